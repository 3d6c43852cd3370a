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
if [ -f out/claims.csv ]; then # every claim that examples/claims.c knows has its line in the book, in the same words
    tail -n +2 out/claims.csv | while IFS=, read -r key section statement rest; do
        line="| $section | $statement | [value: claims.csv, key=$key, measurement, %s] | \
**[value: claims.csv, key=$key, verdict, %s]** |"
        grep -qxF "$line" docs/claims.md || { echo "docs/claims.md lacks the line $line" >&2; exit 1; }
    done
fi
count=0
for program in build/docs/*.c; do
    [ -f "$program" ] || continue
    ${CC:-cc} -std=c99 -I. -o "${program%.c}" "$program" -lm -lpthread
    "${program%.c}" > /dev/null
    count=$((count + 1))
done
echo "the checks of the book pass; $count programs in its prose compile and run"
