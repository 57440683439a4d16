"""Folders: TUM RGB-D, Redwood (as Open3D writes its lens), and clouds in every kind of file."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import DATA

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import guess_format, open_source
from femsense.io.importers.images.folders import read_points
from femsense.io.importers.options import Options
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud

SIZE = (48, 64)


def depth(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    image = np.random.default_rng(number).integers(1000, 9000, size=size).astype(np.uint16)
    image[3, 3], image[4, 4] = 0, 65535
    return image


def color(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(100 + number).integers(0, 256, size=(*size, 3)).astype(np.uint8)


def imported(path: Path, folder: Path, options: Options | None = None) -> tuple[Recording, dict]:
    found = write_recording(open_source(path, options), folder, identity={"test": str(path)})
    return load_recording(folder), found


def tum(folder: Path, frames: int = 4, size: tuple[int, int] = SIZE) -> Path:
    """Write a TUM RGB-D folder whose colours are 5 ms late, the last one 100 ms."""
    lines: dict[str, list[str]] = {"depth": ["# depth maps"], "rgb": ["# color images"]}
    for name in lines:
        (folder / name).mkdir(parents=True)
    for k in range(frames):
        time = 1305031102.175304 + k / 30
        late = time + (0.1 if k == frames - 1 else 0.005)
        cv2.imwrite(str(folder / f"depth/{time:.6f}.png"), depth(k, size))
        cv2.imwrite(str(folder / f"rgb/{late:.6f}.png"), color(k, size)[:, :, ::-1])
        lines["depth"].append(f"{time:.6f} depth/{time:.6f}.png")
        lines["rgb"].append(f"{late:.6f} rgb/{late:.6f}.png")
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(text) + "\n")
    return folder


def test_tum(tmp_path: Path) -> None:
    folder = tum(tmp_path / "sequence")
    (folder / "calibration.txt").write_text("50.5 51.5 31.5 23.5 0.01 -0.02 0 0 0\n")
    assert guess_format(folder) == "tum"
    recording, found = imported(folder, tmp_path / "out")
    lens = recording.cameras[0]
    assert lens is not None and lens.depth_unit == 1 / 5000 and (lens.fx, lens.cy) == (50.5, 23.5)
    assert lens.distortion.tolist() == [0.01, -0.02, 0, 0, 0]
    for k in range(4):
        np.testing.assert_array_equal(read_png(tmp_path / f"out/depth/{k:06d}.png"), np.where(depth(k) == 65535, 0, depth(k)))
    np.testing.assert_array_equal(read_png(tmp_path / "out/color/000001.png")[:, :, ::-1], color(1))
    assert not (tmp_path / "out/color/000003.png").exists() and found["images_without_colour"] == 1
    np.testing.assert_allclose(recording.time_s, np.arange(4) / 30, atol=2e-6)


def test_tum_without_a_lens_has_the_benchmarks_or_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no lens"):
        open_source(tum(tmp_path / "small"))
    source = open_source(tum(tmp_path / "usual", 1, (480, 640)))
    assert source.camera is not None and source.camera.fx == 525.0
    assert any("525" in note for note in source.notes)


def test_redwood_with_the_lens_as_open3d_writes_it(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    folder = tmp_path / "scene"
    (folder / "depth").mkdir(parents=True)
    (folder / "color").mkdir()
    for k in range(3):
        stem = f"{k + 1:07d}-{33_333 * k:012d}"
        cv2.imwrite(str(folder / f"depth/{stem}.png"), depth(k))
        cv2.imwrite(str(folder / f"color/{stem}.png"), color(k)[:, :, ::-1])
    lens = o3d.camera.PinholeCameraIntrinsic(64, 48, 51.0, 52.0, 30.5, 22.5)
    o3d.io.write_pinhole_camera_intrinsic(str(folder / "camera_intrinsic.json"), lens)
    assert guess_format(folder) == "redwood"
    recording, _ = imported(folder, tmp_path / "out")
    camera = recording.cameras[0]
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.depth_unit) == (51.0, 52.0, 30.5, 22.5, 0.001)
    np.testing.assert_allclose(recording.time_s, 0.033333 * np.arange(3), atol=1e-9)
    np.testing.assert_array_equal(read_png(tmp_path / "out/color/000002.png")[:, :, ::-1], color(2))
    data = json.loads((folder / "camera_intrinsic.json").read_text())
    (folder / "camera_intrinsic.json").write_text(json.dumps(data | {"width": 640}))
    with pytest.raises(InputError, match="another size"):
        open_source(folder)


@pytest.mark.parametrize("ending", ["ply", "pcd", "xyz", "npy", "npz"])
def test_clouds(ending: str, tmp_path: Path) -> None:
    folder = tmp_path / "clouds"
    folder.mkdir()
    rng = np.random.default_rng(0)
    clouds = [(rng.random((50, 3)) + 0.1).astype(np.float32).astype(float) for _ in range(11)]
    for k, points in enumerate(clouds):
        file = folder / f"frame_{k}.{ending}"  # 10 comes after 9
        if ending in ("ply", "pcd"):
            write_cloud(file, PointCloud(points))
        elif ending == "xyz":
            np.savetxt(file, points, fmt="%.17g")
        elif ending == "npy":
            np.save(file, points)
        else:
            np.savez(file, points=points)
    assert guess_format(folder) == "clouds"
    with pytest.raises(InputError, match="--rate"):
        open_source(folder, Options(unit="m"))
    recording, _ = imported(folder, tmp_path / "out", Options(rate=10.0, unit="m"))
    np.testing.assert_allclose(recording.time_s, 0.1 * np.arange(11), atol=1e-12)
    for k in range(11):
        cloud = read_frame_cloud(recording, k)
        assert cloud is not None
        np.testing.assert_array_equal(cloud.points, clouds[k])


@pytest.mark.parametrize("order", ["depth first", "colour first"])
def test_a_list_of_pairs_in_place_of_two_lists(order: str, tmp_path: Path) -> None:
    folder = tum(tmp_path / "sequence")
    depths, colors = ([line for line in (folder / f"{n}.txt").read_text().splitlines()[1:]] for n in ("depth", "rgb"))
    pairs = zip(depths, colors) if order == "depth first" else zip(colors, depths)
    (folder / "associations.txt").write_text("\n".join(f"{a} {b}" for a, b in pairs))
    (folder / "calibration.txt").write_text("50 50 32 24")
    for name in ("depth", "rgb"):
        (folder / f"{name}.txt").unlink()
    recording, found = imported(folder / "associations.txt", tmp_path / "out")
    assert recording.frame_count == 4 and found["images_without_colour"] == 1
    np.testing.assert_array_equal(read_png(tmp_path / "out/depth/000001.png"), np.where(depth(1) == 65535, 0, depth(1)))


PLACES = np.random.default_rng(3).random((50, 3)).round(3) + 0.1
STRUCTURED = np.zeros(50, dtype=[("rgb", "u4"), ("z", "f4"), ("y", "f8"), ("x", "f4")])
STRUCTURED["x"], STRUCTURED["y"], STRUCTURED["z"] = PLACES.T


@pytest.mark.parametrize(
    "arrays",
    [
        {"vertices": PLACES},
        {"a": PLACES, "stamp": np.array(1.5)},
        {"pc": PLACES, "color": np.full((50, 3), 51, dtype=np.uint8)},
        {"x": PLACES[:, 0], "y": PLACES[:, 1], "z": PLACES[:, 2]},
        {"data": np.column_stack([PLACES, np.full(50, 7.0)])},
        {"points": PLACES.T},
        {"image": PLACES.reshape(5, 10, 3)},
        {"": STRUCTURED},
    ],
)
def test_arrays_under_any_name_and_layout(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    if "" in arrays:
        np.save(tmp_path / "1.5.npy", arrays[""])
    else:
        np.savez(tmp_path / "1.5.npz", **arrays)
    cloud = read_points(next(tmp_path.iterdir()))
    np.testing.assert_allclose(cloud.points, PLACES, atol=1e-6)
    if "color" in arrays:
        assert cloud.colors is not None
        np.testing.assert_allclose(cloud.colors, 0.2)


def test_arrays_that_could_be_several_things_are_listed(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", left=PLACES, right=PLACES)
    with pytest.raises(InputError, match=r"several arrays[\s\S]*left \(50, 3\); right"):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize("mark", [" ", ",", ";", "\t"])
def test_text_of_points_with_a_header(mark: str, tmp_path: Path) -> None:
    lines = [mark.join(["X", "Y", "Z", "R", "G", "B"]), *(mark.join(map(str, [*p, 51, 102, 0])) for p in PLACES)]
    (tmp_path / "a.xyz").write_text("\n".join(lines))
    cloud = read_points(tmp_path / "a.xyz")
    assert cloud.colors is not None
    np.testing.assert_allclose(cloud.points, PLACES)
    np.testing.assert_allclose(cloud.colors[0], [0.2, 0.4, 0])


def test_clouds_in_millimetres_are_asked(tmp_path: Path) -> None:
    points = 300 * np.random.default_rng(0).random((20, 3))
    np.save(tmp_path / "1.5.npy", points)
    write_cloud(tmp_path / "1.6.ply", PointCloud(points))
    with pytest.raises(InputError, match="--unit"):
        open_source(tmp_path)
    recording, _ = imported(tmp_path, tmp_path / "out", Options(unit="mm"))
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None
    np.testing.assert_allclose(cloud.points, points / 1000)
    np.testing.assert_allclose(recording.time_s, [0.0, 0.1], atol=1e-9)


@pytest.mark.skipif(not (DATA / "realsense").is_dir(), reason="the real cloud is not there")
def test_a_genuine_cloud_of_a_camera(tmp_path: Path) -> None:
    recording, _ = imported(DATA / "realsense" / "test.ply", tmp_path / "out")
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None and len(cloud) == 6905 and cloud.colors is not None


def test_broken_files_cost_themselves(tmp_path: Path) -> None:
    folder = tum(tmp_path / "sequence")
    (folder / "calibration.txt").write_text("50.5 51.5 31.5 23.5")
    files = sorted((folder / "depth").iterdir())
    files[1].write_bytes(files[1].read_bytes()[:200])
    files[2].unlink()
    with pytest.warns(UserWarning, match="keeps no picture"):
        _, found = imported(folder, tmp_path / "out")
    assert found["depth_images"] == 2 and found["broken_pictures"] == 2
    files[0].write_bytes(b"")
    with pytest.raises(InputError, match="first depth image"):
        open_source(folder)


def test_nothing_that_is_known(tmp_path: Path) -> None:
    (tmp_path / "a.oni").write_bytes(b"ONI10\0\0\0")
    with pytest.raises(InputError, match="not a format that femsense imports"):
        open_source(tmp_path / "a.oni")
    with pytest.raises(InputError, match="nothing there"):
        open_source(tmp_path / "b.bag")
    with pytest.raises(InputError, match="no such format"):
        open_source(tmp_path / "a.oni", Options(format="rosbag"))


def test_a_depth_scale_beside_the_lens(tmp_path: Path) -> None:
    """Open3D's recorders write `depth_scale`, units in a metre, into the lens's file."""
    for name, listed in (("redwood", False), ("tum", True)):
        folder = tmp_path / name
        (folder / "depth").mkdir(parents=True)
        cv2.imwrite(str(folder / "depth" / "1.500.png"), depth(0))
        if listed:
            (folder / "depth.txt").write_text("1.5 depth/1.500.png\n")
        lens = {"width": 64, "height": 48, "intrinsic_matrix": [60, 0, 0, 0, 61, 0, 31, 23, 1], "depth_scale": 4000.0}
        (folder / "intrinsic.json").write_text(json.dumps(lens))
        assert open_source(folder).camera.depth_unit == 1 / 4000
        assert open_source(folder, Options(depth_unit=0.01)).camera.depth_unit == 0.01
    write_cloud(tmp_path / "1.5.ply", PointCloud(np.ones((3, 3))))
    with pytest.raises(InputError, match="--depth-unit"):
        open_source(tmp_path / "1.5.ply", Options(depth_unit=0.01))


def test_clouds_in_centimetres_ask_for_their_unit(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform([-5, -5, 40], [5, 5, 50], size=(100, 3))
    write_cloud(tmp_path / "1.5.ply", PointCloud(points))
    with pytest.raises(InputError, match="--unit"):
        open_source(tmp_path)
    recording, _ = imported(tmp_path, tmp_path / "out", Options(unit="cm"))
    np.testing.assert_allclose(read_frame_cloud(recording, 0).points, points / 100, atol=1e-6)
