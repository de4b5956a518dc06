"""Checks of browser.py: calls of a page that has the player in it, and the events that follow."""
from browser_pages import MODEL, say

# What a setting that does not exist says.
UNKNOWN = "() => { try { cc4dgs.set('sh_degree', 1); return 'it is set'; } catch (e) { return e.message; } }"
# Plays, and opens another model in between. Returns the events of playback, whether it plays, and what is open.
OTHER = """async address => { const told = [], stop = ["play", "pause"].map(name => cc4dgs.on(name, () => told.push(name)));
    cc4dgs.play();
    await cc4dgs.load(new URL(address, location.href));
    stop.forEach(stop => stop());
    return [told, cc4dgs.playing, cc4dgs.source]; }"""
# Frames that are drawn within half a second of playback at a speed of 0.
STILL = """async () => { const { draw } = cc4dgs;
    let draws = 0;
    cc4dgs.set("speed", 0), cc4dgs.play(), cc4dgs.draw();
    cc4dgs.draw = function () { draws++; draw.call(this); };
    await new Promise(done => setTimeout(done, 500));
    cc4dgs.draw = draw, cc4dgs.set("speed", 1), cc4dgs.pause();
    return draws; }"""

# Loads a model, and another one in a listener of its progress. Returns what the first call resolves to, frames and source of the second, and what is shown.
RIVALS = """async address => { const { fetch } = window, bytes = new Uint8Array(await (await fetch(address)).arrayBuffer());
    window.fetch = async () => new Response(bytes, { headers: { "Content-Length": String(bytes.length) } });
    let second = null;
    const stop = cc4dgs.on("progress", () => { stop(); second = cc4dgs.load("/second.cc4d"); });
    const first = await cc4dgs.load("/first.cc4d"), facts = await second;
    window.fetch = fetch;
    return [first, facts.frames, cc4dgs.source, cc4dgs.shown.source]; }"""


def calls(pages):
    page = pages.open(f"?src={MODEL}")
    message = page.evaluate(UNKNOWN)
    assert "no setting sh_degree" in message and "shDegree" in message, message
    assert page.evaluate("cc4dgs.goTo(99), cc4dgs.setPose([0, 0, 0, 0, 0, 0, 0]), cc4dgs.camera") == -1, "a view that was not taken is shown as one"
    told, playing, source = page.evaluate(OTHER, MODEL + "?other")
    assert told == ["play", "pause"] and not playing, f"a model that takes the place of one that plays: {told}"
    assert isinstance(source, str) and source.endswith(MODEL + "?other"), source
    assert page.evaluate(STILL) == 0, "the page draws although time stands still"
    frames = page.evaluate("cc4dgs.facts.frames")
    rivals = page.evaluate(RIVALS, MODEL)
    assert rivals == [None, frames, "/second.cc4d", "/second.cc4d"], f"a model that another one replaced goes on: {rivals}"
    page.close()
    pages.quiet("calls")
    say("unknown settings are refused, a new model ends the playback of the one before, and nothing is drawn at speed 0")
