"""Initial inputs of the cables: where to start, their bounds, and their standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@dataclass(frozen=True, eq=False, slots=True)
class InputTables:
    """Initial inputs with their standard deviations, by cable."""

    tension: dict[str, float]
    """[N]."""
    displacement: dict[str, float]
    """[m]."""
    tension_std: dict[str, float | None]
    """[N]; None if the data do not determine it."""
    displacement_std: dict[str, float | None]
    """[m]."""


def input_tables(robot: Robot, recording: Recording, initial: FloatArray | None, covariance: FloatArray) -> InputTables:
    """Return the initial inputs as tables.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        initial: [N] or [m], shape (a,); None where they are known.
        covariance: covariance of `initial`, shape (a, a); empty if they are known.
    """
    state = initial_state(robot, recording, initial)
    own, other = _input_std(robot, recording, state, covariance)
    tension, displacement = (own, other) if recording.actuation == "tension" else (other, own)
    shortening = _initial_displacement(state, recording, robot.body.cable_names, initial)
    return InputTables(dict(state.tension), shortening, tension, displacement)


def initial_state(robot: Robot, recording: Recording, initial: FloatArray | None) -> Equilibrium:
    """Return the equilibrium under the initial inputs if these are unknown, else under those of the first frame."""
    if initial is not None:
        recording = replace(recording, inputs=np.zeros_like(recording.inputs), pressures=np.zeros_like(recording.pressures))
    return solve_frame(DrivenRobot(robot, drive_of(robot, recording, initial=initial)), 0)


def first_inputs(robot: Robot, recording: Recording) -> FloatArray | None:
    """Return the initial guess of the initial inputs [N] or [m], shape (a,): the smallest without negative tensions; None if they are
    known."""
    if recording.actuation_zero == "absolute":
        return None
    lowest = recording.inputs.min(axis=0) if recording.inputs.size else np.zeros(len(robot.body.cables))
    return np.maximum(0.0, -lowest) if recording.actuation == "tension" else np.zeros(len(robot.body.cables))


def most_different(rows: FloatArray, count: int) -> list[int]:
    """Return indices of some rows, shape (n, k): first the largest, then each time the one farthest from those chosen before."""
    chosen = [int(np.abs(rows).sum(axis=1).argmax())]
    while len(chosen) < min(count, len(rows)):
        distance = np.linalg.norm(rows[:, None] - rows[chosen], axis=2).min(axis=1)
        distance[chosen] = -1.0
        chosen.append(int(distance.argmax()))
    return chosen


def calibrated_inputs(robot: Robot, recording: Recording, calibration: Calibration) -> FloatArray:
    """Return the initial inputs of a calibration in the recording's unit [N] or [m], shape (a,)."""
    table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
    return np.array([table[name] for name in robot.body.cable_names])


def largest_input(robot: Robot, actuation: str) -> float:
    """Return the size of an input that would crush the body: a tenth of E × reach² [N], or of its reach [m]."""
    body = robot.body
    return 0.1 * body.reach * (float(np.median(body.material.young_modulus)) * body.reach if actuation == "tension" else 1.0)


def input_bounds(robot: Robot, recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the initial inputs such that initial + recorded input stays within the limits of each cable in every frame.

    If the recorded tensions of a cable span more than its limits (`check_against` warns of it), its bound is max_tension_n.
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


def weak_inputs(recording: Recording, std: dict[str, float | None]) -> str:
    """Return a text that lists the cables whose initial input is poorly determined, with standard deviations; empty if there are none."""
    scale, unit = (0.25, "N") if recording.actuation == "tension" else (0.005, "m")
    weak = [f"{n} (± {'∞' if v is None else format(v, '.2g')} {unit})" for n, v in std.items() if v is None or v > scale]
    return ", ".join(weak)
