"""Files of results: what is written comes back, foreign and broken files are refused, and a finished result is known as such."""

from __future__ import annotations

import csv
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import write_block_robot, write_small_recording
from small_run import make_run

from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration, write_calibration
from femsense.core.errors import InputError
from femsense.io.files import PART_PREFIX
from femsense.io.provenance import finished
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.loop.files import loop_inputs, read_loop, write_loop
from femsense.loop.result import LoopResult
from femsense.model.recording import Recording, select_frames
from femsense.model.robot import Robot
from femsense.sensing.run_files import read_run, run_inputs, write_run

NAN = float("nan")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(
        write_block_robot(tmp_path_factory.mktemp("robot"), cells=(2, 1, 1), cables__0__path_m=[[0.1, 0.015, 0.03]])
    )


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return load_recording(write_small_recording(tmp_path / "recording"))


def make_calibration(**changes: Any) -> Calibration:
    rng = np.random.default_rng(3)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T = np.eye(4)
    T[:3, :3] = R * np.sign(np.linalg.det(R))
    T[:3, 3] = rng.normal(size=3)
    half = rng.normal(size=(6, 6))
    calibration = Calibration(
        T_robot_camera=T,
        poses=(T, np.eye(4)),
        camera_names=("left", "right"),
        cable_tension_n={"top": 0.1 + 0.2, "side": 0.0},
        cable_displacement_m={"top": 1e-3, "side": -2e-4},
        rms_m=1 / 3000,
        marker_rms_m={"tip": 2e-4},
        history=({"iteration": 0, "rms_m": 0.1},),
        pose_std=rng.random((4, 4)),
        pose_covariance=half @ half.T,
        tension_std_n={"top": 0.01, "side": None},
        displacement_std_m={"top": 1e-5, "side": None},
        status="converged",
        placements_m={"tip": [0.1, 0.0, 0.03]},
        frames=(0, 4),
    )
    return replace(calibration, **changes)


def make_loop(robot: Robot) -> LoopResult:
    entry = {"name": "cable_friction", "coefficient": 0.12}
    rms = {"train_rms_m": 1e-3, "validation_rms_m": NAN, "validation_ci_m": [0.0, np.inf]}
    return LoopResult(
        verdict="effects",
        sentence="the cables rub",
        noise_m=1e-4,
        before=rms,
        after=rms,
        entries=(entry,),
        candidates=(),
        confounded=(),
        effects=({"name": "cable_friction", "parameters": {"coefficient": {"value": 0.12, "std": 0.01, "unit": "1"}}},),
        next_experiment="",
        not_testable=(),
        detectable={},
        left={},
        robot=robot,
        declared=robot,
    )


def same(a: Any, b: Any) -> None:
    """Assert that two objects are the same, NaN included."""
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            same(x, y)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        same(list(a.values()), list(b.values()))
    elif hasattr(a, "__dataclass_fields__"):
        for field in fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b or (a != a and b != b), (a, b)


def strict_json(path: Path) -> Any:
    """Return the content of a JSON file that has no NaN and no Infinity."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def nothing_half_written(folder: Path) -> bool:
    return not [path for path in folder.rglob("*") if PART_PREFIX in path.name]


# Calibrations


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


# Runs


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
    assert ",".join(rows[0]) == "frame,time_s,status,contacts,matched,rms_before_m,rms_after_m,ms,tension_top_n,tension_side_n"
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


# Resuming


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


def test_an_incomplete_run_or_one_of_another_version_is_not_finished(
    tmp_path: Path, robot: Robot, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = run_inputs(robot, recording, None)
    folder = write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    monkeypatch.setattr("femsense.__version__", "0.0.0")
    assert not finished(folder, inputs)
    monkeypatch.undo()
    assert finished(folder, inputs)
    (folder / "frames.csv").unlink()
    assert not finished(folder, inputs)


def test_a_recording_made_in_python_is_never_finished(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = run_inputs(robot, replace(recording, folder=None), None)
    write_run(make_run(robot), tmp_path / "run", inputs=inputs)
    assert not finished(tmp_path / "run", inputs)


# Loops


def test_a_loop_writes_the_improved_robot_and_strict_json(tmp_path: Path, robot: Robot, recording: Recording) -> None:
    inputs = loop_inputs(robot, [recording], [], effects=None)
    folder = write_loop(make_loop(robot), tmp_path / "out", inputs=inputs)
    document = read_loop(folder)
    assert document == strict_json(folder / "loop.json") == read_loop(folder / "loop.json")
    assert document["format"] == "femsense-loop-1" and document["before"]["validation_rms_m"] is None
    improved = load_robot(folder)
    assert [cable.friction for cable in improved.body.cables] == [0.12, 0.12]
    assert improved.document is not None and improved.document["effects"] == [{"name": "cable_friction", "coefficient": 0.12}]
    assert finished(folder, inputs) and not finished(folder, loop_inputs(robot, [recording], [], effects=["creep"]))


def test_effects_of_a_second_loop_come_after_those_of_the_first(tmp_path: Path, robot: Robot) -> None:
    first = write_loop(make_loop(robot), tmp_path / "first")
    again = load_robot(first)
    entry = {"name": "stiffness", "scale": 0.8}
    second = write_loop(replace(make_loop(again), entries=(entry,)), tmp_path / "second")
    both = load_robot(second)
    assert both.document is not None and [e["name"] for e in both.document["effects"]] == ["cable_friction", "stiffness"]
    np.testing.assert_allclose(both.body.material.young_modulus, 0.8 * again.body.material.young_modulus)


def test_a_loop_replaces_its_own_robot_but_no_other(tmp_path: Path, robot: Robot) -> None:
    folder = write_loop(make_loop(robot), tmp_path / "out")
    write_loop(replace(make_loop(robot), entries=()), folder)
    assert load_robot(folder).body.cables[0].friction == 0
    with pytest.raises(InputError, match=r"robot\.toml"):
        write_loop(make_loop(robot), write_block_robot(tmp_path / "mine"))


def test_a_result_is_not_written_at_a_file(tmp_path: Path, robot: Robot) -> None:
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with pytest.raises(InputError, match="a file stands"):
        write_loop(make_loop(robot), tmp_path / "file")
    with pytest.raises(InputError, match="a folder stands"):
        write_calibration(make_calibration(), tmp_path)
