/* smoother.c: is the integrand of ray bundles smoother than that of bidirectional paths, and dearer? Section 3 of the
   paper says so, and section 4 concludes that Metropolis sampling gains less from it. Measured on the Cornell box and
   on a room whose lamp is behind a door.

   Both integrands are importances I, the luminance that a sample adds to the picture: of all ways of a path (section
   13.1), or of a walk of bundles (section 14.10). How much they vary along a mutation is

       variation = E[abs(I(z) - I(z'))] / (2 E[I]),   z uniform, z' a perturbation of it,

   0 for a constant and 1 for spikes of which a mutation always loses sight. Since min(a, b) = (a + b - abs(a - b))/2,
   it is the share of mutations that a chain in equilibrium rejects; and this is how it is measured, by chains that
   start from many candidates and burn in, because a uniform z is mostly dark. For the largest angle it is measured
   from uniform pairs as well, as a check.

   The errors are those of the means over 8 x 8 blocks of the picture, relative, against long runs of bidirectional
   path tracing, for Metropolis sampling of .4 rad and for independent samples of the same kind. The Metropolis
   samples come from two chains, which choose their starts among 16 candidates each; these count in the time, not in
   the samples. Bundles keep the error of their patches however long they run.

   See: on the left the lower curve is the smoother integrand. In the middle is what a sample is worth, on the right
   what a second is worth; the solid curve of a color against the dashed one is what Metropolis sampling does to it.

   Writes out/smoother.svg, out/smoother.csv (the variation at .4 rad; the cost of a sample in microseconds; the
   errors after 256 samples, with QUICK=1 after 64, and after the time that bundles take for their last look) and
   out/smoother_curves.csv (what is drawn; x is the apex angle, the number of samples or the time in seconds). */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SCENES = 2, KINDS = 2, ANGLES = 6, CLAIM = 3, BLOCKS = 8, PIECES = BLOCKS * BLOCKS, DEPTH = 6 };
enum { PATHS, BUNDLES, METHODS = 4, LOOKS = 6, SAMPLES = 256, HALVES = 2 };

static const double angle[ANGLES] = { 0.05, 0.1, 0.2, 0.4, 0.8, 1.6 };
static const char *const scene_name[SCENES] = { "cornell", "hidden" };
static const char *const scene_title[SCENES] = { "Cornell box", "Lamp behind a door" };
static const char *const scene_path[SCENES] = { "examples/scenes/cornell.obj", "examples/scenes/hidden.obj" };
static const char *const method_name[METHODS] = { "paths", "bundles", "paths independent", "bundles independent" };

/* One method on one scene. */
typedef struct {
    size_t looks;
    double samples[LOOKS], seconds[LOOKS];
    metro_moments square[LOOKS];  /* of the relative error */
} curve;

typedef struct {
    metro_scene scene[SCENES];
    double patch[SCENES];
    double truth[SCENES][HALVES][PIECES], power[SCENES];
    double variation[SCENES][KINDS][ANGLES], variation_se[SCENES][KINDS][ANGLES];
    double pairs[SCENES][KINDS], pairs_se[SCENES][KINDS];  /* the variation from uniform pairs, largest angle */
    double cost[SCENES][METHODS];                          /* microseconds */
    curve curves[SCENES][METHODS];
} study;

/* ---- The integrands ---- */

static metro_render_options path_options(int method, double apex)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = BLOCKS;
    options.depth = DEPTH;
    options.shortest = 2;
    options.method = method == PATHS ? METRO_MLT : METRO_BDPT;
    options.perturbation = apex;
    options.chains = 2;
    options.candidates = 16;
    options.threads = 1;
    return options;
}

static metro_bundles_options bundle_options(const study *s, size_t scene, int method, double apex)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = 8 * BLOCKS;
    options.depth = DEPTH;
    options.patch = s->patch[scene];
    options.visibility = METRO_LINES;
    options.walk = method == BUNDLES ? METRO_WALK_METROPOLIS : METRO_WALK_RANDOM;
    options.perturbation = apex;
    options.batches = 2;
    options.candidates = 16;
    options.threads = 1;
    return options;
}

/* An integrand with what it reads. */
typedef struct {
    metro_render render;
    metroi_walker walker;
    metro_bundles bundles;
    metro_target target;
} integrand;

