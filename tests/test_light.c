/* test_light.c - chapter 11: the surface model as a formula, as a density and as draws, held against each other;
   lamps and what is left of the number that chose one; the camera against solid angles computed without it. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "light.h"

#define BELOW_ONE (1 - 1.1102230246251565e-16)

static metro_vec3 direction_at(double polar, double azimuth)
{
    return metro_vec3_make(sin(polar) * cos(azimuth), sin(polar) * sin(azimuth), cos(polar));
}

/* A frame around `axis`, made without the library's. */
typedef struct {
    metro_vec3 x, y, z;
} frame;

static frame frame_around(metro_vec3 axis)
{
    frame f;
    metro_vec3 other = fabs(axis.x) < 0.7 ? metro_vec3_make(1, 0, 0) : metro_vec3_make(0, 1, 0);
    f.z = axis;
    f.x = metro_normalize(metro_cross(other, axis));
    f.y = metro_cross(axis, f.x);
    return f;
}

static metro_vec3 frame_out(const frame *f, metro_vec3 d)
{
    return metro_add(metro_add(metro_scale(f->x, d.x), metro_scale(f->y, d.y)), metro_scale(f->z, d.z));
}

static metro_vec3 frame_in(const frame *f, metro_vec3 d)
{
    return metro_vec3_make(metro_dot(f->x, d), metro_dot(f->y, d), metro_dot(f->z, d));
}

/* Normals in general position, along the axes, and where a frame built from the normal may divide by zero. */
static metro_vec3 normal_case(int i)
{
    static const double n[6][3] = { { 0, 0, 1 },  { 0, 0, -1 },    { 0.3, -0.8, 0.5 },
                                    { -1, 0, 0 }, { 1e-9, 0, -1 }, { 0.6, 0.7, -0.2 } };
    return metro_normalize(metro_vec3_make(n[i][0], n[i][1], n[i][2]));
}

#define NORMALS 6

/* ---- the BRDF ---- */

/* Values worked out by hand from eq 11.1, the same under every normal. Catches: n + 1 for n + 2, the half vector for
   the mirror direction, a missing pi, a lobe that is not cut off at a right angle, light from below. */
static void brdf_by_hand(void)
{
    const metro_material m =
        material_make(metro_vec3_make(0.3, 0.2, 0.1), metro_vec3_make(0.5, 0.6, 0.7), 2, grey(0));
    const double third = CHECK_PI / 3, sixth = CHECK_PI / 6;
    /* polar and azimuth of `in`, of `out`, and cos^2 of the angle to the mirror direction; -1: black */
    static const double table[9][5] = { { 1, 0, 1, 3, 1 },  { 0, 0, 1, 0, 0.75 }, { 1, 0, 0, 0, 0.75 },
                                        { 2, 0, 2, 0, 0 },  { 1, 0, 1, 0, 0.25 }, { 2, 0, 1, 3, 0.75 },
                                        { 4, 0, 1, 0, -1 }, { 1, 0, 4, 0, -1 },   { 2, 1.5, 2, 0, 0.0625 } };
    int i, j;
    for (i = 0; i < NORMALS; i++) {
        frame f = frame_around(normal_case(i));
        for (j = 0; j < 9; j++) {
            const double *row = table[j];
            metro_vec3 in = frame_out(&f, direction_at(row[0] * sixth, row[1] * third));
            metro_vec3 out = frame_out(&f, direction_at(row[2] * sixth, row[3] * third));
            metro_vec3 value = metro_brdf(&m, f.z, in, out);
            double lit = row[4] >= 0, lobe = lit ? row[4] * 4 / (2 * CHECK_PI) : 0;
            CHECK_CLOSE(value.x, lit * 0.3 / CHECK_PI + 0.5 * lobe, 1e-14);
            CHECK_CLOSE(value.y, lit * 0.2 / CHECK_PI + 0.6 * lobe, 1e-14);
            CHECK_CLOSE(value.z, lit * 0.1 / CHECK_PI + 0.7 * lobe, 1e-14);
        }
    }
}

static metro_material material_case(int i)
{
    switch (i) {
    case 0: return material_make(grey(0.7), grey(0), 0, grey(0));
    case 1: return material_make(metro_vec3_make(0.1, 0.2, 0.3), metro_vec3_make(0.6, 0.3, 0.1), 1, grey(0));
    case 2: return material_make(grey(0.25), grey(0.5), 50, grey(0));
    case 3: return material_make(grey(0), grey(1), 7.5, grey(0));
    case 4: return material_make(grey(0.3), grey(0.7), 0, grey(0));
    default: return material_make(metro_vec3_make(0, 0, 0.4), metro_vec3_make(0.9, 0, 0), 400, grey(0));
    }
}

