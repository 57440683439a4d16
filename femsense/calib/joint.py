"""The joint Gauss-Newton fit of poses and initial inputs."""

from __future__ import annotations

import numpy as np

from femsense.calib.inputs import input_bounds
from femsense.core.arrays import FloatArray
from femsense.core.least_squares import FitResult, covariance_of, gauss_newton
from femsense.core.pose import move_pose
from femsense.fem.equilibrium import Equilibrium
from femsense.model.observation import Hypothesis, Scene, SceneJet, evaluate_scene
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
    free_inputs: bool = True,
) -> tuple[FitResult, list[FloatArray], FloatArray | None, SceneJet]:
    """Finish over poses and initial inputs together; the noise is estimated from the residual, twice.

    Poses that the recording declares stay as they are.
    """
    plain, empty = Hypothesis(robot), np.zeros(0)
    pivot = robot.marker_points.mean(axis=0)
    moving = [v for v, T in enumerate(scene.recording.T_robot_camera) if T is None]
    a = len(initial) if initial is not None and free_inputs else 0
    base_poses, sigma = list(poses), 5e-4
    placement_std = PLACEMENT_STD_FLOOR
    repeats = _repeats(scene)
    weights = repeats
    jet: SceneJet | None = None
    starts: dict[int, Equilibrium] = {}

    def place(theta: FloatArray) -> tuple[list[FloatArray], FloatArray | None]:
        moved = list(base_poses)
        for i, v in enumerate(moving):
            moved[v] = move_pose(base_poses[v], theta[6 * i : 6 * i + 6], pivot_a=pivot)
        return moved, theta[6 * len(moving) :] if a else initial

    def evaluate(theta: FloatArray, derivative: bool) -> tuple[FloatArray, FloatArray | None]:
        nonlocal jet
        moved, inputs = place(theta)
        known = None if a or jet is None else jet.states  # a pose does not move the body
        jet = evaluate_scene(
            plain,
            scene,
            empty,
            moved,
            inputs,
            derivative=derivative,
            vary_initial=bool(a),
            pivot=pivot,
            starts=starts,
            known=known,
        )
        row = (weights / sigma)[:, None]
        residual = np.concatenate([(row * jet.residual).ravel(), jet.rest.ravel() / placement_std])
        if not derivative:
            return residual, None
        columns = [c for v in moving for c in range(6 * v, 6 * v + 6)]
        J_pose = np.vstack(
            [
                (row[:, :, None] * jet.by_pose[:, :, columns]).reshape(jet.residual.size, len(columns)),
                jet.rest_by_pose[:, :, columns].reshape(jet.rest.size, len(columns)) / placement_std,
            ]
        )
        J_in = np.vstack([(row[:, :, None] * jet.by_initial).reshape(jet.residual.size, a), np.zeros((jet.rest.size, a))])
        return residual, np.hstack([J_pose, J_in])

    low, high = input_bounds(robot, scene.recording) if a else (np.zeros(0), np.zeros(0))
    free = np.full(6 * len(moving), np.inf)
    bounds = np.concatenate([-free, low]), np.concatenate([free, high])
    theta = np.concatenate([np.zeros(6 * len(moving)), initial if a and initial is not None else np.zeros(0)])
    huber = np.ones(len(scene.points))
    for again in range(MAX_REWEIGHTINGS):
        fit = gauss_newton(evaluate, theta, low=bounds[0], high=bounds[1])
        theta = fit.theta
        evaluate(theta, True)
        assert jet is not None
        history.append(root_mean_square(jet.residual))
        before, huber = huber, _huber_weights(jet.residual)
        if again and np.abs(huber - before).max() < 0.1:
            break
        weights = repeats * huber
        winsorised = jet.residual * (repeats * huber**2)[:, None]  # an outlier counts as the largest residual that is none
        sigma = _spread(winsorised, float(3 * (repeats**2).sum()), len(theta))
        placement_std = max(PLACEMENT_STD_FLOOR, float(np.sqrt((jet.rest**2).mean()))) if len(jet.rest) else placement_std
    assert jet is not None
    moved, inputs = place(theta)
    fit = _with_bound_inputs(fit, theta, bounds)
    return fit, moved, inputs, jet


def _with_bound_inputs(fit: FitResult, theta: FloatArray, bounds: tuple[FloatArray, FloatArray]) -> FitResult:
    """A parameter at its bound stays there: it takes no part in the covariance of the others."""
    at = (theta <= bounds[0]) | (theta >= bounds[1])
    if not at.any():
        return fit
    covariance = np.zeros_like(fit.covariance)
    covariance[np.ix_(~at, ~at)] = covariance_of(fit.jacobian[:, ~at])
    own = np.linalg.norm(fit.jacobian[:, at], axis=0)
    covariance[at, at] = np.where(own > 0, 1.0 / np.where(own > 0, own, 1.0) ** 2, np.inf)
    return FitResult(fit.theta, covariance, fit.residual, fit.jacobian, fit.cost, fit.status)


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


def _spread(weighted: FloatArray, rows: float, parameters: int) -> float:
    freedom = max(rows - parameters, 1.0)
    return max(float(np.sqrt((weighted**2).sum() / freedom)), NOISE_FLOOR)


def root_mean_square(residual: FloatArray) -> float:
    """Return the root mean square length of rows (k, c)."""
    return float(np.sqrt((residual**2).sum(axis=1).mean()))
