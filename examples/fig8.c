/* fig8.c: the paper's figure 8 (section 3.3.2): the error of ray bundles against the number of walks, for random
   walks, even ones (quasi-random: 2 D dimensions of one sequence) and Metropolis walks with several sizes of the
   perturbation, in a scene with difficult lighting: two rooms with diffuse and glossy surfaces, the lamp behind an
   almost closed door. The paper's own scene is not public; this is the test scene S2.

   The error is that of the picture in patches: over the patches that the picture shows, weighted with their share
   of it, the root of the mean square of what the reflected radiance is off, relative to the same mean of the truth.
   The truth is a long run with a first shot on the same patches, so the error of cutting surfaces into patches is
   not in it, and its own noise is subtracted. What lamps emit themselves is left out.

   Each run is two series of walks side by side (two chains, two sequences), of which it takes the mean, and there
   are many independent runs. Metropolis chains start at fixed points, one for each of the two, the first of uniform
   draws that are not dark. What such a point leaves in the picture depends on the point, so there are twelve pairs of
   points, each for a share of the runs, and bias and variance are means over the pairs; the second sheet compares
   other starts. How bright the picture is in the mean is taken from the truth, but not with weighted seeds, which
   bring it along. What a start costs, up to 16 walks for a chain, is not counted. Both are in favour of Metropolis.

   The curves are medians, and half of all runs lie in the bands. Means would say less: now and then several
   directions in a row hit the highlights of the floor and the block, the factors of these multiply, and one walk
   shines hundreds of times as brightly as the picture. A mean over few runs shows whether it has met such a walk.
   Bias^2 and variance (eq 7.13) are means all the same; those of random and even walks give no more than an order
   of size.

   See: random and even walks go together, and no perturbation comes near; the smaller it is the worse it gets. On
   the second sheet: from fixed points and by small perturbations much of the squared error is bias, and stays so;
   seeds chosen by importance leave hardly any, but the variance of walks that resemble each other.

   Writes out/fig8.svg, out/fig8.csv (fixed starts), out/fig8_starts.svg, out/fig8_starts.csv. There, error is the
   relative median and error_se its standard error; bias2 (signed) and variance are in units of the truth's mean
   square, and share is that of bias2 in their sum, with standard errors by a jackknife over the runs, or from the
   spread over the pairs of points. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { LOOKS = 8, QUICK_LOOKS = 5, RUNS = 36, QUICK_RUNS = 8, PAIRS = 12, QUICK_PAIRS = 4, BATCHES = 2 };
enum { SIDE = 64, GRID = 32 };
enum { STARTS = 4, ANGLES = 2, MAIN = 6, CURVES = 12 };
enum { FIXED, SEEDS, WEIGHTED, LARGE_STEPS };
enum { RANDOM, EVEN, SMALL, MIDDLE, WIDE, ONE_DIRECTION }; /* the curves of the first sheet */

static const double look[LOOKS] = { 2, 4, 8, 16, 32, 64, 128, 256 };
static const char *const start_name[STARTS] = { "fixed", "seeds", "weighted", "large steps" };
static const char *const start_label[STARTS] = { "fixed points", "seeds", "weighted seeds", "large steps" };

/* A number and its standard error. */
typedef struct {
    double value, error;
} measured;

/* After so many walks: the median error of a run, its quartiles, and the parts of the mean squared error. */
typedef struct {
    measured error, bias2, variance, share; /* of bias in the squared error */
    double low, high;
} verdict;

typedef struct {
    metro_walk walk;
    int start, one_direction;
    double perturbation; /* NaN where nothing is perturbed */
    size_t looks;
    verdict at[LOOKS];
} curve;

/* The part of the patches that the picture shows, with what they reflect. */
typedef struct {
    metro_scene scene;
    size_t visible, runs, pairs;
    size_t *patch;     /* [visible] */
    double *weight;    /* [visible]: what brings the squares of radiance to shares of the truth's power */
    double *truth;     /* [3 * visible], times the weight */
    double brightness; /* the mean luminance of the truth */
    double noise;      /* the squared error of the truth, relative */
    uint64_t truth_walks;
    curve *now;       /* that is measured, and */
    double *radiance; /* [LOOKS * runs * 3 * visible]: its runs, times the weight */
} figure;

