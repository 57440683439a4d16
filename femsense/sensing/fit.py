"""Fitting a hypothesis: the minimum of Φ over forces, contact points and nuisance parameters, and its Laplace approximation.

    Φ = Σ_j (1/T_j) · −2 log[exp(−z_j²/2) + o_j] + |η̃|² + |f̃|² + |s̃|²,   z = (r(x(f, s)) − C(μ + R η̃)) / σ
    E = min Φ + log det A,   A = I + Xᵀ W X

    r: residual of a pixel, marker or gap [m];  σ, T: its noise and overdispersion;  o: odds that it does not show the robot
    f̃: force over its prior scale;  s̃: shift of the contact point over its standard deviation;  η̃: whitened nuisance with prior mean μ and root R
    X = [D · scales, N]: derivatives of the modelled rows with (f̃, s̃) and η̃, N = C R;  W: weights of the rows, responsibility/(σ² T)

    The normal force f_n of a visible contact has a prior uniform in log f_n, since E chooses its scale τ. The minimum is taken in log f_n, where this prior is
    flat: f̃_n² is left out while Φ is minimised, and A has 1 less in its diagonal where the covariance is computed from it. E contains both.

Gauss–Newton steps over all of (f̃, s̃, η̃) with iteratively reweighted rows; each state is a new equilibrium. The tangent of one state is kept for those near
it (chord method). E, which is −2 log evidence up to a constant, is the lower the better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import FemsenseError
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.mixture import Width, first_width
from femsense.inference.nuisance import columns, fit_nuisance
from femsense.inference.rows import Rows, stacked
from femsense.sensing.cone import within_cones
from femsense.sensing.model import Fit, Frame, Linearised, Model
from femsense.sensing.no_penetration import gap_rows
from femsense.sensing.odds import odds_of
from femsense.sensing.touches import moved_to, nodal_forces_by_shift, pressed, touch_normal, ways_of
from femsense.sensing.types import Touch

ACROSS = 0.5
"""Prior scale of a force across the normal relative to the scale τ along the normal: friction coefficients of skins."""
SWAYING = 0.1
"""Prior scale of a hanging weight across gravity relative to the scale along gravity: a thread that is not quite plumb."""
TAU = (0.02, 5.0)
"""Bounds of τ [N]."""
GIVEN_TAU = 2.0
"""First τ of a force at a given place [N]; where the data do not determine the force, τ stays there."""
CATCH = 3.0
"""Largest factor κ on the noise at the start of a fit, where colour does not separate the robot from other things."""
TOLD = 0.1
"""The data determine a force at a given place if its posterior variance is below this share of its prior variance."""
SIZINGS, SETTLED = 8, 0.02
"""Updates of τ in one linear problem at most; they end below this relative change."""
STEPS = 25
"""Gauss–Newton steps of a fit at most."""
LENGTHS = (1.0, 0.3, 0.1, 0.03)
"""Lengths of a step that are tried."""
JUMP = 5.0
"""Pixels at the silhouette make Φ jump by so much. A step that failed is shortened only if the shorter one promises a larger decrease."""
WIDEST = 30.0
"""Factor κ on the noise in the first fit of the nuisance parameters, whose residuals then determine κ: pixels up to so many σ away count in it."""
FIXED = 1e-5
"""A contact point that a step moves by less stays [m]."""
TOLERANCE = 0.1
"""A fit ends where a step lowers Φ by less, and a search where no proposal lowers J by more."""
LATENT = 0.2
"""Prior scale of the latent force at an object that touches without being a contact of the hypothesis [N]."""
CHORD = 0.02
"""A tangent is kept for states whose nodes are closer than this share of the body's diagonal to those of its own state."""


@dataclass(frozen=True, eq=False, slots=True)
class Point:
    """The current point of an iteration."""

    contacts: tuple[Touch, ...]
    forces: FloatArray
    tau: FloatArray
    state: Equilibrium
    axes: FloatArray
    """Outward normal of the deformed surface and two tangents of each contact, shape (m, 3, 3)."""
    rows: Rows
    C: FloatArray
    N: FloatArray
    residual: FloatArray
    """r − Cμ [m], shape (r,)."""


