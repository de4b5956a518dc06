#!/usr/bin/env python3
"""Has viewers of others draw exported files in Chromium with SwiftShader: exports_draw.py MODEL REFERENCE OUT [--program cc4dgs].

REFERENCE is the folder that `cargo run --release -p cc4dgs-player --example reference -- MODEL REFERENCE` wrote: cameras, times, and the images of the tile renderer.
gsplat.js draws splatV at all times; Spark (on three.js) draws PLY and SPZ of one instant. Each gets the cameras of the reference. Prints PSNR against the tile
renderer and writes what was drawn, beside the reference, to OUT as PNG files. Packages come from npm into OUT/tools, or into the folder that CC4DGS_TOOLS names.
Needs playwright, Pillow, numpy, node with npm, and Chromium on the path. Ends with 1 where a viewer draws nothing, or hardly what the model looks like.
"""
import argparse, functools, http.server, io, json, os, pathlib, subprocess, sys, threading
import numpy
from chromium import launch
from PIL import Image
from playwright.sync_api import sync_playwright

PACKAGES = {"gsplat": "1.2.9", "@sparkjsdev/spark": "2.2.0", "three": "0.187.0"}
# Below this a viewer draws something else: an empty image of the demo is 10 to 15 dB from the model's.
LEAST_DB = 20
# Viewers sort in workers: an image counts once two in a row are the same.
PAUSE_MS, PATIENCE = 700, 60

GSPLAT = """
import * as SPLAT from "/node_modules/gsplat/dist/index.es.js";
window.draw = async ({ file, camera, time, background }) => {
    document.body.innerHTML = '<canvas style="display:block"></canvas>';
    const canvas = document.querySelector("canvas");
    Object.assign(canvas.style, { width: camera.width + "px", height: camera.height + "px" });
    // The program takes its time from the clock: (1 + sin(seconds)) / 2.
    Date.now = () => 1000 * Math.asin(2 * time - 1);
    const renderer = new SPLAT.WebGLRenderer(canvas, []);
    renderer.addProgram(new SPLAT.VideoRenderProgram(renderer));
    renderer.backgroundColor = new SPLAT.Color32(...background, 255);
    renderer.setSize(camera.width, camera.height);
    const scene = new SPLAT.Scene(), view = new SPLAT.Camera();
    await SPLAT.SplatvLoader.LoadAsync(file, scene, view, () => {});
    [view.data.fx, view.data.fy] = [camera.fx, camera.fy];
    const w = camera.world_to_camera;
    const columns = [0, 1, 2, 3].flatMap(c => [0, 1, 2, 3].map(r => w[r][c]));
    view.update = () => { view.data._viewMatrix = new SPLAT.Matrix4(...columns); view.data.setSize(camera.width, camera.height); };
    const frame = () => { if (canvas.isConnected) { view.update(); renderer.render(scene, view); requestAnimationFrame(frame); } };
    frame();
};
window.ready = true;
"""
SPARK = """
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
window.draw = async ({ file, camera, background, turned }) => {
    document.body.innerHTML = "";
    const renderer = new THREE.WebGLRenderer({ antialias: false });
    renderer.setPixelRatio(1);
    renderer.setSize(camera.width, camera.height);
    renderer.setClearColor(new THREE.Color().setRGB(...background.map(v => v / 255), THREE.SRGBColorSpace), 1);
    document.body.append(renderer.domElement);
    const scene = new THREE.Scene();
    // Trained without antialiasing, so the blur of a pixel costs no opacity.
    scene.add(new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false }));
    const mesh = new SplatMesh({ url: file });
    // SPZ files are right, up, back; the dataset is turned by 180 degrees about x.
    if (turned) mesh.quaternion.set(1, 0, 0, 0);
    scene.add(mesh);
    await mesh.initialized;
    const view = new THREE.PerspectiveCamera(2 * Math.atan(camera.height / 2 / camera.fy) * 180 / Math.PI, camera.width / camera.height, 0.01, 1000);
    const world = new THREE.Matrix4().set(...camera.world_to_camera.flat()).invert().multiply(new THREE.Matrix4().makeScale(1, -1, -1));
    world.decompose(view.position, view.quaternion, view.scale);
    view.scale.set(1, 1, 1);
    renderer.setAnimationLoop(() => renderer.render(scene, view));
};
window.ready = true;
"""
PAGE = """<!doctype html><meta charset="utf-8"><style>body { margin: 0 }</style>
<script type="importmap">{ "imports": { "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/",
"@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.min.js" } }</script><script type="module">%s</script>"""


def psnr_db(a, b):
    squares = numpy.mean((a.astype(float) - b.astype(float)) ** 2)
    return float("inf") if squares == 0 else 10 * numpy.log10(255**2 / squares)


def of_dataset(camera, normalisation):
    """`camera`, which sees the model in its own coordinates, for files in those of the dataset: the model is scale x + translation."""
    scale, shift = normalisation["scale"], normalisation["translation"]
    rows = [[*row[:3], (row[3] + sum(a * b for a, b in zip(row, shift))) / scale] for row in camera["world_to_camera"][:3]]
    return {**camera, "world_to_camera": [*rows, [0, 0, 0, 1]]}


