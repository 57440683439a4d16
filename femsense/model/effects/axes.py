"""The axis of a body: where it begins, where it ends, and two directions across it."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.body import BodyModel
from femsense.fem.mesh import element_volumes
from femsense.model.effects.base import Entry

SHORTEST = 1e-6
"""Two points that are nearer to each other [m] make no axis."""


def axis_of(body: BodyModel) -> FloatArray:
    """Return the axis of a body at rest [m], shape (2, 3): through its centre of volume along its longest direction,
    from the clamp to the far end."""
    nodes = body.mesh.nodes
    centre, along = _longest(nodes[body.mesh.tets[:, :4]], element_volumes(body.mesh))
    held = body.clamp_center if len(body.clamp_nodes) else centre - along
    along = along if (centre - held) @ along >= 0 else -along
    places = (nodes - centre) @ along
    clamped = places[body.clamped]
    first = clamped.max() if len(clamped) and clamped.max() < 0.0 else places.min()  # clamped points stay fixed
    return np.array([centre + first * along, centre + places.max() * along])


def _longest(corners: FloatArray, volumes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the centre of volume [m] and the longest direction of tetrahedra (m, 4, 3): of the largest second moment,
    which is exact."""
    share = volumes / volumes.sum()
    centre = share @ corners.mean(axis=1)
    x = corners - centre
    sums = x.sum(axis=1)
    moments = np.einsum("m,mai,maj->ij", share, x, x) + np.einsum("m,mi,mj->ij", share, sums, sums)
    return centre, np.asarray(np.linalg.eigh(moments)[1][:, -1])


def axis_from(entry: Entry, where: str) -> FloatArray:
    """Return the two points of `axis_m` [m], shape (2, 3). Raises InputError."""
    try:
        axis = np.asarray(entry.get("axis_m"), dtype=np.float64)
    except (TypeError, ValueError):
        axis = np.zeros(0)
    if axis.shape != (2, 3) or not np.isfinite(axis).all() or np.linalg.norm(axis[1] - axis[0]) < SHORTEST:
        found, expected = entry.get("axis_m"), "two points in metres that are apart: [[x, y, z], [x, y, z]]"
        raise InputError("not an axis", where=f"{where}.axis_m", found=found, expected=expected)
    return axis


def along_axis(axis: FloatArray, points: FloatArray) -> FloatArray:
    """Return the coordinates of points (p, 3) along an axis (2, 3), from its first point [m], shape (p,)."""
    return np.asarray((points - axis[0]) @ _unit(axis[1] - axis[0]))


def across_axis(axis: FloatArray) -> FloatArray:
    """Return the axis' direction and two across it, right-handed unit vectors, shape (3, 3).

    The second is closest to the axis x, y or z of the robot that is most transverse to the axis.
    """
    along = _unit(axis[1] - axis[0])
    own = np.eye(3)[int(np.argmin(np.round(np.abs(along), 9)))]
    first = _unit(own - (own @ along) * along)
    return np.array([along, first, np.cross(along, first)])


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
