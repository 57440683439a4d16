"""Growth: refit the best candidates in full nonlinearity, accept one, polish it, and drop what is no longer needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense.arrays import FloatArray
from femsense.calib.fit import GIVEN_UP
from femsense.errors import FemsenseError
from femsense.loop.data import Data
from femsense.loop.few import Few, few_of
from femsense.loop.joint import JointFit, Prior, rms_of
from femsense.loop.mesh_error import mesh_errors
from femsense.loop.noise import Noise
from femsense.loop.place import POLISHED, Climbs, climbed, closer, placed
from femsense.loop.predict import sweeps_predicted
from femsense.loop.refit import EVIDENCE, FORGONE, beyond, evidence, explains, refit, tried, with_term, within, worth_of
from femsense.loop.screen import NUISANCE, Candidate, joined, linear_gain
from femsense.loop.stages import (
    Stage,
    found_in,
    held_chi2,
    held_shift,
    keeping,
    make_stage,
    own_of,
    problem_of,
    span_of,
)
from femsense.model import Robot

REFITS = 6
"""Candidates that are refitted in full nonlinearity at the first step; half as many later."""
REFITTABLE = 0.04
"""A candidate of which calibration leaves less than this is not refitted, unless it promises more than any other."""
ALIKE = 0.95
"""Candidates that promise this share of what the best does are refitted in the order of their cost: to the first refit all others are held up."""
RIVALS = 0.5
"""Those that promise this share are all fitted to some of the states first, where these spare time, and to all in the order of what they explain there."""
PROMISING = 8.0
"""Linear dBIC that a candidate needs to be refitted: what is small is nearly linear, so that a refit finds about as much."""
HINTED = 0.5
"""A richer form is tried where fields of the model without the effect promise this share of what it needs."""
ENOUGH_SPREAD = 0.5
"""Standard errors by which the prediction of left-out sweeps must get better."""
PREDICTS = 0.25
"""Share of the decrease of χ², a row, that must show on held-out rows too (unless the effect hardly acts there)."""
ABOVE_MESH = 0.5
"""An effect must move the markers by this much of what the mesh itself costs (beyond what calibration absorbs) …"""
ABOVE_MESH_IF_SURE = 0.25
"""… or by this much, if left-out sweeps speak for it by SURE standard errors and, the more of these the less, held-out data gain too."""
NOT_PLAINLY_WORSE = 1.25
"""No effect may leave so many times the plain error where fitted: it would live on a larger share of what the mesh costs."""
MOUNTED = np.radians(5.0)
"""A base is mounted as it is declared to about this angle, and a declared gravity is believed as much [rad]."""
WITHIN_REACH = 0.4
"""What has this share of the best's dBIC at its seed may be ahead of it where its place is."""
SURE = 2.5
"""Standard errors of the gain on left-out sweeps beyond which held-out data need only not speak against an effect."""

