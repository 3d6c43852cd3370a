/* own.c: a researcher's template: your own target, your own asymmetric mutation, and the questions to ask before
   trusting it.

   Replace three functions: `importance` (what you sample), `propose` (how you move, returning T(to -> from)/T(from ->
   to)) and `record` (what you keep). The rest asks, in this order: Is the mutation in balance with its ratio? Do four
   chains from four corners agree? How many independent draws are they worth? How good is b, and the mean?

   The target here is two-dimensional, a bent ridge on a unit square; the mutation drifts along the ridge, which makes
   it asymmetric. Run it once with `own wrong`: the ratio is then left out, everything still runs, and the first
   question finds it.

   Writes out/own.svg (the chains on the ridge, R-hat as they go on) and out/own.csv. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { CHAINS = 4, LOOKS = 12 };

typedef struct {
    double x, y;
} point;

typedef struct {
    int forget_ratio;
    double *draw;   /* [chain * draws + i]: the x of each step, for the diagnostics */
    double *path;   /* the same of y */
    metro_sum mean; /* of x, with the weights of the chain */
} experiment;

/* The importance: a ridge along y = 4 (x - 1/2)^2, brighter to the right. Any scale will do. */
static double importance(const double *z, void *sample, void *user)
{
    double x = z[0], y = z[1], off = y - 4 * (x - 0.5) * (x - 0.5);
    (void)user;
    ((point *)sample)->x = x;
    ((point *)sample)->y = y;
    return x < 0 || x > 1 || y < 0 || y > 1 ? 0 : (0.2 + x) * exp(-off * off / (2 * 0.05 * 0.05));
}

static void record(const void *sample, double weight, void *user)
{
    metro_sum_add(&((experiment *)user)->mean, weight * ((const point *)sample)->x);
}

/* The mutation: a normal step around a point a little further along the slope of the ridge. Its density depends on
   where it starts, so the way back has another one, and the ratio of the two goes into the acceptance (eq 4.2). */
static const double step_size = 0.06;

static double drift(double x) { return 0.02 * (x - 0.5); }

static double log_density(double from_x, double from_y, double to_x, double to_y)
{
    double dx = to_x - from_x - drift(from_x), dy = to_y - from_y - 8 * (from_x - 0.5) * drift(from_x);
    return -(dx * dx + dy * dy) / (2 * step_size * step_size);
}

static double propose(const double *from, double *to, metro_rng *rng, void *user)
{
    to[0] = from[0] + drift(from[0]) + step_size * metro_rng_normal(rng);
    to[1] = from[1] + 8 * (from[0] - 0.5) * drift(from[0]) + step_size * metro_rng_normal(rng);
    if (((const experiment *)user)->forget_ratio) return 1;
    return exp(log_density(to[0], to[1], from[0], from[1]) - log_density(from[0], from[1], to[0], to[1]));
}

static int complain(const char *what, metro_result result)
{
    fprintf(stderr, "own: %s: %s\n", what, metro_result_text(result));
    return 1;
}

/* Runs the chain of corner `c` and writes down where it is after each step. */
static metro_result run_chain(const metro_target *target, int c, size_t draws, metro_moments *b,
                              metro_chain_counts *counts)
{
    static const double corner[CHAINS][2] = { { 0.02, 0.92 }, { 0.98, 0.92 }, { 0.3, 0.2 }, { 0.6, 0.05 } };
    metro_chain_options options = { 0.05, 0 }; /* one step in twenty is a uniform draw: it also measures b */
    experiment *e = (experiment *)target->user;
    metro_chain chain;
    size_t i;
    metro_result result = metro_chain_make(target, &options, metro_rng_make(1, (uint64_t)c), &chain);
    if (result != METRO_OK) return result;
    result = metro_chain_start_point(&chain, corner[c]);
    for (i = 0; i < draws && result == METRO_OK; i++) {
        metro_chain_step(&chain);
        e->draw[(size_t)c * draws + i] = chain.state[0];
        e->path[(size_t)c * draws + i] = chain.state[1];
    }
    metro_chain_flush(&chain);
    metro_moments_add(b, metro_chain_b(&chain, NULL));
    *counts = chain.counts;
    metro_chain_free(&chain);
    return result;
}

/* R-hat of the first part of each chain, for the chart: how the answer to "do they agree?" develops. */
static double rhat_so_far(const experiment *e, size_t draws, size_t length, double *scratch)
{
    int c;
    for (c = 0; c < CHAINS; c++)
        memcpy(scratch + (size_t)c * length, e->draw + (size_t)c * draws, length * sizeof *scratch);
    return metro_rhat(scratch, CHAINS, length);
}

