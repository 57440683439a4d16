"""Whether a mesh can be computed with."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import IntArray
from femsense.core.errors import InputError
from femsense.fem.closest_point import FACES
from femsense.fem.mesh import TetMesh, body_parts, element_volumes


def check_mesh(mesh: TetMesh, where: str) -> None:
    """Refuse meshes that cannot be computed: no elements, flat or inverted ones, unused nodes, loose parts. Raises InputError.

    Parts connected by an edge or a corner only can be computed but act as hinges; this is a warning.
    """
    if not len(mesh.tets):
        raise InputError("the mesh has no tetrahedra", where=where, expected="tetrahedra (tetra or tetra10 cells)")
    volumes = element_volumes(mesh)
    size = np.median(np.abs(volumes))
    flat = np.flatnonzero(np.abs(volumes) <= 1e-9 * size)
    if len(flat):
        raise InputError(
            "tetrahedra without volume",
            where=where,
            found=f"{len(flat)}, the first is number {flat[0]}",
            expected="positive volumes",
            hint="femsense mesh SURFACE -o ROBOT makes a sound mesh",
        )
    inverted = np.flatnonzero(volumes < 0)
    if len(inverted):
        raise InputError(
            "inverted tetrahedra",
            where=where,
            found=f"{len(inverted)} of {len(volumes)}, the first is number {inverted[0]}",
            expected="node order with positive volume",
            hint="swap two nodes of each inverted tetrahedron",
        )
    parts = body_parts(mesh)
    if (parts < 0).any():
        raise InputError(
            "nodes that belong to no tetrahedron",
            where=where,
            found=f"{int((parts < 0).sum())}, the first is number {int(np.flatnonzero(parts < 0)[0])}",
            expected="every node in an element",
            hint="remove the unused nodes",
        )
    if parts.max() > 0:
        raise InputError(
            "the mesh falls into separate parts",
            where=where,
            found=f"{parts.max() + 1} parts of {np.bincount(parts).tolist()} nodes",
            expected="one connected body",
            hint="merge duplicate nodes, or keep one part",
        )
    hinged = np.bincount(hinged_parts(mesh))
    if len(hinged) > 1:
        warnings.warn(
            (
                f"{where}: {len(hinged)} parts of {np.sort(hinged)[::-1][:6].tolist()} tetrahedra hang together by an edge "
                f"or a corner alone and swing about it"
            ),
            stacklevel=3,
        )


def hinged_parts(mesh: TetMesh) -> IntArray:
    """Return the index of the face-connected part of each element, shape (m,).

    Parts that share only an edge or a corner act as hinges."""
    m, n = len(mesh.tets), len(mesh.nodes)
    faces = np.sort(mesh.tets[:, FACES].reshape(-1, 3).astype(np.int64), axis=1)
    keys = (faces[:, 0] * n + faces[:, 1]) * n + faces[:, 2]
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    pairs = order[same] // 4, order[same + 1] // 4
    graph = sp.coo_matrix((np.ones(len(same)), pairs), shape=(m, m))
    return np.asarray(sp.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)
