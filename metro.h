/* metro.h - Metropolis sampling and its start-up bias, in one C header.

   Version 0.1.0. License: MIT-0 (at the end of the file).

   A Markov chain starts somewhere, and for a while its samples tell of that place. How long? How far off is a picture
   made of such samples, and how much of what is wrong with it is the start, how much the noise of samples that follow
   each other closely? Szirmay-Kalos, Dornbach and Purgathofer asked this in 1999 ("On the start-up bias problem of
   Metropolis sampling"). This header answers in formulas that are exact to twelve digits, in a sampler that shows the
   same numbers, and in pictures. It is also a book: read it from here to the end, or weave it into HTML with `make
   docs`.

   To use it, drop this file beside a program. In one of its C or C++ files write

       #define METRO_IMPLEMENTATION
       #include "metro.h"

   and in all others the second line only; then `cc -O2 program.c -lm` builds it. C99, C11, C17 and C++11 will do, and
   nothing is needed but libc and libm. These may be defined before the include:

   - METRO_STATIC: all functions are static, so that several files may carry their own copy.
   - METRO_MALLOC, METRO_REALLOC, METRO_FREE: all three, another allocator.
   - METRO_NO_THREADS: leaves out POSIX threads; runs use one.
   - METRO_NO_TRACER: leaves out chapters 9 to 14, so that a lesson on the sampler compiles in a blink.
   - METRO_NO_SIMD: rays are traced in plain C, at half the speed, for the same pictures.
   - METRO_ASSERT(condition): what to do about a programmer's error, the start of a chain that was not made; `assert`
     otherwise.

   This program follows one chain, and prints beside it how much of the seed theory says is left:

       #define METRO_IMPLEMENTATION
       #include "metro.h"

       int main(void)
       {
           metro_kernel kernel = { METRO_UNIFORM, 0.1, 0, 0 };
           metro_rng rng = metro_rng_make(1, 0);
           double x = 0.0;
           int n;
           for (n = 1; n <= 1000; n++) {
               x = metro_kernel_perturb(&kernel, x, &rng);
               if (n % 200 == 0)
                   printf("step %d: at %.3f, E_n = %.2g\n", n, x, metro_startup_error(&kernel, (uint64_t)n));
           }
           return 0;
       }

   Conventions. Public names begin with metro_, private ones with metroi_. Lengths are in units of the domain, whose
   length is 1; angles are in radians. Structs of options mean their defaults when zero. A function that can fail
   returns a metro_result, 0 for success, and leaves its outputs untouched on failure; a number that cannot be
   computed is NaN. There are no globals: two threads may use two chains. The same seed gives the same numbers on any
   number of threads.

   How the book is written. Comments that begin in the first column are its prose, the code between them its listings.
   An equation stands on lines of its own with its number, and `eq 4.2` in code or prose refers to it; `paper (12)` is
   equation (12) of the paper, and appendix A says for each of those where it stands here and what was wrong with it.

   Contents

       R1 Ground
       R2 Randomness
       R3 Perturbations
       R4 The chain
       R5 Start-up theory
       R5.1 Start-up theory on the sphere and of a run
       R6 The operator
       R7 Diagnostics
       R8 Pictures
       R9 Geometry
       R10 BVH
       R11 Light
       R12 Paths
       R13 Metropolis light
       R14 Ray bundles
       1 Ground
       1.1 Results
       1.2 Vectors
       1.3 Rounds of jobs
       2 Randomness
       2.1 Streams
       2.2 Sums and moments
       2.3 Points that fill the cube evenly
       3 Perturbations
       3.1 Points and turns
       3.2 Arguments without loss
       3.3 What is a kernel
       3.4 Drawing a step
       3.5 The spectrum of Kelemen's kernel
       3.6 Ratios of Bessel functions
       3.7 One mode at a time
       3.8 Densities on the circle
       3.9 Directions
       3.10 Spectra on the sphere
       4 The chain
       4.1 Acceptance
       4.2 The space
       4.3 Making a chain
       4.4 A step
       4.5 Starting
       4.6 Veach's weighted seeds
       4.7 Burn-in and the normalisation
       5 Start-up theory
       5.1 Steps add up
       5.2 The series and the error
       5.3 Numbers that outlive the double
       5.4 When to stop
       5.5 The sum over modes
       5.6 A shorter circle
       5.7 Uniform perturbations
       5.8 Gaussian, Cauchy and von Mises perturbations
       5.9 Kelemen's perturbations
       5.10 Kelemen's far modes
       5.11 Large steps
       5.12 Many seeds
       5.13 The interval
       5.14 More dimensions
       5.15 The running mean
       5.16 The density itself
       5.17 Other distances
       5.18 The sphere
       5.19 The error of a run
       5.20 Covariances by doubling
       5.21 A chain that starts in equilibrium
       5.22 The best size
       6 The operator
       6.1 From an importance to a matrix
       6.2 What the seed leaves behind
       6.3 Distances, and the atom of rejections
       6.4 The spectrum
       6.5 The error of a run, for every seed
       6.6 The exponential
       6.7 The best size
       7 Diagnostics
       7.1 Numbers and their spread
       7.2 Bernstein's formula
       7.3 Autocorrelation
       7.4 The autocorrelation time
       7.5 The error of a mean
       7.6 Ranks
       7.7 R-hat
       7.8 Bulk and tail
       7.9 The squared jump
       7.10 Bias and variance apart
       7.11 What cannot be said
       7.12 Detailed balance
       7.13 Measuring the start-up error
       8 Pictures
       8.1 The picture
       8.2 Colour
       8.3 Numbers in text
       8.4 Reading
       8.5 Writing
       8.6 The error of a picture
       9 Geometry
       9.1 Triangles
       9.2 Filling a scene
       9.3 What a scene is as a whole
       9.4 Lines of text
       9.5 What the reader has to say
       9.6 Names
       9.7 Vertices and faces
       9.8 Polygons
       9.9 The OBJ file
       9.10 The MTL file
       9.11 Finding the MTL file
       9.12 Joining the caller's scene
       10 BVH
       10.1 Nodes and blocks
       10.2 Where to cut
       10.3 From two children to eight
       10.4 Into memory
       10.5 Building
       10.6 Rays and boxes
       10.7 Watertight triangles
       10.8 Four and eight at once
       10.9 The walk
       10.10 Leaving a surface
       11 Light
       11.1 Surfaces
       11.2 Lamps
       11.3 The camera
       12 Paths
       12.1 Numbers
       12.2 Walks
       12.3 Weights
       12.4 Going on
       12.5 Joining
       12.6 All ways of a path
       12.7 A picture that grows
       12.8 Rounds of paths
       13 Metropolis light
       13.1 The paper's state
       13.2 Primary sample space
       13.3 A pilot picture
       13.4 Chains in rounds
       13.5 How bright
       13.6 One call for all methods
       13.7 Errors that can be believed
       14 Ray bundles
       14.1 Patches
       14.2 A bundle
       14.3 Rows and spans
       14.4 Fragments
       14.5 Painting
       14.6 Infinitely many rays
       14.7 Walks
       14.8 The first shot
       14.9 Random and even walks
       14.10 Metropolis walks
       14.11 The picture
       A Equations of the paper
       B Symbols
       C License

   To use the header, read the interface, which comes next: its comments are the contracts. The chapters follow it. */

#ifndef METRO_H
#define METRO_H

#if !defined(__cplusplus) && (!defined(__STDC_VERSION__) || __STDC_VERSION__ < 199901L)
#error "metro.h needs C99 or later: compile with -std=c99"
#endif

#include <stddef.h>
#include <stdint.h>

#define METRO_VERSION "0.1.0"
#define METRO_VERSION_MAJOR 0
#define METRO_VERSION_MINOR 1
#define METRO_VERSION_PATCH 0

#if defined(__GNUC__) || defined(__clang__)
#define METROI_UNUSED __attribute__((unused))
#else
#define METROI_UNUSED
#endif
#ifndef METRO_API
#ifdef METRO_STATIC
#define METRO_API METROI_UNUSED static
#else
#define METRO_API extern
#endif
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* # R1 Ground

   Every function that can fail returns a `metro_result`. Zero is success; anything else is an error, and then the
   outputs are as they were before the call, unless the contract says otherwise. */

typedef enum {
    METRO_OK = 0,
    METRO_ERROR_ARGUMENT,      /* an argument is outside the range that its contract names */
    METRO_ERROR_MEMORY,        /* an allocation failed */
    METRO_ERROR_FILE,          /* a file cannot be opened, read or written */
    METRO_ERROR_FORMAT,        /* a file is not what it claims to be */
    METRO_ERROR_DARK_SEED,     /* a seed has zero importance: the chain could not leave a state it never takes */
    METRO_ERROR_BAD_SEED,      /* a seed has negative, infinite or NaN importance */
    METRO_ERROR_NO_IMPORTANCE, /* no candidate has positive importance */
    METRO_ERROR_NO_LIGHT,      /* nothing in the scene emits */
    METRO_ERROR_STOPPED        /* the caller's `stop` ended the run early; what was merged until then stands */
} metro_result;

/* The result in words, as a sentence that says what to do. Never NULL; the string is constant. */
METRO_API const char *metro_result_text(metro_result result);

/* A vector or a direction in space. */
typedef struct {
    double x, y, z;
} metro_vec3;

METRO_API metro_vec3 metro_vec3_make(double x, double y, double z);
METRO_API metro_vec3 metro_add(metro_vec3 a, metro_vec3 b);
METRO_API metro_vec3 metro_subtract(metro_vec3 a, metro_vec3 b);
METRO_API metro_vec3 metro_scale(metro_vec3 a, double factor);
METRO_API metro_vec3 metro_cross(metro_vec3 a, metro_vec3 b);
METRO_API double metro_dot(metro_vec3 a, metro_vec3 b);
METRO_API double metro_length(metro_vec3 a);

/* The vector of length 1 along `a`, safe for components from 1e-300 to 1e300. The zero vector and vectors with a
   component that is not finite give (NaN, NaN, NaN). */
METRO_API metro_vec3 metro_normalize(metro_vec3 a);

/* Long runs are cut into rounds, and a round into jobs. The number of jobs is part of the problem, never of the
   machine: a job draws from its own random stream, writes only to its own slot and to what no other job of the round
   touches, and the slots are merged in the order of jobs. So the answer is the same, bit for bit, on one thread or on
   sixty-four. */
typedef struct {
    uint64_t rounds;         /* how many rounds; 0 means 1 */
    uint64_t first_round;    /* the number of the first one, to go on where an earlier run ended */
    size_t jobs;             /* jobs in a round; 0 means 16 */
    size_t slot_size;        /* bytes that a job writes, a multiple of the alignment it needs; 0 is allowed */
    size_t threads;          /* 0 means one a core */
    /* Does job `job` (counted over all rounds: round * jobs + index) and leaves its outcome in `slot`, which arrives
       zeroed. Runs on any thread. Of what `user` reaches it may write only what belongs to its index, job % jobs, and
       to no other job: a chain, say, that lives from round to round. Rounds do not overlap, so the next job of this
       index finds what this one wrote, also when another job fails and the round is not merged. */
    metro_result (*work)(uint64_t job, void *slot, void *user);
    /* Takes the slot of one job into the result; called on the caller's thread, in the order of jobs. May be NULL. */
    metro_result (*merge)(uint64_t job, const void *slot, void *user);
    /* Asked after each whole round, with the number of rounds done; nonzero ends the run with METRO_ERROR_STOPPED. */
    int (*stop)(uint64_t rounds_done, void *user);
} metro_rounds;

/* Runs `plan`, handing `user` to its functions. Returns METRO_OK after the last round, METRO_ERROR_STOPPED when
   `stop` asked for it, METRO_ERROR_MEMORY, METRO_ERROR_ARGUMENT (`work` is NULL or the slots overflow a size), or the
   first result other than METRO_OK that a job returned, in the order of jobs; the round of that job is not merged. A
   `merge` that fails ends the run with its result; earlier slots stay merged. At most 257 threads work. Costs jobs *
   slot_size bytes and one thread creation a thread and round. */
METRO_API metro_result metro_rounds_run(const metro_rounds *plan, void *user);

/* The number of cores this process may use, at least 1. */
METRO_API size_t metro_core_count(void);

/* # R2 Randomness

   A stream of random numbers is a small value: copy it and both copies go on alike. */

typedef struct metro_rng {
    uint64_t state[4];
} metro_rng;

/* A stream for (seed, stream). Streams of different pairs start at unrelated places of a period of 2^256 - 1.
   Cost: 16 hashes of 64 bits. Source: xoshiro256++ (Blackman and Vigna 2021), its state filled by SplitMix64. */
METRO_API metro_rng metro_rng_make(uint64_t seed, uint64_t stream);

/* The next 64 random bits. */
METRO_API uint64_t metro_rng_next(metro_rng *rng);

/* A uniform number in [0, 1), a multiple of 2^-53. */
METRO_API double metro_rng_uniform(metro_rng *rng);

/* A uniform whole number in 0 .. bound - 1, without bias; 0 when bound is 0. Source: Lemire (2019). */
METRO_API uint64_t metro_rng_below(metro_rng *rng, uint64_t bound);

/* A standard normal number. Source: Box and Muller (1958); two uniforms a call, so that the stream stays in step. */
METRO_API double metro_rng_normal(metro_rng *rng);

/* A uniform direction. Source: Archimedes: the height of a uniform point of the sphere is uniform. */
METRO_API metro_vec3 metro_rng_direction(metro_rng *rng);

/* A sum that keeps what rounding would lose: the error does not grow with the number of terms. Source: Neumaier
   (1974). Start from { 0, 0 }. */
typedef struct {
    double sum, lost;
} metro_sum;

METRO_API void metro_sum_add(metro_sum *sum, double term);
METRO_API double metro_sum_value(const metro_sum *sum);

/* Mean and standard error of values that arrive one by one, safe from 1e-300 to 1e300. Start from { 0, 0, 0, 0 }. */
typedef struct {
    uint64_t count;
    double scale;    /* the largest magnitude so far: the moments are kept relative to it */
    double mean;     /* of value / scale */
    double squares;  /* sum of squared deviations of value / scale */
} metro_moments;

METRO_API void metro_moments_add(metro_moments *moments, double value);
METRO_API double metro_moments_mean(const metro_moments *moments);     /* NaN when empty */
METRO_API double metro_moments_variance(const metro_moments *moments); /* unbiased; NaN under two values */
METRO_API double metro_moments_error(const metro_moments *moments);    /* of the mean; NaN under two values */

/* Coordinate `dimension` (0 .. 31) of point `index` of a scrambled Sobol sequence, in [0, 1), a multiple of 2^-53.
   The points of one `scramble` fill the cube evenly, so a mean over them has a smaller error than over random ones;
   over all scrambles each point is uniform, so the mean is unbiased, and the means of a few scrambles show its error.
   Take the points from index 0 and a power of two of them. Each 2^24 points are scrambled afresh. A path that needs
   more than 32 coordinates takes the later ones from a stream. NaN when `dimension` is 32 or more. Cost: some tens of
   ns. Sources: Sobol (1967) with the numbers of Joe and Kuo (2008); scrambling of Owen (1995). */
METRO_API double metro_sobol(uint64_t index, unsigned dimension, uint64_t scramble);

/* # R3 Perturbations

   A perturbation kernel says where the next tentative sample may fall, seen from the current one. Each kernel comes
   three times: drawn, as a density, and as a spectrum, for the circle, for the interval and for the sphere. */

typedef enum {
    METRO_UNIFORM,
    METRO_TRIANGLE,
    METRO_GAUSSIAN,
    METRO_CAUCHY,
    METRO_VON_MISES,
    METRO_KELEMEN
} metro_shape;

/* A symmetric kernel in one dimension. It has no defaults: a `size` of 0 is an invalid kernel, except that a von
   Mises kernel of concentration 0 is the uniform draw. A kernel is valid when `shape` is one of the six, `size` is
   positive (METRO_VON_MISES: not negative) and finite, `large` lies in 0 .. 1, and for METRO_KELEMEN 0 < `size_min`
   <= `size`. Sizes above 1 are allowed: the kernel then wraps, or folds, more than once. */
typedef struct {
    metro_shape shape;
    double size;     /* UNIFORM: full width Delta; TRIANGLE: full width of the base; GAUSSIAN: standard deviation;
                        CAUCHY: scale gamma; VON_MISES: concentration kappa; KELEMEN: s2, the largest step.
                        Lengths are in units of the domain, whose length is 1. */
    double size_min; /* KELEMEN: s1, the smallest step; others: ignored */
    double large;    /* probability of an independent uniform draw instead (a "large step"), 0 .. 1 */
} metro_kernel;

/* Perturbs `x` on the circle of length 1 and returns the new point, always in [0, 1); any finite `x` is taken modulo
   1. NaN when the kernel is invalid or `x` is not finite (random numbers may be used up then). While `large` is 0
   nothing is drawn for it: METRO_UNIFORM is x + size * (metro_rng_uniform(rng) - 0.5), wrapped. A step of over 2^32
   turns ends at a uniform point. Cost: one random number for METRO_UNIFORM, METRO_CAUCHY and METRO_KELEMEN, two for
   METRO_TRIANGLE and METRO_GAUSSIAN, three a try for METRO_VON_MISES; one more if `large` > 0. Source: Best and
   Fisher (1979) for METRO_VON_MISES, Kelemen et al. (2002) for METRO_KELEMEN, inversion elsewhere. */
METRO_API double metro_kernel_perturb(const metro_kernel *k, double x, metro_rng *rng);

/* The density, per unit length of the circle, of the perturbation that goes from `from` to `to`: wrapped, with the
   large steps in it. The same, to the last bit, from `to` to `from`. At a jump (UNIFORM, KELEMEN) the mean of both
   sides. KELEMEN with size_min == size has two atoms: +INFINITY there, 0 elsewhere (plus `large`). NaN when the
   kernel is invalid or a point is not finite. Cost: at most some 70 divisions or 20 exponentials. */
METRO_API double metro_kernel_density(const metro_kernel *k, double from, double to);

/* The Fourier coefficient P*(harmonic) of the kernel on the circle, paper (17) for METRO_UNIFORM: a real number, even
   in `harmonic`, 1 at 0. NaN when the kernel is invalid. Absolute error below 1e-15 for harmonics to 1e6 and more;
   zeros are exact. Cost: a sine or an exponential; METRO_VON_MISES and METRO_KELEMEN: at most some 2000 terms. */
METRO_API double metro_kernel_coefficient(const metro_kernel *k, long harmonic);

/* The same three on the interval [0, 1] whose ends reflect: a point beyond an end comes back as far as it went over.
   The new point lies in [0, 1) - the end 1 itself, met once in 2^53, is moved to the number below it, so that
   (size_t)(n * x) is always a cell - and `x` beyond the ends is folded together with its step. The coefficient is the
   eigenvalue mu_k of cos(pi k x), the transform of the kernel at frequency k/2. METRO_VON_MISES lives on the circle
   only and gives NaN. */
METRO_API double metro_kernel_reflect_perturb(const metro_kernel *k, double x, metro_rng *rng);
METRO_API double metro_kernel_reflect_density(const metro_kernel *k, double from, double to);
METRO_API double metro_kernel_reflect_coefficient(const metro_kernel *k, long harmonic);

/* A uniform direction of the cone around `from` (length 1) whose sides stand `half_angle` radians off its axis: the
   apex angle of the paper's section 3.2 is twice that. From pi on the cone is the whole sphere. The result has length
   1 to the last digits, however often it is perturbed. NaN components when `half_angle` is not positive and finite or
   `from` is not of length 1 (its square off by over a per cent). Cost: two random numbers. Source: Archimedes;
   the frame is that of Duff et al. (2017). */
METRO_API metro_vec3 metro_cone_perturb(double half_angle, metro_vec3 from, metro_rng *rng);

/* Its density per steradian between the unit vectors `from` and `to`, the same both ways. NaN when `half_angle` is
   not positive and finite or a component is NaN; lengths are not checked. */
METRO_API double metro_cone_density(double half_angle, metro_vec3 from, metro_vec3 to);

/* The eigenvalue lambda_l of the spherical harmonics of degree l = `degree` under the cone of `half_angle` radians.
   NaN when `half_angle` is not positive and finite or `degree` is negative. Absolute error about 1e-15 at degree 1000
   and 1e-14 at 1e5. Cost: `degree` steps of a recurrence. */
METRO_API double metro_cone_coefficient(double half_angle, int degree);

/* The von Mises-Fisher kernel exp(kappa cos theta) on the sphere, theta the angle from the unit vector `from`: drawn,
   as a density per steradian, and its eigenvalue of degree `degree`. kappa = 0 is the uniform direction; NaN when
   kappa is negative or not finite, `degree` is negative, or (drawn only) `from` is not of length 1. Cost: two random
   numbers; the coefficient at most some 2000 steps of a recurrence. Source: Ulrich (1984) in the stable form of Jakob
   (2012). */
METRO_API metro_vec3 metro_vmf_perturb(double kappa, metro_vec3 from, metro_rng *rng);
METRO_API double metro_vmf_density(double kappa, metro_vec3 from, metro_vec3 to);
METRO_API double metro_vmf_coefficient(double kappa, int degree);

/* # R4 The chain

   A target is a space, an importance on it and what to do with samples. The importance I(z) says how much we want to
   see of the state z, in any unit: how bright the picture is there, say. A chain of states proposes a tentative
   state, accepts or rejects it, and in the long run visits each place in proportion to its importance.

   The space is a list of axes. A circle or an interval takes one coordinate of the state, in [0, 1]; a direction
   takes three, a vector of length 1. Volumes are measured so that each axis has total volume 1: a uniform draw has
   density 1.

   The order of calls is make, start, run, read, free. This program samples an importance of two coordinates and
   prints its integral b, and the mean of the first coordinate under it:

       #define METRO_IMPLEMENTATION
       #include "metro.h"

       static double bright(const double *z, void *sample, void *user)
       {
           (void)user;
           *(double *)sample = z[0];
           return z[0] * z[0] + 0.1 * z[1];
       }

       static void add(const void *sample, double weight, void *user)
       {
           metro_sum_add((metro_sum *)user, weight * *(const double *)sample);
       }

       int main(void)
       {
           metro_axis axes[2] = { { METRO_INTERVAL, { METRO_UNIFORM, 0.3, 0, 0 } },
                                  { METRO_CIRCLE, { METRO_GAUSSIAN, 0.1, 0, 0 } } };
           metro_sum sum = { 0, 0 };
           metro_target target = { axes, 2, sizeof(double), bright, add, NULL, &sum };
           metro_chain_options options = { 0.1, 1 };
           metro_chain chain;
           double b, error;
           metro_result result = metro_chain_make(&target, &options, metro_rng_make(1, 0), &chain);
           if (result == METRO_OK) result = metro_chain_start_weighted(&chain, 1000);
           if (result != METRO_OK) {
               printf("%s\n", metro_result_text(result));
               return 1;
           }
           metro_chain_run(&chain, 100000);
           b = metro_chain_b(&chain, &error);
           printf("b = %.4f +- %.4f, mean %.4f\n", b, error, metro_sum_value(&sum) / (double)chain.counts.steps);
           metro_chain_free(&chain);
           return 0;
       }
*/

typedef enum { METRO_CIRCLE, METRO_INTERVAL, METRO_DIRECTION } metro_axis_kind;

/* One axis and how it is perturbed. METRO_INTERVAL reflects at its ends and takes every shape but METRO_VON_MISES.
   METRO_DIRECTION takes METRO_UNIFORM, a cone whose half-angle in radians is `size` (half the paper's apex angle), or
   METRO_VON_MISES, the von Mises-Fisher kernel of concentration `size`. On every kind of axis `large` must be 0: the
   large step of a chain redraws all axes together and is an option of the chain. */
typedef struct {
    metro_axis_kind kind;
    metro_kernel kernel;
} metro_axis;

/* What the chain samples. The chain copies this struct, but not the axes or what `user` points to. The functions get
   `user` as it stands here. */
typedef struct {
    const metro_axis *axes;  /* [axis_count]; must outlive the chain */
    size_t axis_count;
    size_t sample_size;      /* bytes that `importance` may write to `sample`; may be 0 */
    /* The importance I(z) >= 0 of the state z; whatever the target wants to record about z goes into `sample`. */
    double (*importance)(const double *z, void *sample, void *user);
    /* Takes a sample with its weight; the weights of a step sum to 1, and stays add up. NULL: nothing is recorded. */
    void (*record)(const void *sample, double weight, void *user);
    /* The tentative transition: writes the tentative state to `to` and returns T(to -> from) / T(from -> to). It need
       not stay in the space if the importance is 0 outside. NULL: each axis is perturbed by its kernel, which is
       symmetric. */
    double (*propose)(const double *from, double *to, metro_rng *rng, void *user);
    void *user;
} metro_target;

/* Zero is the default. */
typedef struct {
    double large_step;    /* probability that a tentative state is a uniform draw of all axes together, 0 .. 1 */
    int expected_values;  /* nonzero: record the tentative state with weight a and the current one with 1 - a */
} metro_chain_options;

/* What a careful person asks a chain afterwards. */
typedef struct {
    uint64_t steps;          /* since the start or the end of the burn-in */
    uint64_t accepted;
    uint64_t longest_stay;   /* the most steps in a row that ended in the same state by rejection */
    uint64_t stay;           /* the steps in a row up to this one */
    uint64_t large_steps;    /* tentative states that were uniform draws */
    uint64_t dark;           /* tentative states of zero importance */
    uint64_t nan;            /* importances and transition ratios that were NaN, of tentative states, which are then
                                rejected, and of candidates and surveys, which then count as 0 */
    uint64_t negative;       /* the same for negative */
    uint64_t infinite;       /* and for infinite ones */
    metro_sum squared_jump;  /* sum of a(i -> t) times the squared distance from i to t (radians for directions) */
} metro_chain_counts;

/* A chain. Read its members, write none. */
typedef struct {
    metro_target target;
    metro_chain_options options;
    metro_rng rng;
    double *state;                 /* the current z: one double a circle or interval, three a direction */
    double *tentative;
    void *sample, *tentative_sample;
    double importance;             /* of the current state; 0 before a start */
    double weight;                 /* what the current sample has collected and not yet recorded */
    double start_weight;           /* the weight W of a start from weighted seeds, else 1 */
    metro_moments normalisation;   /* of the importances of independent uniform draws */
    metro_chain_counts counts;
    void *memory;
} metro_chain;

/* Makes a chain for `target` that draws from `rng`. `options` may be NULL. Returns METRO_ERROR_ARGUMENT for no axes,
   no importance, a kernel that is not valid on its axis (not looked at when the target proposes), or large_step
   outside [0, 1]; METRO_ERROR_MEMORY; on failure `chain` is unchanged. Costs one allocation of two states and two
   samples; a step allocates nothing. */
METRO_API metro_result metro_chain_make(const metro_target *target, const metro_chain_options *options, metro_rng rng,
                                        metro_chain *chain);

/* Frees what metro_chain_make allocated. A zeroed chain may be freed. */
METRO_API void metro_chain_free(metro_chain *chain);

/* Starts the chain at the state z, a point of the space, as the paper does: 0 <= z < 1 on a circle, 0 <= z <= 1 on an
   interval, a vector of length 1 within 1e-6 for a direction. Returns METRO_ERROR_ARGUMENT for any other z or NULL (a
   target that proposes by itself may leave the space, and its z is not looked at), METRO_ERROR_DARK_SEED if I(z) = 0,
   METRO_ERROR_BAD_SEED if it is negative, infinite or NaN; the chain is then where it was. A start sets the counts to
   zero and keeps what is known of b. Like a burn-in it drops what the current sample has collected since it was
   recorded last: flush before a restart that shall keep it. */
METRO_API metro_result metro_chain_start_point(metro_chain *chain, const double *z);

/* Starts at the seed z_i, chosen with probability alpha_i (paper (13)). `seeds` states follow each other in z;
   `alpha` has `seeds` numbers whose sum is 1 within 1e-9, or is NULL for equal ones. Returns METRO_ERROR_ARGUMENT for
   no seeds or other weights. One seed that metro_chain_start_point would refuse refuses all, even one of weight 0.
   Cost: `seeds` + 1 importances. */
METRO_API metro_result metro_chain_start_seeds(metro_chain *chain, const double *z, const double *alpha,
                                               size_t seeds);

/* Starts at one of `candidates` uniform draws, chosen in proportion to its importance, and sets `start_weight` to
   their mean importance: start_weight * (weighted mean of f / I) is then unbiased after any number of steps (Veach
   and Guibas 1997; eq 4.6). Returns METRO_ERROR_NO_IMPORTANCE if all candidates are dark: start_weight is 0, steps
   record nothing, and the estimate of this run is the 0 that keeps the mean over runs right. METRO_ERROR_ARGUMENT for
   no candidates. The candidates also enter the normalisation. */
METRO_API metro_result metro_chain_start_weighted(metro_chain *chain, size_t candidates);

/* Makes `steps` steps without recording and sets the counts to zero: a burn-in. What the current sample has collected
   is dropped (flush first to keep it); large steps still count for b. */
METRO_API void metro_chain_burn(metro_chain *chain, uint64_t steps);

/* Makes one step and returns 1 if the tentative state was accepted, else 0. A sample is recorded when the chain
   leaves it, with expected values also one that is rejected: call metro_chain_flush before reading the result. */
METRO_API int metro_chain_step(metro_chain *chain);

/* Makes `steps` steps and flushes. */
METRO_API void metro_chain_run(metro_chain *chain, uint64_t steps);

/* Records what the current sample has collected so far. */
METRO_API void metro_chain_flush(metro_chain *chain);

/* Draws `samples` independent uniform states for the sake of b alone; the chain stays where it is. */
METRO_API void metro_chain_survey(metro_chain *chain, uint64_t samples);

/* b, the integral of the importance: the mean over all independent draws of the chain so far (candidates, survey,
   large steps), of which NaN, negative and infinite ones count as 0. Unbiased if their number does not depend on
   them: a start that finds all candidates dark is followed by no large steps, and then a survey of fixed size is
   safer. NaN if there were none. If `error` is not NULL it gets the standard error, NaN under two draws. */
METRO_API double metro_chain_b(const metro_chain *chain, double *error);

/* # R5 Start-up theory

   A chain of constant importance starts at a point, or at one of several seeds, and forgets it step by step. These
   functions say, without a simulation, how far the density p_n of its n-th sample still is from the uniform density.
   The start-up error E_n is the paper's: the root of the integral of (p_n - 1)^2, eq 5.6.

   Common to all of them: n = 0 gives +INFINITY, because p_0 is a point mass; an invalid kernel (metro_kernel says
   which are valid) gives NaN. A kernel that lands uniformly in one step (METRO_UNIFORM of whole `size`,
   METRO_TRIANGLE of even `size`, METRO_VON_MISES of concentration 0, `large` = 1) has an error of exactly 0 for n >=
   1 (on the circle; on the interval from any seed METRO_UNIFORM needs an even `size` and METRO_TRIANGLE a multiple of
   4). METRO_KELEMEN with `size_min` == `size` jumps between points, so its error is +INFINITY for every n (with
   `large` = 1: 0). Nothing here allocates.

   Each error comes a second time as its natural logarithm, which is finite where the error itself underflows:
   -INFINITY means that the error is exactly 0.

   Accuracy, unless said otherwise: relative 1e-12, or 1e-12 of the logarithm where that is larger, for METRO_KELEMEN
   too, whatever the ratio of its sizes; 1e-9 for METRO_KELEMEN of sizes above 10, which may need half a million
   terms. Lengths below 1e-100 give NaN, and so does METRO_KELEMEN of sizes above 10000 at n = 1, and of sizes so
   close to each other that p_n is still a set of separate peaks beyond n = 5e11. */

/* The start-up error E_n after `n` steps from one seed, eq 5.7, paper (12). Cost: at most some 35 modes for every n
   and size, METRO_VON_MISES 300 (METRO_KELEMEN: up to some 20000 terms, beside the exception above); `make bench`
   says what that takes. */
METRO_API double metro_startup_error(const metro_kernel *k, uint64_t n);
METRO_API double metro_startup_log_error(const metro_kernel *k, uint64_t n);

/* The same when the chain starts at `seed[i]` with probability `alpha[i]`, i < `seeds`: eq 5.41, which is paper (15)
   corrected. `alpha` NULL means equal weights. Seeds are points of the circle and taken modulo 1. NaN when `seed` is
   NULL or `seeds` is 0, when a seed is not finite, when a weight is negative or not finite, and when the weights do
   not sum to 1 within 1e-9. Where seeds cancel modes (equispaced ones) the error is small against that of one seed,
   and is known to 1e-13 of the latter, to 1e-8 for n <= 2 and to 1e-6 for METRO_KELEMEN with more than 5000 modes;
   the logarithm is -INFINITY when nothing is left. Cost: for n >= 3 proportional to `seeds`, one sine and cosine a
   seed for each of a number of modes that is about 150/size at n = 3 and 1/size from n = 10 on; for n <= 2
   (METRO_TRIANGLE: n = 1), for up to eight seeds that do not cancel modes, and for seeds much farther apart than the
   chain has gone, proportional to seeds^2 but without the modes. */
METRO_API double metro_startup_error_seeds(const metro_kernel *k, uint64_t n, const double *seed, const double *alpha,
                                           size_t seeds);
METRO_API double metro_startup_log_error_seeds(const metro_kernel *k, uint64_t n, const double *seed,
                                               const double *alpha, size_t seeds);

/* The error of the running mean (p_burn + .. + p_{burn+steps-1})/steps, which is the density that a sample picked at
   random among `steps` samples after a burn-in has; one seed; eq 5.50. burn = 0 includes p_0: +INFINITY. steps = 0:
   NaN. Cost: at most some 400 modes while burn + steps <= 1000 (METRO_KELEMEN: some 20000 terms, but a million where
   its sizes are within some 1e-3 of each other); for tiny sizes it grows with the square root of `steps`. NaN for
   METRO_KELEMEN of such close sizes when burn + steps is above some 4000 and half a million modes would not do. */
METRO_API double metro_startup_error_mean(const metro_kernel *k, uint64_t burn, uint64_t steps);
METRO_API double metro_startup_log_error_mean(const metro_kernel *k, uint64_t burn, uint64_t steps);

/* The density p_n at `x` (taken modulo 1) of a chain that starts as in metro_startup_error_seeds: eqs 5.5 and 5.40,
   paper (9) and (14). n = 0: +INFINITY at a seed of positive weight, 0 elsewhere. n = 1: metro_kernel_density, so at
   a jump the mean of both sides. NaN for the arguments that give NaN there, for an `x` that is not finite, and for
   METRO_KELEMEN with `size_min` == `size` from n = 2 on, where there is no density, or of a size above 10000 at n =
   2. The error is below 1e-13 of the largest value of p_n (METRO_KELEMEN: 1e-12; 1e-9 at n = 3 for sizes above some 1
   and far apart, and from n = 4 on for sizes above 10). Cost: at most some 70 modes a seed, METRO_VON_MISES 300;
   METRO_KELEMEN: up to some 20000 terms from n = 3 on. */
METRO_API double metro_startup_density(const metro_kernel *k, uint64_t n, double x, const double *seed,
                                       const double *alpha, size_t seeds);

/* The start-up error of a chain on a torus that perturbs `axes` circle coordinates at once, coordinate i by the
   kernel `k[i]`, from one seed: eq 5.48. NaN for axes = 0 and when one of the kernels is invalid. Cost: that of the
   axes. */
METRO_API double metro_startup_error_axes(const metro_kernel *k, size_t axes, uint64_t n);
METRO_API double metro_startup_log_error_axes(const metro_kernel *k, size_t axes, uint64_t n);

/* The start-up error on the interval [0, 1] with reflecting ends, from the seed `x0`: eq 5.44. A seed beyond the ends
   is folded back; one that is not finite gives NaN, and so does METRO_VON_MISES, which lives on the circle only.
   Accuracy and cost: as metro_startup_error_seeds with two seeds. */
METRO_API double metro_reflect_startup_error(const metro_kernel *k, double x0, uint64_t n);
METRO_API double metro_reflect_startup_log_error(const metro_kernel *k, double x0, uint64_t n);

/* Upper bounds of two other distances between p_n, from one seed, and the uniform density: the total variation (1/2)
   int abs(p_n - 1), at most min(1, E_n/2), and the Kullback-Leibler divergence int p_n ln p_n in nats, at most ln(1 +
   E_n^2): eqs 5.58 and 5.59. For METRO_UNIFORM at n = 1, with large steps or without, both are the exact values, eqs
   5.60 and 5.61. At n = 0 the distances are 1 and +INFINITY. */
METRO_API double metro_startup_total_variation_bound(const metro_kernel *k, uint64_t n);
METRO_API double metro_startup_divergence_bound(const metro_kernel *k, uint64_t n);

/* # R5.1 Start-up theory on the sphere and of a run */

/* The start-up error of a direction, from one seed, after `n` perturbations inside a cone of `half_angle` radians:
   the L2 distance of p_n from the uniform density, both taken against the uniform probability on the sphere (for the
   distance of the densities per steradian divide by sqrt(4 pi)), eq 5.62. And its natural logarithm, finite where the
   error underflows; -INFINITY means that the error is exactly 0. n = 0 gives +INFINITY; from `half_angle` pi on and n
   >= 1 the error is exactly 0. NaN when `half_angle` is not positive and finite. Relative error 1e-12, or 1e-12 of
   the logarithm where that is larger. Cost: at most some 4000 degrees for every n and angle. The half angle is half
   the apex angle of the paper's section 3.2. */
METRO_API double metro_cone_startup_error(double half_angle, uint64_t n);
METRO_API double metro_cone_startup_log_error(double half_angle, uint64_t n);

/* The same for the von Mises-Fisher kernel of concentration `kappa`; kappa = 0 is the uniform direction. NaN when
   kappa is negative or not finite. Cost: at most some 1000 degrees. */
METRO_API double metro_vmf_startup_error(double kappa, uint64_t n);
METRO_API double metro_vmf_startup_log_error(double kappa, uint64_t n);

/* What a run makes of an integrand: the bias, the variance and the mean squared error bias^2 + variance of an
   estimate. */
typedef struct {
    double bias, variance, mse;
} metro_run_error;

/* The exact error of the mean of f(z_burn), f(z_burn+1), .. f(z_burn+steps-1) as an estimate of the integral of f
   over the circle, for a chain of constant importance with kernel `k`. The integrand is

       f(x) = sum_{j=1}^{harmonics} (cosine_j cos(2 pi j x) + sine_j sin(2 pi j x))

   with cosine[j - 1] and sine[j - 1]; a constant would change nothing. Either array may be NULL for all zeros. The
   chain starts at seed[i] with probability alpha[i], i < `seeds` (`alpha` NULL: equal weights; weights as for
   metro_startup_error_seeds); with `seeds` = 0 it starts from a uniform point. Drawing the seed is part of the
   experiment: where seeds have different biases, the variance of these adds to the variance of the run. steps = 0
   asks for the limit of many steps: then the three numbers are the limits of steps * bias, steps * variance and steps
   * mse. Errors: METRO_ERROR_ARGUMENT (invalid kernel, coefficients that are not finite, seeds or weights that
   metro_startup_error_seeds would answer by NaN, `error` NULL), METRO_ERROR_MEMORY; `error` is untouched then.
   Relative accuracy 1e-12 of each number unless terms of f cancel at the seed; a variance that is 0 is exactly 0.
   Cost: at most two joins (eq 5.74) for each of the harmonics^2/2 pairs and each binary digit of `burn` and `steps`,
   and some multiplications for each pair and seed; without pairs where `seeds` or `steps` is 0. Memory: 24 bytes a
   pair. */
METRO_API metro_result metro_startup_run_error(const metro_kernel *k, uint64_t burn, uint64_t steps,
                                               const double *cosine, const double *sine, size_t harmonics,
                                               const double *seed, const double *alpha, size_t seeds,
                                               metro_run_error *error);

/* The size of a kernel of `shape` (METRO_UNIFORM, METRO_TRIANGLE, METRO_GAUSSIAN or METRO_CAUCHY, without large
   steps) that gives the run described as above the least mean squared error, and that error. Sizes from 1/1024 to 8
   are searched: the mean squared error has several minima, so they are scanned first and the best three refined.
   Where many are equally good (wide kernels that are uniform to the last digit) it returns one of the smaller.
   Errors: as metro_startup_run_error, and METRO_ERROR_ARGUMENT for another shape or `size` NULL; `size` and `error`
   are untouched then. Cost: some 900 evaluations of the run's error. */
METRO_API metro_result metro_startup_best_size(metro_shape shape, uint64_t burn, uint64_t steps, const double *cosine,
                                               const double *sine, size_t harmonics, const double *seed,
                                               const double *alpha, size_t seeds, double *size,
                                               metro_run_error *error);

/* # R6 The operator

   Any importance on the circle, cut into cells, makes the chain a matrix; everything that a run will do, from any
   seed, can then be computed and need not be simulated. */

/* The chain on `cells` cells of the circle; cell i is [i/cells, (i+1)/cells). A cell is dark when its importance is
   below 1e-300 of the whole: no chain enters it, and none may start there. Read the members, write none. */
typedef struct {
    size_t cells;
    double *stationary;  /* [cells]: pi_i, the probability of cell i in equilibrium; 0 where dark; the sum is 1 */
    double *transition;  /* [cells * cells]: P_ij at i * cells + j; each row sums to 1, the row of a dark cell is 0 */
    double *rejection;   /* [cells]: r_i, the probability that a proposal from cell i is rejected; NaN where dark */
    double acceptance;   /* the mean of 1 - r_i in equilibrium */
} metro_operator;

/* Makes the operator of `kernel`, whose shape must be METRO_UNIFORM (eq 6.1 is the matrix of that kernel), for the
   importance of each cell. `importance` holds `cells` numbers, not negative and finite, in any unit: only their
   ratios count. On success free with metro_operator_free. Returns METRO_ERROR_ARGUMENT for another shape, an invalid
   kernel, no cells or an importance that is negative, infinite or NaN; METRO_ERROR_NO_IMPORTANCE if all are 0;
   METRO_ERROR_MEMORY; on failure `op` is unchanged. Costs cells^2 doubles and divisions. Source: eq 6.1 to eq 6.5. */
METRO_API metro_result metro_operator_make(const metro_kernel *kernel, const double *importance, size_t cells,
                                           metro_operator *op);

/* Frees what metro_operator_make allocated. A zeroed operator may be freed. */
METRO_API void metro_operator_free(metro_operator *op);

/* Lets a distribution evolve: `mass` holds the probability of each cell before, and after `steps` steps in place. Any
   finite numbers that are not negative will do. Returns METRO_ERROR_ARGUMENT for others, METRO_ERROR_DARK_SEED if a
   dark cell has mass, METRO_ERROR_MEMORY; on failure `mass` is unchanged. Costs cells^2 multiplications a step for
   the first 2 * cells steps, cells^3 for every doubling after that. Source: eq 6.6 and eq 6.7. */
METRO_API metro_result metro_operator_evolve(const metro_operator *op, uint64_t steps, double *mass);

/* How far a distribution is from equilibrium. */
typedef struct {
    double l2;               /* the norm of paper (10): sqrt(cells * sum (p_i - pi_i)^2) */
    double chi;              /* sqrt(sum (p_i - pi_i)^2 / pi_i), eq 6.8 */
    double total_variation;  /* sum abs(p_i - pi_i) / 2, eq 6.9: 0 .. 1 */
    double divergence;       /* Kullback and Leibler's sum p_i ln(p_i / pi_i), eq 6.10 */
} metro_distance;

/* The distances of `mass`, the probabilities of the cells, from the stationary ones. All NaN when one is negative,
   infinite or NaN, or their sum is off 1 by more than 1e-9. With mass in a dark cell `chi` and `divergence` are
   infinite. */
METRO_API metro_distance metro_operator_distance(const metro_operator *op, const double *mass);

/* The probability that a chain which starts in `cell` had all of its first `steps` proposals rejected: the atom r^n
   that the seed keeps (eq 6.11). NaN for a dark cell and beyond the last one. */
METRO_API double metro_operator_atom(const metro_operator *op, size_t cell, uint64_t steps);

/* What the eigenvalues say. They are real: 1 = lambda_1 >= lambda_2 >= ... >= -1. */
typedef struct {
    double gap;     /* 1 - lambda_2; to 12 digits even where lambda_2 rounds to 1 */
    double second;  /* lambda_2: what survives of the slowest mode in a step */
    double least;   /* the last one; below 0 a mode changes its sign in every step */
} metro_spectrum;

/* Finds all eigenvalues. `eigenvalue` (may be NULL) gets `cells` numbers in falling order, of which those that dark
   cells leave over are NaN. `slowest` (may be NULL) gets the right eigenvector phi of lambda_2, scaled so that the
   sum of pi_i phi_i^2 is 1, NaN in dark cells: for large n the p_n from seed i is near pi_j (1 + lambda_2^n phi_i
   phi_j). Its sign is arbitrary. Where all cells but one are dark, gap, second, least and slowest are NaN. Returns
   METRO_ERROR_MEMORY, or METRO_ERROR_ARGUMENT if the operator holds a NaN that metro_operator_make did not put there;
   then the outputs are unchanged. Cost: about 10 cells^3 multiplications, and m^2 cells^2 for m islands. Eigenvalues
   are off by some 1e-15, the gap by 1e-13 of itself or by 1e-25, also where several eigenvalues round to 1, as on
   three islands. Source: Golub and Van Loan (1996), algorithms 8.3.1 and 8.3.3; eq 6.12 to eq 6.14. */
METRO_API metro_result metro_operator_spectrum(const metro_operator *op, double *eigenvalue, double *slowest,
                                               metro_spectrum *spectrum);

/* Errors of a run, averaged over its seed. */
typedef struct {
    double bias2;       /* seed drawn uniformly from the cells that are not dark: the mean of bias(seed)^2 */
    double mse;         /* the same seeds: the mean squared error; the variance is mse - bias2 */
    double stationary;  /* the mean squared error when the seed is drawn from the stationary distribution */
} metro_operator_error;

/* The exact error of the estimate (f(z_burn) + ... + f(z_{burn+steps-1})) / steps of the mean of f, where z_0 is the
   seed, for every seed. `f` holds one value a cell. `bias` and `mse` (each may be NULL) get bias and mean squared
   error for a start in each cell, NaN where dark; `mean` (may be NULL) the averages. Returns METRO_ERROR_ARGUMENT for
   steps = 0 or an f that is not finite, METRO_ERROR_MEMORY; then the outputs are unchanged. Cost: 3 cells^2
   multiplications a step for the first 2 * cells steps, 3 cells^3 for every doubling after that, and next to nothing
   once the chain has forgotten its seed. Relative error: about 1e-16 over the spectral gap, or times `steps` if that
   is less. Source: eq 6.15 to eq 6.20. */
METRO_API metro_result metro_operator_run(const metro_operator *op, const double *f, uint64_t burn, uint64_t steps,
                                          double *bias, double *mse, metro_operator_error *mean);

/* The exponential importance I(x) = e^{-lambda x} under uniform perturbations of full width `size`, in closed form:
   the transform that the paper proposes. All four give NaN unless lambda and size are positive and finite and s is
   finite.

   `transform`: phi(s) of eq 6.22: away from a border the Laplace transform of p_n is phi(s)^n e^{-s x0}, exactly so
   for the first 2 x0 / size steps. `rejection`: the probability that a proposal is rejected, away from the border; at
   a border it is this plus 1/2 if the border rejects, twice this if it reflects. `gap`: the upper bound of the
   spectral gap on the half line x > 0, whose border reflects if `reflecting` is not 0 and otherwise rejects what
   falls outside (eq 6.24, eq 6.25). `best_size`: where this bound is largest: 6.374497.../lambda and
   9.171883.../lambda. */
METRO_API double metro_exponential_transform(double lambda, double size, double s);
METRO_API double metro_exponential_rejection(double lambda, double size);
METRO_API double metro_exponential_gap(double lambda, double size, int reflecting);
METRO_API double metro_exponential_best_size(double lambda, int reflecting);

/* What metro_best_size should minimise the error of. Zero is the default. */
typedef struct {
    double (*integrand)(double x, void *user);  /* f; NULL: the picture of two pixels, 1 on [0, 1/2), else 0 */
    const double *start;                        /* the seed x0 in [0, 1); NULL: the mean over uniformly drawn seeds */
    uint64_t seed;                              /* of the jitter of the 64 points */
} metro_best_options;

/* The size to use and what to expect of it. */
typedef struct {
    double size;        /* full width of the uniform perturbation, .02 .. 2 */
    double bias2;       /* predicted squared bias of the mean of f over the run (drawn seeds: its mean over them) */
    double variance;    /* predicted variance; the mean squared error is bias2 + variance. Both are NaN if lit is 1 */
    double acceptance;  /* predicted mean acceptance in equilibrium: for a look, not for tuning */
    size_t lit;         /* how many of the 64 points are not dark: with a handful of them the prediction is a guess */
    size_t refused;     /* how many were negative, infinite or NaN: dark to the chain, which rejects them */
} metro_best;

/* Chooses the size of the uniform perturbation for a run of `steps` steps on the circle under `importance`: the one
   whose mean squared error is least, computed from the importance at 64 stratified points. The run's estimate is the
   mean of f(z_1) .. f(z_steps): a step records the state it ends in, as metro_chain_run does, and the seed z_0 does
   not count. `user` goes to `importance` and to the integrand; `options` may be NULL. Returns METRO_ERROR_ARGUMENT
   for steps = 0, an integrand that is not finite where it is asked (or whose square is not), or a start outside [0,
   1); METRO_ERROR_DARK_SEED or METRO_ERROR_BAD_SEED for a start of zero or of negative, infinite or NaN importance;
   METRO_ERROR_NO_IMPORTANCE if all 64 points are dark; METRO_ERROR_MEMORY; on failure `best` is unchanged. Cost: 64
   calls of each function and some twenty operators of 64 cells, whatever `steps`. A feature narrower than 1/64 is
   seen by one point or by none, and the prediction is as good as the points. */
METRO_API metro_result metro_best_size(double (*importance)(double x, void *user), void *user, uint64_t steps,
                                       const metro_best_options *options, metro_best *best);

/* # R7 Diagnostics

   What are the draws of a chain worth? Draws are numbers that one or more chains produced, chain after chain: draw
   `i` of chain `c` is `draw[c * draws + i]`, so `draw` holds `chains * draws` numbers. They may be anything one
   measures along a chain: a coordinate, f/I, the luminance that falls on a block of pixels. All chains have the same
   length, and a burn-in is left out by the caller. For states on a circle hand over cos 2 pi x and sin 2 pi x, since
   the cut of the circle is no place of the space.

   What cannot be said is NaN, and `metro_draws_trouble` says why (of all but metro_ess_tail). It is always NaN when a
   draw is not finite, when all draws are equal (but for metro_squared_jump, which is 0), when there are no draws and
   when memory runs out. No function averages the chains before it looks at them: the mean over chains that sit in
   different places looks like one chain that moves well. */

/* The autocorrelation of one chain, rho[k] for the lags k = 0 .. lags - 1 (eq 7.3); rho[0] = 1. The estimate divides
   by `draws`, not by draws - k, which bends far lags towards 0 and keeps their noise small. NaN throughout where it
   cannot be said. Returns METRO_ERROR_ARGUMENT for a NULL, no lags, or more lags than draws, METRO_ERROR_MEMORY; then
   `rho` is unchanged. Cost: draws log(draws), whatever the lags. */
METRO_API metro_result metro_autocorrelation(const double *draw, size_t draws, size_t lags, double *rho);

/* The variance of the mean of `steps` draws of a stationary chain, as a multiple of the variance of one draw (paper
   (18) in its exact form, eq 7.1). rho[k] is the correlation at lag k, rho[0] = 1, and correlations from `lags` on
   are taken to be 0. With covariances in place of correlations it is the variance itself. NaN for 0 steps or lags.
   Cost: the smaller of lags and steps. */
METRO_API double metro_bernstein(const double *rho, size_t lags, uint64_t steps);

/* The integrated autocorrelation time tau: so many draws are worth one independent draw, when their mean is what we
   want (eq 7.2). Estimated from all chains together by Geyer's initial monotone sequence (1992), on halves of chains
   as in Vehtari et al. (2021), so that metro_ess_mean times tau is the number of draws; never below 1 / log10 of that
   number. Chains that disagree make it long. NaN under six draws a chain. Cost: n log n for n draws in all, up to 100
   bytes a draw. */
METRO_API double metro_autocorrelation_time(const double *draw, size_t chains, size_t draws);

/* The effective sample size: so many independent draws would tell as much. metro_ess is bulk ESS, which judges where
   the bulk of the distribution lies and needs no mean or variance to exist; metro_ess_tail is the smaller of the
   effective sample sizes of the quantiles at .05 and .95; metro_ess_mean belongs to the plain mean of the draws. A
   middle draw of an odd number is left out. NaN under six draws a chain; the tail also when the quantile at .95 is
   the largest draw, since then no draw lies beyond it. An antithetic chain is worth more than its draws, at most
   log10 of their number times as much; but where already the first pair of correlations is not positive, the rule
   says half of them. Cost as metro_autocorrelation_time, and a sort. Source: Vehtari, Gelman, Simpson, Carpenter and
   Buerkner (2021); the same numbers as their R package posterior. */
METRO_API double metro_ess(const double *draw, size_t chains, size_t draws);
METRO_API double metro_ess_tail(const double *draw, size_t chains, size_t draws);
METRO_API double metro_ess_mean(const double *draw, size_t chains, size_t draws);

/* R-hat, how much chains and their halves disagree: 1 when they look alike, and below 1.01 for results one trusts. It
   takes the larger of two values, on ranks of the draws (do the chains sit in the same place?) and on ranks of their
   distances from the median (are they as wide?). +INFINITY when each half of each chain stands still, in its place or
   in its distance from the median, and not all in the same. NaN under four draws a chain, or when all draws (but a
   middle one of an odd number, which is left out) are equally far from the median. It compares chains with each
   other, never with the truth: where no chain has been, it knows nothing. Cost: three sorts. Source: Vehtari et al.
   (2021), rank-normalised split R-hat; the same numbers as posterior, but where all halves stand still. */
METRO_API double metro_rhat(const double *draw, size_t chains, size_t draws);

/* The Monte Carlo standard error of the mean of all draws, and of their standard deviation: the deviation of the
   draws over the root of the effective sample size (eq 7.8, eq 7.9). NaN where that size is NaN; the second also when
   all draws are equally far from their mean. Source: Vehtari et al. (2021), as in posterior. */
METRO_API double metro_mcse_mean(const double *draw, size_t chains, size_t draws);
METRO_API double metro_mcse_sd(const double *draw, size_t chains, size_t draws);

/* Why a diagnostic of these draws is NaN or not to be trusted, as a sentence, or NULL when nothing is wrong that the
   draws could show. It names the first it finds of: no draws, a draw that is not finite, fewer than four draws a
   chain, all draws equal, chains that all stand still, one that does, fewer than six draws, R-hat that cannot be
   said, chains shorter than 50 autocorrelation times, R-hat above 1.1, and memory that ran out. The string is
   constant. Cost: that of metro_rhat and metro_ess_mean. */
METRO_API const char *metro_draws_trouble(const double *draw, size_t chains, size_t draws);

/* The mean squared distance between a draw of one chain and the next (eq 7.12), stays included: on a circle of length
   `period`, or on the line when `period` is 0. NaN under two draws, for a draw that is not finite, and for a period
   that is negative, infinite or NaN. Distances whose squares are beyond a double are infinite or 0. */
METRO_API double metro_squared_jump(const double *draw, size_t draws, double period);

/* How wrong a method is, from repeats of the same run with other random numbers. All are means over the values. */
typedef struct {
    double bias2, bias2_error;       /* squared bias: unbiased, hence at times negative */
    double variance, variance_error; /* of one run */
    double mse, mse_error;           /* mean squared error of one run; the sum of the two */
} metro_bias_variance;

/* Takes bias and variance of an estimate apart (eq 7.13, eq 7.14). `estimate` holds repeats * values numbers: all
   values (the samples of a picture, say) of the first run, then of the second; `truth` holds the true values. The
   errors are standard errors by the jackknife over runs, so that the values of one run may depend on each other;
   where there is no bias, `bias2_error` is too large by sqrt(2 (repeats - 1)/(repeats - 2)). Of a few values only it
   says little where their bias happens to be near 0: look at the signed bias then. One repeat gives the mean squared
   error only, two add bias^2, variance and the error of the mean squared error, three give all; the rest is NaN. NaN
   or an infinity in the input comes out as NaN or infinity. Returns METRO_ERROR_ARGUMENT for no repeats, no values or
   a NULL, METRO_ERROR_MEMORY; then `out` is unchanged. Cost: three passes over the estimates and 24 bytes a repeat.
   Source: Tukey (1958), Efron and Stein (1981). */
METRO_API metro_result metro_repeats(const double *estimate, const double *truth, size_t repeats, size_t values,
                                     metro_bias_variance *out);

/* The outcome of a check of detailed balance. `probability` is about the chance that a transition in balance scores
   `chi_square` or more, times the number of coordinates, at most 1: under 1e-6 detailed balance is broken. A step may
   break it and yet leave the target as it is, as a rotation of a circle does; and what shows in no single coordinate
   is not seen. */
typedef struct {
    double chi_square, freedom, probability;
    size_t coordinate;  /* of the state, the one that scores worst */
    size_t from, to;    /* the two cells of that coordinate between which the flows differ most */
    double excess;      /* the flow from -> to less the flow back, as a part of their sum, 0 .. 1 */
} metro_balance;

/* Tests a transition against the target that it should leave in balance (eq 7.15). `step`, which gets the target's
   `user`, writes the state after `from` to `to`; NULL means a step of metro_chain with the target's own proposal or
   kernels, which tests a proposal and its ratio. `draws` uniform states are drawn, each is kept with the probability
   I/M, M being the largest of their importances, and steps once; where it steps to a brighter state than M it is left
   out; each coordinate is cut into `cells` cells (2 to 256; 0 means 16; finer than the perturbation is best). Returns
   METRO_ERROR_ARGUMENT (cells, a NULL, or a target that metro_chain_make refuses, also with a step of your own),
   METRO_ERROR_MEMORY, or METRO_ERROR_NO_IMPORTANCE if no two cells were connected by 20 pairs; then `balance` is
   untouched. Costs up to 4 importances and one step a draw; some 1e6 draws serve. Source: Bowker (1948) for the
   statistic, Wilson and Hilferty (1931) for its probability. */
METRO_API metro_result metro_balance_check(const metro_target *target,
                                           void (*step)(const double *from, double *to, metro_rng *rng, void *user),
                                           uint64_t draws, size_t cells, metro_rng rng, metro_balance *balance);

/* An ensemble of independent chains, looked at after given numbers of steps. Zero is the default where one is named.
   */
typedef struct {
    const metro_target *target;          /* circles and intervals; importance and propose are called from several
                                            threads, record is not called */
    const metro_chain_options *options;  /* NULL for the defaults */
    const double *seed, *alpha;          /* `seeds` states and their probabilities, as in metro_chain_start_seeds */
    size_t seeds;
    const uint64_t *steps;               /* [times], never falling: when to look */
    size_t times;
    uint64_t chains;                     /* rounded up to a multiple of the jobs */
    size_t harmonics;                    /* K: the highest harmonic along each axis */
    uint64_t random_seed;
    size_t jobs;                         /* independent groups, at least 4; 0 means 64 */
    size_t threads;                      /* 0 means one a core; the answer does not depend on it */
} metro_ensemble;

/* Measures E_n^2, the squared L2 distance between p_n and the uniform density, over the harmonics up to K along each
   axis, from empirical Fourier coefficients (eq 7.17): no bins, no smoothing. squared[i] is an unbiased estimate
   after steps[i] steps and may be negative where E_n is small; error[i] is its standard error (eq 7.18), somewhat too
   large where nothing of E_n is left. Both have `times` values. What lies beyond K is not in the sum: for a uniform
   perturbation on one circle and n = 1 it is about 1/(pi^2 Delta^2 K), for larger n far less. Returns the errors of
   the chain, METRO_ERROR_ARGUMENT also for no harmonics, times, chains or seeds, for step numbers that fall, for an
   axis that is a direction, for over 2^20 modes or fewer than 4 jobs; then the outputs are untouched. Costs chains *
   (last step + times * axes * modes) and some 32 bytes a job, time and mode. */
METRO_API metro_result metro_ensemble_measure(const metro_ensemble *ensemble, double *squared, double *error);

/* # R8 Pictures

   A picture is a block of numbers: linear radiance, with no exposure, gamma or clamp. Grey pictures have one channel,
   colour pictures three (red, green, blue). Row 0 is the top row, and channel `c` of the pixel in column `x` of row
   `y` is `value[(y * width + x) * channels + c]`. */
typedef struct {
    size_t width, height, channels;
    double *value;
} metro_image;

/* Makes a black picture of `width` x `height` pixels with `channels` = 1 or 3, to be given back by
   `metro_image_free`. An `image` that holds a picture is not freed first. Returns METRO_ERROR_ARGUMENT when a size is
   0, `channels` is neither 1 nor 3 or `image` is NULL, METRO_ERROR_MEMORY when there is no room (or the size
   overflows); then `image` is unchanged. Cost: 8 bytes a sample. */
METRO_API metro_result metro_image_make(size_t width, size_t height, size_t channels, metro_image *image);

/* Gives the memory back and leaves the empty picture, all zeros; the empty picture and NULL are allowed. */
METRO_API void metro_image_free(metro_image *image);

/* Reads the picture in the file `path` into `image`, which is then the caller's to free; an `image` that holds a
   picture is not freed first. The first bytes decide: `P6` and `P3` are PPM, whose values are taken through the sRGB
   curve into 0 .. 1 (maxval 1 to 65535, comments allowed); `PF` and `Pf` are PFM in colour and grey, in either byte
   order, NaN and infinity kept, each value times the magnitude of the scale in the header. Returns METRO_OK,
   METRO_ERROR_FILE when the file cannot be read, METRO_ERROR_FORMAT when it is not what it claims to be (more or
   fewer pixels than it says included), METRO_ERROR_MEMORY, or METRO_ERROR_ARGUMENT (a NULL). Then `image` is
   unchanged, nothing stays allocated, and `message` says what is wrong and what to do, cut to `message_size` bytes
   with its closing zero; on success it is empty. `message` may be NULL when `message_size` is 0. Cost: a file that is
   refused costs at most its own size in memory, a good one 8 bytes a sample besides; time is linear. Source: netpbm's
   description of PPM; Debevec's of PFM. */
METRO_API metro_result metro_image_load(const char *path, metro_image *image, char *message, size_t message_size);

/* The same from the `size` bytes at `bytes`. Nothing is allocated before the whole file has been found good. */
METRO_API metro_result metro_image_parse(const unsigned char *bytes, size_t size, metro_image *image, char *message,
                                         size_t message_size);

/* Writes `image` as PFM: 32-bit floats, little endian (scale -1.0), rows from bottom to top, `PF` for three channels
   and `Pf` for one. NaN and infinity are kept; a magnitude beyond what a float holds (3.4e38) becomes infinity. The
   bytes are the same on every machine and in every locale. The file appears whole or not at all: it is written as
   `path` with `.tmp` appended (a file of that name is replaced) and renamed when all of it has arrived. What is there
   already and is no ordinary file, and what is in /dev, /dev/stdout for one, is written directly; a link is replaced
   by the file, and the file has the rights that any file made there gets. Returns METRO_ERROR_FILE when it cannot be
   written, and then an older file at `path` is as it was, METRO_ERROR_MEMORY, or METRO_ERROR_ARGUMENT (an empty
   picture, `channels` not 1 or 3, a NULL). */
METRO_API metro_result metro_image_save_pfm(const metro_image *image, const char *path);

/* The same as PPM: P6 with 8 bits a channel through the sRGB curve, rounded to nearest; grey is written as three
   equal channels. 1, everything above and +infinity become 255; 0, everything below and NaN become 0, and
   `metro_image_not_finite` says how many samples were no number to show. */
METRO_API metro_result metro_image_save_ppm(const metro_image *image, const char *path);

/* How many samples are NaN or infinite; 0 for the empty picture. */
METRO_API size_t metro_image_not_finite(const metro_image *image);

/* The luminance of linear sRGB, eq 8.1. */
METRO_API double metro_luminance(double red, double green, double blue);

/* The sRGB curve from linear 0 .. 1 to encoded 0 .. 1, eq 8.2, and back, eq 8.3. No clamp: the curves go on beyond 0
   and 1, and NaN gives NaN. Source: IEC 61966-2-1:1999. */
METRO_API double metro_srgb_encode(double linear);
METRO_API double metro_srgb_decode(double encoded);

/* How far a picture is from its reference. */
typedef struct {
    double relative_rmse;  /* eq 8.4, over all samples */
    double relmse;         /* eq 8.5, on luminance */
    double mean;           /* mean luminance of the picture */
    double mean_reference; /* and of the reference */
    double largest;        /* the largest absolute difference of a sample, */
    size_t x, y;           /* and the first pixel that has it */
} metro_image_difference;

/* Compares `image` with `reference`, which has the same size and channels. A NaN or an infinity in either picture
   makes the sums NaN or infinite, as it must; one NaN and `largest` is NaN and names its pixel. A black reference
   makes the first infinite, or NaN if the picture is black too, and the second NaN if they have a black pixel in
   common. Returns METRO_ERROR_ARGUMENT when the pictures differ in shape, are empty or NULL, and then `difference` is
   unchanged. Cost: linear. */
METRO_API metro_result metro_image_error(const metro_image *image, const metro_image *reference,
                                         metro_image_difference *difference);

/* The part of `relmse` that the reference's own noise makes, eq 8.6: subtract it. `variance` holds the variance of
   the reference's luminance in each pixel, in one channel or the same in three. Returns METRO_ERROR_ARGUMENT when the
   sizes differ or a picture is empty or NULL, and then `relmse` is unchanged. */
METRO_API metro_result metro_image_noise(const metro_image *reference, const metro_image *variance, double *relmse);

#ifndef METRO_NO_TRACER

/* # R9 Geometry

   A scene is triangles, what they are made of, and perhaps a camera. Fill it by hand or from an OBJ file, build it
   once, then ask it for hits:

       metro_scene scene = { 0 };
       metro_scene_load_obj(&scene, "room.obj", message, sizeof message);
       metro_scene_build(&scene);
       ...
       metro_scene_free(&scene);

   Coordinates are right-handed. A triangle (p0, p1, p2) has the normal (p1 - p0) x (p2 - p0); it reflects and emits
   on the side that its normal points to, and its back is black. Colours are vectors too: x is red, y green, z blue.
   Corners are rounded to float once, when they are added; areas, normals and lights are those of the rounded
   triangles. */

/* The one surface model: the BRDF is kd/pi + ks (ns + 2)/(2 pi) max(0, cos a)^ns, a the angle between the direction
   of the light and the mirror image of the direction of the eye (Lafortune and Willems 1994); ke is the radiance it
   emits, the same in all directions of the normal's side. */
typedef struct {
    metro_vec3 kd, ks;  /* kd + ks <= 1 in each colour */
    double ns;
    metro_vec3 ke;
} metro_material;

/* A pinhole at `eye` that looks at `look`; `up` points upwards in the picture. */
typedef struct {
    metro_vec3 eye, look, up;
    double fov;  /* the full vertical field of view, in degrees */
} metro_camera;

/* A scene. Read its members, write none; { 0 } is an empty scene. */
typedef struct metro_scene metro_scene;
struct metro_scene {
    float *corner;             /* [9 * triangle_count] */
    uint32_t *material_of;     /* [triangle_count]: the number of each triangle's material */
    metro_material *material;  /* [material_count]: materials 1, 2, ...; material 0 is kd = .5 and nothing else */
    size_t triangle_count, triangle_room;
    size_t material_count, material_room;
    metro_camera camera;
    int has_camera;            /* the file had a camera line */
    uint32_t *light;           /* [light_count]: the triangles that emit, known after the build */
    double *light_sum;         /* [light_count]: running sums of area times luminance of ke, the last scaled to 1 */
    double light_power;        /* the sum of area times luminance of ke before the scaling */
    size_t light_count;
    void *bvh;                 /* NULL before the build */
};

/* Adds a material and gives its number, to be used by `metro_scene_add_triangle`: 1 for the first, then 2, 3, ... Its
   parts must be finite and not negative, and kd + ks at most 1 in each colour (a rounding error of 1e-9 is let pass).
   Returns METRO_OK, METRO_ERROR_ARGUMENT (another material, a scene that is built already, a NULL) or
   METRO_ERROR_MEMORY; then the scene and `index` are unchanged. Cost: constant on average. */
METRO_API metro_result metro_scene_add_material(metro_scene *scene, const metro_material *material, uint32_t *index);

/* Adds the triangle with the three corners `corner`, rounded to float, made of material number `material`. Triangles
   count from 0. One with a corner that is not finite as a float, or of no area, keeps its number and is never hit.
   Returns METRO_OK, METRO_ERROR_ARGUMENT (no such material, a scene that is built already, a NULL) or
   METRO_ERROR_MEMORY (or 2^32 - 1 triangles); then the scene is unchanged. Cost: constant on average, 40 bytes. */
METRO_API metro_result metro_scene_add_triangle(metro_scene *scene, const metro_vec3 corner[3], uint32_t material);

/* Adds the faces of the OBJ file `path`, the materials that they use, from the MTL files that it names, and its
   camera, and does not build. What the scene held before stays; the numbers of what is added follow on.

   A polygon of n corners makes n - 2 triangles: a convex one, or any that can be seen whole from its first corner,
   the fan from there; any other the ears that are cut off it in its own plane. Polygons without area, or with a
   corner that is not finite, are fans, of which the triangles without area, or with such a corner, are never hit. A
   face uses vertices that stand above it. Read are `v`, `f`, `usemtl`, `mtllib`; of an MTL file `newmtl`, `Kd`, `Ks`,
   `Ns`, `Ke` (one number for all colours, or three). What a material does not say is 0, except that one with neither
   Kd nor Ke has the Kd of material 0. The camera stands in a comment, of which the last one counts:

       # camera eye 0 1 4 look 0 1 0 up 0 1 0 fov 40

   Returns METRO_OK, METRO_ERROR_FILE (the OBJ cannot be read), METRO_ERROR_FORMAT (a line is wrong, or there is no
   face at all), METRO_ERROR_MEMORY or METRO_ERROR_ARGUMENT (a NULL, or a scene that is built already). Then the scene
   is unchanged, nothing stays allocated, and `message` says what is wrong, as "FILE:LINE: what", or "FILE: what"
   where no line is to blame. On success it holds the warnings, one a line, and each kind once, with the place where
   it was met first: an MTL file or a material that is missing (material 0 stands in); Kd above 1 (taken as 1), Kd +
   Ks above 1 (Ks is taken as 1 - Kd), a negative number (taken as 0); a transparency (d, Tr), texture (map_) or
   illumination model (illum) that would change the picture, which are not read; a face of fewer than three corners
   (left out), a polygon that ears cannot be cut from since it crosses itself, or with too many corners for that (a
   fan all the same), a vertex that is not finite, a camera line of another form (left out). Without warnings
   `message` is empty. It is cut to `message_size` bytes with its closing zero, and may be NULL when that is 0. Cost:
   linear in the size of the files; the OBJ file is held in memory meanwhile. Source: Wavefront's "Object files
   (.obj)" and "MTL material format", and what exporters make of them. */
METRO_API metro_result metro_scene_load_obj(metro_scene *scene, const char *path, char *message, size_t message_size);

/* The same from `obj_size` bytes of OBJ at `obj` and `mtl_size` bytes of MTL at `mtl`, which stand for the MTL files
   of the OBJ, whether it names any or not; `mtl` may be NULL with size 0. No file is opened. Places in `message`
   begin with "obj:" or "mtl:". Costs a copy of the bytes. */
METRO_API metro_result metro_scene_parse_obj(metro_scene *scene, const unsigned char *obj, size_t obj_size,
                                             const unsigned char *mtl, size_t mtl_size, char *message,
                                             size_t message_size);

/* Material number `material`; 0 is always there. NULL when there is no such material. The pointer is good until the
   next one is added. */
METRO_API const metro_material *metro_scene_material(const metro_scene *scene, uint32_t material);

/* Corner k (0, 1, 2) of triangle number `triangle`: the rounded one. NaN when there is no such corner. */
METRO_API metro_vec3 metro_scene_corner(const metro_scene *scene, uint32_t triangle, int k);

/* The unit normal of triangle number `triangle`, along (p1 - p0) x (p2 - p0); NaN when the triangle has no area, is
   not finite or does not exist. */
METRO_API metro_vec3 metro_scene_normal(const metro_scene *scene, uint32_t triangle);

/* The area of triangle number `triangle`; NaN when it is not finite or does not exist. */
METRO_API double metro_scene_area(const metro_scene *scene, uint32_t triangle);

/* The corners `low` and `high` of the smallest box along the axes that holds all finite triangles. Returns
   METRO_ERROR_ARGUMENT when there is none (or a NULL), and then both are unchanged. Cost: linear. */
METRO_API metro_result metro_scene_bounds(const metro_scene *scene, metro_vec3 *low, metro_vec3 *high);

/* A camera that has the whole scene in view, for scenes that bring none: it looks from +z at the middle of the box of
   metro_scene_bounds, upright, with a field of view of 40 degrees, from where a sphere around the box just fits into
   a picture that is not higher than wide. A closed room shows only the black backs of its walls to it. Returns
   METRO_ERROR_ARGUMENT when no triangle is finite (or a NULL), and then `camera` is unchanged. Cost: linear. */
METRO_API metro_result metro_scene_frame(const metro_scene *scene, metro_camera *camera);

/* # R10 BVH

   Build once; then any number of threads may ask, since a scene that is built is only read. A ray is origin + t
   direction. The direction need not have length 1 and t counts in its lengths, so the ray from a to b has the
   direction b - a and ends at t = 1. Triangles are hit from both sides. */

/* Where a ray met a triangle: t in lengths of the direction, point = (1-u-v) p0 + u p1 + v p2; `triangle` counts the
   triangles as they were added. */
typedef struct {
    double t, u, v;
    uint32_t triangle;
} metro_hit;

/* Makes the scene ready for the queries below, and finds the triangles that emit; to be called once, after the last
   triangle. A triangle that is not finite keeps its number and is never hit, and one that is 1e22 times as small as
   the largest coordinate of the scene need not be; a scene without triangles is built like any other; one that is
   built already is left as it is. Returns METRO_ERROR_ARGUMENT (a NULL, 2^30 triangles or more, lamps whose power is
   too large for a double) or METRO_ERROR_MEMORY, and then the scene is as it was. Cost: n log n for n triangles;
   about 150 bytes a triangle while it works, of which about 60 stay. */
METRO_API metro_result metro_scene_build(metro_scene *scene);

/* Gives back all memory and leaves the empty scene; the empty scene and NULL are allowed. */
METRO_API void metro_scene_free(metro_scene *scene);

/* Finds the nearest hit with t_min < t < t_max, writes it to `hit` and returns 1; or returns 0 and leaves `hit`
   alone. Both inequalities hold for the t that is written, as doubles; either bound may be infinite, and t_min
   negative. Of hits at the same t the triangle with the lowest number is taken. The direction may be as short as
   1e-300 or as long as 1e300; one of length 0, and a NaN or an infinity in origin or direction, hit nothing, and
   neither does anything before the build. Inside, numbers are floats: t carries about seven digits, and u and v are
   off by about 1e-7 times the distance over the size of the triangle. Neither `scene` nor `hit` may be NULL. No ray
   from the inside of a closed mesh gets out between its triangles. The answer does not depend on the instructions
   that the processor has, where a float is a float (not on the x87). Cost: about log n. Source: Woop, Benthin and
   Wald 2013. */
METRO_API int metro_scene_hit(const metro_scene *scene, metro_vec3 origin, metro_vec3 direction, double t_min,
                              double t_max, metro_hit *hit);

/* Whether there is any hit with t_min < t < t_max: 1 exactly where metro_scene_hit would return 1, but sooner. */
METRO_API int metro_scene_occluded(const metro_scene *scene, metro_vec3 origin, metro_vec3 direction, double t_min,
                                   double t_max);

/* # R11 Light

   Directions point away from the surface: `in` to where light comes from, `out` to where it goes. */

/* The BRDF of eq 11.1 in the colours of `material` between the unit vectors `in` and `out` at a surface of unit
   `normal`; black when either is not above the surface. Per steradian. */
METRO_API metro_vec3 metro_brdf(const metro_material *material, metro_vec3 normal, metro_vec3 in, metro_vec3 out);

/* Draws `in` for a given `out` from the two numbers u and v of [0, 1), and returns its density per steradian (eq
   11.2). A direction that falls below the surface is lost: the density is then 0, and `in` is written all the same.
   `normal` and `out` are unit vectors. Cost: two square roots, a sine, a cosine and for the glossy part two
   powers. */
METRO_API double metro_brdf_sample(const metro_material *material, metro_vec3 normal, metro_vec3 out, double u,
                                   double v, metro_vec3 *in);

/* The density with which `metro_brdf_sample` draws `in` for `out`; 0 below the surface. */
METRO_API double metro_brdf_density(const metro_material *material, metro_vec3 normal, metro_vec3 in, metro_vec3 out);

/* The unit direction of the ray through the film position (x, y) of a picture of `width` x `height` pixels: x runs
   right from 0 to `width`, y down from 0 to `height`, and pixel (i, j) is the square i <= x < i + 1, j <= y < j + 1.
   NaN for a camera that metro_camera_check refuses. */
METRO_API metro_vec3 metro_camera_direction(const metro_camera *camera, size_t width, size_t height, double x,
                                            double y);

/* Where `point` appears on the film; returns 0, and leaves x and y alone, when it is not in the picture. */
METRO_API int metro_camera_project(const metro_camera *camera, size_t width, size_t height, metro_vec3 point,
                                   double *x, double *y);

/* METRO_OK if the camera can take a picture: finite vectors, `eye` apart from `look`, `up` not along the view, 0 <
   fov < 180; else METRO_ERROR_ARGUMENT. */
METRO_API metro_result metro_camera_check(const metro_camera *camera);

/* # R12 Paths

   A picture of a scene is computed in rounds: make a render, run as many rounds as there is time for, and look at the
   picture whenever you like. Every round adds on average one sample to each pixel.

       metro_render render;
       metro_render_options options = { 0 };
       metro_image image;
       metro_render_make(&scene, &scene.camera, &options, &render);
       metro_render_run(&render, 16, NULL, NULL);
       metro_render_image(&render, &image);
*/

#define METRO_DEPTH_MOST 32

typedef enum {
    METRO_BDPT,    /* bidirectional path tracing, walks from both sides: Lafortune and Willems (1993), Veach (1995) */
    METRO_PATH,    /* walks from the eye, which aim at a lamp at each step */
    METRO_LIGHT,   /* walks from the lamps, which are joined to the eye at each step */
    METRO_MLT,     /* Metropolis sampling of bidirectional paths with the paper's angular perturbation */
    METRO_PSSMLT   /* Metropolis sampling of the numbers from which such paths are made, Kelemen et al. (2002) */
} metro_method;

/* How the ways to make a path share it. */
typedef enum {
    METRO_POWER,      /* the power heuristic, eq 12.3 */
    METRO_BALANCE,    /* the balance heuristic */
    METRO_UNWEIGHTED  /* each way counts the whole path: pictures of single ways, which must agree, and no sum */
} metro_heuristic;

/* Where the chains of a render start. */
typedef enum {
    METRO_START_SEEDS,    /* at one of `candidates` uniform draws, in proportion to its importance */
    METRO_START_POINT,    /* at the first uniform draw that is not dark: another for each chain, but the same in each
                             run and part */
    METRO_START_WEIGHTED  /* as METRO_START_SEEDS, with Veach's weights: unbiased from the first sample. A run that
                             returns METRO_ERROR_NO_IMPORTANCE belongs to the mean, as a black picture */
} metro_start;

/* Zero means the default, which stands behind the colon. */
typedef struct {
    size_t width, height;       /* of the picture in pixels: 128 */
    int depth;                  /* the most edges of a path, at most METRO_DEPTH_MOST: 8 */
    int shortest;               /* the fewest edges: 1. With 2, lamps are not seen directly */
    metro_method method;
    metro_heuristic heuristic;
    int one_connection;         /* METRO_BDPT: one pair of vertices is joined for each length, not all */
    int random_numbers;         /* METRO_BDPT, _PATH, _LIGHT: independent random numbers, no even points */
    int pyramid;                /* METRO_BDPT: keep a picture for each way of making a path */
    uint64_t seed;
    uint64_t part;              /* the number of this share of a larger run: shares are independent */
    size_t threads;             /* one for each core */
    /* for METRO_MLT and METRO_PSSMLT: */
    size_t chains;              /* at most 4096: 64 */
    metro_start start;
    size_t candidates;          /* for each chain: 1024 */
    uint64_t start_seed;        /* for METRO_START_POINT */
    double perturbation;        /* METRO_MLT: the apex angle of the cone in radians, twice its half-angle: 0.3.
                                   METRO_PSSMLT: the largest small step: 0.02 */
    double large_step;          /* the probability of a large step: METRO_MLT none, METRO_PSSMLT 0.3; -1: none */
    int one_direction;          /* METRO_MLT: perturb one direction of the path, not all */
    int largest_channel;        /* importance is the largest of red, green, blue, not the luminance */
    int all_connections;        /* METRO_PSSMLT: a state makes all ways of a path, not one */
    int one_stage;              /* METRO_PSSMLT: importance is not divided by a pilot picture */
} metro_render_options;

typedef struct {
    const metro_scene *scene;
    metro_render_options options; /* with the defaults filled in */
    uint64_t rounds;              /* done so far */
    uint64_t samples, rays;       /* of the rounds; pilots and starts of chains are not counted */
    void *state;
} metro_render;

/* What a careful person asks of a picture. NaN stands for what a method does not have. */
typedef struct {
    double mean, mean_error;       /* the mean luminance of the picture and its standard error. Even points (see
                                      random_numbers) are better than their error says, least with many rounds */
    double b, b_error;             /* the integral of the importance, and its standard error: infinite where b is 0 */
    double acceptance;             /* the share of mutations that were accepted */
    double dark;                   /* the share of tentative states of zero importance */
    double squared_jump;           /* the mean squared distance of a mutation that is made, 0 for one that is not */
    uint64_t longest_stay;         /* the most mutations in a row that stayed in one state */
    uint64_t not_finite;           /* contributions that were NaN or infinite: counted, and left out */
    double rhat;                   /* the worst R-hat over the chains, of sixteenths of the picture and the whole */
    double ess;                    /* the smallest bulk ESS of these */
    double worst;                  /* the largest relative standard error of a sixteenth */
    char warning[400];             /* why the picture is not to be trusted, in words; empty if nothing is known */
} metro_render_report;

/* Prepares to render `scene` as `camera` sees it; both are read during the runs and must stay. Returns
   METRO_ERROR_ARGUMENT for a scene that is not built, a camera that metro_camera_check refuses or options out of
   range (NULL: all defaults), METRO_ERROR_NO_LIGHT for a scene without a lamp, METRO_ERROR_MEMORY; `render` is then
   unchanged. Cost: METRO_PSSMLT traces two rounds of METRO_BDPT for its pilot. Memory: 24 bytes a pixel, 8 bytes for
   each chain (or 32) and block of 8 x 8 pixels, and with a pyramid of depth K 24 (K + 1)(K + 2) bytes a pixel. */
METRO_API metro_result metro_render_make(const metro_scene *scene, const metro_camera *camera,
                                         const metro_render_options *options, metro_render *render);

/* Makes `rounds` more rounds. After each, `stop` (may be NULL) is asked; nonzero ends the run with
   METRO_ERROR_STOPPED. Returns METRO_ERROR_NO_IMPORTANCE if no chain finds a state to start from, or
   METRO_ERROR_MEMORY; what is there so far stands. With chains the first round begins with `candidates` draws for
   each, up to 64 times as many where they are dark, and does not ask `stop` meanwhile. The picture depends on the
   options and the number of rounds, not on the threads or on how the rounds were shared out over calls. */
METRO_API metro_result metro_render_run(metro_render *render, uint64_t rounds,
                                        int (*stop)(const metro_render *render, void *user), void *user);

/* Makes `image` and fills it with the picture so far, linear radiance. Returns METRO_ERROR_MEMORY, or
   METRO_ERROR_ARGUMENT before the first round; `image` is then unchanged. */
METRO_API metro_result metro_render_image(const metro_render *render, metro_image *image);

/* The same for the paths of s vertices from the lamp and t from the eye. METRO_ERROR_ARGUMENT also where the options
   ask for no pyramid, or there are no such paths: s >= 0, t >= 1 and 2 <= s + t <= depth + 1. */
METRO_API metro_result metro_render_way(const metro_render *render, int s, int t, metro_image *image);

/* The mean luminance of block (column, row) of 8 x 8 pixels and its standard error, which may not be NULL: from the
   spread over the chains, or over 16 to 32 runs of rounds. NaN where there is no such block or too little to say.
   Cost: all blocks times the chains. */
METRO_API double metro_render_block(const metro_render *render, size_t column, size_t row, double *error);

/* Says how far the picture so far can be believed. Never fails: before the first round all is NaN or 0. One render is
   for one thread at a time, also here. Cost: half a millisecond a chain for the ranks of R-hat. */
METRO_API void metro_render_diagnose(const metro_render *render, metro_render_report *report);

/* Gives back all memory; a zeroed render is allowed. */
METRO_API void metro_render_free(metro_render *render);

/* # R13 Metropolis light

   Chapter 13 has no functions of its own: METRO_MLT and METRO_PSSMLT are methods of a render, and what they alone can
   tell stands in its report.

       options.method = METRO_PSSMLT;
       metro_render_make(&scene, &scene.camera, &options, &render);
       metro_render_run(&render, 64, NULL, NULL);
       metro_render_diagnose(&render, &report);
       if (report.warning[0] != 0) puts(report.warning);
*/

/* # R14 Ray bundles

   A bundle is all parallel lines through the scene along one direction, traced at once. Surfaces are cut into
   patches; a bundle moves the radiance of each patch, along each line and both ways, to the patch that faces it. A
   picture is made of walks of bundles:

       metro_bundles bundles;
       metro_bundles_options options = { 0 };
       metro_image image;
       options.first_shot = 1;
       options.visibility = METRO_LINES;
       metro_bundles_make(&scene, &scene.camera, &options, &bundles);
       metro_bundles_run(&bundles, 1024, NULL, NULL);
       metro_bundles_image(&bundles, &image);

   Both options leave less noise after the same time; without them a picture is made as in the paper. */

/* One patch: a part of a triangle, similar to it. */
typedef struct {
    metro_vec3 corner[3];  /* in the order of the triangle's corners */
    metro_vec3 normal;     /* of length 1: the side that emits, reflects and receives */
    double area;
    uint32_t triangle;
} metro_patch;

/* The triangles of a scene cut into patches. Read the members, write none. Triangle t is cut into cuts[t] x cuts[t]
   patches, with the numbers first[t] .. first[t + 1] - 1; one without an area has none. */
typedef struct {
    const metro_scene *scene;
    metro_patch *patch;  /* [count] */
    size_t count;
    uint32_t *cuts;      /* [scene->triangle_count] */
    uint32_t *first;     /* [scene->triangle_count + 1] */
    metro_vec3 middle;   /* of the sphere that holds all patches */
    double radius;
} metro_patches;

/* Cuts each triangle of `scene` regularly into similar ones, n times n, with the smallest n that leaves no edge
   longer than `size` (a part in a million is let pass). The scene is read later on and must stay as it is; it need
   not be built. Returns METRO_ERROR_ARGUMENT for a NULL or a size that is not positive, METRO_ERROR_MEMORY, also for
   more than 2^30 patches; `patches` is then unchanged. Cost: linear, 112 bytes a patch. Source: section 14.1. */
METRO_API metro_result metro_patches_make(const metro_scene *scene, double size, metro_patches *patches);

/* Gives back all memory; zeroed patches are allowed. */
METRO_API void metro_patches_free(metro_patches *patches);

/* The number of the patch that holds the point (1-u-v) p0 + u p1 + v p2 of a triangle, as metro_hit gives it; one
   that rounding left outside the triangle counts to a patch at the border. The number of patches, `count`, where the
   triangle has none. Cost: constant. */
METRO_API size_t metro_patches_at(const metro_patches *patches, uint32_t triangle, double u, double v);

/* Which patch faces which along the lines of a bundle. The lines are those of a square grid, randomly shifted. */
typedef enum {
    METRO_SWEEP,      /* sweeps each row of the grid and keeps the triangles above each other in order: exact, unless
                         triangles pass through each other */
    METRO_FRAGMENTS,  /* lists what each line meets and sorts the lists: exact, and slower where triangles are larger
                         than a cell */
    METRO_PAINTER,    /* paints whole patches in the order of their centres (the paper's time): wrong by a bias */
    METRO_LINES       /* METRO_SWEEP with infinitely many lines in each row: exact along the row */
} metro_visibility;

/* What became of the radiance that a bundle moved, each the sum over its lines of radiance times the area of a cell,
   in W/sr: left = arrived + escaped + absorbed up to rounding. */
typedef struct {
    metro_vec3 left;      /* what the patches sent out */
    metro_vec3 arrived;   /* what other patches received */
    metro_vec3 escaped;   /* what met nothing */
    metro_vec3 absorbed;  /* what met the black back of a patch */
} metro_bundle_balance;

/* Moves radiance along one direction, both ways. `direction` need not have length 1; `grid` x `grid` cells cover the
   sphere around the scene; `shift` holds two numbers of [0, 1), the shift of the grid in cells (METRO_LINES needs the
   second only), or is NULL for none. `radiance` holds what each patch sends out from its front along the line,
   `received` gets for each patch i

       sum_{j} frac{A(i, j)}{A_i} L_j

   with A(i, j) the projected area of j that i sees: radiance times the cosine at i. With uniform directions of the
   sphere and uniform shifts its mean times 2 pi is the irradiance of the patch, whatever the size of cells and
   patches, but for METRO_PAINTER, and for METRO_SWEEP and METRO_LINES where triangles pass through each other; the
   variance of a patch grows as the area of a cell over its own. `radiance` and `received` have `patches->count` items
   and may be the same; `balance` may be NULL. Returns METRO_ERROR_ARGUMENT for a direction of no length or not
   finite, a grid of 0 or above 16384, a shift outside [0, 1), a visibility that there is not, patches that were not
   made, or a NULL; METRO_ERROR_MEMORY; then the outputs are unchanged. Cost: METRO_SWEEP and METRO_LINES one step for
   each row of the grid and each patch it crosses, and for each triangle in a row as many as there are triangles above
   each other, or that begin in the same cell: triangles that are smaller than a cell are better moved by
   METRO_FRAGMENTS; METRO_FRAGMENTS one for each cell of each patch and as many as patches are above each other;
   METRO_PAINTER one for each cell of each patch; and memory for all that is allocated and cleared. A run of walks
   does so once. Source: Szirmay-Kalos and Purgathofer (1998); paper (19), eq 14.4. */
METRO_API metro_result metro_bundle_transfer(const metro_patches *patches, metro_vec3 direction, size_t grid,
                                             const double shift[2], metro_visibility visibility,
                                             const metro_vec3 *radiance, metro_vec3 *received,
                                             metro_bundle_balance *balance);

/* How the directions of a walk are chosen. */
typedef enum {
    METRO_WALK_RANDOM,     /* each uniform and independent */
    METRO_WALK_EVEN,       /* quasi-random: the points of an evenly filling sequence with two coordinates for each of
                              the first 16 directions; the rest is random */
    METRO_WALK_METROPOLIS  /* by the chain of R4: importance is the luminance that a walk adds to the picture */
} metro_walk;

/* Zero means the default, which stands behind the colon. */
typedef struct {
    size_t width, height;       /* of the picture in pixels: 128 */
    int depth;                  /* the most edges of a path, 2 to METRO_DEPTH_MOST: 8. A walk has depth - 1
                                   directions */
    double patch;               /* the longest edge of a patch: a tenth of the radius of the scene */
    size_t grid;                /* cells along a side of the grid, at most 16384: so many that the edge of a patch is
                                   six of them long, three after a first shot */
    metro_visibility visibility;
    metro_walk walk;
    int run_on;                 /* METRO_WALK_EVEN, as a warning: one sequence in two coordinates runs on from one
                                   direction to the next, and converges to a wrong picture */
    int first_shot;             /* the light of the lamps is brought to each patch by a shadow ray in each walk, and
                                   bundles move the rest; a walk has one direction less. The errors are too small for
                                   patches that share an edge with a lamp (section 14.8) */
    int linear;                 /* METRO_SWEEP, METRO_LINES: radiance is linear over each patch, not constant */
    size_t batches;             /* independent replicates, or chains, whose spread gives the errors, 2 to 4096: 16 */
    uint64_t seed;
    uint64_t part;              /* the number of this share of a larger run: shares are independent */
    size_t threads;             /* one for each core */
    /* for METRO_WALK_METROPOLIS: */
    metro_start start;
    size_t candidates;          /* for each chain: 16 */
    uint64_t start_seed;        /* for METRO_START_POINT */
    double perturbation;        /* the apex angle of the cone in radians, twice its half-angle: 0.6 */
    double large_step;          /* the probability of a large step: 0 */
    int one_direction;          /* perturb one direction of the walk, not all */
} metro_bundles_options;

/* Walks of ray bundles through a scene. Read the members, write none. */
typedef struct {
    const metro_scene *scene;
    metro_bundles_options options;  /* with the defaults filled in */
    metro_patches patches;
    double *share;                  /* [patches.count]: the share of the picture that shows the patch */
    uint64_t walks;                 /* rounds so far times batches; a chain that found no start makes none */
    uint64_t bundles, rays;         /* and what it took, with the starts of chains and their draws for b */
    void *state;
} metro_bundles;

/* What a careful person asks. NaN stands for what a method does not have. */
typedef struct {
    double mean, mean_error;  /* the mean luminance of the picture, with each patch by its share of it and even over
                                 the patch; and its error */
    double b, b_error;        /* the integral of the importance, and its standard error: infinite where b is 0 because
                                 all draws that count were dark, and the picture is black */
    double acceptance;        /* the share of mutations that were accepted */
    double dark;              /* the share of tentative states of zero importance */
    double squared_jump;      /* the mean squared distance of a mutation that is made, 0 for one that is not */
    uint64_t longest_stay;    /* the most mutations in a row that stayed in one state */
} metro_bundles_report;

/* Prepares to light `scene` by bundles and to show it as `camera` sees it; the scene is read during the runs and must
   stay. Cuts the patches and finds by 6 x 6 rays a pixel how much of the picture shows each. Returns
   METRO_ERROR_ARGUMENT for a scene that is not built, a camera that metro_camera_check refuses, options out of range
   (NULL: all defaults) or another NULL, METRO_ERROR_NO_LIGHT for a scene without a lamp, METRO_ERROR_MEMORY;
   `bundles` is then unchanged. Cost: 36 rays a pixel on one thread. Memory: 150 bytes a patch; and for each batch 110
   to 210 bytes a patch, three times as much where radiance is linear, 450 a triangle, 4 a cell for METRO_FRAGMENTS
   and METRO_PAINTER, and 16 for each patch on each line for METRO_FRAGMENTS. Source: paper, section 3.3. */
METRO_API metro_result metro_bundles_make(const metro_scene *scene, const metro_camera *camera,
                                          const metro_bundles_options *options, metro_bundles *bundles);

/* Makes `walks` more walks, rounded up to a multiple of the batches: each batch makes one in turn. After each such
   round `stop` (may be NULL) is asked; nonzero ends the run with METRO_ERROR_STOPPED. Returns
   METRO_ERROR_NO_IMPORTANCE if no chain finds a state to start from (then no later run does either),
   METRO_ERROR_ARGUMENT for bundles that were not made, or METRO_ERROR_MEMORY; what is there so far stands. The result
   depends on the options and the number of walks, not on the threads or on how the walks were shared out over calls.
   Cost of a walk: depth - 1 bundles, one less after a first shot. Chains also make `candidates` walks each to start
   from, or up to 64 times as many where light is rare, and without large steps one in sixteen for b. */
METRO_API metro_result metro_bundles_run(metro_bundles *bundles, uint64_t walks,
                                         int (*stop)(const metro_bundles *bundles, void *user), void *user);

/* The radiance that each patch reflects to the eye, its own emission left out, and its standard error from the spread
   over the batches (may be NULL). Both have patches.count items. A diffuse patch that shows the eye its back has the
   radiance of its front all the same, a glossy one 0. With Metropolis walks only patches that are in the picture are
   right, since walks that light only others have no importance, and the error leaves out what the start still does to
   the mean. Returns METRO_ERROR_ARGUMENT before the first walk or for a NULL; the outputs are then unchanged. Cost:
   one step for each patch and batch. */
METRO_API metro_result metro_bundles_radiance(const metro_bundles *bundles, metro_vec3 *radiance, metro_vec3 *error);

/* Makes `image` and fills it with the picture so far, linear radiance: the final gathering, with 6 x 6 rays for each
   pixel; lamps seen directly are added. Returns METRO_ERROR_MEMORY, or METRO_ERROR_ARGUMENT before the first walk or
   for a NULL; `image` is then unchanged. Cost: 36 rays a pixel, on all threads. */
METRO_API metro_result metro_bundles_image(const metro_bundles *bundles, metro_image *image);

/* Says how far the result so far can be believed. Never fails: before the first walk all is NaN or 0. */
METRO_API void metro_bundles_diagnose(const metro_bundles *bundles, metro_bundles_report *report);

/* Gives back all memory; zeroed bundles are allowed. */
METRO_API void metro_bundles_free(metro_bundles *bundles);

#endif /* METRO_NO_TRACER */

#ifdef __cplusplus
}
#endif
#endif /* METRO_H */
#if defined(METRO_IMPLEMENTATION) && !defined(METRO_IMPLEMENTED)
#define METRO_IMPLEMENTED
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#ifndef METRO_NO_THREADS
#ifdef _WIN32
#define METRO_NO_THREADS
#else
#include <pthread.h>
#include <unistd.h>
#endif
#endif
#ifndef METRO_ASSERT
#include <assert.h>
#define METRO_ASSERT(condition) assert(condition)
#endif
#ifndef METRO_MALLOC
#define METRO_MALLOC(size) malloc(size)
#define METRO_REALLOC(pointer, size) realloc(pointer, size)
#define METRO_FREE(pointer) free(pointer)
#endif
#define METROI_PI 3.14159265358979323846
#define METROI_NAN ((double)NAN)
#define METROI_INFINITY ((double)INFINITY)
#ifdef __cplusplus
extern "C" {
#endif

/* Compilers may join a product and a sum into one instruction that rounds once, and do so for some products and not
   for others, as the processor has it; here they must not, so that a seed gives the same numbers on all of them.

   A lesson is compiled more often than it is run for long. So gcc leaves out four passes that take a tenth of the
   time of compiling and make no picture faster, and is held to -Og between METROI_COLD and METROI_WARM, where little
   time is spent. What is compiled without optimization stays so. The rest has the same options throughout, for gcc
   does not inline a function into one that has others. */

#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#define METROI_OPTIONS
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif
#if defined(METROI_OPTIONS) && defined(__OPTIMIZE__) && !defined(__OPTIMIZE_SIZE__)
#pragma GCC optimize("no-gcse,no-schedule-insns2,no-ivopts,no-tree-dominator-opts")
#define METROI_COLD _Pragma("GCC push_options") _Pragma("GCC optimize(\"Og\")")
#define METROI_WARM _Pragma("GCC pop_options")
#else
#define METROI_COLD
#define METROI_WARM
#endif

/* # 1 Ground

   Everything above stands on three small things: a way to say that something failed, vectors, and a way to use many
   cores without the answer depending on how many there are. */

/* # 1.1 Results

   A result is a number for the program and a sentence for the person. The sentence says what to do, because whoever
   reads it is usually in the middle of something else. */

METRO_API const char *metro_result_text(metro_result result)
{
    switch (result) {
    case METRO_OK: return "success";
    case METRO_ERROR_ARGUMENT: return "an argument is outside its range; see the contract of the function in metro.h";
    case METRO_ERROR_MEMORY: return "out of memory; use a smaller size or fewer chains";
    case METRO_ERROR_FILE: return "the file cannot be opened, read or written; check its path and permissions";
    case METRO_ERROR_FORMAT: return "the file is damaged or of another kind than its name or first bytes say";
    case METRO_ERROR_DARK_SEED: return "a seed has zero importance; start where the importance is positive";
    case METRO_ERROR_BAD_SEED:
        return "the importance of a seed is negative, infinite or NaN; check the importance function";
    case METRO_ERROR_NO_IMPORTANCE:
        return "no candidate has positive importance; try more candidates or check the importance function";
    case METRO_ERROR_NO_LIGHT:
        return "the scene has no lamp; give a material of its MTL file an emission, as in: Ke 10 10 10";
    case METRO_ERROR_STOPPED: return "the run was stopped early; the result so far stands";
    }
    return "unknown result";
}

/* # 1.2 Vectors

   Directions are states of a chain (chapter 4). A vector is three doubles,
   passed by value. */

METRO_API metro_vec3 metro_vec3_make(double x, double y, double z)
{
    metro_vec3 v;
    v.x = x;
    v.y = y;
    v.z = z;
    return v;
}

METRO_API metro_vec3 metro_add(metro_vec3 a, metro_vec3 b)
{
    return metro_vec3_make(a.x + b.x, a.y + b.y, a.z + b.z);
}

METRO_API metro_vec3 metro_subtract(metro_vec3 a, metro_vec3 b)
{
    return metro_vec3_make(a.x - b.x, a.y - b.y, a.z - b.z);
}

METRO_API metro_vec3 metro_scale(metro_vec3 a, double factor)
{
    return metro_vec3_make(a.x * factor, a.y * factor, a.z * factor);
}

METRO_API metro_vec3 metro_cross(metro_vec3 a, metro_vec3 b)
{
    return metro_vec3_make(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

METRO_API double metro_dot(metro_vec3 a, metro_vec3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

/* A length squares its components, and 1e-300 squared is 0. So we divide by the largest component first. */

static double metroi_largest_component(metro_vec3 a)
{
    double x = fabs(a.x), y = fabs(a.y), z = fabs(a.z);
    double largest = x > y ? x : y;
    return largest > z ? largest : z;
}

METRO_API double metro_length(metro_vec3 a)
{
    double largest = metroi_largest_component(a);
    metro_vec3 scaled;
    if (!(largest > 0) || isinf(largest)) return fabs(a.x) + fabs(a.y) + fabs(a.z);
    scaled = metro_vec3_make(a.x / largest, a.y / largest, a.z / largest);
    return largest * sqrt(metro_dot(scaled, scaled));
}

METRO_API metro_vec3 metro_normalize(metro_vec3 a)
{
    double largest = metroi_largest_component(a);
    metro_vec3 scaled;
    if (!(largest > 0) || isinf(largest)) return metro_vec3_make(METROI_NAN, METROI_NAN, METROI_NAN);
    scaled = metro_vec3_make(a.x / largest, a.y / largest, a.z / largest);
    return metro_scale(scaled, 1.0 / sqrt(metro_dot(scaled, scaled)));
}

/* # 1.3 Rounds of jobs

   A run on many cores usually gives another picture each time, because threads add to the same sums in the order in
   which they happen to arrive, and floating-point addition is not associative. We separate the two: threads take jobs
   in any order and each writes to the slot of its job; when the round is over, one thread takes the slots in the
   order of jobs. What remains of the machine is only how long it took.

   A pool is shared by the threads of one round. The lock covers the number of the next job and nothing else. */

typedef struct {
    const metro_rounds *plan;
    void *user;
    unsigned char *slots;     /* jobs * slot_size bytes */
    metro_result *results;    /* one a job */
    uint64_t first_job;
    size_t jobs, next;
#ifndef METRO_NO_THREADS
    pthread_mutex_t lock;
#endif
} metroi_pool;

/* Hands out the next job of the round, or `jobs` when all are taken. */
static size_t metroi_pool_take(metroi_pool *pool)
{
    size_t job;
#ifndef METRO_NO_THREADS
    pthread_mutex_lock(&pool->lock);
#endif
    job = pool->next;
    if (pool->next < pool->jobs) pool->next++;
#ifndef METRO_NO_THREADS
    pthread_mutex_unlock(&pool->lock);
#endif
    return job;
}

/* What each thread does: jobs, until none is left. */
static void *metroi_pool_work(void *argument)
{
    metroi_pool *pool = (metroi_pool *)argument;
    size_t job;
    while ((job = metroi_pool_take(pool)) < pool->jobs) {
        void *slot = pool->slots + job * pool->plan->slot_size;
        pool->results[job] = pool->plan->work(pool->first_job + job, slot, pool->user);
    }
    return NULL;
}

/* Does all jobs of a round on `threads` threads, of which the caller is one. A thread that cannot be created is not
   missed: the others take its jobs. */
#ifdef METRO_NO_THREADS
static void metroi_pool_round(metroi_pool *pool, size_t threads)
{
    (void)threads;
    metroi_pool_work(pool);
}
#else
static void metroi_pool_round(metroi_pool *pool, size_t threads)
{
    enum { MOST = 256 };
    pthread_t helper[MOST];
    size_t started = 0, i;
    if (threads > pool->jobs) threads = pool->jobs;
    while (started + 1 < threads && started < MOST) {
        if (pthread_create(&helper[started], NULL, metroi_pool_work, pool) != 0) break;
        started++;
    }
    metroi_pool_work(pool);
    for (i = 0; i < started; i++) pthread_join(helper[i], NULL);
}
#endif

/* The first failure in the order of jobs decides; otherwise all slots are merged in that order. */
static metro_result metroi_pool_merge(const metroi_pool *pool)
{
    size_t job;
    for (job = 0; job < pool->jobs; job++)
        if (pool->results[job] != METRO_OK) return pool->results[job];
    for (job = 0; pool->plan->merge != NULL && job < pool->jobs; job++) {
        const void *slot = pool->slots + job * pool->plan->slot_size;
        metro_result result = pool->plan->merge(pool->first_job + job, slot, pool->user);
        if (result != METRO_OK) return result;
    }
    return METRO_OK;
}

static metro_result metroi_pool_rounds(metroi_pool *pool, uint64_t rounds, size_t threads)
{
    const metro_rounds *plan = pool->plan;
    uint64_t round;
    for (round = 0; round < rounds; round++) {
        metro_result result;
        pool->first_job = (plan->first_round + round) * pool->jobs;
        pool->next = 0;
        if (plan->slot_size > 0) memset(pool->slots, 0, pool->jobs * plan->slot_size);
        metroi_pool_round(pool, threads);
        result = metroi_pool_merge(pool);
        if (result != METRO_OK) return result;
        if (plan->stop != NULL && plan->stop(round + 1, pool->user)) return METRO_ERROR_STOPPED;
    }
    return METRO_OK;
}

METRO_API metro_result metro_rounds_run(const metro_rounds *plan, void *user)
{
    metroi_pool pool;
    metro_result result;
    size_t threads = plan->threads > 0 ? plan->threads : metro_core_count();
    memset(&pool, 0, sizeof pool);
    pool.plan = plan;
    pool.user = user;
    pool.jobs = plan->jobs > 0 ? plan->jobs : 16;
    if (plan->work == NULL || pool.jobs > SIZE_MAX / sizeof *pool.results) return METRO_ERROR_ARGUMENT;
    if (plan->slot_size > (SIZE_MAX - 1) / pool.jobs) return METRO_ERROR_ARGUMENT;
    pool.slots = (unsigned char *)METRO_MALLOC(pool.jobs * plan->slot_size + 1);
    pool.results = (metro_result *)METRO_MALLOC(pool.jobs * sizeof *pool.results);
    result = METRO_ERROR_MEMORY;
#ifndef METRO_NO_THREADS
    if (pool.slots != NULL && pool.results != NULL && pthread_mutex_init(&pool.lock, NULL) == 0) {
        result = metroi_pool_rounds(&pool, plan->rounds > 0 ? plan->rounds : 1, threads);
        pthread_mutex_destroy(&pool.lock);
    }
#else
    if (pool.slots != NULL && pool.results != NULL)
        result = metroi_pool_rounds(&pool, plan->rounds > 0 ? plan->rounds : 1, threads);
#endif
    METRO_FREE(pool.results);
    METRO_FREE(pool.slots);
    return result;
}

METRO_API size_t metro_core_count(void)
{
#if !defined(METRO_NO_THREADS) && defined(_SC_NPROCESSORS_ONLN)
    long cores = sysconf(_SC_NPROCESSORS_ONLN);
    return cores > 0 ? (size_t)cores : 1;
#else
    return 1;
#endif
}

/* # 2 Randomness

   A Markov chain is made of random numbers, so their quality and their bookkeeping come first. Each chain, job and
   experiment owns a stream that follows from a seed and a number; nothing is shared, nothing is hidden, and a result
   can be repeated from the two numbers alone. */

/* # 2.1 Streams

   The generator is xoshiro256++ (Blackman and Vigna 2021): 256 bits of state $s_0 .. s_3$, a linear recurrence over
   bits, and a sum and a rotation that hide its linearity. Its period is 2^256 - 1, so streams that start at unrelated
   places do not meet. To get unrelated places from neighbouring numbers (seed 1, stream 0; seed 1, stream 1) we fill
   the state from two sequences of SplitMix64 (Steele, Lea and Flood 2014) and mix what they give once more. */

static uint64_t metroi_mix(uint64_t x)
{
    x = (x ^ (x >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
    x = (x ^ (x >> 27)) * UINT64_C(0x94d049bb133111eb);
    return x ^ (x >> 31);
}

static uint64_t metroi_rotate(uint64_t x, int bits)
{
    return (x << bits) | (x >> (64 - bits));
}

METRO_API metro_rng metro_rng_make(uint64_t seed, uint64_t stream)
{
    const uint64_t golden = UINT64_C(0x9e3779b97f4a7c15); /* 2^64 over the golden ratio: SplitMix64's step */
    metro_rng rng;
    uint64_t i;
    for (i = 0; i < 4; i++) {
        uint64_t a = metroi_mix(seed + (i + 1) * golden);
        uint64_t b = metroi_mix(metroi_mix(stream ^ golden) + (i + 1) * golden);
        rng.state[i] = metroi_mix(a + metroi_rotate(b, 32));
    }
    /* The one forbidden state is all zeros. */
    if ((rng.state[0] | rng.state[1] | rng.state[2] | rng.state[3]) == 0) rng.state[0] = golden;
    return rng;
}

METRO_API uint64_t metro_rng_next(metro_rng *rng)
{
    uint64_t *s = rng->state;
    uint64_t result = metroi_rotate(s[0] + s[3], 23) + s[0];
    uint64_t t = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = metroi_rotate(s[3], 45);
    return result;
}

/* Of the 64 bits a double holds 53. The upper ones are the better ones. */

METRO_API double metro_rng_uniform(metro_rng *rng)
{
    return (double)(metro_rng_next(rng) >> 11) * (1.0 / 9007199254740992.0);
}

/* The remainder of a division by `bound` favours small numbers by one part in 2^64 / bound. Lemire (2019) takes the
   high half of a product instead and draws again in the rare case that the low half falls into the uneven rest. The
   128-bit product is put together from halves, so that no compiler needs such a type. */

static uint64_t metroi_multiply_high(uint64_t a, uint64_t b, uint64_t *low)
{
    uint64_t a0 = a & 0xffffffffu, a1 = a >> 32, b0 = b & 0xffffffffu, b1 = b >> 32;
    uint64_t middle = a1 * b0 + ((a0 * b0) >> 32);
    uint64_t middle2 = a0 * b1 + (middle & 0xffffffffu);
    *low = a * b;
    return a1 * b1 + (middle >> 32) + (middle2 >> 32);
}

METRO_API uint64_t metro_rng_below(metro_rng *rng, uint64_t bound)
{
    uint64_t low, high, uneven;
    if (bound == 0) return 0;
    uneven = (0 - bound) % bound;
    do high = metroi_multiply_high(metro_rng_next(rng), bound, &low);
    while (low < uneven);
    return high;
}

/* A point of the plane with two independent normal coordinates has a uniform angle and a radius $r$ with
   P(radius > r) = e^{-r^2/2} (Box and Muller 1958). The first uniform is turned round, so that the logarithm
   never sees a 0. */

METRO_API double metro_rng_normal(metro_rng *rng)
{
    double radius = sqrt(-2.0 * log(1.0 - metro_rng_uniform(rng)));
    return radius * cos(2.0 * METROI_PI * metro_rng_uniform(rng));
}

METRO_API metro_vec3 metro_rng_direction(metro_rng *rng)
{
    double z = 1.0 - 2.0 * metro_rng_uniform(rng);
    double azimuth = 2.0 * METROI_PI * metro_rng_uniform(rng);
    double r = sqrt((1.0 - z) * (1.0 + z));
    return metro_vec3_make(r * cos(azimuth), r * sin(azimuth), z);
}

/* # 2.2 Sums and moments

   After 2^32 steps a plain running sum has forgotten the last digits of each new term. Neumaier (1974) carries the
   rounding error of each addition along and adds it at the end. */

METRO_API void metro_sum_add(metro_sum *sum, double term)
{
    double total = sum->sum + term;
    double rest = fabs(sum->sum) >= fabs(term) ? (sum->sum - total) + term : (term - total) + sum->sum;
    sum->sum = total;
    sum->lost += rest;
}

METRO_API double metro_sum_value(const metro_sum *sum)
{
    return isfinite(sum->lost) ? sum->sum + sum->lost : sum->sum;
}

/* Importances span hundreds of decades, and the square of 1e200 is no double. So the moments are kept in units of
   the largest magnitude seen; the updates are Welford's (1962):

       m_n = m_{n-1} + frac{x - m_{n-1}}{n},    Q_n = Q_{n-1} + (x - m_{n-1}) (x - m_n)                      (2.1) */

METRO_API void metro_moments_add(metro_moments *moments, double value)
{
    double magnitude = fabs(value), x, deviation;
    if (magnitude > moments->scale) {
        double shrink = moments->scale / magnitude;
        moments->mean *= shrink;
        moments->squares *= shrink * shrink;
        moments->scale = magnitude;
    }
    x = moments->scale > 0 ? value / moments->scale : value;
    moments->count++;
    deviation = x - moments->mean;
    moments->mean += deviation / (double)moments->count; /* eq 2.1 */
    moments->squares += deviation * (x - moments->mean); /* eq 2.1 */
}

METRO_API double metro_moments_mean(const metro_moments *moments)
{
    return moments->count > 0 ? moments->mean * (moments->scale > 0 ? moments->scale : 1.0) : METROI_NAN;
}

METRO_API double metro_moments_variance(const metro_moments *moments)
{
    double scale = moments->scale > 0 ? moments->scale : 1.0;
    if (moments->count < 2) return METROI_NAN;
    return moments->squares / (double)(moments->count - 1) * scale * scale;
}

METRO_API double metro_moments_error(const metro_moments *moments)
{
    double n = (double)moments->count, scale = moments->scale > 0 ? moments->scale : 1.0;
    return moments->count < 2 ? METROI_NAN : sqrt(moments->squares / (n - 1.0) / n) * scale;
}

/* # 2.3 Points that fill the cube evenly

   Random points clump: of $N$ points in $N$ cells of equal size more than a third stay empty on average when N is
   large. A sequence that puts exactly one into each cell, for many ways of cutting the cube into cells, integrates
   smooth functions with an error that falls almost as $1/N$, and shuffled as below almost as $N^{-3/2}$, where random
   points have $N^{-1/2}$. Sobol (1967) found one that needs only binary digits. The digits of the number of the
   point, $n_1$ the lowest, choose which direction numbers $v_j$ are added up, digit by digit modulo 2:

       x = sum_{j=1}^{24} n_j v_j,   v_j = frac{m_j}{2^j}                             (2.2)

   Each coordinate has its own odd integers $m_j < 2^j$. A primitive polynomial of degree $s$ with the coefficients
   $a_1 .. a_{s-1}$ continues the first $s$ of them, again modulo 2:

       m_j = 2 a_1 m_{j-1} + 4 a_2 m_{j-2} + ... + 2^{s-1} a_{s-1} m_{j-s+1} + 2^s m_{j-s} + m_{j-s}          (2.3)

   Because $m_j$ is odd, $v_j$ is the first of them whose digits reach place $j$, so any $2^k$ points in a row from a
   multiple of $2^k$ have different first $k$ digits: one point in each interval of length $2^{-k}$. How evenly pairs
   of coordinates fill the plane depends on the first integers. Joe and Kuo (2008) searched for good ones; the table
   holds the first 32 coordinates of their list `new-joe-kuo-6`, each row continued by eq 2.3. The first coordinate
   is the number of the point with its digits mirrored about the binary point. */

#define METROI_SOBOL_DIGITS 24

/* The first 24 digits of a coordinate as a whole number. */
static uint32_t metroi_sobol_digits(uint32_t index, unsigned dimension)
{
    static const uint32_t m[32][METROI_SOBOL_DIGITS] = {
        { 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1 },
        { 1, 3, 5, 15, 17, 51, 85, 255, 257, 771, 1285, 3855, 4369, 13107, 21845, 65535, 65537, 196611, 327685,
          983055, 1114129, 3342387, 5570645, 16711935 },
        { 1, 3, 3, 9, 29, 23, 71, 197, 209, 627, 1907, 1369, 4109, 12327, 12407, 36949, 119041, 94979, 291587, 809225,
          855325, 2565911, 7829319, 5592517 },
        { 1, 3, 1, 5, 31, 29, 81, 147, 433, 149, 719, 3693, 3841, 11523, 16641, 49925, 16671, 83229, 515921, 482707,
          1314993, 2380693, 7205839, 2481005 },
        { 1, 1, 1, 11, 31, 55, 61, 157, 181, 191, 1291, 3851, 6993, 7153, 16561, 16571, 17679, 184103, 514861, 908077,
          983109, 2556623, 2951131, 2952667 },
        { 1, 1, 3, 3, 25, 9, 43, 251, 449, 449, 1347, 323, 5081, 14281, 23403, 35771, 36865, 102401, 110595, 831491,
          331801, 1380361, 8335403, 15675643 },
        { 1, 3, 5, 13, 11, 37, 31, 227, 381, 143, 241, 3889, 2255, 6625, 15395, 33895, 101617, 171539, 442933, 345725,
          1298203, 844053, 7545679, 12019507 },
        { 1, 1, 5, 5, 17, 9, 9, 45, 237, 633, 65, 1601, 5701, 8005, 32593, 47689, 13385, 74861, 402861, 931641,
          2019329, 3641345, 5509125, 3411973 },
        { 1, 1, 5, 5, 5, 53, 53, 113, 113, 353, 1873, 785, 4885, 533, 24853, 58661, 124261, 124193, 513313, 775985,
          201985, 1185025, 3216645, 11871493 },
        { 1, 1, 7, 11, 19, 37, 69, 91, 103, 871, 913, 1009, 6199, 10683, 10691, 10741, 5237, 27819, 433303, 434167,
          1918721, 2804481, 2478855, 16639243 },
        { 1, 1, 5, 1, 1, 27, 79, 35, 175, 695, 1021, 2333, 2353, 13237, 17413, 11279, 31771, 52319, 195971, 794507,
          1847729, 2930161, 985141, 6498481 },
        { 1, 1, 1, 3, 11, 43, 75, 43, 425, 37, 1813, 1317, 2501, 12743, 12623, 4711, 56359, 253127, 120005, 779337,
          2033521, 3607409, 7799633, 12002195 },
        { 1, 3, 5, 5, 31, 35, 113, 51, 31, 133, 1197, 1511, 6913, 1801, 23819, 61239, 11021, 162239, 245979, 312137,
          541137, 1622771, 8115893, 11367317 },
        { 1, 3, 3, 9, 7, 49, 33, 163, 483, 681, 2023, 2129, 7169, 5123, 11267, 21513, 62471, 105521, 367649, 38051,
          110051, 775849, 947175, 13964369 },
        { 1, 1, 1, 15, 21, 21, 77, 157, 61, 371, 1001, 2257, 1169, 7281, 30161, 30175, 55109, 55109, 154909, 810285,
          1864749, 2389731, 3987321, 843585 },
        { 1, 3, 1, 13, 27, 49, 35, 133, 331, 475, 1389, 1707, 1461, 10927, 1749, 31409, 109391, 195317, 302367,
          244561, 443703, 1268895, 5095857, 2606295 },
        { 1, 1, 1, 15, 7, 5, 123, 103, 287, 321, 1109, 255, 597, 11005, 32341, 10491, 96851, 12009, 159799, 209091,
          733379, 3265357, 2004569, 4960971 },
        { 1, 3, 1, 15, 13, 25, 27, 109, 131, 897, 1687, 2495, 413, 5311, 11701, 12211, 81945, 49173, 147519, 606457,
          770111, 148389, 3917099, 9257323 },
        { 1, 1, 5, 5, 19, 61, 87, 187, 463, 599, 225, 3331, 7029, 5501, 32705, 8641, 9287, 60649, 336219, 213775,
          636115, 1228027, 1507869, 16452127 },
        { 1, 3, 7, 11, 23, 15, 103, 65, 67, 327, 75, 2135, 7759, 9127, 12289, 28675, 45063, 143371, 241687, 512015,
          1962087, 274497, 1339459, 13939015 },
        { 1, 3, 7, 13, 13, 15, 69, 81, 339, 887, 733, 925, 4799, 5557, 1281, 37123, 37639, 14093, 105741, 23823,
          261957, 128337, 5357651, 5030007 },
        { 1, 1, 3, 13, 7, 35, 63, 113, 401, 19, 221, 2999, 2387, 12527, 21249, 27905, 122115, 42765, 305415, 273187,
          1898303, 213873, 2088081, 1117459 },
        { 1, 3, 5, 9, 1, 25, 53, 137, 331, 813, 193, 2777, 5617, 7357, 4801, 2883, 94277, 63049, 343105, 94041,
          651381, 2134089, 970763, 16175469 },
        { 1, 3, 1, 13, 9, 35, 107, 57, 427, 201, 1429, 1825, 2683, 8371, 26049, 18243, 74305, 173389, 255945, 322019,
          2072363, 2336761, 7240939, 6200457 },
        { 1, 3, 1, 5, 27, 61, 31, 149, 287, 245, 1945, 751, 5561, 643, 17809, 19187, 55185, 60469, 464139, 92941,
          339215, 3108805, 1697199, 986149 },
        { 1, 1, 5, 11, 19, 41, 61, 213, 5, 385, 655, 2183, 4485, 4593, 1521, 44401, 93525, 52763, 376835, 344121,
          540781, 3162213, 7356725, 1131281 },
        { 1, 3, 5, 3, 3, 13, 69, 157, 207, 521, 519, 1551, 4649, 2641, 5809, 49075, 11349, 258003, 468563, 794749,
          262229, 3932269, 6029759, 262681 },
        { 1, 1, 7, 13, 1, 19, 1, 181, 109, 779, 161, 117, 895, 5133, 9297, 44177, 108215, 193181, 253905, 787267,
          1315889, 795685, 7122365, 4564347 },
        { 1, 3, 7, 5, 13, 19, 59, 247, 109, 861, 1087, 3827, 5237, 13649, 4565, 5447, 100179, 70937, 351553, 38007,
          1815871, 4165931, 7705745, 2689009 },
        { 1, 1, 3, 9, 25, 29, 41, 3, 471, 445, 803, 3503, 755, 2655, 21197, 64125, 117815, 115965, 50117, 904425,
          1494077, 2522279, 5114915, 14040609 },
        { 1, 3, 5, 13, 23, 1, 55, 151, 485, 951, 155, 1481, 7019, 3193, 1261, 52263, 1393, 70353, 32531, 943365,
          1267515, 1322307, 3993929, 10834683 },
        { 1, 3, 7, 3, 13, 59, 17, 43, 109, 629, 849, 359, 2493, 3267, 18869, 33359, 30355, 146687, 82177, 841479,
          1994069, 1872887, 5875193, 5455465 }
    };
    uint32_t x = 0;
    unsigned j;
    /* A digit 0 or 1 becomes a mask of zeros or ones: a branch would be guessed wrongly half the time. */
    for (j = 0; index >> j != 0; j++)
        x ^= (m[dimension][j] << (METROI_SOBOL_DIGITS - 1 - j)) & (0u - (index >> j & 1u)); /* eq 2.2 */
    return x;
}

/* Points that are always the same cannot say how far off their mean is, and a function that happens to agree with
   their pattern is integrated wrongly for ever. Owen (1995) shuffles the digits and keeps the cells: flip the first
   digit of all points or of none; then, in each half by a coin of its own, the second digit; in each quarter the
   third, and so on.

       y_j = x_j + c(x_1 x_2 ... x_{j-1})   "modulo 2"                                (2.4)

   Each interval of length $2^{-k}$ is carried onto another as a whole, so the points stay as even as they were, while
   each one becomes uniform. For every square-integrable function the variance falls faster than 1/N, and it stays
   within a factor of that of random points which depends on the points and the dimension, not on N or the function
   (Owen 1997; for Sobol's points Owen 1998).

   The coins $c$ sit in the nodes of a binary tree: the root decides digit 1, and node $i$ has the children $2i$ and
   $2i+1$ for the digits 0 and 1. Nobody can store 2^24 of them, so they are hashes. (Laine and Karras 2011 flip all
   digits with four multiplications of the mirrored number; it is faster, but the flips of the first digits then take
   only a few of the patterns they should.) One hash of 64 bits has room for the 63 coins of a tree of six levels:
   four hashes decide 24 digits. Points that differ no sooner than there do not exist among 2^24, so all further
   digits are plain random bits of the last node. */

static uint64_t metroi_sobol_scramble(uint32_t x, uint64_t key)
{
    const uint64_t golden = UINT64_C(0x9e3779b97f4a7c15); /* as in section 2.1 */
    const unsigned digits = METROI_SOBOL_DIGITS, levels = 6;
    uint64_t y = 0;
    unsigned level, below;
    for (level = 0; level < digits; level += levels) {
        /* The root of a small tree is a node of the large one, and has a number of its own there. */
        uint64_t root = (uint64_t)1 << level | x >> (digits - level);
        uint64_t coins = metroi_mix(key + root * golden);
        unsigned node = 1;
        for (below = 0; below < levels; below++) {
            unsigned digit = x >> (digits - 1 - level - below) & 1;
            y = y << 1 | (digit ^ (coins >> node & 1)); /* eq 2.4 */
            node = 2 * node + digit;
        }
    }
    return y << 29 | metroi_mix(key + ((uint64_t)1 << digits | x) * golden) >> 35;
}

/* The key of a tree mixes the scramble, the coordinate and, beyond 2^24 points, the number of the block. */

METRO_API double metro_sobol(uint64_t index, unsigned dimension, uint64_t scramble)
{
    const uint64_t golden = UINT64_C(0x9e3779b97f4a7c15);
    uint64_t block = index >> METROI_SOBOL_DIGITS;
    uint32_t within = (uint32_t)(index & ((1u << METROI_SOBOL_DIGITS) - 1u));
    uint64_t key, point;
    if (dimension >= 32) return METROI_NAN;
    key = metroi_mix(metroi_mix(scramble) + (32 * block + dimension + 1) * golden);
    point = metroi_sobol_scramble(metroi_sobol_digits(within, dimension), key);
    return (double)point * (1.0 / 9007199254740992.0);
}

#undef METROI_SOBOL_DIGITS

/* # 3 Perturbations

   The tentative transition of the paper adds a random step to the current point. The law of that step is the kernel
   P, and three things are wanted of it: a draw, for the chain of chapter 4; its density, for the transition matrices
   of chapter 6 and for checks; and its spectrum, because the start-up theory of chapter 5 is a sum over nothing else.
   The tests hold the three against each other: draws against the density, the density's transform against the
   spectrum.

   The domain is the circle of length 1, the interval [0, 1] with reflecting ends, or the sphere. A kernel on the
   circle is a kernel of the line with all the points that wrapping identifies added up, so sizes above 1 mean
   something, and something useful: a uniform kernel of width exactly 1, 2 or 3 is independent sampling.

   | shape | size | density of the step u on the line | P*(k) |
   | METRO_UNIFORM | Delta, full width | 1/Delta for abs(u) < Delta/2 | sin(pi k Delta)/(pi k Delta) |
   | METRO_TRIANGLE | Delta, full base | (2/Delta)(1 - 2 abs(u)/Delta) | (sin(pi k Delta/2)/(pi k Delta/2))^2 |
   | METRO_GAUSSIAN | sigma | exp(-u^2/(2 sigma^2))/(sigma sqrt(2 pi)) | exp(-2 pi^2 sigma^2 k^2) |
   | METRO_CAUCHY | gamma, scale | gamma/(pi (gamma^2 + u^2)) | exp(-2 pi gamma abs(k)) |
   | METRO_VON_MISES | kappa | exp(kappa cos(2 pi u))/I_0(kappa), wrapped already | I_k(kappa)/I_0(kappa) |
   | METRO_KELEMEN | s1, s2 | 1/(2 L abs(u)) for s1 <= abs(u) <= s2 | (Ci(2 pi k s2) - Ci(2 pi k s1))/L |

   There sigma is the standard deviation, kappa the concentration, s1 and s2 are the smallest and the largest step,
   and L = ln(s2/s1).

   The uniform kernel is that of the paper; its (16) prints abs(x - y) < Delta, which integrates to 2, where Delta/2
   is meant and where paper (17) agrees with us. Kelemen's kernel (Kelemen et al. 2002) spreads the logarithm of the
   step evenly, so that fine and coarse moves come equally often.

   A large step replaces the kernel, with probability p, by an independent uniform draw:

       P*(k) = (1 - p) K*(k) for k != 0                                               (3.1)

   # 3.1 Points and turns

   A point of the circle is a number in [0, 1). After a step it comes back there by its floor, with one trap: a
   negative number close to zero plus 1 rounds to 1, which is no point of the circle; 0 is meant. The usual case, a
   point that has not left, is answered first. */

static double metroi_wrap(double y)
{
    if (y >= 0 && y < 1) return y;
    y -= floor(y);
    return y >= 1 ? 0 : y;
}

/* A reflecting interval is a circle of length 2 seen from the side: y and 2 - y are the same point. The end 1 itself
   is moved to the number below it, so that no cell index runs over. */

static double metroi_fold(double y)
{
    if (!(y >= 0 && y < 1)) {
        y -= 2 * floor(y / 2);
        if (y > 1) y = 2 - y;
        if (y >= 1) y = 1 - 1.1102230246251565e-16; /* 2^-53 */
    }
    return y;
}

/* # 3.2 Arguments without loss

   Every coefficient is a sine or cosine of pi k x, and where it is small it is the difference between k x and a whole
   number that matters. The product k x rounded to a double has lost it. A fused multiply-add keeps the rest,

       k x = p + e, p = fl(k x), e = fma(k, x, -p)                                    (3.2)

   and both parts lose whole periods without rounding before they are added. So sin(pi k x) is exactly 0 where k x is
   whole and right to the last digits beside such a point, for k whole or half-whole up to 2^53. A product that
   overflows is an even number many times over: no turns. */

static double metroi_turns(double k, double x, int *quadrant)
{
    double p = k * x, e = fma(k, x, -p); /* eq 3.2 */
    double q, r;
    *quadrant = 0;
    if (isinf(p) && isfinite(k) && isfinite(x)) return 0;
    p -= 2 * rint(p / 2);
    e -= 2 * rint(e / 2);
    /* bring k x to [-1/4, 1/4] around a multiple of 1/2 */
    q = rint(2 * p);
    e += p - q / 2;
    r = rint(2 * e);
    e -= r / 2;
    if (fabs(e) <= 1) *quadrant = (int)(q + r) & 3;
    return e;
}

/* sin(pi k x) */
static double metroi_sin_pi(double k, double x)
{
    int quadrant;
    double turns = metroi_turns(k, x, &quadrant);
    double value = quadrant & 1 ? cos(METROI_PI * turns) : sin(METROI_PI * turns);
    return quadrant & 2 ? -value : value;
}

/* cos(pi k x) */
static double metroi_cos_pi(double k, double x)
{
    int quadrant;
    double turns = metroi_turns(k, x, &quadrant);
    double value = quadrant & 1 ? sin(METROI_PI * turns) : cos(METROI_PI * turns);
    return quadrant == 1 || quadrant == 2 ? -value : value;
}

/* Where a coefficient is near 1, its distance from 1 is what the sums of chapter 5 feed on, and 1 - P would lose it.
   So the gap 1 - P is computed beside P. For sin(y)/y it is the alternating series, nested; y < 0.7 needs seven
   terms. */

static double metroi_sinc_gap(double y)
{
    double z = y * y, sum = 0, m;
    if (!(fabs(y) < 0.7)) return 1 - sin(y) / y;
    for (m = 8; m >= 1; m--) sum = z / (2 * m * (2 * m + 1)) * (1 - sum);
    return sum;
}

/* Some integrals of this chapter and the next ones are done by the Gauss-Legendre rule with 24 points, which
   integrates polynomials to degree 47 exactly. Point i = 0 .. 23 of the rule on [0, 1]: */

static double metroi_gauss24(int i, double *weight)
{
    static const double rule[12][2] = {
        { 0.00240639000148931991, 0.0061706148999935997734 }, { 0.012635722014345250901, 0.014265694314466831591 },
        { 0.030862723998633620738, 0.022138719408709903084 }, { 0.056792236497799482893, 0.029649292457718390373 },
        { 0.089999007013048539023, 0.036673240705540152867 }, { 0.12993790421072281788, 0.043095080765976637959 },
        { 0.17595317403151221537, 0.048809326052056944135 }, { 0.22728926430558023217, 0.053722135057982817391 },
        { 0.28310324618697743076, 0.057752834026862800677 }, { 0.34247866015191831281, 0.060835236463901695602 },
        { 0.40444056626319184542, 0.062918728173414148061 }, { 0.46797155356869718696, 0.063969097673376078487 }
    };
    *weight = rule[i < 12 ? i : 23 - i][1];
    return i < 12 ? rule[i][0] : 1 - rule[23 - i][0];
}

/* # 3.3 What is a kernel

   An invalid kernel gives NaN everywhere, so a mistake shows at once instead of passing for a result. */

static int metroi_kernel_valid(const metro_kernel *k)
{
    if (!(k->large >= 0 && k->large <= 1) || !(k->size >= 0 && isfinite(k->size))) return 0;
    switch (k->shape) {
    case METRO_VON_MISES: return 1;
    case METRO_KELEMEN: return k->size_min > 0 && k->size_min <= k->size;
    case METRO_UNIFORM:
    case METRO_TRIANGLE:
    case METRO_GAUSSIAN:
    case METRO_CAUCHY: return k->size > 0;
    }
    return 0;
}

/* L = ln(s2/s1) of Kelemen's kernel, right for s1 close to s2 and for a ratio that overflows. */
static double metroi_kelemen_log(double s1, double s2)
{
    double excess = (s2 - s1) / s1;
    return excess < 1e300 ? log1p(excess) : log(s2) - log(s1);
}

/* # 3.4 Drawing a step

   The von Mises step is drawn by the rejection of Best and Fisher (1979) from a wrapped Cauchy envelope. Their
   parameter is

       s = frac{1 + rho^2}{2 rho}, rho = frac{t - sqrt{2 t}}{2 kappa}, t = 1 + sqrt{1 + 4 kappa^2}      (3.3)

   and rho is the smaller root of rho^2 - 2 s rho + 1 = 0. So s = t/(2 kappa), and s - 1 follows without the
   cancellation that eq 3.3 has at large kappa:

       s - 1 = frac{1 + 1/(2 kappa + sqrt{1 + 4 kappa^2})}{2 kappa}                   (3.4)

   We carry v = 1 - cos(angle) instead of the cosine for the same reason: at kappa = 1e8 the angles are about 1e-4,
   and a cosine keeps half of their digits. The step is +-2 asin(sqrt(v/2)) radians. */

static double metroi_von_mises_step(double kappa, metro_rng *rng)
{
    double s1, u, c, v, y, turns;
    if (kappa < 1e-17) return metro_rng_uniform(rng) - 0.5;
    s1 = (1 + 1 / (2 * kappa + hypot(1, 2 * kappa))) * (0.5 / kappa); /* eq 3.4 */
    do {
        u = 0.5 * METROI_PI * metro_rng_uniform(rng);
        c = cos(u);
        u = sin(u);
        /* a point of the envelope: v = (s - 1)(1 - z)/(s + z) with z = cos(2 u) */
        v = 2 * s1 * u * u / (s1 + 2 * c * c);
        y = kappa * s1 + kappa * v;
        u = metro_rng_uniform(rng);
    } while (!(y * (2 - y) > u || log(y / u) + 1 - y >= 0));
    turns = asin(sqrt(v < 2 ? 0.5 * v : 1)) / METROI_PI;
    return metro_rng_uniform(rng) < 0.5 ? -turns : turns;
}

/* Kelemen's step is s2 exp(-L v) with v uniform; one random number serves for the sign and for v. */

static double metroi_kelemen_step(double s1, double s2, metro_rng *rng)
{
    double u = 2 * metro_rng_uniform(rng);
    double v = u < 1 ? u : u - 1, step = s2 * exp(-metroi_kelemen_log(s1, s2) * v);
    return u < 1 ? step : -step;
}

/* One step of a valid kernel on the line, without its large steps. The triangle is the sum of two uniform steps of
   half its width, the Cauchy step the tangent of a uniform angle. */

static double metroi_kernel_step(const metro_kernel *k, metro_rng *rng)
{
    double u = 0, v;
    switch (k->shape) {
    case METRO_UNIFORM: return k->size * (metro_rng_uniform(rng) - 0.5);
    case METRO_TRIANGLE:
        u = metro_rng_uniform(rng);
        v = metro_rng_uniform(rng);
        return 0.5 * k->size * (u + v - 1);
    case METRO_GAUSSIAN: return k->size * metro_rng_normal(rng);
    case METRO_CAUCHY: return k->size * tan(METROI_PI * (metro_rng_uniform(rng) - 0.5));
    case METRO_VON_MISES: return metroi_von_mises_step(k->size, rng);
    case METRO_KELEMEN: return metroi_kelemen_step(k->size_min, k->size, rng);
    }
    return u;
}

/* A step of many turns leaves few digits for where it ends: beyond 2^32 turns fewer than 21 bits. What is lost is
   close to uniform, because no kernel is steep that far out, and a uniform draw stands for it. */

#define METROI_FAR_STEP 4294967296.0

/* The point that `k` draws from `x`, before it is wrapped or folded. */
static double metroi_kernel_draw(const metro_kernel *k, double x, metro_rng *rng)
{
    double step;
    if (!metroi_kernel_valid(k) || !isfinite(x)) return METROI_NAN;
    if (k->large > 0 && metro_rng_uniform(rng) < k->large) return metro_rng_uniform(rng);
    step = metroi_kernel_step(k, rng);
    return fabs(step) <= METROI_FAR_STEP ? x + step : metro_rng_uniform(rng);
}

/* The plain uniform kernel is the inner loop of the laboratory and goes first; the one comparison of its size is all
   the checking it needs, since NaN fails it. */

METRO_API double metro_kernel_perturb(const metro_kernel *k, double x, metro_rng *rng)
{
    if (k->shape == METRO_UNIFORM && k->large == 0 && k->size > 0 && k->size <= METROI_FAR_STEP)
        return metroi_wrap(x + k->size * (metro_rng_uniform(rng) - 0.5));
    return metroi_wrap(metroi_kernel_draw(k, x, rng));
}

METRO_API double metro_kernel_reflect_perturb(const metro_kernel *k, double x, metro_rng *rng)
{
    if (k->shape == METRO_VON_MISES) return METROI_NAN;
    return metroi_fold(metroi_kernel_draw(k, x, rng));
}

METROI_COLD

/* # 3.5 The spectrum of Kelemen's kernel

   The transform of a density 1/(2 L abs(u)) between s1 and s2 is a difference of cosine integrals,

       P*(k) = frac{Ci(b) - Ci(a)}{L}, a = 2 pi k s1, b = 2 pi k s2                   (3.5)

   and taking that difference as it stands would lose digits twice: for small b, where P* is near 1, and for s1 near
   s2, where L is small. Both times we go for the gap. For b below 4 it has a series whose terms stay small,

       1 - P*(k) = frac{1}{L} sum_{m=1}^{inf} (-1)^{m+1} frac{b^{2m}}{2m (2m)!} (1 - e^{-2 m L})      (3.6)

   and for s1 near s2 it is the mean of 2 sin^2 over a short range, for which the Gauss rule is exact to rounding:

       1 - P*(k) = int_{0}^{1} 2 sin^2(pi k s2 e^{-L u}) du                           (3.7)

   The series first. */

static double metroi_kelemen_gap(double b, double l)
{
    double sum = 0, power = 1, term, m;
    for (m = 1; m <= 20; m++) {
        power *= -b * b / ((2 * m - 1) * 2 * m);
        term = power * -expm1(-2 * m * l) / (2 * m);
        sum -= term;
        if (fabs(term) < 1e-18 * fabs(sum)) break;
    }
    return sum / l; /* eq 3.6 */
}

static void metroi_kelemen_narrow(double frequency, double s2, double b, double l, double *value, double *gap)
{
    double sine = metroi_sin_pi(frequency, s2), cosine = metroi_cos_pi(frequency, s2);
    double sine2 = metroi_sin_pi(2 * frequency, s2), cosine2 = metroi_cos_pi(2 * frequency, s2);
    double weight, node, s, c, x;
    int i;
    *value = *gap = 0;
    for (i = 0; i < 24; i++) {
        node = metroi_gauss24(i, &weight);
        /* the whole turns of k s2 are off already; what e^{-L u} changes is a small angle, taken by its half */
        x = 0.5 * b * expm1(-l * node);
        s = sin(x);
        c = cos(x);
        x = sine * c + cosine * s;
        *value += weight * (cosine2 * (1 - 2 * s * s) - sine2 * 2 * s * c);
        *gap += weight * 2 * x * x; /* eq 3.7 */
    }
}

/* Above x = 4 the cosine integral is the real part of an exponential integral whose oscillation can be taken out,

       Ci(x) = -Re(e^{-i x} h(x)), h(x) = e^{i x} E_1(i x)                            (3.8)

   and h is smooth, near 1/(i x). It is had to x = 50 by the continued fraction of the exponential integral, evaluated
   forwards (Lentz 1976, in the form of Press et al. 1992, cisi); above by the asymptotic series (Abramowitz and
   Stegun 1964, 5.2.34 and 5.2.35), whose smallest term at 50 is 1e-22. Sine and cosine come from section 3.2. */

static void metroi_exponential_series(double x, double *re, double *im)
{
    double z = 1 / (x * x), f = 1, g = 1, even = 1, odd = 1, m;
    for (m = 1; m <= 40 && odd > 1e-18; m++) {
        even *= (2 * m - 1) * 2 * m * z;
        odd *= 2 * m * (2 * m + 1) * z;
        f += fmod(m, 2) > 0 ? -even : even;
        g += fmod(m, 2) > 0 ? -odd : odd;
    }
    *re = g / x / x;
    *im = -f / x;
}

static void metroi_exponential_fraction(double x, double *re, double *im)
{
    double scale = 1 / (1 + x * x), dr = scale, di = -x * scale, hr = dr, hi = di, cr = 1e300, ci = 0, br = 1, t, u;
    int i;
    for (i = 1; i < 200; i++) {
        double a = -(double)i * (double)i;
        br += 2;
        /* d = 1/(a d + b) */
        t = a * dr + br;
        u = a * di + x;
        scale = 1 / (t * t + u * u);
        dr = t * scale;
        di = -u * scale;
        /* c = b + a/c: the first c is as good as infinite, and its square would overflow */
        scale = i == 1 ? 0 : a / (cr * cr + ci * ci);
        t = br + cr * scale;
        ci = x - ci * scale;
        cr = t;
        /* h = h c d */
        t = cr * dr - ci * di;
        u = cr * di + ci * dr;
        scale = hr * t - hi * u;
        hi = hr * u + hi * t;
        hr = scale;
        if (fabs(t - 1) + fabs(u) < 1e-16) break;
    }
    *re = hr;
    *im = hi;
}

static void metroi_exponential_integral(double x, double *re, double *im)
{
    if (x <= 50) metroi_exponential_fraction(x, re, im);
    else metroi_exponential_series(x, re, im);
}

/* Ci(2 pi f s). Below 4: gamma + ln x - sum (-1)^{m+1} x^{2m}/(2m (2m)!), Abramowitz and Stegun (1964), 5.2.16. */
static double metroi_cosine_integral(double frequency, double s)
{
    double x = 2 * METROI_PI * frequency * s, power = 1, sum = 0, re, im, m;
    if (x <= 4) {
        for (m = 1; m <= 20 && fabs(power) > 1e-18; m++) {
            power *= -x * x / ((2 * m - 1) * 2 * m);
            sum += power / (2 * m);
        }
        return 0.57721566490153286061 + log(x) + sum;
    }
    if (!(x < 1e300)) return 0;
    metroi_exponential_integral(x, &re, &im);
    return -(metroi_cos_pi(2 * frequency, s) * re + metroi_sin_pi(2 * frequency, s) * im);
}

/* The transform of Kelemen's kernel at any frequency of at least 0 (whole or half-whole, for exact phases) and its
   gap; s1 = s2 are two atoms. Worst absolute error 3e-16. The bounds of the three ranges are where their errors
   cross. */

static void metroi_kelemen_mode(double s1, double s2, double frequency, double *value, double *gap)
{
    double l = metroi_kelemen_log(s1, s2), a = 2 * METROI_PI * frequency * s1, b = 2 * METROI_PI * frequency * s2, x;
    if (!(s1 < s2)) {
        x = metroi_sin_pi(frequency, s2);
        *gap = 2 * x * x;
        *value = metroi_cos_pi(2 * frequency, s2);
    } else if (l <= 2 && b > 1.5 && b - a <= 8) {
        metroi_kelemen_narrow(frequency, s2, b, l, value, gap);
    } else if (b <= 4) {
        *gap = metroi_kelemen_gap(b, l);
        *value = 1 - *gap;
    } else {
        *value = (metroi_cosine_integral(frequency, s2) - metroi_cosine_integral(frequency, s1)) / l; /* eq 3.5 */
        *gap = 1 - *value;
    }
}

/* # 3.6 Ratios of Bessel functions

   The von Mises coefficients are I_k(kappa)/I_0(kappa), and those of its relative on the sphere are
   I_{l+1/2}(kappa)/I_{1/2}(kappa). So we want I_{c+k}/I_c for c = 0 and c = 1/2.

   From kappa = 1000 on, Debye's expansion for large order or argument (NIST Handbook 2010, 10.41.3) gives them at
   once, for whole k or not. With nu the order and S = sqrt(nu^2 + kappa^2) it reads

       ln I_nu(kappa) ~ kappa - frac{ln(2 pi kappa)}{2} + A(nu)
       A(nu) = frac{nu^2}{S + kappa} - nu asinh(nu/kappa) - frac{1}{4} ln(1 + nu^2/kappa^2)
               + ln(1 + d(nu))                                                        (3.9)

   where d(nu) is the sum of u_m(nu/S)/nu^m. Each term of A is small where nu is small, so the logarithm of a
   coefficient near 1 keeps all its digits. Four terms of d leave 2e-16 at S = 1000. */

#define METROI_DEBYE 1000.0

static double metroi_debye(double order, double s)
{
    double z = order / s * (order / s);
    double u1 = (3 - 5 * z) / 24;
    double u2 = (81 + z * (-462 + 385 * z)) / 1152;
    double u3 = (30375 + z * (-369603 + z * (765765 - 425425 * z))) / 414720;
    double u4 = (4465125 + z * (-94121676 + z * (349922430 + z * (-446185740 + 185910725 * z)))) / 39813120;
    return (u1 + (u2 + (u3 + u4 / s) / s) / s) / s;
}

/* A(nu) but for its last term, whose d(nu) it leaves in `d`. */
static double metroi_debye_log(double nu, double kappa, double *d)
{
    double s = hypot(nu, kappa), z = nu / kappa;
    *d = metroi_debye(nu, s);
    return nu * (nu / (s + kappa) - asinh(z)) - 0.25 * log1p(z * z);
}

/* ln(I_{c+k}(kappa)/I_c(kappa)) for kappa >= METROI_DEBYE, c = `order`, k >= 0 real: smooth in k, relative error
   1e-15. */
static double metroi_bessel_log(double order, double k, double kappa)
{
    double d, d0, low = metroi_debye_log(order, kappa, &d0), high = metroi_debye_log(order + k, kappa, &d);
    return high - low + log1p((d - d0) / (1 + d0)); /* eq 3.9 */
}

/* Below kappa = 1000 we multiply the ratios of neighbours, r_j = I_{c+j}/I_{c+j-1}, which follow from each other
   downwards, where the recurrence is stable (Gautschi 1967),

       r_j = frac{1}{2(c + j)/kappa + r_{j+1}}                                        (3.10)

   from far enough out that starting at 0 is forgotten. Where the leading term of eq 3.9 says that the product
   underflows, it is 0. */

static double metroi_bessel_product(double order, double k, double kappa)
{
    double product = 1, r = 0, j;
    if (!(kappa > 0)) return 0; /* a negative zero, too */
    if (!(k * asinh(k / kappa) - k * k / (hypot(k, kappa) + kappa) <= 760)) return 0;
    for (j = ceil(k + 60 + 1.5 * sqrt(40 * kappa)); j >= 1; j--) {
        r = 1 / (2 * (order + j) / kappa + r); /* eq 3.10 */
        if (j <= k) product *= r;
    }
    return product;
}

/* Products of numbers near 1 lose their distance from 1. For one von Mises coefficient that distance is an integral
   of positive terms,

       1 - P*(k) = frac{sum_{j} w_j 2 sin^2(pi k j/N)}{sum_{j} w_j}, w_j = e^{-2 kappa sin^2(pi j/N)}      (3.11)

   over the N points of the trapezoidal rule, which converges faster than any power of 1/N for a periodic function
   (Trefethen and Weideman 2014); N = 12 sqrt(kappa) + 48 + k leaves nothing that a double can see. Terms stop at w_j
   < 1e-19, so some 20 count, whatever kappa is. Returns the mean of w, which is e^{-kappa} I_0(kappa). */

static double metroi_von_mises_mean(double kappa, double k, double *gap)
{
    double nodes = 2 * ceil(6 * sqrt(kappa) + 24 + k / 2), sum = 1, moment = 0, w, s, j;
    for (j = 1; 2 * j <= nodes; j++) {
        s = sqrt(kappa) * sin(METROI_PI * (j / nodes));
        w = exp(-2 * s * s);
        if (w < 1e-19) break;
        if (2 * j < nodes) w *= 2;
        s = sin(METROI_PI * (fmod(k * j, nodes) / nodes));
        sum += w;
        moment += w * 2 * s * s;
    }
    *gap = moment / sum; /* eq 3.11 */
    return sum / nodes;
}

/* Chapter 5 wants all coefficients up to some k, as logarithms that are right both where P* is near 1 and where it
   has all but vanished. Upwards, the gaps follow from each other,

       delta_{k+1} = delta_{k-1} + frac{2(c + k)}{kappa} (1 - delta_k), delta_0 = 0   (3.12)

   stably while P* is not small; beyond delta = 3/4 the ratios of eq 3.10 take over. */

static void metroi_bessel_logs(double order, double first_gap, double kappa, size_t count, double *log_value)
{
    double r = 0, before = 0, gap = first_gap, next;
    size_t j;
    if (kappa >= METROI_DEBYE) {
        for (j = 1; j <= count; j++) log_value[j - 1] = metroi_bessel_log(order, (double)j, kappa);
        return;
    }
    /* ratios, downwards */
    for (j = count + 60 + (size_t)(1.5 * sqrt(40 * kappa)); j >= 1; j--) {
        r = 1 / (2 * (order + (double)j) / kappa + r); /* eq 3.10 */
        if (j <= count) log_value[j - 1] = r;
    }
    /* gaps, upwards */
    for (j = 1; j <= count && kappa >= 1 && gap < 0.75; j++) {
        log_value[j - 1] = log1p(-gap);
        next = before + 2 * (order + (double)j) / kappa * (1 - gap); /* eq 3.12 */
        before = gap;
        gap = next;
    }
    /* and on by the ratios */
    for (; j <= count; j++) log_value[j - 1] = log(log_value[j - 1]) + (j > 1 ? log_value[j - 2] : 0);
}

/* ln P*(j) for j = 1 .. count: von Mises, and von Mises-Fisher on the sphere (there delta_1 = 1/kappa - 2/(e^{2
   kappa} - 1)). -inf where kappa is 0. */

static void metroi_von_mises_logs(double kappa, size_t count, double *log_value)
{
    double gap = 1;
    if (kappa >= 1 && kappa < METROI_DEBYE) metroi_von_mises_mean(kappa, 1, &gap);
    metroi_bessel_logs(0, gap, kappa, count, log_value);
}

static void metroi_vmf_logs(double kappa, size_t count, double *log_value)
{
    double gap = kappa >= 1 ? 1 / kappa - 2 / expm1(2 * kappa) : 1;
    metroi_bessel_logs(0.5, gap, kappa, count, log_value);
}

/* # 3.7 One mode at a time

   The coefficient of a valid kernel at a frequency (k on the circle, k/2 on the interval) and its gap, both accurate
   where they are small. */

static void metroi_von_mises_mode(double kappa, double k, double *value, double *gap)
{
    if (kappa >= METROI_DEBYE) {
        double l = metroi_bessel_log(0, k, kappa);
        *value = exp(l);
        *gap = -expm1(l);
    } else if (k * k < 2 * kappa) {
        metroi_von_mises_mean(kappa, k, gap);
        *value = 1 - *gap;
    } else {
        *value = metroi_bessel_product(0, k, kappa);
        *gap = 1 - *value;
    }
}

/* sin(pi f h)/(pi f h), paper (17), and its gap. */
static void metroi_sinc_mode(double frequency, double h, double *value, double *gap)
{
    double y = METROI_PI * (frequency * h);
    if (y < 0.7) {
        *gap = metroi_sinc_gap(y);
        *value = 1 - *gap;
    } else {
        *value = y < 1e300 ? metroi_sin_pi(frequency, h) / y : 0; /* eq 5.19 */
        *gap = 1 - *value;
    }
}

static void metroi_kernel_mode(const metro_kernel *k, double frequency, double *value, double *gap)
{
    double s = k->size, f = fabs(frequency), v = 1, g = 0, e = 0;
    switch (k->shape) {
    case METRO_UNIFORM: metroi_sinc_mode(f, s, &v, &g); break;
    case METRO_TRIANGLE:
        metroi_sinc_mode(f, s / 2, &v, &g);
        g *= 1 + v;
        v *= v;
        break;
    case METRO_GAUSSIAN: e = 2 * (METROI_PI * s * f) * (METROI_PI * s * f); break;
    case METRO_CAUCHY: e = 2 * METROI_PI * s * f; break;
    case METRO_VON_MISES: metroi_von_mises_mode(s, f, &v, &g); break;
    case METRO_KELEMEN: metroi_kelemen_mode(k->size_min, s, f, &v, &g); break;
    }
    if (k->shape == METRO_GAUSSIAN || k->shape == METRO_CAUCHY) {
        v = exp(-e);
        g = -expm1(-e);
    }
    *value = (1 - k->large) * v; /* eq 3.1 */
    *gap = (1 - k->large) * g + k->large;
}

static double metroi_kernel_value(const metro_kernel *k, double frequency)
{
    double value, gap;
    if (!metroi_kernel_valid(k)) return METROI_NAN;
    if (frequency == 0) return 1;
    metroi_kernel_mode(k, frequency, &value, &gap);
    return value;
}

METRO_API double metro_kernel_coefficient(const metro_kernel *k, long harmonic)
{
    return metroi_kernel_value(k, (double)harmonic);
}

METRO_API double metro_kernel_reflect_coefficient(const metro_kernel *k, long harmonic)
{
    return k->shape == METRO_VON_MISES ? METROI_NAN : metroi_kernel_value(k, 0.5 * (double)harmonic);
}

/* # 3.8 Densities on the circle

   Wrapping adds up what the density of the line has at u, u + 1, u - 1, and so on. For steps of many turns those sums
   have closed forms; d is the distance of the two points on the circle, between 0 and 1/2.

   The uniform kernel counts the whole numbers within Delta/2 of d, and one that is exactly at the end counts half:
   with F(t) the mean of floor and ceiling, the count is F(Delta/2 - d) + F(Delta/2 + d). */

static double metroi_uniform_density(double size, double d)
{
    double a = 0.5 * size - d, b = 0.5 * size + d;
    return (0.5 * (floor(a) + ceil(a)) + 0.5 * (floor(b) + ceil(b))) / size;
}

/* The triangle whose half base h exceeds 1/2: what differs from the uniform density is itself a small triangle, whose
   half base g is the distance of h from the nearest whole number,

       P(d) = 1 + frac{max(0, g - d) - g^2}{h^2}                                      (3.13)

   as its coefficients sinc(k h)^2 = (g/h)^2 sinc(k g)^2 say. */

static double metroi_triangle_density(double size, double d)
{
    double h = 0.5 * size, g = fabs(h - rint(h));
    if (h <= 0.5) return d < h ? (1 - d / h) / h : 0;
    return 1 + ((d < g ? g - d : 0) / h - g * (g / h)) / h; /* eq 3.13 */
}

/* The Gaussian as a sum of its images or, where it is wide, as its Fourier series: at sigma = 1/4 both need six
   terms. The two agree by Poisson's summation formula. */

static double metroi_gaussian_density(double sigma, double d)
{
    double sum = 0, m;
    if (sigma > 0.25) {
        for (m = 6; m >= 1; m--) {
            double y = METROI_PI * sigma * m;
            sum += exp(-2 * y * y) * metroi_cos_pi(2 * m, d);
        }
        return 1 + 2 * sum;
    }
    for (m = -3; m <= 3; m++) sum += exp(-0.5 * ((d + m) / sigma) * ((d + m) / sigma));
    return sum / (sqrt(2 * METROI_PI) * sigma);
}

/* The Cauchy images add up to a Poisson kernel, with q = exp(-2 pi gamma):

       P(d) = frac{(1 - q)(1 + q)}{(1 - q)^2 + 4 q sin^2(pi d)}                       (3.14)

   which we divide through by 1 - q, so that nothing underflows for a tiny gamma. */

static double metroi_cauchy_density(double gamma, double d)
{
    double q = exp(-2 * METROI_PI * gamma), gap = -expm1(-2 * METROI_PI * gamma), s = sin(METROI_PI * d);
    return (1 + q) / (gap + 4 * q * (s * s / gap)); /* eq 3.14 */
}

static double metroi_von_mises_density(double kappa, double d)
{
    double gap, s = sqrt(kappa) * sin(METROI_PI * d);
    return exp(-2 * s * s) / metroi_von_mises_mean(kappa, 0, &gap);
}

/* Kelemen's kernel needs the sum of 1/y over y, y + 1, ... inside [s1, s2]. Thirty-two terms are added as they are; a
   longer sum is added up to 16 and finished by the asymptotic series of the digamma function (Abramowitz and Stegun
   1964, 6.3.18), which leaves 1e-16 there. */

static double metroi_digamma_rest(double y)
{
    double z = 1 / (y * y);
    return -0.5 / y - z * (1 / 12.0 - z * (1 / 120.0 - z * (1 / 252.0 - z * (1 / 240.0 - z / 132.0))));
}

static double metroi_reciprocal_sum(double y, double s1, double s2)
{
    double first = s1 > y ? ceil(s1 - y) : 0, last = floor(s2 - y), sum = 0, j;
    if (last < first) return 0;
    /* an end that falls on s1 or s2 counts half */
    if (y + first == s1) sum -= 0.5 / (y + first);
    if (y + last == s2) sum -= 0.5 / (y + last);
    for (j = first; j <= last && (last - first <= 32 || y + j < 16); j++) sum += 1 / (y + j);
    if (j > last) return sum;
    return sum + log1p((last + 1 - j) / (y + j)) + metroi_digamma_rest(y + last + 1) - metroi_digamma_rest(y + j);
}

static double metroi_kelemen_density(double s1, double s2, double d)
{
    double sum;
    if (!(s1 < s2)) return d == fabs(s1 - rint(s1)) ? METROI_INFINITY : 0;
    sum = metroi_reciprocal_sum(d, s1, s2) + metroi_reciprocal_sum(1 - d, s1, s2);
    return sum / (2 * metroi_kelemen_log(s1, s2));
}

/* The density of a valid kernel at signed distance `step`, on a circle of length `length` (1, or 2 for the
   interval). */

static double metroi_circle_density(const metro_kernel *k, double step, double length)
{
    double size = k->size / length, d = fabs(step / length - rint(step / length)), density = 0;
    if (k->large == 1) return 1 / length;
    switch (k->shape) {
    case METRO_UNIFORM: density = metroi_uniform_density(size, d); break;
    case METRO_TRIANGLE: density = metroi_triangle_density(size, d); break;
    case METRO_GAUSSIAN: density = metroi_gaussian_density(size, d); break;
    case METRO_CAUCHY: density = metroi_cauchy_density(size, d); break;
    case METRO_VON_MISES: density = metroi_von_mises_density(size, d); break;
    case METRO_KELEMEN: density = metroi_kelemen_density(k->size_min / length, size, d); break;
    }
    return ((1 - k->large) * density + k->large) / length;
}

METRO_API double metro_kernel_density(const metro_kernel *k, double from, double to)
{
    if (!metroi_kernel_valid(k) || !isfinite(from) || !isfinite(to)) return METROI_NAN;
    return metroi_circle_density(k, to - from, 1);
}

/* On the interval a step from x to y goes straight or by way of the mirror image -y; on the circle of length 2 those
   are two points, and their densities add up:

       P(x -> y) = C(y - x) + C(y + x), C the kernel on the circle of length 2        (3.15)

   Both distances are the same, to the last bit, when x and y change places. */

METRO_API double metro_kernel_reflect_density(const metro_kernel *k, double from, double to)
{
    if (!metroi_kernel_valid(k) || k->shape == METRO_VON_MISES || !isfinite(from) || !isfinite(to)) return METROI_NAN;
    from = fabs(from - 2 * rint(from / 2));
    to = fabs(to - 2 * rint(to / 2));
    return metroi_circle_density(k, to - from, 2) + metroi_circle_density(k, to + from, 2); /* eq 3.15 */
}

METROI_WARM

/* # 3.9 Directions

   A direction is turned by an angle theta from the old one, in a plane at a uniform azimuth. Near the axis 1 -
   cos(theta) is what is known well, t, and sin(theta) is sqrt(t (2 - t)). The frame around the old direction is that
   of Duff et al. (2017): it has no branch and no direction where it fails, unlike a cross product with a fixed axis.
   The result is normalised, so that rounding does not add up over a long chain; an old direction whose squared length
   is off 1 by a per cent is a mistake of the caller and gives NaN. */

static inline void metroi_frame(metro_vec3 n, metro_vec3 *across, metro_vec3 *down)
{
    double sign = n.z < 0 ? -1 : 1, a = -1 / (sign + n.z), b = n.x * n.y * a;
    *across = metro_vec3_make(1 + sign * n.x * n.x * a, sign * b, -sign * n.x);
    *down = metro_vec3_make(b, sign + n.y * n.y * a, -n.y);
}

static inline metro_vec3 metroi_in_frame(metro_vec3 n, double u, double v, double w)
{
    metro_vec3 across, down;
    metroi_frame(n, &across, &down);
    return metro_vec3_make(u * across.x + v * down.x + w * n.x, u * across.y + v * down.y + w * n.y,
                           u * across.z + v * down.z + w * n.z);
}

static metro_vec3 metroi_direction_turn(metro_vec3 n, double t, metro_rng *rng)
{
    double azimuth = 2 * METROI_PI * metro_rng_uniform(rng), radius = sqrt(t < 2 ? t * (2 - t) : 0);
    double w = fabs(metro_dot(n, n) - 1) < 0.01 ? 1 - t : METROI_NAN;
    return metro_normalize(metroi_in_frame(n, radius * cos(azimuth), radius * sin(azimuth), w));
}

/* t = 1 - cos(theta) between unit vectors: half the squared distance of their tips, which keeps its digits where the
   cosine is near 1. */

static double metroi_direction_gap(metro_vec3 from, metro_vec3 to)
{
    metro_vec3 d = metro_subtract(to, from);
    return 0.5 * metro_dot(d, d);
}

/* The greatest t of a cone, 1 - cos(half angle) = 2 sin^2(half angle/2); NaN for what is no cone. */
static double metroi_cone_height(double half_angle)
{
    double s = sin(0.5 * half_angle);
    if (!(half_angle > 0 && isfinite(half_angle))) return METROI_NAN;
    return half_angle < METROI_PI ? 2 * s * s : 2;
}

/* The height of a uniform point of a spherical cap is uniform (Archimedes). */

METRO_API metro_vec3 metro_cone_perturb(double half_angle, metro_vec3 from, metro_rng *rng)
{
    double height = metroi_cone_height(half_angle);
    return metroi_direction_turn(from, height * metro_rng_uniform(rng), rng);
}

METRO_API double metro_cone_density(double half_angle, metro_vec3 from, metro_vec3 to)
{
    double height = metroi_cone_height(half_angle), t = metroi_direction_gap(from, to);
    if (isnan(height) || isnan(t)) return METROI_NAN;
    return t <= height || height == 2 ? 1 / (2 * METROI_PI * height) : 0;
}

/* The von Mises-Fisher density e^{kappa cos theta} is an exponential in t = 1 - cos(theta), cut off at 2. Its
   distribution function has an inverse (Ulrich 1984; Jakob 2012 for the form that does not overflow):

       t = -frac{1}{kappa} ln(1 - u (1 - e^{-2 kappa})), u uniform                    (3.16)

   and per steradian it is frac{kappa}{2 pi (1 - e^{-2 kappa})} e^{-kappa t}. Below kappa = 1e-17 it is uniform to the
   last bit. */

METRO_API metro_vec3 metro_vmf_perturb(double kappa, metro_vec3 from, metro_rng *rng)
{
    double u = metro_rng_uniform(rng);
    double t = kappa < 1e-17 ? 2 * u : -log1p(u * expm1(-2 * kappa)) / kappa; /* eq 3.16 */
    if (!(kappa >= 0 && isfinite(kappa))) t = METROI_NAN;
    return metroi_direction_turn(from, t, rng);
}

METRO_API double metro_vmf_density(double kappa, metro_vec3 from, metro_vec3 to)
{
    double t = metroi_direction_gap(from, to);
    if (!(kappa >= 0 && isfinite(kappa)) || isnan(t)) return METROI_NAN;
    return kappa < 1e-17 ? 1 / (4 * METROI_PI) : kappa / (-2 * METROI_PI * expm1(-2 * kappa)) * exp(-kappa * t);
}

/* # 3.10 Spectra on the sphere

   A kernel that depends on the angle alone multiplies every spherical harmonic of degree l by the same number
   lambda_l, its Legendre coefficient (Funk 1915, Hecke 1918). For the cone,

       lambda_l = frac{P_{l-1}(c) - P_{l+1}(c)}{(2l+1)(1 - c)}, c = cos(alpha)        (3.17)

   and for a narrow cone eq 3.17 is 0/0. With w = 1 - c = 2 sin^2(alpha/2), h = cos^2(alpha/2) and lambda_{i+1} = h
   C_i, the recurrence of the Legendre polynomials becomes one for the differences D_i = C_i - C_{i-1}, where nothing
   cancels:

       D_{i+1} = frac{i D_i - (2i+3) w C_i}{i + 3}, C_{i+1} = C_i + D_{i+1}, C_0 = 1, D_0 = 0       (3.18)

   We carry 1 - C, so that chapter 5 has the logarithm of C as well. A cone wider than pi/2 is the whole sphere less a
   narrow cone around the other pole, so

       lambda_l(alpha) = (-1)^{l+1} cot^2(alpha/2) lambda_l(pi - alpha)               (3.19)

   which also keeps the digits of a cone close to the whole sphere. */

typedef struct {
    double w, gap; /* w = 1 - cos(alpha); gap = 1 - C_i: lambda_{i+1} = cos^2(alpha/2) (1 - gap) */
    double d, i;
} metroi_cone;

static metroi_cone metroi_cone_start(double height)
{
    metroi_cone cone;
    cone.w = height;
    cone.gap = cone.d = cone.i = 0;
    return cone;
}

static void metroi_cone_next(metroi_cone *cone)
{
    cone->d = (cone->i * cone->d - (2 * cone->i + 3) * cone->w * (1 - cone->gap)) / (cone->i + 3); /* eq 3.18 */
    cone->gap -= cone->d;
    cone->i++;
}

METRO_API double metro_cone_coefficient(double half_angle, int degree)
{
    double angle = half_angle <= 0.5 * METROI_PI ? half_angle : METROI_PI - half_angle + 1.2246467991473532e-16, h, t;
    metroi_cone cone = metroi_cone_start(metroi_cone_height(angle));
    if (!(half_angle > 0 && isfinite(half_angle)) || degree < 0) return METROI_NAN;
    if (degree == 0) return 1;
    if (half_angle >= METROI_PI) return 0;
    while (cone.i + 1 < degree) metroi_cone_next(&cone);
    h = cos(0.5 * angle);
    if (half_angle <= 0.5 * METROI_PI) return h * h * (1 - cone.gap);
    t = sin(0.5 * angle); /* eq 3.19: cot(alpha/2) = tan((pi - alpha)/2), and cos^2 cancels */
    return (degree % 2 ? t * t : -t * t) * (1 - cone.gap);
}

METRO_API double metro_vmf_coefficient(double kappa, int degree)
{
    double logarithm;
    if (!(kappa >= 0 && isfinite(kappa)) || degree < 0) return METROI_NAN;
    if (degree == 0) return 1;
    if (kappa >= METROI_DEBYE) return exp(metroi_bessel_log(0.5, degree, kappa));
    if (degree > 1) return metroi_bessel_product(0.5, degree, kappa);
    metroi_vmf_logs(kappa, 1, &logarithm);
    return exp(logarithm);
}

#undef METROI_FAR_STEP

/* # 4 The chain

   This chapter is the sampler, and there is no other: every space, one-dimensional or of many directions, is a target
   of the same chain.

   We want the integral of a vector-valued f, and have an importance I, a number that is large where f is. If
   states $z_i$ come with density I(z)/b, where b is the integral of I, then (paper (2))

       int f(z) dz = b E[frac{f(z)}{I(z)}] ~ frac{b}{M} sum_{i=1}^{M} frac{f(z_i)}{I(z_i)}                   (4.1)

   Three things hide in this line. It needs I > 0 wherever f is not 0, or part of the integral is never visited. b is
   a second unknown, to be estimated with an error of its own. And the states have that density only in the limit: how
   far from it they are after n steps is the subject of this book. */

/* # 4.1 Acceptance

   The chain at state i draws a tentative state t with density T(i -> t) and accepts it with probability

       a(i -> t) = min(1, frac{I(t) T(t -> i)}{I(i) T(i -> t)})                                              (4.2)

   The paper prints $I(t) T(i -> t)$ over $I(i) T(i -> t)$. There T cancels, and what is left, I(t)/I(i), is right for
   a symmetric T only. On a ring of five states with T = .7 to the right and .3 to the left and target (.05, .1, .15,
   .2, .5) the printed form converges to (.055, .066, .089, .150, .640), and eq 4.2 to the target. With eq 4.2 the
   flow from i to t and the flow back are equal when the density is I/b,

       I(i) T(i -> t) a(i -> t) = min(I(i) T(i -> t), I(t) T(t -> i)) = I(t) T(t -> i) a(t -> i)             (4.3)

   which is called detailed balance and makes I/b stationary (Metropolis et al. 1953; Hastings 1970).

   The quotient of two importances can leave the range of doubles, 1e300 over 1e-300, where a ratio of transitions
   brings it back. Only then do we take logarithms. */

static double metroi_acceptance(double current, double tentative, double ratio)
{
    double quotient, a;
    if (ratio == 1) return tentative < current ? tentative / current : 1; /* nothing can overflow */
    if (!(tentative > 0) || !(ratio > 0)) return 0;
    quotient = tentative / current;
    a = quotient * ratio;
    if (!(quotient > 1e-290 && quotient < 1e290 && a > 1e-290 && a < 1e290))
        a = exp(log(tentative) - log(current) + log(ratio));
    return a < 1 ? a : 1; /* eq 4.2 */
}

/* A number that is not a proper importance or ratio counts as zero, so the tentative state is rejected; it is
   counted, and never repaired. */

static double metroi_count_value(metro_chain_counts *counts, double value)
{
    if (value >= 0 && value < METROI_INFINITY) return value;
    if (isnan(value)) counts->nan++;
    else if (value < 0) counts->negative++;
    else counts->infinite++;
    return 0;
}

/* # 4.2 The space

   A state is an array of doubles, one for a circle or an interval and three for a direction. Each kind of axis knows
   how to draw uniformly, how to perturb by its kernel (chapter 3), and how far apart two points are. */

static size_t metroi_axis_doubles(metro_axis_kind kind)
{
    return kind == METRO_DIRECTION ? 3 : 1;
}

static size_t metroi_state_doubles(const metro_target *target)
{
    size_t doubles = 0, i;
    for (i = 0; i < target->axis_count; i++) doubles += metroi_axis_doubles(target->axes[i].kind);
    return doubles;
}

static int metroi_axis_valid(const metro_axis *axis)
{
    metro_shape shape = axis->kernel.shape;
    if (axis->kernel.large != 0 || !metroi_kernel_valid(&axis->kernel)) return 0;
    if (axis->kind == METRO_DIRECTION) return shape == METRO_UNIFORM || shape == METRO_VON_MISES;
    return axis->kind == METRO_CIRCLE || (axis->kind == METRO_INTERVAL && shape != METRO_VON_MISES);
}

static void metroi_direction_put(metro_vec3 direction, double *z)
{
    z[0] = direction.x;
    z[1] = direction.y;
    z[2] = direction.z;
}

static void metroi_state_draw(const metro_target *target, double *z, metro_rng *rng)
{
    size_t i;
    for (i = 0; i < target->axis_count; i++) {
        metro_axis_kind kind = target->axes[i].kind;
        if (kind == METRO_DIRECTION) metroi_direction_put(metro_rng_direction(rng), z);
        else *z = metro_rng_uniform(rng);
        z += metroi_axis_doubles(kind);
    }
}

static void metroi_direction_perturb(const metro_kernel *kernel, const double *from, double *to, metro_rng *rng)
{
    metro_vec3 direction = metro_vec3_make(from[0], from[1], from[2]);
    if (kernel->shape == METRO_UNIFORM) direction = metro_cone_perturb(kernel->size, direction, rng);
    else direction = metro_vmf_perturb(kernel->size, direction, rng);
    metroi_direction_put(direction, to);
}

static void metroi_state_perturb(const metro_target *target, const double *from, double *to, metro_rng *rng)
{
    const metro_axis *axis = target->axes, *end = axis + target->axis_count;
    for (; axis < end; axis++) {
        if (axis->kind == METRO_CIRCLE) *to++ = metro_kernel_perturb(&axis->kernel, *from++, rng);
        else if (axis->kind == METRO_INTERVAL) *to++ = metro_kernel_reflect_perturb(&axis->kernel, *from++, rng);
        else {
            metroi_direction_perturb(&axis->kernel, from, to, rng);
            from += 3;
            to += 3;
        }
    }
}

/* The squared distance is the sum over the axes: the shorter way round a circle, the length of an interval, the angle
   between directions, whose sine is the length of the cross product and whose cosine is the dot product. */

static double metroi_direction_angle(const double *a, const double *b)
{
    metro_vec3 u = metro_vec3_make(a[0], a[1], a[2]), v = metro_vec3_make(b[0], b[1], b[2]);
    return atan2(metro_length(metro_cross(u, v)), metro_dot(u, v));
}

static double metroi_state_distance2(const metro_target *target, const double *a, const double *b)
{
    const metro_axis *axis = target->axes, *end = axis + target->axis_count;
    double sum = 0;
    for (; axis < end; axis++) {
        size_t doubles = metroi_axis_doubles(axis->kind);
        double d = doubles == 3 ? metroi_direction_angle(a, b) : fabs(*a - *b);
        if (axis->kind == METRO_CIRCLE && d > 0.5) d = 1 - d;
        sum += d * d;
        a += doubles;
        b += doubles;
    }
    return sum;
}

/* # 4.3 Making a chain

   Current and tentative state, and the samples that belong to them, live in one allocation. Accepting swaps two pairs
   of pointers, so a step copies nothing, whatever the size of a sample. Sizes are rounded up to 16 bytes, so that a
   sample of any type is aligned. */

static metro_result metroi_chain_check(const metro_target *target, const metro_chain_options *options)
{
    size_t i;
    if (target->axis_count == 0 || target->axes == NULL || target->importance == NULL) return METRO_ERROR_ARGUMENT;
    if (target->axis_count > SIZE_MAX / 256 || target->sample_size > SIZE_MAX / 8) return METRO_ERROR_ARGUMENT;
    if (!(options->large_step >= 0 && options->large_step <= 1)) return METRO_ERROR_ARGUMENT;
    for (i = 0; target->propose == NULL && i < target->axis_count; i++)
        if (!metroi_axis_valid(&target->axes[i])) return METRO_ERROR_ARGUMENT;
    return METRO_OK;
}

METRO_API metro_result metro_chain_make(const metro_target *target, const metro_chain_options *options, metro_rng rng,
                                        metro_chain *chain)
{
    metro_chain made;
    metro_result result;
    size_t state_size, sample_size;
    unsigned char *memory;
    memset(&made, 0, sizeof made);
    if (options != NULL) made.options = *options;
    result = metroi_chain_check(target, &made.options);
    if (result != METRO_OK) return result;
    state_size = (metroi_state_doubles(target) * sizeof(double) + 15) / 16 * 16;
    sample_size = (target->sample_size + 15) / 16 * 16;
    memory = (unsigned char *)METRO_MALLOC(2 * (state_size + sample_size));
    if (memory == NULL) return METRO_ERROR_MEMORY;
    memset(memory, 0, 2 * (state_size + sample_size));
    made.target = *target;
    made.rng = rng;
    made.start_weight = 1;
    made.memory = memory;
    made.state = (double *)(void *)memory;
    made.tentative = (double *)(void *)(memory + state_size);
    made.sample = memory + 2 * state_size;
    made.tentative_sample = memory + 2 * state_size + sample_size;
    *chain = made;
    return METRO_OK;
}

METRO_API void metro_chain_free(metro_chain *chain)
{
    METRO_FREE(chain->memory);
    memset(chain, 0, sizeof *chain);
}

/* # 4.4 A step

   A tentative state is a perturbation, the target's own proposal, or, with the probability of a large step, a uniform
   draw of all axes. A large step goes from anywhere to anywhere with density 1, so its ratio is 1; and it is an
   independent uniform draw, so its importance is one more sample of b, free of charge. */

static double metroi_chain_propose(metro_chain *chain, int *large)
{
    const metro_target *target = &chain->target;
    *large = chain->options.large_step > 0 && metro_rng_uniform(&chain->rng) < chain->options.large_step;
    if (*large) metroi_state_draw(target, chain->tentative, &chain->rng);
    else if (target->propose != NULL)
        return target->propose(chain->state, chain->tentative, &chain->rng, target->user);
    else metroi_state_perturb(target, chain->state, chain->tentative, &chain->rng);
    return 1;
}

static void metroi_chain_swap(metro_chain *chain, double importance)
{
    double *state = chain->state;
    void *sample = chain->sample;
    chain->state = chain->tentative;
    chain->sample = chain->tentative_sample;
    chain->tentative = state;
    chain->tentative_sample = sample;
    chain->importance = importance;
}

static void metroi_chain_record(const metro_chain *chain, const void *sample, double weight)
{
    if (weight > 0 && chain->target.record != NULL) chain->target.record(sample, weight, chain->target.user);
}

METRO_API void metro_chain_flush(metro_chain *chain)
{
    metroi_chain_record(chain, chain->sample, chain->weight);
    chain->weight = 0;
}

/* A step ends in the tentative state with probability a and in the current one otherwise. Instead of recording the
   one that chance picks we may record both, each with its probability, which has the same mean and, for the one step,
   a smaller variance (Veach and Guibas 1997 call it expected values). Over a run it usually helps, but it need not
   (Delmas and Jourdain 2009). For any h, given the states i and t,

       E[h(z_next)] = a(i -> t) h(t) + (1 - a(i -> t)) h(i)                                                  (4.4)

   A state that is rejected often would be recorded often. We let the current sample collect its weights and record
   it once, when it is left. */

METRO_API int metro_chain_step(metro_chain *chain)
{
    metro_chain_counts *counts = &chain->counts;
    double ratio, importance, a, moved, stayed;
    int large, accepted;
    counts->steps++;
    if (!(chain->importance > 0)) return 0; /* not started, or no candidate had importance */

    /* Draw a tentative state and weigh it */
    ratio = metroi_chain_propose(chain, &large);
    importance = chain->target.importance(chain->tentative, chain->tentative_sample, chain->target.user);
    if (importance == 0) counts->dark++;
    importance = metroi_count_value(counts, importance);
    ratio = metroi_count_value(counts, ratio);
    if (large) {
        counts->large_steps++;
        metro_moments_add(&chain->normalisation, importance);
    }
    a = metroi_acceptance(chain->importance, importance, ratio);
    if (a > 0)
        metro_sum_add(&counts->squared_jump,
                      a * metroi_state_distance2(&chain->target, chain->state, chain->tentative));

    /* Decide, and share the weight of this step among the two states: eq 4.4, or all to the one it ends in */
    accepted = a >= 1 || (a > 0 && metro_rng_uniform(&chain->rng) < a);
    moved = chain->options.expected_values ? a : (double)accepted;
    stayed = 1 - moved;
    chain->weight += stayed;
    if (accepted) {
        metroi_chain_record(chain, chain->sample, chain->weight);
        metroi_chain_swap(chain, importance);
        chain->weight = moved;
        counts->accepted++;
        counts->stay = 0;
    } else {
        metroi_chain_record(chain, chain->tentative_sample, moved);
        if (++counts->stay > counts->longest_stay) counts->longest_stay = counts->stay;
    }
    return accepted;
}

METRO_API void metro_chain_run(metro_chain *chain, uint64_t steps)
{
    uint64_t i;
    for (i = 0; i < steps; i++) metro_chain_step(chain);
    metro_chain_flush(chain);
}

METROI_COLD

/* # 4.5 Starting

   The seed decides what the first samples are, and the policies below are the ways to live with that. All of them end
   alike: a state whose importance is positive becomes the current one. */

static metro_result metroi_seed_check(double importance)
{
    if (importance == 0) return METRO_ERROR_DARK_SEED;
    return importance > 0 && isfinite(importance) ? METRO_OK : METRO_ERROR_BAD_SEED;
}

static void metroi_chain_begin(metro_chain *chain, double importance, double start_weight)
{
    metroi_chain_swap(chain, importance);
    chain->weight = 0;
    chain->start_weight = start_weight;
    memset(&chain->counts, 0, sizeof chain->counts);
}

/* Whether z is a point of the space. A target that proposes by itself knows its own space. */
static int metroi_state_valid(const metro_target *target, const double *z)
{
    const metro_axis *axis = target->axes, *end = axis + target->axis_count;
    if (z == NULL) return 0;
    for (; target->propose == NULL && axis < end; z += metroi_axis_doubles(axis->kind), axis++) {
        if (axis->kind == METRO_DIRECTION) {
            double length = metro_length(metro_vec3_make(z[0], z[1], z[2]));
            if (!(fabs(length - 1) <= 1e-6)) return 0;
        } else if (!(*z >= 0 && *z <= 1) || (axis->kind == METRO_CIRCLE && *z == 1)) return 0;
    }
    return 1;
}

METRO_API metro_result metro_chain_start_point(metro_chain *chain, const double *z)
{
    const metro_target *target = &chain->target;
    double importance;
    metro_result result;
    METRO_ASSERT(chain->memory != NULL);
    if (!metroi_state_valid(target, z)) return METRO_ERROR_ARGUMENT;
    memmove(chain->tentative, z, metroi_state_doubles(target) * sizeof *z);
    importance = target->importance(chain->tentative, chain->tentative_sample, target->user);
    result = metroi_seed_check(importance);
    if (result == METRO_OK) metroi_chain_begin(chain, importance, 1);
    return result;
}

/* N seeds (paper (13)): the density of the start is a sum of spikes,

       p_0(z) = sum_{i=1}^{N} alpha_i delta(z - z_i)                                                         (4.5) */

static int metroi_weights_valid(const double *alpha, size_t count)
{
    metro_sum sum = { 0, 0 };
    size_t i;
    for (i = 0; alpha != NULL && i < count; i++) {
        if (!(alpha[i] >= 0)) return 0;
        metro_sum_add(&sum, alpha[i]);
    }
    return count > 0 && (alpha == NULL || fabs(metro_sum_value(&sum) - 1) <= 1e-9);
}

METRO_API metro_result metro_chain_start_seeds(metro_chain *chain, const double *z, const double *alpha, size_t seeds)
{
    const metro_target *target = &chain->target;
    size_t doubles = metroi_state_doubles(target), chosen = 0, i;
    double seen = 0;
    METRO_ASSERT(chain->memory != NULL);
    if (z == NULL || !metroi_weights_valid(alpha, seeds)) return METRO_ERROR_ARGUMENT;
    for (i = 0; i < seeds; i++) {
        metro_result result;
        double weight = alpha != NULL ? alpha[i] : 1;
        if (!metroi_state_valid(target, z + i * doubles)) return METRO_ERROR_ARGUMENT;
        result = metroi_seed_check(target->importance(z + i * doubles, chain->tentative_sample, target->user));
        if (result != METRO_OK) return result;
        /* Seed i replaces the one chosen so far with probability alpha_i / (alpha_1 + ... + alpha_i): eq 4.5 */
        seen += weight;
        if (weight > 0 && metro_rng_uniform(&chain->rng) * seen < weight) chosen = i;
    }
    return metro_chain_start_point(chain, z + chosen * doubles);
}

/* # 4.6 Veach's weighted seeds

   Let x be drawn uniformly and give the whole run the weight I(x). Then, for every n and every h,

       E[I(x) h(z_n)] = int I(z) h(z) dz                                                                     (4.6)

   because the pair (state, weight) has the density of the target from the first step on, and the chain keeps it.
   There is no start-up bias at all; the price is a factor I(x) that varies between runs. Choosing x from N draws in
   proportion to I, with the mean of their importances as the weight, is unbiased too and varies less. To take the
   alpha_i of eq 4.5 in proportion to I(x_i) is the same choice without the weight, which leaves a bias of the order
   1/N. If all draws are dark, the weight is 0, and so is the estimate: that, too, belongs to the mean.

   The candidates pass by once: each replaces the one kept so far with probability W_i / (W_1 + ... + W_i), which
   leaves each in the end with probability proportional to W_i (Chao 1982). The importances are used in units of the
   largest so far, so that their sum cannot overflow. */

/* Evaluates a fresh uniform draw in the tentative buffers; what is no proper importance counts as 0. */
static double metroi_chain_candidate(metro_chain *chain)
{
    const metro_target *target = &chain->target;
    double importance;
    metroi_state_draw(target, chain->tentative, &chain->rng);
    importance = target->importance(chain->tentative, chain->tentative_sample, target->user);
    importance = metroi_count_value(&chain->counts, importance);
    metro_moments_add(&chain->normalisation, importance);
    return importance;
}

METRO_API metro_result metro_chain_start_weighted(metro_chain *chain, size_t candidates)
{
    double sum = 0, unit = 0;
    size_t i;
    METRO_ASSERT(chain->memory != NULL);
    if (candidates == 0) return METRO_ERROR_ARGUMENT;
    memset(&chain->counts, 0, sizeof chain->counts);
    chain->importance = chain->weight = 0;
    for (i = 0; i < candidates; i++) {
        double importance = metroi_chain_candidate(chain);
        if (importance > unit) {
            sum *= unit / importance;
            unit = importance;
        }
        if (!(importance > 0)) continue;
        sum += importance / unit;
        if (metro_rng_uniform(&chain->rng) * sum < importance / unit) metroi_chain_swap(chain, importance);
    }
    chain->start_weight = sum / (double)candidates * unit; /* eq 4.6 */
    return unit > 0 ? METRO_OK : METRO_ERROR_NO_IMPORTANCE;
}

/* # 4.7 Burn-in and the normalisation

   A burn-in throws the first samples away. That lowers the bias, and it raises the variance, since fewer samples are
   left to average. Which wins is computed in section 5.19 for constant importance, and measured in the example
   `startup`.

   [figure: startup.svg | All start-up policies at equal cost: squared bias and variance of a small picture against
   the evaluations spent.]

   b is the mean importance of independent draws, wherever they come from: candidates, large steps, or a survey made
   for it. */

METRO_API void metro_chain_burn(metro_chain *chain, uint64_t steps)
{
    uint64_t i;
    void (*record)(const void *, double, void *) = chain->target.record;
    chain->target.record = NULL;
    for (i = 0; i < steps; i++) metro_chain_step(chain);
    chain->target.record = record;
    chain->weight = 0;
    memset(&chain->counts, 0, sizeof chain->counts);
}

METRO_API void metro_chain_survey(metro_chain *chain, uint64_t samples)
{
    uint64_t i;
    METRO_ASSERT(chain->memory != NULL);
    for (i = 0; i < samples; i++) metroi_chain_candidate(chain);
}

METRO_API double metro_chain_b(const metro_chain *chain, double *error)
{
    if (error != NULL) *error = metro_moments_error(&chain->normalisation);
    return metro_moments_mean(&chain->normalisation);
}

/* # 5 Start-up theory

   A Metropolis chain needs no knowledge of its target to start, and pays for that at the start: its first samples lie
   near the seed. How near, and for how long, can be said exactly in the case that the paper studies, where the
   importance is constant and every tentative sample is accepted. The chain is then a sum of independent steps on a
   circle, and Fourier series turn the sum into powers of numbers. This chapter follows the paper's equations (3) to
   (17) in their order, corrects those that need it, and then evaluates each to twelve digits for every size of the
   perturbation and every number of steps, which the series as it stands does not give: cut after 100 terms it is 5 %
   low for Delta = .01 and n = 1, and at large n its terms underflow.

   # 5.1 Steps add up

   The circle has length 1; all lengths, sizes and seeds are fractions of it. The seed is z_0, and z_n, the state
   after n steps, has the density p_n. With one seed at 0, p_0 is the point mass delta(x). The step from y to x has
   the density P(x - y), even and wrapped around the circle (chapter 3). By the theorem of total probability

       p_{n+1}(x) = int_{0}^{1} p_n(y) P(x - y) dy                                    (5.1)

   This is paper (3) with two repairs. The transition inside the integral leads from y to x, P(y -> x), where the
   paper prints P(x -> y). For an even kernel the two agree, but a kernel that steps to the right would, as printed,
   send the chain to the left: ten steps of +.7 end at -7. And the integral runs over one period, with the wrapped
   kernel, not over the whole line. The Fourier transform F turns this convolution into a product, which is paper (4):

       F(p_{n+1}) = F(p_n) P*                                                         (5.2)

   # 5.2 The series and the error

   A density on the circle of length 1 is the sum of its harmonics,

       p_n(x) = sum_{k=-inf}^{inf} a_k^{(n)} e^{2 pi i k x}
       a_k^{(n)} = int_{0}^{1} p_n(x) e^{-2 pi i k x} dx                              (5.3)

   Paper (5) writes e^{jkx} on [-pi, pi] here, and so do (9), (14) and (15); yet (10), (12) and (17) are those of a
   circle of length 1. The two do not mix: on the circle of length 2 pi, after 3 steps of a uniform perturbation of
   width 1, the L2 error is .625176, while (12) gives 1.567084, because it lacks a factor 1/sqrt(2 pi) there. We stay
   with length 1. By eq 5.2 each coefficient is multiplied by its own number at each step, paper (6) and (7),

       a_k^{(n+1)} = P*(k) a_k^{(n)}                                                  (5.4)

   and since all coefficients of a point mass are 1, after n steps, paper (8) and (9),

       p_n(x) = 1 + 2 sum_{k=1}^{inf} P*(k)^n cos(2 pi k x)                           (5.5)

   The coefficient a_0 stays 1 for ever (eqs 5.3 and 5.4 at k = 0): it is the integral of p_n over the period. Paper
   (11) writes it as 1/(2 pi) times an integral from -pi to pi, which is 1/(2 pi) for a density on that circle, not 1.
   All others die away, so the chain tends to the uniform density. How far it still is from there, paper (10), is

       E_n^2 = int_{0}^{1} (p_n(x) - 1)^2 dx                                          (5.6)

   and Parseval's theorem turns eq 5.6 into paper (12), which is right as printed, on the unit period and for n >= 1:

       E_n^2 = 2 sum_{k=1}^{inf} P*(k)^{2n}                                           (5.7)

   At n = 0 all terms are 1 and the error is infinite. Comparing eq 5.7 with eq 5.5 at x = 0 we find that the squared
   error is a value of a density, that of returning to the seed after twice as many steps:

       E_n^2 = p_{2n}(0) - 1                                                          (5.8)

   With the norm weighted by 1/pi (eq 6.8), and p_{2n}(x_0 -> x_0)/pi(x_0) in place of p_{2n}(0), this holds for any
   reversible chain (chapter 6), and it is the key to this chapter. Everything below is a value of

       e_s(x) = p_s(x) - 1                                                            (5.9)

   which we call the excess: for s = 2n and x = 0, or for several s and x. Small sizes and few steps make its series
   slow and the density easy; large sizes and many steps make the density flat and the series fast. We write it both
   ways, and choose.

   [figure: fig1.svg | The density after n steps: exact curves over histograms of an ensemble (figure 1 of the
   paper).]

   # 5.3 Numbers that outlive the double

   After 100000 steps at Delta = .1 the error is about 1e-717, and no double holds it. We keep such a value as a
   factor and a logarithm, $f e^g$, where g is 0 as long as there is no need for it. */

typedef struct {
    double factor, log; /* factor * exp(log); an exact zero has factor 0 */
} metroi_scaled;

static metroi_scaled metroi_scaled_make(double factor, double logarithm)
{
    metroi_scaled v;
    v.factor = factor;
    v.log = logarithm;
    return v;
}

static double metroi_scaled_value(metroi_scaled v)
{
    return v.factor == 0 ? 0 : v.factor * exp(v.log);
}

/* The square root, and the logarithm of the square root. A square that rounding has pushed below zero is zero. */

static double metroi_scaled_root(metroi_scaled v)
{
    return v.factor <= 0 ? 0 : sqrt(v.factor) * exp(0.5 * v.log);
}

static double metroi_scaled_root_log(metroi_scaled v)
{
    return v.factor <= 0 ? -METROI_INFINITY : 0.5 * (log(v.factor) + v.log);
}

/* ln abs(v) */
static double metroi_scaled_log(metroi_scaled v)
{
    return v.factor == 0 ? -METROI_INFINITY : log(fabs(v.factor)) + v.log;
}

/* Adds factor e^logarithm to a sum that starts at (0, -infinity). The largest term sets the scale, whenever it comes.
   */

static void metroi_scaled_add(metroi_scaled *sum, double factor, double logarithm)
{
    if (factor == 0 || logarithm == -METROI_INFINITY) return;
    if (logarithm > sum->log) {
        sum->factor *= exp(sum->log - logarithm);
        sum->log = logarithm;
        sum->factor += factor;
    } else {
        sum->factor += factor * exp(logarithm - sum->log);
    }
}

/* A power P^s is as good as ln P, and ln P is as good as the gap 1 - P where P is near 1. Chapter 3 gives both the
   value and the gap of a mode, with arguments reduced without loss (eq 3.2), so ln abs(P) has a relative error of
   some 1e-16 everywhere. Gaussian, Cauchy and von Mises modes we have as logarithms at once.

   A spectrum is a kernel without its large steps on a circle of some length T, the period: its modes are those of the
   line at the frequencies k/T. The von Mises kernel has no line, but from kappa = 1000 on chapter 3 has its modes as
   a smooth function of k, and that is as good. Below, the modes that matter are tabled: exp(-s k^2/(2 kappa)) is
   under 1e-18 at 300 for every s >= 2. */

#define METROI_MODES 300

typedef struct {
    metro_kernel kernel;
    double period;
    size_t known; /* how many of log_value are filled */
    double log_value[METROI_MODES];
} metroi_spectrum;

static void metroi_spectrum_make(const metro_kernel *k, double period, metroi_spectrum *spectrum)
{
    spectrum->kernel = *k;
    spectrum->kernel.large = 0;
    spectrum->period = period;
    spectrum->known = 0;
    if (k->shape == METRO_VON_MISES && k->size < METROI_DEBYE) {
        spectrum->known = METROI_MODES;
        metroi_von_mises_logs(k->size, METROI_MODES, spectrum->log_value);
    }
}

/* ln abs(P(k/T)), and the sign of P. */
static double metroi_spectrum_log(const metroi_spectrum *spectrum, double k, int *sign)
{
    double size = spectrum->kernel.size, f = k / spectrum->period, value, gap;
    *sign = 1;
    switch (spectrum->kernel.shape) {
    case METRO_GAUSSIAN: return -2 * (METROI_PI * size * f) * (METROI_PI * size * f);
    case METRO_CAUCHY: return -2 * METROI_PI * size * f;
    case METRO_VON_MISES:
        if (size >= METROI_DEBYE) return metroi_bessel_log(0, f, size);
        return k <= (double)spectrum->known ? spectrum->log_value[(size_t)k - 1] : -METROI_INFINITY;
    case METRO_UNIFORM:
    case METRO_TRIANGLE:
    case METRO_KELEMEN: break;
    }
    metroi_kernel_mode(&spectrum->kernel, f, &value, &gap);
    if (value < 0) *sign = -1;
    return gap < 0.5 ? log1p(-gap) : log(fabs(value));
}

/* # 5.4 When to stop

   A sum over modes stops where the terms not yet added cannot matter. We bound them, rather than wait for a small
   term: the terms of a uniform kernel have zeros.

   Uniform, h = Delta/T: abs(P(k/T)) <= 1/y with y = pi k h, and P <= exp(-y^2/6) before the first zero, so

       sum_{j>k} abs(P_j)^s <= frac{k}{(s-1) y^s} "for" k h >= 1
       sum_{j>k} abs(P_j)^s <= frac{3 k}{s y^2} e^{-s y^2/6} + pi^{-s} (1 + frac{1}{h (s-1)}) "below"      (5.10)

   Kelemen: abs(P) <= C/f at the frequency f, with C = (1/s1 + 1/s2)/(2 pi L), since abs(Ci(x)) <= 1/x; from the
   frequency C on this falls like the first line. That is late when s is large, and so we also want a bound X(f) on
   all abs(P) from a lower f on. With a = 2 pi f s1 and b = 2 pi f s2, and V the variance of a step,

       X(f) = frac{1}{L} (frac{1}{b} + max(.48, -ln a - .577 + a^2/4)) "or" C/f "where that is less"
       X(f) = max(X(frac{1}{2 s2}), e^{-8 V f^2}) "for" f < frac{1}{2 s2}, V = frac{s2^2 - s1^2}{2 L}      (5.11)

   The first line bounds Ci(b) by 1/b and Ci(a) by its series or, beyond its first zero, by its largest value. The
   second is 1 - cos y >= 2 y^2/pi^2, true to y = pi. Up to the frequency 2 C there are at most 2 C T modes, none
   above X. Nearly equal sizes, w = s2 - s1 < s1, make that bound useless, since their modes come back to almost 1 for
   many k; but abs(P) is at most the modulus of the transform of the positive steps alone, and the same inequality for
   their differences says

       X(f) = max(2 w C, e^{-2 (q f w)^2/3}) "for" f < frac{1}{2 w}, q = frac{w}{L s2}      (5.12)

   If s1 and s2 are whole or half numbers, all sines vanish and with them the first order of Ci, and there is much
   less to come:

       abs(P(k)) <= frac{1}{4 pi^2 L k^2} (frac{1}{s1^2} + frac{1}{s2^2})             (5.13)

   For the other kernels ln P is concave in k: each ratio of neighbours is below the last one, and a geometric series
   bounds the rest,

       sum_{j>k} P_j^s <= P_k^s frac{r}{1 - r}, r = (P_k/P_{k-1})^s                   (5.14) */

static double metroi_kelemen_bound(const metro_kernel *k)
{
    return (1 / k->size_min + 1 / k->size) / (2 * METROI_PI * metroi_kelemen_log(k->size_min, k->size));
}

static double metroi_sinc_tail(double h, double s, double k)
{
    double y = METROI_PI * k * h, near, far;
    if (k * h >= 1) return log(k / (s - 1)) - s * log(y);
    near = log(3 * k / (s * y * y)) - s * y * y / 6;
    far = log1p(1 / (h * (s - 1))) - s * log(METROI_PI);
    return log(2) + (near > far ? near : far); /* eq 5.10 */
}

/* ln X(f) */
static double metroi_kelemen_ceiling(const metro_kernel *k, double f)
{
    double s1 = k->size_min, s2 = k->size, l = metroi_kelemen_log(s1, s2), g = fmax(f, 0.5 / s2), w = s2 - s1;
    double a = 2 * METROI_PI * g * s1, b = 2 * METROI_PI * g * s2, q = w / s2 / l;
    double bell = -4 * (f * s2) * (f * s2 - f * s1 * (s1 / s2)) / l;
    double ceiling = fmin(1 / b + fmax(0.48, -log(a) - 0.577 + 0.25 * a * a), 1 / a + 1 / b) / l;
    if (w < s1 && f * w < 0.5) /* eq 5.12 */
        return fmin(0, fmax(-2 * (q * f * w) * (q * f * w) / 3, log(2 * w * metroi_kelemen_bound(k))));
    return f < g ? fmax(bell, log(ceiling)) : log(ceiling); /* eq 5.11 */
}

static double metroi_kelemen_tail(const metro_kernel *k, double period, double s, double mode)
{
    double edge = 2 * metroi_kelemen_bound(k) * period, far = mode > edge ? mode : edge, near;
    if (period == 1 && fmod(2 * k->size, 1) == 0 && fmod(2 * k->size_min, 1) == 0) {
        near = (1 / (k->size * k->size) + 1 / (k->size_min * k->size_min))
             / (4 * METROI_PI * METROI_PI * metroi_kelemen_log(k->size_min, k->size));
        return s * (log(near) - 2 * log(mode)) + log(mode / (2 * s - 1)); /* eq 5.13 */
    }
    far = s * log(0.5 * edge / far) + log(far / (s - 1));
    if (mode > edge) return far;
    near = log(edge) + s * metroi_kelemen_ceiling(k, mode / period);
    return log(2) + fmax(near, far);
}

/* The logarithm of the bound, where `at` and `before` are ln P_k and ln P_{k-1}. */
static double metroi_spectrum_tail(const metroi_spectrum *spectrum, double s, double k, double at, double before)
{
    const metro_kernel *kernel = &spectrum->kernel;
    double ratio = s * (at - before);
    switch (kernel->shape) {
    case METRO_UNIFORM: return metroi_sinc_tail(kernel->size / spectrum->period, s, k);
    case METRO_TRIANGLE: return metroi_sinc_tail(kernel->size / 2 / spectrum->period, 2 * s, k);
    case METRO_KELEMEN: return metroi_kelemen_tail(kernel, spectrum->period, s, k);
    case METRO_GAUSSIAN:
    case METRO_CAUCHY:
    case METRO_VON_MISES: break;
    }
    if (at == -METROI_INFINITY) return at;
    return s * at + ratio - log(-expm1(ratio)); /* eq 5.14 */
}

/* # 5.5 The sum over modes

   One loop serves them all:

       S = sum_{k=1}^{inf} P(k/T)^s w_k, w_k = cos(2 pi k x/T) "or" abs(A_k)^2        (5.15)

   The weights are those of a point x, or those of a set of seeds (section 5.12). Beside S we keep S', the same sum of
   abs(P)^s with all weights 1, which belongs to a single seed. We stop where the rest is below 1e-14 S. Seeds that
   cancel each other make S so small that this may never come; so from 64 terms on 1e-14 sqrt(S S') is enough, which
   holds the error of E_n below 1e-14 of what one seed has, and 1e-26 S' for seeds that cancel all. Bounds cost more
   than terms; after the first 16 terms we look at every eighth.

   For Kelemen's kernel the terms may fall slowly. After 5000 of them section 5.10 has a better way. Where that does
   not apply, we are content with 1e-9 after 50000, and where ten times as many would not give that, the answer is NaN
   at once.

   [figure: accuracy.svg | What accuracy costs: error against time for the series and the library, the operator, an
   ensemble, and the size of the perturbation.] */

#define METROI_PATIENCE 5000.0
#define METROI_RESIGNATION 500000.0

typedef struct {
    const double *point, *alpha; /* alpha NULL: equal weights */
    size_t count;
} metroi_seeds;

static double metroi_seed_power(const metroi_seeds *seeds, double k);
static double metroi_seed_weight(const metroi_seeds *seeds, size_t i);
static double metroi_circle_distance(double x, double y);

/* What section 5.10 wants to know of a sum over modes: the terms as a function of ln abs(P) and the sign of P, the
   largest power of P in them, and the logarithm of a bound on all terms beyond mode k. `mean` is for the running mean
   of section 5.15. */
typedef struct metroi_far_terms metroi_far_terms;
struct metroi_far_terms {
    metroi_spectrum spectrum;
    double steps;
    const void *mean;
    double (*term)(const metroi_far_terms *terms, double at, int sign);
    double (*rest)(const metroi_far_terms *terms, double k);
};

static int metroi_far_applies(const metro_kernel *k, double s, double period);
static double metroi_far_series(const metroi_far_terms *terms, double x, const metroi_seeds *seeds);

/* The logarithm of the tolerance at term k, relative to the sum. */
static double metroi_series_tolerance(const metroi_spectrum *spectrum, double k)
{
    return log(spectrum->kernel.shape != METRO_KELEMEN || k < 0.1 * METROI_RESIGNATION ? 1e-14 : 1e-9);
}

/* Whether the sum must be given up at term k: `last` bounds the rest at the last term we are willing to add. */
static int metroi_series_fails(const metroi_spectrum *spectrum, double s, double k, double last, double total)
{
    if (spectrum->kernel.shape != METRO_KELEMEN || k < METROI_PATIENCE) return 0;
    if (metroi_far_applies(&spectrum->kernel, s, spectrum->period)) return 1;
    return k > METROI_RESIGNATION || !(last <= log(1e-9) + total);
}

static metroi_scaled metroi_series(const metroi_spectrum *spectrum, double s, int odd, double x,
                                   const metroi_seeds *seeds)
{
    metroi_scaled sum = metroi_scaled_make(0, -METROI_INFINITY), whole = sum;
    double tolerance, at = 0, before, rest, weight, k;
    int sign;
    for (k = 1;; k++) {
        before = at;
        at = metroi_spectrum_log(spectrum, k, &sign);
        weight = seeds != NULL ? metroi_seed_power(seeds, k) : metroi_cos_pi(2 * k, x / spectrum->period);
        metroi_scaled_add(&sum, odd && sign < 0 ? -weight : weight, s * at); /* eq 5.15 */
        metroi_scaled_add(&whole, 1, s * at);
        if (k > 16 && fmod(k, 8) > 0) continue;
        rest = metroi_spectrum_tail(spectrum, s, METROI_RESIGNATION, at, before);
        if (metroi_series_fails(spectrum, s, k, rest, metroi_scaled_log(whole)))
            return metroi_scaled_make(METROI_NAN, 0);
        tolerance = metroi_series_tolerance(spectrum, k);
        rest = metroi_spectrum_tail(spectrum, s, k, at, before);
        if (rest <= tolerance + metroi_scaled_log(sum)) break;
        if (k < 64) continue;
        if (rest <= tolerance + 0.5 * (metroi_scaled_log(sum) + metroi_scaled_log(whole))) break;
        if (rest <= log(1e-26) + metroi_scaled_log(whole)) break;
    }
    return sum;
}

/* # 5.6 A shorter circle

   While the chain is still near its seed, the circle around it is mostly empty, and a shorter one would do. If p_s is
   negligible beyond the distance r, its reach, then on a circle of length T = x + r no copy of p_s reaches x but its
   own, and eq 5.5 on that circle, scaled back to the line, reads

       p_s(x) = frac{1}{T} (1 + 2 sum_{k=1}^{inf} P(k/T)^s cos(2 pi k x/T)), x + r <= T <= 1      (5.16)

   Its terms are spaced by 1/T, so there are fewer by the factor T. With the smallest T that is allowed, some twenty
   terms are enough for every size and every number of steps.

   The reach of s steps of at most c each is s c, and it is c + c sqrt(2 A s) up to a relative e^{-A}, by the bound of
   Hoeffding (1963) on sums of bounded steps: the last step, whose density is bounded, brings the chain from within c
   of x. For uniform steps of width g the variance g^2/12 takes the place of c^2 in that bound, because (sinh y)/y <=
   exp(y^2/6); A = 48 gives

       r = g min(s/2, 1/2 + sqrt{8 s})                                                (5.17)

   Kelemen's density is unbounded by comparison, 1/(2 L s1), and A = 72 pays for that. A Gaussian is left at 9 of its
   standard deviations, sigma sqrt(s). A von Mises density of concentration 1000 or more is nearly one, with sigma =
   1/(2 pi sqrt(kappa)); its tail is heavier by a hundredth of the exponent at most. The Cauchy density has no reach.
   */

static double metroi_reach(const metro_kernel *k, double s)
{
    double c = k->size;
    switch (k->shape) {
    case METRO_UNIFORM: return c * (s < 34 ? s / 2 : 0.5 + sqrt(8 * s)); /* eq 5.17 */
    case METRO_TRIANGLE: return 0.5 * c * (s < 17 ? s : 0.5 + sqrt(16 * s));
    case METRO_GAUSSIAN: return 9 * c * sqrt(s);
    case METRO_VON_MISES: return c < METROI_DEBYE ? METROI_INFINITY : 9 * sqrt(s / c) / (2 * METROI_PI);
    case METRO_KELEMEN: return c * (s < 146 ? s : 1 + 12 * sqrt(s));
    case METRO_CAUCHY: break;
    }
    return METROI_INFINITY;
}

/* The sum of eq 5.15 of a power of P, and where it was given up, that of section 5.10. */

static double metroi_power_term(const metroi_far_terms *terms, double at, int sign)
{
    double value = exp(terms->steps * at);
    return sign < 0 && fmod(terms->steps, 2) > 0 ? -value : value;
}

static double metroi_power_rest(const metroi_far_terms *terms, double k)
{
    return metroi_kelemen_tail(&terms->spectrum.kernel, terms->spectrum.period, terms->steps, k);
}

static double metroi_far_power(const metro_kernel *k, double period, double s, double x, const metroi_seeds *seeds)
{
    metroi_far_terms terms;
    if (k->shape != METRO_KELEMEN || !metroi_far_applies(k, s, period)) return METROI_NAN;
    metroi_spectrum_make(k, period, &terms.spectrum);
    terms.steps = s;
    terms.mean = NULL;
    terms.term = metroi_power_term;
    terms.rest = metroi_power_rest;
    return metroi_far_series(&terms, x, seeds);
}

/* e_s(x) by modes, on the shorter circle where there is one; eq 5.9, 0 <= x <= 1/2. */
static metroi_scaled metroi_excess_series(const metro_kernel *k, double s, int odd, double x)
{
    metroi_spectrum spectrum;
    metroi_scaled sum;
    double reach = metroi_reach(k, s), period = x + reach < 1 ? x + reach : 1;
    if (x >= reach) return metroi_scaled_make(-1, 0);
    metroi_spectrum_make(k, period, &spectrum);
    sum = metroi_series(&spectrum, s, odd, x, NULL);
    if (isnan(sum.factor)) {
        period = 1.25 * (x + reach) < 1 ? 1.25 * (x + reach) : 1;
        sum = metroi_scaled_make(metroi_far_power(k, period, s, x, NULL), 0);
    }
    if (period < 1) return metroi_scaled_make((1 + 2 * metroi_scaled_value(sum)) / period - 1, 0); /* eq 5.16 */
    sum.factor *= 2;
    return sum;
}

/* # 5.7 Uniform perturbations

   The tentative sample is uniform in an interval of width Delta around the current one,

       P(x - y) = 1/Delta "for" abs(x - y) < Delta/2, "else" 0                        (5.18)

   Paper (16) prints abs(x - y) < Delta, and that integrates to 2. Its transform, paper (17), is right, for Delta > 1
   too:

       P*(k) = frac{sin(pi k Delta)}{pi k Delta}                                      (5.19)

   Size and steps. The first mode forgets last; -1/ln P*(1) steps reduce it by the factor e, and for small Delta that
   is

       tau = -frac{1}{ln P*(1)} ~ frac{6}{pi^2 Delta^2}                               (5.20)

   The paper's section 2.3 asks for much more than 1/Delta steps, but a random walk covers distance by the square root
   of its steps: after 10/Delta of them the error is still .27 for Delta = .1, 1.45 for .01 and 2.96 for .001.

   Whole turns. A Delta that is a whole number lands uniformly in one step. Near such a Delta all coefficients are
   small and 1 cancels from the density. Let m be the whole number nearest to Delta, d = Delta - m and g = abs(d) <=
   1/2. Since sin(pi k Delta) = (-1)^{k m} sin(pi k d), the coefficients are those of a narrow kernel U_g, times
   d/Delta, up to signs, and the signs are a shift by m/2:

       e_s(x) = (d/Delta)^s e_s(U_g; x + s m/2)                                       (5.21)

   In particular E_n(Delta) = (g/Delta)^n E_n(U_g), exactly 0 at d = 0, with all its digits beside it. It also means
   that we need only sizes up to 1/2.

   Few steps. The density of a sum of s uniform steps of width 1 is the B-spline B_s of order s, and wrapping it gives

       p_s(U_g; x) = frac{1}{g} sum_{m} B_s((x - m)/g)                                (5.22)

   Its explicit formula is an alternating sum, useless from s = 20 on. The recurrence adds positive numbers only (Cox
   1972; de Boor 1972), centred:

       B_s(y) = frac{(s/2 + y) B_{s-1}(y + 1/2) + (s/2 - y) B_{s-1}(y - 1/2)}{s - 1}
       B_1(y) = 1 "for" abs(y) < 1/2, "and" 1/2 "at the ends"                         (5.23)

   With eq 5.8 the first errors are E_1^2 = (1 - g)/g and E_2^2 = (2 - 3 g)/(3 g). Splines serve for s <= 10, and on
   to 24 as long as the chain has not gone around the circle; then 1 does not cancel from p_s. Beyond, the modes decay
   fast and eq 5.15 or eq 5.16 takes over.

   [figure: fig2.svg | The start-up error against the number of steps for perturbations of different width, with
   estimates from ensembles of chains (figure 2 of the paper).] */

#define METROI_SPLINE_ORDER 24

static double metroi_spline(int order, double y)
{
    double b[METROI_SPLINE_ORDER], t;
    int r, j;
    /* the orders 1 of all arguments that will be needed, y + (order - 1)/2 down to y - (order - 1)/2 */
    for (j = 0; j < order; j++) {
        t = fabs(y + 0.5 * (order - 1) - j);
        b[j] = t < 0.5 ? 1 : t > 0.5 ? 0 : 0.5;
    }
    for (r = 2; r <= order; r++) {
        for (j = 0; j <= order - r; j++) {
            t = y + 0.5 * (order - r) - j;
            b[j] = ((0.5 * r + t) * b[j] + (0.5 * r - t) * b[j + 1]) / (r - 1); /* eq 5.23 */
        }
    }
    return b[0];
}

/* e_s for a width g <= 1/2, at 0 <= x <= 1/2 */
static metroi_scaled metroi_narrow_excess(double g, double s, int odd, double x)
{
    metro_kernel narrow;
    double sum = 0, m;
    if (s <= 10 || (s <= METROI_SPLINE_ORDER && s * g <= 1.5)) {
        for (m = ceil(x - 0.5 * s * g); m <= x + 0.5 * s * g; m++) sum += metroi_spline((int)s, (x - m) / g);
        return metroi_scaled_make((sum - g) / g, 0); /* eq 5.22 */
    }
    narrow.shape = METRO_UNIFORM;
    narrow.size = g;
    narrow.size_min = narrow.large = 0;
    return metroi_excess_series(&narrow, s, odd, x);
}

/* ln(g/Delta) */
static double metroi_turn_log(double size, double g)
{
    return g > size / 2 ? log1p((g - size) / size) : log(g / size);
}

static metroi_scaled metroi_uniform_excess(double size, double s, int odd, double x)
{
    double m = rint(size), d = size - m, g = fabs(d);
    metroi_scaled e;
    if (d == 0) return metroi_scaled_make(0, 0);
    if (m == 0) return metroi_narrow_excess(g, s, odd, x);
    e = metroi_narrow_excess(g, s, odd, odd && fmod(m, 2) > 0 ? 0.5 - x : x); /* eq 5.21 */
    e.log += s * metroi_turn_log(size, g);
    if (odd && d < 0) e.factor = -e.factor;
    return e;
}

/* A triangular step of base Delta is the sum of two uniform steps of width Delta/2, so s triangular steps are 2 s
   uniform ones:

       e_s("triangle", Delta; x) = e_{2s}("uniform", Delta/2; x)                      (5.24)

   # 5.8 Gaussian, Cauchy and von Mises perturbations

   A Gaussian stays Gaussian, with the variance V = s sigma^2. Wide, it is its series; narrow, the sum of its images,
   and the two agree by Poisson's formula:

       e_s(x) = 2 sum_{k=1}^{inf} e^{-2 pi^2 V k^2} cos(2 pi k x)
       e_s(x) = frac{1}{sqrt{2 pi V}} sum_{m=-inf}^{inf} e^{-(x-m)^2/(2V)} - 1        (5.25)

   We change over at 2 pi^2 V = 1, where both need six terms. */

static metroi_scaled metroi_gaussian_excess(double sigma, double s, double x)
{
    double deviation = sigma * sqrt(s), a = 2 * (METROI_PI * deviation) * (METROI_PI * deviation), sum = 0, k;
    if (a > 1) {
        sum = metroi_cos_pi(2, x);
        for (k = 2; k <= 7; k++) sum += exp(-a * (k * k - 1)) * metroi_cos_pi(2 * k, x);
        return metroi_scaled_make(2 * sum, -a); /* eq 5.25 */
    }
    for (k = -3; k <= 3; k++) sum += exp(-0.5 * ((x - k) / deviation) * ((x - k) / deviation));
    return metroi_scaled_make(sum / (sqrt(2 * METROI_PI) * deviation) - 1, 0);
}

/* Cauchy steps add their scales, and with q = exp(-2 pi gamma s) the series is geometric:

       e_s(x) = frac{2 q (cos(2 pi x) - q)}{(1 - q)^2 + 4 q sin^2(pi x)}
       E_n^2 = frac{2}{e^{4 pi gamma n} - 1}                                          (5.26) */

static metroi_scaled metroi_cauchy_excess(double gamma, double s, double x)
{
    double a = 2 * METROI_PI * gamma * s, q = exp(-a), gap = -expm1(-a);
    double sine = sin(METROI_PI * x), t = sine * sine / gap;
    return metroi_scaled_make(2 * (1 - 2 * t) / (gap + 4 * q * t), -a); /* eq 5.26 */
}

/* Von Mises steps on the circle do not stay von Mises; their coefficients I_k(kappa)/I_0(kappa) come from chapter 3,
   and eq 5.15 adds them.

   # 5.9 Kelemen's perturbations

   The density 1/(2 L abs(u)) on s1 <= abs(u) <= s2, L = ln(s2/s1), has jumps that decay like 1/k in the spectrum. At
   few steps we stay with densities. The density R of two steps on the line is elementary,

       R(x) = frac{1}{2 L^2 x} (T + U), R(0) = frac{s2 - s1}{2 L^2 s1 s2}
       T = ln(1 + frac{x - 2 s1}{s1}) "for" 2 s1 < x < s1 + s2
       T = ln(1 + frac{2 s2 - x}{x - s2}) "for" s1 + s2 <= x < 2 s2, "else" 0
       U = ln(1 + frac{x (s2 - s1 - x)}{s1 s2}) "for" x < s2 - s1, "else" 0           (5.27)

   where T belongs to two steps in the same direction and U to opposite ones. Three and four steps are integrals over
   R,

       p_3(z) = int R(y) P(z - y) dy, p_4(z) = int R(y) R(z - y) dy                   (5.28)

   whose integrands are smooth between the kinks at +-(0, 2 s1, s2 - s1, s1 + s2, 2 s2) and those of the other factor.
   They change over lengths of the order of s1 beside a kink and more slowly away from it. So we cut each piece into
   panels of length s1, 2 s1, 4 s1, ... inward from both ends and give each panel the 24-point Gauss rule. Five steps
   and more are left to the series, on the short circle of eq 5.16, and so are three and four steps of a kernel that
   goes around the circle so often that the series is the shorter sum. At two steps each turn is one term more; we
   stop at sizes of 10000, with NaN. */

#define METROI_WIDEST 1e4

static double metroi_kelemen_pair(const metro_kernel *k, double x)
{
    double s1 = k->size_min, s2 = k->size, l = metroi_kelemen_log(s1, s2), sum = 0;
    x = fabs(x);
    if (x == 0) return (s2 - s1) / s1 / (2 * l * l * s2);
    /* x - s2 is at least s1, even where s1 + s2 rounds to s2 */
    if (x > 2 * s1 && x < 2 * s2)
        sum += x < s1 + s2 ? log1p((x - 2 * s1) / s1) : log1p((2 * s2 - x) / fmax(x - s2, s1));
    if (x < s2 - s1) sum += log1p(x / s1 * ((s2 - s1 - x) / s2));
    return sum / (2 * l * l * x); /* eq 5.27 */
}

/* The second factor of eq 5.28, for s = 3 and s = 4. */
static double metroi_kelemen_factor(const metro_kernel *k, double s, double u)
{
    if (s > 3) return metroi_kelemen_pair(k, u);
    u = fabs(u);
    return u < k->size_min || u > k->size ? 0 : 1 / (2 * metroi_kelemen_log(k->size_min, k->size) * u);
}

static double metroi_kelemen_panel(const metro_kernel *k, double s, double z, double from, double to)
{
    double sum = 0, weight, y;
    int i;
    for (i = 0; i < 24; i++) {
        y = from + (to - from) * metroi_gauss24(i, &weight);
        sum += weight * metroi_kelemen_pair(k, y) * metroi_kelemen_factor(k, s, z - y);
    }
    return sum * (to - from);
}

/* One smooth piece: panels that double from both ends to the middle. */
static double metroi_kelemen_piece(const metro_kernel *k, double s, double z, double from, double to)
{
    double middle = 0.5 * (from + to), half = middle - from, length = k->size_min, at = 0, next, sum = 0;
    while (at < half) {
        next = at + length < half ? at + length : half;
        sum += metroi_kelemen_panel(k, s, z, from + at, from + next);
        sum += metroi_kelemen_panel(k, s, z, to - next, to - at);
        at = next;
        length *= 2;
    }
    return sum;
}

static void metroi_kinks_sort(double *kink, int count)
{
    double t;
    int i, j;
    for (i = 1; i < count; i++)
        for (j = i; j > 0 && kink[j - 1] > kink[j]; j--) {
            t = kink[j];
            kink[j] = kink[j - 1];
            kink[j - 1] = t;
        }
}

/* p_3 or p_4 on the line, eq 5.28. */
static double metroi_kelemen_line(const metro_kernel *k, double s, double z)
{
    double s1 = k->size_min, s2 = k->size, kink[20], place[5], sum = 0, low, high;
    int count = 0, i;
    place[0] = 0;
    place[1] = 2 * s1;
    place[2] = s2 - s1;
    place[3] = s1 + s2;
    place[4] = 2 * s2;
    for (i = 0; i < 5; i++) {
        kink[count++] = place[i];
        kink[count++] = -place[i];
        if (s < 4) place[i] = i % 2 ? s1 : s2;
        kink[count++] = z + place[i];
        kink[count++] = z - place[i];
    }
    metroi_kinks_sort(kink, count);
    low = fmax(-2 * s2, z - (s - 2) * s2);
    high = fmin(2 * s2, z + (s - 2) * s2);
    for (i = 1; i < count; i++)
        if (kink[i] > kink[i - 1] && kink[i - 1] >= low && kink[i] <= high)
            sum += metroi_kelemen_piece(k, s, z, kink[i - 1], kink[i]);
    return sum;
}

/* Nearly equal sizes. With w = s2 - s1 small, the steps are two narrow packets, at s1 and at -s1, and what happens
   around their sums happens over lengths of w. Differences of places would lose the digits that w does not share with
   s1. So a place is counted from the packet that it belongs to. R is the sum of three packets,

       R(x) = sum_{a=-1}^{1} R_a(x - 2 a s1)
       R_1(y) = R_{-1}(-y) = frac{T}{2 L^2 (2 s1 + y)}, R_0(y) = frac{U}{2 L^2 abs(y)}
       T = ln(1 + frac{y}{s1}) "for" 0 < y < w, ln(1 + frac{2 w - y}{s1 + y - w}) "for" w <= y < 2 w
       U = ln(1 + frac{abs(y) (w - abs(y))}{s1 s2}) "for" abs(y) < w                  (5.29)

   and a single step of P_1(y) = P_{-1}(-y) = 1/(2 L (s1 + y)), 0 <= y <= w, and then

       p_3(z) = sum_{a,b} int R_a(y) P_b(z - (2 a + b) s1 - y) dy
       p_4(z) = sum_{a,b} int R_a(y) R_b(z - 2 (a + b) s1 - y) dy                     (5.30)

   with whole turns taken off z - 2 a s1 exactly, as in eq 3.2. Between the kinks, which are w apart, each factor is
   so smooth for s2 < 2 s1 that 24 Gauss points do for a piece. */

/* One factor: the packet `a` of two steps, or (`one`) of one. */
static double metroi_packet(const metro_kernel *k, int one, int a, double y)
{
    double s1 = k->size_min, w = k->size - s1, l = metroi_kelemen_log(s1, k->size);
    if (a < 0) y = -y;
    if (one) return y < 0 || y > w ? 0 : 1 / (2 * l * (s1 + y));
    if (a == 0) {
        y = fabs(y);
        if (y == 0) return w / s1 / (2 * l * l * k->size);
        return y >= w ? 0 : log1p(y / s1 * ((w - y) / k->size)) / (2 * l * l * y);
    }
    if (y <= 0 || y >= 2 * w) return 0;
    return log1p(y < w ? y / s1 : (2 * w - y) / (s1 + (y - w))) / (2 * l * l * (2 * s1 + y)); /* eq 5.29 */
}

/* int R_a(y) Q(z - y) dy, Q = R_b or P_b, piece by piece between the kinks of both. */
static double metroi_packets_meet(const metro_kernel *k, int one, int a, int b, double z)
{
    double w = k->size - k->size_min, first = (a - 1) * w, last = z - (one ? 0.5 * (b - 1) : b - 1) * w;
    double kink[6], sum = 0, weight, y, t;
    int count = one ? 5 : 6, i, j;
    for (i = 0; i < count; i++) kink[i] = i < 3 ? first + i * w : last - (i - 3) * w;
    metroi_kinks_sort(kink, count);
    for (i = 1; i < count; i++) {
        t = kink[i] - kink[i - 1];
        for (j = 0; j < 24 && t > 0; j++) {
            y = kink[i - 1] + t * metroi_gauss24(j, &weight);
            sum += weight * t * metroi_packet(k, 0, a, y) * metroi_packet(k, one, b, z - y);
        }
    }
    return sum;
}

/* p_3(x) or p_4(x) on the circle, eq 5.30. */
static double metroi_packets(const metro_kernel *k, int one, double x)
{
    double w = k->size - k->size_min, sum = 0, p, e, low, high, turns, m;
    int a, b;
    for (a = -1; a <= 1; a++)
        for (b = -1; b <= 1; b += one ? 2 : 1) {
            turns = one ? 2 * a + b : 2 * (a + b);
            p = turns * k->size_min;
            e = fma(turns, k->size_min, -p);
            p = x - (p - rint(p)) - e; /* eq 3.2 */
            low = (one ? a - 1 + 0.5 * (b - 1) : a + b - 2) * w;
            high = low + (one ? 3 : 4) * w;
            for (m = ceil(low - p); m <= high - p; m++) sum += metroi_packets_meet(k, one, a, b, p + m);
        }
    return sum;
}

/* Whether the integrals serve three and four steps. Not where many turns, each of some 2 + log2(s2/s1)/5 panels, take
   longer than the series of section 5.10; not where the error is so small that 1 cancels from them; and not where by
   C/f for a mode the series has fewer than 300 terms an integral, (1e14 C^s/(s-1))^{1/(s-1)} of them. */
static int metroi_kelemen_few(const metro_kernel *k, double s)
{
    int near = k->size < 2 * k->size_min;
    double c = metroi_kelemen_bound(k), reach = near ? s * (k->size - k->size_min) : s * k->size;
    double panels = (1 + 2 * reach) * (7 + metroi_kelemen_log(k->size_min, k->size));
    if (!near && (reach > 100 * c || panels > 600)) return 0;
    return log(1e14 / (s - 1)) + s * log(c) > (s - 1) * log(300 * (1 + 2 * reach));
}

static metroi_scaled metroi_kelemen_excess(const metro_kernel *k, double s, int odd, double x)
{
    double reach = s * k->size, m;
    metro_sum sum = { -1, 0 };
    if (s > 4 || (s > 2 && !metroi_kelemen_few(k, s))) return metroi_excess_series(k, s, odd, x);
    if (s == 2 && k->size > METROI_WIDEST) return metroi_scaled_make(METROI_NAN, 0);
    if (s > 2 && k->size < 2 * k->size_min) return metroi_scaled_make(metroi_packets(k, odd, x) - 1, 0);
    for (m = ceil(x - reach); m <= x + reach; m++)
        metro_sum_add(&sum, s > 2 ? metroi_kelemen_line(k, s, x - m) : metroi_kelemen_pair(k, x - m));
    return metroi_scaled_make(metro_sum_value(&sum), 0);
}

/* # 5.10 Kelemen's far modes

   Two kinds of Kelemen kernels have too many modes to add: those with s1 far below s2, and those with s1 and s2 close
   to each other. Both spectra are simple far out. They are a slow part and one oscillation,

       P(f) = g(f) + Re(z(f) e^{-2 pi i f c})                                         (5.31)

   where g and z change little while f changes by 1/c. With a = 2 pi f s1 and b = 2 pi f s2, for s2 far above s1 eq
   3.8 gives this with c = s2, and for nearly equal sizes (s2 < 2 s1) steps counted from s1 give it with c = s1:

       g(f) = -frac{Ci(a)}{L}, z(f) = -frac{h(b)}{L}                                  (5.32)
       g(f) = 0, z(f) = frac{h(a) - e^{-i (b-a)} h(b)}{L} = int_{0}^{1} e^{-i a (e^{L u} - 1)} du      (5.33)

   By eq 5.31 a function F of P is, at each f, a periodic function of the phase 2 pi f c and has a Fourier series in
   it. The mean over N equally spaced phases gives the coefficients, if N is more than twice the largest j that
   matters:

       F(P(f)) = sum_{j} C_j cos(j (2 pi f c - "arg" z))
       C_j = frac{1}{N} sum_{n=0}^{N-1} F(g + abs(z) cos(2 pi n/N)) cos(2 pi j n/N)      (5.34)

   The C_j of P^s for g = 0 need no such mean. They are a binomial distribution, which fades like e^{-j^2/(2s)}:

       C_j = frac{s!}{((s+j)/2)! ((s-j)/2)!} 2^{-s} abs(z)^s "where" s + j "is even, else" 0      (5.35)

   A sum over modes is then an integral over f, for all j that keep in step with the modes. Let chi fall smoothly from
   1 to 0 around the mode K, f_0 = K/T. The modes weighted by chi we add. For the others Poisson's formula gives

       sum_{k=1}^{inf} (1 - chi) F(P(k/T)) cos(2 pi k x/T)
         = T sum_{j,m} int (1 - chi) C_j cos(2 pi f d - j "arg" z) df
       d = j c - x - m T, chi(f) = frac{1}{2} "erfc"(6 (f/f_0 - 1))                   (5.36)

   and a window that is so smooth leaves nothing of an oscillation that turns 16 times or more from 0 to f_0: e^{-(16
   pi/6)^2} of it. The powers of g and z oscillate too, by c' = s1 or c' = s2 - s1 a step; that is a spread s c'
   around each d, for many steps the reach of section 5.6 with c' for c. A pair (j, m) whose d exceeds the spread by
   more than 16/f_0 has vanished. Few remain, always (0, 0) if x = 0: they are the packets of p_s that lie around x.
   If d exceeds the spread by less, the integral of the pair ends by a second window where that little has turned 32
   times; higher powers are gone at high f, and with them their spread. Otherwise it ends where eq 5.11 says that what
   follows is below 1e-13 of the whole, or 1e-10 at three steps, where the terms fall slowly. The panels grow with f,
   but not beyond 6/(s c') and three turns of d, and each has 24 Gauss points.

   With K = 2000 sum and integral cost some milliseconds for sizes of any ratio. They take the place of the plain
   series where that is longer than 5000 terms. The spread must stay below .4 T, so that each j has one m at most;
   where it does not, C is small and the plain series short. K grows like s^{1/4} for nearly equal sizes, because ever
   more j remain; at 1e12 steps we give up. N is at most 1536, which is enough for 8000 powers of P in the running
   mean of nearly equal sizes, the one case that has more than 14 orders and no eq 5.35. */

#define METROI_FAR_SAMPLES 1536
#define METROI_FAR_BATCH 128
#define METROI_FAR_MODES 2000.0

static int metroi_far_near(const metro_kernel *k)
{
    return k->size < 2 * k->size_min;
}

/* c' of the text, what g and z oscillate with. */
static double metroi_far_residue(const metro_kernel *k)
{
    return metroi_far_near(k) ? k->size - k->size_min : k->size_min;
}

/* How far g and z spread a packet: the reach of s steps of c', as in section 5.6. */
static double metroi_far_spread(const metro_kernel *k, double s)
{
    return fmin(s, 1 + 12 * sqrt(s)) * metroi_far_residue(k);
}

/* The largest j that matters in a polynomial of degree s. Beside g the oscillation is small: 14 orders are plenty. */
static double metroi_far_band(const metro_kernel *k, double s)
{
    if (!metroi_far_near(k)) return fmin(s, 14);
    return fmin(s, floor(8.3 * sqrt(s) + 8));
}

static int metroi_far_applies(const metro_kernel *k, double s, double period)
{
    double least = metroi_far_near(k) ? 5 : 3;
    return s >= least && s <= 1e12 && metroi_far_spread(k, s) < 0.4 * period;
}

/* Whether N is enough for the mean of eq 5.34. */
static int metroi_far_fits(const metro_kernel *k, double s)
{
    return 2 * metroi_far_band(k, s) + 2 <= METROI_FAR_SAMPLES;
}

/* binom(s, floor(s/2))/2^s, from 100 on by Stirling's series for n = ceil(s/2). */
static double metroi_central_binomial(double s)
{
    double n = ceil(0.5 * s), value = 1, i;
    if (n >= 50) return exp((-0.125 + (1 / 192.0 - 1 / (640 * n * n)) / (n * n)) / n) / sqrt(METROI_PI * n);
    for (i = 1; i <= n; i++) value *= (2 * i - 1) / (2 * i);
    return value;
}

/* eq 5.32 and eq 5.33 */
static void metroi_far_mode(const metro_kernel *k, double f, double *slow, double *re, double *im)
{
    double l = metroi_kelemen_log(k->size_min, k->size), a = 2 * METROI_PI * f * k->size_min, width, node, weight;
    int i;
    *slow = *re = *im = 0;
    if (!metroi_far_near(k)) {
        *slow = -metroi_cosine_integral(f, k->size_min) / l;
        metroi_exponential_integral(2 * METROI_PI * f * k->size, re, im);
        *re /= -l;
        *im /= -l;
        return;
    }
    width = 2 * METROI_PI * f * (k->size - k->size_min);
    if (width < 8) {
        for (i = 0; i < 24; i++) {
            node = metroi_gauss24(i, &weight);
            node = a * expm1(l * node);
            *re += weight * cos(node);
            *im -= weight * sin(node);
        }
    } else {
        double hr, hi;
        metroi_exponential_integral(a, re, im);
        metroi_exponential_integral(a + width, &hr, &hi);
        *re = (*re - cos(width) * hr - sin(width) * hi) / l;
        *im = (*im - cos(width) * hi + sin(width) * hr) / l;
    }
}

/* The pairs (j, m) that are integrated together, and F at the N phases of one f. */
typedef struct {
    const metroi_far_terms *terms;
    int binomial; /* eq 5.35 has the C_j; `weight` holds its first two factors */
    double edge;  /* f_0 */
    double whole; /* the sum of abs(F) over the modes, as far as it is known */
    double power; /* the largest power of P that matters at f */
    double j[METROI_FAR_BATCH], d[METROI_FAR_BATCH], end[METROI_FAR_BATCH], weight[METROI_FAR_BATCH];
    size_t count, samples;
    double value[2][METROI_FAR_SAMPLES / 2 + 1]; /* for even and odd j */
    double cosine[METROI_FAR_SAMPLES];
} metroi_far;

/* The phases psi and pi - psi have the same cosines for even j and opposite ones for odd j: adds them up. */
static void metroi_far_fold(metroi_far *far)
{
    size_t n, half = far->samples / 2;
    double left, right;
    for (n = 0; 2 * n <= half; n++) {
        left = far->value[0][n];
        right = 2 * n < half ? far->value[0][half - n] : 0;
        far->value[0][n] = left + right;
        far->value[1][n] = left - right;
    }
}

/* F at the phases 2 pi n/N, n = 0 .. N/2, each with its share of the mean; or, where eq 5.35 holds, abs(z)^s.
   Returns the mean of abs(F), or what is near enough. */
static double metroi_far_sample(metroi_far *far, double slow, double size)
{
    const metroi_far_terms *terms = far->terms;
    double s = terms->steps, sum = 0, p, share;
    size_t n, stride;
    if (far->binomial) {
        far->value[0][0] = exp(s * log(size));
        return far->value[0][0] * metroi_central_binomial(s);
    }
    s = metroi_far_band(&terms->spectrum.kernel, fmin(s, far->power));
    for (far->samples = 12; (double)far->samples < 2 * s + 2;) far->samples *= 2;
    stride = METROI_FAR_SAMPLES / far->samples;
    for (n = 0; 2 * n <= far->samples; n++) {
        p = slow + size * far->cosine[n * stride];
        share = (n == 0 || 2 * n == far->samples ? 1 : 2) / (double)far->samples;
        far->value[0][n] = share * terms->term(terms, log(fabs(p)), p < 0 ? -1 : 1);
        sum += fabs(far->value[0][n]);
    }
    metroi_far_fold(far);
    return sum;
}

/* C_j from the samples; 0 for the j beyond them. */
static double metroi_far_coefficient(const metroi_far *far, double j)
{
    const double *value = far->value[fmod(j, 2) != 0];
    double sum = 0;
    size_t n, at = 0, turn;
    if (far->binomial) return far->value[0][0];
    if (2 * fabs(j) >= (double)far->samples) return 0;
    turn = (size_t)(j < 0 ? -j : j) * (METROI_FAR_SAMPLES / far->samples);
    for (n = 0; 4 * n <= far->samples; n++) {
        sum += value[n] * far->cosine[at];
        at += turn;
        if (at >= METROI_FAR_SAMPLES) at -= METROI_FAR_SAMPLES;
    }
    return sum; /* eq 5.34 */
}

/* The integrand of eq 5.36 at f, times `width`, which is the weight of this point. */
static double metroi_far_point(metroi_far *far, double f, double width)
{
    double slow, re, im, turn, sum = 0;
    size_t i;
    metroi_far_mode(&far->terms->spectrum.kernel, f, &slow, &re, &im);
    turn = atan2(im, re);
    width *= 0.5 * erfc(6 - 6 * f / far->edge);
    far->whole += width * metroi_far_sample(far, slow, hypot(re, im));
    for (i = 0; i < far->count; i++) {
        if (f > 1.5 * far->end[i]) continue;
        sum += far->weight[i] * metroi_far_coefficient(far, far->j[i])
             * cos(2 * METROI_PI * f * far->d[i] - far->j[i] * turn) * 0.5 * erfc(12 * (f / far->end[i] - 1));
    }
    return width * sum;
}

/* Beyond f, with abs(P) <= C/f, higher powers than this are together below 1e-15 of the whole. */
static double metroi_far_largest(const metroi_far *far, double f)
{
    double s = far->terms->steps, ratio = metroi_kelemen_bound(&far->terms->spectrum.kernel) / f;
    if (far->binomial || ratio >= 1) return s;
    return fmin(s, ceil((log(1e-15 * far->whole) - log(f * far->terms->spectrum.period)) / log(ratio)));
}

/* Where the integral of a pair may end: where all powers that still matter leave abs(d) f with 32 turns or more. */
static double metroi_far_end(const metroi_far *far, double d)
{
    const metro_kernel *k = &far->terms->spectrum.kernel;
    double f = far->edge, last = 1e6 * (f + 1 / metroi_far_residue(k));
    for (; f < last; f *= 1.25)
        if ((fabs(d) - metroi_far_spread(k, metroi_far_largest(far, 0.5 * f))) * f >= 32) return f;
    return METROI_INFINITY;
}

/* The largest abs(d) whose integral goes on at f; -1: none does. */
static double metroi_far_fastest(const metroi_far *far, double f)
{
    double fastest = -1;
    size_t i;
    for (i = 0; i < far->count; i++)
        if (f <= 1.5 * far->end[i]) fastest = fmax(fastest, fabs(far->d[i]));
    return fastest;
}

static double metroi_far_integrate(metroi_far *far)
{
    const metroi_far_terms *terms = far->terms;
    double period = terms->spectrum.period, f = far->edge / 12, sum = 0, whole = far->whole;
    double step, fastest, rest, node, weight, tolerance = terms->steps < 4 ? 1e-10 : 1e-13;
    double residue = metroi_far_residue(&terms->spectrum.kernel);
    int i;
    for (;;) {
        fastest = metroi_far_fastest(far, f);
        if (fastest < 0) break;
        rest = terms->rest(terms, f * period) - log(tolerance * far->whole);
        if (f > 2 * far->edge && rest <= 0) break;
        far->power = metroi_far_largest(far, f);
        step = fmin(f / 2, 6 / (fmin(far->power, 34) * residue));
        if (step * fastest > 3) step = 3 / fastest;
        for (i = 0; i < 24; i++) {
            node = metroi_gauss24(i, &weight);
            sum += metroi_far_point(far, f + step * node, weight * step * period);
        }
        f += step;
    }
    far->whole = whole;
    far->count = 0;
    return sum;
}

/* d of eq 5.36, with whole turns taken off exactly where the circle is whole. */
static double metroi_far_distance(const metro_kernel *k, double period, double j, double x)
{
    double c = metroi_far_near(k) ? k->size_min : k->size, p = j * c, e = fma(j, c, -p);
    if (period < 1) return p - x + e;
    p = p - rint(p) - x + e;
    return p - rint(p);
}

/* Takes the pair (j, m) in, if it keeps in step with the modes. Returns what had to be integrated to make room. */
static double metroi_far_take(metroi_far *far, double j, double x, double weight)
{
    const metroi_spectrum *spectrum = &far->terms->spectrum;
    double d = metroi_far_distance(&spectrum->kernel, spectrum->period, j, x);
    double lag = fabs(d) - metroi_far_spread(&spectrum->kernel, metroi_far_largest(far, 0.5 * far->edge));
    if (lag * far->edge > 16) return 0;
    far->j[far->count] = j;
    far->d[far->count] = d;
    far->end[far->count] = d == 0 ? METROI_INFINITY : metroi_far_end(far, d);
    far->weight[far->count++] = weight;
    return far->count == METROI_FAR_BATCH ? metroi_far_integrate(far) : 0;
}

/* The right side of eq 5.36; if x = 0, j and -j give the same. */
static double metroi_far_sum(metroi_far *far, double x)
{
    double s = far->terms->steps, band = metroi_far_band(&far->terms->spectrum.kernel, s), sum = 0, j = 0, share = 1;
    if (far->binomial) {
        share = metroi_central_binomial(s);
        j = fmod(s, 2);
    }
    while (j <= band) {
        sum += metroi_far_take(far, j, x, x == 0 && j > 0 ? 2 * share : share);
        if (j > 0 && x != 0) sum += metroi_far_take(far, -j, x, share);
        if (far->binomial) share *= (s - j) / (s + j + 2);
        j += far->binomial ? 2 : 1;
    }
    return sum + metroi_far_integrate(far);
}

/* The weights are those of eq 5.15; of seeds, abs(A_k)^2 is the sum of alpha_i alpha_l cos(2 pi k (x_i - x_l)). */
static double metroi_far_seeds(metroi_far *far, const metroi_seeds *seeds)
{
    double sum = 0, same = 0, alpha;
    size_t i, l;
    for (i = 0; i < seeds->count; i++) {
        alpha = metroi_seed_weight(seeds, i);
        same += alpha * alpha;
        for (l = 0; l < i; l++)
            sum += 2 * alpha * metroi_seed_weight(seeds, l)
                 * metroi_far_sum(far, metroi_circle_distance(seeds->point[i], seeds->point[l]));
    }
    return sum + same * metroi_far_sum(far, 0);
}

/* The left side of eq 5.36 with chi for 1 - chi: the modes that are added. */
static double metroi_far_added(metroi_far *far, double last, double x, const metroi_seeds *seeds)
{
    const metroi_far_terms *terms = far->terms;
    const metroi_spectrum *spectrum = &terms->spectrum;
    metro_sum sum = { 0, 0 };
    double weight, at, term, k;
    int sign;
    for (k = 1; k <= 2 * last; k++) {
        weight = seeds != NULL ? metroi_seed_power(seeds, k) : metroi_cos_pi(2 * k, x / spectrum->period);
        at = metroi_spectrum_log(spectrum, k, &sign);
        term = 0.5 * erfc(6 * (k / last - 1)) * terms->term(terms, at, sign);
        metro_sum_add(&sum, weight * term);
        far->whole += fabs(term);
    }
    return metro_sum_value(&sum);
}

/* The whole sum over k >= 1, for a point x or for seeds. */
static double metroi_far_series(const metroi_far_terms *terms, double x, const metroi_seeds *seeds)
{
    const metroi_spectrum *spectrum = &terms->spectrum;
    const metro_kernel *k = &spectrum->kernel;
    double last = metroi_far_near(k) ? 60 * sqrt(sqrt(terms->steps)) : 16 * spectrum->period / k->size, sum;
    metroi_far far;
    size_t i;
    last = fmax(last, METROI_FAR_MODES);
    far.terms = terms;
    far.binomial = metroi_far_near(k) && terms->mean == NULL;
    far.edge = last / spectrum->period;
    far.whole = 0;
    far.count = 0;
    for (i = 0; i < METROI_FAR_SAMPLES; i++) far.cosine[i] = cos(2 * METROI_PI * ((double)i / METROI_FAR_SAMPLES));
    sum = metroi_far_added(&far, last, x, seeds);
    return sum + (seeds != NULL ? metroi_far_seeds(&far, seeds) : metroi_far_sum(&far, x));
}

/* # 5.11 Large steps

   A kernel that is replaced, with probability p, by an independent uniform draw keeps its modes, times 1 - p (eq
   3.1). So

       e_s(x) = (1 - p)^s e_s(K; x), E_n = (1 - p)^n E_n(K)                           (5.37)

   where K is the kernel alone: large steps forget at a rate that does not depend on the size. With that, the excess
   of every kernel: s >= 2 steps, `odd` says whether s is odd, 0 <= x <= 1/2. */

static metroi_scaled metroi_excess(const metro_kernel *k, double s, int odd, double x)
{
    metroi_scaled e = metroi_scaled_make(0, 0);
    switch (k->shape) {
    case METRO_UNIFORM: e = metroi_uniform_excess(k->size, s, odd, x); break;
    case METRO_TRIANGLE: e = metroi_uniform_excess(0.5 * k->size, 2 * s, 0, x); break; /* eq 5.24 */
    case METRO_GAUSSIAN: e = metroi_gaussian_excess(k->size, s, x); break;
    case METRO_CAUCHY: e = metroi_cauchy_excess(k->size, s, x); break;
    case METRO_VON_MISES: e = metroi_excess_series(k, s, odd, x); break;
    case METRO_KELEMEN: e = metroi_kelemen_excess(k, s, odd, x); break;
    }
    if (k->large > 0) e.log += s * log1p(-k->large); /* eq 5.37 */
    return e;
}

/* The cases that need no theory, in the order in which they are decided: NaN for what is no kernel, an infinite error
   at n = 0, none where one step is uniform, and an infinite one for Kelemen's kernel of a single length, whose steps
   lead from point to point. Sizes under 1e-100 are refused too: squares of their errors would leave the range of
   doubles. Returns whether `square` has been set. */

static int metroi_startup_settled(const metro_kernel *k, double n, metroi_scaled *square)
{
    double value, smallest = k->shape == METRO_KELEMEN ? k->size_min : k->size;
    if (!metroi_kernel_valid(k) || (smallest > 0 && smallest < 1e-100)) value = METROI_NAN;
    else if (n == 0) value = METROI_INFINITY;
    else if (k->large == 1 || (k->shape == METRO_VON_MISES && k->size == 0)) value = 0;
    else if (k->shape == METRO_KELEMEN && k->size_min == k->size) value = METROI_INFINITY;
    else return 0;
    *square = metroi_scaled_make(value, 0);
    return 1;
}

/* E_n^2 */
static metroi_scaled metroi_startup_square(const metro_kernel *k, uint64_t n)
{
    metroi_scaled square;
    if (metroi_startup_settled(k, (double)n, &square)) return square;
    return metroi_excess(k, 2 * (double)n, 0, 0); /* eq 5.8 */
}

METRO_API double metro_startup_error(const metro_kernel *k, uint64_t n)
{
    return metroi_scaled_root(metroi_startup_square(k, n));
}

METRO_API double metro_startup_log_error(const metro_kernel *k, uint64_t n)
{
    return metroi_scaled_root_log(metroi_startup_square(k, n));
}

/* # 5.12 Many seeds

   One way to reduce the start-up error is to start at one of several seeds x_i, chosen with the probability alpha_i,
   paper (13):

       p_0(x) = sum_{i=1}^{N} alpha_i delta(x - x_i), sum_{i=1}^{N} alpha_i = 1       (5.38)

   The coefficients of p_0 are

       A_k = sum_{i=1}^{N} alpha_i e^{-2 pi i k x_i}                                  (5.39)

   and after n steps, paper (14) on the unit period,

       p_n(x) = sum_{k=-inf}^{inf} P*(k)^n A_k e^{2 pi i k x} = sum_{i=1}^{N} alpha_i (1 + e_n(x - x_i))      (5.40)

   Parseval's theorem gives the error:

       E_n^2 = 2 sum_{k=1}^{inf} abs(P*(k))^{2n} abs(A_k)^2                           (5.41)

   Paper (15) prints the seed sum inside the power, abs(P*(k) A_k)^{2n}. But the seeds act once, at the start, and the
   kernel n times. With the weights .2, .3, .5 at 0, .25 and .6, Delta = .3 and n = 3 the true error is .202907, and
   so says eq 5.41; the printed form says .022252. (The x that it leaves inside is harmless, since the modulus removes
   it.)

   N seeds at equal distances with equal weights leave only the multiples of N: all other A_k vanish. No other set of
   N points does better. But unless the seeds cancel the slow modes exactly, what is left of the first mode fades by
   P*(1) a step as before: seeds start the chain better, they do not make it forget faster. To see such zeros the sums
   over seeds must reduce k x_i exactly (eq 3.2): 1e-16 that is left of A_1 survives where P*(N)^n does not.

   [figure: seeds.svg | The corrected formula for several seeds, the printed one, and what chains do.] */

static double metroi_seed_weight(const metroi_seeds *seeds, size_t i)
{
    return seeds->alpha != NULL ? seeds->alpha[i] : 1 / (double)seeds->count;
}

/* abs(A_k)^2. The sums are compensated: where seeds cancel in pairs, nothing is left. */
static double metroi_seed_power(const metroi_seeds *seeds, double k)
{
    metro_sum real = { 0, 0 }, imaginary = { 0, 0 };
    double turns, sine, cosine, alpha, re, im;
    int quadrant;
    size_t i;
    for (i = 0; i < seeds->count; i++) {
        turns = METROI_PI * metroi_turns(2 * k, seeds->point[i], &quadrant);
        sine = sin(turns);
        cosine = cos(turns);
        alpha = metroi_seed_weight(seeds, i);
        /* a quarter turn exchanges sine and cosine */
        if (quadrant & 2) alpha = -alpha;
        metro_sum_add(&real, quadrant & 1 ? -alpha * sine : alpha * cosine);
        metro_sum_add(&imaginary, quadrant & 1 ? alpha * cosine : alpha * sine);
    }
    re = metro_sum_value(&real);
    im = metro_sum_value(&imaginary);
    return re * re + im * im; /* eq 5.39 */
}

/* Seeds as a user gives them: some, all finite, with weights that are not negative and sum to 1. */
static int metroi_seeds_valid(const metroi_seeds *seeds)
{
    size_t i;
    if (seeds->point == NULL || !metroi_weights_valid(seeds->alpha, seeds->count)) return 0;
    for (i = 0; i < seeds->count; i++)
        if (!isfinite(seeds->point[i])) return 0;
    return 1;
}

/* The distance of two points on the circle, 0 .. 1/2. */
static double metroi_circle_distance(double x, double y)
{
    double d = fabs(metroi_wrap(x) - metroi_wrap(y));
    return d > 0.5 ? 1 - d : d;
}

/* For an even number of steps every case comes down to simpler ones, times a constant: triangular steps to uniform
   ones (eq 5.24), a size to its distance from a whole number (eq 5.21, where the shift is by whole turns), large
   steps to none (eq 5.37). Returns the logarithm of the constant; the size becomes 0 where nothing is left. */

static double metroi_seeds_reduce(metro_kernel *kernel, double *s)
{
    double factor = kernel->large > 0 ? *s * log1p(-kernel->large) : 0, size;
    kernel->large = 0;
    if (kernel->shape == METRO_TRIANGLE) {
        kernel->shape = METRO_UNIFORM;
        kernel->size *= 0.5;
        *s *= 2;
    }
    if (kernel->shape == METRO_UNIFORM && kernel->size > 0.5) {
        size = kernel->size;
        kernel->size = fabs(size - rint(size));
        factor += *s * metroi_turn_log(size, kernel->size);
    }
    return factor;
}

/* At few steps the modes decay slowly, and the error is better had by eq 5.8, two seeds at a time,

       E_n^2 = sum_{i,j} alpha_i alpha_j e_{2n}(x_i - x_j)                            (5.42)

   This costs N^2 evaluations, and where seeds cancel modes it is a small difference of large terms. So it serves
   where e_s is elementary, s <= 4, for uniform and Kelemen's steps, and for seeds so far apart that hardly any two
   feel each other, which is where a series has millions of terms: if the reaches of n steps from all seeds together
   cover at most half of the circle, the error of K is at least 1, and nothing cancels. For the Cauchy kernel we take
   5 gamma s as the reach here, since its far tail is small against 1 then. */

static int metroi_seeds_apart(const metro_kernel *k, double s, size_t count)
{
    double reach = k->shape == METRO_CAUCHY ? 5 * k->size * s : metroi_reach(k, s);
    if (k->shape == METRO_UNIFORM || k->shape == METRO_KELEMEN) {
        if (s <= 4) return 1;
    }
    return reach < 0.01 && 4 * reach * (double)count <= 1;
}

static metroi_scaled metroi_seeds_pairs(const metro_kernel *k, double s, const metroi_seeds *seeds)
{
    metroi_scaled sum = metroi_scaled_make(0, -METROI_INFINITY), e = metroi_excess(k, s, 0, 0);
    size_t i, j;
    for (i = 0; i < seeds->count; i++) {
        double alpha = metroi_seed_weight(seeds, i);
        metroi_scaled_add(&sum, alpha * alpha * e.factor, e.log);
    }
    for (i = 1; i < seeds->count; i++)
        for (j = 0; j < i; j++) {
            double alpha = metroi_seed_weight(seeds, i) * metroi_seed_weight(seeds, j);
            e = metroi_excess(k, s, 0, metroi_circle_distance(seeds->point[i], seeds->point[j]));
            metroi_scaled_add(&sum, 2 * alpha * e.factor, e.log); /* eq 5.42 */
        }
    return sum;
}

/* Up to eight seeds are tried in pairs first, wherever they are: 36 densities, good to some 1e-14 of the largest. The
   sum is kept if it is at least a twentieth of the largest; otherwise seeds cancel modes, and the series must say
   what is left. Kelemen's density is itself a series beyond s = 4. Returns whether the sum was kept. */
static int metroi_seeds_few(const metro_kernel *k, double s, const metroi_seeds *seeds, metroi_scaled *square)
{
    metroi_scaled sum;
    if (seeds->count > 8 || k->shape == METRO_KELEMEN) return 0;
    sum = metroi_seeds_pairs(k, s, seeds);
    if (!(metroi_scaled_value(sum) >= 0.05 * (1 + metroi_scaled_value(metroi_excess(k, s, 0, 0))))) return 0;
    *square = sum;
    return 1;
}

static metroi_scaled metroi_seeds_square(const metro_kernel *k, uint64_t n, const metroi_seeds *seeds)
{
    metro_kernel kernel = *k;
    metroi_spectrum spectrum;
    metroi_scaled square;
    double s = 2 * (double)n, factor;
    if (!metroi_seeds_valid(seeds)) return metroi_scaled_make(METROI_NAN, 0);
    if (metroi_startup_settled(k, (double)n, &square)) return square;
    factor = metroi_seeds_reduce(&kernel, &s);
    if (kernel.size == 0) return metroi_scaled_make(0, 0);
    if (seeds->count == 1 || metroi_seeds_apart(&kernel, s, seeds->count)) {
        square = metroi_seeds_pairs(&kernel, s, seeds);
    } else if (!metroi_seeds_few(&kernel, s, seeds, &square)) {
        metroi_spectrum_make(&kernel, 1, &spectrum);
        square = metroi_series(&spectrum, s, 0, 0, seeds);
        if (isnan(square.factor)) square = metroi_scaled_make(metroi_far_power(&kernel, 1, s, 0, seeds), 0);
        square.factor *= 2; /* eq 5.41 */
    }
    square.log += factor;
    return square;
}

static metroi_seeds metroi_seeds_make(const double *point, const double *alpha, size_t count)
{
    metroi_seeds seeds;
    seeds.point = point;
    seeds.alpha = alpha;
    seeds.count = count;
    return seeds;
}

METRO_API double metro_startup_error_seeds(const metro_kernel *k, uint64_t n, const double *seed, const double *alpha,
                                           size_t seeds)
{
    metroi_seeds set = metroi_seeds_make(seed, alpha, seeds);
    return metroi_scaled_root(metroi_seeds_square(k, n, &set));
}

METRO_API double metro_startup_log_error_seeds(const metro_kernel *k, uint64_t n, const double *seed,
                                               const double *alpha, size_t seeds)
{
    metroi_seeds set = metroi_seeds_make(seed, alpha, seeds);
    return metroi_scaled_root_log(metroi_seeds_square(k, n, &set));
}

/* # 5.13 The interval

   Between reflecting ends the natural functions are cosines, 1 and sqrt(2) cos(pi k x), and they are multiplied at
   each step by mu_k, the transform of the kernel at the frequency k/2. So

       E_n^2(x_0) = 2 sum_{k=1}^{inf} mu_k^{2n} cos^2(pi k x_0)                       (5.43)

   By eq 5.43 the ends are the worst seeds. Unfolded, the interval is a circle of length 2 with the seeds x_0 and
   -x_0; scaled back to length 1, and turned, these are two seeds of weight 1/2 at the distance x_0 under the kernel
   at half its size:

       E_n(x_0) = E_n("circle, half the size, seeds" 0 "and" x_0 "of weight" 1/2)     (5.44)

   because abs(A_k)^2 = cos^2(pi k x_0). From the middle, x_0 = 1/2, the odd modes vanish and the even ones are those
   of the circle of length 1 with the kernel as it is.

   Sizes near 1 have small even modes and seeds near the middle small odd ones. So little is then left of the sum of
   two densities that it has lost its digits, and at six and eight uniform steps the series is long. But the even
   modes of a width g are all modes of the width 2 g, and eq 5.20 has those to the last digit however small they are.
   With y = abs(1/2 - x_0),

       E_n^2 = frac{1}{2} (e_s(U_{2g}; 0) + e_s(U_{2g}; 2 y)) + frac{1}{2} (q_s(0) - q_s(y)), s = 2n
       q_s(x) = frac{1}{2} (e_s(U_g; x) - e_s(U_g; x + 1/2))                          (5.45)

   where q_s are the odd modes. The difference of q_s at two close places comes from its second derivative,

       q_s(0) - q_s(y) = int_{0}^{y} (y - t) r(t) dt
       r(t) = -q_s''(t) = frac{2}{g^2} (q_{s-2}(t) - frac{q_{s-2}(t + g) + q_{s-2}(t - g)}{2})      (5.46)

   since (2 pi k)^2 P^s = 4 sin^2(pi k g) P^{s-2}/g^2; near 0 nothing cancels from r. Between the knots m/2 + i g of
   the splines r is a polynomial of degree s - 3, and the Gauss rule with five points is exact for s <= 8. */

/* q_s(x) for an even s <= 8 */
static double metroi_odd_modes(double g, double s, double x)
{
    double a = metroi_circle_distance(x, 0), b = metroi_circle_distance(x, 0.5);
    return 0.5 * (metroi_narrow_excess(g, s, 0, a).factor - metroi_narrow_excess(g, s, 0, b).factor);
}

/* int (y - t) r(t) dt between two neighbouring knots */
static double metroi_odd_piece(double g, double s, double y, double from, double to)
{
    static const double node[3] = { 0, 0.26923465505284154552, 0.45308992296933199640 };
    static const double weight[3] = { 0.28444444444444444444, 0.23931433524968323402, 0.11846344252809454376 };
    double sum = 0, t, r;
    int i;
    for (i = -2; i <= 2; i++) {
        t = from + (to - from) * (0.5 + (i < 0 ? -node[-i] : node[i]));
        r = metroi_odd_modes(g, s - 2, t)
          - 0.5 * (metroi_odd_modes(g, s - 2, t + g) + metroi_odd_modes(g, s - 2, t - g));
        sum += weight[i < 0 ? -i : i] * (y - t) * r;
    }
    return (to - from) * sum * 2 / (g * g); /* eq 5.46 */
}

/* q_s(0) - q_s(y), 0 <= y <= 1/2: by the pieces from knot to next knot while y is small. */
static double metroi_odd_difference(double g, double s, double y)
{
    double from = 0, to, knot, sum = 0;
    int i, m, most = (int)s;
    if (y > 0.05) return metroi_odd_modes(g, s, 0) - metroi_odd_modes(g, s, y);
    while (from < y) {
        to = y;
        for (m = -most; m <= most; m++)
            for (i = -most / 2; i <= most / 2; i++) {
                knot = 0.5 * m + i * g;
                if (knot > from && knot < to) to = knot;
            }
        sum += metroi_odd_piece(g, s, y, from, to);
        from = to;
    }
    return sum;
}

/* E_n^2 for s = 6 or 8 steps of width g <= 1/2. */
static metroi_scaled metroi_reflect_few(double g, double s, double x0)
{
    double y = fabs(0.5 - metroi_circle_distance(x0, 0));
    metroi_scaled sum = metroi_scaled_make(0.5 * metroi_odd_difference(g, s, y), 0), even;
    even = metroi_uniform_excess(2 * g, s, 0, 0);
    metroi_scaled_add(&sum, 0.5 * even.factor, even.log);
    even = metroi_uniform_excess(2 * g, s, 0, metroi_circle_distance(2 * y, 0));
    metroi_scaled_add(&sum, 0.5 * even.factor, even.log);
    return sum; /* eq 5.45 */
}

static metroi_scaled metroi_reflect_square(const metro_kernel *k, double x0, uint64_t n)
{
    double point[2] = { 0, 0 }, s = 2 * (double)n, factor;
    metro_kernel half = *k, reduced;
    metroi_seeds seeds = metroi_seeds_make(point, NULL, 2);
    metroi_scaled square;
    if (k->shape == METRO_VON_MISES || !isfinite(x0)) return metroi_scaled_make(METROI_NAN, 0);
    if (metroi_startup_settled(k, (double)n, &square)) return square;
    if (fabs(x0 - rint(x0)) == 0.5) return metroi_startup_square(k, n);
    half.size *= 0.5;
    half.size_min *= 0.5;
    reduced = half;
    factor = metroi_seeds_reduce(&reduced, &s);
    if (reduced.shape == METRO_UNIFORM && reduced.size > 0.2 && s >= 6 && s <= 8) {
        square = metroi_reflect_few(reduced.size, s, x0);
        square.log += factor;
        return square;
    }
    point[1] = x0;
    return metroi_seeds_square(&half, n, &seeds); /* eq 5.44 */
}

METRO_API double metro_reflect_startup_error(const metro_kernel *k, double x0, uint64_t n)
{
    return metroi_scaled_root(metroi_reflect_square(k, x0, n));
}

METRO_API double metro_reflect_startup_log_error(const metro_kernel *k, double x0, uint64_t n)
{
    return metroi_scaled_root_log(metroi_reflect_square(k, x0, n));
}

/* # 5.14 More dimensions

   The paper says of Figure 2 that the situation gets worse for higher dimensions. It does, and we can say by how
   much. If a step perturbs all d coordinates at once and independently, the density of the state is the product of
   those of its coordinates, and with e_j the start-up error of coordinate j

       1 + E_n^2 = prod_{j=1}^{d} (1 + e_j^2)                                         (5.47)

   While the e_j are large, the error grows like their product; when they are small, only like sqrt(d). We evaluate eq
   5.47 in logarithms:

       E_n^2 = exp(sum_{j=1}^{d} ln(1 + e_j^2)) - 1                                   (5.48)

   A step that perturbs only one coordinate, picked at random, is another matter. Its eigenvalues are 1 - (1/d) sum_j
   (1 - P*(k_j)), and with probability (1 - 1/d)^n a given coordinate has not been touched after n steps: p_n keeps a
   part that is concentrated where that coordinate still has its first value, a set without volume, and for d >= 2 its
   L2 error is infinite for every n. Taking the coordinates in turn makes it finite after a full sweep. The library
   computes neither.

   [figure: fig2_dimensions.svg | The start-up error in one, two, three and five dimensions.] */

static metroi_scaled metroi_axes_square(const metro_kernel *k, size_t axes, uint64_t n)
{
    metroi_scaled small = metroi_scaled_make(0, -METROI_INFINITY), e;
    double sum = 0;
    size_t i;
    if (axes == 0) return metroi_scaled_make(METROI_NAN, 0);
    for (i = 0; i < axes; i++) {
        e = metroi_startup_square(&k[i], n);
        if (isnan(e.factor)) return e;
        metroi_scaled_add(&small, e.factor, e.log);
        sum += log1p(metroi_scaled_value(e));
    }
    if (sum < 1e-17) return small;
    if (sum < 1) return metroi_scaled_make(expm1(sum), 0); /* eq 5.48 */
    return sum < METROI_INFINITY ? metroi_scaled_make(-expm1(-sum), sum) : metroi_scaled_make(sum, 0);
}

METRO_API double metro_startup_error_axes(const metro_kernel *k, size_t axes, uint64_t n)
{
    return metroi_scaled_root(metroi_axes_square(k, axes, n));
}

METRO_API double metro_startup_log_error_axes(const metro_kernel *k, size_t axes, uint64_t n)
{
    return metroi_scaled_root_log(metroi_axes_square(k, axes, n));
}

/* # 5.15 The running mean

   A picture averages all samples so far. A sample picked at random among the M that follow a burn-in of b has the
   density (p_b + .. + p_{b+M-1})/M, and by eq 5.5 its coefficients are geometric sums:

       S_k = frac{1}{M} sum_{i=b}^{b+M-1} P*(k)^i = P*(k)^b frac{1 - P*(k)^M}{M (1 - P*(k))}      (5.49)
       E^2 = 2 sum_{k=1}^{inf} S_k^2                                                  (5.50)

   For a mode with P near 1 this dies like tau/M, by averaging, while P^n dies exponentially; section 5.19 says what
   that means for an estimate. For M = 1 it is E_b again. With b = 0 the mean holds p_0, and its error is infinite.

   At b = 1 the series is slow, like 1/k^2 for uniform steps. Squaring eq 5.49 out gives powers of P again,

       M^2 S_k^2 = sum_{s=2b}^{2(b+M-1)} c_s P*(k)^s, c_s = min(s - 2b + 1, 2(b+M-1) - s + 1)      (5.51)

   and each power, summed over k, is a value e_s(0) that we know how to find. So the first powers, which make the
   series slow, are taken out of it:

       M^2 E^2 = sum_{s=2b}^{J} c_s e_s(0) + 2 sum_{k=1}^{inf} G_k
       G_k = M^2 S_k^2 - sum_{s=2b}^{J} c_s P*(k)^s                                   (5.52)

   Uniform steps: J = 16, triangular ones: J = 8, Kelemen's: J = 4. Where J would be under 2b nothing is taken out. On
   a shorter circle, which must hold the reach of 2(b+M-1) steps, the mode k = 0 does not drop out and all is divided
   by T, as in eq 5.16:

       M^2 E^2 = sum_{s=2b}^{J} c_s e_s(0) + frac{1}{T} (G_0 + 2 sum_{k=1}^{inf} G_k) - G_0      (5.53)

   With large steps everything carries (1 - p)^s; we keep (1 - p)^{2b} in front and the rest inside. */

typedef struct {
    const metro_kernel *kernel;
    double burn, steps;           /* b, M */
    double large, keep, log_keep; /* p, 1 - p, and its logarithm */
    double last;                  /* J - 2b: so many powers, and one, are taken out; -1: none */
    int odd_steps;
} metroi_mean;

/* c_s as a function of i = s - 2b */
static double metroi_mean_weight(const metroi_mean *mean, double i)
{
    return i + 1 < 2 * mean->steps - 1 - i ? i + 1 : 2 * mean->steps - 1 - i;
}

/* The powers s = 2b + i, i = 0 .. last. `ratio` bounds abs(e_{s+1}/e_s): where it makes terms negligible, the sum
   ends. */
static metroi_scaled metroi_mean_powers(const metroi_mean *mean, double last, double ratio)
{
    metroi_scaled sum = metroi_scaled_make(0, -METROI_INFINITY), e;
    double i, c;
    for (i = 0; i <= last && i <= 2 * (mean->steps - 1); i++) {
        c = metroi_mean_weight(mean, i);
        if ((i + 1) * pow(ratio, i) < 1e-17) break;
        e = metroi_excess(mean->kernel, 2 * mean->burn + i, fmod(i, 2) > 0, 0);
        metroi_scaled_add(&sum, c * e.factor, e.log); /* eq 5.51 */
    }
    return sum;
}

/* sum_{i=0}^{last} c_i v^i, the part of G that is taken out, over P^{2b} */
static double metroi_mean_polynomial(const metroi_mean *mean, double v)
{
    double sum = 0, i = mean->last;
    if (i > 2 * (mean->steps - 1)) i = 2 * (mean->steps - 1);
    for (; i >= 0; i--) sum = sum * v + metroi_mean_weight(mean, i);
    return sum;
}

/* (1 - v^M)/(1 - v) for v = (1 - p) P with ln abs(P) = `at`; 1 - v is carried as the gap. */
static double metroi_mean_geometric(const metroi_mean *mean, double at, int sign, double *v)
{
    double gap, power;
    *v = sign * mean->keep * exp(at);
    gap = sign > 0 ? mean->large - mean->keep * expm1(at) : 1 - *v;
    if (gap == 0) return mean->steps;
    if (*v > 0.5) return -expm1(mean->steps * log1p(-gap)) / gap;
    power = exp(mean->steps * (at + mean->log_keep));
    return (sign < 0 && mean->odd_steps ? 1 + power : 1 - power) / gap;
}

/* The tails. Gaussian and von Mises modes: 1 - P grows at most like k^2, so P^b/(1 - P) falls faster than 1/k^2 and
   the terms faster than 1/k^4; for Cauchy modes it is 1/k and 1/k^2:

       sum_{j>k} G_j <= frac{k}{3} (frac{P_k^b}{(1-p)(1 - P_k)})^2, "Cauchy" k "for" k/3      (5.54)

   Uniform and triangular modes obey the first up to the first zero of P, and from there on, as Kelemen's do from the
   start, with a bound abs(P) <= x on all modes from k on, x falling like 1/k, 1/k^2 and 1/k,

       sum_{j>k} G_j <= x^{J+1} frac{k}{J} (frac{J + 2 - 2b}{1 - x} + frac{x}{(1-x)^2})      (5.55)

   with 2 J + 1 for the J under k where x falls like 1/k^2. */

/* eq 5.54 with `share` for k/3, and eq 5.55 with x = `bound` falling like 1/k^fall; logarithms. */

static double metroi_mean_near(const metroi_mean *mean, double share, double at)
{
    return log(share) + 2 * (mean->burn * at - log(-mean->keep * expm1(at)));
}

static double metroi_mean_far(const metroi_mean *mean, double k, double bound, double fall)
{
    double power = 2 * mean->burn + mean->last; /* J */
    if (!(bound < 0.5)) return METROI_INFINITY;
    return (power + 1) * log(bound) + log(k / (fall * (power + 1) - 1))
         + log((mean->last + 2) / (1 - bound) + bound / ((1 - bound) * (1 - bound)));
}

/* Kelemen's modes up to 4 C T are none above X, eq 5.11, and beyond they fall. */
static double metroi_mean_kelemen_tail(const metroi_mean *mean, double period, double k)
{
    double scale = metroi_kelemen_bound(mean->kernel) * period, edge = 4 * scale, top;
    if (k >= edge) return metroi_mean_far(mean, k, scale / k, 1);
    top = metroi_kelemen_ceiling(mean->kernel, k / period);
    if (!(top < 0)) return METROI_INFINITY;
    return log(2) + fmax(metroi_mean_near(mean, edge, top), metroi_mean_far(mean, edge, 0.25, 1));
}

static double metroi_mean_tail(const metroi_mean *mean, const metroi_spectrum *spectrum, double k, double at)
{
    double near = -METROI_INFINITY, h = mean->kernel->size / spectrum->period, fall = 1, x;
    switch (mean->kernel->shape) {
    case METRO_GAUSSIAN:
    case METRO_VON_MISES: return metroi_mean_near(mean, k / 3, at);
    case METRO_CAUCHY: return metroi_mean_near(mean, k, at);
    case METRO_KELEMEN: return metroi_mean_kelemen_tail(mean, spectrum->period, k);
    case METRO_TRIANGLE: fall = 2; break;
    case METRO_UNIFORM: break;
    }
    h /= fall; /* the triangle is two uniform steps of half the width */
    if (k * h < 1) {
        near = metroi_mean_near(mean, k / 3, at);
        k = 1 / h;
    }
    x = 1 / (METROI_PI * k * h);
    return log(2) + fmax(near, metroi_mean_far(mean, k, fall > 1 ? x * x : x, fall));
}

/* G_k without (1 - p)^{2b} over P^{2b}, and for Kelemen's kernel the sum of section 5.10 over it. */

static double metroi_mean_term(const metroi_mean *mean, double at, int sign)
{
    double v, r = metroi_mean_geometric(mean, at, sign, &v);
    return r * r - metroi_mean_polynomial(mean, v); /* eq 5.52 */
}

static double metroi_mean_far_term(const metroi_far_terms *terms, double at, int sign)
{
    const metroi_mean *mean = (const metroi_mean *)terms->mean;
    return metroi_mean_term(mean, at, sign) * exp(2 * mean->burn * at);
}

static double metroi_mean_far_rest(const metroi_far_terms *terms, double k)
{
    return metroi_mean_kelemen_tail((const metroi_mean *)terms->mean, terms->spectrum.period, k);
}

static double metroi_mean_far_modes(const metroi_mean *mean, double period, double steps)
{
    metroi_far_terms terms;
    if (mean->kernel->shape != METRO_KELEMEN || !metroi_far_applies(mean->kernel, steps, period)) return METROI_NAN;
    metroi_spectrum_make(mean->kernel, period, &terms.spectrum);
    terms.steps = steps;
    terms.mean = mean;
    terms.term = metroi_mean_far_term;
    terms.rest = metroi_mean_far_rest;
    return metroi_far_series(&terms, 0, NULL);
}

/* The series of eq 5.53 without (1 - p)^{2b}; `taken` is the logarithm of what has been taken out, over the same. The
   reach counts only the steps whose weight (1 - p)^{s-2b} is above e^{-45}. */

static metroi_scaled metroi_mean_series(const metroi_mean *mean, const metroi_spectrum *spectrum, double longest,
                                        double taken)
{
    metroi_scaled sum = metroi_scaled_make(0, -METROI_INFINITY);
    double at, k, total, rest;
    int sign;
    for (k = 1;; k++) {
        at = metroi_spectrum_log(spectrum, k, &sign);
        metroi_scaled_add(&sum, metroi_mean_term(mean, at, sign), 2 * mean->burn * at);
        if (k > 16 && fmod(k, 8) > 0) continue;
        total = fmax(metroi_scaled_log(sum), taken);
        rest = metroi_mean_tail(mean, spectrum, METROI_RESIGNATION, at);
        if (metroi_series_fails(spectrum, longest, k, rest, total)) return metroi_scaled_make(METROI_NAN, 0);
        rest = metroi_mean_tail(mean, spectrum, k, at);
        if (rest <= metroi_series_tolerance(spectrum, k) - log(10) + total) return sum;
    }
}

static metroi_scaled metroi_mean_modes(const metroi_mean *mean, double taken)
{
    metroi_spectrum spectrum;
    metroi_scaled sum;
    double longest = 2 * (mean->steps - 1), reach, zero = 0, r, v;
    if (mean->log_keep * longest < -45) longest = -45 / mean->log_keep;
    longest += 2 * mean->burn;
    reach = metroi_reach(mean->kernel, longest);
    if (reach < 1) {
        r = metroi_mean_geometric(mean, 0, 1, &v);
        zero = r * r - metroi_mean_polynomial(mean, mean->keep);
        taken = fmax(taken + log(reach), log(zero));
    }
    metroi_spectrum_make(mean->kernel, reach < 1 ? reach : 1, &spectrum);
    if (!metroi_far_fits(mean->kernel, longest)) longest = METROI_INFINITY; /* which section 5.10 refuses */
    sum = metroi_mean_series(mean, &spectrum, longest, taken);
    if (isnan(sum.factor)) {
        reach *= 1.25;
        sum = metroi_scaled_make(metroi_mean_far_modes(mean, reach < 1 ? reach : 1, longest), 0);
    }
    sum.factor *= 2;
    if (reach < 1) sum = metroi_scaled_make((zero + metroi_scaled_value(sum)) / reach - zero, 0); /* eq 5.53 */
    return sum;
}

/* Cauchy modes fall slowly when gamma b is small, and their powers sum slowly when M is large; but as a function of
   s, c_s e_s(0) is smooth. We add 1024 powers one by one, and the rest by Euler and Maclaurin's formula at midpoints,

       sum_{i=u}^{v-1} g(i) = int_{u-1/2}^{v-1/2} g(t) dt - frac{1}{24} (g'(v - 1/2) - g'(u - 1/2)) + ...      (5.56)

   over panels that double in length, 24 Gauss points in each, the derivative taken as g(v) - g(v-1). What is left out
   is of the order of g'''/2000, and g changes over 1000 steps or more. c_s rises for i < M and falls from there; each
   slope is a sum of its own. */

static double metroi_cauchy_power(const metroi_mean *mean, double i, int falling)
{
    double rate = 2 * METROI_PI * mean->kernel->size;
    double c = falling ? 2 * mean->steps - 1 - i : i + 1;
    return c * 2 / expm1(rate * (2 * mean->burn + i)) * exp(i * mean->log_keep);
}

static double metroi_cauchy_slope(const metroi_mean *mean, double from, double to, int falling)
{
    double sum = 0, i, end, weight, node, slope, panel;
    int j;
    for (i = from; i < to && i < from + 1024; i++) sum += metroi_cauchy_power(mean, i, falling);
    while (i < to) {
        end = 2 * i < to ? 2 * i : to;
        panel = 0;
        for (j = 0; j < 24; j++) {
            node = metroi_gauss24(j, &weight);
            panel += weight * metroi_cauchy_power(mean, i - 0.5 + (end - i) * node, falling);
        }
        slope = metroi_cauchy_power(mean, end, falling) - metroi_cauchy_power(mean, end - 1, falling)
              - metroi_cauchy_power(mean, i, falling) + metroi_cauchy_power(mean, i - 1, falling);
        sum += panel * (end - i) - slope / 24; /* eq 5.56 */
        i = end;
    }
    return sum;
}

static metroi_scaled metroi_mean_cauchy(const metroi_mean *mean)
{
    double rate = 2 * METROI_PI * mean->kernel->size, end = ceil(45 / (rate - mean->log_keep));
    double top = mean->steps, sum;
    sum = metroi_cauchy_slope(mean, 0, end < top ? end : top, 0);
    if (end > 2 * top - 1) end = 2 * top - 1;
    if (end > top) sum += metroi_cauchy_slope(mean, top, end, 1);
    return metroi_scaled_make(sum, 2 * mean->burn * mean->log_keep);
}

/* M^2 E^2. Close to a whole number of turns the powers of d/Delta fall so fast that they are all we need; the Cauchy
   kernel goes its own way while 4 pi gamma b < 1. */

static metroi_scaled metroi_mean_sum(metroi_mean *mean)
{
    const metro_kernel *k = mean->kernel;
    double size = k->shape == METRO_TRIANGLE ? 0.5 * k->size : k->size, ratio = 1;
    double highest = 0;
    metroi_scaled sum, modes;
    if (k->shape == METRO_UNIFORM) highest = 16;
    if (k->shape == METRO_TRIANGLE) highest = 8;
    if (k->shape == METRO_KELEMEN) highest = 4;
    if (highest > 4) {
        ratio = fabs(size - rint(size)) / size;
        if (k->shape == METRO_TRIANGLE) ratio *= ratio;
    }
    if (ratio < 1 && ratio * mean->keep < 0.1) return metroi_mean_powers(mean, METROI_INFINITY, ratio * mean->keep);
    if (k->shape == METRO_CAUCHY && 4 * METROI_PI * k->size * mean->burn < 1) return metroi_mean_cauchy(mean);
    mean->last = highest >= 2 * mean->burn ? highest - 2 * mean->burn : -1;
    sum = metroi_mean_powers(mean, mean->last, 1);
    if (mean->last >= 2 * (mean->steps - 1)) return sum;
    sum.log -= 2 * mean->burn * mean->log_keep;
    modes = metroi_mean_modes(mean, metroi_scaled_log(sum));
    metroi_scaled_add(&sum, modes.factor, modes.log); /* eq 5.52 */
    sum.log += 2 * mean->burn * mean->log_keep;
    return sum;
}

static metroi_scaled metroi_mean_square(const metro_kernel *k, uint64_t burn, uint64_t steps)
{
    metroi_mean mean;
    metroi_scaled square;
    if (steps == 0) return metroi_scaled_make(METROI_NAN, 0);
    if (metroi_startup_settled(k, (double)burn, &square)) return square;
    if (steps == 1) return metroi_startup_square(k, burn);
    mean.kernel = k;
    mean.burn = (double)burn;
    mean.steps = (double)steps;
    mean.large = k->large;
    mean.keep = 1 - k->large;
    mean.log_keep = log1p(-k->large);
    mean.odd_steps = (int)(steps & 1);
    mean.last = -1;
    square = metroi_mean_sum(&mean);
    square.factor /= mean.steps * mean.steps; /* eq 5.50 */
    return square;
}

METRO_API double metro_startup_error_mean(const metro_kernel *k, uint64_t burn, uint64_t steps)
{
    return metroi_scaled_root(metroi_mean_square(k, burn, steps));
}

METRO_API double metro_startup_log_error_mean(const metro_kernel *k, uint64_t burn, uint64_t steps)
{
    return metroi_scaled_root_log(metroi_mean_square(k, burn, steps));
}

/* # 5.16 The density itself

   p_n(x) is eq 5.40 term by term. At n = 1 it is the kernel's own density, with its jumps; from n = 2 on it is
   continuous. Rounding can leave a value of -1e-16 where the density is 0; it is returned as 0. */

static double metroi_startup_density_one(const metro_kernel *k, uint64_t n, double x, double seed)
{
    metroi_scaled e;
    if (n == 0) return metroi_wrap(x) == metroi_wrap(seed) ? METROI_INFINITY : 0;
    if (n == 1) return metro_kernel_density(k, seed, x);
    if (metroi_startup_settled(k, (double)n, &e)) return e.factor == 0 ? 1 : METROI_NAN;
    e = metroi_excess(k, (double)n, (int)(n & 1), metroi_circle_distance(x, seed));
    return 1 + metroi_scaled_value(e);
}

METRO_API double metro_startup_density(const metro_kernel *k, uint64_t n, double x, const double *seed,
                                       const double *alpha, size_t seeds)
{
    metroi_seeds set = metroi_seeds_make(seed, alpha, seeds);
    double sum = 0;
    size_t i;
    if (!metroi_kernel_valid(k) || !isfinite(x) || !metroi_seeds_valid(&set)) return METROI_NAN;
    for (i = 0; i < seeds; i++) {
        double weight = metroi_seed_weight(&set, i);
        if (weight > 0) sum += weight * metroi_startup_density_one(k, n, x, seed[i]); /* eq 5.40 */
    }
    return sum < 0 ? 0 : sum;
}

/* # 5.17 Other distances

   The paper measures the error in L2. A probabilist would ask for the total variation, the largest error of the
   probability of any event; a statistician for the Kullback-Leibler divergence:

       TV = frac{1}{2} int_{0}^{1} abs(p_n(x) - 1) dx, KL = int_{0}^{1} p_n(x) ln(p_n(x)) dx      (5.57)

   The L2 error bounds both distances of eq 5.57, by the inequalities of Cauchy and Schwarz and of Jensen:

       TV <= min(1, E_n/2)                                                            (5.58)
       KL <= ln(1 + E_n^2)                                                            (5.59)

   For a uniform kernel at n = 1 the density has two values. With f = Delta - floor(Delta), it is 1 + q u, u = (1 -
   f)/Delta, on a part f of the circle, and 1 + q v, v = -f/Delta, on the rest, where q = 1 - p is what large steps
   leave. So

       TV = q f (1 - f)/Delta                                                         (5.60)
       KL = f phi(q u) + (1 - f) phi(q v), phi(t) = (1 + t) ln(1 + t) - t             (5.61)

   and the t in phi, which cancel in the sum, keep its digits where the values of t are small; below 1/8 phi is summed
   as t^2/2 - t^3/6 + t^4/12 - ... */

static double metroi_divergence_phi(double t)
{
    double sum = 0, j;
    if (t <= -1) return 1;
    if (fabs(t) > 0.125) return (1 + t) * log1p(t) - t;
    for (j = 18; j >= 2; j--) sum = 1 / (j * (j - 1)) - t * sum;
    return t * t * sum;
}

static int metroi_startup_two_valued(const metro_kernel *k, uint64_t n)
{
    return metroi_kernel_valid(k) && k->shape == METRO_UNIFORM && n == 1;
}

METRO_API double metro_startup_total_variation_bound(const metro_kernel *k, uint64_t n)
{
    double f = k->size - floor(k->size), e;
    if (metroi_startup_two_valued(k, n)) return (1 - k->large) * f * (1 - f) / k->size; /* eq 5.60 */
    e = metro_startup_error(k, n);
    return e > 2 ? 1 : 0.5 * e; /* eq 5.58 */
}

METRO_API double metro_startup_divergence_bound(const metro_kernel *k, uint64_t n)
{
    double f = k->size - floor(k->size), q = 1 - k->large, e;
    if (metroi_startup_two_valued(k, n)) {
        double above = q * ((1 - f) / k->size), below = -q * (f / k->size);
        return f * metroi_divergence_phi(above) + (1 - f) * metroi_divergence_phi(below); /* eq 5.61 */
    }
    e = metro_startup_error(k, n);
    return log1p(e * e); /* eq 5.59 */
}

#undef METROI_DEBYE
#undef METROI_MODES
#undef METROI_FAR_BATCH
#undef METROI_FAR_MODES
#undef METROI_FAR_SAMPLES
#undef METROI_PATIENCE
#undef METROI_RESIGNATION
#undef METROI_SPLINE_ORDER
#undef METROI_WIDEST

/* # 5.18 The sphere

   A state may be a direction, and the paper perturbs directions inside a cone. Spherical harmonics play the part of
   the Fourier series: a kernel that depends on the angle alone multiplies all 2l + 1 harmonics of degree l by
   lambda_l (chapter 3). Against the uniform probability on the sphere, with p_n the density relative to it,

       E_n^2 = sum_{l=1}^{inf} (2l + 1) lambda_l^{2n} = p_{2n}(0) - 1                 (5.62)

   where p_{2n}(0) is the density of being back at the seed. The factor 2l + 1 is the price of a second dimension: for
   a small cone some 1/alpha^2 modes wait to be forgotten, not 1/Delta.

   One and two steps have closed forms. Let f = sin^2(alpha/2) be the share of the sphere that the cone takes; then
   p_2(0) = 1/f, and

       E_1 = cot(alpha/2)                                                             (5.63)

   For E_2 we need p_2 everywhere: at an angle theta from the seed it is the share of the sphere in which two cones,
   theta apart, overlap, over f^2. The overlap is elementary, two sectors less two triangles. With sin(theta/2) =
   sin(alpha) sin(t),

       f p_2 = frac{2}{pi} (atan2(cos(t), cos(alpha) sin(t)) - frac{1}{2 f} asin(A)),
       A = frac{2 f cos(t) sin(t)}{sqrt{1 - sin^2(alpha) sin^2(t)}}                   (5.64)
       1 + E_2^2 = 2 sin^2(alpha) int_{0}^{pi/2} p_2^2 sin(t) cos(t) dt               (5.65)

   and the variable t makes the integrand so smooth that 24 Gauss points give it to rounding. The value is f (1 +
   E_2^2). */

static double metroi_cone_twice(double f)
{
    double cosine = 1 - 2 * f, sine = 2 * sqrt(f * (1 - f)), sum = 0, weight, s, c, p;
    int i;
    for (i = 0; i < 24; i++) {
        double t = 0.5 * METROI_PI * metroi_gauss24(i, &weight);
        s = sin(t);
        c = cos(t);
        p = 2 / METROI_PI * (atan2(c, cosine * s) - asin(2 * f * c * s / sqrt(1 - sine * s * (sine * s))) / (2 * f));
        sum += weight * p * p * s * c; /* eq 5.64 */
    }
    return 4 * METROI_PI * (1 - f) * sum; /* eq 5.65: sin^2(alpha) = 4 f (1 - f) */
}

/* From three steps on we sum eq 5.62 relative to its first term, with the recurrence of section 3.10. Its terms fall
   in the end like those of a Bessel function,

       abs(lambda_l) <= C_b (l + 1/2)^{-3/2}, C_b = 1.16 (1 + cos(alpha)) sqrt{2/pi} sin^{-3/2}(alpha)      (5.66)

   (the form is the asymptotic one, Szego 1939, 8.21; the factor 1.16 was found numerically over all degrees and
   angles, 1.151 being needed), so what follows degree l is at most 2 C_b^{2n} (l + 1/2)^{2-3n}/(3n - 2). For many
   steps that bound comes late. While lambda_l/lambda_1 is above 0.3 no later one is larger, because the second lobe
   never exceeds 0.25; up to the degree where eq 5.66 falls to lambda_l the terms are thus at most those of degree
   l. */

static double metroi_cone_term(double gap, double n)
{
    double square = (1 - gap) * (1 - gap), product = 1;
    if (n > 16) return gap < 0.5 ? exp(2 * n * log1p(-gap)) : gap == 1 ? 0 : exp(n * log(square));
    for (; n > 0; n--) product *= square;
    return product;
}

/* ln sum (2l + 1) (lambda_l/lambda_1)^{2n}, for f <= 1/2 and n >= 3. */
static double metroi_cone_series(double f, double n)
{
    metroi_cone cone = metroi_cone_start(2 * f);
    double sum = 3, l, tolerance = log(3e-13), tail, reach;
    /* ln(C_b/lambda_1), lambda_1 = 1 - f */
    double bound = log(1.16 * 2 * sqrt(2 / METROI_PI)) - 0.75 * log(4 * f * (1 - f));
    for (l = 2;; l++) {
        metroi_cone_next(&cone);
        sum += (2 * l + 1) * metroi_cone_term(cone.gap, n); /* eq 5.62 */
        if (fmod(l, 16) > 0) continue;
        tail = 2 * n * bound + (2 - 3 * n) * log(l + 0.5) + log(2 / (3 * n - 2)); /* eq 5.66 */
        if (cone.gap < 0.7) {
            reach = log1p(-cone.gap);
            tail = 2 * n * reach + 4 / 3.0 * (bound - reach) + log(3);
        }
        if (tail <= tolerance + log(sum)) return log(sum);
    }
}

/* A narrow cone makes this series long. But while the chain has not come round the sphere, the return density times
   its area is a smooth function of the curvature that it has met: with tau = n f,

       Phi(tau) = tau (1 + E_n^2)                                                     (5.67)

   is analytic at tau = 0, where the sphere is a plane (for many steps it is that of the heat kernel on the sphere, 1
   + tau/3 + tau^2/15 + ...). Below tau = h = 0.005 we therefore evaluate it at h, 2h, .. 6h, where the series has
   some hundred terms, and extend it by the polynomial through these six values (Lagrange): what the polynomial leaves
   is of the order of 720 h^6 times a coefficient below 0.01, which is 1e-13 at most. */

#define METROI_NEAR_PLANE 0.005

static double metroi_sphere_extend(const double *phi, double x)
{
    double sum = 0, product;
    int i, j;
    for (i = 1; i <= 6; i++) {
        product = phi[i - 1];
        for (j = 1; j <= 6; j++)
            if (j != i) product *= (x - j) / (i - j);
        sum += product;
    }
    return sum;
}

/* E^2 from Phi and ln tau, eq 5.67. */
static metroi_scaled metroi_sphere_square(double phi, double log_tau)
{
    if (log_tau < -40) return metroi_scaled_make(phi, -log_tau);
    return metroi_scaled_make(phi * exp(-log_tau) - 1, 0);
}

/* E_n^2 of a cone with share f <= 1/2 of the sphere, n >= 2. */
static metroi_scaled metroi_cone_square(double f, double log_f, double n)
{
    double phi[6], tau;
    int i;
    /* Towards the hemisphere the integrand of eq 5.65 bends too sharply for its 24 points, and the series is short */
    if (n < 3 && f < 0.3) return metroi_sphere_square(metroi_cone_twice(f > 1e-30 ? f : 1e-30), log_f);
    if (n * f >= METROI_NEAR_PLANE) return metroi_scaled_make(1, metroi_cone_series(f, n) + 2 * n * log1p(-f));
    for (i = 1; i <= 6; i++) {
        tau = METROI_NEAR_PLANE * i;
        phi[i - 1] = tau + tau * exp(metroi_cone_series(tau / n, n) + 2 * n * log1p(-tau / n));
    }
    return metroi_sphere_square(metroi_sphere_extend(phi, n * f / METROI_NEAR_PLANE), log(n) + log_f);
}

/* A cone wider than a hemisphere has the spectrum of the complementary one times cot^2(alpha/2), eq 3.19, so

       E_n(alpha) = cot^{2n}(alpha/2) E_n(pi - alpha) "for" alpha > pi/2              (5.68)

   and from alpha = pi on a single step is uniform: the error is exactly 0. */

static metroi_scaled metroi_cone_startup(double half_angle, uint64_t n)
{
    double s = sin(0.5 * half_angle), c = cos(0.5 * half_angle), steps = (double)n;
    metroi_scaled square;
    if (!(half_angle > 0 && isfinite(half_angle))) return metroi_scaled_make(METROI_NAN, 0);
    if (n == 0) return metroi_scaled_make(METROI_INFINITY, 0);
    if (half_angle >= METROI_PI) return metroi_scaled_make(0, 0);
    if (n == 1) return metroi_scaled_make(1, 2 * (log(c) - log(s)));
    if (half_angle <= 0.5 * METROI_PI) return metroi_cone_square(s * s, 2 * log(s), steps);
    square = metroi_cone_square(c * c, 2 * log(c), steps);
    square.log += 4 * steps * (log(c) - log(s)); /* eq 5.68 */
    return square;
}

METRO_API double metro_cone_startup_error(double half_angle, uint64_t n)
{
    /* eq 5.63, without the detour over logarithms */
    if (n == 1 && half_angle > 0 && half_angle < METROI_PI) return cos(0.5 * half_angle) / sin(0.5 * half_angle);
    return metroi_scaled_root(metroi_cone_startup(half_angle, n));
}

METRO_API double metro_cone_startup_log_error(double half_angle, uint64_t n)
{
    return metroi_scaled_root_log(metroi_cone_startup(half_angle, n));
}

/* The von Mises-Fisher kernel goes the same way with tau = n/kappa in eq 5.67, since its lambda_l is about exp(-l
   (l+1)/(2 kappa)). At tau = h the sum needs 10 + sqrt(80/h) degrees, 137, for any n; the terms are positive and
   their logarithms concave. One step has E_1^2 = kappa lambda_1. */

#define METROI_VMF_DEGREES 160

static double metroi_vmf_series(double kappa, double n)
{
    double log_lambda[METROI_VMF_DEGREES], sum = 0;
    size_t count = (size_t)(10 + sqrt(80 * ((kappa + 1) / n))), l;
    metroi_vmf_logs(kappa, count, log_lambda);
    for (l = count; l >= 1; l--) sum += (2 * (double)l + 1) * exp(2 * n * (log_lambda[l - 1] - log_lambda[0]));
    return log(sum) + 2 * n * log_lambda[0];
}

static metroi_scaled metroi_vmf_startup(double kappa, uint64_t n)
{
    double phi[6], steps = (double)n, tau, first;
    int i;
    if (!(kappa >= 0 && isfinite(kappa))) return metroi_scaled_make(METROI_NAN, 0);
    if (n == 0) return metroi_scaled_make(METROI_INFINITY, 0);
    if (kappa < 1e-300) return metroi_scaled_make(0, 0);
    if (n == 1) {
        metroi_vmf_logs(kappa, 1, &first);
        return metroi_scaled_make(1, log(kappa) + first);
    }
    if (kappa * METROI_NEAR_PLANE <= steps) return metroi_scaled_make(1, metroi_vmf_series(kappa, steps));
    for (i = 1; i <= 6; i++) {
        tau = METROI_NEAR_PLANE * i;
        phi[i - 1] = tau + tau * exp(metroi_vmf_series(steps / tau, steps));
    }
    tau = steps / kappa;
    return metroi_sphere_square(metroi_sphere_extend(phi, tau / METROI_NEAR_PLANE), log(steps) - log(kappa));
}

METRO_API double metro_vmf_startup_error(double kappa, uint64_t n)
{
    return metroi_scaled_root(metroi_vmf_startup(kappa, n));
}

METRO_API double metro_vmf_startup_log_error(double kappa, uint64_t n)
{
    return metroi_scaled_root_log(metroi_vmf_startup(kappa, n));
}

/* A third kernel needs no function. The phase function of Henyey and Greenstein (1941), with mean cosine g, has
   lambda_l = g^l, so eq 5.62 is a geometric series, and

       E_n^2 = frac{x (3 - x)}{(1 - x)^2}, x = g^{2n}                                 (5.69)

   By eq 5.69 a chain of such steps with g = 0.9 is within 1 % of the uniform density after 50 steps. */

/* # 5.19 The error of a run

   The density p_n is about one sample. A picture is a mean over all of them, and what a person sees is the error of
   that mean: its bias, which the start-up leaves, and its variance, which the correlation of neighbours feeds. For an
   integrand given by Fourier coefficients both are sums over pairs of modes, and exact.

   Seen from a seed x, the integrand is a sum of even and odd waves of the distance u = z - x that the chain has gone,

       f(x + u) = sum_{i} (a_i cos(2 pi i u) + b_i sin(2 pi i u))
       a_i = c_i cos(2 pi i x) + s_i sin(2 pi i x), b_i = s_i cos(2 pi i x) - c_i sin(2 pi i x)      (5.70)

   After n steps cos(2 pi i u) has the mean P_i^n, P_i short for P*(i), and the sine has the mean 0. So the mean of
   the M samples from n = b on is off by

       beta(x) = frac{1}{M} sum_{i} a_i P_i^b S_M(P_i),
       S_M(P) = 1 + P + ... + P^{M-1} = frac{1 - P^M}{1 - P}                          (5.71)

   The bias of the estimate is the mean of beta over the seeds. Its variance is the variance of beta over the seeds
   plus the mean over the seeds of the variance from a given seed (the law of total variance); even and odd waves do
   not correlate, because u and -u are equally likely:

       M^2 Var = sum_{i,j} (X_{ij} G_{ij} + Y_{ij} H_{ij} + Z_{ij} w_i w_j), w_i = P_i^b S_M(P_i)      (5.72)

   where X, Y are the means of a_i a_j and b_i b_j over the seeds, Z is the covariance of a_i and a_j over them, and
   G_{ij} (H_{ij}) is the covariance of sum cos(2 pi i u_n) with sum cos(2 pi j u_n) (of the sums of sines) over the
   run. X, Y and Z do not depend on the kernel and are summed once. */

typedef struct {
    size_t harmonics;
    int seeded;
    double *memory;
    double *power, *mean;         /* (c_i^2 + s_i^2)/2, and the mean of a_i over the seeds */
    double *even, *odd, *between; /* X, Y, Z of eq 5.72, for i <= j at metroi_pair_index */
} metroi_integrand;

static size_t metroi_pair_index(size_t i, size_t j)
{
    return j * (j - 1) / 2 + i - 1;
}

/* Adds what one seed of weight `alpha` gives to the means; or, with `pairs`, to X, Y and Z. a and b are scratch. */
static void metroi_integrand_add(metroi_integrand *f, const double *cosine, const double *sine, double x,
                                 double alpha, int pairs, double *a, double *b)
{
    size_t i, j, at;
    for (i = 1; i <= f->harmonics; i++) {
        double c = metroi_cos_pi(2 * (double)i, x), s = metroi_sin_pi(2 * (double)i, x);
        double p = cosine != NULL ? cosine[i - 1] : 0, q = sine != NULL ? sine[i - 1] : 0;
        a[i - 1] = p * c + q * s; /* eq 5.70 */
        b[i - 1] = q * c - p * s;
        if (!pairs) f->mean[i - 1] += alpha * a[i - 1];
    }
    for (j = 1; pairs && j <= f->harmonics; j++)
        for (i = 1; i <= j; i++) {
            at = metroi_pair_index(i, j);
            f->even[at] += alpha * a[i - 1] * a[j - 1];
            f->odd[at] += alpha * b[i - 1] * b[j - 1];
            f->between[at] += alpha * (a[i - 1] - f->mean[i - 1]) * (a[j - 1] - f->mean[j - 1]);
        }
}

/* Takes an integrand apart. The weights are divided by their sum, so that a single seed has the weight 1 exactly. */
static metro_result metroi_integrand_make(const double *cosine, const double *sine, size_t harmonics,
                                          const metroi_seeds *seeds, int pairs, metroi_integrand *f)
{
    size_t cells = pairs ? harmonics * (harmonics + 1) / 2 : 0, i;
    double total = 0, *a, *b;
    /* neither a size nor the number of pairs may overflow */
    if (harmonics > (size_t)-1 / 64 || (pairs && harmonics >> (4 * sizeof(size_t) - 3) > 0))
        return METRO_ERROR_MEMORY;
    for (i = 0; i < harmonics; i++)
        if ((cosine != NULL && !isfinite(cosine[i])) || (sine != NULL && !isfinite(sine[i])))
            return METRO_ERROR_ARGUMENT;
    f->harmonics = harmonics;
    f->seeded = seeds->count > 0;
    f->memory = (double *)METRO_MALLOC((4 * harmonics + 3 * cells + 1) * sizeof(double));
    if (f->memory == NULL) return METRO_ERROR_MEMORY;
    memset(f->memory, 0, (4 * harmonics + 3 * cells + 1) * sizeof(double));
    f->power = f->memory;
    f->mean = f->power + harmonics;
    a = f->mean + harmonics;
    b = a + harmonics;
    f->even = b + harmonics;
    f->odd = f->even + cells;
    f->between = f->odd + cells;
    for (i = 0; i < harmonics; i++) {
        double p = cosine != NULL ? cosine[i] : 0, q = sine != NULL ? sine[i] : 0;
        f->power[i] = 0.5 * (p * p + q * q);
    }
    for (i = 0; i < seeds->count; i++) total += metroi_seed_weight(seeds, i);
    for (i = 0; i < seeds->count; i++)
        metroi_integrand_add(f, cosine, sine, seeds->point[i], metroi_seed_weight(seeds, i) / total, 0, a, b);
    for (i = 0; pairs && i < seeds->count; i++)
        metroi_integrand_add(f, cosine, sine, seeds->point[i], metroi_seed_weight(seeds, i) / total, 1, a, b);
    return METRO_OK;
}

/* A mode of the kernel, as everything below needs it. */

typedef struct {
    double value, gap, log; /* P, 1 - P and ln abs(P) */
} metroi_mode;

static metroi_mode metroi_mode_make(const metro_kernel *k, size_t i)
{
    metroi_mode mode;
    mode.value = 1;
    mode.gap = 0;
    if (i > 0) metroi_kernel_mode(k, (double)i, &mode.value, &mode.gap);
    mode.log = mode.gap < 0.5 ? log1p(-mode.gap) : log(fabs(mode.value));
    return mode;
}

/* P^m and S_m(P), m >= 1 */
static double metroi_mode_power(metroi_mode mode, uint64_t m)
{
    double power = exp((double)m * mode.log);
    return mode.value < 0 && (m & 1) ? -power : power;
}

static double metroi_mode_sum(metroi_mode mode, uint64_t m)
{
    double at = (double)m * mode.log;
    if (mode.gap == 0) return (double)m;
    if (mode.value > 0 && at > -0.7) return -expm1(at) / mode.gap;
    return (1 - metroi_mode_power(mode, m)) / mode.gap; /* eq 5.71 */
}

/* # 5.20 Covariances by doubling

   Written out, G and H are double sums of differences of powers, whose closed form divides by (1 - P)^2: at small
   sizes and few steps it loses all digits of a variance that is itself small. We put a run together from shorter ones
   instead. Let a run of m steps be followed by one of m'. With

       eta_m = frac{1}{2} (P_{i-j}^m + P_{i+j}^m), zeta_m = frac{1}{2} (P_{i-j}^m - P_{i+j}^m)      (5.73)

   which are the means of cos(2 pi i u_m) cos(2 pi j u_m) and of the product of the sines, a run of m' that starts at
   u_m instead of 0 has the even covariance eta_m G' + zeta_m H', by the addition theorem. Let e_m be the covariance
   of cos(2 pi i u_m) and cos(2 pi j u_m), g^{ij}_m that of the sum of cos(2 pi i u_n) over the run, n < m, with cos(2
   pi j u_m), and o_m, h^{ij}_m the same of the sines. The law of total covariance, given u_m, then says

       e_{m+m'} = eta_m e_{m'} + zeta_m o_{m'} + e_m P_i^{m'} P_j^{m'}
       g^{ij}_{m+m'} = eta_m g^{ij}_{m'} + zeta_m h^{ij}_{m'} + P_j^{m'} (g^{ij}_m + e_m S_{m'}(P_i))
       G_{m+m'} = G_m + eta_m G_{m'} + zeta_m H_{m'} + e_m S_{m'}(P_i) S_{m'}(P_j)
                  + g^{ij}_m S_{m'}(P_j) + g^{ji}_m S_{m'}(P_i)                       (5.74)

   and the same with even and odd exchanged for o (where the mean of a sine is 0, so o_m = zeta_m), h and H. For
   positive falling modes every term is positive: nothing cancels, and M steps need 2 log2(M) such steps. A run of one
   step has G = H = g = h = 0. */

typedef struct {
    metroi_mode plus, minus, i, j; /* the modes i + j, abs(i - j), i and j */
} metroi_pair;

/* A run: the covariances of its sums and of its sums with the state after it. Index 0: even, 1: odd. */
typedef struct {
    uint64_t steps;
    double sum[2], forward[2], back[2]; /* G and H; g^{ij} and h^{ij}; g^{ji} and h^{ji} */
    double state[2];                    /* e and o */
    double plus, minus, power[2];       /* P_{i+j}^m, P_{i-j}^m, P_i^m, P_j^m for m = steps */
    double total[2];                    /* S_m(P_i), S_m(P_j) */
} metroi_run_block;

/* The powers that belong to a run's length. Once e_m and o_m are no longer small they are taken from these: they are
   means less products of means, and the recurrence would let their rounding errors grow with the length of the
   run. */

static void metroi_run_measure(const metroi_pair *pair, metroi_run_block *run)
{
    double even, odd, product;
    run->plus = metroi_mode_power(pair->plus, run->steps);
    run->minus = metroi_mode_power(pair->minus, run->steps);
    run->power[0] = metroi_mode_power(pair->i, run->steps);
    run->power[1] = metroi_mode_power(pair->j, run->steps);
    run->total[0] = metroi_mode_sum(pair->i, run->steps);
    run->total[1] = metroi_mode_sum(pair->j, run->steps);
    odd = 0.5 * (run->minus - run->plus); /* eq 5.73 */
    even = 0.5 * (run->minus + run->plus);
    product = run->power[0] * run->power[1];
    if (fabs(odd) >= 0.25 * fabs(run->minus)) run->state[1] = odd;
    if (fabs(even - product) >= 0.5 * fabs(even)) run->state[0] = even - product;
}

static metroi_run_block metroi_run_join(const metroi_pair *pair, const metroi_run_block *a, const metroi_run_block *b)
{
    metroi_run_block ab;
    double same = 0.5 * (a->minus + a->plus), other = a->state[1]; /* eq 5.73 */
    int p;
    ab.steps = a->steps + b->steps;
    for (p = 0; p < 2; p++) {
        int q = 1 - p;
        /* eq 5.74 */
        ab.sum[p] = a->sum[p] + same * b->sum[p] + other * b->sum[q] + a->state[p] * b->total[0] * b->total[1] +
                    a->forward[p] * b->total[1] + a->back[p] * b->total[0];
        ab.forward[p] = same * b->forward[p] + other * b->forward[q] +
                        b->power[1] * (a->forward[p] + a->state[p] * b->total[0]);
        ab.back[p] =
            same * b->back[p] + other * b->back[q] + b->power[0] * (a->back[p] + a->state[p] * b->total[1]);
        ab.state[p] = same * b->state[p] + other * b->state[q] + a->state[p] * b->power[0] * b->power[1];
    }
    metroi_run_measure(pair, &ab);
    return ab;
}

/* A run of `steps` >= 1 from runs of one step, by the binary digits of `steps`. */
static metroi_run_block metroi_run_make(const metroi_pair *pair, const metroi_run_block *one, uint64_t steps)
{
    metroi_run_block block = *one;
    uint64_t bit = 1;
    while (bit <= steps / 2) bit *= 2;
    for (bit /= 2; bit > 0; bit /= 2) {
        block = metroi_run_join(pair, &block, &block);
        if (steps & bit) block = metroi_run_join(pair, one, &block);
    }
    return block;
}

/* All of that starts from e_1 and o_1 of a single step. o_1 is zeta_1, a difference of gaps of different sizes. But
   e_1 is of the fourth order in the size while the gaps are of the second, so for small sizes it is integrated as it
   stands,

       e_1 = J_{ij} - (1 - P_i)(1 - P_j), J_{ij} = int 4 sin^2(pi i u) sin^2(pi j u) P(u) du      (5.75)

   over a few Gauss points, all terms positive; for the Gaussian it is P_i P_j 2 sinh^2(2 pi^2 sigma^2 i j). For large
   sizes the gaps will do: 4 sin^2(x) sin^2(y) = 2 - ... gives J = delta_i + delta_j - (delta_{i+j} + delta_{i-j})/2.
   Cauchy steps need no more at any size, since their gaps are of the first order. */

static double metroi_joint_integral(const metro_kernel *k, double i, double j)
{
    double low = 0, high = 0.5 * k->size, sum = 0, weight, x, y;
    int n;
    if (k->shape == METRO_KELEMEN) {
        low = k->size_min;
        high = k->size;
    }
    for (n = 0; n < 24; n++) {
        double u = low + (high - low) * metroi_gauss24(n, &weight);
        if (k->shape == METRO_TRIANGLE) weight *= 2 * (1 - u / high);
        if (k->shape == METRO_KELEMEN) weight *= (high - low) / (u * metroi_kelemen_log(low, high));
        x = sin(METROI_PI * i * u);
        y = sin(METROI_PI * j * u);
        sum += weight * 4 * x * x * y * y;
    }
    return sum;
}

static double metroi_joint_von_mises(double kappa, double i, double j)
{
    double nodes = 2 * ceil(6 * sqrt(kappa) + 24 + (i + j) / 2), sum = 1, moment = 0, n, w, s, x, y;
    for (n = 1; 2 * n <= nodes; n++) {
        s = sqrt(kappa) * sin(METROI_PI * (n / nodes));
        w = (2 * n < nodes ? 2 : 1) * exp(-2 * s * s);
        if (w < 1e-19) break;
        x = sin(METROI_PI * (i * n / nodes));
        y = sin(METROI_PI * (j * n / nodes));
        sum += w;
        moment += w * 4 * x * x * y * y;
    }
    return moment / sum;
}

/* J of eq 5.75 */
static double metroi_joint_moment(const metro_kernel *k, const metroi_pair *pair, double i, double j)
{
    double direct = pair->i.gap + pair->j.gap - 0.5 * (pair->plus.gap + pair->minus.gap), moment = -1, a, s;
    double reach = k->shape == METRO_KELEMEN ? k->size : 0.5 * k->size;
    switch (k->shape) {
    case METRO_UNIFORM:
    case METRO_TRIANGLE:
    case METRO_KELEMEN:
        if (2 * METROI_PI * (i + j) * reach < 12 && !(k->shape == METRO_KELEMEN && k->size_min >= k->size))
            moment = metroi_joint_integral(k, i, j);
        break;
    case METRO_GAUSSIAN:
        a = 2 * (METROI_PI * k->size) * (METROI_PI * k->size);
        s = sinh(a * i * j);
        if (a * (i + j) * (i + j) < 1)
            moment = expm1(-a * i * i) * expm1(-a * j * j) + 2 * exp(-a * (i * i + j * j)) * s * s;
        break;
    case METRO_VON_MISES:
        if ((i + j) * (i + j) < 2 * k->size) moment = metroi_joint_von_mises(k->size, i, j);
        break;
    case METRO_CAUCHY: break;
    }
    /* a large step has J = 1, or 3/2 where i = j */
    return moment < 0 ? direct : (1 - k->large) * moment + k->large * (i == j ? 1.5 : 1);
}

/* What the pair (i, j) adds to M^2 Var, eq 5.72 without its factor 2 for i < j. A burn-in is a run before, whose sums
   do not count. */
static double metroi_run_pair(const metroi_integrand *f, const metro_kernel *k, const metroi_mode *mode, size_t i,
                              size_t j, uint64_t burn, uint64_t steps)
{
    size_t at = metroi_pair_index(i, j);
    double even, odd, same, weight;
    metroi_run_block one, run, before;
    metroi_pair pair;
    if (f->even[at] == 0 && f->odd[at] == 0 && f->between[at] == 0) return 0;
    pair.plus = mode[i + j];
    pair.minus = mode[j - i];
    pair.i = mode[i];
    pair.j = mode[j];
    memset(&one, 0, sizeof one);
    one.steps = 1;
    metroi_run_measure(&pair, &one);
    one.state[0] = metroi_joint_moment(k, &pair, (double)i, (double)j) - pair.i.gap * pair.j.gap; /* eq 5.75 */
    one.state[1] = 0.5 * (pair.plus.gap - pair.minus.gap);
    run = metroi_run_make(&pair, &one, steps);
    even = run.sum[0];
    odd = run.sum[1];
    weight = run.total[0] * run.total[1];
    if (burn > 0) {
        before = metroi_run_make(&pair, &one, burn);
        same = 0.5 * (before.minus + before.plus);
        even = same * run.sum[0] + before.state[1] * run.sum[1] + before.state[0] * weight; /* eq 5.74 */
        odd = same * run.sum[1] + before.state[1] * run.sum[0] + before.state[1] * weight;
        weight *= before.power[0] * before.power[1];
    }
    return f->even[at] * even + f->odd[at] * odd + f->between[at] * weight;
}

/* # 5.21 A chain that starts in equilibrium

   From a uniform start there is no bias, and waves of different frequency do not correlate. One mode of power 1/2 has
   the variance T_M/(2 M^2), where T_M is the sum of P^{abs(n - n')} over all pairs of steps, again put together from
   shorter runs,

       T_{m+m'} = T_m + T_{m'} + 2 P S_m(P) S_{m'}(P)                                 (5.76)

   For many steps M Var tends, from any start, to

       lim M Var = sum_{i} frac{c_i^2 + s_i^2}{2} frac{1 + P_i}{1 - P_i}              (5.77)

   and M times the bias to the mean over the seeds of sum a_i P_i^b/(1 - P_i). The factor (1 + P)/(1 - P) is the
   integrated autocorrelation time of the mode (chapter 7 estimates it from draws). Bias and variance are both of the
   order 1/M: so after many steps it is the standard deviation, of the order M^{-1/2}, and not the start-up bias, that
   a picture shows. */

static double metroi_mode_stationary(metroi_mode mode, uint64_t steps)
{
    double total = 1;
    uint64_t bit = 1, m = 1;
    while (bit <= steps / 2) bit *= 2;
    for (bit /= 2; bit > 0; bit /= 2) {
        double sum = metroi_mode_sum(mode, m);
        total = 2 * total + 2 * mode.value * sum * sum; /* eq 5.76 */
        m *= 2;
        if (!(steps & bit)) continue;
        total += 1 + 2 * mode.value * metroi_mode_sum(mode, m);
        m++;
    }
    return total;
}

/* Bias and variance, from the modes 0 .. 2 harmonics (0 .. harmonics where no pairs are needed); steps = 0: the
   limits. */
static metro_run_error metroi_run_evaluate(const metroi_integrand *f, const metro_kernel *k, const metroi_mode *mode,
                                           uint64_t burn, uint64_t steps)
{
    metro_sum bias = { 0, 0 }, variance = { 0, 0 };
    metro_run_error error;
    double m = steps > 0 ? (double)steps : 1;
    size_t i, j;
    for (i = 1; i <= f->harmonics; i++) {
        double weight = steps > 0 ? metroi_mode_sum(mode[i], steps) / m : 1 / mode[i].gap;
        if (burn > 0) weight *= metroi_mode_power(mode[i], burn);
        if (f->mean[i - 1] != 0) metro_sum_add(&bias, f->mean[i - 1] * weight); /* eq 5.71 */
        if (f->seeded && steps > 0) continue;
        weight = (2 - mode[i].gap) / mode[i].gap; /* eq 5.77 */
        if (steps > 0) weight = metroi_mode_stationary(mode[i], steps) / m / m;
        if (f->power[i - 1] != 0) metro_sum_add(&variance, f->power[i - 1] * weight);
    }
    for (j = 1; f->seeded && steps > 0 && j <= f->harmonics; j++)
        for (i = 1; i <= j; i++) {
            double square = metroi_run_pair(f, k, mode, i, j, burn, steps) / m / m; /* eq 5.72 */
            metro_sum_add(&variance, i < j ? 2 * square : square);
        }
    error.bias = metro_sum_value(&bias);
    error.variance = metro_sum_value(&variance);
    if (error.variance < 0) error.variance = 0;
    error.mse = steps > 0 ? error.bias * error.bias + error.variance : error.variance;
    return error;
}

static void metroi_run_modes(const metro_kernel *k, size_t count, metroi_mode *mode)
{
    size_t i;
    for (i = 0; i <= count; i++) mode[i] = metroi_mode_make(k, i);
}

/* What both functions below begin with: the arguments checked, the integrand taken apart, room for the modes. */
static metro_result metroi_run_prepare(uint64_t steps, const double *cosine, const double *sine, size_t harmonics,
                                       const double *seed, const double *alpha, size_t seeds, metroi_integrand *f,
                                       metroi_mode **mode, size_t *modes)
{
    metroi_seeds set = metroi_seeds_make(seed, alpha, seeds);
    int pairs = seeds > 0 && steps > 0;
    metro_result result;
    if (seeds > 0 && !metroi_seeds_valid(&set)) return METRO_ERROR_ARGUMENT;
    result = metroi_integrand_make(cosine, sine, harmonics, &set, pairs, f);
    if (result != METRO_OK) return result;
    *modes = pairs ? 2 * harmonics : harmonics;
    *mode = (metroi_mode *)METRO_MALLOC((*modes + 1) * sizeof(metroi_mode));
    if (*mode != NULL) return METRO_OK;
    METRO_FREE(f->memory);
    return METRO_ERROR_MEMORY;
}

METRO_API metro_result metro_startup_run_error(const metro_kernel *k, uint64_t burn, uint64_t steps,
                                               const double *cosine, const double *sine, size_t harmonics,
                                               const double *seed, const double *alpha, size_t seeds,
                                               metro_run_error *error)
{
    metroi_integrand f;
    metroi_mode *mode;
    size_t modes;
    metro_result result;
    if (!metroi_kernel_valid(k) || error == NULL) return METRO_ERROR_ARGUMENT;
    result = metroi_run_prepare(steps, cosine, sine, harmonics, seed, alpha, seeds, &f, &mode, &modes);
    if (result != METRO_OK) return result;
    metroi_run_modes(k, modes, mode);
    *error = metroi_run_evaluate(&f, k, mode, burn, steps);
    METRO_FREE(mode);
    METRO_FREE(f.memory);
    return METRO_OK;
}

/* # 5.22 The best size

   Small steps correlate neighbours, and large ones land independently; so far the paper. But at constant importance
   the best uniform perturbation is larger than the domain. For one harmonic the limit of eq 5.77 is smallest where
   P*(1) is most negative, at tan(pi Delta) = pi Delta, Delta = 1.4302966531242: neighbours then tend to lie on
   opposite sides and their errors cancel; the mean squared error is .643 of that of independent samples; at Delta =
   .1 it is 121 times that of independent samples. Other importances move the best size either way (chapter 6): for a
   picture of two pixels 1 + .9 cos(2 pi x) asks for a larger one than the constant does, a narrow peak for a much
   smaller one.

   [figure: size.svg | Mean squared error, squared bias and variance against the size of the perturbation.]

   As a function of the size the mean squared error has many minima, one for each lobe of each mode. We scan it on 749
   sizes, in sixteenths of an octave up to 1/4 and in steps of 1/80 from there to 8, and refine the three best of the
   scan's minima by golden section (Kiefer 1953). A minimum is known to about 1e-8 of its place, as flat as it is. */

typedef struct {
    const metroi_integrand *f;
    metroi_mode *mode;
    size_t modes;
    metro_kernel kernel;
    uint64_t burn, steps;
} metroi_size_search;

static double metroi_size_error(metroi_size_search *search, double size, metro_run_error *error)
{
    search->kernel.size = size;
    metroi_run_modes(&search->kernel, search->modes, search->mode);
    *error = metroi_run_evaluate(search->f, &search->kernel, search->mode, search->burn, search->steps);
    return error->mse;
}

#define METROI_SIZES 749

static double metroi_size_scan(int i)
{
    return i < 128 ? ldexp(pow(2, i % 16 / 16.0), i / 16 - 10) : 0.25 + (i - 128) / 80.0;
}

/* The least value between the neighbours of scan point i. */
static double metroi_size_refine(metroi_size_search *search, int i, double *size, metro_run_error *error)
{
    const double golden = 0.61803398874989485;
    double a = metroi_size_scan(i > 0 ? i - 1 : 0), b = metroi_size_scan(i < METROI_SIZES - 1 ? i + 1 : i);
    double x = b - golden * (b - a), y = a + golden * (b - a);
    double at_x = metroi_size_error(search, x, error), at_y = metroi_size_error(search, y, error);
    while (b - a > 1e-9 * b) {
        if (at_x <= at_y) {
            b = y;
            y = x;
            at_y = at_x;
            x = b - golden * (b - a);
            at_x = metroi_size_error(search, x, error);
        } else {
            a = x;
            x = y;
            at_x = at_y;
            y = a + golden * (b - a);
            at_y = metroi_size_error(search, y, error);
        }
    }
    *size = 0.5 * (a + b);
    return metroi_size_error(search, *size, error);
}

/* Indices of the three least of the minima among the scanned values; -1 where there are fewer. Plateaus count at
   their small end, and a value must be better by more than rounding to come before a smaller size. */
static void metroi_size_minima(const double *value, int best[3])
{
    int i, j, m;
    best[0] = best[1] = best[2] = -1;
    for (i = 0; i < METROI_SIZES; i++) {
        if (i > 0 && value[i] >= value[i - 1] * (1 - 1e-12)) continue;
        if (i < METROI_SIZES - 1 && value[i] > value[i + 1] * (1 + 1e-12)) continue;
        j = 0;
        while (j < 3 && best[j] >= 0 && value[best[j]] <= value[i] * (1 + 1e-12)) j++;
        for (m = 2; m > j; m--) best[m] = best[m - 1];
        if (j < 3) best[j] = i;
    }
}

static metro_result metroi_size_find(metroi_size_search *search, double *size, metro_run_error *error)
{
    double *value = (double *)METRO_MALLOC(METROI_SIZES * sizeof(double)), least, found, at;
    metro_run_error tried, best_error;
    int best[3], i;
    if (value == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < METROI_SIZES; i++) value[i] = metroi_size_error(search, metroi_size_scan(i), &tried);
    metroi_size_minima(value, best);
    /* the scanned place itself stands unless a refined one is better by more than rounding */
    at = metroi_size_scan(best[0]);
    least = metroi_size_error(search, at, &best_error);
    for (i = 0; i < 3 && best[i] >= 0; i++) {
        if (!(metroi_size_refine(search, best[i], &found, &tried) < least * (1 - 1e-13))) continue;
        least = tried.mse;
        at = found;
        best_error = tried;
    }
    METRO_FREE(value);
    *size = at;
    *error = best_error;
    return METRO_OK;
}

METRO_API metro_result metro_startup_best_size(metro_shape shape, uint64_t burn, uint64_t steps, const double *cosine,
                                               const double *sine, size_t harmonics, const double *seed,
                                               const double *alpha, size_t seeds, double *size,
                                               metro_run_error *error)
{
    metroi_integrand f;
    metroi_size_search search;
    metro_result result;
    if (shape != METRO_UNIFORM && shape != METRO_TRIANGLE && shape != METRO_GAUSSIAN && shape != METRO_CAUCHY)
        return METRO_ERROR_ARGUMENT;
    if (size == NULL || error == NULL) return METRO_ERROR_ARGUMENT;
    result = metroi_run_prepare(steps, cosine, sine, harmonics, seed, alpha, seeds, &f, &search.mode, &search.modes);
    if (result != METRO_OK) return result;
    search.f = &f;
    search.kernel.shape = shape;
    search.kernel.size = search.kernel.size_min = search.kernel.large = 0;
    search.burn = burn;
    search.steps = steps;
    result = metroi_size_find(&search, size, error);
    METRO_FREE(search.mode);
    METRO_FREE(f.memory);
    return result;
}

#undef METROI_NEAR_PLANE
#undef METROI_VMF_DEGREES
#undef METROI_SIZES

/* # 6 The operator

   Chapter 5 computes what a seed leaves behind when the importance is constant. There every tentative sample is
   accepted, the chain is a convolution, and Fourier series turn it into products of numbers. Any other importance
   rejects, and rejection is not a convolution: how likely the chain moves depends on where it is.

   But it is still linear. One step turns the density p_n into the next one by an operator that never changes. We cut
   the circle into cells, and the operator becomes a matrix; then what takes an ensemble of a million chains to see
   through noise is a product of matrices, for every seed at once. This chapter makes the matrix from an importance,
   asks it what remains of a seed after n steps, how fast that fades, and what error a run of M steps has; and then it
   turns the question round and looks for the perturbation with the least error, which the paper calls its ultimate
   goal.

   Matrices of n cells cost n^2 numbers, so one dimension is as far as this goes. What it shows - peaks that are found
   late, islands that are never left - is not less true in a hundred dimensions; it is only harder to see there. */

/* # 6.1 From an importance to a matrix

   N cells, each 1/N long, hold the importances $I_0 .. I_{N-1}$. A chain in cell i proposes cell j and accepts as
   always. For the proposal let the point be uniform in its cell, and perturb it by the uniform kernel of full width
   Delta: the probability that it lands m cells further on is an overlap of three boxes, two cells and a kernel. With
   cells as the unit of length two boxes make a hat, and the kernel's box selects a part of it:

       w_m = frac{1}{Delta N} int_{m - Delta N / 2}^{m + Delta N / 2} max(0, 1 - abs(t)) dt                  (6.1)

   (This is the matrix that Galerkin's method with constant elements gives, so the errors of the gap, the total
   variation and the mean squared error fall with 1/N^2; the L2 norm is another matter, section 6.3. The simpler
   choice, the share of the kernel that lies over cell m when it starts from the middle of a cell, converges as fast
   on average but jumps whenever an end of the kernel passes from one cell to the next.)

   The difference of two integrals of the hat loses digits where both are near 1, so we integrate from the other end:
   H(x) is what the hat has beyond x, and $w_m = (H(abs(m) - Delta N/2) - H(abs(m) + Delta N/2)) / (Delta N)$. */

/* The hat's integral from x to 1. */
static double metroi_hat_tail(double x)
{
    if (!(x > -1.0)) return 1.0;
    if (!(x < 1.0)) return 0.0;
    return x > 0 ? 0.5 * (1.0 - x) * (1.0 - x) : 1.0 - 0.5 * (1.0 + x) * (1.0 + x);
}

/* On the circle a kernel wider than the domain laps itself: $w_m$ is a sum over m + j N, with as many terms as there
   are turns. But whole turns cover all cells evenly. So we write Delta = t + d with t whole turns and a rest d < 1,
   add the turns as a constant, and wrap the rest once around to either side. After an odd number of turns the rest is
   centred half a circle away: c is 0 for even t and N/2 for odd t.

       w_m = frac{1}{Delta N} (t + sum_{j=-1}^{1} [H(abs(m - c + j N) - frac{d N}{2})
           - H(abs(m - c + j N) + frac{d N}{2})])                                                              (6.2)

   A Delta that is a whole number leaves no rest: every cell is as likely as any other, and proposals are
   independent. */

static double metroi_operator_weight(double size, double cells, double offset)
{
    double whole = floor(size), half = 0.5 * (size - whole) * cells, overlap = 0;
    double centre = fmod(whole, 2.0) > 0 ? 0.5 * cells : 0.0;
    int turn;
    for (turn = -1; turn <= 1; turn++) { /* eq 6.1, wrapped as in eq 6.2 */
        double away = fabs(offset - centre + turn * cells);
        overlap += metroi_hat_tail(away - half) - metroi_hat_tail(away + half);
    }
    return (whole / size + overlap / size) / cells;
}

/* The weights of all offsets, with large steps in them. The chain proposes its own cell with what the others
   leave. */
static void metroi_operator_weights(const metro_kernel *kernel, size_t cells, double *weight)
{
    double n = (double)cells, others = 0;
    size_t m;
    for (m = 1; m < cells; m++) {
        double uniform = metroi_operator_weight(kernel->size, n, (double)m);
        weight[m] = (1.0 - kernel->large) * uniform + kernel->large / n;
        others += weight[m];
    }
    weight[0] = others < 1.0 ? 1.0 - others : 0.0;
}

/* In equilibrium the chain is in cell i with probability $pi_i = I_i / (I_0 + ... + I_{N-1})$. Importances come in
   any unit, 1e-300 or 1e300, so they are divided by the largest before they are added. Cells below 1e-300 of the
   whole are dark: no chain enters them while there is anything else, and one that starts there is refused, as
   metro_chain_start_point refuses it. Their rows and columns of the matrix stay 0. */

static metro_result metroi_operator_stationary(const double *importance, size_t cells, double *stationary)
{
    metro_sum sum = { 0, 0 };
    double largest = 0;
    size_t i;
    for (i = 0; i < cells; i++) {
        if (!(importance[i] >= 0) || isinf(importance[i])) return METRO_ERROR_ARGUMENT;
        if (importance[i] > largest) largest = importance[i];
    }
    if (!(largest > 0)) return METRO_ERROR_NO_IMPORTANCE;
    for (i = 0; i < cells; i++) metro_sum_add(&sum, importance[i] / largest);
    for (i = 0; i < cells; i++) {
        stationary[i] = importance[i] / largest / metro_sum_value(&sum);
        if (stationary[i] < 1e-300) stationary[i] = 0;
    }
    return METRO_OK;
}

/* A move is a proposal and its acceptance; what is rejected stays:

       P_{ij} = w_{j-i} min(1, frac{I_j}{I_i}) "for" j != i,    P_{ii} = w_0 + r_i                           (6.3)

       r_i = sum_{j != i} w_{j-i} (1 - min(1, frac{I_j}{I_i}))                                               (6.4)

   $r_i$ counts rejections only. The chain also stays in its cell when it accepts a proposal from there, which is
   $w_0$ and says more about the grid than about the chain. Since w is even and $I_i min(1, I_j/I_i) = min(I_i, I_j)$
   does not change when i and j trade places,

       pi_i P_{ij} = pi_j P_{ji}                                                                             (6.5)

   This is detailed balance, and everything below leans on it. */

static void metroi_operator_row(metro_operator *op, const double *importance, const double *weight, size_t i)
{
    double *row = op->transition + i * op->cells, rejected = 0;
    size_t j;
    for (j = 0; j < op->cells; j++) {
        double w = weight[j > i ? j - i : i - j], accepted = 0;
        if (op->stationary[j] > 0) accepted = importance[j] < importance[i] ? importance[j] / importance[i] : 1.0;
        row[j] = w * accepted; /* eq 6.3 */
        rejected += w * (1.0 - accepted); /* eq 6.4 */
    }
    row[i] += rejected;
    op->rejection[i] = rejected;
}

/* Zeroed room for matrices and vectors in one block, or NULL. */
static double *metroi_operator_memory(size_t cells, size_t matrices, size_t vectors)
{
    size_t count, i;
    double *memory;
    if (cells == 0 || cells > SIZE_MAX / sizeof *memory / (matrices + vectors) / cells) return NULL;
    count = cells * (cells * matrices + vectors);
    memory = (double *)METRO_MALLOC(count * sizeof *memory);
    for (i = 0; memory != NULL && i < count; i++) memory[i] = 0;
    return memory;
}

METRO_API metro_result metro_operator_make(const metro_kernel *kernel, const double *importance, size_t cells,
                                           metro_operator *op)
{
    metro_operator made;
    metro_result result;
    double *weight, rejected = 0;
    size_t i;
    if (!metroi_kernel_valid(kernel) || kernel->shape != METRO_UNIFORM || cells == 0) return METRO_ERROR_ARGUMENT;
    made.transition = metroi_operator_memory(cells, 1, 3);
    if (made.transition == NULL) return METRO_ERROR_MEMORY;
    made.cells = cells;
    made.stationary = made.transition + cells * cells;
    made.rejection = made.stationary + cells;
    weight = made.rejection + cells;
    result = metroi_operator_stationary(importance, cells, made.stationary);
    if (result != METRO_OK) {
        METRO_FREE(made.transition);
        return result;
    }
    metroi_operator_weights(kernel, cells, weight);
    for (i = 0; i < cells; i++) {
        made.rejection[i] = METROI_NAN;
        if (!(made.stationary[i] > 0)) continue;
        metroi_operator_row(&made, importance, weight, i);
        rejected += made.stationary[i] * made.rejection[i];
    }
    made.acceptance = 1.0 - rejected;
    *op = made;
    return METRO_OK;
}

static size_t metroi_operator_lit(const metro_operator *op)
{
    size_t i, lit = 0;
    for (i = 0; i < op->cells; i++) lit += op->stationary[i] > 0;
    return lit;
}

METRO_API void metro_operator_free(metro_operator *op)
{
    METRO_FREE(op->transition);
    memset(op, 0, sizeof *op);
}

/* # 6.2 What the seed leaves behind

   A distribution over the cells is a row of numbers, and a step multiplies it by the matrix:

       p_n = p_{n-1} P = p_0 P^n                                                                             (6.6)

   A seed in cell i is $p_0 = 1$ there and 0 elsewhere. It helps to look at $h_n = p_n / pi$, which says how many
   times too often the chain is found in a cell. By eq 6.5 it evolves from the other side of the same matrix, like an
   expectation:

       h_n(i) = frac{p_n(i)}{pi_i} = sum_{j} P_{ij} h_{n-1}(j)                                               (6.7)

   Rows of P sum to 1, so a step replaces each ratio by a mean of ratios around it: it smooths, until all are 1. In a
   cell that rejects nearly everything the mean is mostly of itself, and little happens. The second form also means
   that one function moves distributions here and expectations in section 6.5.

   The smallest example has two cells with importances 1 and 3 and independent proposals, Delta = 1. From the dim cell
   every proposal is accepted; from the bright one half of them go to the dim cell, and a third of these are accepted:

                 to dim  to bright
       dim         1/2      1/2
       bright      1/6      5/6

   In equilibrium the chain is bright 3/4 of the time. After a start in the dim cell it is dim with the probability
   $1/4 + (3/4) 3^{-n}$, after a start in the bright one with $1/4 - (1/4) 3^{-n}$: what a seed leaves behind shrinks
   to a third in each step, whichever seed it was, and the dim one leaves three times as much.

   All of the arithmetic is in these three functions. Four terms at a time keep the adders of a processor busy, and
   small sizes have many zeros to skip. */

static void metroi_matrix_add_product(const double *a, const double *b, size_t n, double *out)
{
    size_t i, j, k;
    for (i = 0; i < n; i++) {
        double *to = out + i * n;
        for (k = 0; k + 4 <= n; k += 4) {
            const double *factor = a + i * n + k, *b0 = b + k * n, *b1 = b0 + n, *b2 = b1 + n, *b3 = b2 + n;
            double f0 = factor[0], f1 = factor[1], f2 = factor[2], f3 = factor[3];
            if (f0 == 0 && f1 == 0 && f2 == 0 && f3 == 0) continue;
            for (j = 0; j < n; j++) to[j] += (f0 * b0[j] + f1 * b1[j]) + (f2 * b2[j] + f3 * b3[j]);
        }
        for (; k < n; k++)
            for (j = 0; j < n; j++) to[j] += a[i * n + k] * b[k * n + j];
    }
}

static double metroi_matrix_dot(const double *a, const double *b, size_t n)
{
    double s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    size_t i;
    for (i = 0; i + 4 <= n; i += 4) {
        s0 += a[i] * b[i];
        s1 += a[i + 1] * b[i + 1];
        s2 += a[i + 2] * b[i + 2];
        s3 += a[i + 3] * b[i + 3];
    }
    for (; i < n; i++) s0 += a[i] * b[i];
    return (s0 + s1) + (s2 + s3);
}

static void metroi_matrix_apply(const double *a, const double *x, size_t n, double *out)
{
    size_t i;
    for (i = 0; i < n; i++) out[i] = metroi_matrix_dot(a + i * n, x, n);
}

/* For many steps squaring is cheaper: $P^2$, $P^4$, $P^8$ reach 2^63 steps in 63 products. Each squaring also doubles
   what rounding has done to the sum of a row, so the sums are put right each time. No entry is negative and nothing
   is subtracted, so even the smallest probabilities keep their digits. */

static void metroi_power_double(double **power, double **spare, size_t n)
{
    double *square = *spare;
    size_t i, j;
    memset(square, 0, n * n * sizeof *square);
    metroi_matrix_add_product(*power, *power, n, square);
    for (i = 0; i < n; i++) {
        double sum = 0;
        for (j = 0; j < n; j++) sum += square[i * n + j];
        for (j = 0; j < n && sum > 0; j++) square[i * n + j] /= sum;
    }
    *spare = *power;
    *power = square;
}

/* A squaring costs as much as moving a vector n times, and halves the steps that are left. So it pays while more than
   2 n are left. `x` holds `vectors` columns one after the other. */

static metro_result metroi_operator_advance(const metro_operator *op, uint64_t steps, double *x, size_t vectors)
{
    size_t n = op->cells, v;
    double *memory = metroi_operator_memory(n, 2, 1), *power = memory, *spare, *moved;
    if (memory == NULL) return METRO_ERROR_MEMORY;
    spare = power + n * n;
    moved = spare + n * n;
    memcpy(power, op->transition, n * n * sizeof *power);
    while (steps > 0) {
        int doubles = steps > 2 * (uint64_t)n;
        for (v = 0; v < vectors && (!doubles || steps % 2 == 1); v++) {
            metroi_matrix_apply(power, x + v * n, n, moved); /* eq 6.7 */
            memcpy(x + v * n, moved, n * sizeof *moved);
        }
        if (doubles) metroi_power_double(&power, &spare, n);
        steps = doubles ? steps / 2 : steps - 1;
    }
    METRO_FREE(memory);
    return METRO_OK;
}

METRO_API metro_result metro_operator_evolve(const metro_operator *op, uint64_t steps, double *mass)
{
    size_t n = op->cells, i;
    double *ratio;
    metro_result result;
    for (i = 0; i < n; i++) {
        if (!(mass[i] >= 0) || isinf(mass[i])) return METRO_ERROR_ARGUMENT;
        if (mass[i] > 0 && !(op->stationary[i] > 0)) return METRO_ERROR_DARK_SEED;
    }
    if (steps == 0) return METRO_OK;
    ratio = metroi_operator_memory(n, 0, 1);
    if (ratio == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < n; i++) ratio[i] = mass[i] > 0 ? mass[i] / op->stationary[i] : 0;
    result = metroi_operator_advance(op, steps, ratio, 1); /* eq 6.6 as eq 6.7 */
    for (i = 0; i < n && result == METRO_OK; i++) mass[i] = ratio[i] * op->stationary[i];
    METRO_FREE(ratio);
    return result;
}

/* # 6.3 Distances, and the atom of rejections

   How far is p_n from equilibrium? The norm of paper (10) is the root of the mean square of the density's error, and
   the density of a cell is $N p_i$. Weighted by 1/pi it becomes the natural distance of a chain that obeys eq 6.5,
   since the modes of section 6.4 are then perpendicular:

       chi^2 = sum_{i} frac{(p_i - pi_i)^2}{pi_i}                                                            (6.8)

       "TV" = frac{1}{2} sum_{i} abs(p_i - pi_i)                                                             (6.9)

       "KL" = sum_{i} p_i ln frac{p_i}{pi_i} = sum_{i} pi_i [(1 + u_i) ln(1 + u_i) - u_i],
       u_i = frac{p_i - pi_i}{pi_i}                                                                          (6.10)

   The total variation TV is the largest error in the probability of any set whatever. The second form of the
   divergence adds only positive terms; the first one loses everything to cancellation when p is near pi. For small u
   the bracket is $u^2/2 - u^3/6 + u^4/12 - ...$, the phi of eq 5.61. */

METRO_API metro_distance metro_operator_distance(const metro_operator *op, const double *mass)
{
    metro_sum total = { 0, 0 }, square = { 0, 0 }, chi = { 0, 0 }, variation = { 0, 0 }, divergence = { 0, 0 };
    metro_distance distance = { METROI_NAN, METROI_NAN, METROI_NAN, METROI_NAN };
    size_t i;
    for (i = 0; i < op->cells; i++) {
        double pi = op->stationary[i], off = mass[i] - pi;
        int dark = !(pi > 0);
        if (!(mass[i] >= 0) || isinf(mass[i])) return distance;
        metro_sum_add(&total, mass[i]);
        metro_sum_add(&square, off * off);
        metro_sum_add(&variation, fabs(off)); /* eq 6.9 */
        if (dark && !(mass[i] > 0)) continue;
        metro_sum_add(&chi, dark ? METROI_INFINITY : off / pi * off); /* eq 6.8 */
        metro_sum_add(&divergence, dark ? METROI_INFINITY : pi * metroi_divergence_phi(off / pi)); /* eq 6.10 */
    }
    if (!(fabs(metro_sum_value(&total) - 1.0) <= 1e-9)) return distance;
    distance.l2 = sqrt((double)op->cells * metro_sum_value(&square));
    distance.chi = sqrt(metro_sum_value(&chi));
    distance.total_variation = 0.5 * metro_sum_value(&variation);
    distance.divergence = metro_sum_value(&divergence);
    return distance;
}

/* Which of them to trust? On a grid of N cells, all look fine. But a chain whose first n proposals were all rejected
   is still exactly at its seed, and that has the probability

       r(x_0)^n                                                                                              (6.11)

   however fine the grid is: beside a smooth part p_n has an atom there. The square of a delta function has no
   integral. In our sums the atom is one cell with the mass r^n, its density is $N r^n$, and its part of the squared
   L2 error is $N r^{2n}$: the error that we compute for that norm grows like sqrt(N), and would be infinite on the
   true circle. Constant importance knows nothing of this, because there r is 0; it is why paper (12) is finite from n
   = 1. TV stays finite, and counts the atom as what it is, a probability. So for an importance that rejects, quote
   TV; L2 and chi are for comparison on one grid. */

METRO_API double metro_operator_atom(const metro_operator *op, size_t cell, uint64_t steps)
{
    return cell < op->cells ? pow(op->rejection[cell], (double)steps) : METROI_NAN; /* eq 6.11 */
}

/* # 6.4 The spectrum

   In Fourier's terms each harmonic of p_n shrinks by its own factor $P*(k)$ a step. Detailed balance gives every
   importance such harmonics. Multiply eq 6.5 out: the matrix

       S_{ij} = sqrt{pi_i} P_{ij} frac{1}{sqrt{pi_j}} = sqrt{P_{ij} P_{ji}}                                  (6.12)

   is symmetric, so it has real eigenvalues $1 = lambda_1 >= lambda_2 >= ... >= -1$ and perpendicular eigenvectors
   $v_k$, of which the first is sqrt(pi). With $phi_k = v_k / sqrt{pi}$ a seed in cell i leaves

       frac{p_n(j)}{pi_j} = 1 + sum_{k=2}^{N} lambda_k^n phi_k(i) phi_k(j)                                   (6.13)

   and for large n the second term is what remains: $phi_2$ has the shape of what the seed leaves behind, and
   $phi_2(i)$ says how much of it the seed in cell i leaves. The gap $1 - lambda_2$ is the rate at which it fades. (In
   the example of two cells $lambda_2$ is 1/3.) Two remarks on what it is worth. It never exceeds the probability that
   the chain accepts at the mode, the peak of the importance, since a chain that cannot leave its seed cannot forget
   it. And it is about the worst function on the circle. The picture may not contain that function at all, so a larger
   gap need not mean a smaller error; section 6.7 asks for the error itself.

   Eigenvalues of a symmetric matrix are found in two stages (Golub and Van Loan 1996, algorithms 8.3.1 and 8.3.3).
   Reflections first make it tridiagonal: each turns a column below the diagonal onto one axis. With v of length 1 the
   reflection is 1 - 2 v v^T, and on both sides of the matrix it amounts to A - v w^T - w v^T with w = 2 (A v - (v^T A
   v) v). `q` collects the reflections; its rows end as eigenvectors. */

static double metroi_reflector(const double *a, size_t n, size_t k, double *v)
{
    double length = 0, scale = 0;
    size_t i;
    for (i = k + 1; i < n; i++) length += a[i * n + k] * a[i * n + k];
    length = sqrt(length);
    for (i = k + 1; i < n; i++) v[i] = a[i * n + k];
    v[k + 1] += copysign(length, v[k + 1]);
    for (i = k + 1; i < n; i++) scale += v[i] * v[i];
    for (i = k + 1; i < n; i++) v[i] = scale > 0 ? v[i] / sqrt(scale) : 0;
    return -copysign(length, a[(k + 1) * n + k]);
}

static void metroi_tridiagonalize(double *a, double *q, size_t n, double *diagonal, double *beside, double *v,
                                  double *w)
{
    size_t i, j, k;
    for (k = 0; k + 2 < n; k++) {
        double along = 0;
        size_t rest = n - k - 1;
        beside[k] = metroi_reflector(a, n, k, v);
        /* Reflect what remains of a from both sides. */
        for (i = k + 1; i < n; i++) w[i] = metroi_matrix_dot(a + i * n + k + 1, v + k + 1, rest);
        along = metroi_matrix_dot(v + k + 1, w + k + 1, rest);
        for (i = k + 1; i < n; i++) w[i] = 2.0 * (w[i] - along * v[i]);
        for (i = k + 1; i < n; i++)
            for (j = k + 1; j < n; j++) a[i * n + j] -= v[i] * w[j] + w[i] * v[j];
        /* Reflect q from the left. */
        for (j = 0; j < n; j++) w[j] = 0;
        for (i = k + 1; i < n; i++)
            for (j = 0; j < n; j++) w[j] += v[i] * q[i * n + j];
        for (i = k + 1; i < n; i++)
            for (j = 0; j < n; j++) q[i * n + j] -= 2.0 * v[i] * w[j];
    }
    if (n > 1) beside[n - 2] = a[n * n - 2];
    for (i = 0; i < n; i++) diagonal[i] = a[i * n + i];
}

/* The second stage rotates the tridiagonal matrix in planes (k, k + 1) until nothing is left beside the diagonal. The
   first rotation is aimed by Wilkinson's shift, the eigenvalue of the last 2 by 2 block that is nearer to its last
   element; the others chase the element that it put out of place down to the end. Between `begin` and `end` no
   element beside the diagonal is 0. */

static void metroi_tridiagonal_sweep(double *d, double *e, double *q, size_t n, size_t begin, size_t end)
{
    double half = 0.5 * (d[end - 1] - d[end]), last = e[end - 1];
    double x = d[begin] - d[end] + last * (last / (half + copysign(hypot(half, last), half))), z = e[begin];
    size_t k, j;
    for (k = begin; k < end; k++) {
        double length = hypot(x, z), c = length > 0 ? x / length : 1.0, s = length > 0 ? z / length : 0.0;
        double upper = d[k], lower = d[k + 1], between = e[k], *row = q + k * n, *next = row + n;
        if (k > begin) e[k - 1] = length;
        d[k] = c * c * upper + 2.0 * c * s * between + s * s * lower;
        d[k + 1] = s * s * upper - 2.0 * c * s * between + c * c * lower;
        e[k] = c * s * (lower - upper) + (c * c - s * s) * between;
        x = e[k];
        z = k + 1 < end ? s * e[k + 1] : 0;
        if (k + 1 < end) e[k + 1] *= c;
        for (j = 0; j < n; j++) {
            double a = row[j], b = next[j];
            row[j] = c * a + s * b;
            next[j] = c * b - s * a;
        }
    }
}

/* An element beside the diagonal counts as 0 when it cannot change its neighbours. Each eigenvalue takes two or three
   sweeps; 60 for each are never used up by numbers, but NaN would turn here for ever. Returns 0 then. */

static int metroi_tridiagonal_solve(double *d, double *e, double *q, size_t n)
{
    size_t end = n - 1, begin, sweeps = 0;
    while (end > 0) {
        for (begin = end; begin > 0; begin--)
            if (fabs(e[begin - 1]) <= 1.1e-16 * (fabs(d[begin - 1]) + fabs(d[begin]))) break;
        if (begin == end) end--;
        else metroi_tridiagonal_sweep(d, e, q, n, begin, end);
        if (begin < end && sweeps++ > 60 * n) return 0;
    }
    return isfinite(d[0]) != 0;
}

/* The interesting eigenvalue lies next to 1, and the gap is a difference from 1: two islands with a gap of 1e-6 keep
   ten digits of it, and with 1e-17 none. So we never form it as a difference. First, we solve for 1 - S, and move the
   eigenvalue 0 of sqrt(pi) out of the way, to 3, beyond all others. The least eigenvalue that remains is the gap, as
   well as its neighbours allow; its eigenvector v gives it again, as a sum of squares,

       "gap" = sum_{i < j} pi_i P_{ij} (phi(i) - phi(j))^2
           = sum_{i < j} (sqrt{P_{ij}} v_i - sqrt{P_{ji}} v_j)^2                                             (6.14)

   in which nothing cancels but neighbours that really are alike, and where an error of the eigenvector enters
   squared. This is Dirichlet's form: what a step smooths away of phi. The gap is its least value over all phi of mean
   0 and mean square 1, so any function that one can think of bounds the gap from above: put phi = 1 on one island and
   -1 on the other, and only the moves across count.

   On three islands or more several gaps are as small, and the solver, to which all of them are 0 but for rounding,
   may return any mixture of their eigenvectors. But the space that those span together is right. In it we look for
   the least value of the form anew: the forms of two vectors, with the product of two differences for the square of
   eq 6.14, are a small matrix, again with all its digits, and Jacobi's rotations (Golub and Van Loan 1996, section
   8.4) make it diagonal. An eigenvector that is farther than D from v_2 leaves an error of (1e-15)^2/D; so all within
   1e-16/gap take part, but none beyond 1e-3. */

/* The root of P_ij, where i and j count the lit cells. */
static double metroi_transition_root(const metro_operator *op, const size_t *lit, size_t i, size_t j)
{
    return sqrt(op->transition[lit[i] * op->cells + lit[j]]);
}

static double metroi_dirichlet_form(const metro_operator *op, const size_t *lit, size_t n, const double *u,
                                    const double *v)
{
    metro_sum sum = { 0, 0 };
    size_t i, j;
    for (i = 0; i < n; i++)
        for (j = i + 1; j < n; j++) {
            double there = metroi_transition_root(op, lit, i, j), back = metroi_transition_root(op, lit, j, i);
            metro_sum_add(&sum, (there * u[i] - back * u[j]) * (there * v[i] - back * v[j])); /* eq 6.14 */
        }
    return metro_sum_value(&sum);
}

/* Brings the rows of q to the front whose d is at most `bound`; returns how many they are. */
static size_t metroi_spectrum_gather(double *d, double *q, size_t n, double bound)
{
    size_t count = 0, i, j;
    double t;
    for (i = 0; i < n; i++) {
        if (!(d[i] <= bound)) continue;
        for (j = 0; j < n; j++) {
            t = q[i * n + j];
            q[i * n + j] = q[count * n + j];
            q[count * n + j] = t;
        }
        d[i] = d[count++];
    }
    return count;
}

/* Turns the rows x and y of q so that the element (x, y) of the matrix of their forms, m by m, becomes 0. */
static void metroi_spectrum_turn(double *form, size_t m, double *q, size_t n, size_t x, size_t y)
{
    double tau = (form[y * m + y] - form[x * m + x]) / (2 * form[x * m + y]);
    double t = copysign(1 / (fabs(tau) + hypot(1, tau)), tau), c = 1 / hypot(1, t), s = t * c, a, b;
    size_t k;
    for (k = 0; k < n; k++) {
        a = q[x * n + k];
        b = q[y * n + k];
        q[x * n + k] = c * a - s * b;
        q[y * n + k] = s * a + c * b;
    }
    a = t * form[x * m + y];
    form[x * m + x] -= a;
    form[y * m + y] += a;
    for (k = 0; k < m; k++) {
        if (k == x || k == y) continue;
        a = form[x * m + k];
        b = form[y * m + k];
        form[x * m + k] = form[k * m + x] = c * a - s * b;
        form[y * m + k] = form[k * m + y] = s * a + c * b;
    }
    form[x * m + y] = form[y * m + x] = 0;
}

/* Separates the first m rows of q; returns the row whose form is least. 30 rounds are never used up. */
static size_t metroi_spectrum_separate(const metro_operator *op, const size_t *lit, size_t n, double *q, double *form,
                                       size_t m)
{
    size_t x, y, round, turned = 1, least = 0;
    for (x = 0; x < m; x++)
        for (y = x; y < m; y++)
            form[x * m + y] = form[y * m + x] = metroi_dirichlet_form(op, lit, n, q + x * n, q + y * n);
    for (round = 0; round < 30 && turned > 0; round++)
        for (turned = x = 0; x < m; x++)
            for (y = x + 1; y < m; y++) {
                double small = 1e-17 * sqrt(form[x * m + x]) * sqrt(form[y * m + y]);
                if (!(fabs(form[x * m + y]) > small)) continue;
                metroi_spectrum_turn(form, m, q, n, x, y);
                turned++;
            }
    for (x = 1; x < m; x++)
        if (form[x * m + x] < form[least * m + least]) least = x;
    return least;
}

/* 1 - S over the cells that are not dark, and sqrt(pi) moved to 3. */
static void metroi_spectrum_matrix(const metro_operator *op, const size_t *lit, size_t n, double *a, double *q)
{
    size_t i, j;
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) {
            double there = metroi_transition_root(op, lit, i, j), back = metroi_transition_root(op, lit, j, i);
            q[i * n + j] = i == j ? 1.0 : 0.0;
            a[i * n + j] = q[i * n + j] - there * back; /* eq 6.12 */
            a[i * n + j] += 3.0 * sqrt(op->stationary[lit[i]]) * sqrt(op->stationary[lit[j]]);
        }
}

/* Sorts 1 - d into falling order behind the 1 that belongs to the largest d, and returns the row of the least d. */
static size_t metroi_spectrum_sort(const double *d, size_t n, double *eigenvalue)
{
    size_t largest = 0, least = 0, i, j, count = 1;
    for (i = 1; i < n; i++) {
        if (d[i] > d[largest]) largest = i;
        if (d[i] < d[least]) least = i;
    }
    eigenvalue[0] = 1.0;
    for (i = 0; i < n; i++) {
        if (i == largest) continue;
        for (j = count++; j > 1 && eigenvalue[j - 1] < 1.0 - d[i]; j--) eigenvalue[j] = eigenvalue[j - 1];
        eigenvalue[j] = 1.0 - d[i];
    }
    return least;
}

static void metroi_spectrum_report(const metro_operator *op, const size_t *lit, size_t n, const double *sorted,
                                   const double *v, double *eigenvalue, double *slowest, metro_spectrum *spectrum)
{
    size_t i;
    spectrum->gap = n > 1 ? metroi_dirichlet_form(op, lit, n, v, v) : METROI_NAN;
    spectrum->second = 1.0 - spectrum->gap;
    spectrum->least = n > 1 ? sorted[n - 1] : METROI_NAN;
    for (i = 0; i < op->cells; i++) {
        if (eigenvalue != NULL) eigenvalue[i] = i >= n ? METROI_NAN : i == 1 ? spectrum->second : sorted[i];
        if (slowest != NULL) slowest[i] = METROI_NAN;
    }
    for (i = 0; slowest != NULL && n > 1 && i < n; i++) /* eq 6.13 */
        slowest[lit[i]] = v[i] / sqrt(op->stationary[lit[i]]);
}

static metro_result metroi_spectrum_compute(const metro_operator *op, const size_t *lit, size_t n, double *memory,
                                            double *eigenvalue, double *slowest, metro_spectrum *spectrum)
{
    double *a = memory, *q = a + n * n, *d = q + n * n, *sorted = d + 4 * n, gap;
    size_t row, many;
    metroi_spectrum_matrix(op, lit, n, a, q);
    metroi_tridiagonalize(a, q, n, d, d + n, d + 2 * n, d + 3 * n);
    if (!metroi_tridiagonal_solve(d, d + n, q, n)) return METRO_ERROR_ARGUMENT;
    row = metroi_spectrum_sort(d, n, sorted);
    gap = metroi_dirichlet_form(op, lit, n, q + row * n, q + row * n);
    many = metroi_spectrum_gather(d, q, n, d[row] + fmin(1e-3, 1e-16 / gap));
    row = metroi_spectrum_separate(op, lit, n, q, a, many);
    metroi_spectrum_report(op, lit, n, sorted, q + row * n, eigenvalue, slowest, spectrum);
    return METRO_OK;
}

METRO_API metro_result metro_operator_spectrum(const metro_operator *op, double *eigenvalue, double *slowest,
                                               metro_spectrum *spectrum)
{
    size_t n = 0, i, *lit = (size_t *)METRO_MALLOC(op->cells * sizeof *lit);
    double *memory = metroi_operator_memory(op->cells, 2, 5);
    metro_result result = METRO_ERROR_MEMORY;
    if (memory != NULL && lit != NULL) {
        for (i = 0; i < op->cells; i++)
            if (op->stationary[i] > 0) lit[n++] = i;
        result = metroi_spectrum_compute(op, lit, n, memory, eigenvalue, slowest, spectrum);
    }
    METRO_FREE(memory);
    METRO_FREE(lit);
    return result;
}

/* # 6.5 The error of a run, for every seed

   A picture is not made of p_n but of all samples so far. Let f be the integrand in each cell and $g = f - pi(f)$ its
   deviation from the true mean. A run of m samples from the seed has the error $(g(z_0) + ... + g(z_{m-1})) / m$. Let
   U be the mean of this sum and V the mean of its square, both as functions of the seed. One sample more in front
   gives

       U_{m+1} = g + P U_m                                                                                   (6.15)

       V_{m+1} = g^2 + 2 g P U_m + P V_m                                                                     (6.16)

   from $U_0 = V_0 = 0$: the first sample adds g, then the chain moves and the rest of the run begins there. The bias
   is U/m, the mean squared error V/m^2, and what bias^2 leaves of it is the variance: exactly, for all seeds at once,
   with no eigenvalues and no random numbers. A burn-in of b steps means that the run begins after b moves: P^b U and
   P^b V.

   Instead of one sample, put a block of `a` samples in front. The sum over the block and the sum over what follows
   are correlated, because the one ends where the other begins. $C_a$ carries that: applied to a function of the end
   of the block it gives the mean of the product with the block's sum:

       U_{a+m} = U_a + P^a U_m                                                                               (6.17)

       V_{a+m} = V_a + 2 C_a U_m + P^a V_m,    C_a = sum_{i=0}^{a-1} P^i G P^{a-i}                           (6.18)

   with g on the diagonal of G. For a = 1 this is eq 6.15 and eq 6.16. And blocks can be doubled:

       C_{2a} = C_a P^a + P^a C_a                                                                            (6.19)

   so that a run of 2^63 samples costs three products of matrices for each of 63 doublings. */

typedef struct {
    size_t n;
    double *power, *cross, *spare; /* P^a, C_a and room for the next one */
    double *sum, *square;          /* U_a and V_a of a block */
    double *step[3];               /* what a block in front makes of the rest */
    double *last;                  /* V before the last block */
} metroi_run;

/* The block of one sample. The mean of f is taken relative to one of its values, so that a constant f has no error at
   all. */
static void metroi_run_begin(metroi_run *run, const metro_operator *op, const double *f, double *memory)
{
    size_t n = op->cells, lit = 0, i, j;
    metro_sum mean = { 0, 0 };
    run->n = n;
    run->power = memory;
    run->cross = memory + n * n;
    run->spare = memory + 2 * n * n;
    run->sum = memory + 3 * n * n;
    run->square = run->sum + n;
    run->last = run->square + n;
    for (i = 0; i < 3; i++) run->step[i] = run->last + (i + 1) * n;
    while (lit + 1 < n && !(op->stationary[lit] > 0)) lit++;
    for (i = 0; i < n; i++)
        if (op->stationary[i] > 0) metro_sum_add(&mean, op->stationary[i] * (f[i] - f[lit]));
    for (i = 0; i < n; i++) {
        double g = op->stationary[i] > 0 ? f[i] - f[lit] - metro_sum_value(&mean) : 0;
        run->sum[i] = g;
        run->square[i] = g * g;
        for (j = 0; j < n; j++) {
            run->power[i * n + j] = op->transition[i * n + j];
            run->cross[i * n + j] = g * op->transition[i * n + j];
        }
    }
}

/* Puts a block in front of the run whose U and V are given; `sum` may be that of the block itself. */
static void metroi_run_prepend(metroi_run *run, double *sum, double *square)
{
    size_t n = run->n, i;
    metroi_matrix_apply(run->power, sum, n, run->step[0]);
    metroi_matrix_apply(run->cross, sum, n, run->step[1]);
    metroi_matrix_apply(run->power, square, n, run->step[2]);
    for (i = 0; i < n; i++) {
        sum[i] = run->sum[i] + run->step[0][i]; /* eq 6.17, and eq 6.15 for a block of one */
        square[i] = run->square[i] + 2.0 * run->step[1][i] + run->step[2][i]; /* eq 6.18, and eq 6.16 */
    }
}

static void metroi_run_double(metroi_run *run)
{
    size_t n = run->n;
    double *cross = run->spare;
    metroi_run_prepend(run, run->sum, run->square);
    memset(cross, 0, n * n * sizeof *cross);
    metroi_matrix_add_product(run->cross, run->power, n, cross); /* eq 6.19 */
    metroi_matrix_add_product(run->power, run->cross, n, cross);
    run->spare = run->cross;
    run->cross = cross;
    metroi_power_double(&run->power, &run->spare, n);
}

/* Most chains need no 63 doublings. Once every row of $P^a$ is pi, to 13 digits, the end of a block says nothing
   about its beginning. Then all further blocks add the same:

       V_{2a+m} - V_{a+m} = V_{3a+m} - V_{2a+m}                                                              (6.20)

   for every seed. Only the first block in front still sees how the run behind it ends. */

static int metroi_run_settled(const metroi_run *run, const double *stationary)
{
    size_t i, j, n = run->n;
    for (i = 0; i < n; i++) {
        double distance = 0;
        for (j = 0; j < n && stationary[i] > 0; j++) distance += fabs(run->power[i * n + j] - stationary[j]);
        if (!(distance < 1e-13)) return 0;
    }
    return 1;
}

/* Section 6.7 compares many runs and wants only the best one, so a run may be given up when its error is sure to be
   large. In equilibrium the mode of eigenvalue lambda adds to M times the mean squared error, the cost of a sample so
   to speak, 1 plus twice the sum of $(1 - k/M) lambda^k$ over k = 1 .. M - 1. That grows with M where lambda is
   positive, and lies between 0 and 1 where it is negative. So what a block of a <= M samples costs bounds what the
   run will:

       frac{pi(V_M)}{M} >= frac{pi(V_a)}{a} - pi(g^2)                                                        (6.21) */

static double metroi_run_cost(const metroi_run *run, const double *seeds, double samples)
{
    return metroi_matrix_dot(seeds, run->square, run->n) / samples;
}

/* U and V of the whole run in `sum` and `square`, which arrive zeroed. Returns 0 if it was given up: with `seeds`,
   the probability of each seed, when a sample costs more than `enough` both from them and, for sure, in
   equilibrium. */
static int metroi_run_steps(metroi_run *run, const double *stationary, uint64_t steps, const double *seeds,
                            double enough, double *sum, double *square)
{
    int settled = metroi_run_settled(run, stationary);
    double samples = 1.0, spread = metroi_run_cost(run, stationary, 1.0);
    uint64_t done = 0;
    size_t i;
    /* A doubling costs as much as n blocks in front, and saves half of them. */
    while (steps > 2 * (uint64_t)run->n && !settled) {
        if (steps % 2 == 1) metroi_run_prepend(run, sum, square);
        metroi_run_double(run);
        steps /= 2;
        samples *= 2.0;
        if (seeds != NULL && metroi_run_cost(run, seeds, samples) > enough &&
            metroi_run_cost(run, stationary, samples) - spread > enough) /* eq 6.21 */
            return 0;
        settled = metroi_run_settled(run, stationary);
    }
    for (; done < steps && !(settled && done == 2); done++) {
        memcpy(run->last, square, run->n * sizeof *square);
        metroi_run_prepend(run, sum, square);
    }
    for (i = 0; i < run->n; i++) square[i] += (double)(steps - done) * (square[i] - run->last[i]); /* eq 6.20 */
    return 1;
}

static metro_operator_error metroi_run_mean(const metro_operator *op, const double *sum, const double *square,
                                            double steps)
{
    metro_operator_error mean = { 0, 0, 0 };
    size_t lit = metroi_operator_lit(op), i;
    for (i = 0; i < op->cells; i++) {
        double bias = sum[i] / steps, mse = square[i] / steps / steps;
        if (!(op->stationary[i] > 0)) continue;
        mean.bias2 += bias * bias;
        mean.mse += mse;
        mean.stationary += op->stationary[i] * mse;
    }
    mean.bias2 /= (double)lit;
    mean.mse /= (double)lit;
    return mean;
}

/* Everything but the checks; a run that was given up has infinite means. */
static metro_result metroi_run_compute(const metro_operator *op, const double *f, uint64_t burn, uint64_t steps,
                                       const double *seeds, double enough, double *bias, double *mse,
                                       metro_operator_error *mean)
{
    metroi_run run;
    size_t n = op->cells, i;
    double *memory = metroi_operator_memory(n, 3, 8), *sum, *square, m = (double)steps;
    metro_result result = METRO_OK;
    if (memory == NULL) return METRO_ERROR_MEMORY;
    metroi_run_begin(&run, op, f, memory);
    sum = run.step[2] + n;
    square = sum + n;
    if (!metroi_run_steps(&run, op->stationary, steps, seeds, enough, sum, square)) {
        for (i = 0; i < n; i++) sum[i] = square[i] = METROI_INFINITY;
    } else if (burn > 0) result = metroi_operator_advance(op, burn, sum, 2);
    if (result == METRO_OK && mean != NULL) *mean = metroi_run_mean(op, sum, square, m);
    for (i = 0; i < n && result == METRO_OK; i++) {
        int dark = !(op->stationary[i] > 0);
        if (bias != NULL) bias[i] = dark ? METROI_NAN : sum[i] / m;
        if (mse != NULL) mse[i] = dark ? METROI_NAN : square[i] / m / m;
    }
    METRO_FREE(memory);
    return result;
}

METRO_API metro_result metro_operator_run(const metro_operator *op, const double *f, uint64_t burn, uint64_t steps,
                                          double *bias, double *mse, metro_operator_error *mean)
{
    size_t i;
    for (i = 0; i < op->cells; i++)
        if (!isfinite(f[i])) return METRO_ERROR_ARGUMENT;
    if (steps == 0) return METRO_ERROR_ARGUMENT;
    return metroi_run_compute(op, f, burn, steps, NULL, 0, bias, mse, mean);
}

/* # 6.6 The exponential

   The paper ends with a hint: to leave constant importance behind, "a Laplace transform method is considered on an
   exponential integrand". Here it is. Let $I(x) = e^{-lambda x}$ on the line. The ratio of two importances depends on
   the distance alone, so the step is the same everywhere: half of the proposals go uphill and are accepted, the other
   half go down by t and are accepted with probability $e^{-lambda t}$. A law of steps that does not depend on the
   place is a convolution after all, and the transform that fits a one-sided exponential is Laplace's. Each step
   multiplies it by

       phi(s) = r + frac{1}{Delta} [frac{e^{s Delta/2} - 1}{s}
              + frac{1 - e^{-(lambda + s) Delta/2}}{lambda + s}]                                             (6.22)

       r = frac{1}{2} - frac{1 - e^{-lambda Delta/2}}{lambda Delta}                                          (6.23)

   where r is the probability of rejection, so that $phi(0) = 1$. From the seed x_0 the transform of p_n is $phi(s)^n
   e^{-s x_0}$ as long as no path can have met a border, that is for the first 2 x_0 / Delta steps. All of it is made
   of one function, $A(x) = (e^x - 1)/x$, of which the C library has the stable half: the bracket is Delta/2 times
   $A(s Delta/2) + A(-(lambda + s) Delta/2)$, and $r = (1 - A(-lambda Delta/2))/2$. */

static double metroi_exponential_mean(double x)
{
    if (x == 0) return 1.0;
    return isinf(x) ? (x > 0 ? x : 0) : expm1(x) / x;
}

static int metroi_exponential_valid(double lambda, double size)
{
    return lambda > 0 && size > 0 && isfinite(lambda) && isfinite(size);
}

/* 1 - A(-v) = v/2 - v^2/6 + v^3/24 - ..., by the series where the difference would cancel. */
METRO_API double metro_exponential_rejection(double lambda, double size)
{
    double v = 0.5 * lambda * size, term = 1.0, sum = 0, k;
    if (!metroi_exponential_valid(lambda, size)) return METROI_NAN;
    if (v > 0.5) return 0.5 - 0.5 * metroi_exponential_mean(-v); /* eq 6.23 */
    for (k = 2; k <= 16; k++) {
        term *= -v / k;
        sum -= term;
    }
    return 0.5 * sum;
}

METRO_API double metro_exponential_transform(double lambda, double size, double s)
{
    double half = 0.5 * size;
    if (!metroi_exponential_valid(lambda, size) || !isfinite(s)) return METROI_NAN;
    return metro_exponential_rejection(lambda, size) /* eq 6.22 */
         + 0.5 * (metroi_exponential_mean(s * half) + metroi_exponential_mean(-(lambda + s) * half));
}

/* Weighted by sqrt(pi), as in eq 6.12, a wave e^{i omega x} on the line has the eigenvalue $phi(-lambda/2 + i
   omega)$. The largest of them, at omega = 0, is the edge of a continuous spectrum, and no chain on the half line x >
   0 has a larger gap than this edge leaves. Nor can the gap exceed the probability of acceptance at the border, where
   the importance is largest: there half of the proposals fall outside, which a rejecting border refuses and a
   reflecting one turns inward, so

       "gap" <= min(1 - phi(-frac{lambda}{2}), frac{1 - e^{-lambda Delta/2}}{lambda Delta})                  (6.24)

       "gap" <= min(1 - phi(-frac{lambda}{2}), 2 frac{1 - e^{-lambda Delta/2}}{lambda Delta})                (6.25)

   for a rejecting and for a reflecting border. The first bound grows with Delta and the second falls: small steps
   diffuse slowly, large steps are rejected at the peak. They meet at lambda Delta = 4 (2 + W(-2 e^-2)) = 6.37, with
   Lambert's W, and at 9.17: a perturbation several times as wide as the importance's own length 1/lambda. For a small
   $v = lambda Delta/4$ the first one is v^2/6 and lower powers cancel, so there it is summed as $1/(4v)$ times the
   sum over j >= 3 of $(-v)^j (4 - 2^j) / j!$. (These are upper bounds. The gaps of matrices like ours come down to
   them as the line grows longer and the cells finer; that no isolated eigenvalue ever keeps the gap below them is not
   proved.) */

static double metroi_exponential_edge(double v)
{
    double term = 1.0, power = 1.0, sum = 0, j;
    if (v >= 1.0) return 0.5 + 0.5 * metroi_exponential_mean(-2.0 * v) - metroi_exponential_mean(-v);
    if (!(v > 0)) return 0;
    for (j = 1; j <= 30; j++) {
        term *= -v / j;
        power *= 2.0;
        if (j > 2) sum += term * (4.0 - power);
    }
    return sum / (4.0 * v);
}

METRO_API double metro_exponential_gap(double lambda, double size, int reflecting)
{
    double a = lambda * size, edge, border;
    if (!metroi_exponential_valid(lambda, size)) return METROI_NAN;
    edge = metroi_exponential_edge(0.25 * a);
    border = (reflecting ? 1.0 : 0.5) * metroi_exponential_mean(-0.5 * a);
    return edge < border ? edge : border; /* eq 6.24, eq 6.25 */
}

METRO_API double metro_exponential_best_size(double lambda, int reflecting)
{
    if (!(lambda > 0) || !isfinite(lambda)) return METROI_NAN;
    return (reflecting ? 9.17188317468783043 : 6.37449704016016037) / lambda;
}

/* # 6.7 The best size

   "The ultimate goal is to provide estimates for an 'optimal' perturbation size", the paper says last. We can say
   which size has the least error, if we say of what. Let a run of M steps estimate the mean of an integrand f over
   the stationary distribution: how bright a pixel is, say. A chain records the state in which each step ends (chapter
   4), so this is the mean of M samples after a burn-in of one step, $V = P V_M$ in the terms of section 6.5. Its mean
   squared error is

       E_M^2(Delta) = "bias"^2 + "variance" = frac{1}{N} sum_{i} frac{V(i)}{M^2}                             (6.26)

   averaged over seeds drawn uniformly, or taken at the seed that the program will use. Sections 6.1 and 6.5 compute
   this for any size. So we look at the importance in 64 points, one drawn at random in each 64th of the circle; take
   each for its cell; and try sizes. It costs 64 evaluations of an importance that the run itself will evaluate M
   times, and some twenty small matrices, for any M.

   Why not something simpler? The rules of thumb all look at a part of the question, and each has an importance on
   which it fails. The largest gap chases the slowest mode whether f has any of it or not. An acceptance rate of .44,
   which is right for a normal target on a long line (Gelman, Roberts and Gilks 1996), picks a size that stays on its
   island when there are two. The largest mean jump likes big steps and overlooks a narrow peak. The error sees all of
   it, since it is what we want. The tests hold the choice to an efficiency of at least .95: the least error of any
   size, computed on four times as many cells, over the error of the chosen one.

   A program that is about to sample asks first:

       #define METRO_IMPLEMENTATION
       #include "metro.h"

       static double lamps(double x, void *user)
       {
           (void)user;
           return 0.001 + exp(-800 * (x - 0.3) * (x - 0.3)) + 2 * exp(-200 * (x - 0.8) * (x - 0.8));
       }

       int main(void)
       {
           metro_best best;
           metro_result result = metro_best_size(lamps, NULL, 1000, NULL, &best);
           if (result != METRO_OK) puts(metro_result_text(result));
           else printf("size %.2f, predicted error %.1e\n", best.size, sqrt(best.bias2 + best.variance));
           return result != METRO_OK;
       }

   The points are drawn at random so that no feature hides between points of a grid for ever; the integrand is asked
   only where the importance is positive, as the chain would. A value that is negative, infinite or NaN counts as
   dark, because the chain will reject such states, and is reported. A given seed takes the place of the point in its
   cell.

   [figure: operator.svg | Five importances: the exact error against the size of the perturbation, and the sizes that
   three rules choose.] */

enum { METROI_PILOT_POINTS = 64 };

typedef struct {
    double importance[METROI_PILOT_POINTS], integrand[METROI_PILOT_POINTS];
    double seeds[METROI_PILOT_POINTS]; /* the probability of each cell to be the seed's */
    size_t start;  /* the cell of the seed, or METROI_PILOT_POINTS for the mean over seeds */
    size_t refused;
    uint64_t steps;
} metroi_pilot;

/* Asks for the importance, and the integrand, at the point of one cell. */
static metro_result metroi_pilot_point(metroi_pilot *pilot, size_t cell, double x,
                                       double (*importance)(double x, void *user),
                                       double (*integrand)(double x, void *user), void *user)
{
    double value = importance(x, user), f = cell < METROI_PILOT_POINTS / 2 ? 1.0 : 0.0;
    if (!(value >= 0) || isinf(value)) {
        if (cell == pilot->start) return METRO_ERROR_BAD_SEED;
        pilot->refused++;
        value = 0;
    }
    if (cell == pilot->start && !(value > 0)) return METRO_ERROR_DARK_SEED;
    if (integrand != NULL) f = value > 0 ? integrand(x, user) : 0.0;
    pilot->importance[cell] = value;
    pilot->integrand[cell] = f;
    return isfinite(f) ? METRO_OK : METRO_ERROR_ARGUMENT;
}

static metro_result metroi_pilot_survey(metroi_pilot *pilot, const metro_best_options *options,
                                        double (*importance)(double x, void *user), void *user)
{
    metro_rng rng = metro_rng_make(options->seed, 0);
    metro_result result = METRO_OK;
    double n = METROI_PILOT_POINTS, lit = 0;
    size_t cell;
    pilot->start = METROI_PILOT_POINTS;
    if (options->start != NULL) {
        if (!(*options->start >= 0 && *options->start < 1)) return METRO_ERROR_ARGUMENT;
        pilot->start = (size_t)(n * *options->start);
    }
    for (cell = 0; cell < METROI_PILOT_POINTS && result == METRO_OK; cell++) {
        double x = ((double)cell + metro_rng_uniform(&rng)) / n;
        if (cell == pilot->start) x = *options->start;
        result = metroi_pilot_point(pilot, cell, x, importance, options->integrand, user);
        if (pilot->importance[cell] > 0) lit++;
    }
    for (cell = 0; cell < METROI_PILOT_POINTS; cell++) {
        if (pilot->start < METROI_PILOT_POINTS) pilot->seeds[cell] = cell == pilot->start;
        else pilot->seeds[cell] = pilot->importance[cell] > 0 ? 1.0 / lit : 0;
    }
    return result;
}

/* Computes the error that one size makes, and keeps it in `best` if none was smaller. */
static metro_result metroi_pilot_try(const metroi_pilot *pilot, double size, metro_best *best)
{
    double bias[METROI_PILOT_POINTS], mse[METROI_PILOT_POINTS];
    metro_kernel kernel;
    metro_operator op;
    metro_operator_error mean;
    metro_result result;
    double enough = 4.0 * (double)pilot->steps * (best->bias2 + best->variance);
    kernel.shape = METRO_UNIFORM;
    kernel.size = size;
    kernel.size_min = kernel.large = 0;
    result = metro_operator_make(&kernel, pilot->importance, METROI_PILOT_POINTS, &op);
    if (result != METRO_OK) return result;
    result = metroi_run_compute(&op, pilot->integrand, 1, pilot->steps, pilot->seeds, enough, bias, mse,
                                &mean);
    if (result == METRO_OK && pilot->start < METROI_PILOT_POINTS) {
        mean.bias2 = bias[pilot->start] * bias[pilot->start];
        mean.mse = mse[pilot->start];
    }
    if (result == METRO_OK && mean.mse < best->bias2 + best->variance) { /* eq 6.26 */
        best->size = size;
        best->bias2 = mean.bias2;
        best->variance = mean.mse > mean.bias2 ? mean.mse - mean.bias2 : 0;
        best->acceptance = op.acceptance;
        best->lit = metroi_operator_lit(&op);
    }
    metro_operator_free(&op);
    return result;
}

/* As a function of the size the error may have several valleys - one for steps within a peak, one for steps from peak
   to peak - so the search first looks everywhere. Up to half the domain the sizes grow by factors of about 1.5;
   beyond, where islands are as far apart as a step is long, in equal steps. It ends at 2, where proposals are
   independent as they are at 1: sizes beyond 2 only repeat what lies between, with smaller swings. Two rounds of
   halving then close in on the best one. Sizes are tried from the largest to the smallest, so that among equals, as
   when f is constant, the largest wins.

   A size is given up when a sample costs four times what it costs with the best size so far, from the seeds and in
   equilibrium. Equilibrium alone makes it final (eq 6.21), but seeds that start where f happens to have its mean may
   be luckier than equilibrium for long; and the cost from the seeds alone may be that of a slow start, which a long
   run forgets. */

static metro_result metroi_pilot_search(const metroi_pilot *pilot, metro_best *found)
{
    static const double size[] = { 2.0,  1.8,  1.6,  1.4,  1.2, 1.0,   0.8,   0.64, 0.46,
                                   0.32, 0.22, 0.15, 0.10, 0.065, 0.045, 0.03, 0.02 };
    const size_t last = sizeof size / sizeof *size - 1;
    metro_result result = METRO_OK;
    double below = size[last], above = size[0];
    size_t i;
    int round;
    for (i = 0; i <= last && result == METRO_OK; i++) {
        result = metroi_pilot_try(pilot, size[i], found);
        if (found->size == size[i]) {
            above = size[i > 0 ? i - 1 : 0];
            below = size[i < last ? i + 1 : last];
        }
    }
    for (round = 0; round < 2 && result == METRO_OK; round++) {
        double centre = found->size, smaller = 0.5 * (below + centre), larger = 0.5 * (centre + above);
        result = metroi_pilot_try(pilot, smaller, found);
        if (result == METRO_OK) result = metroi_pilot_try(pilot, larger, found);
        below = found->size < centre ? below : found->size > centre ? centre : smaller;
        above = found->size > centre ? above : found->size < centre ? centre : larger;
    }
    return result;
}

METRO_API metro_result metro_best_size(double (*importance)(double x, void *user), void *user, uint64_t steps,
                                       const metro_best_options *options, metro_best *best)
{
    metro_best_options defaults = { NULL, NULL, 0 };
    metro_best found = { 0, 0, 0, 0, 0, 0 };
    metroi_pilot pilot;
    metro_result result;
    if (importance == NULL || steps == 0) return METRO_ERROR_ARGUMENT;
    memset(&pilot, 0, sizeof pilot);
    pilot.steps = steps;
    found.bias2 = METROI_INFINITY;
    result = metroi_pilot_survey(&pilot, options != NULL ? options : &defaults, importance, user);
    if (result == METRO_OK) result = metroi_pilot_search(&pilot, &found);
    if (result != METRO_OK) return result;
    /* No size has a finite error: the square of the integrand is too large for a double. */
    if (!(found.size > 0)) return METRO_ERROR_ARGUMENT;
    /* One point says nothing about errors. */
    if (found.lit < 2) found.bias2 = found.variance = METROI_NAN;
    found.refused = pilot.refused;
    *best = found;
    return METRO_OK;
}

/* # 7 Diagnostics

   A chain hands out numbers whether it has seen its whole space or only a corner of it, and they look the same. This
   chapter asks what they are worth. It has four words for that.

   - tau, the autocorrelation time: so many draws of the chain are worth one independent draw.
   - ESS, the effective sample size: the number of draws over tau, so many independent draws would do as well.
   - MCSE, the Monte Carlo standard error: the standard deviation of the draws over the root of ESS.
   - R-hat: how much chains that started apart still disagree. It is 1 when one cannot tell them apart.

   A fifth number is read more than all of them and belongs to none: the acceptance rate. It is the share of tentative
   states that were taken. A chain whose steps are a thousandth of the domain takes nearly all of them and goes
   nowhere; on a flat importance every size of step is accepted always, the worst and the best. A high rate is no
   merit and a low one no fault, until tau or the squared jump (section 7.9) stands beside it.

   And one warning covers the chapter. Every number below is made from the draws, and the draws know nothing of places
   that no chain has been to. Four chains that started in the same one of two islands of importance agree perfectly:
   R-hat is 1, ESS is large, and half of the integral is missing. Chains must start far apart, farther than the target
   is wide, for their agreement to mean anything. */

/* # 7.1 Numbers and their spread

   Diagnostics are quotients of variances, and a variance suffers twice in floating point. In numbers like 1e8 + noise
   the rounding of a mean is as large as what the noise has to say, so we count from the first draw on, where the
   difference of near numbers is exact. And 1e200 has no square, so draws are divided by a power of two first, which
   brings the largest magnitude into [1/2, 1) and, being a power of two, rounds nothing that a variance could see. */

static int metroi_draws_constant(const double *value, size_t count)
{
    size_t i;
    for (i = 1; i < count; i++)
        if (value[i] != value[0]) return 0;
    return 1;
}

static double metroi_draws_mean(const double *value, size_t count)
{
    metro_sum sum = { 0, 0 };
    size_t i;
    for (i = 0; i < count; i++) metro_sum_add(&sum, value[i] - value[0]);
    return value[0] + metro_sum_value(&sum) / (double)count;
}

/* The unbiased variance; 0, and exactly so, for equal numbers. */
static double metroi_draws_variance(const double *value, size_t count)
{
    double mean = metroi_draws_mean(value, count);
    metro_sum sum = { 0, 0 };
    size_t i;
    for (i = 0; i < count; i++) metro_sum_add(&sum, (value[i] - mean) * (value[i] - mean));
    return count > 1 ? metro_sum_value(&sum) / (double)(count - 1) : METROI_NAN;
}

/* Whether there are draws, and all of them are finite. Infinite draws have ranks, but then they are also a defect
   that somebody should look at. */
static int metroi_draws_usable(const double *draw, size_t chains, size_t draws)
{
    size_t i;
    if (draw == NULL || chains == 0 || draws == 0 || draws > SIZE_MAX / sizeof *draw / 2 / chains) return 0;
    for (i = 0; i < chains * draws; i++)
        if (!isfinite(draw[i])) return 0;
    return 1;
}

/* The distances from the first draw, divided by 2^exponent; NULL when memory runs out. */
static double *metroi_draws_scaled(const double *draw, size_t count, int *exponent)
{
    double *scaled = (double *)METRO_MALLOC(count * sizeof *scaled), largest = 0;
    size_t i;
    if (scaled == NULL) return NULL;
    for (i = 0; i < count; i++) largest = fabs(draw[i]) > largest ? fabs(draw[i]) : largest;
    frexp(largest, exponent);
    for (i = 0; i < count; i++) scaled[i] = ldexp(draw[i], -*exponent) - ldexp(draw[0], -*exponent);
    return scaled;
}

/* A chain that drifts disagrees with itself: its first half lies elsewhere than its second. So every chain is cut
   into halves, and the halves are treated as chains. Of an odd number of draws the one in the middle is left out.
   Returns 2 * chains halves of draws / 2 numbers each, or NULL when memory runs out. */
static double *metroi_draws_halves(const double *value, size_t chains, size_t draws)
{
    size_t length = draws / 2, c;
    double *half = (double *)METRO_MALLOC((2 * chains * length + 1) * sizeof *half);
    if (half == NULL) return NULL;
    for (c = 0; c < chains; c++) {
        memcpy(half + 2 * c * length, value + c * draws, length * sizeof *half);
        memcpy(half + (2 * c + 1) * length, value + c * draws + (draws - length), length * sizeof *half);
    }
    return half;
}

/* # 7.2 Bernstein's formula

   If draws of a stationary chain have variance sigma^2 and the correlation $rho_k$ at lag k, the variance of the mean
   of M of them counts each pair of draws: there are M - k pairs at lag k, and so

       Var(frac{1}{M} sum_{i=1}^{M} f_i) = frac{sigma^2}{M} [1 + 2 sum_{k=1}^{M-1} (1 - frac{k}{M}) rho_k]   (7.1)

   The paper prints the sum (18) up to M and without the factor 1 - k/M. That is close when correlations die long
   before M, and wrong when they do not: for $rho_k = (-1)^k$ and M = 9 eq 7.1 is 1/81, one draw's worth over 81,
   since the draws cancel in pairs and one is left; the printed form has -1/9 under its root. For large M

       Var(frac{1}{M} sum_{i=1}^{M} f_i) -> frac{sigma^2 tau}{M},    tau = 1 + 2 sum_{k=1}^{inf} rho_k       (7.2)

   and this tau is the autocorrelation time: M draws are worth M/tau. For $rho_k = rho^k$ it is (1 + rho)/(1 - rho).
   It is below 1 when neighbours repel each other; and both formulas are about a stationary chain: they say nothing of
   the start-up bias. */

METRO_API double metro_bernstein(const double *rho, size_t lags, uint64_t steps)
{
    metro_sum sum = { 0, 0 };
    size_t k;
    if (rho == NULL || lags == 0 || steps == 0) return METROI_NAN;
    metro_sum_add(&sum, rho[0]);
    for (k = 1; k < lags && k < steps; k++) /* eq 7.1 */
        metro_sum_add(&sum, 2 * ((double)(steps - k) / (double)steps) * rho[k]);
    return metro_sum_value(&sum) / (double)steps;
}

/* # 7.3 Autocorrelation

   From one chain of n draws with mean m the correlation at lag k is estimated by

       rho_k = frac{gamma_k}{gamma_0},    gamma_k = frac{1}{n} sum_{i=1}^{n-k} (f_i - m) (f_{i+k} - m)       (7.3)

   Dividing by n rather than by the number of terms bends far lags towards 0; it also keeps the noise of far lags from
   growing, and its Fourier transform is then never negative, as that of a true autocovariance must be (Priestley
   1981, pages 323 to 324).

   Written out the sums take n^2 steps for all lags. A discrete Fourier transform Z of the deviations, padded with as
   many zeros so that the ends do not meet, gives them all in n log n (the theorem of Wiener and Khinchin):

       n gamma_k = "Re" frac{1}{N} sum_{j=0}^{N-1} abs(Z_j)^2 e^{2 pi i j k / N},    N >= 2 n                (7.4)

   The transform is that of Cooley and Tukey (1965): sort the numbers by the reversed bits of their index, then join
   transforms of length 1 to 2, 2 to 4, and so on to N, a power of two. All cosines and sines stand in one table,
   `wave`, with cos and sin of 2 pi k/N at 2k and 2k + 1. Each is computed, none by recurrence, so errors stay at the
   last digit. */

static void metroi_draws_fourier(double *re, double *im, const double *wave, size_t n)
{
    size_t i, j, bit, half, start;
    for (i = 1, j = 0; i < n; i++) {
        /* Count j up with its bits reversed. */
        for (bit = n >> 1; (j & bit) != 0; bit >>= 1) j ^= bit;
        j |= bit;
        if (i < j) {
            double swap_re = re[i], swap_im = im[i];
            re[i] = re[j];
            im[i] = im[j];
            re[j] = swap_re;
            im[j] = swap_im;
        }
    }
    for (half = 1; half < n; half *= 2)
        for (start = 0; start < n; start += 2 * half)
            for (j = 0; j < half; j++) {
                /* Join term j of two transforms to the terms j and j + half of one. */
                double c = wave[n / half * j], s = wave[n / half * j + 1];
                double x, y;
                i = start + j;
                x = re[i + half] * c + im[i + half] * s;
                y = im[i + half] * c - re[i + half] * s;
                re[i + half] = re[i] - x;
                im[i + half] = im[i] - y;
                re[i] += x;
                im[i] += y;
            }
}

/* The mean over several chains of gamma, each about its own mean. Sums of powers can be transformed back together,
   and the powers of two chains come from one transform, when one rides as the real and the other as the imaginary
   part: the real part of the autocovariance of x + iy is that of x plus that of y. The powers are real, so the way
   back may use the same transform: conjugation changes only the imaginary part. `covariance` has room for `length`
   numbers. Returns 0 when memory runs out. */
static int metroi_draws_autocovariance(const double *value, size_t chains, size_t length, double *covariance)
{
    size_t n = 2, c, i;
    double *work, *re, *im, *power, *wave;
    while (n < 2 * length && n <= SIZE_MAX / 128) n *= 2;
    if (n < 2 * length) return 0;
    work = (double *)METRO_MALLOC(4 * n * sizeof *work);
    if (work == NULL) return 0;
    re = work;
    im = work + n;
    power = work + 2 * n;
    wave = work + 3 * n;
    for (i = 0; i < n; i++) power[i] = 0;
    for (i = 0; i < n / 2; i++) {
        wave[2 * i] = cos(2 * METROI_PI * (double)i / (double)n);
        wave[2 * i + 1] = sin(2 * METROI_PI * (double)i / (double)n);
    }
    for (c = 0; c < chains; c += 2) {
        const double *x = value + c * length, *y = c + 1 < chains ? x + length : NULL;
        double mean_x = metroi_draws_mean(x, length), mean_y = y != NULL ? metroi_draws_mean(y, length) : 0;
        for (i = 0; i < n; i++) {
            re[i] = i < length ? x[i] - mean_x : 0;
            im[i] = i < length && y != NULL ? y[i] - mean_y : 0;
        }
        metroi_draws_fourier(re, im, wave, n);
        for (i = 0; i < n; i++) power[i] += re[i] * re[i] + im[i] * im[i];
    }
    /* Transform the powers back, eq 7.4. */
    for (i = 0; i < n; i++) im[i] = 0;
    metroi_draws_fourier(power, im, wave, n);
    for (i = 0; i < length; i++) covariance[i] = power[i] / (double)n / (double)length / (double)chains;
    METRO_FREE(work);
    return 1;
}

METRO_API metro_result metro_autocorrelation(const double *draw, size_t draws, size_t lags, double *rho)
{
    int exponent, known;
    double *scaled, *covariance;
    size_t k;
    if (draw == NULL || rho == NULL || lags == 0 || lags > draws) return METRO_ERROR_ARGUMENT;
    if (!metroi_draws_usable(draw, 1, draws) || metroi_draws_constant(draw, draws)) {
        for (k = 0; k < lags; k++) rho[k] = METROI_NAN;
        return METRO_OK;
    }
    scaled = metroi_draws_scaled(draw, draws, &exponent);
    covariance = (double *)METRO_MALLOC(draws * sizeof *covariance);
    known = scaled != NULL && covariance != NULL && metroi_draws_autocovariance(scaled, 1, draws, covariance);
    for (k = 0; known && k < lags; k++) rho[k] = covariance[k] / covariance[0]; /* eq 7.3 */
    METRO_FREE(covariance);
    METRO_FREE(scaled);
    return known ? METRO_OK : METRO_ERROR_MEMORY;
}

/* # 7.4 The autocorrelation time

   It is tempting to sum the estimated correlations over all lags. But far lags are noise, and their sum does not
   settle however long the chain is: with eq 7.3 the sum over all lags is the same for every chain, and tau would be
   0. One must stop. Geyer (1992, section 3.3) gives a reason where: for a reversible chain the sums of neighbours
   $rho_{2m} + rho_{2m+1}$ are positive and fall with m. So we add pairs while they are positive (the initial positive
   sequence) and let none be larger than the one before it (the initial monotone sequence).

   Several chains are one larger sample only if they sample the same distribution. With m chains of n draws, W the
   mean of their variances and V the variance of their means, Vehtari et al. (2021, section 3.2) take

       rho_k = 1 - frac{W - gamma_k}{gamma_0 + V},    W = frac{n}{n - 1} gamma_0                             (7.5)

   gamma being the mean over chains, each about its own mean. Chains that agree have a V of about W tau / n, and eq
   7.5 is eq 7.3 with less noise. For chains that disagree V is large, all correlations are near 1, and tau is of the
   order of the whole run: the chains are then worth little more than one draw each. Averaging the chains first, draw
   by draw, and estimating tau from the average hides exactly this, since the average of chains stuck in different
   places is a chain that moves about in one place; and it throws away the noise reduction, as the average has the
   correlation of one chain and the noise of one.

   The last pair that was looked at is not summed, but its even member, if positive, counts once: it improves tau
   where correlations alternate (as in Stan and in posterior; where the lags ran out on a positive pair, it counts
   whatever its sign). So, with pairs made monotone and t the lag where they end,

       tau = -1 + 2 sum_{m < t/2} (rho_{2m} + rho_{2m+1}) + max(0, rho_t)                                    (7.6)

   which is the 1 + 2 sum of eq 7.2, sorted by pairs. Sums that come out small are mostly luck, so tau is kept from
   falling under 1/log10 of the number of draws. Where the lags run out before a sum has begun, as in halves of three
   to five draws, or where even the first pair is not positive, posterior takes tau = 2, and we do as it does. */

static double metroi_draws_geyer(const double *covariance, size_t n, double means_variance, double total)
{
    double within = covariance[0] * (double)n / (double)(n - 1), all = covariance[0] + means_variance;
    double even = 1, odd = 1 - (within - covariance[1]) / all; /* eq 7.5 */
    double pairs = 0, smallest = METROI_INFINITY, least = 1 / log10(total), tau;
    size_t t = 0;
    while (t + 5 < n && even + odd > 0) {
        /* Add the pair, but no more than the one before it. */
        smallest = even + odd < smallest ? even + odd : smallest;
        pairs += smallest;
        t += 2;
        even = 1 - (within - covariance[t]) / all;
        odd = 1 - (within - covariance[t + 1]) / all;
    }
    tau = -1 + 2 * pairs + (even > 0 || even + odd >= 0 ? even : 0); /* eq 7.6 */
    if (t == 0) tau = 2;
    return tau < least ? least : tau;
}

/* tau of chains that are scaled or are ranks. With `between` zero the disagreement of chains is left out of account.
   NaN where it cannot be said. */
static double metroi_draws_time(const double *value, size_t chains, size_t length, int between)
{
    double *covariance, *mean, tau = METROI_NAN;
    size_t c;
    if (length < 3 || metroi_draws_constant(value, chains * length)) return METROI_NAN;
    covariance = (double *)METRO_MALLOC(length * sizeof *covariance);
    mean = (double *)METRO_MALLOC(chains * sizeof *mean);
    if (covariance != NULL && mean != NULL && metroi_draws_autocovariance(value, chains, length, covariance)) {
        for (c = 0; c < chains; c++) mean[c] = metroi_draws_mean(value + c * length, length);
        tau = metroi_draws_geyer(covariance, length, between ? metroi_draws_variance(mean, chains) : 0.0,
                                 (double)chains * (double)length);
    }
    METRO_FREE(mean);
    METRO_FREE(covariance);
    return tau;
}

/* The same from draws in their own units. */
static double metroi_draws_time_of(const double *draw, size_t chains, size_t draws, int between)
{
    int exponent;
    double *scaled, *half = NULL, tau = METROI_NAN;
    if (!metroi_draws_usable(draw, chains, draws)) return METROI_NAN;
    scaled = metroi_draws_scaled(draw, chains * draws, &exponent);
    if (scaled != NULL) half = metroi_draws_halves(scaled, chains, draws);
    if (half != NULL) tau = metroi_draws_time(half, 2 * chains, draws / 2, between);
    METRO_FREE(half);
    METRO_FREE(scaled);
    return tau;
}

METRO_API double metro_autocorrelation_time(const double *draw, size_t chains, size_t draws)
{
    return metroi_draws_time_of(draw, chains, draws, 1);
}

/* # 7.5 The error of a mean

   With S draws in all halves, the effective sample size of their mean is

       "ESS" = frac{S}{tau}                                                                                  (7.7)

   and the standard error of the mean, with s the standard deviation of the draws,

       "MCSE" = frac{s}{sqrt{"ESS"}}                                                                         (7.8)

   The mean is the plain one over all draws, the middle ones included. */

static double metroi_draws_size(double tau, size_t chains, size_t draws)
{
    return 2 * (double)chains * (double)(draws / 2) / tau; /* eq 7.7 */
}

METRO_API double metro_ess_mean(const double *draw, size_t chains, size_t draws)
{
    return metroi_draws_size(metro_autocorrelation_time(draw, chains, draws), chains, draws);
}

METRO_API double metro_mcse_mean(const double *draw, size_t chains, size_t draws)
{
    int exponent;
    double ess = metro_ess_mean(draw, chains, draws), variance, *scaled;
    if (isnan(ess)) return METROI_NAN;
    scaled = metroi_draws_scaled(draw, chains * draws, &exponent);
    if (scaled == NULL) return METROI_NAN;
    variance = metroi_draws_variance(scaled, chains * draws);
    METRO_FREE(scaled);
    return ldexp(sqrt(variance / ess), exponent); /* eq 7.8 */
}

/* The standard deviation is the root of the mean of g = (f - mean)^2, so its error follows from that of a mean: the
   root of a number with a small error d has the error d over twice the root,

       "MCSE"(s) = frac{1}{2} sqrt{frac{E[g^2] - E[g]^2}{E[g] "ESS"_g}}                                      (7.9)

   If all draws are equally far from the mean, the g differ by rounding alone and carry no information: the squares of
   numbers up to d that are off by a unit e of rounding are off by 2 d e. */

METRO_API double metro_mcse_sd(const double *draw, size_t chains, size_t draws)
{
    int exponent;
    const double epsilon = 2.2204460492503131e-16; /* 2^-52 */
    size_t count, i;
    double *g, mean, ess, g1, g2, least = METROI_INFINITY, largest = 0;
    if (!metroi_draws_usable(draw, chains, draws)) return METROI_NAN;
    count = chains * draws;
    g = metroi_draws_scaled(draw, count, &exponent);
    if (g == NULL) return METROI_NAN;
    mean = metroi_draws_mean(g, count);
    for (i = 0; i < count; i++) {
        g[i] = (g[i] - mean) * (g[i] - mean);
        if (g[i] < least) least = g[i];
        if (g[i] > largest) largest = g[i];
    }
    ess = metro_ess_mean(g, chains, draws);
    g1 = metroi_draws_mean(g, count);
    for (i = 0; i < count; i++) g[i] = (g[i] - g1) * (g[i] - g1);
    g2 = metroi_draws_mean(g, count);
    METRO_FREE(g);
    if (!(largest - least > 4 * epsilon * sqrt(largest))) return METROI_NAN;
    return ldexp(0.5 * sqrt(g2 / (g1 * ess)), exponent); /* eq 7.9 */
}

/* # 7.6 Ranks

   Means and variances need not exist: f/I may have tails so long that one draw in a million outweighs the rest. Ranks
   always exist. Vehtari et al. (2021, section 4) replace each draw by the normal number that belongs to its rank r
   among all S draws (Blom 1958),

       z = Phi^{-1}(frac{r - 3/8}{S + 1/4})                                                                  (7.10)

   with the mean rank for draws that are equal; Phi is the normal distribution function. What z says of the chains is
   the same for f and for any rising function of f.

   The inverse of Phi is algorithm AS 241 (PPND16) of Wichura (1988), good to some 1e-15: rational functions of p
   about the middle and of the root of -ln p outside. His third piece, for p below 1.4e-11, belongs to more than 4e10
   draws and is left out. */

static double metroi_normal_quotient(const double *above, const double *below, double x)
{
    double a = above[7], b = below[7];
    int i;
    for (i = 6; i >= 0; i--) {
        a = a * x + above[i];
        b = b * x + below[i];
    }
    return a / b;
}

/* Phi^{-1}(p), 1.4e-11 < p < 1 - 1.4e-11. */
static double metroi_normal_inverse(double p)
{
    static const double middle[2][8] = {
        { 3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
          4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3 },
        { 1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
          2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3 }
    };
    static const double outside[2][8] = {
        { 1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
          1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4 },
        { 1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1,
          1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9 }
    };
    double q = p - 0.5, z;
    if (fabs(q) <= 0.425) return q * metroi_normal_quotient(middle[0], middle[1], 0.180625 - q * q);
    z = metroi_normal_quotient(outside[0], outside[1], sqrt(-log(q < 0 ? p : 1 - p)) - 1.6);
    return q < 0 ? -z : z;
}

typedef struct {
    double value;
    size_t index;
} metroi_draws_place;

/* Orders doubles, and places by their value, which stands first in them. */
static int metroi_draws_compare(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Replaces the values by their z. Returns 0 when memory runs out. */
static int metroi_draws_rank(double *value, size_t count)
{
    metroi_draws_place *place;
    size_t i, first, next;
    if (count > SIZE_MAX / sizeof *place) return 0;
    place = (metroi_draws_place *)METRO_MALLOC(count * sizeof *place + 1);
    if (place == NULL) return 0;
    for (i = 0; i < count; i++) {
        place[i].value = value[i];
        place[i].index = i;
    }
    qsort(place, count, sizeof *place, metroi_draws_compare);
    /* Ranks count from 1: equal draws at the places first .. next - 1 have the mean rank (first + 1 + next) / 2. */
    for (first = 0; first < count; first = next) {
        double rank, z;
        next = first + 1;
        while (next < count && !(place[next].value > place[first].value)) next++;
        rank = 0.5 * ((double)first + 1 + (double)next);
        z = metroi_normal_inverse((rank - 0.375) / ((double)count + 0.25)); /* eq 7.10 */
        for (i = first; i < next; i++) value[place[i].index] = z;
    }
    METRO_FREE(place);
    return 1;
}

/* # 7.7 R-hat

   If m chains of n draws sample the same distribution, two estimates of its variance agree: W, the mean of the
   variances within the chains, and one that adds V, the variance of their means. While they are still where they
   started, the second is the larger. The root of the quotient is the R-hat of Gelman and Rubin (1992), in the form of
   Vehtari et al. (2021):

       "R-hat" = sqrt{frac{n - 1}{n} + frac{V}{W}}                                                           (7.11)

   The chains are halves (section 7.1) and the draws are ranks (section 7.6). Chains may also agree in their place and
   differ in their width: then their distances from the median differ in place. R-hat is the larger of the two values.

   How much is too much? Vehtari et al. ask for R-hat below 1.01 before a result is used. Halves of n draws that agree
   have a V of about W tau/n, so the square of R-hat is about 1 + tau/n: 1.01 also asks for chains of some 100 tau.

   Chains that all stand still have W = 0. If they stand at the same place there is nothing to say; if not, R-hat is
   infinite. In posterior the rounding of a mean leaves something like 1e15 there, and NA for two chains, whose
   distances from their median are equal. */

static double metroi_draws_disagreement(const double *value, size_t chains, size_t length)
{
    double *variance, *mean, within, between;
    size_t c;
    if (length < 2 || metroi_draws_constant(value, chains * length)) return METROI_NAN;
    variance = (double *)METRO_MALLOC(2 * chains * sizeof *variance);
    if (variance == NULL) return METROI_NAN;
    mean = variance + chains;
    for (c = 0; c < chains; c++) {
        variance[c] = metroi_draws_variance(value + c * length, length);
        mean[c] = metroi_draws_mean(value + c * length, length);
    }
    within = metroi_draws_mean(variance, chains);
    between = metroi_draws_variance(mean, chains);
    METRO_FREE(variance);
    if (!(within > 0)) return METROI_INFINITY;
    return sqrt((double)(length - 1) / (double)length + between / within); /* eq 7.11 */
}

/* R-hat of the ranks of the halves. */
static double metroi_draws_ranked_rhat(const double *value, size_t chains, size_t draws)
{
    double *half = metroi_draws_halves(value, chains, draws), rhat = METROI_NAN;
    if (half != NULL && metroi_draws_rank(half, 2 * chains * (draws / 2)))
        rhat = metroi_draws_disagreement(half, 2 * chains, draws / 2);
    METRO_FREE(half);
    return rhat;
}

/* A sorted copy, or NULL when memory runs out. */
static double *metroi_draws_sorted(const double *draw, size_t count)
{
    double *sorted = (double *)METRO_MALLOC(count * sizeof *sorted);
    if (sorted == NULL) return NULL;
    memcpy(sorted, draw, count * sizeof *sorted);
    qsort(sorted, count, sizeof *sorted, metroi_draws_compare);
    return sorted;
}

METRO_API double metro_rhat(const double *draw, size_t chains, size_t draws)
{
    double place, width, median, *folded;
    size_t count, i;
    if (!metroi_draws_usable(draw, chains, draws)) return METROI_NAN;
    count = chains * draws;
    place = metroi_draws_ranked_rhat(draw, chains, draws);
    /* What stands still in different places needs no second opinion, and what has no answer gets none. */
    if (!(place < METROI_INFINITY)) return place;
    folded = metroi_draws_sorted(draw, count);
    if (folded == NULL) return METROI_NAN;
    median = 0.5 * folded[(count - 1) / 2] + 0.5 * folded[count / 2];
    for (i = 0; i < count; i++) folded[i] = fabs(0.5 * draw[i] - 0.5 * median); /* half of it cannot overflow */
    width = metroi_draws_ranked_rhat(folded, chains, draws);
    METRO_FREE(folded);
    return isnan(width) || width > place ? width : place;
}

/* # 7.8 Bulk and tail

   The effective sample size of the ranks judges the bulk of the distribution. The tails can be far worse: a chain may
   visit a narrow bright peak so rarely that its mean looks settled. So we also count how often draws lie below their
   quantile at .05 and below that at .95; each count is a mean of zeros and ones and has an effective sample size of
   its own, and the smaller one is the tail's.

   The quantile q of S draws lies between two of them, at the fraction q (S - 1) of their order. No draw lies between
   the quantile and the draw below it, so comparing with that draw gives the same zeros and ones, and interpolation,
   with its rounding, is not needed. At .95 its place is S - 1 less a twentieth of that, rounded up. */

METRO_API double metro_ess(const double *draw, size_t chains, size_t draws)
{
    double *half, tau = METROI_NAN;
    if (!metroi_draws_usable(draw, chains, draws)) return METROI_NAN;
    half = metroi_draws_halves(draw, chains, draws);
    if (half != NULL && metroi_draws_rank(half, 2 * chains * (draws / 2)))
        tau = metroi_draws_time(half, 2 * chains, draws / 2, 1);
    METRO_FREE(half);
    return metroi_draws_size(tau, chains, draws);
}

/* The effective sample size of the share of draws up to `bound`. */
static double metroi_draws_share_size(const double *draw, size_t chains, size_t draws, double bound)
{
    double *below = (double *)METRO_MALLOC(chains * draws * sizeof *below), ess;
    size_t i;
    if (below == NULL) return METROI_NAN;
    for (i = 0; i < chains * draws; i++) below[i] = draw[i] <= bound ? 1 : 0;
    ess = metro_ess_mean(below, chains, draws);
    METRO_FREE(below);
    return ess;
}

METRO_API double metro_ess_tail(const double *draw, size_t chains, size_t draws)
{
    double *sorted, low, high;
    size_t last;
    if (!metroi_draws_usable(draw, chains, draws)) return METROI_NAN;
    sorted = metroi_draws_sorted(draw, chains * draws);
    if (sorted == NULL) return METROI_NAN;
    last = chains * draws - 1;
    low = metroi_draws_share_size(draw, chains, draws, sorted[last / 20]);
    high = metroi_draws_share_size(draw, chains, draws, sorted[last - (last / 20 + (last % 20 != 0))]);
    METRO_FREE(sorted);
    return isnan(low) || low < high ? low : high;
}

/* # 7.9 The squared jump

   The mean squared distance between consecutive draws (Pasarica and Gelman 2010) needs no window and no sum over
   lags. For a stationary chain on the line it is the first correlation in another dress,

       E[(z_{i+1} - z_i)^2] = 2 sigma^2 (1 - rho_1)                                                          (7.12)

   so the longer the jumps, the smaller rho_1, stays counting as jumps of length 0. It looks one step ahead only: a
   chain that jumps well inside each of two peaks and never between them has long jumps and an endless tau. On a
   circle the shorter way counts. */

METRO_API double metro_squared_jump(const double *draw, size_t draws, double period)
{
    metro_sum sum = { 0, 0 };
    size_t i;
    if (!(period >= 0) || isinf(period) || draws < 2 || !metroi_draws_usable(draw, 1, draws)) return METROI_NAN;
    for (i = 1; i < draws; i++) {
        double jump = draw[i] - draw[i - 1];
        if (isinf(jump) && period > 0) jump = remainder(draw[i], period) - remainder(draw[i - 1], period);
        if (period > 0) jump = remainder(jump, period);
        metro_sum_add(&sum, jump * jump); /* eq 7.12 */
    }
    return metro_sum_value(&sum) / (double)(draws - 1);
}

/* # 7.10 Bias and variance apart

   The mean squared error of a run is its squared bias plus its variance. One run shows their sum; to see them apart
   one repeats the run with other random numbers. Let $x_r$ be what run r of R gives for a value that is t in truth, m
   the mean of the R and s^2 their unbiased variance. Then (m - t)^2 is too large by the variance of m, and

       b^2 = (m - t)^2 - frac{s^2}{R},    "MSE" = b^2 + s^2 = frac{1}{R} sum_{r=1}^{R} (x_r - t)^2           (7.13)

   is unbiased. It may be negative, and must be allowed to: whoever clips it at zero adds a bias to the measurement of
   bias. For a picture each is averaged over its values.

   How far off are they? The values of one run depend on each other, the runs do not, so the unit is the run. The
   jackknife leaves out one run at a time and looks at how the answer theta moves (Tukey 1958):

       "error"^2 = frac{R - 1}{R} sum_{r=1}^{R} (theta_r - frac{1}{R} sum_{q=1}^{R} theta_q)^2               (7.14)

   Without run r, whose deviation is $e_r = x_r - m$, the mean is $m - e_r/(R - 1)$ and the sum of squared deviations
   is smaller by $e_r^2 R/(R - 1)$; nothing has to be summed again. For the mean squared error eq 7.14 is the usual
   error of a mean.

   The jackknife errs upwards (Efron and Stein 1981), and for b^2 where there is no bias, and b^2 is all products of
   two runs, it is too large by the factor sqrt(2 (R - 1)/(R - 2)). */

/* Adds what one value says of bias^2, variance and mean squared error to `total`, and of each without one of the runs
   to `left_out`. `value` is the value in the first run, and `stride` numbers on it stands in the next. What too few
   runs cannot say becomes NaN. */
static void metroi_repeats_add(const double *value, size_t stride, size_t repeats, double truth, metro_sum total[3],
                               double *left_out[3])
{
    double runs = (double)repeats, others = repeats > 1 ? runs - 1 : METROI_NAN;
    double less = repeats > 2 ? runs - 2 : METROI_NAN, mean, bias, squares = 0, error2 = 0;
    metro_sum sum = { 0, 0 };
    size_t r;
    for (r = 0; r < repeats; r++) metro_sum_add(&sum, value[r * stride] - value[0]);
    mean = value[0] + metro_sum_value(&sum) / runs;
    bias = mean - truth;
    for (r = 0; r < repeats; r++) {
        squares += (value[r * stride] - mean) * (value[r * stride] - mean);
        error2 += (value[r * stride] - truth) * (value[r * stride] - truth);
    }
    metro_sum_add(&total[0], bias * bias - squares / others / runs); /* eq 7.13 */
    metro_sum_add(&total[1], squares / others);
    metro_sum_add(&total[2], error2 / runs);
    /* Leave out one run after the other. */
    for (r = 0; r < repeats; r++) {
        double e = value[r * stride] - mean, d = value[r * stride] - truth;
        double shifted = bias - e / others, variance = (squares - e * e * runs / others) / less;
        left_out[0][r] += shifted * shifted - variance / others;
        left_out[1][r] += variance;
        left_out[2][r] += (error2 - d * d) / others;
    }
}

/* The jackknife error of a mean over `values` values, eq 7.14. */
static double metroi_repeats_error(const double *left_out, size_t repeats, size_t values)
{
    double spread = metroi_draws_variance(left_out, repeats), runs = (double)repeats;
    return (runs - 1) * sqrt(spread / runs) / (double)values;
}

METRO_API metro_result metro_repeats(const double *estimate, const double *truth, size_t repeats, size_t values,
                                     metro_bias_variance *out)
{
    metro_sum total[3] = { { 0, 0 }, { 0, 0 }, { 0, 0 } };
    double *left_out[3];
    size_t v, i;
    if (estimate == NULL || truth == NULL || out == NULL || repeats == 0 || values == 0) return METRO_ERROR_ARGUMENT;
    if (repeats > SIZE_MAX / 3 / sizeof(double)) return METRO_ERROR_MEMORY;
    left_out[0] = (double *)METRO_MALLOC(3 * repeats * sizeof(double));
    if (left_out[0] == NULL) return METRO_ERROR_MEMORY;
    left_out[1] = left_out[0] + repeats;
    left_out[2] = left_out[1] + repeats;
    for (i = 0; i < 3 * repeats; i++) left_out[0][i] = 0;
    for (v = 0; v < values; v++) metroi_repeats_add(estimate + v, values, repeats, truth[v], total, left_out);
    out->bias2 = metro_sum_value(&total[0]) / (double)values;
    out->variance = metro_sum_value(&total[1]) / (double)values;
    out->mse = metro_sum_value(&total[2]) / (double)values;
    out->bias2_error = metroi_repeats_error(left_out[0], repeats, values);
    out->variance_error = metroi_repeats_error(left_out[1], repeats, values);
    out->mse_error = metroi_repeats_error(left_out[2], repeats, values);
    METRO_FREE(left_out[0]);
    return METRO_OK;
}

/* # 7.11 What cannot be said

   A diagnostic that fails should say so and say why. The reasons are looked for from the plainest on. The last two
   are judgements, and their bounds have reasons. tau is estimated from the draws themselves, and a chain that is not
   much longer than tau cannot know its tau: it takes its slow wandering for its mean, and finds the rest well mixed.
   Fifty tau is the customary length from which the estimate holds (it is the rule of emcee, Foreman-Mackey et al.
   2013). It is asked within the chains, so that chains stuck apart are not called short. Chains of 50 tau that agree
   have an R-hat of about 1.02 by chance; 1.1 is seldom chance. */

METRO_API const char *metro_draws_trouble(const double *draw, size_t chains, size_t draws)
{
    size_t c, still = 0;
    double rhat, tau;
    if (draw == NULL || chains == 0 || draws == 0) return "there are no draws";
    if (!metroi_draws_usable(draw, chains, draws)) return "a draw is not finite";
    if (draws < 4) return "there are fewer than four draws a chain, so its halves have no variance";
    if (metroi_draws_constant(draw, chains * draws)) return "all draws are equal";
    for (c = 0; c < chains; c++) still += metroi_draws_constant(draw + c * draws, draws) ? 1 : 0;
    if (still == chains) return "every chain stands still, and not all at the same place";
    if (still > 0) return "a chain stands still";
    if (draws < 6) return "there are fewer than six draws a chain, so its halves have no autocorrelation";
    rhat = metro_rhat(draw, chains, draws);
    if (isnan(rhat))
        return "R-hat cannot be said: all draws (but perhaps a middle one) are equally far from the median, or "
               "memory ran out";
    tau = metroi_draws_time_of(draw, chains, draws, 0);
    if (isnan(tau)) return "memory ran out";
    if (!((double)draws >= 50 * tau))
        return "the chains are shorter than 50 autocorrelation times: the estimates are unreliable";
    if (rhat > 1.1) return "the chains or their halves disagree: R-hat is above 1.1";
    return NULL;
}

/* # 7.12 Detailed balance

   A mutation with an asymmetry that its ratio T(t -> i)/T(i -> t) leaves out gives pictures that look plausible and
   are wrong. The check asks for no theory of the mutation, only for its code. Let x be distributed as the target and
   let y be the state after x. Detailed balance (eq 4.3) says that the pairs (x, y) and (y, x) are equally likely, so
   for any two cells A and B of a coordinate

       P(x "in" A, y "in" B) = P(x "in" B, y "in" A)                                                          (7.15)

   No sampler is needed to test the sampler: x is a uniform draw, kept with probability I(x)/max I. Each pair that is
   kept and connects A and B goes the one way or the other by a fair coin, so with $n_{AB}$ pairs from A to B

       chi^2 = sum_{A < B} frac{(n_{AB} - n_{BA})^2}{n_{AB} + n_{BA}}                                         (7.16)

   has mean 1 a term (Bowker 1948). Terms of less than 20 pairs are left out. A step clamped to the border, a rejected
   step repeated until it is accepted, a ratio upside down: all move more one way than the other.

   In several dimensions we test one coordinate at a time. The coordinates of a uniform direction are uniform in [-1,
   1] each, which is Archimedes' theorem, so they have cells of equal measure too. */

static size_t metroi_coordinate_cell(double value, int of_direction, size_t cells)
{
    double place = (of_direction ? (value + 1) / 2 : value) * (double)cells;
    if (!(place > 0)) return 0;
    return place < (double)cells ? (size_t)place : cells - 1;
}

/* Counts one pair: flow[coordinate][A][B]. */
static void metroi_flow_add(const metro_target *target, const double *x, const double *y, size_t cells, double *flow)
{
    size_t coordinate = 0, axis, i;
    for (axis = 0; axis < target->axis_count; axis++) {
        size_t doubles = metroi_axis_doubles(target->axes[axis].kind);
        for (i = 0; i < doubles; i++, coordinate++) {
            size_t from = metroi_coordinate_cell(x[coordinate], doubles == 3, cells);
            size_t to = metroi_coordinate_cell(y[coordinate], doubles == 3, cells);
            flow[(coordinate * cells + from) * cells + to] += 1;
        }
    }
}

/* The largest importance of the next `draws` uniform states of a stream; what is no proper importance counts as 0. */
static double metroi_largest_importance(metro_chain *chain, uint64_t draws, double *x, metro_rng rng)
{
    const metro_target *target = &chain->target;
    double largest = 0;
    uint64_t i;
    for (i = 0; i < draws; i++) {
        double importance;
        metroi_state_draw(target, x, &rng);
        importance = target->importance(x, chain->tentative_sample, target->user);
        if (importance > largest && isfinite(importance)) largest = importance;
    }
    return largest;
}

/* Draws the same states again, keeps each with probability I(x)/max I, and lets it step. Where it comes to a state
   that is brighter than all that were drawn, the way back cannot be among the pairs, and so this one must not be. */
static void metroi_flow_fill(metro_chain *chain, void (*step)(const double *, double *, metro_rng *, void *),
                             uint64_t draws, size_t cells, double *x, double *y, metro_rng rng, double *flow)
{
    const metro_target *target = &chain->target;
    double largest = metroi_largest_importance(chain, draws, x, rng);
    uint64_t i;
    for (i = 0; i < draws; i++) {
        metroi_state_draw(target, x, &rng);
        if (metro_chain_start_point(chain, x) != METRO_OK) continue;
        if (metro_rng_uniform(&chain->rng) * largest >= chain->importance) continue;
        if (step != NULL) {
            step(x, y, &chain->rng, target->user);
            if (target->importance(y, chain->tentative_sample, target->user) > largest) continue;
        } else {
            metro_chain_step(chain);
            if (chain->importance > largest) continue;
            memcpy(y, chain->state, metroi_state_doubles(target) * sizeof *y);
        }
        metroi_flow_add(target, x, y, cells, flow);
    }
}

/* P(chi-square > value): its cube root is nearly normal (Wilson and Hilferty 1931). */
static double metroi_chi_square_probability(double value, double freedom)
{
    double s = 2.0 / (9.0 * freedom);
    return 0.5 * erfc((cbrt(value / freedom) - 1.0 + s) / sqrt(2.0 * s));
}

/* Scores one coordinate by eq 7.16. */
static metro_balance metroi_flow_score(const double *flow, size_t coordinate, size_t cells)
{
    metro_balance score;
    double worst = -1;
    size_t a, b;
    memset(&score, 0, sizeof score);
    score.coordinate = coordinate;
    score.probability = 1;
    for (a = 0; a < cells; a++)
        for (b = a + 1; b < cells; b++) {
            double there = flow[(coordinate * cells + a) * cells + b];
            double back = flow[(coordinate * cells + b) * cells + a];
            double term;
            if (there + back < 20) continue;
            term = (there - back) * (there - back) / (there + back); /* eq 7.16 */
            score.chi_square += term;
            score.freedom += 1;
            if (term <= worst) continue;
            worst = term;
            score.from = there > back ? a : b;
            score.to = there > back ? b : a;
            score.excess = fabs(there - back) / (there + back);
        }
    if (score.freedom > 0) score.probability = metroi_chi_square_probability(score.chi_square, score.freedom);
    return score;
}

/* The least probable coordinate, its probability multiplied by the number of coordinates tried. */
static metro_balance metroi_flow_worst(const double *flow, size_t coordinates, size_t cells)
{
    metro_balance worst = metroi_flow_score(flow, 0, cells);
    size_t i;
    for (i = 1; i < coordinates; i++) {
        metro_balance score = metroi_flow_score(flow, i, cells);
        if (score.probability < worst.probability) worst = score;
    }
    worst.probability *= (double)coordinates;
    if (worst.probability > 1) worst.probability = 1;
    return worst;
}

METRO_API metro_result metro_balance_check(const metro_target *target,
                                           void (*step)(const double *from, double *to, metro_rng *rng, void *user),
                                           uint64_t draws, size_t cells, metro_rng rng, metro_balance *balance)
{
    metro_chain chain;
    metro_balance worst;
    size_t doubles, entries, i;
    double *flow;
    metro_result result;
    if (cells == 0) cells = 16;
    if (cells < 2 || cells > 256) return METRO_ERROR_ARGUMENT;
    result = metro_chain_make(target, NULL, metro_rng_make(metro_rng_next(&rng), 0), &chain);
    if (result != METRO_OK) return result;
    doubles = metroi_state_doubles(target);
    entries = doubles * cells * cells;
    flow = NULL;
    if (doubles <= SIZE_MAX / 64 / (256 * 256)) flow = (double *)METRO_MALLOC((entries + 2 * doubles) * sizeof *flow);
    if (flow == NULL) {
        metro_chain_free(&chain);
        return METRO_ERROR_MEMORY;
    }
    for (i = 0; i < entries; i++) flow[i] = 0;
    metroi_flow_fill(&chain, step, draws, cells, flow + entries, flow + entries + doubles, rng, flow);
    worst = metroi_flow_worst(flow, doubles, cells);
    METRO_FREE(flow);
    metro_chain_free(&chain);
    if (!(worst.freedom > 0)) return METRO_ERROR_NO_IMPORTANCE;
    *balance = worst;
    return METRO_OK;
}

/* # 7.13 Measuring the start-up error

   Chapter 5 says what E_n is. An ensemble of chains lets us measure it without looking at that chapter. R chains that
   start alike and run apart are, after n steps, R independent draws from p_n, and the mean of e^{-2 pi i k x} over
   them is the empirical coefficient of the density. Its square is too large by the noise of the mean; the product of
   the coefficients of two different groups of chains is not. With J groups, each with the coefficients $c_a(k)$,

       T_{ab} = sum_{k != 0} c_a(k) c_b(-k),    E_n^2 ~ frac{1}{J (J-1)} sum_{a != b} T_{ab}                 (7.17)

   is unbiased: with a constant importance the estimate is 0 in the mean when the chains have forgotten their seed,
   and must be allowed to be negative. A histogram would have a bias that depends on the width of its bins.

   This is a U-statistic, and the variance of such a mean over pairs can be estimated without bias from the same
   matrix. The product of two terms with four different groups has mean E_n^4, so

       Var ~ (E_n^2)^2 - frac{C - 4 A + 2 B}{J (J-1) (J-2) (J-3)}                                            (7.18)

   with $A = sum_a (sum_b T_{ab})^2$, $B = sum_{ab} T_{ab}^2$, $C = (sum_{ab} T_{ab})^2$ over pairs of different
   groups (Hoeffding 1948). Where noise makes eq 7.18 smaller than the part that never vanishes, 2 Var(T)/(J (J-1)),
   we use that part.

   In d dimensions k is a vector of harmonics, from -K to K on a circle; on an interval the functions are sqrt{2}
   cos(pi k x) with k from 0 to K. One mode and its conjugate give the same, so one of the two is counted twice. */

/* The modes are listed once: for each the places of its factors in a table of one-dimensional values, and how often
   its square counts. The table is filled anew for each state, one sine and cosine an axis and then by rotation. */

typedef struct {
    size_t axes, count;
    size_t *factor;   /* [count][axes]: places in the table */
    double *times;    /* [count]: 2 for a mode that stands for its conjugate too, else 1 */
} metroi_modes;

typedef struct {
    const metro_ensemble *ensemble;
    metroi_modes modes;
    size_t jobs;
    uint64_t chains;  /* in a job */
    double *sums;     /* [job][time][mode][2]: sums over the chains of a job */
} metroi_ensemble;

/* The number of harmonics along an axis. */
static size_t metroi_axis_modes(const metro_axis *axis, size_t harmonics)
{
    return axis->kind == METRO_CIRCLE ? 2 * harmonics + 1 : harmonics + 1;
}

/* The number of modes; 0 when there are too many. */
static size_t metroi_mode_count(const metro_target *target, size_t harmonics)
{
    const size_t most = (size_t)1 << 20;
    size_t modes = 1, i;
    if (harmonics == 0 || harmonics > most) return 0;
    for (i = 0; i < target->axis_count; i++) {
        if (target->axes[i].kind == METRO_DIRECTION) return 0;
        modes *= metroi_axis_modes(&target->axes[i], harmonics);
        if (modes > most) return 0;
    }
    return modes;
}

/* Writes the places of the factors of the mode with number `mode`, each axis having 2 K + 1 places, the harmonic k at
   K + k. Returns how often its square counts: 0 for the mean and for the conjugate of another mode, 1 for a mode that
   is its own conjugate, 2 otherwise. */
static int metroi_mode_split(const metro_target *target, size_t harmonics, size_t mode, size_t *factor)
{
    int first = 0, constant = 1;
    size_t i;
    for (i = 0; i < target->axis_count; i++) {
        size_t count = metroi_axis_modes(&target->axes[i], harmonics), place = mode % count;
        mode /= count;
        if (target->axes[i].kind != METRO_CIRCLE) place += harmonics;
        else if (first == 0 && place != harmonics) first = place > harmonics ? 1 : -1;
        if (place != harmonics) constant = 0;
        factor[i] = i * (2 * harmonics + 1) + place;
    }
    if (constant || first < 0) return 0;
    return first > 0 ? 2 : 1;
}

static void metroi_modes_free(metroi_modes *modes)
{
    METRO_FREE(modes->times);
    METRO_FREE(modes->factor);
}

static metro_result metroi_modes_make(const metro_target *target, size_t harmonics, metroi_modes *modes)
{
    size_t all = metroi_mode_count(target, harmonics), mode;
    if (all == 0 || target->axis_count > SIZE_MAX / sizeof(size_t) / all) return METRO_ERROR_ARGUMENT;
    modes->axes = target->axis_count;
    modes->count = 0;
    modes->factor = (size_t *)METRO_MALLOC(all * modes->axes * sizeof *modes->factor);
    modes->times = (double *)METRO_MALLOC(all * sizeof *modes->times);
    if (modes->factor == NULL || modes->times == NULL) {
        metroi_modes_free(modes);
        return METRO_ERROR_MEMORY;
    }
    for (mode = 0; mode < all; mode++) {
        int times = metroi_mode_split(target, harmonics, mode, modes->factor + modes->count * modes->axes);
        modes->times[modes->count] = times;
        if (times > 0) modes->count++;
    }
    return METRO_OK;
}

/* Fills the table with e^{-2 pi i k x} on a circle, k from -K to K, and sqrt(2) cos(pi k x) on an interval, k from 0
   to K: real and imaginary part next to each other. */
static void metroi_table_fill(const metro_target *target, size_t harmonics, const double *z, double *table)
{
    size_t axis, k;
    for (axis = 0; axis < target->axis_count; axis++) {
        int circle = target->axes[axis].kind == METRO_CIRCLE;
        double *middle = table + 2 * (axis * (2 * harmonics + 1) + harmonics);
        double angle = (circle ? 2 : 1) * METROI_PI * z[axis], c = cos(angle), s = sin(angle), re = 1, im = 0;
        middle[0] = 1;
        middle[1] = 0;
        for (k = 1; k <= harmonics; k++) {
            double *up = middle + 2 * k, turned = re * c - im * s;
            im = re * s + im * c;
            re = turned;
            up[0] = circle ? re : sqrt(2.0) * re;
            up[1] = circle ? -im : 0;
            if (!circle) continue;
            middle[-2 * (ptrdiff_t)k] = re;
            middle[1 - 2 * (ptrdiff_t)k] = im;
        }
    }
}

/* Adds the value of each mode, the product of its factors, to its sum. */
static void metroi_modes_add(const metroi_modes *modes, const double *table, double *sum)
{
    const size_t *factor = modes->factor;
    size_t mode, axis;
    for (mode = 0; mode < modes->count; mode++, factor += modes->axes) {
        double re = table[2 * factor[0]], im = table[2 * factor[0] + 1];
        for (axis = 1; axis < modes->axes; axis++) {
            const double *f = table + 2 * factor[axis];
            double turned = re * f[0] - im * f[1];
            im = re * f[1] + im * f[0];
            re = turned;
        }
        sum[2 * mode] += re;
        sum[2 * mode + 1] += im;
    }
}

/* One chain from a seed, looked at after each of the given numbers of steps. */
static metro_result metroi_ensemble_chain(const metroi_ensemble *run, metro_chain *chain, double *table, double *sums)
{
    const metro_ensemble *ensemble = run->ensemble;
    uint64_t done = 0;
    size_t t;
    metro_result result = metro_chain_start_seeds(chain, ensemble->seed, ensemble->alpha, ensemble->seeds);
    for (t = 0; t < ensemble->times && result == METRO_OK; t++) {
        metro_chain_run(chain, ensemble->steps[t] - done);
        done = ensemble->steps[t];
        metroi_table_fill(ensemble->target, ensemble->harmonics, chain->state, table);
        metroi_modes_add(&run->modes, table, sums + 2 * run->modes.count * t);
    }
    return result;
}

static metro_result metroi_ensemble_work(uint64_t job, void *slot, void *user)
{
    const metroi_ensemble *run = (const metroi_ensemble *)user;
    const metro_ensemble *ensemble = run->ensemble;
    size_t table_size = run->modes.axes * (2 * ensemble->harmonics + 1) * 2 * sizeof(double);
    metro_chain chain;
    uint64_t i;
    double *table;
    metro_result result = metro_chain_make(ensemble->target, ensemble->options,
                                           metro_rng_make(ensemble->random_seed, job), &chain);
    if (result != METRO_OK) return result;
    chain.target.record = NULL; /* it would be called from several threads */
    table = (double *)METRO_MALLOC(table_size);
    if (table == NULL) result = METRO_ERROR_MEMORY;
    for (i = 0; i < run->chains && result == METRO_OK; i++)
        result = metroi_ensemble_chain(run, &chain, table, (double *)slot);
    METRO_FREE(table);
    metro_chain_free(&chain);
    return result;
}

static metro_result metroi_ensemble_merge(uint64_t job, const void *slot, void *user)
{
    metroi_ensemble *run = (metroi_ensemble *)user;
    size_t doubles = 2 * run->modes.count * run->ensemble->times;
    memcpy(run->sums + (size_t)job * doubles, slot, doubles * sizeof(double));
    return METRO_OK;
}

/* T_ab of eq 7.17 at one time. */
static double metroi_ensemble_product(const metroi_ensemble *run, size_t time, size_t a, size_t b)
{
    size_t times = run->ensemble->times, modes = run->modes.count, mode;
    const double *x = run->sums + 2 * modes * (a * times + time);
    const double *y = run->sums + 2 * modes * (b * times + time);
    double n = (double)run->chains, sum = 0;
    for (mode = 0; mode < modes; mode++)
        sum += run->modes.times[mode] * (x[2 * mode] * y[2 * mode] + x[2 * mode + 1] * y[2 * mode + 1]);
    return sum / (n * n);
}

/* The mean over pairs of groups and its standard error. `row` has a value a group. */
static void metroi_ensemble_estimate(const metroi_ensemble *run, size_t time, double *row, double *squared,
                                     double *error)
{
    double J = (double)run->jobs, pairs = J * (J - 1), A = 0, B = 0, total = 0, variance, least;
    size_t a, b;
    for (a = 0; a < run->jobs; a++) row[a] = 0;
    for (a = 0; a < run->jobs; a++)
        for (b = a + 1; b < run->jobs; b++) {
            double t = metroi_ensemble_product(run, time, a, b);
            row[a] += t;
            row[b] += t;
            B += 2 * t * t;
        }
    for (a = 0; a < run->jobs; a++) {
        A += row[a] * row[a];
        total += row[a];
    }
    *squared = total / pairs; /* eq 7.17 */
    variance = *squared * *squared - (total * total - 4 * A + 2 * B) / (pairs * (J - 2) * (J - 3)); /* eq 7.18 */
    least = 2 * (B / pairs - *squared * *squared) / pairs;
    *error = sqrt(variance > least ? variance : least > 0 ? least : 0);
}

static int metroi_ensemble_valid(const metro_ensemble *ensemble)
{
    size_t t;
    for (t = 1; t < ensemble->times; t++)
        if (ensemble->steps[t] < ensemble->steps[t - 1]) return 0;
    return ensemble->times > 0 && ensemble->chains > 0 && ensemble->seeds > 0 && ensemble->seed != NULL &&
           (ensemble->jobs == 0 || ensemble->jobs >= 4);
}

/* Runs all jobs into the sums of `run`, and estimates. */
static metro_result metroi_ensemble_run(metroi_ensemble *run, double *squared, double *error)
{
    const metro_ensemble *ensemble = run->ensemble;
    size_t doubles = 2 * run->modes.count * ensemble->times, time;
    metro_rounds plan;
    metro_result result;
    if (run->modes.count > SIZE_MAX / 64 / ensemble->times / run->jobs) return METRO_ERROR_ARGUMENT;
    run->sums = (double *)METRO_MALLOC((doubles + 1) * run->jobs * sizeof *run->sums);
    if (run->sums == NULL) return METRO_ERROR_MEMORY;
    memset(&plan, 0, sizeof plan);
    plan.jobs = run->jobs;
    plan.slot_size = doubles * sizeof *run->sums;
    plan.threads = ensemble->threads;
    plan.work = metroi_ensemble_work;
    plan.merge = metroi_ensemble_merge;
    result = metro_rounds_run(&plan, run);
    for (time = 0; result == METRO_OK && time < ensemble->times; time++)
        metroi_ensemble_estimate(run, time, run->sums + doubles * run->jobs, &squared[time], &error[time]);
    METRO_FREE(run->sums);
    return result;
}

METRO_API metro_result metro_ensemble_measure(const metro_ensemble *ensemble, double *squared, double *error)
{
    metroi_ensemble run;
    metro_result result;
    if (!metroi_ensemble_valid(ensemble)) return METRO_ERROR_ARGUMENT;
    result = metroi_modes_make(ensemble->target, ensemble->harmonics, &run.modes);
    if (result != METRO_OK) return result;
    run.ensemble = ensemble;
    run.jobs = ensemble->jobs > 0 ? ensemble->jobs : 64;
    run.chains = (ensemble->chains - 1) / run.jobs + 1;
    result = metroi_ensemble_run(&run, squared, error);
    metroi_modes_free(&run.modes);
    return result;
}

/* # 8 Pictures

   What a method computes is a picture, and whether it computed it well is a number: the distance from a reference.
   This chapter holds the picture in memory, reads and writes it in the two simplest formats that exist, and measures
   it. */

/* # 8.1 The picture

   Radiance is a density and a sum of many small parts, so a picture keeps doubles in linear units. Clamping and
   curves belong to the way it is shown. The one thing to watch is the size: width times height times channels comes
   from outside and may overflow. */

static int metroi_size_multiply(size_t a, size_t b, size_t *product)
{
    if (a != 0 && b > SIZE_MAX / a) return 0;
    *product = a * b;
    return 1;
}

METRO_API metro_result metro_image_make(size_t width, size_t height, size_t channels, metro_image *image)
{
    size_t size;
    double *value;
    if (image == NULL || width == 0 || height == 0 || (channels != 1 && channels != 3)) return METRO_ERROR_ARGUMENT;
    if (!metroi_size_multiply(width, height, &size)) return METRO_ERROR_MEMORY;
    if (!metroi_size_multiply(size, channels * sizeof *value, &size)) return METRO_ERROR_MEMORY;
    value = (double *)METRO_MALLOC(size);
    if (value == NULL) return METRO_ERROR_MEMORY;
    memset(value, 0, size);
    image->width = width;
    image->height = height;
    image->channels = channels;
    image->value = value;
    return METRO_OK;
}

METRO_API void metro_image_free(metro_image *image)
{
    if (image == NULL) return;
    METRO_FREE(image->value);
    memset(image, 0, sizeof *image);
}

/* A picture that a caller hands in is worth working on when it has pixels. */

static int metroi_image_holds(const metro_image *image)
{
    return image != NULL && image->value != NULL && image->width > 0 && image->height > 0
        && (image->channels == 1 || image->channels == 3);
}

METRO_API size_t metro_image_not_finite(const metro_image *image)
{
    size_t count = 0, i, samples;
    if (!metroi_image_holds(image)) return 0;
    samples = image->width * image->height * image->channels;
    for (i = 0; i < samples; i++) count += isfinite(image->value[i]) ? 0u : 1u;
    return count;
}

/* # 8.2 Colour

   Red, green and blue are those of sRGB (Rec. 709 primaries, white point D65). Luminance weighs them as the eye does;
   the three weights add up to 1, so grey keeps its value:

       Y = 0.212671 R + 0.715160 G + 0.072169 B                                       (8.1) */

METRO_API double metro_luminance(double red, double green, double blue)
{
    return 0.212671 * red + 0.715160 * green + 0.072169 * blue; /* eq 8.1 */
}

static double metroi_image_luminance(const metro_image *image, size_t pixel)
{
    const double *value = image->value + pixel * image->channels;
    return image->channels == 1 ? value[0] : metro_luminance(value[0], value[1], value[2]);
}

/* Screens expect values on a curve that spends its 256 steps where the eye sees them: a power, with a straight piece
   near black, where the power would be infinitely steep (IEC 61966-2-1):

       s(x) = 12.92 x                        "for" x <= 0.0031308
       s(x) = 1.055 x^{1/2.4} - 0.055        "otherwise"                                         (8.2)

       x(s) = frac{s}{12.92}                          "for" s <= 0.04045
       x(s) = (frac{s + 0.055}{1.055})^{2.4}          "otherwise"                                (8.3)

   The two thresholds are the published, rounded ones: the pieces do not quite meet, but the gap is less than a
   hundred-thousandth of one of 256 steps. */

METRO_API double metro_srgb_encode(double linear)
{
    return linear <= 0.0031308 ? 12.92 * linear : 1.055 * pow(linear, 1.0 / 2.4) - 0.055; /* eq 8.2 */
}

METRO_API double metro_srgb_decode(double encoded)
{
    return encoded <= 0.04045 ? encoded / 12.92 : pow((encoded + 0.055) / 1.055, 2.4); /* eq 8.3 */
}

/* # 8.3 Numbers in text

   The functions of the C library that read and write fractions follow the locale: in one half of Europe `strtod`
   reads `0.5` as 0. So we read digits ourselves. A text is a run of bytes with a place in it, and nothing reads
   beyond its end. */

typedef struct {
    const unsigned char *bytes;
    size_t size, at;
} metroi_text;

/* The byte at the place, or -1 at the end. */
static int metroi_text_peek(const metroi_text *text)
{
    return text->at < text->size ? text->bytes[text->at] : -1;
}

static int metroi_is_blank(int byte)
{
    return byte == ' ' || (byte >= '\t' && byte <= '\r');
}

static int metroi_is_digit(int byte)
{
    return byte >= '0' && byte <= '9';
}

/* Moves past white space and past comments, which run from a `#` to the end of the line. */
static void metroi_text_skip(metroi_text *text)
{
    int comment = 0, byte;
    while ((byte = metroi_text_peek(text)) >= 0 && (comment || byte == '#' || metroi_is_blank(byte))) {
        comment = byte == '#' || (comment && byte != '\n' && byte != '\r');
        text->at++;
    }
}

/* A number ends where white space, a comment or the end of the text begins; `12x` is none. */
static int metroi_text_ends(const metroi_text *text)
{
    int byte = metroi_text_peek(text);
    return byte < 0 || byte == '#' || metroi_is_blank(byte);
}

/* Reads a whole number of at most `most`. Returns 0 when there is none or it is larger. */
static int metroi_text_whole(metroi_text *text, size_t most, size_t *number)
{
    size_t value = 0, digits = 0;
    metroi_text_skip(text);
    for (; metroi_is_digit(metroi_text_peek(text)); digits++, text->at++) {
        size_t digit = (size_t)(text->bytes[text->at] - '0');
        if (digit > most || value > (most - digit) / 10) return 0;
        value = 10 * value + digit;
    }
    if (digits == 0 || !metroi_text_ends(text)) return 0;
    *number = value;
    return 1;
}

/* A fraction is a whole number times a power of ten. Up to 19 digits fit into 64 bits; further ones only shift the
   power. Where both parts are doubles without rounding (up to 2^53 and 10^22) their quotient or product is the
   nearest double (Clinger 1990); elsewhere the last digit or two of the sixteen may be off, which no radiance and no
   vertex shows. */

static double metroi_decimal(uint64_t digits, long power)
{
    double value = (double)digits;
    if (digits == 0) return 0.0;
    /* 10^-330 is 0 at once, while digits times 10^-330 need not be: two steps. */
    if (power < -300) return value * 1e-300 * pow(10.0, (double)(power + 300));
    return power < 0 ? value / pow(10.0, (double)-power) : value * pow(10.0, (double)power);
}

/* Reads the digits of a number, with a point among them, as a whole number times 10^power. Returns how many there
   were. */
static size_t metroi_text_digits(metroi_text *text, uint64_t *digits, long *power)
{
    size_t count = 0, point = 0;
    for (;; text->at++) {
        int byte = metroi_text_peek(text);
        if (byte == '.' && !point) {
            point = 1;
        } else if (metroi_is_digit(byte)) {
            int fits = *digits < UINT64_C(1000000000000000000);
            if (fits) *digits = 10 * *digits + (uint64_t)(byte - '0');
            *power += (fits ? 0 : 1) - (point ? 1 : 0);
            count++;
        } else {
            return count;
        }
    }
}

/* Reads a number such as `-1.0`, `.5` or `2e-3`. Returns 0 when there is none; a magnitude too large is infinite. */
static int metroi_text_real(metroi_text *text, double *number)
{
    uint64_t digits = 0;
    long power = 0, exponent = 0, sign;
    metroi_text_skip(text);
    sign = metroi_text_peek(text) == '-' ? -1 : 1;
    if (sign < 0 || metroi_text_peek(text) == '+') text->at++;
    if (metroi_text_digits(text, &digits, &power) == 0) return 0;
    if (metroi_text_peek(text) == 'e' || metroi_text_peek(text) == 'E') {
        int down;
        text->at++;
        down = metroi_text_peek(text) == '-';
        if (down || metroi_text_peek(text) == '+') text->at++;
        if (!metroi_is_digit(metroi_text_peek(text))) return 0;
        for (; metroi_is_digit(metroi_text_peek(text)); text->at++)
            if (exponent < 100000) exponent = 10 * exponent + (text->bytes[text->at] - '0');
        power += down ? -exponent : exponent;
    }
    if (!metroi_text_ends(text)) return 0;
    *number = (double)sign * metroi_decimal(digits, power);
    return 1;
}

/* # 8.4 Reading

   PPM and PFM are alike: a line of text that says what follows, then the samples.

       P6                    PF                  a colour PFM; Pf is grey
       # made by hand        640 480             width and height
       640 480               -1.0                little endian; positive: big endian
       255                   (4-byte floats, bottom row first)
       (bytes, top row first)

   In a P3 the samples are decimal numbers, and a PPM with a maxval above 255 has two bytes a sample, the high one
   first.

   A file is a claim that somebody else makes, so we believe nothing before it is checked: the header, then that all
   samples are there and that nothing follows them but the end of a line, or in a P3 white space. Only then are the
   pixels allocated. What is wrong goes back as a sentence in `why`. */

typedef struct {
    int is_float, is_text, is_big;   /* PFM; P3; PFM with the high byte first */
    size_t width, height, channels, samples;
    size_t most;                     /* PPM: maxval */
    double scale;                    /* PFM: the magnitude of the scale */
} metroi_header;

/* The kind of file, from its first two bytes. Returns why it is none of ours, or NULL. */
static const char *metroi_header_kind(metroi_text *text, metroi_header *header)
{
    int first = metroi_text_peek(text), second;
    if (first < 0) return "the file is empty; save the picture again";
    text->at++;
    second = metroi_text_peek(text);
    text->at++;
    memset(header, 0, sizeof *header);
    header->is_float = second == 'F' || second == 'f';
    header->is_text = second == '3';
    header->channels = second == 'f' ? 1 : 3;
    if (first != 'P' || !(header->is_float || header->is_text || second == '6') || !metroi_text_ends(text))
        return "the file begins with none of P6, P3, PF and Pf; convert the picture to PPM or PFM";
    return NULL;
}

/* The size, and how many samples it makes. More samples than the file has bytes are a lie in every format, and a
   product that overflows is one too. */
static const char *metroi_header_size(metroi_text *text, metroi_header *header)
{
    const size_t most = SIZE_MAX / 16;
    size_t pixels;
    if (!metroi_text_whole(text, most, &header->width) || !metroi_text_whole(text, most, &header->height))
        return "the header has no width and height that are whole numbers of a possible size; save the picture again";
    if (header->width == 0 || header->height == 0) return "the picture has no pixels: its width or height is 0";
    if (!metroi_size_multiply(header->width, header->height, &pixels)
        || !metroi_size_multiply(pixels, header->channels, &header->samples) || header->samples > text->size)
        return "the header asks for more pixels than the file holds: the file was cut off or its size is wrong";
    return NULL;
}

/* The last number of the header, and the one byte of white space behind it. */
static const char *metroi_header_range(metroi_text *text, metroi_header *header)
{
    double scale = 0;
    if (header->is_float) {
        if (!metroi_text_real(text, &scale) || !isfinite(scale) || scale == 0)
            return "the third line of a PFM must be its scale, a finite number other than 0 such as -1.0";
        header->is_big = scale > 0;
        header->scale = fabs(scale);
    } else if (!metroi_text_whole(text, 65535, &header->most) || header->most == 0) {
        return "the maxval of a PPM must be a whole number from 1 to 65535";
    }
    if (!metroi_is_blank(metroi_text_peek(text)))
        return "the header does not end in white space: the file was cut off or is damaged";
    text->at++;
    return NULL;
}

/* One sample of a PFM: the bits of a float, whichever way round. */
static double metroi_read_float(const unsigned char *byte, const metroi_header *header)
{
    int big = header->is_big;
    uint32_t bits = (uint32_t)byte[big ? 3 : 0] | (uint32_t)byte[big ? 2 : 1] << 8
        | (uint32_t)byte[big ? 1 : 2] << 16 | (uint32_t)byte[big ? 0 : 3] << 24;
    float value;
    memcpy(&value, &bits, sizeof value);
    return (double)value * header->scale;
}

/* Moves past one sample and reads it. Returns why it cannot be read, or NULL. */
static const char *metroi_read_sample(metroi_text *text, const metroi_header *header, double *value)
{
    const char *cut_off = "the file ends before its last pixel: it was cut off or the size in its header is wrong";
    const char *damaged = "a sample is not a whole number from 0 to the maxval of the header: the file is damaged";
    size_t width = header->is_float ? 4 : header->most > 255 ? 2 : 1, number;
    if (header->is_text) {
        metroi_text_skip(text);
        if (text->at == text->size) return cut_off;
        if (!metroi_text_whole(text, header->most, &number)) return damaged;
    } else {
        const unsigned char *byte = text->bytes + text->at;
        if (text->size - text->at < width) return cut_off;
        text->at += width;
        if (header->is_float) {
            *value = metroi_read_float(byte, header);
            return NULL;
        }
        number = width == 2 ? (size_t)byte[0] << 8 | byte[1] : byte[0];
        if (number > header->most) return damaged;
    }
    *value = (double)number / (double)header->most;
    return NULL;
}

/* Goes through all samples without keeping any, then looks for what does not belong behind them. */
static const char *metroi_raster_check(metroi_text text, const metroi_header *header)
{
    size_t i;
    double value;
    for (i = 0; i < header->samples; i++) {
        const char *why = metroi_read_sample(&text, header, &value);
        if (why != NULL) return why;
    }
    if (header->is_text) metroi_text_skip(&text);
    else if (metroi_text_peek(&text) == '\n') text.at++;
    return text.at < text.size ? "the file goes on after its last pixel: the size in its header is wrong" : NULL;
}

/* Reads the samples, which are known to be good, into `image`: the first row of a PFM is the bottom one. */
static void metroi_raster_read(metroi_text text, const metroi_header *header, metro_image *image)
{
    size_t row = header->width * header->channels, y, i;
    for (y = 0; y < header->height; y++) {
        double *value = image->value + row * (header->is_float ? header->height - 1 - y : y);
        for (i = 0; i < row; i++) {
            metroi_read_sample(&text, header, &value[i]);
            if (!header->is_float) value[i] = metro_srgb_decode(value[i]);
        }
    }
}

static metro_result metroi_image_parse(const unsigned char *bytes, size_t size, metro_image *image, const char **why)
{
    metroi_text text;
    metroi_header header;
    text.bytes = bytes;
    text.size = size;
    text.at = 0;
    *why = metroi_header_kind(&text, &header);
    if (*why == NULL) *why = metroi_header_size(&text, &header);
    if (*why == NULL) *why = metroi_header_range(&text, &header);
    if (*why == NULL) *why = metroi_raster_check(text, &header);
    if (*why != NULL) return METRO_ERROR_FORMAT;
    if (metro_image_make(header.width, header.height, header.channels, image) != METRO_OK) {
        *why = "there is not enough memory for the pixels; use a smaller picture";
        return METRO_ERROR_MEMORY;
    }
    metroi_raster_read(text, &header, image);
    return METRO_OK;
}

/* Copies `part` to the place `at` of the message, as far as it fits with its closing zero. Returns the place behind
   it. */
static size_t metroi_tell_part(char *message, size_t message_size, size_t at, const char *part)
{
    while (*part != 0 && at + 1 < message_size) message[at++] = *part++;
    message[at] = 0;
    return at;
}

/* The message names the file, where there is one, and why it was refused; on success it is empty. */
static void metroi_tell(char *message, size_t message_size, const char *path, const char *why)
{
    size_t at = 0;
    if (message == NULL || message_size == 0) return;
    message[0] = 0;
    if (why == NULL) return;
    if (path != NULL) {
        at = metroi_tell_part(message, message_size, at, path);
        at = metroi_tell_part(message, message_size, at, ": ");
    }
    metroi_tell_part(message, message_size, at, why);
}

METRO_API metro_result metro_image_parse(const unsigned char *bytes, size_t size, metro_image *image, char *message,
                                         size_t message_size)
{
    const char *why = "no bytes or no picture was given; see the contract of metro_image_parse";
    metro_result result = METRO_ERROR_ARGUMENT;
    if (image != NULL && (bytes != NULL || size == 0)) result = metroi_image_parse(bytes, size, image, &why);
    metroi_tell(message, message_size, NULL, why);
    return result;
}

/* A file is read whole, into memory of its own size. The first byte is read before anything else: a folder can be
   opened but not read, and claims the largest size there is. */

static metro_result metroi_file_read(FILE *file, unsigned char **bytes, size_t *size, const char **why)
{
    long end;
    *why = "the file cannot be read; check that it is an ordinary file and that its disk is there";
    (void)fgetc(file);
    if (ferror(file) || fseek(file, 0, SEEK_END) != 0 || (end = ftell(file)) < 0 || fseek(file, 0, SEEK_SET) != 0)
        return METRO_ERROR_FILE;
    *size = (size_t)end;
    *bytes = (unsigned char *)METRO_MALLOC(*size + 1);
    if (*bytes == NULL) {
        *why = "there is not enough memory for the file; use a smaller picture";
        return METRO_ERROR_MEMORY;
    }
    *size = fread(*bytes, 1, *size, file);
    if (ferror(file)) return METRO_ERROR_FILE;
    *why = NULL;
    return METRO_OK;
}

METRO_API metro_result metro_image_load(const char *path, metro_image *image, char *message, size_t message_size)
{
    const char *why = "no path or no picture was given; see the contract of metro_image_load";
    metro_result result = METRO_ERROR_ARGUMENT;
    unsigned char *bytes = NULL;
    size_t size = 0;
    if (path != NULL && image != NULL) {
        FILE *file = fopen(path, "rb");
        why = "the file cannot be opened; check that it exists and that you may read it";
        result = file == NULL ? METRO_ERROR_FILE : metroi_file_read(file, &bytes, &size, &why);
        if (file != NULL) fclose(file);
        if (result == METRO_OK) result = metroi_image_parse(bytes, size, image, &why);
        METRO_FREE(bytes);
    }
    metroi_tell(message, message_size, path, why);
    return result;
}

/* # 8.5 Writing

   A long run that is killed while it saves, or a disk that is full, must not leave half a picture where a whole one
   was. So we write a sibling, `PATH.tmp`, and rename it when every byte has arrived: within a folder a rename happens
   at once or not at all. A device or a pipe is not replaced (a program that runs as root would otherwise put a file
   where /dev/null was) but written to; nor is anything in /dev and /proc, where /dev/stdout leads to an ordinary file
   if the shell says so. */

typedef struct {
    FILE *file;
    const char *path;
    char *sibling; /* NULL: written directly */
} metroi_output;

#ifdef _WIN32
static int metroi_is_special(const char *path)
{
    (void)path;
    return 0;
}
#else
#include <sys/stat.h>
static int metroi_is_special(const char *path)
{
    struct stat status;
    if (strncmp(path, "/dev/", 5) == 0 || strncmp(path, "/proc/", 6) == 0) return 1;
    return stat(path, &status) == 0 && !S_ISREG(status.st_mode);
}
#endif

static metro_result metroi_output_open(const char *path, metroi_output *output)
{
    size_t length = strlen(path);
    output->path = path;
    output->sibling = NULL;
    if (!metroi_is_special(path)) {
        output->sibling = (char *)METRO_MALLOC(length + 5);
        if (output->sibling == NULL) return METRO_ERROR_MEMORY;
        memcpy(output->sibling, path, length);
        memcpy(output->sibling + length, ".tmp", 5);
    }
    output->file = fopen(output->sibling != NULL ? output->sibling : path, "wb");
    if (output->file != NULL) return METRO_OK;
    METRO_FREE(output->sibling);
    return METRO_ERROR_FILE;
}

/* Closes the file and puts it in its place. A full disk may show only here, when the last block is written. */
static metro_result metroi_output_close(metroi_output *output)
{
    int good = !ferror(output->file), keep = 0;
    good = fclose(output->file) == 0 && good;
    if (output->sibling != NULL) {
#ifdef _WIN32
        keep = good && remove(output->path) == 0; /* rename does not replace there; where it fails, this is left */
#endif
        good = good && rename(output->sibling, output->path) == 0;
        if (!good && !keep) remove(output->sibling);
        METRO_FREE(output->sibling);
    }
    return good ? METRO_OK : METRO_ERROR_FILE;
}

/* The nearest float. A double beyond their range has no defined conversion; the upper half of the last step rounds to
   infinity. */
static float metroi_float(double value)
{
    const double largest = 3.4028234663852886e38; /* (2 - 2^-23) 2^127 */
    const double end = 3.4028235677973366e38;     /* (2 - 2^-24) 2^127 */
    if (fabs(value) >= end) return value > 0 ? (float)METROI_INFINITY : -(float)METROI_INFINITY;
    if (fabs(value) > largest) return value > 0 ? (float)largest : -(float)largest;
    return (float)value;
}

/* The four bytes of a float, the low one first. */
static void metroi_write_float(double value, unsigned char byte[4])
{
    float single = metroi_float(value);
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    byte[0] = (unsigned char)(bits & 255);
    byte[1] = (unsigned char)(bits >> 8 & 255);
    byte[2] = (unsigned char)(bits >> 16 & 255);
    byte[3] = (unsigned char)(bits >> 24);
}

/* The nearest of 256 steps on the sRGB curve. The comparison is turned so that NaN fails it and becomes black. */
static unsigned char metroi_write_byte(double value)
{
    if (!(value > 0)) return 0;
    return value >= 1 ? 255 : (unsigned char)(255.0 * metro_srgb_encode(value) + 0.5); /* eq 8.2 */
}

METRO_API metro_result metro_image_save_pfm(const metro_image *image, const char *path)
{
    metroi_output output;
    metro_result result;
    size_t row, y, i;
    if (!metroi_image_holds(image) || path == NULL) return METRO_ERROR_ARGUMENT;
    result = metroi_output_open(path, &output);
    if (result != METRO_OK) return result;
    row = image->width * image->channels;
    fprintf(output.file, "%s\n%lu %lu\n-1.0\n", image->channels == 1 ? "Pf" : "PF", (unsigned long)image->width,
            (unsigned long)image->height);
    for (y = image->height; y-- > 0;) {
        for (i = 0; i < row; i++) {
            unsigned char byte[4];
            metroi_write_float(image->value[y * row + i], byte);
            fwrite(byte, 1, 4, output.file);
        }
    }
    return metroi_output_close(&output);
}

METRO_API metro_result metro_image_save_ppm(const metro_image *image, const char *path)
{
    metroi_output output;
    metro_result result;
    size_t pixel, pixels, c;
    if (!metroi_image_holds(image) || path == NULL) return METRO_ERROR_ARGUMENT;
    result = metroi_output_open(path, &output);
    if (result != METRO_OK) return result;
    pixels = image->width * image->height;
    fprintf(output.file, "P6\n%lu %lu\n255\n", (unsigned long)image->width, (unsigned long)image->height);
    for (pixel = 0; pixel < pixels; pixel++) {
        unsigned char byte[3];
        for (c = 0; c < 3; c++)
            byte[c] = metroi_write_byte(image->value[pixel * image->channels + (image->channels == 1 ? 0 : c)]);
        fwrite(byte, 1, 3, output.file);
    }
    return metroi_output_close(&output);
}

/* # 8.6 The error of a picture

   Two numbers, because each hides something. The relative root mean square error compares energies: a lamp in the
   picture decides it alone.

       epsilon = sqrt{frac{sum (I - R)^2}{sum R^2}}                                   (8.4)

   relMSE weighs each pixel by its own brightness, as the eye does. With $X$ the luminance of the picture and $Y$ that
   of the reference, the second term of the denominator keeps the pixels that are nearly black from ruling:

       "relMSE" = frac{1}{n} sum_{j=1}^{n} frac{(X_j - Y_j)^2}{Y_j^2 + 0.01 m^2},
       m = frac{1}{n} sum_{j=1}^{n} Y_j                                               (8.5)

   [figure: picture_sheet.svg | What a chain has seen of a picture after more and more mutations.]

   A reference is itself a long run, and where it is off by its own noise of variance $V_j$ the error of even a
   perfect picture is not 0 but, in the mean,

       "noise" = frac{1}{n} sum_{j=1}^{n} frac{V_j}{Y_j^2 + 0.01 m^2}                 (8.6)

   which is to be subtracted. The relMSE of an unbiased method falls as one over its time, so 1 / (relMSE seconds) is
   its efficiency, whatever time it was given; a method whose efficiency falls is held back by something that time
   does not cure. */

static int metroi_images_alike(const metro_image *a, const metro_image *b)
{
    return metroi_image_holds(a) && metroi_image_holds(b) && a->width == b->width && a->height == b->height;
}

static double metroi_image_mean(const metro_image *image)
{
    metro_sum sum = { 0, 0 };
    size_t pixel, pixels = image->width * image->height;
    for (pixel = 0; pixel < pixels; pixel++) metro_sum_add(&sum, metroi_image_luminance(image, pixel));
    return metro_sum_value(&sum) / (double)pixels;
}

/* The denominator of eq 8.5 in one pixel. */
static double metroi_relmse_unit(const metro_image *reference, size_t pixel, double mean)
{
    double y = metroi_image_luminance(reference, pixel);
    return y * y + 0.01 * mean * mean;
}

/* The largest difference of a sample. A NaN wins against every number and stays. */
static void metroi_difference_largest(const metro_image *a, const metro_image *b, metro_image_difference *difference)
{
    size_t i, samples = a->width * a->height * a->channels;
    difference->largest = 0;
    difference->x = difference->y = 0;
    for (i = 0; i < samples && !isnan(difference->largest); i++) {
        double size = fabs(a->value[i] - b->value[i]);
        if (size <= difference->largest) continue;
        difference->largest = size;
        difference->x = i / a->channels % a->width;
        difference->y = i / a->channels / a->width;
    }
}

METRO_API metro_result metro_image_error(const metro_image *image, const metro_image *reference,
                                         metro_image_difference *difference)
{
    metro_sum error = { 0, 0 }, energy = { 0, 0 }, relative = { 0, 0 };
    size_t i, pixels;
    if (difference == NULL || !metroi_images_alike(image, reference) || image->channels != reference->channels)
        return METRO_ERROR_ARGUMENT;
    pixels = image->width * image->height;
    difference->mean = metroi_image_mean(image);
    difference->mean_reference = metroi_image_mean(reference);
    for (i = 0; i < pixels * image->channels; i++) {
        double off = image->value[i] - reference->value[i];
        metro_sum_add(&error, off * off);
        metro_sum_add(&energy, reference->value[i] * reference->value[i]);
    }
    for (i = 0; i < pixels; i++) {
        double off = metroi_image_luminance(image, i) - metroi_image_luminance(reference, i);
        metro_sum_add(&relative, off * off / metroi_relmse_unit(reference, i, difference->mean_reference));
    }
    difference->relative_rmse = sqrt(metro_sum_value(&error) / metro_sum_value(&energy)); /* eq 8.4 */
    difference->relmse = metro_sum_value(&relative) / (double)pixels;                     /* eq 8.5 */
    metroi_difference_largest(image, reference, difference);
    return METRO_OK;
}

METRO_API metro_result metro_image_noise(const metro_image *reference, const metro_image *variance, double *relmse)
{
    metro_sum sum = { 0, 0 };
    size_t i, pixels;
    double mean;
    if (relmse == NULL || !metroi_images_alike(reference, variance)) return METRO_ERROR_ARGUMENT;
    pixels = reference->width * reference->height;
    mean = metroi_image_mean(reference);
    for (i = 0; i < pixels; i++)
        metro_sum_add(&sum, metroi_image_luminance(variance, i) / metroi_relmse_unit(reference, i, mean));
    *relmse = metro_sum_value(&sum) / (double)pixels; /* eq 8.6 */
    return METRO_OK;
}

#ifndef METRO_NO_TRACER

/* # 9 Geometry

   Triangles only: whatever is curved or has many corners can be cut into them, and one kind of surface needs one kind
   of care. This chapter holds them, says what their normals and areas are, and reads them from the files that
   modelling programs write. */

/* # 9.1 Triangles

   A corner is three floats. Rounding it once, when it is added, and taking everything from the rounded numbers means
   that the ray tracer, the lamps and the normals all speak of the same triangle: no light leaks where two of them
   would disagree by a digit. What is computed from the corners is computed in double. The product of two edges has a
   size between 1e-90 and 1e78, so its square neither overflows nor vanishes, and no scaling is needed.

   These small functions are asked at every hit, and what is METROI_INLINE is inlined where it is used. Vectors then
   stay in registers, which makes the walks of chapter 12 up to a tenth faster. */

METROI_WARM
#if defined(__GNUC__) || defined(__clang__)
#define METROI_INLINE __attribute__((always_inline)) static inline
#else
#define METROI_INLINE static inline
#endif

METROI_INLINE metro_vec3 metroi_triangle_corner(const metro_scene *scene, uint32_t triangle, int k)
{
    const float *corner = scene->corner + 9 * (size_t)triangle + 3 * (size_t)k;
    return metro_vec3_make((double)corner[0], (double)corner[1], (double)corner[2]);
}

METROI_INLINE void metroi_triangle_corners(const metro_scene *scene, uint32_t triangle, metro_vec3 p[3])
{
    int k;
    for (k = 0; k < 3; k++) p[k] = metroi_triangle_corner(scene, triangle, k);
}

/* The product of the edges: it stands on the triangle, and its length is twice the area,

       n = frac{e_1 "x" e_2}{abs(e_1 "x" e_2)},   A = frac{1}{2} abs(e_1 "x" e_2)            (9.1)

   where e_1 = p_1 - p_0 and e_2 = p_2 - p_0. */

typedef struct {
    metro_vec3 corner[3], normal;
    double area2, per_area2; /* twice the area, and one over it */
} metroi_facet;

METROI_INLINE metroi_facet metroi_facet_of(const metro_scene *scene, uint32_t triangle)
{
    metroi_facet facet;
    metro_vec3 cross;
    metroi_triangle_corners(scene, triangle, facet.corner);
    cross = metro_cross(metro_subtract(facet.corner[1], facet.corner[0]),
                        metro_subtract(facet.corner[2], facet.corner[0]));
    facet.area2 = sqrt(metro_dot(cross, cross));
    facet.per_area2 = 1 / facet.area2;
    facet.normal = metro_scale(cross, facet.per_area2); /* eq 9.1; 0 times infinity is NaN */
    return facet;
}

/* What is linear between three corners, at (1-u-v) p0 + u p1 + v p2. */

METROI_INLINE metro_vec3 metroi_between(const metro_vec3 p[3], double u, double v)
{
    return metro_add(metro_scale(p[0], 1 - u - v), metro_add(metro_scale(p[1], u), metro_scale(p[2], v)));
}

static double metroi_triangle_area(const metro_scene *scene, uint32_t triangle)
{
    return 0.5 * metroi_facet_of(scene, triangle).area2;
}

/* Material 0 is always there and stands in no list. */

static const metro_material *metroi_scene_material(const metro_scene *scene, uint32_t material)
{
    static const metro_material plain = { { 0.5, 0.5, 0.5 }, { 0, 0, 0 }, 0, { 0, 0, 0 } };
    return material == 0 ? &plain : &scene->material[material - 1];
}

METROI_COLD

/* For users the same is public, and checks what it is asked for. */

METRO_API const metro_material *metro_scene_material(const metro_scene *scene, uint32_t material)
{
    if (scene == NULL || material > scene->material_count) return NULL;
    return metroi_scene_material(scene, material);
}

METRO_API metro_vec3 metro_scene_corner(const metro_scene *scene, uint32_t triangle, int k)
{
    if (scene == NULL || triangle >= scene->triangle_count || k < 0 || k > 2)
        return metro_vec3_make(METROI_NAN, METROI_NAN, METROI_NAN);
    return metroi_triangle_corner(scene, triangle, k);
}

static int metroi_triangle_is_finite(const metro_scene *scene, uint32_t triangle)
{
    const float *corner = scene->corner + 9 * (size_t)triangle;
    int i;
    for (i = 0; i < 9; i++)
        if (!isfinite(corner[i])) return 0;
    return 1;
}

METRO_API metro_vec3 metro_scene_normal(const metro_scene *scene, uint32_t triangle)
{
    if (scene == NULL || triangle >= scene->triangle_count || !metroi_triangle_is_finite(scene, triangle))
        return metro_vec3_make(METROI_NAN, METROI_NAN, METROI_NAN);
    return metroi_facet_of(scene, triangle).normal;
}

METRO_API double metro_scene_area(const metro_scene *scene, uint32_t triangle)
{
    if (scene == NULL || triangle >= scene->triangle_count || !metroi_triangle_is_finite(scene, triangle))
        return METROI_NAN;
    return metroi_triangle_area(scene, triangle);
}

/* # 9.2 Filling a scene

   Lists grow by half of their size, so that adding an item costs the same on average however many there are. The new
   size is checked before it is multiplied out. */

static void *metroi_grown(void *block, size_t *room, size_t need, size_t item)
{
    size_t wanted = *room + *room / 2, bytes;
    void *grown;
    if (wanted < need) wanted = need;
    if (wanted < 16) wanted = 16;
    if (!metroi_size_multiply(wanted, item, &bytes)) return NULL;
    grown = block == NULL ? METRO_MALLOC(bytes) : METRO_REALLOC(block, bytes);
    if (grown != NULL) *room = wanted;
    return grown;
}

/* Makes room for `more` triangles. The two lists share one count of their room: where the second one fails, the first
   is longer than it says, which harms nobody. */

static metro_result metroi_scene_grow(metro_scene *scene, size_t more)
{
    const size_t most = 0xffffffffu; /* numbers of triangles have 32 bits, and the last one is left free */
    size_t need, room;
    void *grown;
    if (scene->triangle_count > most || more > most - scene->triangle_count) return METRO_ERROR_MEMORY;
    need = scene->triangle_count + more;
    if (need <= scene->triangle_room) return METRO_OK;
    room = scene->triangle_room;
    grown = metroi_grown(scene->corner, &room, need, 9 * sizeof *scene->corner);
    if (grown == NULL) return METRO_ERROR_MEMORY;
    scene->corner = (float *)grown;
    room = scene->triangle_room;
    grown = metroi_grown(scene->material_of, &room, need, sizeof *scene->material_of);
    if (grown == NULL) return METRO_ERROR_MEMORY;
    scene->material_of = (uint32_t *)grown;
    scene->triangle_room = room;
    return METRO_OK;
}

METRO_API metro_result metro_scene_add_triangle(metro_scene *scene, const metro_vec3 corner[3], uint32_t material)
{
    metro_result result;
    float *place;
    size_t k;
    if (scene == NULL || corner == NULL || scene->bvh != NULL || material > scene->material_count)
        return METRO_ERROR_ARGUMENT;
    result = metroi_scene_grow(scene, 1);
    if (result != METRO_OK) return result;
    place = scene->corner + 9 * scene->triangle_count;
    for (k = 0; k < 3; k++) {
        place[3 * k] = metroi_float(corner[k].x);
        place[3 * k + 1] = metroi_float(corner[k].y);
        place[3 * k + 2] = metroi_float(corner[k].z);
    }
    scene->material_of[scene->triangle_count++] = material;
    return METRO_OK;
}

/* A material must not send out more than it receives, in any colour, or light would grow with every reflection. The
   comparisons are turned so that NaN fails them. */

static int metroi_color_is_good(metro_vec3 color)
{
    return color.x >= 0 && color.y >= 0 && color.z >= 0 && isfinite(color.x) && isfinite(color.y)
        && isfinite(color.z);
}

static int metroi_material_is_good(const metro_material *material)
{
    const double most = 1 + 1e-9;
    metro_vec3 sum = metro_add(material->kd, material->ks);
    return metroi_color_is_good(material->kd) && metroi_color_is_good(material->ks)
        && metroi_color_is_good(material->ke) && sum.x <= most && sum.y <= most && sum.z <= most
        && material->ns >= 0 && isfinite(material->ns);
}

METRO_API metro_result metro_scene_add_material(metro_scene *scene, const metro_material *material, uint32_t *index)
{
    if (scene == NULL || material == NULL || index == NULL || scene->bvh != NULL) return METRO_ERROR_ARGUMENT;
    if (!metroi_material_is_good(material)) return METRO_ERROR_ARGUMENT;
    if (scene->material_count >= 0xfffffffeu) return METRO_ERROR_MEMORY;
    if (scene->material_count == scene->material_room) {
        size_t need = scene->material_count + 1;
        void *grown = metroi_grown(scene->material, &scene->material_room, need, sizeof *material);
        if (grown == NULL) return METRO_ERROR_MEMORY;
        scene->material = (metro_material *)grown;
    }
    scene->material[scene->material_count++] = *material;
    *index = (uint32_t)scene->material_count;
    return METRO_OK;
}

/* # 9.3 What a scene is as a whole

   Its box, over the triangles that are finite. */

METRO_API metro_result metro_scene_bounds(const metro_scene *scene, metro_vec3 *low, metro_vec3 *high)
{
    float least[3], most[3];
    size_t i, k, found = 0;
    if (scene == NULL || low == NULL || high == NULL) return METRO_ERROR_ARGUMENT;
    for (k = 0; k < 3; k++) {
        least[k] = (float)INFINITY;
        most[k] = -(float)INFINITY;
    }
    for (i = 0; i < scene->triangle_count; i++) {
        const float *corner = scene->corner + 9 * i;
        if (!metroi_triangle_is_finite(scene, (uint32_t)i)) continue;
        for (k = 0; k < 9; k++) {
            if (corner[k] < least[k % 3]) least[k % 3] = corner[k];
            if (corner[k] > most[k % 3]) most[k % 3] = corner[k];
        }
        found++;
    }
    if (found == 0) return METRO_ERROR_ARGUMENT;
    *low = metro_vec3_make((double)least[0], (double)least[1], (double)least[2]);
    *high = metro_vec3_make((double)most[0], (double)most[1], (double)most[2]);
    return METRO_OK;
}

/* A sphere of radius r is just inside a cone of half the angle fov/2 from the distance

       d = frac{r}{sin("fov"/2)}                                                      (9.2)

   and the vertical angle fov is the narrowest of a picture that is not higher than wide. A scene that is a single
   point is given a radius of 1. */

METRO_API metro_result metro_scene_frame(const metro_scene *scene, metro_camera *camera)
{
    const double fov = 40;
    metro_vec3 low, high, middle;
    double radius;
    if (camera == NULL || metro_scene_bounds(scene, &low, &high) != METRO_OK) return METRO_ERROR_ARGUMENT;
    middle = metro_scale(metro_add(low, high), 0.5);
    radius = 0.5 * metro_length(metro_subtract(high, low));
    if (!(radius > 0)) radius = 1;
    camera->look = middle;
    camera->eye = metro_add(middle, metro_vec3_make(0, 0, radius / sin(fov * METROI_PI / 360))); /* eq 9.2 */
    camera->up = metro_vec3_make(0, 1, 0);
    camera->fov = fov;
    return METRO_OK;
}

/* The lamps are the triangles that emit and have an area. A lamp is chosen with a probability proportional to its
   area times the luminance of its emission; for that we keep running sums, scaled so that the last one is 1, and look
   up a uniform number among them. The sum before the scaling, times pi, is the luminous power of the scene. */

static double metroi_triangle_power(const metro_scene *scene, size_t triangle)
{
    metro_vec3 ke = metroi_scene_material(scene, scene->material_of[triangle])->ke;
    double luminance = metro_luminance(ke.x, ke.y, ke.z), area;
    if (!(luminance > 0)) return 0;
    area = metroi_triangle_area(scene, (uint32_t)triangle);
    return area > 0 && isfinite(area) ? area * luminance : 0;
}

static void metroi_scene_lights_forget(metro_scene *scene)
{
    METRO_FREE(scene->light);
    METRO_FREE(scene->light_sum);
    scene->light = NULL;
    scene->light_sum = NULL;
    scene->light_count = 0;
    scene->light_power = 0;
}

/* Lists the lamps. METRO_ERROR_ARGUMENT when their power is too large for a number; on failure there are none. */

static metro_result metroi_scene_lights(metro_scene *scene)
{
    metro_sum sum = { 0, 0 };
    size_t i, count = 0;
    metroi_scene_lights_forget(scene);
    for (i = 0; i < scene->triangle_count; i++) count += metroi_triangle_power(scene, i) > 0;
    if (count == 0) return METRO_OK;
    /* Fewer than 2^32 items of 8 bytes: on a machine whose sizes have 32 bits the triangles would not have fitted. */
    scene->light = (uint32_t *)METRO_MALLOC(count * sizeof *scene->light);
    scene->light_sum = (double *)METRO_MALLOC(count * sizeof *scene->light_sum);
    if (scene->light == NULL || scene->light_sum == NULL) {
        metroi_scene_lights_forget(scene);
        return METRO_ERROR_MEMORY;
    }
    for (i = 0; i < scene->triangle_count; i++) {
        double power = metroi_triangle_power(scene, i);
        if (!(power > 0)) continue;
        metro_sum_add(&sum, power);
        scene->light[scene->light_count] = (uint32_t)i;
        scene->light_sum[scene->light_count++] = metro_sum_value(&sum);
    }
    scene->light_power = metro_sum_value(&sum);
    if (!isfinite(scene->light_power)) {
        metroi_scene_lights_forget(scene);
        return METRO_ERROR_ARGUMENT;
    }
    for (i = 0; i < count; i++) scene->light_sum[i] /= scene->light_power;
    return METRO_OK;
}

/* # 9.4 Lines of text

   An OBJ file is lines, and so is an MTL file. Each begins with a keyword, and may go on below when its last byte is
   a backslash. Files come with the line ends of Unix, of Windows, and from old machines with carriage returns alone;
   some begin with the three bytes that mark UTF-8. We even all this out before anything else, in place: the end of a
   line is a line feed, a line that goes on has a vertical tab where it was broken (white space that still counts as a
   line), and everything else stays where it was. A comment does not go on: `# C:\models\` is the end of more than one
   of them. */

typedef struct {
    const char *file;      /* for messages */
    metroi_text text;      /* the whole file */
    metroi_text line;      /* the current line, without its end */
    size_t number, joined; /* the number of its first line, and how many it takes */
    int are_joined;        /* some lines go on below */
} metroi_lines;

/* Is the place `at` behind a `#` that begins a word of its line? Each line is looked back into at most once, from its
   end. */
static int metroi_in_comment(const unsigned char *bytes, size_t at)
{
    for (; at > 0 && bytes[at - 1] != '\n' && bytes[at - 1] != '\v'; at--)
        if (bytes[at] == '#' && metroi_is_blank(bytes[at - 1])) return 1;
    return bytes[at] == '#';
}

/* Returns whether a line goes on below. */
static int metroi_lines_even(unsigned char *bytes, size_t size)
{
    size_t i, end;
    int joined = 0;
    for (i = 0; i < size; i++) {
        const void *found = memchr(bytes + i, '\r', size - i);
        if (found == NULL) break;
        i = (size_t)((const unsigned char *)found - bytes);
        if (i + 1 == size || (bytes[i + 1] != '\n' && bytes[i + 1] != '\r')) bytes[i] = '\n';
    }
    if (size >= 3 && memcmp(bytes, "\xef\xbb\xbf", 3) == 0) memset(bytes, ' ', 3);
    for (i = 0; i < size; i++) {
        const void *found = memchr(bytes + i, '\\', size - i);
        if (found == NULL) return joined;
        i = (size_t)((const unsigned char *)found - bytes);
        end = i + 1;
        if (end < size && bytes[end] == '\r') end++;
        if (end == size || bytes[end] != '\n' || metroi_in_comment(bytes, i)) continue;
        memset(bytes + i, ' ', end - i);
        bytes[end] = '\v';
        joined = 1;
    }
    return joined;
}

static metroi_lines metroi_lines_make(const char *file, unsigned char *bytes, size_t size)
{
    metroi_lines lines;
    memset(&lines, 0, sizeof lines);
    lines.are_joined = metroi_lines_even(bytes, size);
    lines.file = file;
    lines.text.bytes = bytes;
    lines.text.size = size;
    lines.joined = 1;
    return lines;
}

/* Goes on to the next line, with the place at its first byte that is not blank; 0 at the end of the file. */
static int metroi_lines_next(metroi_lines *lines)
{
    metroi_text *text = &lines->text, *line = &lines->line;
    const void *end;
    size_t i;
    if (text->at >= text->size) return 0;
    line->bytes = text->bytes + text->at;
    end = memchr(line->bytes, '\n', text->size - text->at);
    line->size = end != NULL ? (size_t)((const unsigned char *)end - line->bytes) : text->size - text->at;
    line->at = 0;
    text->at += line->size + 1;
    lines->number += lines->joined;
    lines->joined = 1;
    for (i = 0; lines->are_joined && i < line->size; i++) lines->joined += line->bytes[i] == '\v';
    while (metroi_is_blank(metroi_text_peek(line))) line->at++;
    return 1;
}

/* Is `word` the next word of the line? If so the place moves behind it. */
static int metroi_line_word(metroi_text *line, const char *word)
{
    size_t length = strlen(word), end = line->at + length;
    if (line->size - line->at < length || memcmp(line->bytes + line->at, word, length) != 0) return 0;
    if (end < line->size && !metroi_is_blank(line->bytes[end])) return 0;
    line->at = end;
    while (metroi_is_blank(metroi_text_peek(line))) line->at++;
    return 1;
}

/* # 9.5 What the reader has to say

   An error ends the reading and takes the message for itself. A warning joins those before it, once a kind. Every one
   begins with the file and the line. */

enum {
    METROI_WARN_LIBRARY,
    METROI_WARN_NAME,
    METROI_WARN_BRIGHT,
    METROI_WARN_GLOSSY,
    METROI_WARN_NEGATIVE,
    METROI_WARN_CLEAR,
    METROI_WARN_TEXTURE,
    METROI_WARN_ILLUM,
    METROI_WARN_CORNERS,
    METROI_WARN_CROSSED,
    METROI_WARN_INFINITE,
    METROI_WARN_CAMERA
};

typedef struct {
    const unsigned char *text;
    size_t length;
} metroi_slice;

typedef struct {
    char *message;
    size_t size, at;
    unsigned long told; /* one bit a kind */
} metroi_notes;

static void metroi_notes_add(metroi_notes *notes, const char *part)
{
    if (notes->message != NULL && notes->size > 0)
        notes->at = metroi_tell_part(notes->message, notes->size, notes->at, part);
}

static void metroi_notes_slice(metroi_notes *notes, metroi_slice slice)
{
    size_t i;
    char part[2] = { 0, 0 };
    for (i = 0; i < slice.length && notes->at + 1 < notes->size; i++) {
        part[0] = (char)slice.text[i];
        if (part[0] != 0) metroi_notes_add(notes, part);
    }
}

static void metroi_notes_number(metroi_notes *notes, size_t number)
{
    char digits[24];
    size_t at = sizeof digits - 1;
    digits[at] = 0;
    do digits[--at] = (char)('0' + number % 10);
    while ((number /= 10) > 0);
    metroi_notes_add(notes, digits + at);
}

static void metroi_notes_place(metroi_notes *notes, const char *file, size_t line)
{
    metroi_notes_add(notes, file);
    metroi_notes_add(notes, ":");
    metroi_notes_number(notes, line);
    metroi_notes_add(notes, ": ");
}

/* Is this the first warning of its kind? Then its place is written, and the caller goes on with what is wrong. */
static int metroi_notes_warn(metroi_notes *notes, int kind, const char *file, size_t line)
{
    if ((notes->told >> kind & 1) != 0) return 0;
    notes->told |= 1ul << kind;
    if (notes->at > 0) metroi_notes_add(notes, "\n");
    metroi_notes_place(notes, file, line);
    return 1;
}

/* An error: forgets the warnings. */
static metro_result metroi_notes_refuse(metroi_notes *notes, const metroi_lines *lines, const char *why)
{
    notes->at = 0;
    metroi_notes_place(notes, lines->file, lines->number);
    metroi_notes_add(notes, why);
    return METRO_ERROR_FORMAT;
}

static metro_result metroi_notes_memory(metroi_notes *notes, const char *file)
{
    notes->at = 0;
    metroi_notes_add(notes, file);
    metroi_notes_add(notes, ": there is not enough memory for the scene");
    return METRO_ERROR_MEMORY;
}

/* # 9.6 Names

   A file may name a hundred thousand materials, and each `usemtl` looks one up. The names wait in a list, in the
   order they were met, and a table of slots finds them: a name starts looking at the slot that a hash of its bytes
   says, and takes the first free one after it. At most half of the slots are taken. The hash mixes every byte in
   thoroughly, so that names which count up do not crowd together. */

typedef struct {
    metroi_slice slice;
    size_t line;       /* where it was met first */
    uint32_t material; /* the number in the scene; 0 until it is defined */
    int is_defined;    /* a material in an MTL file; an MTL file that could be read */
    int is_tried;      /* an MTL file */
} metroi_name;

typedef struct {
    metroi_name *name;
    size_t count, room;
    size_t *slot; /* [slots]: 1 + the number of a name, 0 where free; slots is a power of two */
    size_t slots;
} metroi_names;

static void metroi_names_free(metroi_names *names)
{
    METRO_FREE(names->name);
    METRO_FREE(names->slot);
}

static uint64_t metroi_slice_hash(metroi_slice slice)
{
    uint64_t hash = slice.length;
    size_t i;
    for (i = 0; i < slice.length; i++) hash = metroi_mix(hash + slice.text[i] + UINT64_C(0x9e3779b97f4a7c15));
    return hash;
}

/* The slot where `slice` stands, or the free one where it would. There must be slots. */
static size_t metroi_names_slot(const metroi_names *names, metroi_slice slice)
{
    size_t at = (size_t)metroi_slice_hash(slice) & (names->slots - 1);
    for (; names->slot[at] != 0; at = (at + 1) & (names->slots - 1)) {
        metroi_slice other = names->name[names->slot[at] - 1].slice;
        if (other.length == slice.length && memcmp(other.text, slice.text, slice.length) == 0) break;
    }
    return at;
}

/* The name `slice`, or NULL. */
static metroi_name *metroi_names_find(const metroi_names *names, metroi_slice slice)
{
    size_t at;
    if (names->slots == 0) return NULL;
    at = names->slot[metroi_names_slot(names, slice)];
    return at != 0 ? &names->name[at - 1] : NULL;
}

/* Doubles the slots and puts every name into its new one. */
static int metroi_names_widen(metroi_names *names)
{
    size_t slots = names->slots > 0 ? 2 * names->slots : 32, bytes, i;
    size_t *slot;
    if (!metroi_size_multiply(slots, sizeof *slot, &bytes)) return 0;
    slot = (size_t *)METRO_MALLOC(bytes);
    if (slot == NULL) return 0;
    memset(slot, 0, bytes);
    METRO_FREE(names->slot);
    names->slot = slot;
    names->slots = slots;
    for (i = 0; i < names->count; i++) slot[metroi_names_slot(names, names->name[i].slice)] = i + 1;
    return 1;
}

/* Adds `slice` unless it is there. Returns 1 + its number, or 0 when there is no memory. The bytes are not copied. */
static size_t metroi_names_add(metroi_names *names, metroi_slice slice, size_t line)
{
    metroi_name *name;
    size_t at;
    if (2 * (names->count + 1) > names->slots && !metroi_names_widen(names)) return 0;
    at = metroi_names_slot(names, slice);
    if (names->slot[at] != 0) return names->slot[at];
    if (names->count == names->room) {
        void *grown = metroi_grown(names->name, &names->room, names->count + 1, sizeof *name);
        if (grown == NULL) return 0;
        names->name = (metroi_name *)grown;
    }
    name = &names->name[names->count++];
    memset(name, 0, sizeof *name);
    name->slice = slice;
    name->line = line;
    names->slot[at] = names->count;
    return names->count;
}

/* A name is the rest of its line without the blanks around it, since names have blanks in them, and even `#`. Only a
   `#` that stands alone begins a comment. */
static metroi_slice metroi_line_rest(const metroi_text *line)
{
    metroi_slice rest;
    size_t end = line->at;
    while (end < line->size) {
        int stands_alone = line->bytes[end] == '#' && end > 0 && metroi_is_blank(line->bytes[end - 1])
            && (end + 1 == line->size || metroi_is_blank(line->bytes[end + 1]));
        if (stands_alone) break;
        end++;
    }
    while (end > line->at && metroi_is_blank(line->bytes[end - 1])) end--;
    rest.text = line->bytes + line->at;
    rest.length = end - line->at;
    return rest;
}

/* # 9.7 Vertices and faces

   The reader collects what it finds in a scene of its own, which joins the caller's at the end, so that a file that
   turns out bad leaves no trace. While it reads, the material of a triangle is the number of a name: the MTL file may
   be named later, and most of its materials may never be used. */

typedef struct {
    metro_scene part;
    metroi_notes notes;
    metroi_lines lines;
    float *vertex; /* [3 * vertices] */
    size_t vertices, vertex_room;
    size_t *corner; /* [corners]: the vertices of the polygon being read */
    size_t corners, corner_room;
    int64_t ear_work; /* what cutting ears may still cost */
    metroi_names materials, libraries;
    metroi_slice wanted; /* the name after `usemtl` */
    size_t wanted_line;
    uint32_t material; /* 1 + the number of that name, once a face uses it */
    int is_wanted;     /* no face has used it */
} metroi_reader;

static void metroi_reader_free(metroi_reader *reader)
{
    METRO_FREE(reader->part.corner);
    METRO_FREE(reader->part.material_of);
    METRO_FREE(reader->part.material);
    METRO_FREE(reader->vertex);
    METRO_FREE(reader->corner);
    metroi_names_free(&reader->materials);
    metroi_names_free(&reader->libraries);
}

/* A coordinate. Programs that divided by zero write `nan`, `-inf` or `-1.#IND`, which are kept as NaN: a broken
   vertex should not cost the whole scene. Returns 0 where there is no number. */
static int metroi_line_coordinate(metroi_text *line, double *number)
{
    size_t start = line->at;
    int byte;
    if (metroi_text_real(line, number)) {
        if (metroi_text_peek(line) != '#' || line->bytes[line->at - 1] != '.') return 1;
        while (metroi_text_peek(line) >= 0 && !metroi_is_blank(metroi_text_peek(line))) line->at++;
        *number = METROI_NAN;
        return 1;
    }
    line->at = start;
    metroi_text_skip(line);
    byte = metroi_text_peek(line);
    if (byte == '-' || byte == '+') {
        line->at++;
        byte = metroi_text_peek(line);
    }
    if (byte != 'n' && byte != 'N' && byte != 'i' && byte != 'I') return 0;
    while (!metroi_text_ends(line)) line->at++;
    *number = METROI_NAN;
    return 1;
}

/* `v x y z`; a fourth number is a weight of curves that we do not read, and more are colours. */
static metro_result metroi_read_vertex(metroi_reader *reader)
{
    double number = 0;
    float *place;
    int k, finite = 1;
    if (reader->vertices == reader->vertex_room) {
        void *grown = metroi_grown(reader->vertex, &reader->vertex_room, reader->vertices + 1, 3 * sizeof *place);
        if (grown == NULL) return METRO_ERROR_MEMORY;
        reader->vertex = (float *)grown;
    }
    place = reader->vertex + 3 * reader->vertices;
    for (k = 0; k < 3; k++) {
        if (!metroi_line_coordinate(&reader->lines.line, &number))
            return metroi_notes_refuse(&reader->notes, &reader->lines,
                                       "a vertex (v) needs three numbers such as 0.5 -1 2e-3");
        place[k] = metroi_float(number);
        finite = finite && isfinite(place[k]);
    }
    if (!finite && metroi_notes_warn(&reader->notes, METROI_WARN_INFINITE, reader->lines.file, reader->lines.number))
        metroi_notes_add(&reader->notes, "a vertex is not finite: its triangles are never hit");
    reader->vertices++;
    return METRO_OK;
}

/* A vertex that is not there: the message says which, and how many are. */
static metro_result metroi_refuse_corner(metroi_reader *reader, metroi_slice number)
{
    metroi_notes_refuse(&reader->notes, &reader->lines, "a face (f) uses the vertex ");
    metroi_notes_slice(&reader->notes, number);
    metroi_notes_add(&reader->notes, ", which is not there: ");
    metroi_notes_number(&reader->notes, reader->vertices);
    metroi_notes_add(&reader->notes, reader->vertices == 1 ? " stands above it" : " stand above it");
    return METRO_ERROR_FORMAT;
}

/* A corner of a face is `v`, `v/vt`, `v//vn` or `v/vt/vn`, and only v matters here. It counts the vertices from 1, or
   from the latest one backwards with -1, -2, ... A number too long to hold is too large in any case. */
static metro_result metroi_read_corner(metroi_reader *reader, size_t *vertex)
{
    metroi_text *line = &reader->lines.line;
    size_t number = 0, digits = 0;
    int back = metroi_text_peek(line) == '-';
    metroi_slice word;
    word.text = line->bytes + line->at;
    if (back) line->at++;
    for (; metroi_is_digit(metroi_text_peek(line)); digits++, line->at++)
        if (number <= SIZE_MAX / 20) number = 10 * number + (size_t)(line->bytes[line->at] - '0');
    if (digits == 0 || (metroi_text_peek(line) != '/' && !metroi_text_ends(line)))
        return metroi_notes_refuse(&reader->notes, &reader->lines,
                                   "a corner of a face (f) is not a whole number such as 3, 3/1, 3//2 or -1");
    word.length = digits + (size_t)back;
    while (!metroi_text_ends(line)) line->at++;
    if (number == 0)
        return metroi_notes_refuse(&reader->notes, &reader->lines,
                                   "a face (f) uses vertex 0; the first vertex is number 1");
    if (number > reader->vertices) return metroi_refuse_corner(reader, word);
    *vertex = back ? reader->vertices - number : number - 1;
    return METRO_OK;
}

static metro_result metroi_read_corners(metroi_reader *reader)
{
    metroi_text *line = &reader->lines.line;
    reader->corners = 0;
    for (;;) {
        metro_result result;
        metroi_text_skip(line);
        if (line->at == line->size) return METRO_OK;
        if (reader->corners == reader->corner_room) {
            void *grown = metroi_grown(reader->corner, &reader->corner_room, reader->corners + 1,
                                       sizeof *reader->corner);
            if (grown == NULL) return METRO_ERROR_MEMORY;
            reader->corner = (size_t *)grown;
        }
        result = metroi_read_corner(reader, &reader->corner[reader->corners]);
        if (result != METRO_OK) return result;
        reader->corners++;
    }
}

/* Adds the triangle of three vertices; there is room for it. */
static void metroi_reader_triangle(metroi_reader *reader, size_t a, size_t b, size_t c)
{
    float *place = reader->part.corner + 9 * reader->part.triangle_count;
    memcpy(place, reader->vertex + 3 * a, 3 * sizeof *place);
    memcpy(place + 3, reader->vertex + 3 * b, 3 * sizeof *place);
    memcpy(place + 6, reader->vertex + 3 * c, 3 * sizeof *place);
    reader->part.material_of[reader->part.triangle_count++] = reader->material;
}

/* # 9.8 Polygons

   A triangle is itself. A convex polygon, or any other that can be seen whole from its first corner, is the fan from
   there. The rest would be covered by a fan twice in one place and not at all in another, so we cut ears: a corner is
   an ear when the polygon turns left there and no other corner is inside the triangle with its two neighbours. Every
   polygon that does not cross itself has two ears (Meisters 1975), and without one of them it is a polygon of one
   corner less.

   Left and right need a plane. The normal of a polygon that need not be quite flat is the sum of the products of its
   edges (Newell's method); we drop the axis along which that is longest, and order the other two so that the polygon
   goes round counterclockwise. */

typedef struct {
    const float *vertex;
    size_t *corner; /* [count]: what is left of the polygon */
    size_t count;
    int across, up; /* the two axes that are kept */
    int64_t work;   /* corners looked at and moved */
} metroi_polygon;

/* Twice the area of the triangle of three vertices in the plane: positive when it goes round counterclockwise. */
static double metroi_polygon_turn(const metroi_polygon *polygon, size_t a, size_t b, size_t c)
{
    const float *p = polygon->vertex + 3 * a, *q = polygon->vertex + 3 * b, *r = polygon->vertex + 3 * c;
    int x = polygon->across, y = polygon->up;
    return ((double)q[x] - (double)p[x]) * ((double)r[y] - (double)p[y])
        - ((double)q[y] - (double)p[y]) * ((double)r[x] - (double)p[x]);
}

/* Chooses the plane. Each of three planes is asked for the area of the polygon in it, summed as a fan, since the
   components of Newell's normal are just that. Returns 0 when the polygon has no area. */
static int metroi_polygon_flatten(metroi_polygon *polygon)
{
    const size_t *corner = polygon->corner;
    int axis, best = 0;
    double most = 0;
    for (axis = 0; axis < 3; axis++) {
        double area = 0;
        size_t i;
        polygon->across = (axis + 1) % 3;
        polygon->up = (axis + 2) % 3;
        for (i = 1; i + 1 < polygon->count; i++)
            area += metroi_polygon_turn(polygon, corner[0], corner[i], corner[i + 1]);
        if (!(fabs(area) > fabs(most))) continue;
        most = area;
        best = axis;
    }
    polygon->across = (best + (most > 0 ? 1 : 2)) % 3;
    polygon->up = (best + (most > 0 ? 2 : 1)) % 3;
    return most != 0 && isfinite(most);
}

/* The corner `steps` after corner i, going round. */
static size_t metroi_polygon_at(const metroi_polygon *polygon, size_t i, size_t steps)
{
    size_t at = i + steps;
    return polygon->corner[at < polygon->count ? at : at - polygon->count];
}

/* Can the whole polygon be seen from its first corner? Then no triangle of the fan turns right. */
static int metroi_polygon_is_fan(const metroi_polygon *polygon)
{
    const size_t *corner = polygon->corner;
    size_t i;
    for (i = 1; i + 1 < polygon->count; i++)
        if (metroi_polygon_turn(polygon, corner[0], corner[i], corner[i + 1]) < 0) return 0;
    return 1;
}

static int metroi_vertices_agree(const metroi_polygon *polygon, size_t a, size_t b)
{
    const float *p = polygon->vertex + 3 * a, *q = polygon->vertex + 3 * b;
    return p[0] == q[0] && p[1] == q[1] && p[2] == q[2];
}

/* Does the line from a over b to c turn back at b, or stand still? Asked where the three are in line. */
static int metroi_polygon_turns_back(const metroi_polygon *polygon, size_t a, size_t b, size_t c)
{
    const float *p = polygon->vertex + 3 * a, *q = polygon->vertex + 3 * b, *r = polygon->vertex + 3 * c;
    int x = polygon->across, y = polygon->up;
    return ((double)p[x] - (double)q[x]) * ((double)r[x] - (double)q[x])
               + ((double)p[y] - (double)q[y]) * ((double)r[y] - (double)q[y])
        >= 0;
}

/* Is the corner after corner i an ear? A hole is written as a polygon with a cut from its border to the hole, whose
   ends are there twice: a corner at the same place as one of the three does not spoil the ear. The tip of a spike
   without width goes at once, since an ear beside it would not be one. Any other corner in line with its neighbours
   stays while there are ears (`flat` says that there are none): the polygon next door may share it, and an edge that
   runs past it would leave a crack. */
static int metroi_polygon_is_ear(metroi_polygon *polygon, size_t i, int flat)
{
    size_t a = polygon->corner[i], b = metroi_polygon_at(polygon, i, 1), c = metroi_polygon_at(polygon, i, 2), j;
    double turn = metroi_polygon_turn(polygon, a, b, c);
    polygon->work++;
    if (!(turn > 0)) return turn == 0 && (flat || metroi_polygon_turns_back(polygon, a, b, c));
    for (j = 0; j < polygon->count; j++) {
        size_t d = polygon->corner[j];
        polygon->work++;
        if (metroi_polygon_turn(polygon, a, b, d) < 0 || metroi_polygon_turn(polygon, b, c, d) < 0
            || metroi_polygon_turn(polygon, c, a, d) < 0)
            continue;
        if (!metroi_vertices_agree(polygon, d, a) && !metroi_vertices_agree(polygon, d, b)
            && !metroi_vertices_agree(polygon, d, c))
            return 0;
    }
    return 1;
}

/* Cuts the ear after corner i off. */
static void metroi_polygon_cut_ear(metroi_reader *reader, metroi_polygon *polygon, size_t i)
{
    size_t ear = i + 1 < polygon->count ? i + 1 : 0;
    metroi_reader_triangle(reader, polygon->corner[i], polygon->corner[ear], metroi_polygon_at(polygon, i, 2));
    polygon->count--;
    polygon->work += (int64_t)((polygon->count - ear) / 8);
    memmove(polygon->corner + ear, polygon->corner + ear + 1, (polygon->count - ear) * sizeof *polygon->corner);
}

/* Cuts ears until a triangle is left, or no ear is found, or the work exceeds what the polygons so far may cost: to
   know an ear may take a look at every other corner, and a file of one polygon with a million corners should not take
   a day. A spiral of a thousand corners costs four million looks. */

enum { METROI_EAR_WORK = 2000, METROI_EAR_SPARE = 100000000 };

static void metroi_polygon_cut(metroi_reader *reader, metroi_polygon *polygon)
{
    size_t misses = 0, i = 0;
    reader->ear_work += METROI_EAR_WORK * (int64_t)polygon->count;
    while (polygon->count > 3 && misses < 2 * polygon->count && polygon->work < reader->ear_work) {
        if (i >= polygon->count) i = 0;
        if (metroi_polygon_is_ear(polygon, i, misses >= polygon->count)) {
            metroi_polygon_cut_ear(reader, polygon, i);
            misses = 0;
        } else {
            misses++;
            i++;
        }
    }
    reader->ear_work -= polygon->work;
}

/* Splits the polygon that was read. The last triangle, and what ears could not be cut from, is a fan. */
static metro_result metroi_reader_split(metroi_reader *reader)
{
    metroi_polygon polygon;
    size_t i;
    if (metroi_scene_grow(&reader->part, reader->corners - 2) != METRO_OK) return METRO_ERROR_MEMORY;
    polygon.vertex = reader->vertex;
    polygon.corner = reader->corner;
    polygon.count = reader->corners;
    polygon.work = 0;
    if (polygon.count > 3 && metroi_polygon_flatten(&polygon) && !metroi_polygon_is_fan(&polygon)) {
        metroi_polygon_cut(reader, &polygon);
        if (polygon.count > 3
            && metroi_notes_warn(&reader->notes, METROI_WARN_CROSSED, reader->lines.file, reader->lines.number))
            metroi_notes_add(&reader->notes,
                             "a polygon crosses itself or is too intricate: it may be covered wrongly; cut it into "
                             "triangles in the program that wrote the file");
    }
    for (i = 1; i + 1 < polygon.count; i++)
        metroi_reader_triangle(reader, polygon.corner[0], polygon.corner[i], polygon.corner[i + 1]);
    return METRO_OK;
}

/* `f` and its corners. The name of the material is looked up when a face uses it. */
static metro_result metroi_read_face(metroi_reader *reader)
{
    metro_result result = metroi_read_corners(reader);
    if (result != METRO_OK) return result;
    if (reader->corners < 3) {
        if (metroi_notes_warn(&reader->notes, METROI_WARN_CORNERS, reader->lines.file, reader->lines.number))
            metroi_notes_add(&reader->notes, "a face (f) has fewer than three corners and is left out");
        return METRO_OK;
    }
    if (reader->is_wanted) {
        size_t name = metroi_names_add(&reader->materials, reader->wanted, reader->wanted_line);
        if (name == 0 || name > 0xfffffffeu) return METRO_ERROR_MEMORY;
        reader->material = (uint32_t)name;
        reader->is_wanted = 0;
    }
    return metroi_reader_split(reader);
}

/* # 9.9 The OBJ file

   Of the other keywords, `vt`, `vn`, `g`, `o` and `s` do not change what we draw, points, lines and curved surfaces
   are not drawn, and what is unknown is skipped: files live longer than the programs that read them. */

static int metroi_read_vector(metroi_text *line, metro_vec3 *vector)
{
    double number[3];
    int k;
    for (k = 0; k < 3; k++)
        if (!metroi_text_real(line, &number[k]) || !isfinite(number[k])) return 0;
    *vector = metro_vec3_make(number[0], number[1], number[2]);
    while (metroi_is_blank(metroi_text_peek(line))) line->at++;
    return 1;
}

/* The camera hides in a comment, where other programs do not look. */
static void metroi_read_camera(metroi_reader *reader)
{
    metroi_text *line = &reader->lines.line;
    metro_camera camera;
    line->at++; /* past the `#` */
    while (metroi_is_blank(metroi_text_peek(line))) line->at++;
    if (!metroi_line_word(line, "camera") || !metroi_line_word(line, "eye")) return;
    if (metroi_read_vector(line, &camera.eye) && metroi_line_word(line, "look")
        && metroi_read_vector(line, &camera.look) && metroi_line_word(line, "up")
        && metroi_read_vector(line, &camera.up) && metroi_line_word(line, "fov")
        && metroi_text_real(line, &camera.fov) && isfinite(camera.fov)) {
        reader->part.camera = camera;
        reader->part.has_camera = 1;
        return;
    }
    if (metroi_notes_warn(&reader->notes, METROI_WARN_CAMERA, reader->lines.file, reader->lines.number))
        metroi_notes_add(&reader->notes, "left out, since a camera line has the form "
                                         "# camera eye x y z look x y z up x y z fov DEGREES");
}

/* Material names and MTL files are only noted here. */
static metro_result metroi_read_usemtl(metroi_reader *reader)
{
    reader->wanted = metroi_line_rest(&reader->lines.line);
    reader->wanted_line = reader->lines.number;
    reader->is_wanted = reader->wanted.length > 0;
    reader->material = 0;
    return METRO_OK;
}

static metro_result metroi_read_mtllib(metroi_reader *reader)
{
    metroi_slice name = metroi_line_rest(&reader->lines.line);
    if (name.length == 0) return METRO_OK;
    return metroi_names_add(&reader->libraries, name, reader->lines.number) != 0 ? METRO_OK : METRO_ERROR_MEMORY;
}

static metro_result metroi_read_obj_line(metroi_reader *reader)
{
    metroi_text *line = &reader->lines.line;
    if (metroi_line_word(line, "v")) return metroi_read_vertex(reader);
    if (metroi_line_word(line, "f")) return metroi_read_face(reader);
    if (metroi_line_word(line, "usemtl")) return metroi_read_usemtl(reader);
    if (metroi_line_word(line, "mtllib")) return metroi_read_mtllib(reader);
    if (metroi_text_peek(line) == '#') metroi_read_camera(reader);
    return METRO_OK;
}

/* All lines of the file. Memory that is lacking is told of here, once for all the functions above. */
static metro_result metroi_read_obj(metroi_reader *reader, unsigned char *bytes, size_t size)
{
    metro_result result = METRO_OK;
    reader->lines = metroi_lines_make(reader->lines.file, bytes, size);
    while (result == METRO_OK && metroi_lines_next(&reader->lines)) result = metroi_read_obj_line(reader);
    if (result == METRO_OK && reader->part.triangle_count == 0) {
        reader->notes.at = 0;
        metroi_notes_add(&reader->notes, reader->lines.file);
        metroi_notes_add(&reader->notes, ": there is no face (f) in the file; is it an OBJ file?");
        return METRO_ERROR_FORMAT;
    }
    return result;
}

/* # 9.10 The MTL file

   A material is the lines from its `newmtl` to the next one. It is judged as a whole, and only when a face uses it;
   of two with one name the first one counts. */

typedef struct {
    metro_material material;
    metroi_name *name; /* NULL: nobody uses it, or it was defined before */
    size_t line;
    int has_kd, has_ke, is_negative, is_clear, has_texture;
    double illum;
} metroi_draft;

/* One number for all colours, or three. */
static int metroi_read_color(metroi_draft *draft, metroi_text *line, metro_vec3 *color)
{
    double part[3];
    int k;
    if (!metroi_text_real(line, &part[0]) || !isfinite(part[0])) return 0;
    metroi_text_skip(line);
    part[1] = part[2] = part[0];
    for (k = 1; k < 3 && line->at < line->size; k++)
        if (!metroi_text_real(line, &part[k]) || !isfinite(part[k])) return 0;
    if (k == 2) return 0;
    for (k = 0; k < 3; k++) {
        if (part[k] < 0) draft->is_negative = 1;
        if (!(part[k] > 0)) part[k] = 0;
    }
    *color = metro_vec3_make(part[0], part[1], part[2]);
    return 1;
}

static int metroi_read_exponent(metroi_draft *draft, metroi_text *line)
{
    double ns;
    if (!metroi_text_real(line, &ns) || !isfinite(ns)) return 0;
    if (ns < 0) draft->is_negative = 1;
    draft->material.ns = ns > 0 ? ns : 0;
    return 1;
}

/* What is not read, but would change the picture. `Tr` is 1 - d, and `Tr 1` is how some programs write opaque. */
static void metroi_read_ignored(metroi_draft *draft, metroi_text *line)
{
    double number = 0;
    if (metroi_line_word(line, "d")) {
        metroi_line_word(line, "-halo");
        if (metroi_text_real(line, &number) && number < 1) draft->is_clear = 1;
    } else if (metroi_line_word(line, "Tr")) {
        if (metroi_text_real(line, &number) && number > 0 && number < 1) draft->is_clear = 1;
    } else if (metroi_line_word(line, "illum")) {
        if (metroi_text_real(line, &number)) draft->illum = number;
    } else if (metroi_line_word(line, "bump") || metroi_line_word(line, "norm") || metroi_line_word(line, "disp")
               || metroi_line_word(line, "refl")) {
        draft->has_texture = 1;
    } else if (!metroi_line_word(line, "map_Ka") && !metroi_line_word(line, "map_aat")) {
        draft->has_texture |= line->size - line->at > 4 && memcmp(line->bytes + line->at, "map_", 4) == 0;
    }
}

/* A line of a material that is used. Returns 0 when it is wrong. */
static int metroi_read_mtl_line(metroi_draft *draft, metroi_text *line)
{
    if (metroi_line_word(line, "Kd")) {
        draft->has_kd = 1;
        return metroi_read_color(draft, line, &draft->material.kd);
    }
    if (metroi_line_word(line, "Ke")) {
        draft->has_ke = 1;
        return metroi_read_color(draft, line, &draft->material.ke);
    }
    if (metroi_line_word(line, "Ks")) return metroi_read_color(draft, line, &draft->material.ks);
    if (metroi_line_word(line, "Ns")) return metroi_read_exponent(draft, line);
    metroi_read_ignored(draft, line);
    return 1;
}

/* Programs write Ks .5 beside Kd .8 without a thought for energy. Takes what is too much from Ks. */
static int metroi_lower(double *kd, double *ks)
{
    int lowered = *kd + *ks > 1 + 1e-9;
    if (lowered) *ks = 1 - *kd;
    return lowered;
}

static int metroi_cap(double *value)
{
    int capped = *value > 1;
    if (capped) *value = 1;
    return capped;
}

static void metroi_draft_warn(metroi_reader *reader, const metroi_draft *draft, const char *file, int kind,
                              const char *what)
{
    if (!metroi_notes_warn(&reader->notes, kind, file, draft->line)) return;
    metroi_notes_add(&reader->notes, "material ");
    metroi_notes_slice(&reader->notes, draft->name->slice);
    metroi_notes_add(&reader->notes, what);
}

/* Makes the numbers of a material possible. What | joins is done for all three colours; || would stop early. */
static void metroi_draft_mend(metroi_reader *reader, metroi_draft *draft, const char *file)
{
    metro_vec3 *kd = &draft->material.kd, *ks = &draft->material.ks;
    if (!draft->has_kd && !draft->has_ke) *kd = metroi_scene_material(&reader->part, 0)->kd;
    if (draft->is_negative)
        metroi_draft_warn(reader, draft, file, METROI_WARN_NEGATIVE, " has a negative number; it is taken as 0");
    if (metroi_cap(&kd->x) | metroi_cap(&kd->y) | metroi_cap(&kd->z))
        metroi_draft_warn(reader, draft, file, METROI_WARN_BRIGHT, " has Kd above 1; it is taken as 1");
    if (metroi_lower(&kd->x, &ks->x) | metroi_lower(&kd->y, &ks->y) | metroi_lower(&kd->z, &ks->z))
        metroi_draft_warn(reader, draft, file, METROI_WARN_GLOSSY,
                          " has Kd + Ks above 1, more light than it receives; Ks is taken as 1 - Kd");
}

static void metroi_draft_tell(metroi_reader *reader, const metroi_draft *draft, const char *file)
{
    metro_vec3 ks = draft->material.ks;
    int is_glossy = ks.x > 0 || ks.y > 0 || ks.z > 0;
    if (draft->is_clear)
        metroi_draft_warn(reader, draft, file, METROI_WARN_CLEAR, " is transparent (d, Tr); it is drawn opaque");
    if (draft->has_texture)
        metroi_draft_warn(reader, draft, file, METROI_WARN_TEXTURE, " has textures (map_); they are not read");
    if (draft->illum > 2 && is_glossy)
        metroi_draft_warn(reader, draft, file, METROI_WARN_ILLUM,
                          " asks for a mirror or glass (illum); it is drawn with Kd, Ks and Ns alone");
    if (draft->illum >= 0 && draft->illum < 2 && is_glossy)
        metroi_draft_warn(reader, draft, file, METROI_WARN_ILLUM,
                          " switches Ks off (illum 0 or 1); it is drawn with Ks all the same");
}

/* The end of a material: into the scene with it, if a face uses it. */
static metro_result metroi_draft_close(metroi_reader *reader, metroi_draft *draft, const char *file)
{
    metro_result result;
    if (draft->name == NULL) return METRO_OK;
    metroi_draft_tell(reader, draft, file);
    metroi_draft_mend(reader, draft, file);
    result = metro_scene_add_material(&reader->part, &draft->material, &draft->name->material);
    if (result == METRO_OK) draft->name->is_defined = 1;
    return result;
}

static void metroi_draft_open(metroi_reader *reader, metroi_draft *draft, const metroi_lines *lines)
{
    metroi_slice slice = metroi_line_rest(&lines->line);
    memset(draft, 0, sizeof *draft);
    draft->illum = 2;
    draft->line = lines->number;
    draft->name = metroi_names_find(&reader->materials, slice);
    if (draft->name != NULL && draft->name->is_defined) draft->name = NULL;
}

static metro_result metroi_read_mtl(metroi_reader *reader, const char *file, unsigned char *bytes, size_t size)
{
    metroi_lines lines = metroi_lines_make(file, bytes, size);
    metroi_draft draft;
    memset(&draft, 0, sizeof draft);
    while (metroi_lines_next(&lines)) {
        if (metroi_line_word(&lines.line, "newmtl")) {
            metro_result result = metroi_draft_close(reader, &draft, file);
            if (result != METRO_OK) return result;
            metroi_draft_open(reader, &draft, &lines);
        } else if (draft.name != NULL && !metroi_read_mtl_line(&draft, &lines.line)) {
            return metroi_notes_refuse(&reader->notes, &lines,
                                       "Kd, Ks and Ke need one or three finite numbers, and Ns needs one");
        }
    }
    return metroi_draft_close(reader, &draft, file);
}

/* # 9.11 Finding the MTL file

   `mtllib` names files from the folder of the OBJ. Where a name cannot be opened we try what people meant: the last
   part of the path, since scenes move from the machine where they were made to another; and the words of the line,
   since it may name several files, though most programs mean one whose name has blanks. */

static int metroi_is_slash(int byte)
{
    return byte == '/' || byte == '\\';
}

/* The path of the file `name`, which is the caller's to free; NULL when there is no memory. */
static char *metroi_library_path(const char *obj, metroi_slice name)
{
    size_t folder = strlen(obj), i;
    char *path;
    while (folder > 0 && !metroi_is_slash(obj[folder - 1])) folder--;
    if (metroi_is_slash(name.text[0]) || (name.length > 1 && name.text[1] == ':')) folder = 0;
    path = (char *)METRO_MALLOC(folder + name.length + 1);
    if (path == NULL) return NULL;
    memcpy(path, obj, folder);
    for (i = 0; i < name.length; i++) path[folder + i] = name.text[i] == '\\' ? '/' : (char)name.text[i];
    path[folder + name.length] = 0;
    return path;
}

/* Reads one MTL file. `found` says whether it could be read. */
static metro_result metroi_library_read(metroi_reader *reader, metroi_slice name, int *found)
{
    char *path = metroi_library_path(reader->lines.file, name);
    metro_result result = METRO_ERROR_FILE;
    unsigned char *bytes = NULL;
    const char *why;
    size_t size = 0;
    FILE *file;
    if (path == NULL) return METRO_ERROR_MEMORY;
    file = metroi_is_special(path) ? NULL : fopen(path, "rb");
    if (file != NULL) {
        result = metroi_file_read(file, &bytes, &size, &why);
        fclose(file);
    }
    *found = result == METRO_OK;
    if (result == METRO_OK) result = metroi_read_mtl(reader, path, bytes, size);
    else if (result == METRO_ERROR_FILE) result = METRO_OK;
    METRO_FREE(bytes);
    METRO_FREE(path);
    return result;
}

/* The same file is read once, however often it is named. */
static metro_result metroi_library_try(metroi_reader *reader, metroi_slice slice, size_t line, int *found)
{
    size_t number = metroi_names_add(&reader->libraries, slice, line);
    metro_result result = METRO_OK;
    metroi_name *name;
    if (number == 0) return METRO_ERROR_MEMORY;
    name = &reader->libraries.name[number - 1];
    if (!name->is_tried) {
        result = metroi_library_read(reader, slice, &name->is_defined);
        name->is_tried = 1;
    }
    *found = *found || name->is_defined;
    return result;
}

/* A path, or else its last part beside the OBJ. */
static metro_result metroi_library_search(metroi_reader *reader, metroi_slice slice, size_t line, int *found)
{
    metro_result result = metroi_library_try(reader, slice, line, found);
    size_t at = slice.length;
    while (at > 0 && !metroi_is_slash(slice.text[at - 1])) at--;
    slice.text += at;
    slice.length -= at;
    if (result != METRO_OK || *found || at == 0 || slice.length == 0) return result;
    return metroi_library_try(reader, slice, line, found);
}

/* The next word of `rest`, which keeps what stands behind it. */
static metroi_slice metroi_slice_word(metroi_slice *rest)
{
    metroi_slice word = *rest;
    size_t at = 0;
    while (at < rest->length && !metroi_is_blank(rest->text[at])) at++;
    word.length = at;
    while (at < rest->length && metroi_is_blank(rest->text[at])) at++;
    rest->text += at;
    rest->length -= at;
    return word;
}

/* Does the line name several files? Then more than one of its words ends in `.mtl`. */
static int metroi_library_is_list(metroi_slice rest)
{
    int ends = 0;
    while (rest.length > 0) {
        metroi_slice word = metroi_slice_word(&rest);
        const unsigned char *end = word.text + word.length;
        if (word.length < 4 || end[-4] != '.') continue;
        ends += (end[-3] | 32) == 'm' && (end[-2] | 32) == 't' && (end[-1] | 32) == 'l';
    }
    return ends > 1;
}

/* Of several files each must be found; words that make one name are only a guess, and one of them will do. */
static metro_result metroi_read_library(metroi_reader *reader, metroi_slice slice, size_t line)
{
    metroi_slice rest = slice, missing = slice;
    int is_list = metroi_library_is_list(slice), found = 0, lacks = 0;
    metro_result result = is_list ? metroi_library_try(reader, slice, line, &found)
                                  : metroi_library_search(reader, slice, line, &found);
    if (result != METRO_OK || found) return result;
    while (rest.length > 0) {
        metroi_slice word = metroi_slice_word(&rest);
        int here = 0;
        result = metroi_library_search(reader, word, line, &here);
        if (result != METRO_OK) return result;
        if (is_list && !here && !lacks) missing = word;
        lacks = lacks || !here;
        found = found || here;
    }
    if (is_list ? !lacks : found) return METRO_OK;
    if (metroi_notes_warn(&reader->notes, METROI_WARN_LIBRARY, reader->lines.file, line)) {
        metroi_notes_add(&reader->notes, "the MTL file cannot be read (put it beside the OBJ, or correct mtllib): ");
        metroi_notes_slice(&reader->notes, missing);
    }
    return METRO_OK;
}

/* All MTL files, in the order of the lines that name them. Names that are tried on the way join the list behind
   these, and are not visited here. */
static metro_result metroi_read_libraries(metroi_reader *reader)
{
    size_t i, lines = reader->libraries.count;
    metro_result result = METRO_OK;
    for (i = 0; i < lines && result == METRO_OK; i++)
        result = metroi_read_library(reader, reader->libraries.name[i].slice, reader->libraries.name[i].line);
    return result;
}

/* # 9.12 Joining the caller's scene

   The triangles give up the numbers of names for those of materials. What was never defined becomes material 0. */

static void metroi_reader_settle(metroi_reader *reader)
{
    metroi_names *names = &reader->materials;
    size_t i;
    for (i = 0; i < names->count; i++) {
        if (names->name[i].is_defined) continue;
        if (!metroi_notes_warn(&reader->notes, METROI_WARN_NAME, reader->lines.file, names->name[i].line)) break;
        metroi_notes_add(&reader->notes, "no MTL file defines the material ");
        metroi_notes_slice(&reader->notes, names->name[i].slice);
        metroi_notes_add(&reader->notes, "; it is drawn with Kd 0.5");
    }
    for (i = 0; i < reader->part.triangle_count; i++) {
        uint32_t name = reader->part.material_of[i];
        reader->part.material_of[i] = name > 0 ? names->name[name - 1].material : 0;
    }
}

/* Copies the materials of `part` behind those of `scene`. */
static metro_result metroi_scene_join_materials(metro_scene *scene, const metro_scene *part)
{
    size_t count = scene->material_count + part->material_count;
    if (count > 0xfffffffeu) return METRO_ERROR_MEMORY;
    if (count > scene->material_room) {
        void *grown = metroi_grown(scene->material, &scene->material_room, count, sizeof *scene->material);
        if (grown == NULL) return METRO_ERROR_MEMORY;
        scene->material = (metro_material *)grown;
    }
    if (part->material_count > 0)
        memcpy(scene->material + scene->material_count, part->material,
               part->material_count * sizeof *scene->material);
    scene->material_count = count;
    return METRO_OK;
}

/* Gives back the room that the growing lists did not need. Where that fails they stay as they are. */
static void metroi_scene_trim(metro_scene *scene)
{
    void *trimmed = METRO_REALLOC(scene->corner, 9 * scene->triangle_count * sizeof *scene->corner);
    if (trimmed == NULL) return;
    scene->corner = (float *)trimmed;
    scene->triangle_room = scene->triangle_count;
    trimmed = METRO_REALLOC(scene->material_of, scene->triangle_count * sizeof *scene->material_of);
    if (trimmed != NULL) scene->material_of = (uint32_t *)trimmed;
}

/* Takes `part` into `scene`: into an empty one by handing over its lists, else by copying. */
static metro_result metroi_scene_join(metro_scene *scene, metro_scene *part)
{
    uint32_t first = (uint32_t)scene->material_count;
    size_t i;
    if (scene->corner == NULL && scene->material_of == NULL && scene->material == NULL) {
        if (!part->has_camera) part->camera = scene->camera;
        part->has_camera = part->has_camera || scene->has_camera;
        *scene = *part;
        memset(part, 0, sizeof *part);
        metroi_scene_trim(scene);
        return METRO_OK;
    }
    if (metroi_scene_grow(scene, part->triangle_count) != METRO_OK) return METRO_ERROR_MEMORY;
    if (metroi_scene_join_materials(scene, part) != METRO_OK) return METRO_ERROR_MEMORY;
    memcpy(scene->corner + 9 * scene->triangle_count, part->corner, 9 * part->triangle_count * sizeof *part->corner);
    for (i = 0; i < part->triangle_count; i++) {
        uint32_t material = part->material_of[i];
        scene->material_of[scene->triangle_count + i] = material > 0 ? first + material : 0;
    }
    scene->triangle_count += part->triangle_count;
    if (part->has_camera) scene->camera = part->camera;
    scene->has_camera = scene->has_camera || part->has_camera;
    return METRO_OK;
}

/* From the bytes of an OBJ to the scene. `mtl` holds the MTL, or is NULL when files are to be looked for. */
static metro_result metroi_scene_read(metro_scene *scene, metroi_reader *reader, unsigned char *obj, size_t obj_size,
                                      unsigned char *mtl, size_t mtl_size)
{
    metro_result result = metroi_read_obj(reader, obj, obj_size);
    if (result == METRO_OK && mtl != NULL) result = metroi_read_mtl(reader, "mtl", mtl, mtl_size);
    if (result == METRO_OK && mtl == NULL) result = metroi_read_libraries(reader);
    if (result == METRO_OK) {
        metroi_reader_settle(reader);
        result = metroi_scene_join(scene, &reader->part);
    }
    return result == METRO_ERROR_MEMORY ? metroi_notes_memory(&reader->notes, reader->lines.file) : result;
}

static void metroi_reader_make(metroi_reader *reader, const char *file, char *message, size_t message_size)
{
    memset(reader, 0, sizeof *reader);
    reader->ear_work = METROI_EAR_SPARE;
    reader->lines.file = file;
    reader->notes.message = message;
    reader->notes.size = message_size;
    if (message != NULL && message_size > 0) message[0] = 0;
}

METRO_API metro_result metro_scene_load_obj(metro_scene *scene, const char *path, char *message, size_t message_size)
{
    const char *why = "no scene, no path, or a scene that is built already; see the contract of metro_scene_load_obj";
    metro_result result = METRO_ERROR_ARGUMENT;
    unsigned char *bytes = NULL;
    size_t size = 0;
    if (scene != NULL && path != NULL && scene->bvh == NULL) {
        FILE *file = fopen(path, "rb");
        why = "the file cannot be opened; check that it exists and that you may read it";
        result = file == NULL ? METRO_ERROR_FILE : metroi_file_read(file, &bytes, &size, &why);
        if (file != NULL) fclose(file);
        if (result == METRO_ERROR_MEMORY) why = "there is not enough memory for the scene";
    }
    if (result == METRO_OK) {
        metroi_reader reader;
        metroi_reader_make(&reader, path, message, message_size);
        result = metroi_scene_read(scene, &reader, bytes, size, NULL, 0);
        metroi_reader_free(&reader);
    } else {
        metroi_tell(message, message_size, path, why);
    }
    METRO_FREE(bytes);
    return result;
}

/* The bytes are evened out in a copy; one block holds both files, so that an empty MTL has a place too. */

METRO_API metro_result metro_scene_parse_obj(metro_scene *scene, const unsigned char *obj, size_t obj_size,
                                             const unsigned char *mtl, size_t mtl_size, char *message,
                                             size_t message_size)
{
    metroi_reader reader;
    metro_result result = METRO_ERROR_MEMORY;
    unsigned char *bytes = NULL;
    if (scene == NULL || scene->bvh != NULL || (obj == NULL && obj_size > 0) || (mtl == NULL && mtl_size > 0)) {
        metroi_tell(message, message_size, NULL, "no scene, no bytes, or a scene that is built already");
        return METRO_ERROR_ARGUMENT;
    }
    metroi_reader_make(&reader, "obj", message, message_size);
    if (obj_size < SIZE_MAX && mtl_size < SIZE_MAX - obj_size)
        bytes = (unsigned char *)METRO_MALLOC(obj_size + mtl_size + 1);
    if (bytes != NULL) {
        if (obj_size > 0) memcpy(bytes, obj, obj_size);
        if (mtl_size > 0) memcpy(bytes + obj_size, mtl, mtl_size);
        result = metroi_scene_read(scene, &reader, bytes, obj_size, bytes + obj_size, mtl_size);
        metroi_reader_free(&reader);
    } else {
        metroi_notes_memory(&reader.notes, "obj");
    }
    METRO_FREE(bytes);
    return result;
}

#endif /* METRO_NO_TRACER */
METROI_WARM
#ifndef METRO_NO_TRACER

/* # 10 BVH

   Light travels along rays, and the one question a ray asks is which triangle it meets first. Asking every triangle
   answers it, at a cost that grows with their number. A bounding volume hierarchy is a tree of boxes: each box holds
   all the triangles below it, so a ray that misses the box need not look at any of them. In half a million
   triangles a ray then looks at some sixty boxes, eight at a time, and at a few triangles.

   The chapter has three parts. First the tree is built: where to cut a heap of triangles (10.2), how to make a wide
   tree of a narrow one (10.3), how it lies in memory (10.4). Then come the two tests that a ray makes, against boxes
   (10.6) and triangles (10.7), which must not let a ray slip through between two neighbours; the same tests for
   several boxes and triangles at once (10.8); and the walk (10.9). Last, how a ray leaves the surface that it was
   reflected by without meeting it again (10.10). */

#if defined(__GNUC__) || defined(__clang__)
#define METROI_ALIGNED __attribute__((aligned(32)))
#else
#define METROI_ALIGNED
#endif
#define METROI_MARGIN 1.9073486e-6f /* 2^-19 */
#define METROI_LEAF 0x80000000u /* the bit of a child that is a leaf */
#define METROI_NONE 0xFFFFFFFFu /* no child, no triangle */

/* # 10.1 Nodes and blocks

   A node holds the boxes of up to eight children, number by number: eight lower x, then eight lower y, and so on, the
   way that instructions for eight numbers at once read them. A child is the number of a node, or, with METROI_LEAF
   set, of a leaf. A leaf is one block or two, and a block four triangles, again number by number. Corners lie in the
   block itself: to follow an index to a vertex somewhere else would cost more than the test.

   Floats are half as large as doubles and twice as many fit an instruction. So that none of their products is too
   large for them, whatever unit the scene is in, coordinates are divided by a power of two that brings the largest
   into [1/2, 1); dividing by it rounds nothing. What is smaller than that by a factor of 1e22 is lost: the products
   of eq 10.7 are 0 there. */

typedef struct {
    float bound[48]; /* of the eight children in turn: lower x, lower y, lower z, then upper x, y, z */
    uint32_t child[8];
    uint32_t idle[8]; /* to 256 bytes: four lines of the cache, and a shift finds a node */
} metroi_node;

typedef struct {
    float corner[36]; /* of corner j, axis k and triangle i: [12 j + 4 k + i] */
    uint32_t triangle[4];  /* their numbers */
} metroi_block;

/* Which instructions the walk uses; the tests set it to compare them. */
typedef enum { METROI_PLAIN, METROI_FOUR, METROI_EIGHT } metroi_path;

typedef struct {
    metroi_path path;
    double size, scale; /* a power of two, and one over it */
    metroi_node *nodes; /* the first is the root */
    metroi_block *blocks;
    size_t node_count, block_count;
    void *node_memory, *block_memory; /* what nodes and blocks lie in */
} metroi_bvh;

METROI_INLINE float metroi_low(float a, float b)
{
    return a < b ? a : b;
}

METROI_INLINE float metroi_high(float a, float b)
{
    return a > b ? a : b;
}

METROI_INLINE double metroi_larger(double a, double b)
{
    return a > b ? a : b;
}

METROI_INLINE double metroi_smaller(double a, double b)
{
    return a < b ? a : b;
}

/* While the tree is being built a triangle is no more than its box. Boxes have a fourth, idle number in each half, so
   that compilers may use instructions for four; a triangle keeps its own number there. */

typedef struct {
    float lo[4], hi[4];
} metroi_box;

typedef struct {
    metroi_box box; /* lo[3] holds the bits of the triangle's number */
} metroi_item;

static uint32_t metroi_item_triangle(const metroi_item *item)
{
    uint32_t triangle;
    memcpy(&triangle, &item->box.lo[3], sizeof triangle);
    return triangle;
}

/* The box of a triangle has a margin, 2^-19 of its largest coordinate, for what rounding does in 10.7. */
METROI_INLINE void metroi_box_widen(float lo[3], float hi[3])
{
    float largest = 0;
    int k;
    for (k = 0; k < 3; k++) largest = metroi_high(largest, metroi_high(hi[k], -lo[k]));
    for (k = 0; k < 3; k++) lo[k] -= largest * METROI_MARGIN;
    for (k = 0; k < 3; k++) hi[k] += largest * METROI_MARGIN;
}

/* Makes the item of a triangle, and says whether the triangle is finite: the sum of nine scaled coordinates is finite
   unless one of them is not. */
static int metroi_item_make(const float *corner, double scale, uint32_t triangle, metroi_item *item)
{
    float p[9], sum = 0;
    int i, k;
    for (i = 0; i < 9; i++) {
        p[i] = (float)((double)corner[i] * scale);
        sum += p[i];
    }
    for (k = 0; k < 3; k++) {
        item->box.lo[k] = metroi_low(metroi_low(p[k], p[k + 3]), p[k + 6]);
        item->box.hi[k] = metroi_high(metroi_high(p[k], p[k + 3]), p[k + 6]);
    }
    metroi_box_widen(item->box.lo, item->box.hi);
    memcpy(&item->box.lo[3], &triangle, sizeof triangle);
    item->box.hi[3] = 0;
    return isfinite(sum);
}

static void metroi_box_clear(metroi_box *box)
{
    int k;
    for (k = 0; k < 4; k++) {
        box->lo[k] = 8;
        box->hi[k] = -8;
    }
}

METROI_INLINE void metroi_box_add(metroi_box *box, const metroi_box *more)
{
    int k;
    for (k = 0; k < 4; k++) box->lo[k] = metroi_low(more->lo[k], box->lo[k]);
    for (k = 0; k < 4; k++) box->hi[k] = metroi_high(more->hi[k], box->hi[k]);
}

/* Half the area of a box's surface. */
static float metroi_box_area(const metroi_box *box)
{
    float x = box->hi[0] - box->lo[0], y = box->hi[1] - box->lo[1], z = box->hi[2] - box->lo[2];
    return x * y + y * z + z * x;
}

/* # 10.2 Where to cut

   The tree is built from its root: cut the heap of triangles in two, then each half again. A good cut gives small
   boxes with few triangles. How small counts follows from geometry: of the random lines that meet a convex body,
   those that also meet a convex body inside it are a share that is the ratio of the two surface areas. So the
   expected cost of a ray that has come to node n is

       C(n) = c_n + frac{A_l}{A_n} C(l) + frac{A_r}{A_n} C(r)                       (10.1)

   with the cost $c_n$ of a look at the node's children l and r: the surface area heuristic (Goldsmith and Salmon
   1987; MacDonald and Booth 1990). We cannot know C(l) before l has been cut, so we take what it would cost uncut. A
   leaf is tested in blocks of four, and five triangles cost as much as eight; hence the cut minimises

       A_l q_l + A_r q_r,   q = N/4 "rounded up"                       (10.2)

   with $N_l$ and $N_r$ triangles on the two sides. */

METROI_INLINE float metroi_blocks_of(uint32_t count)
{
    return (float)((count + 3) / 4);
}

typedef struct {
    metroi_box box, centre; /* of the triangles, and of twice the centres of their boxes */
    uint32_t first, count;  /* a range of items */
} metroi_range;

static void metroi_range_clear(metroi_range *range, uint32_t first)
{
    metroi_box_clear(&range->box);
    metroi_box_clear(&range->centre);
    range->first = first;
    range->count = 0;
}

METROI_INLINE void metroi_range_add(metroi_range *range, const metroi_item *item)
{
    metroi_box centre;
    int k;
    for (k = 0; k < 4; k++) centre.lo[k] = centre.hi[k] = item->box.lo[k] + item->box.hi[k];
    metroi_box_add(&range->box, &item->box);
    metroi_box_add(&range->centre, &centre);
    range->count++;
}

/* Not every cut is tried. The span of the centres is divided into at most 16 bins along each axis, each triangle goes
   into one bin an axis, and the cuts are those between bins (Wald 2007); 32 bins make no better trees. Small heaps
   get fewer, since bins cost time even when they are empty. */

enum { METROI_BINS = 16 };

typedef struct {
    metroi_box box[METROI_BINS];
    uint32_t count[METROI_BINS];
} metroi_bins;

typedef struct {
    float cost, origin, scale;
    int axis, bin, bins; /* bins below `bin` go to the left; axis -1: no cut was found */
} metroi_split;

METROI_INLINE int metroi_bin_of(const metroi_item *item, int axis, float origin, float scale, int bins)
{
    int bin = (int)((item->box.lo[axis] + item->box.hi[axis] - origin) * scale);
    return bin < bins ? bin : bins - 1;
}

/* Tries the cuts along one axis: from the right, what each cut leaves on its right; then from the left, the rest. */
static void metroi_split_sweep(const metroi_bins *bins, int count, int axis, metroi_split *best)
{
    float right[METROI_BINS];
    metroi_box box;
    uint32_t n = 0;
    int i;
    metroi_box_clear(&box);
    for (i = count - 1; i > 0; i--) {
        n += bins->count[i];
        metroi_box_add(&box, &bins->box[i]);
        right[i] = n > 0 ? metroi_box_area(&box) * metroi_blocks_of(n) : -1;
    }
    metroi_box_clear(&box);
    for (i = 1, n = 0; i < count; i++) {
        float cost;
        n += bins->count[i - 1];
        metroi_box_add(&box, &bins->box[i - 1]);
        if (n == 0 || right[i] < 0) continue; /* all on one side is no cut */
        cost = metroi_box_area(&box) * metroi_blocks_of(n) + right[i]; /* eq 10.2, the part of eq 10.1 that varies */
        if (cost < best->cost) {
            best->cost = cost;
            best->axis = axis;
            best->bin = i;
        }
    }
}

static void metroi_bins_fill(metroi_bins bins[3], const metroi_item *item, const metroi_range *range,
                             const float scale[3], int count)
{
    uint32_t j;
    int i, k;
    for (k = 0; k < 3; k++)
        for (i = 0; i < count; i++) {
            metroi_box_clear(&bins[k].box[i]);
            bins[k].count[i] = 0;
        }
    for (j = range->first; j < range->first + range->count; j++)
        for (k = 0; k < 3; k++) {
            i = metroi_bin_of(&item[j], k, range->centre.lo[k], scale[k], count);
            bins[k].count[i]++;
            metroi_box_add(&bins[k].box[i], &item[j].box);
        }
}

static metroi_split metroi_split_find(const metroi_item *item, const metroi_range *range)
{
    metroi_split best = { 1e30f, 0, 0, -1, 0, 0 };
    metroi_bins bins[3];
    float scale[3];
    int k;
    best.bins = range->count < 240 ? 4 + (int)range->count / 20 : METROI_BINS;
    for (k = 0; k < 3; k++) {
        float extent = range->centre.hi[k] - range->centre.lo[k];
        scale[k] = extent > 1e-30f ? (float)best.bins * 0.99999f / extent : 0; /* centres on one spot stay together */
    }
    metroi_bins_fill(bins, item, range, scale, best.bins);
    for (k = 0; k < 3; k++)
        if (scale[k] > 0) metroi_split_sweep(&bins[k], best.bins, k, &best);
    if (best.axis >= 0) {
        best.origin = range->centre.lo[best.axis];
        best.scale = scale[best.axis];
    }
    return best;
}

static int metroi_split_bin(const metroi_split *split, const metroi_item *item)
{
    return metroi_bin_of(item, split->axis, split->origin, split->scale, split->bins);
}

/* Sorts the items of a range to both sides of a cut, from both ends inwards. Where no cut was found, because all
   centres coincide or for the reason below, the first half of the items goes to the left. */
static void metroi_range_split(metroi_item *item, const metroi_range *range, const metroi_split *split,
                               metroi_range *left, metroi_range *right)
{
    uint32_t i = range->first, end = i + range->count, middle = i + range->count / 2;
    metroi_range_clear(left, i);
    metroi_range_clear(right, end);
    while (i < end) {
        int is_left = i < middle;
        if (split->axis >= 0) is_left = metroi_split_bin(split, &item[i]) < split->bin;
        if (is_left) metroi_range_add(left, &item[i++]);
        else {
            metroi_item other = item[--end];
            item[end] = item[i];
            item[i] = other;
            metroi_range_add(right, &item[end]);
        }
    }
    right->first = end;
}

METROI_COLD

/* # 10.3 From two children to eight

   The cuts make a binary tree, and its inner nodes are forks. A ray is better served by nodes with eight children,
   whose boxes are tested at once. So a node of the final tree stands for a fork and some of the forks below it, and
   the question is which. Let C(n, i) be its area $A_n$ times the least cost to be expected below fork n when it
   appears as at most i children of some node. As one child it is a leaf of at most two blocks, or a node with
   children of its own; as more it shares them out between its two halves:

       C(n, 1) = min(A_n q_n, A_n + C(n, 8))                                             (10.3)
       C(n, i) = min(C(n, i - 1), min_{0 < k < i} (C(l, k) + C(r, i - k)))               (10.4)

   with the blocks $q_n$ of fork n as a leaf, its halves l and r, and for i = 8 the inner minimum alone.

   Looking at a node and testing a block cost the same here, which is about true. Since a fork comes after its parent
   in the list, one pass from the end to the front computes all costs; `part` remembers the choices (Wald, Benthin and
   Boulos 2008; Ylitie, Karras and Laine 2017). */

enum { METROI_WIDTH = 8, METROI_LEAF_MOST = 8, METROI_CUT_DEPTH = 40, METROI_DEPTH = 72 };

typedef struct {
    metroi_box box;
    uint32_t first, count;               /* its items */
    uint32_t left, right;                /* forks; 0 where it was not cut */
    float cost[METROI_WIDTH + 1];        /* [i]: C(n, i) */
    unsigned char part[METROI_WIDTH + 1]; /* [i]: so many children for the left half, or 0: make do with i - 1; */
                                         /* [1]: 0 for a leaf */
    uint32_t node, waiting;              /* its node, and an entry of the stack of metroi_build_wide */
} metroi_fork;

typedef struct {
    const metro_scene *scene;
    metroi_bvh *bvh;
    metroi_item *item;
    metroi_fork *fork;
    size_t fork_count, fork_room;
} metroi_builder;

static int metroi_fork_add(metroi_builder *b, const metroi_range *range, uint32_t *index)
{
    metroi_fork *fork = b->fork;
    if (b->fork_count == b->fork_room) {
        size_t size, room = b->fork_room + b->fork_room / 2;
        if (!metroi_size_multiply(room, sizeof *fork, &size)) return 0;
        fork = (metroi_fork *)METRO_REALLOC(b->fork, size);
        if (fork == NULL) return 0;
        b->fork = fork;
        b->fork_room = room;
    }
    *index = (uint32_t)b->fork_count++;
    fork += *index;
    memset(fork, 0, sizeof *fork);
    fork->box = range->box;
    fork->first = range->first;
    fork->count = range->count;
    return 1;
}

/* Four triangles fill a block and are not cut, unless their box is so large, a 256th of the whole surface, that it
   would often be entered for nothing: the walls of an empty room share no block. Whether the cut is used is for eq
   10.3 to say.

   Cuts by area may peel off one triangle at a time and make a tree as deep as a list. From depth 40 on we halve,
   which ends within 30 more levels, and so the depth of all trees is bounded, and with it every stack below. */

static int metroi_range_is_cut(const metroi_range *range, const metroi_range *all)
{
    if (range->count > 4) return 1;
    return range->count > 1 && metroi_box_area(&range->box) > metroi_box_area(&all->box) / 256;
}

typedef struct {
    metroi_range range;
    uint32_t fork;
    int depth;
} metroi_task;

static int metroi_build_binary(metroi_builder *b, const metroi_range *all)
{
    metroi_task task[METROI_DEPTH + 2]; /* what waits: the right halves along one way down */
    int tasks = 1;
    if (!metroi_fork_add(b, all, &task[0].fork)) return 0;
    task[0].range = *all;
    task[0].depth = 0;
    while (tasks > 0) {
        metroi_task at = task[--tasks], *right = &task[tasks], *left = &task[tasks + 1];
        metroi_split split = { 0, 0, 0, -1, 0, 0 };
        if (!metroi_range_is_cut(&at.range, all)) continue;
        if (at.depth < METROI_CUT_DEPTH) split = metroi_split_find(b->item, &at.range);
        metroi_range_split(b->item, &at.range, &split, &left->range, &right->range);
        left->depth = right->depth = at.depth + 1;
        if (!metroi_fork_add(b, &left->range, &left->fork) || !metroi_fork_add(b, &right->range, &right->fork))
            return 0;
        b->fork[at.fork].left = left->fork;
        b->fork[at.fork].right = right->fork;
        tasks += 2;
    }
    return 1;
}

static void metroi_fork_share(const metroi_builder *b, metroi_fork *n, int i)
{
    const metroi_fork *left = &b->fork[n->left], *right = &b->fork[n->right];
    int k;
    n->cost[i] = 1e30f;
    for (k = 1; k < i; k++) {
        float cost = left->cost[k] + right->cost[i - k]; /* eq 10.4 */
        if (cost < n->cost[i]) {
            n->cost[i] = cost;
            n->part[i] = (unsigned char)k;
        }
    }
}

static void metroi_fork_cost(const metroi_builder *b, metroi_fork *n)
{
    float area = metroi_box_area(&n->box);
    int i;
    for (i = 2; i <= METROI_WIDTH && n->left != 0; i++) metroi_fork_share(b, n, i);
    n->cost[1] = n->count <= METROI_LEAF_MOST ? area * metroi_blocks_of(n->count) : 1e30f;
    if (n->left != 0 && area + n->cost[METROI_WIDTH] < n->cost[1]) { /* eq 10.3 */
        n->cost[1] = area + n->cost[METROI_WIDTH];
        n->part[1] = 1;
    }
    for (i = 2; i < METROI_WIDTH; i++)
        if (n->left == 0 || n->cost[i - 1] <= n->cost[i]) { /* eq 10.4 */
            n->cost[i] = n->cost[i - 1];
            n->part[i] = 0;
        }
}

static int metroi_fork_is_leaf(const metroi_fork *fork)
{
    return fork->part[1] == 0;
}

/* Follows the choices down from fork n to the children of its node, in order; returns how many there are. */
static int metroi_fork_children(const metroi_builder *b, uint32_t n, uint32_t child[METROI_WIDTH])
{
    uint32_t fork[METROI_WIDTH];
    int room[METROI_WIDTH], top = 1, count = 0;
    fork[0] = n;
    room[0] = METROI_WIDTH;
    while (top > 0) {
        const metroi_fork *at = &b->fork[fork[--top]];
        int i = room[top];
        while (i > 1 && at->part[i] == 0) i--;
        if (i == 1) child[count++] = fork[top];
        else {
            room[top] = i - at->part[i];
            fork[top++] = at->right;
            room[top] = at->part[i];
            fork[top++] = at->left;
        }
    }
    return count;
}

/* # 10.4 Into memory

   A ray goes from a node to its children, so children of one node lie side by side, and what is below the first child
   comes before what is below the second. Empty places in a node have a box that no ray meets, from +infinity to
   -infinity, and empty places in a block have corners that are NaN, which fail every comparison. */

static void metroi_node_set(metroi_node *node, int slot, const metroi_fork *fork, uint32_t child)
{
    int k;
    for (k = 0; k < 3; k++) {
        node->bound[8 * k + slot] = fork != NULL ? fork->box.lo[k] : (float)METROI_INFINITY;
        node->bound[8 * k + 24 + slot] = fork != NULL ? fork->box.hi[k] : -(float)METROI_INFINITY;
    }
    node->child[slot] = child;
}

static void metroi_block_set(const metroi_builder *b, metroi_block *block, int lane, uint32_t triangle)
{
    const float *corner = b->scene->corner;
    int i;
    for (i = 0; i < 9; i++) {
        double x = triangle != METROI_NONE ? (double)corner[9 * (size_t)triangle + (size_t)i] : METROI_NAN;
        block->corner[4 * i + lane] = (float)(x * b->bvh->scale);
    }
    block->triangle[lane] = triangle;
}

/* A leaf as a child: its first block, shifted to make room for a bit that says whether there is a second. */
static uint32_t metroi_leaf_place(const metroi_builder *b, const metroi_fork *leaf)
{
    metroi_bvh *bvh = b->bvh;
    uint32_t first = (uint32_t)bvh->block_count, blocks = (leaf->count + 3) / 4, j;
    bvh->block_count += blocks;
    for (j = 0; j < 4 * blocks && bvh->blocks != NULL; j++) {
        uint32_t triangle = j < leaf->count ? metroi_item_triangle(&b->item[leaf->first + j]) : METROI_NONE;
        metroi_block_set(b, &bvh->blocks[first + j / 4], (int)(j % 4), triangle);
    }
    return METROI_LEAF | first << 1 | (blocks - 1);
}

/* Goes over the nodes, parents first, and places them and their leaves. It is run twice: without memory, to count
   what is needed, and then with it. */
static void metroi_build_wide(const metroi_builder *b)
{
    metroi_bvh *bvh = b->bvh;
    metroi_fork *fork = b->fork;
    uint32_t child[METROI_WIDTH];
    size_t top = 1;
    int i, count;
    bvh->node_count = 1;
    bvh->block_count = 0;
    fork[0].waiting = fork[0].node = 0;
    while (top > 0) {
        metroi_fork *at = &fork[fork[--top].waiting];
        count = metroi_fork_children(b, (uint32_t)(at - fork), child);
        for (i = 0; i < METROI_WIDTH; i++) {
            metroi_fork *c = i < count ? &fork[child[i]] : NULL;
            uint32_t code = METROI_NONE;
            if (c != NULL && metroi_fork_is_leaf(c)) code = metroi_leaf_place(b, c);
            else if (c != NULL) code = c->node = (uint32_t)bvh->node_count++;
            if (bvh->nodes != NULL) metroi_node_set(&bvh->nodes[at->node], i, c, code);
        }
        for (i = count - 1; i >= 0; i--)
            if (!metroi_fork_is_leaf(&fork[child[i]])) fork[top++].waiting = child[i];
    }
}

/* # 10.5 Building

   Nodes and blocks begin on multiples of 64 bytes, the size of a line of the cache, so that a row of eight floats
   never straddles two lines. `malloc` promises less, so we ask for a little more and begin inside. */

static void *metroi_aligned(void *memory)
{
    unsigned char *bytes = (unsigned char *)memory;
    return bytes + ((64 - ((uintptr_t)bytes & 63)) & 63);
}

static int metroi_bvh_allocate(metroi_bvh *bvh)
{
    size_t nodes, blocks;
    if (!metroi_size_multiply(bvh->node_count, sizeof *bvh->nodes, &nodes) || nodes > SIZE_MAX - 64) return 0;
    if (!metroi_size_multiply(bvh->block_count, sizeof *bvh->blocks, &blocks) || blocks > SIZE_MAX - 64) return 0;
    bvh->node_memory = METRO_MALLOC(nodes + 64);
    bvh->block_memory = METRO_MALLOC(blocks + 64);
    if (bvh->node_memory == NULL || bvh->block_memory == NULL) return 0;
    bvh->nodes = (metroi_node *)metroi_aligned(bvh->node_memory);
    bvh->blocks = (metroi_block *)metroi_aligned(bvh->block_memory);
    return 1;
}

static void metroi_bvh_free(metroi_bvh *bvh)
{
    if (bvh == NULL) return;
    METRO_FREE(bvh->node_memory);
    METRO_FREE(bvh->block_memory);
    METRO_FREE(bvh);
}

/* The power of two above the largest coordinate of the finite triangles. */
static double metroi_scene_size(const metro_scene *scene)
{
    double largest = 0;
    size_t i, k;
    int exponent = 0;
    for (i = 0; i < scene->triangle_count; i++) {
        if (!metroi_triangle_is_finite(scene, (uint32_t)i)) continue;
        for (k = 0; k < 9; k++) largest = metroi_larger(largest, fabs((double)scene->corner[9 * i + k]));
    }
    frexp(largest, &exponent);
    return ldexp(1.0, exponent);
}

static void metroi_items_make(metroi_builder *b, metroi_range *all)
{
    const metro_scene *scene = b->scene;
    size_t i;
    metroi_range_clear(all, 0);
    for (i = 0; i < scene->triangle_count; i++) {
        metroi_item *item = &b->item[all->count];
        if (metroi_item_make(scene->corner + 9 * i, b->bvh->scale, (uint32_t)i, item)) metroi_range_add(all, item);
    }
}

/* All of it, with the memory for the forks that `b` then holds. */
static int metroi_bvh_build(metroi_builder *b)
{
    metroi_range all;
    size_t i;
    metroi_items_make(b, &all);
    if (all.count == 0) return 1;
    b->fork_room = (size_t)all.count / 5 * 3 + 16;
    if (!metroi_size_multiply(b->fork_room, sizeof *b->fork, &i)) return 0;
    b->fork = (metroi_fork *)METRO_MALLOC(i);
    if (b->fork == NULL || !metroi_build_binary(b, &all)) return 0;
    for (i = b->fork_count; i > 0; i--) metroi_fork_cost(b, &b->fork[i - 1]);
    metroi_build_wide(b);
    if (!metroi_bvh_allocate(b->bvh)) return 0;
    metroi_build_wide(b);
    return 1;
}

static metroi_path metroi_path_best(void);

METRO_API metro_result metro_scene_build(metro_scene *scene)
{
    metroi_builder b;
    metro_result result = METRO_ERROR_MEMORY;
    size_t size;
    if (scene == NULL || scene->triangle_count >= (size_t)1 << 30) return METRO_ERROR_ARGUMENT;
    if (scene->bvh != NULL) return METRO_OK;
    if (!metroi_size_multiply(scene->triangle_count + 1, sizeof *b.item, &size)) return METRO_ERROR_MEMORY;
    memset(&b, 0, sizeof b);
    b.scene = scene;
    b.item = (metroi_item *)METRO_MALLOC(size);
    b.bvh = (metroi_bvh *)METRO_MALLOC(sizeof *b.bvh);
    if (b.bvh != NULL) memset(b.bvh, 0, sizeof *b.bvh);
    if (b.item != NULL && b.bvh != NULL) {
        b.bvh->path = metroi_path_best();
        b.bvh->size = metroi_scene_size(scene);
        b.bvh->scale = 1 / b.bvh->size;
        if (metroi_bvh_build(&b)) result = metroi_scene_lights(scene);
    }
    METRO_FREE(b.fork);
    METRO_FREE(b.item);
    if (result == METRO_OK) scene->bvh = b.bvh;
    else metroi_bvh_free(b.bvh);
    return result;
}

METRO_API void metro_scene_free(metro_scene *scene)
{
    if (scene == NULL) return;
    METRO_FREE(scene->corner);
    METRO_FREE(scene->material_of);
    METRO_FREE(scene->material);
    METRO_FREE(scene->light);
    METRO_FREE(scene->light_sum);
    metroi_bvh_free((metroi_bvh *)scene->bvh);
    memset(scene, 0, sizeof *scene);
}

METROI_WARM

/* # 10.6 Rays and boxes

   The tests below must give the same bits wherever they are compiled, or a ray slips through where one triangle
   rounds this way and its neighbour that way: every product is rounded, and so is every sum.

   Processors have instructions that do the same to four floats. A wrapper gives one name to those of SSE2, which
   every 64-bit PC has, and of NEON, which every 64-bit ARM has; elsewhere, or with METRO_NO_SIMD defined, plain C
   does the work. Minimum and maximum keep the second number when one is NaN, and a mask has a bit for each sign. */

#if !defined(METRO_NO_SIMD) && defined(__GNUC__) && !defined(__TINYC__) && defined(__SSE2__)
#define METROI_SIMD
#define METROI_AVX2 __attribute__((target("avx2,bmi,fma")))
#include <emmintrin.h>

typedef __m128 metroi_v4;
METROI_INLINE metroi_v4 metroi_v4_load(const float *p) { return _mm_loadu_ps(p); }
METROI_INLINE void metroi_v4_store(float *p, metroi_v4 a) { _mm_storeu_ps(p, a); }
METROI_INLINE metroi_v4 metroi_v4_all(float x) { return _mm_set1_ps(x); }
METROI_INLINE metroi_v4 metroi_v4_add(metroi_v4 a, metroi_v4 b) { return _mm_add_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_sub(metroi_v4 a, metroi_v4 b) { return _mm_sub_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_mul(metroi_v4 a, metroi_v4 b) { return _mm_mul_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_div(metroi_v4 a, metroi_v4 b) { return _mm_div_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_low(metroi_v4 a, metroi_v4 b) { return _mm_min_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_high(metroi_v4 a, metroi_v4 b) { return _mm_max_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_le(metroi_v4 a, metroi_v4 b) { return _mm_cmple_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_and(metroi_v4 a, metroi_v4 b) { return _mm_and_ps(a, b); }
METROI_INLINE metroi_v4 metroi_v4_or(metroi_v4 a, metroi_v4 b) { return _mm_or_ps(a, b); }
METROI_INLINE unsigned metroi_v4_mask(metroi_v4 a) { return (unsigned)_mm_movemask_ps(a); }
METROI_INLINE metroi_v4 metroi_v4_from(metro_vec3 a)
{
    return _mm_movelh_ps(_mm_cvtpd_ps(_mm_set_pd(a.y, a.x)), _mm_cvtpd_ps(_mm_set_sd(a.z)));
}

#elif !defined(METRO_NO_SIMD) && defined(__GNUC__) && defined(__aarch64__) && defined(__ARM_NEON)
#define METROI_SIMD
#include <arm_neon.h>

typedef float32x4_t metroi_v4;
METROI_INLINE metroi_v4 metroi_v4_load(const float *p) { return vld1q_f32(p); }
METROI_INLINE void metroi_v4_store(float *p, metroi_v4 a) { vst1q_f32(p, a); }
METROI_INLINE metroi_v4 metroi_v4_all(float x) { return vdupq_n_f32(x); }
METROI_INLINE metroi_v4 metroi_v4_add(metroi_v4 a, metroi_v4 b) { return vaddq_f32(a, b); }
METROI_INLINE metroi_v4 metroi_v4_sub(metroi_v4 a, metroi_v4 b) { return vsubq_f32(a, b); }
METROI_INLINE metroi_v4 metroi_v4_mul(metroi_v4 a, metroi_v4 b) { return vmulq_f32(a, b); }
METROI_INLINE metroi_v4 metroi_v4_div(metroi_v4 a, metroi_v4 b) { return vdivq_f32(a, b); }
METROI_INLINE metroi_v4 metroi_v4_low(metroi_v4 a, metroi_v4 b) { return vbslq_f32(vcltq_f32(a, b), a, b); }
METROI_INLINE metroi_v4 metroi_v4_high(metroi_v4 a, metroi_v4 b) { return vbslq_f32(vcgtq_f32(a, b), a, b); }
METROI_INLINE metroi_v4 metroi_v4_le(metroi_v4 a, metroi_v4 b) { return vreinterpretq_f32_u32(vcleq_f32(a, b)); }
METROI_INLINE metroi_v4 metroi_v4_and(metroi_v4 a, metroi_v4 b)
{
    return vreinterpretq_f32_u32(vandq_u32(vreinterpretq_u32_f32(a), vreinterpretq_u32_f32(b)));
}
METROI_INLINE metroi_v4 metroi_v4_or(metroi_v4 a, metroi_v4 b)
{
    return vreinterpretq_f32_u32(vorrq_u32(vreinterpretq_u32_f32(a), vreinterpretq_u32_f32(b)));
}
METROI_INLINE unsigned metroi_v4_mask(metroi_v4 a)
{
    static const uint32_t bit[4] = { 1, 2, 4, 8 };
    return vaddvq_u32(vandq_u32(vcltzq_s32(vreinterpretq_s32_f32(a)), vld1q_u32(bit)));
}
METROI_INLINE metroi_v4 metroi_v4_from(metro_vec3 a)
{
    float64x2_t xy = { a.x, a.y }, z = { a.z, 0 };
    return vcombine_f32(vcvt_f32_f64(xy), vcvt_f32_f64(z));
}
#endif

/* A ray comes with an origin and a direction in any units. We divide the origin by the scene's size and the direction
   by its own largest component, which makes that component 1 or -1 and t the way along its axis in units of the
   scene. Multiplied by `unit` it is the caller's t again. The bounds that the caller gave are compared as doubles,
   with the caller's t; inside, bounds that are a little too wide save time and decide nothing. */

typedef struct {
    METROI_ALIGNED float origin[4]; /* here and below the fourth number is idle */
    float direction[4];
    float inverse[4];             /* 1 / direction, perhaps infinite */
    float reach[4], spare[4];     /* the same but finite; what 10.7 adds where it was infinite, else 0 */
    const unsigned char *row;     /* three rows of metroi_node.bound where the ray enters, three where it leaves */
    size_t axis[3];               /* the last is the axis of the component 1 or -1, `side` */
    float side, shear[2];
    float t_min, t;               /* hits are looked for from t_min to t, which shrinks as they are found */
    uint32_t triangle;            /* the nearest so far */
    float det, v, w;              /* of it, as in 10.7 */
    double start, unit;           /* the caller's t is (start + t) unit */
    double least, most;           /* and lies between these */
} metroi_ray;

METROI_INLINE uint32_t metroi_float_bits(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

/* A box is the common part of three slabs, each between two planes. The ray is inside the slab of axis k between the
   times at which it crosses the two planes, and inside the box when it is inside all three:

       t_near = max_k frac{n_k - o_k}{d_k},    t_far = min_k frac{f_k - o_k}{d_k},    t_near <= t_far          (10.5)

   with the plane $n_k$ that it meets first, the lower one where $d_k > 0$ (Kay and Kajiya 1986). The sign of 1/d
   decides which, and knows it even for a component of -0.

   A component that is 0 makes 1/d infinite. Beside the slab both quotients are the same infinity, inside they are
   -infinity and infinity, both as they should be; and with the origin on a plane 0 times infinity is NaN, which says
   that this plane has no opinion. So every minimum and maximum is written so that a NaN in the new number leaves the
   old one.

   Rounding may make the time of entrance too late and that of exit too early. A difference and a product round once
   each, by at most 6e-8, and the inverse three times, with the two floats that it is the quotient of. So if the later
   of the two is made longer by ten times that, no box is missed that the exact ray would hit (Ize 2013). For the box
   of a single triangle 10.7 asks for twice as much, and boxes of nodes get a little more again, for the reason that
   is given there. */

#define METROI_PAD 1.0000012f /* in floats 1 + 20 e, e = 2^-24 */
#define METROI_PAD_NODE 1.0000015f /* 1 + 26 e */
#define METROI_REACH 3e38f /* stands for infinity where that would become NaN */

/* Makes floats of the ray, and returns a bit for each negative component. The first box needs the inverse at
   once, so that is a quotient of floats and does not wait for `along`, the direction divided by its largest
   component. */
METROI_INLINE unsigned metroi_ray_floats(metroi_ray *ray, metro_vec3 o, metro_vec3 d, double largest,
                                         metro_vec3 along)
{
#ifdef METROI_SIMD
    metroi_v4 way = metroi_v4_from(d), inverse = metroi_v4_div(metroi_v4_all((float)largest), way);
    metroi_v4 most = metroi_v4_all(METROI_REACH), least = metroi_v4_all(-METROI_REACH);
    metroi_v4 reach = metroi_v4_low(metroi_v4_high(inverse, least), most);
    metroi_v4 endless = metroi_v4_or(metroi_v4_le(reach, least), metroi_v4_le(most, reach));
    metroi_v4_store(ray->origin, metroi_v4_from(o));
    metroi_v4_store(ray->direction, metroi_v4_from(along));
    metroi_v4_store(ray->inverse, inverse);
    metroi_v4_store(ray->reach, reach);
    metroi_v4_store(ray->spare, metroi_v4_and(endless, most));
    return metroi_v4_mask(way) & 7;
#else
    const double from[3] = { o.x, o.y, o.z }, way[3] = { d.x, d.y, d.z }, to[3] = { along.x, along.y, along.z };
    unsigned signs = 0, k;
    for (k = 0; k < 3; k++) {
        float inverse = (float)largest / (float)way[k];
        ray->origin[k] = (float)from[k];
        ray->direction[k] = (float)to[k];
        ray->inverse[k] = inverse;
        ray->reach[k] = metroi_low(metroi_high(inverse, -METROI_REACH), METROI_REACH);
        ray->spare[k] = ray->reach[k] <= -METROI_REACH || METROI_REACH <= ray->reach[k] ? METROI_REACH : 0;
        signs |= (unsigned)(inverse < 0) << k; /* knows -0, too */
    }
    return signs;
#endif
}

/* Which axis comes last, and where a ray enters a box, is computed without a branch: directions are random. */
METROI_INLINE void metroi_ray_axes(metroi_ray *ray, metro_vec3 d, unsigned signs)
{
    static const unsigned char next[4] = { 1, 2, 0, 1 };
    static const unsigned char row[8][6] = {
        { 0, 8, 16, 24, 32, 40 }, { 24, 8, 16, 0, 32, 40 }, { 0, 32, 16, 24, 8, 40 }, { 24, 32, 16, 0, 8, 40 },
        { 0, 8, 40, 24, 32, 16 }, { 24, 8, 40, 0, 32, 16 }, { 0, 32, 40, 24, 8, 16 }, { 24, 32, 40, 0, 8, 16 }
    };
    int y = fabs(d.y) > fabs(d.x), z = fabs(d.z) > metroi_larger(fabs(d.x), fabs(d.y));
    size_t last = (size_t)(2 * z + (y & (1 - z)));
    ray->row = row[signs];
    ray->axis[0] = next[last];
    ray->axis[1] = next[last + 1];
    ray->axis[2] = last;
    ray->side = ray->direction[last];
    ray->shear[0] = ray->direction[ray->axis[0]] * ray->side;
    ray->shear[1] = ray->direction[ray->axis[1]] * ray->side;
}

/* A ray that begins far away, or before t = 0, is moved along itself to a distance of 2 to 4 from the middle of the
   scene, which lies within sqrt(3) of it, or to t_min if that is later: floats would not tell far points apart.
   Returns 0 for one that passes by. */
static int metroi_ray_enter(metro_vec3 *o, metro_vec3 d, double t_min, double *start)
{
    double entrance = -metro_dot(*o, d) / metro_dot(d, d) - 2;
    *start = metroi_larger(t_min, entrance);
    *o = metro_add(*o, metro_scale(d, *start));
    return metro_dot(*o, *o) < 64;
}

/* Returns 0 for a ray that hits nothing. A NaN in the origin or in z of the direction is in no range; one in x or y
   gets by, and fails every comparison of 10.7. */
METROI_INLINE int metroi_ray_make(const metroi_bvh *bvh, metro_vec3 o, metro_vec3 d, double t_min, double t_max,
                                  metroi_ray *ray)
{
    double largest = metroi_largest_component(d), inverse, unit, per_unit, low, high;
    if (bvh == NULL || bvh->block_count == 0 || !(t_min < t_max)) return 0;
    unit = bvh->size;
    per_unit = bvh->scale;
    while (!(largest > 1e-15 && largest < 1e15)) { /* brings directions into the range of floats */
        double boost = largest < 1 ? 1099511627776.0 : 1 / 1099511627776.0; /* 2^40: nothing is rounded */
        if (!(largest > 0 && largest < METROI_INFINITY)) return 0;
        d = metro_scale(d, boost);
        largest *= boost;
        unit *= boost;
        per_unit /= boost;
    }
    inverse = 1 / largest;
    o = metro_scale(o, bvh->scale);
    ray->unit = unit * inverse;
    ray->least = t_min;
    ray->most = t_max;
    ray->start = 0;
    low = t_min == 0 ? 0 : t_min * (largest * per_unit);
    high = t_max < METROI_INFINITY ? t_max * (largest * per_unit) : t_max;
    if (t_min < 0 || !(metro_dot(o, o) < 16)) {
        if (!metroi_ray_enter(&o, metro_scale(d, inverse), low, &ray->start)) return 0;
        low -= ray->start + 1e-15 * fabs(ray->start);
        high -= ray->start - 1e-15 * fabs(ray->start);
    }
    if (!(low < 16 && high >= 0)) return 0; /* the scene ends before 16 */
    ray->t_min = (float)(metroi_larger(low, 0) * (1 - 1e-6));
    ray->t = high < 15 ? (float)(high * (1 + 1e-6)) : 16;
    ray->triangle = METROI_NONE;
    metroi_ray_axes(ray, d, metroi_ray_floats(ray, o, d, largest, metro_scale(d, inverse)));
    return 1;
}

/* Tests the eight boxes of a node, writes when the ray enters each, and returns a bit for each that it meets. The
   loops over eight are for compilers that make vector instructions of them. */
METROI_INLINE unsigned metroi_boxes_plain(const metroi_node *node, const metroi_ray *ray, const void *spread,
                                          float near_t[8])
{
    float far_t[8];
    unsigned mask = 0;
    int i, k;
    (void)spread;
    for (i = 0; i < 8; i++) near_t[i] = ray->t_min;
    for (i = 0; i < 8; i++) far_t[i] = ray->t;
    for (k = 0; k < 3; k++) { /* eq 10.5 */
        const float *near_row = node->bound + ray->row[k], *far_row = node->bound + ray->row[k + 3];
        float o = ray->origin[k], r = ray->inverse[k], padded = ray->inverse[k] * METROI_PAD_NODE;
        for (i = 0; i < 8; i++) near_t[i] = metroi_high((near_row[i] - o) * r, near_t[i]);
        for (i = 0; i < 8; i++) far_t[i] = metroi_low((far_row[i] - o) * padded, far_t[i]);
    }
    for (i = 0; i < 8; i++) mask |= (unsigned)(near_t[i] <= far_t[i]) << i;
    return mask;
}

/* # 10.7 Watertight triangles

   Take the ray's origin as the origin of space, and shear space so that the ray runs along its main axis, the one of
   the largest component of d, here called z. A corner p becomes

       z_p = p_z - o_z,    x_p = p_x - o_x - s_x z_p,    y_p = p_y - o_y - s_y z_p,    s_x = d_x/d_z, s_y = d_y/d_z
                                                                                              (10.6)

   and the ray hits the triangle when the point (0, 0) lies in the flat triangle of the three (x, y). That is so when
   it is on the same side of all three edges, which is told by the signs of

       U = x_c y_b - y_c x_b,    V = x_a y_c - y_a x_c,    W = x_b y_a - y_b x_a                    (10.7)

   These are twice the areas of the three triangles that (0, 0) makes with the edges, and so they also weigh the
   corners:

       t = frac{U z_a + V z_b + W z_c}{D d_z},    u = frac{V}{D},    v = frac{W}{D},    D = U + V + W       (10.8)

   (Woop, Benthin and Wald 2013). Why does no ray get through between two triangles with a common edge? Both compute
   the same x and y for the corners they share, from the same numbers by the same steps, so rounding moves the corners
   but tears nothing apart. For the common edge both compute the same two products, and subtract them in opposite
   order. Rounding is monotonic: the difference of two rounded products has the sign of the exact one or is 0. So the
   two never both say "outside", and a 0, which counts as inside, is said by both. Here the products must be rounded
   before they are subtracted; a fused instruction rounds one of them and not the other.

   Three zeros at once come from a triangle seen edge-on, or from no area at all; then t is 0/0, a NaN, and fails
   the comparisons.

   The order in which triangles are tested must not matter, or four boxes at once would give other pictures than
   eight. It does matter if rounding puts the hit of a triangle before the box that holds the triangle: another hit in
   between would end the search before that box is opened. So we hold every triangle to its own box: it is hit only if
   the ray meets that box by eq 10.5, and not before t_near,

       t <- max(t, t_near)                                                              (10.9)

   which also helps large flat triangles: the box of a floor is as thin as the floor. But the box must not refuse what
   eq 10.7 accepts, or the ray is lost to both neighbours. With e = 2^-24, rounding displaces a corner of eq 10.6
   along x by e of p_x - o_x, three times that of s_x z_p (s_x, z_p and the product are rounded), and e of the
   difference x_p. With the point h where the ray hits, and L the extent of the triangle, the first two lengths are
   below h_x - o_x plus L, since s_x z_h is h_x - o_x, and the third is below 2 L: so the corner is off by 4 e of t,
   in time, and by 6 e of L, in length. Rounding the products of eq 10.7 moves an edge by a few e of L. The part in t,
   once where the ray enters and once where it leaves, and ten roundings of eq 10.5 come to 18 e and are within the
   pad. The part in L is not: it counts where a ray begins close to the edge of a large triangle, whose far corners
   are rounded though the hit is near. So the box has a margin when it is asked whether the ray meets it; L is at most
   twice the largest coordinate. It has none when it is asked for t_near, or whether all of it is behind the ray, for
   those need no more than a sign and a maximum.

   A box around this box and its margin has its planes farther out, and rounding is monotonic, so its t_near is not
   larger, and its t_far not smaller: hence its larger pad, since there the distance of the plane is multiplied by a
   1/d that is padded and rounded already, which may cost two roundings more. A box on the way to an accepted triangle
   is therefore never left out, whatever else was found, and the nearest hit, of equal ones that of the lowest number,
   is the same for every tree and every order. The tests compare it, bit by bit, with a loop over all triangles.

   For a component of d that is 0 a comparison with the triangle's own slab says no more than eq 10.7 does exactly,
   and `spare` makes it pass. */

typedef struct {
    float t[4], v[4], w[4], det[4];
} metroi_lanes;

/* Whether the box of a triangle is met with its margin, and is not behind without; and when it is entered. Nearly all
   boxes that are met are met without a margin, too, and then it need not be computed. */
METROI_INLINE int metroi_own_box(const metroi_block *block, int i, const metroi_ray *ray, float *enter)
{
    float lo[3], hi[3], near_t = ray->t_min, far_t = ray->t, leave = ray->t;
    int k;
    *enter = ray->t_min;
    for (k = 0; k < 3; k++) {
        const float *p = block->corner + 4 * k + i;
        float a = p[0], b = p[12], c = p[24];
        lo[k] = metroi_low(metroi_low(a, b), c);
        hi[k] = metroi_high(metroi_high(a, b), c);
        a = (lo[k] - ray->origin[k]) * ray->reach[k];
        b = (hi[k] - ray->origin[k]) * ray->reach[k];
        *enter = metroi_high(metroi_low(a, b), *enter);
        leave = metroi_low(metroi_high(a, b) + ray->spare[k], leave);
    }
    if (!(ray->t_min <= leave)) return 0;
    if (*enter <= leave) return 1;
    metroi_box_widen(lo, hi);
    for (k = 0; k < 3; k++) { /* eq 10.5 */
        float a = (lo[k] - ray->origin[k]) * ray->reach[k], b = (hi[k] - ray->origin[k]) * ray->reach[k];
        near_t = metroi_high(metroi_low(a, b), near_t);
        far_t = metroi_low(metroi_high(a, b) * METROI_PAD + ray->spare[k], far_t);
    }
    return near_t <= far_t;
}

/* Tests the four triangles of a block, and returns a bit for each that is hit between t_min and t. */
METROI_INLINE unsigned metroi_block_plain(const metroi_block *block, const metroi_ray *ray, metroi_lanes *lanes)
{
    size_t kx = ray->axis[0], ky = ray->axis[1], kz = ray->axis[2];
    int i, j;
    unsigned mask = 0;
    for (i = 0; i < 4; i++) {
        float x[3], y[3], z[3], U, V, W, T, t, enter;
        for (j = 0; j < 3; j++) { /* eq 10.6 */
            const float *p = block->corner + 12 * j + i;
            z[j] = p[4 * kz] - ray->origin[kz];
            x[j] = (p[4 * kx] - ray->origin[kx]) - ray->shear[0] * z[j];
            y[j] = (p[4 * ky] - ray->origin[ky]) - ray->shear[1] * z[j];
        }
        U = x[2] * y[1] - y[2] * x[1]; /* eq 10.7 */
        V = x[0] * y[2] - y[0] * x[2];
        W = x[1] * y[0] - y[1] * x[0];
        if (!((U >= 0 && V >= 0 && W >= 0) || (U <= 0 && V <= 0 && W <= 0))) continue;
        T = ((U * z[0] + V * z[1]) + W * z[2]) * ray->side;
        t = T / ((U + V) + W); /* eq 10.8: 1/d_z is d_z, 1 or -1 */
        if (!(t >= ray->t_min && t <= ray->t)) continue;
        if (!metroi_own_box(block, i, ray, &enter)) continue;
        t = metroi_high(t, enter); /* eq 10.9 */
        if (!(t <= ray->t)) continue;
        lanes->t[i] = t;
        lanes->v[i] = V;
        lanes->w[i] = W;
        lanes->det[i] = (U + V) + W;
        mask |= 1u << i;
    }
    return mask;
}

METROI_INLINE int metroi_lowest_bit(unsigned mask)
{
#if defined(__GNUC__) || defined(__clang__)
    return __builtin_ctz(mask);
#else
    int bit = 0;
    while ((mask >> bit & 1) == 0) bit++;
    return bit;
#endif
}

/* Takes the nearest of the hits in a block, if it is nearer than what the ray has. */
METROI_INLINE void metroi_ray_take(metroi_ray *ray, const metroi_block *block, const metroi_lanes *lanes,
                                   unsigned mask)
{
    do {
        int i = metroi_lowest_bit(mask);
        float t = lanes->t[i];
        double user = (ray->start + (double)t) * ray->unit;
        mask &= mask - 1;
        if (!(t < ray->t || (t == ray->t && block->triangle[i] < ray->triangle))) continue;
        if (!(user > ray->least && user < ray->most)) continue;
        ray->t = t;
        ray->v = lanes->v[i];
        ray->w = lanes->w[i];
        ray->det = lanes->det[i];
        ray->triangle = block->triangle[i];
    } while (mask != 0);
}

/* # 10.8 Four and eight at once

   The functions below are the tests above with the same operations in the same order, four boxes or triangles at a
   time. Where there are no such instructions the plain functions do the work. */

#ifdef METROI_SIMD
/* What boxes need of the ray in all four lanes, spread once a ray. */
typedef struct {
    metroi_v4 origin[3], inverse[3], padded[3];
    size_t row[6];
} metroi_ray4;

METROI_INLINE void metroi_ray4_axis(const metroi_ray *ray, int k, metroi_ray4 *s)
{
    s->origin[k] = metroi_v4_all(ray->origin[k]);
    s->inverse[k] = metroi_v4_all(ray->inverse[k]);
    s->padded[k] = metroi_v4_all(ray->inverse[k] * METROI_PAD_NODE);
}

METROI_INLINE void metroi_rows_spread(const metroi_ray *ray, size_t row[6])
{
    row[0] = ray->row[0];
    row[1] = ray->row[1];
    row[2] = ray->row[2];
    row[3] = ray->row[3];
    row[4] = ray->row[4];
    row[5] = ray->row[5];
}

METROI_INLINE void metroi_ray4_make(const metroi_ray *ray, metroi_ray4 *s)
{
    metroi_ray4_axis(ray, 0, s);
    metroi_ray4_axis(ray, 1, s);
    metroi_ray4_axis(ray, 2, s);
    metroi_rows_spread(ray, s->row);
}

METROI_INLINE metroi_v4 metroi_v4_plane(const float *row, metroi_v4 origin, metroi_v4 inverse)
{
    return metroi_v4_mul(metroi_v4_sub(metroi_v4_load(row), origin), inverse);
}

METROI_INLINE unsigned metroi_boxes_half(const float *row, const metroi_ray *ray, const metroi_ray4 *s, float *near_t)
{
    metroi_v4 n = metroi_v4_all(ray->t_min), f = metroi_v4_all(ray->t); /* eq 10.5 */
    n = metroi_v4_high(metroi_v4_plane(row + s->row[0], s->origin[0], s->inverse[0]), n);
    f = metroi_v4_low(metroi_v4_plane(row + s->row[3], s->origin[0], s->padded[0]), f);
    n = metroi_v4_high(metroi_v4_plane(row + s->row[1], s->origin[1], s->inverse[1]), n);
    f = metroi_v4_low(metroi_v4_plane(row + s->row[4], s->origin[1], s->padded[1]), f);
    n = metroi_v4_high(metroi_v4_plane(row + s->row[2], s->origin[2], s->inverse[2]), n);
    f = metroi_v4_low(metroi_v4_plane(row + s->row[5], s->origin[2], s->padded[2]), f);
    metroi_v4_store(near_t, n);
    return metroi_v4_mask(metroi_v4_le(n, f));
}

METROI_INLINE unsigned metroi_boxes_four(const metroi_node *node, const metroi_ray *ray, const void *spread,
                                         float near_t[8])
{
    const metroi_ray4 *s = (const metroi_ray4 *)spread;
    unsigned first = metroi_boxes_half(node->bound, ray, s, near_t);
    return first | metroi_boxes_half(node->bound + 4, ray, s, near_t + 4) << 4;
}

METROI_INLINE metroi_v4 metroi_v4_shear(const float *row, metroi_v4 origin, metroi_v4 shear, metroi_v4 z)
{
    return metroi_v4_sub(metroi_v4_sub(metroi_v4_load(row), origin), metroi_v4_mul(shear, z)); /* eq 10.6 */
}

METROI_INLINE metroi_v4 metroi_v4_edge(metroi_v4 px, metroi_v4 py, metroi_v4 qx, metroi_v4 qy)
{
    return metroi_v4_sub(metroi_v4_mul(qx, py), metroi_v4_mul(qy, px)); /* eq 10.7 */
}

/* As metroi_box_widen and metroi_own_box, for those of four triangles that are `in`: all ones where it is met. */
METROI_INLINE metroi_v4 metroi_v4_own_box(const float *row, const metroi_ray *ray, metroi_v4 in, metroi_v4 *enter)
{
    metroi_v4 lo[3], hi[3], origin[3], reach[3], spare[3], margin, a, b, c, met;
    metroi_v4 zero = metroi_v4_all(0), largest = zero;
    metroi_v4 begin = metroi_v4_all(ray->t_min), near_t = begin, far_t = metroi_v4_all(ray->t), leave = far_t;
    int k;
    *enter = begin;
    for (k = 0; k < 3; k++) {
        const float *p = row + 4 * k;
        a = metroi_v4_load(p);
        b = metroi_v4_load(p + 12);
        c = metroi_v4_load(p + 24);
        lo[k] = metroi_v4_low(metroi_v4_low(a, b), c);
        hi[k] = metroi_v4_high(metroi_v4_high(a, b), c);
        origin[k] = metroi_v4_all(ray->origin[k]);
        reach[k] = metroi_v4_all(ray->reach[k]);
        spare[k] = metroi_v4_all(ray->spare[k]);
        a = metroi_v4_mul(metroi_v4_sub(lo[k], origin[k]), reach[k]);
        b = metroi_v4_mul(metroi_v4_sub(hi[k], origin[k]), reach[k]);
        *enter = metroi_v4_high(metroi_v4_low(a, b), *enter);
        leave = metroi_v4_low(metroi_v4_add(metroi_v4_high(a, b), spare[k]), leave);
    }
    in = metroi_v4_and(in, metroi_v4_le(begin, leave));
    met = metroi_v4_and(in, metroi_v4_le(*enter, leave));
    if (metroi_v4_mask(met) == metroi_v4_mask(in)) return met;
    for (k = 0; k < 3; k++)
        largest = metroi_v4_high(metroi_v4_high(hi[k], metroi_v4_sub(zero, lo[k])), largest);
    margin = metroi_v4_mul(largest, metroi_v4_all(METROI_MARGIN));
    for (k = 0; k < 3; k++) { /* eq 10.5 */
        a = metroi_v4_mul(metroi_v4_sub(metroi_v4_sub(lo[k], margin), origin[k]), reach[k]);
        b = metroi_v4_mul(metroi_v4_sub(metroi_v4_add(hi[k], margin), origin[k]), reach[k]);
        near_t = metroi_v4_high(metroi_v4_low(a, b), near_t);
        b = metroi_v4_mul(metroi_v4_high(a, b), metroi_v4_all(METROI_PAD));
        far_t = metroi_v4_low(metroi_v4_add(b, spare[k]), far_t);
    }
    return metroi_v4_or(met, metroi_v4_and(in, metroi_v4_le(near_t, far_t)));
}

METROI_INLINE unsigned metroi_block_four(const metroi_block *block, const metroi_ray *ray, metroi_lanes *lanes)
{
    const size_t *axis = ray->axis;
    const float *row = block->corner, *px = row + 4 * axis[0], *py = row + 4 * axis[1], *pz = row + 4 * axis[2];
    metroi_v4 ox = metroi_v4_all(ray->origin[axis[0]]), sx = metroi_v4_all(ray->shear[0]);
    metroi_v4 oy = metroi_v4_all(ray->origin[axis[1]]), sy = metroi_v4_all(ray->shear[1]);
    metroi_v4 oz = metroi_v4_all(ray->origin[axis[2]]);
    metroi_v4 az = metroi_v4_sub(metroi_v4_load(pz), oz);
    metroi_v4 bz = metroi_v4_sub(metroi_v4_load(pz + 12), oz);
    metroi_v4 cz = metroi_v4_sub(metroi_v4_load(pz + 24), oz);
    metroi_v4 ax = metroi_v4_shear(px, ox, sx, az);
    metroi_v4 ay = metroi_v4_shear(py, oy, sy, az);
    metroi_v4 bx = metroi_v4_shear(px + 12, ox, sx, bz);
    metroi_v4 by = metroi_v4_shear(py + 12, oy, sy, bz);
    metroi_v4 cx = metroi_v4_shear(px + 24, ox, sx, cz);
    metroi_v4 cy = metroi_v4_shear(py + 24, oy, sy, cz);
    metroi_v4 U = metroi_v4_edge(bx, by, cx, cy), V = metroi_v4_edge(cx, cy, ax, ay);
    metroi_v4 W = metroi_v4_edge(ax, ay, bx, by), det = metroi_v4_add(metroi_v4_add(U, V), W), T, t, in;
    metroi_v4 zero = metroi_v4_all(0), n = metroi_v4_all(ray->t_min), f = metroi_v4_all(ray->t);
    in = metroi_v4_or(metroi_v4_le(zero, metroi_v4_low(metroi_v4_low(U, V), W)),
                      metroi_v4_le(metroi_v4_high(metroi_v4_high(U, V), W), zero));
    T = metroi_v4_add(metroi_v4_add(metroi_v4_mul(U, az), metroi_v4_mul(V, bz)), metroi_v4_mul(W, cz));
    t = metroi_v4_div(metroi_v4_mul(T, metroi_v4_all(ray->side)), det); /* eq 10.8 */
    in = metroi_v4_and(in, metroi_v4_and(metroi_v4_le(n, t), metroi_v4_le(t, f)));
    if (metroi_v4_mask(in) == 0) return 0;
    in = metroi_v4_own_box(row, ray, in, &n);
    t = metroi_v4_high(t, n); /* eq 10.9 */
    metroi_v4_store(lanes->t, t);
    metroi_v4_store(lanes->v, V);
    metroi_v4_store(lanes->w, W);
    metroi_v4_store(lanes->det, det);
    return metroi_v4_mask(metroi_v4_and(in, metroi_v4_le(t, f)));
}
#endif

/* With AVX2 each step of the test is one instruction for all eight boxes, which saves a tenth of the time. The
   program asks the processor when it runs, so nothing is asked of the compiler's options: the attribute permits the
   instructions in one function. gcc knows them by names of its own, and so does without the header of their common
   names, which would take a tenth as long to compile as all of this one.

   A box need not be tested in the form of eq 10.5: it only must not be missed where 10.7 would accept a triangle in
   it. So here the product and the difference of eq 10.5 are one fused instruction,

       t_near = max_k (n_k r_k - (o_k r_k + m_k)),    t_far = min_k (f_k r_k - (o_k r_k - m_k))             (10.10)

   with $r_k = 1/d_k$, and what does not depend on the box is computed once a ray. The margin $m_k$ covers what
   rounding does: the product $o_k r_k$ and the sums are off by 2^-24 of themselves, and times up to 16 differ between
   the two forms by 16 times 1.5e-6, the larger of the two pads. Infinities would turn to NaN here, so $r_k$ is at
   most 1e30; and 2.4e-7 of it in the margin keeps every box that is within that distance of a ray which runs along a
   plane. */

#ifdef METROI_AVX2
#ifdef __clang__
#include <immintrin.h>
#define METROI_V8(common, own) common
#else
#define METROI_V8(common, own) own
#endif
typedef float metroi_v8 __attribute__((vector_size(32)));
typedef float metroi_v8_anywhere __attribute__((vector_size(32), aligned(4), may_alias));

METROI_AVX2 METROI_INLINE metroi_v8 metroi_v8_low(metroi_v8 a, metroi_v8 b)
{
    return METROI_V8(_mm256_min_ps, __builtin_ia32_minps256)(a, b);
}

METROI_AVX2 METROI_INLINE metroi_v8 metroi_v8_high(metroi_v8 a, metroi_v8 b)
{
    return METROI_V8(_mm256_max_ps, __builtin_ia32_maxps256)(a, b);
}

METROI_AVX2 METROI_INLINE unsigned metroi_v8_le(metroi_v8 a, metroi_v8 b)
{
    metroi_v8 less = METROI_V8(_mm256_cmp_ps, __builtin_ia32_cmpps256)(a, b, 18); /* or equal, and no NaN */
    return (unsigned)METROI_V8(_mm256_movemask_ps, __builtin_ia32_movmskps256)(less);
}

METROI_AVX2 METROI_INLINE metroi_v8 metroi_v8_all(float x)
{
    metroi_v8 all = { x, x, x, x, x, x, x, x };
    return all;
}

typedef struct {
    metroi_v8 inverse[3], enter[3], leave[3];
    size_t row[6];
} metroi_ray8;

METROI_AVX2 METROI_INLINE void metroi_v8_spread(metroi_v4 a, metroi_v8 spread[3])
{
    float lane[4];
    metroi_v4_store(lane, a);
    spread[0] = metroi_v8_all(lane[0]);
    spread[1] = metroi_v8_all(lane[1]);
    spread[2] = metroi_v8_all(lane[2]);
}

METROI_AVX2 METROI_INLINE void metroi_ray8_make(const metroi_ray *ray, metroi_ray8 *s)
{
    metroi_v4 zero = metroi_v4_all(0), one = metroi_v4_all(1), o = metroi_v4_load(ray->origin), r, shift, margin;
    r = metroi_v4_low(metroi_v4_high(metroi_v4_load(ray->inverse), metroi_v4_all(-1e30f)), metroi_v4_all(1e30f));
    margin = metroi_v4_add(metroi_v4_high(o, metroi_v4_sub(zero, o)), one);
    margin = metroi_v4_mul(metroi_v4_mul(margin, metroi_v4_all(2.4e-7f)), metroi_v4_high(r, metroi_v4_sub(zero, r)));
    margin = metroi_v4_add(margin, metroi_v4_all(3e-5f));
    shift = metroi_v4_mul(o, r);
    metroi_v8_spread(r, s->inverse);
    metroi_v8_spread(metroi_v4_sub(metroi_v4_sub(zero, shift), margin), s->enter);
    metroi_v8_spread(metroi_v4_sub(margin, shift), s->leave);
    metroi_rows_spread(ray, s->row);
}

METROI_AVX2 METROI_INLINE metroi_v8 metroi_v8_plane(const float *row, metroi_v8 inverse, metroi_v8 shift)
{
    return METROI_V8(_mm256_fmadd_ps, __builtin_ia32_vfmaddps256)(*(const metroi_v8_anywhere *)row, inverse, shift);
}

METROI_AVX2 METROI_INLINE unsigned metroi_boxes_eight(const metroi_node *node, const metroi_ray *ray,
                                                      const void *spread, float near_t[8])
{
    const metroi_ray8 *s = (const metroi_ray8 *)spread;
    const float *bound = node->bound;
    metroi_v8 n = metroi_v8_all(ray->t_min), f = metroi_v8_all(ray->t); /* eq 10.10 */
    n = metroi_v8_high(metroi_v8_plane(bound + s->row[0], s->inverse[0], s->enter[0]), n);
    f = metroi_v8_low(metroi_v8_plane(bound + s->row[3], s->inverse[0], s->leave[0]), f);
    n = metroi_v8_high(metroi_v8_plane(bound + s->row[1], s->inverse[1], s->enter[1]), n);
    f = metroi_v8_low(metroi_v8_plane(bound + s->row[4], s->inverse[1], s->leave[1]), f);
    n = metroi_v8_high(metroi_v8_plane(bound + s->row[2], s->inverse[2], s->enter[2]), n);
    f = metroi_v8_low(metroi_v8_plane(bound + s->row[5], s->inverse[2], s->leave[2]), f);
    *(metroi_v8_anywhere *)near_t = n;
    return metroi_v8_le(n, f);
}
#endif

/* # 10.9 The walk

   From the root down, the ray goes to the nearest child that it meets and leaves the others on a stack, the nearest
   on top. When it has come to a leaf, or to a node none of whose children it meets, it takes the top of the stack, if
   that box does not begin behind the nearest hit so far. To know whether anything at all is hit, the first hit will
   do, and the order is of no concern.

   What waits is one number of 64 bits, the time of entrance above and the child below: times are not negative, and
   then the bits of floats are ordered as the floats are. Exchanging two such numbers needs no branch. Most nodes that
   are met have one or two children that are met, so up to four are sorted by a fixed list of exchanges and the rest
   by insertion.

   The depth of a tree is at most 72 (10.3) and a node leaves at most seven children, which bounds the stack. */

enum { METROI_STACK = 7 * METROI_DEPTH + 8 };

METROI_INLINE uint64_t metroi_waiting_next(const uint32_t *child, const float *near_t, unsigned *mask)
{
    int i = metroi_lowest_bit(*mask);
    *mask &= *mask - 1;
    return (uint64_t)metroi_float_bits(near_t[i]) << 32 | child[i];
}

METROI_INLINE void metroi_exchange(uint64_t *far_one, uint64_t *near_one)
{
    uint64_t a = *far_one, b = *near_one;
    *far_one = a > b ? a : b;
    *near_one = a > b ? b : a;
}

/* Puts all children in `mask`, of which there are at least two, on the stack in order, but the nearest, which it
   returns. */
METROI_INLINE uint32_t metroi_children_sort(const uint32_t *child, const float *near_t, unsigned mask,
                                            uint64_t *stack, int *top)
{
    uint64_t *base = stack + *top, *end = base, a, b, c, d;
    a = metroi_waiting_next(child, near_t, &mask);
    b = metroi_waiting_next(child, near_t, &mask);
    metroi_exchange(&a, &b);
    *end++ = a;
    if (mask != 0) {
        c = metroi_waiting_next(child, near_t, &mask);
        metroi_exchange(&b, &c);
        metroi_exchange(&a, &b);
        end[-1] = a;
        *end++ = b;
        b = c;
        if (mask != 0) {
            d = metroi_waiting_next(child, near_t, &mask);
            metroi_exchange(&c, &d);
            metroi_exchange(&end[-1], &c);
            metroi_exchange(&end[-2], &end[-1]);
            *end++ = c;
            b = d;
        }
    }
    while (mask != 0) {
        uint64_t *at = end++;
        a = metroi_waiting_next(child, near_t, &mask);
        metroi_exchange(&a, &b);
        for (; at > base && at[-1] < a; at--) at[0] = at[-1];
        at[0] = a;
    }
    *top = (int)(end - stack);
    return (uint32_t)b;
}

typedef unsigned (*metroi_boxes_test)(const metroi_node *node, const metroi_ray *ray, const void *spread,
                                      float near_t[8]);
typedef unsigned (*metroi_block_test)(const metroi_block *block, const metroi_ray *ray, metroi_lanes *lanes);

/* The two tests are arguments that are known where this is inlined, so that they are inlined in turn: one walk stands
   for all. `any` asks for any hit. */
METROI_INLINE void metroi_walk(const metroi_bvh *bvh, metroi_ray *ray, int any, metroi_boxes_test boxes,
                               metroi_block_test triangles, const void *spread)
{
    METROI_ALIGNED float near_t[8]; /* one store, which must not straddle two lines of the cache */
    METROI_ALIGNED metroi_lanes lanes;
    uint64_t stack[METROI_STACK];
    uint32_t at = 0;
    int top = 0;
    for (;;) {
        unsigned mask = 1;
        while (!(at & METROI_LEAF)) {
            const metroi_node *node = bvh->nodes + at;
            mask = boxes(node, ray, spread, near_t);
            if (mask == 0) break;
            at = node->child[metroi_lowest_bit(mask)];
            if ((mask & (mask - 1)) == 0) continue;
            if (!any) at = metroi_children_sort(node->child, near_t, mask, stack, &top);
            else while ((mask &= mask - 1) != 0) stack[top++] = node->child[metroi_lowest_bit(mask)];
        }
        if (at & METROI_LEAF) {
            const metroi_block *block = bvh->blocks + ((at & ~METROI_LEAF) >> 1), *end = block + 1 + (at & 1);
            for (; block < end; block++) {
                mask = triangles(block, ray, &lanes);
                if (mask != 0) metroi_ray_take(ray, block, &lanes, mask);
                if (any && ray->triangle != METROI_NONE) return;
            }
        }
        do {
            if (top == 0) return;
            top--;
        } while (!any && stack[top] >> 32 > metroi_float_bits(ray->t));
        at = (uint32_t)stack[top];
    }
}

static void metroi_walk_plain(const metroi_bvh *bvh, metroi_ray *ray, int any)
{
    metroi_walk(bvh, ray, any, metroi_boxes_plain, metroi_block_plain, NULL);
}

#ifdef METROI_SIMD
static void metroi_walk_four(const metroi_bvh *bvh, metroi_ray *ray, int any)
{
    metroi_ray4 spread;
    metroi_ray4_make(ray, &spread);
    if (any) metroi_walk(bvh, ray, 1, metroi_boxes_four, metroi_block_four, &spread);
    else metroi_walk(bvh, ray, 0, metroi_boxes_four, metroi_block_four, &spread);
}
#endif

#ifdef METROI_AVX2
METROI_AVX2 static void metroi_walk_eight(const metroi_bvh *bvh, metroi_ray *ray, int any)
{
    metroi_ray8 spread;
    metroi_ray8_make(ray, &spread);
    if (any) metroi_walk(bvh, ray, 1, metroi_boxes_eight, metroi_block_four, &spread);
    else metroi_walk(bvh, ray, 0, metroi_boxes_eight, metroi_block_four, &spread);
}
#endif

static void metroi_walk_best(const metroi_bvh *bvh, metroi_ray *ray, int any)
{
#ifdef METROI_AVX2
    if (bvh->path == METROI_EIGHT) {
        metroi_walk_eight(bvh, ray, any);
        return;
    }
#endif
#ifdef METROI_SIMD
    if (bvh->path != METROI_PLAIN) {
        metroi_walk_four(bvh, ray, any);
        return;
    }
#endif
    metroi_walk_plain(bvh, ray, any);
}

static metroi_path metroi_path_best(void)
{
#ifdef METROI_AVX2
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi") && __builtin_cpu_supports("fma"))
        return METROI_EIGHT;
#endif
#ifdef METROI_SIMD
    return METROI_FOUR;
#else
    return METROI_PLAIN;
#endif
}

METRO_API int metro_scene_hit(const metro_scene *scene, metro_vec3 origin, metro_vec3 direction, double t_min,
                              double t_max, metro_hit *hit)
{
    const metroi_bvh *bvh = (const metroi_bvh *)scene->bvh;
    metroi_ray ray;
    if (!metroi_ray_make(bvh, origin, direction, t_min, t_max, &ray)) return 0;
    metroi_walk_best(bvh, &ray, 0);
    if (ray.triangle == METROI_NONE) return 0;
    hit->t = (ray.start + (double)ray.t) * ray.unit;
    hit->u = (double)(ray.v / ray.det); /* eq 10.8 */
    hit->v = (double)(ray.w / ray.det);
    hit->triangle = ray.triangle;
    return 1;
}

METRO_API int metro_scene_occluded(const metro_scene *scene, metro_vec3 origin, metro_vec3 direction, double t_min,
                                   double t_max)
{
    const metroi_bvh *bvh = (const metroi_bvh *)scene->bvh;
    metroi_ray ray;
    if (!metroi_ray_make(bvh, origin, direction, t_min, t_max, &ray)) return 0;
    metroi_walk_best(bvh, &ray, 1);
    return ray.triangle != METROI_NONE;
}

/* # 10.10 Leaving a surface

   A path goes on from the point where it hit, and must not hit that triangle again because of a rounding. The usual
   cure, to start at t = 0.001 or so, is too much for a small scene and too little for a large one. We look at what is
   rounded instead. Let e = 2^-24, what a float rounds off, and let a ray start at o near a triangle, all of whose
   corners lie within L of o along each axis. In eq 10.6 a corner is rounded three times and in the sum of eq 10.8
   four times, each time by at most e L; so the test sees the triangle's plane displaced by at most about 8 e L along
   each axis, 14 e L at an angle. The weights U, V and W are rounded by a few e L^2, each on its own. That is
   nothing beside their sum when the triangle is as wide as it is long; but of a needle, whose width w is its doubled
   area over L, the sum is only L w, and the hit moves by a few e L/w of the length L. Starting higher than both above
   the plane, and going away from it, the ray does not meet it. How flat it leaves does not matter: the sum and the
   height over the length of the ray shrink alike.

   A ray rounds its start to floats (10.6), which moves it by up to $e abs(p_k)$ along axis k, and towards the plane
   by the share $abs(n_k)$ of that. So the height is

       h = 16 e L + min(w, 4 e L frac{L}{w}) + 2 e sum_k abs(n_k p_k)                    (10.11)

   on the side of the triangle that the direction points to. A needle is not left by more than its width; one that is
   thousands of times as long as wide may therefore be met again. A floor at y = 0 of triangles 10 long gives a height
   of about 1e-5, and a contact shadow begins that near to the contact; far from the origin of coordinates it is the
   spacing of the floats that decides, as it must.

   In a corner of a room that rounding may carry the start sideways through the other wall. So the point first moves a
   little towards the middle of its triangle, by a few times what its coordinates may be rounded. That keeps it inside
   where the triangles are about as wide as long. With walls of slender ones, some rays that start within rounding of
   an edge still get out: to be safe from that, all points would have to move hundreds of times as far. */

METROI_INLINE metro_vec3 metroi_facet_leave(const metroi_facet *facet, metro_vec3 point, metro_vec3 direction)
{
    const double e = 1.0 / 16777216;
    const metro_vec3 *p = facet->corner;
    metro_vec3 n = facet->normal, inward;
    double extent, per_extent, needle, height, shrink;
    if (!(facet->area2 > 0)) return point; /* no area, no side */
    extent = metroi_largest_component(metro_subtract(p[0], point));
    extent = metroi_larger(extent, metroi_largest_component(metro_subtract(p[1], point)));
    extent = metroi_larger(extent, metroi_largest_component(metro_subtract(p[2], point)));
    per_extent = 1 / extent;
    needle = 4 * e * extent * (extent * extent * facet->per_area2); /* w is area2/L */
    needle = metroi_smaller(needle, facet->area2 * per_extent);
    height = 16 * e * extent + needle; /* eq 10.11 */
    height += 2 * e * (fabs(n.x * point.x) + fabs(n.y * point.y) + fabs(n.z * point.z));
    if (metro_dot(n, direction) < 0) height = -height;
    inward = metro_subtract(metro_scale(metro_add(metro_add(p[0], p[1]), p[2]), 1.0 / 3), point);
    shrink = metroi_smaller(4 * e * (1 + metroi_largest_component(point) * per_extent), 0.5);
    point = metro_add(point, metro_scale(inward, shrink));
    return metro_add(point, metro_scale(n, height));
}

#undef METROI_ALIGNED
#undef METROI_LEAF
#undef METROI_NONE
#undef METROI_MARGIN
#undef METROI_PAD
#undef METROI_PAD_NODE
#undef METROI_REACH
#undef METROI_AVX2
#undef METROI_V8
#undef METROI_SIMD

/* # 11 Light

   Three models are all that the scenes of the paper need: a surface that reflects a part of the light in all
   directions and a part around the mirror direction, a lamp that is a triangle which glows evenly, and a camera that
   is a pinhole. Each is used in two ways: to say how much light goes from here to there, and to draw a direction, or
   a point, where much light goes. */

/* # 11.1 Surfaces

   The BRDF is the sum of a diffuse and a glossy lobe (Phong's, normalised by Lafortune and Willems 1994):

       f(i, o) = frac{k_d}{pi} + k_s frac{m + 2}{2 pi} max(0, cos(a))^m               (11.1)

   where a is the angle between i and the mirror image of o about the normal, and m the exponent `Ns`. It is
   symmetric, and with k_d + k_s <= 1 it sends out no more than it receives: the factor m + 2, rather than m + 1,
   makes the glossy lobe reflect k_s when the light falls on it perpendicularly, and less at grazing angles, where a
   part of the lobe is below the surface.

   A direction is drawn from the diffuse lobe with probability q, the share of k_d in k_d + k_s, and from the glossy
   lobe otherwise. Together the density per steradian is

       p(i) = q frac{cos(theta_i)}{pi} + (1 - q) frac{m + 1}{2 pi} max(0, cos(a))^m            (11.2)

   What eqs 11.1 and 11.2 share is computed once a material. */

typedef struct {
    metro_vec3 diffuse;      /* k_d / pi */
    metro_vec3 glossy;       /* k_s (m + 2)/(2 pi) */
    metro_vec3 emission;
    double exponent;         /* m */
    double share;            /* q; 1 where nothing is glossy */
    double lobe;             /* (m + 1)/(2 pi) */
    int black;               /* reflects nothing */
} metroi_surface;

static double metroi_color_sum(metro_vec3 color)
{
    return color.x + color.y + color.z;
}

static metroi_surface metroi_surface_make(const metro_material *material)
{
    metroi_surface surface;
    double diffuse = metroi_color_sum(material->kd), glossy = metroi_color_sum(material->ks);
    surface.diffuse = metro_scale(material->kd, 1 / METROI_PI);
    surface.glossy = metro_scale(material->ks, (material->ns + 2) / (2 * METROI_PI));
    surface.emission = material->ke;
    surface.exponent = material->ns;
    surface.share = glossy > 0 ? diffuse / (diffuse + glossy) : 1;
    surface.lobe = (material->ns + 1) / (2 * METROI_PI);
    surface.black = !(diffuse + glossy > 0);
    return surface;
}

/* The value of the BRDF and its two densities, of i for o and of o for i: the glossy part serves all three. With the
   cosines $c_i = n i$ and $c_o = n o$ that of the angle to the mirror direction is $2 c_i c_o - i o$. */

typedef struct {
    metro_vec3 value;
    double density, reverse; /* of drawing `in` for `out`, and `out` for `in` */
} metroi_scatter;

static inline metroi_scatter metroi_surface_scatter(const metroi_surface *surface, metro_vec3 normal, metro_vec3 in,
                                             metro_vec3 out)
{
    double cos_in = metro_dot(normal, in), cos_out = metro_dot(normal, out);
    metroi_scatter s;
    s.value = metro_vec3_make(0, 0, 0);
    s.density = s.reverse = 0;
    if (!(cos_in > 0) || !(cos_out > 0)) return s;
    s.value = surface->diffuse;
    s.density = surface->share * cos_in / METROI_PI;
    s.reverse = surface->share * cos_out / METROI_PI;
    if (surface->share < 1) {
        double mirror = 2 * cos_in * cos_out - metro_dot(in, out);
        double lobe = mirror > 0 ? pow(mirror < 1 ? mirror : 1, surface->exponent) : 0;
        double density = (1 - surface->share) * surface->lobe * lobe;
        s.value = metro_add(s.value, metro_scale(surface->glossy, lobe)); /* eq 11.1 */
        s.density += density;                                             /* eq 11.2 */
        s.reverse += density;
    }
    return s;
}

/* A direction at the height `z` above the plane of `axis`, at the given azimuth, in the frame of section 3.9. */

static inline metro_vec3 metroi_direction_at(metro_vec3 axis, double z, double turn)
{
    double radius = sqrt(z < 1 ? (1 - z) * (1 + z) : 0);
    return metroi_in_frame(axis, radius * cos(2 * METROI_PI * turn), radius * sin(2 * METROI_PI * turn), z);
}

/* A uniform point of a disc lifted onto the hemisphere has the density cos/pi (Malley 1988): its height is the root
   of a uniform number. The glossy lobe is a power of the cosine about the mirror direction, so its height is a root
   of order m + 1. One number serves twice: it chooses the lobe, and what is left of it is uniform again. */

static inline metro_vec3 metroi_surface_draw(const metroi_surface *surface, metro_vec3 normal, metro_vec3 out,
                                             double u, double v)
{
    if (u < surface->share) return metroi_direction_at(normal, sqrt(1 - u / surface->share), v);
    u = (u - surface->share) / (1 - surface->share);
    out = metro_subtract(metro_scale(normal, 2 * metro_dot(normal, out)), out);
    return metroi_direction_at(out, pow(1 - u, 1 / (surface->exponent + 1)), v);
}

METRO_API metro_vec3 metro_brdf(const metro_material *material, metro_vec3 normal, metro_vec3 in, metro_vec3 out)
{
    metroi_surface surface = metroi_surface_make(material);
    return metroi_surface_scatter(&surface, normal, in, out).value;
}

METRO_API double metro_brdf_density(const metro_material *material, metro_vec3 normal, metro_vec3 in, metro_vec3 out)
{
    metroi_surface surface = metroi_surface_make(material);
    return surface.black ? 0 : metroi_surface_scatter(&surface, normal, in, out).density;
}

METRO_API double metro_brdf_sample(const metro_material *material, metro_vec3 normal, metro_vec3 out, double u,
                                   double v, metro_vec3 *in)
{
    metroi_surface surface = metroi_surface_make(material);
    *in = metroi_surface_draw(&surface, normal, out, u, v);
    return surface.black ? 0 : metroi_surface_scatter(&surface, normal, *in, out).density;
}

/* # 11.2 Lamps

   A lamp is a triangle whose material emits. Among many, one is chosen with a probability proportional to area times
   luminance, and then a point of it, uniformly: the square of (u, v) is folded onto the triangle by a root (Turk
   1990). The density per area of a point on triangle j is

       p_A = frac{Y_j}{sum_{i} A_i Y_i}                                               (11.3)

   with $Y$ the luminance of the emission: it does not depend on the size of the triangle, so a lamp may be cut into
   as many pieces as one likes. */

static double metroi_light_density(const metro_scene *scene, const metroi_surface *surface)
{
    metro_vec3 ke = surface->emission;
    return metro_luminance(ke.x, ke.y, ke.z) / scene->light_power; /* eq 11.3 */
}

/* The lamp of the number u in [0, 1); what is left of u is uniform in [0, 1) again. */

static uint32_t metroi_light_choose(const metro_scene *scene, double *u)
{
    size_t low = 0, high = scene->light_count - 1;
    double before, share;
    while (low < high) {
        size_t middle = low + (high - low) / 2;
        if (scene->light_sum[middle] > *u) high = middle;
        else low = middle + 1;
    }
    before = low > 0 ? scene->light_sum[low - 1] : 0;
    share = scene->light_sum[low] - before;
    *u = share > 0 ? (*u - before) / share : 0;
    if (!(*u < 1)) *u = 1 - 1e-16;
    return scene->light[low];
}

METROI_INLINE metro_vec3 metroi_light_point(const metroi_facet *lamp, double u, double v)
{
    double root = sqrt(u);
    return metroi_between(lamp->corner, root * (1 - v), root * v);
}

/* # 11.3 The camera

   The film stands at distance 1 before the eye: its upper edge is at height tan(fov/2). With the view direction f, r
   to the right and u upwards the ray through the film position (x, y) has the direction

       d = f + tan("fov"/2) ((frac{2 x}{W} - 1) frac{W}{H} r - (frac{2 y}{H} - 1) u)              (11.4)

   A pixel is the mean over its square. Let x and y be drawn uniformly over the whole film, of area
   $A = 4 tan^2("fov"/2) frac{W}{H}$. An area element of the film at the angle theta from f covers the solid angle
   cos^3(theta) of it, so the density of the direction per steradian is

       p(omega) = frac{1}{A cos^3(theta)}                                             (11.5)

   and this is also how strongly the camera responds to light from there: a direction that is drawn with that density
   has the weight 1. */

typedef struct {
    metro_vec3 eye, forward, right, down; /* right and down reach from the middle of the film to its edges */
    double width, height;
    double right2, down2;                 /* their squared lengths */
    double density;                       /* 1/A */
} metroi_camera;

METRO_API metro_result metro_camera_check(const metro_camera *camera)
{
    metro_vec3 forward = metro_normalize(metro_subtract(camera->look, camera->eye));
    metro_vec3 across = metro_cross(forward, metro_normalize(camera->up));
    if (!(metro_dot(across, across) > 1e-20) || !(camera->fov > 0 && camera->fov < 180)) return METRO_ERROR_ARGUMENT;
    return isfinite(metroi_largest_component(camera->eye)) ? METRO_OK : METRO_ERROR_ARGUMENT;
}

static metroi_camera metroi_camera_make(const metro_camera *camera, size_t width, size_t height)
{
    metroi_camera c;
    double t = metro_camera_check(camera) == METRO_OK ? tan(camera->fov * METROI_PI / 360) : METROI_NAN;
    double aspect = (double)width / (double)height;
    c.eye = camera->eye;
    c.forward = metro_normalize(metro_subtract(camera->look, camera->eye));
    c.right = metro_normalize(metro_cross(c.forward, metro_normalize(camera->up)));
    c.down = metro_scale(metro_cross(c.forward, c.right), t);
    c.right = metro_scale(c.right, t * aspect);
    c.width = (double)width;
    c.height = (double)height;
    c.right2 = metro_dot(c.right, c.right);
    c.down2 = metro_dot(c.down, c.down);
    c.density = 1 / (4 * t * t * aspect);
    return c;
}

static metro_vec3 metroi_camera_direction(const metroi_camera *camera, double x, double y)
{
    metro_vec3 across = metro_scale(camera->right, 2 * x / camera->width - 1);
    metro_vec3 along = metro_scale(camera->down, 2 * y / camera->height - 1);
    return metro_normalize(metro_add(camera->forward, metro_add(across, along))); /* eq 11.4 */
}

/* The density of eq 11.5 for a unit direction in front of the camera. */
static double metroi_camera_density(const metroi_camera *camera, metro_vec3 direction)
{
    double cosine = metro_dot(camera->forward, direction);
    return camera->density / (cosine * cosine * cosine);
}

static int metroi_camera_project(const metroi_camera *camera, metro_vec3 point, double *x, double *y)
{
    metro_vec3 d = metro_subtract(point, camera->eye);
    double depth = metro_dot(d, camera->forward), column, row;
    if (!(depth > 0)) return 0;
    column = (metro_dot(d, camera->right) / (depth * camera->right2) + 1) / 2 * camera->width;
    row = (metro_dot(d, camera->down) / (depth * camera->down2) + 1) / 2 * camera->height;
    if (!(column >= 0 && column < camera->width && row >= 0 && row < camera->height)) return 0;
    *x = column;
    *y = row;
    return 1;
}

METRO_API metro_vec3 metro_camera_direction(const metro_camera *camera, size_t width, size_t height, double x,
                                            double y)
{
    metroi_camera c = metroi_camera_make(camera, width, height);
    return metroi_camera_direction(&c, x, y);
}

METRO_API int metro_camera_project(const metro_camera *camera, size_t width, size_t height, metro_vec3 point,
                                   double *x, double *y)
{
    metroi_camera c = metroi_camera_make(camera, width, height);
    return metroi_camera_project(&c, point, x, y);
}

/* # 12 Paths

   The light that reaches a pixel is an integral over all paths from a lamp to the eye. A path of k edges has k + 1
   vertices; with the throughput f of a path, the product of what its vertices reflect and of the geometry of its
   edges, a pixel is (Veach 1997, chapter 8)

       L = sum_{k=1}^{K} int f(x_0 .. x_k) dA(x_0) .. dA(x_k)                         (12.1)

   All methods of this chapter draw paths at random and divide f by the density of what they drew. They differ in
   where a path is begun. */

/* # 12.1 Numbers

   A walk asks for pairs of numbers: where on the film, which point of a lamp, which direction next. They come from
   one of three places. A stream gives random ones. A state of the chain of chapter 4 gives its coordinates, each pair
   a fixed place. And points that fill the square evenly give a pixel's own samples in each of the first few pairs,
   where evenness pays; deeper pairs are random. */

enum { METROI_FILM, METROI_LAMP, METROI_LAMP_DIRECTION, METROI_EYE_BOUNCE, METROI_LAMP_BOUNCE, METROI_LAMP_SAMPLE };

typedef struct {
    metro_rng *rng;        /* for what the others do not give */
    const double *z;       /* a state, or NULL */
    uint64_t scramble;     /* a pixel's own scramble of the even points, */
    uint32_t index;        /* the number of the point, */
    unsigned even_pairs;   /* and how many pairs are even */
} metroi_numbers;

/* The pairs in the order of their weight in the picture. */

static unsigned metroi_pair_rank(int kind, int bounce)
{
    unsigned i = (unsigned)bounce;
    switch (kind) {
    case METROI_FILM: return 0;
    case METROI_EYE_BOUNCE: return i == 1 ? 1 : 3 * i - 1;
    case METROI_LAMP_SAMPLE: return i == 1 ? 2 : 3 * i;
    case METROI_LAMP: return 3;
    case METROI_LAMP_DIRECTION: return 4;
    default: return 3 * i + 4;
    }
}

/* The place of a pair in a state, which has no samples of its own at each vertex: film, lamp, and then the directions
   of both walks in turn. */

static size_t metroi_pair_place(int kind, int bounce)
{
    size_t i = (size_t)bounce;
    switch (kind) {
    case METROI_FILM: return 0;
    case METROI_LAMP: return 1;
    case METROI_LAMP_DIRECTION: return 2;
    case METROI_EYE_BOUNCE: return 2 * i + 1;
    default: return 2 * i + 2;
    }
}

/* Even points: the first two coordinates of Sobol's sequence put one point into each of $2^k$ boxes of any shape, for
   each run of $2^k$ points. Pairs are kept independent of each other by taking the points of each in an order of its
   own, shuffled so that the runs stay together (Kollig and Keller 2002), and by scrambling their digits. Both are the
   scrambling of section 2.3, eq 2.4, of the number of the point and of its coordinates; since a path takes up to
   thirty of them, the coins come from one hash of the mirrored digits (Laine and Karras 2011, with the constants of
   Vegdahl 2021), a tenth of the time of those of section 2.3 and even enough for pictures. */

static inline uint32_t metroi_mirror(uint32_t x)
{
    x = x >> 16 | x << 16;
    x = (x & 0x00ff00ffu) << 8 | (x & 0xff00ff00u) >> 8;
    x = (x & 0x0f0f0f0fu) << 4 | (x & 0xf0f0f0f0u) >> 4;
    x = (x & 0x33333333u) << 2 | (x & 0xccccccccu) >> 2;
    return (x & 0x55555555u) << 1 | (x & 0xaaaaaaaau) >> 1;
}

/* Flips each digit by a coin that the digits below it decide. */
static inline uint32_t metroi_flip(uint32_t x, uint32_t key)
{
    x ^= x * 0x3d20adeau;
    x += key;
    x *= (key >> 16) | 1u;
    x ^= x * 0x05526c56u;
    x ^= x * 0x53a22864u;
    return x;
}

/* The digits of the second coordinate. Digit i of it is the sum of all digits a of the number for which the binomial
   coefficient (a over i) is odd (eq 2.2: its direction numbers are the rows of Pascal's triangle modulo 2), that is,
   for which the ones of i are among those of a. Five steps add up over the five digits of a. */
static uint32_t metroi_pascal(uint32_t x)
{
    x ^= (x & 0xaaaaaaaau) >> 1;
    x ^= (x & 0xccccccccu) >> 2;
    x ^= (x & 0xf0f0f0f0u) >> 4;
    x ^= (x & 0xff00ff00u) >> 8;
    return x ^ x >> 16;
}

static void metroi_even_pair(uint32_t index, uint64_t key, double *u, double *v)
{
    uint32_t x = metroi_mirror(metroi_flip(metroi_mirror(index), (uint32_t)key)); /* the shuffled number */
    uint64_t flips = metroi_mix(key);
    *u = metroi_mirror(metroi_flip(x, (uint32_t)flips)) * (1.0 / 4294967296.0); /* the first is its mirror image */
    *v = metroi_mirror(metroi_flip(metroi_pascal(x), (uint32_t)(flips >> 32))) * (1.0 / 4294967296.0);
}

static inline void metroi_numbers_pair(const metroi_numbers *numbers, int kind, int bounce, double *u, double *v)
{
    unsigned rank;
    if (numbers->z != NULL) {
        const double *z = numbers->z + 2 * metroi_pair_place(kind, bounce);
        *u = z[0];
        *v = z[1];
        return;
    }
    rank = metroi_pair_rank(kind, bounce);
    if (rank < numbers->even_pairs) {
        metroi_even_pair(numbers->index, metroi_mix(numbers->scramble + rank), u, v);
        return;
    }
    *u = metro_rng_uniform(numbers->rng);
    *v = metro_rng_uniform(numbers->rng);
}

/* # 12.2 Walks

   A walk from the eye gathers, a walk from a lamp shoots. Both are lists of vertices, and a vertex carries what the
   walk has collected: the product of cosines and BRDFs over the densities of what was drawn, alpha. For the walk from
   a lamp,

       alpha_0 = frac{L_e}{p_A},  alpha_{i+1} = alpha_i frac{f cos(theta)}{p(omega)}             (12.2)

   and for the walk from the eye alpha starts with 1, because eq 11.5 is both the density and the response of the
   camera.

   One path can be made in many ways: by a walk from the eye of t vertices, a walk from a lamp of s vertices, and an
   edge that joins their ends. Which of the s + t = k + 1 pairs is good depends on the scene, and the weights of
   section 12.3 choose. They need the densities, per area, of all vertices from both sides, so a vertex also keeps
   what the sum over the other ways has become. */

typedef struct {
    metro_vec3 point, normal;
    metro_vec3 origin;              /* of rays that leave it: off the surface, on the side of the normal */
    metro_vec3 previous;            /* the unit direction to the vertex before */
    metro_vec3 weight;              /* alpha of eq 12.2 */
    const metroi_surface *surface;  /* NULL at the eye */
    uint32_t triangle;
    int lamp;                       /* the first vertex of a walk from a lamp */
    double forward;                 /* the density per area with which the walk came here */
    double a, b;                    /* eq 12.6 */
} metroi_vertex;

typedef struct {
    const metro_scene *scene;
    const metroi_surface *surface;  /* [material_count + 1] */
    metroi_camera camera;
    int depth, shortest;            /* the most and the fewest edges of a path */
    int from_eye, from_lamp;        /* which walks are made */
    int eye_walks;                  /* for each walk from a lamp */
    int uniform_directions;         /* directions are points of the sphere, with density 1/(4 pi): section 13.1 */
    int one_connection;
    int separate;                   /* each contribution is kept apart: for the pyramid */
    metro_heuristic heuristic;
} metroi_tracer;

/* What a path contributes to the picture: at one place for all ways that end in the walk from the eye, and anywhere
   for those that reach the film from a lamp. */

typedef struct {
    metro_vec3 color;
    uint32_t pixel;
    uint16_t s, t;
} metroi_splat;

typedef struct {
    size_t count;
    uint64_t rays;
    double importance;     /* of the state it belongs to, in a chain */
} metroi_sample;

/* Behind a sample are as many splats as metroi_sample_room says, and behind a log (12.7) as many entries as its slot
   has room for. */
#define METROI_BEHIND(type, block) ((type *)((block) + 1))

static size_t metroi_sample_room(const metroi_tracer *tracer)
{
    size_t depth = (size_t)tracer->depth;
    return tracer->separate ? (depth + 1) * (depth + 2) / 2 : depth + 2;
}

static size_t metroi_sample_size(const metroi_tracer *tracer)
{
    return sizeof(metroi_sample) + metroi_sample_room(tracer) * sizeof(metroi_splat);
}

static metro_vec3 metroi_multiply(metro_vec3 a, metro_vec3 b)
{
    return metro_vec3_make(a.x * b.x, a.y * b.y, a.z * b.z);
}

static double metroi_color_luminance(metro_vec3 color)
{
    return metro_luminance(color.x, color.y, color.z);
}

/* A NaN is not black, so that it is counted in the end. */
static int metroi_color_black(metro_vec3 color)
{
    return color.x <= 0 && color.y <= 0 && color.z <= 0;
}

static void metroi_sample_add(metroi_sample *sample, const metroi_tracer *tracer, uint32_t pixel, int s, int t,
                              metro_vec3 color)
{
    metroi_splat *splat = METROI_BEHIND(metroi_splat, sample), *end = splat + sample->count;
    if (metroi_color_black(color)) return;
    if (!tracer->separate)
        for (; splat < end; splat++)
            if (splat->pixel == pixel) {
                splat->color = metro_add(splat->color, color);
                return;
            }
    splat = end;
    sample->count++;
    splat->color = color;
    splat->pixel = pixel;
    splat->s = (uint16_t)s;
    splat->t = (uint16_t)t;
}

/* # 12.3 Weights

   Let $p_s$ be the density with which the way of s vertices from the lamp makes a given path. Any weights w_s that
   sum to 1 over the ways leave the mean right; those of the power heuristic (Veach and Guibas 1995)

       w_s = frac{p_s^2}{sum_{i} p_i^2}                                               (12.3)

   keep the variance low, and so does the balance heuristic, which has the power 1. Neighbouring densities have a
   simple ratio: the two ways differ in one vertex, which one draws forwards and the other backwards. With f_i the
   density of vertex i from its own walk, and b_i the density with which the other walk would have drawn it,

       frac{p_{s+1}}{p_s} = frac{b_{t-1}}{f_{t-1}}                                    (12.4)

   for the last vertex of the eye's walk, and so on towards the eye, and the same on the other side towards the lamp.
   So 1/w_s = 1 + S_y + S_z, where each sum, with h(x) = x^2 or x, is a nest

       S = h(frac{b_n}{f_n}) (1 + h(frac{b_{n-1}}{f_{n-1}}) (1 + h(frac{b_{n-2}}{f_{n-2}}) (1 + ...)))      (12.5)

   Only b_n and b_{n-1} depend on what is joined. The rest is known when vertex n is made, and vertex n carries it
   (Georgiev 2012): with q_n the density per steradian of going back from n to n-1, and g_n = cos(theta_{n-1})/d^2,
   which makes it one per area,

       A_n = h(frac{1}{f_n}),  B_n = h(frac{g_n}{f_{n-1}}) (1 + h(q_{n-1}) B_{n-1}),
       S = h(b_n) A_n (1 + h(q_n) B_n)                                                (12.6)

   The eye is never met by accident: its density is infinite, and B_1 = 0. */

static double metroi_power(const metroi_tracer *tracer, double x)
{
    return tracer->heuristic == METRO_BALANCE ? x : x * x;
}

/* S of eq 12.5, by eq 12.6, for the densities with which the other side comes here, per area, and goes on, per
   steradian. */
static inline double metroi_ways(const metroi_tracer *tracer, const metroi_vertex *vertex, double here, double on)
{
    return metroi_power(tracer, here) * vertex->a * (1 + metroi_power(tracer, on) * vertex->b); /* eq 12.6 */
}

/* What a vertex does between the direction `toward` and that of the vertex before it: `density` is that of drawing
   `toward`, `reverse` that of the walk the other way round. The BRDF is symmetric, so a vertex need not know which
   walk it is on. A lamp's own vertex emits evenly and draws directions by their cosine. With uniform directions all
   densities are the same. */

static inline metroi_scatter metroi_vertex_scatter(const metroi_tracer *tracer, const metroi_vertex *vertex,
                                            metro_vec3 toward)
{
    metroi_scatter s;
    if (vertex->lamp) {
        s.value = metro_vec3_make(1, 1, 1);
        s.density = metro_dot(vertex->normal, toward) / METROI_PI;
        s.reverse = 0;
    } else s = metroi_surface_scatter(vertex->surface, vertex->normal, toward, vertex->previous);
    if (tracer->uniform_directions) s.density = s.reverse = 1 / (4 * METROI_PI);
    return s;
}

/* # 12.4 Going on

   A vertex is where a ray arrives. `density` is that of the direction, per steradian, and `back` the density with
   which a walk that came the other way would go on from `from` to the vertex before it. Nothing is seen of the back
   of a triangle, so a walk ends there. When there are no walks from a lamp, the only two ways are to meet the lamp
   and to aim at it from the last vertex but one, and the rest of the nest is cut off. */

static int metroi_walk_arrive(const metroi_tracer *tracer, metroi_sample *sample, const metroi_vertex *from,
                              metro_vec3 direction, double density, double back, metroi_vertex *to)
{
    const metro_scene *scene = tracer->scene;
    double cosine, distance2;
    metroi_facet facet;
    metro_hit hit;
    sample->rays++;
    if (!metro_scene_hit(scene, from->origin, direction, 0, METROI_INFINITY, &hit)) return 0;
    facet = metroi_facet_of(scene, hit.triangle);
    cosine = -metro_dot(facet.normal, direction);
    if (!(cosine > 0)) return 0;
    to->surface = tracer->surface + scene->material_of[hit.triangle];
    to->normal = facet.normal;
    to->point = metroi_between(facet.corner, hit.u, hit.v);
    to->origin = metroi_facet_leave(&facet, to->point, facet.normal);
    to->triangle = hit.triangle;
    to->lamp = 0;
    to->previous = metro_scale(direction, -1);
    direction = metro_subtract(to->point, from->point);
    distance2 = metro_dot(direction, direction);
    if (!(distance2 > 0)) return 0;
    to->forward = density * cosine / distance2;
    to->a = metroi_power(tracer, 1 / to->forward);
    cosine = -metro_dot(from->normal, to->previous);
    to->b = metroi_power(tracer, cosine / (distance2 * from->forward))
          * (1 + metroi_power(tracer, back) * from->b); /* eq 12.6 */
    if (!tracer->from_lamp) {
        to->b = 0;
        if (from->surface == NULL) to->a = 0;
    }
    return 1;
}

/* The first vertex of each walk. */

static void metroi_walk_eye(const metroi_tracer *tracer, metroi_vertex *vertex)
{
    memset(vertex, 0, sizeof *vertex);
    vertex->point = vertex->origin = tracer->camera.eye;
    vertex->normal = tracer->camera.forward;
    vertex->weight = metro_vec3_make(1, 1, 1);
    vertex->forward = METROI_INFINITY;
}

static void metroi_walk_lamp(const metroi_tracer *tracer, double u, double v, metroi_vertex *vertex)
{
    const metro_scene *scene = tracer->scene;
    metroi_facet lamp;
    memset(vertex, 0, sizeof *vertex);
    vertex->triangle = metroi_light_choose(scene, &u);
    lamp = metroi_facet_of(scene, vertex->triangle);
    vertex->normal = lamp.normal;
    vertex->point = metroi_light_point(&lamp, u, v);
    vertex->origin = metroi_facet_leave(&lamp, vertex->point, lamp.normal);
    vertex->surface = tracer->surface + scene->material_of[vertex->triangle];
    vertex->lamp = 1;
    vertex->forward = metroi_light_density(scene, vertex->surface);
    vertex->weight = metro_scale(vertex->surface->emission, 1 / vertex->forward); /* eq 12.2 */
    vertex->a = metroi_power(tracer, 1 / vertex->forward);
}

/* The direction in which a walk goes on from a vertex, as its numbers say. */

static inline metro_vec3 metroi_walk_direction(const metroi_tracer *tracer, const metroi_numbers *numbers,
                                        const metroi_vertex *vertex, int kind, int bounce)
{
    double u, v;
    if (tracer->uniform_directions) {
        const double *z = numbers->z + 3 * metroi_pair_place(kind, bounce) - 2; /* two pairs stand before */
        return metro_vec3_make(z[0], z[1], z[2]);
    }
    metroi_numbers_pair(numbers, kind, bounce, &u, &v);
    if (vertex->lamp) return metroi_direction_at(vertex->normal, sqrt(1 - u), v);
    return metroi_surface_draw(vertex->surface, vertex->normal, vertex->previous, u, v);
}

/* A walk from the eye that carries little is ended by a coin and otherwise carries more, which leaves the mean as it
   is (Russian roulette, Arvo and Kirk 1990). The coin is no part of the densities above: weights that sum to 1 need
   not know of it. A state of a chain has no coins. */

static int metroi_walk_survives(const metroi_numbers *numbers, int bounce, metro_vec3 *weight)
{
    double chance = 4 * metroi_color_luminance(*weight);
    if (numbers->z != NULL || bounce < 3 || chance >= 1) return 1;
    if (chance < 0.05) chance = 0.05;
    if (metro_rng_uniform(numbers->rng) >= chance) return 0;
    *weight = metro_scale(*weight, 1 / chance);
    return 1;
}

/* Carries the walk on from its last vertex until it has `most` vertices or ends; returns how many it has. */

static int metroi_walk_on(const metroi_tracer *tracer, const metroi_numbers *numbers, metroi_sample *sample, int eye,
                       metroi_vertex *vertex, int count, int most)
{
    for (; count < most; count++) {
        const metroi_vertex *from = &vertex[count - 1];
        metroi_vertex *to = &vertex[count];
        int kind = eye ? METROI_EYE_BOUNCE : from->lamp ? METROI_LAMP_DIRECTION : METROI_LAMP_BOUNCE;
        metro_vec3 direction;
        metroi_scatter s;
        double cosine;
        if (!from->lamp && from->surface->black) break;
        direction = metroi_walk_direction(tracer, numbers, from, kind, count - 1);
        cosine = metro_dot(from->normal, direction);
        if (!(cosine > 0)) break;
        s = metroi_vertex_scatter(tracer, from, direction);
        if (!(s.density > 0)) break;
        to->weight = metro_scale(metroi_multiply(from->weight, s.value), cosine / s.density); /* eq 12.2 */
        if (eye && !metroi_walk_survives(numbers, count - 1, &to->weight)) break;
        if (!metroi_walk_arrive(tracer, sample, from, direction, s.density, s.reverse, to)) break;
    }
    return count;
}

/* The walk from the eye through the film position (x, y), and the one from a lamp. */

static int metroi_walk_from_eye(const metroi_tracer *tracer, const metroi_numbers *numbers, metroi_sample *sample,
                                double x, double y, metroi_vertex *vertex, int most)
{
    metro_vec3 direction = metroi_camera_direction(&tracer->camera, x, y);
    double density = tracer->eye_walks * metroi_camera_density(&tracer->camera, direction); /* eq 12.8 */
    metroi_walk_eye(tracer, &vertex[0]);
    if (most < 2) return 1;
    vertex[1].weight = vertex[0].weight;
    if (!metroi_walk_arrive(tracer, sample, &vertex[0], direction, density, 0, &vertex[1])) return 1;
    return metroi_walk_on(tracer, numbers, sample, 1, vertex, 2, most);
}

static int metroi_walk_from_lamp(const metroi_tracer *tracer, const metroi_numbers *numbers, metroi_sample *sample,
                                 metroi_vertex *vertex, int most)
{
    double u, v;
    if (most < 1) return 0;
    metroi_numbers_pair(numbers, METROI_LAMP, 0, &u, &v);
    metroi_walk_lamp(tracer, u, v, &vertex[0]);
    return metroi_walk_on(tracer, numbers, sample, 0, vertex, 1, most);
}

/* # 12.5 Joining

   A way with s = 0 needs no join: the walk from the eye has met a lamp. */

static double metroi_heuristic(const metroi_tracer *tracer, double others)
{
    return tracer->heuristic == METRO_UNWEIGHTED || !tracer->from_eye ? 1 : 1 / (1 + others); /* eq 12.3 */
}

static metro_vec3 metroi_join_met(const metroi_tracer *tracer, const metroi_vertex *z)
{
    metro_vec3 emission = z->surface->emission;
    double on = metro_dot(z->normal, z->previous) / METROI_PI, here;
    if (metroi_color_black(emission)) return emission;
    if (tracer->uniform_directions) on = 1 / (4 * METROI_PI);
    here = metroi_light_density(tracer->scene, z->surface);
    here = metroi_heuristic(tracer, metroi_ways(tracer, z, here, on));
    return metro_scale(metroi_multiply(z->weight, emission), here);
}

/* Nothing stands between two vertices: seen from origins off both surfaces, so that neither hides the other. The
   single precision of t knows the far end to some 1e-7 of the way only, which for small triangles is more than they
   are moved off, so the look ends sixteen such steps before it. */

static int metroi_scene_open(const metro_scene *scene, metro_vec3 from, metro_vec3 to)
{
    return !metro_scene_occluded(scene, from, metro_subtract(to, from), 0, 1 - 16.0 / (1 << 23));
}

static int metroi_join_open(const metroi_tracer *tracer, metroi_sample *sample, const metroi_vertex *y,
                            const metroi_vertex *z)
{
    sample->rays++;
    return metroi_scene_open(tracer->scene, z->origin, y->origin);
}

/* The end y of a walk from a lamp and the end z of one from the eye, joined by an edge:

       L = alpha_z f(z) frac{cos(theta_z) cos(theta_y)}{d^2} V(z, y) f(y) alpha_y                (12.7) */

static metro_vec3 metroi_join_edge(const metroi_tracer *tracer, metroi_sample *sample, const metroi_vertex *y,
                                   const metroi_vertex *z)
{
    metro_vec3 black = metro_vec3_make(0, 0, 0), d = metro_subtract(y->point, z->point), color;
    double distance2 = metro_dot(d, d), cos_y, cos_z, others = 0;
    metroi_scatter at_y, at_z;
    if (z->surface->black || (!y->lamp && y->surface->black) || !(distance2 > 0)) return black;
    d = metro_scale(d, 1 / sqrt(distance2));
    cos_z = metro_dot(z->normal, d);
    cos_y = -metro_dot(y->normal, d);
    if (!(cos_z > 0) || !(cos_y > 0)) return black;
    at_z = metroi_vertex_scatter(tracer, z, d);
    at_y = metroi_vertex_scatter(tracer, y, metro_scale(d, -1));
    color = metroi_multiply(metroi_multiply(z->weight, at_z.value), metroi_multiply(y->weight, at_y.value));
    if (metroi_color_black(color) || !metroi_join_open(tracer, sample, y, z)) return black;
    if (tracer->from_lamp) others = metroi_ways(tracer, z, at_y.density * cos_z / distance2, at_z.reverse);
    others += metroi_ways(tracer, y, at_z.density * cos_y / distance2, at_y.reverse);
    return metro_scale(color, cos_y * cos_z / distance2 * metroi_heuristic(tracer, others)); /* eq 12.7 */
}

/* The end y of a walk from a lamp, joined to the eye. The response of the camera stands in the place of f(z) cos: eq
   11.5. Returns where on the film it is seen. */

static int metroi_join_eye(const metroi_tracer *tracer, metroi_sample *sample, const metroi_vertex *y,
                           const metroi_vertex *eye, uint32_t *pixel, metro_vec3 *color)
{
    metro_vec3 d = metro_subtract(y->point, eye->point);
    double distance2 = metro_dot(d, d), cosine, response, row, column, others;
    metroi_scatter at_y;
    if ((!y->lamp && y->surface->black) || !(distance2 > 0)) return 0;
    if (!metroi_camera_project(&tracer->camera, y->point, &column, &row)) return 0;
    d = metro_scale(d, 1 / sqrt(distance2));
    cosine = -metro_dot(y->normal, d);
    if (!(cosine > 0)) return 0;
    at_y = metroi_vertex_scatter(tracer, y, metro_scale(d, -1));
    *color = metroi_multiply(y->weight, at_y.value);
    if (metroi_color_black(*color) || !metroi_join_open(tracer, sample, y, eye)) return 0;
    response = metroi_camera_density(&tracer->camera, d) * cosine / distance2;
    others = metroi_ways(tracer, y, tracer->eye_walks * response, at_y.reverse); /* eq 12.8 */
    *color = metro_scale(*color, response * metroi_heuristic(tracer, others));
    *pixel = (uint32_t)row * (uint32_t)tracer->camera.width + (uint32_t)column;
    return 1;
}

/* # 12.6 All ways of a path

   One walk from each side gives one path for each pair of their vertices. To join them all is Lafortune and Willems'
   (1993) way, the paper's; Veach and Guibas (1995) join one pair for each length, chosen at random and counted as
   often as there were choices. Where the walk from the eye aims at a lamp, s = 1, each vertex draws a point of the
   lamp for itself, unless the numbers are the state of a chain: there one point serves all.

   A walk from a lamp need not be thrown away after one use. Joined to the walks of n pixels it is as good to each of
   them as a walk of its own, and costs an n-th. Only the ways that carry it to the film itself, t = 1, are drawn n
   times less often than the others; so what they bring counts n times, and in the weights

       p_{s,1} -> p_{s,1}/n,   frac{p_{s,1}}{p_{s-1,2}} = frac{b_1}{n f_1}                       (12.8)

   which is a density of the eye's first vertex n times as high. With n = 4 the same error takes three fifths of the
   time in the Cornell box and four fifths with the hidden lamp; between mirrors, whose light on the walls only the
   ways to the film find, it takes as long as with n = 1. Pixels that share a walk err together. No pixel shows it,
   but the mean of the picture does, so its error is computed from groups of pixels that share a walk. A state of a
   chain has a walk from each side, and n = 1.

   [figure: fig3.svg | A path of two walks and the step that joins them, drawn in its scene (figure 3 of the paper).]

   [figure: pyramid.svg | What each way contributes, weighted by the power heuristic: the pictures add up to the
   picture.] */

typedef struct {
    metroi_vertex y[METRO_DEPTH_MOST + 1], z[METRO_DEPTH_MOST + 2];
    int lamp_count, eye_count;
    int chosen[METRO_DEPTH_MOST + 1]; /* the s of each length, where one connection is made */
} metroi_walks;

/* How often a join counts: not at all, once, or, when it was chosen from k + 1, k + 1 times. */
static double metroi_path_share(const metroi_tracer *tracer, const metroi_walks *walks, int s, int t)
{
    int edges = s + t - 1;
    if (edges > tracer->depth || edges < tracer->shortest) return 0;
    if (!tracer->one_connection) return 1;
    return walks->chosen[edges] == s ? edges + 1 : 0;
}

static void metroi_path_aim(const metroi_tracer *tracer, const metroi_numbers *numbers, metroi_sample *sample,
                            metroi_walks *walks, int t, uint32_t pixel)
{
    double share = metroi_path_share(tracer, walks, 1, t), u, v;
    metroi_vertex *y = &walks->y[0], fresh;
    if (!(share > 0) || walks->z[t - 1].surface->black) return;
    if (numbers->z == NULL) {
        metroi_numbers_pair(numbers, METROI_LAMP_SAMPLE, t - 1, &u, &v);
        metroi_walk_lamp(tracer, u, v, &fresh);
        y = &fresh;
    }
    metroi_sample_add(sample, tracer, pixel, 1, t,
                      metro_scale(metroi_join_edge(tracer, sample, y, &walks->z[t - 1]), share));
}

static void metroi_path_from_eye(const metroi_tracer *tracer, const metroi_numbers *numbers, metroi_sample *sample,
                                 metroi_walks *walks, uint32_t pixel)
{
    int s, t;
    for (t = 2; t <= walks->eye_count; t++) {
        const metroi_vertex *z = &walks->z[t - 1];
        double share = metroi_path_share(tracer, walks, 0, t);
        if (share > 0) metroi_sample_add(sample, tracer, pixel, 0, t, metro_scale(metroi_join_met(tracer, z), share));
        metroi_path_aim(tracer, numbers, sample, walks, t, pixel);
        for (s = 2; s <= walks->lamp_count; s++) {
            share = metroi_path_share(tracer, walks, s, t);
            if (!(share > 0)) continue;
            metroi_sample_add(sample, tracer, pixel, s, t,
                              metro_scale(metroi_join_edge(tracer, sample, &walks->y[s - 1], z), share));
        }
    }
}

static void metroi_path_from_lamp(const metroi_tracer *tracer, metroi_sample *sample, const metroi_walks *walks,
                                  int serves)
{
    metro_vec3 color;
    uint32_t pixel;
    int s;
    for (s = 1; s <= walks->lamp_count; s++) {
        double share = metroi_path_share(tracer, walks, s, 1) * serves;
        if (share > 0 && metroi_join_eye(tracer, sample, &walks->y[s - 1], &walks->z[0], &pixel, &color))
            metroi_sample_add(sample, tracer, pixel, s, 1, metro_scale(color, share));
    }
}

/* All that the walks through the film position (x, y) contribute to the picture: one sample of eq 12.1. The walk from
   a lamp is made for as many such samples as `serves` says, and for 0 it is that of the call before. */

static void metroi_trace(const metroi_tracer *tracer, const metroi_numbers *numbers, double x, double y, int serves,
                         metroi_walks *walks, metroi_sample *sample)
{
    uint32_t pixel = (uint32_t)y * (uint32_t)tracer->camera.width + (uint32_t)x;
    int k, depth = tracer->depth;
    sample->count = 0;
    sample->rays = 0;
    for (k = 1; tracer->one_connection && k <= depth; k++)
        walks->chosen[k] = (int)metro_rng_below(numbers->rng, (uint64_t)k + 1);
    if (!tracer->from_lamp) walks->lamp_count = 0;
    else if (serves > 0) walks->lamp_count = metroi_walk_from_lamp(tracer, numbers, sample, walks->y, depth);
    if (tracer->from_eye) {
        walks->eye_count = metroi_walk_from_eye(tracer, numbers, sample, x, y, walks->z, depth + 1);
        metroi_path_from_eye(tracer, numbers, sample, walks, pixel);
    } else metroi_walk_eye(tracer, &walks->z[0]);
    if (serves > 0) metroi_path_from_lamp(tracer, sample, walks, serves);
}

/* # 12.7 A picture that grows

   Jobs write what they found into logs, and the logs are added up in the order of jobs (section 1.3), so that the
   picture is the same on any number of threads. A log has room for all that its job can find. */

typedef struct {
    float color[3];
    uint32_t pixel;
    uint16_t s, t;
} metroi_log_entry;

typedef struct {
    uint64_t samples, groups, rays, not_finite;
    double luminance, luminance2;  /* of all that a group of samples contributes: the sums of it and of its square */
    size_t count;
} metroi_log;

static size_t metroi_log_size(size_t entries)
{
    return (sizeof(metroi_log) + entries * sizeof(metroi_log_entry) + 15) / 16 * 16;
}

/* Returns the luminance that is added: 0 for what is not finite, or not as a float. */
static double metroi_log_add(metroi_log *log, const metroi_splat *splat, double weight)
{
    metroi_log_entry *entry = METROI_BEHIND(metroi_log_entry, log) + log->count;
    metro_vec3 color = metro_scale(splat->color, weight);
    entry->color[0] = metroi_float(color.x);
    entry->color[1] = metroi_float(color.y);
    entry->color[2] = metroi_float(color.z);
    if (!isfinite(entry->color[0]) || !isfinite(entry->color[1]) || !isfinite(entry->color[2])) {
        log->not_finite++;
        return 0;
    }
    entry->pixel = splat->pixel;
    entry->s = splat->s;
    entry->t = splat->t;
    log->count++;
    return metroi_color_luminance(color);
}

/* A canvas holds sums: of the picture, of each way if asked for, and of the luminance of each block of 8 x 8 pixels
   in batches - the chains of a Metropolis method, or runs of rounds - whose spread gives the errors of the blocks. */

typedef struct {
    size_t width, height, columns, rows, batches;
    uint64_t batch_rounds; /* without chains */
    double *sum;     /* [3 * width * height] */
    double *way;     /* [ways * 3 * width * height] or NULL */
    double *block;   /* [batches * columns * rows] */
    int depth;
    uint64_t samples, groups, rays, not_finite;
    double luminance, luminance2;
} metroi_canvas;

static size_t metroi_way_index(int depth, int s, int t)
{
    return (size_t)s * (size_t)(depth + 2) + (size_t)t;
}

static void *metroi_zeros(size_t count, size_t size)
{
    void *memory;
    if (!metroi_size_multiply(count, size, &size) || size == 0) return NULL;
    memory = METRO_MALLOC(size);
    if (memory != NULL) memset(memory, 0, size);
    return memory;
}

static void metroi_canvas_free(metroi_canvas *canvas)
{
    METRO_FREE(canvas->sum);
    METRO_FREE(canvas->way);
    METRO_FREE(canvas->block);
    memset(canvas, 0, sizeof *canvas);
}

static metro_result metroi_canvas_make(size_t width, size_t height, size_t batches, int depth, int ways,
                                       metroi_canvas *canvas)
{
    size_t pixels = width * height, count = 1, most = metroi_way_index(depth, depth + 1, 0);
    memset(canvas, 0, sizeof *canvas);
    canvas->width = width;
    canvas->height = height;
    canvas->columns = (width + 7) / 8;
    canvas->rows = (height + 7) / 8;
    canvas->batches = batches;
    canvas->batch_rounds = 1;
    canvas->depth = depth;
    canvas->sum = (double *)metroi_zeros(pixels, 3 * sizeof(double));
    canvas->block = (double *)metroi_zeros(batches, canvas->columns * canvas->rows * sizeof(double));
    if (ways && !metroi_size_multiply(pixels, most, &count)) return METRO_ERROR_MEMORY;
    if (ways) canvas->way = (double *)metroi_zeros(count, 3 * sizeof(double));
    if (canvas->sum != NULL && canvas->block != NULL && (!ways || canvas->way != NULL)) return METRO_OK;
    metroi_canvas_free(canvas);
    return METRO_ERROR_MEMORY;
}

/* The relative error of the luminance of all that was added, from the spread over the groups of samples. */
static double metroi_canvas_error(const metroi_canvas *canvas)
{
    double n = (double)canvas->groups, mean = canvas->luminance / n, variance = canvas->luminance2 / n - mean * mean;
    return sqrt((variance < 0 ? 0 : variance) / (n - 1)) / mean; /* rounding may leave less than 0 */
}

static void metroi_canvas_add(metroi_canvas *canvas, const metroi_log *log, size_t batch)
{
    size_t i, c, pixels = canvas->width * canvas->height;
    double *block = canvas->block + batch * canvas->columns * canvas->rows;
    for (i = 0; i < log->count; i++) {
        const metroi_log_entry *entry = METROI_BEHIND(const metroi_log_entry, log) + i;
        size_t x = entry->pixel % canvas->width, y = entry->pixel / canvas->width;
        for (c = 0; c < 3; c++) canvas->sum[3 * entry->pixel + c] += (double)entry->color[c];
        block[y / 8 * canvas->columns + x / 8] += metro_luminance((double)entry->color[0], (double)entry->color[1],
                                                                  (double)entry->color[2]);
        if (canvas->way != NULL) {
            size_t index = metroi_way_index(canvas->depth, entry->s, entry->t);
            double *way = canvas->way + 3 * (index * pixels + entry->pixel);
            for (c = 0; c < 3; c++) way[c] += (double)entry->color[c];
        }
    }
    canvas->samples += log->samples;
    canvas->groups += log->groups;
    canvas->rays += log->rays;
    canvas->not_finite += log->not_finite;
    canvas->luminance += log->luminance;
    canvas->luminance2 += log->luminance2;
}

/* # 12.8 Rounds of paths

   A round traces one path through each pixel. Its jobs take 256 pixels each, in groups of sixteen, so that the logs
   stay small whatever the size of the picture. */

enum { METROI_JOB_PIXELS = 256, METROI_ROUND_JOBS = 16, METROI_PATH_BATCHES = 32, METROI_EVEN_PAIRS = 9,
       METROI_EYE_WALKS = 4 };

typedef struct {
    metroi_tracer tracer;
    metroi_canvas *canvas;
    uint64_t key;          /* of the streams and scrambles */
    unsigned even_pairs;
    size_t threads;
    size_t jobs;           /* in a round, rounded up to whole groups */
    size_t log_size;       /* in bytes; a sample stands behind the log in a slot, so that no job lacks memory */
    /* called with each log before it is added; may be NULL */
    void (*look)(const metroi_log *log, void *user);
    void *user;
} metroi_path_plan;

static size_t metroi_path_jobs(size_t pixels)
{
    size_t jobs = (pixels + METROI_JOB_PIXELS - 1) / METROI_JOB_PIXELS;
    return (jobs + METROI_ROUND_JOBS - 1) / METROI_ROUND_JOBS * METROI_ROUND_JOBS;
}

static void metroi_path_pixel(const metroi_path_plan *plan, metro_rng *rng, size_t pixel, uint64_t round, int serves,
                              metroi_walks *walks, metroi_sample *sample)
{
    metroi_numbers numbers;
    double u, v, x = (double)(pixel % plan->canvas->width), y = (double)(pixel / plan->canvas->width);
    numbers.rng = rng;
    numbers.z = NULL;
    numbers.scramble = metroi_mix(plan->key + pixel * UINT64_C(0x9e3779b97f4a7c15));
    numbers.index = (uint32_t)round;
    numbers.even_pairs = plan->even_pairs;
    metroi_numbers_pair(&numbers, METROI_FILM, 0, &u, &v);
    metroi_trace(&plan->tracer, &numbers, x + u, y + v, serves, walks, sample);
}

/* The pixels that a walk from a lamp serves are a group. Its members are far from each other, so that no eye sees
   what they have in common: one from each n-th of the job, and not at the same place in each, since the picture may
   be as wide as that. Pixels that are left over make groups of one. */

static size_t metroi_group_pixel(size_t pixels, size_t members, size_t group, size_t k)
{
    size_t groups = pixels / members;
    return group < groups ? k * groups + (group + 37 * k) % groups : members * groups + (group - groups);
}

static metro_result metroi_path_work(uint64_t job, void *slot, void *user)
{
    const metroi_path_plan *plan = (const metroi_path_plan *)user;
    metroi_log *log = (metroi_log *)slot;
    size_t all = plan->canvas->width * plan->canvas->height, first = (size_t)(job % plan->jobs) * METROI_JOB_PIXELS;
    size_t left = first < all ? all - first : 0, pixels = left < METROI_JOB_PIXELS ? left : (size_t)METROI_JOB_PIXELS;
    size_t members = (size_t)plan->tracer.eye_walks, groups = pixels / members, group, k, i;
    metro_rng rng = metro_rng_make(plan->key, job);
    metroi_sample *sample = (metroi_sample *)((unsigned char *)slot + plan->log_size);
    metroi_walks walks;
    for (group = 0; group < groups + pixels % members; group++) {
        size_t serves = group < groups ? members : 1;
        double luminance = 0;
        for (k = 0; k < serves; k++) {
            size_t pixel = first + metroi_group_pixel(pixels, members, group, k);
            metroi_path_pixel(plan, &rng, pixel, job / plan->jobs, k == 0 ? (int)serves : 0, &walks, sample);
            for (i = 0; i < sample->count; i++)
                luminance += metroi_log_add(log, METROI_BEHIND(metroi_splat, sample) + i, 1);
            log->samples++;
            log->rays += sample->rays;
        }
        log->groups++;
        log->luminance += luminance;
        log->luminance2 += luminance * luminance;
    }
    return METRO_OK;
}

static metro_result metroi_path_merge(uint64_t job, const void *slot, void *user)
{
    const metroi_path_plan *plan = (const metroi_path_plan *)user;
    const metroi_log *log = (const metroi_log *)slot;
    if (plan->look != NULL) plan->look(log, plan->user);
    metroi_canvas_add(plan->canvas, log, (size_t)(job / plan->jobs / plan->canvas->batch_rounds));
    return METRO_OK;
}

/* Each batch is a run of $2^k$ rounds, in which even points are as even as so many can be. Rounds from here and there
   would lie like random numbers, and their spread not show what evenness gains. When all batches are full,
   neighbours become one. */

static void metroi_canvas_join_batches(metroi_canvas *canvas)
{
    size_t blocks = canvas->columns * canvas->rows, half = canvas->batches / 2, b, i;
    for (b = 0; b < half; b++) {
        const double *first = canvas->block + 2 * b * blocks;
        for (i = 0; i < blocks; i++) canvas->block[b * blocks + i] = first[i] + first[blocks + i];
    }
    memset(canvas->block + half * blocks, 0, half * blocks * sizeof(double));
    canvas->batch_rounds *= 2;
}

/* Round number `round`. */
static metro_result metroi_path_round(metroi_path_plan *plan, uint64_t round)
{
    metro_rounds rounds;
    if (round / plan->canvas->batch_rounds == plan->canvas->batches) metroi_canvas_join_batches(plan->canvas);
    memset(&rounds, 0, sizeof rounds);
    plan->jobs = metroi_path_jobs(plan->canvas->width * plan->canvas->height);
    rounds.jobs = METROI_ROUND_JOBS;
    rounds.rounds = plan->jobs / METROI_ROUND_JOBS;
    rounds.first_round = round * rounds.rounds;
    plan->log_size = metroi_log_size(METROI_JOB_PIXELS * metroi_sample_room(&plan->tracer));
    rounds.slot_size = plan->log_size + metroi_sample_size(&plan->tracer);
    rounds.threads = plan->threads;
    rounds.work = metroi_path_work;
    rounds.merge = metroi_path_merge;
    return metro_rounds_run(&rounds, plan);
}

/* # 13 Metropolis light

   The paths of chapter 12 become states of the chain of chapter 4. The integrand is the picture, a vector with three
   numbers for each pixel; a path contributes to one pixel, or, when several of its ways reach the film, to a few. The
   importance of a path is one number, as a rule the luminance of all that it contributes, and then (eq 4.1) each
   sample adds b f/I to the picture: of luminance b, wherever it falls. What a chain does not know is b; and, like any
   chain, it remembers its start. */

/* # 13.1 The paper's state

   A state is a position on the film, a point on a lamp, and the directions of both walks: points of the unit square,
   of the unit square and of the sphere, in the frame of the world. Each is measured so that its total is 1, a
   direction by d omega/(4 pi). With K edges at most there are K - 1 directions for the walk from the eye and K - 1
   for the walk from the lamp; a path that ends early, at a surface that reflects nothing or because a direction
   points into a surface, does not use the rest, and they stay in the state for the next one.

   The integrand joins all points of both walks. For the weights of section 12.3 only the densities matter, and here
   all directions but the first from the eye, which is that of the film position, are drawn with the density 1/(4 pi),
   whatever the surface: each step of eq 12.2 multiplies alpha by

       alpha_{i+1} = alpha_i 4 pi f cos(theta)                                        (13.1)

   and the densities of eq 12.4 become cos(theta)/(4 pi d^2) from both sides. That is all; a uniform state then has
   the mean importance b, which the tests check. A chain that starts well finds for itself what a walk of chapter 12
   knows beforehand: that directions below a surface are useless, and those towards the light are not.

   The mutation is an angular perturbation: a uniform direction of a cone about the old one, of all directions at once
   or of one of them. The paper's size is the apex angle, the full angle of the cone. The position on the film moves
   by up to half the apex angle as well, as seen from the eye, on average over the film; the point of the lamp, which
   has no angle, moves by the same share of its square as the cone has of a straight angle. Film and lamp are
   intervals with reflecting ends.

   The geometry of the paper's scenes was not published. The Cornell box stands in for its homogeneous scene, and a
   room whose lamp shines from behind a door for the one with difficult lighting. Where a whole lamp is in the picture
   every state can be joined to it, so no state is dark and most mutations are accepted, whatever the walks do:
   studies of the bias leave out paths of one edge.

   [figure: fig4.svg | The error against samples per pixel for apex angles from .05 to .6 rad, and the reference
   picture (figure 4 of the paper).]

   [figure: fig5.svg | Pictures after 20, 80 and 320 samples per pixel with apex angles of .05, .15 and .45 rad
   (figure 5 of the paper).]

   [figure: bias.svg | How much of the error is start-up bias: squared bias and variance over independent repeats, for
   three angles and all policies.]

   [figure: decay.svg | How fast a chain of directions forgets: predicted by the spectrum of the cone, and measured.]

   The importance need not be the luminance. A blue path of the same radiance as a green one has a tenth of its
   luminance, is sampled as much less often, and is noisier; the largest channel treats them alike.

   [figure: colours.svg | The error of each colour when importance is the luminance, and when it is the largest
   channel.] */

enum { METROI_LARGEST_CHAINS = 4096, METROI_TRACE_DRAWS = 64, METROI_TRACE_BLOCKS = 17, METROI_PILOT_ROUNDS = 2 };

typedef struct {
    int s, t;
    double until; /* running sum of the probabilities, the last one 1 */
    double share; /* the probability */
} metroi_way;

typedef struct metroi_walker metroi_walker;

/* What all chains of a render share. */
typedef struct {
    metroi_tracer tracer;
    metroi_canvas *canvas;
    const metro_render_options *options;
    metro_axis *axis;
    size_t axis_count;
    metroi_way *way;         /* [way_count]: the ways of a state that makes one, else NULL */
    size_t way_count;
    double *pilot;           /* [pixels]: the luminance of a blurred pilot picture over its mean, or NULL */
    double pilot_mean, pilot_error;
    metroi_walker *walker;   /* [options->chains] */
    size_t alive;            /* chains that found a start */
    size_t group_steps, groups; /* a round is `groups` times `group_steps` steps of each chain */
    double *trace;           /* [chains * METROI_TRACE_BLOCKS * METROI_TRACE_DRAWS]: luminance of blocks over time */
    double *draws;           /* [chains * METROI_TRACE_DRAWS]: one block of it */
    size_t trace_count, trace_fill, trace_span;
    double steps;            /* of each chain so far */
    uint64_t key;
} metroi_metropolis;

/* One chain, and where it writes. */
struct metroi_walker {
    metroi_metropolis *plan;
    metro_chain chain;
    metroi_log *log;           /* of the job at work */
    double scale;              /* what its samples count: Veach's weight, or 1 */
    double luminance;          /* of the last state that was looked at */
    int independent;           /* states looked at are independent draws */
    metro_moments brightness;  /* of the luminance of independent draws */
    uint64_t rays;
    int alive;
};

static double metroi_film(double z, double size)
{
    double x = z * size;
    return x < size ? x : nextafter(size, 0);
}

/* The importance of a sample, and its luminance on the way. */

static double metroi_sample_importance(metroi_walker *walker, metroi_sample *sample)
{
    const metroi_metropolis *plan = walker->plan;
    double importance = 0;
    size_t i;
    walker->luminance = 0;
    for (i = 0; i < sample->count; i++) {
        const metroi_splat *splat = METROI_BEHIND(metroi_splat, sample) + i;
        metro_vec3 color = splat->color;
        double luminance = metroi_color_luminance(color), value = luminance;
        if (plan->options->largest_channel) value = metroi_largest_component(color);
        if (plan->pilot != NULL) value /= plan->pilot[splat->pixel]; /* eq 13.3 */
        walker->luminance += luminance;
        importance += value;
    }
    walker->rays += sample->rays;
    if (!isfinite(importance)) walker->luminance = 0; /* the chain counts it as dark */
    if (walker->independent) metro_moments_add(&walker->brightness, walker->luminance);
    sample->importance = importance;
    return importance;
}

static void metroi_sample_record(const void *kept, double weight, void *user)
{
    metroi_walker *walker = (metroi_walker *)user;
    const metroi_sample *sample = (const metroi_sample *)kept;
    size_t i;
    weight *= walker->scale / sample->importance; /* eq 4.1 */
    for (i = 0; walker->log != NULL && i < sample->count; i++)
        metroi_log_add(walker->log, METROI_BEHIND(const metroi_splat, sample) + i, weight);
}

/* All ways of the walks that a state describes. */

static double metroi_all_importance(const double *z, void *sample, void *user)
{
    metroi_walker *walker = (metroi_walker *)user;
    const metroi_tracer *tracer = &walker->plan->tracer;
    metroi_numbers numbers;
    metroi_walks walks;
    memset(&numbers, 0, sizeof numbers);
    numbers.z = z;
    metroi_trace(tracer, &numbers, metroi_film(z[0], tracer->camera.width), metroi_film(z[1], tracer->camera.height),
                 1, &walks, (metroi_sample *)sample);
    return metroi_sample_importance(walker, (metroi_sample *)sample);
}

static metro_axis metroi_axis_make(metro_axis_kind kind, metro_shape shape, double size, double size_min)
{
    metro_axis axis;
    memset(&axis, 0, sizeof axis);
    axis.kind = kind;
    axis.kernel.shape = shape;
    axis.kernel.size = size;
    axis.kernel.size_min = size_min;
    return axis;
}

static metro_result metroi_angular_axes(metroi_metropolis *plan, double apex, double fov)
{
    int depth = plan->tracer.depth;
    double aspect = plan->tracer.camera.width / plan->tracer.camera.height;
    double across = 2 * atan(tan(fov / 2) * aspect), along = fov;
    size_t i;
    plan->axis_count = 4 + 2 * (size_t)(depth - 1);
    plan->axis = (metro_axis *)metroi_zeros(plan->axis_count, sizeof *plan->axis);
    if (plan->axis == NULL) return METRO_ERROR_MEMORY;
    plan->axis[0] = metroi_axis_make(METRO_INTERVAL, METRO_UNIFORM, apex / across, 0);
    plan->axis[1] = metroi_axis_make(METRO_INTERVAL, METRO_UNIFORM, apex / along, 0);
    plan->axis[2] = plan->axis[3] = metroi_axis_make(METRO_INTERVAL, METRO_UNIFORM, apex / METROI_PI, 0);
    for (i = 4; i < plan->axis_count; i++)
        plan->axis[i] = metroi_axis_make(METRO_DIRECTION, METRO_UNIFORM, apex / 2, 0);
    return METRO_OK;
}

/* One of the directions, the point of the lamp or the position on the film is perturbed, and the rest stay. Each is
   as likely chosen on the way back, so the ratio of eq 4.2 is 1. */

static double metroi_propose_one(const double *from, double *to, metro_rng *rng, void *user)
{
    const metroi_walker *walker = (const metroi_walker *)user;
    const metro_axis *axis = walker->plan->axis;
    size_t places = walker->plan->axis_count - 2, place = (size_t)metro_rng_below(rng, places), i;
    memcpy(to, from, metroi_state_doubles(&walker->chain.target) * sizeof *to);
    if (place >= 2) {
        i = 4 + 3 * (place - 2);
        metroi_direction_perturb(&axis[place + 2].kernel, from + i, to + i, rng);
        return 1;
    }
    for (i = 2 * place; i < 2 * place + 2; i++) to[i] = metro_kernel_reflect_perturb(&axis[i].kernel, from[i], rng);
    return 1;
}

/* # 13.2 Primary sample space

   Kelemen et al. (2002) let the chain walk not among directions but among the numbers from which chapter 12 makes
   them. Numbers that are uniform give directions that suit the surfaces, so the importance is f/p, flatter than f,
   and any state makes sense. A small step moves each number on its circle by a few hundredths at most, most often by
   much less: METRO_KELEMEN. A large step draws all numbers afresh, and is the independent sampling of chapter 12.

   A state can make all ways of a path, or only one (Hachisuka, Kaplanyan and Dachsbacher 2014). One more number then
   chooses the way (s, t), with the probability $q_{s,t}$, and what that way contributes counts

       f = frac{w_s f_{s,t}}{q_{s,t} p_{s,t}}                                         (13.2)

   times. Such a state costs a fraction of the rays, and no sample is spoilt by dark ways beside the bright one. A
   small step keeps the way and moves only the numbers that it uses; the way, and with it the number of edges, changes
   with a large step, so a few chains reach all lengths as well as many. */

static metro_result metroi_primary_axes(metroi_metropolis *plan, double step)
{
    size_t i, numbers = 4 * (size_t)plan->tracer.depth;
    plan->axis_count = plan->way != NULL ? numbers + 1 : numbers;
    plan->axis = (metro_axis *)metroi_zeros(plan->axis_count, sizeof *plan->axis);
    if (plan->axis == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < plan->axis_count; i++)
        plan->axis[i] = metroi_axis_make(METRO_CIRCLE, METRO_KELEMEN, step, step / 64);
    return METRO_OK;
}

static const metroi_way *metroi_way_choose(const metroi_metropolis *plan, double z)
{
    size_t low = 0, high = plan->way_count - 1;
    while (low < high) {
        size_t middle = low + (high - low) / 2;
        if (plan->way[middle].until > z) high = middle;
        else low = middle + 1;
    }
    return &plan->way[low];
}

/* The one way (s, t) of the path that the numbers describe. */

static void metroi_trace_way(const metroi_tracer *tracer, const metroi_numbers *numbers, double x, double y, int s,
                             int t, metroi_sample *sample)
{
    metroi_walks walks;
    uint32_t pixel = (uint32_t)y * (uint32_t)tracer->camera.width + (uint32_t)x;
    metro_vec3 color;
    sample->count = 0;
    sample->rays = 0;
    if (metroi_walk_from_lamp(tracer, numbers, sample, walks.y, s) < s) return;
    if (metroi_walk_from_eye(tracer, numbers, sample, x, y, walks.z, t) < t) return;
    if (t == 1) {
        if (!metroi_join_eye(tracer, sample, &walks.y[s - 1], &walks.z[0], &pixel, &color)) return;
    } else if (s == 0) color = metroi_join_met(tracer, &walks.z[t - 1]);
    else color = metroi_join_edge(tracer, sample, &walks.y[s - 1], &walks.z[t - 1]);
    metroi_sample_add(sample, tracer, pixel, s, t, color);
}

static double metroi_way_importance(const double *z, void *kept, void *user)
{
    metroi_walker *walker = (metroi_walker *)user;
    const metroi_tracer *tracer = &walker->plan->tracer;
    const metroi_way *way = metroi_way_choose(walker->plan, z[0]);
    metroi_sample *sample = (metroi_sample *)kept;
    metroi_splat *splat = METROI_BEHIND(metroi_splat, sample);
    metroi_numbers numbers;
    memset(&numbers, 0, sizeof numbers);
    numbers.z = z + 1;
    metroi_trace_way(tracer, &numbers, metroi_film(z[1], tracer->camera.width),
                     metroi_film(z[2], tracer->camera.height), way->s, way->t, sample);
    if (sample->count > 0) splat->color = metro_scale(splat->color, 1 / way->share); /* eq 13.2 */
    return metroi_sample_importance(walker, sample);
}

/* Is the pair at `place` one that the way uses? Film, lamp and direction of the lamp come first, then the bounces of
   the eye at odd places and those of the lamp at even ones. */

static int metroi_way_uses(const metroi_way *way, size_t place)
{
    int bounce;
    if (place == 0) return way->t >= 2;
    if (place <= 2) return way->s >= (int)place;
    bounce = (int)((place - 1) / 2);
    return place % 2 == 1 ? bounce <= way->t - 2 : bounce <= way->s - 2;
}

static double metroi_propose_way(const double *from, double *to, metro_rng *rng, void *user)
{
    const metroi_walker *walker = (const metroi_walker *)user;
    const metroi_metropolis *plan = walker->plan;
    const metroi_way *way = metroi_way_choose(plan, from[0]);
    size_t i;
    to[0] = from[0];
    for (i = 1; i < plan->axis_count; i++)
        if (metroi_way_uses(way, (i - 1) / 2)) to[i] = metro_kernel_perturb(&plan->axis[i].kernel, from[i], rng);
        else to[i] = from[i];
    return 1;
}

METROI_COLD

/* # 13.3 A pilot picture

   A chain whose importance is the luminance spends its samples where the picture is bright, and the eye asks for the
   same relative error everywhere. So we first trace a picture in two rounds by the methods of chapter 12, blur it,
   and divide the importance by it (Veach 1997, chapter 11, calls this two stages): with the pilot's luminance $P_j$
   in pixel j, relative to its mean and not less than a tenth of it,

       I = sum_{j} frac{Y_j}{P_j}                                                     (13.3)

   Any P leaves the picture right, because eq 4.1 divides by I again; a good one makes it evenly noisy. The pilot
   serves two more ends: its ways show which $q_{s,t}$ of eq 13.2 pay, and its mean is an estimate of the mean
   luminance. */

static void metroi_blur_line(const double *from, double *to, size_t count, size_t stride)
{
    enum { RADIUS = 4 };
    size_t i, j;
    for (i = 0; i < count; i++) {
        size_t low = i > RADIUS ? i - RADIUS : 0, high = i + RADIUS < count ? i + RADIUS : count - 1;
        double sum = 0;
        for (j = low; j <= high; j++) sum += from[j * stride];
        to[i * stride] = sum / (double)(high - low + 1);
    }
}

/* Turns the canvas of the pilot into plan->pilot. */

static metro_result metroi_pilot_picture(metroi_metropolis *plan, const metroi_canvas *canvas)
{
    size_t pixels = canvas->width * canvas->height, i;
    double *line = (double *)metroi_zeros(pixels, sizeof *line), mean = 0;
    plan->pilot = (double *)metroi_zeros(pixels, sizeof *plan->pilot);
    if (line == NULL || plan->pilot == NULL) {
        METRO_FREE(line);
        return METRO_ERROR_MEMORY;
    }
    for (i = 0; i < pixels; i++) {
        const double *c = canvas->sum + 3 * i;
        plan->pilot[i] = metro_luminance(c[0], c[1], c[2]);
        mean += plan->pilot[i] / (double)pixels;
    }
    for (i = 0; i < canvas->height; i++)
        metroi_blur_line(plan->pilot + i * canvas->width, line + i * canvas->width, canvas->width, 1);
    for (i = 0; i < canvas->width; i++) metroi_blur_line(line + i, plan->pilot + i, canvas->height, canvas->width);
    for (i = 0; i < pixels; i++) {
        plan->pilot[i] = mean > 0 ? plan->pilot[i] / mean : 1;
        if (plan->pilot[i] < 0.1) plan->pilot[i] = 0.1;
    }
    METRO_FREE(line);
    return METRO_OK;
}

typedef struct {
    metroi_metropolis *plan;
    double *share; /* by metroi_way_index */
} metroi_pilot_ways;

static void metroi_pilot_look(const metroi_log *log, void *user)
{
    metroi_pilot_ways *pilot = (metroi_pilot_ways *)user;
    size_t i;
    for (i = 0; i < log->count; i++) {
        const metroi_log_entry *entry = METROI_BEHIND(const metroi_log_entry, log) + i;
        double value = metro_luminance((double)entry->color[0], (double)entry->color[1], (double)entry->color[2]);
        pilot->share[metroi_way_index(pilot->plan->tracer.depth, entry->s, entry->t)] += value;
    }
}

/* The probabilities of the ways: four fifths in proportion to what the pilot saw of each, and a fifth in equal parts,
   so that a way the pilot missed is found all the same. */

static void metroi_ways_choose(metroi_metropolis *plan, const double *share)
{
    int depth = plan->tracer.depth, k, s;
    double sum = 0, until = 0;
    size_t count = 0, i;
    for (k = plan->tracer.shortest; k <= depth; k++)
        for (s = 0; s <= k; s++) {
            plan->way[count].s = s;
            plan->way[count].t = k + 1 - s;
            plan->way[count].share = share[metroi_way_index(depth, s, k + 1 - s)];
            sum += plan->way[count++].share;
        }
    plan->way_count = count;
    for (i = 0; i < count; i++) {
        plan->way[i].share = (sum > 0 ? 0.8 * plan->way[i].share / sum : 0) + (sum > 0 ? 0.2 : 1) / (double)count;
        until += plan->way[i].share;
        plan->way[i].until = until;
    }
    plan->way[count - 1].until = 1;
}

static metro_result metroi_pilot_rounds(metroi_metropolis *plan, metroi_path_plan *paths, metroi_canvas *canvas)
{
    const metro_render_options *options = plan->options;
    metro_result result = METRO_OK;
    metroi_pilot_ways pilot;
    int round, depth = plan->tracer.depth;
    pilot.plan = plan;
    pilot.share = (double *)metroi_zeros(metroi_way_index(depth, depth + 1, 0), sizeof(double));
    if (pilot.share == NULL) return METRO_ERROR_MEMORY;
    paths->look = metroi_pilot_look;
    paths->user = &pilot;
    for (round = 0; result == METRO_OK && round < METROI_PILOT_ROUNDS; round++)
        result = metroi_path_round(paths, (uint64_t)round);
    plan->pilot_mean = canvas->luminance / (double)canvas->samples;
    plan->pilot_error = metroi_canvas_error(canvas) * plan->pilot_mean;
    if (canvas->not_finite > 0) plan->pilot_error = 0; /* it left out what the chains do not: it says nothing */
    if (result == METRO_OK && plan->way != NULL) metroi_ways_choose(plan, pilot.share);
    if (result == METRO_OK && !options->one_stage) result = metroi_pilot_picture(plan, canvas);
    METRO_FREE(pilot.share);
    return result;
}

static metro_result metroi_pilot_run(metroi_metropolis *plan)
{
    metroi_canvas canvas;
    metroi_path_plan paths;
    size_t ways = (size_t)(plan->tracer.depth + 1) * (size_t)(plan->tracer.depth + 2) / 2;
    size_t width = plan->canvas->width, height = plan->canvas->height;
    metro_result result = metroi_canvas_make(width, height, 1, plan->tracer.depth, 0, &canvas);
    if (result != METRO_OK) return result;
    if (!plan->options->all_connections) plan->way = (metroi_way *)metroi_zeros(ways, sizeof *plan->way);
    memset(&paths, 0, sizeof paths);
    paths.tracer = plan->tracer;
    paths.tracer.separate = 1;
    paths.canvas = &canvas;
    paths.key = metroi_mix(plan->key + 1);
    paths.even_pairs = METROI_EVEN_PAIRS;
    paths.threads = plan->options->threads;
    result = METRO_ERROR_MEMORY;
    if (plan->options->all_connections || plan->way != NULL) result = metroi_pilot_rounds(plan, &paths, &canvas);
    metroi_canvas_free(&canvas);
    return result;
}

METROI_WARM

/* # 13.4 Chains in rounds

   Each chain is a job (section 1.3), and goes on where its last job ended. A round makes on average one mutation a
   pixel; it is cut into groups, so that a log stays small. */

/* A start from one point takes the first state, drawn with random numbers of its own, that is not dark. */

static metro_result metroi_start_point(metro_chain *chain, double *z, uint64_t seed, uint64_t index,
                                       size_t candidates)
{
    metro_rng rng = metro_rng_make(seed, index);
    metro_result result = METRO_ERROR_DARK_SEED;
    size_t tries;
    for (tries = 0; result != METRO_OK && tries / 64 < candidates; tries++) {
        metroi_state_draw(&chain->target, z, &rng);
        result = metro_chain_start_point(chain, z); /* refuses a dark state, and one that is not finite */
    }
    return result == METRO_OK ? METRO_OK : METRO_ERROR_NO_IMPORTANCE;
}

static metro_result metroi_walker_start_point(metroi_walker *walker, uint64_t index)
{
    const metro_render_options *options = walker->plan->options;
    double *z = (double *)METRO_MALLOC(metroi_state_doubles(&walker->chain.target) * sizeof *z);
    metro_result result;
    if (z == NULL) return METRO_ERROR_MEMORY;
    walker->independent = 1;
    metro_chain_survey(&walker->chain, options->candidates);
    walker->independent = 0;
    result = metroi_start_point(&walker->chain, z, options->start_seed, index, options->candidates);
    METRO_FREE(z);
    return result;
}

/* A start from seeds takes up to 64 times as many candidates before it gives up. Those after the first time do not
   count for b, which would be too high if what one stops at counted. With weighted seeds a chain must not try again:
   its estimate is 0, and leaving that out would raise the mean. */

static metro_result metroi_start_again(metro_chain *chain, size_t candidates)
{
    metro_moments normalisation = chain->normalisation;
    metro_result result = METRO_ERROR_NO_IMPORTANCE;
    int tries;
    for (tries = 1; result == METRO_ERROR_NO_IMPORTANCE && tries < 64; tries++)
        result = metro_chain_start_weighted(chain, candidates);
    chain->normalisation = normalisation;
    return result;
}

static metro_result metroi_walker_start_seeds(metroi_walker *walker)
{
    const metro_render_options *options = walker->plan->options;
    metro_result result;
    walker->independent = 1;
    result = metro_chain_start_weighted(&walker->chain, options->candidates);
    walker->independent = 0;
    if (result == METRO_ERROR_NO_IMPORTANCE && options->start == METRO_START_SEEDS)
        result = metroi_start_again(&walker->chain, options->candidates);
    return result;
}

static metro_result metroi_start_work(uint64_t job, void *slot, void *user)
{
    metroi_metropolis *plan = (metroi_metropolis *)user;
    metroi_walker *walker = &plan->walker[job];
    const metro_render_options *options = plan->options;
    metro_chain_options chain_options;
    metro_target target;
    metro_result result;
    (void)slot;
    memset(&target, 0, sizeof target);
    target.axes = plan->axis;
    target.axis_count = plan->axis_count;
    target.sample_size = metroi_sample_size(&plan->tracer);
    target.importance = plan->way != NULL ? metroi_way_importance : metroi_all_importance;
    target.record = metroi_sample_record;
    target.propose = plan->way != NULL ? metroi_propose_way : options->one_direction ? metroi_propose_one : NULL;
    target.user = walker;
    chain_options.large_step = options->large_step;
    chain_options.expected_values = 1;
    walker->plan = plan;
    walker->scale = 1;
    result = metro_chain_make(&target, &chain_options, metro_rng_make(plan->key, job), &walker->chain);
    if (result != METRO_OK) return result;
    if (options->start == METRO_START_POINT) result = metroi_walker_start_point(walker, job);
    else result = metroi_walker_start_seeds(walker);
    walker->alive = result == METRO_OK;
    if (options->start == METRO_START_WEIGHTED) walker->scale = walker->chain.start_weight;
    return result == METRO_ERROR_NO_IMPORTANCE ? METRO_OK : result;
}

static metro_result metroi_walk_work(uint64_t job, void *slot, void *user)
{
    metroi_metropolis *plan = (metroi_metropolis *)user;
    metroi_walker *walker = &plan->walker[job % plan->options->chains];
    metro_chain *chain = &walker->chain;
    size_t i;
    if (!walker->alive) return METRO_OK;
    walker->log = (metroi_log *)slot;
    walker->rays = 0;
    for (i = 0; i < plan->group_steps; i++) {
        uint64_t large = chain->counts.large_steps;
        metro_chain_step(chain);
        if (chain->counts.large_steps > large) metro_moments_add(&walker->brightness, walker->luminance);
    }
    metro_chain_flush(chain);
    if (!(plan->options->large_step > 0)) { /* b has no other source: one draw for sixteen mutations */
        walker->independent = 1;
        metro_chain_survey(chain, (plan->group_steps + 15) / 16);
        walker->independent = 0;
    }
    walker->log->samples = plan->group_steps;
    walker->log->rays = walker->rays;
    walker->log = NULL;
    return METRO_OK;
}

/* The luminance of sixteen blocks of the picture and of the whole, chain by chain and group by group, is what R-hat
   and ESS are computed from. When 64 draws are full, neighbours are added up, and draws become twice as long. */

static void metroi_trace_add(metroi_metropolis *plan, size_t chain, const metroi_log *log)
{
    const metroi_canvas *canvas = plan->canvas;
    double *trace = plan->trace + chain * METROI_TRACE_BLOCKS * METROI_TRACE_DRAWS + plan->trace_count;
    double scale = plan->walker[chain].scale > 0 ? plan->walker[chain].scale : 1; /* weights are no disagreement */
    size_t i;
    for (i = 0; i < log->count; i++) {
        const metroi_log_entry *entry = METROI_BEHIND(const metroi_log_entry, log) + i;
        size_t x = entry->pixel % canvas->width * 4 / canvas->width;
        size_t y = entry->pixel / canvas->width * 4 / canvas->height;
        double value = metro_luminance((double)entry->color[0], (double)entry->color[1], (double)entry->color[2]);
        trace[(4 * y + x) * METROI_TRACE_DRAWS] += value / scale;
        trace[16 * METROI_TRACE_DRAWS] += value / scale;
    }
}

static void metroi_trace_next(metroi_metropolis *plan)
{
    size_t i, lines = plan->options->chains * METROI_TRACE_BLOCKS, half = METROI_TRACE_DRAWS / 2;
    if (++plan->trace_fill < plan->trace_span) return;
    plan->trace_fill = 0;
    if (++plan->trace_count < METROI_TRACE_DRAWS) return;
    for (i = 0; i < lines; i++) {
        double *draw = plan->trace + i * METROI_TRACE_DRAWS;
        size_t j;
        for (j = 0; j < half; j++) draw[j] = draw[2 * j] + draw[2 * j + 1];
        memset(draw + half, 0, half * sizeof *draw);
    }
    plan->trace_count = half;
    plan->trace_span *= 2;
}

static metro_result metroi_walk_merge(uint64_t job, const void *slot, void *user)
{
    metroi_metropolis *plan = (metroi_metropolis *)user;
    size_t chain = (size_t)(job % plan->options->chains);
    metroi_trace_add(plan, chain, (const metroi_log *)slot);
    metroi_canvas_add(plan->canvas, (const metroi_log *)slot, chain);
    if (chain + 1 == plan->options->chains) metroi_trace_next(plan);
    return METRO_OK;
}

static metro_result metroi_chains_start(metroi_metropolis *plan)
{
    metro_rounds rounds;
    metro_result result;
    size_t i;
    for (i = 0; i < plan->options->chains; i++) { /* what an earlier start that failed has left */
        metro_chain_free(&plan->walker[i].chain);
        memset(&plan->walker[i], 0, sizeof plan->walker[i]);
    }
    plan->alive = 0;
    memset(&rounds, 0, sizeof rounds);
    rounds.jobs = plan->options->chains;
    rounds.threads = plan->options->threads;
    rounds.work = metroi_start_work;
    result = metro_rounds_run(&rounds, plan);
    for (i = 0; i < plan->options->chains; i++) plan->alive += plan->walker[i].alive ? 1u : 0u;
    if (result == METRO_OK && plan->alive == 0) result = METRO_ERROR_NO_IMPORTANCE;
    return result;
}

static metro_result metroi_chains_round(metroi_metropolis *plan, uint64_t round)
{
    metro_rounds rounds;
    metro_result result;
    memset(&rounds, 0, sizeof rounds);
    rounds.jobs = plan->options->chains;
    rounds.rounds = plan->groups;
    rounds.first_round = round * rounds.rounds;
    /* A step records one state at most, and the last is flushed; one way makes one splat. */
    rounds.slot_size = metroi_log_size((plan->group_steps + 1) *
                                       (plan->way != NULL ? 1 : metroi_sample_room(&plan->tracer)));
    rounds.threads = plan->options->threads;
    rounds.work = metroi_walk_work;
    rounds.merge = metroi_walk_merge;
    result = metro_rounds_run(&rounds, plan);
    if (result == METRO_OK) plan->steps += (double)(plan->groups * plan->group_steps);
    return result;
}

static void metroi_chains_free(metroi_metropolis *plan)
{
    size_t i;
    for (i = 0; plan->walker != NULL && i < plan->options->chains; i++) metro_chain_free(&plan->walker[i].chain);
    METRO_FREE(plan->walker);
    METRO_FREE(plan->axis);
    METRO_FREE(plan->way);
    METRO_FREE(plan->pilot);
    METRO_FREE(plan->trace);
    METRO_FREE(plan->draws);
}

/* The pilot, the axes and the memory of all chains; they start with the first round. */

static metro_result metroi_chains_make(metroi_metropolis *plan, double fov)
{
    const metro_render_options *options = plan->options;
    size_t pixels = plan->canvas->width * plan->canvas->height;
    size_t steps = (pixels + options->chains - 1) / options->chains;
    metro_result result = METRO_OK;
    plan->groups = (steps + 1023) / 1024;
    plan->group_steps = (steps + plan->groups - 1) / plan->groups;
    plan->trace_span = 1;
    plan->walker = (metroi_walker *)metroi_zeros(options->chains, sizeof *plan->walker);
    plan->trace = (double *)metroi_zeros(options->chains * METROI_TRACE_BLOCKS, METROI_TRACE_DRAWS * sizeof(double));
    plan->draws = (double *)metroi_zeros(options->chains, METROI_TRACE_DRAWS * sizeof(double));
    if (plan->walker == NULL || plan->trace == NULL || plan->draws == NULL) return METRO_ERROR_MEMORY;
    if (options->method == METRO_MLT) return metroi_angular_axes(plan, options->perturbation, fov);
    if (!options->all_connections || !options->one_stage) result = metroi_pilot_run(plan);
    return result == METRO_OK ? metroi_primary_axes(plan, options->perturbation) : result;
}

METROI_COLD

/* # 13.5 How bright

   b is the mean of the importance over independent states, and there is no end of them: the candidates of the starts,
   and every large step of every chain, whose importance is known because the chain had to weigh it; without large
   steps, a draw for every sixteen mutations. So b is not frozen when the chains start; it gets better as long as they
   run, and states its error. With a pilot the mean luminance is estimated in the same way, and the pilot's own
   estimate joins in, weighted by its error. Where both are poor this lowers the mean, since a low estimate states a
   low error as well. */

static void metroi_moments_join(metro_moments *to, const metro_moments *from)
{
    double n = (double)to->count, m = (double)from->count, a, b, deviation;
    double scale = to->scale > from->scale ? to->scale : from->scale;
    if (from->count == 0) return;
    a = scale > 0 ? to->scale / scale : 1;
    b = scale > 0 ? from->scale / scale : 1;
    deviation = b * from->mean - a * to->mean;
    to->squares = a * a * to->squares + b * b * from->squares + deviation * deviation * n * m / (n + m);
    to->mean = a * to->mean + deviation * m / (n + m);
    to->count += from->count;
    to->scale = scale;
}

/* Draws that were all dark say that b is 0, and not how far from it b may be. */
static double metroi_b_error(const metro_moments *importance)
{
    return metro_moments_mean(importance) == 0 ? METROI_INFINITY : metro_moments_error(importance);
}

static void metroi_chains_moments(const metroi_metropolis *plan, metro_moments *importance, metro_moments *luminance)
{
    size_t i;
    memset(importance, 0, sizeof *importance);
    memset(luminance, 0, sizeof *luminance);
    for (i = 0; i < plan->options->chains; i++) {
        metroi_moments_join(importance, &plan->walker[i].chain.normalisation);
        metroi_moments_join(luminance, &plan->walker[i].brightness);
    }
}

/* The mean luminance of the picture: from the pilot and all independent draws. With Veach's weights (eq 4.6) it needs
   no b, and its error is the spread over the chains. */

static double metroi_canvas_luminance(const metroi_canvas *canvas, size_t batch)
{
    size_t i, blocks = canvas->columns * canvas->rows;
    metro_sum sum = { 0, 0 };
    for (i = 0; i < blocks; i++) metro_sum_add(&sum, canvas->block[batch * blocks + i]);
    return metro_sum_value(&sum);
}

static double metroi_weighted_mean(const metroi_metropolis *plan, double *error)
{
    metro_moments chains;
    size_t c;
    memset(&chains, 0, sizeof chains);
    for (c = 0; c < plan->options->chains; c++)
        metro_moments_add(&chains, metroi_canvas_luminance(plan->canvas, c) / plan->steps);
    *error = metro_moments_error(&chains);
    return metro_moments_mean(&chains);
}

static double metroi_chains_mean(const metroi_metropolis *plan, double *error)
{
    metro_moments importance, luminance;
    double mean, weight = 0;
    if (plan->options->start == METRO_START_WEIGHTED) return metroi_weighted_mean(plan, error);
    metroi_chains_moments(plan, &importance, &luminance);
    mean = metro_moments_mean(&luminance);
    *error = metro_moments_error(&luminance);
    if (plan->pilot_error > 0 && *error > 0) {
        weight = plan->pilot_error / *error;
        weight = 1 / (1 + weight * weight);
        mean += weight * (plan->pilot_mean - mean);
        *error *= sqrt(1 - weight);
    }
    return mean;
}

/* # 13.6 One call for all methods

   What a render needs is made at once; then it goes on round by round, and can be looked at after each.

   [figure: costs.svg | Error against time for all methods, on a room with a lamp in sight and one with a hidden
   lamp.] */

typedef struct {
    metroi_surface *surface;
    metroi_canvas canvas;
    metroi_path_plan paths;
    metroi_metropolis chains;
    metro_render_options options;
} metroi_render;

static int metroi_render_walks(const metro_render_options *options)
{
    return options->method == METRO_MLT || options->method == METRO_PSSMLT;
}

static metro_render_options metroi_render_defaults(const metro_render_options *given)
{
    metro_render_options options;
    memset(&options, 0, sizeof options);
    if (given != NULL) options = *given;
    if (options.width == 0) options.width = 128;
    if (options.height == 0) options.height = 128;
    if (options.depth == 0) options.depth = 8;
    if (options.shortest == 0) options.shortest = 1;
    if (options.threads == 0) options.threads = metro_core_count();
    if (options.chains == 0) options.chains = 64;
    if (options.candidates == 0) options.candidates = 1024;
    if (options.perturbation == 0) options.perturbation = options.method == METRO_MLT ? 0.3 : 0.02;
    if (options.large_step == 0 && options.method == METRO_PSSMLT) options.large_step = 0.3;
    if (options.large_step == -1) options.large_step = 0;
    return options;
}

static metro_result metroi_render_check(const metro_scene *scene, const metro_camera *camera,
                                        const metro_render_options *options)
{
    size_t pixels;
    int fits = metroi_size_multiply(options->width, options->height, &pixels) && pixels <= 0x7fffffff;
    if (options->method < METRO_BDPT || options->method > METRO_PSSMLT) return METRO_ERROR_ARGUMENT;
    if (options->heuristic < METRO_POWER || options->heuristic > METRO_UNWEIGHTED) return METRO_ERROR_ARGUMENT;
    if (options->start < METRO_START_SEEDS || options->start > METRO_START_WEIGHTED) return METRO_ERROR_ARGUMENT;
    if (scene == NULL || scene->bvh == NULL || metro_camera_check(camera) != METRO_OK) return METRO_ERROR_ARGUMENT;
    if (options->depth < 1 || options->depth > METRO_DEPTH_MOST) return METRO_ERROR_ARGUMENT;
    if (options->shortest < 1 || options->shortest > options->depth) return METRO_ERROR_ARGUMENT;
    if (!(options->large_step >= 0 && options->large_step <= 1)) return METRO_ERROR_ARGUMENT;
    if (!(options->perturbation > 1e-300 && isfinite(options->perturbation))) return METRO_ERROR_ARGUMENT;
    if (options->chains > METROI_LARGEST_CHAINS) return METRO_ERROR_ARGUMENT;
    if (!fits) return METRO_ERROR_ARGUMENT;
    return scene->light_count > 0 ? METRO_OK : METRO_ERROR_NO_LIGHT;
}

static metroi_tracer metroi_tracer_make(const metro_scene *scene, const metro_camera *camera,
                                        const metro_render_options *options, const metroi_surface *surface)
{
    metroi_tracer tracer;
    memset(&tracer, 0, sizeof tracer);
    tracer.scene = scene;
    tracer.surface = surface;
    tracer.camera = metroi_camera_make(camera, options->width, options->height);
    tracer.depth = options->depth;
    tracer.shortest = options->shortest;
    tracer.from_eye = options->method != METRO_LIGHT;
    tracer.from_lamp = options->method != METRO_PATH;
    tracer.eye_walks = options->method == METRO_BDPT ? METROI_EYE_WALKS : 1;
    tracer.uniform_directions = options->method == METRO_MLT; /* eq 13.1 */
    tracer.one_connection = options->one_connection && options->method == METRO_BDPT;
    tracer.separate = options->pyramid && options->method == METRO_BDPT;
    tracer.heuristic = options->heuristic;
    return tracer;
}

static void metroi_render_free(metroi_render *state)
{
    metroi_chains_free(&state->chains);
    metroi_canvas_free(&state->canvas);
    METRO_FREE(state->surface);
    METRO_FREE(state);
}

METRO_API void metro_render_free(metro_render *render)
{
    if (render->state != NULL) metroi_render_free((metroi_render *)render->state);
    memset(render, 0, sizeof *render);
}

static metro_result metroi_render_fill(metroi_render *state, const metro_scene *scene, const metro_camera *camera,
                                       const metro_render_options *options)
{
    size_t i, batches = metroi_render_walks(options) ? options->chains : (size_t)METROI_PATH_BATCHES;
    uint64_t key = metroi_mix(options->seed ^ metroi_mix(options->part));
    metro_result result;
    state->surface = (metroi_surface *)metroi_zeros(scene->material_count + 1, sizeof *state->surface);
    if (state->surface == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i <= scene->material_count; i++) {
        state->surface[i] = metroi_surface_make(metro_scene_material(scene, (uint32_t)i));
    }
    result = metroi_canvas_make(options->width, options->height, batches, options->depth,
                                options->pyramid && options->method == METRO_BDPT, &state->canvas);
    if (result != METRO_OK) return result;
    state->paths.tracer = state->chains.tracer = metroi_tracer_make(scene, camera, options, state->surface);
    state->paths.canvas = state->chains.canvas = &state->canvas;
    state->paths.key = state->chains.key = key;
    state->paths.even_pairs = options->random_numbers ? 0 : METROI_EVEN_PAIRS;
    state->paths.threads = options->threads;
    state->options = *options;
    state->chains.options = &state->options;
    if (!metroi_render_walks(options)) return METRO_OK;
    return metroi_chains_make(&state->chains, camera->fov * METROI_PI / 180);
}

METRO_API metro_result metro_render_make(const metro_scene *scene, const metro_camera *camera,
                                         const metro_render_options *options, metro_render *render)
{
    metro_render_options filled = metroi_render_defaults(options);
    metro_result result = metroi_render_check(scene, camera, &filled);
    metroi_render *state;
    if (result != METRO_OK) return result;
    state = (metroi_render *)metroi_zeros(1, sizeof *state);
    if (state == NULL) return METRO_ERROR_MEMORY;
    result = metroi_render_fill(state, scene, camera, &filled);
    if (result != METRO_OK) {
        metroi_render_free(state);
        return result;
    }
    memset(render, 0, sizeof *render);
    render->scene = scene;
    render->options = filled;
    render->state = state;
    return METRO_OK;
}

METRO_API metro_result metro_render_run(metro_render *render, uint64_t rounds,
                                        int (*stop)(const metro_render *render, void *user), void *user)
{
    metroi_render *state = (metroi_render *)render->state;
    uint64_t i;
    if (state == NULL) return METRO_ERROR_ARGUMENT;
    for (i = 0; i < rounds; i++) {
        metro_result result = METRO_OK;
        if (!metroi_render_walks(&render->options)) result = metroi_path_round(&state->paths, render->rounds);
        else {
            if (render->rounds == 0) result = metroi_chains_start(&state->chains);
            if (result == METRO_OK) result = metroi_chains_round(&state->chains, render->rounds);
        }
        if (result != METRO_OK) return result;
        render->rounds++;
        render->samples = state->canvas.samples;
        render->rays = state->canvas.rays;
        if (stop != NULL && stop(render, user)) return METRO_ERROR_STOPPED;
    }
    return METRO_OK;
}

/* Chains: the picture gets the mean luminance that section 13.5 found. Where the importance is the luminance, this is
   eq 4.1 with the best b known. */

static double metroi_chains_scale(const metroi_metropolis *plan)
{
    const metroi_canvas *canvas = plan->canvas;
    double pixels = (double)canvas->width * (double)canvas->height, error, total = 0;
    size_t c;
    for (c = 0; c < canvas->batches; c++) total += metroi_canvas_luminance(canvas, c);
    return total > 0 ? pixels * metroi_chains_mean(plan, &error) / total : 0;
}

/* What turns the sums of the canvas into radiance. */
static double metroi_render_scale(const metro_render *render)
{
    const metroi_render *state = (const metroi_render *)render->state;
    if (!metroi_render_walks(&render->options)) return 1 / (double)render->rounds;
    return metroi_chains_scale(&state->chains);
}

static metro_result metroi_render_picture(const metro_render *render, const double *sum, metro_image *image)
{
    size_t i, count = 3 * render->options.width * render->options.height;
    double scale = metroi_render_scale(render);
    metro_image made;
    metro_result result = metro_image_make(render->options.width, render->options.height, 3, &made);
    if (result != METRO_OK) return result;
    for (i = 0; i < count; i++) made.value[i] = sum[i] * scale;
    *image = made;
    return METRO_OK;
}

METRO_API metro_result metro_render_image(const metro_render *render, metro_image *image)
{
    const metroi_render *state = (const metroi_render *)render->state;
    if (state == NULL || render->rounds == 0) return METRO_ERROR_ARGUMENT;
    return metroi_render_picture(render, state->canvas.sum, image);
}

METRO_API metro_result metro_render_way(const metro_render *render, int s, int t, metro_image *image)
{
    const metroi_render *state = (const metroi_render *)render->state;
    size_t pixels = render->options.width * render->options.height;
    if (state == NULL || render->rounds == 0 || state->canvas.way == NULL) return METRO_ERROR_ARGUMENT;
    if (s < 0 || t < 1 || s + t < 2 || s + t > render->options.depth + 1) return METRO_ERROR_ARGUMENT;
    return metroi_render_picture(
        render, state->canvas.way + 3 * pixels * metroi_way_index(render->options.depth, s, t), image);
}

/* # 13.7 Errors that can be believed

   The chains are independent, so what they say of a block of pixels is a sample of as many numbers, and the error of
   their mean follows from their spread, whatever the correlation along each chain. For a picture that is scaled to
   its mean luminance it is the spread of the ratios that counts: with block B_c and total T_c of chain c and R = sum
   B / sum T,

       "Var"(R) ~ frac{1}{C (C - 1)} sum_{c} frac{(B_c - R T_c)^2}{m^2}, m = frac{1}{C} sum_{c} T_c         (13.4)

   The relative error of the mean luminance is common to all blocks, and adds to it. Veach's weights need no scaling,
   and the other methods have runs of rounds in place of chains (section 12.8): there B_c is compared with its share
   of the sum. Runs of even points also fit each other, which their spread does not show: the error that they state is
   too large, least with many rounds, whose runs are long. */

typedef struct {
    size_t left, right, top, bottom; /* in blocks of 8 x 8 pixels; right and bottom are outside */
} metroi_window;

static double metroi_window_sum(const metroi_canvas *canvas, const metroi_window *window, size_t batch)
{
    size_t x, y;
    double sum = 0;
    for (y = window->top; y < window->bottom; y++)
        for (x = window->left; x < window->right; x++)
            sum += canvas->block[(batch * canvas->rows + y) * canvas->columns + x];
    return sum;
}

/* What batch c should have seen of a window that all batches together saw `sum` of; NaN if it did not run. */
static double metroi_window_expect(const metro_render *render, size_t c, double sum, double total)
{
    const metroi_render *state = (const metroi_render *)render->state;
    const metroi_canvas *canvas = &state->canvas;
    if (!metroi_render_walks(&render->options)) {
        uint64_t before = c * canvas->batch_rounds, rounds = render->rounds > before ? render->rounds - before : 0;
        if (rounds > canvas->batch_rounds) rounds = canvas->batch_rounds;
        return rounds > 0 ? sum * (double)rounds / (double)render->rounds : METROI_NAN;
    }
    if (render->options.start == METRO_START_WEIGHTED) return sum / (double)canvas->batches;
    return state->chains.walker[c].alive ? sum / total * metroi_canvas_luminance(canvas, c) : METROI_NAN;
}

static double metroi_common_error(const metro_render *render)
{
    const metroi_render *state = (const metroi_render *)render->state;
    double mean, error;
    if (!metroi_render_walks(&render->options) || render->options.start == METRO_START_WEIGHTED) return 0;
    mean = metroi_chains_mean(&state->chains, &error);
    return error / mean;
}

/* The sum over the window and its relative standard error; NaN when fewer than two batches have run. */
static double metroi_window_error(const metro_render *render, const metroi_window *window, double *error)
{
    const metroi_canvas *canvas = &((const metroi_render *)render->state)->canvas;
    double sum = 0, total = 0, spread = 0, used = 0, common = metroi_common_error(render);
    size_t c;
    for (c = 0; c < canvas->batches; c++) {
        sum += metroi_window_sum(canvas, window, c);
        total += metroi_canvas_luminance(canvas, c);
    }
    for (c = 0; c < canvas->batches; c++) {
        double off = metroi_window_sum(canvas, window, c) - metroi_window_expect(render, c, sum, total);
        if (isnan(off)) continue;
        spread += off * off;
        used++;
    }
    *error = used > 1 ? sqrt(spread * used / (used - 1) / (sum * sum) + common * common) : METROI_NAN; /* eq 13.4 */
    return sum;
}

METRO_API double metro_render_block(const metro_render *render, size_t column, size_t row, double *error)
{
    const metroi_render *state = (const metroi_render *)render->state;
    const metroi_canvas *canvas;
    metroi_window window;
    size_t width, height;
    double mean;
    *error = METROI_NAN;
    if (state == NULL || render->rounds == 0) return METROI_NAN;
    canvas = &state->canvas;
    if (column >= canvas->columns || row >= canvas->rows) return METROI_NAN;
    window.left = column;
    window.right = column + 1;
    window.top = row;
    window.bottom = row + 1;
    width = 8 * column + 8 <= canvas->width ? 8 : canvas->width - 8 * column;
    height = 8 * row + 8 <= canvas->height ? 8 : canvas->height - 8 * row;
    mean = metroi_window_error(render, &window, error) * metroi_render_scale(render) / (double)(width * height);
    *error = mean > 0 ? *error * mean : METROI_NAN; /* a block that no sample fell on says nothing of its error */
    return mean;
}

/* The relative error of the mean luminance of a method without chains: the spread over the runs of rounds, or, while
   there are few rounds, that over all groups of samples, which counts the differences between pixels as well. */

static double metroi_paths_error(const metro_render *render)
{
    const metroi_canvas *canvas = &((const metroi_render *)render->state)->canvas;
    double error;
    metroi_window all;
    all.left = all.top = 0;
    all.right = canvas->columns;
    all.bottom = canvas->rows;
    metroi_window_error(render, &all, &error);
    return render->rounds >= METROI_PATH_BATCHES / 2 ? error : metroi_canvas_error(canvas);
}

/* The largest relative error of the sixteenths of the picture. */
static double metroi_worst_window(const metro_render *render)
{
    const metroi_canvas *canvas = &((const metroi_render *)render->state)->canvas;
    double worst = METROI_NAN, error;
    size_t i;
    for (i = 0; i < 16; i++) {
        metroi_window window;
        window.left = i % 4 * canvas->columns / 4;
        window.right = (i % 4 + 1) * canvas->columns / 4;
        window.top = i / 4 * canvas->rows / 4;
        window.bottom = (i / 4 + 1) * canvas->rows / 4;
        if (metroi_window_error(render, &window, &error) > 0 && !(error <= worst)) worst = error;
    }
    return worst;
}

/* R-hat and ESS (sections 7.7 and 7.8) are taken of sixteenths of the picture as well, and of the whole. */

static void metroi_chains_diagnose(const metroi_metropolis *plan, metro_render_report *report)
{
    size_t chains, block, c, draws = plan->trace_count, i;
    for (block = 0; draws >= 4 && block < METROI_TRACE_BLOCKS; block++) {
        double rhat, ess;
        for (chains = c = 0; c < plan->options->chains; c++) {
            const double *trace = plan->trace + (c * METROI_TRACE_BLOCKS + block) * METROI_TRACE_DRAWS;
            if (!plan->walker[c].alive) continue; /* it has nothing to agree with */
            for (i = 0; i < draws; i++) plan->draws[chains * draws + i] = trace[i];
            chains++;
        }
        rhat = metro_rhat(plan->draws, chains, draws);
        ess = metro_ess(plan->draws, chains, draws);
        if (!(report->rhat >= rhat) && !isnan(rhat)) report->rhat = rhat;
        if (!(report->ess <= ess) && !isnan(ess)) report->ess = ess;
    }
}

static void metroi_chains_report(const metro_render *render, metro_render_report *report)
{
    const metroi_render *state = (const metroi_render *)render->state;
    const metroi_metropolis *plan = &state->chains;
    metro_moments importance, luminance;
    double steps = 0, accepted = 0, dark = 0, jump = 0;
    size_t c;
    metroi_chains_moments(plan, &importance, &luminance);
    report->b = metro_moments_mean(&importance);
    report->b_error = metroi_b_error(&importance);
    for (c = 0; c < plan->options->chains; c++) {
        const metro_chain_counts *counts = &plan->walker[c].chain.counts;
        steps += (double)counts->steps;
        accepted += (double)counts->accepted;
        dark += (double)counts->dark;
        jump += metro_sum_value(&counts->squared_jump);
        report->not_finite += counts->nan + counts->infinite + counts->negative;
        if (counts->longest_stay > report->longest_stay) report->longest_stay = counts->longest_stay;
    }
    report->acceptance = accepted / steps;
    report->dark = dark / steps;
    report->squared_jump = jump / steps;
    metroi_chains_diagnose(plan, report);
}

/* For a text: what is too large for an int is cut. */
static int metroi_whole(double x)
{
    return x < 1e9 ? (int)x : 1000000000;
}

/* A warning is the first of these that holds. The bounds are the customary ones: R-hat 1.1, an ESS of 100; a mean
   known to a twentieth; a twentieth of a chain spent in one state. */

static void metroi_report_warn(const metro_render *render, metro_render_report *report)
{
    double steps = (double)render->samples / (double)render->options.chains;
    double share = report->mean_error / report->mean;
    char *text = report->warning;
    size_t room = sizeof report->warning;
    int are_weighted = metroi_render_walks(&render->options) && render->options.start == METRO_START_WEIGHTED;
    const char *cure = are_weighted ? "use more chains, or more candidates" : "run longer"; /* weights stay */
    if (report->not_finite > 0)
        snprintf(text, room,
                 "%.0f contributions were NaN or infinite and are missing in the picture: look for triangles or "
                 "materials with extreme numbers",
                 (double)report->not_finite);
    else if (report->mean == 0 && metroi_render_walks(&render->options))
        snprintf(text, room,
                 "none of the independent states had any importance, so b is unknown and the picture black: use more "
                 "candidates or large steps");
    else if (report->mean == 0)
        snprintf(text, room,
                 "no path from a lamp to the eye was found, so the picture is black: use more samples, or check "
                 "where the lamps shine");
    else if (metroi_render_walks(&render->options) && render->options.chains < 4)
        snprintf(text, room, "with fewer than four chains nothing says whether they agree: use more");
    else if (report->rhat > 1.1)
        snprintf(text, room,
                 "the chains do not agree on some part of the picture (R-hat above %d.%d): run longer, or raise the "
                 "probability of a large step",
                 metroi_whole(report->rhat), metroi_whole(10 * report->rhat) % 10);
    else if (report->ess < 100)
        snprintf(text, room, "some part of the picture rests on as little as %d independent samples: run longer",
                 metroi_whole(report->ess));
    else if ((double)report->longest_stay > steps / 20)
        snprintf(text, room,
                 "a chain stayed in one state for %.0f of its %.0f steps, which makes a bright spot: run longer, or "
                 "raise the probability of a large step",
                 (double)report->longest_stay, steps);
    else if (isnan(share))
        snprintf(text, room, "there are too few samples to say how far the picture can be trusted: run longer");
    else if (!(share < 0.05))
        snprintf(text, room, "the mean brightness is uncertain by %d %%: %s", metroi_whole(100 * share), cure);
    else if (report->worst > 0.25)
        snprintf(text, room, "some part of the picture is uncertain by %d %%: %s", metroi_whole(100 * report->worst),
                 cure);
}

METRO_API void metro_render_diagnose(const metro_render *render, metro_render_report *report)
{
    const metroi_render *state = (const metroi_render *)render->state;
    double n;
    memset(report, 0, sizeof *report);
    report->mean = report->mean_error = report->b = report->b_error = METROI_NAN;
    report->acceptance = report->dark = report->rhat = report->ess = report->worst = METROI_NAN;
    report->squared_jump = METROI_NAN;
    if (state == NULL || render->rounds == 0) return;
    report->not_finite = state->canvas.not_finite;
    n = (double)state->canvas.samples;
    if (!metroi_render_walks(&render->options)) {
        report->mean = state->canvas.luminance / n;
        report->mean_error = metroi_paths_error(render) * report->mean;
    } else {
        metroi_chains_report(render, report);
        report->mean = metroi_chains_mean(&state->chains, &report->mean_error);
    }
    report->worst = metroi_worst_window(render);
    metroi_report_warn(render, report);
}

/* # 14 Ray bundles

   The methods so far follow one path at a time. Lines that cross the whole scene, each of which moves light between
   all that it meets, came to radiosity with Sbert (1993) and Neumann (1995), who takes them in parallel bundles.
   Szirmay-Kalos and Purgathofer (1998) make walks of such bundles: choose a direction at random, and move the
   radiance of every surface of the scene along it. Such a bundle is dear, but it is coherent: neighbouring lines meet
   the same surfaces, so that what one line learns serves the next.

   [figure: fig6.svg | A path of ray bundles, drawn from a walk (figure 6 of the paper).]

   A bundle needs something to hold the radiance of all surfaces at once. So the surfaces are cut into patches, and
   the radiance that a patch sends into one direction is a number (a colour), or linear in its plane. The price is
   that a picture shows no more than a constant, or a plane, over each patch. With the vector of the radiances of all
   patches, L(omega), their emission L^e and their BRDFs, the diagonal matrix F, the equation of light becomes (paper
   (19))

       L(omega) = L^e + int F(omega', omega) A(omega') L(omega') d omega',   A_{ij} = frac{A(i, j, omega')}{A_i}
                                                                                      (14.1)

   where $A(i, j, omega')$ is the projected area of patch $j$ that patch $i$ sees in direction omega'. It is the
   equation of the whole scene, not of a point, and each matrix A is one bundle. */

/* # 14.1 Patches

   A triangle is cut into n times n similar ones by lines that are parallel to its edges. With n beta = s and n gamma
   = t for the point $p_0 + beta e_1 + gamma e_2$ these are the lines on which $s$, $t$ or $s + t$ is whole, so the
   patch of a point follows from three floors:

       i = floor(s),   j = floor(t),   k = floor(s + t) - i - j,   "patch" = i (2 n - i) + 2 j + k              (14.2)

   where $k$ is 0 in the patches that stand as the triangle does and 1 in those turned about, between them. Row $i$
   holds $2 (n - i) - 1$ patches. All have the same area. */

static uint32_t metroi_patch_cuts(const metroi_facet *facet, double size)
{
    metro_vec3 a = metro_subtract(facet->corner[1], facet->corner[0]);
    metro_vec3 b = metro_subtract(facet->corner[2], facet->corner[0]), c = metro_subtract(b, a);
    double longest2 = metroi_larger(metroi_larger(metro_dot(a, a), metro_dot(b, b)), metro_dot(c, c)), cuts;
    if (!(facet->area2 > 0) || !isfinite(facet->area2)) return 0;
    cuts = ceil(sqrt(longest2) / size * (1 - 1e-6));
    return cuts < 1 ? 1 : cuts < 32769 ? (uint32_t)cuts : 32769; /* whose square is more than there may be */
}

/* The patch (i, j, k) of a triangle: a lattice point and its two neighbours, or the three opposite ones. */

static metro_patch metroi_patch_cut(const metroi_facet *facet, uint32_t triangle, uint32_t n, uint32_t i, uint32_t j,
                                    int k)
{
    metro_patch patch;
    double step = 1 / (double)n, u = (double)i * step, v = (double)j * step;
    double du = (double)(i + 1) * step, dv = (double)(j + 1) * step;
    patch.corner[0] = k ? metroi_between(facet->corner, du, dv) : metroi_between(facet->corner, u, v);
    patch.corner[1] = k ? metroi_between(facet->corner, u, dv) : metroi_between(facet->corner, du, v);
    patch.corner[2] = k ? metroi_between(facet->corner, du, v) : metroi_between(facet->corner, u, dv);
    patch.normal = facet->normal;
    patch.area = 0.5 * facet->area2 * step * step;
    patch.triangle = triangle;
    return patch;
}

static void metroi_patches_fill(metro_patches *patches)
{
    metro_patch *patch = patches->patch;
    uint32_t triangle, i, j, n;
    for (triangle = 0; triangle < patches->scene->triangle_count; triangle++) {
        metroi_facet facet = metroi_facet_of(patches->scene, triangle);
        n = patches->cuts[triangle];
        for (i = 0; i < n; i++) {
            for (j = 0; i + j < n; j++) {
                *patch++ = metroi_patch_cut(&facet, triangle, n, i, j, 0);
                if (i + j + 1 < n) *patch++ = metroi_patch_cut(&facet, triangle, n, i, j, 1);
            }
        }
    }
}

/* How often each triangle is cut, and the number of its first patch. 0 for too many. */

static int metroi_patches_count(metro_patches *patches, double size)
{
    const size_t most = (size_t)1 << 30;
    uint32_t triangle;
    for (triangle = 0; triangle < patches->scene->triangle_count; triangle++) {
        metroi_facet facet = metroi_facet_of(patches->scene, triangle);
        size_t n = metroi_patch_cuts(&facet, size);
        patches->cuts[triangle] = (uint32_t)n;
        patches->first[triangle] = (uint32_t)patches->count;
        if (n > 0 && n > (most - patches->count) / n) return 0;
        patches->count += n * n;
    }
    patches->first[triangle] = (uint32_t)patches->count;
    return 1;
}

METRO_API metro_result metro_patches_make(const metro_scene *scene, double size, metro_patches *patches)
{
    metro_patches made;
    metro_vec3 low, high;
    if (scene == NULL || patches == NULL || !(size > 0)) return METRO_ERROR_ARGUMENT;
    memset(&made, 0, sizeof made);
    made.scene = scene;
    made.cuts = (uint32_t *)metroi_zeros(scene->triangle_count + 1, sizeof *made.cuts);
    made.first = (uint32_t *)metroi_zeros(scene->triangle_count + 1, sizeof *made.first);
    if (made.cuts != NULL && made.first != NULL && metroi_patches_count(&made, size))
        made.patch = (metro_patch *)metroi_zeros(made.count + 1, sizeof *made.patch);
    if (made.patch == NULL) {
        metro_patches_free(&made);
        return METRO_ERROR_MEMORY;
    }
    metroi_patches_fill(&made);
    if (metro_scene_bounds(scene, &low, &high) == METRO_OK) {
        made.middle = metro_scale(metro_add(low, high), 0.5);
        made.radius = 0.5 * metro_length(metro_subtract(high, low));
    }
    *patches = made;
    return METRO_OK;
}

METRO_API void metro_patches_free(metro_patches *patches)
{
    METRO_FREE(patches->patch);
    METRO_FREE(patches->cuts);
    METRO_FREE(patches->first);
    memset(patches, 0, sizeof *patches);
}

/* Floors that stay inside the triangle when a point on its border is off by a rounding. */

METROI_INLINE void metroi_patch_place(double s, double t, int32_t n, int32_t *i, int32_t *j, int32_t *k)
{
    *i = s < (double)n ? (s > 0 ? (int32_t)s : 0) : n - 1;
    *j = t < (double)(n - *i) ? (t > 0 ? (int32_t)t : 0) : n - 1 - *i;
    *k = s + t >= (double)(*i + *j + 1) && *i + *j + 1 < n; /* eq 14.2 */
}

METROI_INLINE uint32_t metroi_patch_number(int32_t n, int32_t i, int32_t j, int32_t k)
{
    return (uint32_t)(i * (2 * n - i) + 2 * j + k); /* eq 14.2 */
}

METRO_API size_t metro_patches_at(const metro_patches *patches, uint32_t triangle, double u, double v)
{
    int32_t n, i, j, k;
    if (triangle >= patches->scene->triangle_count || patches->cuts[triangle] == 0) return patches->count;
    n = (int32_t)patches->cuts[triangle];
    metroi_patch_place(u * (double)n, v * (double)n, n, &i, &j, &k);
    return patches->first[triangle] + metroi_patch_number(n, i, j, k);
}

METROI_WARM

/* # 14.2 A bundle

   We look along the direction omega. In a frame of three axes with omega for the third, a point has the coordinates x
   and y, counted in cells of the grid, and its depth z. The grid covers the sphere around the scene from any side,
   and the grid is shifted by a random part of a cell: then each line is uniform, and any count of lines is right in
   the mean. This is what keeps patches smaller than a cell unbiased, as long as what a patch received is divided by
   its true area and not by the lines that happened to meet it:

       E[c^2 sum_{"lines"} L_j] = sum_{j} A(i, j) L_j                                 (14.3)

   with $c$ the side of a cell. The variance pays for it: a patch much smaller than a cell is met seldom, and then
   receives much at once. A patch i receives from one side only, its front, and a line has two directions:
   if omega is uniform on the sphere, the direction from which a patch receives is uniform on a hemisphere, with the
   density 1/(2 pi). So one bundle estimates the integral of eq 14.1 by

       2 pi F(omega', omega) frac{c^2}{A_i} sum_{"lines of i"} L_j                    (14.4)

   which for a diffuse surface is $2 rho A_{ij} L_j$. No cosine is divided by, so nothing happens at grazing
   directions but that fewer lines meet the patch.

   Radiance is kept as four numbers, of which the last is always 1: what is done to colours then counts the lines as
   well, which is what the energy balance is measured by. */

enum { METROI_GRID_MOST = 16384 };

#define METROI_NO_PATCH 0xffffffffu

/* The lines of the bundle at work. */
typedef struct {
    metro_vec3 across, down, along;  /* the axes, of unit length */
    metro_vec3 middle;
    double per_cell;                 /* 1/c */
    double x, y;                     /* where the middle of the scene is, in cells */
} metroi_rays;

static metroi_rays metroi_rays_make(const metro_patches *patches, metro_vec3 direction, size_t grid,
                                    const double *shift)
{
    metroi_rays lines;
    lines.along = metro_normalize(direction);
    metroi_frame(lines.along, &lines.across, &lines.down); /* section 3.9 */
    lines.middle = patches->middle;
    lines.per_cell = patches->radius > 0 ? 0.5 * (double)grid / patches->radius : 0;
    lines.x = 0.5 * (double)grid + shift[0];
    lines.y = 0.5 * (double)grid + shift[1];
    return lines;
}

METROI_INLINE metro_vec3 metroi_rays_see(const metroi_rays *lines, metro_vec3 point)
{
    metro_vec3 p = metro_scale(metro_subtract(point, lines->middle), lines->per_cell);
    return metro_vec3_make(metro_dot(p, lines->across) + lines->x, metro_dot(p, lines->down) + lines->y,
                           metro_dot(p, lines->along));
}

/* The lines stand in the middles of the cells, at 1/2, 3/2, ..., and a border at x has floor(x + 1/2) of them to its
   left, whoever asks: two patches that share a border share no line and leave none out. All coordinates are
   positive, so that a conversion is a floor; the grid has a margin of a cell for the shift and one for rounding. */

METROI_INLINE double metroi_lines_before(double x)
{
    return (double)(int32_t)(x + 0.5);
}

/* The outline of a triangle as the rows cut it. The corners are put in order of (y, x) first, so that an edge that
   two triangles share is cut at the same x for both, to the bit. */

typedef struct {
    double x0, y0, x1, y1;            /* corners 0 and 1 */
    double slope01, slope12, slope02; /* dx/dy of the edges */
    double depth, depth_x, depth_y;   /* z = depth + depth_x (x - x0) + depth_y (y - y0) */
    int32_t row, row_end;
    int up;                           /* the front looks along the direction, to larger z */
    int seen;                         /* 0 when it is seen from its edge, and no line meets it */
} metroi_outline;

METROI_INLINE void metroi_swap_if_later(metro_vec3 *a, metro_vec3 *b, int *turned)
{
    metro_vec3 c = *a;
    if (a->y < b->y || (a->y == b->y && a->x <= b->x)) return;
    *a = *b;
    *b = c;
    *turned = !*turned;
}

static metroi_outline metroi_outline_make(metro_vec3 a, metro_vec3 b, metro_vec3 c)
{
    metroi_outline o;
    metro_vec3 ab, ac;
    double det;
    int turned = 0;
    memset(&o, 0, sizeof o);
    metroi_swap_if_later(&a, &b, &turned);
    metroi_swap_if_later(&b, &c, &turned);
    metroi_swap_if_later(&a, &b, &turned);
    ab = metro_subtract(b, a);
    ac = metro_subtract(c, a);
    det = ab.x * ac.y - ac.x * ab.y;
    o.row = (int32_t)(a.y + 0.5);
    o.row_end = (int32_t)(c.y + 0.5);
    /* A direction in the plane of the triangle leaves nothing to divide by. */
    if (!(fabs(det) > 1e-12 * (metro_dot(ab, ab) + metro_dot(ac, ac)))) return o;
    o.seen = 1;
    o.up = (det > 0) != turned;
    o.x0 = a.x;
    o.y0 = a.y;
    o.x1 = b.x;
    o.y1 = b.y;
    o.slope02 = c.y > a.y ? ac.x / ac.y : 0;
    o.slope01 = b.y > a.y ? ab.x / ab.y : 0;
    o.slope12 = c.y > b.y ? (c.x - b.x) / (c.y - b.y) : 0;
    o.depth = a.z;
    o.depth_x = (ab.z * ac.y - ac.z * ab.y) / det;
    o.depth_y = (ab.x * ac.z - ac.x * ab.z) / det;
    return o;
}

METROI_INLINE void metroi_outline_cut(const metroi_outline *o, double y, double *left, double *right)
{
    double x02 = o->x0 + (y - o->y0) * o->slope02;
    double x12 = y < o->y1 ? o->x0 + (y - o->y0) * o->slope01 : o->x1 + (y - o->y1) * o->slope12;
    *left = metroi_smaller(x02, x12);
    *right = metroi_larger(x02, x12);
}

METROI_INLINE double metroi_outline_depth(const metroi_outline *o, double x, double y)
{
    return o->depth + o->depth_x * (x - o->x0) + o->depth_y * (y - o->y0);
}

/* Which of two surfaces on the same line comes first? Where their depths agree to a part in 10^7 they touch, and a
   fixed order decides: back to back, so that a sheet of two triangles shows its fronts to the outside, and a box on
   the floor exchanges nothing with what it stands on; then by number. Whatever the order, what leaves one patch
   arrives at one other, so a wrong one makes no energy. */

METROI_INLINE int metroi_comes_first(double depth_a, int up_a, size_t a, double depth_b, int up_b, size_t b,
                                     double touch)
{
    double difference = depth_a - depth_b;
    if (difference < -touch) return 1;
    if (difference > touch) return 0;
    if (up_a != up_b) return up_b;
    return a < b;
}

/* # 14.3 Rows and spans

   A row of lines is a plane that cuts the scene, and a triangle in it is a segment, a span. Sweeping along the row we
   keep the spans above each other in a list, ordered by depth. The list changes where a span begins or ends, and
   only there does anybody get another neighbour. Between two such events two neighbours face each other along a
   whole stretch of lines, and all that is left is to see which of their patches do.

   Sorting patches instead of triangles would repeat for every patch what is the same for all patches of a triangle.
   Two spans are compared once, in the middle of what they have in common, which is enough where surfaces at most
   touch. Where triangles pass through each other the sweep takes one of them for the upper one all along, and half a
   square behind one that crosses it, which should receive nothing, may receive a fifth of what the other half does;
   such scenes are for the fragments of section 14.4.

   Along the stretch the patch of a triangle changes where $s$, $t$ or $s + t$ of eq 14.2 passes a whole number. That
   gives three arithmetic sequences of places, and their merging is simple: a patch with k = 0 is left into one with
   k = 1 and the other way round. Of the rates of $s$, $t$ and $-(s + t)$, whose sum is 0, one has a sign of its own.
   Patches of one kind are left through a border of that family only, patches of the other kind through one of the two
   others, whichever comes first. Each family also knows how many borders it has left before the border of the
   triangle, so that no rounding leads out of the triangle, and a staircase ends even if its steps are too small to
   move it. */

typedef struct {
    double at, step;      /* the next border, and the distance between borders */
    int32_t left;         /* how many there are still */
    int32_t move, turn;   /* what passing it adds to the number of the patch, and how that changes each time */
    int32_t move_i, move_j;
} metroi_borders;

typedef struct {
    metroi_borders family[3];  /* the first is the one with a sign of its own */
    double next;
    uint32_t patch;
    int32_t i, j, k;           /* kept for radiance that is linear */
    int alone;                 /* the next border is of the first family */
} metroi_stairs;

/* A triangle as the bundle sees it. */
typedef struct {
    metroi_outline outline;
    metro_vec3 corner;         /* p_0 */
    double s_x, s_y, t_x, t_y; /* how s and t change along x and y */
    double step[3];            /* distances between the borders of s, t and s + t along x */
    int kind[3];               /* the families 0 s, 1 t, 2 s + t in the order of the stairs */
    int upward[3];             /* that of s, t, s + t grows along x */
    int alone_first;           /* patches with k = 0 are left through the first family */
    int32_t cuts;
    uint32_t first, next;      /* the number of the first patch; the next triangle that begins in the same row */
    /* in the row at work: */
    double left, right;
    double since;              /* from where on the pair of this span and the one after it has not been exchanged */
    int ready;                 /* the stairs are made */
    metroi_stairs stairs;
} metroi_shadow;

/* The memory of a bundle, allocated once and used for one after the other. */
typedef struct {
    const metro_patches *patches;
    metroi_rays lines;
    size_t grid, rows;         /* rows and columns with their margin */
    double touch;
    metro_visibility visibility;
    size_t nodes;              /* values a patch: 1, or 3 where radiance is linear */
    double *radiance;          /* [4 * nodes * count], the fourth always 1 */
    double *received;          /* [4 * nodes * count]: sums over lines */
    metroi_shadow *shadow;     /* [triangle_count] */
    uint32_t *begin;           /* [rows]: the first triangle that begins in a row */
    metroi_shadow **row, **pile; /* [triangle_count]: the spans of a row; those above each other */
    double since;              /* as `since` of a span, below the lowest one */
    double escaped[4], absorbed[4];
    int balance;               /* these two are wanted */
    struct metroi_fragment *fragment;
    uint32_t *cell, *order;
    size_t fragment_room;
} metroi_bundle;

static void metroi_shadow_stairs_prepare(metroi_shadow *shadow, metro_vec3 b, metro_vec3 c)
{
    metro_vec3 a = shadow->corner;
    double n = (double)shadow->cuts, bx = b.x - a.x, by = b.y - a.y, cx = c.x - a.x, cy = c.y - a.y;
    double scale = n / (bx * cy - cx * by), rate[3];
    int minus, f, lone = 2;
    shadow->s_x = cy * scale;
    shadow->s_y = -cx * scale;
    shadow->t_x = -by * scale;
    shadow->t_y = bx * scale;
    rate[0] = shadow->s_x;
    rate[1] = shadow->t_x;
    rate[2] = shadow->s_x + shadow->t_x;
    for (f = 0; f < 3; f++) {
        shadow->upward[f] = rate[f] > 0;
        shadow->step[f] = 1 / fabs(rate[f]); /* infinite where nothing changes */
    }
    /* The signs of s, t and -(s + t): one minus, or one that is not. */
    minus = (rate[0] < 0) + (rate[1] < 0) + (rate[2] > 0);
    if (minus == 1) lone = rate[0] < 0 ? 0 : rate[1] < 0 ? 1 : 2;
    if (minus == 2) lone = !(rate[0] < 0) ? 0 : !(rate[1] < 0) ? 1 : 2;
    shadow->alone_first = minus == 1;
    shadow->kind[0] = lone;
    shadow->kind[1] = lone == 0 ? 1 : 0;
    shadow->kind[2] = lone == 2 ? 1 : 2;
}

/* The next border of family `kind` from the place `at` on, where the family has the value `value` with the whole part
   `whole`. */

METROI_INLINE metroi_borders metroi_borders_make(const metroi_shadow *shadow, int kind, double at, double value,
                                                 int32_t whole, int32_t i)
{
    metroi_borders borders;
    int32_t n = shadow->cuts;
    int up = shadow->upward[kind];
    double first = up ? (double)(whole + 1) - value : value - (double)whole;
    borders.step = shadow->step[kind];
    borders.left = up ? n - 1 - whole : whole;
    borders.at = borders.left > 0 && borders.step < METROI_INFINITY ? at + first * borders.step : METROI_INFINITY;
    borders.move = up ? 1 : -1;
    borders.turn = 0;
    borders.move_i = kind == 0 ? borders.move : 0;
    borders.move_j = kind == 1 ? borders.move : 0;
    if (kind == 0) { /* to the next row of patches, eq 14.2 */
        borders.move = up ? 2 * (n - i - 1) : -2 * (n - i);
        borders.turn = -2;
    }
    return borders;
}

METROI_INLINE void metroi_stairs_aim(metroi_stairs *stairs, int whole_lines)
{
    double b = stairs->family[1].at, c = stairs->family[2].at;
    stairs->next = stairs->alone ? stairs->family[0].at : metroi_smaller(b, c);
    if (whole_lines && stairs->next < 1e9) stairs->next = metroi_lines_before(stairs->next);
}

/* The patch at the left end of the span, or at its first line, and the borders that follow. */

static void metroi_stairs_make(metroi_shadow *shadow, double y, int whole_lines)
{
    metroi_stairs *stairs = &shadow->stairs;
    double at = whole_lines ? shadow->left + 0.5 : shadow->left;
    double dx = at - shadow->corner.x, dy = y - shadow->corner.y, value[3];
    int32_t whole[3], i, j, k, f;
    shadow->ready = 1;
    stairs->patch = shadow->first;
    stairs->next = METROI_INFINITY;
    stairs->i = stairs->j = stairs->k = 0;
    if (shadow->cuts == 1) return;
    value[0] = dx * shadow->s_x + dy * shadow->s_y;
    value[1] = dx * shadow->t_x + dy * shadow->t_y;
    value[2] = value[0] + value[1];
    metroi_patch_place(value[0], value[1], shadow->cuts, &i, &j, &k);
    whole[0] = i;
    whole[1] = j;
    whole[2] = i + j + k;
    stairs->patch += metroi_patch_number(shadow->cuts, i, j, k);
    stairs->i = i;
    stairs->j = j;
    stairs->k = k;
    for (f = 0; f < 3; f++) {
        int kind = shadow->kind[f];
        stairs->family[f] = metroi_borders_make(shadow, kind, at, value[kind], whole[kind], i);
    }
    stairs->alone = (k == 0) == shadow->alone_first;
    metroi_stairs_aim(stairs, whole_lines);
}

METROI_INLINE void metroi_stairs_step(metroi_stairs *stairs, int whole_lines)
{
    metroi_borders *passed = &stairs->family[0];
    if (!stairs->alone) passed += stairs->family[1].at < stairs->family[2].at ? 1 : 2;
    stairs->patch += (uint32_t)passed->move;
    stairs->i += passed->move_i;
    stairs->j += passed->move_j;
    stairs->k = !stairs->k;
    passed->move += passed->turn;
    passed->at = --passed->left > 0 ? passed->at + passed->step : METROI_INFINITY;
    stairs->alone = !stairs->alone;
    metroi_stairs_aim(stairs, whole_lines);
}

/* What the patch at the end of a line gets from the one at its other end, for `lines` lines. */

METROI_INLINE void metroi_receive(double *received, const double *radiance, double lines)
{
    received[0] += lines * radiance[0]; /* eq 14.3 */
    received[1] += lines * radiance[1];
    received[2] += lines * radiance[2];
    received[3] += lines * radiance[3];
}

/* Radiance may also be linear over a patch, given by its values $l_k$ at the three corners: $L = b_0 l_0 + b_1 l_1 +
   b_2 l_2$ with the barycentric coordinates b of the patch. What arrives is then projected back to such values, by
   dual functions (Szirmay-Kalos, Foris and Purgathofer 1998b). The products of the b over a triangle of area A have
   the integrals A/12, and A/6 for the squares, whose matrix is easily inverted:

       m_k = int b_k L d A,   l_k = frac{12}{A} (m_k - frac{m_0 + m_1 + m_2}{4})                       (14.5)

   Next to the border of a shadow such a value may be below 0, and so may a pixel.

   Along a stretch of lines both factors are linear in x. With their values b, L in its middle and their slopes b', L'
   the sum over n lines, or the integral over a length n, is

       sum b L = n b L + frac{n (n^2 - 1)}{12} b' L',   int b L d x = n b L + frac{n^3}{12} b' L'      (14.6) */

typedef struct {
    double at[3], slope[3];        /* barycentric coordinates in the middle of a stretch, and how they change */
    double light[4], light_slope[4];
} metroi_stretch;

static void metroi_stretch_see(const metroi_bundle *bundle, const metroi_shadow *shadow, double x, double y,
                               metroi_stretch *stretch)
{
    const metroi_stairs *stairs = &shadow->stairs;
    const double *radiance = bundle->radiance + 12 * (size_t)stairs->patch;
    double dx = x - shadow->corner.x, dy = y - shadow->corner.y, sign = stairs->k ? -1 : 1;
    double u = dx * shadow->s_x + dy * shadow->s_y - (double)stairs->i;
    double v = dx * shadow->t_x + dy * shadow->t_y - (double)stairs->j;
    size_t c;
    /* The corners of section 14.1: at (i, j) and its neighbours, or opposite. */
    stretch->at[1] = stairs->k ? 1 - u : u;
    stretch->at[2] = stairs->k ? 1 - v : v;
    stretch->at[0] = 1 - stretch->at[1] - stretch->at[2];
    stretch->slope[1] = sign * shadow->s_x;
    stretch->slope[2] = sign * shadow->t_x;
    stretch->slope[0] = -stretch->slope[1] - stretch->slope[2];
    for (c = 0; c < 4; c++) {
        const double *l = radiance + c;
        stretch->light[c] = stretch->at[0] * l[0] + stretch->at[1] * l[4] + stretch->at[2] * l[8];
        stretch->light_slope[c] = stretch->slope[0] * l[0] + stretch->slope[1] * l[4] + stretch->slope[2] * l[8];
    }
}

static void metroi_stretch_receive(double *received, const metroi_stretch *a, const metroi_stretch *b, double lines,
                                   double spread)
{
    size_t k, c;
    for (k = 0; k < 3; k++)
        for (c = 0; c < 4; c++)
            received[4 * k + c] += lines * a->at[k] * b->light[c] + spread * a->slope[k] * b->light_slope[c];
}

static void metroi_stretch_exchange(metroi_bundle *bundle, const metroi_shadow *a, const metroi_shadow *b, double x,
                                    double end, double y, int whole_lines)
{
    double lines = end - x, spread = lines * (lines * lines - (whole_lines ? 1 : 0)) / 12; /* eq 14.6 */
    metroi_stretch at_a, at_b;
    metroi_stretch_see(bundle, a, 0.5 * (x + end), y, &at_a);
    metroi_stretch_see(bundle, b, 0.5 * (x + end), y, &at_b);
    metroi_stretch_receive(bundle->received + 12 * (size_t)a->stairs.patch, &at_a, &at_b, lines, spread);
    metroi_stretch_receive(bundle->received + 12 * (size_t)b->stairs.patch, &at_b, &at_a, lines, spread);
}

/* Two triangles that face each other from x to `end`: their patches exchange what they send, both ways. */

METROI_INLINE void metroi_sweep_exchange(metroi_bundle *bundle, metroi_shadow *a, metroi_shadow *b, double x,
                                         double end, double y, int whole_lines)
{
    int linear = bundle->nodes == 3;
    while (a->stairs.next <= x) metroi_stairs_step(&a->stairs, whole_lines);
    while (b->stairs.next <= x) metroi_stairs_step(&b->stairs, whole_lines);
    for (;;) {
        size_t i = 4 * (size_t)a->stairs.patch, j = 4 * (size_t)b->stairs.patch;
        double until = metroi_smaller(metroi_smaller(a->stairs.next, b->stairs.next), end);
        if (until > x && linear) metroi_stretch_exchange(bundle, a, b, x, until, y, whole_lines);
        else if (until > x) {
            metroi_receive(bundle->received + i, bundle->radiance + j, until - x);
            metroi_receive(bundle->received + j, bundle->radiance + i, until - x);
        }
        x = metroi_larger(x, until);
        if (until >= end) return;
        if (a->stairs.next <= until) metroi_stairs_step(&a->stairs, whole_lines);
        if (b->stairs.next <= until) metroi_stairs_step(&b->stairs, whole_lines);
    }
}

/* The same for a triangle that nobody faces. Its patches receive nothing but see as many lines, which the fourth
   number keeps count of. */

static void metroi_sweep_lose(metroi_bundle *bundle, metroi_shadow *a, double x, double end, int whole_lines,
                              double *lost)
{
    while (a->stairs.next <= x) metroi_stairs_step(&a->stairs, whole_lines);
    for (;;) {
        size_t i = 4 * (size_t)a->stairs.patch;
        double until = metroi_smaller(a->stairs.next, end);
        if (until > x) {
            metroi_receive(lost, bundle->radiance + i, until - x);
            bundle->received[i + 3] += until - x;
            x = until;
        }
        if (until >= end) return;
        metroi_stairs_step(&a->stairs, whole_lines);
    }
}

/* The pair `low`, `high` in the pile stops being neighbours at x; NULL stands for nothing. */

static void metroi_sweep_part(metroi_bundle *bundle, metroi_shadow *low, metroi_shadow *high, double x, double y,
                              int whole_lines)
{
    double since = low != NULL ? low->since : bundle->since;
    int up = low != NULL && low->outline.up, down = high != NULL && !high->outline.up;
    if (low != NULL) low->since = x;
    else bundle->since = x;
    if (!(x > since) || !(up || down) || !(bundle->balance || (up && down))) return;
    if (up && !low->ready) metroi_stairs_make(low, y, whole_lines);
    if (down && !high->ready) metroi_stairs_make(high, y, whole_lines);
    if (up && down) metroi_sweep_exchange(bundle, low, high, since, x, y, whole_lines);
    else if (up)
        metroi_sweep_lose(bundle, low, since, x, whole_lines, high == NULL ? bundle->escaped : bundle->absorbed);
    else metroi_sweep_lose(bundle, high, since, x, whole_lines, low == NULL ? bundle->escaped : bundle->absorbed);
}

/* Two spans are compared in the middle of what they have in common. */

METROI_INLINE int metroi_sweep_comes_first(const metroi_bundle *bundle, const metroi_shadow *a,
                                           const metroi_shadow *b, double y)
{
    double x = 0.5 * (metroi_larger(a->left, b->left) + metroi_smaller(a->right, b->right));
    return metroi_comes_first(metroi_outline_depth(&a->outline, x, y), a->outline.up, a->first,
                              metroi_outline_depth(&b->outline, x, y), b->outline.up, b->first, bundle->touch);
}

/* Sweeps the row at y with its `spans` spans, which are in order of their left ends. */

static void metroi_sweep_row(metroi_bundle *bundle, size_t spans, double y, int whole_lines)
{
    metroi_shadow **pile = bundle->pile;
    size_t begun = 0, height = 0, place, i;
    bundle->since = 0;
    while (begun < spans || height > 0) {
        size_t ending = 0;
        for (i = 1; i < height; i++)
            if (pile[i]->right < pile[ending]->right) ending = i;
        if (height > 0 && (begun == spans || pile[ending]->right <= bundle->row[begun]->left)) {
            metroi_shadow *span = pile[ending];
            metroi_shadow *low = ending > 0 ? pile[ending - 1] : NULL;
            metroi_shadow *high = ending + 1 < height ? pile[ending + 1] : NULL;
            double x = span->right;
            metroi_sweep_part(bundle, low, span, x, y, whole_lines);
            metroi_sweep_part(bundle, span, high, x, y, whole_lines);
            for (i = ending + 1; i < height; i++) pile[i - 1] = pile[i];
            height--;
        } else {
            metroi_shadow *span = bundle->row[begun++];
            for (place = 0; place < height && metroi_sweep_comes_first(bundle, pile[place], span, y);) place++;
            metroi_sweep_part(bundle, place > 0 ? pile[place - 1] : NULL, place < height ? pile[place] : NULL,
                              span->left, y, whole_lines);
            span->since = span->left;
            for (i = height; i > place; i--) pile[i] = pile[i - 1];
            pile[place] = span;
            height++;
        }
    }
}

/* The spans of a row: those of the row before that go on, and those that begin, each cut at y. Where triangles are
   larger than a cell they are nearly in order already, so they are sorted by insertion. Spans that meet no line are
   left out of the row, but not of the next. */

static size_t metroi_sweep_cut(metroi_bundle *bundle, size_t *live, int32_t row, int whole_lines)
{
    double y = (double)row + 0.5;
    metroi_shadow **list = bundle->row, *span;
    uint32_t index;
    size_t kept = 0, i, j, spans;
    for (i = 0; i < *live; i++)
        if (list[i]->outline.row_end > row) list[kept++] = list[i];
    for (index = bundle->begin[row]; index != METROI_NO_PATCH; index = list[kept++]->next)
        list[kept] = &bundle->shadow[index];
    *live = kept;
    for (i = 0; i < kept; i++) {
        span = list[i];
        span->ready = 0;
        metroi_outline_cut(&span->outline, y, &span->left, &span->right);
        if (whole_lines) {
            span->left = metroi_lines_before(span->left);
            span->right = metroi_lines_before(span->right);
        }
        if (!(span->left < span->right)) span->left = METROI_INFINITY; /* goes to the end */
        for (j = i; j > 0 && list[j - 1]->left > span->left; j--) list[j] = list[j - 1];
        list[j] = span;
    }
    for (spans = kept; spans > 0 && isinf(list[spans - 1]->left);) spans--;
    return spans;
}

/* All triangles, seen along the lines, filed under the row in which they begin. */

static void metroi_sweep_prepare(metroi_bundle *bundle)
{
    const metro_patches *patches = bundle->patches;
    size_t triangle, row;
    for (row = 0; row < bundle->rows; row++) bundle->begin[row] = METROI_NO_PATCH;
    for (triangle = patches->scene->triangle_count; triangle-- > 0;) {
        metroi_shadow *shadow = &bundle->shadow[triangle];
        metro_vec3 p[3];
        int k;
        shadow->cuts = (int32_t)patches->cuts[triangle];
        shadow->outline.seen = 0;
        if (shadow->cuts == 0) continue;
        for (k = 0; k < 3; k++)
            p[k] = metroi_rays_see(&bundle->lines, metroi_triangle_corner(patches->scene, (uint32_t)triangle, k));
        shadow->outline = metroi_outline_make(p[0], p[1], p[2]);
        if (!shadow->outline.seen || shadow->outline.row >= shadow->outline.row_end) continue;
        shadow->corner = p[0];
        shadow->first = patches->first[triangle];
        metroi_shadow_stairs_prepare(shadow, p[1], p[2]);
        shadow->next = bundle->begin[shadow->outline.row];
        bundle->begin[shadow->outline.row] = (uint32_t)triangle;
    }
}

static void metroi_sweep(metroi_bundle *bundle, int whole_lines)
{
    size_t live = 0;
    int32_t row;
    metroi_sweep_prepare(bundle);
    for (row = 0; row < (int32_t)bundle->rows; row++) {
        size_t spans = metroi_sweep_cut(bundle, &live, row, whole_lines);
        metroi_sweep_row(bundle, spans, (double)row + 0.5, whole_lines);
    }
}

METROI_COLD

/* # 14.4 Fragments

   The plain way, to check the sweep by: each patch leaves a fragment, its number and its depth, on each line that
   meets it. We count them line by line, add the counts up so that each line knows its place in one long list, fill
   the list, sort each line's part by depth, and exchange between neighbours. How long is the list? A convex figure of
   area A and perimeter P holds at most

       A + frac{1}{2} P + 1                                                           (14.7)

   points of the unit grid (Nosarzewska 1948), and a patch seen at an angle is smaller than one seen from its front.
   */

struct metroi_fragment {
    double depth;
    uint32_t patch;
    int up;
};

static size_t metroi_fragments_most(const metro_patches *patches, size_t grid)
{
    double per_cell = patches->radius > 0 ? 0.5 * (double)grid / patches->radius : 0, sum = 1;
    size_t i;
    int k;
    for (i = 0; i < patches->count; i++) {
        const metro_patch *patch = &patches->patch[i];
        double around = 0;
        for (k = 0; k < 3; k++)
            around += metro_length(metro_subtract(patch->corner[(k + 1) % 3], patch->corner[k]));
        sum += patch->area * per_cell * per_cell + 0.5 * around * per_cell + 1 + 1e-6; /* eq 14.7 */
    }
    return sum < 4e9 ? (size_t)sum : 0;
}

/* The outline of a patch itself, without regard to its triangle. */

static metroi_outline metroi_patch_outline(const metroi_bundle *bundle, size_t patch)
{
    const metro_vec3 *p = bundle->patches->patch[patch].corner;
    return metroi_outline_make(metroi_rays_see(&bundle->lines, p[0]), metroi_rays_see(&bundle->lines, p[1]),
                               metroi_rays_see(&bundle->lines, p[2]));
}

/* The cells of `outline` in `row`: from *from until before the number returned. */

static size_t metroi_outline_cells(const metroi_bundle *bundle, const metroi_outline *outline, int32_t row,
                                   size_t *from)
{
    double left, right;
    metroi_outline_cut(outline, (double)row + 0.5, &left, &right);
    left = metroi_lines_before(left);
    right = metroi_lines_before(right);
    *from = (size_t)row * bundle->rows + (size_t)left;
    return (size_t)row * bundle->rows + (size_t)right;
}

/* Two neighbours on a line; METROI_NO_PATCH stands for nothing. */

static void metroi_line_pair(metroi_bundle *bundle, uint32_t low, int low_up, uint32_t high, int high_up)
{
    double *received = bundle->received, *radiance = bundle->radiance;
    int up = low != METROI_NO_PATCH && low_up, down = high != METROI_NO_PATCH && !high_up;
    size_t i = 4 * (size_t)low, j = 4 * (size_t)high;
    if (up && down) {
        metroi_receive(received + i, radiance + j, 1);
        metroi_receive(received + j, radiance + i, 1);
    } else if (up) {
        metroi_receive(high == METROI_NO_PATCH ? bundle->escaped : bundle->absorbed, radiance + i, 1);
        received[i + 3] += 1;
    } else if (down) {
        metroi_receive(low == METROI_NO_PATCH ? bundle->escaped : bundle->absorbed, radiance + j, 1);
        received[j + 3] += 1;
    }
}

static void metroi_fragments_sort(struct metroi_fragment *fragment, size_t count, double touch)
{
    size_t i, j;
    for (i = 1; i < count; i++) {
        struct metroi_fragment f = fragment[i];
        for (j = i; j > 0; j--) {
            const struct metroi_fragment *g = &fragment[j - 1];
            if (metroi_comes_first(g->depth, g->up, g->patch, f.depth, f.up, f.patch, touch)) break;
            fragment[j] = fragment[j - 1];
        }
        fragment[j] = f;
    }
}

/* Files the fragments of a patch, or counts them only. */

static void metroi_fragments_add(metroi_bundle *bundle, size_t patch, int count_only)
{
    metroi_outline outline = metroi_patch_outline(bundle, patch);
    int32_t row;
    if (!outline.seen) return;
    for (row = outline.row; row < outline.row_end; row++) {
        size_t cell, until = metroi_outline_cells(bundle, &outline, row, &cell);
        for (; cell < until; cell++) {
            struct metroi_fragment *fragment;
            uint32_t place = bundle->cell[cell]++;
            if (count_only || place >= bundle->fragment_room) continue;
            fragment = &bundle->fragment[place];
            fragment->depth = metroi_outline_depth(&outline, (double)(cell % bundle->rows) + 0.5,
                                                   (double)row + 0.5);
            fragment->patch = (uint32_t)patch;
            fragment->up = outline.up;
        }
    }
}

static void metroi_fragments(metroi_bundle *bundle)
{
    size_t cells = bundle->rows * bundle->rows, i;
    uint32_t sum = 0, begin = 0, end, j;
    memset(bundle->cell, 0, cells * sizeof *bundle->cell);
    for (i = 0; i < bundle->patches->count; i++) metroi_fragments_add(bundle, i, 1);
    for (i = 0; i < cells; i++) {
        uint32_t count = bundle->cell[i];
        bundle->cell[i] = sum;
        sum += count;
    }
    for (i = 0; i < bundle->patches->count; i++) metroi_fragments_add(bundle, i, 0);
    for (i = 0; i < cells; i++, begin = end) { /* filling has moved the beginning of each line to its end */
        const struct metroi_fragment *f = bundle->fragment;
        end = bundle->cell[i];
        if (begin == end) continue;
        metroi_fragments_sort(bundle->fragment + begin, end - begin, bundle->touch);
        metroi_line_pair(bundle, METROI_NO_PATCH, 0, f[begin].patch, f[begin].up);
        for (j = begin; j + 1 < end; j++) metroi_line_pair(bundle, f[j].patch, f[j].up, f[j + 1].patch, f[j + 1].up);
        metroi_line_pair(bundle, f[end - 1].patch, f[end - 1].up, METROI_NO_PATCH, 0);
    }
}

/* # 14.5 Painting

   In 1998 bundles were also painted: patches in the order of their depth, each over what is there (the global
   painter's algorithm of Szirmay-Kalos 1998a). The picture holds at each cell the number of the last patch that was
   painted there, which is the neighbour of the next one. But whole patches have no order. Two that are near each
   other may be painted in the order of their centres although one reaches before the other; and what is then
   exchanged between the wrong pairs is the same on the finest grid and with any number of bundles. The sweep above
   has no such error, and is faster where triangles have many patches, as the chart shows.

   [figure: painter.svg | The painter's error does not fall with the grid: what patches receive by all ways of
   sections 14.3 to 14.6.]

   Depths are sorted by their leading 32 bits, eleven at a time, from the last. */

static void metroi_painter_order(metroi_bundle *bundle)
{
    enum { BITS = 11, SIZE = 1 << BITS };
    size_t count = bundle->patches->count, i;
    uint32_t *from = bundle->order, *to = from + 2 * count, *swap, start[SIZE];
    double low = -(double)bundle->grid, per_step = 4294967295.0 / (2 * (double)bundle->grid);
    int shift, k;
    for (i = 0; i < count; i++) {
        const metro_vec3 *p = bundle->patches->patch[i].corner;
        metro_vec3 sum = metro_add(metro_add(p[0], p[1]), p[2]);
        from[2 * i] = (uint32_t)i;
        from[2 * i + 1] =
            (uint32_t)((metroi_rays_see(&bundle->lines, metro_scale(sum, 1.0 / 3)).z - low) * per_step);
    }
    for (shift = 0; shift < 33; shift += BITS) {
        uint32_t sum = 0;
        memset(start, 0, sizeof start);
        for (i = 0; i < count; i++) start[from[2 * i + 1] >> shift & (SIZE - 1)]++;
        for (k = 0; k < SIZE; k++) {
            uint32_t here = start[k];
            start[k] = sum;
            sum += here;
        }
        for (i = 0; i < count; i++) {
            uint32_t place = start[from[2 * i + 1] >> shift & (SIZE - 1)]++;
            to[2 * place] = from[2 * i];
            to[2 * place + 1] = from[2 * i + 1];
        }
        swap = from;
        from = to;
        to = swap;
    }
    /* Three passes: the result is in the second half. */
}

static void metroi_painter(metroi_bundle *bundle)
{
    size_t cells = bundle->rows * bundle->rows, count = bundle->patches->count, cell, i;
    const uint32_t *order = bundle->order + 2 * count;
    uint32_t *picture = bundle->cell; /* twice the patch, plus 1 if it looks up */
    memset(picture, 0xff, cells * sizeof *picture);
    metroi_painter_order(bundle);
    for (i = 0; i < count; i++) {
        uint32_t patch = order[2 * i];
        metroi_outline outline = metroi_patch_outline(bundle, patch);
        int32_t row;
        if (!outline.seen) continue;
        for (row = outline.row; row < outline.row_end; row++) {
            size_t until = metroi_outline_cells(bundle, &outline, row, &cell);
            for (; cell < until; cell++) {
                uint32_t last = picture[cell];
                metroi_line_pair(bundle, last == METROI_NO_PATCH ? last : last >> 1, (int)(last & 1), patch,
                                 outline.up);
                picture[cell] = patch << 1 | (outline.up ? 1u : 0u);
            }
        }
    }
    for (cell = 0; cell < cells; cell++)
        if (picture[cell] != METROI_NO_PATCH)
            metroi_line_pair(bundle, picture[cell] >> 1, (int)(picture[cell] & 1), METROI_NO_PATCH, 0);
}

/* # 14.6 Infinitely many rays

   Let the lines of a row come ever closer. In the limit a row is no longer a comb of lines but a strip of light, and
   the lines that two patches share become a length. Nothing in the sweep counts lines: it exchanges stretches, and
   their ends need not be rounded. So the same code is exact along the row, and only the rows are samples
   (Szirmay-Kalos, Foris and Purgathofer 1998c take the limit in both directions by an analytic visibility). */

static void metroi_bundle_free(metroi_bundle *bundle)
{
    METRO_FREE(bundle->radiance);
    METRO_FREE(bundle->received);
    METRO_FREE(bundle->shadow);
    METRO_FREE(bundle->begin);
    METRO_FREE(bundle->row);
    METRO_FREE(bundle->pile);
    METRO_FREE(bundle->fragment);
    METRO_FREE(bundle->cell);
    METRO_FREE(bundle->order);
    memset(bundle, 0, sizeof *bundle);
}

static int metroi_bundle_allocate(metroi_bundle *bundle)
{
    size_t triangles = bundle->patches->scene->triangle_count + 1, count = bundle->patches->count + 1;
    int by_cell = bundle->visibility == METRO_FRAGMENTS || bundle->visibility == METRO_PAINTER;
    bundle->radiance = (double *)metroi_zeros(count, 4 * bundle->nodes * sizeof(double));
    bundle->received = (double *)metroi_zeros(count, 4 * bundle->nodes * sizeof(double));
    if (bundle->radiance == NULL || bundle->received == NULL) return 0;
    if (!by_cell) {
        bundle->shadow = (metroi_shadow *)metroi_zeros(triangles, sizeof *bundle->shadow);
        bundle->begin = (uint32_t *)metroi_zeros(bundle->rows, sizeof *bundle->begin);
        bundle->row = (metroi_shadow **)metroi_zeros(triangles, sizeof *bundle->row);
        bundle->pile = (metroi_shadow **)metroi_zeros(triangles, sizeof *bundle->pile);
        return bundle->shadow != NULL && bundle->begin != NULL && bundle->row != NULL && bundle->pile != NULL;
    }
    bundle->cell = (uint32_t *)metroi_zeros(bundle->rows * bundle->rows, sizeof *bundle->cell);
    if (bundle->cell == NULL) return 0;
    if (bundle->visibility == METRO_PAINTER) {
        bundle->order = (uint32_t *)metroi_zeros(count, 4 * sizeof *bundle->order);
        return bundle->order != NULL;
    }
    bundle->fragment_room = metroi_fragments_most(bundle->patches, bundle->grid);
    bundle->fragment =
        (struct metroi_fragment *)metroi_zeros(bundle->fragment_room, sizeof *bundle->fragment);
    return bundle->fragment != NULL;
}

static metro_result metroi_bundle_make(const metro_patches *patches, size_t grid, metro_visibility visibility,
                                       int linear, metroi_bundle *bundle)
{
    size_t i;
    memset(bundle, 0, sizeof *bundle);
    bundle->patches = patches;
    bundle->grid = grid;
    bundle->rows = grid + 3; /* the sphere, the shift, and rounding at either end */
    bundle->touch = 1e-7 * (double)grid;
    bundle->visibility = visibility;
    bundle->nodes = linear ? 3 : 1;
    if (!metroi_bundle_allocate(bundle)) {
        metroi_bundle_free(bundle);
        return METRO_ERROR_MEMORY;
    }
    for (i = 0; i < bundle->nodes * patches->count; i++) bundle->radiance[4 * i + 3] = 1;
    return METRO_OK;
}

/* Moves bundle->radiance along `direction`; bundle->received gets the sums over lines. */

static void metroi_bundle_move(metroi_bundle *bundle, metro_vec3 direction, const double shift[2])
{
    bundle->lines = metroi_rays_make(bundle->patches, direction, bundle->grid, shift);
    bundle->lines.x += 1;
    bundle->lines.y += 1;
    memset(bundle->received, 0, 4 * bundle->nodes * bundle->patches->count * sizeof *bundle->received);
    memset(bundle->escaped, 0, sizeof bundle->escaped);
    memset(bundle->absorbed, 0, sizeof bundle->absorbed);
    switch (bundle->visibility) {
    case METRO_SWEEP: metroi_sweep(bundle, 1); break;
    case METRO_FRAGMENTS: metroi_fragments(bundle); break;
    case METRO_PAINTER: metroi_painter(bundle); break;
    case METRO_LINES: metroi_sweep(bundle, 0); break;
    }
}

/* The area of a cell, c^2. */
static double metroi_bundle_cell(const metroi_bundle *bundle)
{
    double side = 2 * bundle->patches->radius / (double)bundle->grid;
    return side * side;
}

static metro_vec3 metroi_color_of(const double *four, double scale)
{
    return metro_vec3_make(four[0] * scale, four[1] * scale, four[2] * scale);
}

static void metroi_bundle_balance(const metroi_bundle *bundle, metro_bundle_balance *balance)
{
    double cell = metroi_bundle_cell(bundle), left[3] = { 0, 0, 0 }, arrived[3] = { 0, 0, 0 };
    size_t i, c;
    for (i = 0; i < bundle->patches->count; i++)
        for (c = 0; c < 3; c++) {
            left[c] += bundle->received[4 * i + 3] * bundle->radiance[4 * i + c];
            arrived[c] += bundle->received[4 * i + c];
        }
    balance->left = metroi_color_of(left, cell);
    balance->arrived = metroi_color_of(arrived, cell);
    balance->escaped = metroi_color_of(bundle->escaped, cell);
    balance->absorbed = metroi_color_of(bundle->absorbed, cell);
}

METRO_API metro_result metro_bundle_transfer(const metro_patches *patches, metro_vec3 direction, size_t grid,
                                             const double shift[2], metro_visibility visibility,
                                             const metro_vec3 *radiance, metro_vec3 *received,
                                             metro_bundle_balance *balance)
{
    const double none[2] = { 0, 0 };
    metroi_bundle bundle;
    metro_result result;
    double cell;
    size_t i;
    if (patches == NULL || patches->scene == NULL) return METRO_ERROR_ARGUMENT;
    if (radiance == NULL || received == NULL) return METRO_ERROR_ARGUMENT;
    if (grid < 1 || grid > METROI_GRID_MOST || isnan(metro_normalize(direction).x)) return METRO_ERROR_ARGUMENT;
    if (visibility < METRO_SWEEP || visibility > METRO_LINES) return METRO_ERROR_ARGUMENT;
    if (shift == NULL) shift = none;
    if (!(shift[0] >= 0 && shift[0] < 1 && shift[1] >= 0 && shift[1] < 1)) return METRO_ERROR_ARGUMENT;
    result = metroi_bundle_make(patches, grid, visibility, 0, &bundle);
    if (result != METRO_OK) return result;
    bundle.balance = balance != NULL;
    for (i = 0; i < patches->count; i++) {
        bundle.radiance[4 * i] = radiance[i].x;
        bundle.radiance[4 * i + 1] = radiance[i].y;
        bundle.radiance[4 * i + 2] = radiance[i].z;
    }
    metroi_bundle_move(&bundle, direction, shift);
    cell = metroi_bundle_cell(&bundle);
    for (i = 0; i < patches->count; i++)
        received[i] = metroi_color_of(bundle.received + 4 * i, cell / patches->patch[i].area); /* eq 14.4 */
    if (balance != NULL) metroi_bundle_balance(&bundle, balance);
    metroi_bundle_free(&bundle);
    return METRO_OK;
}

METROI_WARM

/* # 14.7 Walks

   A walk is a list of D directions. Along the first one all patches send their emission. Along the k-th they send
   their emission again, and what the bundle before brought them, reflected from direction k - 1 into direction k. The
   last bundle is reflected to the eye (paper 3.3):

       x_1 = L^e,   x_{k+1} = L^e + 2 pi F(omega_k, omega_{k+1}) A(omega_k) x_k                              (14.8)

   and the walk's estimate is what x_{D+1} has beyond the emission. Written out it is a sum over the bundles in which
   the emission set out: emission of bundle D arrives after one reflection, that of bundle D - 1 after two, that of
   the first one after D. With independent uniform directions each product is an unbiased estimate of its iterated
   integral (eq 14.4), so one walk serves paths of all lengths up to D + 1 edges, each once.

   What arrived must be kept with the direction it came from, because a glossy surface reflects it into a lobe about
   the mirror direction; but for one step only: then the direction is used up. So radiance needs no table over
   directions, and a bundle no more memory than one colour a patch. The BRDF depends on the normal and the two
   directions, so it is the same for all patches of a triangle. */

typedef struct metroi_batch metroi_batch;

/* What all walks share. */
typedef struct {
    const metro_scene *scene;
    metro_bundles_options options;
    metro_patches patches;   /* the lists are those of the metro_bundles, which may be moved */
    const double *share;
    metroi_camera camera;
    metroi_surface *surface;
    metroi_facet *facet;     /* [triangle_count] */
    metro_vec3 *to_eye;      /* [count]: of length 1, or zero where the eye sees the back */
    size_t directions;       /* D, one less after a first shot */
    metro_axis *axis;
    size_t axis_count;
    metroi_batch *batch;     /* [options->batches] */
    uint64_t key;
    uint64_t rounds;         /* made so far, of one walk a batch */
    uint64_t at_once;        /* how many a batch makes before it waits for the others */
    int started;             /* the chains have looked for their starts */
    size_t alive;            /* chains that found a start */
    metro_bundles *shown;    /* whose numbers grow, and whom to ask whether to stop */
    int (*stop)(const metro_bundles *bundles, void *user);
    void *user;
} metroi_bundles;

/* An independent series of walks. */
struct metroi_batch {
    metroi_bundles *plan;
    metroi_bundle bundle;
    double *out;             /* [3 * nodes * count]: what the walk at work sends to the eye */
    double *sum;             /* [3 * nodes * count]: the sum over walks */
    metro_vec3 *lit_from;    /* [count]: after a first shot, where the lamp is, */
    double *lit;             /* [3 * count]: its irradiance, */
    double *lit_share;       /* [3 * count]: and what of it goes to each value of a patch that is linear, or NULL */
    double *state;           /* directions, shifts and the number of the shot */
    metro_chain chain;
    double scale;            /* what the samples of the chain count: Veach's weight, or 1 */
    int alive;
    uint64_t bundles, rays;
};

/* The side of `normal` that the line of `direction` arrives from or leaves to: its front. */

METROI_INLINE metro_vec3 metroi_front(metro_vec3 normal, metro_vec3 direction)
{
    return metro_dot(normal, direction) < 0 ? metro_scale(direction, -1) : direction;
}

static const metroi_surface *metroi_surface_of(const metroi_bundles *plan, size_t triangle)
{
    return &plan->surface[plan->scene->material_of[triangle]];
}

/* What a patch sends into `out`: its emission, or after a first shot the reflected light of the lamp. */

METROI_INLINE metro_vec3 metroi_patch_source(const metroi_batch *batch, const metroi_surface *surface,
                                             metro_vec3 normal, metro_vec3 out, size_t patch)
{
    const double *lit = batch->lit;
    metro_vec3 f;
    if (lit == NULL) return surface->emission;
    lit += 3 * patch;
    if (surface->black) return metro_vec3_make(0, 0, 0);
    f = surface->share < 1 ? metroi_surface_scatter(surface, normal, batch->lit_from[patch], out).value
                           : surface->diffuse;
    return metro_vec3_make(f.x * lit[0], f.y * lit[1], f.z * lit[2]);
}

/* What value k of a patch received, times the area of the patch. */

METROI_INLINE double metroi_patch_received(const metroi_bundle *bundle, size_t patch, size_t k, size_t c)
{
    const double *m = bundle->received + 4 * bundle->nodes * patch + c;
    return bundle->nodes == 1 ? m[0] : 12 * m[4 * k] - 3 * (m[0] + m[4] + m[8]); /* eq 14.5 */
}

METROI_INLINE double metroi_patch_lit(const metroi_batch *batch, size_t patch, size_t k)
{
    return batch->lit_share != NULL ? batch->lit_share[3 * patch + k] : 1;
}

/* Fills the bundle with what all patches send along `out`, of which `in` is the direction of the bundle before, or
   NULL: eq 14.8. */

static void metroi_walk_send(metroi_batch *batch, const metro_vec3 *in, metro_vec3 out)
{
    const metroi_bundles *plan = batch->plan;
    const metro_patches *patches = &plan->patches;
    const metroi_bundle *bundle = &batch->bundle;
    double *radiance = bundle->radiance, cell = metroi_bundle_cell(bundle);
    size_t triangle, patch, k, nodes = bundle->nodes;
    for (triangle = 0; triangle < plan->scene->triangle_count; triangle++) {
        const metroi_surface *surface = metroi_surface_of(plan, triangle);
        metro_vec3 normal = plan->facet[triangle].normal, to, f = metro_vec3_make(0, 0, 0);
        size_t first = patches->first[triangle], end = patches->first[triangle + 1];
        if (first == end) continue;
        to = metroi_front(normal, out);
        if (in != NULL && !surface->black) {
            f = metroi_surface_scatter(surface, normal, metroi_front(normal, *in), to).value;
            f = metro_scale(f, 2 * METROI_PI * cell / patches->patch[first].area); /* eq 14.4 */
        }
        for (patch = first; patch < end; patch++) {
            metro_vec3 source = metroi_patch_source(batch, surface, normal, to, patch);
            for (k = 0; k < nodes; k++) {
                double *sent = radiance + 4 * (nodes * patch + k), lit = metroi_patch_lit(batch, patch, k);
                sent[0] = source.x * lit + f.x * metroi_patch_received(bundle, patch, k, 0);
                sent[1] = source.y * lit + f.y * metroi_patch_received(bundle, patch, k, 1);
                sent[2] = source.z * lit + f.z * metroi_patch_received(bundle, patch, k, 2);
            }
        }
    }
}

/* The last step, to the eye. From each patch it is in another direction. */

static void metroi_walk_show(metroi_batch *batch, const metro_vec3 *in, double *out)
{
    const metroi_bundles *plan = batch->plan;
    const metroi_bundle *bundle = &batch->bundle;
    double cell = 2 * METROI_PI * metroi_bundle_cell(bundle);
    size_t i, k, nodes = bundle->nodes;
    memset(out, 0, 3 * nodes * plan->patches.count * sizeof *out);
    for (i = 0; i < plan->patches.count; i++) {
        const metro_patch *patch = &plan->patches.patch[i];
        const metroi_surface *surface = metroi_surface_of(plan, patch->triangle);
        metro_vec3 eye = plan->to_eye[i], f = surface->diffuse, source = metro_vec3_make(0, 0, 0);
        double scale = in != NULL ? cell / patch->area : 0; /* eq 14.4 */
        if (surface->black) continue;
        if (surface->share < 1 && in != NULL)
            f = metroi_surface_scatter(surface, patch->normal, metroi_front(patch->normal, *in), eye).value;
        if (batch->lit != NULL) source = metroi_patch_source(batch, surface, patch->normal, eye, i);
        for (k = 0; k < nodes; k++) {
            double *shown = out + 3 * (nodes * i + k), lit = metroi_patch_lit(batch, i, k);
            shown[0] = source.x * lit + f.x * scale * metroi_patch_received(bundle, i, k, 0);
            shown[1] = source.y * lit + f.y * scale * metroi_patch_received(bundle, i, k, 1);
            shown[2] = source.z * lit + f.z * scale * metroi_patch_received(bundle, i, k, 2);
        }
    }
}

/* # 14.8 The first shot

   Light that comes straight from a lamp is the hardest for bundles: a small lamp is met by few lines, and the patches
   that it lights brightly differ from walk to walk. Shadow rays do it better: Szirmay-Kalos and Purgathofer (1998)
   shoot the light of point lamps beforehand. Ours have an area: in each walk one ray goes from a random point p of
   each patch to a random point y of a lamp, and

       H_i = frac{L^e cos(theta_p) cos(theta_y)}{d^2 p_A} V(p, y)                     (14.9)

   with p_A of eq 11.3 is an unbiased estimate of the mean irradiance of the patch. From there on the patches send
   what they reflect of it in place of their emission, and the walk has one direction less.

   Where a lamp and a patch meet in an edge, d can be as small as one likes, and with P(H > h) falling as h^{-3/2} the
   variance of H is infinite: such a patch is right in the mean, but more often too dark than too bright, and the
   error that is stated of it is too small. A lamp that hangs a little free, as lamps do, has no such edge. */

static void metroi_shoot_patch(metroi_batch *batch, size_t i, metro_rng *rng)
{
    const metroi_bundles *plan = batch->plan;
    const metro_scene *scene = plan->scene;
    const metro_patch *patch = &plan->patches.patch[i];
    double u = metro_rng_uniform(rng), v = metro_rng_uniform(rng), root, distance2, cos_p, cos_y, h;
    double choice = metro_rng_uniform(rng), across = metro_rng_uniform(rng);
    uint32_t lamp = metroi_light_choose(scene, &choice);
    const metroi_facet *facet = &plan->facet[lamp];
    const metroi_surface *glow = metroi_surface_of(plan, lamp);
    metro_vec3 p, y = metroi_light_point(facet, choice, across), d, from;
    memset(batch->lit + 3 * i, 0, 3 * sizeof(double));
    batch->lit_from[i] = patch->normal;
    if (metroi_surface_of(plan, patch->triangle)->black || lamp == patch->triangle) return;
    root = sqrt(u);
    p = metroi_between(patch->corner, root * (1 - v), root * v);
    d = metro_subtract(y, p);
    distance2 = metro_dot(d, d);
    if (!(distance2 > 0)) return;
    d = metro_scale(d, 1 / sqrt(distance2));
    cos_p = metro_dot(patch->normal, d);
    cos_y = -metro_dot(facet->normal, d);
    if (!(cos_p > 0) || !(cos_y > 0)) return;
    from = metroi_facet_leave(&plan->facet[patch->triangle], p, d);
    y = metroi_facet_leave(facet, y, metro_scale(d, -1));
    batch->rays++;
    if (!metroi_scene_open(scene, from, y)) return;
    h = cos_p * cos_y / (distance2 * metroi_light_density(scene, glow)); /* eq 14.9 */
    batch->lit_from[i] = d;
    if (batch->lit_share != NULL) { /* eq 14.5 for a single point, whose density is 1/A */
        batch->lit_share[3 * i] = 12 * (1 - root) - 3;
        batch->lit_share[3 * i + 1] = 12 * root * (1 - v) - 3;
        batch->lit_share[3 * i + 2] = 12 * root * v - 3;
    }
    batch->lit[3 * i] = h * glow->emission.x;
    batch->lit[3 * i + 1] = h * glow->emission.y;
    batch->lit[3 * i + 2] = h * glow->emission.z;
}

/* A whole walk: `z` holds the directions and then two numbers a direction, the shift of its grid. Each bundle has a
   shift of its own, or the errors of two bundles of a walk would not be independent. */

static void metroi_bundles_walk(metroi_batch *batch, const double *z, metro_rng *shots, double *out)
{
    const metroi_bundles *plan = batch->plan;
    size_t d = plan->directions, k, i;
    const double *shift = z + 3 * d;
    metro_vec3 in = metro_vec3_make(0, 0, 1), direction;
    for (i = 0; batch->lit != NULL && i < plan->patches.count; i++) metroi_shoot_patch(batch, i, shots);
    for (k = 0; k < d; k++) {
        direction = metro_vec3_make(z[3 * k], z[3 * k + 1], z[3 * k + 2]);
        metroi_walk_send(batch, k > 0 ? &in : NULL, direction);
        metroi_bundle_move(&batch->bundle, direction, shift + 2 * k);
        in = direction;
    }
    metroi_walk_show(batch, d > 0 ? &in : NULL, out);
    batch->bundles += d;
}

METROI_COLD

/* # 14.9 Random and even walks

   The D directions of a walk are one point of a space of 2 D dimensions, and this space can be filled evenly (section
   2.3): walk number w is point number w, and direction k takes its coordinates 2 k and 2 k + 1. Each batch has a
   scramble of its own, so that the batches are independent and their spread states the error.

   It is tempting to save coordinates and to take the next direction from the next point of a sequence in two
   dimensions. Such a sequence mirrors the digits of the number of the point, in base 2 for one coordinate and in base
   3 for the other (Halton 1960):

       h_b(n_1 + n_2 b + n_3 b^2 + ...) = frac{n_1}{b} + frac{n_2}{b^2} + frac{n_3}{b^3} + ...               (14.10)

   But then every other point has the first coordinate of the one before it, plus 1/2: neighbours avoid each other.
   The pairs of two directions lie on a few lines of the square of their coordinates and do not fill it, however many
   walks are made, so the products of eq 14.8 are integrated over a part of the space only. The picture converges, and
   it is wrong. A random shift of the whole sequence, modulo 1, makes the batches independent and does not help.

   [figure: runon.svg | A sequence that runs on converges to a wrong answer: error against walks.] */

static double metroi_halton(uint64_t n, unsigned base)
{
    double x = 0, digit = 1;
    for (; n > 0; n /= base) {
        digit /= base;
        x += digit * (double)(n % base); /* eq 14.10 */
    }
    return x;
}

/* Coordinate 0 or 1 of direction k in walk `round` of a batch. */

static double metroi_walk_coordinate(const metroi_bundles *plan, uint64_t round, size_t k, unsigned c,
                                     uint64_t scramble, metro_rng *rng)
{
    unsigned dimension = 2 * (unsigned)k + c;
    double x = metro_rng_uniform(rng);
    if (plan->options.walk != METRO_WALK_EVEN) return x;
    if (!plan->options.run_on) return dimension < 32 ? metro_sobol(round, dimension, scramble) : x;
    x = metroi_halton(round * plan->directions + k, c == 0 ? 2 : 3) + metro_sobol(0, c, scramble);
    return x < 1 ? x : x - 1;
}

static void metroi_walk_choose(metroi_batch *batch, uint64_t round, uint64_t scramble, metro_rng *rng)
{
    const metroi_bundles *plan = batch->plan;
    size_t d = plan->directions, k;
    for (k = 0; k < d; k++) {
        double height = 1 - 2 * metroi_walk_coordinate(plan, round, k, 0, scramble, rng);
        double turn = metroi_walk_coordinate(plan, round, k, 1, scramble, rng);
        metroi_direction_put(metroi_direction_at(metro_vec3_make(0, 0, 1), height, turn), batch->state + 3 * k);
    }
    for (k = 3 * d; k < 5 * d; k++) batch->state[k] = metro_rng_uniform(rng);
}

/* Walk number `round` of a batch. */
static void metroi_walk_draw(metroi_bundles *plan, size_t index, uint64_t round)
{
    metroi_batch *batch = &plan->batch[index];
    metro_rng rng = metro_rng_make(plan->key, round * plan->options.batches + index);
    size_t i;
    metroi_walk_choose(batch, round, metroi_mix(plan->key + index), &rng);
    metroi_bundles_walk(batch, batch->state, &rng, batch->out);
    for (i = 0; i < 3 * batch->bundle.nodes * plan->patches.count; i++) batch->sum[i] += batch->out[i];
}

/* # 14.10 Metropolis walks

   The state of the chain is a walk: D directions, and the shifts of the grids, which belong to it because under
   another shift the same directions give another contribution, perhaps none. After a first shot one more coordinate
   numbers the shadow rays. The importance is the luminance that the walk adds to the picture: with $v_i$ the share of
   the picture that shows patch i, and $Y_i$ the luminance of what it sends to the eye,

       I = abs(sum_{i} v_i Y_i)                                                       (14.11)

   A mutation perturbs all directions inside a cone, or one of them; the grids move by up to as much as the rim of the
   scene does. What a state adds to the sums is its contribution over I, and the sums are scaled by b (eq 4.1).

   Only where radiance is linear can the sum be below 0; then I passes 0 where the contribution does not, f/I has no
   bound, and Metropolis walks are better left to constant radiance. A bundle serves the whole picture at once, so the
   integrand is smoother than that of single paths, and the paper concludes that Metropolis sampling gains less by it.

   [figure: fig8.svg | Error against walks: Metropolis walks with several sizes, random and even walks (figure 8 of
   the paper).] */

/* The luminance of patch i: of the mean of its values. */

static double metroi_patch_luminance(const double *out, size_t nodes, size_t i)
{
    double sum = 0;
    size_t k;
    for (k = nodes * i; k < nodes * (i + 1); k++) sum += metro_luminance(out[3 * k], out[3 * k + 1], out[3 * k + 2]);
    return sum / (double)nodes;
}

static double metroi_walk_importance(const double *z, void *sample, void *user)
{
    metroi_batch *batch = (metroi_batch *)user;
    const metroi_bundles *plan = batch->plan;
    double *out = (double *)sample, importance = 0;
    size_t count = plan->patches.count, i;
    metro_rng shots;
    uint64_t number = 0;
    if (plan->options.first_shot) memcpy(&number, z + 5 * plan->directions, sizeof number);
    shots = metro_rng_make(plan->key, number);
    metroi_bundles_walk(batch, z, &shots, out);
    for (i = 0; i < count; i++)
        importance += plan->share[i] * metroi_patch_luminance(out, batch->bundle.nodes, i); /* eq 14.11 */
    importance = fabs(importance);
    out[3 * batch->bundle.nodes * count] = importance;
    return importance;
}

static void metroi_walk_record(const void *sample, double weight, void *user)
{
    metroi_batch *batch = (metroi_batch *)user;
    const double *out = (const double *)sample;
    size_t count = 3 * batch->bundle.nodes * batch->plan->patches.count, i;
    weight *= batch->scale / out[count]; /* eq 4.1 */
    for (i = 0; i < count; i++) batch->sum[i] += weight * out[i];
}

/* One direction and the shift of its grid, each as likely chosen on the way back. */

static double metroi_walk_propose_one(const double *from, double *to, metro_rng *rng, void *user)
{
    const metroi_bundles *plan = ((const metroi_batch *)user)->plan;
    size_t d = plan->directions, doubles = 5 * d + (plan->options.first_shot ? 1u : 0u), k, i;
    memcpy(to, from, doubles * sizeof *to);
    if (plan->options.first_shot) to[5 * d] = metro_rng_uniform(rng);
    if (d == 0) return 1;
    k = (size_t)metro_rng_below(rng, d);
    metroi_direction_perturb(&plan->axis[k].kernel, from + 3 * k, to + 3 * k, rng);
    for (i = 0; i < 2; i++)
        to[3 * d + 2 * k + i] = metro_kernel_perturb(&plan->axis[d + 2 * k + i].kernel, from[3 * d + 2 * k + i], rng);
    return 1;
}

static metro_result metroi_walk_axes(metroi_bundles *plan)
{
    size_t d = plan->directions, i;
    double half_angle = 0.5 * plan->options.perturbation, moved = half_angle * (double)plan->options.grid;
    plan->axis_count = 3 * d + (plan->options.first_shot ? 1u : 0u);
    plan->axis = (metro_axis *)metroi_zeros(plan->axis_count, sizeof *plan->axis);
    if (plan->axis == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i < d; i++) plan->axis[i] = metroi_axis_make(METRO_DIRECTION, METRO_UNIFORM, half_angle, 0);
    for (; i < 3 * d; i++) plan->axis[i] = metroi_axis_make(METRO_CIRCLE, METRO_UNIFORM, moved < 1 ? moved : 1, 0);
    for (; i < plan->axis_count; i++) plan->axis[i] = metroi_axis_make(METRO_CIRCLE, METRO_UNIFORM, 1, 0);
    return METRO_OK;
}

static metro_result metroi_walk_chain(metroi_batch *batch, uint64_t index)
{
    const metroi_bundles *plan = batch->plan;
    metro_chain_options options;
    metro_target target;
    memset(&target, 0, sizeof target);
    target.axes = plan->axis;
    target.axis_count = plan->axis_count;
    target.sample_size = (3 * batch->bundle.nodes * plan->patches.count + 1) * sizeof(double);
    target.importance = metroi_walk_importance;
    target.record = metroi_walk_record;
    target.propose = plan->options.one_direction ? metroi_walk_propose_one : NULL;
    target.user = batch;
    options.large_step = plan->options.large_step;
    options.expected_values = 1;
    return metro_chain_make(&target, &options, metro_rng_make(plan->key, index), &batch->chain);
}

/* Starts as in section 13.4. */

static metro_result metroi_walk_start(uint64_t job, void *slot, void *user)
{
    metroi_bundles *plan = (metroi_bundles *)user;
    metroi_batch *batch = &plan->batch[job];
    const metro_bundles_options *options = &plan->options;
    metro_result result;
    (void)slot;
    if (options->start == METRO_START_POINT) {
        metro_chain_survey(&batch->chain, options->candidates);
        result = metroi_start_point(&batch->chain, batch->state, options->start_seed, job, options->candidates);
    } else {
        result = metro_chain_start_weighted(&batch->chain, options->candidates);
        if (result == METRO_ERROR_NO_IMPORTANCE && options->start == METRO_START_SEEDS)
            result = metroi_start_again(&batch->chain, options->candidates);
    }
    batch->alive = result == METRO_OK;
    batch->scale = options->start == METRO_START_WEIGHTED ? batch->chain.start_weight : 1;
    return result == METRO_ERROR_NO_IMPORTANCE ? METRO_OK : result;
}

/* A step of one chain. Without large steps b needs a draw of its own now and then: one for sixteen mutations. */

static void metroi_walk_step(metroi_bundles *plan, size_t index, uint64_t round)
{
    metroi_batch *batch = &plan->batch[index];
    if (!batch->alive) return;
    metro_chain_run(&batch->chain, 1);
    if (!(plan->options.large_step > 0) && round % 16 == 15) metro_chain_survey(&batch->chain, 1);
}

/* # 14.11 The picture

   The last step is a final gathering: through each pixel go 6 x 6 rays, and each sees the radiance of the patch that
   it meets. No two of them are in one column or one row of 36 x 36 cells of the pixel, so that even an edge along the
   pixels is seen where it is to a 36th. Each pixel shifts them by random numbers of its own, round its borders, so
   that what neighbouring pixels miss is independent. The share v_i of a patch in the picture is what the same rays
   find, so that no patch is seen whose light a chain does not look for.

   [figure: fig7.svg | A room with diffuse and specular surfaces, its lamp hidden from the eye (figure 7 of the
   paper).] */

enum { METROI_GATHER_JOBS = 16, METROI_GATHER_SIDE = 6,
       METROI_GATHER_RAYS = METROI_GATHER_SIDE * METROI_GATHER_SIDE };

/* The patch that the ray through (x, y) sees from its front, and where it was hit; the number of patches if there is
   none. */

static size_t metroi_bundles_look(const metroi_bundles *plan, double x, double y, metro_hit *hit)
{
    metro_vec3 direction = metroi_camera_direction(&plan->camera, x, y);
    if (!metro_scene_hit(plan->scene, plan->camera.eye, direction, 0, METROI_INFINITY, hit)
        || !(metro_dot(plan->facet[hit->triangle].normal, direction) < 0))
        return plan->patches.count;
    return metro_patches_at(&plan->patches, hit->triangle, hit->u, hit->v);
}

static void metroi_gather_shift(const metroi_bundles *plan, size_t x, size_t y, double shift[2])
{
    metro_rng rng = metro_rng_make(metroi_mix(plan->key + 2), y * plan->options.width + x);
    shift[0] = metro_rng_uniform(&rng);
    shift[1] = metro_rng_uniform(&rng);
}

/* What ray number `ray` through pixel (x, y) sees. */

static size_t metroi_gather_look(const metroi_bundles *plan, size_t x, size_t y, const double shift[2], int ray,
                                 metro_hit *hit)
{
    const int side = METROI_GATHER_SIDE, column = ray % side, row = ray / side;
    double u = (double)(column * side + row) / (double)METROI_GATHER_RAYS + shift[0];
    double v = (double)(row * side + column) / (double)METROI_GATHER_RAYS + shift[1];
    return metroi_bundles_look(plan, (double)x + (u < 1 ? u : u - 1), (double)y + (v < 1 ? v : v - 1), hit);
}

static void metroi_bundles_shares(const metroi_bundles *plan, double *share)
{
    size_t x, y;
    int ray;
    for (y = 0; y < plan->options.height; y++)
        for (x = 0; x < plan->options.width; x++) {
            double shift[2];
            metroi_gather_shift(plan, x, y, shift);
            for (ray = 0; ray < METROI_GATHER_RAYS; ray++) {
                metro_hit hit;
                size_t patch = metroi_gather_look(plan, x, y, shift, ray, &hit);
                if (patch < plan->patches.count) share[patch] += 1;
            }
        }
    for (x = 0; x < plan->patches.count; x++)
        share[x] /= (double)METROI_GATHER_RAYS * (double)plan->options.width * (double)plan->options.height;
}

static void metroi_bundles_free(metroi_bundles *plan)
{
    size_t i;
    for (i = 0; plan->batch != NULL && i < plan->options.batches; i++) {
        metroi_batch *batch = &plan->batch[i];
        metro_chain_free(&batch->chain);
        metroi_bundle_free(&batch->bundle);
        METRO_FREE(batch->out);
        METRO_FREE(batch->sum);
        METRO_FREE(batch->lit_from);
        METRO_FREE(batch->lit);
        METRO_FREE(batch->lit_share);
        METRO_FREE(batch->state);
    }
    METRO_FREE(plan->batch);
    METRO_FREE(plan->surface);
    METRO_FREE(plan->facet);
    METRO_FREE(plan->to_eye);
    METRO_FREE(plan->axis);
    METRO_FREE(plan);
}

METRO_API void metro_bundles_free(metro_bundles *bundles)
{
    if (bundles->state != NULL) metroi_bundles_free((metroi_bundles *)bundles->state);
    METRO_FREE(bundles->share);
    metro_patches_free(&bundles->patches);
    memset(bundles, 0, sizeof *bundles);
}

static metro_bundles_options metroi_bundles_defaults(const metro_bundles_options *given)
{
    metro_bundles_options options;
    memset(&options, 0, sizeof options);
    if (given != NULL) options = *given;
    if (options.width == 0) options.width = 128;
    if (options.height == 0) options.height = 128;
    if (options.depth == 0) options.depth = 8;
    if (options.batches == 0) options.batches = 16;
    if (options.threads == 0) options.threads = metro_core_count();
    if (options.candidates == 0) options.candidates = 16;
    if (options.perturbation == 0) options.perturbation = 0.6;
    return options;
}

static metro_result metroi_bundles_check(const metro_scene *scene, const metro_camera *camera,
                                         const metro_bundles_options *options)
{
    size_t pixels;
    int fits = metroi_size_multiply(options->width, options->height, &pixels) && pixels <= 0x1fffffff;
    if (scene == NULL || scene->bvh == NULL || camera == NULL) return METRO_ERROR_ARGUMENT;
    if (metro_camera_check(camera) != METRO_OK || !fits) return METRO_ERROR_ARGUMENT;
    if (options->depth < 2 || options->depth > METRO_DEPTH_MOST) return METRO_ERROR_ARGUMENT;
    if (!(options->patch >= 0)) return METRO_ERROR_ARGUMENT;
    if (options->grid > METROI_GRID_MOST) return METRO_ERROR_ARGUMENT;
    if (options->visibility < METRO_SWEEP || options->visibility > METRO_LINES) return METRO_ERROR_ARGUMENT;
    if (options->walk < METRO_WALK_RANDOM || options->walk > METRO_WALK_METROPOLIS) return METRO_ERROR_ARGUMENT;
    if (options->start < METRO_START_SEEDS || options->start > METRO_START_WEIGHTED) return METRO_ERROR_ARGUMENT;
    if (options->linear && options->visibility != METRO_SWEEP && options->visibility != METRO_LINES)
        return METRO_ERROR_ARGUMENT;
    if (options->batches < 2 || options->batches > METROI_LARGEST_CHAINS) return METRO_ERROR_ARGUMENT;
    if (!(options->large_step >= 0 && options->large_step <= 1)) return METRO_ERROR_ARGUMENT;
    if (!(options->perturbation > 0 && isfinite(options->perturbation))) return METRO_ERROR_ARGUMENT;
    return scene->light_count > 0 ? METRO_OK : METRO_ERROR_NO_LIGHT;
}

/* A patch is six cells long unless the options say otherwise: a coarse grid with many walks is worth more than a fine
   one with few. After a first shot what is left to move comes from everywhere, and three cells do, where patches are
   not much narrower than long. */

static metro_result metroi_bundles_cut(metro_bundles *bundles)
{
    metro_bundles_options *options = &bundles->options;
    metro_vec3 low, high;
    double radius;
    if (metro_scene_bounds(bundles->scene, &low, &high) != METRO_OK) return METRO_ERROR_ARGUMENT;
    radius = 0.5 * metro_length(metro_subtract(high, low));
    if (options->patch == 0) options->patch = 0.1 * radius;
    if (options->grid == 0) {
        double cells = (options->first_shot ? 6 : 12) * radius / options->patch, most = METROI_GRID_MOST;
        options->grid = (size_t)(cells < 8 ? 8 : cells < most ? cells : most);
    }
    return metro_patches_make(bundles->scene, options->patch, &bundles->patches);
}

static metro_result metroi_batch_make(metroi_bundles *plan, size_t index)
{
    metroi_batch *batch = &plan->batch[index];
    const metro_bundles_options *options = &plan->options;
    size_t count = plan->patches.count + 1;
    metro_result result;
    batch->plan = plan;
    batch->scale = 1;
    result = metroi_bundle_make(&plan->patches, options->grid, options->visibility, options->linear, &batch->bundle);
    if (result != METRO_OK) return result;
    batch->out = (double *)metroi_zeros(count, 3 * batch->bundle.nodes * sizeof(double));
    batch->sum = (double *)metroi_zeros(count, 3 * batch->bundle.nodes * sizeof(double));
    batch->state = (double *)metroi_zeros(5 * plan->directions + 1, sizeof(double));
    if (batch->out == NULL || batch->sum == NULL || batch->state == NULL) return METRO_ERROR_MEMORY;
    if (options->first_shot) {
        batch->lit = (double *)metroi_zeros(count, 3 * sizeof(double));
        batch->lit_from = (metro_vec3 *)metroi_zeros(count, sizeof *batch->lit_from);
        if (batch->lit == NULL || batch->lit_from == NULL) return METRO_ERROR_MEMORY;
    }
    if (options->first_shot && options->linear) {
        batch->lit_share = (double *)metroi_zeros(count, 3 * sizeof(double));
        if (batch->lit_share == NULL) return METRO_ERROR_MEMORY;
    }
    return options->walk == METRO_WALK_METROPOLIS ? metroi_walk_chain(batch, index) : METRO_OK;
}

/* From the middle of each patch to the eye. */

static void metroi_bundles_aim(const metroi_bundles *plan)
{
    size_t i;
    for (i = 0; i < plan->patches.count; i++) {
        const metro_patch *patch = &plan->patches.patch[i];
        metro_vec3 middle = metro_add(metro_add(patch->corner[0], patch->corner[1]), patch->corner[2]);
        metro_vec3 eye = metro_normalize(metro_subtract(plan->camera.eye, metro_scale(middle, 1.0 / 3)));
        if (metro_dot(eye, patch->normal) > 0) plan->to_eye[i] = eye;
    }
}

static metro_result metroi_bundles_fill(metroi_bundles *plan, const metro_bundles *bundles,
                                        const metro_camera *camera)
{
    const metro_scene *scene = bundles->scene;
    metro_result result = METRO_OK;
    size_t i;
    plan->scene = scene;
    plan->options = bundles->options;
    plan->patches = bundles->patches;
    plan->share = bundles->share;
    plan->camera = metroi_camera_make(camera, bundles->options.width, bundles->options.height);
    plan->key = metroi_mix(bundles->options.seed ^ metroi_mix(bundles->options.part));
    plan->directions = (size_t)bundles->options.depth - (bundles->options.first_shot ? 2 : 1);
    plan->surface = (metroi_surface *)metroi_zeros(scene->material_count + 1, sizeof *plan->surface);
    plan->facet = (metroi_facet *)metroi_zeros(scene->triangle_count, sizeof *plan->facet);
    plan->to_eye = (metro_vec3 *)metroi_zeros(plan->patches.count + 1, sizeof *plan->to_eye);
    if (plan->surface == NULL || plan->facet == NULL || plan->to_eye == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; i <= scene->material_count; i++)
        plan->surface[i] = metroi_surface_make(metroi_scene_material(scene, (uint32_t)i));
    for (i = 0; i < scene->triangle_count; i++) plan->facet[i] = metroi_facet_of(scene, (uint32_t)i);
    metroi_bundles_aim(plan);
    if (plan->options.walk == METRO_WALK_METROPOLIS) result = metroi_walk_axes(plan);
    if (result != METRO_OK) return result;
    plan->batch = (metroi_batch *)metroi_zeros(plan->options.batches, sizeof *plan->batch);
    if (plan->batch == NULL) return METRO_ERROR_MEMORY;
    for (i = 0; result == METRO_OK && i < plan->options.batches; i++) result = metroi_batch_make(plan, i);
    if (result == METRO_OK) metroi_bundles_shares(plan, bundles->share);
    return result;
}

METRO_API metro_result metro_bundles_make(const metro_scene *scene, const metro_camera *camera,
                                          const metro_bundles_options *options, metro_bundles *bundles)
{
    metro_bundles made;
    metroi_bundles *plan = NULL;
    metro_result result;
    if (bundles == NULL) return METRO_ERROR_ARGUMENT;
    memset(&made, 0, sizeof made);
    made.scene = scene;
    made.options = metroi_bundles_defaults(options);
    result = metroi_bundles_check(scene, camera, &made.options);
    if (result == METRO_OK) result = metroi_bundles_cut(&made);
    if (result != METRO_OK) return result;
    made.share = (double *)metroi_zeros(made.patches.count + 1, sizeof *made.share);
    plan = (metroi_bundles *)metroi_zeros(1, sizeof *plan);
    made.state = plan;
    result = METRO_ERROR_MEMORY;
    if (made.share != NULL && plan != NULL) result = metroi_bundles_fill(plan, &made, camera);
    if (result == METRO_OK) *bundles = made;
    else metro_bundles_free(&made);
    return result;
}

/* A job is a batch. It makes one walk and waits for the others, so that somebody can ask whether to stop; where
   nobody does it makes all its walks, and no thread waits but at the end. */

static metro_result metroi_bundles_work(uint64_t job, void *slot, void *user)
{
    metroi_bundles *plan = (metroi_bundles *)user;
    size_t index = (size_t)(job % plan->options.batches);
    uint64_t round, end = plan->rounds + plan->at_once;
    (void)slot;
    for (round = plan->rounds; round < end; round++)
        if (plan->options.walk == METRO_WALK_METROPOLIS) metroi_walk_step(plan, index, round);
        else metroi_walk_draw(plan, index, round);
    return METRO_OK;
}

static int metroi_bundles_stop(uint64_t rounds, void *user)
{
    metroi_bundles *plan = (metroi_bundles *)user;
    metro_bundles *shown = plan->shown;
    size_t i;
    (void)rounds;
    plan->rounds += plan->at_once;
    shown->walks += plan->at_once * plan->options.batches;
    shown->bundles = shown->rays = 0;
    for (i = 0; i < plan->options.batches; i++) {
        shown->bundles += plan->batch[i].bundles;
        shown->rays += plan->batch[i].rays;
    }
    return plan->stop != NULL && plan->stop(shown, plan->user);
}

static metro_result metroi_bundles_start(metroi_bundles *plan)
{
    metro_rounds rounds;
    metro_result result;
    size_t i;
    memset(&rounds, 0, sizeof rounds);
    rounds.jobs = plan->options.batches;
    rounds.threads = plan->options.threads;
    rounds.work = metroi_walk_start;
    result = metro_rounds_run(&rounds, plan);
    if (result != METRO_OK) return result;
    for (plan->alive = i = 0; i < plan->options.batches; i++) plan->alive += plan->batch[i].alive ? 1u : 0u;
    return METRO_OK;
}

METRO_API metro_result metro_bundles_run(metro_bundles *bundles, uint64_t walks,
                                         int (*stop)(const metro_bundles *bundles, void *user), void *user)
{
    metroi_bundles *plan = bundles != NULL ? (metroi_bundles *)bundles->state : NULL;
    metro_rounds rounds;
    if (plan == NULL) return METRO_ERROR_ARGUMENT;
    if (walks == 0) return METRO_OK;
    if (plan->options.walk == METRO_WALK_METROPOLIS && !plan->started) {
        metro_result result = metroi_bundles_start(plan);
        if (result != METRO_OK) return result;
        plan->started = 1;
    }
    if (plan->options.walk == METRO_WALK_METROPOLIS && plan->alive == 0) return METRO_ERROR_NO_IMPORTANCE;
    plan->shown = bundles;
    plan->stop = stop;
    plan->user = user;
    memset(&rounds, 0, sizeof rounds);
    rounds.jobs = plan->options.batches;
    rounds.rounds = walks / rounds.jobs + (walks % rounds.jobs != 0);
    plan->at_once = stop == NULL ? rounds.rounds : 1;
    rounds.rounds /= plan->at_once;
    rounds.threads = plan->options.threads;
    rounds.work = metroi_bundles_work;
    rounds.stop = metroi_bundles_stop;
    return metro_rounds_run(&rounds, plan);
}

/* The factor of a batch's sums: one over its walks, and b for chains that do not carry Veach's weight (eq 4.1). Of
   these a chain that found no start is left out; one that would carry a weight counts as 0. */

static double metroi_bundles_b(const metroi_bundles *plan, double *error)
{
    metro_moments moments;
    size_t i;
    memset(&moments, 0, sizeof moments);
    for (i = 0; i < plan->options.batches; i++)
        metroi_moments_join(&moments, &plan->batch[i].chain.normalisation);
    *error = metroi_b_error(&moments);
    return metro_moments_mean(&moments);
}

typedef struct {
    double scale;   /* of the sums of a batch */
    double b_share; /* the relative error of b, where the scale has it */
    int all;        /* chains without a start count too */
} metroi_bundles_scale;

static metroi_bundles_scale metroi_bundles_scale_of(const metroi_bundles *plan)
{
    metroi_bundles_scale scale;
    double b, error;
    scale.scale = 1 / (double)plan->rounds;
    scale.b_share = 0;
    scale.all = 1;
    if (plan->options.walk != METRO_WALK_METROPOLIS || plan->options.start == METRO_START_WEIGHTED) return scale;
    b = metroi_bundles_b(plan, &error);
    scale.scale *= b;
    scale.b_share = error / b;
    scale.all = 0;
    return scale;
}

/* One number of the result from that of all batches: their mean, and its error. It is the mean of `count` sums that
   are a colour apart, the values of a patch. */

static double metroi_bundles_number(const metroi_bundles *plan, const metroi_bundles_scale *scale, size_t index,
                                    size_t count, double *error)
{
    metro_moments moments;
    double mean, spread;
    size_t i, k;
    memset(&moments, 0, sizeof moments);
    for (i = 0; i < plan->options.batches; i++) {
        double value = 0;
        for (k = 0; k < count; k++) value += plan->batch[i].sum[index + 3 * k];
        if (scale->all || plan->batch[i].alive) metro_moments_add(&moments, scale->scale * value / (double)count);
    }
    mean = metro_moments_mean(&moments);
    spread = metro_moments_error(&moments);
    *error = sqrt(spread * spread + mean * mean * scale->b_share * scale->b_share);
    return mean;
}

/* The means of `values` groups of `count` values each. */

static void metroi_bundles_numbers(const metroi_bundles *plan, size_t values, size_t count, metro_vec3 *radiance,
                                   metro_vec3 *error)
{
    metroi_bundles_scale scale = metroi_bundles_scale_of(plan);
    size_t i;
    for (i = 0; i < values; i++) {
        metro_vec3 mean, spread;
        mean.x = metroi_bundles_number(plan, &scale, 3 * count * i, count, &spread.x);
        mean.y = metroi_bundles_number(plan, &scale, 3 * count * i + 1, count, &spread.y);
        mean.z = metroi_bundles_number(plan, &scale, 3 * count * i + 2, count, &spread.z);
        radiance[i] = mean;
        if (error != NULL) error[i] = spread;
    }
}

METRO_API metro_result metro_bundles_radiance(const metro_bundles *bundles, metro_vec3 *radiance, metro_vec3 *error)
{
    const metroi_bundles *plan = bundles != NULL ? (const metroi_bundles *)bundles->state : NULL;
    if (plan == NULL || plan->rounds == 0 || radiance == NULL) return METRO_ERROR_ARGUMENT;
    metroi_bundles_numbers(plan, plan->patches.count, plan->options.linear ? 3 : 1, radiance, error);
    return METRO_OK;
}

/* The rows of the picture are shared out to sixteen jobs. */

typedef struct {
    const metroi_bundles *plan;
    const metro_vec3 *radiance; /* of all values of the patches */
    metro_image *image;
} metroi_gather;

/* The radiance at a hit of a patch: that of the patch, or linear between its corners. */

static metro_vec3 metroi_gather_at(const metroi_gather *gather, size_t patch, const metro_hit *hit)
{
    const metroi_bundles *plan = gather->plan;
    const metro_vec3 *value = gather->radiance + 3 * patch;
    int32_t n = (int32_t)plan->patches.cuts[hit->triangle], i, j, k;
    double u = hit->u * (double)n, v = hit->v * (double)n;
    if (!plan->options.linear) return gather->radiance[patch];
    metroi_patch_place(u, v, n, &i, &j, &k);
    u = k ? (double)(i + 1) - u : u - (double)i; /* the corners of section 14.1 */
    v = k ? (double)(j + 1) - v : v - (double)j;
    return metroi_between(value, u, v);
}

static void metroi_gather_pixel(const metroi_gather *gather, size_t x, size_t y)
{
    const metroi_bundles *plan = gather->plan;
    double *pixel = gather->image->value + 3 * (y * gather->image->width + x);
    const double share = 1.0 / (double)METROI_GATHER_RAYS;
    double shift[2];
    int ray;
    metroi_gather_shift(plan, x, y, shift);
    for (ray = 0; ray < METROI_GATHER_RAYS; ray++) {
        metro_vec3 seen;
        metro_hit hit;
        size_t patch = metroi_gather_look(plan, x, y, shift, ray, &hit);
        if (patch >= plan->patches.count) continue;
        seen = metro_add(metroi_gather_at(gather, patch, &hit), metroi_surface_of(plan, hit.triangle)->emission);
        pixel[0] += share * seen.x;
        pixel[1] += share * seen.y;
        pixel[2] += share * seen.z;
    }
}

static metro_result metroi_gather_work(uint64_t job, void *slot, void *user)
{
    const metroi_gather *gather = (const metroi_gather *)user;
    size_t x, y;
    (void)slot;
    for (y = (size_t)job; y < gather->image->height; y += METROI_GATHER_JOBS)
        for (x = 0; x < gather->image->width; x++) metroi_gather_pixel(gather, x, y);
    return METRO_OK;
}

METRO_API metro_result metro_bundles_image(const metro_bundles *bundles, metro_image *image)
{
    const metroi_bundles *plan = bundles != NULL ? (const metroi_bundles *)bundles->state : NULL;
    metroi_gather gather;
    metro_rounds rounds;
    metro_image made;
    metro_vec3 *radiance;
    metro_result result;
    size_t values;
    if (plan == NULL || plan->rounds == 0 || image == NULL) return METRO_ERROR_ARGUMENT;
    values = plan->patches.count * (plan->options.linear ? 3 : 1);
    radiance = (metro_vec3 *)metroi_zeros(values + 1, sizeof *radiance);
    if (radiance == NULL) return METRO_ERROR_MEMORY;
    result = metro_image_make(plan->options.width, plan->options.height, 3, &made);
    if (result == METRO_OK) {
        metroi_bundles_numbers(plan, values, 1, radiance, NULL);
        gather.plan = plan;
        gather.radiance = radiance;
        gather.image = &made;
        memset(&rounds, 0, sizeof rounds);
        rounds.jobs = METROI_GATHER_JOBS;
        rounds.threads = plan->options.threads;
        rounds.work = metroi_gather_work;
        result = metro_rounds_run(&rounds, &gather);
        if (result == METRO_OK) *image = made;
        else metro_image_free(&made);
    }
    METRO_FREE(radiance);
    return result;
}

/* The mean luminance of the picture: what its lamps emit is known, and what its patches reflect is the mean over the
   batches. */

static double metroi_bundles_seen(const metroi_bundles *plan)
{
    double luminance = 0;
    size_t i;
    for (i = 0; i < plan->patches.count; i++)
        luminance += plan->share[i]
                   * metroi_color_luminance(metroi_surface_of(plan, plan->patches.patch[i].triangle)->emission);
    return luminance;
}

static double metroi_bundles_mean(const metroi_bundles *plan, double *error)
{
    metroi_bundles_scale scale = metroi_bundles_scale_of(plan);
    metro_moments moments;
    double mean, spread;
    size_t b, i;
    memset(&moments, 0, sizeof moments);
    for (b = 0; b < plan->options.batches; b++) {
        const double *sum = plan->batch[b].sum;
        double luminance = 0;
        if (!scale.all && !plan->batch[b].alive) continue;
        for (i = 0; i < plan->patches.count; i++)
            luminance += plan->share[i] * metroi_patch_luminance(sum, plan->batch[b].bundle.nodes, i);
        metro_moments_add(&moments, scale.scale * luminance);
    }
    mean = metro_moments_mean(&moments);
    spread = metro_moments_error(&moments);
    *error = sqrt(spread * spread + mean * mean * scale.b_share * scale.b_share);
    return metroi_bundles_seen(plan) + mean;
}

METRO_API void metro_bundles_diagnose(const metro_bundles *bundles, metro_bundles_report *report)
{
    const metroi_bundles *plan = (const metroi_bundles *)bundles->state;
    double steps = 0, accepted = 0, dark = 0, jump = 0;
    size_t i;
    memset(report, 0, sizeof *report);
    report->mean = report->mean_error = report->b = report->b_error = METROI_NAN;
    report->acceptance = report->dark = report->squared_jump = METROI_NAN;
    if (plan == NULL || plan->rounds == 0) return;
    report->mean = metroi_bundles_mean(plan, &report->mean_error);
    if (plan->options.walk != METRO_WALK_METROPOLIS) return;
    report->b = metroi_bundles_b(plan, &report->b_error);
    for (i = 0; i < plan->options.batches; i++) {
        const metro_chain_counts *counts = &plan->batch[i].chain.counts;
        if (!plan->batch[i].alive) continue;
        steps += (double)counts->steps;
        accepted += (double)counts->accepted;
        dark += (double)counts->dark;
        jump += metro_sum_value(&counts->squared_jump);
        if (counts->longest_stay > report->longest_stay) report->longest_stay = counts->longest_stay;
    }
    report->acceptance = accepted / steps;
    report->dark = dark / steps;
    report->squared_jump = jump / steps;
}

METROI_WARM

#undef METROI_NO_PATCH
#undef METROI_BEHIND
#undef METROI_INLINE
#endif /* METRO_NO_TRACER */

#if defined(__clang__)
#pragma STDC FP_CONTRACT DEFAULT
#elif defined(METROI_OPTIONS)
#pragma GCC pop_options
#undef METROI_OPTIONS
#endif
#undef METROI_COLD
#undef METROI_WARM
#undef METROI_PI
#undef METROI_NAN
#undef METROI_INFINITY

#ifdef __cplusplus
}
#endif

/* # A Equations of the paper

   Every numbered equation of Szirmay-Kalos, Dornbach and Purgathofer (1999): where it stands here, what was wrong
   with it, and which function computes it. The evidence for each erratum stands beside its equation.

   | paper | here | erratum | code |
   | paper (1) | eq 7.1 | sigma is called the variance of the estimation; it is the standard deviation of f/p, and sigma/sqrt(M) the standard error | `metro_moments_error` |
   | paper (2) | eq 4.1 | equality holds in stationarity only, and needs I > 0 wherever f is not 0; b is one more unknown | `metro_chain_run`, `metro_chain_b` |
   | paper (3) | eq 5.1 | P(x -> y) under the integral must be P(y -> x), over one period | `metro_kernel_density` |
   | paper (4) | eq 5.2 | none | `metro_kernel_coefficient` |
   | paper (5) | eq 5.3 | e^{jkx} belongs to a period of 2 pi; the rest of the paper uses the unit period, e^{2 pi jkx} | `metro_startup_density` |
   | paper (6) | eq 5.4 | none: the comb of deltas is the list of coefficients | `metro_kernel_coefficient` |
   | paper (7) | eq 5.4 | none | `metro_kernel_coefficient` |
   | paper (8) | eq 5.5 | none | `metro_startup_density` |
   | paper (9) | eq 5.5 | period, as (5) | `metro_startup_density` |
   | paper (10) | eq 5.6 | a_0 is 1 on the unit period that the integral is taken over | `metro_operator_distance` |
   | paper (11) | eq 5.3 | 1/(2 pi) times the integral over [-pi, pi] is 1/(2 pi), not 1; on the unit period a_0 is the integral of p_n, which is 1 | `metro_startup_density` |
   | paper (12) | eq 5.7 | right on the unit period for n >= 1; infinite for n = 0; on a period of 2 pi it needs a factor 1/sqrt(2 pi) | `metro_startup_error` |
   | paper (13) | eq 5.38 | none | `metro_chain_start_seeds` |
   | paper (14) | eq 5.40 | period, as (5) | `metro_startup_density` |
   | paper (15) | eq 5.41 | the sum over the seeds does not belong inside the power 2n, and x has no place in it | `metro_startup_error_seeds` |
   | paper (16) | eq 5.18 | the condition must be abs(x - y) < Delta/2; as printed the density integrates to 2 | `metro_kernel_density` |
   | paper (17) | eq 5.19 | right on the unit period, for Delta > 1 too | `metro_kernel_coefficient` |
   | paper (18) | eq 7.1 | the sum runs to M - 1 with weights 1 - k/M, holds in stationarity, and gives a standard deviation | `metro_bernstein` |
   | paper (19) | eq 14.1 | none; the integral is over all directions, of which a planar patch receives from half | `metro_bundle_transfer` |

   The printed algorithm of paper 1.1 has T(i -> t) in the numerator where T(t -> i) belongs, so that T cancels: eq
   4.2. By paper 2.3 the mutations should be many more than 1/Delta; diffusion needs many more than 1/Delta^2: eq
   5.20. The apex angle of paper 3.2 is the full angle of a cone, twice the half-angle of `metro_cone_perturb`.

   # B Symbols

   The letters of the paper and the names of the code. Inside a function the paper's letter is used where it is
   declared with its meaning.

   | paper | meaning | code |
   | z, z_i | a state of the chain, the state after i steps | `metro_chain.state` |
   | f(z) | the integrand, a vector | what `metro_target.record` adds, divided by I |
   | I(z) | the importance, a number | `metro_target.importance` |
   | b | the integral of I | `metro_chain_b` |
   | M | the number of mutations | `steps` |
   | T(i -> t) | the density of the tentative transition | `metro_target.propose`, `metro_kernel_density` |
   | a(i -> t) | the probability of acceptance | `metroi_acceptance` |
   | p_n | the density of the n-th state | `metro_startup_density` |
   | P(x - y), P* | a perturbation and its spectrum | `metro_kernel_density`, `metro_kernel_coefficient` |
   | Delta | the full width of a uniform perturbation | `metro_kernel.size` |
   | E_n | the start-up error, the L2 distance of p_n from its limit | `metro_startup_error` |
   | x_i, alpha_i | the seeds and their probabilities | `seed`, `alpha` |
   | sigma | the standard deviation of f/p | `metro_moments_variance` is its square |
   | R(k), rho_k | the correlation at lag k | `metro_autocorrelation` |
   | L, L_e | radiance, and what a lamp emits | `metro_material.ke`, `metroi_vertex.weight` times what follows |
   | omega | a direction, per steradian | `direction`, `in`, `out` |
   | f_r, k_d, k_s, m | the BRDF and its numbers, eq 11.1 | `metro_brdf`; `kd`, `ks`, `ns` of `metro_material` |
   | theta | the angle between a direction and the normal | its cosine: `cosine`, `cos_y`, `cos_z` |
   | y_0 .. y_{s-1} | the vertices of the shooting walk, from the lamp | `metroi_walks.y` |
   | z_0 .. z_{t-1} | the vertices of the gathering walk, from the eye | `metroi_walks.z` |
   | alpha | what a walk carries, eq 12.2 | `metroi_vertex.weight` |
   | w_s | the weight of a way to make a path, eq 12.3 | `metroi_heuristic` |
   | A_n, B_n | what a vertex knows of the other ways, eq 12.6 | `metroi_vertex.a`, `.b` |
   | L(omega), L^e | the radiances of all patches, their emission | `metro_bundle_transfer` |
   | F(omega', omega) | the BRDFs of all patches | `metro_brdf` |
   | A(i, j, omega') | the projected area of patch j that patch i sees | `metro_bundle_transfer` |
   | D | the directions of a walk of bundles | `metro_bundles_options.depth` less 1, less 2 after a first shot |
   | c | the side of a cell of the grid | `1 / metroi_rays.per_cell` |
   | v_i | the share of the picture that shows patch i | `metro_bundles.share` |
   | H_i | the irradiance of patch i by the first shot | `metroi_batch.lit` |

   # C License

   MIT No Attribution. Copyright (c) 2026 The metro.h authors.

   Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
   documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
   rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to
   permit persons to whom the Software is furnished to do so.

   THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO
   THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
   AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT,
   TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
   SOFTWARE. */

#endif /* METRO_IMPLEMENTATION */
