/* startup.c: all start-up policies side by side, at equal cost (section 1.2 and 2.1 of the paper).

   The picture is 24 pixels round a circle: a bright peak on a dim floor. Each policy may evaluate the importance so
   many times and must find everything with that, the normalisation b too, for which a fifth of the budget goes into
   independent draws (weighted seeds and large steps draw them anyway). Every policy is repeated many times, and its
   squared bias and its variance are taken apart.

   See: the bias falls with the square of the budget, the variance with the budget itself, so a start that looks
   terrible at a hundred samples is a footnote at ten thousand. A burn-in pays for its lost samples with variance.
   Weighted seeds have no bias at any budget. Large steps cure the start and the slow walk at once.

   Writes out/startup.svg and out/startup.csv. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { PIXELS = 24, SEEDS = 16, POLICIES = 7, BUDGETS = 5, JOBS = 64 };

static const char *const policy_name[POLICIES] = { "one dark point",      "burn-in",       "16 fixed seeds",
                                                   "seeds by importance", "weighted seed", "16 weighted seeds",
                                                   "large steps" };
static const uint64_t budget[BUDGETS] = { 100, 400, 1600, 6400, 25600 };

/* The importance is the brightness at x: a peak of width .04 at .7 on a floor. */
static double brightness(double x) { return 0.1 + exp(-(x - 0.7) * (x - 0.7) / (2 * 0.04 * 0.04)); }

static double importance(const double *z, void *sample, void *user)
{
    (void)user;
    *(int *)sample = (int)(z[0] * PIXELS);
    return brightness(z[0]);
}

/* f/I is 1 on the pixel of the sample, so its weight is all there is to add. */
static void record(const void *sample, double weight, void *user)
{
    ((double *)user)[*(const int *)sample] += weight;
}

static void truth_of(double *pixel)
{
    int i, k;
    for (i = 0; i < PIXELS; i++)
        for (k = 0, pixel[i] = 0; k < 1000; k++)
            pixel[i] += brightness((i + (k + 0.5) / 1000) / PIXELS) / 1000 / PIXELS;
}

/* Adds `scale` times the mean over the steps of a chain. */
static void run_and_add(metro_chain *chain, uint64_t steps, double scale, double *pixel, double *picture)
{
    int i;
    memset(pixel, 0, PIXELS * sizeof *pixel);
    metro_chain_run(chain, steps);
    for (i = 0; i < PIXELS; i++) picture[i] += scale * pixel[i] / (double)steps;
}

/* A seed drawn from `count` uniform candidates by importance, as start-up paper (13) suggests. */
static void start(metro_chain *chain, int policy, int seed, uint64_t candidates)
{
    double point = 0.2;
    if (policy == 2) point = (seed + 0.5) / SEEDS;
    if (policy >= 3 && policy <= 5) metro_chain_start_weighted(chain, (size_t)candidates);
    else metro_chain_start_point(chain, &point);
}

/* One estimate of the picture with `cost` evaluations of the importance. */
static metro_result estimate(int policy, uint64_t cost, metro_rng rng, double *picture)
{
    metro_axis axis = { METRO_CIRCLE, { METRO_UNIFORM, 0.1, 0, 0 } };
    metro_chain_options options = { 0, 0 };
    metro_target target;
    metro_chain chain;
    metro_result result;
    double pixel[PIXELS];
    int seeds = policy == 2 || policy == 3 || policy == 5 ? SEEDS : 1, seed;
    uint64_t independent = policy == 6 ? 0 : cost / 5, steps = cost - independent - (policy == 1 ? cost / 5 : 0);
    memset(&target, 0, sizeof target);
    memset(picture, 0, PIXELS * sizeof *picture);
    target.axes = &axis;
    target.axis_count = 1;
    target.sample_size = sizeof(int);
    target.importance = importance;
    target.record = record;
    target.user = pixel;
    options.expected_values = 1;
    options.large_step = policy == 6 ? 0.2 : 0;
    result = metro_chain_make(&target, &options, rng, &chain);
    if (result != METRO_OK) return result;
    if (policy < 3) metro_chain_survey(&chain, independent);
    for (seed = 0; seed < seeds; seed++) {
        double scale;
        start(&chain, policy, seed, independent / (uint64_t)seeds);
        if (policy == 1) metro_chain_burn(&chain, cost / 5);
        scale = policy == 4 || policy == 5 ? chain.start_weight : 1;
        run_and_add(&chain, steps / (uint64_t)seeds, scale / seeds, pixel, picture);
    }
    /* b is known only at the end where large steps measure it; weighted seeds carry theirs */
    for (seed = 0; seed < PIXELS && policy != 4 && policy != 5; seed++) picture[seed] *= metro_chain_b(&chain, NULL);
    metro_chain_free(&chain);
    return METRO_OK;
}

/* A job makes its share of the repeats for one policy and budget. */
typedef struct {
    int policy;
    uint64_t cost;
    size_t repeats; /* of a job */
    double *picture;
} study;

static metro_result study_work(uint64_t job, void *slot, void *user)
{
    const study *s = (const study *)user;
    metro_result result = METRO_OK;
    size_t i;
    for (i = 0; i < s->repeats && result == METRO_OK; i++) {
        uint64_t repeat = job * s->repeats + i;
        metro_rng rng = metro_rng_make(s->cost * 16 + (uint64_t)s->policy, repeat);
        result = estimate(s->policy, s->cost, rng, (double *)slot + i * PIXELS);
    }
    return result;
}

