"""Point clouds in PLY, PCD and XYZ files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.clouds.pcd import pcd_viewpoint, read_pcd_fields
from femsense.io.clouds.ply import ply_viewpoint, read_ply_vertices, write_ply
from femsense.io.clouds.xyz import read_xyz_columns
from femsense.pointcloud.cloud import PointCloud

CLOUD_ENDINGS = (".ply", ".pcd", ".xyz")
_WRITTEN = (".ply", ".pcd")
_COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names of three columns of colour, in any case: of most writers, of MeshLab's and VCG's older ones, of hand-made ones."""


def read_cloud(path: str | Path) -> PointCloud:
    """Return the cloud of a PLY, PCD or XYZ file; points that are not finite are left out.

    Arguments:
        path: the file; positions in metres.
    Raises:
        InputError: no such file, another format, a broken or shortened file.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a PLY, PCD or XYZ file")
    _check_suffix(file, CLOUD_ENDINGS)
    readers = {".pcd": read_pcd_fields, ".ply": read_ply_vertices, ".xyz": read_xyz_columns}
    fields = readers[file.suffix.lower()](file)
    return cloud_of_fields(fields, file)


def viewpoint_doubt(path: str | Path) -> str | None:
    """Return a warning for a PCD or PLY file whose header has a sensor pose other than the origin; else None.

    The points are read unchanged, because programs disagree about whether that pose is already applied.
    """
    file = Path(path)
    readers = {".pcd": pcd_viewpoint, ".ply": ply_viewpoint}
    T = readers[file.suffix.lower()](file) if file.suffix.lower() in readers else None
    if T is None:
        return None
    place = ", ".join(f"{value:.4g}" for value in T[:3, 3])
    return (
        f"{file}: its header says that the sensor stood at {place} and {'turned' if not np.allclose(T[:3, :3], np.eye(3)) else 'upright'} "
        "(VIEWPOINT); it is not applied: the points count as of the camera's frame (origin in the camera, z forward). If they are in "
        "another frame, transform them by its inverse first"
    )


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY or PCD; colours become bytes, PCD keeps single precision.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    file = Path(path)
    _check_suffix(file, _WRITTEN)
    if not file.parent.is_dir():
        raise InputError("no such folder", where=file.parent, expected="a folder that exists")
    if file.suffix.lower() == ".ply":
        write_ply(file, cloud)
        return
    import open3d as o3d

    data = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.copy()))
    if cloud.colors is not None:
        data.colors = o3d.utility.Vector3dVector(cloud.colors.copy())
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        written = o3d.io.write_point_cloud(str(file), data)
    if not written:
        raise InputError("the file could not be written", where=file, found=f"{len(cloud)} points", expected="a writable place")


# --- helpers ----------------------------------------------------------------------------------------------------------


def _check_suffix(file: Path, known: tuple[str, ...]) -> None:
    if file.suffix.lower() not in known:
        raise InputError(
            "not a format of point clouds", where=file, found=file.suffix or "no suffix", expected=" or ".join(known)
        )


def cloud_of_fields(fields: dict[str, npt.NDArray[np.generic]], where: str | Path | None) -> PointCloud:
    """Return the cloud of columns of shape (n,) by their names; points that are not finite are left out.

    Arguments:
        fields: x, y, z; colours as rgb or rgba packed in one number, or red, green, blue.
        where: the file, for messages.

    Raises:
        InputError: no x, y or z, or colours in an unknown layout.
    """
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError("fields are missing", where=where, found=", ".join(fields), expected="x, y, z")
    points = np.stack([fields[name].astype(np.float64) for name in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1)
    colors = _field_colors({name.lower(): column for name, column in fields.items()}, where)
    return PointCloud(points[finite], None if colors is None else colors[finite])


def _field_colors(fields: dict[str, npt.NDArray[np.generic]], where: str | Path | None) -> FloatArray | None:
    """Return colours (n, 3) in 0 … 1: packed in one number, three of one field, or three columns. Raises InputError."""
    packed = fields.get("rgba", fields.get("rgb"))
    if packed is not None:
        return _unpacked(packed) if packed.ndim == 1 else _scaled(packed[:, :3], where)
    for names in _COLOR_NAMES:
        if all(name in fields for name in names):
            return _scaled(np.stack([fields[name] for name in names], axis=1), where)
    return None


def _scaled(columns: npt.NDArray[np.generic], where: str | Path | None) -> FloatArray:
    """Return colours in 0 … 1, by the type of whole numbers, or by the largest value: up to 1, 255 or 65535."""
    colors = columns.astype(np.float64)
    if not colors.size:
        return colors
    low, high = float(np.nanmin(colors)), float(np.nanmax(colors))
    whole = np.issubdtype(columns.dtype, np.integer)
    limits: tuple[float, ...] = (255.0, 65535.0) if whole else (1.0, 255.0, 65535.0)
    if whole and columns.dtype.itemsize == 2 and high > 0:
        limits = (65535.0,)
    limit = next((limit for limit in limits if high <= limit), None)
    if low < 0 or limit is None:
        raise InputError(
            "colours that are not understood", where=where, found=f"{low:g} … {high:g}", expected="0 … 1, 0 … 255 or 0 … 65535"
        )
    return np.nan_to_num(colors) / limit


def _unpacked(packed: npt.NDArray[np.generic]) -> FloatArray:
    """Return colours (n, 3) from 0x..RRGGBB, kept as an integer or in the bits of a float."""
    bits = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.int64)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1) / 255.0