MORE_STEPS = 30
"""Steps for a refit that could win and is still on its way after the first ones."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False, slots=True)
class Refit:
    """A candidate after its joint fit."""

    candidate: Candidate
    stage: Stage
    score: float
    """dBIC of the nonlinear fit."""
    gain: float
    """Decrease of χ² less the cost: as linear scores are."""
    record: dict[str, Any]
    """What the report says of it."""
    climbs: Climbs | None = None
    """Where its place may lie instead, once that is asked."""


def grow(
    data: Data, stage: Stage, table: list[Candidate], noise: Noise, say: Progress
) -> tuple[Refit | None, list[Refit], list[dict[str, Any]]]:
    """Return the effect that comes next, or None where nothing passes; others that are as good; and what became of each candidate that was
    refitted."""
    refits: list[Refit] = []
    records: list[dict[str, Any]] = []
    listed = shortlist(table, first=not found_in(stage))
    if not listed:
        return None, [], []
    few = few_of(data, stage, noise)
    scouts = _scouted(data, few, listed, noise, say)
    for candidate in sorted(listed, key=lambda c: -scouts[id(c)][1] if id(c) in scouts else np.inf):
        ahead = [r for r in refits if r.record["verdict"] == "passes" and explains(r.stage)]
        behind = candidate.score < max((0.5 * _bar(r, candidate) for r in ahead), default=-np.inf) - EVIDENCE
        if behind and not weighs(data, candidate.effect.name):
            continue  # where little is left to explain, a refit seldom gains that much on its linear score, but for a weight that cables lift
        say(f"refitting with {candidate.effect.name}")
        record: dict[str, Any] = {"name": candidate.effect.name, "seed": candidate.seed}
        records.append(record)
        settled = _settled(data, candidate, ahead)
        try:
            scout, _ = scouts.get(id(candidate), (None, 0.0))
            behind, begin = _in_some_states(
                few, candidate, max(ahead, key=lambda r: r.score, default=None), noise, settled, scout
            )
            if behind:
                record["verdict"] = "given up: in some of the states another one explains more by far"
                continue
            others = [
                r.score for r in ahead if r.candidate.effect.name != candidate.effect.name
            ]  # what bends one form bends both
            wanted = max([EVIDENCE, *(score - 2.0 * EVIDENCE for score in others)])
            made = refit(data, stage, candidate, noise, wanted=wanted, settled=settled, begin=begin)
        except FemsenseError as error:
            record["verdict"] = f"no equilibrium: {error}"
            continue
        refits.append(judged(data, stage, candidate, made, record, noise))
    best = max((r.score for r in refits if r.record["verdict"] == "passes"), default=np.inf)
    refits = [_to_the_end(data, stage, r, noise) if r.score > 0.5 * best - EVIDENCE else r for r in refits]
    if not any(r.record["verdict"] == "passes" for r in refits):
        refits = [_elsewhere(data, stage, r, noise, say) for r in refits]
    passing = [r for r in refits if r.record["verdict"] == "passes"]
    if not passing:
        return None, [], records
    leaders = _leaders(data, stage, passing, noise, say)
    # where evidence is close, what surely predicts better
    winner = max(leaders, key=lambda r: r.score + _predicts(r) + weighs(data, r.candidate.effect.name))
    close = [r for r in leaders if r.score > winner.score - EVIDENCE]
    winner = _enriched(data, stage, winner, table, noise, say)
    winner.record["verdict"] = "named"
    ties = [r for r in close if r.candidate.effect.name != winner.candidate.effect.name]
    return winner, sorted(ties, key=lambda r: -r.score), records


def _leaders(data: Data, stage: Stage, passing: Sequence[Refit], noise: Noise, say: Progress) -> list[Refit]:
    """Return the refits that are as good as the best but for EVIDENCE, and those that their places bring ahead of these, each with its seed improved."""
    best = max(r.score for r in passing)
    near = [
        r if "seed_spread" in r.record else polished(data, stage, r, noise, say) for r in passing if r.score > best - EVIDENCE
    ]
    behind = [_with_climbs(data, stage, r, noise) for r in passing if best - EVIDENCE >= r.score > WITHIN_REACH * best]
    moved = [polished(data, stage, r, noise, say) for r in behind if _in_sight(r) > best]
    ahead = max(r.score for r in near)
    return near + [r for r in moved if r.score > ahead]


def _with_climbs(data: Data, stage: Stage, refitted: Refit, noise: Noise) -> Refit:
    """Return a refit with where its place may lie instead, if it has one."""
    places = refitted.candidate.effect.nearby(data.robot, refitted.candidate.seed)
    return replace(refitted, climbs=climbed(data, stage, refitted.candidate, noise)) if places else refitted


def _in_sight(refitted: Refit) -> float:
    """Return the dBIC of a refit where its place promises the most."""
    more = 0.0 if refitted.climbs is None else refitted.climbs.more - 1.0
    return refitted.score + more * (refitted.score + refitted.candidate.cost)


def _settled(data: Data, candidate: Candidate, ahead: Sequence[Refit]) -> bool:
    """Return whether what a refit ends with is the last word on it: others explain the data, and it has no place or time to move."""
    effect = candidate.effect
    return (
        bool(ahead)
        and not effect.nearby(data.robot, candidate.seed)
        and not effect.polish(data.robot, data.control, candidate.seed)
    )


def _scouted(data: Data, few: Few, listed: Sequence[Candidate], noise: Noise, say: Progress) -> dict[int, tuple[JointFit, float]]:
    """Return how the leading ones of a shortlist fit some of the states, with their dBIC there, each under its `id`; none of them where these do not
    tell it of all, or spare no time."""
    best = max(c.score for c in listed)
    leading = [c for c in listed if few.spares and c.score >= RIVALS * best]
    there = [own for c in leading if (own := few.candidate(c, noise)) is not None]
    if len(leading) < 2 or len(there) < len(leading):
        return {}
    scouts, lead = dict[int, tuple[JointFit, float]](), -np.inf
    for candidate, own in zip(leading, there):
        say(f"refitting with {candidate.effect.name} in some states")
        made = tried(few.data, few.stage, own, noise, max(EVIDENCE, lead - 2.0 * EVIDENCE))
        if made is None:  # where it does not fit, all states decide
            continue
        score = evidence(few.stage.fit, made.fit) - own.cost + weighs(data, candidate.effect.name)
        scouts[id(candidate)] = made.fit, score
        lead = max(lead, score) if explains(made) else lead
    return scouts


def _in_some_states(
    few: Few, candidate: Candidate, ahead: Refit | None, noise: Noise, settled: bool, scout: JointFit | None
) -> tuple[bool, JointFit | None]:
    """Return whether a candidate that is fitted in some of the states, as a scout already or now, stays as far behind another one there as ends a refit,
    where these spare time; and where that fit ended."""
    own = few.candidate(candidate, noise) if few.spares else None
    if own is None:
        return False, None
    base, wanted = few.stage.fit, -np.inf
    if ahead is not None:
        leading = few.of(ahead.stage.fit, noise)
        wanted = max(EVIDENCE, evidence(base, leading) - ahead.candidate.cost - 2.0 * EVIDENCE)
    if scout is None:
        made = tried(few.data, few.stage, own, noise, wanted, settled=settled)
        scout = None if made is None else made.fit
    if scout is None:  # where it does not fit, all states decide
        return False, None
    return scout.chi2 > worth_of(base, own, wanted, settled), scout


def _bar(ahead: Refit, candidate: Candidate) -> float:
    """Return the gain of a refit that the linear one of a candidate is held against: of another form of the same effect it is the linear one too,
    where that is smaller, since what bends one of them bends both."""
    return min(ahead.gain, ahead.candidate.score) if candidate.effect.name == ahead.candidate.effect.name else ahead.gain


def _to_the_end(data: Data, stage: Stage, refitted: Refit, noise: Noise) -> Refit:
    """Return a refit that ran out of steps on its way down with more of them: rivals are compared where each of them ends, or were when a held-out
    state does not come to rest there."""
    fit = refitted.stage.fit
    if fit.fit.status != "iterations":
        return refitted
    try:
        made = make_stage(
            data, fit.hypothesis, fit.prior, noise, fit.coordinates,
            own=own_of(refitted.stage), max_iterations=MORE_STEPS, known=fit.jets,
        )  # fmt: skip
    except FemsenseError:
        return refitted
    return judged(data, stage, refitted.candidate, made, refitted.record, noise)


def _elsewhere(data: Data, stage: Stage, refitted: Refit, noise: Noise, say: Progress) -> Refit:
    """Return a refit with evidence that does not predict as it should, judged again with its seed improved: its place may be to blame."""
    if refitted.score <= EVIDENCE or not refitted.candidate.effect.nearby(data.robot, refitted.candidate.seed):
        return refitted
    better = polished(data, stage, refitted, noise, say)
    return better if better is refitted else judged(data, stage, better.candidate, better.stage, better.record, noise)


def polished(data: Data, stage: Stage, refitted: Refit, noise: Noise, say: Progress) -> Refit:
    """Return a refit with its seed improved."""
    made = _polish(data, stage, refitted, noise, say)
    if made is refitted.stage:
        return refitted
    score = refitted.score - evidence(stage.fit, refitted.stage.fit) + evidence(stage.fit, made.fit)
    refitted.record.update({"dbic": score, "validation_rms_m": made.held_rms})
    return replace(refitted, stage=made, score=score)


def _enriched(data: Data, stage: Stage, winner: Refit, table: list[Candidate], noise: Noise, say: Progress) -> Refit:
    """Return the winner in a form with more parameters where that has EVIDENCE over the simple one."""
    winner = _with_more_markers(data, stage, winner, table, noise, say)
    least = min(REFITTABLE, winner.candidate.retained)
    for form in _forms([c for c in table if c.retained >= least], winner.candidate.effect.name):
        if len(form.parameters) <= len(winner.candidate.parameters):
            continue
        say(f"trying {form.effect.name} with {len(form.parameters)} parameters")
        made = _richer(data, stage, winner, form, noise)
        if made is None:
            continue
        rich = judged(data, stage, form, made, dict(winner.record), noise)
        if rich.record["verdict"] == "passes":
            rich = polished(data, stage, rich, noise, say)
        more = evidence(winner.stage.fit, rich.stage.fit) - (rich.candidate.cost - winner.candidate.cost)
        if rich.record["verdict"] == "passes" and more > EVIDENCE:
            winner.record.update(rich.record | {"seed": form.seed})
            winner = replace(rich, record=winner.record)
    return winner


def _with_more_markers(data: Data, stage: Stage, winner: Refit, table: list[Candidate], noise: Noise, say: Progress) -> Refit:
    """Return offsets of markers with those of further markers, one after the other, as long as each has EVIDENCE: all of them at once cost too much.
    Other effects are returned as they are."""
    alone = [c for c in table if c.effect is winner.candidate.effect] if winner.candidate.effect.name == "marker_offset" else []
    while others := [c for c in alone if not set(c.parameters) & set(winner.candidate.parameters)]:
        problem = problem_of(data, winner.stage.fit, noise)
        gains = [linear_gain(winner.stage.fit, problem, c.raw, c.seats) - c.cost for c in others]
        if max(gains) <= EVIDENCE:
            break
        form = joined(winner.candidate, others[int(np.argmax(gains))])
        say(f"trying {form.effect.name} with {len(form.parameters)} parameters")
        made = _richer(data, stage, winner, form, noise)
        if made is None:
            break
        more = judged(data, stage, form, made, dict(winner.record), noise)
        gain = evidence(winner.stage.fit, made.fit)
        if more.record["verdict"] != "passes" or gain <= form.cost - winner.candidate.cost + EVIDENCE:
            break
        winner.record.update(more.record)
        winner = replace(more, record=winner.record)
    return winner


def _richer(data: Data, stage: Stage, winner: Refit, form: Candidate, noise: Noise) -> Stage | None:
    """Return the fit of a richer form of the winner, started from the winner itself where its parameters are among those of the form."""
    settled, terms = winner.stage.fit.hypothesis.settled, winner.stage.fit.hypothesis.terms
    keys = {p.key for p in form.parameters}
    if settled != stage.fit.hypothesis.settled or not {p.key for p in terms[-1][2]} <= keys:
        return tried(data, stage, form, noise, winner.score + EVIDENCE)
    split = len(winner.stage.fit.coordinates) - len(terms[-1][2])
    found = {(p.key, p.part): float(v) for p, v in zip(terms[-1][2], winner.stage.fit.coordinates[split:])}
    own = [found.get((p.key, p.part), found.get((p.key, None), p.null)) for p in form.parameters]
    hypothesis, prior = with_term(stage.fit, form.effect, form.seed, form.parameters)
    try:
        coordinates = np.concatenate([winner.stage.fit.coordinates[:split], own])
        price = (form.cost - winner.candidate.cost + EVIDENCE - FORGONE[0]) / FORGONE[1]
        if linear_gain(winner.stage.fit, problem_of(data, winner.stage.fit, noise), form.raw, form.seats) < HINTED * price:
            return None
        worth = within(winner.stage.fit, price)
        return make_stage(data, hypothesis, prior, noise, coordinates, own=own_of(winner.stage), max_iterations=10, worth=worth)
    except FemsenseError:
        return None


def shortlist(table: list[Candidate], *, first: bool) -> list[Candidate]:
    """Return the best candidate of each name, in its simplest form (or forms, if several are equally simple), the best first; of those that promise
    as much, the simplest."""
    most = max((c.score for c in table if c.retained >= REFITTABLE), default=np.inf)
    table = [c for c in table if c.retained >= REFITTABLE or c.score > most]
    names = list(dict.fromkeys(c.effect.name for c in table if c.score > PROMISING))
    chosen: list[Candidate] = []
    for name in names[: REFITS if first else (REFITS + 1) // 2]:
        forms = _forms(table, name)
        simple = min(len(c.parameters) for c in forms)
        chosen += [c for c in forms if len(c.parameters) == simple]
    best = max((c.score for c in chosen), default=0.0)
    return sorted(chosen, key=lambda c: c.cost if c.score >= ALIKE * best else np.inf)


def _forms(table: list[Candidate], name: str) -> list[Candidate]:
    """Return the best candidate of each form of an effect (one cable or marker alone is a form of its own)."""
    best: dict[tuple[int, int], Candidate] = {}
    for candidate in table:
        if candidate.effect.name == name:
            best.setdefault((id(candidate.effect), len(candidate.parameters)), candidate)
    return list(best.values())


def judged(
    data: Data,
    stage: Stage,
    candidate: Candidate,
    made: Stage,
    record: dict[str, Any],
    noise: Noise,
) -> Refit:
    gain = evidence(stage.fit, made.fit)
    score = gain - candidate.cost - tilt_cost(data.declared, candidate, made.fit)
    better, spread = sweeps_predicted(data.train, stage.fit, made.fit)
    record |= {"dchi2": gain, "dbic": score, "validation_rms_m": made.held_rms, "cv_gain": better, "cv_spread": spread}
    held = held_chi2(data, stage, noise) - held_chi2(data, made, noise)
    acts = held_shift(
        data, stage, made, noise
    )  # what `held` is on average for the true effect, with a variance of four times that
    wanted = min(PREDICTS * gain * held_share(data), acts - 5.0 * float(np.sqrt(acts)))
    moved, mesh = moved_by(stage, made), mesh_cost(data, stage)
    record |= {"held_dchi2": held, "moved_m": moved, "mesh_cost_m": mesh, "takes_over": _taken_over(stage, made)}
    surely = better > SURE * spread
    if surely:
        wanted = min(wanted, 0.0)
    fit_objection = _objection(made, candidate, score)
    if fit_objection is None and np.isfinite(spread) and better <= ENOUGH_SPREAD * spread:
        fit_objection = f"sweeps that are left out do not speak for it ({better:+.1f} ± {spread:.1f})"
    if fit_objection is None and held < wanted:
        fit_objection = f"it does not predict the held-out data (χ² {_moves(held)} there, and falls by {gain:.1f} where fitted)"
    if fit_objection is None and score + held <= EVIDENCE:  # what was not fitted speaks against it
        fit_objection = f"too little evidence (dBIC {score:.1f}) where held-out data speak against it (χ² {_moves(held)} there)"
    least = ABOVE_MESH_IF_SURE if sure_beyond_mesh(better, spread, held, gain * held_share(data)) else ABOVE_MESH
    if fit_objection is None and moved < least * mesh:
        fit_objection = f"it moves the markers by {1e3 * moved:.3f} mm, the mesh itself by {1e3 * mesh:.3f} mm"
    if fit_objection is None and _plainly_worse(stage, made):
        fit_objection = f"the plain error grows where fitted ({1e3 * stage.fit.rms:.3f} mm, then {1e3 * made.fit.rms:.3f} mm)"
    record["verdict"] = fit_objection or "passes"
    return Refit(candidate, made, score, stage.fit.chi2 - made.fit.chi2 - candidate.cost, record)


def _moves(decrease: float) -> str:
    return f"{'falls' if decrease >= 0.0 else 'rises'} by {abs(decrease):.1f}"


def _plainly_worse(before: Stage, after: Stage) -> bool:
    """Return whether an effect makes the plain error larger where fitted, without a smaller one on held-out data."""
    return after.fit.rms > NOT_PLAINLY_WORSE * before.fit.rms and after.held_rms > before.held_rms


def tilt_cost(declared: Robot, candidate: Candidate, fit: JointFit) -> float:
    """Return −2 log of how likely it is that a declared gravity is off by the angle of the fitted one: a Student's t with four degrees."""
    own = declared.body.gravity
    mask = np.array([p.key == "vector_m_s2" for p in fit.hypothesis.parameters], dtype=bool)
    if candidate.effect.name != "gravity" or not np.any(own) or mask.sum() != 3:
        return 0.0
    vector = fit.coordinates[mask]
    angle = np.arctan2(np.linalg.norm(np.cross(own, vector)), own @ vector)
    return float(5.0 * np.log1p((angle / MOUNTED) ** 2 / 4.0))


