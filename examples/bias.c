/* bias.c: how much of what is wrong with a picture is start-up bias, and how much is the noise of samples that
   follow each other closely? It belongs to section 3.2 of the paper, which saw bright and dark spots at small
   perturbations and blamed the start.

   Metropolis light transport as the paper does it (chapter 13), small pictures, and each of them many times with
   other random numbers. What all repeats have in common, less the reference, is bias; what differs is variance (eq
   7.13, signed, so that "none" comes out as 0 with its error). Five ways to start, and one to go on:

   - one point: one chain, which starts at the same state in every repeat, the first of uniform draws that is not
     dark;
   - 64 points: 64 chains, each with such a point of its own, the same ones in every repeat;
   - burn-in: the same 64 chains, of which about the first half is thrown away;
   - seeds: 64 chains; each starts at one of 16 random states (behind the door 64), chosen by importance;
   - weighted seeds: the same, and each chain counts by the mean importance of its 16 or 64 (section 4.6);
   - large steps: the 64 points, and one mutation in ten is an independent state.

   The lamp is not seen directly, and its pixels and those around it are left out: there the picture has spikes
   that no number of samples smooths. The mean brightness is taken as known, except with weighted seeds, which
   bring their own; the states that a seed is chosen from (one sample a pixel in all, behind the door four) are not
   counted. Spots are means of 4 x 4 pixels.

   See: grey is the variance, the lines are the squared biases. Once the start is forgotten bias falls with the
   square of the number of samples, variance with the number. In the lower row is the share of the spots that is
   bias: 0 is none. Behind the door chains forget so slowly that a start without weights is most of the error, and
   no large step helps, since nearly all of them are dark; but what weighted seeds lose in bias they may pay in
   variance. bias_picture.svg shows one run and the mean of all: the mean has lost the noise and keeps the bias.

   Writes out/bias.svg, out/bias_hidden.svg (a lamp behind a door), out/bias_picture.svg, out/bias.csv.
   There, bias2, variance and their errors are relative to the power of the reference, for single pixels and for
   spots. */

#define _POSIX_C_SOURCE 200809L
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { SIDE = 32, PIXELS = SIDE * SIDE, SPOT = 4, SPOTS = PIXELS / SPOT / SPOT, DEPTH = 5, CHAINS = 64, LOOKS = 9 };
enum { ONE_POINT, POINTS, BURN_IN, SEEDS, WEIGHTED, LARGE_STEPS, POLICIES, REFERENCE };
enum { ANGLES = 3, SHOWN = 2 }; /* the picture is shown at look number SHOWN */

static const char *const policy_name[POLICIES] = { "one point", "64 points",      "burn-in",
                                                   "seeds",     "weighted seeds", "large steps" };
static const double angle[ANGLES] = { 0.05, 0.15, 0.45 };
static const uint64_t look[LOOKS] = { 1, 2, 5, 10, 20, 40, 80, 160, 320 };

/* A scene, what is known of it, and how long it may be looked at. */
typedef struct {
    const char *name, *title, *path;
    uint64_t reference_rounds;
    size_t repeats;
    size_t looks, looks_points; /* of the other policies, and of the 64 points */
    size_t candidates;          /* for each seed */
    metro_scene scene;
    unsigned char mask[PIXELS];
    double truth[PIXELS], spot[SPOTS];
    double mean, power, noise; /* of the reference: its mean, its mean square, the variance that is left in it */
} setting;

/* The error of one policy after one look: of single pixels and of spots, relative to the power. */
typedef struct {
    metro_bias_variance pixel, spot;
    double share, share_error; /* of bias^2 in the squared error of the spots */
} verdict;

typedef struct {
    verdict at[ANGLES][POLICIES][LOOKS];
    size_t looks[POLICIES];
} findings;

static double mean_of(const double *picture)
{
    double sum = 0;
    int i;
    for (i = 0; i < PIXELS; i++) sum += picture[i];
    return sum / PIXELS;
}

