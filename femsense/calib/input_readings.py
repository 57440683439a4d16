"""Readings of the inputs: another unit, sign, order, delay or zero, and the gain and offset of one cable."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.marker_fit import MarkerFit
from femsense.calib.readings import Reading, first_order, share_with
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.fem.equilibrium import SolveOptions
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.marker_correction import recorded_inputs
from femsense.model.observation import Hypothesis, evaluate_scene
from femsense.model.path_solver import look_at
from femsense.model.recording import Recording
from femsense.model.recording_checks import in_frames
from femsense.model.robot import Robot

LATEST = 4
"""Frames by which inputs may be late or early."""
PERMUTED = 5
"""Of more cables than this only pairs are exchanged: all orders would be too many."""
KNOWN = 3.0
"""A gain or an offset is wrong if it lies farther from 1 or 0 than this number of standard deviations."""
ENOUGH = 4
"""Least number of frames for the gain and offset of one cable."""
UNITS = {
    "tension": {9.807: "kilogram-force", 4.448: "pounds", 1e-3: "millinewton", 0.00981: "gram-force"},
    "displacement": {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"},
    "pressure": {
        1e3: "kilopascal",
        1e5: "bar",
        6895.0: "psi",
        133.3: "millimetres of mercury",
        1e2: "millibar",
        1e6: "megapascal",
    },
}
"""Number of SI units in another unit → its name."""
SI = {"tension": "newtons", "displacement": "metres", "pressure": "pascals"}


def marker_places(robot: Robot, recording: Recording, frames: IntArray, initial: FloatArray | None) -> FloatArray | None:
    """Return where the model has the markers in some frames [m], shape (f, m, 3); None where one has no equilibrium."""
    driven, places = DrivenRobot(robot, drive_of(robot, recording, initial=initial)), []
    for k in frames.tolist():
        state = look_at(driven, k, start=None, options=SolveOptions(single=True))
        if not state.converged:
            return None
        places.append(robot.markers.positions(state.positions))
    return np.array(places)


@dataclass(frozen=True, eq=False, slots=True)
class _Columns:
    """Inputs of cables and chambers, read otherwise."""

    error: str
    table: FloatArray
    """[N] or [m], and [Pa], shape (F, a + c)."""
    advice: str = ""
    frames: IntArray | None = None
    """Frames that have such inputs, shape (f,); None: all."""


def inputs_otherwise(fit: MarkerFit) -> Iterator[Reading]:
    """Yield readings with another sign, unit, order or delay of the columns of inputs, predicted by the linear response of the markers."""
    scene, response, table = fit.scene, _response(fit), recorded_inputs(fit.scene.recording)
    names = (*fit.robot.body.cable_names, *fit.robot.body.chamber_names)
    if response is None:
        return
    every = itertools.chain(
        _units(scene.recording, table),
        _signs(names, table),
        _orders(names, len(fit.robot.body.cables), table),
        _delays(scene.frames, table),
    )
    for one in every:
        frames, recording = scene.frames if one.frames is None else one.frames, _with_inputs(scene.recording, one.table)
        drivers, rows = _drivers(recording, fit.initial, frames), np.isin(scene.frame, frames)
        changed = fit.modelled + response.by(drivers - response.drivers, fit)
        slack_before = response.places[scene.marker] + response.by(drivers - response.base, fit)
        predicted = min(share_with(fit, modelled=places, rows=rows) for places in (changed, slack_before))
        yield Reading(f"{one.error}{in_frames(recording)}", predicted, recording, frames=frames, advice=one.advice)


def _units(recording: Recording, table: FloatArray) -> Iterator[_Columns]:
    own = np.arange(table.shape[1]) < recording.inputs.shape[1]
    for kind, columns in ((recording.actuation, own), ("pressure", ~own)):
        for factor, unit in UNITS[kind].items() if table[:, columns].any() else ():
            yield _Columns(
                f"the inputs seem to be in {unit}", np.where(columns, factor, 1.0) * table, f"The files hold {SI[kind]}."
            )


def _signs(names: Sequence[str], table: FloatArray) -> Iterator[_Columns]:
    ones: list[BoolArray] = list(np.eye(len(names), dtype=bool)) if len(names) > 1 else []
    for columns in (np.ones(len(names), dtype=bool), *ones):
        if table[:, columns].any():
            which = ", ".join(name for name, turned in zip(names, columns) if turned)
            yield _Columns(f"the inputs of {which} seem to have the wrong sign (> 0 pulls)", np.where(columns, -table, table))


def _orders(names: Sequence[str], cables: int, table: FloatArray) -> Iterator[_Columns]:
    for first, count in ((0, cables), (cables, len(names) - cables)):
        for order in _permutations(count):
            columns = np.arange(len(names))
            columns[first : first + count] = first + np.array(order)
            moved = [f"{names[i]} moves the robot as {names[j]} should" for i, j in enumerate(np.argsort(columns)) if i != j]
            error = f"the columns of inputs seem exchanged: {', '.join(moved)}"
            yield _Columns(error, table[:, columns], "Exchange them, or the cables in robot.toml.")


def _permutations(count: int) -> Iterator[tuple[int, ...]]:
    """Yield the permutations of n columns except the identity; of many columns, those that exchange two."""
    own = tuple(range(count))
    for order in itertools.permutations(own) if count <= PERMUTED else ():
        if order != own:
            yield order
    for i, j in itertools.combinations(own, 2) if count > PERMUTED else ():
        yield tuple(j if k == i else i if k == j else k for k in own)


def _delays(frames: IntArray, table: FloatArray) -> Iterator[_Columns]:
    for lag in (lag for lag in range(-LATEST, LATEST + 1) if lag):
        there = frames[(frames + lag >= 0) & (frames + lag < len(table))]
        if len(there) >= max(2, len(frames) // 2) and np.ptp(table, axis=0).any():
            taken = np.clip(np.arange(len(table)) + lag, 0, len(table) - 1)
            error = (
                f"the markers are {abs(lag)} frames {'early' if lag > 0 else 'late'}, as they follow the inputs of other frames"
            )
            yield _Columns(error, table[taken], "Are markers and inputs on one clock?", there)


def zero_of_inputs(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the reading in which absolute cable inputs have another zero."""
    recording = fit.scene.recording
    if fit.initial is not None or not fit.robot.body.cables:
        return
    found = first_order(fit, _by_input(fit))
    unit, scale = _unit_of(recording)
    values = ", ".join(f"{name} {scale * z:+.2g} {unit}" for name, z in zip(fit.robot.body.cable_names, found.value))
    yield Reading(
        f"the inputs{in_frames(recording)} seem to count from another zero ({values})",
        found.share,
        replace(recording, inputs=freeze(recording.inputs + found.value)),
        advice='actuation_zero = "unknown" finds it.',
        parameters=len(found.value),
        refused=np.inf,
    )


