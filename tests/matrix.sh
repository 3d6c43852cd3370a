#!/bin/sh
# make check: the header and its tests under every compiler, sanitizer, emulator and fuzzer that is installed.
# What is not installed is named and skipped. Every line is "ok", "FAILED" (with the output) or "skipped".
set -u
work=build/matrix
rm -rf "$work"
mkdir -p "$work"
skipped=""
jobs=0
cores=$(getconf _NPROCESSORS_ONLN 2> /dev/null || echo 1)
# The largest first, so that no core waits for a long one at the end.
tests=$(cd tests && ls -S test_*.c | sed 's/\.c$//')

strict="-Wall -Wextra -pedantic -Wconversion -Wshadow -Wdouble-promotion -Wcast-qual -Wvla"
strict_c="$strict -Wstrict-prototypes -Wmissing-prototypes"
# Of clang's -Weverything these say nothing of use here: comparisons of doubles with 0 are meant, padding is layout, C++98
# and C90 are not targets, and a header with contracts in prose declares what it does not use.
everything="-Weverything -Wno-unknown-warning-option -Wno-float-equal -Wno-padded -Wno-declaration-after-statement -Wno-unused-function
 -Wno-unused-macros -Wno-disabled-macro-expansion -Wno-covered-switch-default -Wno-switch-enum -Wno-reserved-identifier
 -Wno-reserved-id-macro -Wno-cast-align -Wno-c++98-compat -Wno-c++98-compat-pedantic -Wno-old-style-cast
 -Wno-zero-as-null-pointer-constant -Wno-unsafe-buffer-usage -Wno-documentation -Wno-poison-system-directories"

have() { command -v "$1" > /dev/null 2>&1; }

skip() {
    echo "skipped  $1"
    skipped="$skipped; $1"
}

# A job is a file, its name in the first line and its commands below. It is good when they succeed and print nothing.
cat > "$work/run.sh" << 'SH'
#!/bin/sh
job=$1
begin=$(date +%s)
name=$(sed -n '1s/^# //p' "$job")
if timeout 900 sh "$job" > "$job.log" 2>&1 && [ ! -s "$job.log" ]; then
    echo "ok       $name ($(($(date +%s) - begin)) s)"
else
    { echo "FAILED   $name"; tail -n 40 "$job.log" | sed 's/^/    /'; } > "$job.failed"
    cat "$job.failed"
fi
SH

# later NAME COMMANDS: notes a job
later() {
    jobs=$((jobs + 1))
    printf '# %s\n%s\n' "$1" "$2" > "$work/$(printf 'job%03d' $jobs)"
}

# together: runs the noted jobs, as many at once as there are cores
together() {
    ls "$work"/job??? | xargs -P "$cores" -n 1 sh "$work/run.sh"
    rm -f "$work"/job???
}

# ---- The header alone: every language version, no warning
cat > "$work/all.c" << 'C'
#define METRO_IMPLEMENTATION
#include "../../metro.h"
int main(void) { return 0; }
C
cat > "$work/static.c" << 'C'
#define min(a, b) ((a) < (b) ? (a) : (b))
#define max(a, b) ((a) > (b) ? (a) : (b))
#define METRO_STATIC
#include "../../metro.h"
#define METRO_IMPLEMENTATION
#include "../../metro.h"
#include "../../metro.h"
int metro_second(void);
int metro_second(void) { return metro_result_text(METRO_OK) == NULL; }
C
cp "$work/static.c" "$work/static2.c"
sed 's/^int metro_second.*//' "$work/static.c" > "$work/static3.c"
echo 'int metro_second(void); int main(void) { return metro_second(); }' >> "$work/static3.c"
cp "$work/all.c" "$work/all.cpp"
cp "$work/static.c" "$work/static.cpp"
for compiler in gcc clang; do
    have $compiler || { skip $compiler; continue; }
    for standard in c99 c11 c17 gnu99; do
        later "$compiler -std=$standard" "$compiler -std=$standard $strict_c -O2 -c -o /dev/null $work/all.c"
    done
    later "$compiler static, twice, after min and max" "$compiler -std=c99 $strict_c -O2 -c -o /dev/null $work/static.c"
    for option in METRO_NO_THREADS METRO_NO_TRACER METRO_NO_SIMD; do
        later "$compiler -D$option" "$compiler -std=c99 $strict_c -D$option -O2 -c -o /dev/null $work/all.c"
    done
    later "$compiler -O3 -march=native" "$compiler -std=gnu99 $strict_c -O3 -march=native -c -o /dev/null $work/all.c"
