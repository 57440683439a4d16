"""Effects, errors and data of a closed loop, as records."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import Trial, heads_of, normal_rms_of, rms_of, vectors_of
from femsense.loop.fit.cross_validation import LEAST_SWEEPS
from femsense.loop.fit.discretisation_error import mesh_error_rms, representative_frames
from femsense.loop.fit.fitted_model import FittedModel, held_out, roughly_keeping, terms_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import (
    NAMED,
    PASSES,
    CloudCard,
    DataCard,
    Detectable,
    Errors,
    NamedEffect,
    Outlier,
    RefitRecord,
    Residuals,
    TriedEffect,
    Untestable,
    Value,
)
from femsense.loop.search.screening import Candidate, one_each
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import Thresholds
from femsense.loop.verdict.candidate_tables import KINDS, own_size
from femsense.loop.verdict.sentences import ROUNDED
from femsense.model.effects.base import absent_elsewhere, placed

DRAWS = 2000
"""Number of bootstrap draws for the interval of the held-out error, over sweeps, or over frames if there are fewer than LEAST_SWEEPS sweeps."""
REMOVED = "accepted at one step, not part of the returned model"
"""Verdict on an effect that a later step or the final tests removed."""

# Effects


def chain_of_effects(
    data: Data, search: Search, promoted: list[str], names: list[str], back: FittedModel, full_std: dict[str, FloatArray]
) -> list[NamedEffect]:
    """Return the effects in the order in which they were added, each with the held-out error before and after it."""
    models = dict(search.history)
    errors = []
    for i in range(len(promoted) - (names == promoted)):  # the last error is that of the returned model
        errors.append(_rough_error(data, models[""], promoted[: i + 1], search.noise))
    errors += [models[name].held_rms for name in names[len(promoted) : -1]] + [back.held_rms] * bool(names)
    steps = zip(names, [search.before.held_rms, *errors], errors)
    return [NamedEffect(name, values_of(full_std, back, name), before, after) for name, before, after in steps]


def _rough_error(data: Data, fitted: FittedModel, names: list[str], noise: Noise) -> float:
    """Return the held-out error [m] of a fitted model with some of its terms, fitted to some states; without equilibrium its own error."""
    if set(fitted.fit.hypothesis.names) <= set(names):
        return fitted.held_rms
    try:
        frames = [representative_frames(t, len(fitted.fit.hypothesis.robot.body.mesh.tets)) for t in data.train]
        rough = roughly_keeping(data, fitted, names, noise, frames)
        return rms_of([h.jet.residual for h in held_out(data, rough.fit, noise)])
    except FemsenseError:
        return fitted.held_rms


def values_of(full_std: dict[str, FloatArray], back: FittedModel, name: str) -> dict[str, Value]:
    """Return the values of one effect; vectors and tables keep their shape. Values that were not fitted have std None.

    Values are those of the returned model, at their null if the fit moved them by less than ROUNDED standard deviations. Standard deviations are at
    least those of the full fit, in which no number is held fixed.
    """
    result = dict[str, Value]()
    for effect, seed in back.fit.hypothesis.settled:
        if effect.name == name:
            result |= {k: Value(v, None, _unit(k)) for k, v in seed.items()}
    full = full_std.get(name)
    for effect, seed, parameters, span in terms_of(back.fit):
        if effect.name != name:
            continue
        values, std = back.fit.coordinates[span], back.fit.std[span]
        if full is not None and len(full) == len(std):
            std = np.maximum(std, full)
        for p in absent_elsewhere(parameters):
            known = result.get(p.key, Value(None, None, p.unit))
            result[p.key] = Value(placed(known.value, p.part, p.value(p.null)), placed(known.std, p.part, None), known.unit)
        for p, fitted, deviation in zip(parameters, values, std):
            value = p.null if abs(fitted - p.null) <= ROUNDED * deviation else fitted
            known = result.get(p.key, Value(None, None, p.unit))
            own = placed(known.value, p.part, _finite(p.value(value)))
            result[p.key] = Value(own, placed(known.std, p.part, _finite(p.value_std(value, deviation))), known.unit)
        result |= {k: Value(v, None, _unit(k)) for k, v in seed.items() if k not in result}
    return result


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None


def _unit(key: str) -> str:
    return "m" if key.endswith("_m") else "s" if key.endswith("_s") else "1"


# Errors


def errors_of(data: Data, fitted: FittedModel, rng: np.random.Generator) -> Errors:
    """Return the errors of a model: of the markers, and along the normals of the clouds; without markers both are those of the clouds."""
    kind = max(r.shape[1] for r in fitted.held_residuals)
    interval, by = _interval(data, fitted, kind, rng)
    errors = Errors(fitted.fit.rms, fitted.held_rms, interval, by)
    held = normal_rms_of(fitted.held_residuals)
    if held is None:
        return errors
    own = interval if kind == 1 else _interval(data, fitted, 1, rng)[0]
    return replace(errors, train_normal_rms_m=fitted.fit.normal_rms, validation_normal_rms_m=held, validation_normal_ci_m=own)


def _interval(data: Data, fitted: FittedModel, kind: int, rng: np.random.Generator) -> tuple[tuple[float, float], str]:
    """Return the 95 % interval of the held-out error of markers (kind 3) or clouds (1) [m], and the unit of the bootstrap."""
    pairs = [((r**2).sum(axis=1), t.groups) for r, t in zip(fitted.held_residuals, data.held) if r.shape[1] == kind]
    by_sweep = sum(np.unique(g.sweep).size for _, g in pairs) >= LEAST_SWEEPS
    blocks = [s[labels == g] for s, own in pairs for labels in [own.sweep if by_sweep else own.frame] for g in np.unique(labels)]
    sums, counts = np.array([b.sum() for b in blocks]), np.array([len(b) for b in blocks])
    drawn = rng.integers(0, len(blocks), size=(DRAWS, len(blocks)))
    draws = np.sqrt(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
    return (float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))), "sweeps" if by_sweep else "frames"


# Candidates


def untestable(first: Sequence[Candidate], names: Collection[str], thresholds: Thresholds) -> list[Untestable]:
    """Return the effects that calibration absorbs in these data, without the accepted ones."""
    return [
        Untestable(c.effect.name, float(np.sqrt(max(0.0, 1.0 - c.retained**2))), c.retained)
        for c in one_each(list(first))
        if c.retained < thresholds.testable and c.effect.name not in names
    ]


def tried_effects(
    first: list[Candidate], table: list[Candidate], refits: Sequence[RefitRecord], names: Collection[str], thresholds: Thresholds
) -> list[TriedEffect]:
    """Return every effect that was tried with its scores: linear at the start, linear at the end, and the joint refits.

    `names` are the effects of the returned model; another one that a step accepted has the verdict REMOVED."""
    last = {c.effect.name: c for c in one_each(table)}
    screened = {c.effect.name for c in first}
    unscreened = {r.name: r for r in reversed(refits) if r.name not in screened}  # the mesh is tested without screening
    rows = [
        TriedEffect(r.name, r.seed, r.dchi2, r.dbic, None, None, own := _refits_of(r.name, refits), _verdict_of(own, names))
        for r in unscreened.values()
    ]
    for c in one_each(first):
        joint, end = _refits_of(c.effect.name, refits), last.get(c.effect.name)
        verdict = _verdict_of(joint, names) if joint else _why_not(c, end, thresholds)
        rows.append(TriedEffect(c.effect.name, c.seed, c.gain, c.score, c.retained, end.score if end else None, joint, verdict))
    return rows


def _refits_of(name: str, refits: Sequence[RefitRecord]) -> tuple[RefitRecord, ...]:
    return tuple(r for r in refits if r.name == name)


def _verdict_of(joint: Sequence[RefitRecord], names: Collection[str]) -> str:
    """Return the best verdict of an effect's joint refits, else the last one."""
    said = [r.verdict for r in joint]
    best = next((v for v in (NAMED, PASSES) if v in said), said[-1])
    return REMOVED if best == NAMED and joint[0].name not in names else best


