"""Lenses: from pixels to rays and back, and colours registered to a depth image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.io.importers.frames import ColorImage, DepthImage, Lens

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
    points, seen = depth_points(depth, rays, depth_unit_m)
    T = np.asarray(T_color_depth, dtype=np.float64)
    pixel = np.rint(project(points @ T[:3, :3].T + T[:3, 3], color_lens))
    inside = (pixel >= 0).all(axis=1) & (pixel < [color_lens.width, color_lens.height]).all(axis=1)
    column, row = pixel[inside].astype(np.int64).T
    values = np.zeros((len(points), 3), dtype=np.uint8)
    values[inside] = color[row, column]
    result = np.zeros((*depth.shape, 3), dtype=np.uint8)
    result[seen] = values
    return result


def _bent(rays: FloatArray, lens: Lens) -> FloatArray:
    """Return distorted rays: Brown's polynomial, OpenCV's rational one with k4 … k6, or the SDK's variant of it.

    librealsense, `rs2_project_point_to_pixel`: `inverse_brown_conrady` (and modified) takes the tangential terms at the radially
    distorted ray.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([lens.distortion, np.zeros(8)])[:8]
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    at = (x * radial, y * radial) if lens.model == "inverse_brown_conrady" else (x, y)
    u = x * radial + 2 * p1 * at[0] * at[1] + p2 * (r2 + 2 * at[0] ** 2)
    v = y * radial + 2 * p2 * at[0] * at[1] + p1 * (r2 + 2 * at[1] ** 2)
    return np.stack([u, v], axis=-1)


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
