"""Clouds as data of the loop: the distance of surface points of the model from the measured surface, along the normals.

A surface point takes the place of a marker; its distance from the measured surface is its residual, one row. The measured
surface is a smooth height field (`femsense.pointcloud.sheets`) that does not depend on a model, so residuals have exact derivatives and
two models are compared on the same rows. The rows are selected once, with the calibrated model.

Height fields are as wide as a finger and round off edges, steps and facets, in the same places in all frames. The model's surface is
therefore smoothed in the same way, at the places nearest to the measured points, and its rounding is subtracted (`renewed_rows`
recomputes it as the fit proceeds). Without this the true model would leave a residual at every edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from femsense.core.arrays import BoolArray, FloatArray, IntArray, diagonal
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import surface_triangles, triangle_normals, vertex_normals
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.meshing.surface_queries import nearest_on
from femsense.model.camera_frame import as_measured, in_robot_frame
from femsense.model.contact_patch import body_surface, flat_nodes
from femsense.model.observation import Scene
from femsense.model.recording import Recording
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.segmentation import segment_by_model, segment_robot
from femsense.pointcloud.sheets import Crossings, Sheets, fit_sheet, joined

SURFACE_POINTS = 140
"""Number of surface points; one camera sees less than half of them."""
VOXEL = 0.01
"""Edge of the cells over which measured points are averaged, in diagonals of the body."""
RADIUS = 3.5
"""Radius of a height field, in cells."""
SPACING = 0.6
"""Spacing of the centres of height fields, in radii."""
ROUNDS = 0.2
"""Largest rounding of a height field, in radii: 0.16 at a right angle; 0.2 … 2 where the model's own fields do not cover it."""
STEEPEST = 0.78
"""Cosine between the measured and the modelled normal below which a place belongs to another side of the body."""
AROUND = 16
"""Number of neighbouring measured points that decide whether a place lies at the border of the measured surface."""
LOPSIDED = 0.5
"""Largest offset of their mean from the place, relative to their mean distance; on a straight border it is 0.64."""
REACH = 0.1
"""Largest distance of the measured surface from the model's, in diagonals; also of robot points that colour does not identify."""
FACING = 0.35
"""Smallest cosine between a normal and the ray to the camera."""
SMOOTH = 0.06
"""Correlation length of errors, in diagonals."""
PLANE = 1.5
"""Half the thickness of a floor or wall next to the robot, in cells."""
STANDS_OUT = 5.0
"""A row is an outlier if it deviates from its neighbours in the frame by more than this many robust standard deviations."""
FEWEST_ROWS = 8
"""Minimum number of rows of a frame, of neighbours of a row, and of points away from sharp edges before points on edges are used too."""


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredSurface:
    """The measured surface of the robot."""

    points: dict[tuple[int, int], FloatArray]
    """(frame, view) → points [m], shape (r, 3), in the frame of that camera."""
    sheets: Sheets
    """Height fields of these clouds, in the same order."""
    voxel: float
    """Spacing of neighbouring points [m]."""

    def cloud(self, sheet: int) -> FloatArray:
        """Return the points of a cloud by its number [m], shape (r, 3)."""
        return list(self.points.values())[sheet]


def cloud_frames(recording: Recording) -> IntArray:
    """Return the frames that have a cloud or a depth image."""
    return np.array([k for k, files in enumerate(recording.cloud_files) if any(f is not None for f in files)], dtype=np.int64)


def with_surface(robot: Robot) -> Robot:
    """Return the robot with points of its free surface appended to its markers, evenly spread and away from sharp edges."""
    surface = body_surface(robot.body.mesh)
    nodes = robot.body.mesh.nodes
    flat = spread_features(robot.body, SURFACE_POINTS, among=flat_nodes(surface, nodes))
    chosen = flat if len(flat) >= FEWEST_ROWS else spread_features(robot.body, SURFACE_POINTS)
    return robot.with_surface_points(nodes[chosen])


# Measured surface


def read_clouds(
    robot: Robot, recording: Recording, states: dict[int, Equilibrium], poses: tuple[FloatArray, ...]
) -> MeasuredSurface:
    """Return the points of the robot in the clouds of some frames.

    Arguments:
        robot: the declared robot.
        recording: a recording with clouds or depth images.
        states: model states of these frames.
        poses: pose of each camera, shape (4, 4).

    Raises:
        InputError: a malformed file.
        DataError: no camera sees the robot in any of the frames.
    """
    size = diagonal(robot.body.mesh.nodes)
    voxel = VOXEL * size
    triangles = surface_triangles(robot.body.mesh)
    points: dict[tuple[int, int], FloatArray] = {}
    for k, state in states.items():
        for view in range(len(recording.camera_names)):
            cloud = read_frame_cloud(recording, k, view=view)
            own = None if cloud is None else _robot_points(robot, cloud, poses[view], state, triangles, size)
            if own is not None and len(own) >= FEWEST_ROWS:
                points[k, view] = own
    if not points:
        raise DataError(
            "no camera sees the robot in any usable frame: check T_robot_camera, appearance.color_rgb, and that the clouds are in metres"
        )
    return MeasuredSurface(points, joined([sheet_of(own, RADIUS * voxel) for own in points.values()]), voxel)