def _why_not(c: Candidate, end: Candidate | None, thresholds: Thresholds) -> str:
    if c.retained < thresholds.testable:
        share = 100.0 * np.sqrt(max(0.0, 1.0 - c.retained**2))
        return f"not testable: {'more than 99' if share > 99.0 else f'{share:.0f}'} % of it is absorbed by calibration"
    if c.score > thresholds.evidence and end is not None and end.score <= thresholds.evidence:
        return f"the accepted effects fit its share of the residual (dBIC {c.score:.0f}, then {end.score:.1f})"
    if c.score > thresholds.evidence:
        return f"not refitted: its score is far below the best (dBIC {c.score:.0f})"
    return f"too little evidence (dBIC {c.score:.1f})"


def detectable(table: list[Candidate], found: Collection[str]) -> dict[str, Detectable]:
    """Return the smallest detectable size of each effect that was not found, in the unit of its parameter."""
    return {c.effect.name: _smallest_seen(c) for c in one_each(table) if c.effect.name not in found}


def _smallest_seen(c: Candidate) -> Detectable:
    if c.effect.discrete:
        seen = c.smallest[0] < 1.0 if len(c.smallest) else False
        return Detectable({}, bool(seen), share_seen=float(c.smallest[0]))
    sizes = {p.label: own_size(float(s), p.scale) for p, s in zip(c.parameters, c.smallest)}
    seen = any(s <= max(p.high - p.null, p.null - p.low) for p, s in zip(c.parameters, c.smallest))
    return Detectable(sizes, bool(seen), KINDS[c.parameters[0].scale], c.parameters[0].unit)


