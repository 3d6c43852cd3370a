/* Chapter 4: the chain. */

#include <setjmp.h>

#include "memory.h"

static jmp_buf asserted;
#define METRO_ASSERT(condition) ((condition) ? (void)0 : longjmp(asserted, 1))
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "kernels.h"

/* What the targets of this file share: a function of x in [0, 1) and bins that collect weights. A sample is its x. */
typedef struct {
    double (*function)(double x);
    double bin[20], total, other;
    int bins, records;
} lab;

static double lab_importance(const double *z, void *sample, void *user)
{
    *(double *)sample = z[0];
    return ((const lab *)user)->function(z[0]);
}

static void lab_record(const void *sample, double weight, void *user)
{
    lab *l = (lab *)user;
    double x = *(const double *)sample;
    l->bin[(int)(x * l->bins)] += weight;
    l->total += weight;
    l->records++;
}

static double flat(double x)
{
    (void)x;
    return 1;
}

static double slope(double x) { return .2 + x; }             /* integral .7 */
static double half_dark(double x) { return x < .5 ? 1 : 0; } /* integral .5 */
static double nowhere(double x)
{
    (void)x;
    return 0;
}

static lab lab_of(double (*function)(double), int bins)
{
    lab l;
    memset(&l, 0, sizeof l);
    l.function = function;
    l.bins = bins;
    return l;
}

static metro_target lab_target(const metro_axis *axes, size_t count, lab *l)
{
    metro_target target = target_of(axes, count, lab_importance, l);
    target.sample_size = sizeof(double);
    target.record = lab_record;
    return target;
}

/* Catches: a random number more or less than the algorithm needs, a step on the wrong side of the border, >= for >.
   */
