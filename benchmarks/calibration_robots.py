"""Each way of calibrating on the robots that come along, one and two cameras, against the truth of the virtual rig.

    python benchmarks/calibration_robots.py [--robots NAME …] [--ways WAY …] [--seeds N] [--first SEED] [--out FOLDER]

Each seed puts two cameras anywhere above, 2 to 3.5 sizes of the robot away, and gives each cable (chambers: none) an initial input that
the recording does not tell. The truth has a finer mesh and another law; markers have noise of 0.2 mm, clouds that of a stereo camera.
*Over stated* is the root mean square of error over standard deviation: 1 is the bound by Cramér and Rao where the model is right. A pose is
*wrong* where it is more than 10 mm or 10° off and nothing is said; *said* counts what is refused, or has not settled.
Recordings are kept below OUT. Prints the table "On the robots that come along" of docs/results/calibration.md, and for each way which share of all
coordinates of poses and of all inputs lies within one, two and three of its standard deviations.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from calibration import step_between

from femsense import Calibration, FemsenseError, Recording, Robot, calibrate, load_recording, load_robot, simulate
from femsense.core.arrays import FloatArray

HEIGHT, INITIAL = 0.4, (0.05, 0.15)
"""Of a cable's largest tension."""


def script_of(robot: Robot, seed: int) -> dict:
    """Return one sweep an input under two cameras that are drawn."""
    rng = np.random.default_rng(seed)
    nodes = robot.body.mesh.nodes
    middle, size = nodes.mean(axis=0), float(np.linalg.norm(np.ptp(nodes, axis=0)))
    cables = {c.name: HEIGHT * c.max_tension for c in robot.body.cables}
    chambers = {c.name: HEIGHT * c.max_pressure for c in robot.body.chambers}
    inputs = [("cables", c, v) for c, v in cables.items()] + [("chambers", c, v) for c, v in chambers.items()]
    return {
        "format": "femsense-script-1",
        "seed": seed,
        "actuation": "tension",
        "actuation_zero": "unknown" if cables else "absolute",
        "initial": {name: float(rng.uniform(*INITIAL)) * value / HEIGHT for name, value in cables.items()},
        "sweeps": [{"label": c, kind: {c: v}, "rest": int(i == 0), "up": 1, "down": 0} for i, (kind, c, v) in enumerate(inputs)],
        "truth": {"substeps": 1},
        "cameras": {name: {"eye_m": eye(middle, size, rng), "target_m": middle.tolist()} for name in "ab"},
        "markers": {"std_m": 0.0002},
        "clouds": {"kind": "ply"},
        "scene": {"floor_z_m": float(nodes[:, 2].min() - 0.3 * size)},
    }


def eye(middle: FloatArray, size: float, rng: np.random.Generator) -> list[float]:
    """Return a place for a camera, 10° to 60° above the horizon."""
    around, up = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(10.0, 60.0))
    way = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    return (middle + rng.uniform(2.0, 3.5) * size * way).tolist()


# What the recording has


def one_camera(recording: Recording) -> Recording:
    """Return what the first camera saw."""
    mine = recording.marker_view == 0
    return replace(
        recording,
        camera_names=recording.camera_names[:1],
        cameras=recording.cameras[:1],
        T_robot_camera=recording.T_robot_camera[:1],
        cloud_files=tuple(files[:1] for files in recording.cloud_files),
        color_files=tuple(files[:1] for files in recording.color_files),
        marker_frame=recording.marker_frame[mine],
        marker_index=recording.marker_index[mine],
        marker_view=recording.marker_view[mine],
        marker_xyz=recording.marker_xyz[mine],
    )


def without_clouds(recording: Recording) -> Recording:
    files = tuple((None,) * len(recording.camera_names) for _ in range(recording.frame_count))
    return replace(recording, cloud_files=files, color_files=files)


def without_markers(recording: Recording) -> Recording:
    none = np.zeros(0, dtype=np.int64)
    return replace(recording, marker_frame=none, marker_index=none, marker_view=none, marker_xyz=np.zeros((0, 3)))


def without_names(recording: Recording) -> Recording:
    """Return the markers of each frame in an order of their own, without names."""
    order = np.random.default_rng(len(recording.marker_frame)).permutation(len(recording.marker_frame))
    order = order[np.argsort(recording.marker_frame[order], kind="stable")]
    told = {
        "unnamed_frame": recording.marker_frame[order],
        "unnamed_view": recording.marker_view[order],
        "unnamed_xyz": recording.marker_xyz[order],
    }
    return replace(without_markers(without_clouds(recording)), **told)


WAYS: dict[str, Callable[[Recording], Recording]] = {
    "named markers": without_clouds,
    "markers without names": without_names,
    "markers and clouds": lambda recording: recording,
    "clouds alone": without_markers,
}


# Against the truth


@dataclass(frozen=True)
class Errors:
    """Of one calibration that ended."""

    shift_m: float
    turn_rad: float
    pose: float
    """Over stated."""
    inputs: FloatArray
    """Error over the largest tension, each cable."""
    stated: FloatArray
    """Standard deviation over the largest tension, each cable."""
    coordinates: FloatArray
    """Errors of the pose over their standard deviations, shape (6,)."""


