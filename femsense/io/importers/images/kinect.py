"""Azure Kinect recordings (.mkv): depth bit for bit, colours registered to it, the lens from the calibration inside.

File layout: "Azure Kinect DK recording file format" of the vendor's documentation;
scaling of the calibration to a camera mode: `mode_specific_calibration.c` of the Azure Kinect Sensor SDK.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.packages import needed
from femsense.io.clouds.images import decoded_image
from femsense.io.importers.frames import ColorImage, DepthImage, Format, Frame, Images, Source, camera_of_numbers
from femsense.io.importers.images.intrinsics import lens_line
from femsense.io.importers.images.lens import pixel_rays, registered_color
from femsense.io.importers.options import Options
from femsense.model.camera import Camera

DEPTH_MODES = {
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
"""Size of the depth images [px] → size of the whole sensor in that mode, and where the images begin in it."""
LEGACY = ((4096, 2304), (0, -384), (4096, 3072))
"""Old calibrations of the colour camera are of its 16:9 image: size, where the 4:3 image begins in it, size of that [px]."""
PLACES = {"depth": "CALIBRATION_CameraLocationD0", "color": "CALIBRATION_CameraLocationPV0"}


@dataclass(frozen=True, eq=False, slots=True)
class Tracks:
    """Tracks and calibration of a recording."""

    depth: int
    """Number of the stream."""
    little_endian: bool
    """Of the depth images; only files of early SDKs are."""
    color: int | None
    lens: Camera
    color_lens: Camera | None
    T_color_depth: FloatArray
    """Shape (4, 4), translation [m]."""
    near_s: float
    """Colours belong to a depth image at most this far from it in time: half a step, as the SDK has it."""
    delay_s: float
    """The depth camera's shutter is this much later than the colour camera's."""
    count: int | None
    serial: str | None


def open_kinect(path: Path, options: Options) -> Source:
    """Return an Azure Kinect recording as a source. Raises InputError: not readable, no depth, no calibration."""
    tracks = _tracks(path)
    lens = tracks.lens
    found = {
        "lens": lens_line(lens),
        "depth_unit_m": 0.001,
        "colour": None if tracks.color_lens is None else f"{tracks.color_lens.width} × {tracks.color_lens.height}",
        "serial_number": tracks.serial,
    }
    return Source(
        path,
        partial(_frames, path, tracks),
        found=found,
        camera=lens,
        count=tracks.count,
    )


def calibrated_lens(camera: Mapping[str, Any], width: int, height: int) -> Camera:
    """Return the lens of one camera of calibration.json for images of a size [px].

    The file has it for the whole sensor, as shares of its width and height from the corner of the first pixel.

    Raises:
        InputError: a size that no mode has, or a model that is not Brown–Conrady.
    """
    where = f"calibration.json, {camera['Location']}"
    kind = str(camera["Intrinsics"]["ModelType"])
    if not kind.endswith("BrownConrady"):
        raise InputError("a lens of another model", where=where, found=kind, expected="BrownConrady")
    given = np.asarray(camera["Intrinsics"]["ModelParameters"], dtype=np.float64)
    middle, focal = given[:2], given[2:4]
    if camera["Location"] == PLACES["depth"]:
        if (width, height) not in DEPTH_MODES:
            sizes = ", ".join(f"{w} × {h}" for w, h in DEPTH_MODES)
            raise InputError("depth images of a size that no mode has", where=where, found=f"{width} × {height}", expected=sizes)
        whole, corner = (np.array(pair, dtype=np.float64) for pair in DEPTH_MODES[width, height])
    else:
        if camera["SensorWidth"] * 9 // 16 == camera["SensorHeight"]:
            size, start, full = (np.array(pair, dtype=np.float64) for pair in LEGACY)
            middle, focal = (middle * size - start) / full, focal * size / full
        whole = np.array([width, 0.75 * width])
        corner = np.array([0.0, 0.5 * (whole[1] - height)])
    fx, fy = focal * whole
    cx, cy = middle * whole - corner - 0.5
    k1, k2, k3, k4, k5, k6, _, _, p2, p1 = given[4:14]
    return camera_of_numbers(width, height, (fx, fy), (cx, cy), (k1, k2, p1, p2, k3, k4, k5, k6))


# The contents of the file


def _tracks(path: Path) -> Tracks:
    with _opened(path) as file:
        by_name = {str(s.metadata.get("title", "")).upper(): s for s in file.streams.video}
        depth, color = by_name.get("DEPTH"), by_name.get("COLOR")
        if depth is None:
            raise InputError(
                "no depth track",
                where=path,
                found=", ".join(by_name) or "no pictures",
                expected="DEPTH and COLOR as k4arecorder writes them",
                hint="passive infrared holds no depth; other videos are no recording of depth",
            )
        if depth.codec_context.name != "rawvideo":
            raise InputError("depth that is compressed", where=path, found=depth.codec_context.name, expected="16 bits a pixel")
        tags = {**file.metadata, **{key: value for s in file.streams for key, value in s.metadata.items()}}
        cameras = _calibration(file, path)
        step = 1.0 / float(depth.average_rate) if depth.average_rate else 1.0 / 30.0
        tracks = Tracks(
            depth.index,
            depth.codec_context.codec_tag == "YUY2",
            None,
            calibrated_lens(cameras["depth"], depth.codec_context.width, depth.codec_context.height),
            None,
            _pose(cameras["color"]) @ np.linalg.inv(_pose(cameras["depth"])),
            0.5 * step,
            1e-9 * float(tags.get("K4A_DEPTH_DELAY_NS", 0)),
            round(float(file.duration) * 1e-6 / step) if file.duration else None,
            tags.get("K4A_DEVICE_SERIAL_NUMBER"),
        )
        if color is None:
            return tracks
        lens = calibrated_lens(cameras["color"], color.codec_context.width, color.codec_context.height)
        return replace(tracks, color=color.index, color_lens=lens)


def _opened(path: Path) -> Any:
    av = needed("av", "kinect", "reading a recording of an Azure Kinect")
    try:
        return av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise InputError("not readable as Matroska", where=path, found=str(error), expected="a whole .mkv file") from None


def _calibration(file: Any, path: Path) -> dict[str, Any]:
    """Return the entries of the depth and of the colour camera in the attachment. Raises InputError."""
    texts = [s.data for s in file.streams if s.type == "attachment" and str(s.name or "").endswith(".json")]
    if not texts:
        raise InputError(
            "no calibration in the recording",
            where=path,
            found="no attachment calibration.json",
            expected="a file as k4arecorder writes it",
            hint="programs that copy the tracks leave attachments out: take the original",
        )
    try:
        entries = json.loads(bytes(texts[0]).rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        return {name: next(e for e in entries if e["Location"] == place) for name, place in PLACES.items()}
    except (ValueError, KeyError, TypeError, StopIteration) as error:
        raise InputError(
            "not a calibration of an Azure Kinect",
            where=f"{path}, calibration.json",
            found=f"{type(error).__name__}: {error}",
            expected=", ".join(PLACES.values()),
        ) from None


def _pose(camera: Mapping[str, Any]) -> FloatArray:
    """Return T_camera_reference, shape (4, 4), translation [m]."""
    T = np.eye(4)
    T[:3, :3] = np.asarray(camera["Rt"]["Rotation"], dtype=np.float64).reshape(3, 3)
    T[:3, 3] = camera["Rt"]["Translation"]
    return T


# Frames


def _frames(path: Path, tracks: Tracks) -> Iterator[Frame]:
    """Read the file once; a depth image waits until no nearer colours can come."""
    rays = pixel_rays(tracks.lens)
    depths: deque[tuple[float, bytes]] = deque()
    colors: deque[tuple[float, bytes, str]] = deque()
    for number, time, data, kind in _packets(path, tracks):
        if number == tracks.depth:
            depths.append((time, data))
        else:
            colors.append((time + tracks.delay_s, data, kind))
        while depths and (tracks.color is None or time > depths[0][0] + 2.0 * tracks.near_s):
            yield _frame(path, tracks, rays, *depths.popleft(), colors)
    for depth in depths:
        yield _frame(path, tracks, rays, *depth, colors)


def _packets(path: Path, tracks: Tracks) -> Iterator[tuple[int, float, bytes, str]]:
    """Yield (stream, time [s], bytes, how colours are stored) in the order of the file, to its end or to where it was cut off."""
    wanted = [tracks.depth] if tracks.color is None else [tracks.depth, tracks.color]
    with _opened(path) as file:
        kinds = {i: _kind(file.streams[i]) for i in wanted}
        for packet in file.demux([file.streams[i] for i in wanted]):
            if packet.size and packet.pts is not None:
                i = packet.stream.index
                yield i, float(packet.pts * packet.time_base), bytes(packet), kinds[i]


def _kind(stream: Any) -> str:
    codec = stream.codec_context
    return str(codec.name if codec.name != "rawvideo" else codec.pix_fmt or codec.codec_tag)


def _frame(
    path: Path, tracks: Tracks, rays: FloatArray, time: float, data: bytes, colors: deque[tuple[float, bytes, str]]
) -> Frame:
    while len(colors) > 1 and abs(colors[1][0] - time) <= abs(colors[0][0] - time):
        colors.popleft()
    near = bool(colors) and abs(colors[0][0] - time) <= tracks.near_s
    return Frame(time, partial(_images, path, tracks, rays, data, colors[0][1:] if near else None))


def _images(path: Path, tracks: Tracks, rays: FloatArray, data: bytes, color: tuple[bytes, str] | None) -> Images:
    lens = tracks.lens
    depth: DepthImage = np.frombuffer(data, dtype="<u2" if tracks.little_endian else ">u2").astype(np.uint16)
    if depth.size != lens.width * lens.height:
        raise InputError(
            "a depth image is not whole", where=path, found=f"{len(data)} bytes", expected=f"{2 * lens.width * lens.height}"
        )
    depth = depth.reshape(lens.height, lens.width)
    if color is None or tracks.color_lens is None:
        return Images(depth)
    pixels = _color(*color, tracks.color_lens, path)
    return Images(depth, registered_color(depth, rays, 0.001, pixels, tracks.color_lens, tracks.T_color_depth))


def _color(data: bytes, kind: str, lens: Camera, path: Path) -> ColorImage:
    """Return a colour image with red first: JPEG, or one of the raw formats of the camera. Raises InputError."""
    import cv2

    if kind == "mjpeg":
        return np.asarray(decoded_image(data, path), dtype=np.uint8)
    raw = {
        "nv12": ((lens.height * 3 // 2, lens.width), cv2.COLOR_YUV2RGB_NV12),
        "yuyv422": ((lens.height, lens.width, 2), cv2.COLOR_YUV2RGB_YUY2),
        "bgra": ((lens.height, lens.width, 4), cv2.COLOR_BGRA2RGB),
    }
    if kind not in raw or len(data) != int(np.prod(raw[kind][0])):
        raise InputError(
            "colours that are stored in another way",
            where=path,
            found=f"{kind}, {len(data)} bytes",
            expected="MJPEG, NV12, YUY2 or BGRA",
        )
    shape, code = raw[kind]
    image: npt.NDArray[np.uint8] = np.frombuffer(data, dtype=np.uint8).reshape(shape)
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


KINECT = Format(
    "kinect",
    open_kinect,
    lambda path, head: head.startswith(b"\x1aE\xdf\xa3"),
    ("--clock", "--rate", "--up", "--unit", "--topic"),
    endings=(".mkv",),
)
