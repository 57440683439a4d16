"""A block robot that a camera watches: its recording, for software cameras, and sources that a test feeds by hand."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import numpy as np
from helpers import write_block_robot

from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.robot_toml import load_robot
from femsense.live.events import EventLog
from femsense.live.frames import Image, ImageKind, RawFrame
from femsense.model.robot import Robot
from femsense.pointcloud.cloud import PointCloud

T_ROBOT_CAMERA = make_pose(rotation_from_vector([2.4, 0.0, 0.0]), [0.05, 0.25, 0.28])
BLUE = (0.2, 0.4, 0.8)
NOISE = 2e-4
PLACE = np.array([0.1, 0.015, 0.03])
DT = 0.1


def write_watched_block(folder: Path, *, free: int = 14, touched: int = 4, force: float = 0.3) -> tuple[Path, Path]:
    """Write a robot, and a recording of `free` contact-free frames and `touched` frames with a force downward at its end.

    Returns the folders of both. Markers lie at their places; clouds are points of the faces that look at the camera.
    """
    home = write_block_robot(folder / "robot")
    robot = load_robot(home)
    place = folder / "recording"
    (place / "clouds").mkdir(parents=True)
    (place / "recording.toml").write_text(
        'format = "femsense-recording-1"\nactuation = "tension"\nactuation_zero = "absolute"\nmarker_noise_m = 0.0001\n'
    )
    rng = np.random.default_rng(4)
    frames, markers = ["frame,time_s,cable_top,cable_side"], ["frame,marker,x_m,y_m,z_m"]
    node = int(np.linalg.norm(robot.body.mesh.nodes - PLACE, axis=1).argmin())
    state = None
    for k in range(free + touched):
        top, side = (1.0 + np.cos(0.9 * k), 0.5 - 0.5 * np.cos(1.3 * k)) if k < free else (1.0, 0.5)
        loads = np.zeros_like(robot.body.mesh.nodes)
        loads[node, 2] = -force if k >= free else 0.0
        state = solve_equilibrium(robot.body, tension={"top": top, "side": side}, nodal_forces=loads, start=state)
        frames.append(f"{k},{DT * k:.1f},{float(top)!r},{float(side)!r}")
        seen = transform_points(invert_pose(T_ROBOT_CAMERA), robot.markers.positions(state.positions))
        seen = seen + 1e-4 * rng.normal(size=seen.shape)
        markers += [f"{k},{name},{x},{y},{z}" for name, (x, y, z) in zip(robot.marker_names, seen.tolist())]
        write_cloud(place / "clouds" / f"{k:06d}.ply", _cloud(robot, state.positions, rng))
    (place / "frames.csv").write_text("\n".join([*frames, ""]))
    (place / "markers.csv").write_text("\n".join([*markers, ""]))
    return home, place


def _cloud(robot: Robot, x: np.ndarray, rng: np.random.Generator) -> PointCloud:
    triangles = surface_triangles(robot.body.mesh)
    looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - x[triangles].mean(axis=1)) > 0
    corners = x[triangles[looks]]
    points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 30)), corners).reshape(-1, 3)
    ray = points - T_ROBOT_CAMERA[:3, 3]
    points = points + NOISE * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), np.tile(BLUE, (len(points), 1)))


def raw(number: int, stamp_s: float, arrived_s: float, **more: object) -> RawFrame:
    """Return a frame with an image of a few bytes."""
    return RawFrame(number, stamp_s, (Image(ImageKind.DEPTH, b"depth"),), arrived_s=arrived_s, **more)  # type: ignore[arg-type]


def notices(log: EventLog) -> dict[StrEnum, str]:
    """Return the text of each event that is shown."""
    return {event.kind: event.text for event in log.recent()}
