"""Hypotheses that differ from a fitted one in one contact: removed, added at an observed object, added where the linearised evidence is
highest, or moved.

To first order, a force f at a candidate lowers −2 log evidence by  max_f [2 gᵀf − fᵀ(M + D⁻²)f] − log det(I + D M D),  D = diag(τ, τ/2, τ/2):
g and M are the gradient and curvature of Φ with all parameters of the fit profiled out (`Vicinity`). Each proposal carries its expected decrease of J.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.fem.mesh import vertex_normals
from femsense.inference.mixture import first_width, misfit
from femsense.inference.rows import Rows
from femsense.pointcloud.rays import Surface
from femsense.sensing.fit import CATCH, SWAYING, axes_at, axes_of, fit, force_of, force_scale, whitened
from femsense.sensing.model import Fit, Model
from femsense.sensing.no_penetration import COMPLETED, is_with
from femsense.sensing.odds import HANGING, IN_SIGHT, in_sight, odds_of
from femsense.sensing.touches import make_touch
from femsense.sensing.types import Sensor, Touch

SIZES = (0.05, 0.2, 0.8)
"""Prior scales τ of a force for which the linearised evidence is evaluated [N]."""
SAME = 0.08
"""Contacts closer than this share of the body's diagonal are the same."""
SHORT = 10.0
"""Tolerance on the linearised gain of a contact at an observed object: the linearisation keeps the contact points fixed and therefore
underestimates it."""
FIRST = 0.1
"""Depth below the surface at which a line through the body starts [edges]."""
SEARCHED, CLOSE = 2, 20.0
"""Maximum number of fitted candidates, and maximum difference of −2 log evidence to the best one."""


@dataclass(frozen=True, eq=False, slots=True)
class Proposal:
    """A hypothesis to be fitted."""

    gain: float
    """Expected decrease of J."""
    contacts: tuple[Touch, ...]
    forces: FloatArray
    tau: FloatArray


def proposals(model: Model, best: Fit, seen: Sequence[Touch]) -> list[Proposal]:
    """Return hypotheses that differ from the best one so far in one contact, the most promising first; seen: contacts of observed
    objects."""
    near = vicinity(model, best)
    found = [*_dropped(best), *_at_objects(near, seen), *_at_candidates(near)]
    return sorted(found, key=lambda one: -one.gain)


def is_alike(model: Model, first: Sequence[Touch], second: Sequence[Touch]) -> bool:
    """Return whether two hypotheses have the same contacts: at the same places, and hanging weights where the other has them."""
    return len(first) == len(second) and all(
        a.pulls == b.pulls and float(np.linalg.norm(a.place - b.place)) < SAME * model.sensor.size for a, b in zip(first, second)
    )


def inferred_gain(model: Model, best: Fit) -> float:
    """Return the decrease of J by an additional inferred contact, marginalised over the candidates."""
    near = vicinity(model, best)
    return _inferred(near, at_candidates(near), pulls=False).gain


# --- the vicinity of a fit ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class Vicinity:
    """Φ about a fit, to second order in its whitened parameters p and in additional forces f:

    Φ(δp, f) = Φ + δpᵀ K δp + 2 δpᵀ S f + fᵀ Q f − 2 hᵀ δp − 2 bᵀ f
    """

    model: Model
    fit: Fit
    rows: Rows
    """Rows: pixels averaged over triangles, and all others."""
    weight: FloatArray
    """W of these rows [1/m²], shape (r,)."""
    X: FloatArray
    """Their derivatives by p: η̃, then (force along its axes, contact point) of each contact; shape (r, p)."""
    left: FloatArray
    """Their residual [m], shape (r,)."""
    at: FloatArray
    """Value of p at the fit, shape (p,)."""
    scale: FloatArray
    """Prior standard deviations of (force, contact point) of the contacts, shape (5 m,)."""
    K: FloatArray
    """I + Xᵀ W X."""

    def sites(self, answers: FloatArray) -> Sites:
        """Return the terms of Φ for forces at c points; answers: displacements under unit forces [m/N], shape (n, 3, 3c)."""
        D = self.rows.of(np.moveaxis(answers, 2, 0))
        WD, c = D * self.weight[:, None], answers.shape[2] // 3
        D3, W3 = (a.reshape(len(a), c, 3).transpose(1, 2, 0) for a in (D, WD))
        return Sites(WD.T @ self.left, W3 @ D3.transpose(0, 2, 1), self.X.T @ WD)

    def forces_after(self, change: FloatArray) -> FloatArray:
        """Return the forces of the contacts after changes of p, shape (c, p): [N], shape (c, m, 3)."""
        m = len(self.fit.contacts)
        whitened_forces = (self.at + change)[:, len(self.at) - 5 * m :].reshape(len(change), m, 5)[:, :, :3]
        return np.asarray(np.einsum("cmi,mij->cmj", whitened_forces * self.scale.reshape(m, 5)[:, :3], self.fit.axes))

    def own(self, i: int) -> slice:
        """Return the indices of the force of contact i in p."""
        first = self.X.shape[1] - len(self.scale) + 5 * i
        return slice(first, first + 3)