static metro_result integrand_make(const study *s, size_t scene, int kind, double apex, integrand *f)
{
    const metro_scene *where = &s->scene[scene];
    metro_result result;
    memset(f, 0, sizeof *f);
    if (kind == PATHS) {
        metro_render_options options = path_options(PATHS, apex);
        result = metro_render_make(where, &where->camera, &options, &f->render);
        if (result != METRO_OK) return result;
        f->walker.plan = &((metroi_render *)f->render.state)->chains;
        f->target.axes = f->walker.plan->axis;
        f->target.axis_count = f->walker.plan->axis_count;
        f->target.sample_size = metroi_sample_size(&f->walker.plan->tracer);
        f->target.importance = metroi_all_importance;
        f->target.user = &f->walker;
    } else {
        metro_bundles_options options = bundle_options(s, scene, BUNDLES, apex);
        result = metro_bundles_make(where, &where->camera, &options, &f->bundles);
        if (result != METRO_OK) return result;
        f->target = ((metroi_bundles *)f->bundles.state)->batch[0].chain.target;
        f->target.record = NULL;
    }
    return METRO_OK;
}

static void integrand_free(integrand *f)
{
    metro_render_free(&f->render);
    metro_bundles_free(&f->bundles);
}

/* ---- Variation ---- */

typedef struct {
    double variation, variation_se, pairs, pairs_se, cost;
} variation_slot;

/* The share of mutations that chains reject. */
static metro_result reject_share(const integrand *f, int kind, uint64_t stream, variation_slot *out)
{
    size_t chains = plot_quick() ? 4 : kind == PATHS ? 24 : 16, c;
    uint64_t slower = plot_quick() ? 4 : 1, candidates = kind == PATHS ? 4096 : 48;
    uint64_t burn = kind == PATHS ? 256 : 12, steps = kind == PATHS ? 1024 : 64;
    metro_moments share = { 0, 0, 0, 0 };
    double seconds = 0;
    metro_chain_options options = { 0, 0 };
    for (c = 0; c < chains; c++) {
        metro_chain chain;
        metro_result result = metro_chain_make(&f->target, &options, metro_rng_make(stream, c), &chain);
        if (result != METRO_OK) return result;
        if (metro_chain_start_weighted(&chain, (size_t)(candidates / slower)) == METRO_OK) {
            double start;
            metro_chain_burn(&chain, burn / slower);
            start = light_cpu_seconds();
            metro_chain_run(&chain, steps / slower);
            seconds += light_cpu_seconds() - start;
            metro_moments_add(&share, 1 - (double)chain.counts.accepted / (double)chain.counts.steps);
        }
        metro_chain_free(&chain);
    }
    out->variation = metro_moments_mean(&share);
    out->variation_se = metro_moments_error(&share);
    out->cost = 1e6 * seconds / ((double)(steps / slower) * (double)share.count);
    return METRO_OK;
}

/* The same by its definition: a ratio of sums over uniform pairs, in groups whose spread gives the error. */
static metro_result pair_share(const integrand *f, int kind, uint64_t stream, variation_slot *out)
{
    enum { GROUPS = 8 };
    size_t pairs = (kind == PATHS ? 8192 : 64) / (plot_quick() ? 16 : 1), g, i;
    size_t doubles = metroi_state_doubles(&f->target);
    double *z = (double *)malloc(2 * doubles * sizeof *z);
    double apart[GROUPS], both[GROUPS], all_apart = 0, all_both = 0, square = 0;
    void *sample = malloc(f->target.sample_size + 1);
    metro_rng rng = metro_rng_make(stream, 999);
    for (g = 0; g < GROUPS && z != NULL && sample != NULL; g++) {
        apart[g] = both[g] = 0;
        for (i = 0; i < pairs; i++) {
            double one, other;
            metroi_state_draw(&f->target, z, &rng);
            metroi_state_perturb(&f->target, z, z + doubles, &rng);
            one = f->target.importance(z, sample, f->target.user);
            other = f->target.importance(z + doubles, sample, f->target.user);
            apart[g] += fabs(one - other);
            both[g] += one + other;
        }
        all_apart += apart[g];
        all_both += both[g];
    }
    out->pairs = all_apart / all_both;
    for (g = 0; g < GROUPS && z != NULL && sample != NULL; g++) square += pow(apart[g] - out->pairs * both[g], 2);
    out->pairs_se = sqrt(square * GROUPS / (GROUPS - 1.0)) / all_both;
    free(z);
    free(sample);
    return z != NULL && sample != NULL ? METRO_OK : METRO_ERROR_MEMORY;
}

