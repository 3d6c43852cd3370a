/* costs.c: speed against accuracy, for every way of making a picture that chapters 12 and 13 have. It belongs to
   sections 3 and 4 of the paper: Metropolis sampling becomes efficient only for difficult lighting.

   Two scenes, the Cornell box, where light is even, and a room whose lamp is behind a door. Each method runs on
   one thread, several times with other random numbers, and is looked at after 1, 2, 4, ... rounds of one sample a
   pixel. The lamp is not seen directly, and its pixels and those around it do not count. References are long runs
   of bidirectional path tracing with even points; the noise that is left in them, which the program prints, is
   subtracted.

   Metropolis light transport with "apex by pilot" first tries seven angles: two short runs each, of four chains
   and a small picture, from the same budget. It goes on with the angle whose two pictures differ least, pixel by
   pixel and relative to their brightness: what two independent runs differ by is twice their variance, and the
   start is in it, since each run finds its own. In one dimension chapter 6 predicts bias and variance from an
   operator; here we have only what the chains see. How well it chooses is printed: the efficiency of what it chose
   over that of the best of the seven, mean and worst.

   See: down and left is better. In the Cornell box independent samples win, behind the door Metropolis methods
   may; the last line says whether they do. The second chart is about cost alone: it hardly grows with the number
   of triangles, and with depth only as far as paths go.

   Writes out/costs.svg, out/costs_scale.svg and out/costs.csv: for the chart `error`, x is the computing time in
   seconds, value relMSE (mean over the repeats) and low and high their extremes, rmse the relative RMSE, repeats their
   number; for the others x is what the chart is named after, value the time of a sample in microseconds. */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SIDE = 64, PIXELS = SIDE * SIDE, DEPTH = 6, LOOKS = 12, ANGLES = 7, OTHERS = 4, SCENES = 2, CUTS = 8 };
enum { PATH, LAMP, BDPT, PSSMLT, MLT, PILOT = MLT + ANGLES, CURVES };
enum { PILOT_SIDE = 32, PILOT_PIXELS = PILOT_SIDE * PILOT_SIDE, PILOT_ROUNDS = 4, PILOT_CHAINS = 4, HALVES = 2 };

static const double angle[ANGLES] = { 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.1 };
static const char *const curve_name[MLT] = { "path tracing", "light tracing", "bidirectional", "primary space" };
static const metro_method method_of[MLT] = { METRO_PATH, METRO_LIGHT, METRO_BDPT, METRO_PSSMLT };

typedef struct {
    const char *name, *title, *path;
    uint64_t reference_rounds;
    metro_scene scene;
    unsigned char mask[PIXELS];
    double truth[PIXELS], weight[PIXELS]; /* luminance; what a squared error counts in relMSE, 0 around the lamp */
    double power;                         /* the sum of squares of the truth */
    double noise, noise2;                 /* what the reference adds to relMSE and to the squared relative RMSE */
} setting;

/* What the repeats of one method came to. */
typedef struct {
    size_t looks;
    double seconds[LOOKS], value[LOOKS], low[LOOKS], high[LOOKS], rmse[LOOKS];
} curve;

/* Of the pilots: what each repeat chose, and what that took. */
typedef struct {
    double seconds[64], efficiency, worst, share[ANGLES];
    size_t chosen[64];
} pilots;

static const char *name_of(int which, char *room, size_t size)
{
    if (which < MLT) return curve_name[which];
    if (which == PILOT) return "MLT, apex by pilot";
    snprintf(room, size, "MLT %g", angle[which - MLT]);
    return room;
}

static size_t repeats_of_all(void) { return plot_quick() ? 3 : 6; }

static metro_render_options options_of(int which)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    options.depth = DEPTH;
    options.shortest = 2;
    options.seed = 7;
    options.method = which < MLT ? method_of[which] : METRO_MLT;
    options.perturbation = which >= MLT && which < PILOT ? angle[which - MLT] : 0;
    options.candidates = 256;
    return options;
}

/* ---- Errors ---- */

