/* test_randomness.c - chapter 2: streams of random numbers, sums and moments, scrambled Sobol points.

   Seeds are fixed. A statistical check states its statistic; its bound is 5.1 standard errors (a false alarm in 3e-7)
   or the value that chi-square exceeds once in a million. */

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"

static const double PI = 3.14159265358979323846;

/* The chi-square of `cells` counts that should be equal. */
static double chi_square_even(const double *count, size_t cells)
{
    double total = 0, sum = 0, expected;
    size_t i;
    for (i = 0; i < cells; i++) total += count[i];
    expected = total / (double)cells;
    for (i = 0; i < cells; i++) sum += (count[i] - expected) * (count[i] - expected) / expected;
    return sum;
}

static void check_even(const char *what, const double *count, size_t cells)
{
    double chi_square = chi_square_even(count, cells), bound = check_chi_square_bound((double)cells - 1);
    CHECK(chi_square <= bound, "%s: chi-square %.1f over %d cells, allowed %.1f", what, chi_square, (int)cells,
          bound);
}

/* The cell of x in 0 .. 1, safe for x = 1. */
static size_t cell_of(double x, size_t cells)
{
    size_t cell = (size_t)(x * (double)cells);
    return cell < cells ? cell : cells - 1;
}

/* ---- streams ---- */

/* The published recurrence (Blackman and Vigna 2021, figure 3), written again, and the ten first numbers of the state
   1, 2, 3, 4 that the ports of it in other languages test against. Catches: a wrong shift or rotation, ** in place of
   ++. */
static void recurrence(void)
{
    static const uint64_t published[10] = {
        UINT64_C(41943041), UINT64_C(58720359), UINT64_C(3588806011781223), UINT64_C(3591011842654386),
        UINT64_C(9228616714210784205), UINT64_C(9973669472204895162), UINT64_C(14011001112246962877),
        UINT64_C(12406186145184390807), UINT64_C(15849039046786891736), UINT64_C(10450023813501588000)
    };
    metro_rng rng = metro_rng_make(7, 11);
    uint64_t a = rng.state[0], b = rng.state[1], c = rng.state[2], d = rng.state[3];
    int i, wrong = 0;
    for (i = 0; i < 10000; i++) {
        uint64_t sum = a + d, result = ((sum << 23) | (sum >> 41)) + a;
        uint64_t na = a ^ b ^ d, nb = a ^ b ^ c, nc = a ^ c ^ (b << 17), nd = b ^ d;
        wrong += metro_rng_next(&rng) != result;
        a = na;
        b = nb;
        c = nc;
        d = (nd << 45) | (nd >> 19);
    }
    CHECK(wrong == 0, "%d of 10000 numbers differ", wrong);
    for (i = 0; i < 4; i++) rng.state[i] = (uint64_t)i + 1;
    for (i = 0; i < 10; i++) {
        uint64_t number = metro_rng_next(&rng);
        CHECK(number == published[i], "number %d is %.0f", i, (double)number);
    }
}

/* Catches: a hidden state, which a copy would share. */
static void copies_go_on_alike(void)
{
    metro_rng rng = metro_rng_make(1, 2), copy;
    int i;
    metro_rng_normal(&rng);
    copy = rng;
    for (i = 0; i < 100; i++) {
        double a = metro_rng_normal(&rng), b = metro_rng_normal(&copy);
        CHECK(a == b, "draw %d: %g and %g", i, a, b);
    }
    copy = metro_rng_make(1, 2);
    rng = metro_rng_make(1, 2);
    CHECK(metro_rng_next(&rng) == metro_rng_next(&copy), "the same pair gives another stream");
}

/* Cells of equal size, one number and pairs in a row, and the lowest of the 53 bits.
   Catches: 32 bits where 53 are promised, a 1 let through, the lower bits taken. */
