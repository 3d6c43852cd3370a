/* fig4.c: the paper's figure 4 (section 3.2): the error of the picture against the number of samples per pixel, for
   angular perturbations with apex angles from .05 to .6 rad, and the reference picture. The scene is homogeneous, the
   Cornell box; light that comes straight from the lamp is left out, so that all that is measured is reflected. One
   chain paints each picture, as in the paper: all directions of both walks are perturbed at once, there are no large
   steps, and the chain starts at a seed that was drawn by its importance.

   For comparison, the same integrand with a fresh uniform path for each mutation (a large step every time), which
   remembers only by rejecting; and bidirectional path tracing, whose samples are independent and suit the surfaces.

   See: all curves fall like the root of the number of samples, sooner or later, so what a perturbation costs is the
   distance between them. The smallest angle is worst, a middle one is best, and wide ones lose what the chain has
   found ("forgets which regions are important", section 2.3). On a scene as plain as this no Metropolis curve comes
   near bidirectional path tracing: the conclusion of the paper.

   Writes out/fig4.svg, out/fig4.csv, and the reference as out/fig4_reference.png and out/fig4_reference.pfm. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { ANGLES = 7, INDEPENDENT = ANGLES, PATHS, CURVES, LOOKS = 7, QUICK_LOOKS = 5, SHOWN = 4, DEPTH = 5 };

static const double angle[ANGLES] = { 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6 };
static const uint64_t look[LOOKS] = { 5, 10, 20, 40, 80, 160, 320 };

/* What one curve of the chart is made of. */
typedef struct {
    double rmse[LOOKS], error[LOOKS]; /* mean over the repeats, and the standard error of that */
    double acceptance;                /* NaN where nothing is accepted */
} curve;

typedef struct {
    metro_scene scene;
    metro_image reference;
    double noise; /* of the reference, relative */
    size_t repeats, looks;
    curve curve[CURVES];
} figure;

static metro_render_options options_for(int c, size_t side)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = side;
    options.depth = DEPTH;
    options.shortest = 2;
    if (c == PATHS) return options;
    options.method = METRO_MLT;
    options.chains = 1;
    if (c == INDEPENDENT) options.large_step = 1;
    else options.perturbation = angle[c];
    return options;
}

static metro_result measure(figure *f, int c, size_t side)
{
    curve *found = &f->curve[c];
    light_study study;
    metro_result result;
    size_t k;
    memset(&study, 0, sizeof study);
    study.scene = &f->scene;
    study.options = options_for(c, side);
    study.rounds = look;
    study.looks = f->looks;
    study.repeats = f->repeats;
    result = light_study_run(&study);
    if (result != METRO_OK) return result;
    for (k = 0; k < f->looks; k++)
        found->rmse[k] = light_study_error(&study, k, &f->reference, f->noise, &found->error[k]);
    for (k = 0, found->acceptance = 0; k < f->repeats; k++)
        found->acceptance += study.report[k].acceptance / (double)f->repeats;
    light_study_free(&study);
    return METRO_OK;
}

static const char *name_of(plot_panel *panel, int c)
{
    if (c == PATHS) return "bidirectional paths, no chain";
    if (c == INDEPENDENT) return "fresh paths";
    return plot_say(panel, "% rad", angle[c]);
}

static void draw_curve(plot_panel *panel, const figure *f, int c)
{
    static const double x[LOOKS] = { 5, 10, 20, 40, 80, 160, 320 };
    uint32_t color = c == PATHS ? 0x222222 : c == INDEPENDENT ? 0x888888 : plot_shade((size_t)c, ANGLES);
    plot_series *line = plot_line(panel, x, f->curve[c].rmse, f->looks, name_of(panel, c));
    line->color = color;
    line->dash = c == PATHS || c == INDEPENDENT;
    plot_points(panel, x, f->curve[c].rmse, f->curve[c].error, f->looks, NULL)->color = color;
}

/* The angle with the smallest error at the look that the title speaks of. */
static int best_angle(const figure *f)
{
    int c, best = 0;
    for (c = 1; c < ANGLES; c++)
        if (f->curve[c].rmse[SHOWN] < f->curve[best].rmse[SHOWN]) best = c;
    return best;
}

