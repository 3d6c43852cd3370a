/* test_plot.c - examples/plot.h: the files it writes are read back by readers of their own (a checker of tags, an
   inflate, a reader of PNG), and the C library is made to fail and to speak with a comma where the test says so. */

#include <errno.h>
#include <fcntl.h>
#include <locale.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

/* ---- The C library as the tests want it ---- */

static int comma = 0;            /* numbers are written and read with a comma, as in de_DE */
static long allocations = -1;    /* this many allocations succeed, then all fail; below 0 all succeed */
static int disk_full = 0;        /* fwrite keeps half */
static const char *quick = NULL; /* the environment variable QUICK */

static int test_snprintf(char *text, size_t size, const char *format, ...)
{
    va_list list;
    int length;
    va_start(list, format);
    length = vsnprintf(text, size, format, list);
    va_end(list);
    /* Only conversions of floating point depend on the locale. */
    for (; comma && strstr(format, "g") != NULL && size > 0 && *text != 0; text++)
        if (*text == '.') *text = ',';
    return length;
}

static double test_strtod(const char *text, char **end)
{
    char copy[64];
    char *at;
    snprintf(copy, sizeof copy, "%s", text);
    if ((at = strchr(copy, ',')) != NULL && comma) *at = '.';
    return strtod(copy, end);
}

static int refuses(void)
{
    if (allocations < 0) return 0;
    return allocations-- == 0 ? (allocations = 0, 1) : 0;
}

static void *test_malloc(size_t size) { return refuses() ? NULL : malloc(size); }
static void *test_calloc(size_t count, size_t size) { return refuses() ? NULL : calloc(count, size); }
static void *test_realloc(void *old, size_t size) { return refuses() ? NULL : realloc(old, size); }

static size_t test_fwrite(const void *data, size_t size, size_t count, FILE *file)
{
    if (disk_full) {
        errno = ENOSPC;
        return fwrite(data, size, count / 2, file);
    }
    return fwrite(data, size, count, file);
}

static char *test_getenv(const char *name)
{
    static char text[16];
    if (strcmp(name, "QUICK") != 0 || quick == NULL) return NULL;
    snprintf(text, sizeof text, "%s", quick);
    return text;
}

#include "check.h"
#undef snprintf
#define snprintf test_snprintf
#define strtod test_strtod
#define malloc(size) test_malloc(size)
#define calloc(count, size) test_calloc(count, size)
#define realloc(old, size) test_realloc(old, size)
#define fwrite test_fwrite
#define getenv test_getenv
#include "../examples/plot.h"
#undef snprintf
#undef strtod
#undef malloc
#undef calloc
#undef realloc
#undef fwrite
#undef getenv

/* ---- Files of the tests, in a folder of this process ---- */

static const char *in_folder(const char *name)
{
    static char path[8][128];
    static int next = 0;
    next = (next + 1) % 8;
    snprintf(path[next], sizeof path[next], "build/test_plot.%ld/%s", (long)getpid(), name);
    return path[next];
}

/* The bytes of a file with a zero behind them, to be freed; NULL if there is none. */
static char *read_all(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    char *text = NULL;
    size_t room = 0, got = 1;
    *size = 0;
    while (file != NULL && got > 0) {
        char *grown = (char *)realloc(text, room += 65536);
        if (grown == NULL) break;
        text = grown;
        got = fread(text + *size, 1, room - *size - 1, file);
        *size += got;
        text[*size] = 0;
    }
    if (file != NULL) fclose(file);
    return text;
}

static int exists(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file != NULL) fclose(file);
    return file != NULL;
}

/* The temporary sibling that the tool writes first. */
static int sibling_exists(const char *path)
{
    char name[192];
    snprintf(name, sizeof name, "%s.%ld.tmp", path, (long)getpid());
    return exists(name);
}

/* Runs with stderr in a file, so that messages which the tests provoke do not show; returns the size of that file. */
static int saved_stderr = -1;

static const char *stderr_path(void)
{
    static char path[128];
    snprintf(path, sizeof path, "%s", in_folder("stderr.txt"));
    return path;
}

static void hush(void)
{
    int file = creat(stderr_path(), 0600);
    fflush(stderr);
    if (file < 0) return;
    saved_stderr = dup(2);
    dup2(file, 2);
    close(file);
}

static size_t speak(void)
{
    size_t size;
    fflush(stderr);
    if (saved_stderr < 0) return 0;
    dup2(saved_stderr, 2);
    close(saved_stderr);
    saved_stderr = -1;
    free(read_all(stderr_path(), &size));
    return size;
}

/* ---- A small reader of XML ---- */

static int is_name(char c)
{
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-' || c == ':' ||
           c == '_';
}

/* The end of an entity that starts at `at`, NULL if it is none. */
static const char *entity(const char *at)
{
    const char *end = strchr(at, ';');
    if (end == NULL || end - at > 8) return NULL;
    if (at[1] == '#') return strspn(at + 2, "0123456789") == (size_t)(end - at - 2) ? end + 1 : NULL;
    if (strncmp(at, "&lt;", 4) != 0 && strncmp(at, "&gt;", 4) != 0 && strncmp(at, "&amp;", 5) != 0) return NULL;
    return end + 1;
}

/* What is wrong with the text as XML, NULL if nothing: tags balance, attributes are quoted and differ in name,
   entities are whole, no control characters, one root. */
static const char *xml_fault(const char *at)
{
    char stack[32][32];
    int depth = 0, roots = 0;
    while (*at != 0) {
        if (*at == '&') {
            if ((at = entity(at)) == NULL) return "bad entity";
        } else if (*at != '<') {
            if (((unsigned char)*at < 32 && *at != '\n') || (depth == 0 && *at != '\n')) return "bad character";
            at++;
        } else if (at[1] == '/') {
            size_t length = 0;
            for (at += 2; is_name(at[length]); length++) {}
            if (depth == 0 || strlen(stack[depth - 1]) != length || strncmp(stack[depth - 1], at, length) != 0)
                return "unbalanced tag";
            if (at[length] != '>') return "bad closing tag";
            at += length + 1;
            depth--;
        } else {
            char names[512] = " ";
            size_t length = 0;
            for (at++; is_name(at[length]); length++) {}
            if (length == 0 || length > 31 || depth == 32) return "bad tag";
            if (depth == 0 && roots++ > 0) return "two roots";
            memcpy(stack[depth], at, length);
            stack[depth++][length] = 0;
            for (at += length; *at == ' ';) {
                char name[40];
                for (length = 0, at++; is_name(at[length]); length++) {}
                if (length == 0 || length > 36 || strncmp(at + length, "=\"", 2) != 0) return "bad attribute";
                snprintf(name, sizeof name, " %.*s ", (int)length, at);
                if (strstr(names, name) != NULL) return "attribute twice";
                strcat(names, name + 1);
                for (at += length + 2; *at != '"'; at++)
                    if (*at == 0 || *at == '<') return "bad value";
                at++;
            }
            if (*at == '/') depth--, at++;
            if (*at++ != '>') return "bad end of tag";
        }
    }
    return depth == 0 && roots == 1 ? NULL : "unclosed tag";
}

