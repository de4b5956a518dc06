#!/usr/bin/env python3
"""Trains the same scene in other units, translated and rotated, and compares the held-out PSNR.

    benches/invariance.py SCENE OUT [--bin FILE] [--preset NAME] [--iterations N] [--device NAME] [--seeds N] [--only NAME,NAME] [--set KEY=VALUE]...

SCENE is a D-NeRF/Blender folder (transforms_train.json) or a PanopticSports folder (train_meta.json). Copies hold changed metadata and links to the images.
Each copy is trained with one seed, the unchanged scene with --seeds seeds. Runs and copies of an earlier call are replaced. OUT/invariance.json holds all numbers. The
exit code is 1 if a training or an evaluation failed. Needs Python 3 alone.
"""
import argparse
import json
import math
import os
import pathlib
import shutil
import subprocess
import sys

IDENTITY = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def turn(axis, angle):
    """The rotation by `angle` radians around `axis` (Rodrigues)."""
    n = math.sqrt(sum(a * a for a in axis))
    x, y, z = (a / n for a in axis)
    s, c = math.sin(angle), math.cos(angle)
    k = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    u = [x, y, z]
    return [[c * (i == j) + s * k[i][j] + (1 - c) * u[i] * u[j] for j in range(3)] for i in range(3)]


# x -> scale * rotation * x + translation
CHANGES = {
    "same": (1.0, IDENTITY, [0.0, 0.0, 0.0]),
    "moved-1e3": (1.0, IDENTITY, [1e3, -1e3, 1e3]),
    "moved-1e4": (1.0, IDENTITY, [1e4, -1e4, 1e4]),
    "moved-1e5": (1.0, IDENTITY, [1e5, -1e5, 1e5]),
    "scaled-1e-4": (1e-4, IDENTITY, [0.0, 0.0, 0.0]),
    "scaled-1e-3": (1e-3, IDENTITY, [0.0, 0.0, 0.0]),
    "scaled-1e3": (1e3, IDENTITY, [0.0, 0.0, 0.0]),
    "scaled-1e4": (1e4, IDENTITY, [0.0, 0.0, 0.0]),
    "turned": (1.0, turn([1.0, 2.0, -0.5], 1.1), [0.0, 0.0, 0.0]),
}


def times(a, v):
    return [sum(a[i][k] * v[k] for k in range(3)) for i in range(3)]


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def moved_point(change, p):
    scale, rotation, translation = change
    return [scale * v + t for v, t in zip(times(rotation, p), translation)]


def camera_to_world(change, m):
    axes = product(change[1], [row[:3] for row in m[:3]])
    center = moved_point(change, [m[i][3] for i in range(3)])
    return [axes[i] + [center[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def world_to_camera(change, m):
    r = [row[:3] for row in m[:3]]
    center = [-sum(r[i][j] * m[i][3] for i in range(3)) for j in range(3)]
    axes = product(r, [list(column) for column in zip(*change[1])])
    t = times(axes, moved_point(change, center))
    return [axes[i] + [-t[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def copy(source, target, change):
    """Links everything but the files with poses, which are rewritten."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for entry in source.iterdir():
        link = target / entry.name
        if entry.name.startswith("transforms_") and entry.suffix == ".json":
            document = json.loads(entry.read_text())
            for frame in document["frames"]:
                frame["transform_matrix"] = camera_to_world(change, frame["transform_matrix"])
            link.write_text(json.dumps(document))
        elif entry.name.endswith("_meta.json"):
            document = json.loads(entry.read_text())
            document["w2c"] = [[world_to_camera(change, m) for m in instant] for instant in document["w2c"]]
            link.write_text(json.dumps(document))
        else:
            os.symlink(entry.resolve(), link)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", default="target/release/cc4dgs")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--device", default="flex")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", help="names of changes, separated by commas: " + ", ".join(CHANGES))
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    args = parser.parse_args()
    blender = (args.scene / "transforms_train.json").is_file()
    if not blender and not (args.scene / "train_meta.json").is_file():
        sys.exit(f"{args.scene}: neither transforms_train.json nor train_meta.json is there")
    preset = args.preset
    names = args.only.split(",") if args.only else list(CHANGES)
    unknown = [name for name in names if name not in CHANGES]
    if unknown:
        sys.exit(f"--only {','.join(unknown)}: known are {', '.join(CHANGES)}")

    results = []
    for name in names:
        copy(args.scene, args.out / name / "scene", CHANGES[name])
        for seed in range(args.seeds if name == "same" else 1):
            run = args.out / name / f"run-{seed}"
            sets = [f"seed={seed}", f"train.iterations={args.iterations}", *args.sets]
            options = [part for assignment in sets for part in ("--set", assignment)]
            scene = str(args.out / name / "scene")
            train = ["train", "--scene", scene, "--preset", preset, "--device", args.device, "--out", str(run), "--overwrite", *options]
            report = args.out / name / f"eval-{seed}.json"
            report.unlink(missing_ok=True)
            measure = ["eval", str(run), "--scene", scene, "--device", args.device, "--sheet-rows", "0", f"--json={report}"]
            psnr = None
            if all(subprocess.run([args.bin, "--quiet", *command], stdout=subprocess.DEVNULL).returncode == 0 for command in (train, measure)):
                psnr = json.loads(report.read_text())["psnr_db"]
            results.append({"change": name, "seed": seed, "psnr_db": psnr})
            print(f"{name:<12} seed {seed}: " + ("failed" if psnr is None else f"{psnr:.2f} dB"), flush=True)
    document = {"scene": args.scene.name, "preset": preset, "iterations": args.iterations, "device": args.device, "sets": args.sets, "results": results}
    (args.out / "invariance.json").write_text(json.dumps(document, indent=1) + "\n")
    sys.exit(any(r["psnr_db"] is None for r in results))


if __name__ == "__main__":
    main()