/* Means over the pixels of each spot that are not left out; 0 where all are. */
static void spots_of(const double *picture, const unsigned char *mask, double *spot)
{
    double used[SPOTS] = { 0 };
    int i;
    for (i = 0; i < SPOTS; i++) spot[i] = 0;
    for (i = 0; i < PIXELS; i++) {
        int at = i / SIDE / SPOT * (SIDE / SPOT) + i % SIDE / SPOT;
        if (mask[i] != 0) spot[at] += picture[i], used[at]++;
    }
    for (i = 0; i < SPOTS; i++)
        if (used[i] > 0) spot[i] /= used[i];
}

/* Keeps of `rows` pictures the pixels that are not left out, in place; returns how many are left of one. */
static size_t unmask(double *picture, size_t rows, const unsigned char *mask)
{
    size_t r, i, out = 0;
    for (r = 0; r < rows; r++)
        for (i = 0; i < PIXELS; i++)
            if (mask[i] != 0) picture[out++] = picture[r * PIXELS + i];
    return out / rows;
}

static metro_render_options options_of(int policy, double apex, size_t candidates)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.width = options.height = SIDE;
    options.depth = DEPTH;
    options.shortest = 2;
    options.seed = 1;
    options.method = policy == REFERENCE ? METRO_BDPT : METRO_MLT;
    options.perturbation = apex;
    options.chains = policy == ONE_POINT ? 1 : CHAINS;
    options.candidates = policy == ONE_POINT ? candidates * CHAINS : candidates;
    options.start = policy == SEEDS      ? METRO_START_SEEDS
                    : policy == WEIGHTED ? METRO_START_WEIGHTED
                                         : METRO_START_POINT;
    options.large_step = policy == LARGE_STEPS ? 0.1 : 0;
    return options;
}

/* The luminance of all repeats at all looks, to be freed; NULL after a message. Each picture is scaled to `mean`
   unless that is 0. */
static double *pictures_of(const metro_scene *scene, const metro_render_options *options, const uint64_t *rounds,
                           size_t looks, size_t repeats, double mean)
{
    light_study study;
    metro_result result;
    size_t i, k;
    memset(&study, 0, sizeof study);
    study.scene = scene;
    study.options = *options;
    study.rounds = rounds;
    study.looks = looks;
    study.repeats = repeats;
    result = light_study_run(&study);
    if (result != METRO_OK) {
        light_complain("bias", "a picture", result);
        return NULL;
    }
    light_luminance(study.picture, looks * repeats * PIXELS, study.picture);
    for (k = 0; mean > 0 && k < looks * repeats; k++) {
        double *picture = study.picture + k * PIXELS, factor = mean / mean_of(picture);
        for (i = 0; i < PIXELS; i++) picture[i] *= factor;
    }
    free(study.report);
    free(study.seconds);
    return study.picture;
}

/* The reference: the mean of sixteen shares of bidirectional path tracing, whose spread says what noise is left. */
static int reference(setting *s, size_t used)
{
    enum { SHARES = 16 };
    metro_render_options options = options_of(REFERENCE, 0, 0);
    double *share = pictures_of(&s->scene, &options, &s->reference_rounds, 1, SHARES, 0);
    size_t i, r;
    if (share == NULL) return 1;
    for (i = 0; i < PIXELS; i++) {
        for (r = 0; r < SHARES; r++) s->truth[i] += share[r * PIXELS + i] / SHARES;
        if (s->mask[i] == 0) continue;
        s->power += s->truth[i] * s->truth[i] / (double)used;
        for (r = 0; r < SHARES; r++)
            s->noise += pow(share[r * PIXELS + i] - s->truth[i], 2) / (SHARES * (SHARES - 1)) / (double)used;
    }
    s->mean = mean_of(s->truth);
    free(share);
    return 0;
}

static int prepare(setting *s)
{
    if (light_load("bias", s->path, &s->scene) != 0) return 1;
    if (reference(s, light_mask(&s->scene, SIDE, SIDE, s->mask)) != 0) return 1;
    spots_of(s->truth, s->mask, s->spot);
    return 0;
}

/* Makes of what chains saw until each look what they saw since the look before. From the last backwards. */
static void leave_out_beginnings(double *picture, size_t looks, size_t repeats)
{
    size_t k, i, size = repeats * PIXELS;
    for (k = looks; k-- > 1;) {
        double all = (double)look[k], first = (double)look[k - 1];
        for (i = 0; i < size; i++)
            picture[k * size + i] =
                (all * picture[k * size + i] - first * picture[(k - 1) * size + i]) / (all - first);
    }
}