static void uniform(void)
{
    static double single[256], pair[64 * 64], low[2];
    metro_rng rng = metro_rng_make(2, 0);
    uint64_t n = check_count(2e6, 1e5), i;
    double before = metro_rng_uniform(&rng);
    memset(single, 0, sizeof single);
    memset(pair, 0, sizeof pair);
    low[0] = low[1] = 0;
    for (i = 0; i < n; i++) {
        double x = metro_rng_uniform(&rng), grid = x * 9007199254740992.0;
        CHECK(x >= 0 && x < 1 && grid == floor(grid), "%.17g is not a multiple of 2^-53 in [0, 1)", x);
        single[cell_of(x, 256)]++;
        pair[64 * cell_of(before, 64) + cell_of(x, 64)]++;
        low[(size_t)fmod(grid, 2.0)]++;
        before = x;
    }
    check_even("single", single, 256);
    check_even("pairs", pair, 64 * 64);
    CHECK_SIGMA(low[0], (double)n / 2, sqrt((double)n) / 2);
}

/* The correlation of two streams; its standard error is 1/sqrt(n). */
static double correlation(uint64_t seed_a, uint64_t stream_a, uint64_t seed_b, uint64_t stream_b, uint64_t n)
{
    metro_rng a = metro_rng_make(seed_a, stream_a), b = metro_rng_make(seed_b, stream_b);
    double sum = 0;
    uint64_t i;
    for (i = 0; i < n; i++) sum += (metro_rng_uniform(&a) - 0.5) * (metro_rng_uniform(&b) - 0.5);
    return 12.0 * sum / (double)n;
}

/* Neighbouring seeds, neighbouring streams, and the pair the other way round; then the first numbers of 2^16 streams
   in a row, as if they were one stream. Catches: seed + stream (equal streams on a diagonal), a state that is not
   mixed. */
static void streams(void)
{
    static double first[256], second[64 * 64];
    uint64_t n = check_count(2e5, 1e4), i, count = check_count(65536, 20000);
    double before = 0.5;
    int k;
    for (i = 0; i < 20; i++) {
        CHECK_SIGMA(correlation(i, 0, i + 1, 0, n), 0.0, 1 / sqrt((double)n));
        CHECK_SIGMA(correlation(0, i, 0, i + 1, n), 0.0, 1 / sqrt((double)n));
        CHECK_SIGMA(correlation(i, i + 1, i + 1, i, n), 0.0, 1 / sqrt((double)n));
        CHECK_SIGMA(correlation(i, 5, (uint64_t)1 << (i + 40), 5, n), 0.0, 1 / sqrt((double)n));
    }
    for (k = 0; k < 4; k++) {
        memset(first, 0, sizeof first);
        memset(second, 0, sizeof second);
        for (i = 0; i < count; i++) {
            uint64_t wide = i << (k == 2 ? 40 : 0);
            metro_rng rng = k == 3 ? metro_rng_make(i, i) : k == 1 ? metro_rng_make(i, 3) : metro_rng_make(3, wide);
            double x = metro_rng_uniform(&rng);
            first[cell_of(x, 256)]++;
            second[64 * cell_of(before, 64) + cell_of(x, 64)]++;
            before = x;
        }
        check_even("first numbers", first, 256);
        check_even("first numbers of neighbours", second, 64 * 64);
    }
}

/* Bounds where bias shows: of 3 * 2^62 a remainder would give the lower third, and a missing rejection the multiples
   of 3, twice as often. Catches: both, <= for <, a product without its carries. */
static void below(void)
{
    static const uint64_t bound[] = { 6, 7, 256, UINT64_C(3) << 62, UINT64_C(3) << 61, UINT64_C(0x8000000000000001) };
    metro_rng rng = metro_rng_make(4, 0);
    size_t b;
    uint64_t i, n = check_count(300000, 30000);
    for (b = 0; b < sizeof bound / sizeof *bound; b++) {
        double count[256], rest[96];
        size_t cells = bound[b] <= 256 ? (size_t)bound[b] : 96;
        memset(count, 0, sizeof count);
        memset(rest, 0, sizeof rest);
        for (i = 0; i < n; i++) {
            uint64_t number = metro_rng_below(&rng, bound[b]);
            CHECK(number < bound[b], "%.0f of %.0f", (double)number, (double)bound[b]);
            count[bound[b] <= 256 ? (size_t)number : cell_of((double)number / (double)bound[b], cells)]++;
            rest[number % 96]++;
        }
        check_even("below", count, cells);
        if (bound[b] > 256) check_even("below, modulo 96", rest, 96);
    }
    for (i = 0; i < 100; i++) {
        CHECK(metro_rng_below(&rng, 0) == 0, "below 0");
        CHECK(metro_rng_below(&rng, 1) == 0, "below 1");
        CHECK(metro_rng_below(&rng, UINT64_MAX) < UINT64_MAX, "below 2^64 - 1");
    }
}

