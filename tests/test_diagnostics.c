/* Chapter 7, diagnostics on arrays of draws: against the R package posterior, against closed forms and brute force,
   and on chains whose truth is known. tests/posterior.R made the data. */

#include <stddef.h>

static void *test_malloc(size_t size);
static void test_free(void *pointer);

#define METRO_MALLOC(size) test_malloc(size)
#define METRO_REALLOC(pointer, size) NULL /* the tests fail if diagnostics come to use it */
#define METRO_FREE(pointer) test_free(pointer)
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"

#define NOT_A_NUMBER ((double)NAN)
#define INFINITE ((double)INFINITY)

/* Allocations that succeed before one fails (negative: none fails), those that failed, and those not yet given
   back. */
static long malloc_left = -1, malloc_failed = 0, malloc_held = 0;

static void *test_malloc(size_t size)
{
    void *pointer = malloc_left == 0 ? NULL : malloc(size);
    if (malloc_left-- == 0) malloc_failed++;
    if (pointer != NULL) malloc_held++;
    return pointer;
}

static void test_free(void *pointer)
{
    if (pointer != NULL) malloc_held--;
    free(pointer);
}

enum { CASES = 32, MOST = 2000 };

/* A case of posterior.R: the draws, and what posterior says. */
typedef struct {
    char name[32];
    size_t chains, draws, read;
    double rhat, ess, ess_tail, ess_mean, mcse_mean, mcse_sd;
    double draw[MOST];
} posterior_case;

static posterior_case posterior_cases[CASES];
static size_t posterior_count;

static posterior_case *posterior_find(const char *name)
{
    size_t i;
    for (i = 0; i < posterior_count; i++)
        if (strcmp(posterior_cases[i].name, name) == 0) return &posterior_cases[i];
    CHECK(0, "there is no case %s in tests/data/posterior.csv", name);
    return &posterior_cases[0];
}

static void read_answers(char **field, int fields)
{
    posterior_case *c = &posterior_cases[posterior_count];
    CHECK(fields == 9 && posterior_count < CASES, "%d fields in case %d", fields, (int)posterior_count);
    if (fields != 9 || posterior_count >= CASES) return;
    posterior_count++;
    snprintf(c->name, sizeof c->name, "%s", field[0]);
    c->chains = (size_t)atol(field[1]);
    c->draws = (size_t)atol(field[2]);
    c->rhat = atof(field[3]);
    c->ess = atof(field[4]);
    c->ess_tail = atof(field[5]);
    c->ess_mean = atof(field[6]);
    c->mcse_mean = atof(field[7]);
    c->mcse_sd = atof(field[8]);
}

static void read_chains(char **field, int fields)
{
    posterior_case *c = posterior_find(field[0]);
    int i;
    for (i = 2; i < fields && c->read < MOST; i++) c->draw[c->read++] = atof(field[i]);
}

/* Both NaN, or equal to 1e-8: what is asked of the agreement. It is 1e-13 but for the offset of 1e8, where posterior
   rounds its means. */
static void same(const char *name, const char *what, double value, double truth)
{
    if (isnan(truth)) CHECK(isnan(value), "%s of %s is %.17g, should be NaN", what, name, value);
    else CHECK(fabs(value - truth) <= 1e-8 * fabs(truth), "%s of %s: %.17g, not %.17g", what, name, value, truth);
}

/* Catches: halves that keep the middle draw, a tau without the last even term or the monotone rule, ranks of ties in
   order of arrival, a quantile one place off, a variance over n, a fold about the mean, no cap for antithetic
   chains. */
static void posterior_agrees(void)
{
    size_t i;
    for (i = 0; i < posterior_count; i++) {
        posterior_case *c = &posterior_cases[i];
        size_t n = c->chains, d = c->draws;
        CHECK(c->read == n * d, "%s: %d draws of %d read", c->name, (int)c->read, (int)(n * d));
        /* Under four draws halves have one draw; posterior takes chains for draws (R drops a dimension): NaN here. */
        if (d < 4) c->rhat = c->ess = c->ess_tail = c->ess_mean = c->mcse_mean = c->mcse_sd = NOT_A_NUMBER;
        if (strncmp(c->name, "stuck", 5) == 0) {
            /* posterior: 1e15 for four, as a mean is rounded; NA for two, as they are equally far from the median. */
            CHECK(isinf(metro_rhat(c->draw, n, d)), "%s: R-hat %g", c->name, metro_rhat(c->draw, n, d));
        } else
            same(c->name, "metro_rhat", metro_rhat(c->draw, n, d), c->rhat);
        same(c->name, "metro_ess", metro_ess(c->draw, n, d), c->ess);
        same(c->name, "metro_ess_tail", metro_ess_tail(c->draw, n, d), c->ess_tail);
        same(c->name, "metro_ess_mean", metro_ess_mean(c->draw, n, d), c->ess_mean);
        same(c->name, "metro_mcse_mean", metro_mcse_mean(c->draw, n, d), c->mcse_mean);
        same(c->name, "metro_mcse_sd", metro_mcse_sd(c->draw, n, d), c->mcse_sd);
        same(c->name, "metro_autocorrelation_time", metro_autocorrelation_time(c->draw, n, d),
             (double)(2 * n * (d / 2)) / c->ess_mean);
    }
    CHECK(posterior_count >= 24, "%d cases", (int)posterior_count);
}