/* In units of `power`; the noise of the reference is no bias. */
static void scale(metro_bias_variance *error, double power, double noise)
{
    error->bias2 = (error->bias2 - noise) / power;
    error->bias2_error /= power;
    error->variance /= power;
    error->variance_error /= power;
    error->mse = (error->mse - noise) / power;
    error->mse_error /= power;
}

static void judge_share(verdict *v)
{
    double b = v->spot.bias2, r = v->spot.variance, all = b + r;
    v->share = b / all;
    v->share_error = hypot(r * v->spot.bias2_error, b * v->spot.variance_error) / (all * all);
}

/* Takes bias and variance apart after one look; `picture` has all repeats and loses its masked pixels. */
static int judge(const setting *s, double *picture, verdict *v)
{
    double *spot = (double *)malloc(s->repeats * SPOTS * sizeof *spot), truth[PIXELS];
    size_t r, used;
    metro_result result = METRO_ERROR_MEMORY;
    if (spot == NULL) return light_complain("bias", "spots", result);
    for (r = 0; r < s->repeats; r++) spots_of(picture + r * PIXELS, s->mask, spot + r * SPOTS);
    used = unmask(picture, s->repeats, s->mask);
    memcpy(truth, s->truth, sizeof truth);
    unmask(truth, 1, s->mask);
    result = metro_repeats(picture, truth, s->repeats, used, &v->pixel);
    if (result == METRO_OK) result = metro_repeats(spot, s->spot, s->repeats, SPOTS, &v->spot);
    free(spot);
    if (result != METRO_OK) return light_complain("bias", "bias and variance", result);
    scale(&v->pixel, s->power, s->noise);
    scale(&v->spot, s->power, s->noise / (SPOT * SPOT)); /* pixels are independent in the reference */
    judge_share(v);
    return 0;
}

static void write_down(plot_csv *csv, const setting *s, int policy, double apex, size_t k, const verdict *v)
{
    plot_csv_text(csv, s->name);
    plot_csv_text(csv, policy_name[policy]);
    PLOT_CSV_ROW(csv, apex, (double)look[k], (double)s->repeats, v->pixel.bias2, v->pixel.bias2_error,
                 v->pixel.variance, v->pixel.variance_error, v->spot.bias2, v->spot.bias2_error, v->spot.variance,
                 v->spot.variance_error, v->share, v->share_error);
}

/* One run and the mean of all: what bias looks like. */
typedef struct {
    double run[PIXELS], mean[PIXELS];
} exhibit;

static void show(const double *picture, size_t repeats, exhibit *e)
{
    size_t r, i;
    memcpy(e->run, picture, sizeof e->run);
    memset(e->mean, 0, sizeof e->mean);
    for (r = 0; r < repeats; r++)
        for (i = 0; i < PIXELS; i++) e->mean[i] += picture[r * PIXELS + i] / (double)repeats;
}

/* All looks at the pictures of a policy. */
static int judge_all(const setting *s, int policy, int a, double *picture, findings *f, plot_csv *csv)
{
    size_t k;
    for (k = policy == BURN_IN; k < f->looks[policy]; k++) {
        verdict *v = &f->at[a][policy][k];
        if (judge(s, picture + k * s->repeats * PIXELS, v) != 0) return 1;
        write_down(csv, s, policy, angle[a], k, v);
    }
    return 0;
}

/* The burn-in needs no runs of its own. */
static int judge_burn_in(const setting *s, int a, const double *picture, findings *f, plot_csv *csv)
{
    size_t size = f->looks[BURN_IN] * s->repeats * PIXELS;
    double *later = (double *)malloc(size * sizeof *later);
    int failed;
    if (later == NULL) return light_complain("bias", "burn-in", METRO_ERROR_MEMORY);
    memcpy(later, picture, size * sizeof *later);
    leave_out_beginnings(later, f->looks[BURN_IN], s->repeats);
    failed = judge_all(s, BURN_IN, a, later, f, csv);
    free(later);
    return failed;
}

