"""Recording folders: what loads, what comes back after saving, and what each error says."""

from __future__ import annotations

import contextlib
import re
import warnings
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import DATA, RECORDING_FILES, marker_grid, write_block_robot, write_small_recording
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.core.errors import InputError
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.files import folder_hash
from femsense.io.recording_folder import load_recording, save_recording
from femsense.io.robot_toml import load_robot
from femsense.model.camera import Camera, CameraNoise
from femsense.model.plausibility import doubts_of_recording, warn_of
from femsense.model.recording import Recording, make_recording, select_frames, with_marker_table
from femsense.model.recording_checks import check_against
from femsense.model.recording_parts import About, Drives, LoadRows, MarkerRows, RestMarkers, Timeline, Tool, Views

TOML = RECORDING_FILES["recording.toml"]
CAMERA = "[camera]\nwidth = 8\nheight = 6\nfx = 10.0\nfy = 10.0\ncx = 3.5\ncy = 2.5\ndepth_unit_m = 0.001\n"
POSE = [[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
POSE_TOML = f"T_robot_camera = {POSE}\n"


def same_recording(a: Recording, b: Recording) -> None:
    """Assert that two recordings are the same bit by bit, wherever their folders and files stand."""
    for field in fields(Recording):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name in ("folder", "cloud_files", "color_files"):
            continue
        assert_same(x, y, field.name)
    for name in ("cloud_files", "color_files"):
        assert [[f is None for f in row] for row in getattr(a, name)] == [[f is None for f in row] for row in getattr(b, name)]


def assert_same(x: Any, y: Any, name: str) -> None:
    if isinstance(x, np.ndarray):
        np.testing.assert_array_equal(x, y, err_msg=name)
        assert x.dtype == y.dtype and not y.flags.writeable, name
    elif isinstance(x, Camera | CameraNoise | RestMarkers | Tool):
        for field in fields(x):
            if field.name == "mesh_file":
                continue
            assert_same(getattr(x, field.name), getattr(y, field.name), f"{name}.{field.name}")
    elif isinstance(x, tuple):
        assert len(x) == len(y), name
        for p, q in zip(x, y):
            assert_same(p, q, name)
    else:
        assert x == y, name


def write_png(path: Path, image: np.ndarray) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_ply(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\nproperty double "
        f"z\nend_header\n"
    )
    path.write_text(header + "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()))


def depth_recording(folder: Path) -> Path:
    write_small_recording(folder, recording_toml=TOML + CAMERA)
    depth = np.zeros((6, 8), dtype=np.uint16)
    depth[2, 5] = 500
    color = np.zeros((6, 8, 3), dtype=np.uint8)
    color[2, 5] = (0, 0, 255)  # blue, green, red
    for number in (0, 4):
        write_png(folder / "depth" / f"{number:06d}.png", depth)
        write_png(folder / "color" / f"{number:06d}.png", color)
    return folder


# What loads


def test_a_recording_has_what_its_files_say(tmp_path: Path) -> None:
    r = load_recording(write_small_recording(tmp_path, recording_toml=POSE_TOML + TOML + CAMERA))
    assert (r.actuation, r.actuation_zero, r.camera_names, r.cable_names) == ("tension", "absolute", ("",), ("top", "side"))
    np.testing.assert_array_equal(r.frame_numbers, [0, 1, 4])
    np.testing.assert_array_equal(r.time_s, [0, 0.5, 1])
    np.testing.assert_array_equal(r.inputs, [[0, 0], [1, 0.25], [2, 0.5]])
    assert r.pressures.shape == (3, 0) and r.free is None and r.sweep is None and r.gravity is None and r.rest is None
    assert r.marker_names == ("tip", "middle")
    np.testing.assert_array_equal(r.marker_frame, [0, 0, 1, 2])
    np.testing.assert_array_equal(r.marker_index, [0, 1, 0, 1])
    np.testing.assert_array_equal(r.marker_view, 0)
    np.testing.assert_array_equal(r.marker_xyz[2], [0.1, 0.01, 0.5])
    np.testing.assert_array_equal(r.T_robot_camera[0], POSE)
    camera = r.cameras[0]
    assert camera is not None and (camera.width, camera.height, camera.fx, camera.depth_unit) == (8, 6, 10.0, 0.001)
    np.testing.assert_array_equal(camera.distortion, np.zeros(5))
    assert r.has_markers and not r.has_clouds and r.frame_count == 3 and r.folder == tmp_path


def test_optional_columns_and_files(tmp_path: Path) -> None:
    r = load_recording(
        write_small_recording(
            tmp_path,
            frames_csv="frame,time_s,chamber_a,free,sweep,gravity_x_m_s2,gravity_y_m_s2,gravity_z_m_s2\n3,0,1e3,1,up,0,0,-9.81\n4,1,2e3,0,down,0,9.81,0\n",
            markers_csv=None,
            rest_csv="marker,x_m,y_m,z_m,std_m\ntip,0,0,0.5,1e-4\nmiddle,0,0,0.4,\n",
            loads_csv="frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n4,0.1,0,0,0,0,-1\n",
        )
    )
    assert r.cable_names == () and r.inputs.shape == (2, 0) and r.chamber_names == ("a",) and r.sweep == ("up", "down")
    np.testing.assert_array_equal(r.pressures, [[1e3], [2e3]])
    np.testing.assert_array_equal(r.free, [True, False])
    np.testing.assert_array_equal(r.gravity, [[0, 0, -9.81], [0, 9.81, 0]])
    assert r.rest is not None and r.rest.names == ("tip", "middle")
    np.testing.assert_array_equal(r.rest.std, [1e-4, np.nan])
    np.testing.assert_array_equal(r.load_frame, [1])
    np.testing.assert_array_equal(r.load_forces, [[0, 0, -1]])


def test_several_cameras(tmp_path: Path) -> None:
    cameras = CAMERA.replace("[camera]", "[cameras.left]") + POSE_TOML + "[cameras.right]\n"
    folder = write_small_recording(
        tmp_path,
        recording_toml=TOML + cameras,
        markers_csv="frame,camera,marker,x_m,y_m,z_m\n0,right,tip,0,0,1\n0,left,tip,0,0,2\n",
        rest_csv="marker,camera,x_m,y_m,z_m\ntip,right,0,0,1\n",
    )
    write_ply(folder / "clouds" / "right" / "000001.ply", np.array([[0.1, 0.2, 0.3]]))
    r = load_recording(folder)
    assert r.camera_names == ("left", "right") and r.cameras[0] is not None and r.cameras[1] is None
    assert r.T_robot_camera[1] is None
    np.testing.assert_array_equal(r.T_robot_camera[0], POSE)
    np.testing.assert_array_equal(r.marker_view, [1, 0])
    assert r.rest is not None and r.rest.view.tolist() == [1]
    assert [[f is not None for f in files] for files in r.cloud_files] == [[False, False], [False, True], [False, False]]
    np.testing.assert_array_equal(marker_grid(r, view=0)[0, 0], [0, 0, 2])
    cloud = read_frame_cloud(r, 1, view=1)
    assert cloud is not None
    np.testing.assert_allclose(cloud.points, [[0.1, 0.2, 0.3]])
    same_recording(r, load_recording(save_recording(r, tmp_path / "copy")))


def test_byte_order_mark_crlf_blanks_and_empty_lines(tmp_path: Path) -> None:
    plain = load_recording(write_small_recording(tmp_path / "plain"))
    windows = write_small_recording(tmp_path / "windows")
    for name, text in RECORDING_FILES.items():
        lines = text.replace("\n", "\r\n") + ("\r\n\r\n" if name.endswith("csv") else "")
        (windows / name).write_bytes(lines.replace(",tip,", " , tip , ").encode("utf-8-sig"))
    same_recording(plain, load_recording(windows))


def test_a_header_without_rows_is_no_marker(tmp_path: Path) -> None:
    r = load_recording(
        write_small_recording(tmp_path, markers_csv="frame,marker,x_m,y_m,z_m\n", loads_csv="frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n")
    )
    assert not r.has_markers and r.marker_names == () and r.load_points.shape == (0, 3)


# Clouds


def test_depth_and_colour_become_a_cloud(tmp_path: Path) -> None:
    r = load_recording(depth_recording(tmp_path))
    assert r.has_clouds and read_frame_cloud(r, 1) is None
    cloud = read_frame_cloud(r, 2)
    assert cloud is not None
    np.testing.assert_allclose(cloud.points, [[1.5 / 10 * 0.5, -0.5 / 10 * 0.5, 0.5]])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0]])