@dataclass(frozen=True, eq=False, slots=True)
class Sites:
    """Terms of Φ for forces at c points, with three components each."""

    b: FloatArray
    """Dᵀ W r, shape (3c,)."""
    Q: FloatArray
    """Dᵀ W D of each point, shape (c, 3, 3)."""
    S: FloatArray
    """Xᵀ W D, shape (p, 3c)."""


def vicinity(model: Model, best: Fit) -> Vicinity:
    """Return the expansion of Φ about a fit, with its noise widened to the residual."""
    rows, z = best.rows, best.left(model.nuisance)
    kappa = first_width(z, rows.pixel, best.frame.coloured, CATCH).of(rows.pixel)
    weight = misfit(z, rows.log_other, rows.share, kappa)[1] * rows.share / (kappa * rows.std) ** 2
    scale, at = whitened(model, best, trust=False)
    X = np.hstack([best.N, best.D * scale])
    mean = rows.averaged(weight)
    X, left, weight = mean.of_rows(X), mean.of_rows((z * rows.std)[:, None])[:, 0], mean.weight
    K = np.eye(X.shape[1]) + (X * weight[:, None]).T @ X
    return Vicinity(model, best, mean.rows, weight, X, left, np.append(best.eta, at), scale, K)


@dataclass(frozen=True, eq=False, slots=True)
class Additions:
    """One more contact at each of c places, to second order about a fit with m contacts."""

    gains: FloatArray
    """Decrease of −2 log evidence, shape (c,)."""
    forces: FloatArray
    """Force of the contact [N], shape (c, 3)."""
    others: FloatArray
    """Forces of the contacts of the fit at the same minimum of Φ [N], shape (c, m, 3)."""


def evidence_at(near: Vicinity, sites: Sites, axes: FloatArray, hangs: BoolArray, *, without: int | None = None) -> Additions:
    """Return what one more contact at each place gains.

    Arguments:
        axes: of the forces, outward normal (upward for a hanging weight) and two tangents, shape (c, 3, 3).
        hangs: which points are hanging weights, whose forces have no cone, shape (c,).
        without: a contact of the fit that is removed.
    """
    c, K, S, b = len(axes), near.K, sites.S, sites.b
    h = near.X.T @ (near.weight * near.left) - near.at
    kept = np.ones(len(K), dtype=bool)
    if without is not None:
        own = near.own(without)
        force = near.at[own]  # its contribution is added to the residual again
        b, h = b + S[own].T @ force, h + (K - np.eye(len(K)))[:, own] @ force
        kept[own.start : own.start + 5] = False
        K, S, h = K[np.ix_(kept, kept)], S[kept], h[kept]
    Y = np.linalg.solve(K, np.column_stack([S, h]))
    g = (b - S.T @ Y[:, -1]).reshape(c, 3)
    S3, Y3 = (a.reshape(len(a), c, 3).transpose(1, 2, 0) for a in (S, Y[:, :-1]))
    M = sites.Q - S3 @ Y3.transpose(0, 2, 1)
    g, M = np.einsum("cij,cj->ci", axes, g), axes @ M @ axes.transpose(0, 2, 1)
    friction = near.model.sensor.options.friction
    mu = np.where(hangs, np.inf, np.inf if friction is None else friction)
    gain, force = np.full(c, -np.inf), np.zeros((c, 3))
    for tau in SIZES:
        p = np.where(hangs[:, None], force_scale(tau, SWAYING), force_scale(tau))
        H = np.eye(3) + p[:, :, None] * M * p[:, None, :]
        f = np.linalg.solve(H, (p * g)[:, :, None])[:, :, 0] * p
        own_gain = (g * f).sum(axis=1) - np.linalg.slogdet(H)[1]
        outside = np.isfinite(mu) & (np.linalg.norm(f[:, 1:], axis=1) > -np.where(np.isfinite(mu), mu, 0.0) * f[:, 0])
        H0 = 1.0 + tau**2 * M[:, 0, 0]
        along = tau**2 * g[:, 0] / H0
        own_gain = np.where(outside, g[:, 0] * along - np.log(H0), own_gain)
        f = np.where(outside[:, None], along[:, None] * np.array([1.0, 0.0, 0.0]), f)
        better = np.where(f[:, 0] < 0.0, own_gain, -np.inf) > gain
        gain[better], force[better] = own_gain[better], f[better]
    force = np.einsum("ci,cij->cj", force, axes)
    change = np.zeros((c, len(kept)))
    change[:, kept] = Y[:, -1] - np.einsum("pci,ci->cp", Y[:, :-1].reshape(-1, c, 3), force)
    return Additions(gain, force, near.forces_after(change))


