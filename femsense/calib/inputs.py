"""Initial inputs of the cables: where to start, their bounds, and their standard deviations."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.model.recording import Recording
from femsense.model.robot import Robot


def first_inputs(robot: Robot, recording: Recording) -> FloatArray | None:
    """Return initial inputs to start from [N] or [m], shape (a,): the smallest that leave no cable pushing; None where they are known."""
    if recording.actuation_zero == "absolute":
        return None
    lowest = recording.inputs.min(axis=0) if recording.inputs.size else np.zeros(len(robot.body.cables))
    return np.maximum(0.0, -lowest) if recording.actuation == "tension" else np.zeros(len(robot.body.cables))


def _largest_input(robot: Robot, actuation: str) -> float:
    """Return the size of an input that would crush the body: a tenth of E × reach² [N], or of its reach [m]."""
    body = robot.body
    return 0.1 * body.reach * (float(np.median(body.material.young_modulus)) * body.reach if actuation == "tension" else 1.0)


def input_bounds(robot: Robot, recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the initial inputs, so that no frame leaves the limits of its cable: initial + recorded stays within them.

    A cable whose recorded tensions alone span more than its limits (`check_against` warns of it) keeps max_tension_n as its bound.
    """
    cables = robot.body.cables
    if recording.actuation == "displacement":
        reach = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
        return np.full(len(cables), -reach), np.full(len(cables), reach)
    order = [recording.cable_names.index(c.name) for c in cables]
    recorded = recording.inputs[:, order] if recording.inputs.size else np.zeros((1, len(cables)))
    low = np.array([max(c.min_tension, 0.0) for c in cables]) - np.minimum(recorded.min(axis=0), 0.0)
    limit = np.array([c.max_tension for c in cables])
    high = limit - np.maximum(recorded.max(axis=0), 0.0)
    return low, np.maximum(np.where(high > low, high, limit), low + 1e-9)


def _initial_displacement(
    state: Equilibrium, recording: Recording, names: tuple[str, ...], initial: FloatArray | None
) -> dict[str, float]:
    if recording.actuation == "displacement" and initial is not None:
        return {name: float(v) for name, v in zip(names, initial)}
    return dict(state.shortening)


def _input_std(
    robot: Robot, recording: Recording, state: Equilibrium, covariance: FloatArray
) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Return the standard deviations of the fitted inputs and of the others (tension ↔ shortening, through W_aa)."""
    from femsense.fem.compliance import compliance

    names = robot.body.cable_names
    if not covariance.size:
        return {n: 0.0 for n in names}, {n: 0.0 for n in names}
    W = compliance(robot.body, state)[: len(names), : len(names)]
    J = W if recording.actuation == "tension" else np.linalg.pinv(W)
    finite = np.isfinite(np.diag(covariance)).all()
    derived = np.sqrt(np.maximum(np.diag(J @ covariance @ J.T), 0.0)) if finite else np.full(len(names), np.inf)
    own = np.sqrt(np.diag(covariance))

    def table(values: FloatArray) -> dict[str, float | None]:
        return {n: float(v) if np.isfinite(v) else None for n, v in zip(names, values)}

    return table(own), table(derived)
