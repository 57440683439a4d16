"""Which frames are fitted and which are held out: whole sweeps, chosen before any fit."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.model.recording import Recording, state_key


def sweeps_of(recording: Recording, frames: IntArray) -> IntArray:
    """Return the number of the sweep of each frame, shape (f,). Labelled sweeps are numbered in the order of their names, so that the order of recording
    does not matter; others in the order of time.

    A sweep is given by the column `sweep`; without it, an excursion of the inputs from their lowest level and back; if the
    inputs do not move, a run of frames under the same loads.
    """
    if recording.sweep is not None:
        labels = [recording.sweep[k] for k in frames]
        return np.unique(labels, return_inverse=True)[1] if len(set(labels)) > 1 else _runs(recording, frames)
    inputs = _drives(recording)
    moving = np.ptp(inputs, axis=0).max(initial=0.0) > 0
    return _excursions(inputs, frames) if moving else _runs(recording, frames)


def _drives(recording: Recording) -> FloatArray:
    """Return inputs and pressures in one unit, shape (F, a + c): pressures are scaled so that their widest range equals that of the inputs."""
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
    """Return whether the held-out frames contain a state that no fitted frame has."""
    keys = [state_key(recording, int(k)) for k in frames]
    fitted = {key for key, out in zip(keys, held) if not out}
    return any(key not in fitted for key, out in zip(keys, held) if out)


def _can_be_spared(recording: Recording, frames: IntArray, held: BoolArray) -> bool:
    """Return whether the remaining frames reach at least 90 % of each input and of the load, and all directions of gravity."""
    size = np.hstack([np.abs(_drives(recording)), _loads(recording)[:, None]])[frames]
    if (size[~held].max(axis=0, initial=0.0) < 0.9 * size.max(axis=0)).any():
        return False
    if recording.gravity is None:
        return True
    down = recording.gravity[frames]
    return len(np.unique(down[~held], axis=0)) == len(np.unique(down, axis=0))


def _loads(recording: Recording) -> FloatArray:
    """Return the sum of the magnitudes of the known loads of each frame [N], shape (F,)."""
    weights = np.linalg.norm(recording.load_forces, axis=1)
    return np.bincount(recording.load_frame, weights=weights, minlength=recording.frame_count).astype(float)


def hold_out(recording: Recording, frames: IntArray) -> tuple[IntArray, IntArray, str]:
    """Return the frames to fit, the frames to hold out, and the choice in words.

    A quarter of the sweeps is held out, evenly spread and including the last; of two or three sweeps the last one; of a single sweep
    its last quarter. The fitted frames must reach at least 90 % of each input and load and all directions of gravity, and the held-out frames
    must contain a state that is not fitted. Otherwise other sweeps take their places, the evenly spread ones first, then from the last
    one on. If no sweep can be spared, a quarter of the frames of each is held out.
    """
    number = sweeps_of(recording, frames)
    count = int(number.max()) + 1
    if count == 1:
        split = max(1, round(0.75 * len(frames)))
        return frames[:split], frames[split:], "the last quarter of the frames (one sweep only)"
    wanted = max(1, round(count / 4))
    even = np.unique(np.round(np.linspace(count - 1, 0, wanted + 1)[:-1]).astype(int))
    held = _spared(recording, frames, number, even)
    if held is None:
        mask, held = _spared_within(recording, frames, number), even
        if mask.any():
            return frames[~mask], frames[mask], f"{mask.sum()} of {len(frames)} frames (each sweep has inputs that no other has)"
    mask = np.isin(number, held)
    return frames[~mask], frames[mask], f"{len(held)} of {count} sweeps"


def _spared(recording: Recording, frames: IntArray, number: IntArray, even: IntArray) -> IntArray | None:
    """Return the sweeps to hold out: `even` if they can be spared and are new, else as many others that are. None if no sweep can be spared."""

    def fits(sweeps: list[int]) -> bool:
        return _can_be_spared(recording, frames, np.isin(number, sweeps))

    def fresh(sweeps: list[int]) -> bool:
        return _fresh(recording, frames, np.isin(number, sweeps))

    order = [*even[::-1].tolist(), *(s for s in range(int(number.max()), -1, -1) if s not in even)]
    if fresh(even.tolist()) and fits(even.tolist()):
        return even
    chosen = list[int]()
    for sweep in order:
        if len(chosen) < len(even) and fresh([sweep]) and fits([*chosen, sweep]):
            chosen.append(sweep)
    if not any(fits([sweep]) for sweep in order):
        return None
    return np.array(sorted(chosen)) if chosen else even


def _spared_within(recording: Recording, frames: IntArray, number: IntArray) -> BoolArray:
    """Return which frames are held out if no sweep can be spared, shape (f,): a quarter of each sweep, evenly spread over the frames that can be
    spared, then those with the largest inputs."""
    held, height = np.zeros(len(frames), dtype=bool), np.abs(_drives(recording)[frames]).sum(axis=1)
    for sweep in range(int(number.max()) + 1):
        own = np.flatnonzero(number == sweep)
        ones = [i for i in own if _can_be_spared(recording, frames, held | (np.arange(len(frames)) == i))]
        most = min(round(len(own) / 4), len(ones))
        spread = [ones[j] for j in np.round(np.linspace(0, len(ones) - 1, most + 2)[1:-1]).astype(int)]
        for i in [*spread, *sorted(ones, key=lambda i: -height[i])]:
            trial = held | (np.arange(len(frames)) == i)
            if trial[own].sum() <= most and _can_be_spared(recording, frames, trial):
                held = trial
    return held