#define MATERIALS 6

/* Catches: a cosine of one side only in the lobe, a density in place of the value. */
static void brdf_is_symmetric(void)
{
    metro_rng rng = metro_rng_make(1, 1);
    int i, j;
    for (i = 0; i < MATERIALS; i++) {
        metro_material m = material_case(i);
        for (j = 0; j < 2000; j++) {
            metro_vec3 n = metro_rng_direction(&rng), a = metro_rng_direction(&rng), b = metro_rng_direction(&rng), u,
                       v;
            if (metro_dot(n, a) < 0) a = metro_scale(a, -1);
            if (metro_dot(n, b) < 0) b = metro_scale(b, -1);
            u = metro_brdf(&m, n, a, b);
            v = metro_brdf(&m, n, b, a);
            CHECK(metro_length(metro_subtract(u, v)) <= 1e-11 * metro_length(u) + 1e-300, "material %d: %g and %g", i,
                  u.x, v.x);
            CHECK(metro_length(metro_brdf(&m, n, a, metro_scale(b, -1))) == 0 &&
                      metro_brdf_density(&m, n, metro_scale(a, -1), b) == 0,
                  "material %d lets light through", i);
        }
    }
}

/* The integrals of f cos and of the density over directions between two heights along the axis of `f` and between two
   turns about it, by the midpoint rule. */
static void zone(const metro_material *m, metro_vec3 normal, metro_vec3 out, const frame *f, const double *height,
                 int rows, const double *turn, int columns, metro_vec3 *albedo, double *mass)
{
    double area = (height[1] - height[0]) / rows * (turn[1] - turn[0]) / columns;
    int i, j;
    for (i = 0; i < rows; i++) {
        double z = height[0] + (height[1] - height[0]) * (i + 0.5) / rows, r = sqrt(1 - z * z);
        for (j = 0; j < columns; j++) {
            double t = turn[0] + (turn[1] - turn[0]) * (j + 0.5) / columns, cosine;
            metro_vec3 in = frame_out(f, metro_vec3_make(r * cos(t), r * sin(t), z));
            cosine = metro_dot(normal, in);
            if (!(cosine > 0)) continue;
            *albedo = metro_add(*albedo, metro_scale(metro_brdf(m, normal, in, out), cosine * area));
            *mass += metro_brdf_density(m, normal, in, out) * area;
        }
    }
}

/* Over the whole hemisphere, with fine rows where the lobe is. */
static void hemisphere(const metro_material *m, metro_vec3 normal, metro_vec3 out, metro_vec3 *albedo, double *mass)
{
    double turn[2] = { 0, 2 * CHECK_PI }, height[4] = { -1, 0, 0, 1 };
    frame f = frame_around(metro_subtract(metro_scale(normal, 2 * metro_dot(normal, out)), out));
    height[2] = exp(-16 / (m->ns + 1));
    *albedo = grey(0);
    *mass = 0;
    zone(m, normal, out, &f, height, 150, turn, 120, albedo, mass);
    zone(m, normal, out, &f, height + 1, 150, turn, 120, albedo, mass);
    zone(m, normal, out, &f, height + 2, 500, turn, 120, albedo, mass);
}

/* No surface sends out more than it receives, and under perpendicular light it reflects kd + ks of it exactly; the
   density has the mass 1 there, and less where a part of the lobe is below the surface. Catches: n + 1 for n + 2 in
   the value (an albedo of kd + ks (n+1)/(n+2)), n + 2 in the density, a lost part that is renormalised. */
