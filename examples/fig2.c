/* fig2.c: the paper's figure 2, the start-up error E_n against the number of steps n for perturbations of full width
   Delta from 0.02 to 1.43 (section 2.2), and a second sheet for its remark that "this situation gets just worse for
   higher dimensions". The curves are exact, paper (12); the points are estimates from ensembles of chains. To see:
   small perturbations first spread like heat, E_n ~ n^(-1/4), and then forget at the rate P*(1)^n. Larger ones forget
   sooner, up to a whole turn, a size of 1, and not beyond.

   Writes out/fig2.csv and out/fig2_dimensions.csv (the points, with the exact values), the same with _curves, the
   table out/fig2_steps.csv (steps until E_n < 0.1), and the sheets out/fig2.svg and out/fig2_dimensions.svg. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { SIZES = 10, DIMENSIONS = 4, LOOKS = 21, CURVE = 160, MOST_AXES = 10, STEP_SIZES = 4, LATE = 100 };

static const double size[SIZES] = { 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.1, 1.43 };
static const size_t dimensions[DIMENSIONS] = { 1, 2, 3, 5 }, harmonics[DIMENSIONS] = { 32, 6, 3, 2 };
static const size_t step_size[STEP_SIZES] = { 1, 2, 3, 5 }; /* of these sizes we count the steps */
static const double sheet_size = 0.2, forgotten = 0.1;      /* of the second sheet: Delta, and the E_n we wait for */
static const uint64_t look[LOOKS] = { 1,  2,  3,  4,   5,   7,   10,  14,  20,  30,  40,
                                      50, 70, 90, 120, 150, 200, 300, 500, 700, 1000 }; /* when we look, in steps */

/* An ensemble of chains: what theory says of it, and what it says of E_n^2 over its harmonics. */
typedef struct {
    metro_kernel kernel;
    size_t axes, harmonics, looks;
    uint64_t look[LOOKS];
    double exact[LOOKS];                 /* E_n */
    double tail[LOOKS];                  /* the part of E_n^2 beyond the harmonics: no ensemble can see it */
    double squared[LOOKS], error[LOOKS]; /* the estimate of E_n^2, with the tail, and its standard error */
    double score[LOOKS];                 /* how many standard errors it is off */
} ensemble;

/* How many estimates are within 1, 2 and 3 standard errors. */
typedef struct {
    double count, within[3], worst;
} tally;

static double constant_importance(const double *z, void *sample, void *user)
{
    (void)z, (void)sample, (void)user;
    return 1;
}

static double exact_error(const metro_kernel *kernel, size_t axes, uint64_t n)
{
    metro_kernel k[MOST_AXES];
    size_t i;
    for (i = 0; i < axes; i++) k[i] = *kernel;
    return metro_startup_error_axes(k, axes, n);
}

/* E_n^2 beyond the harmonics: all of it without what the series (12) has up to K along each axis, eq 5.48. */
static double tail_beyond(const ensemble *e, uint64_t n, double exact)
{
    double sum = 0;
    size_t k;
    for (k = 1; k <= e->harmonics; k++)
        sum += 2 * pow(fabs(metro_kernel_coefficient(&e->kernel, (long)k)), 2 * (double)n);
    return exact * exact - expm1((double)e->axes * log1p(sum));
}

/* We look from where the harmonics hold 99 % of E_n^2 until E_n is below .004, or out of sight. */
static void choose_looks(ensemble *e)
{
    size_t i;
    for (e->looks = i = 0; i < LOOKS; i++) {
        double exact = exact_error(&e->kernel, e->axes, look[i]), tail = tail_beyond(e, look[i], exact);
        if (tail > 0.01 * exact * exact || exact < 0.004) continue;
        e->look[e->looks] = look[i];
        e->exact[e->looks] = exact;
        e->tail[e->looks++] = tail;
    }
}