/* Is there a number that is none (nan, inf) in a tag? Words in texts may contain these letters. */
static int has_no_number(const char *svg)
{
    int inside = 0;
    for (; *svg != 0; svg++) {
        if (*svg == '<') inside = 1;
        if (*svg == '>') inside = 0;
        if (inside && strncmp(svg, "href=", 5) == 0) svg = strchr(svg + 6, '"');
        if (inside && strchr(" \",MLHVhv", *svg) != NULL)
            if (strncmp(svg + 1, "nan", 3) == 0 || strncmp(svg + 1, "inf", 3) == 0 ||
                strncmp(svg + 1, "-nan", 4) == 0 || strncmp(svg + 1, "-inf", 4) == 0)
                return 1;
    }
    return 0;
}

static size_t count_of(const char *text, const char *word)
{
    size_t count = 0;
    for (; (text = strstr(text, word)) != NULL; text++) count++;
    return count;
}

/* Whether every text begins on the paper. */
static int words_are_on_paper(const char *svg)
{
    const char *at = strstr(svg, "viewBox=\"0 0 ");
    double width = at != NULL ? atof(at + 13) : 0, x;
    for (at = svg; (at = strstr(at, "<text ")) != NULL; at++) {
        x = atof(strstr(at, "x=\"") + 3);
        if (!(x >= 0 && x <= width)) return 0;
    }
    return width > 0;
}

/* Saves the chart as `name` and checks the file; returns its text, to be freed. */
static char *save(plot_chart *chart, const char *name)
{
    const char *path = in_folder(name), *fault;
    char *svg;
    size_t size;
    CHECK(plot_save(chart, path) == 0, "%s", name);
    svg = read_all(path, &size);
    if (svg == NULL) {
        CHECK(0, "%s is not there", name);
        return (char *)calloc(1, 1);
    }
    fault = xml_fault(svg);
    CHECK(fault == NULL, "%s: %s", name, fault != NULL ? fault : "");
    CHECK(!has_no_number(svg), "%s holds nan or inf", name);
    CHECK(strstr(svg, "fill=\"#fff\"/>") != NULL, "no white ground");
    /* The values of odd.svg lie beyond every axis, and their words with them */
    if (strcmp(name, "odd.svg") != 0) CHECK(words_are_on_paper(svg), "%s: words beside the paper", name);
    CHECK(!sibling_exists(path), "a temporary file stays");
    return svg;
}

/* ---- Scales ---- */

/* Catches: a power of ten too high or too low, steps such as 2.5, a bound that rounding crosses. */
static void nice_steps(void)
{
    static const double table[][3] = { { 1, 5, 0.2 },   { 1, 10, 0.1 }, { 10, 4, 5 },        { 7, 7, 1 },
                                       { 8, 7, 2 },     { 100, 3, 50 }, { 1e-12, 4, 5e-13 }, { 3e250, 3, 1e250 },
                                       { 0.3, 3, 0.1 }, { 61, 3, 50 } };
    size_t i;
    for (i = 0; i < sizeof table / sizeof table[0]; i++)
        CHECK_NEAR(plot_nice_step(table[i][0], (int)table[i][1]), table[i][2], 1e-12);
    CHECK(plot_nice_step(0, 5) == 0, "a step for nothing");
    CHECK(plot_nice_step((double)NAN, 5) == 0, "a step for NaN");
    CHECK(plot_nice_step(-1, 5) == 0, "a step for a negative span");
}

static void expect_ticks(double min, double max, int is_log, int most, const double *truth, int count)
{
    double tick[PLOT_TICKS];
    int got = plot_ticks(min, max, is_log, most, tick), i;
    CHECK(got == count, "%g .. %g: %d ticks, should be %d", min, max, got, count);
    for (i = 0; i < got && i < count; i++) CHECK_CLOSE(tick[i], truth[i], 1e-9 * fabs(truth[i]) + 1e-15);
}

/* Catches: ticks outside the range, the tick at an end lost to rounding, decades that are thinned unevenly. */
static void ticks_of_axes(void)
{
    static const double tenths[] = { 0, 0.2, 0.4, 0.6, 0.8, 1 }, signs[] = { -1, 0, 1 },
                        decades[] = { 1, 10, 100, 1000 };
    static const double thinned[] = { 1e-12, 1e-9, 1e-6, 1e-3, 1 }, folds[] = { 0.02, 0.05, 0.1, 0.2, 0.5, 1 },
                        near[] = { 2, 3, 4 };
    double tick[PLOT_TICKS];
    expect_ticks(0, 1, 0, 5, tenths, 6);
    expect_ticks(-1.2, 1.3, 0, 3, signs, 3);
    expect_ticks(1, 1000, 1, 8, decades, 4);
    expect_ticks(1e-13, 1, 1, 5, thinned, 5);
    expect_ticks(0.015, 1.2, 1, 8, folds, 6);
    expect_ticks(2, 4, 1, 3, near, 3);
    CHECK(plot_ticks(0, 1, 1, 5, tick) <= PLOT_TICKS, "zero on a logarithmic axis");
    CHECK(plot_ticks((double)NAN, 1, 0, 5, tick) == 0 && plot_ticks((double)NAN, 1, 1, 5, tick) == 0, "ticks of NaN");
    CHECK(plot_ticks(0, 1, 0, 1000, tick) <= PLOT_TICKS, "too many ticks");
    CHECK(plot_ticks(1e-300, 1e300, 1, 1000, tick) <= PLOT_TICKS, "too many decades");
}

static void expect_range(int is_log, double low, double high, double min, double max, double from, double to)
{
    plot_axis axis;
    memset(&axis, 0, sizeof axis);
    axis.log = is_log;
    axis.min = low;
    axis.max = high;
    ploti_range(&axis, min, max, 0);
    CHECK_CLOSE(axis.min, from, 1e-12);
    CHECK_CLOSE(axis.max, to, 1e-12);
}

/* Catches: 0 taken for a limit where it means "from the data" and the reverse, empty ranges, a logarithmic axis from
   0. */
static void ranges_of_axes(void)
{
    double none = (double)NAN;
    expect_range(0, 2, 10, 0, 0, 0, 10);
    expect_range(0, 5, 10, 0, 0, 5, 10);
    expect_range(0, 5, 10, 0, 8, 0, 8);
    expect_range(0, -3, 10, -5, 0, -5, 10);
    expect_range(0, 4, 4, 0, 0, 2, 6);
    expect_range(0, 0, 0, 0, 0, -1, 1);
    expect_range(0, none, none, 0, 0, 0, 1);
    expect_range(1, none, none, 0, 0, 1, 10);
    expect_range(1, 0.01, 7, 0, 0, 0.01, 7);
    expect_range(1, 0.01, 7, 0.1, 100, 0.1, 100);
    expect_range(1, 0.01, 7, -1, none, 0.01, 7);
    expect_range(1, 6, 6, 0, 0, 2, 18);
}

/* Catches: an axis upside down, log10 for one end only, values that leave the paper by 1e300 pixels. */
static void pixels_of_values(void)
{
    plot_axis axis;
    memset(&axis, 0, sizeof axis);
    axis.min = 1, axis.max = 100, axis.from = 500, axis.to = 0;
    CHECK_CLOSE(plot_at(&axis, 100), 0, 1e-9);
    CHECK_CLOSE(plot_at(&axis, 50.5), 250, 1e-9);
    CHECK_CLOSE(plot_at(&axis, -1e300), 20000, 1e-9);
    axis.log = 1;
    CHECK_CLOSE(plot_at(&axis, 10), 250, 1e-9);
    CHECK_CLOSE(plot_at(&axis, 1), 500, 1e-9);
    CHECK(!ploti_usable(&axis, 0) && !ploti_usable(&axis, -1) && !ploti_usable(&axis, (double)NAN), "not positive");
    CHECK(!ploti_usable(&axis, HUGE_VAL) && ploti_usable(&axis, 1e-310), "infinite, tiny");
    CHECK_CLOSE(ploti_on_axis(&axis, -5), 500, 1e-9);
    CHECK_CLOSE(ploti_on_axis(&axis, 1e9), 0, 1e-9);
}

