"""The true body and its inputs: another mesh and law than the estimator's; gain, zero, backlash and creep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.model.effects import apply_effects
from femsense.model.remeshing import body_on_mesh, finer_mesh
from femsense.model.robot import Robot
from femsense.rig.plan import Plan
from femsense.rig.script import TruthTable


def true_robot(robot: Robot, table: TruthTable, effects: Sequence[Mapping[str, Any]]) -> Robot:
    """Return the true robot.

    Arguments:
        robot: the declared robot.
        table: mesh and law of the truth.
        effects: entries as in `[[effects]]`, applied to the truth only.

    Raises:
        InputError: an effect does not fit.
    """
    mesh = finer_mesh(robot.body.mesh, table.element, table.refinements)
    body = robot.body if mesh is robot.body.mesh else body_on_mesh(robot.body, mesh)
    limit = np.inf if table.stretch_limit is None else table.stretch_limit
    body = body.with_material(replace(body.material, law=table.law, stretch_limit=limit))
    moved = replace(robot.with_body(body).with_marker_points(robot.marker_points), features=np.zeros(0, np.int64))
    for i, entry in enumerate(effects):
        try:
            moved = apply_effects(moved, [entry])
        except InputError as error:
            raise InputError(
                error.what, where=f"effects[{i}]: {error.where}", found=error.found, expected=error.expected, hint=error.hint
            ) from None
    return moved


# The inputs


def true_inputs(robot: Robot, plan: Plan) -> FloatArray:
    """Return the true inputs of each frame [N] or [m], shape (F, a): with gain, zero, slack and creep of the truth."""
    act = robot.actuation
    inputs = act.gain * motor_inputs(plan)
    if act.coupling is not None:
        inputs = inputs @ (np.eye(inputs.shape[1]) + act.coupling).T
    if plan.control == "displacement":
        return np.asarray(inputs + act.displacement_offset - act.slack)
    pulled = np.where(inputs + act.tension_offset > 0, inputs + act.tension_offset, 0.0)
    return creep_matrix(plan.time_s, robot.creep) @ pulled


def motor_inputs(plan: Plan) -> FloatArray:
    """Return the motor inputs for the plan [N] or [m], shape (F, a): with the motors' scale and backlash.

    With a backlash of width w a cable moves only when its motor is at one end of it: y_k = min(max(y_{k−1}, u_k − w/2),
    u_k + w/2), starting at the initial motor position.
    """
    told = plan.commanded + plan.initial
    scaled = told if plan.motor_scale is None else told * plan.motor_scale
    if not plan.backlash:
        return np.asarray(scaled)
    half, done = 0.5 * plan.backlash, scaled.copy()
    for k in range(1, len(done)):
        done[k] = np.clip(done[k - 1], scaled[k] - half, scaled[k] + half)
    return np.asarray(np.maximum(done, 0.0) if plan.control == "tension" else done)


def creep_matrix(time_s: FloatArray, terms: Sequence[tuple[float, float]]) -> FloatArray:
    """Return C, shape (F, F), with crept = C @ values.

    The convolution of J(t) = 1 + Σ f (1 − exp(−t/τ)) with the rate of values that are linear from frame to frame; values
    before the first frame are fully crept. Each row is summed from the closed form of each piece.
    """
    F = len(time_s)
    rate = np.zeros((F, F))
    rate[:, 0] = 1.0 + sum(fraction for fraction, _ in terms)
    for k in range(1, F):
        dt = time_s[k] - time_s[k - 1]
        since, until = time_s[k:] - time_s[k - 1], time_s[k:] - time_s[k]
        rate[k:, k] = 1.0
        for fraction, tau in terms:
            rate[k:, k] += fraction * (1.0 - tau / dt * (np.exp(-until / tau) - np.exp(-since / tau)))
    change = np.eye(F) - np.eye(F, k=-1)
    return np.asarray(rate @ change)
