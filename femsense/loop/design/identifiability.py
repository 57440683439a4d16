"""What an experiment could show, before it is made: linear theory on the declared robot, no noise drawn.

Each part of an experiment (a block of frames) gives the Gram matrices of its columns: of what belongs to its recording alone
(pose, initial inputs), and of what all recordings share (calibration and effects). Blocks add up, so that any experiment made of
them is judged by linear algebra alone. With G the sum and N the columns of calibration,

    S = G_ee − G_eN G_NN⁻¹ G_Ne      (what calibration cannot imitate, Frisch–Waugh–Lovell)

holds everything: an effect a of plausible size D_a raises χ² by tr(D_a S_aa D_a), of which a rival b takes back tr(D_a S_ab S_bb⁻¹ S_ba D_a).
Effects of several parameters count with independent ones of plausible size. This is what `screen` computes from data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.least_squares import FitResult
from femsense.core.pose import rotation_from_vector
from femsense.loop.data.dataset import NUISANCE
from femsense.loop.data.trial import Trial
from femsense.loop.fit.joint_fit import JointFit, JointProblem, Prior
from femsense.loop.search.effect_fields import effect_fields
from femsense.loop.search.screening import TESTABLE, penalty
from femsense.model.effects import EFFECTS, Effect, Entry, Parameter
from femsense.model.effects.base import range_units
from femsense.model.observation import Hypothesis, SceneJet
from femsense.model.robot import Robot
from femsense.rig.camera import measured_points, visible_points
from femsense.rig.scene import body_shape
from femsense.rig.script import SceneTable

MOST_SEEDS = 6
"""Places and times of one effect that are tried; the most spread ones come first."""
EVIDENCE = 10.0
"""dBIC from which an effect is seen, or told from another."""
ALIKE = 0.95
"""Effects that imitate each other by more than this share cannot be told apart."""
ABSORBED = 1e-9
"""Share of its χ² below which a direction counts as imitated whole."""


# Forms


@dataclass(frozen=True, eq=False, slots=True)
class Form:
    """An effect with a seed and its columns."""

    label: str
    """What the table calls it: the effect's name, and which form where there are two."""
    name: str
    effect: Effect
    seed: Entry
    parameters: tuple[Parameter, ...]
    size: FloatArray
    """Plausible size of each column, in coordinates."""
    at: int
    """Where its columns start."""
    known: FloatArray
    """How well calibration knows each column beforehand, in coordinates, shape (q,); empty for what is sought."""

    @property
    def columns(self) -> slice:
        return slice(self.at, self.at + len(self.size))


def forms_of(robot: Robot, control: str, ranges: FloatArray, *, names: Sequence[str] | None = None) -> list[Form]:
    """Return the forms to judge.

    Arguments:
        robot: the declared robot.
        control: "tension" or "displacement".
        ranges: of the cables [N] or [m], shape (a,).
        names: effects to take; by default all.
    """
    result: list[Form] = []
    at = 0
    for effect, label in _kinds(robot):
        seeds = effect.seeds(robot)[:MOST_SEEDS]
        for seed in seeds if names is None or effect.name in names else []:
            parameters = effect.parameters(robot, control)
            if not parameters and not effect.discrete:
                continue
            size = np.ones(1) if effect.discrete else _plausible(parameters, robot, ranges)
            result.append(Form(label, effect.name, effect, seed, parameters, size, at, _known(effect, parameters, robot, ranges)))
            at += len(size)
    return result


def _kinds(robot: Robot) -> list[tuple[Effect, str]]:
    """Return the forms of the effects in which experiments are planned for them, with their labels."""
    result = []
    for effect in EFFECTS:
        forms = [("", effect)] if effect.planned is None else effect.planned(robot)
        result += [(form, f"{effect.name} ({which})" if which else effect.name) for which, form in forms]
    return result


def _known(effect: Effect, parameters: Sequence[Parameter], robot: Robot, ranges: FloatArray) -> FloatArray:
    if effect.calibrated is None:
        return np.zeros(0)
    return np.maximum(effect.calibrated.planned_std * range_units(parameters, robot.body.cable_names, ranges), 1e-9)


