"""Checks of browser.py: files that are dropped, fingers on a screen, wheels, keys, low windows, and reduced motion."""
import math
from browser_pages import MODEL, PATIENCE_MS, say

POSE = "Array.from(cc4dgs.gpu.pose)"


def drop(page, facts):
    """A file that is dragged over the page and dropped is opened."""
    files = page.evaluate_handle("""async address => { const bytes = await (await fetch(address)).arrayBuffer(), files = new DataTransfer();
        files.items.add(new File([bytes], "dropped.cc4d")); return files; }""", MODEL)
    page.evaluate("window.opened = null; cc4dgs.on('loaded', facts => { opened = facts; }); 0")
    for event in ("dragenter", "dragover"):
        page.dispatch_event(".cc canvas", event, {"dataTransfer": files})
    assert page.locator(".cc.dropping").count() == 1, "nothing says that a file can be dropped"
    page.dispatch_event(".cc canvas", "drop", {"dataTransfer": files})
    page.wait_for_function("opened")
    opened = page.evaluate("opened")
    assert page.locator(".cc.dropping").count() == 0
    assert opened["gaussians"] == facts["gaussians"] and opened["frames"] == facts["frames"], opened
    assert page.evaluate("cc4dgs.source.name") == "dropped.cc4d" and page.title().startswith("dropped.cc4d")
    assert "src=" not in page.evaluate("cc4dgs.link()"), "the link of a file without an address names another one"
    text = page.evaluate_handle("() => { const text = new DataTransfer(); text.setData('text/plain', 'no file'); return text; }")
    page.dispatch_event(".cc canvas", "drop", {"dataTransfer": text})
    assert "Only files" in page.locator(".note").inner_text(), "nothing is said of what is no file"
    page.locator(".cc canvas").focus()
    page.keyboard.press("Escape")
    assert page.locator(".note").is_hidden(), "Escape does not close what is said"
    share = page.evaluate("""async () => { const share = [...document.querySelectorAll(".panel button")].find(b => b.textContent === "Copy link");
        await share.onclick(); return document.querySelector(".note").innerText; }""")
    assert "not the file" in share, f"nothing says that a link lacks the file that was dropped: {share!r}"
    page.keyboard.press("Escape")
    say("a file that is dropped on the page is opened; what is no file is refused with a message")


def released(page):
    """A pointer whose capture ends turns nothing any more: nobody tells when it is up."""
    page.evaluate("cc4dgs.reset(); cc4dgs.ui.canvas.addEventListener('pointerdown', e => { window.pressed = e.pointerId; }, { once: true })")
    # A browser begins and ends a capture at the event after it was asked for.
    page.mouse.move(600, 300), page.mouse.down(), page.mouse.move(605, 300)
    page.evaluate("window.heard = new Promise(done => cc4dgs.ui.canvas.addEventListener('pointermove', done, { once: true })).then(() => 0); cc4dgs.ui.canvas.releasePointerCapture(pressed)")
    before = page.evaluate(POSE)
    page.mouse.move(700, 340)
    page.evaluate("heard")
    after = page.evaluate(POSE)
    page.mouse.up()
    assert before == after, "a pointer that lost its capture turns the view"
    say("a pointer that lost its capture turns nothing")


def wheel(page):
    """A notch zooms as far in pixels, in lines and in pages."""
    arms = []
    for mode, delta in ((0, 100), (1, 3), (2, 1)):
        page.evaluate("cc4dgs.reset()")
        page.evaluate("([deltaMode, deltaY]) => cc4dgs.ui.canvas.dispatchEvent(new WheelEvent('wheel', { deltaMode, deltaY, cancelable: true }))", [mode, delta])
        arms.append(length(arm(page.evaluate(POSE))))
    page.evaluate("cc4dgs.reset()")
    rest = length(arm(page.evaluate(POSE)))
    assert max(arms) / min(arms) < 1 + 1e-6 and arms[0] > 1.1 * rest, arms
    # A pinch on a touch pad: Chromium tells 100 times the logarithm of its factor, in many events, and Safari the factor since it began.
    pinches = {"Chromium": "Array.from({ length: 10 }, () => new WheelEvent('wheel', { ctrlKey: true, deltaY: -10 * Math.log(2), cancelable: true }))",
               "Safari": "[1, 1.5, 2].map((scale, k) => Object.assign(new Event(k ? 'gesturechange' : 'gesturestart', { cancelable: true }), { scale }))"}
    for browser, events in pinches.items():
        prevented = page.evaluate(f"{events}.every(e => !cc4dgs.ui.canvas.dispatchEvent(e))")
        pinched = rest / length(arm(page.evaluate(POSE)))
        assert prevented and abs(pinched - 2) < 1e-3, f"{browser}: fingers that part to twice their distance on a touch pad come {pinched:.3f} times nearer"
        page.evaluate("cc4dgs.reset()")
    say("a notch of the wheel zooms as far in pixels, lines and pages, and a touch pad as far as the fingers part")