static void albedo(void)
{
    static const double polar[5] = { 0, 0.4, 0.9, 1.3, 1.56 };
    int i, j;
    for (i = 0; i < MATERIALS; i++) {
        metro_material m = material_case(i);
        metro_vec3 normal = normal_case(i % NORMALS), all = metro_add(m.kd, m.ks), sum;
        frame f = frame_around(normal);
        double share = metroi_surface_make(&m).share, mass;
        for (j = 0; j < 5; j++) {
            hemisphere(&m, normal, frame_out(&f, direction_at(polar[j], 1)), &sum, &mass);
            CHECK(sum.x <= all.x + 1e-4 && sum.y <= all.y + 1e-4 && sum.z <= all.z + 1e-4,
                  "material %d at %g: albedo %g %g %g", i, polar[j], sum.x, sum.y, sum.z);
            CHECK(mass <= 1 + 1e-4 && mass >= share - 1e-4, "material %d at %g: the density integrates to %g", i,
                  polar[j], mass);
            CHECK(sum.x >= m.kd.x - 1e-4, "material %d at %g: albedo %g without its diffuse part", i, polar[j],
                  sum.x);
            if (j == 0) {
                CHECK_CLOSE(sum.x, all.x, 2e-4);
                CHECK_CLOSE(sum.z, all.z, 2e-4);
                CHECK_CLOSE(mass, 1, 2e-4);
            }
            /* half of a wide lobe around the horizon is below it */
            if (i == 3 && j == 4) CHECK_CLOSE(mass, 0.5, 0.02);
        }
    }
}

/* ---- draws ---- */

enum { TURNS = 8, HEIGHTS = 16, CELLS = TURNS * HEIGHTS, FINE = 24 };

/* Cells are even in the turn about the axis of `f`, and in a power of the height that makes a lobe flat. */
static int cell_of(const frame *f, double power, metro_vec3 in)
{
    metro_vec3 d = frame_in(f, in);
    double u = d.z > 0 ? 0.5 + 0.5 * pow(d.z < 1 ? d.z : 1, power) : 0.5 + 0.5 * d.z,
           turn = atan2(d.y, d.x) / (2 * CHECK_PI);
    int i = (int)(HEIGHTS * u), j = (int)floor(TURNS * (turn - floor(turn)));
    if (i < 0) i = 0;
    if (i >= HEIGHTS) i = HEIGHTS - 1;
    return TURNS * i + (j < TURNS ? j : TURNS - 1);
}

/* The integral of the density over each cell, and what is lost. The lowest cell of a lobe holds all wide angles and
   is cut where the lobe has fallen to e^-4, e^-8 and e^-16. */
static void cell_masses(const metro_material *m, metro_vec3 normal, metro_vec3 out, const frame *f, double power,
                        double *p)
{
    int c, i;
    metro_vec3 unused = grey(0);
    p[CELLS] = 1;
    for (c = 0; c < CELLS; c++) {
        double u = 2.0 * (c / TURNS) / HEIGHTS - 1, cut[6], turn[2];
        int cuts = 0;
        cut[cuts++] = u > 0 ? pow(u, 1 / power) : u;
        for (i = 16; u == 0 && power > 1.5 && i >= 4; i /= 2) cut[cuts++] = exp(-i / power);
        u += 2.0 / HEIGHTS;
        cut[cuts] = u > 0 ? pow(u, 1 / power) : u;
        turn[0] = 2 * CHECK_PI * (c % TURNS) / TURNS;
        turn[1] = turn[0] + 2 * CHECK_PI / TURNS;
        p[c] = 0;
        for (i = 0; i < cuts; i++) zone(m, normal, out, f, cut + i, FINE, turn, FINE, &unused, &p[c]);
        p[CELLS] -= p[c];
    }
    if (p[CELLS] < 0) p[CELLS] = 0;
}

