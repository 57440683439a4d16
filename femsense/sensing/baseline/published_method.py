"""The published method as a baseline: feature points along their normals, normal forces, one linear step per frame.

Source: "Calibration and force sensing with an RGB-D camera", section V: segmentation by colour, Algorithm 2 (contacts), Algorithm 3 (matching), equation 12.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError, InputError
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.camera_frame import in_robot_frame
from femsense.model.contact_patch import flat_nodes
from femsense.model.robot import spread_features
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.segmentation import segment_by_model, segment_robot
from femsense.sensing.baseline.contact_detection import detect_contacts
from femsense.sensing.baseline.matching import MatchingOptions, match_along_normals
from femsense.sensing.baseline.normal_forces import normal_forces
from femsense.sensing.run_arrays import sensed
from femsense.sensing.states import free_state, loaded_state
from femsense.sensing.touches import make_touch
from femsense.sensing.tracks import contacts_of
from femsense.sensing.types import FrameReport, SensedFrame, Sensor, Touch

VOXEL = 0.01
"""Edge of the voxel grid, relative to the body's diagonal."""
LINE, REACH = 0.03, 0.2
"""d_m and d_l of Algorithm 3: largest distances from the normal line and along it, relative to the diagonal."""
NEIGHBORS = 3
"""Minimum number of robot points near a contact (Algorithm 2)."""


def sense_as_published(sensor: Sensor, k: int, previous: SensedFrame | None) -> SensedFrame:
    """Return contacts and forces of frame k by the published method. Raises FemsenseError."""
    began = time.perf_counter()
    if not sensor.recording.has_clouds:
        raise InputError("the published method needs clouds", where=sensor.recording.folder, expected="clouds/ or depth/")
    free = free_state(sensor, k, None if previous is None else previous.free_state, None)
    robot, others = _segmented(sensor, k, free)
    rows = _matches(sensor, robot, free)
    touches = _touches(sensor, robot, others, free, k)
    forces, covariance = _one_step(sensor, rows, touches, free)
    state = loaded_state(sensor, k, touches, forces, free, None, exact=True)
    if state is None:
        raise DataError("no equilibrium under the forces of one linear step")
    own = [covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(touches))]
    contacts = contacts_of(sensor, k, touches, forces, own, np.zeros((len(touches), 3, 3)), state, previous)
    after = _matches(sensor, robot, state)
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    ms = 1e3 * (time.perf_counter() - began)
    tension, pressure = dict(state.tension), dict(state.pressure)
    report = FrameReport(number, stamp, "ok", len(sensed(contacts)), len(rows.at), rows.rms, after.rms, ms, tension, pressure)
    return SensedFrame(tuple(touches), state, forces, free, report, contacts)


@dataclass(frozen=True, eq=False, slots=True)
class _Matches:
    """Feature points found in the cloud."""

    at: IntArray
    """Nodes of the features, shape (r,)."""
    normals: FloatArray
    """Outward, shape (r, 3)."""
    distance: FloatArray
    """Along the normal [m], shape (r,)."""
    std: FloatArray
    """[m], shape (r,)."""

    @property
    def rms(self) -> float:
        return float(np.sqrt((self.distance**2).mean()))


