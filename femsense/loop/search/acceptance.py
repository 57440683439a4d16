"""The acceptance test: what decides that a refitted effect is added to the model."""

from __future__ import annotations

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
    """Return a refit with its evidence and its verdict: PASSES, or what speaks against it."""
    decides = data.thresholds
    gain = evidence(fitted.fit, made.fit)
    score = gain - candidate.cost - prior_cost(data.declared, candidate.effect, made.fit)
    better, std_error = sweeps_predicted(data.train, fitted.fit, made.fit)
    held = held_chi2(data, fitted, noise) - held_chi2(data, made, noise)
    # what `held` is on average for the true effect, with a variance of four times that
    acts = held_shift(data, fitted, made, noise)
    wanted = min(decides.held_gain * gain * held_share(data), acts - 2.0 * decides.significant * float(np.sqrt(acts)))
    moved, mesh = moved_by(fitted, made), discretisation_rms(data, fitted)
    fit_objection = _objection(made, candidate, score, decides)
    if fit_objection is None and np.isfinite(std_error) and better <= decides.sweeps_for * std_error:
        fit_objection = f"sweeps that are left out do not speak for it ({better:+.1f} ± {std_error:.1f})"
    if fit_objection is None and held < wanted:
        fit_objection = f"it does not predict the held-out data (χ² {_moves(held)} there, and falls by {gain:.1f} where fitted)"
    if fit_objection is None and score + held <= decides.evidence:  # what was not fitted speaks against it
        fit_objection = f"too little evidence (dBIC {score:.1f}) where held-out data speak against it (χ² {_moves(held)} there)"
    if fit_objection is None and moved < decides.above_mesh * mesh:
        fit_objection = f"it moves the markers by {1e3 * moved:.3f} mm, the mesh itself by {1e3 * mesh:.3f} mm"
    if fit_objection is None and plainly_worse(fitted, made, decides):
        fit_objection = f"the plain error grows where fitted ({1e3 * fitted.fit.rms:.3f} mm, then {1e3 * made.fit.rms:.3f} mm)"
    record = replace(
        record,
        verdict=fit_objection or PASSES,
        dchi2=gain,
        dbic=score,
        validation_rms_m=made.held_rms,
        cv_gain=better,
        cv_std=std_error,
        held_dchi2=held,
        moved_m=moved,
        mesh_cost_m=mesh,
        takes_over=_taken_over(fitted, made, decides),
    )
    return Refit(candidate, made, score, record)


def _moves(decrease: float) -> str:
    return f"{'falls' if decrease >= 0.0 else 'rises'} by {abs(decrease):.1f}"


def plainly_worse(before: FittedModel, after: FittedModel, decides: Thresholds) -> bool:
    """Return whether an effect makes the plain error larger where fitted, without a smaller one on held-out data."""
    return after.fit.rms > decides.plainly_worse * before.fit.rms and after.held_rms > before.held_rms


def prior_cost(declared: Robot, effect: Effect, fit: JointFit) -> float:
    """Return −2 log of how likely the fitted values of an effect are beforehand."""
    return effect.prior_cost(declared, fit.coordinates[span_of(fit, effect.name)])


def surely_predicts(refitted: Refit) -> float:
    """Return the gain on left-out sweeps less its standard error, where that is known."""
    gain, std = refitted.record.cv_gain, refitted.record.cv_std
    assert gain is not None and std is not None
    return gain - (std if np.isfinite(std) else 0.0)


def _taken_over(before: FittedModel, after: FittedModel, decides: Thresholds) -> tuple[str, ...]:
    """Return the nuisances that are significant before an effect is added, and not after."""
    return tuple(n for n in NUISANCE if _z(before, n) > decides.significant > _z(after, n))


def _z(fitted: FittedModel, name: str) -> float:
    """Return by how many standard deviations the values of a nuisance differ from none, at most."""
    part = span_of(fitted.fit, name)
    return float(np.max(np.abs(fitted.fit.coordinates[part]) / np.maximum(fitted.fit.std[part], 1e-300), initial=0.0))


def held_share(data: Data) -> float:
    """Return held-out rows for each fitted one."""
    return sum(len(t.scene.frame) for t in data.held) / max(sum(len(t.scene.frame) for t in data.train), 1)


def moved_by(before: FittedModel, after: FittedModel) -> float:
    """Return by how much an effect moves the markers beyond what calibration does [m], root mean square."""
    return rms_of([b.residual - a.residual for a, b in zip(after.fit.jets, before.fit.jets)])


def discretisation_rms(data: Data, fitted: FittedModel, *, whole: bool = False) -> float:
    """Return the discretisation error beyond what calibration absorbs [m], root mean square as `rms_of` has it; 0 where it is not known.

    Not whole: beyond the share of it that all sweeps have in common, too, where there are several: what it may turn by and what sweeps add.
    """
    errors = mesh_errors(data)
    J = [np.concatenate([j.by_pose, j.by_effect], axis=2).reshape(e.size, -1) for j, e in zip(fitted.fit.jets, errors)]
    fields = [t.mesh_error for t in data.train if t.mesh_error is not None]
    if whole or any(len(np.unique(t.groups.sweep)) < 2 for t in data.train):
        return rms_of([beside(j, e.ravel()).reshape(e.shape) for j, e in zip(J, errors)]) if errors else 0.0
    left = [beside(np.column_stack([j, e.ravel()]), f.reshape(e.size, -1)[:, 1:]) for j, e, f in zip(J, errors, fields)]
    return rms_of([np.linalg.norm(own, axis=1).reshape(e.shape) for own, e in zip(left, errors)]) if errors else 0.0


def _objection(made: FittedModel, candidate: Candidate, score: float, decides: Thresholds) -> str | None:
    """Return why an effect is not accepted, or None."""
    q = len(candidate.parameters)
    std = made.fit.std[len(made.fit.std) - q :]
    if score <= decides.evidence and made.fit.fit.status == STOPPED_EARLY:
        return "stopped early: the predicted gain of a step was too small"
    if score <= decides.evidence:
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
    names = []
    for effect, _, parameters, span in terms_of(fit):
        values = fit.coordinates[span]
        low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
        beyond = (values >= high - 1e-9) | ((values <= low + 1e-9) & (low > -np.inf) & (not effect.discrete))
        if beyond.any() and (effect.name in NUISANCE) == nuisance:
            names.append(effect.name)
    return names
