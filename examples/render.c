/* render.c: makes a picture of a scene of your own, an OBJ file with its MTL:

       render room.obj --size 320x240 --seconds 30 --out room.png

   `render --help` lists the options. A scene needs a lamp: a material with `Ke 10 10 10` in the MTL file. The camera
   stands in the OBJ file, in a line `# camera eye 0 1 4 look 0 1 0 up 0 1 0 fov 40`, or comes from --eye and --look;
   without either the whole scene is framed.

   A run is counted in rounds; a round is on average one sample a pixel. Ray bundles are counted in walks. The same
   options and rounds give the same picture, bit for bit, on any number of threads. So a run of --seconds, or one that
   Ctrl-C ended, says which --rounds or --walks repeats it.

   A picture too large for one machine is made in shares: `render room.obj --part 0/4 --out share0.pfm`, the same with
   1/4, 2/4 and 3/4 elsewhere, and `merge room.pfm share?.pfm`.

   See: the summary at the end. A picture looks finished long before it is right; the errors, R-hat and the warning
   say how far to trust it.

   Exit status: 0, 1 for bad input, 2 for bad usage, 130 when interrupted (the picture so far is written). */

#define _POSIX_C_SOURCE 200809L
#include <signal.h>
#include <time.h>
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

enum { OUTS = 8, PIECE = 64, DEFAULT_ROUNDS = 64, DEFAULT_WALKS = 512 };

/* ---- The options ---- */

enum {
    METHOD, EYE, LOOK, UP, FOV, SIZE, DEPTH, SPP, ROUNDS, SECONDS, PERTURBATION, LARGE, CHAINS, START, WALKS, GRID,
    PATCH, SEED, THREADS, PART, REFERENCE, OUT, CSV, OPTIONS
};
enum { WORD, WHOLE, WHOLE_PAIR, REAL, VECTOR, TEXT };

typedef struct {
    const char *name;
    int kind;
    double least, most;             /* of each number */
    const char *expected, *example; /* in words, for the message about a bad value */
    const char *value, *help;
} option;

/* As metro_method, and then the ways of chapter 14, as metro_walk. */
enum { BUNDLE = METRO_PSSMLT + 1, BUNDLE_QMC, BUNDLE_MLT };
static const char *const method_name[] = { "bdpt",   "path",       "light",      "mlt", "pssmlt",
                                           "bundle", "bundle-qmc", "bundle-mlt", NULL };
static const char *const start_name[] = { "seeds", "point", "weighted", NULL }; /* as metro_start */

static const option options[OPTIONS] = {
    { "--method", WORD, 0, 0, "path, light, bdpt, mlt, pssmlt, bundle, bundle-qmc or bundle-mlt", "bdpt", "NAME",
      "path: from the eye; light: from the lamps; bdpt: from both (default); mlt:\n"
      "Metropolis sampling of directions, the paper's; pssmlt: of random numbers;\n"
      "bundle, bundle-qmc, bundle-mlt: ray bundles along random, evenly spread or\n"
      "Metropolis directions, which show the surfaces as patches" },
    { "--eye", VECTOR, -1e30, 1e30, "three numbers x,y,z without blanks", "0,1,4", "x,y,z", "where the camera is" },
    { "--look", VECTOR, -1e30, 1e30, "three numbers x,y,z without blanks", "0,1,0", "x,y,z", "what it looks at" },
    { "--up", VECTOR, -1e30, 1e30, "three numbers x,y,z without blanks", "0,1,0", "x,y,z",
      "what is up in the picture" },
    { "--fov", REAL, 1e-3, 179.9, "degrees from .001 to 179.9", "40", "DEGREES", "the full vertical field of view" },
    { "--size", WHOLE_PAIR, 1, 65536, "width and height in pixels, each from 1 to 65536", "320x240", "WxH",
      "in pixels; default 128x128, or the size of the reference" },
    { "--depth", WHOLE, 1, METRO_DEPTH_MOST, "a whole number from 1 to 32", "8", "N",
      "the most edges of a path, the one to the eye included; default 8" },
    { "--spp", WHOLE, 1, 1e9, "a whole number from 1 to 1000000000", "64", "N",
      "samples a pixel: another word for --rounds" },
    { "--rounds", WHOLE, 1, 1e9, "a whole number from 1 to 1000000000", "64", "N", "default 64" },
    { "--seconds", REAL, 1e-3, 1e9, "seconds from .001 to 1e9", "10", "S",
      "ends with the round in which this time has passed since loading" },
    { "--perturbation", REAL, 1e-6, 6.2831853071795865,
      "a size above 0, for mlt and bundle-mlt in radians up to 6.28", "0.3", "X",
      "mlt, bundle-mlt: the apex angle of the cone in radians, default .3 and .6;\n"
      "pssmlt: the largest step, as a part of 1, default .02" },
    { "--large", REAL, 0, 1, "a probability from 0 to 1", "0.4", "P",
      "probability of a large step; default .3 for pssmlt, else 0" },
    { "--chains", WHOLE, 1, 4096, "a whole number from 1 to 4096", "64", "N",
      "of mlt and pssmlt, default 64, or bundle-mlt, default 16" },
    { "--start", WORD, 0, 0, "point, seeds or weighted", "seeds", "NAME",
      "of the Metropolis methods; point: the same in each run; seeds: a draw by\n"
      "importance (default); weighted: one with Veach's weight" },
    { "--walks", WHOLE, 1, 1e9, "a whole number from 1 to 1000000000", "1024", "N",
      "of ray bundles, each of depth - 1 directions; default 512" },
    { "--grid", WHOLE, 1, 16384, "a whole number from 1 to 16384", "256", "N",
      "rows of parallel rays in a bundle; default: some for each patch" },
    { "--patch", REAL, 1e-30, 1e30, "a length above 0", "0.1", "SIZE",
      "the longest edge of a patch; default: a tenth of the scene's radius" },
    { "--seed", WHOLE, 0, 18446744073709551615.0, "a whole number below 2^64", "1", "N",
      "another seed, other noise; default 0" },
    { "--threads", WHOLE, 1, 1024, "a whole number from 1 to 1024", "2", "N", "default: one a core" },
    { "--part", WHOLE_PAIR, 0, 1e9, "i/n, a share from 0 to n - 1 and their number", "0/4", "i/n",
      "one of n independent shares for merge; needs --out FILE.pfm" },
    { "--reference", TEXT, 0, 0, "a file", "reference.pfm", "REF.pfm",
      "says how far the picture is from this one; the variance of its noise,\n"
      "if known, stands in REF_var.pfm" },
    { "--out", TEXT, 0, 0, "a file", "room.png", "FILE",
      ".pfm (linear radiance), .ppm or .png; may be given several times;\n"
      "default out/SCENE.pfm and out/SCENE.png" },
    { "--csv", TEXT, 0, 0, "a file", "runs.csv", "FILE", "appends the summary as a row" },
};

