"""Bags as other programs write them: compressed files, MCAP of ROS 1 and without a profile, depth in plain PNG,
infrared beside depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
from imported import imported, without_invalid
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from ros_writers import START_NS, STEP_NS, BagWriter, color_of, depth_of, write_camera
from rosbags.rosbag1 import Reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.io.importers.frames import Options
from femsense.io.importers.guess import open_source

FRAMES = 3


def read_right(path: Path, folder: Path, options: Options | None = None) -> None:
    """Demand that the depth images are those of `write_camera`."""
    recording, _ = imported(path, folder, options)
    assert recording.frame_count == FRAMES
    for k in range(FRAMES):
        np.testing.assert_array_equal(read_png(folder / f"recording/depth/{k:06d}.png"), without_invalid(depth_of(k)))


@pytest.mark.parametrize("mode", list(CompressionMode)[1:])
def test_bags_that_are_compressed(mode: CompressionMode, tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "take", "mcap" if mode.name == "STORAGE" else "sqlite3")
    bag.writer.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        write_camera(bag, FRAMES)
    read_right(tmp_path / "take", tmp_path)


def test_a_compressed_file_alone_says_how_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "take.db3.zstd").write_bytes(bytes(100))
    for path in (tmp_path, tmp_path / "take.db3.zstd"):
        with pytest.raises(InputError, match="unpack it first"):
            open_source(path)


@pytest.mark.parametrize("chunks", ["lz4", "zstd", "none", "no chunks", "no index"])
@pytest.mark.parametrize("profile", ["ros2", ""])
def test_mcap_of_other_writers(chunks: str, profile: str, tmp_path: Path) -> None:
    more: dict = {
        "lz4": {"compression": CompressionType.LZ4},
        "zstd": {"compression": CompressionType.ZSTD},
        "none": {"compression": CompressionType.NONE},
        "no chunks": {"use_chunking": False},
        "no index": {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
    }[chunks]
    with BagWriter(tmp_path / "source", "mcap") as bag:
        write_camera(bag, FRAMES)
    source = next((tmp_path / "source").glob("*.mcap"))
    with source.open("rb") as read, (tmp_path / "take.mcap").open("wb") as written:
        writer, channels = Writer(written, **more), dict[int, int]()
        writer.start(profile=profile)
        for schema, channel, message in make_reader(read).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    read_right(tmp_path / "take.mcap", tmp_path)


def test_a_bag_of_ros_1_converted_to_mcap(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take.bag", "1") as bag:
        write_camera(bag, FRAMES)
    with Reader(tmp_path / "take.bag") as reader, (tmp_path / "take.mcap").open("wb") as written:
        writer, channels = Writer(written), dict[int, int]()
        writer.start(profile="ros1")
        for connection, nanoseconds, raw in reader.messages():
            if connection.id not in channels:
                name, text = connection.msgtype.replace("/msg/", "/"), connection.msgdef.data.encode()
                known = writer.register_schema(name, "ros1msg", text)
                channels[connection.id] = writer.register_channel(connection.topic, "ros1", known)
            writer.add_message(channels[connection.id], nanoseconds, bytes(raw), nanoseconds)
        writer.finish()
    read_right(tmp_path / "take.mcap", tmp_path)


def test_mcap_that_is_not_of_ros_is_named(tmp_path: Path) -> None:
    with (tmp_path / "take.mcap").open("wb") as written:
        writer = Writer(written)
        writer.start()
        schema = writer.register_schema("foxglove.PointCloud", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/points", "json", schema), 1, b"{}", 1)
        writer.finish()
    with pytest.raises(InputError, match=r"messages that are not of ROS\n.*json"):
        open_source(tmp_path / "take.mcap")


def test_depth_in_plain_png_beside_infrared(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(FRAMES):
            at = START_NS + k * STEP_NS
            png = cv2.imencode(".png", depth_of(k))[1].tobytes()
            bag.write("/camera/depth/image_raw/compressed", at, bag.compressed(png, "16UC1; png compressed ", at))
            bag.write("/camera/depth/camera_info", at, bag.info(at))
            bag.write("/camera/ir/image_raw", at, bag.image(color_of(k)[:, :, 0].astype(np.uint16), "mono16", at))
            bag.write("/camera/ir/camera_info", at, bag.info(at))
    read_right(tmp_path / "take", tmp_path)
