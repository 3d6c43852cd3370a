/* test_mlt.c - chapter 13: states and their importance against walks made here, chains against bidirectional paths
   and furnaces, starts that are biased and starts that are not, b and its error, warnings, and the calibration of
   the stated errors in the small. Renders by one, two and three threads are compared for all methods. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include "light.h"

/* ---- scenes ---- */

/* A closed room in two: the lamp is behind a partition and lights the part of the eye through the gap beside it. The
   floor has a glossy lobe. */
static metro_scene hidden_scene(void)
{
    metro_scene scene = empty_scene();
    uint32_t gloss = add_material(&scene, metro_vec3_make(0.3, 0.25, 0.2), grey(0.5), 20, grey(0));
    uint32_t red = add_material(&scene, metro_vec3_make(0.7, 0.2, 0.1), grey(0), 0, grey(0));
    uint32_t white = add_material(&scene, grey(0.75), grey(0), 0, grey(0));
    uint32_t lamp = add_material(&scene, grey(0.4), grey(0), 0, metro_vec3_make(30, 40, 20));
    uint32_t side[6];
    int i;
    for (i = 0; i < 6; i++) side[i] = white;
    add_box(&scene, metro_vec3_make(0.2, 0, -1), metro_vec3_make(0.3, 2, 0.4), 0, side);
    side[0] = red;
    side[2] = gloss;
    add_box(&scene, metro_vec3_make(-1, 0, -1), metro_vec3_make(1, 2, 1), 1, side);
    add_quad(&scene, metro_vec3_make(0.5, 1.9, -0.6), metro_vec3_make(0.3, 0, 0), metro_vec3_make(0, 0, 0.5), lamp);
    build(&scene);
    return scene;
}

static metro_camera hidden_camera(void)
{
    return camera_make(metro_vec3_make(-0.1, 1.2, 0.9), metro_vec3_make(-0.5, 0.8, -1), 75);
}

/* What stands behind a sample. */
static const metroi_splat *splats(const metroi_sample *sample) { return (const metroi_splat *)(sample + 1); }

/* ---- variants ---- */

typedef struct {
    const char *name;
    metro_method method;
    double perturbation, large_step;
    int one_direction, largest_channel, all_connections, one_stage;
    size_t chains;
    double work; /* rounds, relative */
} mlt_variant;

static const mlt_variant variant[] = {
    { "paper", METRO_MLT, 0.4, 0, 0, 0, 0, 0, 64, 2 },
    { "paper, large steps", METRO_MLT, 0.2, 0.25, 0, 0, 0, 0, 64, 1.5 },
    { "paper, one direction", METRO_MLT, 1.2, 0.1, 1, 0, 0, 0, 64, 2 },
    { "paper, largest channel", METRO_MLT, 0.5, 0.1, 0, 1, 0, 0, 64, 1.5 },
    { "paper, whole sphere", METRO_MLT, 6.2831853071795862, 0, 0, 0, 0, 0, 64, 1 },
    { "paper, beyond the sphere", METRO_MLT, 20, 0, 0, 0, 0, 0, 64, 1 },
    { "pssmlt", METRO_PSSMLT, 0, 0, 0, 0, 0, 0, 64, 1 },
    { "pssmlt, largest channel, small steps", METRO_PSSMLT, 0.1, 0.1, 0, 1, 0, 0, 64, 1 },
    { "pssmlt, one stage", METRO_PSSMLT, 0, 0, 0, 0, 0, 1, 64, 1 },
    { "pssmlt, all connections", METRO_PSSMLT, 0, 0, 0, 0, 1, 0, 64, 0.5 },
    { "pssmlt, all connections, one stage, largest channel", METRO_PSSMLT, 0, 0, 0, 1, 1, 1, 64, 0.5 },
    { "pssmlt, ten chains", METRO_PSSMLT, 0, 0, 0, 0, 0, 0, 10, 1 },
};

enum { VARIANTS = (int)(sizeof variant / sizeof variant[0]) };

static metro_render_options variant_options(const mlt_variant *v, size_t size, int depth)
{
    metro_render_options options = options_make(v->method, size, depth);
    options.perturbation = v->perturbation;
    options.large_step = v->large_step;
    options.one_direction = v->one_direction;
    options.largest_channel = v->largest_channel;
    options.all_connections = v->all_connections;
    options.one_stage = v->one_stage;
    options.chains = v->chains;
    options.candidates = 64;
    return options;
}

static metroi_metropolis *plan_of(const metro_render *render) { return &((metroi_render *)render->state)->chains; }

/* Makes the chains and starts them, and takes no step. */
static metro_render render_start(const metro_scene *scene, const metro_camera *camera,
                                 const metro_render_options *options)
{
    metro_render render = render_make(scene, camera, options);
    metro_result result = metro_render_run(&render, 0, NULL, NULL);
    CHECK(result == METRO_OK, "run: %s", metro_result_text(result));
    result = metroi_chains_start(plan_of(&render));
    CHECK(result == METRO_OK, "start: %s", metro_result_text(result));
    return render;
}

/* The truth, from bidirectional paths. */
static metro_render bidirectional(const metro_scene *scene, const metro_camera *camera, size_t size, int depth,
                                  double rounds)
{
    metro_render_options options = options_make(METRO_BDPT, size, depth);
    options.seed = 77;
    return render_run(scene, camera, &options, check_count(rounds, 32));
}

/* The blocks of a render by chains agree with the truth within their joint errors, and so does the mean. */
static void compare_renders(const metro_render *render, const metro_render *truth, const char *what)
{
    metro_render_report report, known;
    double bound = student_bound((double)render->options.chains - 1);
    size_t column, row, columns = (truth->options.width + 7) / 8, rows = (truth->options.height + 7) / 8;
    metro_render_diagnose(render, &report);
    metro_render_diagnose(truth, &known);
    CHECK(report.not_finite == 0, "%s: %d contributions are not finite", what, (int)report.not_finite);
    CHECK(fabs(report.mean - known.mean) <=
              5.1 * sqrt(report.mean_error * report.mean_error + known.mean_error * known.mean_error),
          "%s: mean %.6g +- %.2g, should be %.6g +- %.2g", what, report.mean, report.mean_error, known.mean,
          known.mean_error);
    for (row = 0; row < rows; row++)
        for (column = 0; column < columns; column++) {
            double e, f, x = metro_render_block(render, column, row, &e),
                         y = metro_render_block(truth, column, row, &f);
            CHECK(fabs(x - y) <= bound * sqrt(e * e + f * f) && e < y,
                  "%s, block (%d, %d): %.6g +- %.2g, should be %.6g +- %.2g", what, (int)column, (int)row, x, e, y,
                  f);
        }
}

