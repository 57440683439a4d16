"""Whether the data need quadratic elements."""

from __future__ import annotations

from arm import arm, record, sweeps

from femsense.fem.mesh import to_linear
from femsense.loop.improve import improve
from femsense.model.remeshing import robot_on_mesh


def test_a_linear_mesh_is_asked_for_quadratic_elements_whatever_else_makes_up_for_it() -> None:
    """Calibration makes the locking arm so soft that quadratic elements of that softness fold: screening cannot see them."""
    inputs, labels = sweeps(2.0)
    declared = arm((7, 2, 2), law="neo_hookean")
    recording, _ = record(inputs, labels=labels, truth=declared)  # a finer truth is softer by 1 %, which is named beside it
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "poisson", "cable_gain"])
    assert [e.name for e in found.effects] == ["discretisation"]
    assert found.after.validation_rms_m < 0.2 * found.before.validation_rms_m
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.verdict == "named" and row.dbic > 10.0
    assert {str(r.seed) for r in row.refits} == {"{'element': 'tet10'}", "{'refinements': 1}"}


def test_linear_elements_stay_where_the_data_do_not_miss_quadratic_ones() -> None:
    inputs, labels = sweeps(0.005)  # it hardly moves
    declared = arm((7, 2, 2))
    declared = declared.with_body(declared.body.with_gravity([0.0, 0.0, 0.0]))
    recording, _ = record(inputs, labels=labels, truth=declared)
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "cable_gain"])
    assert found.verdict == "none" and not found.effects
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.refits[0].verdict.startswith("too little evidence")