static metro_result study_merge(uint64_t job, const void *slot, void *user)
{
    study *s = (study *)user;
    memcpy(s->picture + job * s->repeats * PIXELS, slot, s->repeats * PIXELS * sizeof(double));
    return METRO_OK;
}

static metro_result measure(int policy, uint64_t cost, size_t repeats, const double *truth, metro_bias_variance *out)
{
    study s;
    metro_rounds plan;
    metro_result result;
    memset(&plan, 0, sizeof plan);
    s.policy = policy;
    s.cost = cost;
    s.repeats = repeats / JOBS;
    s.picture = (double *)malloc(repeats * PIXELS * sizeof(double));
    if (s.picture == NULL) return METRO_ERROR_MEMORY;
    plan.jobs = JOBS;
    plan.slot_size = s.repeats * PIXELS * sizeof(double);
    plan.work = study_work;
    plan.merge = study_merge;
    result = metro_rounds_run(&plan, &s);
    if (result == METRO_OK) result = metro_repeats(s.picture, truth, repeats, PIXELS, out);
    free(s.picture);
    return result;
}

/* Long runs scatter less, so they are repeated less often. */
static size_t repeats_for(uint64_t cost)
{
    size_t repeats = cost <= 1600 ? 4096 : (size_t)(4096 * 1600 / cost);
    return plot_quick() ? repeats / 4 : repeats;
}

int main(void)
{
    double truth[PIXELS], power = 0, x[BUDGETS], bias2[BUDGETS], bias2_error[BUDGETS], variance[BUDGETS];
    plot_chart chart =
        plot_chart_make("A bad start fades faster than the noise",
                        "Squared bias (left) and variance (right) of a 24-pixel picture, relative to its power, at "
                        "equal cost. Squared bias under two standard errors is not drawn: weighted seeds have none.");
    plot_csv csv = plot_csv_open("out/startup.csv", "policy,evaluations,bias2,bias2_error,variance,variance_error");
    metro_bias_variance last, first;
    int policy, b, i;
    memset(&last, 0, sizeof last);
    memset(&first, 0, sizeof first);
    truth_of(truth);
    for (i = 0; i < PIXELS; i++) power += truth[i] * truth[i] / PIXELS;
    chart.columns = 2;
    chart.width = 1400;
    chart.share_y = 1;
    chart.panel[0].title = "squared bias: the start-up";
    chart.panel[1].title = "variance: everything else";
    for (i = 0; i < 2; i++) {
        chart.panel[i].x_log = chart.panel[i].y_log = 1;
        chart.panel[i].x_label = "evaluations of the importance";
        chart.panel[i].y_label = "relative to the power of the picture";
    }
    printf("evaluations:        ");
    for (b = 0; b < BUDGETS; b++) printf("  %-28d", (int)budget[b]);
    printf("\nstart-up            ");
    for (b = 0; b < BUDGETS; b++) printf("  %-19s %8s", "bias^2", "variance");
    printf("\n");
    for (policy = 0; policy < POLICIES; policy++) {
        printf("%-20s", policy_name[policy]);
        for (b = 0; b < BUDGETS; b++) {
            metro_bias_variance error;
            metro_result result = measure(policy, budget[b], repeats_for(budget[b]), truth, &error);
            if (result != METRO_OK) {
                fprintf(stderr, "startup: %s: %s\n", policy_name[policy], metro_result_text(result));
                return 1;
            }
            x[b] = (double)budget[b];
            bias2[b] = error.bias2 > 2 * error.bias2_error ? error.bias2 / power : NAN;
            bias2_error[b] = error.bias2_error / power;
            variance[b] = error.variance / power;
            plot_csv_text(&csv, policy_name[policy]);
            PLOT_CSV_ROW(&csv, x[b], error.bias2 / power, error.bias2_error / power, variance[b],
                         error.variance_error / power);
            printf("  %8.2g +- %-7.1g %8.2g", error.bias2 / power, error.bias2_error / power, variance[b]);
            if (policy == 0 && b == 0) first = error;
            if (policy == 0 && b == 2) last = error;
            plot_progress((policy * BUDGETS + b + 1) / (double)(POLICIES * BUDGETS), "startup");
        }
        printf("\n");
        plot_points(&chart.panel[0], x, bias2, bias2_error, BUDGETS, NULL)->color = plot_palette((size_t)policy);
        plot_line(&chart.panel[0], x, bias2, BUDGETS, policy_name[policy])->color = plot_palette((size_t)policy);
        plot_line(&chart.panel[1], x, variance, BUDGETS, policy_name[policy])->color = plot_palette((size_t)policy);
    }
    if (plot_csv_close(&csv) != 0 || plot_save(&chart, "out/startup.svg") != 0) return 1;
    printf("from one dark point, squared bias is %.0f %% of the mean squared error at %d evaluations and %.0f %% at "
           "%d\n",
           100 * first.bias2 / first.mse, (int)budget[0], 100 * last.bias2 / last.mse, (int)budget[2]);
    return 0;
}
