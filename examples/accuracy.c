/* accuracy.c: speed against accuracy, for each way of computing that chapters 5 to 7 offer. It belongs to the
   whole paper: before one believes a curve, one asks how far off it is, and what it cost.

   - The start-up error: paper (12) as printed, a series of K terms, and metro_startup_error, against exact
     values.
   - The operator: the mean squared error of a run, on a circle of more and more cells.
   - The ensemble: E_n^2 measured with more and more chains.
   - The size of the perturbation: how many evaluations of the importance are worth an independent sample.

   See: in the first three panels down and left is better. At n = 1 the series gains one digit for every ten times
   as many terms, and never arrives; the library stands at the rounding of a double. Cells and chains buy accuracy
   at a known price. The fourth panel has no time axis: a good size costs little more than a bad one, and down is
   better.

   Reads tests/data/fourier_uniform.csv, so run it from the top of the project. Writes out/accuracy.svg and
   out/accuracy.csv. There, the parameter is the number of terms (0: the library), of cells, of chains, or Delta;
   value is the relative error, but for `size` the evaluations; deviation is what the ensembles were really off;
   seconds are those of one value, but for `size` of one step. */

#define _POSIX_C_SOURCE 200809L
#include <time.h>
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { CASES = 4, SHAPES = 3, MOST = 24, COUNTS = 5, REPEATS = 32 };

static const double pi = 3.14159265358979323846;
static const char *const shape_name[SHAPES] = { "constant", "exponential", "two peaks" };

static int complain(const char *what)
{
    fprintf(stderr, "accuracy: %s\n", what);
    return 1;
}

static double seconds_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* The time of one call of `task`, the best of seven tries of a millisecond or more, of three where a call takes long.
   Its value goes to `value`. */
static double seconds_of(double (*task)(void *context), void *context, double *value)
{
    double best = 1e9;
    int tries, calls = 1, i;
    for (tries = 0; tries < 7 && !(tries > 2 && best > 1e-2); tries++) {
        double start = seconds_now(), one;
        for (i = 0; i < calls; i++) *value = task(context);
        one = (seconds_now() - start) / calls;
        best = fmin(best, one);
        if (one < 1e-3) calls = (int)(1e-3 / (one + 1e-8)) + 1;
    }
    return best;
}

static double importance(double x, int shape)
{
    double left = (x - 0.25) / 0.03, right = (x - 0.75) / 0.03;
    if (shape == 0) return 1;
    return shape == 1 ? exp(-10 * fabs(x - 0.5)) : 1e-4 + exp(-left * left / 2) + exp(-right * right / 2);
}

static double target_importance(const double *z, void *sample, void *user)
{
    (void)sample;
    return importance(*z, *(const int *)user);
}

/* A curve as rows of the table. */
static void write_down(plot_csv *csv, const char *chart, const char *curve, const double *parameter,
                       const double *value, const double *deviation, const double *seconds, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++) {
        plot_csv_text(csv, chart);
        plot_csv_text(csv, curve);
        PLOT_CSV_ROW(csv, parameter[i], value[i], deviation != NULL ? deviation[i] : NAN, seconds[i]);
    }
}

/* ---- The start-up error ---- */

typedef struct {
    metro_kernel kernel;
    uint64_t n;
    long terms;
} series;

/* Paper (12) with paper (17), as one would write it down. */
static double plain(void *context)
{
    const series *s = (const series *)context;
    double sum = 0;
    long k;
    for (k = 1; k <= s->terms; k++) {
        double angle = pi * (double)k * s->kernel.size;
        sum += pow(sin(angle) / angle, 2.0 * (double)s->n);
    }
    return sqrt(2 * sum);
}

static double library(void *context)
{
    const series *s = (const series *)context;
    return metro_startup_error(&s->kernel, s->n);
}

/* The exact E_n of the reference table; NaN if it is not there. */
static double exact(double size, double n)
{
    char line[256], *at;
    double value = NAN;
    FILE *file = fopen("tests/data/fourier_uniform.csv", "r");
    while (file != NULL && fgets(line, sizeof line, file) != NULL)
        if (strtod(line, &at) == size && *at == ',' && strtod(at + 1, &at) == n && *at == ',')
            value = strtod(at + 1, NULL);
    if (file != NULL) fclose(file);
    return value;
}

