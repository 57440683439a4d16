"""An empirical correction travels with its robot; calibration, forces and inputs use it where they are asked to."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, record

import femsense as fs
from femsense.app import cli
from femsense.calib.files import read_calibration, write_calibration
from femsense.core.errors import InputError
from femsense.io.provenance import robot_input
from femsense.model.marker_correction import SEPARATE, Correction, corrected
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.sensing.options import SensingOptions

MARKERS = tuple(f"m{i}" for i in range(12))
TIP = MARKERS[8]
PLACE, FORCE = np.array([[0.095, 0.0, 0.01]]), np.array([[0.0, 0.05, -0.1]])


def learned(std: float = 1e-5) -> Correction:
    """Return a correction: markers are off the more "up" pulls, those at the tip by up to 4 mm."""
    states = np.zeros((3, 4))
    states[:, 0] = (0.3, 0.6, 1.0)
    weights = np.zeros((1, 12, 3))
    weights[0, 4:8], weights[0, 8:] = (0.5e-3, 0.0, 1e-3), (1e-3, 0.0, 4e-3)
    basis = np.linalg.pinv(_gram(states)) @ states[:, :1]
    return Correction(SEPARATE, 1.2, "tension", NAMES, np.full(4, 2.0), MARKERS, states, basis, weights, np.eye(1) * std**2, 1e-4)


def _gram(states: np.ndarray) -> np.ndarray:
    own = np.exp(-0.5 * (states[:, None] - states[None]) ** 2 / 1.2**2)
    rest = np.exp(-0.5 * states**2 / 1.2**2)
    return np.asarray((own - rest[:, None] * rest[None]).sum(axis=2))


def pulled(*, force: bool) -> Recording:
    """Return a recording of pulls of "up", off by what the correction says; with an undeclared force in its last frame."""
    rows = np.zeros((5, 4))
    rows[:, 0] = (0.0, 0.6, 1.2, 2.0, 2.0)
    pushed = {4: (PLACE, FORCE)} if force else None
    recording, _ = record(rows, truth=arm((5, 2, 2)), noise=2e-5, forces=pushed)
    shifts = learned().of_rows(recording)[0]
    off = replace(recording, marker_xyz=recording.marker_xyz + shifts @ T_ROBOT_CAMERA[:3, :3])
    return replace(off, free=np.array([True, True, True, True, not force]))


def test_it_is_written_with_its_robot_and_read_again(tmp_path: Path) -> None:
    robot = replace(arm((4, 1, 1)), correction=learned())
    again = fs.load_robot(fs.save_robot(robot, tmp_path / "a").parent)
    inputs = np.array([[1.5, 0.0, 0.3, 0.0]])
    for a, b in zip(learned().shifts(inputs), again.require_correction().shifts(inputs)):
        np.testing.assert_allclose(a, b)
    assert fs.load_robot(tmp_path / "a", effects=False).correction is None
    plain = fs.load_robot(fs.save_robot(replace(again, correction=None), tmp_path / "b").parent)
    assert plain.correction is None and robot_input(plain)["sha256"] != robot_input(again)["sha256"]
    file = tmp_path / "a" / "correction.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "ranges": [1.0]}))
    with pytest.raises(InputError, match=r"ranges.*\n?.*\(1,\)"):
        fs.load_robot(tmp_path / "a")


def test_calibration_and_forces_use_it() -> None:
    robot, recording = replace(arm((4, 1, 1)), correction=learned()), pulled(force=True)
    plain, better = fs.calibrate(robot, recording), fs.calibrate(robot, recording, correct=True)
    assert better.rms_m < 0.6 * plain.rms_m and better.is_corrected
    off = []
    for calibration, correct in ((plain, False), (better, True)):
        run = fs.estimate(robot, recording, calibration, at=PLACE, options=SensingOptions(correct=correct, friction=None))
        (last,) = [c for c in run.contacts if c.frame == 4]
        off.append(np.linalg.norm((last.force_n_xyz - FORCE[0])[1:]))  # markers hardly show what acts along the arm
    assert off[1] < 0.02 and off[1] < 0.5 * off[0]
    with pytest.warns(UserWarning, match="calibrated without the correction"):
        fs.estimate(robot, recording, plain, at=PLACE, options=SensingOptions(correct=True))


def test_its_uncertainty_counts() -> None:
    recording, stds = pulled(force=True), []
    for std in (1e-5, 1e-3):
        robot = replace(arm((4, 1, 1)), correction=learned(std))
        calibration = fs.calibrate(robot, recording, correct=True)
        run = fs.estimate(robot, recording, calibration, at=PLACE, options=SensingOptions(correct=True))
        stds.append(next(c.std_n for c in run.contacts if c.frame == 4))
    assert stds[1] > 1.3 * stds[0]


def test_inputs_are_found_for_where_markers_truly_go() -> None:
    robot = replace(arm((4, 1, 1)), correction=learned())
    model = robot.markers.positions(fs.solve_equilibrium(robot.body, tension={"up": 1.5}).positions)[8]
    wanted = model + learned().shifts(np.array([[1.5, 0.0, 0.0, 0.0]]))[0][0, 8]
    target = {TIP: [np.nan, np.nan, wanted[2]]}
    limits = {name: (0.0, 0.0) for name in NAMES[1:]}
    motion = fs.reach(robot, target, limits=limits, options=fs.ReachOptions(correct=True))
    assert motion.status == "reached" and motion.inputs["up"] == pytest.approx(1.5, abs=1e-3)
    assert motion.reached_m[TIP][2] == pytest.approx(wanted[2], abs=2e-6) and motion.correction_std_m is not None
    assert "standard deviation of the correction" in motion.text
    assert abs(fs.reach(robot, target, limits=limits).inputs["up"] - 1.5) > 0.02


def test_what_it_does_not_know_is_refused() -> None:
    robot, recording = replace(arm((4, 1, 1)), correction=learned()), pulled(force=False)
    with pytest.raises(InputError, match="has no correction"):
        fs.calibrate(arm((4, 1, 1)), recording, correct=True)
    with pytest.raises(InputError, match="other inputs"):
        corrected(replace(recording, actuation="displacement"), learned(), [T_ROBOT_CAMERA])
    with pytest.raises(InputError, match="does not include this marker"):
        fs.reach(robot, {(0.1, 0.0, 0.0): [0.1, 0.0, 0.0]}, options=fs.ReachOptions(correct=True))


def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot: Robot = replace(arm((4, 1, 1)), correction=learned())
    fs.save_robot(robot, tmp_path / "with")
    fs.save_robot(arm((4, 1, 1)), tmp_path / "without")
    z = robot.marker_points[8, 2]
    target = ["--target", f"{TIP}=*,*,{z + 0.002}", "--correct"]
    assert cli.run(["reach", str(tmp_path / "with"), *target, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["correction_std_m"] > 0.0
    assert cli.run(["reach", str(tmp_path / "without"), *target]) == 2
    assert "improve --correct" in capsys.readouterr().err
    calibration = fs.calibrate(robot, pulled(force=False), correct=True)
    assert read_calibration(write_calibration(calibration, tmp_path / "calibration.json")).is_corrected
