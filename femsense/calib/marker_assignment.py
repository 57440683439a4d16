"""Assignment of unnamed markers to the model's: their order may differ between frames, some may be outliers, others missing.

`search_poses` finds candidate poses for the model's states without an initial guess. For each likely one, the joint fit (pose and unknown
inputs) and the assignment alternate until no name changes. If two poses fit equally well, the markers are refused as ambiguous.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.inputs import first_inputs
from femsense.calib.joint import fit_joint
from femsense.calib.marker_readings import LEFT_HANDED, MIRROR
from femsense.calib.pose_search import PosedNames, refine_names, search_poses, squared
from femsense.calib.readings import AS_GOOD, EXPLAINED, SUSPICIOUS
from femsense.calib.rigid import poses_apart
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.core.pose import transform_points
from femsense.model.camera_frame import undo_depth
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.marker_units import check_marker_sizes
from femsense.model.observation import make_scene
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import Recording, state_key, with_marker_table
from femsense.model.recording_checks import camera_text
from femsense.model.robot import Robot

ELSEWHERE = 0.1
"""Poses are different where they place the markers this share of their spread apart."""
ROUNDS = 4
"""Fits and assignments in turn, at most."""
SURE = 3.0
"""Readings whose log-likelihoods differ by less than this (odds of 20) cannot be distinguished."""


@dataclass(frozen=True, eq=False, slots=True)
class Nameless:
    """Unnamed markers of one camera in the frames that are used."""

    view: int
    frames: IntArray
    """Indices of the frames, ascending, shape (f,)."""
    rows: tuple[IntArray, ...]
    """Rows of the recording's unnamed markers in each frame, each (n,)."""
    points: tuple[FloatArray, ...]
    """Their places after the camera's depth law [m], camera frame, each (n, 3)."""
    allowed: tuple[BoolArray, ...]
    """Which marker each may be, each (n, m)."""
    repeats: float
    """Frames a state."""


@dataclass(frozen=True, eq=False, slots=True)
class Named:
    """An assignment of names to the unnamed markers, with the poses of the cameras."""

    marker: IntArray
    """Which marker each unnamed row of the recording is, shape (U,): −1 none of the robot's, or not distinguishable."""
    error_m: float
    """Error of the points after the fit, see `typical_error` [m]."""
    poses: tuple[FloatArray, ...]
    doubtful: tuple[tuple[int, int, int], ...] = ()
    """(frame, marker, marker) that cannot be distinguished there."""


def name_markers(
    robot: Robot,
    recording: Recording,
    frames: IntArray,
    *,
    allowed: BoolArray | None = None,
) -> Recording:
    """Return the recording with names for its unnamed markers in some frames; markers without an assignment are removed with a warning.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        frames: indices of the frames, shape (f,).
        allowed: which marker each unnamed row may be (by its colour), shape (U, markers); by default any.

    Raises:
        DataError: too few points, points in another unit, mirrored ones, or those that fit the robot under more than one pose.
    """
    frames = np.intersect1d(frames, recording.unnamed_frame)
    if not len(frames):
        return recording
    seen = [_nameless(robot, recording, frames, v, allowed) for v in range(len(recording.camera_names))]
    seen = [one for one in seen if len(one.frames)]
    known = recording.T_robot_camera
    model = _modelled(robot, recording, frames, first_inputs(robot, recording))
    readings = [_readings(robot, one, model, known[one.view]) for one in seen]
    best = _combined(recording, seen, [r[0] for r in readings])
    _check_units(seen, model, readings, _spread(robot))
    if all(T is not None for T in known):
        named = _settled(robot, recording, seen, best, model)
    else:
        named = _fitted(robot, recording, seen, best)
        _check_handed(robot, recording, seen, model, named)
        _require_one(robot, recording, seen, readings, named)
    _say(robot, recording, frames, named)
    return _with_names(robot, recording, frames, named.marker)


