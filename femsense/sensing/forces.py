"""Forces at places: equilibrium → rays → compliance → QP, until the forces stop changing.

Every step is a Gauss–Newton step of one least-squares problem in the forces (three components each), the places (two along the surface) and the
nuisance: pose, modulus and errors that neighbours share. The last QP holds the friction cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.fem.mesh import vertex_normals
from femsense.model.contact_patch import ContactPatch, closest_surface_point, patch_at
from femsense.model.frame_state import solve_frame
from femsense.qp.forces import estimate_forces
from femsense.qp.problem import ForceOptions, FrictionCone
from femsense.sensing.measure import rows_at
from femsense.sensing.nuisance import misfit_of, nuisance_columns, robust_std, sag_at
from femsense.sensing.types import Fit, Rows, Sensor, Touch

ROUGH = 1e-6
"""Unbalanced force, relative to all loads, of the states on the way to the forces; the last one is exact."""
ACROSS = 0.5
"""Forces along the surface are expected to be so much smaller than those along the normal: rubber on plastic or skin slides at 0.5 to 1, and few slide."""
WIDER = 2.0
"""The size of the forces is itself uncertain: standard deviations are those of a prior so much wider than the likeliest."""
TRIES = 4
"""How often a step is made shorter where it leads too far: first along what the rows hardly determine."""
SIZINGS = 8
"""How often the size of the forces is estimated anew in one linear problem."""
PATCH = 1.05
"""Radius over which a point force is spread, in edges of the surface: the least that has a few nodes everywhere."""
LOST = 9.0
"""What a point counts that finds no surface in one state and one in another."""


def make_touch(
    sensor: Sensor,
    place: FloatArray,
    *,
    source: str,
    std_m: float = 0.0,
    normal: FloatArray | None = None,
    radius: float = np.inf,
) -> Touch:
    """Return a touch at the point of the surface at rest that is closest to a place at rest [m], shape (3,)."""
    nodes = sensor.robot.body.mesh.nodes
    at = closest_surface_point(sensor.surface, nodes, place, facing=normal)
    patch = _patch(sensor, at, normal)
    outward = patch.mean(vertex_normals(nodes, sensor.surface.triangles))
    outward = outward / max(float(np.linalg.norm(outward)), 1e-12) if normal is None else normal
    return Touch(at, outward, patch, at, std_m, source, radius)


def touch_normal(sensor: Sensor, touch: Touch, state: Equilibrium) -> FloatArray:
    """Return the outward unit normal of the deformed surface at a touch, shape (3,)."""
    mean = touch.patch.mean(vertex_normals(state.positions, sensor.surface.triangles))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def no_forces(sensor: Sensor, k: int, scan: Scan | None, state: Equilibrium) -> Fit:
    """Return the fit of a frame without contacts."""
    rows = rows_at(sensor, k, scan, state)
    sag = sag_at(sensor, state, tangent_at(sensor.robot.body, state))
    columns, known = nuisance_columns(sensor.knowledge, rows, sag)
    cost = misfit_of(rows.residual - known, columns, rows)[0] + LOST * rows.lost / rows.together
    return Fit((), state, np.zeros((0, 3)), np.zeros((0, 0)), np.zeros((0, 3, 3)), rows, cost)


def fit_forces(
    sensor: Sensor,
    k: int,
    scan: Scan | None,
    touches: Sequence[Touch],
    free: Fit,
    *,
    start: tuple[Equilibrium, FloatArray] | None = None,
    before: tuple[FloatArray, ...] | None = None,
) -> Fit:
    """Return the forces at some places that explain frame k best.

    Arguments:
        touches: where forces may act.
        free: the fit without them, from which it begins.
        start: a state near by and the forces in it (m, 3) [N]; taken where it explains the frame better than the free state.
        before: tensions along the cables until now (friction).

    Raises:
        DataError: nothing is seen, or the force problem has no answer.
    """
    m = len(touches)
    here = _Here(tuple(touches), np.zeros((m, 3)), free.state, free.rows, np.full(m, sensor.options.force_std_n))
    linear = _linearise(sensor, here)
    cost = linear.cost(here)
    if start is not None and len(start[1]) == len(touches):
        forces = _within_cones(sensor, here.touches, start[1], start[0])
        near = _tried(sensor, k, scan, replace(here, forces=forces, state=start[0]), before)
        there = None if near is None else _linearise(sensor, near)
        if near is not None and there is not None and there.cost(near) < cost:
            here, linear, cost = near, there, there.cost(near)
    answer = linear.solve(sensor, here)
    still, trust = False, 1.0
    for _ in range(sensor.options.iterations):
        here = replace(here, sizes=answer.sizes)
        cost = linear.cost(here)
        force_step, shift = answer.forces - here.forces, answer.shift
        small = 0.05 * answer.force_std + 2e-3 * max(float(np.abs(answer.forces).max()), 1e-3)
        if (np.abs(force_step) < small[:, None]).all() and (np.abs(shift) < 0.1 * sensor.surface.edge).all():
            still = True
            break
        better: tuple[_Here, _Linear] | None = None
        for _ in range(TRIES):
            step = answer if trust >= 1.0 else linear.solve(sensor, here, trust)
            near = _tried(sensor, k, scan, _moved(sensor, here, linear, step.forces - here.forces, step.shift), before)
            there = None if near is None else _linearise(sensor, near)
            if near is not None and there is not None and there.cost(near) < cost:
                better, trust = (near, there), min(4.0 * trust, 1.0)
                break
            trust *= 0.2
        if better is None:
            break
        gain = cost - better[1].cost(better[0])
        (here, linear), cost = better, cost - gain
        answer = linear.solve(sensor, here)
        if gain < 1e-4 * cost:
            still = True
            break
    state = _solve(sensor, k, _nodal(sensor, here), here.state, before)
    cost = linear.cost(replace(here, sizes=np.full(m, sensor.options.force_std_n)))
    return Fit(
        here.touches,
        state,
        freeze(here.forces),
        freeze(answer.covariance),
        freeze(answer.place_covariance),
        here.rows,
        cost,
        still,
    )


# --- one linearisation -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class _Here:
    """Where the iteration stands."""

    touches: tuple[Touch, ...]
    forces: FloatArray  # (m, 3) [N]
    state: Equilibrium
    rows: Rows
    sizes: FloatArray  # expected size of each force along each axis, (m,) [N]


@dataclass(frozen=True, eq=False, slots=True)
class _Answer:
    """What one linear problem says."""

    forces: FloatArray  # (m, 3) [N]
    shift: FloatArray  # (m, 2) along the tangents [m]
    covariance: FloatArray  # (3m, 3m)
    place_covariance: FloatArray  # (m, 3, 3)
    force_std: FloatArray  # (m,)
    sizes: FloatArray  # (m,) [N]


@dataclass(frozen=True, eq=False, slots=True)
class _Linear:
    """The rows as they answer to small changes."""

    tangent: Tangent
    by_force: FloatArray  # (r, 3m)
    by_shift: FloatArray  # (r, 2m)
    frames: FloatArray  # tangents at rest, (m, 2, 3)
    nuisance: FloatArray  # (r, q), unit
    residual: FloatArray  # (r,), without what the free frames say
    normals: FloatArray  # outward, deformed, (m, 3)
    moves: FloatArray  # of the nodes by unit forces, (3m, n, 3)

    def cost(self, here: _Here) -> float:
        """Return the misfit of the state, priors included."""
        off = sum(float(((t.place - t.expected) ** 2).sum()) / t.std_m**2 for t in here.touches if t.std_m > 0)
        prior = sum(
            float(((root @ f) ** 2).sum()) for root, f in zip(_priors(here.touches, self.normals, here.sizes), here.forces)
        )
        return misfit_of(self.residual, self.nuisance, here.rows)[0] + LOST * here.rows.lost / here.rows.together + off + prior

    def solve(self, sensor: Sensor, here: _Here, trust: float = 1.0) -> _Answer:
        """Return forces and shifts of the places that explain the rows best; where `trust` is below 1, near those that are here.

        Three components of one force are seldom all determined: a beam hardly yields along its axis. They share a Gaussian prior whose size the
        data choose (MacKay 1992), so that what the data do not see shrinks and does not inflate the force.
        """
        m, edge = len(here.touches), sensor.surface.edge
        std = robust_std(here.rows, self.residual)
        place_std = np.repeat([t.std_m for t in here.touches], 2)
        free = np.repeat([t.std_m > 0 and float(np.linalg.norm(f)) > 0 for t, f in zip(here.touches, here.forces)], 2)
        wanted = np.array([e @ (t.expected - t.place) for t, e in zip(here.touches, self.frames)]).ravel()
        by_shift = self.by_shift * (free * place_std)
        rest = self.residual + self.by_force @ here.forces.ravel() - self.by_shift @ (free * wanted)
        A = np.hstack([self.by_force, by_shift, self.nuisance, rest[:, None]]) / std[:, None]
        R = np.asarray(np.linalg.qr(A, mode="r"))
        spread = max(1.0, 1.483 * float(np.median(np.abs(self.residual / here.rows.std)))) ** 2
        near = np.zeros((0, R.shape[1] - 1)), np.zeros(0)
        if trust < 1.0:
            far = max(
                float(np.abs(_bounded(R, block_diag(*_priors(here.touches, self.normals, here.sizes)), None, near)[0]).max()),
                1e-6,
            )
            weight = np.concatenate([np.full(3 * m, 1.0 / far), place_std / edge]) / trust
            near = (
                np.diag(np.append(weight, np.zeros(R.shape[1] - 1 - 5 * m)))[: 5 * m],
                np.append(here.forces.ravel() / far, -wanted * free / edge) / trust,
            )
        sizes = here.sizes
        for _ in range(SIZINGS):
            prior = block_diag(*_priors(here.touches, self.normals, sizes))
            covariance = _posterior(R, prior)
            forces, others = _bounded(R, prior, _cone(sensor, here, self.normals), near)
            spreads = prior @ covariance[: 3 * m, : 3 * m] @ prior.T
            share = ((prior @ forces.ravel()) ** 2 + np.diag(spreads)).reshape(m, 3).sum(axis=1) / 3.0
            new = np.clip(sizes * np.sqrt(share), 1e-6, sensor.options.force_std_n)
            settled = bool((np.abs(new - sizes) < 0.02 * new).all())
            sizes = new
            if settled:
                break
        covariance = _posterior(R, block_diag(*_priors(here.touches, self.normals, WIDER * sizes)))
        shift = free * (wanted + place_std * others[: 2 * m])
        place = covariance[3 * m : 5 * m, 3 * m : 5 * m] * np.outer(place_std, place_std)
        places = np.array([e.T @ place[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ e for i, e in enumerate(self.frames)])
        limit = sensor.surface.edge
        return _Answer(
            forces,
            np.clip(shift, -limit, limit).reshape(m, 2),
            spread * covariance[: 3 * m, : 3 * m],
            spread * places.reshape(m, 3, 3),
            np.sqrt(spread * np.diag(covariance)[: 3 * m].reshape(m, 3).mean(axis=1)),
            sizes,
        )


def _linearise(sensor: Sensor, here: _Here) -> _Linear:
    tangent = tangent_at(sensor.robot.body, here.state)
    n, m = len(here.state.positions), len(here.touches)
    basis = np.array([t.patch.spread(axis, n) for t in here.touches for axis in np.eye(3)])
    frames = np.array([_tangents(t.normal) for t in here.touches]).reshape(m, 2, 3)
    shifts = np.array([_shifted(sensor, t, e, f) for t, es, f in zip(here.touches, frames, here.forces) for e in es])
    sag = sag_at(sensor, here.state, tangent)
    moves = tangent.respond(np.concatenate([basis, shifts]))
    answers = here.rows.functional(moves)
    columns, known = nuisance_columns(sensor.knowledge, here.rows, sag)
    return _Linear(
        tangent,
        answers[:, : 3 * m],
        answers[:, 3 * m :],
        frames,
        columns,
        here.rows.residual - known,
        np.array([touch_normal(sensor, t, here.state) for t in here.touches]),
        moves[: 3 * m],
    )


def _priors(touches: Sequence[Touch], normals: FloatArray, sizes: FloatArray) -> list[FloatArray]:
    """Return what whitens each force, shape (3, 3): of one size along all axes where the place is given, smaller across the normal of a contact."""
    result = []
    for touch, normal, size in zip(touches, normals, sizes):
        across = 1.0 if touch.source == "given" else ACROSS
        result.append(np.vstack([normal, _tangents(normal) / across]) / size)
    return result


def _posterior(R: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance of forces, shifts and nuisance; the cone, where it acts, would only make it smaller."""
    A, f = R[:, :-1], len(prior)
    precision = A.T @ A + np.eye(A.shape[1])
    precision[:f, :f] += prior.T @ prior - np.eye(f)
    return np.asarray(np.linalg.inv(precision))


