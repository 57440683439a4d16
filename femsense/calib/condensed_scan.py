"""Points of one face as few: neighbours that say the same are averaged, and nothing that the rows could tell is lost.

Within a face of the surface the rows of a scan are linear in the place that a ray meets (displacements, pose), or vary by little (errors that
neighbours share). The mean of some points of one face is therefore worth as much as the points themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.scan import OFF, Scan, pixel_of
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.model.camera import CameraNoise
from femsense.pointcloud.rays import Surface, SurfaceHits

STEEPEST = 4.0
"""Surfaces are averaged whose depth changes by less than so many times the way along the image: 76° of incidence."""
WHOLE = 6
"""A face with more points than this is parted in three, each around one of its corners."""


def condensed(scan: Scan, surface: Surface, poses: Sequence[FloatArray], noises: Sequence[CameraNoise], *, reach: float) -> Scan:
    """Return the scan with the robot's points averaged that lie on one part of one face; points that stand out stay alone.

    Arguments:
        scan: what was seen, the robot's points apart.
        surface: the surface of a state near by.
        poses, noises: of the cameras.
        reach: see `Surface.cast` [m].
    """
    points = scan.points(poses)
    hits = surface.cast(points, scan.origins(poses), reach=reach)
    if not len(hits.index):
        return scan
    std = scan.ray_std(noises)[hits.index] * np.maximum(hits.cosine, 1e-3)
    group = _parts(hits, scan.view[hits.index], len(surface.positions))
    alone = np.ones(len(points), dtype=bool)
    alone[hits.index[_typical(hits.distance, std, group)]] = False
    own = np.flatnonzero(~alone[hits.index])
    order = own[np.argsort(group[own], kind="stable")]
    start = np.flatnonzero(np.diff(group[order], prepend=-1))
    number = np.diff(np.append(start, len(order))).astype(np.float64)
    members, rest = hits.index[order], np.flatnonzero(alone)
    mean = np.add.reduceat(hits.distance[order], start) / number
    inner = np.add.reduceat((hits.distance[order] - np.repeat(mean, number.astype(np.int64))) ** 2, start) / number
    middle = np.add.reduceat(scan.camera_points[members], start, axis=0) / number[:, None]
    return replace(
        scan,
        camera_points=freeze(np.vstack([middle, scan.camera_points[rest]])),
        view=freeze(np.concatenate([scan.view[members[start]], scan.view[rest]]), np.int64),
        count=freeze(np.concatenate([number, np.ones(len(rest))])),
        scatter=freeze(np.concatenate([inner, np.zeros(len(rest))])),
    )


def _parts(hits: SurfaceHits, view: IntArray, nodes: int) -> IntArray:
    """Return the part of a face that each hit lies on, of one camera: the whole face, or what is nearest to one of its corners."""
    face = (view * nodes + hits.nodes[:, 0]) * nodes + hits.nodes[:, 1]
    _, index, number = np.unique(face, return_inverse=True, return_counts=True)
    index = index.ravel()
    return np.asarray(3 * index + np.where(number[index] > WHOLE, np.argmax(hits.weights, axis=1), 0))


def _typical(distance: FloatArray, std: FloatArray, group: IntArray) -> IntArray:
    """Return which hits lie where most of their group do: flying pixels are not averaged."""
    order = np.lexsort((distance, group))
    start = np.flatnonzero(np.diff(group[order], prepend=-1))
    number = np.diff(np.append(start, len(order)))
    middle = 0.5 * (distance[order[start + (number - 1) // 2]] + distance[order[start + number // 2]])
    return np.sort(order[np.abs(distance[order] - np.repeat(middle, number)) < OFF * std[order]])


def in_blocks(scan: Scan, noises: Sequence[CameraNoise], most: int) -> Scan:
    """Return the scan with neighbouring pixels of the robot averaged, about so many at most, where their depth is continuous.

    Pixels are grouped in square blocks of the image of each camera. The mean of points of a plane is a point of the plane.

    Arguments:
        noises: of the cameras.
        most: points with fewer stay as they are.
    """
    if len(scan.view) <= most:
        return scan
    rays = scan.camera_points[:, :2] / scan.camera_points[:, 2:]
    pixel = np.array([pixel_of(scan, view) for view in range(len(noises))])[scan.view]
    side = np.ceil(np.sqrt(len(scan.view) / most)) * np.maximum(pixel, 1e-9)
    cell = np.floor(rays / side[:, None]).astype(np.int64)
    cell -= cell.min(axis=0)
    key = (scan.view * (int(cell[:, 0].max()) + 1) + cell[:, 0]) * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    number = np.diff(np.append(start, len(order)))
    z = scan.camera_points[order, 2]
    deep = np.maximum.reduceat(z, start) - np.minimum.reduceat(z, start)
    allowed = 6.0 * scan.ray_std(noises)[order][start] + STEEPEST * (side * scan.camera_points[:, 2])[order][start]
    one = deep <= allowed
    members = np.repeat(one, number)
    middle = np.add.reduceat(scan.camera_points[order], start, axis=0)[one] / number[one, None]
    alone = order[~members]
    return replace(
        scan,
        camera_points=freeze(np.vstack([middle, scan.camera_points[alone]])),
        view=freeze(np.concatenate([scan.view[order[start[one]]], scan.view[alone]]), np.int64),
        count=freeze(np.concatenate([number[one].astype(np.float64), np.ones(len(alone))])),
    )
