/* pyramid.c: all ways to make a path, as pictures (section 3.1; Veach 1997, figure 10.3). A path of k edges can be
   made by s vertices of a walk from the lamp and t of one from the eye, for every s + t = k + 1. Row k of the pyramid
   holds these ways from s = 0 (the walk from the eye meets the lamp) to t = 1 (the walk from the lamp is joined to
   the eye).

   The first sheet shows what each way contributes when the power heuristic divides every path among the ways that can
   make it: the pictures of a row add up to what k edges do, and the rows to the picture. On the second sheet each way
   counts every path fully, so all pictures of a row are estimates of the same thing, the one at its end.

   See: on the second sheet, what each way does badly. Those that wait for the walk to meet the lamp (s = 0) are a few
   bright dots; those that join two points of surfaces (s and t at least 2) have bright grains where the two may be
   close, in corners; those from the lamp (t = 1) leave dark holes where few walks come. On the first sheet these
   faults are gone: each way is asked only for what it does well, and s = 0, with a lamp this small, for next to
   nothing.

   Writes out/pyramid.svg, out/pyramid_unweighted.svg, out/pyramid.csv, and the whole picture as out/pyramid.png and
   out/pyramid.pfm. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { DEPTH = 4, WAYS = DEPTH + 1, PARTS = 8, SUM = WAYS, COLUMNS = WAYS + 1, WHOLE = 3 };

/* What is known of one way: shares of the mean luminance of its row. */
typedef struct {
    double weighted;     /* with the heuristic */
    metro_moments alone; /* when it counts every path fully, over the parts of the run */
} share;

typedef struct {
    metro_scene scene;
    metro_image row[DEPTH + 1], whole; /* what k edges contribute, and all */
    double stops[DEPTH + 1];           /* by which the pictures of a row are brightened */
    share share[DEPTH + 1][WAYS];
    char title[2][DEPTH + 1][COLUMNS][60];
    plot_chart weighted, unweighted;
} pyramid;

static double mean_luminance(const metro_image *image)
{
    double sum = 0;
    size_t i, count = image->width * image->height;
    for (i = 0; i < count; i++)
        sum += metro_luminance(image->value[3 * i], image->value[3 * i + 1], image->value[3 * i + 2]);
    return sum / (double)count;
}

static void add_image(metro_image *to, const metro_image *image)
{
    size_t i;
    for (i = 0; i < 3 * to->width * to->height; i++) to->value[i] += image->value[i];
}

static void hang(pyramid *p, int unweighted, int k, int s, const metro_image *image)
{
    plot_chart *chart = unweighted ? &p->unweighted : &p->weighted;
    char *title = p->title[unweighted][k][s];
    if (unweighted) snprintf(title, sizeof p->title[1][k][s], "s = %d, t = %d", s, k + 1 - s);
    else
        snprintf(title, sizeof p->title[0][k][s], "s = %d, t = %d: %.0f %%", s, k + 1 - s,
                 100 * p->share[k][s].weighted);
    light_hang(&chart->panel[(k - 1) * COLUMNS + s], image, p->stops[k], title, NULL);
}

static metro_result start(const pyramid *p, size_t side, metro_heuristic heuristic, uint64_t part,
                          metro_render *render)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = side;
    options.depth = DEPTH;
    options.heuristic = heuristic;
    options.pyramid = 1;
    options.part = part;
    return metro_render_make(&p->scene, &p->scene.camera, &options, render);
}

/* ---- The weighted pictures ---- */

/* The picture of a row is the sum of its ways. Its exposure, in whole stops, brings its mean to a middle grey; lamps
   seen directly, the row of one edge, are shown as they would be in the whole. */
static metro_result sum_row(pyramid *p, const metro_render *render, int k)
{
    metro_image way;
    metro_result result = metro_image_make(p->whole.width, p->whole.height, 3, &p->row[k]);
    int s;
    for (s = 0; s <= k && result == METRO_OK; s++) {
        result = metro_render_way(render, s, k + 1 - s, &way);
        if (result != METRO_OK) break;
        add_image(&p->row[k], &way);
        p->share[k][s].weighted = mean_luminance(&way);
        metro_image_free(&way);
    }
    for (s = 0; s <= k && result == METRO_OK; s++) p->share[k][s].weighted /= mean_luminance(&p->row[k]);
    p->stops[k] = floor(light_exposure(k > 1 ? &p->row[k] : &p->whole, 0.2) + 0.5);
    return result;
}

