/* test_bvh: chapter 10. Independent truth is a loop over all triangles: in double (Moller and Trumbore 1997) for what
   is hit, and with the chapter's own test of one triangle for the bits. METRO_BVH_RAYS sets the number of rays for
   the bits and the leaks (1e6 when unset), so that `make check` can run 1e7. */

/* The loop computes the chapter's own test in here, so products and sums must not be contracted here either. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif

#include "memory.h"
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"

/* ---- Scenes */

static void add(metro_scene *scene, metro_vec3 a, metro_vec3 b, metro_vec3 c)
{
    metro_vec3 p[3];
    p[0] = a, p[1] = b, p[2] = c;
    CHECK(metro_scene_add_triangle(scene, p, 0) == METRO_OK, "cannot add a triangle");
}

static void add_quad(metro_scene *scene, metro_vec3 a, metro_vec3 b, metro_vec3 c, metro_vec3 d)
{
    add(scene, a, b, c);
    add(scene, a, c, d);
}

static metro_vec3 vec(double x, double y, double z) { return metro_vec3_make(x, y, z); }

static double uniform(metro_rng *rng, double low, double high) { return low + (high - low) * metro_rng_uniform(rng); }

static metro_vec3 in_box(metro_rng *rng, double r)
{
    double x = uniform(rng, -r, r), y = uniform(rng, -r, r), z = uniform(rng, -r, r);
    return vec(x, y, z);
}

/* gcc 12 at -O2 leaves out the conversion of two doubles to floats and back; it does not where one is volatile. */
static double rounded(double x)
{
    volatile float f = (float)x;
    return (double)f;
}

static metro_vec3 as_float(metro_vec3 a) { return vec(rounded(a.x), rounded(a.y), rounded(a.z)); }

static metro_vec3 ball_point(metro_vec3 c, double r, int n, int i, int j)
{
    double a = 3.14159265358979 * i / n, b = 6.28318530717959 * (j % (2 * n)) / (2 * n),
           s = i == 0 || i == n ? 0 : sin(a);
    return metro_add(c, metro_scale(vec(s * cos(b), cos(a), s * sin(b)), r));
}

static void ball(metro_scene *scene, metro_vec3 c, double r, int n)
{
    int i, j;
    for (i = 0; i < n; i++)
        for (j = 0; j < 2 * n; j++) {
            metro_vec3 p = ball_point(c, r, n, i, j), q = ball_point(c, r, n, i + 1, j);
            if (i > 0) add(scene, p, ball_point(c, r, n, i, j + 1), q);
            if (i < n - 1) add(scene, q, ball_point(c, r, n, i, j + 1), ball_point(c, r, n, i + 1, j + 1));
        }
}

/* The six faces of a cube, n x n quads each; `bump` moves inner vertices inwards. Neighbouring faces share corners
   exactly, since all are computed from the same integers. */
static metro_vec3 cube_point(int face, int n, int i, int j, double r, double bump)
{
    double p[3], u = -1 + 2.0 * i / n, v = -1 + 2.0 * j / n, rim = (1 - u * u) * (1 - v * v);
    int axis = face / 2;
    p[axis] = (face & 1 ? 1 : -1) * (1 - bump * rim * (1.5 + sin(17 * u + 3 * v) * sin(13 * v - 5 * u)));
    p[(axis + 1) % 3] = u;
    p[(axis + 2) % 3] = v;
    return metro_scale(vec(p[0], p[1], p[2]), r);
}

static void cube(metro_scene *scene, int n, double r, double bump)
{
    int face, i, j;
    for (face = 0; face < 6; face++)
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++)
                add_quad(scene, cube_point(face, n, i, j, r, bump), cube_point(face, n, i + 1, j, r, bump),
                         cube_point(face, n, i + 1, j + 1, r, bump), cube_point(face, n, i, j + 1, r, bump));
}

static void soup(metro_scene *scene, metro_rng *rng, int count, double size)
{
    int i;
    for (i = 0; i < count; i++) {
        metro_vec3 c = in_box(rng, 1), a = in_box(rng, size), b = in_box(rng, size);
        add(scene, c, metro_add(c, a), metro_add(c, b));
    }
}

static void build(metro_scene *scene) { CHECK(metro_scene_build(scene) == METRO_OK, "cannot build"); }

static metroi_bvh *tree(const metro_scene *scene) { return (metroi_bvh *)scene->bvh; }

/* ---- Truth */

static metro_vec3 corner(const metro_scene *scene, uint32_t triangle, int k)
{
    const float *p = scene->corner + 9 * (size_t)triangle + 3 * k;
    return vec((double)p[0], (double)p[1], (double)p[2]);
}

/* Moller and Trumbore in double. `edge` is how far the ray is inside, in barycentric units: negative outside. */
static int moller_trumbore(const metro_scene *scene, uint32_t triangle, metro_vec3 o, metro_vec3 d, double *t,
                           double *edge)
{
    metro_vec3 p0 = corner(scene, triangle, 0), e1 = metro_subtract(corner(scene, triangle, 1), p0);
    metro_vec3 e2 = metro_subtract(corner(scene, triangle, 2), p0), p = metro_cross(d, e2);
    metro_vec3 s = metro_subtract(o, p0), q = metro_cross(s, e1);
    double det = metro_dot(e1, p), u = metro_dot(s, p) / det, v = metro_dot(d, q) / det;
    *t = metro_dot(e2, q) / det;
    *edge = fmin(fmin(u, v), 1 - u - v);
    return det != 0 && *edge >= 0;
}

