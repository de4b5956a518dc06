#!/usr/bin/env python3
"""Sizes, losses and times of codecs: a table of every codec on given models.

    benches/codecs.py --cc4dgs target/release/cc4dgs --out benches/results/NAME [--codecs raw,quantize,...] [--ablation] MODEL=NAME[:SCENE]...

With SCENE, PSNR and SSIM are those of `cc4dgs eval` on the test views, and codecs that make use of the scene are given it. Without, a model is rendered from
an orbit before and after by the example `compare`, which lies beside the program, and PSNR is between the two. Writes NAME.json and NAME.md, which hold
numbers only.

With a scene, `compact` has two rows: `finetune=0` and as it comes. `--ablation` adds rows of `compact`, each with an idea switched off that has an effect on the
model, and a table of them by stream. Without a scene, all of them aim at the same estimated PSNR: compare sizes beside the PSNR.

Seconds are those that `compress` reports: of encoding, with the scene where there is one, and of decoding the file; memory is the most that its process had.
Run it while nothing else does.
"""
import argparse, json, os, pathlib, re, subprocess, sys, tempfile

CODECS = "raw,quantize,sorted-image,spz,vq,cca:low,cca:mid,cca:default,compact"
FRAMES = 12
# The ideas of `compact`, each switched off, and those that have no effect without a scene.
SWITCHES = ["adaptive=false", "measured=false", "transform=false", "shapes=false", "allocate=false", "joint=false", "canonical=false", "rate_weight=1.0"]
NEED_SCENE = {"measured=false", "shapes=false", "allocate=false", "joint=false"}


def run(program, *arguments):
    return measured(program, *arguments)[0]


