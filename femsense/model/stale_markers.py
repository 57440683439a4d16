"""Rows of markers that cannot be places: far from all others, where they were before, or where another one is.

Noise never repeats a place to the last digit.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import BoolArray, IntArray, rows_alike
from femsense.model.recording import Recording, with_marker_table

CHANCE = 0.05
"""Expected number of rows that repeat by chance, above which copies are kept."""
FAR = 2.0
"""A marker farther than this many body diagonals from the others is an error."""
SHOWN = 6
"""Rows that a warning names."""


def without_far_markers(recording: Recording, size: float) -> Recording:
    """Return the recording without rows that lie more than FAR bodies from the median of their frame, and warn of them.

    Where that are more than a fifth of the rows, they are something else (another unit), and all are kept.

    Arguments:
        recording: whose rows are checked; frames with fewer than four markers tell nothing.
        size: diagonal of the body with its markers [m].
    """
    r = recording
    far = np.zeros(len(r.marker_frame), dtype=np.bool_)
    for rows in rows_alike(r.marker_frame, r.marker_view):
        if len(rows) >= 4:
            far[rows] = np.linalg.norm(r.marker_xyz[rows] - np.median(r.marker_xyz[rows], axis=0), axis=1) > FAR * size
    if not far.any() or far.mean() > 0.2:
        return recording
    _warn(r, far, f"more than {1e3 * FAR * size:.0f} mm from the others; outliers, left out")
    return _kept(r, ~far)


def without_stale_markers(recording: Recording) -> Recording:
    """Return the recording without rows that repeat the frame before to the last digit, and warn of them.

    A row counts as such a copy where its marker moves in other frames, where others of its frame move or the inputs changed,
    and where digits are fine enough that chance explains none: p³ n < CHANCE,
    with p the share of single coordinates that repeat among n pairs of rows.

    Arguments:
        recording: whose rows are checked; a marker's rows in frames that follow each other are compared.
    """
    r = recording
    keys = np.column_stack([r.marker_frame, r.marker_index, r.marker_view])
    order = np.lexsort((keys[:, 0], keys[:, 1], keys[:, 2]))
    key, same = keys[order][1:], np.diff(r.marker_xyz[order], axis=0) == 0
    follows = (np.diff(keys[order][:, 0]) == 1) & (np.diff(keys[order][:, 1:], axis=0) == 0).all(axis=1)
    copies = follows & same.all(axis=1)
    moving = follows & ~copies
    if not copies.any() or not moving.any() or float(same[moving].mean()) ** 3 * int(follows.sum()) > CHANCE:
        return recording
    should_move = _shared(key[:, [0, 2]], moving) | _driven(r)[key[:, 0]]
    repeats = copies & should_move & _shared(key[:, [1, 2]], moving)
    for i in np.flatnonzero(copies & ~repeats):
        repeats[i] = i > 0 and repeats[i - 1]  # the copy of a copy
    stale = np.zeros(len(keys), dtype=np.bool_)
    stale[order[1:]] = repeats
    if not stale.any():
        return recording
    _warn(r, stale, "to the last digit where it was in the frame before, as of a lost marker; left out")
    return _kept(r, ~stale)


def without_twins(recording: Recording) -> Recording:
    """Return the recording without rows of one frame that stand at the same place to the last digit, and warn of them:
    one of their names is wrong, or none of them was seen.

    Arguments:
        recording: whose rows are checked.
    """
    r = recording
    keys = np.column_stack([r.marker_frame, r.marker_view, r.marker_xyz])
    _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    twins = np.asarray(count[group.ravel()] > 1)
    if not twins.any():
        return recording
    _warn(r, twins, "at the same place as another marker of the frame; left out")
    return _kept(r, ~twins)


def _warn(r: Recording, bad: BoolArray, what: str) -> None:
    """Warn about removed rows."""
    rows = [f"{r.marker_names[m]} in frame {r.frame_numbers[f]}" for f, m in zip(r.marker_frame[bad], r.marker_index[bad])]
    text = ", ".join(rows[:SHOWN]) + (f" and {len(rows) - SHOWN} more" if len(rows) > SHOWN else "")
    where = r.folder / "markers.csv" if r.folder else "markers"
    warnings.warn(f"{where}: {what}: {text}", stacklevel=5)


def _driven(r: Recording) -> BoolArray:
    """Return in which frames other inputs act than in the frame before, shape (F,)."""
    inputs = np.hstack([r.inputs, r.pressures])
    changed = (np.abs(np.diff(inputs, axis=0)) > 1e-3 * np.ptp(inputs, axis=0)).any(axis=1)
    return np.concatenate([[False], changed])


def _shared(groups: IntArray, chosen: BoolArray) -> BoolArray:
    """Return which rows (k, 2) have a chosen row in their group, shape (k,)."""
    _, group = np.unique(groups, axis=0, return_inverse=True)
    return np.asarray((np.bincount(group.ravel(), chosen) > 0)[group.ravel()])


def _kept(r: Recording, kept: BoolArray) -> Recording:
    """Return the recording with some of its rows of named markers."""
    names: Sequence[str] = r.marker_names
    return with_marker_table(r, names, r.marker_frame[kept], r.marker_index[kept], r.marker_xyz[kept], view=r.marker_view[kept])