def drawn(page, size):
    """The image once it does not change any more, and is not of one colour."""
    before = None
    for _ in range(PATIENCE):
        page.wait_for_timeout(PAUSE_MS)
        image = Image.open(io.BytesIO(page.screenshot(clip={"x": 0, "y": 0, "width": size[0], "height": size[1]}, timeout=180000))).convert("RGB")
        pixels = numpy.asarray(image)
        if before is not None and (before == pixels).all() and pixels.std(axis=(0, 1)).max() > 1:
            return image
        before = pixels
    raise SystemExit("nothing is drawn, or it never stands still")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model"), parser.add_argument("reference"), parser.add_argument("out"), parser.add_argument("--program", default="cc4dgs")
    args = parser.parse_args()
    out = pathlib.Path(args.out)
    tools = pathlib.Path(os.environ.get("CC4DGS_TOOLS", out / "tools"))
    for folder in (out, tools):
        folder.mkdir(parents=True, exist_ok=True)
    if not all((tools / "node_modules" / name).is_dir() for name in PACKAGES):
        subprocess.run(["npm", "install", "--silent", "--prefix", tools, *(f"{n}@{v}" for n, v in PACKAGES.items())], check=True)
    for name, version in PACKAGES.items():
        found = json.loads((tools / "node_modules" / name / "package.json").read_text())["version"]
        assert found == version, f"{tools} has {name} {found}, not {version}"
    entries = json.loads((pathlib.Path(args.reference) / "reference.json").read_text())
    told = subprocess.run([args.program, "--quiet", "info", args.model, "--json"], capture_output=True, text=True, check=True)
    normalisation = json.loads(told.stdout)["manifest"]["normalisation"]
    instant = sorted({e["time"] for e in entries})[1]
    described = subprocess.run([args.program, "export", "splatv", args.model, "--out", out / "model.splatv", "--overwrite", "--device", "flex"], capture_output=True, text=True, check=True)
    print(described.stdout.strip(), described.stderr.strip().splitlines()[-1:])
    # Spark reads SPZ up to version 3: version 4 is no gzip file any more.
    for format, more in (("ply", ()), ("spz", ("--set", "version=3"))):
        command = [args.program, "--quiet", "export", format, args.model, "--out", out / f"model.{format}", "--time", str(instant), "--overwrite", "--device", "flex"]
        subprocess.run([*command, *more], check=True)

    class Handler(http.server.SimpleHTTPRequestHandler):
        extensions_map = {**http.server.SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript", ".wasm": "application/wasm"}

        def translate_path(self, path):
            path = path.split("?")[0].lstrip("/")
            return str((tools if path.startswith("node_modules/") else out) / path)

        def log_message(self, *_):
            pass

    for name, script in (("gsplat", GSPLAT), ("spark", SPARK)):
        (out / f"{name}.html").write_text(PAGE % script)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    failed = False
    with sync_playwright() as play:
        browser = launch(play)
        print(f"Chromium {browser.version}")
        for viewer, file in (("gsplat", "model.splatv"), ("spark", "model.ply"), ("spark", "model.spz")):
            scores = []
            for entry in entries:
                if viewer == "spark" and entry["time"] != instant:
                    continue
                camera = of_dataset(entry["camera"], normalisation)
                wanted = Image.open(pathlib.Path(args.reference) / entry["image"]).convert("RGB")
                page = browser.new_page(viewport={"width": camera["width"], "height": camera["height"]})
                page.on("console", lambda m: print("   console:", m.text[:200]) if m.type == "error" and "favicon" not in m.location.get("url", "") else None)
                page.on("pageerror", lambda e: print("   page:", str(e)[:200]))
                page.goto(f"http://127.0.0.1:{server.server_port}/{viewer}.html")
                page.wait_for_function("window.ready", timeout=180000)
                # The corner of the reference is background in an orbit round the whole model.
                options = {"file": "/" + file, "camera": camera, "time": entry["time"], "background": list(wanted.getpixel((0, 0))), "turned": file.endswith("spz")}
                page.evaluate("options => draw(options).then(() => 0)", options)
                image = drawn(page, (camera["width"], camera["height"]))
                page.close()
                both = Image.new("RGB", (2 * image.width, image.height))
                both.paste(wanted, (0, 0)), both.paste(image, (image.width, 0))
                both.save(out / f"{viewer}_{file.split('.')[1]}_{entry['image']}")
                scores.append(psnr_db(numpy.asarray(wanted), numpy.asarray(image)))
            package = {"gsplat": "gsplat", "spark": "@sparkjsdev/spark"}[viewer]
            print(f"{package} {PACKAGES[package]} draws {file}: " + ", ".join(f"{s:.1f}" for s in scores) + " dB from the tile renderer", flush=True)
            failed |= min(scores) < LEAST_DB
        browser.close()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