static void set_curve(curve *c, metro_walk walk, int start, double perturbation, size_t looks)
{
    memset(c, 0, sizeof *c);
    c->walk = walk;
    c->start = start;
    c->perturbation = perturbation;
    c->looks = looks;
}

static metro_bundles_options options_of(const curve *c)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    options.patch = 0.45;
    options.grid = GRID;
    options.visibility = METRO_LINES;
    options.batches = BATCHES;
    options.threads = 1;
    options.seed = 8;
    options.walk = c->walk;
    options.start = c->start == SEEDS      ? METRO_START_SEEDS
                    : c->start == WEIGHTED ? METRO_START_WEIGHTED
                                           : METRO_START_POINT;
    if (c->start == LARGE_STEPS) options.large_step = 0.25;
    if (c->perturbation > 0) options.perturbation = c->perturbation;
    options.one_direction = c->one_direction;
    return options;
}

/* ---- The truth ---- */

/* The weighted radiance of the patches that are seen. */
static void take_down(const figure *f, const metro_vec3 *radiance, double scale, double *out)
{
    size_t i;
    for (i = 0; i < f->visible; i++) {
        metro_vec3 seen = metro_scale(radiance[f->patch[i]], scale * f->weight[i]);
        out[3 * i] = seen.x;
        out[3 * i + 1] = seen.y;
        out[3 * i + 2] = seen.z;
    }
}

static metro_result keep_truth(figure *f, const metro_bundles *bundles, const metro_vec3 *radiance,
                               const metro_vec3 *error)
{
    size_t i, count = bundles->patches.count, room = 3 * count + 1;
    double power = 0;
    f->patch = (size_t *)malloc(room * sizeof *f->patch);
    f->weight = (double *)malloc(room * sizeof *f->weight);
    f->truth = (double *)malloc(room * sizeof *f->truth);
    if (f->patch == NULL || f->weight == NULL || f->truth == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < count; i++) {
        double share = bundles->share[i];
        if (!(share > 0)) continue;
        f->patch[f->visible] = i;
        f->weight[f->visible++] = sqrt(share);
        f->brightness += share * metro_luminance(radiance[i].x, radiance[i].y, radiance[i].z);
        f->noise += share * metro_dot(error[i], error[i]);
        power += share * metro_dot(radiance[i], radiance[i]);
    }
    f->noise /= power;
    for (i = 0; i < f->visible; i++) f->weight[i] /= sqrt(power);
    take_down(f, radiance, 1, f->truth);
    return METRO_OK;
}

static int show_progress(const metro_bundles *bundles, void *user)
{
    plot_progress(0.25 * (double)bundles->walks / *(const double *)user, "figure 8: the truth");
    return 0;
}

/* The radiance of all patches, and after them its errors; to be freed. */
static metro_vec3 *radiance_of(const metro_bundles *bundles)
{
    size_t count = bundles->patches.count;
    metro_vec3 *radiance = (metro_vec3 *)malloc((2 * count + 1) * sizeof *radiance);
    if (radiance != NULL) metro_bundles_radiance(bundles, radiance, radiance + count);
    return radiance;
}

static metro_result find_truth(figure *f)
{
    static curve even;
    metro_bundles_options options;
    double walks = (double)f->truth_walks;
    metro_vec3 *radiance;
    metro_bundles bundles;
    metro_result result;
    set_curve(&even, METRO_WALK_EVEN, FIXED, (double)NAN, 0);
    options = options_of(&even);
    options.first_shot = 1;
    options.batches = 32;
    options.threads = 0;
    options.seed = 1;
    result = metro_bundles_make(&f->scene, &f->scene.camera, &options, &bundles);
    if (result != METRO_OK) return result;
    result = metro_bundles_run(&bundles, f->truth_walks, show_progress, &walks);
    radiance = result == METRO_OK ? radiance_of(&bundles) : NULL;
    if (result == METRO_OK) result = METRO_ERROR_MEMORY;
    if (radiance != NULL) result = keep_truth(f, &bundles, radiance, radiance + bundles.patches.count);
    free(radiance);
    metro_bundles_free(&bundles);
    return result;
}

