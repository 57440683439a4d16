"""Equilibrium, compliance and quadratic programme, until the forces stop changing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.fem.mesh import vertex_normals
from femsense.model.contact_patch import ContactPatch, patch_at
from femsense.model.variants import solve_frame
from femsense.qp.forces import ForceEstimate, estimate_forces
from femsense.qp.problem import FrictionCone
from femsense.sensing.measurement import _measure, _voxel
from femsense.sensing.types import Rows, SeenPoints, Sensor

ROUGH = 1e-6
"""Unbalanced force, relative to all loads, of the states on the way to the forces; the last one is exact."""


PLACE_STD = 0.5
"""How well the place of a contact is known, in search radii."""


# --- forces --------------------------------------------------------------------------------------------------------------


def _fit_forces(
    sensor: Sensor,
    k: int,
    clouds: SeenPoints | None,
    patches: Sequence[ContactPatch],
    source: str,
    free_state: Equilibrium,
    start: tuple[Equilibrium, FloatArray] | None,
    before: tuple[FloatArray, ...] | None,
) -> tuple[Equilibrium, ForceEstimate, Rows]:
    """Equilibrium → compliance → QP, until the forces stop changing or no step makes the fit better.

    `start` is a state near by and the forces in it.
    """
    n = len(sensor.robot.body.mesh.nodes)
    basis = np.array([patch.spread(axis, n) for patch in patches for axis in np.eye(3)])
    state, forces = free_state, np.zeros(len(basis))
    if start is not None and len(start[1]) == len(basis):
        forces = start[1]
        state = _solve(sensor, k, np.tensordot(forces, basis, axes=1), start[0], before, ROUGH)
    rows = _measure(sensor, k, clouds, state)
    estimate: ForceEstimate | None = None
    size = np.inf
    for iteration in range(sensor.options.iterations):
        rows = rows if clouds is None or iteration == 0 else _measure(sensor, k, clouds, state, _reach(sensor, rows))
        outlying = _outlying(rows)
        rows = _robust(rows, outlying)
        directions = _directions(sensor, patches, state, source)
        tangent = tangent_at(sensor.robot.body, state)
        load = internal(sensor.robot.body, state.positions, tangent=False).forces
        moves = tangent.respond(np.concatenate([basis, load[None]]))
        moves, sag = moves[:-1], moves[-1:]
        W = rows.functional(moves) @ directions
        nuisance = _nuisance(sensor, rows, sag)
        estimate, size = _solve_qp(sensor, rows, W, nuisance, directions, forces, state, patches, source, size)
        step = directions @ estimate.forces - forces
        still = np.maximum(
            2e-3 * max(float(np.abs(forces + step).max()), 1e-3), 0.05 * np.linalg.norm(directions * estimate.std, axis=1)
        )
        if (np.abs(step) < still).all():
            break
        cost = _cost(rows, nuisance, forces, size, outlying)
        better = None
        for share in (1.0, 0.4, 0.1):  # large deflections: a full step may lead too far
            try:
                there = _predicted(state, tangent, np.tensordot(share * step, moves, axes=1))
                there = _solve(sensor, k, np.tensordot(forces + share * step, basis, axes=1), there, before, ROUGH)
                seen = _measure(sensor, k, clouds, there, np.inf if iteration == 0 else _reach(sensor, rows))
            except DataError:
                continue
            seen = _robust(seen, outlying)
            gain = cost - _cost(seen, _nuisance(sensor, seen, sag), forces + share * step, size, outlying)
            if gain > 0:
                better = (forces + share * step, there, seen)
                break
        if better is None:
            break
        forces, state, rows = better
        if gain < 1e-3 * cost:
            break
    state = _solve(sensor, k, np.tensordot(forces, basis, axes=1), state, before)
    assert estimate is not None
    covariance = rows.crowding**2 * (directions @ estimate.covariance @ directions.T)
    if source == "cloud":
        covariance = covariance + _place_covariance(sensor, patches, state, tangent, rows, forces)
    return state, replace(estimate, forces=freeze(forces), covariance=freeze(covariance)), rows


def _predicted(state: Equilibrium, tangent: Tangent, move: FloatArray) -> Equilibrium:
    """Return a start near the state that follows when nodes move by `move` [m], shape (n, 3), with the factor that said so."""
    factor = tangent.factor if tangent.factor.negative == 0 else None
    return replace(state, positions=state.positions + move, factor=factor)


def _place_covariance(
    sensor: Sensor, patches: Sequence[ContactPatch], state: Equilibrium, tangent: Tangent, rows: Rows, forces: FloatArray
) -> FloatArray:
    """Return what not knowing the place of contact exactly adds to the covariance of the forces [N²], shape (3k, 3k).

    The camera sees the rim of what touches, not the contact itself. Each force is fitted again at places shifted along the surface
    by PLACE_STD of the search radius, so that it moves the rows as before.
    """
    n, count = len(state.positions), 3 * len(patches)
    covariance = np.zeros((count, count))
    shift = PLACE_STD * (sensor.options.contact_radius_m or 3.0 * _voxel(sensor))
    for i, patch in enumerate(patches):
        force = forces[3 * i : 3 * i + 3]
        size, normal = float(np.linalg.norm(force)), _normal(sensor, patch, state)
        if size == 0:
            continue
        across = np.linalg.svd(normal[None])[2][1:]
        places = [patch.mean(state.positions) + shift * t for t in across]
        moved = [
            patch_at(sensor.surface, state.positions, p, 1.5 * sensor.surface.edge, sensor.robot.body.clamped, facing=normal)
            for p in places
        ]
        moves = (
            rows.functional(tangent.respond(np.array([q.spread(force / size, n) for q in [patch, *moved]]))) / rows.std[:, None]
        )
        again = size * (moves[:, 1:].T @ moves[:, 0]) / np.maximum((moves[:, 1:] ** 2).sum(axis=0), 1e-300)
        spread = float(((again - size) ** 2).sum())
        relative = spread / size**2 + sensor.options.cloud_force_std**2
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = relative * np.outer(force, force)
    return covariance


def _reach(sensor: Sensor, rows: Rows) -> float:
    """Return how far along the normal a match may still lie [m]: what lies farther than the rest belongs to something else."""
    return max(6.0 * float(np.median(np.abs(rows.residual))), 1.5 * _voxel(sensor))


def _outlying(rows: Rows) -> float:
    """Return from which size on a whitened residual stands out [1]: 2.5 times the median scale (Huber)."""
    return 2.5 * max(1.483 * float(np.median(np.abs(rows.residual / rows.sharp))), 1.0)


def _robust(rows: Rows, outlying: float) -> Rows:
    """Return the rows with larger standard deviations where residuals stand out."""
    return replace(rows, std=rows.sharp * np.sqrt(np.maximum(np.abs(rows.residual / rows.sharp) / outlying, 1.0)))


def _directions(sensor: Sensor, patches: Sequence[ContactPatch], state: Equilibrium, source: str) -> FloatArray:
    """Return what the unknowns are: all three components, or the inward normal of each patch, shape (3k, unknowns)."""
    if not _along_normals(sensor, source):
        return np.eye(3 * len(patches))
    directions = np.zeros((3 * len(patches), len(patches)))
    for i, patch in enumerate(patches):
        directions[3 * i : 3 * i + 3, i] = -_normal(sensor, patch, state)
    return directions


def _along_normals(sensor: Sensor, source: str) -> bool:
    return source == "cloud" and sensor.options.friction == 0


def _normal(sensor: Sensor, patch: ContactPatch, state: Equilibrium) -> FloatArray:
    mean = patch.mean(vertex_normals(state.positions, sensor.surface.triangles))
    return mean / max(float(np.linalg.norm(mean)), 1e-12)


def _nuisance(sensor: Sensor, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return how the model moves with modulus and pose, in units of their standard deviations [m], shape (r, j).

    `sag` is the response of the nodes to the internal forces [m], shape (1, n, 3): a body so much softer moves on by so much.
    """
    return np.hstack([-sensor.options.modulus_std * rows.functional(sag), -rows.by_pose])