/* What the command line says of one option. */
typedef struct {
    int given;
    uint64_t whole[2]; /* of a WORD: its number */
    double real[3];
    const char *text;
} answer;

typedef struct {
    const char *scene;
    answer answers[OPTIONS];
    const char *out[OUTS];
    int outs;
} request;

/* All errors of the command line end here; the first one ends the program. */
static int refuse(const char *what, const char *value, const char *why)
{
    fprintf(stderr, "render: %s%s%s: %s\n", what, value[0] != 0 ? " " : "", value, why);
    return 2;
}

static int read_whole(const char *text, uint64_t *value)
{
    uint64_t sum = 0;
    if (*text == 0) return 0;
    for (; *text != 0; text++) {
        uint64_t digit = (uint64_t)(unsigned char)*text - '0';
        if (digit > 9 || sum > (UINT64_MAX - digit) / 10) return 0;
        sum = 10 * sum + digit;
    }
    *value = sum;
    return 1;
}

/* A C program stays in the C locale until it asks for another, and this one does not: strtod reads a point. */
static int read_real(const char *text, double *value)
{
    char *end;
    if (*text == 0 || text[strspn(text, "+-.0123456789eE")] != 0) return 0;
    *value = strtod(text, &end);
    return *end == 0;
}

/* Cuts `text` at the separators into exactly `count` pieces. */
static int split(const char *text, char separator, char piece[][PIECE], int count)
{
    char stop[2] = { 0, 0 };
    int i;
    stop[0] = separator;
    for (i = 0; i < count; i++) {
        size_t length = strcspn(text, stop);
        int last = i == count - 1;
        if (length >= PIECE || (text[length] == 0) != last) return 0;
        memcpy(piece[i], text, length);
        piece[i][length] = 0;
        text += length + (last ? 0 : 1);
    }
    return 1;
}

static int read_wholes(const option *o, const char *text, char separator, int count, answer *a)
{
    char piece[2][PIECE];
    int i;
    if (!split(text, separator, piece, count)) return 0;
    for (i = 0; i < count; i++) {
        if (!read_whole(piece[i], &a->whole[i])) return 0;
        if ((double)a->whole[i] < o->least || (double)a->whole[i] > o->most) return 0;
    }
    return 1;
}

static int read_reals(const option *o, const char *text, int count, answer *a)
{
    char piece[3][PIECE];
    int i;
    if (!split(text, ',', piece, count)) return 0;
    for (i = 0; i < count; i++) {
        if (!read_real(piece[i], &a->real[i])) return 0;
        if (!(a->real[i] >= o->least && a->real[i] <= o->most)) return 0;
    }
    return 1;
}

static int read_word(const char *text, const char *const *word, uint64_t *number)
{
    for (*number = 0; word[*number] != NULL; ++*number)
        if (strcmp(text, word[*number]) == 0) return 1;
    return 0;
}

/* Reads the value of option number `id`; 0 if it is none. */
static int read_value(int id, const char *text, answer *a)
{
    const option *o = &options[id];
    a->text = text;
    switch (o->kind) {
    case WORD: return read_word(text, id == METHOD ? method_name : start_name, &a->whole[0]);
    case WHOLE: return read_wholes(o, text, ' ', 1, a);
    case WHOLE_PAIR: return read_wholes(o, text, id == SIZE ? 'x' : '/', 2, a);
    case REAL: return read_reals(o, text, 1, a);
    case VECTOR: return read_reals(o, text, 3, a);
    default: return *text != 0;
    }
}

static int ends_in(const char *path, const char *end)
{
    size_t length = strlen(path), tail = strlen(end);
    return length > tail && strcmp(path + length - tail, end) == 0;
}

