"""Stages: a model, fitted jointly, with its error on held-out data, its noise and the fields of what it may lack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from femsense.arrays import BoolArray, FloatArray
from femsense.calib.forward import Hypothesis, SceneJet, evaluate_scene
from femsense.effects import Effect, Entry, Parameter, find_effect
from femsense.loop.data import Data, groups_of
from femsense.loop.joint import JointFit, JointProblem, Prior, Trial, fit_jointly, rms_of
from femsense.loop.noise import Noise, estimate_noise, whiten
from femsense.loop.screen import NUISANCE, Candidate, Fields, candidates_for, effect_fields, one_each, screen
from femsense.model import Robot


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """What a model makes of a held-out trial."""

    jet: SceneJet
    """Residuals and states, no derivatives."""
    poses: list[FloatArray]


@dataclass(frozen=True, eq=False, slots=True)
class Stage:
    """A model with its fit and its error on held-out data."""

    fit: JointFit
    held: list[HeldOut]
    held_rms: float

    @property
    def held_residuals(self) -> list[FloatArray]:
        """Residuals of the held-out data [m], (k, 3) a trial."""
        return [h.jet.residual for h in self.held]


def with_nuisance(data: Data) -> tuple[Hypothesis, Prior]:
    """Return the declared model with what is always fitted along: the modulus and, where inputs are absolute, the cables' zeros."""
    terms: list[tuple[Effect, Entry, tuple[Parameter, ...]]] = []
    std: list[float] = []
    for name in NUISANCE:
        effect = find_effect(name)
        parameters = effect.parameters(data.robot, data.control)
        unknown_zero = any(t.initial is not None for t in data.train)
        if not parameters or (name == "cable_offset" and unknown_zero):
            continue
        terms.append((effect, {}, parameters))
        std += [0.7] if name == "stiffness" else [max(0.25 * float(s), 1e-9) for s in data.input_scale]
    return Hypothesis(data.robot, tuple(terms)), Prior(np.zeros(len(std)), np.array(std))


def make_stage(
    data: Data,
    hypothesis: Hypothesis,
    prior: Prior,
    noise: Noise,
    coordinates: FloatArray,
    *,
    own: FloatArray | None = None,
    max_iterations: int = 12,
    known: list[SceneJet] | None = None,
    near: list[SceneJet] | None = None,
) -> Stage:
    """Return the fit of a hypothesis and what it makes of the held-out data; arguments as of `fit_jointly`."""
    fit = fit_jointly(
        hypothesis, prior, data.train, noise, data.seat_std, coordinates,
        own=own, max_iterations=max_iterations, known=known, near=near,
    )  # fmt: skip
    held = held_out(data, fit, noise)
    return Stage(fit, held, rms_of([h.jet.residual for h in held]))


def jets_with(stage: Stage, candidate: Candidate) -> list[SceneJet]:
    """Return the jets of a stage with the columns of a candidate behind the others."""
    return [
        replace(
            jet,
            by_effect=np.concatenate([jet.by_effect, own], axis=2),
            rest_by_effect=np.concatenate([jet.rest_by_effect, seats], axis=2),
        )
        for jet, own, seats in zip(stage.fit.jets, candidate.raw, candidate.seats)
    ]


def jets_without(stage: Stage, keep: BoolArray) -> list[SceneJet]:
    """Return the jets of a stage with the columns of some coordinates only."""
    return [replace(j, by_effect=j.by_effect[:, :, keep], rest_by_effect=j.rest_by_effect[:, :, keep]) for j in stage.fit.jets]


def own_of(stage: Stage) -> FloatArray:
    return np.array(stage.fit.fit.theta[: stage.fit.own])


