#!/bin/sh
# test_weave.sh [WEAVE] - plants each kind of mistake in a small book and expects weave --check to name it, at its
# line. Run from the top of the project. The last line counts; the exit status is 0 when none failed.
set -u
weave=$(cd "$(dirname "${1:-build/weave}")" && pwd)/$(basename "${1:-build/weave}")
work=$(mktemp -d) || exit 1
trap 'rm -rf "$work"' EXIT
cd "$work" || exit 1
passed=0
failed=0

result() { # result NAME STATUS: counts one case
    if [ "$2" -eq 0 ]; then
        passed=$((passed + 1))
    else
        failed=$((failed + 1))
        echo "FAILED $1" >&2
        cat message >&2
    fi
}

run() { # run ARGUMENT...: weave in the sample's folder; leaves its messages and its status
    "$weave" "$@" > output 2> message
    status=$?
}

sample() { # a book that has one of everything and no mistake
    rm -rf out book docs tests
    mkdir out docs tests
    cat > metro.h << 'SAMPLE'
/* metro.h - a sample.

   It uses `metro_add`; section 1.1 defines it. This program compiles:

       #define METRO_IMPLEMENTATION
       #include "metro.h"

       int main(void)
       {
           return metro_add(1, 2) != 3;
       }

   Contents

       R1 Ground
       1 Ground
         1.1 Sums
       A Equations of the paper
*/

#ifndef METRO_H
#define METRO_H
#define METRO_API extern

/* # R1 Ground

   All of it. */

/* Adds $a_i + b^2$, by eq 1.1. */
METRO_API double metro_add(double a, double b);

/* A pair. */
typedef struct {
    double x, y; /* both */
} metro_pair;

METRO_API double metro_first(metro_pair pair);
METRO_API double metro_same(double x); /* x */

#endif
#if defined(METRO_IMPLEMENTATION)

/* # 1 Ground

   The mean is [value: size.csv, Delta=0.1 M=100, mse, %.2g], not [value: none.csv, row 1, mse, %g].

   [figure: chart.svg | The error $E_n$,
   in a caption of two lines.]

   [figure: later.svg | A chart that no run has made.]

       S = sum_{i=1}^{M} frac{x_i}{sqrt{2 pi}} + P*(k)^{2n}                             (1.1)

       f(x) = x_0      for x < 1,
            = 1e-12    otherwise                                                        (1.2)

   The second, eq 1.2, is paper (12); see chapter R1 and appendix A. */

/* # 1.1 Sums */

METRO_API double metro_add(double a, double b)
{
    return a + b; /* eq 1.1 */
}

METRO_API double metro_first(metro_pair pair)
{
    return pair.x;
}

METRO_API double metro_same(double x)
{
    return x;
}
#endif

/* # A Equations of the paper

   | paper | here |
SAMPLE
    number=1
    while [ $number -le 19 ]; do
        echo "   | paper ($number) | eq 1.1 |" >> metro.h
        number=$((number + 1))
    done
    echo '*/' >> metro.h
    printf '# made by size\nDelta,M,mse\n0.1,100,1.5e-05\n0.1,1000,3\n0.2,100,4\n' > out/size.csv
    printf '<?xml version="1.0"?>\n<svg viewBox="0 0 9 9"><path d="M0 0"/></svg>\n' > out/chart.svg
    printf '# A lecture\n\nSee *eq 1.1* and section 1.1.\n\n[function: metro_add]\n\n9. Nine\n   words.\n10. Ten\n    more.\n11. Last.\n' > docs/first.md
    printf '\n| a | b |\n|---|---|\n| 1 | 2 |\n' >> docs/first.md
    echo 'int main(void) { return metro_add(1, 2) + metro_first(p) + metro_same(1); }' > tests/test_all.c
}

check() { run metro.h out book --tests tests --lectures docs --check; }

# mistake NAME FILE EDIT MESSAGE: plants the edit of sed in the file; weave must fail, and say the message (a regular
# expression, which begins behind the name of the file).
mistake() {
    sample
    sed "$3" "$2" > edited && mv edited "$2"
    check
    [ $status -eq 1 ] && grep -q "^$2:$4" message
    result "$1" $?
}

holds() { # holds NAME FILE TEXT: the file holds the text
    grep -qF -- "$3" "$2"
    result "$1" $?
}

