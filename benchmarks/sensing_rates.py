"""How long a frame takes from raw cloud to force, by stage: `benchmarks/sensing.py --rates`."""

from __future__ import annotations

import tempfile
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense import Robot, calibrate, load_recording, load_robot, simulate
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.io.files import write_toml
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.pipeline import sense_frame
from femsense.sensing.prepare import make_sensor
from femsense.sensing.types import SensedFrame

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
FREE, TOUCHED = 3, 8
PLACE = [0.0, -0.0429, 0.0906]


def print_rates(points: int) -> None:
    """Print median time of each stage over touched frames, processor time and frames a second, a row for each element.

    The truth stands on the same mesh of linear elements: tet10 is softer than it, and many of its steps are tried in vain.
    """
    print(f"data/diamond, {points} points a frame, one touch, processor time [ms]")
    print("beside: the paper 143 (7 Hz, all of it), SOFA 16-19 (its quadratic programme alone)")
    for element, colour in (("tet4", True), ("tet4", False), ("tet10", True)):
        with tempfile.TemporaryDirectory() as folder:
            robot = _robot(element, Path(folder) / "robot")
            robot = robot if colour else replace(robot, color_rgb=None)
            stages, total = _stages(robot, Path(folder) / "recording", points)
        told = ", ".join(f"{name} {value:.0f}" for name, value in stages.items())
        print(f"{element}{'' if colour else ', no colour'}: {told}; together {total:.0f}, {1000.0 / total:.1f} Hz", flush=True)


def _robot(element: str, folder: Path) -> Robot:
    document = tomllib.loads((DIAMOND / "robot.toml").read_text(encoding="utf-8"))
    document["mesh"] |= {"element": element, "file": str(DIAMOND / "diamond.vtu")}
    document["appearance"] = {"color_rgb": [0.2, 0.4, 0.8]}  # without a colour the hidden search tells robot from ball
    folder.mkdir()
    write_toml(folder / "robot.toml", document)
    return load_robot(folder)


def _script() -> dict[str, Any]:
    cables = {"north": [0.6 + 0.05 * np.sin(0.5 * k) for k in range(FREE + TOUCHED)], "west": [0.5] * (FREE + TOUCHED)}
    calm = {name: [float(v) for v in values[:FREE]] for name, values in cables.items()}
    during = {name: [float(v) for v in values[FREE:]] for name, values in cables.items()}
    return {
        "format": "femsense-script-1",
        "sweeps": [
            {"label": "free", "cables": calm, "up": 0, "hold": FREE, "down": 0, "free": True},
            {"label": "touch", "cables": during, "up": 0, "hold": TOUCHED, "down": 0},
        ],
        "objects": [{"name": "ball", "kind": "ball"}],
        "contacts": [{"sweep": "touch", "object": "ball", "point_m": PLACE, "force_n": np.linspace(0.1, 0.3, TOUCHED).tolist()}],
        "truth": {"refinements": 0, "element": "tet4", "substeps": 1},
        "clouds": {"kind": "ply"},
        "camera": {"eye_m": [-0.16, -0.30, 0.34], "target_m": [0.0, 0.0, 0.05], "width": 848, "height": 480, "fx": 612.0}
        | {"noise": {"kind": "stereo"}, "declare_pose": True},
    }


def _stages(robot: Robot, folder: Path, points: int) -> tuple[dict[str, float], float]:
    simulate(robot, _script(), folder)
    for file in (folder / "clouds").glob("*.ply"):
        cloud = read_cloud(file)
        kept = np.random.default_rng(0).choice(len(cloud.points), min(points, len(cloud.points)), replace=False)
        colors = None if cloud.colors is None else cloud.colors[np.sort(kept)]
        write_cloud(file, PointCloud(cloud.points[np.sort(kept)], colors))
    recording = load_recording(folder)
    sensor = make_sensor(robot, recording, calibrate(robot, recording))
    last: SensedFrame | None = None
    times, stages = [], []
    for k in range(FREE + TOUCHED):
        began = time.process_time()
        last = sense_frame(sensor, k, last)
        if k > FREE:
            times.append(1e3 * (time.process_time() - began))
            share = times[-1] / sum(last.report.stages_ms.values())  # other programs take the processor, too
            stages.append({name: share * value for name, value in last.report.stages_ms.items()})
    return {name: float(np.median([s[name] for s in stages])) for name in stages[0]}, float(np.median(times))
