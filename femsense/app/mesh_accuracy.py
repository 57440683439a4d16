"""The discretisation error of a robot: motions and sensed forces on it against those on finer spaces of the same body.

The same loads act on the declared mesh, on quadratic elements and on a mesh with each element split into eight. Where a mesh h and its
refinement h/2 with the same element are both known, the limit of ever finer meshes is estimated by Richardson's extrapolation,

    u* = u(h/2) + (u(h/2) − u(h)) / (2^p − 1),

with p = 2, which is careful: linear elements reach it in smooth bodies, quadratic ones in bodies with inward corners. The clamp stays the
piece of the body that the declared mesh clamps, and loads are the same pieces of the surface, so that the space alone differs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.body import BodyModel
from femsense.fem.compliance import drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import Embedding, TetMesh, embed_points, surface_triangles, triangle_normals, vertex_normals
from femsense.model.contact_patch import body_surface, closest_surface_point
from femsense.model.remeshing import body_on_mesh, finer_mesh
from femsense.model.robot import Robot

ORDER = 2.0
"""p, see above."""
STEPS = 8
"""Factorisations that a state and its start take, about."""
MOST_INPUTS = 4
"""So many cables and chambers are looked at, spread over their list."""
FORCE_POINTS = 6
"""Contact forces are tried at so many features …"""
FELT = 0.05
"""… at which a force moves the rest of the body by this share of the most at least: next to the clamp nothing is sensed."""
PART_OF_LARGEST = 0.5
"""Inputs act with this part of their largest value."""
USUAL_MOTION = 0.1
"""No input moves the body by more than about this share of its diagonal."""
MOST_PILOT_UNKNOWNS = 40_000
"""Inputs are sized on quadratic elements if these have no more unknowns; linear ones move too little."""
PATCH = 0.06
"""Radius of the patch that carries a contact force, over the diagonal; one and a half edges of the surface at least."""
SPACES = (("tet4", 0), ("tet10", 0), ("tet4", 1), ("tet10", 1))
"""Element and refinements, the cheapest first."""
Progress = Callable[..., None]


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """How far finer spaces are looked at, and what is fine enough."""

    most_unknowns: int = 400_000
    """A finer space with more unknowns is not solved …"""
    most_seconds: float = 400.0
    """… nor one that would take all spaces together beyond this processor time, judged by the steps of the space before [s]."""
    good_motion: float = 0.03
    """A space is fine enough where motions are off by less than this share …"""
    good_force: float = 0.05
    """… and forces by less than this one."""


@dataclass(frozen=True, eq=False, slots=True)
class Load:
    """Something that moves the body from its rest under its own weight; the weight itself is measured from the unloaded shape."""

    kind: str
    """"gravity", "cable" or "chamber"."""
    name: str
    size: float
    unit: str


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """How one space answers."""

    element: str
    refinements: int
    tetrahedra: int
    unknowns: int
    step_ms: float
    """Processor time of assembling and factorising the stiffness once [ms]."""
    motions: FloatArray
    """Displacement of the observed points under each load [m], shape (l, p, 3)."""
    per_newton: FloatArray
    """Displacement of the observed points under each contact force [m/N], shape (k, p, 3)."""

    def is_space(self, element: str, refinements: int) -> bool:
        return (self.element, self.refinements) == (element, refinements)


@dataclass(frozen=True, eq=False, slots=True)
class Patches:
    """Contact forces that are the same on every mesh of the body."""

    centres: FloatArray  # features that they act at, (k, 3)
    places: FloatArray  # points of the surface that carry them, (q, 3)
    forces: FloatArray  # their shares of each unit force, (k, q, 3)


@dataclass(frozen=True, eq=False, slots=True)
class _Solved:
    """The states of one space, from which a finer one starts."""

    mesh: TetMesh
    states: tuple[Equilibrium, ...]  # at rest under the weight, then under each input


def expected_duration(options: AccuracyOptions | None = None) -> str:
    """Return how long `assess_accuracy` may take, in words."""
    seconds = (options or AccuracyOptions()).most_seconds
    return f"at most about {seconds / 60:.0f} minutes of processor time: finer spaces that would take longer are left out"


def assess_accuracy(robot: Robot, *, options: AccuracyOptions | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Return what the mesh of a robot costs in motion and in force, and what would be better, as plain tables.

    Arguments:
        robot: as it is declared.
        options: how far finer spaces are looked at, and what is fine enough.
        progress: called with what is being done.

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
    loads, solved = _feasible(robot.body)
    chosen = [space for space in SPACES if space == (coarse, 0) or _affordable(robot.body, space, options.most_unknowns)]
    meshes = {space: finer_mesh(robot.body.mesh, space[0], space[1]) for space in chosen}
    finest = max(meshes.values(), key=lambda mesh: len(mesh.nodes))
    patches = contact_patches(robot, finest, felt_features(robot, solved.states[0], places))
    answers: list[Answer] = []
    began = time.process_time()
    left_out = [f"{_space_name(*space)} (too many unknowns)" for space in SPACES if space not in chosen]
    for element, refinements in chosen:
        unknowns = 3 * len(meshes[element, refinements].nodes)
        seconds = _expected_seconds(answers, unknowns, len(solved.states))
        spent = time.process_time() - began
        if seconds and spent + seconds > options.most_seconds and (element, refinements) != (coarse, 0):
            left_out.append(f"{_space_name(element, refinements)} ({unknowns} unknowns, about {seconds / 60:.0f} min)")
            continue
        tell(f"{_space_name(element, refinements)}: {unknowns} unknowns" + (f", about {seconds:.0f} s" if seconds >= 10 else ""))
        body = _on(robot.body, meshes[element, refinements])
        answer, states = _answer(body, (element, refinements), loads, places, patches, solved)
        if answer is None or states is None:
            left_out.append(f"{_space_name(element, refinements)} (does not converge)")
            continue
        answers.append(answer)
        solved = states
    return _report(patches, coarse, loads, answers, left_out, options)


def _space_name(element: str, refinements: int) -> str:
    return f"{element}, split into eight" if refinements else element


def _expected_seconds(answers: Sequence[Answer], unknowns: int, states: int) -> float:
    """Return the processor time that a space would take: direct factors of a solid grow with the square of the unknowns."""
    if not answers:
        return 0.0
    largest = max(answers, key=lambda answer: answer.unknowns)
    return STEPS * states * 1e-3 * largest.step_ms * (unknowns / largest.unknowns) ** 2


def _on(body: BodyModel, mesh: TetMesh) -> BodyModel:
    return body if mesh is body.mesh else body_on_mesh(body, mesh)


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


# Loads


def _rest(body: BodyModel) -> Equilibrium:
    """Return the state under the weight alone. Raises DataError where there is none."""
    rest = solve_equilibrium(body)
    if not rest.converged:
        raise DataError(f"the declared model has no equilibrium under its own weight: {rest.status}: {rest.advice}")
    return rest


def _feasible(body: BodyModel) -> tuple[list[Load], _Solved]:
    """Return loads under which the declared model converges, and its states. Raises DataError where there are none."""
    loads, start = sized_loads(body), _Solved(body.mesh, (_rest(body),))
    for _ in range(4):
        states = _states(body, loads, start)
        if states is not None:
            return loads, _Solved(body.mesh, states)
        loads = [load if load.kind == "gravity" else replace(load, size=0.5 * load.size) for load in loads]
    raise DataError("the declared model does not converge under its cables and chambers, even by an eighth of their usual inputs")


def sized_loads(body: BodyModel) -> list[Load]:
    """Return the weight and the inputs, each a part of its largest value but no larger than moves the body a good deal.

    How far an input moves the body is taken from the stiffness at rest of quadratic elements.
    """
    chosen = _inputs(body)
    weight = [Load("gravity", "own weight", 1.0, "")] if body.gravity.any() else []
    if not chosen:
        return weight
    quadratic = finer_mesh(body.mesh, "tet10", 0)
    pilot = _on(body, quadratic) if 3 * len(quadratic.nodes) <= MOST_PILOT_UNKNOWNS else body
    rest = _rest(pilot)
    pulls = drive_rows(pilot, rest.positions)[[_row(pilot, load) for load in chosen]]
    moves = np.linalg.norm(tangent_at(pilot, rest).respond(pulls.reshape(len(chosen), -1, 3)), axis=2).max(axis=1)
    diagonal = float(np.linalg.norm(np.ptp(body.mesh.nodes, axis=0)))
    limits = [float(f"{USUAL_MOTION * diagonal / max(move, 1e-300):.2g}") for move in moves]
    loads = [replace(load, size=min(load.size, limit)) for load, limit in zip(chosen, limits)]
    return weight + loads


def _row(body: BodyModel, load: Load) -> int:
    """Return the number of an input: cables first, then chambers."""
    if load.kind == "cable":
        return body.cable_names.index(load.name)
    return len(body.cables) + body.chamber_names.index(load.name)


def _inputs(body: BodyModel) -> list[Load]:
    cables = [Load("cable", cable.name, PART_OF_LARGEST * cable.max_tension, "N") for cable in body.cables]
    chambers = [Load("chamber", chamber.name, PART_OF_LARGEST * chamber.max_pressure, "Pa") for chamber in body.chambers]
    return [(cables + chambers)[i] for i in spread_evenly(len(cables) + len(chambers), MOST_INPUTS)]


def spread_evenly(count: int, most: int) -> list[int]:
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most))}) if count else []


def _drive(load: Load) -> dict[str, Any]:
    return {"tension" if load.kind == "cable" else "pressure": {load.name: load.size}}


def felt_features(robot: Robot, rest: Equilibrium, places: FloatArray) -> IntArray:
    """Return the features that contact forces are tried at: far from each other, and such that a force there moves the body."""
    body = robot.body
    normals = vertex_normals(body.mesh.nodes, surface_triangles(body.mesh))[robot.features]
    forces = np.zeros((len(normals), len(body.mesh.nodes), 3))
    forces[np.arange(len(normals)), robot.features] = normals
    ties, radius = embed_points(body.mesh, places), _patch_radius(body)
    far = np.linalg.norm(places - body.mesh.nodes[robot.features][:, None], axis=2) > radius  # a dent is no motion
    fields = tangent_at(body, rest).respond(forces)
    moved = np.array([np.linalg.norm(ties.positions(field)[others]) for field, others in zip(fields, far)])
    return np.asarray(robot.features[moved > FELT * moved.max(initial=0.0)][:FORCE_POINTS])


def contact_patches(robot: Robot, finest: TetMesh, features: IntArray) -> Patches:
    """Return contact forces of one newton into the surface, as a cone over a patch, at some features."""
    body = robot.body
    surface, radius = body_surface(finest), _patch_radius(body)
    corners = finest.nodes[surface.triangles]
    middles, area = corners.mean(axis=1), triangle_normals(finest.nodes, surface.triangles)
    size = np.linalg.norm(area, axis=1)
    centres = body.mesh.nodes[features]
    forces = np.zeros((len(centres), len(middles), 3))
    for k, place in enumerate(centres):
        centre = closest_surface_point(surface, finest.nodes, place)
        facing = _facing(middles, area, centre, radius)
        share = size * np.maximum(1.0 - np.linalg.norm(middles - centre, axis=1) / radius, 0.0) * (area @ facing > 0.35 * size)
        forces[k] = -share[:, None] / share.sum() * facing
    used = forces.any(axis=(0, 2))
    return Patches(centres, middles[used], forces[:, used])


def _patch_radius(body: BodyModel) -> float:
    """Return the radius of the contact patch [m]."""
    return max(PATCH * float(np.linalg.norm(np.ptp(body.mesh.nodes, axis=0))), 1.5 * body_surface(body.mesh).edge)


def _facing(middles: FloatArray, area: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Return the normal of the face that has the most area around a place (at an edge a mean would belong to no face)."""
    near = np.linalg.norm(middles - centre, axis=1) < radius
    size = np.linalg.norm(area[near], axis=1)
    unit = area[near] / size[:, None]
    votes = np.where(unit @ unit.T > 0.9, size, 0.0).sum(axis=1)
    return np.asarray(unit[np.argmax(votes)])


