/* size.c: how large should the perturbation be? Section 2.3 of the paper, at constant importance.

   A chain starts at 0 and makes M steps with a uniform perturbation of full width Delta; the mean of cos 2 pi x
   over its samples estimates an integral that is 0. Chapter 5 says what bias and variance this estimate has, for
   every M and Delta, and some thousand repeats of the run must agree.

   See: a short run is wrong because of its start, a long one because its samples resemble each other: squared
   bias falls with 1/M^2, variance with 1/M. Both want large steps, larger than the circle: at Delta = 1.43 a
   sample tends to fall opposite to the one before it, and their errors cancel. The last panel holds the paper's
   estimate of the steps that a chain needs, 1/Delta, against what diffusion needs, 6/(pi Delta)^2.

   Writes out/size.svg; out/size.csv (where it was measured: exact and measured), out/size_curves.csv,
   out/size_best.csv (the best size for each M; cost is M mse over the variance of cos 2 pi x; the row M = inf holds
   the limits of M^2 bias2, M variance and M mse) and out/size_forget.csv. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { RUNS = 4, SIZES = 10, CURVE = 240 };

static const double pi = 3.14159265358979323846;
static const uint64_t run_steps[RUNS] = { 10, 100, 1000, 10000 };
static const size_t run_repeats[RUNS] = { 16384, 8192, 4096, 1024 };
static const double size_measured[SIZES] = { 0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 0.9, 1.43, 1.8, 2.4 };

/* The chain, from the step that Delta = `size` makes: all samples z_1 .. z_M. */
static double estimate(double size, uint64_t steps, metro_rng *rng)
{
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    double x = 0, sum = 0;
    uint64_t i;
    kernel.size = size;
    for (i = 0; i < steps; i++) {
        x = metro_kernel_perturb(&kernel, x, rng);
        sum += cos(2 * pi * x);
    }
    return sum / (double)steps;
}

/* The same in theory. */
static metro_result theory(double size, uint64_t steps, metro_run_error *error)
{
    static const double cosine = 1, seed = 0;
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    kernel.size = size;
    return metro_startup_run_error(&kernel, 1, steps, &cosine, NULL, 1, &seed, NULL, 1, error);
}

/* What many runs say: squared bias and variance apart, and the mean of the estimates, the bias with its sign. */
typedef struct {
    metro_bias_variance error;
    metro_moments mean;
} measurement;

/* A job repeats the run of one M and one size; those of a round share M. */
static metro_result measure(uint64_t job, void *slot, void *user)
{
    static const double truth = 0;
    size_t run = (size_t)job / SIZES, repeats = run_repeats[run] / (*(const int *)user ? 16 : 1), i;
    double *value = (double *)malloc(repeats * sizeof *value);
    measurement *out = (measurement *)slot;
    metro_result result;
    if (value == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < repeats; i++) {
        metro_rng rng = metro_rng_make(1 + job, i);
        value[i] = estimate(size_measured[job % SIZES], run_steps[run], &rng);
        metro_moments_add(&out->mean, value[i]);
    }
    result = metro_repeats(value, &truth, repeats, 1, &out->error);
    free(value);
    return result;
}

typedef struct {
    int quick;
    measurement measured[RUNS][SIZES];
} study;

static metro_result keep(uint64_t job, const void *slot, void *user)
{
    ((study *)user)->measured[job / SIZES][job % SIZES] = *(const measurement *)slot;
    return METRO_OK;
}

static int show(uint64_t rounds_done, void *user)
{
    (void)user;
    plot_progress((double)rounds_done / (double)RUNS, "size");
    return 0;
}

static metro_result study_run(study *s)
{
    metro_rounds plan;
    memset(&plan, 0, sizeof plan);
    plan.rounds = RUNS;
    plan.jobs = SIZES;
    plan.slot_size = sizeof(measurement);
    plan.work = measure;
    plan.merge = keep;
    plan.stop = show;
    return metro_rounds_run(&plan, s);
}

/* Both parts and their sum for one M: curves, and measured points on them. `worst` keeps the largest disagreement, in
   standard errors. */