/* The four first moments (their errors are 1, sqrt 2, sqrt 15 and sqrt 96 over sqrt n), the cells of equal
   probability, and that each call takes two uniforms. Catches: log of 0, a variance of 1/2, an angle over a quarter
   of the circle. */
static void normal(void)
{
    static double count[64];
    metro_rng rng = metro_rng_make(5, 0), behind;
    double m1 = 0, m2 = 0, m3 = 0, m4 = 0, product = 0, before = 0, n;
    uint64_t i, draws = check_count(1e6, 1e5);
    memset(count, 0, sizeof count);
    for (i = 0; i < draws; i++) {
        double x = metro_rng_normal(&rng);
        CHECK(isfinite(x), "draw %d is %g", (int)i, x);
        m1 += x;
        m2 += x * x;
        m3 += x * x * x;
        m4 += x * x * x * x;
        product += x * before;
        before = x;
        count[cell_of(0.5 * erfc(-x / sqrt(2.0)), 64)]++;
    }
    n = (double)draws;
    CHECK_SIGMA(m1 / n, 0.0, sqrt(1 / n));
    CHECK_SIGMA(m2 / n, 1.0, sqrt(2 / n));
    CHECK_SIGMA(m3 / n, 0.0, sqrt(15 / n));
    CHECK_SIGMA(m4 / n, 3.0, sqrt(96 / n));
    CHECK_SIGMA(product / n, 0.0, sqrt(1 / n));
    check_even("normal", count, 64);
    behind = rng;
    metro_rng_normal(&rng);
    metro_rng_uniform(&behind);
    metro_rng_uniform(&behind);
    CHECK(metro_rng_next(&rng) == metro_rng_next(&behind), "a call does not take two uniforms");
}

/* Cells of equal area in height and azimuth about each of the three axes. Catches: a uniform angle from the pole (the
   poles too dense), a length that is not 1. */
static void direction(void)
{
    static double count[3][16 * 16];
    metro_rng rng = metro_rng_make(6, 0);
    double sum[3] = { 0, 0, 0 }, n;
    uint64_t i, draws = check_count(400000, 50000);
    size_t k;
    memset(count, 0, sizeof count);
    for (i = 0; i < draws; i++) {
        metro_vec3 v = metro_rng_direction(&rng);
        double c[5];
        c[0] = c[3] = v.x;
        c[1] = c[4] = v.y;
        c[2] = v.z;
        CHECK(fabs(v.x * v.x + v.y * v.y + v.z * v.z - 1) < 1e-14, "length off 1");
        for (k = 0; k < 3; k++) {
            double azimuth = atan2(c[k + 2], c[k + 1]) / (2 * PI) + 0.5;
            count[k][16 * cell_of(0.5 + 0.5 * c[k], 16) + cell_of(azimuth, 16)]++;
            sum[k] += c[k];
        }
    }
    n = (double)draws;
    for (k = 0; k < 3; k++) {
        check_even("directions", count[k], 16 * 16);
        CHECK_SIGMA(sum[k] / n, 0.0, sqrt(1 / (3 * n)));
    }
}

/* ---- sums and moments ---- */

/* Sums that are known exactly. Catches: a plain sum, Kahan's (which loses the 1 beside 1e100), the lost part
   forgotten or NaN after an infinity. */
