/* light.h - what the tests of chapters 11 to 14 share: small scenes made in code, and a render in one call. Include
   it after metro.h and check.h. */

#ifndef LIGHT_H
#define LIGHT_H

#define CHECK_PI 3.14159265358979323846

/* ---- statistics ---- */

/* How many standard errors a mean may be off when its error was estimated with `freedom` degrees of freedom, for the
   same false alarm as 5.1 of a known error: Student's quantile by Cornish and Fisher (1937). */
static inline double student_bound(double freedom)
{
    const double z = 5.1, z3 = z * z * z, z5 = z3 * z * z;
    return z + (z3 + z) / (4 * freedom) + (5 * z5 + 16 * z3 + 3 * z) / (96 * freedom * freedom) +
           (3 * z5 * z * z + 19 * z5 + 17 * z3 - 15 * z) / (384 * freedom * freedom * freedom);
}

/* ---- scenes ---- */

static inline metro_vec3 grey(double value) { return metro_vec3_make(value, value, value); }

static inline metro_scene empty_scene(void)
{
    metro_scene scene;
    memset(&scene, 0, sizeof scene);
    return scene;
}

static inline metro_material material_make(metro_vec3 kd, metro_vec3 ks, double ns, metro_vec3 ke)
{
    metro_material material;
    material.kd = kd;
    material.ks = ks;
    material.ns = ns;
    material.ke = ke;
    return material;
}

static inline uint32_t add_material(metro_scene *scene, metro_vec3 kd, metro_vec3 ks, double ns, metro_vec3 ke)
{
    metro_material material = material_make(kd, ks, ns, ke);
    uint32_t index = 0;
    metro_result result = metro_scene_add_material(scene, &material, &index);
    CHECK(result == METRO_OK, "material: %s", metro_result_text(result));
    return index;
}

static inline void add_triangle(metro_scene *scene, metro_vec3 a, metro_vec3 b, metro_vec3 c, uint32_t material)
{
    metro_vec3 corner[3];
    metro_result result;
    corner[0] = a;
    corner[1] = b;
    corner[2] = c;
    result = metro_scene_add_triangle(scene, corner, material);
    CHECK(result == METRO_OK, "triangle: %s", metro_result_text(result));
}

/* The parallelogram at `corner` with the sides a and b; its normal is along a x b. */
static inline void add_quad(metro_scene *scene, metro_vec3 corner, metro_vec3 a, metro_vec3 b, uint32_t material)
{
    metro_vec3 p = metro_add(corner, a), q = metro_add(p, b);
    add_triangle(scene, corner, p, q, material);
    add_triangle(scene, corner, q, metro_add(corner, b), material);
}

/* The box of the given corners, seen from inside (or outside); materials of the sides -x, +x, -y, +y, -z, +z. */
static inline void add_box(metro_scene *scene, metro_vec3 low, metro_vec3 high, int inside, const uint32_t *material)
{
    int axis, side;
    double size[3];
    size[0] = high.x - low.x;
    size[1] = high.y - low.y;
    size[2] = high.z - low.z;
    for (axis = 0; axis < 3; axis++)
        for (side = 0; side < 2; side++) {
            double c[3], a[3] = { 0, 0, 0 }, b[3] = { 0, 0, 0 };
            metro_vec3 va, vb;
            c[0] = low.x;
            c[1] = low.y;
            c[2] = low.z;
            c[axis] += side ? size[axis] : 0;
            a[(axis + 1) % 3] = size[(axis + 1) % 3]; /* a x b is along +axis */
            b[(axis + 2) % 3] = size[(axis + 2) % 3];
            va = metro_vec3_make(a[0], a[1], a[2]);
            vb = metro_vec3_make(b[0], b[1], b[2]);
            if (side == (inside != 0))
                add_quad(scene, metro_vec3_make(c[0], c[1], c[2]), vb, va, material[2 * axis + side]);
            else add_quad(scene, metro_vec3_make(c[0], c[1], c[2]), va, vb, material[2 * axis + side]);
        }
}

static inline void build(metro_scene *scene)
{
    metro_result result = metro_scene_build(scene);
    CHECK(result == METRO_OK, "build: %s", metro_result_text(result));
}

static inline metro_camera camera_make(metro_vec3 eye, metro_vec3 look, double fov)
{
    metro_camera camera;
    camera.eye = eye;
    camera.look = look;
    camera.up = metro_vec3_make(0, 1, 0);
    camera.fov = fov;
    return camera;
}

/* tests/data/<name>.obj with its camera, built. */
static inline metro_scene load_scene(const char *name)
{
    metro_scene scene = empty_scene();
    char path[200], message[400];
    metro_result result;
    snprintf(path, sizeof path, "tests/data/%s.obj", name);
    result = metro_scene_load_obj(&scene, path, message, sizeof message);
    CHECK(result == METRO_OK && scene.has_camera, "%s: %s", path, message);
    if (result == METRO_OK) build(&scene);
    return scene;
}

/* A closed cube of side 2 around the origin whose walls all reflect and glow alike: a furnace. */
static inline metro_scene furnace_scene(double rho, double emission)
{
    metro_scene scene = empty_scene();
    uint32_t wall[6], material = add_material(&scene, grey(rho), grey(0), 0, grey(emission));
    int i;
    for (i = 0; i < 6; i++) wall[i] = material;
    add_box(&scene, grey(-1), grey(1), 1, wall);
    build(&scene);
    return scene;
}

/* The radiance in a furnace of paths of `shortest` to `depth` edges. */
static inline double furnace_radiance(double rho, double emission, int shortest, int depth)
{
    double sum = 0;
    int k;
    for (k = shortest; k <= depth; k++) sum += emission * pow(rho, k - 1);
    return sum;
}

/* ---- renders ---- */

static inline metro_render_options options_make(metro_method method, size_t size, int depth)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    options.method = method;
    options.width = options.height = size;
    options.depth = depth;
    options.threads = 1;
    return options;
}

static inline metro_render render_make(const metro_scene *scene, const metro_camera *camera,
                                       const metro_render_options *options)
{
    metro_render render;
    metro_result result;
    memset(&render, 0, sizeof render);
    result = metro_render_make(scene, camera, options, &render);
    CHECK(result == METRO_OK, "make: %s", metro_result_text(result));
    return render;
}

static inline metro_render render_run(const metro_scene *scene, const metro_camera *camera,
                                      const metro_render_options *options, uint64_t rounds)
{
    metro_render render = render_make(scene, camera, options);
    metro_result result = metro_render_run(&render, rounds, NULL, NULL);
    CHECK(result == METRO_OK, "run: %s", metro_result_text(result));
    return render;
}

static inline metro_image render_image(const metro_render *render)
{
    metro_image image;
    metro_result result;
    memset(&image, 0, sizeof image);
    result = metro_render_image(render, &image);
    CHECK(result == METRO_OK, "image: %s", metro_result_text(result));
    return image;
}

static inline double image_luminance(const metro_image *image, size_t pixel)
{
    const double *v = image->value + 3 * pixel;
    return metro_luminance(v[0], v[1], v[2]);
}

static inline double image_mean(const metro_image *image)
{
    double sum = 0;
    size_t i, pixels = image->width * image->height;
    for (i = 0; i < pixels; i++) sum += image_luminance(image, i) / (double)pixels;
    return sum;
}

static inline int image_same(const metro_image *a, const metro_image *b)
{
    return a->width == b->width && a->height == b->height &&
           memcmp(a->value, b->value, 3 * a->width * a->height * sizeof(double)) == 0;
}

#endif
