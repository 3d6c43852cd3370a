/* test_geometry.c - chapter 9: triangles, materials, lamps, and scenes from OBJ and MTL.

   Small files are written out here as strings, some of them as the programs write them whose names they bear.
   Polygons are judged by area, orientation and by points that must be covered exactly once. The counter of
   memory shows what a file costs, and that nothing leaks. */

#ifndef _XOPEN_SOURCE
#define _XOPEN_SOURCE 700 /* mkdtemp, mkfifo, mkdir, realpath */
#endif
#include "memory.h"

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include <locale.h>
#ifndef _WIN32
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>
#endif

/* ---- small helpers ---- */

static char told[1000]; /* the message of the last call */

static metro_scene nothing(void)
{
    metro_scene scene;
    memset(&scene, 0, sizeof scene);
    return scene;
}

static metro_result parse(metro_scene *scene, const char *obj, const char *mtl)
{
    memset(told, '?', sizeof told);
    return metro_scene_parse_obj(scene, (const unsigned char *)obj, strlen(obj), (const unsigned char *)mtl,
                                 mtl != NULL ? strlen(mtl) : 0, told, sizeof told);
}

static int same_vec3(metro_vec3 a, double x, double y, double z)
{
    return a.x == x && a.y == y && a.z == z;
}

#define CHECK_VEC3(vector, px, py, pz)                                                                               \
    do {                                                                                                             \
        metro_vec3 seen = (vector);                                                                                  \
        CHECK(same_vec3(seen, px, py, pz), "%s is (%.9g, %.9g, %.9g)", #vector, seen.x, seen.y, seen.z);             \
    } while (0)

#define CHECK_TOLD(text) CHECK(strcmp(told, text) == 0, "the message is \"%s\"\n    not \"%s\"", told, text)

/* A file that must load without a word, with so many triangles and materials. */
static metro_scene good(const char *obj, const char *mtl, size_t triangles, size_t materials)
{
    metro_scene scene = nothing();
    metro_result result = parse(&scene, obj, mtl);
    CHECK(result == METRO_OK, "%.40s: %s (%s)", obj, metro_result_text(result), told);
    CHECK(result != METRO_OK || told[0] == 0, "%.40s: unexpected message %s", obj, told);
    CHECK(scene.triangle_count == triangles && scene.material_count == materials,
          "%.40s: %d triangles and %d materials", obj, (int)scene.triangle_count, (int)scene.material_count);
    return scene;
}

/* A file that loads with exactly this warning. */
static metro_scene warned(const char *obj, const char *mtl, const char *text)
{
    metro_scene scene = nothing();
    metro_result result = parse(&scene, obj, mtl);
    CHECK(result == METRO_OK, "%.40s: %s (%s)", obj, metro_result_text(result), told);
    CHECK_TOLD(text);
    return scene;
}

/* A file that must be refused with this message, and leave no trace, neither in an empty scene nor in a full one. */
static void refused(const char *obj, const char *mtl, const char *text)
{
    metro_scene scene = nothing(), before;
    metro_vec3 corner[3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
    long living = allocations_live;
    static const metro_scene empty = { 0, 0, 0, 0, 0, 0, 0, { { 0, 0, 0 }, { 0, 0, 0 }, { 0, 0, 0 }, 0 },
                                       0, 0, 0, 0, 0, 0 };
    metro_result result = parse(&scene, obj, mtl);
    CHECK(result == METRO_ERROR_FORMAT, "%.40s: %s", obj, metro_result_text(result));
    CHECK_TOLD(text);
    CHECK(memcmp(&scene, &empty, sizeof scene) == 0, "%.40s: the empty scene has changed", obj);
    CHECK(allocations_live == living, "%.40s: %ld blocks left", obj, allocations_live - living);
    metro_scene_add_triangle(&scene, corner, 0);
    before = scene;
    CHECK(parse(&scene, obj, mtl) == METRO_ERROR_FORMAT, "refused once only");
    CHECK(scene.triangle_count == 1 && scene.material_count == 0 && !scene.has_camera
              && scene.triangle_room == before.triangle_room,
          "%.40s: the full scene has changed", obj);
    CHECK_VEC3(metro_scene_corner(&scene, 0, 1), 1, 0, 0);
    metro_scene_free(&scene);
    CHECK(allocations_live == living, "%.40s: %ld blocks left", obj, allocations_live - living);
}

/* ---- scenes in code ---- */

/* Catches: Kd + Ks above 1 or NaN let in, a slack that is missing or too wide, a number off by one. */
static void materials(void)
{
    metro_scene scene = nothing();
    static const metro_material fine = { { 0.7, 0.25, 0 }, { 0.3, 0.75, 1 }, 20, { 0, 5, 1e6 } };
    const metro_material *seen;
    uint32_t index = 77, k;
    CHECK(metro_scene_add_material(&scene, &fine, &index) == METRO_OK && index == 1, "index %d", (int)index);
    CHECK(metro_scene_add_material(&scene, &fine, &index) == METRO_OK && index == 2, "index %d", (int)index);
    seen = metro_scene_material(&scene, 0);
    CHECK(seen != NULL && same_vec3(seen->kd, 0.5, 0.5, 0.5) && same_vec3(seen->ks, 0, 0, 0)
              && same_vec3(seen->ke, 0, 0, 0) && seen->ns == 0,
          "material 0");
    seen = metro_scene_material(&scene, 2);
    CHECK(seen != NULL && memcmp(seen, &fine, sizeof fine) == 0, "material 2");
    CHECK(metro_scene_material(&scene, 3) == NULL && metro_scene_material(NULL, 0) == NULL, "a material of nobody");
    index = 77;
    for (k = 0; k < 10; k++) { /* each number of the ten made negative, NaN, infinite */
        static const double bad[3] = { -1e-300, (double)NAN, (double)INFINITY };
        int b;
        for (b = 0; b < 3; b++) {
            double part[10];
            metro_material material;
            memset(&material, 0, sizeof material);
            memcpy(part, &fine, sizeof part);
            part[k] = bad[b];
            memcpy(&material, part, sizeof material);
            CHECK(metro_scene_add_material(&scene, &material, &index) == METRO_ERROR_ARGUMENT,
                  "number %d as %g was let in", (int)k, bad[b]);
        }
    }
    for (k = 0; k < 3; k++) {
        metro_material material = fine;
        double *kd = k == 0 ? &material.kd.x : k == 1 ? &material.kd.y : &material.kd.z;
        *kd += 2e-9;
        CHECK(metro_scene_add_material(&scene, &material, &index) == METRO_ERROR_ARGUMENT, "too bright was let in");
        *kd -= 1.5e-9;
        CHECK(metro_scene_add_material(&scene, &material, &index) == METRO_OK, "a rounding error was refused");
        CHECK(index == 3 + k, "index %d", (int)index);
    }
    CHECK(metro_scene_add_material(NULL, &fine, &index) == METRO_ERROR_ARGUMENT
              && metro_scene_add_material(&scene, NULL, &index) == METRO_ERROR_ARGUMENT
              && metro_scene_add_material(&scene, &fine, NULL) == METRO_ERROR_ARGUMENT,
          "a NULL was let in");
    CHECK(scene.material_count == 5 && index == 5, "a refusal changed something");
    metro_scene_free(&scene);
}

/* Catches: corners kept in double or in the wrong order, a lost number, a cast that is not defined. */
static void triangles(void)
{
    metro_scene scene = nothing();
    metro_vec3 corner[3] = { { 0.1, 1e-50, -3 }, { 1e39, -1e300, (double)NAN }, { -(double)INFINITY, 16777217, 1 } };
    size_t i;
    CHECK(metro_scene_add_triangle(&scene, corner, 0) == METRO_OK, "a triangle that is not finite keeps its number");
    CHECK_VEC3(metro_scene_corner(&scene, 0, 0), 0.100000001490116119384765625, 0, -3);
    CHECK(metro_scene_corner(&scene, 0, 1).x == (double)INFINITY && metro_scene_corner(&scene, 0, 1).y < -1e308
              && isnan(metro_scene_corner(&scene, 0, 1).z),
          "corner 1");
    CHECK(metro_scene_corner(&scene, 0, 2).x < -1e308 && metro_scene_corner(&scene, 0, 2).y == 16777216, "corner 2");
    CHECK_NAN(metro_scene_area(&scene, 0));
    CHECK_NAN(metro_scene_normal(&scene, 0).x);
    for (i = 1; i < 1000; i++) {
        corner[0] = metro_vec3_make((double)i, 0, 0);
        corner[1] = metro_vec3_make(0, (double)i, 0);
        corner[2] = metro_vec3_make(0, 0, (double)i);
        CHECK(metro_scene_add_triangle(&scene, corner, 0) == METRO_OK, "triangle %d", (int)i);
    }
    for (i = 1; i < 1000; i++) CHECK_VEC3(metro_scene_corner(&scene, (uint32_t)i, 2), 0, 0, (double)i);
    CHECK(scene.triangle_count == 1000, "%d triangles", (int)scene.triangle_count);
    CHECK(metro_scene_add_triangle(&scene, corner, 1) == METRO_ERROR_ARGUMENT, "a material that is not there");
    CHECK(metro_scene_add_triangle(NULL, corner, 0) == METRO_ERROR_ARGUMENT
              && metro_scene_add_triangle(&scene, NULL, 0) == METRO_ERROR_ARGUMENT,
          "a NULL was let in");
    CHECK_NAN(metro_scene_corner(&scene, 1000, 0).x);
    CHECK_NAN(metro_scene_corner(&scene, 0, 3).x);
    CHECK_NAN(metro_scene_corner(&scene, 0, -1).y);
    CHECK_NAN(metro_scene_corner(NULL, 0, 0).z);
    CHECK_NAN(metro_scene_area(&scene, 1000));
    CHECK_NAN(metro_scene_normal(&scene, 1000).y);
    CHECK(scene.triangle_count == 1000, "a refusal changed something");
    metro_scene_free(&scene);
}

/* Catches: additions to a scene whose tree is made already, which would be drawn nowhere. */
static void after_the_build(void)
{
    metro_scene scene = good("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", NULL, 1, 0);
    metro_vec3 corner[3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
    metro_material material;
    uint32_t index = 7;
    memset(&material, 0, sizeof material);
    CHECK(metro_scene_build(&scene) == METRO_OK, "build");
    CHECK(metro_scene_add_triangle(&scene, corner, 0) == METRO_ERROR_ARGUMENT, "a triangle after the build");
    CHECK(metro_scene_add_material(&scene, &material, &index) == METRO_ERROR_ARGUMENT && index == 7, "a material");
    CHECK(parse(&scene, "v 0 0 0\nf 1 1 1\n", NULL) == METRO_ERROR_ARGUMENT && told[0] != 0, "bytes");
    CHECK(metro_scene_load_obj(&scene, "no.obj", told, sizeof told) == METRO_ERROR_ARGUMENT, "a file");
    CHECK(scene.triangle_count == 1 && scene.material_count == 0, "a refusal changed something");
    metro_scene_free(&scene);
}

/* Catches: an area without the half, a normal that is left-handed or not of length 1, squares that overflow. */
static void normals_and_areas(void)
{
    static const double scale[] = { 1e-37, 1e-20, 1e-8, 1, 1e8, 1e19, 1e37 };
    metro_rng rng = metro_rng_make(9, 1);
    metro_scene scene = nothing();
    uint32_t count = 0;
    size_t s, i;
    for (s = 0; s < sizeof scale / sizeof *scale; s++) {
        for (i = 0; i < 50; i++) {
            /* p1 = p0 + a u, p2 = p0 + b u + c v with u, v of length 1 and square: area a c/2, normal u x v. */
            metro_vec3 u = metro_rng_direction(&rng), w = metro_rng_direction(&rng), v, normal, corner[3];
            double a = scale[s] * (0.5 + metro_rng_uniform(&rng)), b = scale[s] * metro_rng_uniform(&rng);
            double c = scale[s] * (0.5 + metro_rng_uniform(&rng));
            v = metro_normalize(metro_cross(w, u));
            normal = metro_cross(u, v);
            corner[0] = metro_vec3_make(0, 0, 0);
            corner[1] = metro_scale(u, a);
            corner[2] = metro_add(metro_scale(u, b), metro_scale(v, c));
            metro_scene_add_triangle(&scene, corner, 0);
            CHECK_NEAR(metro_scene_area(&scene, count), 0.5 * a * c, 1e-6);
            CHECK_CLOSE(metro_dot(metro_scene_normal(&scene, count), normal), 1, 1e-6);
            CHECK_CLOSE(metro_length(metro_scene_normal(&scene, count)), 1, 1e-15);
            CHECK(metroi_triangle_area(&scene, count) == metro_scene_area(&scene, count), "two areas");
            count++;
        }
    }
    {
        metro_vec3 flat[3] = { { 1, 2, 3 }, { 2, 4, 6 }, { 3, 6, 9 } };
        metro_scene_add_triangle(&scene, flat, 0);
        CHECK(metro_scene_area(&scene, count) == 0, "a line has area %g", metro_scene_area(&scene, count));
        CHECK_NAN(metro_scene_normal(&scene, count).x);
    }
    metro_scene_free(&scene);
}

/* Catches: a broken triangle in the box, a box that starts at the origin, a camera too near, too far, upside down. */
static void bounds_and_frame(void)
{
    metro_scene scene = nothing();
    metro_vec3 corner[3] = { { 5, -3, 7 }, { 6, -3, 7.5 }, { 5, -2, 9 } }, low = { 1, 1, 1 }, high = { 2, 2, 2 };
    metro_camera camera;
    double largest = 0;
    int i, k;
    memset(&camera, 0, sizeof camera);
    CHECK(metro_scene_bounds(&scene, &low, &high) == METRO_ERROR_ARGUMENT && low.x == 1 && high.z == 2,
          "no triangle");
    CHECK(metro_scene_frame(&scene, &camera) == METRO_ERROR_ARGUMENT && camera.fov == 0, "no triangle");
    metro_scene_add_triangle(&scene, corner, 0);
    corner[1].x = (double)NAN;
    corner[0].y = 1e6;
    metro_scene_add_triangle(&scene, corner, 0);
    corner[1].x = 1e40;
    metro_scene_add_triangle(&scene, corner, 0);
    CHECK(metro_scene_bounds(&scene, &low, &high) == METRO_OK, "bounds");
    CHECK_VEC3(low, 5, -3, 7);
    CHECK_VEC3(high, 6, -2, 9);
    CHECK(metro_scene_bounds(NULL, &low, &high) == METRO_ERROR_ARGUMENT
              && metro_scene_bounds(&scene, NULL, &high) == METRO_ERROR_ARGUMENT
              && metro_scene_bounds(&scene, &low, NULL) == METRO_ERROR_ARGUMENT
              && metro_scene_frame(&scene, NULL) == METRO_ERROR_ARGUMENT,
          "a NULL was let in");
    CHECK(metro_scene_frame(&scene, &camera) == METRO_OK, "frame");
    CHECK_VEC3(camera.look, 5.5, -2.5, 8);
    CHECK_VEC3(camera.up, 0, 1, 0);
    CHECK(camera.eye.x == 5.5 && camera.eye.y == -2.5 && camera.eye.z > 9 && camera.fov == 40, "the eye");
    for (i = 0; i < 8; i++) { /* the corners of the box, as angles off the axis */
        double at[3];
        for (k = 0; k < 3; k++) at[k] = (i >> k & 1) != 0 ? (&high.x)[k] : (&low.x)[k];
        {
            double x = at[0] - camera.eye.x, y = at[1] - camera.eye.y, z = camera.eye.z - at[2];
            double angle = atan2(sqrt(x * x + y * y), z);
            if (angle > largest) largest = angle;
        }
    }
    CHECK(largest <= 20 * 3.14159265358979 / 180, "a corner of the box is %g degrees off", largest * 57.29578);
    CHECK(largest > 0.5 * 20 * 3.14159265358979 / 180, "the box fills %g degrees only", largest * 57.29578);
    metro_scene_free(&scene);
    corner[0] = corner[1] = corner[2] = metro_vec3_make(1, 1, 1);
    metro_scene_add_triangle(&scene, corner, 0);
    CHECK(metro_scene_frame(&scene, &camera) == METRO_OK && camera.eye.z > 2, "a point");
    metro_scene_free(&scene);
}

/* Catches: lamps weighed by area or by luminance alone, a last sum below 1, dark or broken triangles among them. */
static void lamps(void)
{
    metro_scene scene = nothing();
    static const metro_material red = { { 0, 0, 0 }, { 0, 0, 0 }, 0, { 3, 0, 0 } };
    static const metro_material dark = { { 1, 1, 1 }, { 0, 0, 0 }, 0, { 0, 0, 0 } };
    static const metro_material blue = { { 0, 0, 0 }, { 0, 0, 0 }, 0, { 0, 0, 1e-9 } };
    metro_vec3 corner[3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
    uint32_t number[3];
    size_t i;
    long living = allocations_live;
    double sum = 0, total = 0;
    CHECK(metroi_scene_lights(&scene) == METRO_OK && scene.light_count == 0 && scene.light == NULL, "no lamp");
    metro_scene_add_material(&scene, &red, &number[0]);
    metro_scene_add_material(&scene, &dark, &number[1]);
    metro_scene_add_material(&scene, &blue, &number[2]);
    for (i = 0; i < 100; i++) {
        corner[1].x = (double)i; /* the first has no area */
        corner[2].y = i == 50 ? (double)INFINITY : 1;
        metro_scene_add_triangle(&scene, corner, number[i % 3]);
        metro_scene_add_triangle(&scene, corner, 0);
    }
    corner[1] = metro_vec3_make((double)INFINITY, 1, 1); /* an infinite area */
    corner[2] = metro_vec3_make(1, 2, 3);
    metro_scene_add_triangle(&scene, corner, number[0]);
    corner[2] = metro_vec3_make(0, 1, 0);
    CHECK(metroi_scene_lights(&scene) == METRO_OK, "lamps");
    CHECK(scene.light_count == 33 + 32, "%d lamps", (int)scene.light_count);
    for (i = 0; i < scene.light_count; i++) {
        size_t k = scene.light[i] / 2;
        CHECK(scene.light[i] % 2 == 0 && k % 3 != 1 && k != 0 && k != 50, "lamp %d", (int)scene.light[i]);
        CHECK(i == 0 || scene.light[i] > scene.light[i - 1], "the order");
        total += 0.5 * (double)k * (k % 3 == 0 ? 3 * 0.212671 : 1e-9 * 0.072169);
    }
    CHECK_NEAR(scene.light_power, total, 1e-14);
    for (i = 0; i < scene.light_count; i++) {
        double k = (double)(scene.light[i] / 2);
        sum += 0.5 * k * ((scene.light[i] / 2) % 3 == 0 ? 3 * 0.212671 : 1e-9 * 0.072169) / total;
        CHECK_NEAR(scene.light_sum[i], sum, 1e-13);
    }
    CHECK(scene.light_sum[scene.light_count - 1] == 1.0, "the last sum is off 1");
    for (i = 1; i <= 2; i++) {
        allocations_reset((long)i - 1);
        CHECK(metroi_scene_lights(&scene) == METRO_ERROR_MEMORY, "block %d", (int)i);
        CHECK(scene.light == NULL && scene.light_sum == NULL && scene.light_count == 0, "half a list");
    }
    allocations_reset(-1);
    scene.material[0].ke.x = 1e308;
    corner[1].x = 1e20;
    corner[2].y = 1;
    metro_scene_add_triangle(&scene, corner, number[0]);
    CHECK(metroi_scene_lights(&scene) == METRO_ERROR_ARGUMENT && scene.light_count == 0, "an infinite power");
    metro_scene_free(&scene);
    CHECK(allocations_live == living, "blocks left");
}

/* ---- faces ---- */

#define SQUARE "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"

/* Catches: indices from 0, backward ones off by one, vt taken for v, numbers after the third taken for a vertex. */
static void indices(void)
{
    static const char *const same[] = {
        SQUARE "f 1 2 3\nf 1 3 4\n",
        SQUARE "f -4 -3 -2\nf -4 -2 -1\n",
        SQUARE "vt 0 0\nvt 1 1\nvn 0 0 1\nf 1/1 2/1 3/2\nf 1/2 3/1 4/1\n",
        SQUARE "vn 0 0 1\nf 1//1 2//1 3//1\nf 1//1 3//1 4//1\n",
        SQUARE "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf -4/-1/-1 -2/-1/-1 -1/-1/-1\n",
        SQUARE "f 1/ 2/ 3/\nf 1// 3// 4//\n",
        SQUARE "f 1 2 3 4\n",
        "v 0 0 0 1.0\nv 1 0 0 1\nv 1 1 0 1 0 0\nv 0 1 0 .5 .5 .5\nf 1 2 3 4\n",
        "v 0 0 0 # the origin\nv 1 0 0 #\nv 1 1 0# end\nv 0 1 0\nf 1 2 3 4 # all\n",
        "\tv\t0\t0\t0\n  v 1 0 0  \nv 1 1 0\nv 0 1 0\n f  1\t2 3  4 \n",
        "v 0 0 0\nv 1.0e0 0e5 -0\nv +1 1. .0E-3\nv 0 10e-1 0\nf 1 2 3 4",
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\nv 0 1 0\nf -4 -2 -1\n",
        "v 9 9 9\nv 9 9 9\n" SQUARE "f 3 4 5\nf -4 -2 -1\n",
    };
    size_t i;
    for (i = 0; i < sizeof same / sizeof *same; i++) {
        metro_scene scene;
        scene = good(same[i], NULL, 2, 0);
        if (scene.triangle_count == 2) {
            CHECK_VEC3(metro_scene_corner(&scene, 0, 0), 0, 0, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 0, 1), 1, 0, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 0, 2), 1, 1, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 1, 0), 0, 0, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 1, 1), 1, 1, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 1, 2), 0, 1, 0);
        } else {
            CHECK(0, "file %d", (int)i);
        }
        metro_scene_free(&scene);
    }
}

