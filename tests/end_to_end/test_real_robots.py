"""Robots that others built, as robots and recordings:
what the files say comes out in the right places (skipped where the data are absent)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import DATA, ROOT
from scipy.spatial.transform import Rotation

from femsense.core.pose import transform_points
from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.tie_spacing import tie_spacing

sys.path.append(str(ROOT / "benchmarks"))
from real import arm, tentacle, trunk


@pytest.fixture
def tentacle_data() -> Path:
    if not (DATA / "tentacle").is_dir():
        pytest.skip("data/tentacle is not here")
    return DATA / "tentacle"


def test_the_tentacle_hangs_and_bends_as_it_was_measured(tentacle_data: Path, tmp_path: Path) -> None:
    folder, (a, b), (both,) = tentacle.make(tmp_path, tentacle_data, tentacle.WAYS[3])
    robot = load_robot(folder)
    recordings = [load_recording(path) for path in (a, b, both)]
    assert [len(r.time_s) for r in recordings] == [8, 6, 4]
    assert [r.session for r in recordings] == ["A", "B", "B"]
    spacing = tie_spacing(robot.body, robot.body.cables[0])
    assert spacing is not None and spacing.holds
    softer = robot.body.with_stiffness_scale(0.79)  # the modulus that a fit by hand gives
    first = recordings[2]
    pose = first.T_robot_camera[0]
    assert pose is not None
    measured = transform_points(pose, first.marker_xyz[first.marker_frame == 0])
    state = solve_equilibrium(softer, tension=dict(zip(first.cable_names, first.inputs[0])))
    off = np.linalg.norm(robot.markers.positions(state.positions)[1:] - measured[1:], axis=1)
    assert first.inputs[0].tolist() == pytest.approx([0.1 / 0.0325] * 2)
    assert off.mean() < 0.012  # at 3 N in both tendons, where the tip moves by 140 mm


def test_the_trunk_has_the_same_frames_with_and_without_its_weight(tmp_path: Path) -> None:
    if not (DATA / "trunk").is_dir():
        pytest.skip("data/trunk is not here")
    runs = [trunk.read_run(DATA / "trunk", loaded=loaded) for loaded in (False, True)]
    frames = trunk.still_frames(runs, 12)
    shift = (runs[1].discs[frames, 2] - runs[0].discs[frames, 2]) @ trunk.R_ROBOT_MOCAP.T
    assert shift.mean(axis=0)[2] < -0.002  # it pulls down
    recording = load_recording(trunk.write_recording(tmp_path / "r", runs[0], frames))
    assert len(recording.time_s) == 12 and len(recording.cable_names) == 12
    pairs = recording.inputs.reshape(12, 6, 2)
    np.testing.assert_allclose(pairs[..., 0], -pairs[..., 1])  # what one tendon is drawn, the other is paid out


def test_a_rigid_body_of_the_arm_that_is_turned_by_half_a_turn_is_where_it_was() -> None:
    rows = np.zeros((2, 38))
    rows[:, 20:24] = rows[:, 27:31] = 0.0, 0.0, 0.0, 1.0
    bent = Rotation.from_euler("y", 66.0, degrees=True)
    rows[:, 34:38] = [(bent * Rotation.from_euler("z", turn, degrees=True)).as_quat() for turn in (0.0, 180.0)]
    once, turned = arm.along_x(rows, arm.BODIES["tip"])
    np.testing.assert_allclose(once, turned, atol=1e-12)
    np.testing.assert_allclose(once, 1e-3 * arm.ARM_MM * bent.as_matrix()[:, 0], atol=1e-12)


def test_states_of_the_arm_that_are_held_repeat() -> None:
    if not (DATA / "arm").is_dir():
        pytest.skip("data/arm is not here")
    states = arm.read_states(DATA / "arm", "apr_4_1")
    held = np.array([s.markers for s in states[:4]])  # two holds at the same pressures
    assert np.linalg.norm(held - held.mean(axis=0), axis=2).max() < 1e-3
