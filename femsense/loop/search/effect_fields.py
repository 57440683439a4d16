"""Fields of effects: the displacement of the markers to first order, at a fitted model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError, FemsenseError
from femsense.fem.mesh import embed_points
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import States, Trial, spans_of
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.joint_fit import JointFit, JointProblem, Prior
from femsense.model.effects import Effect, InRecording, Parameter
from femsense.model.linear_answers import AtPoints
from femsense.model.observation import Hypothesis, Term
from femsense.model.path_solver import PathSolver, look_at
from femsense.model.robot import Robot

Answers = dict[int, AtPoints]
"""Frame → the linear response of the points of its state."""


def candidates_for(
    base: JointFit, control: str, *, forms: Sequence[Effect], names: Sequence[str], has_placements: bool
) -> list[Term]:
    """Return the effects and seeds to try in addition to a fitted model."""
    present = set(base.hypothesis.names)
    robot = base.hypothesis.robot_at(base.coordinates)
    result = []
    for effect in forms:
        if effect.name not in names or effect.name in present or (effect.places_markers and has_placements):
            continue
        for seed in effect.seeds(robot):
            parameters = effect.parameters(robot, control)
            if parameters or effect.discrete:
                result.append((effect, seed, parameters))
            parts = parts_of(parameters)
            if len(parts) > 1:
                result += [(effect, seed, part) for part in parts]
    return result


def parts_of(parameters: tuple[Parameter, ...]) -> list[tuple[Parameter, ...]]:
    """Return the parameters grouped by recording, cable or marker, or by key: an effect may act on one of them only."""
    parts: dict[str, list[Parameter]] = {}
    for p in parameters:
        owner = p.part.recording if isinstance(p.part, InRecording) else p.part[0] if isinstance(p.part, tuple) else p.part
        parts.setdefault(owner if isinstance(owner, str) else p.key, []).append(p)
    return [tuple(part) for part in parts.values()]


@dataclass(frozen=True, eq=False, slots=True)
class Fields:
    """Fields of candidate effects: the derivative of the residual by their parameters, at a fitted model."""

    todo: list[Term]
    """The effects and seeds that can be evaluated, with their parameters."""
    raw: list[FloatArray]
    """Columns [m], one array (k, c, Σq) per trial; a discrete alternative has one column, its full change."""
    rest: list[FloatArray]
    """Columns of the places measured by rest.csv [m], (r, 3, Σq) per trial."""
    model: Hypothesis
    """The model at which the fields are computed."""

    def beside(self, fit: JointFit) -> Fields | None:
        """Return the fields of the effects that a larger model still lacks, or None if they do not apply to it: another mesh or law, or a model without one
        of this model's effects.

        The field of an effect changes little with the other effects of the body (`benchmarks/hints.py`).
        """
        new = fit.hypothesis
        if new.settled != self.model.settled or not set(self.model.names) <= set(new.names):
            return None
        spans = self._spans()
        keep = [i for i, (effect, _, _) in enumerate(self.todo) if effect.name not in new.names]
        columns = np.concatenate([np.arange(0), *(np.arange(spans[i], spans[i + 1]) for i in keep)])
        raw, rest = [b[:, :, columns] for b in self.raw], [b[:, :, columns] for b in self.rest]
        return Fields([self.todo[i] for i in keep], raw, rest, self.model)

    def of(self, i: int) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the columns of one effect in markers and placements, one array (k, c, q) and (r, 3, q) per trial."""
        spans = self._spans()
        part = slice(spans[i], spans[i + 1])
        return [block[:, :, part] for block in self.raw], [block[:, :, part] for block in self.rest]

    def _spans(self) -> IntArray:
        """Return the first column of each effect, and the end of the last."""
        return np.cumsum([0, *(1 if e.discrete else len(p) for e, _, p in self.todo)])


