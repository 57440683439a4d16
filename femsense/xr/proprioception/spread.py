"""Uncertainty of a predicted marker: an interval for each pose.

The map is linear in its last layer, with features f(x) = (φ(z), z, 1), so its predictive variance is that of Bayesian linear
regression (Bishop 2006, section 3.3.2; for networks the Laplace approximation of the last layer):

    s²(x) = 1 + κ fᵀ (FᵀF / n + λ I)⁻¹ f / p

F are the p features of the n training rows. The leverage term multiplied by κ averages 1 over those rows; it does not decrease with n,
because consecutive rows and repeated motions carry the same information. κ maximises the likelihood of errors on held-out blocks of time.
The interval of a marker has the radius q s(x), where q is the 95 % quantile of |error| / s(x) on such blocks. Blocks at the
end, predicted from earlier ones, contain the drift of a session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.xr.proprioception.network import Network

LEVEL = 0.95
REGULAR = 1e-3
"""λ, relative to the mean square of a feature."""
KAPPAS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
PARTS = 6
"""Parts in time of a recording."""
BETWEEN = -1
FIRST_END = 3
"""Parts from this one on are predicted from those before them, too."""


@dataclass(frozen=True, eq=False, slots=True)
class Spread:
    """Parameters of the radius of an interval."""

    root: FloatArray
    """L⁻¹ of p (FᵀF / n + λ I) = L Lᵀ, shape (p, p)."""
    kappa: float
    """κ: weight of the leverage of an input in the predictive variance [1]."""
    quantile: FloatArray
    """q of each marker [m], shape (m,)."""

    def share_within(self, held: HeldOut) -> float:
        """Return the share of marker positions on held-out rows that lie within their intervals."""
        return float((held.distance <= held.size(self.kappa) * self.quantile).mean())

    def radius(self, network: Network, inputs: FloatArray) -> FloatArray:
        """Return the radius of the 95 % interval of each marker [m], shape (n, m), of inputs of the network, shape (n, d)."""
        return np.asarray(np.sqrt(1.0 + self.kappa * leverage(self.root, network, inputs))[:, None] * self.quantile)


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """Errors of maps on rows that they were not trained on, with their own predictive variance."""

    distance: FloatArray
    """Of each marker [m], shape (n, m)."""
    leverage: FloatArray
    """fᵀ (FᵀF / n + λ I)⁻¹ f / p, shape (n,)."""
    group: IntArray
    """`BETWEEN` where rows before and after were trained on; else which of the groups that come later, or from another recording,
    shape (n,)."""

    def size(self, kappa: float) -> FloatArray:
        """Return s(x) of each row, shape (n, 1)."""
        return np.asarray(np.sqrt(1.0 + kappa * self.leverage)[:, None])

    def pick(self, which: BoolArray) -> HeldOut:
        """Return some of the rows."""
        return HeldOut(self.distance[which], self.leverage[which], self.group[which])

    @classmethod
    def joined(cls, parts: Sequence[HeldOut]) -> HeldOut:
        """Return the rows of several."""
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in ("distance", "leverage", "group")))


def splits(part: IntArray) -> Iterator[tuple[BoolArray, BoolArray, int]]:
    """Yield (trained on, predicted, group): each recording from the others if there are several, else blocks in time, and those
    at the end from earlier ones.

    Arguments:
        part: number of the recording of each row, in order of time, shape (n,).
    """
    recordings = np.unique(part)
    if len(recordings) > 1:
        for one in recordings:
            yield part != one, part == one, int(one)
        return
    block = np.arange(len(part)) * PARTS // len(part)
    for k in range(PARTS):
        yield block != k, block == k, BETWEEN
    for k in range(FIRST_END, PARTS):
        yield block < k, block == k, 0


def held_out(
    train: Callable[[FloatArray, FloatArray], Network], inputs: FloatArray, targets: FloatArray, part: IntArray
) -> HeldOut:
    """Return the cross-validation errors of a training function, over the splits into training and held-out rows of `splits`.

    Arguments:
        train: returns the map of inputs (k, d) to coordinates (k, 3 m).
        inputs, targets, part: inputs, marker coordinates and recording of all rows, in order of time.
    """
    found: list[HeldOut] = []
    for trained, predicted, group in splits(part):
        network = train(inputs[trained], targets[trained])
        found.append(errors_of(network, inputs[trained], inputs[predicted], targets[predicted], group=group))
    return HeldOut.joined(found)


def errors_of(network: Network, trained: FloatArray, inputs: FloatArray, targets: FloatArray, *, group: int) -> HeldOut:
    """Return the errors of a network, trained on inputs (k, d), on other rows, inputs (n, d) and targets (n, 3 m)."""
    own = leverage(root_of(network, trained), network, inputs)
    return HeldOut(marker_distances(network(inputs) - targets), own, np.full(len(own), group))


def make_spread(network: Network, inputs: FloatArray, held: HeldOut) -> Spread:
    """Return the spread of a network that was trained on inputs (n, d), from errors of its kind on held-out rows.

    Of q over all held-out rows and over each group that comes later or from another recording the largest holds.
    """
    kappa = likeliest_kappa(held)
    groups = [held, *(held.pick(held.group == g) for g in np.unique(held.group) if g != BETWEEN)]
    quantiles = [_quantile(one.distance / one.size(kappa)) for one in groups]
    return Spread(freeze(root_of(network, inputs)), kappa, freeze(np.max(quantiles, axis=0)))


def _quantile(values: FloatArray) -> FloatArray:
    """Return the bound of each column, shape (m,), below which a further value lies with a probability of at least `LEVEL`.

    Of n values it is the ⌈(n + 1) LEVEL⌉-th, at most the largest (split conformal prediction; Lei et al. 2018, Distribution-free
    predictive inference for regression).
    """
    rank = min(int(np.ceil((len(values) + 1) * LEVEL)), len(values))
    return np.asarray(np.sort(values, axis=0)[rank - 1])


def likeliest_kappa(held: HeldOut) -> float:
    """Return κ: errors are normal with variance σ² (1 + κ · leverage), σ² profiled out."""
    square = (held.distance**2).mean(axis=1)

    def unlikely(kappa: float) -> float:
        variance = 1.0 + kappa * held.leverage
        return float(np.log(max((square / variance).mean(), 1e-300)) + np.log(variance).mean())

    return min(KAPPAS, key=unlikely)


def growth(held: HeldOut) -> float:
    """Return the ratio of the error on blocks at the end to that on blocks between others; 1 without both."""
    later = held.group != BETWEEN
    if later.all() or not later.any():
        return 1.0
    end, between = (float(np.sqrt((held.distance[which] ** 2).mean())) for which in (later, ~later))
    return end / max(between, 1e-12)


def coverage(spread: Spread, network: Network, inputs: FloatArray, targets: FloatArray) -> float:
    """Return the share of marker positions within their intervals."""
    return float((marker_distances(network(inputs) - targets) <= spread.radius(network, inputs)).mean())


def marker_distances(errors: FloatArray) -> FloatArray:
    """Return the distance of each marker [m], shape (n, m), of errors of coordinates, shape (n, 3 m)."""
    return np.asarray(np.linalg.norm(errors.reshape(len(errors), -1, 3), axis=2))


def features(network: Network, inputs: FloatArray) -> FloatArray:
    """Return (φ(z), z, 1), shape (n, p)."""
    z = network.normalised(inputs)
    parts: Sequence[FloatArray] = (network.hidden(z), z, np.ones((len(z), 1)))
    return np.hstack(parts)


def root_of(network: Network, inputs: FloatArray) -> FloatArray:
    """Return L⁻¹ of p (FᵀF / n + λ I) = L Lᵀ of the rows that a network was trained on."""
    F = features(network, inputs)
    usual = float((F**2).mean())
    lower = np.linalg.cholesky(F.shape[1] * (F.T @ F / len(F) + REGULAR * usual * np.eye(F.shape[1])))
    return np.asarray(np.linalg.inv(lower))


def leverage(root: FloatArray, network: Network, inputs: FloatArray) -> FloatArray:
    """Return fᵀ (FᵀF / n + λ I)⁻¹ f / p of inputs, shape (n,)."""
    return np.asarray(((features(network, inputs) @ root.T) ** 2).sum(axis=1))
