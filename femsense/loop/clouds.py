"""Clouds as data of the loop: points of the surface, and where in each frame the measured surface crosses the normals there.

A point of the surface plays the part of a marker, and its distance from the measured surface along the normal that of its residual: one
row. The measured surface near a normal is a height field (`femsense.pointcloud.patches`) that stays as it is while a model is fitted, so
that derivatives are those of the residual and two models are compared on the same rows. As the fit moves on, the patches are made anew
(`renewed_rows`); which rows there are is decided once, on the model with all that calibration may move.

A patch is as wide as a finger and rounds off edges, steps and facets. So its height is counted from that of a second patch, which is
made in the same way of the places on the model's own surface that are nearest to the measured points: what the model has rounded off as
well is no residual. Without it the right model is off, in the same places in all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from femsense.arrays import BoolArray, FloatArray, IntArray
from femsense.calib.forward import Hypothesis, Scene, as_measured, evaluate_scene, in_robot_frame
from femsense.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import surface_triangles, triangle_normals, vertex_normals
from femsense.model import Robot, spread_features
from femsense.patch import flat_nodes, make_surface
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.patches import Patches, fit_patches
from femsense.pointcloud.segmentation import segment_by_model, segment_robot
from femsense.recording import Recording, read_frame_cloud
from femsense.surface import nearest_on

SURFACE_POINTS = 140
"""Points of the surface; a camera sees less than half of them at once."""
FEWEST_POINTS = 12
"""With fewer off sharp edges those on edges count too."""
VOXEL = 0.01
"""Edge of the cells that measured points are averaged over, in diagonals of the body."""
RADIUS = 3.0
"""Radius of a patch, in cells."""
REACH = 0.1
"""Largest distance of the measured surface from the model's, in diagonals."""
FACING = 0.35
"""Smallest cosine between a normal and the ray to the camera."""
SMOOTH = 0.06
"""Distance over which errors go together, in diagonals."""
NEAR = 0.08
"""Largest distance of the robot's points from the declared model where colours do not tell, in diagonals: it may be that far off."""
PLANE = 1.5
"""Half the thickness of a floor or wall beside the robot, in cells."""
STANDS_OUT = 5.0
"""A row farther from its neighbours in the frame than this many of their usual differences is left out."""
NEIGHBOURS = 6
FEWEST_ROWS = 8
"""Rows that a frame needs."""


@dataclass(frozen=True, eq=False, slots=True)
class Sheets:
    """What the cameras measured of the robot."""

    points: dict[tuple[int, int], FloatArray]
    """(frame, view) → points [m], shape (r, 3), frame of that camera."""
    voxel: float
    """Distance of neighbouring points [m]."""


def has_clouds(recording: Recording) -> bool:
    """Return whether any frame of a recording has a cloud or a depth image."""
    return any(file is not None for files in recording.cloud_files for file in files)


def cloud_frames(recording: Recording) -> IntArray:
    """Return the frames that have a cloud or a depth image."""
    return np.array([k for k, files in enumerate(recording.cloud_files) if any(f is not None for f in files)], dtype=np.int64)


def with_surface(robot: Robot) -> Robot:
    """Return the robot with points of its free surface behind its markers, evenly spread and off sharp edges."""
    surface = make_surface(robot.body.mesh)
    nodes = robot.body.mesh.nodes
    flat = spread_features(robot.body, SURFACE_POINTS, among=flat_nodes(surface, nodes))
    chosen = flat if len(flat) >= FEWEST_POINTS else spread_features(robot.body, SURFACE_POINTS)
    return robot.with_surface_points(nodes[chosen])


def diagonal_of(robot: Robot) -> float:
    """Return the diagonal of the body at rest [m]."""
    return float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))


# What the cameras measured


