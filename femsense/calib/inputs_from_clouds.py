"""Initial inputs of cables, and the poses of cameras with them, from the clouds of free frames; what markers say of them enters as a Gaussian.

Gauss–Newton over poses and inputs: the residual of each point is that along its ray onto the body under the inputs.
A cable moves the whole body, so that a change of input looks like no change of pose in more than one frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from femsense.calib.calibration import Calibration
from femsense.calib.from_clouds import (
    RaySums,
    measured_noises,
    pose_pivot,
    ray_sums,
    what_clouds_know,
    worth_of_clouds,
)
from femsense.calib.inputs import calibrated_inputs, first_inputs, input_bounds, input_tables, largest_input, weak_inputs
from femsense.calib.other_law import with_other_law
from femsense.calib.residual_field import field_scores
from femsense.calib.scan import REACH, RayRows, Scan, ray_rows, read_scan
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError, FemsenseError
from femsense.core.pose import moved_poses
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.recording_checks import how_to_free
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface

FRAMES = 6
"""Free frames that are used at most, spread over the recording."""
STEPS = 8
DERIVATIVES = 3
"""In so many first steps the derivative by the inputs is new; in the first one where markers tell them nearly."""
START_STD = (0.1, 0.03)
"""What the poses are off by before: [rad], and as a share of the body's diagonal; as in `clouds_alone`."""
POINTLESS = 1e-9
"""This share of what markers know stands in for rays where no ray knows anything, so that equations can be solved."""
STEP = {"tension": 1e-2, "displacement": 1e-4}
"""Difference for the derivative by an input [N] or [m]."""


def with_initial_inputs(
    robot: Robot, recording: Recording, calibration: Calibration, known: FloatArray | None = None
) -> Calibration:
    """Return the calibration with undeclared poses and the initial inputs moved to where the clouds of free frames see the body.

    Arguments:
        robot, recording: as loaded; the recording's zero is unknown.
        calibration: with poses near the true ones.
        known: covariance of what markers say of undeclared poses (rotation [rad] and shift [m] each) and of the initial inputs
            ([N] or [m]) of the calibration, shape (p + a, p + a); by default hardly anything is known.

    Raises:
        DataError: no free frame has a cloud, or the body is found in none.
    """
    moving = [v for v, T in enumerate(recording.T_robot_camera) if T is None]
    which = np.concatenate([np.arange(6 * v, 6 * v + 6) for v in moving]) if moving else np.zeros(0, dtype=np.int64)
    p = len(which)
    if known is None:
        start, prior = first_inputs(robot, recording), np.asarray(np.diag(_prior(robot, recording, p)))
    else:
        start, prior = calibrated_inputs(robot, recording, calibration), np.asarray(np.linalg.inv(known))
    assert start is not None
    law = np.zeros(len(start) + p)
    if known is not None and calibration.law_step.size:
        law = np.append(calibration.law_step[which], calibration.law_step[6 * len(calibration.poses) :])
    fit = _Fit(robot, recording, measured_noises(robot, recording, calibration), which, start, prior, law)
    end = fit.joint(calibration.poses, DERIVATIVES if known is None else 1)
    if known is not None:
        end = fit.beside_markers(end)
    return _answer(fit, calibration, end, by_markers=known is not None)


@dataclass(frozen=True, eq=False, slots=True)
class _Weighed:
    """What clouds know beside markers, who count by it."""

    clouds: FloatArray
    """Information, shape (p + a, p + a)."""
    gradient: FloatArray
    """What takes the gradient of points that err on their own to it, shape (p + a, p + a)."""


