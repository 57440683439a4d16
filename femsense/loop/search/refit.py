"""Refits: a candidate fitted together with all that the model has, in full nonlinearity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.least_squares import STOPPED_EARLY
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of
from femsense.loop.fit.joint_fit import FitHow, JointFit, Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.screening import Candidate, jets_with
from femsense.model.drive import has_history
from femsense.model.effects import Effect, Entry, Parameter
from femsense.model.effects.base import known_length
from femsense.model.observation import Hypothesis


def evidence(before: JointFit, after: JointFit) -> float:
    """Return the decrease of χ², or that of (rows − parameters) log χ² where it is smaller: the scale of the noise is an estimate too."""
    freedom = max(len(after.fit.residual) - len(after.fit.theta), 1)
    return min(before.chi2 - after.chi2, freedom * float(np.log(before.chi2 / max(after.chi2, 1e-12))))


def within(fit: JointFit, price: float) -> float:
    """Return the χ² below which a model with something more is better than a fit by so much evidence."""
    freedom = max(len(fit.fit.residual) - len(fit.fit.theta), 1)
    return min(fit.chi2 - price, fit.chi2 * float(np.exp(-price / freedom)))


def beyond(fit: JointFit, price: float) -> float:
    """Return the χ² beyond which a model without something is worse than a fit by so much evidence."""
    freedom = max(len(fit.fit.residual) - len(fit.fit.theta), 1)
    return fit.chi2 * float(np.exp(price / freedom)) + price


def refit(
    data: Data,
    fitted: FittedModel,
    candidate: Candidate,
    noise: Noise,
    *,
    wanted: float | None = None,
) -> FittedModel:
    """Joint fit with one more effect, started from its linear step. Raises DataError where no start helps.

    Where the dBIC would stay below what is wanted (by default `Thresholds.evidence`), the fit is stopped early on its way.
    """
    null = np.array([p.null for p in candidate.parameters])
    low, high = np.array([p.low for p in candidate.parameters]), np.array([p.high for p in candidate.parameters])
    start = null if candidate.effect.discrete else np.clip(_first_guess(candidate, null), low, high)
    hypothesis, prior = with_term(fitted.fit, candidate.effect, candidate.seed, candidate.parameters)
    directed = known_length(candidate.parameters) is not None
    free = not candidate.effect.discrete and not directed  # for these the null is no start
    answer = 0.0 if candidate.effect.discrete else candidate.response @ (start - null)  # of what is fitted already
    worth = within(fitted.fit, candidate.cost + (data.thresholds.evidence if wanted is None else wanted))
    if adds_history(fitted.fit, candidate, start):
        worth = np.inf

    def started_at(share: float | None) -> FittedModel | None:
        part = 1.0 if share is None else share
        known = jets_with(fitted, candidate) if free and share == 0.0 else None
        near = fitted.fit.jets if not candidate.parameters and share is not None else None
        try:
            theta = _declared(data, fitted, hypothesis, noise) if share is None else fitted.fit.fit.theta + share * answer
            coordinates = np.concatenate([theta[fitted.fit.own :], null + part * (start - null)])
            how = FitHow(own=theta[: fitted.fit.own], max_iterations=10, known=known, near=near, worth=worth)
            return fit_model(data, hypothesis, prior, noise, coordinates, **how)
        except DataError:
            return None

    for share in _shares(candidate, free):
        made = started_at(share)
        if made is not None and (made.fit.fit.status == STOPPED_EARLY or made.fit.chi2 <= fitted.fit.chi2 + 1.0):
            return made
    raise DataError("no start from which the fit improves")


def adds_history(fit: JointFit, candidate: Candidate, values: FloatArray) -> bool:
    """Return whether a candidate with such values, shape (q,), makes states depend on those before, as none of the fit does.

    What it explains is then told by no derivative at its null, where every segment of a cable slides: on `arm-1` of
    `benchmarks/distinct_states.py` friction has a predicted gain of 48 in χ² and brings 945.
    """
    fitted, term = fit.hypothesis.robot_at(fit.coordinates), (candidate.effect, candidate.seed, candidate.parameters)
    return has_history(Hypothesis(fitted, (term,)).robot_at(values)) and not has_history(fitted)


def _shares(candidate: Candidate, free: bool) -> tuple[float | None, ...]:
    """Return the shares of the linear step from which a refit may start, in order: that step may go too far. None: from what is declared, where a
    discrete alternative does not fit from where calibration has gone without it."""
    if candidate.effect.discrete:
        return (1.0, None) if candidate.gain < np.inf else (None, 1.0)
    return (0.0, 1.0, 0.3) if free else (1.0, 0.3, 0.0)


def _declared(data: Data, fitted: FittedModel, hypothesis: Hypothesis, noise: Noise) -> FloatArray:
    """Return where an effect starts if what is fitted stays as declared: with its own poses and initial inputs."""
    alone = replace(hypothesis, terms=())
    for trial in data.train:
        if hypothesis.robot.body.mesh is not fitted.fit.hypothesis.robot.body.mesh:
            trial.starts_on(hypothesis.robot.body.mesh).clear()  # states that were carried there from elsewhere may have folded
    nothing = Prior(np.zeros(0), np.zeros(0))
    placed = fit_model(data, alone, nothing, noise, np.zeros(0), own=own_of(fitted))
    return np.concatenate([own_of(placed), fitted.fit.prior.mean])


def with_term(fit: JointFit, effect: Effect, seed: Entry, parameters: tuple[Parameter, ...]) -> tuple[Hypothesis, Prior]:
    """Return the hypothesis of a fit with one more effect, and its prior."""
    old = fit.hypothesis
    if not parameters:
        settled = (*old.settled, (effect, seed))
        return replace(old, robot=effect.apply(old.robot, seed), settled=settled), fit.prior
    null = np.array([p.null for p in parameters])
    prior = Prior(np.concatenate([fit.prior.mean, null]), np.concatenate([fit.prior.std, [p.known for p in parameters]]))
    return replace(old, terms=(*old.terms, (effect, seed, parameters))), prior


def _first_guess(candidate: Candidate, null: FloatArray) -> FloatArray:
    """Return the linear step; of a vector of known length its direction with that length."""
    start = null + candidate.step
    vector = known_length(candidate.parameters)
    if vector is not None:
        start = start / max(float(np.linalg.norm(start)), 1e-9) * vector[1].value
    return np.asarray(start)


def tried(data: Data, fitted: FittedModel, candidate: Candidate, noise: Noise, wanted: float | None = None) -> FittedModel | None:
    """Return a refit, or None where there is none."""
    try:
        return refit(data, fitted, candidate, noise, wanted=wanted)
    except FemsenseError:
        return None
