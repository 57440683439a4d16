"""The forces that the camera of a recording resolves: the same bound as for a script, with what was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_block_robot

from femsense.app.cli import run
from femsense.calib.calibrate import calibrate
from femsense.core.errors import DataError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.rig.force_map import force_map
from femsense.rig.recorded_forces import recorded_forces, resolution_document, resolution_text
from femsense.rig.script import check_script
from femsense.rig.simulate import simulate

SCRIPT = {
    "format": "femsense-script-1",
    "sweeps": [{"label": "pull", "cables": {"top": 0.5}, "levels": [0.0, 0.5, 1.0]}],
    "truth": {"refinements": 0, "element": "tet4", "law": "corotational", "substeps": 1},
    "camera": {
        "width": 160,
        "height": 120,
        "fx": 150.0,
        "eye_m": [0.05, -0.25, 0.12],
        "target_m": [0.05, 0.0, 0.0],
        "declare_pose": True,
        "declare_noise": True,
        "noise": {"edge_dropout": 0.0, "flying_share": 0.0},
    },
    "clouds": {"kind": "depth"},
    "markers": {"std_m": 2e-4, "occlusion": False},
    "scene": {"floor_z_m": -0.05},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the folders of a robot and of a recording with depth images."""
    place = tmp_path_factory.mktemp("recorded")
    robot = write_block_robot(place / "robot")
    return robot, simulate(load_robot(robot), SCRIPT, place / "recording")


def test_a_recording_resolves_what_its_script_foretold(folders: tuple[Path, Path]) -> None:
    robot, recording = load_robot(folders[0]), load_recording(folders[1])
    found = recorded_forces(robot, recording, calibrate(robot, recording))
    planned = force_map(robot, check_script(SCRIPT))
    assert found.declared and found.from_clouds and found.frame == 0
    np.testing.assert_allclose(found.found.points, planned.points, rtol=0.15)
    near = np.linalg.norm(planned.rest[:, None] - found.found.rest, axis=2)
    same = near.min(axis=0) < 1e-9
    assert same.sum() >= 4
    np.testing.assert_allclose(found.found.normal_std[same], planned.normal_std[near.argmin(axis=0)][same], rtol=0.15)
    assert (found.found.visible == planned.visible[near.argmin(axis=0)])[same].all()


def test_it_is_said_at_places_that_are_seen_and_out_of_sight(folders: tuple[Path, Path]) -> None:
    robot, recording = load_robot(folders[0]), load_recording(folders[1])
    found = recorded_forces(robot, recording, calibrate(robot, recording))
    document, text = resolution_document(found), resolution_text(found)
    assert [place["seen"] for place in document["places"]] == [True] * 4 + [False] * 2 and document["from"] == "clouds"
    assert text.count("seen") == 4 and text.count("out of sight") == 2 and "(declared)" in text
    assert f"{3 * min(place['normal_std_n'] for place in document['places']):.2g} to" in text


def test_markers_alone_resolve_less(folders: tuple[Path, Path]) -> None:
    robot, recording = load_robot(folders[0]), load_recording(folders[1])
    calibration = calibrate(robot, recording)
    bare = replace(recording, cloud_files=tuple((None,) for _ in recording.cloud_files), marker_noise_m=2e-4)
    markers, noisy = (recorded_forces(robot, replace(bare, marker_noise_m=std), calibration) for std in (2e-4, 4e-4))
    assert not markers.from_clouds and markers.declared and markers.noise_m == 2e-4
    assert resolution_document(markers)["points"] == len(
        robot.marker_names
    ) and "markers, noise of a coordinate" in resolution_text(markers)
    assert (noisy.found.normal_std > markers.found.normal_std).all()
    empty = {name: getattr(bare, name)[:0] for name in ("marker_frame", "marker_index", "marker_view", "marker_xyz")}
    nothing = replace(bare, **empty)
    with pytest.raises(DataError, match="neither clouds nor markers"):
        recorded_forces(robot, nothing, calibration)


def test_inspect_calibrate_and_estimate_say_it(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, recording = map(str, folders)
    for command in (
        ["inspect", recording, "--robot", robot],
        ["calibrate", robot, recording, "-o", str(tmp_path / "c.json")],
        ["estimate", robot, recording, "-c", str(tmp_path / "c.json"), "-o", str(tmp_path / "run")],
    ):
        assert run(command) == 0
        assert "forces that this camera resolves" in (text := capsys.readouterr().out) and text.count("out of sight") == 2, (
            command
        )
    assert "at the start" not in text and run([*command, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["force_resolution"]["places"]) == 6
