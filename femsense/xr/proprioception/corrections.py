"""Corrections of a model for another day, from simple to complex:

    channel:   y' = f(x − o eᵢ)       one channel i has an offset o (both are estimated)
    base:      y' = R y + t           the base has moved relative to the camera
    zeros:     y' = f(x − o)          all channels have offsets (prior: a tenth of the channel's spread)
    line:      y' = f(x) + C z + d    an additional linear map of the readings
    afresh:    y' = C z + d           a linear map of the labelled frames alone

Each is fitted to some blocks of labelled frames and tested on the others. A more complex one is chosen only if its improvement on
the test blocks is significant at the 5 % level. The linear maps, with and without the model, differ in their penalties only: among them the
smallest mean distance decides. (The mean square is that of the few frames in which a map extrapolates: over 15 pairs of days of a real arm
the maps that it selected had errors up to 1.47 times as large as the best one, and those of the mean distance 1.21 times.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.rigid import fit_rigid
from femsense.core.arrays import BoolArray, FloatArray, IntArray, spread_evenly
from femsense.core.errors import DataError
from femsense.core.pose import make_pose, transform_points
from femsense.xr.proprioception.linear import train_ridge
from femsense.xr.proprioception.network import Network, Units
from femsense.xr.proprioception.selection import folds, marker_rms
from femsense.xr.proprioception.spread import HeldOut, errors_of, marker_distances

BLOCKS = 8
"""Number of blocks of labelled frames that are held out in turn. With four, one of them lacked information that a correction needs: on a day of a real arm,
40 frames then selected a correction with twice the error of learning afresh."""
BETTER = 0.9
"""Largest ratio of the error of an accepted correction to that without it, on held-out frames."""
RESAMPLES = 1000
RESAMPLED = 12
"""Number of blocks in time for the bootstrap, because neighbouring frames are correlated."""
ZERO_STD = 0.1
"""Of a sensor's zero, in spreads of its channel."""
ZERO_STEPS = 5
"""States at which the zeros of all sensors are judged, at most: the fit is nearly linear."""
SCANNED = 12
"""Shifts of a channel that are tried, over its range to either side, before the best is refined."""
SCAN_ROWS = 200
REFINED = 3
AFRESH = "afresh"
LINES = tuple(f"base, line {x}" for x in (0.01, 0.1, 1.0))
MAPS_AFRESH = tuple(f"{AFRESH} {x}" for x in (1.0, 0.1, 0.01, 1e-4))
SIMPLE = ("none", "channel", "base", "channel, base", "zeros", "base, zeros")
"""From simple to less simple."""
LINEAR = (*LINES, *MAPS_AFRESH)
CORRECTIONS = (*SIMPLE, *LINEAR)


@dataclass(frozen=True, slots=True)
class Shift:
    """A constant offset of one channel."""

    channel: int
    by: float
    """Offset in the unit of the channel; > 0: its readings are too high."""


@dataclass(frozen=True, eq=False, slots=True)
class Frames:
    """Labelled frames with the network's inputs."""

    network: Network
    inputs: FloatArray
    """Readings and their filters, shape (n, d)."""
    targets: FloatArray
    """Coordinates of markers [m], shape (n, 3 m)."""
    reach: FloatArray
    """How far each channel ranged when the model was learnt, shape (c,)."""

    def select(self, rows: BoolArray | IntArray) -> Frames:
        """Return some of the frames."""
        return replace(self, inputs=self.inputs[rows], targets=self.targets[rows])

    def errors(self, name: str) -> FloatArray:
        """Return the errors of a correction on blocks in time that it was not fitted to [m], shape (n, 3 m)."""
        return np.concatenate([network(other.inputs) - other.targets for network, _, other in self._in_turn(name)])

    def held_out(self, name: str) -> HeldOut:
        """Return the same errors with the predictive variance of the corrected networks."""
        parts = enumerate(self._in_turn(name))
        found = (errors_of(network, known.inputs, other.inputs, other.targets, group=k) for k, (network, known, other) in parts)
        return HeldOut.joined(list(found))

    def _in_turn(self, name: str) -> Iterator[tuple[Network, Frames, Frames]]:
        """Yield the network with a correction, the frames that it was fitted to, and a block in time of others."""
        for held in folds(len(self.targets), BLOCKS):
            known = self.select(~held)
            yield corrected(known, name), known, self.select(held)


def explain(frames: Frames) -> tuple[str, dict[str, FloatArray]]:
    """Return the correction that explains labelled frames, and the errors of each on frames it was not fitted to [m], shape (n, 3 m)."""
    errors = {name: frames.errors(name) for name in CORRECTIONS}
    chosen = SIMPLE[0]
    for name in (*SIMPLE[1:], min(LINEAR, key=lambda name: float(marker_distances(errors[name]).mean()))):
        if is_better(errors[name], errors[chosen]):
            chosen = name
    return chosen, errors


def is_better(errors: FloatArray, than: FloatArray) -> bool:
    """Whether errors are smaller than others of the same frames, shape (n, 3 m), by a tenth of the mean distance, and not by chance.

    Parts in time are drawn again and again (Künsch 1989), the same of both; in 95 of 100 drawings they have to be smaller.
    """
    if marker_distances(errors).mean() >= BETTER * marker_distances(than).mean():
        return False
    gained = (marker_distances(than) - marker_distances(errors)).sum(axis=1)
    parts = np.array([part.sum() for part in np.array_split(gained, min(RESAMPLED, len(gained)))])
    drawn = np.random.default_rng(0).integers(len(parts), size=(RESAMPLES, len(parts)))
    return bool(np.quantile(parts[drawn].sum(axis=1), 0.05) > 0.0)


