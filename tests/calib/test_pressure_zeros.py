"""Pressures that count from an unknown zero, beside cables that do: a hollow bar, recorded from a finer mesh with another law."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA
from hollow_bar_cable import hollow

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration, write_calibration
from femsense.calib.pressure_zeros import with_initial_pressures
from femsense.control.reach import reach
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, transform_points
from femsense.fem.mesh import embed_points
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import apply_effects
from femsense.model.frame_state import solve_frame
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.model.robot import Observation, Robot, plain_actuation
from femsense.sensing.prepare import make_sensor

POINTS = np.array([[x, y, z] for x in (0.03, 0.06, 0.09) for y, z in ((0.0, 0.0), (0.0, 0.03), (0.03, 0.0), (0.03, 0.03))])
NAMES = tuple(f"m{i}" for i in range(len(POINTS)))
ZERO, START = 800.0, 0.03
"""True initial pressure [Pa] and tension [N]."""


@cache
def bar() -> Robot:
    body = hollow(quadratic=True, gravity=(0.0, 0.0, 0.0))
    ties = embed_points(body.mesh, POINTS)
    stiff = Robot("bar", body, NAMES, POINTS, ties, np.zeros(0, np.int64), None, plain_actuation(1), Observation())
    return apply_effects(stiff, [{"name": "stiffness", "scale": 0.15}])


@cache
def recording() -> Recording:
    pressures, tensions = np.array([0.0, 2e3, 0.0, 1e3]), np.array([0.0, 0.0, 0.05, 0.05])
    true = robot_on_mesh(bar(), finer_mesh(bar().body.mesh, "tet10", 1))
    true = with_initial_pressures(apply_effects(true, [{"name": "hyperelastic", "law": "neo_hookean"}]), {"core": ZERO})
    drives = Drives(
        ("top",),
        tensions[:, None],
        chamber_names=("core",),
        pressures=pressures[:, None],
        actuation="tension",
        actuation_zero="unknown",
    )
    time = Timeline(np.arange(4.0), free=np.ones(4, dtype=bool))
    driven = DrivenRobot(true, drive_of(true, make_recording(time, drives=drives), initial=np.array([START])))
    places = np.vstack([true.markers.positions(solve_frame(driven, k).positions) for k in range(4)])
    seen = transform_points(invert_pose(T_ROBOT_CAMERA), places) + 3e-5 * np.random.default_rng(3).normal(size=places.shape)
    rows = MarkerRows(NAMES, np.repeat(np.arange(4), len(NAMES)), np.tile(np.arange(len(NAMES)), 4), seen)
    return make_recording(time, drives=drives, markers=rows)


@cache
def calibration() -> Calibration:
    return calibrate(bar(), recording())


def test_zeros_of_a_pressure_and_of_a_tension_are_found_together(tmp_path: Path) -> None:
    found = calibration()
    std = found.pressure_std_pa["core"]
    assert std is not None and 5.0 < std < 200.0
    assert found.chamber_pressure_pa["core"] == pytest.approx(ZERO, abs=400.0)  # the truth's mesh and law are 150 Pa off each
    assert found.cable_tension_n["top"] == pytest.approx(START, abs=0.005)
    assert found.rms_m < 1e-4
    again = read_calibration(write_calibration(found, tmp_path / "calibration.json"))
    assert again.chamber_pressure_pa == found.chamber_pressure_pa and again.pressure_std_pa == found.pressure_std_pa


def test_estimates_and_commands_count_from_the_zero() -> None:
    found = calibration()
    zero = found.chamber_pressure_pa["core"]
    sensor = make_sensor(bar(), recording(), found, at=[[0.1, 0.015, 0.03]])
    np.testing.assert_allclose(sensor.driven.drive.pressures, recording().pressures + zero)
    wanted = {"m9": POINTS[9] + [0.001, np.nan, np.nan]}
    plain, counted = reach(bar(), wanted), reach(bar(), wanted, calibration=found)
    assert counted.inputs["core"] == pytest.approx(plain.inputs["core"] - zero)


def test_known_zeros_are_left_alone_and_unknown_ones_need_markers() -> None:
    known = replace(recording(), actuation_zero="absolute", pressures=freeze(recording().pressures + ZERO))
    assert calibrate(bar(), replace(known, inputs=freeze(known.inputs + START))).chamber_pressure_pa == {}
    r = recording()
    none = np.zeros(0, np.int64)
    blind = replace(r, marker_frame=none, marker_index=none, marker_view=none, marker_xyz=freeze(np.zeros((0, 3))))
    with pytest.raises(DataError, match="zeros of pressures need markers"):
        calibrate(bar(), replace(blind, T_robot_camera=(T_ROBOT_CAMERA,)))
