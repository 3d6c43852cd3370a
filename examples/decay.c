/* decay.c: how fast is the start forgotten? Section 2 of the paper answers for a constant importance on a circle;
   on the sphere of directions the answer is the spectrum of the cone (section 5.18): what is left of degree l
   after n mutations is lambda_l^n, and lambda_1 = cos^2(apex / 4) is the slowest.

   - One direction in a furnace, a closed box whose walls all emit the same: what arrives in its middle is the same
     from everywhere, so the importance is constant and the theory exact.
   - One direction in the Cornell box: the importance is the direct light that comes back from there. Now mutations
     are rejected, and where the box is open or in shadow it is dark.
   - Whole paths in the Cornell box: Metropolis light transport as the paper does it, 64 chains from 64 fixed
     points, and the squared bias of 8 x 8 pixels over repeats, in windows of equal length.

   See: in the first panel the furnace lies on the theory's lines, and the Cornell box near them, a little slower. In
   the second, the squared biases of all angles lie on one curve when mutations are counted in the times of decay that
   theory predicts for a direction. In the third, all measured rates grow with about the square of the angle, as the
   theory's do; a whole path forgets faster than one direction, since its place on the film, which moves by the same
   angle, has less far to go. In the fourth, what a perturbation wins in length it loses in acceptance: "large ones
   forget which regions are important" (section 2.3). The best angle stands between, and it is large.

   Writes out/decay.svg and out/decay.csv. There, apex is the apex angle, n the number of mutations, value what the
   column `what` says with its standard error, theory the prediction where there is one. */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum {
    JOBS = 64,
    ANGLES = 4,
    LOOKS = 9,
    SIDE = 8,
    PIXELS = SIDE * SIDE,
    CHAINS = 64,
    DRAWS = 4096,
    WINDOWS = 12,
    SIZES = 8
};
enum { FURNACE, CORNELL, ROOMS };

static const double pi = 3.14159265358979323846;
static const double angle[ANGLES] = { 0.05, 0.15, 0.45, 1.5 };   /* of one direction */
static const double path_angle[ANGLES] = { 0.1, 0.2, 0.4, 0.8 }; /* of whole paths */
static const double size[SIZES] = { 0.1, 0.2, 0.35, 0.6, 1, 1.7, 3, 5 };

static double lambda_1(double apex) { return metro_cone_coefficient(apex / 2, 1); }

/* The slowest mode of the position on a film that is `across` radians wide; the film is an interval. */
static double film_1(double apex, double across)
{
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    kernel.size = apex / across;
    return metro_kernel_reflect_coefficient(&kernel, 1);
}

/* ---- One direction ---- */

typedef struct {
    const char *name, *path;
    metro_vec3 at, start, lamp, lamp_normal; /* where we stand, the seed, and the middle of the lamp */
    double mean, spread; /* of the cosine to the seed under the importance; of the importance, relative */
    metro_scene scene;
} room;

/* A point of the lamp and its normal: the middle of all triangles that emit. */
static void find_lamp(room *r)
{
    size_t i, count = 0;
    int k;
    r->lamp = metro_vec3_make(0, 0, 0);
    for (i = 0; i < r->scene.light_count; i++, count++)
        for (k = 0; k < 3; k++) r->lamp = metro_add(r->lamp, metro_scene_corner(&r->scene, r->scene.light[i], k));
    r->lamp = metro_scale(r->lamp, 1.0 / (3.0 * (double)count));
    r->lamp_normal = metro_scene_normal(&r->scene, r->scene.light[0]);
}

/* The light that comes back from `point`, lit by the middle of the lamp. */
static double reflected(const room *r, const metro_material *material, metro_vec3 point, metro_vec3 normal)
{
    metro_vec3 to_lamp = metro_subtract(r->lamp, point);
    double distance2 = metro_dot(to_lamp, to_lamp), here = metro_dot(to_lamp, normal);
    double there = -metro_dot(to_lamp, r->lamp_normal);
    if (!(here > 0) || !(there > 0)) return 0;
    if (metro_scene_occluded(&r->scene, point, to_lamp, 1e-4, 1 - 1e-4)) return 0;
    return metro_luminance(material->kd.x, material->kd.y, material->kd.z) * here * there / (distance2 * distance2);
}

/* The importance of a direction: what arrives from there. In the furnace that is the emission, in the Cornell box the
   light of the lamp that comes back once; the lamp itself is not seen. */