# The good book, what it holds, and that it is the same a second time.
sample
check
[ $status -eq 0 ] && [ ! -s message ]
result "a good book" $?
holds "a formula" book/index.html '<mfrac><mrow><msub><mi>x</mi><mrow><mi>i</mi></mrow></msub></mrow><mrow><msqrt>'
holds "the text of a formula" book/index.html 'alttext="S = sum_{i=1}^{M} frac{x_i}{sqrt{2 pi}} + P*(k)^{2n}"'
holds "a value" book/index.html '1.5&nbsp;&times;&nbsp;10<sup>&minus;5</sup>'
holds "a missing value" book/index.html 'none.csv: run <code>make paper</code>'
holds "a figure" book/index.html '<svg viewBox="0 0 9 9"><path d="M0 0"/></svg>'
holds "a missing figure" book/index.html 'later.svg<br>is drawn by <code>make paper</code>'
holds "a contract" book/index.html '<a class="name" id="metro_add" href="#def-metro_add">metro_add</a>'
holds "a definition" book/index.html '<a class="name" id="def-metro_add" href="#metro_add">metro_add</a>'
holds "the code of an equation" book/index.html 'code: <a href="#metro_add">metro_add</a>, line <a href="#L63">63</a>'
holds "a pulled function" book/first.html 'href="index.html#L61">61</a>'
holds "a lecture's citation" book/first.html '<em><a href="index.html#eq-1.1">eq 1.1</a></em>'
holds "items that number on from nine" book/first.html '<ol start="9">'
holds "an item under a number of two digits" book/first.html 'more.</li>'
mv book again
check
diff -r book again > message
result "the same book again" $?
rm -rf again
run metro.h --extract programs --lectures docs
[ $status -eq 0 ] && [ "$(cat output)" = programs/example_1.c ] &&
    grep -q '^    return metro_add(1, 2) != 3;' programs/example_1.c
result "an example" $?

# Bytes and lines.
mistake "a byte that is no ASCII" metro.h "3s/It/$(printf '\303\251')/" '3: column 4 holds the byte 0xc3'
mistake "a tab" metro.h "3s/It/$(printf '\t')/" '3: column 4 holds the byte 0x09'
mistake "a trailing blank" metro.h '3s/$/ /' '3: the line ends in a blank'
mistake "a long line" metro.h '3s/$/ 12345678901234567890123456789012345678901234567890/' \
    '3: the line has 121 columns'
mistake "an open comment" metro.h 's/ \*\/$//; s/^\*\/$//' '[0-9]*: the comment is never closed'

# Headings, equations, citations.
mistake "a citation of no equation, in code" metro.h 's/; \/\* eq 1.1/; \/* eq 1.9/' '63: eq 1.9 does not exist'
mistake "a citation of no equation, in prose" metro.h 's/by eq 1.1/by eq 1.9/' '29: eq 1.9 does not exist'
mistake "a citation of no equation, in a lecture" docs/first.md 's/eq 1.1/eq 1.9/' '3: eq 1.9 does not exist'
mistake "an equation that nothing cites" metro.h 's/second, eq 1.2,/second/' '54: nothing cites eq 1.2'
mistake "a number given twice" metro.h 's/(1.2)$/(1.1)/; s/, eq 1.2,//' '54: equation (1.1) stands in line 52 already'
mistake "no such section" metro.h '3s/section 1.1/section 1.2/' '3: section 1.2 does not exist'
mistake "no such chapter" metro.h 's/chapter R1/chapter R2/' '57: chapter R2 does not exist'
mistake "a heading twice" metro.h 's/# 1.1 Sums/# 1 Ground/' '59: heading 1 stands in line 43 already'
mistake "a section in a wrong chapter" metro.h 's/1.1 Sums/2.1 Sums/; 3s/section 1.1/it/' \
    '59: section 2.1 stands in chapter 1'
mistake "contents without a chapter" metro.h '/^       1 Ground$/d' '[0-9]*: the contents do not carry .1 Ground.'
mistake "contents with another title" metro.h 's/^         1.1 Sums/         1.1 Sum/' \
    '17: the contents do not carry .1.1 Sums.'
mistake "contents with too much" metro.h 's/^       A Eq.*/&@       B More/; y/@/\n/' \
    '19: the contents carry .B., which is no heading'
mistake "no contents" metro.h '13,18d' '1: the contents do not carry'
mistake "an equation of the paper not mapped" metro.h '/| paper (7) |/d' '[0-9]*: no table row maps paper (7)'
mistake "an equation of the paper mapped twice" metro.h 's/| paper (7) |/| paper (8) |/' \
    '[0-9]*: paper (8) is mapped in line'
mistake "no such equation of the paper" metro.h 's/is paper (12)/is paper (20)/' '57: paper (20) is in no row'

