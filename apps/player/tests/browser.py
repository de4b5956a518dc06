"""Drives the page in Chromium: browser.py PAGE ARCHIVE REFERENCE [--single FILE.html] [--weights FILE.html] [--screenshots FOLDER].

PAGE is the folder of build-web, ARCHIVE a baked archive, REFERENCE the folder that the example `reference` wrote for it. --single is a file of
`cc4dgs export web` of the same archive, --weights one of the model that was baked, whose motion the page computes from the deformer's weights: both are
opened from disk, without a network. Chromium renders with SwiftShader, so no graphics card is needed. Needs playwright, Pillow and numpy, and Chromium on
the path. Ends with a sentence per check; fails at the first that does not hold.
"""
import argparse, pathlib, time
from browser_calls import calls
from browser_destroy import destroyed
from browser_faults import broken_module, cancelled, fetched_meanwhile, few_degrees, half_arrived, hopeless, incomplete, missing_files, opened_early, opened_meanwhile, out_of_memory, refused, second_player, small_textures, told_once
from browser_gaussian import one_gaussian, remarks
from browser_input import cameras, command_key, drop, embedded, focus, held, key_list, layouts, low, reduced_motion, released, touch, typing, wheel
from browser_keep import frames, reloaded, several, shapes
from browser_pages import Handler, MODEL, Pages, launch, say, serve
from browser_size import freed, sizes
from browser_sort import sorting
from playwright.sync_api import sync_playwright

POSE = "Array.from(cc4dgs.gpu.pose)"

# A number for the image from a pose at 0.6.
IMAGE = """async pose => { cc4dgs.seek(0.6); cc4dgs.gpu.pose = new Float64Array(pose);
    const { data } = await cc4dgs.capture(); return data.reduce((sum, v) => (31 * sum + v) >>> 0, 0); }"""
# Notes what is shown of a model that arrives, and lets the first take at least so many milliseconds.
STAGES = """least => { const { gpu } = cc4dgs, { openPart, openHarmonics } = gpu;
    window.stages = [];
    gpu.openPart = (...all) => {
        stages.push(all.slice(1, 4));
        for (const end = performance.now() + least; performance.now() < end;);
        return openPart.apply(gpu, all);
    };
    gpu.openHarmonics = (download, degree) => { stages.push([255, true, degree]); openHarmonics.call(gpu, download, degree); }; }"""
# Loads a model of which the Gaussians and their motion arrive first, then each degree of harmonics: `patient`ly after the one before is shown, or at once. Returns
# the degrees.
STEPS = """async ([source, patient]) => { const { fetch } = window, bytes = new Uint8Array(await (await fetch(source)).arrayBuffer());
    const wasm = await import("./cc4dgs_player.js"), download = new wasm.Download("steps", bytes.length);
    download.put(0, bytes);
    const harmonics = JSON.parse(download.streams()).filter(s => s.kind === "harmonics");
    download.free();
    let sink, at = 0;
    const body = new ReadableStream({ start: controller => { sink = controller; } });
    const sent = end => { sink.enqueue(bytes.slice(at, end)); at = end; };
    // A degree is shown with what arrives after it has waited.
    const shown = async (count, byte) => {
        while (patient && stages.length < count) {
            await new Promise(done => setTimeout(done, 50));
            if (byte && at < harmonics.at(-1).offset + harmonics.at(-1).bytes - 1) sent(at + 1);
        }
    };
    window.fetch = async () => new Response(body, { headers: { "Content-Length": String(bytes.length) } });
    const loaded = cc4dgs.load("/steps.cc4d");
    sent(harmonics[0].offset);
    await shown(1, false);
    for (const [k, { offset, bytes: length }] of harmonics.slice(0, -1).entries()) {
        sent(Math.max(at, offset + length));
        await shown(2 + k, true);
    }
    const last = harmonics.at(-1);
    sent(last.offset + last.bytes);
    await loaded;
    window.fetch = fetch;
    return harmonics.map(s => s.stage); }"""

# Clicks "Copy link"; returns what the button says then.
COPY = """async () => { const share = [...document.querySelectorAll(".panel button")].find(b => b.textContent === "Copy link");
    await share.onclick(); return share.textContent; }"""


