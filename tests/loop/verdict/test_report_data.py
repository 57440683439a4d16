"""What the report rests on: covariates, repeats, forces from residuals, the field of equivalent forces."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from femsense.loop.data.covariates import actuation_of, rank_with, unloading
from femsense.loop.result.loop_result import rounded
from femsense.loop.verdict.candidate_tables import own_size, without_first
from femsense.loop.verdict.force_impact import forces_from, smallest_field
from femsense.loop.verdict.lack_of_fit import lack_of_fit
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline

LEVELS = [0.0, 1.0, 2.0, 2.0, 1.0, 0.0, 0.0, 1.0, 2.0, 2.0, 1.0, 0.0]


def ramp(levels=LEVELS):
    return make_recording(Timeline(np.arange(len(levels)) * 1.0), drives=Drives(("top",), np.array(levels)[:, None]))


def trial(levels=LEVELS, markers=4):
    frames = np.arange(len(levels))
    scene = SimpleNamespace(
        recording=ramp(levels), frames=frames, frame=np.repeat(frames, markers), marker=np.tile(np.arange(markers), len(levels))
    )
    return SimpleNamespace(scene=scene)


def test_a_hold_keeps_the_direction_it_was_reached_in():
    assert unloading(ramp()).tolist() == [False, False, False, False, True, True, True, False, False, False, True, True]
    assert actuation_of(ramp()).tolist() == LEVELS


def test_p_values_are_adjusted_after_holm():
    rng = np.random.default_rng(0)
    values = rng.normal(size=40)
    table = {"same": values + 0.1 * rng.normal(size=40), "opposite": -values, "noise": rng.normal(size=40), "still": np.zeros(40)}
    rows = rank_with(values, table)
    assert [r.covariate for r in rows] == ["opposite", "same", "noise"] and rows[0].rank_correlation == pytest.approx(-1.0)
    by_p = sorted(rows, key=lambda r: r.p_value)
    assert [r.p_holm for r in by_p] == pytest.approx([3 * by_p[0].p_value, 2 * by_p[1].p_value, by_p[2].p_value], rel=1e-9)
    assert rank_with(values[:4], {"time": np.arange(4.0)}) == []


def test_lack_of_fit_needs_states_that_are_reached_again_the_same_way():
    rng = np.random.default_rng(1)
    noise = 1e-4 * rng.normal(size=(48, 3))
    test = lack_of_fit([trial()], [noise], 0)
    assert test is not None and 0.3 < test.f < 3.0 and test.p_value > 0.01
    assert test.df_pure == 3 * 4 * 4  # 1 and 2 upwards, 1 and 0 on the way back, each twice; the first rest has nothing before it
    assert test.pure_error_m == pytest.approx(1e-4 * np.sqrt(3), rel=0.3)
    bent = noise + np.tile(np.repeat(np.array(LEVELS[:6]) * 1e-3, 4)[:, None], (2, 1)) * [0, 0, 1]
    assert lack_of_fit([trial()], [bent], 0).p_value < 1e-6
    once = list(np.linspace(0, 1, 12))
    assert lack_of_fit([trial(once)], [noise], 0) is None


def test_a_force_comes_back_from_the_residual_it_makes():
    rng = np.random.default_rng(2)
    C = rng.normal(size=(12, 3)) * 1e-2
    force, spread = forces_from(C, C @ [0.1, -0.2, 0.3], 1e-4)
    np.testing.assert_allclose(force, [0.1, -0.2, 0.3], rtol=1e-9)
    np.testing.assert_allclose(spread, 1e-8 * np.linalg.inv(C.T @ C), rtol=1e-9)
    blind = C * [1.0, 1.0, 1e-6]
    assert abs(forces_from(blind, C @ [0.1, 0.0, 1.0], 1e-4)[0][2]) < 1e-3  # a direction that is not seen stays as declared


def test_the_field_of_equivalent_forces_leaves_the_noise():
    rng = np.random.default_rng(3)
    C, r = rng.normal(size=(12, 60)), rng.normal(size=12)
    goal = 0.2 * float(r @ r)
    field = smallest_field(C, r, goal)
    assert np.sum((C @ field - r) ** 2) == pytest.approx(goal, rel=0.02)
    smaller = smallest_field(C, r, 0.5 * float(r @ r))
    assert np.linalg.norm(smaller) < np.linalg.norm(field)


def test_projecting_in_the_gram_matrix_is_projecting_the_columns():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(30, 5))
    Q = np.linalg.qr(A[:, :2])[0]
    left = A[:, 2:] - Q @ (Q.T @ A[:, 2:])
    np.testing.assert_allclose(without_first(A.T @ A, 2), left.T @ left, atol=1e-10)


def test_sizes_in_theirown_size():
    assert own_size(np.log(1.2), "log") == pytest.approx(1.2)
    assert own_size(1e-3, "reciprocal") == pytest.approx(1000.0)
    assert own_size(0.3, "linear") == 0.3 and own_size(np.inf, "linear") is None
    assert rounded({"a": [np.float64(1 / 3), float("nan"), np.int64(2)]}) == {"a": [0.3333333, None, 2]}