static metro_result draw_run(plot_chart *chart, plot_csv *csv, plot_csv *curves, const study *s, int run,
                             double *worst)
{
    double x[CURVE], y[3][CURVE], point[3][SIZES], bar[3][SIZES];
    metro_run_error exact;
    metro_result result;
    char label[40];
    int i, part;
    for (i = 0; i < CURVE; i++) {
        x[i] = 0.02 * pow(150, i / (double)(CURVE - 1));
        result = theory(x[i], run_steps[run], &exact);
        if (result != METRO_OK) return result;
        y[0][i] = exact.mse;
        y[1][i] = exact.bias * exact.bias;
        y[2][i] = exact.variance;
        PLOT_CSV_ROW(curves, (double)run_steps[run], x[i], y[1][i], y[2][i], y[0][i]);
    }
    for (i = 0; i < SIZES; i++) {
        const metro_bias_variance *m = &s->measured[run][i].error;
        const metro_moments *runs = &s->measured[run][i].mean;
        double mean = metro_moments_mean(runs), mean_error = metro_moments_error(runs);
        result = theory(size_measured[i], run_steps[run], &exact);
        if (result != METRO_OK) return result;
        point[0][i] = m->mse, point[1][i] = m->bias2, point[2][i] = m->variance;
        bar[0][i] = m->mse_error, bar[1][i] = m->bias2_error, bar[2][i] = m->variance_error;
        PLOT_CSV_ROW(csv, (double)run_steps[run], size_measured[i], exact.bias, exact.bias * exact.bias,
                     exact.variance, exact.mse, mean, mean_error, m->bias2, m->bias2_error, m->variance,
                     m->variance_error, m->mse, m->mse_error);
        *worst = fmax(*worst, fabs(mean - exact.bias) / mean_error);
        *worst = fmax(*worst, fabs(m->variance - exact.variance) / m->variance_error);
        if (!(m->bias2 > m->bias2_error)) point[1][i] = NAN;
    }
    snprintf(label, sizeof label, "$M$ = %d", (int)run_steps[run]);
    for (part = 0; part < 3; part++) {
        plot_line(&chart->panel[part], x, y[part], CURVE, label)->color = plot_shade((size_t)run, RUNS);
        plot_points(&chart->panel[part], size_measured, point[part], bar[part], SIZES, NULL)->color =
            plot_shade((size_t)run, RUNS);
    }
    return METRO_OK;
}

/* The best size for each M, and in the limit of many samples. */
static int find_best(plot_panel *panel, double *limit, double *cost)
{
    static const double cosine = 1, seed = 0;
    plot_csv csv = plot_csv_open("out/size_best.csv", "M,Delta,bias2,variance,mse,cost");
    double size[RUNS + 1], mse[RUNS + 1];
    metro_run_error error;
    plot_series *series;
    int run;
    for (run = 0; run <= RUNS; run++) {
        uint64_t steps = run < RUNS ? run_steps[run] : 0;
        double m = run < RUNS ? (double)steps : INFINITY;
        metro_result result =
            metro_startup_best_size(METRO_UNIFORM, 1, steps, &cosine, NULL, 1, &seed, NULL, 1, &size[run], &error);
        if (result != METRO_OK) {
            fprintf(stderr, "size: the best size: %s\n", metro_result_text(result));
            return 1;
        }
        mse[run] = error.mse;
        *cost = (run < RUNS ? m : 1) * error.mse / 0.5;
        PLOT_CSV_ROW(&csv, m, size[run], error.bias * error.bias, error.variance, error.mse, *cost);
        printf("M = %-7g best size %.4f, M mse / sigma^2 = %.3f\n", m, size[run], *cost);
    }
    *limit = size[RUNS];
    series = plot_points(panel, size, mse, NULL, RUNS, "best size for each $M$");
    series->color = 0x222222;
    series->marker = 2;
    return plot_csv_close(&csv);
}

