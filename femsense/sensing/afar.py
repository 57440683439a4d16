"""A body that a touch has moved far since the last state: where to begin.

Rows tell only of the surface near by, and a step that lowers the misfit leads to the nearest valley. So states under single forces are solved
over the surface, as far as a body may go, and compared with the cloud as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError, FemsenseError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.pointcloud.rays import Surface
from femsense.sensing.forces import fit_forces, no_forces
from femsense.sensing.judge import left_over
from femsense.sensing.measurement_rows import MANY
from femsense.sensing.places import object_touches, seen_objects
from femsense.sensing.prepare import condensed_at
from femsense.sensing.responses import response_at
from femsense.sensing.states import solve_with
from femsense.sensing.touches import make_touch, touch_normal
from femsense.sensing.types import Fit, Sensor, Start, Touch

WAYS = (0.05, 0.1, 0.2, 0.3)
"""How far a force moves the body to first order, relative to its diagonal."""
APART = 0.12
"""How far apart the places are where a search begins, relative to the body's diagonal."""
TRIED = 3
"""So many of the states that fit best are where a fit begins."""
ANYWHERE = 0.2
"""How well the place of a contact that only the shape shows is known beforehand, relative to the body's diagonal."""
THIN = 400
"""Points that the states are compared with, about."""
ROUNDS = 3
"""Places are first tried where the shape lets expect them, then where objects touch the state that this has led to."""
STEP = 0.05
"""How much farther each step of a growing force moves the body to first order, relative to its diagonal."""
FARTHER = 1.5
"""A force has grown enough where the points lie so many times as far from the surface as they did."""

Ramp = tuple[float, Touch, Equilibrium, FloatArray]
"""How far the points lie from a state on average [m], the touch, the state, and its force (1, 3) [N]."""


def from_afar(
    sensor: Sensor, k: int, whole: Scan | None, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None
) -> tuple[Scan, Fit, Fit]:
    """Return scan, fit and fit without forces of frame k, begun far off where the body is far from its state without forces.

    Only where colour tells the robot: else what is far off may be anything.

    Arguments:
        whole: every point that was measured.
        scan: the points that the fit explains.
        fit: what was found from the states near by.
        free: the fit without forces.
        before: tensions along the cables until now (friction).
    """
    if whole is None or not whole.segmented or is_explained(sensor, fit) or not is_far(scan, free):
        return scan, fit, free
    best = (left_over(sensor, fit), scan, fit, free)
    touches = _likely(sensor, whole, free)
    for _ in range(ROUNDS):
        ramps = sorted((_ramp(sensor, k, whole, touch, free, before) for touch in touches), key=lambda ramp: ramp[0])
        for _, touch, state, force in ramps:
            best = min(best, _begun_at(sensor, k, whole, [touch], (state, force), free, before), key=lambda one: one[0])
            if is_explained(sensor, best[2]):
                return best[1:]
        near = best[2].state if best[2].touches else ramps[0][2]
        touches = object_touches(sensor, seen_objects(sensor, k, whole, near), near)
        if not touches:
            break
    return best[1:]


def averaged_anew(
    sensor: Sensor, k: int, whole: Scan | None, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None
) -> tuple[Scan, Fit, Fit]:
    """Return scan, fit and fit without forces of frame k with its points averaged at the state of the fit, where that explains more.

    The mean of the points of a face says as much as they do near the state where they were averaged. From a state that a touch has moved far, points
    beside an edge are of the face behind it, and what they scatter about their mean cannot be explained by any force.
    Arguments as for `from_afar`.
    """
    if whole is None or not whole.segmented or not fit.touches or is_explained(sensor, fit):
        return scan, fit, free
    left, few, again, alone = _begun_at(sensor, k, whole, fit.touches, (fit.state, fit.forces), free, before)
    return (few, again, alone) if left < left_over(sensor, fit) else (scan, fit, free)


