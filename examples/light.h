/* light.h - what the example programs that render have in common: load a scene, render it once or many times over,
   compute a reference, hang pictures on a sheet. Not part of the library. Include it after metro.h and plot.h.

   Functions that return a metro_result print nothing; the others return 0, or 1 after a message on stderr. */

#ifndef LIGHT_H
#define LIGHT_H

#include <time.h>

#if defined(__GNUC__) || defined(__clang__) || defined(__TINYC__)
#define LIGHT_API static __attribute__((unused))
#else
#define LIGHT_API static inline
#endif

LIGHT_API int light_complain(const char *program, const char *what, metro_result result)
{
    fprintf(stderr, "%s: %s: %s\n", program, what, metro_result_text(result));
    return 1;
}

/* Loads the scene and builds it; warnings of the loader go to stderr. */
LIGHT_API int light_load(const char *program, const char *path, metro_scene *scene)
{
    char message[1000];
    metro_result result;
    memset(scene, 0, sizeof *scene);
    result = metro_scene_load_obj(scene, path, message, sizeof message);
    if (message[0] != 0) fprintf(stderr, "%s: %s\n", program, message);
    if (result != METRO_OK) {
        if (result == METRO_ERROR_FILE) fprintf(stderr, "%s: run it from the folder that metro.h is in\n", program);
        return 1;
    }
    result = metro_scene_build(scene);
    if (result == METRO_OK) return 0;
    metro_scene_free(scene);
    return light_complain(program, path, result);
}

/* The time that this thread has computed, in seconds; where the system does not say, the time on the wall. It says it
   to programs that define _POSIX_C_SOURCE as 200809L above all includes. */
LIGHT_API double light_cpu_seconds(void)
{
#ifdef CLOCK_THREAD_CPUTIME_ID
    struct timespec now;
    if (clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now) == 0) return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
#endif
    return plot_seconds();
}

/* Renders `rounds` rounds through the scene's own camera. `report` may be NULL. */
LIGHT_API metro_result light_render(const metro_scene *scene, const metro_render_options *options, uint64_t rounds,
                                    metro_image *image, metro_render_report *report)
{
    metro_render render;
    metro_result result = metro_render_make(scene, &scene->camera, options, &render);
    if (result != METRO_OK) return result;
    result = metro_render_run(&render, rounds, NULL, NULL);
    if (result == METRO_OK) result = metro_render_image(&render, image);
    if (result == METRO_OK && report != NULL) metro_render_diagnose(&render, report);
    metro_render_free(&render);
    return result;
}

/* The picture that `options` estimate (size, depth, shortest), by bidirectional path tracing in two independent
   halves of `rounds` rounds each. `noise` is the relative RMSE of what comes out, from what the halves differ by. */
LIGHT_API metro_result light_reference(const metro_scene *scene, const metro_render_options *options, uint64_t rounds,
                                       metro_image *image, double *noise)
{
    metro_render_options own;
    metro_image half[2];
    metro_result result;
    double apart = 0, power = 0;
    size_t i;
    memset(&own, 0, sizeof own);
    own.width = options->width;
    own.height = options->height;
    own.depth = options->depth;
    own.shortest = options->shortest;
    result = light_render(scene, &own, rounds, &half[0], NULL);
    if (result != METRO_OK) return result;
    own.part = 1;
    result = light_render(scene, &own, rounds, &half[1], NULL);
    for (i = 0; result == METRO_OK && i < half[0].width * half[0].height * 3; i++) {
        double a = half[0].value[i], b = half[1].value[i], mean = (a + b) / 2;
        apart += (a - b) * (a - b) / 4;
        power += mean * mean;
        half[0].value[i] = mean;
    }
    if (result == METRO_OK) metro_image_free(&half[1]);
    if (result != METRO_OK) metro_image_free(&half[0]);
    else *image = half[0];
    *noise = sqrt(apart / power);
    return result;
}

/* The same render many times over with other random numbers, looked at after some numbers of rounds. Each run has one
   thread, and the runs share the cores. Where chains start at a point, it is the same in each run. */
