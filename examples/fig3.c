/* fig3.c: the paper's figure 3 (section 3.1): a bidirectional path, drawn in the scene where it was found. Of n = 4
   reflections the first k = 2 lie on the gathering walk, which starts at the eye: x1, x2. The shooting walk starts at
   a point y1 of the lamp and is scattered at y2 and y3. A deterministic step from x2 to y3 joins them; it costs the
   factor cos(theta'_k) cos(theta_{n-k+1})/r_k^2, or everything when something stands between.

   The other points can be joined as well, and then two short walks make six paths at once, of one to four reflections
   (Lafortune and Willems 1993). Chapter 12 also joins the points of the shooting walk with the eye; these joins are
   not drawn here.

   The walks are made with the same few functions that a renderer of one's own would use: see `follow`, `gather`,
   `shoot` and `joined`. The rest is drawing: a parallel projection of the box from its right side, whose walls are
   seen through from behind.

   Writes out/fig3.svg and out/fig3.csv (all joins). */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"
#include "light.h"

enum { GATHERED = 2, SHOT = 3, PIECES = 60 };

/* A point of a walk. */
typedef struct {
    metro_vec3 point, normal;
    const metro_material *material;
} place;

typedef struct {
    place x[GATHERED], y[SHOT]; /* x[0] is x1 of the paper, y[0] is y1, on the lamp */
    metro_vec3 film;            /* where the first ray passes the film */
} path;

/* A join of two points. `open`: they face each other and nothing stands between. */
typedef struct {
    int open;
    double cos_x, cos_y, distance;
} join;

/* ---- The path ---- */

/* Rays begin and end this far from surfaces, in units of the scene. */
static double gap_of(const metro_scene *scene) { return 1e-5 * metro_length(scene->camera.eye); }

/* Where a ray arrives: the nearest triangle, if it shows its front. */
static int follow(const metro_scene *scene, metro_vec3 from, metro_vec3 direction, place *to)
{
    metro_hit hit;
    if (!metro_scene_hit(scene, from, direction, gap_of(scene), (double)INFINITY, &hit)) return 0;
    to->point = metro_add(from, metro_scale(direction, hit.t));
    to->normal = metro_scene_normal(scene, hit.triangle);
    to->material = metro_scene_material(scene, scene->material_of[hit.triangle]);
    return metro_dot(to->normal, direction) < 0;
}

/* The next step of a walk that came along `direction`: scattered as the surface `material` does. */
static int scatter(const metro_scene *scene, const place *at, const metro_material *material, metro_vec3 direction,
                   metro_rng *rng, place *to)
{
    double u = metro_rng_uniform(rng), v = metro_rng_uniform(rng);
    metro_vec3 next;
    if (!(metro_brdf_sample(material, at->normal, metro_scale(direction, -1), u, v, &next) > 0)) return 0;
    return follow(scene, at->point, next, to);
}

static metro_vec3 towards(metro_vec3 from, metro_vec3 to) { return metro_normalize(metro_subtract(to, from)); }

/* The gathering walk: from the eye through a random point of the film, and on. */
static int gather(const metro_scene *scene, metro_rng *rng, path *p)
{
    metro_vec3 eye = scene->camera.eye;
    metro_vec3 direction =
        metro_camera_direction(&scene->camera, 1, 1, metro_rng_uniform(rng), metro_rng_uniform(rng));
    int i;
    p->film = direction;
    if (!follow(scene, eye, direction, &p->x[0])) return 0;
    for (i = 1; i < GATHERED; i++) {
        direction = towards(i > 1 ? p->x[i - 2].point : eye, p->x[i - 1].point);
        if (!scatter(scene, &p->x[i - 1], p->x[i - 1].material, direction, rng, &p->x[i])) return 0;
    }
    return 1;
}

/* The shooting walk: from a random point of a lamp, into a direction that follows the cosine, as material 0, which is
   diffuse, scatters. */
