"""One Gauss–Newton step towards the forces of a frame: rows, priors and the friction cone in one quadratic programme.

Unknown are the forces (three components each), their places (two along the surface) and the nuisance: pose, modulus and errors that neighbours share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.qp.friction_cone import pyramid_rows
from femsense.qp.problem import Problem
from femsense.qp.solve import solve
from femsense.sensing.nuisance import misfit_of, nuisance_columns, robust_std
from femsense.sensing.responses import response_at
from femsense.sensing.touches import friction_cone, nodal_forces_by_shift, place_cost, tangents_of, touch_normal, ways_of
from femsense.sensing.types import Response, Rows, Sensor, Touch

ACROSS = 0.5
"""Forces along the surface are expected to be so much smaller than those along the normal: rubber on plastic or skin slides at 0.5 to 1, and few slide."""
WIDER = 2.0
"""The size of the forces is itself uncertain: standard deviations are those of a prior so much wider than the likeliest."""
SIZINGS = 8
"""How often the size of the forces is estimated anew in one linear problem."""


@dataclass(frozen=True, eq=False, slots=True)
class Iterate:
    """Where the iteration stands."""

    touches: tuple[Touch, ...]
    forces: FloatArray  # (m, 3) [N]
    state: Equilibrium
    rows: Rows
    sizes: FloatArray  # expected size of each force along each axis, (m,) [N]


@dataclass(frozen=True, eq=False, slots=True)
class ForceStep:
    """What one linear problem says."""

    forces: FloatArray  # (m, 3) [N]
    shift: FloatArray  # of the places, (m, 2) along the tangents [m]
    covariance: FloatArray  # of the forces, (3m, 3m) [N²]
    place_covariance: FloatArray  # (m, 3, 3) [m²]
    force_std: FloatArray  # (m,) [N]
    sizes: FloatArray  # (m,) [N]


@dataclass(frozen=True, eq=False, slots=True)
class Linearisation:
    """The rows of an iterate as they answer to small changes."""

    response: Response
    by_force: FloatArray  # (r, 3m)
    by_shift: FloatArray  # (r, 2m)
    frames: FloatArray  # tangents at rest, (m, 2, 3)
    nuisance: FloatArray  # (r, q), unit
    residual: FloatArray  # (r,), without what the free frames say
    normals: FloatArray  # outward, deformed, (m, 3)
    moves: FloatArray  # of the nodes by unit forces, (3m, n, 3)
    misfit: float  # of the rows with nuisance fitted

    def cost(self, here: Iterate) -> float:
        """Return the misfit of the state, priors included."""
        return self.misfit + prior_cost(here, self.normals)

    def cost_beside(self, sensor: Sensor, there: Iterate) -> float:
        """Return about what a state near by costs, before it is linearised: its rows with the nuisance of this one.

        The two differed by less than a twentieth of what the cost had changed, but for steps that were ten times too long.
        """
        return misfit_beside(sensor, there.rows, self.response.sag) + prior_cost(there, self.normals)

    def step(self, sensor: Sensor, here: Iterate, trust: float = 1.0, *, firm: bool = False) -> ForceStep:
        """Return forces and shifts of the places that explain the rows best; where `trust` is below 1, near those that are here.

        `firm` as for `robust_std`.

        Three components of one force are seldom all determined: a beam hardly yields along its axis. They share a Gaussian prior whose size the
        data choose (MacKay 1992), so that what the data do not see shrinks and does not inflate the force. Raises DataError.
        """
        m = len(here.touches)
        place_std = np.concatenate([ways_of(t)[1] for t in here.touches])
        free = np.repeat([t.std_m > 0 and float(np.linalg.norm(f)) > 0 for t, f in zip(here.touches, here.forces)], 2)
        wanted = np.array([e @ (t.expected - t.place) for t, e in zip(here.touches, self.frames)]).ravel()
        normal = self._normal_equations(here, free * place_std, free * wanted, firm)
        held = self._held(sensor, here, normal, place_std, free * wanted, trust)
        forces, others, sizes = self._forces_and_sizes(sensor, here, normal, held)
        covariance = normal.covariance(block_diag(*_prior_roots(here.touches, self.normals, WIDER * sizes)))
        place = covariance[3 * m : 5 * m, 3 * m : 5 * m] * np.outer(place_std, place_std)
        places = np.array([e.T @ place[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ e for i, e in enumerate(self.frames)])
        scale = max(1.0, here.rows.spread(self.residual)) ** 2
        limit = sensor.surface.edge
        return ForceStep(
            forces,
            np.clip(free * (wanted + place_std * others[: 2 * m]), -limit, limit).reshape(m, 2),
            scale * covariance[: 3 * m, : 3 * m],
            scale * places.reshape(m, 3, 3),
            np.sqrt(scale * np.diag(covariance)[: 3 * m].reshape(m, 3).mean(axis=1)),
            sizes,
        )

    def _normal_equations(self, here: Iterate, shift_std: FloatArray, wanted: FloatArray, firm: bool) -> NormalEquations:
        """Return what all whitened rows say of forces, shifts and nuisance; the latter two have their unit priors."""
        rest = self.residual + self.by_force @ here.forces.ravel() - self.by_shift @ wanted
        A = np.hstack([self.by_force, self.by_shift * shift_std, self.nuisance, rest[:, None]])
        A /= robust_std(here.rows, self.residual, firm=firm)[:, None]
        gram, f = A.T @ A, self.by_force.shape[1]
        others = np.append(np.zeros(f), np.ones(len(gram) - 1 - f))
        return NormalEquations(gram[:-1, :-1] + np.diag(others), gram[:-1, -1], f)

    def _held(
        self, sensor: Sensor, here: Iterate, normal: NormalEquations, place_std: FloatArray, wanted: FloatArray, trust: float
    ) -> NormalEquations:
        """Return the normal equations with forces and shifts held near those that are here; as they are where the step is trusted."""
        if trust >= 1.0:
            return normal
        m, edge = len(here.touches), sensor.surface.edge
        prior = block_diag(*_prior_roots(here.touches, self.normals, here.sizes))
        far = max(float(np.abs(normal.of_forces().forces(prior)).max()), 1e-6)
        weight = np.concatenate([np.full(3 * m, 1.0 / far), place_std / edge]) / trust
        value = np.append(here.forces.ravel() / far, -wanted / edge) / trust
        matrix, right = normal.matrix.copy(), normal.right.copy()
        matrix[: 5 * m, : 5 * m] += np.diag(weight**2)
        right[: 5 * m] += weight * value
        return NormalEquations(matrix, right, 3 * m)

    def _forces_and_sizes(
        self, sensor: Sensor, here: Iterate, normal: NormalEquations, held: NormalEquations
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return forces (m, 3), the other unknowns, and the size of each force that makes the rows likeliest (m,)."""
        m, sizes = len(here.touches), here.sizes
        cone = friction_cone(sensor, here.touches, self.normals)
        sides = None if cone is None else pyramid_rows(cone, 0, 3 * m, 0)
        free = normal.of_forces()
        bound = free if held is normal else held.of_forces()
        for _ in range(SIZINGS):
            prior = block_diag(*_prior_roots(here.touches, self.normals, sizes))
            forces = bound.forces(prior, sides)
            whitened = prior @ np.linalg.inv(free.matrix + prior.T @ prior) @ prior.T
            share = ((prior @ forces) ** 2 + np.diag(whitened)).reshape(m, 3).sum(axis=1) / 3.0
            new = np.clip(sizes * np.sqrt(share), 1e-6, sensor.options.force_std_n)
            settled = bool((np.abs(new - sizes) < 0.02 * new).all())
            sizes = new
            if settled:
                break
        return forces.reshape(m, 3), bound.others(forces), sizes


