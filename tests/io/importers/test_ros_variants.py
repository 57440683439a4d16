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
from ros_writers import LENS, START_NS, STEP_NS, BagWriter, color_of, depth_of, write_camera
from rosbags.rosbag1 import Reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from femsense.core.errors import InputError
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import open_source
from femsense.io.importers.options import Options

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


def test_clouds_and_depths_in_millimetres_are_asked_and_read(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.6], size=(200, 3))
    with BagWriter(tmp_path / "clouds", "mcap") as bag:
        for k in range(FRAMES):
            stamp = START_NS + k * STEP_NS
            bag.write("/points", stamp, bag.cloud(1e3 * points, None, stamp))
    with BagWriter(tmp_path / "images", "mcap") as bag:
        for k in range(FRAMES):
            stamp = START_NS + k * STEP_NS
            image = depth_of(k).astype(np.float32)
            bag.write("/cam/depth/image_raw", stamp, bag.image(image, "32FC1", stamp))
            bag.write("/cam/depth/camera_info", stamp, bag.info(stamp))
    for name in ("clouds", "images"):
        with pytest.raises(InputError, match="--unit"):
            imported(tmp_path / name, tmp_path / f"refused-{name}")
    recording, _ = imported(tmp_path / "clouds", tmp_path / "a", Options(unit="mm"))
    cloud = read_frame_cloud(recording, 0)
    np.testing.assert_allclose(cloud.points, points, atol=1e-6)
    imported(tmp_path / "images", tmp_path / "b", Options(unit="mm"))
    wanted = 10 * depth_of(0).astype(int)
    got = read_png(tmp_path / "b/recording/depth/000000.png")
    kept = wanted < 65535
    np.testing.assert_array_equal(got[kept], wanted[kept])
    assert not got[~kept].any()