# --- proposals ------------------------------------------------------------------------------------------------------------


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


def _at_objects(near: Vicinity, seen: Sequence[Touch]) -> list[Proposal]:
    """Return additional contacts at observed objects, and observed objects in place of contacts whose place is known less well."""
    model, best = near.model, near.fit
    new = [one for one in seen if not _is_there(model, best, one)]
    if not new:
        return []
    sites = _at_touches(near, new)
    axes, push = axes_at(model, new, best.state), np.zeros(len(new), dtype=bool)
    odds = np.array([odds_of(model, one, best.rows) for one in new])
    added = evidence_at(near, sites, axes, push)
    gains = added.gains - odds
    found = [_added(best, new[c], added, int(c), gains[c]) for c in np.flatnonzero(gains > -SHORT)]
    for i, contact in enumerate(best.contacts):
        if _is_placed_worse(contact):
            instead = evidence_at(near, sites, axes, push, without=i)
            gains = instead.gains - odds + best.odds[i] - best.drop_gain[i]
            found += [_replaced(best, i, new[c], instead, int(c), gains[c]) for c in np.flatnonzero(gains > -SHORT)]
    return found


def _at_touches(near: Vicinity, touches: Sequence[Touch]) -> Sites:
    """Return the terms of Φ for forces at possible contacts."""
    best, n = near.fit, len(near.fit.state.positions)
    loads = np.array([one.patch.spread(axis, n) for one in touches for axis in np.eye(3)])
    return near.sites(np.moveaxis(best.linearised.tangent.respond(loads), 0, 2))


def _is_placed_worse(contact: Touch) -> bool:
    """Return whether the place of a contact is inferred, or given by points of an object whose shape is unknown."""
    return contact.source == "shape" or (contact.shape is not None and contact.shape.kind not in COMPLETED)


def _is_there(model: Model, best: Fit, seen: Touch) -> bool:
    """Return whether a hypothesis has a contact at an observed object, or with one of no better known shape next to it."""
    reach, known = max(SAME * model.sensor.size, 2.0 * seen.std_m), not _is_placed_worse(seen)
    near = [c for c in best.contacts if c.source == "cloud" and float(np.linalg.norm(c.place - seen.place)) < reach]
    return any(not (known and _is_placed_worse(c)) for c in near) or any(
        is_with(contact, seen.shape) for contact in best.contacts
    )


def _at_candidates(near: Vicinity) -> list[Proposal]:
    """Return inferred contacts (pushing; hanging too if there is gravity): additional ones, and replacements of contacts without which they
    fit better."""
    best, at = near.fit, at_candidates(near)
    found = []
    for pulls in (False, True) if near.model.upward.any() else (False,):
        added = _inferred(near, at, pulls=pulls)
        if added.gain > 0.0:
            found += [_added(best, contact, added.at, c, added.gain) for c, contact in added.places(near.model.sensor)]
        for i, odds in enumerate(best.odds):
            moved = _inferred(near, at, pulls=pulls, without=i)
            gain = moved.gain + float(odds)
            if gain > 0.0:
                found += [_replaced(best, i, contact, moved.at, c, gain) for c, contact in moved.places(near.model.sensor)]
    return found