/* ---- The runs ---- */

/* Runs in a row share their start points, or differ in nothing but random numbers. */
static size_t runs_alike(const figure *f)
{
    const curve *c = f->now;
    int is_fixed = c->walk == METRO_WALK_METROPOLIS && (c->start == FIXED || c->start == LARGE_STEPS);
    return is_fixed ? f->runs / f->pairs : f->runs;
}

/* What brings the mean brightness to that of the truth; walks that know theirs keep it. */
static double known_brightness(const figure *f, const metro_bundles *bundles)
{
    metro_bundles_report report;
    if (f->now->walk != METRO_WALK_METROPOLIS || f->now->start == WEIGHTED) return 1;
    metro_bundles_diagnose(bundles, &report);
    return f->brightness / report.b;
}

static metro_result one_run(uint64_t job, void *slot, void *user)
{
    const figure *f = (const figure *)user;
    metro_bundles_options options = options_of(f->now);
    metro_bundles bundles;
    metro_vec3 *radiance;
    metro_result result;
    size_t k;
    options.part = job;
    options.start_seed = 1 + job / runs_alike(f);
    result = metro_bundles_make(&f->scene, &f->scene.camera, &options, &bundles);
    if (result != METRO_OK) return result;
    for (k = 0; k < f->now->looks && result == METRO_OK; k++) {
        result = metro_bundles_run(&bundles, (uint64_t)look[k] - bundles.walks, NULL, NULL);
        radiance = result == METRO_OK ? radiance_of(&bundles) : NULL;
        if (result == METRO_OK && radiance == NULL) result = METRO_ERROR_MEMORY;
        if (result == METRO_OK)
            take_down(f, radiance, known_brightness(f, &bundles), (double *)slot + k * 3 * f->visible);
        free(radiance);
    }
    metro_bundles_free(&bundles);
    return result;
}

static metro_result keep_run(uint64_t job, const void *slot, void *user)
{
    figure *f = (figure *)user;
    size_t k, values = 3 * f->visible;
    for (k = 0; k < LOOKS; k++)
        memcpy(f->radiance + (k * f->runs + job) * values, (const double *)slot + k * values,
               values * sizeof(double));
    return METRO_OK;
}

static int smaller_first(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return x < y ? -1 : x > y;
}

/* The number that a share `at` of the sorted ones stays below. */
static double quantile(const double *sorted, size_t count, double at)
{
    double place = at * (double)(count - 1);
    size_t below = (size_t)fmax(0, fmin(place, (double)(count - 1)));
    size_t above = below + 1 < count ? below + 1 : below;
    return sorted[below] + (place - (double)below) * (sorted[above] - sorted[below]);
}

/* How far the share of runs that lie below a number is off: 1/2 over sqrt(n) for n runs near the median (David and
   Nagaraja 2003, section 7.1); where runs share their start points, by its spread over the pairs of points. */
static double share_error(const double *distance, double at, size_t runs, size_t alike)
{
    metro_moments below;
    size_t first, r;
    if (alike == runs) return 0.5 / sqrt((double)runs);
    memset(&below, 0, sizeof below);
    for (first = 0; first < runs; first += alike) {
        double count = 0;
        for (r = first; r < first + alike; r++) count += distance[r] < at ? 1 : distance[r] > at ? 0 : 0.5;
        metro_moments_add(&below, count / (double)alike);
    }
    return metro_moments_error(&below);
}

