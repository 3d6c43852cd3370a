/* bench_light.c: how efficient are the methods on the two reference scenes? make bench runs it, for some minutes.

   128 x 128 pixels, paths of up to 8 edges, one thread. Efficiency is 1 / (relMSE x CPU seconds), the noise of the
   reference subtracted; the relMSE is the mean of three seeds. Arguments: seconds (8) and how many seeds (3). */

#define METRO_IMPLEMENTATION
#include "../metro.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

typedef struct {
    const char *name;
    metro_method method;
    int random_numbers, all_connections, one_stage;
    size_t chains;
} contender;

static double cpu_seconds(void)
{
    return (double)clock() / CLOCKS_PER_SEC;
}

typedef struct {
    double start, seconds;
} budget;

static int budget_spent(const metro_render *render, void *user)
{
    const budget *b = (const budget *)user;
    (void)render;
    return cpu_seconds() - b->start >= b->seconds;
}

typedef struct {
    metro_scene scene;
    metro_image reference;
    double noise;
} stage;

static void load_picture(const char *scene, const char *kind, metro_image *image)
{
    char path[200], message[400];
    snprintf(path, sizeof path, "tests/data/%s.%s.pfm", scene, kind);
    if (metro_image_load(path, image, message, sizeof message) == METRO_OK) return;
    fprintf(stderr, "%s\n", message);
    exit(1);
}

static void stage_load(stage *s, const char *name)
{
    char path[200], message[400];
    metro_image variance;
    memset(s, 0, sizeof *s);
    snprintf(path, sizeof path, "tests/data/%s.obj", name);
    if (metro_scene_load_obj(&s->scene, path, message, sizeof message) != METRO_OK ||
        metro_scene_build(&s->scene) != METRO_OK) {
        fprintf(stderr, "%s\n", message);
        exit(1);
    }
    load_picture(name, "reference", &s->reference);
    load_picture(name, "reference_var", &variance);
    metro_image_noise(&s->reference, &variance, &s->noise);
    metro_image_free(&variance);
}

/* One run; adds up the error, the time, the samples, and how far the mean is off. */
static void run_once(const stage *s, const contender *c, double seconds, uint64_t seed, double sum[5])
{
    metro_render_options options;
    metro_render render;
    metro_image image;
    metro_image_difference difference;
    budget b;
    memset(&options, 0, sizeof options);
    options.method = c->method;
    options.random_numbers = c->random_numbers;
    options.all_connections = c->all_connections;
    options.one_stage = c->one_stage;
    options.chains = c->chains;
    options.threads = 1;
    options.seed = seed;
    b.start = cpu_seconds();
    b.seconds = seconds;
    if (metro_render_make(&s->scene, &s->scene.camera, &options, &render) != METRO_OK) exit(1);
    if (metro_render_run(&render, UINT64_MAX, budget_spent, &b) != METRO_ERROR_STOPPED) exit(1);
    sum[1] += cpu_seconds() - b.start;
    if (metro_render_image(&render, &image) != METRO_OK) exit(1);
    metro_image_error(&image, &s->reference, &difference);
    sum[0] += difference.relmse - s->noise;
    sum[2] += (double)render.samples;
    sum[3] += (double)render.rays;
    if (fabs(difference.mean / difference.mean_reference - 1) > fabs(sum[4]))
        sum[4] = difference.mean / difference.mean_reference - 1;
    metro_image_free(&image);
    metro_render_free(&render);
}

int main(int argc, char **argv)
{
    static const contender contenders[] = { { "path, random", METRO_PATH, 1, 0, 0, 0 },
                                            { "path", METRO_PATH, 0, 0, 0, 0 },
                                            { "light", METRO_LIGHT, 0, 0, 0, 0 },
                                            { "BDPT, random", METRO_BDPT, 1, 0, 0, 0 },
                                            { "BDPT", METRO_BDPT, 0, 0, 0, 0 },
                                            { "MLT, the paper's, .3 rad", METRO_MLT, 0, 0, 0, 0 },
                                            { "PSSMLT, all ways, one stage", METRO_PSSMLT, 0, 1, 1, 0 },
                                            { "PSSMLT, one stage", METRO_PSSMLT, 0, 0, 1, 0 },
                                            { "PSSMLT", METRO_PSSMLT, 0, 0, 0, 0 },
                                            { "PSSMLT, ten chains", METRO_PSSMLT, 0, 0, 0, 10 } };
    static const char *const scenes[] = { "S1", "S2" };
    double seconds = argc > 1 ? atof(argv[1]) : 8;
    int seeds = argc > 2 ? atoi(argv[2]) : 3, seed;
    size_t i, j;
    for (i = 0; i < sizeof scenes / sizeof *scenes; i++) {
        stage s;
        stage_load(&s, scenes[i]);
        printf("%s, %g CPU seconds, %d seeds      relMSE  efficiency  samples/s     rays/s  worst mean off\n",
               scenes[i], seconds, seeds);
        for (j = 0; j < sizeof contenders / sizeof *contenders; j++) {
            double sum[5] = { 0, 0, 0, 0, 0 };
            for (seed = 1; seed <= seeds; seed++) run_once(&s, &contenders[j], seconds, (uint64_t)seed, sum);
            printf("  %-28s %10.5f %10.2f %11.3g %10.3g %+10.2f %%\n", contenders[j].name, sum[0] / seeds,
                   (double)seeds * (double)seeds / (sum[0] * sum[1]), sum[2] / sum[1], sum[3] / sum[1], 100 * sum[4]);
            fflush(stdout);
        }
        metro_image_free(&s.reference);
        metro_scene_free(&s.scene);
    }
    return 0;
}
