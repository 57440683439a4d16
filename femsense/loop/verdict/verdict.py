"""The conclusion: which effects are named, what is left, what these data cannot say, and the robot that is handed back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import Trial, heads_of, normal_rms_of, rms_of, vectors_of
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.discretisation_error import beyond_mesh, few_states, without_mesh_error
from femsense.loop.fit.fitted_model import (
    FittedModel,
    held_out,
    roughly_keeping,
)
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.result import LoopResult
from femsense.loop.search.refit import EVIDENCE
from femsense.loop.search.screening import TESTABLE, Candidate, one_each
from femsense.loop.search.search_state import Search
from femsense.loop.verdict.confounding import confounded, in_words
from femsense.loop.verdict.report_data import KINDS, gather, own_size
from femsense.loop.verdict.residual_diagnostics import describe_left, structure_tests
from femsense.loop.verdict.returned_model import MODULUS, _entries, _is_sure, _promoted, _worth_handing_back
from femsense.loop.verdict.sentences import _by_mesh, _by_noise, _evidence_for, _mesh_error, _on_linear, _sentence
from femsense.model.effects import apply_effects

MIN_SWEEPS = 4
"""With fewer held-out sweeps the interval of the held-out error resamples frames."""
DRAWS = 2000
EXPLAINED = 0.8
"""Share of the excess over the noise that effects must take away where structure is left."""
LACKS = 2.0
"""A model that is handed back may leave so many times the mean square, in units of all noise, that calibration of all nuisances leaves."""


def conclude(data: Data, search: Search, rng: np.random.Generator) -> LoopResult:
    """Return the verdict with all that the report shows."""
    before, final, noise = search.before, search.final, search.noise
    spread = parameter_std(data, final, noise, _seed_std(search))
    promoted = [n for n in _promoted(data, search) if _is_sure(final, n, spread[n])]
    names = [*promoted, *(n for n, _ in search.history[1:] if n in final.fit.hypothesis.names)]
    names, back = _worth_handing_back(data, search, promoted, names)
    drifted = MODULUS in promoted and MODULUS not in names  # what a modulus beyond all bounds takes away is not explained
    promoted = [n for n in names if n in NUISANCE]
    entries = _entries(back, names)
    effects = _chain(data, search, promoted, names, back, spread)
    lacks = _lacks(data, back, final, noise)
    shown = back if lacks else final  # what nuisances take away unnamed is left, too
    surprise = _surprise(data, back, noise)
    plain = [without_mesh_error(t, jet.residual, noise, nor_placements=True) for t, jet in zip(data.train, shown.fit.jets)]
    tests = structure_tests(data.train, plain, rng=rng)
    excess = _excess(data, before, final, back, noise)
    found = _not_handed_back(search, names)
    structured = tests.significant and excess.left > excess.tolerated
    unexplained = lacks or (found and not effects) or ((structured or surprise) and (drifted or excess.explained < EXPLAINED))
    verdict = "unexplained" if unexplained else "effects" if effects else "none"
    rivals = confounded(search, names)
    not_testable = [
        {"name": c.effect.name, "absorbed_share": float(np.sqrt(max(0.0, 1.0 - c.retained**2))), "retained_share": c.retained}
        for c in one_each(search.first)
        if c.retained < TESTABLE and c.effect.name not in names
    ]
    robot = apply_effects(data.declared, entries) if entries else data.declared
    if data.declared.document is not None and entries:
        written = [*data.declared.document.get("effects", []), *entries]
        robot = replace(robot, document={**data.declared.document, "effects": written})
    return LoopResult(
        verdict=verdict,
        sentence=_sentence(verdict, effects, found, before, back, noise, _mesh_error(data))
        + in_words(rivals, names)
        + _by_noise(data, noise)
        + _by_mesh(data, search, back)
        + _on_linear(data, back)
        + _evidence_for(data, found)
        + surprise,
        noise_m=noise.total,
        before=_errors(data, before, rng),
        after=_errors(data, back, rng),
        effects=tuple(effects),
        entries=tuple(entries),
        candidates=tuple(_candidate_rows(search.first, search.last, search.refits)),
        confounded=tuple(rivals),
        next_experiment="",
        not_testable=tuple(not_testable),
        detectable=_detectable(search.last, {e["name"] for e in effects}),
        left={
            **(_left(data, back, noise, held=True) if surprise and not structured and not lacks else _left(data, shown, noise)),
            "structure": tests.document(),
            "explained_share": excess.explained,
        },
        robot=robot,
        declared=data.declared,
        data=_card(data, final, spread, noise, search.n_effective),
        residuals=_residual_table(data, before, back),
        evidence=gather(data, before, search.base, final, back, shown, noise, search.first, search.last, tests, rng),
    )


def _seed_std(search: Search) -> dict[str, FloatArray]:
    named = [r for r in search.refits if r.get("verdict") == "named" and "seed_std" in r]
    return {r["name"]: np.array(r["seed_std"]) for r in named}


def _chain(
    data: Data, search: Search, promoted: list[str], names: list[str], back: FittedModel, spread: dict[str, FloatArray]
) -> list[dict[str, Any]]:
    """Return the effects in the order in which they were added, each with the held-out error before and after it."""
    models = dict(search.history)
    errors = []
    for i in range(len(promoted) - (names == promoted)):  # the last one's is that of what is handed back
        errors.append(_rough_error(data, models[""], promoted[: i + 1], search.noise))
    errors += [models[name].held_rms for name in names[len(promoted) : -1]] + [back.held_rms] * bool(names)
    return [
        {
            "name": name,
            "parameters": _parameters(spread, back, name),
            "validation_rms_before_m": b,
            "validation_rms_after_m": a,
        }
        for name, b, a in zip(names, [search.before.held_rms, *errors], errors)
    ]


def _rough_error(data: Data, fitted: FittedModel, names: list[str], noise: Noise) -> float:
    """Return the held-out error [m] of a stage with some of its terms only, fitted to some states; its own where they have no equilibrium."""
    if set(fitted.fit.hypothesis.names) <= set(names):
        return fitted.held_rms
    try:
        frames = [few_states(t, len(fitted.fit.hypothesis.robot.body.mesh.tets)) for t in data.train]
        rough = roughly_keeping(data, fitted, names, noise, frames)
        return rms_of([h.jet.residual for h in held_out(data, rough.fit, noise)])
    except FemsenseError:
        return fitted.held_rms


@dataclass(frozen=True, slots=True)
class Excess:
    """Root mean squares [m] over what is measured again and again alike, less the likeliest share of the mesh's error."""

    left: float
    """What the final model leaves beyond the noise of repetition."""
    tolerated: float
    explained: float
    """Share of the mean square beyond the noise that the effects took away: where fitted by all that was found, on held-out data by what is
    handed back; the smaller one."""