static metro_result hang_row(pyramid *p, const metro_render *render, int k)
{
    metro_image way;
    char *title = p->title[0][k][SUM];
    int s, sheet;
    for (s = 0; s <= k; s++) {
        metro_result result = metro_render_way(render, s, k + 1 - s, &way);
        if (result != METRO_OK) return result;
        hang(p, 0, k, s, &way);
        metro_image_free(&way);
    }
    snprintf(title, sizeof p->title[0][k][SUM], "%d edge%s, light $times$ %g", k, k > 1 ? "s" : "",
             pow(2, p->stops[k]));
    for (sheet = 0; sheet < 2; sheet++)
        light_hang(&(sheet ? &p->unweighted : &p->weighted)->panel[(k - 1) * COLUMNS + SUM], &p->row[k], p->stops[k],
                   title, NULL);
    return METRO_OK;
}

/* The largest difference between the sum of all rows and the picture, relative to the brightest sample. */
static double difference(const pyramid *p)
{
    double worst = 0, brightest = 0;
    size_t i;
    int k;
    for (i = 0; i < 3 * p->whole.width * p->whole.height; i++) {
        double sum = 0;
        for (k = 1; k <= DEPTH; k++) sum += p->row[k].value[i];
        worst = fmax(worst, fabs(sum - p->whole.value[i]));
        brightest = fmax(brightest, p->whole.value[i]);
    }
    return worst / brightest;
}

static metro_result make_weighted(pyramid *p, size_t side, uint64_t rounds)
{
    metro_render render;
    metro_result result = start(p, side, METRO_POWER, 0, &render);
    int k;
    if (result != METRO_OK) return result;
    result = metro_render_run(&render, rounds, NULL, NULL);
    if (result == METRO_OK) result = metro_render_image(&render, &p->whole);
    for (k = 1; k <= DEPTH && result == METRO_OK; k++) result = sum_row(p, &render, k);
    for (k = 1; k <= DEPTH && result == METRO_OK; k++) result = hang_row(p, &render, k);
    metro_render_free(&render);
    return result;
}

/* ---- Each way alone ---- */

/* Several independent parts, so that the means of the ways have errors; the first is shown. */
static metro_result make_unweighted(pyramid *p, size_t side, uint64_t rounds)
{
    metro_render render;
    metro_image way;
    uint64_t part;
    int k, s;
    for (part = 0; part < PARTS; part++) {
        metro_result result = start(p, side, METRO_UNWEIGHTED, part + 1, &render);
        if (result != METRO_OK) return result;
        plot_progress(0.4 + 0.6 * (double)part / PARTS, "pyramid");
        result = metro_render_run(&render, rounds, NULL, NULL);
        for (k = 1; k <= DEPTH && result == METRO_OK; k++)
            for (s = 0; s <= k && result == METRO_OK; s++) {
                result = metro_render_way(&render, s, k + 1 - s, &way);
                if (result != METRO_OK) break;
                metro_moments_add(&p->share[k][s].alone, mean_luminance(&way) / mean_luminance(&p->row[k]));
                if (part == 0) hang(p, 1, k, s, &way);
                metro_image_free(&way);
            }
        metro_render_free(&render);
        if (result != METRO_OK) return result;
    }
    return METRO_OK;
}

/* ---- What comes out ---- */

