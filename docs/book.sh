#!/bin/sh
# make docs, and the last step of make paper: weaves the book from metro.h, the lectures and the results in out/.
# With --check also runs the checks of the prose, compiles and runs the programs in it, and weaves twice to compare.
set -eu
weave=build/weave
mkdir -p out/book
$weave metro.h out out/book --tests tests --lectures docs
echo "the book is out/book/index.html"
[ "${1:-}" = --check ] || exit 0
$weave metro.h out out/book --tests tests --lectures docs --check
rm -rf build/book2 build/docs
mkdir -p build/book2 build/docs
$weave metro.h out build/book2 --tests tests --lectures docs > /dev/null
diff -r out/book build/book2 > /dev/null || { echo "weaving twice gives two books" >&2; exit 1; }
$weave metro.h out out/book --extract build/docs > /dev/null
awk '/^```c$/ { on = 1; next } /^```$/ { if (on) exit } on' README.md | cmp -s - examples/hello.c ||
    { echo "README does not show examples/hello.c as it is" >&2; exit 1; }
count=0
for program in build/docs/*.c; do
    [ -f "$program" ] || continue
    ${CC:-cc} -std=c99 -I. -o "${program%.c}" "$program" -lm -lpthread
    "${program%.c}" > /dev/null
    count=$((count + 1))
done
echo "the checks of the book pass; $count programs in its prose compile and run"
