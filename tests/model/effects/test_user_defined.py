"""Effects that a user writes in a file: what they can do, and what is said where the file is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm import arm, record, sweeps
from helpers import write_block_robot

from femsense.core.errors import InputError
from femsense.io.robot_toml import load_robot, save_robot
from femsense.loop.improve import ImproveOptions, improve
from femsense.model.camera_frame import redo_depth, undo_depth
from femsense.model.effects import apply_effects, build_entry, load_own_effect, try_own_effect

OUTSIDE = "ignore:.*outside the mesh.*:UserWarning"
DRAUGHT = '''
"""A draught from the side."""
name = "draught"
parameters = {"push_n": {"unit": "N", "low": -1, "high": 1}}

def forces(nodes_m, push_n):
    result = 0.0 * nodes_m
    result[:, 1] = push_n / len(nodes_m)
    return result
'''
SOFTER = """
name = "softer_with_height"
parameters = {"per_m": {"unit": "1/m", "low": -5, "high": 5}}

def change(robot, per_m):
    body = robot.body
    heights = body.mesh.nodes[body.mesh.tets[:, :4]].mean(axis=1)[:, 0]
    return robot.with_body(body.with_stiffness_scale(1 + per_m * heights))
"""
MAGNET = """
import numpy as np

name = "magnet"
parameters = {"force_n": {"unit": "N", "low": -0.5, "high": 0.5, "size": 3}}
seeds = [{"center_m": [0.1, 0.0, 0.0]}, {"center_m": [0.05, 0.0, 0.0]}]

def forces(nodes_m, force_n, center_m):
    weight = np.exp(-(((nodes_m - center_m) / 0.02) ** 2).sum(axis=1))
    return np.outer(weight / weight.sum(), force_n)
"""
BARREL = """
name = "barrel"
parameters = {"k": {"low": -0.5, "high": 0.5}}

def correct(points_m, k):
    x, y, z = points_m.T
    r2 = (x / z) ** 2 + (y / z) ** 2
    return points_m * (1 + k * r2)[:, None] ** [1, 1, 0]