@pytest.mark.parametrize("name", ["4.ply", "000004.ply", "0004.PLY"])
def test_names_of_clouds(tmp_path: Path, name: str) -> None:
    folder = write_small_recording(tmp_path)
    write_ply(folder / "clouds" / name.lower(), np.eye(3))
    (folder / "clouds" / name.lower()).rename(folder / "clouds" / name)
    r = load_recording(folder)
    assert [files[0] is not None for files in r.cloud_files] == [False, False, True]


@pytest.mark.parametrize(
    ("cut", "text"),
    [
        (lambda data: data[:60], "a broken image"),
        (lambda data: b"", "a broken image"),
        (lambda data: data[:45] + b"\xff" + data[46:], "a broken image"),
    ],
)
def test_a_broken_depth_image_is_found_when_its_frame_is_read(tmp_path: Path, cut: Any, text: str) -> None:
    folder = depth_recording(tmp_path)
    file = folder / "depth" / "000000.png"
    file.write_bytes(cut(file.read_bytes()))
    r = load_recording(folder)
    with pytest.raises(InputError, match=text) as error:
        read_frame_cloud(r, 0)
    assert str(file) in str(error.value)
    assert read_frame_cloud(r, 2) is not None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float "
            b"z\nend_header\n\0\0"
        ),
        b"junk",
    ],
)
def test_a_broken_cloud_is_found_when_its_frame_is_read(tmp_path: Path, content: bytes) -> None:
    folder = write_small_recording(tmp_path)
    write_ply(folder / "clouds" / "000001.ply", np.eye(3))
    (folder / "clouds" / "000000.ply").write_bytes(content)
    r = load_recording(folder)
    with pytest.raises(InputError, match=r"000000\.ply"):
        read_frame_cloud(r, 0)
    cloud = read_frame_cloud(r, 1)
    assert cloud is not None and len(cloud) == 3


def test_depth_of_another_size_or_depth_is_an_error(tmp_path: Path) -> None:
    folder = depth_recording(tmp_path)
    write_png(folder / "depth" / "000000.png", np.ones((6, 9), dtype=np.uint16))
    with pytest.raises(InputError, match="another size than the camera table says") as error:
        load_recording(folder)
    assert "9 × 6" in str(error.value) and "8 × 6" in str(error.value)
    write_png(folder / "depth" / "000000.png", np.ones((6, 8), dtype=np.uint8))
    with pytest.raises(InputError, match="not a depth image") as error:
        load_recording(folder)
    assert "8 bits" in str(error.value)


def test_depth_without_a_camera_or_its_unit_is_an_error(tmp_path: Path) -> None:
    folder = depth_recording(tmp_path)
    (folder / "recording.toml").write_text(TOML)
    with pytest.raises(InputError, match="there are depth images, but no camera"):
        load_recording(folder)
    (folder / "recording.toml").write_text(TOML + CAMERA.replace("depth_unit_m = 0.001\n", ""))
    with pytest.raises(InputError, match=r"camera\.depth_unit_m: a required key is missing"):
        load_recording(folder)


