"""Forces from clouds against their truth, by each method in one run, with places found and given.

    python benchmarks/sensing.py FOLDER … [--method NAME …] [--found]   # recordings of another program (`data/touches`, `data/lab`)
    python benchmarks/sensing.py --rates [--keep FOLDER]     # raw cloud → force, by stage (`data/diamond`)

A folder holds robot/, recording/ and truth.json: {"contacts": [{"frame", "point" [m, deformed], "force" [N], "rest" [m,
where known]}, …]}, made by another program.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from sensing_rates import print_rates

from femsense import Run, SensingOptions, calibrate, estimate, load_recording, load_robot

NEAR = 0.09
"""A contact farther from the truth than this is another one [m]."""
METHODS = {name: SensingOptions(method=name) for name in ("paper", "rays")}


def graded(run: Run, truth: list[dict[str, Any]], *, given: bool) -> str:
    """Return one row of the table: errors, places, missed and false contacts, coverage, time by stage."""
    relative, place, over_std, missed, used = [], [], [], 0, set()
    contacts = [c for c in run.contacts if c.force_n > 0]
    for true in truth:
        force = float(np.linalg.norm(true["force"]))
        near = [
            (float(np.linalg.norm(c.position_m - true["point"])), i)
            for i, c in enumerate(contacts)
            if c.frame == true["frame"] and i not in used
        ]
        if not near or min(near)[0] > NEAR:
            missed += 1
            continue
        distance, i = min(near)
        used.add(i)
        relative.append(abs(contacts[i].force_n / force - 1.0))
        over_std.append(abs(contacts[i].force_n - force) / max(contacts[i].std_n, 1e-9))
        place.append(1e3 * distance)
    false = 0 if given else len(contacts) - len(used)
    touched = [f for f in run.frames if f.frame in {true["frame"] for true in truth}]
    stages = {name: np.median([f.stages_ms.get(name, 0.0) for f in touched]) for f in touched for name in f.stages_ms}
    times = ", ".join(f"{name} {value:.0f}" for name, value in stages.items()) or f"{np.median([f.ms for f in touched]):.0f}"
    if not relative:
        return f"| – | – | – | {missed}/{len(truth)} | {false} | – | – | {times} |"
    errors = f"{np.median(relative):.1%} | {np.quantile(relative, 0.95):.1%} | {np.median(place):.1f}"
    std = f"{np.mean(np.array(over_std) < 1.96):.0%} | {np.sqrt(np.mean(np.square(over_std))):.2f}"
    return f"| {errors} | {missed}/{len(truth)} | {false} | {std} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--rates", action="store_true")
    parser.add_argument("--points", type=int, default=30_000, help="with --rates: of each cloud")
    parser.add_argument(
        "--keep", type=Path, help="with --rates: where recordings and rows stay; those that are there are not made again"
    )
    parser.add_argument("--method", action="append", choices=METHODS, help="may be repeated; else all")
    parser.add_argument("--found", action="store_true", help="not at the true places")
    asked = parser.parse_args()
    if asked.rates:
        with tempfile.TemporaryDirectory() as name:
            print_rates(asked.points, asked.keep or Path(name))
        return
    print(
        "| case | place | method | error of force (median) | (95 %) | place [mm] | missed | false | within 95 % | rms of error/σ | ms a frame |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for folder in asked.folders:
        robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
        document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        truth, calibration = document["contacts"], calibrate(robot, recording)
        rest = [p["point"] for p in document.get("patches", [])] or list({tuple(t["rest"]): None for t in truth})
        for name in asked.method or METHODS:
            for at in (None,) if asked.found else (None, rest):
                options = METHODS[name]
                run = estimate(robot, recording, calibration, at=at, options=options)
                print(
                    f"| {folder.name} | {'found' if at is None else 'given'} | {name} {graded(run, truth, given=at is not None)}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
