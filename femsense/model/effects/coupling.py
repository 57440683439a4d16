"""One motor that moves another's cable: a shared spool, a routing that pulls along, cross-talk of load cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import freeze
from femsense.core.errors import InputError
from femsense.model.effects.base import Alias, Effect, Entry, Experiment, Parameter, number
from femsense.model.effects.cables import CABLE_GAIN
from femsense.model.robot import Robot

NAME = "cable_coupling"
LARGEST, USUAL = 1.0, 0.05
"""Largest and usual share of a cable's input that goes to another."""


def _parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("share", None, "1", 0.0, -LARGEST, LARGEST, 1e-4, plausible=USUAL),) if len(robot.body.cables) > 1 else ()


def _pairs(robot: Robot) -> tuple[Entry, ...]:
    names = robot.body.cable_names
    return tuple({"from": a, "to": b} for a in names for b in names if a != b)


def _apply(robot: Robot, entry: Entry) -> Robot:
    names, act = robot.body.cable_names, robot.actuation
    for key in ("from", "to"):
        if entry.get(key) not in names:
            raise InputError("unknown cable", where=f"{NAME}.{key}", found=entry.get(key), expected=", ".join(names))
    if entry["from"] == entry["to"]:
        hint = "cable_gain scales a cable's own input"
        raise InputError("a cable is coupled with itself", where=NAME, found=entry["to"], expected="two cables", hint=hint)
    coupling = np.zeros((len(names), len(names))) if act.coupling is None else act.coupling.copy()
    coupling[names.index(entry["to"]), names.index(entry["from"])] += number(entry, "share", NAME, low=-10.0, high=10.0)
    return replace(robot, actuation=replace(act, coupling=freeze(coupling)))


CABLE_COUPLING = Effect(
    NAME,
    "one motor that moves another's cable",
    _parameters,
    _apply,
    _pairs,
    keys=("from", "to", "share"),
    aliases=(Alias(CABLE_GAIN.name, common=True),),
    told_by=Experiment.MORE_MARKERS,
    drives=True,
    may_differ=True,
    sought_by_recording=False,
)
