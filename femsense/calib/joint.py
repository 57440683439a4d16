"""The joint Gauss-Newton fit of poses and initial inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.calib.declared_poses import DECLARED_STD
from femsense.calib.inputs import input_bounds
from femsense.calib.marker_fit import MarkerFit, root_mean_square
from femsense.calib.other_law import with_other_law
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.least_squares import covariance_of, gauss_newton
from femsense.core.pose import move_pose
from femsense.fem.equilibrium import Equilibrium
from femsense.model.observation import Hypothesis, Scene, SceneJet, evaluate_scene
from femsense.model.path_solver import PathSolver, look_at
from femsense.model.recording import state_key
from femsense.model.robot import Robot

MAX_REWEIGHTINGS = 10
"""Fits until the outliers are set aside; without any it takes two."""
NOISE_FLOOR = 1e-7
"""No camera measures better than this [m]."""
PLACEMENT_STD_FLOOR = 1e-4
"""Markers are not glued better than this [m]."""


def fit_joint(
    robot: Robot,
    scene: Scene,
    poses: list[FloatArray],
    initial: FloatArray | None,
    history: list[float],
    *,
    solver: PathSolver | None = None,
) -> MarkerFit:
    """Fit poses and initial inputs together; the weights of noise and outliers are re-estimated from the residual until they converge.

    Declared poses stay fixed. States are solved with the `solver`.
    """
    problem = _Problem(robot, scene, poses, initial, solver=solver)
    low, high = problem.bounds()
    theta, huber = problem.start(), np.ones(len(scene.points))
    for again in range(MAX_REWEIGHTINGS):
        fit = gauss_newton(problem.evaluate, theta, low=low, high=high)
        theta = fit.theta
        jet = problem.jet_at(theta, derivative=True)
        history.append(root_mean_square(jet.residual))
        before, huber = huber, _huber_weights(jet.residual)
        if again and np.abs(huber - before).max() < 0.1:
            break
        problem.weigh(jet, huber, len(theta))
    moved, inputs = problem.place(theta)
    fit = replace(fit, covariance=problem.beside_declared(jet, fit.covariance))
    # an input at its bound is no better determined than others: their common error moves all of them
    return MarkerFit(robot, scene, fit, tuple(moved), inputs, jet)


def moved_by_law(fit: MarkerFit) -> FloatArray:
    """Return the change of a fit under the neo-Hookean law, shape (p,); 0 if the robot declares its constitutive law.

    One Gauss–Newton step from the solution, −C Jᵀ Δr, with the change Δr of the whitened residual and C = (JᵀJ)⁻¹.
    """
    other, nothing, jet = with_other_law(fit.robot), np.zeros(len(fit.result.theta)), fit.jet
    if other is None or not np.isfinite(fit.result.covariance).all():
        return nothing
    there = _Problem(other, fit.scene, list(fit.poses), fit.initial, solver=PathSolver(look_at))
    there.starts = dict(jet.states)
    there.weigh(jet, _huber_weights(jet.residual), len(fit.result.theta))
    row = (there.weights / there.std)[:, None, None]
    J = there._jacobian(jet, row)
    try:
        changed = there.jet_at(there.start(), derivative=False)
    except DataError:
        return nothing
    by_law = np.concatenate([(row[:, :, 0] * (changed.residual - jet.residual)).ravel(), np.zeros(jet.rest.size)])
    return np.asarray(-covariance_of(J) @ (J.T @ by_law))


class _Problem:
    """Whitened residuals of markers and rest placements over moves of the free poses and the initial inputs."""

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        poses: list[FloatArray],
        initial: FloatArray | None,
        *,
        solver: PathSolver | None,
    ) -> None:
        self.plain, self.scene, self.solver = Hypothesis(robot), scene, solver
        self.base_poses, self.initial = list(poses), initial
        self.pivot = robot.marker_points.mean(axis=0)
        self.moving = [v for v, T in enumerate(scene.recording.T_robot_camera) if T is None]
        self.declared = [v for v, T in enumerate(scene.recording.T_robot_camera) if T is not None]
        self.free_inputs = 0 if initial is None else len(initial)
        self.repeats = _repeats(scene)
        self.weights, self.std, self.placement_std = self.repeats, 5e-4, PLACEMENT_STD_FLOOR
        self.starts: dict[int, Equilibrium] = {}
        self.jet: SceneJet | None = None

    def start(self) -> FloatArray:
        inputs = np.zeros(0) if self.initial is None else self.initial
        return np.concatenate([np.zeros(6 * len(self.moving)), inputs])

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        robot, recording = self.plain.robot, self.scene.recording
        low, high = input_bounds(robot, recording) if self.free_inputs else (np.zeros(0), np.zeros(0))
        free = np.full(6 * len(self.moving), np.inf)
        return np.concatenate([-free, low]), np.concatenate([free, high])

    def place(self, theta: FloatArray) -> tuple[list[FloatArray], FloatArray | None]:
        """Return poses and initial inputs at a point."""
        moved = list(self.base_poses)
        for i, v in enumerate(self.moving):
            moved[v] = move_pose(self.base_poses[v], theta[6 * i : 6 * i + 6], pivot_a=self.pivot)
        return moved, theta[6 * len(self.moving) :] if self.free_inputs else self.initial

    def jet_at(self, theta: FloatArray, *, derivative: bool) -> SceneJet:
        moved, inputs = self.place(theta)
        known = None if self.free_inputs or self.jet is None else self.jet.states  # a pose does not move the body
        self.jet = evaluate_scene(
            self.plain,
            self.scene,
            np.zeros(0),
            moved,
            inputs,
            derivative=derivative,
            vary_initial=bool(self.free_inputs),
            pivot=self.pivot,
            starts=self.starts,
            known=known,
            solver=self.solver,
        )
        return self.jet

    def evaluate(self, theta: FloatArray, derivative: bool) -> tuple[FloatArray, FloatArray | None]:
        jet = self.jet_at(theta, derivative=derivative)
        row = (self.weights / self.std)[:, None]
        residual = np.concatenate([(row * jet.residual).ravel(), jet.rest.ravel() / self.placement_std])
        return residual, self._jacobian(jet, row[:, :, None]) if derivative else None

    def _jacobian(self, jet: SceneJet, row: FloatArray) -> FloatArray:
        a = self.free_inputs
        by_inputs = np.vstack([(row * jet.by_initial).reshape(jet.residual.size, a), np.zeros((jet.rest.size, a))])
        return np.hstack([self._by_poses(jet, row, self.moving), by_inputs])

    def _by_poses(self, jet: SceneJet, row: FloatArray, views: list[int]) -> FloatArray:
        columns = [c for v in views for c in range(6 * v, 6 * v + 6)]
        return np.vstack(
            [
                (row * jet.by_pose[:, :, columns]).reshape(jet.residual.size, len(columns)),
                jet.rest_by_pose[:, :, columns].reshape(jet.rest.size, len(columns)) / self.placement_std,
            ]
        )

    def beside_declared(self, jet: SceneJet, covariance: FloatArray) -> FloatArray:
        """Return the covariance of the free parameters with the prior σ = `DECLARED_STD` on declared poses: the block of the inverse of
        all normal equations."""
        if not self.declared or not self.free_inputs or not np.isfinite(covariance).all():
            return covariance
        row = (self.weights / self.std)[:, None, None]
        own, other = self._jacobian(jet, row), self._by_poses(jet, row, self.declared)
        moved = np.linalg.lstsq(own, other, rcond=None)[0]
        left = other - own @ moved
        normal = left.T @ left + np.diag(np.tile(DECLARED_STD**-2.0, len(self.declared)))
        return np.asarray(covariance + moved @ np.linalg.solve(normal, moved.T))

    def weigh(self, jet: SceneJet, huber: FloatArray, parameters: int) -> None:
        """Take weights and noise from a residual; an outlier counts as the largest residual that is none."""
        self.weights = self.repeats * huber
        winsorised = jet.residual * (self.repeats * huber**2)[:, None]
        self.std = _noise_std(winsorised, float(3 * (self.repeats**2).sum()), parameters)
        if len(jet.rest):
            self.placement_std = max(PLACEMENT_STD_FLOOR, float(np.sqrt((jet.rest**2).mean())))


def _repeats(scene: Scene) -> FloatArray:
    """Return square-root weights by which frames under the same inputs and loads count once together, shape (k,).

    Such frames repeat the same error of the model; taking them for independent would make every standard deviation too small.
    """
    keys = [state_key(scene.recording, int(f)) for f in scene.frame]
    count: dict[tuple[bytes, int], int] = {}
    for key, marker in zip(keys, scene.marker):
        count[key, int(marker)] = count.get((key, int(marker)), 0) + 1
    return np.array([count[key, int(marker)] ** -0.5 for key, marker in zip(keys, scene.marker)])


def _huber_weights(residual: FloatArray) -> FloatArray:
    """Return square-root weights of Huber's loss for 3-D residuals, scaled by their median."""
    distance = np.linalg.norm(residual, axis=1)
    if len(distance) < 8:
        return np.ones(len(distance))
    scale = max(float(np.median(distance)) / 1.538, 1e-12)  # median of a chi distribution with 3 degrees
    return np.asarray(np.sqrt(np.minimum(1.0, 3.5 * scale / np.maximum(distance, 1e-300))))


def _noise_std(weighted: FloatArray, rows: float, parameters: int) -> float:
    freedom = max(rows - parameters, 1.0)
    return max(float(np.sqrt((weighted**2).sum() / freedom)), NOISE_FLOOR)
