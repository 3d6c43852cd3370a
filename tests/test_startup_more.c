/* test_startup_more.c - chapter 5, second half: the start-up error on the sphere; bias, variance and mean squared
   error of a run; the size that minimises it. Against tables, sums of the test's own, simulations, and known
   optima. */

#include "memory.h"

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "kernels.h"

#define CHECK_PI 3.14159265358979323846

/* --- The sphere ------------------------------------------------------------------------------------------------- */

static void check_error_row(const char *what, double error, double logarithm, char **field)
{
    double truth = atof(field[2]), log_truth = atof(field[3]), scale = fabs(log_truth) > 1 ? fabs(log_truth) : 1;
    CHECK(fabs(logarithm - log_truth) <= 1e-13 * scale, "%s %s, n = %s: ln E is %.17g, should be %.17g", what,
          field[0], field[1], logarithm, log_truth);
    CHECK(fabs(error - truth) <= 2e-13 * truth * scale + 1e-307, "%s %s, n = %s: E is %.17g, should be %.17g", what,
          field[0], field[1], error, truth);
}

/* Catches: the apex angle, 2l in place of 2l + 1, a tail that stops early, an extension by the wrong polynomial. */
static void cone_row(char **field, int fields)
{
    uint64_t n = (uint64_t)atol(field[1]);
    CHECK(fields == 4, "%d fields", fields);
    check_error_row("cone", metro_cone_startup_error(atof(field[0]), n),
                    metro_cone_startup_log_error(atof(field[0]), n), field);
}

static void vmf_row(char **field, int fields)
{
    uint64_t n = (uint64_t)atol(field[1]);
    CHECK(fields == 4, "%d fields", fields);
    check_error_row("vmf", metro_vmf_startup_error(atof(field[0]), n), metro_vmf_startup_log_error(atof(field[0]), n),
                    field);
}

static void sphere_tables(void)
{
    int rows = check_rows("sphere_cap.csv", cone_row);
    CHECK(rows == 90, "%d rows of the cone", rows);
    rows = check_rows("sphere_vmf.csv", vmf_row);
    CHECK(rows == 60, "%d rows of von Mises and Fisher", rows);
}

/* The sum over degrees, with Legendre polynomials by Bonnet's recurrence. */
static double cone_sum(double angle, uint64_t n, int degrees)
{
    double c = cos(angle), before = 1, p = c, next, sum = 0;
    int l;
    for (l = 1; l <= degrees; l++) {
        next = ((2 * l + 1) * c * p - l * before) / (l + 1);
        sum +=
            (2 * l + 1) * pow((before - next) / ((2 * l + 1) * 2 * sin(angle / 2) * sin(angle / 2)), 2.0 * (double)n);
        before = p;
        p = next;
    }
    return sum;
}

/* Angles and steps of no table, on both sides of every change of method: few and many steps, near the plane or not,
   beyond a hemisphere. */
static void sphere_sums(void)
{
    static const double angle[8] = { 0.079, 0.0818, 0.2, 0.9, 1.55, 1.6, 2.4, 3.0 };
    static const int steps[6] = { 3, 4, 7, 16, 17, 40 };
    static const double kappa[7] = { 0.01, 0.7, 3, 60, 590, 610, 1010 };
    int i, j, l;
    for (i = 0; i < 8; i++) {
        for (j = 0; j < 6; j++) {
            double truth = sqrt(cone_sum(angle[i], (uint64_t)steps[j], 6000));
            CHECK_NEAR(metro_cone_startup_error(angle[i], (uint64_t)steps[j]), truth, i < 2 ? 2e-12 : 3e-13);
        }
    }
    for (i = 0; i < 7; i++) {
        for (j = 0; j < 4; j++) {
            uint64_t n = j < 3 ? (uint64_t)j + 1 : 50;
            double sum = 0;
            for (l = 600; l >= 1; l--) sum += (2 * l + 1) * pow(metro_vmf_coefficient(kappa[i], l), 2.0 * (double)n);
            CHECK_NEAR(metro_vmf_startup_error(kappa[i], n), sqrt(sum), 1e-12);
        }
        CHECK_NEAR(metro_vmf_startup_error(kappa[i], 1), sqrt(kappa[i] / tanh(kappa[i]) - 1),
                   kappa[i] < 1 ? 1e-10 : 1e-14);
    }
}

