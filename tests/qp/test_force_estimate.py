"""Forces and the truth of their standard deviations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from femsense.core.errors import InputError
from femsense.qp import FrictionCone, estimate_forces
from femsense.qp.problem import ForceOptions

STD = np.array([1e-4, 2e-4, 5e-5])


def body(
    seed: int = 0, rows: int = 30, forces: int = 3, cables: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return W_forces, W_cables [m/N], free positions and standard deviations [m] of a random body."""
    rng = np.random.default_rng(seed)
    return (
        1e-3 * rng.normal(size=(rows, forces)),
        1e-3 * rng.normal(size=(rows, cables)),
        rng.normal(size=rows),
        rng.choice(STD, rows),
    )


def test_exact_data_give_the_exact_forces() -> None:
    W, W_c, free, std = body()
    force, tension = np.array([1.0, -0.3, 2.0]), np.array([3.0, 4.0])
    estimate = estimate_forces(
        W, W_c, free, free + W @ force + W_c @ tension, std=std, options=ForceOptions(cable_inputs=tension)
    )
    np.testing.assert_allclose(estimate.forces, force, rtol=1e-8)
    np.testing.assert_allclose(estimate.cable_tensions, tension, rtol=1e-12)
    assert estimate.status == "solved" and np.abs(estimate.residual).max() < 1e-10 and estimate.certificate.certificate < 1e-7


def test_measured_displacements_give_forces_and_tensions() -> None:
    """(14): the body pushes back on the cables, so the tensions come out of the equation."""
    rng = np.random.default_rng(1)
    root = 1e-2 * rng.normal(size=(35, 40))
    W_all = root @ root.T  # a symmetric compliance of 30 rows, 3 forces, 2 cables
    W, W_c, W_aa, W_af = W_all[:30, 30:33], W_all[:30, 33:], W_all[33:, 33:], W_all[33:, 30:33]
    force, tension, start = np.array([0.5, 1.5, 0.0]), np.array([2.0, 1.0]), np.array([1e-3, -2e-3])
    shift = W_aa @ tension + W_af @ force + start
    estimate = estimate_forces(
        W,
        W_c,
        np.zeros(30),
        W @ force + W_c @ tension,
        std=0.0001,
        options=ForceOptions(cable_displacements=shift, W_aa=W_aa, W_af=W_af, delta_a_free=start),
    )
    np.testing.assert_allclose(estimate.forces, force, atol=1e-7)
    np.testing.assert_allclose(estimate.cable_tensions, tension, atol=1e-7)


def test_covariance_is_that_of_weighted_least_squares() -> None:
    W, _, free, std = body()
    estimate = estimate_forces(W, None, free, free, std=std)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(W.T @ np.diag(std**-2.0) @ W), rtol=1e-9)
    np.testing.assert_allclose(estimate.std, np.sqrt(np.diag(estimate.covariance)), rtol=1e-12)


def test_cables_that_are_measured_leave_their_directions() -> None:
    """(13) takes the columns of the cables out; (14) makes the tensions follow the forces: λ_a = W_aa⁻¹ (… − W_af λ_f)."""
    W, W_c, free, std = body()
    fixed = estimate_forces(W, W_c, free, free, std=std, options=ForceOptions(cable_inputs=[0.0, 0.0]))
    np.testing.assert_allclose(fixed.covariance, estimate_forces(W, None, free, free, std=std).covariance, rtol=1e-8)
    W_aa, W_af = 1e-3 * np.array([[2.0, 0.5], [0.5, 1.0]]), 1e-3 * np.random.default_rng(7).normal(size=(2, 3))
    parts = {"W_aa": W_aa, "W_af": W_af, "delta_a_free": np.zeros(2)}
    moved = estimate_forces(W, W_c, free, free, std=std, options=ForceOptions(cable_displacements=[0.0, 0.0], **parts))
    stiffer = W - W_c @ np.linalg.solve(W_aa, W_af)
    np.testing.assert_allclose(moved.covariance, estimate_forces(stiffer, None, free, free, std=std).covariance, rtol=1e-7)


