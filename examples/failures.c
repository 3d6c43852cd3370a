/* failures.c: where methods fail, seen. Four sheets, and the sections of the paper they belong to:

   - out/failures.svg (section 1.1): four mistakes in a Metropolis step, each of a line or less. The target is flat,
     so any density but 1 is wrong; the check of detailed balance finds each mistake without knowing the answer.
   - out/failures_islands.svg: two islands farther apart than a step. Chains agree as long as all sit on one island.
   - out/failures_acceptance.svg (section 2.3): the mean squared error against the acceptance rate, for all sizes of
     the perturbation. No rate is the right one.
   - out/failures_numbers.svg (section 2.2): a sum cut too early, and a norm that measures the grid.

   All numbers are in out/failures.csv, one a row: sheet, case, x, quantity, value and standard error (nan: none). */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { STEPS = 6, GROUPS = 20, BINS = 40 };                            /* of the first sheet, */
enum { VOYAGES = 3, CHAINS = 4, DRAWS = 20000, SHOWN = 500 };          /* the second, */
enum { TARGETS = 3, SIZES = 40, CELLS = 128, RUN = 1000 };             /* the third, */
enum { CUTS = 3, POINTS = 20, GRIDS = 5, FIRST_GRID = 64, AFTER = 4 }; /* and the last */

static const double width = 0.2; /* Delta, where the size is not what varies */

#define NONE ((double)NAN) /* no x, or no error */

static int complain(const char *what, metro_result result)
{
    fprintf(stderr, "failures: %s: %s\n", what, metro_result_text(result));
    return 1;
}

/* The table: one number a row. */
static plot_csv csv;

static void put(const char *sheet, const char *name, double x, const char *quantity, double value, double error)
{
    plot_csv_text(&csv, sheet);
    plot_csv_text(&csv, name);
    plot_csv_number(&csv, x);
    plot_csv_text(&csv, quantity);
    PLOT_CSV_ROW(&csv, value, error);
}

static metro_target target_on(const metro_axis *axis, double (*importance)(const double *, void *, void *))
{
    metro_target target;
    memset(&target, 0, sizeof target);
    target.axes = axis;
    target.axis_count = 1;
    target.importance = importance;
    return target;
}

/* ---- Mistakes in a step. The target is 1 on [0, 1) and 0 outside; the steps differ in their proposal only. ---- */

static double flat(const double *z, void *sample, void *user)
{
    (void)sample, (void)user;
    return z[0] >= 0 && z[0] < 1;
}

/* Right: what falls outside is rejected, and the state counts once more. */
static double plain(const double *from, double *to, metro_rng *rng, void *user)
{
    (void)user;
    to[0] = from[0] + width * (metro_rng_uniform(rng) - 0.5);
    return 1;
}

static double clamped(const double *from, double *to, metro_rng *rng, void *user)
{
    plain(from, to, rng, user);
    if (to[0] < 0) to[0] = 0;
    if (to[0] >= 1) to[0] = 1 - 1e-16;
    return 1;
}

/* Only accepted states count: on a flat target the same as to try again until one is inside. */
static double dropped(const double *from, double *to, metro_rng *rng, void *user)
{
    do plain(from, to, rng, user);
    while (!(to[0] >= 0 && to[0] < 1));
    return 1;
}

/* Right: seven steps in ten go to the right, and the ratio T(to -> from)/T(from -> to) makes up for it. */
static double uneven(const double *from, double *to, metro_rng *rng, void *user)
{
    double right = metro_rng_uniform(rng) < 0.7 ? 1 : 0;
    (void)user;
    to[0] = from[0] + width / 2 * (right - metro_rng_uniform(rng));
    return right > 0 ? 0.3 / 0.7 : 0.7 / 0.3;
}

/* The listing of the paper has T(i -> t) above and below, which cancels. */
static double cancelled(const double *from, double *to, metro_rng *rng, void *user)
{
    uneven(from, to, rng, user);
    return 1;
}

static double upside_down(const double *from, double *to, metro_rng *rng, void *user)
{
    return 1 / uneven(from, to, rng, user);
}

