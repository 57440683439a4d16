"""Bags that `rosbags` wrote: ROS 1, ROS 2 in SQLite and MCAP, whole and broken."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
from helpers import marker_grid
from imported import imported, without_invalid
from ros_writers import HEIGHT, LENS, START_NS, STEP_NS, WIDTH, BagWriter, color_of, depth_of, write_camera

from femsense.core.errors import InputError
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import open_source
from femsense.io.importers.options import Clock, Options
from femsense.io.importers.writer import write_recording

FRAMES = 8
KINDS = ("1", "sqlite3", "mcap")


def bag_path(folder: Path, kind: str) -> Path:
    return folder / ("take.bag" if kind == "1" else "take")


@pytest.mark.parametrize("kind", KINDS)
def test_an_aligned_camera_with_motors(kind: str, tmp_path: Path) -> None:
    with BagWriter(bag_path(tmp_path, kind), kind) as bag:
        write_camera(bag, FRAMES)
    recording, found = imported(bag_path(tmp_path, kind), tmp_path)
    for k in range(FRAMES):
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/depth/{k:06d}.png"), without_invalid(depth_of(k)))
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/color/{k:06d}.png")[:, :, ::-1], color_of(k))
    np.testing.assert_allclose(recording.time_s, 1e-9 * STEP_NS * np.arange(FRAMES), atol=1e-6)
    assert recording.cable_names == ("north", "south") and recording.actuation == "tension"
    np.testing.assert_allclose(recording.inputs[:-1, 0], recording.time_s[:-1], atol=1e-6)
    np.testing.assert_allclose(recording.inputs[:-1, 1], 2 * recording.time_s[:-1] + 1, atol=1e-6)
    lens = recording.cameras[0]
    assert lens is not None and (lens.width, lens.height, lens.depth_unit) == (WIDTH, HEIGHT, 0.001)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == LENS
    assert found["clock"] == "header" and found["depth_images"] == FRAMES and found["gaps"] == 0


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_file_without_its_metadata_and_a_bare_file(kind: str, tmp_path: Path) -> None:
    folder = bag_path(tmp_path, kind)
    with BagWriter(folder, kind) as bag:
        write_camera(bag, FRAMES, motors=False)
    (folder / "metadata.yaml").unlink()
    bare = next(folder.iterdir())
    with pytest.warns(UserWarning, match=r"metadata\.yaml is missing"):
        recording, _ = imported(folder, tmp_path / "a")
    assert recording.frame_count == FRAMES
    assert imported(bare, tmp_path / "b")[0].frame_count == FRAMES


def test_png_and_depth_in_messages_that_are_compressed(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(FRAMES):
            at = START_NS + k * STEP_NS
            png = bytes(12) + cv2.imencode(".png", depth_of(k))[1].tobytes()
            bag.write("/cam/depth/image_raw/compressedDepth", at, bag.compressed(png, "16UC1; compressedDepth png", at))
            bag.write("/cam/depth/camera_info", at, bag.info(at))
            png = cv2.imencode(".png", color_of(k)[:, :, ::-1])[1].tobytes()
            bag.write("/cam/color/image_raw/compressed", at, bag.compressed(png, "rgb8; png compressed bgr8", at))
            bag.write("/cam/color/camera_info", at, bag.info(at))
    imported(tmp_path / "take", tmp_path)
    for k in range(FRAMES):
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/depth/{k:06d}.png"), without_invalid(depth_of(k)))
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/color/{k:06d}.png")[:, :, ::-1], color_of(k))


@pytest.mark.parametrize("packing", ["png", "rvl"])
def test_floating_depth_compressed_by_its_inverse(packing: str, tmp_path: Path) -> None:
    """32FC1 in compressedDepth holds a / depth + b as 16 bits (compressed_depth_image_transport)."""
    metres = np.linspace(0.3, 1.2, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    a, b = 1e4, 10.0
    packed = np.rint(a / metres + b).astype(np.uint16)
    packed[5, 5] = 0
    with BagWriter(tmp_path / "take", "mcap") as bag:
        rvl = struct.pack("<II", WIDTH, HEIGHT) + packed_rvl(packed)
        data = struct.pack("<iff", 0, a, b) + (rvl if packing == "rvl" else cv2.imencode(".png", packed)[1].tobytes())
        bag.write("/depth/image/compressedDepth", START_NS, bag.compressed(data, f"32FC1; compressedDepth {packing}", START_NS))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS))
    recording, _ = imported(tmp_path / "take", tmp_path)
    lens = recording.cameras[0]
    assert lens is not None
    depth = read_png(tmp_path / "recording/depth/000000.png") * lens.depth_unit
    assert depth[5, 5] == 0
    depth[5, 5] = metres[5, 5]
    np.testing.assert_allclose(depth, metres, atol=1.2e-4)


def packed_rvl(depth: np.ndarray) -> bytes:
    """Pack a depth image as A. D. Wilson, "Fast Lossless Depth Image Compression" (2017), describes it."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            low, value = value & 7, value >> 3
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    values, at, last = depth.ravel().tolist(), 0, 0
    while at < len(values):
        start = at
        while at < len(values) and not values[at]:
            at += 1
        put(at - start)
        start = at
        while at < len(values) and values[at]:
            at += 1
        put(at - start)
        for value in values[start:at]:
            step, last = value - last, value
            put(2 * step if step >= 0 else -2 * step - 1)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return np.array(words, dtype="<u4").tobytes()


