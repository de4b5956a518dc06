"""What scripts share that drive the page of the player in Chromium with SwiftShader."""
import functools, http.server, pathlib, shutil, threading

FLAGS = ("--enable-unsafe-webgpu --enable-features=Vulkan --use-vulkan=swiftshader --use-angle=swiftshader "
         "--enable-unsafe-swiftshader --ignore-gpu-blocklist --no-sandbox").split()


def launch(play):
    """A headless Chromium, the one on the path."""
    return play.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS, headless=True)


def serve(folder, archive, name):
    """Serves the files of `folder`, and the file `archive` as /`name`, without ranges. Returns the address and the number of bytes of the archive."""
    content = pathlib.Path(archive).read_bytes()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            if self.path != f"/{name}":
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}", len(content)
