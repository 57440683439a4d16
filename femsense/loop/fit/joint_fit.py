"""The joint fit of poses, initial inputs, modulus, input offsets and effects over several recordings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypedDict

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.least_squares import FitResult, GaussNewtonOptions, gauss_newton
from femsense.core.local_model import Nonsmoothness
from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import Equilibrium
from femsense.loop.data.trial import States, Trial, normal_rms_of, rms_of, spans_of
from femsense.loop.fit.noise_components import Noise, Whitener, whiten
from femsense.loop.fit.normal_equations import Rows
from femsense.loop.fit.slack_nonsmoothness import Part, joined, trial_nonsmoothness
from femsense.model.effects.base import known_length
from femsense.model.linear_answers import AtPoints
from femsense.model.observation import Hypothesis, SceneJet, evaluate_scene
from femsense.model.path_solver import PathSolver
from femsense.model.quasi_static_path import has_given

DECLARED_POSE_STD = np.array([2e-3] * 3 + [3e-4] * 3)
"""Prior standard deviation of a declared pose [rad, m] for clouds alone …"""
BESIDE_MARKERS = np.array([1e-2] * 3 + [1e-3] * 3)
"""… and with markers, which determine the pose better: with the tighter prior, a pose wrong by 1 mm and ½° would bias the input offsets."""


@dataclass(frozen=True, eq=False, slots=True)
class Prior:
    """Independent Gaussian priors on the coordinates of a hypothesis."""

    mean: FloatArray
    std: FloatArray
    """inf: no prior."""
    others: Rows | None = None
    """Linearised rows of recordings that are not part of this fit, in the first coordinates."""


@dataclass(frozen=True, eq=False, slots=True)
class Jets:
    """Unwhitened residuals and derivatives of all trials at one point."""

    jets: list[SceneJet]
    theta: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class JointFit:
    """Result of `fit_jointly`: poses, initial inputs and coordinates of a hypothesis, fitted to all trials."""

    hypothesis: Hypothesis
    prior: Prior
    fit: FitResult
    own: int
    """Number of parameters that belong to recordings; the coordinates of the hypothesis follow."""
    chi2: float
    """Sum of squares of all whitened rows, priors included."""
    jets: list[SceneJet]

    @property
    def coordinates(self) -> FloatArray:
        """Coordinates of the hypothesis, shape (p,)."""
        return self.fit.theta[self.own :]

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the coordinates, shape (p,)."""
        return np.sqrt(np.maximum(np.diag(self.fit.covariance)[self.own :], 0.0))

    @property
    def rms(self) -> float:
        """Root mean square residual [m]: 3-D of the markers; without markers, along the normals of the clouds."""
        return rms_of([jet.residual for jet in self.jets])

    @property
    def normal_rms(self) -> float | None:
        """Root mean square residual of the clouds along their normals [m]; None without clouds."""
        return normal_rms_of([jet.residual for jet in self.jets])


