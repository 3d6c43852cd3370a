/* fig6.c: the paper's figure 6 (section 3.3): a path of ray bundles, drawn from a real walk through the test scene
   S2. A walk is a few directions. Along the first all patches send their emission, and only the lamp in the room
   behind has any. Along the next ones they send it again, and what the bundle before brought them, reflected into
   the direction of this bundle. Along all lines radiance moves both ways at once. What the last bundle brings is
   reflected to the eye.

   The walk is made with the functions of chapter 14 that a program of one's own would use, metro_patches_make and
   metro_bundle_transfer, and with metro_brdf: see `walk`. Of many drawn at random it is the one that brings most
   light to what both the eye and the drawing show. The rest is drawing: a parallel projection from the right side,
   where walls that show their backs are seen through. Patches have the colour and, compressed, the brightness of
   what they send along the bundle; of the lines a few are drawn (thin), and of those that carry much light a few
   more (orange, to where it arrives).

   See: lines of a bundle are parallel, so each patch talks to those that it faces along one direction only; the
   light needs three bundles and the last reflection to get out of the room behind, and few patches carry nearly all
   of it.

   Writes out/fig6.svg and out/fig6.csv. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { STEPS = 3, PANELS = STEPS + 1, TRIES = 1200, BRIGHT = 18, SEGMENTS = 20000, GRID = 64 };

typedef struct {
    metro_scene scene;
    metro_patches patches;
    unsigned char *seen; /* [count]: by the eye */
    metro_vec3 direction[STEPS];
    metro_vec3 *sent[PANELS]; /* [count] each: along the bundles, and at last to the eye */
    metro_vec3 *received;     /* [count] */
    metro_bundle_balance balance[STEPS];
} path;

/* To where the drawing is seen from. */
static const metro_vec3 viewer = { 1, 0.28, 0.42 };

/* ---- The walk ---- */

static const metro_material *material_of(const path *p, size_t patch)
{
    return metro_scene_material(&p->scene, p->scene.material_of[p->patches.patch[patch].triangle]);
}

static metro_vec3 middle_of(const metro_patch *patch)
{
    metro_vec3 sum = metro_add(metro_add(patch->corner[0], patch->corner[1]), patch->corner[2]);
    return metro_scale(sum, 1.0 / 3);
}

/* The one of the two directions of a line that leaves the front. */
static metro_vec3 front(metro_vec3 normal, metro_vec3 direction)
{
    return metro_dot(normal, direction) < 0 ? metro_scale(direction, -1) : direction;
}

/* What a patch reflects into `out` of what the bundle along `in` brought (eq 14.4). */
static metro_vec3 reflected(const path *p, size_t patch, metro_vec3 in, metro_vec3 out)
{
    metro_vec3 normal = p->patches.patch[patch].normal, received = p->received[patch];
    metro_vec3 f = metro_brdf(material_of(p, patch), normal, front(normal, in), out);
    const double two_pi = 6.283185307179586;
    return metro_vec3_make(two_pi * f.x * received.x, two_pi * f.y * received.y, two_pi * f.z * received.z);
}

static metro_vec3 to_eye(const path *p, size_t patch)
{
    return metro_normalize(metro_subtract(p->scene.camera.eye, middle_of(&p->patches.patch[patch])));
}

/* The whole walk along the directions. */
static metro_result walk(path *p)
{
    const double shift[2] = { 0.5, 0.5 };
    metro_result result = METRO_OK;
    size_t i, k;
    for (i = 0; i < p->patches.count; i++) p->sent[0][i] = material_of(p, i)->ke;
    for (k = 0; k < STEPS && result == METRO_OK; k++) {
        result = metro_bundle_transfer(&p->patches, p->direction[k], GRID, shift, METRO_LINES, p->sent[k],
                                       p->received, &p->balance[k]);
        for (i = 0; i < p->patches.count && result == METRO_OK; i++) {
            metro_vec3 normal = p->patches.patch[i].normal;
            metro_vec3 out = k + 1 < STEPS ? front(normal, p->direction[k + 1]) : to_eye(p, i);
            p->sent[k + 1][i] = reflected(p, i, p->direction[k], out);
            if (k + 1 < STEPS) p->sent[k + 1][i] = metro_add(p->sent[k + 1][i], p->sent[0][i]);
            else if (!p->seen[i]) p->sent[STEPS][i] = metro_vec3_make(0, 0, 0);
        }
    }
    return result;
}

static double brightness(metro_vec3 color) { return metro_luminance(color.x, color.y, color.z); }

