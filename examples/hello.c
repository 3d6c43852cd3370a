/* hello.c: does a chain still know where it started? The theory says how far its density is from uniform (0 is
   forgotten), the experiment how many of 20000 chains are in the quarter around the seed (25 % is forgotten). */
#define METRO_IMPLEMENTATION
#include "../metro.h"

int main(void)
{
    metro_kernel kernel = { METRO_UNIFORM, 0.1, 0, 0 }; /* steps of up to 0.05 either way on a circle of length 1 */
    for (uint64_t n = 1; n <= 1000; n *= 10) {
        int near = 0;
        for (uint64_t chain = 0; chain < 20000; chain++) {
            metro_rng rng = metro_rng_make(n, chain);
            double x = 0;
            for (uint64_t i = 0; i < n; i++) x = metro_kernel_perturb(&kernel, x, &rng);
            near += x < 0.125 || x > 0.875;
        }
        printf("%4d steps: error %.4f, %.1f %% near the seed\n", (int)n, metro_startup_error(&kernel, n),
               near / 200.0);
    }
}
