"""How far the size of a force may be off, from the covariance of its components."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from femsense.sensing.tracks import size_std, tracked
from femsense.sensing.types import ContactForce


@pytest.mark.parametrize("across", [0.0, 0.02, 0.05])
def test_the_deviation_of_a_size_is_that_of_drawn_forces(across: float) -> None:
    force = np.array([0.0, 0.2, 0.0])
    covariance = np.diag([across**2, 0.005**2, 0.0])
    drawn = force + np.random.default_rng(0).normal(size=(200000, 3)) * np.sqrt(np.diag(covariance))
    off = np.linalg.norm(drawn, axis=1) - 0.2
    assert size_std(force, covariance) == pytest.approx(np.sqrt((off**2).mean()), rel=0.08)


def test_a_force_that_is_little_beside_its_deviation_claims_no_more_than_that() -> None:
    assert size_std(np.array([1e-4, 0.0, 0.0]), np.diag([1e-8, 0.04**2, 0.0])) <= 0.05


@pytest.mark.parametrize(
    ("in_space", "on_body", "is_same"),
    [
        pytest.param(0.001, 0.001, True, id="still"),
        pytest.param(0.05, 0.001, True, id="the body moved with the contact"),
        pytest.param(0.001, 0.05, True, id="the body slid along an object that stays"),
        pytest.param(0.05, 0.05, False, id="another contact"),
    ],
)
def test_a_contact_keeps_its_track_where_it_stays_on_the_body_or_in_space(in_space: float, on_body: float, is_same: bool) -> None:
    up = np.array([0.0, 0.0, 1.0])
    now, before = (
        ContactForce(0, 0.0, 0, place * up, up, up, 1.0, 0.1, "cloud", track) for place, track in ((0.0, -1), (in_space, 4))
    )
    at, was = (SimpleNamespace(place=np.array([0.0, distance, 0.0])) for distance in (0.0, on_body))
    previous = SimpleNamespace(contacts=(before,), touches=(was,))
    (found,) = tracked([now], [at], previous, reach=0.01)
    assert found.track == (4 if is_same else -1)
