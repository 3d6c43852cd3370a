/* fuzz.h - what the programs with LLVMFuzzerTestOneInput share: their demands, and a driver for where no fuzzer is.
   It runs the files that it is given, or mutations of small good files, the same ones each time (METRO_TEST_SCALE
   shrinks their number). Include it after metro.h and define FUZZ_NAME before it. */

#ifndef FUZZ_H
#define FUZZ_H

#include <string.h>

#define FUZZ_DEMAND(condition)                                                                                       \
    do {                                                                                                             \
        if (!(condition)) {                                                                                          \
            fprintf(stderr, FUZZ_NAME ": %s does not hold\n", #condition);                                           \
            abort();                                                                                                 \
        }                                                                                                            \
    } while (0)

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size);

#ifdef FUZZ_STANDALONE

enum { FUZZ_MOST = 1024 };

typedef struct {
    const char *bytes;
    size_t size;
} fuzz_text;

#define FUZZ_TEXT(text) { text, sizeof(text) - 1 }

static int fuzz_file(const char *path)
{
    FILE *file = fopen(path, "rb");
    static uint8_t bytes[1 << 20];
    size_t size = file != NULL ? fread(bytes, 1, sizeof bytes, file) : 0;
    if (file == NULL) {
        fprintf(stderr, FUZZ_NAME ": cannot open %s\n", path);
        return 1;
    }
    fclose(file);
    LLVMFuzzerTestOneInput(bytes, size);
    return 0;
}

/* One small change: a byte, a bit, a digit, a piece taken out or doubled, seldom the end cut off, a word of the
   format put in. */
static size_t fuzz_mutate(uint8_t *bytes, size_t size, const char *word, metro_rng *rng)
{
    size_t at = (size_t)metro_rng_below(rng, size + 1), length = (size_t)metro_rng_below(rng, size < 256 ? 9 : 33), i;
    switch (metro_rng_below(rng, 7)) {
    case 0: if (at < size) bytes[at] = (uint8_t)metro_rng_below(rng, 256); break;
    case 1: if (at < size) bytes[at] ^= (uint8_t)(1u << metro_rng_below(rng, 8)); break;
    case 2: if (at < size) bytes[at] = (uint8_t)('0' + metro_rng_below(rng, 10)); break;
    case 3: return metro_rng_below(rng, 8) == 0 ? at : size;
    case 4:
        if (at + length > size) break;
        memmove(bytes + at, bytes + at + length, size - at - length);
        return size - length;
    case 5:
        if (at + length > size || size + length > FUZZ_MOST) break;
        memmove(bytes + at + length, bytes + at, size - at);
        return size + length;
    default:
        length = strlen(word);
        if (size + length > FUZZ_MOST) break;
        memmove(bytes + at + length, bytes + at, size - at);
        for (i = 0; i < length; i++) bytes[at + i] = (uint8_t)word[i];
        return size + length;
    }
    return size;
}

static int fuzz_main(int count, char **argument, const fuzz_text *good, size_t goods, const char *const *word,
                     size_t words, long runs)
{
    const char *text = getenv("METRO_TEST_SCALE");
    double scale = text != NULL ? atof(text) : 1.0;
    metro_rng rng = metro_rng_make(8, 1);
    int i, failed = 0;
    long run;
    if (scale > 0 && scale < 1) runs = (long)((double)runs * scale);
    for (i = 1; i < count; i++) failed |= fuzz_file(argument[i]);
    for (run = 0; count == 1 && run < runs; run++) {
        const fuzz_text *chosen = &good[metro_rng_below(&rng, goods)];
        size_t size = chosen->size;
        uint64_t changes = 1 + metro_rng_below(&rng, 6);
        uint8_t bytes[FUZZ_MOST], *copy;
        memcpy(bytes, chosen->bytes, size);
        while (changes-- > 0) size = fuzz_mutate(bytes, size, word[metro_rng_below(&rng, words)], &rng);
        /* A block of exactly this size, so that a sanitizer sees a byte too many. */
        copy = (uint8_t *)malloc(size > 0 ? size : 1);
        if (copy == NULL) return 1;
        memcpy(copy, bytes, size);
        LLVMFuzzerTestOneInput(copy, size);
        free(copy);
    }
    if (count == 1) printf(FUZZ_NAME ": %ld mutations, none failed\n", runs);
    return failed;
}

#endif

#endif
