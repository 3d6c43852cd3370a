/* check.h - the harness of the tests: small, and every failure says what was seen and what was allowed.

   A test program is a list of cases:

       static void normal_sum(void) { CHECK_NEAR(sum, 1.0, 1e-15); }
       int main(void) { CHECK_RUN(normal_sum); return check_done("ground"); }

   A case passes when none of its checks failed. Statistical checks use fixed seeds; CHECK_SIGMA and
   check_chi_square_bound are set so that a correct program fails less than once in a million.
   METRO_TEST_SCALE (0 < scale <= 1, default 1) shrinks the work under emulators and valgrind: a test multiplies its
   sample counts by check_scale(), and the bounds follow because they are standard errors. */

#ifndef CHECK_H
#define CHECK_H

/* What is computed by hand here is compared with the header digit by digit, so it must round as the header does: no
   product and sum in one instruction. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    int passed, failed, failures_in_case;
} check_state;

static check_state check_global = { 0, 0, 0 };

#define CHECK(condition, ...)                                                                                        \
    do {                                                                                                             \
        if (!(condition)) {                                                                                          \
            check_complain(__FILE__, __LINE__, #condition);                                                          \
            fprintf(stderr, "    " __VA_ARGS__);                                                                     \
            fprintf(stderr, "\n");                                                                                   \
        }                                                                                                            \
    } while (0)

/* value equals truth within relative * |truth| (so exactly, where truth is 0 or infinite). */
#define CHECK_NEAR(value, truth, relative) check_near(__FILE__, __LINE__, #value, (value), (truth), (relative))
/* |value - truth| <= bound. */
#define CHECK_CLOSE(value, truth, bound) check_close(__FILE__, __LINE__, #value, (value), (truth), (bound))
/* |value - truth| <= 5.1 standard errors: a false alarm in 3e-7. sigma must be positive. */
#define CHECK_SIGMA(value, truth, sigma) check_sigma(__FILE__, __LINE__, #value, (value), (truth), (sigma))
#define CHECK_NAN(value) CHECK(isnan(value), "%s is %.17g, expected NaN", #value, (double)(value))
#define CHECK_RUN(test) check_run(#test, test)

static void check_complain(const char *file, int line, const char *what)
{
    check_global.failures_in_case++;
    fprintf(stderr, "  %s:%d: %s\n", file, line, what);
}

static inline void check_near(const char *file, int line, const char *what, double value, double truth,
                              double relative)
{
    int same = fabs(value - truth) <= relative * fabs(truth);
    if (isinf(truth)) same = isinf(value) && (value > 0) == (truth > 0);
    if (same) return;
    check_complain(file, line, what);
    fprintf(stderr, "    is %.17g, should be %.17g: relative error %.2g, allowed %.2g\n", value, truth,
            fabs(value - truth) / fabs(truth), relative);
}

static inline void check_close(const char *file, int line, const char *what, double value, double truth, double bound)
{
    if (fabs(value - truth) <= bound) return;
    check_complain(file, line, what);
    fprintf(stderr, "    is %.17g, should be %.17g: off by %.2g, allowed %.2g\n", value, truth, fabs(value - truth),
            bound);
}

static inline void check_sigma(const char *file, int line, const char *what, double value, double truth, double sigma)
{
    if (sigma > 0 && fabs(value - truth) <= 5.1 * sigma) return;
    check_complain(file, line, what);
    fprintf(stderr, "    is %.9g, should be %.9g: off by %.2f standard errors of %.3g, allowed 5.1\n", value, truth,
            fabs(value - truth) / sigma, sigma);
}

/* The value that a chi-square variable of `freedom` degrees exceeds once in a million (Wilson and Hilferty 1931;
   the cube is accurate to a per cent there, on the safe side, for freedom >= 3). */
static inline double check_chi_square_bound(double freedom)
{
    double s = 2.0 / (9.0 * freedom), c = 1.0 - s + 4.8 * sqrt(s);
    return freedom * c * c * c;
}

/* Chi square of `count[i]` against samples * p[i]; cells that expect fewer than 10 are put together. */
static inline void check_chi_square(const char *what, const double *count, const double *p, int cells, double samples)
{
    double sum = 0, rest_count = 0, rest = 0, freedom = -1;
    int i;
    for (i = 0; i < cells; i++) {
        double expected = samples * p[i];
        if (expected < 10) {
            rest_count += count[i];
            rest += expected;
            continue;
        }
        sum += (count[i] - expected) * (count[i] - expected) / expected;
        freedom++;
    }
    if (rest > 2) {
        sum += (rest_count - rest) * (rest_count - rest) / rest;
        freedom++;
    } else {
        CHECK(rest_count <= 25, "%s: %g draws in cells that expect %g", what, rest_count, rest);
    }
    if (freedom < 3) freedom = 3;
    CHECK(sum <= check_chi_square_bound(freedom), "%s: chi square %.1f with %.0f degrees of freedom, allowed %.1f",
          what, sum, freedom, check_chi_square_bound(freedom));
}

static inline double check_scale(void)
{
    const char *text = getenv("METRO_TEST_SCALE");
    double scale = text != NULL ? atof(text) : 1.0;
    return scale > 0 && scale < 1 ? scale : 1.0;
}

/* n samples at full scale, at least `least`. */
static inline uint64_t check_count(double n, double least)
{
    double scaled = n * check_scale();
    return (uint64_t)(scaled > least ? scaled : least);
}

/* Calls `row` with the comma-separated fields of each line of tests/data/<name> that is not a comment; returns the
   number of rows and fails the case when the file cannot be read. Tests run from the top of the project. */
static inline int check_rows(const char *name, void (*row)(char **field, int fields))
{
    char path[256], line[4096], *field[64];
    int rows = 0;
    FILE *file;
    snprintf(path, sizeof path, "tests/data/%s", name);
    file = fopen(path, "r");
    if (file == NULL) {
        check_complain(__FILE__, __LINE__, path);
        fprintf(stderr, "    cannot be opened: run the tests from the top of the project\n");
        return 0;
    }
    while (fgets(line, sizeof line, file) != NULL) {
        int fields = 0;
        char *at = line;
        line[strcspn(line, "\r\n")] = 0;
        if (line[0] == '#' || line[0] == 0) continue;
        while (at != NULL && fields < 64) {
            field[fields++] = at;
            at = strchr(at, ',');
            if (at != NULL) *at++ = 0;
        }
        row(field, fields);
        rows++;
    }
    fclose(file);
    return rows;
}

static inline void check_run(const char *name, void (*test)(void))
{
    check_global.failures_in_case = 0;
    test();
    if (check_global.failures_in_case == 0) check_global.passed++;
    else {
        check_global.failed++;
        fprintf(stderr, "FAILED %s (%d checks)\n", name, check_global.failures_in_case);
    }
}

static inline int check_done(const char *program)
{
    printf("%s: %d passed, %d failed\n", program, check_global.passed, check_global.failed);
    return check_global.failed != 0;
}

#endif
