/* claims.c: what the paper says, against what was measured. Every statement of the paper that can be tested, section
   by section, with the measurement and its error from the tables that the other programs have written, and a verdict:

   - reproduced, or refuted: the measured number lies on the side of a bound that the statement asks for, or on the
     other, by more than three standard errors;
   - true only if: the statement holds in one case and fails in another, each by that much;
   - undecided: the error is too large to say; a longer run may know;
   - not measured: a table is missing, and the words say which program writes it.

   No verdict stands in this file: each row has a function that compares, and may come out either way. To add a row,
   write such a function, give it a line in the list at the end, and a line in docs/claims.md.

   Reads the tables in out/, or in another folder: build/claims FOLDER. Writes claims.csv there, with the number that
   decided, its error and its bound (nan: none), and prints the table. */
#include "plot.h"
#include <ctype.h>

#define NONE ((double)NAN)

enum { SIGMAS = 3, TABLES = 24 };

/* ---- Tables ---- */

/* A table in memory: row 0 is the header, and field[row * columns + column] a text. */
typedef struct {
    char name[40];
    char *bytes;
    const char **field;
    size_t columns, rows;
} table;

static const char *folder = "out";
static table tables[TABLES];
static size_t table_count;

/* The bytes of a file and a closing zero, or NULL. */
static char *file_read(const char *name)
{
    char path[300], *bytes = NULL;
    FILE *file;
    long size;
    snprintf(path, sizeof path, "%s/%s", folder, name);
    file = fopen(path, "rb");
    if (file == NULL) return NULL;
    if (fseek(file, 0, SEEK_END) == 0 && (size = ftell(file)) > 0 && fseek(file, 0, SEEK_SET) == 0) {
        bytes = (char *)malloc((size_t)size + 1);
        if (bytes != NULL) bytes[fread(bytes, 1, (size_t)size, file)] = 0;
    }
    fclose(file);
    return bytes;
}

static size_t count_of(const char *text, char what)
{
    size_t n = 0;
    for (; *text != 0; text++) n += *text == what;
    return n;
}

/* Cuts the bytes at commas and ends of lines; fields that a row does not have are empty. */
static int table_cut(table *t)
{
    size_t lines = count_of(t->bytes, '\n') + 1, r, c;
    char *at = t->bytes, *end;
    t->columns = 1;
    for (; *at != 0 && *at != '\n'; at++) t->columns += *at == ',';
    t->field = (const char **)malloc(lines * t->columns * sizeof *t->field);
    if (t->field == NULL) return 0;
    for (r = 0, at = t->bytes; *at != 0; r++) {
        end = at + strcspn(at, "\n");
        if (*end != 0) *end++ = 0;
        if (end - at > 1 && end[-2] == '\r') end[-2] = 0;
        for (c = 0; c < t->columns; c++) {
            size_t size = strcspn(at, ",");
            t->field[r * t->columns + c] = at;
            if (at[size] != 0) at[size++] = 0;
            at += size;
        }
        at = end;
    }
    t->rows = r;
    return 1;
}

/* The table, read once; NULL when the file is not there. */
static const table *table_of(const char *name)
{
    table *t;
    size_t i;
    for (i = 0; i < table_count; i++)
        if (strcmp(tables[i].name, name) == 0) return tables[i].bytes != NULL ? &tables[i] : NULL;
    if (table_count == TABLES) return NULL;
    t = &tables[table_count++];
    snprintf(t->name, sizeof t->name, "%s", name);
    t->bytes = file_read(name);
    if (t->bytes == NULL || table_cut(t)) return t->bytes != NULL ? t : NULL;
    free(t->bytes);
    t->bytes = NULL;
    return NULL;
}

static void tables_free(void)
{
    size_t i;
    for (i = 0; i < table_count; i++) {
        free(tables[i].bytes);
        free((void *)tables[i].field);
    }
}

static size_t column_of(const table *t, const char *name, size_t size)
{
    size_t c;
    for (c = 0; c < t->columns; c++)
        if (strlen(t->field[c]) == size && strncmp(t->field[c], name, size) == 0) break;
    return c;
}

/* Whether a cell is `size` characters of text, or the same number. */
static int cell_is(const char *cell, const char *text, size_t size)
{
    char *cell_end, *text_end;
    double a = strtod(cell, &cell_end), b = strtod(text, &text_end);
    if (strlen(cell) == size && strncmp(cell, text, size) == 0) return 1;
    return cell_end > cell && *cell_end == 0 && text_end == text + size && a == b;
}

/* Whether a row fits "column=value&column=value"; "" fits every row. */
static int row_fits(const table *t, size_t row, const char *query)
{
    while (*query != 0) {
        size_t name = strcspn(query, "="), size, c = column_of(t, query, name);
        const char *value = query + name + (query[name] != 0);
        size = strcspn(value, "&");
        if (c == t->columns || !cell_is(t->field[row * t->columns + c], value, size)) return 0;
        query = value + size + (value[size] != 0);
    }
    return 1;
}

/* The next row after `row` that fits; 0 when there is none. Begin with row 0, which is the header. */
static size_t row_next(const table *t, size_t row, const char *query)
{
    for (row++; row < t->rows; row++)
        if (row_fits(t, row, query)) return row;
    return 0;
}

static size_t row_last(const table *t, const char *query)
{
    size_t row = 0, next;
    while ((next = row_next(t, row, query)) > 0) row = next;
    return row;
}

/* The number in a cell; NaN where there is none. */
static double number(const table *t, size_t row, const char *column)
{
    size_t c = column_of(t, column, strlen(column));
    char *end;
    double value;
    if (row == 0 || c == t->columns) return NONE;
    value = strtod(t->field[row * t->columns + c], &end);
    return end > t->field[row * t->columns + c] ? value : NONE;
}

/* The number in the first row that fits. */
static double pick(const table *t, const char *query, const char *column)
{
    return number(t, row_next(t, 0, query), column);
}

/* ---- Verdicts ---- */

typedef enum { NOT_MEASURED, UNDECIDED, REPRODUCED, REFUTED, ONLY_IF, OUTCOMES } outcome;

static const char *const outcome_name[OUTCOMES] = { "not measured", "undecided", "reproduced", "refuted",
                                                    "true only if" };

typedef struct {
    outcome is;
    double value, error, bound; /* what decided */
    char condition[60];         /* of ONLY_IF */
    char words[240];            /* the measurement */
} finding;

/* 1 if value is above the bound by more than its error lets one doubt, -1 if below, 0 if one cannot say. */
static int compare(double value, double error, double bound)
{
    if (value - bound > SIGMAS * error) return 1;
    if (bound - value > SIGMAS * error) return -1;
    return 0;
}

