"""Clouds of the small arm, rendered from another mesh and law, with a table and things on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from arm import arm

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud
from femsense.rig.camera import Shape, camera_of, cloud_of, look_at, render
from femsense.rig.scene import floor_shape
from femsense.rig.script import NoiseTable, ViewTable

EYES = ([0.25, 0.2, 0.2], [-0.05, -0.25, 0.25])


def block(size: list[float], middle: list[float], color: list[float]) -> Shape:
    box = trimesh.creation.box(extents=size)
    return Shape(np.array(box.vertices) + middle, np.array(box.faces), np.array(color))


def with_clouds(
    folder: Path, recording: Recording, states: list[FloatArray], eyes: tuple[list[float], ...], *, clutter: bool, colored: bool
) -> tuple[Recording, list[FloatArray]]:
    """Return the recording with a cloud of each frame and camera, and the true poses."""
    truth, rng = arm((8, 3, 3), law="neo_hookean"), np.random.default_rng(5)
    poses = [look_at(eye, [0.05, 0.0, 0.0], roll=0.4 + i) for i, eye in enumerate(eyes)]
    things = [floor_shape(-0.06, np.array([0.7, 0.6, 0.5])), block([0.08, 0.06, 0.05], [0.12, 0.1, -0.035], [0.8, 0.2, 0.2])]
    things.append(block([0.04, 0.06, 0.06], [-0.021, 0.0, 0.0], [0.5, 0.5, 0.5]))
    files = []
    for k, state in enumerate(states):
        body = Shape(state, surface_triangles(truth.body.mesh), np.array([0.2, 0.4, 0.8]))
        row = []
        for v, T in enumerate(poses):
            camera = camera_of(ViewTable(eye_m=[0, 0, 1], target_m=[0, 0, 0]))
            cloud = cloud_of(render(camera, T, [body, *(things if clutter else [])], noise=NoiseTable(), rng=rng), camera)
            path = folder / f"{v}-{k}.ply"
            write_cloud(path, cloud if colored else PointCloud(cloud.points))
            row.append(path)
        files.append(tuple(row))
    V, none = len(eyes), np.zeros(0, np.int64)
    bare = replace(
        recording,
        camera_names=tuple("ab"[:V]),
        cameras=(None,) * V,
        T_robot_camera=(None,) * V,
        cloud_files=tuple(files),
        color_files=((None,) * V,) * len(files),
        marker_frame=none,
        marker_index=none,
        marker_view=none,
        marker_xyz=np.zeros((0, 3)),
    )
    return bare, poses
