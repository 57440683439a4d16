"""Files that fit far better if read otherwise: inputs with another sign, order or delay, gravity another way."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record
from hollow_bar_cable import hollow

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, transform_points
from femsense.core.work import counting
from femsense.fem.mesh import embed_points
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.robot import Observation, Robot, plain_actuation

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0.4, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5), (0, 0, 0.3, 0)])


@cache
def recording(actuation: str = "tension") -> Recording:
    if actuation == "tension":
        return record(LEVELS, noise=2e-4)[0]
    pulls = 0.004 * LEVELS @ (np.eye(4) - np.eye(4)[[1, 0, 3, 2]])  # what one cable takes up, its opposite lets out
    return record(pulls, noise=2e-4, zero="unknown", initial=np.full(4, 0.004), actuation="displacement")[0]


def with_inputs(inputs: np.ndarray, plain: Recording | None = None) -> Recording:
    return replace(plain or recording(), inputs=freeze(inputs))


def delayed(frames: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda inputs: inputs[np.clip(np.arange(len(inputs)) - frames, 0, None)]


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda u: -u, "inputs of up, down, left, right seem to have the wrong sign"),
        (lambda u: u[:, [2, 1, 0, 3]], "exchanged: up moves the robot as left should, left moves the robot as up should"),
        (lambda u: np.roll(u, 1, axis=0), "1 frames early"),
        (lambda u: np.roll(u, -1, axis=0), "1 frames late"),
        (delayed(2), "2 frames early"),
    ],
)
def test_inputs_that_fit_if_read_otherwise_are_refused(spoil: Callable[[np.ndarray], np.ndarray], text: str) -> None:
    with pytest.raises(DataError, match=text):
        calibrate(arm(), with_inputs(spoil(recording().inputs)))


def test_a_delay_is_seen_with_three_free_frames_in_common() -> None:
    free = freeze(np.arange(len(LEVELS)) < 5, np.bool_)
    with pytest.raises(DataError, match=r"2 frames early"):
        calibrate(arm(), replace(with_inputs(delayed(2)(recording().inputs)), free=free))


def test_a_sign_shows_where_the_zero_is_unknown_too() -> None:
    plain = recording("displacement")
    assert calibrate(arm(), plain).rms_m < 6e-4
    turned = plain.inputs * np.array([1.0, 1.0, -1.0, 1.0])
    with pytest.raises(DataError, match=r"inputs of left seem to have the wrong sign"):
        calibrate(arm(), with_inputs(turned, plain))


def test_gravity_the_other_way_is_refused_and_another_modulus_is_no_gravity(recwarn: pytest.WarningsRecorder) -> None:
    with pytest.raises(DataError, match=r"gravity seems to point along -z of the robot.*the markers then fit to"):
        calibrate(arm(gravity=(0.0, 0.0, 9.81)), recording())
    calibrate(arm(modulus=450e3), recording())
    assert not [w for w in recwarn if "gravity" in str(w.message)]


def test_an_accelerometer_of_another_sign_is_named() -> None:
    measured = replace(recording(), gravity=freeze(np.tile([0.0, 0.0, 9.81], (len(LEVELS), 1))))
    with pytest.raises(DataError, match=r"gravity seems to have the wrong sign"):
        calibrate(arm(), measured)


def test_another_zero_is_mentioned_with_its_size() -> None:
    with pytest.warns(UserWarning, match=r"count from another zero \(.*up -(0\.[89]|1)\S* N"):
        calibrate(arm(), with_inputs(np.add(recording().inputs, [1.0, 0.0, 0.0, 0.0])))


def test_readings_that_fit_as_well_are_listed_in_the_same_line() -> None:
    """A weightless arm with a square section: what turns its cables by a quarter turns its markers, too."""
    weightless = {"gravity": (0.0, 0.0, 0.0)}
    seen = record(LEVELS, noise=2e-4, truth=arm((8, 3, 3), law="neo_hookean", **weightless))[0]
    turned = with_inputs(seen.inputs[:, [2, 3, 1, 0]], seen)
    with pytest.raises(
        DataError, match=r"the columns of inputs seem exchanged: .*then fit to 0\.3.* As good: the labels seem swapped: .* \(0\.3"
    ):
        calibrate(arm(**weightless), turned)


@pytest.mark.parametrize("modulus", [180e3, 500e3, 600e3])
def test_a_body_that_is_softer_or_stiffer_is_not_refused_for_gravity(modulus: float) -> None:
    recording = record(2.0 * (LEVELS[[0, 1, 3, 4, 5]] > 0), noise=2e-4, seed=3)[0]
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        calibrate(arm(modulus=modulus), recording)
    said = " ".join(str(item.message) for item in heard)
    assert "gravity" not in said and "times its declared modulus" in said


def test_a_modulus_between_those_tried_first_is_fitted() -> None:
    """A single state, so no motion indicates a modulus: that of a grid left gravity along the axis as the better reading."""
    sagging = record(np.zeros((3, 4)), noise=2e-4, truth=arm((8, 3, 3), law="neo_hookean", modulus=1.75 * 60e3))[0]
    with pytest.warns(UserWarning, match=r"about 1\.7 times its declared modulus: the markers then fit to 0\.3"):
        calibrate(arm(modulus=60e3), sagging)


# Chambers that other readings blow up

POINTS = np.array([[x, y, z] for x in (0.03, 0.06, 0.09) for y, z in ((0.0, 0.0), (0.0, 0.03), (0.03, 0.0), (0.03, 0.03))])
NAMES = tuple(f"m{i}" for i in range(len(POINTS)))


@cache
def bar(stiffness: float) -> Robot:
    body = hollow(gravity=(0.0, 0.0, 0.0)).with_stiffness_scale(stiffness)
    markers = embed_points(body.mesh, POINTS)
    return Robot("bar", body, NAMES, POINTS, markers, np.zeros(0, np.int64), None, plain_actuation(1), Observation())


def pressed(pressures: list[float], stiffness: float, *, late: int = 0) -> Recording:
    """A bar; what is logged comes so many frames late."""
    n, true, table = len(pressures), bar(stiffness), np.array(pressures)[:, None]
    time = Timeline(np.arange(float(n)), free=np.ones(n, dtype=bool))
    drives = Drives(("top",), np.zeros((n, 1)), chamber_names=("core",), pressures=table)
    driven = DrivenRobot(true, drive_of(true, make_recording(time, drives=drives)))
    places = np.vstack([true.markers.positions(solve_frame(driven, k).positions) for k in range(n)])
    seen = transform_points(invert_pose(T_ROBOT_CAMERA), places) + 2e-4 * np.random.default_rng(1).normal(size=places.shape)
    rows = MarkerRows(NAMES, np.repeat(np.arange(n), len(NAMES)), np.tile(np.arange(len(NAMES)), n), seen)
    return make_recording(time, drives=replace(drives, pressures=np.roll(table, late, axis=0)), markers=rows)


def test_a_reading_that_blows_a_chamber_up_is_left_after_few_steps() -> None:
    with counting() as work:
        assert calibrate(bar(0.15), pressed([0.0, 9e3, 18e3, 14e3, 16e3], 0.2)).rms_m > 5e-4
    assert work.equilibria < 50  # 82 with all the steps on the way to half the modulus, and to the other law


def test_no_chamber_is_pressed_harder_than_it_was() -> None:
    pressures = [0.0, 10e3, 22e3, 5e3, 22e3, 15e3, 20e3]  # at their mean and half their range more it blows up
    with pytest.raises(DataError, match=r"1 frames late"):
        calibrate(bar(0.15), pressed(pressures, 0.155, late=-1))