static void small_row(char **field, int fields)
{
    double draw[64];
    size_t chains = (size_t)atol(field[0]), draws = (size_t)atol(field[1]), i;
    char name[64];
    snprintf(name, sizeof name, "the row %s,%s,..,%s,%s,%s", field[0], field[1], field[8], field[9], field[10]);
    CHECK((size_t)fields == 8 + chains * draws, "%d fields", fields);
    for (i = 0; i < chains * draws && i < 64; i++) draw[i] = atof(field[8 + i]);
    same(name, "metro_rhat", metro_rhat(draw, chains, draws), atof(field[2]));
    same(name, "metro_ess", metro_ess(draw, chains, draws), atof(field[3]));
    same(name, "metro_ess_tail", metro_ess_tail(draw, chains, draws), atof(field[4]));
    same(name, "metro_ess_mean", metro_ess_mean(draw, chains, draws), atof(field[5]));
    same(name, "metro_mcse_mean", metro_mcse_mean(draw, chains, draws), atof(field[6]));
    same(name, "metro_mcse_sd", metro_mcse_sd(draw, chains, draws), atof(field[7]));
}

/* 120 short chains of small whole numbers: ties, few lags, every way out of the sum of pairs. Catches: a sum of pairs
   that runs one lag too far or stops one too early, tau = 2 left out. */
static void posterior_agrees_on_short_chains(void)
{
    int rows = check_rows("posterior_small.csv", small_row);
    CHECK(rows == 120, "%d rows", rows);
}

static void autocorrelation_row(char **field, int fields)
{
    const posterior_case *c = posterior_find(field[0]);
    double rho[10];
    int k;
    CHECK(fields == 11 && metro_autocorrelation(c->draw, c->draws, 10, rho) == METRO_OK, "%d fields", fields);
    for (k = 0; k < 10; k++) CHECK_CLOSE(rho[k], atof(field[k + 1]), 1e-8);
}

static metro_rng stream(uint64_t number) { return metro_rng_make(7, number); }

/* A stationary chain x' = rho x + noise of variance 1: its correlations are rho^k. */
static void ar1(double *draw, size_t chains, size_t draws, double rho, metro_rng *rng)
{
    size_t c, i;
    for (c = 0; c < chains; c++)
        for (i = 0; i < draws; i++)
            draw[c * draws + i] = i > 0 ? rho * draw[c * draws + i - 1] + sqrt(1 - rho * rho) * metro_rng_normal(rng)
                                        : metro_rng_normal(rng);
}

/* Against posterior, against eq 7.3 summed term by term for lengths around the powers of two, and closed forms.
   Catches: too little padding (ends that meet), division by n - k, a wrong bit reversal, a mean that is not taken
   off. */
static void autocorrelation(void)
{
    static const size_t lengths[] = { 2, 3, 4, 5, 7, 8, 9, 31, 32, 33, 64, 100, 257 };
    double draw[257], rho[257];
    metro_rng rng = stream(1);
    size_t l, i, k;
    CHECK(check_rows("posterior_autocorrelation.csv", autocorrelation_row) >= 10, "rows are missing");
    for (l = 0; l < sizeof lengths / sizeof *lengths; l++) {
        size_t n = lengths[l];
        double mean = 0;
        ar1(draw, 1, n, .8, &rng);
        for (i = 0; i < n; i++) mean += (draw[i] += 3) / (double)n;
        CHECK(metro_autocorrelation(draw, n, n, rho) == METRO_OK, "length %d", (int)n);
        for (k = 0; k < n; k++) {
            double covariance = 0, variance = 0;
            for (i = 0; i < n; i++) variance += (draw[i] - mean) * (draw[i] - mean);
            for (i = 0; i + k < n; i++) covariance += (draw[i] - mean) * (draw[i + k] - mean);
            CHECK_CLOSE(rho[k], covariance / variance, 1e-13);
        }
    }
    for (i = 0; i < 64; i++) draw[i] = i % 2 == 0 ? 1e300 : -1e300;
    metro_autocorrelation(draw, 64, 64, rho);
    for (k = 0; k < 64; k++) CHECK_CLOSE(rho[k], (k % 2 == 0 ? 1 : -1) * (1 - (double)k / 64), 1e-14);
}

static void autocorrelation_edges(void)
{
    double draw[4] = { 1, 1, 1, 1 }, rho[4] = { 5, 5, 5, 5 };
    CHECK(metro_autocorrelation(NULL, 4, 2, rho) == METRO_ERROR_ARGUMENT, "NULL draws");
    CHECK(metro_autocorrelation(draw, 4, 2, NULL) == METRO_ERROR_ARGUMENT, "NULL rho");
    CHECK(metro_autocorrelation(draw, 4, 0, rho) == METRO_ERROR_ARGUMENT, "no lags");
    CHECK(metro_autocorrelation(draw, 4, 5, rho) == METRO_ERROR_ARGUMENT, "more lags than draws");
    CHECK(metro_autocorrelation(draw, 0, 0, rho) == METRO_ERROR_ARGUMENT, "no draws");
    CHECK(rho[0] == 5 && rho[3] == 5, "outputs changed on failure");
    CHECK(metro_autocorrelation(draw, 4, 2, rho) == METRO_OK, "constant");
    CHECK_NAN(rho[0]);
    CHECK_NAN(rho[1]);
    CHECK(rho[2] == 5, "written beyond the lags");
    draw[2] = INFINITE;
    CHECK(metro_autocorrelation(draw, 4, 1, rho) == METRO_OK, "infinite");
    CHECK_NAN(rho[0]);
}

/* The inverse of the normal distribution against erfc, and published quantiles. Catches: a wrong digit in a
   coefficient. */