@dataclass(eq=False, slots=True)
class JointProblem:
    """Whitened residual and Jacobian over trials; keeps the last jets."""

    hypothesis: Hypothesis
    prior: Prior
    trials: list[Trial]
    factors: list[Whitener]
    placement_std: float
    last: Jets | None = None
    """The last evaluation with derivatives."""
    seen: Jets | None = None
    """The last evaluation without derivatives."""
    tried: tuple[FloatArray, list[States]] | None = None
    """The last trial step, and its states."""
    near: list[SceneJet] | None = None
    """Derivatives from a fit close by, used until the first own ones."""
    scale: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Norm of each column of the Jacobian, shape (p,)."""

    @property
    def own(self) -> int:
        return sum(t.size for t in self.trials if not t.together)

    def start(self, coordinates: FloatArray) -> FloatArray:
        """Return θ at the starting values of the trials."""
        parts = [
            np.concatenate([np.zeros(6 * len(t.poses)), t.initial if t.initial is not None else np.zeros(0)])
            for t in self.trials
            if not t.together
        ]
        return np.concatenate([*parts, coordinates])

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return bounds of θ."""
        low, high = [], []
        for t in (t for t in self.trials if not t.together):
            free = np.full(6 * len(t.poses), np.inf)
            low += [-free, t.input_low if t.initial is not None else np.zeros(0)]
            high += [free, t.input_high if t.initial is not None else np.zeros(0)]
        parameters = self.hypothesis.parameters
        return np.concatenate([*low, [p.low for p in parameters]]), np.concatenate([*high, [p.high for p in parameters]])

    def evaluate(self, theta: FloatArray, derivative: bool) -> tuple[FloatArray, FloatArray | None]:
        """Return whitened residual (N,) and Jacobian (N, p): markers, placements, declared poses, priors.

        After the first evaluation, one without derivative is a trial step: its states are solved to a loose tolerance, and kept only if the
        step is accepted.
        """
        rough = not derivative and (self.last is not None or self.near is not None)
        try:
            starts, jets = self._jets(theta, derivative, rough)
        except DataError:
            if self.last is not None or self.seen is not None or not rough:
                raise
            rough = False  # the start is too far from known states for the loose tolerance
            starts, jets = self._jets(theta, derivative, rough)
        if rough:
            self.tried = (np.array(theta), starts)
        if derivative:
            self.last = Jets(jets, np.array(theta))
        else:
            self.seen = Jets(jets, np.array(theta))
        rows = self.rows_of(jets, theta, derivative)
        self.scale = self.scale if rows[1] is None else np.linalg.norm(rows[1], axis=0)
        return rows

    def _jets(self, theta: FloatArray, derivative: bool, rough: bool) -> tuple[list[States], list[SceneJet]]:
        """Return the warm starts and the jets of all trials at θ."""
        starts, spans, before = self.starts(theta, rough), spans_of(self.trials), self.last or self.seen
        jets = []
        for i, (trial, span) in enumerate(zip(self.trials, spans)):
            still = before is not None and not self.hypothesis.parameters and trial.initial is None
            known = before.jets[i].states if still and before is not None else None
            jets.append(self.jet(trial, theta[span], theta[self.own :], derivative, starts[i], rough, known, derivative))
        return starts, jets

    def nonsmooth(self, theta: FloatArray) -> Nonsmoothness | None:
        """Return where cable tensions that reach 0 make the residual nonsmooth near θ, from the last derivatives."""
        jets = self.near if self.last is None else self.last.jets
        if jets is None or not any(jet.by_input.shape[2] for jet in jets):
            return None
        at, parts = 0, list[Part]()
        for trial, factor, jet, span in zip(self.trials, self.factors, jets, spans_of(self.trials)):
            found = trial_nonsmoothness(self.hypothesis, trial, jet, factor, theta[span], theta[self.own :])
            if found is not None:
                parts.append((slice(at, at + jet.residual.size), np.r_[span, self.own : len(theta)], found))
            at += jet.residual.size + jet.rest.size + 6 * len(trial.poses)
        rows = at + len(self._prior_rows(theta[self.own :], len(theta))[0])
        return joined(parts, rows, len(theta)) if parts else None

    def outcome(self, fit: FitResult) -> JointFit:
        """Return the result of a fit of this problem, with derivatives at its end, or earlier ones if the fit has accepted these."""
        at_end = self.last is not None and np.array_equal(self.last.theta, fit.theta)
        was_seen = self.seen is not None and np.array_equal(self.seen.theta, fit.theta)  # otherwise a later step was rejected
        if not at_end and (fit.own or not was_seen):
            self.evaluate(fit.theta, fit.own)
        jets = self.last.jets if self.last is not None and (at_end or fit.own) else self._settled()
        return JointFit(self.hypothesis, self.prior, fit, self.own, float(fit.residual @ fit.residual), jets)

    def _settled(self) -> list[SceneJet]:
        """Return the last residuals with the earlier derivatives; the states of the former become warm starts."""
        derivatives = self.near if self.last is None else self.last.jets
        assert self.seen is not None and derivatives is not None
        self.starts(self.seen.theta, False)
        return [replace(d, residual=s.residual, rest=s.rest, states=s.states) for d, s in zip(derivatives, self.seen.jets)]

    def starts(self, theta: FloatArray, rough: bool) -> list[States]:
        """Return the warm starts of each trial: the states of the last trial step if these are closer in the scaled parameters."""
        kept = [t.starts_on(self.hypothesis.robot.body.mesh) for t in self.trials]
        if not rough:
            for own, tried in zip(kept, self.tried[1] if self.tried is not None and np.array_equal(self.tried[0], theta) else []):
                own.update(tried)
            return kept
        begun = self.near if self.last is None else self.last.jets
        if self.tried is None and begun is not None:
            body = self.hypothesis.robot_at(theta[self.own :]).body
            return [_as_near(own, jet.states, body) for own, jet in zip(kept, begun)]
        if self.tried is None:
            return [dict(s) for s in kept]
        at, states = self.tried
        nearer = self.last is None or (
            len(self.scale) == len(theta)
            and np.linalg.norm(self.scale * (theta - at)) < np.linalg.norm(self.scale * (theta - self.last.theta))
        )
        return [dict(s) for s in (states if nearer else kept)]

    def rows_of(self, jets: list[SceneJet], theta: FloatArray, derivative: bool) -> tuple[FloatArray, FloatArray | None]:
        """Return residual and Jacobian as of `evaluate`, from the jets of all trials at θ."""
        rows, blocks = [], []
        for trial, factor, jet, span in zip(self.trials, self.factors, jets, spans_of(self.trials)):
            r, J = self._scene_rows(trial, factor, jet, theta[span], span.start, len(theta), derivative)
            rows.append(r)
            blocks.append(J)
        r, J = self._prior_rows(theta[self.own :], len(theta))
        rows.append(r)
        blocks.append(J)
        return np.concatenate(rows), np.vstack(blocks) if derivative else None

    def jet(
        self,
        trial: Trial,
        own: FloatArray,
        coordinates: FloatArray,
        derivative: bool,
        starts: States | None = None,
        rough: bool = False,
        known: States | None = None,
        vary_inputs: bool = False,
        answers: dict[int, AtPoints] | None = None,
        solver: PathSolver | None = None,
    ) -> SceneJet:
        """Return residuals and derivatives of one trial, from its own warm starts or `starts`; at `known` states nothing is solved, and with `answers`
        nothing is factorised. `solver` replaces the default path solver."""
        pivot = self.hypothesis.robot.marker_points.mean(axis=0)
        _, initial = trial.place(own, pivot)
        starts = trial.starts_on(self.hypothesis.robot.body.mesh) if starts is None else starts
        return evaluate_scene(
            self.hypothesis,
            trial.scene,
            coordinates,
            trial.poses,
            initial,
            derivative=derivative,
            vary_initial=trial.initial is not None,
            pivot=pivot,
            starts=starts,
            known=known,
            vary_inputs=vary_inputs,
            moves=own[: 6 * len(trial.poses)],
            answers=answers,
            solver=PathSolver(rough=rough) if solver is None else solver,
        )

    def _scene_rows(
        self, trial: Trial, factor: Whitener, jet: SceneJet, own: FloatArray, at: int, width: int, derivative: bool
    ) -> tuple[FloatArray, FloatArray]:
        poses = 6 * len(trial.poses)
        declared = np.array([T is not None and not trial.together for T in trial.scene.recording.T_robot_camera]).repeat(6)
        known = BESIDE_MARKERS if trial.scene.crossings is None else DECLARED_POSE_STD
        trust = np.where(declared, 1.0 / np.tile(known, len(trial.poses)), 0.0)
        r = np.concatenate([whiten(factor, jet.residual), jet.rest.ravel() / self.placement_std, trust * own[:poses]])
        J = np.zeros((len(r), width if derivative else 0))
        if not derivative:
            return r, J
        k, s = jet.residual.size, jet.rest.size
        J[:k, at : at + poses] = whiten(factor, jet.by_pose)
        J[:k, at + poses : at + trial.size] = whiten(factor, jet.by_initial)
        J[:k, self.own :] = whiten(factor, jet.by_effect)
        J[k : k + s, at : at + poses] = jet.rest_by_pose.reshape(s, poses) / self.placement_std
        J[k : k + s, self.own :] = jet.rest_by_effect.reshape(s, jet.rest_by_effect.shape[2]) / self.placement_std
        J[k + s :, at : at + poses] = np.diag(trust)
        return r, J

    def _prior_rows(self, coordinates: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
        known = np.isfinite(self.prior.std)
        r = (coordinates - self.prior.mean)[known] / self.prior.std[known]
        J = np.zeros((len(r), width))
        J[np.arange(len(r)), self.own + np.flatnonzero(known)] = 1.0 / self.prior.std[known]
        if self.prior.others is not None:
            more = np.zeros((len(self.prior.others.offset), width))
            more[:, self.own : self.own + self.prior.others.matrix.shape[1]] = self.prior.others.matrix
            r, J = np.concatenate([r, self.prior.others.at(coordinates)]), np.vstack([J, more])
        known_vector = known_length(self.hypothesis.parameters)
        if known_vector is None or np.linalg.norm(coordinates[known_vector[0]]) < 1e-3:
            return r, J
        at, length = known_vector
        vector = coordinates[at]
        size = float(np.linalg.norm(vector))
        row = np.zeros((1, width))
        row[0, self.own + np.flatnonzero(at)] = vector / size / length.std
        return np.append(r, (size - length.value) / length.std), np.vstack([J, row])


def _as_near(kept: States, near: States, body: BodyModel) -> States:
    """Return warm starts for a body: the states of a fit close by, if they are on the same mesh, because kept states may be from a distant trial step.
    The factorisations of the kept states are reused. States of another kind of clamp (rigid or compliant) are not used."""
    shape = next(iter(near.values())).positions.shape
    if any(state.positions.shape != shape for state in kept.values()):
        return dict(kept)
    return {**kept, **{k: nearby_start(kept.get(k), state, body) for k, state in near.items()}}


def nearby_start(kept: Equilibrium | None, state: Equilibrium, body: BodyModel) -> Equilibrium:
    """Return the warm start of a frame, from a kept state and that of a fit close by."""
    if kept is None or kept.positions is state.positions:  # such a state has its own factorisation
        return state if kept is None else kept
    gives, gave = has_given(body, state), has_given(body, kept)
    if gives == body.clamp_is_rigid and gave != body.clamp_is_rigid:
        return kept
    near = gives == gave and np.abs(kept.positions - state.positions).max() < NEAR * body.reach
    return replace(state, factor=kept.factor if near else None)


NEAR = 1e-2
"""A factorisation is reused for a state whose nodes differ by less than this share of the body's reach."""
TRUSTED = 0.02
"""Derivatives whose prediction erred by less than this share in every step are accepted at the end of the fit."""
GAIN = 0.5
"""Smallest predicted decrease of χ² of a step that continues the fit: half the expected gain of a parameter that fits noise."""
SERVES = 0.25
"""Derivatives are reused for another step if their prediction of the residual erred by less than this share of its change."""


class FitOptions(TypedDict, total=False):
    """Start and limits of a fit: keyword arguments of `fit_jointly`."""

    own: FloatArray | None
    max_iterations: int
    known: list[SceneJet] | None
    near: list[SceneJet] | None
    worth: float


def fit_jointly(
    hypothesis: Hypothesis,
    prior: Prior,
    trials: list[Trial],
    noise: Noise,
    placement_std: float,
    coordinates: FloatArray,
    *,
    own: FloatArray | None = None,
    max_iterations: int = 12,
    known: list[SceneJet] | None = None,
    near: list[SceneJet] | None = None,
    worth: float = np.inf,
) -> JointFit:
    """Fit poses, initial inputs and the coordinates of a hypothesis jointly, with the full nonlinear equilibrium.

    Minimises χ² = Σ |L⁻¹ r|² over the rows of markers, clouds, placements, declared poses and priors by Gauss–Newton within bounds.

    Arguments:
        hypothesis, prior: the parameters and their priors.
        trials: the recordings.
        noise: weights of the residuals.
        placement_std: σ of places measured by rest.csv relative to the declared ones [m].
        coordinates: starting values of the hypothesis, shape (p,).
        own: starting values of the recordings' own parameters; by default those of the trials.
        max_iterations: maximum number of Gauss–Newton steps.
        known: residuals and derivatives at the start, one jet per trial, if available.
        near: derivatives from a fit close by, used for the first steps.
        worth: χ² above which no derivatives are computed at the end.

    Raises:
        DataError: no equilibrium at the start.
    """
    problem = JointProblem(hypothesis, prior, trials, noise.whiteners(trials), placement_std)
    theta = problem.start(coordinates)
    if own is not None:
        theta[: problem.own] = own
    low, high = problem.bounds()
    begin = None if known is None else problem.rows_of(known, theta, True)
    problem.near = near
    problem.last = None if known is None else Jets(known, np.array(theta))
    problem.scale = problem.scale if begin is None or begin[1] is None else np.linalg.norm(begin[1], axis=0)
    fit = gauss_newton(
        problem.evaluate,
        theta,
        low=low,
        high=high,
        known=begin,
        borrowed=None if near is None else problem.rows_of(near, theta, True)[1],
        nonsmooth=problem.nonsmooth,
        options=GaussNewtonOptions(
            max_iterations=max_iterations,
            tolerance=1e-06,
            still=0.2,
            serves=SERVES,
            worth=worth,
            trusted=TRUSTED,
            enough=GAIN,
        ),
    )
    return problem.outcome(fit)