def apart(a, b):
    return max(abs(x - y) for x, y in zip(a, b))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("page"), parser.add_argument("archive"), parser.add_argument("reference")
    parser.add_argument("--single"), parser.add_argument("--weights"), parser.add_argument("--screenshots")
    parser.add_argument("--layers", type=int, default=1, help="sets of Gaussians that the archive shows one after the other")
    args = parser.parse_args()
    archive = pathlib.Path(args.archive).read_bytes()
    address = serve(args.page, archive)
    with sync_playwright() as play:
        pages = Pages(launch(play), address, args.reference, args.screenshots)
        page, facts = loading(pages)
        playing(page)
        navigation(pages, page)
        released(page)
        wheel(page)
        command_key(page)
        layouts(page)
        held(page)
        typing(page)
        cameras(page)
        key_list(page)
        shapes(pages, page)
        webgl(pages, facts)
        lost(pages, page, facts)
        arriving(pages, page, facts, len(archive), args.layers)
        degrees(pages, page)
        errors(pages, page)
        calls(pages)
        told_once(pages)
        refused(pages)
        small_textures(pages)
        sizes(pages)
        freed(pages)
        half_arrived(pages)
        cancelled(pages)
        out_of_memory(pages)
        few_degrees(pages)
        one_gaussian(pages)
        remarks(pages)
        opened_early(pages)
        opened_meanwhile(pages)
        fetched_meanwhile(pages)
        second_player(pages)
        destroyed(pages, facts)
        hopeless(pages)
        broken_module(pages)
        missing_files(pages)
        drop(page, facts)
        pages.quiet("dropping")
        page.close()
        phone(pages, args.archive)
        embedded(pages)
        focus(pages)
        low(pages)
        reduced_motion(pages)
        reloaded(pages)
        frames(pages)
        several(pages)
        for file, name in ((args.single, "single"), (args.weights, "weights")):
            if file:
                from_disk(pages, pathlib.Path(file).resolve(), name, facts)
        if args.single:
            incomplete(pages, pathlib.Path(args.single))
        pages.browser.close()
    say("all checks passed")


def loading(pages):
    """Loads, and agrees with the tile renderer."""
    began = time.time()
    page = pages.open(f"?src={MODEL}")
    facts = page.evaluate("cc4dgs.facts")
    assert facts and facts["gaussians"] > 0 and facts["frames"] > 1, facts
    say(f"loaded {facts['gaussians']} Gaussians, {facts['moving']} of them moving, {facts['frames']} frames, {time.time() - began:.1f} s after opening the page")
    assert any(r and r.startswith("bytes=") for _, r in Handler.requests)
    pages.agree(page, "WebGPU")
    return page, facts


def playing(page):
    """Plays, pauses, seeks, steps."""
    page.evaluate("cc4dgs.seek(0); window.times = []; cc4dgs.on('time', e => times.push(e.time)); cc4dgs.play()")
    page.wait_for_function("times.length > 3")
    page.evaluate("cc4dgs.pause()")
    # A short sequence may have begun again.
    assert page.evaluate("new Set(times).size === times.length")
    rates = page.evaluate("""async () => { const g = cc4dgs.gpu; const n = 5, began = performance.now();
        for (let i = 0; i < n; i++) { cc4dgs.seek(i / n); cc4dgs.draw(); await g.countVisible(); } return (performance.now() - began) / n; }""")
    say(f"plays; {rates:.1f} ms per frame at {page.evaluate('cc4dgs.ui.canvas.width')}x{page.evaluate('cc4dgs.ui.canvas.height')} on SwiftShader")
    slider = page.get_by_label("Time", exact=True)
    for plays in (True, False):
        slider.press(" ")
        assert page.evaluate("cc4dgs.playing") == plays, "Space on the time slider does not play and pause"
    slider.fill("0.5")
    assert abs(page.evaluate("cc4dgs.time") - 0.5) < 1e-3
    frame = page.evaluate("cc4dgs.gpu.frame")
    slider.press("ArrowRight")
    assert page.evaluate("cc4dgs.gpu.frame") == frame + 1, "an arrow key on the slider is a frame"
    page.get_by_label("One frame back").press(" ")
    assert page.evaluate("cc4dgs.gpu.frame") == frame and not page.evaluate("cc4dgs.playing"), "Space on a button presses it alone"
    page.locator("canvas").focus()
    page.keyboard.press(".")
    assert page.evaluate("cc4dgs.time") > 0.5 and not page.evaluate("cc4dgs.playing")
    page.keyboard.press(" ")
    assert page.evaluate("cc4dgs.playing")
    page.keyboard.press(" ")
    say("the slider, single steps and the keyboard work")


