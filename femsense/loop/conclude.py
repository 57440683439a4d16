"""The conclusion: which effects are named, what is left, what these data cannot say, and the robot that is handed back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense.arrays import FloatArray
from femsense.effects import Entry, apply_effects
from femsense.errors import FemsenseError
from femsense.loop.advice import next_element
from femsense.loop.data import Data
from femsense.loop.evidence import KINDS, gather, own_size
from femsense.loop.grow import at_edge
from femsense.loop.joint import Trial, heads_of, normal_rms_of, rms_of, vectors_of
from femsense.loop.mesh_error import few_states, mesh_errors
from femsense.loop.noise import Noise, whiten
from femsense.loop.refit import EVIDENCE
from femsense.loop.result import LoopResult
from femsense.loop.rivals import confounded, in_words
from femsense.loop.screen import NUISANCE, TESTABLE, Candidate, one_each
from femsense.loop.search import Search
from femsense.loop.spread import spreads
from femsense.loop.stages import Stage, held_chi2, held_out, keeping, roughly_keeping, span_of, with_seeds_still, with_sizes_still
from femsense.loop.structure import beyond_mesh, describe_left, structure_tests, without_mesh_error
from femsense.loop.zeros import SIGNIFICANT, moved_nuisance, zeros_are_evident

MIN_SWEEPS = 4
"""With fewer held-out sweeps the interval of the held-out error resamples frames."""
DRAWS = 2000
NOT_WORSE = 1.02
"""What is handed back may not have a larger held-out error than the declared model, but for this factor …"""
NOISY = 1.15
"""… or, where only what calibration may move is handed back, for this one, if χ² of the held-out data says that noise hides a better model.
Three effects that were wrong would have needed it in blind cases, so that they have to do more …"""
FAR_BETTER = 50.0
"""… or, where the mesh's own error is what is larger, if χ² of the held-out data falls by so much."""
ROUNDED = 1e-6
"""What is so small beside the largest component of a vector is said as 0."""
BEYOND_NOISE = 1.2
"""Held-out errors that are so many times the noise need another reason."""
EXPLAINED = 0.8
"""Share of the excess over the noise that effects must take away where structure is left."""
GROSS = 0.03
"""Noise of more than this share of the body's reach is said to be suspicious."""
LACKS = 2.0
"""A model that is handed back may leave so many times the mean square, in units of all noise, that calibration of all nuisances leaves."""


def conclude(data: Data, search: Search, rng: np.random.Generator) -> LoopResult:
    """Return the verdict with all that the report shows."""
    before, final, noise = search.before, search.final, search.noise
    spread = spreads(data, final, noise, _seed_spread(search))
    promoted = [n for n in _promoted(data, search) if _is_sure(final, n, spread[n])]
    names = [*promoted, *(n for n, _ in search.history[1:] if n in final.fit.hypothesis.names)]
    names, back = _worth_handing_back(data, search, promoted, names)
    strayed = "stiffness" in promoted and "stiffness" not in names  # what a modulus beyond all bounds takes away is not explained
    promoted = [n for n in names if n in NUISANCE]
    entries = _entries(back, names)
    effects = _chain(data, search, promoted, names, back, spread)
    lacks = _lacks(data, back, final, noise)
    shown = back if lacks else final  # what nuisances take away unnamed is left, too
    surprise = _surprise(data, back, noise)
    plain = [without_mesh_error(t, jet.residual, noise, nor_seats=True) for t, jet in zip(data.train, shown.fit.jets)]
    tests = structure_tests(data.train, plain, rng=rng)
    excess = _excess(data, before, final, back, noise)
    found = _not_handed_back(search, names)
    structured = tests.significant and excess.left > excess.tolerated
    unexplained = lacks or (found and not effects) or ((structured or surprise) and (strayed or excess.explained < EXPLAINED))
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
        next_experiment=_next_experiment(data, final, noise, rivals, not_testable),
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