# Answers


def _answer(
    body: BodyModel, space: tuple[str, int], loads: Sequence[Load], places: FloatArray, patches: Patches, before: _Solved
) -> tuple[Answer | None, _Solved | None]:
    """Return how a space answers to the loads, and its states; None where it does not converge."""
    states = _states(body, loads, before)
    if states is None:
        return None, None
    ties = embed_points(body.mesh, places)
    rest = ties.positions(states[0].positions)
    motions = [rest - places] if loads and loads[0].kind == "gravity" else []
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
    return answer, _Solved(body.mesh, states)


def _states(body: BodyModel, loads: Sequence[Load], before: _Solved) -> tuple[Equilibrium, ...] | None:
    ties = None if body.mesh is before.mesh else embed_points(before.mesh, body.mesh.nodes)
    drives = [{}, *(_drive(load) for load in loads if load.kind != "gravity")]
    states: list[Equilibrium] = []
    for i, drive in enumerate(drives):
        known = before.states[i] if i < len(before.states) else states[0]
        start = known if ties is None or i >= len(before.states) else _carried(known, ties)
        states.append(solve_equilibrium(body, **drive, start=start))
        if not states[-1].converged:
            return None
    return tuple(states)


def _carried(known: Equilibrium, ties: Embedding) -> Equilibrium:
    """Return a state of one space as a start in another one."""
    positions = ties.positions(known.positions)
    return replace(known, positions=positions, nodal_forces=np.zeros_like(positions), factor=None)


