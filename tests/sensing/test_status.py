"""States that a model does not hold for."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import block_mesh

from femsense.sensing.status import least_stretch

MESH = block_mesh((2, 1, 1))


def test_the_stretch_under_a_contact():
    carrying = np.array([0])
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.1, 0.5], carrying) == pytest.approx(0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, -0.5], carrying) == pytest.approx(-0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, 0.5], np.zeros(0, dtype=np.int64)) == 1.0
