/* make calibrate: are the stated errors honest? Each study repeats a small experiment many times with other random
   numbers and counts how often the interval of 1.96 stated standard errors covers the truth: 95 % is right. The last
   column is the mean of the squared stated errors over the variance that the repeats show: 1 is right. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "kernels.h"

enum { RUNS = 4000 };

typedef struct {
    metro_moments estimate;
    double variance; /* sum of squared stated errors */
    int covered, count;
} study;

static void study_add(study *s, double estimate, double error, double truth)
{
    metro_moments_add(&s->estimate, estimate);
    s->variance += error * error;
    s->covered += fabs(estimate - truth) <= 1.96 * error;
    s->count++;
}

static void study_report(const study *s, const char *what, double truth)
{
    double n = s->count, covered = s->covered / n;
    printf("%-44s %6.2f +- %.2f %% covered, mean %+.2f standard errors off, variance ratio %.3f\n", what,
           100 * covered, 100 * sqrt(covered * (1 - covered) / n),
           (metro_moments_mean(&s->estimate) - truth) / metro_moments_error(&s->estimate),
           s->variance / n / metro_moments_variance(&s->estimate));
}

static double slope(const double *z, void *sample, void *user)
{
    (void)sample;
    (void)user;
    return 0.2 + z[0];
}

static double flat(const double *z, void *sample, void *user)
{
    (void)z;
    (void)sample;
    (void)user;
    return 1;
}

/* b from the large steps of a chain of 400 steps. */
static void study_of_b(void)
{
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 0.1);
    metro_target target = target_of(&axis, 1, slope, NULL);
    metro_chain_options options = { 0.3, 0 };
    study s;
    int run;
    memset(&s, 0, sizeof s);
    for (run = 0; run < RUNS; run++) {
        metro_chain chain;
        double seed = 0.5, b, error;
        if (metro_chain_make(&target, &options, metro_rng_make(1, (uint64_t)run), &chain) != METRO_OK) exit(1);
        metro_chain_start_point(&chain, &seed);
        metro_chain_run(&chain, 400);
        b = metro_chain_b(&chain, &error);
        study_add(&s, b, error, 0.7);
        metro_chain_free(&chain);
    }
    study_report(&s, "b from large steps (truth .7)", 0.7);
}

/* The mean of a chain in equilibrium with its MCSE: four chains of `draws` states. */
static void study_of_mcse(size_t draws)
{
    static double draw[4 * 4000];
    metro_axis axis = axis_of(METRO_INTERVAL, METRO_UNIFORM, 0.5);
    metro_target target = target_of(&axis, 1, slope, NULL);
    char what[64];
    study s;
    int run, c;
    memset(&s, 0, sizeof s);
    for (run = 0; run < RUNS / 4; run++) {
        for (c = 0; c < 4; c++) {
            metro_chain chain;
            size_t i;
            if (metro_chain_make(&target, NULL, metro_rng_make(2, (uint64_t)(4 * run + c)), &chain) != METRO_OK)
                exit(1);
            metro_chain_start_weighted(&chain, 1000);
            metro_chain_burn(&chain, 50);
            for (i = 0; i < draws; i++) {
                metro_chain_step(&chain);
                draw[(size_t)c * draws + i] = chain.state[0];
            }
            metro_chain_free(&chain);
        }
        {
            metro_sum sum = { 0, 0 };
            size_t i;
            for (i = 0; i < 4 * draws; i++) metro_sum_add(&sum, draw[i]);
            study_add(&s, metro_sum_value(&sum) / (double)(4 * draws), metro_mcse_mean(draw, 4, draws),
                      (0.1 + 1 / 3.0) / 0.7);
        }
    }
    snprintf(what, sizeof what, "MCSE of the mean, four chains of %d", (int)draws);
    study_report(&s, what, (0.1 + 1 / 3.0) / 0.7);
}

/* E_n^2 from an ensemble of 1280 chains, where it is large and where it is gone. */
static void study_of_ensembles(uint64_t n)
{
    metro_axis axis = axis_of(METRO_CIRCLE, METRO_UNIFORM, 0.3);
    metro_target target = target_of(&axis, 1, flat, NULL);
    metro_ensemble ensemble;
    double seed = 0.1, truth = 0;
    char what[64];
    study s;
    int run, k;
    memset(&ensemble, 0, sizeof ensemble);
    memset(&s, 0, sizeof s);
    ensemble.target = &target;
    ensemble.seed = &seed;
    ensemble.seeds = 1;
    ensemble.steps = &n;
    ensemble.times = 1;
    ensemble.chains = 1280;
    ensemble.harmonics = 10;
    for (k = 1; k <= 10; k++) truth += 2 * pow(metro_kernel_coefficient(&axis.kernel, k), 2.0 * (double)n);
    for (run = 0; run < RUNS / 4; run++) {
        double squared, error;
        ensemble.random_seed = (uint64_t)run;
        if (metro_ensemble_measure(&ensemble, &squared, &error) != METRO_OK) exit(1);
        study_add(&s, squared, error, truth);
    }
    snprintf(what, sizeof what, "E_n^2 of an ensemble, n = %d", (int)n);
    study_report(&s, what, truth);
}

int main(void)
{
    study_of_b();
    study_of_mcse(200);
    study_of_mcse(4000);
    study_of_ensembles(1);
    study_of_ensembles(5);
    study_of_ensembles(50);
    return 0;
}
