/* failures_light.c: where light fails, seen. Six sheets for the lecture "Where methods fail":

   - out/failures_offset.svg: a ray that leaves a surface must not hit it again. One distance for all scenes loses the
     shadows of a small one and speckles a large one; a height that follows from what floats round off does neither.
   - out/failures_ways.svg: bidirectional path tracing. Each way to make a path of three edges fails on some surface
     of this room; weighted together they fail on none.
   - out/failures_seeds.svg: Metropolis light with small perturbations, and a lamp behind a door. Three seeds, three
     pictures with other bright spots; R-hat says so.
   - out/failures_dark.svg: chains that never find the light. Their 0 belongs to the mean.
   - out/failures_rejections.svg: rejected proposals thrown away, a mistake that no number of samples mends.
   - out/failures_mean.svg: the brightness of a picture comes from independent samples and is known no better than
     they are; the stated error says how well.

   All numbers are in out/failures_light.csv, one a row: sheet, case, x, quantity, value and standard error (nan:
   none). */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

#define NONE ((double)NAN) /* no x, or no error */
#define PROGRAM "failures_light"

enum { DEPTH = 5 };

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

static int complain(const char *what, metro_result result) { return light_complain(PROGRAM, what, result); }

static metro_vec3 at(double x, double y, double z) { return metro_vec3_make(x, y, z); }

static double mean_luminance(const metro_image *image)
{
    metro_sum sum = { 0, 0 };
    size_t i, count = image->width * image->height;
    for (i = 0; i < count; i++)
        metro_sum_add(&sum, metro_luminance(image->value[3 * i], image->value[3 * i + 1], image->value[3 * i + 2]));
    return metro_sum_value(&sum) / (double)count;
}

/* Adds the quadrangle a b c d, seen from where its corners run counterclockwise. Scenes are made once, and a failure
   shows in the build: a scene without triangles has no lamp. */
static void add_quad(metro_scene *scene, metro_vec3 a, metro_vec3 b, metro_vec3 c, metro_vec3 d, uint32_t material)
{
    metro_vec3 corner[3];
    corner[0] = a;
    corner[1] = b;
    corner[2] = c;
    metro_scene_add_triangle(scene, corner, material);
    corner[1] = c;
    corner[2] = d;
    metro_scene_add_triangle(scene, corner, material);
}

static uint32_t add_material(metro_scene *scene, double kd, double ks, double ns, double ke)
{
    metro_material material;
    uint32_t index = 0;
    material.kd = at(kd, kd, kd);
    material.ks = at(ks, ks, ks);
    material.ns = ns;
    material.ke = at(ke, ke, ke);
    metro_scene_add_material(scene, &material, &index);
    return index;
}

/* ---- Leaving a surface ---- */

enum { OFFSET_SIDE = 128, LAMP_GRID = 3, SIZES_SHOWN = 3, SIZES = 11 };

static const double absolute = 0.001; /* what the naive ray skips */

/* A block on the floor y = 0 above the corners (x[i], z[i]), which run counterclockwise as seen from below. */
static void add_block(metro_scene *scene, const double *x, const double *z, double height, double size,
                      uint32_t material)
{
    metro_vec3 low[4], high[4];
    int i;
    for (i = 0; i < 4; i++) {
        low[i] = at(size * x[i], 0, size * z[i]);
        high[i] = at(size * x[i], size * height, size * z[i]);
    }
    for (i = 0; i < 4; i++) add_quad(scene, low[(i + 1) % 4], low[i], high[i], high[(i + 1) % 4], material);
    add_quad(scene, high[3], high[2], high[1], high[0], material);
}

/* A floor of 2 x 2, a block on it and a screen beside the block, all times `size`. */
static metro_result still_life(double size, metro_scene *scene)
{
    static const double block[2][4] = { { 0, -0.4, -0.6, -0.2 }, { 0, 0.2, -0.2, -0.4 } };
    static const double screen[2][4] = { { 0.35, 0.37, 0.67, 0.65 }, { 0.5, 0.51, -0.09, -0.1 } };
    uint32_t white;
    memset(scene, 0, sizeof *scene);
    white = add_material(scene, 0.8, 0, 0, 0);
    add_quad(scene, at(-size, 0, size), at(size, 0, size), at(size, 0, -size), at(-size, 0, -size), white);
    add_block(scene, block[0], block[1], 0.5, size, white);
    add_block(scene, screen[0], screen[1], 0.35, size, white);
    scene->camera.eye = at(-0.3 * size, 1.5 * size, 1.6 * size);
    scene->camera.look = at(-0.1 * size, 0.1 * size, 0.05 * size);
    scene->camera.up = at(0, 1, 0);
    scene->camera.fov = 48;
    return metro_scene_build(scene);
}

/* Point i of a square lamp of side .2 above the scene on the right, which the rays do not hit. */
static metro_vec3 lamp_point(double size, int i)
{
    double u = (i % LAMP_GRID + 0.5) / LAMP_GRID - 0.5, v = ((double)(i / LAMP_GRID) + 0.5) / LAMP_GRID - 0.5;
    return at(size * (1.1 + 0.2 * u), size * 0.9, size * (0.2 + 0.2 * v));
}