static int find_truth(setting *s)
{
    enum { SHARES = 16 };
    light_study study;
    metro_result result;
    double mean = 0, used = (double)light_mask(&s->scene, SIDE, SIDE, s->mask);
    size_t i, r;
    memset(&study, 0, sizeof study);
    study.scene = &s->scene;
    study.options = options_of(BDPT);
    study.options.seed = 8;
    study.rounds = &s->reference_rounds;
    study.looks = 1;
    study.repeats = SHARES;
    result = light_study_run(&study);
    if (result != METRO_OK) return light_complain("costs", "a reference", result);
    light_luminance(study.picture, SHARES * PIXELS, study.picture);
    for (i = 0; i < PIXELS; i++) {
        for (r = 0; r < SHARES; r++) s->truth[i] += study.picture[r * PIXELS + i] / SHARES;
        if (s->mask[i] == 0) continue;
        mean += s->truth[i] / used;
        s->power += s->truth[i] * s->truth[i];
    }
    for (i = 0; i < PIXELS; i++) {
        double spread = 0;
        if (s->mask[i] == 0) continue;
        for (r = 0; r < SHARES; r++) spread += pow(study.picture[r * PIXELS + i] - s->truth[i], 2);
        spread /= SHARES * (SHARES - 1);
        s->weight[i] = 1 / (s->truth[i] * s->truth[i] + 0.01 * mean * mean) / used;
        s->noise += spread * s->weight[i];
        s->noise2 += spread / s->power;
    }
    light_study_free(&study);
    return 0;
}

/* relMSE and the squared relative RMSE of a picture of colors, which becomes luminance. */
static double error_of(const setting *s, double *picture, double *square)
{
    double sum = 0;
    size_t i;
    light_luminance(picture, PIXELS, picture);
    for (i = 0, *square = 0; i < PIXELS; i++) {
        double e = pow(picture[i] - s->truth[i], 2);
        sum += e * s->weight[i];
        if (s->mask[i] != 0) *square += e / s->power;
    }
    *square -= s->noise2;
    return sum - s->noise;
}

/* Looks at 1, 2, 4, ... rounds, as many as fit into `budget` seconds. */
static size_t plan_looks(const setting *s, int which, double budget, uint64_t *rounds)
{
    static const uint64_t few[2] = { 1, 5 };
    light_study study;
    size_t looks = 0;
    double round, start;
    memset(&study, 0, sizeof study);
    study.scene = &s->scene;
    study.options = options_of(which);
    study.rounds = few;
    study.looks = 2;
    study.repeats = 1;
    if (light_study_run(&study) != METRO_OK) return 0;
    round = (study.seconds[1] - study.seconds[0]) / 4;
    start = study.seconds[0] - round;
    light_study_free(&study);
    while (looks < LOOKS && (looks < 3 || start + round * (double)(1 << looks) <= budget)) {
        rounds[looks] = (uint64_t)1 << looks;
        looks++;
    }
    return looks;
}

/* Runs all repeats of a method; each repeat's relMSE at each look goes to `each` (may be NULL). */
static int run_method(const setting *s, int which, double budget, curve *c, double *each, double *each_seconds)
{
    uint64_t rounds[LOOKS];
    light_study study;
    metro_result result;
    size_t k, r, repeats = repeats_of_all();
    memset(&study, 0, sizeof study);
    study.scene = &s->scene;
    study.options = options_of(which);
    study.rounds = rounds;
    study.looks = c->looks = plan_looks(s, which, budget, rounds);
    study.repeats = repeats;
    result = study.looks > 0 ? light_study_run(&study) : METRO_ERROR_MEMORY;
    if (result != METRO_OK) return light_complain("costs", s->path, result);
    for (k = 0; k < c->looks; k++) {
        double square, squares = 0;
        c->low[k] = (double)INFINITY;
        for (r = 0; r < repeats; r++) {
            double e = error_of(s, light_study_picture(&study, k, r), &square);
            c->seconds[k] += study.seconds[k * repeats + r] / (double)repeats;
            c->value[k] += e / (double)repeats;
            c->low[k] = fmin(c->low[k], e);
            c->high[k] = fmax(c->high[k], e);
            squares += square / (double)repeats;
            if (each != NULL) each[k * repeats + r] = e;
            if (each != NULL) each_seconds[k * repeats + r] = study.seconds[k * repeats + r];
        }
        c->rmse[k] = sqrt(fmax(squares, 0));
    }
    light_study_free(&study);
    return 0;
}

