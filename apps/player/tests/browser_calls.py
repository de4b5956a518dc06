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


# Sets what is no number; returns what is said. Then what is out of range; returns what is set.
NUMBERS = """() => { const said = [["speed", NaN], ["scale", "large"], ["resolution", undefined], ["shDegree", null]].map(([name, value]) => {
        try { cc4dgs.set(name, value); return "it is set"; } catch (e) { return e.message; } });
    const names = ["scale", "resolution", "shDegree", "tint"], { settings } = cc4dgs, own = { ...settings };
    [100, 0, -1, 1].forEach((value, k) => cc4dgs.set(names[k], value));
    const set = names.map(name => settings[name]);
    names.forEach(name => cc4dgs.set(name, own[name]));
    return [said, set]; }"""
# Loads what is no model of any kind; returns what is said, and whether the model before is still there.
NOTHING = """async () => { const { source } = cc4dgs, said = [];
    for (const other of [null, undefined, 42, {}]) said.push(await cc4dgs.load(other).then(() => "it loaded", e => e.message));
    return [said, cc4dgs.source === source && !!cc4dgs.facts]; }"""
# Loads a part of a larger array; returns its frames.
PART = """async address => { const bytes = new Uint8Array(await (await fetch(address)).arrayBuffer()), all = new Uint8Array(bytes.length + 8);
    all.set(bytes, 3);
    return (await cc4dgs.load(new DataView(all.buffer, 3, bytes.length), "part.cc4d")).frames; }"""


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
    said, taken = page.evaluate(NUMBERS)
    assert all("is a number" in message for message in said), f"settings that are no numbers: {said}"
    assert taken == [10, 0.1, 0, True], f"settings that are out of range are {taken}"
    said, stays = page.evaluate(NOTHING)
    assert all("was given" in message for message in said) and stays, f"what is no model: {said}, the one before stays: {stays}"
    assert page.evaluate(PART, MODEL) == frames, "a view of a buffer is not opened"
    page.close()
    pages.quiet("calls")
    say("unknown settings and what is no model are refused, a new model ends the playback of the one before, and nothing is drawn at speed 0")