static void chain_equals_a_loop_written_by_hand(void)
{
    lab l = lab_of(slope, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    metro_target target = lab_target(&axis, 1, &l);
    metro_rng rng = metro_rng_make(1, 2);
    metro_chain chain;
    double seed = .25, x = .25, bin[10] = { 0 };
    int i, steps = 20000;
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    metro_chain_run(&chain, (uint64_t)steps);
    for (i = 0; i < steps; i++) {
        double t = x + .3 * (metro_rng_uniform(&rng) - .5), a;
        t -= floor(t);
        a = slope(t) / slope(x);
        if (a >= 1 || metro_rng_uniform(&rng) < a) x = t;
        bin[(int)(x * 10)] += 1;
    }
    CHECK(chain.state[0] == x, "%.17g and %.17g", chain.state[0], x);
    for (i = 0; i < 10; i++) CHECK(l.bin[i] == bin[i], "bin %d: %g and %g", i, l.bin[i], bin[i]);
    metro_chain_free(&chain);
}

/* The mean of each bin over independent chains against the truth; catches any wrong stationary density. */
static void expect_bins(metro_target *target, const metro_chain_options *options, lab *l, const double *truth,
                        double chains)
{
    uint64_t n = check_count(chains, 30), c;
    metro_moments bin[20];
    double seed[8] = { .3, .3, .3, .3, .3, .3, .3, .3 };
    int i;
    memset(bin, 0, sizeof bin);
    for (c = 0; c < n; c++) {
        metro_chain chain;
        CHECK(metro_chain_make(target, options, metro_rng_make(11, c), &chain) == METRO_OK, "make");
        CHECK(metro_chain_start_point(&chain, seed) == METRO_OK, "start");
        metro_chain_burn(&chain, 200);
        memset(l->bin, 0, sizeof l->bin);
        l->total = 0;
        metro_chain_run(&chain, 500);
        CHECK_NEAR(l->total, 500.0, 1e-12);
        for (i = 0; i < l->bins; i++) metro_moments_add(&bin[i], l->bin[i] / 500);
        metro_chain_free(&chain);
    }
    for (i = 0; i < l->bins; i++) CHECK_SIGMA(metro_moments_mean(&bin[i]), truth[i], metro_moments_error(&bin[i]));
}

/* Catches: a rejected step dropped, a ratio upside down, weights of expected values on the wrong sample. */
static void chain_keeps_the_target(void)
{
    double truth[4];
    metro_shape shapes[] = { METRO_UNIFORM, METRO_TRIANGLE, METRO_GAUSSIAN, METRO_CAUCHY, METRO_KELEMEN };
    metro_chain_options options = { 0, 0 };
    int i, e;
    for (i = 0; i < 4; i++) truth[i] = (.05 + (2 * i + 1) / 32.0) / .7;
    for (i = 0; i < 5; i++)
        for (e = 0; e < 4; e++) {
            lab l = lab_of(slope, 4);
            metro_axis axis = axis_of(e & 1 ? METRO_INTERVAL : METRO_CIRCLE, shapes[i], .4);
            metro_target target = lab_target(&axis, 1, &l);
            options.expected_values = e & 1;
            options.large_step = e & 2 ? .2 : 0;
            expect_bins(&target, &options, &l, truth, 300);
        }
}

/* A ring of five states; the user's own transition goes right with .7 and left with .3. */
static double ring_target(double x)
{
    static const double p[5] = { .05, .1, .15, .2, .5 };
    return p[(int)(x * 5)];
}

static double ring_step(const double *from, double *to, metro_rng *rng, int upside_down)
{
    int right = metro_rng_uniform(rng) < .7;
    double x = (floor(from[0] * 5) + .5) / 5 + (right ? .2 : -.2);
    to[0] = x - floor(x);
    return (right ? .3 / .7 : .7 / .3) * (upside_down ? (right ? .49 / .09 : .09 / .49) : 1);
}

static double ring_propose(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    return ring_step(from, to, rng, 0);
}

static double ring_propose_upside_down(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    return ring_step(from, to, rng, 1);
}

/* Catches: T(t -> i)/T(i -> t) upside down, as in the paper's printed algorithm, which gives the second list. */
static void asymmetric_transitions_go_through_the_ratio(void)
{
    const double truth[5] = { .05, .1, .15, .2, .5 };
    lab l = lab_of(ring_target, 5);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .4);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed = .5;
    target.propose = ring_propose;
    expect_bins(&target, NULL, &l, truth, 400);

    /* The same test must be able to fail: upside down, half the time is not spent in the last state */
    target.propose = ring_propose_upside_down;
    memset(l.bin, 0, sizeof l.bin);
    l.total = 0;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(3, 3), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    metro_chain_run(&chain, check_count(200000, 5000));
    CHECK(fabs(l.bin[4] / l.total - .5) > .05, "upside down still gives %g", l.bin[4] / l.total);
    metro_chain_free(&chain);
}

/* Catches: acceptance below 1 on a flat target. */
static void flat_target_accepts_all(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 1.7);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed = 0;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    metro_chain_run(&chain, 10000);
    CHECK(chain.counts.accepted == 10000 && chain.counts.longest_stay == 0, "%g accepted",
          (double)chain.counts.accepted);
    metro_chain_free(&chain);
}

/* Catches: a jump counted when rejected, or the long way round the circle. */
static void squared_jump_is_exact(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axes[3];
    metro_target target = lab_target(axes, 1, &l);
    metro_chain chain;
    double seed[5] = { .97, .5, 0, 0, 1 }, n = (double)check_count(100000, 5000);
    target.record = NULL;
    axes[0] = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, seed) == METRO_OK, "start");
    metro_chain_run(&chain, (uint64_t)n);
    /* uniform on +-.15: mean square .09/12, fourth moment .3^4/80 */
    CHECK_SIGMA(metro_sum_value(&chain.counts.squared_jump) / n, .0075, sqrt((.0081 / 80 - .0075 * .0075) / n));
    metro_chain_free(&chain);
    /* A direction: inside a small cone the squared angle is uniform up to the square of the half-angle */
    axes[0] = axis_of(METRO_DIRECTION, METRO_UNIFORM, .01);
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, seed + 2) == METRO_OK, "start");
    metro_chain_run(&chain, (uint64_t)n);
    CHECK_SIGMA(metro_sum_value(&chain.counts.squared_jump) / n, .5e-4, 1e-4 / sqrt(12 * n));
    metro_chain_free(&chain);
}

