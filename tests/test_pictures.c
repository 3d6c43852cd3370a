/* test_pictures.c - chapter 8: pictures in memory, PPM and PFM in and out, and the error of a picture.

   The bytes of the files are written out by hand here, and the library must agree with them in both directions. All
   memory goes through a counter that can also fail: it shows what a refused file costs and that nothing leaks. */

#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L /* fork, kill, symlink */
#endif
#include "memory.h"

#define METRO_IMPLEMENTATION
#include "../metro.h"
#include "check.h"
#include <locale.h>
#ifdef _WIN32
#include <process.h>
#define getpid _getpid
#else
#include <signal.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#endif

/* ---- small helpers ---- */

static metro_image nothing(void)
{
    metro_image image;
    memset(&image, 0, sizeof image);
    return image;
}

static metro_result parse(const char *bytes, size_t size, metro_image *image, char *message, size_t message_size)
{
    return metro_image_parse((const unsigned char *)bytes, size, image, message, message_size);
}

/* A path for a file of this run: in build/ where that exists, so that the tree stays clean. */
static const char *scratch(const char *name)
{
    static char path[300];
    static const char *folder = NULL;
    if (folder == NULL) {
        FILE *probe;
        snprintf(path, sizeof path, "build/pictures-%ld-probe", (long)getpid());
        probe = fopen(path, "wb");
        folder = probe != NULL ? "build/" : "";
        if (probe != NULL) fclose(probe);
        remove(path);
    }
    snprintf(path, sizeof path, "%spictures-%ld-%s", folder, (long)getpid(), name);
    return path;
}

static size_t read_bytes(const char *path, unsigned char *bytes, size_t most)
{
    FILE *file = fopen(path, "rb");
    size_t size = file != NULL ? fread(bytes, 1, most, file) : 0;
    if (file != NULL) fclose(file);
    return size;
}

static int write_bytes(const char *path, const void *bytes, size_t size)
{
    FILE *file = fopen(path, "wb");
    int good = file != NULL && fwrite(bytes, 1, size, file) == size;
    if (file != NULL) good = fclose(file) == 0 && good;
    return good;
}

static int exists(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file != NULL) fclose(file);
    return file != NULL;
}

#define BYTES(text) text, sizeof(text) - 1

/* ---- the picture ---- */

/* Catches: an overflowing product that makes a small block, sizes of 0, memory that is not black. */
static void make_and_free(void)
{
    metro_image image = nothing(), same;
    size_t i;
    long living = allocations_live;
    CHECK(metro_image_make(5, 4, 3, &image) == METRO_OK, "a small picture was refused");
    CHECK(image.width == 5 && image.height == 4 && image.channels == 3, "wrong shape");
    for (i = 0; i < 60; i++) CHECK(image.value[i] == 0.0, "sample %d is not black", (int)i);
    same = image;
    CHECK(metro_image_make(0, 4, 3, &image) == METRO_ERROR_ARGUMENT, "width 0");
    CHECK(metro_image_make(4, 0, 3, &image) == METRO_ERROR_ARGUMENT, "height 0");
    CHECK(metro_image_make(4, 4, 0, &image) == METRO_ERROR_ARGUMENT, "no channels");
    CHECK(metro_image_make(4, 4, 2, &image) == METRO_ERROR_ARGUMENT, "two channels");
    CHECK(metro_image_make(4, 4, 3, NULL) == METRO_ERROR_ARGUMENT, "no picture");
    allocations_reset(-1);
    CHECK(metro_image_make(SIZE_MAX, SIZE_MAX, 3, &image) == METRO_ERROR_MEMORY, "SIZE_MAX squared");
    CHECK(metro_image_make(SIZE_MAX / 2 + 1, 2, 1, &image) == METRO_ERROR_MEMORY, "wraps to 0");
    CHECK(metro_image_make(SIZE_MAX / 8 + 2, 1, 1, &image) == METRO_ERROR_MEMORY, "bytes wrap to 8");
    CHECK(metro_image_make(SIZE_MAX / 24 + 2, 1, 3, &image) == METRO_ERROR_MEMORY, "bytes wrap");
    CHECK(allocations_made == 0, "an overflowing size reached the allocator");
    CHECK(memcmp(&same, &image, sizeof image) == 0, "a failure changed the picture");
    metro_image_free(&image);
    CHECK(image.value == NULL && image.width == 0 && image.height == 0 && image.channels == 0, "not emptied");
    metro_image_free(&image);
    metro_image_free(NULL);
    CHECK(allocations_live == living, "%ld blocks leaked", allocations_live - living);
}

/* ---- colour ---- */

/* The decoded values are those of IEC 61966-2-1's formula to nine digits (printed in every table of it: 128 is 21.6 %
   grey). Catches: 2.2 for 2.4, the thresholds swapped, the offset forgotten. */
static void srgb_curve(void)
{
    static const struct {
        int code;
        double linear;
    } table[] = { { 0, 0 }, { 1, 0.000303526984 }, { 10, 0.00303526984 }, { 11, 0.00334653576 }, { 64, 0.0512694584 },
                  { 128, 0.215860500 }, { 188, 0.502886458 }, { 254, 0.991102097 }, { 255, 1 } };
    size_t i;
    for (i = 0; i < sizeof table / sizeof *table; i++) {
        CHECK_CLOSE(metro_srgb_decode(table[i].code / 255.0), table[i].linear, 5e-9 * table[i].linear);
        CHECK_CLOSE(metro_srgb_encode(table[i].linear), table[i].code / 255.0, 5e-9);
    }
    for (i = 0; i <= 1000; i++) {
        double x = (double)i / 1000;
        CHECK_CLOSE(metro_srgb_decode(metro_srgb_encode(x)), x, 2e-7);
    }
    CHECK_NEAR(metro_srgb_encode(-1.0), -12.92, 1e-15);
    CHECK_NEAR(metro_srgb_decode(-12.92), -1.0, 1e-15);
    CHECK(metro_srgb_encode(2.0) > 1.0 && isinf(metro_srgb_encode((double)INFINITY)), "the curve ends at 1");
    CHECK_NAN(metro_srgb_encode((double)NAN));
    CHECK_NAN(metro_srgb_decode((double)NAN));
}

/* Catches: the channels swapped; weights that do not add to 1. */
static void luminance(void)
{
    CHECK(metro_luminance(1, 0, 0) == 0.212671, "red");
    CHECK(metro_luminance(0, 1, 0) == 0.715160, "green");
    CHECK(metro_luminance(0, 0, 1) == 0.072169, "blue");
    CHECK_NEAR(metro_luminance(0.3, 0.3, 0.3), 0.3, 1e-15);
    CHECK_NAN(metro_luminance(0, (double)NAN, 0));
}

