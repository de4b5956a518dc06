"""Checks of browser.py: links in windows of other shapes, and pages that are loaded again, alone, in frames, with several players and without storage."""
import math
from browser_pages import MODEL, PATIENCE_MS, say

POSE = "Array.from(cc4dgs.gpu.pose)"
LOADED = "window.cc4dgs?.facts?.frames > 1"
# A page whose storage is denied.
DENIED = "Object.defineProperty(window, 'sessionStorage', { get() { throw new DOMException('denied', 'SecurityError'); } });"
# Changes time, view and settings.
CHANGE = "cc4dgs.pause(); cc4dgs.seek(0.375); cc4dgs.gpu.orbit(0.3, 0.1); cc4dgs.set('tint', true); cc4dgs.set('speed', 0.25)"


def shown(page):
    """Half of what the canvas shows at distance 1, across and down, as the link of the page says."""
    fov, _, aspect = [float(number) for number in page.evaluate("cc4dgs.gpu.poseText").split(",")][6:]
    down = math.tan(fov / 2)
    return aspect * down, down


def shapes(pages, page):
    """Whoever opens a link sees at least what its sender saw, in windows of any shape; older links, without an aspect, work."""
    page.evaluate("cc4dgs.reset()")
    home, (across, down) = page.evaluate(POSE), shown(page)
    ratio = page.evaluate("cc4dgs.ui.canvas.width / cc4dgs.ui.canvas.height")
    assert abs(across / down / ratio - 1) < 1e-5, f"a link has the aspect {across / down} of a canvas of {ratio}"
    link = page.evaluate("cc4dgs.link()")
    for size in ((390, 844), (1600, 400)):
        other = pages.open("?" + link.split("?", 1)[1], size)
        shares = [seen / sent for seen, sent in zip(shown(other), (across, down))]
        assert abs(min(shares) - 1) < 1e-4, f"a window of {size} shows {shares} of what the sender saw across and down"
        other.close()
    old = pages.open(f"?src={MODEL}#t=0.5&pose={','.join(map(str, home[:8]))}", (390, 844))
    far = max(abs(a - b) for a, b in zip(home, old.evaluate(POSE)))
    assert far < 1e-9 and abs(old.evaluate("cc4dgs.time") - 0.5) < 1e-6, f"an older link leads {far} away"
    old.close()
    pages.quiet("links")
    say("links show at least what the sender saw, in a tall and in a low window")


def state(page):
    return page.evaluate("[cc4dgs.time, cc4dgs.playing, cc4dgs.settings.tint, document.querySelector('.bar select').value]")


def reloaded(pages):
    """A page that is loaded again has settings, time and pose of before, and plays no more than it did."""
    page = pages.open(f"?src={MODEL}&autoplay")
    page.evaluate(CHANGE)
    pose = page.evaluate(POSE)
    page.reload()
    page.wait_for_function(LOADED)
    time, playing, tint, speed = state(page)
    far = max(abs(a - b) for a, b in zip(pose, page.evaluate(POSE)))
    assert far < 1e-9 and abs(time - 0.375) < 1e-6 and not playing and tint and speed == "0.25", [far, time, playing, tint, speed]
    address = page.url
    page.goto("about:blank"), page.goto(address)
    page.wait_for_function(LOADED)
    assert not page.evaluate("cc4dgs.settings.tint"), "a page that is opened anew has the state of one before"
    page.close()
    page = pages.open(f"?src={MODEL}", before=DENIED)
    page.evaluate(CHANGE)
    page.reload()
    page.wait_for_function(LOADED)
    assert not page.evaluate("cc4dgs.settings.tint"), "a page without storage keeps its state"
    page.close()
    pages.quiet("a page that is loaded again")
    say("a page that is loaded again goes on as it was; without storage it begins anew")


def frames(pages):
    """A frame goes on as it was where its page, of this site, is loaded again; one without storage begins anew, and so does one that its page loads anew."""
    for name in ("embedding", "sandboxed"):
        page = pages.watch(pages.browser.new_page(viewport={"width": 800, "height": 600}))
        page.goto(f"{pages.address}/{name}.html")
        page.frames[1].wait_for_function(LOADED, timeout=PATIENCE_MS)
        page.frames[1].evaluate(CHANGE)
        pose = page.frames[1].evaluate(POSE)
        page.reload()
        frame = page.frames[1]
        frame.wait_for_function(LOADED, timeout=PATIENCE_MS)
        time, playing, tint, speed = state(frame)
        if name == "sandboxed":
            assert not tint and speed == "1", f"a frame without storage keeps its state: {[tint, speed]}"
        else:
            far = max(abs(a - b) for a, b in zip(pose, frame.evaluate(POSE)))
            assert far < 1e-9 and abs(time - 0.375) < 1e-6 and not playing and tint and speed == "0.25", [name, far, time, playing, tint, speed]
        if name == "embedding":
            frame.evaluate("window.before = true; setTimeout(() => location.reload(), 50); 0")
            frame.wait_for_function(f"!window.before && {LOADED}", timeout=PATIENCE_MS)
            assert frame.evaluate("cc4dgs.settings.tint"), "a frame that is loaded again by itself begins anew"
            page.evaluate("(() => { const frame = document.querySelector('iframe'); frame.replaceWith(frame.cloneNode()); })()")
            page.wait_for_function("frames[0]?.cc4dgs?.facts?.frames > 1", timeout=PATIENCE_MS)
            assert not page.evaluate("frames[0].cc4dgs.settings.tint"), "a frame that its page makes anew has the state of the one before"
        page.close()
    # Chromium complains where a page leaves an answer before its end.
    pages.complaints[:] = [c for c in pages.complaints if "net::ERR_" not in c]
    pages.quiet("frames that are loaded again")
    say("a frame goes on as it was where its page of this site is loaded again; without storage it begins anew")


def several(pages):
    """Players of the same model in one page keep a time each, but not those with `remember: false`."""
    page = pages.watch(pages.browser.new_page(viewport={"width": 800, "height": 600}))
    page.goto(f"{pages.address}/several.html")
    page.wait_for_function("window.players?.length === 3")
    page.evaluate("[0.25, 0.75, 0.5].forEach((time, k) => players[k].seek(time))")
    page.reload()
    page.wait_for_function("window.players?.length === 3")
    times = page.evaluate("players.map(player => player.time)")
    assert max(abs(a - b) for a, b in zip(times, (0.25, 0.75, 0))) < 1e-6, times
    page.close()
    pages.quiet("several players that are loaded again")
    say("several players of a page that is loaded again go on as they were")
