/* whole.c: the whole paper on one page: what does a second of computing buy? It belongs to section 4 of the paper,
   its conclusions.

   Both integrals of the paper, over light paths and over walks of ray bundles, both kinds of samples, independent and
   Metropolis, and both kinds of scenes, even light and difficult light. Each method runs on one thread, several times
   with other random numbers, and the error of its picture is compared with a long run of bidirectional path tracing.
   The lamp is not seen directly, and its pixels and those around it do not count. What bundles take includes one last
   gathering, 36 rays a pixel.

   Ray bundles have a second error, which no time removes: the picture is made of patches. The dashed rule is that
   error alone, where it can be told from the noise.

   See: down and left is better. In even light bundles with even directions and path tracing take turns, until the
   patches hold the bundles up. Behind the door bidirectional paths and Metropolis sampling in primary space share the
   front, by this measure; `costs` weighs dark pixels as much as bright ones, and there primary space leads. For
   bundles the first shot and even directions help, and Metropolis does not: a walk lights all of the scene, so its
   importance says little about any part of it.

   Writes out/whole.svg and out/whole.csv: scene, method, seconds, error (relative RMSE, mean over the repeats), its
   standard error, and floor (of the patches alone; NaN for paths and where noise hides it). */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SIDE = 64, PIXELS = SIDE * SIDE, DEPTH = 6, LOOKS = 10, SCENES = 2, REPEATS = 4 };
enum { PATH, BDPT, MLT, PSSMLT, RANDOM, SHOT, EVEN, METROPOLIS, METHODS };

static const char *const name_of[METHODS] = { "path tracing", "bidirectional", "MLT .3 rad", "primary space",
                                              "bundles, plain", "bundles, first shot", "even bundles",
                                              "Metropolis bundles" };
static const char *const scene_name[SCENES] = { "Cornell box", "lamp behind a door" };
static const char *const scene_path[SCENES] = { "examples/scenes/cornell.obj", "examples/scenes/hidden.obj" };

typedef struct {
    metro_scene scene;
    unsigned char mask[PIXELS];
    double truth[3 * PIXELS], power, noise; /* power: of the truth where it counts; noise: squared, relative */
} setting;

typedef struct {
    size_t looks;
    double seconds[LOOKS], error[LOOKS], spread[LOOKS];
} curve;

/* The repeats of one method; a job is one repeat, and leaves seconds and squared error at each look. */
typedef struct {
    const setting *s;
    int method;
    double budget;
    metro_moments seconds[LOOKS], squared[LOOKS];
} study;

typedef struct {
    size_t looks;
    double seconds[LOOKS], squared[LOOKS];
} outcome;

static double squared_error(const setting *s, const metro_image *image)
{
    double sum = 0;
    size_t i;
    for (i = 0; i < 3 * (size_t)PIXELS; i++)
        if (s->mask[i / 3]) sum += (image->value[i] - s->truth[i]) * (image->value[i] - s->truth[i]);
    return sum / s->power - s->noise;
}

/* A render of either kind, one thread, known by one face. */
typedef struct {
    int method;
    metro_render render;
    metro_bundles bundles;
} any_render;

static metro_result any_make(const setting *s, int method, uint64_t part, any_render *any)
{
    metro_render_options o;
    metro_bundles_options b;
    memset(any, 0, sizeof *any);
    memset(&o, 0, sizeof o);
    memset(&b, 0, sizeof b);
    any->method = method;
    if (method < RANDOM) {
        static const metro_method how[RANDOM] = { METRO_PATH, METRO_BDPT, METRO_MLT, METRO_PSSMLT };
        o.width = o.height = SIDE;
        o.depth = DEPTH;
        o.shortest = 2;
        o.method = how[method];
        o.candidates = 256;
        o.part = part;
        o.threads = 1;
        return metro_render_make(&s->scene, &s->scene.camera, &o, &any->render);
    }
    b.width = b.height = SIDE;
    b.depth = DEPTH;
    b.walk = method == METROPOLIS ? METRO_WALK_METROPOLIS : method == EVEN ? METRO_WALK_EVEN : METRO_WALK_RANDOM;
    b.first_shot = method != RANDOM;
    b.batches = 4;
    b.part = part;
    b.threads = 1;
    return metro_bundles_make(&s->scene, &s->scene.camera, &b, &any->bundles);
}

/* Goes on until `rounds` rounds, or 4 walks each, are made. */
static metro_result any_run(any_render *any, uint64_t rounds)
{
    if (any->method < RANDOM) return metro_render_run(&any->render, rounds - any->render.rounds, NULL, NULL);
    return metro_bundles_run(&any->bundles, 4 * rounds - any->bundles.walks, NULL, NULL);
}

