/* plot.h - charts to be read, tables and pictures for the example programs. Not part of the library: it needs libc
   and libm only, and compiles as C99 and as C++11.

   A chart is a struct in which zero means the default; it holds rows x columns of panels, and a panel holds series:

       #include "plot.h"
       int main(void)
       {
           double n[] = { 1, 10, 100 }, E[] = { 3, 0.27, 1e-8 }, error[] = { 0.1, 0.01, 1e-9 };
           plot_chart chart = plot_chart_make("The start-up error dies away", "Read: below 1 the seed is forgotten.");
           plot_panel *panel = &chart.panel[0];
           panel->x_label = "mutations $n$";
           panel->y_label = "start-up error $E_n$";
           panel->x_log = panel->y_log = 1;
           plot_line(panel, n, E, 3, plot_say(panel, "$Delta$ = %", 0.1));
           plot_points(panel, n, E, error, 3, "4096 chains, 1 standard error")->color = plot_palette(0);
           plot_rule_y(panel, 1, "forgotten");
           return plot_save(&chart, "out/example.svg");
       }

   Sheets: set chart.rows and chart.columns; panel (r, c) is chart.panel[r * chart.columns + c]; panels that get no
   series stay white. Series copy their data and their label, so both may change after the call. A function that adds
   a series returns it, to be styled (`->dash = 1`), never NULL. All other texts must live until plot_save, which
   draws the chart, writes the file whole or not at all, releases everything and returns 0, or says on stderr what
   went wrong and returns 1.

   Values that are not finite, or not positive on a logarithmic axis, break a line and are skipped elsewhere. A
   labelled line is named at its end; other labelled series stand in the key above the panels, equal labels once.

   Texts are ASCII or UTF-8. Between dollar signs stands mathematics in a linear form: `$E_n^2$`, `$10^{-3}$`,
   `$P*(k)$`, Greek by name, single letters italic, and -> <= >= != +- ~ inf times sqrt as their signs. */

#ifndef PLOT_H
#define PLOT_H

#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <unistd.h>
#ifdef _WIN32
#include <direct.h>
#include <process.h>
#endif

/* Every function is static, and may stay unused without a warning. */
#if defined(__GNUC__) || defined(__clang__) || defined(__TINYC__)
#define PLOT_API static __attribute__((unused))
#else
#define PLOT_API static inline
#endif

/* Sizes of type in pixels, on a paper 960 pixels wide unless the chart says otherwise. */
#define PLOTI_TITLE 25
#define PLOTI_TEXT 18
#define PLOTI_SMALL 16
#define PLOTI_LINE 23

enum { PLOT_PANELS = 24, PLOT_TICKS = 24 };
/* What a series is, in the order in which they are drawn over each other. */
enum { PLOT_BAND = 1, PLOT_STEPS, PLOT_BARS, PLOT_RULE_X, PLOT_RULE_Y, PLOT_LINE, PLOT_POINTS, PLOT_NOTE };
enum { PLOTI_KINDS = PLOT_NOTE + 1 };
/* Where its label goes. AUTO: END for lines, rules and notes, KEY for the others. */
enum { PLOT_AUTO, PLOT_END, PLOT_KEY };

typedef struct plot_series plot_series;
struct plot_series {
    int kind;
    uint32_t color;             /* 0xRRGGBB; set by the palette, in the order of the calls */
    double width;               /* of the line in pixels; 0: 3 */
    int dash;                   /* 0 solid, 1 dashed, 2 dotted, 3 dashes and dots */
    int marker;                 /* 0 circle, 1 square, 2 diamond, 3 triangle */
    int place;                  /* of the label: PLOT_AUTO, PLOT_END or PLOT_KEY */
    const char *label;
    size_t count;
    double *x, *y, *low, *high;
    int at_edge;                /* for the layout: the line runs to the right edge, */
    double end[2];              /* is last seen here, */
    size_t ink, ink_end;        /* and these pairs of the frame's ink are its own */
    plot_series *next;
};

typedef struct {
    const char *title;
    const char *x_label, *y_label;     /* with units; under a picture x_label is its caption */
    const char *better;                /* words at an arrow into the lower left corner: "down and left is better" */
    int x_log, y_log;
    double x_min, x_max, y_min, y_max; /* 0: from the data; a linear axis given only a positive maximum begins at 0 */
    int stacked;                       /* bars of one name in a row, not under each other; set before the bars */
    char **names;                      /* from here on filled by the functions below */
    size_t bars, colors, picture_width, picture_height;
    char *picture;
    plot_series *first, *last, spare;
    void *kept;
    int failed;
} plot_panel;

typedef struct {
    const char *title, *note;   /* what the chart says, and how to read it; both wrap */
    size_t rows, columns;       /* 0: 1; at most PLOT_PANELS panels */
    double width, height;       /* in pixels; 0: 960, and what fits */
    int share_x, share_y;       /* one range for all panels; its words at the lowest row, at the left column only */
    plot_panel panel[PLOT_PANELS];
} plot_chart;

/* Bytes that grow. After a failed allocation it takes nothing more and says so in `failed`. Start from zeros. */
typedef struct {
    char *data;
    size_t size, room;
    int failed;
} plot_buffer;

/* An axis: its range, the pixels on which the ends of the range fall, its ticks. */
typedef struct {
    double min, max, from, to;
    int log, ticks;
    double tick[PLOT_TICKS];
} plot_axis;

typedef struct {
    double left, top, right, bottom;
} ploti_box;

/* ---- Bytes and numbers ---- */

PLOT_API void ploti_put_bytes(plot_buffer *out, const void *bytes, size_t count)
{
    if (count > SIZE_MAX / 4 - out->size) out->failed = 1;
    if (!out->failed && count > out->room - out->size) {
        size_t room = 2 * (out->size + count) + 256;
        char *grown = (char *)realloc(out->data, room);
        if (grown == NULL) out->failed = 1;
        else out->data = grown, out->room = room;
    }
    if (out->failed || count == 0) return;
    memcpy(out->data + out->size, bytes, count);
    out->size += count;
}

PLOT_API void ploti_put(plot_buffer *out, const char *text)
{
    if (text != NULL) ploti_put_bytes(out, text, strlen(text));
}

PLOT_API void ploti_drop(plot_buffer *out)
{
    free(out->data);
    memset(out, 0, sizeof *out);
}

/* A length in pixels with at most two decimals, made of whole numbers, which no locale touches. */
PLOT_API void ploti_put_pixels(plot_buffer *out, double value)
{
    char text[40];
    long hundredths = value > -1e6 && value < 1e6 ? lround(100 * value) : 0, size = labs(hundredths);
    int length = snprintf(text, sizeof text, "%s%ld.%02ld", hundredths < 0 ? "-" : "", size / 100, size % 100);
    while (text[length - 1] == '0') length--;
    if (text[length - 1] == '.') length--;
    ploti_put_bytes(out, text, (size_t)length);
}

/* A number with `digits` significant digits; 0: as few as read back the same double. Whatever bytes the locale takes
   for the decimal point become one point. */
PLOT_API void ploti_put_value(plot_buffer *out, double value, int digits)
{
    char text[48];
    int precision = digits > 0 ? digits : 15, foreign = 0;
    const char *at = text;
    snprintf(text, sizeof text, "%.*g", precision, value);
    while (digits == 0 && precision < 17 && strtod(text, NULL) != value)
        snprintf(text, sizeof text, "%.*g", ++precision, value);
    for (at = isnan(value) ? "nan" : text; *at != 0; at++) {
        if (strchr("+-0123456789aefin", *at) != NULL) ploti_put_bytes(out, at, 1);
        else if (foreign++ == 0) ploti_put(out, ".");
    }
}

/* Copies `pattern`; each @ stands for a double in pixels, ~ for a color, ^ for a text as it is. */
PLOT_API void ploti_draw(plot_buffer *out, const char *pattern, ...)
{
    char color[16];
    va_list list;
    va_start(list, pattern);
    for (; *pattern != 0; pattern++) {
        if (*pattern == '@') ploti_put_pixels(out, va_arg(list, double));
        else if (*pattern == '^') ploti_put(out, va_arg(list, const char *));
        else if (*pattern == '~') {
            snprintf(color, sizeof color, "#%06lx", (unsigned long)(va_arg(list, uint32_t) & 0xffffffu));
            ploti_put(out, color);
        } else ploti_put_bytes(out, pattern, 1);
    }
    va_end(list);
}

/* ---- Files and tables: whole or not at all ---- */

PLOT_API int ploti_complain(const char *path, const char *what)
{
    fprintf(stderr, "plot: %s is not written: %s\n", path, what);
    return 1;
}

/* Makes the folders that lead to `path`; what cannot be made shows when the file is opened. */
PLOT_API void ploti_make_folders(char *path)
{
    char *at = path;
    while ((at = strchr(at + 1, '/')) != NULL) {
        *at = 0;
#ifdef _WIN32
        _mkdir(path);
#else
        mkdir(path, 0777);
#endif
        *at = '/';
    }
}

/* Writes the bytes into a temporary sibling and renames it to `path`. */
PLOT_API int ploti_write_file(const char *path, const plot_buffer *bytes)
{
    size_t room = strlen(path) + 32;
    char *sibling = (char *)malloc(room);
    int error = 0;
    FILE *file;
    if (sibling == NULL || bytes->failed) {
        free(sibling);
        return ploti_complain(path, "out of memory");
    }
    snprintf(sibling, room, "%s.%ld.tmp", path, (long)getpid());
    if (path[0] != 0) ploti_make_folders(sibling);
    file = fopen(sibling, "wb");
    if (file == NULL) error = errno;
    if (file != NULL && fwrite(bytes->data, 1, bytes->size, file) != bytes->size) error = errno;
    if (file != NULL && fclose(file) != 0 && error == 0) error = errno;
#ifdef _WIN32
    if (error == 0) remove(path);
#endif
    if (error == 0 && rename(sibling, path) != 0) error = errno;
    if (error != 0 && file != NULL) remove(sibling);
    free(sibling);
    return error == 0 ? 0 : ploti_complain(path, strerror(error));
}

/* A table on its way to `path`, which must live until plot_csv_close. */
typedef struct {
    const char *path;
    plot_buffer text;
    size_t columns, field, bad_rows;
} plot_csv;

/* Begins a table; `header` names the columns: "n,Delta,error". */
PLOT_API plot_csv plot_csv_open(const char *path, const char *header)
{
    plot_csv csv;
    memset(&csv, 0, sizeof csv);
    csv.path = path;
    ploti_draw(&csv.text, "^\n", header);
    for (csv.columns = 1; (header = strchr(header, ',')) != NULL; header++) csv.columns++;
    return csv;
}

/* A field: a number that reads back exactly, or nan, inf, -inf. */
PLOT_API void plot_csv_number(plot_csv *csv, double value)
{
    if (csv->field++ > 0) ploti_put(&csv->text, ",");
    ploti_put_value(&csv->text, value, 0);
}

