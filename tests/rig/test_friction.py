"""The rig's own friction: closed forms of the capstan, sticking, and agreement with the estimator's rule."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.fem.body import tie_cable
from femsense.fem.capstan import capstan_tensions
from femsense.rig.friction import new_grip, pull

from helpers import block_mesh  # isort: skip

MU, ANGLE = 0.3, 1.1
LOSS = np.exp(-MU * ANGLE)


def _along(path: list[float], bends: list[float], mu: float = MU) -> list[list[float]]:
    grip, seen = new_grip(len(bends)), []
    for tension in path:
        behind, grip = pull(grip, tension, np.array(bends), mu)
        seen.append(behind.tolist())
    return seen


def test_pulling_loses_the_capstan_factor() -> None:
    np.testing.assert_allclose(_along([1.0, 2.0, 5.0], [ANGLE]), np.array([[1.0], [2.0], [5.0]]) * LOSS, rtol=1e-14)


def test_a_small_reversal_sticks_and_a_large_one_slides_back() -> None:
    held = 2.0 * LOSS
    seen = np.ravel(_along([2.0, 1.9, 2.0 * LOSS**2 * 1.01, 1.0, 0.5], [ANGLE]))
    np.testing.assert_allclose(seen, [held, held, held, 1.0 / LOSS, 0.5 / LOSS], rtol=1e-13)


def test_pulling_again_after_a_reversal_sticks_until_it_slides() -> None:
    seen = np.ravel(_along([2.0, 0.5, 0.6, 0.5 / LOSS**2, 2.0], [ANGLE]))
    np.testing.assert_allclose(seen, [2.0 * LOSS, 0.5 / LOSS, 0.5 / LOSS, 0.5 / LOSS, 2.0 * LOSS], rtol=1e-13)


def test_two_bends_lose_twice_and_no_friction_loses_nothing() -> None:
    np.testing.assert_allclose(_along([2.0], [0.4, 0.7]), [[2.0 * np.exp(-MU * 0.4), 2.0 * np.exp(-MU * 1.1)]], rtol=1e-14)
    np.testing.assert_allclose(_along([2.0, 0.7], [0.4, 0.7], 0.0), [[2.0, 2.0], [0.7, 0.7]], rtol=1e-14)


def test_a_cable_that_is_let_go_is_slack_and_starts_anew() -> None:
    np.testing.assert_allclose(np.ravel(_along([2.0, 0.0, 0.0, 1.0], [ANGLE])), [2.0 * LOSS, 0.0, 0.0, LOSS], rtol=1e-14)


def test_a_bend_that_opens_lets_a_stuck_cable_slide() -> None:
    behind, grip = pull(new_grip(1), 2.0, np.array([ANGLE]), MU)
    opened, _ = pull(grip, 2.0, np.array([ANGLE / 2]), MU)
    np.testing.assert_allclose(behind, 2.0 * LOSS)
    np.testing.assert_allclose(opened, 2.0 * np.sqrt(LOSS))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.0, 5.0), min_size=1, max_size=12),
    st.lists(st.floats(0.0, 1.5), min_size=3, max_size=3),
    st.floats(0.0, 0.6),
)
def test_it_agrees_with_the_estimators_rule(path: list[float], bends: list[float], mu: float) -> None:
    """Two programs of one rule: ratios in rate form here, intervals of tensions there."""
    path = [0.0 if tension < 1e-6 else tension for tension in path]
    cable = tie_cable(
        block_mesh(), "c", [[0.1, 0.015, 0.015], [0.05, 0.015, 0.03], [0.02, 0.015, 0.015]], [0.0, 0.0, 0.1], friction=mu
    )
    before = np.zeros(3)
    for tension, behind in zip(path, _along(path, bends, mu)):
        before = capstan_tensions(cable, np.array(bends)[::-1], before, tension)
        assert np.array(behind) == pytest.approx(before[::-1], abs=1e-10)
