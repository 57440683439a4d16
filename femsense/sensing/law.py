"""The material's law where none is declared, and how far forces may be off because it is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.model.robot import Robot
from femsense.sensing.types import Fit, Sensor

LIKELY = "neo_hookean"
"""The law of an elastomer whose robot declares none. The corotational law, linear in stretch, lets a body yield ever more where it is squeezed
(docs/forces.md, Measured, has both on the same recordings)."""


def with_likely_law(robot: Robot) -> Robot:
    """Return a robot with the law that an elastomer likely has, from the same modulus and Poisson ratio."""
    return robot.with_body(robot.body.with_material(replace(robot.body.material, law=LIKELY)))


def law_std(sensor: Sensor, fit: Fit, free: Equilibrium) -> FloatArray:
    """Return how much each force of a fit would differ under the corotational law, relative [1], shape (m,).

    Where a contact squeezes the body, laws that agree for small strains differ. What the other law adds to the nodal forces between the free
    and the touched state moves the rows; so much of the forces moves them alike. 0 where the law is not assumed, but declared by an effect.

    Arguments:
        fit: the frame with its contacts.
        free: its state without them.
    """
    m, body = len(fit.touches), sensor.robot.body
    sizes = np.linalg.norm(fit.forces, axis=1)
    if not m or not sensor.law_is_assumed or not sizes.all():
        return np.zeros(m)
    other = replace(body, material=replace(body.material, law="corotational"))
    extra = _between(other, fit, free) - _between(body, fit, free)
    if not np.isfinite(extra).all():
        return np.ones(m)
    n = len(fit.state.positions)
    loads = np.array([t.patch.spread(force, n) for t, force in zip(fit.touches, fit.forces)])
    std = fit.rows.std / np.sqrt(fit.rows.weight)
    tangent = tangent_at(body, fit.state) if fit.response is None else fit.response.tangent
    moves = fit.rows.functional(tangent.respond(np.concatenate([loads, extra[None]]))) / std[:, None]
    return np.asarray(np.abs(np.linalg.lstsq(moves[:, :m], moves[:, m], rcond=None)[0]))


def _between(body: BodyModel, fit: Fit, free: Equilibrium) -> FloatArray:
    """Return the internal forces that a body adds from the free to the touched state [N], shape (n, 3); inf where one is inside out."""
    touched, alone = (internal(body, one.positions, tangent=False) for one in (fit.state, free))
    return touched.forces - alone.forces if np.isfinite(touched.energy - alone.energy) else np.full_like(touched.forces, np.inf)