static int write_table(const pyramid *p)
{
    plot_csv csv = plot_csv_open("out/pyramid.csv", "edges,s,t,share,alone,alone_error,mean_luminance_of_row");
    int k, s;
    printf("the luminance of each way, of that of its row: its share when weighted, and its own estimate alone\n");
    for (k = 1; k <= DEPTH; k++) {
        printf("%d edge%s", k, k > 1 ? "s" : " ");
        for (s = 0; s <= k; s++) {
            const share *at = &p->share[k][s];
            double alone = metro_moments_mean(&at->alone), error = metro_moments_error(&at->alone);
            printf("  (%d,%d) %4.1f%%, %.3f+-%.3f", s, k + 1 - s, 100 * at->weighted, alone, error);
            PLOT_CSV_ROW(&csv, (double)k, (double)s, k + 1.0 - s, at->weighted, alone, error,
                         mean_luminance(&p->row[k]));
        }
        printf("\n");
    }
    return plot_csv_close(&csv);
}

static int save(pyramid *p)
{
    char note[2][400];
    snprintf(
        note[0], sizeof note[0],
        "s vertices from the lamp, t from the eye, weighted by the power heuristic; with the share of each in the "
        "luminance of its row. Each row adds up to its last picture, and these to the whole (light $times$ %g). A "
        "row has one exposure, stated at its end.",
        pow(2, p->stops[1]));
    snprintf(
        note[1], sizeof note[1],
        "Every way counts each path fully, an eighth of the samples. All pictures of a row estimate the same, the "
        "last one, and share its exposure.");
    p->weighted.title = "Each way gives what it does well: the pictures add up to the picture";
    p->unweighted.title = "Alone, each way can make every path, and shows what it does badly";
    p->weighted.note = note[0];
    p->unweighted.note = note[1];
    p->weighted.rows = p->unweighted.rows = DEPTH;
    p->weighted.columns = p->unweighted.columns = COLUMNS;
    p->weighted.width = p->unweighted.width = 1500;
    light_hang(&p->weighted.panel[WHOLE], &p->whole, p->stops[1], "the whole picture", NULL);
    if (plot_save(&p->weighted, "out/pyramid.svg") + plot_save(&p->unweighted, "out/pyramid_unweighted.svg") > 0)
        return 1;
    return light_save("pyramid", "pyramid", &p->whole, p->stops[1]);
}

/* How far the luminance of ways alone is off, in percent: of those with s = 0, or of all others. */
static double farthest(const pyramid *p, int met)
{
    double worst = 0;
    int k, s;
    for (k = 1; k <= DEPTH; k++)
        for (s = met ? 0 : 1; s <= (met ? 0 : k); s++)
            worst = fmax(worst, 100 * fabs(metro_moments_mean(&p->share[k][s].alone) - 1));
    return worst;
}

static int summarize(const pyramid *p)
{
    double apart = difference(p);
    int s, best = 0;
    for (s = 0; s <= DEPTH; s++)
        if (p->share[DEPTH][s].weighted > p->share[DEPTH][best].weighted) best = s;
    if (!(apart < 1e-9)) {
        fprintf(stderr, "pyramid: the ways do not add up to the picture, by %g of its brightest sample\n", apart);
        return 1;
    }
    printf("%d ways add up to the picture; alone, their luminance is within %.1f %% of their row, %.1f %% where they "
           "wait "
           "to meet the lamp; of %d edges most comes from s = %d, t = %d: %.0f %%\n",
           (DEPTH + 1) * (DEPTH + 2) / 2 - 1, farthest(p, 0), farthest(p, 1), DEPTH, best, DEPTH + 1 - best,
           100 * p->share[DEPTH][best].weighted);
    return 0;
}

int main(void)
{
    static pyramid p;
    size_t side = plot_quick() ? 48 : 96;
    uint64_t rounds = plot_quick() ? 64 : 128;
    metro_result result;
    int k, failed;
    if (light_load("pyramid", "examples/scenes/cornell.obj", &p.scene) != 0) return 1;
    plot_progress(0.01, "pyramid");
    result = make_weighted(&p, side, rounds);
    if (result == METRO_OK) result = make_unweighted(&p, side, rounds / PARTS);
    plot_progress(1, "pyramid");
    if (result != METRO_OK) return light_complain("pyramid", "render", result);
    failed = write_table(&p) + save(&p) + summarize(&p);
    for (k = 1; k <= DEPTH; k++) metro_image_free(&p.row[k]);
    metro_image_free(&p.whole);
    metro_scene_free(&p.scene);
    return failed > 0;
}
