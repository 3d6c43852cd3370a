/* operator.c: which size should the perturbation have? Section 4 of the paper calls the answer its ultimate goal.

   Five importances, from a flat one to two narrow peaks. For each, the operator of chapter 6 gives the exact mean
   squared error of a run of 1000 samples that starts anywhere and estimates how much of the importance lies in
   the left half of the circle, a picture of two pixels; no chain is simulated. Three rules then choose a size:

   - metro_best_size looks at 64 points of the importance and minimises the error that it predicts from them;
   - the largest spectral gap, the rate at which the slowest mode fades;
   - larger steps until only .44 of the proposals are accepted, or up to the largest size, 2.

   See: the valley of the error lies elsewhere for each importance, and only the first rule finds it every time.
   With two peaks the acceptance rule is content with steps that stay on one, and nothing that it measures looks
   wrong.

   Writes out/operator.svg and out/operator.csv (the sweeps), out/operator_rules.svg and out/operator_rules.csv
   (what the rules chose; efficiency of metro_best_size: the worst over its random points). */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

static const double pi = 3.14159265358979323846;

enum { SHAPES = 5, RULES = 3, MOST = 64, STEPS = 1000, FINE = 10 };

static const char *const shape_name[SHAPES] = { "constant", "one wave", "exponential", "one peak", "two peaks" };
static const char *const shape_title[SHAPES] = {
    "constant: $I = 1$", "one wave: $1 + .9 cos 2 pi x$", "exponential: $exp(-10 |x - 1/2|)$",
    "one peak of width .02 on a floor of .01", "two peaks of width .03 on a floor of .0001"
};
static const char *const rule_name[RULES] = { "metro_best_size", "largest gap", "acceptance .44" };
static const uint32_t rule_color[RULES] = { 0x009e73, 0xcc79a7, 0xe69f00 };

static double bump(double x, double centre, double width)
{
    return exp(-(x - centre) * (x - centre) / (2 * width * width));
}

static double importance(double x, void *user)
{
    switch (*(const int *)user) {
    case 0: return 1;
    case 1: return 1 + 0.9 * cos(2 * pi * x);
    case 2: return exp(-10 * fabs(x - 0.5));
    case 3: return 0.01 + bump(x, 0.5, 0.02);
    default: return 1e-4 + bump(x, 0.25, 0.03) + bump(x, 0.75, 0.03);
    }
}

/* What the operator says of one importance and one size. */
typedef struct {
    double size, mse, bias2, gap, acceptance;
} outcome;

/* A list of sizes for one importance; each size is a job. */
typedef struct {
    int shape, with_gap;
    size_t cells;
    outcome *row;
} sweep;

static metro_result sweep_work(uint64_t job, void *slot, void *user)
{
    const sweep *s = (const sweep *)user;
    outcome *out = (outcome *)slot;
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    metro_operator op;
    metro_operator_error error;
    metro_spectrum spectrum = { 0, 0, 0 };
    metro_result result = METRO_ERROR_MEMORY;
    size_t i, n = s->cells;
    int shape = s->shape;
    double *cell = (double *)malloc(2 * n * sizeof *cell);
    if (cell == NULL) return result;
    for (i = 0; i < n; i++) {
        cell[i] = importance(((double)i + 0.5) / (double)n, &shape);
        cell[n + i] = i < n / 2;
    }
    kernel.size = s->row[job].size;
    result = metro_operator_make(&kernel, cell, n, &op);
    if (result == METRO_OK) {
        result = metro_operator_run(&op, cell + n, 0, STEPS, NULL, NULL, &error);
        if (result == METRO_OK && s->with_gap) result = metro_operator_spectrum(&op, NULL, NULL, &spectrum);
        out->acceptance = op.acceptance;
        metro_operator_free(&op);
    }
    if (result == METRO_OK) {
        out->size = kernel.size;
        out->mse = error.mse;
        out->bias2 = error.bias2;
        out->gap = spectrum.gap;
    }
    free(cell);
    return result;
}

static metro_result sweep_merge(uint64_t job, const void *slot, void *user)
{
    ((sweep *)user)->row[job] = *(const outcome *)slot;
    return METRO_OK;
}

static metro_result sweep_run(sweep *s, outcome *row, size_t count)
{
    metro_rounds plan;
    memset(&plan, 0, sizeof plan);
    plan.jobs = count;
    plan.slot_size = sizeof(outcome);
    plan.work = sweep_work;
    plan.merge = sweep_merge;
    s->row = row;
    return metro_rounds_run(&plan, s);
}

static size_t least_error(const outcome *row, size_t count)
{
    size_t i, best = 0;
    for (i = 1; i < count; i++)
        if (row[i].mse < row[best].mse) best = i;
    return best;
}

/* What the rules choose: the outcome, the error that the rule predicted, and the efficiency. */
typedef struct {
    outcome chosen;
    double predicted, efficiency;
} choice;

