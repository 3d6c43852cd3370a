/* bundles.c: what a bundle of rays costs and how far it is off; speed against accuracy for chapter 14. It belongs to
   section 3.3 of the paper, whose bundles were painted by graphics hardware.

   - The visibilities. Each patch of the Cornell box sends out a random color, and one bundle moves it. For random
     directions and shifts of the grid, what the patches receive is compared with lines on a grid of 4096 rows. The
     deviation over the shifts is the spread, and what the mean over the shifts is off is the bias; both are relative
     to the root mean square of what is received.
   - The grid at equal time: the error of the light that the patches reflect, as the picture shows them, after one
     second of one thread, for 400 to 6,000 patches. It is the error of the walks alone, which their independent
     batches tell; the walks run for a fraction of a second, and their error is scaled by the root of the time.
   - The patches: pictures by bundles against bidirectional path tracing, whose difference is what the patches cost.
     Products of the differences of independent parts have no noise in the mean, so none has to be subtracted.
   - The sequence that runs on: a walk takes its next direction from the next point of one sequence in two dimensions
     (Halton's, as is tempting), on the inside of a sphere of which one half glows.

   See: in bundles.svg the spread falls with the grid, and the painter's bias does not. The sweep is exact, and faster
   than the painter. In bundles_grid.svg a coarse grid with many walks beats a fine one with few. In
   bundles_patches.svg the pictures come closer to the truth with more patches, sooner where radiance is linear on
   each; behind the door light leaks along patches that are lit in part and seen in part. In runon.svg random and even
   walks go on to improve, and the sequence that runs on stays where it is: it converges to a wrong answer.

   Writes out/bundles.svg, one panel of it as out/painter.svg, out/bundles_grid.svg, out/bundles_patches.svg and
   out/runon.svg, with out/bundles.csv, out/bundles_grid.csv, out/bundles_patches.csv and out/bundles_runon.csv.
   Columns that end in _se are standard errors. A bias2 is the square of the bias, without noise in the mean, and may
   come out below 0. */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { WAYS = 4, GRIDS = 7, SIZES = 2 };

static const char *const way_name[WAYS] = { "sweep", "fragments", "painter", "lines" };

static void progress(double done) { plot_progress(done, "bundles"); }

/* Patches of the largest size of which there are at least `count`. */
static double size_for(const metro_scene *scene, size_t count)
{
    metro_patches patches;
    metro_vec3 low, high;
    double size;
    size_t made = 0;
    if (metro_scene_bounds(scene, &low, &high) != METRO_OK) return 0;
    for (size = 0.5 * metro_length(metro_subtract(high, low)); made < count; size *= made < count ? 0.97 : 1) {
        if (metro_patches_make(scene, size, &patches) != METRO_OK) return 0;
        made = patches.count;
        metro_patches_free(&patches);
    }
    return size;
}

/* The root of a square that noise may have made negative, and its error from that of the square. */
static double root_of(double square) { return square > 0 ? sqrt(square) : (double)NAN; }

static double root_error(double square, double error) { return 0.5 * error / root_of(square); }

/* ---- The visibilities ---- */

enum { SHIFTS = 4, TRUTHS = 2 };

/* One visibility on one grid, for one direction. */
typedef struct {
    double seconds, spread2, bias2;
} transfer;

typedef struct {
    metro_patches patches;
    size_t shown;            /* grids */
    double *color;           /* [3 * count] */
    metro_moments seconds[WAYS][GRIDS], spread2[WAYS][GRIDS], bias2[WAYS][GRIDS];
} transfers;

static size_t grid_of(size_t g) { return (size_t)16 << g; }

/* What each patch receives, in the order of `color`; returns the time that it took. */
static double move(metroi_bundle *bundle, const double *color, metro_vec3 direction, const double *shift, double *out)
{
    size_t i, c, count = bundle->patches->count;
    double cell = metroi_bundle_cell(bundle), start;
    for (i = 0; i < count; i++)
        for (c = 0; c < 3; c++) bundle->radiance[4 * i + c] = color[3 * i + c];
    start = light_cpu_seconds();
    metroi_bundle_move(bundle, direction, shift);
    start = light_cpu_seconds() - start;
    for (i = 0; i < count; i++)
        for (c = 0; c < 3; c++) out[3 * i + c] = bundle->received[4 * i + c] * cell / bundle->patches->patch[i].area;
    return start;
}

/* Moves the colors `times` times over shifts of `rng` into rows of `out`; `seconds` (may be NULL) is the least. */
static metro_result move_often(const transfers *t, metro_visibility way, size_t grid, metro_vec3 direction,
                               size_t times, metro_rng *rng, double *out, double *seconds)
{
    metroi_bundle bundle;
    metro_result result = metroi_bundle_make(&t->patches, grid, way, 0, &bundle);
    size_t k;
    double least = (double)INFINITY;
    if (result != METRO_OK) return result;
    for (k = 0; k < times; k++) {
        double shift[2];
        shift[0] = metro_rng_uniform(rng);
        shift[1] = metro_rng_uniform(rng);
        least = fmin(least, move(&bundle, t->color, direction, shift, out + k * 3 * t->patches.count));
    }
    if (seconds != NULL) *seconds = least;
    metroi_bundle_free(&bundle);
    return METRO_OK;
}

