"""Effects between the body and the measured points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from femsense.core.arrays import freeze
from femsense.core.errors import InputError
from femsense.model.effects.base import Effect, Entry, Experiment, Parameter, number, vector
from femsense.model.robot import Robot

NEAR_CLAMP = 0.25
"""A marker outside the body may be on the clamp if it is closer to it than this fraction of the body's reach."""


def _depth_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (
        Parameter("scale", None, "1", 0.0, float(np.log(0.9)), float(np.log(1.1)), 1e-6, "log", plausible=0.01),
        Parameter("offset_m", None, "m", 0.0, -0.03, 0.03, 1e-5, plausible=2e-3),
    )


def _apply_depth(robot: Robot, entry: Entry) -> Robot:
    scale = number(entry, "scale", "depth_scale", low=0.5, high=2.0, default=1.0)
    offset = number(entry, "offset_m", "depth_scale", low=-1.0, high=1.0, default=0.0)
    seen = robot.observation
    return replace(
        robot, observation=replace(seen, depth_scale=seen.depth_scale * scale, depth_offset=seen.depth_offset * scale + offset)
    )


def _marker_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    parts = [(name, i) for name in robot.glued_names for i in range(3)]
    return tuple(Parameter("offset_m", part, "m", 0.0, -0.02, 0.02, 1e-6, plausible=5e-4) for part in parts)


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


def _share_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("share", None, "1", 1.0, -0.3, 1.3, 1e-3, plausible=1.0),) if _beside_the_clamp(robot) else ()


def _markers_by_the_clamp(robot: Robot) -> tuple[Entry, ...]:
    """Return the sets of markers outside the body near its clamp: all of them, and each alone."""
    names = _beside_the_clamp(robot)
    alone = tuple({"markers": [name]} for name in names)
    return ({"markers": names}, *alone) if len(names) > 1 else alone or ({},)


def _beside_the_clamp(robot: Robot) -> list[str]:
    held = robot.body.mesh.nodes[robot.body.clamped]
    if not len(held) or not len(robot.marker_points):
        return []
    beside = robot.markers.outside > 1e-3 * robot.body.reach
    way = np.linalg.norm(robot.marker_points[:, None] - held[None], axis=2).min(axis=1)
    return [name for name, is_near in zip(robot.marker_names, beside & (way < NEAR_CLAMP * robot.body.reach)) if is_near]


def _apply_share(robot: Robot, entry: Entry) -> Robot:
    share = number(entry, "share", "clamped_marker", low=-1.0, high=2.0, default=0.0)
    names = entry.get("markers")
    if not isinstance(names, list) or not names:
        raise InputError("no markers are named", where="clamped_marker.markers", found=names, expected="a list of markers")
    shares = np.ones(len(robot.marker_names)) if robot.marker_share is None else robot.marker_share.copy()
    for name in names:
        if name not in robot.marker_names:
            raise InputError("unknown marker", where="clamped_marker.markers", found=name, expected=", ".join(robot.marker_names))
        shares[robot.marker_names.index(name)] *= share
    return replace(robot, marker_share=freeze(shares)).with_marker_points(robot.marker_points)


DEPTH_SCALE = Effect(
    "depth_scale",
    "a camera whose distances are off",
    _depth_parameters,
    _apply_depth,
    keys=("scale", "offset_m"),
    told_by=Experiment.MOVE_THE_CAMERA,
    moves_rest=True,
    may_differ=True,
)
MARKER_OFFSET = Effect(
    "marker_offset",
    "markers that sit elsewhere than declared",
    _marker_parameters,
    _apply_marker,
    keys=("offset_m",),
    told_by=Experiment.MOVE_THE_CAMERA,
    places_markers=True,
    may_differ=True,
    sought_by_recording=False,
)
CLAMPED_MARKER = Effect(
    "clamped_marker",
    "markers that sit on the clamp, not on the body",
    _share_parameters,
    _apply_share,
    _markers_by_the_clamp,
    keys=("markers", "share"),
)
