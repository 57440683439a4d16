"""Point clouds in PLY and PCD files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.clouds.pcd import read_pcd_fields
from femsense.io.clouds.ply import read_ply_vertices
from femsense.pointcloud.cloud import PointCloud

_SUFFIXES = (".ply", ".pcd")


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
