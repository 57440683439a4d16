"""What a sum of squares is near a point: curvature that steps have shown, with nonsmooth lines and bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from femsense.core.least_squares import GaussNewtonOptions, Learning, gauss_newton
from femsense.core.local_model import LEAST, Curvature, LocalModel, Nonsmoothness, with_curvature


def circle(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Return how far a point on a circle, and a length, are from where they are wanted: the point inside,
    so that much is left."""
    x, y = theta
    on, along = np.array([np.cos(x), np.sin(x)]), np.array([-np.sin(x), np.cos(x)])
    r = np.append(10.0 * ((1 + 0.02 * y) * on - [0.1, 0.2]), 3.0 * (y - 0.1))
    J = np.vstack([10.0 * np.column_stack([(1 + 0.02 * y) * along, 0.02 * on]), [0.0, 3.0]])
    return r, J if derivative else None


def curved_line(seed: int):
    """Return an evaluation whose Jacobian is linear in θ, and its second derivatives by row, shape (40, 4, 4)."""
    rng = np.random.default_rng(seed)
    A, Q, b = rng.normal(size=(40, 4)), 0.1 * rng.normal(size=(40, 4, 4)), rng.normal(size=40)
    Q = Q + np.swapaxes(Q, 1, 2)

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return A @ x + 0.5 * np.einsum("ipq,p,q->i", Q, x, x) - b, A + Q @ x

    return evaluate, Q


class Given(Curvature):
    """A curvature that is given and never learns; it notes whether it is believed after each step."""

    def __init__(self, S: np.ndarray | None, noted: list[bool]) -> None:
        super().__init__()
        self.S, self.noted = S, noted

    def learn(self, *_: object) -> None:
        pass

    def judge(self, near: LocalModel, step: np.ndarray, gain: float) -> None:
        super().judge(near, step, gain)
        self.noted.append(self.believed)


def given(S: np.ndarray | None, noted: list[bool] | None = None) -> Learning:
    return Learning(curvature=lambda: Given(S, [] if noted is None else noted))


def test_where_much_is_left_a_bent_way_takes_few_steps() -> None:
    steps = []
    for learning in (Learning(), given(None)):
        fit = gauss_newton(
            circle,
            np.array([-0.5, 0.0]),
            options=GaussNewtonOptions(max_iterations=100, still=1e-06, tolerance=1e-14, learning=learning),
        )
        assert fit.status == "converged" and fit.theta[0] == pytest.approx(np.arctan2(0.2, 0.1), abs=1e-4)
        steps.append(len(fit.cost))
    assert steps[0] < 0.2 * steps[1]


def test_it_is_exact_along_the_last_step_and_symmetric() -> None:
    evaluate, Q = curved_line(0)
    curvature, points = Curvature(), np.random.default_rng(1).normal(size=(3, 4))
    for x in points:
        curvature.learn(x, *evaluate(x), None)
    S, step = curvature.S, points[2] - points[1]
    assert S is not None
    np.testing.assert_allclose(S, S.T, atol=1e-12)
    np.testing.assert_allclose(S @ step, np.einsum("i,ipq->pq", evaluate(points[2])[0], Q) @ step, atol=1e-9)
    curvature.learn(points[2], *evaluate(points[2]), None)  # the same point tells nothing
    assert curvature.S is S


def test_it_is_believed_until_straight_lines_foretell_a_step_better() -> None:
    noted: list[bool] = []
    learning = given(np.array([[1.0]]), noted)
    gauss_newton(
        lambda x, d: (2.0 * (x - 1.0), np.array([[2.0]]) if d else None),
        np.zeros(1),
        options=GaussNewtonOptions(serves=1.0, learning=learning),
    )
    assert noted[0] is False  # the line is straight
    x = np.array([0.4, -0.3])
    near = LocalModel(*circle(x, True), None, np.full(2, -9.0), np.full(2, 9.0), np.diag([-50.0, 0.0]))
    curvature, step = Curvature(), np.array([0.2, 0.1])
    for gain, believed in ((near.predicted_gain(step, curved=True), True), (near.predicted_gain(step, curved=False), False)):
        curvature.judge(near, step, gain)
        assert curvature.believed == believed