/* A field of text; commas, quotes and ends of lines in it become spaces, so that any reader can split the row. */
PLOT_API void plot_csv_text(plot_csv *csv, const char *text)
{
    if (csv->field++ > 0) ploti_put(&csv->text, ",");
    for (; *text != 0; text++) ploti_put_bytes(&csv->text, strchr(",\"\r\n", *text) != NULL ? " " : text, 1);
}

/* A whole number too large for a double, such as a seed. */
PLOT_API void plot_csv_whole(plot_csv *csv, unsigned long long value)
{
    char text[32];
    snprintf(text, sizeof text, "%llu", value);
    plot_csv_text(csv, text);
}

/* Numbers as the rest of the row, and its end. */
PLOT_API void plot_csv_row(plot_csv *csv, const double *value, size_t count)
{
    size_t i;
    for (i = 0; i < count; i++) plot_csv_number(csv, value[i]);
    csv->bad_rows += csv->field != csv->columns;
    csv->field = 0;
    ploti_put(&csv->text, "\n");
}

/* The same from a list: PLOT_CSV_ROW(&csv, (double)n, Delta, error); the arguments must be doubles. */
#define PLOT_CSV_ROW(csv, ...)                                                                                       \
    do {                                                                                                             \
        const double plot_csv_values[] = { __VA_ARGS__ };                                                            \
        plot_csv_row((csv), plot_csv_values, sizeof plot_csv_values / sizeof plot_csv_values[0]);                    \
    } while (0)

/* Writes the table and releases it. Returns 0, or 1 after a message, and then no file was written: the file system
   refused, or a row has more or fewer fields than the header. */
PLOT_API int plot_csv_close(plot_csv *csv)
{
    int status;
    if (csv->bad_rows > 0 || csv->field > 0)
        status = ploti_complain(csv->path, "a row does not have the header's columns");
    else status = ploti_write_file(csv->path, &csv->text);
    ploti_drop(&csv->text);
    return status;
}

/* ---- Colors ---- */

/* Eight colors that people with any kind of color vision tell apart (Okabe and Ito 2008), the darker first; their
   yellow, which vanishes on white, is left to a grey. */
PLOT_API uint32_t plot_palette(size_t index)
{
    static const uint32_t hue[8] = { 0x0072b2, 0xd55e00, 0x009e73, 0xcc79a7, 0xe69f00, 0x56b4e9, 0x222222, 0x888888 };
    return hue[index % 8];
}

/* The color of parameter `index` of `count` in ascending order: dark blue, purple, red, orange, darker to lighter in
   grey print too (after "plasma", Smith and van der Walt 2015, without its yellow end). */
PLOT_API uint32_t plot_shade(size_t index, size_t count)
{
    static const int stop[6][3] = { { 13, 8, 135 },   { 106, 0, 168 },  { 165, 32, 151 },
                                    { 208, 72, 111 }, { 236, 112, 67 }, { 250, 160, 30 } };
    double at = count > 1 ? 5.0 * (double)(index < count ? index : count - 1) / (double)(count - 1) : 0;
    int i = at < 4 ? (int)at : 4, channel;
    uint32_t color = 0;
    for (channel = 0; channel < 3; channel++)
        color =
            color << 8 | (uint32_t)(stop[i][channel] + (at - i) * (stop[i + 1][channel] - stop[i][channel]) + 0.5);
    return color;
}

/* The same color, dark enough for text on white: a luminance of at most .18 is a contrast of 4.5 to 1 (WCAG 2.1). */
PLOT_API uint32_t ploti_text_color(uint32_t color)
{
    double r = (color >> 16 & 255) / 255.0, g = (color >> 8 & 255) / 255.0, b = (color & 255) / 255.0, shade = 1;
    double luminance = 0.2126 * pow(r, 2.2) + 0.7152 * pow(g, 2.2) + 0.0722 * pow(b, 2.2);
    if (luminance > 0.18) shade = pow(0.18 / luminance, 1 / 2.2);
    return (uint32_t)(255 * r * shade) << 16 | (uint32_t)(255 * g * shade) << 8 | (uint32_t)(255 * b * shade);
}

/* ---- Building a chart ---- */

/* An empty chart of one panel. In C, `plot_chart chart = { 0 };` does as well. */
PLOT_API plot_chart plot_chart_make(const char *title, const char *note)
{
    plot_chart chart;
    memset(&chart, 0, sizeof chart);
    chart.title = title;
    chart.note = note;
    return chart;
}

/* Zeroed memory that the panel releases, filled from `source` unless that is NULL; each block is linked to the one
   before. NULL marks the panel as failed. */
PLOT_API void *ploti_keep(plot_panel *panel, const void *source, size_t count, size_t size)
{
    union ploti_block {
        void *next;
        double align;
        uint64_t align_too;
    } *block = NULL;
    if (count < SIZE_MAX / size - 2) block = (union ploti_block *)calloc(1, sizeof *block + (count + 1) * size);
    if (block == NULL) {
        panel->failed = 1;
        return NULL;
    }
    block->next = panel->kept;
    panel->kept = block;
    if (source != NULL && count > 0) memcpy(block + 1, source, count * size);
    return block + 1;
}

/* `text` with `value` in six digits in the place of its %, kept by the panel: "$Delta$ = %". Never NULL. */
PLOT_API const char *plot_say(plot_panel *panel, const char *text, double value)
{
    plot_buffer out = { NULL, 0, 0, 0 };
    const char *copy;
    for (; *text != 0; text++) {
        if (*text == '%') ploti_put_value(&out, value, 6);
        else ploti_put_bytes(&out, text, 1);
    }
    panel->failed |= out.failed;
    copy = (const char *)ploti_keep(panel, out.data, out.size, 1);
    ploti_drop(&out);
    return copy != NULL ? copy : "";
}

/* A series with copies of its values; arrays may be NULL. After a failure the panel's spare one, without values. */
PLOT_API plot_series *ploti_series(plot_panel *panel, int kind, const double *x, const double *y, const double *low,
                                        const double *high, size_t count, const char *label)
{
    int plain = kind == PLOT_RULE_X || kind == PLOT_RULE_Y || kind == PLOT_NOTE;
    plot_series *series = (plot_series *)ploti_keep(panel, NULL, 1, sizeof *series);
    if (series == NULL) {
        memset(&panel->spare, 0, sizeof panel->spare);
        return &panel->spare;
    }
    series->kind = kind;
    series->count = count;
    series->color = plain ? 0x555555 : plot_palette(panel->colors++);
    if (label != NULL && label[0] != 0) series->label = (const char *)ploti_keep(panel, label, strlen(label), 1);
    if (x != NULL) series->x = (double *)ploti_keep(panel, x, count, sizeof *x);
    if (y != NULL) series->y = (double *)ploti_keep(panel, y, count, sizeof *y);
    if (low != NULL) series->low = (double *)ploti_keep(panel, low, count, sizeof *low);
    if (high != NULL) series->high = (double *)ploti_keep(panel, high, count, sizeof *high);
    if (panel->last != NULL) panel->last->next = series;
    else panel->first = series;
    panel->last = series;
    return series;
}

/* Makes of low and high, which hold the middle, middle -+ error. */
PLOT_API plot_series *ploti_spread_errors(plot_panel *panel, plot_series *series, const double *error)
{
    size_t i;
    for (i = 0; error != NULL && !panel->failed && i < series->count; i++) {
        series->low[i] -= error[i];
        series->high[i] += error[i];
    }
    return series;
}

/* A line through (x[i], y[i]), named at its end. */
PLOT_API plot_series *plot_line(plot_panel *panel, const double *x, const double *y, size_t count, const char *label)
{
    return ploti_series(panel, PLOT_LINE, x, y, NULL, NULL, count, label);
}

/* Points with bars y +- error; `error` may be NULL. */
PLOT_API plot_series *plot_points(plot_panel *panel, const double *x, const double *y, const double *error,
                                       size_t count, const char *label)
{
    return ploti_spread_errors(panel, ploti_series(panel, PLOT_POINTS, x, y, y, y, count, label), error);
}

/* The area between low[i] and high[i], behind everything else. */
PLOT_API plot_series *plot_band(plot_panel *panel, const double *x, const double *low, const double *high,
                                     size_t count, const char *label)
{
    return ploti_series(panel, PLOT_BAND, x, NULL, low, high, count, label);
}

/* Steps of height[i] between edge[i] and edge[i + 1], filled down to 0; `edge` has count + 1 values. */
PLOT_API plot_series *plot_steps(plot_panel *panel, const double *edge, const double *height, size_t count,
                                      const char *label)
{
    plot_series *series = ploti_series(panel, PLOT_STEPS, NULL, NULL, NULL, NULL, 2 * count, label);
    size_t i;
    series->x = (double *)ploti_keep(panel, NULL, 2 * count, sizeof *series->x);
    series->y = (double *)ploti_keep(panel, NULL, 2 * count, sizeof *series->y);
    series->low = (double *)ploti_keep(panel, NULL, 2 * count, sizeof *series->low);
    for (i = 0; !panel->failed && i < 2 * count; i++) {
        series->x[i] = edge[(i + 1) / 2];
        series->y[i] = height[i / 2];
    }
    series->high = series->y;
    return series;
}

/* The density of `count` values in `bins` equal bins on [low, high); values outside count in the total, not in a bin.
   */
PLOT_API plot_series *plot_histogram(plot_panel *panel, const double *value, size_t count, double low, double high,
                                          size_t bins, const char *label)
{
    double *edge = (double *)ploti_keep(panel, NULL, bins + 1, sizeof *edge), width = (high - low) / (double)bins;
    double *height = (double *)ploti_keep(panel, NULL, bins + 1, sizeof *height);
    size_t i, bin;
    if (edge == NULL || height == NULL) bins = 0;
    for (i = 0; bins > 0 && i <= bins; i++) edge[i] = low + width * (double)i;
    for (i = 0; bins > 0 && i < count; i++) {
        if (!(value[i] >= low && value[i] < high)) continue;
        bin = (size_t)((value[i] - low) / width);
        height[bin < bins ? bin : bins - 1] += 1 / ((double)count * width);
    }
    return plot_steps(panel, edge, height, bins, label);
}

/* Bars of value[i] +- error[i] for name[i]; `error` may be NULL. They lie, so that names of any length are read
   without turning the head: the values are on the x axis. Further calls for the same names put their bars under the
   first, or, if panel->stacked was set before, at its right end. On a logarithmic axis bars begin at the left end of
   the axis. */