/* In the limit of small angles the sphere is a plane: E alpha does not depend on alpha. For many steps p is the heat
   kernel, 1 + E^2 = 1/tau + 1/3 + tau/15 + .. at tau = n sin^2(alpha/2) up to 1/n. Catches: a lost factor n in tau,
   and series that take a million terms. */
static void sphere_limits(void)
{
    static const uint64_t steps[5] = { 1, 2, 3, 10, 1000000 };
    uint64_t n = 100000000;
    double tau = 0.01, angle = 2 * asin(sqrt(tau / (double)n)), e;
    int i;
    for (i = 0; i < 5; i++) {
        double near = metro_cone_startup_error(1e-9, steps[i]), far = metro_cone_startup_error(1e-140, steps[i]);
        CHECK_NEAR(near * 1e-9, metro_cone_startup_error(2e-9, steps[i]) * 2e-9, 1e-12);
        CHECK_NEAR(far * 1e-131, near, 1e-12);
        CHECK_NEAR(metro_vmf_startup_error(1e16, steps[i]), 10 * metro_vmf_startup_error(1e14, steps[i]), 1e-7);
    }
    e = metro_cone_startup_error(angle, n);
    CHECK_NEAR(1 + e * e, 1 / tau + 1 / 3.0 + tau / 15, 1e-6);
    e = metro_vmf_startup_error((double)n / 0.001, n);
    CHECK_NEAR(1 + e * e, 1000 + 1 / 3.0, 1e-6);
    CHECK_NEAR(metro_cone_startup_error(1e-300, 1), 2e300, 1e-14);
    CHECK(isfinite(metro_cone_startup_error(1e-300, 2)), "E_2 of a cone of 1e-300");
    CHECK(isfinite(metro_vmf_startup_error(1e300, 3)), "E_3 at kappa = 1e300");
}

static void sphere_ends(void)
{
    double nan = (double)NAN, inf = (double)INFINITY, bad[4], e;
    int i;
    bad[0] = nan;
    bad[1] = inf;
    bad[2] = -0.1;
    bad[3] = 0;
    for (i = 0; i < 4; i++) {
        CHECK_NAN(metro_cone_startup_error(bad[i], 0));
        CHECK_NAN(metro_cone_startup_error(bad[i], 1));
        CHECK_NAN(metro_cone_startup_error(bad[i], 5));
        CHECK_NAN(metro_cone_startup_log_error(bad[i], 1));
        if (i == 3) continue;
        CHECK_NAN(metro_vmf_startup_error(bad[i], 0));
        CHECK_NAN(metro_vmf_startup_log_error(bad[i], 5));
    }
    CHECK_NEAR(metro_cone_startup_error(0.3, 0), inf, 0);
    CHECK_NEAR(metro_cone_startup_log_error(4.0, 0), inf, 0);
    CHECK_NEAR(metro_vmf_startup_error(2, 0), inf, 0);
    CHECK_NEAR(metro_vmf_startup_error(0, 0), inf, 0);
    CHECK(metro_cone_startup_error(CHECK_PI, 1) <= 1e-15 && metro_cone_startup_error(3.2, 1) == 0,
          "the whole sphere");
    CHECK_NEAR(metro_cone_startup_log_error(3.2, 7), -inf, 0);
    CHECK(metro_vmf_startup_error(0, 1) == 0, "kappa = 0");
    CHECK_NEAR(metro_vmf_startup_log_error(0, 1), -inf, 0);
    CHECK_NEAR(metro_cone_startup_error(3.0, 1), cos(1.5) / sin(1.5), 1e-15);
    /* many steps: the first degree alone, as a logarithm, at once */
    e = metro_cone_startup_log_error(0.3, UINT64_C(1000000000000000000));
    CHECK_NEAR(e, 1e18 * log1p(-sin(0.15) * sin(0.15)), 1e-12);
    e = metro_cone_startup_log_error(3.1, UINT64_C(18446744073709551615));
    CHECK_NEAR(e, 18446744073709551615.0 * log(metro_cone_coefficient(3.1, 1)), 1e-12);
    e = metro_vmf_startup_log_error(20, UINT64_C(1000000000000000000));
    CHECK_NEAR(e, 1e18 * log(1 / tanh(20.0) - 0.05), 1e-12);
    CHECK(metro_cone_startup_error(0.3, UINT64_C(1000000000000000000)) == 0, "underflow");
}

/* A chain of directions forgets as the spectrum says: the mean of P_1 and P_2 of cos(theta_n) is lambda^n. Catches: a
   kernel of chapter 3 and a theory that take the angle differently. */
