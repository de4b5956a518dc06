#!/usr/bin/env python3
"""Trains captures with `auto` and nothing else, beside other settings, and holds the results to floors.

    python3 benches/captures.py OUT --bin BIN [--minutes 5] [--scene NAME=PATH ...] [--with none --with panoptic] [--only NAME,...]

Every scene is trained once per setting for the same wall time, evaluated once on its held-out views, and reported as one row: PSNR (whole images, moving pixels),
SSIM, Gaussians, seconds, exit code, and the plan. `auto+METHOD` keeps the plan and exchanges the field; other names are presets, which run for as many iterations
as take the same time. Finished rows are kept in OUT/rows.json and not run again. Floors are in benches/captures.json; a row below its floor makes the exit code 1.
"""
import argparse
import json
import pathlib
import subprocess
import sys
import time

CAPTURES = ["dome", "rig", "handheld", "photos", "turntable", "sparse", "long", "exposure", "lens", "units", "dark", "appear"]


def run(binary, arguments, log):
    began = time.time()
    with open(log, "w") as file:
        code = subprocess.run([binary, *arguments], stdout=file, stderr=subprocess.STDOUT).returncode
    return code, time.time() - began


def last_line(log):
    lines = [line.strip() for line in open(log, errors="replace").read().replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1][:400] if lines else ""


def train(options, name, path, setting, minutes, extra):
    """One row: what training and evaluation of `path` with `setting` give."""
    out = options.out / f"{name}-{setting.replace('+', '-')}"
    out.parent.mkdir(parents=True, exist_ok=True)
    arguments = ["train", "--scene", path, "--out", str(out), "--overwrite", "--quiet"]
    if setting == "none":
        arguments += ["--preset", "auto+none"]
    elif setting != "auto":
        arguments += ["--preset", setting]
    if setting == "none" or setting.startswith("auto"):
        arguments += ["--minutes", str(minutes)]
    if options.threads:
        arguments += ["--threads", str(options.threads)]
    for text in extra:
        arguments += ["--set", text]
    train_log = out.with_suffix(".train.log")
    code, seconds = run(options.bin, arguments, train_log)
    row = {"scene": name, "setting": setting, "minutes": minutes, "exit": code, "seconds": round(seconds, 1)}
    if code != 0:
        row["said"] = last_line(train_log)
    config = out / "config.toml"
    if config.exists():
        text = config.read_text()
        row["plan"] = [line.strip().strip('",') for line in text.splitlines() if line.strip().startswith('"')]
    if (out / "checkpoint").exists():
        report = out.with_suffix(".json")
        eval_code, _ = run(options.bin, ["eval", str(out), "--scene", path, "--split", "test", f"--json={report}", "--quiet"], out.with_suffix(".eval.log"))
        if eval_code == 0:
            found = json.loads(report.read_text())
            for key in ["psnr_db", "psnr_dynamic_db", "ssim", "gaussians", "dynamic_gaussians"]:
                row[key] = found.get(key)
        else:
            row["said"] = last_line(out.with_suffix(".eval.log"))
    return row


def shown(value, digits=2):
    return "-" if value is None else f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--threads", type=int, default=0, help="threads of each training; 0 takes all cores")
    parser.add_argument("--scene", action="append", default=[], metavar="NAME=PATH", help="a dataset beside the captures")
    parser.add_argument("--with", dest="settings", action="append", default=[], help="another setting: none, auto+METHOD, a preset")
    parser.add_argument("--without-auto", action="store_true")
    parser.add_argument("--only", default="", help="names of scenes, with commas")
    parser.add_argument("--set", dest="sets", action="append", default=[], help="handed to every training")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    floors = json.loads((pathlib.Path(__file__).parent / "captures.json").read_text())
    scenes = [(name, f"procedural:captures/{name}") for name in CAPTURES] + [tuple(text.split("=", 1)) for text in options.scene]
    if options.only:
        scenes = [scene for scene in scenes if scene[0] in options.only.split(",")]
    kept = options.out / "rows.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    below = []
    print("| scene | setting | PSNR dB | moving pixels | SSIM | Gaussians (moving) | seconds | exit |\n| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, path in scenes:
        for setting in ([] if options.without_auto else ["auto"]) + options.settings:
            row = next((r for r in rows if (r["scene"], r["setting"], r["minutes"]) == (name, setting, options.minutes)), None)
            if row is None:
                row = train(options, name, path, setting, options.minutes, options.sets)
                rows.append(row)
                kept.write_text(json.dumps(rows, indent=1))
            numbers = [shown(row.get("psnr_db")), shown(row.get("psnr_dynamic_db")), shown(row.get("ssim"), 3)]
            count = f"{shown(row.get('gaussians'))} ({shown(row.get('dynamic_gaussians'))})"
            print(f"| {name} | {setting} | {' | '.join(numbers)} | {count} | {row['seconds']:.0f} | {row['exit']} {row.get('said', '')} |", flush=True)
            floor = floors.get(name, {}).get("psnr_db")
            if setting == "auto" and floor is not None and (row["exit"] != 0 or (row.get("psnr_db") or 0.0) < floor):
                below.append(f"{name}: {shown(row.get('psnr_db'))} dB, floor {floor}")
    for text in below:
        print(f"below its floor: {text}", file=sys.stderr)
    return 1 if below else 0


if __name__ == "__main__":
    sys.exit(main())
