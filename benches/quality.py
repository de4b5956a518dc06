#!/usr/bin/env python3
"""Long trainings of published scenes with `auto`, each scored once on its test views, with curves of validation PSNR against wall time.

    python3 benches/quality.py OUT --bin BIN --data DATA [--only mutant-5,...] [--threads N] [--minutes M] [--set KEY=VALUE ...] [--curves]

DATA holds `dnerf_mutant` and `panoptic_basketball`. Every run is trained for its minutes of wall time, then evaluated on the test split. An interrupted run is resumed from its checkpoint when
the script is called again; a finished one is not repeated. With `--curves` every run is trained a second time with views kept out of training, and its log holds the
curve. The three medians of `bench step` are measured before every run. `--minutes` plans the runs for another time than their own. Results are kept in
OUT/rows.json, one row per run, list of --set, minutes, threads, data folder and program (its SHA-256); each has a folder of its own, OUT/NAME-HASH. What fails has no
row and makes the exit code 1, as does a run below its aim. `peak_memory_mb` is the most resident memory of the training's last process, in MB of 10^6 bytes.
"""
import argparse
import hashlib
import json
import os
import pathlib
import subprocess
import sys
import time
import tomllib

from trainings import TRAINED, Rows, let_end, points, sha256, trained

# Name, scene, minutes, settings, and the PSNR in dB it is meant to reach.
RUNS = [
    ("mutant-5", "dnerf_mutant", 5, ["scene.width=400"], 36.2),
    ("mutant-30", "dnerf_mutant", 30, ["scene.width=400"], 40.0),
    ("basketball-6", "panoptic_basketball", 6, ["scene.width=640", "scene.frames=[0,30,1]"], 26.2),
    ("basketball-25", "panoptic_basketball", 25, ["scene.width=640", "scene.frames=[0,30,1]"], 27.0),
    ("basketball-all-40", "panoptic_basketball", 40, ["scene.width=640"], 28.0),
    ("mutant-800-90", "dnerf_mutant", 90, ["scene.width=800"], 40.5),
    # Deformable 3DGS and Grid4D are published on black, 4DGS on white.
    ("mutant-800-black-90", "dnerf_mutant", 90, ["scene.width=800", "render.background=[0.0,0.0,0.0]"], 40.5),
    ("basketball-all-180", "panoptic_basketball", 180, ["scene.width=640"], 28.0),
]
CURVES = ["train.validation=12"]


def medians(options, out):
    """Median milliseconds of `bench step` by case, or None where it fails."""
    report = out.with_suffix(".step.json")
    report.unlink(missing_ok=True)
    arguments = [options.bin, "bench", "step", "--repeats", "5", "--quiet", f"--json={report}"]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    if subprocess.run(arguments, stdout=subprocess.DEVNULL).returncode != 0:
        return None
    return json.loads(report.read_text())


def measured(arguments, file):
    """Exit code of a process that writes to `file`, and the most resident memory it had, in MB."""
    child = subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT)
    try:
        _, status, usage = os.wait4(child.pid, 0)
    except BaseException:
        let_end(child)
        raise
    child.returncode = os.waitstatus_to_exitcode(status)
    return child.returncode, round(usage.ru_maxrss * 1024 / 1e6, 1)


def train(options, stated, settings):
    """The row of a run: what is stated of it, and what it reached; without a PSNR where it failed."""
    digest = hashlib.sha256(json.dumps(stated).encode()).hexdigest()[:8]
    # What states anything else must not resume this one's checkpoint.
    out = options.out / f"{stated['name']}-{digest}"
    path = str(options.data / stated["scene"])
    log = out.with_suffix(".train.log")
    step = medians(options, out)
    arguments = ["train", "--scene", path, "--out", str(out), "--quiet", f"--json={out.with_suffix('.train.json')}"]
    resumed = (out / "checkpoint").exists()
    if resumed:
        arguments += ["--resume"]
    else:
        arguments += ["--overwrite", "--minutes", str(stated["minutes"])]
        for text in [*settings, "train.checkpoint_every=2000", *options.sets]:
            arguments += ["--set", text]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    out.with_suffix(".train.json").unlink(missing_ok=True)
    before, began = trained(out) if resumed else 0.0, time.time()
    with open(log, "a") as file:
        code, peak = measured([options.bin, *arguments], file)
    row = {**stated, "exit": code, "resumed": resumed}
    row |= {"seconds": round(before + time.time() - began, 1), "peak_memory_mb": peak, "bench_step": step, "curve": curve(out)}
    report = out.with_suffix(".eval.json")
    report.unlink(missing_ok=True)
    evaluation = [options.bin, "eval", str(out), "--scene", path, "--split", "test", f"--json={report}", "--sheet", str(out.with_suffix(".png")), "--quiet"]
    with open(out.with_suffix(".eval.log"), "w") as file:
        if code in TRAINED and subprocess.run(evaluation, stdout=file, stderr=subprocess.STDOUT).returncode == 0:
            found = json.loads(report.read_text())
            keys = ["psnr_db", "psnr_dynamic_db", "ssim", "gaussians", "dynamic_gaussians", "size_mb", "psnr_worst_block_db", "lost_blocks"]
            row |= {key: found.get(key) for key in keys}
    config = out / "config.toml"
    row["plan"] = tomllib.loads(config.read_text()).get("auto", {}).get("plan", []) if config.exists() else []
    return row


def curve(out):
    """Seconds and PSNR of validation views, of a run with views kept out of training."""
    return [[round(event["seconds"], 1), round(event["psnr_db"], 3)] for event in points(out, "validated")]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--only", default="", help="names of runs, with commas")
    parser.add_argument("--threads", type=int, default=0, help="threads of each training; 0 takes all cores")
    parser.add_argument("--curves", action="store_true")
    parser.add_argument("--minutes", type=float, help="what every run is planned for, in place of its own time")
    parser.add_argument("--set", dest="sets", action="append", default=[], help="handed to every training")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = Rows(options.out / "rows.json")
    below = []
    for name, scene, minutes, settings, aim in RUNS:
        if options.only and name not in options.only.split(","):
            continue
        for name, settings in [(name, settings)] + ([(f"{name}-curve", settings + CURVES)] if options.curves else []):
            stated = {"name": name, "scene": scene, "path": str(options.data / scene), "minutes": options.minutes or minutes}
            stated |= {"settings": [*settings, *options.sets], "threads": options.threads, "binary_sha256": sha256(options.bin)}
            row = rows.find(stated)
            if row is None:
                row = train(options, stated, settings)
                if row.get("psnr_db") is not None:
                    rows.keep(row)
            psnr = row.get("psnr_db")
            print(f"{name:24} {psnr or float('nan'):.2f} dB (aim {aim}), SSIM {row.get('ssim') or float('nan'):.4f}, {row.get('gaussians')} Gaussians, {row['seconds']} s, exit {row['exit']}", flush=True)
            if psnr is None or psnr < aim:
                below.append(name)
    return 1 if below else 0


if __name__ == "__main__":
    sys.exit(main())
