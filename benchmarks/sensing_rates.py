"""How long a frame takes from raw cloud to force, by stage: `benchmarks/sensing.py --rates`."""

from __future__ import annotations

import shutil
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from independent.cases import CASES
from independent.cases import FREE as FREE_BY_ANOTHER
from independent.make import make

from femsense import Recording, Robot, calibrate, load_recording, load_robot, simulate
from femsense.core.parallel import one_blas_thread
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.io.files import write_toml
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import sense
from femsense.sensing.prepare import make_sensor
from femsense.sensing.types import SensedFrame

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
FREE, TOUCHED = 4, 8
PLACE = [0.0, -0.0429, 0.0906]
STAGES = ("equilibrium", "read", "objects", "fit", "search", "rms", "check")


def print_rates(points: int, folder: Path) -> None:
    """Print a table: seconds before the first frame, then the median processor time of each stage over touched frames, of untouched ones, and frames a second.

    Linear elements meet a body of the same linear elements, made by the rig. Quadratic ones meet a body of quadratic elements on another mesh, of
    another law, made by another program (`independent`). Recordings that are in the folder are taken from there.
    """
    print(f"data/diamond, {points} points a frame, one touch; processor time [ms], medians of touched frames")
    print("beside: the paper 143 (7 Hz, all of it), SOFA 16-19 (its quadratic programme alone)")
    print(
        "| | ready [s] | on the robot | equilibrium | read | objects | fit | search | rms | check | together | rate | first contact | untouched | not ok |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    for label in ("tet4", "tet4, no colour", "tet10"):
        print(_row(label, *_made(label, points, folder)), flush=True)


def _made(label: str, points: int, folder: Path) -> tuple[Robot, Recording, int]:
    """Return robot, recording and its number of free frames, made where they are not in the folder yet."""
    made = folder / ("other" if label == "tet10" else "rig")
    if not (made / "made").exists():
        shutil.rmtree(made, ignore_errors=True)
        if label == "tet10":
            make(next(case for case in CASES if case.name == "diamond-normal"), made, 1, diamond=DIAMOND)
        else:
            made.mkdir(parents=True)
            simulate(_linear(made / "robot"), _script(), made / "recording")
        _thin(made / "recording", points)
        (made / "made").touch()
    robot = load_robot(made / "robot")
    robot = replace(robot, color_rgb=None) if label.endswith("no colour") else robot
    return robot, load_recording(made / "recording"), FREE_BY_ANOTHER if label == "tet10" else FREE


def _linear(folder: Path) -> Robot:
    document = tomllib.loads((DIAMOND / "robot.toml").read_text(encoding="utf-8"))
    document["mesh"] |= {"element": "tet4", "file": str(DIAMOND / "diamond.vtu")}
    document["appearance"] = {"color_rgb": [0.2, 0.4, 0.8]}
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


def _thin(folder: Path, points: int) -> None:
    """Leave so many points at most in each cloud of a recording, drawn at random."""
    for file in sorted((folder / "clouds").glob("*.ply")):
        cloud = read_cloud(file)
        kept = np.sort(np.random.default_rng(0).choice(len(cloud.points), min(points, len(cloud.points)), replace=False))
        write_cloud(file, PointCloud(cloud.points[kept], None if cloud.colors is None else cloud.colors[kept]))


@one_blas_thread()
def _row(label: str, robot: Robot, recording: Recording, free: int) -> str:
    """Return a row of the table: frames from `free` on are touched, the first of them finds the contact and does not count."""
    calibration = calibrate(robot, recording)
    began = time.process_time()
    model = learn(make_sensor(robot, recording, calibration))
    ready = time.process_time() - began
    last: SensedFrame | None = None
    first = 0.0
    seen: dict[bool, list[SensedFrame]] = {False: [], True: []}
    times: dict[bool, list[float]] = {False: [], True: []}
    for k in range(free + TOUCHED):
        began = time.process_time()
        last = sense(model, k, last)
        if k == free:
            first = 1e3 * (time.process_time() - began)
        if k not in (0, free):
            times[k > free].append(1e3 * (time.process_time() - began))
            seen[k > free].append(last)
    shares = [
        t / sum(f.report.stages_ms.values()) for t, f in zip(times[True], seen[True])
    ]  # other programs take the processor, too
    stages = [float(np.median([s * f.report.stages_ms.get(name, 0.0) for s, f in zip(shares, seen[True])])) for name in STAGES]
    together, untouched = (float(np.median(times[touched])) for touched in (True, False))
    bad = sum(f.report.status != "ok" or not f.contacts for f in seen[True])
    met = int(np.median([f.report.matched for f in seen[True]]))
    told = " | ".join(f"{value:.0f}" for value in stages)
    return f"| {label} | {ready:.1f} | {met} | {told} | {together:.0f} | {1000.0 / together:.1f} Hz | {first:.0f} | {untouched:.0f} | {bad}/{len(seen[True])} |"
