"""Checks of browser.py: what the page says where memory, textures, devices or connections fail."""
import pathlib, tempfile
from browser_pages import Handler, MODEL, PATIENCE_MS, say
from browser_size import WEBGL as TEXTURES

# Counts what players of the page tell, from their first message on.
TOLD = """async source => { const { createPlayer } = await import("./player.js"), own = cc4dgs.constructor.prototype, { emit } = own;
    let told = 0;
    own.emit = function (name, ...rest) { if (name === "error") told++; return emit.call(this, name, ...rest); };
    await createPlayer(document.body.appendChild(document.createElement("div")), { src: source });
    own.emit = emit;
    return told; }"""
# Buffers of `bytes`, and no more.
BUFFERS = "bytes => { Object.defineProperty(GPUSupportedLimits.prototype, 'maxStorageBufferBindingSize', { get: () => bytes }); }"
# Shows Gaussians and motion of `source` while the harmonics arrive, sets time, pose and playback, and then breaks the connection, or opens what is no model. The rest
# arrives with the second connection. Returns what is left of what was set.
HALF = """async ([source, breaks]) => { const { fetch } = window, bytes = new Uint8Array(await (await fetch(source)).arrayBuffer());
    const wasm = await import("./cc4dgs_player.js"), download = new wasm.Download("half", bytes.length);
    download.put(0, bytes);
    const streams = JSON.parse(download.streams()), end = Math.max(...streams.filter(s => ["canonical", "playback"].includes(s.kind)).map(s => s.offset + s.bytes));
    download.free();
    let sink, connections = 0;
    const until = async holds => { while (!holds()) await new Promise(done => setTimeout(done, 50)); };
    const half = new ReadableStream({ start: controller => { sink = controller; } });
    window.fetch = async () => new Response(connections++ ? bytes : half, { headers: { "Content-Length": String(bytes.length) } });
    const finished = new Promise(done => cc4dgs.on("loaded", done));
    cc4dgs.load("/half.cc4d");
    sink.enqueue(bytes.slice(0, end));
    await until(() => cc4dgs.facts?.frames > 1);
    cc4dgs.set("speed", 0), cc4dgs.seek(0.375), cc4dgs.gpu.orbit(0.3, 0.1), cc4dgs.play();
    const pose = Array.from(cc4dgs.gpu.pose);
    let told = "";
    if (breaks) sink.error(new TypeError("on purpose"));
    else told = await cc4dgs.load(new TextEncoder().encode("no model at all. ".repeat(9)), "broken.ply").then(() => "it loaded", e => e.message);
    await finished;
    window.fetch = fetch;
    const far = Math.max(...Array.from(cc4dgs.gpu.pose, (v, k) => Math.abs(v - pose[k])));
    return { connections, far, time: cc4dgs.time, playing: cc4dgs.playing, source: cc4dgs.source, whole: cc4dgs.shown.ended, told }; }"""
# Seeks to the end and plays while another model is fetched, of which nothing arrives. Returns the seconds that listeners are told, whether it plays, and the clock.
WAITING = """() => { const { fetch } = window;
    window.fetch = (_, { signal }) => new Promise((_, stop) => signal.addEventListener("abort", () => stop(signal.reason)));
    let seconds = null;
    cc4dgs.on("time", e => { seconds ??= e.seconds; });
    cc4dgs.load("/waits.cc4d");
    cc4dgs.seek(1), cc4dgs.play();
    const found = [seconds, cc4dgs.playing, document.querySelector(".bar output").textContent];
    cc4dgs.abort.abort();
    window.fetch = fetch;
    return found; }"""
# What a file that cannot be read is, such as a folder that was dropped.
UNREAD = """() => { const folder = new File([], "folder");
    folder.arrayBuffer = () => Promise.reject(new DOMException("not found", "NotFoundError"));
    return cc4dgs.load(folder).then(() => "it loaded", e => e.message); }"""
