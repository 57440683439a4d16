"""Depth images, colours and clouds into files, without loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError
from femsense.io.importers.frames import ColorImage, DepthImage
from femsense.pointcloud.cloud import PointCloud

NO_DEPTH = 65535
"""What some cameras write where they see nothing; becomes 0."""
FINE_UNIT = 1e-4
"""Metres in one unit of a depth image that came in floating point: reaches 6.55 m, rounds by 0.03 mm rms."""


def write_depth(path: Path, depth: DepthImage) -> None:
    """Write a depth image as PNG of 16 bits; 65535 becomes 0."""
    image = np.where(depth == NO_DEPTH, 0, depth).astype(np.uint16) if (depth == NO_DEPTH).any() else depth
    _write_png(path, image, 1)


def write_color(path: Path, color: ColorImage) -> None:
    """Write an image (H, W, 3), red first, as PNG."""
    _write_png(path, color[:, :, ::-1], 1)


def write_cloud_file(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: single precision where that loses nothing, colours as bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    single = cloud.points.astype(np.float32)
    short = bool(np.array_equal(single.astype(np.float64), cloud.points))
    kind, name = ("<f4", "float") if short else ("<f8", "double")
    fields: list[Any] = [(axis, kind) for axis in "xyz"]
    lines = [f"property {name} {axis}" for axis in "xyz"]
    if cloud.colors is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue")]
        lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = np.empty(len(cloud), dtype=fields)
    for i, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, i]
    if cloud.colors is not None:
        for i, channel in enumerate(("red", "green", "blue")):
            rows[channel] = np.rint(255.0 * cloud.colors[:, i])
    head = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *lines, "end_header", ""])
    path.write_bytes(head.encode("ascii") + rows.tobytes())


def decoded_image(data: bytes, where: str | Path | None) -> npt.NDArray[Any]:
    """Return a PNG or JPEG as it is: (H, W) or (H, W, 3) with red first. Raises InputError where it is broken."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None or not _whole(data):
        raise InputError(
            "a broken image", where=where, found=f"{len(data)} bytes that begin {data[:8]!r}", expected="PNG or JPEG"
        )
    return np.asarray(image if image.ndim == 2 else image[:, :, 2::-1])


def depth_of_metres(metres: npt.ArrayLike) -> DepthImage:
    """Return a depth image in units of FINE_UNIT from distances [m]; 0 where there is none or it is too far."""
    units = np.rint(np.nan_to_num(np.asarray(metres, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0) / FINE_UNIT)
    return np.where((units > 0) & (units < NO_DEPTH), units, 0).astype(np.uint16)


def _whole(data: bytes) -> bool:
    """Whether the file has its end: decoders return images that are cut off half filled."""
    if data[:4] == b"\x89PNG":
        return b"IEND" in data[-16:]
    return data[:2] != b"\xff\xd8" or b"\xff\xd9" in data[-64:]


def _write_png(path: Path, image: npt.NDArray[Any], effort: int) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, effort]):
        raise InputError("the image could not be written", where=path, found=f"{image.shape}", expected="a writable place")
