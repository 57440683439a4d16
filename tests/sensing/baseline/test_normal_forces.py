"""Normal forces and the truth of their standard deviations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from femsense.sensing.baseline.normal_forces import UNSEEN, normal_forces


def body(seed: int = 0, rows: int = 30, forces: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return W [m/N] and standard deviations [m] of a random body."""
    rng = np.random.default_rng(seed)
    return 1e-3 * rng.normal(size=(rows, forces)), rng.choice([1e-4, 2e-4, 5e-5], rows)


def test_exact_data_give_the_exact_forces_and_the_covariance_of_weighted_least_squares() -> None:
    W, std = body()
    forces, covariance = normal_forces(W, W @ [1.0, 0.3, 2.0], std)
    np.testing.assert_allclose(forces, [1.0, 0.3, 2.0], rtol=1e-8)
    np.testing.assert_allclose(covariance, np.linalg.inv(W.T @ np.diag(std**-2.0) @ W), rtol=1e-9)


def test_a_force_at_its_bound_has_no_spread_and_frees_the_others() -> None:
    W, std = body()
    moved = W @ [1.0, -0.5, 2.0]
    forces, covariance = normal_forces(W, moved, std)
    others, their_covariance = normal_forces(W[:, [0, 2]], moved, std)
    assert forces[1] == pytest.approx(0.0, abs=1e-12) and not covariance[1].any() and not covariance[:, 1].any()
    np.testing.assert_allclose(forces[[0, 2]], others, rtol=1e-7)
    np.testing.assert_allclose(covariance[np.ix_([0, 2], [0, 2])], their_covariance, rtol=1e-8)


def test_forces_that_no_row_tells_apart_are_uncertain_without_limit() -> None:
    W, std = body()
    alike, blind = W.copy(), W.copy()
    alike[:, 2], blind[:, 2] = W[:, 1], 0.0
    forces, covariance = normal_forces(alike, alike @ np.ones(3), std)
    assert forces[1:].sum() == pytest.approx(2.0, abs=1e-6) and covariance[0, 0] < 1.0
    assert np.diag(covariance)[1:].tolist() == [UNSEEN, UNSEEN]
    assert normal_forces(blind, blind @ np.ones(3), std)[1][2].tolist() == [0.0, 0.0, UNSEEN]


@pytest.mark.parametrize("width, share", [(1.0, 0.6827), (1.96, 0.95)])
def test_intervals_hold_the_truth_as_often_as_they_say(width: float, share: float) -> None:
    rng, hits, trials = np.random.default_rng(11), 0, 400
    for trial in range(trials):
        W, std = body(trial)
        true = rng.uniform(0.5, 2.0, 3)
        forces, covariance = normal_forces(W, W @ true + std * rng.normal(size=30), std)
        hits += abs(forces[trial % 3] - true[trial % 3]) < width * np.sqrt(covariance[trial % 3, trial % 3])
    low, high = binom.ppf([1e-3, 1 - 1e-3], trials, share)
    assert low <= hits <= high
