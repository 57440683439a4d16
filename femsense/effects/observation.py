"""Effects between the body and the measured points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from femsense.effects.effect import Effect, Entry, Parameter, number, vector
from femsense.errors import InputError
from femsense.model import Robot


def _depth_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (
        Parameter("scale", None, "1", 0.0, float(np.log(0.9)), float(np.log(1.1)), 1e-6, "log"),
        Parameter("offset_m", None, "m", 0.0, -0.03, 0.03, 1e-5),
    )


def _apply_depth(robot: Robot, entry: Entry) -> Robot:
    scale = number(entry, "scale", "depth_scale", low=0.5, high=2.0, default=1.0)
    offset = number(entry, "offset_m", "depth_scale", low=-1.0, high=1.0, default=0.0)
    seen = robot.observation
    return replace(
        robot, observation=replace(seen, depth_scale=seen.depth_scale * scale, depth_offset=seen.depth_offset * scale + offset)
    )


def _marker_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return tuple(Parameter("offset_m", (name, i), "m", 0.0, -0.02, 0.02, 1e-6) for name in robot.marker_names for i in range(3))


def _apply_marker(robot: Robot, entry: Entry) -> Robot:
    table = entry.get("offset_m", {})
    if not isinstance(table, Mapping):
        raise InputError("not a table", where="marker_offset.offset_m", found=table, expected="marker → [x, y, z]")
    points = robot.marker_points.copy()
    for key, value in table.items():
        if key not in robot.marker_names:
            raise InputError("unknown marker", where="marker_offset.offset_m", found=key, expected=", ".join(robot.marker_names))
        points[robot.marker_names.index(str(key))] += vector({"offset_m": value}, "offset_m", f"marker_offset.{key}")
    return robot.with_marker_points(points)


DEPTH_SCALE = Effect(
    "depth_scale", "a camera whose distances are off", _depth_parameters, _apply_depth, keys=("scale", "offset_m")
)
MARKER_OFFSET = Effect(
    "marker_offset", "markers that sit elsewhere than declared", _marker_parameters, _apply_marker, keys=("offset_m",)
)
