"""What bends of the error of a far target: the secant against a case whose second derivatives are known."""

from __future__ import annotations

import numpy as np

from femsense.control.curvature import Seen, convex, learned

BENT = np.array([[0.8, 0.3], [-0.5, -0.2], [0.1, 0.4]])
"""Of p_i(u) = (A u)_i + ½ Σ_j B_ij u_j²."""
SLOPE = np.array([[1.0, 0.2], [0.1, 0.7], [0.3, 0.3]])
WANTED = np.array([-2.0, 1.0, -1.0])


def seen(u: np.ndarray) -> Seen:
    return Seen(u, SLOPE + BENT * u, WANTED - SLOPE @ u - 0.5 * BENT @ u**2)


def second_order(u: np.ndarray) -> np.ndarray:
    return np.diag(-BENT.T @ seen(u).miss)  # Σ r ∇²r with r = −miss


def test_the_step_that_was_taken_is_explained() -> None:
    last, now = seen(np.array([0.2, 0.1])), seen(np.array([0.25, 0.3]))
    found = learned(np.eye(2), last, now)
    np.testing.assert_allclose(found, found.T)
    np.testing.assert_allclose(found @ (now.effort - last.effort), -(now.points - last.points).T @ now.miss, atol=1e-12)


def test_steps_in_all_directions_show_the_second_order_part() -> None:
    u, rng, found = np.array([0.2, 0.1]), np.random.default_rng(1), np.zeros((2, 2))
    for _ in range(40):
        step = 1e-3 * rng.normal(size=2)
        found, u = learned(found, seen(u), seen(u + step)), u + step
    np.testing.assert_allclose(found, second_order(u), atol=0.05 * np.abs(second_order(u)).max())


def test_a_step_of_nothing_shows_nothing_and_what_curves_down_is_left_out() -> None:
    here = seen(np.array([0.2, 0.1]))
    np.testing.assert_array_equal(learned(np.eye(2), here, here), np.eye(2))
    np.testing.assert_allclose(convex(np.diag([2.0, -1.0])), np.diag([2.0, 0.0]), atol=1e-15)