/* Jobs in the order of scene, kind, angle; those that take longest first. */
static void variation_place(uint64_t job, size_t *scene, int *kind, size_t *a)
{
    *a = (size_t)job % ANGLES;
    *scene = (size_t)job / ANGLES % SCENES;
    *kind = (int)(KINDS - 1 - job / ANGLES / SCENES);
}

static metro_result variation_work(uint64_t job, void *slot, void *user)
{
    variation_slot *out = (variation_slot *)slot;
    integrand f;
    metro_result result;
    size_t scene, a;
    int kind;
    variation_place(job, &scene, &kind, &a);
    result = integrand_make((const study *)user, scene, kind, angle[a], &f);
    if (result != METRO_OK) return result;
    result = reject_share(&f, kind, 100 + job, out);
    if (result == METRO_OK && a == ANGLES - 1) result = pair_share(&f, kind, 100 + job, out);
    integrand_free(&f);
    return result;
}

static metro_result variation_merge(uint64_t job, const void *slot, void *user)
{
    study *s = (study *)user;
    const variation_slot *one = (const variation_slot *)slot;
    size_t scene, a;
    int kind;
    variation_place(job, &scene, &kind, &a);
    s->variation[scene][kind][a] = one->variation;
    s->variation_se[scene][kind][a] = one->variation_se;
    if (a == CLAIM) s->cost[scene][kind] = one->cost;
    if (a == ANGLES - 1) s->pairs[scene][kind] = one->pairs;
    if (a == ANGLES - 1) s->pairs_se[scene][kind] = one->pairs_se;
    plot_progress(0.1 + 0.5 * (double)(job + 1) / (KINDS * SCENES * ANGLES), "smoother");
    return METRO_OK;
}

/* ---- Errors ---- */

/* The means of both halves of the reference. */
static metro_result find_truth(study *s, size_t scene)
{
    uint64_t rounds = plot_quick() ? 200 : 2500;
    light_study paths;
    metro_result result;
    size_t h, i;
    memset(&paths, 0, sizeof paths);
    paths.scene = &s->scene[scene];
    paths.options = path_options(METHODS, 0);
    paths.options.seed = 50;
    paths.rounds = &rounds;
    paths.looks = 1;
    paths.repeats = HALVES;
    result = light_study_run(&paths);
    if (result != METRO_OK) return result;
    for (h = 0; h < HALVES; h++) light_luminance(light_study_picture(&paths, 0, h), PIECES, s->truth[scene][h]);
    for (i = 0; i < PIECES; i++) s->power[scene] += s->truth[scene][0][i] * s->truth[scene][1][i];
    light_study_free(&paths);
    return METRO_OK;
}

/* What one run comes to at its looks: the means of the blocks. */
typedef struct {
    double samples[LOOKS], seconds[LOOKS], block[LOOKS][PIECES];
} run_slot;

static size_t repeats_of_all(void) { return plot_quick() ? 4 : 12; }

static size_t looks_of(int method)
{
    size_t looks = method % KINDS == PATHS ? LOOKS : 4;
    return plot_quick() ? looks - 1 : looks;
}

/* 64, 256, ... paths, or 4, 16, ... walks. */
static uint64_t samples_at(int method, size_t look)
{
    return (uint64_t)(method % KINDS == PATHS ? PIECES : 4) << 2 * look;
}

static metro_result path_run(const study *s, size_t scene, int method, uint64_t part, run_slot *out)
{
    metro_render_options options = path_options(method, angle[CLAIM]);
    metro_render render;
    metro_result result;
    size_t k;
    double spent = 0;
    options.seed = 51;
    options.part = part;
    options.random_numbers = 1;
    result = metro_render_make(&s->scene[scene], &s->scene[scene].camera, &options, &render);
    for (k = 0; k < looks_of(method) && result == METRO_OK; k++) {
        metro_image image;
        double start = light_cpu_seconds();
        result = metro_render_run(&render, samples_at(method, k) / PIECES - render.rounds, NULL, NULL);
        spent += light_cpu_seconds() - start;
        if (result == METRO_OK) result = metro_render_image(&render, &image);
        if (result != METRO_OK) break;
        out->samples[k] = (double)samples_at(method, k);
        out->seconds[k] = spent;
        light_luminance(image.value, PIECES, out->block[k]);
        metro_image_free(&image);
    }
    if (render.state != NULL) metro_render_free(&render);
    return result;
}

