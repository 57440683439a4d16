"""Markers of a frame as residual rows: three each, along the axes.

σ² = marker noise² + (model error · displacement from rest)² + σ² of the empirical correction. A marker always belongs to the robot: its row
has no
mixture.
"""

from __future__ import annotations

import warnings

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.checks import true_labels
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.rows import Rows
from femsense.model.camera_frame import in_robot_frame
from femsense.sensing.types import Sensor


def marker_rows(sensor: Sensor, k: int, state: Equilibrium, centres: int) -> Rows:
    """Return the rows of the markers of frame k at a state, without correlated errors.

    Arguments:
        centres: of the error field, which markers do not share.

    Raises:
        DataError: no visible marker.
    """
    recording, robot, calibration = sensor.recording, sensor.robot, sensor.calibration
    known = {name: i for i, name in enumerate(robot.marker_names)}
    rows = np.flatnonzero(recording.marker_frame == k)
    marker = np.array([known.get(recording.marker_names[i], -1) for i in recording.marker_index[rows]], dtype=np.int64)
    rows, marker = rows[marker >= 0], marker[marker >= 0]
    if not len(rows):
        raise DataError("no marker is seen in this frame")
    view = recording.marker_view[rows]
    measured = in_robot_frame(recording.marker_xyz[rows], view, calibration.poses, robot.observation)
    marker = as_labelled(sensor, k, state, measured, marker, view)
    tie, rest = robot.markers[marker], robot.marker_points[marker]
    way = np.linalg.norm(measured - rest, axis=1)
    noise = sensor.options.marker_std_m or marker_std(calibration)
    std = np.hypot(noise, np.hypot(sensor.options.marker_model_std * way, sensor.correction_std[rows]))
    # Marker positions measured in rest.csv rotate with the pose, so only the displacement since then is rotated here.
    placed = np.array([robot.marker_names[m] in calibration.placements_m for m in marker])
    turned = pose_columns(measured, sensor.pivot) - placed[:, None, None] * pose_columns(rest, sensor.pivot)
    by_pose = np.zeros((len(rows), 3, len(calibration.poses), 6))
    by_pose[np.arange(len(rows)), :, view] = turned
    r = 3 * len(rows)
    return Rows(
        residual=(measured - tie.positions(state.positions)).ravel(),
        std=np.repeat(std, 3),
        log_other=np.full(r, -np.inf),
        share=np.ones(r),
        nodes=np.repeat(tie.nodes, 3, axis=0),
        weights=np.repeat(tie.weights, 3, axis=0),
        direction=np.tile(np.eye(3), (len(rows), 1)),
        by_pose=by_pose.reshape(r, -1),
        field=np.zeros((r, centres)),
        camera=np.zeros((r, len(calibration.poses))),
        way=np.repeat(way, 3),
        rest=np.repeat(rest, 3, axis=0),
        pixel=np.zeros(r, dtype=np.bool_),
    )


def as_labelled(sensor: Sensor, k: int, state: Equilibrium, measured: FloatArray, marker: IntArray, view: IntArray) -> IntArray:
    """Return the marker of each row, shape (r,): as labelled, or corrected with a warning if labels are swapped."""
    places, best = sensor.robot.markers.positions(state.positions), marker.copy()
    for v in np.unique(view):
        mine = view == v
        best[mine] = true_labels(places, measured[mine], marker[mine], noise=marker_std(sensor.calibration))
    if (best != marker).any():
        names = " and ".join(sensor.robot.marker_names[m] for m in marker[best != marker])
        number = int(sensor.recording.frame_numbers[k])
        warnings.warn(f"{sensor.recording.folder}: frame {number}: the labels {names} are swapped, put right", stacklevel=4)
    return best


def marker_std(calibration: Calibration) -> float:
    """Return the noise of a marker along each axis [m]: the residual of the calibration, or 0.5 mm if there is none."""
    return max(calibration.rms_m / np.sqrt(3.0), 2e-5) if np.isfinite(calibration.rms_m) else 5e-4


def pose_columns(points: FloatArray, pivot: FloatArray) -> FloatArray:
    """Return the derivatives of points by (rotation about the pivot [rad], shift [m]), shape (p, 3, 6)."""
    arm = points - pivot
    J = np.zeros((len(points), 3, 6))
    J[:, 0, 1], J[:, 0, 2] = arm[:, 2], -arm[:, 1]
    J[:, 1, 0], J[:, 1, 2] = -arm[:, 2], arm[:, 0]
    J[:, 2, 0], J[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J[:, :, 3:] = np.eye(3)
    return J
