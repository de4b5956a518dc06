"""What a user takes along from the window of `cc4dgs view`, and what is opened in it: window_keep.py PROGRAM ARCHIVE [--screenshots FOLDER].

PROGRAM and ARCHIVE are those of window.py, which this shares its virtual screen with. Saves PNG files, prints the command of a view and opens it, drops an archive
without a playback layer, types a path, and loses the graphics device. Prints a sentence per check; fails at the first that does not hold.
"""
import argparse, os, pathlib, shlex, subprocess, sys, tempfile, time
import numpy
from PIL import Image
from window import LEAST_DB, PATIENCE, Screen, different, psnr_db, say
from xclient import close, drop


def files(folder, count):
    """The PNG files in `folder` once there are so many."""
    began = time.time()
    while time.time() - began < PATIENCE:
        found = sorted(pathlib.Path(folder).glob("*.png"), key=lambda f: f.stat().st_mtime)
        if len(found) >= count:
            return found
        time.sleep(0.3)
    raise AssertionError(f"{len(found)} PNG files, not {count}")


def calm(screen):
    """The scene once it stands still: a busy machine draws late."""
    before, began = screen.scene(), time.time()
    while time.time() - began < PATIENCE:
        time.sleep(2)
        now = screen.scene()
        if (now == before).all():
            return now
        before = now
    raise AssertionError("the scene does not stand still")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("program"), parser.add_argument("archive"), parser.add_argument("--screenshots")
    args = parser.parse_args()
    program, archive = os.path.abspath(args.program), pathlib.Path(args.archive).absolute()
    screen, folder, processes = Screen(), tempfile.TemporaryDirectory(), []

    printed, complaints = pathlib.Path(folder.name) / "printed", pathlib.Path(folder.name) / "complaints"

    def shot(name):
        if args.screenshots:
            os.makedirs(args.screenshots, exist_ok=True)
            screen.image().save(os.path.join(args.screenshots, name + ".png"))

    def view(*more):
        with open(printed, "a") as file:
            process = subprocess.Popen([program, "--quiet", "view", *map(str, more)], cwd=folder.name, env=screen.environment, stdout=file, stderr=open(complaints, "w"))
        processes.append(process)
        return process

    def shown(name, process):
        window = screen.window(name, process)
        screen.wait(lambda scene: scene.std() > 4, "the scene is empty", PATIENCE)
        # A window that stands still draws its new size with the next event.
        for at in ((630, 390), (640, 400)):
            screen.tool("mousemove", *at)
            time.sleep(1)
        return window

    try:
        viewer = view(archive)
        window = shown(archive.name, viewer)
        screen.tool("key", "space")
        time.sleep(1.5)
        screen.drag((640, 400), (760, 440))
        before, whole = calm(screen), screen.image()
        screen.tool("key", "p")
        saved = Image.open(files(folder.name, 1)[0]).convert("RGB")
        agreement = psnr_db(numpy.asarray(whole.crop((0, 0, *saved.size))).astype(int), numpy.asarray(saved).astype(int))
        assert saved.size[0] == whole.size[0] and agreement >= LEAST_DB, f"the PNG file has {saved.size} pixels and is {agreement:.1f} dB from the window"
        time.sleep(1)
        shot("keep_png")
        first = files(folder.name, 1)[0].read_bytes()
        screen.tool("key", "p")
        two = files(folder.name, 2)
        assert two[0].read_bytes() == first and two[1].name.endswith("-2.png"), two
        say(f"P saves the image, {agreement:.1f} dB from the window; a second one has another name")
        screen.tool("key", "c")
        time.sleep(1)
        shot("keep_command")
        command = printed.read_text().strip()
        assert command.startswith("cc4dgs") and "--time " in command and "--pose=" in command, f"printed: {command!r}"
        say(f"C prints {command!r}")
        words = shlex.split(command.replace("cc4dgs view", "cc4dgs-view", 1))[1:]
        close(screen.display, window)
        assert viewer.wait(60) == 0
        viewer = view(*words)
        window = shown(archive.name, viewer)
        shot("keep_opened")
        screen.wait(lambda scene: different(before, scene) < 0.3, "the printed command shows another view")
        time.sleep(1)
        assert different(before, screen.scene()) < 0.3, "it does not stand still"
        say("the printed command opens the same time and pose")
        for wrong in (("--pose=1,2,3",), ("--time", "7")):
            said = subprocess.run([program, "--quiet", "view", archive, *wrong], env=screen.environment, capture_output=True, text=True)
            assert said.returncode == 2 and wrong[0].strip("-")[:4] in said.stderr, f"{wrong}: {said.returncode}, {said.stderr}"
        say("a pose or a time that means nothing ends with exit code 2")

        # Where there is no playback layer, it is baked, as for the model on the command line.
        run, plain = pathlib.Path(folder.name) / "run", pathlib.Path(folder.name) / "plain.cc4d"
        sets = [f"--set={s}" for s in ("train.iterations=60", "train.dynamic=all", "train.checks=false")]
        train = [program, "--quiet", "train", "--scene", "procedural:tiny", "--preset", "demo+cdf-basis", "--device", "flex", "--out", run, *sets]
        subprocess.run(train, check=True, stdout=subprocess.DEVNULL)
        store = [program, "--quiet", "compress", run, "--codec", "quantize:high", "--field-weights", "fp16", "--device", "flex", "--out", plain]
        subprocess.run(store, check=True, stdout=subprocess.DEVNULL)
        assert drop(screen.display, window, plain)
        began = time.time()
        while plain.name not in screen.tool("getwindowname", window) and time.time() - began < PATIENCE:
            time.sleep(0.3)
        shot("keep_baked")
        one = screen.scene()
        screen.wait(lambda scene: different(one, scene) > 0.02, "an archive without a playback layer does not play")
        say(f"a dropped archive without a playback layer is baked, and plays after {time.time() - began:.1f} s")

        # A path that is typed.
        screen.tool("key", "o")
        time.sleep(1)
        screen.tool("key", "ctrl+a"), screen.tool("type", "--delay", "60", str(archive))
        time.sleep(1)
        shot("keep_path")
        screen.tool("key", "Return")
        began = time.time()
        while archive.name not in screen.tool("getwindowname", window) and time.time() - began < PATIENCE:
            time.sleep(0.3)
        assert archive.name in screen.tool("getwindowname", window), "a typed path is not opened"
        say("a typed path is opened")

        # The device is lost: the error says how to go on.
        screen.tool("mousemove", 640, 400), screen.tool("key", "space")
        time.sleep(1.5)
        screen.tool("key", "ctrl+shift+F12")
        code = viewer.wait(60)
        told = complaints.read_text().splitlines()[-1]
        assert code == 5 and "lost" in told and "--time " in told and "--pose=" in told, f"a lost device ends with {code}: {told}"
        say(f"a lost device ends with exit code 5: {told}")
        say("all checks passed")
    finally:
        for process in processes:
            if process.poll() is None:
                process.terminate()
        screen.server.terminate()
        folder.cleanup()


if __name__ == "__main__":
    sys.exit(main())