/* Steps to forget: until the slowest mode has fallen to 1/e, diffusion's approximation, and the paper's estimate. */
static int draw_forget(plot_panel *panel)
{
    plot_csv csv = plot_csv_open("out/size_forget.csv", "Delta,steps,diffusion,paper,E_after_10_over_Delta");
    double x[33], exact[33], diffusion[33], paper[33], left[33];
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    int i;
    for (i = 0; i <= 32; i++) {
        kernel.size = x[i] = i % 8 == 0 ? pow(10, i / 8 - 4) : pow(10, i / 8.0 - 4);
        exact[i] = i < 32 ? -1 / log(metro_kernel_coefficient(&kernel, 1)) : 0;
        diffusion[i] = 6 / (pi * x[i] * pi * x[i]);
        paper[i] = 1 / x[i];
        left[i] = metro_startup_error(&kernel, (uint64_t)(10 / x[i] + 0.5));
        PLOT_CSV_ROW(&csv, x[i], exact[i], diffusion[i], paper[i], left[i]);
    }
    plot_line(panel, x, exact, 33, "exact");
    plot_line(panel, x, diffusion, 33, "$6 / (pi Delta)^2$")->dash = 1;
    plot_line(panel, x, paper, 33, "paper: $1 / Delta$");
    for (i = 8; i <= 24; i += 8) {
        char text[80];
        snprintf(text, sizeof text, "$E$ = %.3g after $10/Delta$ steps", left[i]);
        plot_note(panel, x[i], 10 / x[i], text);
        printf("Delta = %-6g forgets in %-8.3g steps; after 10/Delta = %g steps E is still %.3g\n", x[i], exact[i],
               10 / x[i], left[i]);
    }
    return plot_csv_close(&csv);
}

int main(void)
{
    static const char *const part_title[4] = { "both together", "the start-up: squared bias",
                                               "samples that resemble each other: variance",
                                               "to forget the seed, $1/Delta$ steps are too few" };
    static const char *const part_label[4] = { "mean squared error", "squared bias", "variance", "steps" };
    static study s;
    char title[160];
    double worst = 0, best, cost;
    plot_chart chart = plot_chart_make(
        NULL, "A chain from 0 at constant importance, and the mean of $cos 2 pi x$ over its $M$ samples. Curves are "
              "exact, points measured (1 standard error; squared bias where it is larger than that).");
    plot_csv csv = plot_csv_open("out/size.csv",
                                 "M,Delta,bias,bias2,variance,mse,measured_bias,bias_error,measured_bias2,"
                                 "bias2_error,measured_variance,variance_error,measured_mse,mse_error");
    plot_csv curves = plot_csv_open("out/size_curves.csv", "M,Delta,bias2,variance,mse");
    metro_result result;
    int i, failed;
    s.quick = plot_quick();
    chart.rows = chart.columns = 2;
    chart.width = 1300;
    for (i = 0; i < 4; i++) {
        chart.panel[i].title = part_title[i];
        chart.panel[i].x_log = chart.panel[i].y_log = 1;
        chart.panel[i].x_label = "size of the perturbation $Delta$, as a part of the circle";
        chart.panel[i].y_label = part_label[i];
    }
    chart.panel[1].y_min = 1e-10;
    result = study_run(&s);
    for (i = 0; i < RUNS && result == METRO_OK; i++) result = draw_run(&chart, &csv, &curves, &s, i, &worst);
    if (result != METRO_OK) {
        fprintf(stderr, "size: %s\n", metro_result_text(result));
        return 1;
    }
    failed = find_best(&chart.panel[0], &best, &cost);
    if (failed) return 1;
    plot_rule_x(&chart.panel[0], best, plot_say(&chart.panel[0], "%", best));
    failed = draw_forget(&chart.panel[3]);
    snprintf(title, sizeof title,
             "The best size is larger than the circle: at %.2f, %.0f samples are worth 100 independent ones", best,
             100 * cost);
    chart.title = title;
    failed |= plot_csv_close(&csv) | plot_csv_close(&curves) | plot_save(&chart, "out/size.svg");
    if (!(worst < 6)) fprintf(stderr, "size: theory and measurement are %.1f standard errors apart\n", worst);
    if (failed || !(worst < 6)) return 1;
    printf("the best size is %.4f of the circle, with %.3f of the error of independent samples; %d measured biases "
           "and variances agree with theory, worst %.1f standard errors\n", best, cost, 2 * RUNS * SIZES, worst);
    return 0;
}