def command_key(page):
    """A key that is released while Cmd is held, of which macOS does not tell, is not held for ever."""
    key = "([name, key, metaKey]) => document.body.dispatchEvent(new KeyboardEvent(name, { key, metaKey, bubbles: true, cancelable: true }))"
    holds = "cc4dgs.flyKeys(0)"
    for name, pressed, meta in (("keydown", "Meta", True), ("keydown", "c", True), ("keyup", "Meta", False)):
        page.evaluate(key, ["keydown", "w", False])
        assert page.evaluate(holds), "W does not fly"
        page.evaluate(key, [name, pressed, meta])
        assert not page.evaluate(holds), f"W flies on after {name} of {pressed}"
    say("keys are not held any more once Cmd is")


def layouts(page):
    """Letters have their positions on layouts without Latin letters, else what they type."""
    send = "([name, key, code]) => document.body.dispatchEvent(new KeyboardEvent(name, { key, code, bubbles: true, cancelable: true }))"
    for key, code, flies in (("ц", "KeyW", True), ("Ц", "KeyW", True), ("w", "KeyZ", True), ("ц", "", False)):
        page.evaluate(send, ["keydown", key, code])
        assert page.evaluate("cc4dgs.flyKeys(0)") == flies, f"{key} at {code} {'does not fly' if flies else 'flies'}"
        # The layout was changed meanwhile.
        page.evaluate(send, ["keyup", "x", code])
        assert not page.evaluate("cc4dgs.flyKeys(0)"), f"{key} at {code} flies on"
    for key, code in (("а", "KeyF"), ("f", "KeyY")):
        before = page.evaluate("cc4dgs.flying")
        page.evaluate(send, ["keydown", key, code])
        assert page.evaluate("cc4dgs.flying") != before, f"{key} at {code} switches nothing"
    say("letters act on keyboards without Latin letters, too")


def held(page):
    """A key that is held down switches once, and steps again and again."""
    key = "([key, repeat]) => document.body.dispatchEvent(new KeyboardEvent('keydown', { key, repeat, bubbles: true, cancelable: true }))"
    for repeat, flies in ((False, True), (True, True), (True, True), (False, False)):
        page.evaluate(key, ["f", repeat])
        assert page.evaluate("cc4dgs.flying") == flies, "F that is held down switches again and again"
    page.evaluate("cc4dgs.seek(0)")
    for repeat in (False, True):
        page.evaluate(key, [".", repeat])
    assert page.evaluate("cc4dgs.gpu.frame === Math.min(2, cc4dgs.facts.frames - 1)"), "a full stop that is held down does not step on"
    say("a key that is held down switches once, or steps on")


def typing(page):
    """Keys that a text field of the page takes do not reach the player."""
    taken = page.evaluate("""() => [["input", {}], ["textarea", {}], ["div", { contentEditable: "true" }]].map(([tag, own]) => {
        const field = document.body.appendChild(Object.assign(document.createElement(tag), own));
        const typed = field.dispatchEvent(new KeyboardEvent("keydown", { key: "w", code: "KeyW", bubbles: true, cancelable: true }));
        field.remove();
        return !typed || cc4dgs.flyKeys(0); })""")
    assert not any(taken), f"the player takes the keys of a text field: {taken}"
    # Chromium tells of a field that it fills in by such events. What a listener throws is a complaint.
    page.evaluate("['keydown', 'keyup'].forEach(name => document.body.dispatchEvent(new Event(name, { bubbles: true, cancelable: true })))")
    say("text fields beside the player keep their keys")