static double arriving(const double *z, void *sample, void *user)
{
    const room *r = (const room *)user;
    metro_vec3 direction = metro_vec3_make(z[0], z[1], z[2]), normal;
    const metro_material *material;
    metro_hit hit;
    (void)sample;
    if (!metro_scene_hit(&r->scene, r->at, direction, 0, (double)INFINITY, &hit)) return 0;
    normal = metro_scene_normal(&r->scene, hit.triangle);
    material = metro_scene_material(&r->scene, r->scene.material_of[hit.triangle]);
    if (!(metro_dot(normal, direction) < 0)) return 0;
    if (r->name[0] == 'f') return metro_luminance(material->ke.x, material->ke.y, material->ke.z);
    return reflected(r, material, metro_add(r->at, metro_scale(direction, hit.t)), normal);
}

static double cosine_to_start(const room *r, const double *z)
{
    return z[0] * r->start.x + z[1] * r->start.y + z[2] * r->start.z;
}

/* What the chain tends to, from even directions. */
static void find_mean(room *r)
{
    long i, count = 100000;
    double sum = 0, square = 0, cosine = 0;
    for (i = 0; i < count; i++) {
        double z[3], turn = (double)i * 2.39996322972865332, importance; /* the golden angle */
        z[2] = 1 - 2 * ((double)i + 0.5) / (double)count;
        z[0] = sqrt(1 - z[2] * z[2]) * cos(turn);
        z[1] = sqrt(1 - z[2] * z[2]) * sin(turn);
        importance = arriving(z, NULL, r);
        sum += importance;
        square += importance * importance;
        cosine += importance * cosine_to_start(r, z);
    }
    r->mean = cosine / sum;
    r->spread = sqrt(fmax((double)count * square / (sum * sum) - 1, 0));
}

static int open_room(room *r)
{
    if (light_load("decay", r->path, &r->scene) != 0) return 1;
    find_lamp(r);
    find_mean(r);
    return 0;
}

/* A job follows its share of the chains. */
typedef struct {
    const room *r;
    metro_axis axis;
    uint64_t chains, look[LOOKS]; /* chains of a job; how many mutations until each look */
    uint64_t stride;              /* mutations from one draw to the next */
    size_t looks, jobs;
    metro_moments cosine[LOOKS];          /* over the jobs */
    metro_moments acceptance, jump, time; /* ditto */
} walk;

typedef struct {
    double cosine[LOOKS], acceptance, jump, time;
} walk_slot;

static metro_result make_chain(const walk *w, uint64_t stream, metro_chain *chain)
{
    metro_target target;
    memset(&target, 0, sizeof target);
    target.axes = &w->axis;
    target.axis_count = 1;
    target.importance = arriving;
    target.user = (void *)(uintptr_t)w->r;
    return metro_chain_make(&target, NULL, metro_rng_make((uint64_t)(1e6 * w->axis.kernel.size), stream), chain);
}

static metro_result follow(uint64_t job, void *slot, void *user)
{
    const walk *w = (const walk *)user;
    walk_slot *out = (walk_slot *)slot;
    metro_result result = METRO_OK;
    uint64_t c;
    size_t k;
    for (c = 0; c < w->chains && result == METRO_OK; c++) {
        metro_chain chain;
        result = make_chain(w, job * w->chains + c, &chain);
        if (result != METRO_OK) return result;
        result = metro_chain_start_point(&chain, &w->r->start.x);
        for (k = 0; k < w->looks && result == METRO_OK; k++) {
            metro_chain_run(&chain, w->look[k] - chain.counts.steps);
            out->cosine[k] += cosine_to_start(w->r, chain.state) / (double)w->chains;
        }
        metro_chain_free(&chain);
    }
    return result;
}

static metro_result collect(uint64_t job, const void *slot, void *user)
{
    walk *w = (walk *)user;
    size_t k;
    (void)job;
    for (k = 0; k < w->looks; k++) metro_moments_add(&w->cosine[k], ((const walk_slot *)slot)->cosine[k]);
    metro_moments_add(&w->acceptance, ((const walk_slot *)slot)->acceptance);
    metro_moments_add(&w->jump, ((const walk_slot *)slot)->jump);
    metro_moments_add(&w->time, ((const walk_slot *)slot)->time);
    return METRO_OK;
}

