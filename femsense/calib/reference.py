"""A twin recording as the reference: its residual is subtracted from other recordings at the same inputs.

The model error can exceed the effect in question: a weight shifts the tip of the trunk by 10 mm, and the model is wrong by 20 mm. If the same inputs
were recorded without the effect, the errors common to both recordings cancel. With measured markers y and modelled ones m,

    y′(u) = y(u) − (y₀(u₀) − m(u₀)),   u₀ the nearest inputs of the reference,

so that y′ − m(u) is the difference of the two recordings, up to repeatability.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError, InputError
from femsense.model.as_it_is import evaluate_robot
from femsense.model.marker_correction import recorded_inputs
from femsense.model.observation import make_scene
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot

SAME = 0.15
"""Maximum difference of equal inputs, relative to their range in the reference: motors of the trunk repeat to 0.01 on average and to 0.1 at
most."""


def less_reference(robot: Robot, recordings: Sequence[Recording], references: Sequence[Recording]) -> list[Recording]:
    """Subtract the residuals of references from the markers of recordings at the same inputs; markers of frames with other inputs are
    removed.

    Arguments:
        robot: the model.
        recordings: recordings with named markers and known inputs.
        references: recordings of the same robot and cameras without the effect in question.

    Raises:
        InputError: a recording with other inputs than its reference, without named markers, or with an unknown zero of the inputs.
        DataError: no frame has the inputs of a reference, or a reference has no equilibrium.
    """
    for one in (*recordings, *references):
        _require_markers(one, references[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reported when the recordings are used
        known = [_missed(robot, check_against(robot, one)) for one in references]
        recordings = [check_against(robot, one) for one in recordings]
    inputs, of_markers = np.concatenate([k.inputs for k in known]), np.concatenate([k.of_markers for k in known])
    twin = _Missed(inputs, of_markers, known[0].poses)
    return [_moved(robot, one, twin) for one in recordings]


@dataclass(frozen=True, eq=False, slots=True)
class _Missed:
    """Residuals of references."""

    inputs: FloatArray
    """[N], [m] or [Pa], shape (f, a)."""
    of_markers: FloatArray
    """Measured minus modelled markers, robot frame [m], shape (f, v, m, 3); NaN for hidden markers."""
    poses: tuple[FloatArray, ...]
    """T_robot_camera of each camera of the first reference, each (4, 4)."""


def _require_markers(recording: Recording, reference: Recording) -> None:
    where, same = str(recording.folder), (reference.actuation, reference.camera_names)
    if not recording.has_markers:
        raise InputError("a reference speaks of markers with names", where=where, found="none")
    if recording.actuation_zero != "absolute":
        raise InputError("inputs count from an unknown zero", where=where, expected='actuation_zero = "absolute"')
    if (recording.actuation, recording.camera_names) != same:
        found = f"{recording.actuation}, cameras {recording.camera_names}"
        raise InputError(
            "driven or seen otherwise than the reference", where=where, found=found, expected=f"{same[0]}, cameras {same[1]}"
        )


def _missed(robot: Robot, reference: Recording) -> _Missed:
    calibration = calibrate(robot, reference)
    scene = make_scene(robot, reference, np.unique(reference.marker_frame))
    jet = evaluate_robot(robot, scene, calibration.poses, None)
    missed = np.full((len(scene.frames), len(calibration.poses), len(robot.marker_names), 3), np.nan)
    missed[np.searchsorted(scene.frames, scene.frame), scene.view, scene.marker] = jet.residual
    return _Missed(recorded_inputs(reference)[scene.frames], missed, calibration.poses)


def _moved(robot: Robot, recording: Recording, twin: _Missed) -> Recording:
    """Return a recording whose markers are moved by the residual at the nearest inputs."""
    width = np.ptp(twin.inputs, axis=0)
    width = np.where(width > 0.01 * width.max(), width, max(float(width.max()), 1e-12))
    off, nearest = map(np.asarray, cKDTree(twin.inputs / width).query(recorded_inputs(recording) / width, p=np.inf))
    number = {name: i for i, name in enumerate(robot.marker_names)}
    marker = np.array([number.get(name, -1) for name in recording.marker_names])[recording.marker_index]
    shift = twin.of_markers[nearest[recording.marker_frame], recording.marker_view, marker]
    keep = (off[recording.marker_frame] <= SAME) & (marker >= 0) & np.isfinite(shift).all(axis=1)
    if not keep.any():
        raise DataError(f"{recording.folder}: no frame has the inputs of a reference (to {100 * SAME:.0f} % of their range)")
    without = len(np.setdiff1d(recording.marker_frame, recording.marker_frame[keep]))
    if without:
        warnings.warn(f"{recording.folder}: {without} frames have inputs that no reference has, and are left out", stacklevel=3)
    turns = np.array([T[:3, :3] for T in twin.poses])[recording.marker_view[keep]]
    noise = recording.marker_noise_m
    return replace(
        recording,
        marker_frame=freeze(recording.marker_frame[keep], np.int64),
        marker_index=freeze(recording.marker_index[keep], np.int64),
        marker_view=freeze(recording.marker_view[keep], np.int64),
        marker_xyz=freeze(recording.marker_xyz[keep] - np.einsum("kc,kcd->kd", shift[keep], turns)),
        T_robot_camera=tuple(own if T is None else T for T, own in zip(recording.T_robot_camera, twin.poses)),
        marker_noise_m=None if noise is None else float(np.sqrt(2.0)) * noise,
    )
