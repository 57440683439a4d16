"""Refits: a candidate fitted jointly with the whole model, with the full nonlinear equilibrium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.least_squares import STOPPED_EARLY
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, with_term
from femsense.loop.fit.joint_fit import FitOptions, JointFit, Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.screening import Candidate, jets_with
from femsense.model.drive import has_history
from femsense.model.effects.base import known_length
from femsense.model.observation import Hypothesis


def evidence(before: JointFit, after: JointFit) -> float:
    """Return the evidence for a larger model: Δχ², or (n − p) Δ log χ² if that is smaller, because the scale of the noise is an estimate.

    n rows, p parameters of the larger model; both are −2 log likelihood ratios, for a known and for an estimated scale.
    """
    freedom = max(len(after.fit.residual) - len(after.fit.theta), 1)
    return min(before.chi2 - after.chi2, freedom * float(np.log(before.chi2 / max(after.chi2, 1e-12))))


def within(fit: JointFit, price: float) -> float:
    """Return the χ² below which a larger model has at least the evidence `price` against a fit."""
    freedom = max(len(fit.fit.residual) - len(fit.fit.theta), 1)
    return min(fit.chi2 - price, fit.chi2 * float(np.exp(-price / freedom)))


def beyond(fit: JointFit, price: float) -> float:
    """Return the χ² above which a smaller model loses at least the evidence `price` against a fit."""
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
    """Refit: fit the whole model with one more effect, nonlinearly, from the linear step of that effect.

    Raises DataError if no start improves the fit.

    A fit whose dBIC would stay below `wanted` (by default `Thresholds.evidence`) is stopped early.
    """
    null = np.array([p.null for p in candidate.parameters])
    low, high = np.array([p.low for p in candidate.parameters]), np.array([p.high for p in candidate.parameters])
    start = null if candidate.effect.discrete else np.clip(_first_guess(candidate, null), low, high)
    hypothesis, prior = with_term(fitted.fit, candidate.effect, candidate.seed, candidate.parameters)
    directed = known_length(candidate.parameters) is not None
    free = not candidate.effect.discrete and not directed  # a vector of known length has no direction at zero
    answer = 0.0 if candidate.effect.discrete else candidate.response @ (start - null)  # change of the parameters already fitted
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
            options = FitOptions(own=theta[: fitted.fit.own], max_iterations=10, known=known, near=near, worth=worth)
            return fit_model(data, hypothesis, prior, noise, coordinates, **options)
        except DataError:
            return None

    for share in _shares(candidate, free):
        made = started_at(share)
        if made is not None and (made.fit.fit.status == STOPPED_EARLY or made.fit.chi2 <= fitted.fit.chi2 + 1.0):
            return made
    raise DataError("no start from which the fit improves")


def adds_history(fit: JointFit, candidate: Candidate, values: FloatArray) -> bool:
    """Return whether a candidate with values of shape (q,) makes states depend on earlier ones, unlike the fitted model.

    Its gain cannot be predicted by a derivative at the null, where every cable segment slides: on `arm-1` of
    `benchmarks/distinct_states.py` friction has a predicted Δχ² of 48 and an actual one of 945.
    """
    fitted, term = fit.hypothesis.robot_at(fit.coordinates), (candidate.effect, candidate.seed, candidate.parameters)
    return has_history(Hypothesis(fitted, (term,)).robot_at(values)) and not has_history(fitted)


def _shares(candidate: Candidate, free: bool) -> tuple[float | None, ...]:
    """Return the shares of the linear step from which a refit may start, in order, because the full step may be too long. None: from the declared
    values, if a discrete alternative has no equilibrium at the calibrated ones."""
    if candidate.effect.discrete:
        return (1.0, None) if candidate.gain < np.inf else (None, 1.0)
    return (0.0, 1.0, 0.3) if free else (1.0, 0.3, 0.0)


def _declared(data: Data, fitted: FittedModel, hypothesis: Hypothesis, noise: Noise) -> FloatArray:
    """Return the parameters of a fit of the declared model with a discrete alternative: its own poses and initial inputs, the prior mean for the rest."""
    alone = replace(hypothesis, terms=())
    for trial in data.train:
        if hypothesis.robot.body.mesh is not fitted.fit.hypothesis.robot.body.mesh:
            trial.starts_on(hypothesis.robot.body.mesh).clear()  # states interpolated from another mesh may have folded
    nothing = Prior(np.zeros(0), np.zeros(0))
    placed = fit_model(data, alone, nothing, noise, np.zeros(0), own=own_of(fitted))
    return np.concatenate([own_of(placed), fitted.fit.prior.mean])


def _first_guess(candidate: Candidate, null: FloatArray) -> FloatArray:
    """Return the linear step; for a vector of known length, its direction with that length."""
    start = null + candidate.step
    vector = known_length(candidate.parameters)
    if vector is not None:
        start = start / max(float(np.linalg.norm(start)), 1e-9) * vector[1].value
    return np.asarray(start)


def tried(data: Data, fitted: FittedModel, candidate: Candidate, noise: Noise, wanted: float | None = None) -> FittedModel | None:
    """Return a refit, or None if it fails."""
    try:
        return refit(data, fitted, candidate, noise, wanted=wanted)
    except FemsenseError:
        return None
