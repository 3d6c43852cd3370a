/* Chapter 5: the start-up error, its seeds, its running mean, the density, the interval, d dimensions. All of it is
   deterministic: tables of exact values, closed forms, sums in another order, quadrature, numerical convolution. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "kernels.h"

static const double pi = 3.14159265358979323846;
static const double infinity = (double)INFINITY;

/* One kernel of each shape, of moderate size, with and without large steps. */
static metro_kernel specimen(int i)
{
    static const metro_shape shape[6] = { METRO_UNIFORM, METRO_TRIANGLE,  METRO_GAUSSIAN,
                                          METRO_CAUCHY,  METRO_VON_MISES, METRO_KELEMEN };
    static const double size[6] = { 0.3, 0.5, 0.1, 0.05, 4, 0.4 };
    return kernel_make(shape[i % 6], size[i % 6], 0.05, i < 6 ? 0 : 0.2);
}

static double number(const char *text)
{
    return strcmp(text, "-inf") == 0 ? -infinity : strtod(text, NULL);
}

/* value = truth to 1e-12 of max(1, abs(truth)): how logarithms are compared. */
static void check_logarithm(double value, double truth)
{
    if (isinf(truth)) CHECK(isinf(value) && value < 0, "%.17g should be -infinity", value);
    else CHECK_CLOSE(value, truth, 1e-12 * (fabs(truth) > 1 ? fabs(truth) : 1));
}

/* An error and its logarithm against the table's texts; below 1e-300 only the logarithm counts. */
static void check_error(double error, double logarithm, const char *error_text, const char *logarithm_text)
{
    double truth = strtod(error_text, NULL);
    if (truth > 1e-300 || isinf(number(logarithm_text))) CHECK_NEAR(error, truth, 1e-12);
    check_logarithm(logarithm, number(logarithm_text));
}

/* ---- The tables ---- */

static metro_shape row_shape;

static void single_row(char **field, int fields)
{
    metro_kernel k = kernel_make(row_shape, number(field[0]), 0, 0);
    uint64_t n = strtoull(field[1], NULL, 10);
    CHECK(fields == 4, "%d fields", fields);
    check_error(metro_startup_error(&k, n), metro_startup_log_error(&k, n), field[2], field[3]);
}

/* Catches: Delta taken as the half width, a power n for 2n, a series cut too early, a wrong branch at n = 6, a
   logarithm that underflows with its error. */
static void table_uniform(void)
{
    row_shape = METRO_UNIFORM;
    CHECK(check_rows("fourier_uniform.csv", single_row) == 110, "rows");
}

/* Catches: the base of the triangle taken for its half, sinc in place of its square. */
static void table_triangular(void)
{
    row_shape = METRO_TRIANGLE;
    CHECK(check_rows("fourier_triangular.csv", single_row) == 110, "rows");
}

/* Catches: a wrong exponent, images that are not wrapped, the change of series at the wrong place. */
static void table_gauss(void)
{
    row_shape = METRO_GAUSSIAN;
    CHECK(check_rows("fourier_gauss.csv", single_row) == 60, "rows");
}

/* Catches: 2 pi for 4 pi in the exponent, exp - 1 without expm1. */
static void table_cauchy(void)
{
    row_shape = METRO_CAUCHY;
    CHECK(check_rows("fourier_cauchy.csv", single_row) == 60, "rows");
}

/* Catches: too few modes at large kappa, 1 - P formed where P is near 1. */
static void table_von_mises(void)
{
    row_shape = METRO_VON_MISES;
    CHECK(check_rows("fourier_vonmises.csv", single_row) == 60, "rows");
}

static void kelemen_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_KELEMEN, number(field[1]), number(field[0]), 0);
    uint64_t n = strtoull(field[2], NULL, 10);
    CHECK(fields == 5, "%d fields", fields);
    check_error(metro_startup_error(&k, n), metro_startup_log_error(&k, n), field[3], field[4]);
}

/* Catches: a kink of eq 5.27 left out of the panels, the first mode taken for the largest, s1 and s2 exchanged. */
static void table_kelemen(void)
{
    CHECK(check_rows("fourier_kelemen.csv", kelemen_row) == 40, "rows");
}

static void kelemen_edge_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_KELEMEN, number(field[1]), number(field[0]), 0);
    uint64_t n = strtoull(field[2], NULL, 10);
    double bound = 5e-13 + number(field[4]);
    CHECK(fields == 5, "%d fields", fields);
    if (check_scale() < 1 && n % 3 > 0) return;
    CHECK_NEAR(metro_startup_error(&k, n), number(field[3]), bound);
    CHECK_CLOSE(metro_startup_log_error(&k, n), log(number(field[3])), bound);
}

static void kelemen_edge_density_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_KELEMEN, number(field[1]), number(field[0]), 0);
    uint64_t n = strtoull(field[2], NULL, 10);
    double zero = 0, x = number(field[3]), e = metro_startup_error(&k, n / 2);
    CHECK(fields == 5, "%d fields", fields);
    if (check_scale() < 1 && n % 3 > 0) return;
    CHECK_CLOSE(metro_startup_density(&k, n, x, &zero, NULL, 1), number(field[4]), 1e-12 * (1 + e * e));
}

/* Sizes within 1e-13 .. 1/10 of each other, and ratios to 1e60. Catches: a packet (j, m) left out or ended too early,
   the window of the modes and that of the integral not adding up to 1, arg z with the wrong sign (densities), digits
   of s2 - s1 lost, a panel too long for its oscillation. */
static void kelemen_at_the_edges(void)
{
    CHECK(check_rows("kelemen_edges.csv", kelemen_edge_row) == 56, "rows");
    CHECK(check_rows("kelemen_edges_density.csv", kelemen_edge_density_row) == 37, "rows");
}

/* What rests on the error at the edges: the running mean is a double sum over densities, the interval and seeds are
   pairs of densities. Catches: C_j of the running mean without its odd orders, seeds that are paired by their sum, a
   weight lost. */
static void kelemen_edges_hold_together(void)
{
    static const double s1[6] = { 1e-9, 0.00099999, 0.2499999, 2.5e-7, 9e-6, 1.69999 };
    static const double s2[6] = { 1e-3, 0.001, 0.25, 0.25, 1e-5, 1.7 };
    static const double seed[3] = { 0, 0.25, 0.251 }, alpha[3] = { 0.2, 0.3, 0.5 };
    double zero = 0, sum, pair, x0;
    int i, j, l, n, s, burn, steps = 5;
    for (i = 0; i < 6; i++) {
        metro_kernel k = kernel_make(METRO_KELEMEN, s2[i], s1[i], 0), half;
        if (check_scale() < 1 && i > 0) continue;
        for (burn = 1; burn <= 3; burn += 2) {
            sum = 0;
            for (s = 2 * burn; s <= 2 * (burn + steps - 1); s++)
                sum += (steps - abs(2 * burn + steps - 1 - s))
                     * (metro_startup_density(&k, (uint64_t)s, 0, &zero, NULL, 1) - 1);
            CHECK_NEAR(steps * metro_startup_error_mean(&k, (uint64_t)burn, (uint64_t)steps), sqrt(sum), 1e-12);
        }
        for (n = 2; n <= 5; n += 3) {
            sum = 0;
            for (j = 0; j < 3; j++)
                for (l = 0; l < 3; l++)
                    sum += alpha[j] * alpha[l]
                         * (metro_startup_density(&k, 2 * (uint64_t)n, seed[j], seed + l, NULL, 1) - 1);
            CHECK_NEAR(metro_startup_error_seeds(&k, (uint64_t)n, seed, alpha, 3), sqrt(sum), 1e-12);
            half = k;
            half.size *= 0.5;
            half.size_min *= 0.5;
            x0 = 2 * half.size_min;
            pair = metro_startup_density(&half, 2 * (uint64_t)n, 0, &zero, NULL, 1)
                 + metro_startup_density(&half, 2 * (uint64_t)n, x0, &zero, NULL, 1);
            CHECK_NEAR(metro_reflect_startup_error(&k, x0, (uint64_t)n), sqrt(0.5 * pair - 1), 1e-12);
        }
    }
}