/* The nearest hit by the chapter's own test of every triangle, one block after the other, without a box. */
static int loop_hit(const metro_scene *scene, metro_vec3 o, metro_vec3 d, double t_min, double t_max, metro_hit *hit)
{
    const metroi_bvh *bvh = tree(scene);
    metroi_ray ray;
    metroi_lanes lanes;
    size_t i;
    if (!metroi_ray_make(bvh, o, d, t_min, t_max, &ray)) return 0;
    for (i = 0; i < bvh->block_count; i++) {
        unsigned mask = metroi_block_plain(&bvh->blocks[i], &ray, &lanes);
        if (mask != 0) metroi_ray_take(&ray, &bvh->blocks[i], &lanes, mask);
    }
    if (ray.triangle == UINT32_MAX) return 0;
    hit->t = (ray.start + (double)ray.t) * ray.unit;
    hit->u = (double)(ray.v / ray.det);
    hit->v = (double)(ray.w / ray.det);
    hit->triangle = ray.triangle;
    return 1;
}

static int same_hit(const metro_hit *a, const metro_hit *b)
{
    return a->t == b->t && a->u == b->u && a->v == b->v && a->triangle == b->triangle;
}

/* Asks all traversals that this machine has; they must agree. Returns what they say. */
static int hit_all(const metro_scene *scene, metro_vec3 o, metro_vec3 d, double t_min, double t_max, metro_hit *hit)
{
    metroi_bvh *bvh = tree(scene);
    metroi_path best = bvh->path;
    int found = metro_scene_hit(scene, o, d, t_min, t_max, hit), path;
    for (path = METROI_PLAIN; path <= (int)best; path++) {
        metro_hit other = { 0, 0, 0, 0 };
        int again, any;
        bvh->path = (metroi_path)path;
        again = metro_scene_hit(scene, o, d, t_min, t_max, &other);
        any = metro_scene_occluded(scene, o, d, t_min, t_max);
        CHECK(again == found && any == found && (!found || same_hit(hit, &other)),
              "path %d of %d: %d %d %d, t %.9g or %.9g, triangle %u or %u", path, (int)best, found, again, any,
              hit->t, other.t, (unsigned)hit->triangle, (unsigned)other.triangle);
        if (check_global.failures_in_case > 5) break;
    }
    bvh->path = best;
    return found;
}

static double rays_asked(void)
{
    const char *text = getenv("METRO_BVH_RAYS");
    double rays = text != NULL ? atof(text) : 0;
    return rays >= 1 ? rays : 1e6;
}

/* ---- Cases */

static void agrees_with_double(void)
{
    static const double size[4] = { 0.02, 0.2, 1, 5 };
    metro_rng rng = metro_rng_make(1, 0);
    int k;
    for (k = 0; k < 4; k++) {
        metro_scene scene = { 0 };
        uint64_t i, n = check_count(3000, 1000), hits = 0;
        soup(&scene, &rng, k == 0 ? 3000 : k == 1 ? 500 : 60, size[k]);
        build(&scene);
        for (i = 0; i < n; i++) {
            metro_vec3 o = as_float(in_box(&rng, 1.5)), d = in_box(&rng, 1);
            metro_hit hit = { 0, 0, 0, 0 };
            double nearest = INFINITY, t, edge;
            int found = hit_all(&scene, o, d, 0, INFINITY, &hit), sure = 0;
            uint32_t j;
            for (j = 0; j < scene.triangle_count; j++)
                if (moller_trumbore(&scene, j, o, d, &t, &edge) && t > 0 && t < nearest) {
                    nearest = t;
                    sure = edge > 1e-4 && t > 1e-4;
                }
            hits += (uint64_t)found;
            if (sure && !found) CHECK(0, "missed a triangle at t = %g", nearest);
            if (!found) continue;
            (void)moller_trumbore(&scene, hit.triangle, o, d, &t, &edge);
            CHECK(edge > -1e-4, "hits triangle %u, which is %g outside", (unsigned)hit.triangle, -edge);
            CHECK(!sure || hit.t < nearest + 2e-6 * (1 + size[k]) / metro_length(d), "t = %.9g, nearest %.9g", hit.t,
                  nearest);
            if (edge > 1e-3) {
                metro_vec3 p0 = corner(&scene, hit.triangle, 0), p = metro_add(o, metro_scale(d, hit.t)), q;
                q = metro_add(p0, metro_scale(metro_subtract(corner(&scene, hit.triangle, 1), p0), hit.u));
                q = metro_add(q, metro_scale(metro_subtract(corner(&scene, hit.triangle, 2), p0), hit.v));
                CHECK(metro_length(metro_subtract(p, q)) < 3e-4 * (1 + size[k]), "t and (u, v) are %g apart",
                      metro_length(metro_subtract(p, q)));
            }
        }
        CHECK(hits > n / 200, "only %g hits", (double)hits);
        metro_scene_free(&scene);
    }
}

/* A ray at something that rounding has to decide: a vertex, a point on an edge, along an axis, or anywhere. */
static void hard_ray(const metro_scene *scene, metro_rng *rng, double r, metro_vec3 *o, metro_vec3 *d)
{
    uint32_t triangle = (uint32_t)(metro_rng_uniform(rng) * (double)scene->triangle_count);
    metro_vec3 a = corner(scene, triangle, 0), b = corner(scene, triangle, 1), to;
    double f = metro_rng_uniform(rng);
    int kind = (int)(8 * metro_rng_uniform(rng));
    to = kind < 3 ? a : metro_add(metro_scale(a, 1 - f), metro_scale(b, f));
    *o = in_box(rng, r);
    if (kind & 1) *o = as_float(*o);
    *d = metro_subtract(to, *o);
    if (kind == 6) *d = in_box(rng, 1);
    if (kind == 7) { /* from beside the vertex along an axis, to it */
        *o = a;
        if (f < 0.33) o->x = 0;
        else if (f < 0.66) o->y = 0;
        else o->z = 0;
        *d = metro_subtract(a, *o);
    }
}

