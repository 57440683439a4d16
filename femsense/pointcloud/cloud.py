"""Point clouds, and the files and depth images they come from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.pointcloud.grid import positive


@dataclass(frozen=True, eq=False, slots=True)
class PointCloud:
    """Points that a camera saw, with their colours where it has them. Raises InputError."""

    points: FloatArray
    """Positions [m], shape [n, 3], finite."""
    colors: FloatArray | None = None
    """Red, green, blue in [0, 1], shape [n, 3], or None."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", freeze(as_points(self.points, "points")))
        if self.colors is None:
            return
        colors = as_points(self.colors, "colors")
        if len(colors) != len(self.points):
            raise InputError("one colour per point", where="colors", found=len(colors), expected=f"{len(self.points)} rows")
        if colors.size and (colors.min() < 0.0 or colors.max() > 1.0):
            span = f"{colors.min():.3g} … {colors.max():.3g}"
            raise InputError("colours out of range", where="colors", found=span, expected="0 … 1", hint="divide bytes by 255")
        object.__setattr__(self, "colors", freeze(colors))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, mask: npt.ArrayLike) -> PointCloud:
        """Return the points that a mask (n,) or indices (k,) choose, in that order."""
        chosen = np.asarray(mask)
        return PointCloud(self.points[chosen], None if self.colors is None else self.colors[chosen])


def cloud_from_depth(
    depth: npt.ArrayLike,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    distortion: npt.ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    depth_unit_m: float = 0.001,
    *,
    color: npt.ArrayLike | None = None,
) -> PointCloud:
    """Return the points of a depth image in the camera frame (OpenCV: x right, y down, z forward).

        X = ((u − cx)/fx, (v − cy)/fy, 1) · depth · depth_unit_m,   after undoing the lens distortion of (u, v)

    Arguments:
        depth: distances along z in units of depth_unit_m, shape (H, W); 0 where there is none.
        fx, fy, cx, cy: focal lengths and principal point [px]; the centre of the first pixel is (0, 0).
        distortion: OpenCV's k1, k2, p1, p2, k3, shape (5,).
        depth_unit_m: metres per unit of depth.
        color: bytes 0 … 255 or floats 0 … 1, shape (H, W, 3), registered to the depth image.
    Returns:
        The cloud in row-major order of the pixels, pixels without depth left out.
    Raises:
        InputError: wrong shapes, or numbers that are not positive.
    """
    image = np.asarray(depth)
    if image.ndim != 2:
        raise InputError("the depth image has the wrong shape", where="depth", found=image.shape, expected="(H, W)")
    focal = np.array([positive(fx, "fx"), positive(fy, "fy")])
    unit = positive(depth_unit_m, "depth_unit_m")
    row, column = np.nonzero(np.isfinite(image) & (image > 0))
    rays = (np.stack([column, row], axis=1) - [cx, cy]) / focal
    lens = np.asarray(distortion, dtype=np.float64).ravel()
    if np.any(lens != 0.0):
        rays = _undistort(rays, lens)
    z = image[row, column].astype(np.float64) * unit
    colors = None if color is None else _pixel_colors(color, image.shape)[row, column]
    return PointCloud(np.column_stack([rays * z[:, None], z]), colors)


def _undistort(rays: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return straight rays (n, 2): OpenCV's inverse, then corrected while its forward model says that the error falls."""
    import cv2

    if len(rays) == 0:
        return rays
    straight = np.asarray(cv2.undistortPoints(rays[:, None, :], np.eye(3), distortion), dtype=np.float64).reshape(-1, 2)
    smallest = np.inf
    for _ in range(30):
        spatial = np.column_stack([straight, np.ones(len(straight))])
        bent = cv2.projectPoints(spatial, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0]
        error = rays - np.asarray(bent).reshape(-1, 2)
        size = float(np.abs(error).max())
        if size < 1e-12 or size >= smallest:
            break
        straight, smallest = straight + error, size
    return straight


def _pixel_colors(color: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    image = np.asarray(color)
    if image.shape != (*shape, 3):
        raise InputError("the colour image does not fit", where="color", found=image.shape, expected=(*shape, 3))
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)
