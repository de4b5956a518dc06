#!/usr/bin/env python3
"""Trains captures with `auto` and nothing else, beside other settings, and holds the results to floors.

    python3 benches/captures.py OUT --bin BIN [--minutes 5] [--jobs 2 --threads 1] [--with none --with panoptic] [--fields cdf,free-time] [--scene NAME=PATH ...]
                                [--only NAME,...] [--json FILE]

Every scene is trained once per setting, evaluated once on its held-out views, and reported as one row: PSNR (whole images, moving pixels) and its gain over `none`,
SSIM, Gaussians, seconds, exit code, and the plan. `auto+FIELD` exchanges the deformer of the plan; `none` is `auto+none`. All of these get `--minutes`. Another name
is a preset. It is trained again with other numbers of iterations until it takes as long as `auto` took on the scene (`--minutes` with --without-auto), to within a
quarter; the seventh training counts, whatever it takes. The seconds are those of the training that counts. `--jobs` above 1 makes trainings slower.

Finished rows are kept in OUT/rows.json and not run again with the same scene, path, setting, minutes, jobs, threads, --set and program (its SHA-256); a preset's, with
the same seconds to approach, too. A training that fails, with an exit code other than 0 and 6, or cannot be evaluated, has no row there, and makes the exit code 1.
Ctrl-C ends what runs (exit code 130), and the next call goes on with the next row. OUT/machine.json has the medians of `bench step`, measured before the first
training of a program with so many threads. Floors are in benches/captures.json, for `auto`: `psnr_db` of whole images; `gain_db` over `none`, of whole images or of
moving pixels, checked where `none` is trained too. A row below a floor makes the exit code 1.
"""
import argparse
import concurrent.futures
import json
import pathlib
import subprocess
import sys
import time
import tomllib

from trainings import TRAINED, Rows, begin, ended, interrupt, replace, sha256

CAPTURES = ["dome", "rig", "handheld", "photos", "turntable", "sparse", "long", "exposure", "lens", "units", "dark", "appear"]
SCORES = ["psnr_db", "psnr_dynamic_db", "ssim", "gaussians", "dynamic_gaussians"]
STATED = ["minutes", "jobs", "threads", "sets"]


def run(binary, arguments, log):
    began = time.time()
    with open(log, "w") as file:
        code = ended(begin([binary, *arguments], stdout=file, stderr=subprocess.STDOUT))
    return code, time.time() - began


def last_line(log):
    return open(log, errors="replace").read().replace("\r", "\n").strip().split("\n")[-1].strip()[:400]


def is_planned(setting):
    return setting == "none" or setting.split("+")[0] == "auto"


def machine(options):
    """What ran: the version and hash of the binary, and milliseconds of `bench step`, measured again for another binary or number of threads."""
    path, step = options.out / "machine.json", options.out / "step.json"
    stated = {"binary_sha256": sha256(options.bin), "threads": options.threads}
    kept = json.loads(path.read_text()) if path.exists() else {}
    if stated.items() <= kept.items() and kept["bench_step"] is not None:
        return kept
    version = subprocess.run([options.bin, "--version"], capture_output=True, text=True).stdout.strip()
    arguments = ["bench", "step", "--repeats", "5", "--quiet", f"--json={step}", "--threads", str(options.threads)]
    step.unlink(missing_ok=True)
    code, _ = run(options.bin, arguments, options.out / "step.log")
    found = {"version": version, **stated, "bench_step": json.loads(step.read_text()) if code == 0 else None}
    replace(path, found)
    return found


def train_for(target, train_with):
    """Iterations, exit code and seconds of the last of at most seven trainings, which approach `target` seconds by the secant method."""
    known, length = (20, train_with(20)[1]), 60
    for _ in range(6):
        trained, (code, seconds) = length, train_with(length)
        if code not in TRAINED or abs(seconds - target) < 0.25 * target:
            break
        # Times of short trainings are uncertain: an iteration takes at least half of the mean, and at most ten times as many follow.
        each = max((seconds - known[1]) / (trained - known[0]), 0.5 * seconds / trained)
        length = min(max(60, trained + int((target - seconds) / each)), 10 * trained)
        if length == trained:
            break
        known = (trained, seconds)
    return trained, code, seconds


def is_finished(row):
    """Whether there is a model and its scores."""
    return row["exit"] in TRAINED and "psnr_db" in row


def train(options, stated):
    """One row: what is stated of it, and what training and evaluation give."""
    name, path, setting = (stated[key] for key in ["scene", "path", "setting"])
    out = options.out / f"{name}-{setting.replace('+', '-')}"
    shared = ["--quiet", "--threads", str(options.threads)]

    def fit(*sets):
        chosen = [] if setting == "auto" else ["--preset", "auto+none" if setting == "none" else setting]
        planned = ["--minutes", str(options.minutes)] if is_planned(setting) else []
        sets = [word for text in [*options.sets, *sets] for word in ("--set", text)]
        return run(options.bin, ["train", "--scene", path, "--out", str(out), "--overwrite", *shared, *chosen, *planned, *sets], out.with_suffix(".train.log"))

    row = dict(stated)
    if is_planned(setting):
        code, seconds = fit()
    else:
        row["iterations"], code, seconds = train_for(stated["wanted_seconds"], lambda iterations: fit(f"train.iterations={iterations}"))
    row |= {"exit": code, "seconds": round(seconds, 1)}
    if code != 0:
        row["said"] = last_line(out.with_suffix(".train.log"))
    config = out / "config.toml"
    # What fails early leaves the settings of an earlier training there.
    row["plan"] = tomllib.loads(config.read_text()).get("auto", {}).get("plan", []) if code in TRAINED and config.exists() else []
    if code in TRAINED:
        report, log = out.with_suffix(".json"), out.with_suffix(".eval.log")
        report.unlink(missing_ok=True)
        eval_code, _ = run(options.bin, ["eval", str(out), "--scene", path, "--split", "test", f"--json={report}", *shared], log)
        found = json.loads(report.read_text()) if eval_code == 0 else None
        row |= {key: found.get(key) for key in SCORES} if found else {"said": last_line(log)}
    return row


