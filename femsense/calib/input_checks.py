"""Whether the inputs of a recording can be in the unit that is declared: how far they move the markers.

Of each marker only its motion about its mean counts, measured and modelled, so that neither pose nor placement matters.
Another unit counts where it takes most of the difference away.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.checks import EXPLAINED, SUSPICIOUS, Pairs
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.model.recording import Recording

REFUSED = 3.0
"""Ratio of measured and modelled motion that no wrong modulus explains: silicones of one name differ by a factor of two."""
WARNED = 1.5
"""Ratio of measured and modelled motion above which a warning is raised."""
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
    """Return the motions of the markers that one camera saw in all frames; None without such markers, or with a single frame."""
    frames = np.unique(pairs.group)
    counts = np.bincount(pairs.marker)
    always = np.flatnonzero(counts == len(frames))
    if len(frames) < 2 or not len(always):
        return None
    kept = np.isin(pairs.marker, always)
    order = np.lexsort((pairs.marker[kept], pairs.group[kept]))
    modelled, measured = (x[kept][order].reshape(len(frames), -1) for x in (pairs.modelled, pairs.measured))
    return Motions(frames, modelled - modelled.mean(axis=0), measured - measured.mean(axis=0), pairs.spread)


def check_inputs(recording: Recording, pairs: Sequence[Pairs]) -> None:
    """Refuse inputs in another unit; warn if the motions suggest another modulus.

    Arguments:
        recording: to be calibrated.
        pairs: the markers of each camera.

    Raises:
        DataError: says what was found and what it looks like.
    """
    for one in pairs:
        motions = motions_of(one)
        if motions is None or _rms(motions.measured - motions.modelled) < SUSPICIOUS * motions.spread:
            continue
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


def _rms(x: FloatArray) -> float:
    """Return the root mean square length of places (f, 3 m)."""
    return float(np.sqrt(3.0 * (x**2).mean()))
