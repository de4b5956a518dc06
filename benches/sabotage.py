#!/usr/bin/env python3
"""Damages a dataset in eight ways, trains on each copy, and shows how each run ends.

    benches/sabotage.py SCENE OUT [--bin FILE] [--preset NAME] [--device NAME] [--only NAME,NAME] [--floor DB]
                        [--set KEY=VALUE]...

SCENE is a nerfstudio folder (transforms.json), a D-NeRF/Blender folder (transforms_train.json) or a PanopticSports folder (train_meta.json). Copies hold changed
metadata and links to the images. A damaged run should end with an error that names the cause (exit code 3: what is wrong with the data, or 6: a model that is no good;
some may train if they are warned about); the unchanged one ("same") with exit code 0. OUT/sabotage.json holds exit codes, last sentences, warnings and PSNR. The exit
code of this program is the number of runs that did not end as they should. Needs Python 3 alone.
"""
import argparse
import json
import math
import os
import pathlib
import random
import shutil
import struct
import subprocess
import sys
import zlib


def scaled(m, factor):
    """The camera-to-world matrix with its position multiplied by `factor`."""
    return [[*row[:3], factor * row[3]] for row in m[:3]] + [m[3]]


def turned(m):
    """The camera-to-world matrix turned by 180 degrees around the camera's vertical axis."""
    return [[-row[0], row[1], -row[2], row[3]] for row in m[:3]] + [m[3]]


