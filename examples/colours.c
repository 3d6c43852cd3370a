/* colours.c: a lesson on the scalar importance. A path carries red, green and blue, but a chain knows one number;
   which one is the user's choice (section 1 of the paper: it "can, for example, represent the luminance"). Luminance
   gives red a weight of .21, green .72 and blue .07, so a path that carries blue alone seems unimportant, is seldom
   visited and then counts fourteen times in blue. With the largest of the three channels as the importance no path
   counts more than once in any of them.

   Two scenes: a white room under a red, a green and a blue lamp, made here, in which each path has one color; and the
   Cornell box under its yellowish lamp. Each is painted many times by chains with either importance. The bars are the
   relative errors of each color channel: its own RMSE over its own root mean square.

   See: with pure colors, luminance makes green good and blue bad, and the largest channel makes all three alike; in
   the two pictures it is the right side that gains. Where all paths carry all colors, as nearly all do in the Cornell
   box, the choice hardly matters.

   Writes out/colours.svg and out/colours.csv. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SCENES = 2, CHOICES = 2, CHANNELS = 3, DEPTH = 5 };

static const char *const scene_name[SCENES] = { "three lamps", "Cornell box" };
static const char *const choice_name[CHOICES] = { "luminance", "largest channel" };
static const char *const channel_name[CHANNELS] = { "red", "green", "blue" };

/* What one importance does to one scene. */
typedef struct {
    double rmse[CHANNELS], error[CHANNELS];
} verdict;

typedef struct {
    size_t repeats;
    uint64_t rounds, reference_rounds;
    verdict verdict[SCENES][CHOICES];
    plot_chart chart;
} lesson;

/* ---- A scene made in code ---- */

static metro_result add_quad(metro_scene *scene, metro_vec3 origin, metro_vec3 a, metro_vec3 b, uint32_t material)
{
    metro_vec3 corner[4], triangle[3];
    metro_result result;
    corner[0] = origin;
    corner[1] = metro_add(origin, a);
    corner[2] = metro_add(corner[1], b);
    corner[3] = metro_add(origin, b);
    result = metro_scene_add_triangle(scene, corner, material); /* the first three */
    triangle[0] = corner[0], triangle[1] = corner[2], triangle[2] = corner[3];
    return result == METRO_OK ? metro_scene_add_triangle(scene, triangle, material) : result;
}

/* Floor, back wall, ceiling, left and right wall of a room 4 wide, 2 high and 2 deep, open to the front. A quad faces
   where a x b points. */
static metro_result add_room(metro_scene *scene)
{
    static const double quad[5][9] = { { 0, 0, 0, 4, 0, 0, 0, 0, -2 },
                                       { 0, 0, -2, 4, 0, 0, 0, 2, 0 },
                                       { 0, 2, -2, 4, 0, 0, 0, 0, 2 },
                                       { 0, 0, 0, 0, 0, -2, 0, 2, 0 },
                                       { 4, 0, -2, 0, 0, 2, 0, 2, 0 } };
    metro_material white;
    metro_result result;
    uint32_t index;
    int i;
    memset(&white, 0, sizeof white);
    white.kd = metro_vec3_make(0.75, 0.75, 0.75);
    result = metro_scene_add_material(scene, &white, &index);
    for (i = 0; i < 5 && result == METRO_OK; i++) {
        const double *q = quad[i];
        result = add_quad(scene, metro_vec3_make(q[0], q[1], q[2]), metro_vec3_make(q[3], q[4], q[5]),
                          metro_vec3_make(q[6], q[7], q[8]), index);
    }
    return result;
}

/* Three square lamps below the ceiling: red to the left, green in the middle, blue to the right. */
static metro_result make_three_lamps(metro_scene *scene)
{
    metro_result result = add_room(scene);
    int i;
    for (i = 0; i < 3 && result == METRO_OK; i++) {
        metro_material lamp;
        uint32_t index;
        memset(&lamp, 0, sizeof lamp);
        lamp.ke = metro_vec3_make(i == 0 ? 10 : 0, i == 1 ? 10 : 0, i == 2 ? 10 : 0);
        result = metro_scene_add_material(scene, &lamp, &index);
        if (result == METRO_OK)
            result = add_quad(scene, metro_vec3_make(0.5 + 1.3 * i, 1.98, -1.2), metro_vec3_make(0.4, 0, 0),
                              metro_vec3_make(0, 0, 0.4), index);
    }
    scene->camera.eye = metro_vec3_make(2, 1, 4);
    scene->camera.look = metro_vec3_make(2, 1, 0);
    scene->camera.up = metro_vec3_make(0, 1, 0);
    scene->camera.fov = 28;
    return result == METRO_OK ? metro_scene_build(scene) : result;
}

/* ---- The measurement ---- */

/* The relative squared error of one channel of a picture. */
static double squared_error(const double *value, const metro_image *reference, size_t channel)
{
    double apart = 0, power = 0;
    size_t i;
    for (i = channel; i < 3 * reference->width * reference->height; i += 3) {
        apart += (value[i] - reference->value[i]) * (value[i] - reference->value[i]);
        power += reference->value[i] * reference->value[i];
    }
    return apart / power;
}

static void judge(const light_study *study, const metro_image *reference, verdict *v)
{
    size_t c, r;
    for (c = 0; c < CHANNELS; c++) {
        metro_moments squared = { 0, 0, 0, 0 };
        for (r = 0; r < study->repeats; r++)
            metro_moments_add(&squared, squared_error(light_study_picture(study, 0, r), reference, c));
        v->rmse[c] = sqrt(metro_moments_mean(&squared));
        v->error[c] = metro_moments_error(&squared) / (2 * v->rmse[c]);
    }
}

