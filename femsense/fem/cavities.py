"""Closed cavities of a body: which one holds a seed, and how its volume bends with its faces."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.fem.body_parts import Chamber
from femsense.fem.mesh import TetMesh, boundary_faces

_A, _B, _C, _D = 0.816847572980459, 0.091576213509771, 0.108103018168070, 0.445948490915965


_POINTS = np.array([[_A, _B], [_B, _A], [_B, _B], [_C, _D], [_D, _C], [_D, _D]])


_WEIGHTS = np.array([0.109951743655322] * 3 + [0.223381589678011] * 3) / 2.0
"""Six points of degree 4 on the triangle (Dunavant 1985); weights sum to its area in the plane of L₁, L₂."""


RAYS = 200
"""Directions in which an open cavity is looked for."""


def _triple(nodes: int) -> FloatArray:
    """Return T, shape (k, k, k): the volume of a face of k = 3 or 6 nodes over the origin is Σ T_abc x_a · (x_b × x_c)."""
    tensor = np.zeros((nodes,) * 3)
    for (u, v), weight in zip(_POINTS, _WEIGHTS):
        N, N_u, N_v = (
            _shape(u, v) if nodes == 6 else (np.array([u, v, 1 - u - v]), np.array([1.0, 0, -1]), np.array([0, 1.0, -1]))
        )
        tensor += weight / 3.0 * np.einsum("a,b,c->abc", N, N_u, N_v)
    signs = {p: float(np.linalg.det(np.eye(3)[list(p)])) for p in permutations(range(3))}
    return np.asarray(sum(sign * tensor.transpose(p) for p, sign in signs.items()) / 6.0)


def _shape(u: float, v: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shape functions of the triangle of 6 nodes and their slopes along L₁ = u and L₂ = v."""
    L = np.array([u, v, 1.0 - u - v])
    slope = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]])
    sides = [(0, 1), (1, 2), (2, 0)]
    values = np.concatenate([L * (2 * L - 1), [4 * L[i] * L[j] for i, j in sides]])
    slopes = [np.concatenate([(4 * L - 1) * s, [4 * (s[i] * L[j] + L[i] * s[j]) for i, j in sides]]) for s in slope]
    return values, slopes[0], slopes[1]


_TRIPLE = {3: _triple(3), 6: _triple(6)}


def curvature_map(chamber: Chamber, slots: IntArray, block_count: int, node_count: int) -> sp.csr_matrix:
    """Return the map from positions to the vectors w of all blocks, −d²V/dx_a dx_b = [w]×, shape (nb, n).

    Arguments:
        slots: where the block of nodes (a, b) of each face goes, shape (t, k, k).
    """
    k = chamber.faces.shape[1]
    a, b, c = np.nonzero(_TRIPLE[k])
    values = np.broadcast_to(6.0 * _TRIPLE[k][a, b, c], (len(slots), len(a)))
    result = sp.csr_matrix(
        (values.ravel(), (slots[:, a, b].ravel(), chamber.faces[:, c].ravel())), shape=(block_count, node_count)
    )
    result.data[np.abs(result.data) < 1e-12] = 0.0
    result.eliminate_zeros()
    return result


# Finding a chamber


def find_chamber(
    mesh: TetMesh, name: str, seed: npt.ArrayLike, *, max_pressure: float = np.inf, where: str | None = None
) -> Chamber:
    """Find the chamber (a closed cavity) of a mesh that contains a given point, its seed.

    Arguments:
        mesh: mesh of the body at rest [m].
        name: name of the chamber, by which pressures refer to it.
        seed: any point inside the cavity [m], shape (3,).
        max_pressure: largest pressure [Pa]. Default: no limit.
        where: location that error messages state.

    Returns:
        the chamber, for the argument `chambers` of `make_body`.

    Raises:
        InputError: the seed lies in the material, outside of the body, or in a cavity that is open.
    """
    where = where or f"seed of chamber {name}"
    point = as_points(seed, where)[0]
    faces = boundary_faces(mesh)
    part = _surface_parts(faces)
    angles = _solid_angles(mesh.nodes, faces, point)
    turns = np.bincount(part, weights=angles) / (4.0 * np.pi)
    enclosing = np.flatnonzero(np.abs(turns + 1.0) < 0.01)
    if len(enclosing) == 1:
        inner = faces[part == enclosing[0]]
        inner = inner[:, [0, 2, 1]] if inner.shape[1] == 3 else inner[:, [0, 2, 1, 5, 4, 3]]
        return Chamber(name, freeze(inner, np.int64), freeze(point), float(max_pressure))
    raise _not_a_cavity(mesh, faces, point, float(turns.sum()), where)