static void draw_against_density(int i, double polar, int about_mirror, uint64_t stream)
{
    metro_material m = material_case(i);
    metro_vec3 normal = normal_case((int)(stream % NORMALS)), out, in, axis, sum;
    double count[CELLS + 1], p[CELLS + 1], power, mass;
    metro_moments red = { 0, 0, 0, 0 }, blue = { 0, 0, 0, 0 };
    uint64_t k, samples = check_count(60000, 5000);
    metro_rng rng = metro_rng_make(2, stream);
    frame f = frame_around(normal);
    char what[80];
    out = frame_out(&f, direction_at(polar, 2));
    axis = metro_subtract(metro_scale(normal, 2 * metro_dot(normal, out)), out);
    power = about_mirror ? m.ns + 1 : 1;
    f = frame_around(about_mirror ? axis : normal);
    memset(count, 0, sizeof count);
    for (k = 0; k < samples; k++) {
        double u = metro_rng_uniform(&rng), v = metro_rng_uniform(&rng);
        double density = metro_brdf_sample(&m, normal, out, u, v, &in);
        metro_vec3 value = grey(0);
        CHECK(fabs(metro_length(in) - 1) <= 1e-14, "length %.17g", metro_length(in));
        CHECK(density == metro_brdf_density(&m, normal, in, out), "density %g", density);
        CHECK((density > 0) == (metro_dot(normal, in) > 0), "density %g at height %g", density,
              metro_dot(normal, in));
        count[density > 0 ? cell_of(&f, power, in) : CELLS]++;
        if (density > 0) value = metro_scale(metro_brdf(&m, normal, in, out), metro_dot(normal, in) / density);
        metro_moments_add(&red, value.x);
        metro_moments_add(&blue, value.z);
    }
    cell_masses(&m, normal, out, &f, power, p);
    snprintf(what, sizeof what, "material %d out at %g, %s", i, polar, about_mirror ? "about the mirror" : "about n");
    check_chi_square(what, count, p, CELLS + 1, (double)samples);
    /* the mean of f cos / p over the draws is the albedo */
    hemisphere(&m, normal, out, &sum, &mass);
    CHECK_CLOSE(metro_moments_mean(&red), sum.x, 5.1 * metro_moments_error(&red) + 3e-4);
    CHECK_CLOSE(metro_moments_mean(&blue), sum.z, 5.1 * metro_moments_error(&blue) + 3e-4);
}

/* Catches: a cosine dropped, the exponent n for n + 1 in the draw, q upside down, a number used twice without being
   stretched, a lobe about the normal in place of the mirror direction, a lost part that is counted as drawn. */
static void draws_follow_the_density(void)
{
    static const double polar[3] = { 0.05, 0.8, 1.45 };
    uint64_t stream = 0;
    int i, j;
    for (i = 0; i < MATERIALS; i++)
        for (j = 0; j < 3; j++) {
            if (i != 2 && i != 5)
                draw_against_density(i, polar[j], 0, stream++); /* cells about n suit wide lobes only */
            if (i > 0 && i != 4) draw_against_density(i, polar[j], 1, stream++);
        }
}

/* Every number a generator can give, at the seams of the two lobes as well, and lobes of n = 1e4 and more. Catches:
   0/0 at u = 0, a root of a negative number at u just below 1, an overflow of the power. */
static void extreme_numbers(void)
{
    static const double ns[6] = { 0, 1, 50, 1e4, 1e8, 1e300 };
    static const double polar[4] = { 0, 0.7, 1.5, 1.5707963267948966 };
    metro_vec3 in;
    int i, j, k, a, b;
    for (i = 0; i < 6; i++)
        for (j = 0; j < 4; j++)
            for (k = 0; k < NORMALS; k++) {
                metro_material m = material_make(grey(0.3), grey(0.6), ns[i], grey(0));
                frame f = frame_around(normal_case(k));
                metro_vec3 out = frame_out(&f, direction_at(polar[j], 1));
                double share = metroi_surface_make(&m).share, u[7];
                u[0] = 0;
                u[1] = 1.1102230246251565e-16;
                u[2] = nextafter(share, 0);
                u[3] = share;
                u[4] = nextafter(share, 1);
                u[5] = 0.7;
                u[6] = BELOW_ONE;
                for (a = 0; a < 7; a++)
                    for (b = 0; b < 7; b++) {
                        double density = metro_brdf_sample(&m, f.z, out, u[a], u[b], &in);
                        metro_vec3 value = metro_brdf(&m, f.z, in, out);
                        CHECK(fabs(metro_length(in) - 1) <= 1e-14, "n %g, u %.17g, v %.17g: length %g", ns[i], u[a],
                              u[b], metro_length(in));
                        CHECK(density >= 0 && isfinite(density) && value.x >= 0 && isfinite(value.x),
                              "n %g, u %.17g, v %.17g: density %g, value %g", ns[i], u[a], u[b], density, value.x);
                    }
            }
}