static void bits_of_scene(metro_scene *scene, double r, uint64_t rays, uint64_t loops, uint64_t seed)
{
    metro_rng rng = metro_rng_make(seed, 0);
    uint64_t i;
    build(scene);
    for (i = 0; i < rays && check_global.failures_in_case < 5; i++) {
        metro_hit hit = { 0, 0, 0, 0 }, other = { 0, 0, 0, 0 };
        metro_vec3 o, d;
        double t_max = i % 4 == 3 ? uniform(&rng, 0, 2) : INFINITY;
        int found;
        hard_ray(scene, &rng, r, &o, &d);
        found = hit_all(scene, o, d, 0, t_max, &hit);
        if (i < loops) {
            int again = loop_hit(scene, o, d, 0, t_max, &other);
            CHECK(found == again && (!found || same_hit(&hit, &other)),
                  "the loop: %d %d, t %.9g %.9g, triangle %u %u", found, again, hit.t, other.t,
                  (unsigned)hit.triangle, (unsigned)other.triangle);
        }
    }
    metro_scene_free(scene);
}

/* All traversals and the loop over all triangles give the same bits. Fails when near and far are padded alike for
   nodes and triangles, when the best so far is compared without t_near, and when ties go to the first found. */
static void traversals_agree(void)
{
    double rays = rays_asked();
    metro_rng rng = metro_rng_make(2, 0);
    metro_scene scene = { 0 };
    soup(&scene, &rng, 300, 1.5);
    bits_of_scene(&scene, 1.2, check_count(rays * 0.2, 1000), check_count(20000, 500), 3);
    soup(&scene, &rng, 20000, 0.05);
    bits_of_scene(&scene, 1.2, check_count(rays * 0.2, 1000), check_count(200, 10), 4);
    cube(&scene, 1, 1, 0);
    cube(&scene, 1, 0.3, 0);
    bits_of_scene(&scene, 0.99, check_count(rays * 0.2, 1000), check_count(200000, 500), 5);
    cube(&scene, 20, 1, 0);
    ball(&scene, vec(0, 0, 0), 0.3, 20);
    bits_of_scene(&scene, 0.99, check_count(rays * 0.2, 1000), check_count(2000, 50), 6);
    cube(&scene, 40, 1, 0.03);
    ball(&scene, vec(0.2, 0.1, 0), 0.3, 30);
    bits_of_scene(&scene, 0.9, check_count(rays * 0.2, 1000), check_count(1000, 20), 7);
}

/* Rays from inside a closed mesh at its vertices and edges; `convex`: and nothing may be hit behind the target. */
static void leaks_of_scene(metro_scene *scene, double r, int convex, uint64_t rays, uint64_t seed)
{
    metro_rng rng = metro_rng_make(seed, 0);
    metroi_path best;
    uint64_t i, leaks = 0;
    build(scene);
    best = tree(scene)->path;
    for (i = 0; i < rays; i++) {
        uint32_t triangle = (uint32_t)(metro_rng_uniform(&rng) * (double)scene->triangle_count);
        int k = (int)(3 * metro_rng_uniform(&rng)), found;
        metro_vec3 a = corner(scene, triangle, k), b = corner(scene, triangle, (k + 1) % 3), o = in_box(&rng, r), d;
        double f = i % 3 == 0 ? 0 : metro_rng_uniform(&rng);
        metro_hit hit = { 0, 0, 0, 0 };
        if (i % 2) o = as_float(o);
        if (i % 16 == 5) o.x = o.y = 0;
        if (i % 16 == 9 && fabs(a.x) < 0.7 * r && fabs(a.y) < 0.7 * r) o.x = a.x, o.y = a.y;
        d = metro_subtract(metro_add(metro_scale(a, 1 - f), metro_scale(b, f)), o);
        tree(scene)->path = (metroi_path)(i % ((uint64_t)best + 1));
        found = metro_scene_hit(scene, o, d, 0, INFINITY, &hit);
        if (!found || (convex && hit.t > 1.001)) leaks++;
        if (i % 8 == 0 && !metro_scene_occluded(scene, o, d, 0, INFINITY)) leaks++;
    }
    CHECK(leaks == 0, "%g of %g rays leak", (double)leaks, (double)rays);
    metro_scene_free(scene);
}

/* Fails when the pads are 1, when products are fused, when 0 counts as outside, and when a component of 0 loses a
   box. */
static void closed_scenes_do_not_leak(void)
{
    double rays = rays_asked();
    metro_scene scene = { 0 };
    cube(&scene, 1, 1, 0);
    leaks_of_scene(&scene, 0.999, 1, check_count(rays * 0.15, 1000), 11);
    cube(&scene, 13, 1, 0);
    leaks_of_scene(&scene, 0.999, 1, check_count(rays * 0.15, 1000), 12);
    ball(&scene, vec(0, 0, 0), 1, 15);
    leaks_of_scene(&scene, 0.5, 1, check_count(rays * 0.15, 1000), 13);
    ball(&scene, vec(0, 0, 0), 1000, 100);
    leaks_of_scene(&scene, 500, 1, check_count(rays * 0.15, 1000), 14);
    cube(&scene, 30, 1, 0.04);
    leaks_of_scene(&scene, 0.85, 0, check_count(rays * 0.2, 1000), 15);
    ball(&scene, vec(100, 50, -70), 1, 40);
    { /* far from the origin of coordinates: rays are moved there */
        metro_rng rng = metro_rng_make(16, 0);
        uint64_t i, n = check_count(rays * 0.1, 1000), leaks = 0;
        build(&scene);
        for (i = 0; i < n; i++) {
            metro_vec3 o = metro_add(vec(100, 50, -70), in_box(&rng, 0.5));
            metro_hit hit;
            uint32_t triangle = (uint32_t)(metro_rng_uniform(&rng) * (double)scene.triangle_count);
            if (!metro_scene_hit(&scene, o, metro_subtract(corner(&scene, triangle, 0), o), 0, INFINITY, &hit))
                leaks++;
        }
        CHECK(leaks == 0, "%g of %g rays leak", (double)leaks, (double)n);
        metro_scene_free(&scene);
    }
}