static void normal_inverse(void)
{
    double p;
    for (p = 2e-11; p < 1; p = p < .01 ? p * 1.25 : p + .0037) {
        double z = metroi_normal_inverse(p), back = 0.5 * erfc(-z / sqrt(2.0));
        CHECK_NEAR(back, p, 1e-15 * (2 + z * z)); /* z rounded to 1e-16 moves p by z^2 1e-16 */
        if (p > .01) CHECK_CLOSE(metroi_normal_inverse(1 - p), -z, 4e-15 * (1 + fabs(z) + 1 / (1 - p)));
    }
    CHECK_NEAR(metroi_normal_inverse(.975), 1.959963984540054, 4e-16);
    CHECK_NEAR(metroi_normal_inverse(.001), -3.090232306167813, 4e-16);
    CHECK_NEAR(metroi_normal_inverse(1e-9), -5.997807015007686, 4e-16);
    CHECK(metroi_normal_inverse(.5) == 0, "the median");
}

/* Eq 7.1 against the sum over all pairs of draws, against the closed form for rho^k, and the paper's own numbers.
   Catches: the printed (18), which gives -1/9 where 1/81 is right: no factor 1 - k/M; a sum that ends at M or at lags
   - 1. */
static void bernstein(void)
{
    double rho[64];
    size_t m, i, j, k;
    for (k = 0; k < 64; k++) rho[k] = k % 2 == 0 ? 1 : -1;
    CHECK_NEAR(metro_bernstein(rho, 64, 9), 1.0 / 81, 1e-14);
    CHECK_NEAR(metro_bernstein(rho, 9, 9), 1.0 / 81, 1e-14);
    CHECK_CLOSE(metro_bernstein(rho, 64, 10), 0, 1e-16);
    for (k = 0; k < 64; k++) rho[k] = pow(.7, (double)k);
    for (m = 1; m <= 20; m++) {
        double pairs = 0, r = .7, steps = (double)m;
        for (i = 0; i < m; i++)
            for (j = 0; j < m; j++) pairs += rho[i > j ? i - j : j - i];
        CHECK_NEAR(metro_bernstein(rho, 64, m), pairs / steps / steps, 1e-14);
        CHECK_NEAR(metro_bernstein(rho, 64, m) * steps,
                   (1 + r) / (1 - r) - 2 * r * (1 - pow(r, steps)) / (steps * (1 - r) * (1 - r)), 1e-13);
    }
    /* Many steps: tau / M, eq 7.2. Beyond the lags correlations count as 0. */
    CHECK_NEAR(metro_bernstein(rho, 64, UINT64_C(1) << 60) * ldexp(1, 60), 1.7 / .3, 1e-9);
    CHECK_NEAR(metro_bernstein(rho, 1, 1000), 1e-3, 1e-15);
    CHECK_NEAR(metro_bernstein(rho, 2, 1), 1, 0);
    for (k = 0; k < 64; k++) rho[k] = 3;
    CHECK_NEAR(metro_bernstein(rho, 64, 64), 3, 1e-15);
    CHECK_NAN(metro_bernstein(NULL, 4, 4));
    CHECK_NAN(metro_bernstein(rho, 0, 4));
    CHECK_NAN(metro_bernstein(rho, 4, 0));
    rho[1] = NOT_A_NUMBER;
    CHECK_NAN(metro_bernstein(rho, 4, 4));
}

/* tau of AR(1) chains is (1 + rho)/(1 - rho). The statistic is the mean of tau over runs of 4 chains; the bound is
   5.1 standard errors and a bias of 3 %, what cutting the sum and centring each half on its own mean can do. Catches:
   1 + sum for 1 + 2 sum (half of tau), pairs that overlap, correlations of chains averaged first (posterior_agrees
   catches the rest). */
static void time_of_ar1(void)
{
    static const double rhos[] = { .9, .5, 0, -.5 };
    enum { CHAINS = 4, DRAWS = 2000 };
    static double draw[CHAINS * DRAWS];
    uint64_t runs = check_count(150, 10), run;
    size_t r;
    for (r = 0; r < 4; r++) {
        double rho = rhos[r], truth = (1 + rho) / (1 - rho);
        metro_rng rng = stream(10 + r);
        metro_moments tau = { 0, 0, 0, 0 };
        for (run = 0; run < runs; run++) {
            ar1(draw, CHAINS, DRAWS, rho, &rng);
            metro_moments_add(&tau, metro_autocorrelation_time(draw, CHAINS, DRAWS));
        }
        CHECK_CLOSE(metro_moments_mean(&tau), truth, 5.1 * metro_moments_error(&tau) + .03 * truth);
    }
}

/* The error that MCSE promises is the error that the mean has: (mean - 0) / MCSE has variance 1. Over R runs the mean
   of its square is 1 within 5.1 sqrt(2/R) (normal), and 3 % for the bias of tau. The same for the standard deviation,
   whose truth is 1. Catches: an MCSE from the number of draws (variance 9), from one chain's share of them, sd for
   variance. */
static void mcse_is_the_error(void)
{
    enum { CHAINS = 4, DRAWS = 1000 };
    static double draw[CHAINS * DRAWS];
    uint64_t runs = check_count(400, 50), run;
    metro_rng rng = stream(20);
    double mean_squares = 0, sd_squares = 0;
    for (run = 0; run < runs; run++) {
        double sum = 0, squares = 0, mean, sd;
        size_t i;
        ar1(draw, CHAINS, DRAWS, .8, &rng);
        for (i = 0; i < CHAINS * DRAWS; i++) sum += draw[i];
        mean = sum / (CHAINS * DRAWS);
        for (i = 0; i < CHAINS * DRAWS; i++) squares += (draw[i] - mean) * (draw[i] - mean);
        sd = sqrt(squares / (CHAINS * DRAWS - 1));
        mean_squares += pow(mean / metro_mcse_mean(draw, CHAINS, DRAWS), 2);
        sd_squares += pow((sd - 1) / metro_mcse_sd(draw, CHAINS, DRAWS), 2);
    }
    CHECK_CLOSE(mean_squares / (double)runs, 1, 5.1 * sqrt(2 / (double)runs) + .03);
    CHECK_CLOSE(sd_squares / (double)runs, 1, 5.1 * sqrt(2 / (double)runs) + .03);
}

