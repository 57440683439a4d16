"""Real motion capture of a silicone beam under known weights: modulus, forces, and the effect that the model lacks.

Prints what README and docs say of `data/beam`. Needs the data folder beside the project (or its path as the argument).
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

from femsense.calib.calibrate import calibrate
from femsense.loop import improve
from femsense.recording import load_recording
from femsense.robot import load_robot
from femsense.sensing import estimate

EDGE = [[0.1, 0.0, 0.015]]
"""The middle of the loaded edge at rest [m]."""


def main(data: Path) -> None:
    """Print modulus from the unloaded run, the weights sensed with it, and the loop on the model without gravity."""
    recordings = {name: load_recording(data / "recordings" / name) for name in ("gravity_a", "load52_a", "load101_a")}
    began = time.perf_counter()
    loop = improve(load_robot(data / "robot_gravity"), [recordings["gravity_a"]])
    print(f"gravity_a, gravity declared: {loop.sentence} ({time.perf_counter() - began:.0f} s)")
    for effect in loop.effects:
        print(f"  {effect['name']}: {effect['parameters']}")
    for name in ("load52_a", "load101_a"):
        run = estimate(loop.robot, recordings[name], calibrate(loop.robot, recordings[name]), at=EDGE)
        for contact, known in list(zip(run.contacts, run.known_loads))[:1]:
            print(
                f"{name}: {known['declared_n']:.3f} N declared, {contact.force_n:.3f} ± {contact.std_n:.3f} N sensed ({known['error_percent']:+.1f} %)"
            )
    began = time.perf_counter()
    loop = improve(
        load_robot(data / "robot"), [recordings["gravity_a"], recordings["load52_a"]], validation=[recordings["load101_a"]]
    )
    print(
        f"gravity undeclared, fit on 0 and 0.51 N, judged on 1.00 N: {loop.verdict}: {loop.sentence} ({time.perf_counter() - began:.0f} s)"
    )
    for effect in loop.effects:
        print(f"  {effect['name']}: {effect['parameters']}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1].parent / "shared" / "data" / "beam")