/* How much light the walk brings to what both the eye and the drawing show, where patches count more
   than how bright they are. */
static double worth(const path *p)
{
    double sum = 0;
    size_t i;
    for (i = 0; i < p->patches.count; i++) {
        const metro_patch *patch = &p->patches.patch[i];
        if (metro_dot(patch->normal, viewer) > 0 && middle_of(patch).z > -0.99)
            sum += patch->area * sqrt(fmin(brightness(p->sent[STEPS][i]), 1));
    }
    return sum;
}

static void look_around(path *p)
{
    metro_vec3 eye = p->scene.camera.eye;
    size_t i;
    for (i = 0; i < p->patches.count; i++) {
        metro_vec3 d = metro_subtract(middle_of(&p->patches.patch[i]), eye);
        p->seen[i] = metro_dot(d, p->patches.patch[i].normal) < 0 &&
                     metro_dot(d, metro_subtract(p->scene.camera.look, eye)) > 0 &&
                     !metro_scene_occluded(&p->scene, eye, d, 0, 0.999);
    }
}

static metro_vec3 random_direction(metro_rng *rng)
{
    double z = 2 * metro_rng_uniform(rng) - 1, turn = 6.283185307179586 * metro_rng_uniform(rng);
    return metro_vec3_make(sqrt(1 - z * z) * cos(turn), sqrt(1 - z * z) * sin(turn), z);
}

/* ---- The drawing ---- */

typedef struct {
    double x, y;
} spot;

/* A piece of a line between two fronts that face each other, and what it carries to its ends. */
typedef struct {
    metro_vec3 a, b;
    double to_a, to_b;
} segment;

typedef struct {
    const path *path;
    FILE *file;
    double scale, left, top;
    double gap;
    uint32_t *order; /* [count]: patches that the viewer sees the front of, the farthest first */
    size_t fronts;
    segment *found; /* [SEGMENTS] */
    size_t count;
} drawing;

/* Into the room is to the right on the paper; the right side of the room comes forward. */
static spot on_paper(const drawing *d, metro_vec3 p)
{
    spot s;
    s.x = d->left + d->scale * (1.0 - p.z + 0.42 * (p.x + 1));
    s.y = d->top + d->scale * (2.0 - p.y + 0.28 * (p.x + 1));
    return s;
}

typedef struct {
    double depth;
    uint32_t patch;
} far_patch;

static int farther_first(const void *a, const void *b)
{
    double x = ((const far_patch *)a)->depth, y = ((const far_patch *)b)->depth;
    return x < y ? -1 : x > y;
}

static int order_fronts(drawing *d)
{
    const metro_patches *patches = &d->path->patches;
    far_patch *list = (far_patch *)malloc((patches->count + 1) * sizeof *list);
    size_t i;
    if (list == NULL) return 1;
    for (i = 0; i < patches->count; i++) {
        int lamp = brightness(material_of(d->path, i)->ke) > 0;
        if (!(metro_dot(patches->patch[i].normal, viewer) > 0) && !lamp) continue;
        list[d->fronts].depth = metro_dot(middle_of(&patches->patch[i]), viewer);
        list[d->fronts++].patch = (uint32_t)i;
    }
    qsort(list, d->fronts, sizeof *list, farther_first);
    for (i = 0; i < d->fronts; i++) d->order[i] = list[i].patch;
    free(list);
    return 0;
}

/* A sample of radiance as a byte: dark for none, and in proportion to the logarithm, since the lamp is so bright. */
static unsigned shade(double value, double least)
{
    double v = least + (1 - least) * log(1 + 30 * fmax(value, 0)) / log(1 + 30 * 200.0);
    return (unsigned)(255 * fmin(v, 1));
}

static unsigned color_of(metro_vec3 radiance)
{
    return shade(radiance.x, 0.16) << 16 | shade(radiance.y, 0.18) << 8 | shade(radiance.z, 0.24);
}

/* Neighbours of one color share a group. */
static void draw_patches(const drawing *d, const metro_vec3 *sent)
{
    unsigned color = 0, last = 0;
    size_t i;
    fprintf(d->file, "<g stroke=\"#454a57\" stroke-width=\".5\"><g>\n");
    for (i = 0; i < d->fronts; i++) {
        const metro_patch *patch = &d->path->patches.patch[d->order[i]];
        spot a = on_paper(d, patch->corner[0]), b = on_paper(d, patch->corner[1]), c = on_paper(d, patch->corner[2]);
        color = color_of(sent[d->order[i]]);
        if (color != last) fprintf(d->file, "</g><g fill=\"#%06x\">\n", color);
        last = color;
        fprintf(d->file, "<path d=\"M%.1f %.1fL%.1f %.1f %.1f %.1fZ\"/>\n", a.x, a.y, b.x, b.y, c.x, c.y);
    }
    fprintf(d->file, "</g></g>\n");
}