def _excess(data: Data, before: FittedModel, final: FittedModel, back: FittedModel, noise: Noise) -> Excess:
    axes, std = (3.0, noise.std) if noise.std else (1.0, noise.surface)
    floor = float(np.sqrt(axes * sum(v**2 for k, v in std.items() if k != "state")))
    fitted = [beyond_mesh(data.train, [j.residual for j in s.fit.jets], noise) for s in (before, final)]
    held = [beyond_mesh(data.held, s.held_residuals, noise) for s in (before, back)]
    left = float(np.sqrt(max(fitted[1] ** 2 - floor**2, 0.0)))
    return Excess(left, 0.25 * floor, min(_taken_away(fitted[0], fitted[1], floor), _taken_away(held[0], held[1], floor)))


def _lacks(data: Data, back: FittedModel, final: FittedModel, noise: Noise) -> bool:
    """Return whether what is handed back leaves much that the final model takes away with nuisances that are not named."""
    train = [_mean_square(data.train, [j.residual for j in s.fit.jets], noise) for s in (back, final)]
    held = [_mean_square(data.held, s.held_residuals, noise) for s in (back, final)]
    return any(own > LACKS * max(full, 1.0) for own, full in (train, held))


def _surprise(data: Data, back: FittedModel, noise: Noise) -> str:
    """Return a sentence on what held-out data show of what is handed back and fitted data do not; nothing where these are as well explained."""
    fitted = _mean_square(data.train, [j.residual for j in back.fit.jets], noise)
    held = _mean_square(data.held, back.held_residuals, noise)
    if held <= LACKS * max(fitted, 1.0):
        return ""
    worst = describe_left(data.robot, data.held, _beyond_mesh(data.held, back.held_residuals, noise))["worst_frame"]
    return (
        f" Held-out data show what the fitted ones do not, most in frame {worst['frame']} ({1e3 * worst['rms_m']:.2f} mm):"
        " record more sweeps like that one."
    )