static int shoot(const metro_scene *scene, metro_rng *rng, path *p)
{
    uint32_t lamp = scene->light[metro_rng_below(rng, scene->light_count)];
    double u = sqrt(metro_rng_uniform(rng)), v = metro_rng_uniform(rng);
    metro_vec3 a = metro_scale(metro_scene_corner(scene, lamp, 0), 1 - u),
               b = metro_scale(metro_scene_corner(scene, lamp, 1), u * (1 - v)),
               c = metro_scale(metro_scene_corner(scene, lamp, 2), u * v);
    int i;
    p->y[0].point = metro_add(a, metro_add(b, c));
    p->y[0].normal = metro_scene_normal(scene, lamp);
    p->y[0].material = metro_scene_material(scene, 0);
    for (i = 1; i < SHOT; i++) {
        metro_vec3 direction =
            i > 1 ? towards(p->y[i - 2].point, p->y[i - 1].point) : metro_scale(p->y[0].normal, -1);
        if (!scatter(scene, &p->y[i - 1], p->y[i - 1].material, direction, rng, &p->y[i])) return 0;
    }
    return 1;
}

static join joined(const metro_scene *scene, const place *x, const place *y)
{
    join j;
    metro_vec3 d = towards(x->point, y->point);
    j.distance = metro_length(metro_subtract(y->point, x->point));
    j.cos_x = metro_dot(x->normal, d);
    j.cos_y = -metro_dot(y->normal, d);
    j.open = j.cos_x > 0 && j.cos_y > 0 &&
             !metro_scene_occluded(scene, x->point, d, gap_of(scene), j.distance - gap_of(scene));
    return j;
}

/* ---- The drawing ---- */

typedef struct {
    const metro_scene *scene;
    metro_vec3 right, up;    /* what a step to the right and up on the paper is in space, */
    metro_vec3 viewer;       /* and where the viewer is */
    double scale, left, top; /* pixels to a unit, and the corner of the drawing */
    FILE *file;
} drawing;

typedef struct {
    double x, y;
} spot;

static spot on_paper(const drawing *d, metro_vec3 point)
{
    spot s;
    point = metro_subtract(point, d->scene->camera.eye);
    s.x = d->left + d->scale * metro_dot(point, d->right);
    s.y = d->top - d->scale * metro_dot(point, d->up);
    return s;
}

/* Depth goes into the room along the view of the camera, and the right side of the room comes forward. */
static void set_up(drawing *d, const metro_scene *scene, double width, double top, double height)
{
    const metro_camera *camera = &scene->camera;
    metro_vec3 forward = towards(camera->eye, camera->look),
               right = metro_normalize(metro_cross(forward, camera->up));
    metro_vec3 up = metro_cross(right, forward);
    double low[2] = { 0, 0 }, high[2] = { 0, 0 };
    uint32_t i;
    d->scene = scene;
    d->right = metro_add(forward, metro_scale(right, 0.42));
    d->up = metro_subtract(up, metro_scale(right, 0.28));
    d->viewer = metro_add(right, metro_add(metro_scale(forward, -0.42), metro_scale(up, 0.28)));
    d->scale = 1;
    d->left = d->top = 0;
    for (i = 0; i < 3 * scene->triangle_count; i++) {
        spot s = on_paper(d, metro_scene_corner(scene, i / 3, (int)(i % 3)));
        low[0] = fmin(low[0], s.x), high[0] = fmax(high[0], s.x);
        low[1] = fmin(low[1], s.y), high[1] = fmax(high[1], s.y);
    }
    d->scale = fmin((width - 110) / (high[0] - low[0]), height / (high[1] - low[1]));
    d->left = 80 - d->scale * low[0];
    d->top = top - d->scale * low[1];
}

static int shows_front(const drawing *d, uint32_t triangle)
{
    return metro_dot(metro_scene_normal(d->scene, triangle), d->viewer) > 0;
}

typedef struct {
    double area;
    uint32_t triangle;
} front;

static int larger_first(const void *a, const void *b)
{
    double area_a = ((const front *)a)->area, area_b = ((const front *)b)->area;
    return area_a > area_b ? -1 : area_a < area_b;
}

/* How much of its color a surface shows on the paper: least if it faces the eye, most if it faces up. */
static double tint(const drawing *d, uint32_t triangle)
{
    const metro_camera *camera = &d->scene->camera;
    metro_vec3 normal = metro_scene_normal(d->scene, triangle), back = towards(camera->look, camera->eye);
    metro_vec3 right = metro_normalize(metro_cross(camera->up, back));
    return 0.72 - 0.55 * fmax(0, metro_dot(normal, back)) - 0.3 * fmax(0, metro_dot(normal, right));
}