static int measure(const setting *s, int policy, int a, findings *f, plot_csv *csv, exhibit *e)
{
    metro_render_options options = options_of(policy, angle[a], s->candidates);
    double mean = policy == WEIGHTED ? 0 : s->mean;
    double *picture = pictures_of(&s->scene, &options, look, f->looks[policy], s->repeats, mean);
    int failed;
    if (picture == NULL) return 1;
    if (e != NULL) show(picture + SHOWN * s->repeats * PIXELS, s->repeats, e);
    failed = policy == POINTS && judge_burn_in(s, a, picture, f, csv) != 0;
    failed = failed || judge_all(s, policy, a, picture, f, csv) != 0;
    free(picture);
    return failed;
}

/* The variance of the 64 points as a line, and from the least to the largest of all starts as a band; weighted seeds
   have their own line, since their weights may scatter more than all else. */
static void draw_variance(plot_panel *panel, const findings *f, int a)
{
    double x[LOOKS], low[LOOKS], high[LOOKS], line[LOOKS], weighted[LOOKS];
    int policy;
    size_t k;
    for (k = 0; k < f->looks[POINTS]; k++) {
        x[k] = (double)look[k];
        low[k] = high[k] = line[k] = f->at[a][POINTS][k].pixel.variance;
        weighted[k] = f->at[a][WEIGHTED][k].pixel.variance;
        for (policy = 0; policy < POLICIES; policy++) {
            if (policy == BURN_IN || policy == WEIGHTED || k >= f->looks[policy]) continue;
            low[k] = fmin(low[k], f->at[a][policy][k].pixel.variance);
            high[k] = fmax(high[k], f->at[a][policy][k].pixel.variance);
        }
    }
    plot_band(panel, x, low, high, f->looks[WEIGHTED], NULL)->color = 0x777777;
    plot_line(panel, x, line, k, a == 0 ? "variance" : NULL)->color = 0x777777;
    plot_line(panel, x, weighted, f->looks[WEIGHTED], NULL)->color = plot_palette(WEIGHTED);
    panel->last->dash = 1;
}

/* The squared biases over the variance. A bias is drawn where it is above two standard errors. */
static void draw_errors(plot_panel *panel, const findings *f, int a)
{
    double x[LOOKS], y[LOOKS], error[LOOKS];
    int policy;
    size_t k;
    draw_variance(panel, f, a);
    for (policy = 0; policy < POLICIES; policy++) {
        for (k = 0; k < f->looks[policy]; k++) {
            const metro_bias_variance *e = &f->at[a][policy][k].pixel;
            x[k] = (double)look[k];
            y[k] = e->bias2 > 2 * e->bias2_error && e->bias2_error > 0 ? e->bias2 : (double)NAN;
            error[k] = e->bias2_error;
        }
        plot_line(panel, x, y, k, NULL)->color = plot_palette((size_t)policy);
        plot_points(panel, x, y, error, k, NULL)->color = plot_palette((size_t)policy);
    }
}

static void draw_shares(plot_panel *panel, const findings *f, int a)
{
    double x[LOOKS], y[LOOKS], error[LOOKS];
    int policy;
    size_t k, first;
    plot_rule_y(panel, 0, NULL);
    for (policy = 0; policy < POLICIES; policy++) {
        first = policy == BURN_IN;
        for (k = 0; k < f->looks[policy]; k++) {
            x[k] = (double)look[k] * (1 + 0.03 * (policy - 2.5)); /* side by side */
            y[k] = 100 * f->at[a][policy][k].share;
            error[k] = 100 * f->at[a][policy][k].share_error;
        }
        plot_line(panel, x + first, y + first, k - first, a == 0 ? policy_name[policy] : NULL)->color =
            plot_palette((size_t)policy);
        plot_points(panel, x + first, y + first, error + first, k - first, NULL)->color =
            plot_palette((size_t)policy);
    }
}