/* ---- reading ---- */

static void expect_values(const char *what, const char *bytes, size_t size, size_t width, size_t height,
                          size_t channels, const double *value)
{
    metro_image image = nothing();
    char message[200] = "old";
    size_t i;
    metro_result result = parse(bytes, size, &image, message, sizeof message);
    CHECK(result == METRO_OK && message[0] == 0, "%s: refused: %s", what, message);
    if (result != METRO_OK) return;
    CHECK(image.width == width && image.height == height && image.channels == channels, "%s: wrong shape", what);
    for (i = 0; i < width * height * channels; i++) {
        int same = isnan(value[i]) ? isnan(image.value[i]) : fabs(image.value[i] - value[i]) <= 1e-9 * fabs(value[i])
            || image.value[i] == value[i];
        CHECK(same, "%s: sample %d is %.17g, should be %.17g", what, (int)i, image.value[i], value[i]);
    }
    metro_image_free(&image);
}

/* Catches: rows upside down, colours swapped, two-byte samples with the low byte first, comments taken for numbers, a
   maxval that is not divided by, the curve left out. */
static void reads_ppm(void)
{
    const double a = 0.215860500, b = 0.502886458; /* of 128 and 188 */
    const double corner[] = { 1, 0, 0, 0, 1, 0, 0, 0, 1, a, b, 1 };
    const double deep[] = { 0, 0.215860500113899, 1 };            /* 128/255 = 32896/65535 */
    const double two[] = { 0, 1, 1, 0, 0, 1 };
    expect_values("P6", BYTES("P6\n2 2\n255\n\xff\0\0\0\xff\0\0\0\xff\x80\xbc\xff"), 2, 2, 3, corner);
    expect_values("P6, comments", BYTES("P6 # a\n#b 9 9\n 2\t\t2 #\n\r\n255\n\xff\0\0\0\xff\0\0\0\xff\x80\xbc\xff"),
                  2, 2, 3, corner);
    expect_values("P6, a line end behind", BYTES("P6 2 2 255 \xff\0\0\0\xff\0\0\0\xff\x80\xbc\xff\n"), 2, 2, 3,
                  corner);
    expect_values("P3, white space behind", BYTES("P3 2 2 255 255 0 0 0 255 0 0 0 255 128 188 255\n \r\n"), 2, 2, 3,
                  corner);
    expect_values("P3", BYTES("P3 2 2 255 255 0 0 0 255 0 0 0 255 128 188 255"), 2, 2, 3, corner);
    expect_values("P3, comments",
                  BYTES("P3\n2 2\n255\n255 0 0 # red\n0 255 0#green\n\n#\n0 0\t255\n0128 188 255\n# end"),
                  2, 2, 3, corner);
    expect_values("P6 of 16 bits", BYTES("P6 1 1 65535 \0\0\x80\x80\xff\xff"), 1, 1, 3, deep);
    expect_values("P3 of 16 bits", BYTES("P3 1 1 65535 0 32896 65535"), 1, 1, 3, deep);
    expect_values("P3 of 1 bit", BYTES("P3 2 1 1 0 1 1 0 0 1"), 2, 1, 3, two);
    expect_values("P6 of 1 bit", BYTES("P6 2 1 1 \0\1\1\0\0\1"), 2, 1, 3, two);
    expect_values("P6 of 9 bits", BYTES("P6 2 1 256 \0\0\1\0\1\0\0\0\0\0\1\0"), 2, 1, 3, two);
}

/* 1.5 is 3fc00000, -2 c0000000, 0.1 is 3dcccccd, 1e-45 (the smallest) 00000001, infinity 7f800000, NaN 7fc00000.
   Catches: rows top to bottom, the byte order taken from the machine, the sign of the scale ignored, its magnitude
   ignored, NaN or infinity cleaned away. */
static void reads_pfm(void)
{
    const double grey[] = { 1.5, -2, (double)INFINITY, (double)NAN };
    const double tenfold[] = { 15, -20, (double)INFINITY, (double)NAN };
    const double colour[] = { 1.5, -2, -(double)INFINITY, 0, 0.100000001490116119, 1.40129846432481707e-45 };
    expect_values("Pf, little", BYTES("Pf\n2 2\n-1.0\n\0\0\x80\x7f\0\0\xc0\x7f\0\0\xc0\x3f\0\0\0\xc0"),
                  2, 2, 1, grey);
    expect_values("Pf, big", BYTES("Pf\n2 2\n1.0\n\x7f\x80\0\0\x7f\xc0\0\0\x3f\xc0\0\0\xc0\0\0\0"), 2, 2, 1, grey);
    expect_values("Pf, scaled", BYTES("Pf\n2 2\n+1e1\n\x7f\x80\0\0\x7f\xc0\0\0\x3f\xc0\0\0\xc0\0\0\0"),
                  2, 2, 1, tenfold);
    expect_values("PF, little",
                  BYTES("PF\n1 2\n-1\n\0\0\0\0\xcd\xcc\xcc\x3d\1\0\0\0\0\0\xc0\x3f\0\0\0\xc0\0\0\x80\xff"),
                  1, 2, 3, colour);
    expect_values("PF, big", BYTES("PF 1 2 .1e1\n\0\0\0\0\x3d\xcc\xcc\xcd\0\0\0\1\x3f\xc0\0\0\xc0\0\0\0\xff\x80\0\0"),
                  1, 2, 3, colour);
}

/* The scale is the one fraction that is read as text: against strtod, in the locale of the C library's start.
   Catches: a power of ten one off, digits beyond the nineteenth lost, an exponent's sign. */