/* Spread and bias of `got` (rows of shifts) against two independent truths, relative to `power`. Patches count by
   their area. */
static void compare(const transfers *t, const double *got, const double *truth, double power, transfer *out)
{
    size_t i, k, values = 3 * t->patches.count;
    out->spread2 = out->bias2 = 0;
    for (i = 0; i < values; i++) {
        double mean = 0, variance = 0, area = t->patches.patch[i / 3].area;
        for (k = 0; k < SHIFTS; k++) mean += got[k * values + i] / SHIFTS;
        for (k = 0; k < SHIFTS; k++) variance += pow(got[k * values + i] - mean, 2) / (SHIFTS - 1);
        out->spread2 += area * variance / power;
        out->bias2 += area * ((mean - truth[i]) * (mean - truth[values + i]) - variance / SHIFTS) / power;
    }
}

static metro_result transfer_work(uint64_t job, void *slot, void *user)
{
    const transfers *t = (const transfers *)user;
    size_t i, g, w, values = 3 * t->patches.count;
    metro_rng rng = metro_rng_make(14, job);
    metro_vec3 direction = metro_rng_direction(&rng);
    double *truth = (double *)malloc((TRUTHS + SHIFTS) * values * sizeof *truth), power = 0;
    double *got = truth + TRUTHS * values;
    metro_result result = METRO_ERROR_MEMORY;
    size_t fine = plot_quick() ? 1024 : 4096;
    if (truth != NULL) result = move_often(t, METRO_LINES, fine, direction, TRUTHS, &rng, truth, NULL);
    for (i = 0; result == METRO_OK && i < values; i++)
        power += t->patches.patch[i / 3].area * truth[i] * truth[values + i];
    for (w = 0; w < WAYS; w++)
        for (g = 0; g < t->shown && result == METRO_OK; g++) {
            transfer *out = (transfer *)slot + w * GRIDS + g;
            metro_rng shifts = metro_rng_make(15, job * GRIDS + g);
            result = move_often(t, (metro_visibility)w, grid_of(g), direction, SHIFTS, &shifts, got, &out->seconds);
            if (result == METRO_OK) compare(t, got, truth, power, out);
        }
    free(truth);
    return result;
}

static metro_result transfer_merge(uint64_t job, const void *slot, void *user)
{
    transfers *t = (transfers *)user;
    size_t w, g;
    (void)job;
    for (w = 0; w < WAYS; w++)
        for (g = 0; g < t->shown; g++) {
            const transfer *one = (const transfer *)slot + w * GRIDS + g;
            metro_moments_add(&t->seconds[w][g], one->seconds);
            metro_moments_add(&t->spread2[w][g], one->spread2);
            metro_moments_add(&t->bias2[w][g], one->bias2);
        }
    return METRO_OK;
}

static int transfer_run(const metro_scene *scene, size_t count, transfers *t)
{
    metro_rounds plan;
    metro_rng rng = metro_rng_make(13, 0);
    metro_result result = metro_patches_make(scene, size_for(scene, count), &t->patches);
    size_t i;
    if (result != METRO_OK) return light_complain("bundles", "patches", result);
    t->shown = plot_quick() ? GRIDS - 2 : GRIDS;
    t->color = (double *)malloc(3 * t->patches.count * sizeof *t->color);
    for (i = 0; t->color != NULL && i < 3 * t->patches.count; i++) t->color[i] = metro_rng_uniform(&rng);
    memset(&plan, 0, sizeof plan);
    plan.jobs = plot_quick() ? 4 : 12;
    plan.slot_size = WAYS * GRIDS * sizeof(transfer);
    plan.work = transfer_work;
    plan.merge = transfer_merge;
    result = t->color != NULL ? metro_rounds_run(&plan, t) : METRO_ERROR_MEMORY;
    return result == METRO_OK ? 0 : light_complain("bundles", "visibilities", result);
}

static void transfer_write(const transfers *t, plot_csv *csv)
{
    size_t w, g;
    for (w = 0; w < WAYS; w++)
        for (g = 0; g < t->shown; g++) {
            const metro_moments *seconds = &t->seconds[w][g], *spread2 = &t->spread2[w][g], *bias2 = &t->bias2[w][g];
            plot_csv_text(csv, way_name[w]);
            PLOT_CSV_ROW(csv, (double)t->patches.count, (double)grid_of(g), 1e3 * metro_moments_mean(seconds),
                         1e3 * metro_moments_error(seconds), sqrt(metro_moments_mean(spread2)),
                         root_error(metro_moments_mean(spread2), metro_moments_error(spread2)),
                         metro_moments_mean(bias2), metro_moments_error(bias2));
        }
}

/* Numbers of one visibility against the grid. */
typedef struct {
    double grid[GRIDS], ms[GRIDS], spread[GRIDS], bias[GRIDS], bias_error[GRIDS], most[GRIDS], total[GRIDS];
} transfer_curve;

static transfer_curve curve_of(const transfers *t, size_t w)
{
    transfer_curve c;
    size_t g;
    for (g = 0; g < t->shown; g++) {
        double spread2 = metro_moments_mean(&t->spread2[w][g]), bias2 = metro_moments_mean(&t->bias2[w][g]);
        double error = metro_moments_error(&t->bias2[w][g]);
        c.grid[g] = (double)grid_of(g);
        c.ms[g] = 1e3 * metro_moments_mean(&t->seconds[w][g]);
        c.spread[g] = sqrt(spread2);
        c.bias[g] = bias2 > error ? sqrt(bias2) : (double)NAN;
        c.bias_error[g] = root_error(bias2, error);
        c.most[g] = sqrt(fmax(bias2, 0) + 2 * error);
        c.total[g] = sqrt(spread2 + fmax(bias2, 0));
    }
    return c;
}