static metro_vec3 turned(metro_vec3 p) /* by the rotation with the rows (1, 2, 2), (2, 1, -2), (2, -2, 1), over 3 */
{
    return vec((p.x + 2 * p.y + 2 * p.z) / 3, (2 * p.x + p.y - 2 * p.z) / 3, (2 * p.x - 2 * p.y + p.z) / 3);
}

/* Rays that begin close to an edge between two large triangles and pass it as near as floats can tell, where the far
   corners are rounded more than the hit is away; with walls along the axes and turned. Fails when the box of a
   triangle has no margin. */
static void edges_near_by_do_not_leak(void)
{
    metro_rng rng = metro_rng_make(17, 0);
    uint64_t i, n = check_count(rays_asked() / 2, 20000);
    int turn, face, k;
    for (turn = 0; turn < 2; turn++) {
        metro_scene scene = { 0 };
        metroi_path best;
        uint64_t leaks = 0;
        for (face = 0; face < 6; face++) {
            metro_vec3 p[4];
            for (k = 0; k < 4; k++) p[k] = cube_point(face, 1, k == 1 || k == 2, k >= 2, 1, 0);
            for (k = 0; k < 4 && turn; k++) p[k] = turned(p[k]);
            add_quad(&scene, p[0], p[1], p[2], p[3]);
        }
        build(&scene);
        best = tree(&scene)->path;
        for (i = 0; i < n; i++) {
            double near_by = pow(10, -uniform(&rng, 1, 4)), along = uniform(&rng, -0.9, 0.9);
            metro_vec3 to = vec(1 + uniform(&rng, -2e-7, 2e-7), 1 + uniform(&rng, -2e-7, 2e-7), along), o = to;
            metro_hit hit;
            o.x -= near_by * uniform(&rng, 0.01, 1); /* not so close that floats put it on the wall */
            o.y -= near_by * uniform(&rng, 0.01, 1);
            o.z -= uniform(&rng, -near_by, near_by);
            if (turn) o = turned(o), to = turned(to);
            if (i % 2) o = as_float(o);
            tree(&scene)->path = (metroi_path)(i % ((uint64_t)best + 1));
            leaks += !metro_scene_hit(&scene, o, metro_subtract(to, o), 0, INFINITY, &hit);
        }
        CHECK(leaks == 0, "%g of %g rays leak, turn %d", (double)leaks, (double)n, turn);
        metro_scene_free(&scene);
    }
}

static void nothing_to_hit(void)
{
    metro_scene scene = { 0 };
    metro_hit hit = { 7, 8, 9, 10 };
    CHECK(!metro_scene_hit(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, INFINITY, &hit), "an empty scene is hit");
    CHECK(!metro_scene_occluded(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, INFINITY), "an empty scene occludes");
    build(&scene);
    CHECK(!metro_scene_hit(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, INFINITY, &hit), "an empty scene is hit");
    metro_scene_free(&scene);
    add(&scene, vec(-1, -1, 1), vec(1, -1, 1), vec(0, 1, 1));
    CHECK(!metro_scene_hit(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, INFINITY, &hit), "hit before the build");
    build(&scene);
    CHECK(metro_scene_build(&scene) == METRO_OK, "a second build is refused");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, -1), 0, INFINITY, &hit), "hit behind the origin");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, 0), 0, INFINITY, &hit), "hit without a direction");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(-0.0, 0, -0.0), 0, INFINITY, &hit), "hit without a direction");
    CHECK(!hit_all(&scene, vec(0, NAN, 0), vec(0, 0, 1), 0, INFINITY, &hit), "hit from NaN");
    CHECK(!hit_all(&scene, vec(INFINITY, 0, 0), vec(0, 0, 1), 0, INFINITY, &hit), "hit from infinity");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(NAN, 0, 1), 0, INFINITY, &hit), "hit along NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, NAN, 1), 0, INFINITY, &hit), "hit along NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(NAN, NAN, 1), 0, INFINITY, &hit), "hit along two NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, NAN), 0, INFINITY, &hit), "hit along NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, INFINITY), 0, INFINITY, &hit), "hit along infinity");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, 1), NAN, INFINITY, &hit), "hit after NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, NAN, &hit), "hit before NaN");
    CHECK(!hit_all(&scene, vec(0, 0, 0), vec(0, 0, 1), 2, 0.5, &hit), "hit in an empty interval");
    CHECK(hit.t == 7 && hit.u == 8 && hit.v == 9 && hit.triangle == 10, "a miss writes");
    CHECK(hit_all(&scene, vec(0, 0, 0), vec(0, 0, 1), 0, INFINITY, &hit) && hit.t == 1, "one triangle is missed");
    CHECK(hit_all(&scene, vec(0, 0, 2), vec(0, 0, -1), 0, INFINITY, &hit) && hit.t == 1, "its back is missed");
    metro_scene_free(&scene);
    metro_scene_free(&scene);
    metro_scene_free(NULL);
    CHECK(metro_scene_build(NULL) == METRO_ERROR_ARGUMENT, "NULL is built");
}