/* The median over the runs with its standard error, and the quartiles. */
static void judge_median(const figure *f, const double *radiance, size_t alike, verdict *v)
{
    double distance[RUNS], sorted[RUNS], step;
    size_t r, i, values = 3 * f->visible;
    for (r = 0; r < f->runs; r++) {
        double squared = -f->noise;
        for (i = 0; i < values; i++) squared += pow(radiance[r * values + i] - f->truth[i], 2);
        sorted[r] = distance[r] = sqrt(fmax(squared, 0));
    }
    qsort(sorted, f->runs, sizeof *sorted, smaller_first);
    v->error.value = quantile(sorted, f->runs, 0.5);
    step = share_error(distance, v->error.value, f->runs, alike);
    v->error.error = 0.5 * (quantile(sorted, f->runs, 0.5 + step) - quantile(sorted, f->runs, 0.5 - step));
    v->low = quantile(sorted, f->runs, 0.25);
    v->high = quantile(sorted, f->runs, 0.75);
}

static measured measured_of(const metro_moments *moments)
{
    measured m;
    m.value = metro_moments_mean(moments);
    m.error = metro_moments_error(moments);
    return m;
}

/* Bias and variance of runs that are alike; of several pairs of points the mean, with errors from their spread. A
   bright point makes both large, so the error of their ratio is that of what each pair has too much of bias for it. */
static metro_result judge(figure *f, size_t k)
{
    size_t values = 3 * f->visible, alike = runs_alike(f), pairs = f->runs / alike, i;
    const double *radiance = f->radiance + k * f->runs * values;
    verdict *v = &f->now->at[k];
    metro_bias_variance parts[PAIRS];
    metro_moments bias2, variance, excess;
    double all;
    memset(&bias2, 0, sizeof bias2);
    memset(&variance, 0, sizeof variance);
    memset(&excess, 0, sizeof excess);
    for (i = 0; i < pairs; i++) {
        metro_result result = metro_repeats(radiance + i * alike * values, f->truth, alike, values, &parts[i]);
        if (result != METRO_OK) return result;
        metro_moments_add(&bias2, parts[i].bias2 * (double)values - f->noise);
        metro_moments_add(&variance, parts[i].variance * (double)values);
    }
    v->bias2 = measured_of(&bias2);
    v->variance = measured_of(&variance);
    all = v->bias2.value + v->variance.value;
    v->share.value = v->bias2.value / all;
    if (pairs == 1) {
        v->bias2.error = parts[0].bias2_error * (double)values;
        v->variance.error = parts[0].variance_error * (double)values;
        v->share.error =
            hypot(v->variance.value * v->bias2.error, v->bias2.value * v->variance.error) / (all * all);
    } else {
        for (i = 0; i < pairs; i++)
            metro_moments_add(&excess, (double)values * (parts[i].bias2 * (1 - v->share.value)
                                                         - parts[i].variance * v->share.value));
        v->share.error = metro_moments_error(&excess) / all;
    }
    judge_median(f, radiance, alike, v);
    return METRO_OK;
}

static metro_result measure(figure *f, curve *c)
{
    metro_rounds plan;
    metro_result result;
    size_t k;
    f->now = c;
    memset(&plan, 0, sizeof plan);
    plan.jobs = f->runs;
    plan.slot_size = LOOKS * (3 * f->visible + 1) * sizeof(double);
    plan.work = one_run;
    plan.merge = keep_run;
    result = metro_rounds_run(&plan, f);
    for (k = 0; k < c->looks && result == METRO_OK; k++) result = judge(f, k);
    return result;
}

/* ---- Sheets and tables ---- */

static const char *name_of(plot_panel *panel, int c, double perturbation)
{
    if (c == RANDOM) return "random";
    if (c == EVEN) return "even";
    return plot_say(panel, c == ONE_DIRECTION ? "one direction, % rad" : "Metropolis, % rad", perturbation);
}

static uint32_t color_of(int c)
{
    static const uint32_t color[MAIN] = { 0x222222, 0x009e73, 0x0d0887, 0xa52097, 0xec7043, 0xa52097 };
    return color[c];
}

static void draw_curve(plot_panel *panel, const curve *c, int index)
{
    double y[LOOKS], low[LOOKS], high[LOOKS];
    plot_series *line;
    size_t k;
    for (k = 0; k < c->looks; k++) {
        y[k] = c->at[k].error.value;
        low[k] = c->at[k].low;
        high[k] = c->at[k].high;
    }
    if (index != ONE_DIRECTION) plot_band(panel, look, low, high, c->looks, NULL)->color = color_of(index);
    line = plot_line(panel, look, y, c->looks, name_of(panel, index, c->perturbation));
    line->color = color_of(index);
    line->dash = index == ONE_DIRECTION;
}