/* ---- The pilot ---- */

typedef struct {
    const setting *s;
    pilots *out;
} pilot_plan;

typedef struct {
    double seconds;
    size_t chosen;
} pilot_slot;

/* A short run: its luminance, and the mean over blocks of 4 x 4 pixels added to `coarse`. */
static metro_result pilot_try(const setting *s, size_t a, uint64_t part, double *brightness, double *coarse)
{
    metro_render_options options = options_of((int)(MLT + a));
    metro_image image;
    metro_result result;
    size_t i;
    options.width = options.height = PILOT_SIDE;
    options.chains = PILOT_CHAINS;
    options.threads = 1;
    options.part = 1000 + part;
    result = light_render(&s->scene, &options, PILOT_ROUNDS, &image, NULL);
    if (result != METRO_OK) return result;
    light_luminance(image.value, PILOT_PIXELS, brightness);
    metro_image_free(&image);
    for (i = 0; i < PILOT_PIXELS; i++)
        coarse[i / PILOT_SIDE / 4 * (PILOT_SIDE / 4) + i % PILOT_SIDE / 4] += brightness[i] / 16;
    return METRO_OK;
}

/* The angle whose two runs differ least, relative to the mean of all runs in the block of each pixel. */
static size_t pilot_choose(double (*brightness)[PILOT_PIXELS], const double *coarse)
{
    double least = (double)INFINITY, mean = 0, level[ANGLES];
    size_t a, i, chosen = 0;
    for (i = 0; i < PILOT_PIXELS / 16; i++) mean += coarse[i] / (PILOT_PIXELS / 16);
    for (a = 0; a < ANGLES; a++) {
        double apart = 0;
        for (i = 0; i < PILOT_PIXELS; i++) {
            double here = coarse[i / PILOT_SIDE / 4 * (PILOT_SIDE / 4) + i % PILOT_SIDE / 4];
            apart += pow(brightness[HALVES * a][i] - brightness[HALVES * a + 1][i], 2) /
                     (here * here + 0.01 * mean * mean);
        }
        level[a] = log(apart);
    }
    for (a = 0; a < ANGLES; a++) { /* neighbours have their say, since a single spike can spoil one */
        double one = (level[a > 0 ? a - 1 : 0] + 2 * level[a] + level[a + 1 < ANGLES ? a + 1 : a]) / 4;
        if (one < least) least = one, chosen = a;
    }
    return chosen;
}

static metro_result pilot_work(uint64_t job, void *slot, void *user)
{
    const pilot_plan *plan = (const pilot_plan *)user;
    pilot_slot *out = (pilot_slot *)slot;
    double begin = light_cpu_seconds(), coarse[PILOT_PIXELS / 16] = { 0 };
    double(*brightness)[PILOT_PIXELS] = (double(*)[PILOT_PIXELS])malloc(HALVES * ANGLES * sizeof *brightness);
    metro_result result = brightness != NULL ? METRO_OK : METRO_ERROR_MEMORY;
    size_t i;
    for (i = 0; i < HALVES * ANGLES && result == METRO_OK; i++)
        result = pilot_try(plan->s, i / HALVES, HALVES * job + i % HALVES, brightness[i], coarse);
    if (result == METRO_OK) out->chosen = pilot_choose(brightness, coarse);
    free(brightness);
    out->seconds = light_cpu_seconds() - begin;
    return result;
}

static metro_result pilot_merge(uint64_t job, const void *slot, void *user)
{
    const pilot_plan *plan = (const pilot_plan *)user;
    plan->out->seconds[job] = ((const pilot_slot *)slot)->seconds;
    plan->out->chosen[job] = ((const pilot_slot *)slot)->chosen;
    return METRO_OK;
}

static size_t pilots_of_all(void) { return plot_quick() ? 6 : 32; }

/* The pilots, and how good their choices are: the efficiency of each angle comes from the long runs, at the last look
   that all have. */
