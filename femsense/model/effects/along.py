"""Effects along the body: a modulus that changes from one end to the other, and a body that is curved at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.model.effects.axes import across_axis, along_axis, axis_from, axis_of
from femsense.model.effects.base import Effect, Entry, Experiment, Parameter, number
from femsense.model.robot import Robot

STEEPEST, USUAL_STEEPNESS = float(np.log(6.0)), 0.2
"""Largest and usual change of the modulus from end to end, in its logarithm."""
SHARPEST, USUAL_BEND = 1.0, 0.03
"""Largest and usual angle between the ends of a body that is curved at rest [rad]."""
STRAIGHT = 1e-9
"""Curvatures times lengths below this are none [rad]."""


def _whole_axis(robot: Robot) -> tuple[Entry, ...]:
    return ({"axis_m": axis_of(robot.body).tolist()},)


def _length(robot: Robot) -> float:
    axis = axis_of(robot.body)
    return float(np.linalg.norm(axis[1] - axis[0]))


def _gradient_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    steep = 1.0 / _length(robot)
    high, usual = STEEPEST * steep, USUAL_STEEPNESS * steep
    return (Parameter("per_m", None, "1/m", 0.0, -high, high, 1e-5 * steep, plausible=usual),)


def _apply_gradient(robot: Robot, entry: Entry) -> Robot:
    axis, mesh = axis_from(entry, "stiffness_gradient"), robot.body.mesh
    steepness = number(entry, "per_m", "stiffness_gradient", low=-1e4, high=1e4)
    places = np.clip(along_axis(axis, mesh.nodes[mesh.tets[:, :4]].mean(axis=1)), 0.0, np.linalg.norm(axis[1] - axis[0]))
    return robot.with_body(robot.body.with_stiffness_scale(np.exp(steepness * places)))


def _curvature_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    sharp = 1.0 / _length(robot)
    high, usual = SHARPEST * sharp, USUAL_BEND * sharp
    return tuple(Parameter("curvature_1_m", i, "1/m", 0.0, -high, high, 2e-7 * sharp, plausible=usual) for i in range(2))


def _apply_curvature(robot: Robot, entry: Entry) -> Robot:
    axis = axis_from(entry, "rest_shape")
    value = np.asarray(entry.get("curvature_1_m", []), dtype=object)
    if value.shape != (2,) or not all(isinstance(v, int | float) and np.isfinite(v) for v in value):
        found = entry.get("curvature_1_m")
        raise InputError("not two numbers", where="rest_shape.curvature_1_m", found=found, expected="two curvatures in 1/m")
    nodes = robot.body.mesh.nodes
    bent = curved(nodes, axis, value.astype(float))
    if np.array_equal(bent, nodes):
        return robot
    points = robot.marker_points + robot.markers.moves(bent - nodes)
    return replace(robot, body=robot.body.with_rest_nodes(bent), marker_points=freeze(points))


def curved(points: FloatArray, axis: FloatArray, curvature: FloatArray) -> FloatArray:
    """Return where points go when an axis becomes an arc and sections across it stay plane and of their shape.

    Arguments:
        points: [m], shape (p, 3); those before the axis' first point stay.
        axis: its first and its last point [m], shape (2, 3); beyond the last it goes on straight.
        curvature: towards each of the two directions of `across_axis` [1/m], shape (2,).
    """
    along, first, second = across_axis(axis)
    length, size = float(np.linalg.norm(axis[1] - axis[0])), float(np.linalg.norm(curvature))
    if size * length < STRAIGHT:
        return points
    inwards = (curvature[0] * first + curvature[1] * second) / size
    place = along_axis(axis, points)
    arc, beyond = np.clip(place, 0.0, length), np.maximum(place - length, 0.0)
    angle = size * arc
    across = points - axis[0] - place[:, None] * along
    height = across @ inwards
    sine, cosine = np.sin(angle), np.cos(angle)
    ahead = sine / size + beyond * cosine - height * sine + np.minimum(place, 0.0)
    aside = (1.0 - cosine) / size + beyond * sine + height * (cosine - 1.0)
    return np.asarray(axis[0] + across + ahead[:, None] * along + aside[:, None] * inwards)


STIFFNESS_GRADIENT = Effect(
    "stiffness_gradient",
    "a modulus that changes along the body",
    _gradient_parameters,
    _apply_gradient,
    _whole_axis,
    keys=("axis_m", "per_m"),
    told_by=Experiment.MORE_MARKERS,
)
REST_SHAPE = Effect(
    "rest_shape",
    "a body that is curved at rest",
    _curvature_parameters,
    _apply_curvature,
    _whole_axis,
    keys=("axis_m", "curvature_1_m"),
    told_by=Experiment.TURN_THE_BASE,
    moves_rest=True,
)
