"""Which contacts explain a frame: what objects touch, then what the shape alone betrays, one after the other, until nothing is left to explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.pointcloud.primitives import Shape
from femsense.sensing.afar import ANYWHERE, APART, averaged_anew, from_afar
from femsense.sensing.forces import fit_forces
from femsense.sensing.judge import SURE, chi_squared, first_to_go, left_over, unspoken
from femsense.sensing.nuisance import nuisance_columns, robust_std
from femsense.sensing.places import away_from_scenery, given_touches, object_touches, said_free
from femsense.sensing.responses import response_at
from femsense.sensing.states import foretold
from femsense.sensing.touches import make_touch, moved_to
from femsense.sensing.types import Fit, Rows, SensedFrame, Sensor, Start, Touch

STARTS = 3
"""From how many candidates a search begins at most."""
ACROSS = 0.3
"""Size of forces along the surface that is expected of a contact whose place is searched, relative to those along the normal."""
MOST = 4
"""Contacts a frame at most."""
ROUNDS = 2
"""How often a place is looked for again with the state that its force makes."""
NEARBY = 0.03
"""The search takes the answers of a state whose nodes are nearer than this share of the body's diagonal: they rank places, and do not weigh forces."""
THIN = 2000
"""Rows that the search uses at most."""


def explain(
    sensor: Sensor,
    k: int,
    whole: Scan | None,
    scan: Scan | None,
    shapes: list[Shape],
    free: Fit,
    previous: SensedFrame | None,
    before: tuple[FloatArray, ...] | None,
) -> tuple[Scan | None, Fit, Fit]:
    """Return the contacts and forces that explain frame k, with the scan and the fit without forces that go with them.

    Contacts that do not make the misfit smaller are left out. `whole` is every point that was measured, `scan` what `segmented` made of it.
    """
    if scan is None or len(sensor.places):
        touches = given_touches(sensor)
        fit = fit_forces(sensor, k, scan, touches, free, start=start_from(previous, touches), before=before) if touches else None
        return scan, better(free, fit), free
    if said_free(sensor, k):
        return scan, free, free
    again = _held(sensor, k, scan, shapes, free, previous, before)
    earned = again is not None and _earned(sensor, scan, shapes, again, free)
    if again is not None and earned and nothing_new(sensor, again, object_touches(sensor, shapes, again.state)):
        return scan, again, free
    fit = _with_objects(sensor, k, scan, shapes, free, free if again is None else again, before)
    scan, fit, free = averaged_anew(sensor, k, whole, scan, fit, free, before)
    scan, fit, free = from_afar(sensor, k, whole, scan, fit, free, before)
    fit = with_hidden(sensor, k, scan, fit, free, before)
    scan, fit, free = averaged_anew(sensor, k, whole, scan, fit, free, before)
    return scan, _seen_instead(sensor, k, scan, shapes, free, fit, before), free


def with_hidden(
    sensor: Sensor, k: int, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None, *, most: int = MOST
) -> Fit:
    """Return the fit with contacts that the shape alone betrays, one after the other, until there are so many."""
    for _ in range(most - len(fit.touches)):
        start = Start(fit.state, np.vstack([fit.forces, np.zeros((1, 3))]), fit.response)
        more = fit
        for found in find_hidden(sensor, fit):
            more = better(more, attempt(sensor, k, scan, [*fit.touches, found], free, start, before))
        more = _significant(sensor, k, scan, more, free, before)
        if more.cost > fit.cost - 2.0 * sensor.knowledge.gain_limit:
            break
        fit = more
    return fit


def find_hidden(sensor: Sensor, fit: Fit) -> list[Touch]:
    """Return touches that would explain most of what a fit leaves, the best first; none where that is no more than noise can do.

    One linear solve answers for all candidates: the gain in log evidence of a force there with a Gaussian prior, pushing inwards. The best one is
    where the fit begins; its place moves with the forces, and nothing but the rows says where to.
    """
    gain, _ = evidence(sensor, fit)
    nodes = sensor.robot.body.mesh.nodes[sensor.candidates]
    if not len(gain) or gain.max() < sensor.knowledge.gain_limit:
        return []
    found: list[Touch] = []
    for i in np.argsort(-gain):
        if len(found) == STARTS or gain[i] < max(sensor.knowledge.gain_limit, 0.5 * gain.max()):
            break
        if all(np.linalg.norm(nodes[i] - t.place) > APART * sensor.size for t in found):
            found.append(make_touch(sensor, nodes[i], source="shape", std_m=ANYWHERE * sensor.size))
    return found


