"""Markers without names get them from the model, from nowhere; what cannot be told is said."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record

from femsense.calib.calibrate import calibrate
from femsense.calib.marker_assignment import name_markers
from femsense.calib.pose_search import search_poses, typical_error
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.model.recording import Recording, with_marker_table
from femsense.model.robot import Robot

INPUTS = np.array([[0.0, 0, 0, 0], [1.0, 0, 0, 0], [1.0, 0, 0.7, 0], [0, 0, 1.5, 0]])
KEPT = np.array([0, 2, 4, 5, 7, 8, 10, 11])
"""Markers of the arm that break its symmetry."""


def lopsided(robot: Robot) -> Robot:
    names = tuple(robot.marker_names[i] for i in KEPT)
    return replace(robot, marker_names=names).with_marker_points(robot.marker_points[KEPT])


def nameless(
    recording: Recording, kept: IntArray, *, seed: int = 0, outliers: int = 0, missing: int = 0, T: FloatArray | None = None
) -> tuple[Recording, IntArray]:
    """Return the recording without names, rows shuffled in each frame, and which marker (−1: outlier) each row is."""
    rng = np.random.default_rng(seed)
    frame, xyz, truth = [], [], []
    for k in range(recording.frame_count):
        of = np.flatnonzero((recording.marker_frame == k) & np.isin(recording.marker_index, kept))
        of = rng.permutation(of)[: len(of) - missing]
        points = recording.marker_xyz[of]
        wild = points.mean(axis=0) + rng.uniform(-0.08, 0.08, size=(outliers, 3))
        order = rng.permutation(len(of) + outliers)
        xyz.append(np.vstack([points, wild])[order])
        truth.append(np.concatenate([np.searchsorted(kept, recording.marker_index[of]), np.full(outliers, -1)])[order])
        frame.append(np.full(len(order), k))
    none = np.zeros(0, dtype=np.int64)
    points = np.vstack(xyz) if T is None else transform_points(T, np.vstack(xyz))
    bare = replace(recording, marker_frame=none, marker_index=none, marker_view=none, marker_xyz=np.zeros((0, 3)))
    count = len(points)
    return (
        replace(bare, unnamed_frame=np.concatenate(frame), unnamed_view=np.zeros(count, np.int64), unnamed_xyz=points),
        np.concatenate(truth),
    )


def names_given(robot: Robot, bare: Recording, named: Recording) -> IntArray:
    """Return which marker each unnamed row became, −1 where none."""
    at = {
        tuple(x): robot.marker_names.index(named.marker_names[i]) for x, i in zip(named.marker_xyz.tolist(), named.marker_index)
    }
    return np.array([at.get(tuple(x), -1) for x in bare.unnamed_xyz.tolist()])


def off(T: FloatArray, true: FloatArray = T_ROBOT_CAMERA) -> float:
    middle = np.array([[0.05, 0.0, 0.0], [0.1, 0.0, 0.0]])
    return float(np.linalg.norm(transform_points(T @ invert_pose(true), middle) - middle, axis=1).max())


@pytest.mark.parametrize("seed", range(3))
def test_names_and_pose_from_nowhere_in_spite_of_outliers_and_gaps(seed: int) -> None:
    robot, (recording, _) = lopsided(arm()), record(INPUTS, noise=2e-4, seed=seed)
    turn = make_pose(rotation_from_vector(np.random.default_rng(seed).normal(size=3)), [0.3, -0.2, 1.0])
    bare, truth = nameless(recording, KEPT, seed=seed, outliers=2, missing=2, T=turn)
    with pytest.warns(UserWarning, match="markers named by the model"):
        named = name_markers(robot, bare, np.arange(4))
    given = names_given(robot, bare, named)
    assert not ((given != truth) & (given >= 0)).any()
    assert (given == truth).mean() > 0.9
    assert not len(named.unnamed_frame)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        calibration = calibrate(robot, bare)
    assert off(calibration.poses[0] @ turn) < 4e-4


def test_unknown_initial_inputs_are_found_with_the_names() -> None:
    initial = np.array([0.6, 0.0, 0.0, 0.4])
    recording, _ = record(INPUTS, noise=1e-4, zero="unknown", initial=initial)
    bare, _ = nameless(recording, KEPT)
    kept = np.isin(recording.marker_index, KEPT)
    table = with_marker_table(
        recording, recording.marker_names, recording.marker_frame[kept], recording.marker_index[kept], recording.marker_xyz[kept]
    )
    found, named = calibrate(lopsided(arm()), bare), calibrate(lopsided(arm()), table)
    for name, tension in zip(recording.cable_names, initial):
        assert found.cable_tension_n[name] == pytest.approx(tension, abs=0.15)
        assert found.cable_tension_n[name] == pytest.approx(named.cable_tension_n[name], abs=1e-4)
    np.testing.assert_allclose(found.poses[0], named.poses[0], atol=1e-6)


def test_a_layout_with_a_symmetry_is_refused() -> None:
    recording, _ = record(np.zeros((2, 4)), noise=2e-4)
    bare, _ = nameless(recording, np.arange(12))
    weightless = arm(gravity=(0.0, 0.0, 0.0))
    with pytest.raises(DataError, match=r"two poses fit them equally well: .* Name the markers"):
        calibrate(weightless, bare)


def test_cables_that_pull_break_a_symmetry() -> None:
    recording, _ = record(2.0 * INPUTS, noise=1e-4)
    bare, truth = nameless(recording, np.arange(12))
    robot = arm()
    given = names_given(robot, bare, name_markers(robot, bare, np.arange(4)))
    np.testing.assert_array_equal(given, truth)


def test_colours_leave_fewer_names() -> None:
    recording, _ = record(np.zeros((2, 4)), noise=2e-4)
    bare, truth = nameless(recording, np.arange(12))
    allowed = np.ones((len(truth), 12), dtype=bool)
    red = np.isin(np.arange(12), [1, 6])
    allowed[:, red] = False
    allowed[np.isin(truth, [1, 6])] = red
    robot = arm(gravity=(0.0, 0.0, 0.0))
    named = name_markers(robot, bare, np.arange(2), allowed=allowed)
    np.testing.assert_array_equal(names_given(robot, bare, named), truth)


def test_neighbours_that_noise_confuses_get_no_name() -> None:
    robot = lopsided(arm())
    close = robot.marker_points.copy()
    close[4] = close[3] + [0.0004, 0.0, 0.0]
    robot = robot.with_marker_points(close)
    recording, _ = record(INPUTS, noise=4e-4, placements=shifts(robot))
    bare, truth = nameless(recording, KEPT)
    with pytest.warns(UserWarning, match="m5 and m7 not distinguishable"):
        named = name_markers(robot, bare, np.arange(4))
    given = names_given(robot, bare, named)
    assert not ((given != truth) & (given >= 0)).any()


def shifts(robot: Robot) -> FloatArray:
    """Return by how much the markers of the whole arm sit elsewhere so that they are a robot's."""
    result = np.zeros((12, 3))
    result[KEPT] = robot.marker_points - arm().marker_points[KEPT]
    return result