def navigation(pages, page):
    """The mouse, reset, links."""
    pose = page.evaluate(POSE)
    # Where a frame takes seconds, the wheel is heard of later than the next key.
    page.evaluate("window.wheeled = new Promise(r => cc4dgs.ui.canvas.addEventListener('wheel', r, { once: true })).then(() => 0); 0")
    page.mouse.move(600, 300), page.mouse.down(), page.mouse.move(700, 340, steps=4), page.mouse.up(), page.mouse.wheel(0, -300)
    page.evaluate("wheeled")
    moved = page.evaluate(POSE)
    assert apart(pose, moved) > 0.05
    link = page.evaluate("cc4dgs.link()")
    page.keyboard.press("r")
    assert apart(pose, page.evaluate(POSE)) < 1e-6
    other = pages.open("?" + link.split("?", 1)[1])
    # Angle and aspect of a link are those of the window; `shapes` checks them.
    assert apart(moved[:6], other.evaluate(POSE)[:6]) < 1e-3
    assert abs(other.evaluate("cc4dgs.time") - page.evaluate("cc4dgs.time")) < 1e-4
    followed(other, pose)
    other.close()
    # In a frame of `srcdoc` the address cannot be changed.
    page.evaluate("history.replaceState = () => { throw new DOMException('no', 'SecurityError'); }; 0")
    text = page.evaluate(COPY)
    page.evaluate("delete history.replaceState")
    assert text in ("Copied", "Not copied"), text
    say("dragging orbits, the wheel zooms, R resets, a shared link restores time and pose")


def followed(page, pose):
    """A link to the page that is opened in it, which changes the hash alone, is followed; by a player that is a part of the page it is not."""
    page.evaluate("""async source => { const { createPlayer } = await import("./player.js"), element = document.body.appendChild(document.createElement("div"));
        window.part = await createPlayer(element, { src: source }); window.changes = 0; window.addEventListener("hashchange", () => { changes++; }); }""", MODEL)
    stays = page.evaluate("part.time")
    aim = 0.25 if stays > 0.5 else 0.75
    page.evaluate(COPY)
    assert page.evaluate("location.href === cc4dgs.link()"), "the address is not the link that was copied"
    page.evaluate("hash => { location.hash = hash; }", f"t={aim}&pose={','.join(map(str, pose))}")
    page.wait_for_function("changes > 0")
    assert abs(page.evaluate("cc4dgs.time") - aim) < 1e-4 and apart(pose, page.evaluate(POSE)) < 1e-3, "a link that changes the hash alone is not followed"
    assert page.evaluate("changes") == 1, "copying a link is a jump"
    assert page.evaluate("part.time") == stays, "a player that is a part of the page follows its links"
    page.evaluate("part.destroy()")


def webgl(pages, facts):
    """WebGL2, where there is no WebGPU."""
    page = pages.open(f"?src={MODEL}&backend=webgl")
    assert page.evaluate("!!cc4dgs.gl && cc4dgs.facts.gaussians") == facts["gaussians"]
    pages.agree(page, "WebGL2")
    kept = page.evaluate("[0, 1].map(k => cc4dgs.gpu.plainFloats(k).length + cc4dgs.gpu.plainWords(k).length)")
    assert kept == [0, 0], f"arrays that WebGL2 has stay in the memory of WebAssembly, too: {kept} numbers"
    page.evaluate("cc4dgs.play()")
    page.wait_for_function("cc4dgs.time > 0")
    page.evaluate("cc4dgs.pause()")
    sorting(pages, page)
    page.evaluate("cc4dgs.reset()")
    pages.shot(page, "laptop_webgl")
    page.evaluate("""() => { window.recovered = new Promise(r => cc4dgs.on('recovered', r)); const e = cc4dgs.gl.gl.getExtension('WEBGL_lose_context');
        e.loseContext(); setTimeout(() => e.restoreContext(), 200); }""")
    page.evaluate("recovered")
    pages.agree(page, "WebGL2 after a lost context")
    page.evaluate("window.recovered = new Promise(r => cc4dgs.on('recovered', r)); window.losing = cc4dgs.gl.gl.getExtension('WEBGL_lose_context'); 0")
    captured = page.evaluate("(losing.loseContext(), cc4dgs.capture().then(() => 'it is drawn', e => e.message))")
    assert "no graphics device" in captured, f"an image of a lost context: {captured}"
    page.wait_for_function("document.querySelector('[role=alert]')?.innerText.includes('not given WebGL2 back')")
    page.evaluate("losing.restoreContext(); recovered")
    assert page.locator("[role=alert]").count() == 0 or page.locator(".note").is_hidden(), "the message stays after the context was restored"
    assert page.evaluate("!!cc4dgs.gl.sorter.worker")
    page.close()
    pages.quiet("WebGL2")