def corrected(frames: Frames, name: str) -> Network:
    """Return the network with one of the `CORRECTIONS`, fitted to frames."""
    now, steps = frames, [part.strip() for part in name.split(",")]
    for step in steps:
        if step == "channel":
            found = shift_of(now, moved="base" in steps)
            now = replace(now, network=_with_shift(now.network, found, len(now.reach)))
        else:
            now = replace(now, network=_step(now, step))
    return now.network


def shift_of(frames: Frames, *, moved: bool = False) -> Shift:
    """Return the channel and the shift with which the model fits frames best, the first result of `shifts_of`."""
    return shifts_of(frames, moved=moved)[0]


def shifts_of(frames: Frames, *, moved: bool = False) -> tuple[Shift, ...]:
    """Return the offset of one channel that fits the frames best, then those of other channels that fit equally well.

    The offset of each channel is scanned over its range; the best three are refined.

    moved: whether the base may have moved too; a rigid motion is then fitted for each offset that is tried.
    """
    from scipy.optimize import minimize_scalar

    some = frames.select(spread_evenly(len(frames.inputs), SCAN_ROWS))
    shares = np.linspace(-1.0, 1.0, 2 * SCANNED + 1)
    scans = [(*min((_left(some, Shift(i, s * wide), moved), s * wide) for s in shares), i) for i, wide in enumerate(frames.reach)]
    found = []
    for _, start, i in sorted(scans)[:REFINED]:
        half = frames.reach[i] / SCANNED
        if half > 0:
            near = minimize_scalar(
                lambda by, i=i: _left(some, Shift(i, by), moved),
                bounds=(start - half, start + half),
                method="bounded",
                options={"xatol": 1e-3 * half},
            )
            found.append((float(near.fun), Shift(i, float(near.x))))
    shifts = [shift for _, shift in sorted(found, key=lambda item: item[0])] or [Shift(0, 0.0)]
    best, *others = (_errors_without(some, shift, moved) for shift in shifts)
    return (shifts[0], *(shift for shift, errors in zip(shifts[1:], others) if not is_better(best, errors)))


def rigid_motion(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rigid motion from the predicted to the measured markers of all rows, shape (4, 4)."""
    a, b = after.reshape(-1, 3), before.reshape(-1, 3)
    try:
        return fit_rigid(a, b)
    except DataError:  # all on a line: only a translation is determined
        return make_pose(np.eye(3), (a - b).mean(axis=0))


def _step(frames: Frames, step: str) -> Network:
    network, inputs, targets = frames.network, frames.inputs, frames.targets
    if step == "base":
        T, points = rigid_motion(network(inputs), targets), targets.shape[1] // 3
        turned = np.asarray(np.kron(np.eye(points), T[:3, :3]), dtype=np.float64)
        return network.followed_by(turned, np.tile(T[:3, 3], points))
    if step == "zeros":
        return _with_zeros(network, inputs, targets)
    if step.startswith(AFRESH):
        return train_ridge(inputs, targets, penalty=float(step.split()[1]))
    if step.startswith("line"):
        left = train_ridge(network.normalised(inputs), targets - network(inputs), penalty=float(step.split()[1]))
        C = left.C * left.scale
        return network.with_linear(C, left.d - C @ left.centre)
    return network


def _with_shift(network: Network, shift: Shift, channels: int) -> Network:
    """Return the network for readings of which one channel, and its filters, read too much."""
    centre = network.centre.copy()
    centre[shift.channel :: channels] += shift.by
    return replace(network, centre=centre)


def _errors_without(frames: Frames, shift: Shift, moved: bool) -> FloatArray:
    """Return the errors with an offset of one channel and a motion of the base [m], shape (n, 3 m)."""
    predicted = _with_shift(frames.network, shift, len(frames.reach))(frames.inputs)
    T = rigid_motion(predicted, frames.targets) if moved else np.eye(4)
    return np.asarray(transform_points(T, predicted.reshape(-1, 3)).reshape(predicted.shape) - frames.targets)


def _left(frames: Frames, shift: Shift, moved: bool) -> float:
    return marker_rms(_errors_without(frames, shift, moved))


def _with_zeros(network: Network, inputs: FloatArray, targets: FloatArray) -> Network:
    """Return the network whose sensors have other zeros: the likeliest with a prior."""
    from scipy.optimize import least_squares

    noise = max(marker_rms(network(inputs) - targets) / 10.0, 1e-6)
    spread = np.divide(1.0, network.scale, out=np.zeros_like(network.scale), where=network.scale > 0)
    if network.units == Units.RADIAL:
        spread = spread * np.median(np.abs(network.normalised(inputs)))

    def residuals(shares: FloatArray) -> FloatArray:
        left = (network(inputs - shares * spread) - targets) / noise
        return np.concatenate([left.ravel(), shares / ZERO_STD])

    shares = least_squares(residuals, np.zeros(len(spread)), max_nfev=ZERO_STEPS).x
    return replace(network, centre=network.centre + shares * spread)