static walk walk_make(const room *r, double apex)
{
    walk w;
    memset(&w, 0, sizeof w);
    w.r = r;
    w.axis.kind = METRO_DIRECTION;
    w.axis.kernel.shape = METRO_UNIFORM;
    w.axis.kernel.size = fmin(apex / 2, pi);
    w.jobs = JOBS;
    return w;
}

static int walk_run(walk *w, metro_result (*work)(uint64_t, void *, void *))
{
    metro_rounds plan;
    metro_result result;
    memset(&plan, 0, sizeof plan);
    plan.jobs = w->jobs;
    plan.slot_size = sizeof(walk_slot);
    plan.work = work;
    plan.merge = collect;
    result = metro_rounds_run(&plan, w);
    return result == METRO_OK ? 0 : light_complain("decay", w->r->name, result);
}

static void write_down(plot_csv *csv, const char *what, double apex, double n, double value, double error,
                       double theory)
{
    plot_csv_text(csv, what);
    PLOT_CSV_ROW(csv, apex, n, value, error, theory);
}

/* A measured rate of forgetting, per mutation, with its error. */
typedef struct {
    double apex, value, error;
} rate;

/* lambda_1^n as a smooth line. */
static void draw_theory(plot_panel *panel, size_t a, double last)
{
    enum { MANY = 60 };
    double n[MANY], left[MANY];
    int k;
    for (k = 0; k < MANY; k++) {
        n[k] = pow(last, (double)k / (MANY - 1));
        left[k] = pow(lambda_1(angle[a]), n[k]);
    }
    plot_line(panel, n, left, MANY, plot_say(panel, "% rad", angle[a]))->color = plot_palette(a);
}

/* The mean cosine to the seed, less its limit and relative to its beginning, at looks spaced in octaves up to three
   predicted times of decay; the rate is that at the look where theory says 1/e. */
static int decay_of_direction(const room *r, size_t a, double *worst, rate *found, plot_panel *panel, plot_csv *csv)
{
    double tau = -1 / log(lambda_1(angle[a])), x[LOOKS], y[LOOKS], error[LOOKS], theory[LOOKS];
    uint64_t most = plot_quick() ? 1 << 18 : 1 << 22;
    walk w = walk_make(r, angle[a]);
    plot_series *points;
    size_t k;
    for (k = 0; k < LOOKS; k++) {
        uint64_t n = (uint64_t)(2 * tau / (double)(1 << (LOOKS - 1 - k)) + 0.5);
        if (n >= 1 && (w.looks == 0 || n > w.look[w.looks - 1])) w.look[w.looks++] = n;
    }
    w.chains = most / JOBS / w.look[w.looks - 1];
    if (w.chains < 4) w.chains = 4;
    if (w.chains > 200) w.chains = 200;
    if (walk_run(&w, follow) != 0) return 1;
    for (k = 0; k < w.looks; k++) {
        x[k] = (double)w.look[k];
        y[k] = (metro_moments_mean(&w.cosine[k]) - r->mean) / (1 - r->mean);
        error[k] = metro_moments_error(&w.cosine[k]) / (1 - r->mean);
        theory[k] = pow(lambda_1(angle[a]), x[k]);
        if (r->name[0] == 'f') *worst = fmax(*worst, fabs(y[k] - theory[k]) / error[k]);
        write_down(csv, r->name, angle[a], x[k], y[k], error[k], r->name[0] == 'f' ? theory[k] : (double)NAN);
    }
    k = w.looks - 2;
    found->apex = angle[a];
    found->value = -log(fmax(y[k], 0.01)) / x[k];
    found->error = error[k] / fmax(y[k], 0.01) / x[k];
    if (r->name[0] == 'f') draw_theory(panel, a, x[w.looks - 1]);
    points = plot_points(panel, x, y, error, w.looks, r->name[0] == 'f' ? "furnace" : "Cornell box");
    points->color = plot_palette(a);
    points->marker = r->name[0] == 'f' ? 0 : 2;
    points->label = NULL;
    return 0;
}

