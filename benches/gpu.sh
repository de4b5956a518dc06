#!/usr/bin/env bash
# Every measurement of a graphics card in one call: no network, no build, time-boxed steps, JSON out.
#
#   benches/gpu.sh [--bin FILE] [--out DIR] [--device NAME] [--scale SHARE] [--data DIR] [--train MINUTES] [--step SECONDS] [--frames N]
#
# FILE is a built cc4dgs (default: target/release/cc4dgs), which may have been carried here from another machine. --scale shrinks pictures and Gaussians for
# devices that are slow. --data names a folder with dnerf_mutant and panoptic_basketball; with it and --train, both are trained at full size within the minutes.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bin=target/release/cc4dgs out="benches/results/$(date -u +%Y-%m-%d)-gpu" device=wgpu scale=1 data="" minutes=0 limit=120 frames=50
while [ $# -gt 1 ]; do
    case "$1" in
        --bin) bin=$2 ;;
        --out) out=$2 ;;
        --device) device=$2 ;;
        --scale) scale=$2 ;;
        --data) data=$2 ;;
        --train) minutes=$2 ;;
        --step) limit=$2 ;;
        --frames) frames=$2 ;;
        *) echo "unknown option $1" >&2; exit 2 ;;
    esac
    shift 2
done
repeats=$((frames < 10 ? frames : 10))
[ $# = 0 ] || { echo "option $1 lacks a value" >&2; exit 2; }
[ -x "$bin" ] || { echo "$bin is not there; name a built cc4dgs with --bin" >&2; exit 2; }
mkdir -p "$out"
export XDG_RUNTIME_DIR="${XDG_RUNTIME_DIR:-${TMPDIR:-/tmp}}"

failed=0
# step NAME SECONDS COMMAND…: runs within the time, keeps table and JSON, goes on whatever happens.
step() {
    local name=$1 seconds=$2 began=$SECONDS
    shift 2
    echo "== $name"
    timeout --signal=INT --kill-after=30 "$seconds" "$bin" "$@" "--json=$out/$name.json" 2>"$out/$name.log"
    local status=$?
    if [ $status = 124 ] || [ $status = 130 ]; then
        echo "   stopped after $((SECONDS - began)) s"
    elif [ $status != 0 ]; then
        echo "   FAILED with exit code $status:"
        tail -3 "$out/$name.log"
        failed=1
    fi
}

step doctor 60 doctor
step step "$limit" bench step --device "$device" --repeats "$repeats"
step frame "$limit" bench frame --device "$device" --scale "$scale" --frames "$frames"
step frame-basis "$limit" bench frame --device "$device" --scale "$scale" --frames "$frames" --set deformer.kind=cdf-basis
step train-step "$limit" bench step --device "$device" --case n3dv --scale "$scale" --repeats "$repeats"
step field "$limit" bench field --device "$device" --gaussians "$(awk "BEGIN { n = int(40000 * $scale); print (n > 1 ? n : 1) }")" --repeats "$repeats"
step loss "$limit" bench loss --device "$device" --megapixels "$(awk "BEGIN { print 1.4 * $scale \",\" 2.2 * $scale }")"
step sort "$limit" bench sort --device "$device" --pairs "$(awk "BEGIN { print int(1000000 * $scale) \",\" int(4000000 * $scale) }")"
step growth "$limit" bench frame --device "$device" --growth --scale "$scale" --frames "$frames"

if [ -n "$data" ] && [ "$minutes" != 0 ]; then
    for scene in dnerf_mutant:dnerf panoptic_basketball:panoptic; do
        path="$data/${scene%%:*}" preset="${scene##*:}" run="$out/${scene%%:*}"
        step "${scene%%:*}-train" $((60 * minutes)) train --scene "$path" --preset "$preset" --device "$device" --out "$run"
        [ -f "$run/checkpoint" ] || continue
        step "${scene%%:*}-eval" 300 eval "$run" --scene "$path" --device "$device"
        step "${scene%%:*}-compress" 300 compress "$run" --codec cca:default --out "$run.cc4d"
        step "${scene%%:*}-eval-compressed" 300 eval "$run.cc4d" --scene "$path" --device "$device"
    done
fi
echo "results in $out"
exit $failed
