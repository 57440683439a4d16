"""The connected components of a surface: their nesting, cavities, and the choice among several bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import BoolArray, FloatArray, IntArray, diagonal
from femsense.core.errors import InputError
from femsense.io.meshing.surface_queries import crossing_triangles, distance_to, neighbours, place_text, winding_number

DUST = 1e-6
"""A shell that encloses less than this fraction of the total volume is discarded."""
TOUCHING = 1e-4
"""Shells closer than this, over the diagonal, are one body."""
MOST_SHELLS = 3000
"""Surfaces in more pieces are refused: all of them would be compared with each other."""


@dataclass(frozen=True, eq=False, slots=True)
class Shells:
    """The connected pieces of a surface."""

    of: IntArray  # the shell of each triangle, (t,)
    volume: FloatArray  # signed, (s,)
    depth: IntArray  # number of shells around each one, (s,)
    body: IntArray  # number of the body that each one belongs to, by falling volume, (s,)


def pieces(triangles: IntArray) -> IntArray:
    """Return the number of the piece that each triangle belongs to, joined by sides of two triangles, shape (t,)."""
    first, second, _ = neighbours(triangles)
    graph = sp.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(triangles),) * 2)
    return np.asarray(sp.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def find_shells(points: FloatArray, triangles: IntArray, where: str, most: int) -> Shells:
    """Return the closed pieces of a surface, outer ones and cavities. Raises InputError."""
    of = pieces(triangles)
    volume, count = shell_volumes(points, triangles, of), int(of.max()) + 1
    if count > most:
        raise InputError(
            "the surface falls into too many pieces",
            where=where,
            found=f"{count} pieces of {len(triangles) / count:.1f} triangles on average",
            expected=f"a closed surface, or at most {most} shells",
            hint="merge equal points and remove inner parts in a mesh editor",
        )
    if count == 1:
        return Shells(of, volume, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
    corners = [
        points[np.unique(own)] for own in np.split(triangles[np.argsort(of, kind="stable")], np.cumsum(np.bincount(of))[:-1])
    ]
    low, high = np.array([own.min(axis=0) for own in corners]), np.array([own.max(axis=0) for own in corners])
    meets = _meeting(points, triangles, of, corners, low, high)
    inside = np.zeros((count, count), dtype=bool)
    held = (low[:, None] >= low[None]).all(axis=2) & (high[:, None] <= high[None]).all(axis=2) & ~(meets | meets.T)
    np.fill_diagonal(held, False)
    for i, j in np.argwhere(held):
        probes = corners[i][:: max(1, len(corners[i]) // 4)]
        inside[i, j] = bool((np.abs(winding_number(points[triangles[of == j]], probes)) > 0.5).all())
    depth = inside.sum(axis=1)
    meets |= inside & (depth[:, None] % 2 == 1) & (depth[None] == depth[:, None] - 1)  # a cavity belongs to the body around it
    body = sp.csgraph.connected_components(sp.csr_matrix(meets.astype(float)), directed=False)[1]
    size = np.zeros(body.max() + 1)
    np.add.at(size, body[depth % 2 == 0], np.abs(volume[depth % 2 == 0]))
    return Shells(of, volume, depth, np.argsort(np.argsort(-size))[body])


def _meeting(
    points: FloatArray, triangles: IntArray, of: IntArray, corners: list[FloatArray], low: FloatArray, high: FloatArray
) -> BoolArray:
    """Return which shells cross or touch, shape (s, s); corners, low and high are those of each shell."""
    crossing = crossing_triangles(points, triangles)
    meets = np.zeros((len(corners),) * 2, dtype=bool)
    meets[of[crossing[:, 0]], of[crossing[:, 1]]] = True
    near = TOUCHING * diagonal(points)
    close = (low[:, None] <= high[None] + near).all(axis=2) & (high[:, None] >= low[None] - near).all(axis=2) & ~meets
    np.fill_diagonal(close, False)
    for j in np.flatnonzero(close.any(axis=0)):
        others = np.flatnonzero(close[:, j])
        away = distance_to(points, triangles[of == j], np.vstack([corners[i] for i in others]))
        ends = np.cumsum([len(corners[i]) for i in others])[:-1]
        meets[others, j] = [part.min() < near for part in np.split(away, ends)]
    return meets


def shell_volumes(points: FloatArray, triangles: IntArray, of: IntArray) -> FloatArray:
    """Return the signed volume inside each shell, Σ a · (b × c) / 6, shape (s,)."""
    a, b, c = np.moveaxis(points[triangles] - points.mean(axis=0), 1, 0)
    return np.asarray(np.bincount(of, np.einsum("tc,tc->t", a, np.cross(b, c)) / 6.0), dtype=np.float64)


def without_dust(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> IntArray:
    """Return the triangles without pieces of next to no volume. Raises InputError."""
    of = pieces(triangles)
    size = np.abs(shell_volumes(points, triangles, of))
    if size.max() <= 1e-9 * diagonal(points) ** 3:
        raise InputError(
            "the surface encloses nothing",
            where=where,
            found=f"a volume of {size.max():.3g} in the unit of the file",
            expected="a closed surface around a volume",
        )
    dust = size < DUST * size.max()
    if not dust.any():
        return triangles
    done.append(f"{int(dust.sum())} shells of negligible volume were removed")
    return np.asarray(triangles[~dust[of]])


def faced(triangles: IntArray, shells: Shells, fill: bool, done: list[str]) -> tuple[IntArray, int]:
    """Turn outer shells outward and inner ones, which are cavities, into the cavity."""
    inner = shells.depth % 2 == 1
    wrong = (shells.volume < 0) != inner
    if (wrong & ~inner).any():
        done.append(f"{int((wrong & ~inner).sum())} shells that were inside out were turned")
    if (wrong & inner).any() and not fill:
        done.append(f"{int((wrong & inner).sum())} inner shells were turned so that they are cavities")
    return np.where(wrong[shells.of][:, None], triangles[:, ::-1], triangles), int(inner.sum())


def chosen(
    points: FloatArray,
    triangles: IntArray,
    shells: Shells,
    part: int | None,
    fill: bool,
    cavities: int,
    where: str,
    unit: str,
    done: list[str],
) -> tuple[IntArray, int]:
    """Take the body that is meant, with its cavities, or without them where they are to be filled."""
    bodies = int(shells.body.max()) + 1
    inner = shells.depth % 2 == 1
    if bodies > 1 and part is None:
        raise InputError(
            "several separate bodies",
            where=where,
            found=_bodies_text(points, triangles, shells, unit),
            expected="one connected body",
            hint="--part 1 takes the largest; join them in the CAD program if they are one",
        )
    if part is not None and not 1 <= part <= bodies:
        raise InputError("no such part", where=where, found=part, expected=f"1 … {bodies}")
    wanted = np.ones(len(inner), dtype=bool) if part is None else shells.body == part - 1
    if bodies > 1:
        done.append(f"part {part} of {bodies} was taken")
    if fill and (wanted & inner).any():
        done.append(f"{int((wanted & inner).sum())} cavities were filled")
        wanted &= ~inner
    cavities = int((wanted & inner).sum())
    if cavities:
        done.append(f"{cavities} inner shells are kept as cavities")
    return triangles[wanted[shells.of]], cavities


def _bodies_text(points: FloatArray, triangles: IntArray, shells: Shells, unit: str) -> str:
    parts = []
    for body in range(min(int(shells.body.max()) + 1, 6)):
        own = points[triangles[(shells.body == body)[shells.of]]].reshape(-1, 3)
        size, middle = np.ptp(own, axis=0), (own.min(axis=0) + own.max(axis=0)) / 2.0
        parts.append(f"{body + 1}: {' × '.join(f'{v:.3g}' for v in size)} {unit} around {place_text(points, middle)}")
    more = int(shells.body.max()) + 1 - len(parts)
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")
