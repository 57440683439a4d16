"""What each addition to the published method does to forces: independent cases with one of them switched off at a time.

    python benchmarks/additions.py OUT [--seed S] [--case NAME …]

Cases are made below OUT where they are not there yet, calibrated once, and estimated in each way; runs that are there are not made again.
"Over the bound" is the median error over that of an estimator at the bound of Cramér and Rao, 0.67 times it. Milliseconds are processor time a
frame after the first. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from independent.cases import CASES
from independent.grade import Row, grade, summed
from independent.make import make

from femsense import SensingOptions, calibrate, estimate, load_recording, load_robot
from femsense.sensing import contact_free, model, objects_of_frame, pipeline, touches
from femsense.sensing.model import Model
from femsense.sensing.run_files import write_run
from femsense.sensing.types import Sensor

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
ASKED = ("bar-normal", "bar-tangential", "arm-slide", "pad-normal", "slab-gray", "post-two", "diamond-normal")
GIVEN = "all, with the true places given"
PUSH = GIVEN + ", whose forces push"
MEDIAN = 0.6745
"""Median of the size of what is normal, in its standard deviations."""
Patches = tuple[tuple[Any, str, Any], ...]


@dataclass(frozen=True)
class Way:
    """One way to estimate."""

    name: str
    options: SensingOptions = field(default_factory=SensingOptions)
    patches: Patches = ()
    """Module or class, name in it, and what stands there instead."""
    given: bool = False
    """The true places are given."""


def _untaught(sensor: Sensor) -> Model:
    """Return the model before any contact-free frame is seen."""
    return contact_free.prior_model(sensor)


def _no_radius(*given: object) -> float:
    return 0.0


def _nothing_seen(*given: object) -> list[Any]:
    return []


WAYS = (
    Way("the published method", SensingOptions(method="paper")),
    Way(
        "all, but nothing learnt from free frames",
        patches=((pipeline, "learn", _untaught),),
    ),
    Way("all, but no objects: contacts by the shape alone", patches=((objects_of_frame, "objects_near", _nothing_seen),)),
    Way("all, but no forces along the surface", SensingOptions(friction=0.0)),
    Way("all, but no patch by the object", patches=((touches, "contact_radius", _no_radius),)),
    Way("all, but no deviation of the compliance", patches=((model.Model, "compliance_std", 0.0),)),
    Way("all"),
    Way(GIVEN, given=True),
    Way(PUSH, SensingOptions(push=True), given=True),
)


def main() -> None:
    """Print a table over all cases, a row a way, and one a case."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--case", action="append", default=[], metavar="NAME", help=f"may be repeated; else {', '.join(ASKED)}")
    given = ask.parse_args()
    warnings.simplefilter("ignore")
    rows: dict[str, list[tuple[Row, float]]] = {way.name: [] for way in WAYS}
    for name in given.case or ASKED:
        for way, row, ms in _rows_of(name, given.out / name, given.seed):
            rows[way.name].append((row, ms))
            print(f"`{name}`: {_line(way.name, [(row, ms)])}", flush=True)
    print(
        "| way | error of force, median | 95th percentile | place | missed (quiet) | false | within 95 % | over the bound | ms |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for way_name, graded in rows.items():
        print(_line(way_name, graded))


def _line(name: str, graded: list[tuple[Row, float]]) -> str:
    """Return a row of the table; milliseconds are the median over cases."""
    row = summed([row for row, _ in graded])
    if name in (GIVEN, PUSH):  # its place is no answer, and what there is of force is reported in every frame
        row.place_m, row.false, row.calm = [], 0, 0
    over = f"{np.median(row.over_bound) / MEDIAN:.1f}" if row.over_bound else "–"
    return f"| {name} | {row.cells()} | {over} | {np.median([ms for _, ms in graded]):.0f} |"


def _rows_of(name: str, folder: Path, seed: int) -> Iterator[tuple[Way, Row, float]]:
    """Yield the grade of a case in each way, and its milliseconds a frame."""
    if not (folder / "truth.json").exists():
        make(next(case for case in CASES if case.name == name), folder, seed, diamond=DIAMOND)
    robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
    calibration = None
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    places = list({c["contact"]: c["rest"] for c in truth["contacts"]}.values())
    slides = any(touch.slide_m for touch in next(case for case in CASES if case.name == name).touches)
    for number, way in enumerate(WAYS):
        if way.given and slides:
            continue  # a given place stays where it is
        into = folder / f"run-way-{number}"
        if not (into / "ms.json").exists():
            calibration = calibration or calibrate(robot, recording)
            spent = _Clock()
            with ExitStack() as patched:
                for patch in way.patches:
                    patched.enter_context(mock.patch.object(*patch))
                run = estimate(
                    robot, recording, calibration, at=places if way.given else None, options=way.options, progress=spent.tick
                )
            write_run(run, into, inputs={})
            (into / "ms.json").write_text(json.dumps(spent.ms), encoding="utf-8")
        yield way, grade(into, folder / "truth.json"), json.loads((into / "ms.json").read_text(encoding="utf-8"))


class _Clock:
    """Processor time a frame, after the first."""

    def __init__(self) -> None:
        self.first, self.ms = 0.0, float("nan")

    def tick(self, done: int, count: int) -> None:
        if done == 1:
            self.first = time.process_time()
        elif done == count:
            self.ms = 1e3 * (time.process_time() - self.first) / (count - 1)


if __name__ == "__main__":
    main()
