#!/bin/sh
# Races the ray queries of chapter 10 against Embree, where its library is installed (Debian: libembree-dev).
program=build/bench_bvh
mkdir -p build
compile="${CC:-cc} -std=gnu99 -O2 -o $program tests/bench_bvh.c"
if ! $compile -lembree3 -lm 2> /dev/null; then $compile -DNO_EMBREE -lm || exit 1; fi
exec $program "$@"
