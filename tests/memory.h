/* memory.h: include it before metro.h, and every allocation of the library is counted, and the k-th can be made to
   fail. */

#ifndef MEMORY_H
#define MEMORY_H

#include <stdlib.h>

static long allocations_left = -1; /* how many still succeed; -1: all */
static long allocations_made = 0, allocations_live = 0;

static void *counted_malloc(size_t size)
{
    void *memory;
    if (allocations_left == 0) return NULL;
    if (allocations_left > 0) allocations_left--;
    memory = malloc(size);
    allocations_made++;
    if (memory != NULL) allocations_live++;
    return memory;
}

static void counted_free(void *memory)
{
    if (memory != NULL) allocations_live--;
    free(memory);
}

#define METRO_MALLOC(size) counted_malloc(size)
#define METRO_REALLOC(pointer, size) realloc(pointer, size)
#define METRO_FREE(pointer) counted_free(pointer)

#endif
