#!/bin/sh
# test_render.sh [RENDER [MERGE]] - uses render and merge as a person would, right and wrong, on a room of a few
# triangles. The last line counts; the exit status is 0 when none failed.
set -u
absolute() { echo "$(cd "$(dirname "$1")" && pwd)/$(basename "$1")"; }
render=$(absolute "${1:-build/render}")
merge=$(absolute "${2:-build/merge}")
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
        cat output message >&2
    fi
}

run() { # run COMMAND...: leaves its output, its messages and its status
    "$@" > output 2> message
    status=$?
}

works() { # works NAME COMMAND...: it succeeds without a message
    name=$1
    shift
    run "$@"
    [ $status -eq 0 ] && [ ! -s message ]
    result "$name" $?
}

refuses() { # refuses NAME STATUS TEXT COMMAND...: it ends with the status and one line on stderr that holds the text
    name=$1
    expected=$2
    text=$3
    shift 3
    run "$@"
    [ $status -eq "$expected" ] && [ ! -s output ] && [ "$(wc -l < message)" -eq 1 ] && grep -qF -- "$text" message
    result "$name" $?
}

same() { # same NAME A B: equal files
    cmp "$2" "$3" > message 2>&1
    result "$1" $?
}

says() { # says NAME TEXT: the last output matches the regular expression
    grep -q -- "$2" output
    result "$1" $?
}

below() { # below NAME MOST: the relative RMSE in the last output is a number of at most this
    sed -n 's/.*relative RMSE \([^ ]*\) against.*/\1/p' output |
        awk -v most="$2" '{ good = $1 > 0 && $1 < most } END { exit !good }'
    result "$1" $?
}

# An open room of 2 x 2 x 2 with one white, one red and one green side, a lamp under the ceiling, and a glossy floor.
cat > faces << 'OBJ'
mtllib room.mtl
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v -1 2 -1
v 1 2 -1
v 1 2 1
v -1 2 1
v -.4 1.9 -.4
v .4 1.9 -.4
v .4 1.9 .4
v -.4 1.9 .4
usemtl floor
f 4 3 2 1
usemtl white
f 5 6 7 8
f 1 2 6 5
usemtl red
f 1 5 8 4
usemtl green
f 2 3 7 6
usemtl lamp
f 9 10 11 12
OBJ
{
    cat faces
    echo '# camera eye 0 1 3.9 look 0 1 0 up 0 1 0 fov 40'
} > room.obj
cp faces framed.obj
cat > dull.mtl << 'MTL'
newmtl white
Kd .7 .7 .7
newmtl red
Kd .6 .1 .1
newmtl green
Kd .1 .5 .2
newmtl floor
Kd .4 .4 .4
Ks .4 .4 .4
Ns 20
newmtl lamp
Kd 0 0 0
MTL
{
    cat dull.mtl
    echo 'Ke 8 8 8'
} > room.mtl
sed 's/room.mtl/dull.mtl/' room.obj > dark.obj
sed 's/^f 5 6 7 8$/f 5 6 7 x/' room.obj > broken.obj
small="--size 16x12 --depth 4"

# Usage: status 2, one line that says what to do.
refuses "no scene" 2 'render SCENE.obj' "$render"
refuses "two scenes" 2 'second scene' "$render" room.obj dark.obj
refuses "no such option" 2 '--sppp: there is no such option' "$render" room.obj --sppp 3
refuses "no value" 2 'expected a whole number' "$render" room.obj --spp
for value in 12x x 0 -3 1.5 1e3 '' ' 4' 99999999999999999999; do
    refuses "rounds of '$value'" 2 'as in --spp 64' "$render" room.obj --spp "$value"
done
for value in 12x 0 -3 nan inf 0x10 '' 1,5 1.2.3 1e 1e400; do
    refuses "seconds of '$value'" 2 'as in --seconds 10' "$render" room.obj --seconds "$value"
done
for value in 1,2 1,2,3,4 1,2,x '1, 2,3' ,, 1,2,nan; do
    refuses "an eye at '$value'" 2 'as in --eye 0,1,4' "$render" room.obj --eye "$value"
done
for value in 16 16x 0x16 16x12x3 16X12 100000x1; do
    refuses "a size of '$value'" 2 'as in --size 320x240' "$render" room.obj --size "$value"
