"""An arm in clouds that is free in three frames and touched in the fourth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from arm import T_ROBOT_CAMERA, arm, record

from femsense.core.pose import invert_pose, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud

PLACE = np.array([0.085, 0.0, 0.01])
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0]])
NOISE = 3e-4


def touched(folder: Path, force: np.ndarray, *, ball: bool) -> Recording:
    """Return three free frames and one with a force on the upper face, on an arm of another mesh and law; a red ball pushes where it is shown."""
    recording, states = record(INPUTS, noise=1e-4, forces={3: (PLACE, force)})
    true, rng, files = arm((8, 3, 3), law="neo_hookean"), np.random.default_rng(11), []
    triangles = surface_triangles(true.body.mesh)
    node = int(np.argmin(np.linalg.norm(true.body.mesh.nodes - PLACE, axis=1)))
    for k, x in enumerate(states):
        looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - x[triangles].mean(axis=1)) > 0
        corners = x[triangles[looks]]
        points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 12)), corners).reshape(-1, 3)
        shades = np.tile([0.2, 0.4, 0.8], (len(points), 1))
        if ball and k == 3:
            out = rng.normal(size=(1500, 3))
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            more = x[node] + [0, 0, 0.006] + 0.006 * out
            more = more[np.einsum("pc,pc->p", out, T_ROBOT_CAMERA[:3, 3] - more) > 0]
            points, shades = np.vstack([points, more]), np.vstack([shades, np.tile([0.9, 0.1, 0.1], (len(more), 1))])
        ray = points - T_ROBOT_CAMERA[:3, 3]
        points = points + NOISE * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        cloud = PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), shades)
        write_cloud(folder / f"{k:06d}.ply", cloud)
        files.append((folder / f"{k:06d}.ply",))
    return replace(recording, free=np.array([True, True, True, False]), cloud_files=tuple(files), color_files=((None,),) * 4)