def _nameless(robot: Robot, recording: Recording, frames: IntArray, view: int, allowed: BoolArray | None) -> Nameless:
    mine = recording.unnamed_view == view
    used = frames[np.isin(frames, recording.unnamed_frame[mine])]
    rows = tuple(np.flatnonzero(mine & (recording.unnamed_frame == k)) for k in used)
    may = np.ones((len(recording.unnamed_frame), len(robot.marker_names)), dtype=bool) if allowed is None else allowed
    repeats = len(used) / max(len({state_key(recording, int(k)) for k in used}), 1)
    points = tuple(undo_depth(recording.unnamed_xyz[r], robot.observation) for r in rows)
    return Nameless(view, used, rows, points, tuple(may[r] for r in rows), repeats)


def _modelled(robot: Robot, recording: Recording, frames: IntArray, initial: FloatArray | None) -> dict[int, FloatArray]:
    """Return where the model has the markers in each frame [m], robot frame."""
    driven = DrivenRobot(robot, drive_of(robot, recording, initial=initial))
    return {k: places for k, _, places, _ in solve_path(driven, frames.tolist(), lambda r: r.markers)}


def _readings(robot: Robot, seen: Nameless, model: dict[int, FloatArray], known: FloatArray | None) -> list[PosedNames]:
    """Return readings of one camera's markers under different poses, best first."""
    places = [model[int(k)] for k in seen.frames]
    if known is not None:
        return [refine_names(places, seen.points, known, allowed=seen.allowed, fixed=True, repeats=seen.repeats)]
    return search_poses(places, seen.points, allowed=seen.allowed, repeats=seen.repeats, rng=np.random.default_rng(0))


def _combined(recording: Recording, seen: Sequence[Nameless], readings: Sequence[PosedNames]) -> Named:
    """Return the reading of all cameras together."""
    marker = np.full(len(recording.unnamed_frame), -1, dtype=np.int64)
    poses = [np.eye(4) if T is None else T for T in recording.T_robot_camera]
    for one, reading in zip(seen, readings):
        poses[one.view] = reading.T_robot_camera
        for rows, names in zip(one.rows, reading.marker):
            marker[rows] = names
    error = float(np.sqrt(np.mean([r.error_m**2 for r in readings])))
    return Named(marker, error, tuple(poses))


def _fitted(robot: Robot, recording: Recording, seen: Sequence[Nameless], named: Named) -> Named:
    """Return the reading at which fits of pose and inputs and assignments in turns come to a halt."""
    for _ in range(ROUNDS):
        frames = np.unique(np.concatenate([one.frames for one in seen]))
        scene = make_scene(robot, _with_names(robot, recording, frames, named.marker), frames)
        fit = fit_joint(robot, scene, list(named.poses), first_inputs(robot, recording), [])
        model = {k: robot.markers.positions(state.positions) for k, state in fit.jet.states.items()}
        nameless = np.setdiff1d(frames, list(model))  # frames in which no point got a name are not in the fit
        model |= _modelled(robot, recording, nameless, fit.initial)
        again = _settled(robot, recording, seen, replace(named, poses=fit.poses), model)
        named, before = again, named
        if np.array_equal(before.marker, named.marker):
            break
    return named


def _settled(robot: Robot, recording: Recording, seen: Sequence[Nameless], named: Named, model: dict[int, FloatArray]) -> Named:
    """Return the names under given poses and states, by assignment,
    without outliers and without pairs that cannot be distinguished."""
    marker = np.full(len(recording.unnamed_frame), -1, dtype=np.int64)
    left: list[FloatArray] = []
    errors: list[float] = []
    for one in seen:
        places = [model[int(k)] for k in one.frames]
        reading = refine_names(places, one.points, named.poses[one.view], allowed=one.allowed, fixed=True, repeats=one.repeats)
        errors.append(reading.error_m)
        for rows, names, points, p in zip(one.rows, reading.marker, one.points, places):
            own = np.flatnonzero(names >= 0)
            marker[rows[own]] = names[own]
            left.append(transform_points(named.poses[one.view], points[own]) - p[names[own]])
    residual = np.vstack(left)
    scale = float(np.median(np.linalg.norm(residual, axis=1))) / 1.538  # median of a chi distribution with 3 degrees
    named = replace(named, marker=marker, error_m=float(np.sqrt(np.mean(np.square(errors)))))
    return _without_doubt(robot, seen, named, model, max(scale, 1e-6))


