/* test_perturbations.c - chapter 3: each kernel drawn, as a density and as a spectrum, held against each other and
   against exact values; wrapping, folding, the sphere; what is no kernel; the extremes. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "kernels.h"

#define CHECK_PI 3.14159265358979323846

static const char *const shape_name[6] = { "uniform", "triangle", "gaussian", "cauchy", "vonmises", "kelemen" };
static const metro_shape shape_value[6] = { METRO_UNIFORM, METRO_TRIANGLE,  METRO_GAUSSIAN,
                                            METRO_CAUCHY,  METRO_VON_MISES, METRO_KELEMEN };

/* Kernels of all six shapes: narrow, of the order of the domain, wider than it. */
static metro_kernel kernel_case(int i)
{
    static const double length[3] = { 0.06, 0.43, 2.7 }, kappa[3] = { 300.0, 4.0, 0.0 };
    metro_shape shape = shape_value[i / 3];
    double size = shape == METRO_VON_MISES ? kappa[i % 3] : length[i % 3];
    return kernel_make(shape, size, size / 10, 0);
}

#define KERNEL_CASES 18

static int kernel_parse(const char *name, const char *first, const char *second, metro_kernel *k)
{
    int i;
    for (i = 0; i < 6; i++) {
        if (strcmp(name, shape_name[i]) != 0) continue;
        *k = kernel_make(shape_value[i], i == 5 ? atof(second) : atof(first), atof(first), 0);
        return 1;
    }
    return 0;
}

/* --- Spectra against exact values ------------------------------------------------------------------------------- */

/* Catches: a sine of a rounded argument (zeros of the uniform kernel, whose binary sizes miss them by 5e-17), the
   difference of cosine integrals where it cancels, Bessel ratios from too near, the apex angle for the half angle. */
static void coefficient_row(char **field, int fields)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, 1, 0, 0);
    double value, truth = atof(field[4]), p = atof(field[1]);
    CHECK(fields == 5, "%d fields", fields);
    if (kernel_parse(field[0], field[1], field[2], &k)) value = metro_kernel_coefficient(&k, atol(field[3]));
    else if (strcmp(field[0], "vmf") == 0) value = metro_vmf_coefficient(p, atoi(field[3]));
    else value = metro_cone_coefficient(p, atoi(field[3]));
    if (strcmp(field[0], "cap_half_angle") == 0) {
        CHECK(fabs(value - truth) <= 2e-15, "cone %s, degree %s: %.17g, should be %.17g", field[1], field[3], value,
              truth);
        return;
    }
    CHECK(fabs(value - truth) <= (k.shape == METRO_KELEMEN ? 1e-12 : 1e-13) * fabs(truth) + 1e-307 &&
              fabs(value - truth) <= 4e-16,
          "%s %s %s, harmonic %s: %.17g, should be %.17g", field[0], field[1], field[2], field[3], value, truth);
}

static void coefficients(void)
{
    int rows = check_rows("coefficients.csv", coefficient_row);
    CHECK(rows == 228, "%d rows", rows);
}

/* Catches: 1 - P in place of the gap, a half-whole frequency rounded away. */
static void gap_row(char **field, int fields)
{
    metro_kernel k;
    double value, gap, v = atof(field[4]), g = atof(field[5]), f = atof(field[3]), store[64];
    size_t j = (size_t)f;
    CHECK(fields == 6, "%d fields", fields);
    if (kernel_parse(field[0], field[1], field[2], &k)) {
        metroi_kernel_mode(&k, f, &value, &gap);
        CHECK(fabs(value - v) <= 5e-16 && (k.shape == METRO_KELEMEN || fabs(value - v) <= 3e-13 * fabs(v)),
              "%s %s %s at %s: %.17g, should be %.17g", field[0], field[1], field[2], field[3], value, v);
        CHECK(fabs(gap - g) <= 4e-15 * g, "%s %s %s at %s: gap %.17g, should be %.17g", field[0], field[1], field[2],
              field[3], gap, g);
        if (f == floor(f)) CHECK_CLOSE(metro_kernel_coefficient(&k, -(long)f), v, 5e-16);
        if (k.shape != METRO_VON_MISES) CHECK_CLOSE(metro_kernel_reflect_coefficient(&k, (long)(2 * f)), v, 5e-16);
    } else {
        value = metro_vmf_coefficient(atof(field[1]), (int)f);
        CHECK(fabs(value - v) <= 3e-13 * v && fabs(value - v) <= 5e-16, "vmf %s, degree %s: %.17g, should be %.17g",
              field[1], field[3], value, v);
    }
    if (field[0][0] != 'v' || j > 64) return;
    /* the array of chapter 5 */
    if (field[0][1] == 'o') metroi_von_mises_logs(atof(field[1]), 60, store);
    else metroi_vmf_logs(atof(field[1]), 60, store);
    v = g < 0.5 ? log1p(-g) : log(v);
    CHECK(fabs(store[j - 1] - v) <= 1e-13 * fabs(v), "%s %s %s: ln P* is %.17g, should be %.17g", field[0], field[1],
          field[3], store[j - 1], v);
}

static void gaps(void)
{
    int rows = check_rows("kernel_gaps.csv", gap_row);
    CHECK(rows == 218, "%d rows", rows);
}