# A WebGL2 without memory, and one that cannot draw images.
NO_MEMORY = "() => { WebGL2RenderingContext.prototype.getError = function () { return this.OUT_OF_MEMORY; }; }"
NO_IMAGE = "() => { WebGL2RenderingContext.prototype.checkFramebufferStatus = function () { return this.FRAMEBUFFER_UNSUPPORTED; }; }"
# Draws an image that fails. Returns what is told, and how many of the objects that were made for it are still there.
FAILED_IMAGE = """async () => { const { gl } = cc4dgs.gl, made = [], own = WebGL2RenderingContext.prototype;
    for (const name of ["createTexture", "createFramebuffer"]) gl[name] = () => { made.push(own[name].call(gl)); return made.at(-1); };
    cc4dgs.gl.target = () => { throw new Error("on purpose"); };
    const told = await cc4dgs.capture().then(() => "it is drawn", e => e.message);
    delete gl.createTexture, delete gl.createFramebuffer, delete cc4dgs.gl.target;
    return [told, made.length, made.filter(one => (one instanceof WebGLTexture ? gl.isTexture(one) : gl.isFramebuffer(one))).length]; }"""
# Loads a model over a connection that breaks once nothing more is read of it.
CANCELLED = """async source => { const { fetch } = window, bytes = new Uint8Array(await (await fetch(source)).arrayBuffer());
    const body = new ReadableStream({ start: controller => controller.enqueue(bytes), cancel: () => { throw new TypeError("on purpose"); } });
    window.fetch = async () => new Response(body, { headers: { "Content-Length": String(bytes.length) } });
    const told = await cc4dgs.load("/cancelled.cc4d").then(facts => facts.frames, e => e.message);
    window.fetch = fetch;
    return told; }"""
# The module is not fetched before `go` is called.
HELD = """() => { const { fetch } = window;
    window.fetch = async (address, options) => {
        if (String(address.url ?? address).endsWith(".wasm")) await new Promise(done => { window.go = done; });
        return fetch(address, options);
    }; }"""
ALERT = "document.querySelector('[role=alert]')?.innerText ?? ''"


def told_once(pages):
    page = pages.open()
    assert page.evaluate(TOLD, "/text.cc4d") == 1, "a model that does not load is told of twice"
    page.close()
    pages.quiet("errors of a second player")


def refused(pages):
    """A panic while a model opens is a sentence, and the player has stopped."""
    page = pages.open(f"?src={MODEL}")
    page.evaluate("cc4dgs.gpu.openPart = () => { throw new WebAssembly.RuntimeError('unreachable'); }; 0")
    message = page.evaluate("cc4dgs.load('/plain.cc4d').then(() => 'it loaded', e => e.message)")
    assert "memory ran out" in message and page.evaluate("cc4dgs.gpu") is None, message
    assert page.get_by_label("Play", exact=True).is_disabled()
    again = page.evaluate(f"cc4dgs.load('{MODEL}').then(() => 'it loaded', e => e.message)")
    assert "Reload the page" in again, again
    captured = page.evaluate("cc4dgs.capture().then(() => 'it is drawn', e => e.message)")
    assert "no graphics device" in captured, captured
    page.close()
    # The page writes the panic itself to the console.
    pages.complaints[:] = [c for c in pages.complaints if "unreachable" not in c]
    pages.quiet("a panic")
    say(f"a panic is a sentence: {message}")


def small_textures(pages):
    """Models that do not fit into textures of WebGL2 are refused."""
    page = pages.open(f"?src={MODEL}&backend=webgl", before=f"({TEXTURES})(1)")
    message = page.evaluate(ALERT)
    assert "texture" in message and page.evaluate("cc4dgs.facts") is None and page.get_by_label("Play", exact=True).is_disabled(), message
    page.close()
    pages.quiet("small textures")
    say(f"a model that does not fit into small textures: {message}")


def half_arrived(pages):
    """Time, pose and playback outlive a connection that breaks, and a file that is no model, while a model arrives."""
    for backend in ("", "?backend=webgl"):
        for breaks in (True, False):
            page = pages.open(backend)
            found = page.evaluate(HALF, [MODEL, breaks])
            assert found["connections"] == 2 and found["source"] == "/half.cc4d" and found["whole"], found
            assert found["far"] < 1e-9 and abs(found["time"] - 0.375) < 1e-6 and found["playing"], found
            alert = page.evaluate(ALERT)
            assert breaks and not found["told"] or len(found["told"]) > 20 and found["told"][:20] in alert, [found, alert]
            page.close()
    pages.quiet("a model of which half has arrived")
    say("time, pose and playback stay where a connection breaks; a model that arrives goes on after a broken file")


