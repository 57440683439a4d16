"""Forces of which the data do not determine all components: what is not known does not inflate what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import DATA

from femsense.calib.calibrate import calibrate
from femsense.core.pose import rotation_from_vector
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.recording import select_frames
from femsense.sensing.force_step import without_undetermined
from femsense.sensing.pipeline import estimate

BEAM = DATA / "beam"
MODULUS = 1.857
"""What `improve` finds from gravity_a alone."""


def test_the_size_of_a_force_with_an_unknown_component_is_not_inflated() -> None:
    covariance = np.diag([0.3, 0.02, 0.02]) ** 2
    drawn = np.array([0.0, 0.0, 0.5]) + np.random.default_rng(0).normal(size=(2000, 3)) * np.sqrt(np.diag(covariance))
    shrunk = np.linalg.norm([without_undetermined(f, covariance) for f in drawn], axis=1)
    plain = np.linalg.norm(drawn, axis=1)
    assert np.mean(plain) > 0.57 and np.mean(shrunk) < 0.54
    assert np.sqrt(np.mean((shrunk - 0.5) ** 2)) < 0.7 * np.sqrt(np.mean((plain - 0.5) ** 2))


def test_what_is_known_stays_and_no_axis_is_preferred() -> None:
    force, covariance = np.array([0.2, -0.1, 0.4]), np.diag([0.25, 0.01, 0.01]) ** 2
    np.testing.assert_allclose(without_undetermined(force, covariance), [0.0, -0.1, 0.4], atol=1e-12)
    np.testing.assert_allclose(without_undetermined(force, 0.01 * np.eye(3)), force, atol=1e-12)
    Q = rotation_from_vector([0.3, -0.8, 0.5])
    turned = without_undetermined(Q @ force, Q @ covariance @ Q.T)
    np.testing.assert_allclose(turned, Q @ without_undetermined(force, covariance), atol=1e-12)


@pytest.mark.skipif(not BEAM.is_dir(), reason="data/beam is not beside the project")
@pytest.mark.parametrize(("name", "weight"), [("load52_a", 0.51012), ("load101_a", 1.00062)])
def test_weights_that_hang_from_a_real_beam(name: str, weight: float) -> None:
    robot = load_robot(BEAM / "robot_gravity")
    robot = replace(robot, body=robot.body.with_stiffness_scale(MODULUS))
    recording = load_recording(BEAM / "recordings" / name)
    none = np.zeros((0, 3))
    untold = replace(recording, load_frame=np.zeros(0, dtype=np.int64), load_points=none, load_forces=none)
    run = estimate(robot, select_frames(untold, [0]), calibrate(robot, untold), at=[[0.1, 0.0, 0.015]])
    (contact,) = run.contacts
    assert run.frames[0].status == "ok"
    assert abs(contact.force_n - weight) < 0.1 * weight
    assert abs(contact.force_n - weight) < 2.0 * contact.std_n
    assert abs(contact.force_n_xyz[0]) < 0.1