/* The statement asks for a value above the bound (side 1) or below it (side -1). */
static outcome judge(double value, double error, double bound, int side)
{
    int is = compare(value, error, bound) * side;
    if (isnan(value) || isnan(error) || isnan(bound)) return NOT_MEASURED;
    return is > 0 ? REPRODUCED : is < 0 ? REFUTED : UNDECIDED;
}

/* The statement asks for one value, which the measurement must know to within `precision`. */
static outcome judge_equal(double value, double error, double bound, double precision)
{
    if (isnan(value) || isnan(error) || isnan(bound)) return NOT_MEASURED;
    if (compare(value, error, bound) != 0) return REFUTED;
    return SIGMAS * error <= precision ? REPRODUCED : UNDECIDED;
}

/* The statement was judged in two cases. One in which it fails refutes it, unless it holds in the first: then it is
   true only if `condition`. */
static outcome judge_both(outcome first, outcome second, const char *condition, finding *f)
{
    snprintf(f->condition, sizeof f->condition, "%s", condition);
    if (first == NOT_MEASURED || second == NOT_MEASURED) return NOT_MEASURED;
    if (first == REPRODUCED && second == REPRODUCED) return REPRODUCED;
    if (first == REPRODUCED && second == REFUTED) return ONLY_IF;
    return first == REFUTED || second == REFUTED ? REFUTED : UNDECIDED;
}

static void decide(finding *f, double value, double error, double bound)
{
    f->value = value;
    f->error = error;
    f->bound = bound;
}

/* Scores of a theory against experiments: how many, the mean of their squares, and the largest. */
typedef struct {
    double count, square, worst;
} scores;

static scores scores_of(const table *t, const char *query, const char *column)
{
    scores s = { 0, 0, 0 };
    size_t row = 0;
    while ((row = row_next(t, row, query)) > 0) {
        double score = number(t, row, column);
        if (isnan(score)) continue;
        s.count++;
        s.square += (score * score - s.square) / s.count;
        s.worst = fmax(s.worst, fabs(score));
    }
    return s;
}

/* A theory agrees if the largest score is one that chance exceeds at most once in a thousand tables. That holds for
   scores that depend on each other, too, since often the same chains are looked at after several steps; what the mean
   of their squares should be does not. */
static outcome judge_scores(const scores *s, finding *f)
{
    double most = sqrt(2 * log(1000 * s->count));
    decide(f, s->worst, 0, most);
    return s->count > 0 ? judge(s->worst, 0, most, -1) : NOT_MEASURED;
}

/* The error of a quotient. */
static double ratio_error(double a, double a_error, double b, double b_error)
{
    return fabs(a / b) * hypot(a_error / a, b_error / b);
}

/* ---- Section 1: the algorithm ---- */

static void any_transition(const table *const *t, finding *f)
{
    static const char *const query = "sheet=mistakes&case=uneven&quantity=outer_tenth";
    double value = pick(t[0], query, "value"), error = pick(t[0], query, "error");
    decide(f, value, error, 0.1);
    f->is = judge_equal(value, error, 0.1, 0.03);
    snprintf(f->words, sizeof f->words, "flat I; uneven steps: %.4f +- %.4f of the states in a tenth of the interval",
             value, error);
}

static void as_listed(const table *const *t, finding *f)
{
    static const char *const query = "sheet=mistakes&case=cancelled&quantity=outer_tenth";
    double value = pick(t[0], query, "value"), error = pick(t[0], query, "error");
    decide(f, value, error, 0.1);
    f->is = judge_equal(value, error, 0.1, 0.03);
    snprintf(f->words, sizeof f->words, "the same steps; T cancels: %.4f +- %.4f in the tenth", value, error);
}

static void converges_by_itself(const table *const *t, finding *f)
{
    double truth = pick(t[0], "sheet=islands&case=truth&quantity=mean", "value");
    double one = pick(t[0], "sheet=islands&case=one&quantity=mean", "value");
    double one_error = pick(t[0], "sheet=islands&case=one&quantity=mean", "error");
    double all = pick(t[0], "sheet=islands&case=large&quantity=mean", "value");
    double all_error = pick(t[0], "sheet=islands&case=large&quantity=mean", "error");
    decide(f, one, one_error, truth);
    f->is = judge_both(judge_equal(all, all_error, truth, 0.1), judge_equal(one, one_error, truth, 0.1),
                       "steps reach every island of I", f);
    snprintf(f->words, sizeof f->words,
             "two islands: mean %.3f +- %.3f by small steps; %.3f +- %.3f with large ones; true %.3f", one, one_error,
             all, all_error, truth);
}

