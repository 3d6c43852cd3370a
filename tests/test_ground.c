/* Chapter 1: results, vectors, rounds of jobs. */

#include "memory.h"

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"

/* Catches: a result without words, two results with the same words. */
static void results_have_words(void)
{
    int a, b;
    for (a = METRO_OK; a <= METRO_ERROR_STOPPED; a++) {
        CHECK(strlen(metro_result_text((metro_result)a)) > 5, "result %d", a);
        for (b = METRO_OK; b < a; b++)
            CHECK(strcmp(metro_result_text((metro_result)a), metro_result_text((metro_result)b)) != 0, "%d and %d", a,
                  b);
    }
    CHECK(strcmp(metro_result_text((metro_result)99), "unknown result") == 0, "a number that is no result");
}

/* Catches: the sign or order of a cross product, a component left out. */
static void vectors_obey_their_rules(void)
{
    metro_vec3 a = metro_vec3_make(1, 2, 3), b = metro_vec3_make(-4, .5, 2), c = metro_cross(a, b), d;
    CHECK_CLOSE(metro_dot(c, a), 0, 1e-15);
    CHECK_CLOSE(metro_dot(c, b), 0, 1e-15);
    CHECK_NEAR(c.x, 2.5, 1e-15); /* 2 * 2 - 3 * .5 */
    CHECK_NEAR(c.y, -14.0, 1e-15);
    CHECK_NEAR(c.z, 8.5, 1e-15);
    d = metro_subtract(metro_add(a, metro_scale(b, 2)), a);
    CHECK(d.x == -8 && d.y == 1 && d.z == 4, "%g %g %g", d.x, d.y, d.z);
    CHECK_NEAR(metro_dot(a, b), 3.0, 1e-15);
}

/* Catches: a length that squares 1e300 or 1e-300, a zero vector divided by its length. */
static void lengths_survive_huge_and_tiny(void)
{
    metro_vec3 unit;
    CHECK_NEAR(metro_length(metro_vec3_make(3, -4, 12)), 13.0, 1e-15);
    CHECK_NEAR(metro_length(metro_vec3_make(3e300, 4e300, 0)), 5e300, 1e-15);
    CHECK_NEAR(metro_length(metro_vec3_make(0, 3e-300, -4e-300)), 5e-300, 1e-15);
    CHECK(metro_length(metro_vec3_make(0, 0, 0)) == 0, "zero");
    CHECK_NAN(metro_length(metro_vec3_make(0, (double)NAN, 0)));
    unit = metro_normalize(metro_vec3_make(3e-308, 0, -4e-308));
    CHECK_NEAR(unit.x, .6, 1e-15);
    CHECK_NEAR(unit.z, -.8, 1e-15);
    unit = metro_normalize(metro_vec3_make(1e300, 1e300, 1e300));
    CHECK_NEAR(unit.y, 1 / sqrt(3.0), 1e-15);
    CHECK_NAN(metro_normalize(metro_vec3_make(0, 0, 0)).x);
    CHECK_NAN(metro_normalize(metro_vec3_make((double)INFINITY, 0, 0)).y);
    CHECK_NAN(metro_normalize(metro_vec3_make(0, 0, (double)NAN)).z);
}

/* A run whose jobs draw numbers and whose merge folds them in an order-dependent way. */
typedef struct {
    uint64_t merged[64], fold;
    size_t count;
    uint64_t stop_after, fail_job;
} trace;

static metro_result draw_numbers(uint64_t job, void *slot, void *user)
{
    const trace *t = (const trace *)user;
    metro_rng rng = metro_rng_make(7, job);
    uint64_t sum = *(uint64_t *)slot; /* a slot arrives zeroed, so this adds nothing */
    int i, count = (int)(1 + (job * 7919) % 1000);
    for (i = 0; i < count; i++) sum += metro_rng_next(&rng);
    *(uint64_t *)slot = sum;
    return job == t->fail_job ? METRO_ERROR_FORMAT : METRO_OK;
}