def _predicts(refitted: Refit) -> float:
    """Return the gain on left-out sweeps less its standard error, where that is known."""
    spread = refitted.record["cv_spread"]
    return float(refitted.record["cv_gain"] - (spread if np.isfinite(spread) else 0.0))


def weighs(data: Data, name: str) -> float:
    """Return by how much dBIC an effect is ahead of its rivals beforehand: every body has weight, though the robot does not declare it."""
    return EVIDENCE if name == "gravity" and not np.any(data.declared.body.gravity) else 0.0


def sure_beyond_mesh(better: float, spread: float, held: float, expected: float) -> bool:
    """Return whether left-out sweeps (gain ± spread) and held-out data (gain, against what is expected of them) are sure together."""
    return better > SURE * spread and held * better > 2.0 * SURE * spread * expected


def _taken_over(before: Stage, after: Stage) -> list[str]:
    """Return the nuisances that are significant before an effect is added, and not after."""
    return [n for n in NUISANCE if _z(before, n) > 3.0 and _z(after, n) < 3.0]


def _z(stage: Stage, name: str) -> float:
    """Return by how many standard deviations the values of a nuisance differ from none, at most."""
    part = span_of(stage.fit, name)
    return float(np.max(np.abs(stage.fit.coordinates[part]) / np.maximum(stage.fit.std[part], 1e-300), initial=0.0))


