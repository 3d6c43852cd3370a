/* fuzz_scenes.c - bytes that nobody meant to be a scene, for chapter 9.

       clang -g -O1 -fsanitize=fuzzer,address,undefined tests/fuzz_scenes.c -o fuzz -lm -lpthread && ./fuzz
       cc -g -O1 -DFUZZ_STANDALONE -fsanitize=address,undefined tests/fuzz_scenes.c -o fuzz -lm -lpthread && ./fuzz

   The second form needs no fuzzer: it runs the files that it is given, or 100000 mutations (METRO_TEST_SCALE shrinks
   the number) of small good files, the same ones each time. A byte 0 divides the input: the OBJ stands before it and
   the MTL behind it. */

#include <stddef.h>
#include <stdlib.h>

/* The allocator counts what is asked for, because a file must not cost more than its size allows, and fails where the
   input says so. */
static size_t fuzz_bytes = 0, fuzz_living = 0, fuzz_left = (size_t)-1;

static void *fuzz_resize(void *block, size_t size)
{
    void *moved;
    if (fuzz_left == 0) return NULL;
    if (fuzz_left != (size_t)-1) fuzz_left--;
    fuzz_bytes += size;
    moved = realloc(block, size);
    fuzz_living += block == NULL && moved != NULL;
    return moved;
}

static void fuzz_free(void *block)
{
    fuzz_living -= block != NULL;
    free(block);
}

#define METRO_MALLOC(size) fuzz_resize(NULL, size)
#define METRO_REALLOC(pointer, size) fuzz_resize(pointer, size)
#define METRO_FREE(pointer) fuzz_free(pointer)

#define METRO_IMPLEMENTATION
#include "../metro.h"
#define FUZZ_NAME "fuzz_scenes"
#include "fuzz.h"

/* What must hold for a scene that was read: there are no more triangles than the file has room for, all materials
   exist and keep energy, the getters agree with each other, and the scene builds and answers a ray. */
static void fuzz_good(metro_scene *scene, size_t size)
{
    uint32_t i;
    metro_vec3 low, high;
    metro_camera camera;
    metro_hit hit;
    FUZZ_DEMAND(scene->triangle_count > 0 && scene->triangle_count <= size);
    FUZZ_DEMAND(scene->material_count <= size);
    for (i = 1; i <= scene->material_count; i++) {
        const metro_material *m = metro_scene_material(scene, i);
        FUZZ_DEMAND(m->kd.x >= 0 && m->ks.x >= 0 && m->kd.x + m->ks.x <= 1 + 2e-9);
        FUZZ_DEMAND(m->kd.y >= 0 && m->ks.y >= 0 && m->kd.y + m->ks.y <= 1 + 2e-9);
        FUZZ_DEMAND(m->kd.z >= 0 && m->ks.z >= 0 && m->kd.z + m->ks.z <= 1 + 2e-9);
        FUZZ_DEMAND(m->ns >= 0 && isfinite(m->ns) && isfinite(m->ke.x) && isfinite(m->ke.y) && isfinite(m->ke.z));
    }
    for (i = 0; i < scene->triangle_count; i++) {
        double area = metro_scene_area(scene, i);
        metro_vec3 normal = metro_scene_normal(scene, i);
        FUZZ_DEMAND(metro_scene_material(scene, scene->material_of[i]) != NULL);
        FUZZ_DEMAND(isnan(area) || (area >= 0 && isfinite(area)));
        FUZZ_DEMAND(!(area > 0) || fabs(metro_length(normal) - 1) < 1e-12);
    }
    if (metro_scene_bounds(scene, &low, &high) == METRO_OK) {
        FUZZ_DEMAND(low.x <= high.x && low.y <= high.y && low.z <= high.z);
        FUZZ_DEMAND(metro_scene_frame(scene, &camera) == METRO_OK && isfinite(camera.eye.z));
    }
    if (metro_scene_build(scene) != METRO_OK) return; /* lamps too bright for a number, say */
    FUZZ_DEMAND(scene->light_count == 0 || scene->light_sum[scene->light_count - 1] == 1);
    if (metro_scene_hit(scene, metro_vec3_make(0.3, 0.3, 9), metro_vec3_make(0, 0, -1), 0, 1e30, &hit))
        FUZZ_DEMAND(hit.triangle < scene->triangle_count && hit.t > 0 && hit.t < 1e30);
}