static int add_out(request *r, const char *path)
{
    if (!ends_in(path, ".pfm") && !ends_in(path, ".ppm") && !ends_in(path, ".png"))
        return refuse("--out", path, "the name must end in .pfm, .ppm or .png, as in --out room.png");
    if (r->outs == OUTS) return refuse("--out", path, "too many pictures; eight are the most");
    r->out[r->outs++] = path;
    return 0;
}

static int read_option(request *r, const char *name, const char *value)
{
    char why[200];
    int id = 0;
    while (id < OPTIONS && strcmp(name, options[id].name) != 0) id++;
    if (id == OPTIONS) return refuse(name, "", "there is no such option; render --help lists them");
    snprintf(why, sizeof why, "expected %s, as in %s %s", options[id].expected, name, options[id].example);
    if (value == NULL || !read_value(id, value, &r->answers[id]))
        return refuse(name, value != NULL ? value : "", why);
    r->answers[id].given = 1;
    return id == OUT ? add_out(r, value) : 0;
}

/* The options must make sense together: nothing that is given is silently ignored. */
static int check_request(const request *r)
{
    const answer *a = r->answers;
    uint64_t method = a[METHOD].whole[0];
    int uses_chains = method == METRO_MLT || method == METRO_PSSMLT || method == BUNDLE_MLT, id, pfm = 0, i;
    if (r->scene == NULL)
        return refuse("no scene", "", "render SCENE.obj makes a picture of it; render --help says more");
    if (a[SPP].given + a[ROUNDS].given + a[SECONDS].given + a[WALKS].given > 1)
        return refuse("--spp, --rounds, --walks, --seconds", "", "give one of them, not more");
    if (method >= BUNDLE && a[SPP].given + a[ROUNDS].given > 0)
        return refuse(a[SPP].given ? "--spp" : "--rounds", "",
                      "ray bundles are counted in walks, as in --walks 1024");
    if (method >= BUNDLE && a[DEPTH].whole[0] == 1)
        return refuse("--depth", "1", "ray bundles need an edge between surfaces, so 2 or more");
    for (id = PERTURBATION; id <= START; id++)
        if (a[id].given && !uses_chains)
            return refuse(options[id].name, a[id].text,
                          "only --method mlt, pssmlt and bundle-mlt have it; leave it out or choose one");
    for (id = WALKS; id <= PATCH; id++)
        if (a[id].given && method < BUNDLE)
            return refuse(options[id].name, a[id].text,
                          "only --method bundle, bundle-qmc and bundle-mlt have it; leave it out or choose one");
    if (method == BUNDLE_MLT && a[CHAINS].given && a[CHAINS].whole[0] < 2)
        return refuse("--chains", a[CHAINS].text, "for bundle-mlt two at least, whose spread gives the error");
    if (a[PERTURBATION].real[0] > 1 && a[METHOD].whole[0] == METRO_PSSMLT)
        return refuse("--perturbation", a[PERTURBATION].text,
                      "for pssmlt it is a part of 1, as in --perturbation 0.03");
    if (a[SIZE].given && a[SIZE].whole[0] * a[SIZE].whole[1] > 0x7fffffff)
        return refuse("--size", a[SIZE].text, "that is more than 2^31 - 1 pixels");
    if (a[PART].given && a[PART].whole[0] >= a[PART].whole[1])
        return refuse("--part", a[PART].text, "the shares of n are 0 to n - 1, as in --part 0/4");
    for (i = 0; i < r->outs; i++) pfm |= ends_in(r->out[i], ".pfm");
    if (a[PART].given && !pfm)
        return refuse("--part", a[PART].text, "each share needs a file of its own, as in --out share0.pfm");
    return 0;
}

/* Prints the help of one option; its further lines begin in the same column. */
static void show_option(const option *o)
{
    const char *at = o->help;
    printf("  %-14s %-8s", o->name, o->value);
    for (;;) {
        int length = (int)strcspn(at, "\n");
        printf(" %.*s\n", length, at);
        if (at[length] == 0) break;
        at += length + 1;
        printf("%25s", "");
    }
}

static int show_help(void)
{
    int id;
    printf("render SCENE.obj [options] makes a picture of the scene.\n\n");
    for (id = 0; id < OPTIONS; id++) show_option(&options[id]);
    printf("\nA round is on average one sample a pixel. A scene needs a lamp: a material with `Ke 10 10 10` in its\n"
           "MTL file. A line `# camera eye 0 1 4 look 0 1 0 up 0 1 0 fov 40` in the OBJ file is the default\n"
           "camera; without it the whole scene is framed. Ctrl-C writes the picture so far.\n");
    return 0;
}

/* Reads the command line. Returns the exit status to end with, or -1 to go on. */
static int read_request(int argc, char **argv, request *r)
{
    int i, status = 0;
    memset(r, 0, sizeof *r);
    for (i = 1; i < argc && status == 0; i++) {
        if (strcmp(argv[i], "--help") == 0 || strcmp(argv[i], "-h") == 0) return show_help();
        if (argv[i][0] == '-') {
            status = read_option(r, argv[i], i + 1 < argc ? argv[i + 1] : NULL);
            i++;
        } else if (r->scene != NULL) status = refuse(argv[i], "", "a second scene; render makes a picture of one");
        else r->scene = argv[i];
    }
    if (status == 0) status = check_request(r);
    return status == 0 ? -1 : status;
}

