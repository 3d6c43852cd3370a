/* merge.c: combines the shares that `render --part i/n` made into one picture:

       merge room.pfm share0.pfm share1.pfm share2.pfm share3.pfm

   Each share counts by its weight, the number of its samples, which stands in SHARE.pfm.txt. Shares are independent,
   so their spread says how far the merged picture is off, whatever method made them; one method, of one scene, for
   all. room.pfm.txt says what is in room.pfm, so merged pictures can be merged again: shares of shares, or shares
   that came later.

   --error FILE.pfm also writes the standard error of each pixel. --png FILE.png also writes the picture for the eye.

   See: the standard error of a few shares is itself uncertain, by one part in sqrt(2 (shares - 1)).

   Exit status: 0, 1 for bad input, 2 for bad usage. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

static const char header[] = "weight,seed,part,parts,picture";

/* A row of a weight file: which share, and how much it counts. */
typedef struct {
    uint64_t weight, seed, part, parts;
    uint64_t picture; /* one number for the scene, the camera, the method and its options */
    const char *path; /* of the picture it is in */
} share;

typedef struct {
    share *item;
    size_t count, room;
} share_list;

/* The mean of the pictures so far and the weighted sum of squared deviations from it (West 1979): of all samples, of
   the luminance of all pixels, and of the mean luminance. */
typedef struct {
    metro_image mean, squares, luminance, luminance_squares;
    double brightness, brightness_squares, weight;
    size_t count;
} sums;

static int complain(const char *path, const char *what)
{
    fprintf(stderr, "merge: %s: %s\n", path, what);
    return 1;
}

static int refuse(const char *what, const char *why)
{
    fprintf(stderr, "merge: %s: %s\n", what, why);
    return 2;
}

/* ---- Weights ---- */

/* Reads a whole number and the character behind it. */
static int read_whole(const char **text, char end, uint64_t *value)
{
    const char *at = *text;
    for (*value = 0; *at >= '0' && *at <= '9'; at++) {
        uint64_t digit = (uint64_t)(*at - '0');
        if (*value > (UINT64_MAX - digit) / 10) return 0;
        *value = 10 * *value + digit;
    }
    if (at == *text || *at != end) return 0;
    *text = at + 1;
    return 1;
}

static int read_share(char *line, share *s)
{
    const char *at = line;
    size_t length = strcspn(line, "\r\n");
    line[length] = 0;
    if (!read_whole(&at, ',', &s->weight) || !read_whole(&at, ',', &s->seed) || !read_whole(&at, ',', &s->part))
        return 0;
    if (!read_whole(&at, ',', &s->parts) || !read_whole(&at, 0, &s->picture)) return 0;
    return s->weight > 0;
}

static int add_share(share_list *list, const share *s)
{
    if (list->count == list->room) {
        size_t room = 2 * list->room + 16;
        share *grown = (share *)realloc(list->item, room * sizeof *grown);
        if (grown == NULL) return complain(s->path, metro_result_text(METRO_ERROR_MEMORY));
        list->item = grown;
        list->room = room;
    }
    list->item[list->count++] = *s;
    return 0;
}

static int read_weight_lines(FILE *file, const char *path, const char *name, share_list *list)
{
    char line[200];
    share s;
    if (fgets(line, sizeof line, file) == NULL || strncmp(line, header, sizeof header - 1) != 0)
        return complain(name, "its first line is not weight,seed,part,parts,picture");
    while (fgets(line, sizeof line, file) != NULL) {
        s.path = path;
        if (!read_share(line, &s)) return complain(name, "a row is not five whole numbers with a weight above 0");
        if (add_share(list, &s) != 0) return 1;
    }
    return 0;
}

