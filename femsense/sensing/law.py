"""How far forces and places are off because the model is: by what it needs to move under gravity and cables as the body does, and by what another law
would have them be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.model.frame_state import solve_frame
from femsense.sensing.nuisance import commons
from femsense.sensing.states import ROUGH
from femsense.sensing.touches import nodal_forces, nodal_forces_by_shift, ways_of
from femsense.sensing.types import Fit, Knowledge, Sensor


def response_std(knowledge: Knowledge, cameras: int) -> float:
    """Return how far the model's answer to a force may be off beside its answer to gravity and cables, relative [1].

    Gravity and cables pull as declared, but the model needs another modulus or other pulls to move as the body does (mesh, law, ties): what it
    needs of them, it needs of a contact. The root mean square of the pulls that the free frames ask for, and that of the modulus beside it.
    """
    asked = np.arange(6 * cameras, commons(knowledge))
    square = knowledge.mean[asked] ** 2 + (knowledge.root[asked] ** 2).sum(axis=1)
    return float(np.sqrt(square[0] + (square[1:].mean() if len(asked) > 1 else 0.0)))


def law_std(
    sensor: Sensor, k: int, fit: Fit, free: Equilibrium, before: tuple[FloatArray, ...] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return how much each force of a fit would differ under the neo-Hookean law, relative [1], (m,), and its place along each axis [m], (m, 3).

    The corotational law is linear in stretch; laws that agree for small strains differ where a contact or a cable squeezes the body. Under the other
    law the same inputs and forces make another free and another touched state. By how much what the forces move differs between the laws, so much
    of a force, and of a shift of its place as far as that is not known, moves the rows alike. 0 where the robot declares a law by an effect; 1 where
    the other law has no such state.

    Arguments:
        k: index of the frame.
        fit: the frame with its contacts.
        free: its state without them.
        before: tensions along the cables until now (friction).
    """
    m, body = len(fit.touches), sensor.robot.body
    if not m or body.material.law != "corotational" or not np.linalg.norm(fit.forces, axis=1).all():
        return np.zeros(m), np.zeros((m, 3))
    try:
        moved = _under_other_law(sensor, k, fit, free, before) - (fit.state.positions - free.positions)
    except DataError:
        return np.ones(m), np.zeros((m, 3))
    return as_contacts(sensor, fit, moved)


def _under_other_law(sensor: Sensor, k: int, fit: Fit, free: Equilibrium, before: tuple[FloatArray, ...] | None) -> FloatArray:
    """Return how far the forces of a fit move the nodes under the neo-Hookean law [m], shape (n, 3). Raises DataError."""
    robot, n = sensor.robot, len(free.positions)
    robot = replace(robot, body=replace(robot.body, material=replace(robot.body.material, law="neo_hookean")))
    driven, options = replace(sensor.driven, robot=robot), SolveOptions(before=before, relative_tolerance=ROUGH, rough=True)
    loads = nodal_forces(fit.touches, fit.forces, n)
    alone = solve_frame(driven, k, start=replace(free, factor=None), options=options)
    touched = solve_frame(driven, k, start=replace(fit.state, factor=None), nodal_forces=loads, options=options)
    if not (alone.converged and touched.converged):
        raise DataError("no such state under the other law")
    return np.asarray(touched.positions - alone.positions)


def as_contacts(sensor: Sensor, fit: Fit, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what a move of the nodes (n, 3) [m] looks like in the rows of a fit: as a share of each force [1], (m,), and as a shift of its place along
    each axis [m], (m, 3), which costs what is known of the place."""
    m, n = len(fit.touches), len(moved)
    ways = [ways_of(touch) for touch in fit.touches]
    stds = np.concatenate([std for _, std in ways])
    loads = [t.patch.spread(force, n) for t, force in zip(fit.touches, fit.forces)]
    shifts = [nodal_forces_by_shift(sensor, t, e, f) for t, f, (es, _) in zip(fit.touches, fit.forces, ways) for e in es]
    tangent = tangent_at(sensor.robot.body, fit.state) if fit.response is None else fit.response.tangent
    answers = tangent.respond(np.array([*loads, *(std * shift for std, shift in zip(stds, shifts))]))
    rows = fit.rows.functional(np.concatenate([answers, moved[None]]))
    rows /= (fit.rows.std * np.sqrt(fit.rows.together / fit.rows.weight))[:, None]
    A, wanted = rows[:, :-1], rows[:, -1]
    known = np.diag(np.append(np.zeros(m), np.ones(2 * m)))
    found = np.linalg.solve(A.T @ A + known, A.T @ wanted)
    places = [np.abs((std * found[m + 2 * i : m + 2 * i + 2]) @ es) for i, (es, std) in enumerate(ways)]
    return np.abs(found[:m]), np.array(places)
