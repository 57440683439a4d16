"""What constants of sensing do: forces of independent cases with each of them at other values.

    python benchmarks/sensing_constants.py OUT [--seed S] [--case NAME …] [--only HERTZ …]

Cases are made below OUT where they are not there yet, calibrated once, and estimated with each value. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from types import ModuleType

from independent.cases import CASES
from independent.grade import grade
from independent.make import make

from femsense import calibrate, estimate, load_recording, load_robot
from femsense.sensing import forces, nuisance, separation, touches
from femsense.sensing.run_files import write_run

VALUES: dict[str, tuple[ModuleType, tuple[float, ...]]] = {
    "HERTZ": (touches, (0.0, 1.0, touches.HERTZ, 1.6)),
    "ALIKE": (touches, (0.0, touches.ALIKE, 0.3)),
    "KEPT": (separation, (0.0, separation.KEPT, 0.98)),
    "ASIDE": (nuisance, (0.0, 1.0, nuisance.ASIDE, 4.0)),
    "TRIES": (forces, (1, 3, forces.TRIES, 10)),
}
"""Constants, where they stand, and values to ask with; KEPT matters without colours alone, HERTZ and ALIKE where a round object touches."""
ASKED = {
    "HERTZ": ("pad-normal",),
    "ALIKE": ("pad-normal",),
    "KEPT": ("slab-gray",),
    "ASIDE": ("slab-gray", "bar-tangential"),
    "TRIES": ("slab-rod", "bar-tangential"),
}


def main() -> None:
    """Print a row for each value."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument(
        "--case", action="append", default=[], metavar="NAME", help="in place of the one that the constant matters to"
    )
    ask.add_argument("--only", nargs="*", default=list(VALUES), choices=list(VALUES))
    given = ask.parse_args()
    warnings.simplefilter("ignore")
    print(
        "| constant | value | case | error of force, median | 95th percentile | place | missed (quiet) | false | within 95 % | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in given.only:
        for case in given.case or ASKED[name]:
            folder = given.out / case
            if not (folder / "truth.json").exists():
                make(next(c for c in CASES if c.name == case), folder, given.seed)
            robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
            calibration = calibrate(robot, recording)
            module, values = VALUES[name]
            used = getattr(module, name)
            for value in values:
                setattr(module, name, value)
                began = time.process_time()
                run = estimate(robot, recording, calibration)
                spent = time.process_time() - began
                write_run(run, folder / f"run-{name}-{value:.2f}", inputs={})
                row = grade(folder / f"run-{name}-{value:.2f}", folder / "truth.json")
                print(
                    f"| `{name}` | {value:.3g}{' (used)' * (value == used)} | `{case}` | {row.cells()} | {spent:.0f} |",
                    flush=True,
                )
            setattr(module, name, used)


if __name__ == "__main__":
    main()