/* The plain sum over modes is long but no match for 1e-9 where s1 and s2 are whole: against its own first terms. And
   every value at the edges is one: no NaN, and no rise with n. Catches: eq 5.13 with k in place of k^2, a gap between
   what the series and the far modes accept. */
static void kelemen_has_no_gaps(void)
{
    static const double size[8] = { 1e-80, 1e-6, 0.01, 0.25, 0.50001, 1.7, 20, 9999 };
    static const double ratio[9] = { 1e-15, 1e-6, 0.03, 0.5, 0.9, 0.999, 0.999999, 1 - 1e-9, 1 - 1e-14 };
    metro_kernel k = kernel_make(METRO_KELEMEN, 3, 1.5, 0);
    double sum = 0, p, before, at;
    int i, j, n;
    for (n = 20000; n >= 1; n--) {
        p = metro_kernel_coefficient(&k, n);
        sum += 2 * p * p * p * p * p * p;
    }
    CHECK_NEAR(metro_startup_error(&k, 3), sqrt(sum), 1e-12);
    for (i = 0; i < 8; i++)
        for (j = 0; j < 9; j++) {
            k = kernel_make(METRO_KELEMEN, size[i], size[i] * ratio[j], 0);
            before = infinity;
            for (n = 1; n <= 1000 && check_scale() == 1; n = n < 4 ? n + 1 : 6 * n) {
                at = metro_startup_log_error(&k, (uint64_t)n);
                CHECK(at <= before, "size %g ratio %.17g n = %d: %g after %g", size[i], ratio[j], n, at, before);
                before = at;
            }
        }
}

static void mixture_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, number(field[1]), 0, number(field[0]));
    uint64_t n = strtoull(field[2], NULL, 10);
    CHECK(fields == 5, "%d fields", fields);
    check_error(metro_startup_error(&k, n), metro_startup_log_error(&k, n), field[3], field[4]);
}

/* Catches: (1 - p)^{2n} on the error in place of (1 - p)^n, p and 1 - p exchanged. */
static void table_large_steps(void)
{
    CHECK(check_rows("mixture.csv", mixture_row) == 90, "rows");
}

static size_t list_read(const char *text, double *value)
{
    size_t count = 0;
    char *at;
    for (;;) {
        value[count++] = strtod(text, &at);
        if (*at != ';') return count;
        text = at + 1;
    }
}

/* Sets A and C are equispaced: their errors are known to a share of the single seed's, the others relatively. */
static void seeds_row(char **field, int fields)
{
    double seed[16], alpha[16], error, logarithm, truth = strtod(field[5], NULL), single;
    size_t seeds = list_read(field[1], seed);
    metro_kernel k = uniform_kernel(number(field[3]));
    uint64_t n = strtoull(field[4], NULL, 10);
    if (check_scale() < 1 && n == 3 && k.size < 0.1) return; /* ten thousand modes */
    CHECK(fields == 7 && list_read(field[2], alpha) == seeds, "%d fields", fields);
    error = metro_startup_error_seeds(&k, n, seed, alpha, seeds);
    logarithm = metro_startup_log_error_seeds(&k, n, seed, alpha, seeds);
    single = metro_startup_error(&k, n);
    if (field[0][0] == 'B' || field[0][0] == 'D') check_error(error, logarithm, field[5], field[6]);
    else CHECK_CLOSE(error, truth, 1e-12 * truth + (n <= 2 ? 1e-8 : 1e-13) * single);
}

/* Catches: the seed sum inside the power (paper (15) as printed), weights squared or forgotten, e^{-2 pi i k x} with
   a half turn. */
static void table_seeds(void)
{
    CHECK(check_rows("multiseed_uniform.csv", seeds_row) == 168, "rows");
}

/* Where the table says 0 its digits had run out; the errors are small there, and then E = sqrt(d) e. */
static void axes_row(char **field, int fields)
{
    metro_kernel k[10];
    size_t axes = (size_t)strtoul(field[0], NULL, 10), i;
    uint64_t n = strtoull(field[2], NULL, 10);
    double logarithm;
    CHECK(fields == 5 && axes <= 10, "%d fields", fields);
    for (i = 0; i < axes; i++) k[i] = uniform_kernel(number(field[1]));
    logarithm = metro_startup_log_error_axes(k, axes, n);
    if (isinf(number(field[4]))) check_logarithm(logarithm, metro_startup_log_error(k, n) + 0.5 * log((double)axes));
    else check_error(metro_startup_error_axes(k, axes, n), logarithm, field[3], field[4]);
}

/* Catches: errors added where they multiply, d forgotten where the product underflows. */
static void table_axes(void)
{
    CHECK(check_rows("ddim_uniform.csv", axes_row) == 90, "rows");
}

static void reflect_row(char **field, int fields)
{
    metro_kernel k = uniform_kernel(number(field[0]));
    double x0 = number(field[1]);
    uint64_t n = strtoull(field[2], NULL, 10);
    CHECK(fields == 5, "%d fields", fields);
    check_error(metro_reflect_startup_error(&k, x0, n), metro_reflect_startup_log_error(&k, x0, n), field[3],
                field[4]);
}

/* Catches: the circle's spectrum on the interval, the seed halved with the kernel, cos^2 for its mean 1/2. */
static void table_reflect(void)
{
    CHECK(check_rows("reflect_uniform.csv", reflect_row) == 108, "rows");
}

static void mean_row(char **field, int fields)
{
    metro_kernel k = kernel_make(row_shape, number(field[0]), 0, 0);
    uint64_t burn = strtoull(field[1], NULL, 10), steps = strtoull(field[2], NULL, 10);
    CHECK(fields == 5, "%d fields", fields);
    check_error(metro_startup_error_mean(&k, burn, steps), metro_startup_log_error_mean(&k, burn, steps), field[3],
                field[4]);
}

/* Catches: a mean that starts at p_0 or p_{b+1}, 1 - P^M formed near 1, a power taken out twice. */
static void table_mean(void)
{
    row_shape = METRO_UNIFORM;
    CHECK(check_rows("timeavg_uniform.csv", mean_row) == 126, "rows");
    row_shape = METRO_GAUSSIAN;
    CHECK(check_rows("timeavg_gauss.csv", mean_row) == 56, "rows");
}

static void distance_row(char **field, int fields)
{
    metro_kernel k = uniform_kernel(number(field[0]));
    uint64_t n = strtoull(field[1], NULL, 10);
    double variation = metro_startup_total_variation_bound(&k, n), divergence = metro_startup_divergence_bound(&k, n);
    CHECK(fields == 4, "%d fields", fields);
    if (n == 1) {
        CHECK_NEAR(variation, number(field[2]), 1e-12);
        CHECK_NEAR(divergence, number(field[3]), 1e-12);
    } else {
        CHECK(variation >= number(field[2]), "%g is no bound of %s", variation, field[2]);
        CHECK(divergence >= number(field[3]), "%g is no bound of %s", divergence, field[3]);
    }
}

/* Catches: a bound below the distance, the two values of the density exchanged. */
static void table_distances(void)
{
    CHECK(check_rows("tv_kl_uniform.csv", distance_row) == 30, "rows");
}

/* ---- The paper ---- */

