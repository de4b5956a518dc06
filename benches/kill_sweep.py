#!/usr/bin/env python3
"""Kills a sweep at random moments and checks that it ends as an undisturbed one: every cell exactly once, the same result bytes (times aside).

    python3 benches/kill_sweep.py OUT --bin BIN [--grid benches/grids/tiny.toml] [--kills 50] [--json FILE]

The undisturbed sweep is OUT/whole, the other one OUT/killed. At random moments after each start either the pool and
all of its processes are killed (SIGKILL), or the pool alone, or one of its processes, or the pool is asked to stop (SIGTERM). Once the disturbed sweep is complete, its
folder is cleared and it begins again, until as many kills as asked for have hit a running sweep; every completed round is compared.
"""
import argparse
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time

WAYS = ["all", "pool", "worker", "ask"]


def command(options, *arguments):
    return [str(options.bin), "--quiet", "--threads", "1", "sweep", *map(str, arguments)]


def children(parent):
    """Processes of `parent`, its children's children included."""
    found = []
    for entry in pathlib.Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except (OSError, IndexError):
                continue
            if int(fields[1]) == parent:
                found += [int(entry.name), *children(int(entry.name))]
    return found


def kill(process, number):
    try:
        os.kill(process, number)
        return True
    except ProcessLookupError:
        return False


def program(folder):
    """Version and commit of the program that planned a sweep, which no other program runs."""
    plan = json.loads((folder / "plan.json").read_text())
    return {"version": plan["version"], "commit": plan["commit"]}


def results(folder):
    """Result files by name, without what differs between equal runs."""
    found = {}
    for file in sorted((folder / "results").iterdir()):
        result = json.loads(file.read_text())
        assert file.name == result["id"] + ".json", f"{file}: the name is not the cell's"
        result.pop("cost")
        found[file.name] = json.dumps(result, sort_keys=True)
    return found


def compare(whole, killed):
    """What differs between two finished sweeps."""
    a, b = results(whole), results(killed)
    wrong = [f"{name} is only in one of the sweeps" for name in sorted(set(a) ^ set(b))]
    wrong += [f"{name} differs" for name in sorted(set(a) & set(b)) if a[name] != b[name]]
    for name in sorted(file.name for file in (whole / "archives").iterdir()):
        other = killed / "archives" / name
        if not other.exists() or other.read_bytes() != (whole / "archives" / name).read_bytes():
            wrong.append(f"archives/{name} differs")
    return wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bin", type=pathlib.Path, required=True)
    parser.add_argument("--grid", type=pathlib.Path, default=pathlib.Path(__file__).parent / "grids" / "tiny.toml")
    parser.add_argument("--iterations", type=int, help="size, in place of the grid's")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--longest", type=float, default=0.25, help="longest time before a kill, as a share of the undisturbed time")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    options.bin = options.bin.resolve()
    draw = random.Random(options.seed)
    whole, killed = options.out / "whole", options.out / "killed"
    size = ["--iterations", options.iterations] if options.iterations else []
    for folder in (whole, killed):
        shutil.rmtree(folder, ignore_errors=True)
    subprocess.run(command(options, "plan", options.grid, "--out", whole, *size), check=True, stdout=subprocess.DEVNULL)
    began = time.time()
    subprocess.run(command(options, "run", whole, "--jobs", options.jobs), check=True, stdout=subprocess.DEVNULL)
    undisturbed = time.time() - began
    cells = len(results(whole))
    print(f"undisturbed: {cells} cells in {undisturbed:.1f} s", flush=True)

    hits, runs, rounds, resumed, wrong = {way: 0 for way in WAYS}, 0, 0, 0, []
    while sum(hits.values()) < options.kills and not wrong:
        shutil.rmtree(killed, ignore_errors=True)
        subprocess.run(command(options, "plan", options.grid, "--out", killed, *size), check=True, stdout=subprocess.DEVNULL)
        finished = False
        while not finished:
            runs += 1
            process = subprocess.Popen(command(options, "run", killed, "--jobs", options.jobs), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            if sum(hits.values()) < options.kills:
                # Short moments hit the beginning of trainings, long ones checkpoints, codecs and scores.
                time.sleep(draw.uniform(0.05, options.longest * undisturbed))
                way = draw.choice(WAYS)
                workers = children(process.pid)
                if way == "worker":
                    hit = bool(workers) and kill(draw.choice(workers), signal.SIGKILL)
                elif process.poll() is None:
                    hit = kill(process.pid, signal.SIGTERM if way == "ask" else signal.SIGKILL)
                    if way == "all":
                        for worker in workers:
                            kill(worker, signal.SIGKILL)
                else:
                    hit = False
                hits[way] += hit
            code = process.wait()
            # A run that lost a worker says so (4); the next one does the rest.
            if code not in (0, 4, 130, -signal.SIGKILL, -signal.SIGTERM):
                wrong.append(f"run {runs} ended with {code}")
                break
            finished = code == 0
        if wrong:
            break
        rounds += 1
        collected = subprocess.run(command(options, "collect", killed), stdout=subprocess.DEVNULL).returncode
        if collected != 0:
            wrong.append(f"collect ended with {collected}")
        wrong += compare(whole, killed)
        resumed += sum(json.loads(file.read_text())["cost"]["resumed"] > 0 for file in (killed / "results").iterdir())
        print(f"round {rounds}: complete after {sum(hits.values())} kills and {runs} runs; {'; '.join(wrong) or 'the same bytes'}", flush=True)
    report = {**program(whole), "kills": sum(hits.values()), "ways": hits, "runs": runs, "rounds": rounds, "cells": cells,
              "cells_of_resumed_trainings": resumed, "undisturbed_seconds": round(undisturbed, 1), "wrong": wrong}
    print(json.dumps(report, indent=1))
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