static void draw_triangle(const drawing *d, uint32_t triangle)
{
    const metro_material *m = metro_scene_material(d->scene, d->scene->material_of[triangle]);
    int lamp = m->ke.x + m->ke.y + m->ke.z > 0, k;
    double t = tint(d, triangle), r = 1 - t * (1 - m->kd.x), g = 1 - t * (1 - m->kd.y), b = 1 - t * (1 - m->kd.z);
    unsigned color = (unsigned)(255 * r) << 16 | (unsigned)(255 * g) << 8 | (unsigned)(255 * b);
    if (lamp) color = 0xffd23c;
    fprintf(d->file, "<path fill=\"#%06x\" stroke=\"#%06x\" stroke-width=\".8\" d=\"", color, color);
    for (k = 0; k < 3; k++) {
        spot s = on_paper(d, metro_scene_corner(d->scene, triangle, k));
        fprintf(d->file, "%s%.1f %.1f", k > 0 ? "L" : "M", s.x, s.y);
    }
    fprintf(d->file, "Z\"/>\n");
}

/* The fronts that the viewer sees and the lamp, the largest first: walls come before what stands in front of them. */
static void draw_fronts(const drawing *d)
{
    size_t count = 0, i;
    front *fronts = (front *)malloc(d->scene->triangle_count * sizeof *fronts);
    for (i = 0; fronts != NULL && i < d->scene->triangle_count; i++) {
        const metro_material *m = metro_scene_material(d->scene, d->scene->material_of[i]);
        if (!shows_front(d, (uint32_t)i) && !(m->ke.x > 0)) continue;
        fronts[count].area = metro_scene_area(d->scene, (uint32_t)i);
        fronts[count++].triangle = (uint32_t)i;
    }
    if (fronts != NULL) qsort(fronts, count, sizeof *fronts, larger_first);
    for (i = 0; i < count; i++) draw_triangle(d, fronts[i].triangle);
    free(fronts);
}

/* Is there a front between the point and the viewer? Backs are looked through. */
static int hidden(const drawing *d, metro_vec3 point)
{
    double from = 100 * gap_of(d->scene);
    metro_hit hit;
    while (metro_scene_hit(d->scene, point, d->viewer, from, (double)INFINITY, &hit)) {
        if (shows_front(d, hit.triangle)) return 1;
        from = hit.t + gap_of(d->scene);
    }
    return 0;
}

/* Does another triangle go on beyond this edge in the same plane? Then it is no edge of the scene. */
static int edge_inside(const metro_scene *scene, uint32_t triangle, metro_vec3 a, metro_vec3 b)
{
    uint32_t i;
    int k, shared;
    for (i = 0; i < scene->triangle_count; i++) {
        if (i == triangle || !(metro_dot(metro_scene_normal(scene, i), metro_scene_normal(scene, triangle)) > 0.9999))
            continue;
        for (k = shared = 0; k < 3; k++) {
            metro_vec3 c = metro_scene_corner(scene, i, k);
            shared += !(metro_length(metro_subtract(c, a)) > 0) + !(metro_length(metro_subtract(c, b)) > 0);
        }
        if (shared == 2) return 1;
    }
    return 0;
}

/* The pieces of an edge that are not hidden. */
static void draw_edge(const drawing *d, metro_vec3 a, metro_vec3 b)
{
    metro_vec3 step = metro_scale(metro_subtract(b, a), 1.0 / PIECES);
    int i, open = 0;
    fprintf(d->file, "<path d=\"");
    for (i = 0; i < PIECES; i++) {
        metro_vec3 from = metro_add(a, metro_scale(step, i));
        spot s = on_paper(d, from), t = on_paper(d, metro_add(from, step));
        if (hidden(d, metro_add(from, metro_scale(step, 0.5)))) open = 0;
        else {
            fprintf(d->file, open ? "L%.1f %.1f" : "M%.1f %.1fL%.1f %.1f", open ? t.x : s.x, open ? t.y : s.y, t.x,
                    t.y);
            open = 1;
        }
    }
    fprintf(d->file, "\"/>\n");
}

static void draw_edges(const drawing *d)
{
    uint32_t i;
    int k;
    fprintf(d->file, "<g fill=\"none\" stroke=\"#777\" stroke-width=\"1.3\">\n");
    for (i = 0; i < d->scene->triangle_count; i++)
        for (k = 0; k < 3; k++) {
            metro_vec3 a = metro_scene_corner(d->scene, i, k), b = metro_scene_corner(d->scene, i, (k + 1) % 3);
            if (!edge_inside(d->scene, i, a, b)) draw_edge(d, a, b);
        }
    fprintf(d->file, "</g>\n");
}

