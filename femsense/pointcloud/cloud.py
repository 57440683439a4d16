"""Point clouds, and the files and depth images they come from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.arrays import FloatArray, as_points, freeze
from femsense.errors import InputError
from femsense.pointcloud.grid import positive
from femsense.pointcloud.pcd import read_pcd_fields
from femsense.pointcloud.ply import read_ply_vertices

_SUFFIXES = (".ply", ".pcd")


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


def read_cloud(path: str | Path) -> PointCloud:
    """Return the cloud of a PLY or PCD file; points that are not finite are left out.

    Arguments:
        path: the file; positions in metres.
    Raises:
        InputError: no such file, another format, a broken or shortened file.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a PLY or PCD file")
    _check_suffix(file)
    fields = read_pcd_fields(file) if file.suffix.lower() == ".pcd" else read_ply_vertices(file)
    return _cloud_of_fields(fields, file)


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY or PCD (PCD keeps single precision, colours become bytes).

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    file = Path(path)
    _check_suffix(file)
    if not file.parent.is_dir():
        raise InputError("no such folder", where=file.parent, expected="a folder that exists")
    import open3d as o3d

    data = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.copy()))
    if cloud.colors is not None:
        data.colors = o3d.utility.Vector3dVector(cloud.colors.copy())
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        written = o3d.io.write_point_cloud(str(file), data)
    if not written:
        raise InputError("the file could not be written", where=file, found=f"{len(cloud)} points", expected="a writable place")


# --- helpers ----------------------------------------------------------------------------------------------------------


def _check_suffix(file: Path) -> None:
    if file.suffix.lower() not in _SUFFIXES:
        raise InputError("not a format of point clouds", where=file, found=file.suffix or "no suffix", expected=".ply or .pcd")


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


def _cloud_of_fields(fields: dict[str, npt.NDArray[np.generic]], file: Path) -> PointCloud:
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError("fields are missing", where=file, found=", ".join(fields), expected="x, y, z")
    points = np.stack([fields[name].astype(np.float64) for name in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1)
    colors = _field_colors(fields)
    return PointCloud(points[finite], None if colors is None else colors[finite])


def _field_colors(fields: dict[str, npt.NDArray[np.generic]]) -> FloatArray | None:
    """Return colours (n, 3) in 0 … 1: packed as in PCD, or three numbers as in PLY (whole ones count up to their type's largest)."""
    packed = fields.get("rgba", fields.get("rgb"))
    if packed is not None:
        return _unpacked(packed)
    if not all(name in fields for name in ("red", "green", "blue")):
        return None
    columns = np.stack([fields[name] for name in ("red", "green", "blue")], axis=1)
    whole = np.issubdtype(columns.dtype, np.integer)
    return columns / float(np.iinfo(columns.dtype).max) if whole else columns.astype(np.float64)


def _unpacked(packed: npt.NDArray[np.generic]) -> FloatArray:
    """Return colours (n, 3) from 0x..RRGGBB, kept as an integer or in the bits of a float."""
    bits = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1) / 255.0
