"""A finished result is known by what it was made from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import write_block_robot, write_small_recording
from results import bar_robot, make_calibration
from small_run import make_run

from femsense.io.provenance import finished
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.recording import Recording, select_frames
from femsense.model.robot import Robot
from femsense.sensing.run_files import run_inputs, write_run


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return bar_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return load_recording(write_small_recording(tmp_path / "recording"))


def test_finished_sees_every_change_of_the_input(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    calibration = make_calibration()
    inputs = run_inputs(robot, recording, calibration, at=[[0.1, 0.0, 0.0]])
    folder = tmp_path / "run"
    assert not finished(folder, inputs)
    write_run(make_run(robot), folder, inputs=inputs)
    assert finished(folder, run_inputs(robot, load_recording(recording.folder or ""), calibration, at=[0.1, 0, 0]))
    others = [
        run_inputs(robot, recording, calibration),
        run_inputs(robot, recording, None, at=[0.1, 0, 0]),
        run_inputs(robot, select_frames(recording, [0, 1]), calibration, at=[0.1, 0, 0]),
        run_inputs(robot, recording, make_calibration(rms_m=1e-3), at=[0.1, 0, 0]),
        run_inputs(
            load_robot(write_block_robot(tmp_path / "r", material__young_modulus_pa=1e5)), recording, calibration, at=[0.1, 0, 0]
        ),
    ]
    assert not any(finished(folder, other) for other in others)
    assert recording.folder is not None
    with (recording.folder / "markers.csv").open("a") as stream:
        stream.write("4,tip,0.1,0.02,0.5\n")
    assert not finished(folder, run_inputs(robot, recording, calibration, at=[0.1, 0, 0]))


def test_the_same_input_elsewhere_is_the_same_and_truth_does_not_count(
    tmp_path: Path, robot: Robot, recording: Recording
) -> None:
    inputs = run_inputs(robot, recording, None)
    write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    other = write_small_recording(tmp_path / "elsewhere")
    (other / "truth").mkdir()
    (other / "truth" / "contacts.csv").write_text("frame\n", encoding="utf-8")
    assert finished(tmp_path / "run", run_inputs(robot, load_recording(other), None))


def test_an_incomplete_run_or_one_of_another_version_is_not_finished(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = run_inputs(robot, recording, None)
    folder = write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    written = (folder / "run.json").read_text(encoding="utf-8")
    document = json.loads(written)
    document["versions"]["femsense"] = "0.0.0"
    (folder / "run.json").write_text(json.dumps(document), encoding="utf-8")
    assert not finished(folder, inputs)
    (folder / "run.json").write_text(written, encoding="utf-8")
    assert finished(folder, inputs)
    (folder / "frames.csv").unlink()
    assert not finished(folder, inputs)


def test_a_recording_made_in_python_is_never_finished(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = run_inputs(robot, replace(recording, folder=None), None)
    write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    assert not finished(tmp_path / "run", inputs)
