/* seeds.c: starting from multiple seeds (section 2.1 of the paper). Its error formula, paper (15), is printed with
   the sum over the seeds inside the power 2n; it belongs outside, as eq 5.41 has it. Left: both formulas for three
   seeds, and an ensemble of chains that decides between them. Right: how the error falls with the number of seeds, as
   1/sqrt(N) for seeds drawn at random, and far faster for N equispaced ones, which cancel every harmonic that N does
   not divide.

   Writes out/seeds.csv (left), out/seeds_number.csv (right) and out/seeds.svg. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { STEPS = 16, TIMES = 8, MOST_SEEDS = 64, DOUBLINGS = 7, SETS = 40, ALL_SETS = DOUBLINGS * SETS };

static const double three[] = { 0, 0.25, 0.6 }, three_alpha[] = { 0.2, 0.3, 0.5 };
static const metro_kernel three_kernel = { METRO_UNIFORM, 0.3, 0, 0 };
static const uint64_t time_of[TIMES] = { 2, 3, 4, 5, 7, 9, 11, 13 };
static const metro_kernel number_kernel = { METRO_UNIFORM, 0.1, 0, 0 };
static const uint64_t number_steps = 10; /* after which the right panel looks */

/* An estimate of E_n with its standard error; NaN where it is not two standard errors of E_n^2 above zero. */
typedef struct {
    double value, error;
    double score; /* standard errors of E_n^2 that the exact value is off */
} estimate;

static double constant_importance(const double *z, void *sample, void *user)
{
    (void)z, (void)sample, (void)user;
    return 1;
}

/* Measures E_n at `times` looks with `chains` chains, and compares with eq 5.41. Exits with a message on failure. */
static void measure(const metro_kernel *kernel, const double *seed, const double *alpha, size_t seeds,
                    const uint64_t *steps, size_t times, uint64_t chains, uint64_t random_seed, estimate *e)
{
    double squared[TIMES], error[TIMES];
    metro_axis axis;
    metro_target target;
    metro_ensemble plan;
    metro_result result;
    size_t i;
    memset(&target, 0, sizeof target);
    memset(&plan, 0, sizeof plan);
    axis.kind = METRO_CIRCLE;
    axis.kernel = *kernel;
    target.axes = &axis;
    target.axis_count = 1;
    target.importance = constant_importance;
    plan.target = &target;
    plan.seed = seed;
    plan.alpha = alpha;
    plan.seeds = seeds;
    plan.steps = steps;
    plan.times = times;
    plan.chains = chains;
    plan.harmonics = 32; /* beyond them lie less than 1e-4 of E_n^2 at the looks of this program */
    plan.random_seed = random_seed;
    result = metro_ensemble_measure(&plan, squared, error);
    if (result != METRO_OK) {
        fprintf(stderr, "seeds: %s\n", metro_result_text(result));
        exit(1);
    }
    for (i = 0; i < times; i++) {
        double exact = metro_startup_error_seeds(kernel, steps[i], seed, alpha, seeds);
        e[i].value = squared[i] > 2 * error[i] ? sqrt(squared[i]) : (double)NAN;
        e[i].error = error[i] / (2 * e[i].value);
        e[i].score = (squared[i] - exact * exact) / error[i];
    }
}

/* Paper (15) as it is printed, but for the unit of its x: the sum over the seeds, whose modulus does not depend on x,
   is raised to 2n with the coefficient. What lies beyond the 20000th term is below 1e-4 of the sum at n = 1, and
   nothing later. */
static double printed_error(const metro_kernel *kernel, uint64_t n, const double *seed, const double *alpha,
                            size_t seeds)
{
    double sum = 0;
    long k;
    size_t i;
    for (k = 1; k <= 20000; k++) {
        double re = 0, im = 0, turn = 2 * acos(-1.0) * (double)k;
        for (i = 0; i < seeds; i++) {
            re += alpha[i] * cos(turn * seed[i]);
            im += alpha[i] * sin(turn * seed[i]);
        }
        sum += 2 * pow(fabs(metro_kernel_coefficient(kernel, k)) * sqrt(re * re + im * im), 2 * (double)n);
    }
    return sqrt(sum);
}