def effect_fields(
    base: JointFit,
    trials: list[Trial],
    todo: list[Term],
    answers: list[Answers] | None = None,
) -> Fields:
    """Return the fields of effects: those with parameters to first order, with one factorisation per frame, or none if the `answers` of each trial are
    known from an earlier call at this fit; discrete alternatives as their full change, each along a quasi-static path of its own."""
    fixed = base.hypothesis.robot_at(base.coordinates)
    smooth = [t for t in todo if not t[0].discrete and _can_act(fixed, t)]
    every = Hypothesis(fixed, tuple(smooth))
    null = np.array([p.null for p in every.parameters])
    probe = JointProblem(every, Prior(np.zeros(0), np.zeros(0)), trials, [], 1.0)
    raw, rest = [], []
    asked = [None] * len(trials) if answers is None else answers
    for trial, known, span, own in zip(trials, base.jets, spans_of(trials), asked):
        trial.starts_on(fixed.body.mesh).update(_starts_of(trial, fixed, fixed, known.states))
        jet = probe.jet(trial, base.fit.theta[span], null, True, answers=own)
        raw.append(jet.by_effect)
        rest.append(jet.rest_by_effect)
    usable, near = smooth, [jet.states for jet in base.jets]
    for one in (t for t in todo if t[0].discrete and _can_act(fixed, t)):
        changes = _whole_change(base, trials, fixed, one, near)
        if changes is not None:
            usable = [*usable, one]
            raw = [np.concatenate([block, change[:, :, None]], axis=2) for block, change in zip(raw, changes)]
            rest = [np.concatenate([block, np.zeros((*block.shape[:2], 1))], axis=2) for block in rest]
    return Fields(usable, raw, rest, base.hypothesis)


def _can_act(robot: Robot, one: Term) -> bool:
    parameters = one[2]
    try:
        Hypothesis(robot, (one,)).robot_at(np.array([p.null + p.step for p in parameters]))
    except FemsenseError:
        return False
    return True


def _whole_change(
    base: JointFit,
    trials: list[Trial],
    fixed: Robot,
    one: Term,
    near: list[States],
) -> list[FloatArray] | None:
    """Return the change of the residual of each trial by a discrete alternative [m], (k, c); None if it has no equilibrium.

    The states `near` are warm starts, and are replaced by those of an alternative that converged: constitutive laws differ less among each other than
    from the declared one.
    """
    parameters = one[2]
    robot = Hypothesis(fixed, (one,)).robot_at(np.array([p.null for p in parameters]))
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), trials, [], 1.0)
    changes = []
    try:
        for i, (trial, jet, span) in enumerate(zip(trials, base.jets, spans_of(trials))):
            own, starts = base.fit.theta[span], _starts_of(trial, fixed, robot, near[i])
            try:
                moved = probe.jet(trial, own, np.zeros(0), False, starts, rough=True)
            except DataError:
                moved = probe.jet(trial, own, np.zeros(0), False, starts, solver=PathSolver(look_at))
            changes.append(moved.residual - jet.residual)
            near[i] = starts if robot.body.mesh is fixed.body.mesh else near[i]
    except FemsenseError:
        return None
    return changes


def _starts_of(trial: Trial, fixed: Robot, robot: Robot, states: States) -> States:
    """Return warm starts for a robot with another law, or on another mesh of the same body, from states before the change."""
    mesh = robot.body.mesh
    starts = trial.starts_on(mesh)
    if mesh is fixed.body.mesh:  # reuse the factorisations of these states
        return {k: replace(s, factor=starts[k].factor) if s.factor is None and k in starts else s for k, s in states.items()}
    if not states.keys() <= starts.keys():
        ties, still = embed_points(fixed.body.mesh, mesh.nodes), np.zeros_like(mesh.nodes)
        starts.update(
            {k: replace(s, positions=ties.positions(s.positions), nodal_forces=still, factor=None) for k, s in states.items()}
        )
    return starts


def fields_of(data: Data, fitted: FittedModel, names: Sequence[str]) -> Fields:
    """Return the field of each effect that a fitted model lacks."""
    placed_at_rest = any(len(t.scene.rest_marker) for t in data.train)
    todo = candidates_for(
        fitted.fit, data.control, forms=data.forms, names=[n for n in names if n not in NUISANCE], has_placements=placed_at_rest
    )
    return effect_fields(fitted.fit, data.train, todo)