@pytest.mark.parametrize(
    ("names", "text"), [(["1.ply", "000001.ply"], "two files for one frame"), (["frame_1.ply"], "the name is not a frame number")]
)
def test_names_that_are_no_frame(tmp_path: Path, names: list[str], text: str) -> None:
    folder = write_small_recording(tmp_path)
    for name in names:
        write_ply(folder / "clouds" / name, np.eye(3))
    with pytest.raises(InputError, match=text):
        load_recording(folder)


# What comes back


def test_round_trip_with_everything(tmp_path: Path) -> None:
    folder = depth_recording(tmp_path / "a")
    (folder / "frames.csv").write_text(
        "frame,time_s,cable_a,free,sweep\n0,0.1,0.30000000000000004,1,up\n1,0.2,1e-7,0,up\n4,0.30000000000000004,3,0,\n"
    )
    (folder / "loads.csv").write_text("frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n4,0.1,0,0,0,0,-1\n")
    (folder / "rest.csv").write_text("marker,x_m,y_m,z_m,std_m\ntip,0,0,0.5,1e-4\nmiddle,0,0,0.4,\n")
    first = load_recording(folder)
    save_recording(first, tmp_path / "b")
    second = load_recording(tmp_path / "b")
    same_recording(first, second)
    save_recording(second, tmp_path / "c")
    assert folder_hash(tmp_path / "b") == folder_hash(tmp_path / "c")
    assert (tmp_path / "b" / "depth" / "000004.png").read_bytes() == (folder / "depth" / "000004.png").read_bytes()


TOOLS = """
[[tools]]
name = "ball"
radius_m = 0.010

[[tools]]
name = "rod"
cylinder = { radius_m = 0.004, length_m = 0.15 }

[[tools]]
name = "block"
mesh = "a block.stl"
unit = "mm"
"""


def write_block_tool(folder: Path) -> None:
    import trimesh

    trimesh.creation.box(extents=(10.0, 20.0, 30.0)).export(folder / "a block.stl")


