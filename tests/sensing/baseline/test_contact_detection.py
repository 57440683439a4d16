"""Algorithm 2 against the text of the paper, read literally."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.core.errors import InputError
from femsense.core.pose import rotation_from_vector
from femsense.sensing.baseline.contact_detection import detect_contacts

SEEDS = st.integers(0, 2**32 - 1)


def by_the_book(others: np.ndarray, robot: np.ndarray, radius: float, enough: int, gap: float) -> list[tuple[int, np.ndarray]]:
    """Return (count, mean) of each group, by loops."""
    touching = [p for p in others if sum(np.linalg.norm(p - r) <= radius for r in robot) >= enough]
    groups: list[list[np.ndarray]] = []
    for point in touching:
        near = [g for g in groups if any(np.linalg.norm(point - other) <= gap for other in g)]
        groups = [g for g in groups if not any(g is n for n in near)] + [[point, *(p for g in near for p in g)]]
    return [(len(g), np.mean(g, axis=0)) for g in groups]


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, size=(60, 3)), rng.uniform(-1, 1, size=(150, 3))


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, enough=st.integers(1, 5))
def test_contacts_are_those_of_the_paper(seed: int, enough: int) -> None:
    others, robot = scene(seed)
    contacts = detect_contacts(others, robot, search_radius_m=0.3, min_neighbors=enough, cluster_distance_m=0.35)
    expected = by_the_book(others, robot, 0.3, enough, 0.35)
    assert sorted(contacts.counts.tolist()) == sorted(count for count, _ in expected)
    for count, mean in expected:
        row = np.argmin(np.linalg.norm(contacts.positions - mean, axis=1))
        np.testing.assert_allclose(contacts.positions[row], mean, atol=1e-12)
        assert contacts.counts[row] == count
    assert (np.diff(contacts.counts) <= 0).all()


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_contacts_move_with_the_scene_and_not_with_the_order(seed: int) -> None:
    others, robot = scene(seed)
    rng = np.random.default_rng(seed)
    options = {"search_radius_m": 0.3, "min_neighbors": 2, "cluster_distance_m": 0.3}
    contacts = detect_contacts(others, robot, **options)
    shuffled = detect_contacts(rng.permutation(others), rng.permutation(robot), **options)
    np.testing.assert_allclose(shuffled.positions, contacts.positions, atol=1e-12)
    R, shift = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
    turned = detect_contacts(others @ R.T + shift, robot @ R.T + shift, **options)
    assert turned.counts.tolist() == contacts.counts.tolist()
    expected = contacts.positions @ R.T + shift
    gaps = np.linalg.norm(turned.positions[:, None] - expected[None], axis=2)
    assert len(contacts) == 0 or gaps.min(axis=1).max() < 1e-9
    np.testing.assert_allclose(np.sort(turned.radius), np.sort(contacts.radius), atol=1e-9)


def test_a_pressed_ball_is_one_contact_where_it_touches() -> None:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.1, 0.1, (8000, 2)), np.zeros(8000)])
    ball = rng.normal(size=(3000, 3))
    ball = 0.02 * ball / np.linalg.norm(ball, axis=1)[:, None] + [0.03, -0.02, 0.021]
    contacts = detect_contacts(ball, table, search_radius_m=0.004, min_neighbors=3, cluster_distance_m=0.005)
    assert len(contacts) == 1
    np.testing.assert_allclose(contacts.positions[0, :2], [0.03, -0.02], atol=1e-3)
    assert 0.002 < contacts.radius[0] < 0.015


def test_no_contact_is_an_empty_answer() -> None:
    for others, robot in (
        (np.zeros((0, 3)), np.ones((3, 3))),
        (np.ones((3, 3)), np.zeros((0, 3))),
        (np.ones((1, 3)), np.zeros((1, 3))),
    ):
        contacts = detect_contacts(others, robot, search_radius_m=0.1, min_neighbors=1, cluster_distance_m=0.1)
        assert len(contacts) == 0 and contacts.positions.shape == (0, 3)


def test_small_groups_can_be_left_out() -> None:
    others = [[0, 0, 0], [0.001, 0, 0], [1, 0, 0]]
    options = {"search_radius_m": 0.1, "min_neighbors": 1, "cluster_distance_m": 0.01}
    assert detect_contacts(others, others, **options).counts.tolist() == [2, 1]
    assert detect_contacts(others, others, min_points=2, **options).counts.tolist() == [2]
    with pytest.raises(InputError, match="min_neighbors must be at least 1"):
        detect_contacts(others, others, search_radius_m=0.1, min_neighbors=0, cluster_distance_m=0.01)