/* ---- What is read before the run ---- */

/* What a run came to, whatever the method. */
typedef struct {
    uint64_t rounds, samples, rays; /* of bundles: walks for both */
    double perturbation, large_step;
    size_t threads, chains;
    int depth;
} outcome;

typedef struct {
    request asked;
    metro_scene scene;
    metro_camera camera;
    int framed; /* nobody said where the camera is */
    metro_image reference;
    double noise; /* the reference's own relMSE */
    metro_render_options options; /* of bundles: what they have in common */
    char default_out[2][300];
    metro_render render;
    metro_bundles bundles;
    outcome made;
    double started, seconds; /* on the wall */
    metro_image image;
    metro_render_report report; /* of bundles: what they have of it, and NaN */
    metro_image_difference difference;
} work;

static int complain(const char *path, const char *what)
{
    fprintf(stderr, "render: %s%s%s\n", path, path[0] != 0 ? ": " : "", what);
    return 1;
}

/* Prints the loader's warnings, one a line. */
static void warn_lines(const char *message)
{
    while (*message != 0) {
        size_t length = strcspn(message, "\n");
        if (length > 0) fprintf(stderr, "render: warning: %.*s\n", (int)length, message);
        message += length + (message[length] == '\n');
    }
}

static int load_scene(work *w)
{
    static char message[4096];
    metro_result result = metro_scene_load_obj(&w->scene, w->asked.scene, message, sizeof message);
    if (result != METRO_OK)
        return message[0] != 0 ? complain("", message) : complain(w->asked.scene, metro_result_text(result));
    warn_lines(message);
    result = metro_scene_build(&w->scene);
    if (result == METRO_OK && w->scene.light_count == 0) result = METRO_ERROR_NO_LIGHT;
    return result == METRO_OK ? 0 : complain(w->asked.scene, metro_result_text(result));
}

/* The reference, and its own noise if REF_var.pfm beside REF.pfm holds the variance of its luminance. */
static int load_reference(work *w)
{
    const char *path = w->asked.answers[REFERENCE].text;
    const answer *size = &w->asked.answers[SIZE];
    char message[300], variance_path[1024];
    metro_image variance;
    if (path == NULL) return 0;
    if (metro_image_load(path, &w->reference, message, sizeof message) != METRO_OK) return complain("", message);
    if (w->reference.channels != 3) return complain(path, "the reference is grey; it must have three channels");
    if (size->given && (size->whole[0] != w->reference.width || size->whole[1] != w->reference.height))
        return complain(path, "the reference has another size; leave out --size to take it from the reference");
    if (!ends_in(path, ".pfm") || strlen(path) + 5 > sizeof variance_path) return 0;
    snprintf(variance_path, sizeof variance_path, "%.*s_var.pfm", (int)(strlen(path) - 4), path);
    if (metro_image_load(variance_path, &variance, message, sizeof message) != METRO_OK) return 0;
    if (metro_image_noise(&w->reference, &variance, &w->noise) != METRO_OK) w->noise = 0;
    metro_image_free(&variance);
    return 0;
}

static metro_vec3 vector_of(const answer *a) { return metro_vec3_make(a->real[0], a->real[1], a->real[2]); }

/* The camera of the file, or one that frames the scene, with what the command line changes. */
static int choose_camera(work *w)
{
    const answer *a = w->asked.answers;
    double height = (double)w->options.height, width = (double)w->options.width, degree = acos(-1) / 180;
    w->framed = !w->scene.has_camera && !a[EYE].given;
    if (w->scene.has_camera) w->camera = w->scene.camera;
    else if (metro_scene_frame(&w->scene, &w->camera) != METRO_OK)
        return complain(w->asked.scene, "no triangle has finite corners, so there is nothing to see");
    /* A frame fits pictures that are not higher than wide; a higher one needs a larger vertical angle. */
    if (w->framed && height > width)
        w->camera.fov = 2 * atan(tan(w->camera.fov * degree / 2) * height / width) / degree;
    if (a[EYE].given) w->camera.eye = vector_of(&a[EYE]);
    if (a[LOOK].given) w->camera.look = vector_of(&a[LOOK]);
    if (a[UP].given) w->camera.up = vector_of(&a[UP]);
    if (a[FOV].given) w->camera.fov = a[FOV].real[0];
    if (metro_camera_check(&w->camera) == METRO_OK) return 0;
    complain("camera", "it cannot see: --eye and --look must differ, and --up must not point along the view");
    return a[EYE].given || a[LOOK].given || a[UP].given ? 2 : 1;
}

static int is_bundle(const work *w) { return w->asked.answers[METHOD].whole[0] >= BUNDLE; }

static void choose_options(work *w)
{
    const answer *a = w->asked.answers;
    metro_render_options *o = &w->options;
    o->width = a[SIZE].given ? (size_t)a[SIZE].whole[0] : w->reference.width;
    o->height = a[SIZE].given ? (size_t)a[SIZE].whole[1] : w->reference.height;
    if (o->width == 0) o->width = o->height = 128;
    o->depth = (int)a[DEPTH].whole[0];
    o->method = is_bundle(w) ? METRO_BDPT : (metro_method)a[METHOD].whole[0];
    o->seed = a[SEED].whole[0];
    o->part = a[PART].whole[0];
    o->threads = (size_t)a[THREADS].whole[0];
    o->chains = (size_t)a[CHAINS].whole[0];
    o->start = (metro_start)a[START].whole[0];
    o->perturbation = a[PERTURBATION].real[0];
    o->large_step = a[LARGE].given && a[LARGE].real[0] == 0 ? -1 : a[LARGE].real[0];
}

