/* kernels.h: the structs that most tests fill in, in one line each. Include it after metro.h. */

#ifndef KERNELS_H
#define KERNELS_H

#include <string.h>

static inline metro_kernel kernel_make(metro_shape shape, double size, double size_min, double large)
{
    metro_kernel k;
    k.shape = shape;
    k.size = size;
    k.size_min = size_min;
    k.large = large;
    return k;
}

static inline metro_kernel uniform_kernel(double size)
{
    return kernel_make(METRO_UNIFORM, size, 0, 0);
}

/* METRO_KELEMEN gets a smallest step of a sixteenth. */
static inline metro_axis axis_of(metro_axis_kind kind, metro_shape shape, double size)
{
    metro_axis axis;
    axis.kind = kind;
    axis.kernel = kernel_make(shape, size, size / 16, 0);
    return axis;
}

/* A target that keeps no samples and records nothing. */
static inline metro_target target_of(const metro_axis *axes, size_t count,
                                     double (*importance)(const double *z, void *sample, void *user), void *user)
{
    metro_target target;
    memset(&target, 0, sizeof target);
    target.axes = axes;
    target.axis_count = count;
    target.importance = importance;
    target.user = user;
    return target;
}

#endif
