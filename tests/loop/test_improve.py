"""The loop on data of another mesh and law than the estimator's: what is undeclared is found, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.errors import DataError, InputError
from femsense.loop.data.dataset import prepare
from femsense.loop.data.holdout import hold_out, sweeps_of
from femsense.loop.data.trial import Groups
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise, estimate_noise, starting_points, whiten
from femsense.loop.fit.repeatability import Repeatability
from femsense.loop.improve import ImproveOptions, improve
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.search import distinguishes_effects
from femsense.loop.search.search_state import SearchProgress
from femsense.loop.thresholds import DEFAULTS
from femsense.loop.verdict.returned_model import is_significant
from femsense.loop.verdict.sentences import by_noise
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, LoadRows, Timeline


def found(loop, name):
    return next(e for e in loop.effects if e.name == name)


def test_friction_is_named_with_its_coefficient_and_the_held_out_error_falls():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "cable_friction", "coefficient": 0.25}], labels=labels)
    loop = improve(arm((5, 2, 2)), [recording])
    assert loop.verdict == "effects"
    effect = found(loop, "cable_friction")
    assert effect.parameters["coefficient"].value == pytest.approx(0.25, rel=0.15)
    assert loop.after.validation_rms_m < 0.5 * loop.before.validation_rms_m
    assert {e.name for e in loop.effects} <= {"cable_friction", "stiffness", "cable_offset", "hyperelastic"}  # the truth is


def test_a_wrong_modulus_is_named_stiffness_and_nothing_else():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "stiffness", "scale": 1.25}], labels=labels, truth=arm((8, 3, 3)))
    loop = improve(arm(), [recording])
    assert [e.name for e in loop.effects] == ["stiffness"]
    assert "not distinguished" not in loop.sentence  # weight tells it from a gain of all cables
    assert found(loop, "stiffness").parameters["scale"].value == pytest.approx(1.25, rel=0.06)
    assert [e["name"] for e in loop.entries] == ["stiffness", *loop.fitted_along] and "cable_offset" in loop.fitted_along
    assert loop.robot.body.material.young_modulus[0] == pytest.approx(1.25 * 300e3, rel=0.06)


LEVEL = np.array([0.0, 0.5, 1.0, 1.0, 0.5, 0.1])
ONE_EACH = np.concatenate([3.0 * np.outer(LEVEL, row) for row in np.eye(4)])
"""Inputs of four sweeps, each of which pulls a cable that no other pulls [N]."""


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_a_modulus_is_not_told_from_a_gain_of_all_cables_where_nothing_known_pulls_besides(load: float):
    weightless, truth = (arm((4, 1, 1), gravity=(0.0, 0.0, 0.0)) for _ in range(2))
    inputs, labels = sweeps(each=4)
    tip, forces = np.array([0.1, 0.0, 0.01]), {k: np.array([0.0, 0.0, -load]) for k in range(len(inputs)) if load and k % 2}
    hidden = [{"name": "stiffness", "scale": 1.25}]
    recording, _ = record(inputs, labels=labels, truth=truth, effects=hidden, forces={k: (tip, f) for k, f in forces.items()})
    known = {
        "load_frame": np.array(list(forces)),
        "load_points": np.tile(tip, (len(forces), 1)),
        "load_forces": np.array(list(forces.values())),
    }
    loop = improve(weightless, [replace(recording, **known) if forces else recording], effects=["cable_gain", "cable_friction"])
    said = "; not distinguished from cable_gain)" in loop.sentence
    assert [e.name for e in loop.effects] == ["stiffness"] and said == (not load)
    assert loop.next_experiment.startswith("hang a known weight") == (not load)


def test_what_only_held_out_data_show_is_said():
    """Nothing that is fitted drives the last cable: only what is held out tells that it pulls less than it is told."""
    labels, hidden = [f"s{k // 6}" for k in range(24)], [{"name": "cable_gain", "scale": {"right": 0.6}}]
    fitted, held = (
        record(ONE_EACH[rows], effects=hidden, labels=labels[rows], truth=arm((4, 1, 1)))[0]
        for rows in (slice(18), slice(18, 24))
    )
    loop = improve(arm((4, 1, 1)), [fitted], validation=[held], effects=["cable_gain", "cable_friction"])
    assert loop.verdict == "unexplained" and loop.left.held_out
    assert "Held-out data have a larger residual than fitted data, most in frame" in loop.sentence
    assert loop.left.worst_frame.frame in (2, 3) and loop.left.rms_m > 3 * loop.noise_m


def test_where_each_sweep_pulls_a_cable_of_its_own_a_quarter_of_its_frames_is_held_out():
    labels = [f"s{k // 6}" for k in range(24)]
    recording, _ = record(
        ONE_EACH, effects=[{"name": "cable_gain", "scale": {"right": 0.8}}], labels=labels, truth=arm((4, 1, 1))
    )
    train, held, how = hold_out(recording, np.arange(24))
    assert how == f"{len(held)} of 24 frames (each sweep has inputs that no other has)" and set(train) | set(held) == set(
        range(24)
    )
    assert {int(k) // 6 for k in held} == {0, 1, 2, 3} and len(held) == 8 and not set(train) & set(held)
    np.testing.assert_array_equal(recording.inputs[train].max(axis=0), recording.inputs.max(axis=0))
    loop = improve(arm((4, 1, 1)), [recording], effects=["cable_gain", "cable_friction"])
    assert loop.verdict == "effects" and found(loop, "cable_gain").parameters["scale"].value["right"] == pytest.approx(
        0.8, abs=0.02
    )


def test_what_is_taken_away_by_what_nobody_names_is_left():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "stiffness", "scale": 1.25}], labels=labels, truth=arm())
    loop = improve(arm(), [recording], options=ImproveOptions(thresholds=replace(DEFAULTS, significant=1e9)))
    assert loop.verdict == "unexplained" and not loop.effects
    assert loop.left.rms_m > 0.8 * loop.before.train_rms_m > 5.0 * loop.noise_m  # but for the error of the mesh
    assert loop.left.structure.significant and loop.evidence.tests.after.structure.significant


def test_what_has_evidence_and_makes_the_held_out_error_larger_is_said_and_not_handed_back():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "cable_friction", "coefficient": 0.25}], labels=labels, truth=arm((4, 1, 1)))
    strict = replace(DEFAULTS, not_worse=0.0)
    loop = improve(arm((4, 1, 1)), [recording], effects=["cable_friction"], options=ImproveOptions(thresholds=strict))
    assert not loop.effects and loop.robot is loop.declared
    assert "evidence for cable_friction" in loop.sentence and "discretisation error is" in loop.sentence
    assert loop.verdict == "unexplained" and "no effect that passes the tests fits" in loop.sentence


def test_an_effect_whose_states_do_not_converge_again_is_taken_back():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "cable_friction", "coefficient": 0.25}], labels=labels, truth=arm((4, 1, 1)))
    data = prepare(arm((4, 1, 1)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, Noise({"white": 1e-4}, ""), np.zeros(len(prior.mean)))
    named = RefitRecord("cable_friction", {}, NAMED, step=1)
    course = SearchProgress(
        data, data, base, [("", base), ("cable_friction", base)], 1, base, base, ["cable_friction"], False, [named]
    )
    assert course.found == 1
    course.take_back(DataError("no equilibrium in frame 3"))
    assert course.over and not course.found and course.fitted is base and [name for name, _ in course.history] == [""]
    assert "no equilibrium in frame 3" in course.refits[0].verdict and not course.refits[0].is_named


def test_where_nothing_explains_what_is_left_effects_are_sought_again_from_the_first_model():
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    wave = 4e-3 * np.sin(1.7 * recording.marker_frame + recording.marker_index)  # no effect of the list, and no noise either
    off = replace(recording, marker_xyz=recording.marker_xyz + wave[:, None] * np.array([0.0, 0.6, 0.8]), marker_noise_m=1e-4)
    told: list[str] = []
    soon = ImproveOptions(thresholds=replace(DEFAULTS, lacks=0.3))  # less than any weights leave
    loop = improve(arm((4, 1, 1)), [off], effects=["cable_friction", "payload"], progress=told.append, options=soon)
    assert any(text.startswith("no effect fits the residual") for text in told)
    assert loop.verdict == "unexplained" and not [e for e in loop.effects if e.name in ("cable_friction", "payload")]
    assert loop.noise_m < 2e-4 and loop.model_error is not None and loop.model_error.held_out_m > 1e-3


def test_a_search_that_begins_again_keeps_what_was_tried_and_takes_other_weights():
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    data = prepare(arm((4, 1, 1)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, Noise({"white": 1e-4}, ""), np.zeros(len(prior.mean)))
    named = RefitRecord("cable_friction", {}, NAMED, step=1)
    history = [("", base), ("cable_friction", base)]
    course = SearchProgress(data, data, base, history, 1, base, base, ["cable_friction"], False, [named], over=True)
    weights = Noise({"white": 5e-3}, "", assumed=1e-4)
    course.begin_again(data, weights)
    assert not course.over and not course.found and course.noise is weights and course.holds_error
    assert not course.outweighed[0].is_named and "repeated with weights" in course.outweighed[0].verdict


def test_a_model_that_lacks_nothing_is_told_so():
    inputs, labels = sweeps()
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), noise=2e-4)
    loop = improve(arm((4, 1, 1)), [recording])
    assert loop.verdict == "none"
    assert not loop.effects
    assert loop.noise_m == pytest.approx(2e-4 * np.sqrt(3), rel=0.15)
    assert loop.detectable["cable_friction"].smallest["coefficient"] < 0.2
    clamp = loop.detectable[
        "base_compliance"
    ]  # a stiffness in its own unit, below which a clamp gives by what would have been seen
    assert clamp.kind == "softer_than" and (clamp.unit, *clamp.smallest) in {
        ("N/m", "stiffness_n_m"),
        ("N m/rad", "rotation_stiffness_nm_rad"),
    }
    assert all(1e-3 < value < 1e6 for value in clamp.smallest.values())


def test_a_second_round_on_the_improved_robot_finds_nothing():
    inputs, labels = sweeps()
    recording, _ = record(inputs, effects=[{"name": "stiffness", "scale": 0.8}], labels=labels, truth=arm((4, 1, 1)), noise=2e-4)
    first = improve(arm((4, 1, 1)), [recording])
    assert improve(first.robot, [recording]).verdict == "none"


def test_names_that_do_not_exist_are_refused():
    with pytest.raises(InputError, match="cable_friction"):
        improve(arm(), [record(sweeps()[0][:2])[0]], effects=["cable_frictoin"])


def test_data_without_free_markers_say_so():
    inputs, _ = sweeps()
    recording, _ = record(inputs[:4], free=False)
    with pytest.raises(DataError, match="no contact-free frame has markers or clouds"):
        improve(arm(), [recording])


def test_whole_sweeps_are_held_out_and_the_last_is_among_them():
    inputs, labels = sweeps()
    recording = make_recording(Timeline(np.arange(len(inputs)), sweep=labels), drives=Drives(list("abcd"), inputs))
    fit, held, _ = hold_out(recording, np.arange(len(inputs)))
    assert not {labels[k] for k in fit} & {labels[k] for k in held}
    assert labels[-1] in {labels[k] for k in held}


def test_what_is_held_out_does_not_depend_on_the_order_of_sweeps():
    inputs, labels = sweeps()

    def held(order: np.ndarray) -> set[str]:
        recording = make_recording(
            Timeline(np.arange(len(inputs)), sweep=[labels[k] for k in order]), drives=Drives(list("abcd"), inputs[order])
        )
        return {labels[order[k]] for k in hold_out(recording, np.arange(len(inputs)))[1]}

    shuffled = np.concatenate([np.flatnonzero(np.array(labels) == name) for name in ("down", "up-left", "right", "left", "up")])
    assert held(np.arange(len(inputs))) == held(shuffled)


def test_a_sweep_that_is_a_repetition_is_not_held_out_where_another_can_be_spared():
    def held(*sweeps: list[list[float]]) -> set[int]:
        names = [str(i) for i, rows in enumerate(sweeps) for _ in rows]
        inputs = np.concatenate([np.asarray(rows) for rows in sweeps])
        recording = make_recording(Timeline(np.arange(len(inputs)), sweep=names), drives=Drives(["a", "b"], inputs))
        return {int(names[k]) for k in hold_out(recording, np.arange(len(inputs)))[1]}

    one, both, other = ([[0.0, 0.0], x, [0.0, 0.0]] for x in ([2.0, 0.0], [2.0, 2.0], [0.0, 2.0]))
    assert held(one, both, other) == {2}
    assert held(one, other, both, both) == {1}  # `both` drives as far
    assert held(one, other, other) == {2}  # nothing drives the first one but `one`


def test_what_only_one_sweep_shows_is_not_held_out_where_another_can_be_spared():
    """A gain of a cable that is driven far in held-out sweeps alone would not be seen."""
    tops = [[2.0, 0.0], [0.5, 1.0], [0.0, 2.0], [1.0, 0.5], [2.0, 0.1], [0.0, 2.0]]
    inputs = np.array([row for top in tops for row in ([0.0, 0.0], top)])

    def held(loads: LoadRows | None = None, gravity: np.ndarray | None = None) -> set[int]:
        timeline = Timeline(np.arange(12), sweep=[str(k // 2) for k in range(12)], gravity=gravity)
        recording = make_recording(timeline, drives=Drives(["a", "b"], inputs), loads=loads)
        return {k // 2 for k in hold_out(recording, np.arange(12))[1].tolist()}

    assert held() == {3, 4}  # evenly spread: 2 and 5, which are the same
    assert held(LoadRows([3, 7], np.zeros((2, 3)), [[0, 0, -0.5], [0, 0, -1.0]])) == {1, 4}
    turned = np.tile([0.0, 0.0, -9.81], (12, 1))
    turned[6:8] = [0.0, -9.81, 0.0]
    assert held(gravity=turned) == {1, 4}
    inputs[[3, 7]] = 0.0, 0.0
    assert held() == {4}


def test_repeated_sweeps_of_many_states_tell_effects_apart():
    def data(levels: list[float]) -> SimpleNamespace:
        inputs = np.array([[v] for v in levels * 2])
        recording = make_recording(Timeline(np.arange(len(inputs))), drives=Drives(["a"], inputs))
        fitted, held = np.split(np.arange(len(inputs)), 2)
        return SimpleNamespace(
            **{
                n: [SimpleNamespace(scene=SimpleNamespace(recording=recording, frames=f))]
                for n, f in (("train", fitted), ("held", held))
            },
            thresholds=DEFAULTS,
        )

    tells_apart = distinguishes_effects
    assert tells_apart(data([0.0, 1.0, 2.0, 3.0, 4.0]))
    assert not tells_apart(data([0.0, 1.0]))


def test_without_labels_a_sweep_is_an_excursion_from_rest():
    inputs = np.array([[0.0], [1.0], [0.0], [2.0], [1.0], [0.0], [1.0]])
    recording = make_recording(Timeline(np.arange(7)), drives=Drives(["a"], inputs))
    assert sweeps_of(recording, np.arange(7)).tolist() == [0, 0, 1, 1, 1, 2, 2]


def test_the_components_of_the_noise_are_distinguished():
    rng = np.random.default_rng(3)
    frames, markers = 40, 12
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    groups = Groups(marker, frame, frame // 8, np.arange(frames * markers))
    residual = (
        1e-4 * rng.normal(size=(frames * markers, 3))
        + 3e-4 * rng.normal(size=(markers, 3))[marker]
        + 2e-4 * rng.normal(size=(frames, 3))[frame]
    )
    none = np.zeros((frames * markers, 3, 0))
    noise = estimate_noise([residual], [np.ones((frames * markers, 3, 1)) * 1e-6], [none], [groups])
    assert noise.std["white"] == pytest.approx(1e-4, rel=0.1)
    assert noise.std["marker"] == pytest.approx(3e-4, rel=0.4)
    assert noise.std["frame"] == pytest.approx(2e-4, rel=0.3)
    white = whiten(noise.whitener(groups), residual)
    assert white.std() == pytest.approx(1.0, rel=0.1)


def test_a_later_estimate_of_the_noise_begins_at_the_one_before():
    rng = np.random.default_rng(3)
    frames, markers = 20, 6
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    groups = Groups(marker, frame, frame // 5, np.arange(frames * markers))
    residual = 1e-4 * rng.normal(size=(frames * markers, 3)) + 2e-4 * rng.normal(size=(frames, 3))[frame]
    given = [residual], [np.full((frames * markers, 3, 1), 1e-6)], [np.zeros((frames * markers, 3, 0))], [groups]
    first = estimate_noise(*given)
    near = np.log([first.std[name] for name in ("white", "frame")])
    begun = starting_points(("white", "frame"), 2.2e-4, 0.0, near)
    np.testing.assert_allclose(begun[0], near)
    assert (begun[1] >= near).all() and not any(
        np.allclose(s, near) for s in starting_points(("white", "frame"), 2.2e-4, 0.0, None)
    )
    again = estimate_noise(*given, before=first.std)
    for name in ("white", "frame"):
        assert again.std[name] == pytest.approx(first.std[name], rel=0.05)


def test_whitening_inverts_the_covariance():
    groups = Groups(np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]), np.zeros(4, int), np.array([0, 1, 0, 1]))
    noise = Noise({"white": 0.5, "frame": 0.3, "state": 0.2}, "")
    rows = whiten(noise.whitener(groups), np.repeat(np.eye(4)[:, None, :], 3, axis=1))  # (12, 4): one block an axis
    one_axis = rows.reshape(4, 3, 4)[:, 0]
    np.testing.assert_allclose(one_axis.T @ one_axis, np.linalg.inv(noise.covariance(groups)), rtol=1e-10)


@pytest.mark.parametrize("hidden", [{"name": "stiffness", "scale": 1.25}, {"name": "cable_friction", "coefficient": 0.15}])
def test_what_one_pull_without_unloading_cannot_tell_from_a_modulus_is_said_with_it(hidden: dict[str, Any]):
    weightless = arm((4, 1, 1), gravity=(0.0, 0.0, 0.0))
    inputs = np.outer(np.linspace(0.0, 2.0, 9), [1.0, 0.0, 0.0, 0.0])
    recording, _ = record(inputs, effects=[hidden], truth=weightless, noise=3e-4)
    loop = improve(weightless, [recording], effects=["cable_friction", "cable_gain"])
    assert [e.name for e in loop.effects] == ["stiffness"]
    pairs = [set(c.pair) for c in loop.confounded if c.absorbed_share is not None]
    assert pairs == [{"stiffness", "cable_friction"}, {"stiffness", "cable_gain"}]


def test_noise_that_no_camera_has_is_said():
    data = SimpleNamespace(robot=arm((4, 1, 1)), thresholds=DEFAULTS)
    assert by_noise(data, Repeatability(1e-3, 3, True, "")) == ""
    assert "Noise of 3.5 mm on a body of 100 mm is larger than that of any camera" in by_noise(
        data, Repeatability(2e-3, 3, True, "")
    )


def test_a_nuisance_is_named_only_beyond_the_deviations_that_are_reported():
    terms = ((SimpleNamespace(name="stiffness"), {}, (None,)), (SimpleNamespace(name="cable_offset"), {}, (None, None)))
    fitted = SimpleNamespace(
        fit=SimpleNamespace(hypothesis=SimpleNamespace(terms=terms), coordinates=np.array([0.09, 0.0, -0.4]))
    )
    assert is_significant(fitted, "stiffness", np.array([0.029]), DEFAULTS) and not is_significant(
        fitted, "stiffness", np.array([0.031]), DEFAULTS
    )
    assert is_significant(fitted, "cable_offset", np.array([0.1, 0.1]), DEFAULTS) and not is_significant(
        fitted, "cable_offset", np.array([0.1, 0.2]), DEFAULTS
    )
