"""From the points and markers of a frame to linearised rows."""

from __future__ import annotations

import warnings

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.checks import true_labels
from femsense.calib.scan import OFF, REACH, Scan, ray_rows
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera_frame import in_robot_frame
from femsense.pointcloud.rays import Surface
from femsense.sensing.row_noise import scattered
from femsense.sensing.types import Rows, Sensor

FEWEST = 30
"""Fewer points of the robot than this tell nothing of its shape."""
CATCH = 0.2
"""Where most rays miss a state that is still far off, points count by the closest face within this share of the body's diagonal."""
BEHIND = 0.01
"""A point lies behind the body that is farther behind its face than this share of the body's diagonal."""
MANY = 0.7
"""Share of the points that have to be met before their rays alone are asked."""


def rows_at(sensor: Sensor, k: int, scan: Scan | None, state: Equilibrium, *, caught: bool = False) -> Rows:
    """Return the rows of frame k at a state; `caught`: also of points whose rays miss it, as where most do. Raises DataError where nothing is seen."""
    return _marker_rows(sensor, k, state) if scan is None else _ray_rows(sensor, scan, state, caught)


def _ray_rows(sensor: Sensor, scan: Scan, state: Equilibrium, caught: bool) -> Rows:
    surface = Surface(state.positions, sensor.surface.triangles)
    poses, noises, reach = sensor.calibration.poses, sensor.knowledge.noises, REACH * sensor.size
    rows, measured = ray_rows(scan, surface, poses, noises, reach=reach), scan.measured
    if caught or measured[rows.hits.index].sum() < MANY * measured.sum():
        rows = ray_rows(scan, surface, poses, noises, reach=reach, catch=CATCH * sensor.size)
    number = measured[rows.hits.index]
    met = int(number.sum())
    if met < FEWEST:
        raise DataError(f"only {met} points of the robot in view: check the pose, appearance.color_rgb, and what the camera sees")
    nodes = sensor.robot.body.mesh.nodes
    move = rows.operator(len(nodes))
    rest = rows.hits.place(nodes)
    missed = np.ones(len(measured), dtype=bool)
    missed[rows.hits.index] = False
    scatter = None if scan.scatter is None else scan.scatter[rows.hits.index]
    cosine = np.maximum(rows.hits.cosine, 1e-3)
    square = rows.residual**2 + (0.0 if scatter is None else scatter)
    return Rows(
        functional=lambda u: np.asarray(move @ u.reshape(len(u), -1).T),
        residual=rows.residual,
        std=scattered(sensor.knowledge, cosine) * rows.std,
        by_pose=rows.by_pose(sensor.pivot, len(poses)),
        place=rest,
        way=np.linalg.norm(rows.hits.place(state.positions) - rest, axis=1),
        count=met,
        rms=float(np.sqrt(number @ square / met)),
        missed=surface.gap(scan.points(poses)[missed]) / (sensor.knowledge.rough * scan.ray_std(noises)[missed]),
        of_clouds=True,
        together=sensor.knowledge.together,
        operator=move,
        number=None if scan.count is None else number,
        scatter=scatter,
        facing=facing_of(nodes[rows.hits.nodes]),
        cosine=cosine,
        missed_number=None if scan.count is None else measured[missed],
    )


