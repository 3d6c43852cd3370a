/* bench_bundles.c: what does a bundle cost, and what does a second buy? make bench runs it, for half a minute.

   First the milliseconds of one bundle on S1 against patches and grid, for each visibility, the least of five means
   over sixteen directions; then the error of the light that the hidden-lamp room's patches reflect (S2 with Kd + Ks
   for Kd), against a long run, after equal times. One thread but for the last line, which says how much faster two
   are. */

#define _POSIX_C_SOURCE 200809L /* clock_gettime */
#define METRO_IMPLEMENTATION
#include "../metro.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void load(const char *name, int diffuse, metro_scene *scene)
{
    char path[200], message[400];
    size_t i;
    memset(scene, 0, sizeof *scene);
    snprintf(path, sizeof path, "tests/data/%s.obj", name);
    if (metro_scene_load_obj(scene, path, message, sizeof message) != METRO_OK) {
        fprintf(stderr, "%s\n", message);
        exit(1);
    }
    for (i = 0; diffuse && i < scene->material_count; i++) {
        metro_material *material = &scene->material[i];
        material->kd = metro_add(material->kd, material->ks);
        material->ks = metro_vec3_make(0, 0, 0);
    }
    if (metro_scene_build(scene) != METRO_OK) exit(1);
}

/* Milliseconds of a bundle, its memory made before. */
static double bundle_cost(const metro_patches *patches, size_t grid, metro_visibility visibility)
{
    metroi_bundle bundle;
    double least = 1e9;
    size_t i;
    int run, n;
    if (metroi_bundle_make(patches, grid, visibility, 0, &bundle) != METRO_OK) exit(1);
    for (i = 0; i < 4 * patches->count; i++) bundle.radiance[i] = 1;
    for (run = 0; run < 12; run++) {
        metro_rng rng = metro_rng_make(1, 0);
        double start = seconds(), spent;
        for (n = 0; n < 16; n++) {
            double shift[2];
            shift[0] = metro_rng_uniform(&rng);
            shift[1] = metro_rng_uniform(&rng);
            metroi_bundle_move(&bundle, metro_rng_direction(&rng), shift);
        }
        spent = (seconds() - start) / 16;
        if (spent < least) least = spent;
    }
    metroi_bundle_free(&bundle);
    return 1e3 * least;
}

static void costs(void)
{
    const char *name[4] = { "sweep", "fragments", "painter", "lines" };
    const double size[3] = { 0.3, 0.135, 0.0975 };
    metro_scene scene;
    int k, v;
    load("S1", 0, &scene);
    printf("%-12s %8s %10s %10s %10s %10s   ms a bundle\n", "patches", "", "256", "512", "1024", "ratio");
    for (k = 0; k < 3; k++) {
        metro_patches patches;
        if (metro_patches_make(&scene, size[k], &patches) != METRO_OK) exit(1);
        for (v = 0; v < 4; v++) {
            double a = bundle_cost(&patches, 256, (metro_visibility)v);
            double b = bundle_cost(&patches, 512, (metro_visibility)v);
            double c = bundle_cost(&patches, 1024, (metro_visibility)v);
            printf("%-12lu %-9s %9.2f %10.2f %10.2f %10.2f\n", (unsigned long)patches.count, name[v], a, b, c, c / b);
            fflush(stdout);
        }
        metro_patches_free(&patches);
    }
    metro_scene_free(&scene);
}

typedef struct {
    double start, seconds;
} budget;

static int budget_spent(const metro_bundles *bundles, void *user)
{
    const budget *b = (const budget *)user;
    (void)bundles;
    return seconds() - b->start >= b->seconds;
}

static metro_bundles_options options_of(metro_visibility visibility, metro_walk walk, int first_shot)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    options.patch = 0.42;
    options.visibility = visibility;
    options.walk = walk;
    options.first_shot = first_shot;
    options.threads = 1;
    return options;
}