static void sphere_chain(void)
{
    metro_rng rng = metro_rng_make(51, 0);
    metro_vec3 start = metro_vec3_make(0.6, 0, -0.8);
    metro_moments first = { 0, 0, 0, 0 }, second = first;
    uint64_t r, runs = check_count(60000, 3000);
    int n;
    for (r = 0; r < runs; r++) {
        metro_vec3 d = start;
        double c;
        for (n = 0; n < 5; n++) d = metro_cone_perturb(0.5, d, &rng);
        c = metro_dot(d, start);
        metro_moments_add(&first, c);
        metro_moments_add(&second, 1.5 * c * c - 0.5);
    }
    CHECK_SIGMA(metro_moments_mean(&first), pow(metro_cone_coefficient(0.5, 1), 5), metro_moments_error(&first));
    CHECK_SIGMA(metro_moments_mean(&second), pow(metro_cone_coefficient(0.5, 2), 5), metro_moments_error(&second));
}

/* --- The error of a run ----------------------------------------------------------------------------------------- */

static const double table_cosine[3] = { 1, 0, 0.25 }, table_sine[3] = { 0, 0.5, 0 };

/* Catches: a covariance by the closed form (it loses digits at small sizes), a burn-in that is not applied to the
   pairs, the factor 2 of neighbours forgotten, cosine for sine. */
static void check_run_error(const char *what, metro_run_error error, char **field)
{
    double bias = atof(field[0]), variance = atof(field[1]), mse = atof(field[2]);
    CHECK(fabs(error.bias - bias) <= 1e-13 * fabs(bias) + 1e-300, "%s: bias %.17g, should be %.17g", what, error.bias,
          bias);
    CHECK(fabs(error.variance - variance) <= 1e-13 * variance, "%s: variance %.17g, should be %.17g", what,
          error.variance, variance);
    CHECK(fabs(error.mse - mse) <= 1e-13 * mse, "%s: mse %.17g, should be %.17g", what, error.mse, mse);
}

static void run_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, atof(field[0]), 0, 0);
    metro_run_error error = { -1, -1, -1 };
    double seed = atof(field[3]);
    char what[96];
    CHECK(fields == 7, "%d fields", fields);
    CHECK(metro_startup_run_error(&k, (uint64_t)atol(field[2]), (uint64_t)atol(field[1]), table_cosine, table_sine, 3,
                                  &seed, NULL, field[3][0] == 'U' ? 0 : 1, &error) == METRO_OK,
          "refused");
    snprintf(what, sizeof what, "Delta %s, M %s, b %s, seed %s", field[0], field[1], field[2], field[3]);
    check_run_error(what, error, field + 4);
}

static void run_kernel_row(char **field, int fields)
{
    static const char *const name[6] = { "uniform", "triangle", "gaussian", "cauchy", "vonmises", "kelemen" };
    static const metro_shape shape[6] = { METRO_UNIFORM, METRO_TRIANGLE,  METRO_GAUSSIAN,
                                          METRO_CAUCHY,  METRO_VON_MISES, METRO_KELEMEN };
    static const double seeds[3] = { 0.1, 0.6, 0.35 }, alpha[3] = { 0.2, 0.5, 0.3 }, zero = 0, third = 0.3,
                        both[2] = { 1, 0.5 };
    metro_kernel k = kernel_make(METRO_UNIFORM, 1, 0, 0);
    metro_run_error error = { -1, -1, -1 };
    uint64_t burn = (uint64_t)atol(field[4]), steps = (uint64_t)atol(field[5]);
    metro_result result = METRO_ERROR_ARGUMENT;
    char what[128];
    int i;
    CHECK(fields == 10, "%d fields", fields);
    for (i = 0; i < 6; i++)
        if (strcmp(name[i], field[0]) == 0) k = kernel_make(shape[i], atof(field[2]), atof(field[1]), atof(field[3]));
    switch (field[6][0]) {
    case 'A':
        result = metro_startup_run_error(&k, burn, steps, table_cosine, table_sine, 3, &zero, NULL, 1, &error);
        break;
    case 'B':
        result = metro_startup_run_error(&k, burn, steps, table_cosine, table_sine, 3, &third, NULL, 1, &error);
        break;
    case 'C':
        result = metro_startup_run_error(&k, burn, steps, table_cosine, table_sine, 3, seeds, alpha, 3, &error);
        break;
    default: result = metro_startup_run_error(&k, burn, steps, both, NULL, 2, &zero, NULL, 1, &error); break;
    }
    CHECK(result == METRO_OK, "refused");
    snprintf(what, sizeof what, "%s %s, large %s, b %s, M %s, seeds %s", field[0], field[2], field[3], field[4],
             field[5], field[6]);
    check_run_error(what, error, field + 7);
}

