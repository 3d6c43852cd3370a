/* fig5.c: the paper's figure 5 (section 3.2): pictures of the Cornell box by 20, 80 and 320 samples per pixel (left
   to right), with apex angles of the perturbation of .05, .15 and .45 rad (top to bottom). The runs are those of
   figure 4: one chain for each picture, no large steps, light straight from the lamp left out.

   See: "incorrect bright and dark spots" at the small angle, fine grain at the large one. Two numbers tell them
   apart: the error of the pixels, and the error of the means of 8 x 8 pixels, the spots. Noise that is independent
   from pixel to pixel would be eight times smaller in such a mean; spots survive it. What a spot is made of - the
   start, or just neighbours in the chain that look alike - one picture cannot say: bias.c takes them apart.

   Writes out/fig5.svg (the sheet with its numbers), out/fig5.png (the nine pictures alone) and out/fig5.csv. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { ANGLES = 3, LOOKS = 3, BLOCK = 8, GAP = 4, DEPTH = 5 };

static const double angle[ANGLES] = { 0.05, 0.15, 0.45 };
static const uint64_t look[LOOKS] = { 20, 80, 320 };

typedef struct {
    metro_scene scene;
    metro_image reference, sheet;
    double noise, exposure;
    size_t side, repeats;
    double rmse[ANGLES][LOOKS], spots[ANGLES][LOOKS]; /* means over the repeats */
    char caption[ANGLES][LOOKS][80];
    plot_chart chart;
} figure;

static double block_luminance(const double *value, size_t side, size_t column, size_t row)
{
    double sum = 0;
    size_t x, y;
    for (y = row * BLOCK; y < (row + 1) * BLOCK; y++)
        for (x = column * BLOCK; x < (column + 1) * BLOCK; x++) {
            const double *c = value + 3 * (y * side + x);
            sum += metro_luminance(c[0], c[1], c[2]);
        }
    return sum;
}

/* The mean square of how far each block is off, relative to what it should be. */
static double spots_squared(const double *value, const metro_image *reference)
{
    size_t blocks = reference->width / BLOCK, column, row;
    double sum = 0;
    for (row = 0; row < blocks; row++)
        for (column = 0; column < blocks; column++) {
            double off = block_luminance(value, reference->width, column, row) /
                             block_luminance(reference->value, reference->width, column, row) -
                         1;
            sum += off * off;
        }
    return sum / (double)(blocks * blocks);
}

/* Copies a picture to its place on the sheet of the nine. */
static void place(metro_image *sheet, const double *value, size_t side, size_t row, size_t column)
{
    size_t y;
    for (y = 0; y < side; y++) {
        size_t to = (row * (side + GAP) + y) * sheet->width + column * (side + GAP);
        memcpy(sheet->value + 3 * to, value + 3 * y * side, 3 * side * sizeof(double));
    }
}

/* Hangs the first of the repeats, with the numbers of all. */
static void hang(figure *f, const light_study *study, size_t a, size_t k)
{
    plot_panel *panel = &f->chart.panel[a * LOOKS + k];
    metro_image image = f->reference;
    image.value = light_study_picture(study, k, 0);
    snprintf(f->caption[a][k], sizeof f->caption[a][k], "%g rad: error %.2f, spots %.0f %%", angle[a], f->rmse[a][k],
             100 * f->spots[a][k]);
    light_hang(panel, &image, f->exposure, a == 0 ? plot_say(panel, "% samples per pixel", (double)look[k]) : NULL,
               f->caption[a][k]);
    place(&f->sheet, image.value, f->side, a, k);
}

static metro_result paint(figure *f, size_t a)
{
    light_study study;
    metro_result result;
    size_t k, r;
    memset(&study, 0, sizeof study);
    study.scene = &f->scene;
    study.options.width = study.options.height = f->side;
    study.options.depth = DEPTH;
    study.options.shortest = 2;
    study.options.method = METRO_MLT;
    study.options.perturbation = angle[a];
    study.options.chains = 1;
    study.rounds = look;
    study.looks = LOOKS;
    study.repeats = f->repeats;
    result = light_study_run(&study);
    if (result != METRO_OK) return result;
    for (k = 0; k < LOOKS; k++) {
        double squared = 0;
        for (r = 0; r < f->repeats; r++) squared += spots_squared(light_study_picture(&study, k, r), &f->reference);
        f->spots[a][k] = sqrt(squared / (double)f->repeats);
        f->rmse[a][k] = light_study_error(&study, k, &f->reference, f->noise, NULL);
        hang(f, &study, a, k);
    }
    light_study_free(&study);
    return METRO_OK;
}

