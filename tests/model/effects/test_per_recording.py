"""Values of their own in each recording: what a robot is in one, tables, sensitivities, what is sought, round trips."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, record, sweeps
from helpers import write_block_robot

from femsense.core.errors import InputError
from femsense.io.robot_toml import load_robot, robot_document
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import with_nuisance
from femsense.model.drive import drive_of
from femsense.model.effects import Entry, apply_effects, build_entry, by_session, find_effect, forms_by_recording, per_recording
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.robot import Robot

GAIN: Entry = {"name": "cable_gain", "per": "recording", "scale": {"up": {"A": 0.5, "B": 2.0}, "left": 1.5}}


def recording(session: str | None = None, folder: str | None = None, inputs: Any = None, **parts: Any) -> Recording:
    drives = Drives(NAMES, [[0.0] * 4, [1.0] * 4] if inputs is None else inputs)
    made = make_recording(Timeline([0.0, 1.0]), drives=drives, **parts)
    return replace(made, session=session, folder=None if folder is None else Path(folder))


def tensions(robot: Robot, session: str) -> list[float]:
    return drive_of(robot, recording(session)).inputs[1].tolist()


def test_each_recording_has_its_own_value_and_an_unknown_one_the_mean() -> None:
    robot = apply_effects(arm((3, 1, 1)), [GAIN])
    assert tensions(robot, "A") == [0.5, 1.0, 1.5, 1.0]
    assert tensions(robot, "B") == [2.0, 1.0, 1.5, 1.0]
    assert tensions(robot, "C") == [1.25, 1.0, 1.5, 1.0]
    assert tensions(apply_effects(robot, [{"name": "cable_gain", "scale": 2.0}]), "A") == [1.0, 2.0, 3.0, 2.0]


def test_a_recording_goes_by_its_session_or_else_by_its_folder() -> None:
    robot = apply_effects(arm((3, 1, 1)), [{"name": "cable_offset", "per": "recording", "tension_n": {"A": 0.5, "run-2": 1.0}}])
    assert drive_of(robot, recording("A", "runs/run-2")).inputs[0].tolist() == [0.5] * 4
    assert drive_of(robot, recording(None, "runs/run-2")).inputs[0].tolist() == [1.0] * 4


def test_cables_cameras_and_markers_have_them() -> None:
    entries: list[Entry] = [
        {"name": "cable_friction", "per": "recording", "coefficient": {"A": 0.1, "B": 0.3}},
        {"name": "depth_scale", "per": "recording", "scale": {"A": 1.01, "B": 0.99}},
        {"name": "marker_offset", "per": "recording", "offset_m": {"m3": {"A": [0.0, 0.0, 0.001], "B": [0.0, 0.002, 0.001]}}},
    ]
    plain = arm((3, 1, 1))
    there = apply_effects(plain, entries).in_recording("B")
    assert [c.friction for c in there.body.cables] == [0.3] * 4
    assert there.observation.depth_scale == 0.99
    np.testing.assert_allclose((there.marker_points - plain.marker_points)[3], [0.0, 0.002, 0.001])
    np.testing.assert_allclose(
        (apply_effects(plain, entries).in_recording("?").marker_points - plain.marker_points)[3], [0.0, 0.001, 0.001]
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"name": "gravity", "per": "recording", "vector_m_s2": [0, 0, -9.81]}, "unknown key"),
        ({**GAIN, "per": "cable"}, r'(?s)unknown value.*"recording"'),
        ({**GAIN, "scale": {"up": {"A": "much"}}}, "not a table of values"),
        ({"name": "cable_friction", "per": "recording", "coefficient": {"A": 0.2, "B": -0.1}}, "is not negative"),
    ],
)
def test_what_does_not_fit_is_refused(entry: Entry, message: str) -> None:
    with pytest.raises(InputError, match=message):
        apply_effects(arm((3, 1, 1)), [entry])


def test_parameters_build_the_entry_that_is_applied() -> None:
    robot = arm((3, 1, 1))
    form = per_recording(find_effect("cable_gain"), ("A", "B"))
    (seed,) = form.seeds(robot)
    parameters = form.parameters(robot, "tension")
    assert [p.label for p in parameters][:2] == ["scale[up][A]", "scale[down][A]"] and len(parameters) == 8
    entry = build_entry(parameters, np.log(np.arange(1.0, 9.0)).tolist(), seed)
    assert entry["per"] == "recording" and entry["scale"]["left"] == pytest.approx({"A": 3.0, "B": 7.0})
    np.testing.assert_allclose(tensions(form.apply(robot, entry), "B"), [5.0, 6.0, 7.0, 8.0])
    marker = per_recording(find_effect("marker_offset"), ("A", "B"))
    points = build_entry(marker.parameters(robot, "tension"), list(range(72)), *marker.seeds(robot))["offset_m"]
    assert points["m1"] == {"A": [3, 4, 5], "B": [39, 40, 41]}


@pytest.mark.parametrize(
    ("name", "at", "absent", "there"),
    [("cable_gain", np.log(2.0), 1.0, 2.0), ("cable_offset", 0.3, 0.0, 0.3), ("marker_offset", 1e-3, [0.0] * 3, [1e-3] * 3)],
)
def test_what_one_recording_has_alone_is_absent_in_the_others(name: str, at: float, absent: Any, there: Any) -> None:
    robot = arm((3, 1, 1))
    form = per_recording(find_effect(name), ("A", "B"))
    (seed,) = form.seeds(robot)
    own = [
        p
        for p in form.parameters(robot, "tension")
        if p.part.recording == "B" and p.part.part in ("up", *(("m1", i) for i in range(3)))
    ]
    (table,) = (v for k, v in build_entry(own, [at] * len(own), seed).items() if k != "per")
    (values,) = table.values()
    assert values["A"] == absent and values["B"] == pytest.approx(there)
    whole = form.apply(robot, build_entry(own, [at] * len(own), seed))
    np.testing.assert_array_equal(tensions(whole, "A"), tensions(robot, "A"))


def test_it_is_sought_only_where_recordings_were_made_in_several_sessions() -> None:
    effects = [find_effect(name) for name in ("cable_gain", "gravity", "chamber_gain")]
    forms = forms_by_recording(effects, [recording("A"), recording(None, "b")])
    names = ["cable_gain", "chamber_gain"]
    assert [form.name for form in forms] == names * 2  # of each alone, and of all alike
    alike = forms[2].parameters(arm((3, 1, 1)), "tension")
    assert [p.label for p in alike] == ["scale[A]", "scale[b]"] and not forms[3].parameters(arm((3, 1, 1)), "tension")
    entry = build_entry(alike, [0.0, np.log(2.0)], *forms[2].seeds(arm((3, 1, 1))))
    assert tensions(forms[2].apply(arm((3, 1, 1)), entry), "b") == pytest.approx([2.0] * 4)
    assert not forms_by_recording(effects, [recording("A"), recording("A", "other")])
    assert not forms_by_recording(effects, [recording("A"), recording()])
    assert forms_by_recording(effects, [recording("A"), recording("B")])[0] is per_recording(effects[0], ("A", "B"))


def test_the_sensitivity_is_that_of_the_recording_alone() -> None:
    robot = arm((3, 1, 1))
    inputs = np.array([[0.5, 0.0, 0.2, 0.0], [1.5, 0.0, 0.4, 0.0]])
    count = len(robot.marker_names)
    seen = recording(
        "B",
        inputs=inputs,
        markers=MarkerRows(
            robot.marker_names, np.repeat([0, 1], count), np.tile(np.arange(count), 2), np.tile(robot.marker_points, (2, 1))
        ),
    )
    scene = make_scene(robot, seen, np.arange(2))

    def jet(hypothesis: Hypothesis, coordinates: np.ndarray) -> Any:
        options: dict[str, Any] = {"derivative": True, "vary_initial": False, "pivot": np.zeros(3)}
        return evaluate_scene(hypothesis, scene, coordinates, [T_ROBOT_CAMERA], None, **options)

    for name in ("cable_gain", "cable_offset", "cable_friction", "depth_scale"):
        effect = find_effect(name)
        form = per_recording(effect, ("A", "B"))
        common, own = effect.parameters(robot, "tension"), form.parameters(robot, "tension")
        at = np.array([p.null + 0.02 * (p.high - p.null) for p in common])
        alike = jet(Hypothesis(robot, ((effect, {}, common),)), at)
        apart = jet(Hypothesis(robot, ((form, dict(form.seeds(robot)[0]), own),)), np.concatenate([0.0 * at, at]))
        np.testing.assert_allclose(apart.residual, alike.residual, atol=1e-9)
        assert not apart.by_effect[:, :, : len(common)].any()
        np.testing.assert_allclose(
            apart.by_effect[:, :, len(common) :], alike.by_effect, atol=1e-6 * np.abs(alike.by_effect).max()
        )


def test_sessions_have_input_offsets_of_their_own() -> None:
    inputs, labels = sweeps(each=1)
    made, _ = record(inputs, labels=labels, truth=arm((3, 1, 1)))
    robot = arm((3, 1, 1))
    one = prepare(robot, [made, made], [])
    two = prepare(robot, [replace(made, session="A"), replace(made, session="B")], [])
    offsets = [sum(p.key == "tension_n" for p in with_nuisance(data)[0].parameters) for data in (one, two)]
    assert offsets == [4, 8]
    effect = find_effect("cable_offset")
    assert by_session(effect, [made, replace(made, session="A")]) == (effect, {})


def test_robot_toml_round_trip(tmp_path: Path) -> None:
    entries = [
        {"name": "cable_gain", "per": "recording", "scale": {"top": {"A": 0.8, "B": 1.1}}},
        {"name": "depth_scale", "per": "recording", "scale": {"A": 1.01, "B": 1.0}},
    ]
    robot = load_robot(write_block_robot(tmp_path, effects=entries))
    assert robot_document(robot)["effects"] == entries
    assert robot.in_recording("B").actuation.gain.tolist()[0] == 1.1
