/* memory.h: include it before metro.h, and every block that the library asks for is counted, and any one can be
   refused. */

#ifndef MEMORY_H
#define MEMORY_H

#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>

static long allocations_left = -1; /* the block behind so many is refused, those after it are not; -1: none */
static long allocations_made = 0;  /* blocks asked for, larger ones in place of smaller ones included */
static long allocations_live = 0;
static size_t allocations_bytes = 0; /* asked for */

static inline void allocations_reset(long left)
{
    allocations_left = left;
    allocations_made = 0;
    allocations_bytes = 0;
}

static inline int allocation_refused(size_t size)
{
    allocations_made++;
    allocations_bytes += size;
    if (allocations_left < 0) return 0;
    return allocations_left-- == 0;
}

static inline void *counted_malloc(size_t size)
{
    void *memory = allocation_refused(size) ? NULL : malloc(size);
    if (memory != NULL) allocations_live++;
    return memory;
}

static inline void *counted_realloc(void *memory, size_t size)
{
    if (memory == NULL) {
        fprintf(stderr, "METRO_REALLOC was called with NULL, which a user's own need not know\n");
        abort();
    }
    return allocation_refused(size) ? NULL : realloc(memory, size);
}

static inline void counted_free(void *memory)
{
    if (memory != NULL) allocations_live--;
    free(memory);
}

#define METRO_MALLOC(size) counted_malloc(size)
#define METRO_REALLOC(memory, size) counted_realloc(memory, size)
#define METRO_FREE(memory) counted_free(memory)

#endif