/* A long run from equilibrium: acceptance, squared jump, and the autocorrelation time of the cosine. */
static metro_result roam(uint64_t job, void *slot, void *user)
{
    const walk *w = (const walk *)user;
    walk_slot *out = (walk_slot *)slot;
    double *draw = (double *)malloc(DRAWS * sizeof *draw);
    metro_chain chain;
    metro_result result = draw != NULL ? make_chain(w, job, &chain) : METRO_ERROR_MEMORY;
    int i;
    if (result == METRO_OK) {
        result = metro_chain_start_weighted(&chain, 64);
        for (i = 0; i < DRAWS && result == METRO_OK; i++) {
            metro_chain_run(&chain, w->stride);
            draw[i] = cosine_to_start(w->r, chain.state);
        }
        out->acceptance = (double)chain.counts.accepted / (double)chain.counts.steps;
        out->jump = metro_sum_value(&chain.counts.squared_jump) / (double)chain.counts.steps;
        out->time = metro_autocorrelation_time(draw, 1, DRAWS) * (double)w->stride;
        metro_chain_free(&chain);
    }
    free(draw);
    return result;
}

/* ---- Whole paths ---- */

typedef struct {
    unsigned char mask[PIXELS];
    double truth[PIXELS], mean, power, noise;
    size_t used;
} picture;

static metro_render_options path_options(double apex)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    options.depth = 5;
    options.shortest = 2;
    options.seed = 2;
    options.method = METRO_MLT;
    options.perturbation = apex;
    options.chains = CHAINS;
    options.candidates = 64;
    return options;
}

/* Repeats of luminances at all looks, each scaled to `mean` (if not 0), masked pixels left out; NULL after a message.
   */
static double *pictures_of(const metro_scene *scene, const metro_render_options *options, const uint64_t *look,
                           size_t looks, size_t repeats, const picture *p, metro_render_report *report)
{
    light_study study;
    metro_result result;
    size_t i, k, out = 0;
    memset(&study, 0, sizeof study);
    study.scene = scene;
    study.options = *options;
    study.rounds = look;
    study.looks = looks;
    study.repeats = repeats;
    result = light_study_run(&study);
    if (result != METRO_OK) {
        light_complain("decay", "a picture", result);
        return NULL;
    }
    light_luminance(study.picture, looks * repeats * PIXELS, study.picture);
    for (k = 0; p->mean > 0 && k < looks * repeats; k++) {
        double sum = 0, *one = study.picture + k * PIXELS;
        for (i = 0; i < PIXELS; i++) sum += one[i] / PIXELS;
        for (i = 0; i < PIXELS; i++)
            if (p->mask[i] != 0) study.picture[out++] = one[i] * p->mean / sum;
    }
    if (report != NULL) *report = study.report[0];
    free(study.report);
    free(study.seconds);
    return study.picture;
}

/* The reference, and the variance left in it, from sixteen shares. */
static int find_truth(const metro_scene *scene, picture *p)
{
    enum { SHARES = 16 };
    metro_render_options options = path_options(1);
    uint64_t rounds = plot_quick() ? 150 : 1500;
    double *share, sum = 0;
    size_t i, r, out = 0;
    memset(p, 0, sizeof *p);
    options.method = METRO_BDPT;
    light_mask(scene, SIDE, SIDE, p->mask);
    share = pictures_of(scene, &options, &rounds, 1, SHARES, p, NULL);
    if (share == NULL) return 1;
    for (i = 0; i < PIXELS; i++) {
        double mean = 0, spread = 0;
        for (r = 0; r < SHARES; r++) mean += share[r * PIXELS + i] / SHARES;
        for (r = 0; r < SHARES; r++) spread += pow(share[r * PIXELS + i] - mean, 2) / (SHARES * (SHARES - 1));
        sum += mean / PIXELS;
        if (p->mask[i] == 0) continue;
        p->truth[out++] = mean;
        p->power += mean * mean;
        p->noise += spread;
    }
    p->used = out;
    p->mean = sum;
    p->power /= (double)out;
    p->noise /= (double)out;
    free(share);
    return 0;
}

/* The rate at which bias^2 falls per mutation, halved: weighted least squares on its logarithm over the windows in
   which it is three standard errors or more. The first window, where fast modes fade, is left out. */
static rate fit(double apex, const double *n, const double *bias2, const double *error, size_t windows)
{
    double w = 0, wx = 0, wy = 0, wxx = 0, wxy = 0;
    rate found;
    size_t k, used = 0;
    found.apex = apex;
    found.value = found.error = (double)NAN;
    for (k = 1; k < windows && bias2[k] > 3 * error[k]; k++, used++) {
        double weight = pow(bias2[k] / error[k], 2), y = log(bias2[k]);
        w += weight;
        wx += weight * n[k];
        wy += weight * y;
        wxx += weight * n[k] * n[k];
        wxy += weight * n[k] * y;
    }
    if (used < 2) return found;
    found.value = -(w * wxy - wx * wy) / (w * wxx - wx * wx) / 2;
    found.error = sqrt(w / (w * wxx - wx * wx)) / 2;
    return found;
}