def test_the_lens_of_another_camera_is_not_taken(tmp_path: Path) -> None:
    for frame, taken in (("depth", False), ("color", True)):
        with BagWriter(tmp_path / frame, "mcap") as bag:
            bag.write("/cam/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS, frame))
            bag.write("/cam/color/camera_info", START_NS, bag.info(START_NS, "color"))
        if taken:
            assert open_source(tmp_path / frame).camera is not None
            continue
        with pytest.raises(InputError, match="without a lens"):
            open_source(tmp_path / frame)


def test_a_region_and_binning_of_the_lens(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        roi = bag.type("sensor_msgs/msg/RegionOfInterest")(20, 10, 96, 128, False)  # x, y, height, width
        info = bag.info(START_NS, lens=(100.0, 102.0, 90.0, 60.0), size=(200, 150))
        info.binning_x, info.binning_y, info.roi = 2, 2, roi
        bag.write("/cam/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
        bag.write("/cam/depth/camera_info", START_NS, info)
    lens = open_source(tmp_path / "take").camera
    assert lens is not None
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (64, 48, 50, 51, 35, 25)


def test_another_unit_of_depth(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, FRAMES)
    assert open_source(tmp_path / "take", Options(depth_unit=0.00025)).camera.depth_unit == 0.00025
    assert open_source(tmp_path / "take").camera.depth_unit == 0.001


def test_a_list_of_spheres_is_markers_without_names(tmp_path: Path) -> None:
    places = np.array([[0.1, 0.2, 0.7], [0.15, 0.2, 0.75]])
    with BagWriter(tmp_path / "take", "mcap") as bag:
        message = bag.marker_array({"all": (0.0, 0.0, 0.5)}, START_NS)
        message.markers[0].type = 7
        message.markers[0].points = [bag.vector(p - [0, 0, 0.5], "Point") for p in places]
        bag.write("/markers", START_NS, message)
    frame = next(open_source(tmp_path / "take").frames())
    assert not frame.markers
    np.testing.assert_allclose(frame.unlabelled, places)


def write_colors(folder: Path, pixels: np.ndarray, encoding: str) -> Path:
    with BagWriter(folder, "mcap") as bag:
        bag.write("/cam/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
        for name in ("depth", "color"):
            bag.write(f"/cam/{name}/camera_info", START_NS, bag.info(START_NS))
        bag.write("/cam/color/image_raw", START_NS, bag.image(pixels, encoding, START_NS))
    return folder


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8", "uyvy", "yuv422_yuy2"])
def test_colours_as_cameras_send_them(encoding: str, tmp_path: Path) -> None:
    shape = depth_of(0).shape
    wanted = np.array([200, 90, 40])
    if encoding.startswith("bayer"):
        letters = {"r": 0, "g": 1, "b": 2}
        tile = np.array([wanted[letters[c]] for c in encoding[6:10]], dtype=np.uint8).reshape(2, 2)
        pixels = np.tile(tile, (shape[0] // 2, shape[1] // 2))
    else:
        y, cr, cb = cv2.cvtColor(wanted.astype(np.uint8).reshape(1, 1, 3), cv2.COLOR_RGB2YCrCb)[0, 0]
        y = round(16 + 219 / 255 * int(y))
        pair = [[cb, y], [cr, y]] if encoding == "uyvy" else [[y, cb], [y, cr]]
        pixels = np.tile(np.array(pair, dtype=np.uint8), (shape[0], shape[1] // 2, 1))
    imported(write_colors(tmp_path / "take", pixels, encoding), tmp_path)
    seen = read_png(tmp_path / "recording/color/000000.png")[4:-4, 4:-4, ::-1]
    kept = read_png(tmp_path / "recording/depth/000000.png")[4:-4, 4:-4] > 0
    assert np.abs(np.median(seen[kept], axis=0) - wanted).max() < 25


def test_colours_that_are_not_read_cost_themselves(tmp_path: Path) -> None:
    source = open_source(write_colors(tmp_path / "take", np.zeros(depth_of(0).shape, np.uint8), "something"))
    assert any("are left out: their encoding 'something'" in note for note in source.notes)
    assert source.camera is not None


def test_pictures_that_show_nothing_are_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(FRAMES):
            stamp = START_NS + k * STEP_NS
            bag.write("/points", stamp, bag.cloud(np.full((5, 3), np.nan if k else 0.5), None, stamp))
    with pytest.warns(UserWarning, match="2 of 3 pictures show nothing"):
        _, found = imported(tmp_path / "take", tmp_path)
    assert found["empty_pictures"] == 2


@pytest.mark.parametrize(("topic", "lens"), [("image_rect", (40.0, 41.0, 30.0, 22.0)), ("image_raw", LENS)])
def test_rectified_depth_has_the_projection_matrix_and_no_distortion(topic: str, lens: tuple, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        info = bag.info(START_NS, d=(0.1, 0.0, 0.0, 0.0, 0.0))
        info.p[[0, 5, 2, 6]] = [40.0, 41.0, 30.0, 22.0]
        bag.write("/cam/depth/camera_info", START_NS, info)
        bag.write(f"/cam/depth/{topic}", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
    found = imported(tmp_path / "take", tmp_path)[0].cameras[0]
    assert found is not None and (found.fx, found.fy, found.cx, found.cy) == lens
    assert bool(np.any(np.asarray(found.distortion) != 0.0)) == (topic == "image_raw")


@pytest.mark.parametrize("name", ["TAKE.BAG", "take", "take.mcap"])
@pytest.mark.parametrize("kind", ["1", "sqlite3"])
def test_the_content_tells_a_bag_and_not_its_ending(kind: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.bag" if kind == "1" else "a")
    with BagWriter(path, kind) as bag:
        write_camera(bag, 3)
    (path if path.is_file() else next(path.glob("*.db3"))).rename(tmp_path / name)
    assert imported(tmp_path / name, tmp_path)[0].frame_count == 3


def test_noise_with_the_ending_of_a_bag_is_called_none(tmp_path: Path) -> None:
    (tmp_path / "take.mcap").write_bytes(np.random.default_rng(0).bytes(500))
    with pytest.raises(InputError, match="it is none") as caught:
        open_source(tmp_path / "take.mcap")
    assert "recover" not in str(caught.value)


def test_an_input_that_two_topics_hold_is_named_and_can_be_chosen(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((5, 3)), None, at))
            bag.write("/commands", at, bag.joints(["m"], at, effort=[1.0]))
            bag.write("/states", at, bag.joints(["m"], at, effort=[2.0]))
    source = open_source(tmp_path / "take")
    assert next(source.frames()).inputs == {"cable_m": 2.0}
    assert any("/commands and /states: that of /states is taken" in note for note in source.notes)
    chosen = open_source(tmp_path / "take", Options(columns={"/commands.m": "cable_m"}))
    assert next(chosen.frames()).inputs == {"cable_m": 1.0}
