"""The problem of equations 10–14 and the certificate of its answers."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.qp import FrictionCone, Multipliers, Problem, build_force_problem, kkt_residuals
from femsense.qp.problem import ForceOptions


def nobody(n: int, m: int = 0, k: int = 0) -> Multipliers:
    return Multipliers(np.zeros(m), np.zeros(k), np.zeros(n))


def random_parts(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "W_forces": rng.normal(size=(12, 3)),
        "W_cables": rng.normal(size=(12, 2)),
        "free": rng.normal(size=12),
        "target": rng.normal(size=12),
    }


def test_objective_is_the_weighted_misfit_with_its_priors() -> None:
    parts, rng = random_parts(), np.random.default_rng(1)
    weights, extra, tau = rng.uniform(0.5, 2, 12), rng.normal(size=(12, 2)), np.array([0.3, np.inf])
    problem = build_force_problem(weights=weights, options=ForceOptions(ridge=0.7, nuisance=extra, nuisance_std=tau), **parts)

    def cost(x: np.ndarray) -> float:
        gap = parts["W_cables"] @ x[:2] + parts["W_forces"] @ x[2:5] + extra @ x[5:] + parts["free"] - parts["target"]
        return float(0.5 * (weights * gap**2).sum() + 0.35 * (x[2:5] ** 2).sum() + 0.5 * x[5] ** 2 / 0.09)

    for _ in range(3):
        x = rng.normal(size=7)
        assert np.isclose(0.5 * x @ problem.P @ x + problem.q @ x, cost(x) - cost(np.zeros(7)), rtol=1e-12)


def test_actuator_constraints_are_equations_13_and_14() -> None:
    parts, rng = random_parts(), np.random.default_rng(2)
    held = build_force_problem(options=ForceOptions(cable_inputs=[1.0, 2.0]), **parts)
    np.testing.assert_array_equal(held.A, np.eye(2, 5))
    np.testing.assert_array_equal(held.b, [1.0, 2.0])
    W_aa, W_af, start = rng.normal(size=(2, 2)), rng.normal(size=(2, 3)), rng.normal(size=2)
    moved = build_force_problem(
        options=ForceOptions(cable_displacements=[0.1, 0.2], W_aa=W_aa, W_af=W_af, delta_a_free=start), **parts
    )
    x = rng.normal(size=5)
    np.testing.assert_allclose(moved.A @ x - moved.b, W_aa @ x[:2] + W_af @ x[2:] + start - [0.1, 0.2], rtol=1e-12)


def test_bounds_reach_their_unknowns() -> None:
    problem = build_force_problem(
        options=ForceOptions(force_lower=0.0, force_upper=[[1, 2, 3]], tension_upper=[8, 9], nuisance=np.ones((12, 1))),
        **random_parts(),
    )
    np.testing.assert_array_equal(problem.lb, [-np.inf, -np.inf, 0, 0, 0, -np.inf])
    np.testing.assert_array_equal(problem.ub, [8, 9, 1, 2, 3, np.inf])


@pytest.mark.parametrize("sides", [4, 8, 16])
def test_the_pyramid_lies_inside_the_cone_and_touches_it(sides: int) -> None:
    rng = np.random.default_rng(3)
    normal, mu = np.array([0.3, -0.5, 0.8]), 0.4
    unit = normal / np.linalg.norm(normal)
    parts = random_parts()
    G = build_force_problem(options=ForceOptions(friction_cone=FrictionCone(normal, mu, sides)), **parts).G[:, 2:]
    forces = rng.normal(size=(4000, 3)) - 3 * unit
    pressing = -forces @ unit
    sliding = np.linalg.norm(forces + pressing[:, None] * unit, axis=1)
    allowed = (forces @ G.T <= 0).all(axis=1)
    assert (sliding[allowed] <= mu * pressing[allowed] + 1e-12).all()
    assert allowed[(pressing > 0) & (sliding < mu * np.cos(np.pi / sides) * pressing)].all()
    assert not (G @ unit <= 0).all(), "a pull is not allowed"


def test_without_friction_only_a_push_along_the_normal_is_left() -> None:
    G = build_force_problem(options=ForceOptions(friction_cone=FrictionCone([[0, 0, 1.0]], 0.0)), **random_parts()).G[:, 2:]
    assert (G @ [0, 0, -1.0] <= 1e-15).all()
    for force in ([0, 0, 1.0], [0.1, 0, -1.0], [0, -0.1, -1.0]):
        assert (G @ force > 1e-3).any()


def test_every_kind_of_violation_counts() -> None:
    problem = Problem(np.eye(1), [0.0], G=[[2.0]], h=[6.0], A=[[1.0]], b=[2.0], lb=[1.0], ub=[2.5])
    for x, violation in ((2.0, 0.0), (0.0, 2.0), (-1.0, 3.0), (4.0, 2.0), (8.0, 10.0)):
        assert kkt_residuals(problem, np.array([x]), nobody(1, 1, 1)).primal == violation
    boxed = Problem(np.eye(1), [0.0], lb=[1.0], ub=[2.5])
    assert [kkt_residuals(boxed, np.array([x]), nobody(1)).primal for x in (0.5, 2.0, 4.0)] == [0.5, 0.0, 1.5]


def test_a_certificate_of_an_optimal_point_vanishes_and_of_another_does_not() -> None:
    # min (x − 2)² + (y − 1)²,  x ≤ 1, x + y = 1.5  →  (1, 0.5), by hand: z_box = 1, y = 1
    problem = Problem(2 * np.eye(2), [-4.0, -2.0], A=[[1.0, 1.0]], b=[1.5], ub=[1.0, np.inf])
    answer = Multipliers(np.zeros(0), np.array([1.0]), np.array([1.0, 0.0]))
    right = kkt_residuals(problem, np.array([1.0, 0.5]), answer)
    assert max(right.primal, right.dual, right.gap) < 1e-15
    wrong = kkt_residuals(problem, np.array([1.1, 0.5]), answer)
    assert np.isclose(wrong.primal, 0.1) and np.isclose(wrong.dual, 0.2) and wrong.gap > 0.01


def test_a_multiplier_of_the_wrong_sign_is_no_certificate() -> None:
    problem = Problem([[1.0]], [0.0], G=[[1.0]], h=[1.0])
    assert kkt_residuals(problem, np.array([1.0]), Multipliers(np.array([-1.0]), np.zeros(0), np.zeros(1))).dual == 1.0


def test_a_multiplier_on_a_bound_that_is_not_there_is_no_certificate() -> None:
    problem = Problem([[1.0]], [1.0])
    assert kkt_residuals(problem, np.array([0.0]), Multipliers(np.zeros(0), np.zeros(0), np.array([-1.0]))).gap == np.inf


@pytest.mark.parametrize("x", [None, np.array([np.nan])])
def test_a_missing_answer_never_looks_good(x: np.ndarray | None) -> None:
    residuals = kkt_residuals(Problem([[1.0]], [1.0]), x, None if x is None else nobody(1))
    assert residuals.primal == residuals.dual == residuals.gap == np.inf


@pytest.mark.parametrize(
    "change, text",
    [
        ({"P": [[1.0, 0.2], [0.0, 1.0]]}, "P must be symmetric"),
        ({"P": [[1.0, 0.0]]}, "P must be square"),
        ({"q": [np.nan, 1.0]}, "not a vector of finite numbers"),
        ({"G": [[1.0, 1.0]]}, "h is missing"),
        ({"b": [1.0]}, "A is missing"),
        ({"A": [[1.0]], "b": [1.0]}, "not a matrix that fits"),
        ({"lb": [0.0]}, "bounds that do not fit"),
        ({"ub": [-np.inf, 0.0]}, "bounds that do not fit"),
    ],
)
def test_problems_that_do_not_fit(change: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Problem(**{"P": np.eye(2), "q": np.zeros(2), **change})


@pytest.mark.parametrize(
    "change, text",
    [
        ({"target": np.zeros(11)}, "target has the wrong length"),
        ({"W_cables": np.zeros((11, 2))}, "not a matrix that fits"),
        ({"weights": -np.ones(12)}, "negative weights"),
        ({"cable_inputs": [1.0]}, "cable_inputs has the wrong length"),
        ({"cable_inputs": [1, 2], "cable_displacements": [1, 2]}, "two statements of the cables"),
        ({"cable_displacements": [1, 2]}, "W_aa is missing"),
        ({"force_lower": [0.0, 0.0]}, "as many bounds as unknowns"),
        ({"ridge": -1.0}, "ridge must not be negative"),
        ({"friction_cone": FrictionCone(np.eye(3), 0.3)}, "a cone needs forces in three components"),
        ({"nuisance": np.ones((12, 1)), "nuisance_std": [0.0]}, "standard deviations must be positive"),
    ],
)
def test_force_problems_that_do_not_fit(change: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        given = {**random_parts(), **change}
        known = {name: given.pop(name) for name in set(given) - {"W_forces", "W_cables", "free", "target", "weights"}}
        build_force_problem(**given, options=ForceOptions(**known))


@pytest.mark.parametrize("values", [{"normals": np.zeros((1, 3)), "mu": 0.1}, {"normals": np.eye(3), "mu": -0.1}])
def test_cones_that_are_none(values: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"not normals|negative coefficient"):
        FrictionCone(**values)