/* The size with the smallest error at the end. */
static int best_size(const curve *curves)
{
    size_t last = curves[RANDOM].looks - 1;
    int c, best = SMALL;
    for (c = SMALL; c <= ONE_DIRECTION; c++)
        if (curves[c].at[last].error.value < curves[best].at[last].error.value) best = c;
    return best;
}

static int draw(const figure *f, const curve *curves)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[0];
    size_t last = curves[RANDOM].looks - 1;
    int c, best = best_size(curves);
    char title[240], note[400];
    double random = curves[RANDOM].at[last].error.value, metropolis = curves[best].at[last].error.value;
    snprintf(title, sizeof title,
             "Ray bundles in a glossy room behind a door: after %d walks Metropolis is off by %.2f at best (%g rad), "
             "random walks by %.2f, even ones by %.2f",
             (int)look[last], metropolis, curves[best].perturbation, random, curves[EVEN].at[last].error.value);
    snprintf(note, sizeof note,
             "Relative error of the reflected light of the %d patches seen, median of %d runs; half of them lie in "
             "the band. Walks of 7 bundles. A Metropolis run has two chains from fixed points, %d pairs of them in "
             "turn, and perturbs all directions at once (solid) or one of them (dashed).",
             (int)f->visible, (int)f->runs, (int)f->pairs);
    chart.title = title;
    chart.note = note;
    chart.height = 720;
    panel->x_label = "walks";
    panel->y_label = "relative error";
    panel->x_log = panel->y_log = 1;
    panel->better = "down and left is better";
    plot_rule_y(panel, 1, "a black picture");
    for (c = 0; c < MAIN; c++) draw_curve(panel, &curves[c], c);
    return plot_save(&chart, "out/fig8.svg");
}

/* Squared bias as lines with points, where it is above two standard errors; variance dashed. */
static void draw_parts(plot_panel *panel, const curve *c, const char *label)
{
    double bias[LOOKS], error[LOOKS], variance[LOOKS];
    uint32_t color = plot_palette((size_t)c->start);
    plot_series *line;
    size_t k;
    for (k = 0; k < c->looks; k++) {
        bias[k] = c->at[k].bias2.value;
        error[k] = c->at[k].bias2.error;
        variance[k] = c->at[k].variance.value;
        if (!(bias[k] > 2 * error[k])) bias[k] = (double)NAN;
    }
    line = plot_line(panel, look, variance, c->looks, label);
    line->color = color;
    line->dash = 1;
    line->width = 2;
    plot_line(panel, look, bias, c->looks, NULL)->color = color;
    plot_points(panel, look, bias, error, c->looks, NULL)->color = color;
}

/* The share of bias in the squared error, signed. */
static void draw_share(plot_panel *panel, const curve *c, const char *label)
{
    double x[LOOKS], y[LOOKS], error[LOOKS];
    uint32_t color = plot_palette((size_t)c->start);
    size_t k;
    for (k = 0; k < c->looks; k++) {
        x[k] = look[k] * (1 + 0.04 * (c->start - 1.5)); /* side by side */
        y[k] = 100 * c->at[k].share.value;
        error[k] = 100 * c->at[k].share.error;
    }
    plot_line(panel, x, y, c->looks, label)->color = color;
    plot_points(panel, x, y, error, c->looks, NULL)->color = color;
}

/* In percent; what is below 0 only by chance is 0. */
static double bias_share(const curve *c, size_t k)
{
    return 100 * fmax(c->at[k].share.value, 0);
}

/* The curve of one start at one angle; fixed points are on the first sheet. */
static const curve *of_start(const curve *curves, int start, int angle)
{
    return start == FIXED ? &curves[SMALL + angle] : &curves[MAIN + angle * (STARTS - 1) + start - 1];
}

