"""An arm in clouds that is free in three frames and touched in the fourth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from arm import T_ROBOT_CAMERA, WIDTH, arm, record

from femsense.core.pose import invert_pose, move_pose, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud

PLACE = np.array([0.085, 0.0, 0.01])
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0]])
NOISE = 3e-4
_ALONG, _UP = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.1, 0.2, 60), np.linspace(0.0, 0.2, 40)))
WALLS = np.vstack(
    [
        np.column_stack([_ALONG, 0.5 * _UP - 0.1, np.full(len(_UP), -0.15)]),
        np.column_stack([_ALONG, np.full(len(_UP), -0.15), _UP - 0.1]),
        np.column_stack([np.full(len(_UP), -0.15), _ALONG - 0.05, _UP - 0.1]),
    ]
)
"""Points of a floor and of two walls [m]."""


def touched(
    folder: Path,
    force: np.ndarray,
    *,
    ball: bool,
    place: np.ndarray = PLACE,
    nudge: np.ndarray | None = None,
    wall: bool = False,
    noise: float = NOISE,
    inputs: np.ndarray = INPUTS,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
) -> Recording:
    """Return three free frames and one with forces, on an arm of another mesh and law; red balls push where they are shown.

    Arguments:
        force: or several, shape (3,) or (c, 3) [N].
        place: where each pushes, at rest, shape (3,) or (c, 3) [m].
        nudge: how the camera has moved in that frame: (rotation about the robot's origin [rad], shift [m]), shape (6,).
        wall: whether two walls stand around the arm.
        noise: of the points along their rays [m].
        inputs: tensions of the four frames [N], shape (4, 4).
        gravity: [m/s²].
    """
    true, rng, files = arm((8, 3, 3), law="neo_hookean", gravity=gravity), np.random.default_rng(11), []
    recording, states = record(inputs, noise=1e-4, forces={3: (place, force)}, truth=true)
    triangles = surface_triangles(true.body.mesh)
    nodes = [int(np.argmin(np.linalg.norm(true.body.mesh.nodes - one, axis=1))) for one in np.atleast_2d(place)]
    for k, x in enumerate(states):
        looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - x[triangles].mean(axis=1)) > 0
        corners = x[triangles[looks]]
        points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 12)), corners).reshape(-1, 3)
        shades = np.tile([0.2, 0.4, 0.8], (len(points), 1))
        for node, push in zip(nodes, np.atleast_2d(force)) if ball and k == 3 else ():
            out = rng.normal(size=(1500, 3))
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            away = -push / np.linalg.norm(push) if push.any() else np.array([0.0, 0.0, 1.0])
            middle = x[node] + 0.006 * away
            more = middle + 0.006 * out
            seen = np.einsum("pc,pc->p", out, T_ROBOT_CAMERA[:3, 3] - more) > 0
            if push[1] > 0.0:  # behind the arm: what stands out over the upper edge of the side that it pushes on
                edge = x[node] + [0.0, 0.0, 0.5 * WIDTH - true.body.mesh.nodes[node, 2]]
                sight = T_ROBOT_CAMERA[1:3, 3] - edge[1:]
                seen &= (more - edge)[:, 2] * sight[0] > (more - edge)[:, 1] * sight[1]
            more = more[seen]
            points, shades = np.vstack([points, more]), np.vstack([shades, np.tile([0.9, 0.1, 0.1], (len(more), 1))])
        if wall:
            points, shades = np.vstack([points, WALLS]), np.vstack([shades, np.full((len(WALLS), 3), 0.6)])
        pose = T_ROBOT_CAMERA if nudge is None or k != 3 else move_pose(T_ROBOT_CAMERA, nudge)
        ray = points - pose[:3, 3]
        points = points + noise * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        cloud = PointCloud(transform_points(invert_pose(pose), points), shades)
        write_cloud(folder / f"{k:06d}.ply", cloud)
        files.append((folder / f"{k:06d}.ply",))
    return replace(recording, free=np.array([True, True, True, False]), cloud_files=tuple(files), color_files=((None,),) * 4)
