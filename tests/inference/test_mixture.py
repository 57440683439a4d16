"""The mixture of robot and something else: limits, derivative, widening."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.inference.mixture import Others, Width, first_width, misfit

Z = np.linspace(-8.0, 8.0, 41)
ONES = np.ones(len(Z))


def test_without_another_explanation_the_misfit_is_chi_squared():
    total, weight = misfit(Z, np.full(len(Z), -np.inf), ONES)
    assert total == pytest.approx(float(Z @ Z)) and (weight == 1.0).all()


def test_a_row_costs_no_more_than_its_other_explanation():
    odds = np.full(1, np.log(1e-3))
    far = misfit(np.array([50.0]), odds, np.ones(1))
    assert far[0] == pytest.approx(-2.0 * np.log(1e-3)) and far[1][0] < 1e-6


def test_half_the_derivative_is_the_weighted_residual():
    """d/dz of −2 log[exp(−z²/2) + o] is 2 z times the responsibility: the step of expectation maximisation descends."""
    odds, step = np.full(len(Z), np.log(0.02)), 1e-5
    for i, z in enumerate(Z):
        one = slice(i, i + 1)
        ahead, behind = (misfit(np.array([z + s * step]), odds[one], ONES[one])[0] for s in (1.0, -1.0))
        weight = misfit(np.array([z]), odds[one], ONES[one])[1][0]
        assert (ahead - behind) / (2.0 * step) == pytest.approx(2.0 * z * weight, abs=1e-6)


def test_correlated_rows_count_less():
    odds = np.full(len(Z), np.log(0.02))
    assert misfit(Z, odds, ONES / 4.0)[0] == pytest.approx(misfit(Z, odds, ONES)[0] / 4.0)


def test_wide_noise_reaches_far_pixels_and_narrows_to_its_own():
    z = np.append(np.full(90, 12.0), np.full(10, 0.1))
    width = first_width(z, np.ones(100, dtype=bool), True, 3.0)
    assert width.pixels == pytest.approx(12.0 / 1.65) and not width.narrow
    assert first_width(z, np.ones(100, dtype=bool), False, 3.0).pixels == 3.0
    for _ in range(4):
        width = width.narrowed()
    assert width == Width() and width.narrow


def test_odds_of_something_else_are_those_of_its_side_over_a_length():
    odds = Others(0.5, 0.01).log_odds(np.full(2, 1e-3), 0.1, np.array([False, True]))
    assert np.exp(odds) == pytest.approx([0.5 * np.sqrt(2 * np.pi) * 0.01, 0.01 * np.sqrt(2 * np.pi) * 0.01])
