"""Forces from clouds against their truth: the published method beside what is done here, with places found and given.

    python benchmarks/sensing.py FOLDER …                                   # recordings of another program (`data/touches`)
    python benchmarks/sensing.py --suite OUT --seed S [--case NAME …] [--minutes M]
    python benchmarks/sensing.py --rates [--points N]                       # raw cloud → force, by stage (`data/diamond`)
    python benchmarks/sensing.py --list

A FOLDER holds robot/, recording/ and truth.json: {"contacts": [{"frame", "point" [m, deformed], "force" [N], "rest" [m,
where known]}, …]}. The suite makes recordings with the virtual rig (`sensing_cases.py`), senses them and prints a row
each; what is there already is not made again, so that it runs in pieces. Tune on one seed, report another.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from sensing_cases import Case, cases, robot_of, script_of
from sensing_rates import print_rates

from femsense import Run, SensingOptions, calibrate, estimate, load_recording, load_robot, simulate

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


def suite(out: Path, seed: int, names: list[str], minutes: float) -> None:
    """Print a row for each case; recordings and rows that are there stay, so that it goes on where it was stopped."""
    end, chosen = time.monotonic() + 60.0 * minutes, [c for c in cases() if not names or c.name in names]
    print(
        "| case | method | error of force (median) | (95 %) | place [mm] | missed | false | within 95 % | not ok | ms a frame |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for case in chosen:
        kept = out / f"{case.name}-{seed}.txt"
        if not kept.exists() and time.monotonic() > end:
            break
        if not kept.exists():
            out.mkdir(parents=True, exist_ok=True)
            kept.write_text(_rows_of(case, out / f"{case.name}-{seed}", seed), encoding="utf-8")
        print(kept.read_text(encoding="utf-8"), end="", flush=True)


def _rows_of(case: Case, folder: Path, seed: int) -> str:
    robot = robot_of(case)
    if not (folder / "recording.toml").exists():
        simulate(robot, script_of(case, robot, seed), folder)
    recording = load_recording(folder)
    with (folder / "truth" / "contacts.csv").open(newline="", encoding="utf-8") as file:
        truth = [
            {
                "frame": int(row["frame"]),
                "point": [float(row[key]) for key in ("x_m", "y_m", "z_m")],
                "force": [float(row[key]) for key in ("fx_n", "fy_n", "fz_n")],
            }
            for row in csv.DictReader(file)
            if float(row["force_n"]) > 0
        ]
    calibration, lines = calibrate(robot, recording), ""
    for name, options in METHODS.items():
        run = estimate(robot, recording, calibration, options=options)
        odd = sum(frame.status != "ok" for frame in run.frames)
        *cells, times = graded(run, truth, given=False).strip("| ").split(" | ")
        lines += f"| {case.name} | {name} | {' | '.join(cells)} | {odd}/{len(run.frames)} | {times} |\n"
    return lines


def folders(given: list[Path]) -> None:
    """Print four rows for each folder: both methods, places found and given."""
    print("| case | place | method | error of force (median) | (95 %) | place [mm] | missed | false | within 95 % | ms a frame |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for folder in given:
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


def main() -> None:
    """Print what was asked for."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("folders", nargs="*", type=Path)
    ask.add_argument("--suite", type=Path, metavar="OUT", help="where recordings and rows are kept")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--case", action="append", default=[], metavar="NAME", help="one of the suite's; may be repeated; else all")
    ask.add_argument("--minutes", type=float, default=10.0, help="no case begins after so many")
    ask.add_argument("--rates", action="store_true")
    ask.add_argument("--points", type=int, default=30_000, help="with --rates: of each cloud")
    ask.add_argument("--list", action="store_true", help="name the cases of the suite, in their order")
    asked = ask.parse_args()
    if asked.list:
        print("\n".join(case.name for case in cases()))
    if asked.rates:
        print_rates(asked.points)
    if asked.suite:
        suite(asked.suite, asked.seed, asked.case, asked.minutes)
    if asked.folders:
        folders(asked.folders)


if __name__ == "__main__":
    main()