static void beginning_biased(const table *const *t, finding *f)
{
    size_t row = row_next(t[0], 0, "policy=one dark point");
    decide(f, number(t[0], row, "bias2"), number(t[0], row, "bias2_error"), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(f->words, sizeof f->words,
             "from one point; %.0f evaluations: bias^2 %.3f +- %.3f; variance %.3f +- %.3f",
             number(t[0], row, "evaluations"), f->value, f->error, number(t[0], row, "variance"),
             number(t[0], row, "variance_error"));
}

/* ---- Section 2: theory ---- */

static void becomes_uniform(const table *const *t, finding *f)
{
    scores s = scores_of(t[0], "", "score");
    size_t last = row_last(t[0], "");
    f->is = judge_scores(&s, f);
    snprintf(f->words, sizeof f->words,
             "histograms agree with p_n (worst score %.1f); at n = %.0f p_n is within %.0f %% of uniform", s.worst,
             number(t[0], last, "n"), 100 * number(t[0], last, "farthest"));
}

static void equation_12(const table *const *t, finding *f)
{
    scores s = scores_of(t[0], "", "score");
    f->is = judge_scores(&s, f);
    snprintf(f->words, sizeof f->words, "%.0f errors measured by chains: mean square score %.2f; worst %.1f", s.count,
             s.square, s.worst);
}

/* The slope of ln E_n from measured errors, weighted, over the rows where one harmonic is left and E is known. */
static void exponentially(const table *const *t, finding *f)
{
    const double Delta = 0.1, pi = 3.14159265358979324, least = 3 / (pi * Delta * pi * Delta);
    double w = 0, x = 0, y = 0, xx = 0, xy = 0, slope, error, theory = log(sin(pi * Delta) / (pi * Delta));
    size_t row = 0;
    while ((row = row_next(t[0], row, "Delta=0.1")) > 0) {
        double n = number(t[0], row, "n"), E = number(t[0], row, "estimate"), e = number(t[0], row, "error") / E;
        if (n < least || !(e < 0.2)) continue;
        w += 1 / (e * e);
        x += n / (e * e);
        y += log(E) / (e * e);
        xx += n * n / (e * e);
        xy += n * log(E) / (e * e);
    }
    slope = (w * xy - x * y) / (w * xx - x * x);
    error = sqrt(w / (w * xx - x * x));
    decide(f, slope, error, theory);
    f->is = judge_equal(slope, error, theory, 0.2 * fabs(theory));
    snprintf(f->words, sizeof f->words, "Delta = .1 and late: ln E falls by %.5f +- %.5f a step; -ln P*(1) is %.5f",
             -slope, error, -theory);
}

static void seeds_formula(const table *t, const char *formula, finding *f)
{
    scores s = { 0, 0, 0 };
    size_t row = 0;
    while ((row = row_next(t, row, "")) > 0) {
        double score = (number(t, row, "estimate") - number(t, row, formula)) / number(t, row, "error");
        if (isnan(score)) continue;
        s.count++;
        s.square += (score * score - s.square) / s.count;
        s.worst = fmax(s.worst, fabs(score));
    }
    f->is = judge_scores(&s, f);
    snprintf(f->words, sizeof f->words, "n = 3: %.4f; chains %.4f +- %.4f; worst of %.0f scores %.1f",
             pick(t, "n=3", formula), pick(t, "n=3", "estimate"), pick(t, "n=3", "error"), s.count, s.worst);
}

static void seeds_printed(const table *const *t, finding *f) { seeds_formula(t[0], "printed", f); }
static void seeds_corrected(const table *const *t, finding *f) { seeds_formula(t[0], "corrected", f); }

/* The mean start-up error over sets of seeds, and its standard error. */
static double mean_of_sets(const table *t, const char *query, double *error)
{
    double n = 0, mean = 0, squares = 0;
    size_t row = 0;
    while ((row = row_next(t, row, query)) > 0) {
        double value = number(t, row, "startup_error"), off = value - mean;
        n++;
        mean += off / n;
        squares += off * (value - mean);
    }
    *error = n > 1 ? sqrt(squares / (n - 1) / n) : NONE;
    return n > 0 ? mean : NONE;
}

static void seeds_help(const table *const *t, finding *f)
{
    double one_error, many_error, one = mean_of_sets(t[0], "kind=random&seeds=1", &one_error);
    double many = mean_of_sets(t[0], "kind=random&seeds=64", &many_error), ratio = many / one;
    decide(f, ratio, ratio_error(many, many_error, one, one_error), 1);
    f->is = judge(f->value, f->error, f->bound, -1);
    snprintf(f->words, sizeof f->words,
             "64 random seeds leave %.3f +- %.3f of the error of one; 1/sqrt(64) would be .125", f->value, f->error);
}

static void walks_help(const table *const *t, finding *f)
{
    static const char *const query[2][2] = { { "scene=cornell&start=one point&apex=0.05&samples_per_pixel=20",
                                               "scene=cornell&start=64 points&apex=0.05&samples_per_pixel=20" },
                                             { "scene=hidden&start=one point&apex=0.05&samples_per_pixel=20",
                                               "scene=hidden&start=64 points&apex=0.05&samples_per_pixel=20" } };
    double ratio[2], error[2];
    int i;
    for (i = 0; i < 2; i++) {
        double one = pick(t[0], query[i][0], "bias2"), many = pick(t[0], query[i][1], "bias2");
        ratio[i] = many - one;
        error[i] = hypot(pick(t[0], query[i][0], "bias2_error"), pick(t[0], query[i][1], "bias2_error"));
    }
    decide(f, ratio[0], error[0], 0);
    f->is = judge_both(judge(ratio[1], error[1], 0, -1), judge(ratio[0], error[0], 0, -1), "the lamp is hidden", f);
    snprintf(
        f->words, sizeof f->words,
        "20 samples a pixel; .05 rad: bias^2 of 64 chains less that of one: %.3f +- %.3f; behind a door %.2g +- %.1g",
        ratio[0], error[0], ratio[1], error[1]);
}

static void high_harmonics(const table *const *t, finding *f)
{
    double lost = pick(t[0], "sheet=series&case=100_terms&x=0.01", "value");
    decide(f, lost, 0, 0.001);
    f->is = judge(lost, 0, 0.001, 1);
    snprintf(f->words, sizeof f->words, "Delta = .01: the modes above 100 hold %.2g of E_1 (exact)", lost);
}

static void small_stays_wrong(const table *const *t, finding *f)
{
    size_t row = row_last(t[0], "Delta=0.02");
    while (row > 1 && isnan(number(t[0], row, "estimate"))) row--;
    decide(f, number(t[0], row, "estimate"), number(t[0], row, "error"), 0.1);
    f->is = judge(f->value, f->error, f->bound, 1);
    snprintf(f->words, sizeof f->words, "Delta = .02: after %.0f steps E is still %.2f +- %.2f",
             number(t[0], row, "n"), f->value, f->error);
}

static void dimensions_worse(const table *const *t, finding *f)
{
    double one = pick(t[0], "dimensions=1&n=20", "estimate"), three = pick(t[0], "dimensions=3&n=20", "estimate");
    double error = hypot(pick(t[0], "dimensions=1&n=20", "error"), pick(t[0], "dimensions=3&n=20", "error"));
    double steps = pick(t[1], "Delta=0.2&dimensions=5", "steps") / pick(t[1], "Delta=0.2&dimensions=1", "steps");
    decide(f, three - one, error, 0);
    f->is = judge(f->value, f->error, f->bound, 1);
    snprintf(f->words, sizeof f->words,
             "n = 20: E is larger by %.3f +- %.3f in three dimensions than in one; five take %.2f times the steps to "
             "E = .1",
             f->value, f->error, steps);
}

static void mutations_needed(const table *const *t, finding *f)
{
    double wide = NONE, narrow = NONE, best_wide = 1, best_narrow = 1;
    size_t row = 0;
    while ((row = row_next(t[0], row, "")) > 0) {
        double Delta = number(t[0], row, "Delta"), E = number(t[0], row, "E_after_10_over_Delta");
        if (fabs(log(Delta / 0.2)) < best_wide) best_wide = fabs(log(Delta / 0.2)), wide = E;
        if (fabs(log(Delta / 0.01)) < best_narrow) best_narrow = fabs(log(Delta / 0.01)), narrow = E;
    }
    decide(f, narrow, 0, 0.1);
    f->is =
        judge_both(judge(wide, 0, 0.1, -1), judge(narrow, 0, 0.1, -1), "Delta is not small: 1/Delta^2 are needed", f);
    snprintf(f->words, sizeof f->words, "after 10/Delta steps E is %.2g for Delta = .2 and %.2g for .01 (exact)",
             wide, narrow);
}

static void small_biased(const table *const *t, finding *f)
{
    static const char *const small = "M=1000&Delta=0.05", *const large = "M=1000&Delta=0.35";
    double a = pick(t[0], small, "measured_bias2"), b = pick(t[0], large, "measured_bias2");
    decide(f, a - b, hypot(pick(t[0], small, "bias2_error"), pick(t[0], large, "bias2_error")), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(f->words, sizeof f->words, "1000 steps: bias^2 is larger by %.4f +- %.4f at Delta = .05 than at .35",
             f->value, f->error);
}

static void small_correlated(const table *const *t, finding *f)
{
    static const char *const query[2][2] = { { "M=1000&Delta=0.05", "M=1000&Delta=0.9" },
                                             { "M=10&Delta=0.02", "M=10&Delta=0.9" } };
    double apart[2], error[2];
    int i;
    for (i = 0; i < 2; i++) {
        apart[i] = pick(t[0], query[i][0], "measured_variance") - pick(t[0], query[i][1], "measured_variance");
        error[i] = hypot(pick(t[0], query[i][0], "variance_error"), pick(t[0], query[i][1], "variance_error"));
    }
    decide(f, apart[0], error[0], 0);
    f->is = judge_both(judge(apart[0], error[0], 0, 1), judge(apart[1], error[1], 0, 1),
                       "the run is longer than its memory", f);
    snprintf(f->words, sizeof f->words,
             "variance of small less that of large steps: %.4f +- %.4f after 1000 steps; %.4f +- %.4f after 10",
             apart[0], error[0], apart[1], error[1]);
}

/* The mean squared error of the size nearest to Delta. */
static double mse_at(const table *t, const char *query, double Delta)
{
    double mse = NONE, best = (double)INFINITY;
    size_t row = 0;
    while ((row = row_next(t, row, query)) > 0)
        if (fabs(log(number(t, row, "Delta") / Delta)) < best) {
            best = fabs(log(number(t, row, "Delta") / Delta));
            mse = number(t, row, "mse");
        }
    return mse;
}

static void large_forgets(const table *const *t, finding *f)
{
    double peak = mse_at(t[0], "importance=one peak", 2) / mse_at(t[0], "importance=one peak", 0.2);
    double flat = mse_at(t[0], "importance=constant", 2) / mse_at(t[0], "importance=constant", 0.2);
    decide(f, peak, 0, 1);
    f->is = judge_both(judge(peak, 0, 1, 1), judge(flat, 0, 1, 1), "there is a region to remember", f);
    snprintf(f->words, sizeof f->words,
             "squared error at Delta = 2 over that at .2: %.2g on one peak; %.2g on a constant I (exact)", peak,
             flat);
}

/* In how many importances the least error is at neither end of the sizes. */
static void optimum_exists(const table *const *t, finding *f)
{
    static const char *const query[5] = { "importance=constant", "importance=one wave", "importance=exponential",
                                          "importance=one peak", "importance=two peaks" };
    double inside = 0, least = NONE, most = NONE;
    int i;
    for (i = 0; i < 5; i++) {
        size_t row = 0, best = 0, last = row_last(t[0], query[i]), first = row_next(t[0], 0, query[i]);
        while ((row = row_next(t[0], row, query[i])) > 0)
            if (best == 0 || number(t[0], row, "mse") < number(t[0], best, "mse")) best = row;
        inside += best != first && best != last;
        least = fmin(least, number(t[0], best, "Delta"));
        most = fmax(most, number(t[0], best, "Delta"));
    }
    decide(f, inside, 0, 4.5);
    f->is = judge(inside, 0, 4.5, 1);
    snprintf(f->words, sizeof f->words,
             "the least error is at neither end of the sizes for %.0f of 5 importances; best sizes from %.2f to %.2f",
             inside, least, most);
}

/* ---- Section 3: bidirectional path tracing ---- */

/* The errors come from 8 parts of a run, and that of the whole is not in them: 6 of them are too many. */
static void joins_right(const table *const *t, finding *f)
{
    scores s = { 0, 0, 0 };
    double farthest = 0;
    size_t row = 0;
    while ((row = row_next(t[0], row, "")) > 0) {
        double off = number(t[0], row, "alone") - 1, score = off / number(t[0], row, "alone_error");
        if (!(number(t[0], row, "s") >= 1) || !(number(t[0], row, "edges") >= 2)) continue;
        s.count++;
        s.square += (score * score - s.square) / s.count;
        s.worst = fmax(s.worst, fabs(score));
        farthest = fmax(farthest, fabs(off));
    }
    decide(f, s.worst, 1, 0);
    f->is = !(s.count > 0) ? NOT_MEASURED : s.worst > 6 ? REFUTED : farthest < 0.1 ? REPRODUCED : UNDECIDED;
    snprintf(f->words, sizeof f->words,
             "%.0f ways of joining; each alone: off by %.1f %% at most; the worst score of 8 parts is %.1f", s.count,
             100 * farthest, s.worst);
}

/* The last look at one curve of figure 4. */
static double angle_error(const table *t, const char *query, double *error)
{
    size_t row = row_last(t, query);
    *error = number(t, row, "error");
    return number(t, row, "relative_rmse");
}

static void small_angle_worse(const table *const *t, finding *f)
{
    double e[2], small = angle_error(t[0], "method=perturbed&apex_angle=0.05", &e[0]);
    double middle = angle_error(t[0], "method=perturbed&apex_angle=0.3", &e[1]);
    decide(f, small - middle, hypot(e[0], e[1]), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(f->words, sizeof f->words, "%.0f samples a pixel: error %.3f +- %.3f at .05 rad; %.3f +- %.3f at .3",
             number(t[0], row_last(t[0], "method=perturbed&apex_angle=0.05"), "samples_per_pixel"), small, e[0],
             middle, e[1]);
}

static void wide_angle_worse(const table *const *t, finding *f)
{
    double e[2], fresh = angle_error(t[0], "method=fresh paths", &e[0]);
    double middle = angle_error(t[0], "method=perturbed&apex_angle=0.3", &e[1]);
    decide(f, fresh - middle, hypot(e[0], e[1]), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(f->words, sizeof f->words, "error %.3f +- %.3f with fresh paths; %.3f +- %.3f at .3 rad", fresh, e[0],
             middle, e[1]);
}

/* The rates of forgetting, measured over predicted, pooled over the angles number `first` to 3 with their weights. */
static double rate_ratio(const table *t, const char *what, int first, double *error)
{
    static const char *const apex[4] = { "0.05", "0.15", "0.45", "1.5" };
    double w = 0, sum = 0;
    int i;
    for (i = first; i < 4; i++) {
        char query[100];
        double theory, value, e;
        snprintf(query, sizeof query, "what=furnace: rate&apex=%s", apex[i]);
        theory = pick(t, query, "theory");
        snprintf(query, sizeof query, "what=%s: rate&apex=%s", what, apex[i]);
        value = pick(t, query, "value") / theory;
        e = pick(t, query, "error") / theory;
        if (!(e > 0)) continue;
        w += 1 / (e * e);
        sum += value / (e * e);
    }
    *error = sqrt(1 / w);
    return sum / w;
}

/* One angle at which the theory is off suffices; in the box the widest is off most, since most is rejected there. */
static void theory_validated(const table *const *t, finding *f)
{
    double e[2], furnace = rate_ratio(t[0], "furnace", 0, &e[0]), box = rate_ratio(t[0], "Cornell box", 3, &e[1]);
    decide(f, box, e[1], 1);
    f->is =
        judge_both(judge_equal(furnace, e[0], 1, 0.1), judge_equal(box, e[1], 1, 0.1), "I is constant: a furnace", f);
    snprintf(f->words, sizeof f->words,
             "rate of forgetting over the predicted: %.3f +- %.3f in a furnace; %.3f +- %.3f in the Cornell box at "
             "1.5 rad",
             furnace, e[0], box, e[1]);
}

/* The squared error of spots of 4 x 4 pixels. */
static double spots_at(const table *t, const char *apex, double *error)
{
    char query[120];
    snprintf(query, sizeof query, "scene=cornell&start=seeds&apex=%s&samples_per_pixel=20", apex);
    *error = hypot(pick(t, query, "spot_bias2_error"), pick(t, query, "spot_variance_error"));
    return pick(t, query, "spot_bias2") + pick(t, query, "spot_variance");
}

static void spots_exist(const table *const *t, finding *f)
{
    double e[2], small = spots_at(t[0], "0.05", &e[0]), large = spots_at(t[0], "0.45", &e[1]);
    decide(f, small - large, hypot(e[0], e[1]), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(
        f->words, sizeof f->words,
        "20 samples a pixel: squared error of spots of 4 x 4 pixels %.4f +- %.4f at .05 rad; %.4f +- %.4f at .45",
        small, e[0], large, e[1]);
}

/* The share of bias^2 in the squared error of the spots, at small perturbations and 20 samples a pixel. */
static double share_at(const table *t, const char *scene, const char *start, double *error)
{
    char query[120];
    snprintf(query, sizeof query, "scene=%s&start=%s&apex=0.05&samples_per_pixel=20", scene, start);
    *error = pick(t, query, "share_error");
    return pick(t, query, "share");
}

static void spots_are_bias(const table *const *t, finding *f)
{
    double e[3], one = share_at(t[0], "cornell", "one point", &e[0]);
    double many = share_at(t[0], "cornell", "64 points", &e[1]),
           weighted = share_at(t[0], "cornell", "weighted seeds", &e[2]);
    decide(f, one, e[0], 0.5);
    f->is = judge_both(judge(many, e[1], 0.5, 1), judge(one, e[0], 0.5, 1), "many chains start at fixed points", f);
    snprintf(
        f->words, sizeof f->words,
        "20 samples a pixel; bias^2 is %.0f +- %.0f %% of the spots' squared error with one chain; %.0f +- %.0f %% "
        "with 64 from fixed points; %.0f +- %.0f %% from weighted seeds",
        100 * one, 100 * e[0], 100 * many, 100 * e[1], 100 * weighted, 100 * e[2]);
}

/* ---- Section 4 and abstract: conclusions ---- */

static void bias_if_uniform(const table *const *t, finding *f)
{
    static const char *const query[2] = { "M=100&Delta=0.1", "M=10000&Delta=0.1" };
    double share[2], error[2];
    int i;
    for (i = 0; i < 2; i++) {
        double b = pick(t[0], query[i], "measured_bias2"), v = pick(t[0], query[i], "measured_variance");
        share[i] = b / (b + v);
        error[i] = hypot(v * pick(t[0], query[i], "bias2_error"), b * pick(t[0], query[i], "variance_error")) /
                   ((b + v) * (b + v));
    }
    decide(f, share[0], error[0], 0.5);
    f->is = judge_both(judge(share[0], error[0], 0.5, 1), judge(share[1], error[1], 0.5, 1), "the run is short", f);
    snprintf(
        f->words, sizeof f->words,
        "constant I; Delta = .1: bias^2 is %.0f +- %.0f %% of the squared error after 100 steps; %.0f +- %.0f %% "
        "after 10000",
        100 * share[0], 100 * error[0], 100 * share[1], 100 * error[1]);
}

static void bias_by_scene(const table *const *t, finding *f)
{
    double e[2], box = share_at(t[0], "cornell", "one point", &e[0]);
    double hidden = share_at(t[0], "hidden", "one point", &e[1]);
    decide(f, box - hidden, hypot(e[0], e[1]), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(
        f->words, sizeof f->words,
        "share of bias^2 in the spots of one chain: %.2f +- %.2f in the Cornell box; %.2f +- %.2f behind a door",
        box, e[0], hidden, e[1]);
}

static void large_avoids_bias(const table *const *t, finding *f)
{
    static const char *const small = "scene=cornell&start=64 points&apex=0.05&samples_per_pixel=20";
    static const char *const large = "scene=cornell&start=64 points&apex=0.45&samples_per_pixel=20";
    double a = pick(t[0], small, "spot_bias2"), a_error = pick(t[0], small, "spot_bias2_error");
    double b = pick(t[0], large, "spot_bias2"), b_error = pick(t[0], large, "spot_bias2_error");
    decide(f, a - b, hypot(a_error, b_error), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(f->words, sizeof f->words,
             "Cornell box from 64 points: bias^2 of the spots %.4f +- %.4f at .05 rad; %.4f +- %.4f at .45", a,
             a_error, b, b_error);
}

/* ln of the efficiency 1/(relMSE x seconds) at the last look. Of the repeats the table knows the extremes. The range
   of 6 is 6.2 times the standard error of their mean if they are normal, that of 3 is 2.9 times; a fifth and a third
   leave room for those that are not. */
static double efficiency(const table *t, const char *scene, const char *curve, double *error)
{
    char query[120];
    size_t row;
    snprintf(query, sizeof query, "chart=error&scene=%s&curve=%s", scene, curve);
    row = row_last(t, query);
    *error = log(number(t, row, "high") / number(t, row, "low")) / (number(t, row, "repeats") < 6 ? 3 : 5);
    return -log(number(t, row, "value") * number(t, row, "x"));
}

enum { ANGLES = 7 };
static const char *const independent[3] = { "path tracing", "light tracing", "bidirectional" };
static const char *const metropolis[ANGLES + 1] = { "MLT 0.05", "MLT 0.1", "MLT 0.2", "MLT 0.4",
                                                    "MLT 0.8",  "MLT 1.6", "MLT 3.1", "primary space" };

/* The best of some curves; `name` gets which. */
static double best_of(const table *t, const char *scene, const char *const *curve, int count, double *error,
                      const char **name)
{
    double best = NONE, e;
    int i;
    for (i = 0; i < count; i++) {
        double value = efficiency(t, scene, curve[i], &e);
        if (isnan(value) || value <= best) continue;
        best = value;
        *error = e;
        *name = curve[i];
    }
    return best;
}

/* ln of how much more efficient Metropolis is than independent paths. */
static double advantage(const table *t, const char *scene, double *error, const char **name)
{
    const char *other = "";
    double e[2] = { NONE, NONE }, best = best_of(t, scene, metropolis, ANGLES + 1, &e[0], name);
    best -= best_of(t, scene, independent, 3, &e[1], &other);
    *error = hypot(e[0], e[1]);
    return best;
}

static void only_difficult(const table *const *t, finding *f)
{
    const char *name[2] = { "", "" };
    double e[2], box = advantage(t[0], "cornell", &e[0], &name[0]);
    double hidden = advantage(t[0], "hidden", &e[1], &name[1]);
    outcome easy = judge(box, e[0], 0, -1), hard = judge(hidden, e[1], 0, 1);
    decide(f, hidden, e[1], 0);
    f->is = easy == NOT_MEASURED || hard == NOT_MEASURED ? NOT_MEASURED
            : easy == REFUTED || hard == REFUTED         ? REFUTED
            : easy == REPRODUCED && hard == REPRODUCED   ? REPRODUCED
                                                         : UNDECIDED;
    snprintf(
        f->words, sizeof f->words,
        "best Metropolis (%s) over best independent: %.2g times as efficient in the Cornell box; behind a door (%s) "
        "%.2g times; both known to a factor of %.2g",
        name[0], exp(box), name[1], exp(hidden), exp(fmax(e[0], e[1])));
}

static void large_if_homogeneous(const table *const *t, finding *f)
{
    double e[4], box = efficiency(t[0], "cornell", "MLT 0.4", &e[0]) - efficiency(t[0], "cornell", "MLT 0.05", &e[1]);
    double hidden = efficiency(t[0], "hidden", "MLT 0.4", &e[2]) - efficiency(t[0], "hidden", "MLT 0.05", &e[3]);
    decide(f, box - hidden, hypot(hypot(e[0], e[1]), hypot(e[2], e[3])), 0);
    f->is = judge(f->value, f->error, 0, 1);
    snprintf(
        f->words, sizeof f->words,
        ".4 rad over .05: %.2g times as efficient in the Cornell box; %.2g times behind a door; their ratio is "
        "known to a factor of %.2g",
        exp(box), exp(hidden), exp(f->error));
}

static void more_dimensions(const table *const *t, finding *f)
{
    scores s = scores_of(t[0], "", "score");
    f->is = judge_scores(&s, f);
    snprintf(f->words, sizeof f->words,
             "product formula against chains in 1 to 5 dimensions: %.0f scores; mean square %.2f; worst %.1f",
             s.count, s.square, s.worst);
}

static void size_predicted(const table *const *t, finding *f)
{
    const char *name = "";
    double least = NONE, e[2] = { NONE, NONE }, best, pilot, error;
    size_t row = 0;
    while ((row = row_next(t[0], row, "rule=metro_best_size")) > 0)
        least = fmin(least, number(t[0], row, "efficiency"));
    best = best_of(t[1], "cornell", metropolis, ANGLES, &e[0], &name);
    pilot = efficiency(t[1], "cornell", "MLT by pilot", &e[1]) - best;
    error = hypot(e[0], e[1]);
    decide(f, least, 0, 0.8);
    f->is = judge_both(judge(least, 0, 0.8, 1), judge(pilot, error, log(0.8), 1), "there is one dimension", f);
    snprintf(f->words, sizeof f->words,
             "efficiency of the size chosen over the best: %.2f at least in one dimension; %.2g by pilots in the "
             "Cornell box (known to a factor of %.2g)",
             least, exp(pilot), exp(error));
}

/* ---- Bundles of rays ---- */

enum { FEW = 8, MOST = 1000000 }; /* walks: up to so many there are few bundles; more than any run makes */

/* The row of a method with the most walks, up to `most`; of metropolis the perturbation with the least error. */
static size_t bundle_row(const table *t, const char *query, double most)
{
    size_t row = 0, best = 0;
    while ((row = row_next(t, row, query)) > 0) {
        double walks = number(t, row, "walks"), then = number(t, best, "walks");
        if (walks > most) continue;
        if (best == 0 || walks > then || (walks == then && number(t, row, "error") < number(t, best, "error")))
            best = row;
    }
    return best;
}

/* The difference in the error of two rows. */
static void bundle_apart(const table *t, size_t a, size_t b, int side, finding *f)
{
    decide(f, number(t, a, "error") - number(t, b, "error"),
           hypot(number(t, a, "error_se"), number(t, b, "error_se")), 0);
    f->is = judge(f->value, f->error, 0, side);
}

static void bundles_even(const table *const *t, finding *f)
{
    size_t a = bundle_row(t[0], "method=random", MOST), b = bundle_row(t[0], "method=even", MOST);
    bundle_apart(t[0], a, b, 1, f);
    snprintf(f->words, sizeof f->words, "%.0f walks: error %.3g random less %.3g even is %.2g +- %.1g",
             number(t[0], a, "walks"), number(t[0], a, "error"), number(t[0], b, "error"), f->value, f->error);
}

static void bundles_worse(const table *const *t, finding *f)
{
    size_t a = bundle_row(t[0], "method=metropolis", FEW), b = bundle_row(t[0], "method=random", FEW);
    bundle_apart(t[0], a, b, 1, f);
    snprintf(f->words, sizeof f->words,
             "%.0f walks: error %.3g Metropolis (best size) less %.3g random is %.2g +- %.1g",
             number(t[0], a, "walks"), number(t[0], a, "error"), number(t[0], b, "error"), f->value, f->error);
}

/* The smallest (side -1) or the largest perturbation of the Metropolis walks. */
static double bundle_extreme(const table *t, int side)
{
    size_t row;
    double found = NAN;
    for (row = row_next(t, 0, "method=metropolis"); row > 0; row = row_next(t, row, "method=metropolis"))
        if (!(side * (number(t, row, "perturbation") - found) <= 0)) found = number(t, row, "perturbation");
    return found;
}

/* The share of bias^2 in the squared error, the mean over the numbers of walks up to FEW. One run gives them all, so
   their errors go together and are added up as they are. */
static outcome bundle_bias(const table *t, double perturbation, finding *f)
{
    double share = 0, error = 0, rows = 0;
    size_t row;
    for (row = row_next(t, 0, "method=metropolis"); row > 0; row = row_next(t, row, "method=metropolis")) {
        if (number(t, row, "perturbation") != perturbation || number(t, row, "walks") > FEW) continue;
        share += number(t, row, "share");
        error += number(t, row, "share_se");
        rows++;
    }
    decide(f, share / rows, error / rows, 0.5);
    return judge(f->value, f->error, 0.5, 1);
}

static void bundles_biased(const table *const *t, finding *f)
{
    double small = bundle_extreme(t[0], -1), large = bundle_extreme(t[0], 1), share, error;
    outcome first = bundle_bias(t[0], small, f), second;
    share = f->value;
    error = f->error;
    second = bundle_bias(t[0], large, f);
    f->is = judge_both(first, second, "the perturbation is small", f);
    snprintf(f->words, sizeof f->words,
             "up to %d walks from fixed points: bias^2 is %.0f +- %.0f %% of the squared error at %.1f rad; "
             "%.0f +- %.0f %% at %.1f",
             FEW, 100 * share, 100 * error, small, 100 * f->value, 100 * f->error, large);
}

/* The advantage in the error at the most walks, against that of paths at equal time behind the door. */
static void bundles_smaller(const table *const *t, finding *f)
{
    const char *name = "";
    size_t a = bundle_row(t[0], "method=random", MOST), b = bundle_row(t[0], "method=metropolis", MOST);
    double e, paths = advantage(t[1], "hidden", &e, &name) / 2;
    double ratio = log(number(t[0], a, "error") / number(t[0], b, "error"));
    double error = hypot(number(t[0], a, "error_se") / number(t[0], a, "error"),
                         number(t[0], b, "error_se") / number(t[0], b, "error"));
    decide(f, ratio - paths, hypot(error, e / 2), 0);
    f->is = judge(f->value, f->error, 0, -1);
    snprintf(f->words, sizeof f->words,
             "Metropolis divides the error by %.2f for bundles (figure 8, equal walks); by %.2f for paths (lamp "
             "behind a door, equal time)",
             exp(ratio), exp(paths));
}

/* Bundles less paths in one scene: the numbers of both go to `both`. Times have no error in the table: a fifth is
   what a busy machine makes of them. */
static outcome bundles_less_paths(const table *t, const char *scene, const char *column, int side, finding *f,
                                  double both[2])
{
    static const char *const method[2] = { "bundles", "paths" };
    double error[2];
    char query[60], name[40];
    int i;
    snprintf(name, sizeof name, "%s_se", column);
    for (i = 0; i < 2; i++) {
        snprintf(query, sizeof query, "scene=%s&method=%s", scene, method[i]);
        both[i] = pick(t, query, column);
        error[i] = strcmp(column, "cost_us") == 0 ? both[i] / 5 : pick(t, query, name);
    }
    decide(f, both[0] - both[1], hypot(error[0], error[1]), 0);
    return judge(f->value, f->error, 0, side);
}

static void in_both_scenes(const table *t, const char *column, int side, const char *what, finding *f)
{
    double box[2], hidden[2];
    outcome second = bundles_less_paths(t, "cornell", column, side, f, box);
    outcome first = bundles_less_paths(t, "hidden", column, side, f, hidden);
    f->is = judge_both(first, second, "light is difficult", f);
    snprintf(f->words, sizeof f->words,
             "%s: bundles %.3g and paths %.2g in the box; %.3g and %.2g behind the door; the last difference is "
             "known to %.1g",
             what, box[0], box[1], hidden[0], hidden[1], f->error);
}

static void bundles_smooth(const table *const *t, finding *f)
{
    in_both_scenes(t[0], "variation", -1, "variation along a mutation", f);
}

static void bundles_dear(const table *const *t, finding *f)
{
    in_both_scenes(t[0], "cost_us", 1, "microseconds a sample", f);
}

/* ---- The list ---- */

typedef struct {
    const char *key, *section, *statement;
    const char *file, *other; /* the tables it needs; other may be NULL */
    void (*find)(const table *const *t, finding *f);
} claim;

static const claim claims[] = {
    { "uniform", "abstract", "the start-up bias is significant if the integrand is uniform", "size.csv", NULL,
      bias_if_uniform },
    { "difficult", "abstract", "Metropolis pays only for difficult lighting", "costs.csv", NULL, only_difficult },
    { "transition", "1.1", "almost any T leads to the density I/b", "failures.csv", NULL, any_transition },
    { "listing", "1.1", "the acceptance ratio as listed leads there too", "failures.csv", NULL, as_listed },
    { "automatic", "1.1", "the chain finds that density by itself", "failures.csv", NULL, converges_by_itself },
    { "beginning", "1.2", "at its beginning the samples bias the estimate", "startup.csv", NULL, beginning_biased },
    { "figure1", "2; figure 1", "p_n becomes the uniform density", "fig1_summary.csv", NULL, becomes_uniform },
    { "equation12", "2; (12)", "(12) is the start-up error", "fig2.csv", NULL, equation_12 },
    { "exponential", "2; (12)", "late the error falls by the factor P*(1) a step", "fig2.csv", NULL, exponentially },
    { "printed15", "2.1; (15)", "(15) as printed is the error of N seeds", "seeds.csv", NULL, seeds_printed },
    { "corrected15", "2.1; (15)", "the same with the sum outside the power", "seeds.csv", NULL, seeds_corrected },
    { "seeds", "2.1", "several seeds reduce the start-up error", "seeds_number.csv", NULL, seeds_help },
    { "walks", "2.1", "several walks reduce the bias of a picture at equal cost", "bias.csv", NULL, walks_help },
    { "harmonics", "2.2; (17)", "P*(k) can be large for large k", "failures.csv", NULL, high_harmonics },
    { "small", "2.2; figure 2", "small perturbations stay wrong for many steps", "fig2.csv", NULL,
      small_stays_wrong },
    { "dimensions", "2.2", "this gets worse in higher dimensions", "fig2_dimensions.csv", "fig2_steps.csv",
      dimensions_worse },
    { "mutations", "2.3", "many more than 1/Delta mutations are enough", "size_forget.csv", NULL, mutations_needed },
    { "bias", "2.3", "small mutations emphasise the bias", "size.csv", NULL, small_biased },
    { "correlation", "2.3; (18)", "small mutations raise the variance by correlation", "size.csv", NULL,
      small_correlated },
    { "forget", "2.3", "large mutations forget the important regions", "operator.csv", NULL, large_forgets },
    { "optimum", "2.3", "between small and large is an optimal size", "operator.csv", NULL, optimum_exists },
    { "smoother", "3", "the integrand of ray bundles is smoother", "smoother.csv", NULL, bundles_smooth },
    { "dearer", "3", "the integrand of ray bundles is dearer", "smoother.csv", NULL, bundles_dear },
    { "joins", "3.1", "joins count cos cos/r^2: all ways agree", "pyramid.csv", NULL, joins_right },
    { "figure4", "3.2; figure 4", "small angles have the larger error", "fig4.csv", NULL, small_angle_worse },
    { "fresh", "3.2; figure 4", "paths that forget everything are worse again", "fig4.csv", NULL, wide_angle_worse },
    { "validated", "3.2", "pictures follow the theory", "decay.csv", NULL, theory_validated },
    { "spots", "3.2; figure 5", "small angles give wrong bright and dark spots", "bias.csv", NULL, spots_exist },
    { "cause", "3.2; figure 5", "the start-up bias causes these spots", "bias.csv", NULL, spots_are_bias },
    { "even", "3.3; figure 8", "quasi-random walks beat random ones", "fig8.csv", NULL, bundles_even },
    { "scenes", "4", "the bias matters most in homogeneous scenes", "bias.csv", NULL, bias_by_scene },
    { "homogeneous", "4", "homogeneous scenes want larger perturbations", "costs.csv", NULL, large_if_homogeneous },
    { "avoid", "4", "large perturbations avoid the bias there", "bias.csv", NULL, large_avoids_bias },
    { "smaller", "4; figure 8", "for ray bundles Metropolis gains even less", "fig8.csv", "costs.csv",
      bundles_smaller },
    { "few", "4; figure 8", "with few bundles it suffers from the bias", "fig8.csv", NULL, bundles_biased },
    { "compensated", "4; figure 8", "importance sampling does not compensate for that", "fig8.csv", NULL,
      bundles_worse },
    { "generalised", "4", "the generalisation to more dimensions is simple", "fig2_dimensions.csv", NULL,
      more_dimensions },
    { "estimate", "4", "an optimal size can be estimated", "operator_rules.csv", "costs.csv", size_predicted },
};

enum { CLAIMS = sizeof claims / sizeof *claims };

/* "missing: run build/PROGRAM": a table is named after the program that writes it, up to a dot or underscore. */
static void say_missing(const char *file, const char *what, finding *f)
{
    f->is = NOT_MEASURED;
    f->value = f->error = f->bound = NONE;
    snprintf(f->words, sizeof f->words, "%s %s: run build/%.*s", file, what, (int)strcspn(file, "._"), file);
}

static void examine(const claim *c, finding *f)
{
    const table *t[2];
    memset(f, 0, sizeof *f);
    f->value = f->error = f->bound = NONE;
    t[0] = table_of(c->file);
    t[1] = c->other != NULL ? table_of(c->other) : NULL;
    if (t[0] == NULL) say_missing(c->file, "is missing", f);
    else if (c->other != NULL && t[1] == NULL) say_missing(c->other, "is missing", f);
    else c->find(t, f);
    if (f->is == NOT_MEASURED && t[0] != NULL && (c->other == NULL || t[1] != NULL))
        say_missing(c->file, "lacks what is compared", f);
}

static void verdict_text(const finding *f, char *text, size_t room)
{
    snprintf(text, room, "%s%s%s", outcome_name[f->is], f->is == ONLY_IF ? " " : "",
             f->is == ONLY_IF ? f->condition : "");
}

/* ---- The table on the terminal ---- */

enum { CELLS = 4 };
static const int cell_width[CELLS] = { 13, 30, 44, 22 };

/* How many characters of `text` go on a line of `width`: up to a space, if there is one. */
static int line_of(const char *text, int width)
{
    int n = (int)strlen(text), i;
    if (n <= width) return n;
    for (i = width; i > 0; i--)
        if (text[i] == ' ') return i;
    return width;
}

/* A row of cells, each wrapped in its column. */
static void print_row(const char *const *cell)
{
    const char *rest[CELLS];
    int i, more = 1;
    for (i = 0; i < CELLS; i++) rest[i] = cell[i];
    while (more) {
        for (i = 0, more = 0; i < CELLS; i++) {
            int n = line_of(rest[i], cell_width[i]);
            if (i + 1 < CELLS) printf("%-*.*s  ", cell_width[i], n, rest[i]);
            else printf("%.*s\n", n, rest[i]);
            rest[i] += n;
            while (isspace((unsigned char)*rest[i])) rest[i]++;
            more |= *rest[i] != 0;
        }
    }
}

int main(int argc, char **argv)
{
    static const char *const head[CELLS] = { "section", "the paper says", "measured", "verdict" };
    char path[300], verdict[100];
    int count[OUTCOMES] = { 0 }, i;
    plot_csv csv;
    if (argc > 1) folder = argv[1];
    snprintf(path, sizeof path, "%s/claims.csv", folder);
    csv = plot_csv_open(path, "key,section,statement,measurement,verdict,value,error,bound");
    print_row(head);
    for (i = 0; i < CLAIMS; i++) {
        const claim *c = &claims[i];
        const char *cell[CELLS];
        finding f;
        examine(c, &f);
        verdict_text(&f, verdict, sizeof verdict);
        count[f.is]++;
        cell[0] = c->section;
        cell[1] = c->statement;
        cell[2] = f.words;
        cell[3] = verdict;
        printf("\n");
        print_row(cell);
        plot_csv_text(&csv, c->key);
        plot_csv_text(&csv, c->section);
        plot_csv_text(&csv, c->statement);
        plot_csv_text(&csv, f.words);
        plot_csv_text(&csv, verdict);
        PLOT_CSV_ROW(&csv, f.value, f.error, f.bound);
    }
    tables_free();
    printf(
        "\n%d statements of the paper: %d reproduced, %d true only if, %d refuted, %d undecided, %d not measured\n",
        CLAIMS, count[REPRODUCED], count[ONLY_IF], count[REFUTED], count[UNDECIDED], count[NOT_MEASURED]);
    return plot_csv_close(&csv);
}