def read_sheets(robot: Robot, recording: Recording, states: dict[int, Equilibrium], poses: tuple[FloatArray, ...]) -> Sheets:
    """Return the robot's points in the clouds of some frames.

    Arguments:
        robot: as it is declared.
        recording: with clouds or depth images.
        states: of the frames that are wanted, as the model has them.
        poses: of the cameras.

    Raises:
        InputError: a broken file; DataError: no camera sees the robot in any of the frames.
    """
    size = diagonal_of(robot)
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
            "no camera sees the robot in any frame that can be used: check T_robot_camera, appearance.color_rgb, and that the clouds are in metres"
        )
    return Sheets(points, voxel)


def _robot_points(
    robot: Robot, cloud: PointCloud, pose: FloatArray, state: Equilibrium, triangles: IntArray, size: float
) -> FloatArray | None:
    """Return the points of the robot in one cloud [m], shape (r, 3), frame of the camera: boxed, thinned and segmented as `estimate` does."""
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
        own, _ = segment_by_model(placed, state.positions[nodes], normals, NEAR * size, plane_m=PLANE * voxel)
    return as_measured(own.points, np.zeros(len(own), dtype=np.int64), [pose], robot.observation)


def states_of(
    robot: Robot,
    scene: Scene,
    poses: Sequence[FloatArray],
    initial: FloatArray | None,
    starts: dict[int, Equilibrium] | None = None,
) -> dict[int, Equilibrium]:
    """Return the equilibrium of each frame of a scene. Raises DataError where there is none."""
    return evaluate_scene(
        Hypothesis(robot), scene, np.zeros(0), poses, initial, derivative=False, vary_initial=False,
        pivot=robot.marker_points.mean(axis=0), starts=starts,
    ).states  # fmt: skip


# Rows


def make_rows(robot: Robot, scene: Scene, sheets: Sheets, states: dict[int, Equilibrium], poses: list[FloatArray]) -> Scene:
    """Return the scene of a recording's clouds: one row for each point of the surface whose normal the measured surface crosses.

    Arguments:
        robot: with points of its surface.
        scene: of the recording; its frames count, its rows do not.
        sheets: what was measured.
        states: of each frame, as the model has them.
        poses: of the cameras.

    Raises:
        DataError: too few points are found.
    """
    frame, marker, view = [], [], []
    patches: list[Patches] = []
    glued = len(robot.glued_names)
    for (k, v), points in sheets.points.items():
        if k not in states:
            continue
        own, numbers = _patches_of(robot, points, states[k], poses[v], sheets.voxel)
        if len(numbers) < FEWEST_ROWS:
            continue
        frame.append(np.full(len(numbers), k))
        marker.append(glued + numbers)
        view.append(np.full(len(numbers), v))
        patches.append(own)
    if not patches:
        raise DataError(
            f"the measured surface lies nowhere within {1e3 * REACH * diagonal_of(robot):.0f} mm of the model's: check T_robot_camera and the inputs"
        )
    every = Patches(*(np.concatenate([getattr(p, n) for p in patches]) for n in ("origin", "axes", "heights", "radius")))
    rows = replace(scene, frames=np.unique(np.concatenate(frame)), frame=np.concatenate(frame), marker=np.concatenate(marker),
                   view=np.concatenate(view), points=every.feet, patches=every)  # fmt: skip
    return _without_outliers(robot, rows)


def _patches_of(robot: Robot, points: FloatArray, state: Equilibrium, pose: FloatArray, voxel: float) -> tuple[Patches, IntArray]:
    """Return patches of one cloud and the numbers of the surface points they belong to; only those that rest on many points.

    Heights on the normals are those above the model's own patches.
    """
    at = robot.markers.positions(state.positions)[len(robot.glued_names) :]
    measured = _seen(robot, at, pose)
    normals = surface_normals(robot, state.positions) @ pose[:3, :3]
    wide: dict[str, float] = {"radius": RADIUS * voxel, "reach": REACH * diagonal_of(robot), "min_facing": FACING}
    patches, numbers, std = fit_patches(measured, normals, points, **wide)
    modelled, also, _ = fit_patches(measured, normals, _on_model(robot, points, state, pose), **wide)
    good = std <= 3.0 * np.median(std) if len(std) else np.zeros(0, dtype=bool)
    both, i, j = np.intersect1d(numbers[good], also, return_indices=True)
    own = patches.pick(np.flatnonzero(good)[i])
    own.heights[:, 0] -= modelled.heights[j, 0]
    return own, both


