#!/usr/bin/env python3
"""Makes the moving image of the player in the README: player_image.py PAGE ARCHIVE OUT.webp. Drives the page in Chromium (SwiftShader) through one sequence, there and
back, while it orbits, and writes the screenshots as an animated WebP. Needs playwright and Pillow, and Chromium on the path."""
import io, math, pathlib, sys
from chromium import launch, serve
from PIL import Image
from playwright.sync_api import sync_playwright

SIZE = (640, 420)
FRAMES = 24
QUALITY = 60


def main():
    page_folder, archive, out = sys.argv[1:4]
    address, _ = serve(page_folder, archive, "scene.cc4d")
    frames = []
    with sync_playwright() as play:
        browser = launch(play)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(300000)
        page.goto(f"{address}/index.html?src=scene.cc4d")
        page.wait_for_function("window.cc4dgs?.facts?.frames > 1")
        for k in range(FRAMES):
            phase = 2 * math.pi * k / FRAMES
            time, turn = 0.5 - 0.5 * math.cos(phase), 0.35 * (math.sin(phase) - math.sin(phase - 2 * math.pi / FRAMES))
            tint = 3 * FRAMES // 4 <= k
            page.evaluate("""async ([time, turn, tint]) => { cc4dgs.set("tint", tint); cc4dgs.gpu.orbit(turn, 0); cc4dgs.seek(time); cc4dgs.draw();
                await cc4dgs.gpu.countVisible(); await new Promise(requestAnimationFrame); }""", [time, turn, tint])
            frames.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        browser.close()
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=90, loop=0, quality=QUALITY, method=6)
    print(f"{out}: {pathlib.Path(out).stat().st_size / 1e3:.0f} kB, {FRAMES} frames")


if __name__ == "__main__":
    main()