done
refuses "too many pixels" 2 '2^31 - 1' "$render" room.obj --size 65536x65536
refuses "a depth of 33" 2 'from 1 to 32' "$render" room.obj --depth 33
refuses "a field of view of 180" 2 'degrees' "$render" room.obj --fov 180
refuses "an unknown method" 2 'pssmlt, bundle, bundle-qmc or bundle-mlt' "$render" room.obj --method bundles
refuses "an unknown start" 2 'point, seeds or weighted' "$render" room.obj --method mlt --start here
refuses "two lengths" 2 'give one of them' "$render" room.obj --spp 3 --seconds 2
refuses "chains of paths" 2 'only --method mlt, pssmlt and bundle-mlt' "$render" room.obj --method path --chains 4
refuses "a large step of paths" 2 'only --method mlt, pssmlt and bundle-mlt' "$render" room.obj --large 0
refuses "a step above 1" 2 'a part of 1' "$render" room.obj --method pssmlt --perturbation 2
refuses "walks of paths" 2 'only --method bundle, bundle-qmc' "$render" room.obj --walks 8
refuses "a grid of paths" 2 'only --method bundle, bundle-qmc' "$render" room.obj --method mlt --grid 8
refuses "rounds of bundles" 2 'counted in walks' "$render" room.obj --method bundle --rounds 8
refuses "samples of bundles" 2 'counted in walks' "$render" room.obj --method bundle-mlt --spp 8
refuses "chains of even bundles" 2 'only --method mlt, pssmlt and bundle-mlt' "$render" room.obj --method bundle-qmc \
    --chains 8
refuses "one chain of bundles" 2 'two at least' "$render" room.obj --method bundle-mlt --chains 1
refuses "bundles without an edge" 2 '2 or more' "$render" room.obj --method bundle --depth 1
refuses "a patch of nothing" 2 'a length above 0' "$render" room.obj --method bundle --patch 0
refuses "a picture of no kind" 2 '.pfm, .ppm or .png' "$render" room.obj --out room.jpg
refuses "a share too many" 2 '0 to n - 1' "$render" room.obj --part 4/4 --out a.pfm
refuses "a share without a file" 2 '--out share0.pfm' "$render" room.obj --part 0/4
refuses "a camera in what it looks at" 2 '--eye and --look' "$render" room.obj --eye 0,1,0
refuses "a camera upright along the view" 2 '--up' "$render" room.obj --up 0,0,-3
works "help" "$render" --help
[ "$(grep -c '^  --' output)" -eq 23 ]
result "help lists all options" $?

# Bad input: status 1, one line that names the file.
refuses "no such scene" 1 'none.obj' "$render" none.obj
refuses "a folder for a scene" 1 '.' "$render" .
refuses "a broken line" 1 'broken.obj:17: ' "$render" broken.obj
: > empty.obj
refuses "an empty scene" 1 'empty.obj' "$render" empty.obj
refuses "no lamp" 1 'Ke 10 10 10' "$render" dark.obj
refuses "no such reference" 1 'none.pfm' "$render" room.obj --reference none.pfm
refuses "a reference that is no picture" 1 'room.obj' "$render" room.obj --reference room.obj
refuses "a folder that is not there" 1 'none/a.pfm cannot be written' "$render" room.obj --out none/a.pfm
refuses "a folder that is a file" 1 'room.obj/a.png cannot be written' "$render" room.obj --out room.obj/a.png
mkdir folder.ppm
refuses "a picture that is a folder" 1 'folder.ppm cannot be written' "$render" room.obj --out folder.ppm
refuses "another table" 1 'another table' "$render" room.obj --csv room.mtl
[ ! -e out ] && ls | grep -q '\.tmp$'
[ $? -eq 1 ]
result "nothing is left behind" $?
if [ -c /dev/full ]; then
    ln -s /dev/full full.pfm
    run "$render" room.obj $small --rounds 1 --out full.pfm
    [ $status -eq 1 ] && grep -q 'full.pfm' message
    result "a full disk" $?
    run "$render" room.obj $small --rounds 1 --out a.pfm --csv full.pfm
    [ $status -eq 1 ]
    result "a table on a full disk" $?
