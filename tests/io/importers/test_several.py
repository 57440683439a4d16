"""Several cameras in one import: brought together by time, each with its own lens, pose, folders and markers."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imported import imported
from ros_writers import HEIGHT, START_NS, STEP_NS, WIDTH, BagWriter, depth_of

from femsense.app import cli
from femsense.app.import_command import import_into
from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.io.importers.frames import Frame, Images, Source, camera_of_numbers
from femsense.io.importers.guess import open_sources
from femsense.io.importers.options import Options
from femsense.io.importers.several import camera_names, joined
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording
from femsense.model.camera import Camera

LENS = camera_of_numbers(8, 6, (5.0, 5.0), (3.5, 2.5))
TIMES = 10.0 + 0.1 * np.arange(6)


def camera(times: np.ndarray, level: int, *, lens: Camera = LENS, **more: object) -> Source:
    def frames() -> Iterator[Frame]:
        for k, t in enumerate(times.tolist()):
            picture: Callable[[], Images] = lambda k=k: Images(np.full((6, 8), level + k, dtype=np.uint16))  # noqa: E731
            yield Frame(t, picture=picture, markers={"tip": (0.0, 0.1 * level, 1.0)}, **more)

    return Source(Path("x"), frames, camera=lens, actuation="tension")


def levels(folder: Path, name: str) -> dict[int, int]:
    """Return frame → the value of a camera's image there."""
    return {int(file.stem): int(read_png(file)[0, 0]) for file in (folder / "depth" / name).iterdir()}


def test_each_frame_takes_the_nearest_of_the_other_cameras(tmp_path: Path) -> None:
    late = np.delete(TIMES + 0.03, 2)
    one, two = camera(TIMES, 100, inputs={"cable_a": 1.5}), camera(late, 200, lens=replace(LENS, fx=7.0))
    found = write_recording(joined({"one": one, "two": two}, tmp_path, Options()), tmp_path / "r", identity={})
    recording = load_recording(tmp_path / "r")
    assert recording.camera_names == ("one", "two") and recording.frame_count == 6
    assert levels(tmp_path / "r", "one") == {k: 100 + k for k in range(6)}
    assert levels(tmp_path / "r", "two") == {0: 200, 1: 201, 3: 202, 4: 203, 5: 204}
    assert [c.fx for c in recording.cameras if c] == [5.0, 7.0]
    np.testing.assert_array_equal(recording.inputs[:, 0], 1.5)
    assert [c["pictures"] for c in found["cameras"]] == [6, 5]
    with (tmp_path / "r/markers.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(r["frame"], r["camera"]) for r in rows[:3]] == [("0", "one"), ("0", "two"), ("1", "one")]


def test_frames_follow_the_camera_with_pictures_and_others_may_be_faster(tmp_path: Path) -> None:
    capture = Source(Path("x"), lambda: (Frame(t, markers={"tip": (t, 0.0, 0.0)}) for t in np.arange(9.0, 11.0, 0.01).tolist()))
    source = joined({"mocap": capture, "cam": camera(TIMES, 100)}, tmp_path, Options())
    write_recording(source, tmp_path / "r", identity={})
    recording = load_recording(tmp_path / "r")
    seen = recording.marker_xyz[recording.marker_view == recording.camera_names.index("mocap")]
    np.testing.assert_allclose(seen[:, 0], TIMES, atol=1e-9)
    assert recording.cameras[recording.camera_names.index("mocap")] is None


def test_other_clocks_are_refused_or_shifted(tmp_path: Path) -> None:
    sources = {"one": camera(TIMES, 100), "two": camera(TIMES - 7.0, 200)}
    with pytest.raises(InputError, match="do not overlap") as error:
        joined(sources, tmp_path, Options())
    assert "--shift two=7.000" in str(error.value)
    write_recording(joined(sources, tmp_path, Options(shifts={"two": 7.0})), tmp_path / "r", identity={})
    assert levels(tmp_path / "r", "two") == {k: 200 + k for k in range(6)}
    with pytest.raises(InputError, match="no such camera"):
        joined(sources, tmp_path, Options(shifts={"three": 1.0}))


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (["/front/depth/image_raw", "/side/depth/image_raw"], ["front", "side"]),
        (["takes/a.db3", "takes/b.db3"], ["a", "b"]),
        (["one/take.db3", "two/take.db3"], ["one", "two"]),
        (["x/a b.c3d", "x/a,b.c3d"], ["cam1", "cam2"]),
    ],
)
def test_cameras_are_named_by_what_tells_them_apart(labels: list[str], names: list[str]) -> None:
    assert camera_names(labels) == names