static int write_table(const figure *f)
{
    plot_csv csv = plot_csv_open("out/fig5.csv", "apex_angle,samples_per_pixel,relative_rmse,spots,spots_of_grain");
    size_t a, k;
    printf("%-10s %8s %8s %8s   of independent noise\n", "apex angle", "samples", "error", "spots");
    for (a = 0; a < ANGLES; a++)
        for (k = 0; k < LOOKS; k++) {
            double grain = f->rmse[a][k] / BLOCK;
            printf("%-10g %8d %8.3f %7.1f%% %7.1f%%\n", angle[a], (int)look[k], f->rmse[a][k], 100 * f->spots[a][k],
                   100 * grain);
            PLOT_CSV_ROW(&csv, angle[a], (double)look[k], f->rmse[a][k], f->spots[a][k], grain);
        }
    return plot_csv_close(&csv);
}

static int save(figure *f)
{
    char title[200], note[400];
    snprintf(title, sizeof title,
             "Small perturbations paint spots: %.0f %% off at %g rad after %d samples per pixel, %.0f %% at %g rad",
             100 * f->spots[0][1], angle[0], (int)look[1], 100 * f->spots[2][1], angle[2]);
    snprintf(note, sizeof note,
             "Each picture is painted by one chain, and its row has one apex angle. Error: relative RMSE of the "
             "pixels. Spots: how far the means of 8 x 8 pixels are off. Both are means over %d runs, of which the "
             "first is shown.",
             (int)f->repeats);
    f->chart.title = title;
    f->chart.note = note;
    f->chart.rows = ANGLES;
    f->chart.columns = LOOKS;
    f->chart.width = 1200;
    if (plot_save(&f->chart, "out/fig5.svg") != 0) return 1;
    return plot_png_linear("out/fig5.png", f->sheet.width, f->sheet.height, 3, f->sheet.value, f->exposure);
}

static metro_result prepare(figure *f)
{
    metro_render_options options;
    metro_result result;
    size_t size = ANGLES * f->side + (ANGLES - 1) * GAP, i;
    memset(&options, 0, sizeof options);
    options.width = options.height = f->side;
    options.depth = DEPTH;
    options.shortest = 2;
    result = light_reference(&f->scene, &options, 256, &f->reference, &f->noise);
    if (result == METRO_OK) result = metro_image_make(size, size, 3, &f->sheet);
    if (result != METRO_OK) return result;
    f->exposure = light_exposure(&f->reference, 0.2);
    for (i = 0; i < 3 * size * size; i++)
        f->sheet.value[i] = 1 / pow(2, f->exposure); /* white between the pictures */
    return METRO_OK;
}

int main(void)
{
    static figure f;
    metro_result result;
    size_t a;
    f.side = plot_quick() ? 32 : 64;
    f.repeats = plot_quick() ? 2 : 4;
    if (light_load("fig5", "examples/scenes/cornell.obj", &f.scene) != 0) return 1;
    result = prepare(&f);
    for (a = 0; a < ANGLES && result == METRO_OK; a++) {
        plot_progress((double)(a + 1) / (ANGLES + 1), "figure 5: chains");
        result = paint(&f, a);
    }
    plot_progress(1, "figure 5");
    if (result != METRO_OK) return light_complain("fig5", "render", result);
    if (write_table(&f) + save(&f) > 0) return 1;
    printf(
        "after %d samples a pixel the spots are off by %.0f %% at an apex angle of %g rad, %.0f %% at %g and %.0f %% "
        "at %g; independent noise of the same pixels would leave %.1f, %.1f and %.1f %%\n",
        (int)look[1], 100 * f.spots[0][1], angle[0], 100 * f.spots[1][1], angle[1], 100 * f.spots[2][1], angle[2],
        100 * f.rmse[0][1] / BLOCK, 100 * f.rmse[1][1] / BLOCK, 100 * f.rmse[2][1] / BLOCK);
    metro_image_free(&f.reference);
    metro_image_free(&f.sheet);
    metro_scene_free(&f.scene);
    return 0;
}