def held_share(data: Data) -> float:
    """Return held-out rows for each fitted one."""
    return sum(len(t.scene.frame) for t in data.held) / max(sum(len(t.scene.frame) for t in data.train), 1)


def moved_by(before: Stage, after: Stage) -> float:
    """Return by how much an effect moves the markers beyond what calibration does [m], root mean square."""
    return rms_of([b.residual - a.residual for a, b in zip(after.fit.jets, before.fit.jets)])


def mesh_cost(data: Data, stage: Stage, *, whole: bool = False) -> float:
    """Return what the mesh costs beyond what calibration absorbs [m], root mean square as `rms_of` has it; 0 where it is not known.

    Not whole: beyond the share of it that all sweeps have in common, too, where there are several: what it may turn by and what sweeps add.
    """
    errors = mesh_errors(data)
    J = [np.concatenate([j.by_pose, j.by_effect], axis=2).reshape(e.size, -1) for j, e in zip(stage.fit.jets, errors)]
    fields = [t.mesh_error for t in data.train if t.mesh_error is not None]
    if whole or any(len(np.unique(t.groups.sweep)) < 2 for t in data.train):
        return rms_of([_rest(j, e.ravel()).reshape(e.shape) for j, e in zip(J, errors)]) if errors else 0.0
    left = [_rest(np.column_stack([j, e.ravel()]), f.reshape(e.size, -1)[:, 1:]) for j, e, f in zip(J, errors, fields)]
    return rms_of([np.linalg.norm(own, axis=1).reshape(e.shape) for own, e in zip(left, errors)]) if errors else 0.0