def cancelled(pages):
    """A connection that breaks once all that is needed has arrived harms nothing."""
    page = pages.open()
    told = page.evaluate(CANCELLED, MODEL)
    assert isinstance(told, int) and told > 1, told
    page.close()
    pages.quiet("a connection that breaks at the end")
    say("a connection may break once all that is needed has arrived")


def opened_early(pages):
    """A file that is opened before the module has arrived is shown, and stays where the page has a model of its own."""
    for query in ("", f"?src={MODEL}"):
        page = pages.watch(pages.browser.new_page())
        page.add_init_script(f"({HELD})()")
        page.goto(f"{pages.address}/index.html{query}", wait_until="commit")
        page.wait_for_function("window.go !== undefined")
        page.set_input_files("input[type=file]", {"name": "early.cc4d", "mimeType": "application/octet-stream", "buffer": Handler.archives[MODEL]})
        page.evaluate("go()")
        page.wait_for_function(f"window.cc4dgs && (cc4dgs.facts || ({ALERT}))")
        found = page.evaluate(f"[cc4dgs.source?.name, cc4dgs.facts?.frames > 1, {ALERT}]")
        assert found == ["early.cc4d", True, ""], f"a file that is opened before the module has arrived: {found}"
        page.close()
    pages.quiet("a file that was opened early")
    say("a file can be opened before the module has arrived")


def out_of_memory(pages):
    """Too little memory of the graphics card is a sentence, told once; what was allocated is given back."""
    page = pages.open("?backend=webgl")
    told, made, left = page.evaluate(FAILED_IMAGE)
    assert told == "on purpose" and made == 2 and left == 0, f"an image that fails leaves {left} of {made} objects: {told}"
    page.evaluate(NO_MEMORY)
    message = page.evaluate(f"cc4dgs.load('{MODEL}').then(() => 'it loaded', e => e.message)")
    assert "too little free memory for the model" in message and page.evaluate("cc4dgs.facts") is None and message[:20] in page.evaluate(ALERT), message
    assert page.evaluate("cc4dgs.gl.capacity + Object.keys(cc4dgs.gl.textures).length") == 0, "a model that is refused stays on the graphics card"
    page.close()
    page = pages.open("?backend=webgl")
    page.evaluate(NO_IMAGE)
    page.evaluate("window.device = cc4dgs.gpu; cc4dgs.set('resolution', 0.5)")
    page.wait_for_function(f"({ALERT}).includes('cannot draw an image of')")
    assert page.evaluate("[device.__wbg_ptr, cc4dgs.gl.capacity + Object.keys(cc4dgs.gl.textures).length]") == [0, 0], "a player that has stopped keeps its model"
    page.close()
    # The page writes what stops it to the console.
    pages.complaints[:] = [c for c in pages.complaints if "cannot draw" not in c]
    page = pages.open(f"?src={MODEL}")
    page.evaluate("""() => { window.told = []; cc4dgs.on("error", e => told.push(e.message)); cc4dgs.gpu.takeFailure = () => "Out of Memory"; }""")
    page.wait_for_function("told.length > 0")
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done))).then(() => 0)")
    told = page.evaluate("told")
    assert len(told) == 1 and "Out of Memory" in told[0] and told[0] in page.evaluate(ALERT), told
    page.close()
    pages.quiet("memory that ran out")
    say(f"a full graphics card is a sentence: {told[0]}")