def test_where_a_bent_step_fails_a_straight_one_is_tried() -> None:
    tried: list[float] = []

    def evaluate(x: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        tried.append(float(x[0]))
        return 2.0 * (x - 1.0), np.array([[2.0]]) if derivative else None

    gauss_newton(evaluate, np.zeros(1), options=GaussNewtonOptions(learning=given(np.array([[-0.8 * 4.0]]))))  # wrong
    assert tried[1:3] == pytest.approx([5.0, 1.0])


def test_units_do_not_matter() -> None:
    evaluate, _ = curved_line(2)
    points, unit = np.random.default_rng(3).normal(size=(4, 4)), np.array([1e-3, 1.0, 50.0, 1e4])
    learnt, scaled = Curvature(), Curvature()
    for x in points:
        r, J = evaluate(x)
        learnt.learn(x, r, J, None)
        scaled.learn(x * unit, r, J / unit, None)
    np.testing.assert_allclose(scaled.S * np.outer(unit, unit), learnt.S, rtol=1e-8, atol=1e-8)


def test_a_kink_that_was_crossed_is_no_curvature() -> None:
    rng = np.random.default_rng(4)
    A, W, U = rng.normal(size=(20, 2)), rng.normal(size=(20, 3)), rng.normal(size=(3, 2))

    def point(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Nonsmoothness]:
        on = U @ x >= 0
        return x, A @ x + W @ np.maximum(U @ x, 0.0), A + (W * on) @ U, Nonsmoothness(W, U @ x, U, on)

    curvature = Curvature()
    curvature.learn(*point(np.array([1.0, 0.3])))
    curvature.learn(*point(np.array([-0.7, 0.2])))
    assert np.abs(curvature.S).max() < 1e-12


@pytest.mark.parametrize("share", [0.5, -0.5, -3.0])
def test_as_much_is_left_as_asked_and_nothing_where_nothing_is_seen(share: float) -> None:
    J = np.random.default_rng(5).normal(size=(9, 4)) * [1.0, 1e3, 1e-2, 0.0]
    S = share * J.T @ J + np.diag([0.0, 0.0, 0.0, 5.0])
    scale = np.where(J.any(axis=0), np.linalg.norm(J, axis=0), 1.0)
    C = with_curvature(J, S, scale)
    np.testing.assert_allclose(C.T @ C, max(1.0 + share, LEAST) * J.T @ J, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("kinked", [False, True])
@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_step_is_the_best_there_is_and_promises_what_it_brings(kinked: bool, free: bool, damping: float) -> None:
    rng = np.random.default_rng(6)
    A, r, W, U = rng.normal(size=(30, 3)), rng.normal(size=30), rng.normal(size=(30, 2)), 0.5 * rng.normal(size=(2, 3))
    v = np.array([0.2, -0.1])
    nonsmooth = Nonsmoothness(W, v, U, v >= 0) if kinked else None
    J = A + (W * (v >= 0)) @ U if kinked else A
    S = np.diag([-12.0, 8.0, 3.0])
    wide = np.full(3, np.inf if free else 0.1)
    near = LocalModel(r, J, nonsmooth, -wide, wide, S)

    def cost(s: np.ndarray) -> float:
        return float(np.sum((r + near.change(s)) ** 2) + s @ S @ s)

    def damped(s: np.ndarray) -> float:
        return cost(s) + damping * float(np.sum((near.scale * s) ** 2))

    starts = np.random.default_rng(7).uniform(-0.1, 0.1, (20, 3))
    found = [minimize(damped, s, bounds=[(-w, w) for w in wide], method="L-BFGS-B").fun for s in starts]
    step = near.step(damping)
    assert (np.abs(step) <= wide).all() and damped(step) <= min(found) + 1e-3 * (damped(np.zeros(3)) - min(found))
    assert near.predicted_gain(step) == pytest.approx(cost(np.zeros(3)) - cost(step), rel=1e-9)
