"""Clamps that give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import NAMES, arm

from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.equilibrium import solve_equilibrium


def test_the_middles_of_clamped_edges_follow_the_ends_that_have_springs():
    body = arm((4, 2, 2)).body
    corners = np.intersect1d(body.clamped, body.mesh.tets[:, :4])
    body = replace(body, clamp_nodes=corners)
    nearly = solve_equilibrium(body.with_clamp_stiffness(1e6), tension={NAMES[0]: 1.0})
    firm = solve_equilibrium(body, tension={NAMES[0]: 1.0})
    assert np.abs(nearly.positions - firm.positions).max() < 3e-3 * np.abs(firm.positions - body.mesh.nodes).max()
    soft, random = body.with_clamp_stiffness(40.0), np.random.default_rng(0)
    x = body.mesh.nodes + 1e-4 * random.normal(size=body.mesh.nodes.shape)
    step = 1e-8 * random.normal(size=x.shape)
    here, sides = internal(soft, x), [internal(soft, x + sign * step) for sign in (1.0, -1.0)]
    assert (here.forces * step).sum() == pytest.approx((sides[0].energy - sides[1].energy) / 2, rel=1e-5)
    change = ((sides[0].forces - sides[1].forces) / 2).reshape(-1)[soft.free_map.dofs]
    K = reduced_matrix(soft, here.blocks)
    np.testing.assert_allclose(K @ step.reshape(-1)[soft.free_map.dofs], change, atol=1e-6 * np.abs(change).max())