/* Runs chains for about `seconds` of one core. Exits with a message when that cannot be done. */
static void run(ensemble *e, double seconds, uint64_t random_seed)
{
    const double seed[MOST_AXES] = { 0 }, modes = pow(2 * (double)e->harmonics + 1, (double)e->axes) / 2;
    double cost, axes = (double)e->axes;
    metro_axis axis[MOST_AXES];
    metro_target target;
    metro_ensemble plan;
    metro_result result;
    size_t i;
    memset(&target, 0, sizeof target);
    memset(&plan, 0, sizeof plan);
    choose_looks(e);
    for (i = 0; i < e->axes; i++) {
        axis[i].kind = METRO_CIRCLE;
        axis[i].kernel = e->kernel;
    }
    target.axes = axis;
    target.axis_count = e->axes;
    target.importance = constant_importance;
    /* Of one chain, in seconds: its steps and its looks */
    cost = 1e-9 * axes * (12 * (double)e->look[e->looks - 1] + (double)e->looks * (40 + 3 * modes));
    plan.target = &target;
    plan.seed = seed;
    plan.seeds = 1;
    plan.steps = e->look;
    plan.times = e->looks;
    plan.chains = (uint64_t)(seconds / cost) + 32;
    plan.harmonics = e->harmonics;
    plan.random_seed = random_seed;
    result = metro_ensemble_measure(&plan, e->squared, e->error);
    if (result != METRO_OK) {
        fprintf(stderr, "fig2: %s\n", metro_result_text(result));
        exit(1);
    }
}

static void compare(ensemble *e, tally *agreement)
{
    size_t i, k;
    for (i = 0; i < e->looks; i++) {
        e->squared[i] += e->tail[i];
        e->score[i] = (e->squared[i] - e->exact[i] * e->exact[i]) / e->error[i];
        agreement->count++;
        agreement->worst = fmax(agreement->worst, fabs(e->score[i]));
        for (k = 0; k < 3; k++) agreement->within[k] += fabs(e->score[i]) <= (double)k + 1;
    }
}

/* The exact curve up to `most` steps, named. Rows begin with `key`. */
static void draw_curve(plot_panel *panel, const ensemble *e, uint64_t most, const char *label, uint32_t color,
                       double key, plot_csv *csv)
{
    double n[CURVE], E[CURVE];
    size_t count = 0;
    uint64_t at;
    for (at = 1; at <= most && count < CURVE; at += at < 20 ? 1 : at / 20, count++) {
        n[count] = (double)at;
        E[count] = exact_error(&e->kernel, e->axes, at);
        PLOT_CSV_ROW(csv, key, n[count], E[count]);
    }
    plot_line(panel, n, E, count, label)->color = color;
}

/* The estimates that are five standard errors above zero, and below them how far all of them are off. */
static void draw_points(plot_panel *panel, plot_panel *scores, const ensemble *e, uint32_t color, double key,
                        plot_csv *csv)
{
    double n[LOOKS], E[LOOKS], error[LOOKS], x[LOOKS];
    size_t shown = 0, i;
    for (i = 0; i < e->looks; i++) {
        double estimate = e->squared[i] > 0 ? sqrt(e->squared[i]) : (double)NAN;
        double spread = e->error[i] / (2 * estimate);
        x[i] = (double)e->look[i];
        PLOT_CSV_ROW(csv, key, x[i], e->exact[i], estimate, spread, e->squared[i], e->error[i], e->tail[i],
                     e->score[i]);
        if (!(e->squared[i] > 5 * e->error[i])) continue;
        n[shown] = x[i];
        E[shown] = estimate;
        error[shown++] = spread;
    }
    plot_points(panel, n, E, error, shown, "estimates from chains, 1 standard error")->color = color;
    if (scores != NULL) plot_points(scores, x, e->score, NULL, e->looks, NULL)->color = color;
}