PLOT_API plot_series *plot_bars(plot_panel *panel, const char *const *name, const double *value,
                                     const double *error, size_t count, const char *label)
{
    const plot_series *before = panel->stacked ? panel->last : NULL;
    plot_series *series = ploti_series(panel, PLOT_BARS, value, NULL, value, value, count, label);
    size_t i;
    series->y = (double *)ploti_keep(panel, NULL, count, sizeof *series->y); /* where the bars begin */
    for (i = 0; before != NULL && before->kind == PLOT_BARS && !panel->failed && i < count && i < before->count;
         i++) {
        series->y[i] = before->x[i];
        series->x[i] += before->x[i];
        series->low[i] = series->high[i] = series->x[i];
    }
    if (panel->names == NULL) {
        panel->names = (char **)ploti_keep(panel, NULL, count, sizeof *panel->names);
        for (i = 0; !panel->failed && i < count; i++)
            panel->names[i] = (char *)ploti_keep(panel, name[i], strlen(name[i]), 1);
        panel->bars = count;
    }
    return ploti_spread_errors(panel, series, error);
}

/* A dashed upright line at x. */
PLOT_API plot_series *plot_rule_x(plot_panel *panel, double x, const char *label)
{
    return ploti_series(panel, PLOT_RULE_X, &x, NULL, NULL, NULL, 1, label);
}

/* A dashed level line at y. */
PLOT_API plot_series *plot_rule_y(plot_panel *panel, double y, const char *label)
{
    return ploti_series(panel, PLOT_RULE_Y, NULL, &y, NULL, NULL, 1, label);
}

/* Words beside the point (x, y), which gets a small ring. */
PLOT_API plot_series *plot_note(plot_panel *panel, double x, double y, const char *text)
{
    return ploti_series(panel, PLOT_NOTE, &x, &y, NULL, NULL, 1, text);
}

/* Releases everything a chart holds and empties it; plot_save does it too. */
PLOT_API void plot_free(plot_chart *chart)
{
    size_t i;
    for (i = 0; i < PLOT_PANELS; i++)
        while (chart->panel[i].kept != NULL) {
            void *next = *(void **)chart->panel[i].kept;
            free(chart->panel[i].kept);
            chart->panel[i].kept = next;
        }
    memset(chart, 0, sizeof *chart);
}

/* ---- Text ---- */

/* Writes characters in runs of one style, or only measures them. */
typedef struct {
    plot_buffer *out;                /* NULL: measure */
    double size, width;              /* of the type; of what has passed so far, in pixels */
    int markup, open, level, italic; /* runs as tspans? is one open? its style: level -1 below, 1 above the line */
} ploti_pen;

PLOT_API void ploti_pen_style(ploti_pen *pen, int level, int italic)
{
    static const double rise[3] = { -0.22, 0, 0.38 };
    double drop = rise[pen->level + 1] - rise[level + 1];
    if (pen->level == level && pen->italic == italic) return;
    pen->level = level;
    pen->italic = italic;
    if (pen->out == NULL || !pen->markup) return;
    ploti_draw(pen->out,
               pen->open ? "</tspan><tspan dy=\"@\" font-size=\"@\"^>" : "<tspan dy=\"@\" font-size=\"@\"^>",
               drop * pen->size, pen->size * (level == 0 ? 1 : 0.76), italic ? " font-style=\"italic\"" : "");
    pen->open = 1;
}

/* Bytes that show as one character of `width` times the type size. */
PLOT_API void ploti_pen_bytes(ploti_pen *pen, const char *bytes, size_t count, double width)
{
    pen->width += width * pen->size * (pen->level == 0 ? 1 : 0.76);
    if (pen->out != NULL) ploti_put_bytes(pen->out, bytes, count);
}

/* One plain character, escaped; returns its length. Controls and what is no UTF-8 become a question mark. The widths
   are those of Helvetica by classes, on the generous side. */
PLOT_API size_t ploti_pen_plain(ploti_pen *pen, const char *text)
{
    unsigned char lead = (unsigned char)*text;
    size_t count = lead < 0x80 ? 1 : lead < 0xc2 ? 0 : lead < 0xe0 ? 2 : lead < 0xf0 ? 3 : lead < 0xf4 ? 4 : 0, i;
    double width = lead >= 'A' && lead <= 'Z' ? 0.71 : 0.58;
    if (strchr("ijl.,:;'|!", *text) != NULL) width = 0.29;
    else if (strchr("frtI()[]/- \"", *text) != NULL) width = 0.36;
    else if (strchr("mwMW@%", *text) != NULL) width = 0.9;
    for (i = 1; i < count; i++)
        if (((unsigned char)text[i] & 0xc0) != 0x80) count = 0;
    if (*text == '&') ploti_pen_bytes(pen, "&amp;", 5, 0.7);
    else if (*text == '<') ploti_pen_bytes(pen, "&lt;", 4, 0.6);
    else if (*text == '>') ploti_pen_bytes(pen, "&gt;", 4, 0.6);
    else if (count == 0 || lead < 32 || lead == 127) ploti_pen_bytes(pen, "?", 1, width);
    else ploti_pen_bytes(pen, text, count, width);
    return count > 0 ? count : 1;
}

/* The code point of a Greek letter or sign by its name, 0 if it is none. */
PLOT_API unsigned ploti_sign(const char *word, size_t length)
{
    static const char greek[] =
        " alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho "
        "finalsigma sigma tau upsilon phi chi psi omega ";
    static const char other[] = " inf times sqrt -> <= >= != +- - ~ ";
    static const unsigned other_code[] = { 8734, 215, 8730, 8594, 8804, 8805, 8800, 177, 8722, 8764 };
    int capital = *word >= 'A' && *word <= 'Z';
    char name[16];
    const char *at, *found;
    unsigned code = 0;
    if (length == 0 || length > 12) return 0;
    snprintf(name, sizeof name, " %.*s ", (int)length, word);
    if ((found = strstr(other, name)) != NULL) {
        for (at = other + 1; at <= found; at++) code += *at == ' ';
        return other_code[code];
    }
    if (capital) name[1] = (char)(*word - 'A' + 'a');
    if (length == 1 || (found = strstr(greek, name)) == NULL) return 0;
    for (at = greek + 1; at <= found; at++) code += *at == ' ';
    return code + (capital ? 913 : 945);
}

/* One atom of mathematics at `level`; returns its length. */
PLOT_API size_t ploti_pen_math(ploti_pen *pen, const char *text, size_t length, int level)
{
    size_t word = 0, i;
    unsigned sign;
    char code[16];
    while (word < length && ((text[word] | 32) >= 'a' && (text[word] | 32) <= 'z')) word++;
    if (word == 0) word = length > 1 && ploti_sign(text, 2) != 0 ? 2 : 1;
    sign = ploti_sign(text, word);
    ploti_pen_style(pen, level,
                    (word == 1 && (*text | 32) >= 'a' && (*text | 32) <= 'z') || (sign > 944 && sign < 970));
    if (sign != 0) ploti_pen_bytes(pen, code, (size_t)snprintf(code, sizeof code, "&#%u;", sign), 0.62);
    else if (word == 1) return ploti_pen_plain(pen, text);
    else for (i = 0; i < word; i++) ploti_pen_plain(pen, text + i);
    return word;
}

/* Writes the first `length` bytes of `text` and returns their width in pixels; braces only group. */
PLOT_API double ploti_write(plot_buffer *out, const char *text, size_t length, double size, int markup)
{
    ploti_pen pen = { NULL, 0, 0, 0, 0, 0, 0 };
    int math = 0, level = 0, once = 0;
    size_t i = 0;
    pen.out = out;
    pen.size = size;
    pen.markup = markup;
    while (i < length) {
        char c = text[i];
        if (c == '$') math = !math, level = once = 0, i++;
        else if (!math) {
            ploti_pen_style(&pen, 0, 0);
            i += ploti_pen_plain(&pen, text + i);
        } else if (c == '_' || c == '^') level = c == '_' ? -1 : 1, once = 1, i++;
        else if (c == '{') once = 0, i++;
        else if (c == '}') level = 0, i++;
        else {
            i += ploti_pen_math(&pen, text + i, once ? 1 : length - i, level);
            if (once) level = once = 0;
        }
    }
    if (pen.open) ploti_put(out, "</tspan>");
    return pen.width;
}

PLOT_API double ploti_width(const char *text)
{
    return text == NULL ? 0 : ploti_write(NULL, text, strlen(text), PLOTI_SMALL, 0);
}

enum { PLOTI_MIDDLE = 1, PLOTI_RIGHT = 2, PLOTI_BOLD = 4, PLOTI_HALO = 8 };

PLOT_API void ploti_text_part(plot_buffer *out, double x, double y, double size, int look, uint32_t color,
                                   const char *text, size_t length)
{
    ploti_draw(out, "<text x=\"@\" y=\"@\" font-size=\"@\" fill=\"~\"^^^>", x, y, size, color,
               look & PLOTI_MIDDLE  ? " text-anchor=\"middle\""
               : look & PLOTI_RIGHT ? " text-anchor=\"end\""
                                    : "",
               look & PLOTI_BOLD ? " font-weight=\"bold\"" : "",
               look & PLOTI_HALO
                   ? " stroke=\"#fff\" stroke-width=\"5\" stroke-linejoin=\"round\" paint-order=\"stroke\""
                   : "");
    ploti_write(out, text, length, size, 1);
    ploti_put(out, "</text>\n");
}

PLOT_API void ploti_text(plot_buffer *out, double x, double y, int look, uint32_t color, const char *text)
{
    ploti_text_part(out, x, y, PLOTI_SMALL, look, color, text, strlen(text));
}

/* Text broken at spaces (outside mathematics) into lines that fit `width`, the first on the base line y. Returns the
   height of all lines. `out` may be NULL. */
PLOT_API double ploti_paragraph(plot_buffer *out, double x, double y, double width, double size, int look,
                                     const char *text)
{
    double height = 0;
    while (text != NULL && *text != 0) {
        size_t end = 0, i;
        int math = 0;
        for (i = 0;; i++) {
            if (text[i] == '$') math = !math;
            if (text[i] != 0 && (text[i] != ' ' || math)) continue;
            if (end > 0 && ploti_write(NULL, text, i, size, 0) > width) break;
            end = i;
            if (text[i] == 0) break;
        }
        if (end == 0) end = strlen(text);
        if (out != NULL) ploti_text_part(out, x, y + height, size, look, 0x222222, text, end);
        for (text += end; *text == ' '; text++) {}
        height += 1.28 * size;
    }
    return height;
}

/* ---- Scales ---- */

/* The least of 1, 2, 5 times a power of ten that cuts `span` into at most `most` steps; 0 if there is none. */
PLOT_API double plot_nice_step(double span, int most)
{
    double least = span / (most > 0 ? most : 1), power = pow(10, floor(log10(least))), fold = least / power;
    if (!(least > 0) || !(power > 0)) return 0;
    return power * (fold <= 1 + 1e-9 ? 1 : fold <= 2 + 1e-9 ? 2 : fold <= 5 + 1e-9 ? 5 : 10);
}

