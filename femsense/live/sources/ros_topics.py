"""ROS 2 messages as frames, independent of the transport: a depth image with its CameraInfo, and colour if its topic is given."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.importers.images.pictures import FINE_UNIT, depth_of_metres
from femsense.io.importers.ros.messages import DEPTH, cloud_of, lens_of, raw_image, red_first, stamp_of
from femsense.live.frames import Image, ImageKind, RawFrame, png_of
from femsense.model.camera import Camera

IMAGE, CLOUD, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
TYPES = (IMAGE, CLOUD, INFO)
MILLIMETRE = 0.001
DECODER = "ROS 2 messages need the package mcap-ros2-support\n  try:      pip install 'femsense[mcap,xr]'"


def topics_of(text: str) -> tuple[str, TopicFrames]:
    """Return the address in `ADDRESS?depth=TOPIC&color=TOPIC`, and an assembler of its messages."""
    address, _, more = text.partition("?")
    return address, TopicFrames(**{key: value for key, value in parse_qsl(more) if key in ("depth", "color")})


class TopicFrames:
    """Assembles frames from messages.

    The first topic with depth images, or with clouds, is the camera, unless `depth` names another one; a colour topic
    must be given and registered to depth, like `aligned_depth_to_color` and the colour image.
    """

    def __init__(self, depth: str = "", color: str = "") -> None:
        self.depth, self.color = depth, color
        self.camera: Camera | None = None
        self.is_cloud = False
        self._unit_m = MILLIMETRE
        self._color: Image | None = None
        self._number = -1
        self._infos: dict[str, Any] = {}

    def is_wanted(self, topic: str, kind: str) -> bool:
        """Return whether a topic is required, by its name and type."""
        return kind in TYPES and (not self.depth or kind == INFO or topic in (self.depth, self.color))

    def take(self, topic: str, kind: str, message: Any) -> RawFrame | None:
        """Add a message; return the frame that it completes, or None. Raises InputError."""
        if kind == INFO:
            self._infos[topic.rpartition("/")[0]] = message
            self._find_camera()
            return None
        if topic == self.color:
            pixels, encoding = raw_image(message, topic)
            self._color = Image(ImageKind.COLOR, png_of(red_first(pixels, encoding)))
            return None
        if kind == IMAGE and message.encoding not in DEPTH:
            return None
        self.depth = self.depth or topic
        if topic != self.depth:
            return None
        if kind == IMAGE and message.encoding == "32FC1":
            self._unit_m = FINE_UNIT
        self._find_camera()
        if kind == IMAGE and self.camera is None:
            return None  # its CameraInfo has not arrived
        self._number += 1
        image = _depth_image(message, topic) if kind == IMAGE else _cloud_image(message, topic)
        images = (image,) if self._color is None or kind == CLOUD else (image, self._color)
        self.is_cloud = kind == CLOUD
        return RawFrame(self._number, stamp_of(message)[0], images, arrived_s=time.monotonic())

    def _find_camera(self) -> None:
        info = self._infos.get(self.depth.rpartition("/")[0])
        if self.camera is None and info is not None:
            self.camera = replace(lens_of(info, self.depth), depth_unit=self._unit_m)


def _depth_image(message: Any, topic: str) -> Image:
    """Return depth in millimetres (16-bit images, REP 118), or in FINE_UNIT for images of floats in metres."""
    pixels, encoding = raw_image(message, topic)
    return Image(ImageKind.DEPTH, png_of(depth_of_metres(pixels) if encoding == "32FC1" else pixels))


def _cloud_image(message: Any, topic: str) -> Image:
    with tempfile.TemporaryDirectory(prefix="femsense-cloud-") as folder:
        file = Path(folder, "cloud.ply")
        write_cloud(file, cloud_of(message, topic))
        return Image(ImageKind.CLOUD, file.read_bytes(), ".ply")