def _promoted(data: Data, search: Search) -> list[str]:
    """Return the nuisances that the data moved significantly away from what is declared; of the zeros, those that are missed."""
    names = [n for n in search.final.fit.hypothesis.names if n in NUISANCE and moved_nuisance(data, search.final, n)]
    return [n for n in names if n == "stiffness" or zeros_are_evident(data, search.final, search.noise, search.n_effective)]


def _is_sure(stage: Stage, name: str, std: FloatArray) -> bool:
    """Return whether a value of a nuisance differs from what is declared by more than SIGNIFICANT of the standard deviations that are reported."""
    return bool((np.abs(stage.fit.coordinates[span_of(stage.fit, name)]) > SIGNIFICANT * std).any())


def _worth_handing_back(data: Data, search: Search, promoted: list[str], names: list[str]) -> tuple[list[str], Stage]:
    """Return the names that are handed back with the model of just these: with the sizes that they have beside all nuisances where held-out data
    do not miss those, else fitted again. Nuisances that stay as declared are taken out, too if they only do so here, and so is, from the last one
    on, what would make the error on held-out data larger than it was, or goes to the edge of what is plausible."""
    while names:
        kept, back = _with_modulus(data, search, names, sizes_still=True)
        if back is not None and not _misses(data, search, back) and _may_be_handed_back(data, search, back):
            return kept, back
        kept, back = _with_modulus(data, search, names, sizes_still=False)
        idle = [n for n in promoted if n in names and back is not None and not moved_nuisance(data, back, n)]
        if idle:
            names = [n for n in names if n not in idle]
            continue
        if back is not None and at_edge(back.fit):
            back = _handed_back(data, with_seeds_still(data, search.final), kept, search.noise)
        if back is not None and _may_be_handed_back(data, search, back):
            return kept, back
        names = names[:-1]
    return [], search.before


def _misses(data: Data, search: Search, back: Stage) -> bool:
    """Return whether held-out data miss what the final model moves and this one does not."""
    more = held_chi2(data, back, search.noise) - held_chi2(data, search.final, search.noise)
    return back.held_rms > NOT_WORSE * search.final.held_rms or more > EVIDENCE


def _may_be_handed_back(data: Data, search: Search, back: Stage) -> bool:
    return not at_edge(back.fit) and "stiffness" not in at_edge(back.fit, nuisance=True) and _holds_out(data, search, back)


def _with_modulus(data: Data, search: Search, names: list[str], *, sizes_still: bool) -> tuple[list[str], Stage | None]:
    """Return names with the model of just these; with the modulus beside effects if it moved significantly there, by whatever share (zeros that are
    not named may have moved in its place), and held-out data miss it."""
    back = _handed_back(data, search.final, names, search.noise, sizes_still=sizes_still)
    if back is None or "stiffness" in names or not _has_effects(names):
        return names, back
    if sizes_still and not moved_nuisance(data, search.final, "stiffness", relevant=0.0):
        return names, back
    along = _handed_back(data, search.final, ["stiffness", *names], search.noise, sizes_still=sizes_still)
    if along is None or not moved_nuisance(data, search.final if sizes_still else along, "stiffness", relevant=0.0):
        return names, back
    missed = held_chi2(data, back, search.noise) - held_chi2(data, along, search.noise) > EVIDENCE
    return (["stiffness", *names], along) if missed else (names, back)


def _has_effects(names: Iterable[str]) -> bool:
    return any(name not in NUISANCE for name in names)


def _holds_out(data: Data, search: Search, back: Stage) -> bool:
    """Return whether a model is no worse on held-out data in millimetres; or else better by the noise that these data have, where it is calibrated
    only and within reason, or where the mesh's own error is all that is larger: then it must be no worse beyond that, nor in millimetres than
    the model with all that calibration may move, and not be zeros of cables alone, unless it is far better by the noise and within reason."""
    worse = back.held_rms / search.before.held_rms
    if worse <= NOT_WORSE:
        return True
    only_calibrated = not _has_effects(back.fit.hypothesis.names)
    gain = held_chi2(data, search.before, search.noise) - held_chi2(data, back, search.noise)
    if gain <= (EVIDENCE if only_calibrated else 0.0):  # effects have been judged by held-out data before
        return False
    if only_calibrated and worse <= NOISY:
        return True
    before, after = _held_beyond_mesh(data, search, back)
    zeros = only_calibrated and "cable_offset" in back.fit.hypothesis.names  # much else looks like them
    shown = not zeros and back.held_rms <= NOT_WORSE * search.base.held_rms
    return after <= NOT_WORSE * before and (shown or (gain > FAR_BETTER and worse <= NOISY))


