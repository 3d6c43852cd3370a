#!/bin/sh
# Shows the logs of the tests given and closes with the line "N passed, N failed". A log without its closing line is
# a program that crashed: it counts as one failure.
passed=0
failed=0
for log in "$@"; do
    cat "$log"
    line=$(grep -E '^[a-z_]+: [0-9]+ passed, [0-9]+ failed$' "$log" | tail -n 1)
    if [ -z "$line" ]; then
        echo "$log: ended without its closing line"
        failed=$((failed + 1))
        continue
    fi
    line=${line#*: }
    passed=$((passed + ${line%% passed*}))
    line=${line#*, }
    failed=$((failed + ${line%% failed*}))
done
echo "$passed passed, $failed failed"
[ "$failed" -eq 0 ] && [ "$passed" -gt 0 ]