static void run_tables(void)
{
    int rows = check_rows("mse_uniform.csv", run_row);
    CHECK(rows == 210, "%d rows of uniform kernels", rows);
    rows = check_rows("run_kernels.csv", run_kernel_row);
    CHECK(rows == 263, "%d rows of all kernels", rows);
}

/* The estimate simulated: its mean over repeats is off by the bias, and its mean squared error is the mse. Catches: a
   theory whose chain is not the one of chapter 3, a run that starts one step late. */
static void run_simulation(void)
{
    static const double seed[2] = { 0.2, 0.9 }, alpha[2] = { 0.7, 0.3 };
    metro_kernel k = kernel_make(METRO_TRIANGLE, 0.4, 0, 0.05);
    metro_moments mean = { 0, 0, 0, 0 }, square = mean, flat = mean;
    metro_run_error error = { 0, 0, 0 };
    metro_rng rng = metro_rng_make(52, 0);
    uint64_t r, repeats = check_count(60000, 3000);
    int i, start;
    for (r = 0; r < repeats; r++) {
        for (start = 0; start < 2; start++) {
            double x = start ? metro_rng_uniform(&rng) : metro_rng_uniform(&rng) < 0.7 ? seed[0] : seed[1], sum = 0;
            for (i = 0; i < 9; i++) {
                if (i >= 2) sum += cos(2 * CHECK_PI * x) + 0.5 * sin(4 * CHECK_PI * x) + 0.25 * cos(6 * CHECK_PI * x);
                x = metro_kernel_perturb(&k, x, &rng);
            }
            sum /= 7;
            if (start) metro_moments_add(&flat, sum * sum);
            else {
                metro_moments_add(&mean, sum);
                metro_moments_add(&square, sum * sum);
            }
        }
    }
    CHECK(metro_startup_run_error(&k, 2, 7, table_cosine, table_sine, 3, seed, alpha, 2, &error) == METRO_OK,
          "refused");
    CHECK_SIGMA(metro_moments_mean(&mean), error.bias, metro_moments_error(&mean));
    CHECK_SIGMA(metro_moments_mean(&square), error.mse, metro_moments_error(&square));
    CHECK(metro_startup_run_error(&k, 2, 7, table_cosine, table_sine, 3, NULL, NULL, 0, &error) == METRO_OK,
          "refused");
    CHECK(error.bias == 0, "a uniform start has bias %g", error.bias);
    CHECK_SIGMA(metro_moments_mean(&flat), error.mse, metro_moments_error(&flat));
}