static int run_pilots(const setting *s, const curve *curves, pilots *out)
{
    metro_rounds plan;
    pilot_plan pilot;
    metro_result result;
    size_t i, a, last = LOOKS, count = pilots_of_all();
    double best = (double)INFINITY;
    memset(&plan, 0, sizeof plan);
    pilot.s = s;
    pilot.out = out;
    plan.jobs = count;
    plan.slot_size = sizeof(pilot_slot);
    plan.work = pilot_work;
    plan.merge = pilot_merge;
    result = metro_rounds_run(&plan, &pilot);
    if (result != METRO_OK) return light_complain("costs", "a pilot", result);
    for (a = 0; a < ANGLES; a++) last = curves[MLT + a].looks < last ? curves[MLT + a].looks : last;
    for (a = 0; a < ANGLES; a++) best = fmin(best, curves[MLT + a].value[last - 1]);
    out->worst = 1;
    for (i = 0; i < count; i++) {
        double efficiency = best / curves[MLT + out->chosen[i]].value[last - 1];
        out->efficiency += efficiency / (double)count;
        out->worst = fmin(out->worst, efficiency);
        out->share[out->chosen[i]] += 1 / (double)count;
    }
    return 0;
}

/* What a run with a pilot comes to: the repeats of the angle that its pilot chose, after the time of the pilot. */
static void curve_of_pilot(const pilots *p, const curve *curves, double (*each)[LOOKS * 64],
                           double (*each_seconds)[LOOKS * 64], curve *c)
{
    size_t k, r, repeats = repeats_of_all();
    c->looks = LOOKS;
    for (r = 0; r < repeats; r++)
        if (curves[MLT + p->chosen[r]].looks < c->looks) c->looks = curves[MLT + p->chosen[r]].looks;
    for (k = 0; k < c->looks; k++) {
        c->low[k] = (double)INFINITY;
        c->rmse[k] = (double)NAN;
        for (r = 0; r < repeats; r++) {
            double e = each[p->chosen[r]][k * repeats + r];
            c->seconds[k] += (p->seconds[r] + each_seconds[p->chosen[r]][k * repeats + r]) / (double)repeats;
            c->value[k] += e / (double)repeats;
            c->low[k] = fmin(c->low[k], e);
            c->high[k] = fmax(c->high[k], e);
        }
    }
}

/* ---- The first chart ---- */

static void write_curve(plot_csv *csv, const setting *s, const char *name, const curve *c)
{
    size_t k;
    for (k = 0; k < c->looks; k++) {
        plot_csv_text(csv, "error");
        plot_csv_text(csv, s->name);
        plot_csv_text(csv, name);
        PLOT_CSV_ROW(csv, c->seconds[k], c->value[k], c->low[k], c->high[k], c->rmse[k], (double)repeats_of_all());
    }
}

static void draw_curve(plot_panel *panel, const curve *c, const double *value, int band, const char *name,
                       uint32_t color, int dash)
{
    plot_series *line;
    if (band) plot_band(panel, c->seconds, c->low, c->high, c->looks, NULL)->color = color;
    line = plot_line(panel, c->seconds, value, c->looks, name);
    line->color = color;
    line->dash = dash;
}

static void draw_errors(plot_panel *panel, plot_panel *rmse, const curve *curves)
{
    int which;
    for (which = 0; which < CURVES; which++) {
        int a = which - MLT, shown = which < MLT || which == PILOT || a == 0 || a == 2 || a == 4 || a == 6;
        uint32_t color = which < MLT      ? plot_palette(which == PSSMLT ? 6 : (size_t)which)
                         : which == PILOT ? plot_palette(7)
                                          : plot_shade((size_t)a, ANGLES);
        char room[40];
        const char *name = name_of(which, room, sizeof room);
        if (!shown) continue;
        draw_curve(panel, &curves[which], curves[which].value, a < 0 || a == 2 || which == PILOT, name, color,
                   which >= MLT && which != PILOT);
        if (which != PILOT) draw_curve(rmse, &curves[which], curves[which].rmse, 0, name, color, which >= MLT);
    }
}

