"""Many recordings: what their normal equations add up to is the joint fit of all of them, whoever computes them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache, partial, reduce
from operator import add
from pathlib import Path

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.io.recording_folder import load_recording, save_recording
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import fit_model, keeping, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.normal_equations import NormalEquations
from femsense.loop.improve import ImproveOptions, improve, search_recordings
from femsense.loop.search.all_recordings import (
    Question,
    asked_elsewhere,
    asked_here,
    in_all_recordings,
    normal_equations,
    recordings_to_search,
)
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.screening import screen_model
from femsense.loop.thresholds import DEFAULTS, Effort
from femsense.many.engines import open_engine, spread
from femsense.model.effects import FORMS
from femsense.model.recording import Recording
from femsense.model.robot import Robot

NOISE = Noise({"white": 2e-4}, "known")
GAIN = ({"name": "cable_gain", "scale": {"up": 0.8}},)


@cache
def body() -> Robot:
    return arm((4, 1, 1))


@cache
def recordings(count: int = 5) -> tuple[Recording, ...]:
    """Return recordings of different pulls on cables that are never slack, each with noise of its own."""
    made = []
    for i in range(count):
        inputs, labels = sweeps(1.0 + 0.4 * i, each=2)
        made.append(record(inputs + 0.5, labels=labels, effects=GAIN, seed=i, truth=body())[0])
    return tuple(made)


def asked(some: Iterable[Recording], coordinates: np.ndarray, names: tuple[str, ...] = ()) -> Question:
    data = prepare(body(), list(some), [])
    hypothesis, _ = with_nuisance(data)
    return Question(body(), hypothesis, coordinates, NOISE, data.placement_std, None, False, names, DEFAULTS)


def test_a_fit_of_some_with_the_normal_equations_of_the_others_is_the_joint_fit_of_all() -> None:
    every, some = prepare(body(), recordings(), []), prepare(body(), recordings()[:2], [])
    hypothesis, prior = with_nuisance(every)
    joint = fit_model(every, hypothesis, prior, NOISE, np.zeros(len(prior.mean))).fit
    at, made = np.zeros(len(prior.mean)), None
    for _ in range(3):
        question = replace(asked(recordings()[:2], at), placement_std=every.placement_std)
        total = reduce(add, (normal_equations(question, r) for r in recordings()[2:]))
        made = fit_model(some, hypothesis, replace(prior, others=total.rows(at)), NOISE, at).fit
        at = made.coordinates
    assert made is not None and total.count == 3
    alone = fit_model(some, hypothesis, prior, NOISE, np.zeros(len(prior.mean))).fit
    assert (np.abs(made.coordinates - joint.coordinates) < 0.2 * joint.std).all()  # to which the joint fit is carried
    assert made.std == pytest.approx(joint.std, rel=0.02)
    assert (alone.std > 1.1 * joint.std).all()


def test_an_effect_has_the_score_in_added_up_blocks_that_it_has_in_the_joint_screening() -> None:
    every = prepare(body(), recordings(), [])
    hypothesis, prior = with_nuisance(every)
    joint = fit_model(every, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    table = screen_model(every, joint.fit, NOISE, fields_of(every, joint, ["cable_gain"]), 100.0)
    question = replace(asked(recordings(), joint.fit.coordinates, ("cable_gain",)), placement_std=every.placement_std)
    total = reduce(add, (normal_equations(question, r) for r in recordings()))
    gains = []
    for key in total.candidates:
        _, offset = total.beside(key, 1.0 / prior.std**2)
        gains.append(float(offset @ offset))
    assert max(gains) == pytest.approx(max(c.gain for c in table), rel=0.05)


def test_what_is_still_is_held_where_it_is() -> None:
    some = prepare(body(), recordings()[:2], [])
    hypothesis, prior = with_nuisance(some)
    total = normal_equations(asked(recordings()[:2], np.zeros(len(prior.mean))), recordings()[3])
    made = fit_model(
        some, hypothesis, replace(prior, others=total.rows(np.zeros(len(prior.mean)))), NOISE, np.zeros(len(prior.mean))
    )
    less = keeping(some, made, ["stiffness"], NOISE)
    rows = less.fit.prior.others
    assert rows is not None and rows.matrix.shape[1] == 1 and less.fit.chi2 >= made.fit.chi2 - 1e-9
    same = Prior(less.fit.prior.mean, less.fit.prior.std, rows)
    assert rows.at(np.zeros(1)) == pytest.approx(made.fit.prior.others.at(np.zeros(len(prior.mean)))) and same.others is rows


def test_the_recordings_that_are_searched_differ_most_and_are_all_where_there_are_few() -> None:
    few, none = recordings_to_search(recordings(), 5)
    assert len(few) == 5 and none == []
    some, others = recordings_to_search(recordings(), 2)
    assert [len(some), len(others)] == [2, 3] and some == [recordings()[0], recordings()[-1]]
    apart = [replace(r, session=f"day {i}") for i, r in enumerate(recordings())]
    assert recordings_to_search(apart, 2)[1] == []


def test_processes_and_this_process_say_the_same(tmp_path: Path) -> None:
    folders = []
    for i, one in enumerate(recordings()[:3]):
        save_recording(one, tmp_path / f"{i}")
        folders.append(tmp_path / f"{i}")
    loaded = [load_recording(folder) for folder in folders]
    question = asked(loaded, np.zeros(len(with_nuisance(prepare(body(), loaded, []))[1].mean)), ("cable_gain",))
    here = list(asked_here(FORMS)(question, loaded))
    with open_engine(1, None, None) as engine:
        there = list(asked_elsewhere(partial(spread, engine), FORMS, (), tmp_path)(question, loaded))
    for a, b in zip(here, there, strict=True):
        assert a.normal.tobytes() == b.normal.tobytes() and a.slope.tobytes() == b.slope.tobytes()
        assert {k: v.own.tobytes() for k, v in a.candidates.items()} == {k: v.own.tobytes() for k, v in b.candidates.items()}
    assert not list(tmp_path.glob(".question*"))


def test_improve_names_what_all_recordings_lack_from_some_of_them() -> None:
    loop = improve(body(), recordings(), effects=["cable_gain"], options=ImproveOptions(effort=replace(Effort(), recordings=3)))
    assert [e.name for e in loop.effects if e.name == "cable_gain"] == ["cable_gain"]
    assert loop.everywhere is not None and (loop.everywhere.recordings, loop.everywhere.searched) == (5, 3)
    assert loop.everywhere.after_validation_rms_m < 0.8 * loop.everywhere.before_validation_rms_m
    assert "3 of 5 recordings were searched" in loop.sentence


def test_an_effect_of_the_searched_recordings_alone_is_taken_out() -> None:
    searched = [recordings()[0], recordings()[-1]]
    data, search = search_recordings(body(), searched, effects=["cable_gain"])
    inputs, labels = sweeps(1.5, each=2)
    plain, _ = record(inputs + 0.5, labels=labels, noise=0.0, truth=body())
    assert "cable_gain" in search.final.fit.hypothesis.names

    def many_like_it(question: Question, others: Iterable[Recording]) -> Iterator[NormalEquations]:
        one = normal_equations(question, plain)
        yield replace(one, normal=5000 * one.normal, slope=5000 * one.slope, chi2=5000 * one.chi2)

    found = in_all_recordings(data, search, [plain], ["cable_gain"], many_like_it, lambda text: None)
    assert "cable_gain" not in found.final.fit.hypothesis.names and [name for name, _ in found.history] == [""]
    assert any(r.verdict.startswith("too little evidence in all recordings") for r in found.refits)
    assert found.everywhere is not None and "cable_gain" in found.everywhere.dbic