/* What must hold whatever the numbers are. */
static void run_identities(void)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, 0.2, 0, 0);
    double seed[1000], weight[3] = { 0.3, 0.3, 0.4 }, same[3] = { 0.3, 0.3, 0.3 }, c[2], s[2], p;
    metro_run_error one = { 0, 0, 0 }, two = one, limit = one;
    int i;
    /* shifting seed and integrand together changes nothing */
    for (i = 0; i < 2; i++) {
        c[i] = cos(2 * CHECK_PI * (i + 1) * 0.3);
        s[i] = sin(2 * CHECK_PI * (i + 1) * 0.3);
    }
    seed[0] = 0.8;
    metro_startup_run_error(&k, 3, 50, c, s, 2, seed, NULL, 1, &one);
    c[0] = c[1] = 1;
    seed[0] = 0.5;
    metro_startup_run_error(&k, 3, 50, c, NULL, 2, seed, NULL, 1, &two);
    CHECK_NEAR(one.bias, two.bias, 1e-13);
    CHECK_NEAR(one.variance, two.variance, 1e-13);
    /* the same seed three times is one seed; NULL for a zero array */
    metro_startup_run_error(&k, 3, 50, table_cosine, table_sine, 3, same, weight, 3, &one);
    metro_startup_run_error(&k, 3, 50, table_cosine, table_sine, 3, same, NULL, 1, &two);
    CHECK_NEAR(one.bias, two.bias, 1e-13);
    CHECK_NEAR(one.variance, two.variance, 1e-13);
    c[0] = c[1] = 0;
    metro_startup_run_error(&k, 3, 50, c, table_sine, 2, same, NULL, 1, &one);
    metro_startup_run_error(&k, 3, 50, NULL, table_sine, 2, same, NULL, 1, &two);
    CHECK(one.bias == two.bias && one.variance == two.variance, "NULL is zero");
    /* equispaced seeds are as good as a uniform start while there are more of them than harmonics of f^2 */
    for (i = 0; i < 1000; i++) seed[i] = i / 1000.0;
    metro_startup_run_error(&k, 0, 10, table_cosine, table_sine, 3, seed, NULL, 1000, &one);
    metro_startup_run_error(&k, 0, 10, table_cosine, table_sine, 3, NULL, NULL, 0, &two);
    CHECK_CLOSE(one.bias, 0, 1e-15);
    CHECK_NEAR(one.variance, two.variance, 1e-13);
    /* one sample: the variance of f itself from a uniform start, none from a point */
    metro_startup_run_error(&k, 17, 1, table_cosine, table_sine, 3, NULL, NULL, 0, &one);
    CHECK_NEAR(one.variance, 0.5 * (1 + 0.25 + 0.0625), 1e-15);
    metro_startup_run_error(&k, 0, 1, table_cosine, table_sine, 3, seed + 200, NULL, 1, &one);
    CHECK(one.variance == 0, "one sample at the seed has variance %g", one.variance);
    CHECK_NEAR(one.bias, cos(0.4 * CHECK_PI) + 0.5 * sin(0.8 * CHECK_PI) + 0.25 * cos(1.2 * CHECK_PI), 1e-15);
    /* whole Delta: independent samples */
    k.size = 2;
    metro_startup_run_error(&k, 1, 12345, table_cosine, table_sine, 3, seed, NULL, 1, &one);
    CHECK_NEAR(one.variance, 0.65625 / 12345, 1e-13);
    CHECK(one.bias == 0, "bias %g of independent samples", one.bias);
    /* the limit of many steps, by eq 5.77 written out, and from a run of 10^9 */
    k.size = 0.2;
    metro_startup_run_error(&k, 4, 0, table_cosine, table_sine, 3, seed, NULL, 1, &limit);
    metro_startup_run_error(&k, 4, 1000000000, table_cosine, table_sine, 3, seed, NULL, 1, &one);
    p = metro_kernel_coefficient(&k, 1);
    one.variance *= 1e9;
    one.bias *= 1e9;
    CHECK_NEAR(one.variance, limit.variance, 1e-7);
    CHECK_NEAR(one.bias, limit.bias, 1e-12);
    CHECK(limit.mse == limit.variance, "the limit of M mse is that of M variance");
    c[0] = 1;
    metro_startup_run_error(&k, 4, 0, c, NULL, 1, seed, NULL, 1, &limit);
    CHECK_NEAR(limit.variance, 0.5 * (1 + p) / (1 - p), 1e-14);
    CHECK_NEAR(limit.bias, pow(p, 4) / (1 - p), 1e-14);
    metro_startup_run_error(&k, 4, 0, c, NULL, 1, NULL, NULL, 0, &limit);
    CHECK_NEAR(limit.variance, 0.5 * (1 + p) / (1 - p), 1e-14);
    CHECK(limit.bias == 0, "bias %g", limit.bias);
    /* no harmonics, no error; the longest runs end at once */
    metro_startup_run_error(&k, 4, 9, NULL, NULL, 0, seed, NULL, 1, &one);
    CHECK(one.bias == 0 && one.variance == 0 && one.mse == 0, "a constant");
    metro_startup_run_error(&k, UINT64_C(18446744073709551615), UINT64_C(18446744073709551615), c, NULL, 1, seed,
                            NULL, 1, &one);
    CHECK_NEAR(one.variance * 18446744073709551615.0, 0.5 * (1 + p) / (1 - p), 1e-12);
    CHECK(one.bias == 0, "bias %g after 2^64 steps", one.bias);
}