static const struct {
    const char *key, *name;
    double (*propose)(const double *from, double *to, metro_rng *rng, void *user);
    int wrong;
    uint32_t color;
} step_kind[STEPS] = { { "right", "right", plain, 0, 0x222222 },
                       { "uneven", "right, uneven steps", uneven, 0, 0x888888 },
                       { "clamped", "border clamped", clamped, 1, 0xd55e00 },
                       { "dropped", "rejection dropped", dropped, 1, 0x0072b2 },
                       { "cancelled", "T cancelled", cancelled, 1, 0xcc79a7 },
                       { "upside_down", "T upside down", upside_down, 1, 0x009e73 } };

/* Adds the histogram of a chain from a random point to `density`, and its part in the outer bins to `outer`. */
static metro_result walk(const metro_target *target, metro_rng rng, uint64_t steps, double *density,
                         metro_moments *outer)
{
    double start = metro_rng_uniform(&rng), edge = 0;
    uint64_t i;
    metro_chain chain;
    metro_result result = metro_chain_make(target, NULL, rng, &chain);
    if (result != METRO_OK) return result;
    result = metro_chain_start_point(&chain, &start);
    metro_chain_burn(&chain, 1000);
    for (i = 0; i < steps; i++) {
        int bin;
        metro_chain_step(&chain);
        bin = (int)(BINS * chain.state[0]);
        density[bin] += (double)BINS / GROUPS / (double)steps;
        edge += bin < BINS / 20 || bin >= BINS - BINS / 20;
    }
    metro_moments_add(outer, edge / (double)steps);
    metro_chain_free(&chain);
    return result;
}

/* Walks by one kind of step and asks the balance check about it, which gets the step and nothing of the walk. */
static metro_result study_step(size_t kind, double *density, double *part, double *error, metro_balance *balance)
{
    metro_axis axis = { METRO_INTERVAL, { METRO_UNIFORM, 0.2, 0, 0 } };
    metro_target target = target_on(&axis, flat);
    metro_moments outer = { 0, 0, 0, 0 };
    metro_result result = METRO_OK;
    size_t g;
    target.propose = step_kind[kind].propose;
    memset(density, 0, BINS * sizeof *density);
    for (g = 0; g < GROUPS && result == METRO_OK; g++)
        result = walk(&target, metro_rng_make(kind, g), plot_quick() ? 10000 : 300000, density, &outer);
    *part = metro_moments_mean(&outer);
    *error = metro_moments_error(&outer);
    if (result != METRO_OK) return result;
    return metro_balance_check(&target, NULL, plot_quick() ? 200000 : 1000000, 20, metro_rng_make(kind, g), balance);
}

static int draw_mistakes(char *finding, size_t room)
{
    plot_chart chart = plot_chart_make("One wrong line in a step samples another density, and the check knows", NULL);
    double x[BINS], density[BINS], part[STEPS], error[STEPS];
    char name[STEPS][80];
    const char *names[STEPS];
    size_t k, i;
    int failed = 0;
    printf("%-22s %26s %14s\n", "a step", "in the outer tenth", "probability");
    for (i = 0; i < BINS; i++) x[i] = ((double)i + 0.5) / BINS;
    for (k = 0; k < STEPS; k++) {
        const char *key = step_kind[k].key;
        metro_balance balance;
        plot_series *line;
        metro_result result = study_step(k, density, &part[k], &error[k], &balance);
        if (result != METRO_OK) return complain("mistakes", result);
        put("mistakes", key, NONE, "outer_tenth", part[k], error[k]);
        put("mistakes", key, NONE, "probability", balance.probability, NONE);
        put("mistakes", key, NONE, "chi_square", balance.chi_square, NONE);
        put("mistakes", key, NONE, "freedom", balance.freedom, NONE);
        for (i = 0; i < BINS; i++) put("mistakes", key, x[i], "density", density[i], NONE);
        printf("%-22s %14.4f +- %.4f %16.2g\n", step_kind[k].name, part[k], error[k], balance.probability);
        snprintf(name[k], sizeof name[k], balance.probability > 1e-6 ? "%s: $p$ = %.2g" : "%s: $p$ < $10^{-6}$",
                 step_kind[k].name, balance.probability);
        names[k] = name[k];
        line = plot_line(&chart.panel[0], x, density, BINS, step_kind[k].name);
        line->color = step_kind[k].color;
        line->dash = k == 1;
        line->place = PLOT_KEY;
        failed |= (balance.probability < 1e-6) != step_kind[k].wrong ||
                  (fabs(part[k] - 0.1) > 6 * error[k]) != step_kind[k].wrong;
    }
    if (failed) fprintf(stderr, "failures: a right step was refused or a wrong one passed\n");
    chart.note = "Read: left, where long chains have been; the target is 1 everywhere. Right, the part of the states "
                 "within .05 of a border, a tenth for a right chain (dashed), and in the names the probability $p$ "
                 "of metro_balance_check, which looks at single steps only: below a millionth the step is wrong.";
    chart.columns = 2;
    chart.width = 1300;
    chart.panel[0].x_label = "state";
    chart.panel[0].y_label = "density of the states";
    chart.panel[0].y_log = 1;
    chart.panel[0].y_min = 0.3;
    chart.panel[0].y_max = 30;
    chart.panel[1].x_label = "part of the states in the outer tenth";
    plot_bars(&chart.panel[1], names, part, error, STEPS, NULL);
    plot_rule_x(&chart.panel[1], 0.1, "right");
    snprintf(finding, room,
             "a clamped border puts %.4f and a dropped rejection %.4f of a flat target into its outer tenth; the "
             "check of detailed balance finds both, and a ratio upside down",
             part[2], part[3]);
    return failed | plot_save(&chart, "out/failures.svg");
}

