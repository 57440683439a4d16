"""Hollow bodies for tests: a spherical shell and a bar with a cavity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from helpers import block_mesh

from femsense.fem.mesh import TetMesh, oriented, to_quadratic


def without_box(mesh: TetMesh, low: Sequence[float], high: Sequence[float]) -> TetMesh:
    """Return a linear mesh without the tetrahedra whose centres lie in a box [m]."""
    centres = mesh.nodes[mesh.tets].mean(axis=1)
    kept = mesh.tets[~((centres > low) & (centres < high)).all(axis=1)]
    used, tets = np.unique(kept, return_inverse=True)
    return TetMesh(mesh.nodes[used], tets.reshape(-1, 4))


def hollow_bar(
    *, quadratic: bool = False, cells: Sequence[int] = (6, 3, 3), size: Sequence[float] = (0.1, 0.03, 0.03)
) -> TetMesh:
    """Return a bar along x with a cavity that leaves one layer of cells at its ends, one below and one at its sides."""
    step = np.asarray(size) / np.asarray(cells)
    mesh = without_box(block_mesh(cells, size), step, np.asarray(size) - step)
    return to_quadratic(mesh) if quadratic else mesh


def shell(inner: float, outer: float, *, layers: int = 2, subdivisions: int = 2, quadratic: bool = False) -> TetMesh:
    """Return a spherical shell of prisms, each split into three tetrahedra;
    mid-edge nodes of a quadratic one lie on their sphere."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    directions, triangles = np.array(ball.vertices), np.sort(np.array(ball.faces), axis=1)
    radii = np.linspace(inner, outer, layers + 1)
    n = len(directions)
    nodes = np.concatenate([r * directions for r in radii])
    tets = []
    for layer in range(layers):
        a, b, c = (triangles + layer * n).T
        d, e, f = (triangles + (layer + 1) * n).T
        tets += [np.stack(t, axis=1) for t in ((a, b, c, f), (a, b, f, e), (a, e, f, d))]
    mesh = oriented(TetMesh(nodes, np.concatenate(tets)))
    if not quadratic:
        return mesh
    mesh = to_quadratic(mesh)
    x = mesh.nodes.copy()
    ends = x[mesh.tets[:, [0, 1, 0, 0, 1, 2]]], x[mesh.tets[:, [1, 2, 2, 3, 3, 3]]]
    middle = (np.linalg.norm(ends[0], axis=2) + np.linalg.norm(ends[1], axis=2)) / 2
    x[mesh.tets[:, 4:]] *= (middle / np.linalg.norm(x[mesh.tets[:, 4:]], axis=2))[..., None]
    return TetMesh(x, mesh.tets)