def few_degrees(pages):
    """Where only the harmonics do not fit into textures of WebGL2 or buffers of WebGPU, their lower degrees are shown, and a warning says so once."""
    page = pages.open(f"?src={MODEL}&backend=webgl")
    facts = page.evaluate("cc4dgs.facts")
    stored, count = facts["shDegree"], facts["gaussians"]
    words = count * -(-3 * ((stored + 1) ** 2 - 1) // 2)
    # 16 numbers of each Gaussian, and the motion, must fit.
    if words <= max(16 * count, facts["gpuBytes"] // 4 - 16 * count - words):
        say(f"harmonics of degree {stored} are not the largest texture of this model: what happens where they do not fit is not checked")
        return page.close()
    shown = page.evaluate("""async ([most, source]) => { const wasm = await import("./cc4dgs_player.js"), { width, height } = cc4dgs.ui.canvas;
        const warned = []; cc4dgs.on("warning", e => warned.push(e.message));
        cc4dgs.gpu = wasm.Player.plain(width, height, most, cc4dgs.gl.mostSide);
        const facts = await cc4dgs.load(source);
        cc4dgs.draw();
        return [facts.shDegree, facts.storedDegree, warned]; }""", [words - 1, "/slow-plain.cc4d"])
    assert shown[:2] == [stored - 1, stored] and len(shown[2]) == 1 and f"up to degree {stored - 1} of {stored}" in shown[2][0], shown
    page.close()
    for source in ("/slow-plain.cc4d", "/gzip.cc4d"):
        page = pages.open(before=f"({BUFFERS})({4 * (words - 1)})")
        assert not page.evaluate("!!cc4dgs.gl"), "small buffers lead to WebGL2"
        limited = page.evaluate("""async source => { const warned = []; cc4dgs.on("warning", e => warned.push(e.message));
            const facts = await cc4dgs.load(source);
            const { data } = await cc4dgs.capture();
            return [facts.shDegree, facts.storedDegree, warned, data.some(v => v > 60 && v < 255), document.querySelector(".note").innerText]; }""", source)
        assert limited[:2] == [stored - 1, stored] and len(limited[2]) == 1 and "buffer" in limited[2][0] and limited[3], limited
        assert limited[2][0] in limited[4], f"the page does not say what it leaves out: {limited[4]!r}"
        page.close()
    # Chromium complains where a page leaves a compressed answer before its end.
    pages.complaints[:] = [c for c in pages.complaints if "net::ERR_" not in c]
    pages.quiet("harmonics that do not fit")
    say(f"harmonics that do not fit: {shown[2][0]} {limited[2][0]}")


def opened_meanwhile(pages):
    """A model that is asked for while a lost device is replaced is loaded."""
    page = pages.open(f"?src={MODEL}")
    found = page.evaluate("""source => new Promise(done => {
        cc4dgs.start = () => { delete cc4dgs.start; const started = cc4dgs.start(); cc4dgs.load(source).then(f => done([f?.frames, cc4dgs.source]), e => done([e.message])); return started; };
        cc4dgs.gpu.loseDevice(); })""", "/plain.cc4d")
    assert found == [page.evaluate("cc4dgs.facts.frames"), "/plain.cc4d"], found
    page.close()
    pages.quiet("a model that was opened while the device was lost")
    say("a model can be opened while a lost device is replaced")


def fetched_meanwhile(pages):
    """While another model is fetched, the one that is shown has its clock and plays; a folder that is dropped is a sentence, and the model stays."""
    page = pages.open(f"?src={MODEL}")
    told = page.evaluate(UNREAD)
    assert "folder could not be read" in told and "not a folder" in told and told[:20] in page.evaluate(ALERT) and page.evaluate("!!cc4dgs.facts"), told
    seconds, plays, clock = page.evaluate(WAITING)
    assert seconds > 0 and plays and clock.endswith(" s"), [seconds, plays, clock]
    page.close()
    pages.quiet("a model that is fetched while another one plays")
    say("while a model is fetched, the one before plays on; what cannot be read is a sentence")


def second_player(pages):
    """A second player leaves the page its look."""
    page = pages.open()
    look = "getComputedStyle(document.documentElement).overflow + document.documentElement.classList"
    before = page.evaluate(look)
    page.evaluate("""async () => { const { createPlayer } = await import("./player.js"), element = document.body.appendChild(document.createElement("div"));
        await createPlayer(element); window.added = element; }""")
    during = page.evaluate(look)
    page.evaluate("added.remove()")
    assert before == during == page.evaluate(look) and "cc-embedded" not in before, [before, during]
    page.close()
    pages.quiet("a second player")
    say("a second player leaves the page its look")


def hopeless(pages):
    """A model that loses its device each time is given up."""
    page = pages.open()
    page.evaluate(f"cc4dgs.on('loaded', () => cc4dgs.gpu?.loseDevice()); cc4dgs.load('{MODEL}').then(() => 0, () => 0)")
    page.wait_for_function(f"({ALERT}).includes('times in a row')", timeout=PATIENCE_MS)
    assert page.evaluate("cc4dgs.gpu") is None and page.get_by_label("Play", exact=True).is_disabled()
    page.close()
    pages.quiet("a device that is lost again and again")
    say("a model that loses the device each time is given up")


def missing_files(pages):
    """A page without its modules is a sentence, and so is an archive that arrives in part."""
    for name in ("player.js", "cc4dgs_player.js"):
        page = pages.watch(pages.browser.new_page())
        page.route(f"**/{name}", lambda route: route.fulfill(status=404, body="not found"))
        page.goto(f"{pages.address}/index.html")
        page.wait_for_function("document.body.innerText.includes('could not be loaded')")
        said = page.evaluate("document.body.innerText")
        assert "player.js" in said and "beside the page" in said, said
        page.close()
    # The browser itself logs the missing file, and the module that fails for it.
    pages.complaints[:] = [c for c in pages.complaints if "404" not in c and "dynamically imported" not in c]
    pages.quiet("missing modules")
    say(f"a page without its modules says: {said}")
    page = pages.open()
    message = page.evaluate("""async source => { const { fetch } = window, bytes = new Uint8Array(await (await fetch(source)).arrayBuffer());
        window.fetch = async () => new Response(bytes.slice(0, bytes.length / 2), { headers: { "Content-Length": String(bytes.length) } });
        const told = await cc4dgs.load("/part.cc4d").then(() => "it loaded", e => e.message);
        window.fetch = fetch;
        return told; }""", MODEL)
    assert message.startswith("part.cc4d arrived in part"), message
    page.close()
    pages.quiet("a model that arrives in part")


def broken_module(pages):
    """Where the module could not be fetched, another player fetches it."""
    page = pages.watch(pages.browser.new_page())
    page.route("**/*.wasm", lambda route: route.abort(), times=1)
    page.goto(f"{pages.address}/index.html")
    page.wait_for_function("window.cc4dgs !== undefined")
    assert page.evaluate("cc4dgs.gpu") is None and "cc4dgs_player_bg.wasm could not be loaded" in page.evaluate(ALERT)
    found = page.evaluate("""async source => { const { createPlayer } = await import("./player.js");
        const player = await createPlayer(document.body.appendChild(document.createElement("div")), { src: source });
        return player.facts?.frames; }""", MODEL)
    assert found and found > 1, found
    page.close()
    pages.complaints[:] = [c for c in pages.complaints if "net::ERR_" not in c]
    pages.quiet("a module that could not be fetched")
    say("a module that could not be fetched is fetched again by the next player")


def incomplete(pages, path):
    """One HTML file that lacks its end, or whose module is damaged, says so in place of staying blank."""
    text = path.read_text()
    cases = {"its end is missing": text[:len(text) // 2], "end is missing": text[:text.rindex("</script>")], "could not be started": text.replace('id="renderer">', 'id="renderer">AAAA', 1)}
    with tempfile.TemporaryDirectory() as folder:
        for said, content in cases.items():
            file = pathlib.Path(folder) / "damaged.html"
            file.write_text(content)
            page = pages.watch(pages.browser.new_page())
            page.goto(file.as_uri())
            page.wait_for_function(f"document.body.innerText.includes({said!r})")
            page.close()
            if "started" not in said: pages.quiet(said)
    # The page logs that the module cannot be unpacked, in the words of Chromium.
    pages.complaints[:] = [c for c in pages.complaints if c != "Failed to fetch"]
    pages.quiet("a damaged HTML file")
    say("an incomplete HTML file, and a damaged one, say so")
