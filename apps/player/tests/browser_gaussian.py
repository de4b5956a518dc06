"""Checks of browser.py: a model of one Gaussian."""
import gzip, math, struct
from browser_pages import say

# Opens one Gaussian at the origin with these standard deviations along x, y and z.
OPEN = """async sigmas => { const names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(" ");
    const head = `ply\\nformat binary_little_endian 1.0\\nelement vertex 1\\n${names.map(name => `property float ${name}\\n`).join("")}end_header\\n`;
    const values = new Float32Array([0, 0, 0, 1.77, 1.77, 1.77, 3, ...sigmas.map(v => Math.log(v)), 1, 0, 0, 0]);
    await cc4dgs.load(new File([head, values], "one.ply")); }"""
# One Gaussian as an SPZ file of version 2, whose header says that vendor extensions follow: position, opacity, colour, scale and rotation.
EXTENDED = gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 2, 1, 0, 12, 2, 0) + bytes(9) + bytes([255] + [200] * 3 + [120] * 3 + [128] * 3))
# Opens these bytes; returns the warnings, and what the page says.
WARNED = """async bytes => { const warned = []; cc4dgs.on("warning", e => warned.push(e.message));
    await cc4dgs.load(new File([new Uint8Array(bytes)], "one.spz"));
    const note = document.querySelector(".note"); return [warned, note.hidden ? "" : note.querySelector("p").textContent]; }"""
BRIGHTEST = "cc4dgs.capture().then(({ data }) => data.reduce((most, v, i) => (i % 4 < 3 ? Math.max(most, v) : most), 0))"
PIXEL = "async ([camera, x, y]) => { const { width, data } = await cc4dgs.capture(camera, 0); return data[4 * (y * width + x)]; }"
# From (3, 0, 0) to the origin; columns are along y, rows along z.
FOCAL = 100 / math.tan(0.4)
CAMERA = {"name": "t", "width": 200, "height": 100, "fx": FOCAL, "fy": FOCAL, "cx": 100, "cy": 50,
          "world_to_camera": [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 3], [0, 0, 0, 1]]}


def one_gaussian(pages):
    """A single Gaussian is seen from where the page begins, and one along the axes of the image is drawn whole."""
    pixel = 3 / FOCAL
    for backend in ("", "?backend=webgl"):
        page = pages.open(backend)
        page.evaluate(OPEN, [0.05, 0.05, 0.05])
        brightest = page.evaluate(BRIGHTEST)
        assert brightest > 150, f"a single Gaussian is not seen: at most {brightest}"
        assert page.evaluate("cc4dgs.gl?.capacity ?? 1") == 1, "the order of a single Gaussian takes more memory"
        for key in ("End", ".", " "):
            page.keyboard.press(key)
        still = page.evaluate("[cc4dgs.time, cc4dgs.playing, document.querySelector('.bar output').textContent]")
        assert still == [0, False, "still"] and page.get_by_label("Play", exact=True).is_disabled(), f"keys move the time of a single frame: {still}"
        for step in range(24):
            # Its square is just below a power of two, and over it with that of the height: there sums are rounded most.
            width = 30 + 0.07 * step
            page.evaluate(OPEN, [1e-4, width * pixel, 15 * pixel])
            found = page.evaluate(PIXEL, [CAMERA, 100 + int(2 * width), 50])
            assert 25 < found < 45, f"a Gaussian {width} pixels wide is {found} two standard deviations from its middle"
        page.close()
    pages.quiet("one Gaussian")
    say("a single Gaussian is seen, and drawn whole")


def remarks(pages):
    """What the page does not read of a file is said, and told to those who listen."""
    page = pages.open()
    warned, said = page.evaluate(WARNED, list(EXTENDED))
    assert len(warned) == 1 and warned[0].startswith("one.spz: vendor extensions are not read") and said == warned[0], (warned, said)
    page.close()
    pages.quiet("remarks")
    say(f"what is not read of a file is said: {said}")
