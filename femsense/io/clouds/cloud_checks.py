"""Checks of the clouds of a recording: unit, coordinate frame, and the sensor pose in their files."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, spread_evenly
from femsense.core.errors import FemsenseError
from femsense.core.pose import transform_points
from femsense.io.clouds.cloud_files import viewpoint_doubt
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.plausibility import RANGES, doubts_of_cloud_places, other_poses
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.cloud import PointCloud

CLOUDS_READ = 3
"""Number of clouds of a recording that are checked."""
NEAR_BODY = 0.25
"""Points are near a body within its box, grown by this times its diagonal."""
FEWEST_NEAR = 20
"""Number of points near the robot from which an alternative reading of a pose is proposed."""
OTHER_UNIT = 5.0
"""Ratio of the distances of clouds and markers of a frame above which their units differ."""


def some_clouds(recording: Recording) -> list[tuple[int, int, PointCloud]]:
    """Return frame, view and cloud of some frames that have one and whose file can be read."""
    r = recording
    having = [(k, v) for k in range(r.frame_count) for v in range(len(r.camera_names)) if r.cloud_files[k][v] is not None]
    chosen = [having[i] for i in spread_evenly(len(having), CLOUDS_READ)]
    found = []
    for k, v in chosen:
        try:
            cloud = read_frame_cloud(r, k, view=v)
        except FemsenseError:
            continue
        found += [(k, v, cloud)] if cloud is not None else []
    return found


def cloud_problems(recording: Recording, *, robot: Robot | None = None) -> list[str]:
    """Return the problems of the extents of a recording's clouds, compared with its markers and the robot."""
    clouds = some_clouds(recording)
    where = f"{recording.folder / 'clouds' if recording.folder else 'clouds'}"
    if not clouds:
        return []
    full = [(k, v, cloud) for k, v, cloud in clouds if len(cloud)]
    if not full:
        return [f"{where}: the clouds of {len(clouds)} frames that were read have no points"]
    distance = float(np.median([np.median(np.linalg.norm(cloud.points, axis=1)) for _, _, cloud in full]))
    seen = [_marker_distance(recording, k, v) for k, v, _ in full]
    markers = float(np.median([d for d in seen if d is not None])) if any(d is not None for d in seen) else None
    if markers is not None and not 1 / OTHER_UNIT < distance / markers < OTHER_UNIT:
        return [
            f"{where}: clouds {distance:.4g} m away, markers {markers:.4g} m: {_likely(distance / markers)} Clouds are in metres"
        ]
    if distance > RANGES.scene_m[1]:
        return [
            f"{where}: clouds {distance:.4g} m away are not what a depth camera sees: {_likely(distance / 0.5)} Clouds are in metres"
        ]
    extent = max(float(np.ptp(cloud.points, axis=0).max()) for _, _, cloud in full)
    if robot is not None:
        size = float(np.ptp(robot.body.mesh.nodes, axis=0).max())
        if extent < 0.1 * size:
            return [f"{where}: the clouds are {1e3 * extent:.4g} mm across, the robot {1e3 * size:.4g} mm: are they in metres?"]
    return []


def cloud_doubts(recording: Recording) -> list[str]:
    """Return suspicious properties of a recording's clouds: sensor poses in their files, points behind or at the camera."""
    full = [(k, v, cloud) for k, v, cloud in some_clouds(recording) if len(cloud)]
    if not full:
        return []
    file = recording.cloud_files[full[0][0]][full[0][1]]
    doubt = None if file is None else viewpoint_doubt(file)
    where = f"{recording.folder / 'clouds' if recording.folder else 'clouds'}"
    points = np.vstack([cloud.points for _, _, cloud in full])
    return [*([doubt] if doubt else []), *doubts_of_cloud_places(points, where)]


def doubts_of_cloud_poses(robot: Robot, recording: Recording) -> list[str]:
    """Return the declared camera poses without points near the robot, each with the alternative reading that places points there."""
    low, high = robot.body.mesh.nodes.min(axis=0), robot.body.mesh.nodes.max(axis=0)
    margin = NEAR_BODY * float(np.linalg.norm(high - low))
    found = []
    for view, T in enumerate(recording.T_robot_camera):
        clouds = [cloud.points for _, v, cloud in some_clouds(recording) if v == view and len(cloud)]
        if T is None or not clouds:
            continue
        points = np.vstack(clouds)

        def near(pose: FloatArray, seen: FloatArray = points) -> int:
            placed = transform_points(pose, seen)
            return int(((placed > low - margin) & (placed < high + margin)).all(axis=1).sum())

        if near(T):
            continue
        name, count = max(((name, near(pose)) for name, pose in other_poses(T)), key=lambda item: item[1])
        meant = f"; {name} would put {count} of {len(points)} there: is it that?" if count >= FEWEST_NEAR else ""
        where = f"{recording.folder / 'recording.toml' if recording.folder else 'T_robot_camera'}"
        found.append(f"{where}: T_robot_camera puts no point of the clouds near the robot{meant}")
    return found


def _marker_distance(recording: Recording, k: int, view: int) -> float | None:
    mine = (recording.marker_frame == k) & (recording.marker_view == view)
    return float(np.median(np.linalg.norm(recording.marker_xyz[mine], axis=1))) if mine.any() else None


def _likely(ratio: float) -> str:
    names = {1e3: "are they in millimetres?", 1e2: "are they in centimetres?", 39.37: "are they in inches?"}
    nearest = min(names, key=lambda factor: abs(np.log(ratio / factor)))
    return names[nearest] if abs(np.log(ratio / nearest)) < 0.8 else "are they in another unit?"