def _rest(columns: FloatArray, values: FloatArray) -> FloatArray:
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    fitted = np.linalg.lstsq(columns / scale, values, rcond=1e-9)[0]
    return np.asarray(values - columns / scale @ fitted)


def _objection(made: Stage, candidate: Candidate, score: float) -> str | None:
    """Return why an effect is not accepted, or None."""
    q = len(candidate.parameters)
    std = made.fit.std[len(made.fit.std) - q :]
    if score <= EVIDENCE and made.fit.fit.status == GIVEN_UP:
        return "given up: a step promised too little"
    if score <= EVIDENCE:
        return f"too little evidence (dBIC {score:.1f})"
    if not np.isfinite(std).all():
        return "not identifiable: the data leave a parameter open"
    edge = at_edge(made.fit)
    if candidate.effect.name in edge:
        return "acts like it, but its value lies at the edge of what is plausible"
    if edge:
        return f"with it {edge[0]} goes to the edge of what is plausible"
    return None


def at_edge(fit: JointFit, *, nuisance: bool = False) -> list[str]:
    """Return the effects, or the nuisances, with a value at the edge of what is plausible (a law's limit may be none at all)."""
    names, at = [], 0
    for effect, _, parameters in fit.hypothesis.terms:
        values = fit.coordinates[at : at + len(parameters)]
        at += len(parameters)
        low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
        beyond = (values >= high - 1e-9) | ((values <= low + 1e-9) & (low > -np.inf) & (not effect.discrete))
        if beyond.any() and (effect.name in NUISANCE) == nuisance:
            names.append(effect.name)
    return names


