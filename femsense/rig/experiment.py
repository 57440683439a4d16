"""A virtual experiment before it is written: its true states and its cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.model.camera import Camera, CameraNoise
from femsense.model.robot import Robot
from femsense.rig.camera import camera_of, pose_of
from femsense.rig.camera_tables import ViewTable
from femsense.rig.plan import Plan
from femsense.rig.script import ScriptTable
from femsense.rig.true_path import TrueFrame

STREAMS = {"placement": 1, "markers": 2, "inputs": 3, "rest": 4, "clouds": 5, "sensors": 6}
"""Each kind of noise has its own stream of random numbers, so that disabling one does not change the others. (7:
the motors, `rig/plan.py`.)"""
DIGITS = 9
"""Decimals of written positions: nanometres, so that rounding errors of a solver do not change a file."""
MATT = 0.5
"""Typical albedo times cosine of the scene, for the noise that a recording declares of a time-of-flight camera."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """A camera of an experiment."""

    name: str
    """"" if there is only one."""
    table: ViewTable
    camera: Camera
    T_robot_camera: FloatArray
    """Shape (4, 4)."""


@dataclass(frozen=True, eq=False, slots=True)
class Experiment:
    """A simulated experiment before it is written."""

    script: ScriptTable
    plan: Plan
    """Of the converged frames."""
    numbers: IntArray
    """Numbers of these frames in the script, shape (F,)."""
    skipped: tuple[tuple[int, str], ...]
    """Frames of the script that did not converge, with the reason."""
    declared: Robot
    """The robot that the estimator is given."""
    robot: Robot
    """The true robot, with its markers at their true places."""
    views: tuple[View, ...]
    """Its cameras."""
    frames: tuple[TrueFrame, ...]
    marker_positions: FloatArray
    """True positions of the markers [m], shape (F, k, 3), robot frame."""
    visible: BoolArray
    """Which markers each camera sees, shape (V, F, k)."""
    folder: Path
    """Folder of the object meshes."""


def views_of(script: ScriptTable, robot: Robot) -> tuple[View, ...]:
    """Return the cameras of a script, with declared noise if the script requests it. Raises InputError."""
    result = []
    for name, table in script.views.items():
        T = pose_of(table)
        camera = camera_of(table, name, noise=noise_of(table, T, robot) if table.declare_noise else None)
        result.append(View(name, table, camera, T))
    return tuple(result)


def rng_of(script: ScriptTable, stream: str, *more: int) -> np.random.Generator:
    """Return the random number generator of one kind of noise."""
    return np.random.default_rng([script.seed, STREAMS[stream], *more])


def cloud_frames(script: ScriptTable, plan: Plan) -> list[int]:
    """Return the indices of the frames with a cloud, without `extra_frames`."""
    if script.clouds.kind == "none":
        return []
    if script.clouds.frames == "all":
        return list(range(len(plan.time_s)))
    touched = np.zeros(len(plan.time_s), dtype=bool)
    for contact in plan.contacts:
        touched |= contact.force > 0
    return np.flatnonzero(touched).tolist()


def noise_of(table: ViewTable, T_robot_camera: FloatArray, robot: Robot) -> CameraNoise | None:
    """Return the noise that the recording declares; for time of flight its size at the distance of the body."""
    noise = table.noise
    if noise is None or noise.kind == "perfect":
        return None
    if noise.kind == "stereo":
        return CameraNoise("stereo", at_1m=noise.subpixel_px / ((noise.focal_px or table.fx) * noise.baseline_m))
    far = float(np.linalg.norm(robot.body.mesh.nodes.mean(axis=0) - T_robot_camera[:3, 3]))
    return CameraNoise("tof", slope=noise.amplitude_std_m / MATT * far)