/* A straight step of a walk or a join; `style` is its color, width, dashes and arrow. */
static void draw_step(const drawing *d, metro_vec3 a, metro_vec3 b, const char *style)
{
    spot s = on_paper(d, a), t = on_paper(d, b);
    double length = hypot(t.x - s.x, t.y - s.y), cut = strstr(style, "marker") != NULL ? 8 : 0;
    t.x -= cut * (t.x - s.x) / length;
    t.y -= cut * (t.y - s.y) / length;
    fprintf(d->file, "<path fill=\"none\" d=\"M%.1f %.1fL%.1f %.1f\" %s/>\n", s.x, s.y, t.x, t.y, style);
}

/* Words at a place of the paper, with a white halo; what follows a _ is an index. */
static void draw_words(const drawing *d, double x, double y, const char *color, const char *words)
{
    const char *index = strchr(words, '_');
    int length = index != NULL ? (int)(index - words) : (int)strlen(words), layer;
    for (layer = 0; layer < 2; layer++)
        fprintf(
            d->file,
            "<text x=\"%.1f\" y=\"%.1f\" font-size=\"21\" text-anchor=\"middle\" fill=\"%s\"%s>%.*s<tspan dy=\"6\" "
            "font-size=\"15\">%s</tspan></text>\n",
            x, y + 7, layer == 0 ? "#fff" : color,
            layer == 0 ? " stroke=\"#fff\" stroke-width=\"5\" stroke-linejoin=\"round\"" : "", length, words,
            index != NULL ? index + 1 : "");
}

/* A point of a walk with its name on the side where its neighbours are not. */
static void draw_point(const drawing *d, metro_vec3 point, metro_vec3 one, metro_vec3 other, const char *color,
                       const char *name)
{
    spot s = on_paper(d, point), a = on_paper(d, one), b = on_paper(d, other);
    double la = hypot(a.x - s.x, a.y - s.y), lb = hypot(b.x - s.x, b.y - s.y);
    double x = (a.x - s.x) / la + (b.x - s.x) / lb, y = (a.y - s.y) / la + (b.y - s.y) / lb, length = hypot(x, y);
    fprintf(d->file, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"6\" fill=\"%s\"/>\n", s.x, s.y, color);
    draw_words(d, s.x - 22 * x / length, s.y - 20 * y / length, color, name);
}

/* The normal at an end of the join, and the name of the angle between the two. */
static void draw_angle(const drawing *d, const place *at, metro_vec3 to, double size, const char *name)
{
    metro_vec3 tip = metro_add(at->point, metro_scale(at->normal, size));
    metro_vec3 toward = metro_add(at->point, metro_scale(towards(at->point, to), size));
    spot s = on_paper(d, at->point), a = on_paper(d, tip), b = on_paper(d, toward);
    double x = (a.x + b.x) / 2 - s.x, y = (a.y + b.y) / 2 - s.y, length = hypot(x, y);
    draw_step(d, at->point, tip, "stroke=\"#222\" stroke-width=\"1.6\" marker-end=\"url(#fig3-black)\"");
    draw_words(d, s.x + 64 * x / length, s.y + 64 * y / length, "#222", name);
}

static void draw_joins(const drawing *d, const path *p)
{
    int i, j;
    for (i = 0; i < GATHERED; i++)
        for (j = 0; j < SHOT; j++) {
            join found = joined(d->scene, &p->x[i], &p->y[j]);
            const char *style = found.open ? "stroke=\"#009e73\" stroke-width=\"1.4\""
                                           : "stroke=\"#222\" stroke-width=\"1.2\" stroke-dasharray=\"3 6\"";
            if (i + 1 == GATHERED && j + 1 == SHOT) style = "stroke=\"#009e73\" stroke-width=\"4.5\"";
            draw_step(d, p->x[i].point, p->y[j].point, style);
        }
}