static void fuzz_once(const uint8_t *bytes, size_t size, size_t left)
{
    const uint8_t *end = (const uint8_t *)memchr(bytes, 0, size);
    size_t obj = end != NULL ? (size_t)(end - bytes) : size, mtl = end != NULL ? size - obj - 1 : 0;
    size_t message_size = size % 300, living = fuzz_living;
    metro_scene scene, empty;
    char message[301];
    metro_result result;
    memset(&scene, 0, sizeof scene);
    memset(&empty, 0, sizeof empty);
    memset(message, 'x', sizeof message);
    fuzz_bytes = 0;
    fuzz_left = left;
    result = metro_scene_parse_obj(&scene, bytes, obj, end != NULL ? end + 1 : NULL, mtl, message, message_size);
    fuzz_left = (size_t)-1;
    FUZZ_DEMAND(result == METRO_OK || result == METRO_ERROR_FORMAT || (result == METRO_ERROR_MEMORY && left < 1000));
    FUZZ_DEMAND(message[message_size] == 'x');
    FUZZ_DEMAND(message_size == 0 || memchr(message, 0, message_size) != NULL);
    /* Two bytes of a file may become a triangle of 40, and lists that grow by half ask for four times their size. */
    FUZZ_DEMAND(fuzz_bytes <= 5000 + 120 * size);
    if (result == METRO_OK) {
        fuzz_good(&scene, size);
    } else {
        FUZZ_DEMAND(message_size == 0 || message_size == 1 || message[0] != 0);
        FUZZ_DEMAND(memcmp(&scene, &empty, sizeof scene) == 0 && fuzz_living == living);
    }
    metro_scene_free(&scene);
    FUZZ_DEMAND(fuzz_living == living);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size)
{
    if (size == 0) return 0;
    fuzz_once(bytes, size, (size_t)-1);
    fuzz_once(bytes, size, bytes[size - 1] % 16);
    return 0;
}

#ifdef FUZZ_STANDALONE

int main(int count, char **argument)
{
    static const char *const word[] = {
        "\nf 1 2 3 4\n", "\nv 0 0 0\n", " -1 ", " 1e39 ", "nan ", "\\\n", "\r\n", "\nusemtl a\n",
        "\nmtllib a b\n", "\nnewmtl b\n", "Kd ", "\nKs 1 1 1\n", "\n# camera eye ", " look 1 2 3",
        " -99999999999999999999", "//1", "\nKe 1e308", "\nillum 7\n", "\nd .5\n", "\xef\xbb\xbf", "#", "\t",
        " 2 3 1 4 2 1 3 3 4"
    };
    static const fuzz_text good[] = {
        FUZZ_TEXT("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n\0newmtl a\nKd .5 .5 .5\n"
                  "Ks .25\nNs 20\nKe 1 2 3\nd 1\nillum 2\n"),
        FUZZ_TEXT("# camera eye 0 1 4 look 0 1 0 up 0 1 0 fov 40\r\nv 0 0 0\r\nv 4 0 0\r\nv 1 1 0\r\n"
                  "v 0 4 0\r\nf -4/1/1 -3//1 -2/1 -1\r\n"),
        FUZZ_TEXT(
                  "v 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 0\nv 1 1 0\nv 1 3 0\nv 3 3 0\nv 3 1 0\nusemtl a\nf 1 2 3 4 1 "
                  "5 6 7 8 5\nusemtl b b\nf 1 2 \\\n3\n\0newmtl b b\nKe 1\nnewmtl a\nmap_Kd a.png\nKd .8 .9 1\n"
                  "Ks .5 .5 .5\n")
    };
    return fuzz_main(count, argument, good, sizeof good / sizeof *good, word, sizeof word / sizeof *word, 100000);
}

#endif