static int study(setting *s, curve *curves, pilots *p, plot_csv *csv, double from, double to)
{
    static double each[ANGLES][LOOKS * 64], each_seconds[ANGLES][LOOKS * 64];
    double budget = plot_quick() ? 0.06 : 0.6;
    int which;
    if (light_load("costs", s->path, &s->scene) != 0 || find_truth(s) != 0) return 1;
    for (which = 0; which < PILOT; which++) {
        int a = which - MLT;
        double *errors = a >= 0 ? each[a] : NULL, *seconds = a >= 0 ? each_seconds[a] : NULL;
        char room[40];
        if (run_method(s, which, budget, &curves[which], errors, seconds) != 0) return 1;
        write_curve(csv, s, name_of(which, room, sizeof room), &curves[which]);
        plot_progress(from + (to - from) * (which + 1.0) / CURVES, "costs");
    }
    if (run_pilots(s, curves, p) != 0) return 1;
    curve_of_pilot(p, curves, each, each_seconds, &curves[PILOT]);
    write_curve(csv, s, "MLT by pilot", &curves[PILOT]);
    return 0;
}

/* ---- Cost alone ---- */

enum { WAYS = 3, DEPTHS = 5, SAMPLES = 5 };
static const int way_of[WAYS] = { PATH, BDPT, MLT + 3 };
static const char *const way_name[WAYS] = { "path tracing", "bidirectional", "MLT" };

/* The time of a sample in microseconds: of the rounds after the first, the best of three. NaN after a failure. */
static double time_of_sample(const metro_scene *scene, int which, int depth)
{
    metro_render_options options = options_of(which);
    uint64_t rounds = plot_quick() ? 1 : 3;
    metro_render render;
    double best = (double)INFINITY;
    int i;
    options.threads = 1;
    options.depth = depth;
    options.candidates = 16;
    if (metro_render_make(scene, &scene->camera, &options, &render) != METRO_OK) return (double)NAN;
    for (i = 0; i < 4; i++) {
        double start = light_cpu_seconds();
        if (metro_render_run(&render, rounds, NULL, NULL) != METRO_OK) best = (double)NAN;
        if (i > 0) best = fmin(best, light_cpu_seconds() - start);
    }
    metro_render_free(&render);
    return 1e6 * best / (double)rounds / PIXELS;
}

/* The same room in triangles of a quarter of the area, `cuts` times: each is cut at the middles of its edges. */
static metro_result add_cut(metro_scene *to, const metro_vec3 *corner, uint32_t material, int cuts)
{
    metro_vec3 half[3], part[3];
    metro_result result = METRO_OK;
    int i;
    if (cuts == 0) return metro_scene_add_triangle(to, corner, material);
    for (i = 0; i < 3; i++) half[i] = metro_scale(metro_add(corner[i], corner[(i + 1) % 3]), 0.5);
    for (i = 0; i < 3 && result == METRO_OK; i++) {
        part[0] = corner[i];
        part[1] = half[i];
        part[2] = half[(i + 2) % 3];
        result = add_cut(to, part, material, cuts - 1);
    }
    return result == METRO_OK ? add_cut(to, half, material, cuts - 1) : result;
}

static metro_result cut_scene(const metro_scene *from, int cuts, metro_scene *to)
{
    metro_result result = METRO_OK;
    uint32_t i, index;
    int k;
    memset(to, 0, sizeof *to);
    to->camera = from->camera;
    for (i = 1; i <= from->material_count && result == METRO_OK; i++)
        result = metro_scene_add_material(to, metro_scene_material(from, i), &index);
    for (i = 0; i < from->triangle_count && result == METRO_OK; i++) {
        metro_vec3 corner[3];
        for (k = 0; k < 3; k++) corner[k] = metro_scene_corner(from, i, k);
        result = add_cut(to, corner, from->material_of[i], cuts);
    }
    return result;
}