static double wild(double x)
{
    if (x < .1) return (double)NAN;
    if (x < .2) return -1;
    if (x < .3) return (double)INFINITY;
    if (x < .4) return 0;
    return 1;
}

/* Catches: a NaN that is accepted, a bad value clamped into a good one, one kind counted as another. */
static void bad_importances_are_rejected_and_counted(void)
{
    lab l = lab_of(wild, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 1);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed = .5, n = (double)check_count(100000, 5000), s = sqrt(n * .1 * .9);
    int i;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    metro_chain_run(&chain, (uint64_t)n);
    CHECK_SIGMA((double)chain.counts.nan, .1 * n, s);
    CHECK_SIGMA((double)chain.counts.negative, .1 * n, s);
    CHECK_SIGMA((double)chain.counts.infinite, .1 * n, s);
    CHECK_SIGMA((double)chain.counts.dark, .1 * n, s);
    CHECK_SIGMA((double)chain.counts.accepted, .6 * n, sqrt(n * .24));
    for (i = 0; i < 4; i++) CHECK(l.bin[i] == 0, "weight %g on values that are none", l.bin[i]);
    CHECK(l.total == n, "total weight %g", l.total);
    metro_chain_free(&chain);
}

/* Catches: a quotient that overflows before the ratio brings it back. */
static void acceptance_survives_huge_ratios(void)
{
    CHECK_NEAR(metroi_acceptance(1e300, 1e-300, 1e300 * 1e300), 1.0, 0); /* infinite ratio times 1e-600 */
    CHECK_NEAR(metroi_acceptance(1e-300, 1e300, 1), 1.0, 0);
    CHECK(metroi_acceptance(1e300, 1e-300, 1) == 0, "1e-600 is 0");
    CHECK_NEAR(metroi_acceptance(1e300, 1e-20, 1e308), 1e-12, 1e-10); /* 1e-320 is denormal */
    CHECK_NEAR(metroi_acceptance(1e-200, 1e200, 1e-300), 1.0, 0);
    CHECK_NEAR(metroi_acceptance(1e-150, 1e160, 2e-311), .2, 1e-10); /* 1e310 overflows */
    CHECK_NEAR(metroi_acceptance(4, 1, 2), .5, 1e-15);
    CHECK(metroi_acceptance(1, 0, 1) == 0 && metroi_acceptance(1, 1, 0) == 0, "zeros");
}

static double tiny_slope(double x) { return ldexp(slope(x), -990); }
static double huge_slope(double x) { return ldexp(slope(x), 1000); }

/* Catches: anything in the chain that depends on the scale of the importance, b and its error among them. */
static void scale_of_importance_does_not_matter(void)
{
    double (*functions[3])(double) = { slope, tiny_slope, huge_slope };
    double scale[3] = { 1, ldexp(1, -990), ldexp(1, 1000) }, state = 0;
    int i;
    for (i = 0; i < 3; i++) {
        lab l = lab_of(functions[i], 4);
        metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
        metro_target target = lab_target(&axis, 1, &l);
        metro_chain_options options = { .3, 1 };
        metro_chain chain;
        double error, b;
        CHECK(metro_chain_make(&target, &options, metro_rng_make(5, 6), &chain) == METRO_OK, "make");
        CHECK(metro_chain_start_weighted(&chain, 50) == METRO_OK, "start");
        CHECK_NEAR(chain.start_weight / scale[i], .7, .3);
        metro_chain_run(&chain, 20000);
        b = metro_chain_b(&chain, &error);
        CHECK_SIGMA(b / scale[i], .7, error / scale[i]);
        CHECK_NEAR(error / scale[i], sqrt(1 / 12.0 / (double)chain.normalisation.count), .05);
        if (i == 0) state = chain.state[0];
        CHECK(chain.state[0] == state, "another path at scale %g", scale[i]);
        metro_chain_free(&chain);
    }
}

/* Catches: a forced acceptance out of a dark seed, a division by its importance, a chain changed by a refused start.
   */
