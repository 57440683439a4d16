"""Intel RealSense cameras by pyrealsense2: depth, and colour registered to it."""

from __future__ import annotations

import ctypes
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.core.errors import InputError, MissingDependency
from femsense.live.frames import Image, ImageKind, RawFrame, png_of
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost
from femsense.model.camera import Camera

WIDTH, HEIGHT, RATE_HZ = 848, 480, 30
"""The depth mode that Intel recommends for the D400 series; other cameras take the nearest one."""
NEEDED_MBIT_S = WIDTH * HEIGHT * RATE_HZ * (16 + 24) / 1e6
RESET_S = 5.0
"""A camera that was reset is back on the bus after about 3 s."""


class RealSense:
    """One camera, by its serial number or the only one."""

    def __init__(self, serial: str, *, device: Any = None) -> None:
        """`device`: a device of pyrealsense2 to use, such as a software device; None looks for one when it is opened."""
        self.serial, self._given = serial, device
        self._sensors: list[Any] = []
        self._queue: Any = None
        self._align: Any = None

    def open(self, opening: Opening) -> SourceInfo:
        """Start depth and colour; after a loss the camera is reset first."""
        rs = _library()
        device = self._given or self._found(rs, reset=opening.attempt > 0)
        sensors = list(device.query_sensors())
        depth = _nearest(sensors, rs.stream.depth, rs.format.z16)
        color = _nearest(sensors, rs.stream.color, rs.format.rgb8)
        if depth is None:
            raise InputError("the camera has no depth stream", where=f"realsense:{self.serial}", found=_name(rs, device))
        self._align = rs.align(rs.stream.depth)
        self._queue = rs.frame_queue(1) if color is None else rs.syncer(1)
        try:
            for k, sensor in enumerate(sensors):
                wanted = [one.profile for one in (depth, color) if one is not None and one.sensor == k]
                if wanted:
                    sensor.open(wanted if len(wanted) > 1 else wanted[0])
                    sensor.start(self._queue)
                    self._sensors.append(sensor)
        except RuntimeError as error:
            self.close()
            raise SourceLost(Loss.REFUSED, f"the camera cannot be opened: {error}") from None
        link = _info(rs, device, rs.camera_info.usb_type_descriptor)
        camera = _camera(rs, depth.profile.as_video_stream_profile(), _depth_unit(rs, device))
        is_slow = link.startswith(("2", "1"))
        return SourceInfo(
            _name(rs, device), (camera,), float(depth.profile.fps()), link=f"USB {link}" if link else "", is_slow_link=is_slow
        )

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the next pair of depth and colour."""
        rs = _library()
        wait_ms = max(1, round(1e3 * timeout_s))
        is_pair = isinstance(self._queue, rs.syncer)
        came, frames = (self._queue.try_wait_for_frames if is_pair else self._queue.try_wait_for_frame)(wait_ms)
        if not came:
            self._check_presence(rs)
            return None
        arrived = time.monotonic()
        depth = frames.get_depth_frame() if is_pair else frames.as_depth_frame()
        color = frames.get_color_frame() if is_pair else None
        if not depth:
            return None
        images = [Image(ImageKind.DEPTH, png_of(np.asarray(depth.get_data())))]
        if color:
            aligned = self._align.process(frames).get_color_frame()
            images.append(Image(ImageKind.COLOR, png_of(np.asarray(aligned.get_data()))))
        exposure = float("nan")
        if depth.supports_frame_metadata(rs.frame_metadata_value.actual_exposure):
            exposure = 1e-6 * depth.get_frame_metadata(rs.frame_metadata_value.actual_exposure)
        return RawFrame(
            number=int(depth.get_frame_number()),
            stamp_s=1e-3 * depth.get_timestamp(),
            images=tuple(images),
            arrived_s=arrived,
            exposure_s=exposure,
        )

    def close(self) -> None:
        """Stop the sensors, except of a disconnected device."""
        for sensor in self._sensors:
            with suppress(RuntimeError):
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()
        self._sensors = []

    def list_devices(self) -> list[FoundCamera]:
        """Return the RealSense cameras on the bus."""
        rs = _library()
        found = []
        for device in rs.context().query_devices():
            link = _info(rs, device, rs.camera_info.usb_type_descriptor)
            serial = _info(rs, device, rs.camera_info.serial_number)
            slow = link.startswith(("2", "1"))
            found.append(FoundCamera(f"realsense:{serial}", _name(rs, device), f"USB {link}", slow, NEEDED_MBIT_S))
        return found

    def _found(self, rs: Any, *, reset: bool) -> Any:
        """Return the device with the serial number, or the only one. Raises SourceLost, InputError."""
        device = self._on_bus(rs)
        if reset:
            device.hardware_reset()
            end = time.monotonic() + RESET_S
            time.sleep(0.5 * RESET_S)
            while time.monotonic() < end:
                with suppress(SourceLost):
                    return self._on_bus(rs)
                time.sleep(0.2)
            device = self._on_bus(rs)
        return device

    def _on_bus(self, rs: Any) -> Any:
        devices = list(rs.context().query_devices())
        serials = [_info(rs, device, rs.camera_info.serial_number) for device in devices]
        if self.serial:
            if self.serial not in serials:
                raise SourceLost(Loss.UNPLUGGED, f"no RealSense {self.serial} on the bus (found: {', '.join(serials) or 'none'})")
            return devices[serials.index(self.serial)]
        if not devices:
            raise SourceLost(Loss.UNPLUGGED, "no RealSense camera on the bus")
        if len(devices) > 1:
            names = ", ".join(f"realsense:{serial}" for serial in serials)
            raise InputError("several RealSense cameras", where="--camera realsense", found=names, expected="one of them")
        return devices[0]

    def _check_presence(self, rs: Any) -> None:
        """Raise SourceLost if the device is no longer on the bus."""
        if self._given is None:
            self._on_bus(rs)


def _library() -> Any:
    """Return pyrealsense2, with the libusb of an installed package, if any. Raises MissingDependency."""
    with suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        import pyrealsense2
    except ImportError as error:
        raise MissingDependency(
            f"RealSense cameras need the package pyrealsense2 ({error})\n  try:      pip install 'femsense[realsense]'"
        ) from None
    return pyrealsense2


@dataclass(frozen=True, eq=False, slots=True)
class _Stream:
    """A stream that a sensor offers."""

    sensor: int
    """Index of the sensor in its device."""
    profile: Any


def _nearest(sensors: list[Any], stream: Any, form: Any) -> _Stream | None:
    """Return the stream of a kind that is nearest to the requested size and rate; None without such a stream."""
    offered = [_Stream(k, profile) for k, sensor in enumerate(sensors) for profile in sensor.get_stream_profiles()]
    fitting = [one for one in offered if one.profile.stream_type() == stream and one.profile.format() == form]

    def apart(one: _Stream) -> tuple[int, int]:
        video = one.profile.as_video_stream_profile()
        return abs(video.width() - WIDTH) + abs(video.height() - HEIGHT), abs(one.profile.fps() - RATE_HZ)

    return min(fitting, key=apart, default=None)


def _camera(rs: Any, profile: Any, depth_unit: float) -> Camera:
    lens = profile.get_intrinsics()
    models = {rs.distortion.inverse_brown_conrady: "inverse_brown_conrady", rs.distortion.kannala_brandt4: "kannala_brandt"}
    model = models.get(lens.model, "brown_conrady")
    return Camera("", lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy, np.array(lens.coeffs), depth_unit, model)


def _depth_unit(rs: Any, device: Any) -> float:
    """Return metres per unit of depth; 1 mm if the camera does not report it."""
    sensors = [sensor for sensor in device.query_sensors() if sensor.supports(rs.option.depth_units)]
    return round(float(sensors[0].get_option(rs.option.depth_units)), 9) if sensors else 0.001


def _info(rs: Any, device: Any, what: Any) -> str:
    return str(device.get_info(what)) if device.supports(what) else ""


def _name(rs: Any, device: Any) -> str:
    name, serial = _info(rs, device, rs.camera_info.name), _info(rs, device, rs.camera_info.serial_number)
    return f"{name or 'RealSense'} {serial}".strip()