/* Catches: carriage returns in names, a last line without an end, broken lines, bytes before the first line, numbers
   of lines that are off after a broken one, a comment that swallows the line below it. */
static void lines_of_all_kinds(void)
{
    static const char *const file[] = {
        "mtllib a.mtl\nusemtl red wall\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
        "mtllib a.mtl\r\nusemtl red wall\r\nv 0 0 0\r\nv 1 0 0\r\nv 1 1 0\r\nv 0 1 0\r\nf 1 2 3 4\r\n",
        "mtllib a.mtl\rusemtl red wall\rv 0 0 0\rv 1 0 0\rv 1 1 0\rv 0 1 0\rf 1 2 3 4",
        "\xef\xbb\xbfusemtl  red wall \t\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4",
        "usemtl red wall # a # comment\nv 0 \\\n0 0\nv 1 0 \\\r\n 0\nv 1 1 0\nv\\\n0\\\n1\\\n0\nf 1 2 \\\n3 \\\n 4\n",
        "# C:\\rooms\\\nusemtl red wall\n  # C:\\\r\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n\\",
        "\n\n#\nusemtl red wall\n\t\n#v 5 5 5\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n\n\n",
        "usemtl red wall # C:\\tex\\\nv 0 0 0 # C:\\\nv 1 0 0 #C:\\\r\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
        "mtllib a.mtl\rusemtl red wall\rv 0 0 0\rv 1 \\\r0 0\rv 1 1 0\r\r\nv 0 1 0\rf 1 2 3 4\r\n",
    };
    size_t i;
    for (i = 0; i < sizeof file / sizeof *file; i++) {
        metro_scene scene = good(file[i], "newmtl red\nKd 0 0 0\nnewmtl red wall\nKd 1 0.25 0\n", 2, 1);
        CHECK(scene.material_count == 1 && scene.material[0].kd.y == 0.25, "file %d: the material", (int)i);
        if (scene.triangle_count == 2) {
            CHECK(scene.material_of[0] == 1 && scene.material_of[1] == 1, "file %d: the material", (int)i);
            CHECK_VEC3(metro_scene_corner(&scene, 1, 2), 0, 1, 0);
            CHECK_VEC3(metro_scene_corner(&scene, 1, 1), 1, 1, 0);
        }
        metro_scene_free(&scene);
    }
    refused("v 0 0 0\nv 1 \\\n 0 \\\r\n 0\n\nf 1 2 9\n", NULL,
            "obj:6: a face (f) uses the vertex 9, which is not there: 2 stand above it");
    refused("v 0 0 0\n#\\\nf 1 1 9\n", NULL,
            "obj:3: a face (f) uses the vertex 9, which is not there: 1 stands above it");
    refused("v 0 0 \\\n\n", NULL, "obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("v 0 0 0\rf 1 1 0\r", NULL, "obj:2: a face (f) uses vertex 0; the first vertex is number 1");
}

/* Catches: keywords taken by their first letters, and curves, points and lines taken for faces. */
static void what_is_skipped(void)
{
    metro_scene scene =
        good("o thing\ng a b\ns off\ns 1\nvp 0.5\nvt 0 0 0\nvn 0 0 1\nvertex\nfo\nfoo 9 9 9\nl 1 2\np 1\n"
             "cstype bezier\ncurv 0 1 1 2\nsurf 0 1 0 1 1 2\nparm u 0 1\nend\nlod 1\nusemap x\nmg 0\n"
             "Usemtl x\nF 9 9 9\n" SQUARE "f 1 2 3\n",
             NULL, 1, 0);
    metro_scene_free(&scene);
}

/* ---- what programs write ---- */

/* Catches: anything that these programs write and that would stop the reader. */
static void exporters(void)
{
    metro_scene scene;
    /* Blender 3 */
    scene = good("# Blender 3.6.5\n# www.blender.org\nmtllib untitled.mtl\no Cube\nv 1.000000 1.000000 -1.000000\n"
                 "v 1.000000 -1.000000 -1.000000\nv 1.000000 1.000000 1.000000\nv 1.000000 -1.000000 1.000000\n"
                 "vn -0.0000 1.0000 -0.0000\nvt 0.625000 0.500000\ns 0\nusemtl Material.001\n"
                 "f 1/1/1 2/1/1 3/1/1\nf 2/1/1 4/1/1 3/1/1\nl 1 2\n",
                 "# Blender 3.6.5 MTL File: 'None'\n# www.blender.org\n\nnewmtl Material.001\nNs 250.000000\n"
                 "Ka 1.000000 1.000000 1.000000\nKd 0.400000 0.300000 0.200000\nKs 0.500000 0.500000 0.500000\n"
                 "Ke 0.000000 0.000000 0.000000\nNi 1.450000\nd 1.000000\nillum 2\n",
                 2, 1);
    CHECK(scene.material_count == 1 && scene.material[0].ns == 250 && scene.material[0].kd.z == 0.2, "Blender");
    metro_scene_free(&scene);
    /* Maya */
    scene =
        good("# This file uses centimeters as units for non-parametric coordinates.\n\nmtllib plane.mtl\ng default\n"
             "v -0.500000 0.000000 0.500000\nv 0.500000 0.000000 0.500000\nv -0.500000 0.000000 -0.500000\n"
             "v 0.500000 0.000000 -0.500000\nvt 0.000000 0.000000\nvn 0.000000 1.000000 0.000000\ns off\ng pPlane1\n"
             "usemtl initialShadingGroup\nf 1/1/1 2/1/1 4/1/1 3/1/1\n",
             "newmtl initialShadingGroup\nillum 4\nKd 0.50 0.50 0.50\nKa 0.00 0.00 0.00\nTf 1.00 1.00 1.00\n"
             "Ni 1.00\n",
             2, 1);
    metro_scene_free(&scene);
    /* 3ds Max */
    scene = good(
        "# 3ds Max Wavefront OBJ Exporter v0.97b - (c)2007 guruware\r\n# File Created: 01.02.2010 10:11:12\r\n"
        "\r\nmtllib lamp.mtl\r\n\r\n#\r\n# object Plane01\r\n#\r\n\r\nv  -10.0000 0.0000 10.0000\r\n"
        "v  10.0000 0.0000 10.0000\r\nv  10.0000 0.0000 -10.0000\r\n# 3 vertices\r\n\r\nvn 0.0000 1.0000 0.0000\r\n"
        "# 1 vertex normals\r\n\r\nvt 0.0000 0.0000 0.0000\r\n# 1 texture coords\r\n\r\ng Plane01\r\n"
        "usemtl Material #25\r\ns 1\r\nf 1/1/1 2/1/1 3/1/1 \r\n# 0 polygons - 1 triangles\r\n\r\n",
        "# 3ds Max Wavefront OBJ Exporter v0.97b - (c)2007 guruware\r\n\r\nnewmtl Material #25\r\n\tNs 10.0000\r\n"
        "\tNi 1.5000\r\n\td 1.0000\r\n\tTr 0.0000\r\n\tTf 1.0000 1.0000 1.0000 \r\n\tillum 2\r\n"
        "\tKa 0.5882 0.5882 0.5882\r\n\tKd 0.5882 0.5882 0.5882\r\n\tKs 0.0000 0.0000 0.0000\r\n"
        "\tKe 12.0000 12.0000 12.0000\r\n",
        1, 1);
    CHECK(scene.material_count == 1 && scene.material[0].ke.y == 12 && scene.material[0].kd.x == 0.5882, "3ds Max");
    metro_scene_free(&scene);
    /* MeshLab: colours behind the vertices, materials without MTL */
    scene = warned(
        "####\n#\n# OBJ File Generated by Meshlab\n#\n####\n# Object bunny.obj\n#\n# Vertices: 3\n# Faces: 1\n#\n"
        "####\nmtllib ./bunny.obj.mtl\n\nvn 0.1 0.2 0.3\nv -0.037830 0.127940 0.004475 0.752941 0.752941 0.75\n"
        "vn 0.1 0.2 0.3\nv -0.044779 0.128887 0.001905 0.752941 0.752941 0.752941\nvn 0.1 0.2 0.3\n"
        "v -0.068010 0.151244 0.037195 1 1 1\n# 3 vertices, 0 vertices normals\n\n\nusemtl material_0\n"
        "f 1//1 2//2 3//3\n# 1 faces, 0 coords texture\n\n# End of File\n",
        "#\n# Wavefront material file\n# Converted by Meshlab Group\n#\n\nnewmtl material_0\n"
        "Ka 0.200000 0.200000 0.200000\nKd 1.000000 1.000000 1.000000\nKs 1.000000 1.000000 1.000000\n"
        "Tr 1.000000\nillum 2\nNs 0.000000\n\n",
        "mtl:6: material material_0 has Kd + Ks above 1, more light than it receives; Ks is taken as 1 - Kd");
    CHECK(scene.material_count == 1 && scene.material[0].ks.x == 0 && scene.material[0].kd.x == 1, "MeshLab");
    metro_scene_free(&scene);
    /* SketchUp: continued lines, names in brackets, units in a comment */
    scene = good(
        "# Alias OBJ Model File\n# Exported from SketchUp, (c) 2000-2012 Trimble Navigation Limited\n"
        "# File units = meters\n\nmtllib house.mtl\n\ng Mesh1 Model\n\nusemtl <Brick, Common>\nv 2 0 0\nvt 78 0\n"
        "vn 0 -1 -0\nv 2 0 -1\nv 1 0 -1\nv 0 0 0\nf 1/1/1 2/1/1 3/1/1 \\\n4/1/1\n",
        "## Alias OBJ Material File\nnewmtl <Brick, Common>\nKa 0.000000 0.000000 0.000000\n"
        "Kd 0.6 0.5 0.4\nKs 0.330000 0.330000 0.330000\n",
        2, 1);
    metro_scene_free(&scene);
}

/* ---- materials from MTL ---- */

#define FACE "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"

/* Catches: names that are lost when usemtl stands first, the last of two definitions, a material that is added though
   nobody uses it, numbers that stay from the material above. */
static void material_names(void)
{
    metro_scene scene =
        good("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nusemtl b\nf 1 2 3\nusemtl a\nmtllib x.mtl\nf 1 2 3\n"
             "usemtl never\nusemtl b\nf 1 2 3\nusemtl\nf 1 2 3\nusemtl a \nf 1 2 3\n",
             "Kd 9 9 9 before any material\nnewmtl unused\nKd bad\nNs\nKd 7 7 7\nd 0\nnewmtl a\nKd 0.1\n"
             "Ks 0.2 0.3 0.4\nNs 5\nKe 1 2 3\nnewmtl b\nKe 4\nnewmtl a\nKd .9 .9 .9\n",
             6, 2);
    static const uint32_t number[6] = { 0, 2, 1, 2, 0, 1 };
    int i;
    for (i = 0; i < 6 && scene.triangle_count == 6; i++)
        CHECK(scene.material_of[i] == number[i], "face %d has material %d", i, (int)scene.material_of[i]);
    if (scene.material_count == 2) {
        const metro_material *a = &scene.material[0], *b = &scene.material[1];
        CHECK(same_vec3(a->kd, 0.1, 0.1, 0.1) && same_vec3(a->ks, 0.2, 0.3, 0.4) && a->ns == 5
                  && same_vec3(a->ke, 1, 2, 3),
              "material a");
        CHECK(same_vec3(b->kd, 0, 0, 0) && same_vec3(b->ks, 0, 0, 0) && b->ns == 0 && same_vec3(b->ke, 4, 4, 4),
              "material b");
    }
    metro_scene_free(&scene);
    scene = good(FACE, "newmtl a\nmap_Ka dust.png\nPr 0.5\n", 1, 1);
    CHECK(scene.material_count == 1 && scene.material[0].kd.y == 0.5, "a material that says nothing has Kd 0.5");
    metro_scene_free(&scene);
    scene = good("v 0 0 0\nusemtl C# x\nf 1 1 1\nusemtl #\nf 1 1 1\nusemtl #1 # one\nf 1 1 1\n",
                 "newmtl C\nKd .1\nnewmtl C# x\nKd .2\nnewmtl #1\n", 3, 2);
    CHECK(scene.material_count == 2 && scene.material[0].kd.x == 0.2 && scene.material_of[1] == 0, "names with #");
    metro_scene_free(&scene);
    scene = good(FACE, "newmtl\na\nnewmtl a # the first\nKd .25 .25 .25 # grey\nKs \\\n.5\n", 1, 1);
    CHECK(scene.material_count == 1 && scene.material[0].kd.y == 0.25 && scene.material[0].ks.z == 0.5, "comments");
    metro_scene_free(&scene);
}

/* Catches: names that collide in the table, a table that loses names when it grows, a quadratic search. */
static void many_names(void)
{
    enum { NAMES = 20000 };
    size_t size = 64 * (size_t)NAMES, at = 0, wrong = 0, i;
    char *obj = (char *)malloc(size), *mtl = (char *)malloc(size);
    metro_scene scene;
    if (obj == NULL || mtl == NULL) return;
    at += (size_t)snprintf(obj, size, "v 0 0 0\nv 1 0 0\nv 0 1 0\n");
    for (i = 0; i < NAMES; i++)
        at += (size_t)snprintf(obj + at, size - at, "usemtl m%d\nf 1 2 3\nusemtl m0\nf 1 2 3\n", (int)i);
    for (i = at = 0; i < NAMES; i++)
        at +=
            (size_t)snprintf(mtl + at, size - at, "newmtl m%d\nNs %d\n", (int)(NAMES - 1 - i), (int)(NAMES - 1 - i));
    scene = good(obj, mtl, 2 * NAMES, NAMES);
    for (i = 0; i < NAMES && scene.triangle_count == 2 * NAMES; i++) {
        wrong += metro_scene_material(&scene, scene.material_of[2 * i])->ns != (double)i;
        wrong += metro_scene_material(&scene, scene.material_of[2 * i + 1])->ns != 0;
    }
    CHECK(wrong == 0, "%d triangles of another material", (int)wrong);
    metro_scene_free(&scene);
    free(obj);
    free(mtl);
}

/* Catches: each warning missing, twice, or where nothing is wrong; numbers not mended. */
static void warnings(void)
{
    metro_scene scene;
    scene =
        warned(FACE "usemtl b\nf 1 2 3\n", "newmtl b\nKd 1 .5 .5\nKs .5 .5 .5\nnewmtl a\nKd .8 .8 .8\nKs .1 .5 .2\n",
               "mtl:1: material b has Kd + Ks above 1, more light than it receives; Ks is taken as 1 - Kd");
    CHECK(scene.material_count == 2 && same_vec3(scene.material[0].ks, 0, 0.5, 0.5)
              && same_vec3(scene.material[1].ks, 0.1, 1 - 0.8, 0.2),
          "Ks");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nKd .3 1.5 1\n", "mtl:1: material a has Kd above 1; it is taken as 1");
    CHECK(scene.material_count == 1 && same_vec3(scene.material[0].kd, 0.3, 1, 1), "Kd");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nNs -1e-9\n", "mtl:1: material a has a negative number; it is taken as 0");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nKe 1 1 -1\n", "mtl:1: material a has a negative number; it is taken as 0");
    metro_scene_free(&scene);
    scene = warned(FACE, "#\nnewmtl a\nKs -.3 0 0.5\nNs -1.960784\nKe 0 0 -5\n",
                   "mtl:2: material a has a negative number; it is taken as 0");
    CHECK(scene.material_count == 1 && same_vec3(scene.material[0].ks, 0, 0, 0.5) && scene.material[0].ns == 0
              && same_vec3(scene.material[0].ke, 0, 0, 0),
          "negative");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nd .5\n", "mtl:1: material a is transparent (d, Tr); it is drawn opaque");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nd -halo 0\n", "mtl:1: material a is transparent (d, Tr); it is drawn opaque");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nTr .5\n", "mtl:1: material a is transparent (d, Tr); it is drawn opaque");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nmap_Kd -s 1 1 1 wood.png\n",
                   "mtl:1: material a has textures (map_); they are not read");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nbump dents.png\n", "mtl:1: material a has textures (map_); they are not read");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nillum 5\nKs .1 .1 .1\n",
                   "mtl:1: material a asks for a mirror or glass (illum); it is drawn with Kd, Ks and Ns alone");
    metro_scene_free(&scene);
    scene = warned(FACE, "newmtl a\nillum 1\nKs .5 .5 .5\n",
                   "mtl:1: material a switches Ks off (illum 0 or 1); it is drawn with Ks all the same");
    metro_scene_free(&scene);
    scene = good(FACE, "newmtl a\nillum 1\nKs 0 0 0\nd 1\nTr 0\nTr 1\n", 1, 1);
    metro_scene_free(&scene);
    scene = warned(FACE "usemtl c\nf 1 2 3\n", NULL,
                   "obj:4: no MTL file defines the material a; it is drawn with Kd 0.5");
    CHECK(scene.triangle_count == 2 && scene.material_of[0] == 0 && scene.material_of[1] == 0, "material 0");
    metro_scene_free(&scene);
    scene = warned(FACE "f 1 2\nf\nf 1\n", "newmtl a\n",
                   "obj:6: a face (f) has fewer than three corners and is left out");
    CHECK(scene.triangle_count == 1, "%d triangles", (int)scene.triangle_count);
    metro_scene_free(&scene);
    scene = warned("v 1e39 0 0\nv nan 0 0\nv 0 -inf 0\nv 0 0 -nan(ind)\nf 1 2 3\nf 4 4 4\n", NULL,
                   "obj:1: a vertex is not finite: its triangles are never hit");
    CHECK(scene.triangle_count == 2 && isnan(metro_scene_area(&scene, 0)) && isnan(metro_scene_corner(&scene, 1, 0).z)
              && metro_scene_corner(&scene, 1, 0).y == 0,
          "broken triangles keep their numbers");
    metro_scene_free(&scene);
    scene = warned(FACE "usemtl b\nf 1 2 3\nv NaN 0 0\nf 1 2\n", "newmtl a\nd 0\nnewmtl c\nd 0\nKd 2\n",
                   "obj:8: a vertex is not finite: its triangles are never hit\n"
                   "obj:9: a face (f) has fewer than three corners and is left out\n"
                   "mtl:1: material a is transparent (d, Tr); it is drawn opaque\n"
                   "obj:6: no MTL file defines the material b; it is drawn with Kd 0.5");
    metro_scene_free(&scene);
}

