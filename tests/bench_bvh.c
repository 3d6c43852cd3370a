/* bench_bvh: rays a second and triangles a second of chapter 10, beside Embree where it is installed.

       cc -O2 tests/bench_bvh.c -lembree3 -lm    races Embree's single rays (libembree-dev), in turns, in one process
       cc -O2 -DNO_EMBREE tests/bench_bvh.c -lm  only measures

   Closed rooms of 40, 20 thousand and 500 thousand triangles; primary rays of a pinhole, diffuse rays from where
   those hit, shadow rays to a lamp. Both sides get the same rays, with float-exact origins and directions. Each takes
   its best of several turns, so that a noisy machine says little. A ratio is our speed over Embree's. */

#define METRO_STATIC
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include <time.h>

#ifndef NO_EMBREE
#if defined(__has_include)
#if !__has_include(<embree3/rtcore.h>)
#define NO_EMBREE
#endif
#endif
#endif
#ifndef NO_EMBREE
#include <embree3/rtcore.h>
#endif

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void add(metro_scene *scene, metro_vec3 a, metro_vec3 b, metro_vec3 c)
{
    metro_vec3 p[3];
    p[0] = a, p[1] = b, p[2] = c;
    if (metro_scene_add_triangle(scene, p, 0) != METRO_OK) abort();
}

static double bump(double x, double y) { return 0.02 * sin(17 * x + 3 * y) * sin(13 * y - 5 * x); }

/* The point at (u, v) in [0,1]^2 of face `face` of the room [-1,1]^3; faces of many triangles are bumpy. */
static metro_vec3 wall_point(int face, int n, int i, int j)
{
    double p[3], u = -1 + 2.0 * i / n, v = -1 + 2.0 * j / n, rim = (1 - u * u) * (1 - v * v);
    int axis = face / 2;
    p[axis] = (face & 1 ? 1 : -1) * (1 - (n > 1 ? rim * (0.03 + bump(u, v)) : 0));
    p[(axis + 1) % 3] = u;
    p[(axis + 2) % 3] = v;
    return metro_vec3_make(p[0], p[1], p[2]);
}

static void walls(metro_scene *scene, int n)
{
    int face, i, j;
    for (face = 0; face < 6; face++)
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++) {
                metro_vec3 a = wall_point(face, n, i, j), b = wall_point(face, n, i + 1, j);
                metro_vec3 c = wall_point(face, n, i + 1, j + 1), d = wall_point(face, n, i, j + 1);
                add(scene, a, b, c);
                add(scene, a, c, d);
            }
}

