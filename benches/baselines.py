#!/usr/bin/env python3
"""Every baseline at its published size and rates for the same wall time: how far it comes, and the curve.

    python3 benches/baselines.py OUT --bin BIN --scene DATA/dnerf_mutant [--minutes 60] [--only hexplane,...] [--jobs 1] [--threads N] [--processor] [--width 800]

Trains `dnerf+METHOD` (published iterations, sizes and rates; 800x800, or --width: the configurations of `native-4d` train at 400) and
interrupts it after --minutes of training. What it has learned until then is evaluated once on the test views; its learning rates have not
fallen yet, so this is no figure of a finished training. Presets have the background that a method is published on. Results are in
OUT/rows.json, one row per method: iterations reached of those published, seconds, PSNR, SSIM, and PSNR of the training views over time. With
--jobs 2 --threads 1 two methods share the machine.
--processor counts minutes of processor time, all threads of a training together, instead of those on the clock: nothing is lost while a training is stopped (SIGSTOP)
or waits for others. Seconds of the curve are those on the clock.

Called again, it resumes what was cut off and leaves out what is done with the same scene, minutes, jobs, threads and program (its SHA-256); runs have folders of
their own for each of these, OUT/METHOD-HASH. Ctrl-C asks what runs to write its checkpoint and end (exit code 130). A training that fails, or cannot be evaluated,
has no row, and makes the exit code 1.
"""
import argparse
import hashlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor

from trainings import TRAINED, Rows, begin, ended, events, interrupt, points, sha256, trained

METHODS = ["hexplane", "native-4d", "swift4d", "embedding", "grid4d", "deform-mlp"]


def used(child):
    """Processor seconds that all threads of a running process took; none once it has ended."""
    try:
        fields = pathlib.Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(child, seconds, note):
    """Lets a process run for so many seconds of wall time, or, with `note`, of processor time, which `note` gets every second. Its exit code if it ended."""
    if note is None:
        return ended(child, seconds)
    code, spent = None, 0.0
    while code is None and spent < seconds:
        code = ended(child, 1.0)
        spent = max(spent, used(child))
        note(spent)
    return code


def stop(child, seconds, note):
    """Lets a training run for so many seconds, then asks it to write its checkpoint and end. Returns its exit code, and whether it left a model."""
    code = run(child, seconds, note)
    if code is not None:
        return code, code in TRAINED
    child.send_signal(signal.SIGINT)
    code = ended(child, 600)
    if code is None:
        child.kill()
        code = child.wait()
    return code, code in (*TRAINED, 130)


def row(options, stated):
    """The row of one method: what is stated of it, and how far it came."""
    method = stated["method"]
    name = f"{method}-{hashlib.sha256(json.dumps(stated).encode()).hexdigest()[:8]}"
    out = options.out / name
    resumed = (out / "checkpoint").exists()
    arguments = ["train", "--scene", str(options.scene), "--out", str(out), "--quiet"]
    if resumed:
        arguments += ["--resume"]
    else:
        arguments += ["--overwrite", "--preset", f"dnerf+{method}", "--set", f"scene.width={options.width}", "--set", "train.checkpoint_every=500"]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    clock = options.out / f"{name}.processor"
    before = 0.0
    if resumed:
        before = float(clock.read_text()) if options.processor else trained(out)
    elif options.processor:
        clock.write_text("0.0\n")
    left = 60 * options.minutes - before
    note = (lambda seconds: clock.write_text(f"{before + seconds:.1f}\n")) if options.processor else None
    code, learned = None, True
    if left > 30:
        with open(options.out / f"{name}.log", "a") as log:
            code, learned = stop(begin([options.bin, *arguments], stdout=log, stderr=subprocess.STDOUT), left, note)
    report = options.out / f"{name}.json"
    report.unlink(missing_ok=True)
    evaluation = [options.bin, "eval", str(out), "--scene", str(options.scene), "--split", "test", f"--json={report}", "--sheet", str(options.out / f"{name}.png"), "--quiet"]
    with open(options.out / f"{name}.eval.log", "w") as log:
        scored = learned and ended(begin(evaluation, stdout=log, stderr=subprocess.STDOUT)) == 0
    steps = [e for e in events(out) if e["event"] == "iteration"]
    stages = {e["stage"]: e["iterations"] for e in events(out) if e["event"] == "stage-started"}
    done = sum(count for stage, count in stages.items() if stage != steps[-1]["stage"]) + steps[-1]["iteration"] if steps else 0
    curve, seconds = [], 0.0
    for event in points(out, "iteration"):
        if event["seconds"] >= seconds + 60:
            seconds = event["seconds"]
            curve.append([round(seconds), event["stage"], event["iteration"], round(event["psnr_db"], 2)])
    found = json.loads(report.read_text()) if scored else {}
    config = out / "config.toml"
    settings = tomllib.loads(config.read_text()) if config.exists() else {}
    published = settings.get("train", {}).get("iterations")
    keys = ["psnr_db", "ssim", "gaussians", "dynamic_gaussians", "size_mb", "psnr_worst_block_db"]
    return {**stated, "exit": code, "resumed": resumed, "seconds": round(trained(out), 1),
            "processor_seconds": float(clock.read_text()) if options.processor else None, "iterations": done, "published_iterations": published,
            "background": settings.get("render", {}).get("background"), **{key: found.get(key) for key in keys}, "training_views": curve}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--scene", type=pathlib.Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--only", default=",".join(METHODS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--width", type=int, default=800, help="pixels of the images")
    parser.add_argument("--processor", action="store_true", help="minutes of processor time")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = Rows(options.out / "rows.json")

    def one(method):
        """Whether the method has a score."""
        stated = {"method": method, "path": str(options.scene), "minutes": options.minutes, "threads": options.threads, "jobs": options.jobs}
        if options.processor:
            stated["clock"] = "processor"
        if options.width != 800:
            stated["width"] = options.width
        stated |= {"binary_sha256": sha256(options.bin)}
        if rows.find(stated):
            return True
        began = time.time()
        found = row(options, stated)
        psnr = found["psnr_db"]
        if psnr is not None:
            rows.keep(found)
        print(f"{method:12} {found['iterations']:6} of {found['published_iterations']} iterations, {found['seconds']:.0f} s, "
              f"{'no score' if psnr is None else f'{psnr:.2f} dB'}, exit {found['exit']}, {time.time() - began:.0f} s in all\n", end="", flush=True)
        return psnr is not None

    with ThreadPoolExecutor(options.jobs) as pool:
        try:
            scored = list(pool.map(one, options.only.split(",")))
        except KeyboardInterrupt:
            return interrupt(pool)
    return 0 if all(scored) else 1


if __name__ == "__main__":
    sys.exit(main())
