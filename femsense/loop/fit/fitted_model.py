"""Fitted models: a joint fit with its held-out error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.loop.data.dataset import MESH, NUISANCE, Data, groups_of, surface_of
from femsense.loop.data.surface_rows import make_rows, renewed_rows
from femsense.loop.data.trial import Trial, rms_of, spans_of
from femsense.loop.fit.joint_fit import FitOptions, JointFit, JointProblem, Prior, fit_jointly
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.model.as_it_is import evaluate_robot
from femsense.model.effects import Effect, Entry, Parameter, by_session, find_effect
from femsense.model.effects.base import range_units
from femsense.model.observation import Hypothesis, SceneJet, Term
from femsense.model.robot import Robot

ROUGHLY = 4
"""Number of steps of a rough fit, for example one whose residual is only used to estimate the noise."""


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """The prediction of a held-out trial."""

    jet: SceneJet
    """Residuals and states, without derivatives."""
    poses: list[FloatArray]


@dataclass(frozen=True, eq=False, slots=True)
class FittedModel:
    """A fitted model with its held-out error."""

    fit: JointFit
    held: list[HeldOut]
    held_rms: float

    @property
    def held_residuals(self) -> list[FloatArray]:
        """Residuals of the held-out data [m], (k, c) per trial."""
        return [h.jet.residual for h in self.held]


def with_nuisance(data: Data, robot: Robot | None = None) -> tuple[Hypothesis, Prior]:
    """Return a robot, by default that of the data, with the nuisance effects: the modulus and, if the inputs are absolute, the input offsets. With a
    reference there are none."""
    terms: list[Term] = []
    std: list[float] = []
    for name in () if data.relative else NUISANCE:
        effect, seed = by_session(find_effect(name), [t.scene.recording for t in data.train])
        parameters = effect.parameters(data.robot, data.control)
        unknown_zero = any(t.initial is not None for t in data.train)
        if effect.calibrated is None or not parameters or (effect.calibrated.of_inputs and unknown_zero):
            continue
        terms.append((effect, seed, parameters))
        std += [
            max(effect.calibrated.std * u, 1e-9) for u in range_units(parameters, data.robot.body.cable_names, data.input_scale)
        ]
    body = data.robot if robot is None else robot
    settled = data.settled if body is data.robot else ()
    return Hypothesis(body, tuple(terms), settled), Prior(np.zeros(len(std)), np.array(std))


def fit_model(
    data: Data,
    hypothesis: Hypothesis,
    prior: Prior,
    noise: Noise,
    coordinates: FloatArray,
    **options: Unpack[FitOptions],
) -> FittedModel:
    """Fit a hypothesis to the data and predict the held-out data; the arguments are those of `fit_jointly`."""
    fit = fit_jointly(hypothesis, prior, data.train, noise, data.placement_std, coordinates, **options)
    held = held_out(data, fit, noise)
    return FittedModel(fit, held, rms_of([h.jet.residual for h in held]) if held else float("nan"))


def jets_without(fitted: FittedModel, keep: BoolArray) -> list[SceneJet]:
    """Return the jets of a fitted model with the columns of some coordinates."""
    return [replace(j, by_effect=j.by_effect[:, :, keep], rest_by_effect=j.rest_by_effect[:, :, keep]) for j in fitted.fit.jets]


def keeping(data: Data, fitted: FittedModel, names: Sequence[str], noise: Noise, *, worth: float = np.inf) -> FittedModel:
    """Return a fitted model with some of its terms, refitted (roughly if χ² stays above `worth`). Raises DataError."""
    hypothesis, prior, mask = some_terms(fitted, names)
    start, near = fitted.fit.coordinates[mask], jets_without(fitted, mask)
    return fit_model(data, hypothesis, prior, noise, start, own=own_of(fitted), near=near, worth=worth)


def with_seeds_still(data: Data, fitted: FittedModel) -> FittedModel:
    """Return a fitted model whose fitted places and times become part of the seeds, at their current values.

    A time constant of which the data contain only the beginning would otherwise drift to the end of its range when the rest is refitted.
    """
    fit, terms, keep = fitted.fit, list[Term](), list[bool]()
    for (effect, seed, parameters), entry in zip(fit.hypothesis.terms, fit.hypothesis.entries(fit.coordinates)):
        own = {p.key for p in effect.parameters(data.robot, data.control)}
        mask = [p.key in own for p in parameters]
        still = {p.key: entry[p.key] for p, kept in zip(parameters, mask) if not kept}
        terms.append((effect, {**seed, **still}, tuple(p for p, kept in zip(parameters, mask) if kept)))
        keep += mask
    kept = np.array(keep, dtype=bool)
    theta = np.concatenate([fit.fit.theta[: fit.own], fit.coordinates[kept]])
    others = fit.prior.others
    others = None if others is None else others.keeping(kept[: others.matrix.shape[1]], fit.coordinates)
    prior = Prior(fit.prior.mean[kept], fit.prior.std[kept], others)
    less = replace(
        fit,
        hypothesis=replace(fit.hypothesis, terms=tuple(terms)),
        prior=prior,
        fit=replace(fit.fit, theta=theta),
        jets=jets_without(fitted, kept),
    )
    return replace(fitted, fit=less)


def some_terms(fitted: FittedModel, names: Sequence[str]) -> tuple[Hypothesis, Prior, BoolArray]:
    """Return the hypothesis and prior of a fitted model with some of its terms, and the mask of their coordinates."""
    terms = fitted.fit.hypothesis.terms
    mask = np.concatenate([np.full(len(p), e.name in names) for e, _, p in terms]) if terms else np.zeros(0, dtype=bool)
    hypothesis = replace(fitted.fit.hypothesis, terms=tuple(t for t in terms if t[0].name in names))
    others, null = fitted.fit.prior.others, np.array([p.null for p in fitted.fit.hypothesis.parameters])
    others = None if others is None else others.keeping(mask[: others.matrix.shape[1]], null)
    return hypothesis, Prior(fitted.fit.prior.mean[mask], fitted.fit.prior.std[mask], others), mask


def without_effect(data: Data, fitted: FittedModel, name: str, noise: Noise, *, worth: float = np.inf) -> FittedModel:
    """Return a fitted model without one of its effects, all other parameters refitted."""
    return keeping(data, fitted, [n for n in fitted.fit.hypothesis.names if n != name], noise, worth=worth)


def with_term(
    fit: JointFit, effect: Effect, seed: Entry, parameters: tuple[Parameter, ...], *, at: int | None = None
) -> tuple[Hypothesis, Prior]:
    """Return the hypothesis of a fit with one more term, or with another one in place of its `at`-th, and its prior.

    A term without parameters is applied to the robot.
    """
    old, prior = fit.hypothesis, fit.prior
    if not parameters:
        return replace(old, robot=effect.apply(old.robot, seed), settled=(*old.settled, (effect, seed))), prior
    i, span = len(old.terms) if at is None else at % len(old.terms), span_at(fit, at)
    mean, std = (
        np.concatenate([values[: span.start], own, values[span.stop :]])
        for values, own in ((prior.mean, [p.null for p in parameters]), (prior.std, [p.known for p in parameters]))
    )
    return replace(old, terms=(*old.terms[:i], (effect, seed, parameters), *old.terms[i + 1 :])), Prior(mean, std)


def with_values(fit: JointFit, values: Sequence[float] | FloatArray, *, at: int | None = None) -> FloatArray:
    """Return the coordinates of a fit with those of one more term, or of another term that replaces its `at`-th."""
    span = span_at(fit, at)
    return np.concatenate([fit.coordinates[: span.start], values, fit.coordinates[span.stop :]])


def roughly_keeping(
    data: Data, fitted: FittedModel, names: Sequence[str], noise: Noise, frames: Sequence[IntArray]
) -> FittedModel:
    """Return a fitted model with some of its terms, refitted in a few steps to some frames of each trial, without held-out data. Raises DataError."""
    hypothesis, prior, mask = some_terms(fitted, names)
    part = replace(data, train=[t.part(f) for t, f in zip(data.train, frames)], held=[], held_of=[])
    return fit_model(part, hypothesis, prior, noise, fitted.fit.coordinates[mask], own=own_of(fitted), max_iterations=ROUGHLY)


def found_in(fitted: FittedModel) -> list[str]:
    """Return the effects of a fitted model, without nuisance effects and quadratic elements."""
    return [name for name in fitted.fit.hypothesis.names if name not in (*NUISANCE, MESH.name)]


def terms_of(fit: JointFit) -> Iterator[tuple[Effect, Entry, tuple[Parameter, ...], slice]]:
    """Yield each effect of a fit with its seed, its parameters, and the slice of its coordinates."""
    at = 0
    for effect, seed, parameters in fit.hypothesis.terms:
        yield effect, seed, parameters, slice(at, at + len(parameters))
        at += len(parameters)


def span_of(fit: JointFit, name: str) -> slice:
    """Return the slice of an effect's coordinates in a fit; empty if the fit lacks it."""
    return next((span for effect, _, _, span in terms_of(fit) if effect.name == name), slice(0, 0))


