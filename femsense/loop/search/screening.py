"""Screening: the decrease of χ² by each effect to first order, after calibration is projected out.

With Z the whitened columns of the nuisance parameters (poses, initial inputs, modulus, input offsets, and the effects already in the model)
and P the projector on their orthogonal complement, an effect with field s is judged by P s, as if every nuisance parameter were refitted with
it (Frisch–Waugh–Lovell theorem). ρ = |P s| / |s| is the retained share: what calibration does not absorb.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from femsense.core.arrays import FloatArray
from femsense.core.least_squares import basis_of, beside
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import spans_of
from femsense.loop.fit.fitted_model import FittedModel, problem_of
from femsense.loop.fit.joint_fit import JointFit, JointProblem
from femsense.loop.fit.noise_components import UNTOLD, Noise, estimate_noise, whiten
from femsense.loop.search.effect_fields import Fields
from femsense.loop.thresholds import DEFAULTS
from femsense.model.effects import Effect, Entry, Parameter
from femsense.model.observation import SceneJet

COLLINEAR = 0.95
"""Cosine of the angle between two fields, above which the fields are treated as equal: two places of an effect, or two effects that an
experiment does not distinguish."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """An effect with a seed (a place, radius or time that a fit cannot change), linearised at the current model."""

    effect: Effect
    seed: Entry
    parameters: tuple[Parameter, ...]
    raw: list[FloatArray]
    """Columns [m], one array (k, c, q) per trial."""
    placements: list[FloatArray]
    """Columns of the places measured by rest.csv [m], (r, 3, q) per trial."""
    columns: FloatArray
    """Whitened columns after projection, shape (N, q)."""
    response: FloatArray
    """Change of the fitted parameters per unit of each column, shape (p, q)."""
    retained: float
    """ρ, the share of the field that calibration leaves."""
    step: FloatArray
    """Best linear step from the null within the bounds, shape (q,)."""
    gain: float
    """Decrease of χ² by that step."""
    score: float
    """dBIC: gain − cost."""
    cost: float
    """BIC penalty of its parameters and of the selection of its seed, result of `penalty`."""
    smallest: FloatArray
    """Smallest detectable size of each parameter, in its coordinate, shape (q,)."""


def joined(a: Candidate, b: Candidate) -> Candidate:
    """Return two parts of an effect as one candidate; gains and costs add as if the parts were orthogonal."""
    return replace(
        a,
        parameters=(*a.parameters, *b.parameters),
        raw=[np.concatenate(pair, axis=2) for pair in zip(a.raw, b.raw)],
        placements=[np.concatenate(pair, axis=2) for pair in zip(a.placements, b.placements)],
        columns=np.hstack([a.columns, b.columns]),
        response=np.hstack([a.response, b.response]),
        retained=min(a.retained, b.retained),
        step=np.concatenate([a.step, b.step]),
        gain=a.gain + b.gain,
        score=a.score + b.score,
        cost=a.cost + b.cost,
        smallest=np.concatenate([a.smallest, b.smallest]),
    )


def penalty(count: int, seed: Entry, alone: int, effects: int, n_effective: float) -> float:
    """Return the BIC penalty of a candidate, (q + s) log n + 2 log (m a).

    q fitted parameters; the s numbers of its seed (a place, a radius, a time) are selected among many and count as parameters
    too; the selection among m effects, each for one of a cables or markers, adds 2 log (m a).
    """
    chosen = sum(int(np.size(v)) for v in seed.values() if not isinstance(v, bool) and np.asarray(v).dtype.kind in "iuf")
    return float((count + chosen) * np.log(n_effective) + 2.0 * np.log(max(effects * alone, 1)))


def screen(
    base: JointFit, problem: JointProblem, fields: Fields, n_effective: float, *, wanted: float = DEFAULTS.evidence
) -> list[Candidate]:
    """Predict the evidence (dBIC) of every candidate effect to first order, as a score test does.

    Arguments:
        base: the current fit.
        problem: its problem (trials and noise).
        fields: derivative of the residual by each effect to try, at this fit or close to it.
        n_effective: number of independent observations, for BIC.
        wanted: dBIC at which an effect counts as detectable.

    Returns:
        the candidates with their linear scores, the best first.
    """
    Q, inverse = basis_of(np.asarray(base.fit.jacobian))
    residual = base.fit.residual - Q @ (Q.T @ base.fit.residual)
    effects = max(len({e.name for e, _, _ in fields.todo}), 1)
    result = []
    every = np.split(whitened_columns(base, problem, fields.raw, fields.rest), fields._spans()[1:-1], axis=1)
    for i, (effect, seed, parameters) in enumerate(fields.todo):
        (own, rest), whole = fields.of(i), every[i]
        if not np.isfinite(whole).all() or np.linalg.norm(whole) == 0:
            continue
        absorbed = Q.T @ whole
        left = whole - Q @ absorbed
        step, gain = _whole_step(left, residual) if effect.discrete else best_step(left, residual, parameters)
        alone = sum(e is effect and len(p) == len(parameters) and s == seed for e, s, p in fields.todo)
        cost = penalty(len(parameters), seed, alone, effects, n_effective)
        retained = float(np.linalg.norm(left) / np.linalg.norm(whole))
        smallest = _smallest(left, len(parameters), n_effective, wanted)
        found = left, -inverse @ absorbed, retained, step, gain, float(gain - cost), cost, smallest
        result.append(Candidate(effect, seed, parameters, own, rest, *found))
    return sorted(result, key=lambda c: -c.score)


def linear_gain(base: JointFit, problem: JointProblem, raw: list[FloatArray], placements: list[FloatArray]) -> float:
    """Return the decrease of χ² that columns of markers and placements (see `Candidate`) predict in addition to a fit, without bounds."""
    more = basis_of(beside(np.asarray(base.fit.jacobian), whitened_columns(base, problem, raw, placements)))[0]
    return float(np.sum((more.T @ base.fit.residual) ** 2))


def whitened_columns(base: JointFit, problem: JointProblem, own: list[FloatArray], rest: list[FloatArray]) -> FloatArray:
    """Return columns of markers and placements, whitened, with zeros in the remaining rows of the fit (declared poses and priors)."""
    q = own[0].shape[2]
    result = np.zeros((len(base.fit.residual), q))
    at = 0
    for trial, factor, block, rows in zip(problem.trials, problem.factors, own, rest):
        k, s = block.shape[0] * block.shape[1], 3 * len(rows)
        result[at : at + k] = whiten(factor, block)
        result[at + k : at + k + s] = rows.reshape(s, q) / problem.placement_std
        at += k + s + 6 * len(trial.poses)
    return result


def best_step(columns: FloatArray, residual: FloatArray, parameters: Sequence[Parameter]) -> tuple[FloatArray, float]:
    """Return the bounded step with the largest decrease of χ², and that decrease."""
    null = np.array([p.null for p in parameters])
    low, high = np.array([p.low for p in parameters]) - null, np.array([p.high for p in parameters]) - null
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    low, high = np.minimum(low * scale, -1e-12), np.maximum(high * scale, 1e-12)
    answer = lsq_linear(columns / scale, -residual, bounds=(low, high))
    gain = float(residual @ residual) - float(np.sum((residual + columns / scale @ answer.x) ** 2))
    return np.asarray(answer.x / scale), gain


def _smallest(columns: FloatArray, q: int, n_effective: float, wanted: float) -> FloatArray:
    """Return the size of each parameter at which the expected dBIC reaches `wanted`."""
    needed = np.sqrt(wanted + q * np.log(n_effective))
    norm = np.linalg.norm(columns, axis=0)
    return np.asarray(np.where(norm > 0, needed / np.maximum(norm, 1e-300), np.inf))


def _whole_step(columns: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """Return the full step to a discrete alternative, and its decrease of χ²."""
    return np.ones(1), float(residual @ residual) - float(np.sum((residual + columns[:, 0]) ** 2))


def one_each(table: list[Candidate]) -> list[Candidate]:
    """Return the best candidate of each effect."""
    seen: dict[str, Candidate] = {}
    for candidate in table:
        seen.setdefault(candidate.effect.name, candidate)
    return list(seen.values())


def confounding(a: Candidate, b: Candidate) -> float:
    """Return the cosine between the field of a and the span of b after projection: the share of a that b can reproduce."""
    field = a.columns @ a.step if np.linalg.norm(a.columns @ a.step) > 0 else a.columns[:, 0]
    return float(np.linalg.norm(basis_of(b.columns)[0].T @ field) / max(float(np.linalg.norm(field)), 1e-300))


def jets_with(fitted: FittedModel, candidate: Candidate) -> list[SceneJet]:
    """Return the jets of a fitted model with the columns of a candidate appended."""
    return [
        replace(
            jet,
            by_effect=np.concatenate([jet.by_effect, own], axis=2),
            rest_by_effect=np.concatenate([jet.rest_by_effect, placements], axis=2),
        )
        for jet, own, placements in zip(fitted.fit.jets, candidate.raw, candidate.placements)
    ]


def noise_of(data: Data, fitted: FittedModel, fields: Fields | None, before: Noise | None = None) -> tuple[Noise, float]:
    """Estimate the noise from the residual of the richest linear model; return it with the effective number of observations.

    Arguments:
        data, fitted: the residual that is used.
        fields: derivatives of the residual by the effects that the model may lack; they are projected out.
            None: the whole residual of the fitted model counts as noise, markers are
            limited to the prior of their places, and `before` gives the repeatability of a marker.
        before: an earlier estimate.
    """
    own, columns = fitted.fit.own, list[FloatArray]()
    errors = [t.error_by_sweep for t in data.train]
    widest = max(0 if e is None else e.shape[2] for e in errors)
    for error, jet, span in zip(errors, fitted.fit.jets, spans_of(data.train)):
        block = np.zeros((*jet.residual.shape, own + widest))
        block[:, :, span] = np.concatenate([jet.by_pose, jet.by_initial], axis=2)
        if error is not None:
            block[:, :, own : own + error.shape[2]] = error
        columns.append(np.concatenate([block, jet.by_effect], axis=2))
    extra = _explained(data, fitted, fields)
    groups = [t.groups for t in data.train]
    noise = Noise(
        {}, "", assumed=None if before is None else before.assumed or before.std.get("white") if fields is None else None
    )
    residuals = [j.residual for j in fitted.fit.jets]
    for clouds in (False, True):
        which = [i for i, t in enumerate(data.train) if (t.scene.crossings is not None) == clouds]
        if which:
            known = None if before is None or fields is None else before.surface if clouds else before.std
            most = {"marker": data.placement_std} if fields is None and not clouds else {}
            r, nuisance, more = ([arrays[i] for i in which] for arrays in (residuals, columns, extra))
            noise = noise.joined(estimate_noise(r, nuisance, more, [groups[i] for i in which], known, most), clouds)
    return noise, float(sum(g.observations for g in groups))


def _explained(data: Data, fitted: FittedModel, fields: Fields | None) -> list[FloatArray]:
    """Return the columns of effects that a model may lack [m], (k, c, q) per trial, the best first; empty without fields."""
    shapes = [jet.residual.shape for jet in fitted.fit.jets]
    if fields is None:
        return [np.zeros((*shape, 0)) for shape in shapes]
    table = screen(fitted.fit, problem_of(data, fitted.fit, Noise({"white": UNTOLD}, "")), fields, 100.0)
    apart = _apart(table, data.thresholds.significant)
    chosen = (*apart, *(c for c in one_each(table) if not c.effect.places_markers))
    return [np.concatenate([np.zeros((*shape, 0)), *(c.raw[i] for c in chosen)], axis=2) for i, shape in enumerate(shapes)]


def _apart(table: list[Candidate], times: float) -> list[Candidate]:
    """Return the candidates that offset one marker by much more than the median offset: a misplaced marker does not show how well the others are placed."""
    alone = [c for c in table if c.effect.places_markers and len({_marker(p) for p in c.parameters}) == 1]
    size = np.array([np.linalg.norm(c.step) for c in alone])
    return [c for c, s in zip(alone, size) if s > times * np.median(size)]


def _marker(parameter: Parameter) -> str | None:
    return parameter.part[0] if isinstance(parameter.part, tuple) else None


def screen_model(data: Data, fit: JointFit, noise: Noise, fields: Fields, n_effective: float) -> list[Candidate]:
    return screen(fit, problem_of(data, fit, noise), fields, n_effective, wanted=data.thresholds.evidence)
