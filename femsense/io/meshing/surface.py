"""Repair of surfaces from CAD programs and scanners for tetrahedral meshing, with a list of the repairs.

The order is: weld, drop duplicates, orient neighbours consistently, close holes, determine the nesting of the shells, choose the body. A
shell inside another one is a cavity (a chamber), whichever way its triangles face. Shells that cross each other become one body: the
filling takes the union of their interiors.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray, diagonal, freeze
from femsense.core.errors import InputError
from femsense.fem.mesh import triangle_normals
from femsense.io.meshing.shells import MOST_SHELLS, chosen, faced, find_shells, pieces, shell_volumes, without_dust
from femsense.io.meshing.surface_queries import directed_edges, neighbours, open_edges, place_text

WELD = 1e-5
"""Points of open edges closer than this, over the diagonal, are one point."""
SMALL_HOLE = 0.1
"""A hole with a shorter border than this, over the diagonal, is closed without asking."""


@dataclass(frozen=True, eq=False, slots=True)
class ClosedSurface:
    """A closed surface, outward; the surfaces of cavities face into them."""

    points: FloatArray
    """In the unit of the file, shape (n, 3)."""
    triangles: IntArray
    """Shape (t, 3)."""
    cavities: int = 0
    """Shells that face inwards."""
    done: tuple[str, ...] = field(default=())
    """The repairs, as sentences."""

    @property
    def diagonal(self) -> float:
        return diagonal(self.points)

    @property
    def volume(self) -> float:
        """Enclosed volume without cavities [unit³]; the intersection of crossing shells counts twice."""
        return float(shell_volumes(self.points, self.triangles, np.zeros(len(self.triangles), dtype=np.int64))[0])

    @property
    def area(self) -> float:
        return float(np.linalg.norm(triangle_normals(self.points, self.triangles), axis=1).sum())


def repaired(
    points: FloatArray,
    triangles: IntArray,
    *,
    where: str = "surface",
    close_holes: bool = False,
    fill_cavities: bool = False,
    part: int | None = None,
    unit: str = "units",
    most_shells: int = MOST_SHELLS,
) -> ClosedSurface:
    """Return a closed surface that can be filled, and the repairs.

    Arguments:
        points, triangles: of the file, shapes (n, 3) and (t, 3).
        where: for messages.
        close_holes: close holes of any size by flat fans, not only small ones.
        fill_cavities: treat inner shells as solid.
        part: which of several separate bodies to use, 1 the largest.
        unit: of the points, for messages.
        most_shells: a surface in more pieces is refused.

    Raises:
        InputError: not finite, flat, large holes, one-sided, several bodies and none chosen.
    """
    done: list[str] = []
    points, triangles = _tidied(points, triangles, where, done)
    triangles = _turned_alike(points, triangles, where, done)
    points, triangles = _closed(points, triangles, where, close_holes, unit, done)
    triangles = without_dust(points, triangles, where, done)
    shells = find_shells(points, triangles, where, most_shells)
    triangles, cavities = faced(triangles, shells, fill_cavities, done)
    triangles, cavities = chosen(points, triangles, shells, part, fill_cavities, cavities, where, unit, done)
    used, numbers = np.unique(triangles, return_inverse=True)
    return ClosedSurface(freeze(points[used]), freeze(numbers.reshape(-1, 3), np.int64), cavities, tuple(done))


# Points and triangles


def _tidied(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> tuple[FloatArray, IntArray]:
    """Weld points, drop triangles that repeat a point or another triangle."""
    check_finite(points, where)
    points, triangles = merged(points, triangles)
    size = diagonal(points)
    if len(open_edges(triangles)):
        welded = _weld(points, triangles, WELD * size)
        if len(open_edges(welded)) < len(open_edges(triangles)):
            done.append(f"seams up to {WELD:g} of the diagonal wide were welded")
            triangles = welded
    proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    if not proper.all():
        done.append(f"{int((~proper).sum())} triangles without area were dropped")
        triangles = triangles[proper]
    first = np.sort(np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1])
    if len(first) < len(triangles):
        done.append(f"{len(triangles) - len(first)} triangles that stood twice were dropped")
        triangles = triangles[first]
    if len(triangles) < 4 or np.ptp(points, axis=0).min() <= 1e-9 * size:
        raise InputError(
            "the surface encloses nothing",
            where=where,
            found=f"{len(triangles)} triangles, extents {np.ptp(points, axis=0).tolist()}",
            expected="a closed surface around a volume",
        )
    return points, triangles


def merged(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Return points and triangles with equal points made one, in order of their coordinates."""
    order = np.lexsort(points.T[::-1])
    first = np.append(True, (np.diff(points[order], axis=0) != 0).any(axis=1))
    numbers = np.empty(len(points), dtype=np.int64)
    numbers[order] = np.cumsum(first) - 1
    return points[order][first], numbers[triangles]


