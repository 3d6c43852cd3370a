/* Chapter 7, the part that runs chains: detailed balance, and the start-up error measured by ensembles. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "kernels.h"

typedef double function_of_x(double x);

static double call_importance(const double *z, void *sample, void *user)
{
    (void)sample;
    return ((function_of_x **)user)[0](z[0]);
}

static double flat(double x)
{
    (void)x;
    return 1;
}

static double nowhere(double x)
{
    (void)x;
    return 0;
}

static double peak(double x) { return .01 + exp(-(x - .5) * (x - .5) / (2 * .02 * .02)); }
static double huge_peak(double x) { return 1e290 * peak(x); }
static double slope(double x) { return .2 + x; }

static metro_balance balance_of(const metro_target *target,
                                void (*step)(const double *, double *, metro_rng *, void *), size_t cells)
{
    metro_balance balance;
    metro_result result;
    memset(&balance, 0, sizeof balance);
    result = metro_balance_check(target, step, check_count(400000, 100000), cells, metro_rng_make(5, 5), &balance);
    CHECK(result == METRO_OK, "%s", metro_result_text(result));
    return balance;
}

/* Catches: a check that complains of a correct chain, on any kind of axis, shape and target. */
static void balanced_chains_pass(void)
{
    metro_shape shapes[] = { METRO_UNIFORM, METRO_TRIANGLE, METRO_GAUSSIAN,
                             METRO_CAUCHY,  METRO_KELEMEN,  METRO_VON_MISES };
    function_of_x *functions[] = { flat, slope, peak, huge_peak };
    int s, f;
    for (s = 0; s < 6; s++)
        for (f = 0; f < 4; f++) {
            metro_axis axis = axis_of(s < 5 && f % 2 ? METRO_INTERVAL : METRO_CIRCLE, shapes[s], s == 5 ? 10 : .15);
            metro_target target = target_of(&axis, 1, call_importance, &functions[f]);
            metro_balance balance = balance_of(&target, NULL, 32);
            CHECK(balance.probability > 1e-6, "shape %d on function %d: chi-square %g of %g, probability %g", s, f,
                  balance.chi_square, balance.freedom, balance.probability);
        }
}

static double tilted(double x) { return 1.5 + x; }

static void balance_of_directions(void)
{
    metro_axis axes[2];
    function_of_x *function = tilted;
    metro_target target = target_of(axes, 2, call_importance, &function);
    metro_balance balance;
    axes[0] = axis_of(METRO_DIRECTION, METRO_UNIFORM, .5);
    axes[1] = axis_of(METRO_DIRECTION, METRO_VON_MISES, 8);
    balance = balance_of(&target, NULL, 16);
    CHECK(balance.probability > 1e-6, "chi-square %g of %g", balance.chi_square, balance.freedom);
}

/* The three classic mistakes, and one of a user's own mutation. Each must be found. */
static void clamp_to_border(const double *from, double *to, metro_rng *rng, void *user)
{
    double x = from[0] + .3 * (metro_rng_uniform(rng) - .5);
    (void)user;
    to[0] = x < 0 ? 0 : x < 1 ? x : 1 - 1e-16;
}

static void repeat_until_accepted(const double *from, double *to, metro_rng *rng, void *user)
{
    function_of_x *function = *(function_of_x **)user;
    do {
        to[0] = from[0] + .3 * (metro_rng_uniform(rng) - .5);
        to[0] -= floor(to[0]);
    } while (!(metro_rng_uniform(rng) < function(to[0]) / function(from[0])));
}

static double drift(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    to[0] = from[0] + .3 * (metro_rng_uniform(rng) - .4);
    to[0] -= floor(to[0]);
    return 1; /* forgets that the way back is rarer than the way there */
}

static double scaling(const double *from, double *to, double factor, double power)
{
    to[0] = from[0] * factor;
    return pow(factor, power);
}

/* x -> x * f with f = 2^u, u uniform in [-1, 1): T(from -> to) = 1/(to 2 ln 2), so the ratio is to/from. */
static double multiply(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    return scaling(from, to, pow(2, 2 * metro_rng_uniform(rng) - 1), 1);
}

static double multiply_upside_down(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    return scaling(from, to, pow(2, 2 * metro_rng_uniform(rng) - 1), -1);
}

static double inside(double x) { return x < 1 ? slope(x) : 0; }

static void expect_unbalanced(const char *what, const metro_target *target,
                              void (*step)(const double *, double *, metro_rng *, void *))
{
    metro_balance balance = balance_of(target, step, 16);
    CHECK(balance.probability < 1e-6, "%s passes: chi-square %g of %g", what, balance.chi_square, balance.freedom);
    CHECK(balance.excess > 0 && balance.excess <= 1 && balance.from != balance.to, "%s: excess %g", what,
          balance.excess);
}

