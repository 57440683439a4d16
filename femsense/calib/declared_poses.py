"""Whether a pose that is declared can be that of the camera: a pose that is fitted to the same data tells how far it is off."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.checks import EXPLAINED, SUSPICIOUS, Pairs, rigid_rms
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, transform_points
from femsense.model.recording import Recording

TRIED = 1.5
"""A pose is fitted where it could take a third of the residual away, inputs as they are; and spoken of where it does."""
DECLARED_STD = np.repeat([np.radians(0.5), 1e-3], 3)
"""What a declared pose may be off beside clouds: turn [rad] and shift [m] along each axis (docs/forces.md has the trial)."""
Fitted = tuple[float, Sequence[FloatArray]]
"""What is left [m], and the poses."""


def check_declared_poses(
    recording: Recording, poses: Sequence[FloatArray], pairs: Sequence[Pairs], refit: Callable[[Recording], Fitted]
) -> None:
    """Refuse a declared pose where one that is fitted leaves a quarter of the residual. What the model lacks does not: with a modulus
    of half to three times the true one, the arm of the tests leaves half, as it sags by the same in all frames. Where the fitted one
    leaves a third less, a warning names both, pose and model.

    Arguments:
        recording: as it is calibrated.
        poses: of the cameras, declared ones among them.
        pairs: the markers of each camera.
        refit: fits the same markers with other poses declared.

    Raises:
        DataError: says how far it is off.
    """
    for view, (declared, one) in enumerate(zip(recording.T_robot_camera, pairs)):
        rows = one.modelled.size
        if declared is None or rows < 12 or len(np.unique(one.marker)) < 3:
            continue
        before = float(np.sqrt(((one.measured - one.modelled) ** 2).sum(axis=1).mean()))
        freedom = float(np.sqrt(rows / (rows - 6.0)))
        if before < TRIED * rigid_rms(one.modelled, one.measured):
            continue
        open_poses = tuple(None if v == view else T for v, T in enumerate(recording.T_robot_camera))
        try:
            left, fitted = refit(replace(recording, T_robot_camera=open_poses))
        except DataError:
            continue
        if before < TRIED * freedom * left:
            continue
        text = said(recording, view, declared, fitted[view], one.modelled.mean(axis=0), before, left)
        if before > max(EXPLAINED * freedom * left, SUSPICIOUS * one.spread):
            raise DataError(text)
        warnings.warn(f"{text}. Or the model errs by as much: femsense improve", stacklevel=5)


def said(
    recording: Recording, view: int, declared: FloatArray, fitted: FloatArray, middle: FloatArray, before: float, left: float
) -> str:
    """Return in words how far a declared pose is from a fitted one.

    Arguments:
        recording: names the camera.
        view: of the camera.
        declared, fitted: T_robot_camera, shape (4, 4).
        middle: where the shift is told [m], shape (3,).
        before, left: residual with the one and the other [m].
    """
    apart = declared @ invert_pose(fitted)
    turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(apart[:3, :3]) - 1.0), -1.0, 1.0)))
    shift = transform_points(apart, middle[None])[0] - middle
    along = ", ".join(f"{1e3 * x:.2g}" for x in shift)
    return (
        f"the declared pose of camera {recording.camera_names[view] or '(only one)'} leaves {1e3 * before:.3g} mm, one that is "
        f"fitted {1e3 * left:.3g} mm: the declared one is turned by {turn:.2g}° and shifted by {1e3 * np.linalg.norm(shift):.3g} mm "
        f"({along}) at the body. Leave T_robot_camera out of recording.toml to have it fitted, or declare it "
        f"in the robot's frame"
    )