def fit(
    model: Model,
    frame: Frame,
    contacts: Sequence[Touch],
    forces: FloatArray,
    start: Equilibrium,
    *,
    eta: FloatArray | None = None,
    tau: FloatArray | None = None,
    linearised: Linearised | None = None,
    catch: float = CATCH,
) -> Fit | None:
    """Return a hypothesis at the minimum of Φ near a start; None without an equilibrium.

    Arguments:
        contacts: with their places at the start; forces: at the start [N], shape (m, 3).
        start: a state near by.
        catch: κ at the start at most where colour does not separate the robot.
        eta, linearised: the nuisance and the tangent, where they are known from a fit near by.
        tau: prior scales of the forces at the start [N], shape (m,); of contacts at given places they may be left out.
    """
    m, contacts = len(contacts), tuple(contacts)
    forces = np.array(forces, dtype=np.float64).reshape(-1, 3)
    state: Equilibrium | None = start
    if m and (forces.any() or start is not frame.predicted):
        contacts, forces, state = _loaded(model, frame, contacts, forces, start)
    if state is None:
        return None
    q = model.nuisance.root.shape[1]
    near = linearised is not None and _near(model, linearised.positions, state.positions)
    try:
        linear = linearised if near and linearised is not None else model.linearised(state)
    except FemsenseError:  # unstable there
        return None
    tau = np.full(m, GIVEN_TAU) if tau is None else np.array(tau, dtype=np.float64)
    here = _point(model, frame, contacts, forces, tau, state, linear)
    eta = np.append(np.zeros(q) if eta is None else eta[:q], np.zeros(here.N.shape[1] - q))
    if not m:
        eta, _, _ = fit_nuisance(here.rows, here.residual, here.N, eta)
        return _finished(model, frame, here, _contact_columns(model, here, linear), linear, eta, True)
    wide = fit_nuisance(here.rows, here.residual, here.N, eta, kappa=WIDEST, steps=1)[0]
    kappa = _width(here, wide, frame, catch)
    D, converged = _contact_columns(model, here, linear), False
    for _ in range(STEPS):
        step = _step(model, here, D, eta, kappa)
        here = replace(here, tau=step.tau)
        lower = _descended(model, frame, here, linear, step, kappa)
        if isinstance(lower, End):
            if kappa.narrow:
                converged = lower is End.MINIMUM
                break
            kappa = kappa.narrowed()
            continue
        here, eta = lower.point, lower.eta
        if not _near(model, linear.positions, here.state.positions):
            linear = model.linearised(here.state)
            here = _point(model, frame, here.contacts, here.forces, here.tau, here.state, linear)
        D = _contact_columns(model, here, linear)
        if kappa.narrow and step.phi - lower.phi < TOLERANCE:
            converged = True
            break
        kappa = kappa.narrowed(_width(here, eta, frame, catch))
    return _in_cones(model, frame, _finished(model, frame, here, D, linear, eta, converged), here)


def _loaded(
    model: Model, frame: Frame, contacts: tuple[Touch, ...], forces: FloatArray, start: Equilibrium
) -> tuple[tuple[Touch, ...], FloatArray, Equilibrium | None]:
    """Return contacts, forces and their equilibrium. If Newton's method does not converge from the start, the forces are scaled down by
    `LENGTHS`."""
    for share in LENGTHS:
        part = share * forces
        loaded = tuple(pressed(model.sensor, contact, force) for contact, force in zip(contacts, part))
        state = model.solve(frame, loaded, part, start)
        if state is not None:
            return loaded, part, state
    return contacts, forces, None


def _width(here: Point, eta: FloatArray, frame: Frame, catch: float) -> Width:
    """Return κ for the residual of the rows."""
    return first_width((here.residual - here.N @ eta) / here.rows.std, here.rows.pixel, frame.coloured, catch)


# --- steps ------------------------------------------------------------------------------------------------------------


def _near(model: Model, first: FloatArray, second: FloatArray) -> bool:
    return float(np.abs(first - second).max()) < CHORD * model.sensor.size


def _point(
    model: Model,
    frame: Frame,
    contacts: tuple[Touch, ...],
    forces: FloatArray,
    tau: FloatArray,
    state: Equilibrium,
    linear: Linearised,
) -> Point:
    rows = stacked([model.rows(frame, state), *gap_rows(model, frame, contacts, state.positions)])
    C = columns(rows, linear.softening)
    axes = axes_at(model, contacts, state)
    N = np.hstack([C @ model.nuisance.root, _latent_columns(model, frame, rows, state, linear)])
    return Point(contacts, forces, tau, state, axes, rows, C, N, rows.residual - C @ model.nuisance.mean)