# The report


def _report(
    patches: Patches,
    coarse: str,
    loads: Sequence[Load],
    answers: Sequence[Answer],
    left_out: Sequence[str],
    options: AccuracyOptions,
) -> dict[str, Any]:
    declared = next(answer for answer in answers if answer.is_space(coarse, 0))
    reference = reference_of(answers)
    errors = [errors_of(answer, reference) for answer in answers]
    spaces = [_space(answer, error, answer is declared) for answer, error in zip(answers, errors)]
    own = errors[[answer is declared for answer in answers].index(True)]
    report = {
        "declared": {"element": coarse, "tetrahedra": declared.tetrahedra, "unknowns": declared.unknowns},
        "reference": reference.description | {"spaces_left_out": len(left_out), "left_out": list(left_out)},
        "loads": [_load_row(load, own, i) for i, load in enumerate(loads)],
        "forces": _force_table(own, patches, declared),
        "spaces": spaces,
    }
    report["good_enough"] = {"motion_percent": 100.0 * options.good_motion, "force_percent": 100.0 * options.good_force}
    report["advice"] = advice_on(report, options)
    return report


@dataclass(frozen=True, eq=False, slots=True)
class Reference:
    motions: FloatArray
    per_newton: FloatArray
    motion_doubt: FloatArray
    """How far the reference itself may be off [m], shape (l, p); NaN: not known."""
    description: dict[str, Any]
    answer: Answer
    is_limit: bool