def test_depth_packed_by_rvl(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(3):
            at = START_NS + k * STEP_NS
            data = bytes(12) + struct.pack("<II", WIDTH, HEIGHT) + packed_rvl(depth_of(k))
            bag.write("/depth/image_raw/compressedDepth", at, bag.compressed(data, "16UC1; compressedDepth rvl", at))
            bag.write("/depth/camera_info", at, bag.info(at))
    imported(tmp_path / "take", tmp_path)
    for k in range(3):
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/depth/{k:06d}.png"), without_invalid(depth_of(k)))


def test_the_points_of_a_lens_with_eight_numbers(tmp_path: Path) -> None:
    """Time-of-flight cameras have the rational polynomial; the points are those that OpenCV finds."""
    d = (0.5, -0.3, 0.001, -0.0005, 0.02, 0.45, -0.28, 0.01)
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, model="rational_polynomial", d=d))
    recording, _ = imported(tmp_path / "take", tmp_path)
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None
    depth = without_invalid(depth_of(0))
    row, column = np.nonzero(depth)
    fx, fy, cx, cy = LENS
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    z = 1e-3 * depth[row, column]
    pixels = cv2.projectPoints(cloud.points, np.zeros(3), np.zeros(3), K, np.array(d))[0][:, 0]
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=1), atol=1e-5)
    np.testing.assert_allclose(cloud.points[:, 2], z)


@pytest.mark.parametrize("big", [False, True])
def test_floating_depth_and_either_order_of_bytes(big: bool, tmp_path: Path) -> None:
    metres = np.full((HEIGHT, WIDTH), 0.5432, dtype=np.float32)
    metres[0, :4] = [np.nan, np.inf, 0.0, 9.0]
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(metres, "32FC1", START_NS, big=big, pad=8))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS))
    imported(tmp_path / "take", tmp_path)
    depth = read_png(tmp_path / "recording/depth/000000.png")
    np.testing.assert_array_equal(depth[0, :4], 0)
    assert np.unique(depth[1:]).tolist() == [5432]


@pytest.mark.parametrize("big", [False, True])
def test_clouds_keep_places_and_colours(big: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    points[7] = np.nan
    colors = rng.integers(0, 256, size=(500, 3))
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(3):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(points + np.float32(k), colors, at, big=big))
    recording, found = imported(tmp_path / "take", tmp_path)
    assert found["clouds"] == 3
    kept = np.arange(500) != 7
    for k in range(3):
        cloud = read_frame_cloud(recording, k)
        assert cloud is not None and cloud.colors is not None
        np.testing.assert_array_equal(cloud.points, (points + np.float32(k))[kept].astype(float))
        np.testing.assert_array_equal(np.rint(255 * cloud.colors), colors[kept])


def test_the_points_of_a_fisheye_depth_camera(tmp_path: Path) -> None:
    """They are those that OpenCV finds."""
    d = (0.05, -0.01, 0.002, 0.0)
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, model="equidistant", d=d))
    recording, _ = imported(tmp_path / "take", tmp_path)
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None
    depth = without_invalid(depth_of(0))
    row, column = np.nonzero(depth)
    fx, fy, cx, cy = LENS
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rays = cv2.fisheye.undistortPoints(np.stack([column, row], axis=1)[:, None].astype(float), K, np.array(d))[:, 0]
    z = 1e-3 * depth[row, column]
    np.testing.assert_allclose(cloud.points, np.column_stack([rays * z[:, None], z]), atol=1e-6)


