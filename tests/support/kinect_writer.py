"""Recordings as an Azure Kinect's recorder lays them out, written by PyAV (the vendor's recorder needs the camera)."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

DEPTH_MODEL = [0.503, 0.511, 0.4925, 0.4926, 5.157, 3.372, 0.1712, 5.489, 5.052, 0.931, 0, 0, -1.1e-5, 9.2e-5]
"""cx, cy, fx, fy as shares of the sensor; k1 … k6, two unused, p2, p1: the size that these cameras have."""
COLOR_MODEL = [0.4987, 0.5021, 0.4782, 0.6374, 0.5844, -2.494, 1.3603, 0.4648, -2.3362, 1.3012, 0, 0, -1.8e-4, 6.5e-4]


def calibration(shift: Sequence[float] = (-0.032, -0.002, 0.004)) -> dict[str, Any]:
    """Return calibration.json: the colour camera is turned by 6° about x and shifted [m] from the depth camera."""
    c, s = np.cos(np.radians(6.0)), np.sin(np.radians(6.0))
    rows = (
        ("D0", 1024, 1024, DEPTH_MODEL, np.eye(3), (0.0, 0.0, 0.0)),
        ("PV0", 4096, 3072, COLOR_MODEL, np.array([[1, 0, 0], [0, c, s], [0, -s, c]]), shift),
    )
    cameras = [
        {
            "Intrinsics": {
                "ModelParameterCount": 14,
                "ModelParameters": list(model),
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
            },
            "Location": f"CALIBRATION_CameraLocation{place}",
            "Rt": {"Rotation": rotation.ravel().tolist(), "Translation": list(translation)},
            "SensorWidth": width,
            "SensorHeight": height,
        }
        for place, width, height, model, rotation, translation in rows
    ]
    return {"CalibrationInformation": {"Cameras": cameras}}


def write_kinect(
    path: Path,
    depths: Sequence[np.ndarray],
    colors: Sequence[np.ndarray] | None = None,
    *,
    step_ms: int = 33,
    late_ms: int = 1,
    told: dict[str, Any] | None = None,
    title: str = "DEPTH",
) -> Path:
    """Write depth images (H, W) [mm] and colours (h, w, 3), these later by so much; `told` is calibration.json, {} for none."""
    import av

    with av.open(str(path), "w", options={"allow_raw_vfw": "1"}) as file:
        file.metadata["K4A_DEVICE_SERIAL_NUMBER"] = "000123"
        streams = [(_stream(file, "rawvideo", "gray16be", depths[0], title, step_ms), depths, "gray16le", 0)]
        if colors is not None:
            streams.append((_stream(file, "mjpeg", "yuvj420p", colors[0], "COLOR", step_ms), colors, "rgb24", late_ms))
        if told != {}:
            content = json.dumps(told or calibration()).encode() + b"\0"
            file.add_attachment("calibration.json", "application/octet-stream", content)
        for k in range(len(depths)):
            for stream, images, form, late in streams:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(images[k]), format=form).reformat(format=stream.pix_fmt)
                frame.pts, frame.time_base = k * step_ms + late, Fraction(1, 1000)
                for packet in stream.encode(frame):
                    file.mux(packet)
        for stream, *_ in streams:
            for packet in stream.encode():
                file.mux(packet)
    height, width = depths[0].shape
    head = struct.pack("<IiiHHI", 40, width, -height, 1, 16, 0)
    content = path.read_bytes()
    assert content.count(head) == 1
    path.write_bytes(content.replace(head, head[:-4] + b"b16g"))  # the recorder names how depth is stored; this muxer does not
    return path


def _stream(file: Any, codec: str, pixels: str, first: np.ndarray, title: str, step_ms: int) -> Any:
    stream = file.add_stream(codec, rate=Fraction(1000, step_ms))
    stream.height, stream.width = first.shape[:2]
    stream.pix_fmt = pixels
    stream.metadata["title"] = title
    if codec == "mjpeg":
        stream.options = {"qscale": "2"}
    return stream
