"""Effects that load the body: its own weight, and a payload that was not declared."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import embed_points, surface_triangles
from femsense.model.effects.base import Effect, Entry, Experiment, KnownLength, Parameter, vector
from femsense.model.robot import Robot, spread_features, spread_points

STANDARD_GRAVITY = 9.80665
"""[m/s²]."""
SIZE = KnownLength(STANDARD_GRAVITY, 0.1)
"""Size of gravity on an unknown site [m/s²]."""
LIFTED = 0.5
"""Cosine to the vertical beyond which a force lifts: an undeclared load is a weight, or a hose that pulls sideways."""
MOUNTED = np.radians(5.0)
"""A base is mounted as it is declared to about this angle, and a declared gravity is believed as much [rad]."""


def _gravity_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if robot.body.material.density <= 0:
        return ()
    now = robot.body.gravity
    return tuple(Parameter("vector_m_s2", i, "m/s²", float(now[i]), -12.0, 12.0, 0.05, length=SIZE) for i in range(3))


def _apply_gravity(robot: Robot, entry: Entry) -> Robot:
    return robot.with_body(robot.body.with_gravity(vector(entry, "vector_m_s2", "gravity")))


def _tilt_cost(declared: Robot, fitted: FloatArray) -> float:
    """Return −2 log of how likely it is that a declared gravity is off by the angle of the fitted one:
    a Student's t with four degrees."""
    own = declared.body.gravity
    if not np.any(own):
        return 0.0
    angle = np.arctan2(np.linalg.norm(np.cross(own, fitted)), own @ fitted)
    return float(5.0 * np.log1p((angle / MOUNTED) ** 2 / 4.0))


def _weight_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if robot.body.material.density <= 0:
        return ()
    usual = 1.0 if np.any(robot.body.gravity) else STANDARD_GRAVITY / float(np.sqrt(3.0))
    return tuple(Parameter("vector_m_s2", i, "m/s²", 0.0, -12.0, 12.0, 0.05, plausible=usual) for i in range(3))


def _apply_weight(robot: Robot, entry: Entry) -> Robot:
    body = robot.body
    more = body.with_gravity(vector(entry, "vector_m_s2", "gravity")).weight()
    return robot.with_body(body.with_dead_forces(body.dead_forces + more))


def _payload_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return tuple(Parameter("force_n", i, "N", 0.0, -20.0, 20.0, 1e-3, plausible=0.05) for i in range(3))


def _does_not_lift(declared: Robot, fitted: FloatArray) -> bool:
    """Return whether a load is none that pulls upwards."""
    down, force = declared.body.gravity, fitted[:3]
    return bool(down @ force >= -LIFTED * np.linalg.norm(down) * np.linalg.norm(force))


def _payload_places(robot: Robot) -> tuple[Entry, ...]:
    """Places that are spread over the free surface."""
    places = robot.body.mesh.nodes[spread_features(robot.body, 10)]
    return tuple({"point_m": [float(v) for v in place]} for place in places)


NEARBY = ((0.3, 10), (0.1, 8), (0.04, 6))
"""How far around a place others are tried, in shares of the body's reach, and how many of each."""
LATTICE = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4.0
"""Points of a triangle (barycentric) that may be such a place."""


def places_nearby(robot: Robot, seed: Entry) -> tuple[Entry, ...]:
    """Places of the surface around one, far and near, not only at nodes: the force that is found goes with its lever."""
    body, center = robot.body, np.asarray(seed["point_m"])
    triangles = surface_triangles(body.mesh)
    free = triangles[~np.isin(triangles, body.clamped).all(axis=1)]
    surface = (LATTICE @ body.mesh.nodes[free]).reshape(-1, 3)
    distance = np.linalg.norm(surface - center, axis=1)
    places = [dict(seed)]
    for share, count in NEARBY:
        near = surface[distance <= share * body.reach]
        first = int(np.linalg.norm(near - center, axis=1).argmin()) if len(near) else 0
        places += [{"point_m": [float(v) for v in near[i]]} for i in spread_points(near, count, first=first)]
    return tuple(places)


PLACED = 0.05
"""How well a place is known beforehand, in shares of the body's reach: a force acts the same all along its line."""


def place_polish(robot: Robot, control: str, seed: Entry) -> tuple[Parameter, ...]:
    """Return the parameters by which the place of a load is refined from a seed [m]."""
    reach = robot.body.reach
    return tuple(
        Parameter(
            "point_m", i, "m", float(v), float(v) - 0.25 * reach, float(v) + 0.25 * reach, 2e-5 * reach, known=PLACED * reach
        )
        for i, v in enumerate(seed["point_m"])
    )


def _apply_payload(robot: Robot, entry: Entry) -> Robot:
    point, force = vector(entry, "point_m", "payload"), vector(entry, "force_n", "payload")
    mesh = robot.body.mesh
    forces = embed_points(mesh, point[None]).spread(force[None], len(mesh.nodes))
    return robot.with_body(robot.body.with_dead_forces(robot.body.dead_forces + forces))


GRAVITY = Effect(
    "gravity",
    "its own weight, or weight in another direction",
    _gravity_parameters,
    _apply_gravity,
    keys=("vector_m_s2",),
    told_by=Experiment.TURN_THE_BASE,
    planned=lambda robot: (("", WEIGHT),),
    expected=lambda robot: not np.any(robot.body.gravity),
    prior_cost=_tilt_cost,
)
WEIGHT: Effect = Effect("gravity", "", _weight_parameters, _apply_weight, turns_with_base=True)
"""A change of gravity as a dead force, which acts where frames say their own gravity too; it turns with the base."""
PAYLOAD = Effect(
    "payload",
    "a load that was not declared",
    _payload_parameters,
    _apply_payload,
    _payload_places,
    keys=("point_m", "force_n"),
    polish=place_polish,
    nearby=places_nearby,
    told_by=Experiment.TURN_THE_BASE,
    plausible=_does_not_lift,
)