/* A sentence must contain `words`; NULL: no trouble is expected. */
static void trouble(const double *draw, size_t chains, size_t draws, const char *words)
{
    const char *said = metro_draws_trouble(draw, chains, draws);
    if (words == NULL) CHECK(said == NULL, "unexpected trouble: %s", said);
    else CHECK(said != NULL && strstr(said, words) != NULL, "'%s' should name '%s'", said != NULL ? said : "", words);
}

static void all_nan(const double *draw, size_t chains, size_t draws)
{
    CHECK_NAN(metro_autocorrelation_time(draw, chains, draws));
    CHECK_NAN(metro_ess(draw, chains, draws));
    CHECK_NAN(metro_ess_tail(draw, chains, draws));
    CHECK_NAN(metro_ess_mean(draw, chains, draws));
    CHECK_NAN(metro_mcse_mean(draw, chains, draws));
    CHECK_NAN(metro_mcse_sd(draw, chains, draws));
}

/* What cannot be said is NaN, and the reason is named. Catches: ESS = number of draws for a constant, R-hat 1 for it,
   a NaN that the sort loses among the ranks. */
static void what_cannot_be_said(void)
{
    static double draw[4000];
    metro_rng rng = stream(30);
    size_t i;
    ar1(draw, 4, 1000, 0, &rng);
    trouble(draw, 4, 1000, NULL);
    trouble(draw, 1, 4000, NULL);
    trouble(NULL, 4, 1000, "no draws");
    trouble(draw, 0, 1000, "no draws");
    trouble(draw, 4, 0, "no draws");
    all_nan(NULL, 4, 1000);
    all_nan(draw, 0, 1000);
    all_nan(draw, 4, 0);
    CHECK_NAN(metro_rhat(NULL, 4, 1000));
    CHECK_NAN(metro_rhat(draw, 0, 1000));
    CHECK_NAN(metro_rhat(draw, 4, 0));
    all_nan(draw, SIZE_MAX / 8, 1000); /* a size that no memory holds */
    /* One draw that is not finite. */
    for (i = 0; i < 3; i++) {
        double kept = draw[1234];
        draw[1234] = i == 0 ? NOT_A_NUMBER : i == 1 ? INFINITE : -INFINITE;
        trouble(draw, 4, 1000, "not finite");
        all_nan(draw, 4, 1000);
        CHECK_NAN(metro_rhat(draw, 4, 1000));
        draw[1234] = kept;
    }
    /* Too short: R-hat needs 4 draws, the rest 6. */
    for (i = 1; i < 6; i++) {
        all_nan(draw, 4, i);
        trouble(draw, 4, i, i < 4 ? "fewer than four" : "fewer than six");
        CHECK(isnan(metro_rhat(draw, 4, i)) == (i < 4), "R-hat of %d draws", (int)i);
    }
    /* Chains that stand still. */
    for (i = 0; i < 400; i++) draw[i] = 3.7;
    trouble(draw, 4, 100, "equal");
    all_nan(draw, 4, 100);
    CHECK_NAN(metro_rhat(draw, 4, 100));
    for (i = 0; i < 400; i++) draw[i] = (double)(i / 100) / 10;
    trouble(draw, 4, 100, "every chain stands still");
    CHECK(isinf(metro_rhat(draw, 4, 100)), "R-hat of four stuck chains is %g", metro_rhat(draw, 4, 100));
    CHECK(isinf(metro_rhat(draw, 2, 100)), "R-hat of two stuck chains is %g", metro_rhat(draw, 2, 100));
    ar1(draw, 3, 100, 0, &rng);
    trouble(draw, 4, 100, "a chain stands still");
    /* A chain that moves once, between its halves, and one whose middle draw alone differs: halves leave it out. */
    for (i = 0; i < 101; i++) draw[i] = i < 50 ? 1 : 2;
    CHECK(isinf(metro_rhat(draw, 1, 100)), "R-hat of a step is %g", metro_rhat(draw, 1, 100));
    trouble(draw, 1, 100, "R-hat is above");
    for (i = 0; i < 101; i++) draw[i] = i == 50 ? 1 : 2;
    CHECK_NAN(metro_rhat(draw, 1, 101));
    all_nan(draw, 1, 101);
    trouble(draw, 1, 101, "a middle one");
    /* Two values in equal number. */
    for (i = 0; i < 400; i++) draw[i] = (double)((i / 2) % 2);
    trouble(draw, 4, 100, "median");
    CHECK_NAN(metro_rhat(draw, 4, 100));
    CHECK_NAN(metro_mcse_sd(draw, 4, 100));
    CHECK(metro_ess(draw, 4, 100) > 0, "ESS of two values");
    for (i = 0; i < 400; i++) draw[i] = (double)((i / 2) % 2) / 10 - .05; /* equal distances but for rounding */
    CHECK_NAN(metro_mcse_sd(draw, 4, 100));
}

/* A chain of 500 draws with tau = 2000 must not be believed, with 4 x 200 tau it may. Catches: a rule that looks at
   the number of draws alone. */
static void short_windows(void)
{
    enum { LONG = 8000 };
    static double draw[4 * LONG];
    metro_rng rng = stream(31);
    ar1(draw, 1, 500, .999, &rng);
    trouble(draw, 1, 500, "50 autocorrelation times");
    ar1(draw, 4, 300, .9, &rng);
    trouble(draw, 4, 300, "50 autocorrelation times");
    ar1(draw, 4, LONG, .9, &rng);
    trouble(draw, 4, LONG, NULL);
}