static void name_starts(plot_chart *chart, const curve *curves, int angle)
{
    plot_panel *parts = &chart->panel[angle], *share = &chart->panel[ANGLES + angle];
    parts->title = plot_say(parts, "perturbed by % rad", of_start(curves, FIXED, angle)->perturbation);
    parts->y_label = "squared error / power";
    parts->x_log = parts->y_log = share->x_log = 1;
    parts->y_min = 0.3;
    parts->y_max = 60;
    share->x_label = parts->x_label = "walks";
    share->y_label = "bias^2 in it, %";
    share->y_min = -20;
    share->y_max = 100;
}

static int draw_starts(const figure *f, const curve *curves)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    const curve *fixed = of_start(curves, FIXED, 0), *weighted = of_start(curves, WEIGHTED, 0);
    char title[240], note[400];
    double most = 0;
    size_t k;
    int angle, start;
    for (k = 0; k < weighted->looks; k++) most = fmax(most, bias_share(weighted, k));
    snprintf(title, sizeof title,
             "From fixed points bias is %.0f %% of the squared error after %d walks and %.0f %% after %d; "
             "from weighted seeds at most %.0f %%",
             bias_share(fixed, 0), (int)look[0], bias_share(fixed, 4), (int)look[4], most);
    snprintf(
        note, sizeof note,
        "Above: squared bias (solid, with standard errors, left out below two of them) and variance (dashed). Below, "
        "in the same colours: the share of bias, signed. %d runs of two chains, the fixed points in %d pairs. Large "
        "steps: one mutation in four, from the fixed points. The title is for %g rad.",
        (int)f->runs, (int)f->pairs, fixed->perturbation);
    chart.title = title;
    chart.note = note;
    chart.rows = 2;
    chart.columns = ANGLES;
    chart.width = 1200;
    chart.height = 900;
    for (angle = 0; angle < ANGLES; angle++) {
        plot_rule_y(&chart.panel[ANGLES + angle], 0, NULL);
        name_starts(&chart, curves, angle);
        for (start = 0; start < STARTS; start++) {
            draw_parts(&chart.panel[angle], of_start(curves, start, angle), NULL);
            draw_share(&chart.panel[ANGLES + angle], of_start(curves, start, angle), start_label[start]);
        }
    }
    return plot_save(&chart, "out/fig8_starts.svg");
}

static void write_verdict(plot_csv *csv, double perturbation, double walks, const verdict *v)
{
    PLOT_CSV_ROW(csv, perturbation, walks, v->error.value, v->error.error, v->bias2.value, v->bias2.error,
                 v->variance.value, v->variance.error, v->share.value, v->share.error);
}

static int write_main(const curve *curves)
{
    static const char *const method[3] = { "random", "even", "metropolis" };
    plot_csv csv =
        plot_csv_open("out/fig8.csv", "method,perturbation,walks,error,error_se,bias2,bias2_se,variance,variance_se,"
                                      "share,share_se");
    size_t k;
    int c;
    for (c = 0; c < ONE_DIRECTION; c++)
        for (k = 0; k < curves[c].looks; k++) {
            plot_csv_text(&csv, method[curves[c].walk]);
            write_verdict(&csv, curves[c].perturbation, look[k], &curves[c].at[k]);
        }
    return plot_csv_close(&csv);
}

static int write_starts(const curve *curves)
{
    plot_csv csv = plot_csv_open("out/fig8_starts.csv", "start,directions,perturbation,walks,error,error_se,bias2,"
                                                        "bias2_se,variance,variance_se,share,share_se");
    size_t k;
    int c;
    for (c = SMALL; c < CURVES; c++)
        for (k = 0; k < curves[c].looks; k++) {
            plot_csv_text(&csv, start_name[curves[c].start]);
            plot_csv_text(&csv, curves[c].one_direction ? "one" : "all");
            write_verdict(&csv, curves[c].perturbation, look[k], &curves[c].at[k]);
        }
    return plot_csv_close(&csv);
}

/* ---- The whole ---- */