def measured(program, *arguments):
    """Standard output of a process that must succeed, and the most memory it had, in MB."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = subprocess.Popen([program, *map(str, arguments)], stdout=out, stderr=err)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0), err.seek(0)
        if child.returncode:
            sys.exit(f"{' '.join(map(str, arguments))}: {err.read().decode().strip()}")
        return out.read().decode(), usage.ru_maxrss * 1024 / 1e6


def compare(program):
    """The example that renders two models."""
    return pathlib.Path(program).parent / "examples/compare"


def between(program, model, other):
    return json.loads(run(compare(program), model, other, FRAMES))["psnr_db"]


def measure(program, model, scene, codec, weights, settings, before, folder):
    archive = pathlib.Path(folder) / f"{re.sub('[^a-z0-9]', '-', codec)}.cc4d"
    chosen = [part for s in settings for part in ("--set", s)]
    # `compress` refuses a scene that is of no use: it measures for `compact`, and files of other programs get its background.
    uses_scene = "compact" in {codec.split(":")[0], weights.split(":")[0]} or pathlib.Path(model).suffix in {".ply", ".spz"}
    with_scene = ["--scene", scene] if scene and uses_scene else []
    text, peak_mb = measured(program, "compress", model, "--codec", codec, "--field-weights", weights, "--out", archive, "--overwrite", "--json", "-", *chosen, *with_scene)
    report = json.loads(text)
    row = {
        "codec": " ".join([codec, *settings]),
        "field_weights": weights,
        "gaussians": report["gaussians"],
        "total_mb": report["size_mb"]["total"],
        "gaussians_mb": report["size_mb"]["point_cloud"],
        "field_mb": report["size_mb"]["deform"],
        "bytes_per_gaussian": round(1e6 * report["size_mb"]["point_cloud"] / report["gaussians"], 3),
        "encode_s": round(report["seconds"], 2),
        "decode_s": round(report["decode_seconds"], 3),
        "peak_mb": round(peak_mb),
        "streams": {s["name"]: round(s["stored_bytes"] / report["gaussians"], 3) for s in report["streams"] if s["kind"] == "canonical"},
    }
    if scene:
        found = json.loads(run(program, "eval", archive, "--scene", scene, "--sheet-rows", 0, "--json", "-", "--quiet"))
        row |= {"psnr_db": found["psnr_db"], "ssim": found["ssim"], "drop_db": before["psnr_db"] - found["psnr_db"], "ssim_drop": before["ssim"] - found["ssim"]}
    else:
        row["psnr_between_db"] = between(program, model, archive)
    return row


def table(rows, scene):
    loss = ["drop dB", "SSIM drop"] if scene else ["PSNR between dB"]
    lines = ["| codec | weights | " + " | ".join(loss) + " | bytes per Gaussian | Gaussians MB | total MB | encode s | decode s | peak MB | bytes per Gaussian by stream |", "|" + " --- |" * (9 + len(loss))]
    for r in rows:
        numbers = [f"{r['drop_db']:.3f}", f"{r['ssim_drop']:.4f}"] if scene else [f"{r['psnr_between_db']:.2f}"]
        streams = ", ".join(f"{k} {v:.2f}" for k, v in r["streams"].items() if v >= 0.005)
        lines.append(f"| {r['codec']} | {r['field_weights']} | {' | '.join(numbers)} | {r['bytes_per_gaussian']:.2f} | {r['gaussians_mb']:.4f} | {r['total_mb']:.4f} | {r['encode_s']} | {r['decode_s']} | {r['peak_mb']} | {streams} |")
    return lines


def column(stream):
    """Where a stream of `compact` counts: layers after the first have numbers, and attributes of plug-ins have a stream per value."""
    stream = re.sub(r"^(classes|shapes|moving|log_scales|means|quaternions|opacity_logits|sh\.0)\.\d+$", r"\1", stream)
    return re.sub(r"^(coded|extra)\..*", r"\1", stream)


def by_stream(rows, scene):
    """Bytes per Gaussian of `compact` by stream, a row per idea that is switched off."""
    whole = "compact finetune=0" if scene else "compact"
    names = {"compact": "fine-tuning on", whole: "none"}
    rows = [r for r in rows if r["codec"].split()[0] == "compact"]
    sums = []
    for r in rows:
        sums.append({})
        for stream, size in r["streams"].items():
            sums[-1][column(stream)] = sums[-1].get(column(stream), 0.0) + size
    columns = list(dict.fromkeys(c for of in sums for c in of))
    yield "| without | " + "".join(f"`{c}` | " for c in columns) + "all | encode s | decode s |"
    yield "| --- |" + " ---: |" * (len(columns) + 3)
    for r, of in zip(rows, sums):
        name = names.get(r["codec"], f"`{r['codec'].removeprefix(whole).strip()}`")
        yield f"| {name} | " + "".join(f"{of.get(c, 0.0):.3f} | " for c in columns) + f"{r['bytes_per_gaussian']:.3f} | {r['encode_s']} | {r['decode_s']} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cc4dgs", default="target/release/cc4dgs")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--codecs", default=CODECS)
    parser.add_argument("--weights", default="fp16")
    parser.add_argument("--ablation", action="store_true", help="compact with each of its ideas switched off, and a table by stream")
    parser.add_argument("models", nargs="+", metavar="MODEL=NAME[:SCENE]")
    args = parser.parse_args()
    results, lines = [], []
    for spec in args.models:
        model, name = spec.split("=", 1)
        name, _, scene = name.partition(":")
        if not scene and not compare(args.cc4dgs).exists():
            parser.error(f"{compare(args.cc4dgs)} is not there, which compares renders of a model without SCENE: cargo build --release --workspace --examples")
        with tempfile.TemporaryDirectory() as folder:
            before = None
            if scene:
                before = json.loads(run(args.cc4dgs, "eval", model, "--scene", scene, "--sheet-rows", 0, "--json", "-", "--quiet"))
            # Without a scene there is nothing to fine-tune on.
            untuned = ["finetune=0"] if scene else []
            todo = [(codec, untuned if codec.startswith("compact") else []) for codec in args.codecs.split(",")]
            todo += [(codec, []) for codec in args.codecs.split(",") if scene and codec.startswith("compact")]
            if args.ablation:
                todo += [("compact", untuned)] if ("compact", untuned) not in todo else []
                todo += [("compact", [*untuned, s]) for s in SWITCHES if scene or s not in NEED_SCENE]
            rows = [measure(args.cc4dgs, model, scene, codec, args.weights, settings, before, folder) for codec, settings in todo]
            # Large models have several layers.
            if args.ablation and any("means.1" in row["streams"] for row in rows):
                rows.append(measure(args.cc4dgs, model, scene, "compact", args.weights, [*untuned, "layers=1"], before, folder))
        about = f"{name}: {rows[0]['gaussians']} Gaussians" + (f", {before['psnr_db']:.3f} dB, SSIM {before['ssim']:.4f} on test views" if scene else ", no scene: PSNR between renders")
        results.append({"model": name, "scene": bool(scene), "psnr_db": before["psnr_db"] if scene else None, "rows": rows})
        lines += [f"## {about}", "", *table(rows, scene), ""]
        if args.ablation:
            lines += ["Bytes per Gaussian of `compact` by stream, without one of its ideas:", "", *by_stream(rows, scene), ""]
    args.out.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")
    args.out.with_suffix(".md").write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
