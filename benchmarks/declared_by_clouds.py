"""Declared poses of a camera, judged by the clouds of free frames or by named markers, on the robots that come along.

    python benchmarks/declared_by_clouds.py [--robots NAME …] [--way WAY] [--seeds N] [--out FOLDER]

Recordings are those of calibration_robots.py: a finer mesh with another law, one camera drawn anywhere above, cables with initial inputs that are
told (known) or not (unknown). The true pose is declared to robots with the right modulus and a wrong one, and poses that are off in a
direction that is drawn. Cells: what `calibrate` says. *Modulus* is a warning that names both, pose and modulus. Prints the
tables "Declared poses" of docs/results/calibration.md: by clouds, and with `--way "named markers"`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from calibration_robots import WAYS, one_camera, recorded

from femsense import DataError, Recording, Robot, calibrate, load_recording, load_robot
from femsense.calib.from_clouds import pose_pivot
from femsense.core.arrays import FloatArray
from femsense.core.pose import move_pose

CASES = (
    ("right", 0.0, 0.0, 1.0),
    ("right, modulus × 0.6", 0.0, 0.0, 0.6),
    ("right, modulus × 1.67", 0.0, 0.0, 1.67),
    ("1 mm", 1e-3, 0.0, 1.0),
    ("2 mm", 2e-3, 0.0, 1.0),
    ("3 mm", 3e-3, 0.0, 1.0),
    ("5 mm", 5e-3, 0.0, 1.0),
    ("2°", 0.0, 2.0, 1.0),
    ("4°", 0.0, 4.0, 1.0),
)


def seen(robot: Robot, way: str, seed: int, folder: Path) -> Iterator[tuple[str, Recording, FloatArray]]:
    """Yield the recording of one camera as a way of calibrating has it, with initial inputs told and not told, and the true pose."""
    there = recorded(robot, seed, folder)
    truth = json.loads((there / "truth" / "truth.json").read_text())
    recording, T = WAYS[way](one_camera(load_recording(there))), np.array(truth["cameras"]["a"])
    if not robot.body.cables:
        yield "known", recording, T
        return
    initial = np.array([truth["cable_tension_n"][name] for name in robot.body.cable_names])
    yield "known", replace(recording, actuation_zero="absolute", inputs=recording.inputs + initial), T
    yield "unknown", recording, T


def answer(robot: Robot, recording: Recording, T: FloatArray) -> str:
    """Return what is said of a declared pose."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            calibrate(robot, replace(recording, T_robot_camera=(T,)))
        except DataError as error:
            return "refused" if "declared pose" in str(error) else "another error"
    texts = [str(one.message) for one in heard if "declared pose" in str(one.message)]
    return "–" if not texts else "modulus" if "a modulus" in texts[0] else "said"


def off(T: FloatArray, robot: Robot, shift: float, turn: float, rng: np.random.Generator) -> FloatArray:
    """Return a pose that is shifted [m] and turned [°] in a direction that is drawn."""
    ways = rng.normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return move_pose(T, np.concatenate([np.radians(turn) * ways[0], shift * ways[1]]), pivot_a=pose_pivot(robot))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", default=["finger", "arm", "gripper", "four-leg", "pneu-finger"])
    parser.add_argument("--way", choices=["clouds alone", "named markers", "markers and clouds"], default="clouds alone")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path, help="keep recordings here")
    options = parser.parse_args()
    print(f"| robot | initial inputs | {' | '.join(name for name, *_ in CASES)} |\n|---|---|{'---|' * len(CASES)}")
    every: dict[str, Counter[str]] = {name: Counter() for name, *_ in CASES}
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.robots:
            robot = load_robot(name)
            for seed in range(1, 1 + options.seeds):
                for zero, recording, T in seen(robot, options.way, seed, options.out or Path(temporary)):
                    cells = []
                    for i, (case, shift, turn, modulus) in enumerate(CASES):
                        judged = replace(robot, body=robot.body.with_stiffness_scale(modulus))
                        declared = off(T, robot, shift, turn, np.random.default_rng([seed, i]))
                        cells.append(answer(judged, recording, declared))
                        every[case][cells[-1]] += 1
                    print(f"| {name} | {zero} | {' | '.join(cells)} |", flush=True)
    print("\n" + "\n".join(f"{case}: {dict(counts)}" for case, counts in every.items()))


if __name__ == "__main__":
    main()