done
for compiler in g++ clang++; do
    have $compiler || { skip $compiler; continue; }
    for standard in c++11 c++17; do
        later "$compiler -std=$standard" "$compiler -std=$standard $strict -O2 -c -o /dev/null $work/all.cpp"
        later "$compiler -std=$standard static" "$compiler -std=$standard $strict -O2 -c -o /dev/null $work/static.cpp"
    done
done
if have clang; then
    later "clang -Weverything less a written list" "clang -std=c99 $(echo $everything) -c -o /dev/null $work/all.c"
fi
for compiler in tcc musl-gcc; do
    have $compiler || { skip $compiler; continue; }
    later "$compiler" "$compiler -Wall -c -o $work/$compiler.o $work/all.c"
done
if have gcc; then
    later "two files, METRO_STATIC in both" "gcc -std=c99 -o $work/two $work/static2.c $work/static3.c -lm"
    later "no symbol outside the prefix, no writable data" "gcc -std=c99 -O2 -c -o $work/all.o $work/all.c
        nm -g --defined-only $work/all.o | grep -vE ' (metro_[a-z0-9_]+|main)\$'
        nm $work/all.o | grep -E ' [bBdDC] '
        true"
    later "the same picture without SIMD" "for way in METRO_NO_SIMD METRO_WITH_SIMD; do
            gcc -std=gnu99 -O2 -D\$way -o $work/\$way examples/render.c -lm -lpthread
            $work/\$way examples/scenes/hidden.obj --size 32x32 --rounds 16 --out $work/\$way.pfm > /dev/null 2>&1
        done
        cmp $work/METRO_NO_SIMD.pfm $work/METRO_WITH_SIMD.pfm"
    later "no private macro leaks" \
        "gcc -std=c99 -dM -E $work/all.c | grep 'define METROI_' | grep -vE 'METROI_(UNUSED|H)\b' || true"
    later "examples, without a warning" "for f in examples/*.c; do
            gcc -std=c99 -Wall -Wextra -pedantic -fsyntax-only \$f
        done"
fi
later "pure ASCII" "LC_ALL=C grep -n '[^ -~	]' metro.h tests/*.[ch] examples/*.[ch] docs/*.c || true"
together