/* t is 1 exactly here, so each bound can be tried on both sides of it. */
static void bounds_are_strict(void)
{
    metro_scene scene = { 0 };
    metro_hit hit = { 0, 0, 0, 0 };
    metro_vec3 o = vec(0.1, 0.2, 0), d = vec(0, 0, 1);
    add_quad(&scene, vec(-1, -1, 1), vec(1, -1, 1), vec(1, 1, 1), vec(-1, 1, 1));
    build(&scene);
    CHECK(!hit_all(&scene, o, d, 0, 1, &hit), "t_max is not strict");
    CHECK(hit_all(&scene, o, d, 0, nextafter(1, 2), &hit) && hit.t == 1, "t_max is too strict");
    CHECK(!hit_all(&scene, o, d, 1, 2, &hit), "t_min is not strict");
    CHECK(hit_all(&scene, o, d, nextafter(1, 0), 2, &hit) && hit.t == 1, "t_min is too strict");
    CHECK(hit_all(&scene, o, vec(0, 0, -1), -2, 5, &hit) && hit.t == -1, "no hit before 0");
    CHECK(hit_all(&scene, o, vec(0, 0, -1), -INFINITY, INFINITY, &hit), "no hit from -infinity");
    CHECK_NEAR(hit.t, -1.0, 1e-6);
    CHECK(!hit_all(&scene, o, vec(0, 0, -1), -1, 5, &hit), "a negative t_min is not strict");
    CHECK(hit_all(&scene, o, vec(0, 0, -1), -1.0000001, -0.9999999, &hit), "a narrow interval is missed");
    CHECK(!hit_all(&scene, o, vec(0, 0, -1), -5, -1, &hit), "a negative t_max is not strict");
    {
        metro_rng rng = metro_rng_make(21, 0);
        uint64_t i, n = check_count(20000, 500);
        for (i = 0; i < n; i++) {
            metro_vec3 from = in_box(&rng, 0.9),
                       to = metro_subtract(vec(uniform(&rng, -0.9, 0.9), uniform(&rng, -0.9, 0.9), 1), from);
            double t;
            if (!hit_all(&scene, from, to, 0, INFINITY, &hit)) continue;
            t = hit.t;
            CHECK(!hit_all(&scene, from, to, 0, t, &hit), "t_max is not strict at %.17g", t);
            CHECK(hit_all(&scene, from, to, 0, nextafter(t, 2), &hit) && hit.t == t, "t_max is too strict at %.17g",
                  t);
            CHECK(!hit_all(&scene, from, to, t, 2, &hit), "t_min is not strict at %.17g", t);
            CHECK(hit_all(&scene, from, to, nextafter(t, 0), 2, &hit) && hit.t == t, "t_min is too strict at %.17g",
                  t);
        }
    }
    metro_scene_free(&scene);
}

static void ties_go_to_the_lowest(void)
{
    metro_scene scene = { 0 };
    metro_hit hit = { 0, 0, 0, 0 };
    int i, j, k;
    for (k = 0; k < 40; k++) { /* the same quad over and over, with others in between */
        add(&scene, vec(-1, -1, 2), vec(1, -1, 2), vec(0, 1, 2));
        add_quad(&scene, vec(-1, -1, 1), vec(1, -1, 1), vec(1, 1, 1), vec(-1, 1, 1));
    }
    build(&scene);
    CHECK(hit_all(&scene, vec(0.5, -0.5, 0), vec(0, 0, 1), 0, 9, &hit) && hit.triangle == 1, "%u of equals",
          (unsigned)hit.triangle);
    CHECK(hit_all(&scene, vec(0, -0.5, 9), vec(0, 0, -1), 0, 7.5, &hit) && hit.triangle == 0, "%u of equals",
          (unsigned)hit.triangle);
    metro_scene_free(&scene);
    for (i = 0; i < 16; i++) /* a grid, seen straight on at its vertices: up to six triangles meet there */
        for (j = 0; j < 16; j++)
            add_quad(&scene, vec(i, j, 1), vec(i + 1, j, 1), vec(i + 1, j + 1, 1), vec(i, j + 1, 1));
    build(&scene);
    for (i = 0; i <= 16; i++)
        for (j = 0; j <= 16; j++) {
            uint32_t lowest = 0, t;
            for (t = 0; t < scene.triangle_count; t++) {
                int has = 0;
                for (k = 0; k < 3; k++) has |= corner(&scene, t, k).x == i && corner(&scene, t, k).y == j;
                if (has) break;
            }
            lowest = t;
            CHECK(hit_all(&scene, vec(i, j, 0), vec(0, 0, 1), 0, 9, &hit), "the vertex (%d, %d) is missed", i, j);
            CHECK(hit.triangle == lowest && hit.t == 1, "vertex (%d, %d): triangle %u, not %u", i, j,
                  (unsigned)hit.triangle, (unsigned)lowest);
        }
    metro_scene_free(&scene);
}

/* Directions of any length, scenes of any size, origins near and far. */
static void any_scale(void)
{
    static const double length[7] = { 1e-300, 1e-200, 1e-30, 1, 1e30, 1e200, 1e300 };
    static const double size[7] = { 1e-30, 1e-8, 1e-4, 1, 1e4, 1e8, 1e30 };
    metro_rng rng = metro_rng_make(31, 0);
    int i, s, l;
    for (s = 0; s < 7; s++) {
        metro_scene scene = { 0 };
        cube(&scene, 4, size[s], 0);
        build(&scene);
        for (i = 0; i < 200; i++) {
            metro_vec3 o = in_box(&rng, 0.9 * size[s]), d = metro_normalize(in_box(&rng, 1));
            metro_hit unit, hit;
            if (!hit_all(&scene, o, d, 0, INFINITY, &unit)) {
                CHECK(0, "a ray leaves the cube of size %g", size[s]);
                break;
            }
            CHECK(unit.t > 0.09 * size[s] && unit.t < 3.5 * size[s], "t = %g in a cube of size %g", unit.t, size[s]);
            for (l = 0; l < 7; l++) {
                double t = unit.t / length[l];
                int found = hit_all(&scene, o, metro_scale(d, length[l]), 0, INFINITY, &hit);
                if (!(t < 1e305 && t > 1e-290)) continue;
                CHECK(found, "a direction of length %g hits nothing in a cube of size %g", length[l], size[s]);
                if (found) CHECK_NEAR(hit.t, t, 1e-6);
            }
            for (l = 1; l < 10; l++) { /* the same from far outside, in lengths of the distance */
                double far_off = pow(10, l);
                metro_vec3 from = metro_add(o, metro_scale(d, -far_off * size[s]));
                CHECK(hit_all(&scene, from, d, 0, INFINITY, &hit), "missed from %g sizes away", far_off);
                CHECK(hit.t < (far_off + 4) * size[s] && hit.t > (far_off - 4) * size[s], "t = %g from %g sizes away",
                      hit.t / size[s], far_off);
            }
        }
        metro_scene_free(&scene);
    }
}

