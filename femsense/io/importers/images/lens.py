"""Lenses of imported pictures: from pixels to rays, and colours registered to a depth image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.io.importers.frames import ColorImage, DepthImage, is_kept_as_image
from femsense.model.camera import Camera
from femsense.pointcloud.cloud import straight_rays

OUTSIDE = -9.0
"""A pixel outside every image [px]."""
STEPS = 50
"""Fixed-point steps of the inverse; at the distortions of depth cameras ten reach single precision."""


def pixel_rays(lens: Camera) -> FloatArray:
    """Return the straight ray (x, y, 1) of every pixel as x, y, shape (H, W, 2)."""
    column, row = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(lens.height, dtype=np.float64))
    bent = np.stack([(column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy], axis=-1)
    if not is_kept_as_image(lens):
        return _sdk_straight(bent, lens)
    return straight_rays(bent.reshape(-1, 2), lens.distortion, lens.distortion_model).reshape(bent.shape)


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
    color_lens: Camera,
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
    # planes of one coordinate each: ten times as fast as cv2.projectPoints on a list of points
    z, x, y = depth * depth_unit_m, np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    X, Y, Z = ((T[i, 0] * x + T[i, 1] * y + T[i, 2]) * z + T[i, 3] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = _bent(X / Z, Y / Z, color_lens)
    seen = (depth > 0) & (Z > 0)
    column = np.where(seen, u * color_lens.fx + color_lens.cx, OUTSIDE).astype(np.float32)
    row = np.where(seen, v * color_lens.fy + color_lens.cy, OUTSIDE).astype(np.float32)
    black = (0, 0, 0)
    found = cv2.remap(color, column, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=black)
    return np.asarray(found, dtype=np.uint8)


def _bent(x: FloatArray, y: FloatArray, lens: Camera) -> tuple[FloatArray, FloatArray]:
    """Return distorted rays (x, y, 1) as x and y, of the shape of the arguments.

    Brown's polynomial, OpenCV's rational one with k4 … k6, or the variant of the RealSense SDK, whose tangential terms are taken at the
    radially distorted ray (librealsense, `rs2_project_point_to_pixel`). Fisheye: Kannala and Brandt, θ (1 + k1 θ² + … + k4 θ⁸).
    """
    if not np.any(lens.distortion != 0.0):
        return x, y
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([lens.distortion, np.zeros(8)])[:8]
    r2 = x * x + y * y
    if lens.distortion_model == "kannala_brandt":
        r = np.sqrt(r2)
        t2 = np.arctan(r) ** 2
        scale = np.arctan(r) * (1 + t2 * (k1 + t2 * (k2 + t2 * (p1 + t2 * p2)))) / np.where(r > 0, r, 1.0)
        return np.where(r > 0, x * scale, x), np.where(r > 0, y * scale, y)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u, v = x * radial, y * radial
    a, b = (x, y) if is_kept_as_image(lens) else (u, v)
    return u + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), v + 2 * p2 * a * b + p1 * (r2 + 2 * b * b)


def _sdk_straight(bent: FloatArray, lens: Camera) -> FloatArray:
    """Return the rays (H, W, 2) that the RealSense SDK's variant distorts into these."""
    straight = bent
    for _ in range(STEPS):
        error = bent - np.stack(_bent(straight[..., 0], straight[..., 1], lens), axis=-1)
        straight = straight + error
        if np.abs(error).max() < 1e-12:
            break
    return straight