/* The left panel: three seeds, both formulas and an ensemble. `at_3` gets the measurement at n = 3. */
static int draw_formulas(plot_panel *panel, uint64_t chains, estimate *at_3, double *worst)
{
    plot_csv csv = plot_csv_open("out/seeds.csv", "n,corrected,printed,one_seed,estimate,error,score");
    double n[STEPS], corrected[STEPS], printed[STEPS], single[STEPS], x[TIMES], y[TIMES], bar[TIMES];
    estimate measured[TIMES];
    size_t i, looked = 0;
    measure(&three_kernel, three, three_alpha, 3, time_of, TIMES, chains, 1, measured);
    printf("three seeds, Delta = %g\n%4s %10s %10s %22s %8s\n", three_kernel.size, "n", "corrected", "printed",
           "measured", "off");
    for (i = 0; i < STEPS; i++) {
        estimate none = { (double)NAN, (double)NAN, (double)NAN }, *e = &none;
        uint64_t step = (uint64_t)i + 1;
        if (looked < TIMES && time_of[looked] == step) {
            e = &measured[looked];
            *worst = fmax(*worst, fabs(e->score));
            if (step == 3) *at_3 = *e;
            x[looked] = (double)step;
            y[looked] = e->value;
            bar[looked++] = e->error;
        }
        n[i] = (double)step;
        corrected[i] = metro_startup_error_seeds(&three_kernel, step, three, three_alpha, 3);
        printed[i] = printed_error(&three_kernel, step, three, three_alpha, 3);
        single[i] = metro_startup_error(&three_kernel, step);
        PLOT_CSV_ROW(&csv, n[i], corrected[i], printed[i], single[i], e->value, e->error, e->score);
        if (e != &none)
            printf("%4g %10.6f %10.6f %12.6f +- %.6f %8.1f\n", n[i], corrected[i], printed[i], e->value, e->error,
                   e->score);
    }
    plot_line(panel, n, corrected, STEPS, "corrected (15)")->color = plot_palette(0);
    plot_line(panel, n, printed, STEPS, "printed (15)")->color = plot_palette(1);
    plot_line(panel, n, single, STEPS, "one seed")->color = plot_palette(7);
    plot_points(panel, x, y, bar, TIMES, "estimates from chains, 1 standard error")->color = plot_palette(0);
    panel->title = plot_say(panel, "three seeds, $Delta$ = %", three_kernel.size);
    panel->x_label = "steps $n$";
    panel->y_label = "start-up error $E_n$";
    panel->y_log = 1;
    panel->x_min = 1;
    panel->x_max = STEPS;
    panel->y_min = 1e-3;
    panel->y_max = 3;
    return plot_csv_close(&csv);
}

static void row(plot_csv *csv, const char *kind, double seeds, double set, double E, const estimate *e)
{
    plot_csv_text(csv, kind);
    PLOT_CSV_ROW(csv, seeds, set, E, e->value, e->error, e->score);
}

/* Equispaced seeds: exact for each number of them, measured for the first few. Returns how many beat `rival`. */
static double draw_equispaced(plot_panel *panel, plot_csv *csv, uint64_t chains, double rival, double *worst)
{
    double seed[MOST_SEEDS], x[MOST_SEEDS], y[MOST_SEEDS], value[MOST_SEEDS], bar[MOST_SEEDS], enough = 0;
    size_t count, i;
    for (count = 1; count <= MOST_SEEDS; count++) {
        estimate e = { (double)NAN, (double)NAN, (double)NAN };
        for (i = 0; i < count; i++) seed[i] = (double)i / (double)count;
        x[count - 1] = (double)count;
        y[count - 1] = metro_startup_error_seeds(&number_kernel, number_steps, seed, NULL, count);
        if (enough < 1 && y[count - 1] < rival) enough = (double)count;
        if (count <= 5) {
            measure(&number_kernel, seed, NULL, count, &number_steps, 1, chains, 10 + count, &e);
            *worst = fmax(*worst, fabs(e.score));
        }
        value[count - 1] = e.value;
        bar[count - 1] = e.error;
        row(csv, "equispaced", x[count - 1], 0, y[count - 1], &e);
    }
    plot_line(panel, x, y, MOST_SEEDS, "equispaced seeds")->color = plot_palette(2);
    plot_points(panel, x, value, bar, MOST_SEEDS, NULL)->color = plot_palette(2);
    return enough;
}

/* Seeds at random: exact for many sets of 1, 2, 4, ... 64, measured for the first set of each. `rms` gets, for each
   number, the root mean square over the sets. */