/* Millions of rays a second from the middle of the scene into random directions. */
static double rays_per_second(const metro_scene *scene)
{
    long i, count = plot_quick() ? 50000 : 300000;
    metro_rng rng = metro_rng_make(5, 0);
    metro_vec3 low, high, middle, direction;
    metro_hit hit;
    double seconds;
    if (metro_scene_bounds(scene, &low, &high) != METRO_OK) return (double)NAN;
    middle = metro_scale(metro_add(low, high), 0.5);
    middle.y += 0.3 * (high.y - low.y);
    seconds = light_cpu_seconds();
    for (i = 0; i < count; i++) {
        direction.x = metro_rng_uniform(&rng) - 0.5;
        direction.y = metro_rng_uniform(&rng) - 0.5;
        direction.z = metro_rng_uniform(&rng) - 0.5;
        metro_scene_hit(scene, middle, direction, 0, (double)INFINITY, &hit);
    }
    return 1e-6 * (double)count / (light_cpu_seconds() - seconds);
}

static void write_cost(plot_csv *csv, const char *chart, const char *name, double x, double value)
{
    plot_csv_text(csv, chart);
    plot_csv_text(csv, "Cornell box");
    plot_csv_text(csv, name);
    PLOT_CSV_ROW(csv, x, value, (double)NAN, (double)NAN, (double)NAN, (double)NAN);
}

static int chart_triangles(const metro_scene *scene, plot_panel *cost, plot_panel *build, plot_csv *csv,
                           double *growth)
{
    double count[CUTS], seconds[CUTS], rays[CUTS], sample[WAYS][CUTS];
    int cuts, w, most = plot_quick() ? 4 : CUTS;
    for (cuts = 0; cuts < most; cuts++) {
        metro_scene fine;
        metro_result result = cut_scene(scene, cuts, &fine);
        double start = light_cpu_seconds();
        if (result == METRO_OK) result = metro_scene_build(&fine);
        if (result != METRO_OK) return light_complain("costs", "a fine scene", result);
        seconds[cuts] = light_cpu_seconds() - start;
        count[cuts] = (double)fine.triangle_count;
        rays[cuts] = rays_per_second(&fine);
        for (w = 0; w < WAYS; w++) {
            sample[w][cuts] = time_of_sample(&fine, way_of[w], DEPTH);
            write_cost(csv, "triangles", way_name[w], count[cuts], sample[w][cuts]);
        }
        write_cost(csv, "rays: millions a second", "rays", count[cuts], rays[cuts]);
        write_cost(csv, "build: seconds", "build", count[cuts], seconds[cuts]);
        metro_scene_free(&fine);
    }
    for (w = 0; w < WAYS; w++) plot_line(cost, count, sample[w], (size_t)most, way_name[w]);
    plot_line(build, seconds, rays, (size_t)most, NULL);
    for (cuts = 0; cuts < most; cuts += most == CUTS ? 3 : 1)
        plot_note(build, seconds[cuts], rays[cuts], plot_say(build, "% triangles", count[cuts]));
    for (cuts = 0; cuts < most; cuts++) build->y_max = fmax(build->y_max, 1.1 * rays[cuts]);
    *growth = sample[1][most - 1] / sample[1][0];
    return 0;
}

static void chart_depth(const metro_scene *scene, plot_panel *panel, plot_csv *csv)
{
    double depth[DEPTHS], sample[DEPTHS];
    int w, d;
    for (w = 0; w < WAYS; w++) {
        for (d = 0; d < DEPTHS; d++) {
            depth[d] = 2 << d;
            sample[d] = time_of_sample(scene, way_of[w], 2 << d);
            write_cost(csv, "depth", way_name[w], depth[d], sample[d]);
        }
        plot_line(panel, depth, sample, DEPTHS, way_name[w]);
    }
}

/* Picture and wall time of a render on some threads, the better of two tries. */
static int timed(const metro_scene *scene, int which, size_t threads, uint64_t rounds, double *seconds,
                 metro_image *image)
{
    metro_render_options options = options_of(which);
    metro_result result;
    int tries;
    options.threads = threads;
    *seconds = (double)INFINITY;
    for (tries = 0; tries < 2; tries++) {
        double start = plot_seconds();
        if (tries > 0) metro_image_free(image);
        result = light_render(scene, &options, rounds, image, NULL);
        if (result != METRO_OK) break;
        *seconds = fmin(*seconds, plot_seconds() - start);
    }
    return result == METRO_OK ? 0 : light_complain("costs", "threads", result);
}