static void planted_mistakes_are_found(void)
{
    metro_axis interval = axis_of(METRO_INTERVAL, METRO_UNIFORM, .3),
               circle = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    function_of_x *function = flat;
    metro_target target = target_of(&interval, 1, call_importance, &function);
    metro_balance balance;
    expect_unbalanced("clamping", &target, clamp_to_border);
    target = target_of(&circle, 1, call_importance, &function);
    function = slope;
    expect_unbalanced("repeating a rejected step", &target, repeat_until_accepted);
    target.propose = drift;
    expect_unbalanced("a drift without its ratio", &target, NULL);
    function = inside;
    target = target_of(&interval, 1, call_importance, &function);
    target.propose = multiply_upside_down;
    expect_unbalanced("a ratio upside down", &target, NULL);
    target.propose = multiply;
    balance = balance_of(&target, NULL, 16);
    CHECK(balance.probability > 1e-6, "the right ratio: chi-square %g of %g", balance.chi_square, balance.freedom);
}

/* A peak so narrow that uniform draws miss it, and a proposal that finds it every other time. */
static double needle(double x) { return x >= .3 && x < .3 + 1e-7 ? 1e7 + 1 : 1; }

static double propose_needle(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    *to = metro_rng_uniform(rng) < .5 ? metro_rng_uniform(rng) : .3 + 1e-7 * metro_rng_uniform(rng);
    return needle(*from) / needle(*to);
}

static void peaks_that_draws_miss(void)
{
    metro_axis axis = axis_of(METRO_INTERVAL, METRO_UNIFORM, .2);
    function_of_x *function = needle;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    metro_balance balance;
    target.propose = propose_needle;
    balance = balance_of(&target, NULL, 16);
    CHECK(balance.probability > 1e-6, "chi-square %g of %g", balance.chi_square, balance.freedom);
}

/* The probability of a score follows the score: over many seeds the probabilities of a correct chain are uniform. */
static void probabilities_are_uniform(void)
{
    metro_axis axis = axis_of(METRO_INTERVAL, METRO_UNIFORM, .2);
    function_of_x *function = slope;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    int i, n = (int)check_count(400, 40), low = 0;
    for (i = 0; i < n; i++) {
        metro_balance balance;
        CHECK(metro_balance_check(&target, NULL, 20000, 12, metro_rng_make(9, (uint64_t)i), &balance) == METRO_OK,
              "check");
        low += balance.probability < .25;
    }
    CHECK_SIGMA((double)low / n, .25, sqrt(.25 * .75 / n));
}

static void balance_refuses_nonsense(void)
{
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .2);
    function_of_x *function = nowhere;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    metro_balance balance;
    metro_rng rng = metro_rng_make(1, 1);
    CHECK(metro_balance_check(&target, NULL, 100, 16, rng, &balance) == METRO_ERROR_NO_IMPORTANCE, "dark");
    function = flat;
    CHECK(metro_balance_check(&target, NULL, 100, 1, rng, &balance) == METRO_ERROR_ARGUMENT, "one cell");
    CHECK(metro_balance_check(&target, NULL, 100, 257, rng, &balance) == METRO_ERROR_ARGUMENT, "257 cells");
    axis.kernel.size = 0;
    CHECK(metro_balance_check(&target, NULL, 100, 16, rng, &balance) == METRO_ERROR_ARGUMENT, "size 0");
}

/* E_n^2 over the harmonics up to K along each axis, from the spectra of the kernels and one or several seeds: paper
   (12) and the corrected (15) in the order of the definition, with nothing of chapter 5. */
static double truth_of(const metro_axis *axes, size_t count, const double *seed, const double *alpha, size_t seeds,
                       int K, uint64_t n, double large)
{
    double sum = 0;
    int k[5] = { 0 }, span[5], total = 1, mode;
    size_t a, s;
    for (a = 0; a < count; a++) total *= span[a] = axes[a].kind == METRO_CIRCLE ? 2 * K + 1 : K + 1;
    for (mode = 0; mode < total; mode++) {
        double decay = 1, re = 0, im = 0;
        int rest = mode, zero = 1;
        for (a = 0; a < count; a++) {
            k[a] = rest % span[a] - (axes[a].kind == METRO_CIRCLE ? K : 0);
            rest /= span[a];
            if (k[a] != 0) zero = 0;
            if (axes[a].kind == METRO_CIRCLE) decay *= metro_kernel_coefficient(&axes[a].kernel, k[a]);
            else decay *= metro_kernel_reflect_coefficient(&axes[a].kernel, k[a]);
        }
        if (zero) continue;
        for (s = 0; s < seeds; s++) {
            double angle = 0, factor = alpha != NULL ? alpha[s] : 1.0 / (double)seeds;
            for (a = 0; a < count; a++) {
                double x = seed[s * count + a];
                if (axes[a].kind == METRO_CIRCLE) angle += 2 * acos(-1.0) * k[a] * x;
                else if (k[a] > 0) factor *= sqrt(2.0) * cos(acos(-1.0) * k[a] * x);
            }
            re += factor * cos(angle);
            im += factor * sin(angle);
        }
        sum += pow(decay * (1 - large), 2.0 * (double)n) * (re * re + im * im);
    }
    return sum;
}

