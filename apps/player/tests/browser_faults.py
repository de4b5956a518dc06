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