/* ---- Two islands, the right one twice as heavy, and a sea that no step crosses. ---- */

static double islands(const double *z, void *sample, void *user)
{
    const double left = (z[0] - 0.25) / 0.03, right = (z[0] - 0.75) / 0.03;
    (void)sample, (void)user;
    return exp(-left * left / 2) + 2 * exp(-right * right / 2);
}

static const struct {
    const char *key, *title;
    double start[2], large; /* chains start at the two points in turn */
} voyage[VOYAGES] = { { "one", "all start on one", { 0.25, 0.25 }, 0 },
                      { "both", "start on both", { 0.25, 0.75 }, 0 },
                      { "large", "start on both, large steps", { 0.25, 0.75 }, 0.1 } };

/* Runs the chains of a voyage; b is what their large steps say of the integral. */
static metro_result sail(int v, double *draw, metro_moments *b)
{
    metro_axis axis = { METRO_INTERVAL, { METRO_UNIFORM, 0.2, 0, 0 } };
    metro_chain_options options = { 0, 0 };
    metro_target target = target_on(&axis, islands);
    int c, i;
    options.large_step = voyage[v].large;
    for (c = 0; c < CHAINS; c++) {
        metro_chain chain;
        metro_result result =
            metro_chain_make(&target, &options, metro_rng_make(100 + (uint64_t)v, (uint64_t)c), &chain);
        if (result != METRO_OK) return result;
        result = metro_chain_start_point(&chain, &voyage[v].start[c % 2]);
        for (i = 0; i < DRAWS; i++) {
            metro_chain_step(&chain);
            *draw++ = chain.state[0];
        }
        metro_moments_add(b, metro_chain_b(&chain, NULL));
        metro_chain_free(&chain);
        if (result != METRO_OK) return result;
    }
    return METRO_OK;
}

/* One panel; `rhat` gets what the chains say of themselves. */
static metro_result draw_voyage(plot_panel *panel, int v, double truth, double *rhat, char *title, size_t room)
{
    static double draw[CHAINS * DRAWS], step[SHOWN];
    metro_moments b = { 0, 0, 0, 0 };
    metro_sum sum = { 0, 0 };
    metro_result result = sail(v, draw, &b);
    double mean, error = metro_mcse_mean(draw, CHAINS, DRAWS);
    int i;
    for (i = 0; i < CHAINS * DRAWS; i++) metro_sum_add(&sum, draw[i]);
    mean = metro_sum_value(&sum) / (CHAINS * DRAWS);
    *rhat = metro_rhat(draw, CHAINS, DRAWS);
    put("islands", voyage[v].key, NONE, "rhat", *rhat, NONE);
    put("islands", voyage[v].key, NONE, "mean", mean, error);
    put("islands", voyage[v].key, NONE, "mcse", error, NONE);
    put("islands", voyage[v].key, NONE, "ess_mean", metro_ess_mean(draw, CHAINS, DRAWS), NONE);
    put("islands", voyage[v].key, NONE, "b", metro_moments_mean(&b), metro_moments_error(&b));
    put("islands", voyage[v].key, NONE, "b_error", metro_moments_error(&b), NONE);
    printf("%-28s %10.4f %10.4f +- %.4f %10.4f\n", voyage[v].title, *rhat, mean, error, truth);
    snprintf(title, room, "%s: R-hat %.2f, mean %.2f", voyage[v].title, *rhat, mean);
    for (i = 0; i < SHOWN; i++) step[i] = i + 1;
    for (i = 0; i < CHAINS; i++) {
        plot_series *line = plot_line(panel, step, draw + i * DRAWS, SHOWN, NULL);
        line->width = 1.2;
        line->color = plot_palette(i % 2 == 0 ? 0 : 1);
    }
    plot_rule_y(panel, truth, v == 0 ? plot_say(panel, "true mean %", round(100 * truth) / 100) : NULL);
    panel->title = title;
    panel->x_label = "step";
    panel->y_label = "state";
    panel->y_min = 0;
    panel->y_max = 1;
    return result;
}