static void sums(void)
{
    metro_sum sum = { 0, 0 }, many = { 0, 0 }, tenths = { 0, 0 };
    metro_rng rng = metro_rng_make(7, 0);
    int64_t exact = 0;
    int i;
    CHECK(metro_sum_value(&sum) == 0, "the empty sum");
    metro_sum_add(&sum, 1);
    metro_sum_add(&sum, 1e100);
    metro_sum_add(&sum, 1);
    metro_sum_add(&sum, -1e100);
    CHECK(metro_sum_value(&sum) == 2, "1 + 1e100 + 1 - 1e100 is %g", metro_sum_value(&sum));
    /* Whole numbers of very different size, whose sum fits 63 bits: only the last rounding may be seen. */
    for (i = 0; i < 100000; i++) {
        int64_t term = (int64_t)(metro_rng_next(&rng) >> (12 + metro_rng_below(&rng, 50)));
        if (i % 2) term = -term;
        exact += term;
        metro_sum_add(&many, (double)term / 1048576.0);
    }
    CHECK_NEAR(metro_sum_value(&many), (double)exact / 1048576.0, 2.3e-16);
    /* The double nearest 0.1 is 0.1 + 5.55e-18. */
    for (i = 0; i < 10000000; i++) metro_sum_add(&tenths, 0.1);
    CHECK_NEAR(metro_sum_value(&tenths), 1e6 + 5.551115123125783e-11, 2.3e-16);
    metro_sum_add(&tenths, (double)INFINITY);
    metro_sum_add(&tenths, 1);
    CHECK(isinf(metro_sum_value(&tenths)) && metro_sum_value(&tenths) > 0, "infinity became %g",
          metro_sum_value(&tenths));
    metro_sum_add(&tenths, -(double)INFINITY);
    CHECK_NAN(metro_sum_value(&tenths));
    metro_sum_add(&sum, (double)NAN);
    CHECK_NAN(metro_sum_value(&sum));
}

/* The same values by two passes, in a unit in which nothing overflows, for scales over 600 decades, and in an order
   in which the largest comes early, late and in between. Catches: squares that overflow, a scale that is not taken
   out of the mean, the sum of squares minus the squared mean. */
static void moments_of_scale(double scale, int order)
{
    enum { MOST = 500 };
    const int n = MOST;
    double value[MOST], mean = 0, squares = 0;
    metro_moments moments = { 0, 0, 0, 0 };
    metro_rng rng = metro_rng_make(9, (uint64_t)order);
    int i;
    for (i = 0; i < n; i++) {
        double size = order == 0 ? 1.0 : order == 1 ? 1.0 / (1 + i) : order == 2 ? (1.0 + i) / n : 0.0;
        if (order == 3) size = metro_rng_uniform(&rng);
        value[i] = size * (metro_rng_uniform(&rng) - 0.4);
    }
    for (i = 0; i < n; i++) mean += value[i] / n;
    for (i = 0; i < n; i++) squares += (value[i] - mean) * (value[i] - mean);
    for (i = 0; i < n; i++) metro_moments_add(&moments, value[i] * scale);
    CHECK(moments.count == (uint64_t)n, "counted %d", (int)moments.count);
    CHECK_CLOSE(metro_moments_mean(&moments) / scale, mean, 1e-14);
    CHECK_NEAR(metro_moments_error(&moments) / scale, sqrt(squares / (n - 1) / n), 1e-12);
    if (scale > 1e-140 && scale < 1e140)
        CHECK_NEAR(metro_moments_variance(&moments) / scale / scale, squares / (n - 1), 1e-12);
    CHECK(scale < 1e200 || isinf(metro_moments_variance(&moments)), "the variance of 1e200 is no double");
}