/* The means of the blocks from what the patches reflect; the rays are those of the shares. */
static metro_result bundle_blocks(const metro_bundles *bundles, double *block)
{
    const metroi_bundles *plan = (const metroi_bundles *)bundles->state;
    size_t count = bundles->patches.count, side = 2 * bundles->options.width, x, y, i;
    metro_vec3 *radiance = (metro_vec3 *)malloc((count + 1) * sizeof *radiance);
    metro_result result = METRO_ERROR_MEMORY;
    if (radiance != NULL) result = metro_bundles_radiance(bundles, radiance, NULL);
    for (i = 0; i < PIECES; i++) block[i] = 0;
    for (y = 0; y < side && result == METRO_OK; y++)
        for (x = 0; x < side; x++) {
            metro_hit hit;
            size_t patch = metroi_bundles_look(plan, 0.5 * ((double)x + 0.5), 0.5 * ((double)y + 0.5), &hit);
            if (patch >= count) continue;
            block[y * BLOCKS / side * BLOCKS + x * BLOCKS / side] +=
                metro_luminance(radiance[patch].x, radiance[patch].y, radiance[patch].z) * PIECES
                / ((double)side * (double)side);
        }
    free(radiance);
    return result;
}

static metro_result bundle_run(const study *s, size_t scene, int method, uint64_t part, run_slot *out)
{
    metro_bundles_options options = bundle_options(s, scene, method, angle[CLAIM]);
    metro_bundles bundles;
    metro_result result;
    size_t k;
    double spent = 0;
    options.seed = 52;
    options.part = part;
    result = metro_bundles_make(&s->scene[scene], &s->scene[scene].camera, &options, &bundles);
    if (result != METRO_OK) return result;
    for (k = 0; k < looks_of(method) && result == METRO_OK; k++) {
        double start = light_cpu_seconds();
        result = metro_bundles_run(&bundles, samples_at(method, k) - bundles.walks, NULL, NULL);
        spent += light_cpu_seconds() - start;
        out->samples[k] = (double)samples_at(method, k);
        out->seconds[k] = spent;
        if (result == METRO_OK) result = bundle_blocks(&bundles, out->block[k]);
    }
    metro_bundles_free(&bundles);
    return result;
}

static void run_place(uint64_t job, size_t *scene, int *method)
{
    *method = METHODS - 1 - (int)(job / repeats_of_all() % METHODS);
    *scene = (size_t)(job / repeats_of_all() / METHODS);
}

static metro_result run_work(uint64_t job, void *slot, void *user)
{
    const study *s = (const study *)user;
    size_t scene;
    int method;
    run_place(job, &scene, &method);
    if (method % KINDS == PATHS) return path_run(s, scene, method, job, (run_slot *)slot);
    return bundle_run(s, scene, method, job, (run_slot *)slot);
}

static metro_result run_merge(uint64_t job, const void *slot, void *user)
{
    study *s = (study *)user;
    const run_slot *one = (const run_slot *)slot;
    size_t scene, k, i;
    int method;
    curve *c;
    run_place(job, &scene, &method);
    c = &s->curves[scene][method];
    c->looks = looks_of(method);
    for (k = 0; k < c->looks; k++) {
        double sum = 0;
        for (i = 0; i < PIECES; i++)
            sum += (one->block[k][i] - s->truth[scene][0][i]) * (one->block[k][i] - s->truth[scene][1][i]);
        metro_moments_add(&c->square[k], sum / s->power[scene]);
        c->samples[k] = one->samples[k];
        c->seconds[k] += one->seconds[k] / (double)repeats_of_all();
    }
    plot_progress(0.6 + 0.4 * (double)(job + 1) / (double)(SCENES * METHODS * repeats_of_all()), "smoother");
    return METRO_OK;
}

/* ---- Reading the curves ---- */

static double error_at(const curve *c, size_t look, double *error)
{
    double square = metro_moments_mean(&c->square[look]), root = square > 0 ? sqrt(square) : (double)NAN;
    *error = metro_moments_error(&c->square[look]) / (2 * root);
    return root;
}

/* The error where `at` (samples or seconds) reaches x, on the straight line between two looks in logarithms; beyond
   the ends, what is there. */