def reference_of(answers: Sequence[Answer]) -> Reference:
    """Return the limit of finer meshes where two of the same element are known, else the finest quadratic answer."""
    pairs = [(a, b) for a in answers for b in answers if b.is_space("tet10", a.refinements + 1) and a.element == "tet10"]
    if pairs:
        coarse, fine = pairs[-1]
        step = 1.0 / (2.0**ORDER - 1.0)
        motions = fine.motions + step * (fine.motions - coarse.motions)
        text = f"the limit of tet10 meshes, extrapolated from {coarse.tetrahedra} and {fine.tetrahedra} tetrahedra"
        description = {"text": text, "unknowns": fine.unknowns, "extrapolated": True}
        doubt = np.linalg.norm(motions - fine.motions, axis=2)
        return Reference(motions, fine.per_newton + step * (fine.per_newton - coarse.per_newton), doubt, description, fine, True)
    fine = max(answers, key=lambda answer: (answer.element == "tet10", answer.unknowns))
    text = f"{fine.element} with {fine.tetrahedra} tetrahedra, the finest space that is affordable; its own error is not known"
    description = {"text": text, "unknowns": fine.unknowns, "extrapolated": False}
    return Reference(fine.motions, fine.per_newton, np.full(fine.motions.shape[:2], np.nan), description, fine, False)


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    known: bool
    motion: FloatArray  # largest motion under each load [m], (l,)
    largest: FloatArray  # largest error [m], (l,)
    rms: FloatArray  # [m], (l,)
    share: FloatArray  # rms error over rms motion, (l,)
    doubt: FloatArray  # largest doubt [m], (l,)
    force: FloatArray  # sensed over true force − 1, (k,)