static metro_vec3 ball_point(metro_vec3 c, double r, int n, int i, int j)
{
    double a = 3.14159265358979 * i / n, b = 6.28318530717959 * (j % (2 * n)) / (2 * n);
    double s = i == 0 || i == n ? 0 : sin(a);
    return metro_add(c, metro_scale(metro_vec3_make(s * cos(b), cos(a), s * sin(b)), r));
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

static void crate(metro_scene *scene, metro_vec3 c, double r, double turn)
{
    static const int face[6][4] = { { 0, 1, 3, 2 }, { 4, 6, 7, 5 }, { 0, 4, 5, 1 },
                                    { 2, 3, 7, 6 }, { 0, 2, 6, 4 }, { 1, 5, 7, 3 } };
    metro_vec3 p[8];
    int i;
    for (i = 0; i < 8; i++) {
        double x = i & 1 ? r : -r, y = i & 2 ? r : -r, z = i & 4 ? r : -r;
        p[i] = metro_add(c, metro_vec3_make(cos(turn) * x - sin(turn) * z, y, sin(turn) * x + cos(turn) * z));
    }
    for (i = 0; i < 6; i++) {
        add(scene, p[face[i][0]], p[face[i][1]], p[face[i][2]]);
        add(scene, p[face[i][0]], p[face[i][2]], p[face[i][3]]);
    }
}

static void room(metro_scene *scene, int size)
{
    static const int wall_n[3] = { 1, 28, 144 }, balls[3] = { 0, 12, 50 }, ball_n[3] = { 0, 18, 36 };
    metro_rng rng = metro_rng_make(7, 0);
    int i;
    walls(scene, wall_n[size]);
    if (size == 0) {
        crate(scene, metro_vec3_make(-0.4, -0.6, -0.3), 0.3, 0.3);
        crate(scene, metro_vec3_make(0.4, -0.7, 0.2), 0.25, 1.0);
        add(scene, metro_vec3_make(-0.2, 0.99, -0.2), metro_vec3_make(0.2, 0.99, -0.2),
            metro_vec3_make(0.2, 0.99, 0.2));
        add(scene, metro_vec3_make(-0.2, 0.99, -0.2), metro_vec3_make(0.2, 0.99, 0.2),
            metro_vec3_make(-0.2, 0.99, 0.2));
        add(scene, metro_vec3_make(0, -0.99, -0.9), metro_vec3_make(0.3, -0.5, -0.9),
            metro_vec3_make(0.2, 0.2, -0.8));
        add(scene, metro_vec3_make(0.7, -0.99, 0.9), metro_vec3_make(0.9, -0.5, 0.9), metro_vec3_make(0.7, 0.2, 0.8));
    }
    for (i = 0; i < balls[size]; i++) {
        double x = metro_rng_uniform(&rng), y = metro_rng_uniform(&rng), z = metro_rng_uniform(&rng);
        ball(scene, metro_vec3_make(1.6 * x - 0.8, 1.4 * y - 0.8, 1.3 * z - 0.8), size == 1 ? 0.18 : 0.12,
             ball_n[size]);
    }
}

/* ---- Rays */

typedef struct {
    metro_vec3 origin, direction;
    double t_max;
} bench_ray;

enum { SIDE = 512, RAYS = SIDE * SIDE };

static double as_float(double x)
{
    volatile float f = (float)x; /* gcc 12 leaves the conversions of pairs out */
    return (double)f;
}

static void ray_set(bench_ray *ray, metro_vec3 o, metro_vec3 d, double t_max)
{
    ray->origin = metro_vec3_make(as_float(o.x), as_float(o.y), as_float(o.z));
    ray->direction = metro_vec3_make(as_float(d.x), as_float(d.y), as_float(d.z));
    ray->t_max = t_max;
}

static metro_vec3 cosine_direction(metro_vec3 n, metro_rng *rng)
{
    double z = 2 * metro_rng_uniform(rng) - 1, a = 6.283185307179586 * metro_rng_uniform(rng), s = sqrt(1 - z * z);
    return metro_normalize(metro_add(n, metro_vec3_make(0.9999 * s * cos(a), 0.9999 * s * sin(a), 0.9999 * z)));
}

static void make_rays(const metro_scene *scene, bench_ray *primary, bench_ray *diffuse, bench_ray *shadow)
{
    metro_rng rng = metro_rng_make(11, 0);
    int i;
    for (i = 0; i < RAYS; i++) {
        double x = (i % SIDE + metro_rng_uniform(&rng)) / SIDE * 2 - 1,
               y = (i / SIDE + metro_rng_uniform(&rng)) / SIDE * 2 - 1;
        metro_vec3 d = metro_normalize(metro_vec3_make(0.7 * x, -0.7 * y, -1)), n, p, lamp;
        metro_hit hit;
        ray_set(&primary[i], metro_vec3_make(0.05, 0.05, 0.9), d, 1e30);
        if (!metro_scene_hit(scene, primary[i].origin, primary[i].direction, 0, INFINITY, &hit)) abort();
        n = metroi_facet_of(scene, hit.triangle).normal;
        if (metro_dot(n, d) > 0) n = metro_scale(n, -1);
        p = metro_add(primary[i].origin, metro_scale(primary[i].direction, hit.t));
        p = metro_add(p, metro_scale(n, 1e-4));
        ray_set(&diffuse[i], p, cosine_direction(n, &rng), 1e30);
        lamp = metro_vec3_make(0.4 * metro_rng_uniform(&rng) - 0.2, 0.9, 0.4 * metro_rng_uniform(&rng) - 0.2);
        ray_set(&shadow[i], p, metro_subtract(lamp, p), 0.999);
    }
}

static double our_turn(const metro_scene *scene, const bench_ray *ray, int any, double *sum)
{
    double start = now();
    int i;
    for (i = 0; i < RAYS; i++)
        if (any) *sum += metro_scene_occluded(scene, ray[i].origin, ray[i].direction, 0, ray[i].t_max);
        else {
            metro_hit hit;
            if (metro_scene_hit(scene, ray[i].origin, ray[i].direction, 0, ray[i].t_max, &hit)) *sum += hit.t;
        }
    return now() - start;
}

#ifndef NO_EMBREE
static RTCScene embree_scene(RTCDevice device, const metro_scene *scene, int robust, double *seconds)
{
    RTCScene s = rtcNewScene(device);
    RTCGeometry g = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    size_t n = scene->triangle_count, i;
    float *v = (float *)rtcSetNewGeometryBuffer(g, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, 3 * n);
    unsigned *index = (unsigned *)rtcSetNewGeometryBuffer(g, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, n);
    double start;
    memcpy(v, scene->corner, 36 * n);
    for (i = 0; i < 3 * n; i++) index[i] = (unsigned)i;
    rtcCommitGeometry(g);
    rtcAttachGeometry(s, g);
    rtcReleaseGeometry(g);
    if (robust) rtcSetSceneFlags(s, RTC_SCENE_FLAG_ROBUST);
    start = now();
    rtcCommitScene(s);
    *seconds = now() - start;
    return s;
}

static double embree_turn(RTCScene scene, const bench_ray *ray, int any, double *sum)
{
    double start = now();
    struct RTCIntersectContext context;
    int i;
    rtcInitIntersectContext(&context);
    for (i = 0; i < RAYS; i++) {
        struct RTCRayHit q;
        q.ray.org_x = (float)ray[i].origin.x, q.ray.org_y = (float)ray[i].origin.y,
        q.ray.org_z = (float)ray[i].origin.z;
        q.ray.dir_x = (float)ray[i].direction.x, q.ray.dir_y = (float)ray[i].direction.y;
        q.ray.dir_z = (float)ray[i].direction.z;
        q.ray.tnear = 0, q.ray.tfar = (float)ray[i].t_max, q.ray.time = 0, q.ray.mask = ~0u, q.ray.flags = 0;
        if (any) {
            rtcOccluded1(scene, &context, &q.ray);
            *sum += q.ray.tfar < 0;
        } else {
            q.hit.geomID = RTC_INVALID_GEOMETRY_ID;
            q.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
            rtcIntersect1(scene, &context, &q);
            if (q.hit.geomID != RTC_INVALID_GEOMETRY_ID) *sum += (double)q.ray.tfar;
        }
    }
    return now() - start;
}
#endif

enum { PATHS = 3, COLUMNS = 5 };
static const char *const column_name[COLUMNS] = { "plain", "four", "eight", "embree", "robust" };
static const char *const scene_name[3] = { "40", "20k", "500k" };
static const char *const kind_name[3] = { "primary", "diffuse", "shadow" };

int main(int argc, char **argv)
{
    int turns = argc > 1 ? atoi(argv[1]) : 9, size, kind, c, turn;
    int last = argc > 2 ? atoi(argv[2]) : 3;
    double log_sum[PATHS][2], lowest[PATHS];
    bench_ray *ray[3];
    for (c = 0; c < PATHS; c++) log_sum[c][0] = log_sum[c][1] = 0, lowest[c] = 1e9;
    for (kind = 0; kind < 3; kind++) ray[kind] = (bench_ray *)malloc(RAYS * sizeof **ray);
#ifdef NO_EMBREE
    printf("Embree is not compiled in: speeds only, no comparison\n");
#else
    RTCDevice device = rtcNewDevice("threads=1");
#endif
    for (size = 0; size < last; size++) {
        metro_scene scene[PATHS];
        double best[3][COLUMNS], sum[3][COLUMNS], build = 1e9, embree_build = 1e9;
        int path;
        memset(scene, 0, sizeof scene);
        for (path = 0; path < PATHS; path++) room(&scene[path], size);
#ifndef NO_EMBREE
        RTCScene em[2] = { NULL, NULL };
#endif
        for (turn = 0; turn < (turns < 3 ? 1 : 3); turn++) {
            for (path = 0; path < PATHS; path++) {
                double start;
                metroi_bvh_free((metroi_bvh *)scene[path].bvh);
                scene[path].bvh = NULL;
                start = now();
                if (metro_scene_build(&scene[path]) != METRO_OK) return 1;
                start = now() - start;
                ((metroi_bvh *)scene[path].bvh)->path = (metroi_path)path;
                if (start < build) build = start; /* the trees are the same */
            }
#ifndef NO_EMBREE
            for (c = 0; c < 2; c++) {
                double seconds;
                if (em[c] != NULL) rtcReleaseScene(em[c]);
                em[c] = embree_scene(device, &scene[0], c, &seconds);
                if (c == 0 && seconds < embree_build) embree_build = seconds;
            }
#endif
        }
        make_rays(&scene[0], ray[0], ray[1], ray[2]);
        for (kind = 0; kind < 3; kind++)
            for (c = 0; c < COLUMNS; c++) best[kind][c] = 1e9;
        for (turn = 0; turn < turns; turn++)
            for (kind = 0; kind < 3; kind++)
                for (c = 0; c < COLUMNS; c++) {
                    double t = 1e9;
                    sum[kind][c] = 0;
                    if (c < PATHS) t = our_turn(&scene[c], ray[kind], kind == 2, &sum[kind][c]);
#ifndef NO_EMBREE
                    else t = embree_turn(em[c - PATHS], ray[kind], kind == 2, &sum[kind][c]);
#endif
                    if (t < best[kind][c]) best[kind][c] = t;
                }
        {
            const metroi_bvh *b = (const metroi_bvh *)scene[PATHS - 1].bvh;
            size_t n = scene[0].triangle_count;
            printf("room %s: %zu triangles, %.1f bytes a triangle, %zu nodes, %zu blocks, build %.2f M triangles/s",
                   scene_name[size], n,
                   40 + (double)(b->node_count * sizeof(metroi_node) + b->block_count * sizeof(metroi_block)) / n,
                   b->node_count, b->block_count, 1e-6 * n / build);
            if (embree_build < 1e9) printf(" (Embree %.2f)", 1e-6 * n / embree_build);
            printf("\n");
        }
        for (kind = 0; kind < 3; kind++) {
            printf("  %-8s", kind_name[kind]);
            for (c = 0; c < COLUMNS; c++)
                if (best[kind][c] < 1e9) printf(" %s %.2f M/s", column_name[c], 1e-6 * RAYS / best[kind][c]);
            printf("\n           ");
            for (c = 0; c < PATHS && best[kind][3] < 1e9; c++) {
                double a = best[kind][3] / best[kind][c], b = best[kind][4] / best[kind][c];
                printf(" %s %.2f / %.2f  ", column_name[c], a, b);
                log_sum[c][0] += log(a), log_sum[c][1] += log(b);
                if (a < lowest[c]) lowest[c] = a;
            }
            printf(" sums %.9g %.9g %.9g\n", sum[kind][1], sum[kind][2], sum[kind][3]);
        }
        for (path = 0; path < PATHS; path++) metro_scene_free(&scene[path]);
    }
#ifndef NO_EMBREE
    for (c = 0; c < PATHS; c++)
        printf("%s: geometric mean %.3f of Embree's default, %.3f of its robust mode; lowest cell %.2f\n",
               column_name[c], exp(log_sum[c][0] / (3 * last)), exp(log_sum[c][1] / (3 * last)), lowest[c]);
    rtcReleaseDevice(device);
#endif
    return 0;
}