/* The numbers that chapter 5 gives as evidence for its corrections. Catches: an erratum undone. */
static void evidence_for_the_errata(void)
{
    static const double seed[3] = { 0, 0.25, 0.6 }, alpha[3] = { 0.2, 0.3, 0.5 };
    metro_kernel k = uniform_kernel(1 / (2 * pi));
    double printed = 0, cut = 0, p, a, b;
    int i, j;
    /* (12) on the circle of length 2 pi: B_6(0) = 11/20 is the true mean square of p_3 there */
    CHECK_CLOSE(metro_startup_error(&k, 3), 1.567084, 5e-7);
    CHECK_CLOSE(sqrt(0.55 - 1 / (2 * pi)), 0.625176, 5e-7);
    CHECK_NEAR(metro_startup_error(&k, 3) / sqrt(2 * pi), sqrt(0.55 - 1 / (2 * pi)), 1e-12);
    /* (15) */
    k = uniform_kernel(0.3);
    for (i = 1; i < 1000; i++) {
        p = sin(pi * i * 0.3) / (pi * i * 0.3);
        a = b = 0;
        for (j = 0; j < 3; j++) {
            a += alpha[j] * cos(2 * pi * i * seed[j]);
            b += alpha[j] * sin(2 * pi * i * seed[j]);
        }
        printed += 2 * pow(p * p * (a * a + b * b), 3);
    }
    CHECK_CLOSE(sqrt(printed), 0.022252, 5e-7);
    CHECK_CLOSE(metro_startup_error_seeds(&k, 3, seed, alpha, 3), 0.202907, 5e-7);
    /* section 2.3: n = 10/Delta */
    k = uniform_kernel(0.1);
    CHECK_CLOSE(metro_startup_error(&k, 100), 0.27, 0.005);
    k = uniform_kernel(0.01);
    CHECK_CLOSE(metro_startup_error(&k, 1000), 1.45, 0.005);
    k = uniform_kernel(0.001);
    CHECK_CLOSE(metro_startup_error(&k, 10000), 2.96, 0.005);
    /* the series cut after 100 terms */
    for (i = 1; i <= 100; i++) {
        p = sin(pi * i * 0.01) / (pi * i * 0.01);
        cut += 2 * p * p;
    }
    k = uniform_kernel(0.01);
    CHECK_CLOSE(sqrt(cut) / metro_startup_error(&k, 1), 0.95, 0.005);
    k = uniform_kernel(0.1);
    CHECK_CLOSE(metro_startup_log_error(&k, 100000) / log(10.0), -717, 0.5);
}

/* ---- Closed forms ---- */

/* I_0, by its power series */
static double bessel_i0(double x)
{
    double sum = 1, term = 1;
    int m;
    for (m = 1; m < 200; m++) {
        term *= x * x / (4.0 * m * m);
        sum += term;
    }
    return sum;
}

/* sqrt(2 pi x) e^{-x} I_0(x) for large x, by its asymptotic series */
static double bessel_i0_large(double x)
{
    double sum = 1, term = 1;
    int m;
    for (m = 1; m < 12; m++) {
        term *= (2 * m - 1) * (2 * m - 1) / (8 * m * x);
        sum += term;
    }
    return sum;
}

/* Catches: a wrong first error of any shape, independently of the tables' parameters; failures: n = 1 with small
   Delta. */
static void first_errors_are_closed(void)
{
    double s1 = 0.013, s2 = 0.2, l = log(s2 / s1), size;
    metro_kernel k;
    for (size = 1e-9; size < 0.6; size *= 7) {
        k = uniform_kernel(size);
        CHECK_NEAR(metro_startup_error(&k, 1), sqrt((1 - size) / size), 1e-12);
        CHECK_NEAR(metro_startup_error(&k, 2), sqrt((2 - 3 * size) / (3 * size)), 1e-12);
        k = kernel_make(METRO_TRIANGLE, size, 0, 0);
        CHECK_NEAR(metro_startup_error(&k, 1), sqrt(4 / (3 * size) - 1), 1e-12);
    }
    k = kernel_make(METRO_VON_MISES, 7, 0, 0);
    CHECK_NEAR(metro_startup_error(&k, 1), sqrt(bessel_i0(14) / (bessel_i0(7) * bessel_i0(7)) - 1), 1e-12);
    for (size = 600; size < 1e12; size *= 1.6) {
        k = kernel_make(METRO_VON_MISES, size, 0, 0);
        CHECK_NEAR(metro_startup_error(&k, 1),
                   sqrt(sqrt(pi * size) * bessel_i0_large(2 * size) / pow(bessel_i0_large(size), 2) - 1), 1e-12);
    }
    k = kernel_make(METRO_KELEMEN, s2, s1, 0);
    CHECK_NEAR(metro_startup_error(&k, 1), sqrt((s2 - s1) / (2 * l * l * s1 * s2) - 1), 1e-12);
    k = kernel_make(METRO_CAUCHY, 0.02, 0, 0);
    CHECK_NEAR(metro_startup_error(&k, 6), sqrt(2 / expm1(24 * pi * 0.02)), 1e-12);
    k = kernel_make(METRO_GAUSSIAN, 1e-7, 0, 0);
    CHECK_NEAR(metro_startup_error(&k, 9), sqrt(1 / (sqrt(36 * pi) * 1e-7) - 1), 1e-12);
}

/* The coefficient of chapter 3's table, computed here in its own way, for k > 0. Kelemen: chapter 3's. */
static double mode(const metro_kernel *k, int harmonic)
{
    double s = k->size, x = pi * harmonic * s, p = 0;
    switch (k->shape) {
    case METRO_UNIFORM: p = sin(x) / x; break;
    case METRO_TRIANGLE: p = pow(sin(x / 2) / (x / 2), 2); break;
    case METRO_GAUSSIAN: p = exp(-2 * x * x); break;
    case METRO_CAUCHY: p = exp(-2 * x); break;
    case METRO_VON_MISES:
    case METRO_KELEMEN: return metro_kernel_coefficient(k, harmonic);
    }
    return (1 - k->large) * p;
}

/* The series of eq 5.7 added from its far end, for every shape, n where it converges by 20000 terms, sizes on both
   sides of 1. Catches: a sum that stops early or on the zero of a mode, a wrong period of eq 5.16, a size taken
   modulo 1 without its factor. */
static void direct_sums_agree(void)
{
    static const double scale[6] = { 0.11, 0.9, 1.6, 3.7, 8.15, 0.031 };
    int shape, i, n, k;
    for (shape = 0; shape < 12; shape++)
        for (i = 0; i < 6; i++) {
            metro_kernel kernel = specimen(shape);
            double sum[3] = { 0, 0, 0 };
            int terms = (int)check_count(kernel.shape == METRO_VON_MISES ? 60 : 20000, 20);
            if (kernel.shape == METRO_KELEMEN && check_scale() < 1) continue;
            kernel.size *= scale[i];
            kernel.size_min *= scale[i];
            for (k = terms; k >= 1; k--) {
                double p = fabs(mode(&kernel, k));
                for (n = 0; n < 3; n++) sum[n] += 2 * pow(p, n == 0 ? 10 : n == 1 ? 14 : 60);
            }
            for (n = 0; n < 3; n++)
                if (sum[n] > 1e-290 && (terms >= 20000 || kernel.shape == METRO_VON_MISES))
                    CHECK_NEAR(metro_startup_error(&kernel, n == 0 ? 5 : n == 1 ? 7 : 30), sqrt(sum[n]), 1e-12);
        }
}

/* E_n^2 is a moment sequence in n: log-convex and decreasing. Catches: a step where one algorithm hands over to the
   next. */
static void errors_are_log_convex(void)
{
    int shape, n;
    double size;
    for (shape = 0; shape < 5; shape++)
        for (size = 1e-6; size < 20; size *= 3.7) {
            metro_kernel k = kernel_make(specimen(shape).shape, shape == 4 ? 1 / (size * size) : size, 0, 0);
            double before = metro_startup_log_error(&k, 1), at = metro_startup_log_error(&k, 2), after;
            for (n = 3; n < 60; n++) {
                after = metro_startup_log_error(&k, (uint64_t)n);
                CHECK(after < at, "shape %d size %g n %d", shape, size, n);
                CHECK(before - 2 * at + after > -1e-12 * (1 + fabs(at)), "shape %d size %g n %d: %g", shape, size, n,
                      before - 2 * at + after);
                before = at;
                at = after;
            }
        }
}

/* ---- Where it is delicate ---- */