def test_too_few_points() -> None:
    recording, _ = record(INPUTS[:1])
    bare, _ = nameless(recording, KEPT, missing=6)
    with pytest.raises(DataError, match="three markers; the most in one frame is 2"):
        calibrate(lopsided(arm()), bare)


def test_two_cameras_and_one_that_is_declared() -> None:
    recording, _ = record(INPUTS, noise=2e-4)
    robot, other = lopsided(arm()), make_pose(rotation_from_vector([0.3, -1.0, 0.4]), [0.1, 0.2, -0.6])
    first, _ = nameless(recording, KEPT, outliers=1)
    second, _ = nameless(recording, KEPT, seed=1, T=other)
    n = len(first.unnamed_frame), len(second.unnamed_frame)
    both = replace(
        first,
        camera_names=("a", "b"),
        cameras=(None, None),
        T_robot_camera=(None, None),
        cloud_files=((None, None),) * 4,
        color_files=((None, None),) * 4,
        unnamed_frame=np.concatenate([first.unnamed_frame, second.unnamed_frame]),
        unnamed_view=np.repeat([0, 1], n),
        unnamed_xyz=np.vstack([first.unnamed_xyz, second.unnamed_xyz]),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        free = calibrate(robot, both)
        declared = calibrate(robot, replace(both, T_robot_camera=(T_ROBOT_CAMERA, None)))
    for calibration in (free, declared):
        assert off(calibration.poses[0]) < 4e-4
        assert off(calibration.poses[1] @ other) < 4e-4


def test_the_search_needs_no_start_and_no_order() -> None:
    rng = np.random.default_rng(4)
    model = rng.normal(size=(9, 3))
    for _ in range(5):
        T = make_pose(rotation_from_vector(3.0 * rng.normal(size=3)), rng.normal(size=3))
        order = rng.permutation(9)[:7]
        seen = np.vstack([transform_points(invert_pose(T), model[order]), 2.0 * rng.normal(size=(2, 3))])
        best = search_poses([model], [seen], rng=rng)[0]
        np.testing.assert_allclose(best.T_robot_camera, T, atol=1e-6)
        np.testing.assert_array_equal(best.marker[0][:7], order)


def test_an_error_is_that_of_the_model_s_points_and_outliers_cost() -> None:
    rng = np.random.default_rng(6)
    squares = (1e-3 * rng.normal(size=(400, 3)) ** 2 * 1e-3).sum(axis=1)
    clean = float(typical_error(squares, 0.1))
    assert clean == pytest.approx(1e-3, rel=0.1)
    squares[:40] = 0.05**2
    assert clean < float(typical_error(squares, 0.1)) < 3.0 * clean


def test_a_frame_of_strays_alone_costs_only_itself() -> None:
    robot = lopsided(arm())
    bare, truth = nameless(record(INPUTS, noise=2e-4)[0], KEPT)
    strays = bare.unnamed_frame == 2
    xyz = bare.unnamed_xyz + strays[:, None] * np.array([0.3, -0.2, 0.1])
    bare = replace(bare, unnamed_xyz=xyz[~strays | (np.cumsum(strays) <= 2)])
    kept = ~strays | (np.cumsum(strays) <= 2)
    bare = replace(bare, unnamed_frame=bare.unnamed_frame[kept], unnamed_view=bare.unnamed_view[kept])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        named = name_markers(robot, bare, np.arange(bare.frame_count))
    given = names_given(robot, bare, named)
    assert (given[bare.unnamed_frame == 2] == -1).all()
    assert (given == np.where(bare.unnamed_frame == 2, -1, truth[kept])).all()


@pytest.mark.parametrize(("factor", "unit"), [(100.0, "centimetres"), (39.37, "inches"), (1000.0, "millimetres")])
def test_another_unit_is_named(factor: float, unit: str) -> None:
    recording, _ = record(INPUTS, noise=2e-4, seed=1)
    bare, _ = nameless(recording, KEPT, seed=1)
    with pytest.raises(DataError, match=rf"times too large: are they in {unit}\?"):
        calibrate(lopsided(arm()), replace(bare, unnamed_xyz=factor * bare.unnamed_xyz))


@pytest.mark.parametrize("zero", ["absolute", "unknown"])
def test_left_handed_axes_are_named(zero: str) -> None:
    recording, _ = record(INPUTS, noise=2e-4, seed=1, zero=zero, initial=None if zero == "absolute" else np.full(4, 0.3))
    bare, _ = nameless(recording, KEPT, seed=1)
    with pytest.raises(DataError, match="Are the axes left-handed"):
        calibrate(lopsided(arm()), replace(bare, unnamed_xyz=bare.unnamed_xyz * [1.0, -1.0, 1.0]))