# --- polishing -------------------------------------------------------------------------------------------------------------


def _polish(data: Data, stage: Stage, winner: Refit, noise: Noise, say: Progress) -> Stage:
    """Return the winner with its seed (place, radius, time) improved: first seeds near by, then fitted along."""
    best, effect = winner.stage, winner.candidate.effect
    if effect.nearby(data.robot, winner.candidate.seed):
        say(f"looking near by for {effect.name}")
        climbs = winner.climbs or climbed(data, stage, winner.candidate, noise)
        best, winner.record["seed_spread"] = placed(data, stage, winner.candidate, winner.stage, climbs, noise)
    else:
        winner.record["seed_spread"] = [0.0] * len(winner.candidate.parameters)
    if not winner.candidate.parameters:
        return best
    *others, (_, seed, parameters) = best.fit.hypothesis.terms
    more = effect.polish(data.robot, data.control, seed)
    if not more:
        return best
    say(f"polishing {effect.name}")
    hypothesis = replace(best.fit.hypothesis, terms=(*others, (effect, seed, (*parameters, *more))))
    null = np.array([p.null for p in more])
    prior = Prior(np.concatenate([best.fit.prior.mean, null]), np.concatenate([best.fit.prior.std, [p.known for p in more]]))
    try:
        made = make_stage(data, hypothesis, prior, noise, np.concatenate([best.fit.coordinates, null]), own=own_of(best))
    except FemsenseError:
        return best
    inside = all(p.low + 1e-9 < v < p.high - 1e-9 for p, v in zip(more, made.fit.coordinates[-len(more) :]))
    return made if made.fit.chi2 < best.fit.chi2 - POLISHED * len(more) and inside else best