/* The first sheet: all sizes in one dimension. Returns 0, or more if a file could not be written. */
static int draw_sizes(double seconds, tally *agreement)
{
    plot_csv csv =
        plot_csv_open("out/fig2.csv", "Delta,n,startup_error,estimate,error,squared,squared_error,tail,score");
    plot_csv curves = plot_csv_open("out/fig2_curves.csv", "Delta,n,startup_error");
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[0], *scores = &chart.panel[1];
    double last[SIZES];
    char title[200];
    ensemble e;
    size_t i;
    memset(&e, 0, sizeof e);
    e.axes = 1;
    for (i = 0; i < SIZES; i++) {
        e.kernel.size = size[i];
        last[i] = exact_error(&e.kernel, 1, LATE);
        for (e.harmonics = 8, e.look[0] = 0; e.look[0] != 1; choose_looks(&e)) e.harmonics *= 2; /* 99 % of E_1^2 */
        run(&e, seconds, i);
        compare(&e, agreement);
        draw_curve(panel, &e, 1000, plot_say(panel, "$Delta$ = %", size[i]), plot_shade(i, SIZES), size[i], &curves);
        draw_points(panel, scores, &e, plot_shade(i, SIZES), size[i], &csv);
        plot_progress((double)(i + 1) / (SIZES + DIMENSIONS), "figure 2: chains");
    }
    snprintf(title, sizeof title,
             "Small perturbations remember the seed: after %d steps $E_n$ is %.2g for width %g, "
             "%.2g for %g and %.2g for %g",
             LATE, last[0], size[0], last[2], size[2], last[3], size[3]);
    chart.title = title;
    chart.note =
        "Read: a curve is the distance $E_n$ of the density of the $n$-th sample from uniform, for steps of full "
        "width $Delta$ on a circle of length 1; points are estimates from ensembles of chains. The panel below "
        "says how many standard errors each estimate of $E_n^2$ is off.";
    panel->y_label = "start-up error $E_n$";
    panel->x_log = panel->y_log = scores->x_log = 1;
    panel->x_min = scores->x_min = 1;
    panel->x_max = scores->x_max = 1000;
    panel->y_min = 1e-3;
    panel->y_max = 10;
    scores->x_label = "steps $n$";
    scores->y_label = "estimate less exact, in standard errors";
    plot_rule_y(scores, 2, NULL);
    plot_rule_y(scores, -2, NULL);
    chart.rows = 2;
    chart.height = 1050;
    return plot_csv_close(&csv) + plot_csv_close(&curves) + plot_save(&chart, "out/fig2.svg");
}

/* How many steps until E_n is below `forgotten`, in 1, 2, ... dimensions, each of which takes as long or longer. */
static void count_steps(double Delta, double *steps)
{
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    uint64_t n = 1;
    size_t axes;
    kernel.size = Delta;
    for (axes = 1; axes <= MOST_AXES; axes++) {
        while (exact_error(&kernel, axes, n) >= forgotten) n++;
        steps[axes - 1] = (double)n;
    }
}

/* The table of the second sheet and its right panel. `ratio` gets the steps in five dimensions over those in one. */
static int draw_steps(plot_panel *panel, double *ratio)
{
    plot_csv csv = plot_csv_open("out/fig2_steps.csv", "Delta,dimensions,E_1,E_10,steps");
    double steps[MOST_AXES], axes[MOST_AXES];
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    size_t i, d;
    printf("%6s %11s %10s %10s   steps until E_n < %g\n", "Delta", "dimensions", "E_1", "E_10", forgotten);
    for (i = 0; i < STEP_SIZES; i++) {
        kernel.size = size[step_size[i]];
        count_steps(kernel.size, steps);
        for (d = 1; d <= MOST_AXES; d++) {
            double first = exact_error(&kernel, d, 1), tenth = exact_error(&kernel, d, 10);
            axes[d - 1] = (double)d;
            PLOT_CSV_ROW(&csv, kernel.size, axes[d - 1], first, tenth, steps[d - 1]);
            if (d <= 3 || d == 5)
                printf("%6g %11d %10.4g %10.4g %22g\n", kernel.size, (int)d, first, tenth, steps[d - 1]);
        }
        plot_line(panel, axes, steps, MOST_AXES, plot_say(panel, "$Delta$ = %", kernel.size))->color =
            plot_shade(step_size[i], SIZES);
        if (kernel.size >= sheet_size && kernel.size <= sheet_size) *ratio = steps[4] / steps[0];
    }
    panel->title = plot_say(panel, "steps until $E_n$ < %", forgotten);
    panel->x_label = "dimensions";
    panel->y_label = "steps $n$";
    panel->y_log = 1;
    return plot_csv_close(&csv);
}