def errors_of(answer: Answer, reference: Reference) -> Errors:
    off, true = answer.motions - reference.motions, reference.motions
    distance, moved = np.linalg.norm(off, axis=2), np.linalg.norm(true, axis=2)
    rms, size = np.sqrt((distance**2).mean(axis=1)), np.sqrt((moved**2).mean(axis=1))
    known = reference.is_limit or answer is not reference.answer
    share = np.divide(rms, size, out=np.zeros_like(rms), where=size > 0)
    return Errors(
        known,
        moved.max(axis=1),
        distance.max(axis=1),
        rms,
        share,
        reference.motion_doubt.max(axis=1),
        _force_errors(answer, reference),
    )


def _force_errors(answer: Answer, reference: Reference) -> FloatArray:
    """Return sensed force / true force − 1 at each contact, shape (k,).

    The force that a camera's points call for on a model is the one whose displacement field U comes nearest to the true field U*:
    least squares gives ⟨U, U*⟩ / ⟨U, U⟩ times the true force.
    """
    own, true = answer.per_newton, reference.per_newton
    return np.asarray((own * true).sum(axis=(1, 2)) / (own**2).sum(axis=(1, 2)) - 1.0)


def _space(answer: Answer, error: Errors, is_declared: bool) -> dict[str, Any]:
    known = error.known
    return {
        "element": answer.element,
        "refinements": answer.refinements,
        "tetrahedra": answer.tetrahedra,
        "unknowns": answer.unknowns,
        "step_ms": answer.step_ms,
        "motion_percent": 100.0 * float(error.share.max()) if known and len(error.share) else None,
        "motion_mm": 1e3 * float(error.largest.max()) if known and len(error.share) else None,
        "force_percent": 100.0 * float(np.abs(error.force).max()) if known and len(error.force) else None,
        "declared": is_declared,
    }


def _best(spaces: list[dict[str, Any]], options: AccuracyOptions) -> dict[str, Any] | None:
    """Return the cheapest space that is good enough, None where none is known to be; the spaces get a mark."""
    for space in spaces:
        known = space["motion_percent"] is not None or space["force_percent"] is not None
        space["good_enough"] = known and _lack(space, options) <= 1.0
    good = [space for space in spaces if space["good_enough"]]
    return min(good, key=lambda space: space["unknowns"]) if good else None


def _load_row(load: Load, error: Errors, i: int) -> dict[str, Any]:
    return {
        "kind": load.kind,
        "name": load.name,
        "size": load.size,
        "unit": load.unit,
        "motion_mm": 1e3 * float(error.motion[i]),
        "error_mm": 1e3 * float(error.largest[i]) if error.known else None,
        "error_rms_mm": 1e3 * float(error.rms[i]) if error.known else None,
        "error_percent": 100.0 * float(error.share[i]) if error.known else None,
        "doubt_mm": 1e3 * float(error.doubt[i]),
    }


def _force_table(error: Errors, patches: Patches, declared: Answer) -> dict[str, Any]:
    known = error.known and len(error.force) > 0
    return {
        "places_mm": 1e3 * patches.centres,
        "motion_mm_per_n": 1e3 * np.linalg.norm(declared.per_newton, axis=2).max(axis=1),
        "error_percent": [100.0 * float(value) for value in error.force] if known else None,
        "worst_percent": 100.0 * float(error.force[np.argmax(np.abs(error.force))]) if known else None,
    }


def advice_on(report: Mapping[str, Any], options: AccuracyOptions) -> str:
    """Return which space would serve, in words; the spaces of the report get a mark where they do."""
    best = _best(report["spaces"], options)
    declared = next(space for space in report["spaces"] if space["declared"])
    plain = next((space for space in report["spaces"] if space["element"] == "tet10" and not space["refinements"]), None)
    if declared["force_percent"] is None and declared["motion_percent"] is None:
        return "the declared space is the finest that is affordable here: nothing to compare it with; a coarser mesh of the same body would show its error"
    if declared["good_enough"]:
        return "the declared mesh is fine enough"
    if best is not None and not best["refinements"]:
        return f"better: {_change(best, declared)}"
    if plain is None or _lack(plain, options) == 0.0:
        return f"no space that was tried is known to be fine enough; the nearest is {_change(plain or declared, declared)}"
    factor = 1.1 * _lack(plain, options) ** 1.5
    wanted, unknowns = (int(float(f"{factor * plain[key]:.2g}")) for key in ("tetrahedra", "unknowns"))
    changes = ['element = "tet10"'] * (declared["element"] != "tet10") + [
        f"a mesh of about {wanted} tetrahedra (femsense mesh --max-tets {wanted})"
    ]
    return f"better: {' and '.join(changes)}: about {unknowns} unknowns instead of {declared['unknowns']}, judged by errors that fall with the square of the edges"