static void dark_and_bad_seeds_are_refused(void)
{
    lab l = lab_of(wild, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed[4] = { .5, .05, .15, .25 }, dark = .35, pair[2] = { .5, .35 };
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &dark) == METRO_ERROR_DARK_SEED, "dark");
    CHECK(metro_chain_step(&chain) == 0 && chain.weight == 0, "a chain that was not started moved");
    CHECK(metro_chain_start_point(&chain, seed) == METRO_OK, "good");
    CHECK(metro_chain_start_point(&chain, seed + 1) == METRO_ERROR_BAD_SEED, "NaN");
    CHECK(metro_chain_start_point(&chain, seed + 2) == METRO_ERROR_BAD_SEED, "negative");
    CHECK(metro_chain_start_point(&chain, seed + 3) == METRO_ERROR_BAD_SEED, "infinite");
    CHECK(chain.state[0] == .5 && chain.importance == 1, "a refused start moved the chain");
    CHECK(metro_chain_start_seeds(&chain, pair, NULL, 2) == METRO_ERROR_DARK_SEED, "one dark among two");
    metro_chain_free(&chain);
}

static double anywhere(const double *z, void *sample, void *user)
{
    (void)z;
    (void)sample;
    ++*(int *)user;
    return 1;
}

static double stay_there(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)rng;
    (void)user;
    to[0] = from[0];
    return 1;
}

/* Catches: a point outside the space that is taken or handed to the importance, an end of the interval or a direction
   in single precision that is refused, a space of the target's own that is looked at. */
static void seeds_outside_the_space_are_refused(void)
{
    const double wrong[9] = { -1e-9, 1, 1.5, -1, (double)NAN, (double)INFINITY, -(double)INFINITY, 3, 1e300 };
    int calls = 0, i;
    metro_axis axes[3], circle = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    metro_target target = target_of(axes, 3, anywhere, &calls);
    metro_chain chain;
    double z[10] = { 0, 1, .6, 0, -.8, 0, 1, .6, 0, -.8 };
    axes[0] = circle;
    axes[1] = axis_of(METRO_INTERVAL, METRO_UNIFORM, .3);
    axes[2] = axis_of(METRO_DIRECTION, METRO_UNIFORM, .3);
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, z) == METRO_OK && calls == 1, "the ends belong to the space");
    CHECK(metro_chain_start_point(&chain, NULL) == METRO_ERROR_ARGUMENT, "no point");
    for (i = 0; i < 9; i++) {
        z[5] = wrong[i];
        CHECK(metro_chain_start_point(&chain, z + 5) == METRO_ERROR_ARGUMENT, "%g on the circle", wrong[i]);
        z[5] = 0;
        z[6] = wrong[i];
        if (i != 1) CHECK(metro_chain_start_point(&chain, z + 5) == METRO_ERROR_ARGUMENT, "%g on the interval", z[6]);
        CHECK(i == 1 || metro_chain_start_seeds(&chain, z, NULL, 2) == METRO_ERROR_ARGUMENT, "one of two seeds");
        z[6] = 1;
        z[8] = wrong[i];
        if (i > 0) CHECK(metro_chain_start_point(&chain, z + 5) == METRO_ERROR_ARGUMENT, "%g in a direction", z[8]);
        z[8] = 0;
    }
    z[7] = (double)0.6f;
    z[9] = (double)-0.8f;
    calls = 0;
    CHECK(metro_chain_start_point(&chain, z + 5) == METRO_OK && calls == 1, "single precision");
    CHECK(chain.state[2] == z[7], "the point is taken as it is");
    metro_chain_free(&chain);
    target = target_of(&circle, 1, anywhere, &calls);
    target.propose = stay_there;
    z[0] = -7;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, z) == METRO_OK, "a space of its own");
    metro_chain_free(&chain);
}

/* Catches: a restart that records, or keeps for the new sample, what the old one has collected; a refused one that
   drops it; a flush that does not keep it. */