/* Squared bias of what chains see in one window after the other. */
static int decay_of_paths(const metro_scene *scene, const picture *p, size_t a, rate *found, plot_panel *panel,
                          plot_csv *csv)
{
    double apex = path_angle[a], tau = -1 / log(lambda_1(apex));
    double n[WINDOWS], bias2[WINDOWS], error[WINDOWS], shown[WINDOWS], scaled[WINDOWS];
    size_t repeats = plot_quick() ? 16 : 96, k, i;
    uint64_t width = (uint64_t)fmax(1, 0.4 * tau / WINDOWS + 0.5), look[WINDOWS];
    metro_render_options options = path_options(apex);
    double *one;
    options.start = METRO_START_POINT;
    for (k = 0; k < WINDOWS; k++) look[k] = (k + 1) * width;
    one = pictures_of(scene, &options, look, WINDOWS, repeats, p, NULL);
    if (one == NULL) return 1;
    for (k = WINDOWS; k-- > 0;) {
        double *now = one + k * repeats * p->used, all = (double)k + 1;
        metro_bias_variance e;
        metro_result result;
        for (i = 0; k > 0 && i < repeats * p->used; i++)
            now[i] = all * now[i] - (all - 1) * now[i - repeats * p->used];
        result = metro_repeats(now, p->truth, repeats, p->used, &e);
        if (result != METRO_OK) return light_complain("decay", "bias", result);
        n[k] = ((double)k + 0.5) * (double)width;
        bias2[k] = (e.bias2 - p->noise) / p->power;
        error[k] = e.bias2_error / p->power;
        scaled[k] = n[k] / tau;
        shown[k] = bias2[k] > 2 * error[k] ? bias2[k] : (double)NAN;
        write_down(csv, "Cornell box: squared bias of paths", apex, n[k], bias2[k], error[k], (double)NAN);
    }
    free(one);
    *found = fit(apex, n, bias2, error, WINDOWS);
    plot_line(panel, scaled, shown, WINDOWS, plot_say(panel, "% rad", apex))->color = plot_palette(a);
    plot_points(panel, scaled, shown, error, WINDOWS, NULL)->color = plot_palette(a);
    return 0;
}

/* Mutations that are worth an independent sample of the picture, from the variance over repeats: a sample adds b to
   one pixel, and is there with the probability that the pixel has of the whole. */
static int time_of_paths(const metro_scene *scene, const picture *p, double apex, double *time, double *acceptance)
{
    enum { FEW = 4 };
    metro_render_options options = path_options(apex);
    size_t repeats = plot_quick() ? 12 : 48, i;
    uint64_t rounds = plot_quick() ? 60 : 200;
    metro_render_report report;
    metro_bias_variance e;
    double *one, independent = 0, whole = p->mean * PIXELS;
    metro_result result;
    options.chains = FEW;
    one = pictures_of(scene, &options, &rounds, 1, repeats, p, &report);
    if (one == NULL) return 1;
    result = metro_repeats(one, p->truth, repeats, p->used, &e);
    free(one);
    if (result != METRO_OK) return light_complain("decay", "variance", result);
    for (i = 0; i < p->used; i++) {
        double share = p->truth[i] / whole;
        independent += share * (1 - share) * whole * whole / (double)p->used;
    }
    *time = e.variance * (double)rounds * PIXELS / independent;
    *acceptance = report.acceptance;
    return 0;
}

/* ---- The chart ---- */