static metro_result fold_numbers(uint64_t job, const void *slot, void *user)
{
    trace *t = (trace *)user;
    t->merged[t->count++ % 64] = job;
    t->fold = t->fold * 31 + *(const uint64_t *)slot;
    return METRO_OK;
}

static int stop_after(uint64_t rounds_done, void *user) { return rounds_done >= ((trace *)user)->stop_after; }

static metro_rounds plan_of(uint64_t rounds, size_t jobs, size_t threads)
{
    metro_rounds plan;
    memset(&plan, 0, sizeof plan);
    plan.rounds = rounds;
    plan.jobs = jobs;
    plan.threads = threads;
    plan.slot_size = sizeof(uint64_t);
    plan.work = draw_numbers;
    plan.merge = fold_numbers;
    return plan;
}

static trace trace_of(void)
{
    trace t;
    memset(&t, 0, sizeof t);
    t.fail_job = UINT64_MAX;
    t.stop_after = UINT64_MAX;
    return t;
}

/* Catches: slots merged as they arrive, a slot left dirty between rounds, a job done twice or not at all. */
static void rounds_do_not_depend_on_threads(void)
{
    size_t threads[] = { 1, 2, 3, 8, 0 }, i, job;
    uint64_t fold = 0;
    for (i = 0; i < 5; i++) {
        trace t = trace_of();
        metro_rounds plan = plan_of(4, 13, threads[i]);
        CHECK(metro_rounds_run(&plan, &t) == METRO_OK, "threads %d", (int)threads[i]);
        CHECK(t.count == 52, "%d jobs merged", (int)t.count);
        for (job = 0; job < 52; job++)
            CHECK(t.merged[job] == job, "job %d at place %d", (int)t.merged[job], (int)job);
        if (i == 0) fold = t.fold;
        CHECK(t.fold == fold, "another answer on %d threads", (int)threads[i]);
    }
}

/* Catches: a run in two parts that repeats or skips jobs. */
static void rounds_go_on_where_they_ended(void)
{
    trace whole = trace_of(), parts = trace_of();
    metro_rounds plan = plan_of(5, 6, 2);
    CHECK(metro_rounds_run(&plan, &whole) == METRO_OK, "whole");
    plan.rounds = 2;
    CHECK(metro_rounds_run(&plan, &parts) == METRO_OK, "first part");
    plan.first_round = 2;
    plan.rounds = 3;
    CHECK(metro_rounds_run(&plan, &parts) == METRO_OK, "second part");
    CHECK(parts.fold == whole.fold && parts.count == whole.count, "parts differ from the whole");
}

/* Catches: an early stop that loses a merged round, a failure that merges its round, errors taken in thread order. */
static void rounds_stop_and_fail_cleanly(void)
{
    trace t = trace_of();
    metro_rounds plan = plan_of(9, 4, 2);
    plan.stop = stop_after;
    t.stop_after = 3;
    CHECK(metro_rounds_run(&plan, &t) == METRO_ERROR_STOPPED, "stop");
    CHECK(t.count == 12, "%d jobs merged before the stop", (int)t.count);
    t = trace_of();
    t.fail_job = 6;
    CHECK(metro_rounds_run(&plan, &t) == METRO_ERROR_FORMAT, "the job's own result");
    CHECK(t.count == 4, "%d jobs merged, the failed round among them", (int)t.count);
}

