"""Another day: does a model still hold, has the base moved, or has the map changed? And a correction from a few labelled frames.

    base:   y' = R y + t            the same robot, seen from elsewhere
    zeros:  y' = f(x − o)           sensors with other zeros (their prior: a tenth of the channel's spread)
    line:   y' = f(x) + C z + d     what else a linear map of the readings can say

Each correction is fitted to some blocks of the labelled frames and judged on the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.rigid import fit_rigid
from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import DataError
from femsense.core.pose import make_pose
from femsense.xr.proprioception.domain import Domain
from femsense.xr.proprioception.labelled import Labelled, check_frame
from femsense.xr.proprioception.linear import train_ridge
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.network import Network
from femsense.xr.proprioception.selection import marker_rms

AS_BEFORE = 1.5
"""Times the error that was stated at which a model still holds."""
BLOCKS = 4
FEWEST = 8
"""Labelled frames for a correction."""
BETTER = 0.9
"""Times the error without it that a correction must reach on frames it was not fitted to."""
ZERO_STD = 0.1
"""Of a sensor's zero, in spreads of its channel."""
ZERO_STEPS = 3
CORRECTIONS = ("none", "base", "zeros", "base, zeros", "base, line 0.01", "base, line 0.1", "base, line 1.0")


@dataclass(frozen=True, eq=False, slots=True)
class Drift:
    """What became of a model on other data."""

    verdict: str
    """"holds", "base moved", "map changed", or "base moved and map changed"."""
    stated_mm: float
    """The error of the model on the data that it is from."""
    error_mm: float
    """On these."""
    rigid_mm: float
    """After a rigid motion, on frames that it was not fitted to."""
    shift_mm: float
    """How far the middle of the markers moves by it."""
    turn_deg: float
    outside: float
    """Share of the rows with a channel outside what was learnt."""
    channels: dict[str, float]
    """Of those channels, the share of rows in which each is outside."""

    @property
    def text(self) -> str:
        """Two lines for people."""
        lines = [f"{self.verdict}: {self.error_mm:.2f} mm here, {self.stated_mm:.2f} mm when it was learnt"]
        if self.verdict != "holds":
            lines.append(f"a rigid motion of {self.shift_mm:.2f} mm and {self.turn_deg:.2f}° leaves {self.rigid_mm:.2f} mm")
        if self.outside > 0.0:
            named = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in self.channels.items())
            lines.append(f"outside what was learnt in {100 * self.outside:.0f} % of the rows: {named}")
        return "\n".join(lines)


def drift(model: ProprioceptiveModel, data: Labelled) -> Drift:
    """Say whether a model still holds on other data, shape and order of channels and markers as it knows them.

    Raises:
        DataError: fewer than 8 rows.
    """
    inputs, targets = model_inputs(model, data), data.targets
    stated, before = float(model.report.get("error_mm", 0.0)), 1e3 * marker_rms(model.network(inputs) - targets)
    rigid = 1e3 * _judged(model, "base", inputs, targets)
    T = _rigid(model.network(inputs), targets)
    middle = model.network(inputs).reshape(-1, 3).mean(axis=0)
    shift = 1e3 * float(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
    turn = float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))
    inside = model.domain.inside(data.readings)
    names = [item.channel for row in data.readings[~inside] for item in model.check(row)]
    counts = {name: names.count(name) / len(data) for name in dict.fromkeys(names)}
    shares = dict(sorted(counts.items(), key=lambda item: -item[1]))
    return Drift(_verdict(stated, before, rigid), stated, before, rigid, shift, turn, float(1.0 - inside.mean()), shares)


def adapt(model: ProprioceptiveModel, few: Labelled) -> ProprioceptiveModel:
    """Return the model corrected by a few labelled frames of another day.

    Of no correction, a rigid motion, other zeros of the sensors, both, or a linear map beside the motion, the one is taken that
    predicts frames best that it was not fitted to; the report says which, and its error there.

    Raises:
        DataError: fewer than 8 rows.
    """
    inputs, targets = model_inputs(model, few), few.targets
    errors = {name: _judged(model, name, inputs, targets) for name in CORRECTIONS}
    chosen = "none"
    for name in CORRECTIONS[1:]:
        if errors[name] < BETTER * errors[chosen]:
            chosen = name
    network = _corrected(model.network, chosen, inputs, targets)
    report = {
        **model.report,
        "adapted": {"by": chosen, "rows": len(few), "error_mm": 1e3 * errors[chosen], "before_mm": 1e3 * errors["none"]},
    }
    return replace(model, network=network, bones=None, domain=_wider(model.domain, few.readings), report=report)