@dataclass(frozen=True, eq=False, slots=True)
class _End:
    """Where a joint fit ends."""

    poses: list[FloatArray]
    initial: FloatArray
    """Initial inputs, shape (a,)."""
    gone: FloatArray
    """How far poses and inputs went, shape (p + a,)."""
    sums: RaySums
    weighed: _Weighed | None
    """How the rays counted; None: each on its own."""
    scans: dict[int, Scan]
    moves: dict[int, FloatArray]


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    """What a joint fit starts from."""

    robot: Robot
    recording: Recording
    noises: tuple[CameraNoise, ...]
    which: IntArray
    """Coordinates of poses that move, shape (p,)."""
    start: FloatArray
    """Initial inputs, shape (a,)."""
    prior: FloatArray
    """Precision of poses and inputs about where they start, shape (p + a, p + a)."""
    law: FloatArray
    """By how much another law moves what is known before, shape (p + a,)."""

    def joint(
        self,
        first: Sequence[FloatArray],
        derivatives: int,
        weighed: _Weighed | None = None,
        gone: FloatArray | None = None,
    ) -> _End:
        """Return where Gauss–Newton leads; in so many first steps the derivative is new. `weighed` says how rays count,
        `gone` how far poses and inputs have gone before."""
        robot, recording, p = self.robot, self.recording, len(self.which)
        poses, pivot, initial = list(first), pose_pivot(robot), self.start.copy()
        low, high = input_bounds(robot, recording)
        gone = np.zeros(p + len(initial)) if gone is None else gone
        scans: dict[int, Scan] = {}
        moves: dict[int, FloatArray] = {}
        for step in range(STEPS):
            states = _states(robot, recording, initial)
            if step < 2:
                scans = _scans(robot, recording, poses, states)
            if step < derivatives:
                moves = _moves(robot, recording, initial, states)
            sums = self._sums(scans, states, moves, poses)
            change = self._step(sums, weighed, gone, low - initial, high - initial)
            full = np.zeros(6 * len(poses))
            full[self.which] = change[:p]
            poses, gone, initial = moved_poses(poses, full, pivot), gone + change, initial + change[p:]
            if np.abs(change[p:]).max() < 1e-3 * STEP[recording.actuation] and np.abs(change[:p]).max(initial=0.0) < 1e-6:
                break
        return _End(poses, initial, gone, sums, weighed, scans, moves)

    def _step(self, sums: RaySums, weighed: _Weighed | None, gone: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return the step of least squares, shape (p + a,), that keeps inputs within their bounds."""
        known, right = (sums.normal, sums.right) if weighed is None else (weighed.clouds, weighed.gradient @ sums.right)
        root = np.linalg.cholesky(known + self.prior).T
        wanted = -np.linalg.solve(root.T, right + self.prior @ gone)
        free = np.full(len(gone) - len(low), np.inf)
        box = (np.append(-free, low - 1e-12), np.append(free, high + 1e-12))
        return np.asarray(lsq_linear(root, wanted, bounds=box).x)

    def beside_markers(self, end: _End) -> _End:
        """Return where markers and clouds lead together, each by what it knows, from where they lead if each point erred on its own."""
        normal = end.sums.normal + POINTLESS * self.prior
        clouds = what_clouds_know(normal, self.scores(end))
        clouds *= worth_of_clouds(clouds, self.prior, end.gone - np.linalg.solve(normal, end.sums.right))
        weighed = _Weighed(clouds, np.asarray(clouds @ np.linalg.inv(normal)))
        return replace(self, start=end.initial).joint(end.poses, 1, weighed, end.gone)

    def covariance(self, end: _End) -> FloatArray:
        """Return the covariance of poses and inputs, shape (p + a, p + a): of points, of what was known before, and of the law."""
        moved = self._moved_by_law(end)
        by_law = np.outer(moved, moved)
        if end.weighed is not None:
            return np.asarray(np.linalg.inv(end.weighed.clouds + self.prior) + by_law)
        inverse, scores = np.linalg.inv(end.sums.normal + self.prior), self.scores(end)
        return np.asarray(inverse @ (scores.T @ scores + self.prior) @ inverse + by_law)

    def scores(self, end: _End) -> FloatArray:
        """Return rows whose sum of squares is the covariance of the gradient (`field_scores`)."""
        states = _states(self.robot, self.recording, end.initial)
        return field_scores(self._rows(end.scans, states, end.moves, end.poses), self.robot.body.mesh.nodes)

    def _moved_by_law(self, end: _End) -> FloatArray:
        """Return where a fit under the neo-Hookean law ends, from here, shape (p + a,). What all cables have in common
        compresses the body, and laws that agree for small strains differ there. 0 where the robot declares a law by an effect."""
        other = with_other_law(self.robot)
        if other is None:
            return np.zeros(len(self.prior))
        gone = end.gone - self.law  # from where the other law leads what is known before
        there = replace(self, robot=other, start=end.initial).joint(end.poses, 1, end.weighed, gone)
        return np.asarray(there.gone - gone)

    def _sums(
        self, scans: dict[int, Scan], states: dict[int, FloatArray], moves: dict[int, FloatArray], poses: list[FloatArray]
    ) -> RaySums:
        size = float(np.linalg.norm(np.ptp(self.robot.body.mesh.nodes, axis=0)))
        return ray_sums(self._rows(scans, states, moves, poses), len(self.prior), size)

    def _rows(
        self, scans: dict[int, Scan], states: dict[int, FloatArray], moves: dict[int, FloatArray], poses: list[FloatArray]
    ) -> Iterator[tuple[RayRows, FloatArray]]:
        """Yield the rows of each frame, and how they change with poses and inputs, shape (r, p + a)."""
        mesh, pivot = self.robot.body.mesh, pose_pivot(self.robot)
        surface, size = body_surface(mesh), float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        for k in scans.keys() & states.keys() & moves.keys():
            rows = ray_rows(scans[k], Surface(states[k], surface.triangles), poses, self.noises, reach=REACH * size)
            by_input = -(rows.operator(len(states[k])) @ moves[k])
            yield rows, np.hstack([rows.by_pose(pivot, len(poses))[:, self.which], by_input])


def _prior(robot: Robot, recording: Recording, poses: int) -> FloatArray:
    """Return the precision of what is known before, shape (p + a,): hardly anything."""
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    pose = np.tile([START_STD[0]] * 3 + [START_STD[1] * size] * 3, poses // 6)
    return np.append(pose, np.full(len(robot.body.cables), largest_input(robot, recording.actuation))) ** -2.0


def _frames(recording: Recording) -> list[int]:
    free = np.zeros(recording.frame_count, dtype=bool) if recording.free is None else recording.free
    frames = [int(k) for k in np.flatnonzero(free) if any(file is not None for file in recording.cloud_files[k])]
    if not frames:
        raise DataError(
            "initial inputs without markers need clouds of free frames: mark frames in which nothing touches the robot "
            f"{how_to_free(recording)}"
        )
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, FRAMES).round().astype(int))]


def _states(robot: Robot, recording: Recording, initial: FloatArray) -> dict[int, FloatArray]:
    """Return the nodes of the free frames under initial inputs [m]; a frame without an equilibrium is left out."""
    driven = DrivenRobot(robot, drive_of(robot, recording, initial=initial))
    states = {k: state.positions for k, state in free_path(driven, _frames(recording))}
    if not states:
        raise DataError("no equilibrium in the free frames: are the inputs those of this robot?")
    return states


def _scans(robot: Robot, recording: Recording, poses: list[FloatArray], states: dict[int, FloatArray]) -> dict[int, Scan]:
    scans: dict[int, Scan] = {}
    for k, positions in states.items():
        try:
            scan = read_scan(robot, recording, k, poses, positions)
        except FemsenseError:
            continue
        if scan is not None:
            scans[k] = scan
    if not scans:
        raise DataError("the clouds of the free frames do not show the body")
    return scans


def _moves(robot: Robot, recording: Recording, initial: FloatArray, states: dict[int, FloatArray]) -> dict[int, FloatArray]:
    """Return how the nodes of each frame move with each input, shape (3n, a)."""
    h, columns = STEP[recording.actuation], dict[int, list[FloatArray]]()
    for i in range(len(initial)):
        more = _states(robot, recording, initial + h * np.eye(len(initial))[i])
        for k, positions in states.items():
            columns.setdefault(k, []).append(((more.get(k, positions) - positions) / h).ravel())
    return {k: np.stack(of, axis=1) for k, of in columns.items()}


def _answer(fit: _Fit, calibration: Calibration, end: _End, *, by_markers: bool) -> Calibration:
    """Return the calibration with what was found."""
    robot, recording, p, poses = fit.robot, fit.recording, len(fit.which), end.poses
    covariance = fit.covariance(end)
    joint = np.zeros((6 * len(poses),) * 2)
    joint[np.ix_(fit.which, fit.which)] = covariance[:p, :p]
    tables = input_tables(robot, recording, end.initial, covariance[p:, p:])
    weak = weak_inputs(recording, tables.tension_std if recording.actuation == "tension" else tables.displacement_std)
    found, what = ("converged", "these data") if by_markers else ("converged (initial inputs by clouds alone)", "the clouds")
    return replace(
        calibration,
        status=f"{found}, but {what} hardly determine the initial input of {weak}" if weak else found,
        T_robot_camera=freeze(poses[0]),
        poses=tuple(freeze(T) for T in poses),
        pose_covariance=freeze(joint[:6, :6]),
        joint_covariance=freeze(joint),
        normal_rms_m=end.sums.rms,
        cable_tension_n=tables.tension,
        cable_displacement_m=tables.displacement,
        tension_std_n=tables.tension_std,
        displacement_std_m=tables.displacement_std,
        frames=calibration.frames if by_markers else tuple(int(recording.frame_numbers[k]) for k in _frames(recording)),
    )
