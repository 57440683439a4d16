"""Rigid fit and bounded Gauss–Newton: exact answers, optimality, covariance, degenerate data."""

from __future__ import annotations

import numpy as np
import pytest
from analytic import central_gradient, random_rotation
from scipy.optimize import least_squares

from femsense.calib.rigid import fit_rigid, fit_rigid_robust
from femsense.core.errors import DataError, InputError
from femsense.core.least_squares import (
    NEARLY,
    GaussNewtonOptions,
    Learning,
    Pace,
    basis_of,
    beside,
    broyden_update,
    covariance_of,
    gauss_newton,
)
from femsense.core.pose import invert_pose, make_pose, move_pose, transform_points


def pairs(seed: int, *, count: int = 8, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T_a_b and corresponding points a, b."""
    rng = np.random.default_rng(seed)
    T, b = make_pose(random_rotation(rng), rng.normal(0, 1, 3)), rng.normal(0, 0.1, (count, 3))
    return T, transform_points(T, b) + rng.normal(0, noise, (count, 3)), b


def misfit(T: np.ndarray, a: np.ndarray, b: np.ndarray, w: np.ndarray | float = 1.0) -> float:
    return float((np.asarray(w) * ((transform_points(T, b) - a) ** 2).sum(axis=1)).sum())


# Rigid


@pytest.mark.parametrize("count", [3, 4, 20])
@pytest.mark.parametrize("seed", range(3))
def test_exact_pairs_give_their_pose(seed: int, count: int) -> None:
    T, a, b = pairs(seed, count=count)
    np.testing.assert_allclose(fit_rigid(a, b), T, atol=1e-12)
    np.testing.assert_allclose(fit_rigid(b, a), invert_pose(T), atol=1e-12)


@pytest.mark.parametrize("weighted", [False, True])
def test_no_pose_nearby_fits_noisy_pairs_better(weighted: bool) -> None:
    _, a, b = pairs(5, noise=0.02)
    w = np.random.default_rng(0).uniform(0.1, 5, len(a)) if weighted else None
    T = fit_rigid(a, b, weights=w)
    slope = central_gradient(lambda step: misfit(move_pose(T, step), a, b, 1.0 if w is None else w), np.zeros(6), 1e-5)
    assert np.abs(slope).max() < 1e-8 and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_noise_averages_out() -> None:
    errors = [
        np.linalg.norm(fit_rigid(*pairs(s, count=n, noise=0.01)[1:])[:3, 3] - pairs(s, count=n)[0][:3, 3])
        for n in (10, 1000)
        for s in range(20)
    ]
    assert np.mean(errors[20:]) < 0.2 * np.mean(errors[:20])


@pytest.mark.parametrize("seed", range(10))
def test_flat_and_noisy_points_never_give_a_mirror(seed: int) -> None:
    _, a, b = pairs(seed, noise=0.05)
    b[:, 2] *= 1e-3
    R = fit_rigid(a, b)[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1.0) and np.allclose(R @ R.T, np.eye(3))


def test_mirrored_points_give_the_best_rotation() -> None:
    _, a, b = pairs(1)
    T = fit_rigid(a, b * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    rng = np.random.default_rng(0)
    others = [make_pose(R := random_rotation(rng), a.mean(axis=0) - R @ (b * [1, 1, -1]).mean(axis=0)) for _ in range(200)]
    assert misfit(T, a, b * [1, 1, -1]) <= min(misfit(other, a, b * [1, 1, -1]) for other in others)


def test_points_without_weight_do_not_count() -> None:
    T, a, b = pairs(2)
    a[0] += 5.0
    np.testing.assert_allclose(fit_rigid(a, b, weights=np.array([0.0] + [1.0] * 7)), T, atol=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "error", "text"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), DataError, "needs three points that are seen; found 2"),
        (np.outer(range(5), [1.0, 2, 3]), np.outer(range(5), [3.0, 2, 1]), DataError, "not on a line"),
        (np.zeros((4, 3)), np.zeros((4, 3)), DataError, "not on a line"),
        (np.zeros((4, 3)), np.zeros((5, 3)), InputError, "do not correspond"),
    ],
)
def test_pairs_that_give_no_pose(a: np.ndarray, b: np.ndarray, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        fit_rigid(a, b)


def test_a_robust_fit_sets_outliers_aside() -> None:
    T, a, b = pairs(3, count=12, noise=1e-4)
    a[4] += [0.05, 0.02, 0.0]
    plain = fit_rigid(a, b)
    robust, weights = fit_rigid_robust(a, b)
    assert weights.argmin() == 4 and weights[4] < 1e-3
    assert np.abs(robust - T).max() < 0.1 * np.abs(plain - T).max()


def test_four_points_cannot_say_who_is_wrong() -> None:
    _, a, b = pairs(3, count=4, noise=0.01)
    T, weights = fit_rigid_robust(a, b)
    np.testing.assert_array_equal(weights, 1.0)
    np.testing.assert_array_equal(T, fit_rigid(a, b))


# Gauss–Newton


def curve(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Return residuals of a · exp(−b t) + c at known data."""
    t = np.linspace(0, 4, 25)
    data = 2.0 * np.exp(-0.7 * t) + 0.3 + 0.01 * np.sin(37 * t)
    a, b, c = theta
    model = np.exp(-b * t)
    J = np.column_stack([model, -a * t * model, np.ones_like(t)]) / 0.01
    return (a * model + c - data) / 0.01, J if derivative else None


def test_it_finds_the_least_squares_of_scipy() -> None:
    fit = gauss_newton(curve, np.array([1.0, 0.3, 0.0]))
    wanted = least_squares(lambda x: curve(x, False)[0], [1.0, 0.3, 0.0], xtol=1e-14, ftol=1e-14)
    std = np.sqrt(np.diag(fit.covariance))
    assert fit.status == "converged" and (np.diff(fit.cost) < 0).all()
    assert (np.abs(fit.theta - wanted.x) < 1e-2 * std).all()
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(wanted.jac.T @ wanted.jac), rtol=1e-3)


