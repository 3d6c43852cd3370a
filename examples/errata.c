/* errata.c: the errors in the paper, each with a number that decides. The formula as printed and the formula as it
   should be are evaluated for one small case; a third number comes from neither: it is simulated, summed by brute
   force or worked out by hand for that case. See: the third column agrees with the second, never with the first.

   Writes out/errata.csv. */
#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "plot.h"

static plot_csv csv;

/* One row, on the terminal and in the file. `slack` is the standard error of the evidence, or its rounding. */
static void row(const char *place, const char *quantity, double printed, double right, double evidence, double slack)
{
    printf("%-14s %-44s %12.6g %12.6g %12.6g +- %.1g\n", place, quantity, printed, right, evidence, slack);
    plot_csv_text(&csv, place);
    plot_csv_text(&csv, quantity);
    PLOT_CSV_ROW(&csv, printed, right, evidence, slack);
}

/* Paper (1): the error of a mean of M values. M = 100 values of deviation sigma = 1/2, repeated. */
static void standard_error(void)
{
    enum { M = 100, REPEATS = 20000 };
    metro_rng rng = metro_rng_make(1, 0);
    metro_moments m = { 0 };
    int i, r;
    for (r = 0; r < REPEATS; r++) {
        double sum = 0;
        for (i = 0; i < M; i++) sum += metro_rng_uniform(&rng) < 0.5;
        metro_moments_add(&m, sum / M);
    }
    row("paper_1", "variance of a mean of 100 coins", 0.5 / 10, 0.25 / 100, metro_moments_variance(&m),
        0.25 / 100 * sqrt(2.0 / REPEATS));
}

/* Paper (2): with one chain of M steps from a seed, b times the mean of f/I misses the integral of f. Here f is
   cos(2 pi x), I is 1, and the integral 0; eq 5.7's P*(1)^n gives what the chain still remembers. */
static void equality(void)
{
    enum { CHAINS = 20000, M = 50 };
    metro_kernel kernel = { METRO_UNIFORM, 0.1, 0, 0 };
    double p = metro_kernel_coefficient(&kernel, 1), bias = p * (1 - pow(p, M)) / (1 - p) / M;
    metro_moments m = { 0 };
    int c, i;
    for (c = 0; c < CHAINS; c++) {
        metro_rng rng = metro_rng_make(2, (uint64_t)c);
        double x = 0, sum = 0;
        for (i = 0; i < M; i++) {
            x = metro_kernel_perturb(&kernel, x, &rng);
            sum += cos(6.283185307179586 * x);
        }
        metro_moments_add(&m, sum / M);
    }
    row("paper_2", "expected mean of 50 steps from a seed", 0, bias, metro_moments_mean(&m), metro_moments_error(&m));
}

/* The algorithm of section 1.1: on a ring of five states, one step to the right with probability .7, to the left with
   .3. As printed, T cancels. The share of the last state, by the powers of both matrices and by counting. */
static double ring_share(const double target[5], int right_way)
{
    double p[5] = { 0.2, 0.2, 0.2, 0.2, 0.2 }, q[5], go[2] = { 0.7, 0.3 };
    int n, i, k;
    for (n = 0; n < 4000; n++) {
        memset(q, 0, sizeof q);
        for (i = 0; i < 5; i++)
            for (k = 0; k < 2; k++) {
                int t = (i + (k == 0 ? 1 : 4)) % 5;
                double ratio = target[t] / target[i], a;
                if (right_way) ratio *= go[1 - k] / go[k]; /* T(t -> i)/T(i -> t) */
                a = ratio < 1 ? ratio : 1;
                q[t] += p[i] * go[k] * a;
                q[i] += p[i] * go[k] * (1 - a);
            }
        memcpy(p, q, sizeof p);
    }
    return p[4];
}

static void algorithm(void)
{
    static const double target[5] = { 0.05, 0.1, 0.15, 0.2, 0.5 };
    row("section_1.1", "share of the last of five states", ring_share(target, 0), ring_share(target, 1), target[4],
        1e-12);
}

/* Paper (3): Int p_n(y) P(x -> y) dy. A kernel that drifts to the right by .02 on average; where is it after ten
   steps? The printed form runs the transitions backwards. */
static void direction(void)
{
    metro_rng rng = metro_rng_make(3, 0);
    metro_moments m = { 0 };
    int c, i;
    for (c = 0; c < 20000; c++) {
        double x = 0;
        for (i = 0; i < 10; i++) x += 0.02 + 0.1 * (metro_rng_uniform(&rng) - 0.5);
        metro_moments_add(&m, x);
    }
    row("paper_3", "mean place after ten steps of drift .02", -0.2, 0.2, metro_moments_mean(&m),
        metro_moments_error(&m));
}