/* Catches: an argument reduced in one piece; the double 0.1 is 1/10 + 5.551115123125783e-18. */
static void exact_arguments(void)
{
    int i;
    for (i = -9; i <= 9; i++) {
        CHECK(metroi_sin_pi(i, 1.0) == 0 && metroi_cos_pi(i + 0.5, 1.0) == 0, "zero at %d", i);
        CHECK(metroi_cos_pi(i, 1.0) == (i % 2 ? -1 : 1) && metroi_sin_pi(i + 0.5, 1.0) == (i % 2 ? -1 : 1),
              "one at %d", i);
    }
    CHECK_NEAR(metroi_sin_pi(1e15, 0.1), sin(CHECK_PI * 5.551115123125783e-3), 1e-12);
    CHECK_NEAR(metroi_sin_pi(1e15 + 5, 0.1), cos(CHECK_PI * (1e15 + 5) * 5.551115123125783e-18), 1e-12);
    /* 2^53 times the double 0.1 is 900719925474099.25 */
    CHECK_NEAR(metroi_cos_pi(9007199254740992.0, 0.1), -sqrt(0.5), 1e-15);
    CHECK_NAN(metroi_sin_pi((double)NAN, 1));
    CHECK_NAN(metroi_cos_pi(1, (double)INFINITY));
    CHECK(metroi_cos_pi(1e300, 1e300) == 1, "a product that overflows is even");
}

/* Large steps, harmonic 0, evenness; the closed forms of the header's table; whole Delta is independent sampling. */
static void coefficient_forms(void)
{
    long h;
    int i;
    metro_kernel k, u;
    for (i = 0; i < KERNEL_CASES; i++) {
        metro_kernel plain = kernel_case(i);
        k = plain;
        k.large = 0.3;
        CHECK(metro_kernel_coefficient(&k, 0) == 1, "harmonic 0 of case %d", i);
        for (h = 1; h < 20; h++) {
            CHECK_NEAR(metro_kernel_coefficient(&k, h), 0.7 * metro_kernel_coefficient(&plain, h), 1e-15);
            CHECK(metro_kernel_coefficient(&k, -h) == metro_kernel_coefficient(&k, h), "case %d is not even", i);
        }
    }
    for (h = 1; h < 20; h++) {
        double x = (double)h * 0.43, v;
        k = kernel_make(METRO_TRIANGLE, 0.43, 0, 0);
        u = kernel_make(METRO_UNIFORM, 0.215, 0, 0);
        v = metro_kernel_coefficient(&u, h);
        CHECK_NEAR(metro_kernel_coefficient(&k, h), v * v, 1e-15);
        k = kernel_make(METRO_GAUSSIAN, 0.043, 0, 0);
        CHECK_NEAR(metro_kernel_coefficient(&k, h), exp(-2 * CHECK_PI * CHECK_PI * x * x * 0.01), 1e-13);
        k = kernel_make(METRO_CAUCHY, 0.43, 0, 0);
        CHECK_NEAR(metro_kernel_coefficient(&k, h), exp(-2 * CHECK_PI * x), 1e-13);
        for (i = 1; i <= 3; i++) {
            k = kernel_make(METRO_UNIFORM, i, 0, 0);
            CHECK(metro_kernel_coefficient(&k, h) == 0, "uniform %d is independent sampling", i);
        }
        CHECK(metro_cone_coefficient(4.0, (int)h) == 0 && metro_vmf_coefficient(0, (int)h) == 0,
              "uniform on the sphere");
    }
    CHECK(metro_cone_coefficient(0.3, 0) == 1 && metro_cone_coefficient(9.0, 0) == 1 &&
              metro_vmf_coefficient(7, 0) == 1,
          "degree 0");
}

/* --- Densities against spectra ---------------------------------------------------------------------------------- */

/* The integral of `density(y) cos(2 pi f y)` over [0, 1] in `panels` panels of 8 Gauss points between breakpoints. */
typedef struct {
    const metro_kernel *k;
    double from, frequency;
    int reflect;
} transform;

static double transform_integrand(const transform *t, double y)
{
    double density =
        t->reflect ? metro_kernel_reflect_density(t->k, t->from, y) : metro_kernel_density(t->k, t->from, y);
    return density * cos(2 * CHECK_PI * t->frequency * y);
}

static double transform_piece(const transform *t, double a, double b, int panels)
{
    static const double x[4] = { 0.18343464249564980494, 0.52553240991632898582, 0.79666647741362673959,
                                 0.96028985649753623168 };
    static const double w[4] = { 0.36268378337836198297, 0.31370664587788728734, 0.22238103445337447054,
                                 0.10122853629037625915 };
    double sum = 0, h = 0.5 * (b - a) / panels;
    int i, j;
    for (i = 0; i < panels; i++) {
        double middle = a + (2 * i + 1) * h;
        for (j = 0; j < 4; j++)
            sum += w[j] * h * (transform_integrand(t, middle - h * x[j]) + transform_integrand(t, middle + h * x[j]));
    }
    return sum;
}

static int transform_order(const void *a, const void *b)
{
    double x, y;
    memcpy(&x, a, sizeof x);
    memcpy(&y, b, sizeof y);
    return (x > y) - (x < y);
}

/* Breaks at the images of every place where a kernel is not smooth. */
static double transform_integral(const transform *t)
{
    double cut[64], offset[6], sum = 0;
    int cuts = 0, i, j;
    offset[0] = 0;
    offset[1] = 0.5 * t->k->size;
    offset[2] = t->k->size;
    offset[3] = t->k->size_min;
    offset[4] = 0.5;
    offset[5] = t->k->size * 0.25;
    for (i = 0; i < 6; i++) {
        for (j = -1; j <= 1; j += 2) {
            double y = t->from + j * offset[i];
            cut[cuts++] = t->reflect ? fabs(y - 2 * rint(y / 2)) : y - floor(y);
        }
    }
    cut[cuts++] = 0;
    cut[cuts++] = 1;
    qsort(cut, (size_t)cuts, sizeof cut[0], transform_order);
    for (i = 1; i < cuts; i++)
        if (cut[i] > cut[i - 1]) sum += transform_piece(t, cut[i - 1], cut[i], 30);
    return sum;
}