static void draw_rates(plot_panel *panel, double across, const rate *furnace, const rate *cornell, const rate *paths)
{
    const rate *group[3];
    static const char *const name[3] = { "furnace, one direction", "Cornell box, one direction",
                                         "Cornell box, paths" };
    double x[SIZES], y[SIZES], error[SIZES];
    size_t g, k;
    group[0] = furnace;
    group[1] = cornell;
    group[2] = paths;
    for (k = 0; k < SIZES; k++) {
        x[k] = 0.03 * pow(100, (double)k / (SIZES - 1));
        y[k] = -log(lambda_1(x[k]));
    }
    plot_line(panel, x, y, SIZES, "theory: a direction")->color = 0x555555;
    for (k = 0; k < SIZES; k++) {
        x[k] = 0.05 * pow(12, (double)k / (SIZES - 1));
        y[k] = -log(film_1(x[k], across));
    }
    plot_line(panel, x, y, SIZES, "theory: the film")->color = 0x999999;
    for (g = 0; g < 3; g++) {
        plot_series *points;
        for (k = 0; k < ANGLES; k++) {
            x[k] = group[g][k].apex;
            y[k] = group[g][k].value;
            error[k] = group[g][k].error;
        }
        points = plot_points(panel, x, y, error, ANGLES, name[g]);
        points->color = plot_palette(g);
        points->marker = g == 0 ? 0 : g == 1 ? 2 : 1;
    }
}

static int forgetting(const room *r, const picture *p, plot_panel *panel, plot_csv *csv, double *best)
{
    double y[5][SIZES], least = (double)INFINITY;
    static const char *const name[5] = { "acceptance", "squared jump", "efficiency", "acceptance, paths",
                                         "efficiency, paths" };
    size_t k, i;
    for (k = 0; k < SIZES; k++) {
        walk w = walk_make(r, size[k]);
        double time = (double)NAN;
        w.jobs = plot_quick() ? 6 : 16;
        w.stride =
            (uint64_t)(-80 / log(lambda_1(size[k])) / DRAWS) + 1; /* runs of 40 times the time that theory says */
        if (walk_run(&w, roam) != 0) return 1;
        y[0][k] = metro_moments_mean(&w.acceptance);
        y[1][k] =
            metro_moments_mean(&w.jump) / (pi * pi / 2 - 2); /* the mean of theta^2 for independent directions */
        y[2][k] = 1 / metro_moments_mean(&w.time);
        if (time_of_paths(&r->scene, p, size[k], &time, &y[3][k]) != 0) return 1;
        y[4][k] = 1 / time;
        if (time < least) least = time, *best = size[k];
        write_down(csv, name[0], size[k], 1, y[0][k], metro_moments_error(&w.acceptance), (double)NAN);
        write_down(csv, name[1], size[k], 1, y[1][k], metro_moments_error(&w.jump), (double)NAN);
        write_down(csv, name[2], size[k], 1, y[2][k], metro_moments_error(&w.time) * y[2][k] * y[2][k], (double)NAN);
        write_down(csv, name[3], size[k], 1, y[3][k], (double)NAN, (double)NAN);
        write_down(csv, name[4], size[k], 1, y[4][k], (double)NAN, (double)NAN);
        plot_progress(0.7 + 0.3 * (double)(k + 1) / SIZES, "decay");
    }
    for (i = 0; i < 5; i++) {
        plot_series *line = plot_line(panel, size, y[i], SIZES, name[i]);
        line->color = plot_palette(i < 3 ? i : i == 3 ? 0 : 2);
        line->dash = i < 3 ? 0 : 1;
    }
    return 0;
}

static plot_chart sheet(void)
{
    plot_chart chart = plot_chart_make(
        NULL, "Rates are per mutation, with standard errors. Upper left: circles furnace, diamonds Cornell box, "
              "lines theory. "
              "Lower right: solid one direction in the Cornell box, dashed whole paths; independent samples from the "
              "importance would have 1 in all; efficiency is 1 over the autocorrelation time.");
    chart.rows = chart.columns = 2;
    chart.width = 1400;
    chart.panel[0].title = "one direction: what is left of the start";
    chart.panel[0].x_label = "mutations";
    chart.panel[0].y_label = "mean cosine to the seed, less its limit";
    chart.panel[0].x_log = 1;
    chart.panel[1].title = "whole paths, Cornell box: squared bias";
    chart.panel[1].x_label = "mutations of a chain, in predicted times of decay";
    chart.panel[1].y_label = "squared bias / power of the picture";
    chart.panel[1].y_log = 1;
    chart.panel[2].title = "rate of forgetting";
    chart.panel[2].x_label = "apex angle, rad";
    chart.panel[2].y_label = "rate per mutation";
    chart.panel[2].x_log = chart.panel[2].y_log = 1;
    chart.panel[3].title = "what large perturbations forget";
    chart.panel[3].x_label = "apex angle, rad";
    chart.panel[3].y_label = "share of what independent samples have";
    chart.panel[3].x_log = chart.panel[3].y_log = 1;
    return chart;
}

