"""Validity of a model on another day: it holds, the base has moved, one channel has an offset, or the map has changed; and a
correction from a few labelled frames (`corrections`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.model.marker_units import check_marker_sizes
from femsense.xr.proprioception.corrections import (
    AFRESH,
    Frames,
    corrected,
    explain,
    is_better,
    rigid_motion,
    shift_of,
    shifts_of,
)
from femsense.xr.proprioception.domain import Domain
from femsense.xr.proprioception.labelled import Labelled, check_frame
from femsense.xr.proprioception.learn import error_interval, error_table, marker_errors_mm, median_radius_mm
from femsense.xr.proprioception.memory import longest_gap
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.selection import marker_rms
from femsense.xr.proprioception.spread import make_spread

AS_BEFORE = 1.5
"""Times the error that was stated at which a model still holds."""
FEWEST = 8
"""Labelled frames for a correction."""


@dataclass(frozen=True, eq=False, slots=True)
class Drift:
    """Result of `drift`: errors of a model on other data, and the cause if they are too large."""

    verdict: str
    """"holds", or the cause: "one channel shifted", "base moved", "map changed", joined by "and"."""
    stated_mm: float
    """Error of the model on held-out training data, as stated in its file: root mean square distance of the markers [mm]."""
    error_mm: float
    """Error of the unchanged model on the new data [mm]."""
    rigid_mm: float
    """Error after a rigid motion of the predicted markers [mm], on frames to which the motion was not fitted."""
    shift_mm: float
    """Translation of the centre of the markers by this rigid motion [mm]."""
    turn_deg: float
    """Angle of this rigid motion [°]."""
    shifts: dict[str, float]
    """Channel → offset in the unit of its sensor: first the channel whose offset fits best, then others that fit equally well."""
    left_mm: float
    """Error after correction of the causes in `verdict` [mm], on frames to which the correction was not fitted."""
    outside: float
    """Share of the rows with a channel outside of the training domain."""
    channels: dict[str, float]
    """Of those channels, the share of rows in which each is outside."""

    @property
    def text(self) -> str:
        """The message to the user, in lines."""
        lines = [f"{self.verdict}: {self.error_mm:.2f} mm here, {self.stated_mm:.2f} mm when it was learnt"]
        if self.verdict != "holds":
            lines.append(f"a rigid motion of {self.shift_mm:.2f} mm and {self.turn_deg:.2f}° leaves {self.rigid_mm:.2f} mm")
        if self.verdict != "holds" and self.shifts:
            said = [f"{name} reads {abs(by):.4g} too {'high' if by > 0 else 'low'}" for name, by in self.shifts.items()]
            lines.append(f"{', or '.join(said)}; without that {self.left_mm:.2f} mm are left")
        if self.outside > 0.0:
            named = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in self.channels.items())
            lines.append(f"outside the training domain in {100 * self.outside:.0f} % of the rows: {named}")
        return "\n".join(lines)


def drift(model: ProprioceptiveModel, data: Labelled) -> Drift:
    """Test whether the error of a proprioceptive model on new data is still the one stated for it, and find the cause if it is not.

    The error is the root mean square distance between predicted and measured markers. The model holds if the lower end of its 95 % interval is
    at most 1.5 times the stated error. Otherwise an offset of one channel, a rigid motion of the base and a changed map are fitted to one part of
    the frames and compared on the others.

    Arguments:
        model: result of `learn` or `load_model`.
        data: result of `labelled`: sensor readings and measured markers of another day, with the channels and markers of the model.

    Returns:
        the errors with and without correction [mm], and `verdict`: "holds", or the causes.

    Raises:
        DataError: fewer than 8 rows with markers.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> time_s = np.arange(400) / 50.0
        >>> bend = np.sin(2.0 * time_s)[:, None]  # reading of one bend sensor
        >>> tip = np.stack([0.1 * np.cos(bend), 0.0 * bend, 0.1 * np.sin(bend)], axis=2)  # one marker [m]
        >>> model = fs.learn(fs.labelled(time_s, bend, tip, channels=("flex",), marker_names=("tip",)))
        >>> later = fs.labelled(time_s, bend + 0.1, tip, channels=("flex",), marker_names=("tip",))  # the zero of the sensor has moved
        >>> result = fs.drift(model, later)
        >>> result.verdict, round(result.shifts["flex"], 2)
        ('one channel shifted', 0.1)
    """
    frames = _frames(model, data)
    predicted = model.network(frames.inputs)
    stated = float(model.report.get("error_mm", 0.0))
    chosen, errors = explain(frames)
    T, middle = rigid_motion(predicted, frames.targets), predicted.reshape(-1, 3).mean(axis=0)
    shifts = shifts_of(frames, moved="base" in chosen) if "channel" in chosen else ()
    inside = model.domain.inside(data.readings)
    names = [item.channel for row in data.readings[~inside] for item in model.check(row)]
    counts = {name: names.count(name) / len(data) for name in dict.fromkeys(names)}
    return Drift(
        verdict=_verdict(errors, chosen, frames.targets, stated),
        stated_mm=stated,
        error_mm=1e3 * marker_rms(errors["none"]),
        rigid_mm=1e3 * marker_rms(errors["base"]),
        shift_mm=1e3 * float(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle)),
        turn_deg=float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))),
        shifts={model.channels[shift.channel]: shift.by for shift in shifts},
        left_mm=1e3 * marker_rms(errors[chosen]),
        outside=float(1.0 - inside.mean()),
        channels=dict(sorted(counts.items(), key=lambda item: -item[1])),
    )


def adapt(model: ProprioceptiveModel, few: Labelled) -> ProprioceptiveModel:
    """Return a proprioceptive model corrected by a few frames of another day.

    The candidate corrections are offsets of channels, a rigid motion of the base, a linear addition to the map, and a new linear map
    (`corrections.CORRECTIONS`). A more complex one is chosen only if its error on held-out frames is significantly smaller (5 % level).

    Arguments:
        model: result of `learn` or `load_model`.
        few: result of `labelled`: sensor readings and measured markers of the new day.

    Returns:
        the corrected model. Its `report` names the correction and its error on held-out frames [mm], from which the 95 % intervals are
        computed. These hold for one session; `growth` is the error before the correction divided by the stated one.

    Raises:
        DataError: fewer than 8 rows with markers.
    """
    frames = _frames(model, few)
    chosen, errors = explain(frames)
    network = corrected(frames, chosen)
    held = frames.held_out(chosen)
    spread = make_spread(network, frames.inputs, held)
    radius = spread.radius(network, frames.inputs)
    before, learnt = 1e3 * marker_rms(errors["none"]), float(model.report.get("error_mm", 0.0))
    left = error_table(errors[chosen])
    report = {
        **{key: value for key, value in model.report.items() if key != "test"},
        **left,
        "marker_error_mm": marker_errors_mm(errors[chosen], model.marker_names),
        "sessions": 1,
        "interval": {
            "radius_mm": median_radius_mm(radius, model.marker_names),
            "coverage": spread.share_within(held),
            "growth": before / max(learnt, 1e-9),
        },
        "adapted": {"by": chosen, "rows": len(few), "error_mm": left["error_mm"], "before_mm": before, "learnt_mm": learnt},
    }
    domain = model.domain
    if "channel" in chosen:
        found = shift_of(frames, moved="base" in chosen)
        moved = found.by * np.eye(len(model.channels))[found.channel]
        report["adapted"] |= {"channel": model.channels[found.channel], "channel_shift": found.by}
        domain = replace(domain, low=domain.low + moved, high=domain.high + moved, centre=domain.centre + moved)
    return replace(model, network=network, bones=None, domain=_wider(domain, few.readings), report=report, spread=spread)


def model_inputs(model: ProprioceptiveModel, data: Labelled) -> FloatArray:
    """Return the inputs of a model's networks for labelled data.

    Raises InputError, DataError where channels, markers, frames or units differ.
    """
    for kind, here, known in (
        ("channels", data.channels, model.channels),
        ("markers", data.marker_names, model.marker_names),
    ):
        if here != known:
            raise DataError(_other_names(kind, here, known))
    check_frame(model.frame, data.frame)
    if len(data) < FEWEST:
        raise DataError(f"{len(data)} rows have readings and all markers; at least {FEWEST} are needed")
    if data.spacing_s > longest_gap(model.memory_s):
        raise DataError(
            f"readings are {data.spacing_s:.2g} s apart; the model remembers {min(model.memory_s):g} s and needs one every "
            f"{longest_gap(model.memory_s):g} s\n  try:      all rows of the sensors; markers in a few of them are enough"
        )
    inputs = data.inputs(model.memory_s)
    check_marker_sizes(data.markers, model.network(inputs).reshape(data.markers.shape))
    return inputs


def _other_names(kind: str, here: tuple[str, ...], known: tuple[str, ...]) -> str:
    """Return in words how names differ from those of the model."""
    missing, new = [n for n in known if n not in here], [n for n in here if n not in known]
    if not missing and not new:
        return f"the {kind} are in another order than in the training data: {', '.join(here)}, not {', '.join(known)}"
    parts = [f"without {', '.join(missing)}"] * bool(missing) + [f"with {', '.join(new)}, which it does not know"] * bool(new)
    return f"other {kind} than the model's: {', and '.join(parts)}; it knows {', '.join(known)}"


def _frames(model: ProprioceptiveModel, data: Labelled) -> Frames:
    return Frames(model.network, model_inputs(model, data), data.targets, model.domain.high - model.domain.low)


def _verdict(errors: dict[str, FloatArray], chosen: str, targets: FloatArray, stated: float) -> str:
    """Return the meaning of the chosen correction; if the remaining error significantly exceeds the model's own, the map has changed too.

    Significant means that its whole 95 % interval lies above: a few rows outside of the training domain are no change.
    """
    before = errors["none"]
    motion = marker_rms(targets - targets.mean(axis=0))
    if 1e3 * error_interval(before)[0] <= AS_BEFORE * stated and marker_rms(before) < motion:
        return "holds"
    said = []
    if "channel" in chosen:
        said.append("one channel shifted")
    if "base" in chosen and is_better(errors["base"], before):
        said.append("base moved")
    is_map = any(word in chosen for word in ("zeros", "line", AFRESH))
    if not said or is_map or 1e3 * error_interval(errors[chosen])[0] > AS_BEFORE * stated:
        said.append("map changed")
    return " and ".join(said)


def _wider(domain: Domain, readings: FloatArray) -> Domain:
    low, high = np.minimum(domain.low, readings.min(axis=0)), np.maximum(domain.high, readings.max(axis=0))
    return replace(domain, low=low, high=high)