/* Puts about `most` ticks, at most PLOT_TICKS, into `tick`; returns how many. A logarithmic axis gets powers of ten,
   over less than two decades also their double and fivefold, and over less than two thirds of a decade the linear
   ticks. */
PLOT_API int plot_ticks(double min, double max, int is_log, int most, double *tick)
{
    static const double fold[3] = { 1, 2, 5 };
    double decades = is_log && min > 0 && max <= 1e300 ? log10(max) - log10(min) : 0,
           step = plot_nice_step(max - min, most);
    int folds = decades < 2 ? 3 : 1, stride = (int)ceil(decades / (most > 0 ? most : 1)), count = 0, i, e;
    if (decades >= 0.66) {
        for (e = (int)floor(log10(min)); folds == 1 && e % stride != 0; e--) {}
        for (; pow(10, e) <= max * (1 + 1e-9); e += folds == 1 ? stride : 1)
            for (i = 0; i < folds && count < PLOT_TICKS; i++) {
                double value = fold[i] * pow(10, e);
                if (value >= min * (1 - 1e-9) && value <= max * (1 + 1e-9)) tick[count++] = value;
            }
    } else if (step > 0)
        for (i = 0; count < PLOT_TICKS && (ceil(min / step - 1e-9) + i) * step <= max + 1e-9 * step; i++)
            tick[count++] = (ceil(min / step - 1e-9) + i) * step;
    return count;
}

/* The words at a tick, as mathematics: plain if that suits all ticks of the axis, else with a power of ten. */
PLOT_API const char *ploti_tick_text(const plot_axis *axis, int index, char text[64])
{
    double value = fabs(axis->tick[index]), first = fabs(axis->tick[0]), last = fabs(axis->tick[axis->ticks - 1]);
    double largest = fmax(first, last), fold = 0;
    int exponent = value > 0 ? (int)floor(log10(value) + 1e-9) : 0;
    plot_buffer out = { NULL, 0, 0, 0 };
    int plain = axis->log ? fmin(first, last) > 0.9e-3 && largest < 2e4 : largest < 1e5 && largest >= 1e-3;
    if (value > 0 && !plain) fold = value / pow(10, exponent);
    ploti_put(&out, axis->tick[index] < 0 ? "$-" : "$");
    if (!(fabs(fold - 1) < 1e-9)) ploti_put_value(&out, fold > 0 ? fold : value, 7);
    if (fold > 0) {
        ploti_put(&out, fabs(fold - 1) < 1e-9 ? "10^{" : " times 10^{");
        ploti_put_value(&out, exponent, 3);
        ploti_put(&out, "}");
    }
    snprintf(text, 64, "%.*s$", out.failed ? 0 : (int)out.size, out.data);
    ploti_drop(&out);
    return text;
}

PLOT_API int ploti_usable(const plot_axis *axis, double value)
{
    return fabs(value) <= 1e300 && (!axis->log || value > 0);
}

/* The pixel of a usable value, kept within reach of the paper. */
PLOT_API double plot_at(const plot_axis *axis, double value)
{
    double part = axis->log ? (log(value) - log(axis->min)) / (log(axis->max) - log(axis->min))
                            : (value - axis->min) / (axis->max - axis->min);
    return fmax(-20000, fmin(20000, axis->from + (axis->to - axis->from) * part));
}

/* The pixel brought to the axis; values that are not usable fall on its beginning. */
PLOT_API double ploti_on_axis(const plot_axis *axis, double value)
{
    double at = ploti_usable(axis, value) ? plot_at(axis, value) : axis->from;
    return fmax(fmin(axis->from, axis->to), fmin(fmax(axis->from, axis->to), at));
}

/* Widens the axis, NaN when empty, to hold the usable ones of the values. */
PLOT_API void ploti_cover(plot_axis *axis, const double *value, size_t count)
{
    size_t i;
    for (i = 0; value != NULL && i < count; i++) {
        if (!ploti_usable(axis, value[i])) continue;
        axis->min = fmin(axis->min, value[i]);
        axis->max = fmax(axis->max, value[i]);
    }
}

/* The range to draw: what it covers with a little air (`pad`, a part of it), from 0 if that is near, unless `min` or
   `max` say otherwise; never empty, never finer than doubles resolve. */
PLOT_API void ploti_range(plot_axis *axis, double min, double max, double pad)
{
    double low = axis->min, high = axis->max, air;
    int fix_low = ploti_usable(axis, min) && (min != 0 || max > 0), fix_high = ploti_usable(axis, max) && max != 0;
    if (!(low <= high)) low = axis->log ? 1 : 0, high = axis->log ? 10 : 1;
    if (!axis->log && low > 0 && low < 0.3 * high) low = 0;
    if (fix_low) low = min;
    if (fix_high) high = max;
    if (axis->log && !(high > low * 1.001)) low /= 3, high = low * 9;
    if (!axis->log && !(high - low > 1e-9 * (fabs(low) + fabs(high)))) {
        air = fmax(fabs(low) + fabs(high), 1e-300) < 1e-200 ? 1 : 0.25 * (fabs(low) + fabs(high));
        low -= air, high = low + 2 * air;
    }
    air = axis->log ? exp(pad * (log(high) - log(low))) : pad * (high - low);
    if (!fix_low && (axis->log || (low != 0))) low = axis->log ? low / air : low - air;
    if (!fix_high && (axis->log || (high != 0))) high = axis->log ? high * air : high + air;
    axis->min = low;
    axis->max = high;
}

/* ---- Lines, clipped to the panel ---- */

/* A panel on its way to paper: its axes, what ink is on it (pairs x, y every few pixels), what boxes labels have
   taken. */
typedef struct {
    plot_panel *panel;
    plot_buffer *out;
    ploti_box box;
    plot_axis x, y;
    int show_x, show_y;     /* are the words of the axes shown? */
    plot_buffer ink, taken;
    double pen[2];          /* where the last line was last seen */
} ploti_frame;

/* Cuts the segment s = (x0, y0, x1, y1) to the box; 0 if nothing is left (Liang and Barsky 1984). */
PLOT_API int ploti_clip(const ploti_box *box, double s[4])
{
    double dx = s[2] - s[0], dy = s[3] - s[1], from = 0, to = 1, step[4], room[4];
    int k;
    step[0] = -dx, step[1] = dx, step[2] = -dy, step[3] = dy;
    room[0] = s[0] - box->left, room[1] = box->right - s[0], room[2] = s[1] - box->top, room[3] = box->bottom - s[1];
    for (k = 0; k < 4; k++) {
        if (step[k] < 0) from = fmax(from, room[k] / step[k]);
        else if (step[k] > 0) to = fmin(to, room[k] / step[k]);
        else if (room[k] < 0) return 0;
    }
    if (from > to) return 0;
    s[2] = s[0] + to * dx, s[3] = s[1] + to * dy;
    s[0] += from * dx, s[1] += from * dy;
    return 1;
}

PLOT_API void ploti_add_ink(ploti_frame *frame, double x, double y)
{
    double pair[2];
    pair[0] = x, pair[1] = y;
    ploti_put_bytes(&frame->ink, pair, sizeof pair);
}

/* Draws the visible part of a segment and inks it every 4 pixels. */
PLOT_API void ploti_segment(ploti_frame *frame, const double from[2], const double to[2])
{
    double s[4];
    int i, steps;
    s[0] = from[0], s[1] = from[1], s[2] = to[0], s[3] = to[1];
    if (!ploti_clip(&frame->box, s)) return;
    if (!(fabs(s[0] - frame->pen[0]) + fabs(s[1] - frame->pen[1]) < 1e-6)) ploti_draw(frame->out, "M@ @", s[0], s[1]);
    ploti_draw(frame->out, "L@ @", s[2], s[3]);
    steps = (int)((fabs(s[2] - s[0]) + fabs(s[3] - s[1])) / 4) + 1;
    for (i = 1; i <= steps; i++)
        ploti_add_ink(frame, s[0] + (s[2] - s[0]) * i / steps, s[1] + (s[3] - s[1]) * i / steps);
    frame->pen[0] = s[2], frame->pen[1] = s[3];
}

/* The path through the usable points; points closer than half a pixel are passed over, a lonely one becomes a dot. */
PLOT_API void ploti_path(ploti_frame *frame, const double *x, const double *y, size_t count)
{
    double last[2] = { 0, 0 }, at[2];
    size_t i, run = 0;
    frame->pen[0] = frame->pen[1] = (double)NAN;
    for (i = 0; i < count; i++) {
        int ends = i + 1 == count || !ploti_usable(&frame->x, x[i + 1]) || !ploti_usable(&frame->y, y[i + 1]);
        if (!ploti_usable(&frame->x, x[i]) || !ploti_usable(&frame->y, y[i])) {
            run = 0;
            continue;
        }
        at[0] = plot_at(&frame->x, x[i]), at[1] = plot_at(&frame->y, y[i]);
        if (run > 0 && !ends && fabs(at[0] - last[0]) < 0.5 && fabs(at[1] - last[1]) < 0.5) continue;
        if (run > 0) ploti_segment(frame, last, at);
        else if (ends) ploti_segment(frame, at, at);
        last[0] = at[0], last[1] = at[1];
        run++;
    }
}

/* ---- Labels ---- */

/* Moves the ascending `y` apart until neighbours are `gap` away from each other, between `low` and `high`, with the
   least sum of squared moves: y[i] - i gap must ascend, which isotonic regression solves (Barlow et al. 1972, the
   max-min formula). Where there is no room the gap shrinks. `moved` gets the result. */
PLOT_API void plot_spread(const double *y, size_t count, double gap, double low, double high, double *moved)
{
    size_t i, a, b;
    if (count > 1) gap = fmin(gap, (high - low) / (double)(count - 1));
    for (i = 0; i < count; i++) {
        double best = -1e300;
        for (a = 0; a <= i; a++) {
            double sum = 0, least = 1e300;
            for (b = a; b < count; b++) {
                sum += y[b] - gap * (double)b;
                if (b >= i) least = fmin(least, sum / (double)(b - a + 1));
            }
            best = fmax(best, least);
        }
        moved[i] = fmax(low, fmin(best, high - gap * (double)(count - 1))) + gap * (double)i;
    }
}

PLOT_API int ploti_in_key(const plot_series *series)
{
    if (series->label == NULL || series->place == PLOT_END) return 0;
    return series->place == PLOT_KEY || series->kind < PLOT_RULE_X || series->kind == PLOT_POINTS;
}

/* Names the lines that run to the right edge beside it, moved apart, with a thin leader where the name is not at the
   end. */
