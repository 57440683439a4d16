"""The folder of a run: what is written comes back, and nothing else is written over."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_small_recording
from results import bar_robot, make_calibration, nothing_half_written, same, strict_json
from small_run import make_run

from femsense.calib.files import read_calibration
from femsense.core.errors import InputError
from femsense.io.provenance import finished
from femsense.io.recording_folder import load_recording
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.sensing.run_files import read_run, run_inputs, write_run


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return bar_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return load_recording(write_small_recording(tmp_path / "recording"))


def test_a_run_comes_back_the_same(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    run = replace(make_run(robot), recording_folder=recording.folder)
    inputs = run_inputs(robot, recording, None)
    folder = write_run(run, tmp_path / "run", inputs=inputs, seconds=1.5, calibration=make_calibration())
    back = read_run(folder)
    for name in ("contacts", "frames", "states", "known_loads", "recording_folder"):
        same(getattr(run, name), getattr(back, name))
    assert back.states.nodes_m.dtype == np.float32
    np.testing.assert_array_equal(back.robot.body.mesh.nodes, robot.body.mesh.nodes)
    same(make_calibration(), read_calibration(folder))
    assert nothing_half_written(tmp_path)


def test_the_files_of_a_run_are_those_of_the_contract(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    folder = write_run(make_run(robot), tmp_path / "run", inputs=run_inputs(robot, recording, None, at=[0.1, 0, 0]))
    with (folder / "contacts.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    first = "frame,time_s,contact,x_m,y_m,z_m,nx,ny,nz,fx_n,fy_n,fz_n,force_n,std_n,source"
    assert ",".join(rows[0]) == first + ",track,x_std_m,y_std_m,z_std_m,radius_m,fx_std_n,fy_std_n,fz_std_n"
    assert [row[13] for row in rows[1:]] == ["0.1", "", "0.3"]
    with (folder / "frames.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    columns = "frame,time_s,status,contacts,matched,rms_before_m,rms_after_m,ms,tension_top_n,tension_side_n"
    assert ",".join(rows[0]) == columns + ",note"  # one contact was seen, and its size is not determined
    without = write_run(replace(make_run(robot), contacts=()), tmp_path / "without", inputs=run_inputs(robot, recording, None))
    assert (without / "frames.csv").read_text(encoding="utf-8").splitlines()[0] == columns
    with np.load(folder / "states.npz") as states:
        assert set(states.files) == {"time_s", "nodes_m", "tets", "rest_nodes_m"} and states["nodes_m"].dtype == np.float32
    document = strict_json(folder / "run.json")
    assert document["format"] == "femsense-run-1" and document["frames_ok"] == 2
    assert {"femsense", "numpy", "scipy", "open3d"} <= set(document["versions"]) and document["timing"][
        "ms_per_frame_median"
    ] == 12.0
    assert document["inputs"]["options"] == {"at": [[0.1, 0.0, 0.0]]} and len(document["inputs"]["robot"]["sha256"]) == 64


def test_a_new_run_replaces_an_old_one_and_leaves_other_files(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = run_inputs(robot, recording, None)
    folder = write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    write_run(replace(make_run(robot), contacts=()), folder, inputs=inputs)
    assert read_run(folder).contacts == () and (folder / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert nothing_half_written(tmp_path)


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = run_inputs(robot, recording, None)
    folder = write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    broken = replace(make_run(robot), states=None)  # type: ignore[arg-type]
    for place in (folder, tmp_path / "other"):
        with pytest.raises(AttributeError):
            write_run(broken, place, inputs=inputs)
    assert finished(folder, inputs) and len(read_run(folder).contacts) == 3
    assert not (tmp_path / "other").exists() and nothing_half_written(tmp_path)


@pytest.mark.parametrize("name", ["robot.toml", "recording.toml", "loop.json"])
def test_a_run_is_not_written_over_something_else(tmp_path: Path, robot: Robot, recording: Recording, name: str) -> None:
    (tmp_path / name).write_text("precious", encoding="utf-8")
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        write_run(make_run(robot), tmp_path, inputs=run_inputs(robot, recording, None))
    assert (tmp_path / name).read_text(encoding="utf-8") == "precious" and not (tmp_path / "run.json").exists()


def test_an_incomplete_run_is_refused_with_what_is_missing(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    folder = write_run(make_run(robot), tmp_path / "run", inputs=run_inputs(robot, recording, None))
    (folder / "states.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"states\.npz: not readable"):
        read_run(folder)
    (folder / "states.npz").unlink()
    with pytest.raises(InputError, match=r"no states\.npz"):
        read_run(folder)