/* Catches: a wrong spectrum or a wrong chain, bins, a bias of the squared modulus (J groups and eq 7.17 remove it).
   */
static void expect_theory(const metro_axis *axes, size_t count, const double *seed, const double *alpha, size_t seeds,
                          int K, double large, double chains, int agree)
{
    static const uint64_t steps[4] = { 1, 2, 4, 9 };
    function_of_x *function = flat;
    metro_target target = target_of(axes, count, call_importance, &function);
    metro_chain_options options = { 0, 0 };
    metro_ensemble ensemble;
    metro_result result;
    double squared[4], error[4];
    int t, off = 0;
    memset(&ensemble, 0, sizeof ensemble);
    options.large_step = large;
    ensemble.target = &target;
    ensemble.options = &options;
    ensemble.seed = seed;
    ensemble.alpha = alpha;
    ensemble.seeds = seeds;
    ensemble.steps = steps;
    ensemble.times = 4;
    ensemble.chains = check_count(chains, 200);
    ensemble.harmonics = (size_t)K;
    ensemble.random_seed = 3;
    result = metro_ensemble_measure(&ensemble, squared, error);
    CHECK(result == METRO_OK, "%s", metro_result_text(result));
    for (t = 0; t < 4; t++) {
        double truth = truth_of(axes, count, seed, alpha, seeds, K, steps[t], large);
        if (agree) CHECK_SIGMA(squared[t], truth, error[t] + 1e-12);
        else off += fabs(squared[t] - truth) > 6 * error[t];
    }
    CHECK(agree || off > 0, "a planted mistake was not seen");
}

static void ensembles_meet_the_theory(void)
{
    static const double seed[10] = { .1, .3, .35, .6, .8, .2, .4, .7, .9, .5 }, alpha[3] = { .2, .3, .5 };
    metro_shape shapes[] = { METRO_UNIFORM, METRO_TRIANGLE, METRO_GAUSSIAN,
                             METRO_CAUCHY,  METRO_KELEMEN,  METRO_VON_MISES };
    double sizes[] = { .3, .5, .1, .03, .4, 4 };
    metro_axis axes[5];
    int s, i;
    for (s = 0; s < 6; s++) {
        axes[0] = axis_of(METRO_CIRCLE, shapes[s], sizes[s]);
        expect_theory(axes, 1, seed, NULL, 1, 40, 0, 40000, 1);
        expect_theory(axes, 1, seed, alpha, 3, 40, .1, 40000, 1);
        axes[0].kind = METRO_INTERVAL;
        if (s < 5) expect_theory(axes, 1, seed, alpha, 3, 40, 0, 40000, 1);
    }
    for (i = 0; i < 5; i++) axes[i] = axis_of(i % 3 == 2 ? METRO_INTERVAL : METRO_CIRCLE, shapes[i], sizes[i]);
    expect_theory(axes, 2, seed, alpha, 3, 8, .2, 20000, 1);
    expect_theory(axes, 3, seed, alpha, 3, 3, 0, 20000, 1);
    expect_theory(axes, 5, seed, NULL, 2, 2, 0, 4000, 1);
}

/* A chain that clamps, and a theory that takes Delta for the half-width, are both seen to be wrong. */
static double clamped(const double *from, double *to, metro_rng *rng, void *user)
{
    clamp_to_border(from, to, rng, user);
    return 1;
}

static void planted_mistakes_miss_the_theory(void)
{
    static const uint64_t steps[1] = { 4 };
    double seed = .1, squared, error, truth;
    metro_axis axis = axis_of(METRO_INTERVAL, METRO_UNIFORM, .3);
    function_of_x *function = flat;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    metro_ensemble ensemble;
    memset(&ensemble, 0, sizeof ensemble);
    target.propose = clamped;
    ensemble.target = &target;
    ensemble.seed = &seed;
    ensemble.seeds = 1;
    ensemble.steps = steps;
    ensemble.times = 1;
    ensemble.chains = check_count(40000, 4000);
    ensemble.harmonics = 30;
    truth = truth_of(&axis, 1, &seed, NULL, 1, 30, 4, 0);
    CHECK(metro_ensemble_measure(&ensemble, &squared, &error) == METRO_OK, "measure");
    CHECK(fabs(squared - truth) > 6 * error, "clamping is not seen: %g +- %g, truth %g", squared, error, truth);
    target.propose = NULL;
    CHECK(metro_ensemble_measure(&ensemble, &squared, &error) == METRO_OK, "measure");
    CHECK_SIGMA(squared, truth, error);
    axis.kernel.size = .6;
    truth = truth_of(&axis, 1, &seed, NULL, 1, 30, 4, 0);
    CHECK(fabs(squared - truth) > 6 * error, "half-width is not seen: %g +- %g, truth %g", squared, error, truth);
}