def evidence(sensor: Sensor, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return the gain in log evidence of one more contact at each candidate, shape (c,), and its force (c, 3) [N]."""
    n = len(fit.state.positions)
    response = response_at(sensor, fit.state, fit.response)
    held = np.zeros((len(fit.rows.std), 0))
    if fit.touches:
        loads = np.array([t.patch.spread(a, n) for t in fit.touches for a in np.eye(3)])
        held = fit.rows.functional(response.tangent.respond(loads))
    return evidence_of(sensor, fit.state, fit.rows, response.sag, held)


def evidence_of(
    sensor: Sensor, state: Equilibrium, rows: Rows, sag: FloatArray, held: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gain in log evidence of one more contact at each candidate, shape (c,), and its force (c, 3) [N].

    Arguments:
        state: where it is asked for.
        rows: of the frame at that state.
        sag: how the nodes move with the modulus and the pulls, as `sag_at` has it.
        held: how the rows answer to the forces of the contacts that are there, shape (r, 3m) [m/N].
    """
    normals = vertex_normals(state.positions, sensor.surface.triangles)[sensor.candidates]
    frames = np.concatenate([normals[:, None], np.linalg.svd(normals[:, None])[2][:, 1:]], axis=1)  # rows: normal, tangents
    answers = _answers(sensor, state)
    columns, known = nuisance_columns(sensor.knowledge, rows, sag)
    residual = rows.residual - known
    columns = np.hstack([columns, sensor.options.force_std_n * held])
    std = robust_std(rows, residual)
    thin = np.arange(0, len(std), max(1, len(std) // THIN))
    share = len(std) / len(thin)
    N, z = columns[thin] / std[thin, None], residual[thin] / std[thin]
    W = frames @ (rows.some(thin, answers) / std[thin, None]).T.reshape(len(frames), 3, -1)  # of each candidate, (c, 3, t)
    inner = np.linalg.inv(N.T @ N + np.eye(N.shape[1]) / share)
    WN = W @ N
    g = share * (W @ z - WN @ (inner @ (N.T @ z)))
    M = share * (W @ W.transpose(0, 2, 1) - WN @ inner @ WN.transpose(0, 2, 1))
    prior = np.diag([1.0, ACROSS**-2, ACROSS**-2]) / sensor.options.force_std_n**2
    H = M + prior
    f = np.linalg.solve(H, g[:, :, None])[:, :, 0]
    gain = 0.5 * (g * f).sum(axis=1) - 0.5 * (np.linalg.slogdet(H)[1] - np.linalg.slogdet(prior)[1])
    along = g[:, 0] / H[:, 0, 0]
    alone = 0.5 * (g[:, 0] * along - np.log(H[:, 0, 0] / prior[0, 0]))
    mu = np.inf if sensor.options.friction is None else sensor.options.friction
    slides = np.linalg.norm(f[:, 1:], axis=1) > -mu * f[:, 0]  # beyond its cone: then along the normal only
    f = np.where(slides[:, None], along[:, None] * np.array([1.0, 0.0, 0.0]), f)
    return np.where(f[:, 0] < 0, np.where(slides, alone, gain), -np.inf), np.einsum("ci,cij->cj", f, frames)


def _answers(sensor: Sensor, state: Equilibrium) -> FloatArray:
    """Return how the nodes answer to unit forces at the candidates near a state [m/N], shape (3n, 3c)."""
    kept = sensor.answers
    if kept.state is None or np.abs(kept.state.positions - state.positions).max() > NEARBY * sensor.size:
        kept.state, kept.columns = replace(state, factor=None), None
    if kept.columns is None:
        near = tangent_at(sensor.robot.body, kept.state)
        n, c = len(state.positions), len(sensor.candidates)
        loads = np.zeros((c, 3, n, 3))
        loads[np.arange(c), :, sensor.candidates] = np.eye(3)
        kept.columns = np.ascontiguousarray(near.respond(loads.reshape(-1, n, 3)).reshape(3 * c, -1).T)
    return kept.columns


# --- helpers ----------------------------------------------------------------------------------------------------------


def _with_objects(
    sensor: Sensor, k: int, scan: Scan, shapes: list[Shape], free: Fit, fit: Fit, before: tuple[FloatArray, ...] | None
) -> Fit:
    """Return a fit with what objects touch, their places found again in the state that the forces make."""
    for _ in range(ROUNDS if shapes else 0):
        found = object_touches(sensor, shapes, fit.state)
        if _same(sensor, found, fit):
            break
        own = [
            t
            for t in fit.touches
            if t.source == "shape" and all(np.linalg.norm(t.place - o.place) > 0.15 * sensor.size for o in found)
        ]
        start = _start_of(sensor, fit, [*found, *own])
        fit = better(free, attempt(sensor, k, scan, [*found, *own], free, start, before) if found or own else None)
    fit = _significant(sensor, k, scan, fit, free, before)
    return fit if _earned(sensor, scan, shapes, fit, free) else free


def _seen_instead(
    sensor: Sensor, k: int, scan: Scan, shapes: list[Shape], free: Fit, fit: Fit, before: tuple[FloatArray, ...] | None
) -> Fit:
    """Return the fit with what objects touch in its state in place of a contact that only the shape shows, where that explains the frame as well.

    Some objects touch only in the state that a contact makes: in that of the inputs alone they lie inside the body, or beside it.
    """
    if all(touch.source == "cloud" for touch in fit.touches):
        return fit
    known = [touch for touch in fit.touches if touch.source == "cloud"]
    if all(_near(sensor, found, known) for found in away_from_scenery(sensor, object_touches(sensor, shapes, fit.state))):
        return fit
    seen = _with_objects(sensor, k, scan, shapes, free, fit, before)
    as_well = left_over(sensor, seen) <= max(sensor.knowledge.misfit_limit, left_over(sensor, fit))
    return seen if seen.touches and as_well else fit


def _earned(sensor: Sensor, scan: Scan, shapes: list[Shape], fit: Fit, free: Fit) -> bool:
    """Return whether contacts are more than what free frames leave where no colour tells what is an object and what the robot.

    There a few points beside the robot are mostly its own. Where no completed object touches, contacts have to explain as much as those that only the
    shape shows.
    """
    completed = [shape for shape in shapes if shape.kind != "points"]
    if scan.segmented or not fit.touches or object_touches(sensor, completed, fit.state):
        return True
    return fit.cost <= free.cost - 2.0 * sensor.knowledge.gain_limit


def _held(
    sensor: Sensor,
    k: int,
    scan: Scan,
    shapes: list[Shape],
    free: Fit,
    previous: SensedFrame | None,
    before: tuple[FloatArray, ...] | None,
) -> Fit | None:
    """Return the fit of what held in the frame before; None where that does not explain this one."""
    if previous is None or not previous.touches:
        return None
    near = foretold(previous, free.state)
    held, kept = held_on(sensor, previous.touches, object_touches(sensor, shapes, near), previous.sure, gone=not shapes)
    forces = np.vstack([previous.forces, np.zeros((1, 3))])[kept]
    again = attempt(sensor, k, scan, held, free, Start(near, forces, previous.response, firm=True), before) if held else None
    if again is None or left_over(sensor, again) > sensor.knowledge.misfit_limit or again.cost >= free.cost:
        return None
    return again


def nothing_new(sensor: Sensor, fit: Fit, found: Sequence[Touch]) -> bool:
    """Return whether a fit leaves nothing to be explained by another contact: objects touch where it has contacts, each of its contacts is sure
    or where an object still touches, and nowhere on the surface another one gains enough.

    Arguments:
        found: where objects touch in the state of the fit.
    """
    if any(v < SURE and not (unspoken(fit, i) and _near(sensor, fit.touches[i], found)) for i, v in enumerate(chi_squared(fit))):
        return False
    if any(t.source != "cloud" and _near(sensor, t, found) for t in fit.touches):
        return False
    if not all(_near(sensor, f, fit.touches) for f in found):
        return False
    return not find_hidden(sensor, fit)


def _near(sensor: Sensor, touch: Touch, others: Sequence[Touch]) -> bool:
    return any(float(np.linalg.norm(touch.place - other.expected)) < _reach(sensor, touch) for other in others)


def _reach(sensor: Sensor, found: Touch) -> float:
    """Return within which distance [m] a contact is that of an object: along a rod that lies on the body its place may be anywhere."""
    return max(APART * sensor.size, 2.0 * found.std_m)


def held_on(
    sensor: Sensor, touches: Sequence[Touch], found: Sequence[Touch], sure: Sequence[bool], *, gone: bool = False
) -> tuple[list[Touch], IntArray]:
    """Return the touches of the frame before, each moved on with the nearest one that is found now, then those that are new; and which they are.

    New ones have the number −1: what they may carry, the others may seem to carry, whether the shape shows it or not.

    Arguments:
        touches: of the frame before.
        found: where objects touch now.
        sure: of each touch whether it carried a force. Of one that did not, the place is as it is seen, since the shape says nothing of it; where
            it is not seen any more, it is left out.
        gone: no object is seen any more: none touches.
    """
    result: list[Touch] = []
    kept: list[int] = []
    gap = np.array([[np.linalg.norm(touch.expected - f.place) for f in found] for touch in touches]).reshape(
        len(touches), len(found)
    )
    reach = [_reach(sensor, f) for f in found]
    for i, touch in enumerate(touches):
        j = int(gap[i].argmin()) if touch.source == "cloud" and len(found) else -1
        seen = j >= 0 and gap[i, j] < reach[j] and i == int(gap[:, j].argmin())
        if seen:
            result.append(_moved_on(sensor, touch, found[j]) if sure[i] else replace(found[j], std_m=0.0))
        elif sure[i] and not (gone and touch.source == "cloud"):
            result.append(replace(touch, source="shape"))
        kept += [i] * (len(result) - len(kept))
    new = [f for j, f in enumerate(found) if not len(touches) or gap[:, j].min() >= reach[j]]
    return [*result, *new], np.array([*kept, *(-1 for _ in new)], dtype=np.int64)


def _moved_on(sensor: Sensor, touch: Touch, found: Touch) -> Touch:
    """Return where an object is found to touch, with what the shape said of the place in the frame before."""
    place = found.place + touch.place - touch.expected
    return replace(moved_to(sensor, found, place), expected=found.place)


def _same(sensor: Sensor, found: Sequence[Touch], fit: Fit) -> bool:
    """Return whether objects touch where the fit has contacts already; where it has one that carries nothing, it does not matter as much."""
    touches = fit.touches
    if len(found) != len(touches) or any(t.source != "cloud" for t in touches):
        return False
    if not touches:
        return True
    reach = np.where(chi_squared(fit) < 1.0, APART * sensor.size, 0.3 * sensor.surface.edge)
    gap = np.linalg.norm([[f.place - t.expected for t in touches] for f in found], axis=2)
    return bool((gap < reach).any(axis=1).all() and (gap < reach).any(axis=0).all())


def _significant(sensor: Sensor, k: int, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None) -> Fit:
    """Return the fit without contacts whose force may be noise, or that pull.

    An object that touches beside another one stays in the fit: what it may carry is part of how well the other is known.
    """
    while fit.touches:
        value = chi_squared(fit)
        weak = [i for i, v in enumerate(value) if v < SURE and not unspoken(fit, i)]
        if not weak:
            return fit
        weakest = first_to_go(fit, weak)
        kept = [t for i, t in enumerate(fit.touches) if i != weakest]
        if not kept:
            return free
        start = Start(fit.state, np.delete(fit.forces, weakest, axis=0), fit.response)
        fit = better(free, attempt(sensor, k, scan, kept, free, start, before))
    return fit


def attempt(
    sensor: Sensor,
    k: int,
    scan: Scan,
    touches: Sequence[Touch],
    free: Fit,
    start: Start | None,
    before: tuple[FloatArray, ...] | None,
) -> Fit | None:
    try:
        return fit_forces(sensor, k, scan, touches, free, start=start, before=before)
    except DataError:
        return None


def better(free: Fit, fit: Fit | None) -> Fit:
    """Return the fit, unless it explains no more than no contact at all."""
    return free if fit is None or fit.cost >= free.cost else fit


def start_from(previous: SensedFrame | None, touches: Sequence[Touch]) -> Start | None:
    if previous is None or len(previous.touches) != len(touches):
        return None
    return Start(previous.state, previous.forces, previous.response)


def _start_of(sensor: Sensor, fit: Fit, touches: Sequence[Touch]) -> Start | None:
    """Return the state and forces of a fit as a start for some touches, each with the force of the nearest one; None where one has no place there."""
    if not fit.touches or not touches:
        return None
    gap = np.linalg.norm([[t.place - old.place for t in touches] for old in fit.touches], axis=2)
    nearest = gap.argmin(axis=1)
    if gap.min(axis=1).max() > APART * sensor.size or len(set(nearest)) < len(nearest):
        return None
    forces = np.zeros((len(touches), 3))
    forces[nearest] = fit.forces
    return Start(fit.state, forces, fit.response)