/* Bad triangles beside good ones: the good ones are hit as if the bad were not there. */
static void bad_neighbours(void)
{
    metro_rng rng = metro_rng_make(41, 0);
    metro_scene scene = { 0 };
    metro_hit hit = { 0, 0, 0, 0 };
    uint32_t good;
    int i, tiny_hits = 0;
    for (i = 0; i < 300; i++) {
        metro_vec3 p = in_box(&rng, 1), q = in_box(&rng, 1);
        add(&scene, p, p, p);                                 /* a point */
        add(&scene, p, q, p);                                 /* a line, twice covered */
        add(&scene, p, metro_scale(metro_add(p, q), 0.5), q); /* three points in a line */
        add(&scene, vec(NAN, 3e38, 0), p, q);
        add(&scene, p, vec(0, INFINITY, 3e38), q);
        add(&scene, p, q, vec(0, 0, -INFINITY));
        add(&scene, metro_scale(p, 1e-8), metro_scale(q, 1e-8), vec(1e-8, 0, 0));
    }
    add(&scene, vec(-1e8, -1e8, 5), vec(1e8, -1e8, 5), vec(0, 1e8, 5)); /* huge, behind all others */
    good = (uint32_t)scene.triangle_count;
    cube(&scene, 5, 2, 0);
    for (i = 0; i < 200; i++)
        add(&scene, vec(-1, -1, 1.5), vec(1, -1, 1.5), vec(0, 1, 1.5)); /* duplicates, coplanar */
    build(&scene);
    for (i = 0; i < 2000; i++) {
        metro_vec3 o = in_box(&rng, 1.99), d = in_box(&rng, 1);
        if (!hit_all(&scene, o, d, 0, INFINITY, &hit)) {
            CHECK(0, "a ray leaves the cube");
            break;
        }
        CHECK(hit.triangle >= good, "hits the bad triangle %u", (unsigned)hit.triangle);
        CHECK(hit.t > 0 && hit.u > -1e-6 && hit.v > -1e-6 && hit.u + hit.v < 1.000001, "t %g, u %g, v %g", hit.t,
              hit.u, hit.v);
    }
    CHECK(hit_all(&scene, vec(0, 0, 0), vec(0, 0, 1), 0.1, INFINITY, &hit) && hit.triangle == good + 300,
          "of equals triangle %u", (unsigned)hit.triangle);
    CHECK(hit_all(&scene, vec(0, 0, 3), vec(0, 0, 1), 0, INFINITY, &hit) && hit.triangle == good - 1,
          "the huge triangle is missed");
    CHECK(hit_all(&scene, vec(5e7, -9e7, 3), vec(0, 0, 1), 0, INFINITY, &hit) && hit.triangle == good - 1,
          "the huge triangle is missed far out");
    metro_scene_free(&scene);
    for (i = 0; i < 50; i++)
        add(&scene, metro_scale(in_box(&rng, 1), 1e-8), metro_scale(in_box(&rng, 1), 1e-8), vec(0, 0, 1e-8));
    build(&scene);
    for (i = 0; i < 1000; i++) {
        metro_vec3 to = metro_scale(in_box(&rng, 0.3), 1e-8);
        tiny_hits += hit_all(&scene, vec(0.3e-8, 2e-8, -3e-8), metro_subtract(to, vec(0.3e-8, 2e-8, -3e-8)), 0,
                             INFINITY, &hit);
    }
    CHECK(tiny_hits > 900, "of triangles 1e-8 large only %d of 1000 are hit", tiny_hits);
    metro_scene_free(&scene);
}

/* Heaps that no cut divides, or that a cut divides badly: depth stays bounded, and all can be found. */
static void deep_trees(void)
{
    metro_rng rng = metro_rng_make(51, 0);
    metro_scene scene = { 0 };
    metro_hit hit = { 0, 0, 0, 0 };
    uint64_t i, n = check_count(100000, 3000);
    for (i = 0; i < n; i++) add(&scene, vec(0, 0, 1), vec(1, 0, 1), vec(0, 1, 1)); /* all the same */
    build(&scene);
    CHECK(hit_all(&scene, vec(0.2, 0.2, 0), vec(0, 0, 1), 0, 9, &hit) && hit.triangle == 0,
          "the first of equals is %u", (unsigned)hit.triangle);
    metro_scene_free(&scene);
    for (i = 0; i < 2000; i++) { /* each half as large as the one before, down to nothing, and again */
        double s = pow(0.5, (double)(i % 140));
        add(&scene, vec(s, 0, 0), vec(2 * s, s, 0), vec(2 * s, -s, 0.1 * s));
    }
    build(&scene);
    for (i = 0; i < 140; i++) {
        double s = pow(0.5, (double)i);
        if (s < 1e-17) continue; /* below, areas are smaller than floats */
        CHECK(hit_all(&scene, vec(1.5 * s, 0, 0.3 * s), vec(0, 0, -1), 0, 9, &hit), "size %g is missed", s);
    }
    metro_scene_free(&scene);
    for (i = 0; i < 3000; i++) { /* long needles through one point */
        metro_vec3 d = metro_normalize(in_box(&rng, 1)), e = metro_scale(in_box(&rng, 1), 1e-3);
        add(&scene, d, metro_add(metro_scale(d, -1), e), metro_subtract(metro_scale(d, -1), e));
    }
    bits_of_scene(&scene, 1.5, check_count(2000, 100), check_count(2000, 100), 52);
}