def _on_model(robot: Robot, points: FloatArray, state: Equilibrium, pose: FloatArray) -> FloatArray:
    """Return the places on the model's surface nearest to measured points (r, 3) [m], frame of the camera; only sides that face it count."""
    nodes, triangles = _seen(robot, state.positions, pose), surface_triangles(robot.body.mesh)
    faces = np.einsum("tc,tc->t", triangle_normals(nodes, triangles), nodes[triangles[:, 0]]) < 0.0
    return nearest_on(nodes, triangles[faces], points) if faces.any() else points[:0]


def _seen(robot: Robot, points: FloatArray, pose: FloatArray) -> FloatArray:
    """Return points of the robot frame as one camera measures them [m], frame of the camera."""
    return as_measured(points, np.zeros(len(points), dtype=np.int64), [pose], robot.observation)


def surface_normals(robot: Robot, positions: FloatArray) -> FloatArray:
    """Return the outward normals of a body at its surface points, shape (p, 3), for positions of its nodes [m]."""
    triangles = surface_triangles(robot.body.mesh)
    nodes = np.unique(triangles)
    nearest = nodes[cKDTree(robot.body.mesh.nodes[nodes]).query(robot.marker_points[len(robot.glued_names) :])[1]]
    return np.asarray(vertex_normals(positions, triangles)[nearest])


def _without_outliers(robot: Robot, scene: Scene) -> Scene:
    """Leave out rows that lie apart from their neighbours in the frame: another limb, a cable, a flying pixel."""
    height = scene.patches.heights[:, 0] if scene.patches is not None else np.zeros(0)
    apart = np.zeros(len(height))
    for k in scene.frames:
        rows = np.flatnonzero(scene.frame == k)
        at = robot.marker_points[scene.marker[rows]]
        near = np.asarray(cKDTree(at).query(at, k=min(NEIGHBOURS + 1, len(rows)))[1])[:, 1:]
        apart[rows] = height[rows] - np.median(height[rows][near], axis=1)
    usual = 1.4826 * float(np.median(np.abs(apart)))
    return _rows(scene, np.abs(apart) <= STANDS_OUT * max(usual, 2e-4))


def _rows(scene: Scene, keep: BoolArray) -> Scene:
    assert scene.patches is not None
    return replace(scene, frames=np.unique(scene.frame[keep]), frame=scene.frame[keep], marker=scene.marker[keep], view=scene.view[keep],
                   points=scene.points[keep], patches=scene.patches.pick(keep))  # fmt: skip


def renewed_rows(robot: Robot, scene: Scene, sheets: Sheets, states: dict[int, Equilibrium], poses: list[FloatArray]) -> Scene:
    """Return the same rows with their patches made anew where the model now is; a patch that is not found again stays as it was."""
    assert scene.patches is not None
    patches, glued = scene.patches, len(robot.glued_names)
    for (k, v), points in sheets.points.items():
        rows = np.flatnonzero((scene.frame == k) & (scene.view == v))
        if k not in states or not len(rows):
            continue
        own, numbers = _patches_of(robot, points, states[k], poses[v], sheets.voxel)
        place = {int(n): i for i, n in enumerate(numbers)}
        again = np.array([i for i in rows if int(scene.marker[i]) - glued in place], dtype=np.int64)
        if len(again):
            fresh = own.pick(np.array([place[int(scene.marker[i]) - glued] for i in again]))
            still = np.abs(fresh.heights[:, 0] - _height_now(patches.pick(again), fresh)) < patches.radius[again]
            patches = patches.put(again[still], fresh.pick(still))
    return replace(scene, patches=patches, points=patches.feet)


def _height_now(old: Patches, fresh: Patches) -> FloatArray:
    """Return how far old patches lie outside of where the model is now [m], shape (k,): a fresh one much farther is of another limb."""
    return -old.distance(fresh.origin)