static void restart_drops_what_is_not_flushed(void)
{
    lab l = lab_of(half_dark, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 1e-9);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed = .25, dark = .75;
    int i, k;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    for (k = 0; k < 2; k++) {
        CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
        for (i = 0; i < 10; i++) metro_chain_step(&chain);
        CHECK(l.total == 9 + 10 * k, "ten steps, the last one pending: %g", l.total);
        CHECK(metro_chain_start_point(&chain, &dark) == METRO_ERROR_DARK_SEED && chain.weight == 1, "refused");
        if (k == 0) metro_chain_flush(&chain);
    }
    CHECK(l.total == 19, "after the flush: %g", l.total);
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK && chain.weight == 0, "restart");
    metro_chain_run(&chain, 10);
    CHECK(l.total == 29, "one step was dropped: %g", l.total);
    metro_chain_free(&chain);
}

/* Catches: seeds chosen with the wrong probability, alpha that is no distribution. */
static void seeds_are_chosen_by_alpha(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .3);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed[4] = { .1, .2, .3, .4 }, alpha[4] = { .1, 0, .65, .25 }, off[4] = { .1, 0, .65, .25 + 2e-9 };
    double count[4] = { 0 }, n = (double)check_count(40000, 4000);
    uint64_t i;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    for (i = 0; i < (uint64_t)n; i++) {
        CHECK(metro_chain_start_seeds(&chain, seed, alpha, 4) == METRO_OK, "start");
        count[(int)(chain.state[0] * 10 - .5)]++;
    }
    for (i = 0; i < 4; i++)
        if (alpha[i] > 0) CHECK_SIGMA(count[i], n * alpha[i], sqrt(n * alpha[i] * (1 - alpha[i])));
    CHECK(count[1] == 0, "a seed of probability 0 was chosen");
    CHECK(metro_chain_start_seeds(&chain, seed, off, 4) == METRO_ERROR_ARGUMENT, "sum off by 2e-9");
    off[3] = -.1;
    CHECK(metro_chain_start_seeds(&chain, seed, off, 4) == METRO_ERROR_ARGUMENT, "negative");
    off[3] = (double)NAN;
    CHECK(metro_chain_start_seeds(&chain, seed, off, 4) == METRO_ERROR_ARGUMENT, "NaN");
    CHECK(metro_chain_start_seeds(&chain, seed, NULL, 0) == METRO_ERROR_ARGUMENT, "none");
    metro_chain_free(&chain);
}

/* The estimate of the integral of x I(x) by short runs: with the weight of the start it is right after any number of
   steps, without it it is not. Truth: int x (.2 + x) = .1 + 1/3. Catches: the weight forgotten, candidates drawn
   uniformly. */
static void weighted_seeds_are_unbiased_at_every_step(void)
{
    lab l = lab_of(slope, 20);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .1);
    metro_target target = lab_target(&axis, 1, &l);
    size_t candidates[] = { 1, 2, 5 };
    int steps[] = { 1, 3, 20 };
    int c, s;
    target.record = NULL;
    for (c = 0; c < 3; c++)
        for (s = 0; s < 3; s++) {
            metro_moments weighted = { 0, 0, 0, 0 }, plain = { 0, 0, 0, 0 };
            uint64_t run, runs = check_count(40000, 1000);
            for (run = 0; run < runs; run++) {
                metro_chain chain;
                double sum = 0;
                int i;
                CHECK(metro_chain_make(&target, NULL, metro_rng_make(17, run), &chain) == METRO_OK, "make");
                CHECK(metro_chain_start_weighted(&chain, candidates[c]) == METRO_OK, "start");
                for (i = 0; i < steps[s]; i++) {
                    metro_chain_step(&chain);
                    sum += chain.state[0];
                }
                metro_moments_add(&weighted, chain.start_weight * sum / steps[s]);
                metro_moments_add(&plain, .7 * sum / steps[s]);
                metro_chain_free(&chain);
            }
            CHECK_SIGMA(metro_moments_mean(&weighted), .1 + 1 / 3.0, metro_moments_error(&weighted));
            /* One candidate without its weight is a uniform start: far off. At small scale the error hides it. */
            if (candidates[c] == 1 && check_scale() > .5)
                CHECK(fabs(metro_moments_mean(&plain) - .1 - 1 / 3.0) > 6 * metro_moments_error(&plain),
                      "the unweighted start is not seen to be biased");
        }
}