/* Catches: arguments that reach a division or an allocation unchecked. */
static void rounds_refuse_nonsense(void)
{
    trace t = trace_of();
    metro_rounds plan = plan_of(1, 4, 1);
    plan.work = NULL;
    CHECK(metro_rounds_run(&plan, &t) == METRO_ERROR_ARGUMENT, "no work");
    plan = plan_of(1, 1000, 1);
    plan.slot_size = SIZE_MAX / 100;
    CHECK(metro_rounds_run(&plan, &t) == METRO_ERROR_ARGUMENT, "slots overflow");
    plan = plan_of(0, 0, 1);
    CHECK(metro_rounds_run(&plan, &t) == METRO_OK, "defaults");
    CHECK(t.count == 16, "default: one round of 16 jobs, not %d", (int)t.count);
    plan.merge = NULL;
    plan.slot_size = 0;
    plan.work = draw_numbers;
    CHECK(metro_core_count() >= 1, "cores");
}

/* One stream an index, which goes on from round to round. */
typedef struct {
    metro_rng rng[5];
    uint64_t drawn[5], fold;
} walkers;

static metro_result walk_on(uint64_t job, void *slot, void *user)
{
    walkers *w = (walkers *)user;
    size_t i, index = (size_t)(job % 5);
    for (i = 0; i < 1000 * (index + 1); i++) *(uint64_t *)slot += metro_rng_next(&w->rng[index]);
    w->drawn[index] += i;
    return METRO_OK;
}

static metro_result fold_walk(uint64_t job, const void *slot, void *user)
{
    walkers *w = (walkers *)user;
    w->fold = w->fold * 31 + *(const uint64_t *)slot + job;
    return METRO_OK;
}

/* Catches: two jobs of one index at work at once, rounds that overlap. */
static void jobs_may_keep_what_is_theirs(void)
{
    static const size_t threads[4] = { 1, 2, 3, 8 };
    uint64_t fold = 0;
    size_t i, k;
    for (k = 0; k < 4; k++) {
        walkers w;
        metro_rounds plan = plan_of(20, 5, threads[k]);
        memset(&w, 0, sizeof w);
        for (i = 0; i < 5; i++) w.rng[i] = metro_rng_make(3, i);
        plan.work = walk_on;
        plan.merge = fold_walk;
        CHECK(metro_rounds_run(&plan, &w) == METRO_OK, "walk");
        for (i = 0; i < 5; i++) {
            metro_rng straight = metro_rng_make(3, i);
            uint64_t j;
            CHECK(w.drawn[i] == 20000 * (i + 1), "walker %d drew %g", (int)i, (double)w.drawn[i]);
            for (j = 0; j < w.drawn[i]; j++) metro_rng_next(&straight);
            CHECK(metro_rng_next(&straight) == metro_rng_next(&w.rng[i]), "walker %d is elsewhere", (int)i);
        }
        if (k == 0) fold = w.fold;
        CHECK(w.fold == fold, "%d threads give another walk", (int)threads[k]);
    }
}

/* Catches: a failed allocation that is used, and memory that a failure leaks. */
static void rounds_survive_failing_allocations(void)
{
    long k;
    for (k = 0; k < 4; k++) {
        trace t = trace_of();
        metro_rounds plan = plan_of(2, 4, 1);
        metro_result result;
        allocations_left = k;
        result = metro_rounds_run(&plan, &t);
        allocations_left = -1;
        CHECK(result == (k < 2 ? METRO_ERROR_MEMORY : METRO_OK), "allocation %ld: %s", k, metro_result_text(result));
        CHECK(k >= 2 || t.count == 0, "merged without memory");
    }
    CHECK(allocations_live == 0, "%ld blocks leaked", allocations_live);
}

int main(void)
{
    CHECK_RUN(results_have_words);
    CHECK_RUN(vectors_obey_their_rules);
    CHECK_RUN(lengths_survive_huge_and_tiny);
    CHECK_RUN(rounds_do_not_depend_on_threads);
    CHECK_RUN(rounds_go_on_where_they_ended);
    CHECK_RUN(rounds_stop_and_fail_cleanly);
    CHECK_RUN(rounds_refuse_nonsense);
    CHECK_RUN(jobs_may_keep_what_is_theirs);
    CHECK_RUN(rounds_survive_failing_allocations);
    return check_done("ground");
}
