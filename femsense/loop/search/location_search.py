"""Location search: the place on the body at which an effect fits best, by local search over its seeds, then by fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.core.least_squares import STOPPED_EARLY
from femsense.fem.mesh import embed_points
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import (
    FittedModel,
    fit_model,
    jets_without,
    own_of,
    problem_of,
    span_at,
    with_term,
    with_values,
)
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.effect_fields import Answers, effect_fields
from femsense.loop.search.refit import beyond, evidence, tried
from femsense.loop.search.screening import COLLINEAR, Candidate, confounding, jets_with, screen
from femsense.loop.thresholds import Thresholds
from femsense.model.effects import Effect, Entry, Parameter
from femsense.model.robot import Robot

GAINS_ONLY = 100.0
"""Number of observations that is assumed when only gains are compared, which are independent of that number."""


def located(
    data: Data, fitted: FittedModel, candidate: Candidate, made: FittedModel, ends: Sequence[Candidate], noise: Noise
) -> tuple[FittedModel, list[float]]:
    """Return the best of the fits of a candidate, from its own seed (`made`) and from the end of each local search, with its seed improved; and the scatter of
    its parameters: the larger of that of `closer` and that over the places that fit equally well."""
    evident = data.thresholds.evidence
    others = _at_seeds(data, fitted, candidate.effect, candidate.parameters, [end.seed for end in ends], noise) if ends else []
    tries = [tried(data, fitted, other, noise) for other in others]
    begun = [made, *(one for one in tries if one is not None and one.fit.fit.status != STOPPED_EARLY)]
    moved = list[tuple[FittedModel, list[float]]]()
    for one in sorted(begun, key=lambda s: s.fit.chi2):
        if not moved or evidence(one.fit, moved[0][0].fit) < 2.0 * evident:
            moved.append(closer(data, one, noise))
    best, scatter = min(moved, key=lambda end: end[0].fit.chi2)
    values = [s.fit.coordinates[-len(scatter) :] for s, _ in moved if evidence(s.fit, best.fit) < evident]
    return best, np.maximum(scatter, np.std(values, axis=0)).tolist()


def climbed(data: Data, fitted: FittedModel, start: Candidate, noise: Noise) -> list[Candidate]:
    """Return the ends of the local searches from the best seeds, the best first and without the starting seed. A soft place here and a stiff one there
    can have nearly the same field if the modulus is free, so that there are several optima."""
    asked, known = list[Entry](), list[Candidate]()
    answers: list[Answers] = [{} for _ in data.train]

    def at(seeds: Sequence[Entry]) -> list[Candidate]:
        fresh = [seed for i, seed in enumerate(seeds) if seed not in seeds[:i] and seed not in asked]
        asked.extend(fresh)
        known.extend(_at_seeds(data, fitted, start.effect, start.parameters, fresh, noise, answers=answers) if fresh else [])
        return [c for c in known if c.seed in seeds]

    others = at([start.seed, *start.effect.seeds(data.robot)])
    ways = sorted(others, key=lambda c: (c.seed != start.seed, -c.gain))[: data.effort.starts]
    for _ in range(data.effort.rounds):  # in lockstep, because one factorisation serves all seeds
        around = [start.effect.nearby(data.robot, here.seed) for here in ways]
        at([seed for seeds in around for seed in seeds])
        best = [max([here, *at(seeds)], key=lambda c: c.gain) for here, seeds in zip(ways, around)]
        further = [found if found.gain >= here.gain + data.thresholds.swap else here for here, found in zip(ways, best)]
        if further == ways:
            break
        ways = further
    ends = [here for here in ways if here.seed != start.seed]
    most = max((end.gain for end in ends), default=0.0)
    apart = list[Candidate]()
    for end in sorted((end for end in ends if end.gain > 0.5 * most), key=lambda c: -c.gain):
        if not any(same_place(end, other) for other in apart):
            apart.append(end)
    return apart


def same_place(a: Candidate, b: Candidate) -> bool:
    """Return whether two places have nearly the same field with the same sign; with opposite signs (soft here, stiff there) they are different."""
    return float(a.step @ b.step) > 0.0 and confounding(a, b) >= COLLINEAR


def _scatter(seen: Sequence[Candidate], best: Candidate, fit: JointFit, thresholds: Thresholds) -> list[float]:
    """Return the standard deviation of the steps over the seeds that fit nearly as well as the best one."""
    steps = [c.step for c in seen if fit.chi2 + best.gain - c.gain <= beyond(fit, thresholds.evidence)]
    return [float(v) for v in np.std(steps, axis=0)]


def closer(data: Data, fitted: FittedModel, noise: Noise) -> tuple[FittedModel, list[float]]:
    """Return a fitted model whose last effect has moved to better neighbouring seeds, and the scatter of its parameters over the seeds that fit nearly as
    well. The seeds are compared in the fitted state: fields of the state before the effect rank the neighbours of a large effect wrongly."""
    while True:
        *_, (effect, seed, parameters) = fitted.fit.hypothesis.terms
        around = _at_seeds(data, fitted, effect, parameters, effect.nearby(data.robot, seed), noise, instead_of=-1)
        here = next((c for c in around if c.seed == seed), None)
        if here is None:  # the effect does not move these markers
            return fitted, [0.0] * len(parameters)
        best = max(around, key=lambda c: c.gain)
        scatter = _scatter(around, best, fitted.fit, data.thresholds)
        made = _moved(data, fitted, best, noise) if best.gain >= here.gain + data.thresholds.swap else None
        if made is None or made.fit.chi2 > fitted.fit.chi2 - data.thresholds.swap:
            return fitted, scatter
        fitted = made


def _at_seeds(
    data: Data,
    fitted: FittedModel,
    effect: Effect,
    parameters: tuple[Parameter, ...],
    seeds: Sequence[Entry],
    noise: Noise,
    *,
    instead_of: int | None = None,
    answers: list[Answers] | None = None,
) -> list[Candidate]:
    """Return an effect at some seeds as candidates, linearised at a fitted model; `instead_of`: the term that they replace. Their gains can be compared,
    not their scores: the number of observations has no influence."""
    fit = fitted.fit
    fields = effect_fields(fit, data.train, [(effect, seed, parameters) for seed in seeds], answers)
    base = fit if instead_of is None else without_term(fit, instead_of)
    return screen(base, problem_of(data, fit, noise), fields, GAINS_ONLY)


def without_term(fit: JointFit, i: int) -> JointFit:
    """Return a fit without one of its terms, to first order; `i` may count from the last."""
    terms, span = list(fit.hypothesis.terms), span_at(fit, i)
    columns = fit.own + np.arange(span.start, span.stop)
    J, own = np.asarray(fit.fit.jacobian), fit.coordinates[span] - np.array([p.null for p in terms[i][2]])
    residual = fit.fit.residual - J[:, columns] @ own
    del terms[i]
    less = replace(fit.fit, theta=np.delete(fit.fit.theta, columns), residual=residual, jacobian=np.delete(J, columns, axis=1))
    return replace(fit, hypothesis=replace(fit.hypothesis, terms=tuple(terms)), fit=less)


def may_lie_elsewhere(data: Data, fitted: FittedModel, name: str, noise: Noise) -> bool:
    """Return whether another seed of an accepted effect may fit better, to first order in the fitted state, with the parameters of its place excluded.
    True for effects without neighbouring seeds, for which nothing can be predicted."""
    terms = fitted.fit.hypothesis.terms
    i = [effect.name for effect, _, _ in terms].index(name)
    effect, seed, moving = terms[i]
    around = effect.nearby(data.robot, seed)
    if not around:
        return True
    own = {(p.key, p.part) for p in effect.parameters(data.robot, data.control)}
    parameters = tuple(p for p in moving if (p.key, p.part) in own)
    seen = _at_seeds(data, fitted, effect, parameters, [*effect.seeds(data.robot), *around], noise, instead_of=i)
    here = next((c for c in seen if c.seed == seed), None)
    return here is None or max(c.gain for c in seen) > here.gain + data.thresholds.swap


def _moved(data: Data, fitted: FittedModel, candidate: Candidate, noise: Noise) -> FittedModel | None:
    """Return a fitted model with the seed of its last effect replaced by that of a candidate, refitted; None if that fails."""
    fit = fitted.fit
    hypothesis, prior = with_term(fit, candidate.effect, candidate.seed, candidate.parameters, at=-1)
    start = with_values(fit, np.array([p.null for p in candidate.parameters]) + candidate.step, at=-1)
    keep = np.arange(len(fit.coordinates)) < span_at(fit, -1).start
    near = jets_with(replace(fitted, fit=replace(fit, jets=jets_without(fitted, keep))), candidate)
    try:
        return fit_model(data, hypothesis, prior, noise, start, own=own_of(fitted), near=near)
    except FemsenseError:
        return None


def lies_on_body(
    robot: Robot, parameters: Sequence[Parameter], coordinates: Sequence[float] | FloatArray, thresholds: Thresholds
) -> bool:
    """Return whether each point among parameters lies in the body at rest, or outside it by at most `relevant` of its reach. Without this bound a fit may
    place a force anywhere along its line of action."""
    places: dict[str, list[float]] = {}
    for p, v in zip(parameters, coordinates):
        if p.unit == "m" and isinstance(p.part, int):
            places.setdefault(p.key, []).append(p.value(float(v)))
    points = np.array([place for place in places.values() if len(place) == 3]).reshape(-1, 3)
    most = thresholds.relevant * robot.body.reach
    return not len(points) or bool((embed_points(robot.body.mesh, points).outside <= most).all())
