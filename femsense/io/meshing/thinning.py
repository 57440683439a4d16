"""Fewer triangles for a surface that is to be filled with tetrahedra."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.io.meshing.surface import ClosedSurface
from femsense.io.meshing.surface_queries import distance_to, open_edges

MANY_TRIANGLES = 6000
"""Surfaces with more triangles than this are thinned out before they are filled …"""
MOST_TRIANGLES = 30_000
"""… and no more than this are filled, whatever the tolerance: with 250 000 triangles of a noisy scan fTetWild takes minutes."""


def thinned(
    surface: ClosedSurface, *, tolerance: float, start: ClosedSurface | None = None, enough: int = MANY_TRIANGLES
) -> tuple[ClosedSurface, float]:
    """Return a surface with fewer triangles that stays near, and how far it deviates [unit of the file].

    Edges are collapsed in the order of their quadric error (Garland and Heckbert 1997, implementation of Open3D). The
    number of triangles is halved as long as no point of one surface is farther than the tolerance from the other, and, however
    far, until at most MOST_TRIANGLES are left (a scan whose noise is larger than the tolerance). Each surface is made from the previous
    one, so that the total cost is about that of one reduction.

    Arguments:
        surface: closed.
        tolerance: allowed distance in the unit of the file.
        start: result for a smaller tolerance, to continue from.
        enough: number of triangles at which thinning stops.
    """
    kept = start or surface
    away = 0.0 if kept is surface else _deviation(surface, kept.points, kept.triangles)
    while len(kept.triangles) > enough:
        points, triangles = _simplified(kept.points, kept.triangles, max(enough, len(kept.triangles) // 2))
        deviation = _deviation(surface, points, triangles)
        stuck = len(open_edges(triangles)) or len(triangles) > 0.9 * len(kept.triangles)
        if stuck or (deviation > tolerance and len(kept.triangles) <= MOST_TRIANGLES):
            break
        done = (*surface.done, f"thinned out from {len(surface.triangles)} to {len(triangles)} triangles")
        kept, away = ClosedSurface(freeze(points), freeze(triangles, np.int64), surface.cavities, done), deviation
    return kept, away


def _simplified(points: FloatArray, triangles: IntArray, wanted: int) -> tuple[FloatArray, IntArray]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points.copy()), o3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    thin = mesh.simplify_quadric_decimation(wanted)
    return np.asarray(thin.vertices), np.asarray(thin.triangles, dtype=np.int64)


def _deviation(surface: ClosedSurface, points: FloatArray, triangles: IntArray) -> float:
    """Return the largest distance of points and middles of either surface from the other."""
    middles = points[triangles].mean(axis=1)
    out = distance_to(surface.points, surface.triangles, np.vstack([points, middles])).max()
    back = distance_to(points, triangles, surface.points).max()
    return float(max(out, back))