/* Adds the shares that PATH.txt lists. With `optional` a file that is not there has none. */
static int read_weights(const char *path, share_list *list, int optional)
{
    size_t room = strlen(path) + 8, before = list->count;
    char *name = (char *)malloc(room);
    FILE *file;
    int status;
    if (name == NULL) return complain(path, metro_result_text(METRO_ERROR_MEMORY));
    snprintf(name, room, "%s.txt", path);
    file = fopen(name, "rb");
    if (file == NULL) {
        status = optional ? 0 : complain(name, "no such file; render --part i/n writes it beside the picture");
    } else {
        status = read_weight_lines(file, path, name, list);
        if (status == 0 && list->count == before) status = complain(name, "it lists no share");
        fclose(file);
    }
    free(name);
    return status;
}

static double weight_of(const share_list *list, const char *path)
{
    double sum = 0;
    size_t i;
    for (i = 0; i < list->count; i++)
        if (list->item[i].path == path) sum += (double)list->item[i].weight;
    return sum;
}

static const share *find_share(const share_list *list, size_t count, const share *s)
{
    size_t i;
    for (i = 0; i < count; i++)
        if (list->item[i].seed == s->seed && list->item[i].part == s->part) return &list->item[i];
    return NULL;
}

/* A share that counts twice makes the error too small. */
static int check_twice(const share_list *list)
{
    size_t i;
    for (i = 1; i < list->count; i++) {
        const share *s = &list->item[i], *twin = find_share(list, i, s);
        if (twin == NULL) continue;
        fprintf(stderr, "merge: %s and %s hold the same share, seed %llu, part %llu: leave one out\n", twin->path,
                s->path, (unsigned long long)s->seed, (unsigned long long)s->part);
        return 1;
    }
    return 0;
}

static int check_same(const share_list *list)
{
    size_t i;
    for (i = 1; i < list->count; i++) {
        if (list->item[i].picture == list->item[0].picture) continue;
        fprintf(stderr,
                "merge: %s and %s do not belong together: another scene, camera, method, size, depth or option\n",
                list->item[0].path, list->item[i].path);
        return 1;
    }
    return 0;
}

/* A picture that would be overwritten may hold only shares that go into the new one: so `merge share?.pfm`, where the
   name of the merged picture was forgotten, loses nothing. */
static int check_target(const char *out, const share_list *list)
{
    share_list old = { NULL, 0, 0 };
    size_t i;
    int status = read_weights(out, &old, 1);
    for (i = 0; i < old.count && status == 0; i++)
        if (find_share(list, list->count, &old.item[i]) == NULL)
            status =
                complain(out, "it holds a share that would be lost; name the merged picture first, then its shares");
    free(old.item);
    return status;
}

/* ---- Sums ---- */

/* Takes the value x of weight w into a mean and its sum of squared deviations; `total` includes w. */
static void add_value(double x, double w, double total, double *mean, double *squares)
{
    double before = x - *mean;
    *mean += before * w / total;
    *squares += w * before * (x - *mean);
}

static metro_result make_sums(sums *s, const metro_image *image)
{
    size_t width = image->width, height = image->height;
    metro_result result = metro_image_make(width, height, image->channels, &s->mean);
    if (result == METRO_OK) result = metro_image_make(width, height, image->channels, &s->squares);
    if (result == METRO_OK) result = metro_image_make(width, height, 1, &s->luminance);
    if (result == METRO_OK) result = metro_image_make(width, height, 1, &s->luminance_squares);
    return result;
}

static void free_sums(sums *s)
{
    metro_image_free(&s->mean);
    metro_image_free(&s->squares);
    metro_image_free(&s->luminance);
    metro_image_free(&s->luminance_squares);
}

static void add_image(sums *s, const metro_image *image, double weight)
{
    size_t pixels = image->width * image->height, channels = image->channels, i, c;
    double brightness = 0;
    s->weight += weight;
    s->count++;
    for (i = 0; i < pixels; i++) {
        const double *value = image->value + i * channels;
        double y = channels == 3 ? metro_luminance(value[0], value[1], value[2]) : value[0];
        for (c = i * channels; c < (i + 1) * channels; c++)
            add_value(image->value[c], weight, s->weight, &s->mean.value[c], &s->squares.value[c]);
        add_value(y, weight, s->weight, &s->luminance.value[i], &s->luminance_squares.value[i]);
        brightness += y / (double)pixels;
    }
    add_value(brightness, weight, s->weight, &s->brightness, &s->brightness_squares);
}

