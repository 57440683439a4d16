"""`learn`: from readings with markers to a model, with its error on held-out data."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, spread_evenly
from femsense.core.errors import DataError, InputError
from femsense.model.marker_units import FARTHEST, doubt_of_size, span
from femsense.xr.armature import Armature, ArmatureOptions, make_armature
from femsense.xr.proprioception.bayes import train_bayesian
from femsense.xr.proprioception.domain import learn_domain
from femsense.xr.proprioception.labelled import Labelled, check_frame
from femsense.xr.proprioception.memory import longest_gap
from femsense.xr.proprioception.model import ProprioceptiveModel, bone_numbers
from femsense.xr.proprioception.network import Network
from femsense.xr.proprioception.selection import (
    MEMORIES,
    MOST_ROWS,
    Compared,
    Kind,
    Progress,
    compare_plans,
    marker_rms,
    rows_kept,
    simplest_good,
)
from femsense.xr.proprioception.spread import coverage, growth, held_out, make_spread

NEEDED = {Kind.MLP: "sklearn"}
"""Kinds that need a package of the extra `learn`."""
FEWEST_ROWS = 60
TRAINED_ROWS = 3000
"""Rows on which the chosen map is trained at most, thinned evenly."""
BONE_ROWS = 1000
"""The same for the end-to-end network."""
RESAMPLES = 1000
ERROR_BLOCKS = 12
"""Blocks in time that are drawn again and again for the interval of an error."""
CLIPPED = 0.05
"""Share of rows at one end of a channel's range beyond which the channel is reported as saturated."""
DISTINCT = 20
"""A channel with fewer distinct values is a switch, whose ends are not saturation."""


@dataclass(frozen=True, eq=False, slots=True)
class LearnOptions:
    """Options of `learn`: candidate maps and memories, and the bones."""

    kinds: tuple[Kind, ...] = tuple(Kind)
    """Maps that are tried, simple ones first."""
    memories: tuple[tuple[float, ...], ...] = MEMORIES
    """Candidate time constants [s] of filters in addition to the readings; ((),): none."""
    end_to_end: bool = False
    """Whether a second network predicts the bones directly from the readings."""
    bones: ArmatureOptions = field(default_factory=ArmatureOptions)
    """Placement of the bones along the markers."""
    rest_row: int = 0
    """Row in which the robot is at rest: the bones of the skin are placed on its markers."""
    seed: int = 0
    """Seed of the random numbers of training."""


