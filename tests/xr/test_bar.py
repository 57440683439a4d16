"""A bar that bends and twists in a known way, for the tests of the package xr, and what must be true of it."""

from __future__ import annotations

import numpy as np
from xr_bar import SIZE, bar_mesh, bar_states

from femsense.fem.mesh import TetMesh, element_volumes


def test_bar_is_sound_in_every_frame() -> None:
    mesh = bar_mesh()
    _, states = bar_states(mesh.nodes)
    np.testing.assert_allclose(element_volumes(mesh).sum(), SIZE.prod(), rtol=1e-12)
    np.testing.assert_allclose(states[0], mesh.nodes, atol=1e-3)
    for state in states:
        assert element_volumes(TetMesh(state, mesh.tets)).min() > 0