/* The eye, the film before it and the first ray. */
static void draw_eye(const drawing *d, const path *p)
{
    const metro_camera *camera = &d->scene->camera;
    double distance = 0.25 * metro_length(metro_subtract(camera->look, camera->eye));
    spot s = on_paper(d, camera->eye);
    int k;
    fprintf(d->file, "<path fill=\"#fff\" fill-opacity=\".8\" stroke=\"#0072b2\" stroke-width=\"1.5\" d=\"");
    for (k = 0; k < 4; k++) {
        metro_vec3 corner = metro_camera_direction(camera, 1, 1, k == 1 || k == 2, k >= 2);
        corner = metro_scale(corner, distance / metro_dot(corner, towards(camera->eye, camera->look)));
        s = on_paper(d, metro_add(camera->eye, corner));
        fprintf(d->file, "%s%.1f %.1f", k > 0 ? "L" : "M", s.x, s.y);
    }
    fprintf(d->file, "Z\"/>\n");
    s = on_paper(d,
                 metro_add(camera->eye,
                           metro_scale(p->film, distance / metro_dot(p->film, towards(camera->eye, camera->look)))));
    fprintf(d->file, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"3\" fill=\"#0072b2\"/>\n", s.x, s.y);
    s = on_paper(d, camera->eye);
    fprintf(d->file,
            "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"9\" fill=\"#fff\" stroke=\"#0072b2\" stroke-width=\"3\"/>\n"
            "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"4\" fill=\"#0072b2\"/>\n",
            s.x, s.y, s.x, s.y);
    draw_words(d, s.x, s.y + 28, "#0072b2", "eye");
}

static void draw_walks(const drawing *d, const path *p)
{
    const char *blue = "stroke=\"#0072b2\" stroke-width=\"3.5\" marker-end=\"url(#fig3-blue)\"";
    const char *orange = "stroke=\"#d55e00\" stroke-width=\"3.5\" marker-end=\"url(#fig3-orange)\"";
    metro_vec3 eye = d->scene->camera.eye, middle, x = p->x[GATHERED - 1].point, y = p->y[SHOT - 1].point;
    double size = 0.14 * metro_length(metro_subtract(d->scene->camera.look, eye));
    char name[20];
    spot s;
    int i;
    draw_step(d, eye, p->x[0].point, blue);
    for (i = 1; i < GATHERED; i++) draw_step(d, p->x[i - 1].point, p->x[i].point, blue);
    for (i = 1; i < SHOT; i++) draw_step(d, p->y[i - 1].point, p->y[i].point, orange);
    draw_angle(d, &p->x[GATHERED - 1], y, size, "&#952;&#8242;_2");
    draw_angle(d, &p->y[SHOT - 1], x, size, "&#952;_3");
    middle = metro_scale(metro_add(x, y), 0.5);
    s = on_paper(d, middle);
    draw_words(d, s.x, s.y, "#00805e", "r_2");
    for (i = 0; i < GATHERED; i++) {
        snprintf(name, sizeof name, "x_%d", i + 1);
        draw_point(d, p->x[i].point, i > 0 ? p->x[i - 1].point : eye, i + 1 < GATHERED ? p->x[i + 1].point : y,
                   "#0072b2", name);
    }
    for (i = 0; i < SHOT; i++) {
        snprintf(name, sizeof name, "y_%d", i + 1);
        draw_point(d, p->y[i].point, i > 0 ? p->y[i - 1].point : p->y[1].point, i + 1 < SHOT ? p->y[i + 1].point : x,
                   "#c05500", name);
    }
}

/* What the step costs, in the empty corner. */
static void draw_formula(const drawing *d, double x, double y)
{
    fprintf(d->file,
            "<g font-size=\"21\" fill=\"#00805e\"><text x=\"%.1f\" y=\"%.1f\">the step costs the factor</text>\n"
            "<text x=\"%.1f\" y=\"%.1f\">cos &#952;&#8242;<tspan dy=\"6\" font-size=\"15\">2</tspan><tspan "
            "dy=\"-6\"> cos &#952;</tspan><tspan dy=\"6\" font-size=\"15\">3</tspan><tspan dy=\"-6\"> / r</tspan>"
            "<tspan dy=\"6\" font-size=\"15\">2</tspan><tspan dy=\"-14\" font-size=\"15\">2</tspan></text></g>\n",
            x, y, x, y + 32);
}

static void draw_arrow_head(FILE *file, const char *name, const char *color)
{
    fprintf(
        file,
        "<marker id=\"fig3-%s\" viewBox=\"0 0 10 10\" refX=\"9\" refY=\"5\" markerWidth=\"16\" markerHeight=\"16\" "
        "markerUnits=\"userSpaceOnUse\" orient=\"auto\"><path d=\"M0 0L10 5L0 10L3 5Z\" fill=\"%s\"/></marker>\n",
        name, color);
}