/* ---- What is written after it: looked at before, so that a long run does not end in front of a closed door ---- */

/* The name of the scene without its folder and its .obj. */
static void choose_default_out(work *w)
{
    const char *name = w->asked.scene, *slash = strrchr(name, '/');
    int length, i;
    if (w->asked.outs > 0) return;
    if (slash != NULL) name = slash + 1;
    length = (int)strlen(name);
    if (ends_in(name, ".obj")) length -= 4;
#ifdef _WIN32
    _mkdir("out");
#else
    mkdir("out", 0777);
#endif
    for (i = 0; i < 2; i++) {
        snprintf(w->default_out[i], sizeof w->default_out[i], "out/%.*s%s", length < 255 ? length : 255, name,
                 i == 0 ? ".pfm" : ".png");
        w->asked.out[w->asked.outs++] = w->default_out[i];
    }
}

/* Can `path` be written? Files are written as a sibling that is renamed, devices directly. */
static int check_out(const char *path)
{
    struct stat status;
    int special = stat(path, &status) == 0 && !S_ISREG(status.st_mode), error;
    size_t room = strlen(path) + 8;
    char *sibling = (char *)malloc(room);
    FILE *file;
    if (sibling == NULL) return complain(path, metro_result_text(METRO_ERROR_MEMORY));
    snprintf(sibling, room, "%s%s", path, special ? "" : ".tmp");
    file = fopen(sibling, "ab");
    error = errno;
    if (file != NULL) fclose(file);
    if (file != NULL && !special) remove(sibling);
    free(sibling);
    if (file != NULL) return 0;
    fprintf(stderr, "render: %s cannot be written: %s\n", path, strerror(error));
    return 1;
}

static const char csv_header[] =
    "scene,method,start,width,height,depth,seed,part,parts,rounds,threads,seconds,samples,rays,mean,mean_error,b,"
    "b_error,acceptance,dark,longest_stay,rhat,ess,not_finite,perturbation,large_step,chains,relmse,relative_rmse,"
    "reference_noise,warning";

/* A table that is there already must be one of ours. */
static int check_csv(const char *path)
{
    char line[sizeof csv_header + 2];
    FILE *file;
    int good = 1;
    if (path == NULL) return 0;
    file = fopen(path, "ab");
    if (file == NULL) return complain(path, strerror(errno));
    fclose(file);
    file = fopen(path, "rb");
    if (file != NULL && fgets(line, sizeof line, file) != NULL) {
        line[strcspn(line, "\r\n")] = 0;
        good = strcmp(line, csv_header) == 0;
    }
    if (file != NULL) fclose(file);
    return good ? 0 : complain(path, "holds another table than render writes; name another file");
}

static int check_outs(work *w)
{
    int i, status = 0;
    choose_default_out(w);
    for (i = 0; i < w->asked.outs && status == 0; i++) status = check_out(w->asked.out[i]);
    return status == 0 ? check_csv(w->asked.answers[CSV].text) : status;
}

/* ---- The run ---- */

static volatile sig_atomic_t interrupted;

/* The first signal ends the run after its round, the second one kills. */
static void interrupt(int number)
{
    interrupted = number;
    signal(number, SIG_DFL);
}

static double seconds_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* How much of the run is done, from 0 to 1. */
static double progress(const work *w, uint64_t rounds)
{
    const answer *a = w->asked.answers;
    uint64_t asked = a[SPP].given      ? a[SPP].whole[0]
                     : a[ROUNDS].given ? a[ROUNDS].whole[0]
                     : a[WALKS].given  ? a[WALKS].whole[0]
                     : is_bundle(w)    ? (uint64_t)DEFAULT_WALKS
                                       : (uint64_t)DEFAULT_ROUNDS;
    if (a[SECONDS].given) return (seconds_now() - w->started) / a[SECONDS].real[0];
    return (double)rounds / (double)asked;
}

static int ends_after(const work *w, uint64_t rounds)
{
    double done = progress(w, rounds);
    int ends = done >= 1 || interrupted;
    plot_progress(ends ? 1 : done, interrupted ? "" : "Ctrl-C ends after this round");
    return ends;
}

static int stop_render(const metro_render *render, void *user)
{
    return ends_after((const work *)user, render->rounds);
}

static int stop_bundles(const metro_bundles *bundles, void *user)
{
    return ends_after((const work *)user, bundles->walks);
}

static metro_result run_render(work *w, metro_result *ended)
{
    metro_render *r = &w->render;
    metro_result result = metro_render_make(&w->scene, &w->camera, &w->options, r);
    if (result != METRO_OK) return result;
    *ended = metro_render_run(r, UINT64_MAX, stop_render, w);
    w->seconds = seconds_now() - w->started;
    w->made = (outcome){ r->rounds, r->samples, r->rays, r->options.perturbation, r->options.large_step,
                         r->options.threads, r->options.chains, r->options.depth };
    if (r->rounds == 0) return METRO_OK;
    metro_render_diagnose(r, &w->report);
    return metro_render_image(r, &w->image);
}