def _cost(rows: Rows, nuisance: FloatArray, forces: FloatArray, size: float, outlying: float) -> float:
    """Return the mean of Huber's function of the whitened residual with nuisance fitted, and of the forces against their prior."""
    A = np.vstack([nuisance / rows.std[:, None], np.eye(nuisance.shape[1])])
    b = np.concatenate([rows.residual / rows.std, np.zeros(nuisance.shape[1])])
    fitted = np.linalg.lstsq(A, b, rcond=None)[0]
    z = np.abs(rows.residual - nuisance @ fitted) / rows.sharp
    loss = np.where(z <= outlying, z**2, outlying * (2.0 * z - outlying)).sum() + fitted @ fitted
    return float((loss + (0.0 if np.isinf(size) else forces @ forces / size**2)) / len(rows.residual))


def _solve_qp(
    sensor: Sensor,
    rows: Rows,
    W: FloatArray,
    nuisance: FloatArray,
    directions: FloatArray,
    forces: FloatArray,
    state: Equilibrium,
    patches: Sequence[ContactPatch],
    source: str,
    size: float,
) -> tuple[ForceEstimate, float]:
    """The QP in the total forces: modelled = W (f − f₀) at the linearisation f₀; pose and modulus are nuisance with priors.

    Three free components of one force are seldom all determined (a beam hardly yields along its axis). They share a Gaussian
    prior of unknown size, which the data choose (MacKay 1992): what the data do not see shrinks, what they see stays.

    Returns:
        the estimate, and the size of that prior [N] (inf where each force has one component).
    """
    now = np.linalg.lstsq(directions, forces, rcond=None)[0]
    pushing, cone = _along_normals(sensor, source), None
    if source == "cloud" and sensor.options.friction:
        cone = FrictionCone(normals=np.array([_normal(sensor, p, state) for p in patches]), mu=sensor.options.friction)

    def answer(prior: float) -> ForceEstimate:
        extra = 0 if np.isinf(prior) else W.shape[1]  # the prior on the forces as rows: 0 ± prior
        estimate = estimate_forces(
            np.vstack([W, np.eye(W.shape[1])[:extra]]),
            None,
            np.concatenate([-W @ now, np.zeros(extra)]),
            np.concatenate([rows.residual, np.zeros(extra)]),
            std=np.concatenate([rows.std, np.full(extra, prior)]),
            force_lower=np.zeros(W.shape[1]) if pushing else None,
            friction_cone=cone,
            nuisance=np.vstack([nuisance, np.zeros((extra, nuisance.shape[1]))]),
            nuisance_std=np.ones(nuisance.shape[1]),
            inflate=True,
        )
        if not np.isfinite(estimate.forces).all():
            raise DataError(f"the force problem has no answer: {estimate.status}")
        return estimate

    estimate = answer(size)
    if pushing:
        return estimate, np.inf
    for _ in range(20):
        square = float(estimate.forces @ estimate.forces)
        blurred = float(np.trace(estimate.covariance)) if np.isfinite(estimate.covariance).all() else 0.0
        new = float(np.sqrt((square + blurred) / len(estimate.forces)))
        if not np.isfinite(new) or new < 1e-9 or abs(new - size) < 1e-3 * new:
            break
        size = new
        estimate = answer(size)
    return estimate, size


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
