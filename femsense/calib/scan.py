# mypy: allow-untyped-decorators
"""The depth measurements of one frame: each point of the robot with its ray and the noise of its depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from femsense.core.arrays import BoolArray, FloatArray, IntArray, read_only
from femsense.core.kernels import njit
from femsense.io.clouds.frame_clouds import read_frame_parts
from femsense.model.camera import CameraNoise
from femsense.model.camera_frame import undo_depth
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.rays import Surface, SurfaceHits
from femsense.pointcloud.segmentation import color_mask

REACH = 0.04
"""Points farther from the surface than this fraction of the body's diagonal are not assigned to the robot (12 mm for the diamond)."""
OFF = 4.0
"""Points farther from the surface than this number of standard deviations are not on it."""
AROUND = 9
"""Number of neighbours, the point included, of which more than half must be on the surface."""
DIM = 0.5
"""Points darker than this fraction of the robot's typical brightness have no reliable hue: they are assigned to it if more than half of
their neighbours are. On a dark gray plate on a soft dome, every fortieth point had the dome's hue, and the estimated force was a quarter
too small."""
SOME = 300
"""Number of rays from which the angle between neighbours is estimated."""
MARGIN = 0.25
"""Points farther from the body than this fraction of its diagonal are background."""
ASIDE = 0.18
"""Points of other things farther from the body than this fraction of its diagonal do not touch it."""
SOME_FAR = 600
"""Points of the background that are kept of each camera, about."""


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """The points of one frame."""

    camera_points: FloatArray
    """Points that may be of the robot, each in the frame of its camera [m], shape (k, 3)."""
    view: IntArray
    """Camera of each, shape (k,)."""
    others: FloatArray
    """Points of everything else, in the frame of their camera [m], shape (o, 3)."""
    others_view: IntArray
    """Camera of each, shape (o,)."""
    segmented: bool = True
    """Whether colour separated the robot from the rest; otherwise all points may belong to the robot."""
    count: FloatArray | None = None
    """How many measured points each point of the robot is the mean of, shape (k,); None: each is one (see `in_blocks`)."""
    far: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """Some points farther from the body at rest than any of its own come, in the frame of their camera [m], shape (g, 3)."""
    far_view: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Camera of each, shape (g,)."""

    @property
    def measured(self) -> FloatArray:
        """Number of measured points that each point of the robot represents, shape (k,)."""
        return np.ones(len(self.view)) if self.count is None else self.count

    def points(self, poses: Sequence[FloatArray]) -> FloatArray:
        """Return the robot's points in the robot frame [m], shape (k, 3)."""
        return _placed(self.camera_points, self.view, poses)

    def surroundings(self, poses: Sequence[FloatArray]) -> FloatArray:
        """Return the points of everything else in the robot frame [m], shape (o, 3)."""
        return _placed(self.others, self.others_view, poses)

    def background(self, poses: Sequence[FloatArray]) -> FloatArray:
        """Return the points of the background in the robot frame [m], shape (g, 3)."""
        return _placed(self.far, self.far_view, poses)

    def origins(self, poses: Sequence[FloatArray]) -> FloatArray:
        """Return where each ray begins in the robot frame [m], shape (k, 3)."""
        return np.array([T[:3, 3] for T in poses])[self.view]

    def ray_std(self, noises: Sequence[CameraNoise]) -> FloatArray:
        """Return the noise of each measured point of the robot along its ray [m], shape (k,)."""
        return ray_std(self.camera_points, self.view, noises)


@dataclass(frozen=True, eq=False, slots=True)
class RayRows:
    """Residual rows of one frame: measured points minus the modelled surface, along the surface normal."""

    hits: SurfaceHits
    points: FloatArray
    """Measured points of the rows, robot frame [m], shape (r, 3)."""
    view: IntArray
    """Camera of each row, shape (r,)."""
    residual: FloatArray
    """[m], shape (r,)."""
    std: FloatArray
    """[m], shape (r,)."""

    def off(self, nodes: BoolArray) -> RayRows:
        """Return the rows on triangles with at least one node that is not among the given ones, shape (n,)."""
        kept = np.asarray(~nodes[self.hits.nodes].all(axis=1))
        return RayRows(self.hits.pick(kept), self.points[kept], self.view[kept], self.residual[kept], self.std[kept])

    def operator(self, node_count: int) -> sp.csr_array:
        """Return the operator from node displacements to the rows, shape (r, 3n)."""
        r = len(self.residual)
        columns = (3 * self.hits.nodes[:, :, None] + np.arange(3)).reshape(r, 9)
        values = (self.hits.weights[:, :, None] * self.hits.normal[:, None, :]).reshape(r, 9)
        return sp.csr_array((values.ravel(), columns.ravel(), 9 * np.arange(r + 1)), shape=(r, 3 * node_count))

    def by_pose(self, pivot: FloatArray, view_count: int) -> FloatArray:
        """Return how the residual moves with (rotation about the pivot [rad], shift [m]) of each camera, shape (r, 6 v)."""
        arm = np.cross(self.points - pivot, self.hits.normal)
        own = np.hstack([arm, self.hits.normal])
        result = np.zeros((len(own), view_count, 6))
        result[np.arange(len(own)), self.view] = own
        return result.reshape(len(own), 6 * view_count)


