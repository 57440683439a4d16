"""The quasi-static path along a recording: from recorded inputs to one equilibrium a frame.

History (friction of cables, creep) is carried from frame to frame in the order of time. Without history, frames with the
same inputs and loads share one solve.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.parallel import each
from femsense.core.work import count
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles
from femsense.fem.capstan import capstan_tensions
from femsense.fem.clamp import rigid_give
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.fem.linalg.refinement import Refined
from femsense.fem.mesh import Embedding
from femsense.model.balance import Balance
from femsense.model.drive import DrivenRobot, frame_key, has_history
from femsense.model.frame_state import require_converged, solve_frame
from femsense.model.linear_answers import AtPoints
from femsense.model.path_solver import PathSolver
from femsense.model.robot import Robot
from femsense.model.variants import Variants, most_lent, room_for_factor

TRIED = 1e-8
"""Relative tolerance of states that are only tried: below a thousandth of a millimetre, where derivatives want a tenth of it."""
PARTS, SHORTEST_PART = 4, 6
"""Parts at most in which frames are solved side by side where each starts from the one before, and frames of a part at least."""
PAST, PAST_TRIED = 1e-8, 1e-6
"""Tensions along a cable that agree so well [N], and as shares of the largest, are the same past;
the latter for states that are only tried."""


def solve_path(
    driven: DrivenRobot,
    frames: Sequence[int],
    ties: Callable[[Robot], Embedding],
    variants: Sequence[DrivenRobot] = (),
    *,
    starts: dict[int, Equilibrium] | None = None,
    answers: dict[int, AtPoints] | None = None,
    solver: PathSolver | None = None,
) -> Iterator[tuple[int, Equilibrium, FloatArray, FloatArray]]:
    """Solve frames in order, and the same frames of slightly different variants by linearisation.

    A variant's state is the linear response of the base state to the residual forces of the variant there, so that all variants together
    cost one factorisation and one solve with many right-hand sides. A variant on another mesh, or with a rigid clamp instead of a
    compliant one, is solved nonlinearly.

    Arguments:
        driven: the base.
        frames: indices, ascending; frames between them are solved too if the state depends on the history.
        ties: robot → the observed points, p of them.
        variants: other robots or drives.
        starts: frame → a state near by, such as that of an earlier path; brought up to date as frames are solved. Their
            factors are kept as long as they fit into FACTOR_MEMORY.
        answers: frame → adjoint responses of its points, from an earlier path along the same states with other variants;
            what is missing is added where the points are few.
        solver: settings of the solver.

    Yields:
        frame index, equilibrium, positions of the points [m], shape (p, 3), and those of the variants, shape (v, p, 3).
    """
    wanted, solver = sorted(set(int(f) for f in frames)), solver or PathSolver()
    past = has_history(driven.robot)
    todo = list(range(max(wanted) + 1)) if wanted and any(has_history(w.robot) for w in (driven, *variants)) else wanted
    alike = _alike(driven, todo, past)
    unique = [k for k in todo if alike[k] == k]
    bases = dict(zip(unique, _base_states(driven, unique, starts, past, solver)))
    seen = {k: ties(driven.robot).positions(bases[k].positions) for k in {alike[k]: None for k in wanted}}
    others = {k: np.zeros((len(variants), *seen[alike[k]].shape)) for k in wanted}
    lent = {k: s.factor for k, s in (starts or {}).items() if k in bases and s.positions is bases[k].positions}
    observed = Variants(driven, variants, {k: bases[alike[k]] for k in todo}, alike, others, ties, lent, answers, solver)
    room = room_for_factor(len(unique))
    for k, factor in observed.write():
        count(responses=1)
        plain = factor.plain if isinstance(factor, Refined) else factor
        if plain is not None and starts is not None and plain.bytes < most_lent(starts[k], room):
            starts[k] = replace(starts[k], factor=plain)
    for k in wanted:
        yield k, bases[alike[k]], seen[alike[k]], others[k]


def free_path(driven: DrivenRobot, frames: Sequence[int]) -> Iterator[tuple[int, Equilibrium]]:
    """Yield frames with their states under inputs and known loads alone, in order; a frame without an equilibrium is left out.

    If the robot has friction, all earlier frames are solved too, because the state depends on them.

    Arguments:
        driven: robot and drive.
        frames: indices.
    """
    wanted = sorted(set(int(k) for k in frames))
    past = has_history(driven.robot)
    state: Equilibrium | None = None
    for k in range(wanted[-1] + 1) if past and wanted else wanted:
        before = state.segment_tensions if past and state is not None else None
        found = solve_frame(driven, k, start=state, options=SolveOptions(before=before, reuse_factor=state is not None))
        if not found.converged:
            continue
        state = found
        if k in wanted:
            yield k, state


def _alike(driven: DrivenRobot, frames: list[int], past: bool) -> dict[int, int]:
    """Return for each frame the first one with the same state: the same inputs and loads, with a past the frames just before."""
    first: dict[bytes, int] = {}
    result: dict[int, int] = {}
    last = b""
    for k in frames:
        key = frame_key(driven, k)
        if past and key != last:
            first[key] = k
        result[k] = first.setdefault(key, k)
        last = key
    return result


def _base_states(
    driven: DrivenRobot,
    frames: list[int],
    starts: dict[int, Equilibrium] | None,
    past: bool,
    solver: PathSolver,
) -> Iterator[Equilibrium]:
    """Yield the states of frames, without their factors; `starts` gets them with these where they fit into memory."""
    room, solve, rough = room_for_factor(len(frames)), solver.equilibrium, solver.rough
    near = {k: state for k, state in sorted((starts or {}).items()) if _clamp_fits(driven.robot.body, state)}

    def keep(k: int, state: Equilibrium) -> Equilibrium:
        bare = replace(state, factor=None)
        if starts is not None:
            starts[k] = state if state.factor is not None and state.factor.bytes < room else bare
        return bare

    known, fits = near.keys() & set(frames), bool(near)
    if not near:
        near = {k: start for k, state in sorted((starts or {}).items()) if (start := _taken_along(driven, k, state)) is not None}
    if near:
        near.update(_nearest(driven, near, [k for k in frames if k not in near]))

    def again(k: int, before: tuple[FloatArray, ...] | None = None, start: Equilibrium | None = None) -> Equilibrium:
        start, tried = near[k] if start is None else start, rough and k in known
        tolerance = TRIED if tried else 1e-09
        options = SolveOptions(before=before, reuse_factor=True, relative_tolerance=tolerance, rough=tried, single=True)
        return _counted(solve, driven, k, start, options)

    if near:
        with contextlib.suppress(
            *(() if fits else (DataError,))
        ):  # from the previous state a body may not converge: then from rest
            states = list(_solve_with_history(driven, frames, near, again, rough) if past else each(again, frames))
            yield from (keep(k, state) for k, state in zip(frames, states))
            return

    def along(part: list[int]) -> list[Equilibrium]:
        states: list[Equilibrium] = []
        for k in part:
            last = states[-1] if states else None
            before = last.segment_tensions if past and last is not None else None
            states.append(keep(k, _counted(solve, driven, k, last, SolveOptions(before=before, single=True))))
        return states

    for states in each(along, [frames] if past else _parts(frames)):
        yield from states


def _counted(
    solve: Callable[..., Equilibrium], driven: DrivenRobot, k: int, start: Equilibrium | None, options: SolveOptions
) -> Equilibrium:
    """Return the state of a frame; the work counts as soon as it is done, also where there is no state. Raises DataError."""
    state = solve(driven, k, start=start, options=options)
    count(equilibria=1)
    return require_converged(state, k)


def _parts(frames: list[int]) -> list[list[int]]:
    """Return frames cut into parts that are solved side by side; as many wherever it runs."""
    size = max(SHORTEST_PART, -(-len(frames) // PARTS))
    return [frames[i : i + size] for i in range(0, len(frames), size)]


def _nearest(driven: DrivenRobot, near: dict[int, Equilibrium], frames: list[int]) -> dict[int, Equilibrium]:
    """Return as warm start of each frame the state of the known frame with the most similar inputs and loads."""
    drive = driven.drive
    load = np.zeros((len(drive.inputs), 3))
    np.add.at(load, drive.load_frame, drive.load_forces)
    gravity = np.zeros((len(load), 0)) if drive.gravity is None else drive.gravity
    table = np.hstack([drive.inputs, drive.pressures, gravity, load])
    table = (table - table[0]) / np.maximum(np.ptp(table, axis=0), 1e-12)
    known = list(near)
    return {k: near[known[int(np.linalg.norm(table[known] - table[k], axis=1).argmin())]] for k in frames}


def _solve_with_history(
    driven: DrivenRobot, frames: list[int], near: dict[int, Equilibrium], again: Callable[..., Equilibrium], rough: bool
) -> list[Equilibrium]:
    """Return the states of frames with a past, from states near by.

    The frames are split into parts that are solved in parallel, each from cable tensions predicted by the warm starts. Then, part
    after part, frames are solved again until the tensions at the start of a part equal those at the end of the previous one.
    """
    parts = _parts(frames)
    expected = _expected_tensions(driven, frames, near)
    assumed = [None, *(expected[part[-1]] for part in parts[:-1])]
    result: dict[int, Equilibrium] = {}
    slack = PAST_TRIED if rough else PAST

    def along(i: int) -> list[Equilibrium]:
        states, before = [], assumed[i]
        for k in parts[i]:
            states.append(again(k, before))
            before = states[-1].segment_tensions
        return states

    for i, states in enumerate(each(along, range(len(parts)))):
        before = result[parts[i - 1][-1]].segment_tensions if i else None
        result.update(zip(parts[i], states))
        last = assumed[i]
        for k in parts[i]:
            if before is None or last is None or _as_before(before, last, slack):
                break
            last, result[k] = result[k].segment_tensions, again(k, before, result[k])
            before = result[k].segment_tensions
    return [result[k] for k in frames]


def _expected_tensions(driven: DrivenRobot, frames: list[int], near: dict[int, Equilibrium]) -> dict[int, tuple[FloatArray, ...]]:
    """Return the tensions along the cables in each frame if they bend as in states near by."""
    result: dict[int, tuple[FloatArray, ...]] = {}
    held, cables = driven.drive.control == "displacement", driven.robot.body.cables
    before = tuple(np.zeros(len(c.path)) for c in cables)
    for k in frames:
        state = near[k]
        motors = [state.tension[c.name] if held else float(T) for c, T in zip(cables, driven.drive.inputs[k])]
        before = tuple(
            capstan_tensions(c, bend_angles(c, state.positions), b, max(T, 0.0)) for c, b, T in zip(cables, before, motors)
        )
        result[k] = before
    return result


def _as_before(now: tuple[FloatArray, ...], then: tuple[FloatArray, ...], slack: float) -> bool:
    """Return whether the tensions along all cables are unchanged."""
    return all(np.abs(a - b).max(initial=0.0) <= slack * max(1.0, float(a.max(initial=0.0))) for a, b in zip(now, then))


def _clamp_fits(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether a state can serve as a start as it is: one whose clamp gave way elsewhere would be torn back,
    one whose clamp has not yet would let go of the whole load at once."""
    return body.clamp_is_rigid != has_given(body, state)


def _taken_along(driven: DrivenRobot, frame: int, state: Equilibrium) -> Equilibrium | None:
    """Return a state with a rigid clamp as a start for a clamp that gives, the whole body taken along;
    None where that is no start."""
    balance = Balance(driven, frame, state)
    moved = rigid_give(driven.robot.body, state.positions, balance.whole(driven, balance.along(driven), state.positions))
    return None if moved is None else replace(state, positions=moved)


def has_given(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether the clamp has given way in a state."""
    return bool(np.abs(state.positions[body.clamped] - body.mesh.nodes[body.clamped]).max(initial=0.0) >= 1e-9)
