"""The discretisation error of a robot: motions and sensed forces on it against those on finer spaces of the same body.

The same loads act on the declared mesh, on quadratic elements and on a mesh with each element split into eight.
Clamp and loads cover the same parts of the body in all of them, so that only the finite-element space differs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from femsense.app.accuracy.errors import Answer, space_name
from femsense.app.accuracy.loads import (
    Load,
    LoadKind,
    Patches,
    SolvedSpace,
    body_on,
    contact_patches,
    feasible_loads,
    felt_features,
    states_under,
)
from femsense.app.accuracy.report import AccuracyOptions, accuracy_report
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.body import BodyModel
from femsense.fem.compliance import tangent_at
from femsense.fem.mesh import embed_points
from femsense.model.remeshing import finer_mesh
from femsense.model.robot import Robot

STEPS = 8
"""Factorisations that a state and its start take, about."""
SPACES = (("tet4", 0), ("tet10", 0), ("tet4", 1), ("tet10", 1))
"""Element and refinements, the cheapest first."""
Progress = Callable[..., None]


def expected_duration(options: AccuracyOptions | None = None) -> str:
    """Return how long `assess_accuracy` may take, in words."""
    seconds = (options or AccuracyOptions()).most_seconds
    return f"at most about {seconds / 60:.0f} minutes of processor time: finer spaces that would take longer are left out"


def assess_accuracy(robot: Robot, *, options: AccuracyOptions | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Return the discretisation error of a robot in motion and in force, and a recommended mesh, as plain tables.

    Arguments:
        robot: as it is declared.
        options: limits on finer spaces, and the errors that are fine enough.
        progress: called with the name of each step.

    Returns:
        `declared`, `reference` (what was taken as the truth), `loads` (a row each), `forces`, `spaces` (what each would cost) and
        `advice`.

    Raises:
        DataError: where the declared model itself does not converge.
    """
    tell, options = progress or (lambda *_: None), options or AccuracyOptions()
    tell("the declared mesh")
    places = observed_points(robot)
    coarse = "tet10" if robot.body.mesh.is_quadratic else "tet4"
    loads, solved = feasible_loads(robot.body)
    chosen = [space for space in SPACES if space == (coarse, 0) or _affordable(robot.body, space, options.most_unknowns)]
    meshes = {space: finer_mesh(robot.body.mesh, space[0], space[1]) for space in chosen}
    finest = max(meshes.values(), key=lambda mesh: len(mesh.nodes))
    patches = contact_patches(robot, finest, felt_features(robot, solved.states[0], places))
    answers: list[Answer] = []
    began = time.process_time()
    left_out = [f"{space_name(*space)} (too many unknowns)" for space in SPACES if space not in chosen]
    for element, refinements in chosen:
        unknowns = 3 * len(meshes[element, refinements].nodes)
        seconds = _expected_seconds(answers, unknowns, len(solved.states))
        spent = time.process_time() - began
        if seconds and spent + seconds > options.most_seconds and (element, refinements) != (coarse, 0):
            left_out.append(f"{space_name(element, refinements)} ({unknowns} unknowns, about {seconds / 60:.0f} min)")
            continue
        tell(f"{space_name(element, refinements)}: {unknowns} unknowns" + (f", about {seconds:.0f} s" if seconds >= 10 else ""))
        body = body_on(robot.body, meshes[element, refinements])
        answer, states = _answer(body, (element, refinements), loads, places, patches, solved)
        if answer is None or states is None:
            left_out.append(f"{space_name(element, refinements)} (does not converge)")
            continue
        answers.append(answer)
        solved = states
    return accuracy_report(patches, coarse, loads, answers, left_out, options)


def _expected_seconds(answers: Sequence[Answer], unknowns: int, states: int) -> float:
    """Return the processor time that a space would take: direct factors of a solid grow with the square of the unknowns."""
    if not answers:
        return 0.0
    largest = max(answers, key=lambda answer: answer.unknowns)
    return STEPS * states * 1e-3 * largest.step_ms * (unknowns / largest.unknowns) ** 2


def _affordable(body: BodyModel, space: tuple[str, int], most_unknowns: int) -> bool:
    if space[1] and 3 * len(body.mesh.tets) > most_unknowns:  # each adds a node at least
        return False
    return 3 * len(finer_mesh(body.mesh, *space).nodes) <= most_unknowns


def observed_points(robot: Robot) -> FloatArray:
    """Return the points whose motion counts: features and markers at rest [m], shape (p, 3)."""
    points = np.vstack([robot.body.mesh.nodes[robot.features], robot.markers.positions(robot.body.mesh.nodes)])
    if not len(points):
        raise DataError("the robot has neither features nor markers: no motion to compare")
    return points


# Answers


def _answer(
    body: BodyModel, space: tuple[str, int], loads: Sequence[Load], places: FloatArray, patches: Patches, before: SolvedSpace
) -> tuple[Answer | None, SolvedSpace | None]:
    """Return how a space answers to the loads, and its states; None where it does not converge."""
    states = states_under(body, loads, before)
    if states is None:
        return None, None
    ties = embed_points(body.mesh, places)
    rest = ties.positions(states[0].positions)
    motions = [rest - places] if loads and loads[0].kind is LoadKind.GRAVITY else []
    motions += [ties.positions(state.positions) - rest for state in states[1:]]
    times = []
    for _ in range(2):  # the first one may have to analyse the mesh
        began = time.process_time()
        tangent = tangent_at(body, states[0])
        times.append(time.process_time() - began)
    step = 1e3 * min(times)
    carried = embed_points(body.mesh, patches.places)
    nodal = np.array([carried.spread(force, len(body.mesh.nodes)) for force in patches.forces]).reshape(
        -1, len(body.mesh.nodes), 3
    )
    moved = tangent.respond(nodal) if len(nodal) else np.zeros((0, len(body.mesh.nodes), 3))
    per_newton = np.array([ties.positions(field) for field in moved]).reshape(-1, len(places), 3)
    shape = np.array(motions).reshape(-1, len(places), 3)
    answer = Answer(*space, len(body.mesh.tets), len(body.free_map.dofs), step, shape, per_newton)
    return answer, SolvedSpace(body.mesh, states)
