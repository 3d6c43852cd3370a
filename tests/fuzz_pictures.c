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
#define FUZZ_NAME "fuzz_pictures"
#include "fuzz.h"

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

int main(int count, char **argument)
{
    static const char *const word[] = {
        " 0 ", "18446744073709551616", "4294967296", "65536", "1e308", "-0.0", "nan", "#", "\n", "P3", "PF",
        "Pf", "P6", "-1.0\n", " 1 1 ", "255 "
    };
    static const fuzz_text good[] = {
        FUZZ_TEXT("P6\n2 1\n255\n\1\2\3\4\5\6"), FUZZ_TEXT("P6\n1 1\n65535\n\1\2\3\4\5\6"),
        FUZZ_TEXT("P3\n2 2 # size\n15\n1 2 3 4 5 6 7 8 9 10 11 12\n"),
        FUZZ_TEXT("Pf\n2 1\n-1.0\n\0\0\x80\x3f\1\2\3\4"),
        FUZZ_TEXT("PF\n1 1\n1.0\n\x3f\x80\0\0\x7f\xc0\0\0\x7f\x80\0\0")
    };
    return fuzz_main(count, argument, good, sizeof good / sizeof *good, word, sizeof word / sizeof *word, 200000);
}

#endif