def inverse(m):
    """The inverse of a rigid matrix."""
    r = [[m[j][i] for j in range(3)] for i in range(3)]
    return [r[i] + [-sum(r[i][k] * m[k][3] for k in range(3))] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def black_png(width, height):
    """A black PNG image."""
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    rows = (b"\0" + b"\0" * (3 * width)) * height
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def png_or_jpeg_size(path):
    data = path.read_bytes()
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack(">II", data[16:24])
    at = 2
    while at + 9 < len(data):
        marker, length = data[at + 1], struct.unpack(">H", data[at + 2 : at + 4])[0]
        if marker in (0xC0, 0xC1, 0xC2):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + length
    sys.exit(f"{path}: neither PNG nor JPEG")


# Exit codes of data and of models that are refused. Others are mistakes in the call, crashes and interruptions, which tell nothing of the data.
REFUSED = (3, 6)


class Transforms:
    """transforms.json, or transforms_train.json and its siblings: one entry per image."""

    def __init__(self, root):
        self.root = root
        self.documents = {path.name: json.loads(path.read_text()) for path in sorted(root.glob("transforms*.json"))}
        for document in self.documents.values():
            document["frames"] = [frame for frame in document["frames"] if self.image(frame).is_file()]

    def image(self, frame):
        path = self.root / frame["file_path"]
        return path if path.suffix else path.with_name(path.name + ".png")

    def main(self):
        return self.documents.get("transforms_train.json") or self.documents["transforms.json"]

    def poses(self, change):
        """Replaces the poses of training images by what `change` makes of their list."""
        frames = self.main()["frames"]
        for frame, pose in zip(frames, change([frame["transform_matrix"] for frame in frames])):
            frame["transform_matrix"] = pose

    def no_times(self):
        for document in self.documents.values():
            for frame in document["frames"]:
                frame["time"] = 0.0

    def focal(self, factor):
        for document in self.documents.values():
            for target in [document, *document["frames"]]:
                for key in ("fl_x", "fl_y"):
                    if key in target:
                        target[key] *= factor
                for key in ("camera_angle_x", "camera_angle_y"):
                    if key in target:
                        target[key] = 2.0 * math.atan(math.tan(0.5 * target[key]) / factor)

    def one_image(self):
        """A dataset without a split of its own holds out every eighth image, so it keeps two."""
        self.main()["frames"] = self.main()["frames"][: 1 if "transforms_train.json" in self.documents else 2]

    def half_missing(self, rng):
        frames = self.main()["frames"]
        gone = set(rng.sample(range(len(frames)), len(frames) // 2))
        return {self.image(frames[i]).resolve() for i in gone}

    def write(self, target):
        for name, document in self.documents.items():
            (target / name).write_text(json.dumps(document))
        return set(self.documents)


class Panoptic:
    """train_meta.json and test_meta.json: lists by time, then by camera."""

    def __init__(self, root):
        self.root = root
        self.documents = {path.name: json.loads(path.read_text()) for path in root.glob("*_meta.json")}

    def main(self):
        return self.documents["train_meta.json"]

    def poses(self, change):
        self.main()["w2c"] = [[inverse(m) for m in change([inverse(m) for m in instant])] for instant in self.main()["w2c"]]

    def no_times(self):
        for document in self.documents.values():
            for key in ("fn", "k", "w2c", "cam_id"):
                document[key] = [[value for instant in document[key] for value in instant]]

    def focal(self, factor):
        for document in self.documents.values():
            document["k"] = [[[[factor * v[0][0], v[0][1], v[0][2]], [v[1][0], factor * v[1][1], v[1][2]], v[2]] for v in instant] for instant in document["k"]]

    def one_image(self):
        for key in ("fn", "k", "w2c", "cam_id"):
            self.main()[key] = [self.main()[key][0][:1]]

    def half_missing(self, rng):
        names = [name for instant in self.main()["fn"] for name in instant]
        return {(self.root / "ims" / name).resolve() for name in rng.sample(names, len(names) // 2)}

    def write(self, target):
        for name, document in self.documents.items():
            (target / name).write_text(json.dumps(document))
        return set(self.documents)


def shuffled(rng):
    def change(poses):
        order = list(range(len(poses)))
        while any(i == j for i, j in enumerate(order)) and len(order) > 1:
            rng.shuffle(order)
        return [poses[i] for i in order]

    return change


DAMAGES = {
    "same": lambda data, rng: None,
    "scaled": lambda data, rng: data.poses(lambda poses: [scaled(m, 2.0) if i % 2 else m for i, m in enumerate(poses)]),
    "shuffled": lambda data, rng: data.poses(shuffled(rng)),
    "no-times": lambda data, rng: data.no_times(),
    "black": lambda data, rng: None,
    "one-image": lambda data, rng: data.one_image(),
    "away": lambda data, rng: data.poses(lambda poses: [turned(m) for m in poses]),
    "half-missing": lambda data, rng: None,
    "focal": lambda data, rng: data.focal(1.3),
}


def mirror(source, target, skip, without, black):
    """Links files, without those that are missing; images become `black` if it is given."""
    target.mkdir(parents=True, exist_ok=True)
    for entry in source.iterdir():
        copy = target / entry.name
        if entry.is_dir():
            mirror(entry, copy, set(), without, black)
        elif entry.name in skip or entry.resolve() in without:
            continue
        elif black and entry.suffix.lower() in (".png", ".jpg", ".jpeg") and source.name != "seg" and source.parent.name != "seg":
            size = png_or_jpeg_size(entry) if black.get("size") is None else black["size"]
            black["size"] = size
            copy.write_bytes(black.setdefault(size, black_png(*size)))
        else:
            os.symlink(entry.resolve(), copy)


def damage(name, source, target):
    rng = random.Random(0)
    data = Panoptic(source) if (source / "train_meta.json").is_file() else Transforms(source)
    DAMAGES[name](data, rng)
    without = data.half_missing(rng) if name == "half-missing" else set()
    if target.exists():
        shutil.rmtree(target)
    mirror(source, target, set(data.documents), without, {"size": None} if name == "black" else None)
    data.write(target)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", default="target/release/cc4dgs")
    parser.add_argument("--preset")
    parser.add_argument("--device", default="flex")
    parser.add_argument("--only", help="names of damages, separated by commas: " + ", ".join(DAMAGES))
    parser.add_argument("--floor", type=float, default=20.0, help="dB that a model with exit code 0 must reach on the undamaged scene")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    args = parser.parse_args()
    if not any((args.scene / name).is_file() for name in ("transforms.json", "transforms_train.json", "train_meta.json")):
        sys.exit(f"{args.scene}: neither transforms.json, transforms_train.json nor train_meta.json is there")
    names = args.only.split(",") if args.only else list(DAMAGES)
    unknown = [name for name in names if name not in DAMAGES]
    if unknown:
        sys.exit(f"--only {','.join(unknown)}: known are {', '.join(DAMAGES)}")

    results, wrong = [], 0
    for name in names:
        copy, run = args.out / name / "scene", args.out / name / "run"
        damage(name, args.scene, copy)
        # A refused run writes no checkpoint; one of an earlier call must not be scored in its place.
        shutil.rmtree(run, ignore_errors=True)
        options = [part for assignment in args.sets for part in ("--set", assignment)]
        if args.preset:
            options += ["--preset", args.preset]
        command = [args.bin, "train", "--scene", str(copy), "--device", args.device, "--out", str(run), "--overwrite", *options]
        ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        lines = [line for line in ended.stderr.splitlines() if line.strip()]
        warnings = [line for line in lines if line.startswith("warning: ")]
        verdicts = [line for line in lines if line.startswith(("error: ", "verdict: "))]
        last = verdicts[-1] if verdicts else (lines[-1] if lines else "")
        psnr = None
        if (run / "checkpoint").is_file():
            report = args.out / name / "eval.json"
            report.unlink(missing_ok=True)
            measure = [args.bin, "--quiet", "eval", str(run), "--scene", str(args.scene), "--device", args.device, "--sheet-rows", "0", f"--json={report}"]
            if subprocess.run(measure, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode == 0:
                psnr = json.loads(report.read_text())["psnr_db"]
        results.append({"damage": name, "exit": ended.returncode, "last": last, "warnings": warnings, "psnr_db": psnr})
        # Half of the images may be enough, and a static scene needs no times; the run must say so all the same, and the model must be no blur.
        spoken = {"half-missing": "missing", "no-times": "time"}.get(name)
        warned = ended.returncode == 0 and spoken is not None and any(spoken in warning for warning in warnings) and (psnr or 0.0) >= args.floor
        expected = ended.returncode == 0 if name == "same" else ended.returncode in REFUSED or warned
        wrong += not expected
        shown = "     -" if psnr is None else f"{psnr:6.2f}"
        print(f"{name:<13} exit {ended.returncode:>3} {shown} dB  {'' if expected else 'UNEXPECTED '}{last}", flush=True)
        for warning in warnings:
            print(f"{'':<30}{warning}")
    version = subprocess.run([args.bin, "--version"], capture_output=True, text=True).stdout.strip()
    document = {"scene": args.scene.name, "version": version, "floor_db": args.floor, "preset": args.preset, "device": args.device, "sets": args.sets, "results": results}
    (args.out / "sabotage.json").write_text(json.dumps(document, indent=1) + "\n")
    sys.exit(wrong)


if __name__ == "__main__":
    main()
