"""Bags that are broken: cut off, never closed, garbage, of another type store, of another size, and one that is merely large."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")
from imported import imported, without_invalid
from ros_writers import START_NS, BagWriter, depth_of, write_camera

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import read_cloud
from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import open_source


def cut_bag(folder: Path, kind: str, share: float) -> Path:
    """Write 300 depth images into a bag, and keep a share of its file [1]."""
    path = folder / ("take.bag" if kind == "1" else "take")
    with BagWriter(path, kind, chunk=100_000) as bag:
        write_camera(bag, 300, motors=False)
    file = path if kind == "1" else next(f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    return file


@pytest.mark.parametrize("share", [0.5, 0.98])
def test_mcap_that_is_cut_off_is_read_up_to_the_break(share: float, tmp_path: Path) -> None:
    file = cut_bag(tmp_path, "mcap", share)
    with pytest.warns(UserWarning, match=r"the file is broken.*mcap recover"):
        recording, _ = imported(file, tmp_path)
    # all but the last unfinished chunk, which MCAP's writer makes of a megabyte (70 frames)
    assert 300 * share - 80 < recording.frame_count <= 300
    np.testing.assert_array_equal(read_png(tmp_path / "recording/depth/000000.png"), without_invalid(depth_of(0)))


@pytest.mark.parametrize("kind", ["1", "sqlite3", "mcap"])
@pytest.mark.parametrize("share", [0.0, 0.01])
def test_what_is_cut_off_at_its_beginning_is_refused_with_its_name(kind: str, share: float, tmp_path: Path) -> None:
    file = cut_bag(tmp_path, kind, share)
    with pytest.raises(InputError) as caught:
        open_source(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("share", [0.5, 0.98])
def test_ros_1_that_is_cut_off_is_refused_with_the_program_that_mends_it(share: float, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rosbag reindex"):
        open_source(cut_bag(tmp_path, "1", share))


def test_a_bag_of_ros_1_that_was_never_closed(tmp_path: Path) -> None:
    """Its header holds no place of an index, as while it is recorded."""
    with BagWriter(tmp_path / "take.bag", "1") as bag:
        write_camera(bag, 5)
    data = bytearray((tmp_path / "take.bag").read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    (tmp_path / "take.bag").write_bytes(data)
    with pytest.raises(InputError, match=r"(?s)not indexed.*rosbag reindex"):
        open_source(tmp_path / "take.bag")


def test_garbage_with_the_ending_of_a_bag(tmp_path: Path) -> None:
    for name in ("a.bag", "a.db3", "a.mcap"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
        with pytest.raises(InputError, match="not readable as a ROS bag"):
            open_source(tmp_path / name)


def test_messages_of_another_type_store_cost_themselves_only(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 4, motors=False)
        bag.writer.write(bag.connections["/camera/depth/image_raw"], START_NS + 10**9, b"\x00\x01\x00\x00garbage")
    with pytest.warns(UserWarning, match="a message that its type does not describe"):
        recording, _ = imported(tmp_path / "take", tmp_path)
    assert recording.frame_count == 4


def test_an_image_of_another_size_than_its_lens(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/depth/image_raw", START_NS, bag.image(depth_of(0), "16UC1", START_NS))
        bag.write("/depth/camera_info", START_NS, bag.info(START_NS, size=(32, 24)))
    with pytest.raises(InputError, match="another size than its CameraInfo"):
        imported(tmp_path / "take", tmp_path)


def test_a_million_points(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((1_000_000, 3)).astype(np.float32) + 0.1
    with BagWriter(tmp_path / "take", "mcap") as bag:
        bag.write("/points", START_NS, bag.cloud(points, None, START_NS))
    imported(tmp_path / "take", tmp_path)
    np.testing.assert_array_equal(read_cloud(tmp_path / "recording/clouds/000000.ply").points, points.astype(float))


def test_points_beyond_the_width_of_a_cloud_are_said(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.3, 0.4, (50, 3)).astype("<f4")
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(2):
            message = bag.cloud(points, None, START_NS + k * 10**8)
            bag.write("/points", START_NS + k * 10**8, replace(message, width=30, row_step=30 * message.point_step))
    with pytest.warns(UserWarning, match=r"240 bytes of a cloud beyond its width and height are not read"):
        imported(tmp_path / "take", tmp_path)