static int draw_islands(void)
{
    plot_chart chart = plot_chart_make("Chains that agree may all be wrong", NULL);
    double truth = (0.25 + 2 * 0.75) / 3, rhat[VOYAGES];
    char title[VOYAGES][80];
    int v;
    put("islands", "truth", NONE, "mean", truth, NONE);
    put("islands", "truth", NONE, "b", 3 * 0.03 * sqrt(8 * atan(1.0)), NONE);
    printf("\n%-28s %10s %20s %10s\n", "two islands", "R-hat", "mean", "truth");
    for (v = 0; v < VOYAGES; v++) {
        metro_result result = draw_voyage(&chart.panel[v], v, truth, &rhat[v], title[v], sizeof title[v]);
        if (result != METRO_OK) return complain("islands", result);
    }
    chart.note = "Read: four chains, step by step. Two islands, at .25 and twice as heavy at .75, lie farther apart "
                 "than a step reaches. R-hat compares chains with each other, never with the truth: started on one "
                 "island they agree, though most of the integral is missing. Started apart they give each other "
                 "away. One large step in ten cures it.";
    chart.columns = VOYAGES;
    chart.width = 1400;
    chart.share_y = 1;
    if (rhat[0] < 1.01 && rhat[1] > 1.5 && rhat[2] < 1.05) return plot_save(&chart, "out/failures_islands.svg");
    fprintf(stderr, "failures: R-hat of the islands is %g, %g, %g\n", rhat[0], rhat[1], rhat[2]);
    plot_free(&chart);
    return 1;
}

/* ---- Acceptance against error, for every size, from the operator: no chain is run. ---- */

static const char *const target_key[TARGETS] = { "constant", "peak", "two_peaks" };
static const char *const target_name[TARGETS] = { "constant", "one peak", "two peaks" };

static double importance_at(size_t target, double x)
{
    const double s = target == 1 ? 0.02 : 0.03, a = (x - 0.25) / s, b = (x - 0.75) / s, c = (x - 0.5) / s;
    if (target == 0) return 1;
    return target == 1 ? 0.01 + exp(-c * c / 2) : 1e-4 + exp(-a * a / 2) + exp(-b * b / 2);
}

static double size_of(size_t i) { return 0.02 * pow(2.0 / 0.02, (double)i / (SIZES - 1)); }

/* Acceptance and mean squared error of a run from a random seed, for the picture of two pixels. */
static metro_result run_error(size_t target, double size, double *acceptance, double *mse)
{
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    double importance[CELLS], f[CELLS];
    metro_operator op;
    metro_operator_error mean;
    metro_result result;
    size_t i;
    kernel.size = size;
    for (i = 0; i < CELLS; i++) {
        importance[i] = importance_at(target, ((double)i + 0.5) / CELLS);
        f[i] = i < CELLS / 2;
    }
    result = metro_operator_make(&kernel, importance, CELLS, &op);
    if (result != METRO_OK) return result;
    result = metro_operator_run(&op, f, 0, RUN, NULL, NULL, &mean);
    *acceptance = op.acceptance;
    *mse = mean.mse;
    metro_operator_free(&op);
    return result;
}