def shown(value, digits=2):
    return "-" if value is None else f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def gains(row, none):
    """PSNR over that of the row of `none`, in dB: whole images, moving pixels."""
    pairs = [(row.get(key), (none or {}).get(key)) for key in ["psnr_db", "psnr_dynamic_db"]]
    return [None if a is None or b is None else a - b for a, b in pairs]


def printed(row, none):
    whole, moving = gains(row, none)
    gain = "-" if row["setting"] == "none" else f"{shown(whole)} ({shown(moving)})"
    scores = [shown(row.get("psnr_db")), shown(row.get("psnr_dynamic_db")), gain, shown(row.get("ssim"), 3)]
    count = f"{shown(row.get('gaussians'))} ({shown(row.get('dynamic_gaussians'))})"
    return f"| {row['scene']} | {row['setting']} | {' | '.join(scores)} | {count} | {row['seconds']:.0f} | {row['exit']} {row.get('said', '')} |"


def missed(row, none, floors):
    """The floors that a row of `auto` is below."""
    found, (whole, moving), floor, gain = [], gains(row, none), floors.get("psnr_db"), floors.get("gain_db")
    if floor is not None and (row["exit"] != 0 or (row.get("psnr_db") or 0.0) < floor):
        found.append(f"{row['scene']}: {shown(row.get('psnr_db'))} dB, exit code {row['exit']}, floor {floor} dB")
    if gain is not None and none is not None and max((g for g in [whole, moving] if g is not None), default=-1e9) < gain:
        found.append(f"{row['scene']}: gain over none {shown(whole)} dB, on moving pixels {shown(moving)} dB, floor {gain} dB")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", required=True)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time")
    parser.add_argument("--threads", type=int, default=0, help="threads of each training; 0 takes all cores")
    parser.add_argument("--scene", action="append", default=[], metavar="NAME=PATH", help="a dataset beside the captures")
    parser.add_argument("--with", dest="settings", action="append", default=[], help="another setting: none, auto+FIELD, a preset")
    parser.add_argument("--fields", default="", help="deformers with commas: a setting auto+FIELD each")
    parser.add_argument("--without-auto", action="store_true")
    parser.add_argument("--only", default="", help="names of scenes, with commas")
    parser.add_argument("--set", dest="sets", action="append", default=[], help="handed to every training")
    parser.add_argument("--json", type=pathlib.Path, help="a file for the rows with their plans, the machine and the floors")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    floors = json.loads((pathlib.Path(__file__).parent / "captures.json").read_text())
    scenes = [(name, f"procedural:captures/{name}") for name in CAPTURES] + [tuple(text.split("=", 1)) for text in options.scene]
    if options.only:
        scenes = [scene for scene in scenes if scene[0] in options.only.split(",")]
    settings = [*([] if options.without_auto else ["auto"]), *options.settings, *(f"auto+{field}" for field in options.fields.split(",") if field)]
    settings = list(dict.fromkeys(settings))
    rows, found = Rows(options.out / "rows.json"), machine(options)

    def row_of(name, path, setting, auto):
        stated = {"scene": name, "path": path, "setting": setting} | {key: getattr(options, key) for key in STATED} | {"binary_sha256": sha256(options.bin)}
        if not is_planned(setting):
            trained = auto is not None and auto.result()["exit"] in TRAINED
            stated["wanted_seconds"] = round(auto.result()["seconds"] if trained else 60.0 * options.minutes, 1)
        row = rows.find(stated)
        if row is None:
            row = train(options, stated)
            if is_finished(row):
                rows.keep(row)
        return row

    below, finished = [], []
    print("| scene | setting | PSNR dB | moving pixels | gain over none, dB (moving pixels) | SSIM | Gaussians (moving) | seconds | exit |" + "\n|" + " --- |" * 9)
    with concurrent.futures.ThreadPoolExecutor(max(1, options.jobs)) as pool:
        try:
            started = {}
            for name, path in scenes:
                # Presets come last: they wait for the seconds of `auto`.
                for setting in sorted(settings, key=lambda setting: not is_planned(setting)):
                    started[name, setting] = pool.submit(row_of, name, path, setting, started.get((name, "auto")))
            for name, _ in scenes:
                of_scene = {setting: started[name, setting].result() for setting in settings}
                finished += of_scene.values()
                print("\n".join(printed(row, of_scene.get("none")) for row in of_scene.values()), flush=True)
                if "auto" in of_scene:
                    below += missed(of_scene["auto"], of_scene.get("none"), floors.get(name, {}))
        except KeyboardInterrupt:
            return interrupt(pool)
    if options.json:
        of_scenes = {name: floors[name] for name, _ in scenes if name in floors}
        whole = {key: getattr(options, key) for key in STATED} | {"machine": found, "rows": finished, "floors": of_scenes, "below": below}
        options.json.write_text(json.dumps(whole, indent=1) + "\n")
    failed = [f"{row['scene']} with {row['setting']}, exit code {row['exit']}: {row.get('said')}" for row in finished if not is_finished(row)]
    print("".join(f"failed: {text}\n" for text in failed) + "".join(f"below its floor: {text}\n" for text in below), end="", file=sys.stderr)
    return 1 if below or failed else 0


if __name__ == "__main__":
    sys.exit(main())