def learn(
    data: Labelled, *, test: Labelled | None = None, options: LearnOptions | None = None, progress: Progress | None = None
) -> ProprioceptiveModel:
    """Learn a proprioceptive model: a map from the readings of sensors in the body to the positions of markers on it.

    Several kinds of map (linear, networks), memories (low-pass filters of the readings) and sets of channels are compared by their error on held-out
    blocks of time; the simplest good one is returned. Three of twenty blocks are used neither for training nor for this selection, and give the
    reported error.

    Arguments:
        data: readings and markers of one or several recordings, result of `labelled`.
        test: data of another recording, on which the error is reported in addition. Default: none.
        options: a `LearnOptions`: candidate maps, candidate memories, and the bones. Default: `LearnOptions()`.
        progress: a function, called with (steps done, number of steps).

    Returns:
        the model. `report["error_mm"]` is its root mean square marker error on the unused blocks [mm].

    Raises:
        InputError: an unknown kind of map, or `test` in other coordinates than `data`.
        DataError: too few rows, or constant readings.
    """
    options = options or LearnOptions()
    _check(data, options)
    check_frame(data.frame, data.frame if test is None else test.frame)
    held = rows_kept(len(data))
    work, kept = data.select(~held), data.select(held)
    kinds = tuple(Kind(kind) for kind in options.kinds if kind not in NEEDED or find_spec(NEEDED[kind]) is not None)
    memories = tuple(taus for taus in options.memories if data.spacing_s <= longest_gap(taus)) or ((),)
    compared = compare_plans(work, kinds, memories, seed=options.seed, progress=progress)
    trained, some = (work.select(spread_evenly(len(work), most)) for most in (TRAINED_ROWS, MOST_ROWS))
    networks = {item.plan.kind: item.plan.train(trained.inputs(item.plan.memory_s), trained.targets) for item in compared}
    plan = simplest_good(compared).plan
    network, taus = networks[plan.kind], plan.memory_s
    out = held_out(plan.train, some.inputs(taus), some.targets, some.part)
    spread = make_spread(network, trained.inputs(taus), out)
    chain = _chain(data.markers[options.rest_row], options.bones)
    bones = _bones(work, taus, chain, options.seed) if options.end_to_end and chain is not None else None
    model = ProprioceptiveModel(
        data.channels, data.marker_names, network, taus, learn_domain(work.readings), chain, bones, {}, data.frame, spread
    )
    own, inputs = errors_on(model, kept), kept.inputs(taus)
    report: dict[str, Any] = {
        "kind": plan.kind,
        **{key: own[key] for key in ("error_mm", "error_ci_mm", "marker_error_mm")},
        "rows": len(work),
        "test_rows": len(kept),
        "motion_mm": 1e3 * marker_rms(data.targets - data.targets.mean(axis=0)),
        "sessions": len(np.unique(data.part)),
        "interval": {
            "radius_mm": median_radius_mm(spread.radius(network, inputs), data.marker_names),
            "coverage": own["coverage"],
            "growth": growth(out),
        },
        "compared": {item.plan.kind: _comparison(item, networks[item.plan.kind], kept) for item in compared},
        "importance_mm": importance(network, inputs, kept.targets, data.channels, len(taus)),
        "unused": [name for name, used in zip(data.channels, plan.used) if not used],
        "dead": dead_channels(data.readings, data.channels),
        "saturated": saturated_channels(data.readings, data.channels),
        "test_outside": own["outside"],
    }
    if bones is not None and chain is not None:
        report["bones_mm"] = _bone_error(bones(inputs), chain, kept)
    if test is not None:
        report["test"] = errors_on(model, test, report["error_mm"])
    return replace(model, report=report)


def errors_on(model: ProprioceptiveModel, data: Labelled, stated_mm: float = float("nan")) -> dict[str, Any]:
    """Return the errors of a model on data that it was not made from, and whether its intervals hold there, as plain tables.

    `growth` is the error there over the stated one.
    """
    inputs = data.inputs(model.memory_s)
    errors = model.network(inputs) - data.targets
    table = {
        **error_table(errors),
        "marker_error_mm": marker_errors_mm(errors, model.marker_names),
        "rows": len(data),
        "outside": float(1.0 - model.domain.inside(data.readings).mean()),
        "growth": 1e3 * marker_rms(errors) / max(stated_mm, 1e-9),
    }
    if model.spread is not None:
        table["coverage"] = coverage(model.spread, model.network, inputs, data.targets)
    return table


