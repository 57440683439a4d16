"""Images as cameras write them: depth of 16 bits (PNG) and colour (PNG, JPEG)."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.model.camera import Camera

PNG, JPEG, JPEG_END = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd9"
"""Marks of the formats; a JPEG may have zeros behind its end."""


def read_png(path: Path) -> npt.NDArray[Any]:
    """Return an image file as it is: shape (H, W), or (H, W, 3) in the order blue, green, red. Raises InputError."""
    return _decoded(_bytes_of(path), path)


def read_color(path: Path) -> FloatArray:
    """Return a colour image in 0 … 1, shape (H, W, 3), red first; grey becomes three equal channels. Raises InputError."""
    image = read_color_levels(path)
    return np.asarray(image / np.iinfo(image.dtype).max, dtype=np.float64)


def read_color_levels(path: Path) -> npt.NDArray[Any]:
    """Return a colour image in its own whole numbers of 8 or 16 bits, shape (H, W, 3), red first; grey becomes three equal channels. Raises InputError."""
    image = decoded_image(_bytes_of(path), path)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError("not a colour image", where=path, found=str(image.dtype), expected="8 or 16 bits a channel")
    return np.stack([image] * 3, axis=2) if image.ndim == 2 else image


def decoded_image(data: bytes, where: str | Path | None) -> npt.NDArray[Any]:
    """Return a PNG or JPEG as it is: (H, W) or (H, W, 3) with red first. Raises InputError where it is broken."""
    image = _decoded(data, where)
    return image if image.ndim == 2 else image[:, :, 2::-1]


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None


def _decoded(data: bytes, where: str | Path | None) -> npt.NDArray[Any]:
    import cv2

    if data.startswith(PNG):
        _check_png(data, where)
    cut = data.startswith(JPEG) and JPEG_END not in data[-64:]
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data and not cut else None
    if image is None:
        raise InputError(
            "a broken image",
            where=where,
            found=f"{len(data)} bytes that begin {data[:8]!r}",
            expected="a whole PNG or JPEG image",
        )
    return np.asarray(image)


def png_header(path: Path) -> tuple[int, int, int, int] | None:
    """Return (width, height, bits a channel, colour type) of a PNG image; None where the file is none."""
    with path.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or not head.startswith(PNG) or head[12:16] != b"IHDR":
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"), head[24], head[25]


def check_image_size(width: int, height: int, camera: Camera, file: Path) -> None:
    """Refuse an image whose size [px] is not that of its camera. Raises InputError."""
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            "the image has another size than the camera table says",
            where=file,
            found=f"{width} × {height}",
            expected=f"{camera.width} × {camera.height}",
            hint="the intrinsics belong to one size: use those of this one",
        )


def _check_png(data: bytes, where: str | Path | None) -> None:
    """Refuse a PNG that is cut off or damaged: decoders return such images half filled."""
    position = len(PNG)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        body, mark = data[position + 4 : end - 4], data[end - 4 : end]
        if end > len(data) or zlib.crc32(body) != int.from_bytes(mark, "big"):
            break
        if body[:4] == b"IEND":
            return
        position = end
    raise InputError(
        "a broken image",
        where=where,
        found=f"damaged or cut off at byte {position} of {len(data)}",
        expected="a whole PNG image",
        hint="leave the file out: the frame then has no cloud",
    )
