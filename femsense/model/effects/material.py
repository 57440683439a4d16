"""Effects of the material: its modulus, Poisson ratio, a softer part, another law, slow flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, diagonal, freeze
from femsense.core.errors import InputError
from femsense.fem.mesh import element_volumes
from femsense.model.effects.base import Calibrated, Effect, Entry, Experiment, Parameter, no_parameters, number, vector
from femsense.model.robot import Robot, spread_features

MODULUS_STD = 0.5
"""Prior standard deviation of the logarithm of the modulus: a soft region in a stiff body and a stiff one in a soft body have nearly the
same effect."""


def _stiffness_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("scale", None, "1", 0.0, float(np.log(0.1)), float(np.log(10.0)), 1e-5, "log", plausible=0.2),)


def _apply_stiffness(robot: Robot, entry: Entry) -> Robot:
    return robot.with_body(robot.body.with_stiffness_scale(number(entry, "scale", "stiffness", low=1e-3, high=1e3)))


def _poisson_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    declared = float(np.median(robot.body.material.poisson_ratio))
    return (Parameter("poisson_ratio", None, "1", declared, 0.05, 0.4995, 1e-6, plausible=0.03),)


def _apply_poisson(robot: Robot, entry: Entry) -> Robot:
    nu = number(entry, "poisson_ratio", "poisson", low=-0.99, high=0.4999)
    material = robot.body.material
    return robot.with_body(
        robot.body.with_material(replace(material, poisson_ratio=freeze(np.full_like(material.poisson_ratio, nu))))
    )


def _region_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("scale", None, "1", 0.0, float(np.log(0.1)), float(np.log(5.0)), 1e-5, "log", plausible=0.4),)


RADII = 0.12, 0.25
"""Radii of the spheres that are tried first, in shares of the body's diagonal."""


def _region_places(robot: Robot) -> tuple[Entry, ...]:
    """Spheres around places that are spread over the surface, and around the middles of the body's parts;
    those that hold the centroid of an element."""
    mesh = robot.body.mesh
    size = diagonal(mesh.nodes)
    centroids = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    places = [*mesh.nodes[spread_features(robot.body, 8)], *_middles(centroids, np.abs(element_volumes(mesh)), 3)]
    spheres = [(p, r * size) for p in places for r in RADII]
    return tuple(
        {"center_m": [float(v) for v in p], "radius_m": r}
        for p, r in spheres
        if (np.linalg.norm(centroids - p, axis=1) <= r).any()
    )


def _middles(points: FloatArray, weights: FloatArray, halvings: int) -> list[FloatArray]:
    """Return the centres of parts of some points (p, 3) that are halved across their longest axis again and again."""
    middle = np.average(points, axis=0, weights=weights)
    if halvings == 0 or len(points) < 2:
        return [middle]
    along = (points - middle) @ np.linalg.eigh(np.cov(points.T, aweights=weights))[1][:, -1]
    order = np.argsort(along)
    median = along[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())]]
    half = along > median + 1e-6 * np.ptp(along)
    if not half.any() or half.all():
        return [middle]
    return [m for part in (~half, half) for m in _middles(points[part], weights[part], halvings - 1)]


def _regions_nearby(robot: Robot, seed: Entry) -> tuple[Entry, ...]:
    """Spheres of several sizes around this point and neighbouring ones; of spheres with the same elements only the first."""
    mesh, center, radius = robot.body.mesh, np.asarray(seed["center_m"]), float(seed["radius_m"])
    centroids = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    moves = np.vstack([np.zeros((1, 3)), *(h * radius * np.vstack([np.eye(3), -np.eye(3)]) for h in (0.35, 0.8))])
    distinct: dict[bytes, Entry] = {}
    for place in center + moves:
        distance = np.linalg.norm(centroids - place, axis=1)
        for factor in (1.0, 0.8, 1.25, 0.6):
            inside = distance <= factor * radius
            if inside.any():
                distinct.setdefault(inside.tobytes(), {"center_m": [float(v) for v in place], "radius_m": factor * radius})
    return tuple(distinct.values())


def _apply_region(robot: Robot, entry: Entry) -> Robot:
    center, mesh = vector(entry, "center_m", "soft_region"), robot.body.mesh
    radius = number(entry, "radius_m", "soft_region", low=0.0)
    scale = number(entry, "scale", "soft_region", low=1e-3, high=1e3)
    inside = np.linalg.norm(mesh.nodes[mesh.tets[:, :4]].mean(axis=1) - center, axis=1) <= radius
    if not inside.any():
        raise InputError(
            "no element has its centroid in the region",
            where="soft_region",
            found=f"radius {radius:g} m around {center.tolist()}",
            expected="a region of the body",
            hint="enlarge radius_m",
        )
    return robot.with_body(robot.body.with_stiffness_scale(np.where(inside, scale, 1.0)))


