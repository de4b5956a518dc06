#!/usr/bin/env python3
"""Opens a report in Chromium and checks it: no request leaves the page, no error on the console, no drawing without axis titles, the slider moves.

    apt-get install chromium; python3 -m venv v; v/bin/pip install playwright
    v/bin/python benches/report_screenshots.py runs/sweep/report.html OUT

Writes OUT/screen-NN.png (1366 pixels wide, a screen each), OUT/report.pdf (A4 landscape), and exits with 1 if something is wrong. Look at the images: that text
can be read is for people to judge.
"""
import pathlib
import shutil
import sys

from playwright.sync_api import sync_playwright

WIDTH, HEIGHT = 1366, 1500


def main():
    page_file, out = pathlib.Path(sys.argv[1]).resolve(), pathlib.Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    # Screens of a longer report must not pass for this one's.
    for old in out.glob("screen-[0-9][0-9]*.png"):
        old.unlink()
    problems, requests = [], []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"], headless=True)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.on("console", lambda message: problems.append(f"console: {message.text}") if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: problems.append(f"script: {error}"))
        page.on("request", lambda request: requests.append(request.url) if not request.url.startswith("data:") else None)
        page.goto(page_file.as_uri())
        page.wait_for_function("document.documentElement.dataset.ready === 'yes'", timeout=60000)
        problems += [f"request to {url}" for url in requests if url != page_file.as_uri()]
        problems += page.evaluate(
            """() => {
                const wrong = [];
                for (const svg of document.querySelectorAll("figure > svg")) {
                    const titles = [...svg.querySelectorAll("text.title")].map((t) => t.textContent);
                    const wanted = svg.closest("figure").classList.contains("wide") ? 1 : 2;
                    if (titles.length !== wanted || titles.some((t) => !t.trim())) wrong.push("axis titles of " + svg.getAttribute("aria-label"));
                    const box = svg.getBoundingClientRect();
                    for (const text of svg.querySelectorAll("text")) {
                        const t = text.getBoundingClientRect();
                        if (t.left < box.left - 1 || t.right > box.right + 1 || t.top < box.top - 1 || t.bottom > box.bottom + 1)
                            wrong.push(`"${text.textContent}" leaves ${svg.getAttribute("aria-label")}`);
                    }
                }
                for (const image of document.images) if (!image.complete || image.naturalWidth === 0) wrong.push("an image is not drawn");
                if (document.documentElement.scrollWidth > innerWidth) wrong.push(`the page is ${document.documentElement.scrollWidth} pixels wide`);
                return wrong;
            }"""
        )
        sliders = page.locator(".slider input")
        if sliders.count():
            sliders.first.fill("20")
            clip = page.locator(".slider .above").first.evaluate("e => e.style.clipPath")
            if "20%" not in clip:
                problems.append(f"the slider does not move: {clip}")
            sliders.first.fill("50")
        height = page.evaluate("document.documentElement.scrollHeight")
        for number, top in enumerate(range(0, height, HEIGHT)):
            page.screenshot(path=out / f"screen-{number:02}.png", full_page=True, clip={"x": 0, "y": top, "width": WIDTH, "height": min(HEIGHT, height - top)})
        page.pdf(path=out / "report.pdf", prefer_css_page_size=True, print_background=True)
        browser.close()
    print(f"{page_file}: {height} pixels high, {len(problems)} problems")
    for problem in problems:
        print("  " + problem)
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