/* The largest of the biases, each two standard errors higher, of all visibilities but the painter's. */
static void most_of_others(const transfers *t, double *most)
{
    size_t w, g;
    for (g = 0; g < t->shown; g++) most[g] = 0;
    for (w = 0; w < WAYS; w++) {
        transfer_curve c = curve_of(t, w);
        for (g = 0; g < t->shown && w != METRO_PAINTER; g++) most[g] = fmax(most[g], c.most[g]);
    }
}

/* Spread and bias against the grid. */
static void spread_draw(const transfers *t, plot_panel *panel)
{
    transfer_curve sweep = curve_of(t, METRO_SWEEP), lines = curve_of(t, METRO_LINES);
    transfer_curve painter = curve_of(t, METRO_PAINTER);
    double most[GRIDS];
    size_t n = t->shown;
    most_of_others(t, most);
    plot_line(panel, sweep.grid, sweep.spread, n, "spread, all grids")->color = plot_palette(METRO_SWEEP);
    plot_line(panel, lines.grid, lines.spread, n, "spread, lines")->color = plot_palette(METRO_LINES);
    plot_line(panel, painter.grid, painter.bias, n, "painter's bias")->color = plot_palette(METRO_PAINTER);
    plot_points(panel, painter.grid, painter.bias, painter.bias_error, n, NULL)->color = plot_palette(METRO_PAINTER);
    plot_line(panel, sweep.grid, most, n, "others' bias: less than this")->color = 0x777777;
    panel->last->dash = 2;
    panel->x_log = panel->y_log = 1;
    panel->x_label = "cells along a side of the grid";
    panel->y_label = "relative error of the transfer";
}

/* A row of three panels. */
static void transfer_draw(const transfers *t, plot_panel *panel)
{
    static const size_t order[WAYS] = { METRO_FRAGMENTS, METRO_PAINTER, METRO_SWEEP, METRO_LINES };
    size_t i;
    for (i = 0; i < WAYS; i++) {
        size_t w = order[i];
        transfer_curve c = curve_of(t, w);
        plot_line(&panel[0], c.grid, c.ms, t->shown, way_name[w])->color = plot_palette(w);
        plot_line(&panel[2], c.ms, c.total, t->shown, way_name[w])->color = plot_palette(w);
        plot_points(&panel[2], c.ms, c.total, NULL, t->shown, NULL)->color = plot_palette(w);
    }
    spread_draw(t, &panel[1]);
}

/* The middle panel of the last row alone. */
static int save_painter(const transfers *t, const char *title)
{
    plot_chart chart = plot_chart_make(title, "The Cornell box; each patch sends out a random color. Bars are "
                                              "standard errors. Dotted: two of them above the bias of the other "
                                              "three ways.");
    spread_draw(t, &chart.panel[0]);
    return plot_save(&chart, "out/painter.svg");
}

static plot_chart transfer_sheet(void)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    size_t k;
    chart.rows = 2;
    chart.columns = 3;
    chart.width = 1800;
    chart.height = 1250;
    for (k = 0; k < 6; k++) {
        plot_panel *panel = &chart.panel[k];
        panel->x_log = panel->y_log = 1;
        panel->x_label = k % 3 == 2 ? "time of a bundle, milliseconds" : "cells along a side of the grid";
        panel->y_label = k % 3 == 0 ? "time of a bundle, milliseconds" : "relative error of the transfer";
    }
    chart.panel[2].better = chart.panel[5].better = "down and left is better";
    return chart;
}

static int show_transfers(const metro_scene *scene, char *title, size_t size)
{
    static transfers t[SIZES];
    static const size_t count[SIZES] = { 1600, 6000 };
    plot_csv csv = plot_csv_open("out/bundles.csv",
                                 "way,patches,grid,ms,ms_se,spread,spread_se,bias2,bias2_se");
    plot_chart chart = transfer_sheet();
    size_t k, last;
    double bias2, error, painter, sweep;
    int failed;
    for (k = 0; k < SIZES; k++) {
        if (transfer_run(scene, count[k], &t[k]) != 0) return 1;
        transfer_write(&t[k], &csv);
        transfer_draw(&t[k], &chart.panel[3 * k]);
        chart.panel[3 * k].title = plot_say(&chart.panel[3 * k], "time, % patches", (double)t[k].patches.count);
        chart.panel[3 * k + 1].title = "spread over shifts, and bias";
        chart.panel[3 * k + 2].title = "error against time";
        progress(0.125 * (double)(k + 1));
    }
    last = t[1].shown - 1;
    bias2 = metro_moments_mean(&t[1].bias2[METRO_PAINTER][last]);
    error = root_error(bias2, metro_moments_error(&t[1].bias2[METRO_PAINTER][last]));
    painter = metro_moments_mean(&t[1].seconds[METRO_PAINTER][last]);
    sweep = metro_moments_mean(&t[1].seconds[METRO_SWEEP][last]);
    snprintf(title, size,
             "%s painter's bias: %.2g (+- %.1g) of what is received, on %d x %d cells; the exact sweep takes %.2g "
             "times its time",
             root_of(bias2) > 3 * error ? "No grid removes the" : "Too few directions to tell the", root_of(bias2),
             error, (int)grid_of(last), (int)grid_of(last), sweep / painter);
    chart.title = title;
    chart.note = "The Cornell box; each patch sends out a random color. Mean over directions; bars are standard "
                 "errors. The fragments give what the sweep gives. Dotted: two standard errors above the bias of "
                 "the other three.";
    failed = save_painter(&t[1], title);
    for (k = 0; k < SIZES; k++) {
        metro_patches_free(&t[k].patches);
        free(t[k].color);
    }
    return plot_csv_close(&csv) | plot_save(&chart, "out/bundles.svg") | failed;
}