# --- pruning ---------------------------------------------------------------------------------------------------------------


def prune(data: Data, stage: Stage, noise: Noise, n_effective: float, say: Progress) -> Stage:
    """Return the stage without effects that those added later have made needless (dBIC for keeping them not above 0); the place of the last one,
    which was found beside them, then moves on."""
    whole, added = stage, found_in(stage)
    for name in added[:-1]:
        others = [n for n in stage.fit.hypothesis.names if n != name]
        count = sum(len(p) for e, _, p in stage.fit.hypothesis.terms if e.name == name)
        if not count:
            continue
        say(f"asking whether {name} is still needed")
        price = count * float(np.log(n_effective))
        try:
            without = keeping(data, stage, others, noise, worth=beyond(stage.fit, FORGONE[1] * price + FORGONE[0]))
        except FemsenseError:
            continue
        if evidence(without.fit, stage.fit) <= price:
            stage = without
    *_, (effect, seed, parameters) = stage.fit.hypothesis.terms
    places = (
        stage is not whole
        and effect.nearby(data.robot, seed)
        and len(parameters) == len(effect.parameters(data.robot, data.control))
    )
    return closer(data, stage, noise)[0] if places else stage


__all__ = [
    "ABOVE_MESH",
    "Progress",
    "Refit",
    "at_edge",
    "grow",
    "held_share",
    "judged",
    "mesh_cost",
    "moved_by",
    "polished",
    "prune",
    "shortlist",
    "sure_beyond_mesh",
    "tilt_cost",
    "weighs",
]
