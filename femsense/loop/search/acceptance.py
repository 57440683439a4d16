"""The acceptance test of a refitted effect."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from femsense.core.least_squares import STOPPED_EARLY, beside
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.cross_validation import sweeps_predicted
from femsense.loop.fit.discretisation_error import mesh_errors
from femsense.loop.fit.fitted_model import FittedModel, held_chi2, held_shift, span_of, terms_of
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import PASSES, RefitRecord
from femsense.loop.search.refit import evidence
from femsense.loop.search.screening import Candidate
from femsense.loop.search.search_state import Refit
from femsense.loop.thresholds import Thresholds
from femsense.model.effects import Effect
from femsense.model.robot import Robot


def acceptance_test(
    data: Data,
    fitted: FittedModel,
    candidate: Candidate,
    made: FittedModel,
    record: RefitRecord,
    noise: Noise,
) -> Refit:
    """Decide whether an effect is accepted, from its refit (the nonlinear fit of the model with this effect): PASSES, or the first criterion that fails.

    With Δχ² the decrease of χ² in the fitted data, Δχ²_held that in the held-out data, k the BIC penalty and p the prior cost (−2 log prior density):

    1. Evidence: Δχ² − k − p > `evidence`.
    2. Parameters: identifiable, and inside their bounds.
    3. Prediction: Δχ²_held ≥ `held_gain` · Δχ² · n_held / n_fitted. A true effect has a Δχ²_held with mean s (`held_shift`) and variance 4 s; if its values
       are plausible, Δχ²_held ≥ s − 2 z √s suffices, with z = `significant`.
    4. Evidence in all data: Δχ² − k − p + Δχ²_held > `evidence`.
    5. Unweighted residual: its root mean square does not grow (`plainly_worse`).

    Names in code style are fields of `Thresholds`.

    Arguments:
        data: fitted and held-out data.
        fitted: the model without the effect.
        candidate: the effect, with its BIC penalty.
        made: the refitted model with the effect.
        record: the record of the refit, to be completed.
        noise: the noise of the measurements.

    Returns:
        the refit with its evidence and its verdict.
    """
    thresholds = data.thresholds
    gain = evidence(fitted.fit, made.fit)
    score = gain - candidate.cost - prior_cost(data.declared, candidate.effect, made.fit)
    better, std_error = sweeps_predicted(data.train, fitted.fit, made.fit)
    held = held_chi2(data, fitted, noise) - held_chi2(data, made, noise)
    wanted = thresholds.held_gain * gain * held_share(data)
    if is_plausible(data.declared, candidate.effect, made.fit):  # for a true effect `held` has mean `acts` and variance 4 · acts
        acts = held_shift(data, fitted, made, noise)
        wanted = min(wanted, acts - 2.0 * thresholds.significant * float(np.sqrt(acts)))
    fit_objection = _objection(made, candidate, score, thresholds)
    if fit_objection is None and held < wanted:
        fit_objection = (
            f"it does not predict the held-out data (χ² {_moves(held)} there, and falls by {gain:.1f} in the fitted data)"
        )
    if fit_objection is None and score + held <= thresholds.evidence:  # held-out data weaken the evidence
        fit_objection = f"too little evidence (dBIC {score:.1f}) with the held-out data (χ² {_moves(held)} there)"
    if fit_objection is None and plainly_worse(fitted, made, thresholds):
        fit_objection = (
            f"the unweighted error of the fitted data grows (from {1e3 * fitted.fit.rms:.3f} to {1e3 * made.fit.rms:.3f} mm)"
        )
    record = replace(
        record,
        verdict=fit_objection or PASSES,
        dchi2=gain,
        dbic=score,
        validation_rms_m=made.held_rms,
        cv_gain=better,
        cv_std=std_error,
        held_dchi2=held,
        takes_over=_taken_over(fitted, made, thresholds),
    )
    return Refit(candidate, made, score, record)


def _moves(decrease: float) -> str:
    return f"{'falls' if decrease >= 0.0 else 'rises'} by {abs(decrease):.1f}"


def plainly_worse(before: FittedModel, after: FittedModel, thresholds: Thresholds) -> bool:
    """Return whether an effect enlarges the unweighted rms of the fitted data beyond `plainly_worse` and does not reduce the held-out error."""
    return after.fit.rms > thresholds.plainly_worse * before.fit.rms and after.held_rms > before.held_rms


def is_plausible(declared: Robot, effect: Effect, fit: JointFit) -> bool:
    """Return whether the fitted values of an effect are plausible (`Effect.plausible`)."""
    return effect.plausible(declared, fit.coordinates[span_of(fit, effect.name)])


def eligible(data: Data, refits: Iterable[Refit], noise: Noise) -> list[Refit]:
    """Return the refits that pass and may be chosen: next to a model error that the weights include, implausible values compensate for that error; otherwise
    they are accepted if nothing plausible has passed within `evidence` of them."""
    passing = [r for r in refits if r.record.passes]
    plausible = [r for r in passing if is_plausible(data.declared, r.candidate.effect, r.fitted.fit)]
    if noise.assumed is not None:
        return plausible
    best = max((r.on_all_data for r in passing), default=0.0) - data.thresholds.evidence
    return plausible if any(r.on_all_data > best for r in plausible) else passing


def prior_cost(declared: Robot, effect: Effect, fit: JointFit) -> float:
    """Return −2 log of the prior density of the fitted values of an effect."""
    return effect.prior_cost(declared, fit.coordinates[span_of(fit, effect.name)])


def _taken_over(before: FittedModel, after: FittedModel, thresholds: Thresholds) -> tuple[str, ...]:
    """Return the nuisance effects that are significant before an effect is added, and not after."""
    return tuple(n for n in NUISANCE if _z(before, n) > thresholds.significant > _z(after, n))


def _z(fitted: FittedModel, name: str) -> float:
    """Return the largest |value| / σ of a nuisance effect."""
    part = span_of(fitted.fit, name)
    return float(np.max(np.abs(fitted.fit.coordinates[part]) / np.maximum(fitted.fit.std[part], 1e-300), initial=0.0))


def held_share(data: Data) -> float:
    """Return the number of held-out rows per fitted row."""
    return sum(len(t.scene.frame) for t in data.held) / max(sum(len(t.scene.frame) for t in data.train), 1)


def moved_by(before: FittedModel, after: FittedModel) -> float:
    """Return the rms displacement of the markers by an effect, calibration refitted [m]."""
    return rms_of([b.residual - a.residual for a, b in zip(after.fit.jets, before.fit.jets)])


def discretisation_rms(data: Data, fitted: FittedModel) -> float:
    """Return the rms discretisation error after calibration is projected out [m], as defined by `rms_of`; 0 if it is unknown."""
    errors = mesh_errors(data)
    J = [np.concatenate([j.by_pose, j.by_effect], axis=2).reshape(e.size, -1) for j, e in zip(fitted.fit.jets, errors)]
    return rms_of([beside(j, e.ravel()).reshape(e.shape) for j, e in zip(J, errors)]) if errors else 0.0


def _objection(made: FittedModel, candidate: Candidate, score: float, thresholds: Thresholds) -> str | None:
    """Return the criterion of evidence, identifiability or bounds that a fit violates, or None."""
    q = len(candidate.parameters)
    std = made.fit.std[len(made.fit.std) - q :]
    if score <= thresholds.evidence and made.fit.fit.status == STOPPED_EARLY:
        return "stopped early: the predicted gain of a step was too small"
    if score <= thresholds.evidence:
        return f"too little evidence (dBIC {score:.1f})"
    if not np.isfinite(std).all():
        return "not identifiable: the data leave a parameter open"
    edge = at_edge(made.fit)
    if candidate.effect.name in edge:
        return "fits, but its value lies at the bound of the plausible range"
    if edge:
        return f"with it {edge[0]} reaches the bound of its plausible range"
    return None


def at_edge(fit: JointFit, *, nuisance: bool = False) -> list[str]:
    """Return the effects, or the nuisances, with a value at a bound of its plausible range (a discrete alternative may take its lower one)."""
    names = []
    for effect, _, parameters, span in terms_of(fit):
        values = fit.coordinates[span]
        low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
        beyond = (values >= high - 1e-9) | ((values <= low + 1e-9) & (low > -np.inf) & (not effect.discrete))
        if beyond.any() and (effect.name in NUISANCE) == nuisance:
            names.append(effect.name)
    return names