/* One and two threads: the same picture, and how much sooner. */
static int chart_threads(const metro_scene *scene, plot_panel *panel, plot_csv *csv, int *same, double *speedup)
{
    static const char *const name[2][2] = { { "bidirectional, 1 thread", "2 threads" },
                                            { "MLT, 1 thread", "2 threads" } };
    double samples[SAMPLES], seconds[2][SAMPLES];
    int w, k, t;
    *same = 1;
    *speedup = 0;
    for (w = 0; w < 2; w++) {
        for (k = 0; k < SAMPLES; k++) {
            metro_image image[2];
            samples[k] = (plot_quick() ? 1 : 4) << k;
            for (t = 0; t < 2; t++)
                if (timed(scene, way_of[w + 1], (size_t)t + 1, (uint64_t)samples[k], &seconds[t][k], &image[t]) != 0)
                    return 1;
            *same &= memcmp(image[0].value, image[1].value, 3 * PIXELS * sizeof(double)) == 0;
            for (t = 0; t < 2; t++) {
                write_cost(csv, "samples: seconds", name[w][t], samples[k], seconds[t][k]);
                metro_image_free(&image[t]);
            }
        }
        *speedup += seconds[0][SAMPLES - 1] / seconds[1][SAMPLES - 1] / 2;
        for (t = 0; t < 2; t++) {
            plot_series *line = plot_line(panel, samples, seconds[t], SAMPLES, name[w][t]);
            line->color = plot_palette((size_t)w + 1);
            line->dash = t;
        }
    }
    return 0;
}

/* ---- The program ---- */

static const char *const scene_name[SCENES] = { "cornell", "hidden" };
static const char *const scene_title[SCENES] = { "Cornell box", "Lamp behind a door" };
static const char *const scene_path[SCENES] = { "examples/scenes/cornell.obj", "examples/scenes/hidden.obj" };

static plot_chart error_sheet(void)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    int i;
    chart.rows = chart.columns = 2;
    chart.width = 1500;
    chart.height = 1250;
    for (i = 0; i < 4; i++) {
        chart.panel[i].title = scene_title[i % 2];
        chart.panel[i].x_log = chart.panel[i].y_log = 1;
        chart.panel[i].x_label = "computing time of one thread, seconds";
        chart.panel[i].y_label = i < 2 ? "relMSE" : "relative RMSE";
        chart.panel[i].better = "down and left is better";
    }
    return chart;
}

static plot_chart cost_sheet(void)
{
    plot_chart chart =
        plot_chart_make(NULL, "The Cornell box, 64 x 64 pixels, one thread but in the third panel; the room is "
                              "refined by cutting each triangle into four.");
    static const char *const title[4] = { "triangles", "depth", "samples and threads", "rays against build" };
    static const char *const x[4] = { "triangles", "most edges of a path", "samples per pixel",
                                      "time to build, seconds" };
    static const char *const y[4] = { "microseconds per sample", "microseconds per sample", "seconds on the wall",
                                      "million rays per second" };
    int i;
    chart.rows = chart.columns = 2;
    chart.width = 1400;
    for (i = 0; i < 4; i++) {
        chart.panel[i].title = title[i];
        chart.panel[i].x_label = x[i];
        chart.panel[i].y_label = y[i];
        chart.panel[i].x_log = 1;
        chart.panel[i].y_log = i == 2;
        if (i < 2) chart.panel[i].y_max = 0;
    }
    return chart;
}

/* 1 / (relMSE x seconds) at the last look. */
static double efficiency_of(const curve *c) { return 1 / (c->value[c->looks - 1] * c->seconds[c->looks - 1]); }

static void best_of(const curve *c, int *independent, int *metropolis)
{
    int i;
    *independent = PATH;
    *metropolis = PSSMLT;
    for (i = 0; i < PILOT; i++) {
        int *best = i < PSSMLT ? independent : metropolis;
        if (efficiency_of(&c[i]) > efficiency_of(&c[*best])) *best = i;
    }
}

