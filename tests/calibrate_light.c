/* calibrate_light.c: do the errors that a Metropolis render states hold? make calibrate runs it, for some minutes.

   Many independent runs of each scene, each with its own seed; how often does the interval of 95 % around the stated
   mean luminance hold the truth, and those around the means of the blocks of 8 x 8 pixels? The truth is the scene's
   reference picture, whose own error is a hundredth of what is tested. Between 90 and 99 % is what we ask for. */

#define METRO_IMPLEMENTATION
#include "../metro.h"

#include <stdio.h>
#include <stdlib.h>

static double block_truth(const metro_image *reference, size_t column, size_t row)
{
    double sum = 0;
    size_t x, y;
    for (y = 8 * row; y < 8 * row + 8; y++)
        for (x = 8 * column; x < 8 * column + 8; x++) {
            const double *c = reference->value + 3 * (y * reference->width + x);
            sum += metro_luminance(c[0], c[1], c[2]);
        }
    return sum / 64;
}

typedef struct {
    double mean, blocks, runs, bias, squares;
} coverage;

static void run_once(const metro_scene *scene, const metro_image *reference, double truth,
                     metro_render_options options, uint64_t rounds, coverage *sum)
{
    metro_render render;
    metro_render_report report;
    size_t column, row, held = 0;
    if (metro_render_make(scene, &scene->camera, &options, &render) != METRO_OK) exit(1);
    if (metro_render_run(&render, rounds, NULL, NULL) != METRO_OK) exit(1);
    metro_render_diagnose(&render, &report);
    for (row = 0; row < reference->height / 8; row++)
        for (column = 0; column < reference->width / 8; column++) {
            double error, mean = metro_render_block(&render, column, row, &error);
            held += fabs(mean - block_truth(reference, column, row)) <= 2.0 * error; /* Student's t, 63 degrees */
        }
    sum->runs++;
    sum->mean += fabs(report.mean - truth) <= 1.96 * report.mean_error;
    sum->bias += (report.mean - truth) / report.mean_error;
    sum->squares += (report.mean - truth) / report.mean_error * (report.mean - truth) / report.mean_error;
    sum->blocks += (double)held / (double)(reference->width / 8 * (reference->height / 8));
    metro_render_free(&render);
}

static void scene_runs(const char *name, int runs, uint64_t rounds, metro_render_options options, const char *what)
{
    char path[200], message[400];
    metro_scene scene;
    metro_image reference;
    metro_image_difference difference;
    coverage sum;
    int i;
    memset(&scene, 0, sizeof scene);
    memset(&sum, 0, sizeof sum);
    snprintf(path, sizeof path, "tests/data/%s.obj", name);
    if (metro_scene_load_obj(&scene, path, message, sizeof message) != METRO_OK ||
        metro_scene_build(&scene) != METRO_OK) {
        printf("%s: %s\n", path, message);
        exit(1);
    }
    snprintf(path, sizeof path, "tests/data/%s.reference.pfm", name);
    if (metro_image_load(path, &reference, message, sizeof message) != METRO_OK) {
        printf("%s\n", message);
        exit(1);
    }
    metro_image_error(&reference, &reference, &difference);
    for (i = 0; i < runs; i++) {
        options.seed = 1000 + (uint64_t)i;
        run_once(&scene, &reference, difference.mean, options, rounds, &sum);
    }
    printf("%-3s %-28s %4.0f runs of %3d rounds: mean luminance held %5.1f %%, blocks %5.1f %%; "
           "mean off by %+.2f +- %.2f of its error\n",
           name, what, sum.runs, (int)rounds, 100 * sum.mean / sum.runs, 100 * sum.blocks / sum.runs,
           sum.bias / sum.runs, sqrt(sum.squares / sum.runs));
    fflush(stdout);
    metro_image_free(&reference);
    metro_scene_free(&scene);
}

int main(int argc, char **argv)
{
    int runs = argc > 1 ? atoi(argv[1]) : 200;
    metro_render_options pssmlt, mlt;
    memset(&pssmlt, 0, sizeof pssmlt);
    pssmlt.method = METRO_PSSMLT;
    mlt = pssmlt;
    mlt.method = METRO_MLT;
    mlt.large_step = 0.1;
    mlt.perturbation = 0.45;
    scene_runs("S1", runs, 30, pssmlt, "PSSMLT");
    scene_runs("S2", runs, 60, pssmlt, "PSSMLT");
    scene_runs("S1", runs, 20, mlt, "MLT, .45 rad, large .1");
    return 0;
}