def facing_of(corners: FloatArray) -> FloatArray:
    """Return the unit normals of triangles (r, 3, 3), shape (r, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def seen_through(sensor: Sensor, scan: Scan, state: Equilibrium) -> float:
    """Return the share of the points that lie behind the body on their ray, farther than the model or the noise may be off [1].

    No camera sees through the body: where it stands elsewhere than the state has it, its points are taken for something else behind it.
    """
    poses = sensor.calibration.poses
    points, origins = scan.surroundings(poses), np.array([T[:3, 3] for T in poses])[scan.others_view]
    if not len(points):
        return 0.0
    hits = Surface(state.positions, sensor.surface.triangles).cast(points, origins, reach=np.inf)
    depth = np.linalg.norm(points - origins, axis=1)[hits.index]
    std = depth_std(sensor, depth, scan.others_view[hits.index])
    behind = hits.distance < -np.maximum(OFF * std * hits.cosine, BEHIND * sensor.size)
    return float(behind.sum() / (scan.measured.sum() + behind.sum()))


def depth_std(sensor: Sensor, depth: FloatArray, view: IntArray) -> FloatArray:
    """Return the noise of points at some depths (k,) [m], each of its camera (k,), shape (k,) [m]."""
    std = np.empty(len(depth))
    for v, noise in enumerate(sensor.knowledge.noises):
        std[view == v] = noise.std(depth[view == v])
    return std


def _marker_rows(sensor: Sensor, k: int, state: Equilibrium) -> Rows:
    """Markers, three rows each."""
    recording, robot = sensor.recording, sensor.robot
    known = {name: i for i, name in enumerate(robot.marker_names)}
    rows = np.flatnonzero(recording.marker_frame == k)
    marker = np.array([known.get(recording.marker_names[i], -1) for i in recording.marker_index[rows]], dtype=np.int64)
    rows, marker = rows[marker >= 0], marker[marker >= 0]
    if not len(rows):
        raise DataError("no marker is seen in this frame")
    view = recording.marker_view[rows]
    measured = in_robot_frame(recording.marker_xyz[rows], view, sensor.calibration.poses, robot.observation)
    marker = as_labelled(sensor, k, state, measured, marker, view)
    tie = robot.markers[marker]
    residual = measured - tie.positions(state.positions)
    way = np.linalg.norm(
        measured - robot.marker_points[marker], axis=1
    )  # of the marker, so that a state that runs away gains nothing
    noise = sensor.options.marker_std_m or marker_std(sensor.calibration)
    beyond = np.hypot(sensor.options.marker_model_std * way, sensor.correction_std[rows])
    std = np.repeat(np.hypot(noise, beyond), 3)
    placed = np.array([robot.marker_names[m] in sensor.calibration.placements_m for m in marker])
    # a placement that rest.csv measured moves with the pose: only the marker's motion since then is left to turn
    turned = pose_columns(measured, sensor.pivot)
    turned = turned - placed[:, None, None] * pose_columns(robot.marker_points[marker], sensor.pivot)
    by_pose = np.zeros((len(rows), 3, len(sensor.calibration.poses), 6))
    by_pose[np.arange(len(rows)), :, view] = turned

    def functional(u: FloatArray) -> FloatArray:
        return np.array([tie.moves(v).ravel() for v in u]).reshape(len(u), -1).T

    return Rows(
        functional=functional,
        residual=residual.ravel(),
        std=std,
        by_pose=by_pose.reshape(residual.size, -1),
        place=np.repeat(robot.marker_points[marker], 3, axis=0),
        way=np.repeat(way, 3),
        count=len(rows),
        rms=float(np.sqrt((residual**2).sum(axis=1).mean())),
    )


def as_labelled(sensor: Sensor, k: int, state: Equilibrium, measured: FloatArray, marker: IntArray, view: IntArray) -> IntArray:
    """Return which markers were seen, shape (r,): as named, or put right where labels are swapped, with a warning."""
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
    """Return the noise of a marker along each axis [m]: what the calibration left, or half a millimetre where it had none."""
    return max(calibration.rms_m / np.sqrt(3.0), 2e-5) if np.isfinite(calibration.rms_m) else 5e-4


def pose_columns(points: FloatArray, pivot: FloatArray) -> FloatArray:
    """Return how points move with (rotation about the pivot [rad], shift [m]), shape (p, 3, 6)."""
    arm = points - pivot
    J = np.zeros((len(points), 3, 6))
    J[:, 0, 1], J[:, 0, 2] = arm[:, 2], -arm[:, 1]
    J[:, 1, 0], J[:, 1, 2] = -arm[:, 2], arm[:, 0]
    J[:, 2, 0], J[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J[:, :, 3:] = np.eye(3)
    return J