fi
: > nothing.mtl
sed 's/room.mtl/none.mtl/' room.obj > nomtl.obj
run "$render" nomtl.obj
[ $status -eq 1 ] && grep -q 'none.mtl' message
result "no MTL file" $?

# Pictures: their kinds, where they go, and the summary.
works "a scene and nothing else" "$render" room.obj --rounds 1
[ "$(head -c 15 out/room.pfm | tr '\n' ' ')" = "PF 128 128 -1.0" ] && [ -s out/room.png ]
result "out/ holds the default pictures" $?
works "three pictures" "$render" room.obj $small --rounds 4 --out a.pfm --out a.ppm --out a.png
says "wrote all three" 'wrote a.pfm, a.ppm, a.png'
says "the camera of the file" '^camera eye 0 1 3.9 look 0 1 0 up 0 1 0 fov 40$'
says "samples" '^0.000768 million samples'
says "the mean" '^mean luminance 0\.[0-9]* +- '
[ "$(head -c 9 a.pfm | tr '\n' ' ')" = "PF 16 12 " ] && [ "$(wc -c < a.pfm)" -eq $((14 + 16 * 12 * 12)) ]
result "a PFM" $?
[ "$(head -c 13 a.ppm | tr '\n' ' ')" = "P6 16 12 255 " ] && [ "$(wc -c < a.ppm)" -eq $((13 + 16 * 12 * 3)) ]
result "a PPM" $?
[ "$(head -c 24 a.png | od -An -tx1 | tr -d ' \n')" = 89504e470d0a1a0a0000000d49484452000000100000000c ] &&
    tail -c 8 a.png | od -An -tx1 | tr -d ' \n' | grep -q '^49454e44ae426082$'
result "a PNG" $?
works "no camera" "$render" framed.obj $small --rounds 1 --out b.pfm
says "the scene is framed" '^camera eye .* (chosen to frame the scene)$'
works "a camera behind a wall" "$render" framed.obj $small --rounds 1 --eye 0,1,-60 --look 0,1,0 --out b.pfm
says "only backs are seen" '^warning: the camera sees no surface from its front'
works "a camera of one's own" "$render" framed.obj $small --rounds 4 --eye 0,1,3.9 --look 0,1,0 --fov 40 --out b.pfm
same "the same camera, the same picture" a.pfm b.pfm
works "upside down" "$render" room.obj $small --rounds 4 --up 0,-1,0 --out b.pfm
cmp -s a.pfm b.pfm
[ $? -eq 1 ]
result "--up turns the picture" $?

# Every method makes the same picture.
works "a reference" "$render" room.obj $small --rounds 600 --out reference.pfm
for bound in path:.05 light:.05 bdpt:.05 mlt:.3 pssmlt:.3; do
    method=${bound%:*}
    works "$method" "$render" room.obj --depth 4 --method $method --rounds 100 --seed 1 --reference reference.pfm \
        --out $method.pfm --csv runs.csv
    below "$method agrees with the reference" "${bound#*:}"
    says "$method is what was used" "^$method, 16 x 12 pixels, depth 4, seed 1: 100 rounds"
    works "$method on one thread" "$render" room.obj $small --method $method --rounds 8 --threads 1 --out one.pfm
    works "$method on two threads" "$render" room.obj $small --method $method --rounds 8 --threads 2 --out two.pfm
    same "$method is the same on one and two threads" one.pfm two.pfm
    for other in path light bdpt mlt; do
        [ $other = $method ] && break
        ! cmp -s $method.pfm $other.pfm
        result "$method is not $other" $?
    done
done
cp output paths
for bound in bundle:.2 bundle-qmc:.2 bundle-mlt:.2; do # the lamp by 6 x 6 samples a pixel
    method=${bound%:*}
    small_bundles="--size 16x12 --depth 4 --method $method --patch .2 --grid 96"
    works "$method" "$render" room.obj $small_bundles --walks 1000 --seed 1 --reference reference.pfm \
        --out $method.pfm --csv bundles.csv
    below "$method agrees with the reference" "${bound#*:}"
    says "$method is what was used" "^$method, 16 x 12 pixels, depth 4, seed 1: 1008 walks"
    works "$method on one thread" "$render" room.obj $small_bundles --walks 32 --threads 1 --out one.pfm
    works "$method on two threads" "$render" room.obj $small_bundles --walks 32 --threads 2 --out two.pfm
    same "$method is the same on one and two threads" one.pfm two.pfm
    ! cmp -s $method.pfm bdpt.pfm
    result "$method is not bdpt" $?
