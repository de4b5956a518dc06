#!/usr/bin/env python3
"""Trains the models that codecs are compared on, from the configurations in benches/models, so that sizes measured at different times can be compared.

    benches/reference_models.py --cc4dgs target/release/cc4dgs --data DATA --out runs/reference [NAME...]

DATA is the folder with dnerf_mutant and panoptic_basketball; the built-in scene needs none. A training that was interrupted goes on. Writes OUT/NAME (a run) and
OUT/models.json: program, configuration, Gaussians, seconds, scores of the test views, and the SHA-256 of the model as `raw` stores it. The same program
on the same kind of machine gives the same bytes. The models stay out of the repository. Then, to compare codecs:

    benches/codecs.py --cc4dgs target/release/cc4dgs --out benches/results/DATE-codecs OUT/mutant-12k=mutant-12k:DATA/dnerf_mutant ...
"""
import argparse, hashlib, json, pathlib, subprocess, sys, tempfile, time

SCENES = {"mutant-12k": "dnerf_mutant", "mutant-40k": "dnerf_mutant", "basketball": "panoptic_basketball", "built-in": None}
CONFIGURATIONS = pathlib.Path(__file__).resolve().parent / "models"


def run(*command):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: {done.stderr.strip()}")
    return done.stdout


def model(program, data, out, name):
    folder, configuration = out / name, CONFIGURATIONS / f"{name}.toml"
    scene = data / SCENES[name] if SCENES[name] else "procedural"
    began = time.time()
    common = ["train", "--scene", scene, "--out", folder, "--quiet"]
    finished = (folder / "finished.json").exists()
    if not finished:
        again = (folder / "checkpoint").exists()
        run(program, *common, *(["--resume"] if again else ["--config", configuration, "--overwrite"]))
        (folder / "finished.json").write_text(json.dumps({"seconds": round(time.time() - began, 1), "resumed": again}))
    scores = json.loads(run(program, "eval", folder, "--scene", scene, "--sheet-rows", 0, "--json", "-", "--quiet"))
    with tempfile.TemporaryDirectory() as temporary:
        archive = pathlib.Path(temporary) / "raw.cc4d"
        run(program, "compress", folder, "--codec", "raw", "--field-weights", "fp32", "--out", archive, "--quiet")
        digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    row = {"configuration": f"benches/models/{name}.toml", "scene": SCENES[name] or "procedural", "sha256_of_raw_archive": digest}
    row |= json.loads((folder / "finished.json").read_text())
    return row | {key: scores[key] for key in ("gaussians", "psnr_db", "ssim") if key in scores}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cc4dgs", default="target/release/cc4dgs")
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("names", nargs="*", default=list(SCENES), metavar="NAME")
    args = parser.parse_args()
    unknown = [name for name in args.names if name not in SCENES]
    if unknown:
        parser.error(f"no model is called {', '.join(unknown)}; there are {', '.join(SCENES)}")
    args.out.mkdir(parents=True, exist_ok=True)
    summary = args.out / "models.json"
    found = json.loads(summary.read_text()) if summary.exists() else {"program": run(args.cc4dgs, "--version").strip(), "models": {}}
    commit = subprocess.run(["git", "-C", str(CONFIGURATIONS), "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    found["commit"] = commit
    for name in args.names:
        found["models"][name] = model(args.cc4dgs, args.data, args.out, name)
        summary.write_text(json.dumps(found, indent=1) + "\n")
        print(name, json.dumps(found["models"][name]))


if __name__ == "__main__":
    main()