# Formulas.
mistake "an open brace" metro.h 's/frac{x_i}{sqrt{2 pi}}/frac{x_i}{sqrt{2 pi}/' '52: eq 1.1.*not closed'
mistake "an open parenthesis" metro.h 's/P\*(k)/P*(k/' '52: eq 1.1.*not closed'
mistake "a parenthesis too many" metro.h 's/P\*(k)/P*(k))/' '52: eq 1.1.*never opened'
mistake "letters that touch" metro.h 's/x_i/k x_i kx/' '52: eq 1.1, at .kx.*: two letters that touch'
mistake "a star for a product" metro.h 's/+ P/* P/' '52: eq 1.1, at .\* P.*star'
mistake "a strange character" metro.h 's/+ P/# P/' '52: eq 1.1, at .# P.*no meaning'
mistake "a script too many" metro.h 's/x_i/x_i_j/' '52: eq 1.1.*second script'
mistake "a missing script" metro.h 's/1e-12/x^/' '55: eq 1.2.*'
mistake "a missing group" metro.h 's/frac{x_i}/frac{x_i} 2/' '52: eq 1.1.*{ is missing'
mistake "too deep" metro.h 's/x_i/((((((((((((((((((((((((((((((x))))))))))))))))))))))))))))))/' \
    '52: eq 1.1.*too deeply'
mistake "a formula in prose" metro.h 's/\$a_i + b^2\$/$a_i + (b^2$/' '29: formula.*not closed'
mistake "an open dollar" metro.h 's/\$a_i + b^2\$/$a_i + b^2/' '29: a dollar sign has no partner'
mistake "an open backtick" metro.h '3s/`metro_add`/`metro_add/' '3: a backtick has no partner'

# Symbols.
mistake "no contract" metro.h '/^.. Adds/d' '29: metro_add has no contract'
mistake "no contract beside a type" metro.h 's/(metro_pair pair);/(double pair);/' '37: metro_first has no contract'
sample
sed 's/metro_first/metro_firsts/' tests/test_all.c > edited && mv edited tests/test_all.c
check
[ $status -eq 1 ] && grep -q '^metro.h:37: no test in tests/\*.c names metro_first$' message
result "no test" $?
mistake "declared and not defined" metro.h \
    's/^METRO_API double metro_same(double x)$/static double metroi_same(double x)/' \
    '38: metro_same is declared and never defined'
mistake "defined and not declared" metro.h 's/^METRO_API double metro_same(double x);.*//' \
    '71: metro_same is defined and not'
mistake "an unknown name in prose" metro.h '3s/metro_add/metro_sub/' '3: metro.h declares no metro_sub'
mistake "an unknown function to pull" docs/first.md 's/: metro_add/: metro_sub/' \
    '5: \[function: metro_sub\]: metro.h defines no'

# Results.
mistake "no such column" metro.h 's/, mse, %.2g/, msd, %.2g/' '45: the file has no column .msd.'
mistake "no such column in a selector" metro.h 's/ M=100/ N=100/' '45: the selector .N=100. names no column'
mistake "no such row" metro.h 's/M=100,/M=101,/' '45: 0 rows fit'
mistake "several rows" metro.h 's/Delta=0.1 M/M/' '45: 2 rows fit'
mistake "row 0" metro.h 's/Delta=0.1 M=100/row 0/' '45: rows are counted from 1'
mistake "a bad format" metro.h 's/%.2g/%n/' '45: the cell .1.5e-05. does not print as %n'
mistake "too few fields" metro.h 's/ row 1,//' '45: a value is written'
mistake "a file elsewhere" metro.h 's/none.csv/..\/none.csv/' '45: .\.\./none.csv. is not the name'
mistake "a figure that is no picture" metro.h 's/chart.svg/size.csv/' '47: size.csv is neither SVG nor PNG'
mistake "a figure without its bracket" metro.h 's/two lines\.\]/two lines./' '47: the bracket is not closed'

# Usage, files that are not there, and headers cut off anywhere: a status, never a signal.
run metro.h; [ $status -eq 2 ]; result "usage" $?
run none.h out book; [ $status -eq 1 ]; result "no header" $?
sample
cp metro.h whole
size=$(wc -c < whole)
at=0
good=0
while [ $at -lt "$size" ]; do
    head -c $at whole > metro.h
    check
    [ $status -le 1 ] || good=1
    at=$((at + 29))
done
result "headers cut off" $good

echo "weave: $passed passed, $failed failed"
[ $failed -eq 0 ]