static size_t patch_at(const drawing *d, const metro_hit *hit)
{
    return metro_patches_at(&d->path->patches, hit->triangle, hit->u, hit->v);
}

/* Adds the segments of one line of a bundle. */
static void follow_line(drawing *d, metro_vec3 from, metro_vec3 direction, const metro_vec3 *sent)
{
    const metro_scene *scene = &d->path->scene;
    double at = 0;
    metro_hit hit, before;
    int open = 0;
    memset(&before, 0, sizeof before);
    while (d->count < SEGMENTS && metro_scene_hit(scene, from, direction, at, (double)INFINITY, &hit)) {
        int leaves = metro_dot(metro_scene_normal(scene, hit.triangle), direction) > 0;
        if (open && !leaves) {
            segment *s = &d->found[d->count++];
            s->a = metro_add(from, metro_scale(direction, before.t));
            s->b = metro_add(from, metro_scale(direction, hit.t));
            s->to_b = brightness(sent[patch_at(d, &before)]);
            s->to_a = brightness(sent[patch_at(d, &hit)]);
        }
        open = leaves;
        before = hit;
        at = hit.t + d->gap;
    }
}

/* The segments of all lines of a square grid, `step` apart. */
static void find_segments(drawing *d, metro_vec3 direction, double step, const metro_vec3 *sent)
{
    const metro_patches *patches = &d->path->patches;
    metro_vec3 side = fabs(direction.y) < 0.9 ? metro_vec3_make(0, 1, 0) : metro_vec3_make(1, 0, 0);
    metro_vec3 u = metro_normalize(metro_cross(side, direction)), v = metro_cross(direction, u);
    metro_vec3 start = metro_subtract(patches->middle, metro_scale(direction, 1.01 * patches->radius));
    int most = (int)(patches->radius / step), i, j;
    d->count = 0;
    for (j = -most; j <= most; j++)
        for (i = -most; i <= most; i++) {
            metro_vec3 across = metro_add(metro_scale(u, (i + 0.5) * step), metro_scale(v, (j + 0.5) * step));
            follow_line(d, metro_add(start, across), direction, sent);
        }
}

static void draw_segment(const drawing *d, metro_vec3 a, metro_vec3 b, const char *style)
{
    spot s = on_paper(d, a), t = on_paper(d, b);
    fprintf(d->file, "<path fill=\"none\" d=\"M%.1f %.1fL%.1f %.1f\" %s/>\n", s.x, s.y, t.x, t.y, style);
}

static void draw_thin_lines(drawing *d, metro_vec3 direction, const metro_vec3 *sent)
{
    size_t i;
    find_segments(d, direction, 0.42, sent);
    for (i = 0; i < d->count; i++)
        draw_segment(d, d->found[i].a, d->found[i].b,
                     "stroke=\"#9fd8ff\" stroke-width=\"1.2\" stroke-opacity=\".6\"");
}

/* Of the lines that carry at least a fiftieth of what the best one does, some, evenly over the bundle. */
static void draw_bright_lines(drawing *d, metro_vec3 direction, const metro_vec3 *sent)
{
    double best = 0;
    size_t i, bright = 0, drawn = 0, passed = 0;
    find_segments(d, direction, 0.06, sent);
    for (i = 0; i < d->count; i++) best = fmax(best, fmax(d->found[i].to_a, d->found[i].to_b));
    for (i = 0; i < d->count; i++) bright += fmax(d->found[i].to_a, d->found[i].to_b) > 0.02 * best;
    for (i = 0; i < d->count; i++) {
        const segment *s = &d->found[i];
        int forward = s->to_b > s->to_a;
        if (!(fmax(s->to_a, s->to_b) > 0.02 * best)) continue;
        if (passed++ * BRIGHT < drawn * bright) continue;
        drawn++;
        draw_segment(d, forward ? s->a : s->b, forward ? s->b : s->a,
                     "stroke=\"#ff9d2e\" stroke-width=\"2.4\" marker-end=\"url(#fig6-orange)\"");
    }
}

