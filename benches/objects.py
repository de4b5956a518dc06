#!/usr/bin/env python3
"""Whether an object of one colour is in every image that shows it: the overlap of its pixels in renders with those in the ground truth.

    cc4dgs eval RUN --scene DATA/panoptic_basketball --renders RENDERS --json=EVAL.json
    python3 benches/objects.py EVAL.json RENDERS --images DATA/panoptic_basketball/ims [--json F]

The object is what is redder than RED levels above green and blue, such as the ball of PanopticSports basketball. Overlap is intersection over union of both
sets of pixels. An image shows the object if at least LEAST pixels of the ground truth do (in an image of 640x360; other sizes in proportion). EVAL.json
says camera and frame of every render. Needs numpy and Pillow.
"""
import argparse
import json
import pathlib
import sys

import numpy
from PIL import Image

RED = 50
LEAST = 60
# Overlap from which an object counts as there.
THERE = 0.3


def object_pixels(image):
    red, green, blue = (numpy.asarray(image.convert("RGB"), dtype=int)[..., k] for k in range(3))
    return red - numpy.maximum(green, blue) > RED


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evaluation", type=pathlib.Path)
    parser.add_argument("renders", type=pathlib.Path)
    parser.add_argument("--images", type=pathlib.Path, required=True, help="a folder per camera")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    report = json.loads(options.evaluation.read_text())
    views = report["images"]
    # Frames are counted among those that were chosen.
    first, _, stride = report["provenance"]["config"].get("scene", {}).get("frames") or (0, 0, 1)
    rows = []
    for index, view in enumerate(views):
        camera, frame = view["camera"], view["frame"]
        render = Image.open(options.renders / f"{index:05}.png")
        truth = sorted(path for path in (options.images / camera).iterdir() if not path.name.startswith("."))[first + frame * stride]
        shown = object_pixels(Image.open(truth).resize(render.size, Image.Resampling.BOX))
        drawn = object_pixels(render)
        if shown.sum() < LEAST * render.size[0] * render.size[1] / (640 * 360):
            continue
        rows.append({"camera": camera, "frame": frame, "pixels": int(shown.sum()), "overlap": round(float((shown & drawn).sum() / (shown | drawn).sum()), 4)})
    if not rows:
        sys.exit("no image shows the object")
    overlaps = [row["overlap"] for row in rows]
    lost = [row for row in rows if row["overlap"] < THERE]
    print(f"{len(rows)} of {len(views)} images show it; overlap: median {numpy.median(overlaps):.2f}, least {min(overlaps):.2f}; lost (below {THERE}) in {len(lost)}")
    for row in lost:
        print(f"  camera {row['camera']}, frame {row['frame']}: {row['overlap']:.2f} of {row['pixels']} pixels")
    if options.json:
        options.json.write_text(json.dumps({"threshold": RED, "images": rows}, indent=1))


if __name__ == "__main__":
    main()
