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
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.qp.forces import estimate_forces
from femsense.qp.friction_cone import FrictionCone
from femsense.qp.problem import ForceOptions
from femsense.sensing.nuisance import misfit_of, nuisance_columns, robust_std, sag_at
from femsense.sensing.touches import friction_cone, nodal_forces_by_shift, tangents_of, touch_normal
from femsense.sensing.types import Rows, Sensor, Touch

ACROSS = 0.5
"""Forces along the surface are expected to be so much smaller than those along the normal: rubber on plastic or skin slides at 0.5 to 1, and few slide."""
WIDER = 2.0
"""The size of the forces is itself uncertain: standard deviations are those of a prior so much wider than the likeliest."""
SIZINGS = 8
"""How often the size of the forces is estimated anew in one linear problem."""
LOST = 9.0
"""What a point counts that finds no surface in one state and one in another."""


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

    tangent: Tangent
    by_force: FloatArray  # (r, 3m)
    by_shift: FloatArray  # (r, 2m)
    frames: FloatArray  # tangents at rest, (m, 2, 3)
    nuisance: FloatArray  # (r, q), unit
    residual: FloatArray  # (r,), without what the free frames say
    normals: FloatArray  # outward, deformed, (m, 3)
    moves: FloatArray  # of the nodes by unit forces, (3m, n, 3)

    def cost(self, here: Iterate) -> float:
        """Return the misfit of the state, priors included."""
        off = sum(float(((t.place - t.expected) ** 2).sum()) / t.std_m**2 for t in here.touches if t.std_m > 0)
        roots = _prior_roots(here.touches, self.normals, here.sizes)
        prior = sum(float(((root @ f) ** 2).sum()) for root, f in zip(roots, here.forces))
        return misfit_with_lost(self.residual, self.nuisance, here.rows) + off + prior

    def step(self, sensor: Sensor, here: Iterate, trust: float = 1.0) -> ForceStep:
        """Return forces and shifts of the places that explain the rows best; where `trust` is below 1, near those that are here.

        Three components of one force are seldom all determined: a beam hardly yields along its axis. They share a Gaussian prior whose size the
        data choose (MacKay 1992), so that what the data do not see shrinks and does not inflate the force. Raises DataError.
        """
        m = len(here.touches)
        place_std = np.repeat([t.std_m for t in here.touches], 2)
        free = np.repeat([t.std_m > 0 and float(np.linalg.norm(f)) > 0 for t, f in zip(here.touches, here.forces)], 2)
        wanted = np.array([e @ (t.expected - t.place) for t, e in zip(here.touches, self.frames)]).ravel()
        R = self._reduced_rows(here, free * place_std, free * wanted)
        held = self._held(sensor, here, R, place_std, free * wanted, trust)
        forces, others, sizes = self._forces_and_sizes(sensor, here, R, held)
        covariance = _posterior(R, block_diag(*_prior_roots(here.touches, self.normals, WIDER * sizes)))
        place = covariance[3 * m : 5 * m, 3 * m : 5 * m] * np.outer(place_std, place_std)
        places = np.array([e.T @ place[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ e for i, e in enumerate(self.frames)])
        scale = max(1.0, 1.483 * float(np.median(np.abs(self.residual / here.rows.std)))) ** 2
        limit = sensor.surface.edge
        return ForceStep(
            forces,
            np.clip(free * (wanted + place_std * others[: 2 * m]), -limit, limit).reshape(m, 2),
            scale * covariance[: 3 * m, : 3 * m],
            scale * places.reshape(m, 3, 3),
            np.sqrt(scale * np.diag(covariance)[: 3 * m].reshape(m, 3).mean(axis=1)),
            sizes,
        )

    def _reduced_rows(self, here: Iterate, shift_std: FloatArray, wanted: FloatArray) -> FloatArray:
        """Return the triangle of forces, shifts, nuisance and right-hand side that says what all whitened rows say."""
        by_shift = self.by_shift * shift_std
        rest = self.residual + self.by_force @ here.forces.ravel() - self.by_shift @ wanted
        A = np.hstack([self.by_force, by_shift, self.nuisance, rest[:, None]])
        return np.asarray(np.linalg.qr(A / robust_std(here.rows, self.residual)[:, None], mode="r"))

    def _held(
        self, sensor: Sensor, here: Iterate, R: FloatArray, place_std: FloatArray, wanted: FloatArray, trust: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return rows and values that hold forces and shifts near those that are here; none where the step is trusted."""
        m, q, edge = len(here.touches), R.shape[1] - 1, sensor.surface.edge
        if trust >= 1.0:
            return np.zeros((0, q)), np.zeros(0)
        prior = block_diag(*_prior_roots(here.touches, self.normals, here.sizes))
        free_forces, _ = _solve_qp(R, prior, None, (np.zeros((0, q)), np.zeros(0)))
        far = max(float(np.abs(free_forces).max()), 1e-6)
        weight = np.concatenate([np.full(3 * m, 1.0 / far), place_std / edge]) / trust
        rows = np.diag(np.append(weight, np.zeros(q - 5 * m)))[: 5 * m]
        return rows, np.append(here.forces.ravel() / far, -wanted / edge) / trust

    def _forces_and_sizes(
        self, sensor: Sensor, here: Iterate, R: FloatArray, held: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return forces (m, 3), the other unknowns, and the size of each force that makes the rows likeliest (m,)."""
        m, sizes = len(here.touches), here.sizes
        cone = friction_cone(sensor, here.touches, self.normals)
        for _ in range(SIZINGS):
            prior = block_diag(*_prior_roots(here.touches, self.normals, sizes))
            covariance = _posterior(R, prior)
            forces, others = _solve_qp(R, prior, cone, held)
            whitened = prior @ covariance[: 3 * m, : 3 * m] @ prior.T
            share = ((prior @ forces.ravel()) ** 2 + np.diag(whitened)).reshape(m, 3).sum(axis=1) / 3.0
            new = np.clip(sizes * np.sqrt(share), 1e-6, sensor.options.force_std_n)
            settled = bool((np.abs(new - sizes) < 0.02 * new).all())
            sizes = new
            if settled:
                break
        return forces, others, sizes


def linearise(sensor: Sensor, here: Iterate) -> Linearisation:
    """Return how the rows of an iterate answer to forces, to shifts of their places, and to the nuisance."""
    tangent = tangent_at(sensor.robot.body, here.state)
    n, m = len(here.state.positions), len(here.touches)
    basis = np.array([t.patch.spread(axis, n) for t in here.touches for axis in np.eye(3)])
    frames = np.array([tangents_of(t.normal) for t in here.touches]).reshape(m, 2, 3)
    shifts = [nodal_forces_by_shift(sensor, t, e, f) for t, es, f in zip(here.touches, frames, here.forces) for e in es]
    sag = sag_at(sensor, here.state, tangent)
    moves = tangent.respond(np.concatenate([basis, np.array(shifts)]))
    answers = here.rows.functional(moves)
    columns, known = nuisance_columns(sensor.knowledge, here.rows, sag)
    return Linearisation(
        tangent,
        answers[:, : 3 * m],
        answers[:, 3 * m :],
        frames,
        columns,
        here.rows.residual - known,
        np.array([touch_normal(sensor, t, here.state) for t in here.touches]),
        moves[: 3 * m],
    )


def misfit_with_lost(residual: FloatArray, nuisance: FloatArray, rows: Rows) -> float:
    """Return the misfit of rows with nuisance fitted, points without a surface counted in."""
    return misfit_of(residual, nuisance, rows)[0] + LOST * rows.lost / rows.together


def _prior_roots(touches: Sequence[Touch], normals: FloatArray, sizes: FloatArray) -> list[FloatArray]:
    """Return what whitens each force, shape (3, 3): of one size along all axes where the place is given, smaller across the normal of a contact."""
    result = []
    for touch, normal, size in zip(touches, normals, sizes):
        across = 1.0 if touch.source == "given" else ACROSS
        result.append(np.vstack([normal, tangents_of(normal) / across]) / size)
    return result


def _posterior(R: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance of forces, shifts and nuisance; the cone, where it acts, would only make it smaller."""
    A, f = R[:, :-1], len(prior)
    precision = A.T @ A + np.eye(A.shape[1])
    precision[:f, :f] += prior.T @ prior - np.eye(f)
    return np.asarray(np.linalg.inv(precision))


def _solve_qp(
    R: FloatArray, prior: FloatArray, cone: FrictionCone | None, held: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return forces (m, 3) within the cone and the nuisance; `held` are rows and values that hold them. Raises DataError."""
    f = len(prior)
    A = np.vstack([R[:, :-1], np.hstack([prior, np.zeros((f, R.shape[1] - 1 - f))]), held[0]])
    b = np.concatenate([R[:, -1], np.zeros(f), held[1]])
    options = ForceOptions(nuisance=A[:, f:], nuisance_std=np.ones(A.shape[1] - f), friction_cone=cone)
    estimate = estimate_forces(A[:, :f], None, np.zeros(len(A)), b, std=1.0, options=options)
    if not np.isfinite(estimate.forces).all():
        raise DataError(f"the force problem has no answer: {estimate.status}")
    return estimate.forces.reshape(-1, 3), estimate.nuisance
