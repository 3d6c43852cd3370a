/* picture.c: Metropolis sampling of a picture: `picture`, or `picture YOURS.ppm`, or a .pfm.

   The state is a point of the picture and the importance its luminance, so the chain spends its time where the
   picture is bright, and the histogram of where it was is the picture again. A row of the sheet shows what a number
   of mutations per pixel has found; the start is the same dark corner in every row.

   See: small steps leave the start and then paint wrong bright and dark spots, as in figure 5 of the paper; large
   ones give honest noise; one large step in ten cures the small ones. Dark parts stay noisy for all: the chain seldom
   goes there.

   Writes out/picture_sheet.svg, out/picture.svg (error against mutations), out/picture.csv, and what the last way
   painted as out/picture.png and out/picture.pfm. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { WAYS = 4, LOOKS = 5 };

typedef struct {
    const char *name;
    double size, large_step;
} way;

static const way ways[WAYS] = { { "steps of .02", 0.02, 0 },
                                { "steps of .1", 0.1, 0 },
                                { "steps of .5", 0.5, 0 },
                                { "steps of .02, one in ten large", 0.02, 0.1 } };

/* What the chain needs: the picture, and where the samples go. */
typedef struct {
    const metro_image *picture;
    double *value; /* sums of weight * f/I, in the layout of the picture */
} easel;

/* A sample is its pixel, with f/I: the colour divided by its luminance. */
typedef struct {
    size_t pixel;
    double share[3];
} dab;

static double importance(const double *z, void *sample, void *user)
{
    const metro_image *picture = ((const easel *)user)->picture;
    dab *d = (dab *)sample;
    size_t x = (size_t)(z[0] * (double)picture->width), y = (size_t)(z[1] * (double)picture->height), c;
    const double *value;
    double luminance;
    if (x >= picture->width) x = picture->width - 1;
    if (y >= picture->height) y = picture->height - 1;
    d->pixel = y * picture->width + x;
    value = picture->value + d->pixel * picture->channels;
    luminance = picture->channels == 3 ? metro_luminance(value[0], value[1], value[2]) : value[0];
    for (c = 0; c < picture->channels; c++) d->share[c] = luminance > 0 ? value[c] / luminance : 0;
    return luminance;
}

static void record(const void *sample, double weight, void *user)
{
    const easel *e = (const easel *)user;
    const dab *d = (const dab *)sample;
    size_t channels = e->picture->channels, c;
    for (c = 0; c < channels; c++) e->value[d->pixel * channels + c] += weight * d->share[c];
}

/* The picture used when none is given: a dark room with a lamp, its light on a wall, and a coloured globe. */
static metro_result built_in(metro_image *picture)
{
    size_t x, y, c;
    metro_result result = metro_image_make(96, 72, 3, picture);
    for (y = 0; result == METRO_OK && y < 72; y++)
        for (x = 0; x < 96; x++) {
            double u = ((double)x + 0.5) / 96, v = ((double)y + 0.5) / 72, *value = picture->value + (y * 96 + x) * 3;
            double lamp = (u - 0.7) * (u - 0.7) + (v - 0.25) * (v - 0.25),
                   globe = hypot((u - 0.28) * 4 / 3, v - 0.62);
            double wall = 0.02 + 0.04 / (lamp + 0.04);
            static const double paint[3] = { 1, 0.8, 0.55 }, glaze[3] = { 0.15, 0.45, 0.9 };
            for (c = 0; c < 3; c++) {
                value[c] = wall * paint[c] * (v > 0.8 ? 0.35 : 0.6);
                if (globe < 0.2)
                    value[c] =
                        glaze[c] * (0.03 + 0.8 * exp(-((u - 0.33) * (u - 0.33) + (v - 0.53) * (v - 0.53)) / 0.008));
                if (lamp < 0.003) value[c] = 4 * paint[c];
            }
        }
    return result;
}

/* Where a start must not be: black pixels. Takes the first pixel with light, from the lower left corner. */
static int find_start(const metro_image *picture, double *z)
{
    size_t i;
    dab d;
    easel e = { NULL, NULL };
    e.picture = picture;
    for (i = 0; i < picture->width * picture->height; i++) {
        z[0] = ((double)(i % picture->width) + 0.5) / (double)picture->width;
        z[1] = ((double)(picture->height - 1 - i / picture->width) + 0.5) / (double)picture->height;
        if (importance(z, &d, &e) > 0) return 1;
    }
    return 0;
}

/* Paints with one chain; after each number of mutations a pixel it fills one picture and measures its error. */
static metro_result paint(const metro_image *picture, const way *how, const double *mutations, metro_image *painted,
                          double *error)
{
    metro_axis axes[2] = { { METRO_INTERVAL, { METRO_UNIFORM, 1, 0, 0 } },
                           { METRO_INTERVAL, { METRO_UNIFORM, 1, 0, 0 } } };
    metro_chain_options options = { 0, 1 };
    size_t samples = picture->width * picture->height * picture->channels, i;
    double pixels = (double)(picture->width * picture->height), start[2], b;
    easel e = { NULL, NULL };
    metro_target target;
    metro_chain chain;
    metro_result result;
    int look;
    memset(&target, 0, sizeof target);
    axes[0].kernel.size = axes[1].kernel.size = how->size;
    options.large_step = how->large_step;
    e.picture = picture;
    target.axes = axes;
    target.axis_count = 2;
    target.sample_size = sizeof(dab);
    target.importance = importance;
    target.record = record;
    target.user = &e;
    e.value = (double *)calloc(samples, sizeof *e.value);
    if (e.value == NULL) return METRO_ERROR_MEMORY;
    result = metro_chain_make(&target, &options, metro_rng_make(7, 0), &chain);
    if (result != METRO_OK) {
        free(e.value);
        return result;
    }
    metro_chain_survey(&chain, 100000); /* b is the mean luminance; here every way may know it well */
    b = metro_chain_b(&chain, NULL);
    result = find_start(picture, start) ? metro_chain_start_point(&chain, start) : METRO_ERROR_NO_IMPORTANCE;
    for (look = 0; look < LOOKS && result == METRO_OK; look++) {
        metro_image_difference difference;
        metro_chain_run(&chain, (uint64_t)(mutations[look] * pixels) - chain.counts.steps);
        for (i = 0; i < samples; i++)
            painted[look].value[i] = e.value[i] * b * pixels / (double)chain.counts.steps; /* eq 4.1 */
        result = metro_image_error(&painted[look], picture, &difference);
        error[look] = difference.relative_rmse;
    }
    metro_chain_free(&chain);
    free(e.value);
    return result;
}