static metro_result any_image(const any_render *any, metro_image *image)
{
    return any->method < RANDOM ? metro_render_image(&any->render, image) : metro_bundles_image(&any->bundles, image);
}

static metro_result study_work(uint64_t job, void *slot, void *user)
{
    const study *plan = (const study *)user;
    outcome *out = (outcome *)slot;
    any_render any;
    double begin = light_cpu_seconds(), looking = 0;
    metro_result result = any_make(plan->s, plan->method, job, &any);
    for (out->looks = 0; out->looks < LOOKS && result == METRO_OK; out->looks++) {
        metro_image image;
        double before, after;
        result = any_run(&any, (uint64_t)1 << out->looks);
        before = light_cpu_seconds();
        if (result == METRO_OK) result = any_image(&any, &image);
        after = light_cpu_seconds();
        if (result != METRO_OK) break;
        out->seconds[out->looks] = after - begin - looking; /* one gathering counts, those before do not */
        out->squared[out->looks] = squared_error(plan->s, &image);
        metro_image_free(&image);
        looking += light_cpu_seconds() - before;
        if (out->looks >= 2 && 2 * out->seconds[out->looks] > plan->budget) {
            out->looks++;
            break;
        }
    }
    metro_render_free(&any.render);
    metro_bundles_free(&any.bundles);
    return result;
}

static metro_result study_merge(uint64_t job, const void *slot, void *user)
{
    study *plan = (study *)user;
    const outcome *out = (const outcome *)slot;
    size_t k;
    (void)job;
    for (k = 0; k < out->looks; k++) {
        metro_moments_add(&plan->seconds[k], out->seconds[k]);
        metro_moments_add(&plan->squared[k], out->squared[k]);
    }
    return METRO_OK;
}

/* The curve of one method: looks that all repeats came to. */
static int run_method(const setting *s, int method, double budget, curve *c)
{
    static study plan;
    metro_rounds rounds;
    metro_result result;
    memset(&plan, 0, sizeof plan);
    memset(&rounds, 0, sizeof rounds);
    plan.s = s;
    plan.method = method;
    plan.budget = budget;
    rounds.jobs = plot_quick() ? 2 : REPEATS;
    rounds.slot_size = sizeof(outcome);
    rounds.work = study_work;
    rounds.merge = study_merge;
    result = metro_rounds_run(&rounds, &plan);
    if (result != METRO_OK) return light_complain("whole", name_of[method], result);
    for (c->looks = 0; c->looks < LOOKS; c->looks++) {
        size_t k = c->looks;
        double square = metro_moments_mean(&plan.squared[k]);
        if (plan.squared[k].count < rounds.jobs || !(square > 0)) break;
        c->seconds[k] = metro_moments_mean(&plan.seconds[k]);
        c->error[k] = sqrt(square);
        c->spread[k] = metro_moments_error(&plan.squared[k]) / (2 * c->error[k]);
    }
    return 0;
}

static int find_truth(setting *s)
{
    metro_render_options o;
    metro_image image;
    metro_result result;
    double noise;
    size_t i;
    memset(&o, 0, sizeof o);
    o.width = o.height = SIDE;
    o.depth = DEPTH;
    o.shortest = 2;
    result = light_reference(&s->scene, &o, plot_quick() ? 30 : 300, &image, &noise);
    if (result != METRO_OK) return light_complain("whole", "a reference", result);
    light_mask(&s->scene, SIDE, SIDE, s->mask);
    for (i = 0; i < 3 * (size_t)PIXELS; i++) {
        s->truth[i] = image.value[i];
        if (s->mask[i / 3]) s->power += s->truth[i] * s->truth[i];
    }
    s->noise = noise * noise;
    metro_image_free(&image);
    return 0;
}

/* The squared error that patches leave, whatever the noise: the mean product, over the pixels, of the errors of two
   independent runs. Its root; NaN where noise makes the product negative. */
static int find_floor(const setting *s, double *level)
{
    metro_bundles_options o;
    metro_image image[2];
    double sum = 0;
    size_t i;
    memset(&o, 0, sizeof o);
    o.width = o.height = SIDE;
    o.depth = DEPTH;
    o.walk = METRO_WALK_EVEN;
    o.first_shot = 1;
    o.seed = 3;
    for (o.part = 0; o.part < 2; o.part++) {
        metro_bundles bundles;
        metro_result result = metro_bundles_make(&s->scene, &s->scene.camera, &o, &bundles);
        if (result == METRO_OK) result = metro_bundles_run(&bundles, plot_quick() ? 128 : 1024, NULL, NULL);
        if (result == METRO_OK) result = metro_bundles_image(&bundles, &image[o.part]);
        if (result != METRO_OK) return light_complain("whole", "the patches", result);
        metro_bundles_free(&bundles);
    }
    for (i = 0; i < 3 * (size_t)PIXELS; i++)
        if (s->mask[i / 3]) sum += (image[0].value[i] - s->truth[i]) * (image[1].value[i] - s->truth[i]);
    *level = sqrt(sum / s->power - s->noise);
    metro_image_free(&image[0]);
    metro_image_free(&image[1]);
    return 0;
}

