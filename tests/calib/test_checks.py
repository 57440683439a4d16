"""Markers that cannot be the robot's as they are written: unit, mirror, labels, outliers."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm, by_two_cameras, record
from helpers import DATA, write_block_robot

from femsense.calib.calibrate import calibrate
from femsense.calib.checks import true_labels
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.core.pose import make_pose, transform_points
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.recording import Recording, make_recording, with_marker_table
from femsense.model.recording_parts import Drives, RestMarkers, Timeline
from femsense.model.robot import Robot

TRIALS = DATA / "trials"
FRAMES = 5


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    places = [[0.1, 0.0, 0.03], [0.08, 0.03, 0.01], [0.06, 0.0, 0.02], [0.05, 0.03, 0.03], [0.03, 0.01, 0.0], [0.1, 0.03, 0.0]]
    markers = [{"name": f"m{i}", "position_m": place} for i, place in enumerate(places)]
    folder = write_block_robot(tmp_path_factory.mktemp("robot"), markers=markers, gravity=None)
    return load_robot(folder)


def seen(robot: Robot, *, noise: float = 5e-5) -> FloatArray:
    """Return the markers at rest as a camera sees them [m], shape (F, m, 3)."""
    T = make_pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), [0.02, -0.03, 0.4])
    rng = np.random.default_rng(3)
    still = transform_points(T, robot.marker_points)
    return np.array([still + noise * rng.normal(size=still.shape) for _ in range(FRAMES)])


def recorded(robot: Robot, xyz: FloatArray) -> Recording:
    count = len(robot.marker_names)
    r = make_recording(
        Timeline(0.1 * np.arange(FRAMES)), drives=Drives(robot.body.cable_names, np.zeros((FRAMES, len(robot.body.cables))))
    )
    return with_marker_table(
        r, robot.marker_names, np.repeat(np.arange(FRAMES), count), np.tile(np.arange(count), FRAMES), xyz.reshape(-1, 3)
    )


def test_markers_that_fit_are_not_accused(robot: Robot, recwarn: pytest.WarningsRecorder) -> None:
    assert calibrate(robot, recorded(robot, seen(robot))).rms_m < 2e-4
    assert not [w for w in recwarn if "recording" in str(w.message)]


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(39.37, "inches"), (100.0, "centimetres"), (3.2808, "feet"), (1000.0, "millimetres")],
)
def test_another_unit_is_named(robot: Robot, factor: float, unit: str) -> None:
    with pytest.raises(DataError, match="do not fit the robot") as error:
        calibrate(robot, recorded(robot, factor * seen(robot)))
    assert "times too large" in str(error.value)
    assert unit in str(error.value)


def test_left_handed_axes_are_named(robot: Robot) -> None:
    for axis in np.eye(3):
        with pytest.raises(DataError, match="axes of the markers seem left-handed"):
            calibrate(robot, recorded(robot, seen(robot) * (1 - 2 * axis)))


def test_labels_swapped_in_all_frames_are_named(robot: Robot) -> None:
    with pytest.raises(DataError, match="labels seem swapped: m0 is m3, m3 is m0:"):
        calibrate(robot, recorded(robot, seen(robot)[:, [3, 1, 2, 0, 4, 5]]))
    with pytest.raises(DataError, match="labels seem swapped") as error:
        calibrate(robot, recorded(robot, seen(robot)[:, [3, 4, 2, 0, 1, 5]]))
    assert "m0 is m3, m1 is m4, m3 is m0, m4 is m1:" in str(error.value)


@pytest.mark.parametrize(("swapped", "rows"), [((1,), "camera right"), ((0, 1), "camera left and right")])
def test_the_cameras_are_named_in_whose_rows_labels_are_swapped(swapped: tuple[int, ...], rows: str) -> None:
    both = by_two_cameras(record(np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0)]), noise=2e-4)[0])
    other = np.arange(len(both.marker_names))
    other[[0, 11]] = other[[11, 0]]
    index = np.where(np.isin(both.marker_view, swapped), other[both.marker_index], both.marker_index)
    with pytest.raises(DataError, match=rf"Swap them in markers.csv, in the rows of {rows}\."):
        calibrate(arm(), replace(both, marker_index=freeze(index, np.int64)))


def test_labels_swapped_in_one_frame_are_put_right(robot: Robot) -> None:
    xyz = seen(robot)
    clean = calibrate(robot, recorded(robot, xyz))
    xyz[2] = xyz[2][[0, 4, 2, 3, 1, 5]]
    with pytest.warns(UserWarning, match=r"frame 2: m1, m4 \(labels were swapped, and are corrected\)"):
        found = calibrate(robot, recorded(robot, xyz))
    np.testing.assert_allclose(found.T_robot_camera, clean.T_robot_camera, atol=1e-9)


def test_an_outlier_is_named_and_left_out(robot: Robot) -> None:
    xyz = seen(robot)
    clean = calibrate(robot, recorded(robot, xyz))
    xyz[3, 2] += [0.02, -0.03, 0.01]
    with pytest.warns(UserWarning, match=r"frame 3: m2 \(outliers, left out\)"):
        found = calibrate(robot, recorded(robot, xyz))
    np.testing.assert_allclose(found.T_robot_camera, clean.T_robot_camera, atol=2e-4)
    assert found.rms_m < 2e-4


def test_a_coordinate_ten_times_too_large_is_an_outlier_and_no_unit(robot: Robot) -> None:
    xyz = seen(robot)
    clean = calibrate(robot, recorded(robot, xyz))
    xyz[3, 2, 2] *= 10.0
    with pytest.warns(UserWarning, match="from the others; outliers, left out: m2 in frame 3"):
        found = calibrate(robot, recorded(robot, xyz))
    np.testing.assert_allclose(found.T_robot_camera, clean.T_robot_camera, atol=2e-4)


def test_labels_swapped_in_most_frames_are_refused(robot: Robot) -> None:
    xyz = seen(robot)
    xyz[:3] = xyz[:3][:, [3, 1, 2, 0, 4, 5]]
    with pytest.raises(DataError, match=r"labels of m0 and m3 seem swapped in [23] of 5 frames|labels seem swapped: m0 is m3"):
        calibrate(robot, recorded(robot, xyz))


def test_names_that_change_from_frame_to_frame_are_refused_with_the_way_out(robot: Robot) -> None:
    rng = np.random.default_rng(2)
    xyz = np.array([frame[rng.permutation(len(frame))] for frame in seen(robot)])
    with pytest.raises(DataError, match="leave the column marker empty: the model names the markers"):
        calibrate(robot, recorded(robot, xyz))


def test_a_marker_that_sits_elsewhere_in_all_frames_is_no_stray(robot: Robot, recwarn: pytest.WarningsRecorder) -> None:
    xyz = seen(robot)
    xyz[:, 2] += [0.02, -0.03, 0.01]
    assert calibrate(robot, recorded(robot, xyz)).marker_rms_m["m2"] > 0.01
    assert not [w for w in recwarn if "left out" in str(w.message)]


def test_other_markers_than_the_robots(robot: Robot) -> None:
    rng = np.random.default_rng(5)
    with pytest.raises(DataError, match="do not fit the robot"):
        calibrate(robot, recorded(robot, np.tile(rng.normal(size=(6, 3)), (FRAMES, 1, 1))))


def test_swaps_need_a_reason() -> None:
    places = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.05, 0, 0]])
    as_named = np.arange(3)
    bent = places + np.array([[0.004, 0, 0], [0.004, 0, 0], [0.02, 0, 0]])
    np.testing.assert_array_equal(true_labels(places, bent, as_named, noise=1e-4), as_named)
    np.testing.assert_array_equal(true_labels(places, places[[1, 0, 2]], as_named, noise=1e-4), [1, 0, 2])
    np.testing.assert_array_equal(true_labels(places, places[[1, 0, 2]], as_named, noise=2e-3), as_named)


@pytest.mark.skipif(not TRIALS.is_dir(), reason="the trials are not here")
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("v_inch", "39.27 times too large: are they in inches"),
        ("v_swapall", "swapped: tip is mid, mid is tip:"),
        ("v_zeros_all", "left: these"),
    ],
)
def test_recordings_that_went_wrong(name: str, text: str) -> None:
    with pytest.raises(DataError) as error:
        calibrate(load_robot(TRIALS / "base"), load_recording(TRIALS / name))
    assert text in str(error.value)


@pytest.mark.skipif(not TRIALS.is_dir(), reason="the trials are not here")
@pytest.mark.parametrize(("name", "text"), [("v_zeros", "mid in frame 2, mid in frame 5"), ("v_swap2", "are corrected")])
def test_recordings_that_are_put_right(name: str, text: str) -> None:
    body = load_robot(TRIALS / "base")
    clean = calibrate(body, load_recording(TRIALS / "recm"))
    with pytest.warns(UserWarning, match=text):
        found = calibrate(body, load_recording(TRIALS / name))
    np.testing.assert_allclose(found.T_robot_camera[:3, 3], clean.T_robot_camera[:3, 3], atol=5e-4)


def test_a_lost_marker_written_as_zeros(tmp_path: Path) -> None:
    from helpers import write_small_recording

    rows = "frame,marker,x_m,y_m,z_m\n0,tip,0.1,0,0.5\n1,tip,0,0,0\n4,tip,0.1,0,0.5\n"
    with pytest.warns(UserWarning, match="left out: tip in frame 1"):
        r = load_recording(write_small_recording(tmp_path / "a", markers_csv=rows))
    assert r.marker_frame.tolist() == [0, 2]
    with pytest.warns(UserWarning, match="-1, -1, -1 is a lost marker"):
        load_recording(write_small_recording(tmp_path / "c", markers_csv=rows.replace("0,0,0", "-1,-1,-1")))
    with pytest.warns(UserWarning, match="9999, 9999, 9999 is a lost marker"):
        load_recording(write_small_recording(tmp_path / "d", markers_csv=rows.replace("0,0,0", "9999,9999,9999")))
    with pytest.raises(DataError, match="0, 0, 0 in every row of side"), contextlib.suppress(UserWarning):
        load_recording(write_small_recording(tmp_path / "b", markers_csv=rows + "0,side,0,0,0\n"))


@pytest.mark.parametrize("seed", range(3))
def test_left_handed_axes_of_a_symmetric_body_are_not_taken_for_swapped_labels(seed: int) -> None:
    inputs = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.4, 0], [0, 0, 0.6, 0]])
    recording, _ = record(inputs, noise=2e-4, seed=seed)
    xyz = recording.marker_xyz * np.where(np.arange(3) == seed, -1.0, 1.0)
    table = (recording.marker_names, recording.marker_frame, recording.marker_index, xyz)
    with pytest.raises(DataError, match="axes of the markers seem left-handed"):
        calibrate(arm(), with_marker_table(recording, *table))


def test_labels_swapped_in_all_frames_are_named_where_the_body_moves() -> None:
    inputs = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.4, 0], [0, 0, 0.6, 0], [0, 0.5, 0, 0], [0, 0, 0, 0.5]])
    recording, _ = record(inputs, noise=2e-4)
    index = recording.marker_index.copy()
    index[recording.marker_index == 9], index[recording.marker_index == 11] = 11, 9
    table = (recording.marker_names, recording.marker_frame, index, recording.marker_xyz)
    with pytest.raises(DataError, match=r"labels seem swapped: m9 is m11, m11 is m9:"):
        calibrate(arm(), with_marker_table(recording, *table))


def test_gravity_in_another_unit_is_mentioned(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="is it in g"):
        load_robot(write_block_robot(tmp_path, gravity={"vector_m_s2": [0.0, 0.0, -1.0]}))


def test_markers_at_rest_that_hold_the_pose_elsewhere_are_refused(robot: Robot) -> None:
    xyz = seen(robot)
    places, count = freeze(xyz[0] + np.array([1.0, 0.0, 0.0])), len(robot.marker_names)
    rest = RestMarkers(robot.marker_names, places, freeze(np.full(count, 1e-5)), freeze(np.zeros(count), np.int64))
    with pytest.warns(UserWarning, match="same camera frame"), pytest.raises(DataError, match="puts the robot elsewhere"):
        calibrate(robot, replace(recorded(robot, xyz), rest=rest))