def _added(best: Fit, contact: Touch, at: Additions, c: int, gain: float) -> Proposal:
    """Return the hypothesis with one more contact, at place c of some, all forces at their common minimum."""
    force = at.forces[c]
    return Proposal(float(gain), (*best.contacts, contact), np.vstack([at.others[c], force]), np.append(best.tau, _tau(force)))


def _replaced(best: Fit, i: int, contact: Touch, at: Additions, c: int, gain: float) -> Proposal:
    """Return the hypothesis with another contact instead of contact i, at place c of some, all forces at their common minimum."""
    contacts, forces, tau = list(best.contacts), at.others[c].copy(), best.tau.copy()
    contacts[i], forces[i], tau[i] = contact, at.forces[c], _tau(at.forces[c])
    return Proposal(float(gain), tuple(contacts), forces, tau)


def _tau(force: FloatArray) -> float:
    return max(float(np.linalg.norm(force)), 0.05)


@dataclass(frozen=True, eq=False, slots=True)
class AtCandidates:
    """Terms of Φ for an inferred contact at each candidate."""

    sites: Sites
    normals: FloatArray
    """Outward normals, shape (c, 3)."""
    seen: BoolArray
    """Whether the candidate is visible, shape (c,)."""


def at_candidates(near: Vicinity) -> AtCandidates:
    """Return the terms of Φ for an inferred contact at each candidate, about a fit."""
    model, best = near.model, near.fit
    nodes, x = model.sensor.candidates, best.state.positions
    normals = vertex_normals(x, model.sensor.surface.triangles)[nodes]
    return AtCandidates(near.sites(model.answers_near(best.state)), normals, in_sight(model, best.rows, model.skin.rest[nodes]))


@dataclass(frozen=True, eq=False, slots=True)
class Inferred:
    """An additional contact at one of the candidates."""

    gain: float
    """By how much it lowers J, marginalised over the candidates; relative to the place of the contact that it replaces."""
    at: Additions
    """At each candidate; its gains are decreases of J."""
    pulls: bool

    def places(self, sensor: Sensor) -> list[tuple[int, Touch]]:
        """Return the best candidates, as (index, contact)."""
        gains, std = self.at.gains, float(np.sqrt(sensor.surface.area.sum() / (2.0 * np.pi)))
        found: list[tuple[int, Touch]] = []
        for c in np.argsort(-gains):
            place = sensor.robot.body.mesh.nodes[sensor.candidates[c]]
            if len(found) == SEARCHED or gains[c] < gains.max() - CLOSE:
                break
            if all(np.linalg.norm(place - contact.place) > SAME * sensor.size for _, contact in found):
                contact = make_touch(sensor, place, source="shape", std_m=std)
                found.append((int(c), replace(contact, pulls=self.pulls)))
        return found


def _inferred(near: Vicinity, at: AtCandidates, *, pulls: bool, without: int | None = None) -> Inferred:
    """Return the gain of an additional contact at the candidates.

    Arguments:
        pulls: consider hanging weights, whose forces have no cone.
        without: a contact of the fit that is removed; the gain is then relative to its own position.
    """
    added = _at_all(near, at, pulls=pulls, without=without)
    gains = added.gains
    top = float(gains.max())
    if not np.isfinite(top):
        return Inferred(-np.inf, added, pulls)
    # All candidates are equally likely beforehand.
    total = (
        top + 2.0 * float(np.log(np.exp(0.5 * (gains - top)).mean()))
        if without is None
        else top - _gain_at_own_place(near, without)
    )
    return Inferred(total, added, pulls)


def _at_all(near: Vicinity, at: AtCandidates, *, pulls: bool, without: int | None) -> Additions:
    """Return one more contact at each candidate, with the decrease of J as its gain."""
    c = len(at.normals)
    axes = axes_of(np.broadcast_to(near.model.upward, (c, 3)) if pulls else at.normals)
    added = evidence_at(near, at.sites, axes, np.full(c, pulls), without=without)
    odds = near.model.inferred_odds + (HANGING if pulls else IN_SIGHT * at.seen)
    return replace(added, gains=added.gains - odds)