done
works "a time for bundles" "$render" room.obj $small_bundles --seconds .1 --out time.pfm
walks=$(sed -n 's/^the same picture again: --walks //p' output)
works "these walks" "$render" room.obj $small_bundles --walks "${walks:-1}" --out again.pfm
same "the same picture" time.pfm again.pfm
works "larger patches" "$render" room.obj --size 16x12 --depth 4 --method bundle --patch 1 --walks 16 --out b.pfm
says "patches as large as asked for" '^[0-9]* patches, '
works "half of the bundles" "$render" room.obj $small_bundles --walks 32 --part 0/2 --out share0.pfm
works "the other half" "$render" room.obj $small_bundles --walks 32 --part 1/2 --out share1.pfm
! cmp -s share0.pfm share1.pfm
result "two shares, two pictures" $?
works "the halves together" "$merge" merged.pfm share0.pfm share1.pfm
cp paths output
says "b and its error" '^b [0-9.]* +- [0-9.]*; [0-9.]* % of the mutations accepted, .* longest stay [0-9]* mutations$'
says "R-hat" 'worst R-hat [0-9.]*, smallest ESS [0-9]*$'
[ "$(wc -l < runs.csv)" -eq 6 ] && [ "$(grep -c '^scene,method' runs.csv)" -eq 1 ] &&
    [ "$(awk -F, '{ print NF }' runs.csv | sort -u | wc -l)" -eq 1 ] && [ "$(sed -n 5p runs.csv | cut -d, -f 1-6)" = \
    room.obj,mlt,seeds,16,12,4 ]
result "a table with five rows" $?
for start in point seeds weighted; do
    works "start: $start" "$render" room.obj --depth 4 --method mlt --start $start --large .3 --chains 16 \
        --perturbation .5 --rounds 100 --reference reference.pfm --out $start.pfm
    below "start: $start agrees with the reference" .15
done
! cmp -s point.pfm seeds.pfm && ! cmp -s seeds.pfm weighted.pfm && ! cmp -s point.pfm weighted.pfm
result "three starts, three pictures" $?
up="--eye 0,1.5,0 --look 0,1.9,0 --up 0,0,1 --fov 20 --depth 1"
works "up to the lamp, from the eye" "$render" room.obj $up --size 16x12 --rounds 1 --method path --out b.pfm
says "a walk from the eye meets the lamp in each pixel" '^mean luminance 8 +- '
works "up to the lamp, from the lamp" "$render" room.obj $up --size 16x12 --rounds 1 --method light --out c.pfm
! cmp -s b.pfm c.pfm
result "a walk from the lamp is seen in some pixels" $?
works "no large step" "$render" room.obj $small --method pssmlt --large 0 --rounds 8 --out b.pfm --csv large.csv
[ "$(tail -n 1 large.csv | cut -d, -f 26)" = 0 ]
result "--large 0 is no large step" $?
works "another seed" "$render" room.obj $small --rounds 4 --seed 5 --out b.pfm
cmp -s a.pfm b.pfm
[ $? -eq 1 ]
result "--seed gives other noise" $?
works "lamps alone" "$render" room.obj $small --rounds 4 --depth 1 --out b.pfm
cmp -s a.pfm b.pfm
[ $? -eq 1 ]
result "--depth changes the picture" $?
refuses "a reference of another size" 1 'another size' "$render" room.obj --size 16x16 --reference reference.pfm

# Time: the rounds that it says repeat the picture.
works "a time" "$render" room.obj $small --seconds 0.2 --out time.pfm
rounds=$(sed -n 's/^the same picture again: --rounds //p' output)
works "the same in rounds" "$render" room.obj $small --spp "${rounds:-x}" --out b.pfm
same "--rounds repeats --seconds" time.pfm b.pfm

