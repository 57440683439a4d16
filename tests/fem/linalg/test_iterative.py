"""Conjugate gradients with two levels: the direct solver's answers, its sense of what is definite,
and when they take its place."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from analytic import bar_body, relative_error
from helpers import block_mesh
from hollow import hollow_bar

from femsense.core.errors import FemsenseError, InputError
from femsense.fem.assembly import internal, reduced_values
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.cavities import find_chamber
from femsense.fem.compliance import compliance
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.linalg.factorization import available_memory, factorize, factorize_definite, iterates
from femsense.fem.linalg.iterative import Iterative, coarse_factor, iterative

both = pytest.mark.parametrize("quadratic", [False, True], ids=["tet4", "tet10"])


def bent(quadratic: bool, nu: float = 0.4) -> tuple[BodyModel, np.ndarray]:
    """Return a bar that its cables bend, and its stiffness there without theirs."""
    body = bar_body(block_mesh((8, 3, 3)), quadratic=quadratic, poisson_ratio=nu)
    state = solve_equilibrium(body, tension={"top": 1.0, "side": 0.5})
    assert state.converged
    blocks = internal(body, state.positions).blocks
    assert blocks is not None
    return body, reduced_values(body, blocks)


@both
@pytest.mark.parametrize("nu", [0.4, 0.49])
def test_solutions_are_those_of_the_direct_factor(quadratic: bool, nu: float) -> None:
    body, values = bent(quadratic, nu)
    pattern = body.free_map.pattern
    rng = np.random.default_rng(0)
    right = rng.normal(0, 1, (pattern.size, 3)) * [1.0, 1e-12, 1e9]
    found, wanted = iterative(pattern.levels(), values), factorize(pattern, values)
    assert found is not None and wanted is not None and found.negative == 0 and found.size == wanted.size
    for j in range(3):
        assert relative_error(found.solve(right[:, j]), wanted.solve(right[:, j])) < 1e-8
    np.testing.assert_allclose(found.solve(right)[:, 1], found.solve(right[:, 1]), rtol=1e-12)
    assert found.solve(np.zeros((pattern.size, 0))).shape == (pattern.size, 0)
    assert (found.solve(np.zeros(pattern.size)) == 0).all()
    columns = sp.random_array((pattern.size, 4), density=0.02, rng=rng).tocsc()
    assert relative_error(found.gram(columns), wanted.gram(columns)) < 1e-8


@both
def test_the_coarse_matrix_is_the_projection_of_the_fine_one(quadratic: bool) -> None:
    body, values = bent(quadratic)
    pattern = body.free_map.pattern
    levels = pattern.levels()
    P = levels.prolong.astype(np.float64)
    K = sp.csc_matrix((values, pattern.indices, pattern.indptr))
    right = np.random.default_rng(1).normal(0, 1, P.shape[1])
    factor = coarse_factor(levels, values)
    assert factor is not None
    projected = (P.T @ K @ P).toarray()
    assert relative_error(projected @ factor.solve(right), right) < 1e-3  # single precision


@both
def test_the_coarse_space_holds_the_rigid_motions(quadratic: bool) -> None:
    body = bar_body(block_mesh((4, 2, 2)), quadratic=quadratic, clamped=False)
    pattern = body.free_map.pattern
    x = body.mesh.nodes.ravel()[body.free_map.dofs].reshape(-1, 3)
    P = pattern.levels().prolong.toarray().astype(np.float64)
    for motion in (np.ones((len(x), 1)) * [1.0, 2.0, 3.0], np.cross([0.3, -1.0, 0.5], x)):
        answer = np.linalg.lstsq(P, motion.ravel(), rcond=None)[0]
        assert relative_error(P @ answer, motion.ravel()) < 1e-5


@both
def test_one_negative_eigenvalue_is_seen(quadratic: bool) -> None:
    """The coarse matrix of a stiffness just below zero may be definite: then the curvatures along the search must tell."""
    body = bar_body(block_mesh((4, 2, 2)), quadratic=quadratic, cables=False)
    pattern = body.free_map.pattern
    blocks = internal(body, np.array(body.mesh.nodes)).blocks
    assert blocks is not None
    K = sp.csc_matrix((reduced_values(body, blocks), pattern.indices, pattern.indptr))
    lowest = float(np.linalg.eigvalsh(K.toarray())[0])
    levels = pattern.levels()
    on_diagonal = pattern.indices == np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    coarse_seen = []
    for share in (0.9, 0.99, 1.003, 1.1, 3.0):
        values = K.data - share * lowest * on_diagonal
        assert (iterative(levels, values) is not None) == (share < 1.0), share
        coarse_seen.append(coarse_factor(levels, values) is None)
    assert not coarse_seen[2] and coarse_seen[-1]


def test_the_shift_and_the_inertia_are_those_of_the_direct_path(monkeypatch: pytest.MonkeyPatch) -> None:
    body = bar_body(block_mesh((8, 2, 2)), cables=False)
    squeezed = body.mesh.nodes * [0.55, 1.0, 1.0]  # far beyond buckling
    blocks = internal(body, squeezed).blocks
    assert blocks is not None
    pattern, values = body.free_map.pattern, reduced_values(body, blocks)
    direct, shift = factorize_definite(pattern, values)
    whole = factorize(pattern, values)
    monkeypatch.setenv("FEMSENSE_SOLVER", "iterative")
    found, other = factorize_definite(pattern, values)
    exact = factorize(pattern, values)
    assert direct is not None and isinstance(found, Iterative) and shift > 0 and other == shift
    assert whole is not None and exact is not None and exact.negative == whole.negative > 0
    values[5] = np.nan
    assert factorize(pattern, values) is None


def hollow_body(quadratic: bool) -> BodyModel:
    """Return a bar with a chamber and two cables, under its weight."""
    mesh = hollow_bar(quadratic=quadratic)
    cables = tuple(tie_cable(mesh, name, [[0.1, y, 0.03]], [-0.01, y, 0.045]) for name, y in (("a", 0.01), ("b", 0.02)))
    return make_body(
        mesh,
        young_modulus=150e3,
        poisson_ratio=0.4,
        density=1000.0,
        clamped=mesh.nodes[:, 0] < 1e-9,
        cables=cables,
        chambers=(find_chamber(mesh, "core", [0.05, 0.015, 0.015]),),
        gravity=[0, 0, -9.81],
    )


@both
def test_an_equilibrium_with_cables_and_a_chamber_is_that_of_the_direct_path(
    monkeypatch: pytest.MonkeyPatch, quadratic: bool
) -> None:
    body = hollow_body(quadratic)
    drives = {"tension": {"a": 0.4}, "shortening": {"b": 0.001}, "volume": {"core": 2e-7}}
    direct = solve_equilibrium(body, **drives)
    points, normals = body.mesh.nodes[-2:], np.eye(3)[:2]
    W = compliance(body, direct, points=points, directions=normals)
    monkeypatch.setenv("FEMSENSE_SOLVER", "iterative")
    state = solve_equilibrium(body, **drives)
    assert direct.converged and state.converged and isinstance(state.factor, Iterative)
    np.testing.assert_allclose(state.positions, direct.positions, atol=1e-9)
    assert state.tension["b"] == pytest.approx(direct.tension["b"], rel=1e-6)
    assert state.pressure["core"] == pytest.approx(direct.pressure["core"], rel=1e-6)
    assert relative_error(compliance(body, state, points=points, directions=normals), W) < 1e-6


def test_memory_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen(free_gb: str, asked_from: int = 0) -> bool:
        monkeypatch.setenv("FEMSENSE_MEMORY_GB", free_gb)
        return iterates(bar_body(block_mesh((4, 2, 2)), cables=False).free_map.pattern, asked_from=asked_from)

    monkeypatch.delenv("FEMSENSE_SOLVER", raising=False)
    monkeypatch.delenv("FEMSENSE_MEMORY_GB", raising=False)
    assert available_memory() > 1e6
    assert chosen("1e-6") and not chosen("1000")
    assert not chosen("1e-6", 10**6)  # small bodies do not ask
    monkeypatch.setenv("FEMSENSE_SOLVER", "direct")
    assert not chosen("1e-6")
    monkeypatch.setenv("FEMSENSE_SOLVER", "iterative")
    assert chosen("1000")


@pytest.mark.parametrize("said", ["much", "-1", "nan"])
def test_memory_that_is_no_number_is_an_error(monkeypatch: pytest.MonkeyPatch, said: str) -> None:
    monkeypatch.setenv("FEMSENSE_MEMORY_GB", said)
    with pytest.raises(InputError, match="FEMSENSE_MEMORY_GB"):
        available_memory()


def test_an_indefinite_stiffness_without_memory_for_its_factor_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    body = bar_body(block_mesh((8, 2, 2)), cables=False)
    blocks = internal(body, body.mesh.nodes * [0.55, 1.0, 1.0]).blocks
    assert blocks is not None
    monkeypatch.setenv("FEMSENSE_SOLVER", "iterative")
    monkeypatch.setenv("FEMSENSE_MEMORY_GB", "1e-6")
    with pytest.raises(FemsenseError, match=r"its factor needs .* GB where"):
        factorize(body.free_map.pattern, reduced_values(body, blocks))
