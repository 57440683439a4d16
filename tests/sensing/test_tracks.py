"""How far the size of a force may be off, from the covariance of its components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from femsense.model.contact_patch import ContactPatch
from femsense.sensing.tracks import place_std, size_std
from femsense.sensing.types import Touch


@pytest.mark.parametrize("across", [0.0, 0.02, 0.05])
def test_the_deviation_of_a_size_is_that_of_drawn_forces(across: float) -> None:
    force = np.array([0.0, 0.2, 0.0])
    covariance = np.diag([across**2, 0.005**2, 0.0])
    drawn = force + np.random.default_rng(0).normal(size=(200000, 3)) * np.sqrt(np.diag(covariance))
    off = np.linalg.norm(drawn, axis=1) - 0.2
    assert size_std(force, covariance) == pytest.approx(np.sqrt((off**2).mean()), rel=0.08)


def test_a_force_that_is_little_beside_its_deviation_claims_no_more_than_that() -> None:
    assert size_std(np.array([1e-4, 0.0, 0.0]), np.diag([1e-8, 0.04**2, 0.0])) <= 0.05


def test_a_place_that_is_held_where_it_is_seen_is_known_as_it_is_seen() -> None:
    up, at, none = np.array([0.0, 0.0, 1.0]), np.zeros(3), np.zeros((3, 3))
    seen = Touch(at, up, ContactPatch(np.array([0]), np.array([1.0])), at, 2e-3, "cloud", across_m=1e-3)
    np.testing.assert_allclose(place_std(replace(seen, std_m=0.0), none), [1e-3, 1e-3, 0.0])
    np.testing.assert_allclose(place_std(seen, 4e-6 * np.eye(3)), 2e-3)
    np.testing.assert_allclose(place_std(replace(seen, std_m=0.0, source="given"), none), 0.0)