/* Failures: whole Delta. Catches: a rounding error for an exact 0, digits lost beside it. */
static void whole_sizes_are_exact(void)
{
    double size, g;
    uint64_t n;
    int i;
    for (size = 1; size < 2000; size = 2 * size + 1)
        for (n = 1; n < 1000000; n = 3 * n + 1) {
            metro_kernel k = uniform_kernel(size), t = kernel_make(METRO_TRIANGLE, 2 * size, 0, 0);
            double seed[2] = { 0.1, 0.45 };
            CHECK_NEAR(metro_startup_error(&k, n), 0.0, 0);
            CHECK_NEAR(metro_startup_log_error(&k, n), -infinity, 0);
            CHECK_NEAR(metro_startup_error(&t, n), 0.0, 0);
            CHECK_NEAR(metro_startup_error_mean(&k, n, 10), 0.0, 0);
            CHECK_NEAR(metro_startup_log_error_mean(&t, n, 10), -infinity, 0);
            CHECK_NEAR(metro_startup_error_seeds(&k, n, seed, NULL, 2), 0.0, 0);
            CHECK_NEAR(metro_startup_error_axes(&k, 1, n), 0.0, 0);
            CHECK_NEAR(metro_startup_density(&k, n, 0.3, seed, NULL, 2), 1.0, 0);
        }
    for (i = 1; i <= 50; i++)
        for (size = 1; size < 2000; size = 2 * size + 1) {
            metro_kernel k = uniform_kernel(size + pow(0.5, i));
            g = k.size - rint(k.size);
            if (g == 0 || i == 1) continue;
            check_logarithm(metro_startup_log_error(&k, 1), log(g / k.size) + 0.5 * log((1 - g) / g));
            check_logarithm(metro_startup_log_error(&k, 2), 2 * log(g / k.size) + 0.5 * log((2 - 3 * g) / (3 * g)));
            /* powers above the third of d/Delta are nothing: M^2 E^2 = e_2 + 2 e_3 */
            if (g < 1e-6) CHECK_NEAR(2 * metro_startup_error_mean(&k, 1, 2), metro_startup_error(&k, 1), 1e-5);
        }
    for (i = 2; i <= 50; i++) {
        metro_kernel k = uniform_kernel(3 - pow(0.5, i));
        g = pow(0.5, i);
        check_logarithm(metro_startup_log_error(&k, 1), log(g / k.size) + 0.5 * log((1 - g) / g));
    }
}

/* Failures: n = 1e6 and more. Catches: a logarithm that ends with its error, an overflow of 2n. */
static void logarithms_outlive_the_double(void)
{
    static const uint64_t steps[5] = { 1000000, 1000000000, UINT64_C(1000000000000), UINT64_C(1000000000000000000),
                                       UINT64_MAX };
    int shape, i;
    for (shape = 0; shape < 12; shape++)
        for (i = 0; i < 5; i++) {
            metro_kernel k = specimen(shape);
            double n = (double)steps[i], first = log(fabs(mode(&k, 1)));
            CHECK_NEAR(metro_startup_log_error(&k, steps[i]), n * first + 0.5 * log(2.0), 1e-12);
            CHECK_NEAR(metro_startup_error(&k, steps[i]), 0.0, 0);
            CHECK_NEAR(metro_startup_log_error_mean(&k, steps[i], 1), n * first + 0.5 * log(2.0), 1e-12);
            /* of the mean: the first sample, and all that follow it, each less by P */
            CHECK_CLOSE(metro_startup_log_error_mean(&k, steps[i], 1000000),
                        n * first + 0.5 * log(2.0) - log(1e6) - log1p(-mode(&k, 1)), 1e-12 * fabs(n * first));
            CHECK_NEAR(metro_startup_log_error_axes(&k, 1, steps[i]), n * first + 0.5 * log(2.0), 1e-12);
        }
}

/* Failures: no slowness for any size or n: a loop that does not end hangs here. Values that both sides know: a small
   perturbation has not gone around, and E^2 + 1 = B_{2n}(0)/Delta is nearly Gaussian. */
static void tiny_sizes_are_quick(void)
{
    double size, n, truth;
    for (size = 1e-20; size < 1e-4; size *= 57)
        for (n = 1e4; n < 0.1 / (size * size) && n < 1e18; n *= 97) {
            metro_kernel k = uniform_kernel(size), g = kernel_make(METRO_GAUSSIAN, size / sqrt(12.0), 0, 0);
            /* central limit with its first correction, 1 - 3/(40 n) for uniform steps; the next is of order 1/n^2 */
            truth = sqrt(6 / (pi * 2 * n)) / size * (1 - 3 / (40 * n)) - 1;
            CHECK_NEAR(pow(metro_startup_error(&k, (uint64_t)n), 2), truth, 1e-8);
            CHECK_NEAR(pow(metro_startup_error(&g, (uint64_t)n), 2), sqrt(3 / (pi * n)) / size - 1, 1e-11);
            if (size > 1e-9 || check_scale() < 1) continue;
            CHECK(metro_startup_error_mean(&k, 1, (uint64_t)n) > metro_startup_error(&k, (uint64_t)n), "n = %g", n);
        }
}

/* ---- Seeds ---- */

/* N = 2^j equispaced seeds leave the multiples of N, and P*(k N) of size Delta is P*(k) of size N Delta. Failures:
   only multiples of N survive. Catches: A_k with an inexact argument, a sum that stops before mode N. */
static void equispaced_seeds_are_a_wider_kernel(void)
{
    static const uint64_t steps[7] = { 1, 2, 3, 5, 20, 300, 100000 };
    double seed[16];
    int shape, i, n, j;
    for (shape = 0; shape < 4; shape++)
        for (i = 2; i <= 16; i *= 2) {
            metro_kernel k = specimen(shape), wide;
            k.size *= 0.07;
            wide = k;
            wide.size *= i;
            for (j = 0; j < i; j++) seed[j] = 0.125 + (double)j / i;
            for (n = 0; n < 7; n++) {
                double truth = metro_startup_error(&wide, steps[n]), single = metro_startup_error(&k, steps[n]);
                double error = metro_startup_error_seeds(&k, steps[n], seed, NULL, (size_t)i);
                CHECK_CLOSE(error, truth, 1e-12 * truth + (steps[n] <= 2 ? 1e-8 : 1e-13) * single);
                if (steps[n] >= 5)
                    check_logarithm(metro_startup_log_error_seeds(&k, steps[n], seed, NULL, (size_t)i),
                                    metro_startup_log_error(&wide, steps[n]));
            }
        }
}

/* The same, but tiny seeds: the pairs of eq 5.42 against the series at the edge of their use, and rotation, whole
   turns, doubled seeds. Catches: a seed that is not wrapped, a pair counted once, weights not squared on the
   diagonal. */
static void seeds_may_be_moved_and_split(void)
{
    static const double seed[4] = { 0.1, 0.35, 0.73, 0.3504 }, alpha[4] = { 0.1, 0.2, 0.3, 0.4 };
    double moved[4], split[5], weight[5], size;
    int shape, n, i;
    for (shape = 0; shape < 12; shape++)
        for (size = 1e-3; size < 2; size *= 6)
            for (n = 1; n <= 12; n = n < 4 ? n + 1 : 2 * n) {
                metro_kernel k = specimen(shape);
                double error, single;
                if (k.shape == METRO_KELEMEN && (size < 0.1 || check_scale() < 1)) continue;
                k.size = k.shape == METRO_VON_MISES ? 0.3 / (size * size) : k.size * size;
                k.size_min *= size;
                error = metro_startup_error_seeds(&k, (uint64_t)n, seed, alpha, 4);
                single = metro_startup_error(&k, (uint64_t)n);
                for (i = 0; i < 4; i++) moved[i] = seed[i] + 0.125 + (i - 2) * 3;
                CHECK_CLOSE(metro_startup_error_seeds(&k, (uint64_t)n, moved, alpha, 4), error, 1e-10 * single);
                for (i = 0; i < 5; i++) {
                    split[i] = seed[i % 4];
                    weight[i] = i == 0 || i == 4 ? 0.05 : alpha[i];
                }
                CHECK_CLOSE(metro_startup_error_seeds(&k, (uint64_t)n, split, weight, 5), error, 1e-13 * single);
                CHECK_NEAR(metro_startup_error_seeds(&k, (uint64_t)n, seed + 1, NULL, 1), single, 1e-12);
                for (i = 0; i < 5; i++) split[i] = 0.77;
                CHECK_NEAR(metro_startup_error_seeds(&k, (uint64_t)n, split, NULL, 5), single, 1e-12);
            }
}

/* The sum of eq 5.41 from its far end, for tiny steps (pairs) and others (modes). Catches: pairs beyond their reach,
   the wrong n in one of the two ways. */