def _latent_columns(model: Model, frame: Frame, rows: Rows, state: Equilibrium, linear: Linearised) -> FloatArray:
    """Return the columns of latent normal forces (see `Frame.latent`), shape (r, l)."""
    loads = [one.patch.spread(-LATENT * touch_normal(model.sensor, one, state), len(state.positions)) for one in frame.latent]
    return rows.of(linear.tangent.respond(np.array(loads))) if loads else np.zeros((len(rows), 0))


def axes_at(model: Model, contacts: Sequence[Touch], state: Equilibrium) -> FloatArray:
    """Return the axes of the force of each contact, shape (m, 3, 3): outward normal and two tangents; for a hanging weight, upward and two
    horizontals."""
    normals = [model.upward if c.pulls else touch_normal(model.sensor, c, state) for c in contacts]
    return axes_of(np.array(normals).reshape(-1, 3))


def axes_of(normals: FloatArray) -> FloatArray:
    """Return an orthonormal basis for each unit normal (m, 3): the normal and two tangents as rows, shape (m, 3, 3)."""
    across = np.cross(normals, np.eye(3)[np.where(np.abs(normals[:, 0]) < 0.8, 0, 1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([normals, across, np.cross(normals, across)], axis=1)


def force_scale(tau: float, across: float = ACROSS) -> FloatArray:
    """Return the prior standard deviation of a force along its axes [N], shape (3,)."""
    return tau * np.array([1.0, across, across])


def across(model: Model, contact: Touch) -> float:
    """Return the prior scale of the force across its first axis relative to that along it; 1 for a given contact that may also pull."""
    if contact.pulls:
        return SWAYING
    return 1.0 if contact.source == "given" and not model.sensor.options.push else ACROSS


def _place_scale(contact: Touch, force: FloatArray, limit: float = np.inf) -> FloatArray:
    """Return the prior σ of a contact point along its two tangential directions [m], shape (2,); 0 if it is fixed."""
    if contact.std_m == 0.0 or not force.any():
        return np.zeros(2)
    std = ways_of(contact)[1]
    return np.minimum(std, limit) if contact.source == "shape" else std


def _place_offset(contact: Touch) -> FloatArray:
    """Return s̃ of a contact, shape (2,): its distance from the observed contact point in standard deviations; 0 for an inferred contact,
    whose position has a flat prior."""
    if contact.source == "shape" or contact.std_m == 0.0:
        return np.zeros(2)
    ways, std = ways_of(contact)
    return np.asarray(ways @ (contact.place - contact.expected) / std)


def _prior(model: Model, here: Point) -> float:
    """Return |f̃|² + |s̃|², without the normal forces of `_unpulled`."""
    at = whitened(model, here, trust=False)[1]
    return float((at**2).sum() - (at[_unpulled(here)] ** 2).sum())


def whitened(model: Model, here: Point | Fit, *, trust: bool) -> tuple[FloatArray, FloatArray]:
    """Return the prior scales of (force along its axes, contact point) of all contacts, and their whitened values, shapes (5m,).

    trust: limit the step of an inferred contact point to about an edge (trust region).
    """
    limit = model.sensor.surface.edge if trust else np.inf
    scales, at = [np.zeros(0)], [np.zeros(0)]
    for contact, force, axes, tau in zip(here.contacts, here.forces, here.axes, here.tau):
        own = force_scale(tau, across(model, contact))
        scales += [own, _place_scale(contact, force, limit)]
        at += [(axes @ force) / own, _place_offset(contact)]
    return np.concatenate(scales), np.concatenate(at)


def _unpulled(here: Point) -> list[int]:
    """Return the indices of f_n of visible contacts among the parameters: those whose prior does not pull (see above)."""
    return [force_of(i).start for i, one in enumerate(here.contacts) if one.source == "cloud" and not one.undetermined]


def _contact_columns(model: Model, here: Point, linear: Linearised) -> FloatArray:
    """Return D: derivatives of the modelled rows with (force along its axes, contact point) of each contact, shape (r, 5m)."""
    n = len(here.state.positions)
    loads = []
    for contact, force, own in zip(here.contacts, here.forces, here.axes):
        loads += [contact.patch.spread(axis, n) for axis in own]
        loads += [nodal_forces_by_shift(model.sensor, contact, way, force) for way in ways_of(contact)[0]]
    return here.rows.of(linear.tangent.respond(np.array(loads))) if loads else np.zeros((len(here.rows), 0))


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """A Gauss–Newton step from a point."""

    change: FloatArray
    """Change of (forces along their axes [N], contact points [m]), shape (5m,)."""
    eta: FloatArray
    """η̃ there."""
    tau: FloatArray
    """Prior scales that maximise the evidence of the linear problem [N], shape (m,)."""
    decrease: float
    """Decrease of Φ in the linear problem."""
    phi: float
    """Φ at the start of the step, with these prior scales."""


@dataclass(frozen=True, eq=False, slots=True)
class Lower:
    """A point with lower Φ."""

    point: Point
    eta: FloatArray
    phi: float


class End(Enum):
    """Why a step leads to no point of lower Φ."""

    MINIMUM = auto()
    """The linear problem promises less than TOLERANCE, or Φ is not lower at any length of the step."""
    NO_EQUILIBRIUM = auto()
    """No length of the step has an equilibrium."""


def force_of(i: int) -> slice:
    """Return the place of the force of contact i among the parameters (force along its axes, contact point) of all contacts."""
    return slice(5 * i, 5 * i + 3)


def place_of(i: int) -> slice:
    """Return the place of the contact point of contact i among these parameters."""
    return slice(5 * i + 3, 5 * i + 5)


def _step(model: Model, here: Point, D: FloatArray, eta: FloatArray, kappa: Width) -> Step:
    """Return the Gauss–Newton step from a point, with the prior scales τ of the forces for which its linear problem has the highest evidence."""
    m = len(here.contacts)
    eta, phi, weight = fit_nuisance(here.rows, here.residual, here.N, eta, kappa=kappa.of(here.rows.pixel))
    DN = np.hstack([D, here.N])
    weighted, tau = DN * weight[:, None], here.tau
    gram = DN.T @ weighted
    for _ in range(SIZINGS):
        sized = replace(here, tau=tau)
        scale, at = whitened(model, sized, trust=True)
        scales = np.append(scale, np.ones(here.N.shape[1]))
        A = np.eye(len(scales)) + scales[:, None] * gram * scales
        covariance = np.linalg.inv(A)
        prior_mean = np.zeros(len(scales))
        prior_mean[_unpulled(here)] = at[_unpulled(here)]
        minimum = covariance @ (scales * (weighted.T @ (here.residual + D @ (at * scale))) + prior_mean)
        tau = _of_highest_evidence(sized, minimum, np.diag(covariance))
        if np.abs(np.log(tau / sized.tau)).max(initial=0.0) < SETTLED:
            break
    change = minimum - np.append(at, eta)
    # The step belongs to the scales it was computed with; the next one is computed with those that follow from it.
    return Step(
        change=(minimum[: 5 * m] - at) * scale,
        eta=minimum[5 * m :],
        tau=sized.tau,
        decrease=float(change @ A @ change),
        phi=phi + _prior(model, sized),
    )


def _of_highest_evidence(here: Point, mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the next iterate of the prior scales τ that maximise the evidence of a linear problem (type-II maximum likelihood) [N], shape (m,).

    τ² is the mean square of the whitened components of the force, expected under the posterior (MacKay 1992). τ stays for contacts whose force is known not
    to be determined, and at given places where the data leave more than TOLD of the prior variance of the normal force: two opposed fingers determine the
    difference of their forces only, and τ would shrink both to zero.

    Arguments:
        mean, variance: of the whitened parameters under the posterior with the present τ, shape (p,).
    """
    tau = here.tau.copy()
    for i, contact in enumerate(here.contacts):
        own = force_of(i)
        if not contact.undetermined and (contact.source != "given" or variance[own][0] < TOLD):
            tau[i] = np.clip(tau[i] * np.sqrt((mean[own] ** 2 + variance[own]).mean()), *TAU)
    return tau


def _descended(model: Model, frame: Frame, here: Point, linear: Linearised, step: Step, kappa: Width) -> Lower | End:
    """Return a point of lower Φ along a step, or why there is none."""
    if step.decrease < TOLERANCE:
        return End.MINIMUM
    refused = False
    for length in LENGTHS:
        if refused and length * step.decrease < JUMP:
            break
        there = _moved(model, frame, here, linear, length * step.change)
        if there is None:
            continue
        eta, phi, _ = fit_nuisance(there.rows, there.residual, there.N, step.eta, kappa=kappa.of(there.rows.pixel))
        phi += _prior(model, there)
        if phi < step.phi:
            return Lower(there, eta, phi)
        refused = True
    return End.MINIMUM if refused else End.NO_EQUILIBRIUM


def _moved(model: Model, frame: Frame, here: Point, linear: Linearised, step: FloatArray) -> Point | None:
    edge = model.sensor.surface.edge
    contacts, forces = [], here.forces.copy()
    for i, (contact, axes) in enumerate(zip(here.contacts, here.axes)):
        forces[i] += axes.T @ step[force_of(i)]
        way = step[place_of(i)] @ ways_of(contact)[0]
        far = float(np.linalg.norm(way))
        there = moved_to(model.sensor, contact, contact.place + way * min(1.0, edge / far)) if far > FIXED else contact
        contacts.append(pressed(model.sensor, there, forces[i]))
    state = model.solve(frame, tuple(contacts), forces, here.state)
    return None if state is None else _point(model, frame, tuple(contacts), forces, here.tau, state, linear)


# --- the optimum --------------------------------------------------------------------------------------------------------


def _finished(
    model: Model, frame: Frame, here: Point, D: FloatArray, linear: Linearised, eta: FloatArray, converged: bool
) -> Fit:
    """Return the Laplace approximation at a point."""
    m = len(here.contacts)
    eta, phi, weight = fit_nuisance(here.rows, here.residual, here.N, eta)
    scale, at = whitened(model, here, trust=False)
    X = np.hstack([D * scale, here.N])
    A = np.eye(X.shape[1]) + (X * weight[:, None]).T @ X
    precision = A.copy()
    precision[_unpulled(here), _unpulled(here)] -= 1.0
    P = np.linalg.inv(precision)
    evidence = phi + float((at**2).sum()) + float(np.linalg.slogdet(A)[1])
    q = model.nuisance.root.shape[1]
    force_map, places, gain = np.zeros((3 * m, 5 * m)), np.zeros((m, 3, 3)), np.zeros(m)
    for i, (contact, axes) in enumerate(zip(here.contacts, here.axes)):
        f, s = force_of(i), place_of(i)
        force_map[3 * i : 3 * i + 3, f] = axes.T * scale[f]
        ways, stds = ways_of(contact)
        way = ways.T * (scale[s] if here.forces[i].any() else stds)  # without a force, the contact point is the observed one
        places[i] = way @ P[s, s] @ way.T
        gain[i] = float(at[f] @ np.linalg.solve(P[f, f], at[f]) + np.linalg.slogdet(P[f, f])[1])
    return Fit(
        frame=frame,
        contacts=here.contacts,
        forces=freeze(here.forces),
        tau=here.tau,
        axes=here.axes,
        state=here.state,
        rows=here.rows,
        linearised=linear,
        C=here.C,
        N=here.N,
        D=D,
        eta=eta,
        weight=weight,
        evidence=evidence,
        odds=np.array([odds_of(model, contact, here.rows) for contact in here.contacts]),
        covariance=force_map @ P[: 5 * m, : 5 * m] @ force_map.T,
        place_covariance=places,
        latent_force=LATENT * np.column_stack([eta[q:], np.sqrt(np.diag(P)[5 * m + q :])]),
        drop_gain=gain,
        converged=converged,
    )


def _in_cones(model: Model, frame: Frame, found: Fit, here: Point) -> Fit:
    """Return the fit with its forces projected onto their friction cones in the metric of the posterior."""
    inside = within_cones(model.sensor, found, here.axes)
    if inside is None:
        return found
    state = model.solve(frame, found.contacts, inside, found.state)
    if state is None:
        return found
    there = _point(model, frame, found.contacts, inside, found.tau, state, found.linearised)
    D = _contact_columns(model, there, found.linearised)
    return _finished(model, frame, there, D, found.linearised, found.eta, found.converged)