static int add_file(sums *s, const char *path, double weight)
{
    char message[300];
    metro_image image;
    int status = 0;
    if (metro_image_load(path, &image, message, sizeof message) != METRO_OK) {
        fprintf(stderr, "merge: %s\n", message);
        return 1;
    }
    if (s->count == 0 && make_sums(s, &image) != METRO_OK)
        status = complain(path, metro_result_text(METRO_ERROR_MEMORY));
    else if (image.width != s->mean.width || image.height != s->mean.height || image.channels != s->mean.channels)
        status = complain(path, "it has another size than the first picture");
    else add_image(s, &image, weight);
    metro_image_free(&image);
    return status;
}

/* From sums of squared deviations to variances of the mean: a picture of weight w has the variance v / w, and v is
   estimated by the sum over shares - 1. NaN for one picture alone. */
static double variance_unit(const sums *s) { return s->count > 1 ? 1 / (s->weight * (double)(s->count - 1)) : NAN; }

static void scale_image(metro_image *image, double factor)
{
    size_t i;
    for (i = 0; i < image->width * image->height * image->channels; i++) image->value[i] *= factor;
}

/* ---- Out ---- */

static int save_pfm(const metro_image *image, const char *path)
{
    metro_result result = metro_image_save_pfm(image, path);
    return result == METRO_OK ? 0 : complain(path, metro_result_text(result));
}

static int save_weights(const char *name, const share_list *list)
{
    plot_csv csv = plot_csv_open(name, header);
    size_t i;
    for (i = 0; i < list->count; i++) {
        const share *s = &list->item[i];
        plot_csv_whole(&csv, s->weight);
        plot_csv_whole(&csv, s->seed);
        plot_csv_whole(&csv, s->part);
        plot_csv_whole(&csv, s->parts);
        plot_csv_whole(&csv, s->picture);
        plot_csv_row(&csv, NULL, 0);
    }
    return plot_csv_close(&csv);
}

/* The picture and its weights. The old weights go first: a kill must not leave a picture beside those of another. */
static int save_merged(const metro_image *image, const char *path, const share_list *list)
{
    size_t room = strlen(path) + 8;
    char *name = (char *)malloc(room);
    int status;
    if (name == NULL) return complain(path, metro_result_text(METRO_ERROR_MEMORY));
    snprintf(name, room, "%s.txt", path);
    remove(name);
    status = save_pfm(image, path);
    if (status == 0) status = save_weights(name, list);
    free(name);
    return status;
}

/* The standard error of each sample; turns the squares into it. */
static int save_error(sums *s, const char *path)
{
    size_t i;
    for (i = 0; i < s->squares.width * s->squares.height * s->squares.channels; i++)
        s->squares.value[i] = sqrt(s->squares.value[i]);
    return save_pfm(&s->squares, path);
}

static void say(sums *s, const share_list *list, const char *out)
{
    double variance = 0, energy = 0, relmse = NAN;
    size_t i;
    for (i = 0; i < s->mean.width * s->mean.height * s->mean.channels; i++) {
        variance += s->squares.value[i];
        energy += s->mean.value[i] * s->mean.value[i];
    }
    metro_image_noise(&s->mean, &s->luminance_squares, &relmse);
    printf("%s: %lu pictures with %lu shares, weight %.0f\n", out, (unsigned long)s->count,
           (unsigned long)list->count, s->weight);
    if (s->count > 1) {
        printf("mean luminance %.6g +- %.2g\n", s->brightness, sqrt(s->brightness_squares * variance_unit(s)));
        printf("by the spread of the pictures: relMSE about %.3g, relative RMSE about %.3g\n", relmse,
               sqrt(variance / energy));
    } else printf("mean luminance %.6g; one picture alone does not say how far it is off\n", s->brightness);
}