PLOT_API void ploti_edge_labels(ploti_frame *frame)
{
    enum { MOST = 64 };
    const plot_series *series, *sorted[MOST];
    double y[MOST] = { 0 }, moved[MOST], x = frame->box.right;
    size_t count = 0, i;
    for (series = frame->panel->first; series != NULL && count < MOST; series = series->next) {
        if (!series->at_edge) continue;
        for (i = count++; i > 0 && sorted[i - 1]->end[1] > series->end[1]; i--) sorted[i] = sorted[i - 1];
        sorted[i] = series;
    }
    for (i = 0; i < count; i++) y[i] = sorted[i]->end[1];
    plot_spread(y, count, PLOTI_SMALL + 4, frame->box.top, frame->box.bottom, moved);
    for (i = 0; i < count; i++) {
        if (fabs(moved[i] - y[i]) > 3 || x - sorted[i]->end[0] > 8)
            ploti_draw(frame->out, "<path d=\"M@ @L@ @L@ @\" stroke=\"~\" fill=\"none\"/>\n", sorted[i]->end[0] + 3,
                       y[i], fmax(x, sorted[i]->end[0] + 3), y[i], x + 14, moved[i], sorted[i]->color);
        ploti_text(frame->out, x + 17, moved[i] + 5.5, 0, ploti_text_color(sorted[i]->color), sorted[i]->label);
    }
}

/* How bad a place for the label of `series` this box is: outside the panel, over another label, over ink, close to
   the ink of others. */
PLOT_API double ploti_box_cost(const ploti_frame *frame, const plot_series *series, const ploti_box *box)
{
    const ploti_box *taken = (const ploti_box *)(const void *)frame->taken.data, *in = &frame->box;
    const double *ink = (const double *)(const void *)frame->ink.data;
    size_t i;
    double cost = 0;
    if (box->left < in->left || box->right > in->right || box->top < in->top || box->bottom > in->bottom) cost = 3000;
    for (i = 0; i < frame->taken.size / sizeof *taken; i++)
        if (box->left < taken[i].right && taken[i].left < box->right && box->top < taken[i].bottom &&
            taken[i].top < box->bottom)
            cost += 1000;
    for (i = 0; i < frame->ink.size / sizeof *ink; i += 2) {
        double aside = fmax(box->left - ink[i], ink[i] - box->right),
               off = fmax(box->top - ink[i + 1], ink[i + 1] - box->bottom);
        if (aside < 3 && off < 0) cost += 10;
        else if (aside < 12 && off < 10 && (i / 2 < series->ink || i / 2 >= series->ink_end)) cost += 4;
    }
    return cost;
}

/* Names a series inside the panel: of the eight sides of each sample of its own ink, close by or at the end of a thin
   leader, the place that covers least, the nearer to the end of the series the better. */
PLOT_API void ploti_inner_label(ploti_frame *frame, const plot_series *series)
{
    static const int side[8][2] = { { 1, 0 },   { 1, -1 }, { 1, 1 },  { 0, -1 },
                                    { -1, -1 }, { 0, 1 },  { -1, 0 }, { -1, 1 } };
    double width = ploti_width(series->label), height = PLOTI_SMALL + 3, least = 1e300, from[2] = { 0, 0 };
    size_t i, k, inks = series->ink_end - series->ink;
    ploti_box best = { 0, 0, 0, 0 }, box;
    int led = 0;
    for (i = 0; i < inks; i += inks / 60 + 1)
        for (k = 0; k < 16; k++) {
            const double *at = (const double *)(const void *)frame->ink.data + 2 * (series->ink_end - 1 - i);
            double off = k < 8 ? 5 : 22, cost = 80.0 * (double)i / (double)inks + 2.0 * (double)(k % 8) + off;
            box.left = at[0] + side[k % 8][0] * (width / 2 + off + 3) - width / 2;
            box.top = at[1] + side[k % 8][1] * (height / 2 + off) - height / 2;
            box.right = box.left + width;
            box.bottom = box.top + height;
            cost += ploti_box_cost(frame, series, &box);
            if (cost < least) least = cost, best = box, from[0] = at[0], from[1] = at[1], led = k >= 8;
        }
    if (inks == 0) return;
    ploti_put_bytes(&frame->taken, &best, sizeof best);
    if (led)
        ploti_draw(frame->out, "<path d=\"M@ @L@ @\" stroke=\"~\"/>\n", from[0], from[1],
                   fmax(best.left, fmin(from[0], best.right)), fmax(best.top, fmin(from[1], best.bottom)),
                   series->color);
    ploti_text(frame->out, best.left, best.bottom - 5, PLOTI_HALO, ploti_text_color(series->color), series->label);
}

/* ---- Drawing ---- */

PLOT_API void ploti_stroke(plot_buffer *out, const plot_series *series, double width)
{
    static const char *const dash[4] = { "", " stroke-dasharray=\"11 8\"", " stroke-dasharray=\"1 7\"",
                                         " stroke-dasharray=\"14 7 1 7\"" };
    ploti_draw(
        out,
        " fill=\"none\" stroke=\"~\" stroke-width=\"@\" stroke-linejoin=\"round\" stroke-linecap=\"round\"^ d=\"",
        series->color, series->width > 0 ? series->width : width, dash[series->dash & 3]);
}

PLOT_API void ploti_marker(plot_buffer *out, int marker, double x, double y, int small)
{
    static const char *const shape[4] = { "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0z", "M-5-5h10v10h-10z",
                                          "M0-7l7 7l-7 7l-7-7z", "M0-7l6.5 11.5h-13z" };
    ploti_draw(out, "<path transform=\"translate(@ @)^\" stroke=\"none\" d=\"^\"/>\n", x, y,
               small ? " scale(.5)" : "", shape[marker & 3]);
}

PLOT_API void ploti_draw_points(ploti_frame *frame, const plot_series *series)
{
    size_t i;
    ploti_draw(frame->out, "<g fill=\"~\" stroke=\"~\" stroke-width=\"2\">\n", series->color, series->color);
    for (i = 0; i < series->count; i++) {
        double s[4], low, high;
        if (!ploti_usable(&frame->x, series->x[i]) || !ploti_usable(&frame->y, series->y[i])) continue;
        s[0] = s[2] = plot_at(&frame->x, series->x[i]), s[1] = s[3] = plot_at(&frame->y, series->y[i]);
        if (!ploti_clip(&frame->box, s)) continue;
        low = isnan(series->low[i]) ? s[1] : ploti_on_axis(&frame->y, series->low[i]);
        high = isnan(series->high[i]) ? s[1] : ploti_on_axis(&frame->y, series->high[i]);
        if (low - high > 1)
            ploti_draw(frame->out, "<path d=\"M@ @h10m-5 0V@m-5 0h10\"/>\n", s[0] - 5, low, high);
        ploti_marker(frame->out, series->marker, s[0], s[1], series->count > 200);
        for (; low > high + 4; low -= 4) ploti_add_ink(frame, s[0], low);
        ploti_add_ink(frame, s[0], s[1]);
    }
    ploti_put(frame->out, "</g>\n");
}

/* The filled area of a band or of steps, in pieces between values that are not finite. */
PLOT_API void ploti_draw_area(ploti_frame *frame, const plot_series *series, const char *clip)
{
    size_t from, to, i;
    for (from = 0; from < series->count; from = to + 1) {
        for (to = from; to < series->count; to++)
            if (!ploti_usable(&frame->x, series->x[to]) || !(fabs(series->low[to]) + fabs(series->high[to]) <= 1e300))
                break;
        if (to < from + 2) continue;
        ploti_draw(frame->out, "<path clip-path=\"url(#^)\" fill=\"~\" fill-opacity=\".3\" d=\"", clip,
                   series->color);
        for (i = from; i < to; i++)
            ploti_draw(frame->out, i == from ? "M@ @" : "L@ @", plot_at(&frame->x, series->x[i]),
                       ploti_on_axis(&frame->y, series->low[i]));
        for (i = to; i-- > from;)
            ploti_draw(frame->out, "L@ @", plot_at(&frame->x, series->x[i]),
                       ploti_on_axis(&frame->y, series->high[i]));
        ploti_put(frame->out, "Z\"/>\n");
    }
}

/* The bars of the series that is number `index` of `groups` under each name. */
PLOT_API void ploti_draw_bars(ploti_frame *frame, const plot_series *series, size_t index, size_t groups)
{
    double row = (frame->box.bottom - frame->box.top) / (double)frame->panel->bars,
           thick = 0.74 * row / (double)groups;
    size_t i;
    for (i = 0; i < series->count && i < frame->panel->bars; i++) {
        double top = frame->box.top + row * ((double)i + 0.13) + thick * (double)index, middle = top + 0.46 * thick;
        double base = ploti_on_axis(&frame->x, series->y[i]), end = ploti_on_axis(&frame->x, series->x[i]);
        double low = ploti_on_axis(&frame->x, series->low[i]), high = ploti_on_axis(&frame->x, series->high[i]);
        if (!ploti_usable(&frame->x, series->x[i])) continue;
        ploti_draw(frame->out, "<rect x=\"@\" y=\"@\" width=\"@\" height=\"@\" fill=\"~\"/>\n", fmin(base, end), top,
                   fabs(end - base), 0.92 * thick, series->color);
        if (!isnan(series->low[i]) && high - low > 1)
            ploti_draw(frame->out,
                       "<path d=\"M@ @v10m0-5H@m0-5v10\" fill=\"none\" stroke=\"#222\" stroke-width=\"2\"/>\n", low,
                       middle - 5, high);
    }
}

/* The stroke of lines, steps and rules. */
PLOT_API void ploti_draw_line(ploti_frame *frame, plot_series *series)
{
    double x[2], y[2];
    if (series->kind == PLOT_RULE_X || series->kind == PLOT_RULE_Y) {
        x[0] = series->x != NULL ? series->x[0] : frame->x.min,
        x[1] = series->x != NULL ? series->x[0] : frame->x.max;
        y[0] = series->y != NULL ? series->y[0] : frame->y.min,
        y[1] = series->y != NULL ? series->y[0] : frame->y.max;
        if (series->dash == 0) series->dash = 1;
    }
    ploti_put(frame->out, "<path");
    ploti_stroke(frame->out, series, series->kind == PLOT_LINE ? 3 : 1.5);
    if (series->kind == PLOT_LINE || series->kind == PLOT_STEPS)
        ploti_path(frame, series->x, series->y, series->count);
    else ploti_path(frame, x, y, 2);
    ploti_put(frame->out, "\"/>\n");
}

/* The ring of a note; a note outside the ranges is not drawn. */
PLOT_API void ploti_draw_note(ploti_frame *frame, const plot_series *series)
{
    double s[4];
    if (!ploti_usable(&frame->x, series->x[0]) || !ploti_usable(&frame->y, series->y[0])) return;
    s[0] = s[2] = plot_at(&frame->x, series->x[0]), s[1] = s[3] = plot_at(&frame->y, series->y[0]);
    if (!ploti_clip(&frame->box, s)) return;
    ploti_draw(frame->out, "<circle cx=\"@\" cy=\"@\" r=\"4\" fill=\"#fff\" stroke=\"~\" stroke-width=\"2\"/>\n",
               s[0], s[1], series->color);
    ploti_add_ink(frame, s[0], s[1]);
}