def test_noise_lens_model_tools_and_labels_come_back(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    lens = CAMERA + 'distortion = [0.1, 0.01, 0.0, 0.0]\ndistortion_model = "kannala_brandt"\n'
    noise = '[camera.noise]\nkind = "stereo"\nat_1m_m = 0.002\n'
    write_small_recording(folder, recording_toml=TOML + 'marker_noise_m = 0.0002\nsession = "A"\n' + lens + noise + TOOLS)
    write_block_tool(folder)
    r = load_recording(folder)
    camera = r.cameras[0]
    assert camera is not None and camera.noise is not None and camera.distortion_model == "kannala_brandt"
    np.testing.assert_allclose(camera.noise.std([1.0, 0.5]), [0.002, 0.0005], rtol=1e-12)
    np.testing.assert_array_equal(camera.distortion, [0.1, 0.01, 0.0, 0.0, 0.0])
    assert (r.marker_noise_m, r.session) == (0.0002, "A")
    assert [(t.name, t.kind, t.radius, t.length) for t in r.tools[:2]] == [
        ("ball", "ball", 0.01, 0.0),
        ("rod", "cylinder", 0.004, 0.15),
    ]
    np.testing.assert_allclose(np.ptp(r.tools[2].points, axis=0), [0.01, 0.02, 0.03], rtol=1e-6)
    assert r.tools[2].triangles.shape == (12, 3)
    save_recording(r, tmp_path / "b")
    same_recording(r, load_recording(tmp_path / "b"))
    save_recording(load_recording(tmp_path / "b"), tmp_path / "c")
    assert folder_hash(tmp_path / "b") == folder_hash(tmp_path / "c")


def test_a_tool_made_in_python_keeps_all_digits(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1 / 3, 0, 0], [0, 0.1, 0], [0, 0, 0.7]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    noise = CameraNoise("tof", floor=0.001, slope=0.002)
    camera = Camera("", 8, 6, 10.0, 10.0, 3.5, 2.5, np.zeros(5), 0.001, "inverse_brown_conrady", noise)
    r = make_recording(
        Timeline([0.0]),
        views=Views(cameras=[camera]),
        about=About(tools=[Tool("wedge", "mesh", points=points, triangles=triangles)], session="b"),
    )
    back = load_recording(save_recording(r, tmp_path / "a"))
    corners = lambda t: np.sort(t.points[t.triangles].reshape(-1, 9), axis=0)  # noqa: E731
    np.testing.assert_array_equal(corners(back.tools[0]), corners(r.tools[0]))
    assert back.cameras[0] is not None and back.cameras[0].noise is not None
    np.testing.assert_allclose(back.cameras[0].noise.std([0.0, 2.0]), [0.001, 0.005], rtol=1e-12)


def test_markers_without_names_come_back(tmp_path: Path) -> None:
    rows = "0,,0.1,0,0.5\n0,,0.2,0,0.5\n1,tip,0.1,0,0.5\n4,,0.3,0,0.5\n"
    r = load_recording(write_small_recording(tmp_path / "a", markers_csv="frame,marker,x_m,y_m,z_m\n" + rows))
    assert r.unnamed_frame.tolist() == [0, 0, 2] and r.marker_names == ("tip",) and r.marker_frame.tolist() == [1]
    np.testing.assert_array_equal(r.unnamed_xyz[:, 0], [0.1, 0.2, 0.3])
    same_recording(r, load_recording(save_recording(r, tmp_path / "b")))
    assert select_frames(r, [1, 2]).unnamed_frame.tolist() == [1]


def test_saving_over_its_own_folder(tmp_path: Path) -> None:
    first = load_recording(depth_recording(tmp_path / "a"))
    save_recording(first, tmp_path / "a")
    second = load_recording(tmp_path / "a")
    same_recording(first, second)
    assert read_frame_cloud(second, 0) is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


def test_saving_deletes_no_foreign_file(tmp_path: Path) -> None:
    r = load_recording(write_small_recording(tmp_path / "a"))
    for name in ("import.json", "notes.txt"):
        (tmp_path / "a" / name).write_text("mine")
        with pytest.raises(InputError, match=rf"would be deleted\n  found:    {name}"):
            save_recording(r, tmp_path / "a")
        assert (tmp_path / "a" / name).read_text() == "mine"
        (tmp_path / "a" / name).unlink()


def test_filling_writes_further_files_and_a_failure_leaves_nothing(tmp_path: Path) -> None:
    r = load_recording(write_small_recording(tmp_path / "a"))
    save_recording(r, tmp_path / "b", fill=lambda folder: write_ply(folder / "clouds" / "000004.ply", np.eye(3)))
    assert load_recording(tmp_path / "b").has_clouds

    def fail(folder: Path) -> None:
        raise RuntimeError

    with pytest.raises(RuntimeError):
        save_recording(r, tmp_path / "c", fill=fail)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


numbers = st.floats(-1.0, 1.0, allow_subnormal=True)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_recording_round_trips(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    r = data.draw(recordings())
    folder = tmp_path_factory.mktemp("r") / "x"
    same_recording(r, load_recording(save_recording(r, folder)))


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    F = draw(st.integers(1, 5))
    names = draw(
        st.lists(st.text("abcÄ-_ 1", min_size=1, max_size=4).map(lambda s: " ".join(f"m{s}".split())), unique=True, max_size=3)
    )
    seen = [(f, m) for f in range(F) for m in range(len(names)) if draw(st.booleans())]
    used = list(dict.fromkeys(m for _, m in seen))
    cables = draw(st.integers(0, 2))
    grid = lambda rows, columns: np.array([[draw(numbers) for _ in range(columns)] for _ in range(rows)]).reshape(rows, columns)  # noqa: E731
    places = grid(len(seen), 3)
    places[(places == places[:, :1]).all(axis=1)] = [0.0, 0.0, 1.0]  # one number three times is how a lost marker is written
    return make_recording(
        Timeline(
            np.cumsum([draw(st.floats(1e-3, 10.0)) for _ in range(F)]),
            frame_numbers=np.cumsum([draw(st.integers(1, 9)) for _ in range(F)]),
            free=draw(st.none() | st.lists(st.booleans(), min_size=F, max_size=F)),
            sweep=draw(st.none() | st.lists(st.sampled_from(["", "up", "a b"]), min_size=F, max_size=F)),
            gravity=draw(st.none() | st.just(grid(F, 3))),
        ),
        drives=Drives(
            actuation=draw(st.sampled_from(["tension", "displacement"])),
            actuation_zero=draw(st.sampled_from(["absolute", "unknown"])),
            cable_names=[f"c{j}" for j in range(cables)],
            inputs=grid(F, cables),
        ),
        markers=MarkerRows([names[m] for m in used], [f for f, _ in seen], [used.index(m) for _, m in seen], places),
        loads=LoadRows([0] * 2, grid(2, 3), grid(2, 3)),
    )


# Selections


def test_selecting_frames_takes_their_markers_and_loads_along(tmp_path: Path) -> None:
    r = load_recording(
        write_small_recording(tmp_path, loads_csv="frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n1,0,0,0,1,0,0\n4,0,0,0,2,0,0\n")
    )
    part = select_frames(r, [2, 0])
    np.testing.assert_array_equal(part.frame_numbers, [0, 4])
    np.testing.assert_array_equal(marker_grid(part), marker_grid(r)[[0, 2]])
    np.testing.assert_array_equal(part.load_frame, [1])
    np.testing.assert_array_equal(part.load_forces, [[2, 0, 0]])
    assert part.marker_names == r.marker_names and len(part.cloud_files) == 2
    same_recording(part, select_frames(r, np.array([True, False, True])))
    same_recording(r, select_frames(r, np.ones(3, dtype=bool)))


@pytest.mark.parametrize("which", [[3], [-1], np.array([True])])
def test_selecting_frames_that_do_not_exist(tmp_path: Path, which: Any) -> None:
    with pytest.raises(InputError, match=r"no such frame|wrong shape"):
        select_frames(load_recording(write_small_recording(tmp_path)), which)


def test_another_marker_table(tmp_path: Path) -> None:
    r = load_recording(write_small_recording(tmp_path))
    new = with_marker_table(r, ["a"], [0, 2], [0, 0], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(marker_grid(new)[:, 0], [[1, 2, 3], [np.nan] * 3, [4, 5, 6]])
    with pytest.raises(InputError, match="index out of range"):
        with_marker_table(r, ["a"], [0], [1], [[1, 2, 3]])


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"timeline": Timeline([0.0, 0.0])}, "time does not increase"),
        ({"timeline": Timeline([0.0, 1.0], [1, 1])}, "a frame occurs twice"),
        ({"drives": Drives(actuation="force")}, "unknown actuation"),
        ({"drives": Drives(inputs=[[1.0]])}, "inputs has the wrong shape"),
        ({"markers": MarkerRows([], [0], [0], [[0, 0, 0]])}, "marker_index out of range"),
        ({"timeline": Timeline([0.0, 1.0], sweep=["a"])}, "sweep has the wrong length"),
        ({"timeline": Timeline([0.0, 1.0], gravity=[[0, 0, np.nan]] * 2)}, "gravity must be finite"),
    ],
)
def test_parts_that_do_not_fit(parts: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        make_recording(**{"timeline": Timeline([0.0, 1.0]), **parts})


# Against a robot


@pytest.fixture
def robot(tmp_path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_robot(write_block_robot(tmp_path / "robot"))


def test_cables_are_put_in_the_order_of_the_robot(tmp_path: Path, robot: Any) -> None:
    r = load_recording(
        write_small_recording(tmp_path / "r", frames_csv="frame,time_s,cable_side,cable_top\n0,0,1,2\n1,1,3,4\n4,2,5,5\n")
    )
    fitted = check_against(robot, r)
    assert fitted.cable_names == ("top", "side")
    np.testing.assert_array_equal(fitted.inputs, [[2, 1], [4, 3], [5, 5]])
    same_recording(fitted, check_against(robot, fitted))


def test_a_recording_that_fits_is_not_warned_of(tmp_path: Path, robot: Any) -> None:
    r = load_recording(write_small_recording(tmp_path / "r"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same_recording(r, check_against(robot, r))


@pytest.mark.parametrize(
    ("header", "texts"),
    [
        ("cable_top", ["lacks side", "found:    cable_top\n", "expected: cable_top, cable_side"]),
        ("cable_top,cable_side,cable_low", ["has low, which the robot lacks", "--map low=cable_NAME"]),
        ("cable_top,cable_sides", ["lacks side and has sides", "did you mean 'side'?"]),
    ],
)
def test_other_cables(tmp_path: Path, robot: Any, header: str, texts: list[str]) -> None:
    cells = ",".join("1" for _ in header.split(","))
    r = load_recording(
        write_small_recording(tmp_path / "r", frames_csv=f"frame,time_s,{header}\n0,0,{cells}\n1,1,{cells}\n4,2,{cells}\n")
    )
    with pytest.raises(InputError, match="other cables than those of the robot 'block'") as error:
        check_against(robot, r)
    for text in texts:
        assert text in str(error.value)


def test_unknown_markers_are_left_out_with_a_warning(tmp_path: Path, robot: Any) -> None:
    r = load_recording(
        write_small_recording(
            tmp_path / "r",
            markers_csv="frame,marker,x_m,y_m,z_m\n0,ghost,0,0,9\n0,tip,0,0,1\n1,ghost,0,0,9\n4,middle,0,0,2\n",
            rest_csv="marker,x_m,y_m,z_m\nghost,0,0,1\ntip,0,0,2\n",
        )
    )
    with pytest.warns(UserWarning, match="left out: ghost"):
        fitted = check_against(robot, r)
    assert fitted.marker_names == ("tip", "middle") and fitted.rest is not None and fitted.rest.names == ("tip",)
    np.testing.assert_array_equal(fitted.marker_xyz[:, 2], [1, 2])
    np.testing.assert_array_equal(fitted.marker_index, [0, 1])
    np.testing.assert_array_equal(fitted.marker_frame, [0, 2])


def test_no_common_marker(tmp_path: Path, robot: Any) -> None:
    r = load_recording(write_small_recording(tmp_path / "r", markers_csv="frame,marker,x_m,y_m,z_m\n0,Tipp,0,0,1\n"))
    with pytest.raises(InputError, match="no marker that the robot 'block' has") as error:
        check_against(robot, r)
    assert "tip, middle, stalk" in str(error.value) and "did you mean 'tip'?" in str(error.value)


@pytest.mark.parametrize(("place", "hint"), [("100,15,30", "millimetres"), ("0.1,0.2,0.03", "robot frame")])
def test_a_load_far_from_the_body(tmp_path: Path, robot: Any, place: str, hint: str) -> None:
    r = load_recording(
        write_small_recording(tmp_path / "r", loads_csv=f"frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n0,0.1,0,0,0,0,1\n4,{place},0,0,1\n")
    )
    with pytest.raises(InputError, match="a known load is far from the body") as error:
        check_against(robot, r)
    assert hint in str(error.value) and "frame 4" in str(error.value)


@pytest.mark.parametrize(
    ("value", "text"), [("5.5", "cable 'top' reaches 5.5 N, more than its max_tension_n of 5 N"), ("-1", "goes down to -1 N")]
)
def test_inputs_beyond_the_limits_warn(tmp_path: Path, robot: Any, value: str, text: str) -> None:
    r = load_recording(
        write_small_recording(
            tmp_path / "r", frames_csv=f"frame,time_s,cable_top,cable_side\n0,0,0,0\n1,1,{value},900\n4,2,0,0\n"
        )
    )
    with pytest.warns(UserWarning, match=re.escape(text)):
        check_against(robot, r)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_against(robot, replace(r, actuation="displacement", inputs=1e-5 * np.abs(r.inputs)))


def test_colour_of_16_bits_or_as_jpeg_goes_with_its_depth(tmp_path: Path) -> None:
    import cv2

    image = np.zeros((6, 8, 3), dtype=np.uint16)
    image[:, :, 2] = 65535
    write_png(depth_recording(tmp_path / "a") / "color" / "000000.png", image)
    cloud = read_frame_cloud(load_recording(tmp_path / "a"), 0)
    assert cloud is not None and cloud.colors is not None
    np.testing.assert_array_equal(cloud.colors, np.tile([1.0, 0.0, 0.0], (len(cloud), 1)))
    folder = depth_recording(tmp_path / "b")
    for file in (folder / "color").glob("*"):
        file.unlink()
    assert cv2.imwrite(str(folder / "color" / "000000.jpg"), (image // 257).astype(np.uint8))
    cloud = read_frame_cloud(load_recording(folder), 0)
    assert cloud is not None and cloud.colors is not None
    np.testing.assert_allclose(cloud.colors, np.tile([1.0, 0.0, 0.0], (len(cloud), 1)), atol=0.02)
    whole = (folder / "color" / "000000.jpg").read_bytes()
    (folder / "color" / "000000.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="a broken image"):
        read_frame_cloud(load_recording(folder), 0)


def test_files_that_are_not_read_are_named(tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path)
    (folder / "clouds").mkdir()
    for name in ("000000.las", "000001.las", "000001.xyz", "notes.txt"):
        (folder / "clouds" / name).write_text("0 0 1\n")
    with pytest.warns(UserWarning, match=r"files that are not read: 2 × \.las"):
        r = load_recording(folder)
    cloud = read_frame_cloud(r, 1)
    assert cloud is not None and len(cloud) == 1


@pytest.mark.parametrize(
    ("frames", "actuation", "text"),
    [
        ("0,0,0,0\n1,33,1,0\n2,67,1,0\n", "tension", r"one frame every 33\.5 s .* milliseconds"),
        ("0,0,0,0\n1,1,2.0,0\n2,2,1,0\n", "displacement", "moves by up to 2 m; are displacements in millimetres"),
        ("0,0,0,0\n1,1,-0.01,0\n2,2,-0.02,0\n", "displacement", r"slack in 3 of 3 frames.* is the sign right\?"),
    ],
)
def test_values_that_are_hardly_meant(tmp_path: Path, frames: str, actuation: str, text: str) -> None:
    toml = TOML.replace("tension", actuation)
    r = load_recording(write_small_recording(tmp_path, recording_toml=toml, frames_csv=FRAMES + frames, markers_csv=None))
    with pytest.warns(UserWarning, match=text):
        warn_of(doubts_of_recording(r))


def test_a_cable_is_not_shortened_by_more_than_its_length(tmp_path: Path, robot: Any) -> None:
    toml, frames = TOML.replace("tension", "displacement"), FRAMES + "0,0,0,0\n1,1,2.0,0\n"
    r = load_recording(write_small_recording(tmp_path / "r", recording_toml=toml, frames_csv=frames, markers_csv=None))
    with pytest.raises(InputError, match="shortened by more than its length") as error:
        check_against(robot, r)
    assert "2 m" in str(error.value) and "millimetres" in str(error.value)


# What is wrong

FRAMES = "frame,time_s,cable_top,cable_side\n"
MARKERS = "frame,marker,x_m,y_m,z_m\n"
BAD: list[tuple[dict[str, str | None], str, list[str]]] = [
    ({"recording_toml": None}, "", ["recording.toml is missing", "femsense import"]),
    ({"frames_csv": None}, "frames.csv", ["frames.csv is missing", "frame,time_s,cable_<name>"]),
    (
        {"recording_toml": TOML.replace("tension", "force")},
        "recording.toml: actuation",
        ["'force'", '"tension"', '"displacement"'],
    ),
    (
        {"recording_toml": 'format = "femsense-recording-1"\nactuation = "tension"\n'},
        "recording.toml: actuation_zero",
        ["a required key is missing"],
    ),
    ({"recording_toml": TOML + "camra = 1\n"}, "recording.toml: camra", ["unknown key", "did you mean 'camera'"]),
    ({"recording_toml": TOML + CAMERA.replace("fx = 10.0\n", "")}, "recording.toml: camera", ["the camera lacks fx"]),
    (
        {"recording_toml": TOML + CAMERA.replace("fx = 10.0", "fx = -1")},
        "recording.toml: camera.fx",
        ["greater than 0", "pixels"],
    ),
    (
        {"recording_toml": TOML + CAMERA.replace("width = 8", "width = 8.5")},
        "recording.toml: camera.width",
        ["valid integer", "8.5"],
    ),
    ({"recording_toml": TOML + "[camera]\n"}, "recording.toml: camera", ["the camera lacks its lens"]),
    ({"recording_toml": TOML + CAMERA + "[cameras.a]\n"}, "recording.toml", ["both [camera] and [cameras.NAME]"]),
    ({"recording_toml": POSE_TOML.replace("1.0", "2.0") + TOML}, "recording.toml: T_robot_camera", ["not a rigid transform"]),
    (
        {"recording_toml": "T_robot_camera = [[1, 0, 0, 0]]\n" + TOML},
        "recording.toml: T_robot_camera",
        ["should have at least 4 items, not 1"],
    ),
    ({"recording_toml": POSE_TOML + TOML + "[cameras.a]\n"}, "recording.toml: T_robot_camera", ["one pose for several cameras"]),
    (
        {"recording_toml": POSE_TOML + TOML + CAMERA + POSE_TOML},
        "recording.toml: camera.T_robot_camera",
        ["the pose is given twice"],
    ),
    ({"recording_toml": TOML + '[cameras."../a"]\n'}, "recording.toml: cameras", ["not a name for a camera", "'../a'"]),
    ({"recording_toml": TOML + "x = = 1\n"}, "recording.toml", ["not valid TOML", "line 4"]),
    ({"frames_csv": FRAMES}, "frames.csv", ["no frames"]),
    ({"frames_csv": ""}, "frames.csv", ["the file is empty", "frame,time_s"]),
    ({"frames_csv": FRAMES + "0,0,1,zwei\n"}, "frames.csv, line 2, column cable_side", ["not a number", "zwei"]),
    ({"frames_csv": FRAMES + "0,0,1,\n"}, "frames.csv, line 2, column cable_side", ["not a number", "an empty cell"]),
    ({"frames_csv": FRAMES + "0,0,1,nan\n"}, "frames.csv, line 2, column cable_side", ["not a finite number"]),
    ({"frames_csv": FRAMES + "0,0,1,1\n\n1,1,1,inf\n"}, "frames.csv, line 4, column cable_side", ["not a finite number"]),
    (
        {"frames_csv": FRAMES + '0,"0,5",1,1\n'},
        "frames.csv, line 2, column time_s",
        ["not a number", "decimal points, not commas"],
    ),
    (
        {"frames_csv": FRAMES + "0,0,5,1,1\n"},
        "frames.csv, line 2",
        ["another length than the header", "5 cells", "decimal points"],
    ),
    (
        {"frames_csv": FRAMES + "0,0,1,1\n1,0,1,1\n"},
        "frames.csv, line 3, column time_s",
        ["time does not increase", "0 s after 0 s"],
    ),
    ({"frames_csv": FRAMES + "0,0,1,1\n0,1,1,1\n"}, "frames.csv, line 3, column frame", ["a frame occurs twice", "line 2"]),
    ({"frames_csv": FRAMES + "0.5,0,1,1\n"}, "frames.csv, line 2, column frame", ["not a whole number", "0.5"]),
    ({"frames_csv": FRAMES + "-1,0,1,1\n"}, "frames.csv, line 2, column frame", ["not a whole number ≥ 0"]),
    ({"frames_csv": "frame,cable_top\n0,0\n"}, "frames.csv, header", ["columns are missing", "time_s"]),
    ({"frames_csv": "frame,time_s,cable_top,fre\n0,0,0,1\n"}, "frames.csv, header", ["unknown column", "'fre'", "'free'"]),
    ({"frames_csv": "frame,time_s,cable_\n0,0,0\n"}, "frames.csv, header", ["unknown column", "'cable_'"]),
    ({"frames_csv": "frame,time_s,cable_a,cable_a\n0,0,0,0\n"}, "frames.csv, header", ["a column occurs twice", "cable_a"]),
    ({"frames_csv": "frame;time_s;cable_a\n0;0,5;1\n"}, "frames.csv, header", ["semicolons or tabs", "commas between the cells"]),
    ({"frames_csv": "frame,time_s,free\n0,0,1\n1,1,yes\n"}, "frames.csv, line 3, column free", ["neither 0 nor 1", "yes"]),
    ({"frames_csv": "frame,time_s,gravity_x_m_s2\n0,0,1\n"}, "frames.csv, header", ["gravity needs its three columns"]),
    (
        {"recording_toml": TOML.replace("tension", "displacement"), "frames_csv": FRAMES + "0,0,0,25\n"},
        "frames.csv, line 2, column cable_side",
        ["looks like millimetres", "25 m"],
    ),
    (
        {"markers_csv": MARKERS + "2,tip,0,0,0\n"},
        "markers.csv, line 2, column frame",
        ["a frame that frames.csv does not have", "2", "(0 … 4)"],
    ),
    (
        {"markers_csv": MARKERS + "0,tip,0,0,1\n0,,0,0,2\n"},
        "markers.csv, line 3, column marker",
        ["named and unnamed markers in one frame", "frame 0"],
    ),
    ({"rest_csv": "marker,x_m,y_m,z_m\n,0,0,0\n"}, "rest.csv, line 2, column marker", ["a marker without a name"]),
    (
        {"recording_toml": TOML + CAMERA + '[camera.noise]\nkind = "stereo"\nfloor_m = 0.1\n'},
        "recording.toml: camera.noise",
        ['"stereo" has at_1m_m'],
    ),
    (
        {"recording_toml": TOML + CAMERA + '[camera.noise]\nkind = "radar"\n'},
        "recording.toml: camera.noise.kind",
        ["radar", "tof"],
    ),
    (
        {"recording_toml": TOML + CAMERA + 'distortion_model = "brown"\n'},
        "recording.toml: camera.distortion_model",
        ["'brown'", "kannala_brandt"],
    ),
    (
        {"recording_toml": TOML + CAMERA + 'distortion = [1, 0, 0, 0, 1]\ndistortion_model = "kannala_brandt"\n'},
        "recording.toml: camera",
        ["kannala_brandt has four numbers"],
    ),
    ({"recording_toml": TOML + CAMERA + "distortion = [1, 0, 0, 0, 1, 2]\n"}, "recording.toml: camera", ["6 numbers"]),
    ({"recording_toml": TOML + '[[tools]]\nname = "a"\n'}, "recording.toml: tools[0]", ["a tool is a ball with radius_m"]),
    (
        {"recording_toml": TOML + '[[tools]]\nname = "a"\nmesh = "rod.stl"\n'},
        "recording.toml: tools[0]",
        ["a mesh with its unit"],
    ),
    (
        {"recording_toml": TOML + '[[tools]]\nname = "a"\nmesh = "rod.stl"\nunit = "mm"\n'},
        "recording.toml: tools[0].mesh",
        ["no such mesh file"],
    ),
    (
        {"recording_toml": TOML + '[[tools]]\nname = "a"\nradius_m = 0.01\n' * 2},
        "recording.toml: tools[1].name",
        ["a name occurs twice"],
    ),
    ({"recording_toml": TOML + "marker_noise_m = 0\n"}, "recording.toml: marker_noise_m", ["greater than 0"]),
    (
        {"markers_csv": MARKERS + "0,tip,0,0,1\n0,tip,0,0,2\n"},
        "markers.csv, line 3",
        ["a marker occurs twice in one frame", "frame 0, marker 'tip'"],
    ),
    (
        {"markers_csv": MARKERS + "0,tip,105.2,33,512\n1,tip,100,30,511\n"},
        "markers.csv, line 2",
        ["look like millimetres", "divide x, y and z by 1000"],
    ),
    (
        {"markers_csv": MARKERS + "".join(f"0,m{i},0,0,1\n" for i in range(9)) + "0,m9,0,0,1e6\n"},
        "markers.csv, line 11",
        ["not plausible", "leave the row out"],
    ),
    (
        {"markers_csv": MARKERS + "0,tip,nan,nan,nan\n"},
        "markers.csv, line 2, column x_m",
        ["not a finite number", "leave the row out"],
    ),
    ({"markers_csv": "frame,name,x_m,y_m,z_m\n"}, "markers.csv, header", ["unknown column", "'name'"]),
    ({"markers_csv": "frame,marker,x_mm,y_mm,z_mm\n"}, "markers.csv, header", ["unknown column", "did you mean 'x_m'"]),
    (
        {"markers_csv": "frame,marker,camera,x_m,y_m,z_m\n0,tip,left,0,0,0\n"},
        "markers.csv, line 2, column camera",
        ["a camera that recording.toml does not have", "left"],
    ),
    (
        {"recording_toml": TOML + "[cameras.left]\n[cameras.right]\n"},
        "markers.csv, header",
        ["which camera saw these markers?", "left, right"],
    ),
    (
        {"rest_csv": "marker,x_m,y_m,z_m\ntip,0,0,0\ntip,0,0,1\n"},
        "rest.csv, line 3, column marker",
        ["a marker occurs twice", "tip"],
    ),
    ({"rest_csv": "marker,x_m,y_m,z_m,std_m\ntip,0,0,0,-1\n"}, "rest.csv, line 2, column std_m", ["below zero"]),
    ({"rest_csv": "marker,x_m,y_m,z_m\ntip,0,0,400\n"}, "rest.csv, line 2", ["look like millimetres"]),
    ({"loads_csv": "frame,x_m,y_m,z_m,fx_n,fy_n\n"}, "loads.csv, header", ["columns are missing", "fz_n"]),
    (
        {"loads_csv": "frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n7,0,0,0,0,0,0\n"},
        "loads.csv, line 2, column frame",
        ["a frame that frames.csv does not have", "7"],
    ),
]


@pytest.mark.parametrize(("files", "place", "texts"), BAD, ids=[f"{i}-{texts[0]}" for i, (_, _, texts) in enumerate(BAD)])
def test_one_clear_error(tmp_path: Path, files: dict[str, str | None], place: str, texts: list[str]) -> None:
    with pytest.raises(InputError) as error:
        load_recording(write_small_recording(tmp_path, **files))
    message = str(error.value)
    assert message.splitlines()[0].startswith(f"{tmp_path / place if place else tmp_path}: ")
    for text in texts:
        assert text in message


@pytest.mark.parametrize(("rows", "status"), [("0,tip,105.2,33,512\n1,tip,100,30,511\n", 1), ("0,tip,0,0,1,2\n", 2)])
def test_another_unit_ends_as_data_that_allow_no_result(tmp_path: Path, rows: str, status: int) -> None:
    with pytest.raises(InputError) as error:
        load_recording(write_small_recording(tmp_path, markers_csv=MARKERS + rows))
    assert error.value.exit_status == status


def test_no_such_recording(tmp_path: Path) -> None:
    write_small_recording(tmp_path / "push")
    with pytest.raises(InputError, match="no such recording") as error:
        load_recording(tmp_path / "pusch")
    assert "did you mean 'push'?" in str(error.value)


@settings(max_examples=60, deadline=None)
@given(
    text=st.text("0123456789.,-\n\r;\"'eframtismx_ \tnaé\0", max_size=120),
    name=st.sampled_from(["frames.csv", "markers.csv", "recording.toml", "rest.csv", "loads.csv"]),
)
def test_whatever_stands_in_a_file_only_input_errors_come_out(
    tmp_path_factory: pytest.TempPathFactory, text: str, name: str
) -> None:
    folder = write_small_recording(tmp_path_factory.mktemp("r"))
    (folder / name).write_text(text, encoding="utf-8", newline="")
    with contextlib.suppress(InputError):
        load_recording(folder)


# Real recordings

real = pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the repository")


@real
@pytest.mark.parametrize("name", ["gravity_a", "load52_a", "load101_a", "all_a"])
def test_real_beam_recordings(tmp_path: Path, name: str) -> None:
    r = load_recording(DATA / "beam" / "recordings" / name)
    frames = 15 if name == "all_a" else 5
    assert r.frame_count == frames and len(r.marker_names) == 6 and len(r.marker_frame) == 6 * frames
    assert (r.rest is not None) == (name != "all_a")
    total = {"gravity_a": 0.0, "load52_a": 0.51012, "load101_a": 1.00062}.get(name)
    if total is not None:
        np.testing.assert_allclose(r.load_forces[:, 2].sum() / frames, -total, atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same_recording(r, check_against(load_robot(DATA / "beam" / "robot"), r))
    same_recording(r, load_recording(save_recording(r, tmp_path / "copy")))


@real
def test_the_real_depth_frame() -> None:
    r = load_recording(DATA / "hammer" / "recording")
    assert r.frame_count == 1 and r.free is not None and r.free.all() and r.T_robot_camera == (None,)
    cloud = read_frame_cloud(r, 0)
    assert cloud is not None and len(cloud) == 290289 and cloud.colors is None
    assert 0.2 < cloud.points[:, 2].min() < cloud.points[:, 2].max() < 0.7


def test_a_camera_may_have_a_pose_and_no_lens(tmp_path: Path) -> None:
    pose = "T_robot_camera = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    r = load_recording(write_small_recording(tmp_path / "a", recording_toml=f"{TOML}[camera]\n{pose}"))
    assert r.cameras == (None,) and r.T_robot_camera[0] is not None and r.T_robot_camera[0][0, 3] == 0.1
    with pytest.raises(InputError, match="the camera lacks width"):
        load_recording(write_small_recording(tmp_path / "b", recording_toml=f"{TOML}[camera]\n{pose}depth_unit_m = 0.001\n"))