/* Paper (12) on a period of 2 pi: three steps of width 1. The density is then the quadratic B-spline, whose square
   integrates to 11/20; the distance from the uniform 1/(2 pi) follows by hand. */
static void period(void)
{
    double sum = 0;
    int k;
    for (k = 1; k < 100000; k++) sum += 2 * pow(sin(k / 2.0) / (k / 2.0), 6);
    row("paper_11", "E_3 of width 1 on a circle of length 2 pi", sqrt(sum), sqrt(sum / 6.283185307179586),
        sqrt(11.0 / 20 - 1 / 6.283185307179586), 1e-12);
}

/* Paper (15): three seeds. The evidence sums the square of the density itself, three B-splines, over a fine grid. */
static double spline(double x) /* the density of a sum of three uniform numbers of [-1/2, 1/2] */
{
    x = fabs(x);
    if (x < 0.5) return 0.75 - x * x;
    return x < 1.5 ? (1.5 - x) * (1.5 - x) / 2 : 0;
}

static void seeds(void)
{
    enum { GRID = 60000, N = 3 };
    static const double seed[3] = { 0, 0.25, 0.6 }, alpha[3] = { 0.2, 0.3, 0.5 };
    metro_kernel kernel = { METRO_UNIFORM, 0.3, 0, 0 };
    double printed = 0, truth = 0;
    int k, i, j, wrap;
    for (k = 1; k < 2000; k++) {
        double re = 0, im = 0, p = metro_kernel_coefficient(&kernel, (uint64_t)k);
        for (j = 0; j < 3; j++) {
            re += alpha[j] * cos(6.283185307179586 * k * seed[j]);
            im += alpha[j] * sin(6.283185307179586 * k * seed[j]);
        }
        printed += 2 * pow(p * p * (re * re + im * im), N);
    }
    for (i = 0; i < GRID; i++) {
        double x = (i + 0.5) / GRID, density = -1;
        for (j = 0; j < 3; j++)
            for (wrap = -1; wrap <= 1; wrap++) density += alpha[j] * spline((x - seed[j] + wrap) / 0.3) / 0.3;
        truth += density * density / GRID;
    }
    row("paper_15", "E_3 from three seeds; width .3", sqrt(printed),
        metro_startup_error_seeds(&kernel, N, seed, alpha, 3), sqrt(truth), 1e-8);
}

/* Paper (16): the density of the uniform perturbation, summed over the circle. */
static void density(void)
{
    enum { GRID = 100000 };
    metro_kernel kernel = { METRO_UNIFORM, 0.3, 0, 0 };
    double printed = 0, right = 0;
    int i;
    for (i = 0; i < GRID; i++) {
        double x = (i + 0.5) / GRID - 0.5;
        printed += (fabs(x) < 0.3 ? 1 / 0.3 : 0) / GRID;
        right += metro_kernel_density(&kernel, 0, x) / GRID;
    }
    row("paper_16", "integral of the uniform perturbation", printed, right, 1, 1e-5);
}

/* Paper (18): nine draws whose correlation at lag k is (-1)^k. Their mean is known: it is x/9. */
static void bernstein(void)
{
    double rho[9];
    int k;
    for (k = 0; k < 9; k++) rho[k] = k % 2 ? -1 : 1;
    row("paper_18", "variance of a mean of nine: alternating draws", (1 + 2 * (-1.0)) / 9, metro_bernstein(rho, 9, 9),
        1.0 / 81, 1e-15);
}

/* Section 2.3: "the number of mutations should be much greater than 1/Delta". At 10/Delta the error does not fall
   below a bound as it would if that were the scale. Steps until E_n < .1, against ten times the size. */
static uint64_t steps_to_forget(double size)
{
    metro_kernel kernel = { METRO_UNIFORM, 0, 0, 0 };
    uint64_t low = 1, high = (uint64_t)1 << 40;
    kernel.size = size;
    while (low < high) {
        uint64_t middle = low + (high - low) / 2;
        if (metro_startup_error(&kernel, middle) < 0.1) high = middle;
        else low = middle + 1;
    }
    return low;
}

static void diffusion(void)
{
    double ratio = (double)steps_to_forget(0.001) / (double)steps_to_forget(0.01);
    row("section_2.3", "steps to forget: Delta .001 against .01", 10, 100, ratio, 1);
}

int main(void)
{
    csv = plot_csv_open("out/errata.csv", "place,quantity,printed,right,evidence,evidence_error");
    printf("%-14s %-44s %12s %12s %12s\n", "paper", "what", "printed", "right", "evidence");
    standard_error();
    equality();
    algorithm();
    direction();
    period();
    seeds();
    density();
    bernstein();
    diffusion();
    if (plot_csv_close(&csv) != 0) return 1;
    printf("out/errata.csv: nine errors of the paper, each with a number that decides\n");
    return 0;
}
