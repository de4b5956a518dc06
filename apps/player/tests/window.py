"""Opens the window of `cc4dgs view` and of `cc4dgs train --view` on a virtual screen: window.py PROGRAM ARCHIVE [--screenshots FOLDER] [--iterations N].

PROGRAM is a cc4dgs with the feature `view`, ARCHIVE a baked archive that moves. Needs Xvfb, xdotool, ffmpeg, Pillow, numpy and python-xlib; Mesa's lavapipe is enough to draw.
Moves the time slider with the mouse, orbits, presses keys, switches to exact images, drops a damaged and a good file, pauses and resumes a training, and compares the
checkpoint of the watched training with that of an unwatched one. Prints a sentence per check; fails at the first that does not hold.
"""
import argparse, io, math, os, pathlib, subprocess, sys, tempfile, time
import numpy
from PIL import Image
from xclient import close, drop

SIZE = (1280, 800)
# Pixels of the window that the scene fills, whatever the panels: left, upper, right, lower.
SCENE = (300, 150, 800, 600)
PATIENCE = 240
# Width of the settings at the right.
PANEL = 120
# Where the sign of exact images lies, its background, and the colour of its text while one is computed.
SIGN = (8, 8, 420, 38)
GROUND = (27, 27, 27)
COMPUTING = (255, 143, 0)
# PSNR in dB that an exact image has at least against the player's.
LEAST_DB = 40


def say(text):
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


class Screen:
    """A virtual screen and what is on it."""

    def __init__(self):
        read, write = os.pipe()
        self.server = subprocess.Popen(["Xvfb", "-displayfd", str(write), "-screen", "0", f"{SIZE[0]}x{SIZE[1]}x24"], pass_fds=[write], stderr=subprocess.DEVNULL)
        os.close(write)
        self.display = ":" + os.read(read, 16).decode().strip()
        self.environment = {**os.environ, "DISPLAY": self.display, "WAYLAND_DISPLAY": ""}

    def tool(self, *arguments):
        return subprocess.run(["xdotool", *map(str, arguments)], env=self.environment, capture_output=True, text=True).stdout.strip()

    def start(self, *command):
        return subprocess.Popen([str(c) for c in command], env=self.environment, stdout=subprocess.DEVNULL)

    def window(self, title, process):
        """The window whose title contains `title`, in the corner of the screen and as large as it."""
        began = time.time()
        while time.time() - began < PATIENCE:
            # A window that is not mapped yet cannot have the focus; without a window manager, nobody else gives it.
            found = self.tool("search", "--onlyvisible", "--name", title).split()
            if found:
                self.tool("windowmove", found[0], 0, 0), self.tool("windowsize", found[0], *SIZE)
                time.sleep(1)
                self.tool("windowfocus", "--sync", found[0])
                time.sleep(1)
                return found[0]
            assert process.poll() is None, f"the program ended with {process.returncode} before it had a window"
            time.sleep(0.5)
        raise AssertionError("no window appeared")

    def image(self):
        grab = ["ffmpeg", "-v", "error", "-f", "x11grab", "-draw_mouse", "0", "-video_size", f"{SIZE[0]}x{SIZE[1]}", "-i", self.display, "-frames:v", "1", "-f", "image2pipe", "-c:v", "png", "-"]
        return Image.open(io.BytesIO(subprocess.run(grab, env=self.environment, capture_output=True, check=True).stdout)).convert("RGB")

    def scene(self):
        return numpy.asarray(self.image().crop(SCENE)).astype(int)

    def wait(self, holds, what, patience=30):
        """Waits until `holds(scene)`: drawing in software takes its time."""
        began = time.time()
        while time.time() - began < patience:
            if holds(self.scene()):
                return
            time.sleep(0.5)
        raise AssertionError(what)

    def drag(self, start, end):
        # Slowly: what happens within one frame is no drag, and a frame may take half a second.
        self.tool("mousemove", *start)
        time.sleep(0.6)
        self.tool("mousedown", 1)
        for k in range(1, 9):
            time.sleep(0.2)
            self.tool("mousemove", *[round(a + (b - a) * k / 8) for a, b in zip(start, end)])
        time.sleep(0.8)
        self.tool("mouseup", 1)
        time.sleep(1)


def different(a, b):
    """Mean difference of pixels, 0 to 255."""
    return float(numpy.abs(a - b).mean())