@pytest.mark.parametrize(("low", "high"), [([-9, 0.9, -9], [9, 9, 9]), ([-9, -9, -9], [1.8, 9, 9]), ([-9, -9, 0.4], [9, 0.6, 9])])
def test_it_stays_within_bounds_and_is_the_best_there(low: list[float], high: list[float]) -> None:
    fit = gauss_newton(curve, np.array([1.0, 0.5, 0.5]), low=np.array(low, dtype=float), high=np.array(high, dtype=float))
    wanted = least_squares(
        lambda x: curve(x, False)[0],
        np.clip([1.0, 0.5, 0.5], np.add(low, 1e-6), np.subtract(high, 1e-6)),
        bounds=(low, high),
        xtol=1e-14,
        ftol=1e-14,
    )
    assert (fit.theta >= low).all() and (fit.theta <= high).all()
    assert fit.cost[-1] <= 2 * wanted.cost * (1 + 1e-5)


def test_a_linear_problem_takes_one_step() -> None:
    rng = np.random.default_rng(0)
    A, b = rng.normal(0, 1, (30, 4)), rng.normal(0, 1, 30)
    fit = gauss_newton(lambda x, d: (A @ x - b, A if d else None), np.zeros(4))
    np.testing.assert_allclose(fit.theta, np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-10)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(A.T @ A), rtol=1e-9)
    assert len(fit.cost) == 2


def test_a_bad_first_step_is_damped() -> None:
    evaluate = lambda x, d: (1e3 * np.arctan(x - 1.0), 1e3 * np.diag(1 / (1 + (x - 1.0) ** 2)) if d else None)  # noqa: E731
    fit = gauss_newton(evaluate, np.array([8.0]))  # plain Gauss–Newton diverges from here
    assert fit.theta[0] == pytest.approx(1.0, abs=1e-5)


