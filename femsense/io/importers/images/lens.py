"""Lenses: from pixels to rays and back, and colours registered to a depth image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.io.importers.frames import ColorImage, DepthImage, Lens

OUTSIDE = -9.0
"""A pixel beside every image [px]."""
STEPS = 50
"""Fixed-point steps of the inverse; at the distortions of depth cameras ten reach single precision."""


def pixel_rays(lens: Lens) -> FloatArray:
    """Return the straight ray (x, y, 1) of every pixel as x, y, shape (H, W, 2)."""
    column, row = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(lens.height, dtype=np.float64))
    bent = np.stack([(column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy], axis=-1)
    if not np.any(lens.distortion != 0.0):
        return bent
    if lens.model == "kannala_brandt":
        return _straight_fisheye(bent, lens.distortion)
    straight = bent.copy()
    for _ in range(STEPS):
        error = bent - _bent(straight, lens)
        straight = straight + error
        if np.abs(error).max() < 1e-12:
            break
    return straight


def project(points: npt.ArrayLike, lens: Lens) -> FloatArray:
    """Return the pixels (n, 2) of points (n, 3) [m] in the camera frame; NaN behind the camera."""
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = np.where(xyz[:, 2:] > 0, xyz[:, :2] / xyz[:, 2:], np.nan)
        if np.any(lens.distortion != 0.0):
            rays = _bent_fisheye(rays, lens.distortion) if lens.model == "kannala_brandt" else _bent(rays, lens)
    return rays * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def depth_points(depth: DepthImage, rays: FloatArray, depth_unit_m: float) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return the points (n, 3) [m] of the pixels that have depth, and the mask of those pixels (H, W)."""
    seen = depth > 0
    z = depth[seen].astype(np.float64) * depth_unit_m
    return np.column_stack([rays[seen] * z[:, None], z]), seen


def registered_color(
    depth: DepthImage,
    rays: FloatArray,
    depth_unit_m: float,
    color: ColorImage,
    color_lens: Lens,
    T_color_depth: npt.ArrayLike,
) -> ColorImage:
    """Return for each depth pixel the colour of the place that it sees, shape (H, W, 3); black where there is none.

    Arguments:
        depth: shape (H, W), 0 where there is none.
        rays: of the depth camera's pixels, shape (H, W, 2); see `pixel_rays`.
        depth_unit_m: metres in one unit of depth.
        color: shape (h, w, 3).
        color_lens: lens of the colour image.
        T_color_depth: maps depth-camera coordinates to colour-camera coordinates, shape (4, 4), translation [m].
    """
    import cv2

    T = np.asarray(T_color_depth, dtype=np.float64)
    z, x, y = depth * depth_unit_m, np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    X, Y, Z = ((T[i, 0] * x + T[i, 1] * y + T[i, 2]) * z + T[i, 3] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = _bent_planes(X / Z, Y / Z, color_lens)
    seen = (depth > 0) & (Z > 0)
    column = np.where(seen, u * color_lens.fx + color_lens.cx, OUTSIDE).astype(np.float32)
    row = np.where(seen, v * color_lens.fy + color_lens.cy, OUTSIDE).astype(np.float32)
    black = (0, 0, 0)
    found = cv2.remap(color, column, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=black)
    return np.asarray(found, dtype=np.uint8)


def _bent_planes(x: FloatArray, y: FloatArray, lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Return distorted rays (x, y, 1) of any model as x and y, of the shape that came in."""
    if not np.any(lens.distortion != 0.0):
        return x, y
    if lens.model == "kannala_brandt":
        bent = _bent_fisheye(np.stack([x, y], axis=-1), lens.distortion)
        return bent[..., 0], bent[..., 1]
    return _brown(x, y, lens)


def _bent(rays: FloatArray, lens: Lens) -> FloatArray:
    """Return distorted rays: Brown's polynomial, OpenCV's rational one with k4 … k6, or the SDK's variant of it.

    librealsense, `rs2_project_point_to_pixel`: `inverse_brown_conrady` (and modified) takes the tangential terms at the radially
    distorted ray.
    """
    return np.stack(_brown(rays[..., 0], rays[..., 1], lens), axis=-1)


def _brown(x: FloatArray, y: FloatArray, lens: Lens) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([lens.distortion, np.zeros(8)])[:8]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u, v = x * radial, y * radial
    if not (p1 or p2):
        return u, v
    a, b = (u, v) if lens.model == "inverse_brown_conrady" else (x, y)
    ab = a * b
    return u + 2 * p1 * ab + p2 * (r2 + 2 * a * a), v + 2 * p2 * ab + p1 * (r2 + 2 * b * b)


def _bent_fisheye(rays: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return distorted rays of Kannala and Brandt: θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) from the axis."""
    r = np.linalg.norm(rays, axis=-1, keepdims=True)
    scale = _fisheye_angle(np.arctan(r), coefficients) / np.where(r > 0, r, 1.0)
    return np.where(r > 0, rays * scale, rays)


def _straight_fisheye(bent: FloatArray, coefficients: FloatArray) -> FloatArray:
    r = np.linalg.norm(bent, axis=-1, keepdims=True)
    theta = r.copy()
    for _ in range(STEPS):
        theta = np.clip(theta + r - _fisheye_angle(theta, coefficients), 0.0, 0.5 * np.pi - 1e-6)
    return np.where(r > 0, bent * np.tan(theta) / np.where(r > 0, r, 1.0), bent)


def _fisheye_angle(theta: FloatArray, coefficients: FloatArray) -> FloatArray:
    k = np.concatenate([coefficients, np.zeros(4)])[:4]
    t2 = theta * theta
    bent: FloatArray = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    return bent