/* Whether the segment from `from` to `to` meets a triangle other than `own`, in doubles: Moller and Trumbore 1997. */
static int stands_between(const metro_scene *scene, metro_vec3 from, metro_vec3 to, uint32_t own)
{
    metro_vec3 d = metro_subtract(to, from);
    uint32_t i;
    for (i = 0; i < scene->triangle_count; i++) {
        metro_vec3 p0 = metro_scene_corner(scene, i, 0), e1 = metro_subtract(metro_scene_corner(scene, i, 1), p0);
        metro_vec3 e2 = metro_subtract(metro_scene_corner(scene, i, 2), p0), p = metro_cross(d, e2);
        metro_vec3 o = metro_subtract(from, p0), q = metro_cross(o, e1);
        double det = metro_dot(e1, p), u = metro_dot(o, p) / det, v = metro_dot(d, q) / det;
        double t = metro_dot(e2, q) / det;
        if (i != own && u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < 1) return 1;
    }
    return 0;
}

/* The height of section 10.10 for triangles that are no needles: what floats round off, times 16. */
static metro_vec3 leave(const metro_scene *scene, metro_vec3 point, metro_vec3 normal, uint32_t triangle)
{
    const double e = 1.0 / 16777216;
    double extent = 0, height;
    int k;
    for (k = 0; k < 3; k++) {
        metro_vec3 d = metro_subtract(metro_scene_corner(scene, triangle, k), point);
        extent = fmax(extent, fmax(fabs(d.x), fmax(fabs(d.y), fabs(d.z))));
    }
    height = 16 * e * extent; /* eq 10.11 */
    height += 2 * e * (fabs(normal.x * point.x) + fabs(normal.y * point.y) + fabs(normal.z * point.z));
    return metro_add(point, metro_scale(normal, height));
}

enum { NAIVE, DERIVED, TRUTH, RULES };

/* Whether `lamp` is seen from a hit, by one of the rules. */
static int sees(const metro_scene *scene, int rule, metro_vec3 point, metro_vec3 normal, uint32_t triangle,
                metro_vec3 lamp)
{
    metro_vec3 d = metro_subtract(lamp, point);
    double length = sqrt(metro_dot(d, d));
    if (rule == TRUTH) return !stands_between(scene, point, lamp, triangle);
    if (rule == NAIVE) return !metro_scene_occluded(scene, point, d, absolute / length, 1 - absolute / length);
    point = leave(scene, point, normal, triangle);
    return !metro_scene_occluded(scene, point, metro_subtract(lamp, point), 0, 1 - 1e-6);
}

static double shade(const metro_scene *scene, int rule, double size, metro_vec3 direction, const metro_hit *hit)
{
    uint32_t i = hit->triangle;
    metro_vec3 normal = metro_scene_normal(scene, i), point;
    double light = 0;
    int k;
    if (rule == NAIVE) point = metro_add(scene->camera.eye, metro_scale(direction, hit->t));
    else
        point = metro_add(metro_add(metro_scale(metro_scene_corner(scene, i, 0), 1 - hit->u - hit->v),
                                    metro_scale(metro_scene_corner(scene, i, 1), hit->u)),
                          metro_scale(metro_scene_corner(scene, i, 2), hit->v));
    for (k = 0; k < LAMP_GRID * LAMP_GRID; k++) {
        metro_vec3 lamp = lamp_point(size, k), d = metro_subtract(lamp, point);
        double d2 = metro_dot(d, d), cosine = metro_dot(normal, d) / sqrt(d2);
        if (cosine > 0 && sees(scene, rule, point, normal, i, lamp)) light += cosine * d.y / sqrt(d2) / d2;
    }
    return size * size * light / (LAMP_GRID * LAMP_GRID) + 0.02; /* a little light from everywhere */
}

static metro_result picture_of(double size, int rule, size_t side, metro_image *image)
{
    metro_scene scene;
    metro_result result = still_life(size, &scene);
    size_t i;
    if (result == METRO_OK) result = metro_image_make(side, side, 1, image);
    for (i = 0; result == METRO_OK && i < side * side; i++) {
        double x = (double)(i % side) + 0.5, y = (double)(i / side) + 0.5;
        metro_vec3 direction = metro_camera_direction(&scene.camera, side, side, x, y);
        metro_hit hit;
        image->value[i] = 0.02;
        if (metro_scene_hit(&scene, scene.camera.eye, direction, 0, (double)INFINITY, &hit))
            image->value[i] = shade(&scene, rule, size, direction, &hit);
    }
    metro_scene_free(&scene);
    return result;
}

/* How much light is where it should not be or missing where it should, over all light. */
static double misplaced(const metro_image *image, const metro_image *truth)
{
    double apart = 0, all = 0;
    size_t i;
    for (i = 0; i < image->width * image->height; i++) {
        apart += fabs(image->value[i] - truth->value[i]);
        all += truth->value[i];
    }
    return apart / all;
}

static metro_result wrong_light(double size, double *naive, double *derived)
{
    metro_image image[RULES];
    metro_result result = METRO_OK;
    int rule;
    memset(image, 0, sizeof image);
    for (rule = 0; rule < RULES && result == METRO_OK; rule++) result = picture_of(size, rule, 64, &image[rule]);
    if (result == METRO_OK) {
        *naive = misplaced(&image[NAIVE], &image[TRUTH]);
        *derived = misplaced(&image[DERIVED], &image[TRUTH]);
        put("offset", "absolute", size, "misplaced", *naive, NONE);
        put("offset", "derived", size, "misplaced", *derived, NONE);
    }
    for (rule = 0; rule < RULES; rule++) metro_image_free(&image[rule]);
    return result;
}

