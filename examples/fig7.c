/* fig7.c: the paper's figure 7 (section 3.3.2): the test scene with difficult lighting. Two rooms, surfaces that
   reflect diffusely and in highlights (floor and dark block), and a lamp in the room behind, whose light comes round
   an almost closed door. The paper's scene is not public; this is the test scene S2.

   On the left as ray bundles see it, with what chapter 14 has best: even walks, lines in place of points, and a first
   shot of the lamp's light. In the middle by bidirectional path tracing (chapter 12) in about the same time. On the
   right the reference of the tests.

   See: bundles have no grain, because each of them lights all patches at once; but they show the patches, and where
   their walks are still noisy, whole patches are too bright or too dark together. Patches of the floor that lie half
   behind the door let light leak under it, which no number of walks removes; the error of paths is grain, and falls.

   Writes out/fig7.svg (the sheet), out/fig7.png and out/fig7.pfm (the picture by bundles), out/fig7.csv. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SIDE = 128 };

/* A picture, how it was made and how good it is. */
typedef struct {
    const char *name, *unit;
    metro_image image;
    double amount, seconds;
    metro_image_difference error;
    char caption[120];
} exhibit;

/* What all threads have computed so far, which another program on the machine does not lengthen. */
static double computed(void) { return (double)clock() / CLOCKS_PER_SEC; }

static int show_bundles(const metro_bundles *bundles, void *user)
{
    plot_progress(0.6 * (double)bundles->walks / *(const double *)user, "figure 7: bundles");
    return 0;
}

static metro_result by_bundles(const metro_scene *scene, exhibit *e, size_t *patches)
{
    metro_bundles_options options;
    metro_bundles bundles;
    metro_result result;
    double begin = computed();
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    options.patch = plot_quick() ? 0.3 : 0.2;
    options.grid = plot_quick() ? 48 : 80;
    options.visibility = METRO_LINES;
    options.walk = METRO_WALK_EVEN;
    options.first_shot = 1;
    result = metro_bundles_make(scene, &scene->camera, &options, &bundles);
    if (result != METRO_OK) return result;
    *patches = bundles.patches.count;
    result = metro_bundles_run(&bundles, (uint64_t)e->amount, show_bundles, &e->amount);
    if (result == METRO_OK) result = metro_bundles_image(&bundles, &e->image);
    metro_bundles_free(&bundles);
    e->seconds = computed() - begin;
    return result;
}

static metro_result by_paths(const metro_scene *scene, exhibit *e)
{
    metro_render_options options;
    metro_result result;
    double begin = computed();
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    plot_progress(0.6, "figure 7: paths");
    result = light_render(scene, &options, (uint64_t)e->amount, &e->image, NULL);
    e->seconds = computed() - begin;
    return result;
}

static void hang(plot_panel *panel, exhibit *e, double exposure)
{
    snprintf(e->caption, sizeof e->caption, "%.0f %s, %.1f s: error %.2f", e->amount, e->unit, e->seconds,
             e->error.relative_rmse);
    light_hang(panel, &e->image, exposure, e->name, e->caption);
}

static int draw(exhibit *e, const metro_image *reference, double exposure, size_t patches)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    char title[200], note[240];
    snprintf(title, sizeof title,
             "A glossy room, its lamp behind a door: bundles trade grain for patches, error %.2f against %.2f",
             e[0].error.relative_rmse, e[1].error.relative_rmse);
    snprintf(note, sizeof note,
             "%d x %d pixels, paths of up to 8 edges. Seconds of computing, all threads together. Error: "
             "relative RMSE of the pixels. %d patches.",
             SIDE, SIDE, (int)patches);
    chart.title = title;
    chart.note = note;
    chart.columns = 3;
    chart.width = 1400;
    hang(&chart.panel[0], &e[0], exposure);
    hang(&chart.panel[1], &e[1], exposure);
    light_hang(&chart.panel[2], reference, exposure, "the reference", "long runs of two methods that agree");
    return plot_save(&chart, "out/fig7.svg");
}

static int write_table(const exhibit *e, size_t patches)
{
    static const char *const method[2] = { "bundles", "bdpt" };
    plot_csv csv =
        plot_csv_open("out/fig7.csv", "method,amount,patches,seconds,relative_rmse,relmse,mean,mean_reference");
    int i;
    for (i = 0; i < 2; i++) {
        plot_csv_text(&csv, method[i]);
        PLOT_CSV_ROW(&csv, e[i].amount, i == 0 ? (double)patches : (double)NAN, e[i].seconds,
                     e[i].error.relative_rmse, e[i].error.relmse, e[i].error.mean, e[i].error.mean_reference);
    }
    return plot_csv_close(&csv);
}

int main(void)
{
    static exhibit e[2];
    metro_scene scene;
    metro_image reference;
    metro_result result;
    size_t patches = 0, i;
    double exposure;
    e[0].name = "ray bundles";
    e[0].unit = "walks";
    e[1].name = "bidirectional paths";
    e[1].unit = "a pixel";
    e[0].amount = plot_quick() ? 256 : 1792;
    e[1].amount = plot_quick() ? 6 : 64;
    if (light_load("fig7", "tests/data/S2.obj", &scene) != 0) return 1;
    result = metro_image_load("tests/data/S2.reference.pfm", &reference, NULL, 0);
    if (result != METRO_OK) return light_complain("fig7", "tests/data/S2.reference.pfm", result);
    result = by_bundles(&scene, &e[0], &patches);
    if (result == METRO_OK) result = by_paths(&scene, &e[1]);
    for (i = 0; i < 2 && result == METRO_OK; i++) result = metro_image_error(&e[i].image, &reference, &e[i].error);
    plot_progress(1, "figure 7");
    if (result != METRO_OK) return light_complain("fig7", "render", result);
    exposure = light_exposure(&reference, 0.2);
    if (draw(e, &reference, exposure, patches) + write_table(e, patches) > 0) return 1;
    if (light_save("fig7", "fig7", &e[0].image, exposure) != 0) return 1;
    printf("ray bundles: %.0f walks over %d patches, %.1f s, relative RMSE %.3f; bidirectional paths: %.0f a pixel, "
           "%.1f s, %.3f\n",
           e[0].amount, (int)patches, e[0].seconds, e[0].error.relative_rmse, e[1].amount, e[1].seconds,
           e[1].error.relative_rmse);
    for (i = 0; i < 2; i++) metro_image_free(&e[i].image);
    metro_image_free(&reference);
    metro_scene_free(&scene);
    return 0;
}