static metro_bundles_options bundle_options(const work *w)
{
    const answer *a = w->asked.answers;
    metro_bundles_options o;
    memset(&o, 0, sizeof o);
    o.width = w->options.width;
    o.height = w->options.height;
    o.depth = w->options.depth;
    o.patch = a[PATCH].real[0];
    o.grid = (size_t)a[GRID].whole[0];
    o.walk = (metro_walk)(a[METHOD].whole[0] - BUNDLE);
    o.first_shot = 1;
    o.batches = w->options.chains;
    o.seed = w->options.seed;
    o.part = w->options.part;
    o.threads = w->options.threads;
    o.start = w->options.start;
    o.perturbation = w->options.perturbation;
    o.large_step = w->options.large_step > 0 ? w->options.large_step : 0;
    return o;
}

static void report_bundles(work *w)
{
    metro_bundles_report p;
    metro_render_report *r = &w->report;
    metro_bundles_diagnose(&w->bundles, &p);
    r->mean = p.mean;
    r->mean_error = p.mean_error;
    r->b = p.b;
    r->b_error = p.b_error;
    r->acceptance = p.acceptance;
    r->dark = p.dark;
    r->squared_jump = p.squared_jump;
    r->longest_stay = p.longest_stay;
    r->rhat = r->ess = r->worst = NAN;
}

static metro_result run_bundles(work *w, metro_result *ended)
{
    metro_bundles_options o = bundle_options(w);
    metro_bundles *b = &w->bundles;
    metro_result result = metro_bundles_make(&w->scene, &w->camera, &o, b);
    if (result != METRO_OK) return result;
    *ended = metro_bundles_run(b, UINT64_MAX, stop_bundles, w);
    w->seconds = seconds_now() - w->started;
    w->made = (outcome){ b->walks, b->walks, b->rays, b->options.perturbation, b->options.large_step,
                         b->options.threads, b->options.batches, b->options.depth };
    if (b->walks == 0) return METRO_OK;
    report_bundles(w);
    return metro_bundles_image(b, &w->image);
}

static int run(work *w)
{
    metro_result result, ended = METRO_ERROR_STOPPED;
    signal(SIGINT, interrupt);
    w->started = seconds_now();
    plot_progress(0, w->asked.scene);
    result = is_bundle(w) ? run_bundles(w, &ended) : run_render(w, &ended);
    plot_progress(1, "");
    if (result != METRO_OK) return complain(w->asked.scene, metro_result_text(result));
    return ended == METRO_ERROR_STOPPED ? 0 : complain(w->asked.scene, metro_result_text(ended));
}

/* ---- Pictures, weight and table ---- */

/* FNV-1a (Fowler, Noll and Vo 1991) of a number. */
static void add_key(uint64_t *key, double number)
{
    uint64_t bits;
    int i;
    memcpy(&bits, &number, sizeof bits);
    for (i = 0; i < 64; i += 8) *key = (*key ^ (bits >> i & 255)) * UINT64_C(0x100000001b3);
}

static void add_vector(uint64_t *key, metro_vec3 v)
{
    add_key(key, v.x);
    add_key(key, v.y);
    add_key(key, v.z);
}

/* One number for what was rendered and how, but for the noise: shares with another one do not belong together. */
static uint64_t picture_key(const work *w)
{
    const metro_scene *scene = &w->scene;
    const metro_bundles_options *bundles = &w->bundles.options;
    uint64_t key = UINT64_C(0xcbf29ce484222325);
    size_t i;
    for (i = 0; i < 9 * scene->triangle_count; i++) add_key(&key, (double)scene->corner[i]);
    for (i = 0; i < scene->triangle_count; i++) add_key(&key, scene->material_of[i]);
    for (i = 0; i < scene->material_count; i++) {
        add_vector(&key, scene->material[i].kd);
        add_vector(&key, scene->material[i].ks);
        add_vector(&key, scene->material[i].ke);
        add_key(&key, scene->material[i].ns);
    }
    add_vector(&key, w->camera.eye);
    add_vector(&key, w->camera.look);
    add_vector(&key, w->camera.up);
    add_key(&key, w->camera.fov);
    add_key(&key, (double)w->asked.answers[METHOD].whole[0]);
    add_key(&key, (double)w->image.width);
    add_key(&key, (double)w->image.height);
    add_key(&key, w->made.depth);
    add_key(&key, w->made.perturbation);
    add_key(&key, w->made.large_step);
    add_key(&key, (double)w->made.chains);
    add_key(&key, w->options.start);
    if (!is_bundle(w)) return key;
    add_key(&key, bundles->patch);
    add_key(&key, (double)bundles->grid);
    return key;
}

/* Writes PATH.txt, the weight of a share, which one it is and of what; merge reads it. */
static int save_weight(const work *w, const char *path)
{
    const uint64_t *part = w->asked.answers[PART].whole;
    plot_csv csv = plot_csv_open(path, "weight,seed,part,parts,picture");
    plot_csv_whole(&csv, w->made.samples);
    plot_csv_whole(&csv, w->options.seed);
    plot_csv_whole(&csv, part[0]);
    plot_csv_whole(&csv, part[1]);
    plot_csv_whole(&csv, picture_key(w));
    plot_csv_row(&csv, NULL, 0);
    return plot_csv_close(&csv);
}