def test_the_points_of_a_depth_camera_with_the_sdks_inverse_lens(tmp_path: Path) -> None:
    """Two pixels at 1 m as `rs2_deproject_pixel_to_point` of pyrealsense2 2.57.7 and 2.59.1 gives them."""
    d = (0.12, -0.2, 0.03, -0.02, 0.05)
    depth = np.zeros((HEIGHT, WIDTH), dtype=np.uint16)
    depth[0, 0] = 65535
    depth[7, 5] = depth[40, 60] = 1000
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(depth, "16UC1", START_NS))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, model="Inverse Brown Conrady", d=d))
    recording, _ = imported(tmp_path / "take", tmp_path)
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None
    np.testing.assert_allclose(cloud.points, [[-0.512157, -0.327936, 1], [0.570252, 0.306582, 1]], atol=2e-6)


def test_colours_of_another_camera_by_static_transforms(tmp_path: Path) -> None:
    """A wall 0.5 m away: the colour camera, 20 mm to the right, sees each place 2 pixels farther left."""
    wall = np.full((HEIGHT, WIDTH), 500, dtype=np.uint16)
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/tf_static", START_NS, bag.static_transform("link", "depth_optical", (0.01, 0, 0)))
        bag.write("/tf_static", START_NS, bag.static_transform("link", "color_optical", (0.03, 0, 0)))
        bag.write("/depth/image_raw", START_NS, bag.image(wall, "16UC1", START_NS, "depth_optical"))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, "depth_optical"))
        bag.write("/color/image_raw", START_NS, bag.image(color_of(0), "rgb8", START_NS, "color_optical"))
        bag.write("/color/camera_info", START_NS, bag.info(START_NS, "color_optical"))
    imported(tmp_path / "take", tmp_path)
    color = read_png(tmp_path / "recording/color/000000.png")[:, :, ::-1]
    np.testing.assert_array_equal(color[:, 2:], color_of(0)[:, :-2])
    assert not color[:, :2].any()


def test_colours_of_a_camera_that_is_turned(tmp_path: Path) -> None:
    """The same wall, seen by a colour camera that is turned by 90° about its axis, to the right and upwards."""
    wall, place = np.full((HEIGHT, WIDTH), 500, dtype=np.uint16), np.array([0.03, -0.01, 0.0])
    quarter = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/tf_static", START_NS, bag.static_transform("depth_optical", "color_optical", place, quarter))
        bag.write("/depth/image_raw", START_NS, bag.image(wall, "16UC1", START_NS, "depth_optical"))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, "depth_optical"))
        bag.write("/color/image_raw", START_NS, bag.image(color_of(0), "rgb8", START_NS, "color_optical"))
        bag.write("/color/camera_info", START_NS, bag.info(START_NS, "color_optical"))
    imported(tmp_path / "take", tmp_path)
    color = read_png(tmp_path / "recording/color/000000.png")[:, :, ::-1]
    fx, fy, cx, cy = LENS
    row, column = np.indices((HEIGHT, WIDTH)).reshape(2, -1)
    points = 0.5 * np.column_stack([(column - cx) / fx, (row - cy) / fy, np.ones(row.size)]) - place
    x, y = points[:, 1], -points[:, 0]  # the camera's x points down, its y to the left
    u, v = np.rint(fx * x / 0.5 + cx).astype(int), np.rint(fy * y / 0.5 + cy).astype(int)
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    assert inside.sum() > 300
    same = (color[row[inside], column[inside]] == color_of(0)[v[inside], u[inside]]).all(axis=1)
    assert same.mean() > 0.99 and not color[row[~inside], column[~inside]].any()


def test_colours_without_a_known_place_are_left_out_and_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS, "a"))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, "a"))
        bag.write("/color/image_raw", START_NS, bag.image(color_of(0), "rgb8", START_NS, "b"))
        bag.write("/color/camera_info", START_NS, bag.info(START_NS, "b"))
    source = open_source(tmp_path / "take")
    assert any("/color/image_raw" in note and "left out" in note for note in source.notes)
    imported(tmp_path / "take", tmp_path)
    assert not (tmp_path / "recording/color").exists()


