#!/usr/bin/env bash
# Every measurement of a graphics card in one call: no network, no build, time-boxed steps, JSON out.
#
#   benches/gpu.sh [--bin FILE] [--out DIR] [--device NAME] [--scale SHARE] [--data DIR] [--train MINUTES] [--step SECONDS] [--frames N] [--player FILE]
#
# FILE is a built cc4dgs (default: target/release/cc4dgs), which may have been carried here from another machine. --scale shrinks images and Gaussians for
# devices that are slow. --data, a folder with dnerf_mutant and panoptic_basketball, and --train, minutes such as 0.5, go together: `auto` plans for the minutes and
# trains each at the published size (mutant 800x800, basketball 640x360 with all frames). A training that takes more than 1.5 times as long is stopped.
# Other steps are stopped after --step seconds (120). The exit code is 1 if a step fails or is stopped before it wrote anything, and 130 after Ctrl-C. What a call is
# to measure is removed from DIR before it begins.
# --player names the example `frames` of the player (cargo build --release -p cc4dgs-player --example frames); with it the player's renderer is timed too.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bin=target/release/cc4dgs out="benches/results/$(date -u +%Y-%m-%d)-gpu" device=wgpu scale=1 data="" player="" minutes="" limit=120 frames=50
while [ $# -gt 1 ]; do
    case "$1" in
        --bin) bin=$2 ;;
        --out) out=$2 ;;
        --device) device=$2 ;;
        --scale) scale=$2 ;;
        --data) data=$2 ;;
        --player) player=$2 ;;
        --train) minutes=$2 ;;
        --step) limit=$2 ;;
        --frames) frames=$2 ;;
        *) echo "unknown option $1" >&2; exit 2 ;;
    esac
    shift 2
done
[ $# = 0 ] || { echo "option $1 lacks a value" >&2; exit 2; }
# positive OPTION VALUE
positive() {
    awk -v v="$2" 'BEGIN { exit !(v ~ /^[0-9]*[.]?[0-9]+(e[-+]?[0-9]+)?$/ && v + 0 > 0) }' || { echo "$1 wants a positive number, not \"$2\"" >&2; exit 2; }
}
positive --scale "$scale"
positive --step "$limit"
positive --frames "$frames"
case "$frames" in *[!0-9]* | 0*) echo "--frames wants a whole number, not \"$frames\"" >&2; exit 2 ;; esac
if [ -n "$minutes" ]; then
    positive --train "$minutes"
    [ -n "$data" ] || { echo "--train wants --data, the folder of the scenes" >&2; exit 2; }
elif [ -n "$data" ]; then
    echo "--data wants --train, the minutes of each training" >&2
    exit 2
fi
repeats=$((frames < 10 ? frames : 10))
[ -x "$bin" ] || { echo "$bin is not there; name a built cc4dgs with --bin" >&2; exit 2; }
bin=$(realpath "$bin")
mkdir -p "$out"
out=$(realpath "$out")
export XDG_RUNTIME_DIR="${XDG_RUNTIME_DIR:-${TMPDIR:-/tmp}}"

scenes=(dnerf_mutant:800 panoptic_basketball:640)
# Results of an earlier call, of another program say, must not pass for those of this one.
rm -f "$out"/{doctor,step,frame,frame-basis,train-step,field,loss,sort,kernels-{frame,step,field,train-turntable,train-exposure}{,-stopped},growth}.{json,log}
[ -z "$player" ] || rm -f "$out"/{player-model,player}.{json,log} "$out/player.cc4d"
for scene in ${minutes:+"${scenes[@]%%:*}"}; do
    rm -f "$out/$scene"-{train,eval,compress,eval-compressed}.{json,log} "$out/$scene.cc4d" "$out/$scene/checkpoint"
done

failed=0
# step NAME SECONDS COMMAND…: runs within the time, keeps table and JSON, goes on whatever happens. Ends as `timeout` does: 124 where the time was over.
step() {
    local name=$1 seconds=$2 began=$SECONDS
    shift 2
    echo "== $name"
    # In the foreground, Ctrl-C reaches the program.
    timeout --foreground --signal=INT --kill-after=30 "$seconds" "$bin" "$@" "--json=$out/$name.json" 2>"$out/$name.log"
    local status=$?
    if [ $status = 130 ]; then
        echo "   interrupted"
        exit 130
    elif [ $status = 124 ]; then
        echo "   stopped after $((SECONDS - began)) s"
        # Profiled steps leave a log.
        [ -n "${profiled:-}" ] || [ -s "$out/$name.json" ] || { echo "   FAILED: it wrote nothing; give more --step seconds"; failed=1; }
    elif [ $status != 0 ]; then
        echo "   FAILED with exit code $status:"
        tail -3 "$out/$name.log"
        failed=1
    fi
    return $status
}