static void draw(plot_panel *panel, const curve *curves, double level)
{
    int m;
    panel->x_log = panel->y_log = 1;
    panel->x_label = "CPU seconds, one thread";
    panel->y_label = "relative RMSE of the picture";
    for (m = 0; m < METHODS; m++) {
        const curve *c = &curves[m];
        double low[LOOKS], high[LOOKS];
        plot_series *line;
        size_t k;
        for (k = 0; k < c->looks; k++) {
            low[k] = fmax(c->error[k] - c->spread[k], 0.5 * c->error[k]);
            high[k] = c->error[k] + c->spread[k];
        }
        plot_band(panel, c->seconds, low, high, c->looks, NULL)->color = plot_palette((size_t)m);
        line = plot_line(panel, c->seconds, c->error, c->looks, name_of[m]);
        line->color = plot_palette((size_t)m);
        line->dash = m >= RANDOM;
    }
    if (level > 0) plot_rule_y(panel, level, "patches");
}

static void write_rows(plot_csv *csv, int scene, const curve *curves, double level)
{
    size_t k;
    int m;
    for (m = 0; m < METHODS; m++)
        for (k = 0; k < curves[m].looks; k++) {
            plot_csv_text(csv, scene_name[scene]);
            plot_csv_text(csv, name_of[m]);
            PLOT_CSV_ROW(csv, curves[m].seconds[k], curves[m].error[k], curves[m].spread[k],
                         m >= RANDOM ? level : (double)NAN);
        }
}

/* The method that is lowest at the end of its budget. */
static int best_of(const curve *curves, int from, int to)
{
    int m, best = from;
    for (m = from; m < to; m++)
        if (curves[m].error[curves[m].looks - 1] < curves[best].error[curves[best].looks - 1]) best = m;
    return best;
}

int main(void)
{
    static setting s[SCENES];
    static curve curves[SCENES][METHODS];
    plot_chart chart = plot_chart_make("What a second buys",
                                       "Down and left is better. Solid: light paths; dashed: ray bundles, whose "
                                       "patches leave an error that no time removes. Bands: one standard error.");
    plot_csv csv = plot_csv_open("out/whole.csv", "scene,method,seconds,error,error_se,floor");
    double budget = plot_quick() ? 0.06 : 1.2, level[SCENES];
    int scene, m;
    chart.columns = 2;
    chart.width = 1400;
    for (scene = 0; scene < SCENES; scene++) {
        if (light_load("whole", scene_path[scene], &s[scene].scene) != 0 || find_truth(&s[scene]) != 0) return 1;
        if (find_floor(&s[scene], &level[scene]) != 0) return 1;
        for (m = 0; m < METHODS; m++) {
            if (run_method(&s[scene], m, budget, &curves[scene][m]) != 0) return 1;
            plot_progress((scene + (m + 1.0) / METHODS) / SCENES, "whole");
        }
        chart.panel[scene].title = scene_name[scene];
        draw(&chart.panel[scene], curves[scene], level[scene]);
        write_rows(&csv, scene, curves[scene], level[scene]);
        metro_scene_free(&s[scene].scene);
    }
    if (plot_csv_close(&csv) != 0 || plot_save(&chart, "out/whole.svg") != 0) return 1;
    for (scene = 0; scene < SCENES; scene++) {
        int path = best_of(curves[scene], PATH, RANDOM), bundle = best_of(curves[scene], RANDOM, METHODS);
        const curve *p = &curves[scene][path], *b = &curves[scene][bundle];
        printf("%s: best of paths %s, %.3f after %.2f s; best of bundles %s, %.3f after %.2f s (%s)\n",
               scene_name[scene], name_of[path], p->error[p->looks - 1], p->seconds[p->looks - 1], name_of[bundle],
               b->error[b->looks - 1], b->seconds[b->looks - 1],
               curves[scene][METROPOLIS].error[curves[scene][METROPOLIS].looks - 1] <
                       curves[scene][SHOT].error[curves[scene][SHOT].looks - 1]
                   ? "Metropolis below independent walks"
                   : "Metropolis above independent walks");
    }
    return 0;
}