/* Segments against a box, compared with 4000 points walked along each. Catches: an end not cut, a sign in one side.
   */
static void clipping(void)
{
    uint32_t state = 1;
    int trial, i, k;
    ploti_box box = { 10, 20, 60, 90 };
    for (trial = 0; trial < 300; trial++) {
        double s[4], c[4], low = 2, high = -1, at;
        for (k = 0; k < 4; k++) {
            state = state * 1664525u + 1013904223u;
            c[k] = s[k] = (state >> 16) % 120;
        }
        for (i = 0; i <= 4000; i++) {
            double x = s[0] + (s[2] - s[0]) * i / 4000, y = s[1] + (s[3] - s[1]) * i / 4000;
            if (x < box.left || x > box.right || y < box.top || y > box.bottom) continue;
            low = fmin(low, i / 4000.0), high = fmax(high, i / 4000.0);
        }
        if (!ploti_clip(&box, c)) {
            CHECK(high - low < 0.001, "visible segment %d thrown away", trial);
            continue;
        }
        at = fabs(s[2] - s[0]) + fabs(s[3] - s[1]);
        if (low > high) continue;
        CHECK_CLOSE(fabs(c[0] - s[0]) + fabs(c[1] - s[1]), low * at, 0.001 * at + 1e-9);
        CHECK_CLOSE(fabs(c[2] - s[0]) + fabs(c[3] - s[1]), high * at, 0.001 * at + 1e-9);
    }
}

/* ---- Labels ---- */

static double spread_cost(const double *y, const double *moved, size_t count)
{
    double sum = 0;
    size_t i;
    for (i = 0; i < count; i++) sum += (y[i] - moved[i]) * (y[i] - moved[i]);
    return sum;
}

/* Labels apart, in order, within bounds; and no feasible small change is nearer to where they belong. Catches: a gap
   that only the first pass keeps, labels pushed in one direction only, labels past the edge. */
static void labels_apart(void)
{
    static const double y[] = { 10, 11, 12, 50, 52, 90, 90, 90, 97 };
    enum { COUNT = 9 };
    double moved[COUNT], other[COUNT], two[] = { 40, 50 };
    uint32_t state = 7;
    int trial;
    size_t i;
    plot_spread(two, 2, 20, 0, 100, moved);
    CHECK_CLOSE(moved[0], 35, 1e-12);
    CHECK_CLOSE(moved[1], 55, 1e-12);
    plot_spread(y, COUNT, 8, 5, 100, moved);
    CHECK(moved[0] >= 5 - 1e-9 && moved[COUNT - 1] <= 100 + 1e-9, "%g .. %g", moved[0], moved[COUNT - 1]);
    for (i = 1; i < COUNT; i++)
        CHECK(moved[i] - moved[i - 1] >= 8 - 1e-9, "labels %d: %g", (int)i, moved[i] - moved[i - 1]);
    for (trial = 0; trial < 2000; trial++) {
        int feasible = 1;
        for (i = 0; i < COUNT; i++) {
            state = state * 1664525u + 1013904223u;
            other[i] = moved[i] + ((double)(state >> 8) / 16777216.0 - 0.5) * (trial % 2 ? 4 : 0.4);
            feasible &= other[i] >= 5 && other[i] <= 100 && (i == 0 || other[i] - other[i - 1] >= 8);
        }
        if (feasible)
            CHECK(spread_cost(y, other, COUNT) >= spread_cost(y, moved, COUNT) - 1e-9, "trial %d is nearer", trial);
    }
    plot_spread(y, COUNT, 50, 0, 100, moved);
    for (i = 1; i < COUNT; i++) CHECK_CLOSE(moved[i] - moved[i - 1], 12.5, 1e-9);
    plot_spread(y, 0, 8, 0, 100, moved);
}

/* Where the k-th text with these words begins and how wide it may be. */
static int find_label(const char *svg, const char *words, double *x, double *y)
{
    const char *at = strstr(svg, words);
    if (at == NULL) return 0;
    while (strncmp(at, "<text ", 6) != 0) at--;
    *x = atof(strstr(at, "x=\"") + 3);
    *y = atof(strstr(at, "y=\"") + 3);
    return 1;
}

/* Twelve lines that end in one point at the right, and six that end in one point inside: no two names overlap.
   Catches: labels that are not entered as taken, an anchor for the text other than the measured one. */
static void labels_in_a_chart(void)
{
    plot_chart chart = plot_chart_make("Labels", NULL);
    double x[2] = { 0, 1 }, y[2] = { 0, 1 }, at[18][2];
    char name[32], *svg;
    int i, k;
    chart.panel[0].x_max = 1;
    for (i = 0; i < 18; i++) {
        y[0] = 0.1 * i;
        x[1] = i < 12 ? 1 : 0.5;
        snprintf(name, sizeof name, "line%02d", i);
        plot_line(&chart.panel[0], x, y, 2, name);
    }
    svg = save(&chart, "labels.svg");
    for (i = 0; i < 18; i++) {
        snprintf(name, sizeof name, ">line%02d<", i);
        CHECK(find_label(svg, name, &at[i][0], &at[i][1]), "%s is missing", name);
        for (k = 0; k < i; k++)
            CHECK(fabs(at[i][1] - at[k][1]) > 15 || fabs(at[i][0] - at[k][0]) > 45, "labels %d and %d overlap", i, k);
        CHECK(i < 12 ? at[i][0] > 800 : at[i][0] < 800, "label %d is at %g", i, at[i][0]);
    }
    free(svg);
}

/* ---- Text ---- */

static const char *written(const char *text, int markup)
{
    static char result[512];
    plot_buffer out = { NULL, 0, 0, 0 };
    double width = ploti_write(&out, text, strlen(text), 10, markup);
    CHECK_CLOSE(ploti_write(NULL, text, strlen(text), 10, markup), width, 1e-12);
    ploti_put_bytes(&out, "", 1);
    snprintf(result, sizeof result, "%s", out.data);
    ploti_drop(&out);
    return result;
}

#define EXPECT_TEXT(text, markup, truth)                                                                             \
    CHECK(strcmp(written(text, markup), truth) == 0, "%s gives %s", text, written(text, markup))