def model_inputs(model: ProprioceptiveModel, data: Labelled) -> FloatArray:
    """Return the inputs of a model's networks for labelled data. Raises InputError, DataError where channels, markers or frames differ."""
    same = (data.channels, data.marker_names) == (model.channels, model.marker_names)
    if not same:
        raise DataError(
            f"other channels or markers: {data.channels}, {data.marker_names}; the model knows {model.channels}, "
            f"{model.marker_names}"
        )
    check_frame(model.frame, data.frame)
    if len(data) < FEWEST:
        raise DataError(f"{len(data)} rows have readings and all markers; at least {FEWEST} are needed")
    return data.inputs(model.memory_s)


def _verdict(stated: float, before: float, rigid: float) -> str:
    if before <= AS_BEFORE * stated:
        return "holds"
    if rigid <= AS_BEFORE * stated:
        return "base moved"
    return "base moved and map changed" if rigid < 0.5 * before else "map changed"


def _judged(model: ProprioceptiveModel, name: str, inputs: FloatArray, targets: FloatArray) -> float:
    """Return the error of a correction on blocks in time that it was not fitted to [m]."""
    errors = np.empty_like(targets)
    for held in _blocks(len(targets)):
        network = _corrected(model.network, name, inputs[~held], targets[~held])
        errors[held] = network(inputs[held]) - targets[held]
    return marker_rms(errors)


def _blocks(count: int) -> Iterator[BoolArray]:
    block = np.arange(count) * BLOCKS // count
    for number in range(BLOCKS):
        yield block == number


def _corrected(network: Network, name: str, inputs: FloatArray, targets: FloatArray) -> Network:
    for step in (part.strip() for part in name.split(",")):
        if step == "base":
            T = _rigid(network(inputs), targets)
            points = targets.shape[1] // 3
            network = network.followed_by(
                np.asarray(np.kron(np.eye(points), T[:3, :3]), dtype=np.float64), np.tile(T[:3, 3], points)
            )
        elif step == "zeros":
            network = _with_zeros(network, inputs, targets)
        elif step.startswith("line"):
            left = train_ridge(network.normalised(inputs), targets - network(inputs), penalty=float(step.split()[1]))
            C = left.C * left.scale
            network = network.with_linear(C, left.d - C @ left.centre)
    return network


def _rigid(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rigid motion that takes the markers of all rows to where they are, shape (4, 4)."""
    a, b = after.reshape(-1, 3), before.reshape(-1, 3)
    try:
        return fit_rigid(a, b)
    except DataError:  # all on a line: no more than a shift is known
        return make_pose(np.eye(3), (a - b).mean(axis=0))


def _with_zeros(network: Network, inputs: FloatArray, targets: FloatArray) -> Network:
    """Return the network whose sensors have other zeros, found by Gauss–Newton steps with a prior."""
    noise = max(marker_rms(network(inputs) - targets) / 10.0, 1e-6)
    spread = np.where(network.scale > 0, 1.0 / np.where(network.scale > 0, network.scale, 1.0), 0.0)
    if network.kind == "radial":
        spread = spread * np.median(np.abs(network.normalised(inputs)))
    offset = np.zeros(len(spread))
    for _ in range(ZERO_STEPS):
        base = network(inputs - offset)
        columns = [(network(inputs - offset - 1e-4 * step) - base).ravel() / 1e-4 for step in np.diag(spread)]
        J = np.stack(columns, axis=1) / noise
        left = (targets - base).ravel() / noise
        share = np.divide(offset, spread, out=np.zeros_like(offset), where=spread > 0)
        system = J.T @ J / len(inputs) + np.eye(len(spread)) / (ZERO_STD**2 * len(inputs))
        gradient = J.T @ left / len(inputs) - share / (ZERO_STD**2 * len(inputs))
        offset = offset + spread * np.linalg.solve(system, gradient)
    return replace(network, centre=network.centre + offset)


def _wider(domain: Domain, readings: FloatArray) -> Domain:
    low, high = np.minimum(domain.low, readings.min(axis=0)), np.maximum(domain.high, readings.max(axis=0))
    return replace(domain, low=low, high=high)