/* How many series of one kind a panel has. */
PLOT_API size_t ploti_count(const plot_panel *panel, int kind)
{
    const plot_series *series;
    size_t count = 0;
    for (series = panel->first; series != NULL; series = series->next) count += series->kind == kind;
    return count;
}

/* All series of one kind. `clip` is the id of the panel's clipping path. */
PLOT_API void ploti_draw_kind(ploti_frame *frame, int kind, const char *clip)
{
    size_t bars = 0, groups = frame->panel->stacked ? 1 : ploti_count(frame->panel, PLOT_BARS);
    plot_series *series;
    for (series = frame->panel->first; series != NULL; series = series->next) {
        if (series->kind != kind) continue;
        series->ink = frame->ink.size / (2 * sizeof(double));
        if (kind == PLOT_BAND || kind == PLOT_STEPS) ploti_draw_area(frame, series, clip);
        if (kind == PLOT_POINTS) ploti_draw_points(frame, series);
        else if (kind == PLOT_NOTE) ploti_draw_note(frame, series);
        else if (kind == PLOT_BARS) ploti_draw_bars(frame, series, bars++ % groups, groups);
        else if (kind != PLOT_BAND) ploti_draw_line(frame, series);
        series->ink_end = frame->ink.size / (2 * sizeof(double));
        series->end[0] = frame->pen[0], series->end[1] = frame->pen[1];
    }
}

/* The arrow that says in which corner the best are. */
PLOT_API void ploti_draw_better(ploti_frame *frame)
{
    double x = frame->box.left + 12, y = frame->box.bottom - 12;
    ploti_box box;
    if (frame->panel->better == NULL) return;
    box.left = x, box.right = x + 46 + ploti_width(frame->panel->better), box.top = y - 36, box.bottom = y;
    ploti_put_bytes(&frame->taken, &box, sizeof box);
    ploti_draw(frame->out, "<path d=\"M@ @l-30 30m-1-13v14h14\" fill=\"none\" stroke=\"#222\" stroke-width=\"3\"/>\n",
               x + 32, y - 32);
    ploti_text(frame->out, x + 42, y - 14, PLOTI_HALO | PLOTI_BOLD, 0x222222, frame->panel->better);
}

/* Grid lines at the ticks, and the words of one axis; words without room are left out. */
PLOT_API void ploti_draw_x_axis(const ploti_frame *frame)
{
    double taken = -1e9;
    char text[64];
    int i;
    for (i = 0; i < frame->x.ticks; i++) {
        double x = plot_at(&frame->x, frame->x.tick[i]),
               half = ploti_width(ploti_tick_text(&frame->x, i, text)) / 2 + 4;
        ploti_draw(frame->out, "<path d=\"M@ @V@\" stroke=\"^\"/>\n", x, frame->box.top, frame->box.bottom,
                   frame->x.tick[i] < 0 || frame->x.tick[i] > 0 ? "#ddd" : "#777");
        if (!frame->show_x || x - half < taken) continue;
        ploti_text(frame->out, x, frame->box.bottom + 20, PLOTI_MIDDLE, 0x222222, text);
        taken = x + half;
    }
}

PLOT_API void ploti_draw_y_axis(const ploti_frame *frame)
{
    char text[64];
    int i;
    size_t k;
    for (i = 0; i < frame->y.ticks; i++) {
        double y = plot_at(&frame->y, frame->y.tick[i]);
        ploti_draw(frame->out, "<path d=\"M@ @H@\" stroke=\"^\"/>\n", frame->box.left, y, frame->box.right,
                   frame->y.tick[i] < 0 || frame->y.tick[i] > 0 ? "#ddd" : "#777");
        if (frame->show_y)
            ploti_text(frame->out, frame->box.left - 8, y + 5.5, PLOTI_RIGHT, 0x222222,
                       ploti_tick_text(&frame->y, i, text));
    }
    for (k = 0; k < frame->panel->bars && frame->show_y; k++)
        ploti_text(frame->out, frame->box.left - 10,
                   frame->box.top +
                       (frame->box.bottom - frame->box.top) * ((double)k + 0.5) / (double)frame->panel->bars + 5,
                   PLOTI_RIGHT, 0x222222, frame->panel->names[k]);
}

/* The picture as large as the panel allows; returns the height it took. */
PLOT_API double ploti_draw_picture(const ploti_frame *frame)
{
    const plot_panel *panel = frame->panel;
    double width = frame->box.right - frame->box.left, height = frame->box.bottom - frame->box.top;
    double scale = fmin(width / (double)panel->picture_width, height / (double)panel->picture_height);
    double w = scale * (double)panel->picture_width, h = scale * (double)panel->picture_height;
    ploti_draw(frame->out,
               "<image x=\"@\" y=\"@\" width=\"@\" height=\"@\" style=\"image-rendering:pixelated\" "
               "href=\"data:image/png;base64,^\"/>\n",
               frame->box.left + (width - w) / 2, frame->box.top, w, h, panel->picture);
    return h;
}

/* ---- The sheet ---- */

typedef struct {
    plot_chart *chart;
    const char *id;
    size_t rows, columns;
    double width, height, head, plot_width, plot_height;
    double left[PLOT_PANELS], right[PLOT_PANELS];  /* margins of the columns */
    double above[PLOT_PANELS], below[PLOT_PANELS]; /* strips of the rows: title and y label, ticks and x label */
    ploti_frame frame[PLOT_PANELS];
} ploti_sheet;

PLOT_API int ploti_empty(const plot_panel *panel)
{
    return panel->first == NULL && panel->picture == NULL;
}

/* What the axes of a panel have to cover. Bars and steps begin at 0. */
PLOT_API void ploti_cover_panel(ploti_frame *frame)
{
    const double zero = 0;
    const plot_series *series;
    frame->x.log = frame->panel->x_log;
    frame->y.log = frame->panel->y_log;
    frame->x.min = frame->x.max = frame->y.min = frame->y.max = (double)NAN;
    for (series = frame->panel->first; series != NULL; series = series->next) {
        plot_axis *value = series->kind == PLOT_BARS ? &frame->x : &frame->y;
        if (series->kind == PLOT_NOTE) continue;
        ploti_cover(&frame->x, series->x, series->count);
        ploti_cover(value, series->y, series->count);
        ploti_cover(value, series->low, series->count);
        ploti_cover(value, series->high, series->count);
        if (series->kind == PLOT_STEPS || series->kind == PLOT_BARS) ploti_cover(value, &zero, 1);
    }
}

/* The ranges of all panels. Where an axis is shared, the first panel with series decides on its logarithm and limits.
   */
PLOT_API void ploti_ranges(ploti_sheet *sheet)
{
    ploti_frame *first = NULL, *frame;
    size_t k;
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        frame = &sheet->frame[k];
        frame->panel = &sheet->chart->panel[k];
        ploti_cover_panel(frame);
        if (first == NULL && frame->panel->first != NULL) first = frame;
        if (first == NULL) continue;
        if (sheet->chart->share_x) ploti_cover(&first->x, &frame->x.min, 1), ploti_cover(&first->x, &frame->x.max, 1);
        if (sheet->chart->share_y) ploti_cover(&first->y, &frame->y.min, 1), ploti_cover(&first->y, &frame->y.max, 1);
    }
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        plot_panel *panel = &sheet->chart->panel[k];
        frame = &sheet->frame[k];
        ploti_range(&frame->x, panel->x_min, panel->x_max,
                    panel->bars + ploti_count(panel, PLOT_POINTS) > 0 ? 0.04 : 0);
        ploti_range(&frame->y, panel->y_min, panel->y_max, 0.05);
        if (sheet->chart->share_x && first != NULL) frame->x = first->x;
        if (sheet->chart->share_y && first != NULL) frame->y = first->y;
    }
}

/* Draws every labelled line once on a board of 1000 x 1000 to see which run to the right edge. */
PLOT_API void ploti_find_edges(ploti_frame *frame)
{
    plot_buffer scratch = { NULL, 0, 0, 0 };
    plot_series *series;
    frame->out = &scratch;
    frame->box.right = frame->box.bottom = frame->x.to = frame->y.from = 1000;
    for (series = frame->panel->first; series != NULL; series = series->next) {
        if (series->kind != PLOT_LINE || series->label == NULL || ploti_in_key(series)) continue;
        ploti_path(frame, series->x, series->y, series->count);
        series->at_edge = frame->pen[0] > 985 || (frame->pen[0] > 940 && frame->pen[1] > 5 && frame->pen[1] < 995);
    }
    ploti_drop(&scratch);
    ploti_drop(&frame->ink);
}

/* A small picture of how a series is drawn, 30 pixels wide around the height y. */
PLOT_API void ploti_key_sign(plot_buffer *out, const plot_series *series, double x, double y)
{
    if (series->kind < PLOT_RULE_X)
        ploti_draw(out, "<rect x=\"@\" y=\"@\" width=\"30\" height=\"14\" fill=\"~\" fill-opacity=\"@\"/>\n", x,
                   y - 7, series->color, series->kind == PLOT_BARS ? 1 : 0.35);
    else if (series->kind == PLOT_POINTS) {
        ploti_draw(out, "<g fill=\"~\" stroke=\"~\" stroke-width=\"2\">\n", series->color, series->color);
        if (series->count > 0 && series->high[0] > series->low[0])
            ploti_draw(out, "<path d=\"M@ @h10m-5 0v20m-5 0h10\"/>\n", x + 10, y - 10);
        ploti_marker(out, series->marker, x + 15, y, 0);
        ploti_put(out, "</g>\n");
    } else {
        ploti_put(out, "<path");
        ploti_stroke(out, series, 3);
        ploti_draw(out, "M@ @h30\"/>\n", x, y);
    }
}

/* The key: each label once, in rows; returns the height. `out` may be NULL. */
PLOT_API double ploti_key(const ploti_sheet *sheet, plot_buffer *out, double top)
{
    enum { MOST = 64 };
    const plot_series *seen[MOST], *series;
    double x = 14, y = top + 10;
    size_t k, count = 0, i;
    for (k = 0; k < sheet->rows * sheet->columns; k++)
        for (series = sheet->chart->panel[k].first; series != NULL; series = series->next) {
            double width = 40 + ploti_width(series->label);
            if (!ploti_in_key(series) || count == MOST) continue;
            for (i = 0; i < count && strcmp(seen[i]->label, series->label) != 0; i++) {}
            if (i < count) continue;
            seen[count++] = series;
            if (x > 14 && x + width > sheet->width - 14) x = 14, y += 24;
            if (out != NULL) ploti_key_sign(out, series, x, y);
            if (out != NULL) ploti_text(out, x + 38, y + 5.5, 0, 0x222222, series->label);
            x += width + 24;
        }
    return count > 0 ? y + 22 - top : 0;
}