static metro_vec3 *run_for(const metro_scene *scene, const metro_bundles_options *options, double time,
                           metro_bundles *bundles)
{
    metro_vec3 *radiance;
    budget b;
    if (metro_bundles_make(scene, &scene->camera, options, bundles) != METRO_OK) exit(1);
    b.start = seconds();
    b.seconds = time;
    metro_bundles_run(bundles, (uint64_t)1 << 40, budget_spent, &b);
    radiance = (metro_vec3 *)malloc((bundles->patches.count + 1) * sizeof *radiance);
    if (radiance == NULL || metro_bundles_radiance(bundles, radiance, NULL) != METRO_OK) exit(1);
    return radiance;
}

static double relative_error(const metro_bundles *bundles, const metro_vec3 *radiance, const metro_vec3 *truth)
{
    double sum = 0, all = 0;
    size_t i;
    for (i = 0; i < bundles->patches.count; i++) {
        double weight = bundles->share[i] > 0 ? bundles->patches.patch[i].area : 0;
        metro_vec3 d = metro_subtract(radiance[i], truth[i]);
        sum += weight * metro_dot(d, d);
        all += weight * metro_dot(truth[i], truth[i]);
    }
    return sqrt(sum / all);
}

static void errors(double time)
{
    const struct {
        const char *name;
        metro_visibility visibility;
        metro_walk walk;
        int first_shot;
    } contender[] = { { "random", METRO_SWEEP, METRO_WALK_RANDOM, 0 },
                      { "random, lines", METRO_LINES, METRO_WALK_RANDOM, 0 },
                      { "even, lines", METRO_LINES, METRO_WALK_EVEN, 0 },
                      { "metropolis, lines", METRO_LINES, METRO_WALK_METROPOLIS, 0 },
                      { "random, first shot", METRO_SWEEP, METRO_WALK_RANDOM, 1 },
                      { "random, lines, first shot", METRO_LINES, METRO_WALK_RANDOM, 1 },
                      { "even, lines, first shot", METRO_LINES, METRO_WALK_EVEN, 1 } };
    metro_bundles_options options = options_of(METRO_LINES, METRO_WALK_RANDOM, 1);
    metro_scene scene;
    metro_bundles reference, bundles;
    metro_vec3 *truth, *radiance;
    size_t k;
    load("S2", 1, &scene);
    options.seed = 1;
    truth = run_for(&scene, &options, 4 * time, &reference);
    printf("\n%-28s %10s %12s   %lu patches, %g s\n", "S2, diffuse", "walks", "error",
           (unsigned long)reference.patches.count, time);
    for (k = 0; k < sizeof contender / sizeof *contender; k++) {
        options = options_of(contender[k].visibility, contender[k].walk, contender[k].first_shot);
        radiance = run_for(&scene, &options, time, &bundles);
        printf("%-28s %10lu %12.4f\n", contender[k].name, (unsigned long)bundles.walks,
               relative_error(&bundles, radiance, truth));
        fflush(stdout);
        metro_bundles_free(&bundles);
        free(radiance);
    }
    metro_bundles_free(&reference);
    free(truth);
    metro_scene_free(&scene);
}

static void two_threads(void)
{
    metro_scene scene;
    double least[2] = { 1e9, 1e9 };
    int run, t;
    load("S2", 0, &scene);
    for (run = 0; run < 12; run++)
        for (t = 0; t < 2; t++) {
            metro_bundles_options options = options_of(METRO_LINES, METRO_WALK_RANDOM, 1);
            metro_bundles bundles;
            double start;
            options.threads = (size_t)t + 1;
            if (metro_bundles_make(&scene, &scene.camera, &options, &bundles) != METRO_OK) exit(1);
            start = seconds();
            metro_bundles_run(&bundles, 512, NULL, NULL);
            if (seconds() - start < least[t]) least[t] = seconds() - start;
            metro_bundles_free(&bundles);
        }
    printf("\ntwo threads are %.2f times as fast as one\n", least[0] / least[1]);
    metro_scene_free(&scene);
}

int main(int argc, char **argv)
{
    costs();
    errors(argc > 1 ? atof(argv[1]) : 2);
    two_threads();
    return 0;
}
