"""Objects in touch whose force the data do not determine: they stay in the hypothesis, under a wide prior, for the sake of their neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.sensing.fit import fit
from femsense.sensing.model import Fit, Model
from femsense.sensing.no_penetration import COMPLETED, in_touch, is_rigid, is_with
from femsense.sensing.status import UNDETERMINED, std_along
from femsense.sensing.types import Touch

UNDETERMINED_TAU = 2.0
"""Prior scale of the force at an object in touch whose force the data do not determine [N]; hands and grippers press with so much."""
MANY = 30
"""Minimum number of pixels of an object without a known shape that can carry a latent force."""


def with_undetermined(model: Model, best: Fit, touching: Sequence[Touch]) -> Fit:
    """Return a hypothesis fitted again with the objects in touch that are no contacts of it, whatever J says.

    These objects have no significant force. Left out, they would bias the forces of their neighbours and make the neighbours' intervals too narrow. An object
    whose surface lies at the body's becomes a contact with a wide prior, another object a latent force. Visible contacts without a significant force get the
    wide prior, too: of two tips that squeeze a body the pixels determine the difference only, and the τ of highest evidence would make both forces zero.
    """
    others = [t for t in touching if _is_object(t) and not any(is_with(c, t.shape) for c in best.contacts)]
    at_surface = [replace(t, undetermined=True) for t in others if in_touch(model, t, best.state.positions)]
    latent = [t for t in others if not any(is_with(c, t.shape) for c in at_surface)]
    if at_surface or latent:
        best = _under_wide_prior(model, replace(best, frame=replace(best.frame, latent=tuple(latent))), at_surface)
    return _under_wide_prior(model, best, ()) if any(_insignificant(model, best)) else best


def _insignificant(model: Model, best: Fit) -> list[bool]:
    """Return for each contact whether it is visible and its force is not significant, under a prior that was sized by this force."""
    return [
        is_rigid(model, contact) and not contact.undetermined and float(np.linalg.norm(force)) < UNDETERMINED * std_along(best, i)
        for i, (contact, force) in enumerate(zip(best.contacts, best.forces))
    ]


def _under_wide_prior(model: Model, best: Fit, more: Sequence[Touch]) -> Fit:
    """Return a hypothesis with more contacts, fitted again with the prior scale UNDETERMINED_TAU for these and for contacts without a significant force.

    The other visible contacts begin with this scale: their τ was sized while the forces opposite to them were zero.
    """
    wide = [contact.undetermined or small for contact, small in zip(best.contacts, _insignificant(model, best))]
    tau = [UNDETERMINED_TAU if is_rigid(model, contact) else own for contact, own in zip(best.contacts, best.tau)]
    again = fit(
        model,
        best.frame,
        [*(replace(contact, undetermined=own) for contact, own in zip(best.contacts, wide)), *more],
        np.vstack([best.forces, np.zeros((len(more), 3))]),
        best.state,
        eta=best.eta,
        tau=np.append(tau, np.full(len(more), UNDETERMINED_TAU)),
        linearised=best.linearised,
    )
    return best if again is None else again


def _is_object(contact: Touch) -> bool:
    """Return whether a contact is with an object of known shape, or of at least MANY pixels: fewer may be a part of the scene."""
    shape = contact.shape
    return shape is not None and (shape.kind in COMPLETED or len(shape.points) >= MANY)
