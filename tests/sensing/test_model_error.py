"""What the model may have wrong under a contact, and states that it does not hold for."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from analytic import bar_body
from helpers import block_mesh

from femsense.calib.scan import clear_of
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import solve_equilibrium
from femsense.model.contact_patch import body_surface, patch_at
from femsense.sensing.judge import least_stretch
from femsense.sensing.model_error import WIDE, model_columns
from femsense.sensing.types import Touch

MESH = block_mesh((4, 2, 2))
PLACE = MESH.nodes.max(axis=0) * [0.6, 0.5, 1.0]
FORCE = np.array([0.0, 0.0, -0.4])
UP = np.array([0.0, 0.0, 1.0])


def columns_and_change(*, law: str = "corotational", wide: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns of a press on a bar, and how its nodes move when the press is solved anew by another law or over a wider patch."""
    states = []
    for own_law in ("corotational", law):
        body = bar_body(MESH, law=own_law, cables=False)
        surface = body_surface(body.mesh)
        patches = [patch_at(surface, MESH.nodes, PLACE, r * surface.edge, body.clamped, facing=UP) for r in (1.05, WIDE)]
        patch = patches[wide and len(states) == 1]
        states.append(solve_equilibrium(body, nodal_forces=patch.spread(FORCE, len(MESH.nodes))))
    body = bar_body(MESH, cables=False)
    sensor = SimpleNamespace(robot=SimpleNamespace(body=body), surface=body_surface(body.mesh))
    rows = SimpleNamespace(functional=lambda u: u.reshape(len(u), -1).T)
    touch = Touch(PLACE, UP, patches[0], PLACE, 0.0, "given")
    columns = model_columns(sensor, rows, states[0], tangent_at(body, states[0]), [touch], FORCE[None])
    return columns, (states[1].positions - states[0].positions).ravel()


def test_the_first_column_is_what_another_law_does():
    columns, change = columns_and_change(law="neo_hookean")
    assert np.linalg.norm(change) > 1e-6
    assert np.linalg.norm(columns[:, 0] - change) < 0.2 * np.linalg.norm(change)


def test_a_column_a_contact_is_what_a_wider_patch_does():
    columns, change = columns_and_change(wide=True)
    assert np.linalg.norm(change) > 1e-6
    assert np.linalg.norm(columns[:, 1] - change) < 0.2 * np.linalg.norm(change)


def test_the_stretch_under_a_contact():
    carrying = np.array([0])
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.1, 0.5], carrying) == pytest.approx(0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, -0.5], carrying) == pytest.approx(-0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, 0.5], np.zeros(0, dtype=np.int64)) == 1.0


@pytest.mark.parametrize("kept", [1.0, 0.3])
@pytest.mark.parametrize(("depth", "dropped"), [(0.3, 1), (0.5, 0)])
def test_pixels_beside_something_nearer_are_left_out(kept, depth, dropped):
    x, y = np.meshgrid(np.arange(40), np.arange(40), indexing="ij")
    x, y = x.ravel(), y.ravel()
    seen = np.random.default_rng(0).random(x.size) < kept
    rays = np.column_stack([2e-3 * x, 2e-3 * y, np.ones(x.size)])
    clear = clear_of(0.4 * rays[(x >= 20) & seen], depth * rays[(x < 20)])
    assert (clear == (x[(x >= 20) & seen] >= 20 + dropped)).all()