static int draw_chart(const experiment *e, size_t draws)
{
    plot_chart chart =
        plot_chart_make("Four chains of one's own mutation",
                        "Left: the first 400 steps of each chain from its corner. Right: R-hat below 1.01 (dashed) "
                        "is what one asks for before trusting a result.");
    plot_csv csv = plot_csv_open("out/own.csv", "steps,rhat,ess");
    double length[LOOKS], rhat[LOOKS];
    double *scratch = (double *)malloc(CHAINS * draws * sizeof *scratch);
    int c, i;
    if (scratch == NULL) return complain("chart", METRO_ERROR_MEMORY);
    chart.columns = 2;
    chart.width = 1300;
    for (c = 0; c < CHAINS; c++) {
        plot_series *line = plot_line(&chart.panel[0], e->draw + (size_t)c * draws, e->path + (size_t)c * draws,
                                      draws < 400 ? draws : 400, NULL);
        line->width = 1.2;
    }
    for (i = 0; i < LOOKS; i++) {
        size_t n = draws >> (LOOKS - 1 - i) > 16 ? draws >> (LOOKS - 1 - i) : 16;
        length[i] = (double)n;
        rhat[i] = rhat_so_far(e, draws, n, scratch);
        PLOT_CSV_ROW(&csv, length[i], rhat[i], metro_ess(scratch, CHAINS, n));
    }
    free(scratch);
    chart.panel[0].x_label = "$x$";
    chart.panel[0].y_label = "$y$";
    chart.panel[1].x_label = "steps of each chain";
    chart.panel[1].y_label = "R-hat of $x$";
    chart.panel[1].x_log = 1;
    plot_line(&chart.panel[1], length, rhat, LOOKS, "R-hat");
    plot_rule_y(&chart.panel[1], 1.01, "1.01");
    return plot_csv_close(&csv) | plot_save(&chart, "out/own.svg");
}

/* The questions, in the order in which they should be asked. */
static int ask(const experiment *e, size_t draws, const metro_balance *balance, const metro_moments *b,
               const metro_chain_counts *counts)
{
    const char *trouble = metro_draws_trouble(e->draw, CHAINS, draws);
    double n = (double)(CHAINS * draws), ess = metro_ess(e->draw, CHAINS, draws);
    printf("a state has 2 coordinates: x and y, where on the ridge; every one of them is moved by each proposal\n");
    printf("detailed balance: chi-square %.0f of %.0f, probability %.2g: %s\n", balance->chi_square, balance->freedom,
           balance->probability, balance->probability < 1e-6 ? "WRONG, check the ratio" : "nothing wrong is seen");
    printf("acceptance %.2f, longest stay %d, bad importances %d\n", (double)counts->accepted / (double)counts->steps,
           (int)counts->longest_stay, (int)(counts->nan + counts->negative + counts->infinite));
    printf("R-hat %.4f, bulk ESS %.0f and tail ESS %.0f of %.0f draws\n", metro_rhat(e->draw, CHAINS, draws), ess,
           metro_ess_tail(e->draw, CHAINS, draws), n);
    printf("b = %.5f +- %.5f\n", metro_moments_mean(b), metro_moments_error(b));
    printf("the mean of x is %.4f +- %.4f, from draws worth %.0f independent ones%s%s\n",
           metro_sum_value(&e->mean) / n, metro_mcse_mean(e->draw, CHAINS, draws), ess,
           trouble != NULL ? "; but: " : "", trouble != NULL ? trouble : "");
    return balance->probability < 1e-6;
}

int main(int argc, char **argv)
{
    /* The space: two intervals. Their kernels are not used, since the target proposes for itself. */
    metro_axis axes[2] = { { METRO_INTERVAL, { METRO_UNIFORM, 1, 0, 0 } },
                           { METRO_INTERVAL, { METRO_UNIFORM, 1, 0, 0 } } };
    size_t draws = plot_quick() ? 4000 : 100000;
    experiment e;
    metro_target target;
    metro_balance balance;
    metro_moments b = { 0, 0, 0, 0 };
    metro_chain_counts counts;
    metro_result result;
    int c, wrong;
    memset(&e, 0, sizeof e);
    memset(&target, 0, sizeof target);
    e.forget_ratio = argc > 1 && strcmp(argv[1], "wrong") == 0;
    e.draw = (double *)malloc(2 * CHAINS * draws * sizeof *e.draw);
    if (e.draw == NULL) return complain("draws", METRO_ERROR_MEMORY);
    e.path = e.draw + CHAINS * draws;
    target.axes = axes;
    target.axis_count = 2;
    target.sample_size = sizeof(point);
    target.importance = importance;
    target.propose = propose;
    target.record = record;
    target.user = &e;
    result = metro_balance_check(&target, NULL, 40 * draws, 16, metro_rng_make(2, 0), &balance);
    for (c = 0; c < CHAINS && result == METRO_OK; c++) result = run_chain(&target, c, draws, &b, &counts);
    if (result != METRO_OK) return complain("run", result);
    wrong = ask(&e, draws, &balance, &b, &counts) | draw_chart(&e, draws);
    free(e.draw);
    return wrong;
}
