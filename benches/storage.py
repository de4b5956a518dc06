#!/usr/bin/env python3
"""Float32 bytes of deformers as published: a model of each method after three iterations on a tiny built-in scene, whose weights have the size of any scene's.

    python3 benches/storage.py CC4DGS OUT.json [--family n3dv]
"""
import argparse
import json
import pathlib
import subprocess
import tempfile

# Rows of the paper's Table 4 (N3DV), MB: spatial encoding and network.
REPORTED = {"grid4d": (220.9, 0.2), "swift4d": (67.7, 0.7), "cdf": (0.8, 1.1)}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program")
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--family", default="n3dv")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for method in ("cdf", "cdf-basis", "hash-basis", "swift4d", "grid4d", "hexplane", "deform-mlp"):
            preset = options.family if method == "cdf" else f"{options.family}+{method}"
            run = pathlib.Path(folder) / method
            sets = ["train.iterations=3", "train.checks=false", "train.shares=[1.0,0.0,2.0]", "train.dynamic=all", "scene.width=0"]
            arguments = [options.program, "train", "--scene", "procedural:tiny", "--preset", preset, "--device", "flex", "--out", run, "-q"]
            subprocess.run(arguments + [part for s in sets for part in ("--set", s)], check=True)
            report = subprocess.run([options.program, "eval", run, "--scene", "procedural:tiny", "--device", "flex", "--max-views", "1", "--sheet-rows", "0", "-q", "--json", "-"], check=True, capture_output=True)
            size = json.loads(report.stdout)["size_mb"]
            rows.append({"method": method, "preset": preset, "grid_mb": size["deform_grid_f32"], "net_mb": size["deform_net_f32"], "reported_mb": REPORTED.get(method)})
    options.out.write_text(json.dumps({"what": "float32 MB of deformers", "family": options.family, "rows": rows}, indent=1) + "\n")
    print("| method | encoding MB | network MB | total MB | reported, encoding + network |\n| --- | ---: | ---: | ---: | ---: |")
    for r in rows:
        reported = "–" if r["reported_mb"] is None else f"{r['reported_mb'][0]} + {r['reported_mb'][1]}"
        print(f"| `{r['method']}` | {r['grid_mb']:.2f} | {r['net_mb']:.2f} | {r['grid_mb'] + r['net_mb']:.2f} | {reported} |")


if __name__ == "__main__":
    main()
