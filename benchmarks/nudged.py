"""A camera that moves beside touches near the clamp: what frames are said to be. Truths by the independent generator.

    python benchmarks/nudged.py OUT [--seed S] [--robots bar arm post slab] [--bare]

A row that stands in OUT already is read, not computed again. `--bare`: nothing but the robot is seen, no table below it. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from independent.cases import CASES, DIFFERENT_NUDGES, FREE
from independent.grade import RESOLVED, contacts_of, run, statuses_of
from independent.make import make

KINDS = ("ok, no contact", "ok, a contact", "the camera moved", "not ok for another reason")
"""What a frame may be said to be."""


def kind_of(status: str, contacts: int) -> str:
    """Return which of the kinds a frame is."""
    if status == "ok":
        return KINDS[1] if contacts else KINDS[0]
    return KINDS[2] if "moved by" in status else KINDS[3]


def print_nudges(heading: str, nudged: dict[tuple[float, float], Counter[str]]) -> None:
    """Print what frames were said to be after each nudge."""
    print(f"| {heading} | frames | {' | '.join(KINDS)} |\n|---|---|{'---|' * len(KINDS)}")
    for (shift, turn), counts in nudged.items():
        size = f"{1e3 * shift:.1f} mm" if shift else f"{np.degrees(turn):.1f}°" if turn else "nothing"
        print(f"| {size} | {counts.total()} | {' | '.join(str(counts[kind]) for kind in KINDS)} |")
    print()


def main() -> None:
    """Make and run the cases, and print both tables."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--robots", nargs="*", default=["bar", "arm", "post", "slab"])
    ask.add_argument("--bare", action="store_true")
    given = ask.parse_args()
    nudged, beside = ({nudge: Counter[str]() for nudge in DIFFERENT_NUDGES} for _ in range(2))
    touched: dict[str, Counter[str]] = {}
    for case in CASES:
        if case.robot not in given.robots or not (case.nudges or case.near_clamp):
            continue
        folder = given.out / (case.name + "-bare" * given.bare)
        if not (folder / "truth.json").exists():
            make(replace(case, bare=given.bare), folder, given.seed)
        if not (folder / "run" / "frames.csv").exists():
            print(f"{folder.name}: {run(folder, timeout=3000.0)}", flush=True)
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        contacts, status = Counter(contacts_of(folder / "run")), statuses_of(folder / "run")
        for k in range(FREE, truth["frames"]):
            kind = kind_of(status[k], contacts[k])
            if case.nudges and not case.touches:
                nudged[case.nudges[k - FREE]][kind] += 1
                continue
            here = [c for c in truth["contacts"] if c["frame"] == k]
            if case.nudges and here:
                beside[case.nudges[k - FREE]][kind] += 1
            elif here:
                sure = "resolved" if here[0]["bound_rel"] < RESOLVED else "lighter"
                touched.setdefault(f"{case.name}, {sure}", Counter())[kind] += 1
    print_nudges("the camera moved by", nudged)
    print_nudges("beside a touch that is seen, it moved by", beside)
    print(f"| a touch near the clamp | frames | {' | '.join(KINDS)} |\n|---|---|{'---|' * len(KINDS)}")
    for name, counts in touched.items():
        print(
            f"| `{name.split(',')[0]}`,{name.split(',')[1]} | {counts.total()} | {' | '.join(str(counts[kind]) for kind in KINDS)} |"
        )


if __name__ == "__main__":
    main()