static void report(const setting *s, const curve *c, const pilots *p)
{
    char room[40];
    int i;
    printf("%s: relMSE and efficiency 1 / (relMSE x seconds) of one thread at the last look; the reference's own "
           "relMSE is "
           "%.2g\n",
           s->title, s->noise);
    for (i = 0; i < CURVES; i++)
        printf("  %-20s %7.3f s  relMSE %-9.3g  efficiency %.3g\n", name_of(i, room, sizeof room),
               c[i].seconds[c[i].looks - 1], c[i].value[c[i].looks - 1], efficiency_of(&c[i]));
    printf("  pilots chose");
    for (i = 0; i < ANGLES; i++)
        if (p->share[i] > 0) printf(" %g (%.0f %%)", angle[i], 100 * p->share[i]);
    printf(": efficiency against the best angle %.2f, worst %.2f\n", p->efficiency, p->worst);
}

static void conclude(const setting *s, curve (*c)[CURVES], char *title, size_t size)
{
    size_t used = 0;
    int i, a, b;
    char room[2][40];
    for (i = 0; i < SCENES; i++) {
        double ratio;
        best_of(c[i], &a, &b);
        ratio = efficiency_of(&c[i][b]) / efficiency_of(&c[i][a]);
        used += (size_t)snprintf(title + used, size - used, "%s%s: %s is %.2g times as efficient as %s",
                                 i > 0 ? "; " : "", s[i].title, name_of(ratio > 1 ? b : a, room[0], 40),
                                 ratio > 1 ? ratio : 1 / ratio, name_of(ratio > 1 ? a : b, room[1], 40));
        if (used >= size) return;
    }
}

int main(void)
{
    static setting s[SCENES];
    static curve curves[SCENES][CURVES];
    static pilots p[SCENES];
    plot_csv csv = plot_csv_open("out/costs.csv", "chart,scene,curve,x,value,low,high,rmse,repeats");
    plot_chart chart = error_sheet(), costs = cost_sheet();
    char title[300], note[200], cost_title[200];
    double growth = 0, speedup = 0;
    int i, same = 0;
    for (i = 0; i < SCENES; i++) {
        s[i].name = scene_name[i];
        s[i].title = scene_title[i];
        s[i].path = scene_path[i];
        s[i].reference_rounds = plot_quick() ? 3 : 48;
        if (study(&s[i], curves[i], &p[i], &csv, 0.4 * i, 0.4 * (i + 1)) != 0) return 1;
        draw_errors(&chart.panel[i], &chart.panel[2 + i], curves[i]);
    }
    conclude(s, curves, title, sizeof title);
    snprintf(note, sizeof note,
             "%d x %d pixels, %d edges. MLT: the paper's Metropolis sampling with its apex angle, dashed. Lines "
             "are means over %d repeats; bands, not drawn for all, their extremes.",
             SIDE, SIDE, DEPTH, (int)repeats_of_all());
    chart.title = title;
    chart.note = note;
    if (chart_triangles(&s[0].scene, &costs.panel[0], &costs.panel[3], &csv, &growth) != 0) return 1;
    plot_progress(0.9, "costs");
    chart_depth(&s[0].scene, &costs.panel[1], &csv);
    if (chart_threads(&s[0].scene, &costs.panel[2], &csv, &same, &speedup) != 0) return 1;
    snprintf(cost_title, sizeof cost_title,
             "%d times as many triangles take %.2g times the time; two threads make %s picture, %.2g "
             "times as fast as one",
             plot_quick() ? 64 : 16384, growth, same ? "the same" : "ANOTHER", speedup);
    costs.title = cost_title;
    if ((plot_csv_close(&csv) | plot_save(&chart, "out/costs.svg") | plot_save(&costs, "out/costs_scale.svg")) != 0)
        return 1;
    for (i = 0; i < SCENES; i++) report(&s[i], curves[i], &p[i]);
    printf("%s\n%s\n", cost_title, title);
    for (i = 0; i < SCENES; i++) metro_scene_free(&s[i].scene);
    return same ? 0 : 1;
}
