"""Depth images and colours into files, without loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError
from femsense.io.importers.frames import ColorImage, DepthImage

NO_DEPTH = 65535
"""Value of some cameras for a pixel without depth; becomes 0."""
FINE_UNIT = 1e-4
"""Metres in one unit of a depth image that came in floating point: reaches 6.55 m, rounds by 0.03 mm rms."""


def write_depth(path: Path, depth: DepthImage) -> None:
    """Write a depth image as PNG of 16 bits; 65535 becomes 0."""
    _write_png(path, np.where(depth == NO_DEPTH, 0, depth).astype(np.uint16))


def write_color(path: Path, color: ColorImage) -> None:
    """Write an image (H, W, 3), red first, as PNG."""
    _write_png(path, color[:, :, ::-1])


def depth_of_metres(metres: npt.ArrayLike) -> DepthImage:
    """Return a depth image in units of FINE_UNIT from distances [m]; 0 where there is none or it is too far."""
    units = np.rint(np.nan_to_num(np.asarray(metres, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0) / FINE_UNIT)
    return np.where((units > 0) & (units < NO_DEPTH), units, 0).astype(np.uint16)


def _write_png(path: Path, image: npt.NDArray[Any]) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise InputError("the image could not be written", where=path, found=f"{image.shape}", expected="a writable place")
