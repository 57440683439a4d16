"""Orbbec cameras (Gemini, Femto) by pyorbbecsdk2: depth, and colour registered to it by the SDK."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np

from femsense.core.errors import MissingDependency
from femsense.io.clouds.images import decoded_image
from femsense.live.frames import Image, ImageKind, RawFrame, png_of
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost
from femsense.model.camera import Camera

NEEDED_MBIT_S = 640 * 576 * 30 * 16 / 1e6 + 100.0
"""Depth of a Femto without compression, and colour as JPEG."""


class Orbbec:
    """One camera, by its serial number or the first one."""

    def __init__(self, serial: str) -> None:
        self.serial = serial
        self._pipeline: Any = None
        self._align: Any = None
        self._scale_m = 0.0

    def open(self, opening: Opening) -> SourceInfo:
        """Start depth and colour; after a loss the camera is rebooted first."""
        ob = _library()
        device = self._on_bus(ob)
        if opening.attempt > 0:
            with suppress(ob.OBError):
                device.reboot()
            raise_after = time.monotonic() + 8.0
            time.sleep(3.0)
            while True:
                try:
                    device = self._on_bus(ob)
                    break
                except SourceLost:
                    if time.monotonic() > raise_after:
                        raise
                    time.sleep(0.5)
        info = device.get_device_info()
        try:
            pipeline, config = ob.Pipeline(device), ob.Config()
            depth = pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR).get_default_video_stream_profile()
            config.enable_stream(depth)
            with suppress(ob.OBError):  # some devices have no colour
                config.enable_stream(
                    pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR).get_default_video_stream_profile()
                )
                self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.DEPTH_STREAM)
                pipeline.enable_frame_sync()
            pipeline.start(config)
        except ob.OBError as error:
            raise SourceLost(Loss.REFUSED, f"the camera cannot be opened: {error}") from None
        self._pipeline = pipeline
        lens, bent = depth.get_intrinsic(), depth.get_distortion()
        distortion = np.array([bent.k1, bent.k2, bent.p1, bent.p2, bent.k3, bent.k4, bent.k5, bent.k6])
        self._scale_m = self._first_scale(ob)
        camera = Camera("", depth.get_width(), depth.get_height(), lens.fx, lens.fy, lens.cx, lens.cy, distortion, self._scale_m)
        link = str(info.get_connection_type())
        return SourceInfo(
            f"{info.get_name()} {info.get_serial_number()}",
            (camera,),
            float(depth.get_fps()),
            link=link,
            is_slow_link=_is_slow(link),
        )

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the next pair of depth and colour."""
        ob = _library()
        try:
            frames = self._pipeline.wait_for_frames(max(1, round(1e3 * timeout_s)))
        except ob.OBError as error:
            raise SourceLost(Loss.UNPLUGGED, str(error)) from None
        if frames is None:
            self._on_bus(ob)
            return None
        arrived, depth = time.monotonic(), frames.get_depth_frame()
        if depth is None:
            return None
        number, stamp = int(depth.get_index()), 1e-6 * depth.get_timestamp_us()
        color = None
        if self._align is not None and frames.get_color_frame() is not None:
            aligned = self._align.process(frames).as_frame_set()
            depth, color = aligned.get_depth_frame() or depth, aligned.get_color_frame()
        pixels = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
        images = [Image(ImageKind.DEPTH, png_of(pixels))]
        if color is not None:
            images.append(Image(ImageKind.COLOR, png_of(_red_first(ob, color))))
        return RawFrame(number, stamp, tuple(images), arrived_s=arrived)

    def close(self) -> None:
        """Stop the pipeline."""
        if self._pipeline is not None:
            with suppress(Exception):  # the SDK raises on a disconnected device
                self._pipeline.stop()
        self._pipeline = None

    def list_devices(self) -> list[FoundCamera]:
        """Return the connected Orbbec cameras."""
        ob = _library()
        devices = ob.Context().query_devices()
        infos = [devices.get_device_by_index(i).get_device_info() for i in range(devices.get_count())]
        return [
            FoundCamera(
                f"orbbec:{info.get_serial_number()}",
                str(info.get_name()),
                str(info.get_connection_type()),
                _is_slow(str(info.get_connection_type())),
                NEEDED_MBIT_S,
            )
            for info in infos
        ]

    def _on_bus(self, ob: Any) -> Any:
        devices = ob.Context().query_devices()
        if devices.get_count() == 0:
            raise SourceLost(Loss.UNPLUGGED, "no Orbbec camera on the bus")
        try:
            return devices.get_device_by_serial_number(self.serial) if self.serial else devices.get_device_by_index(0)
        except ob.OBError as error:
            raise SourceLost(Loss.UNPLUGGED, f"no Orbbec {self.serial} on the bus: {error}") from None

    def _first_scale(self, ob: Any) -> float:
        """Return metres per unit of depth, read from a frame. Raises SourceLost if none arrives."""
        end = time.monotonic() + 5.0
        while time.monotonic() < end:
            frames = self._pipeline.wait_for_frames(500)
            if frames is not None and frames.get_depth_frame() is not None:
                return round(1e-3 * float(frames.get_depth_frame().get_depth_scale()), 9)
        raise SourceLost(Loss.REFUSED, "the camera gave no depth within 5 s of its start")


def _library() -> Any:
    try:
        import pyorbbecsdk
    except ImportError as error:
        raise MissingDependency(
            f"Orbbec cameras need the package pyorbbecsdk2 ({error})\n  try:      pip install 'femsense[orbbec]'"
        ) from None
    return pyorbbecsdk


def _is_slow(link: str) -> bool:
    return "2." in link


def _red_first(ob: Any, frame: Any) -> Any:
    """Return the pixels of a colour frame in RGB order, shape (H, W, 3)."""
    data = np.frombuffer(frame.get_data(), np.uint8)
    if frame.get_format() == ob.OBFormat.MJPG:
        return decoded_image(data.tobytes(), "orbbec")
    pixels = data.reshape(frame.get_height(), frame.get_width(), -1)
    return pixels[:, :, ::-1] if frame.get_format() == ob.OBFormat.BGR else pixels