/* The rules that only look at the sweep. */
static void choose_by_rules(const outcome *row, size_t count, choice *rule)
{
    size_t i, gap = 0, rate = 0;
    for (i = 0; i < count; i++)
        if (row[i].gap > row[gap].gap) gap = i;
    while (rate + 1 < count && row[rate].acceptance > 0.44) rate++;
    rule[1].chosen = row[gap];
    rule[2].chosen = row[rate];
    rule[1].predicted = rule[2].predicted = NAN;
}

/* The sweep, the rules, and the true optimum by a finer sweep around the least error. The pilots are choices of
   metro_best_size with other random points: the first one is kept, with the efficiency of the worst. */
static metro_result examine(sweep *s, outcome *row, size_t count, size_t pilots, choice *rule)
{
    outcome pilot[MOST], fine[FINE];
    metro_best best;
    metro_best_options options = { NULL, NULL, 0 };
    metro_result result;
    size_t i, at;
    double least;
    for (i = 0; i < count; i++) row[i].size = 0.02 * pow(100, (double)i / (double)(count - 1));
    s->with_gap = 1;
    result = sweep_run(s, row, count);
    choose_by_rules(row, count, rule);
    at = least_error(row, count);
    for (i = 0; i < FINE; i++) {
        double low = row[at > 0 ? at - 1 : 0].size, high = row[at + 1 < count ? at + 1 : at].size;
        fine[i].size = low + (high - low) * (double)i / (double)(FINE - 1);
    }
    for (i = pilots; i-- > 0 && result == METRO_OK;) {
        options.seed = i;
        result = metro_best_size(importance, &s->shape, STEPS, &options, &best);
        pilot[i].size = best.size;
    }
    s->with_gap = 0;
    if (result == METRO_OK) result = sweep_run(s, fine, FINE);
    if (result == METRO_OK) result = sweep_run(s, pilot, pilots);
    if (result != METRO_OK) return result;
    rule[0].chosen = pilot[0];
    rule[0].predicted = best.bias2 + best.variance;
    least = fmin(fmin(row[at].mse, fine[least_error(fine, FINE)].mse), pilot[least_error(pilot, pilots)].mse);
    for (i = 0; i < RULES; i++) rule[i].efficiency = least / rule[i].chosen.mse;
    for (i = 0; i < pilots; i++) rule[0].efficiency = fmin(rule[0].efficiency, least / pilot[i].mse);
    return METRO_OK;
}

/* One panel: the exact error against the size, its two parts, and what the rules chose. */
static void draw_sweep(plot_panel *panel, int shape, const outcome *row, size_t count, const choice *rule)
{
    double x[MOST], mse[MOST], bias2[MOST], variance[MOST];
    char text[100];
    plot_series *series;
    size_t i;
    for (i = 0; i < count; i++) {
        x[i] = row[i].size;
        mse[i] = row[i].mse;
        bias2[i] = row[i].bias2 > 1e-9 ? row[i].bias2 : NAN;
        variance[i] = row[i].mse - row[i].bias2;
    }
    panel->title = shape_title[shape];
    panel->x_log = panel->y_log = 1;
    panel->y_min = 1e-6;
    panel->y_max = 0.5;
    panel->x_label = "size of the perturbation $Delta$, as a part of the circle";
    panel->y_label = "mean squared error";
    series = plot_line(panel, x, mse, count, NULL);
    series->color = 0xbbbbbb;
    series->width = 9;
    series = plot_line(panel, x, variance, count, "variance");
    series->color = plot_palette(0);
    series->width = 2;
    series = plot_line(panel, x, bias2, count, "bias$^2$");
    series->color = plot_palette(1);
    series->dash = 1;
    for (i = RULES; i-- > 0;) {
        double predicted = i == 0 ? rule[i].predicted : rule[i].chosen.mse;
        series = plot_points(panel, &rule[i].chosen.size, &predicted, NULL, 1, rule_name[i]);
        series->color = rule_color[i];
        series->marker = (int)(3 - i);
    }
    snprintf(text, sizeof text, "%.3g: predicted %.2g, exact %.2g", rule[0].chosen.size, rule[0].predicted,
             rule[0].chosen.mse);
    plot_note(panel, rule[0].chosen.size, rule[0].predicted, text)->color = rule_color[0];
}

static void draw_shapes(plot_panel *panel)
{
    double x[401], y[401], most;
    int shape, i;
    panel->title = "the five importances";
    panel->x_label = "place on the circle $x$";
    panel->y_label = "importance, relative to its largest value";
    panel->y_log = 1;
    for (shape = 0; shape < SHAPES; shape++) {
        for (i = 0, most = 0; i <= 400; i++) {
            x[i] = i / 400.0;
            y[i] = importance(x[i], &shape);
            most = fmax(most, y[i]);
        }
        for (i = 0; i <= 400; i++) y[i] /= most;
        plot_line(panel, x, y, 401, shape_name[shape]);
    }
}