static int draw_offset(void)
{
    static const double shown[SIZES_SHOWN] = { 0.003, 1, 1e5 };
    static const char *const title[SIZES_SHOWN] = { "size .003: shadows leak", "size 1: right",
                                                    "size 100000: speckles" };
    plot_chart chart = plot_chart_make(
        "One distance for all scenes is too long for a small one and too short for a large one", NULL);
    plot_panel *panel = &chart.panel[SIZES_SHOWN];
    double size[SIZES], naive[SIZES], derived[SIZES], worst = 0;
    metro_result result = METRO_OK;
    size_t i;
    for (i = 0; i < SIZES_SHOWN && result == METRO_OK; i++) {
        metro_image image;
        result = picture_of(shown[i], NAIVE, OFFSET_SIDE, &image);
        if (result != METRO_OK) break;
        light_hang(&chart.panel[i], &image, 0.4, title[i], NULL);
        metro_image_free(&image);
    }
    printf("%-22s %16s %16s\n", "size of the scene", "skip .001", "from the floats");
    for (i = 0; i < SIZES && result == METRO_OK; i++) {
        size[i] = pow(10, (double)i - 4);
        result = wrong_light(size[i], &naive[i], &derived[i]);
        worst = fmax(worst, derived[i]);
        printf("%-22g %14.2f %% %14.2f %%  of the light is misplaced\n", size[i], 100 * naive[i], 100 * derived[i]);
        naive[i] = fmax(100 * naive[i], 0.01); /* a logarithmic axis shows no 0 */
        derived[i] = fmax(100 * derived[i], 0.01);
    }
    if (result != METRO_OK) return complain("offset", result);
    put("offset", "derived", NONE, "worst", worst, NONE);
    plot_line(panel, size, naive, SIZES, "skip .001")->color = plot_palette(1);
    plot_line(panel, size, derived, SIZES, "height from the floats")->color = plot_palette(0);
    panel->x_label = "size of the scene";
    panel->y_label = "misplaced light, %";
    panel->x_log = panel->y_log = 1;
    panel->y_max = 100;
    chart.note =
        "Read: the same block and screen in three sizes. A shadow ray that skips .001 at both ends skips the "
        "block where all is small; where all is large the floats have moved it under the floor by more. "
        "Right: the light that is in the wrong place, against one that knows which triangle it leaves; what "
        "is below .01 % is drawn there.";
    chart.columns = 4;
    chart.width = 1500;
    return plot_save(&chart, "out/failures_offset.svg");
}

/* ---- Ways that fail ---- */

enum { WAYS = 4, ALL = WAYS, TRIES, SURFACES = 3, EDGES = 3 };

static const char *const surface_name[SURFACES] = { "floor", "walls", "ceiling" };

/* A room with a polished floor, and a lamp near the ceiling that shines upwards. Materials 1, 2 and 3 are the floor,
   the walls and the ceiling. */
static metro_result polished_room(metro_scene *scene)
{
    uint32_t floor, wall, ceiling, lamp;
    memset(scene, 0, sizeof *scene);
    floor = add_material(scene, 0.1, 0.8, 300, 0);
    wall = add_material(scene, 0.6, 0, 0, 0);
    ceiling = add_material(scene, 0.8, 0, 0, 0);
    lamp = add_material(scene, 0, 0, 0, 100);
    add_quad(scene, at(-1, 0, 1), at(1, 0, 1), at(1, 0, -1), at(-1, 0, -1), floor);
    add_quad(scene, at(-1, 0, -1), at(1, 0, -1), at(1, 2, -1), at(-1, 2, -1), wall);
    add_quad(scene, at(-1, 0, 1), at(-1, 0, -1), at(-1, 2, -1), at(-1, 2, 1), wall);
    add_quad(scene, at(1, 0, -1), at(1, 0, 1), at(1, 2, 1), at(1, 2, -1), wall);
    add_quad(scene, at(1, 0, 1), at(-1, 0, 1), at(-1, 2, 1), at(1, 2, 1), wall);
    add_quad(scene, at(-1, 2, -1), at(1, 2, -1), at(1, 2, 1), at(-1, 2, 1), ceiling);
    add_quad(scene, at(-0.1, 1.9, 0.0), at(0.1, 1.9, 0.0), at(0.1, 1.9, -0.2), at(-0.1, 1.9, -0.2), lamp);
    scene->camera.eye = at(0, 1, 0.98);
    scene->camera.look = at(0, 1, -1);
    scene->camera.up = at(0, 1, 0);
    scene->camera.fov = 88;
    return metro_scene_build(scene);
}

static metro_render_options way_options(size_t side)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = side;
    options.depth = options.shortest = EDGES;
    options.seed = 3;
    return options;
}

/* The ways of three edges, each alone, and the weighted picture: image[s] and image[ALL]. */
static metro_result ways_of(const metro_scene *scene, size_t side, uint64_t rounds, metro_image *image)
{
    metro_render_options options = way_options(side);
    metro_render render;
    metro_result result = light_render(scene, &options, rounds, &image[ALL], NULL);
    int s;
    if (result != METRO_OK) return result;
    options.heuristic = METRO_UNWEIGHTED;
    options.pyramid = 1;
    result = metro_render_make(scene, &scene->camera, &options, &render);
    if (result != METRO_OK) return result;
    result = metro_render_run(&render, rounds, NULL, NULL);
    for (s = 0; s < WAYS && result == METRO_OK; s++) result = metro_render_way(&render, s, EDGES + 1 - s, &image[s]);
    metro_render_free(&render);
    return result;
}

/* What is seen in the middle of a pixel: the number of its surface, SURFACES for the lamp. */
static int surface_at(const metro_scene *scene, size_t side, size_t pixel)
{
    metro_vec3 direction = metro_camera_direction(&scene->camera, side, side, (double)(pixel % side) + 0.5,
                                                  (double)(pixel / side) + 0.5);
    metro_hit hit;
    if (!metro_scene_hit(scene, scene->camera.eye, direction, 0, (double)INFINITY, &hit)) return SURFACES;
    return (int)scene->material_of[hit.triangle] - 1;
}