static void seed_sums_agree(void)
{
    static const double seed[4] = { 0.1, 0.35, -0.27, 7.3504 }, alpha[4] = { 0.1, 0.2, 0.3, 0.4 };
    static const double size[6] = { 0.004, 0.02, 0.3, 0.7, 1.01, 2.5 };
    int i, n, k, j, terms = (int)check_count(30000, 8000);
    for (i = check_scale() < 1 ? 2 : 0; i < 6; i++)
        for (n = 3; n <= 9; n += 3) {
            metro_kernel kernel = kernel_make(n == 6 ? METRO_TRIANGLE : METRO_UNIFORM, size[i], 0, n == 9 ? 0.3 : 0);
            double sum = 0, a, b;
            for (k = terms; k >= 1; k--) {
                a = b = 0;
                for (j = 0; j < 4; j++) {
                    double turns = k * seed[j] - floor(k * seed[j]);
                    a += alpha[j] * cos(2 * pi * turns);
                    b += alpha[j] * sin(2 * pi * turns);
                }
                sum += 2 * pow(mode(&kernel, k), 2 * n) * (a * a + b * b);
            }
            CHECK_NEAR(metro_startup_error_seeds(&kernel, (uint64_t)n, seed, alpha, 4), sqrt(sum), 2e-11);
        }
}

/* ---- The density ---- */

/* p_n over one period by the Gauss rule with 8 points on `pieces` equal pieces: its integral and E^2. */
static void density_moments(const metro_kernel *k, uint64_t n, const double *seed, const double *alpha, size_t seeds,
                            int pieces, double *one, double *square)
{
    static const double node[4] = { 0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363 };
    static const double weight[4] = { 0.3626837833783620, 0.3137066458778873, 0.2223810344533745,
                                      0.1012285362903763 };
    int i, j;
    *one = *square = 0;
    for (i = 0; i < pieces; i++)
        for (j = 0; j < 8; j++) {
            double x = (i + 0.5 + 0.5 * (j < 4 ? -node[j] : node[j - 4])) / pieces, w = weight[j % 4] / (2 * pieces);
            double p = metro_startup_density(k, n, x, seed, alpha, seeds);
            CHECK(p >= 0, "p_%d(%g) = %g", (int)n, x, p);
            *one += w * p;
            *square += w * (p - 1) * (p - 1);
        }
}

/* The density integrates to 1 and its L2 distance from 1 is the error: eqs 5.5, 5.6 and 5.7. Pieces of 1/40 put the
   kinks of the uniform and the triangular kernel at their ends. Catches: a seed's weight lost, images that are
   missing. */
static void density_has_the_error(void)
{
    static const double seed[3] = { 0, 0.25, 0.6 }, alpha[3] = { 0.2, 0.3, 0.5 };
    static const double size[5] = { 0.1, 0.35, 0.8, 1.4, 2.25 };
    double one, square, error;
    int i, n, shape;
    for (shape = 0; shape < 2; shape++)
        for (i = 0; i < 5; i++)
            for (n = 1; n <= 40; n = n < 8 ? n + 1 : n + 9) {
                metro_kernel k =
                    kernel_make(shape == 0 ? METRO_UNIFORM : METRO_TRIANGLE, size[i], 0, i == 1 ? 0.25 : 0);
                density_moments(&k, (uint64_t)n, seed, alpha, 3, 40, &one, &square);
                error = metro_startup_error_seeds(&k, (uint64_t)n, seed, alpha, 3);
                CHECK_CLOSE(one, 1, 1e-13);
                CHECK_CLOSE(sqrt(square), error, 1e-8 * error + 1e-13);
            }
    for (shape = 2; shape < 11; shape++)
        for (n = 2; n <= 26; n = n < 6 ? n + 1 : n + 10) {
            metro_kernel k = specimen(shape);
            int rough = k.shape == METRO_KELEMEN;
            const double *weight = rough ? NULL : alpha;
            if (rough && (n == 5 || check_scale() < 1)) continue;
            density_moments(&k, (uint64_t)n, seed, weight, rough ? 1 : 3, rough ? 40 : 60, &one, &square);
            error = metro_startup_error_seeds(&k, (uint64_t)n, seed, weight, rough ? 1 : 3);
            CHECK_CLOSE(one, 1, rough ? 1e-4 : 1e-12);
            CHECK_CLOSE(sqrt(square), error, (rough ? 1e-3 : 1e-10) * error + 1e-13);
        }
}

/* p_{n+1}(x) = int p_n(x - u) P(u) du (eq 5.1) as the mean of p_n over a grid of steps drawn by inversion. Catches: a
   density of the wrong n, a kernel of the wrong width, a wrong sign or shift of odd powers beyond Delta = 1/2, R of
   eq 5.27 with a wrong branch. */
static void density_is_a_convolution(void)
{
    static const metro_shape shape[3] = { METRO_UNIFORM, METRO_TRIANGLE, METRO_KELEMEN };
    static const double scale[5] = { 1, 2.1, 2.9, 4.5, 8.6 };
    int s, n, i, j;
    for (s = 0; s < 3; s++)
        for (n = 2; n <= 6; n++)
            for (i = 0; i < 5; i++) {
                metro_kernel k = specimen((int)shape[s]);
                double x = 0.17 * i, seed = 0.31, sum = 0, u = 0, t;
                int grid = s == 2 ? 400 : 2000;
                if ((s == 2 && n > 3) || check_scale() < 1) continue;
                if (s < 2) k.size *= scale[i];
                for (j = 0; j < grid; j++) {
                    t = (j + 0.5) / grid;
                    if (s == 0) u = k.size * (t - 0.5);
                    if (s == 1) u = k.size * (t < 0.5 ? sqrt(t / 2) - 0.5 : 0.5 - sqrt((1 - t) / 2));
                    if (s == 2) u = k.size * pow(k.size_min / k.size, fabs(2 * t - 1)) * (t < 0.5 ? -1 : 1);
                    sum += metro_startup_density(&k, (uint64_t)n, x - u, &seed, NULL, 1) / grid;
                }
                CHECK_CLOSE(sum, metro_startup_density(&k, (uint64_t)n + 1, x, &seed, NULL, 1), 3e-4);
            }
}

/* The same on a grid for the smooth kernels, where the trapezoidal rule is exact. Catches: a mode number off by one,
   an image or a large step left out. */
static void smooth_density_is_a_convolution(void)
{
    static double p[256], q[256], w[256];
    double zero = 0;
    int shape, n, i, j;
    for (shape = 0; shape < 12; shape++) {
        metro_kernel k = specimen(shape);
        if (k.shape < METRO_GAUSSIAN || k.shape == METRO_KELEMEN) continue;
        for (i = 0; i < 256; i++) p[i] = w[i] = metro_kernel_density(&k, 0, i / 256.0);
        for (n = 1; n <= 12; n++) {
            for (i = 0; i < 256; i++)
                CHECK_CLOSE(metro_startup_density(&k, (uint64_t)n, i / 256.0, &zero, NULL, 1), p[i], 2e-13);
            for (i = 0; i < 256; i++) {
                q[i] = 0;
                for (j = 0; j < 256; j++) q[i] += p[j] * w[(i - j + 256) % 256] / 256;
            }
            memcpy(p, q, sizeof p);
        }
    }
}

/* n = 1 is the kernel's density, jumps included; n = 0 is a point; tails are exact. Catches: a jump counted whole, a
   density that is not 0 where no step reaches. */
