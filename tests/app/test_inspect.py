"""What inspect says of files and folders, good and bad; it never raises for what stands in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from helpers import DATA, RECORDING_FILES, block_mesh, block_surface, write_block_robot, write_small_recording
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.app.inspect import describe, inspect_path
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh
from femsense.io.importers.guess import open_source
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot, robot_names

TOML = RECORDING_FILES["recording.toml"]


def inspect(path: Path) -> dict[str, Any]:
    """Return the report after checking what holds for each: it is JSON, and its text names the path and every problem."""
    report = inspect_path(path)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    text = describe(report)
    assert text.startswith(str(path)) and "None" not in text and "nan" not in text
    for problem in [*report["problems"], *report["warnings"]]:
        assert problem.splitlines()[0] in text
    return report


# Robots


def test_a_robot(tmp_path: Path) -> None:
    report = inspect(write_block_robot(tmp_path, mesh__element="tet10"))
    assert report["kind"] == "robot" and report["name"] == "block" and report["problems"] == [] and report["warnings"] == []
    mesh = report["mesh"]
    assert (mesh["element"], mesh["unit"], mesh["tetrahedra"], mesh["nodes"]) == ("tet10", "mm", 96, 225)
    np.testing.assert_allclose(mesh["size_mm"], [100, 30, 30])
    np.testing.assert_allclose([mesh["volume_cm3"], report["mass_g"]], [90, 96.3])
    assert 0 < mesh["radius_ratio_min"] <= mesh["radius_ratio_median"] <= 1 and report["clamped_nodes"] == 25
    top, side = report["cables"]
    np.testing.assert_allclose(top["length_mm"], 50 + np.hypot(50, 10))
    np.testing.assert_allclose(top["bends_deg"], np.degrees(np.arctan2(10, 50)))
    assert side["max_tension_n"] is None and top["max_tension_n"] == 5.0
    np.testing.assert_allclose([marker["outside_mm"] for marker in report["markers"]], [0, 0, 20], atol=1e-6)


def test_a_robot_that_lacks_or_guesses_something_is_not_said_to_be_right(tmp_path: Path) -> None:
    whole = write_block_robot(tmp_path / "whole", mesh__element="tet10")
    assert describe(inspect(whole)).endswith("nothing is wrong with it")
    bare = write_block_robot(tmp_path / "bare", cables=[], markers=[])
    report = inspect(bare)
    assert any("neither [[cables]] nor [[chambers]]" in text for text in report["warnings"])
    assert any("no [[markers]]" in text for text in report["warnings"]) and report["problems"] == []
    assert "nothing is wrong" not in describe(report)
    toml = whole / "robot.toml"
    toml.write_text(
        toml.read_text(encoding="utf-8").replace("[[fixed]]", "# GUESSED: the lowest slab.\n[[fixed]]"), encoding="utf-8"
    )
    (text,) = inspect(whole)["warnings"]
    assert "still marked GUESSED: fixed" in text


@pytest.mark.parametrize(
    ("name", "tool"), [("take.svo2", "svo_export.py"), ("take.zdf", "Zivid Studio"), ("take.mp4", "no depth")]
)
def test_captures_of_other_programs_say_how_they_are_exported(name: str, tool: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\x00\x01")
    assert tool in inspect(tmp_path / name)["problems"][0]
    with pytest.raises(InputError, match=tool):
        open_source(tmp_path / name)


def test_all_problems_of_the_tables_are_named_with_the_texts_of_the_errors(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, material__young_modulus=1, mesh__unit="inch", cables__0__pull_point_m=None)
    report = inspect(folder)
    assert len(report["problems"]) == 3
    with pytest.raises(InputError) as error:
        load_robot(folder)
    assert report["problems"][0] == str(error.value)
    assert "mesh.unit" in report["problems"][1] and "cables[0].pull_point_m" in report["problems"][2]


def test_a_robot_that_does_not_load_still_shows_its_mesh(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, fixed=[{"box_m": [[1, 1, 1], [2, 2, 2]]}])
    report = inspect(folder)
    with pytest.raises(InputError) as error:
        load_robot(folder)
    assert report["problems"] == [str(error.value)] and report["mesh"]["tetrahedra"] == 96


def test_warnings_of_a_robot_are_in_the_report(tmp_path: Path) -> None:
    report = inspect(write_block_robot(tmp_path, cables__0__path_m=[[0.1, 0.015, 0.031]], material__young_modulus_pa=150.0))
    assert report["problems"] == []
    said = ["outside the mesh, up to 1 mm", "softer than any silicone", "linear tetrahedra make this body too stiff"]
    assert [any(words in text for text in report["warnings"]) for words in said] == [True] * 3 and len(report["warnings"]) == 3


# Meshes and surfaces


def test_a_mesh_file(tmp_path: Path) -> None:
    report = inspect(write_block_robot(tmp_path) / "block.vtu")
    assert report["kind"] == "mesh" and report["tetrahedra"] == 96 and report["problems"] == []
    np.testing.assert_allclose(report["size"], [100, 30, 30])
    assert "in the unit of the file" in describe(report)


def test_a_bad_mesh_file(tmp_path: Path) -> None:
    mesh = block_mesh()
    tets = mesh.tets.copy()
    tets[0] = tets[0][[1, 0, 2, 3]]
    report = inspect(write_block_robot(tmp_path, block=TetMesh(mesh.nodes, tets)) / "block.vtu")
    assert report["tetrahedra"] == 96 and "inverted tetrahedra" in report["problems"][0]


@pytest.mark.parametrize("name", ["box.stl", "box.ply", "box.vtu"])
def test_a_surface(tmp_path: Path, name: str) -> None:
    points, triangles = block_surface()
    meshio.Mesh(points, [("triangle", triangles)]).write(tmp_path / name)
    report = inspect(tmp_path / name)
    assert (report["kind"], report["points"], report["triangles"], report["problems"]) == ("surface", 8, 12, [])
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]
    meshio.Mesh(points, [("triangle", triangles[1:])]).write(tmp_path / name)
    assert "the surface is not closed" in inspect(tmp_path / name)["problems"][0]


# Recordings


def test_a_recording(tmp_path: Path) -> None:
    report = inspect(
        write_small_recording(tmp_path, loads_csv="frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n4,0,0,0,3,0,0\n4,0,0,0,0,4,0\n")
    )
    assert (report["kind"], report["frames"], report["duration_s"], report["rate_hz"]) == ("recording", 3, 1.0, 2.0)
    assert report["cables"] == [{"name": "top", "min_n": 0.0, "max_n": 2.0}, {"name": "side", "min_n": 0.0, "max_n": 0.5}]
    markers = report["markers"]
    assert (markers["visible_per_frame_min"], markers["visible_per_frame_max"]) == (1, 2)
    np.testing.assert_allclose(markers["hidden_share"], 2 / 6)
    assert markers["each"] == [{"name": "tip", "frames": 2}, {"name": "middle", "frames": 2}]
    assert report["loads"] == {"rows": 2, "frames": 1, "largest_total_n": 5.0} and report["problems"] == []
    assert "33.3 %" in describe(report)


@pytest.mark.parametrize(
    "files",
    [
        {"frames_csv": None},
        {"frames_csv": "frame;time_s\n0;0\n"},
        {"markers_csv": "frame,marker,x_m,y_m,z_m\n0,tip,100,200,900\n"},
        {"recording_toml": TOML + "x = 1\n"},
    ],
)
def test_a_bad_recording_has_the_text_of_the_error(tmp_path: Path, files: dict[str, str | None]) -> None:
    folder = write_small_recording(tmp_path, **files)
    with pytest.raises(InputError) as error:
        load_recording(folder)
    assert inspect(folder)["problems"] == [str(error.value)]
    assert inspect(folder / "recording.toml")["problems"] == [str(error.value)]


def test_a_recording_without_recording_toml_is_still_a_recording(tmp_path: Path) -> None:
    report = inspect(write_small_recording(tmp_path, recording_toml=None))
    assert report["kind"] == "recording" and "recording.toml is missing" in report["problems"][0]


def test_nothing_measured_outliers_and_gaps(tmp_path: Path) -> None:
    frames = "frame,time_s\n" + "".join(f"{k},{k if k < 5 else k + 90}\n" for k in range(9))
    folder = write_small_recording(tmp_path, markers_csv=None, frames_csv=frames)
    (folder / "clouds").mkdir()
    (folder / "clouds" / "000077.ply").write_text("ply\n")
    report = inspect(folder)
    assert "neither markers nor clouds" in report["problems"][0]
    assert any("gaps in time" in text and "before frame 5" in text for text in report["warnings"])
    assert any("number is not in frames.csv, the first is 77" in text for text in report["warnings"])


def test_broken_clouds_are_named_and_the_others_counted(tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path)
    (folder / "clouds").mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    (folder / "clouds" / "000000.ply").write_text(header + "0 0 1\n0 1 1\n")
    (folder / "clouds" / "000001.ply").write_text("")
    report = inspect(folder)
    assert report["clouds"] == {"frames_with_cloud": 2, "frames_without_cloud": 1, "read": 1, "points_median": 2.0}
    assert len(report["problems"]) == 1 and "000001.ply" in report["problems"][0]


# Clouds, images, results


def test_a_cloud_and_its_units(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    file.write_text(header + "0 0 0.3\n0.1 0 0.3\n")
    report = inspect(file)
    assert report["kind"] == "cloud" and report["points"] == 2 and report["problems"] == []
    np.testing.assert_allclose(report["high_mm"], [100, 0, 300], atol=1e-3)
    file.write_text(header + "0 0 300\n100 0 300\n")
    assert "look like millimetres" in inspect(file)["problems"][0]


def test_images(tmp_path: Path) -> None:
    import cv2

    depth = np.zeros((6, 8), dtype=np.uint16)
    depth[0, :4] = [10, 20, 30, 40]
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    report = inspect(tmp_path / "d.png")
    assert (report["kind"], report["content"], report["width"], report["depth_min"], report["depth_max"]) == (
        "image",
        "depth",
        8,
        10,
        40,
    )
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((6, 8, 3), dtype=np.uint8))
    assert inspect(tmp_path / "c.png")["content"] == "colour"
    (tmp_path / "d.png").write_bytes((tmp_path / "d.png").read_bytes()[:40])
    assert "a broken image" in inspect(tmp_path / "d.png")["problems"][0]


def test_a_calibration(tmp_path: Path) -> None:
    data = {
        "format": "femsense-calibration-1",
        "T_robot_camera": np.eye(4).tolist(),
        "rms_m": 1e-3,
        "status": "converged",
        "cable_tension_n": {"top": 0.5},
        "cable_displacement_m": {},
        "marker_rms_m": {},
        "history": [{"iteration": 0, "rms_m": 1e-2}],
        "std": {},
    }
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(data))
    report = inspect(file)
    assert (report["kind"], report["rms_m"], report["iterations"], report["problems"]) == ("calibration", 1e-3, 1, [])
    for key, value, said in (
        ("format", "x", "another kind of file"),
        ("T_robot_camera", np.diag([2.0, 1, 1, 1]).tolist(), "not a rigid transform"),
        ("marker_rms_m", 1, "not a table"),
    ):
        file.write_text(json.dumps({**data, key: value}))
        (problem,) = inspect(file)["problems"]
        assert said in problem


def test_a_loop_with_its_robot(tmp_path: Path) -> None:
    write_block_robot(tmp_path)
    data = {
        "format": "femsense-loop-1",
        "verdict": "effects",
        "before": {"train_rms_m": 2e-3},
        "after": {"train_rms_m": 1e-4},
        "effects": [{"name": "gravity"}],
    }
    (tmp_path / "loop.json").write_text(json.dumps(data))
    report = inspect(tmp_path)
    assert (report["kind"], report["verdict"], report["effects"], report["robot"]["name"]) == (
        "loop",
        "effects",
        ["gravity"],
        "block",
    )
    assert report["problems"] == []
    del data["verdict"]
    (tmp_path / "loop.json").write_text(json.dumps(data))
    assert "expected: verdict" in inspect(tmp_path / "loop.json")["problems"][0]
    (tmp_path / "loop.json").write_text(json.dumps({**data, "verdict": "effects", "noise_m": "little"}))
    assert "noise_m" in inspect(tmp_path / "loop.json")["problems"][0]


def test_a_run_and_what_it_lacks(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"femsense": "0.1.0"}))
    (tmp_path / "frames.csv").write_text("frame,time_s,status\n0,0,converged\n1,1,converged\n2,2,failed\n")
    (tmp_path / "contacts.csv").write_text("frame,force_n\n0,0.5\n1,1.5\n")
    report = inspect(tmp_path)
    assert report["kind"] == "run" and report["frames"]["status"] == {"converged": 2, "failed": 1}
    assert report["contacts"]["largest_force_n"] == 1.5 and "states.npz" in report["problems"][0]
    np.savez(tmp_path / "states.npz", nodes_m=np.zeros((3, 5, 3), dtype=np.float32))
    report = inspect(tmp_path)
    assert report["states"] == {"nodes_m": "3 × 5 × 3"} and report["problems"] == []


def test_a_script(tmp_path: Path) -> None:
    text = (robot_names()["four-leg"] / "demo_script.toml").read_text(encoding="utf-8")
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    report = inspect(tmp_path / "plan.toml")
    assert report["kind"] == "script" and report["frames"] == 44 and report["effects"] == ["cable_friction", "stiffness"]
    assert report["sweeps"][0] == {"label": "north", "frames": 7, "drives": "north"} and not report["problems"]
    (tmp_path / "plan.toml").write_text(text.replace("eye_m", "eye"), encoding="utf-8")
    assert "camera.eye" in inspect(tmp_path / "plan.toml")["problems"][0]


# Whatever else


def test_nothing_at_a_path_is_the_only_error(tmp_path: Path) -> None:
    write_small_recording(tmp_path / "push")
    with pytest.raises(InputError, match="nothing there") as error:
        inspect_path(tmp_path / "pus")
    assert "did you mean 'push'?" in str(error.value)


def test_what_is_not_known(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_text("x")
    assert inspect(tmp_path / "a.dat")["kind"] == "unknown"
    report = inspect(tmp_path)
    assert report["kind"] == "unknown" and "femsense import" in report["problems"][0]


NAMES = [
    "robot.toml",
    "recording.toml",
    "a.toml",
    "a.ply",
    "a.pcd",
    "a.stl",
    "a.obj",
    "a.vtu",
    "a.vtk",
    "a.msh",
    "a.png",
    "a.json",
    "calibration.json",
    "loop.json",
    "run.json",
    "a.csv",
    "a.bag",
    "frames.csv",
    "contacts.csv",
    "states.npz",
    "a",
]


@settings(max_examples=60, deadline=None)
@given(
    content=st.binary(max_size=60)
    | st.sampled_from(
        [b"{", b"[]", b"{}", b"ply\nelement face 3\nend_header\n", b"# vtk DataFile", b"solid\nendsolid\n", b"\x89PNG\r\n\x1a\n"]
    ),
    name=st.sampled_from(NAMES),
)
def test_no_content_makes_it_raise(tmp_path_factory: pytest.TempPathFactory, content: bytes, name: str) -> None:
    folder = tmp_path_factory.mktemp("x")
    (folder / name).write_bytes(content)
    for path in (folder / name, folder):
        describe(inspect_path(path))


# Real data

real = pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the repository")

REAL: dict[str, tuple[str, dict[str, Any]]] = {
    "diamond": ("robot", {"name": "diamond", "clamped_nodes": 58, "features": 51}),
    "finger": ("robot", {"name": "finger", "clamped_nodes": 20}),
    "beam/robot": ("robot", {"name": "silicone-beam", "clamped_nodes": 169, "gravity_m_s2": [0, 0, 0]}),
    "beam/robot_gravity": ("robot", {"gravity_m_s2": [0, 0, -9.80709]}),
    "hammer/robot": ("robot", {"name": "hammer-moldstar", "color_rgb": [0.05, 0.45, 0.65]}),
    "beam/recordings/load52_a": ("recording", {"frames": 5, "free_frames": 0, "rest_markers": 6}),
    "beam/recordings/all_a": ("recording", {"frames": 15, "free_frames": 5, "rest_markers": None}),
    "hammer/recording": ("recording", {"frames": 1, "markers": None}),
    "hammer/recording/depth/000000.png": ("image", {"width": 1024, "height": 768, "content": "depth"}),
    "kinect/mOSD_test31.pcd": ("cloud", {"points": 170909, "colors": True}),
    "diamond/diamond.vtu": ("mesh", {"nodes": 1628, "tetrahedra": 4147}),
}


@real
@pytest.mark.parametrize("place", REAL)
def test_real_files_and_folders(place: str) -> None:
    kind, values = REAL[place]
    report = inspect(DATA / place)
    assert report["kind"] == kind and report["problems"] == []
    assert {key: report[key] for key in values} == values


@real
def test_the_real_finger_weighs_what_its_readme_says() -> None:
    np.testing.assert_allclose(inspect(DATA / "finger")["mass_g"], 75.0, rtol=1e-3)


@real
def test_the_real_diamond_warns_of_its_cables() -> None:
    report = inspect(DATA / "diamond")
    assert sum("nearest centre" in text for text in report["warnings"]) == 4
    np.testing.assert_allclose([c["outside_mm"] for c in report["cables"]], [0.0011, 0.317, 0.172, 0.267], atol=1e-3)


# What cannot be meant


def cloud_recording(folder: Path, factor: float, *, count: int = 30, markers: bool = True) -> Path:
    """Write a recording with clouds half a metre away, in metres times a factor."""
    rng = np.random.default_rng(2)
    write_small_recording(folder, **({} if markers else {"markers_csv": None}))
    (folder / "clouds").mkdir()
    for number in (0, 1, 4):
        points = factor * (rng.normal(scale=0.05, size=(count, 3)) + np.array([0.0, 0.0, 0.5]))
        header = f"ply\nformat ascii 1.0\nelement vertex {count}\n" + "".join(f"property double {c}\n" for c in "xyz")
        rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
        (folder / "clouds" / f"{number:06d}.ply").write_text(header + "end_header\n" + rows)
    return folder


@pytest.mark.parametrize(
    ("factor", "markers", "text"),
    [
        (1000.0, True, "are they in millimetres?"),
        (100.0, True, "are they in centimetres?"),
        (39.37, True, "are they in inches?"),
        (1000.0, False, "are they in millimetres?"),
        (100.0, False, "not what a depth camera sees"),
    ],
)
def test_clouds_in_another_unit(tmp_path: Path, factor: float, markers: bool, text: str) -> None:
    assert not inspect(cloud_recording(tmp_path / "good", 1.0, markers=markers))["problems"]
    report = inspect(cloud_recording(tmp_path / "bad", factor, markers=markers))
    assert any(text in problem for problem in report["problems"])


def test_empty_clouds_are_a_problem(tmp_path: Path) -> None:
    report = inspect(cloud_recording(tmp_path, 1.0, count=0))
    assert any("have no points" in problem for problem in report["problems"])


def test_a_recording_against_a_robot(tmp_path: Path) -> None:
    robot = write_block_robot(tmp_path / "robot")
    report = inspect_path(cloud_recording(tmp_path / "r", 1.0), robot=robot)
    assert report["problems"] == [] and any("the clouds have none" in note for note in report["warnings"])
    assert any("seen in no frame: stalk" in note for note in report["warnings"])
    report = inspect_path(cloud_recording(tmp_path / "small", 0.01, markers=False), robot=robot)
    assert any("are they in metres?" in note for note in report["warnings"])
    assert not any("seen in no frame" in note for note in report["warnings"])  # it has no markers at all
    report = inspect_path(robot, robot=robot)
    assert any("--robot is about recordings" in problem for problem in report["problems"])


def test_a_scene_of_gltf_is_not_a_robot(tmp_path: Path) -> None:
    whole = b"glTF" + (2).to_bytes(4, "little") + (12).to_bytes(4, "little")
    (tmp_path / "a.glb").write_bytes(whole)
    assert inspect(tmp_path / "a.glb")["kind"] == "scene" and not inspect(tmp_path / "a.glb")["problems"]
    (tmp_path / "b.glb").write_bytes(whole + b"more")
    assert "not a whole .glb file" in inspect(tmp_path / "b.glb")["problems"][0]
    with pytest.raises(InputError, match="not a text file") as error:
        load_robot(write_bytes(tmp_path / "c.glb", b"glTF\x02\xff\xfe"))
    assert "a glTF scene" in str(error.value) and "UTF-8" in str(error.value)


def write_bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_a_cad_file_and_a_bag_without_its_ending(tmp_path: Path) -> None:
    (tmp_path / "finger.step").write_text("ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n#1=MANIFOLD_SOLID_BREP('',#2);\nENDSEC;\n")
    report = inspect_path(tmp_path / "finger.step")
    assert report["kind"] == "cad" and report["solids"] == 1 and not report["problems"]
    assert "femsense mesh reads the rest" in describe(report)
    (tmp_path / "other.stp").write_bytes(b"\x00\x01")
    assert inspect_path(tmp_path / "other.stp")["problems"]
    (tmp_path / "take").write_bytes(b"#ROSBAG V2.0\n")
    assert inspect_path(tmp_path / "take")["kind"] == "capture"