/* Components of +0 and -0, origins on the planes of boxes and triangles, rays that run within a plane. */
static void zero_components(void)
{
    static const double zero[2] = { 0.0, -0.0 };
    metro_scene scene = { 0 };
    metro_hit hit = { 0, 0, 0, 0 };
    int axis, i, j, k, sign;
    cube(&scene, 4, 1, 0);
    build(&scene);
    for (axis = 0; axis < 3; axis++)
        for (sign = -1; sign <= 1; sign += 2)
            for (i = 0; i <= 8; i++)
                for (j = 0; j <= 8; j++)
                    for (k = 0; k < 4; k++) {
                        double o[3], d[3];
                        o[axis] = 0;
                        o[(axis + 1) % 3] = -1 + 0.25 * i; /* on vertices, on edges, in the plane of the wall */
                        o[(axis + 2) % 3] = -1 + 0.25 * j;
                        d[axis] = sign;
                        d[(axis + 1) % 3] = zero[k & 1];
                        d[(axis + 2) % 3] = zero[k / 2];
                        CHECK(hit_all(&scene, vec(o[0], o[1], o[2]), vec(d[0], d[1], d[2]), 0, INFINITY, &hit) &&
                                  hit.t == 1,
                              "axis %d, (%d, %d): t = %g", axis, i, j, hit.t);
                    }
    metro_scene_free(&scene);
    for (i = -8; i < 8; i++) /* a floor at 0; rays within it hit at most edges, and end */
        for (j = -8; j < 8; j++)
            add_quad(&scene, vec(i, 0, j), vec(i + 1, 0, j), vec(i + 1, 0, j + 1), vec(i, 0, j + 1));
    add_quad(&scene, vec(9, -1, -9), vec(9, 1, -9), vec(9, 1, 9), vec(9, -1, 9));
    build(&scene);
    for (i = -8; i < 8; i++) {
        CHECK(hit_all(&scene, vec(-20, 0, i), vec(1, 0, 0), 0, INFINITY, &hit),
              "the wall behind a floor edge-on is missed");
        CHECK(hit_all(&scene, vec(-20, 0, i + 0.3), vec(1, -0.0, 0.01), 0, INFINITY, &hit),
              "the wall behind a floor edge-on is missed");
        CHECK(hit_all(&scene, vec(0.5, 0, i), vec(1, 0, 0), 0, INFINITY, &hit),
              "the wall is missed from within the floor");
    }
    metro_scene_free(&scene);
}

static metro_vec3 leave(const metro_scene *scene, uint32_t triangle, metro_vec3 point, metro_vec3 direction)
{
    metroi_facet facet = metroi_facet_of(scene, triangle);
    return metroi_facet_leave(&facet, point, direction);
}

/* A ray that leaves a surface does not hit it. Fails at 1/16 of the height. */
static void leaving_hits_not_oneself(void)
{
    static const double size[5] = { 1e-4, 1e-2, 1, 1e2, 1e4 }, away[4] = { 0, 1, 30, 3000 };
    metro_rng rng = metro_rng_make(61, 0);
    int s, w;
    for (s = 0; s < 5; s++)
        for (w = 0; w < 4; w++) {
            metro_scene scene = { 0 };
            metro_vec3 middle = metro_scale(vec(0.7, -0.4, 0.6), size[s] * away[w]);
            uint64_t i, n = check_count(10000, 300), self = 0, above = 0;
            uint32_t t;
            for (t = 0; t < 60; t++) {
                double width = t % 3 == 0 ? 0.02 : t % 7 == 0 ? 0.001 : 1; /* needles too */
                metro_vec3 a = in_box(&rng, size[s]), e = in_box(&rng, size[s]),
                           f = metro_scale(in_box(&rng, size[s]), width);
                if (t % 4 == 1) a.y = e.y = f.y = 0; /* a floor */
                a = metro_add(a, middle);
                add(&scene, a, metro_add(a, e), metro_add(a, metro_add(metro_scale(e, 0.5), f)));
            }
            build(&scene);
            for (i = 0; i < n; i++) {
                double u = sqrt(metro_rng_uniform(&rng)), v = metro_rng_uniform(&rng), b1 = u * (1 - v), b2 = u * v,
                       up, needle;
                metro_vec3 a, b, c, p, d = metro_normalize(in_box(&rng, 1)), o, normal;
                metro_hit hit;
                t = (uint32_t)(60 * metro_rng_uniform(&rng));
                a = corner(&scene, t, 0), b = corner(&scene, t, 1), c = corner(&scene, t, 2);
                normal = metro_normalize(metro_cross(metro_subtract(b, a), metro_subtract(c, a)));
                if (i % 3 == 0) { /* flat: 1e-1 to 1e-7 above the plane */
                    d = metro_subtract(d, metro_scale(normal, metro_dot(d, normal)));
                    d = metro_add(metro_normalize(d), metro_scale(normal, pow(10, -uniform(&rng, 1, 7))));
                }
                b1 = rounded(b1), b2 = rounded(b2);
                p = metro_add(metro_scale(a, 1 - b1 - b2), metro_add(metro_scale(b, b1), metro_scale(c, b2)));
                o = leave(&scene, t, p, d);
                up = metro_dot(metro_subtract(o, a), normal) * (metro_dot(d, normal) < 0 ? -1 : 1);
                above += up > 0;
                if (hit_all(&scene, o, d, 0, INFINITY, &hit) && hit.triangle == t) self++;
                needle = metro_length(metro_subtract(b, a)) * metro_length(metro_subtract(b, a));
                needle /= metro_length(metro_cross(metro_subtract(b, a), metro_subtract(c, a)));
                CHECK(metro_length(metro_subtract(o, p)) <
                          1e-5 * (size[s] * (1 + 0.2 * needle) + 0.3 * metro_length(p)),
                      "moved by %g in a scene of size %g at %g", metro_length(metro_subtract(o, p)), size[s],
                      away[w]);
            }
            CHECK(self == 0 && above == n, "size %g at %g: %g of %g hit themselves, %g start above", size[s], away[w],
                  (double)self, (double)n, (double)above);
            metro_scene_free(&scene);
        }
}