/* Catches: markup let through, words taken for Greek outside mathematics, a shift that is not taken back. */
static void text_and_mathematics(void)
{
    EXPECT_TEXT("a < b & c > d", 1, "a &lt; b &amp; c &gt; d");
    EXPECT_TEXT("Delta pi", 1, "Delta pi");
    EXPECT_TEXT("$Delta$ = 1", 1, "&#916; = 1");
    EXPECT_TEXT("$2 pi <= inf$", 0, "2 &#960; &#8804; &#8734;");
    EXPECT_TEXT("$-1 -> +-sqrt{2}$", 0, "&#8722;1 &#8594; &#177;&#8730;2");
    EXPECT_TEXT("$alpha omega Alpha Omega sigma$", 0, "&#945; &#969; &#913; &#937; &#963;");
    EXPECT_TEXT("$max x$", 1, "max <tspan dy=\"0\" font-size=\"10\" font-style=\"italic\">x</tspan>");
    EXPECT_TEXT("$E_n$ b", 1,
                "<tspan dy=\"0\" font-size=\"10\" font-style=\"italic\">E</tspan><tspan dy=\"2.2\" font-size=\"7.6\" "
                "font-style=\"italic\">n</tspan><tspan dy=\"-2.2\" font-size=\"10\"> b</tspan>");
    EXPECT_TEXT("$10^{-3}$", 1, "10<tspan dy=\"-3.8\" font-size=\"7.6\">&#8722;3</tspan>");
    EXPECT_TEXT("\xc3\xa9\xe2\x82\xac", 1, "\xc3\xa9\xe2\x82\xac");
    EXPECT_TEXT("a\xff\xc3 \x01\x7f", 1, "a?? ??");
    EXPECT_TEXT("$x_", 0, "x");
    EXPECT_TEXT("", 1, "");
}

/* A tick is named as a reader would: plain while short, then by powers of ten. Catches: 0.1 + 0.2 in full, -0, 1e+06.
   */
static void words_at_ticks(void)
{
    static const double value[][2] = {
        { 0.30000000000000004, 1 }, { -2, 2 }, { 0, 1 }, { 2e6, 3e6 }, { 1e6, 3e6 }, { 1500, 2000 }
    };
    static const char *const truth[] = { "$0.3$", "$-2$", "$0$", "$2 times 10^{6}$", "$10^{6}$", "$1500$" };
    plot_axis axis;
    char text[64];
    size_t i;
    memset(&axis, 0, sizeof axis);
    axis.ticks = 2;
    for (i = 0; i < 6; i++) {
        axis.tick[0] = value[i][0], axis.tick[1] = value[i][1];
        CHECK(strcmp(ploti_tick_text(&axis, 0, text), truth[i]) == 0, "%s, should be %s", text, truth[i]);
    }
    axis.log = 1;
    axis.tick[0] = 1e-7, axis.tick[1] = 1;
    CHECK(strcmp(ploti_tick_text(&axis, 0, text), "$10^{-7}$") == 0, "%s", text);
    CHECK(strcmp(ploti_tick_text(&axis, 1, text), "$10^{0}$") == 0, "%s", text);
    axis.tick[0] = 0.001;
    CHECK(strcmp(ploti_tick_text(&axis, 0, text), "$0.001$") == 0, "%s", text);
}

/* WCAG's luminance, with sRGB's curve. */
static double luminance(uint32_t color)
{
    double sum = 0, weight[3] = { 0.2126, 0.7152, 0.0722 };
    int k;
    for (k = 0; k < 3; k++) {
        double v = (double)(color >> (16 - 8 * k) & 255) / 255;
        sum += weight[k] * (v <= 0.04045 ? v / 12.92 : pow((v + 0.055) / 1.055, 2.4));
    }
    return sum;
}

/* Text in the color of its line has a contrast of 4.5 on white, and the ordered colors grow lighter. Catches:
   channels swapped, an interpolation past the last stop. */
static void colors_can_be_read(void)
{
    size_t i, k;
    for (i = 0; i < 8; i++) {
        CHECK(1.05 / (luminance(ploti_text_color(plot_palette(i))) + 0.05) >= 4.4, "color %d", (int)i);
        for (k = 0; k < i; k++) CHECK(plot_palette(i) != plot_palette(k), "colors %d, %d", (int)i, (int)k);
    }
    for (i = 1; i < 12; i++)
        CHECK(luminance(plot_shade(i, 12)) > luminance(plot_shade(i - 1, 12)),
              "shade %d is darker than the one before", (int)i);
    CHECK(plot_shade(0, 12) == 0x0d0887 && plot_shade(11, 12) == 0xfaa01e, "the ends");
    CHECK(plot_shade(0, 1) == 0x0d0887 && plot_shade(9, 2) == 0xfaa01e && plot_shade(0, 0) == 0x0d0887, "odd counts");
    CHECK(ploti_text_color(0x000000) == 0, "black");
}

/* ---- Charts ---- */

/* The reader of XML itself: it has to find faults. */
static void faults_are_found(void)
{
    CHECK(xml_fault("<a b=\"1\"><c/></a>\n") == NULL, "a good text");
    CHECK(xml_fault("<a><b></a></b>") != NULL && xml_fault("<a>") != NULL && xml_fault("</a>") != NULL, "balance");
    CHECK(xml_fault("<a b=1></a>") != NULL && xml_fault("<a b=\"1\" b=\"2\"/>") != NULL, "attributes");
    CHECK(xml_fault("<a>&x</a>") != NULL && xml_fault("<a>\x01</a>") != NULL && xml_fault("<a/><a/>") != NULL,
          "texts");
    CHECK(has_no_number("<p d=\"M1 nan\"/>") && has_no_number("<p x=\"-inf\"/>") &&
              !has_no_number("<p x=\"1\">inf</p>"),
          "nan");
}

static plot_chart full_chart(void)
{
    static const char *const names[] = { "a <point>", "8 seeds & more" };
    double x[] = { 1, 2, 4, 8 }, y[] = { 3, 2, 0.5, 0.1 }, error[] = { 0.1, 0.1, 0.7, 0.01 },
           edge[] = { 0, 1, 2, 3, 4 };
    double low[] = { 2.5, 1.5, 0.1, 0.05 }, high[] = { 3.5, 2.5, 1, 0.2 };
    unsigned char pixel[2 * 3 * 3] = {
        0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120, 130, 140, 150, 160, 170
    };
    plot_chart chart = plot_chart_make("Everything: $E_n$ < 1 & more",
                                       "A note that is long enough to be broken into two lines "
                                       "on a paper of this width, as notes in charts often are, with $a_1 + b$.");
    plot_panel *panel = chart.panel;
    chart.rows = 2;
    chart.columns = 3;
    panel[0].x_log = panel[0].y_log = 1;
    panel[0].title = "lines & points";
    panel[0].x_label = "$n$";
    panel[0].y_label = "error \"E\"";
    panel[0].better = "down and left is better";
    plot_line(&panel[0], x, y, 4, plot_say(panel, "$Delta$ = %", 0.1))->dash = 3;
    plot_points(&panel[0], x, y, error, 4, "measured")->marker = 2;
    plot_rule_x(&panel[0], 3, "here");
    plot_rule_y(&panel[0], 1, "one");
    plot_note(&panel[0], 2, 2, "a note");
    plot_band(&panel[1], x, low, high, 4, "a band");
    plot_steps(&panel[1], edge, y, 4, "steps");
    plot_histogram(&panel[1], y, 4, 0, 4, 4, "histogram");
    plot_bars(&panel[2], names, y, error, 2, "bias");
    plot_bars(&panel[2], names, y, NULL, 2, "variance");
    panel[3].stacked = 1;
    plot_bars(&panel[3], names, y, NULL, 2, "bias");
    plot_bars(&panel[3], names, y, error, 2, "variance");
    plot_picture(&panel[4], 2, 3, 3, pixel);
    panel[4].x_label = "a picture";
    return chart;
}