def test_several_cameras_are_a_choice(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for name in ("left", "right"):
            bag.write(f"/{name}/depth/image_raw", START_NS, bag.image(depth_of(name == "right"), "16UC1", START_NS, name))
            bag.write(f"/{name}/depth/camera_info", START_NS, bag.info(START_NS, name))
    with pytest.raises(InputError) as caught:
        open_source(tmp_path / "take")
    assert "/left/depth/image_raw" in str(caught.value) and "/right/depth/image_raw" in str(caught.value)
    imported(tmp_path / "take", tmp_path, Options(topics=["/right/depth/image_raw"]))
    np.testing.assert_array_equal(read_png(tmp_path / "recording/depth/000000.png"), without_invalid(depth_of(1)))
    with pytest.raises(InputError, match="no such topic"):
        open_source(tmp_path / "take", Options(topics=["/middle"]))


def test_stamps_that_are_no_clock_are_not_used(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take.bag", "1") as bag:
        for k in range(FRAMES):
            bag.write("/depth/image_raw", START_NS + k * STEP_NS, bag.image(depth_of(k), "16UC1", 0))
            bag.write("/depth/camera_info", START_NS + k * STEP_NS, bag.info(0))
    recording, found = imported(tmp_path / "take.bag", tmp_path)
    assert found["clock"] == "record"
    np.testing.assert_allclose(recording.time_s, 1e-9 * STEP_NS * np.arange(FRAMES), atol=1e-6)


def test_stamps_of_another_clock_are_not_used(tmp_path: Path) -> None:
    """A driver that counts from its start, and commands without stamps: one clock serves both."""
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(FRAMES):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((4, 3)), None, 10**9 + k * STEP_NS))
            bag.write("/commands", at, bag.array([float(k)]))
    recording, found = imported(tmp_path / "take", tmp_path, actuation="tension")
    assert found["clock"] == "record"
    np.testing.assert_allclose(recording.inputs[:, 0], np.arange(FRAMES), atol=1e-4)


def test_header_stamps_win_over_the_jitter_of_recording(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(FRAMES):
            stamp = START_NS + k * STEP_NS
            bag.write("/points", stamp + int(rng.integers(1, 20)) * 10**6, bag.cloud(np.ones((4, 3)), None, stamp))
    recording, _ = imported(tmp_path / "take", tmp_path / "a")
    np.testing.assert_allclose(np.diff(recording.time_s), 1e-9 * STEP_NS, atol=1e-6)
    late, _ = imported(tmp_path / "take", tmp_path / "b", Options(clock=Clock.RECORD))
    assert np.ptp(np.diff(late.time_s)) > 1e-3


def test_a_mapping_of_motors_with_a_factor(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((4, 3)), None, at))
            bag.write("/motors", at, bag.joints(["m1", "m2"], at, position=[0.1 * k, 5.0], effort=[1.0, 2.0]))
    recording, _ = imported(tmp_path / "take", tmp_path, Options(columns={"m1.position": "cable_north*-0.02"}))
    assert recording.cable_names == ("north",)
    assert recording.actuation == "displacement" and recording.actuation_zero == "unknown"
    np.testing.assert_allclose(recording.inputs[:, 0], -0.002 * np.arange(4), atol=1e-9)


def test_commands_in_arrays_say_no_unit(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((4, 3)), None, at))
            bag.write("/commands", at, bag.array([k, 2.0 * k]))
    options = Options(columns={"0": "cable_a", "1": "cable_b"})
    with pytest.raises(InputError, match="--inputs tension"):
        imported(tmp_path / "take", tmp_path, options)
    recording, _ = imported(tmp_path / "take", tmp_path, options, actuation="tension")
    np.testing.assert_allclose(recording.inputs, np.arange(4)[:, None] * [1.0, 2.0], atol=3e-5)


def test_known_loads_need_their_place(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((4, 3)), None, at))
            bag.write("/ft", at, bag.wrench((0.0, 0.0, -0.1 * k), at))
    assert any("/ft" in note and "load@" in note for note in open_source(tmp_path / "take").notes)
    recording, _ = imported(tmp_path / "take", tmp_path, Options(columns={"/ft": "load@0.1,0,0.02"}))
    np.testing.assert_allclose(recording.load_points, [[0.1, 0, 0.02]] * 4)
    np.testing.assert_allclose(recording.load_forces[:, 2], -0.1 * np.arange(4), atol=1e-9)