/* ---- The grid at equal time ---- */

enum { CUTS = 3, STEPS = 6, SHOTS = 2 };

static const size_t cut_count[CUTS] = { 400, 1600, 6000 };

typedef struct {
    const metro_scene *scene;
    double budget, power;
    size_t steps, repeats;                     /* grids, and runs on each */
    double size[CUTS];
    double patches[CUTS];
    metro_moments square[SHOTS][CUTS][STEPS];  /* of the relative error after a second */
    metro_moments walks[SHOTS][CUTS][STEPS];   /* in a second */
} grids;

typedef struct {
    double square, walks, patches;
} grid_slot;

/* Has the thread computed for long enough? */
typedef struct {
    double start, budget;
} watch;

static int watch_stop(const metro_bundles *bundles, void *user)
{
    const watch *w = (const watch *)user;
    (void)bundles;
    return light_cpu_seconds() - w->start >= w->budget;
}

/* The sum over the patches of share times square: of the error, and of the radiance less what its error adds. */
static metro_result squares_of(const metro_bundles *bundles, double *error2, double *power)
{
    size_t i, count = bundles->patches.count;
    metro_vec3 *radiance = (metro_vec3 *)malloc(2 * (count + 1) * sizeof *radiance), *error = radiance + count;
    metro_result result = METRO_ERROR_MEMORY;
    if (radiance != NULL) result = metro_bundles_radiance(bundles, radiance, error);
    *error2 = *power = 0;
    for (i = 0; result == METRO_OK && i < count; i++) {
        *error2 += bundles->share[i] * metro_dot(error[i], error[i]);
        *power += bundles->share[i] * (metro_dot(radiance[i], radiance[i]) - metro_dot(error[i], error[i]));
    }
    free(radiance);
    return result;
}

static metro_bundles_options options_of(double size, size_t grid, int first_shot)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = 64;
    options.patch = size;
    options.grid = grid;
    options.first_shot = first_shot;
    options.threads = 1;
    return options;
}

static metro_result grid_work(uint64_t job, void *slot, void *user)
{
    const grids *g = (const grids *)user;
    size_t row = (size_t)job / g->repeats, step = row % g->steps;
    size_t cut = row / g->steps % CUTS, shot = row / g->steps / CUTS;
    metro_bundles_options options = options_of(g->size[cut], (size_t)16 << step, (int)shot);
    grid_slot *out = (grid_slot *)slot;
    metro_bundles bundles;
    metro_result result;
    watch w;
    double power;
    options.seed = 20;
    options.part = job;
    result = metro_bundles_make(g->scene, &g->scene->camera, &options, &bundles);
    if (result != METRO_OK) return result;
    w.start = light_cpu_seconds();
    w.budget = g->budget;
    result = metro_bundles_run(&bundles, (uint64_t)1 << 30, watch_stop, &w);
    w.start = light_cpu_seconds() - w.start;
    if (result == METRO_ERROR_STOPPED) result = squares_of(&bundles, &out->square, &power);
    out->square *= w.start / g->power;
    out->walks = (double)bundles.walks / w.start;
    out->patches = (double)bundles.patches.count;
    metro_bundles_free(&bundles);
    return result;
}

static metro_result grid_merge(uint64_t job, const void *slot, void *user)
{
    grids *g = (grids *)user;
    size_t row = (size_t)job / g->repeats, step = row % g->steps;
    size_t cut = row / g->steps % CUTS, shot = row / g->steps / CUTS;
    const grid_slot *one = (const grid_slot *)slot;
    metro_moments_add(&g->square[shot][cut][step], one->square);
    metro_moments_add(&g->walks[shot][cut][step], one->walks);
    g->patches[cut] = one->patches;
    return METRO_OK;
}

/* The mean square of the light that the patches reflect, to which errors are relative. */
static metro_result find_power(grids *g)
{
    metro_bundles_options options = options_of(g->size[1], 0, 1);
    metro_bundles bundles;
    metro_result result;
    double error2;
    options.walk = METRO_WALK_EVEN;
    options.threads = 0;
    result = metro_bundles_make(g->scene, &g->scene->camera, &options, &bundles);
    if (result != METRO_OK) return result;
    result = metro_bundles_run(&bundles, plot_quick() ? 64 : 256, NULL, NULL);
    if (result == METRO_OK) result = squares_of(&bundles, &error2, &g->power);
    metro_bundles_free(&bundles);
    return result;
}