def held_out(data: Data, fit: JointFit, noise: Noise) -> list[HeldOut]:
    """Return what a fit makes of each held-out trial; a recording of its own gets its own pose from its first frames."""
    robot = fit.hypothesis.robot_at(fit.coordinates)
    plain, pivot = Hypothesis(robot), data.robot.marker_points.mean(axis=0)
    spans = np.cumsum([0, *(t.size for t in data.train)])
    result = []
    for trial, of in zip(data.held, data.held_of):
        if of is not None:
            poses, initial = data.train[of].place(fit.fit.theta[spans[of] : spans[of + 1]], pivot)
        else:
            poses, initial = _pose_on_first_frames(robot, trial, noise, data.seat_std, pivot)
        jet = evaluate_scene(
            plain,
            trial.scene,
            np.zeros(0),
            poses,
            initial,
            derivative=False,
            vary_initial=False,
            pivot=pivot,
            starts=trial.starts_on(robot.body.mesh),
        )
        result.append(HeldOut(jet, list(poses)))
    return result


def _pose_on_first_frames(
    robot: Robot, trial: Trial, noise: Noise, seat_std: float, pivot: FloatArray
) -> tuple[list[FloatArray], FloatArray | None]:
    frames = trial.scene.frames
    scene = trial.scene.pick(frames[: max(1, round(0.2 * len(frames)))])
    first = replace(trial, scene=scene, groups=groups_of(scene), starts={}, mesh_error=None)
    fit = fit_jointly(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [first], noise, seat_std, np.zeros(0))
    return first.place(fit.fit.theta, pivot)


def fields_of(data: Data, stage: Stage, names: Sequence[str]) -> Fields:
    """Return what each effect that is not in the model yet would do to the markers."""
    seated = any(len(t.scene.rest_marker) for t in data.train)
    todo = candidates_for(
        stage.fit, data.control, forms=data.forms, names=[n for n in names if n not in NUISANCE], has_seats=seated
    )
    return effect_fields(stage.fit, data.train, todo)


def placed(data: Data, fit: JointFit) -> list[tuple[list[FloatArray], FloatArray | None]]:
    """Return poses and initial inputs of each training trial at a fit."""
    pivot = data.robot.marker_points.mean(axis=0)
    spans = np.cumsum([0, *(t.size for t in data.train)])
    return [t.place(fit.fit.theta[a:b], pivot) for t, (a, b) in zip(data.train, pairwise(spans))]


def held_chi2(data: Data, stage: Stage, noise: Noise) -> float:
    """Return the whitened sum of squares of the held-out residuals."""
    return float(
        sum((whiten(noise.whitener(t.groups, t.mesh_error), r) ** 2).sum() for t, r in zip(data.held, stage.held_residuals))
    )


def problem_of(data: Data, fit: JointFit, noise: Noise) -> JointProblem:
    return JointProblem(
        fit.hypothesis, fit.prior, data.train, [noise.whitener(t.groups, t.mesh_error) for t in data.train], data.seat_std
    )


def noise_of(data: Data, stage: Stage, fields: Fields) -> tuple[Noise, float]:
    """Estimate the noise from what the richest linear model leaves; return it with the effective number of observations."""
    table = screen(stage.fit, problem_of(data, stage.fit, Noise({"white": 5e-4}, "")), fields, 100.0)
    own = sum(t.size for t in data.train)
    widest = max(0 if t.mesh_error is None else t.mesh_error.shape[2] for t in data.train)
    columns, extra, at = [], [], 0
    for i, (trial, jet) in enumerate(zip(data.train, stage.fit.jets)):
        k = len(jet.residual)
        block = np.zeros((k, 3, own + widest))
        block[:, :, at : at + 6 * len(trial.poses)] = jet.by_pose
        block[:, :, at + 6 * len(trial.poses) : at + trial.size] = jet.by_initial
        if trial.mesh_error is not None:
            block[:, :, own : own + trial.mesh_error.shape[2]] = trial.mesh_error
        at += trial.size
        columns.append(np.concatenate([block, jet.by_effect], axis=2))
        others = [c.raw[i] for c in one_each(table) if c.effect.name != "marker_offset"]
        extra.append(np.concatenate([np.zeros((k, 3, 0)), *others], axis=2))
    noise = estimate_noise([j.residual for j in stage.fit.jets], columns, extra, [t.groups for t in data.train])
    return noise, float(sum(3 * (t.groups.state.max() + 1) for t in data.train))


def screen_stage(data: Data, fit: JointFit, noise: Noise, fields: Fields, n_effective: float) -> list[Candidate]:
    return screen(fit, problem_of(data, fit, noise), fields, n_effective)