static int draw(const setting *s, const findings *f, const char *path)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    const verdict *v[3];
    char title[200];
    char note[400];
    double most = 0, least;
    int a, policy;
    snprintf(note, sizeof note,
             "%s, %d x %d pixels, %d repeats. Upper row: squared bias of single pixels "
             "(lines, with standard errors; left out below two of them) and variance (grey; of weighted seeds "
             "dashed). Lower "
             "row: the share of bias in the squared error of spots of 4 x 4 pixels, signed; the title is for 20 "
             "samples per pixel at %g rad.",
             s->title, SIDE, SIDE, (int)s->repeats, angle[0]);
    for (a = 0; a < ANGLES; a++)
        for (policy = 0; policy < POLICIES; policy++)
            if (f->at[a][policy][0].pixel.mse > 0) most = fmax(most, 2 * f->at[a][policy][0].pixel.mse);
    least = f->at[ANGLES - 1][POINTS][f->looks[POINTS] - 1].pixel.variance / 10;
    v[0] = &f->at[0][ONE_POINT][4];
    v[1] = &f->at[0][POINTS][4];
    v[2] = &f->at[0][WEIGHTED][4];
    snprintf(title, sizeof title,
             "How much of the spots is start-up bias? From 64 fixed points %.0f %%, from one point %.0f %%, "
             "from weighted seeds %.0f %%",
             100 * fmax(v[1]->share, 0), 100 * fmax(v[0]->share, 0), 100 * fmax(v[2]->share, 0));
    chart.title = title;
    chart.note = note;
    chart.rows = 2;
    chart.columns = ANGLES;
    chart.width = 1500;
    chart.height = 1000;
    for (a = 0; a < ANGLES; a++) {
        plot_panel *error = &chart.panel[a], *share = &chart.panel[ANGLES + a];
        error->title = plot_say(error, "apex angle % rad", angle[a]);
        error->x_log = error->y_log = share->x_log = 1;
        error->y_label = "squared error / power";
        error->y_min = least;
        error->y_max = most;
        error->x_label = share->x_label = "samples per pixel";
        share->y_label = "bias in the spots, %";
        error->x_min = share->x_min = 0.9;
        error->x_max = share->x_max = 1.25 * (double)look[f->looks[POINTS] - 1];
        share->y_min = -20;
        share->y_max = 100;
        draw_errors(error, f, a);
        draw_shares(share, f, a);
    }
    return plot_save(&chart, path);
}

/* A picture of `side` x `side` shown bright enough, each pixel as a square. */
static void put_picture(plot_panel *panel, const char *title, const char *caption, const double *brightness,
                        double white)
{
    enum { ZOOM = 8, LARGE = SIDE * ZOOM };
    static unsigned char byte[LARGE * LARGE];
    size_t i;
    for (i = 0; i < LARGE * LARGE; i++) {
        double value = brightness[i / LARGE / ZOOM * SIDE + i % LARGE / ZOOM] / white;
        value = value > 0 ? value < 1 ? value : 1 : 0;
        byte[i] = (unsigned char)(255 * pow(value, 1 / 2.2) + 0.5);
    }
    plot_picture(panel, LARGE, LARGE, 1, byte);
    panel->title = title;
    panel->x_label = caption;
}

static int draw_pictures(const setting *s, const exhibit *e)
{
    plot_chart chart =
        plot_chart_make("What start-up bias looks like: it stays when runs are averaged",
                        "Where all runs start at the same 64 states, their mean keeps the spots of the "
                        "start. Weighted seeds leave noise, which the mean loses.");
    static const char *const title[2] = { "64 points", "weighted seeds" };
    char run[80], mean[80];
    double white = 2.5 * s->mean;
    int i;
    snprintf(run, sizeof run, "one run, %d samples per pixel, apex angle %g", (int)look[SHOWN], angle[0]);
    snprintf(mean, sizeof mean, "mean of %d such runs", (int)s->repeats);
    chart.rows = 2;
    chart.columns = 3;
    chart.width = 1000;
    for (i = 0; i < 2; i++) {
        put_picture(&chart.panel[3 * i], title[i], run, e[i].run, white);
        put_picture(&chart.panel[3 * i + 1], NULL, mean, e[i].mean, white);
        put_picture(&chart.panel[3 * i + 2], NULL, "reference", s->truth, white);
    }
    return plot_save(&chart, "out/bias_picture.svg");
}