/* A lobe of n = 1e4 reflects ks of perpendicular light, on average over draws. */
static void narrow_lobe(void)
{
    metro_material m = material_make(grey(0), grey(0.8), 1e4, grey(0));
    metro_vec3 normal = normal_case(2), in;
    metro_rng rng = metro_rng_make(3, 1);
    uint64_t k, samples = check_count(100000, 5000);
    metro_moments moments = { 0, 0, 0, 0 };
    for (k = 0; k < samples; k++) {
        double u = metro_rng_uniform(&rng), v = metro_rng_uniform(&rng);
        double density = metro_brdf_sample(&m, normal, normal, u, v, &in);
        metro_moments_add(&moments, metro_brdf(&m, normal, in, normal).x * metro_dot(normal, in) / density);
    }
    /* f cos / p = ks (n + 2)/(n + 1) cos, of mean ks */
    CHECK(fabs(metro_moments_mean(&moments) - 0.8) <= 5.1 * metro_moments_error(&moments) + 1e-12, "mean %.9g",
          metro_moments_mean(&moments));
    CHECK_CLOSE(metro_moments_mean(&moments), 0.8, 1e-5);
}

static void black_surface(void)
{
    metro_material m = material_make(grey(0), grey(0), 5, grey(3));
    metro_vec3 n = normal_case(2), in;
    CHECK(metro_brdf_sample(&m, n, n, 0.5, 0.5, &in) == 0 && metro_brdf_density(&m, n, n, n) == 0 &&
              metro_length(metro_brdf(&m, n, n, n)) == 0,
          "a black surface reflects");
}

/* ---- lamps ---- */

/* Five triangles of which four emit, of unlike areas and colours; one has no area, one a colour of no luminance. */
static metro_scene lamps_scene(void)
{
    metro_scene scene = empty_scene();
    uint32_t red = add_material(&scene, grey(0.2), grey(0), 0, metro_vec3_make(9, 0, 0));
    uint32_t white = add_material(&scene, grey(0.2), grey(0), 0, grey(2));
    uint32_t blue = add_material(&scene, grey(0), grey(0), 0, metro_vec3_make(0, 0, 5));
    add_triangle(&scene, metro_vec3_make(0, 0, 0), metro_vec3_make(1, 0, 0), metro_vec3_make(0, 1, 0), red);
    add_triangle(&scene, metro_vec3_make(0, 0, 1), metro_vec3_make(3, 0, 1), metro_vec3_make(0, 1, 2), 0);
    add_triangle(&scene, metro_vec3_make(0, 0, 2), metro_vec3_make(3, 0, 2), metro_vec3_make(0, 2, 4), white);
    add_triangle(&scene, metro_vec3_make(1, 1, 1), metro_vec3_make(1, 1, 1), metro_vec3_make(1, 1, 1), white);
    add_triangle(&scene, metro_vec3_make(-1, 0, 2), metro_vec3_make(-1, 0.25, 2), metro_vec3_make(-1, 0, 4), blue);
    add_triangle(&scene, metro_vec3_make(5, 0, 0), metro_vec3_make(6, 0, 0), metro_vec3_make(5, 0, 0.5), white);
    build(&scene);
    return scene;
}

static metro_vec3 point_of(const metro_scene *scene, uint32_t lamp, double u, double v)
{
    metroi_facet facet = metroi_facet_of(scene, lamp);
    return metroi_light_point(&facet, u, v);
}

/* The frequencies of lamps are as area times luminance, the number that chose is uniform again afterwards, and points
   are uniform on each triangle, also given the lamp. Catches: areas alone, radiances alone, a running sum shifted by
   one lamp, a number that is used twice, a root that is missing. */