def errors_of(robot: Robot, found: Calibration, truth: dict) -> Errors:
    """Return the errors of a calibration."""
    step = step_between(found.poses[0], np.array(truth["cameras"]["a"]), robot.marker_points.mean(axis=0))
    most = np.array([c.max_tension for c in robot.body.cables])
    names = [c.name for c in robot.body.cables] if found.cable_tension_n else []
    off = np.array([found.cable_tension_n[n] - truth["cable_tension_n"][n] for n in names])
    std = np.array([found.tension_std_n[n] or np.inf for n in names])
    coordinates = step / np.sqrt(np.diag(found.pose_covariance))
    pose = float(np.sqrt(step @ np.linalg.solve(found.pose_covariance, step) / 6.0))
    scale = most[: len(names)]
    return Errors(float(np.linalg.norm(step[3:])), float(np.linalg.norm(step[:3])), pose, off / scale, std / scale, coordinates)


def row(robot: Robot, way: str, cameras: int, seeds: list[int], folder: Path) -> tuple[str, list[Errors]]:
    """Return a line of the table, and what ended right."""
    ended, said, wrong = list[Errors](), 0, 0
    for seed in seeds:
        there = recorded(robot, seed, folder)
        recording = load_recording(there)
        recording = WAYS[way](one_camera(recording) if cameras == 1 else recording)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = calibrate(robot, recording)
            except FemsenseError as error:
                print(f"  {robot.name}, {way}, {cameras}, seed {seed}: {str(error).splitlines()[0][:150]}", flush=True)
                said += 1
                continue
        one = errors_of(robot, found, json.loads((there / "truth" / "truth.json").read_text()))
        if not found.settled:
            print(f"  {robot.name}, {way}, {cameras}, seed {seed}: {found.status}; {1e3 * one.shift_m:.1f} mm off", flush=True)
            said += 1
        elif one.shift_m > 0.01 or one.turn_rad > np.radians(10.0):
            print(f"  {robot.name}, {way}, {cameras}, seed {seed}: WRONG, {1e3 * one.shift_m:.1f} mm", flush=True)
            wrong += 1
        else:
            ended.append(one)
    cells = [robot.name, way, cameras, f"{len(ended)} of {len(seeds)}", said, wrong, *told(ended)]
    return "| " + " | ".join(map(str, cells)) + " |", ended


def shares(way: str, ended: list[Errors]) -> list[str]:
    """Return lines of the table of shares within the standard deviations."""
    lines = []
    for name, parts in (("pose", [e.coordinates for e in ended]), ("inputs", [e.inputs / e.stated for e in ended])):
        size = np.abs(np.concatenate(parts)) if parts else np.zeros(0)
        if size.size:
            within = " | ".join(f"{100 * np.mean(size <= n):.0f} %" for n in (1, 2, 3))
            lines.append(f"| {way}: {name} | {within} | {size.max():.1f} | {np.sqrt(np.mean(size**2)):.1f} |")
    return lines


def told(ended: list[Errors]) -> list[str]:
    """Return medians and root mean squares of calibrations that ended right."""
    if not ended:
        return ["–"] * 5
    off, std = (np.concatenate([getattr(one, name) for one in ended]) for name in ("inputs", "stated"))
    inputs = [f"{100 * np.sqrt(np.mean(off**2)):.1f} %", f"{np.sqrt(np.mean((off / std) ** 2)):.1f}"] if off.size else ["–", "–"]
    return [
        f"{1e3 * np.median([one.shift_m for one in ended]):.2f} mm",
        f"{np.degrees(np.median([one.turn_rad for one in ended])):.2f}°",
        f"{np.sqrt(np.mean([one.pose**2 for one in ended])):.1f}",
        *inputs,
    ]


def recorded(robot: Robot, seed: int, folder: Path) -> Path:
    """Return the recording of a seed, simulated where there is none."""
    there = folder / f"{robot.name}-{seed}"
    if not (there / "truth" / "truth.json").is_file():
        simulate(robot, script_of(robot, seed), there)
    return there


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", default=["finger", "arm", "gripper", "four-leg", "pneu-finger"])
    parser.add_argument("--ways", nargs="*", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--out", type=Path, help="keep recordings here")
    options = parser.parse_args()
    print("| robot | way | cameras | right | said | wrong | shift | turn | over stated | inputs | over stated |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        seeds = list(range(options.first, options.first + options.seeds))
        right: dict[str, list[Errors]] = {way: [] for way in options.ways}
        for name in options.robots:
            for way in options.ways:
                for cameras in (1, 2):
                    line, ended = row(load_robot(name), way, cameras, seeds, options.out or Path(temporary))
                    print(line, flush=True)
                    right[way] += ended
    print("\n| | within 1 | within 2 | within 3 | largest | rms |\n|---|---|---|---|---|---|")
    for way, ended in right.items():
        print("\n".join(shares(way, ended)))


if __name__ == "__main__":
    main()