@dataclass(frozen=True, eq=False, slots=True)
class NormalEquations:
    """The least-squares problem of one step without the prior of its forces."""

    matrix: FloatArray  # (q, q), forces first
    right: FloatArray  # (q,)
    force_count: int

    def of_forces(self) -> ForceEquations:
        """Return the equations of the forces, all else eliminated."""
        f, A, b = self.force_count, self.matrix, self.right
        eliminated = np.asarray(np.linalg.solve(A[f:, f:], np.column_stack([A[f:, :f], b[f:]])), dtype=np.float64)
        left = A[:f, :f] - A[:f, f:] @ eliminated[:, :f]
        return ForceEquations(np.asarray(0.5 * (left + left.T)), b[:f] - A[:f, f:] @ eliminated[:, f], eliminated)

    def covariance(self, prior: FloatArray) -> FloatArray:
        """Return the covariance of all unknowns; the cone, where it acts, would only make it smaller."""
        precision, f = self.matrix.copy(), self.force_count
        precision[:f, :f] += prior.T @ prior
        return np.asarray(np.linalg.inv(precision))


@dataclass(frozen=True, eq=False, slots=True)
class ForceEquations:
    """Normal equations of the forces alone."""

    matrix: FloatArray  # (f, f)
    right: FloatArray  # (f,)
    eliminated: FloatArray  # how all else answers to the forces, and what it is without them, (q − f, f + 1)

    def forces(self, prior: FloatArray, sides: FloatArray | None = None) -> FloatArray:
        """Return the forces (f,) with their whitening prior (f, f), within a pyramid whose sides (s, f) say sides · f ≤ 0. Raises DataError."""
        precision = self.matrix + prior.T @ prior
        free = np.linalg.solve(precision, self.right)
        if sides is None or (sides @ free <= 0.0).all():
            return np.asarray(free)
        answer = solve(Problem(P=precision, q=-self.right, G=sides, h=np.zeros(len(sides))))
        if answer.x is None or not np.isfinite(answer.x).all():
            raise DataError(f"the force problem has no answer: {answer.status}")
        return answer.x

    def others(self, forces: FloatArray) -> FloatArray:
        """Return shifts and nuisance that belong to forces (f,), shape (q − f,)."""
        return np.asarray(self.eliminated[:, -1] - self.eliminated[:, :-1] @ forces)


