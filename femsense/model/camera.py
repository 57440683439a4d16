"""A depth camera: its lens and the noise of its depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class CameraNoise:
    """Standard deviation of a single depth as a function of the distance z."""

    kind: str
    """"stereo": at_1m · z²;  "tof": floor + slope · z."""
    at_1m: float = 0.0
    """[m] at z = 1 m; 0 where the kind is "tof"."""
    floor: float = 0.0
    """[m]; 0 where the kind is "stereo"."""
    slope: float = 0.0
    """[m/m]; 0 where the kind is "stereo"."""

    def std(self, depth: npt.ArrayLike) -> FloatArray:
        """Return one standard deviation [m] of depths z [m], of the same shape."""
        z = np.asarray(depth, dtype=np.float64)
        return self.at_1m * z**2 if self.kind == "stereo" else self.floor + self.slope * z


@dataclass(frozen=True, eq=False, slots=True)
class Camera:
    """Intrinsics of a pinhole camera with lens distortion. Pixel coordinates have their origin at the centre of the first pixel."""

    name: str
    """Name of the camera; "" if there is only one."""
    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    distortion: FloatArray
    """OpenCV's k1, k2, p1, p2, k3, shape (5,), with k4, k5, k6 shape (8,); k1 … k4 and 0 where the model is "kannala_brandt"."""
    depth_unit: float
    """Metres in one unit of a depth image."""
    distortion_model: str = "brown_conrady"
    """"brown_conrady", "inverse_brown_conrady" (the same polynomial takes bent rays to straight ones) or "kannala_brandt"."""
    noise: CameraNoise | None = None
    """Noise of a single depth; None if unknown."""