/* Contact shadows: a plate 1e-5 of its size above a floor hides the sky from under it; and in a corner of a room a
   ray does not slip out through the other wall. */
static void leaving_keeps_what_is_near(void)
{
    static const double size[3] = { 1e-4, 1, 1e4 };
    metro_rng rng = metro_rng_make(62, 0);
    int s;
    for (s = 0; s < 3; s++) {
        metro_scene scene = { 0 };
        double r = size[s], h = 1e-5 * r;
        uint64_t i, n = check_count(20000, 500), escaped = 0;
        metro_hit hit;
        add_quad(&scene, vec(-r, 0, -r), vec(-r, 0, r), vec(r, 0, r), vec(r, 0, -r));
        add_quad(&scene, vec(-r, h, -r), vec(-r, h, r), vec(r, h, r), vec(r, h, -r));
        build(&scene);
        for (i = 0; i < 1000; i++) {
            metro_vec3 p = vec(uniform(&rng, -0.9 * r, 0.9 * r), 0, uniform(&rng, -0.9 * r, 0.9 * r)),
                       d = vec(0.2, 1, 0.1);
            uint32_t t = p.x < p.z ? 0 : 1;
            CHECK(metro_scene_occluded(&scene, leave(&scene, t, p, d), d, 0, INFINITY),
                  "no contact shadow at size %g", r);
        }
        metro_scene_free(&scene);
        cube(&scene, 3, r, 0);
        build(&scene);
        for (i = 0; i < n; i++) { /* from points as close to an edge of the cube as doubles can tell, or in between */
            uint32_t t = (uint32_t)(metro_rng_uniform(&rng) * (double)scene.triangle_count);
            metro_vec3 a = corner(&scene, t, 0), b = corner(&scene, t, 1), c = corner(&scene, t, 2), p, d, n0;
            double near_by = pow(10, -uniform(&rng, 0, 16)), f = metro_rng_uniform(&rng),
                   side = i % 3 == 0 ? f : 1 - near_by;
            p = metro_add(metro_scale(a, near_by),
                          metro_scale(metro_add(metro_scale(b, side), metro_scale(c, 1 - side)), 1 - near_by));
            n0 = metro_normalize(metro_cross(metro_subtract(b, a), metro_subtract(c, a)));
            if (metro_dot(n0, p) > 0) n0 = metro_scale(n0, -1); /* inwards */
            d = metro_normalize(in_box(&rng, 1));
            if (metro_dot(d, n0) < 0) d = metro_scale(d, -1);
            escaped += !hit_all(&scene, leave(&scene, t, p, d), d, 0, INFINITY, &hit);
        }
        CHECK(escaped == 0, "%g of %g rays from near the edges leave a cube of size %g", (double)escaped, (double)n,
              r);
        metro_scene_free(&scene);
    }
}

static void every_allocation_may_fail(void)
{
    metro_rng rng = metro_rng_make(71, 0);
    metro_scene scene = { 0 };
    long k, needed, live;
    soup(&scene, &rng, 200, 0.2);
    live = allocations_live;
    for (k = 0; k < 50; k++) {
        metro_hit hit;
        allocations_left = k;
        if (metro_scene_build(&scene) == METRO_OK) break;
        allocations_left = -1;
        CHECK(allocations_live == live && scene.bvh == NULL, "allocation %ld leaves something behind", k);
        CHECK(!metro_scene_hit(&scene, vec(0, 0, -5), vec(0, 0, 1), 0, INFINITY, &hit),
              "hit after a build that failed");
    }
    needed = k;
    allocations_left = -1;
    CHECK(needed >= 4 && needed < 50, "%ld allocations", needed);
    CHECK(scene.bvh != NULL, "not built with all allocations");
    metro_scene_free(&scene);
    CHECK(allocations_live == live - 2 || allocations_live == 0, "%ld blocks are left", allocations_live);
}

/* The promise of 150 bytes a triangle: corners and material 40, the rest here. */
static void memory_is_bounded(void)
{
    metro_scene scene = { 0 };
    metro_rng rng = metro_rng_make(81, 0);
    double bytes;
    cube(&scene, 60, 1, 0.03);
    build(&scene);
    bytes =
        (double)(tree(&scene)->node_count * sizeof(metroi_node) + tree(&scene)->block_count * sizeof(metroi_block));
    CHECK(40 + bytes / (double)scene.triangle_count < 105, "a mesh takes %g bytes a triangle",
          40 + bytes / (double)scene.triangle_count);
    metro_scene_free(&scene);
    soup(&scene, &rng, 20000, 0.1);
    build(&scene);
    bytes =
        (double)(tree(&scene)->node_count * sizeof(metroi_node) + tree(&scene)->block_count * sizeof(metroi_block));
    CHECK(40 + bytes / (double)scene.triangle_count < 150, "a soup takes %g bytes a triangle",
          40 + bytes / (double)scene.triangle_count);
    metro_scene_free(&scene);
}

int main(void)
{
    CHECK_RUN(nothing_to_hit);
    CHECK_RUN(agrees_with_double);
    CHECK_RUN(traversals_agree);
    CHECK_RUN(closed_scenes_do_not_leak);
    CHECK_RUN(edges_near_by_do_not_leak);
    CHECK_RUN(bounds_are_strict);
    CHECK_RUN(ties_go_to_the_lowest);
    CHECK_RUN(any_scale);
    CHECK_RUN(bad_neighbours);
    CHECK_RUN(deep_trees);
    CHECK_RUN(zero_components);
    CHECK_RUN(leaving_hits_not_oneself);
    CHECK_RUN(leaving_keeps_what_is_near);
    CHECK_RUN(every_allocation_may_fail);
    CHECK_RUN(memory_is_bounded);
    return check_done("bvh");
}