/* Title, note and key; returns their height. */
PLOT_API double ploti_head(const ploti_sheet *sheet, plot_buffer *out)
{
    double y = 10;
    y += ploti_paragraph(out, 14, y + PLOTI_TITLE, sheet->width - 28, PLOTI_TITLE, PLOTI_BOLD, sheet->chart->title);
    y += ploti_paragraph(out, 14, y + PLOTI_TEXT + 2, sheet->width - 28, PLOTI_TEXT, 0, sheet->chart->note) + 10;
    return y + ploti_key(sheet, out, y);
}

/* Which panels show the words of their axes, and the strips that titles and words, wrapped at `width`, take above and
   below each row. */
PLOT_API void ploti_strips(ploti_sheet *sheet, double width)
{
    const plot_chart *chart = sheet->chart;
    double above, below;
    size_t k, row;
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        const plot_panel *panel = &chart->panel[k];
        ploti_frame *frame = &sheet->frame[k];
        if (ploti_empty(panel)) continue;
        row = k / sheet->columns;
        frame->show_x = panel->picture != NULL || !chart->share_x || row + 1 == sheet->rows ||
                        ploti_empty(panel + sheet->columns);
        frame->show_y = panel->picture == NULL && (!chart->share_y || k % sheet->columns == 0);
        above = 12 + ploti_paragraph(NULL, 0, 0, width, PLOTI_TEXT, 0, panel->title);
        if (frame->show_y) above += ploti_paragraph(NULL, 0, 0, width, PLOTI_TEXT, 0, panel->y_label);
        below = 22;
        if (frame->show_x) below += 20 + ploti_paragraph(NULL, 0, 0, width, PLOTI_TEXT, 0, panel->x_label);
        sheet->above[row] = fmax(sheet->above[row], above);
        sheet->below[row] = fmax(sheet->below[row], below);
    }
}

/* The height that a panel would like, in a cell of the given width. */
PLOT_API double ploti_wish(const plot_panel *panel, double cell)
{
    size_t groups = panel->stacked ? 1 : ploti_count(panel, PLOT_BARS);
    if (ploti_empty(panel)) return 0;
    if (panel->picture != NULL) return (cell - 40) * (double)panel->picture_height / (double)panel->picture_width;
    return panel->bars > 0 ? (double)panel->bars * (22.0 * (double)groups + 24) : fmax(230, fmin(0.6 * cell, 430));
}

/* Divides the height among the rows, then the width among the columns. */
PLOT_API void ploti_divide(ploti_sheet *sheet)
{
    double strips = 0, wish = 60, margins = 0;
    char text[64];
    size_t k, i;
    int t;
    for (k = 0; k < sheet->rows; k++) strips += sheet->above[k] + sheet->below[k];
    for (k = 0; k < sheet->columns; k++) sheet->left[k] = sheet->right[k] = 0;
    for (k = 0; k < sheet->rows * sheet->columns; k++)
        wish = fmax(wish, ploti_wish(&sheet->chart->panel[k], sheet->width / (double)sheet->columns));
    if (sheet->height > 0) wish = fmax(60, (sheet->height - sheet->head - strips) / (double)sheet->rows);
    sheet->plot_height = wish;
    sheet->height = sheet->head + strips + wish * (double)sheet->rows;
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        ploti_frame *frame = &sheet->frame[k];
        const plot_series *series = frame->panel->first;
        double left = 14, right = 26;
        if (ploti_empty(frame->panel)) continue;
        if (frame->panel->bars == 0)
            frame->y.ticks =
                plot_ticks(frame->y.min, frame->y.max, frame->y.log, (int)(wish / 55) + 1, frame->y.tick);
        for (t = 0; t < frame->y.ticks && frame->show_y; t++)
            left = fmax(left, 22 + ploti_width(ploti_tick_text(&frame->y, t, text)));
        for (i = 0; i < frame->panel->bars && frame->show_y; i++)
            left = fmax(left, 24 + ploti_width(frame->panel->names[i]));
        for (; series != NULL; series = series->next)
            if (series->at_edge) right = fmax(right, 28 + ploti_width(series->label));
        i = k % sheet->columns;
        margins -= sheet->left[i] + sheet->right[i];
        sheet->left[i] = fmax(sheet->left[i], left);
        sheet->right[i] = fmax(sheet->right[i], right);
        margins += sheet->left[i] + sheet->right[i];
    }
    sheet->plot_width = fmax(60, (sheet->width - margins) / (double)sheet->columns);
}

/* Draws panel k with the upper left corner of its cell at (left, top). */
PLOT_API void ploti_draw_panel(ploti_sheet *sheet, size_t k, double left, double top, plot_buffer *out)
{
    ploti_frame *frame = &sheet->frame[k];
    ploti_box *box = &frame->box;
    const plot_series *series;
    double width = sheet->plot_width + 20, label, low;
    char clip[96];
    int kind;
    frame->out = out;
    box->left = frame->x.from = left + sheet->left[k % sheet->columns];
    box->right = frame->x.to = box->left + sheet->plot_width;
    box->top = frame->y.to = top + sheet->above[k / sheet->columns];
    box->bottom = low = frame->y.from = box->top + sheet->plot_height;
    ploti_paragraph(out, box->left, top + PLOTI_TEXT, width, PLOTI_TEXT, PLOTI_BOLD, frame->panel->title);
    if (frame->panel->picture != NULL) low = box->top + ploti_draw_picture(frame) - 20;
    if (frame->show_x)
        ploti_paragraph(out, (box->left + box->right) / 2, low + 44, width, PLOTI_TEXT, PLOTI_MIDDLE,
                        frame->panel->x_label);
    if (frame->panel->picture != NULL) return;
    label = ploti_paragraph(NULL, 0, 0, width, PLOTI_TEXT, 0, frame->panel->y_label);
    if (frame->show_y)
        ploti_paragraph(out, left + 14, box->top + 12 - label, width, PLOTI_TEXT, 0, frame->panel->y_label);
    snprintf(clip, sizeof clip, "%s-clip%d", sheet->id, (int)k);
    ploti_draw(out, "<clipPath id=\"^\"><rect x=\"@\" y=\"@\" width=\"@\" height=\"@\"/></clipPath>\n", clip,
               box->left, box->top, sheet->plot_width, sheet->plot_height);
    frame->x.ticks =
        plot_ticks(frame->x.min, frame->x.max, frame->x.log, (int)(sheet->plot_width / 65) + 1, frame->x.tick);
    ploti_draw_x_axis(frame);
    ploti_draw_y_axis(frame);
    for (kind = PLOT_BAND; kind < PLOTI_KINDS; kind++) ploti_draw_kind(frame, kind, clip);
    ploti_draw(out, "<path d=\"M@ @V@H@\" fill=\"none\" stroke=\"#222\"/>\n", box->left, box->top, box->bottom,
               box->right);
    ploti_draw_better(frame);
    ploti_edge_labels(frame);
    for (series = frame->panel->first; series != NULL && !frame->ink.failed; series = series->next)
        if (series->label != NULL && !series->at_edge && !ploti_in_key(series)) ploti_inner_label(frame, series);
    out->failed |= frame->ink.failed | frame->taken.failed;
    ploti_drop(&frame->ink);
    ploti_drop(&frame->taken);
}

/* A text without markup, for <title> and <desc>. */
PLOT_API void ploti_say(plot_buffer *out, const char *before, const char *text)
{
    if (text == NULL) return;
    ploti_put(out, before);
    ploti_write(out, text, strlen(text), 1, 0);
}

/* The whole file: opening, words for those who do not see it, white ground, head, panels. */
PLOT_API void ploti_draw_sheet(ploti_sheet *sheet, plot_buffer *out)
{
    const plot_panel *panel = sheet->chart->panel;
    double top = sheet->head, left = 0;
    size_t k, column;
    ploti_draw(out,
               "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"@\" height=\"@\" viewBox=\"0 0 @ @\" role=\"img\" "
               "aria-labelledby=\"^-title ^-desc\" xml:space=\"preserve\" font-family=\"Helvetica, Arial, "
               "'Liberation Sans', "
               "'DejaVu Sans', sans-serif\">\n<title id=\"^-title\">",
               sheet->width, sheet->height, sheet->width, sheet->height, sheet->id, sheet->id, sheet->id);
    ploti_say(out, "", sheet->chart->title);
    ploti_draw(out, "</title>\n<desc id=\"^-desc\">", sheet->id);
    ploti_say(out, "", sheet->chart->note);
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        ploti_say(out, "\nPanel: ", panel[k].title);
        ploti_say(out, "\nUp: ", panel[k].y_label);
        ploti_say(out, "\nTo the right: ", panel[k].x_label);
    }
    ploti_draw(out, "</desc>\n<rect width=\"@\" height=\"@\" fill=\"#fff\"/>\n", sheet->width, sheet->height);
    ploti_head(sheet, out);
    for (k = 0; k < sheet->rows * sheet->columns; k++) {
        column = k % sheet->columns;
        if (k > 0 && column == 0)
            top += sheet->above[k / sheet->columns - 1] + sheet->plot_height + sheet->below[k / sheet->columns - 1];
        left = column == 0 ? 0 : left + sheet->left[column - 1] + sheet->plot_width + sheet->right[column - 1];
        if (!ploti_empty(&panel[k])) ploti_draw_panel(sheet, k, left, top, out);
    }
    ploti_put(out, "</svg>\n");
}

/* The file's base name as the beginning of all ids in it, so that several charts can stand in one page. */
PLOT_API void ploti_id(const char *path, char id[64])
{
    const char *base = strrchr(path, '/') != NULL ? strrchr(path, '/') + 1 : path;
    size_t i, length = strcspn(base, ".");
    snprintf(id, 64, "plot-%.*s", (int)(length < 50 ? length : 50), base);
    for (i = 0; id[i] != 0; i++)
        if (strchr("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-", id[i]) == NULL) id[i] = '_';
}

/* Draws the chart, writes it to `path` whole or not at all, and releases it. Missing folders are made. Returns 0, or
   1 after a message on stderr. */
PLOT_API int plot_save(plot_chart *chart, const char *path)
{
    ploti_sheet *sheet = (ploti_sheet *)calloc(1, sizeof *sheet);
    plot_buffer out = { NULL, 0, 0, 0 };
    size_t k, rows = chart->rows > 0 ? chart->rows : 1, columns = chart->columns > 0 ? chart->columns : 1;
    char id[64];
    int status = 1, failed = sheet == NULL;
    ploti_id(path, id);
    for (k = 0; k < PLOT_PANELS; k++) failed |= chart->panel[k].failed;
    if (failed) ploti_complain(path, "out of memory, or a picture is empty or too large");
    else if (rows > PLOT_PANELS / columns) ploti_complain(path, "too many panels");
    else {
        sheet->chart = chart;
        sheet->id = id;
        sheet->rows = rows;
        sheet->columns = columns;
        sheet->width = chart->width > 0 ? chart->width : 960;
        sheet->height = chart->height;
        ploti_ranges(sheet);
        for (k = 0; k < rows * columns; k++) ploti_find_edges(&sheet->frame[k]);
        sheet->head = ploti_head(sheet, NULL);
        /* The width of the panels follows from the strips, and their words wrap at that width: twice settles it */
        ploti_strips(sheet, sheet->width / (double)columns - 40);
        ploti_divide(sheet);
        ploti_strips(sheet, sheet->plot_width + 20);
        sheet->height = chart->height;
        ploti_divide(sheet);
        ploti_draw_sheet(sheet, &out);
        status = ploti_write_file(path, &out);
    }
    ploti_drop(&out);
    free(sheet);
    plot_free(chart);
    return status;
}