def cameras(page):
    """The list of cameras says where the view is from, so that the same camera can be chosen again."""
    chosen = "document.querySelector('.panel select').selectedOptions[0].textContent"
    page.keyboard.press("r")
    home = page.evaluate(POSE)
    assert page.evaluate(chosen) == "Home", page.evaluate(chosen)
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(chosen) == "Free view", page.evaluate(chosen)
    turned = page.evaluate(POSE)
    assert length([a - b for a, b in zip(arm(home), arm(turned))]) > 1e-3 * length(arm(home)), "an arrow key does not orbit"
    page.evaluate("cc4dgs.goTo(-1)")
    assert page.evaluate(chosen) == "Home" and page.evaluate(POSE) == home
    # Flying, arrow keys turn the view where the eye is.
    page.keyboard.press("f"), page.keyboard.press("ArrowLeft")
    looked = page.evaluate(POSE)
    page.keyboard.press("f"), page.keyboard.press("r")
    eye, target = (length([a - b for a, b in zip(home[k:k + 3], looked[k:k + 3])]) for k in (0, 3))
    assert eye < 1e-6 * length(arm(home)) < 1e-3 * target, f"an arrow key moves the eye by {eye} and its target by {target} while flying"
    say("the list of cameras follows the view; arrow keys orbit, and look around while flying")


def key_list(page):
    """The question mark lists the keys, and Escape closes the list."""
    page.keyboard.press("?")
    opened = "document.querySelector('.panel details').open"
    assert page.evaluate(opened) and "W A S D" in page.locator(".panel details").inner_text(), "there is no list of keys"
    assert page.evaluate("document.activeElement.tagName") == "SUMMARY"
    plays = page.evaluate("cc4dgs.playing")
    page.keyboard.press(" ")
    assert not page.evaluate(opened) and page.evaluate("cc4dgs.playing") == plays, "Space does not close the list alone"
    page.keyboard.press("Escape")
    assert page.locator(".panel").is_hidden() and page.evaluate("document.activeElement.ariaExpanded") == "false"
    page.locator(".cc canvas").focus()
    say("the question mark lists the keys")


def focus(pages):
    """The keyboard's focus on the view is seen."""
    page = pages.open()
    page.keyboard.press("Tab")
    found = page.evaluate("[document.activeElement.tagName, getComputedStyle(document.activeElement).outlineStyle]")
    assert found == ["CANVAS", "solid"], f"the focus is not seen: {found}"
    page.close()
    pages.quiet("the focus")
    say("the focus on the view is seen")


def reduced_motion(pages):
    """Where the system asks for less motion, nothing starts by itself."""
    page = pages.watch(pages.browser.new_page(reduced_motion="reduce"))
    page.goto(f"{pages.address}/index.html?src={MODEL}&autoplay")
    page.wait_for_function("window.cc4dgs?.facts")
    assert not page.evaluate("cc4dgs.playing") and page.evaluate("cc4dgs.time") == 0
    page.evaluate("cc4dgs.play()")
    assert page.evaluate("cc4dgs.playing")
    page.close()
    pages.quiet("reduced motion")
    say("with reduced motion the page does not start by itself")


def arm(pose):
    """From the orbited point to the eye."""
    return [pose[k] - pose[3 + k] for k in range(3)]


def length(vector):
    return math.sqrt(sum(v * v for v in vector))


