"""Factorisation: two solvers that agree, inertia, shifts, and several factors alive at once."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import scipy.sparse as sp
from analytic import bar_body
from helpers import block_mesh

from femsense.core.errors import InputError
from femsense.fem.assembly import internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.linalg import refinement
from femsense.fem.linalg.cholesky import cholesky
from femsense.fem.linalg.factorization import Pattern, factorize, factorize_definite
from femsense.fem.linalg.symbolic import analyse


@pytest.fixture(params=["direct", "superlu"])
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Choose the solver as a user would."""
    monkeypatch.setenv("FEMSENSE_SOLVER", request.param)
    return str(request.param)


def random_symmetric(nodes: int, seed: int, *, definite: bool) -> sp.csc_matrix:
    """Return a sparse symmetric matrix of 3 × 3 blocks with a full diagonal."""
    rng, size = np.random.default_rng(seed), 3 * nodes
    graph = sp.random_array((nodes, nodes), density=0.1, rng=rng) + sp.eye_array(nodes)
    A = sp.csc_matrix(sp.kron(graph != 0, np.ones((3, 3))))
    A.data[:] = rng.standard_normal(A.nnz)
    A = (A + A.T).tocsc()
    shift = np.abs(A).sum(axis=1).max() + 1.0
    D = np.full(size, shift) if definite else rng.choice([-1.0, 1.0], size) * rng.uniform(0.5, 2.0, size)
    A = sp.csc_matrix(A + sp.diags_array(D))
    A.sort_indices()
    return A