static void lamp_choice(void)
{
    enum { SIDE = 6, PIECES = SIDE * SIDE };
    metro_scene scene = lamps_scene();
    double power[6], p[6 * PIECES], count[6 * PIECES], total = 0, n, mass = 0;
    uint64_t k, samples = check_count(200000, 20000);
    metro_rng rng = metro_rng_make(4, 1);
    size_t i;
    memset(count, 0, sizeof count);
    for (i = 0; i < 6; i++) {
        const metro_material *m = metro_scene_material(&scene, scene.material_of[i]);
        power[i] = metro_scene_area(&scene, (uint32_t)i) * metro_luminance(m->ke.x, m->ke.y, m->ke.z);
        total += power[i];
    }
    CHECK_NEAR(scene.light_power, total, 1e-12);
    CHECK(scene.light_count == 4, "%d lamps", (int)scene.light_count);
    for (k = 0; k < samples; k++) {
        double u = metro_rng_uniform(&rng), v = metro_rng_uniform(&rng), s, t, b0, b1, b2;
        uint32_t lamp = metroi_light_choose(&scene, &u);
        metro_vec3 q[3], x, a, b, d;
        int cell;
        CHECK(u >= 0 && u < 1, "what is left is %.17g", u);
        x = point_of(&scene, lamp, u, v);
        q[0] = metro_scene_corner(&scene, lamp, 0);
        q[1] = metro_scene_corner(&scene, lamp, 1);
        q[2] = metro_scene_corner(&scene, lamp, 2);
        a = metro_subtract(q[1], q[0]);
        b = metro_subtract(q[2], q[0]);
        d = metro_subtract(x, q[0]);
        n = metro_dot(metro_cross(a, b), metro_cross(a, b));
        b1 = metro_dot(metro_cross(d, b), metro_cross(a, b)) / n;
        b2 = metro_dot(metro_cross(a, d), metro_cross(a, b)) / n;
        b0 = 1 - b1 - b2;
        CHECK(b0 >= -1e-12 && b1 >= -1e-12 && b2 >= -1e-12, "outside: %g %g %g", b0, b1, b2);
        /* the lattice of SIDE^2 equal triangles */
        s = b1 * SIDE;
        t = b2 * SIDE;
        /* rows have 2 (SIDE - row) - 1 of them */
        cell = (int)s * (2 * SIDE - (int)s) + 2 * (int)t + (s - floor(s) + t - floor(t) > 1);
        if (cell >= 0 && cell < PIECES) count[lamp * PIECES + (size_t)cell]++;
    }
    for (i = 0; i < 6 * PIECES; i++) p[i] = power[i / PIECES] / total / PIECES;
    check_chi_square("lamps and their points", count, p, 6 * PIECES, (double)samples);
    for (i = 0; i < 6; i++) {
        metroi_surface surface = metroi_surface_make(metro_scene_material(&scene, scene.material_of[i]));
        double area = metro_scene_area(&scene, (uint32_t)i);
        if (area > 0) mass += area * metroi_light_density(&scene, &surface);
    }
    CHECK_CLOSE(mass, 1, 1e-12);
    metro_scene_free(&scene);
}

/* Catches: a lamp of no area chosen at a seam, a number left over that is 1 or NaN, the last lamp missed. */
static void lamp_extremes(void)
{
    metro_scene scene = lamps_scene();
    size_t i, j;
    int k;
    for (i = 0; i < scene.light_count; i++)
        for (k = -1; k <= 1; k++) {
            double seam = scene.light_sum[i],
                   u = k < 0   ? nextafter(seam, 0)
                       : k > 0 ? nextafter(seam, 1)
                               : seam,
                   left;
            uint32_t lamp;
            if (i == scene.light_count - 1 && k >= 0) u = k > 0 ? 0 : BELOW_ONE;
            left = u;
            lamp = metroi_light_choose(&scene, &left);
            CHECK(left >= 0 && left < 1, "of %.17g is left %.17g", u, left);
            CHECK(metro_scene_area(&scene, lamp) > 0, "lamp %d has no area", (int)lamp);
            for (j = 0; j < 4; j++) {
                metro_vec3 x = point_of(&scene, lamp, j & 1 ? BELOW_ONE : 0, j & 2 ? BELOW_ONE : 0);
                CHECK(isfinite(metro_dot(x, x)), "the point of %d is not finite", (int)j);
            }
        }
    CHECK(scene.light_sum[scene.light_count - 1] == 1, "the last sum is %.17g",
          scene.light_sum[scene.light_count - 1]);
    metro_scene_free(&scene);
}

/* ---- the camera ---- */

/* eq 11.4 with numbers worked out by hand. Catches: half the angle twice, the horizontal field of view, y upwards, a
   pixel that begins at its middle, an `up` that must be perpendicular or of length 1. */