def touch(page):
    """One finger orbits, two that part zoom in. The page must be that of a touch screen, with a model."""
    devtools = page.context.new_cdp_session(page)
    canvas = page.locator(".cc canvas").bounding_box()
    x, y = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2

    def fingers(kind, *points):
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x + dx, "y": y + dy, "id": n} for n, (dx, dy) in enumerate(points)]})

    def gesture(*paths):
        """Fingers along straight paths, from and to; the poses before and after."""
        before = page.evaluate(POSE)
        page.evaluate("window.lifted = false; cc4dgs.ui.canvas.addEventListener('pointerup', () => { lifted = true; }, { once: true })")
        steps = 8
        at = lambda k: [(a[0] + (b[0] - a[0]) * k / steps, a[1] + (b[1] - a[1]) * k / steps) for a, b in paths]
        fingers("touchStart", *at(0))
        for k in range(1, steps + 1):
            fingers("touchMove", *at(k))
        fingers("touchEnd")
        page.wait_for_function("lifted")
        return before, page.evaluate(POSE)

    page.evaluate("cc4dgs.reset()")
    before, after = gesture(((-40, 0), (40, 0)))
    (a, b), moved = (arm(before), arm(after)), length([p - q for p, q in zip(before[3:6], after[3:6])])
    turned = math.acos(sum(p * q for p, q in zip(a, b)) / (length(a) * length(b)))
    # 4 radians per height of the canvas; away from the equator the eye moves along a smaller circle.
    wanted = 4 * 80 / canvas["height"]
    assert moved < 1e-6 and abs(length(a) / length(b) - 1) < 1e-6, "orbiting moved the orbited point or changed the distance"
    assert 0.3 * wanted < turned < 1.1 * wanted, f"one finger turned {turned:.3f} rad, {wanted:.3f} was expected at the equator"

    before, after = gesture(((-50, 0), (-100, 0)), ((50, 0), (100, 0)))
    nearer = length(arm(before)) / length(arm(after))
    assert abs(nearer - 2) < 0.1, f"two fingers came {nearer:.2f} times nearer instead of 2"
    assert abs(sum(p * q for p, q in zip(arm(before), arm(after))) / (length(arm(before)) * length(arm(after))) - 1) < 1e-6, "pinching turned the camera"
    before, after = gesture(((-50, 0), (-20, 0)), ((50, 0), (80, 0)), ((0, 60), (30, 60)))
    aligned = sum(p * q for p, q in zip(arm(before), arm(after))) / (length(arm(before)) * length(arm(after)))
    assert abs(aligned - 1) < 1e-6, "a third finger turns the camera"
    page.evaluate("cc4dgs.reset()")
    say(f"one finger orbits ({turned:.2f} rad), two that part come nearer ({nearer:.2f} times)")


def low(pages):
    """In a low frame the settings open and close, all of a message can be read, and another file can be opened."""
    page = pages.open(f"?src={MODEL}", size=(320, 180))
    gear = page.get_by_label("Settings and help")
    gear.click()
    height = page.evaluate("document.querySelector('.panel').clientHeight")
    assert height > 120, f"the settings are {height} pixels high"
    # Escape closes them from a list, too.
    page.locator(".panel select").first.focus()
    page.keyboard.press("Escape")
    assert page.locator(".panel").is_hidden(), "Escape does not close the settings from a list"
    gear.click(), gear.click()
    assert page.locator(".panel").is_hidden(), "the button does not close the settings"
    page.close()
    page = pages.open("?src=/text.cc4d", size=(320, 180))
    fits, free = page.evaluate("""(() => { const box = document.querySelector(".note").getBoundingClientRect(), open = document.querySelector(".open"), at = open.getBoundingClientRect();
        const above = document.elementFromPoint(at.x + at.width / 2, at.y + at.height / 2);
        return [box.top >= 0 && box.bottom <= innerHeight && box.height > 40, open.contains(above)]; })()""")
    assert fits and free, f"a message fits into the frame: {fits}, and leaves the button to open another file: {free}"
    page.close()
    pages.quiet("low windows")
    say("in a frame of 320x180 the settings and messages can be used")


def embedded(pages):
    """In an iframe of 480x320 the page loads and plays."""
    page = pages.watch(pages.browser.new_page(viewport={"width": 800, "height": 600}))
    page.goto(f"{pages.address}/embedding.html")
    frame = page.frames[1]
    frame.wait_for_function("window.cc4dgs?.facts && cc4dgs.playing && cc4dgs.time > 0", timeout=PATIENCE_MS)
    size = frame.evaluate("[cc4dgs.ui.canvas.width, cc4dgs.ui.canvas.height, cc4dgs.facts.frames]")
    assert size[:2] == [480, 320] and size[2] > 1, size
    frame.evaluate("cc4dgs.pause()")
    pages.shot(page, "iframe")
    page.close()
    pages.quiet("the iframe")
    say("in an iframe of 480x320 the page loads and plays")
