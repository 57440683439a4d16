"""Model selection on held-out blocks of time.

Consecutive rows are nearly equal, so a row held out at random does not test the next excursion.
Six blocks in time are held out in turn; blocks spread over the rest of the recording
are reserved for the reported error (70 / 15 / 15 %).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import product

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, rms, spread_evenly
from femsense.xr.proprioception.bayes import train_bayesian
from femsense.xr.proprioception.labelled import Labelled
from femsense.xr.proprioception.linear import train_radial, train_ridge
from femsense.xr.proprioception.network import Network, Units

FOLDS = 6
TEST_BLOCKS, TEST_EVERY, TEST_FIRST = 20, 7, 3
"""Three blocks of twenty are for the stated error."""
MOST_ROWS = 600
"""Rows on which maps are compared; thinned evenly, since neighbours are nearly the same."""
GAIN = 0.05
"""Relative fall of the held-out error that a less simple map, or a channel, must bring."""
MEMORIES: tuple[tuple[float, ...], ...] = ((), (0.1,), (0.3,), (1.0,), (0.3, 1.0, 3.0))
PENALTIES = (1e-6, 1e-4, 1e-3, 1e-2)
LENGTHS, NOISES = (1.0, 2.0), (1e-3, 1e-2)
MLP_UNITS, MLP_MEMBERS = 10, 5
"""Units of each small network, and how many networks make a committee."""
MLP_DECAY = 1.0
"""Weight decay, as scikit-learn counts it."""
Progress = Callable[[int, int], None]
"""Called with (steps done, all steps)."""


class Kind(StrEnum):
    """Maps, in the order of simplicity."""

    RIDGE = "ridge"
    RADIAL = "radial"
    NETWORK = "network"
    """The paper's."""
    MLP = "mlp"


Trainer = Callable[[FloatArray, FloatArray], Network]
"""Returns the map of inputs, shape (n, d), to outputs, shape (n, o)."""
CHEAP: dict[Kind, tuple[Trainer, ...]] = {
    Kind.RIDGE: tuple(partial(train_ridge, penalty=penalty) for penalty in PENALTIES),
    Kind.RADIAL: tuple(
        partial(train_radial, penalty=PENALTIES[1], length=length, noise=noise) for length, noise in product(LENGTHS, NOISES)
    ),
}
"""Maps that cost little: memory and channels are chosen with them."""


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """One map before it is trained."""

    kind: Kind
    memory_s: tuple[float, ...]
    used: BoolArray
    """Channels that it takes, shape (c,)."""
    trainer: Trainer
    """Trains it, with its own penalty, length, noise or seed, on the inputs that it uses."""

    def train(self, inputs: FloatArray, targets: FloatArray) -> Network:
        """Return the map, trained on inputs with filters, shape (n, (1 + k) c); it takes all of them, also those it does not use."""
        columns = np.tile(self.used, 1 + len(self.memory_s))
        return _widened(self.trainer(inputs[:, columns], targets), columns)


@dataclass(frozen=True, eq=False, slots=True)
class Compared:
    """A map and its error on the blocks that were held out in turn."""

    plan: Plan
    rms: float
    """Root mean square distance over all markers [m]."""
    typical: float
    """The same of the median block [m]."""


def rows_kept(count: int) -> BoolArray:
    """Return which of `count` rows are kept for the stated error, shape (count,)."""
    block = np.arange(count) * TEST_BLOCKS // max(count, 1)
    return np.asarray(block % TEST_EVERY == TEST_FIRST)


def folds(count: int, number: int = FOLDS) -> Iterator[BoolArray]:
    """Yield which rows are held out, one of `number` blocks in time after the other, shape (count,)."""
    block = np.arange(count) * number // max(count, 1)
    for held in range(number):
        yield block == held


def compare_plans(
    data: Labelled,
    kinds: tuple[Kind, ...],
    memories: tuple[tuple[float, ...], ...],
    *,
    seed: int,
    progress: Progress | None = None,
) -> list[Compared]:
    """Return the best map of each kind, in the order of `kinds`, each with its error on held-out blocks.

    Memory and channels are chosen with ridge and radial maps, which cost little; the networks follow their choice.
    """
    rows = spread_evenly(len(data), MOST_ROWS)
    targets = data.targets[rows]
    inputs = {taus: data.inputs(taus)[rows] for taus in ((), *memories)}
    everything = np.ones(len(data.channels), dtype=bool)
    sets = {tuple(used): used for used in (everything, _needed(inputs[()], targets))}
    best: dict[Kind, Compared] = {}
    pairs = list(product(memories, sets.values()))
    for done, (taus, used) in enumerate(pairs):
        if progress is not None:
            progress(done, len(pairs))
        for kind in [kind for kind in CHEAP if kind in kinds] or [Kind.RIDGE]:
            for trainer in CHEAP[kind]:
                _keep(best, compare_plan(Plan(kind, taus, used, trainer), inputs[taus], targets))
    leader = min(best.values(), key=lambda item: item.rms).plan
    networks = {Kind.NETWORK: partial(train_bayesian, seed=seed), Kind.MLP: partial(train_mlp, seed=seed)}
    jobs = list(product((kind for kind in kinds if kind in networks), dict.fromkeys((leader.memory_s, ()))))
    for done, (kind, taus) in enumerate(jobs):
        if progress is not None:
            progress(done, len(jobs))
        _keep(best, compare_plan(Plan(kind, taus, leader.used, networks[kind]), inputs[taus], targets))
    return [best[kind] for kind in kinds if kind in best]


