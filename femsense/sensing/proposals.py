"""Hypotheses next to a fitted one: a contact dropped, added at a seen object, added where the linearised evidence is highest, or moved elsewhere.

To first order, a force f at a candidate lowers −2 log evidence by  max_f [2 gᵀf − fᵀ(M + D⁻²)f] − log det(I + D M D),  D = diag(τ, τ/2, τ/2):
g and M are the gradient and curvature of Φ with all parameters of the fit profiled out. Each proposal carries its expected decrease of J.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.fem.mesh import vertex_normals
from femsense.inference.mixture import first_width, misfit
from femsense.sensing.fit import CATCH, SWAYING, across, axes_at, axes_of, contact_columns, force_scale
from femsense.sensing.model import Fit, Model
from femsense.sensing.no_penetration import is_with
from femsense.sensing.odds import HANGING, IN_SIGHT, in_sight, odds_of
from femsense.sensing.places import away_from_scenery, object_touches
from femsense.sensing.touches import make_touch, touch_normal, ways_of
from femsense.sensing.types import Touch

SIZES = (0.05, 0.2, 0.8)
"""Prior scales τ of a force for which the linearised evidence is taken [N]."""
THIN = 2500
"""Rows of the linearised evidence at most."""
SAME = 0.08
"""Contacts within this share of the body's diagonal are one."""
STALE = 0.03
"""Answers at the candidates serve while no node has moved farther than this share of the diagonal: they rank, and do not estimate."""
SHORT = 10.0
"""By how much the linearised gain of a contact at a seen object may fall short of the fitted one: it keeps the contact points."""
SEARCHED, CLOSE = 2, 20.0
"""Candidates that are fitted, the best first, and by how much −2 log evidence of the last may be below the first."""


@dataclass(frozen=True, eq=False, slots=True)
class Proposal:
    """A hypothesis that is worth a fit."""

    gain: float
    """Expected decrease of J."""
    contacts: tuple[Touch, ...]
    forces: FloatArray
    tau: FloatArray


def proposals(model: Model, best: Fit) -> list[Proposal]:
    """Return hypotheses next to the best one so far, the most promising first."""
    seen = away_from_scenery(model.sensor, object_touches(model.sensor, list(best.frame.objects), best.state))
    found = [*_dropped(best), *_at_objects(model, best, seen), *_inferred(model, best), *_elsewhere(model, best)]
    return sorted(found, key=lambda one: -one.gain)


def _dropped(best: Fit) -> list[Proposal]:
    found = []
    for i in np.flatnonzero(best.drop_gain < best.odds):
        kept = [j for j in range(len(best.contacts)) if j != i]
        found.append(
            Proposal(
                float(best.odds[i] - best.drop_gain[i]),
                tuple(best.contacts[j] for j in kept),
                best.forces[kept],
                best.tau[kept],
            )
        )
    return found


def _at_objects(model: Model, best: Fit, seen: Sequence[Touch]) -> list[Proposal]:
    """Return additions at seen objects that are no contact yet, and inferred contacts replaced by them."""
    new = [one for one in seen if not _is_there(model, best, one)]
    if not new:
        return []
    n = len(best.state.positions)
    loads = np.array([one.patch.spread(axis, n) for one in new for axis in np.eye(3)])
    answers = np.moveaxis(best.linearised.tangent.respond(loads), 0, 2)
    normals = np.array([touch_normal(model.sensor, one, best.state) for one in new])
    odds = np.array([odds_of(model, one, best.rows) for one in new])
    gains, forces = linearised_evidence(model, best, answers, normals)
    found = [_added(best, one, f, g - L) for one, g, f, L in zip(new, gains, forces, odds) if g > L - SHORT]
    for i, contact in enumerate(best.contacts):
        if contact.source == "shape":
            gains, forces = linearised_evidence(model, best, answers, normals, without=i)
            found += [
                _replaced(best, i, one, f, g - L + best.odds[i] - best.drop_gain[i])
                for one, g, f, L in zip(new, gains, forces, odds)
                if g - L + best.odds[i] > -SHORT
            ]
    return found


def _is_there(model: Model, best: Fit, seen: Touch) -> bool:
    """Return whether a hypothesis has a contact at a seen object."""
    reach = max(SAME * model.sensor.size, 2.0 * seen.std_m)
    near = [c for c in best.contacts if c.source == "cloud" and float(np.linalg.norm(c.place - seen.place)) < reach]
    return bool(near) or any(is_with(contact, seen.shape) for contact in best.contacts)