def _held_beyond_mesh(data: Data, search: Search, back: Stage) -> tuple[float, float]:
    """Return the held-out errors before and after [m] less the likeliest share of what the mesh itself costs."""
    before, after = (beyond_mesh(data.held, s.held_residuals, search.noise) for s in (search.before, back))
    return before, after


def _handed_back(data: Data, final: Stage, names: list[str], noise: Noise, *, sizes_still: bool = False) -> Stage | None:
    """Return the model of some names alone, fitted again, or with the sizes that they have beside all that calibration may move: whoever
    calibrates what is handed back moves that too. None where it has no equilibrium, or where another effect that they were found beside is gone."""
    present = {effect.name for effect, _, _ in final.fit.hypothesis.terms}
    if present <= set(names):
        return final
    if sizes_still and not (_has_effects(names) and present <= {*names, *NUISANCE}):
        return None
    try:
        return (with_sizes_still if sizes_still else keeping)(data, final, names, noise)
    except FemsenseError:
        return None


def _entries(stage: Stage, names: list[str]) -> list[Entry]:
    """Return the tables of `[[effects]]`: those that change the mesh or the law first, then in the order in which they were found."""
    settled = [{"name": effect.name, **seed} for effect, seed in stage.fit.hypothesis.settled]
    tables = {e["name"]: e for e in stage.fit.hypothesis.entries(stage.fit.coordinates)}
    return [_rounded(e) for e in settled] + [_rounded(tables[name]) for name in names if name in tables]


def _seed_spread(search: Search) -> dict[str, FloatArray]:
    named = [r for r in search.refits if r.get("verdict") == "named" and "seed_spread" in r]
    return {r["name"]: np.array(r["seed_spread"]) for r in named}


def _chain(
    data: Data, search: Search, promoted: list[str], names: list[str], back: Stage, spread: dict[str, FloatArray]
) -> list[dict[str, Any]]:
    """Return the effects in the order in which they were added, each with the held-out error before and after it."""
    stages = dict(search.history)
    errors = []
    for i in range(len(promoted) - (names == promoted)):  # the last one's is that of what is handed back
        errors.append(_rough_error(data, stages[""], promoted[: i + 1], search.noise))
    errors += [stages[name].held_rms for name in names[len(promoted) : -1]] + [back.held_rms] * bool(names)
    return [
        {
            "name": name,
            "parameters": _parameters(spread, back, name),
            "validation_rms_before_m": b,
            "validation_rms_after_m": a,
        }
        for name, b, a in zip(names, [search.before.held_rms, *errors], errors)
    ]


def _rough_error(data: Data, stage: Stage, names: list[str], noise: Noise) -> float:
    """Return the held-out error [m] of a stage with some of its terms only, fitted to some states; its own where they have no equilibrium."""
    if set(stage.fit.hypothesis.names) <= set(names):
        return stage.held_rms
    try:
        frames = [few_states(t, len(stage.fit.hypothesis.robot.body.mesh.tets)) for t in data.train]
        rough = roughly_keeping(data, stage, names, noise, frames)
        return rms_of([h.jet.residual for h in held_out(data, rough.fit, noise)])
    except FemsenseError:
        return stage.held_rms


@dataclass(frozen=True, slots=True)
class Excess:
    """Root mean squares [m] over what is measured again and again alike, less the likeliest share of the mesh's error."""

    left: float
    """What the final model leaves beyond the noise of repetition."""
    tolerated: float
    explained: float
    """Share of the mean square beyond the noise that the effects took away: where fitted by all that was found, on held-out data by what is
    handed back; the smaller one."""