/* A share and its weight. The old weight goes first: a kill must not leave a picture beside the weight of another. */
static int save_share(const work *w, const char *path)
{
    size_t room = strlen(path) + 8;
    char *name = (char *)malloc(room);
    metro_result result = METRO_ERROR_MEMORY;
    int status = 1;
    if (name != NULL) {
        snprintf(name, room, "%s.txt", path);
        remove(name);
        result = metro_image_save_pfm(&w->image, path);
    }
    if (result != METRO_OK) complain(path, metro_result_text(result));
    else status = save_weight(w, name);
    free(name);
    return status;
}

static int save_picture(const work *w, const char *path)
{
    const metro_image *image = &w->image;
    metro_result result;
    if (ends_in(path, ".png")) return plot_png_linear(path, image->width, image->height, 3, image->value, 0);
    if (ends_in(path, ".pfm") && w->asked.answers[PART].given) return save_share(w, path);
    result = ends_in(path, ".pfm") ? metro_image_save_pfm(image, path) : metro_image_save_ppm(image, path);
    return result == METRO_OK ? 0 : complain(path, metro_result_text(result));
}

/* Where the render has no such number, NaN stands in the table. */
static void fill_row(const work *w, plot_csv *csv)
{
    const outcome *m = &w->made;
    const metro_render_report *p = &w->report;
    int walks = !isnan(p->acceptance), compared = w->reference.value != NULL;
    plot_csv_text(csv, w->asked.scene);
    plot_csv_text(csv, method_name[w->asked.answers[METHOD].whole[0]]);
    plot_csv_text(csv, walks ? start_name[w->options.start] : "");
    plot_csv_number(csv, (double)w->image.width);
    plot_csv_number(csv, (double)w->image.height);
    plot_csv_number(csv, (double)m->depth);
    plot_csv_whole(csv, w->options.seed);
    plot_csv_number(csv, (double)w->options.part);
    plot_csv_number(csv, w->asked.answers[PART].given ? (double)w->asked.answers[PART].whole[1] : 1);
    plot_csv_number(csv, (double)m->rounds);
    plot_csv_number(csv, (double)m->threads);
    plot_csv_number(csv, w->seconds);
    plot_csv_number(csv, (double)m->samples);
    plot_csv_number(csv, (double)m->rays);
    plot_csv_number(csv, p->mean);
    plot_csv_number(csv, p->mean_error);
    plot_csv_number(csv, p->b);
    plot_csv_number(csv, p->b_error);
    plot_csv_number(csv, p->acceptance);
    plot_csv_number(csv, p->dark);
    plot_csv_number(csv, walks ? (double)p->longest_stay : NAN);
    plot_csv_number(csv, p->rhat);
    plot_csv_number(csv, p->ess);
    plot_csv_number(csv, (double)p->not_finite);
    plot_csv_number(csv, walks ? m->perturbation : NAN);
    plot_csv_number(csv, walks ? m->large_step : NAN);
    plot_csv_number(csv, walks ? (double)m->chains : NAN);
    plot_csv_number(csv, compared ? w->difference.relmse - w->noise : NAN);
    plot_csv_number(csv, compared ? w->difference.relative_rmse : NAN);
    plot_csv_number(csv, compared ? w->noise : NAN);
    plot_csv_text(csv, p->warning);
    plot_csv_row(csv, NULL, 0);
}

/* Appends the row, after the header where the file is empty, in one piece: several runs may share a table. What
   a full disk cuts off is taken back. */
static int save_csv(const work *w, const char *path)
{
    plot_csv csv = plot_csv_open(path, csv_header);
    size_t skip = 0;
    long before;
    int good;
    FILE *file = fopen(path, "ab");
    fill_row(w, &csv);
    good = file != NULL && !csv.text.failed && csv.bad_rows == 0 && fseek(file, 0, SEEK_END) == 0;
    before = good ? ftell(file) : 0;
    if (before > 0) skip = sizeof csv_header;
    good = good && fwrite(csv.text.data + skip, 1, csv.text.size - skip, file) == csv.text.size - skip;
    if (file != NULL) good = fclose(file) == 0 && good;
#ifndef _WIN32
    if (!good && before >= 0 && file != NULL && truncate(path, before) != 0) before = -1;
#endif
    free(csv.text.data);
    return good ? 0 : complain(path, "the row cannot be written");
}

/* ---- The summary ---- */

static void say_camera(const work *w)
{
    const metro_camera *c = &w->camera;
    printf("camera eye %.6g %.6g %.6g look %.6g %.6g %.6g up %.6g %.6g %.6g fov %.6g%s\n", c->eye.x, c->eye.y,
           c->eye.z, c->look.x, c->look.y, c->look.z, c->up.x, c->up.y, c->up.z, c->fov,
           w->framed ? " (chosen to frame the scene)" : "");
}