static void density_at_the_edges(void)
{
    metro_kernel k = uniform_kernel(0.25);
    double seed[2] = { 0.5, 0.125 }, weights[2] = { 1, 0 }, n;
    CHECK_NEAR(metro_startup_density(&k, 1, 0.625, seed, NULL, 1), 2.0, 0);
    CHECK_NEAR(metro_startup_density(&k, 1, 0.6249, seed, NULL, 1), 4.0, 0);
    CHECK_NEAR(metro_startup_density(&k, 1, 0.6251, seed, NULL, 1), 0.0, 0);
    CHECK_NEAR(metro_startup_density(&k, 0, 0.5, seed, NULL, 2), infinity, 0);
    CHECK_NEAR(metro_startup_density(&k, 0, -2.875, seed, NULL, 2), infinity, 0);
    CHECK_NEAR(metro_startup_density(&k, 0, 0.3, seed, NULL, 2), 0.0, 0);
    CHECK_NEAR(metro_startup_density(&k, 0, 0.125, seed, weights, 2), 0.0, 0);
    k = uniform_kernel(0.01);
    for (n = 2; n < 60; n++)
        CHECK_NEAR(metro_startup_density(&k, (uint64_t)n, 0.5 + 0.0050001 * n, seed, NULL, 1), 0.0, 0);
    /* the corner of B_n: ((n/2 - y)^{n-1})/(n-1)!/Delta, at y = n/2 - 1/2 */
    CHECK_NEAR(metro_startup_density(&k, 8, 0.535, seed, NULL, 1), pow(0.5, 7) / 5040 / 0.01, 1e-9);
    k = kernel_make(METRO_KELEMEN, 0.25, 0.25, 0);
    CHECK_NEAR(metro_startup_density(&k, 1, 0.75, seed, NULL, 1), infinity, 0);
    CHECK_NAN(metro_startup_density(&k, 2, 0.5, seed, NULL, 1));
    k.large = 1;
    CHECK_NEAR(metro_startup_density(&k, 2, 0.5, seed, NULL, 1), 1.0, 0);
}

/* ---- The running mean ---- */

/* M^2 E^2 = sum of e_{i+j}(0) over all pairs of steps, e_s(0) from the density. Catches: c_s wrong at its top, odd
   powers with the wrong sign, large steps that weigh each power alike. */
static void mean_is_a_double_sum(void)
{
    static const double scale[4] = { 0.3, 1.9, 3.3, 3.35 };
    int shape, i, burn, s, steps;
    for (shape = 0; shape < 12; shape++)
        for (i = 0; i < 4; i++)
            for (burn = 1; burn <= 9; burn += 4) {
                metro_kernel k = specimen(shape);
                double sum = 0, zero = 0;
                if (k.shape == METRO_KELEMEN && check_scale() < 1) continue;
                k.size *= scale[i];
                k.size_min *= scale[i];
                steps = shape == 5 && i == 0 ? 4 : 9;
                for (s = 2 * burn; s <= 2 * (burn + steps - 1); s++) {
                    int c = s - 2 * burn + 1 < 2 * (burn + steps - 1) - s + 1 ? s - 2 * burn + 1
                                                                              : 2 * (burn + steps - 1) - s + 1;
                    sum += c * (metro_startup_density(&k, (uint64_t)s, 0, &zero, NULL, 1) - 1);
                }
                /* the density has lost what is small against 1 */
                CHECK_CLOSE(metro_startup_error_mean(&k, (uint64_t)burn, (uint64_t)steps) * steps, sqrt(sum),
                            1e-11 * sqrt(sum) + 1e-13 * steps * steps / sqrt(sum));
            }
}

/* Long runs against the sum over modes, from its far end, where that converges. Catches: a short circle that is too
   short, the tail of eq 5.54 for eq 5.55, the Euler-Maclaurin panels. */
static void long_means_agree_with_modes(void)
{
    static const double steps[5] = { 2, 1000, 1e5, 1e9, 1e18 };
    static const double size[7] = { 0.02, 0.15, 0.01, 0.002, 3e4, 0.7, 1.2 };
    static const metro_shape shape[7] = { METRO_UNIFORM,   METRO_TRIANGLE, METRO_GAUSSIAN, METRO_CAUCHY,
                                          METRO_VON_MISES, METRO_UNIFORM,  METRO_TRIANGLE };
    int i, j, burn, k;
    for (i = 0; i < 7; i++)
        for (j = 0; j < 5; j++)
            for (burn = 1; burn <= 4; burn += 3) {
                metro_kernel kernel = kernel_make(shape[i], size[i], 0, i == 5 ? 1e-9 : 0);
                double sum = 0, p, t, m = steps[j];
                if (check_scale() < 1 || (burn == 1 && kernel.shape == METRO_UNIFORM)) continue;
                for (k = 30000; k >= 1; k--) {
                    p = mode(&kernel, k);
                    t = p < 0 ? 1 - (p < -1e-3 || m < 100 ? pow(p, m) : 0) : -expm1(m * log(p));
                    if (p > 0.5 && kernel.shape == METRO_GAUSSIAN) t = -expm1(-2 * m * pow(pi * k * kernel.size, 2));
                    t *= pow(p, burn) / (1 - p);
                    sum += 2 * t * t;
                }
                CHECK_NEAR(metro_startup_error_mean(&kernel, (uint64_t)burn, (uint64_t)m), sqrt(sum) / m, 2e-9);
            }
}

/* Sums that keep every digit: Gaussian modes when M goes to infinity, M^2 E^2 = 2 sum 1/(e^{a k^2} - 1)^2, and Cauchy
   powers one by one. Catches: 1 - P formed near 1, the correction of the Euler-Maclaurin panels left out or upside
   down. */
static void long_means_keep_their_digits(void)
{
    static const double size[4] = { 1e-6, 1e-4, 1e-3, 0.01 };
    static const int steps[4] = { 1025, 1500, 4000, 9000 };
    int i, j, s;
    for (i = 0; i < 4; i++) {
        metro_kernel k = kernel_make(METRO_GAUSSIAN, size[i], 0, 0);
        double sum = 0;
        for (s = 30000; s >= 1; s--) sum += 2 / pow(expm1(2 * pow(pi * s * size[i], 2)), 2);
        CHECK_NEAR(1e18 * metro_startup_error_mean(&k, 1, UINT64_C(1000000000000000000)), sqrt(sum), 1e-12);
        for (j = 0; j < 4; j++) {
            k = kernel_make(METRO_CAUCHY, size[i], 0, j % 2 == 0 ? 0 : 1e-4);
            sum = 0;
            for (s = 2 * steps[j]; s >= 2; s--)
                sum += (s - 1 < 2 * steps[j] - s + 1 ? s - 1 : 2 * steps[j] - s + 1) * 2 /
                       expm1(2 * pi * size[i] * s) * exp(s * log1p(-k.large));
            CHECK_NEAR(steps[j] * metro_startup_error_mean(&k, 1, (uint64_t)steps[j]), sqrt(sum), 1e-12);
        }
    }
}

/* ---- The interval and d dimensions ---- */

/* Eq 5.43 with chapter 3's eigenvalues, and what follows from symmetry. Catches: x0 folded wrongly, the size not
   halved, the middle that is not the circle. */
static void interval_agrees_with_its_modes(void)
{
    static const double x0[6] = { 0, 0.2, 0.5, 0.77, 1, 1.3 };
    int shape, i, n, k;
    for (shape = 0; shape < 12; shape++)
        for (i = 0; i < 6; i++)
            for (n = 4; n < 100; n *= 4) {
                metro_kernel kernel = specimen(shape);
                double sum = 0;
                if (kernel.shape == METRO_VON_MISES) continue;
                for (k = 3000; k >= 1; k--) {
                    double turns = fmod(k * x0[i], 1), cosine = turns == 0.5 ? 0 : cos(pi * turns);
                    sum += 2 * pow(metro_kernel_reflect_coefficient(&kernel, k), 2 * n) * cosine * cosine;
                }
                CHECK_NEAR(metro_reflect_startup_error(&kernel, x0[i], (uint64_t)n), sqrt(sum), 1e-10);
                check_logarithm(metro_reflect_startup_log_error(&kernel, x0[i], (uint64_t)n), 0.5 * log(sum));
            }
    for (shape = 0; shape < 4; shape++)
        for (n = 1; n < 1000; n *= 3) {
            metro_kernel kernel = specimen(shape);
            double end = metro_reflect_startup_error(&kernel, 0, (uint64_t)n);
            CHECK_NEAR(metro_reflect_startup_error(&kernel, 0.5, (uint64_t)n),
                       metro_startup_error(&kernel, (uint64_t)n), 0);
            CHECK_NEAR(metro_reflect_startup_error(&kernel, 1, (uint64_t)n), end, 1e-12);
            CHECK_NEAR(metro_reflect_startup_error(&kernel, 0.3, (uint64_t)n),
                       metro_reflect_startup_error(&kernel, 0.7, (uint64_t)n), 1e-8);
            CHECK(end > metro_reflect_startup_error(&kernel, 0.3, (uint64_t)n), "the ends are worst");
        }
}


