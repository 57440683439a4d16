"""What constants of sensing do: forces of independent cases with each of them at other values.

    python benchmarks/sensing_constants.py OUT [--seed S] [--case NAME …] [--only PATCH …]

Cases are made below OUT where they are not there yet, calibrated once, and estimated with each value. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path
from types import ModuleType

from independent.cases import CASES
from independent.grade import grade
from independent.make import make

from femsense import calibrate, estimate, load_recording, load_robot
from femsense.pointcloud import primitives
from femsense.sensing import estimate_frame, fit, model, no_penetration, odds, places, proposals, touches
from femsense.sensing.run_files import write_run

VISIBLE = ("pad-slide", "arm-two", "diamond-three", "pad-plate")
HIDDEN = ("arm-hidden", "bar-release")
GREY = ("slab-gray", "bar-gray")
VALUES: dict[str, tuple[ModuleType, tuple[float, ...], tuple[str, ...]]] = {
    "PATCH": (touches, (0.3, touches.PATCH, 0.9), ("pad-normal", "bar-normal")),
    "ALIKE": (touches, (0.0, touches.ALIKE, 0.3), ("pad-normal",)),
    "VISIBLE": (odds, (0.0, odds.VISIBLE, 2 * odds.VISIBLE), VISIBLE),
    "INFERRED": (odds, (0.5 * odds.INFERRED, odds.INFERRED, 2 * odds.INFERRED), HIDDEN + GREY),
    "IN_SIGHT": (odds, (0.0, odds.IN_SIGHT, 3 * odds.IN_SIGHT), VISIBLE + GREY),
    "UNRESOLVED": (odds, (0.0, odds.UNRESOLVED, 3 * odds.UNRESOLVED), VISIBLE),
    "LATENT": (fit, (0.0, 0.05, fit.LATENT, 1.0), VISIBLE),
    "UNDETERMINED_TAU": (estimate_frame, (0.2, estimate_frame.UNDETERMINED_TAU, 10.0), VISIBLE),
    "ACROSS": (fit, (0.25, fit.ACROSS, 1.0), ("bar-tangential", "bar-normal")),
    "CHORD": (fit, (0.005, fit.CHORD, 0.08), ("bar-jump", "arm-slide")),
    "JUMP": (fit, (0.5, fit.JUMP, 50.0), ("bar-jump", "post-two")),
    "TOLERANCE": (fit, (0.01, fit.TOLERANCE, 1.0), ("bar-jump", "arm-slide")),
    "MISPLACED": (no_penetration, (0.01, no_penetration.MISPLACED, 0.5), VISIBLE),
    "OVERLAPPING": (no_penetration, (1e-4, no_penetration.OVERLAPPING, 0.3), VISIBLE),
    "GAP_STD": (no_penetration, (1e-5, no_penetration.GAP_STD, 5e-4), VISIBLE),
    "SHORT": (proposals, (0.0, proposals.SHORT, 40.0), VISIBLE),
    "SAME": (proposals, (0.04, proposals.SAME, 0.16), VISIBLE),
    "STALE": (model, (0.005, model.STALE, 0.1), HIDDEN),
    "PIXELS": (model, (2000, model.PIXELS, 40000), ("diamond-normal",)),
    "STRAY": (model, (1e-3, model.STRAY, 0.1), ("diamond-far", "pad-slide")),
    "END": (primitives, (0.0, primitives.END, 1.0), ("arm-rod", "slab-rod")),
    "SIMPLER": (primitives, (1.0, primitives.SIMPLER, 4.0), ("arm-rod", "pad-slide")),
    "BLEEDING": (places, (1.0, places.BLEEDING, 6.0), VISIBLE),
}
"""Constants, where they are defined, values to ask with, and the cases that each matters to."""


def set_everywhere(name: str, value: float) -> None:
    """Set a constant in each module of the package that has it."""
    for module in list(sys.modules.values()):
        if module.__name__.startswith(("femsense.sensing.", "femsense.inference.", "femsense.pointcloud.")) and name in vars(
            module
        ):
            setattr(module, name, value)


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
        module, values, cases = VALUES[name]
        for case in given.case or cases:
            folder = given.out / case
            if not (folder / "truth.json").exists():
                make(next(c for c in CASES if c.name == case), folder, given.seed)
            robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
            calibration = calibrate(robot, recording)
            used = getattr(module, name)
            for value in values:
                set_everywhere(name, value)
                began = time.process_time()
                run = estimate(robot, recording, calibration)
                spent = time.process_time() - began
                write_run(run, folder / f"run-{name}-{value:.2f}", inputs={})
                row = grade(folder / f"run-{name}-{value:.2f}", folder / "truth.json")
                print(
                    f"| `{name}` | {value:.3g}{' (used)' * (value == used)} | `{case}` | {row.cells()} | {spent:.0f} |",
                    flush=True,
                )
            set_everywhere(name, used)


if __name__ == "__main__":
    main()
