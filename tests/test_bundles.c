/* test_bundles.c - chapter 14: bundles against form factors, furnaces and a sphere, the four visibilities against
   each other, walks against each other and against bidirectional paths.

   All memory goes through a counter that can also fail, which is not safe with threads, so everything here has one
   thread but the one test that compares threads, which counts nothing. */

#include "memory.h"

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "light.h"

/* ---- helpers ---- */

static metro_patches patches_make(const metro_scene *scene, double size)
{
    metro_patches patches;
    metro_result result;
    memset(&patches, 0, sizeof patches);
    result = metro_patches_make(scene, size, &patches);
    CHECK(result == METRO_OK, "patches: %s", metro_result_text(result));
    return patches;
}

static metro_vec3 *colors_make(const metro_patches *patches, double value)
{
    metro_vec3 *colors = (metro_vec3 *)malloc((patches->count + 1) * sizeof *colors);
    size_t i;
    for (i = 0; i < patches->count; i++) colors[i] = grey(value);
    return colors;
}

static void transfer(const metro_patches *patches, metro_vec3 direction, size_t grid, const double *shift,
                     metro_visibility visibility, const metro_vec3 *radiance, metro_vec3 *received,
                     metro_bundle_balance *balance)
{
    metro_result result =
        metro_bundle_transfer(patches, direction, grid, shift, visibility, radiance, received, balance);
    CHECK(result == METRO_OK, "transfer: %s", metro_result_text(result));
}

static void random_lines(metro_rng *rng, metro_vec3 *direction, double shift[2])
{
    *direction = metro_rng_direction(rng);
    shift[0] = metro_rng_uniform(rng);
    shift[1] = metro_rng_uniform(rng);
}

/* The mean over the patches of a triangle pair `wall` (triangles 2 wall and 2 wall + 1), weighted by area. */
static double wall_mean(const metro_patches *patches, const metro_vec3 *value, uint32_t wall)
{
    double sum = 0, area = 0;
    size_t i;
    for (i = patches->first[2 * wall]; i < patches->first[2 * wall + 2]; i++) {
        sum += value[i].x * patches->patch[i].area;
        area += patches->patch[i].area;
    }
    return sum / area;
}

static void balance_check(const metro_bundle_balance *balance)
{
    metro_vec3 end = metro_add(balance->arrived, metro_add(balance->escaped, balance->absorbed));
    CHECK_NEAR(end.x, balance->left.x, 1e-12);
    CHECK_NEAR(end.y, balance->left.y, 1e-12);
    CHECK_NEAR(end.z, balance->left.z, 1e-12);
}

static metro_bundles_options bundles_options(int depth, double patch, size_t grid)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = 32;
    options.depth = depth;
    options.patch = patch;
    options.grid = grid;
    options.threads = 1;
    return options;
}

static metro_bundles bundles_run(const metro_scene *scene, const metro_camera *camera,
                                 const metro_bundles_options *options, uint64_t walks)
{
    metro_bundles bundles;
    metro_result result;
    memset(&bundles, 0, sizeof bundles);
    result = metro_bundles_make(scene, camera, options, &bundles);
    CHECK(result == METRO_OK, "make: %s", metro_result_text(result));
    result = metro_bundles_run(&bundles, walks, NULL, NULL);
    CHECK(result == METRO_OK, "run: %s", metro_result_text(result));
    return bundles;
}

static metro_bundles_report report_of(const metro_bundles *bundles)
{
    metro_bundles_report report;
    metro_bundles_diagnose(bundles, &report);
    return report;
}

/* The part of the mean luminance that is lamps seen directly. */
static double lamps_seen(const metro_bundles *bundles)
{
    double sum = 0;
    size_t i;
    for (i = 0; i < bundles->patches.count; i++) {
        uint32_t triangle = bundles->patches.patch[i].triangle;
        metro_vec3 e = metro_scene_material(bundles->scene, bundles->scene->material_of[triangle])->ke;
        sum += bundles->share[i] * metro_luminance(e.x, e.y, e.z);
    }
    return sum;
}

static metro_vec3 *radiance_of(const metro_bundles *bundles, metro_vec3 *error)
{
    metro_vec3 *radiance = colors_make(&bundles->patches, 0);
    metro_result result = metro_bundles_radiance(bundles, radiance, error);
    CHECK(result == METRO_OK, "radiance: %s", metro_result_text(result));
    return radiance;
}

/* Two results agree in their mean, within their joint error. */
static void agree(const char *what, const metro_bundles *a, const metro_bundles *b)
{
    metro_bundles_report x = report_of(a), y = report_of(b);
    double error = sqrt(x.mean_error * x.mean_error + y.mean_error * y.mean_error);
    double bound = student_bound((double)(a->options.batches + b->options.batches) - 2) * error;
    CHECK(fabs(x.mean - y.mean) <= bound, "%s: %g +- %g and %g +- %g", what, x.mean, x.mean_error, y.mean,
          y.mean_error);
    CHECK(error < 0.2 * x.mean, "%s: the error %g says nothing of %g", what, error, x.mean);
}

/* ---- patches ---- */