# Data


def data_card(
    data: Data, final: FittedModel, full_std: dict[str, FloatArray], noise: Noise, noise_source: str, n_effective: float
) -> DataCard:
    """Return the data, their split, and the nuisance values of the final model."""
    moved = {effect.name for effect, _, _ in final.fit.hypothesis.terms}
    heads = [data.train[i] for i in heads_of(data.train)]
    return DataCard(
        recordings=tuple(str(t.scene.recording.folder) for t in heads),
        split=tuple(data.split),
        frames_fitted=_frame_numbers(heads),
        frames_held_out=_frame_numbers([data.held[i] for i in heads_of(data.held)]),
        measured=data.measured,
        clouds=_cloud_card(data, noise),
        noise_components_m=noise.std or noise.surface,
        noise_source=noise_source,
        mesh_error_m=mesh_error_rms(data),
        outliers=tuple(Outlier(number, name) for number, name in data.outliers),
        effective_observations=n_effective,
        nuisance_after={name: values_of(full_std, final, name) for name in NUISANCE if name in moved},
        placement_std_m=data.placement_std,
    )


def _frame_numbers(trials: list[Trial]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(t.scene.recording.frame_numbers[k]) for k in t.scene.frames) for t in trials)


def _cloud_card(data: Data, noise: Noise) -> CloudCard | None:
    """Return the cloud data that were fitted; None without clouds."""
    own = [t for t in data.train if t.scene.crossings is not None]
    if not own:
        return None
    points = sorted({int(m) for t in own for m in t.scene.marker})
    return CloudCard(
        frames=tuple(len(t.scene.frames) for t in own),
        rows=tuple(len(t.scene.frame) for t in own),
        points_m={data.robot.marker_names[i]: tuple(data.robot.marker_points[i].tolist()) for i in points},
        noise_components_m=noise.surface,
        noise_m=noise.along_normals,
    )


def residual_table(data: Data, before: FittedModel, after: FittedModel) -> Residuals:
    """Return the held-out residuals of two models as vectors in the robot frame [m]."""
    recordings, frames, markers = list[int](), list[int](), list[str]()
    fields: tuple[list[tuple[float, ...]], ...] = ([], [])
    for i, at in enumerate(heads_of(data.held)):
        scene = data.held[at].scene
        for field, fitted in zip(fields, (before, after)):
            field += map(tuple, vectors_of(data.held[at], fitted.held_residuals[at], fitted.held[at].poses).tolist())
        recordings += [i] * len(scene.frame)
        frames += [int(n) for n in scene.recording.frame_numbers[scene.frame]]
        markers += [data.robot.marker_names[m] for m in scene.marker]
    return Residuals(tuple(recordings), tuple(frames), tuple(markers), tuple(fields[0]), tuple(fields[1]))