def test_unknown_tensions_and_nuisance_are_marginalised() -> None:
    """By the other road: a nuisance of deviation τ is noise of covariance B τ² Bᵀ; a free one takes its direction away."""
    W, W_c, free, std = body()
    B, tau = 1e-4 * np.random.default_rng(3).normal(size=(30, 2)), np.array([0.5, 2.0])
    target = free + W @ [1.0, 2.0, 3.0] + B @ [0.3, -1.0] + std * np.random.default_rng(4).normal(size=30)
    estimate = estimate_forces(W, W_c, free, target, std=std, options=ForceOptions(nuisance=B, nuisance_std=tau))
    weight = np.linalg.inv(np.diag(std**2) + B @ np.diag(tau**2) @ B.T)
    both = np.hstack([W_c, W])
    covariance = np.linalg.inv(both.T @ weight @ both)
    np.testing.assert_allclose(estimate.covariance, covariance[2:, 2:], rtol=1e-7)
    np.testing.assert_allclose(estimate.forces, (covariance @ both.T @ weight @ (target - free))[2:], rtol=1e-6)
    free_one = estimate_forces(W, None, free, target, std=std, options=ForceOptions(nuisance=W_c, nuisance_std=np.inf))
    np.testing.assert_allclose(free_one.covariance, estimate_forces(W, W_c, free, target, std=std).covariance, rtol=1e-7)


def coverage(width: float, trials: int, **change: object) -> tuple[int, int]:
    """Return how often the truth lies within width standard deviations, one force a trial, and the number of trials."""
    rng = np.random.default_rng(11)
    hits = 0
    for trial in range(trials):
        W, W_c, free, std = body(trial)
        B, force, tension = 2e-4 * rng.normal(size=(30, 1)), rng.uniform(0.5, 2, 3), rng.uniform(1, 4, 2)
        noise = std * rng.normal(size=30) + (B @ rng.normal(size=1) if change.get("model_error") else 0.0)
        options = {"nuisance": B, "nuisance_std": 1.0} if change.get("model_error") else {}
        target = free + W @ force + W_c @ tension + noise
        known = ForceOptions(cable_inputs=tension, force_lower=0.0, **options)
        estimate = estimate_forces(W, W_c, free, target, std=std, options=known)
        hits += abs(estimate.forces[trial % 3] - force[trial % 3]) < width * estimate.std[trial % 3]
    return hits, trials


@pytest.mark.parametrize("model_error", [False, True])
@pytest.mark.parametrize("width, share", [(1.0, 0.6827), (1.96, 0.95)])
def test_intervals_hold_the_truth_as_often_as_they_say(width: float, share: float, model_error: bool) -> None:
    hits, trials = coverage(width, 600, model_error=model_error)
    low, high = binom.ppf([1e-3, 1 - 1e-3], trials, share)
    assert low <= hits <= high


def test_a_force_held_by_its_bound_has_no_spread_and_frees_the_others() -> None:
    W, _, free, std = body()
    target = free + W @ np.array([1.0, -0.5, 2.0])
    estimate = estimate_forces(W, None, free, target, std=std, options=ForceOptions(force_lower=0.0))
    assert estimate.held.tolist() == [False, True, False]
    assert estimate.std[1] == 0.0 and estimate.forces[1] == pytest.approx(0.0, abs=1e-12)
    others = estimate_forces(W[:, [0, 2]], None, free, target, std=std)
    np.testing.assert_allclose(estimate.covariance[np.ix_([0, 2], [0, 2])], others.covariance, rtol=1e-8)
    np.testing.assert_allclose(estimate.forces[[0, 2]], others.forces, rtol=1e-7)


def test_forces_that_no_row_sees_are_uncertain_without_limit() -> None:
    W, _, free, std = body()
    W[:, 2] = W[:, 1]  # two contacts that look alike
    estimate = estimate_forces(
        W, None, free, free + W @ np.array([1.0, 1.0, 1.0]), std=std, options=ForceOptions(force_lower=0.0, force_upper=5.0)
    )
    assert np.isinf(estimate.std[1:]).all() and np.isfinite(estimate.std[0])
    assert estimate.forces[1:].sum() == pytest.approx(2.0, abs=1e-6)
    ridged = estimate_forces(W, None, free, free + W @ np.array([1.0, 1.0, 1.0]), std=std, options=ForceOptions(ridge=1.0))
    np.testing.assert_allclose(ridged.forces, 1.0, atol=0.02)
    assert np.isfinite(ridged.std).all()


def test_ridge_shrinks_and_its_spread_is_that_of_the_estimator() -> None:
    W, _, free, std = body()
    H = W.T @ np.diag(std**-2.0) @ W
    ridge = float(np.trace(H)) / 3
    estimate = estimate_forces(W, None, free, free + W @ np.ones(3), std=std, options=ForceOptions(ridge=ridge))
    inverse = np.linalg.inv(H + ridge * np.eye(3))
    np.testing.assert_allclose(estimate.covariance, inverse @ H @ inverse, rtol=1e-8)
    assert (np.abs(estimate.forces) < 0.9).all()


