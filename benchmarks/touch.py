"""Forces from clouds: the four-leg robot in front of its depth camera, touched by a ball at several places.

    python benchmarks/touch.py [--folder DIR]

The truth is that of `femsense demo` (half the element size, quadratic elements, neo-Hookean,
cables that rub) with other seeds; the robot that senses is declared with the effects that the truth has, on its own mesh. Forces
are sensed where contacts are found: in any direction, and along the normal that is seen.
"""

from __future__ import annotations

import argparse
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from femsense import Recording, Robot, SensingOptions, apply_effects, calibrate, estimate, load_recording, load_robot, simulate
from femsense.app.demo.truth import true_effects
from femsense.sensing.comparison import read_truth

PLACES = {
    "leg, from above": [0.0, -0.042964, 0.09057],
    "leg, from the side": [-0.043, -0.009, 0.085],
    "leg, ridge, left": [-0.05, 0.0, 0.089],
    "leg, ridge, right": [0.045, 0.0, 0.0895],
    "leg, outer face": [-0.0845, 0.0, 0.045],
}
DIRECTIONS = {"any": SensingOptions(), "normal": SensingOptions(friction=0.0)}


def script_of(robot: Robot, place: list[float], seed: int) -> dict[str, Any]:
    """Return the script of the demo with its touch at another place, with a seed of its noise."""
    assert robot.folder is not None
    script = tomllib.loads((robot.folder / "demo_script.toml").read_text(encoding="utf-8"))
    script["contacts"][0]["point_m"] = place
    return script | {"seed": seed}


def touched(folder: Path, robot: Robot, name: str, seed: int) -> Recording:
    """Return the recording of a touch, made if it is not there yet."""
    place = folder / f"{name.replace(', ', '-').replace(' ', '-')}-{seed}"
    if not (place / "recording.toml").is_file():
        simulate(robot, script_of(robot, PLACES[name], seed), place)
    return load_recording(place)


def errors_of(robot: Robot, recording: Recording, options: SensingOptions) -> np.ndarray:
    """Return error of the force relative to it, in standard deviations, and of the place [m], a row a contact that was found."""
    assert recording.folder is not None
    truth = {true.frame: true for true in read_truth(recording.folder)}
    rows = []
    for contact in estimate(robot, recording, calibrate(robot, recording), options=options).contacts:
        if contact.frame in truth:
            true = truth[contact.frame]
            force = float(np.linalg.norm(true.force_n_xyz))
            error = contact.force_n - force
            rows.append((error / force, error / contact.std_n, np.linalg.norm(contact.position_m - true.position_m)))
    return np.array(rows).reshape(-1, 3)


def row(name: str, direction: str, errors: np.ndarray) -> str:
    relative, z, place = errors.T
    cells = [
        name,
        direction,
        str(len(errors)),
        f"{np.median(np.abs(relative)):.1%}",
        f"{np.median(relative):+.1%}",
        f"{(np.abs(z) < 1).mean():.0%}",
        f"{(np.abs(z) < 2).mean():.0%}",
        f"{1e3 * np.median(place):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print a row for each place and direction, and one for all places together."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path)
    folder = parser.parse_args().folder or Path(tempfile.mkdtemp(prefix="touch-"))
    declared = load_robot("four-leg")
    every: dict[str, list[np.ndarray]] = {direction: [] for direction in DIRECTIONS}
    print("| touched | force along | contacts | error (median) | signed | within 1 std | within 2 std | place [mm] |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for seed, name in enumerate(PLACES, start=21):
        recording = touched(folder, declared, name, seed)
        assert recording.folder is not None
        robot = apply_effects(declared, true_effects(recording.folder))
        for direction, options in DIRECTIONS.items():
            every[direction].append(errors_of(robot, recording, options))
            print(row(name, direction, every[direction][-1]), flush=True)
    for direction, errors in every.items():
        print(row("all", direction, np.concatenate(errors)), flush=True)


if __name__ == "__main__":
    main()