def _plausible(parameters: Sequence[Parameter], robot: Robot, ranges: FloatArray) -> FloatArray:
    """Return plausible sizes of parameters, in coordinates, shape (q,)."""
    return np.array([p.usual_size for p in parameters]) * range_units(parameters, robot.body.cable_names, ranges)


# Blocks


@dataclass(frozen=True, eq=False, slots=True)
class Gram:
    """Products of whitened columns: own ones of the recording (w of them) and shared ones (e)."""

    own: FloatArray
    """Shape (w, w)."""
    cross: FloatArray
    """Shape (w, e)."""
    shared: FloatArray
    """Shape (e, e)."""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """One part of an experiment."""

    recording: str
    """Blocks of one recording share its pose."""
    gram: Gram
    rested: Gram | None
    """The same with rest.csv; None where it was not asked for."""
    placements: Gram
    """What rest.csv says, once a recording."""
    states: int
    """Distinct states of markers."""
    rows: int


def make_block(
    trial: Trial,
    robot: Robot,
    forms: Sequence[Form],
    *,
    recording: str,
    noise: float,
    turns: FloatArray | None = None,
    see: bool = False,
    measured: bool = False,
    with_rest: bool = False,
) -> Block:
    """Return a block.

    Arguments:
        trial: inputs, loads and camera; unless `measured`, its marker positions are replaced by those of the robot.
        robot: the declared robot.
        forms: whose columns are wanted.
        recording: its key.
        noise: standard deviation of a marker's coordinate [m].
        turns: rotation of the base in each frame, shape (F, 3, 3): gravity in the frame is that times gravity as declared.
        see: leave out markers that the camera does not see.
        measured: the trial's markers are real.
        with_rest: also with rest.csv.

    Raises:
        DataError: a frame has no equilibrium.
    """
    trial = trial if measured else _as_expected(trial, robot)
    jet = _jet(trial, robot)
    rows = _seen(trial, robot, jet) if see else np.ones(len(jet.residual), dtype=bool)
    columns, rest_columns = _columns(trial, robot, jet, forms, turns, width=max((f.columns.stop for f in forms), default=0))
    states = len(np.unique(trial.groups.state[rows]))
    gram, placements = _gram(_own(jet)[rows], columns[rows], noise), _placements(jet, rest_columns, noise)
    if not with_rest:
        return Block(recording, gram, None, placements, states, int(rows.sum()))
    placed = _with_rest(trial, robot)
    jet = _jet(placed, robot)
    moved = [f for f in forms if f.effect.moves_rest]  # the others leave the measured seats where they are
    fresh, rest_columns = _columns(placed, robot, jet, moved, turns, width=columns.shape[2])
    for f in moved:
        columns[:, :, f.columns] = fresh[:, :, f.columns]
    rested = _gram(_own(jet)[rows], columns[rows], noise)
    return Block(recording, gram, rested, _placements(jet, rest_columns, noise), states, int(rows.sum()))


def _own(jet: SceneJet) -> FloatArray:
    return np.concatenate([jet.by_pose, jet.by_initial], axis=2)


def _jet(trial: Trial, robot: Robot) -> SceneJet:
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [trial], [], 1.0)
    return probe.jet(trial, _start(trial), np.zeros(0), True)


def _start(trial: Trial) -> FloatArray:
    return np.concatenate([np.zeros(6 * len(trial.poses)), np.zeros(0) if trial.initial is None else trial.initial])


def _as_expected(trial: Trial, robot: Robot) -> Trial:
    """Return the trial with its markers where the declared robot would have the camera measure them."""
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [trial], [], 1.0)
    states = probe.jet(trial, _start(trial), np.zeros(0), False).states
    places = {k: robot.markers.positions(state.positions) for k, state in states.items()}
    scene = trial.scene
    true = np.array([places[int(f)][m] for f, m in zip(scene.frame, scene.marker)])
    return replace(trial, scene=replace(scene, points=measured_points(trial.poses[0], true, robot.observation)))


def _with_rest(trial: Trial, robot: Robot) -> Trial:
    every = np.arange(len(robot.marker_points))
    points = measured_points(trial.poses[0], robot.marker_points, robot.observation)
    return replace(trial, scene=replace(trial.scene, rest_marker=every, rest_view=np.zeros_like(every), rest_points=points))


