#!/usr/bin/env python3
"""Times the page of the player in Chromium with SwiftShader, and the tile renderer beside it: player.py PAGE [--program cc4dgs] [--native frames] [--case n3dv]
[--gaussians N] [--out FILE].

PAGE is the folder of apps/player/build-web. The model is the synthetic scene of `cc4dgs bench frame`, as large as published scenes: 335,000 Gaussians at 1352x1014, of which
12 % move. With software rendering that takes very long, and may not finish: choose --gaussians 10000 there. Images then have the same share of the case's pixels as the
scene has of its Gaussians. The scene is stored with a playback layer (`--archive`), and page and tile renderer look from the same camera. Prints JSON: bytes of the
bundle (gzipped) and of the archive, milliseconds from the last byte to the first frame, and milliseconds per frame of WebGPU, of WebGL2 and of the tile renderer on the
device `flex`, deformer included; the medians of alternating rounds. Frames of WebGL2 do not wait for the worker that sorts. With --native (the example `frames` of the player), also
those of the renderer of the window on the graphics adapter of this machine. Needs playwright, and Chromium on the path.
"""
import argparse, gzip, json, pathlib, statistics, subprocess, tempfile
from chromium import launch, serve
from playwright.sync_api import sync_playwright

# Gaussians of each case of `cc4dgs bench frame`.
GAUSSIANS = 335000
ROUNDS = 3
FRAMES = 4
LOAD = """async () => {
    const bytes = new Uint8Array(await (await fetch("/model.cc4d")).arrayBuffer());
    const began = performance.now();
    await cc4dgs.load(bytes, "model.cc4d");
    cc4dgs.goTo(0);
    cc4dgs.draw();
    if (cc4dgs.gl) { const g = cc4dgs.gl.gl; g.readPixels(0, 0, 1, 1, g.RGBA, g.UNSIGNED_BYTE, new Uint8Array(4)); } else await cc4dgs.gpu.countVisible();
    return performance.now() - began;
}"""
FRAME = """async frames => {
    const began = performance.now();
    for (let i = 0; i < frames; i++) {
        cc4dgs.gpu.seek(i / frames);
        cc4dgs.draw();
        if (cc4dgs.gl) { const g = cc4dgs.gl.gl; g.readPixels(0, 0, 1, 1, g.RGBA, g.UNSIGNED_BYTE, new Uint8Array(4)); } else await cc4dgs.gpu.countVisible();
    }
    return (performance.now() - began) / frames;
}"""


def synthetic_scene(args, frames, *more):
    """What `cc4dgs bench frame` says of the case."""
    scale = args.scale if args.gaussians is None else repr(args.gaussians / GAUSSIANS)
    command = [args.program, "--quiet", "bench", "frame", "--case", args.case, "--scale", scale, "--motion", "0.05", "--device", "flex"]
    ran = subprocess.run([*command, "--set", f"deformer.kind={args.deformer}", "--frames", str(frames), *more, "--json"], capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout)["cases"][0]


def native(args, archive, size):
    """What the example `frames` says of the archive."""
    ran = subprocess.run([args.native, str(archive), "--size", size, "--frames", str(FRAMES)], capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page"), parser.add_argument("--program", default="cc4dgs"), parser.add_argument("--case", default="n3dv")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--scale", default="1", help="share of the case's pixels and Gaussians")
    size.add_argument("--gaussians", type=int, metavar="N", help="Gaussians, with the same share of the pixels; 335000 by default, and 10000 for software rendering")
    parser.add_argument("--deformer", default="cdf-basis"), parser.add_argument("--native"), parser.add_argument("--out")
    args = parser.parse_args()
    if args.gaussians is not None and not 1 <= args.gaussians <= 100 * GAUSSIANS:
        parser.error(f"--gaussians {args.gaussians} is not from 1 to {100 * GAUSSIANS}")
    folder = tempfile.TemporaryDirectory()
    archive = pathlib.Path(folder.name) / "scene.cc4d"
    case = synthetic_scene(args, 1, "--archive", str(archive))
    width, height = case["width"], case["height"]
    address, archive_bytes = serve(args.page, archive, "model.cc4d")
    files = [f for f in pathlib.Path(args.page).iterdir() if f.suffix in (".wasm", ".js", ".css", ".html")]
    out = {"size": f"{width}x{height}", "case": args.case, "deformer": args.deformer, "archive_bytes": archive_bytes}
    out["bundle_gzip_bytes"] = sum(len(gzip.compress(f.read_bytes(), 9)) for f in files)
    times = {"webgpu": [], "webgl2": [], "tile": []}
    with sync_playwright() as play:
        browser = launch(play)
        out["browser"] = browser.version
        pages = {}
        for name, query in (("webgpu", ""), ("webgl2", "?backend=webgl")):
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(600000)
            page.goto(f"{address}/index.html{query}")
            page.wait_for_function("window.cc4dgs !== undefined")
            out[f"{name}_first_frame_ms"] = round(page.evaluate(LOAD), 1)
            facts = page.evaluate("cc4dgs.facts")
            pages[name] = page
        out |= {"gaussians": facts["gaussians"], "moving": facts["moving"]}
        out["canvas"] = pages["webgpu"].evaluate("`${cc4dgs.ui.canvas.width}x${cc4dgs.ui.canvas.height}`")
        for _ in range(ROUNDS):
            for name, page in pages.items():
                page.bring_to_front()
                times[name].append(page.evaluate(FRAME, FRAMES))
            case = synthetic_scene(args, FRAMES)
            times["tile"].append(case["field"]["median_ms"] + case["raster"]["median_ms"])
            if args.native:
                found = native(args, archive, out["size"])
                times.setdefault("native", []).append(found["median_ms"])
                out |= {"native_adapter": f"{found['adapter']}, {found['driver']}", "native_first_frame_ms": round(found["first_frame_ms"], 1)}
                out["native_frames_per_second"] = round(found["frames_per_second"], 2)
        browser.close()
    medians = {name: statistics.median(values) for name, values in times.items()}
    out |= {"frame_ms": {name: round(value, 1) for name, value in medians.items()}, "rounds": times}
    out["tile_over_player"] = {name: round(medians["tile"] / medians[name], 2) for name in times if name != "tile"}
    text = json.dumps(out, indent=1)
    print(text)
    if args.out:
        pathlib.Path(args.out).write_text(text + "\n")


if __name__ == "__main__":
    main()
