"""Whether markers are as far apart as on the robot: another unit shows before anything is fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from femsense.core.arrays import FloatArray, rows_alike
from femsense.core.errors import DataError
from femsense.model.recording import Recording
from femsense.model.robot import Robot

UNITS = {1e3: "millimetres", 1e2: "centimetres", 39.37: "inches", 3.281: "feet", 1e6: "micrometres", 1e-3: "kilometres"}
"""Ratio of marker distances to those of the robot → the unit that it indicates."""
APART, NEAR = 2.0, 0.2
"""Ratios of marker distances beyond which another unit is assumed: no silicone stretches or coils that far."""
SMALLEST, LARGEST = 0.02, 2.0
"""A robot's markers span between these [m]: those of the robots in meshes/ span 0.06 to 0.25 m, in centimetres that would read 6 to 25."""
FARTHEST = 10.0
"""Markers that span more [m] are no robot's: depth cameras see less far."""
FEWEST = 3
"""Least number of markers in a frame."""


def unit_hint(scale: float) -> str:
    """Return, as a question, in which unit numbers may be that are `scale` times too large."""
    nearest = min(UNITS, key=lambda known: abs(np.log(scale / known)))
    return f"are they in {UNITS[nearest]}?" if abs(np.log(scale / nearest)) < 0.25 else "is the robot's mesh.unit right?"


def check_marker_distances(robot: Robot, recording: Recording) -> None:
    """Refuse markers whose distances are far from those of the robot's; the median over frames counts.

    Arguments:
        robot: with its markers at rest.
        recording: its markers' names are the robot's.

    Raises:
        DataError: states the factor by which they are too large, and the likely unit.
    """
    r, number = recording, {name: i for i, name in enumerate(robot.marker_names)}
    rest = np.array([robot.marker_points[number[name]] for name in r.marker_names]).reshape(-1, 3)
    ratios = []
    for rows in rows_alike(r.marker_frame, r.marker_view):
        own = _size(rest[r.marker_index[rows]]) if len(rows) >= FEWEST else 0.0
        if own > 0.0:
            ratios.append(_size(r.marker_xyz[rows]) / own)
    _check_scale(float(np.median(ratios)) if ratios else 1.0, "the robot", unit_hint)


def check_marker_sizes(measured: Sequence[FloatArray] | FloatArray, known: Sequence[FloatArray] | FloatArray) -> None:
    """Refuse markers [m], n arrays (k, 3), whose size differs much from that of the modelled markers of the same rows, n arrays (m, 3).

    Raises DataError, as `check_marker_distances`.
    """
    own = np.array([_size(points) for points in known])
    ratios = [_size(points) / size for points, size in zip(measured, own) if size > 0.0 and len(points) >= FEWEST]
    _check_scale(float(np.median(ratios)) if ratios else 1.0, "the model", _unit_question)


def doubt_of_size(points: FloatArray) -> str:
    """Return a question about the unit of markers, shape (n, m, 3), that are farther apart than those of a robot; empty if they are not.

    Used if the size of the robot is unknown.
    """
    across = span(points)
    if not across > LARGEST:
        return ""
    meant = [f"in {UNITS[times]} ({across / times:.2g} m)" for times in (1e3, 1e2) if SMALLEST < across / times < LARGEST]
    return f"the markers span {across:.4g} m: are they {' or '.join(meant) or 'in another unit'}? The file holds metres"


def span(points: FloatArray) -> float:
    """Return how far markers (n, m, 3) are apart, in all rows together [m]; a few that are lost do not count."""
    low, high = np.quantile(points.reshape(-1, 3), [0.01, 0.99], axis=0)
    return float(np.linalg.norm(high - low))


def _check_scale(scale: float, than: str, hint: Callable[[float], str]) -> None:
    if not NEAR < scale < APART:
        raise DataError(
            f"the markers do not fit {than}: by their distances they are {scale:.4g} times too large: {hint(max(scale, 1e-12))} "
            f"The files hold metres"
        )


def _unit_question(scale: float) -> str:
    return unit_hint(scale).replace("is the robot's mesh.unit right?", "are they of the same robot?")


def _size(points: np.ndarray) -> float:
    """Return the median distance of points (k, 3) from their median: one that is lost does not move it."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
