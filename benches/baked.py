#!/usr/bin/env python3
"""Playback layers of every deformer: error against the deformer itself, and bytes against its weights.

    benches/baked.py OUT.json --cc4dgs target/release/cc4dgs [--scene procedural] [--preset demo] [--iterations 400] [--max-error 0.1px] [--only cdf,...]

Trains every method for so many iterations, bakes, and reports: the largest error at the layer's samples and half way between them, as a share of what was
allowed; the 99th percentile over Gaussians of each one's largest error between samples, and the share of Gaussians over the bound there; bytes of the layer
and of the deformer's weights (fp16), as stored; and the PSNR between images of the deformer and of its layer, over an orbit of 12 times (the example
`compare`, which lies beside the program). Writes OUT.json and prints a table.
"""
import argparse, json, pathlib, subprocess, sys, tempfile

LAYER_KEYS = ["moving", "samples", "samples_limited", "segments", "at_samples", "between_samples", "between_p99", "between_over", "between_measured"]
METHODS = "cdf,cdf-basis,deform-mlp,embedding,free-time,grid4d,hash-basis,hexplane,native-4d,swift4d"


def run(*command):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: {done.stderr.strip()}")
    return done.stdout


def measure(args, method, folder):
    model = folder / method
    run(args.cc4dgs, "train", "--preset", f"{args.preset}+{method}", "--scene", args.scene, "--out", model, "--set", f"train.iterations={args.iterations}", "--quiet")
    baked, bare = folder / f"{method}.cc4d", folder / f"{method}-bare.cc4d"
    common = ["bake", model, "--scene", args.scene, "--max-error", args.max_error, "--codec", "raw", "--quiet"]
    report = json.loads(run(args.cc4dgs, *common, "--out", baked, "--json", "-"))
    run(args.cc4dgs, *common, "--out", bare, "--without-field")
    between = json.loads(run(pathlib.Path(args.cc4dgs).parent / "examples/compare", baked, bare, 12))["psnr_db"]
    layer = report["layer"] or {}
    row = {key: layer.get(key) for key in LAYER_KEYS}
    heads = {head["head"]: head["functions"] for head in layer.get("heads", [])}
    return {"method": method, **row, "functions": heads, "layer_bytes": report["layer_bytes"], "field_bytes": report["field_bytes"], "psnr_between_db": between}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--cc4dgs", default="target/release/cc4dgs")
    parser.add_argument("--scene", default="procedural")
    parser.add_argument("--preset", default="demo")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--max-error", default="0.1px")
    parser.add_argument("--only", default=METHODS)
    args = parser.parse_args()
    rows = []
    print("| method | moving | samples, segments | functions by head | error at samples, between them, its 99th percentile (allowed: 1) | over between samples, % | layer MB | weights MB | PSNR between dB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for method in args.only.split(","):
            row = measure(args, method, pathlib.Path(folder))
            rows.append(row)
            functions = ", ".join(f"{head} {count}" for head, count in row["functions"].items())
            errors, over = "-", "-"
            if row["moving"]:
                errors = f"{row['at_samples']:.2f}, {row['between_samples']:.2f}, {row['between_p99']:.2f}"
                over = f"{100 * row['between_over']:.1f}"
            sizes = f"{row['layer_bytes'] / 1e6:.3f} | {row['field_bytes'] / 1e6:.3f}"
            print(f"| `{method}` | {row['moving'] or 0} | {row['samples']}, {row['segments']} | {functions} | {errors} | {over} | {sizes} | {row['psnr_between_db']:.1f} |", flush=True)
            settings = {key: str(getattr(args, key)) for key in ("scene", "preset", "iterations", "max_error")}
            args.out.write_text(json.dumps({"settings": settings, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