static void moments(void)
{
    static const double scale[] = { 1e-300, 1e-200, 1e-100, 1, 1e100, 1e200, 1e300 };
    metro_moments m = { 0, 0, 0, 0 }, far = { 0, 0, 0, 0 };
    size_t i;
    for (i = 0; i < 4 * (sizeof scale / sizeof *scale); i++) moments_of_scale(scale[i / 4], (int)(i % 4));
    CHECK_NAN(metro_moments_mean(&m));
    CHECK_NAN(metro_moments_variance(&m));
    CHECK_NAN(metro_moments_error(&m));
    metro_moments_add(&m, 0);
    CHECK(metro_moments_mean(&m) == 0, "the mean of 0");
    CHECK_NAN(metro_moments_variance(&m));
    CHECK_NAN(metro_moments_error(&m));
    metro_moments_add(&m, 0);
    CHECK(metro_moments_variance(&m) == 0 && metro_moments_error(&m) == 0, "the variance of 0, 0");
    metro_moments_add(&m, -3e-300);
    CHECK_NEAR(metro_moments_mean(&m), -1e-300, 1e-15);
    metro_moments_add(&m, 1e300);
    CHECK_NEAR(metro_moments_mean(&m), 2.5e299, 1e-15);
    CHECK_NEAR(metro_moments_error(&m), 2.5e299, 1e-14);
    metro_moments_add(&m, (double)NAN);
    CHECK_NAN(metro_moments_mean(&m));
    CHECK_NAN(metro_moments_error(&m));
    /* 1e9 + 0, 1, 2 alternating: the variance is that of 0, 1, 2. */
    for (i = 0; i < 3000; i++) metro_moments_add(&far, 1e9 + (double)(i % 3));
    CHECK_NEAR(metro_moments_mean(&far), 1e9 + 1, 1e-14);
    CHECK_NEAR(metro_moments_variance(&far), 2000.0 / 2999.0, 1e-6);
}

/* ---- Sobol points ---- */

/* The rows of Joe and Kuo's list as published (degree, polynomial, first integers), continued by eq 2.3 in another
   form than the table's. Catches: a number of the table mistyped, a shift off by one, digits from the wrong end. */
static void sobol_table(void)
{
    static const unsigned published[31][9] = {
        { 1, 0, 1 }, { 2, 1, 1, 3 }, { 3, 1, 1, 3, 1 }, { 3, 2, 1, 1, 1 }, { 4, 1, 1, 1, 3, 3 },
        { 4, 4, 1, 3, 5, 13 },
        { 5, 2, 1, 1, 5, 5, 17 }, { 5, 4, 1, 1, 5, 5, 5 }, { 5, 7, 1, 1, 7, 11, 19 }, { 5, 11, 1, 1, 5, 1, 1 },
        { 5, 13, 1, 1, 1, 3, 11 }, { 5, 14, 1, 3, 5, 5, 31 }, { 6, 1, 1, 3, 3, 9, 7, 49 },
        { 6, 13, 1, 1, 1, 15, 21, 21 },
        { 6, 16, 1, 3, 1, 13, 27, 49 }, { 6, 19, 1, 1, 1, 15, 7, 5 }, { 6, 22, 1, 3, 1, 15, 13, 25 },
        { 6, 25, 1, 1, 5, 5, 19, 61 }, { 7, 1, 1, 3, 7, 11, 23, 15, 103 }, { 7, 4, 1, 3, 7, 13, 13, 15, 69 },
        { 7, 7, 1, 1, 3, 13, 7, 35, 63 }, { 7, 8, 1, 3, 5, 9, 1, 25, 53 }, { 7, 14, 1, 3, 1, 13, 9, 35, 107 },
        { 7, 19, 1, 3, 1, 5, 27, 61, 31 }, { 7, 21, 1, 1, 5, 11, 19, 41, 61 }, { 7, 28, 1, 3, 5, 3, 3, 13, 69 },
        { 7, 31, 1, 1, 7, 13, 1, 19, 1 }, { 7, 32, 1, 3, 7, 5, 13, 19, 59 }, { 7, 37, 1, 1, 3, 9, 25, 29, 41 },
        { 7, 41, 1, 3, 5, 13, 23, 1, 55 }, { 7, 42, 1, 3, 7, 3, 13, 59, 17 }
    };
    unsigned d, j, i;
    for (d = 0; d < 32; d++) {
        /* v_j = m_j / 2^j as 32 binary places, continued as Bratley and Fox (1988) do. */
        uint32_t v[24];
        unsigned s = d == 0 ? 0 : published[d - 1][0], a = d == 0 ? 0 : published[d - 1][1];
        for (j = 0; j < 24; j++) {
            if (d == 0) v[j] = 0x80000000u >> j;
            else if (j < s) v[j] = (uint32_t)published[d - 1][2 + j] << (31 - j);
            else {
                v[j] = v[j - s] ^ (v[j - s] >> s);
                for (i = 1; i < s; i++)
                    if (a >> (s - 1 - i) & 1) v[j] ^= v[j - i];
            }
            CHECK(metroi_sobol_digits((uint32_t)1 << j, d) == v[j] >> 8, "coordinate %d, number %d", (int)d,
                  (int)j + 1);
        }
        CHECK(metroi_sobol_digits(0, d) == 0, "point 0");
        CHECK(metroi_sobol_digits(0xb00005, d) == (v[0] ^ v[2] ^ v[20] ^ v[21] ^ v[23]) >> 8,
              "a sum in coordinate %d", (int)d);
    }
}