/* ---- Pictures: PNG (RFC 2083) in deflate (RFC 1951) with its fixed codes, which shorten runs ---- */

/* Bits, the first into the lowest place of a byte. */
typedef struct {
    plot_buffer *out;
    uint32_t bits;
    int count;
} ploti_bits;

PLOT_API void ploti_put_bits(ploti_bits *to, uint32_t bits, int count)
{
    to->bits |= bits << to->count;
    for (to->count += count; to->count >= 8; to->count -= 8, to->bits >>= 8) {
        unsigned char byte = (unsigned char)(to->bits & 255);
        ploti_put_bytes(to->out, &byte, 1);
    }
}

/* A literal byte or a length symbol in the fixed code (RFC 1951, 3.2.6); codes go out with the highest bit first. */
PLOT_API void ploti_put_symbol(ploti_bits *to, uint32_t symbol)
{
    int count = symbol < 144 ? 8 : symbol < 256 ? 9 : symbol < 280 ? 7 : 8;
    uint32_t first = symbol < 144 ? 0 : symbol < 256 ? 144 : symbol < 280 ? 256 : 280;
    uint32_t code = symbol - first + (symbol < 144 ? 0x30 : symbol < 256 ? 0x190 : symbol < 280 ? 0 : 0xc0);
    while (count-- > 0) ploti_put_bits(to, code >> count & 1, 1);
}

/* "Repeat the last byte `length` times", 3..257 (RFC 1951, 3.2.5: four symbols for each number of extra bits). */
PLOT_API void ploti_put_run(ploti_bits *to, uint32_t length)
{
    uint32_t rest = length - 3;
    int extra = 0;
    while (rest >> extra >= 8) extra++;
    ploti_put_symbol(to, 257 + 4 * (uint32_t)extra + (rest >> extra));
    ploti_put_bits(to, rest & ((1u << extra) - 1), extra);
    ploti_put_bits(to, 0, 5);
}

PLOT_API void ploti_put_32(plot_buffer *out, uint32_t value)
{
    int shift;
    for (shift = 24; shift >= 0; shift -= 8) {
        unsigned char byte = (unsigned char)(value >> shift & 255);
        ploti_put_bytes(out, &byte, 1);
    }
}

/* One block of literals and runs in zlib's wrapping (RFC 1950) with its checksum, Adler's. */
PLOT_API void ploti_deflate(plot_buffer *out, const unsigned char *data, size_t size)
{
    ploti_bits to = { NULL, 0, 0 };
    uint32_t a = 1, b = 0;
    size_t i, k;
    to.out = out;
    ploti_put_bytes(out, "\x78\x01", 2);
    ploti_put_bits(&to, 3, 3);
    for (i = 0; i < size;) {
        for (k = i; i > 0 && k < size && k < i + 257 && data[k] == data[i - 1]; k++) {}
        if (k >= i + 3) ploti_put_run(&to, (uint32_t)(k - i));
        else ploti_put_symbol(&to, data[k = i]), k++;
        for (; i < k; i++) a = (a + data[i]) % 65521, b = (b + a) % 65521;
    }
    ploti_put_symbol(&to, 256);
    ploti_put_bits(&to, 0, 7);
    ploti_put_32(out, b << 16 | a);
}

/* A chunk: length, name, bytes, and the CRC of name and bytes. */
PLOT_API void ploti_put_chunk(plot_buffer *out, const char *name, const plot_buffer *bytes)
{
    uint32_t crc = 0xffffffffu;
    size_t i = out->size + 4;
    int bit;
    if (bytes->failed || bytes->size > 0x7fffffff) out->failed = 1;
    ploti_put_32(out, (uint32_t)bytes->size);
    ploti_put(out, name);
    ploti_put_bytes(out, bytes->data, bytes->size);
    for (; !out->failed && i < out->size; i++)
        for (crc ^= (unsigned char)out->data[i], bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
    ploti_put_32(out, crc ^ 0xffffffffu);
}

/* The PNG file of a picture, its rows as differences to the left neighbour (filter 1); fails for empty and huge ones.
   */
PLOT_API void ploti_png(plot_buffer *out, size_t width, size_t height, int channels, const unsigned char *pixel)
{
    plot_buffer head = { NULL, 0, 0, 0 }, rows = head, packed = head, none = head;
    size_t step = channels == 1 ? 1 : 3, row, i;
    if (width == 0 || height == 0 || width > 100000000 || height > 1000000000 / (width * step)) {
        out->failed = 1;
        return;
    }
    for (row = 0; row < height; row++) {
        const unsigned char *at = pixel + row * width * step;
        ploti_put_bytes(&rows, "\x01", 1);
        for (i = 0; i < width * step; i++) {
            unsigned char byte = (unsigned char)(i < step ? at[i] : at[i] - at[i - step]);
            ploti_put_bytes(&rows, &byte, 1);
        }
    }
    ploti_put_32(&head, (uint32_t)width);
    ploti_put_32(&head, (uint32_t)height);
    ploti_put_bytes(&head, step == 1 ? "\x08\0\0\0\0" : "\x08\x02\0\0\0", 5);
    packed.failed = rows.failed;
    if (!rows.failed) ploti_deflate(&packed, (const unsigned char *)(const void *)rows.data, rows.size);
    ploti_put_bytes(out, "\x89PNG\r\n\x1a\n", 8);
    ploti_put_chunk(out, "IHDR", &head);
    ploti_put_chunk(out, "IDAT", &packed);
    ploti_put_chunk(out, "IEND", &none);
    ploti_drop(&head);
    ploti_drop(&rows);
    ploti_drop(&packed);
}

/* Writes a picture of 1 (grey) or 3 (red, green, blue) bytes a pixel, the top row first, as PNG, whole or not at all.
   Returns 0, or 1 after a message. */
PLOT_API int plot_png(const char *path, size_t width, size_t height, int channels, const unsigned char *pixel)
{
    plot_buffer out = { NULL, 0, 0, 0 };
    int status;
    ploti_png(&out, width, height, channels, pixel);
    if (out.failed) status = ploti_complain(path, "the picture is empty, too large, or memory is out");
    else status = ploti_write_file(path, &out);
    ploti_drop(&out);
    return status;
}

/* Linear values as sRGB bytes (IEC 61966-2-1), brighter by `exposure` stops (0: as they are), from malloc; NULL
   without memory. What is not positive is black, but NaN becomes magenta in a colored picture, so that it is seen. */
PLOT_API unsigned char *plot_bytes(size_t width, size_t height, int channels, const double *linear, double exposure)
{
    size_t step = channels == 1 ? 1 : 3, i;
    unsigned char *bytes = NULL;
    if (width > 0 && height < SIZE_MAX / 3 / width) bytes = (unsigned char *)malloc(width * height * step + 1);
    for (i = 0; bytes != NULL && i < width * height * step; i++) {
        double v = linear[i] * pow(2, exposure);
        v = v > 0.0031308 ? 1.055 * pow(fmin(v, 1), 1 / 2.4) - 0.055 : v > 0 ? 12.92 * v : 0;
        bytes[i] = (unsigned char)(255 * v + 0.5);
    }
    for (i = 0; bytes != NULL && step == 3 && i < width * height * 3; i += 3)
        if (isnan(linear[i] + linear[i + 1] + linear[i + 2])) bytes[i] = bytes[i + 2] = 255, bytes[i + 1] = 0;
    return bytes;
}

/* plot_png of linear values, through plot_bytes. */
PLOT_API int plot_png_linear(const char *path, size_t width, size_t height, int channels, const double *linear,
                                  double exposure)
{
    unsigned char *bytes = plot_bytes(width, height, channels, linear, exposure);
    int status =
        bytes != NULL ? plot_png(path, width, height, channels, bytes) : ploti_complain(path, "out of memory");
    free(bytes);
    return status;
}

/* Makes the panel a picture: its pixels stand in the chart as squares, title above, x_label below. */
PLOT_API void plot_picture(plot_panel *panel, size_t width, size_t height, int channels, const unsigned char *pixel)
{
    static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    plot_buffer png = { NULL, 0, 0, 0 };
    size_t i, k;
    char *text = NULL;
    ploti_png(&png, width, height, channels, pixel);
    panel->failed |= png.failed;
    if (!png.failed) text = (char *)ploti_keep(panel, NULL, png.size / 3 + 1, 4);
    for (i = 0; text != NULL && i < png.size; i += 3) {
        uint32_t three = 0;
        for (k = 0; k < 3; k++) three = three << 8 | (i + k < png.size ? (unsigned char)png.data[i + k] : 0u);
        for (k = 0; k < 4; k++) text[i / 3 * 4 + k] = i + k > png.size ? '=' : digit[three >> (18 - 6 * k) & 63];
    }
    panel->picture = text;
    panel->picture_width = width;
    panel->picture_height = height;
    ploti_drop(&png);
}

/* ---- The run ---- */

/* Shows how far a run is (0..1) and at what, on stderr and only if that is a terminal; 1 clears the line. */
PLOT_API void plot_progress(double fraction, const char *what)
{
    static int shown = -1;
    int percent = fraction > 0 ? fraction < 1 ? (int)(100 * fraction) : 100 : 0;
    if (percent == shown || !isatty(2)) return;
    shown = percent;
    if (percent < 100)
        fprintf(stderr, "\r[%-25.*s] %3d %% %.40s\033[K", percent / 4, "#########################", percent, what);
    else fprintf(stderr, "\r\033[K");
    fflush(stderr);
}

/* Nonzero if the environment asks for small sizes: QUICK is set, and neither to nothing nor to 0. */
PLOT_API int plot_quick(void)
{
    const char *text = getenv("QUICK");
    return text != NULL && text[0] != 0 && strcmp(text, "0") != 0;
}

/* Seconds on the wall since some fixed moment, to a microsecond: for charts of error against time. */
PLOT_API double plot_seconds(void)
{
    struct timeval now;
    gettimeofday(&now, NULL);
    return (double)now.tv_sec + 1e-6 * (double)now.tv_usec;
}

#undef PLOT_API
#undef PLOTI_TITLE
#undef PLOTI_TEXT
#undef PLOTI_SMALL
#undef PLOTI_LINE
#endif