def _seen(trial: Trial, robot: Robot, jet: SceneJet) -> BoolArray:
    """Return which rows the camera sees, shape (k,)."""
    camera, table, scene = trial.scene.recording.cameras[0], SceneTable.model_validate({}), trial.scene
    assert camera is not None
    visible = {}
    for k, state in jet.states.items():
        shapes = [body_shape(robot, state.positions, table)]
        visible[k] = visible_points(camera, trial.poses[0], shapes, robot.markers.positions(state.positions))
    return np.array([visible[int(f)][m] for f, m in zip(scene.frame, scene.marker)], dtype=bool)


def _columns(
    trial: Trial, robot: Robot, jet: SceneJet, forms: Sequence[Form], turns: FloatArray | None, *, width: int
) -> tuple[FloatArray, FloatArray]:
    """Return the columns of forms at their places [m], of markers (k, c, e) and of measured seats (r, 3, e); zero where a form cannot
    act or finds no equilibrium."""
    result, rest = np.zeros((*jet.residual.shape, width)), np.zeros((len(jet.rest), 3, width))
    if not forms:
        return result, rest
    theta = _start(trial)
    fit = FitResult(theta, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), (), "")
    base = JointFit(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), fit, len(theta), 0.0, [jet])
    fields = effect_fields(base, [trial], [(f.effect, f.seed, f.parameters) for f in forms])
    where = {(id(f.effect), id(f.seed)): f for f in forms}
    for i, (effect, seed, _) in enumerate(fields.todo):
        form = where[id(effect), id(seed)]
        (own,), (placements,) = fields.of(i)
        if form.effect.turns_with_base and turns is not None:
            own = np.einsum("kci,kij->kcj", own, turns[trial.scene.frame])
        result[:, :, form.columns], rest[:, :, form.columns] = own, placements
    return result, rest


def _gram(own: FloatArray, shared: FloatArray, noise: float) -> Gram:
    A, B = own.reshape(-1, own.shape[2]) / noise, shared.reshape(-1, shared.shape[2]) / noise
    return Gram(A.T @ A, A.T @ B, B.T @ B)


def _placements(jet: SceneJet, shared: FloatArray, noise: float) -> Gram:
    """Return what measured seats say; they are trusted as markers are, but not better than 0.1 mm."""
    r = len(jet.rest)
    own = np.concatenate(
        [jet.rest_by_pose.reshape(r, 3, jet.by_pose.shape[2]), np.zeros((r, 3, jet.by_initial.shape[2]))], axis=2
    )
    return _gram(own, shared, max(noise, 1e-4))


def turns_of(gravity: FloatArray | None, declared: FloatArray) -> FloatArray | None:
    """Return the smallest rotations that turn gravity as declared into that of each frame, shape (F, 3, 3); None without turns."""
    if gravity is None:
        return None
    first = declared if np.any(declared) else gravity[0]
    a = first / np.linalg.norm(first)
    result = []
    for g in gravity:
        b = g / max(float(np.linalg.norm(g)), 1e-300)
        axis = np.cross(a, b)
        size = float(np.linalg.norm(axis))
        spare = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        unit = axis / size if size > 1e-9 else spare / np.linalg.norm(spare)
        result.append(rotation_from_vector(unit * np.arctan2(size, float(a @ b))))
    return np.array(result)


# Judging


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """What an experiment says of one effect."""

    label: str
    name: str
    retained: float
    """Share that calibration leaves."""
    smallest: FloatArray
    """Size of each parameter that would just be seen, in coordinates."""
    form: Form
    dbic: float
    """Expected at plausible size."""

    @property
    def testable(self) -> bool:
        return self.retained >= TESTABLE

    @property
    def seen(self) -> bool:
        return self.testable and self.dbic >= EVIDENCE


