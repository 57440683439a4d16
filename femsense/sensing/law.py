"""How far forces are off because the model is: by what it needs to move under gravity and cables as the body does, and by what another law would have
them be in the same state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.sensing.nuisance import commons
from femsense.sensing.types import Fit, Knowledge, Sensor


def response_std(knowledge: Knowledge, cameras: int) -> float:
    """Return how far the model's answer to a force may be off beside its answer to gravity and cables, relative [1].

    Gravity and cables pull as declared, but the model needs another modulus or other pulls to move as the body does (mesh, law, ties): what it
    needs of them, it needs of a contact. The root mean square of the pulls that the free frames ask for, and that of the modulus beside it.
    """
    asked = np.arange(6 * cameras, commons(knowledge))
    square = knowledge.mean[asked] ** 2 + (knowledge.root[asked] ** 2).sum(axis=1)
    return float(np.sqrt(square[0] + (square[1:].mean() if len(asked) > 1 else 0.0)))


def law_std(sensor: Sensor, fit: Fit, free: Equilibrium) -> FloatArray:
    """Return how much each force of a fit would differ under the neo-Hookean law, relative [1], shape (m,).

    The corotational law is linear in stretch. Where a contact squeezes the body, laws that agree for small strains differ. What the other law adds
    to the nodal forces between the free and the touched state moves the rows; so much of the forces moves them alike. 0 where the robot
    declares a law by an effect.

    Arguments:
        fit: the frame with its contacts.
        free: its state without them.
    """
    m, body = len(fit.touches), sensor.robot.body
    sizes = np.linalg.norm(fit.forces, axis=1)
    if not m or body.material.law != "corotational" or not sizes.all():
        return np.zeros(m)
    other = replace(body, material=replace(body.material, law="neo_hookean"))
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