static int grid_run(const metro_scene *scene, grids *g)
{
    metro_rounds plan;
    metro_result result;
    size_t cut;
    g->scene = scene;
    g->budget = plot_quick() ? 0.004 : 0.08;
    g->steps = plot_quick() ? STEPS - 2 : STEPS;
    g->repeats = plot_quick() ? 2 : 3;
    for (cut = 0; cut < CUTS; cut++) g->size[cut] = size_for(scene, cut_count[cut]);
    result = find_power(g);
    memset(&plan, 0, sizeof plan);
    plan.jobs = SHOTS * CUTS * g->steps * g->repeats;
    plan.slot_size = sizeof(grid_slot);
    plan.work = grid_work;
    plan.merge = grid_merge;
    if (result == METRO_OK) result = metro_rounds_run(&plan, g);
    return result == METRO_OK ? 0 : light_complain("bundles", "grids", result);
}

/* The error after a second against the grid; returns the best grid of the middle number of patches. */
static size_t grid_draw(const grids *g, size_t shot, plot_panel *panel, plot_csv *csv)
{
    double grid[STEPS], value[STEPS], error[STEPS];
    size_t cut, step, best = 0;
    for (cut = 0; cut < CUTS; cut++) {
        for (step = 0; step < g->steps; step++) {
            double square = metro_moments_mean(&g->square[shot][cut][step]);
            grid[step] = (double)((size_t)16 << step);
            value[step] = sqrt(square);
            error[step] = root_error(square, metro_moments_error(&g->square[shot][cut][step]));
            plot_csv_text(csv, shot ? "first shot" : "bundles");
            PLOT_CSV_ROW(csv, g->patches[cut], grid[step], metro_moments_mean(&g->walks[shot][cut][step]),
                         value[step], error[step]);
            if (cut == 1 && value[step] < value[best]) best = step;
        }
        plot_line(panel, grid, value, g->steps, plot_say(panel, "% patches", g->patches[cut]))->color =
            plot_shade(cut, CUTS);
        plot_points(panel, grid, value, error, g->steps, NULL)->color = plot_shade(cut, CUTS);
    }
    panel->title = shot ? "with a first shot" : "bundles alone";
    panel->x_label = "cells along a side of the grid";
    panel->y_label = "relative error after 1 s of one thread";
    panel->x_log = panel->y_log = 1;
    return best;
}

static int show_grids(const metro_scene *scene, char *title, size_t size)
{
    static grids g;
    plot_csv csv = plot_csv_open("out/bundles_grid.csv", "walks_of,patches,grid,walks_a_second,error,error_se");
    plot_chart chart = plot_chart_make(NULL, "The Cornell box, random walks of 8 edges; the light that visible "
                                             "patches reflect. The noise of the walks alone, without what the size "
                                             "of the patches adds. Bars are standard errors.");
    size_t shot, best[SHOTS], last;
    double gain;
    if (grid_run(scene, &g) != 0) return 1;
    chart.columns = SHOTS;
    chart.width = 1500;
    chart.height = 800;
    for (shot = 0; shot < SHOTS; shot++) best[shot] = grid_draw(&g, shot, &chart.panel[shot], &csv);
    last = g.steps - 1;
    gain = sqrt(metro_moments_mean(&g.square[1][1][last]) / metro_moments_mean(&g.square[1][1][best[1]]));
    snprintf(title, size,
             "A coarse grid with many walks beats a fine one with few: with a first shot %d x %d cells are best for "
             "%d patches, and %d x %d have %.2g times the error",
             16 << best[1], 16 << best[1], (int)g.patches[1], 16 << last, 16 << last, gain);
    chart.title = title;
    return plot_csv_close(&csv) | plot_save(&chart, "out/bundles_grid.svg");
}

/* ---- Patches against paths ---- */

enum { SIDE = 64, PIXELS = SIDE * SIDE, DEPTH = 6, PARTS = 6, PLACES = 4, KINDS = 2, ROOMS = 2 };

static const size_t place_count[PLACES] = { 100, 400, 1600, 6400 };
static const uint64_t place_walks[PLACES] = { 512, 384, 256, 128 };
static const char *const kind_name[KINDS] = { "constant", "linear" };
static const char *const room_title[ROOMS] = { "Cornell box", "Lamp behind a door" };
static const char *const room_path[ROOMS] = { "examples/scenes/cornell.obj", "examples/scenes/hidden.obj" };

/* What pictures by bundles are compared with. */
typedef struct {
    metro_scene scene;
    size_t shown;                                /* sizes of patches */
    double size[PLACES], patches[PLACES];
    double weight[PIXELS];                       /* what a squared difference counts; 0 around the lamp */
    double paths[PARTS][PIXELS];                 /* luminance */
    double picture[KINDS][PLACES][PARTS][PIXELS];
} room;

/* What was found: relMSE and the mean over that of the paths, with standard errors. */
typedef struct {
    double relmse, relmse_se, mean, mean_se;
} finding;