def test_where_it_cannot_be_evaluated_it_steps_back() -> None:
    def evaluate(x: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        if x[0] <= 0:
            raise DataError("no equilibrium")
        return 100 * np.array([np.log(x[0]) + 2.0]), np.array([[100 / x[0]]]) if derivative else None

    assert gauss_newton(evaluate, np.array([3.0])).theta[0] == pytest.approx(np.exp(-2.0), rel=1e-4)


def test_what_the_data_do_not_see_has_no_bound_on_its_spread() -> None:
    covariance = covariance_of(np.array([[1.0, 0, 1], [2.0, 0, 2], [0.0, 0, 0]]))
    assert np.isinf(np.diag(covariance)).all()
    J = np.random.default_rng(0).normal(0, 1, (9, 3)) * [1, 1e4, 1e-4]
    np.testing.assert_allclose(covariance_of(J), np.linalg.inv(J.T @ J), rtol=1e-7)
    mixed = covariance_of(np.column_stack([J[:, 0], np.zeros(9), J[:, 1], J[:, 1]]))
    assert np.isfinite(mixed[0, 0]) and np.isinf(mixed[1, 1]) and np.isinf(mixed[2, 2]) and np.isinf(mixed[3, 3])


def counted(power: float):
    """Return an evaluation of a bent line with noise, and the list of the derivatives that it was asked for."""
    x = np.linspace(0.1, 1.0, 30)
    y = 0.7 * x**1.3 + 0.2 + 0.01 * np.sin(40 * x)
    asked: list[bool] = []

    def evaluate(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        asked.append(derivative)
        a, b, c = theta
        r = a * x ** (1 + power * b) + c - y
        J = np.column_stack([x ** (1 + power * b), a * power * np.log(x) * x ** (1 + power * b), np.ones_like(x)])
        return r, J if derivative else None

    return evaluate, asked


def test_a_jacobian_that_serves_again_ends_at_the_same_place_with_fewer_of_them() -> None:
    results, jacobians = [], []
    for serves in (0.0, 0.3):
        evaluate, asked = counted(1.0)
        results.append(
            gauss_newton(
                evaluate, np.array([0.6, 0.2, 0.1]), options=GaussNewtonOptions(serves=serves, still=1e-12, tolerance=1e-14)
            )
        )
        jacobians.append(sum(asked))
    np.testing.assert_allclose(results[1].theta, results[0].theta, atol=1e-7)
    assert results[1].status == "converged" and jacobians[1] < jacobians[0]
    evaluate, _ = counted(1.0)
    np.testing.assert_array_equal(results[1].jacobian, evaluate(results[1].theta, True)[1])  # that at the end


def test_a_jacobian_that_serves_again_learns_from_the_steps_it_predicted() -> None:
    J, step, missed = np.eye(4)[:, :3], np.array([1.0, 2.0, 0.0]), np.array([0.1, 0.0, -0.2, 0.3])
    seen = broyden_update(J, step, np.array([1.0, 3.0, 1.0]), missed)
    np.testing.assert_allclose((seen - J) @ step, missed)
    results, costs = [], []
    for learning in (Learning(), Learning(update=lambda J, *_: J)):
        evaluate, asked = counted(1.0)
        start = np.array([0.6, 0.2, 0.1])
        results.append(
            gauss_newton(evaluate, start, options=GaussNewtonOptions(serves=0.5, still=1e-09, tolerance=1e-14, learning=learning))
        )
        costs.append((len(asked), sum(asked)))
    np.testing.assert_allclose(results[0].theta, results[1].theta, atol=1e-6)
    assert costs[0][0] < costs[1][0] and costs[0][1] <= costs[1][1]


class NoPace(Pace):
    """Foretells nothing."""

    def took(self, length: float) -> None:
        pass


def test_steps_that_shrink_foretell_the_end() -> None:
    results, jacobians = [], []
    for learning in (Learning(), Learning(pace=NoPace)):
        evaluate, asked = counted(1.0)
        results.append(
            gauss_newton(
                evaluate, np.array([0.9, 1.0, 0.4]), options=GaussNewtonOptions(serves=0.3, still=0.01, learning=learning)
            )
        )
        jacobians.append(sum(asked))
    np.testing.assert_allclose(results[0].theta, results[1].theta, atol=1e-5)
    assert jacobians[0] == jacobians[1] - 1 and results[0].status == "converged"
    assert results[1].own and not results[0].own


def test_where_the_end_is_foretold_a_step_that_was_missed_asks_for_no_jacobian() -> None:
    results, jacobians = [], []
    for learning in (Learning(), Learning(pace=NoPace)):
        evaluate, asked = counted(1.0)
        fit = gauss_newton(
            evaluate, np.array([0.9, 1.0, 0.4]), options=GaussNewtonOptions(still=0.01, learning=learning)
        )  # every step is missed
        results.append(fit)
        jacobians.append(sum(asked))
    np.testing.assert_allclose(results[0].theta, results[1].theta, atol=1e-4)
    assert jacobians[0] < jacobians[1] and not results[0].own


def test_what_is_known_at_the_start_is_not_evaluated_again() -> None:
    evaluate, asked = counted(1.0)
    start = np.array([0.6, 0.2, 0.1])
    known = evaluate(start, True)
    asked.clear()
    fit = gauss_newton(evaluate, start, known=known)
    assert asked[0] is False
    plain = gauss_newton(counted(1.0)[0], start)
    np.testing.assert_array_equal(fit.theta, plain.theta)
    asked.clear()
    assert gauss_newton(evaluate, plain.theta, known=evaluate(plain.theta, True)).status == "converged" and asked == [True]


def test_a_borrowed_jacobian_never_decides_the_end() -> None:
    evaluate, asked = counted(1.0)
    start = np.array([0.6, 0.2, 0.1])
    wrong = np.zeros((30, 3))  # says that nothing can be gained
    fit = gauss_newton(evaluate, start, borrowed=wrong)
    np.testing.assert_allclose(fit.theta, gauss_newton(counted(1.0)[0], start).theta, atol=1e-9)
    assert asked[:2] == [False, True]


@pytest.mark.parametrize("borrows", [False, True])
def test_a_jacobian_that_missed_next_to_nothing_of_a_step_is_believed_at_the_end(borrows: bool) -> None:
    start, results, jacobians = np.array([0.6, 0.2, 0.1]), [], []
    for trusted, off in ((0.0, 0.0), (0.05, 0.0), (0.05, 0.2)):
        evaluate, asked = counted(0.05)  # nearly linear
        J = evaluate(start, True)[1] * (1.0 + off) if borrows else None
        asked.clear()
        results.append(
            gauss_newton(evaluate, start, borrowed=J, options=GaussNewtonOptions(serves=0.5, trusted=trusted, still=0.001))
        )
        jacobians.append(sum(asked))
    assert jacobians[1] == jacobians[0] - 1 and not results[1].own and results[0].own
    if borrows:
        assert results[2].own  # it missed a fifth
    np.testing.assert_allclose(results[1].residual, results[0].residual, atol=1e-3)


def rough_valley(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Return a residual with a jagged floor: each Jacobian promises a little, and the step brings less."""
    u, v = theta
    r = np.array([u - 3.0, 0.4 * abs(np.sin(25.0 * v)) + 0.02 * v, 0.3])
    slope = 0.4 * 25.0 * np.cos(25.0 * v) * np.sign(np.sin(25.0 * v)) + 0.02
    return r, np.array([[1.0, 0.0], [0.0, slope], [0.0, 0.0]]) if derivative else None


def test_idle_steps_end_a_fit() -> None:
    start, costs, asked = np.array([3.0, 0.74]), [], []
    borrowed = rough_valley(start, True)[1]
    for enough in (0.0, 0.06):
        seen = list[bool]()

        def evaluate(theta: np.ndarray, derivative: bool, seen: list[bool] = seen) -> tuple[np.ndarray, np.ndarray | None]:
            seen.append(derivative)
            return rough_valley(theta, derivative)

        fit = gauss_newton(evaluate, start, borrowed=borrowed, options=GaussNewtonOptions(enough=enough, still=1e-06))
        costs.append(fit.cost[-1])
        asked.append(len(seen))
        assert fit.status == "converged"
    assert asked[1] < asked[0] and costs[1] < costs[0] + 0.06
    assert asked[1] == 3  # the start and two idle ones


def test_what_is_little_is_not_told_by_the_misfit() -> None:
    def evaluate(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        x = theta[0]
        r, slope = (30.0 - 18.0 * x, -18.0) if x < 1.0 else (24.0 - 12.0 * x, -12.0)  # the first step falls short
        return np.array([40.0, r]), np.array([[0.0], [slope]]) if derivative else None

    fit = gauss_newton(evaluate, np.zeros(1), options=GaussNewtonOptions(enough=0.5))
    assert fit.cost[-1] == pytest.approx(1600.0)


@pytest.mark.parametrize("pays", [True, False])
def test_a_step_that_promises_little_by_its_own_jacobian_is_the_last(pays: bool) -> None:
    ends, asked = [], []
    for enough in (0.0, 0.5):
        seen = list[bool]()

        def evaluate(theta: np.ndarray, derivative: bool, seen: list[bool] = seen) -> tuple[np.ndarray, np.ndarray | None]:
            seen.append(derivative)
            bend = 0.5 if pays else 3.0  # of what no Jacobian tells
            u = 2.0 * theta[0]
            r, slope = np.array([theta[0] - 0.9, bend * np.sin(u) ** 2, 0.3]), 4.0 * bend * np.sin(u) * np.cos(u)
            return r, np.array([[1.0], [slope], [0.0]]) if derivative else None

        ends.append(gauss_newton(evaluate, np.zeros(1), options=GaussNewtonOptions(enough=enough, still=1e-06)))
        asked.append(seen)
    assert asked[1] == [True, False] and len(asked[0]) > 4 and ends[1].status == "converged"
    assert (ends[1].theta[0] != 0.0) == (ends[1].cost[-1] < ends[1].cost[0]) == pays


def test_a_step_that_struggles_far_from_the_end_is_not_idle() -> None:
    def evaluate(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        x, y = theta
        return np.array([10.0 * (y - x**2), 1.0 - x]), np.array([[-20.0 * x, 10.0], [-1.0, 0.0]]) if derivative else None

    fit = gauss_newton(evaluate, np.array([-1.2, 1.0]), options=GaussNewtonOptions(enough=0.3, max_iterations=200))
    assert fit.cost[-1] < NEARLY * 0.3  # short steps along the valley bring little, a whole one promised more


def test_a_fit_that_is_not_worth_it_is_given_up_before_its_own_jacobian() -> None:
    asked: list[bool] = []
    J = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])

    def evaluate(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        asked.append(derivative)
        return J @ theta + np.array([1.0, 1.0, 3.0]) + 1e-3 * np.sin(theta[0]), J if derivative else None

    start = np.zeros(2)
    for worth, status in ((8.0, "stopped early"), (10.0, "converged")):
        asked.clear()
        fit = gauss_newton(evaluate, start, borrowed=J, options=GaussNewtonOptions(serves=0.25, worth=worth))
        assert fit.status == status and any(asked) == (status == "converged")
        assert fit.cost[-1] == pytest.approx(9.0, abs=0.01)


def test_a_fit_whose_steps_promise_less_than_half_of_what_is_missing_is_given_up_with_its_own_jacobian_too() -> None:
    asked: list[bool] = []
    J = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])

    def evaluate(theta: np.ndarray, derivative: bool) -> tuple[np.ndarray, np.ndarray | None]:
        asked.append(derivative)
        return J @ theta + np.array([1.0, 1.0, 3.0]), J if derivative else None

    start = np.zeros(2)  # 11, of which a step takes 2
    fit = gauss_newton(evaluate, start, options=GaussNewtonOptions(worth=6.9))
    assert fit.status == "stopped early" and asked == [True] and fit.cost == (11.0,)
    assert (
        gauss_newton(evaluate, start, options=GaussNewtonOptions(worth=7.1)).status == "stopped early"
    )  # tried, and no better than that
    assert gauss_newton(evaluate, start, options=GaussNewtonOptions(worth=9.1)).cost[-1] == pytest.approx(9.0)


@pytest.mark.parametrize("width", [0, 1, 4])
def test_a_basis_spans_its_columns_and_tells_their_inverse(width: int) -> None:
    rng = np.random.default_rng(3)
    J = rng.normal(size=(30, width)) * 10.0 ** rng.integers(-6, 6, width)
    J = np.column_stack([J, J.sum(axis=1), np.zeros(30)])  # one that others make up, and one that nothing answers to
    Q, A = basis_of(J)
    np.testing.assert_allclose(Q.T @ Q, np.eye(width), atol=1e-9)
    np.testing.assert_allclose(J @ (A @ (Q.T @ J)), J, atol=1e-9 * np.abs(J).max(initial=0.0))
    values = rng.normal(size=(30, 2))
    left = beside(J, values)
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    np.testing.assert_allclose((J / size).T @ left, 0.0, atol=1e-9)
    np.testing.assert_allclose(beside(J, J / size), 0.0, atol=1e-9)
    np.testing.assert_allclose(beside(J, left), left, atol=1e-12)
