"""The certificate of answers, and problems that do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.qp import Multipliers, Problem, kkt_residuals


def nobody(n: int, m: int = 0) -> Multipliers:
    return Multipliers(np.zeros(m), np.zeros(n))


def test_every_kind_of_violation_counts() -> None:
    problem = Problem(np.eye(1), [0.0], G=[[2.0]], h=[6.0], lb=[1.0], ub=[7.0])
    for x, violation in ((2.0, 0.0), (0.0, 1.0), (-1.0, 2.0), (4.0, 2.0), (8.0, 10.0)):
        assert kkt_residuals(problem, np.array([x]), nobody(1, 1)).primal == violation
    boxed = Problem(np.eye(1), [0.0], lb=[1.0], ub=[2.5])
    assert [kkt_residuals(boxed, np.array([x]), nobody(1)).primal for x in (0.5, 2.0, 4.0)] == [0.5, 0.0, 1.5]


def test_a_certificate_of_an_optimal_point_vanishes_and_of_another_does_not() -> None:
    # min (x − 2)² + (y − 1)²,  x ≤ 1, x + y ≤ 1.5  →  (1, 0.5), by hand: z_box = 1, z = 1
    problem = Problem(2 * np.eye(2), [-4.0, -2.0], G=[[1.0, 1.0]], h=[1.5], ub=[1.0, np.inf])
    answer = Multipliers(np.array([1.0]), np.array([1.0, 0.0]))
    right = kkt_residuals(problem, np.array([1.0, 0.5]), answer)
    assert max(right.primal, right.dual, right.gap) < 1e-15
    wrong = kkt_residuals(problem, np.array([1.1, 0.5]), answer)
    assert np.isclose(wrong.primal, 0.1) and np.isclose(wrong.dual, 0.2) and wrong.gap > 0.01


def test_a_multiplier_of_the_wrong_sign_is_no_certificate() -> None:
    problem = Problem([[1.0]], [0.0], G=[[1.0]], h=[1.0])
    assert kkt_residuals(problem, np.array([1.0]), Multipliers(np.array([-1.0]), np.zeros(1))).dual == 1.0


def test_a_multiplier_on_a_bound_that_is_not_there_is_no_certificate() -> None:
    problem = Problem([[1.0]], [1.0])
    assert kkt_residuals(problem, np.array([0.0]), Multipliers(np.zeros(0), np.array([-1.0]))).gap == np.inf


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
        ({"h": [1.0]}, "G is missing"),
        ({"G": [[1.0]], "h": [1.0]}, "not a matrix that fits"),
        ({"lb": [0.0]}, "bounds that do not fit"),
        ({"ub": [-np.inf, 0.0]}, "bounds that do not fit"),
    ],
)
def test_problems_that_do_not_fit(change: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Problem(**{"P": np.eye(2), "q": np.zeros(2), **change})