static void draw_random(plot_panel *panel, plot_csv *csv, uint64_t chains, double *rms, double *worst)
{
    double seed[MOST_SEEDS], x[ALL_SETS], y[ALL_SETS], number[DOUBLINGS], value[DOUBLINGS], bar[DOUBLINGS];
    metro_rng rng = metro_rng_make(3, 0);
    size_t k, set, i;
    for (k = 0; k < DOUBLINGS; k++) {
        size_t count = (size_t)1 << k;
        number[k] = (double)count;
        for (rms[k] = 0, set = 0; set < SETS; set++) {
            estimate e = { (double)NAN, (double)NAN, (double)NAN };
            size_t at = k * SETS + set;
            for (i = 0; i < count; i++) seed[i] = metro_rng_uniform(&rng);
            x[at] = number[k];
            y[at] = metro_startup_error_seeds(&number_kernel, number_steps, seed, NULL, count);
            rms[k] += y[at] * y[at] / (double)SETS;
            if (set == 0) {
                measure(&number_kernel, seed, NULL, count, &number_steps, 1, chains, 20 + k, &e);
                *worst = fmax(*worst, fabs(e.score));
                value[k] = e.value;
                bar[k] = e.error;
            }
            row(csv, "random", x[at], (double)set, y[at], &e);
        }
        rms[k] = sqrt(rms[k]);
        plot_progress((double)(k + 2) / (DOUBLINGS + 2), "seeds");
    }
    plot_points(panel, x, y, NULL, ALL_SETS, "random seeds: each dot a set of them")->color = plot_palette(5);
    plot_points(panel, number, value, bar, DOUBLINGS, NULL)->color = plot_palette(0);
}

int main(void)
{
    const uint64_t chains = plot_quick() ? 40000 : 1000000;
    plot_csv csv = plot_csv_open("out/seeds_number.csv", "kind,seeds,set,startup_error,estimate,error,score");
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[1];
    double first = metro_startup_error(&number_kernel, number_steps), worst = 0, enough, off;
    double rms[DOUBLINGS], ends[2] = { 1, MOST_SEEDS }, law[2];
    double corrected = metro_startup_error_seeds(&three_kernel, 3, three, three_alpha, 3);
    double printed = printed_error(&three_kernel, 3, three, three_alpha, 3);
    char title[200], note[400], right[80];
    estimate at_3 = { 0, 0, 0 };
    int failed = draw_formulas(&chart.panel[0], chains, &at_3, &worst);
    size_t k;

    /* The right panel */
    draw_random(panel, &csv, chains, rms, &worst);
    law[0] = first;
    law[1] = first / sqrt(ends[1]); /* random seeds have E abs(A_k)^2 = 1/N for every harmonic k */
    plot_line(panel, ends, law, 2, "$1/sqrt N$")->color = plot_palette(6);
    enough = draw_equispaced(panel, &csv, chains, rms[DOUBLINGS - 1], &worst);
    snprintf(right, sizeof right, "$N$ seeds, $Delta$ = %g, $n$ = %d", number_kernel.size, (int)number_steps);
    panel->title = right;
    panel->x_label = "number of seeds $N$";
    panel->y_label = "start-up error $E_n$";
    panel->x_log = panel->y_log = 1;
    panel->x_min = 1;
    panel->x_max = MOST_SEEDS;
    panel->y_min = 1e-3;
    panel->y_max = 3;
    printf("random seeds, Delta = %g, n = %d\n%4s %24s %12s\n", number_kernel.size, (int)number_steps, "N",
           "rms E_n over the sets", "E_n/sqrt(N)");
    for (k = 0; k < DOUBLINGS; k++) printf("%4d %24.4f %12.4f\n", 1 << k, rms[k], first / sqrt((double)(1 << k)));

    off = fabs(at_3.value * at_3.value - printed * printed) / (2 * at_3.value * at_3.error);
    snprintf(title, sizeof title,
             "The printed (15) is %.0f times too small after 3 steps; %g equispaced seeds beat %d at "
             "random",
             corrected / printed, enough, MOST_SEEDS);
    chart.title = title;
    snprintf(
        note, sizeof note,
        "Read: lower is closer to uniform. Left: seeds %g, %g and %g with weights %g, %g and %g; the chains decide "
        "between the two formulas. Right: how much more seeds of equal weight help; small dots are exact for sets "
        "of random seeds, around the line that theory expects, large ones estimates for a set of each.",
        three[0], three[1], three[2], three_alpha[0], three_alpha[1], three_alpha[2]);
    chart.note = note;
    chart.columns = 2;
    failed += plot_csv_close(&csv);
    if (failed + plot_save(&chart, "out/seeds.svg") > 0) return 1;
    if (!(worst < 6)) {
        fprintf(stderr, "seeds: an estimate is %.1f standard errors off eq. 15 as corrected\n", worst);
        return 1;
    }
    printf("at n = 3 the corrected (15) gives %.6f, chains %.4f +- %.4f, the printed (15) %.6f, %.0f standard errors "
           "off; "
           "%g equispaced seeds beat %d at random\n",
           corrected, at_3.value, at_3.error, printed, off, enough, MOST_SEEDS);
    return 0;
}
