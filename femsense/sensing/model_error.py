"""What the model may have wrong under a contact: the law at large strain, and over how much of the surface a force is spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent
from femsense.fem.equilibrium import Equilibrium
from femsense.model.contact_patch import patch_at
from femsense.sensing.types import Rows, Sensor, Touch

WIDE = 2.1
"""Radius of the wide patch in edges of the surface, twice that of the patch of a point force: what touches is seldom known better."""


def model_columns(
    sensor: Sensor, rows: Rows, state: Equilibrium, tangent: Tangent, touches: Sequence[Touch], forces: FloatArray
) -> FloatArray:
    """Return how the rows change with another law and with wider patches [m], shape (r, 1 + m): nuisance of unit size.

    Both are to first order: the load that is out of balance at the state, answered by the tangent. The law matters where contacts squeeze the
    body; where bending turns it, laws agree. So does the patch: only the surface around a contact answers to it.

    Arguments:
        rows, state, tangent: where the fit stands.
        touches, forces: what acts there, forces (m, 3) [N].
    """
    loads = [_other_law(sensor, state), *(_wider(sensor, touch, force) for touch, force in zip(touches, forces))]
    return rows.functional(tangent.respond(np.array(loads)))


def _other_law(sensor: Sensor, state: Equilibrium) -> FloatArray:
    """Return the load that the state lacks or has too much when the material is neo-Hookean instead [N], shape (n, 3)."""
    body = sensor.robot.body
    if body.material.law != "corotational":
        return np.zeros_like(state.positions)
    other = replace(body, material=replace(body.material, law="neo_hookean"))
    load = internal(body, state.positions, tangent=False).forces - internal(other, state.positions, tangent=False).forces
    return np.nan_to_num(load, nan=0.0, posinf=0.0, neginf=0.0)


def _wider(sensor: Sensor, touch: Touch, force: FloatArray) -> FloatArray:
    """Return the load that spreads a force over the wide patch instead of its own [N], shape (n, 3)."""
    body = sensor.robot.body
    n = len(body.mesh.nodes)
    wide = patch_at(sensor.surface, body.mesh.nodes, touch.place, WIDE * sensor.surface.edge, body.clamped, facing=touch.normal)
    return wide.spread(force, n) - touch.patch.spread(force, n)
