"""From clouds and markers of a frame to linearised rows."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.calib.checks import true_labels
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.contact_patch import BodySurface, flat_nodes
from femsense.model.observation import in_robot_frame
from femsense.model.recording import Recording
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.matching import Matches, match_along_normals
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.segmentation import segment_by_model, segment_robot
from femsense.sensing.types import Rows, SeenPoints, SensingOptions, Sensor


def _probes(robot: Robot, surface: BodySurface, options: SensingOptions) -> npt.NDArray[np.int64]:
    """Return the surface nodes that are matched with clouds: as many as the robot's features at least, off sharp edges where it has enough others."""
    count = max(len(robot.features), options.match_points)
    flat = spread_features(robot.body, count, among=flat_nodes(surface, robot.body.mesh.nodes))
    return flat if len(flat) >= min(50, count) else spread_features(robot.body, count)


# --- clouds ------------------------------------------------------------------------------------------------------------


def _has_clouds(recording: Recording) -> bool:
    return any(file is not None for files in recording.cloud_files for file in files)


def _voxel(sensor: Sensor) -> float:
    return sensor.options.voxel_m or 0.01 * sensor.size


def _robot_and_surroundings(sensor: Sensor, k: int, state: Equilibrium) -> SeenPoints | None:
    """Return robot points and surrounding points of all cameras [m], robot frame; None where the frame has no cloud."""
    parts: list[PointCloud] = []
    for view in range(len(sensor.recording.camera_names)):
        cloud = read_frame_cloud(sensor.recording, k, view=view)
        if cloud is not None:
            points = in_robot_frame(
                cloud.points,
                np.zeros(len(cloud.points), dtype=np.int64),
                [sensor.calibration.poses[view]],
                sensor.robot.observation,
            )
            parts.append(PointCloud(points, cloud.colors))
    if not parts:
        return None
    colors = [p.colors for p in parts if p.colors is not None]
    cloud = PointCloud(np.vstack([p.points for p in parts]), np.vstack(colors) if len(colors) == len(parts) else None)
    margin = 0.25 * sensor.size
    box = np.array([state.positions.min(axis=0) - margin, state.positions.max(axis=0) + margin])
    voxel = _voxel(sensor)
    cloud = remove_radius_outliers(voxel_grid(pass_through(cloud, box), voxel), 3.0 * voxel, 4)
    robot, others = _segment(sensor, cloud, state)
    if len(robot.points) < 10:
        raise DataError(
            f"only {len(robot.points)} points of the robot in view: check the pose, appearance.color_rgb, and what the camera sees"
        )
    normals = None
    if len(sensor.calibration.poses) == 1:
        normals = estimate_normals(robot.points, 2.5 * voxel, camera_position=sensor.calibration.poses[0][:3, 3])[0]
    return SeenPoints(robot.points, normals, others.points)


def _segment(sensor: Sensor, cloud: PointCloud, state: Equilibrium) -> tuple[PointCloud, PointCloud]:
    nodes, triangles = sensor.surface.nodes, sensor.surface.triangles
    normals = vertex_normals(state.positions, triangles)[nodes]
    distance = 0.08 * sensor.size
    color = sensor.robot.color_rgb
    if cloud.colors is None:
        return segment_by_model(cloud, state.positions[nodes], normals, 0.5 * distance, plane_m=1.5 * _voxel(sensor))
    if color is None:
        return segment_by_model(cloud, state.positions[nodes], normals, distance)
    return segment_robot(cloud, color, vote_radius_m=1.5 * _voxel(sensor))


# --- measurements --------------------------------------------------------------------------------------------------------


def _measure(sensor: Sensor, k: int, clouds: SeenPoints | None, state: Equilibrium, reach: float = np.inf) -> Rows:
    if clouds is not None:
        return _cloud_rows(sensor, clouds, state, reach)
    return _marker_rows(sensor, k, state)


def _cloud_rows(sensor: Sensor, seen_now: SeenPoints, state: Equilibrium, reach: float) -> Rows:
    """Feature points matched along their normals (Algorithm 3), no farther than `reach` [m]."""
    options, features = sensor.options, sensor.probes
    normals = vertex_normals(state.positions, sensor.surface.triangles)[features]
    cameras = np.array([T[:3, 3] for T in sensor.calibration.poses])
    matches: Matches = match_along_normals(
        state.positions[features],
        normals,
        seen_now.robot,
        d_m=options.match_line_m or 3.0 * _voxel(sensor),
        d_l=min(options.match_reach_m or 0.2 * sensor.size, reach),
        average=True,
        camera_position=cameras,
        robot_normals=seen_now.normals,
        std_floor_m=options.cloud_std_m,
    )
    use = matches.found & np.isfinite(matches.std)
    if use.sum() < 3:
        raise DataError(
            f"only {int(use.sum())} of {len(features)} feature points were found in the cloud: check the pose and the view"
        )
    at, n = features[use], normals[use]
    seen = matches.positions(state.positions[features], normals)[use]
    by_pose = np.einsum("rc,rcj->rj", n, _pose_columns(sensor, seen))
    distance = matches.distance[use]
    way = np.linalg.norm(state.positions[at] - sensor.robot.body.mesh.nodes[at], axis=1)
    std = np.hypot(matches.std[use], options.model_std * way)
    return Rows(
        lambda u: np.einsum("krc,rc->rk", u[:, at], n),
        distance,
        std,
        by_pose,
        int(use.sum()),
        float(np.sqrt((distance**2).mean())),
        std,
        _crowding(seen, options.correlation_m or 0.12 * sensor.size),
    )


