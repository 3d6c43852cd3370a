#!/bin/sh
# How long a lesson that uses the laboratory (chapters 1 to 8) takes to compile: the best of five, in seconds.
mkdir -p build
for compiler in "${CC:-cc} -O2" "gcc -O2" "clang -O2" "tcc"; do
    command -v ${compiler%% *} > /dev/null 2>&1 || continue
    best=
    for i in 1 2 3 4 5; do
        start=$(date +%s%N)
        $compiler -DMETRO_NO_TRACER -o build/lesson examples/hello.c -lm || exit 1
        elapsed=$(( ($(date +%s%N) - start) / 1000000 ))
        if [ -z "$best" ] || [ "$elapsed" -lt "$best" ]; then best=$elapsed; fi
    done
    printf 'compile hello.c with %-10s %5d ms\n' "$compiler" "$best"
done
rm -f build/lesson