static void draw_head(FILE *file, double width, double height, int open, int blocked)
{
    fprintf(file,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" xml:space=\"preserve\" width=\"%g\" height=\"%g\" viewBox=\"0 "
            "0 %g %g\" role=\"img\" "
            "font-family=\"Helvetica, Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif\">\n<title>A bidirectional "
            "path</title>\n<rect width=\"%g\" height=\"%g\" fill=\"#fff\"/>\n<defs>\n",
            width, height, width, height, width, height);
    draw_arrow_head(file, "blue", "#0072b2");
    draw_arrow_head(file, "orange", "#d55e00");
    draw_arrow_head(file, "black", "#222");
    fprintf(
        file,
        "</defs>\n<text x=\"14\" y=\"36\" font-size=\"25\" font-weight=\"bold\" fill=\"#222\">Two walks and a step "
        "between them: a path of %d reflections, %d of them gathered</text>\n"
        "<g font-size=\"18\" fill=\"#222\"><text x=\"14\" y=\"66\">"
        "<tspan fill=\"#0072b2\" font-weight=\"bold\">Gathering walk</tspan> from the eye, "
        "<tspan fill=\"#c05500\" font-weight=\"bold\">shooting walk</tspan> from the lamp, and the "
        "<tspan fill=\"#00805e\" font-weight=\"bold\">deterministic step</tspan> from x<tspan dy=\"5\" "
        "font-size=\"13\">2</tspan><tspan dy=\"-5\"> to y</tspan><tspan dy=\"5\" font-size=\"13\">3</tspan>"
        "<tspan dy=\"-5\">.</tspan></text>\n"
        "<text x=\"14\" y=\"90\">Thin lines: the other joins of the same two walks, %d open and, dashed, %d whose "
        "ends do not see each other. Each open one is a shorter path.</text></g>\n",
        GATHERED + SHOT - 1, GATHERED, open, blocked);
}

/* ---- Which path ---- */

static int count_open(const metro_scene *scene, const path *p)
{
    int i, j, open = 0;
    for (i = 0; i < GATHERED; i++)
        for (j = 0; j < SHOT; j++) open += joined(scene, &p->x[i], &p->y[j]).open;
    return open;
}

/* Does something stand in the way of a join whose ends face each other? */
static int something_stands_between(const metro_scene *scene, const path *p)
{
    int i, j, found = 0;
    for (i = 0; i < GATHERED; i++)
        for (j = 0; j < SHOT; j++) {
            join at = joined(scene, &p->x[i], &p->y[j]);
            found |= !at.open && at.cos_x > 0 && at.cos_y > 0;
        }
    return found;
}

/* The viewer sees the front of the surface that the point is on, and nothing before it. */
static int seen(const drawing *d, const place *at)
{
    return metro_dot(at->normal, d->viewer) > 0 && !hidden(d, at->point);
}

/* The smallest distance on the paper between any two of the points, the middle of the join and those of the steps of
   the shooting walk. */
static double crowding(const drawing *d, const path *p)
{
    enum { SPOTS = GATHERED + 2 * SHOT };
    spot s[SPOTS];
    double least = 1e9;
    int i, j;
    for (i = 0; i < GATHERED; i++) s[i] = on_paper(d, p->x[i].point);
    for (i = 0; i < SHOT; i++) {
        metro_vec3 next = i + 1 < SHOT ? p->y[i + 1].point : p->x[GATHERED - 1].point;
        s[GATHERED + i] = on_paper(d, p->y[i].point);
        s[GATHERED + SHOT + i] = on_paper(d, metro_scale(metro_add(p->y[i].point, next), 0.5));
    }
    for (i = 0; i < SPOTS; i++)
        for (j = 0; j < i; j++) least = fmin(least, hypot(s[i].x - s[j].x, s[i].y - s[j].y));
    return least;
}

/* The angle on the paper between the ways from `at` to a and to b. */
static double turn(const drawing *d, metro_vec3 at, metro_vec3 a, metro_vec3 b)
{
    spot s = on_paper(d, at), t = on_paper(d, a), u = on_paper(d, b);
    double x = t.x - s.x, y = t.y - s.y, v = u.x - s.x, w = u.y - s.y;
    return fabs(atan2(x * w - y * v, x * v + y * w));
}