def error_interval(errors: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of the root mean square distance [m] of errors, shape (n, 3 m).

    Blocks in time are resampled, because neighbouring rows are correlated (Künsch 1989).
    """
    square = (errors.reshape(len(errors), -1, 3) ** 2).sum(axis=2).mean(axis=1)
    parts = np.array_split(square, min(ERROR_BLOCKS, len(square)))
    sums, counts = np.array([part.sum() for part in parts]), np.array([len(part) for part in parts])
    drawn = np.random.default_rng(0).integers(len(parts), size=(RESAMPLES, len(parts)))
    rms = np.sqrt(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
    low, high = np.quantile(rms, [0.025, 0.975])
    return float(low), float(high)


def importance(
    network: Network, inputs: FloatArray, targets: FloatArray, channels: tuple[str, ...], filters: int
) -> dict[str, float]:
    """Return the increase of the error when a channel is replaced by itself at other times [mm], by channel.

    The channel and its filters are shifted by half the rows, which keeps their autocorrelation (permutation importance,
    Breiman 2001).
    """
    base, half, width = marker_rms(network(inputs) - targets), len(inputs) // 2, len(channels)
    grown = {}
    for i, name in enumerate(channels):
        moved = inputs.copy()
        columns = i + width * np.arange(1 + filters)
        moved[:, columns] = np.roll(inputs[:, columns], half, axis=0)
        grown[name] = 1e3 * (marker_rms(network(moved) - targets) - base)
    return grown


def dead_channels(readings: FloatArray, channels: tuple[str, ...]) -> list[str]:
    """Return the channels that never change."""
    return [name for name, x in zip(channels, readings.T) if np.ptp(x) <= 1e-12 * (1.0 + np.abs(x).max())]


def saturated_channels(readings: FloatArray, channels: tuple[str, ...]) -> list[str]:
    """Return the channels that are at an end of their range in more than the allowed share of rows."""
    found = []
    for name, x in zip(channels, readings.T):
        at_end = max((x == x.max()).mean(), (x == x.min()).mean())
        if len(np.unique(x)) > DISTINCT and at_end > CLIPPED:
            found.append(name)
    return found


def _check(data: Labelled, options: LearnOptions) -> None:
    if doubt := doubt_of_size(data.markers):
        if span(data.markers) > FARTHEST:
            raise DataError(f"{doubt}\n  try:      x_m, y_m and z_m in metres")
        warnings.warn(doubt, stacklevel=3)
    if not options.kinds or not set(options.kinds) <= set(Kind):
        raise InputError("unknown kind of map", where="kinds", found=options.kinds, expected=" | ".join(Kind))
    if len(data) < FEWEST_ROWS:
        raise DataError(
            f"{len(data)} rows have readings and all markers; at least {FEWEST_ROWS} are needed to learn and to hold some out"
        )
    if len(dead_channels(data.readings, data.channels)) == len(data.channels):
        raise DataError("no channel ever changes: " + ", ".join(data.channels))


def _comparison(item: Compared, network: Network, kept: Labelled) -> dict[str, Any]:
    """Return the report on one map: its error on rows kept from it, and on the blocks that were held out in turn."""
    return {
        **error_table(network(kept.inputs(item.plan.memory_s)) - kept.targets),
        "blocks_mm": 1e3 * item.rms,
        "median_block_mm": 1e3 * item.typical,
        "memory_s": list(item.plan.memory_s),
        "channels": int(item.plan.used.sum()),
    }


def _bones(data: Labelled, taus: tuple[float, ...], chain: Armature, seed: int) -> Network:
    """Return an end-to-end network from readings to bones."""
    some = data.select(spread_evenly(len(data), BONE_ROWS))
    wanted = np.array([bone_numbers(chain(markers)) for markers in some.markers])
    return train_bayesian(some.inputs(taus), wanted, seed=seed)


def _chain(rest: FloatArray, options: ArmatureOptions) -> Armature | None:
    apart = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    return make_armature(rest, options) if len(rest) > 1 and (apart > 0).all() else None


def error_table(errors: FloatArray) -> dict[str, Any]:
    """Return the root mean square distance of markers [mm] and its 95 % interval, of coordinates [m], shape (rows, 3 m)."""
    return {"error_mm": 1e3 * marker_rms(errors), "error_ci_mm": [1e3 * x for x in error_interval(errors)]}


def marker_errors_mm(errors: FloatArray, names: tuple[str, ...]) -> dict[str, float]:
    """Return the root mean square of each marker's distance [mm], of coordinates [m], shape (rows, 3 m)."""
    return {name: 1e3 * marker_rms(errors[:, 3 * i : 3 * i + 3]) for i, name in enumerate(names)}


def median_radius_mm(radius: FloatArray, names: tuple[str, ...]) -> dict[str, float]:
    """Return the median of each marker's radius [mm], of radii [m], shape (rows, m)."""
    return dict(zip(names, (1e3 * np.median(radius, axis=0)).tolist()))


def _bone_error(numbers: FloatArray, chain: Armature, test: Labelled) -> float:
    """Return the error of the places of bones that come straight from the readings [mm],
    against those from the measured markers."""
    places = numbers.reshape(len(test), -1, 9)[:, :, :3]
    wanted = np.array([chain(markers).positions for markers in test.markers])
    return 1e3 * marker_rms((places - wanted).reshape(len(test), -1))