/* Catches: attributes that are not quoted, texts that are not escaped, ids that two files share. */
static void charts_are_well_formed(void)
{
    plot_chart chart = full_chart();
    char *svg = save(&chart, "full.chart-1.svg"), *at = svg;
    CHECK(strstr(svg, "<title id=\"plot-full-title\">Everything: E_n") == NULL, "mathematics in the title");
    CHECK(strstr(svg, "<title id=\"plot-full-title\">Everything: En &lt; 1 &amp; more</title>") != NULL, "title");
    CHECK(strstr(svg, "<desc id=\"plot-full-desc\">A note that") != NULL, "desc");
    while ((at = strstr(at, "id=\"")) != NULL) CHECK(strncmp(at += 4, "plot-full-", 10) == 0, "id %.20s", at);
    CHECK(count_of(svg, ">bias</text>") == 1 && count_of(svg, ">variance</text>") == 1, "equal labels in the key");
    CHECK(count_of(svg, "href=\"data:image/png;base64,iVBORw0KGgo") == 1, "the picture");
    CHECK(count_of(svg, "NaN") == 0, "NaN");
    free(svg);
    CHECK(chart.title == NULL && chart.panel[0].first == NULL, "the chart is not released");
    free(save(&chart, "empty.svg"));
}

/* The path of the only line of a chart of 1000 x 600. */
static char *line_path(const double *x, const double *y, size_t count, int is_log)
{
    static char path[400];
    plot_chart chart = plot_chart_make("Line", NULL);
    char *svg, *at;
    chart.panel[0].x_log = chart.panel[0].y_log = is_log;
    plot_line(&chart.panel[0], x, y, count, NULL)->color = 0x123456;
    svg = save(&chart, "line.svg");
    at = strstr(svg, "stroke=\"#123456\"");
    at = at != NULL ? strstr(at, " d=\"") : NULL;
    snprintf(path, sizeof path, "%.*s", at != NULL ? (int)strcspn(at + 4, "\"") : 0, at != NULL ? at + 4 : "");
    free(svg);
    return path;
}

/* Catches: a line drawn across a value that is missing, a zero on a logarithmic axis at the bottom or at infinity. */
static void lines_break(void)
{
    double x[] = { 1, 2, 3, 4, 5 }, y[] = { 1, 2, (double)NAN, 2, 1 }, inf[] = { 1, 2, HUGE_VAL, 2, 1 },
           zero[] = { 1, 2, 0, 2, 1 };
    double lonely[] = { (double)NAN, 2, -HUGE_VAL, 2, 1e307 }, none[] = { (double)NAN, (double)NAN },
           huge[] = { -1e300, 1e300 };
    CHECK(count_of(line_path(x, y, 5, 0), "M") == 2, "%s", line_path(x, y, 5, 0));
    CHECK(count_of(line_path(x, inf, 5, 0), "M") == 2, "%s", line_path(x, inf, 5, 0));
    CHECK(count_of(line_path(x, zero, 5, 0), "M") == 1, "%s", line_path(x, zero, 5, 0));
    CHECK(count_of(line_path(x, zero, 5, 1), "M") == 2, "%s", line_path(x, zero, 5, 1));
    CHECK(count_of(line_path(x, lonely, 5, 0), "M") == 2, "lonely points are dots: %s", line_path(x, lonely, 5, 0));
    CHECK(count_of(line_path(x, none, 2, 1), "M") == 0, "%s", line_path(x, none, 2, 1));
    CHECK(count_of(line_path(x, huge, 2, 0), "M") == 1, "%s", line_path(x, huge, 2, 0));
    CHECK(count_of(line_path(x, y, 0, 0), "M") == 0, "no points");
}

/* NaN, infinities, zeros and huge values in every kind of series. Catches: one kind that forgets to look. */
static void odd_values(void)
{
    static const char *const names[] = { "a", "b", "c", "d", "e", "f", "g" };
    double odd[] = { (double)NAN, HUGE_VAL, -HUGE_VAL, 0, -1e308, 1e-320, 5 }, edge[] = { 0, 1, 2, 3, 4, 5, 6, 7 };
    int is_log;
    for (is_log = 0; is_log < 2; is_log++) {
        plot_chart chart = plot_chart_make("Odd", NULL);
        size_t k;
        chart.columns = 3;
        for (k = 0; k < 3; k++) chart.panel[k].x_log = chart.panel[k].y_log = is_log;
        plot_line(&chart.panel[0], odd, edge, 7, "line");
        plot_points(&chart.panel[0], edge, odd, odd, 7, "points");
        plot_points(&chart.panel[0], edge, edge, odd, 7, "points");
        plot_rule_x(&chart.panel[0], (double)NAN, "rule");
        plot_rule_y(&chart.panel[0], HUGE_VAL, "rule");
        plot_note(&chart.panel[0], 1, (double)NAN, "note");
        plot_band(&chart.panel[1], edge, odd, edge, 7, "band");
        plot_steps(&chart.panel[1], edge, odd, 7, "steps");
        plot_steps(&chart.panel[1], odd, edge, 6, "steps");
        plot_histogram(&chart.panel[1], odd, 7, 0, 1, 0, "no bins");
        plot_histogram(&chart.panel[1], odd, 7, (double)NAN, 1, 3, "no range");
        plot_bars(&chart.panel[2], names, odd, odd, 7, "bars");
        chart.panel[0].x_min = (double)NAN;
        chart.panel[1].y_max = HUGE_VAL;
        free(save(&chart, "odd.svg"));
    }
}

/* Three values in four bins of width .5 on [0, 2): the density over all four values. Catches: bars of counts, a total
   without the values outside. */
static void histogram_is_a_density(void)
{
    plot_chart chart = plot_chart_make(NULL, NULL);
    double value[] = { 0.1, 0.2, 1.9, 7 };
    plot_series *series = plot_histogram(&chart.panel[0], value, 4, 0, 2, 4, NULL);
    CHECK(series->count == 8, "%d corners", (int)series->count);
    CHECK_NEAR(series->y[0], 1.0, 1e-12);
    CHECK(series->y[2] == 0, "%g", series->y[2]);
    CHECK_NEAR(series->y[7], 0.5, 1e-12);
    CHECK_NEAR(series->x[7], 2.0, 1e-12);
    plot_free(&chart);
}

/* A band is drawn in two pieces around a value that is missing. Catches: NaN drawn at the bottom. */
static void bands_break(void)
{
    double x[] = { 1, 2, 3, 4, 5 }, low[] = { 1, 1, (double)NAN, 1, 1 }, high[] = { 2, 2, 2, 2, 2 };
    plot_chart chart = plot_chart_make("Band", NULL);
    char *svg;
    plot_band(&chart.panel[0], x, low, high, 5, NULL);
    svg = save(&chart, "band.svg");
    CHECK(count_of(svg, "fill-opacity=\".3\" d=\"M") == 2, "%d pieces",
          (int)count_of(svg, "fill-opacity=\".3\" d=\"M"));
    free(svg);
}

/* Shared axes: one range for all, words only at the left column and the lowest row. Catches: ranges of one panel's
   own. */