# ---- The tests, built and run in other ways
# suite NAME COMPILE-COMMAND [RUN-PREFIX]: every test must compile, and close with "N passed, 0 failed". The tests of a
# suite are shared out over the cores; each leaves its complaint, or an empty file.
cat > "$work/one.sh" << 'SH'
#!/bin/sh
t=$1
grep -q metro_scene "tests/$t.c" || COMPILE="$COMPILE -DMETRO_NO_TRACER"
{
    if ! $COMPILE -o "$WORK/$t" "tests/$t.c" -lm -lpthread > "$WORK/$t.log" 2>&1; then
        echo "$t does not compile:"
    elif timeout 900 $PREFIX "$WORK/$t" > "$WORK/$t.log" 2>&1 && tail -n 1 "$WORK/$t.log" | grep -q ' passed, 0 failed$'; then
        exit 0
    else
        echo "$t:"
    fi
    tail -n 15 "$WORK/$t.log"
} > "$WORK/$t.result"
SH
suite() {
    rm -f "$work"/*.result
    begin=$(date +%s)
    for t in $tests; do echo "$t"; done |
        WORK=$work COMPILE=$2 PREFIX=${3:-} xargs -P "$cores" -n 1 sh "$work/one.sh"
    if cat "$work"/*.result | grep . > "$work/log" || [ "$(ls "$work"/*.result | wc -l)" -ne "$(echo "$tests" | wc -w)" ]; then
        jobs=$((jobs + 1))
        { echo "FAILED   tests: $1"; sed 's/^/    /' "$work/log"; } > "$work/suite$jobs.failed"
        cat "$work/suite$jobs.failed"
    else
        echo "ok       tests: $1 ($(($(date +%s) - begin)) s)"
    fi
}

export METRO_TEST_SCALE=0.2
have gcc && suite "gcc -O3 -march=native -std=gnu99" "gcc -std=gnu99 -O3 -march=native"
have clang && suite "clang -O2" "clang -std=c99 -O2"
export METRO_TEST_SCALE=0.1
have g++ && suite "g++ -std=c++11" "g++ -x c++ -std=c++11 -O1"
have musl-gcc && suite "musl, static" "musl-gcc -std=c99 -O2 -static"
export METRO_TEST_SCALE=0.05 # tcc does not optimise
have tcc && suite "tcc" "tcc"
export METRO_TEST_SCALE=0.1
if have clang && clang -fsanitize=address,undefined -o "$work/a.out" "$work/all.c" -lm > /dev/null 2>&1; then
    UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 ASAN_OPTIONS=detect_leaks=1:allocator_may_return_null=1
    export UBSAN_OPTIONS ASAN_OPTIONS
    suite "address and undefined behaviour" "clang -std=c99 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all"
    tests_of_threads="test_ground test_chain test_ensemble test_mlt test_bundles"
    all=$tests
    tests=$(for t in $tests_of_threads; do [ -f "tests/$t.c" ] && echo "$t"; done)
    suite "threads" "clang -std=c99 -O1 -g -fsanitize=thread"
    tests=$all
else
    skip "sanitizers (clang and its runtime)"
fi

# ---- Ten million rays at edges and vertices, and as many for the equality of the traversals, where multiplications and
# additions may be contracted
# rays NAME COMPILE-COMMAND
rays() {
    later "1e7 rays: $1" "$2 -o $work/rays_${1%% *} tests/test_bvh.c -lm -lpthread || exit
        METRO_TEST_SCALE=1 METRO_BVH_RAYS=1e7 $work/rays_${1%% *} > $work/rays_${1%% *}.log 2>&1 || cat $work/rays_${1%% *}.log"
}
have gcc && rays "gcc -O3 -march=native -std=gnu99" "gcc -std=gnu99 -O3 -march=native"
have clang && rays "clang -O3 -march=native" "clang -std=gnu99 -O3 -march=native"
together

# Under an emulator the tests run at a smaller scale, and those that render for long not at all.
export METRO_TEST_SCALE=0.02
export METRO_BVH_RAYS=20000
tests=$(for t in $tests; do case $t in test_mlt | test_paths | test_bundles) ;; *) echo "$t" ;; esac; done)
if have valgrind; then
    suite "valgrind" "gcc -std=c99 -O1 -g" "valgrind -q --error-exitcode=9 --leak-check=full"
else
    skip valgrind
fi
# emulated NAME COMPILER FLAGS EMULATOR
emulated() {
    if have "$2" && have "$4"; then suite "$1" "$2 -std=c99 -O2 -static $3" "$4"; else skip "$1 ($2, $4)"; fi
}
emulated "aarch64" aarch64-linux-gnu-gcc "" qemu-aarch64
emulated "s390x, big endian" s390x-linux-gnu-gcc "" qemu-s390x
emulated "i686" i686-linux-gnu-gcc "-msse2 -mfpmath=sse" qemu-i386

# ---- Fuzzers
echo '#include <stddef.h>
int LLVMFuzzerTestOneInput(const unsigned char *bytes, size_t count) { return bytes == NULL && count > 0; }' > "$work/fuzz.c"
for fuzz in tests/fuzz_*.c; do
    target=$(basename "$fuzz" .c)
    if have clang && clang -fsanitize=fuzzer,address,undefined -o "$work/fuzz" "$work/fuzz.c" > /dev/null 2>&1; then
        mkdir -p "$work/corpus_$target"
        later "$target" "clang -std=c99 -O1 -g -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all \\
            -o $work/$target $fuzz -lm || exit
        $work/$target -max_total_time=20 -rss_limit_mb=512 -max_len=4096 -artifact_prefix=$work/ \\
            $work/corpus_$target > $work/$target.log 2>&1 || { tail -n 30 $work/$target.log; exit 1; }"
    else
        skip "$target (clang with libFuzzer)"
    fi
done
together

if [ -n "$skipped" ]; then echo "not installed, so skipped: ${skipped#; }"; fi
failures=$(ls "$work" | grep -c '\.failed$')
if [ "$failures" -gt 0 ]; then
    echo "make check: $failures failed"
    exit 1
fi
echo "make check: all ok"