def two_cameras(path: Path, kind: str) -> Path:
    with BagWriter(path, kind) as bag:
        for side, x in (("left", 0.1), ("right", -0.1)):
            bag.write("/tf_static", START_NS, bag.static_transform("base", f"{side}_optical", (x, 0.0, 0.5)))
        bag.write("/tf_static", START_NS, bag.static_transform("left_optical", "mocap", (0.0, 0.2, 0.0)))
        for k in range(4):
            stamp = START_NS + k * STEP_NS
            for i, side in enumerate(("left", "right")):
                frame = f"{side}_optical"
                bag.write(
                    f"/{side}/depth/image_raw", stamp + i, bag.image(depth_of(10 * i + k), "16UC1", stamp + i * 10**6, frame)
                )
                bag.write(f"/{side}/depth/camera_info", stamp, bag.info(stamp, frame, lens=(50.0 + i, 51.0, 31.5, 23.5)))
                color = np.full((HEIGHT, WIDTH, 3), 50 * (i + 1), dtype=np.uint8)
                bag.write(f"/{side}/color/image_raw", stamp, bag.image(color, "rgb8", stamp + i * 10**6, frame))
                bag.write(f"/{side}/color/camera_info", stamp, bag.info(stamp, frame))
            bag.write("/markers", stamp, bag.marker_array({"tip": (0.0, 0.0, 0.3)}, stamp, "mocap"))
    return path


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_topics_of_a_bag_as_cameras_with_poses_of_its_transforms(tmp_path: Path, kind: str) -> None:
    path = two_cameras(tmp_path / "take", kind)
    topics = ("/left/depth/image_raw", "/right/depth/image_raw")
    with pytest.raises(InputError, match="each is a camera"):
        open_sources([path])
    recording, found = imported(path, tmp_path, Options(topics=topics, base="base"))
    assert recording.camera_names == ("left", "right")
    left, right = recording.T_robot_camera
    assert left is not None and right is not None
    np.testing.assert_allclose(left[:3, 3], [0.1, 0, 0.5])
    np.testing.assert_allclose(right[:3, 3], [-0.1, 0, 0.5])
    for i, name in enumerate(("left", "right")):
        folder = tmp_path / "recording"
        expected = depth_of(10 * i + 2)
        np.testing.assert_array_equal(read_png(folder / "depth" / name / "000002.png"), np.where(expected == 65535, 0, expected))
        assert int(read_png(folder / "color" / name / "000002.png").max()) == 50 * (i + 1)
    np.testing.assert_array_equal(recording.marker_view, 0)  # a marker is measured once, by the first camera that is joined to it
    np.testing.assert_allclose(recording.marker_xyz[0], [0.0, 0.2, 0.3])
    assert [c["lens"].split(" ")[0] for c in found["cameras"]] == [str(WIDTH)] * 2
    with pytest.raises(InputError, match="no static transform joins the robot's frame"):
        imported(path, tmp_path / "other", Options(topics=topics, base="bse"))


def test_several_files_are_cameras_and_the_same_command_does_nothing(tmp_path: Path) -> None:
    for name in ("front", "side"):
        with BagWriter(tmp_path / name, "sqlite3") as bag:
            for k in range(3):
                stamp = START_NS + k * STEP_NS
                bag.write(f"/{name}/depth", stamp, bag.image(depth_of(k), "16UC1", stamp))
                bag.write(f"/{name}/camera_info", stamp, bag.info(stamp))
    said: list[str] = []
    paths = [str(tmp_path / "front"), f"second={tmp_path / 'side'}"]
    found = import_into(tmp_path / "r", paths, Options(), say=said.append)
    assert load_recording(tmp_path / "r").camera_names == ("front", "second") and found["frames"] == 3
    import_into(tmp_path / "r", paths, Options(), say=said.append)
    assert len(said) == 1 and "already" in said[0]
    with pytest.raises(InputError, match="import of another source"):
        import_into(tmp_path / "r", [paths[0], f"third={tmp_path / 'side'}"], Options(), say=said.append)
    with pytest.raises(InputError, match="occurs twice"):
        import_into(tmp_path / "s", [f"a={tmp_path / 'side'}", f"a={tmp_path / 'front'}"], Options(), say=said.append)


def test_one_of_so_many_frames_and_spans_that_are_free(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(7):
            bag.write("/markers", START_NS + k * 10**9, bag.marker_array({"tip": (0.1 * k, 0.0, 0.3)}, START_NS + k * 10**9))
    said = ["--every", "2", "--free", "0:0.5", "--free", "4:6"]
    assert cli.run(["import", str(tmp_path / "take"), "-o", str(tmp_path / "r"), *said]) == 0
    recording = load_recording(tmp_path / "r")
    np.testing.assert_allclose(recording.time_s, [0, 2, 4, 6])
    np.testing.assert_allclose(recording.marker_xyz[:, 0], [0, 0.2, 0.4, 0.6])
    assert recording.free is not None and recording.free.tolist() == [True, False, True, True]
