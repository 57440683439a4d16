"""Effects between the motor and the body: friction, zero, scale, stretch and play of the cables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.model.effects.base import Effect, Entry, Parameter, per_cable
from femsense.model.robot import Robot


def _has_bends(robot: Robot) -> bool:
    return any(len(c.path) > 1 or c.exit_direction is not None for c in robot.body.cables)


def _rubbing(robot: Robot, control: str) -> list[str]:
    """Return the cables whose friction moves the body: a bend where it leaves matters only if its tension at the motor does."""
    return [
        c.name
        for c in robot.body.cables
        if len(c.path) > 1 or (c.exit_direction is not None and (control == "tension" or np.isfinite(c.stretch_stiffness)))
    ]


def _friction_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("coefficient", None, "1", 0.0, 0.0, 1.5, 2e-5),) if _rubbing(robot, control) else ()


def _friction_parameters_each(robot: Robot, control: str) -> tuple[Parameter, ...]:
    names = _rubbing(robot, control)
    return tuple(Parameter("coefficient", name, "1", 0.0, 0.0, 1.5, 2e-5) for name in names) if len(names) > 1 else ()


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
        return tuple(Parameter("tension_n", name, "N", 0.0, -20.0, 20.0, 1e-3) for name in names)
    return tuple(Parameter("displacement_m", name, "m", 0.0, -0.05, 0.05, 1e-5) for name in names)


def _apply_offset(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    tension = act.tension_offset + per_cable(entry, "tension_n", "cable_offset", robot, 0.0)
    displacement = act.displacement_offset + per_cable(entry, "displacement_m", "cable_offset", robot, 0.0)
    return replace(robot, actuation=replace(act, tension_offset=freeze(tension), displacement_offset=freeze(displacement)))


def _gain_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return tuple(
        Parameter("scale", name, "1", 0.0, float(np.log(0.3)), float(np.log(3.0)), 1e-5, "log") for name in robot.body.cable_names
    )


def _apply_gain(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    return replace(robot, actuation=replace(act, gain=freeze(act.gain * per_cable(entry, "scale", "cable_gain", robot, 1.0))))


def _stretch_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if control != "displacement" or not robot.body.cables:
        return ()
    return (Parameter("stiffness_n_m", None, "N/m", 0.0, 0.0, 1e-2, 1e-6, "reciprocal"),)


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
    return tuple(Parameter("displacement_m", name, "m", 0.0, 0.0, 0.02, 1e-5) for name in robot.body.cable_names)


def _apply_slack(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    return replace(
        robot, actuation=replace(act, slack=freeze(act.slack + per_cable(entry, "displacement_m", "cable_slack", robot, 0.0)))
    )


CABLE_FRICTION = Effect(
    "cable_friction",
    "loss where a cable bends or rubs; depends on the direction of motion",
    _friction_parameters,
    _apply_friction,
    keys=("coefficient",),
    history=True,
)
CABLE_FRICTIONS = Effect(
    "cable_friction",
    "loss where a cable bends or rubs; depends on the direction of motion",
    _friction_parameters_each,
    _apply_friction,
    keys=("coefficient",),
    history=True,
)
CABLE_OFFSET = Effect(
    "cable_offset",
    "a wrong zero of tension or displacement",
    _offset_parameters,
    _apply_offset,
    keys=("tension_n", "displacement_m"),
)
CABLE_GAIN = Effect("cable_gain", "a wrong scale of the tension or displacement", _gain_parameters, _apply_gain, keys=("scale",))
CABLE_STRETCH = Effect("cable_stretch", "a cable that is a spring", _stretch_parameters, _apply_stretch, keys=("stiffness_n_m",))
CABLE_SLACK = Effect("cable_slack", "play before a cable pulls", _slack_parameters, _apply_slack, keys=("displacement_m",))
