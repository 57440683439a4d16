"""Screening: how much of the residual each effect explains beyond what calibration can imitate.

With z the whitened nuisance columns (poses, initial inputs, modulus, zeros, and the effects that are in the model already) and P the
projector on their orthogonal complement, an effect's field s is judged by P s alone (Frisch–Waugh–Lovell): it is as if every nuisance were
refitted with it. ρ = |P s| / |s| is the share that calibration leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from femsense.arrays import FloatArray, IntArray
from femsense.calib.forward import Hypothesis
from femsense.effects import Effect, Entry, Parameter
from femsense.errors import DataError, FemsenseError
from femsense.fem.mesh import embed_points
from femsense.loop.joint import JointFit, JointProblem, Prior, States, Trial, spans_of
from femsense.loop.noise import whiten
from femsense.loop.states import MOST_WORK, between, representatives, spread_states, state_vectors
from femsense.march import AtPoints, has_history
from femsense.model import Robot

NUISANCE = ("stiffness", "cable_offset")
"""Effects that are always fitted along."""
TESTABLE = 0.1
"""An effect of which calibration imitates more than 90 % cannot be tested."""

Answers = dict[int, AtPoints]
"""Frame → what the points of its state answer to."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """An effect with a seed, as a column block at the current model."""

    effect: Effect
    seed: Entry
    parameters: tuple[Parameter, ...]
    raw: list[FloatArray]
    """Columns in metres, one array (k, c, q) a trial."""
    seats: list[FloatArray]
    """The same of the seats that rest.csv measures [m], (r, 3, q) a trial."""
    columns: FloatArray
    """Whitened, nuisance projected out, shape (N, q)."""
    response: FloatArray
    """How the fitted parameters answer to a unit of each column, shape (p, q)."""
    retained: float
    """ρ."""
    step: FloatArray
    """Best linear step from the null, shape (q,)."""
    gain: float
    """Decrease of χ² by that step."""
    score: float
    """dBIC: gain − cost."""
    cost: float
    """What the evidence must bring for the candidate's freedom."""
    smallest: FloatArray
    """Size of each parameter (in its coordinate) that would just have been seen, shape (q,)."""