def shuffled(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return the unknowns in a random order of their nodes."""
    return (3 * rng.permutation(size // 3)[:, None] + np.arange(3)).ravel()


def pattern_of(A: sp.csc_matrix) -> Pattern:
    return Pattern(A.indptr, A.indices)


def stiffness(body: BodyModel, positions: np.ndarray | None = None) -> np.ndarray:
    blocks = internal(body, np.array(body.mesh.nodes) if positions is None else positions).blocks
    assert blocks is not None
    return reduced_values(body, blocks)


@pytest.mark.parametrize("seed", range(3))
def test_solutions_are_those_of_the_dense_matrix(solver: str, seed: int) -> None:
    A = random_symmetric(20, seed, definite=True)
    factor = factorize(pattern_of(A), A.data)
    right = np.random.default_rng(seed).normal(0, 1, (60, 7))
    assert factor is not None and factor.negative == 0 and factor.size == 60 and factor.bytes > 0
    wanted = np.linalg.solve(A.toarray(), right)
    np.testing.assert_allclose(factor.solve(right), wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor.solve(right[:, 0]), wanted[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor.solve(right[:, 1:3]), wanted[:, 1:3], rtol=1e-9, atol=1e-12)
    assert factor.solve(np.zeros((60, 0))).shape == (60, 0)
    np.testing.assert_allclose(factor.solve(np.asfortranarray(right)[:, ::-1]), wanted[:, ::-1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["random", "tet4", "tet10"])
def test_the_gram_matrix_of_sparse_columns_is_that_of_dense_ones(solver: str, kind: str) -> None:
    rng = np.random.default_rng(4)
    if kind == "random":
        A = random_symmetric(30, 1, definite=True)
        pattern, values = pattern_of(A), A.data
    else:
        body = bar_body(block_mesh((4, 2, 2)), quadratic=kind == "tet10")
        pattern, values = body.free_map.pattern, stiffness(body)
        A = sp.csc_matrix((values, pattern.indices, pattern.indptr))
    columns = sp.random_array((pattern.size, 9), density=0.03, rng=rng).tocsc()
    columns = sp.csc_matrix(sp.hstack([columns, sp.csc_matrix((pattern.size, 1))]))  # an empty one too
    factor = factorize(pattern, values)
    assert factor is not None
    dense = columns.toarray()
    wanted = dense.T @ np.linalg.solve(A.toarray(), dense)
    np.testing.assert_allclose(factor.gram(columns), wanted, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("seed", range(4))
def test_a_random_pattern_is_factorised_as_the_dense_matrix(seed: int) -> None:
    """Trees with several roots, single nodes, wide and narrow fronts."""
    rng = np.random.default_rng(seed)
    A = sp.block_diag([random_symmetric(size, seed, definite=True) for size in (1, 2, 12, 24)]).tocsc()
    order = shuffled(rng, A.shape[0])
    A = sp.csc_matrix(A[order][:, order])
    A.sort_indices()
    factor = cholesky(analyse(A.indptr, A.indices), A.data)
    assert factor is not None
    right = rng.normal(0, 1, (A.shape[0], 5))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(A.toarray(), right), rtol=1e-9, atol=1e-12)


def test_a_pattern_without_blocks_is_refused() -> None:
    scattered = random_symmetric(6, 0, definite=True).tolil()
    scattered[0, 17] = scattered[17, 0] = 1.0 - scattered[0, 17]
    for matrix in (sp.eye_array(6), sp.eye_array(5), sp.eye_array(7), sp.csc_array(scattered), sp.csc_array(np.ones((4, 4)))):
        A = sp.csc_matrix(matrix)
        A.eliminate_zeros()
        with pytest.raises(InputError, match="not a pattern of nodes"):
            analyse(A.indptr, A.indices)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 24, 25])
def test_any_number_of_right_hand_sides_is_solved_as_by_the_dense_matrix(count: int, single: bool) -> None:
    """One, groups whose last one is full or not, and as many as BLAS takes."""
    body = bar_body(block_mesh((5, 3, 2)), quadratic=True, cables=False)
    pattern, values = body.free_map.pattern, stiffness(body)
    factor = cholesky(pattern.analysis(), values, single=single)
    assert factor is not None
    A = sp.csc_matrix((values, pattern.indices, pattern.indptr)).toarray()
    right = np.random.default_rng(count).normal(0, 1, (pattern.size, count))
    wanted = np.linalg.solve(A, right)
    error = np.abs(factor.solve(right) - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert error.max() < (2e-3 if single else 1e-9)


def test_single_precision_is_a_preconditioner() -> None:
    body = bar_body(block_mesh((6, 2, 2)), quadratic=True, cables=False)
    pattern, values = body.free_map.pattern, stiffness(body)
    exact, rough = (cholesky(pattern.analysis(), values, single=s) for s in (False, True))
    assert exact is not None and rough is not None and 2 * rough.bytes == exact.bytes
    right = np.random.default_rng(0).normal(0, 1, pattern.size)
    A = sp.csc_matrix((values, pattern.indices, pattern.indptr))
    wanted, x, error = exact.solve(right), np.zeros(pattern.size), 1.0
    for _ in range(3):
        x = x + rough.solve(right - A @ x)
        last, error = error, float(np.abs(x - wanted).max() / np.abs(wanted).max())
        assert error < max(0.02 * last, 1e-11)


@pytest.mark.parametrize("seed", range(6))
def test_an_indefinite_matrix_is_seen_as_such(solver: str, seed: int) -> None:
    A = random_symmetric(14, seed, definite=False)
    factor = factorize(pattern_of(A), A.data)
    assert factor is not None and factor.negative == int((np.linalg.eigvalsh(A.toarray()) < 0).sum())


def test_a_solver_that_does_not_exist_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEMSENSE_SOLVER", "pardiso")
    A = random_symmetric(3, 0, definite=True)
    with pytest.raises(InputError, match=r"(?s)FEMSENSE_SOLVER.*pardiso.*superlu"):
        factorize(pattern_of(A), A.data)


def test_a_definite_matrix_in_any_order_is_seen_as_such(solver: str) -> None:
    A = random_symmetric(27, 11, definite=True)
    order = shuffled(np.random.default_rng(0), A.shape[0])
    B = sp.csc_matrix(A[order][:, order])
    B.sort_indices()
    factor, shift = factorize_definite(pattern_of(B), B.data)
    assert factor is not None and factor.negative == 0 and shift == 0.0


def test_the_shift_makes_an_indefinite_matrix_definite(solver: str) -> None:
    A = random_symmetric(14, 3, definite=False)
    factor, shift = factorize_definite(pattern_of(A), A.data)
    lowest = float(np.linalg.eigvalsh(A.toarray()).min())
    assert factor is not None and factor.negative == 0
    assert -lowest < shift < -8 * lowest  # no more than the factor between two tries too much
    right = np.random.default_rng(0).normal(0, 1, 42)
    np.testing.assert_allclose(
        factor.solve(right), np.linalg.solve(A.toarray() + shift * np.eye(42), right), rtol=1e-7, atol=1e-10
    )


def test_numbers_that_are_not_finite_have_no_factor(solver: str) -> None:
    A = random_symmetric(7, 0, definite=True)
    values = A.data.copy()
    values[7] = np.nan
    assert factorize(pattern_of(A), values) is None
    values[:] = 0.0
    assert factorize_definite(pattern_of(A), values)[0] is None


def test_factors_alive_at_once_keep_their_own_values(solver: str) -> None:
    body = bar_body(block_mesh((4, 2, 2)), cables=False)
    pattern, values = body.free_map.pattern, stiffness(body)
    right = np.random.default_rng(0).normal(0, 1, pattern.size)
    scales = [1.0, 2.0, 5.0, 0.25]
    factors = [factorize(pattern, s * values) for s in scales]
    first = factors[0].solve(right)
    for scale, factor in zip(scales, factors):
        np.testing.assert_allclose(factor.solve(right), first / scale, rtol=1e-9)
    del factors[1]
    gc.collect()
    fresh = factorize(pattern, 10.0 * values)  # takes the memory of the one that is gone
    np.testing.assert_allclose(fresh.solve(right), first / 10, rtol=1e-9)
    for scale, factor in zip([1.0, 5.0, 0.25], factors):
        np.testing.assert_allclose(factor.solve(right), first / scale, rtol=1e-9)


def test_memory_of_dead_factors_is_used_again() -> None:
    body = bar_body(block_mesh((2, 1, 1)), cables=False)
    pattern, values = body.free_map.pattern, stiffness(body)
    for _ in range(5):
        factorize(pattern, values)
    gc.collect()
    assert all(len(idle) == 1 for idle in pattern.analysis().pool.idle.values())


@pytest.mark.parametrize("quadratic", [False, True])
def test_all_solvers_find_the_same_equilibrium(monkeypatch: pytest.MonkeyPatch, quadratic: bool) -> None:
    body = bar_body(block_mesh((4, 1, 1)), quadratic=quadratic, gravity=(0, 0, -9.81))
    states = []
    for name in ("direct", "superlu"):
        monkeypatch.setenv("FEMSENSE_SOLVER", name)
        states.append(solve_equilibrium(body, tension={"top": 1.0, "side": 0.5}))
    assert all(state.converged for state in states)
    for state in states[1:]:
        np.testing.assert_allclose(state.positions, states[0].positions, atol=1e-10)


def test_superlu_sees_the_stiffness_of_a_body_as_definite(solver: str) -> None:
    for quadratic in (False, True):
        body = bar_body(block_mesh((3, 2, 1)), quadratic=quadratic)
        factor = factorize(body.free_map.pattern, stiffness(body))
        assert factor is not None and factor.negative == 0


def test_a_factor_of_a_state_near_by_is_taken_where_it_serves() -> None:
    body = bar_body(block_mesh((5, 2, 2), (0.1, 0.013, 0.01)))
    state, pattern = solve_equilibrium(body), body.free_map.pattern
    values = reduced_values(body, internal(body, state.positions).blocks)
    right = np.random.default_rng(0).standard_normal((pattern.size, 3))
    exact = factorize(pattern, values).solve(right)
    smaller = bar_body(block_mesh((4, 2, 2), (0.1, 0.013, 0.01)))
    other = factorize(smaller.free_map.pattern, reduced_values(smaller, internal(smaller, smaller.mesh.nodes).blocks))
    for lent, taken in (
        (factorize(pattern, 1.005 * values), True),
        (factorize(pattern, 1.028 * values), True),
        (factorize(pattern, 1.05 * values), False),
        (other, False),
        (None, False),
    ):
        refined = refinement.refined(pattern, values, lent, pays_from=1)
        assert isinstance(refined, refinement.Refined)
        for _ in range(2):
            assert np.abs(refined.solve(right) - exact).max() < 1e-6 * np.abs(exact).max()
            assert (refined.plain is lent) == taken