/* Catches: half the width for the full one, one image too few, a density that forgets the large steps. */
static void density_transform(void)
{
    static const double from[4] = { 0, 0.1, 0.5, 0.93 };
    transform t;
    int i, j, h;
    for (i = 0; i < KERNEL_CASES; i++) {
        metro_kernel k = kernel_case(i);
        k.large = i % 2 ? 0.25 : 0;
        t.k = &k;
        for (j = 0; j < 4; j++) {
            for (h = 0; h < 5; h++) {
                int c = h < 4 ? h : 17;
                t.from = from[j];
                t.frequency = c;
                t.reflect = 0;
                CHECK_CLOSE(transform_integral(&t), metro_kernel_coefficient(&k, c) * cos(2 * CHECK_PI * c * from[j]),
                            1e-9);
                if (k.shape == METRO_VON_MISES) continue;
                t.frequency = 0.5 * c;
                t.reflect = 1;
                CHECK_CLOSE(transform_integral(&t),
                            metro_kernel_reflect_coefficient(&k, c) * cos(CHECK_PI * c * from[j]), 1e-9);
            }
        }
    }
}

/* Wrapped densities against a sum over their images, many turns wide. */
static double line_density(const metro_kernel *k, double u)
{
    double s = k->size, a = fabs(u);
    switch (k->shape) {
    case METRO_UNIFORM: return a < s / 2 ? 1 / s : 0;
    case METRO_TRIANGLE: return a < s / 2 ? 2 / s * (1 - 2 * a / s) : 0;
    case METRO_GAUSSIAN: return exp(-0.5 * u * u / (s * s)) / (s * sqrt(2 * CHECK_PI));
    case METRO_CAUCHY: return s / (CHECK_PI * (s * s + u * u));
    case METRO_KELEMEN: return a >= k->size_min && a <= s ? 0.5 / (log(s / k->size_min) * a) : 0;
    case METRO_VON_MISES: break;
    }
    return 0;
}

static void density_images(void)
{
    static const double size[4] = { 0.2, 0.26, 1.9, 40.3 }, at[4] = { 0, 0.137, 0.41, 0.5 };
    int i, j, s;
    long m, reach;
    for (s = 0; s < 6; s++) {
        if (shape_value[s] == METRO_VON_MISES) continue;
        for (i = 0; i < 4; i++) {
            for (j = 0; j < 4; j++) {
                metro_kernel k = kernel_make(shape_value[s], size[i], size[i] / 7, 0);
                double sum = 0, bound = 1e-13;
                reach = s == 3 ? 200000 : 400;
                for (m = reach; m > 0; m--)
                    sum += line_density(&k, at[j] + (double)m) + line_density(&k, at[j] - (double)m);
                sum += line_density(&k, at[j]);
                /* the tail of a Cauchy kernel, midpoint rule: 2 gamma/(pi (reach + 1/2)) */
                if (s == 3) sum += 2 * size[i] / CHECK_PI / ((double)reach + 0.5);
                if (s == 3) bound = 1e-10;
                CHECK_CLOSE(metro_kernel_density(&k, 0.25, 0.25 + at[j]), sum, bound * (1 + sum));
                CHECK_CLOSE(metro_kernel_density(&k, 0.75 + at[j], 0.75), sum, bound * (1 + sum));
            }
        }
    }
    {
        /* a million turns of Kelemen's kernel: sums of 1/(m + d) by pairs, Euler-Maclaurin end */
        metro_kernel k = kernel_make(METRO_KELEMEN, 1000000.0, 0.3, 0);
        double sum = 0;
        for (m = 999999; m >= 0; m--) sum += 1 / ((double)m + 0.4) + 1 / ((double)m + 0.6);
        CHECK_NEAR(metro_kernel_density(&k, 0, 0.4), sum / (2 * log(1000000.0 / 0.3)), 1e-13);
    }
    {
        /* von Mises against its Fourier series and against exp(kappa cos) / I_0, I_0 by its power series */
        static const double kappa[4] = { 0, 0.5, 3, 12 };
        for (i = 0; i < 4; i++) {
            metro_kernel k = kernel_make(METRO_VON_MISES, kappa[i], 0, 0);
            double term = 1, bessel = 1;
            for (j = 1; j < 80; j++) bessel += term *= 0.25 * kappa[i] * kappa[i] / ((double)j * j);
            for (j = 0; j < 4; j++)
                CHECK_NEAR(metro_kernel_density(&k, 0.1, 0.1 + at[j]),
                           exp(kappa[i] * cos(2 * CHECK_PI * at[j])) / bessel, 1e-13);
        }
    }
}