typedef struct {
    const metro_scene *scene;
    metro_render_options options;
    const uint64_t *rounds;       /* [looks], rising: when to look */
    size_t looks, repeats;
    double *picture;              /* [looks * repeats * values], by the function; values = 3 * width * height */
    metro_render_report *report;  /* [repeats], after the last look */
    double *seconds;              /* [looks * repeats]: computing time until each look, with all that comes before */
} light_study;

LIGHT_API size_t light_study_values(const light_study *study)
{
    return 3 * study->options.width * study->options.height;
}

/* The picture of one repeat at one look. */
LIGHT_API double *light_study_picture(const light_study *study, size_t look, size_t repeat)
{
    return study->picture + (look * study->repeats + repeat) * light_study_values(study);
}

/* A slot holds the report, then the pictures at all looks and then the times. */
LIGHT_API double *light_study_slot(const void *slot)
{
    return (double *)(void *)((char *)(uintptr_t)slot + (sizeof(metro_render_report) + 15) / 16 * 16);
}

LIGHT_API metro_result light_study_work(uint64_t job, void *slot, void *user)
{
    const light_study *study = (const light_study *)user;
    metro_render_options options = study->options;
    size_t look, values = light_study_values(study);
    double begin = light_cpu_seconds(), looking = 0, *seconds = light_study_slot(slot) + study->looks * values;
    metro_render render;
    metro_result result;
    options.part = job;
    options.threads = 1;
    result = metro_render_make(study->scene, &study->scene->camera, &options, &render);
    if (result != METRO_OK) return result;
    for (look = 0; look < study->looks && result == METRO_OK; look++) {
        metro_image image;
        double end;
        result = metro_render_run(&render, study->rounds[look] - render.rounds, NULL, NULL);
        end = light_cpu_seconds();
        seconds[look] = end - begin - looking;
        if (result == METRO_OK) result = metro_render_image(&render, &image);
        if (result != METRO_OK) break;
        memcpy(light_study_slot(slot) + look * values, image.value, values * sizeof(double));
        metro_image_free(&image);
        looking += light_cpu_seconds() - end;
    }
    metro_render_diagnose(&render, (metro_render_report *)slot);
    metro_render_free(&render);
    return result;
}

LIGHT_API metro_result light_study_merge(uint64_t job, const void *slot, void *user)
{
    light_study *study = (light_study *)user;
    size_t look, values = light_study_values(study), repeat = (size_t)job;
    study->report[repeat] = *(const metro_render_report *)slot;
    for (look = 0; look < study->looks; look++) {
        memcpy(light_study_picture(study, look, repeat), light_study_slot(slot) + look * values,
               values * sizeof(double));
        study->seconds[look * study->repeats + repeat] = light_study_slot(slot)[study->looks * values + look];
    }
    return METRO_OK;
}

LIGHT_API void light_study_free(light_study *study)
{
    free(study->picture);
    free(study->report);
    free(study->seconds);
    study->picture = NULL;
    study->report = NULL;
    study->seconds = NULL;
}

/* Runs the study, of which width, height and all but the last three members are filled in. After a failure there is
   nothing to free. */
LIGHT_API metro_result light_study_run(light_study *study)
{
    size_t values = light_study_values(study);
    metro_rounds plan;
    metro_result result = METRO_ERROR_MEMORY;
    study->picture = (double *)malloc(study->looks * study->repeats * values * sizeof(double));
    study->report = (metro_render_report *)malloc(study->repeats * sizeof *study->report);
    study->seconds = (double *)malloc(study->looks * study->repeats * sizeof *study->seconds);
    memset(&plan, 0, sizeof plan);
    plan.jobs = study->repeats;
    plan.slot_size = (sizeof(metro_render_report) + 15) / 16 * 16 + study->looks * (values + 1) * sizeof(double);
    plan.work = light_study_work;
    plan.merge = light_study_merge;
    if (study->picture != NULL && study->report != NULL && study->seconds != NULL)
        result = metro_rounds_run(&plan, study);
    if (result != METRO_OK) light_study_free(study);
    return result;
}

/* The relative RMSE at one look, mean over the repeats, and the standard error of that mean: of the squared errors,
   less what the noise of the reference (relative, too) adds to each, the root. */