/* Hangs a picture into the sheet: rows are ways, columns numbers of mutations, the last column is the original. */
static int hang(plot_chart *sheet, int row, int column, const metro_image *image, const char *title,
                const char *caption)
{
    plot_panel *panel = &sheet->panel[row * (LOOKS + 1) + column];
    unsigned char *bytes = plot_bytes(image->width, image->height, (int)image->channels, image->value, 0);
    if (bytes == NULL) return 1;
    panel->title = row == 0 ? title : NULL;
    panel->x_label = column == 0 ? caption : NULL;
    plot_picture(panel, image->width, image->height, (int)image->channels, bytes);
    free(bytes);
    return 0;
}

int main(int argc, char **argv)
{
    static const double full[LOOKS] = { 0.25, 1, 4, 16, 64 };
    plot_chart chart =
        plot_chart_make("Small steps paint wrong spots; larger ones, or a few uniform ones, do not",
                        "Relative error of the picture against mutations per pixel: one chain for each way, from the "
                        "same dark corner. Independent samples would fall with slope -1/2.");
    plot_csv csv = plot_csv_open("out/picture.csv", "way,size,large_step,mutations_per_pixel,relative_rmse");
    plot_chart sheet =
        plot_chart_make("What a chain has seen of the picture",
                        "From left to right 1/4, 1, 4, 16 and 64 mutations a pixel, and the original.");
    static const char *const column[LOOKS + 1] = { "1/4", "1", "4", "16", "64 a pixel", "original" };
    metro_image picture = { 0, 0, 0, NULL }, painted[LOOKS];
    char message[200];
    double error[WAYS][LOOKS];
    metro_result result = METRO_OK;
    int w, look;
    if (argc > 1 && metro_image_load(argv[1], &picture, message, sizeof message) != METRO_OK) {
        fprintf(stderr, "picture: %s\n", message);
        return 1;
    }
    memset(painted, 0, sizeof painted);
    if (argc <= 1) result = built_in(&picture);
    for (look = 0; look < LOOKS && result == METRO_OK; look++)
        result = metro_image_make(picture.width, picture.height, picture.channels, &painted[look]);
    sheet.rows = WAYS;
    sheet.columns = LOOKS + 1;
    sheet.width = 1400;
    printf("relative RMS error after so many mutations a pixel:\n%-32s", "");
    for (look = 0; look < LOOKS; look++) printf(" %7.4g", full[look]);
    printf("\n");
    for (w = 0; w < WAYS && result == METRO_OK; w++) {
        result = paint(&picture, &ways[w], full, painted, error[w]);
        printf("%-32s", ways[w].name);
        for (look = 0; look < LOOKS && result == METRO_OK; look++) {
            if (hang(&sheet, w, look, &painted[look], column[look], ways[w].name) != 0) result = METRO_ERROR_MEMORY;
            plot_csv_text(&csv, ways[w].name);
            PLOT_CSV_ROW(&csv, ways[w].size, ways[w].large_step, full[look], error[w][look]);
            printf(" %7.3f", error[w][look]);
        }
        printf("\n");
        if (result == METRO_OK) hang(&sheet, w, LOOKS, &picture, column[LOOKS], NULL);
        plot_line(&chart.panel[0], full, error[w], LOOKS, ways[w].name);
        plot_progress((w + 1.0) / WAYS, "picture");
    }
    if (result != METRO_OK) {
        fprintf(stderr, "picture: %s\n", metro_result_text(result));
        return 1;
    }
    chart.panel[0].x_log = chart.panel[0].y_log = 1;
    chart.panel[0].x_label = "mutations per pixel";
    chart.panel[0].y_label = "relative RMS error";
    chart.panel[0].better = "down and left is better";
    if (plot_csv_close(&csv) != 0 || plot_save(&chart, "out/picture.svg") != 0) return 1;
    if (plot_save(&sheet, "out/picture_sheet.svg") != 0) return 1;
    if (plot_png_linear("out/picture.png", picture.width, picture.height, (int)picture.channels,
                        painted[LOOKS - 1].value, 0) != 0)
        return 1;
    result = metro_image_save_pfm(&painted[LOOKS - 1], "out/picture.pfm");
    if (result != METRO_OK) fprintf(stderr, "picture: out/picture.pfm: %s\n", metro_result_text(result));
    for (look = 0; look < LOOKS; look++) metro_image_free(&painted[look]);
    metro_image_free(&picture);
    printf("at %.0f mutations a pixel the error is %.2f with %s and %.2f with %s\n", full[LOOKS - 1],
           error[0][LOOKS - 1], ways[0].name, error[3][LOOKS - 1], ways[3].name);
    return 0;
}