/* At a jump the mean of both sides, also where several images meet; atoms. */
static void density_jumps(void)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, 0.25, 0, 0);
    CHECK(metro_kernel_density(&k, 0, 0.125) == 2 && metro_kernel_density(&k, 0.5, 0.375) == 2, "jump");
    CHECK(metro_kernel_density(&k, 0, 0.1249) == 4 && metro_kernel_density(&k, 0, 0.1251) == 0, "sides");
    CHECK(metro_kernel_density(&k, 0.9375, 0.0625) == 2, "jump across the seam");
    k.size = 1.5;
    CHECK_NEAR(metro_kernel_density(&k, 0, 0.25), 1.0, 1e-15);
    CHECK_NEAR(metro_kernel_density(&k, 0, 0.2), 1 / 1.5, 1e-15);
    CHECK_NEAR(metro_kernel_density(&k, 0, 0.3), 2 / 1.5, 1e-15);
    k.size = 3;
    CHECK(metro_kernel_density(&k, 0.1, 0.6) == 1 && metro_kernel_density(&k, 0.1, 0.7) == 1,
          "whole Delta is uniform");
    k.size = 0.25;
    CHECK(metro_kernel_reflect_density(&k, 0, 0) == 8 && metro_kernel_reflect_density(&k, 1, 0.9) == 8,
          "the end doubles");
    CHECK(metro_kernel_reflect_density(&k, 0.5, 0.625) == 2, "jump on the interval");
    CHECK(metro_kernel_reflect_density(&k, -0.5, 2.375) == metro_kernel_reflect_density(&k, 0.5, 0.375),
          "points are folded");
    k = kernel_make(METRO_KELEMEN, 0.25, 0.125, 0);
    CHECK_NEAR(metro_kernel_density(&k, 0, 0.125), 0.5 * 4 / log(2.0), 1e-15);
    CHECK_NEAR(metro_kernel_density(&k, 0.5, 0.25), 0.5 * 2 / log(2.0), 1e-15);
    k.size = 0.125;
    CHECK(isinf(metro_kernel_density(&k, 0, 0.125)) && isinf(metro_kernel_density(&k, 0, 0.875)), "atoms");
    CHECK(metro_kernel_density(&k, 0, 0.2) == 0, "between the atoms");
    k.large = 0.25;
    CHECK(metro_kernel_density(&k, 0, 0.2) == 0.25 && isinf(metro_kernel_density(&k, 0, 0.125)),
          "atoms and large steps");
    k.large = 1;
    CHECK(metro_kernel_density(&k, 0, 0.125) == 1 && metro_kernel_reflect_density(&k, 0, 0.3) == 1,
          "large steps alone");
}

/* Catches: a density that sees which point came first. */
static void density_symmetry(void)
{
    metro_rng rng = metro_rng_make(31, 0);
    int i, j;
    for (i = 0; i < KERNEL_CASES; i++) {
        metro_kernel k = kernel_case(i);
        for (j = 0; j < 500; j++) {
            double x = metro_rng_uniform(&rng),
                   y = j % 2 ? metro_rng_uniform(&rng) : x + 0.02 * metro_rng_uniform(&rng);
            CHECK(metro_kernel_density(&k, x, y) == metro_kernel_density(&k, y, x), "%s, %g to %g", shape_name[i / 3],
                  x, y);
            if (k.shape == METRO_VON_MISES) continue;
            CHECK(metro_kernel_reflect_density(&k, x, y) == metro_kernel_reflect_density(&k, y, x),
                  "%s, %g to %g reflecting", shape_name[i / 3], x, y);
        }
    }
    for (j = 0; j < 500; j++) {
        metro_vec3 a = metro_rng_direction(&rng), b = metro_rng_direction(&rng);
        CHECK(metro_cone_density(1.3, a, b) == metro_cone_density(1.3, b, a), "cone");
        CHECK(metro_vmf_density(5, a, b) == metro_vmf_density(5, b, a), "von Mises-Fisher");
    }
}

/* --- Draws against densities ------------------------------------------------------------------------------------ */

#define CELLS 48

/* Draws `k` from `x` into CELLS cells over [0, 1], or over a window around x when the kernel is narrow; the cell
   probabilities are integrals of the density. Each chi square raises a false alarm once in a million. */
static void draw_against_density(metro_kernel k, double x, int reflect, uint64_t stream)
{
    double count[CELLS], p[CELLS],
        window = reflect                      ? 1
                 : k.shape == METRO_VON_MISES ? (k.size > 100 ? 0.25 : 1)
                                              : 6 * k.size;
    double a, width, total = 0, mass = 0;
    uint64_t i, samples = check_count(200000, 5000);
    metro_rng rng = metro_rng_make(32, stream);
    char what[96];
    int c, j, points = 400;
    if (window > 1) window = 1;
    a = window < 1 ? x - window / 2 : 0;
    width = window / CELLS;
    for (c = 0; c < CELLS; c++) {
        count[c] = p[c] = 0;
        for (j = 0; j < points; j++) {
            double y = a + (c + (j + 0.5) / points) * width;
            p[c] += (reflect ? metro_kernel_reflect_density(&k, x, y) : metro_kernel_density(&k, x, y - floor(y))) *
                    width / points;
        }
        mass += p[c];
    }
    for (i = 0; i < samples; i++) {
        double y = reflect ? metro_kernel_reflect_perturb(&k, x, &rng) : metro_kernel_perturb(&k, x, &rng);
        CHECK(y >= 0 && y < 1, "%s: %.17g is outside", shape_name[k.shape], y);
        if (!(y >= 0 && y < 1)) return;
        c = (int)floor((window < 1 ? y - a - floor(y - a) : y - a) / width);
        if (c < CELLS) count[c]++;
        else total++;
    }
    snprintf(what, sizeof what, "%s %g large %g %s from %g", shape_name[k.shape], k.size, k.large,
             reflect ? "on the interval" : "on the circle", x);
    CHECK(mass <= 1 + 1e-3, "%s: the density integrates to %g", what, mass);
    /* what lies outside the window */
    CHECK(window < 1 || total == 0, "%s: %g draws outside", what, total);
    if (window < 1) CHECK_SIGMA(total, (double)samples * (1 - mass), sqrt((double)samples * fabs(1 - mass)) + 3);
    check_chi_square(what, count, p, CELLS, (double)samples);
}