/* Numbers times 2^900 and 2^-1000 give the same answers bit for bit; so does an offset of 1e8 that rounds nothing;
   ranks do not care for exp. Catches: squares that overflow, means taken at the offset, an absolute tolerance as in
   posterior, which takes draws of size 1e-17 for a constant. */
static void scales(void)
{
    enum { CHAINS = 4, DRAWS = 200, ALL = CHAINS * DRAWS };
    static double draw[ALL], other[ALL];
    static const int exponents[] = { 900, -1000, 1015, -56 };
    metro_rng rng = stream(32);
    double error;
    size_t i, e;
    ar1(draw, CHAINS, DRAWS, .5, &rng);
    for (i = 0; i < ALL; i++) draw[i] = floor(draw[i] * 65536) / 65536;
    for (e = 0; e < 4; e++) {
        for (i = 0; i < ALL; i++) other[i] = ldexp(draw[i], exponents[e]);
        CHECK_NEAR(metro_rhat(other, CHAINS, DRAWS), metro_rhat(draw, CHAINS, DRAWS), 0);
        CHECK_NEAR(metro_ess(other, CHAINS, DRAWS), metro_ess(draw, CHAINS, DRAWS), 0);
        CHECK_NEAR(metro_ess_tail(other, CHAINS, DRAWS), metro_ess_tail(draw, CHAINS, DRAWS), 0);
        CHECK_NEAR(metro_ess_mean(other, CHAINS, DRAWS), metro_ess_mean(draw, CHAINS, DRAWS), 0);
        error = ldexp(metro_mcse_mean(other, CHAINS, DRAWS), -exponents[e]);
        CHECK_NEAR(error, metro_mcse_mean(draw, CHAINS, DRAWS), 0);
        error = ldexp(metro_mcse_sd(other, CHAINS, DRAWS), -exponents[e]);
        CHECK_NEAR(error, metro_mcse_sd(draw, CHAINS, DRAWS), 0);
        trouble(other, CHAINS, DRAWS, metro_draws_trouble(draw, CHAINS, DRAWS));
    }
    for (i = 0; i < ALL; i++) other[i] = draw[i] + 1e8;
    CHECK_NEAR(metro_rhat(other, CHAINS, DRAWS), metro_rhat(draw, CHAINS, DRAWS), 0);
    CHECK_NEAR(metro_ess_mean(other, CHAINS, DRAWS), metro_ess_mean(draw, CHAINS, DRAWS), 1e-13);
    CHECK_NEAR(metro_mcse_mean(other, CHAINS, DRAWS), metro_mcse_mean(draw, CHAINS, DRAWS), 1e-13);
    CHECK_NEAR(metro_mcse_sd(other, CHAINS, DRAWS), metro_mcse_sd(draw, CHAINS, DRAWS), 1e-13);
    for (i = 0; i < ALL; i++) other[i] = exp(9 * draw[i]);
    CHECK_NEAR(metro_ess(other, CHAINS, DRAWS), metro_ess(draw, CHAINS, DRAWS), 0);
    CHECK_NEAR(metro_ess_tail(other, CHAINS, DRAWS), metro_ess_tail(draw, CHAINS, DRAWS), 0);
    /* The ends of the range of doubles. */
    for (i = 0; i < ALL; i++) other[i] = (i * 7 % 10 < 5 ? 1 : -1) * 1.7e308;
    CHECK(isfinite(metro_ess_mean(other, CHAINS, DRAWS)), "1.7e308");
    CHECK(isfinite(metro_mcse_mean(other, CHAINS, DRAWS)), "1.7e308");
    for (i = 0; i < ALL; i++) other[i] = (double)(i * 7 % 10) * 5e-324;
    CHECK(isfinite(metro_ess_mean(other, CHAINS, DRAWS)), "5e-324");
}

/* Catches: a difference that is not wrapped (.81 for .01), division by the number of draws, jumps from chain to
   chain. */
static void squared_jump(void)
{
    static const double far_apart[2] = { 1.7e308, -1.7e308 };
    const double turn[5] = { .85, .95, .05, .15, .25 }, walk[4] = { 0, 1, 1, 3 };
    double bad[2] = { 0, 0 };
    CHECK_NEAR(metro_squared_jump(turn, 5, 1), .01, 1e-13);
    CHECK_NEAR(metro_squared_jump(turn, 5, 0), (3 * .01 + .81) / 4, 1e-13);
    CHECK_NEAR(metro_squared_jump(walk, 4, 0), 5.0 / 3, 1e-15);
    CHECK_NEAR(metro_squared_jump(walk, 4, 2.5), (1 + .25) / 3, 1e-15);
    CHECK(metro_squared_jump(bad, 2, 1) == 0, "a stay");
    CHECK(metro_squared_jump(far_apart, 2, 1) <= .25, "%g round a circle", metro_squared_jump(far_apart, 2, 1));
    CHECK_NAN(metro_squared_jump(walk, 1, 0));
    CHECK_NAN(metro_squared_jump(walk, 0, 0));
    CHECK_NAN(metro_squared_jump(NULL, 4, 0));
    CHECK_NAN(metro_squared_jump(walk, 4, -1));
    CHECK_NAN(metro_squared_jump(walk, 4, NOT_A_NUMBER));
    CHECK_NAN(metro_squared_jump(walk, 4, INFINITE));
    bad[1] = INFINITE;
    CHECK_NAN(metro_squared_jump(bad, 2, 0));
    bad[1] = NOT_A_NUMBER;
    CHECK_NAN(metro_squared_jump(bad, 2, 1));
}

/* Eq 7.12 on AR(1): 2 (1 - rho). Independent increments of variance v = 2 (1 - rho) are correlated by little, so the
   error of the mean of their squares is below v sqrt(2 tau / n) with tau <= (1 + rho)/(1 - rho). */