/* The table, and what it says. */
static void report(const setting *s, const findings *f)
{
    static const size_t column[4] = { 0, 2, 4, 6 };
    int a, policy, k;
    printf("%s: share of bias in the spots, %%, at 1, 5, 20 and 80 samples per pixel\n", s->title);
    for (a = 0; a < ANGLES; a++)
        for (policy = 0; policy < POLICIES; policy++) {
            printf("  apex %.2f  %-24s", angle[a], policy_name[policy]);
            for (k = 0; k < 4; k++) {
                const verdict *v = &f->at[a][policy][column[k]];
                if (column[k] >= f->looks[policy] || !(v->spot.variance > 0)) printf("  %-15s", "-");
                else printf("  %5.1f +- %-6.1f", 100 * v->share, 100 * v->share_error);
            }
            printf("\n");
        }
}

/* The share of bias in the spots at 20 samples per pixel, in words that follow from it. */
static void conclude(const setting *s, const findings *f)
{
    static const int policy[3] = { ONE_POINT, POINTS, WEIGHTED };
    int i, a;
    printf("%s, start-up bias in the spots at 20 samples per pixel:", s->title);
    for (i = 0; i < 3; i++) {
        double largest = 0;
        for (a = 0; a < ANGLES; a++) largest = fmax(largest, f->at[a][policy[i]][4].share);
        printf("%s %.0f +- %.0f %% from %s%s", i > 0 ? ";" : "", 100 * f->at[0][policy[i]][4].share,
               100 * f->at[0][policy[i]][4].share_error, policy_name[policy[i]],
               largest > 0.5   ? " (bias prevails)"
               : largest > 0.1 ? " (noise prevails)"
                               : " (noise alone)");
    }
    printf("\n");
}

static int study(setting *s, findings *f, plot_csv *csv, exhibit *e, double from, double to)
{
    int policy, a, done = 0;
    if (prepare(s) != 0) return 1;
    for (policy = 0; policy < POLICIES; policy++)
        f->looks[policy] = policy == POINTS || policy == BURN_IN ? s->looks_points : s->looks;
    for (a = 0; a < ANGLES; a++)
        for (policy = 0; policy < POLICIES; policy++) {
            exhibit *shown = a > 0 || e == NULL ? NULL : policy == POINTS ? e : policy == WEIGHTED ? e + 1 : NULL;
            if (policy == BURN_IN) continue;
            if (measure(s, policy, a, f, csv, shown) != 0) return 1;
            plot_progress(from + (to - from) * ++done / (double)(ANGLES * (POLICIES - 1)), "bias");
        }
    return 0;
}

int main(void)
{
    static setting cornell = {
        "cornell", "Cornell box", "examples/scenes/cornell.obj", 48, 32, 6, 9, 16, { 0 }, { 0 }, { 0 }, { 0 }, 0, 0, 0
    };
    static setting hidden = { "hidden",
                              "Lamp behind a door",
                              "examples/scenes/hidden.obj",
                              240,
                              24,
                              5,
                              6,
                              64,
                              { 0 },
                              { 0 },
                              { 0 },
                              { 0 },
                              0,
                              0,
                              0 };
    static findings in_cornell, in_hidden;
    static exhibit shown[2];
    plot_csv csv =
        plot_csv_open("out/bias.csv", "scene,start,apex,samples_per_pixel,repeats,bias2,bias2_error,variance,"
                                      "variance_error,spot_bias2,spot_bias2_error,spot_variance,"
                                      "spot_variance_error,share,share_error");
    if (plot_quick()) {
        cornell.repeats = 8;
        hidden.repeats = 6;
        cornell.looks = cornell.looks_points = hidden.looks = hidden.looks_points = 5;
        cornell.reference_rounds = 12;
        hidden.reference_rounds = 24;
    }
    if (study(&cornell, &in_cornell, &csv, shown, 0, 0.7) != 0) return 1;
    if (study(&hidden, &in_hidden, &csv, NULL, 0.7, 1) != 0) return 1;
    if (plot_csv_close(&csv) != 0) return 1;
    if (draw(&cornell, &in_cornell, "out/bias.svg") != 0) return 1;
    if (draw(&hidden, &in_hidden, "out/bias_hidden.svg") != 0) return 1;
    if (draw_pictures(&cornell, shown) != 0) return 1;
    report(&cornell, &in_cornell);
    report(&hidden, &in_hidden);
    conclude(&cornell, &in_cornell);
    conclude(&hidden, &in_hidden);
    metro_scene_free(&cornell.scene);
    metro_scene_free(&hidden.scene);
    return 0;
}
