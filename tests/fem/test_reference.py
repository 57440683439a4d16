"""Equilibria of another program on real robots: nodes agree to a micrometre from a cold start."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import DATA

from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.io.robot_toml import load_robot

REFERENCE = DATA / "reference"
pytestmark = [
    pytest.mark.skipif(not REFERENCE.exists(), reason="the reference equilibria are not here"),
    pytest.mark.filterwarnings("ignore:.*outside the mesh.*:UserWarning"),
]

MICROMETRE = 1e-6
DIAMOND = ["gravity", "north_1N", "all_1N", "tip_force", "displacement"]
ALL = [
    *[("diamond", "corotational_polar", case) for case in [*DIAMOND, "gravity_by_volume"]],
    *[("diamond", "neo_hookean", case) for case in DIAMOND],
    *[("finger", "finger_corotational_polar", case) for case in ("gravity", "force_500mN", "disp_10mm")],
]
MASS = {"diamond": 0.5, "finger": 0.075}
MODULUS = {"diamond": 180e3, "finger": 600e3}


def reference(name: str, kind: str, case: str) -> tuple[dict[str, Any], np.ndarray]:
    document = json.loads((REFERENCE / "cases.json").read_text(encoding="utf-8"))[kind][case]
    with np.load(REFERENCE / (f"{kind}.npz" if name == "finger" else f"{name}_{kind}.npz")) as file:
        return document, file[case]


_bodies: dict[str, BodyModel] = {}


def body_of(name: str, kind: str) -> BodyModel:
    if name not in _bodies:
        body = load_robot(DATA / name).body
        assert set(body.material.young_modulus.tolist()) == {MODULUS[name]}
        assert set(body.material.poisson_ratio.tolist()) == {0.45}
        _bodies[name] = body.with_gravity([0, 0, 0])
    body = _bodies[name]
    law = "neo_hookean" if kind == "neo_hookean" else "corotational"
    return body.with_material(replace(body.material, law=law))


def loaded(name: str, kind: str, case: str) -> tuple[BodyModel, dict[str, Any]]:
    """Return the body and the arguments of solve_equilibrium for a case."""
    document, _ = reference(name, kind, case)
    body = body_of(name, kind)
    forces = np.zeros_like(body.mesh.nodes)
    if case == "gravity_by_volume":
        body = body.with_material(replace(body.material, density=1274.35)).with_gravity(document["gravity_m_s2"])
    else:
        forces += MASS[name] / len(forces) * np.array(document["gravity_m_s2"])
    for node, force in document.get("nodal_force_n", []):
        forces[node] += force
    held = document.get("held_cables", {})
    return body, {
        "tension": {k: v for k, v in document["tension_n"].items() if k not in held},
        "shortening": held,
        "nodal_forces": forces,
    }


@pytest.mark.parametrize(("name", "kind", "case"), ALL)
def test_nodes_are_where_the_other_program_finds_them(name: str, kind: str, case: str) -> None:
    document, nodes = reference(name, kind, case)
    body, arguments = loaded(name, kind, case)
    state: Equilibrium = solve_equilibrium(body, **arguments)
    assert state.converged, state.advice
    assert np.abs(state.positions - nodes).max() < MICROMETRE
    for cable, wanted in document.get("cable_shortening_m", {}).items():
        assert state.shortening[cable] == pytest.approx(wanted, abs=MICROMETRE)
    for cable, wanted in document["tension_n"].items():
        assert state.tension[cable] == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("case", ["all_1N", "displacement"])
def test_the_start_does_not_matter(case: str) -> None:
    body, arguments = loaded("diamond", "corotational_polar", case)
    elsewhere = solve_equilibrium(body, tension={"west": 1.5, "south": 0.7})
    warm = solve_equilibrium(body, start=elsewhere, **arguments)
    assert warm.converged
    assert np.abs(warm.positions - reference("diamond", "corotational_polar", case)[1]).max() < MICROMETRE
