"""Checks of browser.py: what the page says where memory, textures, devices or connections fail."""
from browser_pages import MODEL, PATIENCE_MS, say

# Counts what players of the page tell, from their first message on.
TOLD = """async source => { const { createPlayer } = await import("./player.js"), own = cc4dgs.constructor.prototype, { emit } = own;
    let told = 0;
    own.emit = function (name, ...rest) { if (name === "error") told++; return emit.call(this, name, ...rest); };
    await createPlayer(document.body.appendChild(document.createElement("div")), { src: source });
    own.emit = emit;
    return told; }"""
# Textures of `side` texels, and no more.
TEXTURES = """side => { const own = WebGL2RenderingContext.prototype, { getParameter } = own;
    own.getParameter = function (name) { return name === this.MAX_TEXTURE_SIZE ? side : getParameter.call(this, name); }; }"""
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
    page.close()
    # The page writes the panic itself to the console.
    pages.complaints[:] = [c for c in pages.complaints if "unreachable" not in c]
    pages.quiet("a panic")
    say(f"a panic is a sentence: {message}")


def small_textures(pages):
    """WebGL2 with small textures: canvases and images fit, and models that do not are refused."""
    page = pages.open(f"?src={MODEL}&backend=webgl", before=f"({TEXTURES})(512)")
    page.evaluate("cc4dgs.set('resolution', 2); cc4dgs.draw()")
    sides = page.evaluate("[cc4dgs.ui.canvas.width, cc4dgs.ui.canvas.height, ...cc4dgs.gl.size]")
    assert max(sides) == 512 and abs(sides[0] / sides[1] - 1280 / 800) < 0.01 and abs(sides[2] / sides[3] - 1280 / 800) < 0.01, sides
    page.close()
    page = pages.open(f"?src={MODEL}&backend=webgl", before=f"({TEXTURES})(1)")
    message = page.evaluate(ALERT)
    assert "texture" in message and page.evaluate("cc4dgs.facts") is None and page.get_by_label("Play", exact=True).is_disabled(), message
    page.close()
    pages.quiet("small textures")
    say(f"images fit into small textures; models that do not: {message}")


def few_degrees(pages):
    """Where only the harmonics do not fit into textures of WebGL2, their lower degrees are shown, and a warning says so once."""
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
    pages.quiet("harmonics that do not fit")
    say(f"harmonics that do not fit: {shown[2][0]}")


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


def broken_module(pages):
    """Where the module could not be fetched, another player fetches it."""
    page = pages.watch(pages.browser.new_page())
    page.route("**/*.wasm", lambda route: route.abort(), times=1)
    page.goto(f"{pages.address}/index.html")
    page.wait_for_function("window.cc4dgs !== undefined")
    assert page.evaluate("cc4dgs.gpu") is None and len(page.evaluate(ALERT)) > 5
    found = page.evaluate("""async source => { const { createPlayer } = await import("./player.js");
        const player = await createPlayer(document.body.appendChild(document.createElement("div")), { src: source });
        return player.facts?.frames; }""", MODEL)
    assert found and found > 1, found
    page.close()
    pages.complaints[:] = [c for c in pages.complaints if "net::ERR_" not in c]
    pages.quiet("a module that could not be fetched")
    say("a module that could not be fetched is fetched again by the next player")
