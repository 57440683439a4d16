"""Effects between the motor and the body: friction, offset, scale, stretch and play of the cables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.model.effects.base import Alias, Calibrated, Effect, Entry, Experiment, Parameter, number, per_cable
from femsense.model.effects.material import STIFFNESS
from femsense.model.robot import Robot

USUAL_FRICTION = 0.15
"""Coefficient of a hand-laid cable in a soft channel."""
USUAL_OFFSET = 0.05
"""Usual offset of a cable as a share of its range."""
OFFSET_STD = 0.1
"""How well the offset of a cable is known beforehand, as a share of its range in the recording …"""
PLANNED_OFFSET_STD = 0.25
"""… and of its range in an experiment that is planned."""
GAINS = float(np.log(0.3)), float(np.log(3.0))
"""Logarithms of the smallest and the largest scale of an input."""
WEIGHT_TELLS = (
    "hang a known weight on the robot in some frames (loads.csv): a modulus answers to it, a gain of all cables does not"
)
"""How a common scale of all cables is distinguished from the modulus."""


def _has_bends(robot: Robot) -> bool:
    return any(len(c.path) > 1 or c.exit_direction is not None for c in robot.body.cables)


def _rubbing(robot: Robot, control: str) -> list[str]:
    """Return the cables whose friction moves the body: the bend at the exit matters only if the motor tension is given."""
    return [
        c.name
        for c in robot.body.cables
        if len(c.path) > 1 or (c.exit_direction is not None and (control == "tension" or np.isfinite(c.stretch_stiffness)))
    ]


def _friction_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (
        (Parameter("coefficient", None, "1", 0.0, 0.0, 1.5, 2e-5, plausible=USUAL_FRICTION),) if _rubbing(robot, control) else ()
    )


def _friction_parameters_each(robot: Robot, control: str) -> tuple[Parameter, ...]:
    names = _rubbing(robot, control)
    return (
        tuple(Parameter("coefficient", name, "1", 0.0, 0.0, 1.5, 2e-5, plausible=USUAL_FRICTION) for name in names)
        if len(names) > 1
        else ()
    )


def _apply_friction(robot: Robot, entry: Entry) -> Robot:
    values = per_cable(entry, "coefficient", "cable_friction", robot, 0.0)
    if (values < 0).any():
        raise InputError(
            "a coefficient of friction is not negative",
            where="cable_friction.coefficient",
            found=float(values.min()),
            expected="≥ 0",
        )
    if (values > 0).any() and not _has_bends(robot):
        raise InputError(
            "no cable of this robot bends",
            where="cable_friction",
            hint="give [[cables]] an exit_direction, or inner points of the path",
        )
    cables = tuple(replace(c, friction=float(v)) for c, v in zip(robot.body.cables, values))
    return robot.with_body(robot.body.with_cables(cables))


def _offset_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    names = robot.body.cable_names
    if control == "tension":
        return tuple(
            Parameter("tension_n", name, "N", 0.0, -20.0, 20.0, 1e-3, plausible=USUAL_OFFSET, of_range=True) for name in names
        )
    return tuple(
        Parameter("displacement_m", name, "m", 0.0, -0.05, 0.05, 1e-5, plausible=USUAL_OFFSET, of_range=True) for name in names
    )


def _apply_offset(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    tension = act.tension_offset + per_cable(entry, "tension_n", "cable_offset", robot, 0.0)
    displacement = act.displacement_offset + per_cable(entry, "displacement_m", "cable_offset", robot, 0.0)
    return replace(robot, actuation=replace(act, tension_offset=freeze(tension), displacement_offset=freeze(displacement)))


def _gain_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return tuple(Parameter("scale", name, "1", 0.0, *GAINS, 1e-5, "log", plausible=0.05) for name in robot.body.cable_names)


def _apply_gain(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    return replace(robot, actuation=replace(act, gain=freeze(act.gain * per_cable(entry, "scale", "cable_gain", robot, 1.0))))


def _stretch_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if control != "displacement" or not robot.body.cables:
        return ()
    return (Parameter("stiffness_n_m", None, "N/m", 0.0, 0.0, 1e-2, 1e-6, "reciprocal", plausible=5e-5),)


def _apply_stretch(robot: Robot, entry: Entry) -> Robot:
    if entry.get("stiffness_n_m") == float("inf"):
        return robot
    values: FloatArray = per_cable(entry, "stiffness_n_m", "cable_stretch", robot, float("nan"))
    if not (values > 0).all():
        raise InputError(
            "a stiffness is positive", where="cable_stretch.stiffness_n_m", found=float(values.min()), expected="> 0 N/m"
        )
    cables = tuple(replace(c, stretch_stiffness=float(v)) for c, v in zip(robot.body.cables, values))
    return robot.with_body(robot.body.with_cables(cables))


def _slack_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if control != "displacement":
        return ()
    return tuple(Parameter("displacement_m", name, "m", 0.0, 0.0, 0.02, 1e-5, plausible=5e-4) for name in robot.body.cable_names)


def _apply_slack(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    return replace(
        robot, actuation=replace(act, slack=freeze(act.slack + per_cable(entry, "displacement_m", "cable_slack", robot, 0.0)))
    )


def _one_gain(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("scale", None, "1", 0.0, *GAINS, 1e-3, "log", plausible=0.05),) if robot.body.cables else ()


def _apply_one_gain(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    return replace(robot, actuation=replace(act, gain=act.gain * number(entry, "scale", "cable_gain", low=1e-3)))


def _gains_planned(robot: Robot) -> tuple[tuple[str, Effect], ...]:
    alike = (("all alike", ONE_GAIN),) if len(robot.body.cables) > 1 else ()
    return (("", CABLE_GAIN), *alike)


CABLE_FRICTION = Effect(
    "cable_friction",
    "loss where a cable bends or rubs; depends on the direction of motion",
    _friction_parameters,
    _apply_friction,
    keys=("coefficient",),
    path_dependent=True,
    told_by=Experiment.LOAD_UNLOAD_AND_HOLD,
    may_differ=True,
)
CABLE_FRICTIONS = replace(CABLE_FRICTION, parameters=_friction_parameters_each)
CABLE_OFFSET = Effect(
    "cable_offset",
    "a wrong zero of tension or displacement",
    _offset_parameters,
    _apply_offset,
    keys=("tension_n", "displacement_m"),
    calibrated=Calibrated(OFFSET_STD, PLANNED_OFFSET_STD, of_inputs=True),
    told_by=Experiment.KNOWN_WEIGHT,
    drives=True,
    may_differ=True,
)
CABLE_GAIN: Effect = Effect(
    "cable_gain",
    "a wrong scale of the tension or displacement",
    _gain_parameters,
    _apply_gain,
    keys=("scale",),
    aliases=(Alias(STIFFNESS.name, common=True, told_by=WEIGHT_TELLS),),
    told_by=Experiment.KNOWN_WEIGHT,
    planned=_gains_planned,
    drives=True,
    may_differ=True,
)
ONE_GAIN: Effect = Effect("cable_gain", "", _one_gain, _apply_one_gain)
"""The scales of all cables wrong by the same factor, which no per-cable difference gives away."""
CABLE_STRETCH = Effect(
    "cable_stretch",
    "a cable that is a spring",
    _stretch_parameters,
    _apply_stretch,
    keys=("stiffness_n_m",),
    told_by=Experiment.KNOWN_WEIGHT,
    may_differ=True,
)
CABLE_SLACK = Effect(
    "cable_slack",
    "play before a cable pulls",
    _slack_parameters,
    _apply_slack,
    keys=("displacement_m",),
    aliases=(Alias(CABLE_OFFSET.name),),
    told_by=Experiment.LOAD_UNLOAD_AND_HOLD,
    may_differ=True,
)
