#!/usr/bin/env python3
"""Shortens the JSON of `cc4dgs stress` to a row per part and condition: python3 benches/stress_summary.py IN.json OUT.json

A row counts its cases, those that are required (where an error is a failure), and those that were refused with an error."""
import json
import sys


def main():
    report = json.load(open(sys.argv[1]))
    limits = {(l["part"], l["condition"]): l["level"] for l in report["limits"]}
    rows = {}
    for case in report["cases"]:
        key = (case["part"], case["condition"])
        empty = {"part": key[0], "condition": key[1], "cases": 0, "required": 0, "refused": 0, "oracle": case["oracle"], "largest_error": None, "at": None}
        row = rows.setdefault(key, empty)
        row["cases"] += 1
        row["required"] += case["required"]
        row["refused"] += case["outcome"].startswith("error")
        row["oracle"] = row["oracle"] or case["oracle"]
        if case["error"] is not None and (row["largest_error"] is None or case["error"] > row["largest_error"]):
            row["largest_error"], row["at"] = float(f"{case['error']:.2e}"), case["level"]
        row["limit"] = limits.get(key)
    head = {key: report[key] for key in ("device", "optimizer_steps", "deformer_levels", "failures")}
    with open(sys.argv[2], "w") as file:
        json.dump(head | {"cases": len(report["cases"]), "rows": list(rows.values())}, file, indent=0)
        file.write("\n")


if __name__ == "__main__":
    main()