static void axes_are_shared(void)
{
    plot_chart chart = plot_chart_make("Shared", NULL);
    double near[] = { 0, 1 }, x[] = { 0, 40 }, y[] = { 0, 3000 };
    char *svg;
    size_t k;
    chart.rows = chart.columns = 2;
    chart.share_x = chart.share_y = 1;
    for (k = 0; k < 3; k++) {
        plot_line(&chart.panel[k], k == 0 ? x : near, k == 0 ? y : near, 2, NULL);
        chart.panel[k].x_label = "below", chart.panel[k].y_label = "beside";
    }
    svg = save(&chart, "shared.svg");
    CHECK(count_of(svg, ">below</text>") == 2, "%d x labels", (int)count_of(svg, ">below</text>"));
    CHECK(count_of(svg, ">beside</text>") == 2, "%d y labels", (int)count_of(svg, ">beside</text>"));
    CHECK(count_of(svg, ">40</text>") == 2, "%d times 40", (int)count_of(svg, ">40</text>"));
    CHECK(count_of(svg, ">3000</text>") == 2, "%d times 3000", (int)count_of(svg, ">3000</text>"));
    free(svg);
}

/* ---- Files ---- */

/* Catches: numbers cut to six digits, a row shorter than the header written all the same. */
static void tables(void)
{
    const char *path = in_folder("deep/er/table.csv");
    static const double value[] = { 0.1, 1.0 / 3, 1e-300, 123456789012345678.0, -2.5 };
    plot_csv csv = plot_csv_open(path, "name,a,b,c,d,e");
    char *text, *at;
    size_t size, i;
    plot_csv_text(&csv, "one, \"two\"");
    plot_csv_row(&csv, value, 5);
    plot_csv_text(&csv, "odd");
    PLOT_CSV_ROW(&csv, (double)NAN, HUGE_VAL, -HUGE_VAL, 0.0, 5e-324);
    CHECK(plot_csv_close(&csv) == 0, "close");
    text = read_all(path, &size);
    CHECK(text != NULL && strncmp(text, "name,a,b,c,d,e\none   two ,", 26) == 0, "%s",
          text != NULL ? text : "no file");
    at = text != NULL ? strstr(text, "two ,") + 4 : NULL;
    for (i = 0; at != NULL && i < 5; i++) {
        CHECK(strtod(at + 1, &at) == value[i], "value %d", (int)i);
        CHECK(*at == (i < 4 ? ',' : '\n'), "after value %d", (int)i);
    }
    CHECK(text != NULL && strstr(text, "\n0.1,") == NULL && strstr(text, ",0.1,") != NULL, "the shortest digits");
    CHECK(text != NULL && strstr(text, "odd,nan,inf,-inf,0,4.94065645841247e-324\n") != NULL, "%s",
          text != NULL ? text : "no file");
    free(text);
    path = in_folder("short.csv");
    csv = plot_csv_open(path, "a,b");
    plot_csv_row(&csv, value, 1);
    hush();
    CHECK(plot_csv_close(&csv) == 1, "a short row passes");
    CHECK(speak() > 0, "no message");
    CHECK(!exists(path), "a short row is written");
}

/* With a comma in the C library's numbers the files are the same, byte for byte. Catches: any %g or %f on the way. */
static void locale_is_ignored(void)
{
    static const char *const locales[] = { "de_DE.UTF-8", "de_DE.utf8", "de_DE", "fr_FR.UTF-8" };
    double value[] = { 0.25, 1e-7, 1234.5 };
    size_t i, size[3];
    char *text[3], *table[3];
    int run;
    for (run = 0; run < 3; run++) {
        plot_chart chart = full_chart();
        plot_csv csv = plot_csv_open(in_folder("comma.csv"), "a,b,c");
        comma = run == 1;
        for (i = 0; run == 2 && i < 4 && setlocale(LC_ALL, locales[i]) == NULL; i++) {}
        plot_say(&chart.panel[0], "%", 0.5);
        chart.panel[0].title = plot_say(&chart.panel[0], "% of one", 0.5);
        plot_csv_row(&csv, value, 3);
        CHECK(plot_csv_close(&csv) == 0 && plot_save(&chart, in_folder("comma.svg")) == 0, "run %d", run);
        comma = 0;
        setlocale(LC_ALL, "C");
        text[run] = read_all(in_folder("comma.svg"), &size[run]);
        table[run] = read_all(in_folder("comma.csv"), &i);
        CHECK(size[run] == size[0] && memcmp(text[run], text[0], size[0]) == 0, "chart of run %d differs", run);
        CHECK(strcmp(table[run], table[0]) == 0, "table of run %d: %s", run, table[run]);
    }
    CHECK(strstr(text[0], ">0.5 of one<") != NULL, "the title");
    for (run = 0; run < 3; run++) free(text[run]), free(table[run]);
}

static int write_one(int what, const char *path)
{
    static const unsigned char pixel[3] = { 1, 2, 3 };
    double value = 1;
    plot_chart chart;
    plot_csv csv;
    if (what == 0) {
        chart = full_chart();
        return plot_save(&chart, path);
    }
    if (what == 1) return plot_png(path, 1, 1, 3, pixel);
    csv = plot_csv_open(path, "a");
    plot_csv_row(&csv, &value, 1);
    return plot_csv_close(&csv);
}

/* A full disk, a file where a folder should be, a folder where the file should be. Catches: half a file under its
   name, a temporary file that stays, an old file lost, success reported. */
static void failures_leave_nothing(void)
{
    int what;
    FILE *file;
    for (what = 0; what < 3; what++) {
        char path[128];
        char *text;
        size_t size;
        snprintf(path, sizeof path, "%s", in_folder("victim"));
        remove(path);
        hush();
        disk_full = 1;
        CHECK(write_one(what, path) == 1, "success on a full disk");
        CHECK(speak() > 0, "no message");
        CHECK(!exists(path) && !sibling_exists(path), "half a file");
        file = fopen(path, "wb");
        if (file != NULL) fputs("old", file), fclose(file);
        hush();
        CHECK(write_one(what, path) == 1, "success on a full disk");
        disk_full = 0;
        CHECK(write_one(what, in_folder("victim/file")) == 1, "a file as a folder");
        CHECK(write_one(what, in_folder("")) == 1 && !sibling_exists(in_folder("")), "a folder as a file");
        CHECK(write_one(what, "") == 1, "no name");
        speak();
        text = read_all(path, &size);
        CHECK(text != NULL && strcmp(text, "old") == 0, "the old file is lost");
        free(text);
    }
}

/* The k-th allocation fails, for all k: no crash, no file, a message; and in the end it works. Catches: a pointer
   used before it is looked at (and, under a sanitizer, memory that leaks). */
static void memory_may_fail(void)
{
    char path[128];
    int what, status;
    long k;
    snprintf(path, sizeof path, "%s", in_folder("memory.svg"));
    for (what = 0; what < 3; what++) {
        remove(path);
        for (k = 0, status = 1; status != 0 && k < 3000; k++) {
            hush();
            allocations = k;
            status = write_one(what, path);
            allocations = -1;
            CHECK(speak() > 0 || status == 0, "no message");
            CHECK(status == 0 || !exists(path), "a file without memory");
        }
        CHECK(status == 0 && k > 2, "never works: %ld", k);
    }
}