/* The curve of one importance. `tuned` gets the error, over the least, of the size that accepts nearest to `rule`. */
static metro_result draw_sizes(plot_panel *panel, size_t t, double rule, double *tuned)
{
    double percent[SIZES], mse[SIZES], best;
    char words[80];
    size_t i, least = 0, nearest = 0, most = 0;
    for (i = 0; i < SIZES; i++) {
        metro_result result = run_error(t, size_of(i), &percent[i], &mse[i]);
        if (result != METRO_OK) return result;
        percent[i] *= 100;
        if (mse[i] < mse[least]) least = i;
        if (mse[i] > mse[most]) most = i;
        if (fabs(percent[i] - rule) < fabs(percent[nearest] - rule)) nearest = i;
    }
    for (i = 0, best = mse[least]; i < SIZES; i++) {
        mse[i] /= best;
        put("acceptance", target_key[t], size_of(i), "acceptance", percent[i] / 100, NONE);
        put("acceptance", target_key[t], size_of(i), "mse_over_least", mse[i], NONE);
    }
    *tuned = mse[nearest];
    put("acceptance", target_key[t], NONE, "best_size", size_of(least), NONE);
    put("acceptance", target_key[t], NONE, "best_acceptance", percent[least] / 100, NONE);
    put("acceptance", target_key[t], NONE, "tuned_over_least", t > 0 ? *tuned : NONE, NONE);
    put("acceptance", target_key[t], NONE, "worst_over_least", mse[most], NONE);
    printf("%-22s %10.2f %10.0f %% %20.3g times the least\n", target_name[t], size_of(least), percent[least],
           mse[most]);
    plot_line(panel, percent, mse, SIZES, NULL)->color = plot_palette(t);
    plot_points(panel, percent, mse, NULL, SIZES, target_name[t])->color = plot_palette(t);
    snprintf(words, sizeof words, "%s: size %.2g", target_name[t], size_of(least));
    plot_note(panel, percent[least], 1, words);
    return METRO_OK;
}

static int draw_acceptance(void)
{
    const double rule = 44; /* per cent, the best for one normal variable: Gelman, Roberts and Gilks 1996 */
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[0];
    double tuned[TARGETS];
    char title[120];
    size_t t;
    printf("\n%-22s %10s %12s %20s\n", "importance", "best size", "accepts", "error of the worst");
    for (t = 0; t < TARGETS; t++) {
        metro_result result = draw_sizes(panel, t, rule, &tuned[t]);
        if (result != METRO_OK) return complain("acceptance", result);
    }
    snprintf(title, sizeof title,
             "Tuned to accept %g %%, one peak has %.2g and two peaks have %.0f times the least error", rule, tuned[1],
             tuned[2]);
    chart.title = title;
    chart.note = "Read: each curve is one importance, each point on it one size of the perturbation, from .02, where "
                 "most is accepted, to two turns of the circle. Rings mark the best sizes. A constant importance "
                 "accepts everything at every size, whatever its error. The errors are exact.";
    panel->x_label = "acceptance rate, %";
    panel->y_label = "mean squared error, over the least";
    panel->y_log = 1;
    plot_rule_x(panel, rule, "the rule");
    return plot_save(&chart, "out/failures_acceptance.svg");
}

/* ---- Numbers that deceive: a series cut too early, a norm that sees the grid. ---- */

/* E_1 from the first `terms` of the series (12); 0 terms: from the library. */
static double first_error(const metro_kernel *kernel, long terms)
{
    metro_sum sum = { 0, 0 };
    long k;
    for (k = 1; k <= terms; k++) metro_sum_add(&sum, 2 * pow(metro_kernel_coefficient(kernel, k), 2));
    return terms > 0 ? sqrt(metro_sum_value(&sum)) : metro_startup_error(kernel, 1);
}

/* The relative error of E_1 against the closed form sqrt((1 - Delta)/Delta). Returns the largest of 100 terms. */
static double draw_series(plot_panel *panel)
{
    static const long cut[CUTS + 1] = { 100, 1000, 10000, 0 };
    static const char *const key[CUTS + 1] = { "100_terms", "1000_terms", "10000_terms", "library" };
    static const char *const name[CUTS + 1] = { "100 terms", "1000 terms", "10000 terms", "library" };
    double Delta[POINTS], error[POINTS], largest = 0;
    size_t i, c;
    for (c = 0; c <= CUTS; c++) {
        for (i = 0; i < POINTS; i++) {
            metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
            kernel.size = Delta[i] = 0.01 * pow(0.8 / 0.01, (double)i / (POINTS - 1));
            error[i] = fabs(first_error(&kernel, cut[c]) / sqrt((1 - Delta[i]) / Delta[i]) - 1);
            put("series", key[c], Delta[i], "relative_error", error[i], NONE);
            if (c == 0 && error[i] > largest) largest = error[i];
            if (error[i] < 1e-16) error[i] = 1e-16; /* a logarithmic axis shows no 0 */
        }
        plot_line(panel, Delta, error, POINTS, name[c]);
    }
    panel->title = "a series that is cut";
    panel->x_label = "size of the perturbation $Delta$";
    panel->y_label = "relative error of $E_1$";
    panel->x_log = panel->y_log = 1;
    return largest;
}

