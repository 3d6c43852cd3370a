/* fig1.c: the paper's figure 1, how p_n approaches the uniform density (section 2). Many chains start at one seed and
   make steps of full width 0.2 on a circle of length 1 under a constant importance. Theory gives the density p_n of
   where they are after n steps, paper (9); a histogram of the chains shows it with its counting error. To see: a box,
   a tent, soon a bell, and once the bell is as wide as the circle, hardly a trace of the seed.

   Writes out/fig1.csv (curves and histograms), out/fig1_summary.csv (a row for each n) and out/fig1.svg. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

/* Bins over the circle, points of the curve in a bin, and the groups of chains that run side by side */
enum { LOOKS = 6, BINS = 40, POINTS_PER_BIN = 10, POINTS = BINS * POINTS_PER_BIN, JOBS = 32 };

static const uint64_t look[LOOKS] = { 1, 2, 5, 10, 20, 50 };           /* when we look, in steps */
static const double highest[LOOKS] = { 5.5, 5.5, 3.3, 3.3, 1.8, 1.8 }; /* the top of each panel */
static const double seed = 0;
static const metro_axis circle = { METRO_CIRCLE, { METRO_UNIFORM, 0.2, 0, 0 } };

/* How many chains were in each bin of [-1/2, 1/2) at each look. */
typedef struct {
    uint64_t count[LOOKS][BINS];
} histograms;

typedef struct {
    uint64_t chains_per_job;
    histograms all;
} ensemble;

static double constant_importance(const double *z, void *sample, void *user)
{
    (void)z, (void)sample, (void)user;
    return 1;
}

/* One job: chains that start at the seed and are looked at as they go on. */
static metro_result run_chains(uint64_t job, void *slot, void *user)
{
    histograms *found = (histograms *)slot;
    metro_target target;
    metro_chain chain;
    metro_result result;
    uint64_t i;
    size_t k;
    memset(&target, 0, sizeof target);
    target.axes = &circle;
    target.axis_count = 1;
    target.importance = constant_importance;
    result = metro_chain_make(&target, NULL, metro_rng_make(1, job), &chain);
    if (result != METRO_OK) return result;
    for (i = 0; i < ((const ensemble *)user)->chains_per_job; i++) {
        metro_chain_start_point(&chain, &seed);
        for (k = 0; k < LOOKS; k++) {
            double x;
            metro_chain_run(&chain, look[k] - (k > 0 ? look[k - 1] : 0));
            x = chain.state[0] < 0.5 ? chain.state[0] + 0.5 : chain.state[0] - 0.5; /* the seed in the middle */
            found->count[k][(size_t)((double)BINS * x)]++;
        }
    }
    metro_chain_free(&chain);
    return METRO_OK;
}

static metro_result add_histograms(uint64_t job, const void *slot, void *user)
{
    histograms *all = &((ensemble *)user)->all;
    size_t k, bin;
    (void)job;
    for (k = 0; k < LOOKS; k++)
        for (bin = 0; bin < BINS; bin++) all->count[k][bin] += ((const histograms *)slot)->count[k][bin];
    return METRO_OK;
}

/* What is found at one n: theory on a fine grid, experiment in bins, and how they compare. */
typedef struct {
    double x[POINTS], density[POINTS], edge[BINS + 1], height[BINS], error[BINS];
    double farthest; /* the largest abs(p_n - 1) */
    double chi_square, freedom, score;
} comparison;

/* Pearson's chi-square of the counts; neighbouring bins are pooled until ten counts are expected. The score says how
   many standard deviations that is off (Wilson and Hilferty 1931: the cube root of chi-square is nearly normal). */
static void score_counts(const uint64_t *count, const double *expected, comparison *c)
{
    double seen = 0, due = 0, left = 0, width;
    size_t bin;
    c->chi_square = 0;
    c->freedom = -1;
    for (bin = 0; bin < BINS; bin++) left += expected[bin];
    for (bin = 0; bin < BINS; bin++) {
        seen += (double)count[bin];
        due += expected[bin];
        left -= expected[bin];
        if (bin + 1 < BINS && (due < 10 || left < 10)) continue;
        c->chi_square += (seen - due) * (seen - due) / due;
        c->freedom += 1;
        seen = due = 0;
    }
    width = 2 / (9 * c->freedom);
    c->score = (cbrt(c->chi_square / c->freedom) - (1 - width)) / sqrt(width);
}

/* Theory and experiment at one look. */
static void compare(const uint64_t *count, double chains, uint64_t n, comparison *c)
{
    double expected[BINS] = { 0 };
    size_t i;
    c->farthest = 0;
    for (i = 0; i < POINTS; i++) {
        c->x[i] = -0.5 + ((double)i + 0.5) / (double)POINTS;
        c->density[i] = metro_startup_density(&circle.kernel, n, c->x[i], &seed, NULL, 1);
        c->farthest = fmax(c->farthest, fabs(c->density[i] - 1));
        expected[i / POINTS_PER_BIN] += chains * c->density[i] / (double)POINTS;
    }
    for (i = 0; i < BINS; i++) {
        double part = (double)count[i] / chains;
        c->edge[i] = -0.5 + (double)i / (double)BINS;
        c->height[i] = (double)BINS * part;
        c->error[i] = (double)BINS * sqrt(part * (1 - part) / chains);
    }
    c->edge[BINS] = 0.5;
    score_counts(count, expected, c);
}