static light_study study_of(const lesson *l, const metro_scene *scene, int s)
{
    light_study study;
    memset(&study, 0, sizeof study);
    study.scene = scene;
    study.options.width = s == 0 ? 64 : 32;
    study.options.height = 32;
    study.options.depth = DEPTH;
    study.options.shortest = 2;
    study.options.method = METRO_MLT;
    study.options.perturbation = 0.3;
    study.options.large_step = 0.2;
    study.options.chains = 16;
    study.rounds = &l->rounds;
    study.looks = 1;
    study.repeats = l->repeats;
    return study;
}

/* Paints the scene with both importances; of the first scene it hangs a picture by each. */
static metro_result measure(lesson *l, const metro_scene *scene, int s)
{
    light_study study = study_of(l, scene, s);
    metro_image reference, image;
    double noise;
    int choice;
    metro_result result = light_reference(scene, &study.options, l->reference_rounds, &reference, &noise);
    if (result != METRO_OK) return result;
    image = reference;
    for (choice = 0; choice < CHOICES && result == METRO_OK; choice++) {
        plot_progress((s * CHOICES + choice + 0.5) / (SCENES * CHOICES), "colours");
        study.options.largest_channel = choice;
        result = light_study_run(&study);
        if (result != METRO_OK) break;
        judge(&study, &reference, &l->verdict[s][choice]);
        image.value = light_study_picture(&study, 0, 0);
        if (s == 0)
            light_hang(&l->chart.panel[2 + choice], &image, light_exposure(&reference, 0.25),
                       choice == 0 ? "three lamps by luminance" : "three lamps by largest channel", NULL);
        light_study_free(&study);
    }
    metro_image_free(&reference);
    return result;
}

/* ---- What comes out ---- */

static int write_table(const lesson *l)
{
    plot_csv csv = plot_csv_open("out/colours.csv", "scene,importance,channel,relative_rmse,error");
    int s, choice, c;
    for (s = 0; s < SCENES; s++)
        for (choice = 0; choice < CHOICES; choice++) {
            const verdict *v = &l->verdict[s][choice];
            printf("%-12s %-16s", scene_name[s], choice_name[choice]);
            for (c = 0; c < CHANNELS; c++) {
                printf("  %s %.3f +- %.3f", channel_name[c], v->rmse[c], v->error[c]);
                plot_csv_text(&csv, scene_name[s]);
                plot_csv_text(&csv, choice_name[choice]);
                plot_csv_text(&csv, channel_name[c]);
                PLOT_CSV_ROW(&csv, v->rmse[c], v->error[c]);
            }
            printf("\n");
        }
    return plot_csv_close(&csv);
}

static int draw(lesson *l)
{
    const verdict *v = l->verdict[0];
    char title[200], note[400];
    int s, choice;
    snprintf(
        title, sizeof title,
        "Luminance as the importance forgets blue: its error is %.1f times that of green; by the largest channel "
        "it is %.1f times",
        v[0].rmse[2] / v[0].rmse[1], v[1].rmse[2] / v[1].rmse[1]);
    snprintf(
        note, sizeof note,
        "Relative RMSE of each channel over its own root mean square, %d samples a pixel, mean of %d runs with its "
        "standard error. Below: one run of each; the lamps are black because their own light is left out.",
        (int)l->rounds, (int)l->repeats);
    l->chart.title = title;
    l->chart.note = note;
    l->chart.rows = l->chart.columns = 2;
    l->chart.width = 1200;
    for (s = 0; s < SCENES; s++) {
        plot_panel *panel = &l->chart.panel[s];
        panel->title = scene_name[s];
        panel->x_label = "relative RMSE";
        panel->x_max = 1.1 * fmax(fmax(v[0].rmse[0], v[0].rmse[1]), v[0].rmse[2]);
        for (choice = 0; choice < CHOICES; choice++)
            plot_bars(panel, channel_name, l->verdict[s][choice].rmse, l->verdict[s][choice].error, CHANNELS,
                      choice == 0 ? "importance: luminance" : "importance: largest channel");
    }
    return plot_save(&l->chart, "out/colours.svg");
}

int main(void)
{
    static lesson l;
    metro_scene scene;
    metro_result result;
    const verdict *v = l.verdict[0];
    l.repeats = plot_quick() ? 12 : 32;
    l.rounds = plot_quick() ? 20 : 40;
    l.reference_rounds = plot_quick() ? 256 : 512;
    memset(&scene, 0, sizeof scene);
    result = make_three_lamps(&scene);
    if (result == METRO_OK) result = measure(&l, &scene, 0);
    metro_scene_free(&scene);
    if (result != METRO_OK) return light_complain("colours", scene_name[0], result);
    if (light_load("colours", "examples/scenes/cornell.obj", &scene) != 0) return 1;
    result = measure(&l, &scene, 1);
    metro_scene_free(&scene);
    if (result != METRO_OK) return light_complain("colours", scene_name[1], result);
    plot_progress(1, "colours");
    if (write_table(&l) + draw(&l) > 0) return 1;
    printf(
        "three lamps: by luminance the error of blue is %.1f times that of green, by the largest channel %.1f times; "
        "blue gains a factor of %.1f, green loses one of %.1f\n",
        v[0].rmse[2] / v[0].rmse[1], v[1].rmse[2] / v[1].rmse[1], v[0].rmse[2] / v[1].rmse[2],
        v[1].rmse[1] / v[0].rmse[1]);
    return 0;
}