/* From patches that are seen to the eye. */
static void draw_gathering(const drawing *d, const metro_vec3 *shown)
{
    metro_vec3 eye = d->path->scene.camera.eye;
    size_t i, bright = 0, passed = 0, drawn = 0;
    for (i = 0; i < d->path->patches.count; i++) bright += brightness(shown[i]) > 0.1;
    for (i = 0; i < d->path->patches.count; i++) {
        if (!(brightness(shown[i]) > 0.1) || passed++ * BRIGHT < drawn * bright) continue;
        drawn++;
        draw_segment(d, middle_of(&d->path->patches.patch[i]), eye,
                     "stroke=\"#ff9d2e\" stroke-width=\"1.6\" marker-end=\"url(#fig6-orange)\"");
    }
}

static void draw_eye(const drawing *d)
{
    spot s = on_paper(d, d->path->scene.camera.eye);
    fprintf(d->file,
            "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"9\" fill=\"#fff\" stroke=\"#0072b2\" stroke-width=\"3\"/>\n"
            "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"4\" fill=\"#0072b2\"/>\n",
            s.x, s.y, s.x, s.y);
}

static void draw_panel(drawing *d, int k)
{
    static const char *const title[PANELS] = { "Bundle 1: the emission sets out",
                                               "Bundle 2: what came is reflected, and emission again",
                                               "Bundle 3: once more", "To the eye: the last reflection" };
    const path *p = d->path;
    draw_patches(d, p->sent[k]);
    if (k < STEPS) {
        draw_thin_lines(d, p->direction[k], p->sent[k]);
        draw_bright_lines(d, p->direction[k], p->sent[k]);
    } else draw_gathering(d, p->sent[k]);
    draw_eye(d);
    fprintf(d->file, "<text x=\"%.1f\" y=\"%.1f\" font-size=\"20\" font-weight=\"bold\" fill=\"#222\">%s</text>\n",
            d->left, d->top - 12, title[k]);
}

static void draw_legend(FILE *file, double x, double y)
{
    static const double level[5] = { 0, 0.1, 2, 20, 200 };
    int i;
    fprintf(file, "<g font-size=\"17\" fill=\"#222\"><text x=\"%.1f\" y=\"%.1f\">radiance sent, W/m&#178;sr</text>\n",
            x, y);
    for (i = 0; i < 5; i++)
        fprintf(file,
                "<rect x=\"%.1f\" y=\"%.1f\" width=\"34\" height=\"18\" fill=\"#%06x\" stroke=\"#4a4f5c\"/>"
                "<text x=\"%.1f\" y=\"%.1f\">%g%s</text>\n",
                x + 215 + 84 * i, y - 14, color_of(metro_vec3_make(level[i], level[i], level[i])), x + 254 + 84 * i,
                y, level[i], i < 4 ? "" : ", the lamp");
    fprintf(file, "</g>\n");
}

static void draw_head(FILE *file, double width, double height)
{
    fprintf(file,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%g\" height=\"%g\" viewBox=\"0 0 %g %g\" role=\"img\" "
            "font-family=\"Helvetica, Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif\">\n<title>A path of ray "
            "bundles</title>\n<rect width=\"%g\" height=\"%g\" fill=\"#fff\"/>\n<defs><marker id=\"fig6-orange\" "
            "viewBox=\"0 0 10 10\" refX=\"9\" refY=\"5\" markerWidth=\"11\" markerHeight=\"11\" "
            "markerUnits=\"userSpaceOnUse\" orient=\"auto\"><path d=\"M0 0L10 5L0 10L3 5Z\" fill=\"#ff9d2e\"/>"
            "</marker></defs>\n",
            width, height, width, height, width, height);
    fprintf(file,
            "<text x=\"14\" y=\"36\" font-size=\"25\" font-weight=\"bold\" fill=\"#222\">A path of ray bundles: "
            "three directions, and the light of the lamp is in the room of the eye</text>\n"
            "<text x=\"14\" y=\"64\" font-size=\"18\" fill=\"#222\">All lines of a bundle are parallel. Blue: some "
            "of them; <tspan fill=\"#b35a00\" font-weight=\"bold\">orange</tspan>: some that carry much light, to "
            "where it arrives. The eye is on the left.</text>\n");
}