def psnr_db(a, b):
    squares = float(((a - b) ** 2).mean())
    return 10 * math.log10(255**2 / squares) if squares else math.inf


def computing(screen):
    """Whether the sign says that an exact image is being computed; `None` where there is no sign. And its pixels."""
    sign = numpy.asarray(screen.image().crop(SIGN)).astype(int)
    if (sign == GROUND).all(axis=2).sum() < 1000:
        return None, sign
    return bool((numpy.abs(sign - COMPUTING).max(axis=2) < 40).sum() > 20), sign


def message(screen, rows=(0, 24)):
    """Whether a message takes these rows of the window, in all of its width; the sign of exact images takes less."""
    return (numpy.asarray(screen.image().crop((0, rows[0], SIZE[0], rows[1]))) == GROUND).all(axis=2).mean() > 0.6


def exact(screen):
    """The scene once the sign says that the exact image is there, and does not change any more (the comparison follows the image); how long that took."""
    began, calm, before = time.time(), 0, None
    while time.time() - began < PATIENCE:
        time.sleep(0.5)
        under_way, sign = computing(screen)
        calm = calm + 1 if under_way is False and before is not None and (sign == before).all() else 0
        before = sign
        if calm == 3:
            return screen.scene(), time.time() - began
    raise AssertionError("no exact image appears")


def click_exact(screen, bar, on):
    """Clicks on the switch, the last but one of the bar, until exact images are on or off: a press of 0.8 s is no click, and a frame may take longer."""
    for _ in range(5):
        screen.tool("mousemove", SIZE[0] - 58, bar), screen.tool("click", 1)
        for _ in range(8):
            time.sleep(0.5)
            if (computing(screen)[0] is not None) == on:
                return
    raise AssertionError(f"the button does not switch exact images {'on' if on else 'off'}")