def span_at(fit: JointFit, at: int | None) -> slice:
    """Return the slice of the coordinates of the `at`-th term, which may count from the last; None: of one that follows the last."""
    end = len(fit.coordinates)
    return slice(end, end) if at is None else [span for *_, span in terms_of(fit)][at]


def own_of(fitted: FittedModel) -> FloatArray:
    return np.array(fitted.fit.fit.theta[: fitted.fit.own])


def held_out(data: Data, fit: JointFit, noise: Noise) -> list[HeldOut]:
    """Return the predictions of the held-out trials; a held-out recording gets its own pose, fitted to its first frames."""
    robot = fit.hypothesis.robot_at(fit.coordinates)
    result: list[HeldOut] = []
    for trial, (poses, initial) in zip(data.held, held_poses_and_inputs(data, fit, noise)):
        jet = evaluate_robot(robot, trial.scene, poses, initial, trial.starts_on(robot.body.mesh))
        result.append(HeldOut(jet, list(poses)))
    return result


PosesAndInputs = tuple[list[FloatArray], FloatArray | None]
"""Poses of the cameras, and initial inputs where they are unknown."""


def held_poses_and_inputs(data: Data, fit: JointFit, noise: Noise) -> list[PosesAndInputs]:
    """Return poses and initial inputs of each held-out trial: those of its recording, or its own from its first frames."""
    train, result = poses_and_inputs(data, fit), list[PosesAndInputs]()
    robot = fit.hypothesis.robot_at(fit.coordinates)
    for i, (trial, of) in enumerate(zip(data.held, data.held_of)):
        if of is not None:
            result.append(train[of])
        elif trial.together:
            result.append(result[-1])
        else:
            both = [trial, *(t for t in data.held[i + 1 : i + 2] if t.together)]
            result.append(_pose_on_first_frames(robot, both, noise, data.placement_std, data.robot.marker_points.mean(axis=0)))
    return result