/* The relative RMSE over the pixels of each surface. */
static void errors_by_surface(const metro_scene *scene, const metro_image *image, const metro_image *truth,
                              double *error)
{
    double apart[SURFACES + 1] = { 0 }, power[SURFACES + 1] = { 0 };
    size_t i;
    int s;
    for (i = 0; i < 3 * image->width * image->height; i++) {
        s = surface_at(scene, image->width, i / 3);
        apart[s] += pow(image->value[i] - truth->value[i], 2);
        power[s] += pow(truth->value[i], 2);
    }
    for (s = 0; s < SURFACES; s++) error[s] = sqrt(apart[s] / power[s]);
}

static int draw_ways(void)
{
    static const char *const key[TRIES] = { "s0", "s1", "s2", "s3", "weighted" };
    static const char *const name[TRIES] = { "meet the lamp ($s = 0$)", "aim at the lamp ($s = 1$)",
                                             "join two walks ($s = 2$)", "aim at the eye ($s = 3$)",
                                             "all ways, weighted" };
    static char caption[TRIES][90];
    static char title[160];
    plot_chart chart = plot_chart_make(title, NULL);
    size_t side = plot_quick() ? 48 : 80;
    metro_render_options options = way_options(side);
    metro_image image[TRIES], truth;
    metro_scene scene;
    double noise, error[SURFACES], stops, worst, least = (double)INFINITY;
    metro_result result = polished_room(&scene);
    int i, s;
    memset(image, 0, sizeof image);
    if (result == METRO_OK) result = light_reference(&scene, &options, plot_quick() ? 32 : 128, &truth, &noise);
    if (result == METRO_OK) result = ways_of(&scene, side, 16, image);
    if (result != METRO_OK) return complain("ways", result);
    stops = light_exposure(&truth, 0.25);
    printf("\n%-28s %8s %8s %8s  relative RMSE (of the reference %.3f)\n", "three edges", surface_name[0],
           surface_name[1], surface_name[2], noise);
    for (i = 0; i < TRIES; i++) {
        errors_by_surface(&scene, &image[i], &truth, error);
        for (s = 0; s < SURFACES; s++) put("ways", key[i], NONE, surface_name[s], error[s], NONE);
        worst = fmax(error[0], fmax(error[1], error[2]));
        if (i != ALL) least = fmin(least, worst);
        printf("%-28s %8.2f %8.2f %8.2f\n", key[i], error[0], error[1], error[2]);
        snprintf(caption[i], sizeof caption[i], "error: floor %.2g, walls %.2g, ceiling %.2g", error[0], error[1],
                 error[2]);
        light_hang(&chart.panel[i], &image[i], stops, name[i], caption[i]);
        metro_image_free(&image[i]);
    }
    put("ways", "reference", NONE, "noise", noise, NONE);
    put("ways", "alone", NONE, "least_worst", least, NONE);
    put("ways", "weighted", NONE, "worst", worst, NONE);
    snprintf(title, sizeof title,
             "Each way alone is off by %.2g or more on some surface, all weighted by %.2g at most", least, worst);
    light_hang(&chart.panel[TRIES], &truth, stops, "reference", "the same, many more samples");
    chart.note = "Read: light that took three edges, in a room with a polished floor and a lamp that shines at the "
                 "ceiling close above it. The same 16 samples a pixel in each picture; the errors are relative RMSE.";
    chart.columns = 3;
    chart.rows = 2;
    chart.width = 1200;
    metro_image_free(&truth);
    metro_scene_free(&scene);
    return plot_save(&chart, "out/failures_ways.svg");
}

/* ---- Smooth pictures that differ ---- */

enum { SEEDS = 3, LINES = 2, CHAINS = 8, BLOCK = 8 };

static const char *const apex_key[LINES] = { "small", "large" };
static const double apex[LINES] = { 0.02, 0.3 };

static metro_render_options hidden_options(metro_method method, size_t side)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = side;
    options.depth = DEPTH;
    options.shortest = 2;
    options.method = method;
    return options;
}

/* The mean luminance of block number i of 8 x 8 pixels. */
static double block_mean(const metro_image *image, size_t i)
{
    size_t columns = image->width / BLOCK, k;
    double sum = 0;
    for (k = 0; k < BLOCK * BLOCK; k++) {
        size_t y = i / columns * BLOCK + k / BLOCK, x = i % columns * BLOCK + k % BLOCK;
        const double *p = &image->value[3 * (y * image->width + x)];
        sum += metro_luminance(p[0], p[1], p[2]) / (BLOCK * BLOCK);
    }
    return sum;
}

/* The share of the blocks in which one seed sees at least twice as much light as another, of those that are not
   nearly black. */
static double disagreement(const metro_image *image, const metro_image *truth)
{
    size_t count = truth->width / BLOCK * (truth->height / BLOCK), i, used = 0, apart = 0;
    double least = mean_luminance(truth) / 4;
    int k;
    for (i = 0; i < count; i++) {
        double low = (double)INFINITY, high = 0;
        if (block_mean(truth, i) < least) continue;
        for (k = 0; k < SEEDS; k++) {
            low = fmin(low, block_mean(&image[k], i));
            high = fmax(high, block_mean(&image[k], i));
        }
        used++;
        apart += high >= 2 * low;
    }
    return (double)apart / (double)used;
}