def _without_doubt(robot: Robot, seen: Sequence[Nameless], named: Named, model: dict[int, FloatArray], noise: float) -> Named:
    """Return the assignment without ambiguous names: those that could be exchanged, or belong to a nearby point without a name."""
    marker, doubtful = named.marker.copy(), []
    for one in seen:
        for k, rows, points, may in zip(one.frames.tolist(), one.rows, one.points, one.allowed):
            names = named.marker[rows]
            squares = np.where(may, squared(transform_points(named.poses[one.view], points), model[k]), np.inf)
            for i, j in _alike(names, squares, 2.0 * SURE * noise**2):
                marker[rows[[i, j]]] = -1
                doubtful.append((k, int(names[i]), int(names[j] if names[j] >= 0 else names[i])))
    return replace(named, marker=marker, doubtful=tuple(doubtful))


def _alike(names: IntArray, squares: FloatArray, least: float) -> list[tuple[int, int]]:
    """Return pairs of points of one frame whose swap costs less than `least` [m²]; the first of a pair has a name."""
    pairs = []
    for i in np.flatnonzero(names >= 0):
        for j in range(len(names)):
            both = names[j] >= 0
            if j == i or (both and j < i):
                continue
            now = squares[i, names[i]] + (squares[j, names[j]] if both else 0.0)
            then = squares[j, names[i]] + (squares[i, names[j]] if both else 0.0)
            if then - now < least:
                pairs.append((int(i), int(j)))
    return pairs