# Ctrl-C: the picture so far, whole, and status 130. The table appears just before the run begins.
start() { # start TABLE OPTION...: a run in the background, with its number in `job`
    "$render" room.obj --csv "$@" > output 2> message &
    job=$!
    tries=0
    while [ ! -e "$1" ] && [ $tries -lt 100 ]; do
        sleep 0.1
        tries=$((tries + 1))
    done
    sleep 0.3
}
end() { # end: waits for the job, at most 20 seconds, and leaves its status
    (sleep 20; kill -KILL $job) > /dev/null 2>&1 &
    clock=$!
    wait $job 2> /dev/null
    status=$?
    kill $clock 2> /dev/null
}
start one.csv $small --method mlt --seconds 60 --out interrupted.pfm
kill -INT $job
end
[ $status -eq 130 ] && [ "$(wc -l < message)" -eq 1 ] &&
    grep -q 'interrupted; the picture of [0-9]* rounds is written' message
result "an interrupted run" $?
rounds=$(sed -n 's/^the same picture again: --rounds //p' output)
works "the same to its end" "$render" room.obj $small --method mlt --rounds "${rounds:-x}" --out b.pfm
same "the interrupted picture is whole" interrupted.pfm b.pfm
start two.csv --size 1000x1000 --depth 32 --threads 1 --out killed.pfm
kill -INT $job
sleep 0.3
kill -INT $job # still there: it is in its first round
alive=$?
end
[ $status -eq 130 ] && [ $alive -eq 0 ] && [ ! -e killed.pfm ] && [ ! -s output ]
result "a second Ctrl-C kills" $?

# A terminal sees a bar that is wiped away at the end.
if command -v script > /dev/null 2>&1; then
    run script -qec "'$render' room.obj $small --rounds 400 --out b.pfm" /dev/null
    [ $status -eq 0 ] && grep -q '\[#* *\] *[0-9]* %' output && grep -q 'mean luminance' output
    result "a bar on a terminal" $?
fi

# Decimal commas change nothing.
comma=$(locale -a 2> /dev/null | grep -iE '^(de|fr|it|es|pl|nl|ru)_.*utf' | head -n 1)
if [ -z "$comma" ] && localedef -i de_DE -f UTF-8 ./de_DE.UTF-8 > /dev/null 2>&1; then
    comma=de_DE.UTF-8
    LOCPATH=$work
    export LOCPATH
fi
if [ -n "$comma" ]; then
    options="room.obj $small --rounds 4 --fov 40.5 --method mlt --perturbation .25"
    works "decimal points" "$render" $options --out b.pfm --csv points.csv
    grep '^mean\|^b\|^camera' output > points
    works "decimal commas" env LC_ALL="$comma" "$render" $options --out c.pfm --csv commas.csv
    grep '^mean\|^b\|^camera' output > commas
    same "the same picture" b.pfm c.pfm
    same "the same summary" points commas
    cut -d, -f 1-11,13- points.csv > points
    cut -d, -f 1-11,13- commas.csv > commas
    same "the same table" points commas
    unset LOCPATH
fi

# Shares. First by hand: 1 of weight 3 and 5 of weight 1 have the mean 2 and the standard error sqrt(3).
hand() { # hand FILE BYTES WEIGHT PART [PICTURE]: a grey picture of one pixel
    printf "Pf\n1 1\n-1.0\n$2" > "$1"
    printf 'weight,seed,part,parts,picture\n%s,0,%s,2,%s\n' "$3" "$4" "${5:-18446744073709551615}" > "$1.txt"
}
hand one.pfm '\000\000\200\077' 3 0
hand five.pfm '\000\000\240\100' 1 1
hand two '\000\000\000\100' 0 0
works "two shares" "$merge" sum.pfm one.pfm five.pfm --error error.pfm --png sum.png
same "the mean by weight" sum.pfm two
says "the standard error" '^mean luminance 2 +- 1.7$'
[ "$(tail -c 4 error.pfm | od -An -tx1 | tr -d ' \n')" = d7b3dd3f ] && [ -s sum.png ]
result "the standard error of a pixel" $?
[ "$(tr '\n' ' ' < sum.pfm.txt)" = \
  "weight,seed,part,parts,picture 3,0,0,2,18446744073709551615 1,0,1,2,18446744073709551615 " ]