/* Catches: runs of no importance dropped from the mean, dark candidates chosen. */
static void dark_candidates_belong_to_the_mean(void)
{
    lab l = lab_of(half_dark, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .1);
    metro_target target = lab_target(&axis, 1, &l);
    metro_moments mean = { 0, 0, 0, 0 };
    uint64_t run, runs = check_count(20000, 1000), none = 0;
    metro_chain chain;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(17, 1), &chain) == METRO_OK, "make");
    for (run = 0; run < runs; run++) {
        metro_result result = metro_chain_start_weighted(&chain, 2);
        CHECK((result == METRO_ERROR_NO_IMPORTANCE) == (chain.start_weight == 0), "%s", metro_result_text(result));
        none += result == METRO_ERROR_NO_IMPORTANCE;
        l.total = 0;
        metro_chain_run(&chain, 3);
        CHECK(l.total == (result == METRO_OK ? 3 : 0), "total weight %g", l.total);
        metro_moments_add(&mean, chain.start_weight * l.total / 3);
    }
    CHECK_SIGMA(metro_moments_mean(&mean), .5, metro_moments_error(&mean));
    CHECK_SIGMA((double)none, (double)runs / 4, sqrt((double)runs * 3 / 16));
    metro_chain_free(&chain);
    l.function = nowhere;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(17, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_weighted(&chain, 100) == METRO_ERROR_NO_IMPORTANCE, "nothing to find");
    CHECK(metro_chain_start_weighted(&chain, 0) == METRO_ERROR_ARGUMENT, "no candidates");
    metro_chain_free(&chain);
}

/* Catches: candidates without importance, large steps or surveys counted twice or not at all in b. */
static void b_comes_with_its_error(void)
{
    lab l = lab_of(slope, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .1);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain_options options = { .25, 0 };
    metro_chain chain;
    metro_moments b = { 0, 0, 0, 0 };
    double error, sum = 0, seed = .5;
    uint64_t run, runs = check_count(2000, 200);
    for (run = 0; run < runs; run++) {
        CHECK(metro_chain_make(&target, &options, metro_rng_make(run, 3), &chain) == METRO_OK, "make");
        CHECK_NAN(metro_chain_b(&chain, NULL));
        CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
        metro_chain_survey(&chain, 10);
        metro_chain_run(&chain, 100);
        CHECK(chain.normalisation.count == 10 + chain.counts.large_steps, "b from %g draws",
              (double)chain.normalisation.count);
        metro_moments_add(&b, metro_chain_b(&chain, &error));
        sum += error * error;
        metro_chain_free(&chain);
    }
    CHECK_SIGMA(metro_moments_mean(&b), .7, metro_moments_error(&b));
    /* The stated errors are those that the runs show: the ratio of variances has an error of sqrt(2/runs) */
    CHECK_SIGMA(sum / (double)runs / metro_moments_variance(&b), 1.0, 1.2 * sqrt(2 / (double)runs));
}

/* Catches: a large step that redraws one axis only, or with the wrong probability. */
static void large_steps_redraw_all_axes(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axes[3];
    metro_target target = lab_target(axes, 3, &l);
    metro_chain_options options = { .25, 0 };
    metro_chain chain;
    double z[5], n = (double)check_count(40000, 2000), far = 0;
    int i, k;
    axes[0] = axis_of(METRO_CIRCLE, METRO_UNIFORM, 1e-6);
    axes[1] = axis_of(METRO_INTERVAL, METRO_UNIFORM, 1e-6);
    axes[2] = axis_of(METRO_DIRECTION, METRO_VON_MISES, 1e12);
    z[0] = z[1] = .5;
    z[2] = z[3] = 0;
    z[4] = 1;
    CHECK(metro_chain_make(&target, &options, metro_rng_make(1, 3), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, z) == METRO_OK, "start");
    for (i = 0; i < (int)n; i++) {
        int moved = 0;
        metro_chain_step(&chain);
        for (k = 0; k < 5; k++) moved += fabs(chain.state[k] - z[k]) > 1e-4;
        far += moved > 0;
        CHECK(moved == 0 || moved >= 4, "%d of five coordinates moved far", moved);
        memcpy(z, chain.state, sizeof z);
        CHECK_NEAR(z[2] * z[2] + z[3] * z[3] + z[4] * z[4], 1.0, 1e-14);
    }
    CHECK_SIGMA(far, .25 * n, sqrt(n * .25 * .75));
    CHECK_SIGMA((double)chain.counts.large_steps, .25 * n, sqrt(n * .25 * .75));
    metro_chain_free(&chain);
}