static int find_paths(room *r)
{
    unsigned char mask[PIXELS];
    uint64_t rounds = plot_quick() ? 2 : 24;
    light_study study;
    metro_result result;
    double mean = 0, used = (double)light_mask(&r->scene, SIDE, SIDE, mask);
    size_t i, p;
    memset(&study, 0, sizeof study);
    study.scene = &r->scene;
    study.options.width = study.options.height = SIDE;
    study.options.depth = DEPTH;
    study.options.shortest = 2;
    study.options.seed = 30;
    study.rounds = &rounds;
    study.looks = 1;
    study.repeats = PARTS;
    result = light_study_run(&study);
    if (result != METRO_OK) return light_complain("bundles", "paths", result);
    for (p = 0; p < PARTS; p++) light_luminance(light_study_picture(&study, 0, p), PIXELS, r->paths[p]);
    light_study_free(&study);
    for (i = 0; i < PIXELS; i++) {
        for (p = 0; p < PARTS; p++) r->weight[i] += r->paths[p][i] / PARTS;
        mean += mask[i] ? r->weight[i] / used : 0;
    }
    for (i = 0; i < PIXELS; i++)
        r->weight[i] = mask[i] ? 1 / (r->weight[i] * r->weight[i] + 0.01 * mean * mean) / used : 0;
    return 0;
}

typedef struct {
    double patches, luminance[PIXELS];
} picture_slot;

static metro_result picture_work(uint64_t job, void *slot, void *user)
{
    const room *r = (const room *)user;
    size_t place = r->shown - 1 - job / PARTS % r->shown;
    metro_bundles_options options = options_of(r->size[place], 0, 1);
    picture_slot *out = (picture_slot *)slot;
    metro_bundles bundles;
    metro_image image;
    metro_result result;
    options.depth = DEPTH;
    options.linear = job / PARTS / r->shown == 1;
    options.visibility = METRO_LINES;
    options.walk = METRO_WALK_EVEN;
    options.batches = 2;
    options.seed = 31;
    options.part = job;
    result = metro_bundles_make(&r->scene, &r->scene.camera, &options, &bundles);
    if (result != METRO_OK) return result;
    result = metro_bundles_run(&bundles, plot_quick() ? 16 : place_walks[place], NULL, NULL);
    if (result == METRO_OK) result = metro_bundles_image(&bundles, &image);
    if (result == METRO_OK) {
        light_luminance(image.value, PIXELS, out->luminance);
        metro_image_free(&image);
    }
    out->patches = (double)bundles.patches.count;
    metro_bundles_free(&bundles);
    return result;
}

static metro_result picture_merge(uint64_t job, const void *slot, void *user)
{
    room *r = (room *)user;
    size_t place = r->shown - 1 - job / PARTS % r->shown, kind = job / PARTS / r->shown;
    const picture_slot *one = (const picture_slot *)slot;
    memcpy(r->picture[kind][place][job % PARTS], one->luminance, sizeof one->luminance);
    r->patches[place] = one->patches;
    return METRO_OK;
}

/* What is specular becomes diffuse: bundles find a lobe as rarely as they find a lamp. */
static void make_diffuse(metro_scene *scene)
{
    size_t i;
    for (i = 0; i < scene->material_count; i++) {
        metro_material *material = &scene->material[i];
        material->kd = metro_add(material->kd, material->ks);
        material->ks = metro_vec3_make(0, 0, 0);
    }
}

static int room_run(const char *path, room *r)
{
    metro_rounds plan;
    metro_result result;
    size_t place;
    if (light_load("bundles", path, &r->scene) != 0) return 1;
    make_diffuse(&r->scene);
    if (find_paths(r) != 0) return 1;
    r->shown = plot_quick() ? PLACES - 2 : PLACES;
    for (place = 0; place < r->shown; place++) r->size[place] = size_for(&r->scene, place_count[place]);
    memset(&plan, 0, sizeof plan);
    plan.jobs = KINDS * r->shown * PARTS;
    plan.slot_size = sizeof(picture_slot);
    plan.work = picture_work;
    plan.merge = picture_merge;
    result = metro_rounds_run(&plan, r);
    return result == METRO_OK ? 0 : light_complain("bundles", path, result);
}

/* The mean of the products of different parts' differences, one part (`but`) left out or PARTS for none. */
static double product_of(double (*gram)[PARTS], size_t but)
{
    double sum = 0;
    size_t k, l, pairs = 0;
    for (k = 0; k < PARTS; k++)
        for (l = 0; l < PARTS; l++)
            if (k != l && k != but && l != but) sum += gram[k][l], pairs++;
    return sum / (double)pairs;
}

/* The error of relMSE is that of the jackknife (Efron 1982). */
static finding find(const room *r, size_t kind, size_t place)
{
    double gram[PARTS][PARTS], less[PARTS], middle = 0, square = 0;
    const double (*const picture)[PIXELS] = r->picture[kind][place];
    metro_moments ratio = { 0, 0, 0, 0 };
    finding f;
    size_t k, l, i;
    memset(gram, 0, sizeof gram);
    for (k = 0; k < PARTS; k++) {
        double ours = 0, theirs = 0;
        for (i = 0; i < PIXELS; i++) {
            double difference = picture[k][i] - r->paths[k][i];
            for (l = 0; l < PARTS; l++) gram[k][l] += r->weight[i] * difference * (picture[l][i] - r->paths[l][i]);
            ours += r->weight[i] > 0 ? picture[k][i] : 0;
            theirs += r->weight[i] > 0 ? r->paths[k][i] : 0;
        }
        metro_moments_add(&ratio, ours / theirs);
    }
    for (k = 0; k < PARTS; k++) middle += (less[k] = product_of(gram, k)) / PARTS;
    for (k = 0; k < PARTS; k++) square += pow(less[k] - middle, 2) * (PARTS - 1) / PARTS;
    f.relmse = product_of(gram, PARTS);
    f.relmse_se = sqrt(square);
    f.mean = metro_moments_mean(&ratio);
    f.mean_se = metro_moments_error(&ratio);
    return f;
}