/* Any 2^k points from a multiple of 2^k: one in each interval of length 2^-k, in every coordinate, whatever the
   scramble and the block. Catches: coins that do not hang on the digits above (an interval is torn), digits out of
   order, the index of a block left in. */
static void sobol_intervals(void)
{
    static const uint64_t start[] = { 0, 1, 5, UINT64_C(1) << 16, (UINT64_C(1) << 24) + 3, UINT64_C(1) << 40 };
    static unsigned char seen[1 << 10];
    unsigned d, k;
    size_t b, torn = 0;
    uint64_t i;
    for (d = 0; d < 32; d++)
        for (b = 0; b < sizeof start / sizeof *start; b++)
            for (k = 1; k <= 10; k += 3) {
                uint64_t count = (uint64_t)1 << k;
                memset(seen, 0, sizeof seen);
                for (i = 0; i < count; i++) {
                    double x = metro_sobol((start[b] << k) + i, d, 100 + b);
                    CHECK(x >= 0 && x < 1, "%g is outside [0, 1)", x);
                    torn += seen[cell_of(x, (size_t)count)]++ != 0;
                }
            }
    CHECK(torn == 0, "%d intervals hold two points", (int)torn);
}

/* The first two coordinates are a (0, 2)-sequence: 2^m points meet each of the boxes 2^-a by 2^-(m-a), for every a.
   Catches: the second row of the table wrong, one scramble's key used for both coordinates with swapped digits, a
   scramble that tears boxes. */
static void sobol_boxes(void)
{
    static unsigned char seen[1 << 10];
    uint64_t scramble, start, i;
    unsigned m, a;
    size_t missed = 0;
    for (scramble = 0; scramble < 20; scramble++)
        for (m = 2; m <= 10; m += 4)
            for (a = 0; a <= m; a++)
                for (start = 0; start < 3; start++) {
                    memset(seen, 0, sizeof seen);
                    for (i = 0; i < (uint64_t)1 << m; i++) {
                        uint64_t index = (start << m) + i;
                        size_t column = cell_of(metro_sobol(index, 0, scramble), (size_t)1 << a);
                        size_t row = cell_of(metro_sobol(index, 1, scramble), (size_t)1 << (m - a));
                        missed += seen[(column << (m - a)) + row]++ != 0;
                    }
                }
    CHECK(missed == 0, "%d boxes hold two points", (int)missed);
}

/* Over scrambles each point is uniform, its digits beyond the 24th too, and its coordinates are independent of each
   other, of the next scramble and of the next block. Catches: a first digit that is never flipped, further digits
   left 0 (a bias), one key for all coordinates, a key that neighbours share, the same coins at several levels. */
