"""Camera poses and initial inputs from the clouds of contact-free frames, combined with the estimate from markers.

Parameters are a step of each pose and the initial inputs, with a Gaussian prior from the markers or from an initial guess. The residual of a point is its
distance from the face that its ray hits, along the normal. Gauss–Newton: the posterior mean of the linearised problem is the next point, with new
states, rays and weights. Residuals of neighbouring points are correlated (errors of mesh and law); their covariance is that of a smooth random field
along the surface (`residual_field`). In a single frame a change of an input resembles a change of the pose, so several frames are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq, lsq_linear

from femsense.calib.calibration import Calibration
from femsense.calib.inputs import calibrated_inputs, first_inputs, input_bounds, input_tables, largest_input, weak_inputs
from femsense.calib.other_law import with_other_law
from femsense.calib.residual_field import field_scores, row_weights
from femsense.calib.scan import REACH, RayRows, Scan, ray_rows, read_scan
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import DataError, FemsenseError
from femsense.core.pose import moved_poses, std_of_entries
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.recording_checks import how_to_free
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface

FRAMES, FRAMES_WITH_INPUTS = 12, 6
"""Maximum number of contact-free frames, evenly spaced; and if inputs are fitted, which needs one more state per input and frame."""
STEPS = 12
"""Maximum number of Gauss–Newton steps, each with new rays and weights."""
DERIVATIVES = 3
"""Number of initial steps that recompute the derivatives by the inputs; only the first one does if markers determine them."""
STEP = {"tension": 1e-2, "displacement": 1e-4}
"""Finite difference of an input [N or m]."""
START_STD = (0.1, 0.03)
"""Prior σ of a pose from a global search: [rad], and relative to the body's diagonal; three times the errors of
benchmarks/calibration.py."""
DAMPINGS = (0.0, 1e-3, 1e-2, 1e-1)
"""Damping of a step, relative to the largest eigenvalue of the information."""
LOST = 0.01
"""Maximum share of the points on the body that a step may lose: rays at a silhouette change between hit and miss."""
FEWEST = 30
"""Minimum number of rays that hit the body in all frames."""
STILL = 0.02
"""A fit has converged if no parameter changes by more than this share of its standard deviation."""
USUAL = CameraNoise("stereo", at_1m=0.002)
"""Noise of an unknown camera: that of the D415 at its default setting."""


def pose_pivot(robot: Robot) -> FloatArray:
    """Return the point about which pose steps rotate [m], shape (3,): the mean of the markers, or of the body without markers."""
    return np.asarray(robot.marker_points.mean(axis=0) if len(robot.marker_points) else robot.body.mesh.nodes.mean(axis=0))


def free_clouds(recording: Recording, most: int = FRAMES) -> list[int]:
    """Return at most FRAMES contact-free frames with a cloud, evenly spaced."""
    if recording.free is None or not recording.has_clouds:
        return []
    free = [int(k) for k in np.flatnonzero(recording.free) if any(file is not None for file in recording.cloud_files[k])]
    return [free[i] for i in np.unique(np.linspace(0, len(free) - 1, most).round().astype(int))] if free else []


def fit_clouds(robot: Robot, recording: Recording, calibration: Calibration, *, guessed: Sequence[int] = ()) -> Calibration:
    """Fit undeclared poses, and initial inputs with an unknown zero, to the clouds of contact-free frames.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        calibration: calibration from markers, or an initial guess; its covariances are the prior (zero: flat prior).
        guessed: cameras whose pose is a guess: its covariance limits the steps and does not enter the posterior.

    Returns:
        the calibration with poses, inputs, their covariance, and `normal_rms_m`; unchanged if no contact-free frame shows the body.

    Raises:
        DataError: markers do not determine the initial inputs, and no contact-free frame shows the body.
    """
    unknown = recording.actuation_zero == "unknown" and bool(robot.body.cables)
    alone = unknown and not calibration.marker_covariance.any()
    if not free_clouds(recording) and alone:
        raise DataError(
            "initial inputs without markers need clouds of free frames: mark frames in which nothing touches the robot "
            f"{how_to_free(recording)}"
        )
    if not free_clouds(recording) or not (unknown or len(_moving(recording))):
        return calibration
    p, a = 6 * len(calibration.poses), len(robot.body.cables) if unknown else 0
    law = np.zeros(p + a)
    law[: len(calibration.law_step)] = calibration.law_step[: len(law)]
    prior, loose = _prior_of_poses(robot, recording, calibration.joint_covariance - np.outer(law[:p], law[:p]), guessed)
    inputs = None
    if unknown:
        inputs = first_inputs(robot, recording) if alone else calibrated_inputs(robot, recording, calibration)
        prior = _with_inputs(robot, recording, calibration, prior, guessed)
    loose = np.append(loose, np.full(a, alone))
    fit = _Fit(robot, recording, measured_noises(robot, recording, calibration), inputs, prior, loose, law)
    try:
        end = fit.end(calibration.poses, inputs, np.zeros(p + a))
    except DataError:
        if alone:
            raise
        return calibration
    return fit.calibrated(calibration, end, alone=alone)


def _with_inputs(
    robot: Robot, recording: Recording, calibration: Calibration, poses: FloatArray, guessed: Sequence[int]
) -> FloatArray:
    """Return the prior covariance of pose steps and initial inputs: that of the markers, combined with a bound on the inputs at which they
    would crush the body."""
    p, a = len(poses), len(robot.body.cables)
    prior = block_diag(poses, largest_input(robot, recording.actuation) ** 2 * np.eye(a))
    known = calibration.marker_covariance
    if not known.any() or not np.isfinite(known).all():
        return np.asarray(prior)
    marked = [c for c in _moving(recording) if c // 6 not in guessed]
    if len(marked) + a != len(known):  # poses fitted to markers count as declared here
        known, marked = known[-a:, -a:], []
    own = np.append(np.array(marked, dtype=np.int64), np.arange(p, p + a))
    wide = known[-a:, -a:] + prior[p:, p:]
    prior[np.ix_(own, own)] = known - known[:, -a:] @ np.linalg.solve(wide, known[-a:])
    return np.asarray(prior)


def _moving(recording: Recording) -> IntArray:
    """Return the coordinates of undeclared poses."""
    return np.flatnonzero(np.repeat([T is None for T in recording.T_robot_camera], 6))


def _prior_of_poses(
    robot: Robot, recording: Recording, covariance: FloatArray, guessed: Sequence[int]
) -> tuple[FloatArray, BoolArray]:
    """Return the prior covariance of pose steps, shape (6 v, 6 v), and which of them only limit the steps, shape (6 v,): those of cameras
    with a guessed or unknown pose."""
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    prior, loose = np.zeros_like(covariance), np.zeros(len(covariance), dtype=bool)
    moving = _moving(recording)
    prior[np.ix_(moving, moving)] = covariance[np.ix_(moving, moving)]
    for v in np.unique(moving // 6).tolist():
        own = slice(6 * v, 6 * v + 6)
        unknown = not (np.isfinite(prior[own, own]).all() and (np.diag(prior[own, own]) > 0).all())
        if unknown:
            prior[own, :], prior[:, own] = 0.0, 0.0
            prior[own, own] = np.diag(np.repeat([START_STD[0], START_STD[1] * size], 3) ** 2)
        loose[own] = unknown or v in guessed
    return prior, loose


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """A contact-free frame at one point of the iteration."""

    scan: Scan
    surface: Surface
    moves: FloatArray
    """Derivative of the nodes by each initial input, shape (a or 0, n, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class _End:
    """The end of a fit."""

    poses: tuple[FloatArray, ...]
    inputs: FloatArray | None
    """Initial inputs, shape (a,)."""
    gone: FloatArray
    """Change of poses and inputs, shape (c,)."""
    covariance: FloatArray
    """Covariance of poses and inputs, shape (c, c)."""
    scores: FloatArray
    """Rows whose sum of squares is the covariance of the gradient, shape (g, c), see `field_scores`."""
    rms: float
    """Root mean square residual of the robot's pixels [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    """The fit of poses and, if the prior contains them, initial inputs."""

    robot: Robot
    recording: Recording
    noises: tuple[CameraNoise, ...]
    inputs: FloatArray | None
    """Initial inputs at the start, shape (a,); None if their zero is known."""
    prior: FloatArray
    """Covariance of pose steps, and of steps of fitted initial inputs, about the start, shape (c, c)."""
    loose: BoolArray
    """Coordinates with a guessed start, shape (c,): their prior limits the steps and does not enter the posterior."""
    law: FloatArray
    """Change of the prior mean under another law of the material, shape (c,)."""

    @property
    def fits_inputs(self) -> bool:
        return len(self.prior) > 6 * len(self.recording.T_robot_camera)

    def calibrated(self, calibration: Calibration, end: _End, *, alone: bool) -> Calibration:
        """Return the calibration with the result of the clouds; alone: markers do not determine the initial inputs."""
        p, robot = 6 * len(calibration.poses), self.robot
        moved = self.moved_by_law(end)
        covariance = end.covariance + np.outer(moved, moved)
        fitted = replace(
            calibration,
            T_robot_camera=freeze(end.poses[0]),
            poses=tuple(freeze(T) for T in end.poses),
            pose_covariance=freeze(covariance[:6, :6]),
            pose_std=std_of_entries(end.poses[0], covariance[:6, :6], pose_pivot(self.robot)),
            joint_covariance=freeze(covariance[:p, :p]),
            law_step=freeze(np.append(moved[:p], calibration.law_step[p:])),
            normal_rms_m=end.rms,
        )
        if not self.fits_inputs:
            return fitted
        tables = input_tables(robot, self.recording, end.inputs, covariance[p:, p:])
        own = tables.tension_std if self.recording.actuation == "tension" else tables.displacement_std
        weak = weak_inputs(self.recording, own)
        found, what = ("converged (initial inputs by clouds alone)", "the clouds") if alone else ("converged", "these data")
        used = self.recording.frame_numbers[free_clouds(self.recording, FRAMES_WITH_INPUTS)]
        return replace(
            fitted,
            status=f"{found}, but {what} hardly determine the initial input of {weak}" if weak else found,
            cable_tension_n=tables.tension,
            cable_displacement_m=tables.displacement,
            tension_std_n=tables.tension_std,
            displacement_std_m=tables.displacement_std,
            frames=tuple(map(int, used)) if alone else calibration.frames,
        )

    def end(
        self,
        poses: Sequence[FloatArray],
        inputs: FloatArray | None,
        gone: FloatArray,
        scores: FloatArray | None = None,
    ) -> _End:
        """Return the end of the Gauss–Newton iteration; without `scores`, the errors of points are independent.

        A flat face towards the camera hardly determines its position in its own plane, so that a step can leave it. Steps are damped until at most the
        share LOST of the points is lost (Levenberg 1944); damping acts on the worst determined directions first.
        """
        poses = tuple(poses)
        p = 6 * len(poses)
        frames, blocks = self.at(poses, inputs, {}, 0)
        settled, begun = scores is not None, (poses, inputs, gone)
        for step in range(STEPS):
            mean, explained = -np.where(self.loose, 0.0, gone), self.explained(blocks)
            for damping in DAMPINGS:
                said = self.posterior(blocks, mean, scores, damping)
                change = self._within_bounds(said, inputs)
                tried = tuple(moved_poses(poses, change[:p], pose_pivot(self.robot)))
                pulled = inputs + change[p:] if inputs is not None and self.fits_inputs else inputs
                there = self.at(tried, pulled, frames, step + 1)
                if self.explained(there[1]) >= (1.0 - LOST) * explained:
                    poses, inputs, gone, (frames, blocks) = tried, pulled, gone + change, there
                    break
            else:
                change = np.zeros(len(gone))
            if (np.abs(change) <= STILL * np.linalg.norm(said.root, axis=1)).all() or step == STEPS // 2 - 1:
                if settled:
                    break
                scores, settled = field_scores(blocks, self.robot.body.mesh.nodes), True
                if self.loose.any():  # with a guessed start only, correlated errors change the covariance and not the estimate
                    break
                poses, inputs, gone = (
                    begun  # a step back to the markers would lose points: the second iteration starts from there too
                )
                frames, blocks = self.at(poses, inputs, frames, step + 1)
        assert scores is not None
        root = self.posterior(blocks, mean, scores, 0.0).root
        squares, count = sum(float((rows.residual**2).sum()) for rows, _ in blocks), sum(len(rows.residual) for rows, _ in blocks)
        return _End(poses, inputs, gone, root @ root.T, scores, float(np.sqrt(squares / max(count, 1))))

    def at(
        self, poses: Sequence[FloatArray], inputs: FloatArray | None, before: dict[int, _Seen], step: int
    ) -> tuple[dict[int, _Seen], list[tuple[RayRows, FloatArray]]]:
        """Return the contact-free frames at a point, and their rows. Raises DataError if hardly any ray hits the body at the start."""
        frames = self.frames(poses, inputs, before, step)
        blocks = [self.rows(seen, poses) for seen in frames.values()]
        if step == 0 and sum(len(rows.residual) for rows, _ in blocks) < FEWEST:
            raise DataError("the clouds of the free frames do not show the body")
        return frames, blocks

    def explained(self, blocks: Sequence[tuple[RayRows, FloatArray]]) -> float:
        """Return the number of points on the body, each with a weight from 1 on the surface to 0 at REACH."""
        reach = REACH * float(np.linalg.norm(np.ptp(self.robot.body.mesh.nodes, axis=0)))
        return sum(float((1.0 - (rows.residual / reach) ** 2).sum()) for rows, _ in blocks)

    def moved_by_law(self, end: _End) -> FloatArray:
        """Return the change of the estimate under the other constitutive law, shape (c,), by a fit that starts from this one. The common
        input of all cables compresses the body, where laws that agree for small strains differ. 0 if the robot declares a law by an
        effect."""
        other = with_other_law(self.robot)
        if other is None:
            return np.zeros(len(self.prior))
        gone = end.gone - self.law  # start from the prior mean under the other law
        try:
            there = replace(self, robot=other).end(end.poses, end.inputs, gone, end.scores)
        except DataError:
            return np.zeros(len(self.prior))
        return np.asarray(there.gone - gone)

    def frames(
        self, poses: Sequence[FloatArray], inputs: FloatArray | None, before: dict[int, _Seen], step: int
    ) -> dict[int, _Seen]:
        """Return the contact-free frames, with new states if inputs change, and new clouds and derivatives in the first steps."""
        if before and not self.fits_inputs:
            return before
        states = self._states(inputs)
        moves = {k: seen.moves for k, seen in before.items()}
        if step < (DERIVATIVES if self.loose.any() else 1):
            moves = self._moves(inputs, states)
        result, triangles = dict[int, _Seen](), body_surface(self.robot.body.mesh).triangles
        for k, positions in states.items():
            scan = before[k].scan if step > 1 and k in before else self._scan(k, poses, positions)
            if scan is not None and k in moves:
                result[k] = _Seen(scan, Surface(positions, triangles), moves[k])
        if sum(len(seen.scan.view) for seen in result.values()) < FEWEST:
            raise DataError("the clouds of the free frames do not show the body")
        return result

    def rows(self, seen: _Seen, poses: Sequence[FloatArray]) -> tuple[RayRows, FloatArray]:
        """Return the rows of a frame and their derivatives by the parameters, shape (r, c). Rows on clamped nodes are used only if inputs
        are fitted, because only they separate inputs from poses. Otherwise they are left out: the holder hides the clamped part, and its
        points lie at or in front of it."""
        mesh = self.robot.body.mesh
        size, held = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0))), np.zeros(len(mesh.nodes), dtype=bool)
        held[self.robot.body.clamped] = True
        rows = ray_rows(seen.scan, seen.surface, poses, self.noises, reach=REACH * size)
        rows = rows if self.fits_inputs else rows.off(held)
        by_input = -(rows.operator(len(mesh.nodes)) @ seen.moves.reshape(len(seen.moves), 3 * len(mesh.nodes)).T)
        return rows, np.hstack([rows.by_pose(pose_pivot(self.robot), len(poses)), by_input])

    def posterior(
        self, blocks: Sequence[tuple[RayRows, FloatArray]], mean: FloatArray, scores: FloatArray | None, damping: float
    ) -> _Posterior:
        """Return the posterior of the next step from prior and points.

        The estimate of the points alone is that of least squares, −N⁻¹ g. Its information is Godambe's, N S⁻¹ N, with the covariance S ≥ N of the gradient
        under noise and a smooth field (White 1982): N alone without `scores`.

        If the estimates of points and of markers differ by more than their covariances allow, both have a further error (lens, model): the covariance of
        the points is then increased until the difference is expected (Mandel & Paule 1970).

        Arguments:
            mean: prior mean of the c parameters, shape (c,).
            damping: damping of the step, relative to the largest eigenvalue of the information.
        """
        values, vectors = np.linalg.eigh(self.prior)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        root = root[:, values > 1e-14 * values.max()]
        N, g = np.zeros((root.shape[1],) * 2), np.zeros(root.shape[1])
        for rows, derivative in blocks:
            J, weight = derivative @ root, row_weights(rows) / rows.std**2
            N += (J * weight[:, None]).T @ J
            g -= (J * weight[:, None]).T @ (rows.residual + derivative @ mean)
        N += 1e-12 * max(float(np.trace(N)), 1e-300) * np.eye(len(N))
        half = np.linalg.cholesky(N)
        whitened = np.zeros((1, len(N))) if scores is None else np.linalg.solve(half, (scores @ root).T).T
        errors, U = np.linalg.eigh(whitened.T @ whitened)
        half = half @ U / np.sqrt(np.maximum(errors, 1.0))
        known, V = np.linalg.eigh(half @ half.T)
        known, apart = np.maximum(known, 0.0), V.T @ np.linalg.solve(N, g)
        known *= _worth(known, apart) if scores is not None and not self.loose.any() else 1.0
        back = root @ V
        return _Posterior(mean + back @ (known / (1.0 + known + damping * known.max()) * apart), back / np.sqrt(1.0 + known))

    def _scan(self, k: int, poses: Sequence[FloatArray], positions: FloatArray) -> Scan | None:
        try:
            return read_scan(self.robot, self.recording, k, poses, positions)
        except FemsenseError:
            return None

    def _states(self, inputs: FloatArray | None) -> dict[int, FloatArray]:
        """Return the nodes of the contact-free frames under initial inputs [m]; frames without an equilibrium are left out."""
        driven = DrivenRobot(self.robot, drive_of(self.robot, self.recording, initial=inputs))
        frames = free_clouds(self.recording, FRAMES_WITH_INPUTS if self.fits_inputs else FRAMES)
        states = {k: state.positions for k, state in free_path(driven, frames)}
        if not states:
            raise DataError("no equilibrium in the free frames: are the inputs those of this robot?")
        return states

    def _moves(self, inputs: FloatArray | None, states: dict[int, FloatArray]) -> dict[int, FloatArray]:
        """Return the derivative of the nodes of each frame by each initial input, shape (a, n, 3)."""
        a, h = len(self.prior) - 6 * len(self.recording.T_robot_camera), STEP[self.recording.actuation]
        near = [self._states(inputs + h * axis) for axis in np.eye(a)] if inputs is not None and a else []
        return {
            k: np.array([(one.get(k, positions) - positions) / h for one in near]).reshape(len(near), *positions.shape)
            for k, positions in states.items()
        }

    def _within_bounds(self, said: _Posterior, inputs: FloatArray | None) -> FloatArray:
        """Return the most likely step with inputs within their bounds, shape (c,)."""
        p, change, root = 6 * len(self.recording.T_robot_camera), said.mean, said.root
        if inputs is None or not self.fits_inputs:
            return change
        low, high = (bound - inputs for bound in input_bounds(self.robot, self.recording))
        if (change[p:] >= low).all() and (change[p:] <= high).all():
            return change
        own = np.flatnonzero(np.diag(self.prior) > 0.0)
        information = np.linalg.cholesky(np.linalg.inv(root[own] @ root[own].T)).T
        free = np.full(len(own) - len(inputs), np.inf)
        box = (np.append(-free, low - 1e-12), np.append(free, high + 1e-12))
        change = change.copy()
        change[own] = lsq_linear(information, information @ change[own], bounds=box).x
        return change


@dataclass(frozen=True, eq=False, slots=True)
class _Posterior:
    """The posterior of the parameters."""

    mean: FloatArray
    """shape (c,)."""
    root: FloatArray
    """Square root of their covariance, shape (c, q)."""


def _worth(values: FloatArray, apart: FloatArray) -> float:
    """Return the largest weight w ≤ 1 of information with eigenvalues λ relative to a unit prior for which Σ a² wλ/(1 + wλ) is at most its
    expectation."""

    def excess(log: float) -> float:
        known = np.exp(log) * values
        return float((apart**2 * known / (1.0 + known)).sum()) - len(apart)

    return 1.0 if excess(0.0) <= 0.0 else float(np.exp(brentq(excess, np.log(1e-12), 0.0)))


# --- the noise of a camera -----------------------------------------------------------------------------------------------


def measured_noises(robot: Robot, recording: Recording, calibration: Calibration) -> tuple[CameraNoise, ...]:
    """Return the noise of each camera: as declared, or estimated from the scatter of contact-free clouds about their smooth part.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        calibration: calibration with the poses.
    """
    declared = [camera.noise if camera is not None else None for camera in recording.cameras]
    if not recording.has_clouds or all(noise is not None for noise in declared):
        return tuple(noise or USUAL for noise in declared)
    initial = calibrated_inputs(robot, recording, calibration) if recording.actuation_zero == "unknown" else None
    unit, size = (CameraNoise("stereo", at_1m=1.0),) * len(declared), float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    driven, triangles = DrivenRobot(robot, drive_of(robot, recording, initial=initial)), body_surface(robot.body.mesh).triangles
    spread = [np.zeros(0)]
    for k, state in free_path(driven, free_clouds(recording)):
        try:
            scan = read_scan(robot, recording, k, calibration.poses, state.positions)
        except FemsenseError:
            continue
        if scan is not None:
            rows = ray_rows(scan, Surface(state.positions, triangles), calibration.poses, unit, reach=REACH * size)
            spread += [_smooth_rest(rows)] if len(rows.residual) else []
    every = np.concatenate(spread)
    found = CameraNoise("stereo", at_1m=1.483 * float(np.median(np.abs(every)))) if len(every) >= 100 else USUAL
    return tuple(noise or found for noise in declared)


def _smooth_rest(rows: RayRows) -> FloatArray:
    """Return whitened residuals minus the mean of their neighbours."""
    cell = np.ptp(rows.points, axis=0).max() / 30.0 + 1e-12
    z = rows.residual / rows.std
    _, group = np.unique(np.floor(rows.points / cell).astype(np.int64), axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    mean = np.bincount(group, z) / count
    many = count[group] >= 5
    scale = np.sqrt(count / np.maximum(count - 1.0, 1.0))
    return np.asarray(((z - mean[group]) * scale[group])[many])