def _inferred(model: Model, best: Fit) -> list[Proposal]:
    result = []
    for pulls in _ways_of_acting(model):
        gain, found = inferred(model, best, pulls=pulls)
        result += [_added(best, contact, force, gain) for contact, force in found] if gain > 0.0 else []
    return result


def _ways_of_acting(model: Model) -> tuple[bool, ...]:
    """Return whether an inferred contact may push (False), and hang (True) where there is gravity."""
    return (False, True) if model.upward.any() else (False,)


def _elsewhere(model: Model, best: Fit) -> list[Proposal]:
    """Return each contact replaced by an inferred one that fits better while it is removed."""
    found = []
    for i, pulls in product(range(len(best.contacts)), _ways_of_acting(model)):
        gain, others = inferred(model, best, without=i, pulls=pulls)
        if gain + best.odds[i] > 0.0:
            found += [_replaced(best, i, contact, force, gain + best.odds[i]) for contact, force in others]
    return found


def _added(best: Fit, contact: Touch, force: FloatArray, gain: float) -> Proposal:
    return Proposal(float(gain), (*best.contacts, contact), np.vstack([best.forces, force]), np.append(best.tau, _tau(force)))


def _replaced(best: Fit, i: int, contact: Touch, force: FloatArray, gain: float) -> Proposal:
    contacts, forces, tau = list(best.contacts), best.forces.copy(), best.tau.copy()
    contacts[i], forces[i], tau[i] = contact, force, _tau(force)
    return Proposal(float(gain), tuple(contacts), forces, tau)


def _tau(force: FloatArray) -> float:
    return max(float(np.linalg.norm(force)), 0.05)


def inferred(
    model: Model, best: Fit, *, without: int | None = None, pulls: bool = False
) -> tuple[float, list[tuple[Touch, FloatArray]]]:
    """Return by how much one more contact lowers J, marginalised over the candidates, and the best places with their forces.

    Arguments:
        without: a contact of the fit that is removed; the gain is then relative to its own place.
        pulls: ask for hanging weights, whose forces keep to no cone.
    """
    sensor, x = model.sensor, best.state.positions
    answers, normals = answers_at(model, best), vertex_normals(x, sensor.surface.triangles)[sensor.candidates]
    if without is not None:
        own = best.contacts[without]
        moves = best.linearised.tangent.respond(np.array([own.patch.spread(axis, len(x)) for axis in np.eye(3)]))
        answers = np.concatenate([answers, np.moveaxis(moves, 0, 2)], axis=2)
        normals = np.vstack([normals, axes_at(model, [own], best.state)[0, 0]])
    hangs = np.full(len(normals), pulls)
    if without is not None:
        hangs[-1] = best.contacts[without].pulls
    normals = np.where(hangs[:, None], model.upward, normals)
    gains, forces = linearised_evidence(model, best, answers, normals, without=without, hangs=hangs)
    at_own = 0.0
    if without is not None:
        gains, forces, at_own = gains[:-1], forces[:-1], float(gains[-1])
    seen = np.zeros(len(gains), dtype=bool) if pulls else in_sight(model, best.rows, model.skin.rest[sensor.candidates])
    gains = gains - model.inferred_odds - (HANGING if pulls else IN_SIGHT * seen)
    if not np.isfinite(gains).any():
        return -np.inf, []
    top = float(gains.max())
    total = top + 2.0 * np.log(np.exp(0.5 * (gains - top)).mean())  # all candidates are equally likely beforehand
    std = float(np.sqrt(sensor.surface.area.sum() / (2.0 * np.pi)))
    found: list[tuple[Touch, FloatArray]] = []
    for i in np.argsort(-gains):
        place = sensor.robot.body.mesh.nodes[sensor.candidates[i]]
        if len(found) == SEARCHED or gains[i] < top - CLOSE:
            break
        if all(np.linalg.norm(place - contact.place) > SAME * sensor.size for contact, _ in found):
            found.append((replace(make_touch(sensor, place, source="shape", std_m=std), pulls=pulls), forces[i]))
    return (top - at_own if without is not None else total), found


def answers_at(model: Model, best: Fit) -> FloatArray:
    """Return displacements under unit forces at the candidates near the state of a fit [m/N], shape (n, 3, 3c)."""
    kept, x = model.candidates, best.state.positions
    if kept.answers is None or kept.positions is None or np.abs(kept.positions - x).max() > STALE * model.sensor.size:
        nodes = model.sensor.candidates
        loads = np.zeros((len(nodes), 3, len(x), 3))
        loads[np.arange(len(nodes)), :, nodes] = np.eye(3)
        moves = best.linearised.tangent.respond(loads.reshape(-1, len(x), 3))
        kept.positions, kept.answers = x, np.ascontiguousarray(np.moveaxis(moves, 0, 2))
    return kept.answers