/* Pictures of one apex angle by all seeds, onto a line of the sheet. */
static metro_result render_line(const metro_scene *scene, int line, size_t side, metro_image *image,
                                metro_render_report *report)
{
    metro_render_options options = hidden_options(METRO_MLT, side);
    metro_result result = METRO_OK;
    int k;
    options.chains = CHAINS;
    options.perturbation = apex[line];
    for (k = 0; k < SEEDS && result == METRO_OK; k++) {
        options.seed = (uint64_t)k + 1;
        result = light_render(scene, &options, plot_quick() ? 16 : 48, &image[k], &report[k]);
        if (result != METRO_OK) break;
        put("seeds", apex_key[line], k + 1, "rhat", report[k].rhat, NONE);
        put("seeds", apex_key[line], k + 1, "ess", report[k].ess, NONE);
        put("seeds", apex_key[line], k + 1, "acceptance", report[k].acceptance, NONE);
        put("seeds", apex_key[line], k + 1, "warned", report[k].warning[0] != 0, NONE);
        printf("%-12g %8d %10.2f %10.0f  %s\n", apex[line], k + 1, report[k].rhat, report[k].ess, report[k].warning);
    }
    return result;
}

static int draw_seeds(const metro_scene *scene)
{
    static char title[LINES][SEEDS][80], words[200];
    plot_chart chart = plot_chart_make(words, NULL);
    size_t side = plot_quick() ? 32 : 64;
    metro_render_options options = hidden_options(METRO_BDPT, side);
    metro_image truth, image[SEEDS];
    metro_render_report report[SEEDS];
    double noise, stops, apart[LINES], rhat = (double)INFINITY;
    int i, k, warned = 0;
    metro_result result = light_reference(scene, &options, plot_quick() ? 24 : 64, &truth, &noise);
    if (result != METRO_OK) return complain("seeds", result);
    stops = light_exposure(&truth, 0.2);
    printf("\n%-12s %8s %10s %10s\n", "apex angle", "seed", "R-hat", "ESS");
    for (i = 0; i < LINES; i++) {
        result = render_line(scene, i, side, image, report);
        if (result != METRO_OK) return complain("seeds", result);
        apart[i] = disagreement(image, &truth);
        put("seeds", apex_key[i], NONE, "apex_angle", apex[i], NONE);
        put("seeds", apex_key[i], NONE, "disagreement", 100 * apart[i], NONE);
        for (k = 0; k < SEEDS; k++) {
            if (i == 0) rhat = fmin(rhat, report[k].rhat), warned += report[k].warning[0] != 0;
            snprintf(title[i][k], sizeof title[i][k], "%g rad, seed %d: R-hat %.2f", apex[i], k + 1, report[k].rhat);
            light_hang(&chart.panel[(SEEDS + 1) * i + k], &image[k], stops, title[i][k], NULL);
            metro_image_free(&image[k]);
        }
    }
    light_hang(&chart.panel[SEEDS], &truth, stops, "reference", NULL);
    put("seeds", "small", NONE, "least_rhat", rhat, NONE);
    snprintf(
        words, sizeof words,
        "Smooth, and another picture with each seed: %.0f %% of it differs by a factor of two or more, and R-hat "
        "is at least %.2g",
        100 * apart[0], rhat);
    chart.note =
        "Read: the lamp is behind the door. Above, small perturbations: neighbouring pixels agree, since the "
        "chains hardly move, and each seed paints other bright spots. Below, larger ones, as many samples: "
        "the noise is seen, and the pictures agree better.";
    chart.columns = SEEDS + 1;
    chart.rows = LINES;
    chart.width = 1300;
    metro_image_free(&truth);
    if (warned == SEEDS) return plot_save(&chart, "out/failures_seeds.svg");
    fprintf(stderr, PROGRAM ": a picture by small perturbations comes without a warning\n");
    plot_free(&chart);
    return 1;
}

/* ---- Nothing found ---- */

enum { CANDIDATES = 9, EIGHT = 3 }; /* 1, 2, 4, ..., and where 8 is */

/* What runs of one kind said of the mean luminance. */
typedef struct {
    double dark;              /* the share that found nothing */
    metro_moments all, lucky; /* all runs, and those that found something */
} searches;

/* Runs of one chain and 64 mutations, each started at one of `candidates` states and weighted by their mean. */
static metro_result search(const metro_scene *scene, size_t candidates, size_t runs, searches *s)
{
    metro_render_options options = hidden_options(METRO_MLT, 8);
    size_t i;
    memset(s, 0, sizeof *s);
    options.perturbation = 0.3;
    options.chains = 1;
    options.start = METRO_START_WEIGHTED;
    options.candidates = candidates;
    options.threads = 1;
    for (i = 0; i < runs; i++) {
        metro_image image;
        double mean = 0;
        metro_result result;
        options.part = i;
        result = light_render(scene, &options, 1, &image, NULL);
        if (result == METRO_OK) mean = mean_luminance(&image);
        if (result == METRO_OK) metro_image_free(&image);
        else if (result != METRO_ERROR_NO_IMPORTANCE) return result;
        if (result != METRO_OK) s->dark += 1 / (double)runs;
        else metro_moments_add(&s->lucky, mean);
        metro_moments_add(&s->all, mean);
    }
    return METRO_OK;
}

/* What is known of the room with the hidden lamp. */
typedef struct {
    double mean, error; /* the mean luminance of its picture, by bidirectional path tracing */
    double dark;        /* the share of independent states that carry no light */
} truth;

