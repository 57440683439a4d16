"""Forces where the camera's pose is declared, exactly or somewhat off: what the prior of such a pose does. Truths by the independent generator.

    python benchmarks/declared_pose.py OUT [--seed S] [--case NAME …] [--off DEG,MM …] [--prior FACTOR …]

A prior of 0 takes the pose for exact; 1 is `DECLARED_STD`, and 0.3 what sensing has. "Wrong, ok": forces that are more than 30 % and two standard
deviations off in a frame that is ok. A run that stands in OUT already is read, not computed again. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from independent.cases import CASES
from independent.declared import declare
from independent.grade import grade
from independent.make import make

from femsense import calibrate, estimate, load_recording, load_robot
from femsense.calib.declared_poses import DECLARED_STD
from femsense.sensing import prepare
from femsense.sensing.run_files import write_run


def main() -> None:
    """Print a row for each case, pose and prior."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--case", nargs="*", default=["bar-gray", "arm-gray", "slab-gray"])
    ask.add_argument(
        "--off", nargs="*", default=["0,0", "0.1,0.07", "0.3,0.5"], help="turn [°] and shift [mm] of the declared pose"
    )
    ask.add_argument("--prior", nargs="*", type=float, default=[0.0, 0.3, 1.0])
    given = ask.parse_args()
    warnings.simplefilter("ignore")
    print(
        "| case | pose off by | prior | error of force, median | 95th percentile | place | missed (quiet) | false | within 95 % | wrong, ok |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in given.case:
        case = given.out / name
        if not (case / "truth.json").exists():
            make(next(c for c in CASES if c.name == name), case, given.seed)
        for off in given.off:
            turn, shift = map(float, off.split(","))
            folder = given.out / f"{name}-{turn:g}-{shift:g}"
            if not (folder / "truth.json").exists():
                declare(case, folder, turn, 1e-3 * shift, given.seed)
            for factor in given.prior:
                run = folder / f"run-{factor:g}"
                if not (run / "frames.csv").exists():
                    prepare.POSE_STD = factor * DECLARED_STD
                    robot, recording = load_robot(folder / "robot"), load_recording(folder / "recording")
                    write_run(estimate(robot, recording, calibrate(robot, recording)), run, inputs={})
                row = grade(run, folder / "truth.json")
                print(f"| `{name}` | {turn:g}°, {shift:g} mm | {factor:g} | {row.cells()} | {row.wrong_quietly} |", flush=True)


if __name__ == "__main__":
    main()
