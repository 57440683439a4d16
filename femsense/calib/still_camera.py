"""Whether a camera stood still: two poses, before and after some frame, against one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.calib.checks import EXPLAINED, SUSPICIOUS, Pairs, rigid_rms
from femsense.core.errors import DataError
from femsense.model.recording import Recording
from femsense.model.robot import Robot

FEWEST, MARKERS = 4, 4
"""Least number of frames, and of markers before and after."""
WIDE = 0.2
"""Markers closer together than this fraction of the body's diagonal move together under any model error, and are not used."""


def check_camera_still(robot: Robot, recording: Recording, pairs: Sequence[Pairs]) -> None:
    """Refuse a camera that moved between two frames: separate poses before and after fit far better than one.

    Arguments:
        robot, recording: to be calibrated.
        pairs: the markers of each camera.

    Raises:
        DataError: states the two frames.
    """
    diagonal = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    for name, one in zip(recording.camera_names, pairs):
        frames = np.unique(one.group)
        if len(frames) < FEWEST or one.spread < WIDE * diagonal:
            continue
        plain = rigid_rms(one.modelled, one.measured)
        if plain < SUSPICIOUS * one.spread:
            continue
        split, left = min(((k, _two_poses(one, k)) for k in frames[1:].tolist()), key=lambda pair: pair[1])
        if left * EXPLAINED < plain:
            last = int(recording.frame_numbers[frames[frames < split].max()])
            raise DataError(
                f"camera {name or '(only one)'} or the robot's base seems to have moved between frames {last} and "
                f"{int(recording.frame_numbers[split])}: with a pose of their own before and after, the markers fit to "
                f"{1e3 * left:.3g} mm instead of {1e3 * plain:.3g} mm. Calibrate the frames of one pose: make two recordings of it"
            )


def _two_poses(pairs: Pairs, split: int) -> float:
    """Return the rms residual [m] with two poses, the second one from a given frame on."""
    squares = 0.0
    for mine in (pairs.group < split, pairs.group >= split):
        if mine.sum() < MARKERS:
            return np.inf
        squares += mine.sum() * rigid_rms(pairs.modelled[mine], pairs.measured[mine]) ** 2
    return float(np.sqrt(squares / len(pairs.group)))
