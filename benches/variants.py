#!/usr/bin/env python3
"""Compares settings at equal wall time on validation views, never on test views.

    python3 benches/variants.py OUT --bin BIN --minutes 3 --scene rig=procedural:captures/rig:7 --variant 'batch=train.batch=4;train.lr.batch_power=0.5' [--seeds 2]
                                [--set KEY=VALUE ...] [--preset NAME] [--views N] [--threads N] [--jobs N]

Every scene is trained with the preset (`auto`) as it is, called `base`, and with each variant's settings on top. The plan gives each variant as many iterations as
take the same time. A line with validation PSNR, and what the variant gains on `base`, is printed for each training. `--jobs` trains so many at once: give each as many `--threads` as there are
cores for it, and compare rows of one call only.

Rows are kept in OUT/rows.json and not run again with the same scene, path, variant, --set, preset, views, threads, jobs, minutes, seed and program (its SHA-256). Trainings
that fail, with exit codes other than 0 and 6, have no row there, and make the exit code 1.
"""
import argparse
import json
import pathlib
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from trainings import TRAINED, Rows, begin, ended, interrupt, sha256


def train(options, stated):
    """The row of one training: what is stated of it, and what it gave."""
    seed, settings = stated["seed"], stated["settings"]
    out = options.out / f"{stated['scene']}-{stated['variant']}-{seed}"
    report = out.with_suffix(".json")
    report.unlink(missing_ok=True)
    arguments = ["train", "--scene", stated["path"], "--out", str(out), "--overwrite", "--quiet", "--preset", options.preset, f"--json={report}"]
    if options.minutes > 0:
        arguments += ["--minutes", str(options.minutes)]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    for text in [f"train.validation={options.views}", f"seed={seed}", *options.sets, *settings]:
        arguments += ["--set", text]
    began = time.time()
    with open(out.with_suffix(".log"), "w") as log:
        code = ended(begin([options.bin, *arguments], stdout=log, stderr=subprocess.STDOUT))
    row = stated | {"exit": code, "seconds": round(time.time() - began, 1)}
    if report.exists():
        found = json.loads(report.read_text())
        verdict = found.get("verdict") or {}
        row |= {"gaussians": found.get("gaussians"), "moving_gaussians": found.get("dynamic_gaussians"), "iterations": found.get("iterations")}
        row |= {key: verdict.get(f"{key}_psnr_db") for key in ["train", "validation", "moving"] if verdict.get(f"{key}_psnr_db") is not None}
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--minutes", type=float, default=3.0, help="0 leaves the iterations to the preset and the settings")
    parser.add_argument("--views", type=int, default=12, help="validation views")
    parser.add_argument("--threads", type=int, default=0, help="threads of each training; 0 takes all cores")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scene", action="append", default=[], metavar="NAME=PATH", required=True)
    parser.add_argument("--variant", action="append", default=[], metavar="NAME=KEY=VALUE;...")
    parser.add_argument("--set", dest="sets", action="append", default=[], help="for every variant, `base` included")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    variants = [("base", [])] + [(text.split("=", 1)[0], text.split("=", 1)[1].split(";")) for text in options.variant]
    rows = Rows(options.out / "rows.json")
    shared = {key: getattr(options, key) for key in ["sets", "preset", "views", "threads", "jobs", "minutes"]}
    program = sha256(options.bin)
    table, failed = {}, []

    def stated_of(scene, path, seed, name, settings):
        return {"scene": scene, "path": path, "variant": name, "settings": settings, "seed": seed, **shared, "binary_sha256": program}

    scenes = [text.split("=", 1) for text in options.scene]
    trainings = [stated_of(scene, path, seed, name, settings) for scene, path in scenes for seed in range(options.seeds) for name, settings in variants]

    def one(stated):
        """The row, kept as soon as it is there."""
        row = rows.find(stated)
        if row is None:
            row = train(options, stated)
            if row["exit"] in TRAINED:
                rows.keep(row)
        return row

    with ThreadPoolExecutor(options.jobs) as pool:
        try:
            # In the order of the list, in which a base comes before its variants.
            for stated, row in zip(trainings, pool.map(one, trainings)):
                scene, name, seed = stated["scene"], stated["variant"], stated["seed"]
                if row["exit"] not in TRAINED:
                    failed.append(f"{scene}-{name}-{seed}")
                table[scene, name, seed] = row.get("validation")
                base = table[scene, "base", seed]
                gain = f"{row['validation'] - base:+.2f}" if row.get("validation") and base else "-"
                print(f"{scene:12} {name:16} seed {seed}: validation {row.get('validation') or float('nan'):.2f} dB ({gain}), training {row.get('train') or float('nan'):.2f} dB, "
                      f"{row.get('gaussians')} Gaussians ({row.get('moving_gaussians')} move), {row.get('iterations')} iterations, {row['seconds']} s, exit {row['exit']}", flush=True)
        except KeyboardInterrupt:
            return interrupt(pool)
    print("".join(f"failed: {name}, see {options.out / name}.log\n" for name in failed), end="", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
