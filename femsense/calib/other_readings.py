"""Alternative readings of the files: inputs with another sign, order or delay, another direction of gravity, another modulus.

Each reading is screened with free poses and all else fixed: inputs by the linear response of the markers, gravity, whose effect can be
large, by the equilibria of a few frames. The best one is then fitted like the files themselves and judged by its residual. Another zero
of the inputs and another modulus have parameters of their own; they are only mentioned.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.checks import SUSPICIOUS, Pairs, rigid_rms
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.fem.equilibrium import SolveOptions
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.observation import Scene
from femsense.model.path_solver import look_at
from femsense.model.recording import Recording
from femsense.model.recording_checks import in_frames
from femsense.model.robot import Robot

TOLD = 1.5
"""Another reading is worth a word where it divides the residual by this. The finger of the rig under gravity along x: 1.8."""
REFUSED = 2.0
"""… and the files are refused where it divides it by this. Gravity up: 2.3 on the finger, 2.4 on the arm; signs, order and
delay of inputs: 8 and more."""
LATEST = 4
"""Frames by which inputs may be late or early."""
PERMUTED = 5
"""Of more cables than this only pairs are exchanged: all orders would be too many."""
FEW = 3
"""Frames by which directions of gravity are weighed."""

MODULI = (0.4, 0.63, 1.6, 2.5)
"""Other moduli, as shares of the declared one. Without them, an arm declared 1.67 times too stiff was refused because of another
direction of gravity."""

Refit = Callable[[Robot, Recording, IntArray], FloatArray]
"""Returns the residual of a fit of a robot to frames of a recording [m], shape (k, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """An alternative reading of the same files."""

    text: str
    """The error in the files if this reading is right."""
    robot: Robot
    recording: Recording
    frames: IntArray
    """The frames that it applies to, shape (f,)."""
    fitted: bool = False
    """Whether it has fitted parameters. These can absorb model error, so files are never refused because of it."""


@dataclass(frozen=True, eq=False, slots=True)
class Response:
    """How markers answer to inputs and pressures, to first order."""

    drivers: FloatArray
    """As recorded, shape (F, d): inputs [N] or [m], pressures [Pa]."""
    base: FloatArray
    """The drivers about which the response is taken, shape (d,)."""
    places: FloatArray
    """Where the markers are under them [m], shape (markers, 3)."""
    slope: FloatArray
    """[m per unit of each driver], shape (d, markers, 3)."""

    def by(self, change: FloatArray, scene: Scene) -> FloatArray:
        """Return the displacement of the scene's markers [m], shape (k, 3), for changed drivers, shape (F, d)."""
        return np.asarray(np.einsum("kd,dki->ki", change[scene.frame], self.slope[:, scene.marker]))


def check_other_readings(
    robot: Robot, scene: Scene, pairs: Sequence[Pairs], initial: FloatArray | None, residual: FloatArray, refit: Refit
) -> float:
    """Refuse files that fit far better under an alternative reading; warn of those that fit better.

    Return the rms residual of the reported reading [m]; infinite without one.

    Arguments:
        robot: the robot.
        scene: the markers that were fitted.
        pairs: their places, one item a camera, rows in the order of the scene's.
        initial: fitted initial inputs [N] or [m], shape (a,); None where they are known.
        residual: of the fit [m], shape (k, 3).
        refit: fits another reading.

    Raises:
        DataError: states the error in the files if the better reading is right.
    """
    if all(_rms(residual[scene.view == v]) < SUSPICIOUS * one.spread for v, one in enumerate(pairs) if len(one.marker)):
        return np.inf
    shares = [*_by_inputs(robot, scene, pairs, initial), *_by_body(robot, scene, pairs, initial)]
    share, best = min(shares, key=lambda one: one[0], default=(1.0, None))
    if best is None or share * TOLD > 1.0:
        return np.inf
    try:
        left = _rms(refit(best.robot, best.recording, best.frames))
    except DataError:
        return np.inf
    before = _rms(residual[np.isin(scene.frame, best.frames)])
    found = f"{best.text}: the markers then fit to {1e3 * left:.3g} mm instead of {1e3 * before:.3g} mm"
    if before > REFUSED * left and not best.fitted:
        raise DataError(found)
    if before <= TOLD * left:
        return np.inf
    warnings.warn(f"{found}. Is it so?", stacklevel=5)
    return left


def readings(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    """Yield alternative readings of a recording whose columns are in the robot's order.

    Arguments:
        robot, recording: as they stand.
        frames: indices of the frames that are fitted, shape (f,).
    """
    yield from _of_inputs(robot, recording, frames)
    yield from _gravities(robot, recording, frames)


def _of_inputs(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    yield from _signs(robot, recording, frames)
    yield from _orders(robot, recording, frames)
    yield from _delays(robot, recording, frames)


def _by_inputs(robot: Robot, scene: Scene, pairs: Sequence[Pairs], initial: FloatArray | None) -> Iterator[tuple[float, Reading]]:
    """Yield alternative readings of the inputs with their residual to first order, as a fraction of the current one."""
    response = _response(robot, scene, initial)
    if response is None:
        return
    frames, recording = scene.frames, scene.recording
    modelled = np.zeros((len(scene.frame), 3))
    for v, one in enumerate(pairs):
        modelled[scene.view == v] = one.modelled
    for reading in _of_inputs(robot, recording, frames):
        rows, drivers = np.isin(scene.frame, reading.frames), _drivers(reading.recording, initial, reading.frames)
        changed = modelled + response.by(drivers - response.drivers, scene)
        anew = response.places[scene.marker] + response.by(drivers - response.base, scene)  # where a state is slack, as read now
        yield min(_share(pairs, scene, rows, places - modelled) for places in (changed, anew)), reading
    if initial is None and robot.body.cables:
        yield _by_zero(robot, scene, pairs, response, modelled)


def _by_zero(
    robot: Robot, scene: Scene, pairs: Sequence[Pairs], response: Response, modelled: FloatArray
) -> tuple[float, Reading]:
    """Return the residual with another zero of the cable inputs, to first order, as a fraction of the current one."""
    measured, recording, a = np.zeros_like(modelled), scene.recording, len(robot.body.cables)
    columns = [response.slope[:a, scene.marker].transpose(1, 2, 0)]
    for v, one in enumerate(pairs):
        measured[scene.view == v] = one.measured
        mine = (scene.view == v)[:, None, None]
        arm = modelled - modelled.mean(axis=0)
        turned = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
        columns += [mine * turned, mine * np.broadcast_to(np.eye(3), (len(arm), 3, 3))]
    J = np.concatenate(columns, axis=2).reshape(measured.size, -1)
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    zero = (np.linalg.lstsq(J / size, (measured - modelled).ravel(), rcond=1e-3)[0] / size)[:a]
    unit, scale = ("N", 1.0) if recording.actuation == "tension" else ("mm", 1e3)
    values = ", ".join(f"{name} {scale * z:+.2g} {unit}" for name, z in zip(robot.body.cable_names, zero))
    text = f'the inputs{in_frames(recording)} seem to count from another zero ({values}). actuation_zero = "unknown" finds it'
    shifted = replace(recording, inputs=freeze(recording.inputs + zero))
    change = np.zeros_like(response.drivers)
    change[:, :a] = zero
    share = _share(pairs, scene, np.ones(len(modelled), dtype=np.bool_), response.by(change, scene))
    return share, Reading(text, robot, shifted, scene.frames, fitted=True)


def _by_body(robot: Robot, scene: Scene, pairs: Sequence[Pairs], initial: FloatArray | None) -> Iterator[tuple[float, Reading]]:
    """Yield other directions of gravity and other moduli with their residual in a few frames, as a fraction of the current one."""
    few = scene.frames[np.unique(np.linspace(0, len(scene.frames) - 1, FEW).round().astype(int))]
    rows = np.isin(scene.frame, few)
    now = _states(robot, scene.recording, few, initial) if rows.any() else None
    others = itertools.chain(_gravities(robot, scene.recording, scene.frames), _moduli(robot, scene.recording, scene.frames))
    for reading in others if now is not None else ():
        other = _states(reading.robot, reading.recording, few, initial)
        if other is None or now is None:
            continue
        shift = np.zeros((len(scene.frame), 3))
        shift[rows] = [other[f][m] - now[f][m] for f, m in zip(scene.frame[rows].tolist(), scene.marker[rows].tolist())]
        yield _share(pairs, scene, rows, shift), reading


def _states(robot: Robot, recording: Recording, frames: IntArray, initial: FloatArray | None) -> dict[int, FloatArray] | None:
    """Return where the markers are in some frames [m], shape (markers, 3) each; None where a state is missing."""
    driven, found = DrivenRobot(robot, drive_of(robot, recording, initial=initial)), dict[int, FloatArray]()
    for k in frames.tolist():
        state = look_at(driven, k, start=None, options=SolveOptions(single=True))
        if not state.converged:
            return None
        found[k] = robot.markers.positions(state.positions)
    return found


def _signs(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    names, table = _inputs(robot, recording)
    ones = [[j] for j in range(len(names))] if len(names) > 1 else []
    for columns in [list(range(len(names))), *ones]:
        turned = table.copy()
        turned[:, columns] *= -1.0
        if columns and turned[:, columns].any():
            text = f"the inputs of {', '.join(names[j] for j in columns)}{in_frames(recording)} seem to have the wrong sign (> 0 pulls)"
            yield Reading(text, robot, _with_inputs(recording, turned), frames)


def _orders(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    names, table = _inputs(robot, recording)
    a = len(robot.body.cables)
    for first, count in ((0, a), (a, len(names) - a)):
        for order in _permutations(count):
            columns = np.arange(len(names))
            columns[first : first + count] = first + np.array(order)
            moved = [f"{names[i]} moves the robot as {names[j]} should" for i, j in enumerate(np.argsort(columns)) if i != j]
            text = f"the columns of inputs{in_frames(recording)} seem exchanged: {', '.join(moved)}. Exchange them, or the cables in robot.toml"
            yield Reading(text, robot, _with_inputs(recording, table[:, columns]), frames)


def _permutations(count: int) -> Iterator[tuple[int, ...]]:
    """Yield the permutations of n columns except the identity."""
    own = tuple(range(count))
    if count <= PERMUTED:
        yield from (order for order in itertools.permutations(own) if order != own)
        return
    for i, j in itertools.combinations(own, 2):
        yield tuple(j if k == i else i if k == j else k for k in own)


def _delays(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    _, table = _inputs(robot, recording)
    for lag in (lag for lag in range(-LATEST, LATEST + 1) if lag):
        there = frames[(frames + lag >= 0) & (frames + lag < len(table))]
        if len(there) < max(2, len(frames) // 2) or not np.ptp(table, axis=0).any():
            continue
        how = "early" if lag > 0 else "late"
        text = (
            f"the markers are {abs(lag)} frames {how}: they follow the inputs of other frames. Are markers and inputs on "
            f"one clock?"
        )
        taken = np.clip(np.arange(len(table)) + lag, 0, len(table) - 1)
        yield Reading(text, robot, _with_inputs(recording, table[taken]), there)


def _gravities(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    own, size = robot.body.gravity, float(np.linalg.norm(robot.body.gravity))
    if recording.gravity is not None:
        text = f"the gravity{in_frames(recording)} seems to have the wrong sign (an accelerometer at rest shows it upwards)"
        yield Reading(text, robot, replace(recording, gravity=freeze(-recording.gravity)), frames)
        return
    for j, sign in itertools.product(range(3) if size else (), (1.0, -1.0)):
        other = sign * size * np.eye(3)[j]
        if float(other @ own) < 0.9 * size**2:
            text = (
                f"gravity seems to point along {'-' if sign < 0 else '+'}{'xyz'[j]} of the robot, not as gravity.vector_m_s2 says"
            )
            yield Reading(text, replace(robot, body=robot.body.with_gravity(other)), recording, frames)


def _moduli(robot: Robot, recording: Recording, frames: IntArray) -> Iterator[Reading]:
    """Yield other moduli: a robot that is too soft or too stiff is no reason to refuse its files."""
    for scale in MODULI:
        body = robot.body.with_stiffness_scale(scale)
        text = f"the body seems to have about {scale:g} times its declared modulus. femsense improve finds it"
        yield Reading(text, replace(robot, body=body), recording, frames, fitted=True)


def _inputs(robot: Robot, recording: Recording) -> tuple[tuple[str, ...], FloatArray]:
    """Return the names of cables and chambers, and their recorded inputs, shape (F, a + c)."""
    return (*robot.body.cable_names, *robot.body.chamber_names), np.hstack([recording.inputs, recording.pressures])


def _with_inputs(recording: Recording, table: FloatArray) -> Recording:
    a = recording.inputs.shape[1]
    return replace(recording, inputs=freeze(table[:, :a]), pressures=freeze(table[:, a:]))


def _drivers(recording: Recording, initial: FloatArray | None, frames: IntArray) -> FloatArray:
    """Return the drivers of the markers in each frame, shape (F, d). Cables cannot push: negative tensions are zero. If their zero is
    unknown, only changes count."""
    cables = recording.inputs
    cables = np.maximum(cables, 0.0) if initial is None else cables - cables[frames].mean(axis=0)
    return np.hstack([cables, recording.pressures])


def _response(robot: Robot, scene: Scene, initial: FloatArray | None) -> Response | None:
    """Return how the markers answer; None where a state is missing."""
    recording, k = scene.recording, int(scene.frames[0])
    _, table = _inputs(robot, recording)
    a = recording.inputs.shape[1]
    if initial is not None:  # all cables pull, in whichever way they are read
        initial = np.maximum(initial, np.abs(table[:, :a] - table[scene.frames, :a].mean(axis=0)).max(axis=0))
    base = table[scene.frames].mean(axis=0) if initial is not None else np.abs(table).mean(axis=0)
    steps = 0.5 * np.ptp(table, axis=0)
    pressed = (np.arange(len(steps)) >= a) & (base + steps > table.max(axis=0))
    steps[pressed] *= -1.0  # no chamber is pressed harder than it was: it may blow up

    def places(at: FloatArray) -> FloatArray | None:
        held = _with_inputs(recording, np.broadcast_to(at, table.shape))
        found = _states(robot, held, np.array([k]), initial)
        return None if found is None else found[k]

    rest = places(base)
    slope = np.zeros((len(steps), len(robot.marker_names), 3))
    for j in np.flatnonzero(steps):
        moved = places(base + steps * (np.arange(len(steps)) == j))
        if moved is None or rest is None:
            return None
        slope[j] = (moved - rest) / steps[j]
    if rest is None:
        return None
    drivers = _drivers(recording, initial, scene.frames)
    about = base.copy()
    if initial is not None:
        about[:a] = 0.0  # drivers of a zero that is unknown are counted from their mean
    return Response(drivers, about, rest, slope)


def _share(pairs: Sequence[Pairs], scene: Scene, rows: BoolArray, shift: FloatArray) -> float:
    """Return the residual of some rows with displaced model markers [m], shape (k, 3), as a fraction of the current one."""
    return _left(pairs, scene.view, rows, shift) / max(_left(pairs, scene.view, rows, 0.0 * shift), 1e-300)


def _left(pairs: Sequence[Pairs], view: IntArray, rows: BoolArray, shift: FloatArray) -> float:
    squares = 0.0
    for v, one in enumerate(pairs):
        mine = rows[view == v]
        if mine.any():
            squares += mine.sum() * rigid_rms((one.modelled + shift[view == v])[mine], one.measured[mine]) ** 2
    return float(np.sqrt(squares / max(rows.sum(), 1)))


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt((residual**2).sum(axis=1).mean())) if len(residual) else 0.0