static void squared_jump_is_first_correlation(void)
{
    enum { DRAWS = 100000 };
    static double draw[DRAWS];
    metro_rng rng = stream(33);
    size_t draws = (size_t)check_count(DRAWS, 2000);
    ar1(draw, 1, draws, .7, &rng);
    CHECK_SIGMA(metro_squared_jump(draw, draws, 0), .6, .6 * sqrt(2 * (1.7 / .3) / (double)draws));
}

enum { VALUES = 40, REPEATS = 12 };

/* A synthetic method: value v has the bias b cos v and the deviation .5 + v / VALUES; half of the noise is common to
   the values of a run, as it is in a picture. Returns the mean of the squared bias and of the variance. */
static void synthetic_runs(double b, metro_rng *rng, double *estimate, double *truth, double *bias2, double *variance)
{
    size_t r, v;
    *bias2 = *variance = 0;
    for (r = 0; r < REPEATS; r++) {
        double common = metro_rng_normal(rng);
        for (v = 0; v < VALUES; v++) {
            double noise = sqrt(.5) * (common + metro_rng_normal(rng)), deviation = .5 + (double)v / (double)VALUES;
            truth[v] = (double)v;
            estimate[r * VALUES + v] = truth[v] + b * cos((double)v) + deviation * noise;
            *bias2 += pow(b * cos((double)v), 2) / (double)(VALUES * REPEATS);
            *variance += deviation * deviation / (double)(VALUES * REPEATS);
        }
    }
}

/* Over many experiments each answer is right in the mean (5.1 standard errors), and its promised error is the real
   one: the mean of error^2 is the variance of the answers within 5.1 times the error of that quotient (about
   sqrt(2/n) for normal answers; they are heavier, so we allow 3/sqrt(n)); without bias it is 2 (R - 1)/(R - 2) times
   that for b^2, and with a bias like the noise in between. Catches: s^2/R not subtracted, a clip at zero, a variance
   over R, an error that takes the values for independent (12 times too small in variance). */
static void repeats_on_normals(void)
{
    static const double biases[] = { 0, .3, 3 };
    double estimate[REPEATS * VALUES], truth[VALUES], bias2 = 0, variance = 0;
    uint64_t n = check_count(3000, 300), i;
    size_t b;
    for (b = 0; b < 3; b++) {
        metro_moments bias_m = { 0, 0, 0, 0 }, variance_m = { 0, 0, 0, 0 }, mse_m = { 0, 0, 0, 0 };
        double bias_e = 0, variance_e = 0, mse_e = 0;
        double wide = b == 0 ? 2 * (double)(REPEATS - 1) / (double)(REPEATS - 2) : 1;
        double allowed = 5.1 * 3 / sqrt((double)n) + .06;
        metro_rng rng = stream(40 + b);
        for (i = 0; i < n; i++) {
            metro_bias_variance out;
            synthetic_runs(biases[b], &rng, estimate, truth, &bias2, &variance);
            CHECK(metro_repeats(estimate, truth, REPEATS, VALUES, &out) == METRO_OK, "experiment %d", (int)i);
            CHECK_CLOSE(out.bias2 + out.variance, out.mse, 1e-12 * (1 + out.mse));
            metro_moments_add(&bias_m, out.bias2);
            metro_moments_add(&variance_m, out.variance);
            metro_moments_add(&mse_m, out.mse);
            bias_e += out.bias2_error * out.bias2_error / (double)n;
            variance_e += out.variance_error * out.variance_error / (double)n;
            mse_e += out.mse_error * out.mse_error / (double)n;
        }
        CHECK_SIGMA(metro_moments_mean(&bias_m), bias2, metro_moments_error(&bias_m));
        CHECK_SIGMA(metro_moments_mean(&variance_m), variance, metro_moments_error(&variance_m));
        CHECK_SIGMA(metro_moments_mean(&mse_m), bias2 + variance, metro_moments_error(&mse_m));
        if (b != 1) CHECK_CLOSE(bias_e / metro_moments_variance(&bias_m), wide, wide * allowed);
        CHECK_CLOSE(variance_e / metro_moments_variance(&variance_m), 1, allowed);
        CHECK_CLOSE(mse_e / metro_moments_variance(&mse_m), 1, allowed);
    }
}

/* The jackknife by brute force: leave each run out, call again, eq 7.14. Catches: a slip in the algebra of leaving
   out. */
static void repeats_jackknife(void)
{
    double estimate[REPEATS * VALUES], truth[VALUES], fewer[REPEATS * VALUES], bias2, variance, theta[3][REPEATS];
    metro_rng rng = stream(50);
    metro_bias_variance all = { 0, 0, 0, 0, 0, 0 }, less = { 0, 0, 0, 0, 0, 0 };
    size_t r, k;
    synthetic_runs(.4, &rng, estimate, truth, &bias2, &variance);
    CHECK(metro_repeats(estimate, truth, REPEATS, VALUES, &all) == METRO_OK, "all");
    for (r = 0; r < REPEATS; r++) {
        memcpy(fewer, estimate, r * VALUES * sizeof *fewer);
        memcpy(fewer + r * VALUES, estimate + (r + 1) * VALUES, (REPEATS - 1 - r) * VALUES * sizeof *fewer);
        CHECK(metro_repeats(fewer, truth, REPEATS - 1, VALUES, &less) == METRO_OK, "without %d", (int)r);
        theta[0][r] = less.bias2;
        theta[1][r] = less.variance;
        theta[2][r] = less.mse;
    }
    for (k = 0; k < 3; k++) {
        double mean = 0, squares = 0, error = k == 0 ? all.bias2_error : k == 1 ? all.variance_error : all.mse_error;
        for (r = 0; r < REPEATS; r++) mean += theta[k][r] / (double)REPEATS;
        for (r = 0; r < REPEATS; r++) squares += (theta[k][r] - mean) * (theta[k][r] - mean);
        CHECK_NEAR(error, sqrt((double)(REPEATS - 1) / (double)REPEATS * squares), 1e-11);
    }
}

