"""How far forces are off because the law is not known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from helpers import block_mesh

from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel, make_body
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.model.contact_patch import body_surface, patch_at
from femsense.sensing.law import law_std
from femsense.sensing.types import Fit, Rows, Sensor, Touch

MESH = block_mesh((6, 6, 4), (0.03, 0.03, 0.02))
TOP = np.flatnonzero(MESH.nodes[:, 2] > 0.0199)
PLACE = np.array([0.015, 0.015, 0.02])


def pad(law: str) -> BodyModel:
    """Return a soft pad that sticks to the ground."""
    return make_body(MESH, young_modulus=6e4, poisson_ratio=0.45, law=law, clamped=MESH.nodes[:, 2] < 1e-9)


def pressed(body: BodyModel, force_n: float) -> tuple[Touch, Equilibrium]:
    """Return a touch in the middle of the top and the state under its force."""
    patch = patch_at(body_surface(MESH), MESH.nodes, PLACE, 0.006, body.clamped)
    touch = Touch(PLACE, np.array([0.0, 0, 1]), patch, PLACE, 0.0, "cloud")
    return touch, solve_equilibrium(body, nodal_forces=patch.spread(np.array([0.0, 0, -force_n]), len(MESH.nodes)))


def fit_with(law: str, force_n: float) -> tuple[Sensor, Fit, Equilibrium]:
    """Return a sensor that sees the heights of the top, with a fit of so much force and the state without it."""
    body = pad(law)
    touch, state = pressed(body, force_n)
    rows = SimpleNamespace(functional=lambda u: u[:, TOP, 2].T, std=np.full(len(TOP), 1e-4), weight=np.ones(len(TOP)))
    forces = np.array([[0.0, 0.0, -force_n]])
    fit = Fit((touch,), state, forces, np.zeros((3, 3)), np.zeros((1, 3, 3)), cast(Rows, rows), 1.0)
    return cast(Sensor, SimpleNamespace(robot=SimpleNamespace(body=body))), fit, solve_equilibrium(body)


def heights(state: Equilibrium) -> FloatArray:
    """Return how the top has moved [m]."""
    return np.asarray(state.positions[TOP, 2] - MESH.nodes[TOP, 2])


@pytest.mark.parametrize("true", [0.5, 1.6])
def test_the_deviation_is_that_of_the_force_another_law_needs_for_the_same_dent(true: float) -> None:
    wanted, sensed = heights(pressed(pad("neo_hookean"), true)[1]), true
    for _ in range(6):
        seen = heights(pressed(pad("corotational"), sensed)[1])
        sensed *= float(np.linalg.norm(wanted) / np.linalg.norm(seen))
    (share,) = law_std(*fit_with("corotational", sensed))
    assert share == pytest.approx(true / sensed - 1.0, rel=0.35)  # 2.7 % and 9.1 %


def test_a_declared_law_is_believed():
    assert not law_std(*fit_with("neo_hookean", 0.3)).any()