def _apply_law(robot: Robot, entry: Entry) -> Robot:
    law = entry.get("law")
    if law not in ("neo_hookean", "gent"):
        raise InputError("unknown law", where="hyperelastic.law", found=law, expected="neo_hookean | gent")
    if law == "neo_hookean" and "jm" in entry:
        raise InputError("jm belongs to gent", where="hyperelastic.jm", found=entry["jm"], expected='law = "gent"')
    limit = number(entry, "jm", "hyperelastic", low=1e-3) if law == "gent" else np.inf
    return robot.with_body(robot.body.with_material(replace(robot.body.material, law=str(law), stretch_limit=limit)))


def _law_seeds(robot: Robot) -> tuple[Entry, ...]:
    return () if robot.body.material.law == "neo_hookean" else ({"law": "neo_hookean"},)


def _gent_seeds(robot: Robot) -> tuple[Entry, ...]:
    return ({"law": "gent"},)


def _gent_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """The coordinate is 1/jm: 0 is the neo-Hookean law."""
    return (Parameter("jm", None, "1", 0.3, 0.0, 10.0, 1e-4, "reciprocal"),)


MOST_CREEP = 0.5
"""Largest fraction of the stress of a cast silicone that relaxes in one term (0.05–0.3 are usual); more indicates another effect."""
USUAL_CREEP = 0.15
"""Share that one term of a cast silicone relaxes."""


def _creep_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("fraction", None, "1", 0.0, 0.0, MOST_CREEP, 1e-3, plausible=USUAL_CREEP),) if control == "tension" else ()


def _creep_seeds(robot: Robot) -> tuple[Entry, ...]:
    return tuple({"time_s": t} for t in (0.5, 2.0, 8.0, 32.0, 128.0))


def _creep_polish(robot: Robot, control: str, seed: Entry) -> tuple[Parameter, ...]:
    start = float(np.log(seed["time_s"]))
    return (Parameter("time_s", None, "s", start, float(np.log(0.05)), float(np.log(2000.0)), 1e-5, "log"),)


def _creep_twice_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    if control != "tension":
        return ()
    return tuple(Parameter("fraction", i, "1", 0.0, 0.0, MOST_CREEP, 1e-3, plausible=USUAL_CREEP) for i in range(2))


def _creep_twice_seeds(robot: Robot) -> tuple[Entry, ...]:
    return tuple({"time_s": list(times)} for times in ((0.5, 8.0), (2.0, 32.0), (8.0, 128.0)))


def _creep_twice_polish(robot: Robot, control: str, seed: Entry) -> tuple[Parameter, ...]:
    low, high = float(np.log(0.05)), float(np.log(2000.0))
    return tuple(Parameter("time_s", i, "s", float(np.log(t)), low, high, 1e-5, "log") for i, t in enumerate(seed["time_s"]))


def _apply_creep(robot: Robot, entry: Entry) -> Robot:
    fractions, times = (v if isinstance(v, list) else [v] for v in (entry.get("fraction", []), entry.get("time_s", [])))
    if not len(fractions) or len(fractions) != len(times):
        raise InputError(
            "fraction and time_s differ in number", where="creep", found=entry, expected="one or more terms, as many of each"
        )
    terms = tuple(
        (number({"f": f}, "f", "creep.fraction", low=0.0), number({"t": t}, "t", "creep.time_s", low=1e-6))
        for f, t in zip(fractions, times)
    )
    return replace(robot, creep=robot.creep + terms)


STIFFNESS = Effect(
    "stiffness",
    "the right modulus everywhere",
    _stiffness_parameters,
    _apply_stiffness,
    keys=("scale",),
    calibrated=Calibrated(MODULUS_STD, MODULUS_STD, of_inputs=False),
    told_by=Experiment.KNOWN_WEIGHT,
)
POISSON = Effect(
    "poisson",
    "the right Poisson ratio",
    _poisson_parameters,
    _apply_poisson,
    keys=("poisson_ratio",),
    told_by=Experiment.MORE_MARKERS,
)
SOFT_REGION = Effect(
    "soft_region",
    "a part of another stiffness",
    _region_parameters,
    _apply_region,
    _region_places,
    keys=("center_m", "radius_m", "scale"),
    nearby=_regions_nearby,
    told_by=Experiment.MORE_MARKERS,
)
HYPERELASTIC: Effect = Effect(
    "hyperelastic",
    "stiffening or softening with stretch",
    no_parameters,
    _apply_law,
    _law_seeds,
    keys=("law", "jm"),
    discrete=True,
    told_by=Experiment.MORE_MARKERS,
    planned=lambda robot: (("", GENT if robot.body.material.law == "neo_hookean" else HYPERELASTIC),),
)
GENT: Effect = replace(HYPERELASTIC, parameters=_gent_parameters, seeds=_gent_seeds, planned=None)
CREEP = Effect(
    "creep",
    "slow flow under load",
    _creep_parameters,
    _apply_creep,
    _creep_seeds,
    keys=("fraction", "time_s"),
    polish=_creep_polish,
    told_by=Experiment.LOAD_UNLOAD_AND_HOLD,
    drives=True,
)
CREEP_TWICE = replace(CREEP, parameters=_creep_twice_parameters, seeds=_creep_twice_seeds, polish=_creep_twice_polish)