/* Draws at the end of the range have the R-hat of smaller ones. Catches: distances from the median that overflow. */
static void rhat_of_large_draws(void)
{
    double small[400], large[400];
    metro_rng rng = metro_rng_make(91, 0);
    size_t i;
    for (i = 0; i < 400; i++) {
        small[i] = .999 * metro_rng_uniform(&rng) * (i < 200 ? 1 : .8) * (metro_rng_uniform(&rng) < .3 ? 1 : -1);
        large[i] = ldexp(small[i], 1024);
    }
    CHECK(metro_rhat(large, 2, 200) == metro_rhat(small, 2, 200), "%.17g is not %.17g", metro_rhat(large, 2, 200),
          metro_rhat(small, 2, 200));
}

static void repeats_edges(void)
{
    const double estimate[4] = { 1, 2, 4, 8 }, truth[2] = { 1, 1 };
    double offset[3] = { 1e8 + 1, 1e8 + 2, 1e8 + 3 }, zero = 0;
    metro_bias_variance out = { 7, 7, 7, 7, 7, 7 };
    CHECK(metro_repeats(NULL, truth, 2, 2, &out) == METRO_ERROR_ARGUMENT, "NULL estimate");
    CHECK(metro_repeats(estimate, NULL, 2, 2, &out) == METRO_ERROR_ARGUMENT, "NULL truth");
    CHECK(metro_repeats(estimate, truth, 0, 2, &out) == METRO_ERROR_ARGUMENT, "no repeats");
    CHECK(metro_repeats(estimate, truth, 2, 0, &out) == METRO_ERROR_ARGUMENT, "no values");
    CHECK(metro_repeats(estimate, truth, 2, 2, NULL) == METRO_ERROR_ARGUMENT, "NULL out");
    CHECK(metro_repeats(estimate, truth, SIZE_MAX / 2, 2, &out) == METRO_ERROR_MEMORY, "repeats beyond memory");
    CHECK(out.bias2 == 7 && out.mse_error == 7, "out changed on failure");
    /* One run of two values (1, 2) with errors (0, 1). */
    CHECK(metro_repeats(estimate, truth, 1, 2, &out) == METRO_OK, "one repeat");
    CHECK_NEAR(out.mse, .5, 1e-15);
    CHECK_NAN(out.bias2);
    CHECK_NAN(out.variance);
    CHECK_NAN(out.mse_error);
    /* Two runs (1, 2) and (4, 8): means 2.5 and 5, variances 4.5 and 18, mean errors of the runs 1/2 and 29. */
    CHECK(metro_repeats(estimate, truth, 2, 2, &out) == METRO_OK, "two repeats");
    CHECK_NEAR(out.bias2, (2.25 - 2.25 + 16 - 9) / 2, 1e-14);
    CHECK_NEAR(out.variance, 11.25, 1e-15);
    CHECK_NEAR(out.mse, 14.75, 1e-15);
    CHECK_NEAR(out.mse_error, 14.25, 1e-14);
    CHECK_NAN(out.bias2_error);
    CHECK_NAN(out.variance_error);
    /* A bias of 1e8 does not drown the variance. */
    CHECK(metro_repeats(offset, &zero, 3, 1, &out) == METRO_OK, "offset");
    CHECK_NEAR(out.variance, 1, 1e-15);
    CHECK_NEAR(out.bias2, (1e8 + 2) * (1e8 + 2), 1e-15);
    offset[1] = NOT_A_NUMBER;
    CHECK(metro_repeats(offset, &zero, 3, 1, &out) == METRO_OK, "NaN");
    CHECK_NAN(out.bias2);
    CHECK_NAN(out.variance);
    CHECK_NAN(out.mse);
    CHECK_NAN(out.bias2_error);
}

/* Metropolis on the line with a uniform step of full width `size` and the importance e^{-x^2/2} about `island` and
   -island. Returns the acceptance rate. */
static double islands(double *draw, size_t draws, double start, double island, double size, metro_rng *rng)
{
    double x = start, accepted = 0;
    size_t i;
    for (i = 0; i < draws; i++) {
        double t = x + size * (metro_rng_uniform(rng) - .5);
        double here = exp(-.5 * (x - island) * (x - island)) + exp(-.5 * (x + island) * (x + island));
        double there = exp(-.5 * (t - island) * (t - island)) + exp(-.5 * (t + island) * (t + island));
        if (metro_rng_uniform(rng) * here < there) {
            x = t;
            accepted++;
        }
        draw[i] = x;
    }
    return accepted / (double)draws;
}

/* Lesson: chains that started on one of two islands agree perfectly, and half of the integral is missing. Dispersed
   chains say so, and averaging them first hides it again. */