def cavity_seeds(mesh: TetMesh) -> list[FloatArray]:
    """Return a point inside each cavity of a mesh that is closed [m], each (3,), the largest cavity first."""
    faces = boundary_faces(mesh)
    part, seeds = _surface_parts(faces), list[tuple[float, FloatArray]]()
    corners = mesh.nodes[faces[:, :3]]
    volumes = np.bincount(part, weights=np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)
    for p in np.flatnonzero(volumes < 0.0):  # seen from the material its faces look inwards
        of = corners[part == p]
        normal = np.cross(of[:, 1] - of[:, 0], of[:, 2] - of[:, 0])
        edge = np.sqrt(np.linalg.norm(normal, axis=1, keepdims=True))
        beside = of.mean(axis=1) + 0.1 * normal / np.maximum(edge, 1e-300)
        for point in [of.reshape(-1, 3).mean(axis=0), *beside[:20]]:
            if abs(_solid_angles(mesh.nodes, faces[part == p], point).sum() / (4.0 * np.pi) + 1.0) < 0.01:
                seeds.append((float(volumes[p]), point))
                break
    return [point for _, point in sorted(seeds, key=lambda seed: seed[0])]


def check_chambers(chambers: tuple[Chamber, ...], where: str = "chambers") -> None:
    """Refuse two chambers that are the same cavity. Raises InputError."""
    seen: dict[int, str] = {}
    for chamber in chambers:
        first = int(chamber.faces.min())
        if first in seen:
            raise InputError(
                "two chambers share a surface",
                where=where,
                found=f"the seeds of {seen[first]!r} and {chamber.name!r} lie in one cavity",
                expected="each chamber its own closed cavity",
                hint="keep one of them",
            )
        seen[first] = chamber.name


def _not_a_cavity(mesh: TetMesh, faces: IntArray, seed: FloatArray, turns: float, where: str) -> InputError:
    expected = "a point inside a closed cavity of the mesh"
    found = "[" + ", ".join(f"{v:.4g}" for v in seed) + "] m"
    if abs(turns) > 0.01:
        return InputError("the seed of the chamber lies in the material", where=where, found=found, expected=expected)
    hidden = _hidden_share(mesh.nodes, faces, seed)
    if hidden < 0.5:
        hint = "seeds are in metres, robot frame, after T_robot_mesh"
        return InputError(
            "the seed of the chamber lies outside of the body", where=where, found=found, expected=expected, hint=hint
        )
    found = f"{found}; {100 * (1 - hidden):.0f} % of the directions from there meet no wall" if hidden < 1 else found
    return InputError(
        "the cavity around the seed is open to the outside",
        where=where,
        found=found,
        expected=expected,
        hint="close the hole in the mesh (a plug where the tube enters)",
    )


def _surface_parts(faces: IntArray) -> IntArray:
    """Return the number of the connected surface of each face, shape (t,); faces are neighbours where they share a side."""
    t = len(faces)
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, side = np.unique(sides, axis=0, return_inverse=True)
    face = np.repeat(np.arange(t), 3)
    touches = sp.csr_matrix((np.ones(3 * t), (face, side.ravel())), shape=(t, int(side.max()) + 1))
    return np.asarray(sp.csgraph.connected_components(touches @ touches.T, directed=False)[1], dtype=np.int64)


def _solid_angles(nodes: FloatArray, faces: IntArray, point: FloatArray) -> FloatArray:
    """Return the signed solid angle of each face seen from a point, shape (t,) (van Oosterom & Strackee 1983)."""
    quarters = [[0, 1, 2]] if faces.shape[1] == 3 else [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]
    total = np.zeros(len(faces))
    for corners in quarters:
        a, b, c = np.moveaxis(nodes[faces[:, corners]] - point, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        dots = [np.einsum("ti,ti->t", u, v) for u, v in ((a, b), (b, c), (c, a))]
        total += 2.0 * np.arctan2(
            np.einsum("ti,ti->t", a, np.cross(b, c)), la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
        )
    return total


def _hidden_share(nodes: FloatArray, faces: IntArray, point: FloatArray) -> float:
    """Return the share of directions from a point that meet the surface [1]."""
    step = np.arange(RAYS) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * step / RAYS), np.pi * (1.0 + np.sqrt(5.0)) * step
    rays = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    a, b, c = np.moveaxis(nodes[faces[:, :3]] - point, 1, 0)
    sides = [np.cross(u, v) @ rays.T for u, v in ((a, b), (b, c), (c, a))]
    one_sided = np.logical_and.reduce([s > 0 for s in sides]) | np.logical_and.reduce([s < 0 for s in sides])
    ahead = (np.cross(b - a, c - a) @ rays.T) * np.einsum("ti,ti->t", a, np.cross(b - a, c - a))[:, None] > 0
    return float((one_sided & ahead).any(axis=0).mean())