/* k x less the whole number nearest to it, rounded once: as much of a sine's argument as counts. */
static double turns_left(double k, double x)
{
    return fma(k, x, -rint(k * x));
}

/* Six and eight uniform steps on the interval, the seed y from the middle, by 200000 modes from the far end; sizes
   where the even modes are small, and others. Catches: q_s(0) - q_s(y) without the factor 2/g^2, a knot left out,
   even modes with the seed's y for 2 y, large steps or whole turns lost. */
static void seeds_near_the_middle(void)
{
    static const double size[8] = { 0.9991, 0.7, 0.43, 1.3, 2.997, 1.02, 6.9, 4.04 };
    static const double y[5] = { 0.31, 0.04, 1e-2, 1e-5, 4e-7 };
    double sum, p, c, k;
    int i, j, two;
    for (i = 0; i < 8; i++)
        for (j = 0; j < 5; j++)
            for (two = 0; two < 2; two++) {
                metro_shape shape = two ? METRO_TRIANGLE : METRO_UNIFORM;
                metro_kernel kernel = kernel_make(shape, size[i], 0, i % 3 > 1 ? 0.1 : 0);
                double x0 = 0.5 - y[j], h = 0.5 * size[i], near = 0.5 - x0;
                if (check_scale() < 1 && (2 * i + j) % 13 > 0) continue;
                if (two) kernel.size *= 2;
                sum = 0;
                for (k = 200000; k >= 1; k--) {
                    p = sin(pi * turns_left(k, h)) / (pi * k * h);
                    c = fmod(k, 2) > 0 ? sin(pi * turns_left(k, near)) : cos(pi * turns_left(k, near));
                    p *= p;
                    sum += 2 * p * p * p * (two ? p : 1) * c * c;
                }
                sum *= pow(1 - kernel.large, two ? 4 : 6);
                CHECK_NEAR(metro_reflect_startup_error(&kernel, x0, two ? 2 : 3), sqrt(sum), 1e-12);
                CHECK_NEAR(metro_reflect_startup_error(&kernel, 1 - x0, two ? 2 : 3), sqrt(sum), 1e-9);
            }
}

/* Catches: a product that overflows or underflows, the first kernel used for all axes. */
static void axes_multiply(void)
{
    static metro_kernel k[600];
    double product = 1, sum = 0, e;
    int i;
    for (i = 0; i < 6; i++) {
        k[i] = specimen(i);
        e = metro_startup_error(&k[i], 2);
        product *= 1 + e * e;
    }
    CHECK_NEAR(metro_startup_error_axes(k, 6, 2), sqrt(product - 1), 1e-12);
    CHECK_NEAR(metro_startup_log_error_axes(k, 6, 2), 0.5 * log(product - 1), 1e-12);
    for (i = 0; i < 600; i++) {
        k[i] = uniform_kernel(0.001 * (1 + i % 7));
        e = metro_startup_error(&k[i], 1);
        sum += log1p(e * e);
    }
    CHECK_NEAR(metro_startup_log_error_axes(k, 600, 1), 0.5 * sum, 1e-12);
    CHECK_NEAR(metro_startup_error_axes(k, 600, 1), infinity, 0);
    check_logarithm(metro_startup_log_error_axes(k + 6, 1, 1000000000), metro_startup_log_error(k + 6, 1000000000));
    k[0] = k[1] = k[2] = uniform_kernel(0.7);
    check_logarithm(metro_startup_log_error_axes(k, 3, 5000), metro_startup_log_error(k, 5000) + 0.5 * log(3.0));
}

/* ---- Other distances ---- */

/* Quadrature of eq 5.57. Catches: eq 5.60 or 5.61 without the large steps, a bound that is none for another shape. */
static void distances_bound_the_density(void)
{
    static const double size[5] = { 0.1, 0.35, 0.8, 1.4, 2.25 };
    double zero = 0, variation, divergence, p;
    int shape, n, i;
    const int grid = 4000;
    for (shape = 0; shape < 16; shape++)
        for (n = 1; n <= 3; n++) {
            metro_kernel k = specimen(shape % 6);
            if (shape >= 6) k = kernel_make(METRO_UNIFORM, size[shape % 5], 0, shape < 11 ? 0 : 0.3);
            if (k.shape == METRO_KELEMEN && check_scale() < 1) continue;
            variation = divergence = 0;
            for (i = 0; i < grid; i++) {
                p = metro_startup_density(&k, (uint64_t)n, (i + 0.5) / grid, &zero, NULL, 1);
                variation += 0.5 * fabs(p - 1) / grid;
                if (p > 0) divergence += p * log(p) / grid;
            }
            if (k.shape == METRO_UNIFORM && n == 1) {
                CHECK_NEAR(metro_startup_total_variation_bound(&k, 1), variation, 1e-9);
                CHECK_NEAR(metro_startup_divergence_bound(&k, 1), divergence, 1e-9);
            } else {
                CHECK(metro_startup_total_variation_bound(&k, (uint64_t)n) > variation * (1 - 1e-9), "shape %d n %d",
                      shape, n);
                CHECK(metro_startup_divergence_bound(&k, (uint64_t)n) > divergence * (1 - 1e-9), "shape %d n %d",
                      shape, n);
                CHECK(metro_startup_total_variation_bound(&k, (uint64_t)n) <= 1, "shape %d n %d", shape, n);
            }
        }
    /* small distances: beside Delta = 7, chi^2 = e, TV = e (1-e)/Delta, KL = chi^2/2 to first order */
    for (p = 0.01; p > 1e-12; p /= 4) {
        metro_kernel k = uniform_kernel(7 + p);
        double f = k.size - 7;
        CHECK_NEAR(metro_startup_total_variation_bound(&k, 1), f * (1 - f) / k.size, 1e-12);
        CHECK_NEAR(metro_startup_divergence_bound(&k, 1), 0.5 * f * (1 - f) / (k.size * k.size), 0.06);
    }
    /* f = 1/2: KL = ((1+u) ln(1+u) + (1-u) ln(1-u))/2 with u = 1/(2 Delta), a short series */
    for (p = 5.5; p < 1e7; p = 10 * p + 0.5) {
        metro_kernel k = uniform_kernel(p);
        double u = 0.25 / (p * p);
        CHECK_NEAR(metro_startup_divergence_bound(&k, 1),
                   u * (1.0 / 2 + u * (1.0 / 12 + u * (1.0 / 30 + u * (1.0 / 56 + u / 90)))), 1e-12);
    }
}

/* ---- Nonsense and limits ---- */

/* Every function, on the kernel k, at n: all must be NaN (or as `expected`). */
static void check_all(const metro_kernel *k, uint64_t n, double error, double logarithm)
{
    double seed[2] = { 0.1, 0.4 };
    double value[14];
    int i;
    value[0] = metro_startup_error(k, n);
    value[1] = metro_startup_error_seeds(k, n, seed, NULL, 2);
    value[2] = metro_startup_error_mean(k, n, 5);
    value[3] = metro_startup_error_axes(k, 1, n);
    value[4] = metro_reflect_startup_error(k, 0.3, n);
    value[5] = metro_startup_log_error(k, n);
    value[6] = metro_startup_log_error_seeds(k, n, seed, NULL, 2);
    value[7] = metro_startup_log_error_mean(k, n, 5);
    value[8] = metro_startup_log_error_axes(k, 1, n);
    value[9] = metro_reflect_startup_log_error(k, 0.3, n);
    for (i = 0; i < 10; i++) {
        double truth = i < 5 ? error : logarithm;
        if (k->shape == METRO_VON_MISES && i % 5 == 4) truth = (double)NAN;
        if (isnan(truth))
            CHECK(isnan(value[i]), "function %d of shape %d size %g: %g", i, (int)k->shape, k->size, value[i]);
        else
            CHECK(value[i] == truth, "function %d of shape %d size %g at n = %g: %g", i, (int)k->shape, k->size,
                  (double)n, value[i]);
    }
}