static int find_truth(const metro_scene *scene, truth *truth)
{
    metro_render_options options = hidden_options(METRO_BDPT, 16);
    metro_render_report report;
    metro_image image;
    metro_result result = light_render(scene, &options, plot_quick() ? 256 : 1500, &image, &report);
    if (result != METRO_OK) return complain("truth", result);
    metro_image_free(&image);
    truth->mean = report.mean;
    truth->error = report.mean_error;
    options = hidden_options(METRO_MLT, 16);
    options.large_step = 1;
    result = light_render(scene, &options, plot_quick() ? 100 : 500, &image, &report);
    if (result != METRO_OK) return complain("truth", result);
    metro_image_free(&image);
    truth->dark = report.dark;
    put("dark", "truth", NONE, "mean", truth->mean, truth->error);
    put("dark", "states", NONE, "dark", truth->dark, NONE);
    return 0;
}

/* What the chart shows, over the numbers of candidates. */
typedef struct {
    size_t count;
    double n[CANDIDATES], dark[CANDIDATES], dark_error[CANDIDATES], law[CANDIDATES];
    double all[CANDIDATES], all_error[CANDIDATES], lucky[CANDIDATES], lucky_error[CANDIDATES];
} darkness;

static metro_result measure_dark(const metro_scene *scene, const truth *truth, darkness *d)
{
    size_t runs = plot_quick() ? 100 : 500, c;
    d->count = plot_quick() ? 7 : CANDIDATES;
    for (c = 0; c < d->count; c++) {
        searches s;
        metro_result result = search(scene, (size_t)1 << c, runs, &s);
        if (result != METRO_OK) return result;
        d->n[c] = 1 << c;
        d->dark[c] = 100 * s.dark;
        d->dark_error[c] = 100 * sqrt(s.dark * (1 - s.dark) / (double)runs);
        d->law[c] = 100 * pow(truth->dark, d->n[c]);
        d->all[c] = metro_moments_mean(&s.all) / truth->mean;
        d->all_error[c] = metro_moments_error(&s.all) / truth->mean;
        d->lucky[c] = metro_moments_mean(&s.lucky) / truth->mean;
        d->lucky_error[c] = metro_moments_error(&s.lucky) / truth->mean;
        put("dark", "runs", d->n[c], "dark_percent", d->dark[c], d->dark_error[c]);
        put("dark", "all", d->n[c], "mean_over_truth", d->all[c], d->all_error[c]);
        put("dark", "lucky", d->n[c], "mean_over_truth", d->lucky[c], d->lucky_error[c]);
        printf("%-12g %16.1f %% %14.3f +- %.3f %14.3f +- %.3f\n", d->n[c], d->dark[c], d->all[c], d->all_error[c],
               d->lucky[c], d->lucky_error[c]);
    }
    return METRO_OK;
}

static int draw_dark(const metro_scene *scene, const truth *truth)
{
    static darkness d;
    static char words[200];
    plot_chart chart = plot_chart_make(words, NULL);
    plot_panel *left = &chart.panel[0], *right = &chart.panel[1];
    metro_result result;
    printf("\n%-12s %18s %22s %22s   truth %.5f +- %.5f\n", "candidates", "runs in the dark", "mean of all runs",
           "of those with light", truth->mean, truth->error);
    result = measure_dark(scene, truth, &d);
    if (result != METRO_OK) return complain("dark", result);
    plot_line(left, d.n, d.law, d.count, "(share of dark states)$^n$")->color = plot_palette(0);
    plot_points(left, d.n, d.dark, d.dark_error, d.count, NULL)->color = plot_palette(0);
    left->y_label = "runs that found no light, %";
    plot_points(right, d.n, d.all, d.all_error, d.count, "all runs, 0 for the dark ones")->color = plot_palette(0);
    plot_points(right, d.n, d.lucky, d.lucky_error, d.count, "only runs that found light")->color = plot_palette(1);
    right->last->marker = 2;
    plot_rule_y(right, 1, "right");
    right->y_label = "mean brightness, over the truth";
    left->x_label = right->x_label = "candidates $n$ for the start of a chain";
    left->x_log = right->x_log = right->y_log = 1;
    snprintf(
        words, sizeof words,
        "With eight candidates %.0f %% of the runs find no light; without their zeros the mean is %.2g times the "
        "truth",
        d.dark[EIGHT], d.lucky[EIGHT]);
    chart.note = "Read: one chain of 64 mutations a run, behind the door, from Veach's weighted seeds. A run whose "
                 "candidates are all dark says 0, and this 0 belongs to the mean over runs.";
    chart.columns = 2;
    chart.width = 1300;
    return plot_save(&chart, "out/failures_dark.svg");
}

/* ---- Rejections thrown away ---- */

enum { MUTATIONS = 6, STEPS = 2 };

/* The luminance of a picture as an importance on the square. */
static double luminance_at(const double *z, void *sample, void *user)
{
    const metro_image *image = (const metro_image *)user;
    size_t x = (size_t)(z[0] * (double)image->width), y = (size_t)(z[1] * (double)image->height);
    (void)sample;
    return image->value[y * image->width + x];
}

/* Counts where a chain is after each step, or only after those that were accepted. Keeps the picture after 4^k
   mutations a pixel, scaled to the mean luminance of the truth. */