def _segmented(sensor: Sensor, k: int, state: Equilibrium) -> tuple[PointCloud, PointCloud]:
    """Return the filtered points of the robot and of its surroundings, robot frame."""
    parts = []
    for view, T in enumerate(sensor.calibration.poses):
        cloud = read_frame_cloud(sensor.recording, k, view=view)
        if cloud is not None:
            own = np.zeros(len(cloud.points), dtype=np.int64)
            parts.append(PointCloud(in_robot_frame(cloud.points, own, [T], sensor.robot.observation), cloud.colors))
    if not parts:
        raise DataError("the frame has no cloud")
    colors = [p.colors for p in parts if p.colors is not None]
    cloud = PointCloud(np.vstack([p.points for p in parts]), np.vstack(colors) if len(colors) == len(parts) else None)
    margin, voxel = 0.25 * sensor.size, VOXEL * sensor.size
    box = np.array([state.positions.min(axis=0) - margin, state.positions.max(axis=0) + margin])
    cloud = remove_radius_outliers(voxel_grid(pass_through(cloud, box), voxel), 3.0 * voxel, 4)
    if cloud.colors is not None and sensor.robot.color_rgb is not None:
        robot, others = segment_robot(cloud, sensor.robot.color_rgb, vote_radius_m=1.5 * voxel)
    else:
        nodes = sensor.surface.nodes
        normals = vertex_normals(state.positions, sensor.surface.triangles)[nodes]
        robot, others = segment_by_model(cloud, state.positions[nodes], normals, 0.04 * sensor.size, plane_m=1.5 * voxel)
    if len(robot.points) < 10:
        raise DataError(f"only {len(robot.points)} points of the robot in view")
    return robot, others


def _matches(sensor: Sensor, robot: PointCloud, state: Equilibrium) -> _Matches:
    """Return feature points matched along their normals (Algorithm 3)."""
    flat = flat_nodes(sensor.surface, sensor.robot.body.mesh.nodes)
    features = spread_features(sensor.robot.body, max(len(sensor.robot.features), 50), among=flat)
    normals = vertex_normals(state.positions, sensor.surface.triangles)[features]
    matches = match_along_normals(
        state.positions[features],
        normals,
        robot.points,
        d_m=LINE * sensor.size,
        d_l=REACH * sensor.size,
        camera_position=np.array([T[:3, 3] for T in sensor.calibration.poses]),
        options=MatchingOptions(average=True, std_floor_m=5e-4),
    )
    use = matches.found & np.isfinite(matches.std)
    if use.sum() < 3:
        raise DataError(f"only {int(use.sum())} of {len(features)} feature points were found in the cloud")
    return _Matches(features[use], normals[use], matches.distance[use], matches.std[use])


def _touches(sensor: Sensor, robot: PointCloud, others: PointCloud, state: Equilibrium, k: int) -> list[Touch]:
    """Return the given contact points, or those that Algorithm 2 detects."""
    if len(sensor.places):
        return [make_touch(sensor, place, source="given") for place in sensor.places]
    if sensor.recording.free is not None and sensor.recording.free[k]:
        return []
    voxel = VOXEL * sensor.size
    found = detect_contacts(
        others.points,
        robot.points,
        search_radius_m=3.0 * voxel,
        min_neighbors=NEIGHBORS,
        cluster_distance_m=4.0 * voxel,
        min_points=3,
    )
    nodes, x = sensor.surface.nodes, state.positions
    nearest = [int(nodes[np.argmin(np.linalg.norm(x[nodes] - place, axis=1))]) for place in found.positions]
    return [make_touch(sensor, sensor.robot.body.mesh.nodes[node], source="cloud") for node in nearest]


def _one_step(sensor: Sensor, rows: _Matches, touches: list[Touch], state: Equilibrium) -> tuple[FloatArray, FloatArray]:
    """Return forces along the inward normals by one linear step (equation 12), and their covariance."""
    m, n = len(touches), len(state.positions)
    if not m:
        return np.zeros((0, 3)), np.zeros((0, 0))
    inward = np.array([-t.patch.mean(vertex_normals(state.positions, sensor.surface.triangles)) for t in touches])
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
    basis = np.array([t.patch.spread(d, n) for t, d in zip(touches, inward)])
    moves = tangent_at(sensor.robot.body, state).respond(basis)
    W = np.einsum("krc,rc->rk", moves[:, rows.at], rows.normals)
    forces, covariance = normal_forces(W, rows.distance, rows.std)
    spread = np.zeros((3 * m, m))
    for i in range(m):
        spread[3 * i : 3 * i + 3, i] = inward[i]
    return freeze(forces[:, None] * inward), freeze(spread @ covariance @ spread.T)