def test_named_markers_in_a_frame_that_static_transforms_join(tmp_path: Path) -> None:
    """The motion capture stands 1 m above the camera, turned by 90° about z."""
    half = np.sqrt(0.5)
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/tf_static", START_NS, bag.static_transform("cam", "mocap", (0, 0, 1), (0, 0, half, half)))
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/points", at, bag.cloud(np.ones((4, 3)), None, at))
            bag.write("/markers", at, bag.marker_array({"tip": (0.1, 0.2, 0.01 * k)}, at, "mocap"))
    recording, _ = imported(tmp_path / "take", tmp_path)
    assert recording.marker_names == ("tip",)
    np.testing.assert_allclose(marker_grid(recording)[:, 0], [[-0.2, 0.1, 1 + 0.01 * k] for k in range(4)], atol=1e-12)


def test_markers_without_names_stay_without(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            at = START_NS + k * STEP_NS
            bag.write("/poses", at, bag.poses([(0.1, 0, 0), (0.2, 0, 0.01 * k)], at))
    found = write_recording(open_source(tmp_path / "take"), tmp_path / "out", identity={})
    rows = (tmp_path / "out/markers.csv").read_text().splitlines()
    assert found["unlabelled_markers"] == 2 and rows[0] == "frame,marker,x_m,y_m,z_m"
    assert rows[-1] == "3,,0.2,0.0,0.03"


MOCAP4R2 = {
    "mocap4r2_msgs/msg/Marker": "int8 USE_NAME=0\nint8 USE_INDEX=1\nint8 USE_BOTH=2\nint8 id_type\nint32 marker_index\n"
    "string marker_name\ngeometry_msgs/Point translation",
    "mocap4r2_msgs/msg/Markers": "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/Marker[] markers",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\nmocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose",
    "mocap4r2_msgs/msg/RigidBodies": "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies",
}
"""Messages of the motion-capture drivers for ROS 2."""


def test_markers_and_bodies_of_mocap4r2(tmp_path: Path) -> None:
    from rosbags.typesys import get_types_from_msg

    with BagWriter(tmp_path / "take", "mcap") as bag:
        for name, text in MOCAP4R2.items():
            bag.store.register(get_types_from_msg(text, name))
        marker, body = bag.type("mocap4r2_msgs/msg/Marker"), bag.type("mocap4r2_msgs/msg/RigidBody")
        for k in range(3):
            at = START_NS + k * STEP_NS
            named = marker(0, 0, "tip", bag.vector((0.1, 0.2, 0.01 * k), "Point"))
            indexed = marker(1, 7, "", bag.vector((0.3, 0.2, 0.1), "Point"))
            bag.write("/markers", at, bag.type("mocap4r2_msgs/msg/Markers")(bag.header(at), k, [named, indexed]))
            base = body("base", [named], bag.pose((1.0, 2.0, 3.0)))
            bag.write("/rigid_bodies", at, bag.type("mocap4r2_msgs/msg/RigidBodies")(bag.header(at), k, [base]))
    recording, _ = imported(tmp_path / "take", tmp_path)
    assert set(recording.marker_names) == {"tip", "7", "base"}
    grid = dict(zip(recording.marker_names, marker_grid(recording).transpose(1, 0, 2)))
    np.testing.assert_allclose(grid["tip"], [[0.1, 0.2, 0.01 * k] for k in range(3)])
    np.testing.assert_allclose(grid["base"], [[1.0, 2.0, 3.0]] * 3)


def test_efforts_that_begin_at_zero_are_tensions_and_arrays_of_markers_keep_the_clock(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(4):
            stamp = START_NS + k * STEP_NS
            bag.write("/camera/depth/image_raw", stamp + 9_000_000, bag.image(depth_of(k), "16UC1", stamp))
            bag.write("/camera/depth/camera_info", stamp, bag.info(stamp))
            bag.write("/motors", stamp, bag.joints(["a"], stamp, position=[0.0], effort=[0.5 * k]))
            bag.write("/markers", stamp, bag.marker_array({"tip": (0.0, 0.0, 0.3), "m": (0.1, 0.0, 0.3)}, stamp))
            bag.write("/base", stamp, bag.poses([(0.2, 0.0, 0.3)], stamp))
    recording, found = imported(tmp_path / "take", tmp_path, Options(columns={"m": "marker.left", "/base": "marker.base"}))
    assert set(recording.marker_names) == {"tip", "left", "base"}
    assert found["clock"] == "header" and found["actuation"] == "tension"
    np.testing.assert_allclose(recording.inputs[:, 0], 0.5 * np.arange(4))
