"""A depth camera that looks at triangles: rays, shading, and files. `rig/depth_noise.py` adds its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose, invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.model.camera import Camera, CameraNoise
from femsense.model.robot import Observation
from femsense.pointcloud.cloud import PointCloud
from femsense.rig.camera_tables import NoiseTable, ViewTable
from femsense.rig.depth_noise import Sight, disturbed
from femsense.rig.lens import pixel_rays, pixels_of

AMBIENT = 0.35
"""Share of the ambient light."""
COLOR_NOISE = 0.012
"""Standard deviation of a colour channel [1]."""
TRUE_DEPTH = Observation()
HIDDEN = 2e-3
"""A marker is hidden if the ray towards it ends more than this before it [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Shape:
    """Triangles of one colour."""

    points: FloatArray
    """[m], shape (n, 3), robot frame."""
    triangles: IntArray
    """Shape (t, 3), outward."""
    color: FloatArray
    """Red, green, blue in [0, 1], shape (3,)."""
    albedo: float = 0.6
    """Diffuse reflectance in the infrared [1]."""
    gloss: float = 0.0
    """Probability that a depth is lost at a specular reflection [1]."""


@dataclass(frozen=True, eq=False, slots=True)
class DepthImage:
    """The images of a camera."""

    depth: FloatArray
    """Along the optical axis [m], shape (H, W); 0: no measurement."""
    color: npt.NDArray[np.uint8]
    """Red, green, blue, shape (H, W, 3)."""
    shape: IntArray
    """Index of the shape in each pixel, shape (H, W); −1: none."""


def camera_of(view: ViewTable, name: str = "", *, noise: CameraNoise | None = None) -> Camera:
    """Return the intrinsics of a view."""
    fy = view.fx if view.fy is None else view.fy
    cx = (view.width - 1) / 2 if view.cx is None else view.cx
    cy = (view.height - 1) / 2 if view.cy is None else view.cy
    distortion = freeze([*view.distortion, 0.0] if len(view.distortion) == 4 else view.distortion)
    lens = (view.width, view.height, view.fx, fy, cx, cy, distortion, view.depth_unit_m, view.distortion_model)
    return Camera(name, *lens, noise)


def pose_of(view: ViewTable) -> FloatArray:
    """Return T_robot_camera, shape (4, 4). Raises InputError."""
    if view.T_robot_camera is not None:
        return check_pose(view.T_robot_camera, "camera.T_robot_camera")
    return look_at(view.eye_m or (), view.target_m or (), roll=np.radians(view.roll_deg))


def look_at(eye: Sequence[float], target: Sequence[float], *, roll: float = 0.0) -> FloatArray:
    """Return T_robot_camera of a camera at `eye` [m] that looks at `target` [m], upright (z up), then turned by `roll` [rad].

    Raises:
        InputError: eye and target coincide.
    """
    forward = np.asarray(target, dtype=float) - np.asarray(eye, dtype=float)
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError(
            "the target of a camera coincides with its position",
            where="camera.target_m",
            found=list(target),
            expected="another place than eye_m",
        )
    z = forward / distance
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(z, x), z], axis=1)
    return make_pose(upright @ rotation_from_vector([0.0, 0.0, roll]), np.asarray(eye, dtype=float))


def render(
    camera: Camera,
    T_robot_camera: FloatArray,
    shapes: Sequence[Shape],
    *,
    noise: NoiseTable | None = None,
    observation: Observation = TRUE_DEPTH,
    rng: np.random.Generator | None = None,
) -> DepthImage:
    """Return the images of a camera.

    Arguments:
        camera: the intrinsics.
        T_robot_camera: its pose, shape (4, 4).
        shapes: the scene, robot frame.
        noise: of the depth; None: exact depth without gaps.
        observation: measured distance along the ray = depth_scale × true distance + depth_offset.
        rng: random numbers of the noise; required with `noise`.
    """
    sight = look(camera, T_robot_camera, shapes)
    color = _shade(shapes, sight.shape, sight.facing, rng)
    seen = sight.shape >= 0
    measured = np.where(seen, sight.depth, 0.0)
    if noise is not None and rng is not None:
        measured = disturbed(sight, noise, camera, rng)
    distance = np.where(measured > 0, measured * np.linalg.norm(sight.rays, axis=-1), 1.0)
    stretch = observation.depth_scale + observation.depth_offset / distance
    return DepthImage(freeze(measured * stretch), color, sight.shape)


def look(camera: Camera, T_robot_camera: FloatArray, shapes: Sequence[Shape]) -> Sight:
    """Return the hits of the rays of a camera at T_robot_camera (4, 4)."""
    rays = pixel_rays(camera)
    depth, shape, facing, normal = _cast(rays, T_robot_camera, shapes)
    albedo, gloss = np.array([[s.albedo, s.gloss] for s in shapes] + [[0.0, 0.0]])[shape].transpose(2, 0, 1)
    return Sight(rays, depth, shape, normal, facing, albedo, gloss)