def _excess(data: Data, before: Stage, final: Stage, back: Stage, noise: Noise) -> Excess:
    axes, std = (3.0, noise.std) if noise.std else (1.0, noise.surface)
    floor = float(np.sqrt(axes * sum(v**2 for k, v in std.items() if k != "state")))
    fitted = [beyond_mesh(data.train, [j.residual for j in s.fit.jets], noise) for s in (before, final)]
    held = [beyond_mesh(data.held, s.held_residuals, noise) for s in (before, back)]
    left = float(np.sqrt(max(fitted[1] ** 2 - floor**2, 0.0)))
    return Excess(left, 0.25 * floor, min(_taken_away(fitted[0], fitted[1], floor), _taken_away(held[0], held[1], floor)))


def _lacks(data: Data, back: Stage, final: Stage, noise: Noise) -> bool:
    """Return whether what is handed back leaves much that the final model takes away with nuisances that are not named."""
    train = [_mean_square(data.train, [j.residual for j in s.fit.jets], noise) for s in (back, final)]
    held = [_mean_square(data.held, s.held_residuals, noise) for s in (back, final)]
    return any(own > LACKS * max(full, 1.0) for own, full in (train, held))


def _surprise(data: Data, back: Stage, noise: Noise) -> str:
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


def _left(data: Data, stage: Stage, noise: Noise, *, held: bool = False) -> dict[str, Any]:
    """Return what the residual of the fitted data looks like, or of the held-out data where these alone show it."""
    trials, residuals = (data.held, stage.held_residuals) if held else (data.train, [jet.residual for jet in stage.fit.jets])
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


def _rounded(entry: Entry) -> Entry:
    def tidy(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.9g}")
        if isinstance(value, list):
            return [tidy(v) for v in value]
        return {k: tidy(v) for k, v in value.items()} if isinstance(value, dict) else value

    return {k: tidy(v) for k, v in entry.items()}


def _parameters(spread: dict[str, FloatArray], back: Stage, name: str) -> dict[str, Any]:
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


def _errors(data: Data, stage: Stage, rng: np.random.Generator) -> dict[str, Any]:
    """Return the errors of a stage: of the markers, of clouds along their normals beside them; where there are no markers, twice those."""
    kind = max(r.shape[1] for r in stage.held_residuals)
    interval, by = _interval(data, stage, kind, rng)
    errors = {
        "train_rms_m": stage.fit.rms,
        "validation_rms_m": stage.held_rms,
        "validation_ci_m": interval,
        "validation_ci_by": by,
    }
    held = normal_rms_of(stage.held_residuals)
    if held is not None:
        own = interval if kind == 1 else _interval(data, stage, 1, rng)[0]
        errors |= {"train_normal_rms_m": stage.fit.normal_rms, "validation_normal_rms_m": held, "validation_normal_ci_m": own}
    return errors


def _interval(data: Data, stage: Stage, kind: int, rng: np.random.Generator) -> tuple[list[float], str]:
    """Return the 95 % interval of the held-out error of markers (kind 3) or clouds (1) [m], and what was drawn again."""
    pairs = [((r**2).sum(axis=1), t.groups) for r, t in zip(stage.held_residuals, data.held) if r.shape[1] == kind]
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
            "name": r["name"], "seed": r["seed"], "dchi2": r.get("dchi2"), "dbic": r.get("dbic"), "retained_share": None, "dbic_at_end": None,
            "refits": [o for o in refits if o["name"] == r["name"]], "verdict": _verdict_of([o for o in refits if o["name"] == r["name"]]),
        }
        for r in {r["name"]: r for r in reversed(refits) if r["name"] not in screened}.values()
    ]  # fmt: skip
    for c in one_each(first):
        joint = [r for r in refits if r["name"] == c.effect.name]
        end = last.get(c.effect.name)
        rows.append({
            "name": c.effect.name, "seed": c.seed, "dchi2": c.gain, "dbic": c.score, "retained_share": c.retained,
            "dbic_at_end": None if end is None else end.score, "refits": joint, "verdict": _verdict_of(joint) if joint else _why_not(c, end),
        })  # fmt: skip
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
            "smallest": sizes, "kind": KINDS[c.parameters[0].scale], "unit": c.parameters[0].unit, "would_be_seen": bool(seen)
        }  # fmt: skip
    return result


