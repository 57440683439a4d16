"""The quadratic problem of one step: what is eliminated first changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.qp.forces import estimate_forces
from femsense.qp.friction_cone import FrictionCone, pyramid_rows
from femsense.qp.problem import ForceOptions
from femsense.sensing.force_step import NormalEquations

UP = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])


@pytest.mark.parametrize("pull", [-1.0, 1.0], ids=["inside the cones", "held by them"])
def test_forces_with_all_else_eliminated_are_those_of_the_whole_problem(pull: float) -> None:
    rng, m, others = np.random.default_rng(3), 2, 7
    rows = rng.normal(size=(40, 3 * m + others)) * np.append(np.full(3 * m, 3.0), np.ones(others))
    measured = rows[:, : 3 * m] @ np.ravel(pull * UP) + 0.1 * rng.normal(size=40)
    prior, cone = np.diag(np.full(3 * m, 2.0)), FrictionCone(normals=UP, mu=0.5)

    A = np.vstack([rows, np.hstack([prior, np.zeros((3 * m, others))])])
    options = ForceOptions(nuisance=A[:, 3 * m :], nuisance_std=np.ones(others), friction_cone=cone)
    whole = estimate_forces(A[:, : 3 * m], None, np.zeros(len(A)), np.append(measured, np.zeros(3 * m)), std=1.0, options=options)

    units = np.append(np.zeros(3 * m), np.ones(others))
    equations = NormalEquations(rows.T @ rows + np.diag(units), rows.T @ measured, 3 * m)
    reduced = equations.of_forces()
    forces = reduced.forces(prior, pyramid_rows(cone, 0, 3 * m, 0))
    np.testing.assert_allclose(forces, whole.forces, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(reduced.others(forces), whole.nuisance, rtol=1e-6, atol=1e-9)
    if pull < 0:
        np.testing.assert_allclose(equations.covariance(prior)[: 3 * m, : 3 * m], whole.covariance, rtol=1e-6)