result "the merged picture knows its shares" $?
works "merged again" "$merge" sum.pfm one.pfm five.pfm
hand three.pfm '\000\000\200\077' 4 2
works "a merged picture and a share" "$merge" more.pfm sum.pfm three.pfm
says "the mean of three shares" '^mean luminance 1.5 '
works "one picture" "$merge" b.pfm one.pfm
refuses "a share twice" 1 'hold the same share' "$merge" b.pfm sum.pfm five.pfm
refuses "the merged picture is forgotten" 1 'would be lost' "$merge" one.pfm five.pfm three.pfm
refuses "a share of itself" 2 'cannot be one of its shares' "$merge" one.pfm one.pfm five.pfm
refuses "nothing to merge" 2 'merge OUT.pfm SHARE.pfm' "$merge" b.pfm
refuses "an unknown option of merge" 2 '--what' "$merge" b.pfm one.pfm --what
refuses "no such share" 1 'none.pfm.txt' "$merge" b.pfm none.pfm
refuses "no weight" 1 'a.pfm.txt' "$merge" b.pfm a.pfm
for row in 0,0,0,2,0 -1,0,0,2,0 1,0,0,2 1,0,0,2,0x 1,0,0,2,18446744073709551616 nan,0,0,2,0; do
    hand bad.pfm '\000\000\200\077' 1 1
    printf 'weight,seed,part,parts,picture\n%s\n' $row > bad.pfm.txt
    refuses "a weight of '$row'" 1 'bad.pfm.txt' "$merge" b.pfm one.pfm bad.pfm
done
cp a.pfm wide.pfm
sed s/3,0,0,2/1,0,7,8/ one.pfm.txt > wide.pfm.txt
hand alien.pfm '\000\000\200\077' 1 5 18446744073709551614
refuses "a share of another picture" 1 'do not belong together' "$merge" b.pfm one.pfm alien.pfm
refuses "shares of two sizes" 1 'another size' "$merge" b.pfm one.pfm wide.pfm
refuses "a folder for merge that is not there" 1 'none/b.pfm' "$merge" none/b.pfm one.pfm

# Then by render: three shares of unequal length are as good as one run, and none is another.
for part in 0 1 2; do
    works "share $part" "$render" room.obj $small --part $part/3 --rounds $((50 + 50 * part)) --out share$part.pfm
done
[ "$(tr '\n' ' ' < share1.pfm.txt | sed 's/,[0-9]* $//')" = "weight,seed,part,parts,picture 19200,0,1,3" ]
result "a weight" $?
works "a share as long as the first" "$render" room.obj $small --part 2/3 --rounds 50 --out other.pfm
! cmp -s share0.pfm other.pfm
result "shares are independent" $?
works "shares merged" "$merge" shares.pfm share?.pfm
works "the same options in other words" "$render" room.obj $small --method bdpt --fov 40 --seed 3 --rounds 9 \
    --part 3/4 --out words.pfm
works "merging it" "$merge" b.pfm share0.pfm words.pfm
sed 's/room.mtl/pale.mtl/' room.obj > pale.obj
sed 's/Kd .7 .7 .7/Kd .7 .7 .6/' room.mtl > pale.mtl
last=
while read -r scene other; do
    works "a share of $scene $other" "$render" $scene $small --part 7/9 --seconds .01 $other --out other.pfm
    refuses "merging a share of $scene $other" 1 'do not belong together' "$merge" new.pfm share0.pfm other.pfm
    key=$(sed -n '$s/.*,//p' other.pfm.txt)
    [ -n "$key" ] && [ "$key" != "$last" ]
    result "$scene $other is another picture than the one before" $?
    last=$key
done << 'END'
room.obj --method path
room.obj --depth 3
room.obj --size 12x16
room.obj --eye 0,1,2
room.obj --fov 50
pale.obj --fov 40
room.obj --method mlt
room.obj --method mlt --perturbation .1
room.obj --method mlt --start point
room.obj --method bundle
room.obj --method bundle --patch .7
room.obj --method bundle --patch .7 --grid 9
END
works "against the reference" "$render" room.obj --depth 4 --reference shares.pfm --rounds 400 --seed 9 --out b.pfm
below "the merged picture is right" .03

echo "render: $passed passed, $failed failed"
[ $failed -eq 0 ]