/* Catches: a clamped border, a dropped wrap or fold, a Gaussian of the wrong width, a wrong kappa, a missing sign,
   one uniform for two, a large step that is taken with 1 - p. */
static void draws(void)
{
    int i;
    uint64_t stream = 0;
    for (i = 0; i < KERNEL_CASES; i++) {
        metro_kernel k = kernel_case(i);
        draw_against_density(k, 0.03, 0, stream++);
        if (k.shape != METRO_VON_MISES) draw_against_density(k, 0.96, 1, stream++);
        k.large = 0.3;
        draw_against_density(k, 0.98, 0, stream++);
        if (k.shape != METRO_VON_MISES) draw_against_density(k, 0.02, 1, stream++);
    }
    /* the extremes of the von Mises rejection, and steps of astronomically many turns */
    draw_against_density(kernel_make(METRO_VON_MISES, 1e-8, 0, 0), 0.5, 0, stream++);
    draw_against_density(kernel_make(METRO_VON_MISES, 1e-300, 0, 0), 0.5, 0, stream++);
    draw_against_density(kernel_make(METRO_UNIFORM, 1e5, 0, 0), 0.5, 0, stream++);
    draw_against_density(kernel_make(METRO_UNIFORM, 1.6e308, 0, 0), 0.5, 0, stream++);
    draw_against_density(kernel_make(METRO_GAUSSIAN, 1e300, 0, 0), 0.5, 1, stream++);
    draw_against_density(kernel_make(METRO_CAUCHY, 1e308, 0, 0), 0.5, 0, stream++);
    draw_against_density(kernel_make(METRO_KELEMEN, 1e18, 1e-3, 0), 0.5, 0, stream++);
}

/* The mean of cos(2 pi h step) is the coefficient: it sees the whole law at once, for sizes that no cell resolves. */
static void draw_against_spectrum(metro_kernel k, long h, uint64_t stream)
{
    metro_rng rng = metro_rng_make(33, stream);
    metro_moments m = { 0, 0, 0, 0 };
    uint64_t i, samples = check_count(100000, 5000);
    for (i = 0; i < samples; i++) {
        double y = metro_kernel_perturb(&k, 0, &rng);
        metro_moments_add(&m, cos(2 * CHECK_PI * (double)h * y));
    }
    CHECK_SIGMA(metro_moments_mean(&m), metro_kernel_coefficient(&k, h), metro_moments_error(&m));
}

static void draws_narrow(void)
{
    /* one of the coefficients away from 0 and 1 for each kernel */
    draw_against_spectrum(kernel_make(METRO_VON_MISES, 1e8, 0, 0), 10000, 0);
    draw_against_spectrum(kernel_make(METRO_VON_MISES, 1e10, 0, 0), 100000, 1);
    draw_against_spectrum(kernel_make(METRO_UNIFORM, 1e-6, 0, 0), 600000, 2);
    draw_against_spectrum(kernel_make(METRO_TRIANGLE, 1e-6, 0, 0), 800000, 3);
    draw_against_spectrum(kernel_make(METRO_GAUSSIAN, 1e-6, 0, 0), 200000, 4);
    draw_against_spectrum(kernel_make(METRO_CAUCHY, 1e-6, 0, 0), 100000, 5);
    draw_against_spectrum(kernel_make(METRO_KELEMEN, 1e-4, 1e-9, 0), 10000, 6);
    draw_against_spectrum(kernel_make(METRO_GAUSSIAN, 1e-6, 0, 0.2), 200000, 7);
    draw_against_spectrum(kernel_make(METRO_KELEMEN, 0.1000001, 0.1, 0.3), 4, 8);
}

/* The uniform kernel is the loop anyone would write, bit for bit, and takes one random number a step. */
static void uniform_by_hand(void)
{
    metro_kernel k = kernel_make(METRO_UNIFORM, 0.37, 0, 0);
    metro_rng one = metro_rng_make(34, 0), two = one;
    double x = 0.2, y = 0.2;
    int i;
    for (i = 0; i < 100000; i++) {
        x = metro_kernel_perturb(&k, x, &one);
        y += 0.37 * (metro_rng_uniform(&two) - 0.5);
        y -= floor(y);
        if (x != y) break;
    }
    CHECK(i == 100000, "step %d: %.17g, by hand %.17g", i, x, y);
    CHECK(memcmp(&one, &two, sizeof one) == 0, "the streams are out of step");
}

/* Catches: x + step = -1e-18, which plus 1 is 1; a fold that returns the end. */
static void borders(void)
{
    static const double at[4] = { 0, 1e-20, 0.99999999999999989, 1 }, size[3] = { 1e-18, 1e-16, 3e-16 };
    metro_rng rng = metro_rng_make(35, 0);
    int i, j, s, n;
    for (s = 0; s < 6; s++) {
        for (i = 0; i < 4; i++) {
            for (j = 0; j < 3; j++) {
                metro_kernel k = kernel_make(shape_value[s], size[j], size[j], 0);
                for (n = 0; n < 200; n++) {
                    double y = metro_kernel_perturb(&k, at[i], &rng);
                    CHECK(y >= 0 && y < 1, "%s: %.17g on the circle", shape_name[s], y);
                    if (k.shape == METRO_VON_MISES) continue;
                    y = metro_kernel_reflect_perturb(&k, at[i], &rng);
                    CHECK(y >= 0 && y < 1, "%s: %.17g on the interval", shape_name[s], y);
                }
            }
        }
    }
    {
        /* any finite point is taken modulo 1, or folded */
        metro_kernel k = kernel_make(METRO_GAUSSIAN, 1e-9, 0, 0);
        CHECK_CLOSE(metro_kernel_perturb(&k, 7.25, &rng), 0.25, 1e-7);
        CHECK_CLOSE(metro_kernel_perturb(&k, -0.25, &rng), 0.75, 1e-7);
        CHECK_CLOSE(metro_kernel_reflect_perturb(&k, 1.25, &rng), 0.75, 1e-7);
        CHECK_CLOSE(metro_kernel_reflect_perturb(&k, -0.25, &rng), 0.25, 1e-7);
    }
}

