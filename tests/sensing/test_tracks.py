"""How far the size of a force may be off, from the covariance of its components."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.sensing.tracks import size_std


@pytest.mark.parametrize("across", [0.0, 0.02, 0.05])
def test_the_deviation_of_a_size_is_that_of_drawn_forces(across: float) -> None:
    force = np.array([0.0, 0.2, 0.0])
    covariance = np.diag([across**2, 0.005**2, 0.0])
    drawn = force + np.random.default_rng(0).normal(size=(200000, 3)) * np.sqrt(np.diag(covariance))
    off = np.linalg.norm(drawn, axis=1) - 0.2
    assert size_std(force, covariance) == pytest.approx(np.sqrt((off**2).mean()), rel=0.08)


def test_a_force_that_is_little_beside_its_deviation_claims_no_more_than_that() -> None:
    assert size_std(np.array([1e-4, 0.0, 0.0]), np.diag([1e-8, 0.04**2, 0.0])) <= 0.05