LIGHT_API double light_study_error(const light_study *study, size_t look, const metro_image *reference, double noise,
                                   double *error)
{
    metro_moments squared = { 0, 0, 0, 0 };
    double mean;
    size_t r;
    for (r = 0; r < study->repeats; r++) {
        metro_image_difference difference;
        metro_image image = *reference;
        image.value = light_study_picture(study, look, r);
        if (metro_image_error(&image, reference, &difference) != METRO_OK) return (double)NAN;
        metro_moments_add(&squared, difference.relative_rmse * difference.relative_rmse - noise * noise);
    }
    mean = sqrt(metro_moments_mean(&squared));
    if (error != NULL) *error = metro_moments_error(&squared) / (2 * mean);
    return mean;
}

/* The luminance of `pixels` pixels of three channels; `luminance` may be the picture itself. */
LIGHT_API void light_luminance(const double *color, size_t pixels, double *luminance)
{
    size_t i;
    for (i = 0; i < pixels; i++) luminance[i] = metro_luminance(color[3 * i], color[3 * i + 1], color[3 * i + 2]);
}

/* Sets mask[pixel] to 0 where a lamp is seen in the pixel or in one beside it, else to 1; returns how many are 1.
   Beside a lamp the picture has a spike that no number of samples smooths, which studies of bias leave out. */
LIGHT_API size_t light_mask(const metro_scene *scene, size_t width, size_t height, unsigned char *mask)
{
    enum { FINE = 8 };
    size_t x, y, i, used = 0;
    for (i = 0; i < width * height; i++) mask[i] = 1;
    for (i = 0; i < width * height * FINE * FINE; i++) {
        double fx = ((double)(i % (width * FINE)) + 0.5) / FINE, fy = ((double)(i / (width * FINE)) + 0.5) / FINE;
        metro_vec3 direction = metro_camera_direction(&scene->camera, width, height, fx, fy);
        const metro_material *material;
        metro_hit hit;
        if (!metro_scene_hit(scene, scene->camera.eye, direction, 0, (double)INFINITY, &hit)) continue;
        material = metro_scene_material(scene, scene->material_of[hit.triangle]);
        if (!(material->ke.x + material->ke.y + material->ke.z > 0)) continue;
        if (!(metro_dot(metro_scene_normal(scene, hit.triangle), direction) < 0)) continue;
        for (y = (size_t)fy > 0 ? (size_t)fy - 1 : 0; y <= (size_t)fy + 1 && y < height; y++)
            for (x = (size_t)fx > 0 ? (size_t)fx - 1 : 0; x <= (size_t)fx + 1 && x < width; x++)
                mask[y * width + x] = 0;
    }
    for (i = 0; i < width * height; i++) used += mask[i];
    return used;
}

/* Makes a panel a picture, brighter by `exposure` stops, with words above and below (either may be NULL). */
LIGHT_API void light_hang(plot_panel *panel, const metro_image *image, double exposure, const char *title,
                          const char *caption)
{
    unsigned char *bytes = plot_bytes(image->width, image->height, (int)image->channels, image->value, exposure);
    panel->title = title;
    panel->x_label = caption;
    if (bytes == NULL) panel->failed = 1;
    else plot_picture(panel, image->width, image->height, (int)image->channels, bytes);
    free(bytes);
}

/* The stops that bring the mean of all samples to `level` (of white 1): .18 is a middle grey. */
LIGHT_API double light_exposure(const metro_image *image, double level)
{
    double sum = 0;
    size_t i, count = image->width * image->height * image->channels;
    for (i = 0; i < count; i++) sum += image->value[i];
    return sum > 0 ? log(level * (double)count / sum) / log(2.0) : 0;
}

/* out/NAME.png, brighter by `exposure` stops, and out/NAME.pfm, as it is. */
LIGHT_API int light_save(const char *program, const char *name, const metro_image *image, double exposure)
{
    char path[200];
    metro_result result;
    snprintf(path, sizeof path, "out/%s.png", name);
    if (plot_png_linear(path, image->width, image->height, (int)image->channels, image->value, exposure) != 0)
        return 1;
    snprintf(path, sizeof path, "out/%s.pfm", name);
    result = metro_image_save_pfm(image, path);
    return result == METRO_OK ? 0 : light_complain(program, path, result);
}

#undef LIGHT_API
#endif