static metro_result paint(metro_image *truth, int only_moves, size_t looks, double mean, metro_image *image)
{
    metro_axis axis[2] = { { METRO_INTERVAL, { METRO_UNIFORM, 0.1, 0, 0 } },
                           { METRO_INTERVAL, { METRO_UNIFORM, 0.1, 0, 0 } } };
    size_t side = truth->width, pixels = side * side, k, i, x, y;
    uint64_t steps = 0, counted = 0;
    metro_target target;
    metro_chain chain;
    metro_result result;
    memset(&target, 0, sizeof target);
    target.axes = axis;
    target.axis_count = 2;
    target.importance = luminance_at;
    target.user = truth;
    result = metro_chain_make(&target, NULL, metro_rng_make(7, (uint64_t)only_moves), &chain);
    if (result == METRO_OK) result = metro_chain_start_weighted(&chain, 1024);
    for (k = 0; k < looks && result == METRO_OK; k++) {
        result = metro_image_make(side, side, 1, &image[k]);
        if (result != METRO_OK) break;
        if (k > 0) memcpy(image[k].value, image[k - 1].value, pixels * sizeof(double));
        for (i = 0; k > 0 && i < pixels; i++) image[k].value[i] *= (double)counted / (double)pixels / mean;
        for (; steps < (uint64_t)pixels << (2 * k); steps++) {
            uint64_t before = chain.counts.accepted;
            metro_chain_step(&chain);
            if (only_moves && chain.counts.accepted == before) continue; /* the mistake */
            counted++;
            x = (size_t)(chain.state[0] * (double)side);
            y = (size_t)(chain.state[1] * (double)side);
            image[k].value[y * side + x]++;
        }
        for (i = 0; i < pixels; i++) image[k].value[i] *= mean * (double)pixels / (double)counted;
    }
    metro_chain_free(&chain);
    return result;
}

/* The light of the pixels where the truth is at least half of its brightest, over what it should be. */
static double brightest_part(const metro_image *image, const metro_image *truth)
{
    double most = 0, sum = 0, all = 0;
    size_t i, count = truth->width * truth->height;
    for (i = 0; i < count; i++) most = fmax(most, truth->value[i]);
    for (i = 0; i < count; i++) {
        if (truth->value[i] < most / 2) continue;
        sum += image->value[i];
        all += truth->value[i];
    }
    return sum / all;
}

static metro_result grey_cornell(size_t side, metro_image *grey)
{
    metro_render_options options;
    metro_scene scene;
    metro_image color;
    metro_result result;
    memset(&options, 0, sizeof options);
    options.width = options.height = side;
    options.depth = DEPTH;
    if (light_load(PROGRAM, "examples/scenes/cornell.obj", &scene) != 0) return METRO_ERROR_FILE;
    result = light_render(&scene, &options, 64, &color, NULL);
    if (result == METRO_OK) result = metro_image_make(side, side, 1, grey);
    if (result == METRO_OK) light_luminance(color.value, side * side, grey->value);
    if (result == METRO_OK) metro_image_free(&color);
    metro_scene_free(&scene);
    return result;
}

static const char *const step_key[STEPS] = { "right", "thrown_away" };
static const char *const step_name[STEPS] = { "right", "rejections thrown away" };

/* A line of errors, and the last picture onto the sheet. Returns the last error. */
static double study_step(plot_chart *chart, int i, metro_image *truth, double mean, double stops, char *caption,
                         size_t room)
{
    size_t looks = plot_quick() ? 5 : MUTATIONS, k;
    double samples[MUTATIONS], error[MUTATIONS], bright;
    metro_image image[MUTATIONS];
    memset(image, 0, sizeof image);
    if (paint(truth, i, looks, mean, image) != METRO_OK) return NONE;
    for (k = 0; k < looks; k++) {
        metro_image_difference difference;
        if (metro_image_error(&image[k], truth, &difference) != METRO_OK) return NONE;
        samples[k] = (double)(1 << (2 * k));
        error[k] = difference.relative_rmse;
        put("rejections", step_key[i], samples[k], "relative_rmse", error[k], NONE);
    }
    bright = brightest_part(&image[looks - 1], truth);
    put("rejections", step_key[i], NONE, "mutations", samples[looks - 1], NONE);
    put("rejections", step_key[i], NONE, "error", error[looks - 1], NONE);
    put("rejections", step_key[i], NONE, "lamp_percent", 100 * bright, NONE);
    printf("%-24s %12.3f %10.1f %%\n", step_name[i], error[looks - 1], 100 * bright);
    snprintf(caption, room, "the lamp has %.0f %% of its light", 100 * bright);
    light_hang(&chart->panel[1 + i], &image[looks - 1], stops, step_name[i], caption);
    plot_line(&chart->panel[3], samples, error, looks, step_name[i])->color = plot_palette((size_t)i);
    for (k = 0; k < looks; k++) metro_image_free(&image[k]);
    return error[looks - 1];
}

static int draw_rejections(void)
{
    static char caption[STEPS][80], words[120];
    plot_chart chart = plot_chart_make(words, NULL);
    size_t side = 64, k;
    metro_image truth;
    double mean = 0, last = 0, stops;
    metro_result result = grey_cornell(side, &truth);
    int i;
    if (result != METRO_OK) return complain("rejections", result);
    for (k = 0; k < side * side; k++) mean += truth.value[k] / (double)(side * side);
    stops = light_exposure(&truth, 0.45);
    printf("\n%-24s %12s %12s\n", "a step", "error", "lamp");
    for (i = 0; i < STEPS; i++) last = study_step(&chart, i, &truth, mean, stops, caption[i], sizeof caption[i]);
    light_hang(&chart.panel[0], &truth, stops, "the truth", NULL);
    metro_image_free(&truth);
    snprintf(words, sizeof words, "Thrown-away rejections: an error of %.2g that no number of samples mends", last);
    chart.note =
        "Read: a chain on the pixels of a picture, whose luminance is the importance. Each step counts where "
        "the chain is; in the third picture only accepted steps do. Scaled to the same mean, the lamp, where "
        "most is rejected, is too dark and all else too bright.";
    chart.panel[3].x_label = "mutations per pixel";
    chart.panel[3].y_label = "relative RMSE";
    chart.panel[3].x_log = chart.panel[3].y_log = 1;
    chart.columns = 4;
    chart.width = 1500;
    if (last > 0) return plot_save(&chart, "out/failures_rejections.svg");
    plot_free(&chart);
    return complain("rejections", METRO_ERROR_MEMORY);
}