def _pose_on_first_frames(
    robot: Robot, trials: list[Trial], noise: Noise, placement_std: float, pivot: FloatArray
) -> PosesAndInputs:
    frames = np.unique(np.concatenate([t.scene.frames for t in trials]))
    cases = frames[: max(1, round(0.2 * len(frames)))]
    first = [t.part(cases) for t in trials if np.isin(t.scene.frames, cases).any()]
    first = [replace(t, together=bool(i)) for i, t in enumerate(first)]
    fit = fit_jointly(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), first, noise, placement_std, np.zeros(0))
    return first[0].place(fit.fit.theta, pivot)


def poses_and_inputs(data: Data, fit: JointFit) -> list[PosesAndInputs]:
    """Return poses and initial inputs of each training trial in a fit."""
    pivot = data.robot.marker_points.mean(axis=0)
    return [t.place(fit.fit.theta[span], pivot) for t, span in zip(data.train, spans_of(data.train))]


def rematched(data: Data, fitted: FittedModel, noise: Noise, *, reselect: bool = False) -> Data:
    """Return the data with the rounding of cloud rows recomputed in the states of a fitted model; with `reselect` the rows are selected again too."""
    if "clouds" not in data.measured:
        return data
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    train = [_rematched(robot, t, *own, reselect) for t, own in zip(data.train, poses_and_inputs(data, fitted.fit))]
    held = [_rematched(robot, t, *own, reselect) for t, own in zip(data.held, held_poses_and_inputs(data, fitted.fit, noise))]
    return replace(data, train=train, held=held)


def _rematched(robot: Robot, trial: Trial, poses: list[FloatArray], initial: FloatArray | None, reselect: bool) -> Trial:
    if trial.seen is None:
        return trial
    states = evaluate_robot(robot, trial.scene, poses, initial, trial.starts_on(robot.body.mesh)).states
    if not reselect:
        return replace(trial, scene=renewed_rows(robot, trial.scene, trial.seen, states, poses))
    scene = make_rows(robot, trial.scene, trial.seen, states, poses)
    return replace(trial, scene=scene, groups=groups_of(scene, trial.frames, surface_of(robot, scene, poses)), mesh_error=None)


def whitened(trial: Trial, residual: FloatArray, noise: Noise) -> FloatArray:
    """Return whitened rows of a trial, (k, c, …) → (c k, …)."""
    return whiten(noise.whitener(trial.groups, trial.mesh_error), residual)


def held_chi2(data: Data, fitted: FittedModel, noise: Noise) -> float:
    """Return the whitened sum of squares of the held-out residuals."""
    return float(sum((whitened(t, r, noise) ** 2).sum() for t, r in zip(data.held, fitted.held_residuals)))


def mean_square(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> float:
    """Return the mean square of whitened residuals; its expectation is 1 for noise."""
    rows = [whitened(t, r, noise) for t, r in zip(trials, residuals)]
    return float(np.mean(np.concatenate(rows, axis=None) ** 2)) if rows else 0.0


def held_shift(data: Data, before: FittedModel, after: FittedModel, noise: Noise) -> float:
    """Return the whitened sum of squares of the difference between two models on held-out data."""
    pairs = zip(before.held_residuals, after.held_residuals)
    return float(sum((whitened(t, b - a, noise) ** 2).sum() for t, (b, a) in zip(data.held, pairs)))


def problem_of(data: Data, fit: JointFit, noise: Noise) -> JointProblem:
    return JointProblem(fit.hypothesis, fit.prior, data.train, noise.whiteners(data.train), data.placement_std)