/* ---- The command ---- */

typedef struct {
    const char *out, *error, *png;
    char **in; /* the pictures */
    int count;
} request;

static int ends_in(const char *path, const char *end)
{
    size_t length = strlen(path), tail = strlen(end);
    return length > tail && strcmp(path + length - tail, end) == 0;
}

/* Reads the command line; the names of the pictures move to the front of argv. Returns 0, or the exit status. */
static int read_request(int argc, char **argv, request *r)
{
    int i, names = 0;
    for (i = 1; i < argc; i++) {
        const char **target = strcmp(argv[i], "--error") == 0 ? &r->error
                              : strcmp(argv[i], "--png") == 0 ? &r->png
                                                              : NULL;
        if (target != NULL && i + 1 == argc) return refuse(argv[i], "a file name must follow");
        if (target != NULL) *target = argv[++i];
        else if (argv[i][0] == '-') return refuse(argv[i], "there is no such option; merge --help lists them");
        else argv[names++] = argv[i];
    }
    if (names < 2) return refuse("usage", "merge OUT.pfm SHARE.pfm ... [--error FILE.pfm] [--png FILE.png]");
    r->out = argv[0];
    r->in = argv + 1;
    r->count = names - 1;
    for (i = 0; i < names; i++)
        if (!ends_in(argv[i], ".pfm")) return refuse(argv[i], "the name must end in .pfm");
    if (r->error != NULL && !ends_in(r->error, ".pfm")) return refuse(r->error, "the name must end in .pfm");
    if (r->png != NULL && !ends_in(r->png, ".png")) return refuse(r->png, "the name must end in .png");
    for (i = 0; i < r->count; i++)
        if (strcmp(r->out, r->in[i]) == 0) return refuse(r->out, "the merged picture cannot be one of its shares");
    return 0;
}

static int merge(const request *r, share_list *list, sums *s)
{
    int i, status = 0;
    for (i = 0; i < r->count && status == 0; i++) status = read_weights(r->in[i], list, 0);
    if (status == 0) status = check_same(list);
    if (status == 0) status = check_twice(list);
    if (status == 0) status = check_target(r->out, list);
    for (i = 0; i < r->count && status == 0; i++) {
        plot_progress((double)i / r->count, "merge");
        status = add_file(s, r->in[i], weight_of(list, r->in[i]));
    }
    plot_progress(1, "");
    if (status != 0) return status;
    scale_image(&s->squares, variance_unit(s));
    scale_image(&s->luminance_squares, variance_unit(s));
    status = save_merged(&s->mean, r->out, list);
    if (r->png != NULL)
        status |= plot_png_linear(r->png, s->mean.width, s->mean.height, (int)s->mean.channels, s->mean.value, 0);
    if (status == 0) say(s, list, r->out);
    if (r->error != NULL) status |= save_error(s, r->error);
    return status;
}

static int show_help(void)
{
    puts("merge OUT.pfm SHARE.pfm ... [--error FILE.pfm] [--png FILE.png]\n\n"
         "Makes one picture of the shares of `render --part i/n`, each by its number of samples, and says by their\n"
         "spread how far it is off. --error also writes the standard error of each pixel, --png a picture to see.");
    return 0;
}

int main(int argc, char **argv)
{
    request r = { NULL, NULL, NULL, NULL, 0 };
    share_list list = { NULL, 0, 0 };
    sums s;
    int status;
    if (argc == 2 && (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0)) return show_help();
    status = read_request(argc, argv, &r);
    memset(&s, 0, sizeof s);
    if (status == 0) status = merge(&r, &list, &s);
    free_sums(&s);
    free(list.item);
    return status;
}