def lost(pages, page, facts):
    """A lost device comes back with the model, at the same time."""
    before = page.evaluate("cc4dgs.time")
    page.evaluate("window.recovered = new Promise(r => cc4dgs.on('recovered', r)); cc4dgs.gpu.loseDevice()")
    page.evaluate("recovered")
    assert page.evaluate("cc4dgs.facts.gaussians") == facts["gaussians"] and abs(page.evaluate("cc4dgs.time") - before) < 1e-6
    assert page.evaluate("cc4dgs.capture().then(p => p.data.some(v => v > 60 && v < 255))")
    say("a lost device is recovered")
    page.get_by_label("Settings").first.click()
    page.wait_for_function("document.querySelector('.stats').textContent.includes('Gaussians')")
    pages.shot(page, "laptop_settings")
    page.get_by_label("Tint what moves").check(), page.get_by_label("Depth").check()
    pages.shot(page, "laptop_depth")
    page.get_by_label("Depth").uncheck()
    pages.shot(page, "laptop_tint")
    page.get_by_label("Tint what moves").uncheck()
    page.keyboard.press("Escape")
    pages.shot(page, "laptop")
    pages.quiet("use of the page")


def arriving(pages, page, facts, total, least_layers):
    """Without ranges, and slowly: Gaussians, then their motion, then their harmonics. In the end the image is that of the whole file."""
    page.evaluate(f"cc4dgs.load('{MODEL}').then(() => 0)")
    pose = page.evaluate(POSE)
    whole = page.evaluate(IMAGE, pose)
    for name in ("plain", "slow"):
        page.evaluate("window.steps = []; cc4dgs.on('progress', e => steps.push([e.bytes, cc4dgs.facts?.frames ?? 0])); 0")
        loaded = page.evaluate(f"cc4dgs.load('/{name}.cc4d')")
        assert loaded["frames"] == facts["frames"], loaded
        assert page.evaluate(IMAGE, pose) == whole, f"{name}: the image is another one"
    fetched = page.evaluate("cc4dgs.received")
    assert page.evaluate("steps.some(([, frames]) => frames === 1) && steps.at(-1)[1] <= cc4dgs.facts.frames")
    # The last is another site for the browser, and compresses.
    other_site = pages.address.replace("127.0.0.1", "localhost")
    for source in ("/tagged.cc4d", "/gzip.cc4d", f"{other_site}/gzip.cc4d"):
        assert page.evaluate("source => cc4dgs.load(source)", source)["frames"] == facts["frames"]
        assert page.evaluate(IMAGE, pose) == whole, f"{source}: the image is another one"
    assert total <= 65536 or "/tagged.cc4d" in Handler.broken, "no connection broke"
    pages.complaints[:] = [c for c in pages.complaints if "net::ERR_" not in c]
    for backend in ("", "?backend=webgl"):
        other = pages.open(backend)
        other.evaluate(STAGES, 0)
        other.evaluate("cc4dgs.load('/slow-plain.cc4d').then(() => 0)")
        stages = other.evaluate("stages")
        # Gaussians in colours of degree 0, then with their motion, then higher degrees up to all (255); those that the next ones overtake are left out.
        layers = [layer for layer, motion, _ in stages if not motion]
        shown = [degree for _, motion, degree in stages if motion]
        assert [rest for _, *rest in stages] == [[False, 0]] * len(layers) + [[True, degree] for degree in shown], stages
        assert shown == sorted(set(shown)) and len(shown) > 1 and shown[-1] == 255, stages
        # The most important Gaussians before the others, where the codec has layers.
        assert layers and layers == sorted(set(layers)) and layers[-1] == 255 and len(layers) >= least_layers, stages
        if backend:
            pages.agree(other, "WebGL2, harmonics last")
        else:
            assert other.evaluate(IMAGE, pose) == whole, "harmonics that came last give another image"
        other.close()
    say(f"servers without ranges work; slow ones show Gaussians, motion, harmonics; {fetched} of {total} bytes were fetched")
    pages.quiet("loading")