static void sobol_uniform_over_scrambles(void)
{
    static const uint64_t point[] = { 0, 1, 12345, (UINT64_C(1) << 24) - 1, UINT64_C(1) << 24, UINT64_MAX };
    static double cells[64], digits[64 * 64], fine[64], pair[16 * 16], next[16 * 16], cross[16 * 16], block[16 * 16];
    uint64_t scramble, n = check_count(50000, 10000);
    size_t p;
    for (p = 0; p < sizeof point / sizeof *point; p++) {
        unsigned d = (unsigned)(5 * p % 31);
        memset(cells, 0, sizeof cells);
        memset(digits, 0, sizeof digits);
        memset(fine, 0, sizeof fine);
        memset(cross, 0, sizeof cross);
        memset(pair, 0, sizeof pair);
        memset(next, 0, sizeof next);
        memset(block, 0, sizeof block);
        for (scramble = 0; scramble < n; scramble++) {
            double x = metro_sobol(point[p], d, scramble), y = metro_sobol(point[p], d + 1, scramble);
            double z = metro_sobol(point[p], d, scramble + 1), grid = x * 16777216.0;
            double w = metro_sobol(point[p] ^ UINT64_C(1) << 24, d, scramble);
            double v = metro_sobol(point[p], d + 1, scramble - 1);
            cells[cell_of(x, 64)]++;
            digits[64 * cell_of(x, 64) + cell_of(64 * x - floor(64 * x), 64)]++;
            cross[16 * cell_of(x, 16) + cell_of(v, 16)]++;
            fine[cell_of(grid - floor(grid), 64)]++;
            pair[16 * cell_of(x, 16) + cell_of(y, 16)]++;
            next[16 * cell_of(x, 16) + cell_of(z, 16)]++;
            block[16 * cell_of(x, 16) + cell_of(w, 16)]++;
        }
        check_even("one coordinate", cells, 64);
        check_even("beyond 24 digits", fine, 64);
        check_even("two coordinates", pair, 16 * 16);
        check_even("two scrambles", next, 16 * 16);
        check_even("two scrambles across coordinates", cross, 16 * 16);
        check_even("twelve digits", digits, 64 * 64);
        check_even("two blocks", block, 16 * 16);
    }
}

/* Within one scramble the digits beyond the 24th differ from point to point. Catches: one tail for all points, which
   no single point shows. */
static void sobol_tails(void)
{
    static double pair[32 * 32];
    uint64_t i, scramble, n = check_count(20000, 20000);
    for (scramble = 0; scramble < 4; scramble++) {
        double before = 0.5;
        memset(pair, 0, sizeof pair);
        for (i = 0; i < n; i++) {
            double grid = metro_sobol(i, 7, scramble) * 16777216.0, tail = grid - floor(grid);
            pair[32 * cell_of(before, 32) + cell_of(tail, 32)]++;
            before = tail;
        }
        check_even("tails", pair, 32 * 32);
    }
}

/* The fifteen coins that decide the first four digits, as one number of 15 bits over many scrambles: 2^15 patterns,
   all equally frequent. The first coordinate of point i is i mirrored, so point i shows the coins on the way to i.
   Catches: one flip for all points (a digital shift takes 16 patterns), the multiplications of Laine and Karras (128
   or so). */
static void sobol_coins(void)
{
    static double count[1 << 15];
    uint64_t scramble, n = check_count(400000, 200000);
    memset(count, 0, sizeof count);
    for (scramble = 0; scramble < n; scramble++) {
        size_t pattern = 0, node = 0;
        unsigned level, prefix;
        for (level = 0; level < 4; level++)
            for (prefix = 0; prefix < 1u << level; prefix++, node++) {
                /* The points 0 .. 2^level - 1 have a 0 in the digit that comes after `level` others. */
                size_t digits = cell_of(metro_sobol(prefix, 0, scramble), (size_t)2 << level);
                pattern |= (digits & 1) << node;
            }
        count[pattern]++;
    }
    check_even("coins", count, 1 << 15);
}

/* Smooth in four coordinates, integral 1: the product of 1 + (x - 1/2). Its variance at one point is (13/12)^4 - 1 =
   .3774. */
static double smooth(uint64_t index, uint64_t scramble)
{
    double product = 1;
    unsigned d;
    for (d = 0; d < 4; d++) product *= 0.5 + metro_sobol(index, d, scramble);
    return product;
}

