"""The verdict in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm
from fitted_arm import fitted_arm

from femsense.fem.mesh import to_linear
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import Value
from femsense.loop.verdict import sentences
from femsense.model.effects import find_effect
from femsense.model.remeshing import robot_on_mesh


@pytest.mark.parametrize(("noise_mm", "small"), [(0.2, False), (0.4, True)])
def test_a_residual_no_larger_than_the_noise_is_said_to_be_so(noise_mm: float, small: bool) -> None:
    fitted = replace(fitted_arm(arm((4, 2, 2)), 1.0)[1], held_rms=3e-4)
    noise = Noise({"white": 1e-3 * noise_mm / np.sqrt(3.0)}, "")
    sentence = sentences.verdict_in_words("unexplained", [], [], fitted, fitted, noise, None)
    assert sentence.startswith("A residual is left that no effect of the list explains")
    assert ("no larger than the noise" in sentence) == small and f"0.30 mm, noise {noise_mm:.2f} mm" in sentence


@pytest.mark.parametrize("error, mesh, expected", [(0.5, None, False), (0.5, 1.0, False), (0.9, 1.0, True)])
def test_where_the_data_are_explained_by_what_the_mesh_costs_the_sentence_says_so(
    error: float, mesh: float | None, expected: bool
) -> None:
    _, fitted = fitted_arm(arm((4, 2, 2)), 1.0)
    fitted = replace(fitted, held_rms=1e-3 * error)
    noise = Noise({"white": 0.5e-3 / np.sqrt(3.0)}, "")
    sentence = sentences.verdict_in_words("none", [], [], fitted, fitted, noise, None if mesh is None else 1e-3 * mesh)
    assert ("its discretisation error (1.00 mm" in sentence) == expected and "noise (0.50 mm)" in sentence


def test_values_are_said_in_short_whatever_they_are() -> None:
    values = {
        "center_m": Value([0.0151, -1.4e-19, -0.0264], None, "m"),
        "share": Value(0.24567, 0.1, "1"),
        "markers": Value(["Base-1", "Base-2"], None, "1"),
        "scale": Value({"a": 0.9, "b": [0.0, 0.0]}, None, "1"),
    }
    said = sentences.values_in_words(values)
    assert said == "center_m [0.0151, 0, -0.0264] m, share 0.246, markers [Base-1, Base-2], scale a 0.9, b [0, 0]"


@pytest.mark.parametrize("mesh, costs", [(None, "0.50 mm."), (0.3e-3, "0.50 mm; the discretisation error is 0.30 mm.")])
def test_what_neither_the_noise_nor_the_mesh_explains_is_not_said_to_be_explained(mesh: float | None, costs: str) -> None:
    fitted = replace(fitted_arm(arm((4, 2, 2)), 1.0)[1], held_rms=0.9e-3)
    sentence = sentences.verdict_in_words("none", [], [], fitted, fitted, Noise({"white": 0.5e-3 / np.sqrt(3.0)}, ""), mesh)
    assert sentence == f"Nothing that was tried explains more of the data: held-out error 0.90 mm; their noise is {costs}"


@pytest.mark.parametrize("linear, named", [(True, True), (False, True), (True, False)])
def test_effects_that_are_named_on_linear_elements_may_stand_for_these(
    monkeypatch: pytest.MonkeyPatch, linear: bool, named: bool
) -> None:
    robot = arm((4, 2, 2))
    data, fitted = fitted_arm(robot_on_mesh(robot, to_linear(robot.body.mesh)) if linear else robot, 1.0)
    settled = ((find_effect("hyperelastic"), {}),) if named else ()
    back = replace(fitted, fit=replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, settled=settled)))
    monkeypatch.setattr(sentences, "mesh_error_rms", lambda data: 2e-3)
    assert ("try discretisation" in sentences.on_linear(data, back)) == (linear and named)
