"""What a loop found, in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from femsense.loop.result.loop_result import Loop, Verdict
from femsense.loop.result.records import (
    ConfoundedPair,
    CorrectionRecord,
    Detectable,
    Left,
    NamedEffect,
    Untestable,
    Value,
    WorstMarker,
    alternatives,
)
from femsense.report.text import columns
from femsense.report.words import VERDICTS, known

SURE = 0.05
"""The residual goes with a covariate whose p-value, corrected for multiple tests (Holm), is below this."""


def loop_text(loop: Loop) -> str:
    """Return the content of loop.json in a few lines."""
    words = loop.sentence or VERDICTS.get(loop.verdict)
    lines = [f"verdict: {loop.verdict}" + (f" ({words})" if words else "")]
    lines.append(columns(_rows(loop)))
    close = [pair for pair in loop.confounded if not pair.is_by_model_error]
    others = alternatives(close, [effect.name for effect in loop.effects])
    for effect in loop.effects:
        lines += ["", effect_text(effect, others.get(effect.name, ()))]
    for name, parameters in loop.fitted_along.items():
        lines += ["", f"{name} (fitted along, part of the improved robot, not named)", _values(parameters)]
    for title, said in (
        ("cannot be distinguished", ", ".join(" / ".join(pair.pair) for pair in open_pairs(loop))),
        ("not testable", ", ".join(map(_untestable, loop.not_testable))),
        ("would have been seen", _seen(loop) if loop.verdict == Verdict.NONE else ""),
        ("next experiment", loop.next_experiment),
    ):
        if said:
            lines += ["", f"{title}: {said}"]
    left = _left(loop.left)
    return "\n".join([*lines, "", f"what is left: {left}"] if left else lines)


def effect_text(effect: NamedEffect, others: Sequence[str] = ()) -> str:
    """Return an effect that was found: its name with those that the data do not distinguish from it, parameters with one standard deviation, and what it
    changed."""
    rows = _value_rows(effect.parameters)
    before, after = effect.validation_rms_before_m, effect.validation_rms_after_m
    if known(before) and known(after):
        rows.append(["residual on held-out data", f"{1e3 * before:.3f} → {1e3 * after:.3f} mm rms"])
    title = " or ".join([effect.name, *others]) + (": these data do not distinguish them" if others else "")
    return f"{title}\n{columns(rows)}"


# --- helpers ----------------------------------------------------------------------------------------------------------


def _values(parameters: Mapping[str, Value]) -> str:
    return columns(_value_rows(parameters))


def _value_rows(parameters: Mapping[str, Value]) -> list[list[str]]:
    return [[key, _parameter(entry.value, entry.std, entry.unit)] for key, entry in parameters.items()]


def open_pairs(loop: Loop) -> list[ConfoundedPair]:
    """Return the pairs that the data cannot distinguish: those that hold a named effect, or all where no effect is named."""
    names = {effect.name for effect in loop.effects}
    return [row for row in loop.confounded if names & set(row.pair) or not names]


def _untestable(effect: Untestable) -> str:
    share = effect.absorbed_share
    return effect.name + ("" if not known(share) else f" ({100 * share:.1f} % of it is absorbed by calibration)")


def _seen(loop: Loop) -> str:
    """Return in one line the smallest sizes at which testable effects that were not found would have been detected."""
    hidden = {effect.name for effect in loop.not_testable}
    shown = {name: entry for name, entry in loop.detectable.items() if name not in hidden and entry.would_be_seen}
    return ", ".join(f"{name} ({_size(entry)})" for name, entry in shown.items() if entry.smallest)


def _size(entry: Detectable) -> str:
    """Return the smallest size that would be detected at all places."""
    largest = max((size for size in entry.smallest.values() if size is not None), default=float("nan"))
    size = f"{largest:.{4 if entry.kind == 'factor' else 3}g}" + ("" if entry.unit in (None, "", "1") else f" {entry.unit}")
    return {"factor": f"a factor of {size}", "softer_than": f"softer than {size}"}.get(entry.kind or "", size)


def _left(left: Left) -> str:
    """Return in one line the size of the remaining residual, its place, frame and covariate, and whether it has structure."""
    if not known(left.rms_m):
        return ""
    words = [f"{1e3 * left.rms_m:.3g} mm rms" + (" in held-out data" if left.held_out else "")]
    if left.where.marker:
        words.append("most " + _place_text(left.where))
    if left.worst_frame.frame is not None:
        words.append(f"in frame {left.worst_frame.frame}")
    goes = next((row for row in left.goes_with if not row.p_holm >= SURE), None)
    if goes is not None:
        words.append(f"going with {goes.covariate}")
    if left.structure.significant is not None:
        words.append("with structure" if left.structure.significant else "without structure")
    return ", ".join(words)


def _place_text(where: WorstMarker) -> str:
    """Return where a residual is largest: at a marker, or at a place on the body at rest."""
    if not where.marker.startswith("surface ") or not where.position_m:
        return f"at marker {where.marker}"
    return "at ({:.0f}, {:.0f}, {:.0f}) mm on the body".format(*(1e3 * v for v in where.position_m))


def _rows(loop: Loop) -> list[list[str]]:
    rows = []
    keys = [("train_rms_m", "residual"), ("validation_rms_m", "residual, held out")]
    if loop.before.validation_normal_rms_m not in (None, loop.before.validation_rms_m):
        keys.append(("validation_normal_rms_m", "clouds, along normals, held out"))
    for key, name in keys:
        before, after = getattr(loop.before, key), getattr(loop.after, key)
        if known(before) and known(after):
            rows.append([name, f"{1e3 * before:.3f} → {1e3 * after:.3f} mm rms"])
    if known(loop.noise_m):
        rows.append(["noise", f"{1e3 * loop.noise_m:.3f} mm"])
    own = loop.model_error
    if own is not None and known(own.held_out_m):
        said = f"{1e3 * own.held_out_m:.3f} mm held out, beyond noise and discretisation; noise: {own.noise_source}"
        rows.append(["error of the model", said])
    if loop.correction is not None:
        rows.append(["with an empirical correction", correction_text(loop.correction)])
    return rows


def correction_text(own: CorrectionRecord) -> str:
    """Return what an empirical correction does to held-out markers, and whether it is returned."""
    before, after = own.validation_rms_before_m, own.validation_rms_after_m
    sizes = "" if before is None or after is None else f"{1e3 * before:.3f} → {1e3 * after:.3f} mm rms held out; "
    return f"{sizes}{own.verdict}; it is {'handed back, as no cause' if own.accepted else 'not handed back'}"


def _parameter(value: Any, std: Any, unit: str | None) -> str:
    """Return a value with its standard deviation; values of several places one after another."""
    if isinstance(value, Mapping):
        stds = std if isinstance(std, Mapping) else {}
        return ", ".join(f"{name} {_parameter(v, stds.get(name), unit)}" for name, v in value.items())
    known = "" if unit in (None, "", "1") else f" {unit}"
    return f"{_words(value)}{'' if std is None else f' ± {_words(std)}'}{known}"


def _words(value: Any) -> str:
    """Return a value of JSON as a short text."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{str(key).replace('_', ' ')} {_words(item)}" for key, item in value.items() if item is not None)
    if isinstance(value, list | tuple):
        simple = all(isinstance(item, int | float) for item in value)
        return f"[{', '.join(map(_words, value))}]" if simple else "; ".join(map(_words, value))
    return "–" if value is None else str(value)