static void islands_unseen(void)
{
    enum { DRAWS = 20000 };
    static double draw[4 * DRAWS], average[DRAWS];
    metro_rng rng = stream(60);
    size_t c, i;
    for (c = 0; c < 4; c++) islands(draw + c * DRAWS, DRAWS, 20, 20, 5, &rng);
    CHECK(metro_rhat(draw, 4, DRAWS) < 1.01, "R-hat on one island: %g", metro_rhat(draw, 4, DRAWS));
    CHECK(metro_ess(draw, 4, DRAWS) > 1000, "ESS on one island: %g", metro_ess(draw, 4, DRAWS));
    trouble(draw, 4, DRAWS, NULL);
    CHECK(metro_mcse_mean(draw, 4, DRAWS) < .1, "the true mean is 0, and the promised error %g about 20",
          metro_mcse_mean(draw, 4, DRAWS));
    for (c = 0; c < 4; c++) islands(draw + c * DRAWS, DRAWS, c < 2 ? 20 : -20, 20, 5, &rng);
    CHECK(metro_rhat(draw, 4, DRAWS) > 1.5, "R-hat on two islands: %g", metro_rhat(draw, 4, DRAWS));
    CHECK(metro_ess_mean(draw, 4, DRAWS) < 8, "ESS on two islands: %g", metro_ess_mean(draw, 4, DRAWS));
    trouble(draw, 4, DRAWS, "R-hat");
    /* tau of the average against tau of the chains: a factor above a hundred. */
    for (i = 0; i < DRAWS; i++)
        average[i] = (draw[i] + draw[DRAWS + i] + draw[2 * DRAWS + i] + draw[3 * DRAWS + i]) / 4;
    CHECK(metro_autocorrelation_time(draw, 4, DRAWS) > 100 * metro_autocorrelation_time(average, 1, DRAWS),
          "averaging hides: %g against %g", metro_autocorrelation_time(draw, 4, DRAWS),
          metro_autocorrelation_time(average, 1, DRAWS));
}

/* Lesson: on one peak of width 1, the size with the high acceptance rate is the bad one; tau and the squared jump
   know. */
static void acceptance_says_nothing(void)
{
    enum { DRAWS = 40000 };
    static double timid[DRAWS], bold[DRAWS];
    metro_rng rng = stream(61);
    double high = islands(timid, DRAWS, 0, 0, .5, &rng), low = islands(bold, DRAWS, 0, 0, 8, &rng);
    double tau_timid, tau_bold;
    CHECK(high > .9 && low < .5, "acceptance %g and %g", high, low);
    tau_timid = metro_autocorrelation_time(timid, 1, DRAWS);
    tau_bold = metro_autocorrelation_time(bold, 1, DRAWS);
    CHECK(tau_timid > 10 * tau_bold, "tau %g and %g", tau_timid, tau_bold);
    CHECK(metro_squared_jump(timid, DRAWS, 0) < .1 * metro_squared_jump(bold, DRAWS, 0), "squared jump %g and %g",
          metro_squared_jump(timid, DRAWS, 0), metro_squared_jump(bold, DRAWS, 0));
}

/* Calls what allocates with allocation number k failing. A failure must show, and only then. */
static double call_and_fail(int function, long k)
{
    const posterior_case *c = posterior_find("odd_number");
    malloc_left = k;
    malloc_failed = 0;
    switch (function) {
    case 0: return metro_rhat(c->draw, 3, 151);
    case 1: return metro_ess(c->draw, 3, 151);
    case 2: return metro_ess_tail(c->draw, 3, 151);
    case 3: return metro_ess_mean(c->draw, 3, 151);
    case 4: return metro_mcse_mean(c->draw, 3, 151);
    case 5: return metro_mcse_sd(c->draw, 3, 151);
    case 6: return metro_autocorrelation_time(c->draw, 3, 151);
    case 7: {
        const char *said = metro_draws_trouble(c->draw, 3, 151);
        return said != NULL && strstr(said, "memory") != NULL ? NOT_A_NUMBER : 1;
    }
    case 8: {
        double rho[3] = { 5, 5, 5 };
        metro_result result = metro_autocorrelation(c->draw, 151, 3, rho);
        return result == METRO_ERROR_MEMORY && rho[0] == 5 ? NOT_A_NUMBER : rho[0];
    }
    default: {
        metro_bias_variance out = { 7, 7, 7, 7, 7, 7 };
        metro_result result = metro_repeats(c->draw, c->draw, 3, 10, &out);
        return result == METRO_ERROR_MEMORY && out.mse == 7 ? NOT_A_NUMBER : out.mse;
    }
    }
}

/* Every allocation fails in its turn: NaN or METRO_ERROR_MEMORY, and nothing leaks. Catches: a value from unset
   memory, a leak. */
static void memory_runs_out(void)
{
    int function;
    for (function = 0; function < 10; function++) {
        long k = -1, failed = 1;
        while (failed && k < 100) {
            double value = call_and_fail(function, ++k);
            failed = malloc_failed;
            CHECK(isnan(value) == (failed > 0), "function %d gives %g, allocation %ld failing", function, value, k);
            CHECK(malloc_held == 0, "function %d holds %ld after failure of %ld", function, malloc_held, k);
        }
        CHECK(k > 0 && k < 100, "function %d: all succeeds from allocation %ld on", function, k);
    }
    malloc_left = -1;
}

int main(void)
{
    check_rows("posterior.csv", read_answers);
    check_rows("posterior_chains.csv", read_chains);
    CHECK_RUN(posterior_agrees);
    CHECK_RUN(posterior_agrees_on_short_chains);
    CHECK_RUN(autocorrelation);
    CHECK_RUN(autocorrelation_edges);
    CHECK_RUN(normal_inverse);
    CHECK_RUN(bernstein);
    CHECK_RUN(time_of_ar1);
    CHECK_RUN(mcse_is_the_error);
    CHECK_RUN(what_cannot_be_said);
    CHECK_RUN(short_windows);
    CHECK_RUN(scales);
    CHECK_RUN(squared_jump);
    CHECK_RUN(squared_jump_is_first_correlation);
    CHECK_RUN(repeats_on_normals);
    CHECK_RUN(repeats_jackknife);
    CHECK_RUN(rhat_of_large_draws);
    CHECK_RUN(repeats_edges);
    CHECK_RUN(islands_unseen);
    CHECK_RUN(acceptance_says_nothing);
    CHECK_RUN(memory_runs_out);
    return check_done("diagnostics");
}