static int chart_fourier(plot_panel *panel, plot_csv *csv, double *worst_plain, double *worst_library)
{
    static const double size[CASES] = { 0.01, 0.1, 0.001, 0.1 };
    static const uint64_t n[CASES] = { 1, 2, 10, 20 };
    double terms[MOST], error[MOST], seconds[MOST], value, truth;
    char name[60], label[60];
    size_t c, count;
    panel->title = "start-up error: series and library";
    panel->x_label = "time of one value, seconds";
    panel->y_label = "relative error of $E_n$";
    panel->y_min = 1e-21;
    for (c = 0; c < CASES; c++) {
        series s = { { METRO_UNIFORM, 0, 0, 0 }, 0, 1 };
        plot_series *point;
        s.kernel.size = size[c];
        s.n = n[c];
        snprintf(name, sizeof name, "Delta=%g n=%d", size[c], (int)n[c]);
        snprintf(label, sizeof label, "$Delta$ = %g, $n$ = %d", size[c], (int)n[c]);
        truth = exact(size[c], (double)n[c]);
        if (!(truth > 0)) return complain("no tests/data/fourier_uniform.csv; run from the top of the project");
        /* 1, 3, 10, 30, ... terms */
        for (count = 0; s.terms <= (plot_quick() ? 100000 : 1000000) && count < MOST; count++) {
            terms[count] = (double)s.terms;
            seconds[count] = seconds_of(plain, &s, &value);
            error[count] = fmax(fabs(value - truth) / truth, 1e-17);
            s.terms = count % 2 == 0 ? 3 * s.terms : s.terms / 3 * 10;
        }
        *worst_plain = fmax(*worst_plain, error[count - 1]);
        write_down(csv, "fourier", name, terms, error, NULL, seconds, count);
        plot_line(panel, seconds, error, count, label)->color = plot_palette(c);
        terms[0] = 0;
        seconds[0] = seconds_of(library, &s, &value);
        error[0] = fmax(fabs(value - truth) / truth, 1e-17);
        *worst_library = fmax(*worst_library, error[0]);
        write_down(csv, "fourier", name, terms, error, NULL, seconds, 1);
        point = plot_points(panel, seconds, error, NULL, 1, NULL);
        point->color = plot_palette(c);
        point->marker = 2;
    }
    return 0;
}

/* ---- The operator ---- */

typedef struct {
    int shape;
    double size;
    size_t cells;
    uint64_t steps;
} run;

/* The exact mean squared error on a grid, from random seeds, of the share of the left half of the circle; NaN for
   want of memory. All three importances are symmetric, so the share is 1/2 and its variance 1/4. */
static double operator_error(void *context)
{
    const run *r = (const run *)context;
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    metro_operator op;
    metro_operator_error error;
    double *cell = (double *)malloc(2 * r->cells * sizeof *cell);
    size_t i;
    if (cell == NULL) return NAN;
    for (i = 0; i < r->cells; i++) {
        cell[i] = importance(((double)i + 0.5) / (double)r->cells, r->shape);
        cell[r->cells + i] = i < r->cells / 2;
    }
    kernel.size = r->size;
    error.mse = NAN;
    if (metro_operator_make(&kernel, cell, r->cells, &op) == METRO_OK) {
        if (metro_operator_run(&op, cell + r->cells, 0, r->steps, NULL, NULL, &error) != METRO_OK) error.mse = NAN;
        metro_operator_free(&op);
    }
    free(cell);
    return error.mse;
}

static int chart_operator(plot_panel *panel, plot_csv *csv, double *order)
{
    static const double size[SHAPES] = { 0.3, 0.3, 1.2 };
    size_t last = plot_quick() ? 256 : 512, count;
    double cells[MOST], error[MOST], seconds[MOST], value, truth;
    int shape;
    panel->title = "operator: mean squared error of 100 samples";
    panel->x_label = plot_say(panel, "time with 16 to % cells, seconds", (double)last);
    panel->y_label = "relative error";
    for (shape = 0; shape < SHAPES; shape++) {
        run r = { 0, 0, 0, 100 };
        r.shape = shape;
        r.size = size[shape];
        /* the truth by extrapolation (Richardson 1911): from here on the error is a quarter on twice as many cells */
        r.cells = 2 * last;
        truth = operator_error(&r);
        r.cells = last;
        truth += (truth - operator_error(&r)) / 3;
        for (count = 0, r.cells = 16; r.cells <= last; r.cells *= 2, count++) {
            cells[count] = (double)r.cells;
            seconds[count] = seconds_of(operator_error, &r, &value);
            error[count] = fmax(fabs(value - truth) / truth, 1e-17);
        }
        if (!(truth > 0)) return complain("the operator needs more memory");
        if (shape == 0) *order = log(error[0] / error[count - 1]) / log(cells[count - 1] / cells[0]);
        write_down(csv, "operator", shape_name[shape], cells, error, NULL, seconds, count);
        plot_line(panel, seconds, error, count, shape_name[shape]);
    }
    return 0;
}