@dataclass(frozen=True, eq=False, slots=True)
class Identifiability:
    """What an experiment could show."""

    rows: tuple[Row, ...]
    confounding: FloatArray
    """How much of effect i (row) effect j can imitate, calibration refitted, shape (r, r)."""
    gap: FloatArray
    """Expected dBIC of i over j where i is the truth at plausible size, shape (r, r); inf between forms of one effect."""

    def pairs(self) -> list[tuple[int, int, float, float]]:
        """Return (i, j, confounding, gap) of all pairs of effects, the weaker direction of each."""
        count = len(self.rows)
        every = [(i, j) for i in range(count) for j in range(i + 1, count) if self.rows[i].name != self.rows[j].name]
        return [
            (i, j, float(min(self.confounding[i, j], self.confounding[j, i])), float(min(self.gap[i, j], self.gap[j, i])))
            for i, j in every
        ]

    def confused(self) -> list[tuple[int, int, float, float]]:
        """Return pairs of effects that would both be seen and cannot be told apart."""
        seen = [r.seen for r in self.rows]
        return [p for p in self.pairs() if seen[p[0]] and seen[p[1]] and (p[2] > ALIKE or p[3] < EVIDENCE)]

    def distinguished(self) -> tuple[int, int]:
        """Return the number of pairs of effects that would both be seen and told apart, and of all pairs."""
        pairs = self.pairs()
        seen = sum(self.rows[i].seen and self.rows[j].seen for i, j, *_ in pairs)
        return seen - len(self.confused()), len(pairs)

    @property
    def untestable(self) -> list[str]:
        return [r.label for r in self.rows if not r.testable]

    @property
    def unseen(self) -> list[str]:
        """Effects that could be tested but whose plausible size is too small to be seen."""
        return [r.label for r in self.rows if r.testable and not r.seen]

    @property
    def confusion(self) -> float:
        """What a plan lowers: shortfalls of pairs and of effects, each between 0 and 1; also those not counted yet because of another."""
        missing = sum(max(0.0, 1.0 - r.retained / TESTABLE) + np.clip(1.0 - r.dbic / EVIDENCE, 0.0, 1.0) for r in self.rows)
        pairs = sum(
            np.clip(1.0 - gap / EVIDENCE, 0.0, 1.0) + np.clip((share - ALIKE) / (1 - ALIKE), 0, 1)
            for *_, share, gap in self.pairs()
        )
        return float(missing + pairs)


