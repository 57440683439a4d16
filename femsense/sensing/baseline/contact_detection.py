"""Contact detection by distance between robot points and surrounding points.

Source: "Calibration and force sensing with an RGB-D camera", section V.A.3–4, Algorithm 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.pointcloud.grid import build_grid, count_within, positive
from femsense.pointcloud.objects import euclidean_clusters


@dataclass(frozen=True, eq=False, slots=True)
class Contacts:
    """Contact points, in order of decreasing number of points."""

    positions: FloatArray
    """Mean of each group of contact points [m], shape [k, 3]."""
    counts: IntArray
    """Number of surrounding points in each group, shape [k]."""
    radius: FloatArray
    """Root mean square distance of a group's points from their mean: the size of the contact patch [m], shape [k]."""

    def __len__(self) -> int:
        return len(self.counts)


def detect_contacts(
    surroundings: npt.ArrayLike,
    robot: npt.ArrayLike,
    *,
    search_radius_m: float,
    min_neighbors: int,
    cluster_distance_m: float,
    min_points: int = 1,
) -> Contacts:
    """Return the contact points of a frame (Algorithm 2).

    A surrounding point touches if at least min_neighbors robot points lie within search_radius_m of it. Touching points that are closer to
    each other than cluster_distance_m form a group, and the mean of a group is a contact point.

    Arguments:
        surroundings: points that do not belong to the robot [m], shape (m, 3).
        robot: points of the robot [m], shape (r, 3).
        search_radius_m: [m]; larger than the spacing of the points and the noise.
        min_neighbors: minimum number of robot points, at least 1.
        cluster_distance_m: minimum distance between two groups [m].
        min_points: minimum number of points of a group.
    Returns:
        the contacts, ordered by decreasing count, then by x, y, z; empty if there is none.
    Raises:
        InputError: wrong shapes, or numbers that are not positive.
    """
    others, body = as_points(surroundings, "surroundings"), as_points(robot, "robot")
    radius = positive(search_radius_m, "search_radius_m")
    enough = _at_least_one(min_neighbors, "min_neighbors")
    touching = others[count_within(build_grid(body, radius), others, radius, enough=enough) >= enough]
    groups = euclidean_clusters(touching, cluster_distance_m, _at_least_one(min_points, "min_points"))
    return _contacts(touching[groups >= 0], groups[groups >= 0])


def _contacts(points: FloatArray, groups: IntArray) -> Contacts:
    counts = np.bincount(groups)
    if len(counts) == 0:
        return Contacts(freeze(np.zeros((0, 3))), freeze([], np.int64), freeze([]))
    means = np.stack([np.bincount(groups, weights=column) for column in points.T], axis=1) / counts[:, None]
    spread = np.bincount(groups, weights=((points - means[groups]) ** 2).sum(axis=1)) / counts
    order = np.lexsort((means[:, 2], means[:, 1], means[:, 0], -counts))
    return Contacts(freeze(means[order]), freeze(counts[order], np.int64), freeze(np.sqrt(spread[order])))


def _at_least_one(value: int, name: str) -> int:
    if int(value) < 1:
        raise InputError(f"{name} must be at least 1", where=name, found=value, expected="≥ 1")
    return int(value)