def is_far(scan: Scan, free: Fit) -> bool:
    """Return whether so many rays miss the state without forces that it tells little of the body's."""
    return bool(free.rows.count < MANY * scan.measured.sum())


def is_explained(sensor: Sensor, fit: Fit) -> bool:
    """Return whether a fit leaves no more than free frames let expect."""
    return left_over(sensor, fit) <= sensor.knowledge.misfit_limit


def _likely(sensor: Sensor, whole: Scan, free: Fit) -> list[Touch]:
    """Return touches whose states, to first order, come nearest to the measured points; the nearest first, each elsewhere."""
    x, nodes = free.state.positions, sensor.candidates
    loads = np.zeros((len(nodes), *x.shape))
    loads[np.arange(len(nodes)), nodes] = -vertex_normals(x, sensor.surface.triangles)[nodes]
    moves = response_at(sensor, free.state, free.response).tangent.respond(loads)
    moves *= sensor.size / np.maximum(np.linalg.norm(moves, axis=2).max(axis=1), 1e-12)[:, None, None]
    points = _thin(sensor, whole)
    gaps = [(min(_gap(sensor, points, x + way * move) for way in WAYS), i) for i, move in enumerate(moves)]
    result: list[Touch] = []
    for _, i in sorted(gaps):
        touch = make_touch(sensor, sensor.robot.body.mesh.nodes[nodes[i]], source="shape", std_m=ANYWHERE * sensor.size)
        if all(np.linalg.norm(touch.place - other.place) > APART * sensor.size for other in result):
            result.append(touch)
        if len(result) == TRIED:
            break
    return result


def _ramp(sensor: Sensor, k: int, whole: Scan, touch: Touch, free: Fit, before: tuple[FloatArray, ...] | None) -> Ramp:
    """Return the state nearest to the measured points under a force into the surface that grows from nothing."""
    state, points = free.state, _thin(sensor, whole)
    load = touch.patch.spread(-touch_normal(sensor, touch, state), len(state.positions))
    compliance = float(np.linalg.norm(response_at(sensor, free.state, free.response).tangent.respond(load[None]), axis=2).max())
    best = (_gap(sensor, points, state.positions), touch, state, np.zeros((1, 3)))
    size = 0.0
    while size * compliance < WAYS[-1] * sensor.size:
        size += STEP * sensor.size / max(compliance, 1e-12)
        force = -size * touch_normal(sensor, touch, state)[None]
        try:
            state = solve_with(sensor, k, [touch], force, replace(state, factor=None), before=before)
        except FemsenseError:
            break
        gap = _gap(sensor, points, state.positions)
        if gap > FARTHER * best[0]:
            break
        best = min(best, (gap, touch, state, force), key=lambda ramp: ramp[0])
    return best


def _thin(sensor: Sensor, whole: Scan) -> FloatArray:
    return whole.points(sensor.calibration.poses)[:: max(1, len(whole.view) // THIN)]


def _gap(sensor: Sensor, points: FloatArray, positions: FloatArray) -> float:
    """Return how far measured points lie from the surface, on average [m]."""
    return float(Surface(positions, sensor.surface.triangles).gap(points).mean())


def _begun_at(
    sensor: Sensor,
    k: int,
    whole: Scan,
    touches: Sequence[Touch],
    start: tuple[Equilibrium, FloatArray],
    free: Fit,
    before: tuple[FloatArray, ...] | None,
) -> tuple[float, Scan, Fit, Fit]:
    """Return what a fit leaves that begins at a state, its points, the fit, and that without forces to the same points."""
    few = condensed_at(sensor, whole, start[0])
    alone = no_forces(sensor, k, few, free.state, free.response)
    try:
        fit = fit_forces(sensor, k, few, touches, alone, start=Start(*start), before=before)
    except DataError:
        return np.inf, few, alone, alone
    return left_over(sensor, fit), few, fit, alone