def _lack(space: Mapping[str, Any], options: AccuracyOptions) -> float:
    """Return the error of a space over what is fine enough; 0 where it is not known."""
    motion, force = space["motion_percent"] or 0.0, space["force_percent"] or 0.0
    return max(motion / (100 * options.good_motion), force / (100 * options.good_force))


def _change(space: Mapping[str, Any], declared: Mapping[str, Any]) -> str:
    element = f'element = "{space["element"]}"'
    return f"{element}: {space['unknowns']} unknowns instead of {declared['unknowns']}, {space['step_ms']:.0f} ms a Newton step instead of {declared['step_ms']:.0f} ms"


def accuracy_text(report: Mapping[str, Any]) -> str:
    """Return a report of `assess_accuracy` as tables."""
    d, good = report["declared"], report["good_enough"]
    lines = [
        f"the declared mesh: {d['element']}, {d['tetrahedra']} tetrahedra, {d['unknowns']} unknowns",
        f"compared with: {report['reference']['text']}",
    ]
    lines += ["", f"  {'load':<28}{'motion':>10}{'error':>12}{'of the motion':>15}{'doubt':>11}"]
    if not report["loads"]:
        lines.append("  none: the robot has neither weight nor cables nor chambers; forces alone are looked at")
    for row in report["loads"]:
        load = f"{row['name']} {_size(row)}".strip()
        lines.append(
            f"  {load:<28}{_mm(row['motion_mm']):>10}{_mm(row['error_mm']):>12}{_percent(row['error_percent']):>15}{_mm(row['doubt_mm']):>13}"
        )
    lines += _force_lines(report["forces"])
    lines += ["", f"  {'space':<24}{'tetrahedra':>10}{'unknowns':>10}{'ms a step':>11}{'motion':>9}{'force':>9}"]
    for space in report["spaces"]:
        name = f"{_space_name(space['element'], space['refinements'])}{' *' if space['declared'] else ''}"
        lines.append(
            f"  {name:<24}{space['tetrahedra']:>10}{space['unknowns']:>10}{space['step_ms']:>11.0f}{_percent(space['motion_percent']):>9}{_percent(space['force_percent']):>9}"
        )
    lines += [
        f"  * declared; errors are the worst of all loads and places; fine enough: {good['motion_percent']:.0f} % of motion, {good['force_percent']:.0f} % of force"
    ]
    if report["reference"]["left_out"]:
        lines.append(f"  left out: {'; '.join(report['reference']['left_out'])}")
    lines += ["", report["advice"]]
    return "\n".join(lines)


def _force_lines(forces: Mapping[str, Any]) -> list[str]:
    """Return the table of contact forces."""
    lines = ["", f"  {'force at [mm]':<28}{'moves it':>14}{'sensed force':>18}"]
    for i, place in enumerate(forces["places_mm"]):
        at = f"[{', '.join(f'{value:.0f}' for value in place)}]"
        off = "?" if forces["error_percent"] is None else f"{forces['error_percent'][i]:+.1f} %"
        lines.append(f"  {at:<28}{forces['motion_mm_per_n'][i]:>9.3g} mm/N{off:>18}")
    return [*lines, "  (+: sensed too large, the mesh is too stiff)"] if len(lines) > 2 else []


def _size(row: Mapping[str, Any]) -> str:
    if not row["unit"]:
        return ""
    return f"{row['size'] / 1e3:.3g} kPa" if row["unit"] == "Pa" else f"{row['size']:.3g} {row['unit']}"


def _mm(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.3g} mm"


def _percent(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.1f} %"
