"""Shared parts of the scripts that train: finished rows in a file, so that no training is repeated with the same program and settings, and Ctrl-C."""
import contextlib
import fcntl
import hashlib
import json
import pathlib
import shutil
import signal
import subprocess
import sys
import threading

TRAINED = (0, 6)  # Exit codes of trainings that leave a model; 6 is one below simple baselines.
INTERRUPTED = threading.Event()  # Set once Ctrl-C was pressed: threads start no more processes.


def sha256(program):
    """The hash of the file that runs as `program`: a rebuilt one is another program."""
    file = shutil.which(program)
    if file is None:
        sys.exit(f"{program} is not there, or cannot be run")
    return hashlib.sha256(pathlib.Path(file).read_bytes()).hexdigest()


def replace(file, document):
    """Writes JSON by way of a partial file: an interruption keeps the earlier content."""
    partial = file.with_name(file.name + ".partial")
    partial.write_text(json.dumps(document, indent=1) + "\n")
    partial.replace(file)


class Rows:
    """Finished rows in a JSON file. Each states what it depends on, and what was measured. Several threads and processes may share the file: it is read again for
    every call, under a lock of the file beside it that is called as it is with `.lock` after the name."""

    def __init__(self, file):
        self.file, self.threads = file, threading.Lock()

    @contextlib.contextmanager
    def locked(self):
        """The rows, which nothing else changes meanwhile."""
        # On network file systems a lock may be one of the whole process, so threads have one of their own.
        with self.threads, open(self.file.with_name(self.file.name + ".lock"), "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield json.loads(self.file.read_text()) if self.file.exists() else []

    def find(self, stated):
        """The row that states the same. Rows of earlier versions of a script state less, and are not found."""
        with self.locked() as rows:
            return next((row for row in rows if stated.items() <= row.items()), None)

    def keep(self, row):
        """Adds the row to those that the file has by now."""
        with self.locked() as rows:
            replace(self.file, [*rows, row])


def events(out):
    """The events of the run in the folder `out`; an incomplete line is ignored. `seconds` are those of the line: in older logs some events have a later key of
    this name."""
    log, found = out / "events.jsonl", []
    for line in log.read_text().splitlines() if log.exists() else []:
        try:
            found.append(json.loads(line, object_pairs_hook=lambda pairs: dict(reversed(pairs))))
        except json.JSONDecodeError:
            continue
    return found


def timed(out):
    """The events of the run in the folder `out`, with the seconds of all parts of an interrupted run together."""
    total, last, found = 0.0, 0.0, []
    for event in events(out):
        if event["event"] == "run-started":
            total, last = total + last, 0.0
        last = event.get("seconds", last)
        found.append({**event, "seconds": total + last})
    return found


def points(out, kind):
    """The events of one kind, in order, one per iteration: of iterations that a resumed run repeated, the last event counts."""
    found = {}
    for event in timed(out):
        if event["event"] == kind:
            key = (event.get("stage"), event.get("iteration"))
            found.pop(key, None)
            found[key] = event
    return list(found.values())


def trained(out):
    """Seconds of training, all parts of an interrupted run together."""
    return max((event["seconds"] for event in timed(out)), default=0.0)


def begin(arguments, **streams):
    """The process, unless Ctrl-C was pressed."""
    if INTERRUPTED.is_set():
        raise KeyboardInterrupt
    return subprocess.Popen(arguments, **streams)


def let_end(child):
    """Gives an interrupted process a minute to write its checkpoint, then kills it."""
    try:
        child.wait(60)
    except subprocess.TimeoutExpired:
        child.kill()


def ended(child, seconds=None):
    """Exit code of a process, or `None` if it takes more than `seconds`. Ctrl-C reaches the process, too: it gets a minute to write its checkpoint."""
    try:
        code = child.wait(seconds)
    except subprocess.TimeoutExpired:
        return None
    except BaseException:
        let_end(child)
        raise
    # The process may receive the signal before the main thread of this script does.
    if INTERRUPTED.wait(1 if code in (130, -signal.SIGINT) else 0):
        raise KeyboardInterrupt
    return code


def interrupt(pool):
    """Call it on Ctrl-C. Running processes receive the signal, too; tasks of `pool` that have not begun are cancelled."""
    INTERRUPTED.set()
    pool.shutdown(wait=False, cancel_futures=True)
    print("interrupted; waiting for processes to end", file=sys.stderr)
    return 130
