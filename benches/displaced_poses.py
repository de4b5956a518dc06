#!/usr/bin/env python3
"""Copies a `transforms.json` and turns and moves its cameras a little, to measure what poses that are not exact cost.

    python3 benches/displaced_poses.py DATASET COPY [--degrees 0.3] [--share 0.005] [--seed 5] [--keep EVAL.json ...]

Every camera turns about a random axis and its centre moves in a random direction. --degrees is the root mean square of the angle, --share that of the move, as a
share of the extent of the cameras (1.1 times the largest distance from their mean). Cameras of the images in --keep, files of `cc4dgs eval --json`, keep their poses:
those are held out. Images are not copied: the folder of the copy has a link to `images`. Needs NumPy.
"""
import argparse
import json
import math
import pathlib

import numpy


def rotation(vector):
    """The rotation matrix of a rotation vector (radians)."""
    angle = numpy.linalg.norm(vector)
    x, y, z = vector / angle
    cross = numpy.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return numpy.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=pathlib.Path)
    parser.add_argument("copy", type=pathlib.Path)
    parser.add_argument("--degrees", type=float, default=0.3)
    parser.add_argument("--share", type=float, default=0.005)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--keep", type=pathlib.Path, nargs="*", default=[])
    options = parser.parse_args()

    kept = {image["camera"] for file in options.keep for image in json.loads(file.read_text())["images"]}
    transforms = json.loads((options.dataset / "transforms.json").read_text())
    centres = numpy.array([frame["transform_matrix"] for frame in transforms["frames"]])[:, :3, 3]
    extent = 1.1 * numpy.linalg.norm(centres - centres.mean(0), axis=1).max()
    random = numpy.random.default_rng(options.seed)
    moved = 0
    for frame in transforms["frames"]:
        turn = random.normal(size=3) * math.radians(options.degrees) / math.sqrt(3)
        move = random.normal(size=3) * extent * options.share / math.sqrt(3)
        if frame["file_path"] in kept:
            continue
        pose = numpy.array(frame["transform_matrix"])
        pose[:3, :3] = rotation(turn) @ pose[:3, :3]
        pose[:3, 3] += move
        frame["transform_matrix"] = pose.tolist()
        moved += 1
    options.copy.mkdir(parents=True, exist_ok=True)
    link = options.copy / "images"
    if not link.is_symlink():
        link.symlink_to((options.dataset / "images").resolve())
    (options.copy / "transforms.json").write_text(json.dumps(transforms))
    print(f"{moved} of {len(transforms['frames'])} cameras turned and moved; {len(kept)} kept")


if __name__ == "__main__":
    main()