/* ---- How bright the picture is ---- */

enum { RUNS = 16, LOOKS = 3 };

/* What runs of one length say of the mean luminance, over the truth. */
typedef struct {
    double mean[RUNS], error[RUNS]; /* the error is twice the stated one */
    double stated;
    int inside, unwarned; /* intervals that hold the truth; those that do not and come without a warning */
} lengths;

static metro_result measure_means(const metro_scene *scene, const truth *truth, uint64_t rounds, lengths *l)
{
    metro_render_options options = hidden_options(METRO_MLT, 16);
    double known = truth->error / truth->mean;
    size_t r;
    memset(l, 0, sizeof *l);
    options.chains = 4;
    options.candidates = 16;
    options.large_step = 0.5;
    for (r = 0; r < RUNS; r++) {
        metro_render_report report;
        metro_image image;
        metro_result result;
        int holds;
        options.part = r;
        result = light_render(scene, &options, rounds, &image, &report);
        if (result != METRO_OK) return result;
        metro_image_free(&image);
        l->mean[r] = report.mean / truth->mean;
        l->error[r] = 2 * report.mean_error / truth->mean;
        l->stated += l->error[r] / 2 / RUNS;
        holds = fabs(l->mean[r] - 1) <= hypot(l->error[r], 2 * known);
        l->inside += holds;
        l->unwarned += !holds && report.warning[0] == 0;
        put("mean", "run", (double)rounds, "mean_over_truth", l->mean[r], l->error[r] / 2);
    }
    put("mean", "stated", (double)rounds, "error_percent", 100 * l->stated, NONE);
    put("mean", "inside", (double)rounds, "runs", l->inside, NONE);
    put("mean", "unwarned", (double)rounds, "runs", l->unwarned, NONE);
    printf("%-24d %16.1f %% %14d of %d\n", (int)rounds, 100 * l->stated, l->inside, RUNS);
    return METRO_OK;
}

static int draw_mean(const metro_scene *scene, const truth *truth)
{
    static const uint64_t rounds[LOOKS] = { 4, 16, 64 };
    static lengths l[LOOKS];
    static char words[200];
    plot_chart chart = plot_chart_make(words, NULL);
    plot_panel *panel = &chart.panel[0];
    size_t looks = plot_quick() ? 2 : LOOKS, k, r;
    double x[RUNS];
    int inside = 0, unwarned = 0;
    printf("\n%-24s %18s %20s   truth %.5f +- %.5f\n", "rounds", "stated error", "intervals that hold", truth->mean,
           truth->error);
    for (k = 0; k < looks; k++) {
        metro_result result = measure_means(scene, truth, rounds[k], &l[k]);
        if (result != METRO_OK) return complain("mean", result);
        for (r = 0; r < RUNS; r++) x[r] = (double)(k * (RUNS + 2) + r + 1);
        plot_points(panel, x, l[k].mean, l[k].error, RUNS, plot_say(panel, "% rounds", (double)rounds[k]))->color =
            plot_palette(k);
        inside += l[k].inside;
        unwarned += l[k].unwarned;
    }
    put("mean", "all", NONE, "runs", (double)(looks * RUNS), NONE);
    put("mean", "all", NONE, "inside", inside, NONE);
    put("mean", "all", NONE, "unwarned", unwarned, NONE);
    printf(
        "of %d short runs with the hidden lamp %d state an interval that holds the true brightness; %d of the others "
        "come without a warning\n",
        (int)looks * RUNS, inside, unwarned);
    plot_rule_y(panel, 1, "truth");
    snprintf(words, sizeof words,
             "The stated error shrinks from %.0f to %.0f %%; as long as it is large, mistrust it", 100 * l[0].stated,
             100 * l[looks - 1].stated);
    chart.note = "Read: the mean brightness of the room with the hidden lamp, as Metropolis pictures know it; each "
                 "point is a run with another seed, with twice the error that it states (cut at 3). Few states find "
                 "the light, and until the brightest have been met nothing speaks of them. Large steps refine it.";
    panel->x_label = "runs, by their length";
    panel->y_label = "mean luminance, over the truth";
    panel->x_max = (double)looks * (RUNS + 2);
    panel->y_max = 3;
    chart.width = 1200;
    return plot_save(&chart, "out/failures_mean.svg");
}

int main(void)
{
    metro_scene hidden;
    truth mean;
    int failed;
    if (light_load(PROGRAM, "examples/scenes/hidden.obj", &hidden) != 0) return 1;
    csv = plot_csv_open("out/failures_light.csv", "sheet,case,x,quantity,value,error");
    failed = draw_offset() != 0 || draw_ways() != 0 || draw_seeds(&hidden) != 0 || find_truth(&hidden, &mean) != 0 ||
             draw_dark(&hidden, &mean) != 0 || draw_rejections() != 0 || draw_mean(&hidden, &mean) != 0;
    metro_scene_free(&hidden);
    return failed | plot_csv_close(&csv);
}