def linearised_evidence(
    model: Model,
    best: Fit,
    answers: FloatArray,
    normals: FloatArray,
    *,
    without: int | None = None,
    hangs: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the decrease of −2 log evidence by one more contact at each candidate, shape (c,), and its force [N], shape (c, 3).

    Arguments:
        answers: displacements under unit forces [m/N], shape (n, 3, 3c).
        normals: outward, shape (c, 3).
        without: a contact of the fit that is removed.
        hangs: candidates that are hanging weights, whose normals point upwards and whose forces keep to no cone, shape (c,).
    """
    rows, z = best.rows, best.left(model.nuisance)
    kappa = first_width(z, rows.pixel, best.frame.coloured, CATCH).of(rows.pixel)
    pixels = np.flatnonzero(rows.pixel)
    thin = np.concatenate([pixels[:: max(1, len(pixels) // THIN)], np.flatnonzero(~rows.pixel)])
    part = rows.some(thin)
    N, residual = best.N[thin], z[thin] * part.std
    if best.contacts:
        axes = axes_at(model, best.contacts, best.state)
        J = contact_columns(model, replace(best, rows=part), axes, best.linearised)
        kept = np.ones(J.shape[1], dtype=bool)
        if without is not None:
            own = slice(5 * without, 5 * without + 3)
            kept[5 * without : 5 * without + 5] = False
            residual = residual + J[:, own] @ (axes[without] @ best.forces[without])
        scale = np.concatenate(
            [[*force_scale(t, across(model, c)), *_free_ways(c, f)] for c, f, t in zip(best.contacts, best.forces, best.tau)]
        )
        N = np.hstack([N, (J * scale)[:, kept]])
    weight = misfit(z[thin], part.log_other, part.share, kappa[thin])[1] * part.share / (kappa[thin] * part.std) ** 2
    weight *= np.where(part.pixel, len(pixels) / max(part.pixel.sum(), 1), 1.0)
    D = part.of(np.moveaxis(answers, 2, 0))
    WD, WN = D * weight[:, None], N * weight[:, None]
    K = np.eye(N.shape[1]) + N.T @ WN
    S = N.T @ WD
    X = np.linalg.solve(K, S)
    g = WD.T @ residual - S.T @ np.linalg.solve(K, WN.T @ residual)
    c = len(normals)
    D3, W3, S3, X3 = (a.reshape(len(a), c, 3).transpose(1, 2, 0) for a in (D, WD, S, X))
    M = W3 @ D3.transpose(0, 2, 1) - S3 @ X3.transpose(0, 2, 1)
    R = np.array([axes_of(normal) for normal in normals])
    g, M = np.einsum("cij,cj->ci", R, g.reshape(c, 3)), R @ M @ R.transpose(0, 2, 1)
    friction = model.sensor.options.friction
    hangs = np.zeros(c, dtype=bool) if hangs is None else hangs
    mu = np.where(hangs, np.inf, np.inf if friction is None else friction)
    gain, force = np.full(c, -np.inf), np.zeros((c, 3))
    for tau in SIZES:
        p = np.where(hangs[:, None], force_scale(tau, SWAYING), force_scale(tau))
        H = np.eye(3) + p[:, :, None] * M * p[:, None, :]
        f = np.linalg.solve(H, (p * g)[:, :, None])[:, :, 0] * p
        own = (g * f).sum(axis=1) - np.linalg.slogdet(H)[1]
        outside = np.isfinite(mu) & (np.linalg.norm(f[:, 1:], axis=1) > -np.where(np.isfinite(mu), mu, 0.0) * f[:, 0])
        H0 = 1.0 + tau**2 * M[:, 0, 0]
        along = tau**2 * g[:, 0] / H0
        own = np.where(outside, g[:, 0] * along - np.log(H0), own)
        f = np.where(outside[:, None], along[:, None] * np.array([1.0, 0.0, 0.0]), f)
        better = np.where(f[:, 0] < 0.0, own, -np.inf) > gain
        gain[better], force[better] = own[better], f[better]
    return gain, np.einsum("ci,cij->cj", force, R)


def _free_ways(contact: Touch, force: FloatArray) -> FloatArray:
    return ways_of(contact)[1] if contact.std_m > 0.0 and force.any() else np.zeros(2)