static void camera_by_hand(void)
{
    metro_camera camera = camera_make(metro_vec3_make(0, 0, 0), metro_vec3_make(0, 0, -7), 90);
    static const double table[5][5] = { { 100, 50, 0, 0, -1 },
                                        { 200, 0, 2, 1, -1 },
                                        { 0, 100, -2, -1, -1 },
                                        { 150, 50, 1, 0, -1 },
                                        { 100, 25, 0, 0.5, -1 } };
    double x, y, t = tan(20 * CHECK_PI / 180);
    metro_vec3 d;
    int i;
    camera.up = metro_vec3_make(0, 1e-3, 1e-3);
    for (i = 0; i < 5; i++) {
        metro_vec3 truth = metro_normalize(metro_vec3_make(table[i][2], table[i][3], table[i][4]));
        d = metro_camera_direction(&camera, 200, 100, table[i][0], table[i][1]);
        CHECK(metro_length(metro_subtract(d, truth)) <= 1e-15, "(%g, %g): %g %g %g", table[i][0], table[i][1], d.x,
              d.y, d.z);
    }
    /* the view of scene S1: 128 x 128, fov 40; the middle of pixel (0, 0) is at (.5, .5) */
    camera = camera_make(metro_vec3_make(0, 1, 3.7474774), metro_vec3_make(0, 1, 0), 40);
    d = metro_camera_direction(&camera, 128, 128, 0.5, 0.5);
    CHECK_CLOSE(d.x / -d.z, -t * 127 / 128, 1e-15);
    CHECK_CLOSE(d.y / -d.z, t * 127 / 128, 1e-15);
    CHECK(metro_camera_project(&camera, 128, 128, metro_vec3_make(-0.99, 1.99, -1), &x, &y), "not in the picture");
    CHECK_CLOSE(x, 64 - 64 * 0.99 / (t * 4.7474774), 1e-12);
    CHECK_CLOSE(y, 64 - 64 * 0.99 / (t * 4.7474774), 1e-12);
}

/* Catches: a projection that forgets the aspect or the depth, what is behind the eye or beside the film let in. */
static void camera_inverse(void)
{
    metro_rng rng = metro_rng_make(5, 1);
    int i, j;
    for (i = 0; i < 50; i++) {
        size_t width = 1 + (size_t)metro_rng_below(&rng, 300), height = 1 + (size_t)metro_rng_below(&rng, 300);
        metro_camera camera =
            camera_make(metro_scale(metro_rng_direction(&rng), 3), metro_scale(metro_rng_direction(&rng), 2),
                        1 + 160 * metro_rng_uniform(&rng));
        double x0 = 0, y0 = 0;
        camera.up = metro_rng_direction(&rng);
        if (metro_camera_check(&camera) != METRO_OK) continue;
        for (j = 0; j < 40; j++) {
            double x = (double)width * metro_rng_uniform(&rng), y = (double)height * metro_rng_uniform(&rng);
            double far = exp(12 * metro_rng_uniform(&rng) - 6), px = -7, py = -7;
            metro_vec3 d = metro_camera_direction(&camera, width, height, x, y);
            int seen =
                metro_camera_project(&camera, width, height, metro_add(camera.eye, metro_scale(d, far)), &px, &py);
            CHECK_CLOSE(metro_length(d), 1, 1e-14);
            CHECK(seen && fabs(px - x) <= 1e-8 * (double)width && fabs(py - y) <= 1e-8 * (double)height,
                  "(%g, %g) came back as (%g, %g)", x, y, px, py);
            px = py = -7;
            seen = metro_camera_project(&camera, width, height, metro_subtract(camera.eye, metro_scale(d, far)), &px,
                                        &py);
            CHECK(!seen && px == -7 && py == -7, "seen behind the eye at (%g, %g)", px, py);
            x = j % 2 ? -1e-3 : (double)width + 1e-3;
            d = metro_camera_direction(&camera, width, height, j % 4 < 2 ? x : 0.5, j % 4 < 2 ? 0.5 : -1e-3);
            seen = metro_camera_project(&camera, width, height, metro_add(camera.eye, metro_scale(d, far)), &px, &py);
            CHECK(!seen && px == -7, "seen beside the film at (%g, %g)", px, py);
        }
        CHECK(!metro_camera_project(&camera, width, height, camera.eye, &x0, &y0), "the eye sees itself");
    }
}

/* The solid angle of a triangle of unit directions (Van Oosterom and Strackee 1983). */
static double solid_angle(metro_vec3 a, metro_vec3 b, metro_vec3 c)
{
    double volume = metro_dot(a, metro_cross(b, c));
    return 2 * atan2(fabs(volume), 1 + metro_dot(a, b) + metro_dot(b, c) + metro_dot(c, a));
}

/* The density of eq 11.5 times the solid angle of a piece of the film is its share of the film, so that it integrates
   to 1. Catches: a cosine too many or too few, the area of the film without its aspect. */
