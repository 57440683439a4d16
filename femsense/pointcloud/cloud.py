# mypy: allow-untyped-decorators
"""Point clouds, and their construction from depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.core.kernels import njit
from femsense.pointcloud.grid import positive
from femsense.pointcloud.rays import GRAZING


@dataclass(frozen=True, eq=False, slots=True)
class PointCloud:
    """Measured points of a camera, with colours if it has them. Raises InputError."""

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
        """Return the points selected by a mask (n,) or by indices (k,), in that order."""
        chosen, part = np.asarray(mask), object.__new__(PointCloud)  # no checks: a subset of valid points is valid
        object.__setattr__(part, "points", freeze(self.points[chosen]))
        object.__setattr__(part, "colors", None if self.colors is None else freeze(self.colors[chosen]))
        return part


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
    distortion_model: str = "brown_conrady",
    within: tuple[FloatArray, FloatArray, FloatArray] | None = None,
) -> PointCloud:
    """Return the points of a depth image in the camera frame (OpenCV: x right, y down, z forward).

        X = ((u − cx)/fx, (v − cy)/fy, 1) · depth · depth_unit_m,   after undoing the lens distortion of (u, v)

    Arguments:
        depth: distances along z in units of depth_unit_m, shape (H, W); 0: no measurement.
        fx, fy, cx, cy: focal lengths and principal point [px]; the centre of the first pixel is (0, 0).
        distortion: OpenCV's k1, k2, p1, p2, k3, shape (5,) or with k4, k5, k6 (8,); of a fisheye k1, k2, k3, k4 and zeros.
        depth_unit_m: metres per unit of depth.
        color: whole numbers up to the largest of their type or floats 0 … 1, shape (H, W, 3), registered to the depth image.
        distortion_model: "brown_conrady" (straight rays to bent ones),
            "inverse_brown_conrady" (the same polynomial takes bent rays to straight ones, as in RealSense's SDK) or
            "kannala_brandt" (OpenCV's fisheye).
        within: restrict the result to a box, which is faster than a selection afterwards: the pose of the camera in the frame of the box,
            shape (4, 4), and the lower and upper corner of the box [m], shapes (3,).
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
    lens = np.asarray(distortion, dtype=np.float64).ravel()
    T, low, high = EVERYWHERE if within is None or lens.any() else within
    points, seen = _lifted(np.ascontiguousarray(image), cx, cy, focal[0], focal[1], unit, T[:3], low, high)
    if lens.any():
        points[:, :2] = straight_rays(points[:, :2] / points[:, 2:], lens, distortion_model) * points[:, 2:]
    colors = None if color is None else _pixel_colors(color, image.shape, seen)
    return PointCloud(points, colors)


EVERYWHERE = (np.eye(4), np.full(3, -np.inf), np.full(3, np.inf))
"""An unbounded box, see `cloud_from_depth`."""


@njit(cache=True)
def _lifted(depth, cx, cy, fx, fy, unit, T, low, high):  # type: ignore[no-untyped-def]
    """Return the points along straight rays that lie in a box, and their indices in the flat image."""
    height, width = depth.shape
    points, seen, count = np.empty((height * width, 3)), np.empty(height * width, dtype=np.int64), 0
    for v in range(height):
        for u in range(width):
            z = depth[v, u] * unit
            if not 0.0 < z < np.inf:
                continue
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            inside = True
            for c in range(3):
                placed = T[c, 0] * x + T[c, 1] * y + T[c, 2] * z + T[c, 3]
                inside = inside and low[c] <= placed <= high[c]
            if inside:
                points[count, 0], points[count, 1], points[count, 2], seen[count] = x, y, z, v * width + u
                count += 1
    return points[:count].copy(), seen[:count].copy()


def without_mixed_pixels(depth: npt.ArrayLike, fx: float, fy: float) -> FloatArray:
    """Remove mixed (flying) pixels from a depth image: their depth lies between two surfaces, and looks like a small object at an edge.

    A mixed pixel is farther than its neighbour on one side and nearer than that on the other, along a row or a column, each by more than on a
    surface at a cosine of incidence of GRAZING. Thin objects are nearer than both neighbours and are kept.

    Arguments:
        depth: distances along z, shape (H, W); 0: no measurement.
        fx, fy: focal lengths [px].
    """
    image = np.array(depth, dtype=np.float64)
    mixed = np.zeros(image.shape, dtype=bool)
    for lines, marked, focal in ((image, mixed, fx), (image.T, mixed.T, fy)):
        middle, before, after = lines[:, 1:-1], lines[:, :-2], lines[:, 2:]
        step = middle / focal * np.sqrt(1.0 / GRAZING**2 - 1.0)
        rises, falls = (middle - before > step) & (after - middle > step), (before - middle > step) & (middle - after > step)
        marked[:, 1:-1] |= (rises | falls) & (before > 0) & (middle > 0) & (after > 0)
    image[mixed] = 0.0
    return image


def straight_rays(rays: FloatArray, distortion: FloatArray, model: str) -> FloatArray:
    """Return undistorted rays (n, 2) of distorted ones (n, 2); distortion and model as for `cloud_from_depth`. Raises InputError."""
    if not np.any(distortion != 0.0):
        return rays
    if model == "inverse_brown_conrady":
        return _bent(rays, distortion)
    if model == "kannala_brandt":
        return _unfished(rays, distortion[:4])
    if model != "brown_conrady":
        known = "brown_conrady | inverse_brown_conrady | kannala_brandt"
        raise InputError("unknown lens model", where="distortion_model", found=model, expected=known)
    return _undistort(rays, distortion)


def _unfished(rays: FloatArray, k: FloatArray) -> FloatArray:
    """Return straight rays (n, 2): θ from |ray| = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) by Newton,
    then tan θ (Kannala and Brandt 2006)."""
    bent = np.linalg.norm(rays, axis=1)
    theta = bent.copy()
    powers = np.arange(3, 10, 2)
    for _ in range(30):
        value = theta + (k * theta[:, None] ** powers).sum(axis=1) - bent
        step = value / (1.0 + (k * powers * theta[:, None] ** (powers - 1)).sum(axis=1))
        theta = theta - step
        if np.abs(step).max(initial=0.0) < 1e-14:
            break
    scale = np.divide(np.tan(theta), bent, out=np.ones_like(bent), where=bent > 0)
    return np.asarray(rays * scale[:, None])


def _bent(rays: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return distorted rays (n, 2) by OpenCV's forward model."""
    import cv2

    if len(rays) == 0:
        return rays
    spatial = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(cv2.projectPoints(spatial, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0], dtype=np.float64).reshape(
        -1, 2
    )


def _undistort(rays: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return undistorted rays (n, 2): OpenCV's inverse, then corrected while the error under the forward model decreases."""
    import cv2

    if len(rays) == 0:
        return rays
    straight = np.asarray(cv2.undistortPoints(rays[:, None, :], np.eye(3), distortion), dtype=np.float64).reshape(-1, 2)
    smallest = np.inf
    for _ in range(30):
        error = rays - _bent(straight, distortion)
        size = float(np.abs(error).max())
        if size < 1e-12 or size >= smallest:
            break
        straight, smallest = straight + error, size
    return straight


def _pixel_colors(color: npt.ArrayLike, shape: tuple[int, ...], seen: IntArray) -> FloatArray:
    """Return the colours of pixels by their indices in a flat image, 0 … 1, shape (k, 3)."""
    image = np.asarray(color)
    if image.shape != (*shape, 3):
        raise InputError("the colour image does not fit", where="color", found=image.shape, expected=(*shape, 3))
    own = image.reshape(-1, 3)[seen]
    return own / np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else own.astype(np.float64)