def sheet_of(points: FloatArray, radius: float) -> Sheets:
    """Return the measured surface of one cloud: height fields at evenly spaced points."""
    thin = voxel_grid(PointCloud(points), SPACING * radius).points
    chosen = np.unique(np.asarray(cKDTree(points).query(thin)[1]))
    return fit_sheet(points, points[chosen], estimate_normals(points, radius)[0][chosen], radius)


def _robot_points(
    robot: Robot, cloud: PointCloud, pose: FloatArray, state: Equilibrium, triangles: IntArray, size: float
) -> FloatArray | None:
    """Return the points of the robot in one cloud [m], shape (r, 3), camera frame: cropped, thinned and segmented as in `estimate`."""
    voxel, margin, zero = VOXEL * size, 0.25 * size, np.zeros(len(cloud), dtype=np.int64)
    placed = PointCloud(in_robot_frame(cloud.points, zero, [pose], robot.observation), cloud.colors)
    box = np.array([state.positions.min(axis=0) - margin, state.positions.max(axis=0) + margin])
    placed = remove_radius_outliers(voxel_grid(pass_through(placed, box), voxel), 3.0 * voxel, 4)
    if not len(placed):
        return None
    if placed.colors is not None and robot.color_rgb is not None:
        own, _ = segment_robot(placed, robot.color_rgb, vote_radius_m=1.5 * voxel)
    else:
        nodes = np.unique(triangles)
        normals = vertex_normals(state.positions, triangles)[nodes]
        own, _ = segment_by_model(placed, state.positions[nodes], normals, REACH * size, plane_m=PLANE * voxel)
    return as_measured(own.points, np.zeros(len(own), dtype=np.int64), [pose], robot.observation)


# Rows


def make_rows(
    robot: Robot, scene: Scene, seen: MeasuredSurface, states: dict[int, Equilibrium], poses: list[FloatArray]
) -> Scene:
    """Return the scene of a recording's clouds: one row per surface point whose normal crosses the measured surface.

    Arguments:
        robot: the robot, with surface points (`Robot.with_surface_points`).
        scene: provides the recording and its frames; its rows are ignored.
        seen: the measured surface.
        states: model states by frame.
        poses: pose of each camera, shape (4, 4).

    Raises:
        DataError: too few points are found.
    """
    robot, every = robot.in_recording(scene.recording.label), list[tuple[IntArray, IntArray, IntArray, FloatArray, Crossings]]()
    for i, (k, v) in enumerate(seen.points):
        if k not in states:
            continue
        numbers, heights, own = crossings_of(robot, seen, i, states[k], poses[v])
        if len(numbers) >= FEWEST_ROWS:
            every.append((np.full(len(numbers), k), len(robot.glued_names) + numbers, np.full(len(numbers), v), heights, own))
    if not every:
        raise DataError(
            f"no part of the measured surface lies within {1e3 * REACH * diagonal(robot.body.mesh.nodes):.0f} mm of the model: "
            "check T_robot_camera and the inputs"
        )
    frame, marker, view = (np.concatenate([e[i] for e in every]) for i in range(3))
    heights = np.concatenate([e[3] for e in every])
    parts = ("sheet", "sides", "rounded", "feet", "normals")
    own = Crossings(seen.sheets, *(np.concatenate([getattr(e[4], n) for e in every]) for n in parts))
    rows = replace(scene, frames=np.unique(frame), frame=frame, marker=marker, view=view, points=own.feet, crossings=own)
    return _without_outliers(robot, rows, heights)


def crossings_of(
    robot: Robot, seen: MeasuredSurface, sheet: int, state: Equilibrium, pose: FloatArray
) -> tuple[IntArray, FloatArray, Crossings]:
    """Return the numbers of the surface points whose normals one measured surface crosses amid measured points, how far outside of the model
    [m], and where."""
    at = in_camera(robot, robot.markers.positions(state.positions)[len(robot.glued_names) :], pose)
    sides = surface_normals(robot, state.positions) @ pose[:3, :3]
    rays = -at / np.linalg.norm(at, axis=1, keepdims=True)
    distance, normals = seen.sheets.distance(at, np.full(len(at), sheet), sides)
    steep = np.einsum("kc,kc->k", normals, sides)
    feet = at - (distance / np.maximum(steep, STEEPEST))[:, None] * sides
    good = (
        (np.einsum("kc,kc->k", rays, sides) >= FACING)
        & (np.abs(distance) <= REACH * diagonal(robot.body.mesh.nodes))
        & (steep >= STEEPEST)
    )
    good[good] = _amid(feet[good], normals[good], seen.cloud(sheet), RADIUS * seen.voxel)
    rounded = np.full(len(at), np.nan)
    rounded[good] = _rounded(robot, seen, sheet, state, pose, at[good], sides[good])
    own = np.flatnonzero(np.isfinite(rounded))
    crossings = Crossings(seen.sheets, np.full(len(own), sheet), sides[own], rounded[own], feet[own], normals[own])
    return own, (rounded - distance)[own], crossings