/* Catches: an error bar that is too small or too large. Over many ensembles the estimates must scatter as the mean of
   the stated variances says, where E_n is large and where it is zero. */
static void stated_errors_are_those_seen(void)
{
    static const uint64_t steps[2] = { 2, 200 };
    double seed = .1;
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    function_of_x *function = flat;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    metro_ensemble ensemble;
    metro_moments estimate[2] = { { 0, 0, 0, 0 }, { 0, 0, 0, 0 } };
    double variance[2] = { 0, 0 };
    int i, t, n = (int)check_count(400, 100);
    memset(&ensemble, 0, sizeof ensemble);
    ensemble.target = &target;
    ensemble.seed = &seed;
    ensemble.seeds = 1;
    ensemble.steps = steps;
    ensemble.times = 2;
    ensemble.chains = 320;
    ensemble.harmonics = 10;
    for (i = 0; i < n; i++) {
        double squared[2], error[2];
        ensemble.random_seed = (uint64_t)i;
        CHECK(metro_ensemble_measure(&ensemble, squared, error) == METRO_OK, "measure");
        for (t = 0; t < 2; t++) {
            metro_moments_add(&estimate[t], squared[t]);
            variance[t] += error[t] * error[t] / n;
        }
    }
    CHECK_SIGMA(metro_moments_mean(&estimate[1]), 0.0, metro_moments_error(&estimate[1]));
    for (t = 0; t < 2; t++) CHECK_SIGMA(variance[t] / metro_moments_variance(&estimate[t]), 1.0, 1.5 * sqrt(2.0 / n));
}

/* Catches: an answer that depends on the threads, nonsense that is taken. */
static void ensembles_are_repeatable_and_careful(void)
{
    static const uint64_t steps[2] = { 0, 3 }, backwards[2] = { 3, 0 };
    double seed[3] = { .1, 0, 0 }, one[2], two[2], error[2];
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    function_of_x *function = flat;
    metro_target target = target_of(&axis, 1, call_importance, &function);
    metro_ensemble ensemble;
    memset(&ensemble, 0, sizeof ensemble);
    ensemble.target = &target;
    ensemble.seed = seed;
    ensemble.seeds = 1;
    ensemble.steps = steps;
    ensemble.times = 2;
    ensemble.chains = 500;
    ensemble.harmonics = 10;
    ensemble.threads = 1;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_OK, "one thread");
    CHECK_NEAR(one[0], 20.0, 1e-12); /* at n = 0 each of 20 modes has modulus 1 */
    ensemble.threads = 3;
    CHECK(metro_ensemble_measure(&ensemble, two, error) == METRO_OK, "three threads");
    CHECK(one[0] == two[0] && one[1] == two[1], "another answer on three threads");
    ensemble.jobs = 3;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "3 jobs");
    ensemble.jobs = 0;
    ensemble.steps = backwards;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "steps backwards");
    ensemble.steps = steps;
    ensemble.harmonics = 0;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "no harmonics");
    ensemble.harmonics = SIZE_MAX / 2;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "too many harmonics");
    ensemble.harmonics = 10;
    ensemble.seeds = 0;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "no seeds");
    ensemble.seeds = 1;
    function = nowhere;
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_DARK_SEED, "dark seed");
    function = flat;
    axis = axis_of(METRO_DIRECTION, METRO_UNIFORM, .3);
    CHECK(metro_ensemble_measure(&ensemble, one, error) == METRO_ERROR_ARGUMENT, "a direction");
}

int main(void)
{
    CHECK_RUN(balanced_chains_pass);
    CHECK_RUN(balance_of_directions);
    CHECK_RUN(planted_mistakes_are_found);
    CHECK_RUN(peaks_that_draws_miss);
    CHECK_RUN(probabilities_are_uniform);
    CHECK_RUN(balance_refuses_nonsense);
    CHECK_RUN(ensembles_meet_the_theory);
    CHECK_RUN(planted_mistakes_miss_the_theory);
    CHECK_RUN(stated_errors_are_those_seen);
    CHECK_RUN(ensembles_are_repeatable_and_careful);
    return check_done("ensemble");
}