def check_exact(screen, shot, bar):
    """Switches to exact images and back, in a window that stands still."""
    screen.tool("key", "Home")
    time.sleep(1.5)
    player = screen.scene()
    assert computing(screen)[0] is None, "there is a sign of exact images before they were asked for"
    screen.tool("key", "x")
    first, took = exact(screen)
    shot("exact")
    agreement = psnr_db(player, first)
    assert agreement >= LEAST_DB, f"the exact image is {agreement:.1f} dB from the player's"
    assert different(player, first) > 0, "the exact image is the player's to the bit: nothing says that another renderer drew it"
    say(f"X shows the exact image, {agreement:.1f} dB from the player's, after {took:.1f} s")
    screen.tool("key", "t")
    time.sleep(1)
    assert different(first, screen.scene()) == 0, "T tints an exact image"
    screen.tool("key", "End")
    last, _ = exact(screen)
    # Time matters more than the renderer, so agreement says something.
    moved = psnr_db(first, last)
    assert moved < agreement - 3, f"the exact image hardly follows time: {moved:.1f} dB"
    screen.drag((640, 400), (760, 440))
    turned, _ = exact(screen)
    assert different(last, turned) > 0.5, "the exact image does not follow the camera"
    shot("exact_turned")
    click_exact(screen, bar, False)
    agreement = psnr_db(turned, screen.scene())
    assert agreement >= LEAST_DB, f"the player's image is {agreement:.1f} dB from the exact one of another camera"
    click_exact(screen, bar, True)
    exact(screen)
    say(f"exact images follow time ({moved:.1f} dB apart) and camera ({agreement:.1f} dB from the player's); the button switches them")
    screen.tool("key", "x")
    screen.tool("key", "r")
    time.sleep(1.5)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("program"), parser.add_argument("archive")
    parser.add_argument("--screenshots"), parser.add_argument("--iterations", type=int, default=200)
    args = parser.parse_args()
    screen = Screen()
    folder = tempfile.TemporaryDirectory()
    processes = []

    def shot(name):
        if args.screenshots:
            os.makedirs(args.screenshots, exist_ok=True)
            screen.image().save(os.path.join(args.screenshots, name + ".png"))

    try:
        archive = pathlib.Path(args.archive)
        viewer = screen.start(args.program, "--quiet", "view", archive)
        processes.append(viewer)
        began = time.time()
        window = screen.window(archive.name, viewer)
        screen.wait(lambda scene: scene.std() > 4, "the scene is empty", PATIENCE)
        say(f"{archive.name} is in a window after {time.time() - began:.1f} s")
        shot("view")
        # It plays; the space bar stops it.
        screen.tool("mousemove", 640, 400), screen.tool("key", "space")
        time.sleep(1.5)
        stopped = screen.scene()
        time.sleep(1.5)
        assert different(stopped, screen.scene()) < 0.05, "the space bar does not stop it"
        say("the space bar stops it")
        # The slider lies in the bar at the bottom, right of three buttons.
        bar = SIZE[1] - 16
        screen.tool("key", "Home")
        time.sleep(1.5)
        start = screen.scene()
        screen.drag((140, bar), (520, bar))
        screen.wait(lambda scene: different(start, scene) > 0.05, "the slider does not change the image")
        shot("view_slider")
        screen.tool("key", "Home")
        screen.wait(lambda scene: different(start, scene) < 0.05, "the first frame is another one now")
        say("the slider moves time, Home returns to the first frame")
        screen.drag((640, 400), (760, 440))
        screen.wait(lambda scene: different(start, scene) > 0.5, "dragging does not orbit")
        screen.tool("key", "r")
        screen.wait(lambda scene: different(start, scene) < 0.05, "R does not reset the camera")
        screen.tool("key", "t")
        screen.wait(lambda scene: different(start, scene) > 0.05, "T does not tint what moves")
        say("dragging orbits, R resets, T tints")
        for key in ("t", "End"):
            screen.tool("key", key)
        time.sleep(1.5)
        last = screen.scene()
        screen.tool("key", "comma")
        screen.wait(lambda scene: different(last, scene) > 0.05, "the comma does not go a frame back")
        screen.tool("key", "period")
        screen.wait(lambda scene: different(last, scene) < 0.05, "the full stop does not go a frame on")
        screen.tool("keydown", "w"), time.sleep(0.7), screen.tool("keyup", "w")
        screen.wait(lambda scene: different(last, scene) > 0.5, "W does not fly on")
        screen.tool("key", "r")
        say("comma and full stop step, W flies")
        check_exact(screen, shot, bar)
        # The button of the settings is the last one of the bar.
        whole = numpy.asarray(screen.image()).astype(int)
        screen.tool("mousemove", SIZE[0] - 18, bar), screen.tool("click", 1)
        time.sleep(3)
        panel = different(whole[:, SIZE[0] - PANEL :], numpy.asarray(screen.image()).astype(int)[:, SIZE[0] - PANEL :])
        assert panel > 10, "the settings do not open"
        shot("view_settings")
        say("the settings open, with statistics")
        screen.tool("key", "x")
        exact(screen)
        shot("exact_settings")
        screen.tool("key", "x")
        time.sleep(1.5)
        damaged = pathlib.Path(folder.name) / "damaged.cc4d"
        content = bytearray(archive.read_bytes())
        content[len(content) // 2] ^= 0xFF
        damaged.write_bytes(content)
        before = screen.scene()
        assert drop(screen.display, window, damaged), "the window does not take a file"
        screen.wait(lambda scene: message(screen), "nothing is said of a damaged file")
        shot("view_damaged")
        assert drop(screen.display, window, archive)
        screen.wait(lambda scene: different(before, scene) > 0.05, "a dropped archive does not play")
        assert screen.tool("search", "--name", archive.name).split() == [window], "the title does not name the file"
        say("a damaged file that is dropped is refused with a message, a good one plays")
        # Exact images of a model that plays, one of which is under way.
        screen.tool("key", "x")
        screen.wait(lambda scene: computing(screen)[0], "no exact image is computed of a dropped model")
        close(screen.display, window)
        assert viewer.wait(60) == 0, f"the window ends with {viewer.returncode}"
        say("the window ends while an exact image is computed")
        alone = pathlib.Path(folder.name) / "alone.cc4d"
        subprocess.run([args.program, "--quiet", "bake", archive, "--without-field", "--out", alone], check=True, stdout=subprocess.DEVNULL)
        viewer = screen.start(args.program, "--quiet", "view", alone)
        processes.append(viewer)
        window = screen.window(alone.name, viewer)
        screen.wait(lambda scene: scene.std() > 4, "the scene is empty", PATIENCE)
        screen.tool("mousemove", 640, 400), screen.tool("key", "space"), screen.tool("key", "x")
        time.sleep(2)
        assert computing(screen)[0] is None, "an archive without its deformer has exact images"
        screen.tool("mousemove", SIZE[0] - 58, bar), screen.tool("mousemove_relative", 1, 0)
        time.sleep(3)
        shot("exact_absent")
        close(screen.display, window)
        assert viewer.wait(60) == 0, f"the window ends with {viewer.returncode}"
        say("an archive without its deformer cannot be switched")
        changed = pathlib.Path(folder.name) / "changed.cc4d"
        changed.write_bytes(archive.read_bytes())
        viewer = screen.start(args.program, "--quiet", "view", changed)
        processes.append(viewer)
        window = screen.window(changed.name, viewer)
        screen.wait(lambda scene: scene.std() > 4, "the scene is empty", PATIENCE)
        screen.tool("mousemove", 640, 400), screen.tool("key", "space")
        time.sleep(1)
        changed.write_bytes(alone.read_bytes())
        screen.tool("key", "x")
        screen.wait(lambda scene: message(screen), "nothing is said of a file that changed")
        shot("exact_error")
        close(screen.display, window)
        assert viewer.wait(60) == 0, f"the window ends with {viewer.returncode}"
        say("an error is said in words, and the player's image is back")
        said = subprocess.run([args.program, "--quiet", "view", damaged], env=screen.environment, capture_output=True, text=True)
        assert said.returncode == 3 and "damaged.cc4d" in said.stderr, f"a damaged file ends with {said.returncode}: {said.stderr}"
        say("view of a damaged file ends with exit code 3 and a message")

        def train(name, *more):
            out = pathlib.Path(folder.name) / name
            command = [args.program, "--quiet", "train", "--scene", "procedural:tiny", "--preset", "demo+cdf-basis", "--device", "flex", "--out", out]
            sets = [f"train.iterations={args.iterations}", "train.dynamic=all", "train.checkpoint_every=0", "train.checks=false"]
            return [*command, *(word for each in sets for word in ("--set", each)), *more], out / "checkpoint"

        alone, plain = train("alone")
        subprocess.run([str(c) for c in alone], check=True, stdout=subprocess.DEVNULL)
        watched, checkpoint = train("watched", "--view")
        training = screen.start(*watched)
        processes.append(training)
        window = screen.window("watched", training)
        screen.wait(lambda scene: scene.std() > 4, "no model of the training appears", PATIENCE)
        shot("train_early")
        # The button that pauses is the first one of the bar at the top.
        screen.tool("mousemove", 60, 14), screen.tool("click", 1)
        time.sleep(4)
        paused = numpy.asarray(screen.image()).astype(int)
        time.sleep(3)
        assert not checkpoint.exists(), "the training ended before it could be paused; give more iterations"
        assert different(paused, numpy.asarray(screen.image()).astype(int)) < 0.01, "a paused training goes on"
        shot("train_paused")
        say("a training is shown, and pauses")
        screen.tool("mousemove", 60, 14), screen.tool("click", 1)
        began = time.time()
        while not checkpoint.exists() and time.time() - began < PATIENCE:
            time.sleep(0.5)
        time.sleep(4)
        shot("train_done")
        bar = SIZE[1] - 16
        start = screen.scene()
        screen.drag((140, bar), (520, bar))
        screen.wait(lambda scene: different(start, scene) > 0.02, "the slider does not move the trained model")
        shot("train_scrubbed")
        second = (26, 42)
        assert not message(screen, second), "there is a line below that of the training before a file was dropped"
        assert drop(screen.display, window, archive), "the window does not take a file"
        screen.wait(lambda scene: message(screen, second), "nothing is said of a file that is dropped on a training")
        assert "watched" in screen.tool("getwindowname", window), "a file took the place of the training"
        shot("train_dropped")
        say("a file that is dropped on a training is refused with a message")
        close(screen.display, window)
        assert training.wait(60) == 0, f"the watched training ends with {training.returncode}"
        assert checkpoint.read_bytes() == plain.read_bytes(), "the watched training ended in other bytes"
        say(f"the training of {args.iterations} iterations ends in the bytes of one without a window, and can be scrubbed")
        say("all checks passed")
    finally:
        for process in processes:
            if process.poll() is None:
                process.terminate()
        screen.server.terminate()
        folder.cleanup()


if __name__ == "__main__":
    sys.exit(main())