static void reads_fractions(void)
{
    static const char *const exact[] = { "1", "-1.0", "0.5", ".25", "3.", "1e0", "1E+2", "12345.678e-3", "0.1",
                                         "1e22", "1e-22", "9007199254740992",
                                         "000000000000000000000000000000000000000001.5" };
    static const char *const nearly[] = { "3.14159265358979323846264338327950288", "1e300", "1.7e308", "2.5e-308",
                                         "123456789e-300", "1e-310",
                                         "0.000000000000000000000000000000000000000000000000012345",
                                         "123456789012345678901234567890", "99999999999999999999e-20", "4.9e-300" };
    metro_rng rng = metro_rng_make(8, 3);
    size_t i, count = (size_t)check_count(20000, 500);
    for (i = 0; i < sizeof exact / sizeof *exact + sizeof nearly / sizeof *nearly + count; i++) {
        size_t of_nearly = i - sizeof exact / sizeof *exact, of_random = of_nearly - sizeof nearly / sizeof *nearly;
        int is_exact = i < sizeof exact / sizeof *exact;
        char number[100], file[140];
        metro_image image = nothing();
        double truth;
        int header;
        if (is_exact) strcpy(number, exact[i]);
        else if (of_nearly < sizeof nearly / sizeof *nearly) strcpy(number, nearly[of_nearly]);
        else snprintf(number, sizeof number, "%.*g", (int)(of_random % 25) + 1,
                      ldexp(metro_rng_uniform(&rng) + 0.5, (int)metro_rng_below(&rng, 1800) - 900));
        truth = fabs(strtod(number, NULL));
        header = snprintf(file, sizeof file, "Pf 1 1 %s\n", number);
        /* The float 1 is 3f800000: big endian for a positive scale. */
        memcpy(file + header, number[0] == '-' ? "\0\0\x80\x3f" : "\x3f\x80\0\0", 4);
        CHECK(parse(file, (size_t)header + 4, &image, NULL, 0) == METRO_OK, "%s was refused", number);
        if (image.value != NULL) {
            double allowed = is_exact ? 0.0 : 1e-15 * truth + 1e-323;
            CHECK(fabs(image.value[0] - truth) <= allowed, "%s read as %.17g", number, image.value[0]);
        }
        metro_image_free(&image);
    }
}

/* Files that lie. Each must be refused for its own reason, without an allocation, and leave the picture alone.
   Catches: a header that is believed before the file is measured, a product that wraps, a sample above the maxval, a
   number that ends in letters, a zero byte taken for the end. */