def _bounded(
    R: FloatArray, prior: FloatArray, cone: FrictionCone | None, near: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return forces (m, 3) within the cone and the nuisance; `near` are rows and values that hold them. Raises DataError."""
    f = len(prior)
    A = np.vstack([R[:, :-1], np.hstack([prior, np.zeros((f, R.shape[1] - 1 - f))]), near[0]])
    b = np.concatenate([R[:, -1], np.zeros(f), near[1]])
    estimate = estimate_forces(
        A[:, :f],
        None,
        np.zeros(len(A)),
        b,
        std=1.0,
        options=ForceOptions(nuisance=A[:, f:], nuisance_std=np.ones(A.shape[1] - f), friction_cone=cone),
    )
    if not np.isfinite(estimate.forces).all():
        raise DataError(f"the force problem has no answer: {estimate.status}")
    return estimate.forces.reshape(-1, 3), estimate.nuisance


def _cone(sensor: Sensor, here: _Here, normals: FloatArray) -> FrictionCone | None:
    given = [t.source == "given" for t in here.touches]
    if sensor.options.friction is None or any(given):
        return None
    return FrictionCone(normals=normals, mu=sensor.options.friction)


def _within_cones(sensor: Sensor, touches: tuple[Touch, ...], forces: FloatArray, state: Equilibrium) -> FloatArray:
    """Return forces (m, 3) moved to the nearest ones within their friction cones; given places push and pull as they like."""
    mu, result = sensor.options.friction, np.array(forces, dtype=np.float64)
    if mu is None:
        return result
    for i, touch in enumerate(touches):
        inward = -touch_normal(sensor, touch, state)
        along = float(result[i] @ inward)
        across = result[i] - along * inward
        size = float(np.linalg.norm(across))
        if touch.source == "given" or size <= mu * along:
            continue
        kept = max(along + mu * size, 0.0) / (1.0 + mu**2)
        result[i] = kept * (inward + mu * across / max(size, 1e-12))
    return result


def _tangents(normal: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.svd(normal[None])[2][1:])


def _shifted(sensor: Sensor, touch: Touch, tangent: FloatArray, force: FloatArray) -> FloatArray:
    """Return how nodal forces change when the place moves along a tangent, per metre [N/m], shape (n, 3)."""
    n, step = len(sensor.robot.body.mesh.nodes), 0.5 * sensor.surface.edge
    if touch.std_m == 0 or not force.any():
        return np.zeros((n, 3))
    ahead, behind = (_patch(sensor, touch.place + s * step * tangent, touch.normal) for s in (1.0, -1.0))
    return np.asarray((ahead.spread(force, n) - behind.spread(force, n)) / (2.0 * step))


def _patch(sensor: Sensor, place: FloatArray, normal: FloatArray | None) -> ContactPatch:
    body = sensor.robot.body
    return patch_at(sensor.surface, body.mesh.nodes, place, PATCH * sensor.surface.edge, body.clamped, facing=normal)


def _moved(sensor: Sensor, here: _Here, linear: _Linear, force_step: FloatArray, shift: FloatArray) -> _Here:
    """Return where a step leads, with a start for its state that the tangent foretells."""
    touches = []
    for touch, frame, way in zip(here.touches, linear.frames, shift):
        if way.any():
            moved = make_touch(
                sensor, touch.place + way @ frame, source=touch.source, std_m=touch.std_m, radius=touch.object_radius_m
            )
            touch = replace(moved, expected=touch.expected)
        touches.append(touch)
    forces = _within_cones(sensor, tuple(touches), here.forces + force_step, here.state)
    move = np.tensordot((forces - here.forces).ravel(), linear.moves, axes=1)
    factor = linear.tangent.factor if linear.tangent.factor.negative == 0 else None
    state = replace(here.state, positions=here.state.positions + move, factor=factor)
    return _Here(tuple(touches), forces, state, here.rows, here.sizes)


def _tried(sensor: Sensor, k: int, scan: Scan | None, there: _Here, before: tuple[FloatArray, ...] | None) -> _Here | None:
    """Return it with its equilibrium and rows; None where it has none."""
    try:
        state = _solve(sensor, k, _nodal(sensor, there), there.state, before, ROUGH)
        return replace(there, state=state, rows=rows_at(sensor, k, scan, state))
    except DataError:
        return None


def _nodal(sensor: Sensor, here: _Here) -> FloatArray:
    n = len(sensor.robot.body.mesh.nodes)
    return np.asarray(sum((t.patch.spread(f, n) for t, f in zip(here.touches, here.forces)), np.zeros((n, 3))))


def _solve(
    sensor: Sensor,
    k: int,
    nodal_forces: FloatArray | None,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    tolerance: float = 1e-9,
) -> Equilibrium:
    state = solve_frame(
        sensor.driven,
        k,
        start=start,
        nodal_forces=nodal_forces,
        options=SolveOptions(before=before, reuse_factor=start is not None, relative_tolerance=tolerance),
    )
    if not state.converged:
        raise DataError(f"no equilibrium: {state.status}: {state.advice}")
    return state


def free_state(sensor: Sensor, k: int, start: Equilibrium | None, before: tuple[FloatArray, ...] | None) -> Equilibrium:
    """Return the state under the inputs alone. Raises DataError."""
    return _solve(sensor, k, None, start, before)


def solve_with(sensor: Sensor, k: int, touches: Sequence[Touch], forces: FloatArray, start: Equilibrium) -> Equilibrium:
    """Return the state of frame k under forces (m, 3) [N] at some places. Raises DataError."""
    n = len(start.positions)
    return _solve(
        sensor, k, np.asarray(sum((t.patch.spread(f, n) for t, f in zip(touches, forces)), np.zeros((n, 3)))), start, None
    )
