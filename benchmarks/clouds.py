"""Effects found from clouds: the loop on a robot in front of a depth camera, from markers, from clouds and from both.

    python benchmarks/clouds.py [--robot four-leg|arm|gripper|finger] [--cases friction,gain,…] [--from markers,clouds,both] [--seed 20]
                                [--pose-off 1] [--without-colours] [--folder DIR]

The truth has a mesh of half the size, quadratic elements and the rig's own integrator of friction. The four-leg robot has also another law
(neo-Hookean; in the null case the declared one); its camera is that of `femsense demo`, with its noise. The others have a camera of the
same kind at their stands. Poses are declared, `--pose-off` times 2.7 mm and 7 mrad off.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense import ImproveOptions, Recording, Robot, improve, load_recording, load_robot, simulate
from femsense.core.pose import move_pose
from femsense.loop.result.records import Value

CASES: dict[str, dict[str, list[dict[str, Any]]]] = {
    "four-leg": {
        "friction": [{"name": "cable_friction", "coefficient": 0.2}],
        "gain": [{"name": "cable_gain", "scale": {"west": 0.8}}],
        "gravity": [{"name": "gravity", "vector_m_s2": [0.0, 0.0, -9.81]}],
        "depth": [{"name": "depth_scale", "scale": 1.015}],
        "payload": [{"name": "payload", "point_m": [-0.073, 0.0, 0.065], "force_n": [0.0, 0.1, -0.15]}],
        "soft": [{"name": "soft_region", "center_m": [0.0, -0.045, 0.085], "radius_m": 0.02, "scale": 0.5}],
        "null": [],
    },
    "arm": {
        "friction": [{"name": "cable_friction", "coefficient": 0.2}],
        "gain": [{"name": "cable_gain", "scale": {"east": 0.8}}],
        "gravity": [{"name": "gravity", "vector_m_s2": [0.0, 0.0, -9.81]}],
        "depth": [{"name": "depth_scale", "scale": 1.015}],
        "payload": [{"name": "payload", "point_m": [-0.007, -0.007, -0.18], "force_n": [0.0, 0.02, -0.03]}],
        "soft": [{"name": "soft_region", "center_m": [-0.0142, -0.0029, -0.09], "radius_m": 0.0224, "scale": 0.5}],
        "null": [],
    },
    "gripper": {
        "gain": [{"name": "cable_gain", "scale": {"right": 0.8}}],
        "soft": [{"name": "soft_region", "center_m": [-0.016, 0.0, -0.04625], "radius_m": 0.0136, "scale": 0.5}],
        "null": [],
    },
    "finger": {
        "gain": [{"name": "cable_gain", "scale": {"flexor": 0.8}}],
        "gravity": [{"name": "gravity", "vector_m_s2": [0.0, 0.0, -9.81]}],
        "depth": [{"name": "depth_scale", "scale": 1.015}],
        "soft": [{"name": "soft_region", "center_m": [0.045, -0.0085, 0.0021], "radius_m": 0.0115, "scale": 0.5}],
        "null": [],
    },
}
POSE_OFF = np.array([5e-3, -3e-3, 4e-3, 2e-3, -1e-3, 1.5e-3])
"""By how much the declared pose is off: rotation [rad], shift [m]."""


@dataclass(frozen=True)
class Stand:
    """Where a robot hangs or stands, and how far its cables pull."""

    cables: tuple[str, ...]
    pull_n: float
    eye_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    floor_m: float


STANDS = {
    "arm": Stand(("north", "west", "south", "east"), 2.25, (0.065, -0.3, 0.115), (0.0, 0.0, -0.09), -0.275),
    "gripper": Stand(("left", "right"), 0.45, (0.04, -0.182, 0.079), (0.0, 0.0, -0.046), -0.149),
    "finger": Stand(("flexor",), 0.72, (0.08, -0.154, 0.116), (0.046, 0.0, 0.01), -0.048),
}


def script_of(name: str, case: str, seed: int) -> dict[str, Any]:
    """Return the script of a case, with a seed of its noise and a depth image in every frame;
    what the demo's script says of camera and markers."""
    script = tomllib.loads((_folder("four-leg") / "demo_script.toml").read_text(encoding="utf-8"))
    script |= {
        "contacts": [],
        "effects": CASES[name][case],
        "actuation_zero": "absolute",
        "clouds": {"kind": "depth", "frames": "all"},
        "seed": seed,
    }
    script["camera"]["declare_pose"] = True
    if name in STANDS:
        return _at_its_stand(script, STANDS[name])
    script["sweeps"] = [sweep for sweep in script["sweeps"] if sweep["label"] != "touch"]
    script["truth"]["law"] = "corotational" if case == "null" else "neo_hookean"
    return script


