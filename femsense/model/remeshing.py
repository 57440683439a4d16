"""A robot and its body on another mesh of the same shape."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.body_parts import Chamber
from femsense.fem.cavities import find_chamber
from femsense.fem.mesh import Embedding, TetMesh, embed_points, refined, to_linear, to_quadratic
from femsense.model.robot import Robot

ROUNDING = 2
"""A point counts as inside a box up to this number of units in the last place of the bound, the rounding error of a change of units."""


@functools.lru_cache(maxsize=4)
def finer_mesh(mesh: TetMesh, element: str | None, refinements: int) -> TetMesh:
    """Return a mesh with another element type (None: the same), refined a number of times by splitting each element into eight.

    The most recent meshes are cached, so that states solved on one can be reused.
    """
    quadratic = mesh.is_quadratic if element is None else element == "tet10"
    if not refinements and quadratic == mesh.is_quadratic:
        return mesh
    fine = to_linear(mesh)
    for _ in range(refinements):
        fine = refined(fine)
    return to_quadratic(fine) if quadratic else fine


@functools.lru_cache(maxsize=2)
def robot_on_mesh(robot: Robot, mesh: TetMesh) -> Robot:
    """Return the robot with its body on another mesh of the same shape; markers, features and cables stay where they are.

    The last ones are kept: what the stiffness of a fine mesh needs beforehand takes as long as some states.
    """
    from scipy.spatial import cKDTree

    old = robot.body.mesh
    boxes = declared_boxes(robot)
    clamped = None if boxes is None else np.flatnonzero(within(mesh.nodes, boxes))
    features = cKDTree(mesh.nodes).query(old.nodes[robot.features])[1] if len(robot.features) else robot.features
    moved = robot.with_body(body_on_mesh(robot.body, mesh, clamped=clamped))
    return replace(moved.with_marker_points(robot.marker_points), features=freeze(features, np.int64))


def declared_boxes(robot: Robot) -> FloatArray | None:
    """Return the boxes of [[fixed]] [m], shape (b, 2, 3), if they clamp just the nodes that are clamped; else None."""
    document = robot.document
    tables = document.get("fixed", []) if isinstance(document, Mapping) else []
    boxes = np.array([t["box_m"] for t in tables], dtype=float).reshape(-1, 2, 3)
    hold = np.array_equal(np.flatnonzero(within(robot.body.mesh.nodes, boxes)), robot.body.clamped)
    return boxes if len(boxes) and hold else None


def within(points: FloatArray, boxes: FloatArray) -> BoolArray:
    """Return which points (n, 3) are inside one of the boxes (b, 2, 3), their boundaries included, shape (n,)."""
    slack = ROUNDING * np.spacing(np.abs(boxes))
    low, high = boxes[:, 0] - slack[:, 0], boxes[:, 1] + slack[:, 1]
    return np.asarray(((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2).any(axis=1))


def body_on_mesh(body: BodyModel, mesh: TetMesh, *, clamped: IntArray | None = None) -> BodyModel:
    """Return a body on another mesh of the same shape.

    Arguments:
        body: the body.
        mesh: elements take the material of the element that holds their centre;
            springs of the clamp and dead loads stay where they are.
        clamped: nodes of the new mesh; by default those that moved with clamped nodes alone.
    """
    if clamped is None:
        ties = embed_points(body.mesh, mesh.nodes)
        is_clamped = np.zeros(len(body.mesh.nodes), dtype=bool)
        is_clamped[body.clamped] = True
        clamped = np.flatnonzero(np.abs(np.where(is_clamped[ties.nodes], 0.0, ties.weights)).max(axis=1) < 1e-6)
    nodes = clamped.astype(np.int64).tobytes(), body.clamp_nodes.astype(np.int64).tobytes()
    made, parent = _plain_body(body.mesh, mesh, tuple((c.name, c.path) for c in body.cables), body.chambers, *nodes)
    made = made.with_cables(tuple(replace(c, path=tied.path) for c, tied in zip(body.cables, made.cables)))
    material = body.material
    young, poisson = material.young_modulus[parent], material.poisson_ratio[parent]
    made = made.with_material(replace(material, young_modulus=freeze(young), poisson_ratio=freeze(poisson)))
    made = made.with_gravity(body.gravity)
    if not body.clamp_is_rigid:
        made = made.with_clamp_stiffness(body.clamp_stiffness, turn=body.clamp_turn_stiffness)
    if body.carried_mass is not None:
        made = made.with_carried_mass(_spread_over(mesh, body.mesh.nodes, body.carried_mass[:, None])[:, 0])
    if not body.dead_forces.any():
        return made
    return made.with_dead_forces(_spread_over(mesh, body.mesh.nodes, body.dead_forces))


def _spread_over(mesh: TetMesh, places: FloatArray, values: FloatArray) -> FloatArray:
    """Return nodal values at places (p, 3), shape (p, c), distributed to the nodes of another mesh, shape (n, c)."""
    held = np.flatnonzero(values.any(axis=1))
    ties = embed_points(mesh, places[held])
    return np.asarray(ties.matrix(len(mesh.nodes)).T @ values[held])


@functools.lru_cache(maxsize=2)
def _plain_body(
    old: TetMesh,
    mesh: TetMesh,
    paths: tuple[tuple[str, Embedding], ...],
    chambers: tuple[Chamber, ...],
    clamped: bytes,
    springs: bytes,
) -> tuple[BodyModel, IntArray]:
    """Return a body of any one material on a mesh with the paths of cables and the chambers of an old one,
    and which old element each element lies in.

    The last ones are kept: pattern, order and ties take as long as some states,
    and neither material nor friction changes them. Nodes are bytes of int64: those that are clamped on the new mesh, and those of
    the old one that carry springs where the clamp gives.
    """
    from scipy.spatial import cKDTree

    parent = embed_points(old, mesh.nodes[mesh.tets[:, :4]].mean(axis=1)).element
    held = old.nodes[np.frombuffer(springs, np.int64)]
    made = make_body(
        mesh,
        young_modulus=1.0,
        poisson_ratio=0.3,
        clamped=np.frombuffer(clamped, np.int64),
        cables=tuple(tie_cable(mesh, name, path.positions(old.nodes), np.zeros(3)) for name, path in paths),
        chambers=tuple(find_chamber(mesh, c.name, c.seed, max_pressure=c.max_pressure) for c in chambers),
    )
    springs_on_new = cKDTree(mesh.nodes).query(held)[1] if len(held) else np.zeros(0, np.int64)
    return made.with_clamp_nodes(springs_on_new), parent