/* Against the double sum over steps and modes, written out: all shapes, sizes wide enough for a plain sum. */
static void run_sums(void)
{
    static const metro_shape shape[6] = { METRO_UNIFORM, METRO_TRIANGLE,  METRO_GAUSSIAN,
                                          METRO_CAUCHY,  METRO_VON_MISES, METRO_KELEMEN };
    static const double size[6] = { 0.7, 1.1, 0.15, 0.1, 5, 0.6 };
    int shape_index, burn, i, j, k, l;
    for (shape_index = 0; shape_index < 6; shape_index++) {
        for (burn = 0; burn < 3; burn += 2) {
            metro_kernel kernel = kernel_make(shape[shape_index], size[shape_index], 0.05, 0.1 * burn);
            double x = 0.17, bias = 0, mse = 0;
            metro_run_error error = { 0, 0, 0 };
            /* f = sum_k f_k e^{2 pi i k x}; E f(z_i) f(z_j) = sum f_k f_l A_{k+l} P_{k+l}^i P_l^{j-i} */
            for (k = -3; k <= 3; k++) {
                for (i = burn; k > 0 && i < burn + 6; i++) {
                    double a = table_cosine[k - 1] * cos(2 * CHECK_PI * k * x) +
                               table_sine[k - 1] * sin(2 * CHECK_PI * k * x);
                    bias += a * pow(metro_kernel_coefficient(&kernel, k), i) / 6;
                }
                for (l = -3; l <= 3; l++) {
                    int m = k < 0 ? -k : k, n = l < 0 ? -l : l, q = k + l < 0 ? -k - l : k + l;
                    double re, im, cr, ci, dr, di, time = 0;
                    if (k == 0 || l == 0) continue;
                    cr = 0.5 * table_cosine[m - 1];
                    ci = (k > 0 ? -0.5 : 0.5) * table_sine[m - 1];
                    dr = 0.5 * table_cosine[n - 1];
                    di = (l > 0 ? -0.5 : 0.5) * table_sine[n - 1];
                    re = cr * dr - ci * di;
                    im = cr * di + ci * dr;
                    re = re * cos(2 * CHECK_PI * (k + l) * x) - im * sin(2 * CHECK_PI * (k + l) * x);
                    for (i = burn; i < burn + 6; i++)
                        for (j = i; j < burn + 6; j++)
                            time += (i < j ? 2 : 1) * pow(metro_kernel_coefficient(&kernel, q), i) *
                                    pow(metro_kernel_coefficient(&kernel, n), j - i);
                    mse += re * time / 36;
                }
            }
            CHECK(metro_startup_run_error(&kernel, (uint64_t)burn, 6, table_cosine, table_sine, 3, &x, NULL, 1,
                                          &error) == METRO_OK,
                  "refused");
            CHECK_CLOSE(error.bias, bias, 1e-14);
            CHECK_CLOSE(error.mse, mse, 1e-14);
            CHECK_CLOSE(error.variance, mse - bias * bias, 1e-14);
        }
    }
}

/* --- The best size ---------------------------------------------------------------------------------------------- */

static double best_limit(const double *cosine, size_t harmonics, double *ratio)
{
    metro_run_error error = { 0, 0, 0 };
    double size = -1, power = 0;
    size_t i;
    for (i = 0; i < harmonics; i++) power += 0.5 * cosine[i] * cosine[i];
    CHECK(metro_startup_best_size(METRO_UNIFORM, 0, 0, cosine, NULL, harmonics, NULL, NULL, 0, &size, &error) ==
              METRO_OK,
          "refused");
    *ratio = error.mse / power;
    return size;
}

/* Catches: a search that stops at the domain's size, or in the wrong lobe; the indicators' coefficients are 2 sin(pi
   k w)/(pi k). */
static void best_known(void)
{
    static const double three[3] = { 1, 0.5, 0.25 };
    static double indicator[2000];
    double ratio, size = best_limit(three, 1, &ratio);
    int i;
    CHECK_CLOSE(size, 1.4302966531242, 1e-7);
    /* (1 + P)/(1 - P) at the most negative sin(x)/x, which is cos(x) where tan(x) = x = 4.493409457909064 */
    CHECK_NEAR(ratio, (1 + cos(4.493409457909064)) / (1 - cos(4.493409457909064)), 1e-13);
    size = best_limit(three, 3, &ratio);
    CHECK_CLOSE(size, 1.552, 1e-3);
    CHECK_CLOSE(ratio, 0.7375, 1e-4);
    for (i = 1; i <= 2000; i++) indicator[i - 1] = 2 * sin(0.5 * CHECK_PI * i) / (CHECK_PI * i);
    size = best_limit(indicator, 2000, &ratio);
    CHECK_CLOSE(size, 1.399, 1e-3);
    CHECK_CLOSE(ratio, 0.720, 1e-3);
    for (i = 1; i <= 2000; i++) indicator[i - 1] = 2 * sin(0.05 * CHECK_PI * i) / (CHECK_PI * i);
    size = best_limit(indicator, 2000, &ratio);
    CHECK_CLOSE(size, 1.905, 1e-3);
    CHECK_CLOSE(ratio, 0.952, 1e-3);
}