def _amid(places: FloatArray, normals: FloatArray, points: FloatArray, radius: float) -> BoolArray:
    """Return which places of a measured surface have measured points on all sides, shape (p,)."""
    if not len(places) or len(points) < AROUND:
        return np.zeros(len(places), dtype=bool)
    distance, near = map(np.asarray, cKDTree(points).query(places, k=AROUND))
    apart = points[near] - places[:, None, :]
    apart -= np.einsum("pkc,pc->pk", apart, normals)[:, :, None] * normals[:, None, :]
    off = np.linalg.norm(apart.mean(axis=1), axis=1)
    return np.asarray((off <= LOPSIDED * np.linalg.norm(apart, axis=2).mean(axis=1)) & (distance[:, 0] <= radius))


def _rounded(
    robot: Robot, seen: MeasuredSurface, sheet: int, state: Equilibrium, pose: FloatArray, at: FloatArray, sides: FloatArray
) -> FloatArray:
    """Return how far places on the model lie outside of its own surface as it would be measured [m], shape (k,); NaN: not measured there."""
    points, (centres, normals) = seen.cloud(sheet), seen.sheets.fields_of(sheet)
    modelled = on_model(robot, np.concatenate([points, centres]), state, pose)
    if not len(modelled):
        return np.full(len(at), np.nan)
    own = fit_sheet(modelled[: len(points)], modelled[len(points) :], normals, seen.sheets.radius)
    distance = own.distance(at, np.zeros(len(at), dtype=np.int64), sides)[0]
    return np.where(np.abs(distance) <= ROUNDS * seen.sheets.radius, distance, np.nan)


def on_model(robot: Robot, points: FloatArray, state: Equilibrium, pose: FloatArray) -> FloatArray:
    """Return the places on the model's surface nearest to measured points (r, 3) [m], frame of the camera; only sides that face it count."""
    nodes, triangles = in_camera(robot, state.positions, pose), surface_triangles(robot.body.mesh)
    faces = np.einsum("tc,tc->t", triangle_normals(nodes, triangles), nodes[triangles[:, 0]]) < 0.0
    return nearest_on(nodes, triangles[faces], points) if faces.any() else points[:0]


def in_camera(robot: Robot, points: FloatArray, pose: FloatArray) -> FloatArray:
    """Return points of the robot frame as one camera measures them [m], frame of the camera."""
    return as_measured(points, np.zeros(len(points), dtype=np.int64), [pose], robot.observation)


def surface_normals(robot: Robot, positions: FloatArray) -> FloatArray:
    """Return the outward normals of a body at its surface points, shape (p, 3), for positions of its nodes [m]."""
    triangles = surface_triangles(robot.body.mesh)
    nodes = np.unique(triangles)
    nearest = nodes[cKDTree(robot.body.mesh.nodes[nodes]).query(robot.marker_points[len(robot.glued_names) :])[1]]
    return np.asarray(vertex_normals(positions, triangles)[nearest])


def _without_outliers(robot: Robot, scene: Scene, heights: FloatArray) -> Scene:
    """Exclude rows that deviate from their neighbours in the frame: another limb, a cable, a flying pixel."""
    apart = np.zeros(len(heights))
    for k in scene.frames:
        rows = np.flatnonzero(scene.frame == k)
        at = robot.marker_points[scene.marker[rows]]
        near = np.asarray(cKDTree(at).query(at, k=min(FEWEST_ROWS + 1, len(rows)))[1])[:, 1:]
        apart[rows] = heights[rows] - np.median(heights[rows][near], axis=1)
    usual = 1.4826 * float(np.median(np.abs(apart)))
    keep = np.abs(apart) <= STANDS_OUT * max(usual, 2e-4)
    return replace(scene.of_rows(keep), frames=np.unique(scene.frame[keep]))


def renewed_rows(
    robot: Robot, scene: Scene, seen: MeasuredSurface, states: dict[int, Equilibrium], poses: list[FloatArray]
) -> Scene:
    """Return the same rows with the rounding recomputed at the present surface of the model."""
    assert scene.crossings is not None
    robot, rounded = robot.in_recording(scene.recording.label), scene.crossings.rounded.copy()
    for i, (k, v) in enumerate(seen.points):
        rows = np.flatnonzero((scene.frame == k) & (scene.view == v))
        if k not in states or not len(rows):
            continue
        at = in_camera(robot, robot.markers.positions(states[k].positions)[scene.marker[rows]], poses[v])
        fresh = _rounded(robot, seen, i, states[k], poses[v], at, scene.crossings.sides[rows])
        rounded[rows] = np.where(np.isfinite(fresh), fresh, rounded[rows])
    return replace(scene, crossings=replace(scene.crossings, rounded=rounded))