/* ---- states ---- */

static void state_draw(const metro_render *render, double *z, metro_rng *rng)
{
    metroi_state_draw(&plan_of(render)->walker[0].chain.target, z, rng);
}

enum { DOUBLES = 4 + 6 * METRO_DEPTH_MOST };

/* The importance is the sum over what a state contributes of luminance or largest channel, divided by the pilot where
   there is one: eq 13.3. Catches: a pilot that is forgotten, or read at another pixel. */
static void importance_by_hand(void)
{
    metro_scene scene = load_scene("S1");
    int v;
    for (v = 0; v < VARIANTS; v++) {
        metro_render_options options = variant_options(&variant[v], 24, 4);
        metro_render render = render_start(&scene, &scene.camera, &options);
        metroi_metropolis *plan = plan_of(&render);
        metroi_walker *walker = &plan->walker[0];
        metroi_sample *sample = (metroi_sample *)malloc(metroi_sample_size(&plan->tracer));
        metro_rng rng = metro_rng_make(1, (uint64_t)v);
        int i, lit = 0;
        CHECK((plan->pilot != NULL) == (options.method == METRO_PSSMLT && !options.one_stage), "%s: pilot",
              variant[v].name);
        CHECK((plan->way != NULL) == (options.method == METRO_PSSMLT && !options.all_connections), "%s: ways",
              variant[v].name);
        for (i = 0; i < 400; i++) {
            double z[DOUBLES], sum = 0, importance;
            size_t k;
            state_draw(&render, z, &rng);
            importance = walker->chain.target.importance(z, sample, walker);
            for (k = 0; k < sample->count; k++) {
                metro_vec3 c = splats(sample)[k].color;
                double value = metro_luminance(c.x, c.y, c.z);
                if (options.largest_channel) value = c.x > c.y ? (c.x > c.z ? c.x : c.z) : c.y > c.z ? c.y : c.z;
                sum += plan->pilot != NULL ? value / plan->pilot[splats(sample)[k].pixel] : value;
            }
            CHECK(fabs(importance - sum) <= 1e-12 * sum, "%s: importance %.12g, should be %.12g", variant[v].name,
                  importance, sum);
            lit += importance > 0;
        }
        CHECK(lit > 20, "%s: %d states of 400 are lit", variant[v].name, lit);
        free(sample);
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

/* A state that makes one way uses the numbers that metroi_way_uses names and no other; the shares are probabilities.
   Catches: a number that a way uses and no small step moves, one that is moved for nothing. */
static void ways_use_their_numbers(void)
{
    enum { DEPTH = 4 };
    metro_scene scene = load_scene("S1");
    metro_render_options options = variant_options(&variant[6], 16, DEPTH);
    metro_render render = render_start(&scene, &scene.camera, &options);
    metroi_metropolis *plan = plan_of(&render);
    metroi_walker *walker = &plan->walker[0];
    metroi_sample *sample = (metroi_sample *)malloc(metroi_sample_size(&plan->tracer));
    metro_rng rng = metro_rng_make(2, 1);
    double sum = 0, z[DOUBLES];
    size_t w, place;
    CHECK(plan->way_count == 2 + 3 + 4 + 5, "%d ways", (int)plan->way_count);
    for (w = 0; w < plan->way_count; w++) {
        const metroi_way *way = &plan->way[w];
        int moved[2 * DEPTH] = { 0 }, tries, edges = way->s + way->t - 1;
        CHECK(way->t >= 1 && edges >= 1 && edges <= DEPTH, "way (%d, %d)", way->s, way->t);
        CHECK(way->share >= 0.2 / 14 - 1e-12, "share %g", way->share);
        sum += way->share;
        CHECK_CLOSE(way->until, sum, 1e-12);
        for (tries = 0; tries < 8000; tries++) {
            double before, after, keep[2];
            state_draw(&render, z, &rng);
            z[0] = way->until - way->share / 2;
            CHECK(metroi_way_choose(plan, z[0]) == way, "another way is chosen");
            before = walker->chain.target.importance(z, sample, walker);
            if (!(before > 0)) continue;
            CHECK(sample->count == 1 && splats(sample)[0].s == way->s && splats(sample)[0].t == way->t,
                  "another way is made");
            for (place = 0; place < 2 * DEPTH; place++) {
                memcpy(keep, z + 1 + 2 * place, sizeof keep);
                z[1 + 2 * place] = metro_rng_uniform(&rng);
                z[2 + 2 * place] = metro_rng_uniform(&rng);
                after = walker->chain.target.importance(z, sample, walker);
                moved[place] |= after != before;
                memcpy(z + 1 + 2 * place, keep, sizeof keep);
            }
        }
        for (place = 0; place < 2 * DEPTH; place++)
            CHECK(moved[place] == metroi_way_uses(way, place) || (!moved[place] && place == 0),
                  "way (%d, %d), pair %d: %s", way->s, way->t, (int)place,
                  moved[place] ? "moves the path" : "does nothing");
    }
    CHECK_CLOSE(sum, 1, 1e-12);
    CHECK(plan->way[plan->way_count - 1].until == 1, "the last sum");
    /* A small step moves what is used, keeps the rest and the way, and is symmetric */
    for (w = 0; w < 2000; w++) {
        double to[DOUBLES], ratio;
        const metroi_way *way;
        state_draw(&render, z, &rng);
        way = metroi_way_choose(plan, z[0]);
        ratio = walker->chain.target.propose(z, to, &rng, walker);
        CHECK(ratio == 1, "the ratio is %g", ratio);
        CHECK(to[0] == z[0], "the way changes");
        for (place = 0; place < 2 * DEPTH; place++) {
            int both = to[1 + 2 * place] != z[1 + 2 * place] && to[2 + 2 * place] != z[2 + 2 * place];
            int none = to[1 + 2 * place] == z[1 + 2 * place] && to[2 + 2 * place] == z[2 + 2 * place];
            CHECK(metroi_way_uses(way, place) ? both : none, "way (%d, %d), pair %d", way->s, way->t, (int)place);
        }
    }
    free(sample);
    metro_render_free(&render);
    metro_scene_free(&scene);
}

/* The pilot is a blurred picture over its mean, at least a tenth. */
static void pilot_picture(void)
{
    enum { SIZE = 32 };
    metro_scene scene = load_scene("S1");
    metro_render_options options = variant_options(&variant[6], SIZE, 4);
    metro_render render = render_start(&scene, &scene.camera, &options), truth;
    metro_image image;
    double mean, off = 0, y[SIZE][SIZE];
    int i, j, k, l;
    truth = bidirectional(&scene, &scene.camera, SIZE, 4, 16);
    image = render_image(&truth);
    mean = image_mean(&image);
    for (i = 0; i < SIZE; i++)
        for (j = 0; j < SIZE; j++) {
            double sum = 0, count = 0, seen = plan_of(&render)->pilot[SIZE * i + j];
            for (k = i - 4; k <= i + 4; k++)
                for (l = j - 4; l <= j + 4; l++)
                    if (k >= 0 && k < SIZE && l >= 0 && l < SIZE) {
                        sum += image_luminance(&image, (size_t)(SIZE * k + l));
                        count++;
                    }
            y[i][j] = sum / count / mean;
            if (y[i][j] < 0.1) y[i][j] = 0.1;
            CHECK(seen >= 0.1, "pixel (%d, %d): %g", j, i, seen);
            off += fabs(log(seen / y[i][j])) / (SIZE * SIZE);
        }
    CHECK(off < 0.25, "the pilot is off by %g on average", off);
    CHECK_CLOSE(plan_of(&render)->pilot_mean, mean, 6 * plan_of(&render)->pilot_error);
    metro_image_free(&image);
    metro_render_free(&render);
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* The cone's full angle is the apex angle, so a direction turns by up to half of it; the film position moves by up
   to half of it as seen from the eye, and the lamp's point by the same share of a square as the cone has of a
   straight angle. With one direction a step moves one thing, each as often. Catches: the apex angle for the
   half-angle, degrees, a horizontal angle for the vertical one. */
static void perturbation_sizes(void)
{
    enum { DEPTH = 4 };
    metro_scene scene = load_scene("S1");
    metro_camera camera = scene.camera;
    const double apex = 0.02;
    int one;
    camera.fov = 12;
    for (one = 0; one < 2; one++) {
        metro_render_options options = options_make(METRO_MLT, 16, DEPTH);
        double z[DOUBLES], to[DOUBLES], most[5] = { 0 }, moved[8] = { 0 }, p[8];
        metro_render render;
        metro_chain *chain;
        metro_rng rng = metro_rng_make(3, 1);
        int i, k;
        options.width = 32;
        options.perturbation = apex;
        options.one_direction = one;
        options.candidates = 64;
        options.chains = 4;
        render = render_start(&scene, &camera, &options);
        chain = &plan_of(&render)->walker[0].chain;
        CHECK(plan_of(&render)->axis_count == 4 + 2 * (DEPTH - 1), "%d axes", (int)plan_of(&render)->axis_count);
        for (k = 0; k < 20000; k++) {
            double step[8];
            metro_vec3 a, b;
            state_draw(&render, z, &rng);
            z[0] = z[1] = z[2] = z[3] = 0.5;
            if (one) CHECK(chain->target.propose(z, to, &rng, chain->target.user) == 1, "the ratio is not 1");
            else metroi_state_perturb(&chain->target, z, to, &rng);
            a = metro_camera_direction(&camera, 32, 16, 32 * z[0], 8);
            b = metro_camera_direction(&camera, 32, 16, 32 * to[0], 8);
            step[0] = metroi_direction_angle(&a.x, &b.x);
            a = metro_camera_direction(&camera, 32, 16, 16, 16 * z[1]);
            b = metro_camera_direction(&camera, 32, 16, 16, 16 * to[1]);
            step[1] = metroi_direction_angle(&a.x, &b.x);
            step[2] = fabs(to[2] - z[2]) * CHECK_PI;
            step[3] = fabs(to[3] - z[3]) * CHECK_PI;
            step[4] = 0;
            if (step[0] > 1e-9) moved[0]++; /* the angle of a direction with itself may be a rounding error */
            if (step[2] > 0) moved[1]++;
            for (i = 0; i < 2 * (DEPTH - 1); i++) {
                double turn = metroi_direction_angle(z + 4 + 3 * i, to + 4 + 3 * i);
                if (turn > 1e-9) moved[2 + i]++;
                if (turn > step[4]) step[4] = turn;
            }
            for (i = 0; i < 5; i++)
                if (step[i] > most[i]) most[i] = step[i];
        }
        for (i = 0; i < 5; i++)
            CHECK(most[i] <= apex / 2 * (1 + 0.02) && most[i] >= apex / 2 * (1 - 0.03),
                  "%s: part %d moves by %g, should be up to %g", one ? "one" : "all", i, most[i], apex / 2);
        for (i = 0; i < 8; i++) p[i] = 1.0 / 8;
        if (one) check_chi_square("what is moved", moved, p, 8, 20000);
        else
            for (i = 0; i < 8; i++) CHECK(moved[i] == 20000, "part %d moved %g times", i, moved[i]);
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

/* ---- chains against the truth ---- */

/* Independent uniform states, which a chain of large steps draws, have the mean importance b, and give the picture.
   Catches: any direction density but 1/(4 pi) in walks or weights, a coin in a state, a share q of a way that is left
   out. */
static void uniform_states(void)
{
    static const int pick[6] = { 0, 3, 6, 8, 9, 10 };
    metro_scene s1 = load_scene("S1"), hidden = hidden_scene();
    metro_camera hidden_eye = hidden_camera();
    int i, j;
    for (i = 0; i < 2; i++) {
        const metro_scene *scene = i ? &hidden : &s1;
        const metro_camera *camera = i ? &hidden_eye : &s1.camera;
        metro_render truth = bidirectional(scene, camera, 16, 3, 250);
        metro_render_report known;
        metro_render_diagnose(&truth, &known);
        for (j = 0; j < 6; j++) {
            const mlt_variant *v = &variant[pick[j]];
            metro_render_options options = variant_options(v, 16, 3);
            metro_render_report report;
            metro_render render;
            char what[100];
            options.large_step = 1;
            render = render_run(scene, camera, &options, check_count(80 * v->work, 40));
            snprintf(what, sizeof what, "uniform states, %s, scene %d", v->name, i);
            compare_renders(&render, &truth, what);
            metro_render_diagnose(&render, &report);
            if (options.one_stage || (options.method == METRO_MLT && !options.largest_channel))
                if (!options.largest_channel)
                    CHECK(fabs(report.b - known.mean) <=
                              5.1 * sqrt(report.b_error * report.b_error + known.mean_error * known.mean_error),
                          "%s: b %.6g +- %.2g, should be %.6g +- %.2g", what, report.b, report.b_error, known.mean,
                          known.mean_error);
            metro_render_free(&render);
        }
        metro_render_free(&truth);
    }
    metro_scene_free(&s1);
    metro_scene_free(&hidden);
}

/* Catches: a picture scaled by another b, weights that are recorded once too often, a ratio T other than 1, a length
   that never changes, a pilot that divides the importance and not the sample. */
static void chains_agree(void)
{
    metro_scene s1 = load_scene("S1"), hidden = hidden_scene();
    metro_camera hidden_eye = hidden_camera();
    int i, v;
    for (i = 0; i < 2; i++) {
        const metro_scene *scene = i ? &hidden : &s1;
        const metro_camera *camera = i ? &hidden_eye : &s1.camera;
        metro_render truth = bidirectional(scene, camera, 16, 3, 250);
        for (v = 0; v < VARIANTS; v++) {
            metro_render_options options = variant_options(&variant[v], 16, 3);
            metro_render render = render_run(scene, camera, &options, check_count(150 * variant[v].work, 60));
            char what[100];
            snprintf(what, sizeof what, "%s, scene %d", variant[v].name, i);
            compare_renders(&render, &truth, what);
            metro_render_free(&render);
        }
        metro_render_free(&truth);
    }
    metro_scene_free(&s1);
    metro_scene_free(&hidden);
}

/* In a furnace every pixel has the sum of E rho^(k-1) over the edges k that count, by every kind of chain: 2 to 4
   edges in a bright one, 4 to 6 in a dark one, where roulette in a state would show. */
static void furnace(double rho, int shortest, int depth, double precision)
{
    metro_scene scene = furnace_scene(rho, 2);
    metro_camera camera = camera_make(metro_vec3_make(0.1, -0.2, 0.3), metro_vec3_make(-0.7, 0.3, -1), 60);
    double truth = furnace_radiance(rho, 2, shortest, depth);
    int v;
    for (v = 0; v < VARIANTS; v++) {
        metro_render_options options = variant_options(&variant[v], 16, depth);
        metro_render_report report;
        metro_render render;
        int column, row;
        double bound = student_bound((double)options.chains - 1);
        options.shortest = shortest;
        render = render_run(&scene, &camera, &options, check_count(50 * variant[v].work, 30));
        metro_render_diagnose(&render, &report);
        CHECK(fabs(report.mean - truth) <= 5.1 * report.mean_error && report.mean_error < precision * truth,
              "%s: mean %.6g +- %.2g, should be %.6g", variant[v].name, report.mean, report.mean_error, truth);
        for (row = 0; row < 2; row++)
            for (column = 0; column < 2; column++) {
                double error, value = metro_render_block(&render, (size_t)column, (size_t)row, &error);
                CHECK(fabs(value - truth) <= bound * error && error < 8 * precision * truth,
                      "%s, block (%d, %d): %.6g +- %.2g, should be %.6g", variant[v].name, column, row, value, error,
                      truth);
            }
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

static void furnaces(void)
{
    furnace(0.8, 2, 4, 0.03);
    furnace(0.3, 4, 6, 0.08);
}

/* ---- starts ---- */

/* With the same `start_seed` chain i starts at the same state in every run, the first one of its stream that is lit;
   with another, elsewhere. Started at seeds, runs start at unlike states. */
static void start_points(void)
{
    metro_scene scene = hidden_scene();
    metro_camera camera = hidden_camera();
    static const metro_method method[2] = { METRO_MLT, METRO_PSSMLT };
    int m, i;
    size_t c, k;
    for (m = 0; m < 2; m++) {
        metro_render render[4];
        for (i = 0; i < 4; i++) {
            metro_render_options options = options_make(method[m], 16, 4);
            options.chains = 5;
            options.candidates = 64;
            options.start = METRO_START_POINT;
            options.one_stage = 1; /* else each run has its own pilot, and by it its own ways */
            options.all_connections = 1;
            options.seed = i == 0 ? 1 : 2;
            options.start_seed = i == 2 ? 12 : 11;
            if (i == 3) options.start = METRO_START_SEEDS;
            render[i] = render_start(&scene, &camera, &options);
        }
        for (c = 0; c < 5; c++) {
            const metro_chain *chain[4];
            metro_rng rng = metro_rng_make(11, c);
            size_t doubles;
            int same[4] = { 1, 1, 1, 1 };
            double z[DOUBLES];
            for (i = 0; i < 4; i++) chain[i] = &plan_of(&render[i])->walker[c].chain;
            doubles = metroi_state_doubles(&chain[0]->target);
            for (i = 1; i < 4; i++)
                for (k = 0; k < doubles; k++) same[i] &= chain[i]->state[k] == chain[0]->state[k];
            CHECK(same[1] && !same[2] && !same[3], "chain %d: %d %d %d", (int)c, same[1], same[2], same[3]);
            CHECK(chain[0]->importance > 0, "chain %d starts in the dark", (int)c);
            CHECK(chain[0]->normalisation.count == 64, "b rests on %d draws", (int)chain[0]->normalisation.count);
            do metroi_state_draw(&chain[0]->target, z, &rng);
            while (!(chain[0]->target.importance(z, chain[0]->tentative_sample, chain[0]->target.user) > 0));
            for (k = 0; k < doubles; k++)
                CHECK(z[k] == chain[0]->state[k], "chain %d, coordinate %d", (int)c, (int)k);
        }
        for (i = 0; i < 4; i++) metro_render_free(&render[i]);
    }
    metro_scene_free(&scene);
}

/* Runs of 16 chains of 16 small steps each, over many seeds. Weighted seeds have the right mean; from one fixed start
   the mean over runs is wrong, however many runs there are, and that is the start-up bias itself. Catches: a weight
   that is forgotten or used twice, a start that is drawn anew in each run, a scale by the wrong number of steps. */
static void short_runs(metro_start start, size_t candidates, size_t chains, double runs, const metro_render *truth,
                       double *worst)
{
    metro_moments block[4];
    uint64_t run, n = check_count(runs, 30);
    int b;
    memset(block, 0, sizeof block);
    for (run = 0; run < n; run++) {
        metro_render_options options = options_make(METRO_MLT, 16, 3);
        metro_render render;
        options.perturbation = 0.1;
        options.chains = chains;
        options.candidates = candidates;
        options.start = start;
        options.start_seed = 5;
        options.seed = run;
        render = render_run(truth->scene, &truth->scene->camera, &options, 1);
        for (b = 0; b < 4; b++) {
            double error;
            metro_moments_add(&block[b], metro_render_block(&render, (size_t)b % 2, (size_t)b / 2, &error));
        }
        metro_render_free(&render);
    }
    *worst = 0;
    for (b = 0; b < 4; b++) {
        double error, known = metro_render_block(truth, (size_t)b % 2, (size_t)b / 2, &error);
        double spread = metro_moments_error(&block[b]), off = fabs(metro_moments_mean(&block[b]) - known);
        off /= sqrt(error * error + spread * spread);
        if (off > *worst) *worst = off;
    }
}

static void start_up_bias(void)
{
    metro_scene scene = load_scene("S1");
    metro_render truth = bidirectional(&scene, &scene.camera, 16, 3, 600);
    double worst, bound = student_bound((double)check_count(100, 30) - 1);
    short_runs(METRO_START_WEIGHTED, 32, 16, 200, &truth, &worst);
    CHECK(worst <= bound, "weighted seeds are off by %.2f standard errors", worst);
    /* one candidate, of which many are dark: the runs of weight 0 belong to the mean */
    short_runs(METRO_START_WEIGHTED, 1, 64, 150, &truth, &worst);
    CHECK(worst <= bound, "single weighted seeds are off by %.2f standard errors", worst);
    short_runs(METRO_START_POINT, 32, 16, 100, &truth, &worst);
    CHECK(worst > 1.3 * bound, "fixed starts are off by %.2f standard errors only", worst);
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* Chains that found no start are no disagreement. Catches: R-hat of lines of zeros. */
static void dead_chains(void)
{
    metro_scene scene = load_scene("S1");
    metro_render_options options = options_make(METRO_PSSMLT, 16, 4);
    metro_render_report report;
    metro_render render;
    size_t c, alive = 0;
    options.chains = 16;
    options.candidates = 1;
    options.start = METRO_START_WEIGHTED;
    render = render_run(&scene, &scene.camera, &options, 600);
    for (c = 0; c < 16; c++) alive += plan_of(&render)->walker[c].alive ? 1u : 0u;
    metro_render_diagnose(&render, &report);
    CHECK(alive > 4 && alive < 16, "%d of 16 chains are alive", (int)alive);
    CHECK(report.rhat < 1.1, "R-hat %g", report.rhat);
    metro_render_free(&render);
    metro_scene_free(&scene);
}

/* b from seeds that are drawn again while all are dark: over many runs it is the mean luminance, which bidirectional
   paths know. Catches: draws that one stops at among those that count. */
static void b_of_dark_starts(void)
{
    metro_scene scene = load_scene("S2");
    metro_render truth = bidirectional(&scene, &scene.camera, 4, 8, 20000);
    metro_render_options options = options_make(METRO_PSSMLT, 4, 8);
    metro_render_report report, known;
    metro_moments b = { 0, 0, 0, 0 };
    uint64_t run, runs = check_count(20000, 1000);
    metro_render_diagnose(&truth, &known);
    options.chains = 1;
    options.candidates = 4;
    options.all_connections = options.one_stage = 1;
    options.large_step = -1;
    for (run = 0; run < runs; run++) {
        metro_render render;
        options.seed = run;
        render = render_run(&scene, &scene.camera, &options, 1);
        metro_render_diagnose(&render, &report);
        metro_moments_add(&b, report.b);
        metro_render_free(&render);
    }
    CHECK_SIGMA(metro_moments_mean(&b), known.mean, hypot(metro_moments_error(&b), known.mean_error));
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* A lamp so bright that the importance of some states is infinite: they are counted and left out, of b and of the
   mean as well. */
static void infinite_states(void)
{
    metro_scene scene = empty_scene();
    metro_camera camera = camera_make(metro_vec3_make(0, 1, 4), metro_vec3_make(0, 0, 0), 40);
    metro_render_options options = options_make(METRO_PSSMLT, 16, 3);
    static const metro_start start[3] = { METRO_START_SEEDS, METRO_START_POINT, METRO_START_WEIGHTED };
    int i;
    add_quad(&scene, metro_vec3_make(-1, 0, 1), metro_vec3_make(2, 0, 0), metro_vec3_make(0, 0, -2),
             add_material(&scene, grey(0.5), grey(0), 0, grey(1)));
    add_quad(&scene, metro_vec3_make(-0.2, 0.5, 0), metro_vec3_make(0, 0, 0.4), metro_vec3_make(0.4, 0, 0),
             add_material(&scene, grey(0), grey(0), 0, grey(1.7e308)));
    build(&scene);
    for (i = 0; i < 3; i++) {
        metro_render_report report;
        metro_render render;
        options.start = start[i];
        options.heuristic = METRO_UNWEIGHTED;
        options.one_stage = 1;
        render = render_run(&scene, &camera, &options, 20);
        metro_render_diagnose(&render, &report);
        CHECK(!isnan(report.mean) && report.not_finite > 0, "start %d: mean %g, %d not finite", i, report.mean,
              (int)report.not_finite);
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

/* ---- b and the report ---- */

/* b rests on all candidates, all large steps and, where there are none, on a survey in each round; its error falls
   with the run, and b is right. Catches: a b that is frozen at the start, an error that is. */
static void b_is_refined(void)
{
    metro_scene scene = load_scene("S1");
    metro_render truth = bidirectional(&scene, &scene.camera, 16, 4, 400);
    metro_image picture = render_image(&truth);
    static const int pick[5] = { 0, 1, 6, 8, 10 };
    int i;
    for (i = 0; i < 5; i++) {
        const mlt_variant *v = &variant[pick[i]];
        metro_render_options options = variant_options(v, 16, 4);
        metro_render_report early, late, known;
        const metroi_metropolis *plan;
        metro_moments importance, luminance;
        metro_render render;
        uint64_t expected, large = 0, rounds = 120;
        double b = 0, error = 0, fall;
        size_t c, p;
        options.chains = 16;
        options.candidates = 16;
        render = render_run(&scene, &scene.camera, &options, 8);
        metro_render_diagnose(&render, &early);
        CHECK(metro_render_run(&render, rounds - 8, NULL, NULL) == METRO_OK, "run");
        metro_render_diagnose(&render, &late);
        plan = plan_of(&render);
        for (c = 0; c < 16; c++) large += plan->walker[c].chain.counts.large_steps;
        metroi_chains_moments(plan, &importance, &luminance);
        /* 16 steps of each chain in a round */
        expected = 16 * 16 + (render.options.large_step > 0 ? large : 16 * rounds);
        CHECK(importance.count == expected && luminance.count == expected,
              "%s: b of %d and mean of %d draws, should be %d", v->name, (int)importance.count, (int)luminance.count,
              (int)expected);
        CHECK_CLOSE((double)large, render.options.large_step * 256 * (double)rounds,
                    5.1 * sqrt(256 * (double)rounds / 4));
        fall = sqrt((double)(16 * 16 + (expected - 16 * 16) / rounds * 8) / (double)expected);
        CHECK(late.b_error < 1.5 * fall * early.b_error && late.b_error > 0,
              "%s: the error of b fell from %g to %g, by less than %g", v->name, early.b_error, late.b_error, fall);
        /* The truth of b for this importance, from the picture */
        for (p = 0; p < 256; p++)
            b += image_luminance(&picture, p) / (plan->pilot != NULL ? plan->pilot[p] : 1) / 256;
        metro_render_diagnose(&truth, &known);
        error = known.mean_error / known.mean * b * 2;
        if (!options.largest_channel)
            CHECK(fabs(late.b - b) <= 5.1 * sqrt(late.b_error * late.b_error + error * error),
                  "%s: b %.6g +- %.2g, should be %.6g", v->name, late.b, late.b_error, b);
        metro_render_free(&render);
    }
    metro_image_free(&picture);
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* The report adds up what the chains counted, and the picture has the mean that the report states. */
static void report_by_hand(void)
{
    metro_scene scene = hidden_scene();
    metro_camera camera = hidden_camera();
    int v;
    for (v = 0; v < VARIANTS; v++) {
        metro_render_options options = variant_options(&variant[v], 16, 4);
        metro_render render = render_run(&scene, &camera, &options, 12);
        metro_render_report report;
        double steps = 0, accepted = 0, dark = 0;
        uint64_t stay = 0;
        metro_image image = render_image(&render);
        size_t c;
        metro_render_diagnose(&render, &report);
        for (c = 0; c < options.chains; c++) {
            const metro_chain_counts *counts = &plan_of(&render)->walker[c].chain.counts;
            steps += (double)counts->steps;
            accepted += (double)counts->accepted;
            dark += (double)counts->dark;
            if (counts->longest_stay > stay) stay = counts->longest_stay;
        }
        CHECK_NEAR(report.acceptance, accepted / steps, 1e-12);
        CHECK_NEAR(report.dark, dark / steps, 1e-12);
        CHECK(report.longest_stay == stay && stay > 0, "%s: longest stay %d, should be %d", variant[v].name,
              (int)report.longest_stay, (int)stay);
        CHECK(render.samples == (uint64_t)steps && render.rays > render.samples / 4,
              "%s: %d samples, %g steps, %d rays", variant[v].name, (int)render.samples, steps, (int)render.rays);
        CHECK(fabs(image_mean(&image) - report.mean) <= (options.largest_channel ? 0.05 : 1e-5) * report.mean,
              "%s: the picture has the mean %g, the report says %g", variant[v].name, image_mean(&image),
              report.mean);
        metro_image_free(&image);
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

/* A picture of one block is known as well as its mean, whose error all blocks share. Catches: blocks that take b, or
   the mean luminance, for known. */
static void errors_in_common(void)
{
    metro_scene scene = load_scene("S1");
    int v;
    for (v = 0; v < VARIANTS; v++) {
        metro_render_options options = variant_options(&variant[v], 8, 4);
        metro_render_report report;
        metro_render render;
        double value, error;
        options.candidates = 4;
        render = render_run(&scene, &scene.camera, &options, 20);
        metro_render_diagnose(&render, &report);
        value = metro_render_block(&render, 0, 0, &error);
        CHECK_CLOSE(value, report.mean, (options.largest_channel ? 0.1 : 1e-5) * report.mean);
        CHECK(error >= 0.999 * report.mean_error &&
                  error <= (options.largest_channel ? 1.5 : 1.001) * report.mean_error,
              "%s: the error of the only block is %g, that of the mean %g", variant[v].name, error,
              report.mean_error);
        metro_render_free(&render);
    }
    metro_scene_free(&scene);
}

/* With large steps the number of edges changes, so that ten chains do as well as 64 with as many steps in all. */
static void ten_chains(void)
{
    metro_scene scene = hidden_scene();
    metro_camera camera = hidden_camera();
    metro_render truth = bidirectional(&scene, &camera, 16, 4, 600);
    metro_image picture = render_image(&truth), image;
    double squared[2] = { 0, 0 };
    int i, seed;
    size_t p;
    for (i = 0; i < 2; i++)
        for (seed = 0; seed < 6; seed++) {
            metro_render_options options = options_make(METRO_PSSMLT, 16, 4);
            metro_render render;
            options.chains = i ? 64 : 10;
            options.candidates = i ? 160 : 1024;
            options.seed = (uint64_t)seed;
            render = render_run(&scene, &camera, &options, i ? 100 : 98); /* 26 steps of ten chains a round */
            image = render_image(&render);
            for (p = 0; p < 256; p++) squared[i] += pow(image_luminance(&image, p) - image_luminance(&picture, p), 2);
            metro_image_free(&image);
            metro_render_free(&render);
        }
    CHECK(squared[0] < 1.4 * squared[1], "ten chains: squared error %g, 64 chains %g", squared[0], squared[1]);
    metro_image_free(&picture);
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* ---- warnings ---- */

/* Two rooms, one with a tiny bright lamp, one dark but for what comes through a slit; the camera sees both. */
static metro_scene dark_room_scene(void)
{
    metro_scene scene = empty_scene();
    uint32_t white = add_material(&scene, grey(0.6), grey(0), 0, grey(0));
    uint32_t lamp = add_material(&scene, grey(0), grey(0), 0, grey(20000));
    uint32_t side[6];
    int i;
    for (i = 0; i < 6; i++) side[i] = white;
    add_box(&scene, metro_vec3_make(-1, 0, -1), metro_vec3_make(1, 2, 1), 1, side);
    add_box(&scene, metro_vec3_make(-0.02, 0, -1), metro_vec3_make(0.02, 1.97, 0.3), 0, side);
    add_box(&scene, metro_vec3_make(-0.02, 0, 0.3), metro_vec3_make(0.02, 1.97, 0.32), 0, side);
    add_quad(&scene, metro_vec3_make(-0.8, 0.4, -0.6), metro_vec3_make(0, 0, 0.02), metro_vec3_make(0, 0.02, 0),
             lamp);
    build(&scene);
    return scene;
}

static const char *warning_of(const metro_scene *scene, const metro_camera *camera,
                              const metro_render_options *options, uint64_t rounds, metro_render_report *report)
{
    metro_render render = render_run(scene, camera, options, rounds);
    metro_render_diagnose(&render, report);
    metro_render_free(&render);
    return report->warning;
}

/* Catches: a warning that never comes, or always. */
static void warnings(void)
{
    metro_scene s1 = load_scene("S1"), hidden = hidden_scene(), dark = dark_room_scene();
    metro_camera hidden_eye = hidden_camera();
    metro_camera dark_eye = camera_make(metro_vec3_make(0, 1, 0.98), metro_vec3_make(0, 1, -1), 100);
    metro_render_options options;
    metro_render_report report;
    options = options_make(METRO_PSSMLT, 32, 4);
    CHECK(warning_of(&s1, &s1.camera, &options, check_count(60, 60), &report)[0] == 0, "S1: %s", report.warning);
    CHECK(report.rhat < 1.1 && report.rhat > 0.9 && report.ess > 100, "S1: R-hat %g, ESS %g", report.rhat,
          report.ess);
    options = options_make(METRO_MLT, 32, 3);
    options.perturbation = 0.6;
    options.large_step = 0.2;
    CHECK(warning_of(&s1, &s1.camera, &options, check_count(100, 100), &report)[0] == 0, "S1, paper: %s",
          report.warning);
    options = options_make(METRO_BDPT, 16, 4);
    CHECK(warning_of(&s1, &s1.camera, &options, check_count(100, 100), &report)[0] == 0, "S1, bdpt: %s",
          report.warning);

    options = options_make(METRO_MLT, 32, 4);
    options.candidates = 64;
    CHECK(warning_of(&hidden, &hidden_eye, &options, 4, &report)[0] != 0, "few steps at a hidden lamp: no warning");
    options = options_make(METRO_PSSMLT, 32, 4);
    options.one_stage = 1;
    options.candidates = 64;
    CHECK(warning_of(&dark, &dark_eye, &options, 20, &report)[0] != 0,
          "a dark room beside a bright lamp: no warning");
    options = options_make(METRO_MLT, 32, 4);
    options.chains = 4;
    options.start = METRO_START_POINT;
    options.perturbation = 0.05;
    CHECK(warning_of(&s1, &s1.camera, &options, 6, &report)[0] != 0, "four chains at their starts: no warning");
    CHECK(report.rhat > 1.1 || report.ess < 100, "R-hat %g, ESS %g", report.rhat, report.ess);
    options.chains = 2;
    CHECK(warning_of(&s1, &s1.camera, &options, 6, &report)[0] != 0, "two chains: no warning");
    metro_scene_free(&s1);
    metro_scene_free(&hidden);
    metro_scene_free(&dark);
}

/* A sound report with one thing wrong gives the warning that names it. */
static void warnings_one_by_one(void)
{
    static const char *const expected[10] = { "",      "NaN",   "black",          "four chains",
                                              "R-hat", "R-hat", "50 independent", "stayed",
                                              "10 %",  "40 %" };
    metro_scene scene = load_scene("S1");
    metro_render_options options = options_make(METRO_PSSMLT, 16, 3);
    metro_render render;
    metro_render_report good, report;
    int i;
    options.candidates = 64;
    render = render_run(&scene, &scene.camera, &options, 4);
    metro_render_diagnose(&render, &good);
    good.not_finite = good.longest_stay = 0;
    good.mean = 1;
    good.mean_error = 0.01;
    good.rhat = 1.01;
    good.ess = 1000;
    good.worst = 0.1;
    good.warning[0] = 0;
    for (i = 0; i < 10; i++) {
        metro_render changed = render;
        report = good;
        if (i == 1) report.not_finite = 1;
        if (i == 2) report.mean = report.mean_error = 0;
        if (i == 3) changed.options.chains = 3;
        if (i == 4) report.rhat = 1.2;
        if (i == 5) report.rhat = (double)INFINITY;
        if (i == 6) report.ess = 50.5;
        if (i == 7) report.longest_stay = render.samples / 64 / 10;
        if (i == 8) report.mean_error = 0.105;
        if (i == 9) report.worst = 0.405;
        metroi_report_warn(&changed, &report);
        CHECK(expected[i][0] == 0 ? report.warning[0] == 0 : strstr(report.warning, expected[i]) != NULL,
              "case %d: \"%s\" does not name \"%s\"", i, report.warning, expected[i]);
        CHECK(strchr(report.warning, '-') == NULL || strstr(report.warning, "R-hat") != NULL, "case %d: \"%s\"", i,
              report.warning);
    }
    report = good;
    report.mean_error = (double)NAN;
    metroi_report_warn(&render, &report);
    CHECK(report.warning[0] != 0 && strchr(report.warning, '-') == NULL, "no error known: \"%s\"", report.warning);
    metro_render_free(&render);
    metro_scene_free(&scene);
}

/* ---- calibration in the small ---- */

/* Over 40 runs the 95 % intervals of blocks, pooled, hold the truth between 85 and 99.5 % of the time, and those of
   the mean at least 31 times. Catches: an error that forgets b, or that of b, a variance over chains not divided by
   their number. */
static void calibration(const metro_render *truth, const mlt_variant *v, uint64_t rounds)
{
    enum { RUNS = 40, SIZE = 24, BLOCKS = 9 };
    metro_render_report report, known;
    int run, b, inside = 0, mean_inside = 0, b_inside = 0;
    metro_render_diagnose(truth, &known);
    for (run = 0; run < RUNS; run++) {
        metro_render_options options = variant_options(v, SIZE, 3);
        metro_render render;
        options.chains = 32;
        options.candidates = 32;
        options.seed = 500 + (uint64_t)run;
        render = render_run(truth->scene, &truth->scene->camera, &options, rounds);
        metro_render_diagnose(&render, &report);
        for (b = 0; b < BLOCKS; b++) {
            double e, f, value = metro_render_block(&render, (size_t)b % 3, (size_t)b / 3, &e);
            inside += fabs(value - metro_render_block(truth, (size_t)b % 3, (size_t)b / 3, &f)) <=
                      1.96 * sqrt(e * e + f * f);
        }
        mean_inside += fabs(report.mean - known.mean) <= 1.96 * report.mean_error;
        b_inside += fabs(report.b - known.mean) <= 1.96 * report.b_error;
        metro_render_free(&render);
    }
    CHECK(inside >= 0.85 * RUNS * BLOCKS && inside <= 0.995 * RUNS * BLOCKS, "%s: %d of %d intervals hold the truth",
          v->name, inside, RUNS * BLOCKS);
    CHECK(mean_inside >= 31, "%s: %d of %d intervals hold the mean", v->name, mean_inside, RUNS);
    if (v->one_stage || v->method == METRO_MLT)
        CHECK(b_inside >= 31, "%s: %d of %d intervals hold b", v->name, b_inside, RUNS);
}

static void errors_are_calibrated(void)
{
    metro_scene scene = load_scene("S1");
    metro_render truth = bidirectional(&scene, &scene.camera, 24, 3, 300);
    calibration(&truth, &variant[6], 12);
    calibration(&truth, &variant[8], 10);
    calibration(&truth, &variant[1], 10);
    metro_render_free(&truth);
    metro_scene_free(&scene);
}

/* ---- nothing lit, threads ---- */

/* A lamp that turns its back on the scene. */
static void nothing_lit(void)
{
    static const metro_method method[2] = { METRO_MLT, METRO_PSSMLT };
    static const metro_start start[3] = { METRO_START_SEEDS, METRO_START_POINT, METRO_START_WEIGHTED };
    metro_scene scene = empty_scene();
    metro_camera camera = camera_make(metro_vec3_make(0, 0, 3), metro_vec3_make(0, 0, 0), 40);
    uint32_t lamp = add_material(&scene, grey(0), grey(0), 0, grey(1));
    int m, i;
    add_quad(&scene, metro_vec3_make(-1, -1, 0), metro_vec3_make(2, 0, 0), metro_vec3_make(0, 2, 0), 0);
    add_quad(&scene, metro_vec3_make(-1, -1, -1), metro_vec3_make(0, 1, 0), metro_vec3_make(1, 0, 0), lamp);
    build(&scene);
    for (m = 0; m < 2; m++)
        for (i = 0; i < 3; i++) {
            metro_render_options options = options_make(method[m], 16, 3);
            metro_render render;
            metro_image image;
            metro_render_report report;
            metro_result result;
            options.chains = 1;
            options.candidates = 16;
            options.start = start[i];
            render = render_make(&scene, &camera, &options);
            result = metro_render_run(&render, 2, NULL, NULL);
            CHECK(result == METRO_ERROR_NO_IMPORTANCE && render.rounds == 0, "start %d: %s", i,
                  metro_result_text(result));
            CHECK(metro_render_image(&render, &image) == METRO_ERROR_ARGUMENT, "a picture of nothing");
            metro_render_diagnose(&render, &report);
            CHECK(isnan(report.mean), "mean %g", report.mean);
            metro_render_free(&render);
        }
    metro_scene_free(&scene);
}

/* Bit for bit the same on one, two and three threads, and however the rounds are shared out. */
static void threads_and_calls(void)
{
    metro_scene scene = load_scene("S1");
    static const metro_method method[5] = { METRO_PATH, METRO_LIGHT, METRO_BDPT, METRO_MLT, METRO_PSSMLT };
    int m, i;
    for (m = 0; m < 5; m++) {
        metro_image first;
        double block = 0, error = 0, e;
        memset(&first, 0, sizeof first);
        for (i = 0; i < 4; i++) {
            metro_render_options options = options_make(method[m], 40, 4);
            metro_render render;
            metro_image image;
            options.chains = 7;
            options.candidates = 50;
            options.threads = i < 3 ? (size_t)i + 1 : 2;
            render = render_run(&scene, &scene.camera, &options, i < 3 ? 5 : 2);
            if (i == 3) CHECK(metro_render_run(&render, 3, NULL, NULL) == METRO_OK, "run");
            image = render_image(&render);
            if (i == 0) {
                first = image;
                block = metro_render_block(&render, 1, 1, &error);
            } else {
                CHECK(image_same(&first, &image), "method %d: the pictures differ, case %d", (int)method[m], i);
                CHECK(metro_render_block(&render, 1, 1, &e) == block && e == error,
                      "method %d: the blocks differ, case %d", (int)method[m], i);
                metro_image_free(&image);
            }
            metro_render_free(&render);
        }
        metro_image_free(&first);
    }
    metro_scene_free(&scene);
}

int main(void)
{
    CHECK_RUN(importance_by_hand);
    CHECK_RUN(ways_use_their_numbers);
    CHECK_RUN(pilot_picture);
    CHECK_RUN(perturbation_sizes);
    CHECK_RUN(uniform_states);
    CHECK_RUN(chains_agree);
    CHECK_RUN(furnaces);
    CHECK_RUN(start_points);
    CHECK_RUN(start_up_bias);
    CHECK_RUN(dead_chains);
    CHECK_RUN(b_of_dark_starts);
    CHECK_RUN(infinite_states);
    CHECK_RUN(b_is_refined);
    CHECK_RUN(report_by_hand);
    CHECK_RUN(errors_in_common);
    CHECK_RUN(ten_chains);
    CHECK_RUN(warnings);
    CHECK_RUN(warnings_one_by_one);
    CHECK_RUN(errors_are_calibrated);
    CHECK_RUN(nothing_lit);
    CHECK_RUN(threads_and_calls);
    return check_done("mlt");
}