def simplest_good(found: list[Compared]) -> Compared:
    """Return the first map that no later one betters by more than `GAIN`; the list is in the order of simplicity."""
    chosen = found[0]
    for other in found[1:]:
        if other.rms < (1.0 - GAIN) * chosen.rms:
            chosen = other
    return chosen


def compare_plan(plan: Plan, inputs: FloatArray, targets: FloatArray) -> Compared:
    """Return a map's error on blocks that were held out in turn."""
    blocks = []
    for held in folds(len(targets)):
        blocks.append(marker_rms(plan.train(inputs[~held], targets[~held])(inputs[held]) - targets[held]))
    return Compared(plan, float(np.sqrt(np.mean(np.square(blocks)))), float(np.median(blocks)))


def train_mlp(x: FloatArray, y: FloatArray, *, seed: int) -> Network:
    """Return the mean of a committee of small networks on the residual of ridge, as one network.

    Each has `MLP_UNITS` rectified units, as many as the paper's, and other initial weights; scikit-learn trains it (L-BFGS). The error of a single
    one varies by half with its initial weights.
    """
    from sklearn.neural_network import MLPRegressor

    line = train_ridge(x, y, penalty=PENALTIES[1])
    z, left = line.normalised(x), y - line(x)
    size = max(float(left.std()), 1e-12)
    members = [
        MLPRegressor(hidden_layer_sizes=(MLP_UNITS,), solver="lbfgs", alpha=MLP_DECAY, max_iter=300, random_state=seed + i)
        for i in range(MLP_MEMBERS)
    ]
    with warnings.catch_warnings():  # with few steps it usually has not converged; held-out blocks decide
        warnings.simplefilter("ignore")
        for member in members:
            member.fit(z, left / size if left.shape[1] > 1 else left[:, 0] / size)
    first, b = (np.concatenate([getattr(m, name)[0].T for m in members]) for name in ("coefs_", "intercepts_"))
    second = np.concatenate([m.coefs_[1].T.reshape(y.shape[1], -1) for m in members], axis=1)
    d = np.mean([m.intercepts_[1] for m in members], axis=0)
    share = size / MLP_MEMBERS
    return Network(Units.RELU, line.centre, line.scale, first, b, share * second, line.C, line.d + size * d)


def marker_rms(errors: FloatArray) -> float:
    """Return the root mean square distance of markers [m] of errors, shape (n, 3 m)."""
    return rms(errors.reshape(len(errors), -1, 3))


def _keep(best: dict[Kind, Compared], found: Compared) -> None:
    """Keep the better one of a kind; a memory or another set of channels must bring `GAIN`."""
    before = best.get(found.plan.kind)
    if before is None:
        best[found.plan.kind] = found
        return
    alike = before.plan.memory_s == found.plan.memory_s and (before.plan.used == found.plan.used).all()
    if found.rms < (1.0 if alike else 1.0 - GAIN) * before.rms:
        best[found.plan.kind] = found


def _needed(x: FloatArray, targets: FloatArray) -> BoolArray:
    """Return the channels with which held-out blocks are predicted best: all but those that go, or those that come, one by one.

    Arguments:
        x: readings, shape (n, c).
        targets: coordinates [m], shape (n, o).
    """

    def error(used: BoolArray) -> float:
        return compare_plan(Plan(Kind.RIDGE, (), used, partial(train_ridge, penalty=PENALTIES[1])), x, targets).rms

    starts = (np.ones(x.shape[1], dtype=bool), np.zeros(x.shape[1], dtype=bool))
    return min((_one_by_one(used, error) for used in starts), key=error)


def _one_by_one(used: BoolArray, error: Callable[[BoolArray], float]) -> BoolArray:
    """Return the best channels on the way from all to one, or from one to all, when each time the best change of one is made."""
    towards = not used.all()
    best, least = used, error(used) if used.any() else np.inf
    while (trials := [used ^ (np.arange(len(used)) == i) for i in np.flatnonzero(used != towards)]) and trials[0].any():
        errors = [error(trial) for trial in trials]
        used = trials[int(np.argmin(errors))]
        if min(errors) < (1.0 - GAIN) * least:
            best, least = used, min(errors)
    return best


def _widened(network: Network, columns: BoolArray) -> Network:
    """Return a network that takes all inputs and looks at some."""
    if columns.all():
        return network
    wide = len(columns)
    centre, scale = np.zeros(wide), np.zeros(wide)
    centre[columns], scale[columns] = network.centre, network.scale
    B, C = np.zeros((len(network.B), wide)), np.zeros((len(network.d), wide))
    B[:, columns], C[:, columns] = network.B, network.C
    return Network(network.units, centre, scale, B, network.b, network.A, C, network.d)