/* The second sheet: one size in more dimensions. */
static int draw_dimensions(double seconds, tally *agreement, double *ratio)
{
    plot_csv csv = plot_csv_open("out/fig2_dimensions.csv",
                                 "dimensions,n,startup_error,estimate,error,squared,squared_error,tail,score");
    plot_csv curves = plot_csv_open("out/fig2_dimensions_curves.csv", "dimensions,n,startup_error");
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[0];
    char title[200];
    int failed = draw_steps(&chart.panel[1], ratio);
    size_t i;
    for (i = 0; i < DIMENSIONS; i++) {
        double axes = (double)dimensions[i];
        ensemble e;
        memset(&e, 0, sizeof e);
        e.kernel.size = sheet_size;
        e.axes = dimensions[i];
        e.harmonics = harmonics[i];
        run(&e, seconds, SIZES + i);
        compare(&e, agreement);
        draw_curve(panel, &e, 100, plot_say(panel, axes > 1 ? "% dimensions" : "% dimension", axes), plot_palette(i),
                   axes, &curves);
        draw_points(panel, NULL, &e, plot_palette(i), axes, &csv);
        plot_progress((double)(i + 1 + SIZES) / (SIZES + DIMENSIONS), "figure 2: chains");
    }
    snprintf(title, sizeof title,
             "More dimensions begin far worse but forget at the same rate: five need %.2f times "
             "the steps of one dimension",
             *ratio);
    chart.title = title;
    chart.note =
        "Read: all coordinates are perturbed at once, by steps of full width $Delta$ each. Left: the error, with "
        "estimates from ensembles of chains. The curves begin far apart and end as close neighbours. Right: how "
        "many steps until the error is below the dashed line; the title speaks of the same $Delta$ as the left.";
    panel->x_label = "steps $n$";
    panel->y_label = plot_say(panel, "start-up error $E_n$ for $Delta$ = %", sheet_size);
    panel->x_log = panel->y_log = 1;
    panel->y_min = 0.01;
    plot_rule_y(panel, forgotten, NULL);
    chart.columns = 2;
    failed += plot_csv_close(&csv) + plot_csv_close(&curves);
    return failed + plot_save(&chart, "out/fig2_dimensions.svg");
}

int main(void)
{
    double seconds = plot_quick() ? 0.05 : 0.8, ratio = 0, percent;
    tally agreement = { 0, { 0, 0, 0 }, 0 };
    if (draw_sizes(seconds, &agreement) + draw_dimensions(seconds, &agreement, &ratio) > 0) return 1;
    percent = 100 / agreement.count;
    if (!(agreement.worst < 6)) {
        fprintf(stderr, "fig2: an estimate is %.1f standard errors off\n", agreement.worst);
        return 1;
    }
    printf("E_n agrees with %g estimates from chains (%.0f %% within 1, %.0f %% within 2, %.0f %% within 3 standard "
           "errors, the worst %.1f off); five dimensions take %.2f times the steps of one to forget the seed\n",
           agreement.count, percent * agreement.within[0], percent * agreement.within[1],
           percent * agreement.within[2], agreement.worst, ratio);
    return 0;
}