def cloud_of(image: DepthImage, camera: Camera, which: npt.ArrayLike | None = None) -> PointCloud:
    """Return the measured points of an image with their colours, camera frame, in single precision as a file keeps them; `which` is a mask (H, W)
    of pixels to keep."""
    keep = image.depth > 0
    if which is not None:
        keep &= np.asarray(which)
    points = (pixel_rays(camera)[keep] * image.depth[keep][:, None]).astype(np.float32)
    return PointCloud(points.astype(np.float64), image.color[keep] / 255.0)


def thinned(cloud: PointCloud, size: float) -> PointCloud:
    """Return the first point in each cube of an edge length [m]."""
    cubes = np.floor(cloud.points / size).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return cloud.select(np.sort(first))


def write_images(depth_file: Path, color_file: Path, image: DepthImage, camera: Camera) -> None:
    """Write depth as 16-bit and colour as 8-bit PNG. Raises InputError if a depth exceeds 16 bits."""
    import cv2

    units = np.rint(image.depth / camera.depth_unit)
    if units.max(initial=0.0) > np.iinfo(np.uint16).max:
        raise InputError(
            "depths beyond 16 bits",
            where="camera.depth_unit_m",
            found=f"{image.depth.max():.3g} m in units of {camera.depth_unit:g} m",
            expected=f"depth_unit_m ≥ {image.depth.max() / 65535:.2g}",
        )
    for file, pixels in ((depth_file, units.astype(np.uint16)), (color_file, image.color[..., ::-1])):
        file.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def visible_points(camera: Camera, T_robot_camera: FloatArray, shapes: Sequence[Shape], points: FloatArray) -> BoolArray:
    """Return which points (p, 3) [m], robot frame, are inside the image and not occluded."""
    local = transform_points(invert_pose(T_robot_camera), points)
    ahead = local[:, 2] > 1e-6
    safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
    u, v = pixels_of(camera, safe).T
    inside = ahead & (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
    rays = local / safe[:, 2:]
    hit, shape, _, _ = _cast(rays, T_robot_camera, shapes)
    gap = (local[:, 2] - hit) * np.linalg.norm(rays, axis=1)
    return np.asarray(inside & ((shape < 0) | (gap < HIDDEN)))


def measured_points(T_robot_camera: FloatArray, points: FloatArray, observation: Observation) -> FloatArray:
    """Return points (p, 3) [m] of the robot frame as the camera measures them, without noise, camera frame."""
    local = transform_points(invert_pose(T_robot_camera), points)
    distance = np.linalg.norm(local, axis=1, keepdims=True)
    return np.asarray(local * (observation.depth_scale + observation.depth_offset / distance))


# Rays and light


def _cast(
    rays: FloatArray, T_robot_camera: FloatArray, shapes: Sequence[Shape]
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Return depth [m] (inf: no hit), index of the shape (−1: no hit), cosine between ray and normal, shape (…,),
    and the normal towards the camera (…, 3)."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for shape in shapes:
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(shape.points, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(shape.triangles, dtype=np.uint32)),
        )
    directions = rays @ T_robot_camera[:3, :3].T
    start = np.broadcast_to(T_robot_camera[:3, 3], directions.shape)
    answer: dict[str, Any] = scene.cast_rays(
        o3d.core.Tensor(np.concatenate([start, directions], axis=-1).astype(np.float32)), nthreads=1
    )
    number = answer["geometry_ids"].numpy().astype(np.int64)
    missed = number == int(scene.INVALID_ID)
    normals = answer["primitive_normals"].numpy().astype(np.float64)
    slope = np.einsum("...c,...c->...", normals, directions)
    facing = np.abs(slope) / np.linalg.norm(directions, axis=-1)
    towards = -np.sign(slope)[..., None] * normals @ T_robot_camera[:3, :3]
    depth = np.full(number.shape, np.inf)
    for i, shape in enumerate(shapes):
        mine = number == i
        depth[mine] = _exact_depth(shape, answer["primitive_ids"].numpy()[mine], start[mine], directions[mine])
    return depth, np.where(missed, -1, number), np.where(missed, 0.0, facing), np.where(missed[..., None], 0.0, towards)


def _exact_depth(shape: Shape, triangle: npt.NDArray[Any], start: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the intersections of rays (k, 3) with the planes of their triangles, in double precision, as multiples of the direction."""
    a, b, c = (shape.points[shape.triangles[triangle.astype(np.int64), i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(np.einsum("kc,kc->k", a - start, normal) / np.einsum("kc,kc->k", direction, normal))


def _shade(
    shapes: Sequence[Shape], shape: IntArray, facing: FloatArray, rng: np.random.Generator | None
) -> npt.NDArray[np.uint8]:
    """Return the colours under a lamp at the camera, shape (H, W, 3)."""
    palette = np.vstack([np.zeros((1, 3)), *(s.color[None] for s in shapes)])
    color = palette[shape + 1] * (AMBIENT + (1.0 - AMBIENT) * facing)[..., None]
    if rng is not None:
        color = color + COLOR_NOISE * rng.standard_normal(color.shape)
    return np.asarray(np.rint(255.0 * np.clip(color, 0.0, 1.0)), dtype=np.uint8)