static void say_run(const work *w)
{
    const outcome *m = &w->made;
    double samples = (double)m->samples, rays = (double)m->rays;
    printf("%s: %lu triangles, %lu of them lamps\n", w->asked.scene, (unsigned long)w->scene.triangle_count,
           (unsigned long)w->scene.light_count);
    say_camera(w);
    printf("%s, %lu x %lu pixels, depth %d, seed %llu: %llu %s in %.2f s on %lu threads\n",
           method_name[w->asked.answers[METHOD].whole[0]], (unsigned long)w->image.width,
           (unsigned long)w->image.height, m->depth, (unsigned long long)w->options.seed,
           (unsigned long long)m->rounds, is_bundle(w) ? "walks" : "rounds", w->seconds, (unsigned long)m->threads);
    if (is_bundle(w))
        printf("%lu patches, %lu x %lu lines in a bundle, %llu bundles (%.3g a second)\n",
               (unsigned long)w->bundles.patches.count, (unsigned long)w->bundles.options.grid,
               (unsigned long)w->bundles.options.grid, (unsigned long long)w->bundles.bundles,
               (double)w->bundles.bundles / w->seconds);
    else
        printf("%.4g million samples (%.3g million a second), %.4g million rays (%.3g million a second)\n",
               1e-6 * samples, 1e-6 * samples / w->seconds, 1e-6 * rays, 1e-6 * rays / w->seconds);
}

/* Does any of 32 x 32 rays from the eye meet the front of a triangle? */
static int sees_a_front(const work *w)
{
    int i;
    for (i = 0; i < 32 * 32; i++) {
        metro_vec3 d = metro_camera_direction(&w->camera, w->image.width, w->image.height,
                                              (i % 32 + 0.5) / 32 * (double)w->image.width,
                                              (i / 32 + 0.5) / 32 * (double)w->image.height);
        metro_hit hit;
        if (metro_scene_hit(&w->scene, w->camera.eye, d, 0, (double)INFINITY, &hit) &&
            metro_dot(metro_scene_normal(&w->scene, hit.triangle), d) < 0)
            return 1;
    }
    return 0;
}

static void say_trust(const work *w)
{
    const metro_render_report *p = &w->report;
    printf("mean luminance %.5g +- %.2g\n", p->mean, isnan(p->mean_error) ? (double)NAN : p->mean_error);
    if (!isnan(p->acceptance)) {
        printf("b %.5g +- %.2g; %.1f %% of the mutations accepted, %.1f %% dark, longest stay %llu mutations\n", p->b,
               p->b_error, 100 * p->acceptance, 100 * p->dark, (unsigned long long)p->longest_stay);
        if (!isnan(p->rhat)) {
            printf("over %lu chains: worst R-hat %.3f", (unsigned long)w->made.chains, p->rhat);
            if (isnan(p->ess)) printf("; too few rounds for an ESS\n");
            else printf(", smallest ESS %.0f\n", p->ess);
        }
    }
    if (w->reference.value != NULL) {
        printf("relMSE %.4g", w->difference.relmse - w->noise);
        if (w->noise > 0) printf(" (%.2g of noise in the reference subtracted)", w->noise);
        printf(", relative RMSE %.4g against %s\n", w->difference.relative_rmse, w->asked.answers[REFERENCE].text);
    }
    if (sees_a_front(w)) {
        if (p->warning[0] != 0) printf("warning: %s\n", p->warning);
    } else if (w->framed)
        printf("warning: the camera stands outside of the scene, where a closed room shows only backs: give --eye\n");
    else
        printf("warning: the camera sees no surface from its front, and backs are black: move --eye into the room, or "
               "turn the corners of the faces round\n");
}

static void say_files(const work *w)
{
    int i;
    printf("wrote");
    for (i = 0; i < w->asked.outs; i++) printf("%s %s", i > 0 ? "," : "", w->asked.out[i]);
    printf("\n");
    if (w->asked.answers[SECONDS].given || interrupted)
        printf("the same picture again: --%s %llu\n", is_bundle(w) ? "walks" : "rounds",
               (unsigned long long)w->made.rounds);
}

/* Writes everything and says what it is worth. */
static int finish(work *w)
{
    int i, status = 0;
    if (w->reference.value != NULL) metro_image_error(&w->image, &w->reference, &w->difference);
    for (i = 0; i < w->asked.outs; i++) status |= save_picture(w, w->asked.out[i]);
    if (w->asked.answers[CSV].given) status |= save_csv(w, w->asked.answers[CSV].text);
    say_run(w);
    say_trust(w);
    if (status == 0) say_files(w);
    if (interrupted)
        fprintf(stderr, "render: interrupted; the picture of %llu %s is %s\n", (unsigned long long)w->made.rounds,
                is_bundle(w) ? "walks" : "rounds", status == 0 ? "written" : "not written");
    return fflush(stdout) == 0 ? status : 1;
}

static int make_picture(work *w)
{
    int status = load_reference(w);
    if (status != 0) return status;
    choose_options(w);
    status = load_scene(w);
    if (status == 0) status = choose_camera(w);
    if (status == 0) status = check_outs(w);
    if (status == 0) status = run(w);
    if (w->image.value != NULL) status |= finish(w);
    return status == 0 && interrupted ? 130 : status;
}

int main(int argc, char **argv)
{
    static work w;
    int status = read_request(argc, argv, &w.asked);
    if (status >= 0) return status;
    signal(SIGINT, SIG_DFL); /* a shell lets its jobs in the background ignore it */
    status = make_picture(&w);
    metro_render_free(&w.render);
    metro_bundles_free(&w.bundles);
    metro_image_free(&w.image);
    metro_image_free(&w.reference);
    metro_scene_free(&w.scene);
    return status;
}
