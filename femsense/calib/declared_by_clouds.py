"""Check of the declared pose of a camera without markers, by a pose fitted to the clouds of contact-free frames."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from femsense.calib.calibration import Calibration
from femsense.calib.cloud_pose_search import LEAST, search_cloud_poses, settle_cloud_pose
from femsense.calib.clouds_alone import free_states, seen_by, started_at
from femsense.calib.declared_poses import DECLARED_STD, REMEDY, pose_error
from femsense.calib.from_clouds import fit_clouds, free_clouds, measured_noises, pose_pivot
from femsense.calib.inputs import calibrated_inputs
from femsense.calib.readings import EXPLAINED, SUSPICIOUS
from femsense.calib.scan import REACH, ray_rows, read_scan
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.pose import invert_pose, transform_points
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface

KNOWN = 4.48
"""A declared pose is wrong if its Mahalanobis distance from the fitted one exceeds this: the 99.7 % quantile of χ with six degrees of
freedom."""
ALLOWED = 2.0
"""It is reported if rotation or translation also exceed this multiple of `DECLARED_STD`; `estimate` corrects smaller errors with
contact-free frames."""
CELL = 0.1
"""Size of the cells of the body at rest, relative to its diagonal."""
FRAMES = 4
"""Number of contact-free frames used."""
MODULUS = 3.0
"""Range of moduli, as a factor and its inverse, that are tried as an alternative to another pose."""


@dataclass(frozen=True, eq=False, slots=True)
class _Body:
    """The points of the body in one contact-free frame, selected with the fitted pose."""

    frame: int
    points: FloatArray
    """Points in the camera frame [m], shape (k, 3)."""
    cell: IntArray
    """Cell of the body at rest of each point, 0 … c − 1, shape (k,)."""


def check_declared_by_clouds(robot: Robot, recording: Recording, found: Calibration, views: Sequence[int]) -> None:
    """Compare declared poses with poses fitted to the clouds of contact-free frames.

    A warning is given if a declared pose lies outside the uncertainty of the fitted one, which includes the model error, and farther away than
    `estimate` can correct. The pose is refused if the fitted one has a quarter of its misfit, averaged over cells of the body. If another modulus
    reduces the misfit as much, the warning names both causes.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        found: the calibration with the declared poses.
        views: cameras with a declared pose, contact-free clouds and no markers.

    Raises:
        DataError: a declared pose is wrong; the error states by how much.
    """
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    spread = float(np.sqrt(((robot.body.mesh.nodes - robot.body.mesh.nodes.mean(axis=0)) ** 2).sum(axis=1).mean()))
    for view in views:
        fitted = _fitted(robot, recording, found, view)
        body = [] if fitted is None else _body(robot, recording, fitted, view, size)
        if fitted is None or not body:
            continue
        before, left = _left(robot, recording, found, view, body), _left(robot, recording, fitted, view, body)
        off, apart = _deviations(fitted, view, found.poses[view], pose_pivot(robot))
        plain = before > max(EXPLAINED * left, SUSPICIOUS * spread)
        if off < ALLOWED or (apart < KNOWN and not plain):
            continue
        middle = robot.body.mesh.nodes.mean(axis=0)
        text = (
            f"{pose_error(recording, [view], found.poses, fitted.poses, [middle])}: it leaves {1e3 * before:.3g} mm, one that is fitted to "
            f"the clouds {1e3 * left:.3g} mm. {REMEDY} That is {apart:.2g} times what the clouds leave open"
        )
        factor, softer = _with_modulus(robot, recording, found, view, body)
        by_modulus = softer < 0.5 * before
        if plain and not by_modulus:
            raise DataError(text)
        if by_modulus:
            text += f". With it, a modulus {factor:.2g} times as large leaves {1e3 * softer:.3g} mm: one of both is off"
        warnings.warn(text, stacklevel=4)


def views_to_check(recording: Recording, seen: IntArray) -> list[int]:
    """Return the cameras with a declared pose and contact-free clouds that see no markers."""
    free = free_clouds(recording)
    told = [v for v, T in enumerate(recording.T_robot_camera) if T is not None and v not in seen]
    return [v for v in told if any(recording.cloud_files[k][v] is not None for k in free)]


def _deviations(fitted: Calibration, view: int, declared: FloatArray, pivot: FloatArray) -> tuple[float, float]:
    """Return two distances of a declared pose from the fitted one [1]: rotation or translation relative to those that `estimate` can
    correct, and the Mahalanobis distance."""
    apart = declared @ invert_pose(fitted.poses[view])
    step = np.append(Rotation.from_matrix(apart[:3, :3]).as_rotvec(), transform_points(apart, pivot[None])[0] - pivot)
    own, whole = slice(6 * view, 6 * view + 6), (step / DECLARED_STD).reshape(2, 3)
    return float(np.linalg.norm(whole, axis=1).max()), float(
        np.sqrt(step @ np.linalg.solve(fitted.joint_covariance[own, own], step))
    )


def _fitted(robot: Robot, recording: Recording, found: Calibration, view: int) -> Calibration | None:
    """Return the calibration with the pose of one camera fitted to its clouds; None if they do not show the body."""
    opened = replace(recording, T_robot_camera=tuple(None if v == view else T for v, T in enumerate(found.poses)))
    views = seen_by(robot, recording, free_states(robot, recording, found, [view]), view)
    near = settle_cloud_pose(views, found.poses[view])
    if near.gain < LEAST:
        near = next((pose for pose in search_cloud_poses(views)[:1] if pose.gain >= LEAST), near)
    start = started_at(robot, found, {view: near.T_robot_camera})
    try:
        return fit_clouds(robot, opened, start, guessed=(view,))
    except DataError:
        return None


def _paths(robot: Robot, recording: Recording, found: Calibration, frames: Sequence[int]) -> dict[int, FloatArray]:
    """Return the nodes of the body in some frames under the inputs of a calibration [m]."""
    initial = calibrated_inputs(robot, recording, found) if recording.actuation_zero == "unknown" else None
    driven = DrivenRobot(robot, drive_of(robot, recording, initial=initial))
    return {k: state.positions for k, state in free_path(driven, frames)}


def _body(robot: Robot, recording: Recording, fitted: Calibration, view: int, size: float) -> list[_Body]:
    """Return the points of the body in one camera, selected with the fitted pose."""
    mesh, triangles, result = robot.body.mesh, body_surface(robot.body.mesh).triangles, list[_Body]()
    free = [k for k in free_clouds(recording) if recording.cloud_files[k][view] is not None]
    chosen = [free[i] for i in np.unique(np.linspace(0, len(free) - 1, FRAMES).round().astype(int))]
    noises = measured_noises(robot, recording, fitted)
    held = np.zeros(len(mesh.nodes), dtype=bool)
    held[robot.body.clamped] = True
    for k, positions in _paths(robot, recording, fitted, chosen).items():
        try:
            scan = read_scan(robot, recording, k, fitted.poses, positions)
        except FemsenseError:
            continue
        if scan is None:
            continue
        rows = ray_rows(scan, Surface(positions, triangles), fitted.poses, noises, reach=REACH * size).off(held)
        own = rows.view == view
        keys = np.floor(rows.hits.place(mesh.nodes)[own] / (CELL * size)), np.sign(rows.hits.normal[own]).round()
        cell = np.unique(np.hstack(keys), axis=0, return_inverse=True)[1].ravel()
        if own.any():
            result.append(_Body(k, scan.camera_points[rows.hits.index[own]], cell))
    return result


def _left(robot: Robot, recording: Recording, found: Calibration, view: int, body: Sequence[_Body]) -> float:
    """Return the root mean square, over cells, of the mean distance of points from the surface under a calibration [m]."""
    states, triangles = _paths(robot, recording, found, [one.frame for one in body]), body_surface(robot.body.mesh).triangles
    T, squares, count = found.poses[view], 0.0, 0
    for one in body:
        if one.frame not in states:
            return float("inf")
        gap = Surface(states[one.frame], triangles).closest(one.points @ T[:3, :3].T + T[:3, 3])[1]
        many = np.bincount(one.cell)
        squares += float((many * (np.bincount(one.cell, gap) / many) ** 2).sum())
        count += len(gap)
    return float(np.sqrt(squares / count))


def _with_modulus(
    robot: Robot, recording: Recording, found: Calibration, view: int, body: Sequence[_Body]
) -> tuple[float, float]:
    """Return the modulus, as a factor, with the smallest misfit at a pose, and that misfit [m]."""

    def left(log: float) -> float:
        softer = replace(robot, body=robot.body.with_stiffness_scale(float(np.exp(log))))
        return min(_left(softer, recording, found, view, body), 1e3)

    best = minimize_scalar(left, bounds=(-np.log(MODULUS), np.log(MODULUS)), method="bounded", options={"maxiter": 8})
    return float(np.exp(best.x)), float(best.fun)