/* Catches: expected values that change the mean or do not lower the variance. */
static void expected_values_lower_the_variance(void)
{
    metro_moments mean[2] = { { 0, 0, 0, 0 }, { 0, 0, 0, 0 } };
    uint64_t run, runs = check_count(4000, 300);
    int e;
    for (e = 0; e < 2; e++)
        for (run = 0; run < runs; run++) {
            lab l = lab_of(slope, 2);
            metro_axis axis = axis_of(METRO_INTERVAL, METRO_UNIFORM, 1.5);
            metro_target target = lab_target(&axis, 1, &l);
            metro_chain_options options = { 0, 0 };
            metro_chain chain;
            options.expected_values = e;
            CHECK(metro_chain_make(&target, &options, metro_rng_make(1, run), &chain) == METRO_OK, "make");
            CHECK(metro_chain_start_weighted(&chain, 100) == METRO_OK, "start");
            metro_chain_run(&chain, 100);
            CHECK_NEAR(l.total, 100.0, 1e-13);
            metro_moments_add(&mean[e], l.bin[0] / 100);
            metro_chain_free(&chain);
        }
    for (e = 0; e < 2; e++)
        CHECK_CLOSE(metro_moments_mean(&mean[e]), .225 / .7, .004 + 6 * metro_moments_error(&mean[e]));
    CHECK(metro_moments_variance(&mean[1]) < metro_moments_variance(&mean[0]), "%g with, %g without expected values",
          metro_moments_variance(&mean[1]), metro_moments_variance(&mean[0]));
}