/* Failures: n = 0. Catches: a 0 or a NaN for the infinite error of a point, in any function. */
static void nothing_done_is_infinite(void)
{
    int shape;
    for (shape = 0; shape < 12; shape++) {
        metro_kernel k = specimen(shape);
        check_all(&k, 0, infinity, infinity);
        if (shape < 6) k.large = 1;
        if (shape < 6) check_all(&k, 0, infinity, infinity);
        CHECK_NEAR(metro_startup_total_variation_bound(&k, 0), 1.0, 0);
        CHECK_NEAR(metro_startup_divergence_bound(&k, 0), infinity, 0);
    }
}

/* Catches: large = 1, kappa = 0, atoms that get a number. */
static void limits_are_exact(void)
{
    metro_kernel k;
    double nan = (double)NAN;
    int shape;
    for (shape = 0; shape < 6; shape++) {
        k = specimen(shape);
        k.large = 1;
        check_all(&k, 1, 0, -infinity);
        check_all(&k, 1000, 0, -infinity);
        CHECK_NEAR(metro_startup_total_variation_bound(&k, 1), 0.0, 0);
        CHECK_NEAR(metro_startup_divergence_bound(&k, 1), 0.0, 0);
    }
    k = kernel_make(METRO_VON_MISES, 0, 0, 0);
    check_all(&k, 1, 0, -infinity);
    k = kernel_make(METRO_KELEMEN, 0.3, 0.3, 0.5);
    check_all(&k, 1, infinity, infinity);
    check_all(&k, 100, infinity, infinity);
    k.large = 1;
    check_all(&k, 100, 0, -infinity);
    k = uniform_kernel(0.3);
    CHECK_NAN(metro_startup_error_mean(&k, 1, 0));
    CHECK_NAN(metro_startup_log_error_mean(&k, 0, 0));
    CHECK_NAN(metro_startup_error_axes(&k, 0, 1));
    CHECK_NAN(metro_startup_log_error_axes(&k, 0, 1));
    CHECK_NAN(metro_reflect_startup_error(&k, nan, 1));
    CHECK_NAN(metro_reflect_startup_error(&k, infinity, 1));
    CHECK_NAN(metro_reflect_startup_log_error(&k, -infinity, 1));
}

/* Catches: p <= 0 in place of !(p > 0), a kernel used unchecked. */
static void nonsense_is_nan(void)
{
    static const double size[5] = { 0, -0.1, (double)NAN, (double)INFINITY, 1e-200 };
    double nan = (double)NAN, zero = 0;
    metro_kernel k;
    int shape, i;
    for (shape = 0; shape < 6; shape++) {
        for (i = 0; i < 5; i++) {
            k = kernel_make(specimen(shape).shape, size[i], size[i] * 0.5, 0);
            if (shape == 4 && i == 0) continue; /* kappa = 0 is a kernel */
            check_all(&k, 2, nan, nan);
            CHECK_NAN(metro_startup_density(&k, 2, 0.2, &zero, NULL, 1));
            if (i < 4) CHECK_NAN(metro_startup_total_variation_bound(&k, 1));
            if (i < 4) CHECK_NAN(metro_startup_divergence_bound(&k, 1));
        }
        for (i = 0; i < 3; i++) {
            k = specimen(shape);
            k.large = i == 0 ? -0.1 : i == 1 ? 1.1 : nan;
            check_all(&k, 2, nan, nan);
            check_all(&k, 0, nan, nan);
            CHECK_NAN(metro_startup_density(&k, 0, 0.2, &zero, NULL, 1));
        }
    }
    k = kernel_make(METRO_KELEMEN, 0.1, 0.2, 0);
    check_all(&k, 3, nan, nan);
    k = kernel_make((metro_shape)5, 0.1, 0, 0);
    check_all(&k, 3, nan, nan);
}

/* Failures: alpha. Catches: weights that are normalised silently, a sum of absolute values, NULL taken for a fault.
   */
static void weights_are_checked(void)
{
    static const double good[3] = { 0.2, 0.3, 0.5 };
    double seed[3] = { 0.1, 0.4, 0.8 }, alpha[3], nan = (double)NAN;
    metro_kernel k = uniform_kernel(0.2);
    uint64_t n;
    int i;
    for (n = 0; n < 5; n++) {
        CHECK_NAN(metro_startup_error_seeds(&k, n, NULL, NULL, 0));
        CHECK_NAN(metro_startup_error_seeds(&k, n, seed, good, 0));
        CHECK_NAN(metro_startup_error_seeds(&k, n, NULL, good, 3));
        CHECK_NAN(metro_startup_density(&k, n, 0.2, NULL, NULL, 0));
        CHECK_NAN(metro_startup_density(&k, n, nan, seed, good, 3));
        CHECK_NAN(metro_startup_density(&k, n, infinity, seed, good, 3));
        for (i = 0; i < 6; i++) {
            memcpy(alpha, good, sizeof alpha);
            if (i == 0) alpha[1] += 1e-8;
            if (i == 1) alpha[1] -= 1e-8;
            if (i == 2) alpha[1] = nan;
            if (i == 3) alpha[1] = infinity;
            if (i == 4) alpha[0] = -0.1, alpha[1] = 0.6;
            if (i == 5) alpha[2] += 5e-10; /* within what rounding explains */
            if (i < 5) {
                CHECK_NAN(metro_startup_error_seeds(&k, n, seed, alpha, 3));
                CHECK_NAN(metro_startup_log_error_seeds(&k, n, seed, alpha, 3));
                CHECK_NAN(metro_startup_density(&k, n, 0.2, seed, alpha, 3));
            } else {
                CHECK_NEAR(metro_startup_error_seeds(&k, n, seed, alpha, 3),
                           metro_startup_error_seeds(&k, n, seed, good, 3), 1e-8);
            }
        }
        for (i = 0; i < 3; i++) {
            seed[1] = i == 0 ? nan : i == 1 ? infinity : -infinity;
            CHECK_NAN(metro_startup_error_seeds(&k, n, seed, good, 3));
            CHECK_NAN(metro_startup_log_error_seeds(&k, n, seed, NULL, 3));
            CHECK_NAN(metro_startup_density(&k, n, 0.2, seed, good, 3));
        }
        seed[1] = 0.4;
    }
}

int main(void)
{
    CHECK_RUN(table_uniform);
    CHECK_RUN(table_triangular);
    CHECK_RUN(table_gauss);
    CHECK_RUN(table_cauchy);
    CHECK_RUN(table_von_mises);
    CHECK_RUN(table_kelemen);
    CHECK_RUN(kelemen_at_the_edges);
    CHECK_RUN(kelemen_edges_hold_together);
    CHECK_RUN(kelemen_has_no_gaps);
    CHECK_RUN(table_large_steps);
    CHECK_RUN(table_seeds);
    CHECK_RUN(table_axes);
    CHECK_RUN(table_reflect);
    CHECK_RUN(table_mean);
    CHECK_RUN(table_distances);
    CHECK_RUN(evidence_for_the_errata);
    CHECK_RUN(first_errors_are_closed);
    CHECK_RUN(direct_sums_agree);
    CHECK_RUN(errors_are_log_convex);
    CHECK_RUN(whole_sizes_are_exact);
    CHECK_RUN(logarithms_outlive_the_double);
    CHECK_RUN(tiny_sizes_are_quick);
    CHECK_RUN(equispaced_seeds_are_a_wider_kernel);
    CHECK_RUN(seeds_may_be_moved_and_split);
    CHECK_RUN(seed_sums_agree);
    CHECK_RUN(density_has_the_error);
    CHECK_RUN(density_is_a_convolution);
    CHECK_RUN(smooth_density_is_a_convolution);
    CHECK_RUN(density_at_the_edges);
    CHECK_RUN(mean_is_a_double_sum);
    CHECK_RUN(long_means_agree_with_modes);
    CHECK_RUN(long_means_keep_their_digits);
    CHECK_RUN(interval_agrees_with_its_modes);
    CHECK_RUN(seeds_near_the_middle);
    CHECK_RUN(axes_multiply);
    CHECK_RUN(distances_bound_the_density);
    CHECK_RUN(nothing_done_is_infinite);
    CHECK_RUN(limits_are_exact);
    CHECK_RUN(nonsense_is_nan);
    CHECK_RUN(weights_are_checked);
    return check_done("startup");
}
