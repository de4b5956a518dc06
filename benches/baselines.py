#!/usr/bin/env python3
"""Every baseline at its published size and rates for the same wall time: how far it comes, and the curve.

    python3 benches/baselines.py OUT --bin BIN --scene DATA/dnerf_mutant [--minutes 60] [--only hexplane,...] [--jobs 1] [--threads N]

Trains `dnerf+METHOD` (published iterations, sizes and rates; 800x800) and interrupts it after --minutes of training. What it has learned until then is evaluated once
on the test views; its learning rates have not fallen yet, so this is no figure of a finished training. Results are in OUT/rows.json, one row per method: iterations
reached of those published, seconds, PSNR, SSIM, and PSNR of the training views over time. Called again, it resumes what was cut off and leaves out what is done.
With --jobs 2 --threads 1 two methods share the machine.
"""
import argparse
import json
import pathlib
import signal
import subprocess
import sys
import threading
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor

METHODS = ["hexplane", "native-4d", "swift4d", "embedding", "grid4d", "deform-mlp"]
WRITING = threading.Lock()


def events(out):
    log = out / "events.jsonl"
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def trained(out):
    """Seconds of training, all parts of an interrupted run together."""
    total, last = 0.0, 0.0
    for event in events(out):
        if event["event"] == "run-started":
            total, last = total + last, 0.0
        last = event.get("seconds", last)
    return total + last


def stop(child, seconds):
    """Lets a training run for so long, then asks it to write its checkpoint and end. Returns its exit code."""
    try:
        return child.wait(max(seconds, 1))
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGINT)
    try:
        return child.wait(600)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def row(options, method):
    out = options.out / method
    resumed = (out / "checkpoint").exists()
    arguments = ["train", "--scene", str(options.scene), "--out", str(out), "--quiet"]
    if resumed:
        arguments += ["--resume"]
    else:
        arguments += ["--overwrite", "--preset", f"dnerf+{method}", "--set", "scene.width=800", "--set", "train.checkpoint_every=500"]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    left = 60 * options.minutes - trained(out) if resumed else 60 * options.minutes
    code = None
    if left > 30:
        with open(options.out / f"{method}.log", "a") as log:
            code = stop(subprocess.Popen([options.bin, *arguments], stdout=log, stderr=subprocess.STDOUT), left)
    report = options.out / f"{method}.json"
    report.unlink(missing_ok=True)
    evaluation = [options.bin, "eval", str(out), "--scene", str(options.scene), "--split", "test", f"--json={report}", "--sheet", str(options.out / f"{method}.png"), "--quiet"]
    with open(options.out / f"{method}.eval.log", "w") as log:
        scored = subprocess.run(evaluation, stdout=log, stderr=subprocess.STDOUT).returncode == 0
    steps = [e for e in events(out) if e["event"] == "iteration"]
    stages = {e["stage"]: e["iterations"] for e in events(out) if e["event"] == "stage-started"}
    done = sum(count for stage, count in stages.items() if stage != steps[-1]["stage"]) + steps[-1]["iteration"] if steps else 0
    curve, seconds = [], 0.0
    for event in events(out):
        if event["event"] == "iteration" and event["seconds"] >= seconds + 60:
            seconds = event["seconds"]
            curve.append([round(seconds), event["stage"], event["iteration"], round(event["psnr_db"], 2)])
    found = json.loads(report.read_text()) if scored else {}
    config = out / "config.toml"
    published = tomllib.loads(config.read_text())["train"]["iterations"] if config.exists() else None
    keys = ["psnr_db", "ssim", "gaussians", "dynamic_gaussians", "size_mb", "psnr_worst_block_db"]
    return {"method": method, "exit": code, "resumed": resumed, "seconds": round(trained(out), 1), "iterations": done, "published_iterations": published,
            "threads": options.threads, "jobs": options.jobs, **{key: found.get(key) for key in keys}, "training_views": curve}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--scene", type=pathlib.Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--only", default=",".join(METHODS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / "rows.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []

    def one(method):
        if any(r["method"] == method and r["psnr_db"] is not None for r in rows):
            return
        began = time.time()
        found = row(options, method)
        with WRITING:
            rows[:] = [r for r in rows if r["method"] != method] + [found]
            kept.write_text(json.dumps(rows, indent=1) + "\n")
            psnr = found["psnr_db"]
            print(f"{method:12} {found['iterations']:6} of {found['published_iterations']} iterations, {found['seconds']:.0f} s, "
                  f"{'no score' if psnr is None else f'{psnr:.2f} dB'}, exit {found['exit']}, {time.time() - began:.0f} s in all", flush=True)

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(one, options.only.split(",")))
    return 1 if any(r["psnr_db"] is None for r in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