static void refuses(void)
{
    static const struct {
        const char *bytes;
        size_t size;
        const char *reason;
    } bad[] = {
        { BYTES(""), "empty" },
        { BYTES("P"), "P6" },
        { BYTES("\0\0\0\0"), "P6" },
        { BYTES("hello"), "P6" },
        { BYTES("P5 1 1 255 \0"), "P6" },
        { BYTES("P2 1 1 255 0"), "P6" },
        { BYTES("p6 1 1 255 \0\0\0"), "P6" },
        { BYTES("P66 1 1 255 \0\0\0"), "P6" },
        { BYTES("P6\0 1 1 255 \0\0\0"), "P6" },
        { BYTES("PG\n1 1\n-1\n\0\0\0\0"), "P6" },
        { BYTES("\x89PNG\r\n\x1a\n"), "P6" },
        { BYTES("P6"), "width and height" },
        { BYTES("P6 "), "width and height" },
        { BYTES("P6 1"), "width and height" },
        { BYTES("P6 1 "), "width and height" },
        { BYTES("P6 # 1 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 -1 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 +1 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 1.0 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 1x1 255 \0\0\0"), "width and height" },
        { BYTES("P6 1 1\0 255 \0\0\0"), "width and height" },
        { BYTES("P6 a 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 99999999999999999999999999999999999999 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 18446744073709551617 1 255 \0\0\0"), "width and height" },
        { BYTES("P6 0 0 255 "), "no pixels" },
        { BYTES("P6 0 1 255 "), "no pixels" },
        { BYTES("P6 1 0 255 \0\0\0"), "no pixels" },
        { BYTES("PF 0 0 -1\n"), "no pixels" },
        { BYTES("P3 0 0 255"), "no pixels" },
        { BYTES("P6 100000 100000 255 \0\0\0"), "more pixels" },
        { BYTES("P3 100000 100000 255 0 0 0"), "more pixels" },
        { BYTES("PF 100000 100000 -1\n\0\0\0\0\0\0\0\0\0\0\0\0"), "more pixels" },
        { BYTES("P6 65536 65536 255 \0\0\0"), "more pixels" },
        { BYTES("Pf 4294967296 4294967296 -1\n\0\0\0\0"), "" },
        { BYTES("P6 1152921504606846975 1152921504606846975 255 \0\0\0"), "" },
        { BYTES("Pf 1152921504606846975 16 -1\n\0\0\0\0"), "" },
        { BYTES("P6 268435455 268435455 255 \0\0\0"), "more pixels" },
        { BYTES("P6 1 1"), "maxval" },
        { BYTES("P6 1 1 0 \0\0\0"), "maxval" },
        { BYTES("P6 1 1 65536 \0\0\0\0\0\0"), "maxval" },
        { BYTES("P6 1 1 99999999999999999999 \0\0\0"), "maxval" },
        { BYTES("P6 1 1 -255 \0\0\0"), "maxval" },
        { BYTES("P6 1 1 255.0 \0\0\0"), "maxval" },
        { BYTES("P6 1 1 255x\0\0\0"), "maxval" },
        { BYTES("P6 1 1 255\0\0\0\0"), "maxval" },
        { BYTES("P3 1 1 255"), "white space" },
        { BYTES("P6 1 1 255#\0\0\0"), "white space" },
        { BYTES("P6 1 1 255 \0\0"), "before its last pixel" },
        { BYTES("P6 1 1 65535 \0\0\0\0\0"), "before its last pixel" },
        { BYTES("P6 1 2 255 \0\0\0\0\0"), "before its last pixel" },
        { BYTES("P6 1 1 255 \0\0\0\0"), "after its last pixel" },
        { BYTES("P6 1 1 255 \0\0\0 x"), "after its last pixel" },
        { BYTES("P6 1 1 255 \0\0\0P6 1 1 255 \0\0\0"), "after its last pixel" },
        { BYTES("P6 1 1 254 \0\0\xff"), "maxval" },
        { BYTES("P6 1 1 65534 \0\0\0\0\xff\xff"), "maxval" },
        { BYTES("P3 1 1 255 0 0"), "before its last pixel" },
        { BYTES("P3 1 1 255 0 0 # 0"), "before its last pixel" },
        { BYTES("P3 1 1 255 0 0 x"), "whole number" },
        { BYTES("P3 1 1 255 0 0 1x"), "whole number" },
        { BYTES("P3 1 1 255 0 -1 0"), "whole number" },
        { BYTES("P3 1 1 255 0 0.5 0"), "whole number" },
        { BYTES("P3 1 1 255 0 256 0"), "whole number" },
        { BYTES("P3 1 1 1 0 2 0"), "whole number" },
        { BYTES("P3 1 1 5 0 6 0"), "whole number" },
        { BYTES("P3 1 1 255 0 18446744073709551616 0"), "whole number" },
        { BYTES("P3 1 1 255 0\0 0 0 0"), "whole number" },
        { BYTES("P3 1 1 255 0 0 0 0"), "after its last pixel" },
        { BYTES("P3 1 1 255 0 0 0 x"), "after its last pixel" },
        { BYTES("P6 1 1 255\nABC "), "after its last pixel" },
        { BYTES("P6\r\n1 1\r\n255\r\nAB\t"), "after its last pixel" },
        { BYTES("P6 1 1 255\nABC\n\n"), "after its last pixel" },
        { BYTES("PF 1 1"), "scale" },
        { BYTES("PF 1 1 \0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 -0.0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1e-9999\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1e9999\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1e99999\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1e\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1e 5\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1.0.0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 1,0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 nan\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 NaN\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 inf\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 0x1p0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 --1\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 -\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 .\n\0\0\0\0\0\0\0\0\0\0\0\0"), "scale" },
        { BYTES("PF 1 1 -1.0"), "white space" },
        { BYTES("PF 1 1 -1.0\n\0\0\0\0\0\0\0\0\0\0\0"), "before its last pixel" },
        { BYTES("PF 1 1 -1.0\n\0\0\0\0\0\0\0\0\0\0\0\0\0"), "after its last pixel" },
        { BYTES("PF 1 2 -1.0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "before its last pixel" },
        { BYTES("Pf 3 1 -1.0\n\0\0\0\0\0\0\0\0\0\0\0"), "before its last pixel" },
        { BYTES("Pf 2 1 -1.0\n\0\0\0\0\0\0\0\0\0\0\0\0"), "after its last pixel" },
    };
    size_t i;
    long living = allocations_live;
    for (i = 0; i < sizeof bad / sizeof *bad; i++) {
        metro_image image = nothing(), same;
        char message[200] = "";
        metro_result result;
        image.width = 77;
        same = image;
        allocations_reset(-1);
        result = parse(bad[i].bytes, bad[i].size, &image, message, sizeof message);
        CHECK(result == METRO_ERROR_FORMAT, "case %d (%s) gave result %d", (int)i, bad[i].bytes, (int)result);
        CHECK(allocations_made == 0, "case %d (%s) allocated", (int)i, bad[i].bytes);
        CHECK(strlen(message) > 20 && strstr(message, bad[i].reason) != NULL, "case %d (%s): %s", (int)i,
              bad[i].bytes, message);
        CHECK(memcmp(&image, &same, sizeof image) == 0, "case %d (%s) changed the picture", (int)i, bad[i].bytes);
        if (result == METRO_OK) metro_image_free(&image);
    }
    CHECK(allocations_live == living, "leaked");
}

/* Every beginning of a good file is a bad file, and reads nothing beyond its end (the copy has exactly its size, so
   that a sanitizer sees a byte too many). */
static void refuses_every_beginning(void)
{
    static const struct {
        const char *bytes;
        size_t size;
    } good[] = { { BYTES("P6\n2 1\n255\n\1\2\3\4\5\6") }, { BYTES("P6\n2 1\n65535\n\1\2\3\4\5\6\1\2\3\4\5\6") },
                 { BYTES("P3\n2 1\n255\n1 2 3 4 5 6") }, { BYTES("Pf\n2 1\n-1.0\n\1\2\3\4\5\6\7\x08") },
                 { BYTES("PF #\n1 1\n1.0\n\1\2\3\4\5\6\7\x08\1\2\3\4") } };
    size_t i, size;
    for (i = 0; i < sizeof good / sizeof *good; i++)
        for (size = 0; size <= good[i].size; size++) {
            unsigned char *copy = (unsigned char *)malloc(size + (size == 0));
            metro_image image = nothing();
            metro_result result;
            if (copy == NULL) continue;
            memcpy(copy, good[i].bytes, size);
            result = metro_image_parse(copy, size, &image, NULL, 0);
            CHECK(result == (size < good[i].size ? METRO_ERROR_FORMAT : METRO_OK), "file %d, %d bytes: %d", (int)i,
                  (int)size, (int)result);
            metro_image_free(&image);
            free(copy);
        }
}

/* Catches: a message written beyond its end, or not closed. */
static void messages(void)
{
    metro_image image = nothing();
    char message[64];
    size_t size;
    for (size = 0; size < sizeof message; size++) {
        memset(message, 'x', sizeof message);
        CHECK(parse("P6 0 0 255 ", 11, &image, message, size) == METRO_ERROR_FORMAT, "0 x 0 was read");
        CHECK(size == 0 || strlen(message) < size, "not closed within %d bytes", (int)size);
        CHECK(message[size] == 'x', "written beyond %d bytes", (int)size);
    }
    CHECK(parse("P6 0 0 255 ", 11, &image, NULL, 0) == METRO_ERROR_FORMAT, "no message wanted");
    CHECK(parse("P6 0 0 255 ", 11, &image, NULL, 9) == METRO_ERROR_FORMAT, "no message wanted");
    CHECK(parse(NULL, 0, &image, message, sizeof message) == METRO_ERROR_FORMAT, "no bytes are an empty file");
    CHECK(parse(NULL, 5, &image, message, sizeof message) == METRO_ERROR_ARGUMENT && message[0] != 0, "NULL bytes");
    CHECK(parse("P6", 2, NULL, message, sizeof message) == METRO_ERROR_ARGUMENT && message[0] != 0, "NULL picture");
    CHECK(metro_image_load(NULL, &image, message, sizeof message) == METRO_ERROR_ARGUMENT && message[0] != 0,
          "NULL path");
    CHECK(metro_image_load("x", NULL, message, sizeof message) == METRO_ERROR_ARGUMENT && message[0] != 0,
          "NULL picture");
}

/* ---- writing ---- */

static metro_image random_picture(size_t width, size_t height, size_t channels)
{
    metro_image image = nothing();
    metro_rng rng = metro_rng_make(8, width);
    size_t i;
    if (metro_image_make(width, height, channels, &image) != METRO_OK) return image;
    for (i = 0; i < width * height * channels; i++)
        image.value[i] = (double)(float)ldexp(metro_rng_uniform(&rng) - 0.3, (int)metro_rng_below(&rng, 200) - 100);
    return image;
}

static int same_value(double a, double b)
{
    return isnan(a) ? isnan(b) : a == b && (a != 0 || signbit(a) == signbit(b));
}

/* Catches: rows upside down in one direction only, a value that loses bits, NaN cleaned away. */
static void pfm_round_trip(void)
{
    size_t channels, i;
    for (channels = 1; channels <= 3; channels += 2) {
        metro_image image = random_picture(7, 5, channels), back = nothing();
        const char *path = scratch("round.pfm");
        if (image.value == NULL) continue;
        image.value[3] = (double)NAN;
        image.value[8] = (double)INFINITY;
        image.value[9] = -(double)INFINITY;
        image.value[10] = -0.0;
        CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
        CHECK(metro_image_load(path, &back, NULL, 0) == METRO_OK, "cannot read %s", path);
        CHECK(back.width == 7 && back.height == 5 && back.channels == channels, "wrong shape");
        for (i = 0; back.value != NULL && i < 35 * channels; i++)
            CHECK(same_value(image.value[i], back.value[i]), "sample %d: %g came back as %g", (int)i, image.value[i],
                  back.value[i]);
        CHECK(metro_image_not_finite(&back) == 3, "counted %d", (int)metro_image_not_finite(&back));
        remove(path);
        metro_image_free(&image);
        metro_image_free(&back);
    }
}

/* The file, byte by byte. Catches: the machine's byte order, a mistake that reading makes as well and undoes. */
static void pfm_bytes(void)
{
    static const char truth[] = "PF\n1 2\n-1.0\n"
                                "\0\0\x80\x7f\0\0\x80\xff\0\0\x80\x7f\0\0\xc0\x3f\0\0\0\xc0\xff\xff\x7f\x7f";
    static const char grey_truth[] = "Pf\n1 2\n-1.0\n\0\0\0\xc0\0\0\xc0\x3f";
    unsigned char bytes[100];
    metro_image image = nothing();
    const char *path = scratch("bytes.pfm");
    size_t size;
    if (metro_image_make(1, 2, 3, &image) != METRO_OK) return;
    image.value[0] = 1.5;
    image.value[1] = -2;
    image.value[2] = 3.4028234663852886e38;
    image.value[3] = 3.5e38; /* beyond a float */
    image.value[4] = -1e300;
    image.value[5] = (double)INFINITY;
    CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
    size = read_bytes(path, bytes, sizeof bytes);
    CHECK(size == sizeof truth - 1 && memcmp(bytes, truth, size) == 0, "other bytes, %d of them", (int)size);
    image.channels = 1;
    CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
    size = read_bytes(path, bytes, sizeof bytes);
    CHECK(size == sizeof grey_truth - 1 && memcmp(bytes, grey_truth, size) == 0, "other bytes, %d of them",
          (int)size);
    remove(path);
    metro_image_free(&image);
}

/* Every one of the 256 values comes back as itself, and what cannot be shown has a defined value and is counted.
   Catches: rounding down, a cast of NaN or of a huge double (undefined), grey written as one channel. */
static void ppm_round_trip(void)
{
    static const double odd[6] = { -3.0, 1e300, 0.0031308, 0, 0, 0 };
    static const char odd_truth[] = "P6\n2 1\n255\n\0\xff\x0a\0\0\xff";
    static const char grey_truth[] = "P6\n2 1\n255\n\xbc\xbc\xbc\xff\xff\xff";
    unsigned char bytes[12 + 3 * 256 + 1], again[sizeof bytes];
    metro_image image = nothing();
    const char *path = scratch("round.ppm");
    size_t i, size, header;
    memcpy(bytes, "P6\n16 16\n255\n", header = 13);
    for (i = 0; i < 256; i++) {
        bytes[header + 3 * i] = (unsigned char)i;
        bytes[header + 3 * i + 1] = (unsigned char)(255 - i);
        bytes[header + 3 * i + 2] = (unsigned char)(7 * i & 255);
    }
    CHECK(metro_image_parse(bytes, sizeof bytes, &image, NULL, 0) == METRO_OK, "refused");
    CHECK(metro_image_save_ppm(&image, path) == METRO_OK, "cannot write %s", path);
    size = read_bytes(path, again, sizeof again);
    CHECK(size == sizeof bytes && memcmp(bytes, again, size) == 0, "the 256 values do not come back");
    CHECK(metro_image_not_finite(&image) == 0, "counted what is finite");
    metro_image_free(&image);

    if (metro_image_make(2, 1, 3, &image) != METRO_OK) return;
    memcpy(image.value, odd, sizeof odd);
    image.value[3] = (double)NAN;
    image.value[4] = -(double)INFINITY;
    image.value[5] = (double)INFINITY;
    CHECK(metro_image_save_ppm(&image, path) == METRO_OK, "cannot write %s", path);
    size = read_bytes(path, again, sizeof again);
    CHECK(size == sizeof odd_truth - 1 && memcmp(odd_truth, again, size) == 0, "odd values have other bytes");
    CHECK(metro_image_not_finite(&image) == 3, "counted %d of 3", (int)metro_image_not_finite(&image));
    image.channels = 1;
    image.value[0] = 0.502886458;
    CHECK(metro_image_save_ppm(&image, path) == METRO_OK, "cannot write %s", path);
    size = read_bytes(path, again, sizeof again);
    CHECK(size == sizeof grey_truth - 1 && memcmp(grey_truth, again, size) == 0, "grey has other bytes");
    remove(path);
    metro_image_free(&image);
    CHECK(metro_image_not_finite(&image) == 0 && metro_image_not_finite(NULL) == 0, "the empty picture");
}

/* Catches: a picture without pixels written as one. */
static void refuses_to_write(void)
{
    metro_image image = random_picture(2, 2, 3), broken;
    const char *path = scratch("never.pfm");
    int k;
    for (k = 0; k < 5; k++) {
        broken = image;
        if (k == 0) broken.width = 0;
        if (k == 1) broken.height = 0;
        if (k == 2) broken.channels = 2;
        if (k == 3) broken.value = NULL;
        CHECK(metro_image_save_pfm(k == 4 ? NULL : &broken, path) == METRO_ERROR_ARGUMENT, "case %d as PFM", k);
        CHECK(metro_image_save_ppm(k == 4 ? NULL : &broken, path) == METRO_ERROR_ARGUMENT, "case %d as PPM", k);
    }
    CHECK(metro_image_save_pfm(&image, NULL) == METRO_ERROR_ARGUMENT, "no path as PFM");
    CHECK(metro_image_save_ppm(&image, NULL) == METRO_ERROR_ARGUMENT, "no path as PPM");
    CHECK(!exists(path), "%s was written", path);
    metro_image_free(&image);
}

typedef metro_result (*save_function)(const metro_image *image, const char *path);

/* No file, no folder, a folder in place of a file, a file in place of a folder. Works as root too, whom no permission
   stops. Catches: a sibling left behind, a message without the name. */
static void unwritable(void)
{
    static const save_function save[2] = { metro_image_save_pfm, metro_image_save_ppm };
    metro_image image = random_picture(3, 2, 3), read = nothing();
    char message[300], path[400];
    int k;
    long living = allocations_live;
    snprintf(path, sizeof path, "%s", scratch("missing.pfm"));
    CHECK(metro_image_load(path, &read, message, sizeof message) == METRO_ERROR_FILE, "a missing file was read");
    CHECK(strstr(message, path) == message && strstr(message, "exists") != NULL, "the message is: %s", message);
    CHECK(metro_image_load(".", &read, message, sizeof message) == METRO_ERROR_FILE, "a folder was read: %s",
          message);
    CHECK(read.value == NULL, "a failure changed the picture");
    for (k = 0; k < 2; k++) {
        snprintf(path, sizeof path, "%s/no/such/folder.pfm", scratch("missing"));
        CHECK(save[k](&image, path) == METRO_ERROR_FILE, "written into a missing folder");
        CHECK(save[k](&image, ".") == METRO_ERROR_FILE, "written over a folder");
        CHECK(save[k](&image, "") == METRO_ERROR_FILE, "written to no name");
        remove(".tmp"); /* the sibling of the empty name */
        snprintf(path, sizeof path, "%s", scratch("plain"));
        CHECK(write_bytes(path, "x", 1), "cannot write %s", path);
        snprintf(path, sizeof path, "%s/in_a_file.pfm", scratch("plain"));
        CHECK(save[k](&image, path) == METRO_ERROR_FILE, "written into a file");
        remove(scratch("plain"));
    }
    CHECK(allocations_live == living, "leaked");
    metro_image_free(&image);
}

#ifndef _WIN32
/* Makes `path` a link to a device. Only links are written to here: a mistake that replaces a device would otherwise
   cost a machine its /dev/null. */
static int link_to(const char *device, const char *path)
{
    char command[700];
    snprintf(command, sizeof command, "ln -sf %s %s", device, path);
    return exists(device) && system(command) == 0;
}

static int is_device(const char *path)
{
    struct stat status;
    return stat(path, &status) == 0 && S_ISCHR(status.st_mode);
}
#endif

/* A full disk: the sibling is a link to /dev/full, where writing fails at the last flush. The older picture must stay
   and the sibling go. Catches: fclose not asked, the rename done all the same, the target opened first. */
static void full_disk(void)
{
#ifndef _WIN32
    static const save_function save[2] = { metro_image_save_pfm, metro_image_save_ppm };
    metro_image small = random_picture(3, 2, 3), large = random_picture(200, 100, 3);
    char path[300], sibling[310];
    unsigned char bytes[10];
    int k;
    snprintf(path, sizeof path, "%s", scratch("full"));
    snprintf(sibling, sizeof sibling, "%s.tmp", path);
    for (k = 0; k < 4; k++) {
        if (!link_to("/dev/full", sibling)) {
            fprintf(stderr, "  no /dev/full here: a full disk is not tried\n");
            break;
        }
        CHECK(write_bytes(path, "older", 5), "cannot write %s", path);
        CHECK(save[k % 2](k < 2 ? &small : &large, path) == METRO_ERROR_FILE, "a full disk was not noticed");
        CHECK(read_bytes(path, bytes, sizeof bytes) == 5 && memcmp(bytes, "older", 5) == 0, "the older file is gone");
        CHECK(!exists(sibling), "%s was left", sibling);
        remove(sibling);
        remove(path);
    }
    metro_image_free(&small);
    metro_image_free(&large);
#endif
}

/* Devices are written to, not replaced. Catches: the rename, which as root would turn /dev/null into a file. */
static void devices(void)
{
#ifndef _WIN32
    metro_image image = random_picture(3, 2, 3), read = nothing();
    char path[300], link[40];
    FILE *file;
    snprintf(path, sizeof path, "%s", scratch("device"));
    if (link_to("/dev/full", path)) {
        CHECK(metro_image_save_pfm(&image, path) == METRO_ERROR_FILE, "a full device was not noticed");
        CHECK(is_device(path), "/dev/full was replaced by a file");
    }
    if (link_to("/dev/null", path)) {
        CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "/dev/null takes everything");
        CHECK(is_device(path), "/dev/null was replaced by a file");
        CHECK(metro_image_load(path, &read, NULL, 0) == METRO_ERROR_FORMAT, "/dev/null is an empty file");
    }
    remove(path);
    /* What stands in /dev may be a link to an ordinary file, as /dev/stdout is behind a `>`. */
    snprintf(path, sizeof path, "%s", scratch("redirected.pfm"));
    file = fopen(path, "wb");
    if (file != NULL) {
        snprintf(link, sizeof link, "/dev/fd/%d", fileno(file));
        if (exists(link)) {
            CHECK(metro_image_save_pfm(&image, link) == METRO_OK, "cannot write %s", link);
            CHECK(metro_image_load(path, &read, NULL, 0) == METRO_OK && read.width == 3, "%s did not get it", path);
        }
        fclose(file);
    }
    remove(path);
    metro_image_free(&read);
    metro_image_free(&image);
#endif
}

/* A good save replaces an older file and leaves no sibling. */
static void replaces(void)
{
    metro_image image = random_picture(3, 2, 3), back = nothing();
    char path[300], sibling[310];
    snprintf(path, sizeof path, "%s", scratch("older.pfm"));
    snprintf(sibling, sizeof sibling, "%s.tmp", path);
    CHECK(write_bytes(path, "older", 5) && write_bytes(sibling, "left by a killed run", 20), "cannot write %s", path);
    CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
    CHECK(metro_image_load(path, &back, NULL, 0) == METRO_OK && back.width == 3, "not replaced");
    CHECK(!exists(sibling), "%s was left", sibling);
    remove(path);
    metro_image_free(&image);
    metro_image_free(&back);
}

/* ---- memory ---- */

/* Each allocation fails in turn. Catches: a result not looked at, a block that leaks on the way out, a file that
   stays. */
static void every_allocation_fails(void)
{
    metro_image image = random_picture(4, 3, 3), made = nothing();
    char path[300], out[300], message[400];
    long k, living = allocations_live;
    snprintf(path, sizeof path, "%s", scratch("memory.pfm"));
    snprintf(out, sizeof out, "%s", scratch("memory.out"));
    CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
    for (k = 1;; k++) {
        metro_image read = nothing();
        metro_result result;
        allocations_reset(k - 1);
        result = metro_image_load(path, &read, message, sizeof message);
        if (allocations_made < k) {
            CHECK(result == METRO_OK && k == 3, "two blocks were expected, not %ld", k - 1);
            metro_image_free(&read);
            break;
        }
        CHECK(result == METRO_ERROR_MEMORY && strstr(message, "memory") != NULL, "load, block %ld: %d", k,
              (int)result);
        CHECK(read.value == NULL && read.width == 0 && allocations_live == living, "load, block %ld: not clean",
              k);
    }
    for (k = 1;; k++) {
        metro_result pfm, ppm;
        allocations_reset(k - 1);
        pfm = metro_image_save_pfm(&image, out);
        if (allocations_made < k) break;
        allocations_reset(k - 1);
        ppm = metro_image_save_ppm(&image, out);
        CHECK(pfm == METRO_ERROR_MEMORY && ppm == METRO_ERROR_MEMORY, "save, block %ld", k);
        CHECK(!exists(out) && allocations_live == living, "save, block %ld: not clean", k);
    }
    allocations_reset(0);
    CHECK(metro_image_make(3, 3, 1, &made) == METRO_ERROR_MEMORY && made.value == NULL, "make");
    allocations_reset(-1);
    remove(path);
    remove(out);
    metro_image_free(&image);
}

/* A refused file costs its own size (and a byte), however large it says it is. Catches: pixels made before the
   check. */
static void refused_file_is_cheap(void)
{
    static const struct {
        const char *bytes;
        size_t size;
    } lie[] = { { BYTES("P6 5000 5000 255 \1\2\3") }, { BYTES("P3 3 1 255 0 0 0 0 0 0 0 0 x") },
                { BYTES("PF 2 1 -1.0\n123456789012345678901234567890") } };
    metro_image image = nothing();
    char path[300];
    size_t i;
    snprintf(path, sizeof path, "%s", scratch("lie"));
    for (i = 0; i < sizeof lie / sizeof *lie; i++) {
        CHECK(write_bytes(path, lie[i].bytes, lie[i].size), "cannot write %s", path);
        allocations_reset(-1);
        CHECK(metro_image_load(path, &image, NULL, 0) == METRO_ERROR_FORMAT, "lie %d was believed", (int)i);
        CHECK(allocations_bytes <= lie[i].size + 1, "lie %d cost %d bytes", (int)i, (int)allocations_bytes);
    }
    remove(path);
}

/* ---- the locale ---- */

/* Catches: strtod or printf with fractions, which read and write "1,0" here. */
static void decimal_comma(void)
{
    static const char *const name[] = { "de_DE.UTF-8", "de_DE.utf8", "de_DE", "fr_FR.UTF-8", "pl_PL.UTF-8",
                                        "German" };
    size_t i;
    for (i = 0; i < sizeof name / sizeof *name; i++)
        if (setlocale(LC_ALL, name[i]) != NULL && localeconv()->decimal_point[0] == ',') break;
    if (i == sizeof name / sizeof *name) {
        fprintf(stderr, "  no locale with a decimal comma is installed: it is not tried\n");
    } else {
        reads_pfm();
        pfm_bytes();
        pfm_round_trip();
        ppm_round_trip();
    }
    setlocale(LC_ALL, "C");
}

/* ---- the error of a picture ---- */

/* By hand: picture (1, 2), reference (2, 1) in grey: relative RMSE sqrt(2/5); mean 1.5, 0.01 m^2 = .0225, relMSE
   (1/4.0225 + 1/1.0225)/2. Catches: the picture's brightness in the denominator, the mean of squares in place of the
   square of the mean, a sum in place of a mean, a root too many. */
static void error_by_hand(void)
{
    double picture[2] = { 1, 2 }, truth[2] = { 2, 1 }, noise[2] = { 0.04, 0.01 }, relmse = 0;
    metro_image image = nothing(), reference = nothing(), variance = nothing();
    metro_image_difference difference;
    image.width = 2;
    image.height = image.channels = 1;
    reference = variance = image;
    image.value = picture;
    reference.value = truth;
    variance.value = noise;
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK_NEAR(difference.relative_rmse, sqrt(0.4), 1e-15);
    CHECK_NEAR(difference.relmse, (1 / 4.0225 + 1 / 1.0225) / 2, 1e-15);
    CHECK_NEAR(difference.mean, 1.5, 1e-15);
    CHECK_NEAR(difference.mean_reference, 1.5, 1e-15);
    CHECK(difference.largest == 1 && difference.x == 0 && difference.y == 0, "largest %g at %d %d",
          difference.largest, (int)difference.x, (int)difference.y);
    CHECK(metro_image_noise(&reference, &variance, &relmse) == METRO_OK, "refused");
    CHECK_NEAR(relmse, (0.04 / 4.0225 + 0.01 / 1.0225) / 2, 1e-15);
    truth[0] = 1;
    truth[1] = 3;
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK_NEAR(difference.relmse, (1 / 9.04) / 2, 1e-15);
}

/* Colour, against the formula written out with other loops. Catches: channels mixed up, luminance left out, x and y
   swapped. */
static void error_in_colour(void)
{
    enum { W = 5, H = 3 };
    metro_image image = nothing(), reference = nothing();
    metro_image_difference difference;
    metro_rng rng = metro_rng_make(8, 9);
    double top = 0, bottom = 0, mean = 0, mean_reference = 0, relmse = 0;
    size_t x, y;
    if (metro_image_make(W, H, 3, &image) != METRO_OK || metro_image_make(W, H, 3, &reference) != METRO_OK) return;
    for (x = 0; x < W * H * 3; x++) {
        image.value[x] = metro_rng_uniform(&rng);
        reference.value[x] = metro_rng_uniform(&rng);
    }
    image.value[(2 * W + 3) * 3 + 1] = 7.5;
    for (y = 0; y < H; y++)
        for (x = 0; x < W; x++) {
            const double *a = &image.value[(y * W + x) * 3], *b = &reference.value[(y * W + x) * 3];
            top += (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) + (a[2] - b[2]) * (a[2] - b[2]);
            bottom += b[0] * b[0] + b[1] * b[1] + b[2] * b[2];
            mean += (0.212671 * a[0] + 0.715160 * a[1] + 0.072169 * a[2]) / (W * H);
            mean_reference += (0.212671 * b[0] + 0.715160 * b[1] + 0.072169 * b[2]) / (W * H);
        }
    for (y = H; y-- > 0;)
        for (x = W; x-- > 0;) {
            const double *a = &image.value[(y * W + x) * 3], *b = &reference.value[(y * W + x) * 3];
            double ya = 0.212671 * a[0] + 0.715160 * a[1] + 0.072169 * a[2];
            double yb = 0.212671 * b[0] + 0.715160 * b[1] + 0.072169 * b[2];
            relmse += (ya - yb) * (ya - yb) / (yb * yb + 0.01 * mean_reference * mean_reference) / (W * H);
        }
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK_NEAR(difference.relative_rmse, sqrt(top / bottom), 1e-14);
    CHECK_NEAR(difference.relmse, relmse, 1e-14);
    CHECK_NEAR(difference.mean, mean, 1e-14);
    CHECK_NEAR(difference.mean_reference, mean_reference, 1e-14);
    CHECK(difference.x == 3 && difference.y == 2, "largest at %d %d", (int)difference.x, (int)difference.y);
    CHECK_NEAR(difference.largest, 7.5 - reference.value[(2 * W + 3) * 3 + 1], 1e-15);
    metro_image_free(&image);
    metro_image_free(&reference);
}

/* Catches: NaN skipped in silence, shapes that differ compared all the same. */
static void error_of_nonsense(void)
{
    metro_image image = random_picture(4, 3, 3), reference = random_picture(4, 3, 3), other = random_picture(3, 4, 3);
    metro_image grey = random_picture(4, 3, 1), none = nothing();
    metro_image_difference difference, same;
    double relmse = 5;
    memset(&difference, 0, sizeof difference);
    difference.largest = 5;
    same = difference;
    CHECK(metro_image_error(&image, &other, &difference) == METRO_ERROR_ARGUMENT, "another shape");
    CHECK(metro_image_error(&image, &grey, &difference) == METRO_ERROR_ARGUMENT, "other channels");
    CHECK(metro_image_error(&image, &none, &difference) == METRO_ERROR_ARGUMENT, "no reference");
    CHECK(metro_image_error(NULL, &image, &difference) == METRO_ERROR_ARGUMENT, "no picture");
    CHECK(metro_image_error(&image, &reference, NULL) == METRO_ERROR_ARGUMENT, "no difference");
    CHECK(metro_image_noise(&image, &other, &relmse) == METRO_ERROR_ARGUMENT && relmse == 5,
          "noise of another shape");
    CHECK(metro_image_noise(&image, NULL, &relmse) == METRO_ERROR_ARGUMENT && relmse == 5, "no noise");
    CHECK(metro_image_noise(&image, &image, NULL) == METRO_ERROR_ARGUMENT, "no place for the noise");
    CHECK(metro_image_noise(&image, &grey, &relmse) == METRO_OK, "noise in one channel");
    CHECK(memcmp(&difference, &same, sizeof same) == 0, "a failure changed the difference");

    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK(difference.relative_rmse == 0 && difference.relmse == 0 && difference.largest == 0,
          "equal pictures differ");
    image.value[(1 * 4 + 2) * 3] = (double)NAN;
    image.value[(2 * 4 + 2) * 3] = 1e30;
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK_NAN(difference.relative_rmse);
    CHECK_NAN(difference.relmse);
    CHECK_NAN(difference.mean);
    CHECK_NAN(difference.largest);
    CHECK(difference.x == 2 && difference.y == 1, "the NaN is at 2 1, not %d %d", (int)difference.x,
          (int)difference.y);
    image.value[(1 * 4 + 2) * 3] = (double)INFINITY;
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK(isinf(difference.relmse) && isinf(difference.relative_rmse) && isinf(difference.largest),
          "infinity was lost");
    memset(reference.value, 0, 36 * sizeof(double));
    image.value[(1 * 4 + 2) * 3] = 0;
    CHECK(metro_image_error(&image, &reference, &difference) == METRO_OK, "refused");
    CHECK(isinf(difference.relative_rmse) && !(difference.relmse < 1e300), "a black reference");
    metro_image_free(&image);
    metro_image_free(&reference);
    metro_image_free(&other);
    metro_image_free(&grey);
}

static void nothing_leaked(void)
{
    CHECK(allocations_live == 0, "%ld blocks are still alive", allocations_live);
}

/* A program that writes the same file over and over is killed at some moment. Catches: a picture written in place, of
   which half would be there. */
static void killed_run(void)
{
#ifndef _WIN32
    metro_image image = random_picture(150, 100, 3), read = nothing();
    char path[300], sibling[310], message[200];
    int k;
    snprintf(path, sizeof path, "%s", scratch("killed.pfm"));
    snprintf(sibling, sizeof sibling, "%s.tmp", path);
    for (k = 0; k < 12; k++) {
        struct timespec pause = { 0, 3000000 + 700000 * k };
        pid_t child;
        CHECK(metro_image_save_pfm(&image, path) == METRO_OK, "cannot write %s", path);
        fflush(NULL);
        child = fork();
        if (child == 0)
            for (;;) metro_image_save_pfm(&image, path);
        CHECK(child > 0, "cannot fork");
        if (child <= 0) break;
        nanosleep(&pause, NULL);
        kill(child, SIGKILL);
        waitpid(child, NULL, 0);
        CHECK(metro_image_load(path, &read, message, sizeof message) == METRO_OK, "after %d: %s", k, message);
        CHECK(read.width == 150 && read.height == 100, "another picture");
        metro_image_free(&read);
        remove(sibling);
    }
    remove(path);
    metro_image_free(&image);
#endif
}

int main(void)
{
    CHECK_RUN(make_and_free);
    CHECK_RUN(srgb_curve);
    CHECK_RUN(luminance);
    CHECK_RUN(reads_ppm);
    CHECK_RUN(reads_pfm);
    CHECK_RUN(reads_fractions);
    CHECK_RUN(refuses);
    CHECK_RUN(refuses_every_beginning);
    CHECK_RUN(messages);
    CHECK_RUN(pfm_round_trip);
    CHECK_RUN(pfm_bytes);
    CHECK_RUN(ppm_round_trip);
    CHECK_RUN(refuses_to_write);
    CHECK_RUN(unwritable);
    CHECK_RUN(full_disk);
    CHECK_RUN(killed_run);
    CHECK_RUN(devices);
    CHECK_RUN(replaces);
    CHECK_RUN(every_allocation_fails);
    CHECK_RUN(refused_file_is_cheap);
    CHECK_RUN(decimal_comma);
    CHECK_RUN(error_by_hand);
    CHECK_RUN(error_in_colour);
    CHECK_RUN(error_of_nonsense);
    CHECK_RUN(nothing_leaked);
    return check_done("pictures");
}