static void plan_curves(curve *curves, size_t looks)
{
    static const double size[3] = { 0.1, 0.3, 0.8 };
    int i, start;
    set_curve(&curves[RANDOM], METRO_WALK_RANDOM, FIXED, (double)NAN, looks);
    set_curve(&curves[EVEN], METRO_WALK_EVEN, FIXED, (double)NAN, looks);
    for (i = 0; i < 3; i++) set_curve(&curves[SMALL + i], METRO_WALK_METROPOLIS, FIXED, size[i], looks);
    set_curve(&curves[ONE_DIRECTION], METRO_WALK_METROPOLIS, FIXED, size[1], looks);
    curves[ONE_DIRECTION].one_direction = 1;
    for (i = 0; i < ANGLES; i++)
        for (start = SEEDS; start < STARTS; start++)
            set_curve(&curves[MAIN + i * (STARTS - 1) + start - 1], METRO_WALK_METROPOLIS, start, size[i],
                      looks < LOOKS ? looks : LOOKS - 1);
}

static metro_result measure_all(figure *f, curve *curves)
{
    metro_result result = METRO_OK;
    int c;
    f->radiance = (double *)malloc(LOOKS * f->runs * 3 * f->visible * sizeof *f->radiance + 1);
    if (f->radiance == NULL) return METRO_ERROR_MEMORY;
    for (c = 0; c < CURVES && result == METRO_OK; c++) {
        result = measure(f, &curves[c]);
        plot_progress(0.25 + 0.75 * (c + 1.0) / CURVES, "figure 8: walks");
    }
    return result;
}

static void report(const figure *f, const curve *curves)
{
    size_t k;
    int c;
    printf("median relative error after so many walks; the truth is off by %.3f\n%-40s", sqrt(f->noise), "");
    for (k = 0; k < curves[RANDOM].looks; k++) printf(" %8d", (int)look[k]);
    printf("\n");
    for (c = 0; c < CURVES; c++) {
        static const char *const method[3] = { "random", "even", "metropolis" };
        if (curves[c].walk != METRO_WALK_METROPOLIS) printf("%-40s", method[curves[c].walk]);
        else
            printf("metropolis %4g rad, %s, %-12s ", curves[c].perturbation, curves[c].one_direction ? "one" : "all",
                   start_name[curves[c].start]);
        for (k = 0; k < curves[c].looks; k++) printf(" %8.3f", curves[c].at[k].error.value);
        printf("\n%-40s", "  share of bias, %");
        for (k = 0; k < curves[c].looks; k++)
            printf(" %4.0f+-%-2.0f", 100 * curves[c].at[k].share.value, 100 * curves[c].at[k].share.error);
        printf("\n");
    }
}

int main(void)
{
    static figure f;
    static curve curves[CURVES];
    metro_result result;
    size_t last;
    f.runs = plot_quick() ? QUICK_RUNS : RUNS;
    f.pairs = plot_quick() ? QUICK_PAIRS : PAIRS;
    f.truth_walks = plot_quick() ? 1024 : 12288;
    plan_curves(curves, plot_quick() ? QUICK_LOOKS : LOOKS);
    if (light_load("fig8", "tests/data/S2.obj", &f.scene) != 0) return 1;
    result = find_truth(&f);
    if (result == METRO_OK) result = measure_all(&f, curves);
    plot_progress(1, "figure 8");
    if (result != METRO_OK) return light_complain("fig8", "walks", result);
    if (write_main(curves) + write_starts(curves) + draw(&f, curves) + draw_starts(&f, curves) > 0) return 1;
    report(&f, curves);
    last = curves[RANDOM].looks - 1;
    printf("after %d walks: random %.2f, even %.2f, Metropolis %.2f at %g rad, %.2f at %g, %.2f at %g\n",
           (int)look[last], curves[RANDOM].at[last].error.value, curves[EVEN].at[last].error.value,
           curves[SMALL].at[last].error.value, curves[SMALL].perturbation, curves[MIDDLE].at[last].error.value,
           curves[MIDDLE].perturbation, curves[WIDE].at[last].error.value, curves[WIDE].perturbation);
    free(f.patch);
    free(f.weight);
    free(f.truth);
    free(f.radiance);
    metro_scene_free(&f.scene);
    return 0;
}
