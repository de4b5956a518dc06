"""Opens the window of `cc4dgs view` and of `cc4dgs train --view` on a virtual screen: window.py PROGRAM ARCHIVE [--screenshots FOLDER] [--iterations N].

PROGRAM is a cc4dgs with the feature `view`, ARCHIVE a baked archive that moves. Needs Xvfb, xdotool, ffmpeg, Pillow and numpy; Mesa's lavapipe is enough to draw.
Moves the time slider with the mouse, orbits, pauses and resumes a training, and compares the checkpoint of the watched training with that of an unwatched one.
Ends with a sentence per check; fails at the first that does not hold.
"""
import argparse, io, os, pathlib, subprocess, sys, tempfile, time
import numpy
from PIL import Image

SIZE = (1280, 800)
# Pixels of the window that the scene fills, whatever the panels: left, upper, right, lower.
SCENE = (300, 150, 800, 600)
PATIENCE = 240


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
            found = self.tool("search", "--name", title).split()
            if found:
                self.tool("windowmove", found[0], 0, 0), self.tool("windowsize", found[0], *SIZE), self.tool("windowfocus", found[0])
                time.sleep(2)
                return found[0]
            assert process.poll() is None, f"the program ended with {process.returncode} before it had a window"
            time.sleep(0.5)
        raise AssertionError("no window appeared")

    def image(self):
        grab = ["ffmpeg", "-v", "error", "-f", "x11grab", "-video_size", f"{SIZE[0]}x{SIZE[1]}", "-i", self.display, "-frames:v", "1", "-f", "image2pipe", "-c:v", "png", "-"]
        return Image.open(io.BytesIO(subprocess.run(grab, env=self.environment, capture_output=True, check=True).stdout)).convert("RGB")

    def scene(self):
        return numpy.asarray(self.image().crop(SCENE)).astype(int)

    def wait(self, holds, what):
        """Waits until `holds(scene)`."""
        began = time.time()
        while time.time() - began < PATIENCE:
            if holds(self.scene()):
                return
            time.sleep(0.5)
        raise AssertionError(what)

    def drag(self, start, end):
        self.tool("mousemove", *start), self.tool("mousedown", 1)
        for k in range(1, 9):
            self.tool("mousemove", *[round(a + (b - a) * k / 8) for a, b in zip(start, end)])
            time.sleep(0.05)
        self.tool("mouseup", 1)
        time.sleep(1.5)


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
        screen.wait(lambda scene: scene.std() > 4, "the scene is empty")
        say(f"{archive.name} is in a window after {time.time() - began:.1f} s")
        shot("view")
        # It plays; the space bar stops it.
        screen.tool("mousemove", 640, 400), screen.tool("key", "--window", window, "space")
        time.sleep(1.5)
        stopped = screen.scene()
        time.sleep(1.5)
        assert different(stopped, screen.scene()) < 0.05, "the space bar does not stop it"
        say("the space bar stops it")
        # The slider lies in the bar at the bottom, right of three buttons.
        bar = SIZE[1] - 16
        screen.tool("key", "--window", window, "Home")
        time.sleep(1.5)
        start = screen.scene()
        screen.drag((140, bar), (520, bar))
        moved = screen.scene()
        assert different(start, moved) > 0.05, "the slider does not change the image"
        shot("view_slider")
        screen.tool("key", "--window", window, "Home")
        time.sleep(1.5)
        assert different(start, screen.scene()) < 0.05, "the first frame is another one now"
        say("the slider moves time, Home returns to the first frame")
        screen.drag((640, 400), (760, 440))
        assert different(start, screen.scene()) > 0.5, "dragging does not orbit"
        screen.tool("key", "--window", window, "r")
        time.sleep(1.5)
        assert different(start, screen.scene()) < 0.05, "R does not reset the camera"
        screen.tool("key", "--window", window, "t")
        time.sleep(1.5)
        assert different(start, screen.scene()) > 0.05, "T does not tint what moves"
        # The button of the settings is the last one of the bar.
        screen.tool("mousemove", SIZE[0] - 18, bar), screen.tool("click", 1)
        time.sleep(3)
        shot("view_settings")
        say("dragging orbits, R resets, T tints")
        screen.tool("windowclose", window)
        assert viewer.wait(60) is not None

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
        screen.wait(lambda scene: scene.std() > 4, "no model of the training appears")
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
        assert different(start, screen.scene()) > 0.02, "the slider does not move the trained model"
        shot("train_scrubbed")
        screen.tool("windowclose", window)
        training.wait(60)
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
