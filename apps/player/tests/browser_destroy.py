"""Checks of browser.py: players that are destroyed."""
from browser_pages import MODEL, say

# Destroys the page's player while it plays and loads, twice. Returns what it still does half a second later, and what of it is still there.
DESTROY = """async source => { const player = cc4dgs, { fetch, requestAnimationFrame } = window, { destroy } = GPUDevice.prototype;
    const later = ms => new Promise(done => setTimeout(done, ms)), problem = promise => promise.then(() => "", e => e.message);
    let frames = 0, devices = 0, signal = null;
    window.requestAnimationFrame = run => { frames++; return requestAnimationFrame.call(window, run); };
    window.fetch = (address, options) => { signal = options?.signal; return fetch(address, options); };
    GPUDevice.prototype.destroy = function () { devices++; destroy.call(this); };
    player.play();
    const loading = player.load(source);
    while (!frames || !signal) await later(50);
    const { gpu, gl } = player;
    player.destroy(), player.destroy();
    frames = 0;
    const keys = !document.body.dispatchEvent(new KeyboardEvent("keydown", { key: " ", bubbles: true, cancelable: true }));
    player.play(), player.seek(0.5), player.step(1), player.reset(), player.goTo(0), player.set("depth", true), player.link();
    const refused = [await problem(player.load(source)), await problem(player.capture())];
    await later(500);
    Object.assign(window, { fetch, requestAnimationFrame });
    GPUDevice.prototype.destroy = destroy;
    return { frames, devices, keys, fetching: !signal.aborted, loaded: await loading, refused, memory: gpu.__wbg_ptr !== 0,
        context: !!gl && !gl.gl.isContextLost(), worker: !!gl?.sorter.worker, buffers: gl?.capacity ?? 0, textures: Object.keys(gl?.textures ?? {}).length, elements: document.getElementById("player").childElementCount }; }"""
# A second player, inside of a page whose first one is the page's own.
INSIDE = """import('./player.js').then(async m => { const box = document.body.appendChild(document.createElement('div'));
    box.style.cssText = 'position:fixed;left:0;top:0;width:160px;height:120px'; window.inner = await m.createPlayer(box); })"""
# Destroys the page's player while a lost device is replaced. Returns how that ends, and what is left of the player.
DESTROY_LOST = """() => new Promise(done => { const player = cc4dgs;
    player.start = () => {
        delete player.start;
        const started = player.start(), ended = end => done([end, !!player.gpu, !!player.gl, document.getElementById("player").childElementCount]);
        player.destroy();
        started.then(() => ended("it started"), e => ended(e.message));
        return started;
    };
    if (player.gl) player.gl.gl.getExtension("WEBGL_lose_context").loseContext(); else player.gpu.loseDevice(); })"""

# Makes a player in the element of the page's own one. Returns whether that is destroyed, its memory, the elements, and whether the new one shows the model.
REPLACE = """async source => { const { createPlayer } = await import("./player.js"), { gpu } = cc4dgs, old = cc4dgs, element = document.getElementById("player");
    window.cc4dgs = await createPlayer(element, { src: source });
    return [old.destroyed, gpu.__wbg_ptr, element.childElementCount, cc4dgs.facts?.frames > 1]; }"""


def destroyed(pages, facts):
    """A player that is destroyed leaves nothing behind, and its element to another one."""
    for backend in ("", "&backend=webgl"):
        page = pages.open(f"?src={MODEL}{backend}")
        left = page.evaluate(DESTROY, "/slow.cc4d")
        assert all("destroyed" in message for message in left.pop("refused")), "a destroyed player does not refuse what it is asked for"
        assert left.pop("devices") == (0 if backend else 1) and left.pop("loaded") is None and not any(left.values()), left
        page.evaluate("import('./player.js').then(async m => { window.cc4dgs = await m.createPlayer(document.getElementById('player')); })")
        assert page.locator("canvas").count() == 1 and page.evaluate("cc4dgs.facts.gaussians") == facts["gaussians"] and bool(backend) == page.evaluate("!!cc4dgs.gl")
        page.evaluate("cc4dgs.play()")
        page.wait_for_function("cc4dgs.time > 0")
        page.keyboard.press(" ")
        assert not page.evaluate("cc4dgs.playing"), "keys do not reach the second player of an element"
        page.evaluate(INSIDE)
        page.evaluate("cc4dgs.play(); inner.play(); inner.ui.canvas.focus()")
        page.keyboard.press(" ")
        assert page.evaluate("[cc4dgs.playing, inner.playing]") == [True, False], "a key of a player inside of the page reached the page's own player"
        page.evaluate("cc4dgs.pause(); inner.destroy()")
        assert page.evaluate("cc4dgs.capture().then(p => p.data.some(v => v > 60 && v < 255))"), "the second player of an element shows nothing"
        found = page.evaluate(REPLACE, MODEL)
        assert found == [True, 0, 1, True], f"a player whose element another one takes goes on: {found}"
        end, *left = page.evaluate(DESTROY_LOST)
        assert "destroyed" in end and not any(left), f"a recovery goes on after its player was destroyed: {[end, *left]}"
        page.close()
    pages.quiet("players that are destroyed")
    say("a destroyed player leaves nothing behind, and its element to another one")