/* No size of a fine sweep does better, for short and long runs, from a point and from seeds, for each shape. */
static void best_sweep(void)
{
    static const metro_shape shape[4] = { METRO_UNIFORM, METRO_TRIANGLE, METRO_GAUSSIAN, METRO_CAUCHY };
    static const double seed[2] = { 0.03, 0.41 };
    static const uint64_t steps[4] = { 2, 13, 400, 0 };
    int i, j, s, n;
    for (s = 0; s < 4; s++) {
        for (i = 0; i < 4; i++) {
            for (n = 0; n < 3; n++) {
                metro_run_error best = { 0, 0, 0 }, error = best, again = best;
                double size = -1;
                metro_kernel k = kernel_make(shape[s], 1, 0, 0);
                CHECK(metro_startup_best_size(shape[s], (uint64_t)n, steps[i], table_cosine, table_sine, 3, seed,
                                              NULL, (size_t)n, &size, &best) == METRO_OK,
                      "refused");
                CHECK(size >= 1 / 1024.0 && size <= 8, "size %g", size);
                k.size = size;
                metro_startup_run_error(&k, (uint64_t)n, steps[i], table_cosine, table_sine, 3, seed, NULL, (size_t)n,
                                        &again);
                CHECK(again.mse == best.mse && again.bias == best.bias && again.variance == best.variance,
                      "not its own error");
                for (j = 0; j < 300; j++) {
                    k.size = 0.001 * pow(8000, j / 299.0);
                    metro_startup_run_error(&k, (uint64_t)n, steps[i], table_cosine, table_sine, 3, seed, NULL,
                                            (size_t)n, &error);
                    CHECK(k.size < 1 / 1024.0 || error.mse >= best.mse * (1 - 1e-9),
                          "shape %d, M %g, %d seeds: size %g has mse %.12g, the chosen %g has %.12g", s,
                          (double)steps[i], n, k.size, error.mse, size, best.mse);
                }
            }
        }
    }
}

/* --- What is refused -------------------------------------------------------------------------------------------- */

static void refused(void)
{
    double nan = (double)NAN, seed[2] = { 0.1, 0.2 }, bad_seed[2], bad_weight[2] = { 0.5, 0.6 },
           good[2] = { 0.5, 0.5 }, c[2] = { 1, 2 };
    double bad_c[2], size = 77;
    metro_kernel k = kernel_make(METRO_UNIFORM, 0.3, 0, 0), none = kernel_make(METRO_UNIFORM, 0, 0, 0);
    metro_run_error error = { 7, 8, 9 };
    const metro_result argument = METRO_ERROR_ARGUMENT;
    bad_seed[0] = 0.1;
    bad_seed[1] = nan;
    bad_c[0] = 1;
    bad_c[1] = (double)INFINITY;
    CHECK(metro_startup_run_error(&none, 0, 3, c, NULL, 2, seed, NULL, 2, &error) == argument, "kernel");
    CHECK(metro_startup_run_error(&k, 0, 3, bad_c, NULL, 2, seed, NULL, 2, &error) == argument, "cosine");
    CHECK(metro_startup_run_error(&k, 0, 3, c, bad_c, 2, NULL, NULL, 0, &error) == argument, "sine");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, NULL, NULL, 2, &error) == argument, "no seeds");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, bad_seed, NULL, 2, &error) == argument, "seed NaN");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, seed, bad_weight, 2, &error) == argument,
          "weights of sum 1.1");
    bad_weight[0] = -0.5;
    bad_weight[1] = 1.5;
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, seed, bad_weight, 2, &error) == argument, "negative weight");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, seed, good, 2, NULL) == argument, "no place for the answer");
    CHECK(metro_startup_best_size(METRO_VON_MISES, 0, 3, c, NULL, 2, seed, NULL, 2, &size, &error) == argument,
          "von Mises");
    CHECK(metro_startup_best_size(METRO_KELEMEN, 0, 3, c, NULL, 2, seed, NULL, 2, &size, &error) == argument,
          "Kelemen");
    CHECK(metro_startup_best_size(METRO_UNIFORM, 0, 3, c, NULL, 2, seed, NULL, 2, NULL, &error) == argument,
          "no size");
    CHECK(metro_startup_best_size(METRO_UNIFORM, 0, 3, c, NULL, 2, seed, NULL, 2, &size, NULL) == argument,
          "no error");
    CHECK(metro_startup_best_size(METRO_UNIFORM, 0, 3, bad_c, NULL, 2, seed, NULL, 2, &size, &error) == argument,
          "cosine");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, (size_t)-1, seed, NULL, 2, &error) == METRO_ERROR_MEMORY,
          "overflow");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, (size_t)-1 / 32, NULL, NULL, 0, &error) == METRO_ERROR_MEMORY,
          "overflow");
    CHECK(error.bias == 7 && error.variance == 8 && error.mse == 9 && size == 77, "outputs touched");
    CHECK(metro_startup_run_error(&k, 0, 3, c, NULL, 2, seed, good, 2, &error) == METRO_OK && error.bias != 7,
          "accepted");
}