def _next_experiment(
    data: Data, final: Stage, noise: Noise, rivals: list[dict[str, Any]], not_testable: list[dict[str, Any]]
) -> str:
    """Return in words what to record to tell apart what these data cannot: as predicted where that is cheap, else by rule."""
    pairs = [(r["pair"][0], r["pair"][1]) for r in rivals]
    predicted = next_element(data, final.fit, noise, pairs, [r["name"] for r in not_testable])
    if predicted:
        said = [
            f"{words} ({what}: expected dBIC {round(before)} → {round(after)})" for words, what, before, after in predicted[:2]
        ]
        loaded = any(len(t.scene.recording.load_frame) for t in data.train)
        if not loaded and any(set(pair) == {"stiffness", "cable_gain"} for pair in pairs):
            said.insert(
                0,
                "hang a known weight on the robot in some frames (loads.csv): a modulus answers to it, a gain of all cables does not",
            )
        return "; or ".join(said)
    names = {n for r in rivals for n in r["pair"]} | {r["name"] for r in not_testable}
    advice = []
    recordings = [data.train[i].scene.recording for i in heads_of(data.train)]
    unloading = any(
        len(r.inputs) > 1
        and (np.diff(r.inputs, axis=0).max(initial=0.0) > 0)
        and (np.diff(r.inputs, axis=0).min(initial=0.0) < 0)
        for r in recordings
    )
    if names & {"gravity", "payload"}:
        advice.append(
            "turn the base by 90° between frames, camera fixed (gravity_*_m_s2 in frames.csv): weight then changes direction and the pose does not"
        )
    if names & {"cable_friction", "creep", "cable_slack"}:
        advice.append(
            "go up and down at several levels, and hold for a minute"
            if not unloading
            else "hold for a minute at two levels, and repeat a sweep at another speed"
        )
    if names & {"cable_gain", "cable_offset", "stiffness", "cable_stretch"}:
        advice.append("hang a known weight on the robot in some frames (loads.csv)")
    if names & {"poisson", "soft_region", "base_compliance", "hyperelastic"}:
        advice.append("add markers on opposite faces and close to the clamp, and pull opposite cables together")
    if names & {"depth_scale", "marker_offset"} and len(data.declared.marker_points):
        rest = any(r.rest is not None for r in recordings)
        advice.append("move the camera in depth" if rest else "record rest.csv: the unloaded body, and move the camera in depth")
    return "; ".join(advice)


def _sentence(
    verdict: str, effects: list[dict[str, Any]], found: list[str], before: Stage, after: Stage, noise: Noise, mesh: float | None
) -> str:
    """Return the sentence on top; `mesh` is what the mesh itself costs [m], where that is known."""
    error = f"held-out error {1e3 * before.held_rms:.2f} mm"
    if not noise.std:
        error += " along the normals of the surface"
    if verdict == "none" and before.held_rms > BEYOND_NOISE * np.hypot(noise.total, mesh or 0.0):
        costs = f", and its mesh costs {1e3 * mesh:.2f} mm" if mesh else ""
        return f"Nothing that was tried explains more of the data: {error}; their noise is {1e3 * noise.total:.2f} mm{costs}."
    if verdict == "none":
        known = f"to their noise ({1e3 * noise.total:.2f} mm)"
        if mesh and before.held_rms > BEYOND_NOISE * noise.total:
            known += f" and to what its mesh costs ({1e3 * mesh:.2f} mm; a finer one would show more)"
        return f"The model explains the data {known}: {error}."
    if verdict == "unexplained" and not effects:
        explains = "nothing that may be handed back" if found else "no effect of the list"
        small = ", though it is no larger than the noise" if before.held_rms <= noise.total else ""
        return f"A residual is left that {explains} explains{small}: {error}, noise {1e3 * noise.total:.2f} mm."
    what = ", ".join(f"{e['name']} ({_short(e['parameters'])})" for e in effects)
    tail = "" if verdict == "effects" else " A residual is left that no effect explains."
    where = "" if noise.std else " along the normals of the surface"
    return f"The model lacks {what}; held-out error{where} {1e3 * before.held_rms:.2f} mm before, {1e3 * after.held_rms:.2f} mm after.{tail}"