static void patches_cover(void)
{
    metro_scene scene = empty_scene();
    metro_rng rng = metro_rng_make(1, 0);
    metro_patches patches;
    double area = 0, longest = 0;
    size_t i, k;
    int t;
    add_triangle(&scene, metro_vec3_make(0, 0, 0), metro_vec3_make(1, 0, 0.5), metro_vec3_make(0.25, 2, 0), 0);
    add_triangle(&scene, grey(0), grey(1), grey(2), 0); /* no area */
    add_triangle(&scene, metro_vec3_make(3, 0, 0), metro_vec3_make(3, 0.1, 0), metro_vec3_make(3, 0, 0.1), 0);
    patches = patches_make(&scene, 0.3);
    CHECK(patches.cuts[0] == 8 && patches.cuts[1] == 0 && patches.cuts[2] == 1, "%u %u %u cuts", patches.cuts[0],
          patches.cuts[1], patches.cuts[2]);
    CHECK(patches.count == 65 && patches.first[2] == 64 && patches.first[3] == 65, "%zu patches", patches.count);
    for (i = 0; i < 64; i++) {
        const metro_patch *patch = &patches.patch[i];
        metro_vec3 a = metro_subtract(patch->corner[1], patch->corner[0]);
        metro_vec3 b = metro_subtract(patch->corner[2], patch->corner[0]), n = metro_cross(a, b);
        area += patch->area;
        CHECK_NEAR(0.5 * metro_length(n), patch->area, 1e-12);
        CHECK_CLOSE(metro_dot(metro_normalize(n), patch->normal), 1, 1e-12);
        CHECK(patch->triangle == 0, "patch %zu", i);
        for (k = 0; k < 3; k++) {
            double edge = metro_length(metro_subtract(patch->corner[(k + 1) % 3], patch->corner[k]));
            if (edge > longest) longest = edge;
        }
    }
    CHECK_NEAR(area, metro_scene_area(&scene, 0), 1e-12);
    CHECK(longest <= 0.3 * (1 + 1e-6), "an edge of %g", longest);
    /* Each point is in the patch that is said to hold it. */
    for (t = 0; t < 2000; t++) {
        double u = metro_rng_uniform(&rng), v = metro_rng_uniform(&rng);
        metro_vec3 p;
        const metro_patch *patch;
        if (u + v > 1) {
            u = 1 - u;
            v = 1 - v;
        }
        p = metro_add(metro_scale(metro_scene_corner(&scene, 0, 0), 1 - u - v),
                      metro_add(metro_scale(metro_scene_corner(&scene, 0, 1), u),
                                metro_scale(metro_scene_corner(&scene, 0, 2), v)));
        i = metro_patches_at(&patches, 0, u, v);
        CHECK(i < 64, "patch %zu", i);
        patch = &patches.patch[i];
        for (k = 0; k < 3; k++) {
            metro_vec3 e = metro_subtract(patch->corner[(k + 1) % 3], patch->corner[k]);
            double side = metro_dot(metro_cross(e, metro_subtract(p, patch->corner[k])), patch->normal);
            CHECK(side > -1e-9, "point %d is outside patch %zu by %g", t, i, side);
        }
    }
    CHECK(metro_patches_at(&patches, 0, -1, -1) < 64 && metro_patches_at(&patches, 0, 2, 2) < 64, "outside");
    CHECK(metro_patches_at(&patches, 1, 0.1, 0.1) == patches.count, "no area");
    CHECK(metro_patches_at(&patches, 9, 0.1, 0.1) == patches.count, "no triangle");
    metro_patches_free(&patches);
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

/* ---- one bundle ---- */

/* Form factors of the unit cube, Howell's catalogue: from a wall that glows with radiance 1 the irradiance of another
   is pi times the form factor. Planted: 4 pi for 2 pi gives twice these; one way only gives half. */
static void cube_factors(metro_visibility visibility, double size, size_t grid, double bundles)
{
    metro_scene scene = furnace_scene(0.5, 1);
    metro_patches patches = patches_make(&scene, size);
    metro_vec3 *radiance = colors_make(&patches, 0), *received = colors_make(&patches, 0);
    metro_rng rng = metro_rng_make(2, (uint64_t)visibility);
    metro_moments opposite, beside, itself;
    uint64_t n, count = check_count(bundles, 400);
    size_t i;
    memset(&opposite, 0, sizeof opposite);
    memset(&beside, 0, sizeof beside);
    memset(&itself, 0, sizeof itself);
    for (i = patches.first[0]; i < patches.first[2]; i++) radiance[i] = grey(1); /* the wall at -x */
    for (n = 0; n < count; n++) {
        metro_vec3 direction;
        double shift[2];
        random_lines(&rng, &direction, shift);
        transfer(&patches, direction, grid, shift, visibility, radiance, received, NULL);
        metro_moments_add(&itself, 2 * wall_mean(&patches, received, 0));
        metro_moments_add(&opposite, 2 * wall_mean(&patches, received, 1));
        metro_moments_add(&beside, 2 * wall_mean(&patches, received, 3));
    }
    CHECK(metro_moments_mean(&itself) == 0, "a plane sees itself: %g", metro_moments_mean(&itself));
    CHECK_SIGMA(metro_moments_mean(&opposite), 0.19982490, metro_moments_error(&opposite));
    CHECK_SIGMA(metro_moments_mean(&beside), 0.20004378, metro_moments_error(&beside));
    CHECK(metro_moments_error(&opposite) < 0.03, "error %g", metro_moments_error(&opposite));
    free(radiance);
    free(received);
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

static void cube_form_factors(void)
{
    cube_factors(METRO_SWEEP, 0.5, 48, 4000);
    cube_factors(METRO_FRAGMENTS, 0.5, 48, 1500);
    cube_factors(METRO_LINES, 0.5, 24, 3000);
    cube_factors(METRO_LINES, 5, 6, 4000);
}

/* Trap 43: patches a fifth of a cell long. */
static void patches_smaller_than_a_cell(void)
{
    cube_factors(METRO_SWEEP, 0.2, 4, 2000);
    cube_factors(METRO_FRAGMENTS, 0.2, 4, 2000);
    cube_factors(METRO_LINES, 0.2, 4, 2000);
}

/* Two parallel squares of side 1 at distance 1 have the form factor .19982490; at distance 1/2 .41525. The rest of
   what they send escapes. */
static void parallel_plates(void)
{
    const double distance[2] = { 1, 0.5 }, factor[2] = { 0.19982490, 0.41525283 };
    int k;
    for (k = 0; k < 2; k++) {
        metro_scene scene = empty_scene();
        metro_patches patches;
        metro_vec3 *radiance, *received;
        metro_rng rng = metro_rng_make(3, 0);
        metro_moments seen, left;
        uint64_t n, count = check_count(6000, 400);
        memset(&seen, 0, sizeof seen);
        memset(&left, 0, sizeof left);
        add_quad(&scene, metro_vec3_make(0, 0, 0), metro_vec3_make(0, 0, 1), metro_vec3_make(1, 0, 0), 0);
        add_quad(&scene, metro_vec3_make(0, distance[k], 0), metro_vec3_make(1, 0, 0), metro_vec3_make(0, 0, 1), 0);
        patches = patches_make(&scene, 0.3);
        radiance = colors_make(&patches, 1);
        received = colors_make(&patches, 0);
        for (n = 0; n < count; n++) {
            metro_bundle_balance balance;
            metro_vec3 direction;
            double shift[2];
            random_lines(&rng, &direction, shift);
            transfer(&patches, direction, 32, shift, METRO_SWEEP, radiance, received, &balance);
            balance_check(&balance);
            CHECK(balance.absorbed.x == 0, "backs that no line should meet absorb %g", balance.absorbed.x);
            metro_moments_add(&seen, 2 * wall_mean(&patches, received, 0));
            metro_moments_add(&left, balance.left.x);
        }
        CHECK_SIGMA(metro_moments_mean(&seen), factor[k], metro_moments_error(&seen));
        CHECK_SIGMA(metro_moments_mean(&left), 1, metro_moments_error(&left)); /* the mean of abs(cos), twice */
        free(radiance);
        free(received);
        metro_patches_free(&patches);
        metro_scene_free(&scene);
    }
}

/* A crowded scene: boxes just above the floor of a room, a tilted box in the air, panels. */
static metro_scene crowd_scene(int open)
{
    metro_scene scene = empty_scene();
    uint32_t wall[6], white = add_material(&scene, grey(0.7), grey(0), 0, grey(0));
    uint32_t lamp = add_material(&scene, grey(0.2), grey(0), 0, metro_vec3_make(3, 4, 2));
    int i;
    for (i = 0; i < 6; i++) wall[i] = white;
    if (!open) add_box(&scene, grey(-1), grey(1), 1, wall);
    add_box(&scene, metro_vec3_make(-0.7, -0.95, -0.6), metro_vec3_make(-0.2, 0.1, -0.1), 0, wall);
    add_box(&scene, metro_vec3_make(0.1, -0.9, 0.1), metro_vec3_make(0.7, -0.5, 0.5), 0, wall);
    add_triangle(&scene, metro_vec3_make(-0.6, 0.3, 0.7), metro_vec3_make(0.8, 0.35, 0.6),
                 metro_vec3_make(0.1, 0.9, -0.8), white);
    add_triangle(&scene, metro_vec3_make(-0.6, 0.3, 0.7), metro_vec3_make(0.1, 0.9, -0.8),
                 metro_vec3_make(0.8, 0.35, 0.6), white); /* the same sheet from its other side */
    add_quad(&scene, metro_vec3_make(-0.3, 0.99, -0.3), metro_vec3_make(0.6, 0, 0), metro_vec3_make(0, 0, 0.6), lamp);
    build(&scene);
    return scene;
}

/* What leaves arrives, escapes or is absorbed, to rounding, in every direction and by every visibility. Planted: a
   stair that starts at the rounded end of its span is off by 1e-4. */
static void energy_balance(void)
{
    int open, v, n;
    for (open = 0; open < 2; open++) {
        metro_scene scene = crowd_scene(open);
        metro_patches patches = patches_make(&scene, 0.17);
        metro_vec3 *radiance = colors_make(&patches, 0), *received = colors_make(&patches, 0);
        metro_rng rng = metro_rng_make(4, (uint64_t)open);
        size_t i;
        for (i = 0; i < patches.count; i++)
            radiance[i] = metro_vec3_make(metro_rng_uniform(&rng), metro_rng_uniform(&rng), metro_rng_uniform(&rng));
        for (v = 0; v < 4; v++)
            for (n = 0; n < 20; n++) {
                metro_bundle_balance balance;
                metro_vec3 direction;
                double shift[2], arrived = 0;
                random_lines(&rng, &direction, shift);
                transfer(&patches, direction, 100, shift, (metro_visibility)v, radiance, received, &balance);
                balance_check(&balance);
                for (i = 0; i < patches.count; i++) arrived += received[i].x * patches.patch[i].area;
                CHECK_NEAR(arrived, balance.arrived.x, 1e-12);
                if (open) CHECK(balance.escaped.x > 0.05 * balance.left.x, "only %g escapes", balance.escaped.x);
                else if (v != METRO_PAINTER)
                    CHECK(balance.escaped.x < 1e-12, "from a closed room %g escapes", balance.escaped.x);
            }
        free(radiance);
        free(received);
        metro_patches_free(&patches);
        metro_scene_free(&scene);
    }
}

static double difference(const metro_patches *patches, const metro_vec3 *a, const metro_vec3 *b)
{
    double sum = 0, all = 0;
    size_t i;
    for (i = 0; i < patches->count; i++) {
        metro_vec3 d = metro_subtract(a[i], b[i]);
        sum += metro_dot(d, d) * patches->patch[i].area;
        all += metro_dot(b[i], b[i]) * patches->patch[i].area;
    }
    return sqrt(sum / all);
}

/* The sweep does what the fragments do, line by line; a fine comb of lines comes near infinitely many; painting does
   not. */
static void visibilities_agree(void)
{
    metro_scene scene = crowd_scene(0);
    metro_patches patches = patches_make(&scene, 0.3);
    metro_vec3 *radiance = colors_make(&patches, 0), *received[4];
    metro_rng rng = metro_rng_make(5, 0);
    double painted[2] = { 0, 0 }, lines[2] = { 0, 0 };
    int n, v, fine;
    size_t i;
    for (v = 0; v < 4; v++) received[v] = colors_make(&patches, 0);
    for (i = 0; i < patches.count; i++) radiance[i] = grey(metro_rng_uniform(&rng));
    for (fine = 0; fine < 2; fine++) {
        int count = fine ? (int)check_count(8, 3) : 30;
        for (n = 0; n < count; n++) {
            metro_vec3 direction;
            double shift[2];
            random_lines(&rng, &direction, shift);
            for (v = 0; v < 4; v++)
                transfer(&patches, direction, fine ? 800 : 50, shift, (metro_visibility)v, radiance, received[v],
                         NULL);
            CHECK(difference(&patches, received[METRO_FRAGMENTS], received[METRO_SWEEP]) < (fine ? 1e-3 : 1e-12),
                  "fragments are off by %g", difference(&patches, received[METRO_FRAGMENTS], received[METRO_SWEEP]));
            painted[fine] += difference(&patches, received[METRO_PAINTER], received[METRO_SWEEP]) / count;
            lines[fine] += difference(&patches, received[METRO_LINES], received[METRO_SWEEP]) / count;
        }
    }
    CHECK(lines[0] > 0.01 && lines[1] < 0.1 * lines[0], "lines: %g, and %g on a fine grid", lines[0], lines[1]);
    CHECK(painted[0] > 0.002 && painted[1] > 0.5 * painted[0], "painting: %g, and %g on a fine grid", painted[0],
          painted[1]);
    for (v = 0; v < 4; v++) free(received[v]);
    free(radiance);
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

/* Trap 48: along axes, along diagonals, in the planes of patches and nearly so. */
static void special_directions(void)
{
    metro_scene scene = crowd_scene(0);
    metro_patches patches = patches_make(&scene, 0.25);
    metro_vec3 *radiance = colors_make(&patches, 1), *received = colors_make(&patches, 0);
    int x, y, z, v, k;
    for (x = -1; x <= 1; x++)
        for (y = -1; y <= 1; y++)
            for (z = -1; z <= 1; z++)
                for (v = 0; v < 4; v++)
                    for (k = 0; k < 4; k++) {
                        const double tilt[4] = { 0, 1e-15, 1e-9, 1e-5 };
                        const double shift[2] = { k == 0 ? 0 : 0.3, 0.5 };
                        metro_bundle_balance balance;
                        metro_vec3 d = metro_vec3_make(x + tilt[k], y - 2 * tilt[k], z + 3 * tilt[k]);
                        size_t i;
                        if (x == 0 && y == 0 && z == 0) continue;
                        transfer(&patches, metro_scale(d, k == 3 ? 1e200 : 1), 40, shift, (metro_visibility)v,
                                 radiance, received, &balance);
                        balance_check(&balance);
                        for (i = 0; i < patches.count; i++)
                            CHECK(received[i].x >= 0 && received[i].x < 8, "patch %zu receives %g", i, received[i].x);
                    }
    free(radiance);
    free(received);
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

/* Trap 46: the same sheet twice, from both sides, and a box on it. A sheet of two triangles back to back shows both
   its fronts, what stands on it exchanges nothing with it, and the energy is kept whatever the order. Planted: with
   the touching fronts face to face the sheet sees itself only. */
static void touching_patches(void)
{
    metro_scene scene = empty_scene();
    uint32_t side[6] = { 0, 0, 0, 0, 0, 0 };
    metro_patches patches;
    metro_vec3 *radiance, *received;
    metro_rng rng = metro_rng_make(6, 0);
    int v, n;
    size_t i;
    add_quad(&scene, metro_vec3_make(-1, 0, -1), metro_vec3_make(0, 0, 2), metro_vec3_make(2, 0, 0), 0); /* up */
    add_quad(&scene, metro_vec3_make(-1, 0, -1), metro_vec3_make(2, 0, 0), metro_vec3_make(0, 0, 2), 0); /* down */
    add_quad(&scene, metro_vec3_make(-1, 1, -1), metro_vec3_make(2, 0, 0), metro_vec3_make(0, 0, 2), 0);
    add_quad(&scene, metro_vec3_make(-1, -1, -1), metro_vec3_make(0, 0, 2), metro_vec3_make(2, 0, 0), 0);
    add_box(&scene, metro_vec3_make(-0.25, 0, -0.25), metro_vec3_make(0.25, 0.5, 0.25), 0, side);
    patches = patches_make(&scene, 0.25);
    radiance = colors_make(&patches, 1);
    received = colors_make(&patches, 0);
    for (i = patches.first[0]; i < patches.first[4]; i++) radiance[i] = grey(0); /* the sheet is dark */
    for (v = 0; v < 4; v++)
        for (n = 0; n < 20; n++) {
            metro_bundle_balance balance;
            metro_vec3 direction;
            double shift[2], up = 0, down = 0, bottom = 0;
            random_lines(&rng, &direction, shift);
            direction.y = 3;
            transfer(&patches, direction, 64, shift, (metro_visibility)v, radiance, received, &balance);
            balance_check(&balance);
            for (i = 0; i < patches.count; i++) {
                uint32_t t = patches.patch[i].triangle;
                if (t < 2) up += received[i].x * patches.patch[i].area;
                else if (t < 4) down += received[i].x * patches.patch[i].area;
                else if (t >= 12 && t < 14) bottom += received[i].x * patches.patch[i].area;
            }
            if (v == METRO_PAINTER) continue;
            CHECK(up > 0.3 * down && down > 2, "the upper side receives %g, the lower %g", up, down);
            CHECK(bottom == 0, "the bottom of a box on the floor receives %g", bottom);
        }
    free(radiance);
    free(received);
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

/* ---- walks ---- */

static metro_camera inside_camera(void)
{
    return camera_make(metro_vec3_make(0.1, 0.2, 0.9), metro_vec3_make(0, -0.1, -1), 90);
}

/* A closed furnace has the radiance sum of rho^k after k = 1 .. D reflections; rho = 1 keeps all. The mean fluctuates
   from walk to walk even so, since the patches get what the lines happen to bring. Planted: emission that is sent in
   the first step only gives rho^D alone. */
static void furnace(void)
{
    const double rho[2] = { 0.6, 1 };
    int r, v;
    for (r = 0; r < 2; r++)
        for (v = 0; v < 4; v++) {
            metro_scene scene = furnace_scene(rho[r], 2);
            metro_camera camera = inside_camera();
            metro_bundles_options options = bundles_options(5, 0.7, 24);
            metro_bundles bundles;
            metro_bundles_report report;
            options.visibility = v == 3 ? METRO_LINES : v == 2 ? METRO_SWEEP : (metro_visibility)v;
            options.walk = v == 2 ? METRO_WALK_EVEN : METRO_WALK_RANDOM;
            options.batches = 64;
            bundles = bundles_run(&scene, &camera, &options, check_count(v == 1 ? 640 : 1920, 640));
            report = report_of(&bundles);
            CHECK_SIGMA(report.mean, furnace_radiance(rho[r], 2, 1, 5), report.mean_error);
            CHECK(report.mean_error < 0.02 * report.mean, "error %g of %g", report.mean_error, report.mean);
            CHECK(bundles.bundles == 4 * bundles.walks, "%g bundles", (double)bundles.bundles);
            metro_bundles_free(&bundles);
            metro_scene_free(&scene);
        }
}

/* Inside a sphere whose upper half glows F_ij = A_j/A, so all patches receive the same, and after k reflections they
   send rho^k times half the emission. With flat facets their mean is the same by reciprocity, and up to a per cent
   each half has it for itself. Planted: a frame that is not orthogonal, or half of the directions only. */
static void sphere(void)
{
    const int n = 24, m = 12; /* around, and from pole to pole */
    const double rho = 0.5, truth = 0.5 * rho * (1 - pow(rho, 8)) / (1 - rho);
    metro_scene scene = empty_scene();
    uint32_t bright = add_material(&scene, grey(rho), grey(0), 0, grey(1));
    uint32_t dark = add_material(&scene, grey(rho), grey(0), 0, grey(0));
    metro_camera camera = inside_camera();
    metro_bundles_options options = bundles_options(9, 2, 40);
    metro_moments mean, skew;
    size_t i;
    int a, b, k;
    for (b = 0; b < m; b++)
        for (a = 0; a < n; a++) {
            metro_vec3 p[4];
            for (k = 0; k < 4; k++) {
                double t = CHECK_PI * (b + k / 2) / m, f = 2 * CHECK_PI * (a + (k == 1 || k == 2)) / n;
                p[k] = metro_vec3_make(sin(t) * cos(f), cos(t), sin(t) * sin(f));
            }
            if (b > 0) add_triangle(&scene, p[0], p[2], p[1], b < m / 2 ? bright : dark);
            if (b < m - 1) add_triangle(&scene, p[0], p[3], p[2], b < m / 2 ? bright : dark);
        }
    build(&scene);
    memset(&mean, 0, sizeof mean);
    memset(&skew, 0, sizeof skew);
    for (options.part = 0; options.part < 20; options.part++) {
        metro_bundles bundles = bundles_run(&scene, &camera, &options, check_count(48, 16));
        metro_vec3 *radiance = colors_make(&bundles.patches, 0);
        double sum[2] = { 0, 0 }, area = 0;
        CHECK(metro_bundles_radiance(&bundles, radiance, NULL) == METRO_OK, "radiance");
        for (i = 0; i < bundles.patches.count; i++) {
            const metro_patch *patch = &bundles.patches.patch[i];
            sum[patch->normal.y > 0] += radiance[i].x * patch->area;
            area += patch->area;
        }
        metro_moments_add(&mean, (sum[0] + sum[1]) / area);
        metro_moments_add(&skew, 2 * (sum[0] - sum[1]) / area);
        free(radiance);
        metro_bundles_free(&bundles);
    }
    CHECK_SIGMA(metro_moments_mean(&mean), truth, metro_moments_error(&mean));
    CHECK(fabs(metro_moments_mean(&skew)) < 0.01 * truth + 5.1 * metro_moments_error(&skew),
          "the halves differ by %g", metro_moments_mean(&skew));
    CHECK(metro_moments_error(&mean) < 0.02 * truth && metro_moments_error(&skew) < 0.05 * truth, "errors %g and %g",
          metro_moments_error(&mean), metro_moments_error(&skew));
    metro_scene_free(&scene);
}

/* ---- methods against each other ---- */

/* A room with a lamp in its ceiling and two boxes, all diffuse, or all partly glossy. */
static metro_scene room_scene(double gloss)
{
    metro_scene scene = empty_scene();
    uint32_t side[6], wall[6], i;
    uint32_t white =
        add_material(&scene, metro_vec3_make(0.7 - gloss, 0.6 - gloss, 0.5 - gloss), grey(gloss), 3, grey(0));
    uint32_t shiny = add_material(&scene, grey(0.6 - gloss), grey(gloss), 6, grey(0));
    uint32_t lamp = add_material(&scene, grey(0), grey(0), 0, metro_vec3_make(9, 8, 7));
    for (i = 0; i < 6; i++) wall[i] = white;
    for (i = 0; i < 6; i++) side[i] = shiny;
    wall[2] = shiny;
    add_box(&scene, grey(-1), grey(1), 1, wall);
    add_box(&scene, metro_vec3_make(-0.7, -0.9, -0.6), metro_vec3_make(-0.2, 0.1, -0.1), 0, side);
    add_box(&scene, metro_vec3_make(0.1, -0.95, -0.5), metro_vec3_make(0.6, -0.5, 0), 0, side);
    add_quad(&scene, metro_vec3_make(-0.4, 0.95, -0.4), metro_vec3_make(0.8, 0, 0), metro_vec3_make(0, 0, 0.8), lamp);
    build(&scene);
    return scene;
}

/* In the limit of small patches a picture by bundles is that of paths. The patches are a tenth of the room: what they
   leave of the discretisation is allowed for by 2 per cent. Planted: emission sent in the last step too, or twice the
   glossy lobe. */
static void bidirectional_paths(void)
{
    int g, shot;
    for (g = 0; g < 2; g++) {
        metro_scene scene = room_scene(g ? 0.5 : 0);
        metro_camera camera = inside_camera();
        metro_render_options paths = options_make(METRO_BDPT, 32, 6);
        metro_render render;
        metro_image picture;
        metro_render_report seen;
        paths.shortest = 2;
        render = render_run(&scene, &camera, &paths, check_count(32, 8));
        metro_render_diagnose(&render, &seen);
        metro_render_free(&render);
        paths.shortest = 1;
        render = render_run(&scene, &camera, &paths, check_count(16, 8));
        picture = render_image(&render);
        for (shot = 0; shot < 2; shot++) {
            metro_bundles_options options = bundles_options(6, 0.2, shot ? 40 : 60);
            metro_bundles bundles;
            metro_bundles_report report;
            metro_image image;
            metro_image_difference difference;
            double error, lamp;
            options.first_shot = shot;
            options.batches = 32;
            options.visibility = METRO_LINES;
            bundles = bundles_run(&scene, &camera, &options, check_count(shot ? 512 : 384, 64));
            report = report_of(&bundles);
            memset(&image, 0, sizeof image);
            CHECK(metro_bundles_image(&bundles, &image) == METRO_OK, "image");
            metro_image_error(&image, &picture, &difference);
            error = sqrt(report.mean_error * report.mean_error + seen.mean_error * seen.mean_error);
            lamp = lamps_seen(&bundles);
            CHECK(fabs(report.mean - lamp - seen.mean) < 0.02 * seen.mean + student_bound(31) * error,
                  "%g, paths %g +- %g", report.mean - lamp, seen.mean, error);
            CHECK_CLOSE(lamp, difference.mean_reference - seen.mean, 0.06 * lamp);
            CHECK_NEAR(report.mean, difference.mean, 1e-9);
            if (shot)
                CHECK(report.mean_error < (check_scale() < 0.5 ? 0.2 : 0.03) * seen.mean, "error %g of %g",
                      report.mean_error, seen.mean);
            if (shot) CHECK(difference.relative_rmse < 0.25, "the picture is off by %g", difference.relative_rmse);
            metro_image_free(&image);
            metro_bundles_free(&bundles);
        }
        metro_image_free(&picture);
        metro_render_free(&render);
        metro_scene_free(&scene);
    }
}

/* Every walk has the same answer: random, even, by chains from all three starts, with one direction perturbed, with
   large steps, after a first shot. Planted: without Veach's weight the third is off. */
static void walks_agree(void)
{
    metro_scene scene = room_scene(0.3);
    metro_camera camera = inside_camera();
    metro_bundles_options options = bundles_options(4, 0.7, 40);
    metro_bundles reference, other;
    metro_bundles_report report;
    uint64_t walks = check_count(1280, 480);
    options.visibility = METRO_LINES;
    options.batches = 32;
    reference = bundles_run(&scene, &camera, &options, 2 * walks);
    CHECK(isnan(report_of(&reference).b), "random walks have no b");
    options.seed = 1;
    options.visibility = METRO_SWEEP;
    other = bundles_run(&scene, &camera, &options, walks);
    agree("sweep", &reference, &other);
    metro_bundles_free(&other);
    options.visibility = METRO_LINES;
    options.walk = METRO_WALK_EVEN;
    other = bundles_run(&scene, &camera, &options, walks);
    agree("even", &reference, &other);
    metro_bundles_free(&other);
    options.first_shot = 1;
    other = bundles_run(&scene, &camera, &options, walks / 4);
    agree("first shot", &reference, &other);
    CHECK(report_of(&other).mean_error < report_of(&reference).mean_error, "a first shot has the error %g, not %g",
          report_of(&other).mean_error, report_of(&reference).mean_error);
    metro_bundles_free(&other);
    options.first_shot = 0;
    options.walk = METRO_WALK_METROPOLIS;
    options.perturbation = 2;
    other = bundles_run(&scene, &camera, &options, walks);
    agree("metropolis", &reference, &other);
    report = report_of(&other);
    CHECK_SIGMA(report.b, report_of(&reference).mean - lamps_seen(&reference),
                hypot(report.b_error, report_of(&reference).mean_error));
    CHECK(report.acceptance > 0.1 && report.acceptance < 0.9, "acceptance %g", report.acceptance);
    CHECK(report.squared_jump > 0 && report.dark >= 0 && report.longest_stay > 0, "the counts of the chains");
    metro_bundles_free(&other);
    options.one_direction = 1;
    options.large_step = 0.2;
    options.start = METRO_START_POINT;
    other = bundles_run(&scene, &camera, &options, walks);
    agree("one direction, large steps, from a point", &reference, &other);
    metro_bundles_free(&other);
    options.first_shot = 1;
    options.start = METRO_START_SEEDS;
    other = bundles_run(&scene, &camera, &options, walks / 2);
    agree("metropolis after a first shot", &reference, &other);
    metro_bundles_free(&other);
    options.linear = 1;
    options.large_step = 0;
    options.one_direction = 0;
    other = bundles_run(&scene, &camera, &options, walks / 2);
    agree("linear", &reference, &other);
    metro_bundles_free(&other);
    metro_bundles_free(&reference);
    metro_scene_free(&scene);
}

/* Veach's weights leave no bias, however short the chains: 2048 chains of two steps, from one candidate each. Their
   plain counterpart, chosen from two candidates and scaled by b, is not asked. */
static void weighted_start(void)
{
    metro_scene scene = room_scene(0.3);
    metro_camera camera = inside_camera();
    metro_bundles_options options = bundles_options(3, 1, 20);
    metro_bundles reference, weighted;
    options.visibility = METRO_LINES;
    options.batches = 64;
    options.width = options.height = 8;
    reference = bundles_run(&scene, &camera, &options, check_count(6400, 3200));
    options.walk = METRO_WALK_METROPOLIS;
    options.start = METRO_START_WEIGHTED;
    options.candidates = 2;
    options.perturbation = 0.4;
    options.batches = (size_t)check_count(1600, 600);
    weighted = bundles_run(&scene, &camera, &options, 2 * options.batches);
    agree("weighted", &reference, &weighted);
    metro_bundles_free(&weighted);
    metro_bundles_free(&reference);
    metro_scene_free(&scene);
}

/* Radiance that is linear over the patches: the same light (to the discretisation, which the means hardly see), and
   fewer patches for the same picture. Planted: corners of the patches turned about taken for those of the others. */
static void linear_radiance(void)
{
    metro_scene scene = room_scene(0), furnace_ = furnace_scene(0.8, 1);
    metro_camera camera = camera_make(metro_vec3_make(0.1, 0.7, 0.9), metro_vec3_make(0, -1, -0.6), 60);
    metro_render_options paths = options_make(METRO_BDPT, 32, 3);
    metro_render render;
    metro_image picture, image;
    double error[2];
    int v, linear;
    for (v = 0; v < 4; v++) {
        metro_bundles_options options = bundles_options(3, v < 2 ? 2 : 0.5, v < 2 ? 3 : 16);
        metro_bundles bundles;
        metro_bundles_report report;
        options.linear = 1;
        options.visibility = v % 2 ? METRO_LINES : METRO_SWEEP;
        options.batches = 64;
        bundles = bundles_run(&furnace_, &camera, &options, check_count(3200, 1280));
        report = report_of(&bundles);
        CHECK_SIGMA(report.mean, furnace_radiance(0.8, 1, 1, 3), report.mean_error);
        metro_bundles_free(&bundles);
    }
    render = render_run(&scene, &camera, &paths, check_count(64, 24));
    picture = render_image(&render);
    for (linear = 0; linear < 2; linear++) {
        metro_bundles_options options = bundles_options(3, 0.7, 40);
        metro_bundles bundles;
        metro_vec3 *radiance;
        double sum = 0, all = 0;
        size_t i;
        options.linear = linear;
        options.visibility = METRO_LINES;
        options.first_shot = 1;
        bundles = bundles_run(&scene, &camera, &options, check_count(640, 320));
        memset(&image, 0, sizeof image);
        CHECK(metro_bundles_image(&bundles, &image) == METRO_OK, "image");
        for (i = 0; i < 32 * 32; i++) {
            double y = image_luminance(&image, i), truth = image_luminance(&picture, i);
            sum += (y - truth) * (y - truth);
            all += truth * truth;
        }
        error[linear] = sqrt(sum / all);
        radiance = radiance_of(&bundles, NULL);
        for (i = 0, sum = 0; i < bundles.patches.count; i++)
            sum += bundles.share[i] * metro_luminance(radiance[i].x, radiance[i].y, radiance[i].z);
        CHECK_NEAR(sum, report_of(&bundles).mean, 1e-9);
        free(radiance);
        metro_image_free(&image);
        metro_bundles_free(&bundles);
    }
    CHECK(error[1] < (check_scale() < 0.5 ? 0.9 : 0.7) * error[0], "constant %g, linear %g", error[0], error[1]);
    metro_image_free(&picture);
    metro_render_free(&render);
    metro_scene_free(&scene);
    metro_scene_free(&furnace_);
}

/* Between two squares straight above each other a linear radiance arrives as it was sent: eqs 14.5 and 14.6. Planted:
   without the slopes, or with lumped masses, it arrives flattened. */
static void linear_is_carried(void)
{
    metro_scene scene = empty_scene();
    metro_patches patches;
    metroi_bundle bundle;
    const double shift[2] = { 0.3, 0.6 };
    int v, c;
    size_t i, k;
    add_quad(&scene, grey(0), metro_vec3_make(0, 0, 1), metro_vec3_make(1, 0, 0), 0);
    add_quad(&scene, metro_vec3_make(0, 0.7, 0), metro_vec3_make(1, 0, 0), metro_vec3_make(0, 0, 1), 0);
    build(&scene);
    patches = patches_make(&scene, 0.4);
    for (v = 0; v < 2; v++) {
        metro_result result = metroi_bundle_make(&patches, 8001, v ? METRO_LINES : METRO_SWEEP, 1, &bundle);
        double cell, worst = 0;
        CHECK(result == METRO_OK, "%s", metro_result_text(result));
        for (i = 0; i < patches.count; i++)
            for (k = 0; k < 3; k++)
                for (c = 0; c < 3; c++) {
                    metro_vec3 p = patches.patch[i].corner[k];
                    bundle.radiance[4 * (3 * i + k) + (size_t)c] = 1 + 2 * p.x - 3 * p.z * c;
                }
        metroi_bundle_move(&bundle, metro_vec3_make(0, 1, 0), shift);
        cell = metroi_bundle_cell(&bundle);
        for (i = 0; i < patches.count; i++)
            for (k = 0; k < 3; k++)
                for (c = 0; c < 3; c++) {
                    metro_vec3 p = patches.patch[i].corner[k];
                    double got = metroi_patch_received(&bundle, i, k, (size_t)c) * cell / patches.patch[i].area;
                    double off = fabs(got - (1 + 2 * p.x - 3 * p.z * c));
                    if (off > worst) worst = off;
                }
        CHECK(worst < 0.05, "visibility %d: a corner is off by %g", v, worst);
        metroi_bundle_free(&bundle);
    }
    metro_patches_free(&patches);
    metro_scene_free(&scene);
}

/* Trap 44: a sequence that runs on gets more certain of a wrong answer. */
static void run_on(void)
{
    metro_scene scene = room_scene(0);
    metro_camera camera = inside_camera();
    metro_bundles_options options = bundles_options(6, 0.7, 40);
    metro_bundles right, wrong;
    metro_bundles_report a, b;
    options.visibility = METRO_LINES;
    options.batches = 32;
    right = bundles_run(&scene, &camera, &options, check_count(1800, 900));
    options.walk = METRO_WALK_EVEN;
    options.run_on = 1;
    wrong = bundles_run(&scene, &camera, &options, check_count(1800, 900));
    a = report_of(&right);
    b = report_of(&wrong);
    CHECK(fabs(a.mean - b.mean) > 6 * hypot(a.mean_error, b.mean_error), "%g +- %g, and running on %g +- %g", a.mean,
          a.mean_error, b.mean, b.mean_error);
    metro_bundles_free(&right);
    metro_bundles_free(&wrong);
    metro_scene_free(&scene);
}

/* Trap 47: a lamp of a twentieth of a cell. Of the open scene's light only what the floor reflects counts: a small
   lamp above a floor, one reflection. A first shot sees it in each walk. */
static void narrow_lamp(void)
{
    metro_scene scene = empty_scene();
    uint32_t floor_ = add_material(&scene, grey(0.8), grey(0), 0, grey(0));
    uint32_t lamp = add_material(&scene, grey(0), grey(0), 0, grey(1000));
    metro_camera camera = camera_make(metro_vec3_make(0, 3, 0.01), metro_vec3_make(0, 0, 0), 36);
    metro_bundles_options options = bundles_options(2, 0.5, 6);
    metro_bundles exact, lines, grid;
    camera.up = metro_vec3_make(0, 0, -1);
    add_quad(&scene, metro_vec3_make(-1, 0, -1), metro_vec3_make(0, 0, 2), metro_vec3_make(2, 0, 0), floor_);
    add_quad(&scene, metro_vec3_make(0.3, 1, 0.3), metro_vec3_make(0.03, 0, 0), metro_vec3_make(0, 0, 0.03), lamp);
    build(&scene);
    options.first_shot = 1;
    exact = bundles_run(&scene, &camera, &options, check_count(3200, 800));
    CHECK(exact.bundles == 0 && exact.rays > 0, "one reflection after a first shot takes no bundle");
    options.first_shot = 0;
    options.batches = 64;
    options.visibility = METRO_LINES;
    lines = bundles_run(&scene, &camera, &options, check_count(60000, 30000));
    agree("lines", &exact, &lines);
    options.visibility = METRO_SWEEP;
    grid = bundles_run(&scene, &camera, &options, check_count(400000, 200000));
    agree("grid", &exact, &grid);
    CHECK(report_of(&grid).mean_error > 0, "no lamp was met");
    metro_bundles_free(&exact);
    metro_bundles_free(&lines);
    metro_bundles_free(&grid);
    metro_scene_free(&scene);
}

/* ---- what a program needs ---- */

static int never_stop(const metro_bundles *bundles, void *user)
{
    (void)bundles;
    ++*(int *)user;
    return 0;
}

/* One, two and three threads, in one call or in several, asked whether to stop or not, give the same bits. */
static void threads(void)
{
    metro_scene scene = room_scene(0.3);
    metro_camera camera = inside_camera();
    int walk, shot, t, asked = 0;
    for (walk = 0; walk < 3; walk++)
        for (shot = 0; shot < 2; shot++) {
            metro_vec3 *first = NULL;
            metro_image image[3];
            size_t size = 0;
            for (t = 0; t < 3; t++) {
                metro_bundles_options options = bundles_options(4, 0.7, 30);
                metro_bundles bundles;
                metro_vec3 *radiance;
                options.walk = (metro_walk)walk;
                options.first_shot = shot;
                options.linear = shot && walk == 0;
                options.threads = (size_t)t + 1;
                bundles = bundles_run(&scene, &camera, &options, t == 1 ? 17 : 64);
                if (t == 1) metro_bundles_run(&bundles, 32, never_stop, &asked);
                CHECK(bundles.walks == 64, "%g walks", (double)bundles.walks);
                radiance = radiance_of(&bundles, NULL);
                size = bundles.patches.count * sizeof *radiance;
                memset(&image[t], 0, sizeof image[t]);
                CHECK(metro_bundles_image(&bundles, &image[t]) == METRO_OK, "image");
                if (t == 0) first = radiance;
                else {
                    CHECK(memcmp(first, radiance, size) == 0, "walk %d: %d threads give other bits", walk, t + 1);
                    CHECK(image_same(&image[0], &image[t]), "walk %d: %d threads give another picture", walk, t + 1);
                    free(radiance);
                }
                metro_bundles_free(&bundles);
            }
            for (t = 0; t < 3; t++) metro_image_free(&image[t]);
            free(first);
        }
    CHECK(asked == 12, "asked %d times", asked);
    metro_scene_free(&scene);
}

/* Shares of a run are independent, and seeds and parts matter. */
static void parts(void)
{
    metro_scene scene = room_scene(0);
    metro_camera camera = inside_camera();
    metro_bundles_options options = bundles_options(3, 0.7, 20);
    double mean[3];
    int k;
    for (k = 0; k < 3; k++) {
        metro_bundles bundles;
        options.seed = k == 1;
        options.part = k == 2;
        bundles = bundles_run(&scene, &camera, &options, 32);
        mean[k] = report_of(&bundles).mean;
        metro_bundles_free(&bundles);
    }
    CHECK(mean[0] != mean[1] && mean[0] != mean[2] && mean[1] != mean[2], "%g %g %g", mean[0], mean[1], mean[2]);
    metro_scene_free(&scene);
}

static int stop_at_once(const metro_bundles *bundles, void *user)
{
    *(uint64_t *)user = bundles->walks;
    return 1;
}

static void arguments(void)
{
    metro_scene scene = room_scene(0), empty = empty_scene(), unbuilt = empty_scene();
    metro_camera camera = inside_camera(), bad = camera;
    metro_patches patches, untouched;
    metro_bundles bundles;
    metro_bundles_options options;
    metro_bundles_report report;
    metro_vec3 *colors, axis = metro_vec3_make(0, 0, 1), zero = grey(0);
    metro_image image;
    double shift[2] = { 0, 0 };
    uint64_t walks = 0;
    int k;
    memset(&patches, 7, sizeof patches);
    untouched = patches;
    CHECK(metro_patches_make(NULL, 1, &patches) == METRO_ERROR_ARGUMENT, "no scene");
    CHECK(metro_patches_make(&scene, 1, NULL) == METRO_ERROR_ARGUMENT, "no patches");
    CHECK(metro_patches_make(&scene, 0, &patches) == METRO_ERROR_ARGUMENT, "size 0");
    CHECK(metro_patches_make(&scene, -1, &patches) == METRO_ERROR_ARGUMENT, "size -1");
    CHECK(metro_patches_make(&scene, (double)NAN, &patches) == METRO_ERROR_ARGUMENT, "size NaN");
    CHECK(metro_patches_make(&scene, 1e-9, &patches) == METRO_ERROR_MEMORY, "too many");
    CHECK(memcmp(&patches, &untouched, sizeof patches) == 0, "patches are touched");
    CHECK(metro_patches_make(&empty, 1, &patches) == METRO_OK && patches.count == 0, "an empty scene");
    CHECK(metro_bundle_transfer(&patches, axis, 8, NULL, METRO_SWEEP, &axis, &axis, NULL) == METRO_OK, "nothing");
    metro_patches_free(&patches);
    patches = patches_make(&scene, 1);
    colors = colors_make(&patches, 3);
#define REFUSED(...) CHECK(metro_bundle_transfer(__VA_ARGS__) == METRO_ERROR_ARGUMENT, #__VA_ARGS__)
    REFUSED(NULL, axis, 8, shift, METRO_SWEEP, colors, colors, NULL);
    REFUSED(&patches, grey(0), 8, shift, METRO_SWEEP, colors, colors, NULL);
    REFUSED(&patches, grey((double)NAN), 8, shift, METRO_SWEEP, colors, colors, NULL);
    REFUSED(&patches, axis, 0, shift, METRO_SWEEP, colors, colors, NULL);
    REFUSED(&patches, axis, 16385, shift, METRO_SWEEP, colors, colors, NULL);
    REFUSED(&patches, axis, 8, shift, (metro_visibility)4, colors, colors, NULL);
    REFUSED(&patches, axis, 8, shift, METRO_SWEEP, NULL, colors, NULL);
    REFUSED(&patches, axis, 8, shift, METRO_SWEEP, colors, NULL, NULL);
    shift[1] = 1;
    REFUSED(&patches, axis, 8, shift, METRO_SWEEP, colors, colors, NULL);
    shift[1] = (double)NAN;
    REFUSED(&patches, axis, 8, shift, METRO_SWEEP, colors, colors, NULL);
#undef REFUSED
    CHECK(colors[0].x == 3, "the radiance is touched");
    free(colors);
    metro_patches_free(&patches);

    memset(&bundles, 0, sizeof bundles);
    CHECK(metro_bundles_make(NULL, &camera, NULL, &bundles) == METRO_ERROR_ARGUMENT, "no scene");
    CHECK(metro_bundles_make(&scene, NULL, NULL, &bundles) == METRO_ERROR_ARGUMENT, "no camera");
    CHECK(metro_bundles_make(&unbuilt, &camera, NULL, &bundles) == METRO_ERROR_ARGUMENT, "not built");
    bad.fov = 0;
    CHECK(metro_bundles_make(&scene, &bad, NULL, &bundles) == METRO_ERROR_ARGUMENT, "no camera");
    for (k = 0; k < 15; k++) {
        options = bundles_options(4, 1, 8);
        if (k == 0) options.depth = 1;
        if (k == 1) options.depth = METRO_DEPTH_MOST + 1;
        if (k == 2) options.patch = -1;
        if (k == 3) options.patch = (double)NAN;
        if (k == 4) options.grid = 16385;
        if (k == 5) options.visibility = (metro_visibility)4;
        if (k == 6) options.walk = (metro_walk)3;
        if (k == 7) options.start = (metro_start)3;
        if (k == 8) options.batches = 1;
        if (k == 9) options.batches = 4097;
        if (k == 10) options.large_step = 1.5;
        if (k == 11) options.perturbation = -1;
        if (k == 12) options.width = SIZE_MAX / 2;
        if (k == 13) options.perturbation = HUGE_VAL;
        if (k == 14) {
            options.linear = 1;
            options.visibility = METRO_FRAGMENTS;
        }
        CHECK(metro_bundles_make(&scene, &camera, &options, &bundles) == METRO_ERROR_ARGUMENT, "option %d", k);
    }
    add_quad(&unbuilt, grey(0), metro_vec3_make(1, 0, 0), metro_vec3_make(0, 1, 0), 0);
    build(&unbuilt);
    CHECK(metro_bundles_make(&unbuilt, &camera, NULL, &bundles) == METRO_ERROR_NO_LIGHT, "no lamp");
    CHECK(bundles.state == NULL && bundles.share == NULL, "bundles are touched");
    CHECK(metro_bundles_run(&bundles, 1, NULL, NULL) == METRO_ERROR_ARGUMENT, "run what was not made");
    CHECK(metro_bundles_make(&scene, &camera, NULL, NULL) == METRO_ERROR_ARGUMENT, "make NULL");
    CHECK(metro_bundles_run(NULL, 1, NULL, NULL) == METRO_ERROR_ARGUMENT, "run NULL");
    CHECK(metro_bundles_image(NULL, &image) == METRO_ERROR_ARGUMENT, "the image of NULL");
    CHECK(metro_bundles_radiance(NULL, &zero, NULL) == METRO_ERROR_ARGUMENT, "the radiance of NULL");
    memset(&patches, 0, sizeof patches);
    CHECK(metro_bundle_transfer(&patches, grey(1), 8, NULL, METRO_SWEEP, &zero, &zero, NULL) == METRO_ERROR_ARGUMENT,
          "patches that were not made");
    CHECK(metro_bundles_image(&bundles, &image) == METRO_ERROR_ARGUMENT, "no image");
    metro_bundles_diagnose(&bundles, &report);
    CHECK_NAN(report.mean);
    options = bundles_options(METRO_DEPTH_MOST, 1, 8);
    options.walk = METRO_WALK_EVEN; /* more directions than the sequence has coordinates for */
    CHECK(metro_bundles_make(&scene, &camera, &options, &bundles) == METRO_OK, "the most depth");
    CHECK(metro_bundles_image(&bundles, &image) == METRO_ERROR_ARGUMENT, "no walk yet");
    CHECK(metro_bundles_run(&bundles, 0, NULL, NULL) == METRO_OK && bundles.walks == 0, "no walks");
    CHECK(metro_bundles_run(&bundles, 1000, stop_at_once, &walks) == METRO_ERROR_STOPPED, "stopped");
    CHECK(walks == 16 && bundles.walks == 16, "stopped after %g walks", (double)walks);
    metro_bundles_diagnose(&bundles, &report);
    CHECK(report.mean > 0, "mean %g", report.mean);
    metro_bundles_free(&bundles);
    metro_bundles_free(&bundles);
    metro_scene_free(&scene);
    metro_scene_free(&unbuilt);
}

/* A lamp that shines away from everything: chains have nowhere to start, walks are dark. */
static void dark(void)
{
    metro_scene scene = empty_scene();
    uint32_t lamp = add_material(&scene, grey(0), grey(0), 0, grey(1));
    metro_camera camera = camera_make(metro_vec3_make(0, 1, 3), metro_vec3_make(0, 0, 0), 40);
    metro_bundles_options options = bundles_options(3, 1, 8);
    metro_bundles bundles;
    int start;
    add_quad(&scene, grey(0), metro_vec3_make(0, 0, 1), metro_vec3_make(1, 0, 0), 0);
    add_quad(&scene, metro_vec3_make(0, 1, 0), metro_vec3_make(0, 0, 1), metro_vec3_make(1, 0, 0), lamp);
    build(&scene);
    bundles = bundles_run(&scene, &camera, &options, 16);
    CHECK(report_of(&bundles).mean == 0, "mean %g", report_of(&bundles).mean);
    metro_bundles_free(&bundles);
    options.walk = METRO_WALK_METROPOLIS;
    for (start = 0; start < 3; start++) {
        options.start = (metro_start)start;
        CHECK(metro_bundles_make(&scene, &camera, &options, &bundles) == METRO_OK, "make");
        CHECK(metro_bundles_run(&bundles, 16, NULL, NULL) == METRO_ERROR_NO_IMPORTANCE, "start %d", start);
        CHECK(metro_bundles_run(&bundles, 16, NULL, NULL) == METRO_ERROR_NO_IMPORTANCE, "and again");
        CHECK(bundles.walks == 0 && isnan(report_of(&bundles).mean), "nothing is there");
        metro_bundles_free(&bundles);
    }
    metro_scene_free(&scene);
}

/* Every allocation fails once: the result says so, nothing is touched and nothing is kept. */
static void failing_memory(void)
{
    metro_scene scene = room_scene(0.2);
    metro_camera camera = inside_camera();
    metro_patches patches, plain;
    metro_vec3 *colors;
    metro_result result = METRO_ERROR_MEMORY;
    long live = allocations_live, k;
    int v, walk;
    memset(&patches, 7, sizeof patches);
    plain = patches;
    for (k = 0; result != METRO_OK && k < 100; k++) {
        allocations_left = k;
        result = metro_patches_make(&scene, 0.9, &patches);
        allocations_left = -1;
        CHECK(result == METRO_OK || result == METRO_ERROR_MEMORY, "%s", metro_result_text(result));
        if (result == METRO_OK) break;
        CHECK(allocations_live == live && memcmp(&patches, &plain, sizeof patches) == 0, "allocation %ld", k);
    }
    CHECK(k == 3, "%ld allocations", k);
    live = allocations_live;
    colors = colors_make(&patches, 5);
    for (v = 0; v < 4; v++) {
        result = METRO_ERROR_MEMORY;
        for (k = 0; result != METRO_OK && k < 100; k++) {
            allocations_left = k;
            result = metro_bundle_transfer(&patches, grey(1), 8, NULL, (metro_visibility)v, colors, colors, NULL);
            allocations_left = -1;
            if (result == METRO_OK) continue;
            CHECK(allocations_live == live && colors[0].x == 5, "allocation %ld", k);
        }
        CHECK(k > 3 && allocations_live == live, "%ld allocations", k);
        colors[0].x = 5;
    }
    free(colors);
    metro_patches_free(&patches);
    live = allocations_live;
    for (walk = 0; walk < 3; walk++) {
        metro_bundles_options options = bundles_options(3, 0.9, 8);
        metro_bundles bundles, untouched;
        metro_image image;
        options.walk = (metro_walk)walk;
        options.first_shot = 1;
        options.linear = walk == 1;
        options.batches = 3;
        memset(&bundles, 7, sizeof bundles);
        untouched = bundles;
        result = METRO_ERROR_MEMORY;
        for (k = 0; result != METRO_OK && k < 1000; k++) {
            allocations_left = k;
            result = metro_bundles_make(&scene, &camera, &options, &bundles);
            allocations_left = -1;
            if (result == METRO_OK) continue;
            CHECK(result == METRO_ERROR_MEMORY, "%s", metro_result_text(result));
            CHECK(allocations_live == live && memcmp(&bundles, &untouched, sizeof bundles) == 0, "allocation %ld", k);
        }
        CHECK(k > 20, "%ld allocations", k);
        result = METRO_ERROR_MEMORY;
        for (k = 0; result != METRO_OK && k < 100; k++) {
            allocations_left = k;
            result = metro_bundles_run(&bundles, 3, NULL, NULL);
            allocations_left = -1;
            CHECK(bundles.walks == (result == METRO_OK ? 3u : 0u), "%g walks", (double)bundles.walks);
        }
        CHECK(k > 1, "%ld allocations", k);
        memset(&image, 7, sizeof image);
        result = METRO_ERROR_MEMORY;
        for (k = 0; result != METRO_OK && k < 100; k++) {
            long before = allocations_live;
            allocations_left = k;
            result = metro_bundles_image(&bundles, &image);
            allocations_left = -1;
            if (result != METRO_OK) CHECK(allocations_live == before, "allocation %ld", k);
        }
        CHECK(k > 2, "%ld allocations", k);
        metro_image_free(&image);
        metro_bundles_free(&bundles);
        CHECK(allocations_live == live, "%ld allocations are left", allocations_live - live);
    }
    metro_scene_free(&scene);
}

/* A square lamp that faces the eye covers a known part of the film, and its edges run along the pixels. Catches: rays
   through a pixel in too few rows and columns. */
static void edges_along_pixels(void)
{
    double squares = 0;
    int i;
    for (i = 0; i < 20; i++) {
        double half = 0.5 + 0.037 * i, side = half / (4 * tan(20 * CHECK_PI / 180)), covered = 0, off;
        metro_scene scene = empty_scene();
        metro_camera camera = camera_make(metro_vec3_make(0, 0, 4), metro_vec3_make(0, 0, 0), 40);
        metro_bundles_options options;
        metro_bundles bundles;
        size_t k;
        memset(&options, 0, sizeof options);
        options.width = options.height = 16;
        options.seed = (uint64_t)i;
        add_quad(&scene, metro_vec3_make(-half, -half, 0), metro_vec3_make(2 * half, 0, 0),
                 metro_vec3_make(0, 2 * half, 0), add_material(&scene, grey(0), grey(0), 0, grey(1)));
        build(&scene);
        CHECK(metro_bundles_make(&scene, &camera, &options, &bundles) == METRO_OK, "make");
        for (k = 0; k < bundles.patches.count; k++) covered += bundles.share[k];
        off = covered / (side * side) - 1;
        squares += off * off / 20;
        metro_bundles_free(&bundles);
        metro_scene_free(&scene);
    }
    CHECK(sqrt(squares) < 0.004, "the lamp covers its part of the film to %g only", sqrt(squares));
}

int main(void)
{
    CHECK_RUN(patches_cover);
    CHECK_RUN(cube_form_factors);
    CHECK_RUN(patches_smaller_than_a_cell);
    CHECK_RUN(parallel_plates);
    CHECK_RUN(energy_balance);
    CHECK_RUN(visibilities_agree);
    CHECK_RUN(special_directions);
    CHECK_RUN(touching_patches);
    CHECK_RUN(furnace);
    CHECK_RUN(sphere);
    CHECK_RUN(bidirectional_paths);
    CHECK_RUN(walks_agree);
    CHECK_RUN(weighted_start);
    CHECK_RUN(linear_is_carried);
    CHECK_RUN(linear_radiance);
    CHECK_RUN(run_on);
    CHECK_RUN(narrow_lamp);
    CHECK_RUN(threads);
    CHECK_RUN(parts);
    CHECK_RUN(arguments);
    CHECK_RUN(dark);
    CHECK_RUN(failing_memory);
    CHECK_RUN(edges_along_pixels);
    return check_done("bundles");
}
