"""What the checks of browser.py share: a server of page and archives, and pages whose console is watched."""
import functools, gzip, http.server, json, os, pathlib, re, shutil, threading, time
import numpy
from PIL import Image

FLAGS = ("--enable-unsafe-webgpu --enable-features=Vulkan --use-vulkan=swiftshader --use-angle=swiftshader "
         "--enable-unsafe-swiftshader --ignore-gpu-blocklist --no-sandbox").split()
LEAST_DB = 40.0
MODEL = "/model.cc4d"
# A frame of a real scene takes seconds in software.
PATIENCE_MS = 180000
HEAD = '<!doctype html><html lang="en"><title>embedding</title><link rel="icon" href="data:,">'
# Pages with a player in a frame of this site, and without storage; and with three players of their own.
FRAME = HEAD + f'<body><p>A page with a player in it.</p><iframe %s src="index.html?src={MODEL}&amp;autoplay" width="480" height="320" style="border: 0"></iframe></body></html>'
SEVERAL = HEAD + f"""<link rel="stylesheet" href="player.css"><body><div></div><div></div><div></div><style>body > div {{ height: 180px }}</style><script type="module">import {{ createPlayer }} from "./player.js";
const src = "{MODEL}", [one, two, three] = document.querySelectorAll("body > div");
window.players = [await createPlayer(one, {{ src }}), await createPlayer(two, {{ src }}), await createPlayer(three, {{ src, remember: false }})];</script></body></html>"""


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the page and the archives, with ranges or without, whole or damaged, and a page that embeds the page."""
    protocol_version = "HTTP/1.1"
    requests = []
    archives = {}
    # Paths whose connection broke already.
    broken = set()

    def do_GET(self):
        path = self.path.split("?")[0]
        embedding = {"/embedding.html": FRAME % "", "/sandboxed.html": FRAME % 'sandbox="allow-scripts"', "/several.html": SEVERAL}
        if path in embedding:
            return self.answer(embedding[path].encode(), 200, {"Content-Type": "text/html; charset=utf-8"})
        if not path.endswith(".cc4d"):
            return super().do_GET()
        body = self.archives.get(path)
        if body is None:
            return self.send_error(404)
        wanted = self.headers.get("Range")
        Handler.requests.append((path, wanted))
        pieces = 40 if "slow" in path else 1
        if "gzip" in path:
            return self.answer(gzip.compress(body), 200, {"Content-Encoding": "gzip"})
        version = {"ETag": '"1"'} if "tagged" in path else {}
        if "tagged" in path and wanted and not wanted.startswith("bytes=0-"):
            assert self.headers.get("If-Range") == '"1"', "parts are asked for without a condition"
            if path not in Handler.broken:
                Handler.broken.add(path)
                part, extent = self.part(wanted, body)
                return self.answer(part, 206, {**version, "Content-Range": extent}, cut=len(part) // 2)
        if not wanted or "plain" in path:
            return self.answer(body, 200, {}, pieces)
        if not body:
            return self.answer(body, 416, {"Content-Range": "bytes */0"})
        part, extent = self.part(wanted, body)
        self.answer(part, 206, {**version, "Content-Range": extent}, pieces)

    def end_headers(self):
        # Frames without storage are of a site of their own.
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    @staticmethod
    def part(wanted, body):
        first, last = re.fullmatch(r"bytes=(\d+)-(\d+)", wanted).groups()
        part = body[int(first):int(last) + 1]
        return part, f"bytes {first}-{int(first) + len(part) - 1}/{len(body)}"

    def answer(self, body, status, headers, pieces=1, cut=None):
        """Sends `body` in pieces; with `cut`, so many bytes of it before the connection ends."""
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if cut:
            body, self.close_connection = body[:cut], True
        step = max(1, len(body) // pieces)
        for at in range(0, len(body), step):
            try:
                self.wfile.write(body[at:at + step])
                self.wfile.flush()
            except (BrokenPipeError, ConnectionResetError):
                return
            if pieces > 1:
                # Without a graphics card a frame of the page takes half a second, in which pieces gather: layers are seen apart where each takes longer.
                time.sleep(0.5 if "plain" in self.path else 0.15)

    def log_message(self, *_):
        pass


def serve(folder, archive):
    """Serves `folder` and forms of `archive` from now on; returns the server's address."""
    damaged = bytearray(archive)
    damaged[len(archive) // 3] ^= 0x55
    hostile = archive[:12] + (0xFFFFFFF0).to_bytes(4, "little") + archive[16:]
    # The header of an SPZ file of 7,999,999 Gaussians of degree 4: more than WebAssembly holds.
    vast = b"NGSP" + (4).to_bytes(4, "little") + (7999999).to_bytes(4, "little") + bytes([4, 12, 0, 6]) + (32).to_bytes(4, "little") + bytes(12)
    Handler.archives = {MODEL: archive, "/plain.cc4d": archive, "/slow.cc4d": archive, "/slow-plain.cc4d": archive, "/damaged.cc4d": bytes(damaged), "/hostile.cc4d": hostile,
                        "/cut.cc4d": archive[:len(archive) // 2], "/text.cc4d": b"this is no model at all" * 9, "/gzip.cc4d": archive,
                        "/tagged.cc4d": archive, "/vast.cc4d": vast, "/empty.cc4d": b""}
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


def launch(play):
    return play.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS, headless=True)


def psnr(a, b):
    error = numpy.mean((a.astype(float) - b.astype(float)) ** 2)
    return 99.0 if error == 0 else 10 * numpy.log10(255 ** 2 / error)


def say(text):
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


class Pages:
    """Opens pages in `browser`, notes what their consoles say, and compares images with those in the folder `reference`."""

    def __init__(self, browser, address, reference, screenshots):
        self.browser, self.address, self.reference, self.screenshots = browser, address, pathlib.Path(reference), screenshots
        self.complaints = []

    def watch(self, page):
        page.set_default_timeout(PATIENCE_MS)
        page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: self.complaints.append(str(e)))
        return page

    def open(self, query="", size=(1280, 800), before=None):
        """The page; `before` is a script that runs ahead of its own."""
        page = self.watch(self.browser.new_page(viewport={"width": size[0], "height": size[1]}))
        if before:
            page.add_init_script(before)
        page.goto(f"{self.address}/index.html{query}")
        page.wait_for_function("window.cc4dgs !== undefined")
        return page

    def shot(self, page, name):
        if self.screenshots:
            os.makedirs(self.screenshots, exist_ok=True)
            page.wait_for_timeout(400)
            page.screenshot(path=os.path.join(self.screenshots, name + ".png"))

    def quiet(self, what):
        assert not self.complaints, f"{what}: the console says {self.complaints}"

    def agree(self, page, what):
        least = 99.0
        for entry in json.loads((self.reference / "reference.json").read_text()):
            wanted = numpy.asarray(Image.open(self.reference / entry["image"]).convert("RGB"))
            found = page.evaluate("async ([camera, time]) => { const p = await cc4dgs.capture(camera, time); return [p.width, p.height, Array.from(p.data)]; }",
                                  [entry["camera"], entry["time"]])
            image = numpy.array(found[2], numpy.uint8).reshape(found[1], found[0], 4)[..., :3]
            decibels = psnr(image, wanted)
            least = min(least, decibels)
            assert decibels >= LEAST_DB, f"{what}, {entry['image']}: {decibels:.1f} dB"
        say(f"{what}: pixels agree with the tile renderer, at least {least:.1f} dB over 3 times and 2 cameras")
