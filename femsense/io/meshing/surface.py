"""Surfaces as CAD programs and scanners write them, made fit to be filled with tetrahedra, and what was done to them.

The order is: weld, drop what repeats, turn neighbours the same way, close holes, find which shells lie inside which, choose the body.
A shell inside another one is a cavity (a chamber), whichever way its triangles face. Shells that cross each other become one body:
the filling takes what lies inside any of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.fem.mesh import closest_in_triangle

WELD = 1e-5
"""Points of open edges closer than this, over the diagonal, are one point."""
SMALL_HOLE = 0.1
"""A hole with a shorter border than this, over the diagonal, is closed without asking."""
DUST = 1e-6
"""A shell that encloses less than this share of the whole is left out."""
TOUCHING = 1e-4
"""Shells closer than this, over the diagonal, are one body."""
MOST_SHELLS = 3000
"""Surfaces in more pieces are refused: all of them would be compared with each other."""
SIDES_AT_ONCE = 200_000
"""So many sides of triangles are looked at together for where they go through others (memory)."""
MANY_TRIANGLES = 6000
"""Surfaces with more triangles than this are thinned out before they are filled …"""
MOST_TRIANGLES = 30_000
"""… and no more than this are filled, whatever the tolerance: with 250 000 triangles of a noisy scan fTetWild takes minutes."""
Progress = Callable[..., None]


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
    """What was done to the surface, in words."""

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def volume(self) -> float:
        """Enclosed volume, cavities taken off [unit³] (where shells cross, what they share counts twice)."""
        return float(_shell_volumes(self.points, self.triangles, np.zeros(len(self.triangles), dtype=np.int64))[0])

    @property
    def area(self) -> float:
        return float(np.linalg.norm(_area_vectors(self.points, self.triangles), axis=1).sum())


@dataclass(frozen=True, eq=False, slots=True)
class _Shells:
    """The connected pieces of a surface."""

    of: IntArray  # the shell of each triangle, (t,)
    volume: FloatArray  # signed, (s,)
    depth: IntArray  # how many other shells each one lies in, (s,)
    body: IntArray  # number of the body that each one belongs to, by falling volume, (s,)


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
    """Return a closed surface that can be filled, and what had to be done for it.

    Arguments:
        points, triangles: of the file, shapes (n, 3) and (t, 3).
        where: what a message names.
        close_holes: close holes of any size by flat fans, not only small ones.
        fill_cavities: take inner shells as solid.
        part: which of several separate bodies is meant, 1 the largest.
        unit: of the points, for messages.
        most_shells: a surface in more pieces is refused.

    Raises:
        InputError: not finite, flat, large holes, one-sided, several bodies and none chosen.
    """
    done: list[str] = []
    points, triangles = _tidied(points, triangles, where, done)
    triangles = _turned_alike(points, triangles, where, done)
    points, triangles = _closed(points, triangles, where, close_holes, unit, done)
    triangles = _without_dust(points, triangles, where, done)
    shells = _find_shells(points, triangles, where, most_shells)
    triangles, cavities = _faced(triangles, shells, fill_cavities, done)
    triangles, cavities = _chosen(points, triangles, shells, part, fill_cavities, cavities, where, unit, done)
    used, numbers = np.unique(triangles, return_inverse=True)
    return ClosedSurface(freeze(points[used]), freeze(numbers.reshape(-1, 3), np.int64), cavities, tuple(done))


# Points and triangles


def _tidied(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> tuple[FloatArray, IntArray]:
    """Weld points, drop triangles that repeat a point or another triangle."""
    check_finite(points, where)
    points, triangles = merged(points, triangles)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if len(_open_edges(triangles)):
        welded = _weld(points, triangles, WELD * diagonal)
        if len(_open_edges(welded)) < len(_open_edges(triangles)):
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
    if len(triangles) < 4 or np.ptp(points, axis=0).min() <= 1e-9 * diagonal:
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

    border = np.unique(_open_edges(triangles))
    pairs = cKDTree(points[border]).query_pairs(distance, output_type="ndarray")
    n = len(points)
    graph = sp.coo_matrix((np.ones(len(pairs)), (border[pairs[:, 0]], border[pairs[:, 1]])), shape=(n, n))
    labels = sp.csgraph.connected_components(graph, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    return np.asarray(first[labels][triangles])


def _directed_edges(triangles: IntArray) -> IntArray:
    """Return the sides of triangles as they go round, shape (3 t, 2), triangle by triangle."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)