static double error_where(const curve *c, const double *at, double x, double *error)
{
    size_t k = 0;
    double low, high, low_error, high_error, share;
    while (k + 2 < c->looks && at[k + 1] < x) k++;
    low = error_at(c, k, &low_error);
    high = error_at(c, k + 1, &high_error);
    share = log(x / at[k]) / log(at[k + 1] / at[k]);
    share = share < 0 ? 0 : share > 1 ? 1 : share;
    *error = low_error + share * (high_error - low_error);
    return low * pow(high / low, share);
}

/* What both are compared at. */
static double few_samples(const study *s)
{
    return fmin(SAMPLES, s->curves[0][BUNDLES].samples[looks_of(BUNDLES) - 1]);
}

static double equal_time(const study *s, size_t scene)
{
    return s->curves[scene][BUNDLES].seconds[looks_of(BUNDLES) - 1];
}

/* ---- The sheet ---- */

static uint32_t color_of(int method) { return plot_palette((size_t)(method % KINDS)); }

static void write_point(plot_csv *csv, const char *chart, size_t scene, int method, double x, double value, double se)
{
    plot_csv_text(csv, chart);
    plot_csv_text(csv, scene_name[scene]);
    plot_csv_text(csv, method_name[method]);
    PLOT_CSV_ROW(csv, x, value, se);
}

static void draw_variation(const study *s, size_t scene, plot_panel *panel, plot_csv *csv)
{
    size_t a;
    int kind;
    for (kind = 0; kind < KINDS; kind++) {
        plot_series *check;
        plot_line(panel, angle, s->variation[scene][kind], ANGLES, method_name[kind])->color = color_of(kind);
        plot_points(panel, angle, s->variation[scene][kind], s->variation_se[scene][kind], ANGLES, NULL)->color =
            color_of(kind);
        check = plot_points(panel, &angle[ANGLES - 1], &s->pairs[scene][kind], &s->pairs_se[scene][kind], 1, NULL);
        check->color = color_of(kind);
        check->marker = 2;
        for (a = 0; a < ANGLES; a++)
            write_point(csv, "variation", scene, kind, angle[a], s->variation[scene][kind][a],
                        s->variation_se[scene][kind][a]);
        write_point(csv, "variation from pairs", scene, kind, angle[ANGLES - 1], s->pairs[scene][kind],
                    s->pairs_se[scene][kind]);
    }
    panel->title = scene_title[scene];
    panel->x_log = 1;
    panel->y_max = 1;
    panel->x_label = "apex angle of the mutation, radians";
    panel->y_label = "variation along a mutation";
}

static void draw_errors(const study *s, size_t scene, plot_panel *samples, plot_panel *time, plot_csv *csv)
{
    int method;
    size_t k;
    for (method = METHODS - 1; method >= 0; method--) {
        const curve *c = &s->curves[scene][method];
        double value[LOOKS], error[LOOKS];
        for (k = 0; k < c->looks; k++) {
            value[k] = error_at(c, k, &error[k]);
            write_point(csv, "error against samples", scene, method, c->samples[k], value[k], error[k]);
            write_point(csv, "error against seconds", scene, method, c->seconds[k], value[k], error[k]);
        }
        plot_line(samples, c->samples, value, c->looks, method_name[method])->color = color_of(method);
        samples->last->dash = method >= KINDS;
        plot_points(samples, c->samples, value, error, c->looks, NULL)->color = color_of(method);
        plot_line(time, c->seconds, value, c->looks, method_name[method])->color = color_of(method);
        time->last->dash = method >= KINDS;
        plot_points(time, c->seconds, value, error, c->looks, NULL)->color = color_of(method);
    }
    samples->x_log = samples->y_log = time->x_log = time->y_log = 1;
    samples->title = "error at equally few samples";
    time->title = "error at equal time";
    samples->x_label = "samples";
    time->x_label = "computing time of one thread, seconds";
    samples->y_label = time->y_label = "relative error of block means";
    time->better = "down and left is better";
}