static void room_draw(const room *r, const char *title, plot_panel *relmse, plot_panel *mean, plot_csv *csv,
                      finding *last)
{
    double value[PLACES], error[PLACES], off[PLACES], off_error[PLACES];
    size_t kind, place;
    for (kind = 0; kind < KINDS; kind++) {
        for (place = 0; place < r->shown; place++) {
            finding f = find(r, kind, place);
            value[place] = f.relmse;
            error[place] = f.relmse_se;
            off[place] = 100 * (f.mean - 1);
            off_error[place] = 100 * f.mean_se;
            plot_csv_text(csv, title);
            plot_csv_text(csv, kind_name[kind]);
            PLOT_CSV_ROW(csv, r->patches[place], f.relmse, f.relmse_se, f.mean, f.mean_se);
            last[kind] = f;
        }
        plot_line(relmse, r->patches, value, r->shown, kind_name[kind])->color = plot_palette(kind);
        plot_points(relmse, r->patches, value, error, r->shown, NULL)->color = plot_palette(kind);
        plot_line(mean, r->patches, off, r->shown, kind_name[kind])->color = plot_palette(kind);
        plot_points(mean, r->patches, off, off_error, r->shown, NULL)->color = plot_palette(kind);
    }
    plot_rule_y(mean, 0, NULL);
    relmse->title = title;
    relmse->x_log = relmse->y_log = mean->x_log = 1;
    relmse->x_label = mean->x_label = "patches";
    relmse->y_label = "relMSE against paths";
    mean->y_label = "mean of the picture: off by, percent";
}

static int show_patches(char *title, size_t size)
{
    static room r[ROOMS];
    finding last[ROOMS][KINDS];
    plot_csv csv = plot_csv_open("out/bundles_patches.csv",
                                 "scene,radiance,patches,relmse,relmse_se,mean_ratio,mean_ratio_se");
    plot_chart chart = plot_chart_make(NULL, "64 x 64 pixels, 6 edges, all surfaces diffuse; the reference is "
                                             "bidirectional path tracing. The noise of both has no part in the mean "
                                             "of what is shown; bars are standard errors.");
    size_t k;
    chart.rows = chart.columns = ROOMS;
    chart.width = 1400;
    for (k = 0; k < ROOMS; k++) {
        if (room_run(room_path[k], &r[k]) != 0) return 1;
        room_draw(&r[k], room_title[k], &chart.panel[k], &chart.panel[ROOMS + k], &csv, last[k]);
        metro_scene_free(&r[k].scene);
        progress(0.55 + 0.15 * (double)(k + 1));
    }
    snprintf(title, size,
             "In the Cornell box smaller patches come closer to the truth: %.0f by relMSE %.2g, and %.2g if radiance "
             "is linear; behind the door the picture is still %.2f (+- %.2f) and %.2f (+- %.2f) times as bright as "
             "paths make it",
             r[0].patches[r[0].shown - 1], last[0][0].relmse, last[0][1].relmse, last[1][0].mean, last[1][0].mean_se,
             last[1][1].mean, last[1][1].mean_se);
    chart.title = title;
    return plot_csv_close(&csv) | plot_save(&chart, "out/bundles_patches.svg");
}

/* ---- The sequence that runs on ---- */

enum { DRAWS = 3, LOOKS = 10, RUNS = 16 };

static const char *const draw_name[DRAWS] = { "random", "even", "one that runs on" };

/* The luminance that each patch reflects, of one batch or of the even or odd ones (RUNS, RUNS + 1). */
static double batch_value(const metro_bundles *bundles, size_t batch, size_t patch)
{
    const metroi_bundles *plan = (const metroi_bundles *)bundles->state;
    double sum = 0;
    size_t b;
    for (b = 0; b < RUNS; b++) {
        const double *color = plan->batch[b].sum + 3 * patch;
        if (b == batch || (batch >= RUNS && b % 2 == batch - RUNS))
            sum += metro_luminance(color[0], color[1], color[2]);
    }
    return sum / (double)plan->rounds / (batch < RUNS ? 1 : RUNS / 2);
}

/* The square of the relative error of each batch in the mean, its error, and that of the mean of the batches, less
   its noise: the bias. `truth` has two independent halves. */
static void look(const metro_bundles *bundles, const metro_bundles *truth, metro_moments *square, double *bias2)
{
    double power = 0, cross = 0;
    size_t i, b, count = bundles->patches.count;
    for (i = 0; i < count; i++) {
        double one = batch_value(truth, RUNS, i), other = batch_value(truth, RUNS + 1, i);
        double first = batch_value(bundles, RUNS, i) - one, second = batch_value(bundles, RUNS + 1, i) - other;
        power += bundles->share[i] * one * other;
        cross += bundles->share[i] * first * second;
    }
    *bias2 = cross / power;
    memset(square, 0, sizeof *square);
    for (b = 0; b < RUNS; b++) {
        double sum = 0;
        for (i = 0; i < count; i++) {
            double value = batch_value(bundles, b, i), share = bundles->share[i];
            sum += share * (value - batch_value(truth, RUNS, i)) * (value - batch_value(truth, RUNS + 1, i));
        }
        metro_moments_add(square, sum / power);
    }
}