def read_scan(
    robot: Robot, recording: Recording, k: int, poses: Sequence[FloatArray], positions: FloatArray, *, some: int = SOME_FAR
) -> Scan | None:
    """Return the measured points near the body in frame k; None if the frame has no cloud.

    Colour separates the robot if robot and cloud have one. Otherwise all points may belong to the robot, and the residuals decide.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        k: index of the frame.
        poses: pose of each camera, shape (4, 4).
        positions: approximate nodes of the body [m], shape (n, 3).
        some: points of the background that are kept of each camera, about.
    """
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    own, own_view, rest, rest_view, far, far_view = [], [], [], [], [], []
    margin = MARGIN * size
    segmented = True
    box = np.array([positions.min(axis=0) - margin, positions.max(axis=0) + margin])
    for view, T in enumerate(poses):
        parts = read_frame_parts(recording, k, view=view, T=T, box=box, some=some)
        if parts is None:
            continue
        cloud, sparse = parts
        outside = undo_depth(sparse, robot.observation)
        outside = outside[~in_box(outside @ T[:3, :3].T + T[:3, 3], robot.body.mesh.nodes, margin) & (outside[:, 2] > 0)]
        far.append(outside[:: max(1, len(outside) // some)])
        far_view.append(np.full(len(far[-1]), view))
        points = undo_depth(cloud.points, robot.observation)
        inside = in_box(points @ T[:3, :3].T + T[:3, 3], positions, margin) & (points[:, 2] > 0)
        points, kept = points[inside], cloud.select(inside)
        segmented = segmented and kept.colors is not None and robot.color_rgb is not None
        mine = _of_robot(robot, kept)
        own.append(points[mine])
        other = points[~mine]
        rest.append(other[in_box(other @ T[:3, :3].T + T[:3, 3], positions, ASIDE * size)])
        own_view.append(np.full(len(own[-1]), view))
        rest_view.append(np.full(len(rest[-1]), view))
    if not own:
        return None
    near = (np.vstack(own), np.concatenate(own_view), np.vstack(rest), np.concatenate(rest_view))
    return Scan(*near, segmented, far=np.vstack(far), far_view=np.concatenate(far_view))


def ray_std(points: FloatArray, view: IntArray, noises: Sequence[CameraNoise]) -> FloatArray:
    """Return the noise along their rays [m] of measured points (k, 3) in the frames of their cameras (k,), shape (k,)."""
    z = points[:, 2]
    std = np.empty(len(z))
    for v, noise in enumerate(noises):
        of = view == v
        std[of] = noise.std(z[of])
    return np.asarray(std * np.linalg.norm(points, axis=1) / np.maximum(z, 1e-9))


def ray_rows(
    scan: Scan,
    surface: Surface,
    poses: Sequence[FloatArray],
    noises: Sequence[CameraNoise],
    *,
    reach: float,
) -> RayRows:
    """Cast the ray of each measured point onto the deformed surface, and return one residual row per hit.

    The residual is the distance of the point from the hit face along its normal. Its standard deviation is the noise along the ray times the
    cosine of incidence.

    Arguments:
        scan: measured points of all cameras in one frame.
        surface: the deformed surface.
        poses: T_robot_camera of each camera, shape (4, 4).
        noises: depth noise of each camera.
        reach: maximum distance between a point and its face [m]; points farther away belong to another object.
    """
    points = scan.points(poses)
    hits = surface.cast(points, scan.origins(poses), reach=reach)
    std = scan.ray_std(noises)[hits.index] * np.maximum(hits.cosine, 1e-3)
    return RayRows(hits, points[hits.index], scan.view[hits.index], hits.distance, std)


def parted(scan: Scan, surface: Surface, poses: Sequence[FloatArray], noises: Sequence[CameraNoise], *, reach: float) -> Scan:
    """Return the scan segmented by a state: points on the surface whose neighbours are on it too belong to the robot.

    Arguments:
        scan: the measured points, without colour.
        surface: the deformed surface.
        poses, noises: pose, shape (4, 4), and noise model of each camera.
        reach: largest distance between a measured point and the surface [m], as for `Surface.cast`.
    """
    rows = ray_rows(scan, surface, poses, noises, reach=reach)
    on = np.zeros(len(scan.view), dtype=bool)
    on[rows.hits.index] = np.abs(rows.residual) < OFF * rows.std
    missed = np.setdiff1d(np.arange(len(on)), rows.hits.index)  # grazing rays, and those next to a silhouette
    points = scan.points(poses)
    on[missed] = surface.gap(points[missed]) < 0.5 * OFF * scan.ray_std(noises)[missed]
    own = np.flatnonzero(on)
    if not len(own):
        return scan
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    around = tree.query(points[own], k=min(AROUND, len(on)))[1].reshape(len(own), -1)
    mine = np.zeros(len(on), dtype=bool)
    mine[own] = on[around].mean(axis=1) > 0.5
    return replace(
        scan,
        camera_points=scan.camera_points[mine],
        view=scan.view[mine],
        others=scan.camera_points[~mine],
        others_view=scan.view[~mine],
    )


def pixel_angles(recording: Recording, k: int, scan: Scan) -> list[float]:
    """Return the angle between neighbouring rays of each camera in a frame [rad]: of depth images their own, of a cloud that of its points."""
    result = []
    for view, (file, camera) in enumerate(zip(recording.cloud_files[k], recording.cameras)):
        whole = camera is not None and file is not None and file.suffix.lower() == ".png"
        result.append(1.0 / camera.fx if camera is not None and whole else pixel_of(scan, view))
    return result


def pixel_of(scan: Scan, view: int) -> float:
    """Return the angle between neighbouring rays of a camera [rad], from the robot's points; 0 where there are too few.

    A cloud that was thinned has a larger one, and a wider halo in metres.
    """
    seen = scan.camera_points[scan.view == view]
    if len(seen) < AROUND:
        return 0.0
    rays = seen[:, :2] / seen[:, 2:]
    some = rays[:: max(1, len(rays) // SOME)]
    return float(np.median(np.asarray(cKDTree(rays).query(some, k=2)[0])[:, 1]))


def _of_robot(robot: Robot, cloud: PointCloud) -> BoolArray:
    """Return which points of a cloud have the robot's colour, shape (n,); all of them where there are no colours."""
    if cloud.colors is None or robot.color_rgb is None:
        return np.ones(len(cloud.points), dtype=bool)
    mask = color_mask(cloud.colors, robot.color_rgb)
    robot_like = np.flatnonzero(mask)
    light = np.linalg.norm(cloud.colors[robot_like], axis=1)
    dim = robot_like[light < DIM * np.median(light)] if len(light) else robot_like
    if len(dim):
        tree = cKDTree(cloud.points, balanced_tree=False, compact_nodes=False)
        around = tree.query(cloud.points[dim], k=min(AROUND, len(mask)))[1].reshape(len(dim), -1)
        mask[dim] = mask[around].mean(axis=1) > 0.5
    return mask


def in_box(points: FloatArray, body: FloatArray, margin: float) -> BoolArray:
    """Return which points (k, 3) lie within the box about a body (n, 3) and a margin [m], shape (k,)."""
    inside = np.empty(len(points), dtype=np.bool_)
    _in_box(read_only(points), body.min(axis=0) - margin, body.max(axis=0) + margin, inside)
    return inside


@njit(cache=True)
def _in_box(points, low, high, inside):  # type: ignore[no-untyped-def]
    for i in range(len(points)):
        inside[i] = True
        for c in range(3):
            inside[i] &= low[c] <= points[i, c] <= high[c]


def _placed(points: FloatArray, view: IntArray, poses: Sequence[FloatArray]) -> FloatArray:
    result = np.empty_like(points)
    for v, T in enumerate(poses):
        of = view == v
        result[of] = points[of] @ T[:3, :3].T + T[:3, 3]
    return result
