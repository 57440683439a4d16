"""Names and paths as systems write them: é in two spellings, padding, control characters, backslashes, tabs."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import RECORDING_FILES, write_block_robot, write_small_recording

from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.io.importers.guess import open_source
from femsense.io.importers.options import Options
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot, save_robot
from femsense.model.recording_checks import check_against

NAME = "extrémité"
SPLIT = unicodedata.normalize("NFD", NAME)


def test_both_spellings_are_one_name_in_robot_recording_and_import(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path / "robot")
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace('name = "tip"', f'name = "{SPLIT}"'), encoding="utf-8")
    markers = RECORDING_FILES["markers.csv"]
    recording = load_recording(write_small_recording(tmp_path / "r", markers_csv=markers.replace("tip", SPLIT)))
    assert NAME in load_robot(folder).marker_names and NAME in recording.marker_names
    (tmp_path / "take.csv").write_text(
        f"time,{SPLIT}_x_m,{SPLIT}_y_m,{SPLIT}_z_m\n0,0.1,0.2,0.3\n1,0.1,0.2,0.3\n", encoding="utf-8"
    )
    assert set(next(open_source(tmp_path / "take.csv").frames()).markers) == {NAME}


def test_a_recording_made_of_arrays_has_composed_names_beside_a_robot(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path / "robot")
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace('name = "tip"', f'name = "{NAME}"'), encoding="utf-8")
    given = load_recording(write_small_recording(tmp_path / "r"))
    split = replace(given, marker_names=tuple(SPLIT if name == "tip" else name for name in given.marker_names))
    assert check_against(load_robot(folder), split).marker_names == (NAME, "middle")


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16-le", "utf-8-sig"])
def test_names_with_accents_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    text = f"time;{NAME}_x_m;{NAME}_y_m;{NAME}_z_m\n0;0,1;0,2;0,3\n1;0,1;0,2;0,3\n"
    (tmp_path / "take.csv").write_bytes(text.encode(encoding))
    assert set(next(open_source(tmp_path / "take.csv", Options()).frames()).markers) == {NAME}


@pytest.mark.parametrize("name", ["tip\0\0", "\u00a0tip ", "tip\u200b", "\ufefftip"])
def test_padding_is_no_part_of_a_name(name: str, tmp_path: Path) -> None:
    assert plain_name(name) == "tip"
    markers = RECORDING_FILES["markers.csv"].replace("tip", name)
    assert "tip" in load_recording(write_small_recording(tmp_path, markers_csv=markers)).marker_names


def test_control_characters_within_a_name_are_refused(tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path, markers_csv=RECORDING_FILES["markers.csv"].replace("tip", "t\x07ip"))
    with pytest.raises(InputError, match="control characters") as error:
        load_recording(folder)
    assert "line 2, column marker" in str(error.value)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ('"meshes\\top\\block.vtu"', "write / for the backslash, or single quotes"),
        ('"meshes\\new.vtu"', r"\n in double quotes is no part of a path"),
        ("'meshes\\block.vtu'", "meshes/block.vtu"),
        ('"C:\\Users\\me\\block.vtu"', "write paths with / or in single quotes"),
    ],
)
def test_paths_with_backslashes_are_explained(written: str, said: str, tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text().replace('"block.vtu"', written))
    with pytest.raises(InputError) as error:
        load_robot(folder)
    assert said in str(error.value)


def test_typographic_quotes_are_named(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text().replace('"block"', "“block”"), encoding="utf-8")
    with pytest.raises(InputError, match="typographic quotes"):
        load_robot(folder)


def test_a_mesh_whose_file_name_is_spelt_otherwise_is_found_and_saved(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path / "robot")
    (folder / "block.vtu").rename(folder / f"{SPLIT}.vtu")
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text().replace("block.vtu", f"{NAME}.vtu"), encoding="utf-8")
    save_robot(load_robot(folder), tmp_path / "saved")
    assert load_robot(tmp_path / "saved").name == "block"


def test_folders_of_a_camera_are_found_in_either_spelling(tmp_path: Path) -> None:
    toml = f'{RECORDING_FILES["recording.toml"]}\n[cameras."{NAME}"]\n'
    folder = write_small_recording(tmp_path, recording_toml=toml, markers_csv=None)
    (folder / "clouds" / SPLIT).mkdir(parents=True)
    (folder / "clouds" / SPLIT / "000000.xyz").write_text("0 0 0.5\n")
    recording = load_recording(folder)
    assert recording.camera_names == (NAME,) and recording.cloud_files[0][0] is not None


def test_a_robot_in_utf_16_is_read(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    text = (folder / "robot.toml").read_text()
    (folder / "robot.toml").write_bytes(text.encode("utf-16"))
    assert load_robot(folder).name == "block"


@pytest.mark.parametrize(("unit", "spelt"), [("mm", "MM"), ("mm", "millimetres")])
def test_a_unit_of_a_mesh_in_any_spelling(unit: str, spelt: str, tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    toml = folder / "robot.toml"
    given = load_robot(folder).body.mesh.nodes
    toml.write_text(toml.read_text().replace(f'unit = "{unit}"', f'unit = "{spelt}"'))
    assert (load_robot(folder).body.mesh.nodes == given).all()


@pytest.mark.parametrize("spelt", ["DICT_4X4_50", "4x4_50", "dict_4x4_50"])
def test_a_dictionary_of_tags_in_any_spelling(spelt: str, tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, appearance__aruco_dictionary=spelt)
    assert load_robot(folder).aruco_dictionary == "4X4_50"


def test_an_unknown_dictionary_is_refused_where_the_robot_is_read(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, appearance__aruco_dictionary="4X4_51")
    with pytest.raises(InputError, match="unknown dictionary") as error:
        load_robot(folder)
    assert "4X4_50" in str(error.value)


@pytest.mark.parametrize("name", ["TIP", "Tip ", "ｔip"])
def test_markers_in_another_spelling_are_named(name: str, tmp_path: Path) -> None:
    markers = RECORDING_FILES["markers.csv"].replace("tip", name)
    recording = load_recording(write_small_recording(tmp_path / "r", markers_csv=markers))
    with pytest.warns(UserWarning, match="left out: .*; are they tip in another spelling"):
        check_against(load_robot(write_block_robot(tmp_path / "robot")), recording)