static void draw_panel(plot_panel *panel, const comparison *c)
{
    double bar_x[3 * BINS], bar_y[3 * BINS]; /* error bars: pieces of a line, each ended by a NaN */
    plot_series *line;
    size_t i;
    for (i = 0; i < BINS; i++) {
        bar_x[3 * i] = bar_x[3 * i + 1] = (c->edge[i] + c->edge[i + 1]) / 2;
        bar_y[3 * i] = c->height[i] - c->error[i];
        bar_y[3 * i + 1] = c->height[i] + c->error[i];
        bar_x[3 * i + 2] = bar_y[3 * i + 2] = (double)NAN;
    }
    panel->x_min = -0.5;
    panel->x_max = 0.5;
    plot_steps(panel, c->edge, c->height, BINS, "histogram of the chains")->color = plot_palette(5);
    line = plot_line(panel, c->x, c->density, POINTS, "exact $p_n$");
    line->color = plot_palette(1);
    line->place = PLOT_KEY;
    line = plot_line(panel, bar_x, bar_y, 3 * BINS, "1 standard error of the histogram");
    line->color = plot_palette(0);
    line->width = 2;
    line->place = PLOT_KEY;
    plot_rule_y(panel, 1, NULL);
}

static metro_result run_ensemble(ensemble *run, double chains)
{
    metro_rounds plan;
    memset(run, 0, sizeof *run);
    memset(&plan, 0, sizeof plan);
    run->chains_per_job = (uint64_t)chains / JOBS;
    plan.jobs = JOBS;
    plan.slot_size = sizeof(histograms);
    plan.work = run_chains;
    plan.merge = add_histograms;
    return metro_rounds_run(&plan, run);
}

int main(void)
{
    const double chains = plot_quick() ? 5120 : 20480;
    plot_csv csv = plot_csv_open("out/fig1.csv", "n,x,density,histogram,error");
    plot_csv summary = plot_csv_open("out/fig1_summary.csv", "n,startup_error,farthest,chi_square,freedom,score");
    plot_chart chart = plot_chart_make(NULL, NULL);
    char title[160], note[500], panel_title[LOOKS][100];
    static ensemble run;
    static comparison c;
    double worst = 0;
    size_t k, i;
    metro_result result = run_ensemble(&run, chains);
    if (result != METRO_OK) {
        fprintf(stderr, "fig1: %s\n", metro_result_text(result));
        return 1;
    }

    printf("%g chains that start at 0, steps of full width %g\n", chains, circle.kernel.size);
    printf("%5s %10s %14s %12s %8s %20s\n", "n", "E_n", "max |p_n - 1|", "chi-square", "freedom", "deviations off");
    for (k = 0; k < LOOKS; k++) {
        plot_panel *panel = &chart.panel[k];
        double n = (double)look[k], E = metro_startup_error(&circle.kernel, look[k]);
        compare(run.all.count[k], chains, look[k], &c);
        worst = fmax(worst, fabs(c.score));
        for (i = 0; i < POINTS; i++)
            PLOT_CSV_ROW(&csv, n, c.x[i], c.density[i], c.height[i / POINTS_PER_BIN], c.error[i / POINTS_PER_BIN]);
        PLOT_CSV_ROW(&summary, n, E, c.farthest, c.chi_square, c.freedom, c.score);
        printf("%5g %10.4g %14.4g %12.1f %8.0f %20.2f\n", n, E, c.farthest, c.chi_square, c.freedom, c.score);
        snprintf(panel_title[k], sizeof panel_title[k], "$n$ = %g: $E_n$ = %.3g, chi-square %.3g over %g", n, E,
                 c.chi_square, c.freedom);
        panel->title = panel_title[k];
        panel->x_label = k + 2 < LOOKS ? NULL : "position $x$, in lengths of the circle";
        panel->y_label = k % 2 == 0 ? "density $p_n(x)$" : NULL;
        panel->y_max = highest[k];
        draw_panel(panel, &c);
    }

    snprintf(title, sizeof title,
             "The seed is forgotten: after %d steps of size %g the density is within %.1f %% of "
             "uniform",
             (int)look[LOOKS - 1], circle.kernel.size, 100 * c.farthest);
    snprintf(
        note, sizeof note,
        "Read: each panel shows where %g chains that started at 0 are after $n$ steps, as a "
        "histogram with its counting error, and the exact density over it. Where they lie on each other, theory "
        "and experiment agree; chi-square says it in a number, to be compared with its degrees of freedom. Dashed: "
        "uniform. Each row has its own scale.",
        chains);
    chart.title = title;
    chart.note = note;
    chart.rows = LOOKS / 2;
    chart.columns = 2;
    chart.height = 1200;
    if (plot_csv_close(&csv) + plot_csv_close(&summary) + plot_save(&chart, "out/fig1.svg") > 0) return 1;
    if (!(worst < 5)) {
        fprintf(stderr, "fig1: a histogram is %.1f standard deviations off its exact density\n", worst);
        return 1;
    }
    printf("histograms of %g chains agree with the exact p_n at %d values of n (the worst chi-square is %.1f "
           "standard deviations off); after %d steps of size %g p_n is within %.1f %% of uniform\n",
           chains, LOOKS, worst, (int)look[LOOKS - 1], circle.kernel.size, 100 * c.farthest);
    return 0;
}