/* Catches: 32-bit counts, a burn-in that leaves weights or counts behind, a stay counted wrongly. */
static void counts_are_kept(void)
{
    lab l = lab_of(half_dark, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 1);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain chain;
    double seed = .2;
    uint64_t longest = 0, stay = 0, i;
    CHECK(metro_chain_make(&target, NULL, metro_rng_make(1, 9), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    metro_chain_burn(&chain, 1000);
    CHECK(l.records == 0 && chain.weight == 0 && chain.counts.steps == 0 && chain.counts.dark == 0,
          "the burn-in left traces");
    for (i = 0; i < 2000; i++) {
        stay = metro_chain_step(&chain) ? 0 : stay + 1;
        if (stay > longest) longest = stay;
    }
    CHECK(chain.counts.longest_stay == longest, "%g and %g", (double)chain.counts.longest_stay, (double)longest);
    chain.counts.steps = UINT64_C(0xfffffffe);
    chain.counts.accepted = UINT64_C(0xffffffff);
    metro_chain_run(&chain, 1000);
    CHECK(chain.counts.steps == UINT64_C(0xfffffffe) + 1000, "steps beyond 2^32");
    CHECK(chain.counts.accepted > UINT64_C(0xffffffff) + 300, "accepted beyond 2^32");
    metro_chain_free(&chain);
    metro_chain_free(&chain);
}

/* Catches: nonsense that is taken, memory that a failure leaks, a step that allocates. */
static void chains_refuse_nonsense(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .1);
    metro_target target = lab_target(&axis, 1, &l), bad;
    metro_chain_options options = { 1.5, 0 };
    metro_chain chain;
    metro_rng rng = metro_rng_make(1, 1);
    double seed = .5;
    long before;
    memset(&chain, 0, sizeof chain);
    CHECK(metro_chain_make(&target, &options, rng, &chain) == METRO_ERROR_ARGUMENT, "large step 1.5");
    options.large_step = (double)NAN;
    CHECK(metro_chain_make(&target, &options, rng, &chain) == METRO_ERROR_ARGUMENT, "large step NaN");
    bad = target;
    bad.axis_count = 0;
    CHECK(metro_chain_make(&bad, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "no axes");
    bad.axis_count = SIZE_MAX / 8;
    CHECK(metro_chain_make(&bad, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "axes overflow");
    bad = target;
    bad.importance = NULL;
    CHECK(metro_chain_make(&bad, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "no importance");
    bad = target;
    bad.sample_size = SIZE_MAX - 3;
    CHECK(metro_chain_make(&bad, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "sample overflows");
    axis.kernel.size = 0;
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "size 0");
    axis = axis_of(METRO_INTERVAL, METRO_VON_MISES, 3);
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "von Mises on an interval");
    axis = axis_of(METRO_DIRECTION, METRO_CAUCHY, 3);
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "Cauchy on the sphere");
    axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .1);
    axis.kernel.large = .1;
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_ERROR_ARGUMENT, "large step of one axis");
    axis.kernel.large = 0;
    CHECK(chain.memory == NULL, "a failure left memory");
    allocations_left = 0;
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_ERROR_MEMORY, "no memory");
    allocations_left = -1;
    CHECK(metro_chain_make(&target, NULL, rng, &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    before = allocations_made;
    metro_chain_run(&chain, 100);
    metro_chain_flush(&chain);
    CHECK(allocations_made == before, "a step allocated");
    metro_chain_free(&chain);
}

/* Catches: an assertion that holds for a chain that was not made, or for one that was freed. */
static void a_chain_that_was_not_made_is_asserted(void)
{
    static volatile int caught = 0;
    static metro_chain chain;
    double z = .5;
    if (setjmp(asserted)) caught++;
    if (caught == 0) metro_chain_start_point(&chain, &z);
    if (caught == 1) metro_chain_start_seeds(&chain, &z, NULL, 1);
    if (caught == 2) metro_chain_start_weighted(&chain, 1);
    if (caught == 3) metro_chain_survey(&chain, 1);
    CHECK(caught == 4, "%d of four", caught);
}

/* Large steps alone are independent sampling. Catches: a large step that depends on where the chain is. */
static void only_large_steps_are_independent(void)
{
    lab l = lab_of(flat, 10);
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, .01);
    metro_target target = lab_target(&axis, 1, &l);
    metro_chain_options options = { 1, 0 };
    metro_chain chain;
    double seed = .5, last, product = 0, n = (double)check_count(100000, 3000);
    int i;
    CHECK(metro_chain_make(&target, &options, metro_rng_make(1, 1), &chain) == METRO_OK, "make");
    CHECK(metro_chain_start_point(&chain, &seed) == METRO_OK, "start");
    for (i = 0, last = .5; i < (int)n; i++) {
        metro_chain_step(&chain);
        product += (last - .5) * (chain.state[0] - .5);
        last = chain.state[0];
    }
    CHECK_SIGMA(product / n, 0.0, 1 / 12.0 / sqrt(n));
    metro_chain_free(&chain);
}

int main(void)
{
    CHECK_RUN(chain_equals_a_loop_written_by_hand);
    CHECK_RUN(chain_keeps_the_target);
    CHECK_RUN(asymmetric_transitions_go_through_the_ratio);
    CHECK_RUN(flat_target_accepts_all);
    CHECK_RUN(squared_jump_is_exact);
    CHECK_RUN(bad_importances_are_rejected_and_counted);
    CHECK_RUN(acceptance_survives_huge_ratios);
    CHECK_RUN(scale_of_importance_does_not_matter);
    CHECK_RUN(dark_and_bad_seeds_are_refused);
    CHECK_RUN(seeds_outside_the_space_are_refused);
    CHECK_RUN(restart_drops_what_is_not_flushed);
    CHECK_RUN(seeds_are_chosen_by_alpha);
    CHECK_RUN(weighted_seeds_are_unbiased_at_every_step);
    CHECK_RUN(dark_candidates_belong_to_the_mean);
    CHECK_RUN(b_comes_with_its_error);
    CHECK_RUN(large_steps_redraw_all_axes);
    CHECK_RUN(expected_values_lower_the_variance);
    CHECK_RUN(counts_are_kept);
    CHECK_RUN(chains_refuse_nonsense);
    CHECK_RUN(a_chain_that_was_not_made_is_asserted);
    CHECK_RUN(only_large_steps_are_independent);
    return check_done("chain");
}
