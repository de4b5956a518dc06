"""Drives the page in Chromium: browser.py PAGE ARCHIVE REFERENCE [--single FILE.html] [--screenshots FOLDER].

PAGE is the folder of build-web, ARCHIVE a baked archive, REFERENCE the folder that the example `reference` wrote for it. --single is a file of
`cc4dgs export web` of the same archive: it is opened from disk, without a network. Chromium renders with SwiftShader, so no
graphics card is needed. Needs playwright, Pillow and numpy, and Chromium on the path. Ends with a sentence per check; fails at the first that does not hold.
"""
import argparse, functools, http.server, io, json, os, pathlib, re, shutil, threading, time
import numpy
from PIL import Image
from playwright.sync_api import sync_playwright

FLAGS = ("--enable-unsafe-webgpu --enable-features=Vulkan --use-vulkan=swiftshader --use-angle=swiftshader "
         "--enable-unsafe-swiftshader --ignore-gpu-blocklist --no-sandbox").split()
LEAST_DB = 40.0
MODEL = "/model.cc4d"
# A frame of a real scene takes seconds in software.
PATIENCE_MS = 180000


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the page and the archive, with ranges or without, whole or damaged."""
    protocol_version = "HTTP/1.1"
    requests = []

    def do_GET(self):
        path = self.path.split("?")[0]
        if not path.endswith(".cc4d"):
            return super().do_GET()
        body = self.archives.get(path)
        if body is None:
            return self.send_error(404)
        wanted = self.headers.get("Range")
        Handler.requests.append((path, wanted))
        if wanted and "plain" not in path:
            first, last = re.fullmatch(r"bytes=(\d+)-(\d+)", wanted).groups()
            part = body[int(first):int(last) + 1]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{int(first) + len(part) - 1}/{len(body)}")
        else:
            part = body
            self.send_response(200)
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        step = max(1, len(part) // 20) if "slow" in path else max(1, len(part))
        for at in range(0, len(part), step):
            try:
                self.wfile.write(part[at:at + step])
                self.wfile.flush()
            except (BrokenPipeError, ConnectionResetError):
                return
            if "slow" in path:
                time.sleep(0.3)

    def log_message(self, *_):
        pass


def psnr(a, b):
    error = numpy.mean((a.astype(float) - b.astype(float)) ** 2)
    return 99.0 if error == 0 else 10 * numpy.log10(255 ** 2 / error)


def say(text):
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("page"), parser.add_argument("archive"), parser.add_argument("reference")
    parser.add_argument("--single"), parser.add_argument("--screenshots")
    args = parser.parse_args()
    archive = pathlib.Path(args.archive).read_bytes()
    damaged = bytearray(archive)
    damaged[len(archive) // 3] ^= 0x55
    hostile = archive[:12] + (0xFFFFFFF0).to_bytes(4, "little") + archive[16:]
    Handler.archives = {MODEL: archive, "/plain.cc4d": archive, "/slow.cc4d": archive, "/damaged.cc4d": bytes(damaged), "/hostile.cc4d": hostile,
                        "/cut.cc4d": archive[:len(archive) // 2], "/text.cc4d": b"this is no model at all" * 9}
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=args.page))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/index.html"

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS, headless=True)
        complaints = []

        def open_page(query="", size=(1280, 800)):
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
            page.set_default_timeout(PATIENCE_MS)
            page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
            page.on("pageerror", lambda e: complaints.append(str(e)))
            page.goto(address + query)
            page.wait_for_function("window.cc4dgs !== undefined", timeout=PATIENCE_MS)
            return page

        def shot(page, name):
            if args.screenshots:
                os.makedirs(args.screenshots, exist_ok=True)
                page.wait_for_timeout(400)
                page.screenshot(path=os.path.join(args.screenshots, name + ".png"))

        def quiet(what):
            assert not complaints, f"{what}: the console says {complaints}"

        def agree(page, what):
            least = 99.0
            for entry in json.loads((pathlib.Path(args.reference) / "reference.json").read_text()):
                wanted = numpy.asarray(Image.open(pathlib.Path(args.reference) / entry["image"]).convert("RGB"))
                found = page.evaluate("async ([camera, time]) => { const p = await cc4dgs.picture(camera, time); return [p.width, p.height, Array.from(p.data)]; }",
                                      [entry["camera"], entry["time"]])
                image = numpy.array(found[2], numpy.uint8).reshape(found[1], found[0], 4)[..., :3]
                decibels = psnr(image, wanted)
                least = min(least, decibels)
                assert decibels >= LEAST_DB, f"{what}, {entry['image']}: {decibels:.1f} dB"
            say(f"{what}: pixels agree with the tile renderer, at least {least:.1f} dB over 3 times and 2 cameras")

        # Loads, and agrees with the tile renderer.
        began = time.time()
        page = open_page(f"?src={MODEL}")
        facts = page.evaluate("cc4dgs.facts")
        assert facts and facts["gaussians"] > 0 and facts["frames"] > 1, facts
        say(f"loaded {facts['gaussians']} Gaussians, {facts['moving']} of them moving, {facts['frames']} frames, {time.time() - began:.1f} s after opening the page")
        assert any(r and r.startswith("bytes=") for _, r in Handler.requests)
        agree(page, "WebGPU")

        # Plays, pauses, seeks, steps.
        page.evaluate("cc4dgs.seek(0); window.times = []; cc4dgs.on('time', e => times.push(e.time)); cc4dgs.play()")
        page.wait_for_function("times.length > 3", timeout=PATIENCE_MS)
        page.evaluate("cc4dgs.pause()")
        # A short sequence may have begun again.
        assert page.evaluate("new Set(times).size === times.length")
        rates = page.evaluate("""async () => { const g = cc4dgs.gpu; const n = 5, began = performance.now();
            for (let i = 0; i < n; i++) { cc4dgs.seek(i / n); cc4dgs.draw(); await g.countVisible(); } return (performance.now() - began) / n; }""")
        say(f"plays; {rates:.1f} ms per frame at {page.evaluate('cc4dgs.ui.canvas.width')}x{page.evaluate('cc4dgs.ui.canvas.height')} on SwiftShader")
        page.get_by_label("Time", exact=True).fill("0.5")
        assert abs(page.evaluate("cc4dgs.time") - 0.5) < 1e-3
        page.locator("canvas").focus()
        page.keyboard.press(".")
        assert page.evaluate("cc4dgs.time") > 0.5 and not page.evaluate("cc4dgs.playing")
        page.keyboard.press(" ")
        assert page.evaluate("cc4dgs.playing")
        page.keyboard.press(" ")
        say("the slider, single steps and the keyboard work")

        # Gestures, reset, links.
        pose = page.evaluate("Array.from(cc4dgs.gpu.pose)")
        # Where a frame takes seconds, the wheel is heard of later than the next key.
        page.evaluate("window.wheeled = new Promise(r => cc4dgs.ui.canvas.addEventListener('wheel', r, { once: true })).then(() => 0); 0")
        page.mouse.move(600, 300), page.mouse.down(), page.mouse.move(700, 340, steps=4), page.mouse.up(), page.mouse.wheel(0, -300)
        page.evaluate("wheeled")
        moved = page.evaluate("Array.from(cc4dgs.gpu.pose)")
        assert max(abs(a - b) for a, b in zip(pose, moved)) > 0.05
        link = page.evaluate("cc4dgs.link()")
        page.keyboard.press("r")
        assert max(abs(a - b) for a, b in zip(pose, page.evaluate("Array.from(cc4dgs.gpu.pose)"))) < 1e-6
        other = open_page("?" + link.split("?", 1)[1])
        assert max(abs(a - b) for a, b in zip(moved, other.evaluate("Array.from(cc4dgs.gpu.pose)"))) < 1e-3
        assert abs(other.evaluate("cc4dgs.time") - page.evaluate("cc4dgs.time")) < 1e-4
        other.close()
        say("dragging orbits, the wheel zooms, R resets, a shared link restores time and pose")

        # WebGL2, where there is no WebGPU.
        plain = open_page(f"?src={MODEL}&backend=webgl")
        assert plain.evaluate("!!cc4dgs.gl && cc4dgs.facts.gaussians") == facts["gaussians"]
        agree(plain, "WebGL2")
        plain.evaluate("cc4dgs.play()")
        plain.wait_for_timeout(500)
        assert plain.evaluate("cc4dgs.time") > 0
        plain.evaluate("cc4dgs.pause()")
        shot(plain, "laptop_webgl")
        plain.evaluate("""() => { window.recovered = new Promise(r => cc4dgs.on('recovered', r)); const e = cc4dgs.gl.gl.getExtension('WEBGL_lose_context');
            e.loseContext(); setTimeout(() => e.restoreContext(), 200); }""")
        plain.evaluate("recovered")
        agree(plain, "WebGL2 after a lost context")
        plain.close()
        quiet("WebGL2")

        # A lost device comes back with the model, at the same time.
        before = page.evaluate("cc4dgs.time")
        page.evaluate("window.recovered = new Promise(r => cc4dgs.on('recovered', r)); cc4dgs.gpu.loseDevice()")
        page.evaluate("recovered")
        assert page.evaluate("cc4dgs.facts.gaussians") == facts["gaussians"] and abs(page.evaluate("cc4dgs.time") - before) < 1e-6
        assert page.evaluate("cc4dgs.picture().then(p => p.data.some(v => v > 60 && v < 255))")
        say("a lost device is recovered")
        page.get_by_label("Settings").first.click()
        page.wait_for_function("document.querySelector('.stats').textContent.includes('Gaussians')", timeout=PATIENCE_MS)
        shot(page, "laptop_settings")
        page.get_by_label("Tint what moves").check(), page.get_by_label("Depth").check()
        shot(page, "laptop_depth")
        page.get_by_label("Depth").uncheck()
        shot(page, "laptop_tint")
        page.get_by_label("Tint what moves").uncheck()
        page.keyboard.press("Escape")
        shot(page, "laptop")
        quiet("use of the page")

        # Without ranges, and slowly: the base is there before the motion.
        for name in ("plain", "slow"):
            page.evaluate("window.steps = []; cc4dgs.on('progress', e => steps.push([e.bytes, cc4dgs.facts?.frames ?? 0])); 0")
            loaded = page.evaluate(f"cc4dgs.load('/{name}.cc4d')")
            assert loaded["frames"] == facts["frames"], loaded
        fetched = page.evaluate("cc4dgs.received")
        assert page.evaluate("steps.some(([, frames]) => frames === 1) && steps.at(-1)[1] <= cc4dgs.facts.frames")
        say(f"servers without ranges work; slow ones show the Gaussians first; {fetched} of {len(archive)} bytes were fetched")
        quiet("loading")

        # Damage is a sentence.
        for name in ("damaged", "hostile", "cut", "text", "missing"):
            message = page.evaluate(f"cc4dgs.load('/{name}.cc4d').then(() => 'it loaded', e => e.message)")
            assert len(message) > 20 and message != "it loaded" and "RuntimeError" not in message, f"{name}: {message}"
            shown = page.locator("[role=alert]").inner_text()
            assert message[:20] in shown, shown
            say(f"{name}: {message}")
        shot(page, "laptop_error")
        # Missing files are an error of the network that the browser itself logs.
        complaints[:] = [c for c in complaints if "404" not in c]
        quiet("errors")
        page.evaluate(f"cc4dgs.load('{MODEL}')")
        page.close()

        # A file that is dropped, and a phone.
        phone = browser.new_context(viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True).new_page()
        phone.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        phone.goto(address)
        phone.wait_for_function("window.cc4dgs !== undefined")
        shot(phone, "phone_empty")
        phone.set_input_files("input[type=file]", args.archive)
        phone.wait_for_function("cc4dgs.facts && cc4dgs.facts.frames > 1", timeout=PATIENCE_MS)
        phone.evaluate("cc4dgs.seek(0.4)")
        shot(phone, "phone")
        quiet("the phone")
        say("the file picker works, at phone width too")
        if args.single:
            path = pathlib.Path(args.single).resolve()
            context = browser.new_context(viewport={"width": 1280, "height": 800}, offline=True)
            for backend in ("", "?backend=webgl"):
                file = context.new_page()
                file.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
                file.on("pageerror", lambda e: complaints.append(str(e)))
                fetched = []
                file.on("request", lambda r: fetched.append(r.url) if not r.url.startswith(("data:", "blob:")) else None)
                began = time.time()
                file.goto(path.as_uri() + backend)
                file.wait_for_function("window.cc4dgs?.facts", timeout=PATIENCE_MS)
                assert file.evaluate("cc4dgs.facts.gaussians") == facts["gaussians"] and bool(backend) == file.evaluate("!!cc4dgs.gl")
                say(f"{path.name}, {path.stat().st_size / 1e6:.2f} MB: opened from disk without a network in {time.time() - began:.1f} s, {file.title()!r}")
                file.wait_for_function("cc4dgs.playing && cc4dgs.time > 0", timeout=PATIENCE_MS)
                file.evaluate("cc4dgs.pause()")
                agree(file, "the single file" + (", WebGL2" if backend else ""))
                assert len(fetched) == 1, f"it fetched {fetched}"
                file.evaluate("cc4dgs.seek(0.5)")
                shot(file, "single" + ("_webgl" if backend else ""))
                file.close()
            quiet("the single file")
        browser.close()
    say("all checks passed")


if __name__ == "__main__":
    main()
