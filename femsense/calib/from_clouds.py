"""Pose of the cameras and noise of their depth from the clouds of free frames, together with what markers say.

The residual of every point along the normal of the surface that its ray meets moves the poses (and unknown inputs) in a
Gauss–Newton fit; the fit to the markers enters as a Gaussian. Neighbouring residuals err together (mesh, law), so clouds know
what points know under a field along the surface (`residual_field`), and count beside markers by that.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.inputs import calibrated_inputs
from femsense.calib.other_law import with_other_law
from femsense.calib.residual_field import field_scores, row_weights
from femsense.calib.scan import REACH, RayRows, Scan, ray_rows, read_scan
from femsense.core.arrays import BoolArray, FloatArray, freeze
from femsense.core.errors import FemsenseError
from femsense.core.pose import moved_poses
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface

FRAMES = 12
"""More free frames than this are thinned out evenly."""
STEPS = 6
"""Gauss–Newton steps at most; rays and weights are new in each."""
DAMPINGS = (0.0, 1e-3, 1e-2, 1e-1)
"""Of a step, in units of what the best known direction is held by."""
LOST = 0.01
"""A step may lose this share of the points that lie on the body: rays at a silhouette come and go."""
USUAL = CameraNoise("stereo", at_1m=0.002)
"""A camera of which nothing is known: the D415 at its default setting."""


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """A free frame."""

    scan: Scan
    state: Equilibrium
    surface: Surface


@dataclass(frozen=True, eq=False, slots=True)
class RaySums:
    """Normal equations of the rows of all frames."""

    normal: FloatArray
    """JᵀJ, shape (p, p)."""
    right: FloatArray
    """Jᵀr, shape (p,)."""
    rms: float
    """Root mean square of the residual [m]."""
    explained: float = 0.0
    """How many points lie on the body: 1 for one on it, 0 for one that is REACH off [1]."""


def pose_pivot(robot: Robot) -> FloatArray:
    """Return the point about which pose steps turn [m], shape (3,): the markers' mean, the body's where there are none."""
    return np.asarray(robot.marker_points.mean(axis=0) if len(robot.marker_points) else robot.body.mesh.nodes.mean(axis=0))


def measured_noises(robot: Robot, recording: Recording, calibration: Calibration) -> tuple[CameraNoise, ...]:
    """Return the noise of each camera: declared, else as the free frames' clouds scatter about their own smooth part.

    Arguments:
        robot, recording: as loaded.
        calibration: with the poses.
    """
    declared = [camera.noise if camera is not None else None for camera in recording.cameras]
    if not recording.has_clouds or all(noise is not None for noise in declared):
        return tuple(noise or USUAL for noise in declared)
    frames = _free_frames(robot, recording, calibration.poses, calibration)
    return tuple(noise or _measured_noise(robot, frames, calibration.poses, view) for view, noise in enumerate(declared))


def refine_poses(robot: Robot, recording: Recording, calibration: Calibration, *, guessed: Sequence[int] = ()) -> Calibration:
    """Return the calibration with its undeclared poses moved to where the clouds of free frames see the body.

    Arguments:
        robot, recording: as loaded.
        calibration: of the markers, or a start for the poses; its covariance is the prior (zero: nothing is known but the start).
        guessed: cameras whose pose is a start that nothing measured: its covariance is a bound, and pulls no answer of the clouds back.

    Returns:
        the calibration with poses, their covariance, and `normal_rms_m`; as it was where no free frame has a cloud.
    """
    moving = [v for v, T in enumerate(recording.T_robot_camera) if T is None]
    frames = _free_frames(robot, recording, calibration.poses, calibration)
    if not frames or not moving:
        return calibration
    noises = measured_noises(robot, recording, calibration)
    pivot, size = pose_pivot(robot), float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    which = np.concatenate([np.arange(6 * v, 6 * v + 6) for v in moving])
    law = _law_of(calibration)
    prior = _prior(calibration.joint_covariance - np.outer(law, law), which)
    held = np.zeros(len(robot.body.mesh.nodes), dtype=bool)
    held[robot.body.clamped] = True
    equations = _Equations(frames, noises, pivot, size, which, held)
    weight, center = np.eye(len(which)), np.zeros(len(which))
    measured = prior.any() and not set(moving) <= set(guessed)
    for _ in range(2 if measured else 1):  # the second time with what the clouds are worth beside the markers
        used = weight, center
        poses, gone, sums = _nearer(equations, list(calibration.poses), prior, *used)
        normal, right, rms = sums.normal, sums.right, sums.rms
        if np.linalg.matrix_rank(normal) < len(normal):  # no ray meets the body there, or none holds a direction
            return calibration
        center = np.where(np.isin(which // 6, guessed), gone, 0.0)
        apart = gone - center - np.linalg.solve(normal, right)
        clouds = what_clouds_know(normal, field_scores(equations.rows(poses), robot.body.mesh.nodes))
        clouds *= worth_of_clouds(clouds, prior, apart) if measured else 1.0
        weight = clouds @ np.linalg.inv(normal)
    ended = replace(calibration, poses=tuple(poses))
    moved = _moved_by_law(robot, recording, ended, equations, prior, used[0], used[1] - gone + law[which])
    covariance = np.zeros((6 * len(poses),) * 2)
    covariance[np.ix_(which, which)] = np.linalg.inv(clouds + prior) + np.outer(moved, moved)
    law_step = np.zeros(len(covariance))
    law_step[which] = moved
    return replace(
        calibration,
        T_robot_camera=freeze(poses[0]),
        poses=tuple(freeze(T) for T in poses),
        pose_covariance=freeze(covariance[:6, :6]),
        joint_covariance=freeze(covariance),
        law_step=freeze(np.append(law_step, calibration.law_step[len(law_step) :])),
        normal_rms_m=rms,
    )


def _law_of(calibration: Calibration) -> FloatArray:
    """Return by how much another law moves the poses of a calibration, shape (6 v,); 0 where nobody knows."""
    p = 6 * len(calibration.poses)
    return calibration.law_step[:p] if calibration.law_step.size else np.zeros(p)


def _moved_by_law(
    robot: Robot,
    recording: Recording,
    ended: Calibration,
    equations: _Equations,
    prior: FloatArray,
    weight: FloatArray,
    center: FloatArray,
) -> FloatArray:
    """Return where a fit under the other law ends that begins where a fit ended, shape (p,); 0 where the robot declares its law.
    The center of the prior is where the other law moves it."""
    other = with_other_law(robot)
    frames = [] if other is None else _free_frames(other, recording, ended.poses, ended)
    if not frames:
        return np.zeros(len(prior))
    return _nearer(replace(equations, frames=frames), list(ended.poses), prior, weight, center)[1]


def what_clouds_know(normal: FloatArray, scores: FloatArray) -> FloatArray:
    """Return the information of the clouds, shape (p, p): that of points that err together, N S⁻¹ N, in no direction more than N.

    Arguments:
        normal: N, information of points that err each on its own, shape (p, p).
        scores: rows whose sum of squares S is the covariance of the gradient, shape (g, p).
    """
    root = np.linalg.cholesky(normal)
    whitened = np.linalg.solve(root, scores.T)
    values, vectors = np.linalg.eigh(whitened @ whitened.T)
    half = root @ vectors / np.sqrt(np.maximum(values, 1.0))
    return np.asarray(half @ half.T)


def worth_of_clouds(clouds: FloatArray, prior: FloatArray, apart: FloatArray) -> float:
    """Return by which share the clouds count beside the markers [1].

    Where clouds and markers are farther apart than both deviations say, the clouds err by more still (model, lens). They then
    count by so much less that the difference is one that is to be expected.
    Source: Mandel and Paule, "Interlaboratory evaluation of a material with unequal numbers of replicates" (1970).

    Arguments:
        clouds: information of the clouds, shape (p, p).
        prior: information of the markers, shape (p, p).
        apart: answer of the clouds alone less that of the markers, shape (p,).
    """
    p, of_markers, of_clouds = len(clouds), np.linalg.inv(prior), np.linalg.inv(clouds)

    def distance(worth: float) -> float:
        return float(apart @ np.linalg.solve(of_markers + of_clouds / worth, apart))

    if distance(1.0) <= p:
        return 1.0
    low, high = 1e-12, 1.0
    for _ in range(60):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if distance(middle) < p else (low, middle)
    return low


@dataclass(frozen=True, eq=False, slots=True)
class _Equations:
    """The rays of all frames."""

    frames: list[_Seen]
    noises: tuple[CameraNoise, ...]
    pivot: FloatArray
    size: float
    which: FloatArray
    """Of all coordinates of poses, those that move, shape (p,)."""
    held: BoolArray
    """Nodes that are clamped, shape (n,): what holds them hides them, and lies where they should be or before."""

    def rows(self, poses: list[FloatArray]) -> Iterator[tuple[RayRows, FloatArray]]:
        """Yield the rows of each frame at poses, and how they change with them."""
        for seen in self.frames:
            rows = ray_rows(seen.scan, seen.surface, poses, self.noises, reach=REACH * self.size).off(self.held)
            yield rows, rows.by_pose(self.pivot, len(poses))[:, self.which]

    def at(self, poses: list[FloatArray]) -> RaySums:
        """Return the normal equations at poses."""
        return ray_sums(self.rows(poses), len(self.which), self.size)


def _nearer(
    equations: _Equations, poses: list[FloatArray], prior: FloatArray, weight: FloatArray, center: FloatArray
) -> tuple[list[FloatArray], FloatArray, RaySums]:
    """Return the poses to which Gauss–Newton leads, how far they went, shape (p,), and the equations there.

    The rays' equations count by a weight, shape (p, p), beside a prior about a center, shape (p,).

    A flat side that faces the camera hardly says where it lies in its plane, and a step may leave it. Steps are damped until no
    more points than a few are lost (Levenberg 1944), those directions first that are known least.
    """
    gone, sums = np.zeros(len(prior)), equations.at(poses)
    unit = np.tile([1.0 / equations.size**2] * 3 + [1.0] * 3, len(prior) // 6)
    for _ in range(STEPS):
        root = np.sqrt(unit)
        rays = weight @ sums.normal
        top = float(np.linalg.norm(rays * np.outer(root, root), 2))
        for damping in DAMPINGS if sums.explained > 0.0 else ():
            matrix = rays + prior + np.diag(damping * top / unit)
            step = -np.linalg.lstsq(matrix, weight @ sums.right + prior @ (gone - center), rcond=None)[0]
            full = np.zeros(6 * len(poses))
            full[equations.which] = step
            tried = moved_poses(poses, full, equations.pivot)
            there = equations.at(tried)
            if there.explained >= (1.0 - LOST) * sums.explained:
                break
        else:
            break
        poses, gone, sums = tried, gone + step, there
        if np.abs(step[3:]).max() < 1e-7 and np.abs(step[:3]).max() < 1e-6:
            break
    return poses, gone, sums


def ray_sums(frames: Iterable[tuple[RayRows, FloatArray]], p: int, size: float) -> RaySums:
    """Return the robust normal equations of the rows of all frames.

    Arguments:
        frames: rows of each frame, and how their residual changes with the parameters, shape (r, p).
        p: number of parameters.
        size: diagonal of the body [m].
    """
    normal, right, squares, count, explained = np.zeros((p, p)), np.zeros(p), 0.0, 0, 0.0
    for rows, derivative in frames:
        J = derivative / rows.std[:, None]
        z = rows.residual / rows.std
        weight = row_weights(rows)
        normal += J.T @ (weight[:, None] * J)
        right += J.T @ (weight * z)
        squares, count = squares + float((rows.residual**2).sum()), count + len(z)
        explained += float(np.maximum(1.0 - (rows.residual / (REACH * size)) ** 2, 0.0).sum())
    return RaySums(normal, right, float(np.sqrt(squares / max(count, 1))), explained)


def _prior(covariance: FloatArray, which: FloatArray) -> FloatArray:
    """Return the precision that the markers leave to the clouds; zero where they say nothing."""
    own = covariance[np.ix_(which, which)] if covariance.size else np.zeros((len(which),) * 2)
    if not np.isfinite(own).all() or not (np.diag(own) > 0).all():
        return np.zeros_like(own)
    return np.asarray(np.linalg.inv(own))


def _free_frames(robot: Robot, recording: Recording, poses: tuple[FloatArray, ...], calibration: Calibration) -> list[_Seen]:
    """Return what is seen in the free frames that have clouds."""
    free = free_clouds(recording)
    initial = calibrated_inputs(robot, recording, calibration) if recording.actuation_zero == "unknown" else None
    driven, triangles = DrivenRobot(robot, drive_of(robot, recording, initial=initial)), body_surface(robot.body.mesh).triangles
    result = []
    for k, state in free_path(driven, free):
        try:
            scan = read_scan(robot, recording, k, poses, state.positions)
        except FemsenseError:
            continue
        if scan is not None:
            result.append(_Seen(scan, state, Surface(state.positions, triangles)))
    return result


def free_clouds(recording: Recording) -> list[int]:
    """Return the frames that are free and have a cloud, evenly thinned out to FRAMES."""
    if recording.free is None or not recording.has_clouds:
        return []
    free = [int(k) for k in np.flatnonzero(recording.free) if any(file is not None for file in recording.cloud_files[k])]
    return [free[i] for i in np.unique(np.linspace(0, len(free) - 1, FRAMES).round().astype(int))] if free else []


def _measured_noise(robot: Robot, frames: list[_Seen], poses: tuple[FloatArray, ...], view: int) -> CameraNoise:
    """Return stereo noise that makes the residuals about their smooth part as large as they are."""
    unit = (CameraNoise("stereo", at_1m=1.0),) * len(poses)
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    spread = [
        _smooth_rest(rows)
        for seen in frames
        for rows in [ray_rows(seen.scan, seen.surface, poses, unit, reach=REACH * size)]
        if len(rows.residual)
    ]
    every = np.concatenate(spread) if spread else np.zeros(0)
    return CameraNoise("stereo", at_1m=1.483 * float(np.median(np.abs(every)))) if len(every) >= 100 else USUAL


def _smooth_rest(rows: RayRows) -> FloatArray:
    """Return whitened residuals without the mean of those around them."""
    cell = np.ptp(rows.points, axis=0).max() / 30.0 + 1e-12
    z = rows.residual / rows.std
    _, group = np.unique(np.floor(rows.points / cell).astype(np.int64), axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    mean = np.bincount(group, z) / count
    many = count[group] >= 5
    scale = np.sqrt(count / np.maximum(count - 1.0, 1.0))
    return np.asarray(((z - mean[group]) * scale[group])[many])
