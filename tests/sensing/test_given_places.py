"""Forces at given places from markers alone, on real data: a marker beside the force feels no dent that is not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import DATA

from femsense.calib.calibrate import calibrate
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.recording import select_frames
from femsense.sensing.pipeline import estimate

BEAM = DATA / "beam"
MODULUS = 1.857
"""What `improve` finds from gravity_a alone."""


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
    assert abs(contact.force_n - weight) < 0.2 * weight  # 24 % before, and beyond what the law holds at 1 N
    assert abs(contact.force_n - weight) < 2.0 * contact.std_n
    assert abs(contact.force_n_xyz[2] + weight) < 0.1 * weight
