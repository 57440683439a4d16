"""Effects of weight: a wrong density and an undeclared mass. Both rotate with gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import embed_points
from femsense.model.effects.base import Alias, Effect, Entry, Experiment, Parameter, number, vector
from femsense.model.effects.loads import PAYLOAD, place_polish, places_nearby
from femsense.model.robot import Robot, spread_features

DENSITIES = float(np.log(0.4)), float(np.log(2.5))
"""Logarithms of the smallest and the largest density against the declared one: a foam cast too dense,
a silicone with a metal filler."""
WEIGHED = 0.1
"""A body is weighed, or its data sheet right, to about this share."""
PLACES = 6
"""Places of a mass that are tried first."""
HEAVIEST = 5.0
"""Largest mass that is tried, in masses of the body."""
USUAL_SHARE = 0.1
"""Mass of a connector or a marker ball, in masses of the body."""


def _density_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("scale", None, "1", 0.0, *DENSITIES, 1e-4, "log", plausible=WEIGHED),) if robot.body.mass > 0 else ()


def _apply_density(robot: Robot, entry: Entry) -> Robot:
    scale, material = number(entry, "scale", "density", low=1e-2, high=1e2), robot.body.material
    return robot.with_body(robot.body.with_material(replace(material, density=scale * material.density)))


def _density_cost(declared: Robot, fitted: FloatArray) -> float:
    """Return −2 log of how likely it is that a declared density is off by a factor: a Student's t with four degrees."""
    return float(5.0 * np.log1p((fitted[0] / WEIGHED) ** 2 / 4.0))


def _mass_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    mass = robot.body.mass
    if mass <= 0:
        return ()
    return (Parameter("mass_kg", None, "kg", 0.0, 0.0, HEAVIEST * mass, 1e-3 * mass, plausible=USUAL_SHARE * mass),)


def _mass_places(robot: Robot) -> tuple[Entry, ...]:
    """Places that are spread over the free surface, the one farthest from the clamp first."""
    places = robot.body.mesh.nodes[spread_features(robot.body, PLACES)]
    return tuple({"point_m": [float(v) for v in place]} for place in places)


def _apply_mass(robot: Robot, entry: Entry) -> Robot:
    point, mass = vector(entry, "point_m", "tip_mass"), number(entry, "mass_kg", "tip_mass", low=0.0)
    body = robot.body
    count = len(body.mesh.nodes)
    own = mass * embed_points(body.mesh, point[None]).matrix(count).toarray()[0]
    return robot.with_body(body.with_carried_mass(own if body.carried_mass is None else body.carried_mass + own))


DENSITY = Effect(
    "density",
    "the right weight",
    _density_parameters,
    _apply_density,
    keys=("scale",),
    told_by=Experiment.KNOWN_WEIGHT,
    prior_cost=_density_cost,
)
TIP_MASS = Effect(
    "tip_mass",
    "an undeclared mass, with a weight along gravity",
    _mass_parameters,
    _apply_mass,
    _mass_places,
    keys=("point_m", "mass_kg"),
    polish=place_polish,
    nearby=places_nearby,
    aliases=(
        Alias(PAYLOAD.name, common=True, told_by="turn the base: the weight of a mass turns with gravity, a payload stays"),
    ),
    told_by=Experiment.TURN_THE_BASE,
)
