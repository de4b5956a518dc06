#!/usr/bin/env python3
"""Trains the models that codecs are compared on, from the configurations in benches/models, so that sizes measured at different times can be compared.

    benches/reference_models.py --cc4dgs target/release/cc4dgs --data DATA --out runs/reference [NAME...]

DATA is the folder with dnerf_mutant and panoptic_basketball; the built-in scene needs none. A training that was interrupted goes on. A model of another program, of
another configuration or of data elsewhere is neither trained on nor scored: it ends with 1. Writes OUT/NAME (a run; begun.json says what trained it) and
OUT/models.json: program and commit of the repository when it began, configuration, Gaussians, seconds, scores of the test views, and the SHA-256 of the model as `raw`
stores it. The same program on the same kind of machine gives the same bytes. The models stay out of the repository. Then, to compare codecs:

    benches/codecs.py --cc4dgs target/release/cc4dgs --out benches/results/DATE-codecs OUT/mutant-12k=mutant-12k:DATA/dnerf_mutant ...
"""
import argparse, hashlib, json, pathlib, subprocess, sys, tempfile, time
from trainings import begin, ended, replace, sha256, trained

SCENES = {"mutant-12k": "dnerf_mutant", "mutant-24k": "dnerf_mutant", "mutant-40k": "dnerf_mutant", "basketball": "panoptic_basketball", "built-in": None}
CONFIGURATIONS = pathlib.Path(__file__).resolve().parent / "models"


def run(*command):
    """Standard output of a process that must succeed."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        code = ended(begin([str(part) for part in command], stdout=out, stderr=err))
        out.seek(0), err.seek(0)
        if code:
            sys.exit(f"{' '.join(map(str, command))}: {err.read().strip() or f'exit code {code}'}")
        return out.read()


def started(program, folder, stated):
    """What the model in `folder` is trained from, written if it is new; the call ends if it was begun from anything else."""
    file = folder / "begun.json"
    if any((folder / name).exists() for name in ("checkpoint", "finished.json")):
        found = json.loads(file.read_text()) if file.exists() else {}
        if not stated.items() <= found.items():
            sys.exit(f"{folder} holds a model of another program, configuration or data folder. Name another --out, or delete it")
        return found
    commit = subprocess.run(["git", "-C", str(CONFIGURATIONS), "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    folder.mkdir(parents=True, exist_ok=True)
    replace(file, {"program": run(program, "--version").strip(), "commit": commit, **stated})
    return json.loads(file.read_text())


def model(program, data, out, name):
    folder, configuration = out / name, CONFIGURATIONS / f"{name}.toml"
    scene = data / SCENES[name] if SCENES[name] else "procedural"
    digest = hashlib.sha256(configuration.read_bytes()).hexdigest()
    stated = {"binary_sha256": sha256(program), "configuration_sha256": digest, "path": str(scene.resolve() if SCENES[name] else scene)}
    known = started(program, folder, stated)
    began = time.time()
    common = ["train", "--scene", scene, "--out", folder, "--quiet"]
    finished = (folder / "finished.json").exists()
    if not finished:
        again = (folder / "checkpoint").exists()
        before = trained(folder) if again else 0.0
        run(program, *common, *(["--resume"] if again else ["--config", configuration, "--overwrite"]))
        replace(folder / "finished.json", {"seconds": round(before + time.time() - began, 1), "resumed": again})
    scores = json.loads(run(program, "eval", folder, "--scene", scene, "--sheet-rows", 0, "--json", "-", "--quiet"))
    with tempfile.TemporaryDirectory() as temporary:
        archive = pathlib.Path(temporary) / "raw.cc4d"
        run(program, "compress", folder, "--codec", "raw", "--field-weights", "fp32", "--out", archive, "--quiet")
        digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    row = {key: known[key] for key in ("program", "commit", "binary_sha256", "configuration_sha256")}
    row |= {"configuration": f"benches/models/{name}.toml", "scene": SCENES[name] or "procedural", "sha256_of_raw_archive": digest}
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
    found = json.loads(summary.read_text()) if summary.exists() else {"models": {}}
    for name in args.names:
        found["models"][name] = model(args.cc4dgs, args.data, args.out, name)
        replace(summary, found)
        print(name, json.dumps(found["models"][name]))


if __name__ == "__main__":
    main()
