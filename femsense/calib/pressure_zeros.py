"""Pressures that count from an unknown zero: found beside poses and initial inputs, from markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.marker_fit import MarkerFit
from femsense.core.arrays import FloatArray, freeze
from femsense.model.as_it_is import evaluate_robot
from femsense.model.recording import Recording
from femsense.model.robot import Robot

ROUNDS = 8
"""Rounds at most; three or four take the step below SETTLED."""
SETTLED = 1e-4
"""The zeros are found that change by less than this share of the recorded range."""
DIFFERENCE = 1e-3
"""Share of the recorded range by which a derivative is taken."""
WEAK = 0.25
"""A zero is hardly determined whose standard deviation is above this share of the recorded range."""
FARTHEST = 0.5
"""One step goes no farther than this share of the recorded range."""

Fit = Callable[[Robot], MarkerFit]
"""Fits poses and initial inputs of a robot."""


@dataclass(frozen=True, eq=False, slots=True)
class PressureZeros:
    """Initial pressures, which are added to the recorded ones."""

    pressure: dict[str, float]
    """Initial pressure of each chamber [Pa]."""
    std: dict[str, float | None]
    """[Pa]; None where the data say nothing."""


def has_unknown_zeros(robot: Robot, recording: Recording) -> bool:
    """Return whether the recorded pressures of a robot have an unknown zero."""
    return recording.actuation_zero == "unknown" and bool(robot.body.chambers)


def with_initial_pressures(robot: Robot, pressure: dict[str, float]) -> Robot:
    """Return the robot whose recorded pressures count from initial ones [Pa], by chamber; others from zero."""
    act = robot.actuation
    added = np.array([pressure.get(name, 0.0) for name in robot.body.chamber_names])
    return replace(robot, actuation=replace(act, pressure_offset=freeze(act.pressure_offset + added)))


def find_pressure_zeros(robot: Robot, recording: Recording, fit: Fit) -> PressureZeros:
    """Fit the initial pressures of all chambers by Gauss–Newton steps; poses and initial inputs are re-fitted in each step.

    Arguments:
        robot: the robot.
        recording: in the robot's order.
        fit: fits what else is unknown.

    Raises:
        DataError: `fit` raises it.
    """
    names = robot.body.chamber_names
    scale = np.maximum(np.ptp(recording.pressures, axis=0), 1.0)
    zeros = np.zeros(len(names))
    for _ in range(ROUNDS):
        at = with_initial_pressures(robot, dict(zip(names, zeros)))
        step, covariance = _step(fit(at), scale)
        step = np.clip(step, -FARTHEST, FARTHEST) * scale
        zeros += step
        if (np.abs(step) < SETTLED * scale).all():
            break
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale
    known = np.isfinite(std)
    return PressureZeros(dict(zip(names, zeros.tolist())), {n: float(s) if ok else None for n, s, ok in zip(names, std, known)})


def weak_zeros(recording: Recording, zeros: PressureZeros) -> str:
    """Return a text that lists the chambers whose initial pressure is poorly determined, with standard deviations; empty if there are none."""
    ranges = dict(zip(recording.chamber_names, np.ptp(recording.pressures, axis=0)))
    weak = [(name, std) for name, std in zeros.std.items() if std is None or std > WEAK * ranges[name]]
    return ", ".join(f"{name} (± {'∞' if std is None else format(std, '.2g')} Pa)" for name, std in weak)


def _step(fit: MarkerFit, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the step of the zeros and their covariance, in units of `scale`; shapes (c,), (c, c)."""
    robot, scene, jet = fit.robot, fit.scene, fit.jet
    moving = [c for v, T in enumerate(scene.recording.T_robot_camera) if T is None for c in range(6 * v, 6 * v + 6)]
    rows = jet.residual.size
    columns = [jet.by_pose[:, :, moving].reshape(rows, len(moving)), jet.by_initial.reshape(rows, -1)]
    for j, name in enumerate(robot.body.chamber_names):
        near = with_initial_pressures(robot, {name: DIFFERENCE * float(scale[j])})
        there = evaluate_robot(near, scene, fit.poses, fit.initial, dict(jet.states))
        columns.append(((there.residual - jet.residual) / DIFFERENCE).reshape(rows, 1))
    J, c = np.hstack(columns), len(scale)
    unit = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    J = J / unit
    change = -np.linalg.lstsq(J, jet.residual.ravel(), rcond=1e-8)[0] / unit
    noise = float((jet.residual**2).sum()) / max(rows - J.shape[1], 1)
    values, vectors = np.linalg.eigh(J.T @ J)
    inverse = np.where(values > 1e-12, 1.0 / np.maximum(values, 1e-12), np.inf)
    spread = (vectors[-c:] ** 2) @ np.where(np.isfinite(inverse), inverse, 1e12)
    return change[-c:], np.diag(noise * spread / unit[-c:] ** 2)
