#!/usr/bin/env bash
# Exports a model in every format and has programs of others read the files: PlayCanvas' splat-transform (PLY, SPZ, SOG), Khronos' validator
# (glTF), gsplat.js (splatV), ffprobe (MP4). What splat-transform reads is written as PLY again and rendered through the cameras of the
# dataset, beside the model's own PLY.
#
#   benches/exports.sh MODEL SCENE OUT
#
# What an earlier call left in OUT is replaced.
# Needs node with npm (which downloads the packages into OUT/tools, or into the folder that CC4DGS_TOOLS names) and ffmpeg. CC4DGS names the program.
set -euo pipefail
model=$1 scene=$2 out=$3
program=${CC4DGS:-target/release/cc4dgs}
tools=${CC4DGS_TOOLS:-$out/tools}
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
mkdir -p "$out" "$tools"
if ! [ -d "$tools/node_modules/gsplat" ] || ! [ -d "$tools/node_modules/gltf-validator" ] || ! [ -d "$tools/node_modules/@playcanvas/splat-transform" ]; then
    npm install --silent --prefix "$tools" @playcanvas/splat-transform@2.7.1 gltf-validator@2.0.0-dev.3.10 gsplat@1.2.9
fi
transform=(node "$tools/node_modules/@playcanvas/splat-transform/bin/cli.mjs" -w -q)

export_as() { # FORMAT FILE OPTION...
    echo "== $1 -> $2"
    "$program" export "$1" "$model" --out "$out/$2" --overwrite --device flex -q "${@:3}"
}
export_as ply model.ply
export_as ply-sequence sequence --frames 3
export_as spz model.spz
export_as spz model-v3.spz --set version=3
export_as sog model.sog
export_as gltf model.glb
export_as splatv model.splatv
export_as mp4 model.mp4 --frames 12 --size 320x240 --fps 12

render() { # PLY FOLDER
    "$program" render "$1" --out "$2" --scene "$scene" --frames 6 --overwrite --device flex -q >/dev/null
}
render "$out/model.ply" "$out/frames/own"

for file in model.ply model.spz model-v3.spz model.sog "sequence/$(ls "$out/sequence" | tail -1)"; do
    name=$(basename "$file")
    echo "== splat-transform reads $file"
    "${transform[@]}" "$out/$file" "$out/read-$name.ply"
    head -c 300 "$out/read-$name.ply" | grep -a "element vertex"
    case $file in sequence/*) continue ;; esac
    node "$here/exports_read.mjs" "$out/read-$name.ply"
    render "$out/read-$name.ply" "$out/frames/$name"
    ffmpeg -loglevel info -i "$out/frames/own/frame_%05d.png" -i "$out/frames/$name/frame_%05d.png" -lavfi psnr -f null - 2>&1 |
        sed -n 's/.*PSNR.*average:\([^ ]*\).*/   PSNR of what it read against our PLY: \1 dB/p'
done

"${transform[@]}" "$out/model.ply" "$out/splat-transform.glb"
cp "$here/exports_read.mjs" "$tools/"
absolute=$(cd "$out" && pwd)
(cd "$tools" && node exports_read.mjs "$absolute")

echo "== ffprobe reads model.mp4"
ffprobe -v error -count_frames -show_entries stream=codec_name,width,height,r_frame_rate,nb_read_frames -of default=nw=1 "$out/model.mp4"
