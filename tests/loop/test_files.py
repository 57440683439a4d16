"""The folder of a loop: its robot, loop.json, and what is written over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_block_robot, write_small_recording
from results import bar_robot, make_loop, strict_json

from femsense.core.errors import InputError
from femsense.io.provenance import finished
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.loop.files import loop_inputs, read_loop, write_loop
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return bar_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return load_recording(write_small_recording(tmp_path / "recording"))


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


def test_a_loop_replaces_no_mesh_and_not_the_robot_it_is_made_from(tmp_path: Path, robot: Robot) -> None:
    folder = write_loop(make_loop(robot), tmp_path / "out")
    with pytest.raises(InputError, match="the result would replace the robot"):
        write_loop(make_loop(load_robot(folder)), folder)
    mesh = load_robot(folder).document["mesh"]["file"]  # type: ignore[index]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / mesh).write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=f"another mesh would be replaced\n  found:    {mesh}"):
        write_loop(make_loop(robot), tmp_path / "mine")
    assert (tmp_path / "mine" / mesh).read_text(encoding="utf-8") == "mine"


def test_a_loop_is_not_written_at_a_file(tmp_path: Path, robot: Robot) -> None:
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with pytest.raises(InputError, match="a file exists"):
        write_loop(make_loop(robot), tmp_path / "file")


def test_a_result_says_itself_in_a_line(tmp_path: Path) -> None:
    loop = make_loop(bar_robot(tmp_path))
    said = repr(loop)
    assert said.startswith(f"LoopResult({loop.verdict}: ") and all(effect.name in said for effect in loop.effects)
    assert f"{1e3 * loop.before.validation_rms_m:.3g} → " in said and len(said) < 200
