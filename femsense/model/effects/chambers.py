"""Effects between the regulator and the chambers: pressures with a wrong zero or a wrong scale."""

from __future__ import annotations

from dataclasses import replace

from femsense.core.arrays import freeze
from femsense.fem.body_parts import Chamber
from femsense.model.effects.base import Alias, Effect, Entry, Experiment, Parameter, per_name
from femsense.model.effects.cables import GAINS, WEIGHT_TELLS
from femsense.model.effects.material import STIFFNESS
from femsense.model.robot import Robot

OFTEN = 50e3
"""Largest pressure of a soft chamber that declares none [Pa]."""
FARTHEST, USUAL_ZERO = 0.25, 0.01
"""Largest and usual zero of a pressure sensor, as shares of the chamber's largest pressure:
0.25 to 2 % of full scale in data sheets."""


def _largest(chamber: Chamber) -> float:
    return min(chamber.max_pressure, OFTEN)


def _offset_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    tops = {chamber.name: _largest(chamber) for chamber in robot.body.chambers}
    return tuple(
        Parameter("pressure_pa", name, "Pa", 0.0, -FARTHEST * p, FARTHEST * p, 1e-4 * p, plausible=USUAL_ZERO * p)
        for name, p in tops.items()
    )


def _apply_offset(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    offset = act.pressure_offset + per_name(entry, "pressure_pa", "chamber_offset", robot.body.chamber_names, 0.0, kind="chamber")
    return replace(robot, actuation=replace(act, pressure_offset=freeze(offset)))


def _gain_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return tuple(Parameter("scale", name, "1", 0.0, *GAINS, 1e-5, "log", plausible=0.05) for name in robot.body.chamber_names)


def _apply_gain(robot: Robot, entry: Entry) -> Robot:
    act = robot.actuation
    gain = act.pressure_gain * per_name(entry, "scale", "chamber_gain", robot.body.chamber_names, 1.0, kind="chamber")
    return replace(robot, actuation=replace(act, pressure_gain=freeze(gain)))


CHAMBER_OFFSET = Effect(
    "chamber_offset",
    "pressures with a wrong zero",
    _offset_parameters,
    _apply_offset,
    keys=("pressure_pa",),
    told_by=Experiment.KNOWN_WEIGHT,
    may_differ=True,
)
CHAMBER_GAIN = Effect(
    "chamber_gain",
    "pressures with a wrong scale",
    _gain_parameters,
    _apply_gain,
    keys=("scale",),
    aliases=(Alias(STIFFNESS.name, common=True, told_by=WEIGHT_TELLS.replace("cables", "chambers")),),
    told_by=Experiment.KNOWN_WEIGHT,
    may_differ=True,
)