def input_of_one_cable(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the gain and offset of each cable's known input, fitted together with a gain of all, which a wrong modulus looks like.

    With two cables, one that is too weak looks like the other one too strong: their fits decide. Standard errors alone would report errors of the model
    as a wrong input (0.985 ± 0.003 for a gain of 1 on the arm of the tests).
    """
    recording, frames = fit.scene.recording, fit.scene.frames
    moving = np.flatnonzero(np.ptp(recording.inputs[frames], axis=0) > 0.0)
    if fit.initial is not None or len(frames) < ENOUGH or not len(moving):
        return
    by_offset = _by_input(fit)
    by_gain = by_offset * recording.inputs[fit.scene.frame][:, None, :]
    unit, scale = _unit_of(recording)
    for j in moving.tolist():
        gains = [by_gain.sum(axis=2)]
        if len(moving) > 1:  # where one cable moves alone, its gain and the gain of all are one
            gains.append(by_gain[:, :, j])
        found = first_order(fit, np.stack([by_offset[:, :, j], *gains], axis=2))
        offset, offset_std, gain, gain_std = found.value[0], found.std[0], 1.0, 0.0
        if len(moving) > 1:
            gain, gain_std = 1.0 + found.value[2], found.std[2]
        if abs(offset) < KNOWN * offset_std and abs(gain - 1.0) <= KNOWN * gain_std:
            continue
        times = f"times {gain:.3g} ± {gain_std:.1g}, " if gain_std else ""
        size = f"{times}plus {scale * offset:.2g} ± {scale * offset_std:.1g} {unit}"
        inputs = recording.inputs.copy()
        inputs[:, j] = gain * inputs[:, j] + offset
        yield Reading(
            f"the input of {fit.robot.body.cable_names[j]} alone seems off ({size})",
            found.share,
            replace(recording, inputs=freeze(inputs)),
            advice="Is its sensor calibrated, the cable slack or caught?",
            parameters=2,
            refused=np.inf,
        )


def _by_input(fit: MarkerFit) -> FloatArray:
    """Return how the residual changes with an offset of each known cable input, shape (k, 3, a)."""
    jet = evaluate_scene(
        Hypothesis(fit.robot),
        fit.scene,
        np.zeros(0),
        fit.poses,
        None,
        derivative=True,
        vary_initial=True,
        pivot=fit.robot.marker_points.mean(axis=0),
        starts=dict(fit.jet.states),
    )
    return jet.by_initial


def _unit_of(recording: Recording) -> tuple[str, float]:
    """Return the unit in which inputs are reported, and how many of it an SI unit has."""
    return ("N", 1.0) if recording.actuation == "tension" else ("mm", 1e3)


def _with_inputs(recording: Recording, table: FloatArray) -> Recording:
    a = recording.inputs.shape[1]
    return replace(recording, inputs=freeze(table[:, :a]), pressures=freeze(table[:, a:]))


@dataclass(frozen=True, eq=False, slots=True)
class _Response:
    """How markers answer to inputs and pressures, to first order."""

    drivers: FloatArray
    """As recorded, shape (F, d): inputs [N] or [m], pressures [Pa]."""
    base: FloatArray
    """The drivers about which the response is taken, shape (d,)."""
    places: FloatArray
    """Where the markers are under them [m], shape (markers, 3)."""
    slope: FloatArray
    """[m per unit of each driver], shape (d, markers, 3)."""

    def by(self, change: FloatArray, fit: MarkerFit) -> FloatArray:
        """Return the displacement of the scene's markers [m], shape (k, 3), for changed drivers, shape (F, d)."""
        return np.asarray(np.einsum("kd,dki->ki", change[fit.scene.frame], self.slope[:, fit.scene.marker]))


def _drivers(recording: Recording, initial: FloatArray | None, frames: IntArray) -> FloatArray:
    """Return the drivers of the markers in each frame, shape (F, d). Cables cannot push: negative tensions are zero. If their zero is
    unknown, only changes count."""
    cables = recording.inputs
    cables = np.maximum(cables, 0.0) if initial is None else cables - cables[frames].mean(axis=0)
    return np.hstack([cables, recording.pressures])


def _response(fit: MarkerFit) -> _Response | None:
    """Return how the markers answer; None where no input changes, or a state is missing."""
    recording, initial, table, frames = fit.scene.recording, fit.initial, recorded_inputs(fit.scene.recording), fit.scene.frames
    a = recording.inputs.shape[1]
    if initial is not None:  # all cables pull, in whichever way they are read
        initial = np.maximum(initial, np.abs(table[:, :a] - table[frames, :a].mean(axis=0)).max(axis=0))
    base = table[frames].mean(axis=0) if initial is not None else np.abs(table).mean(axis=0)
    steps = 0.5 * np.ptp(table, axis=0)
    pressed = (np.arange(len(steps)) >= a) & (base + steps > table.max(axis=0))
    steps[pressed] *= -1.0  # no chamber is pressed harder than it was: it may blow up
    if not steps.any():
        return None
    moving = np.flatnonzero(steps)
    held = [base, *(base + np.diag(steps)[moving])]
    states = [_with_inputs(recording, np.broadcast_to(row, table.shape)) for row in held]
    places = [marker_places(fit.robot, state, frames[:1], initial) for state in states]
    if any(place is None for place in places):
        return None
    rest, *moved = (place[0] for place in places if place is not None)
    slope = np.zeros((len(steps), *rest.shape))
    slope[moving] = [(place - rest) / steps[j] for j, place in zip(moving.tolist(), moved)]
    about = base.copy()
    if initial is not None:
        about[:a] = 0.0  # drivers of a zero that is unknown are counted from their mean
    return _Response(_drivers(recording, initial, frames), about, rest, slope)