/* --- The sphere ------------------------------------------------------------------------------------------------- */

static const double axis[7][3] = { { 0, 0, 1 }, { 0, 0, -1 },  { 1, 0, 0 },        { 0, -1, 0 },
                                   { 1, 2, 3 }, { -3, 1, -2 }, { 1e-9, -1e-9, -1 } };

/* Azimuth of `to` around `from` in a frame of the test's own, in turns; then 1 - cos of the angle between them, which
   half the squared chord gives without loss. */
static double sphere_azimuth(metro_vec3 from, metro_vec3 to)
{
    metro_vec3 help = fabs(from.x) < 0.5 ? metro_vec3_make(1, 0, 0) : metro_vec3_make(0, 1, 0);
    metro_vec3 u = metro_normalize(metro_cross(from, help)), v = metro_cross(from, u);
    return atan2(metro_dot(to, u), metro_dot(to, v)) / (2 * CHECK_PI) + 0.5;
}

static double sphere_height(metro_vec3 from, metro_vec3 to)
{
    metro_vec3 d = metro_subtract(to, from);
    return 0.5 * metro_dot(d, d);
}

/* Draws from the cone of half angle `size`, or the von Mises-Fisher kernel of kappa = `size`; heights are mapped to a
   uniform number by the distribution function, so that cells of equal width have equal probability. */
static void sphere_draws(double size, int fisher, int a, uint64_t stream)
{
    double count[2][24] = { { 0 } }, p[24], height = size < CHECK_PI ? 2 * sin(size / 2) * sin(size / 2) : 2;
    metro_vec3 from = metro_normalize(metro_vec3_make(axis[a][0], axis[a][1], axis[a][2]));
    metro_rng rng = metro_rng_make(36, stream);
    uint64_t i, samples = check_count(100000, 5000);
    char what[96];
    int j;
    for (j = 0; j < 24; j++) p[j] = 1 / 24.0;
    for (i = 0; i < samples; i++) {
        metro_vec3 to = fisher ? metro_vmf_perturb(size, from, &rng) : metro_cone_perturb(size, from, &rng);
        double t = sphere_height(from, to), u = t / height, azimuth = sphere_azimuth(from, to);
        if (fisher) u = size > 0 ? expm1(-size * t) / expm1(-2 * size) : t / 2;
        /* rounding of the tip may carry it a little over the edge of a cone */
        CHECK(u <= 1 + 3e-16 / height + (fisher ? 1e-6 : 0) + 4e-8 * (size < 1e-7), "%g: height %.17g of %.17g", size,
              t, height);
        CHECK(fabs(metro_length(to) - 1) <= 5e-16, "length off by %g", metro_length(to) - 1);
        j = (int)floor(24 * u);
        count[0][j < 0 ? 0 : j > 23 ? 23 : j]++;
        j = (int)floor(24 * azimuth);
        count[1][j < 0 ? 0 : j > 23 ? 23 : j]++;
    }
    snprintf(what, sizeof what, "height of %s %g around axis %d", fisher ? "vmf" : "cone", size, a);
    check_chi_square(what, count[0], p, 24, (double)samples);
    snprintf(what, sizeof what, "azimuth of %s %g around axis %d", fisher ? "vmf" : "cone", size, a);
    check_chi_square(what, count[1], p, 24, (double)samples);
}

/* Catches: the apex angle in place of the half angle, uniform theta in place of uniform height, a frame that fails at
   a pole, kappa wrong by a factor, a cosine that has lost its digits at kappa = 1e8 or half angle 1e-8. */
static void sphere_laws(void)
{
    static const double angle[6] = { 1e-8, 1e-4, 0.05, 0.6, 2.5, 4.0 }, kappa[6] = { 0, 1e-8, 0.5, 20, 1e4, 1e8 };
    int i;
    for (i = 0; i < 6; i++) {
        sphere_draws(angle[i], 0, i, (uint64_t)i);
        sphere_draws(kappa[i], 1, i, (uint64_t)i + 10);
    }
    sphere_draws(0.3, 0, 6, 20);
    sphere_draws(7, 1, 6, 21);
}

/* Catches: a length that walks away from 1 by rounding, step after step. */
static void sphere_drift(void)
{
    metro_rng rng = metro_rng_make(40, 0);
    metro_vec3 d = metro_normalize(metro_vec3_make(1, 2, 3));
    int i;
    for (i = 0; i < 20000; i++) {
        d = i % 2 ? metro_cone_perturb(0.3, d, &rng) : metro_vmf_perturb(40, d, &rng);
        if (!(fabs(metro_length(d) - 1) <= 5e-16)) break;
    }
    CHECK(i == 20000, "after %d steps the length is off by %g", i, metro_length(d) - 1);
}

