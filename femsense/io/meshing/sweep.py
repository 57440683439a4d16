"""Tetrahedra of a body along a line: rings around an axis in layers, each cell a prism of three tetrahedra.

A layer is a polar grid: a fan of triangles around the axis, then rings of quadrilaterals of two triangles.
Cavities are omitted cells. Prisms are split by the order of their nodes, reversed in every second layer, so that neighbours match and the
mesh has no preferred direction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, oriented
from femsense.io.meshing.line_sections import Section, hole_outline, outline


@dataclass(frozen=True, eq=False, slots=True)
class Layer:
    """A cross-section of the mesh."""

    center: FloatArray
    """[m], shape (3,)."""
    axes: FloatArray
    """Unit vectors of angle 0 and of 90°, shape (2, 3)."""
    section: Section
    """Its hole, where it has one, is the boundary of the fan."""
    levels: FloatArray
    """Where the rings are between axis and outline, rising to 1 [1], shape (r,)."""


Kept = Callable[[int, IntArray, IntArray], BoolArray]


def sweep(layers: Sequence[Layer], angles: FloatArray, keep: Kept) -> tuple[TetMesh, IntArray]:
    """Return the tetrahedra between layers, and the layer of each node.

    Arguments:
        layers: two at least, with the same number of rings.
        angles: of the corners around the axis [rad], rising within one turn, shape (n,).
        keep: (number of the slab between two layers, rings (c,), sectors (c,)) → which of these cells belong to the body, (c,).

    Raises:
        InputError: no cells, or inverted ones.
    """
    grids = np.array([_grid(layer, angles) for layer in layers])
    triangles, rings, sectors = polar_triangles(len(layers[0].levels), len(angles))
    each = grids.shape[1]
    tets = [
        _prisms(triangles[np.asarray(keep(k, rings, sectors), dtype=bool)], k, each, turned=bool(k % 2))
        for k in range(len(layers) - 1)
    ]
    used, numbers = np.unique(np.vstack(tets), return_inverse=True)
    if not len(used):
        raise InputError("no cell remains", where="chambers", expected="cavities that leave something of the body")
    mesh = oriented(TetMesh(grids.reshape(-1, 3)[used], numbers.reshape(-1, 4)))
    return mesh, used // each


def polar_triangles(rings: int, sectors: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the triangles of a polar grid (t, 3) with the ring and the sector of each, shapes (t,).

    Node 0 is the axis; node 1 + r · sectors + s is corner s of ring r.
    """
    sector = np.arange(sectors)
    after = (sector + 1) % sectors
    parts = [np.stack([0 * sector, 1 + sector, 1 + after], axis=1)]
    ring, side = [np.zeros(sectors, dtype=np.int64)], [sector]
    for r in range(1, rings):
        a, b = 1 + (r - 1) * sectors + sector, 1 + (r - 1) * sectors + after
        c, d = a + sectors, b + sectors
        even = (sector % 2 == 0)[:, None]
        parts.append(np.where(even, np.stack([a, c, d], axis=1), np.stack([a, c, b], axis=1)))
        parts.append(np.where(even, np.stack([a, d, b], axis=1), np.stack([b, c, d], axis=1)))
        ring += [np.full(2 * sectors, r)]
        side += [sector, sector]
    return np.vstack(parts), np.concatenate(ring), np.concatenate(side)


def _grid(layer: Layer, angles: FloatArray) -> FloatArray:
    """Return the nodes of a layer [m], shape (1 + r n, 3)."""
    rim = outline(layer.section, angles)
    levels = layer.levels[:, None, None]
    flat = levels * rim
    if layer.section.hole_width > 0:
        hole = hole_outline(layer.section, angles)
        share = (levels - levels[0]) / (1.0 - levels[0])
        flat = hole + share * (rim - hole)
    return np.asarray(layer.center + np.vstack([np.zeros((1, 2)), flat.reshape(-1, 2)]) @ layer.axes)


def _prisms(triangles: IntArray, layer: int, each: int, *, turned: bool) -> IntArray:
    """Return three tetrahedra for each triangle between a layer and the next, shape (3 t, 4)."""
    ordered = np.sort(triangles, axis=1) + layer * each
    low, high = (ordered + each, ordered) if turned else (ordered, ordered + each)
    a, b, c = low.T
    d, e, f = high.T
    return np.vstack([np.stack(t, axis=1) for t in ((a, b, c, f), (a, b, e, f), (a, d, e, f))])
