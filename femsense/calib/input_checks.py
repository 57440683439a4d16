"""Whether the inputs of a recording can be those that moved its markers: unit, order of the columns, delay.

Of each marker only its motion about its mean counts, measured and modelled, so that neither pose nor placement matters.
Another reading of the inputs counts where it takes most of the difference away.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from femsense.calib.checks import EXPLAINED, SUSPICIOUS, Pairs
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.model.recording import Recording
from femsense.model.robot import Robot

REFUSED = 3.0
"""Motions so many times too large or small are no modulus that is off: silicones of one name differ by a factor of two."""
WARNED = 1.5
"""Motions so many times too large or small are worth a word."""
LATEST = 4
"""Frames by which inputs may be late or early."""
FEWEST = 4
"""Fewer frames tell nothing of a delay."""
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
"""One of this unit is so many of what the files hold."""


@dataclass(frozen=True, eq=False, slots=True)
class Motions:
    """Markers that one camera saw in all of some frames, about their means."""

    frames: IntArray
    """Indices of the frames, ascending, shape (f,)."""
    modelled: FloatArray
    """[m], shape (f, 3 m)."""
    measured: FloatArray
    """[m], shape (f, 3 m)."""
    spread: float
    """Of the markers [m]."""


def motions_of(pairs: Pairs) -> Motions | None:
    """Return the motions of those markers that one camera saw in all frames; None where there is no such marker,
    or one frame alone."""
    frames = np.unique(pairs.group)
    counts = np.bincount(pairs.marker)
    always = np.flatnonzero(counts == len(frames))
    if len(frames) < 2 or not len(always):
        return None
    kept = np.isin(pairs.marker, always)
    order = np.lexsort((pairs.marker[kept], pairs.group[kept]))
    modelled, measured = (x[kept][order].reshape(len(frames), -1) for x in (pairs.modelled, pairs.measured))
    return Motions(frames, modelled - modelled.mean(axis=0), measured - measured.mean(axis=0), pairs.spread)


def check_inputs(robot: Robot, recording: Recording, pairs: Sequence[Pairs]) -> None:
    """Refuse inputs in another unit, in exchanged columns, or recorded some frames off;
    warn where motions hint at another modulus.

    Arguments:
        robot, recording: as they are calibrated.
        pairs: the markers of each camera.

    Raises:
        DataError: says what was found and what it looks like.
    """
    for one in pairs:
        motions = motions_of(one)
        if motions is None or _rms(motions.measured - motions.modelled) < SUSPICIOUS * motions.spread:
            continue
        _check_order(robot, recording, motions)
        _check_delay(motions)
        _check_scale(recording, motions)


def _check_scale(recording: Recording, motions: Motions) -> None:
    own = float((motions.modelled**2).sum())
    if own <= 0.0:
        return
    scale = float((motions.modelled * motions.measured).sum()) / own
    left = _rms(motions.measured - scale * motions.modelled)
    size = abs(np.log(max(scale, 1e-9)))
    if left * EXPLAINED > max(_rms(motions.measured), _rms(motions.modelled)) or size < np.log(WARNED):
        return
    found = f"the markers move {scale:.3g} times as far as the model under these inputs"
    if size > np.log(REFUSED):
        raise DataError(f"{found}. {_units(recording, scale)}Is young_modulus_pa right?")
    warnings.warn(f"{found}: is young_modulus_pa right? femsense improve finds it", stacklevel=5)


def _units(recording: Recording, scale: float) -> str:
    """Return which units of the inputs a scale hints at, as a question; empty where it hints at none."""
    kinds = [recording.actuation] if recording.cable_names else []
    kinds += ["pressure"] if recording.chamber_names else []
    names = [name for kind in kinds for known, name in UNITS[kind].items() if abs(np.log(scale / known)) < 0.4]
    held = {"tension": "newtons", "displacement": "metres", "pressure": "pascals"}[kinds[-1]] if kinds else ""
    return f"Are the inputs in {' or '.join(names)}? The files hold {held}. " if names else ""


def _check_order(robot: Robot, recording: Recording, motions: Motions) -> None:
    """Refuse columns that stand under each other's names: to first order each input has its own motion (least squares;
    Kuhn 1955)."""
    names = (*robot.body.cable_names, *robot.body.chamber_names)
    inputs = np.hstack([recording.inputs, recording.pressures])[motions.frames]
    inputs = inputs - inputs.mean(axis=0)
    inputs = inputs / np.maximum(np.abs(inputs).max(axis=0), 1e-300)
    if len(names) < 2 or len(inputs) <= len(names) or np.linalg.cond(inputs) > 20.0:
        return
    by_input = [np.linalg.lstsq(inputs, x, rcond=None)[0] for x in (motions.measured, motions.modelled)]
    cost = ((by_input[0][:, None] - by_input[1][None]) ** 2).sum(axis=2)
    columns = linear_sum_assignment(cost)[1]
    changed = np.flatnonzero(columns != np.arange(len(names)))
    if not len(changed):
        return
    if cost[changed, columns[changed]].sum() * EXPLAINED**2 < cost[changed, changed].sum():
        text = ", ".join(f"{names[i]} moves the robot as {names[columns[i]]} should" for i in changed)
        raise DataError(f"the columns of inputs in frames.csv seem exchanged: {text}. Exchange them, or the cables in robot.toml")


def _check_delay(motions: Motions) -> None:
    """Refuse inputs that are some frames late or early. Raises DataError."""
    best, delay = np.inf, 0
    for lag in (lag for lag in range(-LATEST, LATEST + 1) if lag):
        shared = np.intersect1d(motions.frames, motions.frames + lag)
        if len(shared) < max(FEWEST, len(motions.frames) // 2):
            continue
        measured = motions.measured[np.isin(motions.frames, shared)]
        moved, plain = (motions.modelled[np.isin(motions.frames, k)] for k in (shared - lag, shared))
        left, before = (_rms(_about_mean(measured - x)) for x in (moved, plain))
        if left * EXPLAINED < before and left < best:
            best, delay = left, lag
    if delay:
        how = "late" if delay > 0 else "early"
        raise DataError(
            f"the markers are {abs(delay)} frames {how}: they follow the inputs of other frames. Are markers and inputs "
            f"on one clock?"
        )


def _about_mean(x: FloatArray) -> FloatArray:
    return np.asarray(x - x.mean(axis=0))


def _rms(x: FloatArray) -> float:
    """Return the root mean square length of places (f, 3 m)."""
    return float(np.sqrt(3.0 * (x**2).mean()))
