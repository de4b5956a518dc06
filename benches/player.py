#!/usr/bin/env python3
"""Times the page of the player in Chromium with SwiftShader, and the tile renderer beside it: player.py PAGE ARCHIVE --scene SCENE [--program cc4dgs] [--size 1352x1014] [--out FILE].

PAGE is the folder of apps/player/build-web, ARCHIVE an archive that was baked with its deformer and --scene SCENE, a built-in scene. Prints JSON: bytes of the bundle (gzipped) and of what a player fetches, milliseconds from the
last byte to the first frame, and milliseconds per frame of WebGPU, of WebGL2 and of the tile renderer on the device `flex` (`cc4dgs bench play`), the medians of
alternating rounds. Needs playwright, and Chromium on the path.
"""
import argparse, gzip, json, pathlib, statistics, subprocess
from chromium import launch, serve
from playwright.sync_api import sync_playwright

ROUNDS = 3
FRAMES = 4
LOAD = """async () => {
    const bytes = new Uint8Array(await (await fetch("/model.cc4d")).arrayBuffer());
    const began = performance.now();
    await cc4dgs.load(bytes, "model.cc4d");
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


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("page"), parser.add_argument("archive")
    parser.add_argument("--scene", required=True), parser.add_argument("--program", default="cc4dgs"), parser.add_argument("--size", default="1352x1014"), parser.add_argument("--out")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    address, archive_bytes = serve(args.page, args.archive, "model.cc4d")
    files = [f for f in pathlib.Path(args.page).iterdir() if f.suffix in (".wasm", ".js", ".css", ".html")]
    out = {"size": args.size, "archive_bytes": archive_bytes, "bundle_gzip_bytes": sum(len(gzip.compress(f.read_bytes(), 9)) for f in files)}
    times = {"webgpu": [], "webgl2": [], "tile": []}
    with sync_playwright() as play:
        browser = launch(play)
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
                times[name].append(page.evaluate(FRAME, FRAMES))
            sets = [word for each in (f"scene.width={width}", f"scene.height={height}") for word in ("--set", each)]
            command = [args.program, "--quiet", "bench", "play", args.archive, "--scene", args.scene, *sets, "--frames", str(FRAMES), "--device", "flex", "--json"]
            ran = subprocess.run(command, capture_output=True, text=True)
            if ran.returncode:
                raise SystemExit(ran.stderr)
            report = json.loads(ran.stdout)
            times["tile"].append(report["field"]["median_ms"] + report["raster"]["median_ms"])
        browser.close()
    medians = {name: statistics.median(values) for name, values in times.items()}
    out |= {"frame_ms": {name: round(value, 1) for name, value in medians.items()}, "rounds": times}
    out["tile_over_player"] = {name: round(medians["tile"] / medians[name], 2) for name in pages}
    text = json.dumps(out, indent=1)
    print(text)
    if args.out:
        pathlib.Path(args.out).write_text(text + "\n")


if __name__ == "__main__":
    main()