def test_without_std_the_residual_tells() -> None:
    rng = np.random.default_rng(0)
    ratio = []
    for trial in range(300):
        W, _, free, _ = body(trial)
        estimate = estimate_forces(W, None, free, free + W @ np.ones(3) + 1e-4 * rng.normal(size=30))
        ratio.append((estimate.forces[0] - 1.0) / estimate.std[0])
    assert 0.9 < np.std(ratio) < 1.2  # Student's t with 27 degrees of freedom: 1.04


def test_chi2_tells_whether_std_is_right_and_inflation_repairs_it() -> None:
    rng = np.random.default_rng(0)
    W, _, free, std = body(rows=400)
    target = free + W @ np.ones(3) + 3.0 * std * rng.normal(size=400)
    plain, inflated = (estimate_forces(W, None, free, target, std=std, inflate=flag) for flag in (False, True))
    assert 7.0 < plain.reduced_chi2 < 11.5
    np.testing.assert_allclose(inflated.covariance, plain.reduced_chi2 * plain.covariance, rtol=1e-9)
    assert np.isnan(estimate_forces(W[:3], None, free[:3], target[:3], std=std[:3]).reduced_chi2)


def test_a_row_of_infinite_std_counts_for_nothing() -> None:
    W, _, free, std = body()
    target = free + W @ np.ones(3)
    target[0], std[0] = 7.0, np.inf
    np.testing.assert_allclose(estimate_forces(W, None, free, target, std=std).forces, 1.0, rtol=1e-7)


def test_friction_keeps_the_force_in_its_cone() -> None:
    W, _, free, std = body()
    normal, mu = np.array([0.0, 0.0, 1.0]), 0.3
    inside, outside = np.array([0.1, 0.0, -1.0]), np.array([1.0, 0.0, -1.0])
    for force in (inside, outside):
        estimate = estimate_forces(
            W, None, free, free + W @ force, std=std, options=ForceOptions(friction_cone=FrictionCone(normal, mu))
        )
        tangential = np.linalg.norm(estimate.forces[:2])
        assert tangential <= -mu * estimate.forces[2] + 1e-9
        if force is inside:
            np.testing.assert_allclose(estimate.forces, force, atol=1e-7)
        else:  # on a side or an edge of the pyramid: one or two directions are lost
            assert np.linalg.matrix_rank(estimate.covariance, tol=1e-6 * np.trace(estimate.covariance)) in (1, 2)


def test_an_infeasible_problem_is_a_status() -> None:
    W, W_c, free, std = body()
    estimate = estimate_forces(W, W_c, free, free, std=std, options=ForceOptions(cable_inputs=[-1.0, 0.0], tension_lower=0.0))
    assert estimate.status == "infeasible" and np.isnan(estimate.forces).all() and np.isinf(estimate.std).all()
    assert np.isnan(estimate.cable_tensions).all() and estimate.residual.shape == (30,)


@pytest.mark.parametrize("seed", range(3))
def test_order_of_rows_and_forces_does_not_matter(seed: int) -> None:
    W, W_c, free, std = body(seed)
    rng = np.random.default_rng(seed)
    target = free + W @ [1.0, 0.0, -2.0] + std * rng.normal(size=30)
    rows, columns = rng.permutation(30), rng.permutation(3)
    one = estimate_forces(W, W_c, free, target, std=std, options=ForceOptions(force_lower=0.0))
    other = estimate_forces(
        W[rows][:, columns], W_c[rows], free[rows], target[rows], std=std[rows], options=ForceOptions(force_lower=0.0)
    )
    np.testing.assert_allclose(other.forces, one.forces[columns], atol=1e-8)
    np.testing.assert_allclose(other.covariance, one.covariance[np.ix_(columns, columns)], rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize(
    "change, text",
    [
        ({"std": 0.0}, "standard deviations that do not fit"),
        ({"std": np.ones(4)}, "standard deviations that do not fit"),
        ({"std": None, "options": ForceOptions(ridge=1.0)}, "priors need the scale of the noise"),
    ],
)
def test_bad_arguments_say_so(change: dict[str, object], text: str) -> None:
    W, _, free, std = body()
    with pytest.raises(InputError, match=text):
        estimate_forces(W, None, free, free, **{"std": std, **change})