int main(void)
{
    static room rooms[ROOMS] = {
        { "furnace", "examples/scenes/box.obj", { 0, 0, 0 }, { 0, 0, 1 }, { 0, 0, 0 }, { 0, 0, 0 }, 0, 0, { 0 } },
        { "Cornell box",
          "examples/scenes/cornell.obj",
          { 278, 400, 200 },
          { 0, 0, 1 },
          { 0, 0, 0 },
          { 0, 0, 0 },
          0,
          0,
          { 0 } }
    };
    static picture truth;
    rate rates[ROOMS][ANGLES], path_rate[ANGLES];
    double worst = 0, best = 0, ratio[2] = { 0, 0 }, paths = 0, fitted = 0;
    char title[160];
    plot_chart chart = sheet();
    plot_csv csv = plot_csv_open("out/decay.csv", "what,apex,n,value,error,theory");
    size_t r, a;
    for (r = 0; r < ROOMS; r++) {
        if (open_room(&rooms[r]) != 0) return 1;
        for (a = 0; a < ANGLES; a++)
            if (decay_of_direction(&rooms[r], a, &worst, &rates[r][a], &chart.panel[0], &csv) != 0) return 1;
    }
    plot_progress(0.3, "decay");
    if (find_truth(&rooms[CORNELL].scene, &truth) != 0) return 1;
    for (a = 0; a < ANGLES; a++) {
        if (decay_of_paths(&rooms[CORNELL].scene, &truth, a, &path_rate[a], &chart.panel[1], &csv) != 0) return 1;
        write_down(&csv, "furnace: rate", angle[a], 1, rates[FURNACE][a].value, rates[FURNACE][a].error,
                   -log(lambda_1(angle[a])));
        write_down(&csv, "Cornell box: rate", angle[a], 1, rates[CORNELL][a].value, rates[CORNELL][a].error,
                   (double)NAN);
        write_down(&csv, "Cornell box: rate of paths", path_angle[a], 1, path_rate[a].value, path_rate[a].error,
                   (double)NAN);
        if (a == 0 || a == ANGLES - 1) ratio[a > 0] = rates[CORNELL][a].value / -log(lambda_1(angle[a]));
        if (isnan(path_rate[a].value)) continue; /* too little bias is left for a fit */
        paths += path_rate[a].value / -log(lambda_1(path_angle[a]));
        fitted++;
    }
    paths /= fitted;
    plot_progress(0.7, "decay");
    draw_rates(&chart.panel[2], rooms[CORNELL].scene.camera.fov * pi / 180, rates[FURNACE], rates[CORNELL],
               path_rate);
    if (forgetting(&rooms[CORNELL], &truth, &chart.panel[3], &csv, &best) != 0) return 1;
    snprintf(title, sizeof title, "The start is forgotten at a rate that grows with the power %.2f of the angle",
             log(rates[CORNELL][2].value / rates[CORNELL][0].value) / log(angle[2] / angle[0]));
    chart.title = title;
    if (plot_csv_close(&csv) != 0 || plot_save(&chart, "out/decay.svg") != 0) return 1;
    printf("the importance of a direction has a relative deviation of %.2g in the furnace, %.2g in the Cornell box\n",
           rooms[FURNACE].spread, rooms[CORNELL].spread);
    printf("apex    rate predicted  furnace              Cornell box          paths at apex         in the Cornell "
           "box\n");
    for (a = 0; a < ANGLES; a++)
        printf("%-7g %-15.3g %.3g +- %-9.1g  %.3g +- %-9.1g  %-21g %.3g +- %.1g\n", angle[a],
               -log(lambda_1(angle[a])), rates[FURNACE][a].value, rates[FURNACE][a].error, rates[CORNELL][a].value,
               rates[CORNELL][a].error, path_angle[a], path_rate[a].value, path_rate[a].error);
    printf(
        "the furnace is off the theory by %.1f standard errors at most; in the Cornell box one direction forgets at "
        "%.2g times the predicted rate at %g rad and %.2g times at %g, a path's picture at %.2g times; the best apex "
        "angle there is about %.2g rad\n",
        worst, ratio[0], angle[0], ratio[1], angle[ANGLES - 1], paths, best);
    for (r = 0; r < ROOMS; r++) metro_scene_free(&rooms[r].scene);
    return 0;
}