static int draw(const figure *f)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    plot_panel *panel = &chart.panel[0];
    char title[200], note[300];
    int c, best = best_angle(f);
    snprintf(title, sizeof title,
             "Small perturbations cost most: after %d samples a pixel the error is %.2f for an apex angle of %g rad, "
             "%.2f for %g rad",
             (int)look[SHOWN], f->curve[0].rmse[SHOWN], angle[0], f->curve[best].rmse[SHOWN], angle[best]);
    snprintf(
        note, sizeof note,
        "Relative RMSE of the picture without the directly seen lamp, mean of %d runs with its standard error. One "
        "chain paints each picture. Fresh paths: every mutation is an independent path. Right: the reference, "
        "itself off by %.2g.",
        (int)f->repeats, f->noise);
    chart.title = title;
    chart.note = note;
    chart.columns = 2;
    chart.width = 1400;
    panel->x_label = "samples per pixel";
    panel->y_label = "relative RMSE";
    panel->x_log = panel->y_log = 1;
    panel->better = "down and left is better";
    panel->y_max = 1.15 * f->curve[0].rmse[0];
    panel->y_min = 0.8 * f->curve[PATHS].rmse[f->looks - 1];
    for (c = 0; c < CURVES; c++) draw_curve(panel, f, c);
    light_hang(&chart.panel[1], &f->reference, light_exposure(&f->reference, 0.2), NULL,
               "the reference: bidirectional path tracing");
    return plot_save(&chart, "out/fig4.svg");
}

static int write_table(const figure *f)
{
    plot_csv csv =
        plot_csv_open("out/fig4.csv", "method,apex_angle,acceptance,samples_per_pixel,relative_rmse,error");
    size_t k;
    int c;
    printf("%-24s %10s   relative RMSE after so many samples a pixel\n%-35s", "", "", "");
    for (k = 0; k < f->looks; k++) printf(" %6d", (int)look[k]);
    printf("\n");
    for (c = 0; c < CURVES; c++) {
        const char *name = c == PATHS ? "bidirectional, no chain" : c == INDEPENDENT ? "fresh paths" : "perturbed";
        double apex = c < ANGLES ? angle[c] : (double)NAN;
        if (c < ANGLES) printf("apex angle %-13g", apex);
        else printf("%-24s", name);
        if (c == PATHS) printf("%11s", "");
        else printf(" accept %.2f", f->curve[c].acceptance);
        for (k = 0; k < f->looks; k++) {
            printf(" %6.3f", f->curve[c].rmse[k]);
            plot_csv_text(&csv, name);
            PLOT_CSV_ROW(&csv, apex, f->curve[c].acceptance, (double)look[k], f->curve[c].rmse[k],
                         f->curve[c].error[k]);
        }
        printf("\n");
    }
    return plot_csv_close(&csv);
}

int main(void)
{
    static figure f;
    size_t side = plot_quick() ? 32 : 64;
    metro_render_options options = options_for(PATHS, side);
    metro_result result;
    int c, best;
    f.repeats = 4;
    f.looks = plot_quick() ? QUICK_LOOKS : LOOKS;
    if (light_load("fig4", "examples/scenes/cornell.obj", &f.scene) != 0) return 1;
    result = light_reference(&f.scene, &options, 512, &f.reference, &f.noise);
    for (c = 0; c < CURVES && result == METRO_OK; c++) {
        plot_progress((c + 1.0) / (CURVES + 1), "figure 4: chains");
        result = measure(&f, c, side);
    }
    plot_progress(1, "figure 4");
    if (result != METRO_OK) return light_complain("fig4", "render", result);
    if (write_table(&f) + draw(&f) > 0) return 1;
    if (light_save("fig4", "fig4_reference", &f.reference, light_exposure(&f.reference, 0.2)) != 0) return 1;
    best = best_angle(&f);
    printf(
        "after %d samples a pixel the error is %.2f for an apex angle of %g rad, %.2f for %g, %.2f for %g, %.2f for "
        "fresh paths and %.3f without a chain\n",
        (int)look[SHOWN], f.curve[0].rmse[SHOWN], angle[0], f.curve[best].rmse[SHOWN], angle[best],
        f.curve[ANGLES - 1].rmse[SHOWN], angle[ANGLES - 1], f.curve[INDEPENDENT].rmse[SHOWN],
        f.curve[PATHS].rmse[SHOWN]);
    metro_image_free(&f.reference);
    metro_scene_free(&f.scene);
    return 0;
}
