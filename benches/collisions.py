#!/usr/bin/env python3
"""Collisions of the hash functions of computational deformation fields, ((a v + b) mod (2^31 - 1)) mod m over the vertices v of a grid.

    python3 benches/collisions.py [--seeds 1,2,3,4,5] [--json FILE]

For k functions and modulus m: how many vertices share all k values with another vertex (`duplicates`, the least and the most over the seeds), and how many single
values coincide with one of another vertex (`collisions`, the mean share over functions). Constants come from SplitMix64, as in backends/src/ops/hash.rs. k values of a vertex are compared by a
64-bit fingerprint; the chance that two different ones of 16.8 million have the same is below 1e-5.
"""
import argparse
import json

import numpy as np

PRIME = (1 << 31) - 1
FUNCTIONS = (1, 2, 4, 8, 32, 128)
MODULI = (100, 1_000, 10_000, 100_000, 1_000_000)
MASK = (1 << 64) - 1


def split_mix(state):
    while True:
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        yield z ^ (z >> 31)


def vertices(resolution):
    axis = np.arange(resolution + 1, dtype=np.uint64)
    return [g.ravel() for g in np.meshgrid(axis, axis, axis, indexing="ij")]


def shared(values):
    """Number of entries that are equal to another entry."""
    ordered = np.sort(values)
    same = ordered[1:] == ordered[:-1]
    return int(np.count_nonzero(np.concatenate([same, [False]]) | np.concatenate([[False], same])))


def duplicates(grid, modulus, seed):
    """Vertices that share all of k values with another one, per k of FUNCTIONS, and the share of single values that coincide."""
    random = split_mix(seed)
    fingerprint = np.zeros(len(grid[0]), dtype=np.uint64)
    found, single = [], []
    for k in range(1, max(FUNCTIONS) + 1):
        a = [1 + next(random) % (PRIME - 1) for _ in range(3)]
        b = next(random) % PRIME
        value = (sum(np.uint64(a[i]) * grid[i] for i in range(3)) + np.uint64(b)) % np.uint64(PRIME) % np.uint64(modulus)
        if k <= 4:
            single.append(shared(value) / len(value))
        fingerprint = (fingerprint ^ value) * np.uint64(0x9E3779B97F4A7C15)
        fingerprint ^= fingerprint >> np.uint64(29)
        if k in FUNCTIONS:
            found.append(shared(fingerprint))
            if found[-1] == 0:
                # More functions cannot make two vertices equal again.
                break
    return found + [0] * (len(FUNCTIONS) - len(found)), float(np.mean(single))


def study(resolution, modulus, seeds):
    grid = vertices(resolution)
    found = [duplicates(grid, modulus, seed) for seed in seeds]
    functions = [{"k": k, "duplicates": [counts[i] for counts, _ in found]} for i, k in enumerate(FUNCTIONS)]
    return {"resolution": resolution, "modulus": modulus, "vertices": len(grid[0]), "collisions": [single for _, single in found], "functions": functions}


def span(counts):
    low, high = min(counts), max(counts)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json")
    parser.add_argument("--resolutions", default="32,64,128,255")
    parser.add_argument("--seeds", default="1,2,3,4,5")
    options = parser.parse_args()
    seeds = [int(seed) for seed in options.seeds.split(",")]
    cases = [study(int(r), m, seeds) for r in options.resolutions.split(",") for m in MODULI]
    print("| vertices | m | single values that collide | " + " | ".join(f"k = {k}" for k in FUNCTIONS) + " |")
    print("|" + " ---: |" * (3 + len(FUNCTIONS)))
    for case in cases:
        cells = " | ".join(span(row["duplicates"]) for row in case["functions"])
        print(f"| {case['vertices']:,} | {case['modulus']:,} | {100 * np.mean(case['collisions']):.2f} % | {cells} |")
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"what": "vertices that share all k hash values with another one, per seed", "seeds": seeds, "cases": cases}, file)
            file.write("\n")


if __name__ == "__main__":
    main()