def _open_edges(triangles: IntArray) -> IntArray:
    """Return the sides that only one triangle has, as they go round there, shape (e, 2)."""
    edges = _directed_edges(triangles)
    _, inverse, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(edges[count[inverse.reshape(-1)] == 1])


def shared_edges(triangles: IntArray) -> IntArray:
    """Return the sides that more than two triangles have, shape (e, 2)."""
    edges, count = np.unique(np.sort(_directed_edges(triangles), axis=1), axis=0, return_counts=True)
    return np.asarray(edges[count > 2])


def _turned_alike(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> IntArray:
    """Turn triangles so that neighbours go round the same way.

    Each triangle stands in a graph twice, as it is and turned; sides join what goes together. The two halves of a surface with two
    sides are not connected, and the half that turns fewer triangles is taken.
    """
    t = len(triangles)
    first, second, alike = _neighbours(triangles)
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


def _neighbours(triangles: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Return pairs of triangles with a side that no third one has, and whether they go round the same way, shapes (p,)."""
    edges = _directed_edges(triangles)
    owner = np.repeat(np.arange(len(triangles)), 3)
    _, inverse, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    pair = order[count[inverse[order]] == 2].reshape(-1, 2)
    alike = edges[pair[:, 0], 0] == edges[pair[:, 1], 1]
    return owner[pair[:, 0]], owner[pair[:, 1]], alike


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
    limit = np.inf if everything else SMALL_HOLE * float(np.linalg.norm(np.ptp(points, axis=0)))
    large = [(size, hole) for size, hole in zip(length, holes) if size > limit]
    if large:
        size, hole = max(large, key=lambda item: item[0])
        found = f"{len(large)} large hole{'s' * (len(large) > 1)} of {len(holes)}; the largest has a border of {size:.4g} {unit} around {_place(points, points[hole].mean(axis=0))}"
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


def _place(points: FloatArray, place: FloatArray) -> str:
    """Return a place in words, to a millionth of the size of the surface."""
    step = 1e-6 * float(np.ptp(points, axis=0).max())
    return "[" + ", ".join(f"{round(value / step) * step + 0.0:.4g}" for value in place.tolist()) + "]"


def _without_sheets(points: FloatArray, triangles: IntArray, loose: IntArray, where: str, done: list[str]) -> IntArray:
    """Leave out sheets that hang on the rest: open edges that do not come round bound them. Raises InputError where that is the most."""
    edges, labels = np.sort(_directed_edges(triangles), axis=1), _pieces(triangles)
    bounds = (edges[:, None] == np.sort(loose, axis=1)[None]).all(axis=2).any(axis=1)
    hangs = np.isin(labels, labels[np.flatnonzero(bounds) // 3])
    area = np.linalg.norm(_area_vectors(points, triangles), axis=1)
    if area[hangs].sum() > 0.5 * area.sum():
        raise InputError(
            "the surface is open",
            where=where,
            found=f"{len(loose)} edges of one triangle that go round no hole, the first at {_place(points, points[loose[0]].mean(axis=0))}",
            expected="a closed surface",
            hint="mend it in a mesh editor",
        )
    done.append(f"{len(np.unique(labels[hangs]))} sheets of {int(hangs.sum())} triangles that hang on the body were left out")
    return triangles[~hangs]


def _pieces(triangles: IntArray) -> IntArray:
    """Return the number of the piece that each triangle belongs to, joined by sides of two triangles, shape (t,)."""
    first, second, _ = _neighbours(triangles)
    graph = sp.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(triangles),) * 2)
    return np.asarray(sp.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def _holes(triangles: IntArray) -> tuple[list[IntArray], IntArray]:
    """Return the borders of the holes, each as its points in the order in which a closing triangle goes round, and open edges of none."""
    after: dict[int, list[int]] = {}
    for a, b in _open_edges(triangles).tolist():
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


# Shells


def _find_shells(points: FloatArray, triangles: IntArray, where: str, most: int) -> _Shells:
    of = _pieces(triangles)
    volume, count = _shell_volumes(points, triangles, of), int(of.max()) + 1
    if count > most:
        raise InputError(
            "the surface falls into too many pieces",
            where=where,
            found=f"{count} pieces of {len(triangles) / count:.1f} triangles on average",
            expected=f"a closed surface, or at most {most} shells",
            hint="merge equal points and remove what is inside, in a mesh editor",
        )
    if count == 1:
        return _Shells(of, volume, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
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
    meets |= inside & (depth[:, None] % 2 == 1) & (depth[None] == depth[:, None] - 1)  # a cavity belongs to what holds it
    body = sp.csgraph.connected_components(sp.csr_matrix(meets.astype(float)), directed=False)[1]
    size = np.zeros(body.max() + 1)
    np.add.at(size, body[depth % 2 == 0], np.abs(volume[depth % 2 == 0]))
    return _Shells(of, volume, depth, np.argsort(np.argsort(-size))[body])


def _meeting(
    points: FloatArray, triangles: IntArray, of: IntArray, corners: list[FloatArray], low: FloatArray, high: FloatArray
) -> BoolArray:
    """Return which shells cross or touch, shape (s, s); corners, low and high are those of each shell."""
    crossing = crossing_triangles(points, triangles)
    meets = np.zeros((len(corners),) * 2, dtype=bool)
    meets[of[crossing[:, 0]], of[crossing[:, 1]]] = True
    near = TOUCHING * float(np.linalg.norm(np.ptp(points, axis=0)))
    close = (low[:, None] <= high[None] + near).all(axis=2) & (high[:, None] >= low[None] - near).all(axis=2) & ~meets
    np.fill_diagonal(close, False)
    for j in np.flatnonzero(close.any(axis=0)):
        others = np.flatnonzero(close[:, j])
        away = distance_to(points, triangles[of == j], np.vstack([corners[i] for i in others]))
        ends = np.cumsum([len(corners[i]) for i in others])[:-1]
        meets[others, j] = [part.min() < near for part in np.split(away, ends)]
    return meets


def _shell_volumes(points: FloatArray, triangles: IntArray, of: IntArray) -> FloatArray:
    """Return the signed volume inside each shell, Σ a · (b × c) / 6, shape (s,)."""
    a, b, c = np.moveaxis(points[triangles] - points.mean(axis=0), 1, 0)
    return np.asarray(np.bincount(of, np.einsum("tc,tc->t", a, np.cross(b, c)) / 6.0), dtype=np.float64)


def _area_vectors(points: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return np.cross(b - a, c - a) / 2.0


def _without_dust(points: FloatArray, triangles: IntArray, where: str, done: list[str]) -> IntArray:
    of = _pieces(triangles)
    size = np.abs(_shell_volumes(points, triangles, of))
    if size.max() <= 1e-9 * float(np.linalg.norm(np.ptp(points, axis=0))) ** 3:
        raise InputError(
            "the surface encloses nothing",
            where=where,
            found=f"a volume of {size.max():.3g} in the unit of the file",
            expected="a closed surface around a volume",
        )
    dust = size < DUST * size.max()
    if not dust.any():
        return triangles
    done.append(f"{int(dust.sum())} shells that enclose next to nothing were left out")
    return np.asarray(triangles[~dust[of]])


def _faced(triangles: IntArray, shells: _Shells, fill: bool, done: list[str]) -> tuple[IntArray, int]:
    """Turn outer shells outward and inner ones, which are cavities, into the cavity."""
    inner = shells.depth % 2 == 1
    wrong = (shells.volume < 0) != inner
    if (wrong & ~inner).any():
        done.append(f"{int((wrong & ~inner).sum())} shells that were inside out were turned")
    if (wrong & inner).any() and not fill:
        done.append(f"{int((wrong & inner).sum())} inner shells were turned so that they are cavities")
    return np.where(wrong[shells.of][:, None], triangles[:, ::-1], triangles), int(inner.sum())


def _chosen(
    points: FloatArray,
    triangles: IntArray,
    shells: _Shells,
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


def _bodies_text(points: FloatArray, triangles: IntArray, shells: _Shells, unit: str) -> str:
    parts = []
    for body in range(min(int(shells.body.max()) + 1, 6)):
        own = points[triangles[(shells.body == body)[shells.of]]].reshape(-1, 3)
        size, middle = np.ptp(own, axis=0), (own.min(axis=0) + own.max(axis=0)) / 2.0
        parts.append(f"{body + 1}: {' × '.join(f'{v:.3g}' for v in size)} {unit} around {_place(points, middle)}")
    more = int(shells.body.max()) + 1 - len(parts)
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


# Geometry


def winding_number(corners: FloatArray, places: FloatArray) -> FloatArray:
    """Return how often triangles (t, 3, 3) wind around places (p, 3): 1 inside an outward surface, 0 outside, shape (p,).

    Sum of solid angles over 4π (van Oosterom and Strackee 1983).
    """
    result = np.empty(len(places))
    for i, place in enumerate(places):
        a, b, c = np.moveaxis(corners - place, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        ab, bc, ca = (np.einsum("tc,tc->t", u, v) for u, v in ((a, b), (b, c), (c, a)))
        result[i] = np.arctan2(np.einsum("tc,tc->t", a, np.cross(b, c)), la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (
            2.0 * np.pi
        )
    return result


def crossing_triangles(points: FloatArray, triangles: IntArray) -> IntArray:
    """Return pairs of triangles of which a side of the first goes through the second, shape (p, 2).

    Sides are rays into the triangles (Embree, single precision); what only touches does not count.
    """
    import open3d as o3d

    scaled, scene = _scene(points, triangles)
    edges = _directed_edges(triangles)
    rays = np.hstack([scaled[edges[:, 0]], scaled[edges[:, 1]] - scaled[edges[:, 0]]]).astype(np.float32)
    met = np.flatnonzero(scene.test_occlusions(o3d.core.Tensor(rays), tnear=1e-3, tfar=1.0 - 1e-3).numpy())
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for some in (met[i : i + SIDES_AT_ONCE] for i in range(0, len(met), SIDES_AT_ONCE)):
        hits = scene.list_intersections(o3d.core.Tensor(rays[some]))
        ray, other, t = (hits[key].numpy() for key in ("ray_ids", "primitive_ids", "t_hit"))
        ray, other = some[ray.astype(np.int64)], other.astype(np.int64)
        shares = (triangles[other][:, :, None] == edges[ray][:, None, :]).any(axis=(1, 2))
        real = ~shares & (t > 1e-3) & (t < 1 - 1e-3)
        pairs.append(np.stack([ray[real] // 3, other[real]], axis=1))
    return np.asarray(np.unique(np.vstack(pairs), axis=0).reshape(-1, 2))


def distance_to(points: FloatArray, triangles: IntArray, places: FloatArray) -> FloatArray:
    """Return the distance of places (p, 3) from a surface, in its unit, shape (p,)."""
    return np.asarray(np.linalg.norm(places - nearest_on(points, triangles, places), axis=1))


def nearest_on(points: FloatArray, triangles: IntArray, places: FloatArray) -> FloatArray:
    """Return the points of a surface that are nearest to places (p, 3), shape (p, 3).

    The nearest triangle is found in single precision, the point in it in double.
    """
    import open3d as o3d

    centre, size = points.mean(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    _, scene = _scene(points, triangles)
    nearest = scene.compute_closest_points(o3d.core.Tensor(((places - centre) / size).astype(np.float32)))["primitive_ids"]
    corners = points[triangles[nearest.numpy().astype(np.int64)]]
    return np.asarray(np.einsum("pi,pic->pc", closest_in_triangle(corners, places), corners))


def wall_thickness(points: FloatArray, triangles: IntArray, places: FloatArray, inward: FloatArray) -> FloatArray:
    """Return how far it is from places just inside of the surface, along unit vectors, to the next wall, shape (p,); inf: none."""
    import open3d as o3d

    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    _, scene = _scene(points, triangles)
    start = (places - centre) / size + 1e-4 * inward
    hit = scene.cast_rays(o3d.core.Tensor(np.hstack([start, inward]).astype(np.float32)))["t_hit"].numpy()
    return np.asarray((hit.astype(np.float64) + 1e-4) * size)


def _scene(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, Any]:
    """Return the points scaled to about one around zero, and the triangles as Open3D casts rays into them."""
    import open3d as o3d

    scaled = (points - points.mean(axis=0)) / max(float(np.ptp(points, axis=0).max()), 1e-300)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(scaled.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    return scaled, scene


# Fewer triangles


def thinned(
    surface: ClosedSurface, *, tolerance: float, start: ClosedSurface | None = None, enough: int = MANY_TRIANGLES
) -> tuple[ClosedSurface, float]:
    """Return a surface with fewer triangles that stays near, and how far it strays [unit of the file].

    Edges are drawn together where that costs least (quadric error metrics, Garland and Heckbert 1997, as Open3D has them). The
    number of triangles is halved as long as no point of one surface is farther than the tolerance from the other, and, however
    far, until at most MOST_TRIANGLES are left (a scan whose noise is larger than the tolerance). Each surface is made from the
    one before it, so that the whole costs about as much as one reduction.

    Arguments:
        surface: closed.
        tolerance: allowed distance in the unit of the file.
        start: what was returned for a smaller tolerance, to go on from.
        enough: so many triangles are fine; fewer are not asked for.
    """
    kept = start or surface
    away = 0.0 if kept is surface else _strays(surface, kept.points, kept.triangles)
    while len(kept.triangles) > enough:
        points, triangles = _simplified(kept.points, kept.triangles, max(enough, len(kept.triangles) // 2))
        strays = _strays(surface, points, triangles)
        stuck = len(_open_edges(triangles)) or len(triangles) > 0.9 * len(kept.triangles)
        if stuck or (strays > tolerance and len(kept.triangles) <= MOST_TRIANGLES):
            break
        done = (*surface.done, f"thinned out from {len(surface.triangles)} to {len(triangles)} triangles")
        kept, away = ClosedSurface(freeze(points), freeze(triangles, np.int64), surface.cavities, done), strays
    return kept, away


def _simplified(points: FloatArray, triangles: IntArray, wanted: int) -> tuple[FloatArray, IntArray]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points.copy()), o3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    thin = mesh.simplify_quadric_decimation(wanted)
    return np.asarray(thin.vertices), np.asarray(thin.triangles, dtype=np.int64)


def _strays(surface: ClosedSurface, points: FloatArray, triangles: IntArray) -> float:
    """Return the largest distance of points and middles of either surface from the other."""
    middles = points[triangles].mean(axis=1)
    out = distance_to(surface.points, surface.triangles, np.vstack([points, middles])).max()
    back = distance_to(points, triangles, surface.points).max()
    return float(max(out, back))
