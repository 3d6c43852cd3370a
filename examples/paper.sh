#!/bin/sh
# make paper: runs every example that draws a figure, chart or table, one after the other, and says how long it took.
# The last one compares what they have measured with what the paper says, and its table is printed.
# Each program uses all cores. The data (CSV), charts (SVG) and pictures (PNG, PFM) go to out/. QUICK=1 makes them small.
set -u
programs="hello fig1 fig2 seeds errata size startup operator picture own failures accuracy
 fig3 fig4 fig5 pyramid colours bias decay failures_light costs fig6 fig7 fig8 bundles smoother whole claims"
total=$(echo $programs | wc -w)
start=$(date +%s)
done=0
mkdir -p out
bar() { # bar DONE TOTAL NAME: one line that is drawn over on a terminal, a plain line in a pipe
    if [ -t 2 ]; then
        filled=$(($1 * 30 / $2))
        printf '\r[%-30s] %d/%d %-12s' "$(printf '%*s' "$filled" '' | tr ' ' '#')" "$1" "$2" "$3" >&2
    fi
}
for program in $programs; do
    bar $done "$total" "$program"
    if [ -t 2 ]; then echo >&2; fi
    if ! build/$program > out/$program.txt; then
        cat out/$program.txt
        echo "examples/$program failed" >&2
        exit 1
    fi
    done=$((done + 1))
    echo "$done/$total $program: $(tail -n 1 out/$program.txt)"
done
bar "$total" "$total" "done"
if [ -t 2 ]; then echo >&2; fi
echo
cat out/claims.txt
echo
echo "all figures and charts are in out/, after $(($(date +%s) - start)) s"