def elsewhere(model: Model, best: Fit) -> FloatArray:
    """Return the covariance of each contact point due to the posterior probability of other candidates [m²], shape (m, 3, 3); 0 for visible
    and given contacts.

    The deformation of a thin body hardly depends on the side on which a force acts. The Laplace approximation about the best point ignores
    the other side, so the contact is fitted there too. That point has the Laplace volume of the best one; each candidate has its share of
    the surface.
    """
    added = np.zeros((len(best.contacts), 3, 3))
    inferred = [i for i, contact in enumerate(best.contacts) if contact.source == "shape"]
    if not inferred:
        return added
    near, nodes, positions = vicinity(model, best), model.sensor.candidates, best.state.positions
    at = at_candidates(near)
    share = float(model.sensor.surface.area.sum()) / len(nodes)
    ways = (False, True) if model.upward.any() else (False,)
    for i in inferred:
        place, own = best.contacts[i].patch.mean(positions), _gain_at_own_place(near, i) - best.odds[i]
        if not np.isfinite(own):  # no admissible force there, to first order
            continue
        volume = min(2.0 * np.pi * float(np.sqrt(np.prod(np.linalg.eigvalsh(best.place_covariance[i])[1:]))), share)
        points, mass = positions[nodes] - place, np.zeros(len(nodes))
        for pulls in ways:
            mass += share * _likelihood(_at_all(near, at, pulls=pulls, without=i).gains - own)
        mass[np.linalg.norm(points, axis=1) < np.sqrt(share)] = 0.0
        if (other := _on_other_side(model, best, i)) is not None:
            way = other.contacts[i].patch.mean(other.state.positions) - place
            mass[np.linalg.norm(points - way, axis=1) < np.sqrt(share)] = 0.0
            points = np.vstack([points, way])
            mass = np.append(mass, volume * _likelihood(np.array(best.criterion - other.criterion)))
        added[i] = (points * mass[:, None]).T @ points / (volume + mass.sum())
    return added


def _likelihood(gain: FloatArray) -> FloatArray:
    """Return the posterior odds of a decrease of J; at most 1, since the search rejected larger ones."""
    return np.asarray(np.exp(0.5 * np.minimum(gain, 0.0)))


def _on_other_side(model: Model, best: Fit, i: int) -> Fit | None:
    """Return the fit with an inferred contact at the opposite side of the body along its force: a push if the force points into the body
    there, else a hanging weight; None if neither is admissible."""
    positions, contact = best.state.positions, best.contacts[i]
    axis, place = best.axes[i][0], contact.patch.mean(positions)
    body, within = Surface(positions, model.sensor.surface.triangles), FIRST * model.sensor.surface.edge
    for way in (-axis, axis):
        hits = body.cast((place + model.sensor.size * way)[None], (place + within * way)[None], reach=np.inf)
        if len(hits.nodes) and hits.normal[0] @ way > 0.0:
            touch = make_touch(model.sensor, hits.place(model.skin.rest)[0], source="shape", std_m=contact.std_m)
            contacts = list(best.contacts)
            contacts[i] = replace(touch, pulls=bool(best.forces[i] @ hits.normal[0] >= 0.0))
            if contacts[i].pulls and best.forces[i] @ model.upward >= 0.0:  # not the direction of a weight
                return None
            return fit(model, best.frame, contacts, best.forces, best.state, eta=best.eta, tau=best.tau)
    return None


def _gain_at_own_place(near: Vicinity, i: int) -> float:
    """Return the decrease of −2 log evidence by contact i at its own position."""
    own, contact = near.own(i), near.fit.contacts[i]
    scale = near.scale[force_of(i)]
    XWX = near.K - np.eye(len(near.K))
    sites = Sites(
        (near.X[:, own].T @ (near.weight * near.left)) / scale,
        (XWX[own, own] / np.outer(scale, scale))[None],
        XWX[:, own] / scale,
    )
    return float(evidence_at(near, sites, np.eye(3)[None], np.array([contact.pulls]), without=i).gains[0])
