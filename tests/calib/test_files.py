"""calibration.json: what is written comes back, foreign and broken files are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from results import NAN, make_calibration, nothing_half_written, same, strict_json

from femsense.calib.files import read_calibration, write_calibration
from femsense.core.errors import InputError


@pytest.mark.parametrize("changes", [{}, {"rms_m": NAN, "marker_rms_m": {}, "history": ()}, {"placements_m": {}, "frames": ()}])
def test_a_calibration_comes_back_the_same(tmp_path: Path, changes: dict[str, Any]) -> None:
    calibration = make_calibration(**changes)
    path = write_calibration(calibration, tmp_path / "new" / "calibration.json")
    same(calibration, read_calibration(path))
    same(calibration, read_calibration(path.parent))
    assert nothing_half_written(tmp_path)


def test_calibration_json_has_the_keys_of_the_contract(tmp_path: Path) -> None:
    document = strict_json(write_calibration(make_calibration(rms_m=NAN), tmp_path / "c.json"))
    assert document["format"] == "femsense-calibration-1"
    assert {
        "T_robot_camera",
        "cable_tension_n",
        "cable_displacement_m",
        "rms_m",
        "marker_rms_m",
        "history",
        "std",
        "status",
    } <= set(document)
    assert set(document["std"]) == {"T_robot_camera", "cable_tension_n", "cable_displacement_m"}
    assert document["rms_m"] is None and document["std"]["cable_tension_n"]["side"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "another kind of file"),
        ('{"format": "femsense-loop-1"}', "found:    'femsense-loop-1'"),
        ('{"format": "femsense-calibration-1"}', "a key is missing"),
        ('{"format": "femsense-calibration-1", "std": 3}', "not a table"),
        ('{"format": "femsense-calibration-1", "std": {}, "T_robot_camera": [[1]]}', "T_robot_camera: not a rigid transform"),
    ],
)
def test_foreign_and_broken_calibrations_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "c.json"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_calibration(file)
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("cable_tension_n", {"top": "much"}),
        ("history", 3),
        ("cameras", [{}]),
        ("placements_m", {"tip": 1}),
        ("pose_covariance", [[1.0]]),
        ("frames", "x"),
    ],
)
def test_a_calibration_with_a_broken_value_is_refused(tmp_path: Path, key: str, value: Any) -> None:
    file = write_calibration(make_calibration(), tmp_path / "c.json")
    file.write_text(json.dumps({**strict_json(file), key: value}), encoding="utf-8")
    with pytest.raises(InputError, match="calibration"):
        read_calibration(file)


def test_a_missing_calibration_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read") as error:
        read_calibration(tmp_path / "none.json")
    assert "none.json" in str(error.value)


def test_a_calibration_is_not_written_at_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a folder exists"):
        write_calibration(make_calibration(), tmp_path)


def test_a_calibration_says_itself_in_a_line() -> None:
    said = repr(make_calibration())
    assert said.startswith("Calibration(2 cameras; ") and "mm rms of markers" in said and len(said) < 200 and "array" not in said