/* The mean of P_1 and P_2 of the cosine over draws is lambda_1, lambda_2; and the same from the density. */
static void sphere_spectrum(void)
{
    static const double angle[4] = { 0.05, 0.6, 2.0, 3.5 }, kappa[4] = { 0, 0.7, 20, 3000 };
    static const double x[4] = { 0.18343464249564980494, 0.52553240991632898582, 0.79666647741362673959,
                                 0.96028985649753623168 };
    static const double w[4] = { 0.36268378337836198297, 0.31370664587788728734, 0.22238103445337447054,
                                 0.10122853629037625915 };
    metro_vec3 from = metro_vec3_make(0, 0, 1);
    int i, fisher, degree, panel, j, side;
    for (i = 0; i < 4; i++) {
        for (fisher = 0; fisher < 2; fisher++) {
            double sum[13] = { 0 }, top = fisher ? (kappa[i] > 20 ? 40 / kappa[i] : 2) : 1 - cos(angle[i]);
            if (!fisher && angle[i] > CHECK_PI) top = 2;
            for (panel = 0; panel < 60; panel++) {
                for (j = 0; j < 8; j++) {
                    double h = top / 120, t = (2 * panel + 1) * h, before = 0, p = 1, next, density;
                    metro_vec3 to;
                    side = j % 2 ? 1 : -1;
                    t += side * h * x[j / 2];
                    to = metro_vec3_make(sqrt(t * (2 - t)), 0, 1 - t);
                    density = fisher ? metro_vmf_density(kappa[i], from, to) : metro_cone_density(angle[i], from, to);
                    for (degree = 0; degree <= 12; degree++) {
                        sum[degree] += 2 * CHECK_PI * w[j / 2] * h * density * p;
                        /* Bonnet's recurrence */
                        next = ((2 * degree + 1) * (1 - t) * p - degree * before) / (degree + 1);
                        before = p;
                        p = next;
                    }
                }
            }
            for (degree = 0; degree <= 12; degree++) {
                double truth =
                    fisher ? metro_vmf_coefficient(kappa[i], degree) : metro_cone_coefficient(angle[i], degree);
                CHECK_CLOSE(sum[degree], truth, 1e-12);
            }
        }
    }
    {
        metro_vec3 to = metro_vec3_make(sin(0.31), 0, cos(0.31));
        CHECK(metro_cone_density(0.3, from, to) == 0, "outside");
        CHECK_NEAR(metro_cone_density(0.32, from, to), 1 / (2 * CHECK_PI * (1 - cos(0.32))), 1e-14);
        CHECK_NEAR(metro_cone_density(5, from, metro_vec3_make(0, 0, -1)), 1 / (4 * CHECK_PI), 1e-15);
        CHECK_NEAR(metro_vmf_density(2, from, to), 2 / (4 * CHECK_PI * sinh(2.0)) * exp(2 * cos(0.31)), 1e-14);
        CHECK_NEAR(metro_vmf_density(1e8, from, metro_vec3_make(1e-4, 0, 1 - 5e-9)), 1e8 / (2 * CHECK_PI) * exp(-0.5),
                   1e-7);
        CHECK_NEAR(metro_vmf_density(0, from, to), 1 / (4 * CHECK_PI), 1e-15);
    }
    /* the ends of the range of cones */
    CHECK_NEAR(metro_cone_coefficient(1e-8, 1), 1.0, 1e-15);
    CHECK_NEAR(metro_cone_coefficient(CHECK_PI - 1e-6, 1), 0.25e-12, 1e-9);
    CHECK_NEAR(metro_cone_coefficient(CHECK_PI - 1e-6, 2), -0.25e-12, 1e-9);
}

/* --- What is no kernel, and the extremes ------------------------------------------------------------------------ */

static void check_no_kernel(metro_kernel k, const char *what)
{
    metro_rng rng = metro_rng_make(37, 0);
    CHECK(isnan(metro_kernel_coefficient(&k, 3)) && isnan(metro_kernel_coefficient(&k, 0)), "%s: coefficient", what);
    CHECK(isnan(metro_kernel_density(&k, 0.1, 0.2)), "%s: density", what);
    CHECK(isnan(metro_kernel_perturb(&k, 0.1, &rng)), "%s: perturb", what);
    CHECK(isnan(metro_kernel_reflect_coefficient(&k, 3)), "%s: coefficient on the interval", what);
    CHECK(isnan(metro_kernel_reflect_density(&k, 0.1, 0.2)), "%s: density on the interval", what);
    CHECK(isnan(metro_kernel_reflect_perturb(&k, 0.1, &rng)), "%s: perturb on the interval", what);
}

