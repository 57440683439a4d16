"""The constitutive law of the states that are fitted, and how much a force depends on it and on the zones of line and face contacts.

A robot that declares no law is corotational by the contract, which fits small strains. Under contacts strains are large, and in compression rubber stiffens
as a neo-Hookean body does, so the fitted states are neo-Hookean with the same moduli. The true law may lie anywhere between the two: of a uniform distribution
the root mean square deviation from one end is 1/√3 of its width.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.calib.other_law import with_other_law
from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.compliance import tangent_near
from femsense.sensing.fit import force_of, whitened
from femsense.sensing.model import Fit, Model
from femsense.sensing.touches import longer_patch
from femsense.sensing.types import Sensor


def neo_hookean(sensor: Sensor) -> Sensor | None:
    """Return the sensor with a neo-Hookean body; None if the robot declares its law, or if forces come from markers, whose camera pose `calibrate` has
    determined with the declared law."""
    robot = with_other_law(sensor.robot)
    if robot is None or not sensor.recording.has_clouds:
        return None
    return replace(sensor, robot=robot, driven=replace(sensor.driven, robot=robot))


BETWEEN = 1.0 / np.sqrt(3.0)
"""Standard deviation of a force due to the law, relative to its change under the other law."""


def moved_by_law(model: Model, fit: Fit) -> FloatArray:
    """Return the change of the forces under the other law, to first order [N], shape (3m,); zero if the robot declares its law.

    Under the other law the same inputs and forces leave the internal forces δr unbalanced, which moves the body by −K⁻¹ δr. The displacement of the predicted
    state x₀ is in the nuisance parameters that the contact-free frames determine, so that the rows change by −H (K⁻¹ δr(x) − K₀⁻¹ δr(x₀)), H their
    derivatives with the nodes. One Gauss–Newton step from the optimum gives

        δp = A⁻¹ Xᵀ W H (K⁻¹ δr(x) − K₀⁻¹ δr(x₀)) .

    Raises:
        FemsenseError: the predicted state is unstable.
    """
    sensor, m = model.sensor, len(fit.contacts)
    body, predicted = sensor.robot.body, fit.frame.predicted
    if sensor.declares_law or not m:
        return np.zeros(3 * m)
    law = "corotational" if body.material.law == "neo_hookean" else "neo_hookean"
    other = body.with_material(replace(body.material, law=law))
    unbalanced = [_unbalanced(body, other, x) for x in (fit.state.positions, predicted.positions)]
    if not np.isfinite(unbalanced).all():  # an element is inverted; the status tells
        return np.zeros(3 * m)
    displacement = fit.linearised.tangent.respond(unbalanced[0][None]) - tangent_near(body, predicted).respond(
        unbalanced[1][None]
    )
    return np.asarray(_compensated(model, fit, displacement)[0])


def moved_by_zones(model: Model, fit: Fit) -> FloatArray:
    """Return the changes of the forces, to first order [N], if the zone of one line or face contact were half or twice as long, over √2: shape (2k, 3m) for
    k such contacts.

    How far a rod or plate touches depends on the curvature of the body and on the force; the gaps by which the zone is estimated tell it within a factor of
    two. A shorter zone dents the body more under the same force.
    """
    n, loads = len(fit.state.positions), []
    for contact, force in zip(fit.contacts, fit.forces):
        if contact.along is not None:
            own = contact.patch.spread(force, n)
            loads += [longer_patch(model.sensor, contact, times).spread(force, n) - own for times in (0.5, 2.0)]
    if not loads:
        return np.zeros((0, 3 * len(fit.contacts)))
    return np.asarray(_compensated(model, fit, -fit.linearised.tangent.respond(np.array(loads))) / np.sqrt(2.0))


def _compensated(model: Model, fit: Fit, displacements: FloatArray) -> FloatArray:
    """Return the changes of the forces by which the fit makes up for displacements (k, n, 3) that the model misses [m], shape (k, 3m) [N]."""
    m, scale = len(fit.contacts), whitened(model, fit, trust=False)[0]
    X = np.hstack([fit.D * scale, fit.N])
    WX = X * fit.weight[:, None]
    change = scale[:, None] * np.linalg.solve(np.eye(X.shape[1]) + X.T @ WX, WX.T @ fit.rows.of(displacements))[: 5 * m]
    return np.concatenate([axes.T @ change[force_of(i)] for i, axes in enumerate(fit.axes)]).T


def _unbalanced(body: BodyModel, other: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the internal forces of another body of the same mesh minus those of a body [N], shape (n, 3); not finite if an element is inverted."""
    there = internal(other, positions, tangent=False)
    return there.forces - internal(body, positions, tangent=False).forces + (0.0 if np.isfinite(there.energy) else np.nan)