static int draw_rules(choice rule[SHAPES][RULES], const double *worst, size_t pilots)
{
    char title[160];
    plot_chart chart = plot_chart_make(
        NULL, "Efficiency: the least possible mean squared error, as a part of the one at the chosen size. 1 is the "
              "best that can be; at .5 the same error takes twice as many samples.");
    plot_csv csv = plot_csv_open("out/operator_rules.csv",
                                 "importance,rule,Delta,mse,predicted,acceptance,efficiency");
    double value[SHAPES];
    int shape, r;
    for (shape = 0; shape < SHAPES; shape++)
        for (r = 0; r < RULES; r++) {
            const choice *c = &rule[shape][r];
            plot_csv_text(&csv, shape_name[shape]);
            plot_csv_text(&csv, rule_name[r]);
            PLOT_CSV_ROW(&csv, c->chosen.size, c->chosen.mse, c->predicted, c->chosen.acceptance, c->efficiency);
        }
    snprintf(title, sizeof title,
             "The predicted error never chooses worse than %.2f of the best; the gap falls to %.2g, the acceptance "
             "rate to %.1g", worst[0], worst[1], worst[2]);
    chart.title = title;
    chart.panel[0].x_max = 1;
    chart.panel[0].x_label = "efficiency against the best size";
    for (r = 0; r < RULES; r++) {
        const char *label = plot_say(&chart.panel[0], "metro_best_size, worst of % draws", (double)pilots);
        if (r > 0) label = rule_name[r];
        for (shape = 0; shape < SHAPES; shape++) value[shape] = rule[shape][r].efficiency;
        plot_bars(&chart.panel[0], shape_name, value, NULL, SHAPES, label)->color = rule_color[r];
    }
    return plot_csv_close(&csv) | plot_save(&chart, "out/operator_rules.svg");
}

int main(void)
{
    size_t count = plot_quick() ? 20 : 48, pilots = plot_quick() ? 3 : 10, i;
    outcome row[MOST];
    choice rule[SHAPES][RULES];
    double worst[RULES] = { 1, 1, 1 }, smallest = 2, largest = 0;
    char title[120];
    sweep s = { 0, 0, 0, NULL };
    int r;
    plot_chart chart = plot_chart_make(
        NULL, "Grey: the exact mean squared error of 1000 samples from a random seed, the sum of variance and "
              "squared bias. Markers: the sizes that three rules choose. The lowest point of the grey curve is "
              "best.");
    plot_csv csv = plot_csv_open("out/operator.csv", "importance,Delta,mse,bias2,variance,gap,acceptance");
    chart.rows = 3;
    chart.columns = 2;
    chart.width = 1200;
    draw_shapes(&chart.panel[0]);
    s.cells = plot_quick() ? 96 : 192;
    printf("%-14s %24s %24s %24s\n", "", rule_name[0], rule_name[1], rule_name[2]);
    for (s.shape = 0; s.shape < SHAPES; s.shape++) {
        metro_result result = examine(&s, row, count, pilots, rule[s.shape]);
        if (result != METRO_OK) {
            fprintf(stderr, "operator: %s: %s\n", shape_name[s.shape], metro_result_text(result));
            return 1;
        }
        draw_sweep(&chart.panel[1 + s.shape], s.shape, row, count, rule[s.shape]);
        for (i = 0; i < count; i++) {
            plot_csv_text(&csv, shape_name[s.shape]);
            PLOT_CSV_ROW(&csv, row[i].size, row[i].mse, row[i].bias2, row[i].mse - row[i].bias2, row[i].gap,
                         row[i].acceptance);
        }
        smallest = fmin(smallest, rule[s.shape][0].chosen.size);
        largest = fmax(largest, rule[s.shape][0].chosen.size);
        printf("%-14s", shape_name[s.shape]);
        for (r = 0; r < RULES; r++) {
            const choice *c = &rule[s.shape][r];
            worst[r] = fmin(worst[r], c->efficiency);
            printf("  Delta %5.3f, efficiency %.2g", c->chosen.size, c->efficiency);
        }
        printf("\n");
        plot_progress((s.shape + 1) / (double)SHAPES, "operator");
    }
    snprintf(title, sizeof title,
             "The best size depends on the importance: here %.3g to %.3g, and 64 points find it", smallest, largest);
    chart.title = title;
    if ((plot_csv_close(&csv) | plot_save(&chart, "out/operator.svg")) != 0) return 1;
    if (draw_rules(rule, worst, pilots) != 0) return 1;
    printf("the size of least predicted error has at least %.2f of the best efficiency on all %d importances, the "
           "largest gap %.2f, acceptance .44 only %.2g\n", worst[0], (int)SHAPES, worst[1], worst[2]);
    return 0;
}