static int draw(const path *p, drawing *d)
{
    const double width = 1240, height = 800;
    int k, failed;
    d->path = p;
    d->gap = 1e-4 * p->patches.radius;
    d->order = (uint32_t *)malloc((p->patches.count + 1) * sizeof *d->order);
    d->found = (segment *)malloc(SEGMENTS * sizeof *d->found);
    if (d->order == NULL || d->found == NULL || order_fronts(d) != 0)
        return light_complain("fig6", "drawing", METRO_ERROR_MEMORY);
    d->file = fopen("out/fig6.svg", "w");
    if (d->file == NULL) return light_complain("fig6", "out/fig6.svg", METRO_ERROR_FILE);
    draw_head(d->file, width, height);
    d->scale = 118;
    for (k = 0; k < PANELS; k++) {
        d->left = 14 + 620 * (k % 2);
        d->top = 110 + 340 * (k / 2);
        draw_panel(d, k);
    }
    draw_legend(d->file, 14, height - 16);
    fprintf(d->file, "</svg>\n");
    failed = ferror(d->file);
    if (fclose(d->file) != 0 || failed) return light_complain("fig6", "out/fig6.svg", METRO_ERROR_FILE);
    return 0;
}

/* ---- The whole ---- */

static metro_result make_path(path *p)
{
    metro_result result = metro_patches_make(&p->scene, 0.3, &p->patches);
    size_t count = p->patches.count + 1;
    int k;
    if (result != METRO_OK) return result;
    p->seen = (unsigned char *)malloc(count);
    p->received = (metro_vec3 *)malloc(count * sizeof *p->received);
    if (p->seen == NULL || p->received == NULL) return METRO_ERROR_MEMORY;
    for (k = 0; k < PANELS; k++) {
        p->sent[k] = (metro_vec3 *)malloc(count * sizeof *p->sent[k]);
        if (p->sent[k] == NULL) return METRO_ERROR_MEMORY;
    }
    look_around(p);
    return METRO_OK;
}

/* Draws walks at random and keeps the best. */
static metro_result find_path(path *p)
{
    metro_rng rng = metro_rng_make(6, 0);
    metro_vec3 best[STEPS] = { { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 } };
    metro_result result = METRO_OK;
    double most = 0;
    int tries, k;
    for (tries = 0; tries < TRIES && result == METRO_OK; tries++) {
        for (k = 0; k < STEPS; k++) p->direction[k] = random_direction(&rng);
        result = walk(p);
        if (result != METRO_OK || !(worth(p) > most)) continue;
        most = worth(p);
        memcpy(best, p->direction, sizeof best);
        plot_progress((tries + 1.0) / TRIES, "figure 6: walks");
    }
    memcpy(p->direction, best, sizeof best);
    plot_progress(1, "figure 6");
    return result == METRO_OK ? walk(p) : result;
}

static int write_table(const path *p)
{
    plot_csv csv = plot_csv_open("out/fig6.csv", "bundle,x,y,z,left,arrived,escaped,absorbed,lit_patches");
    size_t i, lit;
    int k;
    printf("bundle  direction                 left   arrived   patches that send\n");
    for (k = 0; k < STEPS; k++) {
        const metro_bundle_balance *b = &p->balance[k];
        metro_vec3 w = p->direction[k];
        for (i = lit = 0; i < p->patches.count; i++) lit += brightness(p->sent[k][i]) > 0;
        printf("%d       %6.3f %6.3f %6.3f  %8.3f  %8.3f   %d of %d\n", k + 1, w.x, w.y, w.z, brightness(b->left),
               brightness(b->arrived), (int)lit, (int)p->patches.count);
        PLOT_CSV_ROW(&csv, k + 1.0, w.x, w.y, w.z, brightness(b->left), brightness(b->arrived),
                     brightness(b->escaped), brightness(b->absorbed), (double)lit);
    }
    return plot_csv_close(&csv);
}

int main(void)
{
    static path p;
    static drawing d;
    metro_result result;
    size_t i, shown = 0;
    int k;
    if (light_load("fig6", "tests/data/S2.obj", &p.scene) != 0) return 1;
    result = make_path(&p);
    if (result == METRO_OK) result = find_path(&p);
    if (result != METRO_OK) return light_complain("fig6", "a walk", result);
    if (write_table(&p) + draw(&p, &d) > 0) return 1;
    for (i = 0; i < p.patches.count; i++) shown += brightness(p.sent[STEPS][i]) > 0;
    printf("the best of %d walks of three bundles brings light to %d of the patches that the eye sees\n", TRIES,
           (int)shown);
    for (k = 0; k < PANELS; k++) free(p.sent[k]);
    free(p.seen);
    free(p.received);
    free(d.order);
    free(d.found);
    metro_patches_free(&p.patches);
    metro_scene_free(&p.scene);
    return 0;
}
