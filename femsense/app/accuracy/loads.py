"""Loads that are equal on every space: the weight, feasible inputs, contact forces on patches of the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, diagonal, spread_evenly
from femsense.core.errors import DataError
from femsense.fem.body import BodyModel
from femsense.fem.compliance import drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import Embedding, TetMesh, embed_points, surface_triangles, triangle_normals, vertex_normals
from femsense.model.contact_patch import body_surface, closest_surface_point
from femsense.model.remeshing import body_on_mesh, finer_mesh
from femsense.model.robot import Robot

MOST_INPUTS = 4
"""Number of cables and chambers that are tried, spread over their list."""
FORCE_POINTS = 6
"""Number of features at which contact forces are tried …"""
FELT = 0.05
"""… at which a force moves the rest of the body by this share of the most at least: next to the clamp nothing is sensed."""
PART_OF_LARGEST = 0.5
"""Inputs act with this part of their largest value."""
USUAL_MOTION = 0.1
"""No input moves the body by more than about this share of its diagonal."""
MOST_PILOT_UNKNOWNS = 40_000
"""Inputs are sized on quadratic elements if these have no more unknowns; linear ones move too little."""
PATCH = 0.06
"""Radius of the patch that carries a contact force, over the diagonal; one and a half edges of the surface at least."""


class LoadKind(StrEnum):
    """Kind of a load."""

    GRAVITY = "gravity"
    CABLE = "cable"
    CHAMBER = "chamber"


@dataclass(frozen=True, eq=False, slots=True)
class Load:
    """Something that moves the body from its rest under its own weight; the weight itself is measured from the unloaded shape."""

    kind: LoadKind
    name: str
    size: float
    unit: str


@dataclass(frozen=True, eq=False, slots=True)
class Patches:
    """Contact forces that are the same on every mesh of the body."""

    centres: FloatArray  # features that they act at, (k, 3)
    places: FloatArray  # points of the surface that carry them, (q, 3)
    forces: FloatArray  # their shares of each unit force, (k, q, 3)


@dataclass(frozen=True, eq=False, slots=True)
class SolvedSpace:
    """The states of one space, from which a finer one starts."""

    mesh: TetMesh
    states: tuple[Equilibrium, ...]  # at rest under the weight, then under each input


def rest_of(body: BodyModel) -> Equilibrium:
    """Return the state under the weight alone. Raises DataError where there is none."""
    rest = solve_equilibrium(body)
    if not rest.converged:
        raise DataError(f"the declared model has no equilibrium under its own weight: {rest.status}: {rest.advice}")
    return rest


def feasible_loads(body: BodyModel) -> tuple[list[Load], SolvedSpace]:
    """Return loads under which the declared model converges, and its states. Raises DataError where there are none."""
    loads, start = sized_loads(body), SolvedSpace(body.mesh, (rest_of(body),))
    for _ in range(4):
        states = states_under(body, loads, start)
        if states is not None:
            return loads, SolvedSpace(body.mesh, states)
        loads = [load if load.kind is LoadKind.GRAVITY else replace(load, size=0.5 * load.size) for load in loads]
    raise DataError("the declared model does not converge under its cables and chambers, even by an eighth of their usual inputs")


def sized_loads(body: BodyModel) -> list[Load]:
    """Return the weight and the inputs, each a part of its largest value but no larger than moves the body a good deal.

    How far an input moves the body is taken from the stiffness at rest of quadratic elements.
    """
    chosen = _inputs(body)
    weight = [Load(LoadKind.GRAVITY, "own weight", 1.0, "")] if body.gravity.any() else []
    if not chosen:
        return weight
    quadratic = finer_mesh(body.mesh, "tet10", 0)
    pilot = body_on(body, quadratic) if 3 * len(quadratic.nodes) <= MOST_PILOT_UNKNOWNS else body
    rest = rest_of(pilot)
    pulls = drive_rows(pilot, rest.positions)[[row_of(pilot, load) for load in chosen]]
    moves = np.linalg.norm(tangent_at(pilot, rest).respond(pulls.reshape(len(chosen), -1, 3)), axis=2).max(axis=1)
    most = USUAL_MOTION * diagonal(body.mesh.nodes)
    limits = [float(f"{most / max(move, 1e-300):.2g}") for move in moves]
    loads = [replace(load, size=min(load.size, limit)) for load, limit in zip(chosen, limits)]
    return weight + loads


def row_of(body: BodyModel, load: Load) -> int:
    """Return the number of an input: cables first, then chambers."""
    if load.kind is LoadKind.CABLE:
        return body.cable_names.index(load.name)
    return len(body.cables) + body.chamber_names.index(load.name)


def _inputs(body: BodyModel) -> list[Load]:
    cables = [Load(LoadKind.CABLE, cable.name, PART_OF_LARGEST * cable.max_tension, "N") for cable in body.cables]
    chambers = [Load(LoadKind.CHAMBER, chamber.name, PART_OF_LARGEST * chamber.max_pressure, "Pa") for chamber in body.chambers]
    return [(cables + chambers)[i] for i in spread_evenly(len(cables) + len(chambers), MOST_INPUTS)]


def drive_of_load(load: Load) -> dict[str, Any]:
    """Return a load as an argument of `solve_equilibrium`."""
    return {"tension" if load.kind is LoadKind.CABLE else "pressure": {load.name: load.size}}


def felt_features(robot: Robot, rest: Equilibrium, places: FloatArray) -> IntArray:
    """Return the features that contact forces are tried at: far from each other, and such that a force there moves the body."""
    body = robot.body
    normals = vertex_normals(body.mesh.nodes, surface_triangles(body.mesh))[robot.features]
    forces = np.zeros((len(normals), len(body.mesh.nodes), 3))
    forces[np.arange(len(normals)), robot.features] = normals
    ties, radius = embed_points(body.mesh, places), _patch_radius(body)
    far = np.linalg.norm(places - body.mesh.nodes[robot.features][:, None], axis=2) > radius  # a dent is no motion
    fields = tangent_at(body, rest).respond(forces)
    moved = np.array([np.linalg.norm(ties.positions(field)[others]) for field, others in zip(fields, far)])
    return np.asarray(robot.features[moved > FELT * moved.max(initial=0.0)][:FORCE_POINTS])


def contact_patches(robot: Robot, finest: TetMesh, features: IntArray) -> Patches:
    """Return contact forces of one newton into the surface, as a cone over a patch, at some features."""
    body = robot.body
    surface, radius = body_surface(finest), _patch_radius(body)
    corners = finest.nodes[surface.triangles]
    middles, area = corners.mean(axis=1), triangle_normals(finest.nodes, surface.triangles)
    size = np.linalg.norm(area, axis=1)
    centres = body.mesh.nodes[features]
    forces = np.zeros((len(centres), len(middles), 3))
    for k, place in enumerate(centres):
        centre = closest_surface_point(surface, finest.nodes, place)
        facing = _facing(middles, area, centre, radius)
        share = size * np.maximum(1.0 - np.linalg.norm(middles - centre, axis=1) / radius, 0.0) * (area @ facing > 0.35 * size)
        forces[k] = -share[:, None] / share.sum() * facing
    used = forces.any(axis=(0, 2))
    return Patches(centres, middles[used], forces[:, used])


def _patch_radius(body: BodyModel) -> float:
    """Return the radius of the contact patch [m]."""
    return max(PATCH * diagonal(body.mesh.nodes), 1.5 * body_surface(body.mesh).edge)


def _facing(middles: FloatArray, area: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Return the normal of the face that has the most area around a place (at an edge a mean would belong to no face)."""
    near = np.linalg.norm(middles - centre, axis=1) < radius
    size = np.linalg.norm(area[near], axis=1)
    unit = area[near] / size[:, None]
    votes = np.where(unit @ unit.T > 0.9, size, 0.0).sum(axis=1)
    return np.asarray(unit[np.argmax(votes)])


def states_under(body: BodyModel, loads: Sequence[Load], before: SolvedSpace) -> tuple[Equilibrium, ...] | None:
    """Return the equilibria without and under each load; None where one does not converge."""
    ties = None if body.mesh is before.mesh else embed_points(before.mesh, body.mesh.nodes)
    drives = [{}, *(drive_of_load(load) for load in loads if load.kind is not LoadKind.GRAVITY)]
    states: list[Equilibrium] = []
    for i, drive in enumerate(drives):
        known = before.states[i] if i < len(before.states) else states[0]
        start = known if ties is None or i >= len(before.states) else _carried(known, ties)
        states.append(solve_equilibrium(body, **drive, start=start))
        if not states[-1].converged:
            return None
    return tuple(states)


def _carried(known: Equilibrium, ties: Embedding) -> Equilibrium:
    """Return a state of one space as a start in another one."""
    positions = ties.positions(known.positions)
    return replace(known, positions=positions, nodal_forces=np.zeros_like(positions), factor=None)


def body_on(body: BodyModel, mesh: TetMesh) -> BodyModel:
    """Return a body on another mesh of the same shape."""
    return body if mesh is body.mesh else body_on_mesh(body, mesh)