"""


def written(folder: Path, text: str, name: str = "own.py") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def applied(path: Path, robot, **keys):
    return load_own_effect(path).apply(robot, keys)


def test_forces_are_added_to_the_dead_load(tmp_path):
    robot = arm((2, 1, 1))
    effect = load_own_effect(written(tmp_path, DRAUGHT))
    assert effect.name == "draught" and effect.lacks == "A draught from the side." and effect.keys == ("file", "push_n")
    blown = effect.apply(effect.apply(robot, {"push_n": 0.5}), {"push_n": 0.25})
    np.testing.assert_allclose(blown.body.dead_forces.sum(axis=0), [0, 0.75, 0], atol=1e-12)


def test_the_model_may_be_changed(tmp_path):
    robot = arm((2, 1, 1))
    soft = applied(written(tmp_path, SOFTER), robot, per_m=-2.0)
    scale = soft.body.material.young_modulus / robot.body.material.young_modulus
    assert 0.8 < scale.min() < scale.max() < 1.0


def test_what_the_camera_measures_may_be_corrected_and_the_inverse_is_found(tmp_path):
    seen = applied(written(tmp_path, BARREL), arm((2, 1, 1)), k=0.1).observation
    points = np.array([[0.1, 0.05, 0.4], [0.0, 0.0, 0.5], [-0.1, 0.1, 0.6]])
    bent = undo_depth(points, seen)
    assert np.abs(bent - points).max() > 1e-4
    np.testing.assert_allclose(undo_depth(redo_depth(points, seen), seen), points, atol=1e-12)


def test_parameters_have_defaults_sizes_and_scales(tmp_path):
    text = DRAUGHT.replace(
        "parameters = {",
        (
            'parameters = {"wind_m_s": {"low": -3, "high": 3, "size": 3}, "part": {"low": 1, "high": 9, "null": 2, "scale": '
            '"log", "unit": "s"}, '
        ),
    )
    effect = load_own_effect(written(tmp_path, text))
    robot = arm((2, 1, 1))
    parameters = effect.parameters(robot, "tension")
    assert [p.label for p in parameters] == ["wind_m_s[0]", "wind_m_s[1]", "wind_m_s[2]", "part", "push_n"]
    assert parameters[0].step == pytest.approx(6e-4) and parameters[3].unit == "s"
    seed = effect.seeds(robot)[0]
    entry = build_entry(parameters, [1, 2, 3, 0, 0.5], seed)
    assert entry == {"file": str(tmp_path / "own.py"), "wind_m_s": [1, 2, 3], "part": 1.0, "push_n": 0.5}


@pytest.mark.filterwarnings(OUTSIDE)
def test_a_robot_file_names_the_file_and_takes_it_along(tmp_path):
    folder = write_block_robot(tmp_path / "a", effects=[{"name": "draught", "file": "draught.py", "push_n": 0.5}])
    written(folder, DRAUGHT, "draught.py")
    robot = load_robot(folder)
    assert robot.body.dead_forces.sum() == pytest.approx(0.5)
    elsewhere = {"name": "softer_with_height", "file": str(written(tmp_path, SOFTER, "softer.py")), "per_m": 1.0}
    save_robot(robot, tmp_path / "b", effects=[{"name": "draught", "file": "draught.py", "push_n": 0.25}, elsewhere])
    (tmp_path / "softer.py").unlink()
    again = load_robot(tmp_path / "b")
    assert again.body.dead_forces.sum() == pytest.approx(0.25) and np.ptp(again.body.material.young_modulus) > 0
    assert 'file = "softer.py"' in (tmp_path / "b" / "robot.toml").read_text()


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ("name = ", ["does not run", "own.py:1", "SyntaxError"]),
        ("x = 1\nimport nowhere_at_all", ["does not run", "own.py:2", "ModuleNotFoundError"]),
        ("x = 1", ["has no name", 'name = "magnet"']),
        ("name = 'gravity'", ["does nothing", "forces(nodes_m"]),
        (DRAUGHT.replace('"draught"', '"gravity"'), ["the name is taken"]),
        (DRAUGHT.replace("parameters =", "parameter ="), ["has no parameters", "parameters = {"]),
        (DRAUGHT.replace('"low": -1, ', ""), ["without bounds", "push_n"]),
        (DRAUGHT.replace('"low"', '"lowest": 0, "low"'), ["unknown key", "lowest", "unit, null, low"]),
        (DRAUGHT.replace('"low": -1', '"low": 0.5'), ["bounds that do not hold the null", "null is where the effect vanishes"]),
        (DRAUGHT.replace('"low": -1', '"low": "a"'), ["not a number"]),
        (DRAUGHT.replace('"unit": "N"', '"scale": "square"'), ["unknown scale", "linear | log | reciprocal"]),
        (DRAUGHT + "seeds = []", ["not a list of tables"]),
    ],
)
def test_a_wrong_file_is_explained(tmp_path, text, texts):
    with pytest.raises(InputError) as error:
        load_own_effect(written(tmp_path, text))
    for part in texts:
        assert part in str(error.value)


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        (DRAUGHT.replace("return result", "return result[0]"), ["gives something else", "shape (3,)", "nodal forces"]),
        (DRAUGHT.replace("return result", "return result / 0.0 + float('nan')"), ["not finite"]),
        (DRAUGHT.replace("push_n / len", "push / len"), ["forces fails", "own.py:8", "NameError"]),
        (
            SOFTER.replace('per_m": {', 'push_n": {')
            .replace("per_m", "push_n")
            .replace("return robot.with_body", "return body.with_stiffness_scale(1) or"),
            ["change gives something else", "BodyModel"],
        ),
    ],
)
def test_a_function_that_fails_is_told_with_its_line(tmp_path, text, texts):
    with pytest.raises(InputError) as error:
        applied(written(tmp_path, text), arm((2, 1, 1)), push_n=0.5)
    for part in texts:
        assert part in str(error.value)


def test_an_effect_that_fails_or_does_not_vanish_is_told_before_anything_is_tried(tmp_path):
    robot = arm((2, 1, 1))
    for i, (text, said) in enumerate(
        [
            (DRAUGHT.replace("push_n / len", "push / len"), "forces fails"),
            (DRAUGHT.replace("return result", "return result + 1.0"), "does not vanish at its null"),
            (SOFTER.replace("1 + per_m", "2 + per_m"), "does not vanish at its null"),
        ]
    ):
        (folder := tmp_path / str(i)).mkdir()
        with pytest.raises(InputError, match=said):
            try_own_effect(load_own_effect(written(folder, text)), robot)
    try_own_effect(load_own_effect(written(tmp_path, DRAUGHT)), robot)
    try_own_effect(load_own_effect(written(tmp_path, SOFTER)), robot)


def test_entries_are_checked(tmp_path):
    file, robot = written(tmp_path, DRAUGHT), arm((2, 1, 1))
    for entry, text in [
        ({"name": "draught", "file": str(file)}, "a parameter is missing"),
        ({"name": "wind", "file": str(file), "push_n": 1.0}, "the file holds another effect"),
        ({"name": "draught", "file": str(file), "push_n": 1.0, "pull_n": 1.0}, "unknown key"),
        ({"name": "draught", "file": str(tmp_path / "no.py"), "push_n": 1.0}, "no such file"),
    ]:
        with pytest.raises(InputError, match=text):
            apply_effects(robot, [entry])


def test_an_effect_of_ones_own_competes_and_the_better_robot_can_be_written(tmp_path):
    (tmp_path / "own").mkdir()
    magnet = written(tmp_path / "own", MAGNET, "magnet.py")
    inputs, labels = sweeps(each=1)
    hidden = {"name": "magnet", "file": str(magnet), "center_m": [0.1, 0.0, 0.0], "force_n": [0.0, 0.16, 0.1]}
    recording, _ = record(inputs[:9], effects=[hidden], labels=labels[:9], truth=arm((3, 1, 1)))
    loop = improve(
        arm((3, 1, 1)), [recording], effects=["magnet", "cable_friction"], options=ImproveOptions(user_effects=[magnet])
    )
    tried = next(row for row in loop.candidates if row.name == "magnet")
    assert tried.dchi2 > 100.0 and tried.seed["file"] == str(magnet)
    save_robot(arm((3, 1, 1)), tmp_path, effects=[hidden])
    assert (tmp_path / "magnet.py").is_file()
    np.testing.assert_allclose(load_robot(tmp_path).body.dead_forces.sum(axis=0), hidden["force_n"], atol=1e-9)
    with pytest.raises(InputError, match="unknown effect"):
        improve(arm((2, 1, 1)), [recording], effects=["magnet"])