/* How far p_4 from the peak is from its limit, on a grid of `cells`: in L2, in total variation, the atom in L2. */
static metro_result fourth_step(size_t cells, double *l2, double *variation, double *atom)
{
    metro_kernel kernel = { METRO_UNIFORM, 0.2, 0, 0 };
    double importance[FIRST_GRID << (GRIDS - 1)], mass[FIRST_GRID << (GRIDS - 1)];
    metro_distance distance;
    metro_operator op;
    metro_result result;
    size_t i;
    for (i = 0; i < cells; i++) {
        importance[i] = importance_at(1, ((double)i + 0.5) / (double)cells);
        mass[i] = i == cells / 2;
    }
    result = metro_operator_make(&kernel, importance, cells, &op);
    if (result != METRO_OK) return result;
    result = metro_operator_evolve(&op, AFTER, mass);
    distance = metro_operator_distance(&op, mass);
    *l2 = distance.l2;
    *variation = distance.total_variation;
    *atom = metro_operator_atom(&op, cells / 2, AFTER) * sqrt((double)cells);
    metro_operator_free(&op);
    return result;
}

/* `growth` gets the L2 error of the finest grid over that of the coarsest. */
static metro_result draw_atom(plot_panel *panel, double *growth)
{
    double cells[GRIDS], l2[GRIDS], variation[GRIDS], atom[GRIDS];
    size_t grids = plot_quick() ? 3 : GRIDS, g;
    for (g = 0; g < grids; g++) {
        size_t n = (size_t)FIRST_GRID << g;
        metro_result result = fourth_step(n, &l2[g], &variation[g], &atom[g]);
        if (result != METRO_OK) return result;
        cells[g] = (double)n;
        put("atom", "peak", cells[g], "l2", l2[g], NONE);
        put("atom", "peak", cells[g], "total_variation", variation[g], NONE);
        put("atom", "peak", cells[g], "atom", atom[g], NONE);
    }
    *growth = l2[grids - 1] / l2[0];
    plot_line(panel, cells, l2, grids, "$L_2$ error")->color = plot_palette(1);
    plot_line(panel, cells, atom, grids, "the spike's part")->dash = 1;
    panel->last->color = plot_palette(1);
    plot_line(panel, cells, variation, grids, "total variation")->color = plot_palette(0);
    panel->title = "a norm that sees the grid";
    panel->x_label = "cells of the grid";
    panel->y_label = "distance of $p_4$ from its limit";
    panel->x_log = panel->y_log = 1;
    return METRO_OK;
}

static int draw_numbers(void)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    char title[120];
    double low = draw_series(&chart.panel[0]), growth;
    metro_result result = draw_atom(&chart.panel[1], &growth);
    if (result != METRO_OK) return complain("atom", result);
    snprintf(title, sizeof title,
             "A cut series is up to %.2g %% low, and a finer grid makes an error %.2g times larger", 100 * low,
             growth);
    printf("\n%s\n", title);
    chart.title = title;
    chart.note = "Read: left, the start-up error after one step, (12), summed to so many terms, against the closed "
                 "form. The spectrum of short steps falls slowly; the library does not sum it there (its error, if "
                 "below $10^{-16}$, is drawn at that). Right, a chain "
                 "that has been rejected so far still sits on its seed, on the top of a peak. The finer the grid, "
                 "the higher this spike and the $L_2$ error, though nothing has become worse.";
    chart.columns = 2;
    chart.width = 1300;
    return plot_save(&chart, "out/failures_numbers.svg");
}

int main(void)
{
    char finding[300];
    csv = plot_csv_open("out/failures.csv", "sheet,case,x,quantity,value,error");
    if (draw_mistakes(finding, sizeof finding) + draw_islands() + draw_acceptance() + draw_numbers() > 0) return 1;
    if (plot_csv_close(&csv) != 0) return 1;
    printf("%s\n", finding);
    return 0;
}
