"""The pose of a camera from clouds alone, without an initial guess: a global search that aligns the visible side of the body with the
cloud.

Poses on a grid of rotations and translations are scored with a distance map of the measured points (Fitzgibbon, "Robust registration of
2D and 3D point sets", 2003). The best are refined by closest-point registration (Besl and McKay 1992) from the visible side to the
measured points; the silhouette determines the translation in the image plane. The final score counts the parts of the visible side that
were measured, and counts rays that pass through the body against the pose. Occluded parts count half. Planes larger than the body are
removed first, because a flat side fits anywhere into a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from femsense.calib.rigid import poses_apart, rotation_between
from femsense.calib.scan import REACH
from femsense.calib.visible_side import Samples, size_of, spread_samples
from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, make_pose, transform_points
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.filters import voxel_grid
from femsense.pointcloud.objects import find_plane
from femsense.pointcloud.rays import Surface

ROTATIONS = 800
"""Rotations of the grid: neighbours are 20° apart, and closest points find their way from there."""
SEEDS = 150
"""Places of the grid at most."""
SAMPLES = 80
"""Points of the visible side by which a pose is judged."""
CLOSER = 300
"""Poses that closest points refine."""
FINAL = 16
"""Poses that are refined with finer points."""
COARSE_STEPS, FINE, FINE_STEPS = 10, 1200, 25
"""Steps of both, and samples of the second."""
RAYS = 10000
"""Rays of a view that judge at most."""
MOST_CELLS = 4e6
"""Cells of the map of distances: 16 MB; a wider scene gets larger ones."""
UNKNOWN = 0.5
"""Cost of an occluded part of the visible side, between measured, 0, and not measured, 1."""
LEAST = 0.25
"""A pose needs this gain: right ones of benchmarks/calibration.py have 0.5 and more,
wrong ones 0 and less where the robot is in sight."""
CAP = 0.1
"""Distances are truncated at this fraction of the body's diagonal."""
PLANE_SHARE = 0.3
"""A plane has this share of the points at least."""
ALIKE = 1.2
"""Another pose fits equally well if its error is below this multiple of the best one's; a symmetric body has 1.0."""
TURNED, SHIFTED = 0.3, 0.1
"""Poses are different where they are turned by this [rad], or shift the body by this share of its diagonal."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """The cloud of one camera in one contact-free frame, and the state of the body in it."""

    points: FloatArray
    """[m], camera frame, shape (k, 3)."""
    mine: BoolArray
    """Points that may belong to the robot by their colour, shape (k,); all without colour."""
    surface: Surface
    """Of the body in that frame, robot frame."""
    colored: bool = False
    """Whether colour separated the robot from the rest."""


@dataclass(frozen=True, eq=False, slots=True)
class CloudPose:
    """A candidate pose of a camera, and the quality of its fit."""

    T_robot_camera: FloatArray
    """shape (4, 4)."""
    error_m: float
    """Root mean square distance of the visible side from measured points [m], truncated at REACH of the diagonal. Rays through the body
    count as that distance, occluded parts as `UNKNOWN` of its square."""
    gain: float
    """Measured fraction of the visible side, minus the unmeasured fraction and the rays that pass through it; occluded parts count as
    neither [1]. 1 is perfect, below 0 is no fit."""


def find_cloud_pose(views: Sequence[View]) -> CloudPose:
    """Return the pose of a camera from the clouds of some contact-free frames.

    Arguments:
        views: one per frame; the search uses the first, the score all of them.

    Raises:
        DataError: no pose fits, or two poses fit equally well (a symmetric body).
    """
    poses = search_cloud_poses(views)
    size = size_of(views[0].surface)
    if not poses or poses[0].gain < LEAST:
        raise DataError(
            "no pose was found at which the clouds of the free frames show the robot. Record markers, write "
            "T_robot_camera in recording.toml, or declare the robot's colour"
        )
    best = poses[0]
    for other in poses[1:]:
        turn, shift = difference(best.T_robot_camera, other.T_robot_camera, views[0].surface)
        apart = turn > TURNED or shift > SHIFTED * size
        if apart and other.error_m < ALIKE * best.error_m:
            raise DataError(
                f"two poses fit the clouds equally well: the residuals are {1e3 * best.error_m:.3g} and {1e3 * other.error_m:.3g} mm, "
                f"and they differ by {np.degrees(turn):.0f}° and {1e3 * shift:.0f} mm. Is the robot symmetric? Record markers, pull cables in free frames, or "
                f"write T_robot_camera in recording.toml"
            )
    return best


def settle_cloud_pose(views: Sequence[View], T_robot_camera: FloatArray) -> CloudPose:
    """Refine a pose by ICP (closest points of all views) from a start; return the pose and the quality of its fit.

    Arguments:
        views: the cloud of the camera in each frame.
        T_robot_camera: off by a tenth of the body's diagonal at most, shape (4, 4).
    """
    size = size_of(views[0].surface)
    return _settled([_Fine(view, size) for view in views], T_robot_camera, size)


def difference(T: FloatArray, other: FloatArray, surface: Surface) -> tuple[float, float]:
    """Return the rotation angle between two poses [rad], and the distance between the positions of the body's centre under them [m]."""
    D = T @ invert_pose(other)
    middle = surface.positions.mean(axis=0)
    angle = float(np.arccos(np.clip((np.trace(D[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return angle, float(np.linalg.norm(D[:3, :3] @ middle + D[:3, 3] - middle))


def search_cloud_poses(views: Sequence[View]) -> list[CloudPose]:
    """Return poses of a camera under which the clouds show the body, best first, each different from those before."""
    first, size = views[0], size_of(views[0].surface)
    scene = _scene(first, size)
    if len(scene) < 50:
        return []
    samples = spread_samples(first.surface, 3 * SAMPLES)
    starts = _on_the_grid(scene, samples, size)
    closer = _closest(scene, samples, starts, size)
    fine = [_Fine(view, size) for view in views]
    fitted = [_settled(fine, T, size) for T in closer]
    found: list[CloudPose] = []
    for pose in sorted(fitted, key=lambda pose: pose.error_m):
        if all(_different(pose, other, first.surface, size) for other in found):
            found.append(pose)
    return found


def _different(one: CloudPose, other: CloudPose, surface: Surface, size: float) -> bool:
    turn, shift = difference(one.T_robot_camera, other.T_robot_camera, surface)
    return turn > TURNED or shift > SHIFTED * size


def _scene(view: View, size: float) -> FloatArray:
    """Return the points among which the body is sought [m], thinned, without planes larger than the body, shape (s, 3)."""
    points = voxel_grid(PointCloud(view.points[view.mine]), 0.02 * size).points
    if view.colored:
        return points
    while len(points) > 200:
        plane = find_plane(points, 0.02 * size, rng=np.random.default_rng(0))
        on = np.abs(plane.distance(points)) < 0.02 * size
        width = np.linalg.norm(np.ptp(points[on], axis=0)) if on.any() else 0.0
        if on.mean() < PLANE_SHARE or width < 1.5 * size:
            break
        points = points[np.abs(plane.distance(points)) >= REACH * size]  # the noise of distant points is removed with it
    return points


def _rotations() -> FloatArray:
    """Return rotations spread evenly over all, shape (ROTATIONS, 3, 3) (Alexa, "Super-Fibonacci spirals", 2022)."""
    from scipy.spatial.transform import Rotation

    s = np.arange(ROTATIONS) + 0.5
    r, q = np.sqrt(s / ROTATIONS), np.sqrt(1.0 - s / ROTATIONS)
    alpha, beta = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / 1.533751168755204288118041
    return np.asarray(
        Rotation.from_quat(np.stack([r * np.sin(alpha), r * np.cos(alpha), q * np.sin(beta), q * np.cos(beta)], 1)).as_matrix()
    )


def _on_the_grid(scene: FloatArray, samples: Samples, size: float) -> list[FloatArray]:
    """Return T_camera_robot of the best poses of the grid, each (4, 4)."""
    near = _DistanceMap(scene, 0.02 * size, CAP * size)
    seeds = scene[_spread(scene, 0.15 * size)]
    scored: list[tuple[float, FloatArray]] = []
    for R in _rotations():
        turned, facing = samples.places @ R.T, samples.normals @ R.T
        bare = samples.seen[int(np.argmax(samples.eyes @ R.T @ -seeds.mean(axis=0)))]
        looking = bare & (np.einsum("pc,c->p", facing, seeds.mean(axis=0)) < -0.2 * np.linalg.norm(seeds.mean(axis=0)))
        side = turned[looking][:SAMPLES]
        if len(side) < 10:
            continue
        middle = side[np.argmin(((side - side.mean(axis=0)) ** 2).sum(axis=1))]  # a visible point comes to lie on a seed
        shifts = seeds - middle
        score = near(side[None] + shifts[:, None]).mean(axis=1)
        for j in np.argsort(score)[:6]:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, shifts[j]
            scored.append((float(score[j]), T))
    return [T for _, T in sorted(scored, key=lambda s: s[0])[:CLOSER]]


def _spread(points: FloatArray, spacing: float) -> IntArray:
    """Return one point of each cube of an edge [m], SEEDS of them at most."""
    _, first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
    return first if len(first) <= SEEDS else np.random.default_rng(0).choice(first, SEEDS, replace=False)


class _DistanceMap:
    """Distances to the nearest measured point on a grid, cut off."""

    def __init__(self, points: FloatArray, cell: float, cap: float) -> None:
        self.low = points.min(axis=0) - cap
        volume = float(np.prod(points.max(axis=0) + cap - self.low))
        self.cell, self.cap = (cell := max(cell, (volume / MOST_CELLS) ** (1 / 3))), cap
        shape = np.ceil((points.max(axis=0) + cap - self.low) / cell).astype(int) + 1
        empty = np.ones(shape, dtype=bool)
        empty[tuple(((points - self.low) / cell).astype(int).T)] = False
        self.map = np.minimum(distance_transform_edt(empty) * cell, cap).astype(np.float32)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return distances [m], shape (…,), of points (…, 3)."""
        at = np.floor((points - self.low) / self.cell).astype(np.int64)
        inside = ((at >= 0) & (at < self.map.shape)).all(axis=-1)
        at = np.where(inside[..., None], at, 0)
        return np.asarray(np.where(inside, self.map[at[..., 0], at[..., 1], at[..., 2]], self.cap))


def _closest(scene: FloatArray, samples: Samples, starts: Sequence[FloatArray], size: float) -> list[FloatArray]:
    """Return T_robot_camera of the poses to which closest points lead, best first, FINAL at most, each (4, 4)."""
    sides, done = [(samples, cKDTree(scene))], []
    for start in starts:
        T = _registered(sides, start, size * np.geomspace(2.0 * CAP, REACH, COARSE_STEPS))
        placed, looking = samples.looking(T, 0.1)
        distance = np.asarray(sides[0][1].query(placed[looking])[0])
        done.append((float(np.minimum(distance, CAP * size).mean()) if len(distance) else np.inf, invert_pose(T)))
    result: list[FloatArray] = []
    for _, T in sorted(done, key=lambda one: one[0]):
        if len(result) < FINAL and all(poses_apart(T, other, samples.places) > 0.05 * size for other in result):
            result.append(T)
    return result


def _registered(sides: Sequence[tuple[Samples, Any]], T: FloatArray, reaches: FloatArray) -> FloatArray:
    """Return T_camera_robot to which closest points lead, (4, 4): of each side of the body its visible samples and a tree of the measured points.

    Pairs within a reach that shrinks, one step each [m], count.
    """
    for reach in reaches.tolist():
        a, b = [], []
        for samples, tree in sides:
            placed, looking = samples.looking(T, 0.1)
            distance, index = tree.query(placed[looking], distance_upper_bound=reach)
            near = np.isfinite(distance)
            a.append(tree.data[index[near]])
            b.append(placed[looking][near])
        if sum(len(part) for part in b) < 10:
            break
        T = _rigid(np.vstack(a), np.vstack(b)) @ T
    return T


def _rigid(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the pose that takes b (n, 3) best onto a (n, 3), also where they do not determine it."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    R = rotation_between(a - mean_a, b - mean_b)
    return make_pose(R, mean_a - R @ mean_b)


class _Fine:
    """A view with finer samples of the body and thinned points."""

    def __init__(self, view: View, size: float) -> None:
        self.surface = view.surface
        self.samples = spread_samples(view.surface, FINE)
        self.points = voxel_grid(PointCloud(view.points[view.mine]), 0.01 * size).points
        self.rays = view.points[:: max(1, len(view.points) // RAYS)]
        self.others = view.points[~view.mine] if view.colored else self.rays
        self.others = self.others[:: max(1, len(self.others) // RAYS)]
        self.ways = cKDTree(_unit(self.others)) if len(self.others) > 1 else None
        self.width = (
            0.0 if self.ways is None else 2.0 * float(np.median(np.asarray(self.ways.query(self.ways.data, k=2)[0])[:, 1]))
        )

    def near(self, T: FloatArray, size: float) -> Any:
        """Return a tree of the points about the body under a pose."""
        placed = transform_points(T, self.points)
        low, high = self.surface.positions.min(axis=0) - 0.3 * size, self.surface.positions.max(axis=0) + 0.3 * size
        inside = ((placed >= low) & (placed <= high)).all(axis=1)
        return cKDTree(self.points[inside] if inside.any() else np.full((1, 3), 1e3))

    def hidden(self, placed: FloatArray, before: float) -> BoolArray:
        """Return which points [m], camera frame, shape (p, 3), something else hides that was measured more than so far before them [m]."""
        if self.ways is None:
            return np.zeros(len(placed), dtype=bool)
        angle, index = self.ways.query(_unit(placed))
        in_front = np.linalg.norm(self.others[index], axis=1) < np.linalg.norm(placed, axis=1) - before
        return np.asarray(in_front & (angle < self.width))


def _settled(views: Sequence[_Fine], T_robot_camera: FloatArray, size: float) -> CloudPose:
    """Return the pose to which closest points of all views lead, with finer points and a reach that shrinks, and how it fits."""
    trees = [view.near(T_robot_camera, size) for view in views]
    sides = [(view.samples, tree) for view, tree in zip(views, trees)]
    T = _registered(sides, invert_pose(T_robot_camera), size * np.geomspace(CAP, REACH, FINE_STEPS))
    return _judged(views, trees, invert_pose(T), size)


def _judged(views: Sequence[_Fine], trees: Sequence[Any], T: FloatArray, size: float) -> CloudPose:
    """Return error and gain of a pose: each visible sample is near a measured point or not, each ray ends on the body or behind it."""
    limit, squares = REACH * size, []
    for view, tree in zip(views, trees):
        placed, looking = view.samples.looking(invert_pose(T), 0.1)
        square = np.minimum(tree.query(placed[looking])[0] / limit, 1.0) ** 2
        squares.append(np.where(view.hidden(placed[looking], 2.0 * limit), np.minimum(square, UNKNOWN), square))
    bare = float(np.concatenate(squares).mean())
    through = float(np.mean([_seen_through(view, T, limit) for view in views]))
    return CloudPose(T, limit * float(np.sqrt(bare + through)), 1.0 - 2.0 * bare - 2.0 * through)


def _unit(points: FloatArray) -> FloatArray:
    return np.asarray(points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12))


def _seen_through(view: _Fine, T: FloatArray, limit: float) -> float:
    """Return which share of the rays that meet the body end behind it [1]."""
    points = transform_points(T, view.rays)
    met = view.surface.cast(points, np.broadcast_to(T[:3, 3], points.shape), reach=np.inf)
    if not len(met.index):
        return 1.0
    ray = np.linalg.norm(points[met.index] - T[:3, 3], axis=1)
    far = np.linalg.norm(met.place(view.surface.positions) - T[:3, 3], axis=1)
    return float((ray - far > 2.0 * limit).mean())