static void camera_density(void)
{
    static const double fov[4] = { 5, 40, 70, 150 };
    int i, x, y;
    for (i = 0; i < 4; i++) {
        metro_camera camera = camera_make(metro_vec3_make(1, 2, 3), metro_vec3_make(-1, 0.5, 2), fov[i]);
        metroi_camera c = metroi_camera_make(&camera, 90, 60);
        double sum = 0;
        CHECK(metro_camera_check(&camera) == METRO_OK, "camera");
        for (y = 0; y < 60; y++)
            for (x = 0; x < 90; x++) {
                metro_vec3 p = metroi_camera_direction(&c, x, y), q = metroi_camera_direction(&c, x + 1, y);
                metro_vec3 r = metroi_camera_direction(&c, x + 1, y + 1), s = metroi_camera_direction(&c, x, y + 1);
                double share = (solid_angle(p, q, r) + solid_angle(p, r, s)) *
                               metroi_camera_density(&c, metroi_camera_direction(&c, x + 0.5, y + 0.5)) * 90 * 60;
                CHECK(fabs(share - 1) <= 2e-2, "fov %g, pixel (%d, %d): %g", fov[i], x, y, share);
                sum += share / (90 * 60);
            }
        CHECK_CLOSE(sum, 1, 1e-3);
    }
}

/* What is refused has no directions. */
static void camera_refusals(void)
{
    const double nan = (double)NAN, inf = (double)INFINITY;
    metro_camera good = camera_make(metro_vec3_make(0, 1, 4), metro_vec3_make(0, 1, 0), 40), bad[14];
    int i;
    for (i = 0; i < 14; i++) bad[i] = good;
    bad[0].look = bad[0].eye;
    bad[1].up = metro_vec3_make(0, 0, 2);
    bad[2].up = metro_vec3_make(0, 0, -1);
    bad[3].up = grey(0);
    bad[4].fov = 0;
    bad[5].fov = 180;
    bad[6].fov = -40;
    bad[7].fov = nan;
    bad[8].eye.x = nan;
    bad[9].eye.y = inf;
    bad[10].look.z = -inf;
    bad[11].up.x = nan;
    bad[12].fov = 200;
    bad[13].up.y = inf;
    CHECK(metro_camera_check(&good) == METRO_OK, "refused");
    for (i = 0; i < 14; i++) {
        metro_vec3 d;
        CHECK(metro_camera_check(&bad[i]) == METRO_ERROR_ARGUMENT, "camera %d is taken", i);
        d = metro_camera_direction(&bad[i], 128, 128, 30, 30);
        CHECK(isnan(d.x) && isnan(d.y) && isnan(d.z), "camera %d has the direction %g %g %g", i, d.x, d.y, d.z);
    }
    for (i = 0; i < 100; i++) { /* `up` along the view, but for rounding */
        metro_camera along = good;
        metro_vec3 d;
        along.look = metro_vec3_make(0.01 * i, 0.3, 0.7);
        along.up = metro_scale(metro_subtract(along.look, along.eye), 3);
        CHECK(metro_camera_check(&along) == METRO_ERROR_ARGUMENT, "view %d is taken", i);
        d = metro_camera_direction(&along, 128, 128, 30, 30);
        CHECK(isnan(d.x), "view %d has the direction %g %g %g", i, d.x, d.y, d.z);
    }
    good.up = metro_vec3_make(1e-200, 1e-200, 1e-200);
    CHECK(metro_camera_check(&good) == METRO_OK, "a short up is refused");
    good.eye = metro_vec3_make(1e-5, 1, 4);
    good.look = metro_vec3_make(1e-5, 1, 4 - 1e-6);
    CHECK(metro_camera_check(&good) == METRO_OK, "a near look is refused");
    good = camera_make(metro_vec3_make(0, 1e200, 0), metro_vec3_make(1e200, 0, 0), 179.9);
    CHECK(metro_camera_check(&good) == METRO_OK, "a far eye is refused");
}

int main(void)
{
    CHECK_RUN(brdf_by_hand);
    CHECK_RUN(brdf_is_symmetric);
    CHECK_RUN(albedo);
    CHECK_RUN(draws_follow_the_density);
    CHECK_RUN(extreme_numbers);
    CHECK_RUN(narrow_lobe);
    CHECK_RUN(black_surface);
    CHECK_RUN(lamp_choice);
    CHECK_RUN(lamp_extremes);
    CHECK_RUN(camera_by_hand);
    CHECK_RUN(camera_inverse);
    CHECK_RUN(camera_density);
    CHECK_RUN(camera_refusals);
    return check_done("light");
}
