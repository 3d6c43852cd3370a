#!/bin/sh
# make check: the header and its tests under every compiler, sanitizer, emulator and fuzzer that is installed.
# What is not installed is named and skipped. Every line is "ok", "FAILED" (with the output) or "skipped".
set -u
work=build/matrix
rm -rf "$work"
mkdir -p "$work"
failures=0
skipped=""
clock=$(date +%s)
tests=$(cd tests && ls test_*.c | sed 's/\.c$//')

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

# run NAME COMMAND...: good when the command succeeds and prints nothing
run() {
    name=$1
    shift
    if timeout 900 "$@" > "$work/log" 2>&1 && [ ! -s "$work/log" ]; then
        echo "ok       $name ($(($(date +%s) - clock)) s)"
    else
        echo "FAILED   $name"
        tail -n 40 "$work/log" | sed 's/^/    /'
        failures=$((failures + 1))
    fi
    clock=$(date +%s)
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
        run "$compiler -std=$standard" $compiler -std=$standard $strict_c -O2 -c -o "$work/a.o" "$work/all.c"
    done
    run "$compiler static, twice, after min and max" $compiler -std=c99 $strict_c -O2 -c -o "$work/a.o" "$work/static.c"
    for option in METRO_NO_THREADS METRO_NO_TRACER; do
        run "$compiler -D$option" $compiler -std=c99 $strict_c -D$option -O2 -c -o "$work/a.o" "$work/all.c"
    done
    run "$compiler -O3 -march=native" $compiler -std=gnu99 $strict_c -O3 -march=native -c -o "$work/a.o" "$work/all.c"
done
for compiler in g++ clang++; do
    have $compiler || { skip $compiler; continue; }
    for standard in c++11 c++17; do
        run "$compiler -std=$standard" $compiler -std=$standard $strict -O2 -c -o "$work/a.o" "$work/all.cpp"
        run "$compiler -std=$standard static" $compiler -std=$standard $strict -O2 -c -o "$work/a.o" "$work/static.cpp"
    done
done
if have clang; then
    run "clang -Weverything less a written list" clang -std=c99 $everything -c -o "$work/a.o" "$work/all.c"
fi
for compiler in tcc musl-gcc; do
    have $compiler || { skip $compiler; continue; }
    run "$compiler" $compiler -Wall -c -o "$work/a.o" "$work/all.c"
done
if have gcc; then
    gcc -std=c99 -c -o "$work/one.o" "$work/static2.c" && gcc -std=c99 -c -o "$work/two.o" "$work/static3.c"
    run "two files, METRO_STATIC in both" gcc -o "$work/two" "$work/one.o" "$work/two.o" -lm
    gcc -std=c99 -O2 -c -o "$work/a.o" "$work/all.c"
    run "no symbol outside the prefix" sh -c "! nm -g --defined-only $work/a.o | grep -vE ' (metro_[a-z0-9_]+|main)$'"
    run "no writable data" sh -c "! nm $work/a.o | grep -E ' [bBdDC] '"
    run "no private macro leaks" sh -c "! gcc -std=c99 -dM -E $work/all.c | grep 'define METROI_' | grep -vE 'METROI_(UNUSED|H)\b'"
fi
run "pure ASCII" sh -c "! LC_ALL=C grep -n '[^ -~	]' metro.h tests/*.[ch] examples/*.[ch] docs/*.c"

# ---- The tests, built and run in other ways
# suite NAME COMPILE-COMMAND [RUN-PREFIX]: every test must compile, and close with "N passed, 0 failed". The tests of a
# suite are shared out over the cores; each leaves its complaint, or an empty file.
cores=$(getconf _NPROCESSORS_ONLN 2> /dev/null || echo 1)
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
    for t in $tests; do echo "$t"; done |
        WORK=$work COMPILE=$2 PREFIX=${3:-} xargs -P "$cores" -n 1 sh "$work/one.sh"
    run "tests: $1" cat "$work"/*.result
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
rays() {
    run "1e7 rays: $1" sh -c "$2 -o $work/rays tests/test_bvh.c -lm -lpthread &&
        METRO_TEST_SCALE=1 METRO_BVH_RAYS=1e7 $work/rays > $work/rays.log 2>&1 || { cat $work/rays.log; exit 1; }"
}
have gcc && rays "gcc -O3 -march=native -std=gnu99" "gcc -std=gnu99 -O3 -march=native"
have clang && rays "clang -O3 -march=native" "clang -std=gnu99 -O3 -march=native"

# Under an emulator the tests run at a smaller scale, and those that render for
# long not at all.
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
for fuzz in tests/fuzz_*.c; do
    target=$(basename "$fuzz" .c)
    if have clang && clang -std=c99 -O1 -g -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all \
        -o "$work/$target" "$fuzz" -lm > /dev/null 2>&1; then
        mkdir -p "$work/corpus_$target"
        if timeout 300 "$work/$target" -max_total_time=20 -rss_limit_mb=512 -max_len=4096 -artifact_prefix="$work/" \
            "$work/corpus_$target" > "$work/log" 2>&1; then
            echo "ok       $target"
        else
            echo "FAILED   $target"
            tail -n 30 "$work/log" | sed 's/^/    /'
            failures=$((failures + 1))
        fi
    else
        skip "$target (clang with libFuzzer)"
    fi
done

if [ -n "$skipped" ]; then echo "not installed, so skipped: ${skipped#; }"; fi
if [ $failures -gt 0 ]; then
    echo "make check: $failures failed"
    exit 1
fi
echo "make check: all ok"