def check_finite(points: FloatArray, where: str) -> None:
    """Refuse points that are not finite. Raises InputError."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            "a point of the surface is not finite",
            where=where,
            found=f"{len(bad)} points, the first is number {bad[0]}: {points[bad[0]].tolist()}",
            expected="finite coordinates",
            hint="export the surface again",
        )


def _weld(points: FloatArray, triangles: IntArray, distance: float) -> IntArray:
    """Return the triangles with points of open edges that are close to each other made one."""
    from scipy.spatial import cKDTree

    border = np.unique(open_edges(triangles))
    pairs = cKDTree(points[border]).query_pairs(distance, output_type="ndarray")
    n = len(points)
    graph = sp.coo_matrix((np.ones(len(pairs)), (border[pairs[:, 0]], border[pairs[:, 1]])), shape=(n, n))
    labels = sp.csgraph.connected_components(graph, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    return np.asarray(first[labels][triangles])


def _turned_alike(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> IntArray:
    """Orient triangles consistently.

    Each triangle is in a graph twice, in both orientations; edges connect consistent neighbours. For an orientable surface the graph has
    two components, of which the one that flips fewer triangles is used.
    """
    t = len(triangles)
    first, second, alike = neighbours(triangles)
    joins = [
        np.concatenate([first, first + t]),
        np.concatenate([np.where(alike, second, second + t), np.where(alike, second + t, second)]),
    ]
    graph = sp.coo_matrix((np.ones(len(joins[0])), (joins[0], joins[1])), shape=(2 * t, 2 * t))
    count, labels = sp.csgraph.connected_components(graph, directed=False)
    kept, turned = labels[:t], labels[t:]
    if (kept == turned).any():
        raise InputError(
            "the surface has only one side",
            where=where,
            found=f"{int((kept == turned).sum())} triangles that are their own back, as on a Möbius strip",
            expected="a surface with an inside and an outside",
            hint="mend it in a mesh editor",
        )
    size = np.bincount(kept, minlength=count)
    turn = size[kept] < size[turned]
    tie = (size[kept] == size[turned]) & (kept > turned)
    turn |= tie
    if not turn.any():
        return triangles
    done.append(f"{int(turn.sum())} of {t} triangles were turned to face the way of their neighbours")
    return np.where(turn[:, None], triangles[:, ::-1], triangles)


# Holes


def _closed(
    points: FloatArray, triangles: IntArray, where: str, everything: bool, unit: str, done: list[str]
) -> tuple[FloatArray, IntArray]:
    """Close small holes, or all of them, by fans around their middles."""
    holes, loose = _holes(triangles)
    if len(loose):
        triangles = _without_sheets(points, triangles, loose, where, done)
        holes, _ = _holes(triangles)
    if not holes:
        return points, triangles
    length = [float(np.linalg.norm(points[hole] - points[np.roll(hole, 1)], axis=1).sum()) for hole in holes]
    limit = np.inf if everything else SMALL_HOLE * diagonal(points)
    large = [(size, hole) for size, hole in zip(length, holes) if size > limit]
    if large:
        size, hole = max(large, key=lambda item: item[0])
        found = (
            f"{len(large)} large hole{'s' * (len(large) > 1)} of {len(holes)}; the largest has a border of {size:.4g} {unit} "
            f"around {place_text(points, points[hole].mean(axis=0))}"
        )
        raise InputError(
            "the surface is open",
            where=where,
            found=found,
            expected="a closed surface",
            hint="--close-holes closes them by flat caps; or mend the surface where it was made",
        )
    new_points, new_triangles = [points], [triangles]
    for hole in holes:
        around = np.roll(hole, -1)
        if len(hole) == 3:
            new_triangles.append(hole[None])
            continue
        number = sum(len(block) for block in new_points)
        new_points.append(points[hole].mean(axis=0)[None])
        new_triangles.append(np.stack([hole, around, np.full(len(hole), number)], axis=1))
    done.append(f"{len(holes)} holes were closed; the longest border is {max(length):.3g} {unit}")
    return np.vstack(new_points), np.vstack(new_triangles)


def _without_sheets(points: FloatArray, triangles: IntArray, loose: IntArray, where: str, done: list[str]) -> IntArray:
    """Remove sheets that are attached to the body: they are bounded by open edges that do not form closed loops.

    Raises InputError if that is most of the surface.
    """
    edges, labels = np.sort(directed_edges(triangles), axis=1), pieces(triangles)
    bounds = (edges[:, None] == np.sort(loose, axis=1)[None]).all(axis=2).any(axis=1)
    hangs = np.isin(labels, labels[np.flatnonzero(bounds) // 3])
    area = np.linalg.norm(triangle_normals(points, triangles), axis=1)
    if area[hangs].sum() > 0.5 * area.sum():
        raise InputError(
            "the surface is open",
            where=where,
            found=(
                f"{len(loose)} edges of one triangle that go round no hole, the first at "
                f"{place_text(points, points[loose[0]].mean(axis=0))}"
            ),
            expected="a closed surface",
            hint="mend it in a mesh editor",
        )
    done.append(f"{len(np.unique(labels[hangs]))} sheets of {int(hangs.sum())} triangles attached to the body were removed")
    return triangles[~hangs]


def _holes(triangles: IntArray) -> tuple[list[IntArray], IntArray]:
    """Return the borders of the holes, each as its points in the order in which a closing triangle goes round,
    and open edges of none."""
    after: dict[int, list[int]] = {}
    for a, b in open_edges(triangles).tolist():
        after.setdefault(b, []).append(a)
    holes, loose = [], []
    while after:
        start = next(iter(after))
        border = [start]
        while border[-1] in after:
            here = border[-1]
            border.append(after[here].pop())
            if not after[here]:
                del after[here]
            if border[-1] == start:
                break
        if len(border) > 3 and border[-1] == start:
            holes.append(np.array(border[:-1]))
        else:
            loose += list(itertools.pairwise(border))
    return holes, np.array(loose, dtype=np.int64).reshape(-1, 2)