# kernels NAME COMMAND…: the same with every kernel timed by itself (CubeCL's profile, read from the working folder, waits after each); the JSON is launches and
# milliseconds per kernel, NAME-stopped.json where the time was over. Whole times are not comparable with those of other steps.
kernels() {
    local name=$1 folder status profiled=1
    shift
    folder=$(mktemp -d)
    printf '[profiling]\nlogger = { level = "full", file = "%s/log" }\n' "$folder" >"$folder/cubecl.toml"
    pushd "$folder" >/dev/null
    step "$name" "$limit" "$@"
    status=$?
    popd >/dev/null
    rm -f "$out/$name.json"
    case $status in
        0) [ -f "$folder/log" ] || { echo "   FAILED: no kernel was timed"; failed=1; } ;;
        124)
            [ -f "$folder/log" ] || { echo "   FAILED: no kernel was timed"; failed=1; }
            name+=-stopped ;;
        *) rm -f "$folder/log" ;;
    esac
    [ -f "$folder/log" ] || { rm -rf "$folder"; return; }
    grep -aoE '^\| [0-9.]+[^ ]*s +\| [A-Za-z0-9_:]+' "$folder/log" |
        sed -E 's/^\| ([0-9.]+)([^ ]*s) +\| .*::([A-Za-z0-9_]+):?$/\3 \1 \2/' |
        # What is none of the others are microseconds, in whatever spelling.
        awk 'NF == 3 { print $1, $2 * ($3 == "s" ? 1000 : $3 == "ms" ? 1 : $3 == "ns" ? 0.000001 : 0.001) }' | sort -k1,1 -k2,2g |
        awk 'function flush() { if (n) printf "%s  {\"kernel\": \"%s\", \"launches\": %d, \"min_ms\": %g, \"median_ms\": %g, \"sum_ms\": %g}", (any++ ? ",\n" : ""), name, n, v[1], v[int((n + 1) / 2)], sum }
             BEGIN { print "[" } { if ($1 != name) { flush(); name = $1; n = 0; sum = 0 } v[++n] = $2; sum += $2 } END { flush(); print "\n]" }' >"$out/$name.json"
    grep -q '"kernel"' "$out/$name.json" || { echo "   FAILED: no line of the log was understood"; rm -f "$out/$name.json"; failed=1; }
    rm -rf "$folder"
}

step doctor 60 doctor
moving=$(awk "BEGIN { n = int(40000 * $scale); print (n > 1 ? n : 1) }")
# The same field in burn's primitives, which takes a hundred times as long, decides how many it can be compared for.
compared=$((moving / 20 + 1))
step step "$limit" bench step --device "$device" --repeats "$repeats"
step frame "$limit" bench frame --device "$device" --scale "$scale" --frames "$frames"
step frame-basis "$limit" bench frame --device "$device" --scale "$scale" --frames "$frames" --set deformer.kind=cdf-basis
step train-step "$limit" bench step --device "$device" --case n3dv --scale "$scale" --repeats "$repeats"
step field "$limit" bench field --device "$device" --gaussians "$compared" --repeats "$repeats"
step loss "$limit" bench loss --device "$device" --megapixels "$(awk "BEGIN { print 1.4 * $scale \",\" 2.2 * $scale }")"
step sort "$limit" bench sort --device "$device" --pairs "$(awk "BEGIN { print int(1000000 * $scale) \",\" int(4000000 * $scale) }")"
kernels kernels-frame bench frame --device "$device" --case n3dv --scale "$scale" --frames "$frames"
kernels kernels-step bench step --device "$device" --case n3dv --scale "$scale" --repeats "$repeats"
kernels kernels-field bench field --device "$device" --gaussians "$compared" --repeats "$repeats"
# Trainings of a moment: of an object that moves, and with colours of cameras.
for capture in turntable exposure; do
    kernels "kernels-train-$capture" "$limit" train --scene "procedural:captures/$capture" --overwrite --preset auto --device "$device" --out "$out/run-$capture" \
        --set train.iterations=$((10 + frames)) --set density.max_gaussians=$((moving / 4 + 1)) --set init.count=$((moving / 4 + 1))
    rm -rf "$out/run-$capture"
done
step growth "$limit" bench frame --device "$device" --growth --scale "$scale" --frames "$frames"

if [ -n "$player" ]; then
    step player-model 300 bench frame --device flex --case n3dv --scale "$scale" --motion 0.05 --frames 1 --set deformer.kind=cdf-basis --archive "$out/player.cc4d"
    echo "== player"
    timeout --foreground --kill-after=10 "$limit" "$player" "$out/player.cc4d" --frames "$frames" >"$out/player.json" 2>"$out/player.log" ||
        { tail -3 "$out/player.log"; rm -f "$out/player.json"; failed=1; }
    rm -f "$out/player.cc4d"
fi

if [ -n "$minutes" ]; then
    longest=$(awk -v m="$minutes" 'BEGIN { s = 90 * m; printf "%d", (s > int(s) ? int(s) + 1 : s) }')
    for scene in "${scenes[@]}"; do
        path="$data/${scene%%:*}" width="${scene##*:}" run="$out/${scene%%:*}"
        # One that failed late or was stopped leaves a checkpoint, too.
        step "${scene%%:*}-train" "$longest" train --scene "$path" --overwrite --preset auto --minutes "$minutes" --set scene.width="$width" --device "$device" --out "$run"
        [ -f "$run/checkpoint" ] || continue
        step "${scene%%:*}-eval" 300 eval "$run" --scene "$path" --device "$device"
        step "${scene%%:*}-compress" 300 compress "$run" --codec cca:default --out "$run.cc4d" --overwrite
        step "${scene%%:*}-eval-compressed" 300 eval "$run.cc4d" --scene "$path" --device "$device"
    done
fi
echo "results in $out"
exit $failed