/* Catches: QUICK=0 taken for yes; a bar that fills a log file. */
static void the_run(void)
{
    static const char *const text[] = { "1", "yes", "0", "" };
    int i;
    CHECK(plot_quick() == 0, "unset");
    for (i = 0; i < 4; i++) {
        quick = text[i];
        CHECK((plot_quick() != 0) == (i < 2), "QUICK=%s", text[i]);
    }
    quick = NULL;
    hush();
    for (i = 0; i <= 100; i++) plot_progress(i / 100.0, "test");
    plot_progress((double)NAN, "test");
    CHECK(speak() == 0, "a bar in a pipe");
    CHECK(plot_seconds() > 1e9 && plot_seconds() <= plot_seconds(), "the clock");
}

/* ---- Pictures ---- */

/* Bits of a deflate stream, the lowest first; zeros after its end. */
typedef struct {
    const unsigned char *data;
    size_t size, bit;
} bit_reader;

static unsigned bits(bit_reader *in, int count)
{
    unsigned value = 0;
    int i;
    for (i = 0; i < count; i++, in->bit++)
        if (in->bit / 8 < in->size) value |= (unsigned)(in->data[in->bit / 8] >> in->bit % 8 & 1) << i;
    return value;
}

/* The next symbol of the fixed code, read a bit at a time (RFC 1951, 3.2.6). */
static int fixed_symbol(bit_reader *in)
{
    unsigned code = 0;
    int length;
    for (length = 1; length <= 9; length++) {
        code = code << 1 | bits(in, 1);
        if (length == 7 && code <= 23) return 256 + (int)code;
        if (length == 8 && code >= 48 && code <= 191) return (int)code - 48;
        if (length == 8 && code >= 192 && code <= 199) return 280 + (int)code - 192;
        if (length == 9 && code >= 400) return 144 + (int)code - 400;
    }
    return -1;
}

/* Unpacks a zlib stream of stored and fixed blocks into `out`; returns the number of bytes, 0 if it is malformed. */
static size_t inflate(const unsigned char *data, size_t size, unsigned char *out, size_t room)
{
    static const int base[] = { 3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258 };
    static const int more[] = {
        0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0
    };
    static const int far[] = {
        1,   2,   3,   4,   5,   7,    9,    13,   17,   25,   33,   49,   65,    97,    129,
        193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577
    };
    bit_reader in = { data, size, 16 };
    size_t n = 0, i;
    int last, kind, symbol;
    uint32_t a = 1, b = 0;
    if (size < 6 || (data[0] & 15) != 8 || (data[0] * 256 + data[1]) % 31 != 0) return 0;
    do {
        last = (int)bits(&in, 1);
        kind = (int)bits(&in, 2);
        if (kind != 1) return 0;
        while ((symbol = fixed_symbol(&in)) != 256) {
            int length = 1, back = 0;
            if (symbol < 0 || symbol > 285) return 0;
            if (symbol > 256) {
                unsigned code = 0;
                length = base[symbol - 257] + (int)bits(&in, more[symbol - 257]);
                for (i = 0; i < 5; i++) code = code << 1 | bits(&in, 1);
                if (code > 29) return 0;
                back = far[code] + (int)bits(&in, code < 2 ? 0 : (int)code / 2 - 1);
                if ((size_t)back > n) return 0;
            }
            for (; length > 0; length--, n++) {
                if (n == room || in.bit > 8 * size) return 0;
                out[n] = back > 0 ? out[n - (size_t)back] : (unsigned char)symbol;
            }
        }
    } while (!last);
    in.bit = (in.bit + 7) / 8 * 8;
    for (i = 0; i < n; i++) a = (a + out[i]) % 65521, b = (b + a) % 65521;
    for (i = 0; i < 4; i++)
        if (bits(&in, 8) != ((b << 16 | a) >> (24 - 8 * i) & 255)) return 0;
    return in.bit == 8 * size ? n : 0;
}