def linearise(sensor: Sensor, here: Iterate, near: Response | None = None) -> Linearisation:
    """Return how the rows of an iterate answer to forces, to shifts of their places, and to the nuisance.

    `near` is a response at hand, which is taken where it was made near by.
    """
    response = response_at(sensor, here.state, near)
    n, m = len(here.state.positions), len(here.touches)
    basis = np.array([t.patch.spread(axis, n) for t in here.touches for axis in np.eye(3)])
    frames = np.array([ways_of(t)[0] for t in here.touches]).reshape(m, 2, 3)
    shifts = [nodal_forces_by_shift(sensor, t, e, f) for t, es, f in zip(here.touches, frames, here.forces) for e in es]
    moves = response.tangent.respond(np.concatenate([basis, np.array(shifts)]))
    answers = here.rows.functional(moves)
    columns, known = nuisance_columns(sensor.knowledge, here.rows, response.sag)
    return Linearisation(
        response,
        answers[:, : 3 * m],
        answers[:, 3 * m :],
        frames,
        columns,
        here.rows.residual - known,
        np.array([touch_normal(sensor, t, here.state) for t in here.touches]),
        moves[: 3 * m],
        misfit_of(here.rows.residual - known, columns, here.rows)[0],
    )


def prior_cost(here: Iterate, normals: FloatArray) -> float:
    """Return what forces (about outward normals, (m, 3)) and places of an iterate cost beforehand."""
    off = sum(place_cost(touch) for touch in here.touches)
    roots = _prior_roots(here.touches, normals, here.sizes)
    return off + sum(float(((root @ f) ** 2).sum()) for root, f in zip(roots, here.forces))


def misfit_beside(sensor: Sensor, rows: Rows, sag: FloatArray) -> float:
    """Return about the misfit of the rows of a state whose moves with modulus and pulls are not known, with those of a state near by."""
    columns, known = nuisance_columns(sensor.knowledge, rows, sag)
    return misfit_of(rows.residual - known, columns, rows)[0]


def _prior_roots(touches: Sequence[Touch], normals: FloatArray, sizes: FloatArray) -> list[FloatArray]:
    """Return what whitens each force, shape (3, 3): of one size along all axes where the place is given, smaller across the normal of a contact."""
    result = []
    for touch, normal, size in zip(touches, normals, sizes):
        across = 1.0 if touch.source == "given" else ACROSS
        result.append(np.vstack([normal, tangents_of(normal) / across]) / size)
    return result