def _at_its_stand(script: dict[str, Any], stand: Stand) -> dict[str, Any]:
    """Return a script with the sweeps of a robot at its stand, the law that is declared, and a camera that sees all of it."""
    cables, pull = stand.cables, stand.pull_n
    script.pop("initial")
    script["dt_s"] = 2.0
    script["sweeps"] = [
        *({"label": c, "cables": {c: pull}, "rest": 1, "up": 4, "down": 3} for c in cables),
        *({"label": f"{c} again", "cables": {c: 0.6 * pull}, "up": 3, "down": 3} for c in cables),
        {"label": "last", "cables": {c: (0.7 if cables[1:] else 0.8) * pull for c in cables[:2]}, "up": 3, "down": 3},
    ]
    script["truth"]["law"] = "corotational"
    script["camera"] |= {"eye_m": list(stand.eye_m), "target_m": list(stand.target_m)}
    script["scene"] = {"floor_z_m": stand.floor_m}
    return script


def _folder(name: str) -> Path:
    folder = load_robot(name).folder
    assert folder is not None
    return folder


def declared_robot(name: str, case: str) -> Robot:
    robot = load_robot(name)
    return robot.with_body(robot.body.with_gravity(np.zeros(3))) if case == "gravity" else robot


def recording_of(folder: Path, name: str, case: str, seed: int, pose_off: float) -> Recording:
    """Return the recording of a case, made if it is not there yet."""
    place = folder / f"{name}-{case}-{seed}"
    if not (place / "recording.toml").is_file():
        simulate(declared_robot(name, case), script_of(name, case, seed), place)
    recording = load_recording(place)
    pose = recording.T_robot_camera[0]
    assert pose is not None
    return replace(recording, T_robot_camera=(move_pose(pose, pose_off * POSE_OFF, pivot_a=np.zeros(3)),))


def size_of(loop: Any, truth: dict[str, Any]) -> str:
    """Return the values that were found beside the true ones."""
    entry = next((e for e in loop.effects if e.name == truth["name"]), None)
    if entry is None:
        return "–"
    return ", ".join(_off(key, entry.parameters[key], true) for key, true in truth.items() if key != "name")


def _off(key: str, found: Value, true: Any) -> str:
    value, std = found.value, found.std
    if isinstance(value, list):
        away = float(np.linalg.norm(np.subtract(value, true)))
        return f"place {1e3 * away:.0f} mm off" if key.endswith("_m") else f"{away / np.linalg.norm(true):.1%} off"
    if isinstance(value, dict):
        if isinstance(true, dict) and not set(true) <= set(value):
            return f"{key} of {', '.join(value)} (true: {', '.join(true)})"
        value, std = (float(np.mean([t[k] for k in (true if isinstance(true, dict) else value)])) for t in (value, std))
    true = float(np.mean(list(true.values()))) if isinstance(true, dict) else true
    unit = f"{key.removesuffix('_m')} " if key.endswith("_m") else ""
    spread = "" if std is None else f" ± {std:.1g}"
    return f"{unit}{value:.4g}{spread} (true {true:g})"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robot", choices=CASES, default="four-leg")
    parser.add_argument("--cases", help="default: all of the robot's")
    parser.add_argument("--from", dest="kinds", default="markers,clouds,both")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--pose-off", type=float, default=1.0, help="0: as it is")
    parser.add_argument("--without-colours", action="store_true", help="the camera has depth alone")
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="clouds-"))
    print("| hidden | from | verdict | named | size | held out, markers [mm] | held out, clouds [mm] | noise [mm] | CPU [s] |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for case in options.cases.split(",") if options.cases else CASES[options.robot]:
        recording = recording_of(folder, options.robot, case, options.seed, options.pose_off)
        if options.without_colours:
            recording = replace(recording, color_files=tuple((None,) * len(files) for files in recording.color_files))
        for kind in options.kinds.split(","):
            began = time.process_time()
            loop = improve(declared_robot(options.robot, case), [recording], options=ImproveOptions(measured=kind))
            print(row(case, CASES[options.robot][case], kind, loop, time.process_time() - began), flush=True)


def row(case: str, hidden: list[dict[str, Any]], kind: str, loop: Any, seconds: float) -> str:
    def fall(key: str) -> str:
        ends = [getattr(part, key) for part in (loop.before, loop.after)]
        return "–" if None in ends else f"{1e3 * ends[0]:.3f} → {1e3 * ends[1]:.3f}"

    marked = "–" if kind == "clouds" else fall("validation_rms_m")
    named = ", ".join(e.name for e in loop.effects) or "–"
    size = size_of(loop, hidden[0]) if hidden else "–"
    cells = [
        case,
        kind,
        loop.verdict,
        named,
        size,
        marked,
        fall("validation_normal_rms_m"),
        f"{1e3 * loop.noise_m:.3f}",
        f"{seconds:.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