/* Catches: each error missing, without its place, or leaving something behind. */
static void errors(void)
{
    const char *not_whole = "obj:2: a corner of a face (f) is not a whole number such as 3, 3/1, 3//2 or -1";
    const char *none = "obj: there is no face (f) in the file; is it an OBJ file?";
    const char *color = "mtl:2: Kd, Ks and Ke need one or three finite numbers, and Ns needs one";
    refused("", NULL, none);
    refused("v 0 0 0\nv 1 0 0\nl 1 2\n", NULL, none);
    refused("v 0 0 0\nf 1 1\n", NULL, none);
    refused("\x7f\x45LF\x02\x01\x01 and so on", NULL, none);
    refused("v 0 0\n", NULL, "obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("#\nv\n", NULL, "obj:2: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("v 0 0 x\n", NULL, "obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("v 0 0 1x\n", NULL, "obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("v 0,5 0 1\n", NULL, "obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    refused("v 0 0 0\nf 1 1 x\n", NULL, not_whole);
    refused("v 0 0 0\nf 1 1 1.5\n", NULL, not_whole);
    refused("v 0 0 0\nf 1 1 -\n", NULL, not_whole);
    refused("v 0 0 0\nf 1 1 /1\n", NULL, not_whole);
    refused("v 0 0 0\nf 1 1 1a\n", NULL, not_whole);
    refused("v 0 0 0\nf 1 0 1\n", NULL, "obj:2: a face (f) uses vertex 0; the first vertex is number 1");
    refused("v 0 0 0\nf 1 2 1\n", NULL, "obj:2: a face (f) uses the vertex 2, which is not there: 1 stands above it");
    refused("v 0 0 0\nv 0 0 0\nf 1 -3 1\n", NULL,
            "obj:3: a face (f) uses the vertex -3, which is not there: 2 stand above it");
    refused("f 1 2 3\nv 0 0 0\n", NULL, "obj:1: a face (f) uses the vertex 1, which is not there: 0 stand above it");
    refused("v 0 0 0\nf 1 1 4294967297\n", NULL,
            "obj:2: a face (f) uses the vertex 4294967297, which is not there: 1 stands above it");
    refused("v 0 0 0\nf 1 1 18446744073709551617\n", NULL,
            "obj:2: a face (f) uses the vertex 18446744073709551617, which is not there: 1 stands above it");
    refused("v 0 0 0\nf 1 1 100000000000000000000000000000000000000000001\n", NULL,
            "obj:2: a face (f) uses the vertex 100000000000000000000000000000000000000000001,"
            " which is not there: 1 stands above it");
    refused(FACE "f 1 2\nf 1 2 9\n", NULL,
            "obj:7: a face (f) uses the vertex 9, which is not there: 3 stand above it");
    refused(FACE "f 1 2\n", "newmtl a\nKd\n", color);
    refused(FACE, "newmtl a\nKd\n", color);
    refused(FACE, "newmtl a\nKd 1 2\n", color);
    refused(FACE, "newmtl a\nKd .1 .1 x\n", color);
    refused(FACE, "newmtl a\nKs spectral a.rfl\n", color);
    refused(FACE, "newmtl a\nKe 1e999 0 0\n", color);
    refused(FACE, "newmtl a\nKe nan\n", color);
    refused(FACE, "newmtl a\nNs many\n", color);
}

/* Catches: a camera that is not read, the first of two, a half-read one, other comments taken for cameras. */
static void cameras(void)
{
    metro_scene scene = good("# camera eye 9 9 9 look 0 0 0 up 0 1 0 fov 10\n"
                             "  #\tcamera eye 0 1 3.7474774 look 0 -1.5 0 up 0 1 1e-1  fov 40.5  # and more\n"
                             "# camera: Canon\n#camera\n# cameras eye\n" SQUARE "f 1 2 3\n",
                             NULL, 1, 0);
    CHECK(scene.has_camera == 1, "no camera");
    CHECK_VEC3(scene.camera.eye, 0, 1, 3.7474774);
    CHECK_VEC3(scene.camera.look, 0, -1.5, 0);
    CHECK_VEC3(scene.camera.up, 0, 1, 0.1);
    CHECK(scene.camera.fov == 40.5, "fov %g", scene.camera.fov);
    CHECK(parse(&scene, SQUARE "f 1 2 3\n", NULL) == METRO_OK && scene.has_camera && scene.camera.fov == 40.5,
          "a file without a camera took it away");
    CHECK(parse(&scene, "#camera eye 1 2 3 look 0 0 0 up 0 1 0 fov 30\n" SQUARE "f 1 2 3\n", NULL) == METRO_OK
              && scene.camera.fov == 30,
          "a second camera is the one that counts");
    metro_scene_free(&scene);
    scene = warned(
        "# camera eye 1 2 3 look 0 0 0 up 0 1 0 fov x\n# camera eye\n" SQUARE "f 1 2 3\n", NULL,
        "obj:1: left out, since a camera line has the form # camera eye x y z look x y z up x y z fov DEGREES");
    CHECK(!scene.has_camera, "half a camera");
    metro_scene_free(&scene);
    scene = warned("# camera eye 1 2 3 look 0 0 0 up 0 1 0 fov 1e999\n" SQUARE "f 1 2 3\n", NULL,
                   "obj:1: left out, since a camera line has the form # camera eye x y z look x y z up x y z fov "
                   "DEGREES");
    CHECK(!scene.has_camera, "a camera without end");
    scene.camera.fov = 20;
    scene.has_camera = 1;
    metro_scene_free(&scene);
    scene.has_camera = 1;
    scene.camera.fov = 20;
    CHECK(parse(&scene, SQUARE "f 1 2 3\n", NULL) == METRO_OK && scene.has_camera && scene.camera.fov == 20,
          "a camera that stood in an empty scene is gone");
    metro_scene_free(&scene);
}

/* ---- polygons ---- */

typedef struct {
    double x, y;
} point2;

static int inside_triangle(point2 p, const point2 t[3])
{
    int k, left = 0;
    for (k = 0; k < 3; k++) {
        point2 a = t[k], b = t[(k + 1) % 3];
        left += (b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x) > 0;
    }
    return left == 3;
}

/* The even-odd rule. */
static int inside_polygon(point2 p, const point2 *q, int n)
{
    int i, inside = 0;
    for (i = 0; i < n; i++) {
        point2 a = q[i], b = q[(i + 1) % n];
        if ((a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) * (b.x - a.x) / (b.y - a.y)) inside = !inside;
    }
    return inside;
}

/* The polygon q in the plane of `right` and `up` (square, of length 1), written as an OBJ face. */
static char *polygon_text(const point2 *q, int n, metro_vec3 right, metro_vec3 up)
{
    size_t size = 100 * (size_t)n + 100, at = 0;
    char *text = (char *)malloc(size);
    int i;
    for (i = 0; i < n; i++) {
        metro_vec3 p = metro_add(metro_scale(right, q[i].x), metro_scale(up, q[i].y));
        at += (size_t)snprintf(text + at, size - at, "v %.9g %.9g %.9g\n", p.x, p.y, p.z);
    }
    at += (size_t)snprintf(text + at, size - at, "f");
    for (i = 0; i < n; i++) at += (size_t)snprintf(text + at, size - at, " %d", i + 1);
    snprintf(text + at, size - at, "\n");
    return text;
}

/* Each point of the polygon must be covered once and no other point at all, all triangles facing the same way: tried
   with random points, in the plane of `right` that `normal` stands on. */
static void cover_in(const char *name, const point2 *q, int n, metro_vec3 right, metro_vec3 normal, metro_rng *rng)
{
    metro_vec3 up = metro_cross(normal, right);
    char *text = polygon_text(q, n, right, up);
    metro_scene scene = good(text, NULL, (size_t)n - 2, 0);
    double area = 0, turned = 0, low = 1e9, high = -1e9;
    point2 *flat = (point2 *)malloc(3 * (size_t)n * sizeof *flat);
    int i, k, wrong = 0, back = 0, triangles = (int)scene.triangle_count;
    for (i = 0; i < n; i++) {
        point2 a = q[i], b = q[(i + 1) % n];
        area += (a.x * b.y - a.y * b.x) / 2;
        low = low < a.x ? low : a.x;
        low = low < a.y ? low : a.y;
        high = high > a.x ? high : a.x;
        high = high > a.y ? high : a.y;
    }
    for (i = 0; i < triangles; i++) {
        double facing = metro_dot(metro_scene_normal(&scene, (uint32_t)i), normal);
        if (metro_scene_area(&scene, (uint32_t)i) > 1e-6 * fabs(area)) back += (facing > 0) != (area > 0);
        turned += metro_scene_area(&scene, (uint32_t)i);
        for (k = 0; k < 3; k++) {
            metro_vec3 p = metro_scene_corner(&scene, (uint32_t)i, area > 0 ? k : 2 - k);
            flat[3 * i + k].x = metro_dot(p, right);
            flat[3 * i + k].y = metro_dot(p, up);
        }
    }
    CHECK(back == 0, "%s: %d of %d triangles look the wrong way", name, back, triangles);
    CHECK(fabs(turned - fabs(area)) < 1e-5 * fabs(area), "%s: area %.9g, not %.9g", name, turned, fabs(area));
    for (k = 0; k < 300; k++) {
        point2 p;
        int covered = 0;
        p.x = low + (high - low) * metro_rng_uniform(rng);
        p.y = low + (high - low) * metro_rng_uniform(rng);
        for (i = 0; i < triangles; i++) covered += inside_triangle(p, flat + 3 * i);
        wrong += covered != inside_polygon(p, q, n);
    }
    CHECK(wrong <= 1, "%s: %d of 300 points are covered wrongly", name, wrong); /* one may lie on an edge */
    metro_scene_free(&scene);
    free(flat);
    free(text);
}

/* In a random plane. */
static void cover(const char *name, const point2 *q, int n, metro_rng *rng)
{
    metro_vec3 right = metro_rng_direction(rng);
    cover_in(name, q, n, right, metro_normalize(metro_cross(right, metro_rng_direction(rng))), rng);
}

/* From every corner as the first one, and in both directions. */
static void cover_all(const char *name, const point2 *q, int n, metro_rng *rng)
{
    point2 turned[200];
    int first, i, back;
    for (back = 0; back < 2; back++)
        for (first = 0; first < n; first++) {
            for (i = 0; i < n; i++) turned[i] = q[back ? (first + n - i) % n : (first + i) % n];
            cover(name, turned, n, rng);
        }
}

/* Catches: a fan over a concave polygon, an ear with a corner inside it, an ear cut where the polygon turns right,
   the wrong plane or direction. */
static void concave_polygons(void)
{
    static const point2 arrow[4] = { { 0, 0 }, { 4, 0 }, { 1, 1 }, { 0, 4 } };
    static const point2 square[4] = { { 0, 0 }, { 1, 0 }, { 1, 1 }, { 0, 1 } };
    static const point2 room[6] = { { 0, 0 }, { 3, 0 }, { 3, 1 }, { 1, 1 }, { 1, 4 }, { 0, 4 } };
    static const point2 in_line[7] = { { 0, 0 }, { 1, 0 }, { 2, 0 }, { 3, 0 }, { 3, 2 }, { 1.5, 1 }, { 0, 2 } };
    static const point2 ring[10] = { { 0, 0 }, { 4, 0 }, { 4, 4 }, { 0, 4 }, { 0, 0 },
                                     { 1, 1 }, { 1, 3 }, { 3, 3 }, { 3, 1 }, { 1, 1 } };
    static const point2 doubled[8] = { { 0, 0 }, { 2, 0 },   { 2, 0 },   { 3, 0 },
                                       { 3, 2 }, { 1.5, 1 }, { 1.5, 1 }, { 0, 2 } };
    static const point2 spike[7] = { { 0, 0 }, { 4, 0 }, { 4, 3 }, { 2, 1 }, { 2, 2 }, { 2, 1 }, { 0, 3 } };
    metro_rng rng = metro_rng_make(9, 2);
    static point2 q[1000];
    int i, n;
    for (i = 0; i < 6; i++) { /* the planes of the axes, from both sides */
        metro_vec3 right = metro_vec3_make(i % 3 == 0, i % 3 == 1, i % 3 == 2);
        metro_vec3 normal = metro_scale(metro_vec3_make(right.z, right.x, right.y), i < 3 ? 1 : -1);
        cover_in("room in a plane of the axes", room, 6, right, normal, &rng);
        cover_in("ring in a plane of the axes", ring, 10, right, normal, &rng);
    }
    cover_all("arrow", arrow, 4, &rng);
    cover_all("square", square, 4, &rng);
    cover_all("room", room, 6, &rng);
    cover_all("in line", in_line, 7, &rng);
    cover_all("ring", ring, 10, &rng);
    cover_all("doubled", doubled, 8, &rng);
    cover_all("spike", spike, 7, &rng);
    for (i = 0; i < 50; i++) { /* a comb */
        q[2 * i].x = 2 * i;
        q[2 * i].y = 0;
        q[2 * i + 1].x = 2 * i + 1;
        q[2 * i + 1].y = i % 7 + 60;
    }
    q[100].x = 99;
    q[100].y = 80;
    q[101].x = 0;
    q[101].y = 80;
    cover_all("comb", q, 102, &rng);
    for (i = 0; i < 60; i++) { /* a spiral of two walls */
        double angle = 0.3 * i, radius = 1 + 0.2 * i;
        q[i].x = radius * cos(angle);
        q[i].y = radius * sin(angle);
        q[119 - i].x = (radius + 0.8) * cos(angle);
        q[119 - i].y = (radius + 0.8) * sin(angle);
    }
    cover_all("spiral", q, 120, &rng);
    for (i = 0; i < 500; i++) { /* a long one, many times round */
        double angle = 6.283185307179586 * i / 40, radius = 1 + 0.2 * i;
        q[i].x = radius * cos(angle);
        q[i].y = radius * sin(angle);
        q[999 - i].x = (radius + 2) * cos(angle);
        q[999 - i].y = (radius + 2) * sin(angle);
    }
    cover("long spiral", q, 1000, &rng);
    for (n = 5; n < 200; n += 3) { /* stars with arms of random length */
        for (i = 0; i < n; i++) {
            double angle = 6.283185307179586 * i / n, radius = 0.05 + metro_rng_uniform(&rng);
            q[i].x = radius * cos(angle);
            q[i].y = radius * sin(angle);
        }
        cover("star", q, n, &rng);
    }
}

/* Catches: a warning that is missing or false, triangles lost or made up, an endless loop, time that grows with the
   square of the corners. */
static void odd_polygons(void)
{
    metro_scene scene;
    size_t i, n = 50000, size = 64 * n, at = 0;
    char *text = (char *)malloc(size);
    const char *crossed = "obj:6: a polygon crosses itself or is too intricate: it may be covered wrongly; cut it "
                          "into triangles in the program that wrote the file";
    scene = good("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\nf 1 1 2 2\nf 1 1 1\nf 1 2 1 2 1 2\n", NULL, 9, 0);
    metro_scene_free(&scene);
    scene = warned("v 6 8 0\nv 1 7 0\nv 4 8 0\nv 8 2 0\nv 8 1 0\nf 1 2 3 4 5\n", NULL, crossed);
    CHECK(scene.triangle_count == 3, "%d triangles", (int)scene.triangle_count);
    metro_scene_free(&scene);
    scene = warned("v 0 0 0\nv 1 1 0\nv 1 nan 0\nv 0 1e39 0\nf 1 2 3 4\n", NULL,
                   "obj:3: a vertex is not finite: its triangles are never hit");
    CHECK(scene.triangle_count == 2, "%d triangles", (int)scene.triangle_count);
    metro_scene_free(&scene);
    scene = good("v 3.4028235e38 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n", NULL, 1, 0); /* rounds to the largest float */
    CHECK(isfinite(scene.corner[0]), "the largest float is read as %g", (double)scene.corner[0]);
    metro_scene_free(&scene);
    scene = warned("v 0 0 -1.#IND00\nv 1.#INF 1 0\nv 1 -1.#QNAN 0\nv 0 1e10000 -1e-10000\nf 1 2 3 4\n", NULL,
                   "obj:1: a vertex is not finite: its triangles are never hit");
    CHECK(!isfinite(scene.corner[2]) && !isfinite(scene.corner[3]) && !isfinite(scene.corner[7]), "-1.#IND is read");
    CHECK(isinf(scene.corner[16]) && scene.corner[17] == 0, "1e10000 is %g, -1e-10000 %g", (double)scene.corner[16],
          (double)scene.corner[17]);
    metro_scene_free(&scene);
    scene =
        good("v 0 0 0\nv 3e38 0 0\nv 1e38 1e38 0\nv 0 3e38 0\nv -3e38 -3e38 0\nf 4 1 2 3\nf 1 2 3 4 5\n", NULL, 5, 0);
    CHECK_NEAR(metro_scene_area(&scene, 0) + metro_scene_area(&scene, 1), 3e76, 1e-6);
    metro_scene_free(&scene);
    if (text == NULL) return;
    for (i = 0; i < n; i++) /* a star with ever longer and shorter arms: far too intricate */
        at += (size_t)snprintf(text + at, size - at, "v %.6g %.6g 0\n",
                               (1 + (double)(i * 7919 % 1000)) * cos(6.28 * (double)i / (double)n),
                               (1 + (double)(i * 7919 % 1000)) * sin(6.28 * (double)i / (double)n));
    at += (size_t)snprintf(text + at, size - at, "f");
    for (i = 0; i < n; i++) at += (size_t)snprintf(text + at, size - at, " %d", (int)i + 1);
    allocations_reset(-1);
    scene = nothing();
    CHECK(parse(&scene, text, NULL) == METRO_OK && scene.triangle_count == n - 2, "%d triangles",
          (int)scene.triangle_count);
    CHECK(strstr(told, ": a polygon crosses itself") != NULL, "no warning: %s", told);
    CHECK(allocations_made < 200 && allocations_bytes < 40 * size, "%ld blocks, %.3g bytes for %.3g",
          allocations_made, (double)allocations_bytes, (double)at);
    metro_scene_free(&scene);
    free(text);
}

/* ---- several loads ---- */

/* Catches: numbers of materials that are not moved on, triangles that overwrite others. */
static void joining(void)
{
    metro_scene scene = nothing();
    static const metro_material grey = { { 0.125, 0, 0 }, { 0, 0, 0 }, 0, { 0, 0, 0 } };
    metro_vec3 corner[3] = { { 7, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
    static const uint32_t number[6] = { 1, 2, 0, 3, 4, 0 };
    uint32_t index, i;
    metro_scene_add_material(&scene, &grey, &index);
    metro_scene_add_triangle(&scene, corner, index);
    CHECK(parse(&scene, FACE "usemtl x\nf 2 2 3\n", "newmtl a\nKd .25\n") == METRO_OK, "%s", told);
    CHECK(parse(&scene, "v 8 0 0\nusemtl b\nf 1 1 1\nusemtl a\nf 1 1 1\nusemtl\nf 1 1 1\n",
                "newmtl b\nKd .5\nnewmtl a\nKd .75\n")
              == METRO_OK,
          "%s", told);
    CHECK(scene.triangle_count == 6 && scene.material_count == 4, "%d triangles, %d materials",
          (int)scene.triangle_count, (int)scene.material_count);
    for (i = 0; i < 6; i++)
        CHECK(scene.material_of[i] == number[i], "triangle %d: %d", (int)i, (int)scene.material_of[i]);
    CHECK(metro_scene_material(&scene, 1)->kd.x == 0.125 && metro_scene_material(&scene, 2)->kd.x == 0.25
              && metro_scene_material(&scene, 3)->kd.x == 0.5 && metro_scene_material(&scene, 4)->kd.x == 0.75,
          "the materials");
    CHECK_VEC3(metro_scene_corner(&scene, 0, 0), 7, 0, 0);
    CHECK_VEC3(metro_scene_corner(&scene, 2, 0), 1, 0, 0);
    CHECK_VEC3(metro_scene_corner(&scene, 5, 2), 8, 0, 0);
    metro_scene_free(&scene);
}

/* ---- messages ---- */

/* Catches: a byte beyond the message, no closing zero, a message that is not a beginning of the whole one. */
static void messages_are_cut(void)
{
    static const char *const file[2] = { FACE "f 1 1 7\n", FACE "usemtl x\nf 1 2 3\nf\n" };
    int i;
    for (i = 0; i < 2; i++) {
        const unsigned char *bytes = (const unsigned char *)file[i];
        size_t size = strlen(file[i]), length, cut;
        char whole[500], part[600];
        metro_scene scene = nothing();
        metro_result result = metro_scene_parse_obj(&scene, bytes, size, NULL, 0, whole, sizeof whole);
        metro_scene_free(&scene);
        length = strlen(whole);
        CHECK(length > 40, "\"%s\"", whole);
        for (cut = 0; cut <= length + 2; cut++) {
            memset(part, '!', sizeof part);
            CHECK(metro_scene_parse_obj(&scene, bytes, size, NULL, 0, part, cut) == result, "another result");
            metro_scene_free(&scene);
            CHECK(part[cut] == '!', "size %d: a byte beyond the end", (int)cut);
            if (cut > 0)
                CHECK(strlen(part) == (cut - 1 < length ? cut - 1 : length), "size %d: \"%s\"", (int)cut, part);
            if (cut > 0) CHECK(memcmp(part, whole, strlen(part)) == 0, "size %d: \"%s\"", (int)cut, part);
        }
        CHECK(metro_scene_parse_obj(&scene, bytes, size, NULL, 0, NULL, 0) == result, "no message");
        CHECK(metro_scene_parse_obj(&scene, bytes, size, NULL, 0, NULL, 99) == result, "no message");
        metro_scene_free(&scene);
    }
}

/* Catches: NULLs that are followed. */
static void no_arguments(void)
{
    metro_scene scene = nothing();
    const unsigned char byte = 'v';
    CHECK(metro_scene_load_obj(NULL, "a.obj", told, sizeof told) == METRO_ERROR_ARGUMENT && told[0] != 0, "no scene");
    CHECK(metro_scene_load_obj(&scene, NULL, told, sizeof told) == METRO_ERROR_ARGUMENT && told[0] != 0, "no path");
    CHECK(metro_scene_parse_obj(NULL, &byte, 1, NULL, 0, told, sizeof told) == METRO_ERROR_ARGUMENT && told[0] != 0,
          "no scene");
    CHECK(metro_scene_parse_obj(&scene, NULL, 1, NULL, 0, told, sizeof told) == METRO_ERROR_ARGUMENT, "no bytes");
    CHECK(metro_scene_parse_obj(&scene, &byte, 1, NULL, 1, told, sizeof told) == METRO_ERROR_ARGUMENT, "no MTL");
    CHECK(metro_scene_parse_obj(&scene, NULL, 0, NULL, 0, told, sizeof told) == METRO_ERROR_FORMAT, "an empty file");
    CHECK(metro_scene_load_obj(NULL, NULL, NULL, 0) == METRO_ERROR_ARGUMENT, "nothing at all");
}

/* ---- memory ---- */

#define EVERYTHING                                                                                                   \
    "mtllib none.mtl\n# camera eye 0 0 5 look 0 0 0 up 0 1 0 fov 40\nv 0 0 0\nv 4 0 0\nv 1 1 0\nv 0 4 0\nusemtl a\n" \
    "f 1 2 3 4\nusemtl b\nf 1 2 3\nusemtl c\nf 1 2 3 4 3 2 1 2 3 4 3 2 1 2 3 4 3 2 1 2 3 4\n"

/* Every allocation fails once, for a scene that is empty and for one that holds something, until the file loads. */
static void no_memory(void)
{
    int full;
    for (full = 0; full < 2; full++) {
        long k, before = allocations_live;
        metro_result result = METRO_ERROR_MEMORY;
        for (k = 1; result == METRO_ERROR_MEMORY && k < 100; k++) {
            metro_scene scene = nothing();
            metro_vec3 corner[3] = { { 7, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
            allocations_reset(-1);
            if (full) metro_scene_add_triangle(&scene, corner, 0);
            allocations_reset(k - 1);
            result = parse(&scene, EVERYTHING, "newmtl a\nKd .5\nnewmtl b\nd 0\n");
            allocations_reset(-1);
            if (result == METRO_ERROR_MEMORY) {
                CHECK(strstr(told, "memory") != NULL, "\"%s\"", told);
                CHECK(scene.triangle_count == (size_t)full && scene.material_count == 0 && !scene.has_camera,
                      "block %ld: the scene has changed", k);
                if (!full) CHECK(allocations_live == before, "block %ld: something stays", k);
                if (full) CHECK_VEC3(metro_scene_corner(&scene, 0, 0), 7, 0, 0);
            } else {
                CHECK(result == METRO_OK && scene.triangle_count == 23 + (size_t)full, "%s", told);
            }
            metro_scene_free(&scene);
            CHECK(allocations_live == before, "block %ld of %d: %ld blocks left", k, full,
                  allocations_live - before);
        }
        CHECK(result == METRO_OK && k > 10, "%ld tries, %s", k, metro_result_text(result));
    }
}

/* The same for scenes made in code. Catches: a count that goes up though the list did not grow. */
static void no_memory_in_code(void)
{
    long k, before = allocations_live;
    for (k = 1; k < 6; k++) {
        metro_scene scene = nothing();
        metro_vec3 corner[3] = { { 7, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
        metro_material material;
        uint32_t index = 0, failed = 0, i;
        memset(&material, 0, sizeof material);
        allocations_reset(k - 1);
        for (i = 0; i < 20; i++) {
            size_t triangles = scene.triangle_count, materials = scene.material_count;
            if (metro_scene_add_triangle(&scene, corner, 0) != METRO_OK) {
                failed++;
                CHECK(scene.triangle_count == triangles, "a triangle too many");
            }
            if (metro_scene_add_material(&scene, &material, &index) != METRO_OK) {
                failed++;
                CHECK(scene.material_count == materials, "a material too many");
            }
        }
        CHECK(failed == 1 && scene.triangle_count + scene.material_count == 39, "%d failed", (int)failed);
        allocations_reset(-1);
        metro_scene_free(&scene);
    }
    CHECK(allocations_live == before, "blocks left");
    {
        metro_scene scene = nothing();
        metro_vec3 corner[3] = { { 7, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } };
        scene.triangle_count = scene.triangle_room = 0xffffffffu; /* a full scene, without its lists */
        allocations_reset(-1);
        CHECK(metro_scene_add_triangle(&scene, corner, 0) == METRO_ERROR_MEMORY && allocations_made == 0,
              "2^32 triangles");
    }
}

/* Catches: memory that grows faster than the file. */
static void memory_is_linear(void)
{
    size_t n = 20000, size = 40 * n, at = 0, i;
    char *text = (char *)malloc(size);
    metro_scene scene = nothing();
    if (text == NULL) return;
    for (i = 0; i < n; i++) at += (size_t)snprintf(text + at, size - at, "v %d 0 1\nmtllib m\nf -1 1 -1\n", (int)i);
    allocations_reset(-1);
    CHECK(parse(&scene, text, "") == METRO_OK && scene.triangle_count == n, "%s", told);
    /* 40 bytes a triangle and 12 a vertex, lists that grow by half, then are trimmed: at most four times as much. */
    CHECK(allocations_bytes < 4 * 52 * n + 2 * at + 5000, "%d bytes", (int)allocations_bytes);
    CHECK(scene.triangle_room == n, "room for %d triangles is kept", (int)scene.triangle_room);
    CHECK(allocations_made < 120, "%ld blocks", allocations_made);
    metro_scene_free(&scene);
    free(text);
}

/* ---- files ---- */

#ifndef _WIN32

static char folder[200];

static const char *in_folder(const char *name)
{
    static char path[300];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return path;
}

static void write_text(const char *name, const char *text)
{
    FILE *file = fopen(in_folder(name), "wb");
    CHECK(file != NULL, "cannot write %s", in_folder(name));
    if (file == NULL) return;
    fwrite(text, 1, strlen(text), file);
    fclose(file);
}

#define CANNOT_READ(line)                                                                                            \
    "%s/room.obj:" line ": the MTL file cannot be read (put it beside the OBJ, or correct mtllib): "

/* Loads `text` as room.obj of the folder, which must give `message` (%s: the folder) and so many materials. */
static void loads(const char *text, const char *message, size_t materials)
{
    metro_scene scene = nothing();
    char expected[600];
    metro_result result;
    long living = allocations_live;
    write_text("room.obj", text);
    snprintf(expected, sizeof expected, message, folder, folder);
    memset(told, '?', sizeof told);
    result = metro_scene_load_obj(&scene, in_folder("room.obj"), told, sizeof told);
    CHECK(result == METRO_OK, "%s: %s", text, metro_result_text(result));
    CHECK_TOLD(expected);
    CHECK(scene.material_count == materials, "%s: %d materials", text, (int)scene.material_count);
    if (materials > 0 && scene.material_count > 0) CHECK(scene.material[0].kd.x == 0.25, "another material");
    metro_scene_free(&scene);
    CHECK(allocations_live == living, "%ld blocks left", allocations_live - living);
}

static void fails(const char *name, metro_result wanted, const char *message)
{
    metro_scene scene = nothing();
    char expected[600];
    metro_result result;
    long living = allocations_live;
    snprintf(expected, sizeof expected, message, folder, folder);
    result = metro_scene_load_obj(&scene, in_folder(name), told, sizeof told);
    CHECK(result == wanted, "%s: %s", name, metro_result_text(result));
    CHECK_TOLD(expected);
    CHECK(scene.corner == NULL && scene.triangle_count == 0 && allocations_live == living, "something stays");
}

#define USE_A "v 0 0 0\nusemtl a\nf 1 1 1\n"

/* Catches: paths from the current folder, names with blanks cut, a second library that is not read, a missing file
   that stops everything, a device or a pipe that is waited for. */
static void libraries(void)
{
    static char whole[5000]; /* PATH_MAX and more */
    char text[700];
    write_text("a.mtl", "newmtl a\nKd .25\n");
    write_text("my room.mtl", "newmtl a\nKd .25\n");
    write_text("b.mtl", "newmtl b\nKd .75\n");
    write_text("sub/c.mtl", "newmtl a\nKd .25\n");
    loads("mtllib a.mtl\n" USE_A, "", 1);
    loads(USE_A "mtllib a.mtl\r\n", "", 1);
    loads("mtllib ./a.mtl\n" USE_A, "", 1);
    loads("mtllib sub/c.mtl\n" USE_A, "", 1);
    loads("mtllib sub\\c.mtl\n" USE_A, "", 1);
    loads("mtllib my room.mtl\n" USE_A, "", 1);
    loads("mtllib b.mtl a.mtl\n" USE_A, "", 1);
    loads("mtllib b.mtl\nmtllib a.mtl\n" USE_A, "", 1);
    loads("mtllib a.mtl\nmtllib b.mtl\n" USE_A "usemtl b\nf 1 1 1\n", "", 2);
    loads("mtllib C:\\Users\\somebody\\My Scenes\\a.mtl\n" USE_A, "", 1);
    loads("mtllib /home/somebody/scenes/my room.mtl\n" USE_A, "", 1);
    snprintf(text, sizeof text, "mtllib %s\n" USE_A, in_folder("a.mtl"));
    loads(text, "", 1);
    if (realpath(folder, whole) != NULL) {
        snprintf(text, sizeof text, "mtllib %.500s/sub/c.mtl\n" USE_A, whole);
        loads(text, "", 1);
    }
    loads("\n\nmtllib none.mtl\nmtllib nor this.mtl\n" USE_A,
          CANNOT_READ("3") "none.mtl\n"
          "%s/room.obj:6: no MTL file defines the material a; it is drawn with Kd 0.5",
          0);
    loads("mtllib none.mtl a.mtl\n" USE_A, CANNOT_READ("1") "none.mtl", 1);
    loads("mtllib a.mtl none.MTL\n" USE_A, CANNOT_READ("1") "none.MTL", 1);
    loads("mtllib none a.mtl\n" USE_A, "", 1);
    loads("mtllib /nowhere/a.mtl C:\\nowhere\\b.mtl\n" USE_A "usemtl b\nf 1 1 1\n", "", 2);
    loads("mtllib C:\\Users\\me\\my room.mtl\n" USE_A, "", 1);
    loads("mtllib sub\nmtllib a.mtl\n" USE_A, CANNOT_READ("1") "sub", 1);
    loads("mtllib /dev/zero\nmtllib a.mtl\n" USE_A, CANNOT_READ("1") "/dev/zero", 1);
    loads("mtllib\nmtllib \n" "v 0 0 0\nf 1 1 1\n", "", 0);
    if (mkfifo(in_folder("pipe.mtl"), 0600) == 0) {
        loads("mtllib pipe.mtl\nmtllib a.mtl\n" USE_A, CANNOT_READ("1") "pipe.mtl", 1);
        remove(in_folder("pipe.mtl"));
    }
}

/* Catches: a library that is read as often as it is named, which makes the time a product of two sizes. */
static void libraries_are_read_once(void)
{
    size_t n = 5000, size = 40 * n, at = 0, i;
    char *text = (char *)malloc(size);
    if (text == NULL) return;
    for (i = 0; i < n; i++)
        at += (size_t)snprintf(text + at, size - at, i % 2 == 0 ? "mtllib a.mtl\n" : "mtllib no%d a.mtl\n", (int)i);
    snprintf(text + at, size - at, USE_A);
    allocations_reset(-1);
    loads(text, "", 1);
    /* One block each for 2500 lines and 2500 words that name nothing, and few others. */
    CHECK(allocations_made < (long)(n + n / 10), "%ld blocks for %d lines", allocations_made, (int)n);
    free(text);
}

/* Catches: errors without the name of the file that they are in. */
static void files_that_fail(void)
{
    write_text("bad.mtl", "newmtl a\n\nKd red\n");
    write_text("bad.obj", "v 0 0\n");
    write_text("worse.obj", "mtllib bad.mtl\n" USE_A);
    write_text("empty.obj", "");
    fails("bad.obj", METRO_ERROR_FORMAT, "%s/bad.obj:1: a vertex (v) needs three numbers such as 0.5 -1 2e-3");
    fails("worse.obj", METRO_ERROR_FORMAT,
          "%s/bad.mtl:3: Kd, Ks and Ke need one or three finite numbers, and Ns needs one");
    fails("empty.obj", METRO_ERROR_FORMAT, "%s/empty.obj: there is no face (f) in the file; is it an OBJ file?");
    fails("none.obj", METRO_ERROR_FILE,
          "%s/none.obj: the file cannot be opened; check that it exists and that you may read it");
    fails("sub", METRO_ERROR_FILE,
          "%s/sub: the file cannot be read; check that it is an ordinary file and that its disk is there");
}

static void no_memory_for_files(void)
{
    long k, before = allocations_live;
    metro_result result = METRO_ERROR_MEMORY;
    write_text("d.mtl", "newmtl a\nKd .5\nnewmtl b\nd 0\n");
    write_text("all.obj", "mtllib no such thing\nmtllib x/d.mtl\n" EVERYTHING);
    for (k = 1; result == METRO_ERROR_MEMORY && k < 100; k++) {
        metro_scene scene = nothing();
        allocations_reset(k - 1);
        result = metro_scene_load_obj(&scene, in_folder("all.obj"), told, sizeof told);
        allocations_reset(-1);
        CHECK(result == METRO_OK ||
                  (strstr(told, "all.obj: ") != NULL && strstr(told, "memory for the scene") != NULL),
              "\"%s\"", told);
        CHECK(result == METRO_OK || allocations_live == before, "block %ld: something stays", k);
        metro_scene_free(&scene);
    }
    CHECK(result == METRO_OK && k > 15 && allocations_live == before, "%ld tries", k);
}

static void file_tests(void)
{
    static const char *const name[] = { "a.mtl", "my room.mtl", "b.mtl", "sub/c.mtl", "room.obj", "bad.mtl",
                                        "bad.obj", "worse.obj", "empty.obj", "d.mtl", "all.obj", "sub" };
    size_t i;
    snprintf(folder, sizeof folder, "build/geometry.XXXXXX");
    if (mkdtemp(folder) == NULL) {
        snprintf(folder, sizeof folder, "/tmp/geometry.XXXXXX");
        if (mkdtemp(folder) == NULL) {
            CHECK_RUN(no_arguments);
            printf("geometry: no folder to write to; the tests of files are left out\n");
            return;
        }
    }
    mkdir(in_folder("sub"), 0700);
    CHECK_RUN(libraries);
    CHECK_RUN(libraries_are_read_once);
    CHECK_RUN(files_that_fail);
    CHECK_RUN(no_memory_for_files);
    for (i = 0; i < sizeof name / sizeof *name; i++) remove(in_folder(name[i]));
    rmdir(in_folder("sub"));
    rmdir(folder);
}

#endif

/* Catches: numbers read by the rules of a country that writes 0,5. */
static void decimal_commas(void)
{
    static const char *const name[] = { "de_DE.UTF-8", "de_DE.utf8", "de_DE", "fr_FR.UTF-8", "German_Germany.1252" };
    size_t i;
    metro_scene scene;
    for (i = 0; i < sizeof name / sizeof *name; i++)
        if (setlocale(LC_ALL, name[i]) != NULL) break;
    scene = good("# camera eye 0.5 0 5 look 0 0 0 up 0 1 0 fov 40\nv 0.5 0 0\nf 1 1 1\nusemtl a\nf 1 1 1\n",
                 "newmtl a\nKd 0.25\n", 2, 1);
    CHECK_VEC3(metro_scene_corner(&scene, 0, 0), 0.5, 0, 0);
    CHECK(scene.camera.eye.x == 0.5 && scene.material_count == 1 && scene.material[0].kd.x == 0.25,
          "a lost fraction");
    metro_scene_free(&scene);
    setlocale(LC_ALL, "C");
}

/* Catches: numbers that lose digits on their way from text to float. */
static void numbers_come_back(void)
{
    metro_rng rng = metro_rng_make(9, 3);
    int n = (int)check_count(20000, 500), i, wrong = 0;
    char *text = (char *)malloc(80 * (size_t)n + 100);
    float *value = (float *)malloc(3 * (size_t)n * sizeof *value);
    size_t at = 0;
    metro_scene scene = nothing();
    for (i = 0; i < 3 * n; i++) {
        double size = pow(10, 60 * metro_rng_uniform(&rng) - 30);
        value[i] = (float)(i % 6 < 3 ? size : 2000 * metro_rng_uniform(&rng) - 1000);
    }
    for (i = 0; i < n; i++)
        at += (size_t)sprintf(text + at, "v %.9g %.9g %.9g\nf -1 -1 -1\n", (double)value[3 * i],
                              (double)value[3 * i + 1], (double)value[3 * i + 2]);
    CHECK(parse(&scene, text, NULL) == METRO_OK && scene.triangle_count == (size_t)n, "%s", told);
    for (i = 0; i < 3 * n && scene.triangle_count == (size_t)n; i++) {
        const float *corner = scene.corner + 9 * (i / 3) + i % 3;
        wrong += corner[0] != value[i] || corner[3] != value[i] || corner[6] != value[i];
    }
    CHECK(wrong == 0, "%d of %d floats are others", wrong, 3 * n);
    metro_scene_free(&scene);
    free(text);
    free(value);
}

int main(void)
{
    long living = allocations_live;
    CHECK_RUN(materials);
    CHECK_RUN(triangles);
    CHECK_RUN(after_the_build);
    CHECK_RUN(normals_and_areas);
    CHECK_RUN(bounds_and_frame);
    CHECK_RUN(lamps);
    CHECK_RUN(indices);
    CHECK_RUN(lines_of_all_kinds);
    CHECK_RUN(what_is_skipped);
    CHECK_RUN(exporters);
    CHECK_RUN(material_names);
    CHECK_RUN(many_names);
    CHECK_RUN(warnings);
    CHECK_RUN(errors);
    CHECK_RUN(cameras);
    CHECK_RUN(concave_polygons);
    CHECK_RUN(odd_polygons);
    CHECK_RUN(joining);
    CHECK_RUN(messages_are_cut);
    CHECK_RUN(no_arguments);
    CHECK_RUN(no_memory);
    CHECK_RUN(no_memory_in_code);
    CHECK_RUN(memory_is_linear);
    CHECK_RUN(decimal_commas);
    CHECK_RUN(numbers_come_back);
#ifndef _WIN32
    file_tests();
#endif
    if (allocations_live != living) fprintf(stderr, "geometry: %ld blocks left\n", allocations_live);
    return check_done("geometry");
}
