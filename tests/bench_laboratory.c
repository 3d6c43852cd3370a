/* make bench: what the laboratory costs. Ratios are taken within one run, alternating, the best of several rounds,
   because machines are shared and noisy. */

#if !defined(_POSIX_C_SOURCE)
#define _POSIX_C_SOURCE 200809L /* clock_gettime */
#endif
#include <time.h>
#define METRO_IMPLEMENTATION
#include "../metro.h"

enum { BINS = 100, ROUNDS = 7 };

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

typedef struct {
    double bin[BINS];
} histogram;

static double parabola(const double *z, void *sample, void *user)
{
    (void)user;
    *(double *)sample = z[0];
    return 0.2 + z[0] * z[0];
}

static void record(const void *sample, double weight, void *user)
{
    ((histogram *)user)->bin[(int)(*(const double *)sample * BINS)] += weight;
}

static double time_chain(histogram *h, uint64_t steps)
{
    metro_axis axis = { METRO_CIRCLE, { METRO_UNIFORM, 0.3, 0, 0 } };
    metro_target target;
    metro_chain chain;
    double seed = 0.5, start;
    memset(h, 0, sizeof *h);
    memset(&target, 0, sizeof target);
    target.axes = &axis;
    target.axis_count = 1;
    target.sample_size = sizeof(double);
    target.importance = parabola;
    target.record = record;
    target.user = h;
    if (metro_chain_make(&target, NULL, metro_rng_make(1, 2), &chain) != METRO_OK) exit(1);
    metro_chain_start_point(&chain, &seed);
    start = seconds();
    metro_chain_run(&chain, steps);
    start = seconds() - start;
    metro_chain_free(&chain);
    return start;
}

/* The same by hand: the loop of the paper for this one target, with the same random numbers. */
static double time_hand(histogram *h, uint64_t steps)
{
    metro_rng rng = metro_rng_make(1, 2);
    double x = 0.5, importance = 0.2 + x * x, start;
    uint64_t i;
    memset(h, 0, sizeof *h);
    start = seconds();
    for (i = 0; i < steps; i++) {
        double t = x + 0.3 * (metro_rng_uniform(&rng) - 0.5), tentative, a;
        if (t < 0) t += 1;
        else if (t >= 1) t -= 1;
        tentative = 0.2 + t * t;
        a = tentative / importance;
        if (a >= 1 || metro_rng_uniform(&rng) < a) {
            x = t;
            importance = tentative;
        }
        h->bin[(int)(x * BINS)] += 1;
    }
    return seconds() - start;
}

static int by_value(const void *a, const void *b)
{
    return (*(const double *)a > *(const double *)b) - (*(const double *)a < *(const double *)b);
}

/* Short runs in turn, so that both meet the same disturbances; the median of their ratios. */
static void bench_chain(void)
{
    enum { TURNS = 25 };
    const uint64_t steps = 1000000;
    double chain = INFINITY, hand = INFINITY, ratio[TURNS];
    histogram a, b;
    int i, same = 1;
    for (i = 0; i < TURNS; i++) {
        double t = time_chain(&a, steps), u = time_hand(&b, steps);
        if (t < chain) chain = t;
        if (u < hand) hand = u;
        ratio[i] = t / u;
        same &= memcmp(&a, &b, sizeof a) == 0;
    }
    qsort(ratio, TURNS, sizeof *ratio, by_value);
    printf("chain on a 1-D target: %.1f ns a step, by hand %.1f ns; median ratio %.2f, best %.2f (goal: 2.0), %s\n",
           1e9 * chain / (double)steps, 1e9 * hand / (double)steps, ratio[TURNS / 2], chain / hand,
           same ? "same histogram" : "THE HISTOGRAMS DIFFER");
}

/* The best time of a call of metro_startup_error, in microseconds. */
static double time_error(const metro_kernel *kernel, uint64_t n)
{
    double best = INFINITY;
    int i, repeat;
    for (i = 0; i < ROUNDS; i++) {
        volatile double keep = 0;
        double start = seconds(), elapsed;
        for (repeat = 0; repeat < 4; repeat++) keep += metro_startup_error(kernel, n);
        elapsed = (seconds() - start) / 4;
        if (elapsed < best) best = elapsed;
    }
    return 1e6 * best;
}

static void bench_theory(void)
{
    static const char *const name[6] = { "uniform", "triangle", "Gaussian", "Cauchy", "von Mises", "Kelemen" };
    static const uint64_t n[8] = { 1, 2, 3, 4, 5, 10, 100, 1000 };
    static const double sizes[5] = { 0.003, 0.05, 0.3, 0.97, 1.43 };
    int shape, i, s;
    printf("metro_startup_error, worst over sizes .003 to 1.43, microseconds (goal: 50; Kelemen 50000):\n           "
           "n =");
    for (i = 0; i < 8; i++) printf(" %8d", (int)n[i]);
    for (shape = 0; shape < 6; shape++) {
        printf("\n  %-11s", name[shape]);
        for (i = 0; i < 8; i++) {
            double worst = 0;
            for (s = 0; s < 5; s++) {
                metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
                double t;
                kernel.shape = (metro_shape)shape;
                kernel.size = shape == METRO_VON_MISES ? 1 / (sizes[s] * sizes[s]) : sizes[s];
                kernel.size_min = sizes[s] / 64;
                t = time_error(&kernel, n[i]);
                if (t > worst) worst = t;
            }
            printf(" %8.2f", worst);
        }
    }
    printf("\n");
}

static void bench_seeds(void)
{
    metro_kernel kernel = { METRO_UNIFORM, 0.05, 0, 0 };
    metro_rng rng = metro_rng_make(3, 3);
    static double seed[4096];
    size_t count;
    int i;
    double last = 0;
    for (count = 0; count < 4096; count++) seed[count] = metro_rng_uniform(&rng);
    printf("metro_startup_error_seeds, uniform .05, n = 10 (goal: linear in the seeds):\n");
    for (count = 64; count <= 4096; count *= 4) {
        double best = INFINITY;
        for (i = 0; i < ROUNDS; i++) {
            double start = seconds();
            volatile double keep = metro_startup_error_seeds(&kernel, 10, seed, NULL, count);
            (void)keep;
            start = seconds() - start;
            if (start < best) best = start;
        }
        printf("  %5d seeds %9.1f us", (int)count, 1e6 * best);
        if (last > 0) printf(", %.2f times the time for 4 times the seeds", best / last);
        printf("\n");
        last = best;
    }
}

static double two_peaks(double x, void *user)
{
    double a = (x - 0.25) / 0.03, b = (x - 0.75) / 0.03;
    (void)user;
    return 1e-4 + exp(-a * a / 2) + exp(-b * b / 2);
}

static void bench_best_size(void)
{
    uint64_t steps;
    printf("metro_best_size on two peaks (goal: 0.1 s for any number of steps):\n");
    for (steps = 10; steps <= UINT64_C(100000000000); steps *= 1000) {
        double best = INFINITY;
        int i;
        for (i = 0; i < 3; i++) {
            metro_best choice;
            double start = seconds();
            if (metro_best_size(two_peaks, NULL, steps, NULL, &choice) != METRO_OK) exit(1);
            start = seconds() - start;
            if (start < best) best = start;
        }
        printf("  %12.0f steps %6.1f ms\n", (double)steps, 1e3 * best);
    }
}

int main(void)
{
    bench_chain();
    bench_theory();
    bench_seeds();
    bench_best_size();
    return 0;
}