def _by_mesh(data: Data, search: Search, back: Stage) -> str:
    """Return a sentence on what the held-out error is beyond the mesh's own, where that is what makes it larger; nothing where it is not larger."""
    if back.held_rms <= NOT_WORSE * search.before.held_rms or not mesh_errors(data):
        return ""
    before, after = _held_beyond_mesh(data, search, back)
    return f" Less the likeliest share of what the mesh itself costs, that is {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after."


def _on_linear(data: Data, back: Stage) -> str:
    """Return a sentence on what effects that are named on a linear mesh may stand for; nothing elsewhere, or where that is an effect itself."""
    mesh = _mesh_error(data)
    if not mesh or back.fit.hypothesis.robot.body.mesh.is_quadratic or not _has_effects(back.fit.hypothesis.names):
        return ""
    return f" Linear elements cost {1e3 * mesh:.2f} mm themselves, which other effects may stand for: try discretisation too."


def _not_handed_back(search: Search, names: list[str]) -> list[str]:
    """Return the effects that were found, but are not among the names that are handed back."""
    return [n for n, _ in search.history[1:] if n not in names and n in search.final.fit.hypothesis.names]


def _evidence_for(data: Data, found: list[str]) -> str:
    """Return a sentence on effects that were found and are not handed back; nothing where there are none."""
    if not found:
        return ""
    mesh = _mesh_error(data)
    finer = f"; the mesh itself costs {1e3 * mesh:.2f} mm, and a finer one may tell" if mesh else ""
    return (
        f" There is evidence for {', '.join(found)}, but the held-out error would grow with it or a value be implausible{finer}."
    )


def _by_noise(data: Data, noise: Noise) -> str:
    """Return in words that the noise is beyond what cameras have."""
    reach = data.robot.body.reach
    if noise.total < GROSS * reach:
        return ""
    return (
        f" Noise of {1e3 * noise.total:.1f} mm on a body of {1e3 * reach:.0f} mm is no camera's: frames that should be alike are not."
        " Look whether inputs belong to their frames and names to their markers and cables."
    )


def _short(parameters: dict[str, Any]) -> str:
    def show(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}"
        if isinstance(value, list):
            largest = max((abs(v) for v in value if isinstance(v, float)), default=0.0)
            return "[" + ", ".join(show(0.0 if isinstance(v, float) and abs(v) <= ROUNDED * largest else v) for v in value) + "]"
        return ", ".join(f"{k} {show(v)}" for k, v in value.items()) if isinstance(value, dict) else str(value)

    said = {k: p for k, p in parameters.items() if k != "file"}
    return ", ".join(f"{k} {show(p['value'])}" + ("" if p["unit"] == "1" else f" {p['unit']}") for k, p in said.items())


def _card(data: Data, final: Stage, spread: dict[str, FloatArray], noise: Noise, n_effective: float) -> dict[str, Any]:
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
        "strays": [{"frame": number, "marker": name} for number, name in data.strays],
        "effective_observations": n_effective,
        "nuisance_after": nuisance,
        "seat_std_m": data.seat_std,
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


def _mesh_error(data: Data) -> float | None:
    """Return how far a finer mesh would move the markers, root mean square [m]; None where it was not computed."""
    errors = mesh_errors(data)
    return rms_of(errors) if errors else None


def _residual_table(data: Data, before: Stage, after: Stage) -> dict[str, Any]:
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


__all__ = ["Search", "conclude"]
