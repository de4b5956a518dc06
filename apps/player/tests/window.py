"""Opens the window of `cc4dgs view` and of `cc4dgs train --view` on a virtual screen: window.py PROGRAM ARCHIVE [--screenshots FOLDER] [--iterations N].

PROGRAM is a cc4dgs with the feature `view`, ARCHIVE a baked archive that moves. Needs Xvfb, xdotool, ffmpeg, Pillow, numpy and python-xlib; Mesa's lavapipe is enough to draw.
Moves the time slider with the mouse, orbits, presses keys, drops a damaged and a good file, pauses and resumes a training, and compares the checkpoint of the
watched training with that of an unwatched one. Prints a sentence per check; fails at the first that does not hold.
"""
import argparse, io, os, pathlib, subprocess, sys, tempfile, time
import numpy
from PIL import Image
from xclient import close, drop

SIZE = (1280, 800)
# Pixels of the window that the scene fills, whatever the panels: left, upper, right, lower.
SCENE = (300, 150, 800, 600)
PATIENCE = 240
# Width of the settings at the right.
PANEL = 120


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
        # The button of the settings is the last one of the bar.
        whole = numpy.asarray(screen.image()).astype(int)
        screen.tool("mousemove", SIZE[0] - 18, bar), screen.tool("click", 1)
        time.sleep(3)
        panel = different(whole[:, SIZE[0] - PANEL :], numpy.asarray(screen.image()).astype(int)[:, SIZE[0] - PANEL :])
        assert panel > 10, "the settings do not open"
        shot("view_settings")
        say("the settings open, with statistics")
        damaged = pathlib.Path(folder.name) / "damaged.cc4d"
        content = bytearray(archive.read_bytes())
        content[len(content) // 2] ^= 0xFF
        damaged.write_bytes(content)
        before = screen.scene()
        assert drop(screen.display, window, damaged), "the window does not take a file"
        time.sleep(2)
        shot("view_damaged")
        # The message takes the top of the window.
        assert different(whole[:16], numpy.asarray(screen.image()).astype(int)[:16]) > 10, "nothing is said of a damaged file"
        assert drop(screen.display, window, archive)
        screen.wait(lambda scene: different(before, scene) > 0.05, "a dropped archive does not play")
        assert screen.tool("search", "--name", archive.name).split() == [window], "the title does not name the file"
        say("a damaged file that is dropped is refused with a message, a good one plays")
        close(screen.display, window)
        assert viewer.wait(60) == 0, f"the window ends with {viewer.returncode}"
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