/* ---- The ensemble ---- */

static int chart_ensemble(plot_panel *panel, plot_csv *csv, double *ratio)
{
    static const uint64_t n = 20;
    static const double seed = 0;
    static int constant = 0;
    metro_axis axis = { METRO_CIRCLE, { METRO_UNIFORM, 0.1, 0, 0 } };
    metro_target target;
    metro_ensemble ensemble;
    double chains[COUNTS], error[COUNTS], deviation[COUNTS], seconds[COUNTS], slope[COUNTS], truth = 0, sum = 0;
    double repeats = REPEATS;
    plot_series *line;
    int i, k;
    memset(&target, 0, sizeof target);
    memset(&ensemble, 0, sizeof ensemble);
    target.axes = &axis;
    target.axis_count = 1;
    target.importance = target_importance;
    target.user = &constant;
    ensemble.target = &target;
    ensemble.seed = &seed;
    ensemble.seeds = 1;
    ensemble.steps = &n;
    ensemble.times = 1;
    ensemble.harmonics = 16;
    /* what the ensemble measures: the first harmonics of paper (12) */
    for (k = 1; k <= 16; k++) truth += 2 * pow(metro_kernel_coefficient(&axis.kernel, k), 2.0 * (double)n);
    for (i = 0; i < COUNTS; i++) {
        ensemble.chains = (uint64_t)(plot_quick() ? 128 : 512) << 2 * i;
        chains[i] = (double)ensemble.chains;
        error[i] = deviation[i] = 0;
        seconds[i] = 1e9;
        for (k = 0; k < REPEATS; k++) {
            double squared, one, start = seconds_now();
            metro_result result;
            ensemble.random_seed = (uint64_t)(REPEATS * i + k);
            result = metro_ensemble_measure(&ensemble, &squared, &one);
            if (result != METRO_OK) return complain(metro_result_text(result));
            seconds[i] = fmin(seconds[i], seconds_now() - start);
            error[i] += one * one / repeats;
            deviation[i] += (squared - truth) * (squared - truth) / repeats;
        }
        sum += deviation[i] / error[i] / (double)COUNTS;
        error[i] = sqrt(error[i]) / truth;
        deviation[i] = sqrt(deviation[i]) / truth;
    }
    *ratio = sqrt(sum);
    for (i = 0; i < COUNTS; i++) slope[i] = error[COUNTS - 1] * sqrt(seconds[COUNTS - 1] / seconds[i]);
    panel->title = "ensemble: $E_{20}^2$ at $Delta$ = .1, measured";
    panel->x_label = plot_say(panel, "time with up to % chains, seconds", chains[COUNTS - 1]);
    panel->y_label = "error relative to $E_{20}^2$";
    write_down(csv, "ensemble", "E_20^2", chains, error, deviation, seconds, COUNTS);
    line = plot_line(panel, seconds, slope, COUNTS, "slope -1/2");
    line->color = 0x888888;
    line->dash = 1;
    line->width = 2;
    line = plot_line(panel, seconds, error, COUNTS, "standard error that the ensemble states");
    line->place = PLOT_KEY;
    plot_points(panel, seconds, deviation, NULL, COUNTS, plot_say(panel, "its real deviation, over % runs", repeats))
        ->color = line->color;
    return 0;
}

/* ---- The size of the perturbation ---- */

static double thousand_steps(void *context)
{
    metro_chain *chain = (metro_chain *)context;
    metro_chain_run(chain, 1000);
    return chain->state[0];
}

