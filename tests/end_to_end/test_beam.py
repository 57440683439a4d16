"""Real data: motion capture of a silicone beam whose weight was not declared."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import DATA, block_mesh

from femsense.fem.mesh import to_quadratic
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.loop.improve import improve
from femsense.model.remeshing import robot_on_mesh

BEAM = DATA / "beam"


@pytest.mark.skipif(not BEAM.is_dir(), reason="data/beam is not beside the project")
def test_the_weight_of_a_beam_is_found_in_motion_capture() -> None:
    mesh = to_quadratic(block_mesh((5, 2, 2), start=(0.0, -0.015, -0.015)))
    robot = robot_on_mesh(load_robot(BEAM / "robot"), mesh)
    free, light, heavy = (load_recording(BEAM / "recordings" / name) for name in ("gravity_a", "load52_a", "load101_a"))
    loop = improve(robot, [free, light], validation=[heavy])
    found = {effect.name: effect.parameters for effect in loop.effects}
    assert {"stiffness", "gravity"} <= set(found) and "payload" not in found
    assert 1.4 < found["stiffness"]["scale"].value < 2.0  # of 150 kPa; another solver got 266–278 kPa
    gravity = np.array(found["gravity"]["vector_m_s2"].value)
    assert gravity[2] < -8.0 and abs(gravity[1]) < 1.0
    assert loop.after.validation_rms_m < 0.45 * loop.before.validation_rms_m
