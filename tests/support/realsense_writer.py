"""Write a RealSense recording with the SDK's own recorder and a camera of its own making; run as a program.

    python realsense_writer.py FILE FRAMES [inverse]

FILE ends in .bag (an SDK up to 2.57) or .db3 (2.58 and later). Exit status 3:
this SDK does not load or does not write this format. With `inverse` the depth lens has what the SDK calls inverse Brown–Conrady.
"""

from __future__ import annotations

import contextlib
import gc
import sys

import numpy as np

WIDTH, HEIGHT = 64, 48
DEPTH_UNIT = 0.0005
START_MS = 5000.0
SHIFT = 0.015
"""The colour camera stands so far [m] to the right: T_color_depth has −SHIFT in x."""
TURN = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of T_color_depth: the colour camera is rolled by 53 degrees."""
DEPTH_LENS = (50.0, 51.0, 31.0, 23.0)
INVERSE = [0.1, -0.05, 0.001, 0.002, 0.01]
"""Coefficients of the depth lens, where it is asked for."""
COLOR_LENS = (55.0, 56.0, 32.0, 24.0)


def depth_of(number: int) -> np.ndarray:
    """Return a depth image with steps, holes and one pixel at 65535."""
    rng = np.random.default_rng(number)
    image = np.full((HEIGHT, WIDTH), 800 + 10 * number, dtype=np.uint16)
    image[10:30, 20:40] = 500 + number
    image[rng.random(image.shape) < 0.05] = 0
    image[0, 0] = 65535
    return image


def color_of(number: int) -> np.ndarray:
    """Return a colour image: red counts columns, green rows, blue frames."""
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:, :, 0] = 4 * np.arange(WIDTH)
    image[:, :, 1] = 5 * np.arange(HEIGHT)[:, None]
    image[:, :, 2] = number
    return image


def _load() -> object:
    with contextlib.suppress(ImportError, OSError):
        import ctypes

        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        import pyrealsense2

        return pyrealsense2
    except ImportError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)


def _profile(rs: object, stream: object, form: object, lens: tuple[float, ...], index: int, size: int) -> object:
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = WIDTH, HEIGHT
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = lens
    intrinsics.model = rs.distortion.brown_conrady
    intrinsics.coeffs = [0.0] * 5
    video = rs.video_stream()
    video.type, video.index, video.uid = stream, 0, index
    video.width, video.height, video.fps, video.bpp = WIDTH, HEIGHT, 30, size
    video.fmt, video.intrinsics = form, intrinsics
    return video


def main(path: str, frames: int, model: str = "") -> None:
    rs = _load()
    device = rs.software_device()
    depth_sensor, color_sensor = device.add_sensor("Depth"), device.add_sensor("Color")
    video = _profile(rs, rs.stream.depth, rs.format.z16, DEPTH_LENS, 0, 2)
    if model == "inverse":
        lens = video.intrinsics
        lens.model, lens.coeffs = rs.distortion.inverse_brown_conrady, INVERSE
        video.intrinsics = lens
    depth = depth_sensor.add_video_stream(video)
    color = color_sensor.add_video_stream(_profile(rs, rs.stream.color, rs.format.rgb8, COLOR_LENS, 1, 3))
    depth_sensor.add_read_only_option(rs.option.depth_units, DEPTH_UNIT)
    move = rs.extrinsics()
    move.rotation = TURN.T.ravel().tolist()  # by columns
    move.translation = [-SHIFT, 0.0, 0.0]
    depth.register_extrinsics_to(color, move)
    try:
        recorder = rs.recorder(path, device)
    except RuntimeError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
    queue = rs.frame_queue(100)
    sensors = recorder.query_sensors()
    for sensor, profile in zip(sensors, (depth, color)):
        sensor.open(profile)
        sensor.start(queue)
    for number in range(frames):
        for sensor, profile, pixels, size in (
            (depth_sensor, depth, depth_of(number), 2),
            (color_sensor, color, color_of(number), 3),
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels.copy(), WIDTH * size, size
            frame.timestamp, frame.domain, frame.frame_number = (
                START_MS + 1000.0 * number / 30,
                rs.timestamp_domain.system_time,
                number + 1,
            )
            frame.profile = profile.as_video_stream_profile()
            if size == 2:
                frame.depth_units = DEPTH_UNIT
            sensor.on_video_frame(frame)
            queue.wait_for_frame(5000)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder, sensors, sensor, depth_sensor, color_sensor, depth, color, device, frame, profile, queue
    gc.collect()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