def joined(a: Candidate, b: Candidate) -> Candidate:
    """Return two parts of an effect as one candidate, scored as if they did not know of each other."""
    return replace(
        a,
        parameters=(*a.parameters, *b.parameters),
        raw=[np.concatenate(pair, axis=2) for pair in zip(a.raw, b.raw)],
        seats=[np.concatenate(pair, axis=2) for pair in zip(a.seats, b.seats)],
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
    """Return what a candidate's freedom costs: (q + s) log n + 2 log (m a).

    q parameters are fitted; the s numbers of its seed (a place, a radius, a time) are chosen from many, so they count as parameters
    too; m effects are looked at, and a is the number of cables or markers that it might be alone.
    """
    chosen = sum(int(np.size(v)) for v in seed.values() if not isinstance(v, bool) and np.asarray(v).dtype.kind in "iuf")
    return float((count + chosen) * np.log(n_effective) + 2.0 * np.log(max(effects * alone, 1)))


def candidates_for(
    base: JointFit, control: str, *, forms: Sequence[Effect], names: Sequence[str], has_seats: bool
) -> list[tuple[Effect, Entry, tuple[Parameter, ...]]]:
    """Return the effects and seeds to try on top of a fitted model."""
    present = set(base.hypothesis.names)
    robot = base.hypothesis.robot_at(base.coordinates)
    result = []
    for effect in forms:
        if effect.name not in names or effect.name in present or (effect.name == "marker_offset" and has_seats):
            continue
        for seed in effect.seeds(robot):
            parameters = effect.parameters(robot, control)
            if parameters or effect.discrete:
                result.append((effect, seed, parameters))
            parts = _parts(parameters)
            if len(parts) > 1:
                result += [(effect, seed, part) for part in parts]
    return result


def _parts(parameters: tuple[Parameter, ...]) -> list[tuple[Parameter, ...]]:
    """Return the parameters of each cable or marker, or of each key, by itself: an effect may be that of one of them alone."""
    parts: dict[str, list[Parameter]] = {}
    for p in parameters:
        owner = p.part[0] if isinstance(p.part, tuple) else p.part
        parts.setdefault(owner if isinstance(owner, str) else p.key, []).append(p)
    return [tuple(part) for part in parts.values()]


@dataclass(frozen=True, eq=False, slots=True)
class Fields:
    """What effects do to the markers at a fitted model, to first order."""

    todo: list[tuple[Effect, Entry, tuple[Parameter, ...]]]
    """The effects and seeds that can be evaluated."""
    raw: list[FloatArray]
    """Columns [m], one array (k, 3, Σq) a trial; a discrete alternative has one column, its whole change."""
    rest: list[FloatArray]
    """The same of the seats that rest.csv measures [m], (r, 3, Σq) a trial."""
    model: Hypothesis
    """The fitted model."""

    def beside(self, fit: JointFit) -> Fields | None:
        """Return the fields of what a model with more effects does not have yet, or None where they say little of it: it lies on another mesh,
        has another law, or lacks an effect of this one.

        What an effect does to the markers changes little with what else the body has (`benchmarks/hints.py`).
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
        """Return the columns of one effect in markers and seats, one array (k, c, q) and (r, 3, q) a trial."""
        spans = self._spans()
        part = slice(spans[i], spans[i + 1])
        return [block[:, :, part] for block in self.raw], [block[:, :, part] for block in self.rest]

    def _spans(self) -> IntArray:
        """Return where the columns of each effect begin, and where the last end."""
        return np.cumsum([0, *(1 if e.discrete else len(p) for e, _, p in self.todo)])


def screen(base: JointFit, problem: JointProblem, fields: Fields, n_effective: float) -> list[Candidate]:
    """Return all candidates with their linear scores, the best first.

    Arguments:
        base: the current fit.
        problem: its problem (trials and noise).
        fields: of the effects to try, at this fit or very near to it.
        n_effective: number of independent observations, for BIC.
    """
    Q, inverse = _factors(np.asarray(base.fit.jacobian))
    residual = base.fit.residual - Q @ (Q.T @ base.fit.residual)
    effects = max(len({e.name for e, _, _ in fields.todo}), 1)
    result = []
    every = np.split(_whitened(base, problem, fields.raw, fields.rest), fields._spans()[1:-1], axis=1)
    for i, (effect, seed, parameters) in enumerate(fields.todo):
        (own, rest), whole = fields.of(i), every[i]
        if not np.isfinite(whole).all() or np.linalg.norm(whole) == 0:
            continue
        absorbed = Q.T @ whole
        left = whole - Q @ absorbed
        step, gain = _whole_step(left, residual) if effect.discrete else _best_step(left, residual, parameters)
        q = len(parameters)
        alone = sum(e is effect and len(p) == len(parameters) and s == seed for e, s, p in fields.todo)
        cost = penalty(q, seed, alone, effects, n_effective)
        score = gain - cost
        retained = float(np.linalg.norm(left) / np.linalg.norm(whole))
        smallest = _smallest(left, q, n_effective)
        response = -inverse @ absorbed
        result.append(
            Candidate(effect, seed, parameters, own, rest, left, response, retained, step, gain, float(score), cost, smallest)
        )
    return sorted(result, key=lambda c: -c.score)


def linear_gain(base: JointFit, problem: JointProblem, raw: list[FloatArray], seats: list[FloatArray]) -> float:
    """Return the decrease of χ² that columns of markers and seats (see `Candidate`) promise beside a fit, without bounds."""
    Q = _orthonormal(np.asarray(base.fit.jacobian))
    whole = _whitened(base, problem, raw, seats)
    more = _orthonormal(whole - Q @ (Q.T @ whole))
    return float(np.sum((more.T @ base.fit.residual) ** 2))


def effect_fields(
    base: JointFit,
    trials: list[Trial],
    todo: list[tuple[Effect, Entry, tuple[Parameter, ...]]],
    answers: list[Answers] | None = None,
) -> Fields:
    """Return what each effect does to the markers: those with parameters to first order, all of them with one factorisation a frame, or none where
    the `answers` of each trial are known from an earlier call for this fit; discrete alternatives as a whole, each with a walk of its own."""
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


def _can_act(robot: Robot, one: tuple[Effect, Entry, tuple[Parameter, ...]]) -> bool:
    parameters = one[2]
    try:
        Hypothesis(robot, (one,)).robot_at(np.array([p.null + p.step for p in parameters]))
    except FemsenseError:
        return False
    return True


def _whole_change(
    base: JointFit, trials: list[Trial], fixed: Robot, one: tuple[Effect, Entry, tuple[Parameter, ...]], near: list[States]
) -> list[FloatArray] | None:
    """Return by how much a discrete alternative changes the residual of each trial [m], (k, c); None where it has no equilibrium.

    It starts from states `near`, which those of another law take the place of: laws differ less from each other than from what is declared.
    On large meshes some of the states tell it for the markers in all.
    """
    parameters = one[2]
    robot = Hypothesis(fixed, (one,)).robot_at(np.array([p.null for p in parameters]))
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), trials, [], 1.0)
    changes = []
    try:
        for i, (trial, jet, span) in enumerate(zip(trials, base.jets, spans_of(trials))):
            own, starts = base.fit.theta[span], _starts_of(trial, fixed, robot, near[i])
            asked = _part_that_tells(trial, robot)
            try:
                moved = probe.jet(asked, own, np.zeros(0), False, starts, rough=True)
            except DataError:
                moved = probe.jet(asked, own, np.zeros(0), False, starts)
            whole = asked is trial
            changes.append(moved.residual - jet.residual if whole else -_between(trial, fixed, jet.states, robot, moved.states))
            near[i] = starts if robot.body.mesh is fixed.body.mesh else near[i]
    except FemsenseError:
        return None
    return changes


def _part_that_tells(trial: Trial, robot: Robot) -> Trial:
    """Return a trial with some states that tell what changes in all; the whole of it where they are few, or clouds, or depend on each other."""
    if trial.scene.crossings is not None or has_history(robot):
        return trial
    frames, share = spread_states(trial, MOST_WORK // len(robot.body.mesh.tets))
    return trial if share == 1.0 else trial.part(frames)


def _between(trial: Trial, fixed: Robot, before: States, robot: Robot, after: States) -> FloatArray:
    """Return by how much the marker of each row of a trial moves from one robot to another [m], (k, 3), from its moves in some of the states."""
    frames = trial.scene.frames
    vectors = state_vectors(trial.scene.recording, frames)
    asked = np.flatnonzero(np.isin(frames, list(after)))
    known = asked[representatives(vectors[asked], len(asked))]  # states that come back are one

    def move(k: int) -> FloatArray:
        return robot.markers.positions(after[k].positions) - fixed.markers.positions(before[k].positions)

    every = between(vectors, known, np.array([move(int(k)) for k in frames[known]]))
    return np.asarray(every[np.searchsorted(frames, trial.scene.frame), trial.scene.marker])


def _starts_of(trial: Trial, fixed: Robot, robot: Robot, states: States) -> States:
    """Return starts for a robot with another law, or on another mesh of the same body, from states of it as it was."""
    mesh = robot.body.mesh
    starts = trial.starts_on(mesh)
    if mesh is fixed.body.mesh:  # the factors of these states are lent
        return {k: replace(s, factor=starts[k].factor) if s.factor is None and k in starts else s for k, s in states.items()}
    if not states.keys() <= starts.keys():
        ties, still = embed_points(fixed.body.mesh, mesh.nodes), np.zeros_like(mesh.nodes)
        starts.update(
            {k: replace(s, positions=ties.positions(s.positions), nodal_forces=still, factor=None) for k, s in states.items()}
        )
    return starts


def _whitened(base: JointFit, problem: JointProblem, own: list[FloatArray], rest: list[FloatArray]) -> FloatArray:
    """Return columns of markers and seats, whitened, with zeros for the other rows of the fit (declared poses and priors)."""
    q = own[0].shape[2]
    result = np.zeros((len(base.fit.residual), q))
    at = 0
    for trial, factor, block, rows in zip(problem.trials, problem.factors, own, rest):
        k, s = block.shape[0] * block.shape[1], 3 * len(rows)
        result[at : at + k] = whiten(factor, block)
        result[at + k : at + k + s] = rows.reshape(s, q) / problem.seat_std
        at += k + s + 6 * len(trial.poses)
    return result


def _orthonormal(columns: FloatArray) -> FloatArray:
    return _factors(columns)[0]


def _factors(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q, an orthonormal basis of columns J (N, p), and A with A Qᵀ = J⁺."""
    norm = np.linalg.norm(columns, axis=0)
    seen = norm > 0
    inverse = np.zeros((columns.shape[1], 0))
    if not seen.any():
        return np.zeros((len(columns), 0)), inverse
    U, s, Vt = np.linalg.svd(columns[:, seen] / norm[seen], full_matrices=False)
    kept = s > 1e-9 * s[0]
    inverse = np.zeros((columns.shape[1], int(kept.sum())))
    inverse[seen] = (Vt[kept].T / s[kept]) / norm[seen, None]
    return np.asarray(U[:, kept]), inverse


def _best_step(columns: FloatArray, residual: FloatArray, parameters: Sequence[Parameter]) -> tuple[FloatArray, float]:
    """Return the bounded step that explains most, and the decrease of χ²."""
    null = np.array([p.null for p in parameters])
    low, high = np.array([p.low for p in parameters]) - null, np.array([p.high for p in parameters]) - null
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    low, high = np.minimum(low * scale, -1e-12), np.maximum(high * scale, 1e-12)
    answer = lsq_linear(columns / scale, -residual, bounds=(low, high))
    gain = float(residual @ residual) - float(np.sum((residual + columns / scale @ answer.x) ** 2))
    return np.asarray(answer.x / scale), gain


def _smallest(columns: FloatArray, q: int, n_effective: float) -> FloatArray:
    """Return the size of each parameter at which the expected dBIC reaches 10."""
    needed = np.sqrt(10.0 + q * np.log(n_effective))
    norm = np.linalg.norm(columns, axis=0)
    return np.asarray(np.where(norm > 0, needed / np.maximum(norm, 1e-300), np.inf))


def _whole_step(columns: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """Return the step to a discrete alternative, which is taken as a whole, and the decrease of χ²."""
    return np.ones(1), float(residual @ residual) - float(np.sum((residual + columns[:, 0]) ** 2))


def one_each(table: list[Candidate]) -> list[Candidate]:
    """Return the best candidate of each name."""
    seen: dict[str, Candidate] = {}
    for candidate in table:
        seen.setdefault(candidate.effect.name, candidate)
    return list(seen.values())


def confounding(a: Candidate, b: Candidate) -> float:
    """Return how much of a's field b can imitate once nuisance is projected out (the largest canonical correlation)."""
    A, B = _orthonormal(a.columns), _orthonormal(b.columns)
    if not A.size or not B.size:
        return 0.0
    direction = a.columns @ a.step if np.linalg.norm(a.columns @ a.step) > 0 else a.columns[:, 0]
    return float(np.linalg.norm(B.T @ direction) / max(float(np.linalg.norm(direction)), 1e-300))