def _spread(robot: Robot) -> float:
    """Return the root mean square distance of the markers at rest from their middle [m]."""
    return float(np.sqrt(((robot.marker_points - robot.marker_points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _check_units(
    seen: Sequence[Nameless], model: dict[int, FloatArray], readings: Sequence[Sequence[PosedNames]], spread: float
) -> None:
    """Refuse points that fit nowhere and are far from as large as the model's markers (DataError, with the unit that this hints at)."""
    for one, reading in zip(seen, readings):
        if reading[0].error_m > SUSPICIOUS * spread:
            check_marker_sizes(one.points, [model[int(k)] for k in one.frames])


def _check_handed(
    robot: Robot, recording: Recording, seen: Sequence[Nameless], model: dict[int, FloatArray], named: Named
) -> None:
    """Refuse points that fit the robot once they are mirrored, and far worse as they are (DataError)."""
    spread = _spread(robot)
    if named.error_m < SUSPICIOUS * spread or any(T is not None for T in recording.T_robot_camera):
        return
    turned = replace(recording, unnamed_xyz=freeze(recording.unnamed_xyz * MIRROR))
    others = [replace(one, points=tuple(points * MIRROR for points in one.points)) for one in seen]
    first = _combined(turned, others, [_readings(robot, one, model, None)[0] for one in others])
    left = _fitted(robot, turned, others, first).error_m
    if left * EXPLAINED < named.error_m:
        raise DataError(
            f"the markers without names do not fit the robot: the residual is {1e3 * named.error_m:.3g} mm for a spread of "
            f"{1e3 * spread:.3g} mm, mirrored {1e3 * left:.3g} mm. Are the axes left-handed? {LEFT_HANDED}"
        )


def _require_one(
    robot: Robot, recording: Recording, seen: Sequence[Nameless], readings: Sequence[Sequence[PosedNames]], best: Named
) -> None:
    """Refuse markers of a camera that fit about equally well under another pose.

    Raises:
        DataError: states the difference of the two poses and the residual of each.
    """
    spread = _spread(robot)
    for i, one in enumerate(seen):
        chosen = best.poses[one.view]
        likely = [r for r in readings[i][1:] if r.error_m < EXPLAINED * max(readings[i][0].error_m, 1e-6)]
        others = [r for r in likely if poses_apart(r.T_robot_camera, chosen, robot.marker_points) > ELSEWHERE * spread]
        for other in others[:3]:
            first = [other if j == i else r[0] for j, r in enumerate(readings)]
            other_fit = _fitted(robot, recording, seen, _combined(recording, seen, first))
            away = poses_apart(other_fit.poses[one.view], chosen, robot.marker_points)
            both = (other_fit.marker >= 0) & (best.marker >= 0)
            if (
                (other_fit.marker != best.marker)[both].any()
                and away > ELSEWHERE * spread
                and other_fit.error_m < _margin(one) * best.error_m
            ):
                raise DataError(
                    f"the markers of {camera_text(recording.camera_names[one.view])} have no names, and two poses fit them equally well: the residuals are "
                    f"{1e3 * best.error_m:.3g} and {1e3 * other_fit.error_m:.3g} mm, and they place the markers "
                    f"{1e3 * away:.3g} mm apart. Name the markers, place one more where it breaks the symmetry, "
                    f"pull cables in free frames, or declare T_robot_camera"
                )


def _margin(seen: Nameless) -> float:
    """Return the least ratio of the errors of a wrong pose and the best one [1]; it is larger for few points, which fit by chance."""
    freedom = 3.0 * sum(len(points) for points in seen.points) / seen.repeats - 6.0
    return max(AS_GOOD, float(np.exp(SURE / max(freedom, 1.0))))


def _with_names(robot: Robot, recording: Recording, frames: IntArray, marker: IntArray) -> Recording:
    """Return the recording with the unnamed rows of some frames turned into rows with names; the others stay."""
    number = {name: i for i, name in enumerate(robot.marker_names)}
    names = [*robot.marker_names, *(name for name in recording.marker_names if name not in number)]
    place = {name: i for i, name in enumerate(names)}
    index = np.array([place[recording.marker_names[i]] for i in recording.marker_index], dtype=np.int64)
    here = np.isin(recording.unnamed_frame, frames)
    kept = here & (marker >= 0)
    table = with_marker_table(
        recording,
        names,
        np.concatenate([recording.marker_frame, recording.unnamed_frame[kept]]),
        np.concatenate([index, marker[kept]]),
        np.vstack([recording.marker_xyz, recording.unnamed_xyz[kept]]),
        view=np.concatenate([recording.marker_view, recording.unnamed_view[kept]]),
    )
    return replace(
        table,
        unnamed_frame=recording.unnamed_frame[~here],
        unnamed_view=recording.unnamed_view[~here],
        unnamed_xyz=recording.unnamed_xyz[~here],
    )


def _say(robot: Robot, recording: Recording, frames: IntArray, named: Named) -> None:
    """Warn of points that got no name, frame by frame."""
    texts = []
    for k in frames.tolist():
        pairs = [(robot.marker_names[a], robot.marker_names[b]) for f, a, b in named.doubtful if f == k]
        alike = sorted({f"{a} and {b}" if a != b else a for a, b in pairs})
        none = int(((recording.unnamed_frame == k) & (named.marker < 0)).sum())
        what = f"{none} point{'s' if none > 1 else ''} without a marker"
        texts += (
            [f"frame {int(recording.frame_numbers[k])}: {what}" + (f" ({', '.join(alike)} not distinguishable)" if alike else "")]
            if none
            else []
        )
    if texts:
        text = "; ".join(texts[:6]) + (f"; and {len(texts) - 6} frames more" if len(texts) > 6 else "")
        warnings.warn(f"{recording.folder or 'the recording'}: markers named by the model; left out: {text}", stacklevel=4)