def _left(data: Data, fitted: FittedModel, noise: Noise, *, held: bool = False) -> dict[str, Any]:
    """Return what the residual of the fitted data looks like, or of the held-out data where these alone show it."""
    trials, residuals = (data.held, fitted.held_residuals) if held else (data.train, [jet.residual for jet in fitted.fit.jets])
    return {**describe_left(data.robot, trials, _beyond_mesh(trials, residuals, noise)), "held_out": held}


def _beyond_mesh(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> list[FloatArray]:
    return [without_mesh_error(t, r, noise) for t, r in zip(trials, residuals)]


def _mean_square(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> float:
    """Return the mean square of whitened residuals; 1 is noise."""
    rows = [whiten(noise.whitener(t.groups, t.mesh_error), r) for t, r in zip(trials, residuals)]
    return float(np.mean(np.concatenate(rows, axis=None) ** 2)) if rows else 0.0


def _taken_away(before: float, after: float, floor: float) -> float:
    """Return the share of the mean square beyond the floor that is gone; all of it where nothing is left beyond."""
    return 1.0 if after <= floor else float((before**2 - after**2) / max(before**2 - floor**2, 1e-18))


def _parameters(spread: dict[str, FloatArray], back: FittedModel, name: str) -> dict[str, Any]:
    """Return {key: {value, std, unit}} of one effect; vectors and tables keep their shape. What was not fitted has std None.

    Values are those that are handed back; standard deviations are not smaller than those of the full fit, in which nothing was held still.
    """
    result = dict[str, Any]()
    for effect, seed in back.fit.hypothesis.settled:
        if effect.name == name:
            result |= {k: {"value": v, "std": None, "unit": _unit(k)} for k, v in seed.items()}
    full = spread.get(name)
    at = 0
    for effect, seed, parameters in back.fit.hypothesis.terms:
        values = back.fit.coordinates[at : at + len(parameters)]
        std = back.fit.std[at : at + len(parameters)]
        at += len(parameters)
        if effect.name != name:
            continue
        if full is not None and len(full) == len(std):
            std = np.maximum(std, full)
        for p, value, deviation in zip(parameters, values, std):
            slot = result.setdefault(p.key, {"value": None, "std": None, "unit": p.unit})
            for field, number in (("value", p.value(value)), ("std", p.value_std(value, deviation))):
                slot[field] = _placed(slot[field], p.part, float(number) if np.isfinite(number) else None)
        result |= {k: {"value": v, "std": None, "unit": _unit(k)} for k, v in seed.items() if k not in result}
    return result


def _unit(key: str) -> str:
    return "m" if key.endswith("_m") else "s" if key.endswith("_s") else "1"


def _placed(slot: Any, part: Any, number: float | None) -> Any:
    if part is None:
        return number
    if isinstance(part, int):
        return [*(slot or []), number]
    if isinstance(part, tuple):
        table = dict(slot or {})
        table[part[0]] = [*table.get(part[0], []), number]
        return table
    return {**(slot or {}), part: number}


def _errors(data: Data, fitted: FittedModel, rng: np.random.Generator) -> dict[str, Any]:
    """Return the errors of a stage: of the markers, of clouds along their normals beside them; where there are no markers, twice those."""
    kind = max(r.shape[1] for r in fitted.held_residuals)
    interval, by = _interval(data, fitted, kind, rng)
    errors = {
        "train_rms_m": fitted.fit.rms,
        "validation_rms_m": fitted.held_rms,
        "validation_ci_m": interval,
        "validation_ci_by": by,
    }
    held = normal_rms_of(fitted.held_residuals)
    if held is not None:
        own = interval if kind == 1 else _interval(data, fitted, 1, rng)[0]
        errors |= {"train_normal_rms_m": fitted.fit.normal_rms, "validation_normal_rms_m": held, "validation_normal_ci_m": own}
    return errors


def _interval(data: Data, fitted: FittedModel, kind: int, rng: np.random.Generator) -> tuple[list[float], str]:
    """Return the 95 % interval of the held-out error of markers (kind 3) or clouds (1) [m], and what was drawn again."""
    pairs = [((r**2).sum(axis=1), t.groups) for r, t in zip(fitted.held_residuals, data.held) if r.shape[1] == kind]
    by_sweep = sum(np.unique(g.sweep).size for _, g in pairs) >= MIN_SWEEPS
    blocks = [s[labels == g] for s, own in pairs for labels in [own.sweep if by_sweep else own.frame] for g in np.unique(labels)]
    sums, counts = np.array([b.sum() for b in blocks]), np.array([len(b) for b in blocks])
    drawn = rng.integers(0, len(blocks), size=(DRAWS, len(blocks)))
    draws = np.sqrt(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
    return [float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))], "sweeps" if by_sweep else "frames"


def _candidate_rows(first: list[Candidate], table: list[Candidate], refits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return every effect that was tried with its scores: linear at the start, linear at the end, and the joint refits."""
    last = {c.effect.name: c for c in one_each(table)}
    screened = {c.effect.name for c in first}
    rows = [  # the mesh is asked about without screening it
        {
            "name": r["name"],
            "seed": r["seed"],
            "dchi2": r.get("dchi2"),
            "dbic": r.get("dbic"),
            "retained_share": None,
            "dbic_at_end": None,
            "refits": [o for o in refits if o["name"] == r["name"]],
            "verdict": _verdict_of([o for o in refits if o["name"] == r["name"]]),
        }
        for r in {r["name"]: r for r in reversed(refits) if r["name"] not in screened}.values()
    ]
    for c in one_each(first):
        joint = [r for r in refits if r["name"] == c.effect.name]
        end = last.get(c.effect.name)
        rows.append(
            {
                "name": c.effect.name,
                "seed": c.seed,
                "dchi2": c.gain,
                "dbic": c.score,
                "retained_share": c.retained,
                "dbic_at_end": None if end is None else end.score,
                "refits": joint,
                "verdict": _verdict_of(joint) if joint else _why_not(c, end),
            }
        )
    return rows


def _verdict_of(joint: list[dict[str, Any]]) -> str:
    """Return what became of an effect in all its joint refits: the best that was said of any."""
    said = [str(r["verdict"]) for r in joint]
    return next((v for v in ("named", "passes") if v in said), said[-1])


def _why_not(c: Candidate, end: Candidate | None) -> str:
    if c.retained < TESTABLE:
        share = 100.0 * np.sqrt(max(0.0, 1.0 - c.retained**2))
        return f"not testable: calibration imitates {'more than 99' if share > 99.0 else f'{share:.0f}'} % of it"
    if c.score > EVIDENCE and end is not None and end.score <= EVIDENCE:
        return f"nothing is left for it once what is named is in the model (dBIC {c.score:.0f}, then {end.score:.1f})"
    if c.score > EVIDENCE:
        return f"not refitted: far behind the best (dBIC {c.score:.0f})"
    return f"too little evidence (dBIC {c.score:.1f})"


def _detectable(table: list[Candidate], found: set[str]) -> dict[str, Any]:
    """Return for each effect that was not found the smallest size that would have been seen, in the unit of its parameter, and whether any plausible
    size would."""
    result: dict[str, Any] = {}
    for c in one_each(table):
        if c.effect.name in found:
            continue
        if c.effect.discrete:
            seen = c.smallest[0] < 1.0 if len(c.smallest) else False
            result[c.effect.name] = {"smallest": {}, "would_be_seen": bool(seen), "share_seen": float(c.smallest[0])}
            continue
        sizes = {p.label: own_size(float(s), p.scale) for p, s in zip(c.parameters, c.smallest)}
        seen = any(s <= max(p.high - p.null, p.null - p.low) for p, s in zip(c.parameters, c.smallest))
        result[c.effect.name] = {
            "smallest": sizes,
            "kind": KINDS[c.parameters[0].scale],
            "unit": c.parameters[0].unit,
            "would_be_seen": bool(seen),
        }
    return result


def _not_handed_back(search: Search, names: list[str]) -> list[str]:
    """Return the effects that were found, but are not among the names that are handed back."""
    return [n for n, _ in search.history[1:] if n not in names and n in search.final.fit.hypothesis.names]


def _card(data: Data, final: FittedModel, spread: dict[str, FloatArray], noise: Noise, n_effective: float) -> dict[str, Any]:
    nuisance = {
        name: _parameters(spread, final, name)
        for name in NUISANCE
        if any(e.name == name for e, _, _ in final.fit.hypothesis.terms)
    }

    def frames(trials: list[Trial]) -> list[list[int]]:
        return [[int(t.scene.recording.frame_numbers[k]) for k in t.scene.frames] for t in trials]

    return {
        "recordings": [str(data.train[i].scene.recording.folder) for i in heads_of(data.train)],
        "split": data.split,
        "frames_fitted": frames([data.train[i] for i in heads_of(data.train)]),
        "frames_held_out": frames([data.held[i] for i in heads_of(data.held)]),
        "measured": list(data.measured),
        "clouds": _cloud_card(data, noise),
        "noise_components_m": noise.std or noise.surface,
        "noise_source": noise.source,
        "mesh_error_m": _mesh_error(data),
        "outliers": [{"frame": number, "marker": name} for number, name in data.outliers],
        "effective_observations": n_effective,
        "nuisance_after": nuisance,
        "placement_std_m": data.placement_std,
    }


def _cloud_card(data: Data, noise: Noise) -> dict[str, Any] | None:
    """Return what was used of clouds; None where they were not."""
    own = [t for t in data.train if t.scene.crossings is not None]
    if not own:
        return None
    rows = [len(t.scene.frame) for t in own]
    return {
        "frames": [len(t.scene.frames) for t in own],
        "rows": rows,
        "points_m": {
            data.robot.marker_names[i]: data.robot.marker_points[i].tolist()
            for i in sorted({int(m) for t in own for m in t.scene.marker})
        },
        "noise_components_m": noise.surface,
        "noise_m": noise.along_normals,
    }


def _residual_table(data: Data, before: FittedModel, after: FittedModel) -> dict[str, Any]:
    rows: dict[str, list[Any]] = {"recording": [], "frame": [], "marker": [], "before_m": [], "after_m": []}
    for i, at in enumerate(heads_of(data.held)):
        trial = data.held[at]
        a, b = (vectors_of(trial, s.held_residuals[at], s.held[at].poses) for s in (before, after))
        numbers = trial.scene.recording.frame_numbers[trial.scene.frame]
        rows["recording"] += [i] * len(a)
        rows["frame"] += [int(n) for n in numbers]
        rows["marker"] += [data.robot.marker_names[m] for m in trial.scene.marker]
        rows["before_m"] += a.tolist()
        rows["after_m"] += b.tolist()
    return rows
