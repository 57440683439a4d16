"""Effects of the clamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.errors import InputError
from femsense.model.effects.base import Effect, Entry, Experiment, Parameter, number
from femsense.model.robot import Robot

KEYS = ("stiffness_n_m", "rotation_stiffness_nm_rad")
SOFTEST = 150.0
"""Largest compliance of a clamp, relative to a cube of the material with the size of the body's reach. Clamps in which soft bodies move
by tens of millimetres reach a third of it; with 50 they were excluded as implausible."""
USUAL_SPRING, USUAL_PLATE = 0.01, 0.02
"""Plausible compliance of a clamp, of its springs and of its plate, as a share of the largest that is tried."""


def _spring_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """The coordinate is the compliance of a node's spring [m/N], which is 0 for the clamp."""
    count = len(robot.body.clamp_nodes)
    if not count:
        return ()
    compliance = count / (float(robot.body.material.young_modulus.mean()) * robot.body.reach)
    softest = SOFTEST * compliance
    usual = USUAL_SPRING * softest
    return (Parameter(KEYS[0], None, "N/m", 0.0, 0.0, softest, 1e-6 * compliance, "reciprocal", plausible=usual),)


def _plate_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """The coordinate is the compliance of the plate [rad/(N m)], which is 0 for the clamp."""
    nodes = robot.body.mesh.nodes[robot.body.clamp_nodes]
    if len(nodes) < 3:
        return ()
    width = float(
        np.sort(np.ptp(nodes, axis=0))[-2]
    )  # of the clamped face; a bar of that width bends by reach/(E w⁴/12) a moment
    bending = 12.0 * robot.body.reach / (float(robot.body.material.young_modulus.mean()) * max(width, 1e-3) ** 4)
    softest = 2.0 * bending
    usual = USUAL_PLATE * softest
    return (Parameter(KEYS[1], None, "N m/rad", 0.0, 0.0, softest, 1e-6 * bending, "reciprocal", plausible=usual),)


def _apply_clamp(robot: Robot, entry: Entry) -> Robot:
    if not any(key in entry for key in KEYS):
        raise InputError("neither spring is given", where="base_compliance", expected=" or ".join(KEYS))
    if not len(robot.body.clamp_nodes):
        raise InputError("nothing of this body is clamped", where="base_compliance", expected="[[fixed]]")
    spring, plate = (
        float("inf") if entry.get(key, np.inf) == float("inf") else number(entry, key, "base_compliance", low=1e-9)
        for key in KEYS
    )
    return robot.with_body(robot.body.with_clamp_stiffness(spring, turn=plate))


BASE_COMPLIANCE: Effect = Effect(
    "base_compliance",
    "a clamp that gives",
    _spring_parameters,
    _apply_clamp,
    keys=KEYS,
    told_by=Experiment.MORE_MARKERS,
    planned=lambda robot: (("", BASE_COMPLIANCE), ("plate", BASE_ROTATION)),
)
BASE_ROTATION: Effect = replace(BASE_COMPLIANCE, parameters=_plate_parameters, planned=None)
"""The same effect with the other key: the loop tries both."""