/* Every allocation fails once: a result, nothing lost, outputs untouched. */
static void memory(void)
{
    static const double c[2] = { 1, 2 }, seed[2] = { 0.1, 0.2 };
    metro_kernel k = kernel_make(METRO_UNIFORM, 0.3, 0, 0);
    metro_run_error error = { 7, 8, 9 };
    double size = 77;
    long at;
    for (at = 0; at < 10; at++) {
        metro_result result;
        allocations_left = at;
        result = metro_startup_run_error(&k, 0, 3, c, NULL, 2, seed, NULL, 2, &error);
        allocations_left = -1;
        CHECK(allocations_live == 0, "%ld allocations lost", allocations_live);
        if (result == METRO_OK) break;
        CHECK(result == METRO_ERROR_MEMORY && error.mse == 9, "result %d", (int)result);
    }
    CHECK(at == 2, "%ld allocations", at);
    error.mse = 9;
    for (at = 0; at < 10; at++) {
        metro_result result;
        allocations_left = at;
        result = metro_startup_best_size(METRO_UNIFORM, 0, 3, c, NULL, 2, seed, NULL, 2, &size, &error);
        allocations_left = -1;
        CHECK(allocations_live == 0, "%ld allocations lost", allocations_live);
        if (result == METRO_OK) break;
        CHECK(result == METRO_ERROR_MEMORY && error.mse == 9 && size == 77, "result %d", (int)result);
    }
    CHECK(at == 3, "%ld allocations", at);
}

/* ln E_2 of a cone by eq 5.62 term by term: Legendre's recurrence, and eq 3.17 for lambda_l. */
static double cone_two_steps(double half_angle)
{
    double c = cos(half_angle), before = 1, here = c, next, lambda;
    metro_sum sum = { 0, 0 };
    int l;
    for (l = 1; l <= 50000; l++) {
        next = ((2.0 * l + 1) * c * here - l * before) / (l + 1.0);
        lambda = (before - next) / ((2.0 * l + 1) * (1 - c));
        metro_sum_add(&sum, (2.0 * l + 1) * lambda * lambda * lambda * lambda);
        before = here;
        here = next;
    }
    return 0.5 * log(metro_sum_value(&sum));
}

/* Catches: a quadrature that is too coarse near the hemisphere; a concentration of negative zero that is not zero. */
static void wide_cones_and_negative_zero(void)
{
    metro_kernel k = kernel_make(METRO_VON_MISES, -0.0, 0, 0);
    double angle;
    for (angle = 0.9; angle < 1.57; angle += 0.01)
        CHECK_CLOSE(metro_cone_startup_log_error(angle, 2), cone_two_steps(angle), 1e-12);
    CHECK(metro_kernel_coefficient(&k, 2000000000) == 0, "kappa -0 on the circle");
    CHECK(metro_vmf_coefficient(-0.0, 2000000000) == 0, "kappa -0 on the sphere");
}

int main(void)
{
    CHECK_RUN(sphere_tables);
    CHECK_RUN(sphere_sums);
    CHECK_RUN(sphere_limits);
    CHECK_RUN(sphere_ends);
    CHECK_RUN(sphere_chain);
    CHECK_RUN(run_tables);
    CHECK_RUN(run_simulation);
    CHECK_RUN(run_identities);
    CHECK_RUN(run_sums);
    CHECK_RUN(best_known);
    CHECK_RUN(best_sweep);
    CHECK_RUN(refused);
    CHECK_RUN(memory);
    CHECK_RUN(wide_cones_and_negative_zero);
    return check_done("startup_more");
}
