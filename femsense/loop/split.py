"""Which frames are fitted and which are held out: whole sweeps, chosen before any fit."""

from __future__ import annotations

import numpy as np

from femsense.arrays import BoolArray, FloatArray, IntArray
from femsense.recording import Recording, state_key


def sweeps_of(recording: Recording, frames: IntArray) -> IntArray:
    """Return the number of the sweep that each frame belongs to, shape (f,).

    A sweep is what the column `sweep` says; without it an excursion of the inputs from their lowest level and back; where
    the inputs do not move, a run of frames under the same loads.
    """
    if recording.sweep is not None:
        labels = [recording.sweep[k] for k in frames]
        return np.unique(labels, return_inverse=True)[1] if len(set(labels)) > 1 else _runs(recording, frames)
    inputs = _drives(recording)
    moving = np.ptp(inputs, axis=0).max(initial=0.0) > 0
    return _excursions(inputs, frames) if moving else _runs(recording, frames)


def _drives(recording: Recording) -> FloatArray:
    """Return inputs and pressures in one unit, shape (F, a + c): the widest range of a pressure is that of an input."""
    width = [float(np.ptp(table, axis=0).max(initial=0.0)) for table in (recording.inputs, recording.pressures)]
    scale = width[0] / width[1] if min(width) > 0 else 1.0
    return np.hstack([recording.inputs, scale * recording.pressures])


def _excursions(inputs: FloatArray, frames: IntArray) -> IntArray:
    height = np.abs(inputs - inputs.min(axis=0)).max(axis=1)
    resting = height <= 0.05 * height.max()
    starts = resting & ~np.concatenate([[False], resting[:-1]])
    number = np.maximum(np.cumsum(starts) - 1, 0)
    return np.unique(number[frames], return_inverse=True)[1]


def _runs(recording: Recording, frames: IntArray) -> IntArray:
    keys = [state_key(recording, int(k)) for k in frames]
    change = np.array([i > 0 and keys[i] != keys[i - 1] for i in range(len(keys))], dtype=bool)
    return np.cumsum(change)


def _fresh(recording: Recording, frames: IntArray, held: BoolArray) -> bool:
    """Return whether frames that are held out have a state that none of the others has."""
    keys = [state_key(recording, int(k)) for k in frames]
    fitted = {key for key, out in zip(keys, held) if not out}
    return any(key not in fitted for key, out in zip(keys, held) if out)


def _can_be_spared(recording: Recording, frames: IntArray, held: BoolArray) -> bool:
    """Return whether frames that are held out have a state of their own, while the others drive every input as far."""
    size = np.abs(_drives(recording)[frames])
    return _fresh(recording, frames, held) and bool((size[~held].max(axis=0) >= 0.9 * size.max(axis=0)).all())


def hold_out(recording: Recording, frames: IntArray) -> tuple[IntArray, IntArray, str]:
    """Return frames to fit, frames to hold out, and how they were chosen in words.

    A quarter of the sweeps, evenly spread and the last among them; of two or three sweeps the last one; of a single sweep
    its last quarter. Where these only repeat states that are fitted, the last sweep with a state of its own that can be spared takes
    the place of the last: the others drive every input as far.
    """
    number = sweeps_of(recording, frames)
    count = int(number.max()) + 1
    if count >= 2:
        wanted = max(1, round(count / 4))
        held = np.unique(np.round(np.linspace(count - 1, 0, wanted + 1)[:-1]).astype(int))
        if not _fresh(recording, frames, np.isin(number, held)):
            swaps = [np.append(held[:-1], s) for s in range(count - 1, -1, -1) if s not in held]
            held = next((h for h in swaps if _can_be_spared(recording, frames, np.isin(number, h))), held)
        mask = np.isin(number, held)
        return frames[~mask], frames[mask], f"{len(held)} of {count} sweeps"
    split = max(1, round(0.75 * len(frames)))
    return frames[:split], frames[split:], "the last quarter of the frames (one sweep only)"