@dataclass(eq=False, slots=True)
class Judge:
    """Judges experiments made of blocks."""

    forms: list[Form]
    calibrated: tuple[str, ...] = NUISANCE
    _by_label: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for i, f in enumerate(self.forms):
            self._by_label.setdefault(f.label, []).append(i)

    def judge(self, blocks: Sequence[Block], *, rest: bool = False) -> Identifiability:
        """Return what an experiment could show.

        Arguments:
            blocks: its parts.
            rest: whether rest.csv is part of it.
        """
        seen, whole = self._shared(blocks, rest)
        count = max(3.0 * sum(b.states for b in blocks), 2.0)
        labels = [label for label, own in self._by_label.items() if not (rest and self.forms[own[0]].effect.places_markers)]
        names = len({f.name for f in self.forms if f.name not in self.calibrated})
        scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        free = {drop: _Left(self, seen, scale, self._kept(drop), count, names) for drop in self._drops(labels)}
        rows = [self._row(label, free[self._dropped(label)], whole, count) for label in labels]
        confounding, gap = np.zeros((len(rows), len(rows))), np.full((len(rows), len(rows)), np.inf)
        for i, a in enumerate(rows):
            for j, b in enumerate(rows):
                if a.name != b.name:
                    left = free[self._dropped(a.label) | self._dropped(b.label)]
                    confounding[i, j], gap[i, j] = left.rival(self.forms.index(a.form), self._by_label[b.label])
        return Identifiability(tuple(rows), confounding, gap)

    def _dropped(self, label: str) -> frozenset[str]:
        return frozenset({label} & set(self.calibrated))

    def _drops(self, labels: list[str]) -> list[frozenset[str]]:
        own = [frozenset({c}) for c in self.calibrated if c in labels]
        return [frozenset(), *own, frozenset().union(*own)] if len(own) > 1 else [frozenset(), *own]

    def _kept(self, drop: frozenset[str]) -> list[Form]:
        return [f for f in self.forms if f.name in self.calibrated and f.name not in drop]

    def _shared(self, blocks: Sequence[Block], rest: bool) -> tuple[FloatArray, FloatArray]:
        """Return the products of shared columns with each recording's own ones projected out, and without that, (e, e)."""
        left, whole = 0.0, 0.0
        for key in dict.fromkeys(b.recording for b in blocks):
            mine = [b for b in blocks if b.recording == key]
            grams = [b.rested if rest and b.rested is not None else b.gram for b in mine]
            grams += [mine[0].placements] if rest or mine[0].rested is None else []
            own, cross, shared = (np.sum([getattr(g, n) for g in grams], axis=0) for n in ("own", "cross", "shared"))
            left, whole = left + shared - cross.T @ _inverse(own) @ cross, whole + shared
        return np.asarray(left), np.asarray(whole)

    def _row(self, label: str, left: _Left, whole: FloatArray, count: float) -> Row:
        """Return the row of an effect, at the seed in the middle of all."""
        tried = sorted(self._by_label[label], key=lambda i: left.dbic(i))
        f = self.forms[tried[(len(tried) - 1) // 2]]
        at = f.columns
        size, total = np.diag(left.S)[at], np.diag(whole)[at]
        retained = float(np.sqrt(max(size.sum(), 0.0) / total.sum())) if total.sum() > 0 else 0.0
        needed = np.sqrt(EVIDENCE + len(f.parameters) * np.log(count))
        smallest = np.where(size > ABSORBED * np.maximum(total, 1e-300), needed / np.sqrt(np.maximum(size, 1e-300)), np.inf)
        return Row(label, f.name, retained, smallest, f, left.dbic(self.forms.index(f)))


class _Left:
    """What some calibration leaves of every form, and how much of one another explains."""

    def __init__(self, judge: Judge, shared: FloatArray, scale: FloatArray, kept: list[Form], count: float, names: int) -> None:
        self.forms, self.count, self.names = judge.forms, count, names
        N = np.concatenate([np.arange(f.at, f.at + len(f.size)) for f in kept]) if kept else np.zeros(0, dtype=np.int64)
        prior = np.concatenate([f.known for f in kept]) if kept else np.zeros(0)
        G = shared[np.ix_(N, N)] + np.diag(1.0 / prior**2)
        self.S = shared - shared[:, N] @ _inverse(G) @ shared[N] if len(N) else shared
        self.size = np.concatenate([f.size for f in self.forms])
        self.starts = [f.at for f in self.forms]
        roots = np.zeros_like(self.S)
        for f in self.forms:
            roots[f.columns, f.columns] = _root(self.S[f.columns, f.columns], scale[f.columns])
        shares = (self.size[:, None] * (self.S @ roots)) ** 2
        self.explained = np.add.reduceat(np.add.reduceat(shares, self.starts, axis=0), self.starts, axis=1)
        self.gain = np.add.reduceat(np.maximum(np.diag(self.S), 0.0) * self.size**2, self.starts)

    def dbic(self, i: int) -> float:
        return float(self.gain[i]) - self._price(self.forms[i])

    def rival(self, i: int, others: list[int]) -> tuple[float, float]:
        """Return how much of a form the best of others imitates, and the expected dBIC over it."""
        a, gain = self.forms[i], float(self.gain[i])
        if gain <= 1e-12:
            return 0.0, 0.0
        share = float(np.sqrt(np.clip(max(self.explained[i, j] for j in others) / gain, 0.0, 1.0)))
        gaps = [gain - float(self.explained[i, j]) + self._price(self.forms[j]) - self._price(a) for j in others]
        return share, min(gaps)

    def _price(self, f: Form) -> float:
        return penalty(len(f.parameters), f.seed, 1, self.names, self.count)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a positive semi-definite matrix, columns scaled to unit size."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    good = values > 1e-12 * max(float(values.max(initial=0.0)), 1e-300)
    half = vectors[:, good] / np.sqrt(values[good]) / scale[:, None]
    return np.asarray(half @ half.T)


def _root(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """Return R with R Rᵀ the pseudo-inverse of a block; directions that calibration imitates whole are left out."""
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    good = values > ABSORBED
    return np.asarray(vectors / scale[:, None] * np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0))