static uint32_t big_endian(const unsigned char *at)
{
    return (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | at[3];
}

/* The CRC by division, from a table, as ISO 3309 has it; its check value is tested below. */
static uint32_t crc_of(const unsigned char *data, size_t size)
{
    uint32_t table[256], crc = 0xffffffffu, i;
    int k;
    for (i = 0; i < 256; i++)
        for (table[i] = i, k = 0; k < 8; k++) table[i] = table[i] & 1 ? 0xedb88320u ^ table[i] >> 1 : table[i] >> 1;
    while (size-- > 0) crc = table[(crc ^ *data++) & 255] ^ crc >> 8;
    return ~crc;
}

/* Reads a PNG of the given kind back into `pixel`; returns what is wrong with it, or NULL. */
static const char *read_png(const unsigned char *data, size_t size, size_t width, size_t height, size_t step,
                            unsigned char *pixel)
{
    static const char *const name[] = { "IHDR", "IDAT", "IEND" };
    size_t at = 8, chunk, row, i, length = 0, row_bytes = width * step;
    unsigned char *rows = (unsigned char *)malloc(height * (row_bytes + 1) + 1);
    const char *fault = NULL;
    if (rows == NULL || size < 8 || memcmp(data, "\x89PNG\r\n\x1a\n", 8) != 0) fault = "signature";
    for (chunk = 0; chunk < 3 && fault == NULL; chunk++, at += length + 12) {
        length = at + 12 <= size ? big_endian(data + at) : size;
        if (at + length + 12 > size || memcmp(data + at + 4, name[chunk], 4) != 0) fault = "chunk";
        else if (crc_of(data + at + 4, length + 4) != big_endian(data + at + 8 + length)) fault = "CRC";
        else if (chunk == 0 && (length != 13 || big_endian(data + at + 8) != width ||
                                big_endian(data + at + 12) != height || data[at + 16] != 8 ||
                                data[at + 17] != (step == 1 ? 0 : 2) || memcmp(data + at + 18, "\0\0\0", 3) != 0))
            fault = "header";
        else if (chunk == 1 &&
                 inflate(data + at + 8, length, rows, height * (row_bytes + 1)) != height * (row_bytes + 1))
            fault = "deflate";
    }
    if (fault == NULL && at != size) fault = "bytes behind the end";
    for (row = 0; row < height && fault == NULL; row++) {
        const unsigned char *from = rows + row * (row_bytes + 1) + 1;
        unsigned char *to = pixel + row * row_bytes;
        if (from[-1] > 2) fault = "filter";
        for (i = 0; i < row_bytes; i++) {
            int less = from[-1] == 1 && i >= step ? to[i - step]
                       : from[-1] == 2 && row > 0 ? *(to + i - row_bytes)
                                                  : 0;
            to[i] = (unsigned char)(from[i] + less);
        }
    }
    free(rows);
    return fault;
}

/* A byte of test picture `kind`: noise, constant, slopes, and rows of single pixels at growing distances, so that
   runs of every length occur. */
static unsigned char test_byte(int kind, size_t i)
{
    static uint32_t state = 99;
    size_t mark = (size_t)((sqrt(8.0 * (double)i + 1) - 1) / 2);
    state = state * 1664525u + 1013904223u;
    if (kind == 0) return (unsigned char)(state >> 24);
    if (kind == 1) return 200;
    if (kind == 2) return (unsigned char)(i / 3);
    return mark * (mark + 1) / 2 == i ? 255 : 7;
}

/* Pictures come back as they were, through an inflate and a CRC of the test's own. Catches: bits in the wrong order,
   a run of a length that its symbol does not mean (3, 10, 11, 257), a filter over the wrong distance, a CRC over the
   length. */
static void pictures_come_back(void)
{
    static const size_t shape[][3] = { { 1, 1, 1 },   { 1, 1, 3 },     { 7, 5, 3 },   { 64, 48, 3 },
                                       { 3, 200, 1 }, { 300, 301, 1 }, { 1000, 1, 3 } };
    size_t s, size, i;
    int kind;
    CHECK(crc_of((const unsigned char *)"123456789", 9) == 0xcbf43926u, "the test's CRC");
    for (s = 0; s < sizeof shape / sizeof shape[0]; s++)
        for (kind = 0; kind < 4; kind++) {
            size_t width = shape[s][0], height = shape[s][1], step = shape[s][2], bytes = width * height * step;
            unsigned char *pixel = (unsigned char *)malloc(bytes), *back = (unsigned char *)calloc(bytes, 1);
            const char *path = in_folder("picture.png"), *fault = "memory";
            char *file = NULL;
            for (i = 0; pixel != NULL && i < bytes; i++) pixel[i] = test_byte(kind, i);
            if (pixel != NULL && back != NULL) {
                CHECK(plot_png(path, width, height, (int)step, pixel) == 0, "not written");
                file = read_all(path, &size);
                fault =
                    file == NULL ? "file" : read_png((unsigned char *)(void *)file, size, width, height, step, back);
                if (fault == NULL && memcmp(pixel, back, bytes) != 0) fault = "pixels";
                if (kind == 1 && bytes > 10000)
                    CHECK(size < bytes / 20, "%d bytes for a constant picture", (int)size);
            }
            CHECK(fault == NULL, "picture %d of kind %d: %s", (int)s, kind, fault);
            free(file);
            free(pixel);
            free(back);
        }
    hush();
    CHECK(plot_png(in_folder("none.png"), 0, 5, 3, (const unsigned char *)"") == 1, "an empty picture");
    CHECK(plot_png(in_folder("none.png"), SIZE_MAX / 2, SIZE_MAX / 2, 3, (const unsigned char *)"") == 1,
          "a huge picture");
    speak();
    CHECK(!exists(in_folder("none.png")), "an empty picture is written");
}

/* The picture in a chart is the same PNG in base 64 (RFC 4648), for every length modulo 3. */
static void pictures_in_charts(void)
{
    static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    unsigned char pixel[27];
    size_t width, i, k;
    for (i = 0; i < 27; i++) pixel[i] = (unsigned char)(i * 89);
    for (width = 1; width <= 9; width++) {
        plot_chart chart = plot_chart_make(NULL, NULL);
        plot_buffer png = { NULL, 0, 0, 0 }, back = { NULL, 0, 0, 0 };
        const char *text;
        plot_picture(&chart.panel[0], width, 1, 3, pixel);
        ploti_png(&png, width, 1, 3, pixel);
        for (text = chart.panel[0].picture; text != NULL && *text != 0; text += 4) {
            uint32_t value = 0;
            for (k = 0; k < 4; k++)
                value = value << 6 | (text[k] == '=' ? 0u : (uint32_t)(strchr(digit, text[k]) - digit));
            for (k = 0; k < 3; k++) {
                unsigned char byte = (unsigned char)(value >> (16 - 8 * k) & 255);
                if (text[k + 1] != '=') ploti_put_bytes(&back, &byte, 1);
            }
        }
        CHECK(png.size == back.size && memcmp(png.data, back.data, png.size) == 0, "width %d: %d bytes, should be %d",
              (int)width, (int)back.size, (int)png.size);
        ploti_drop(&png);
        ploti_drop(&back);
        plot_free(&chart);
    }
    {
        plot_chart chart = plot_chart_make(NULL, NULL);
        plot_picture(&chart.panel[0], 0, 0, 3, pixel);
        hush();
        CHECK(plot_save(&chart, in_folder("none.svg")) == 1, "a chart of an empty picture");
        speak();
    }
}

/* Known values of sRGB (IEC 61966-2-1): 0.18 -> 118, 0.5 -> 188. Catches: gamma 2.2, exposure as a factor, NaN as 0.
   */
static void linear_values(void)
{
    double linear[12] = { 0, 0.5, 1, 0.18, 2, -1, 0.002, HUGE_VAL, 0.25, (double)NAN, 0.5, 0.5 };
    static const unsigned char truth[12] = { 0, 188, 255, 118, 255, 0, 7, 255, 137, 255, 0, 255 };
    unsigned char *bytes = plot_bytes(4, 1, 3, linear, 0), *stop = plot_bytes(4, 1, 3, linear, 1),
                  *grey = plot_bytes(12, 1, 1, linear, 0);
    int i;
    for (i = 0; i < 12 && bytes != NULL; i++)
        CHECK(bytes[i] == truth[i], "value %d: %d, should be %d", i, bytes[i], truth[i]);
    CHECK(stop != NULL && stop[8] == 188 && stop[1] == 255, "one stop");
    CHECK(grey != NULL && grey[9] == 0 && grey[3] == 118, "grey");
    free(bytes);
    free(stop);
    free(grey);
    CHECK(plot_png_linear(in_folder("linear.png"), 4, 1, 3, linear, 0) == 0 && exists(in_folder("linear.png")),
          "not written");
    CHECK(plot_bytes(0, 3, 3, linear, 0) == NULL && plot_bytes(SIZE_MAX / 2, 3, 3, linear, 0) == NULL, "sizes");
}

/* Takes the test's folder away again. */
static void clean_up(void)
{
    static const char *const name[] = {
        "stderr.txt", "labels.svg", "full.chart-1.svg",  "empty.svg",   "line.svg",   "band.svg",
        "odd.svg",    "shared.svg", "deep/er/table.csv", "deep/er",     "deep",       "comma.svg",
        "comma.csv",  "victim",     "memory.svg",        "picture.png", "linear.png", ""
    };
    size_t i;
    for (i = 0; i < sizeof name / sizeof name[0]; i++)
        if (remove(in_folder(name[i])) != 0) CHECK(0, "%s cannot be removed: %s", name[i], strerror(errno));
}

int main(void)
{
    plot_chart first = plot_chart_make(NULL, NULL);
    if (plot_save(&first, in_folder("empty.svg")) != 0) return 1;
    CHECK_RUN(nice_steps);
    CHECK_RUN(ticks_of_axes);
    CHECK_RUN(ranges_of_axes);
    CHECK_RUN(pixels_of_values);
    CHECK_RUN(clipping);
    CHECK_RUN(labels_apart);
    CHECK_RUN(labels_in_a_chart);
    CHECK_RUN(text_and_mathematics);
    CHECK_RUN(words_at_ticks);
    CHECK_RUN(colors_can_be_read);
    CHECK_RUN(faults_are_found);
    CHECK_RUN(charts_are_well_formed);
    CHECK_RUN(lines_break);
    CHECK_RUN(odd_values);
    CHECK_RUN(histogram_is_a_density);
    CHECK_RUN(bands_break);
    CHECK_RUN(axes_are_shared);
    CHECK_RUN(tables);
    CHECK_RUN(locale_is_ignored);
    CHECK_RUN(failures_leave_nothing);
    CHECK_RUN(memory_may_fail);
    CHECK_RUN(the_run);
    CHECK_RUN(pictures_come_back);
    CHECK_RUN(pictures_in_charts);
    CHECK_RUN(linear_values);
    CHECK_RUN(clean_up);
    return check_done("plot");
}
