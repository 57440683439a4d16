"""Forces from clouds against their truth: the published method beside what is done here, with places found and given.

    python benchmarks/sensing.py FOLDER …                    # recordings of another program (`data/touches`)
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
METHODS = {"paper": SensingOptions(method="paper"), "rays": SensingOptions()}


def graded(run: Run, truth: list[dict[str, Any]], *, given: bool) -> str:
    """Return one row of the table: errors, places, missed and false contacts, coverage, time by stage."""
    relative, place, within, missed, used = [], [], [], 0, set()
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
        within.append(abs(contacts[i].force_n - force) < 1.96 * contacts[i].std_n)
        place.append(1e3 * distance)
    false = 0 if given else len(contacts) - len(used)
    stages = {name: np.median([f.stages_ms[name] for f in run.frames if f.stages_ms]) for f in run.frames for name in f.stages_ms}
    times = ", ".join(f"{name} {value:.0f}" for name, value in stages.items()) or f"{np.median([f.ms for f in run.frames]):.0f}"
    if not relative:
        return f"| – | – | – | {missed}/{len(truth)} | {false} | – | {times} |"
    errors = f"{np.median(relative):.1%} | {np.quantile(relative, 0.95):.1%} | {np.median(place):.1f}"
    return f"| {errors} | {missed}/{len(truth)} | {false} | {np.mean(within):.0%} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--rates", action="store_true")
    parser.add_argument("--points", type=int, default=30_000, help="with --rates: of each cloud")
    parser.add_argument(
        "--keep", type=Path, help="with --rates: where recordings and rows stay; those that are there are not made again"
    )
    asked = parser.parse_args()
    if asked.rates:
        with tempfile.TemporaryDirectory() as name:
            print_rates(asked.points, asked.keep or Path(name))
        return
    print("| case | place | method | error of force (median) | (95 %) | place [mm] | missed | false | within 95 % | ms a frame |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for folder in asked.folders:
        robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
        document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        truth, calibration = document["contacts"], calibrate(robot, recording)
        rest = [p["point"] for p in document.get("patches", [])] or list({tuple(t["rest"]): None for t in truth})
        for name, options in METHODS.items():
            for at in (None, rest):
                run = estimate(robot, recording, calibration, at=at, options=options)
                print(
                    f"| {folder.name} | {'found' if at is None else 'given'} | {name} {graded(run, truth, given=at is not None)}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
