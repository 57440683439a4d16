"""Objects that recording.toml declares: their shape says where they touch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record

from femsense.calib.calibrate import calibrate
from femsense.core.pose import invert_pose, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.recording import Recording
from femsense.model.recording_parts import Tool
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.rays import Surface
from femsense.sensing.pipeline import estimate
from femsense.sensing.places import fit_tool

PLACE = np.array([0.085, 0.0, 0.01])
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0]])
NOISE = 3e-4
LEAN = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


def cone() -> tuple[np.ndarray, np.ndarray]:
    """Return points and outward triangles of a cone on its tip: 25 mm high, 8 mm radius."""
    angle = 2 * np.pi * np.arange(40) / 40
    points = np.vstack(
        [np.column_stack([0.008 * np.cos(angle), 0.008 * np.sin(angle), np.full(40, 0.025)]), np.zeros(3), [0, 0, 0.025]]
    )
    i, j = np.arange(40), (np.arange(40) + 1) % 40
    sides = np.column_stack([j, i, np.full(40, 40)])
    return points, np.vstack([sides, np.column_stack([i, j, np.full(40, 41)])])


def shown(x: np.ndarray, triangles: np.ndarray, each: int, rng: np.random.Generator) -> np.ndarray:
    """Return points on the faces that look at the camera and are not hidden."""
    corners = x[triangles]
    facing = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - corners.mean(axis=1)) > 0
    weights = rng.dirichlet(np.ones(3), size=(int(facing.sum()), each))
    return np.einsum("tsi,tic->tsc", weights, corners[facing]).reshape(-1, 3)


def pressed_by_a_cone(folder: Path) -> tuple[Recording, np.ndarray]:
    """Return three free frames and one in which the tip of a red cone presses on an arm of another mesh and law.

    And where it touches."""
    recording, states = record(INPUTS, noise=1e-4, forces={3: (PLACE, np.array([0.0, 0.0, -0.15]))})
    mesh, rng, files = arm((8, 3, 3), law="neo_hookean").body.mesh, np.random.default_rng(11), []
    triangles = surface_triangles(mesh)
    touched = states[3][int(np.argmin(np.linalg.norm(mesh.nodes - PLACE, axis=1)))]
    for k, x in enumerate(states):
        points = shown(x, triangles, 12, rng)
        shades = np.tile([0.2, 0.4, 0.8], (len(points), 1))
        if k == 3:
            shape, faces = cone()
            stands = shape @ LEAN.T + touched
            more = shown(stands, faces, 25, rng)
            origins = np.tile(T_ROBOT_CAMERA[:3, 3], (len(more), 1))
            more = more[Surface(stands, faces).cast(more, origins, reach=1e-5).index]
            points, shades = np.vstack([points, more]), np.vstack([shades, np.tile([0.9, 0.1, 0.1], (len(more), 1))])
        ray = points - T_ROBOT_CAMERA[:3, 3]
        points = points + NOISE * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        write_cloud(folder / f"{k:06d}.ply", PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), shades))
        files.append((folder / f"{k:06d}.ply",))
    recording = replace(recording, free=np.array([True] * 3 + [False]), cloud_files=tuple(files), color_files=((None,),) * 4)
    return recording, touched


def test_the_mesh_of_a_tool_says_where_it_touches(tmp_path: Path) -> None:
    recording, touched = pressed_by_a_cone(tmp_path)
    points, triangles = cone()
    declared = replace(recording, tools=(Tool("cone", "mesh", points=points, triangles=triangles),))
    calibration = calibrate(arm(), recording)
    known, unknown = (estimate(arm(), r, calibration).contacts[-1] for r in (declared, recording))
    off = float(np.linalg.norm(known.position_m - touched))
    assert known.source == "cloud"
    assert off < 0.0004 and off < 3 * np.linalg.norm(known.position_std_m)
    assert known.force_n == pytest.approx(0.15, rel=0.1)
    assert known.radius_m < unknown.radius_m  # a tip presses on less than what looks like a ball


def test_a_table_beside_a_known_ball_is_a_plate():
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-0.03, 0.03, (300, 2)), np.zeros(300)])
    normals = rng.normal(size=(300, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.5]
    ball = 0.008 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    tools, camera = (Tool("ball", "ball", 0.008),), np.array([0.0, 0.0, 0.4])
    kinds = []
    for points in (flat, ball):
        ray = points - camera
        noisy = points + NOISE * rng.normal(size=(300, 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        shape = fit_tool(tools, noisy, np.full(300, NOISE), np.tile(camera, (300, 1)))
        kinds.append(shape.kind)
        off = shape.distance(np.array([[0.0, 0.0, 0.023]])) - (0.023 if points is flat else 0.015)
        assert abs(float(off[0])) < 3e-4  # what is not completed is known to 6 mm: a body far above it would be touched
    assert kinds == ["plate", "sphere"]