/* A quarter disc: not even continuous. Integral pi/4, variance .1685. */
static double disc(uint64_t index, uint64_t scramble)
{
    double x = metro_sobol(index, 0, scramble), y = metro_sobol(index, 1, scramble);
    return x * x + y * y < 1 ? 1 : 0;
}

/* The mean of n points, over many scrambles: its mean in `mean`, returned its root mean square error. */
static double sobol_error(double (*f)(uint64_t, uint64_t), double truth, uint64_t n, uint64_t scrambles,
                          metro_moments *mean)
{
    double squares = 0;
    uint64_t scramble, i;
    memset(mean, 0, sizeof *mean);
    for (scramble = 0; scramble < scrambles; scramble++) {
        double sum = 0;
        for (i = 0; i < n; i++) sum += f(i, scramble + 1000);
        metro_moments_add(mean, sum / (double)n);
        squares += (sum / (double)n - truth) * (sum / (double)n - truth);
    }
    return sqrt(squares / (double)scrambles);
}

/* Unbiased within the standard error that the scrambles themselves show, and the error falls faster than 1/sqrt(n):
   from 16 to 4096 points a random sample gains 16. Here it must gain 400 for the smooth function (n^-3/2 would gain
   4096) and 30 for the disc (n^-3/4 would gain 64); the ratio of root mean squares over 128 scrambles is uncertain by
   some 10 %. Catches: the same scramble for all (the mean off by many errors), points that clump. */
static void sobol_converges(void)
{
    metro_moments mean;
    double few, many, n_many = 4096, disc_truth = PI / 4;
    uint64_t scrambles = check_count(128, 64);
    few = sobol_error(smooth, 1.0, 16, scrambles, &mean);
    CHECK_SIGMA(metro_moments_mean(&mean), 1.0, metro_moments_error(&mean));
    many = sobol_error(smooth, 1.0, 4096, scrambles, &mean);
    CHECK_SIGMA(metro_moments_mean(&mean), 1.0, metro_moments_error(&mean));
    CHECK(many < few / 400, "smooth: from %g at 16 points to %g at 4096", few, many);
    CHECK(many < sqrt(0.3774 / n_many) / 50, "smooth: %g, random points would have %g", many, sqrt(0.3774 / n_many));
    few = sobol_error(disc, disc_truth, 16, scrambles, &mean);
    CHECK_SIGMA(metro_moments_mean(&mean), disc_truth, metro_moments_error(&mean));
    many = sobol_error(disc, disc_truth, 4096, scrambles, &mean);
    CHECK_SIGMA(metro_moments_mean(&mean), disc_truth, metro_moments_error(&mean));
    CHECK(many < few / 30, "disc: from %g at 16 points to %g at 4096", few, many);
    CHECK(many < sqrt(0.1685 / n_many) / 3, "disc: %g, random points would have %g", many, sqrt(0.1685 / n_many));
}

/* Catches: a read beyond the table. */
static void sobol_arguments(void)
{
    CHECK_NAN(metro_sobol(0, 32, 0));
    CHECK_NAN(metro_sobol(5, 4000000000u, 0));
    CHECK(metro_sobol(UINT64_MAX, 31, UINT64_MAX) < 1 && metro_sobol(UINT64_MAX, 31, UINT64_MAX) >= 0,
          "the last point");
    CHECK(metro_sobol(77, 3, 5) == metro_sobol(77, 3, 5), "a point changes");
}

int main(void)
{
    CHECK_RUN(recurrence);
    CHECK_RUN(copies_go_on_alike);
    CHECK_RUN(uniform);
    CHECK_RUN(streams);
    CHECK_RUN(below);
    CHECK_RUN(normal);
    CHECK_RUN(direction);
    CHECK_RUN(sums);
    CHECK_RUN(moments);
    CHECK_RUN(sobol_table);
    CHECK_RUN(sobol_intervals);
    CHECK_RUN(sobol_boxes);
    CHECK_RUN(sobol_uniform_over_scrambles);
    CHECK_RUN(sobol_tails);
    CHECK_RUN(sobol_coins);
    CHECK_RUN(sobol_converges);
    CHECK_RUN(sobol_arguments);
    return check_done("randomness");
}
