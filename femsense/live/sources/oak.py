"""Luxonis OAK cameras by depthai 3: stereo depth registered to the colour camera."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np

from femsense.core.errors import MissingDependency
from femsense.live.frames import Image, ImageKind, RawFrame, png_of
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost
from femsense.model.camera import Camera

WIDTH, HEIGHT, RATE_HZ = 640, 400, 30
NEEDED_MBIT_S = WIDTH * HEIGHT * RATE_HZ * (16 + 24) / 1e6


class Oak:
    """One camera, by its device id, else the first one."""

    def __init__(self, device_id: str) -> None:
        self.device_id = device_id
        self._pipeline: Any = None
        self._depth: Any = None
        self._color: Any = None
        self._waiting: Any = None

    def open(self, opening: Opening) -> SourceInfo:
        """Start depth and colour; opening a device boots it, so that no reset is needed after a loss."""
        dai = _library()
        try:
            device = dai.Device(dai.DeviceInfo(self.device_id)) if self.device_id else dai.Device()
        except RuntimeError as error:
            missing = not dai.Device.getAllAvailableDevices()
            raise SourceLost(Loss.UNPLUGGED if missing else Loss.REFUSED, str(error)) from None
        pipeline = self._pipeline = dai.Pipeline(device)
        sockets = dai.CameraBoardSocket
        cameras = {
            socket: pipeline.create(dai.node.Camera).build(socket) for socket in (sockets.CAM_A, sockets.CAM_B, sockets.CAM_C)
        }
        size = (WIDTH, HEIGHT)
        color = cameras[sockets.CAM_A].requestOutput(size, dai.ImgFrame.Type.RGB888i, fps=RATE_HZ, enableUndistortion=True)
        stereo = pipeline.create(dai.node.StereoDepth)
        cameras[sockets.CAM_B].requestOutput(size, fps=RATE_HZ).link(stereo.left)
        cameras[sockets.CAM_C].requestOutput(size, fps=RATE_HZ).link(stereo.right)
        color.link(stereo.inputAlignTo)
        self._depth, self._color = (one.createOutputQueue(maxSize=1, blocking=False) for one in (stereo.depth, color))
        pipeline.start()
        K = np.array(device.readCalibration().getCameraIntrinsics(sockets.CAM_A, WIDTH, HEIGHT))
        lens = Camera("", WIDTH, HEIGHT, K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.zeros(5), 0.001)
        speed = device.getUsbSpeed()
        slow = speed in (dai.UsbSpeed.HIGH, dai.UsbSpeed.FULL, dai.UsbSpeed.LOW)
        name = f"{device.getProductName()} {device.getDeviceId()}"
        return SourceInfo(name, (lens,), float(RATE_HZ), link=f"USB {speed.name}", is_slow_link=slow)

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the newest depth image with the last colour image."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            try:
                depth, color = self._depth.tryGet(), self._color.tryGet()
            except RuntimeError as error:  # the queue is closed when its device disconnects
                raise SourceLost(Loss.UNPLUGGED, str(error)) from None
            self._waiting = color or self._waiting
            if depth is None:
                time.sleep(0.002)
                continue
            arrived = time.monotonic()
            images = [Image(ImageKind.DEPTH, png_of(depth.getFrame()))]
            stamps: tuple[float, ...] = (depth.getTimestampDevice().total_seconds(),)
            if self._waiting is not None:
                images.append(Image(ImageKind.COLOR, png_of(self._waiting.getCvFrame()[:, :, ::-1])))
                stamps = (*stamps, self._waiting.getTimestampDevice().total_seconds())
            return RawFrame(int(depth.getSequenceNum()), stamps[0], tuple(images), arrived_s=arrived, view_stamps_s=stamps)
        return None

    def close(self) -> None:
        """Stop the pipeline, which releases the device."""
        if self._pipeline is not None:
            with suppress(RuntimeError):
                self._pipeline.stop()
        self._pipeline = None

    def list_devices(self) -> list[FoundCamera]:
        """Return the connected OAK cameras; their link speed is unknown before they are booted."""
        dai = _library()
        return [
            FoundCamera(f"oak:{info.getDeviceId()}", f"OAK {info.name}", info.protocol.name, False, NEEDED_MBIT_S)
            for info in dai.Device.getAllAvailableDevices()
        ]


def _library() -> Any:
    try:
        import depthai
    except ImportError as error:
        raise MissingDependency(
            f"OAK cameras need the package depthai ({error})\n  try:      pip install 'femsense[oak]'"
        ) from None
    return depthai
