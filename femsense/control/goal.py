"""The goal of a search: target coordinates of points of the body, and the contact forces that act on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.control.motion import WallContact
from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.fem.mesh import Embedding, embed_points
from femsense.model.on_body import check_on_body
from femsense.model.robot import Robot

Forces = Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]
"""Known contact forces: (place on the body at rest [m], force on the body [N]), each of shape (3,)."""
Target = Mapping[str | tuple[float, float, float], npt.ArrayLike]
"""A marker's name, or a point of the body at rest [m] → its target position, robot frame [m], (3,);
NaN leaves a direction free."""


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """Target coordinates, one row each."""

    ties: Embedding
    """The points, p of them."""
    directions: FloatArray
    """Coefficients of each row in the coordinates of the points, shape (r, p, 3)."""
    wanted: FloatArray
    """[m], shape (r,)."""
    names: tuple[str, ...]
    """Names of the points with targets, which come first."""
    nodal_forces: FloatArray
    """Contact forces, known and wanted [N], shape (n, 3)."""

    def miss(self, positions: FloatArray) -> FloatArray:
        """Return wanted minus reached [m], shape (r,), for node positions [m], shape (n, 3)."""
        return np.asarray(self.wanted - np.einsum("rpc,pc->r", self.directions, self.ties.positions(positions)))

    def rows(self, moves: FloatArray) -> FloatArray:
        """Return the change of the rows by k displacements of the nodes (k, n, 3), shape (r, k)."""
        return np.stack([np.einsum("rpc,pc->r", self.directions, self.ties.moves(move)) for move in moves], axis=1)

    def error(self, positions: FloatArray) -> float:
        """Return the largest distance of a point from its target [m]."""
        off = np.einsum("r,rpc->pc", self.miss(positions), self.directions)
        return float(np.linalg.norm(off, axis=1).max(initial=0.0))


# Construction of goals


def make_goal(
    robot: Robot,
    target: Target,
    forces: Forces,
    contacts: Sequence[WallContact],
) -> Goal:
    """Return a goal: rows for the fixed coordinates of the targets, then for the walls.

    Raises InputError.
    """
    keys, points = list(target), [_numbers(value, f"target {key}") for key, value in target.items()]
    places = [_place(robot, key) for key in keys] + [_numbers(contact.point_m, "contacts") for contact in contacts]
    if not places:
        raise InputError("no target", where="target", expected="a marker or a point of the body, and its target position")
    rest = np.array(places)
    rows = [(i, np.eye(3)[axis], point[axis]) for i, point in enumerate(points) for axis in np.flatnonzero(~np.isnan(point))]
    rows += [(len(keys) + i, _normal(contact), contact.offset_m) for i, contact in enumerate(contacts)]
    directions = np.zeros((len(rows), len(rest), 3))
    for row, (i, direction, _) in zip(directions, rows):
        row[i] = direction
    names = tuple(key if isinstance(key, str) else ",".join(f"{x:g}" for x in key) for key in keys)
    wanted = np.array([value for *_, value in rows])
    return Goal(_ties(robot, keys, rest), directions, wanted, names, _nodal(robot, forces, contacts))


def _numbers(value: npt.ArrayLike, where: str) -> FloatArray:
    """Return three numbers, NaN allowed, shape (3,). Raises InputError."""
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,) or np.isinf(point).any():
        raise InputError("not a position", where=where, found=value, expected="x, y, z in metres; NaN leaves a direction free")
    return point


def _place(robot: Robot, key: str | tuple[float, float, float]) -> FloatArray:
    """Return the place of a marker at rest, or the point itself [m], shape (3,). Raises InputError."""
    if not isinstance(key, str):
        place = _numbers(key, "target")
        check_on_body(robot.body.mesh, place[None], where="target")
        return place
    if key not in robot.glued_names:
        raise InputError(
            "unknown marker",
            where="target",
            found=key,
            expected=", ".join(robot.glued_names) or "a point X,Y,Z of the body (this robot has no markers)",
            hint=did_you_mean(key, robot.glued_names),
        )
    return np.asarray(robot.marker_points[robot.marker_names.index(key)])


def _ties(robot: Robot, keys: list[str | tuple[float, float, float]], rest: FloatArray) -> Embedding:
    """Return the embedding of points at rest (p, 3), targets first; markers follow body and clamp with their declared share."""
    ties = embed_points(robot.body.mesh, rest)
    if robot.marker_share is None:
        return ties
    share = np.ones(len(rest))
    for i, key in enumerate(keys):
        if isinstance(key, str):
            share[i] = robot.marker_share[robot.marker_names.index(key)]
    return ties.following(rest, share)


def _normal(contact: WallContact) -> FloatArray:
    """Return the unit normal of a wall, shape (3,). Raises InputError."""
    normal = _numbers(contact.normal, "contacts")
    length = float(np.linalg.norm(normal))
    if not (length > 0 and contact.force_n >= 0):
        raise InputError(
            "invalid wall",
            where="contacts",
            found=f"normal {contact.normal}, {contact.force_n:g} N",
            expected="a normal that is not zero, and a force ≥ 0",
        )
    return normal / length


def _nodal(robot: Robot, forces: Forces, contacts: Sequence[WallContact]) -> FloatArray:
    """Return all contact forces as nodal forces [N], shape (n, 3)."""
    mesh = robot.body.mesh
    pairs = [(_numbers(place, "forces"), _numbers(force, "forces")) for place, force in forces]
    pairs += [(_numbers(c.point_m, "contacts"), c.force_n * _normal(c)) for c in contacts]
    if not pairs:
        return np.zeros_like(mesh.nodes)
    places, values = (np.array(column) for column in zip(*pairs))
    check_on_body(mesh, places[: len(forces)], where="forces")
    check_on_body(mesh, places[len(forces) :], where="contacts")
    return embed_points(mesh, places).spread(values, len(mesh.nodes))