def degrees(pages, page):
    """Each degree of the harmonics is shown, but not one that the next overtakes."""
    pose = page.evaluate(POSE)
    whole = page.evaluate(IMAGE, pose)
    for patient in (True, False):
        other = pages.open()
        other.evaluate(STAGES, 0 if patient else 1000)
        arrived = other.evaluate(STEPS, [MODEL, patient])
        stages = other.evaluate("stages")
        assert len(arrived) > 1, f"harmonics arrive in one piece: {arrived}"
        assert stages == [[255, True, degree] for degree in [0, *(arrived[:-1] if patient else []), 255]], stages
        assert other.evaluate(IMAGE, pose) == whole, "harmonics that came degree by degree give another image"
        other.close()
    say(f"harmonics are shown degree by degree, in {len(arrived)} steps where each takes its time")
    pages.quiet("degrees")


def errors(pages, page):
    """Damage is a sentence."""
    for name, said in {"damaged": "", "hostile": "", "cut": "", "text": "", "vast": "", "missing": "404", "empty": "is empty"}.items():
        message = page.evaluate(f"cc4dgs.load('/{name}.cc4d').then(() => 'it loaded', e => e.message)")
        assert len(message) > 20 and message != "it loaded" and "RuntimeError" not in message and said in message, f"{name}: {message}"
        shown = page.locator("[role=alert]").inner_text()
        assert message[:20] in shown, shown
        say(f"{name}: {message}")
    pages.shot(page, "laptop_error")
    message = page.evaluate("cc4dgs.capture({ width: 8 }).then(() => 'it is drawn', e => e.message)")
    assert message.startswith("camera of an image") and "world_to_camera" in message, message
    # Missing and empty files are errors of the network that the browser itself logs.
    pages.complaints[:] = [c for c in pages.complaints if "404" not in c and "416" not in c]
    pages.quiet("errors")


def phone(pages, archive):
    """A phone: the file picker, and fingers."""
    context = pages.browser.new_context(viewport={"width": 390, "height": 844}, device_scale_factor=2, has_touch=True, is_mobile=True)
    page = pages.watch(context.new_page())
    page.goto(f"{pages.address}/index.html")
    page.wait_for_function("window.cc4dgs !== undefined")
    pages.shot(page, "phone_empty")
    page.set_input_files("input[type=file]", archive)
    page.wait_for_function("cc4dgs.facts && cc4dgs.facts.frames > 1")
    page.evaluate("cc4dgs.seek(0.4)")
    pages.shot(page, "phone")
    say("the file picker works, at phone width too")
    touch(page)
    pages.quiet("the phone")
    context.close()


def from_disk(pages, path, name, facts):
    """One HTML file, opened from disk without a network."""
    context = pages.browser.new_context(viewport={"width": 1280, "height": 800}, offline=True)
    for backend in ("", "?backend=webgl"):
        page = pages.watch(context.new_page())
        fetched = []
        page.on("request", lambda r: fetched.append(r.url) if not r.url.startswith(("data:", "blob:")) else None)
        began = time.time()
        page.goto(path.as_uri() + backend)
        page.wait_for_function("window.cc4dgs?.facts")
        found = page.evaluate("cc4dgs.facts")
        assert found["gaussians"] == facts["gaussians"] and found["frames"] > 1 and found["moving"] > 0 and not found["lacksMotion"], found
        assert bool(backend) == page.evaluate("!!cc4dgs.gl")
        say(f"{path.name}, {path.stat().st_size / 1e6:.2f} MB: opened from disk without a network in {time.time() - began:.1f} s, {page.title()!r}")
        page.wait_for_function("cc4dgs.playing && cc4dgs.time > 0")
        page.evaluate("cc4dgs.pause()")
        pages.agree(page, f"the file {path.name}" + (", WebGL2" if backend else ""))
        assert len(fetched) == 1, f"it fetched {fetched}"
        page.evaluate("cc4dgs.seek(0.5)")
        if backend:
            page.wait_for_function("cc4dgs.gl.settled && !cc4dgs.dirty")
            assert page.evaluate("!!cc4dgs.gl.sorter.worker"), "the worker does not start in a file"
        pages.shot(page, name + ("_webgl" if backend else ""))
        page.reload()
        page.wait_for_function("window.cc4dgs?.facts")
        assert abs(page.evaluate("cc4dgs.time") - 0.5) < 1e-6 and not page.evaluate("cc4dgs.playing"), "a file that is loaded again does not go on as it was"
        page.close()
    context.close()
    pages.quiet(f"the file {path.name}")


if __name__ == "__main__":
    main()