static void nonsense(void)
{
    double bad[4], nan = (double)NAN, inf = (double)INFINITY;
    metro_kernel k;
    metro_rng rng = metro_rng_make(38, 0);
    metro_vec3 z = metro_vec3_make(0, 0, 1), zero = metro_vec3_make(0, 0, 0), two = metro_vec3_make(0, 0, 2);
    int i, s;
    bad[0] = nan;
    bad[1] = inf;
    bad[2] = -1;
    bad[3] = 0;
    for (s = 0; s < 6; s++) {
        for (i = 0; i < 4; i++) {
            if (shape_value[s] == METRO_VON_MISES && i == 3) continue;
            check_no_kernel(kernel_make(shape_value[s], bad[i], 0.1, 0), "size");
            check_no_kernel(kernel_make(shape_value[s], bad[i], 0.1, 0.5), "size with large steps");
        }
        check_no_kernel(kernel_make(shape_value[s], 0.2, 0.1, nan), "large NaN");
        check_no_kernel(kernel_make(shape_value[s], 0.2, 0.1, -1e-9), "large below 0");
        check_no_kernel(kernel_make(shape_value[s], 0.2, 0.1, 1.0000001), "large above 1");
    }
    for (i = 0; i < 4; i++) check_no_kernel(kernel_make(METRO_KELEMEN, 0.2, bad[i], 0), "smallest step");
    check_no_kernel(kernel_make(METRO_KELEMEN, 0.2, 0.3, 0), "smallest step above the largest");
    /* von Mises has no reflecting twin */
    k = kernel_make(METRO_VON_MISES, 3, 0, 0);
    CHECK_NAN(metro_kernel_reflect_coefficient(&k, 1));
    CHECK_NAN(metro_kernel_reflect_density(&k, 0.1, 0.2));
    CHECK_NAN(metro_kernel_reflect_perturb(&k, 0.1, &rng));
    /* points that are none */
    for (s = 0; s < 6; s++) {
        k = kernel_make(shape_value[s], 0.2, 0.1, 0);
        for (i = 0; i < 2; i++) {
            CHECK(isnan(metro_kernel_density(&k, bad[i], 0.2)) && isnan(metro_kernel_density(&k, 0.2, bad[i])),
                  "density");
            CHECK(isnan(metro_kernel_reflect_density(&k, bad[i], 0.2)), "reflecting density");
            CHECK(isnan(metro_kernel_perturb(&k, bad[i], &rng)) &&
                      isnan(metro_kernel_reflect_perturb(&k, bad[i], &rng)),
                  "draw");
        }
    }
    for (i = 0; i < 4; i++) {
        CHECK_NAN(metro_cone_coefficient(bad[i], 2));
        CHECK_NAN(metro_cone_density(bad[i], z, z));
        CHECK_NAN(metro_cone_perturb(bad[i], z, &rng).x);
        if (i == 3) continue;
        CHECK_NAN(metro_vmf_coefficient(bad[i], 2));
        CHECK_NAN(metro_vmf_density(bad[i], z, z));
        CHECK_NAN(metro_vmf_perturb(bad[i], z, &rng).y);
    }
    CHECK_NAN(metro_cone_coefficient(1, -1));
    CHECK_NAN(metro_vmf_coefficient(1, -1));
    CHECK_NAN(metro_cone_perturb(1, zero, &rng).z);
    CHECK_NAN(metro_cone_perturb(1, two, &rng).z);
    CHECK_NAN(metro_vmf_perturb(1, zero, &rng).z);
    CHECK_NAN(metro_vmf_perturb(1, metro_vec3_make(nan, 0, 1), &rng).x);
    CHECK_NAN(metro_cone_density(1, metro_vec3_make(nan, 0, 1), z));
    CHECK_NAN(metro_vmf_density(1, z, metro_vec3_make(0, nan, 1)));
}

/* Sizes and harmonics at the ends of what a double and a long can hold: finite, bounded by 1, and quick. */
static void extremes(void)
{
    static const double size[6] = { 5e-324, 1e-300, 1e-30, 1e30, 1e300, 1.7e308 };
    static const long harmonic[6] = { 1, 2147483646, 2147483647, -2147483647, 1000003, 999 };
    metro_rng rng = metro_rng_make(39, 0);
    int i, j, s;
    for (s = 0; s < 6; s++) {
        for (i = 0; i < 6; i++) {
            metro_kernel k = kernel_make(shape_value[s], size[i], i == 3 ? 1e-30 : size[i], 0);
            double y;
            for (j = 0; j < 6; j++) {
                double c = metro_kernel_coefficient(&k, harmonic[j]);
                CHECK(fabs(c) <= 1, "%s %g at %ld: %g", shape_name[s], size[i], harmonic[j], c);
                if (s == 4) continue;
                c = metro_kernel_reflect_coefficient(&k, harmonic[j]);
                CHECK(fabs(c) <= 1, "%s %g at %ld on the interval: %g", shape_name[s], size[i], harmonic[j], c);
            }
            y = metro_kernel_density(&k, 0.25, 0.75);
            CHECK(y >= 0, "%s %g: density %g", shape_name[s], size[i], y);
            if (size[i] > 1 && (s < 4)) CHECK_NEAR(y, 1.0, 1e-9);
            y = metro_kernel_density(&k, 0.25, 0.25);
            CHECK(y >= 0, "%s %g: density %g at the point itself", shape_name[s], size[i], y);
            for (j = 0; j < 20; j++) {
                y = metro_kernel_perturb(&k, 0.5, &rng);
                CHECK(y >= 0 && y < 1, "%s %g: %g", shape_name[s], size[i], y);
                if (size[i] < 1 && s != 4 && s != 3) CHECK(y == 0.5, "%s %g: %.17g", shape_name[s], size[i], y);
            }
        }
    }
    CHECK_CLOSE(metro_vmf_coefficient(1e300, 1), 1.0, 1e-15);
    CHECK_CLOSE(metro_vmf_coefficient(1e300, 2147483647), 1.0, 1e-15);
    CHECK(metro_vmf_coefficient(1e-300, 2147483647) == 0 && metro_vmf_coefficient(5e-324, 1) >= 0, "tiny kappa");
    CHECK_CLOSE(metro_cone_coefficient(5e-324, 100), 1.0, 1e-15);
}

int main(void)
{
    CHECK_RUN(coefficients);
    CHECK_RUN(gaps);
    CHECK_RUN(exact_arguments);
    CHECK_RUN(coefficient_forms);
    CHECK_RUN(density_transform);
    CHECK_RUN(density_images);
    CHECK_RUN(density_jumps);
    CHECK_RUN(density_symmetry);
    CHECK_RUN(draws);
    CHECK_RUN(draws_narrow);
    CHECK_RUN(uniform_by_hand);
    CHECK_RUN(borders);
    CHECK_RUN(sphere_laws);
    CHECK_RUN(sphere_drift);
    CHECK_RUN(sphere_spectrum);
    CHECK_RUN(nonsense);
    CHECK_RUN(extremes);
    return check_done("perturbations");
}