static void write_claims(const study *s, plot_csv *csv)
{
    size_t scene;
    int m;
    for (scene = 0; scene < SCENES; scene++)
        for (m = 0; m < METHODS; m++) {
            const curve *c = &s->curves[scene][m];
            double samples_error, time_error, cost = s->cost[scene][m];
            double samples = error_where(c, c->samples, few_samples(s), &samples_error);
            double time = error_where(c, c->seconds, equal_time(s, scene), &time_error);
            if (m >= KINDS) cost = 1e6 * c->seconds[c->looks - 1] / c->samples[c->looks - 1];
            plot_csv_text(csv, scene_name[scene]);
            plot_csv_text(csv, method_name[m]);
            PLOT_CSV_ROW(csv, cost, m < KINDS ? s->variation[scene][m][CLAIM] : (double)NAN,
                         m < KINDS ? s->variation_se[scene][m][CLAIM] : (double)NAN, samples, samples_error, time,
                         time_error);
        }
}

static void say(const study *s, char *title, size_t size)
{
    const double (*v)[ANGLES] = s->variation[0];
    const double (*w)[ANGLES] = s->variation[1];
    snprintf(title, size,
             "A mutation of %.1g rad changes the integrand of bundles by %.2g and that of paths by %.2g, behind a "
             "door by %.2g and %.2g; a sample of bundles costs %.0f and %.0f times as much",
             angle[CLAIM], v[BUNDLES][CLAIM], v[PATHS][CLAIM], w[BUNDLES][CLAIM], w[PATHS][CLAIM],
             s->cost[0][BUNDLES] / s->cost[0][PATHS], s->cost[1][BUNDLES] / s->cost[1][PATHS]);
}

static int show(const study *s)
{
    plot_csv claims = plot_csv_open("out/smoother.csv", "scene,method,cost_us,variation,variation_se,"
                                                        "error_equal_samples,error_equal_samples_se,"
                                                        "error_equal_time,error_equal_time_se");
    plot_csv curves = plot_csv_open("out/smoother_curves.csv", "chart,scene,method,x,value,value_se");
    plot_chart chart = plot_chart_make(NULL, "Variation: 0 for a constant, 1 for spikes; it is the share of "
                                             "mutations that are rejected. Diamonds: the same from uniform pairs. "
                                             "Solid: Metropolis sampling of .4 rad, two chains; dashed: independent "
                                             "samples. Bars are standard errors.");
    char title[400];
    size_t scene;
    say(s, title, sizeof title);
    chart.title = title;
    chart.rows = SCENES;
    chart.columns = 3;
    chart.width = 1900;
    chart.height = 1300;
    for (scene = 0; scene < SCENES; scene++) {
        draw_variation(s, scene, &chart.panel[3 * scene], &curves);
        draw_errors(s, scene, &chart.panel[3 * scene + 1], &chart.panel[3 * scene + 2], &curves);
    }
    write_claims(s, &claims);
    plot_progress(1, "smoother");
    printf("%s\n", title);
    return plot_csv_close(&claims) | plot_csv_close(&curves) | plot_save(&chart, "out/smoother.svg");
}

static metro_result run_jobs(study *s, uint64_t jobs, size_t slot_size,
                             metro_result (*work)(uint64_t job, void *slot, void *user),
                             metro_result (*merge)(uint64_t job, const void *slot, void *user))
{
    metro_rounds plan;
    memset(&plan, 0, sizeof plan);
    plan.jobs = jobs;
    plan.slot_size = slot_size;
    plan.work = work;
    plan.merge = merge;
    return metro_rounds_run(&plan, s);
}

int main(void)
{
    static study s;
    metro_result result = METRO_OK;
    metro_vec3 low, high;
    size_t k;
    int status;
    for (k = 0; k < SCENES; k++) {
        if (light_load("smoother", scene_path[k], &s.scene[k]) != 0) return 1;
        metro_scene_bounds(&s.scene[k], &low, &high);
        s.patch[k] = 0.1 * metro_length(metro_subtract(high, low));
        if (result == METRO_OK) result = find_truth(&s, k);
        plot_progress(0.05 * (double)(k + 1), "smoother");
    }
    if (result == METRO_OK)
        result = run_jobs(&s, KINDS * SCENES * ANGLES, sizeof(variation_slot), variation_work, variation_merge);
    if (result == METRO_OK)
        result = run_jobs(&s, SCENES * METHODS * repeats_of_all(), sizeof(run_slot), run_work, run_merge);
    if (result != METRO_OK) return light_complain("smoother", "a study", result);
    status = show(&s);
    for (k = 0; k < SCENES; k++) metro_scene_free(&s.scene[k]);
    return status;
}