def _crowding(points: FloatArray, length: float) -> float:
    """Return the factor by which neighbours' common errors widen standard deviations: √(points / cells of that length they fill)."""
    cells = len(np.unique(np.floor(points / length).astype(np.int64), axis=0))
    return float(np.sqrt(len(points) / cells))


def _marker_rows(sensor: Sensor, k: int, state: Equilibrium) -> Rows:
    """Markers, three rows each."""
    recording, robot = sensor.recording, sensor.robot
    known = {name: i for i, name in enumerate(robot.marker_names)}
    rows = np.flatnonzero(recording.marker_frame == k)
    marker = np.array([known.get(recording.marker_names[i], -1) for i in recording.marker_index[rows]], dtype=np.int64)
    rows, marker = rows[marker >= 0], marker[marker >= 0]
    if not len(rows):
        raise DataError("no marker is seen in this frame")
    measured = in_robot_frame(
        recording.marker_xyz[rows], recording.marker_view[rows], sensor.calibration.poses, robot.observation
    )
    marker = _as_seen(sensor, k, state, measured, marker, recording.marker_view[rows])
    place = robot.markers[marker]
    residual = measured - place.positions(state.positions)
    way = np.linalg.norm(place.positions(state.positions) - robot.marker_points[marker], axis=1)
    noise = sensor.options.marker_std_m or _marker_std(sensor.calibration)
    std = np.repeat(np.hypot(noise, sensor.options.model_std * way), 3)
    seated = np.array([robot.marker_names[m] in sensor.calibration.placements_m for m in marker])
    # a seat that rest.csv measured moves with the pose: only the marker's motion since then is left to turn
    by_pose = _pose_columns(sensor, measured) - seated[:, None, None] * _pose_columns(sensor, robot.marker_points[marker])
    by_pose = by_pose.reshape(residual.size, -1)

    def functional(u: FloatArray) -> FloatArray:
        return np.array([place.moves(v).ravel() for v in u]).reshape(len(u), -1).T

    return Rows(functional, residual.ravel(), std, by_pose, len(rows), float(np.sqrt((residual**2).sum(axis=1).mean())), std)


def _as_seen(sensor: Sensor, k: int, state: Equilibrium, measured: FloatArray, marker: IntArray, view: IntArray) -> IntArray:
    """Return which markers were seen, shape (r,): as named, or put right where labels are exchanged, with a warning."""
    places, best = sensor.robot.markers.positions(state.positions), marker.copy()
    for v in np.unique(view):
        mine = view == v
        best[mine] = true_labels(places, measured[mine], marker[mine], noise=_marker_std(sensor.calibration))
    if (best != marker).any():
        names = " and ".join(sensor.robot.marker_names[m] for m in marker[best != marker])
        number = int(sensor.recording.frame_numbers[k])
        warnings.warn(f"{sensor.recording.folder}: frame {number}: the labels {names} are exchanged, put right", stacklevel=4)
    return best


def _marker_std(calibration: Calibration) -> float:
    """Return the noise of a marker along each axis [m]: what the calibration left, or half a millimetre where it had none."""
    return max(calibration.rms_m / np.sqrt(3.0), 2e-5) if np.isfinite(calibration.rms_m) else 5e-4


def _pose_columns(sensor: Sensor, points: FloatArray) -> FloatArray:
    """Return how points move with the pose, in units of its standard deviations [m], shape (p, 3, j)."""
    pivot = sensor.robot.marker_points.mean(axis=0) if len(sensor.robot.marker_points) else np.zeros(3)
    arm = points - pivot
    J = np.zeros((len(points), 3, 6))
    J[:, 0, 1], J[:, 0, 2] = arm[:, 2], -arm[:, 1]
    J[:, 1, 0], J[:, 1, 2] = -arm[:, 2], arm[:, 0]
    J[:, 2, 0], J[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J[:, :, 3:] = np.eye(3)
    return J @ sensor.pose_root


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance) if covariance.size else (np.zeros(0), np.zeros((6, 0)))
    keep = values > 0
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))