/* The time of a step of the general chain; NaN for want of memory. */
static double seconds_of_step(int shape, double size)
{
    static const double start = 0.25;
    metro_axis axis = { METRO_CIRCLE, { METRO_UNIFORM, 0, 0, 0 } };
    metro_target target;
    metro_chain chain;
    double seconds = NAN, value;
    memset(&target, 0, sizeof target);
    axis.kernel.size = size;
    target.axes = &axis;
    target.axis_count = 1;
    target.importance = target_importance;
    target.user = &shape;
    if (metro_chain_make(&target, NULL, metro_rng_make(1, 0), &chain) != METRO_OK) return seconds;
    if (metro_chain_start_point(&chain, &start) == METRO_OK)
        seconds = seconds_of(thousand_steps, &chain, &value) / 1000;
    metro_chain_free(&chain);
    return seconds;
}

static int chart_size(plot_panel *panel, plot_csv *csv, double *least, double *most)
{
    size_t count = plot_quick() ? 12 : MOST, i;
    double size[MOST], cost[MOST], seconds[MOST];
    plot_series *line;
    int shape;
    panel->title = "size: mean squared error times cost";
    panel->x_label = "size of the perturbation $Delta$";
    panel->y_label = "evaluations that are worth one independent sample";
    for (shape = 0; shape < SHAPES; shape++) {
        run r = { 0, 0, 64, 1000 };
        r.shape = shape;
        for (i = 0; i < count; i++) {
            size[i] = r.size = 0.02 * pow(100, (double)i / (double)(count - 1));
            cost[i] = operator_error(&r) * (double)r.steps / 0.25;
            seconds[i] = seconds_of_step(shape, r.size);
            if (!(cost[i] > 0 && seconds[i] > 0)) return complain("the operator and the chain need more memory");
            *least = fmin(*least, cost[i]);
            *most = fmax(*most, cost[i]);
        }
        write_down(csv, "size", shape_name[shape], size, cost, NULL, seconds, count);
        plot_line(panel, size, cost, count, shape_name[shape])->color = plot_palette((size_t)shape);
        for (i = 0; i < count; i++) cost[i] *= seconds[i] / seconds[0];
        line = plot_line(panel, size, cost, count, "fourth panel: the same in time, in steps of the smallest size");
        line->color = plot_palette((size_t)shape);
        line->place = PLOT_KEY;
        line->dash = 2;
        line->width = 2;
    }
    plot_rule_y(panel, 1, "independent samples");
    return 0;
}

int main(void)
{
    double worst_plain = 0, worst_library = 0, order = 0, ratio = 0, least = 1e9, most = 0;
    char title[160];
    plot_chart chart = plot_chart_make(
        NULL, "In the first three panels down and left is better, in the fourth down. Lines in the first are the "
              "paper's series, diamonds the library; errors below 1e-17 are drawn there.");
    plot_csv csv = plot_csv_open("out/accuracy.csv", "chart,curve,parameter,value,deviation,seconds");
    int i;
    chart.rows = chart.columns = 2;
    chart.width = 1300;
    for (i = 0; i < 4; i++) {
        chart.panel[i].x_log = chart.panel[i].y_log = 1;
        if (i < 3) chart.panel[i].better = "down and left is better";
    }
    if (chart_fourier(&chart.panel[0], &csv, &worst_plain, &worst_library) != 0) return 1;
    plot_progress(0.3, "accuracy");
    if (chart_operator(&chart.panel[1], &csv, &order) != 0) return 1;
    plot_progress(0.5, "accuracy");
    if (chart_ensemble(&chart.panel[2], &csv, &ratio) != 0) return 1;
    plot_progress(0.8, "accuracy");
    if (chart_size(&chart.panel[3], &csv, &least, &most) != 0) return 1;
    plot_progress(1, "accuracy");
    snprintf(title, sizeof title,
             "What accuracy costs: the paper's series is off by %.0e after %s terms, the library by %.0e",
             worst_plain, plot_quick() ? "a hundred thousand" : "a million", worst_library);
    chart.title = title;
    if ((plot_csv_close(&csv) | plot_save(&chart, "out/accuracy.svg")) != 0) return 1;
    printf("E_n against exact values: the library is off by %.1e at most, the longest series by %.1e\n",
           worst_library, worst_plain);
    printf("the operator's error falls with the power %.2f of the number of cells\n", order);
    printf("ensembles are really off by %.2f of the standard error that they state\n", ratio);
    printf("%.2g to %.2g evaluations are worth an independent sample, by the size of the perturbation\n", least,
           most);
    printf("E_n is right to %.0e where the longest series is off by %.0e, and the operator's error falls with the "
           "power %.1f of its cells\n", worst_library, worst_plain, order);
    return 0;
}