/* Nor do the lines that meet at the ends of the join, and the normals there, lie on each other. */
static double tightness(const drawing *d, const path *p)
{
    const place *x = &p->x[GATHERED - 1], *y = &p->y[SHOT - 1];
    metro_vec3 x_tip = metro_add(x->point, x->normal), y_tip = metro_add(y->point, y->normal);
    double least = fmin(turn(d, x->point, p->x[GATHERED - 2].point, y->point), turn(d, x->point, x_tip, y->point));
    least = fmin(least, turn(d, x->point, x_tip, p->x[GATHERED - 2].point));
    least = fmin(least, turn(d, y->point, p->y[SHOT - 2].point, x->point));
    least = fmin(least, turn(d, y->point, y_tip, p->y[SHOT - 2].point));
    return fmin(least, turn(d, y->point, y_tip, x->point));
}

/* Draws paths at random until one suits a figure: its join is open and of good use, something stands in the way of
   another, all points are seen and none is near another. Returns how many were drawn. */
static int find_path(const drawing *d, path *p)
{
    metro_rng rng = metro_rng_make(2, 0);
    int tries, suits, i;
    join step;
    for (tries = 1; tries < 10000000; tries++) {
        if (!gather(d->scene, &rng, p) || !shoot(d->scene, &rng, p)) continue;
        step = joined(d->scene, &p->x[GATHERED - 1], &p->y[SHOT - 1]);
        suits = step.open && step.cos_x > 0.3 && step.cos_y > 0.3 && count_open(d->scene, p) >= 3;
        suits = suits && something_stands_between(d->scene, p) && crowding(d, p) > 80 && tightness(d, p) > 0.5;
        for (i = 0; i < GATHERED && suits; i++) suits = seen(d, &p->x[i]);
        for (i = 1; i < SHOT && suits; i++) suits = seen(d, &p->y[i]);
        if (suits) return tries;
    }
    return 0;
}

static int write_table(const metro_scene *scene, const path *p)
{
    plot_csv csv = plot_csv_open("out/fig3.csv", "x,y,reflections,open,cos_x,cos_y,distance");
    int i, j;
    printf("join     reflections          cos     cos        r\n");
    for (i = 0; i < GATHERED; i++)
        for (j = 0; j < SHOT; j++) {
            join found = joined(scene, &p->x[i], &p->y[j]);
            printf("x%d - y%d  %11d  %-7s %6.3f  %6.3f  %7.1f\n", i + 1, j + 1, i + 1 + j,
                   found.open ? "open" : "blocked", found.cos_x, found.cos_y, found.distance);
            PLOT_CSV_ROW(&csv, i + 1.0, j + 1.0, i + 1.0 + j, (double)found.open, found.cos_x, found.cos_y,
                         found.distance);
        }
    return plot_csv_close(&csv);
}

int main(void)
{
    const double width = 1200, head = 110, height = 700;
    metro_scene scene;
    drawing d;
    path p;
    join last;
    int tries, open, failed;
    if (light_load("fig3", "examples/scenes/cornell.obj", &scene) != 0) return 1;
    set_up(&d, &scene, width, head + 20, height - head - 40);
    tries = find_path(&d, &p);
    if (tries == 0) return light_complain("fig3", "no path suits", METRO_ERROR_NO_IMPORTANCE);
    open = count_open(&scene, &p);
    if (write_table(&scene, &p) != 0) return 1; /* makes out/ too */
    d.file = fopen("out/fig3.svg", "w");
    if (d.file == NULL) return light_complain("fig3", "out/fig3.svg", METRO_ERROR_FILE);
    draw_head(d.file, width, height, open - 1, GATHERED * SHOT - open);
    draw_fronts(&d);
    draw_edges(&d);
    draw_eye(&d, &p);
    draw_joins(&d, &p);
    draw_walks(&d, &p);
    draw_formula(&d, 60, height - 70);
    fprintf(d.file, "</svg>\n");
    failed = ferror(d.file);
    if (fclose(d.file) != 0 || failed) return light_complain("fig3", "out/fig3.svg", METRO_ERROR_FILE);
    last = joined(&scene, &p.x[GATHERED - 1], &p.y[SHOT - 1]);
    printf("path %d of those drawn at random: %d of %d joins are open; the step of length %.0f from x%d to y%d costs "
           "the "
           "factor %.2g\n",
           tries, open, GATHERED * SHOT, last.distance, GATHERED, SHOT,
           last.cos_x * last.cos_y / (last.distance * last.distance));
    metro_scene_free(&scene);
    return 0;
}
