"""The verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from arm import arm
from fitted_arm import fitted_arm

from femsense.fem.mesh import to_linear
from femsense.loop.result.records import ConfoundedPair, ModelError, NamedEffect, Value
from femsense.loop.verdict import sentences
from femsense.model.effects import find_effect
from femsense.model.remeshing import robot_on_mesh
from femsense.report.loop.text import effect_text


def budget(own: float, noise: float, *, measured: bool = True, mesh: float | None = None, note: str = "") -> ModelError:
    """Return what an error consists of, all in mm."""
    parts = (1e-3 * own, 1e-3 * own, 1e-3 * noise, measured, "", 0.0)
    return ModelError(*parts, None if mesh is None else 1e-3 * mesh, note)


def said(verdict: str, error: float, parts: ModelError, effects: Sequence[NamedEffect] = ()) -> str:
    """Return the sentence on top for a held-out error [mm]."""
    fitted = replace(fitted_arm(arm((4, 2, 2)), 1.0)[1], held_rms=1e-3 * error)
    return sentences.verdict_in_words(verdict, list(effects), [], fitted, fitted, parts)


def test_how_much_of_the_error_is_the_model_s_own_is_said_first() -> None:
    sentence = said("unexplained", 8.9, budget(8.8, 0.2))
    assert sentence == (
        "A residual remains that no known effect fits: held-out error 8.90 mm, of which 8.80 mm is model error and 0.20 mm noise."
    )
    stiff = NamedEffect("stiffness", {"scale": Value(0.8, 0.02, "1")}, 1.0, 1.0)
    sentence = said("unexplained", 8.9, budget(8.8, 0.2), [stiff])
    assert "8.90 mm after, of which 8.80 mm is model error and 0.20 mm noise. A residual remains" in sentence
    assert "about 0.20 mm (assumed: no state repeats) noise" in said("effects", 8.9, budget(8.8, 0.2, measured=False), [stiff])
    assert "0.20 mm noise, 0.30 mm discretisation." in said("effects", 8.9, budget(8.8, 0.2, mesh=0.3), [stiff])
    assert said("effects", 8.9, budget(8.8, 0.2, note="it is huge"), [stiff]).endswith(
        "discretisation error is unknown: it is huge."
    )


def test_an_effect_is_followed_by_those_that_the_data_do_not_distinguish_from_it() -> None:
    fitted = fitted_arm(arm((4, 2, 2)), 1.0)[1]
    effects = [
        NamedEffect("stiffness", {"scale": Value(0.8, 0.02, "1")}),
        NamedEffect("density", {"scale": Value(0.7, 0.02, "1")}),
    ]
    pairs = [ConfoundedPair(("payload", "density"), dbic_gap=4.0), ConfoundedPair(("stiffness", "density"), dbic_gap=1.0)]
    sentence = sentences.verdict_in_words("effects", effects, [], fitted, fitted, budget(0.0, 0.2), pairs)
    assert sentence.startswith(
        "The model lacks stiffness (scale 0.8), density (scale 0.7; not distinguished from payload); held-out error"
    )
    errs = [ConfoundedPair(("payload", "density"), dbic_gap=74.0)]  # by far, if the model were right
    sentence = sentences.verdict_in_words("effects", effects[1:], [], fitted, fitted, budget(0.0, 0.2), errs)
    assert "density (scale 0.7; by the model error may stand for payload);" in sentence
    assert effect_text(effects[1], ["payload"]).startswith("density or payload: these data do not distinguish them\n")
    assert effect_text(effects[0]).startswith("stiffness\n")


@pytest.mark.parametrize("error, mesh, expected", [(0.5, None, False), (0.5, 1.0, False), (0.9, 1.0, True)])
def test_where_the_data_are_explained_by_what_the_mesh_costs_the_sentence_says_so(
    error: float, mesh: float | None, expected: bool
) -> None:
    sentence = said("none", error, budget(0.0, 0.5, mesh=mesh))
    assert ("its discretisation error (1.00 mm" in sentence) == expected and "noise (0.50 mm)" in sentence


@pytest.mark.parametrize("mesh, costs", [(None, "noise."), (0.3, "noise; the discretisation error is 0.30 mm.")])
def test_what_neither_the_noise_nor_the_mesh_explains_is_not_said_to_be_explained(mesh: float | None, costs: str) -> None:
    sentence = said("none", 0.9, budget(0.7, 0.5, mesh=mesh))
    assert sentence.startswith(
        "No effect that was tried improves the fit: held-out error 0.90 mm, of which 0.70 mm is model error"
    )
    assert sentence.endswith(f"0.50 mm {costs}")


def test_what_is_found_and_not_sure_is_said_apart_from_what_is_worse_on_held_out_data() -> None:
    data, _ = fitted_arm(arm((4, 2, 2)), 1.0)
    sentence = sentences.evidence_for(data, ["payload", "gravity"], ["payload"])
    assert "payload would improve the fit, but no value is significant" in sentence
    assert "There is evidence for gravity," in sentence and sentences.evidence_for(data, [], []) == ""


def test_values_are_said_in_short_whatever_they_are() -> None:
    values = {
        "center_m": Value([0.0151, -1.4e-19, -0.0264], None, "m"),
        "share": Value(0.24567, 0.1, "1"),
        "markers": Value(["Base-1", "Base-2"], None, "1"),
        "scale": Value({"a": 0.9, "b": [0.0, 0.0]}, None, "1"),
    }
    assert (
        sentences.values_in_words(values)
        == "center_m [0.0151, 0, -0.0264] m, share 0.246, markers [Base-1, Base-2], scale a 0.9, b [0, 0]"
    )


@pytest.mark.parametrize("linear, named", [(True, True), (False, True), (True, False)])
def test_effects_that_are_named_on_linear_elements_may_stand_for_these(linear: bool, named: bool) -> None:
    robot = arm((4, 2, 2))
    data, fitted = fitted_arm(robot_on_mesh(robot, to_linear(robot.body.mesh)) if linear else robot, 1.0)
    settled = ((find_effect("hyperelastic"), {}),) if named else ()
    back = replace(fitted, fit=replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, settled=settled)))
    trials = [replace(t, mesh_error=np.full((len(t.scene.frame), 3, 1), 1e-3)) for t in data.train]
    data = replace(data, train=trials)
    assert ("also try discretisation" in sentences.on_linear(data, back, [], 0.1e-3)) == (linear and named)
    assert ("also try discretisation" in sentences.on_linear(data, back, ["stiffness"], 0.1e-3)) == linear
    assert ("also try discretisation" in sentences.on_linear(data, back, ["stiffness"], 0.1)) == (linear and named)
