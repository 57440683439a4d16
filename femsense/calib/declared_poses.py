"""Declared camera poses: their prior, and how far one lies from a pose that is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, transform_points
from femsense.model.recording import Recording
from femsense.model.recording_checks import camera_text

DECLARED_STD = np.repeat([np.radians(0.5), 1e-3], 3)
"""Prior standard deviation of a declared pose when clouds are fitted: rotation [rad] and translation [m] along each axis
(trial: docs/appendix/forces-before-0.2.md)."""
REMEDY = "Leave T_robot_camera out of recording.toml to have it fitted, or declare it in the robot's frame."


def pose_error(
    recording: Recording,
    views: Sequence[int],
    declared: Sequence[FloatArray],
    fitted: Sequence[FloatArray],
    middles: Sequence[FloatArray],
) -> str:
    """Return a clause with the difference between declared and fitted poses.

    Arguments:
        recording: the recording, with the names of its cameras.
        views: indices of the cameras.
        declared, fitted: T_robot_camera of all cameras, shape (4, 4) each.
        middles: point at which the translation is stated, one per view [m], shape (3,).
    """
    names = [recording.camera_names[v] for v in views]
    off = [_difference(declared[v], fitted[v], middle) for v, middle in zip(views, middles)]
    if len(views) == 1:
        return f"the declared pose of {camera_text(names[0])} is {off[0]}"
    each = "; that of ".join(f"{name} is {text}" for name, text in zip(names, off))
    return f"the declared poses of cameras {', '.join(names)} are off: that of {each}"


def _difference(declared: FloatArray, fitted: FloatArray, middle: FloatArray) -> str:
    apart = declared @ invert_pose(fitted)
    turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(apart[:3, :3]) - 1.0), -1.0, 1.0)))
    shift = transform_points(apart, middle[None])[0] - middle
    along = ", ".join(f"{1e3 * x:.2g}" for x in shift)
    return f"turned by {turn:.2g}° and shifted by {1e3 * np.linalg.norm(shift):.3g} mm ({along}) at the body"