static metro_result run_on_make(const metro_scene *scene, int draw, metro_bundles *bundles)
{
    metro_bundles_options options = options_of(2, 24, draw == DRAWS);
    options.depth = 4;
    options.batches = RUNS;
    options.threads = 0;
    options.walk = draw == 0 ? METRO_WALK_RANDOM : METRO_WALK_EVEN;
    options.run_on = draw == 2;
    options.seed = 40 + (uint64_t)draw;
    return metro_bundles_make(scene, &scene->camera, &options, bundles);
}

typedef struct {
    double walks[LOOKS], error[LOOKS], error_se[LOOKS], bias2[LOOKS];
    size_t looks;
} run_on_curve;

static metro_result run_on_run(const metro_scene *scene, int draw, const metro_bundles *truth, run_on_curve *c)
{
    metro_bundles bundles;
    metro_result result = run_on_make(scene, draw, &bundles);
    size_t k;
    if (result != METRO_OK) return result;
    c->looks = plot_quick() ? LOOKS - 3 : LOOKS;
    for (k = 0; k < c->looks && result == METRO_OK; k++) {
        metro_moments square;
        result = metro_bundles_run(&bundles, ((uint64_t)RUNS << k) - bundles.walks, NULL, NULL);
        if (result != METRO_OK) break;
        look(&bundles, truth, &square, &c->bias2[k]);
        c->walks[k] = (double)(1 << k);
        c->error[k] = sqrt(metro_moments_mean(&square));
        c->error_se[k] = root_error(metro_moments_mean(&square), metro_moments_error(&square));
    }
    metro_bundles_free(&bundles);
    return result;
}

static metro_result run_on_study(run_on_curve *c)
{
    metro_scene scene;
    metro_bundles truth;
    metro_result result;
    int draw;
    if (light_load("bundles", "examples/scenes/sphere.obj", &scene) != 0) return METRO_ERROR_FILE;
    result = run_on_make(&scene, DRAWS, &truth);
    if (result == METRO_OK) {
        result = metro_bundles_run(&truth, plot_quick() ? 512 : 4096, NULL, NULL);
        for (draw = 0; draw < DRAWS && result == METRO_OK; draw++)
            result = run_on_run(&scene, draw, &truth, &c[draw]);
        metro_bundles_free(&truth);
    }
    metro_scene_free(&scene);
    return result;
}

static int show_run_on(char *title, size_t size)
{
    static run_on_curve c[DRAWS];
    plot_csv csv = plot_csv_open("out/bundles_runon.csv", "sequence,walks,error,error_se,bias2");
    plot_chart chart = plot_chart_make(NULL, "The inside of a sphere of which one half glows: light that visible "
                                             "patches reflect, paths of 4 edges. Root mean square over 16 runs; bars "
                                             "are standard errors. Dashed: the mean of the 16 that run on.");
    plot_panel *panel = &chart.panel[0];
    metro_result result = run_on_study(c);
    size_t draw, k, last = c[2].looks - 1;
    if (result != METRO_OK) return light_complain("bundles", "a sequence that runs on", result);
    for (draw = 0; draw < DRAWS; draw++) {
        double bias[LOOKS];
        plot_line(panel, c[draw].walks, c[draw].error, c[draw].looks, draw_name[draw])->color = plot_palette(draw);
        plot_points(panel, c[draw].walks, c[draw].error, c[draw].error_se, c[draw].looks, NULL)->color =
            plot_palette(draw);
        for (k = 0; k < c[draw].looks; k++) {
            bias[k] = k < 4 ? (double)NAN : root_of(c[draw].bias2[k]);
            plot_csv_text(&csv, draw_name[draw]);
            PLOT_CSV_ROW(&csv, c[draw].walks[k], c[draw].error[k], c[draw].error_se[k], c[draw].bias2[k]);
        }
        if (draw < 2) continue;
        plot_line(panel, c[draw].walks, bias, c[draw].looks, "their mean")->color = plot_palette(draw);
        panel->last->dash = 1;
    }
    panel->x_log = panel->y_log = 1;
    panel->x_label = "walks";
    panel->y_label = "relative error of reflected light";
    snprintf(title, size,
             "A sequence that runs on converges to a wrong answer: after %.0f walks it is off by %.2g, random "
             "walks by %.2g, even ones by %.2g",
             c[2].walks[last], c[2].error[last], c[0].error[last], c[1].error[last]);
    chart.title = title;
    return plot_csv_close(&csv) | plot_save(&chart, "out/runon.svg");
}

int main(void)
{
    metro_scene cornell;
    char title[4][400];
    int i;
    if (light_load("bundles", "examples/scenes/cornell.obj", &cornell) != 0) return 1;
    if (show_transfers(&cornell, title[0], sizeof title[0]) != 0) return 1;
    if (show_grids(&cornell, title[1], sizeof title[1]) != 0) return 1;
    metro_scene_free(&cornell);
    progress(0.55);
    if (show_patches(title[2], sizeof title[2]) != 0) return 1;
    if (show_run_on(title[3], sizeof title[3]) != 0) return 1;
    progress(1);
    for (i = 3; i >= 0; i--) printf("%s\n", title[i]);
    return 0;
}
