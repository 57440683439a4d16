"""Where a cable truly runs: its path moved across the body, or about the body's axis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import rotation_from_vector
from femsense.model.effects.axes import across_axis, along_axis, axis_of
from femsense.model.effects.base import Alias, Effect, Entry, Experiment, Parameter, per_cable, vector
from femsense.model.effects.cables import CABLE_GAIN
from femsense.model.robot import Robot

NAME = "cable_path"
FARTHEST, USUAL_WAY = 0.2, 0.01
"""Largest and usual distance of a path from where it is declared, in shares of the body's reach."""
SCALES = float(np.log(0.3)), float(np.log(2.0))
"""Logarithms of the smallest and the largest distance from the axis, against the declared one."""
NEAR_AXIS = 0.02
"""A cable that is nearer to the axis than this share of the reach has no angle about it."""
LARGEST_TURN, USUAL_TURN = 0.6, 0.03
"""Largest and usual angle by which a path is turned about the body's axis [rad]."""


def _parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """Two numbers a cable, its distance from the body's axis and its angle about it; three where a cable runs along that axis."""
    names = robot.body.cable_names
    if names and _way_from_axis(robot) > NEAR_AXIS * robot.body.reach:
        turns = (
            (
                Parameter("radius_scale", name, "1", 0.0, *SCALES, 1e-4, "log", plausible=0.05),
                Parameter("angle_rad", name, "rad", 0.0, -LARGEST_TURN, LARGEST_TURN, 1e-4, plausible=USUAL_TURN),
            )
            for name in names
        )
        return tuple(p for pair in turns for p in pair)
    reach = robot.body.reach
    far, usual = FARTHEST * reach, USUAL_WAY * reach
    parts = [(name, i) for name in names for i in range(3)]
    return tuple(Parameter("offset_m", part, "m", 0.0, -far, far, 1e-4 * reach, plausible=usual) for part in parts)


def _way_from_axis(robot: Robot) -> float:
    """Return how far from the body's axis that cable runs which is nearest to it [m]."""
    axis, nodes = axis_of(robot.body), robot.body.mesh.nodes
    return min(float(np.linalg.norm(_from_axis(axis, c.path.positions(nodes)), axis=1).max()) for c in robot.body.cables)


def _from_axis(axis: FloatArray, points: FloatArray) -> FloatArray:
    direction = across_axis(axis)[0]
    return np.asarray(points - axis[0] - along_axis(axis, points)[:, None] * direction)


def _apply(robot: Robot, entry: Entry) -> Robot:
    body, nodes = robot.body, robot.body.mesh.nodes
    if not {"offset_m", "radius_scale", "angle_rad"} & set(entry):
        raise InputError("the paths of the cables are not declared", where=NAME, expected="offset_m, radius_scale or angle_rad")
    scales, angles = (per_cable(entry, key, NAME, robot, default) for key, default in (("radius_scale", 1.0), ("angle_rad", 0.0)))
    offsets, axis = _offsets(entry, body.cable_names), axis_of(body)
    places = {}
    for cable, scale, angle in zip(body.cables, scales, angles):
        points = cable.path.positions(nodes)
        moved = points + offsets[cable.name]
        if scale != 1.0 or angle != 0.0:
            arm = _from_axis(axis, points)
            turned = scale * arm @ rotation_from_vector(angle * across_axis(axis)[0]).T
            moved = moved + turned - arm
        if not np.array_equal(moved, points):
            places[cable.name] = moved
    return robot.with_body(body.with_cable_places(places))


def _offsets(entry: Entry, names: tuple[str, ...]) -> dict[str, FloatArray]:
    """Return `offset_m` of each cable [m], (3,): a table name → [x, y, z], or one for all. Raises InputError."""
    value = entry.get("offset_m", {})
    if not isinstance(value, Mapping):
        value = dict.fromkeys(names, value)
    unknown = sorted(set(value) - set(names))
    if unknown:
        raise InputError("unknown cable", where=f"{NAME}.offset_m", found=unknown[0], expected=", ".join(names))
    return {n: vector({"offset_m": value.get(n, [0.0, 0.0, 0.0])}, "offset_m", f"{NAME}.{n}") for n in names}


CABLE_PATH = Effect(
    NAME,
    "where a cable truly runs",
    _parameters,
    _apply,
    keys=("offset_m", "radius_scale", "angle_rad"),
    aliases=(Alias(CABLE_GAIN.name, common=True),),
    told_by=Experiment.MORE_MARKERS,
    may_differ=True,
    sought_by_recording=False,
)
