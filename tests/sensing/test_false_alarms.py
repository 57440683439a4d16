"""What free frames say of how much a contact has to explain."""

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
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.contact_free import learn
from femsense.sensing.odds import INFERRED
from femsense.sensing.prepare import make_sensor

INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.2, 0, 0, 0], [0.0, 0, 0.4, 0], [0.3, 0, 0.3, 0]])


def seen_free(folder: Path, pull: float) -> Recording:
    """Return six free frames of an arm of another mesh and law; something that no model has pulls at it in two of them [N]."""
    wrong = {k: (np.array([0.085, 0.0, 0.01]), np.array([0.0, 0.0, -pull])) for k in (2, 4)}
    recording, states = record(INPUTS, noise=1e-4, forces=wrong if pull else None)
    triangles, rng, files = surface_triangles(arm((8, 3, 3), law="neo_hookean").body.mesh), np.random.default_rng(3), []
    for k, x in enumerate(states):
        looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - x[triangles].mean(axis=1)) > 0
        corners = x[triangles[looks]]
        points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 12)), corners).reshape(-1, 3)
        ray = (points - T_ROBOT_CAMERA[:3, 3]) / np.linalg.norm(points - T_ROBOT_CAMERA[:3, 3], axis=1, keepdims=True)
        off = 3e-4 * rng.normal(size=len(points))
        shades = np.tile([0.2, 0.4, 0.8], (len(points), 1))
        write_cloud(
            folder / f"{k:06d}.ply",
            PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points + off[:, None] * ray), shades),
        )
        files.append((folder / f"{k:06d}.ply",))
    return replace(recording, free=np.ones(len(INPUTS), bool), cloud_files=tuple(files), color_files=((None,),) * len(INPUTS))


def limit(folder: Path, pull: float) -> float:
    folder.mkdir()
    seen = seen_free(folder, pull)
    calibration = calibrate(arm(), seen)
    return learn(make_sensor(arm(), seen, calibration)).inferred_odds


def test_a_contact_has_to_explain_more_than_errors_that_other_free_frames_do_not_teach(tmp_path: Path) -> None:
    assert limit(tmp_path / "plain", 0.0) == pytest.approx(INFERRED, abs=5.0)
    assert limit(tmp_path / "pulled", 0.05) > 3.0 * INFERRED
