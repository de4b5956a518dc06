#!/usr/bin/env python3
"""Bytes, seconds and memory of every codec on a PLY file, repeated to a larger model. Each codec is encoded and decoded alone, each in a process of its own.

    benches/codec_speed.py OUT.json --ply FILE.ply [--copies 11] [--example target/release/examples/codec_speed] [--codecs raw,quantize,...] [--threads N]
                           [--limit SECONDS] [--limits sorted-image=SECONDS,vq=SECONDS] [--weights ARCHIVE.cc4d ...]

Needs the built example: cargo build --release -p cc4dgs-codecs --example codec_speed. There is no scene, so that `compact` aims at 50 dB. Seconds are of encoding
without Zstandard, median and least of --encodes (fewer where a minute is over before), and of decoding, of --decodes. Memory is the most that a process had, in
MB, the program and what it had read included: before and after encoding, and where it decodes once and has done nothing else. A codec that takes longer than its
limit has a row that says so.

--weights names archives whose deformer's weights are decoded, --decodes times each, Zstandard included: one model that `cc4dgs compress` stored with one
--field-weights after another. Run it while nothing else does. Writes OUT.json and prints tables.
"""
import argparse, hashlib, json, os, pathlib, subprocess, sys, tempfile

CODECS = "raw,quantize,sorted-image,spz,vq,cca:low,cca:mid,cca:default,compact"


def run(args, limit, folder, *arguments):
    """The document that the example writes; `None` if it takes more than `limit` seconds."""
    out = folder / "out.json"
    environment = os.environ | {"ENCODES": str(args.encodes), "DECODES": str(args.decodes), "ARCHIVES": str(folder)}
    if args.threads:
        environment["RAYON_NUM_THREADS"] = str(args.threads)
    environment.pop("DECODED", None)
    try:
        ran = subprocess.run([args.example, *map(str, arguments), "--json", out], env=environment, timeout=limit, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    except subprocess.TimeoutExpired:
        return None
    if ran.returncode:
        sys.exit(f"{' '.join(map(str, arguments))}: {ran.stderr.strip()}")
    return json.loads(out.read_text())


def measure(args, codec, limit):
    """The row of a codec, and what is said of the machine."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        encoded = run(args, limit, folder, args.ply, args.copies, codec)
        if encoded is None:
            return {"codec": codec, "over_the_limit_s": limit}, {}
        row = encoded.pop("rows")[0]
        decoded = run(args, limit, folder, next(folder.glob("*.cc4d")), codec)
        alone = decoded["rows"][0] if decoded else {"over_the_limit_s": limit}
        assert alone.get("gaussians", row["gaussians"]) == row["gaussians"], codec
        # Read from the file, and decoded for the first time.
        names = {"decode_s": "decode_alone_s", "peak_mb": "decode_alone_peak_mb", "over_the_limit_s": "over_the_limit_s"}
        return row | {new: alone[old] for old, new in names.items() if old in alone}, encoded


def table(heading, left_aligned, rows, cells):
    """Lines of a table whose first cell is a name; `cells` gives those of a row that kept to its limit."""
    columns = heading.count("|") - 1
    yield heading
    yield "|" + " --- |" * left_aligned + " ---: |" * (columns - left_aligned)
    for name, r in rows:
        own = cells(r) if "bytes" in r else [f"over the limit of {r['over_the_limit_s']:g} s"] + [""] * (columns - 2)
        yield "| " + " | ".join([name, *own]) + " |"


def codec_cells(r):
    peaks = [str(r.get(key, "over the limit")) for key in ("loaded_peak_mb", "encode_peak_mb", "decode_alone_peak_mb")]
    encode = f"{r['encode_median_s']:.2f} ({r['encode_least_s']:.2f})"
    decode = f"{r['decode_median_s']:.3f} ({r['decode_least_s']:.3f})"
    mb = [f"{r[key] / 1e6:.3f}" for key in ("bytes", "decoded_bytes")]
    return [f"{r['bytes_per_gaussian']:.2f}", *mb, encode, decode, f"{r['decode_cpu_least_s']:.3f}", *peaks]


def weight_cells(r):
    decode = f"{1e3 * r['decode_median_s']:.2f} ({1e3 * r['decode_least_s']:.2f})"
    return [f"`{r['deformer']}`", f"`{r['plugin']['name']}`", str(r["values"]), f"{r['bytes'] / 1e6:.4f}", decode, f"{1e3 * r['decode_cpu_least_s']:.2f}", str(r["peak_mb"])]


CODEC_HEADING = "| codec | bytes per Gaussian | MB | decoded MB | encode s, median (least) | decode s, median (least) | of processor s | peak MB: loaded | encoding | decoding alone |"
WEIGHT_HEADING = "| archive | deformer | weights | values | MB | decode ms, median (least) | of processor ms | peak MB |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path, metavar="OUT.json")
    parser.add_argument("--ply", type=pathlib.Path, required=True)
    parser.add_argument("--copies", type=int, default=11)
    parser.add_argument("--example", type=pathlib.Path, default=pathlib.Path("target/release/examples/codec_speed"))
    parser.add_argument("--codecs", default=CODECS)
    parser.add_argument("--encodes", type=int, default=3)
    parser.add_argument("--decodes", type=int, default=9)
    parser.add_argument("--threads", type=int, help="threads of the example; all processors by default")
    parser.add_argument("--limit", type=float, default=600, help="seconds that a process may take")
    parser.add_argument("--limits", default="", help="the same for some codecs: sorted-image=1800,vq=1800")
    parser.add_argument("--weights", nargs="+", default=[], type=pathlib.Path, metavar="ARCHIVE.cc4d", help="archives whose deformer's weights are decoded, too")
    args = parser.parse_args()
    if not args.example.exists():
        parser.error(f"{args.example} is not there; build it, or name it with --example")
    args.example = args.example.resolve()
    limits = {codec: float(seconds) for codec, seconds in (pair.rsplit("=", 1) for pair in args.limits.split(",") if pair)}
    commit = subprocess.run(["git", "-C", str(pathlib.Path(__file__).parent), "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    # The commit is that of the repository; the example may be older.
    digest = hashlib.sha256(args.example.read_bytes()).hexdigest()
    found = {"ply": args.ply.name, "copies": args.copies, "commit": commit, "example_sha256": digest, "rows": [], "weights": []}
    for codec in args.codecs.split(","):
        row, machine = measure(args, codec, limits.get(codec, args.limit))
        found = {**machine, **found, "rows": [*found["rows"], row]}
        # After each row, so that an interruption keeps the finished ones.
        args.out.write_text(json.dumps(found, indent=1) + "\n")
        print(json.dumps(row), file=sys.stderr)
    for archive in args.weights:
        with tempfile.TemporaryDirectory() as name:
            decoded = run(args, args.limit, pathlib.Path(name), archive)
        row = decoded["rows"][0] if decoded else {"over_the_limit_s": args.limit}
        found["weights"].append({"archive": archive.name} | row)
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    print("\n".join(table(CODEC_HEADING, 1, [(f"`{r['codec']}`", r) for r in found["rows"]], codec_cells)))
    if found["weights"]:
        print("\n".join(["", *table(WEIGHT_HEADING, 3, [(r["archive"], r) for r in found["weights"]], weight_cells)]))


if __name__ == "__main__":
    main()
