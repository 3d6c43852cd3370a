/* fuzz_pictures.c - bytes that nobody meant to be a picture, for chapter 8.

       clang -g -O1 -fsanitize=fuzzer,address,undefined tests/fuzz_pictures.c -o fuzz -lm -lpthread && ./fuzz
       cc -g -O1 -DFUZZ_STANDALONE -fsanitize=address,undefined tests/fuzz_pictures.c -o fuzz -lm -lpthread && ./fuzz

   The second form needs no fuzzer: it runs the files that it is given, or 200000 mutations (METRO_TEST_SCALE shrinks
   the number) of small good files, the same ones each time. */

#include <stddef.h>
#include <stdlib.h>

/* The allocator counts, because a refused file must not cost an allocation. */
static size_t fuzz_made = 0;

static void *fuzz_make(size_t size)
{
    fuzz_made++;
    return malloc(size);
}

#define METRO_MALLOC(size) fuzz_make(size)
#define METRO_REALLOC(pointer, size) realloc(pointer, size)
#define METRO_FREE(pointer) free(pointer)

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include <string.h>

#define FUZZ_DEMAND(condition)                                                                                       \
    do {                                                                                                             \
        if (!(condition)) {                                                                                          \
            fprintf(stderr, "fuzz_pictures: %s does not hold\n", #condition);                                        \
            abort();                                                                                                 \
        }                                                                                                            \
    } while (0)

/* What must hold for a picture that was read: the file was large enough for it, every sample can be touched, a PPM
   lies in 0 .. 1, and it equals itself. */
static void fuzz_good(const uint8_t *bytes, size_t size, const metro_image *image)
{
    metro_image_difference difference;
    size_t samples = image->width * image->height * image->channels, i, finite = 0;
    int is_ppm = bytes[1] == '3' || bytes[1] == '6';
    FUZZ_DEMAND(samples > 0 && samples <= size && image->width <= size && image->height <= size);
    FUZZ_DEMAND(image->channels == (bytes[1] == 'f' ? 1u : 3u));
    for (i = 0; i < samples; i++) {
        finite += isfinite(image->value[i]) ? 1u : 0u;
        FUZZ_DEMAND(!is_ppm || (image->value[i] >= 0 && image->value[i] <= 1));
    }
    FUZZ_DEMAND(metro_image_not_finite(image) == samples - finite);
    FUZZ_DEMAND(metro_image_error(image, image, &difference) == METRO_OK);
    FUZZ_DEMAND(finite < samples || difference.largest == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    metro_image image;
    char message[80];
    metro_result result;
    memset(&image, 0, sizeof image);
    image.width = 12345;
    message[0] = 'x';
    fuzz_made = 0;
    result = metro_image_parse(bytes, size, &image, message, size % sizeof message + 1);
    FUZZ_DEMAND(result == METRO_OK || result == METRO_ERROR_FORMAT);
    FUZZ_DEMAND(memchr(message, 0, size % sizeof message + 1) != NULL);
    if (result == METRO_OK) {
        FUZZ_DEMAND(message[0] == 0 && fuzz_made == 1);
        fuzz_good(bytes, size, &image);
        metro_image_free(&image);
    } else {
        FUZZ_DEMAND(fuzz_made == 0 && image.width == 12345 && image.value == NULL);
    }
    return 0;
}

#ifdef FUZZ_STANDALONE

enum { FUZZ_MOST = 256 };

static int fuzz_file(const char *path)
{
    FILE *file = fopen(path, "rb");
    static uint8_t bytes[1 << 20];
    size_t size = file != NULL ? fread(bytes, 1, sizeof bytes, file) : 0;
    if (file == NULL) {
        fprintf(stderr, "fuzz_pictures: cannot open %s\n", path);
        return 1;
    }
    fclose(file);
    LLVMFuzzerTestOneInput(bytes, size);
    return 0;
}

/* One small change: a byte, a bit, a digit, a piece taken out or doubled, the end cut off, a word of the format put
   in. */
static size_t fuzz_mutate(uint8_t *bytes, size_t size, metro_rng *rng)
{
    static const char *const word[] = { " 0 ", "18446744073709551616", "4294967296", "65536", "1e308", "-0.0", "nan",
                                        "#", "\n", "P3", "PF", "Pf", "P6", "-1.0\n", " 1 1 ", "255 " };
    size_t at = (size_t)metro_rng_below(rng, size + 1), length = (size_t)metro_rng_below(rng, 9), i;
    const char *put = word[metro_rng_below(rng, sizeof word / sizeof *word)];
    switch (metro_rng_below(rng, 7)) {
    case 0: if (at < size) bytes[at] = (uint8_t)metro_rng_below(rng, 256); break;
    case 1: if (at < size) bytes[at] ^= (uint8_t)(1u << metro_rng_below(rng, 8)); break;
    case 2: if (at < size) bytes[at] = (uint8_t)('0' + metro_rng_below(rng, 10)); break;
    case 3: return at;
    case 4:
        if (at + length > size) break;
        memmove(bytes + at, bytes + at + length, size - at - length);
        return size - length;
    case 5:
        if (at + length > size || size + length > FUZZ_MOST) break;
        memmove(bytes + at + length, bytes + at, size - at);
        return size + length;
    default:
        length = strlen(put);
        if (size + length > FUZZ_MOST) break;
        memmove(bytes + at + length, bytes + at, size - at);
        for (i = 0; i < length; i++) bytes[at + i] = (uint8_t)put[i];
        return size + length;
    }
    return size;
}

#define FUZZ_BYTES(text) { text, sizeof(text) - 1 }

int main(int count, char **argument)
{
    static const struct {
        const char *bytes;
        size_t size;
    } good[] = { FUZZ_BYTES("P6\n2 1\n255\n\1\2\3\4\5\6"), FUZZ_BYTES("P6\n1 1\n65535\n\1\2\3\4\5\6"),
                 FUZZ_BYTES("P3\n2 2 # size\n15\n1 2 3 4 5 6 7 8 9 10 11 12\n"),
                 FUZZ_BYTES("Pf\n2 1\n-1.0\n\0\0\x80\x3f\1\2\3\4"),
                 FUZZ_BYTES("PF\n1 1\n1.0\n\x3f\x80\0\0\x7f\xc0\0\0\x7f\x80\0\0") };
    const char *text = getenv("METRO_TEST_SCALE");
    double scale = text != NULL ? atof(text) : 1.0;
    long runs = (long)(200000 * (scale > 0 && scale < 1 ? scale : 1.0)), run;
    metro_rng rng = metro_rng_make(8, 1);
    int i, failed = 0;
    for (i = 1; i < count; i++) failed |= fuzz_file(argument[i]);
    for (run = 0; count == 1 && run < runs; run++) {
        size_t chosen = (size_t)metro_rng_below(&rng, sizeof good / sizeof *good), size = good[chosen].size;
        uint64_t changes = 1 + metro_rng_below(&rng, 4);
        uint8_t bytes[FUZZ_MOST], *copy;
        memcpy(bytes, good[chosen].bytes, size);
        while (changes-- > 0) size = fuzz_mutate(bytes, size, &rng);
        /* A block of exactly this size, so that a sanitizer sees a byte too many. */
        copy = (uint8_t *)malloc(size > 0 ? size : 1);
        if (copy == NULL) return 1;
        memcpy(copy, bytes, size);
        LLVMFuzzerTestOneInput(copy, size);
        free(copy);
    }
    if (count == 1) printf("fuzz_pictures: %ld mutations, none failed\n", runs);
    return failed;
}

#endif
