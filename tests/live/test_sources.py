"""Sources of frames: names, the growing folder, a RealSense software device, ROS 2 messages from a pipe and from a Foxglove bridge."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.live.frames import ImageKind, RawFrame, png_of
from femsense.live.sources import SOURCES, list_cameras, make_source
from femsense.live.sources.foxglove import Foxglove
from femsense.live.sources.mcap_pipe import McapPipe
from femsense.live.sources.source import FrameSource, Loss, Opening, SourceLost

CAMERA = "[camera]\nwidth = 8\nheight = 6\nfx = 10.0\nfy = 10.0\ncx = 3.5\ncy = 2.5\ndepth_unit_m = 0.001\n"
DEPTH = np.arange(48, dtype=np.uint16).reshape(6, 8) + 500


def pixels(data: bytes, folder: Path) -> np.ndarray:
    (folder / "image.png").write_bytes(data)
    return read_png(folder / "image.png")


def frame_within(source: FrameSource, seconds: float) -> RawFrame:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        frame = source.newest(0.1)
        if frame is not None:
            return frame
    raise AssertionError("no frame came")


def test_every_source_of_the_registry_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "recording.toml").write_text(
        'format = "femsense-recording-1"\nactuation = "tension"\nactuation_zero = "absolute"\n'
    )
    (tmp_path / "frames.csv").write_text("frame,time_s\n0,0.0\n")
    for word in SOURCES:
        assert hasattr(make_source(f"{word}:{tmp_path}"), "newest"), word


def test_a_name_that_is_no_source_is_refused_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="realsense:…"):
        make_source("realsens")
    with pytest.raises(InputError, match="only a recording"):
        make_source(f"folder:{tmp_path}", as_fast_as_possible=True)


def test_listing_cameras_says_which_packages_are_missing() -> None:
    cameras, missing = list_cameras()
    assert all("pip install 'femsense[" in text for text in missing.values()) and "realsense" not in missing
    assert all(camera.source.partition(":")[0] in SOURCES for camera in cameras)


# A folder that grows


def test_a_growing_folder_gives_the_newest_whole_frame(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text(CAMERA)
    for name in ("depth", "color"):
        (tmp_path / name).mkdir()
    (tmp_path / "depth" / "000002.png").write_bytes(png_of(DEPTH))
    source = make_source(str(tmp_path))
    info = source.open(Opening())
    assert info.cameras[0] is not None and info.cameras[0].width == 8
    assert source.newest(0.05) is None  # what stood there before is not new
    for number in (3, 4, 5):
        (tmp_path / "depth" / f"{number:06d}.png").write_bytes(png_of(DEPTH + number))
        if number < 5:
            (tmp_path / "color" / f"{number:06d}.png").write_bytes(png_of(np.zeros((6, 8, 3), np.uint8)))
    frame = frame_within(source, 5.0)
    assert frame.number == 4 and [image.kind for image in frame.images] == [ImageKind.DEPTH, ImageKind.COLOR]
    assert np.array_equal(pixels(frame.images[0].data, tmp_path), DEPTH + 4)
    (tmp_path / "depth").rename(tmp_path / "gone")
    assert source.newest(0.05) is None


def test_a_folder_without_a_lens_or_that_is_gone_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera.toml"):
        make_source(str(tmp_path)).open(Opening())
    with pytest.raises(SourceLost, match="there is no folder") as lost:
        make_source(f"folder:{tmp_path}/none").open(Opening())
    assert lost.value.loss is Loss.UNPLUGGED


# RealSense, by the SDK's software device


@pytest.mark.skipif(sys.platform != "linux", reason="pyrealsense2 is a dependency of tests on Linux")
def test_a_realsense_software_device_gives_its_images_lens_and_numbers(tmp_path: Path) -> None:
    import realsense_writer as writer

    from femsense.live.sources.realsense import RealSense

    rs = pytest.importorskip("pyrealsense2")
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Software D400")
    device.register_info(rs.camera_info.usb_type_descriptor, "2.1")
    sensor = device.add_sensor("Depth")
    video = rs.video_stream()
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 50.0, 51.0, 31.0, 23.0
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.1, 0.0, 0.0, 0.0, 0.0]
    video.type, video.index, video.uid, video.width, video.height = rs.stream.depth, 0, 0, 64, 48
    video.fps, video.bpp, video.fmt, video.intrinsics = 30, 2, rs.format.z16, lens
    profile = sensor.add_video_stream(video)
    sensor.add_read_only_option(rs.option.depth_units, writer.DEPTH_UNIT)
    source = RealSense("", device=device)
    info = source.open(Opening())
    camera = info.cameras[0]
    assert camera is not None and (camera.fx, camera.cy, camera.depth_unit) == (50.0, 23.0, writer.DEPTH_UNIT)
    assert camera.distortion.tolist() == pytest.approx([0.1, 0, 0, 0, 0]) and info.link == "USB 2.1" and info.is_slow_link
    assert info.name == "Software D400" and info.rate_hz == 30.0
    for number in range(3):
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = writer.depth_of(number).copy(), 128, 2
        frame.timestamp, frame.domain, frame.frame_number = 5000.0 + number, rs.timestamp_domain.system_time, number + 7
        frame.profile, frame.depth_units = profile.as_video_stream_profile(), writer.DEPTH_UNIT
        sensor.on_video_frame(frame)
        found = frame_within(source, 5.0)
        assert found.number == number + 7 and found.stamp_s == pytest.approx(5.0 + 1e-3 * number)
        assert np.array_equal(pixels(found.images[0].data, tmp_path), writer.depth_of(number))
    assert source.newest(0.05) is None
    source.close()


# ROS 2


HEADER = "std_msgs/Header header\nuint32 height\nuint32 width\n"
INFO = (
    f"{HEADER}string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
    "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
)
IMAGE = f"{HEADER}string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
PARTS = (
    f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    f"{'=' * 80}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
)
SCHEMAS = {"sensor_msgs/msg/CameraInfo": INFO + PARTS, "sensor_msgs/msg/Image": IMAGE + PARTS}


def messages(number: int, depth: np.ndarray, encoding: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    header = {"stamp": {"sec": 100 + number, "nanosec": 500_000_000}, "frame_id": "camera"}
    k = [10.0, 0, 3.5, 0, 11.0, 2.5, 0, 0, 1]
    yield (
        "/cam/depth/camera_info",
        "sensor_msgs/msg/CameraInfo",
        {
            "header": header,
            "height": 6,
            "width": 8,
            "distortion_model": "plumb_bob",
            "d": [0.1, 0, 0, 0, 0],
            "k": k,
            "r": [1.0, 0, 0, 0, 1, 0, 0, 0, 1],
            "p": [*k[:3], 0, *k[3:6], 0, *k[6:], 0],
            "binning_x": 0,
            "binning_y": 0,
            "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
        },
    )
    for topic, image, form in (
        ("/cam/color/image", np.full((6, 8, 3), 9, np.uint8), "rgb8"),
        ("/cam/depth/image", depth, encoding),
    ):
        row = image.shape[1] * image.dtype.itemsize * (3 if image.ndim == 3 else 1)
        yield (
            topic,
            "sensor_msgs/msg/Image",
            {
                "header": header,
                "height": 6,
                "width": 8,
                "encoding": form,
                "is_bigendian": 0,
                "step": row,
                "data": image.tobytes(),
            },
        )


def check_ros(source: FrameSource, folder: Path, expected: np.ndarray, unit_m: float) -> None:
    info = source.open(Opening())
    frame = frame_within(source, 5.0)
    camera = info.cameras[0]
    assert camera is not None and (camera.fx, camera.fy, camera.cx, camera.depth_unit) == (10.0, 11.0, 3.5, unit_m)
    assert camera.distortion[0] == pytest.approx(0.1) and "/cam/depth/image" in info.name
    assert frame.stamp_s == pytest.approx(100.5 + frame.number, abs=2.0)
    assert np.array_equal(pixels(frame.images[0].data, folder), expected)


@pytest.mark.parametrize(
    ("depth", "encoding", "expected", "unit_m"),
    [(DEPTH, "16UC1", DEPTH, 1e-3), ((DEPTH * 1e-3).astype(np.float32), "32FC1", DEPTH * 10, 1e-4)],
)
def test_topics_come_through_a_pipe_of_mcap(
    tmp_path: Path, depth: np.ndarray, encoding: str, expected: np.ndarray, unit_m: float
) -> None:
    from mcap_ros2.writer import Writer

    pipe = tmp_path / "topics"
    os.mkfifo(pipe)

    data = io.BytesIO()
    with Writer(data) as writer:
        schemas = {kind: writer.register_msgdef(kind, text) for kind, text in SCHEMAS.items()}
        for number in range(2):
            for topic, kind, message in messages(number, depth, encoding):
                writer.write_message(topic, schemas[kind], message, log_time=number, publish_time=number)
    thread = threading.Thread(target=lambda: pipe.write_bytes(data.getvalue()), daemon=True)
    thread.start()
    source = McapPipe(f"{pipe}?color=/cam/color/image")
    check_ros(source, tmp_path, expected, unit_m)
    thread.join(10.0)
    with pytest.raises(SourceLost, match="has ended"):
        [source.newest(0.2) for _ in range(50)]
    source.close()


def test_a_file_of_mcap_is_no_pipe(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"x")
    with pytest.raises(SourceLost, match="femsense import"):
        make_source(str(tmp_path / "a.mcap")).open(Opening())
    with pytest.raises(SourceLost, match="mkfifo"):
        make_source("mcap:/nowhere/at/all").open(Opening())


@contextmanager
def bridge() -> Iterator[int]:
    """Serve the depth topics as a Foxglove bridge does, to whoever subscribes, and close after two frames."""
    from mcap_ros2.writer import serialize_dynamic  # type: ignore[attr-defined]
    from websockets.sync.server import ServerConnection, serve

    encoders = {kind: serialize_dynamic(kind, text)[kind] for kind, text in SCHEMAS.items()}
    listed = [(topic, kind) for topic, kind, _ in messages(0, DEPTH, "16UC1")]

    def answer(connection: ServerConnection) -> None:
        channels = [
            {"id": i, "topic": topic, "encoding": "cdr", "schemaName": kind, "schema": SCHEMAS[kind], "schemaEncoding": "ros2msg"}
            for i, (topic, kind) in enumerate(listed)
        ]
        connection.send(json.dumps({"op": "advertise", "channels": channels}))
        wanted = {json.loads(connection.recv())["subscriptions"][0]["channelId"]: None for _ in listed}
        for number in range(2):
            for i, (_, kind, message) in enumerate(messages(number, DEPTH, "16UC1")):
                if i in wanted:
                    connection.send(struct.pack("<BIQ", 1, i, number) + encoders[kind](message))
            time.sleep(0.3)

    with serve(answer, "127.0.0.1", 0, subprotocols=["foxglove.sdk.v1"]) as server:  # type: ignore[list-item]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.socket.getsockname()[1]
        server.shutdown()


def test_topics_come_from_a_foxglove_bridge_and_its_end_is_a_loss(tmp_path: Path) -> None:
    with bridge() as port:
        source = Foxglove(f"ws://127.0.0.1:{port}")
        check_ros(source, tmp_path, DEPTH, 1e-3)
        with pytest.raises(SourceLost) as lost:
            [source.newest(0.2) for _ in range(50)]
        assert lost.value.loss is Loss.UNPLUGGED and "closed the connection" in lost.value.text
        source.close()
    with pytest.raises(SourceLost, match="no Foxglove bridge"):
        Foxglove(f"ws://127.0.0.1:{port}").open(Opening())
