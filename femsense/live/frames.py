"""A camera frame: encoded images, time stamps and metadata."""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError

NAN = float("nan")
HEAD = struct.Struct("<4sI")
MAGIC = b"FSF1"
FAST_PNG = 1
"""zlib level of images: three times faster than OpenCV's default, and 10 % larger files for depth images."""


class ImageKind(StrEnum):
    """Kind of an image; also the folder of a recording that holds it."""

    DEPTH = "depth"
    COLOR = "color"
    CLOUD = "clouds"


@dataclass(frozen=True, eq=False, slots=True)
class Image:
    """One image or cloud of a frame, encoded as in its file."""

    kind: ImageKind
    data: bytes
    """Content of the file."""
    suffix: str = ".png"
    view: int = 0
    """Index of the camera."""


@dataclass(frozen=True, eq=False, slots=True)
class Marker:
    """A named marker as measured by a camera."""

    name: str
    xyz_m: tuple[float, float, float]
    """Camera frame [m]."""
    view: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class RawFrame:
    """A frame before any processing."""

    number: int
    """Counter of the device: a gap means that the device or its link lost frames."""
    stamp_s: float
    """Time of exposure on the clock of the device [s]."""
    images: tuple[Image, ...] = ()
    markers: tuple[Marker, ...] = ()
    arrived_s: float = NAN
    """Arrival on this machine [s, monotonic clock]."""
    view_stamps_s: tuple[float, ...] = ()
    """Exposure time of each camera if there are several [s]."""
    exposure_s: float = NAN
    """Exposure duration [s]; nan: not reported by the device."""
    contact_free: bool | None = None
    """Whether a recording declares the frame contact-free; None: unknown."""
    inputs: tuple[tuple[str, float], ...] = ()
    """Inputs of the frame: column of frames.csv (`cable_<name>`, `chamber_<name>`) and value [N], [m] or [Pa]."""
    ready_s: float = NAN
    """Since when its reader waited for it [s, monotonic clock]; nan: unknown."""


@dataclass(frozen=True, eq=False, slots=True)
class StampedFrame:
    """A frame on the clock of the session, with its session number."""

    number: int
    """Number in the session; it counts all frames of the device, lost ones included."""
    time_s: float
    """Time of exposure since the session began [s]."""
    taken_s: float
    """The same on the monotonic clock [s]; the age of a result is relative to it."""
    raw: RawFrame


def png_of(image: npt.NDArray[np.generic]) -> bytes:
    """Return an image as a PNG file: depth of 16 bits, shape (H, W), or colour of 8 bits, red first, shape (H, W, 3)."""
    import cv2

    pixels = image[:, :, ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, FAST_PNG])
    if not done:
        raise InputError("cannot be written as a PNG image", where="image", found=f"{image.dtype}, shape {image.shape}")
    return bytes(data)


def frame_bytes(frame: RawFrame) -> bytes:
    """Return a frame as bytes: a header, its values as JSON, its images."""
    images = [{"kind": i.kind, "suffix": i.suffix, "view": i.view, "size": len(i.data)} for i in frame.images]
    values = {**asdict(replace(frame, images=())), "images": images}
    text = json.dumps(values).encode()
    return b"".join([HEAD.pack(MAGIC, len(text)), text, *(image.data for image in frame.images)])


def read_frame(data: bytes) -> RawFrame:
    """Return the frame encoded in some bytes. Raises InputError if they are truncated."""
    magic, size = HEAD.unpack_from(data)
    if magic != MAGIC:
        raise InputError("not a frame", where="ring", found=repr(magic), expected=repr(MAGIC))
    at = HEAD.size + size
    values = json.loads(data[HEAD.size : at])
    images = []
    for told in values.pop("images"):
        images.append(Image(ImageKind(told["kind"]), data[at : at + told["size"]], told["suffix"], told["view"]))
        at += told["size"]
    if at != len(data):
        raise InputError("a truncated frame", where="ring", found=f"{len(data)} bytes", expected=f"{at} bytes")
    markers = tuple(Marker(m["name"], tuple(m["xyz_m"]), m["view"]) for m in values.pop("markers"))
    stamps, inputs = tuple(values.pop("view_stamps_s")), tuple((name, value) for name, value in values.pop("inputs"))
    return RawFrame(**values, images=tuple(images), markers=markers, view_stamps_s=stamps, inputs=inputs)
