"""Many recordings: effects are searched for in some of them, fitted to all, and screened again in all.

A joint fit holds the states and the derivatives of all its recordings, and its Jacobian has columns for the camera of each: memory grows with the
square of their number. Effects are therefore searched for in `Effort.recordings` recordings, chosen as different as possible. The resulting model is
fitted to all recordings by Gauss–Newton steps in the shared parameters: each other recording is processed alone, contributes its normal equations
with its own parameters eliminated (`femsense.loop.fit.normal_equations`), and is released. Their sum enters the joint fit as rows of it; at
convergence this is the joint fit of all recordings. An effect without evidence in all of them is removed, and every other effect is screened with the
same sums.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.least_squares import basis_of
from femsense.io.checkpoint import Checkpoint
from femsense.io.files import file_hash, json_text, plain
from femsense.io.recording_folder import load_recording
from femsense.loop.data.dataset import NUISANCE, Data, prepare
from femsense.loop.data.sampled_states import Sampled, drive_table
from femsense.loop.fit.discretisation_error import with_mesh_errors_of
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, problem_of, without_effect
from femsense.loop.fit.joint_fit import Prior, fit_jointly
from femsense.loop.fit.marker_placement import with_errors_as_shown
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.normal_equations import Block, NormalEquations, Squares
from femsense.loop.options import Measured
from femsense.loop.result.records import AllRecordings
from femsense.loop.search.calibration import calibrated_pose, calibrated_without_outliers
from femsense.loop.search.effect_fields import candidates_for, effect_fields
from femsense.loop.search.screening import best_step, penalty, whitened_columns
from femsense.loop.search.search_state import Progress, Search
from femsense.loop.thresholds import Thresholds
from femsense.model.effects import FORMS, Effect, load_own_effect
from femsense.model.observation import Hypothesis, Term
from femsense.model.recording import Recording
from femsense.model.robot import Robot, spread_points

MOST_STEPS = 4
"""Maximum number of Gauss–Newton steps over all recordings."""
KEY = 6
"""Length of a candidate's key [bytes]."""
STILL = 0.1
"""The steps end if no shared parameter moves by more than this share of its standard error."""


Spread = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]
"""Yields function(*task) for each task, in order: `femsense.many.engines.spread` of an engine."""


@dataclass(frozen=True, eq=False, slots=True)
class Question:
    """The request to every recording: its normal equations at a model, and those of the effects that the model lacks."""

    declared: Robot
    hypothesis: Hypothesis
    coordinates: FloatArray
    """β, shape (p,)."""
    noise: Noise
    placement_std: float
    mesh_moves: Sampled | None
    """Displacement of the markers by a finer mesh; None: unknown."""
    mesh_as_shown: bool
    """As of `Data`."""
    names: tuple[str, ...]
    """Effects to screen; empty: only the normal equations are needed."""
    thresholds: Thresholds


# Which recordings


def recordings_to_search(recordings: Sequence[Recording], most: int) -> tuple[list[Recording], list[Recording]]:
    """Return at most `most` recordings with inputs and loads as different as possible, and the others, both in order.

    All are searched if there are several sessions, whose values are fitted separately, or if one has no markers: its surface rows depend on the model.
    """
    sessions = len({r.session for r in recordings})
    if len(recordings) <= most or sessions > 1 or not all(len(r.marker_frame) for r in recordings):
        return list(recordings), []
    tables = [drive_table(r, np.arange(len(r.time_s))) for r in recordings]
    if len({table.shape[1] for table in tables}) > 1:
        return list(recordings), []
    ends = np.array([[table.min(axis=0), table.max(axis=0)] for table in tables]).reshape(len(tables), -1)
    unit = np.maximum(np.ptp(ends, axis=0), 1e-12)
    chosen = {int(i) for i in spread_points(ends / unit, most)}
    chosen |= set([i for i in range(len(tables)) if i not in chosen][: most - len(chosen)])  # fill up if several are identical
    return [r for i, r in enumerate(recordings) if i in chosen], [r for i, r in enumerate(recordings) if i not in chosen]


# One recording


def normal_equations(question: Question, recording: Recording, forms: Sequence[Effect] = FORMS) -> NormalEquations:
    """Return the normal equations of a recording at a model, its own parameters fitted. Raises DataError that names the recording."""
    try:
        return _normal_equations(question, recording, forms)
    except FemsenseError as error:
        raise DataError(
            f"{recording.folder or 'a recording'}: {error}; leave it out, or check it with femsense calibrate"
        ) from error


def _normal_equations(question: Question, recording: Recording, forms: Sequence[Effect]) -> NormalEquations:
    at = question.hypothesis.robot_at(question.coordinates)
    data = replace(
        prepare(question.hypothesis.robot, [recording], [], Measured.markers),
        placement_std=question.placement_std,
        forms=tuple(forms),
        thresholds=question.thresholds,
        mesh_as_shown=question.mesh_as_shown,
    )
    data, placed = calibrated_without_outliers(data, at, question.noise)
    before = calibrated_pose(data, question.declared, question.noise, placed)
    if question.mesh_moves is not None:
        moves = question.mesh_moves
        data = with_mesh_errors_of(data, data.with_trials(lambda t: replace(t, mesh_moves=moves)), placed)
    data = with_errors_as_shown(data, placed)
    placed = calibrated_pose(data, at, question.noise, placed)
    free = Prior(question.coordinates, np.full(len(question.coordinates), np.inf))
    fit = fit_jointly(
        question.hypothesis,
        free,
        data.train,
        question.noise,
        data.placement_std,
        question.coordinates,
        own=own_of(placed),
        max_iterations=0,
    )
    rows = sum(jet.residual.size + jet.rest.size + 6 * len(t.poses) for t, jet in zip(data.train, fit.jets))
    problem = problem_of(data, fit, question.noise)
    r, jacobian = problem.rows_of(fit.jets, fit.fit.theta, True)
    assert jacobian is not None
    J, r = jacobian[:rows], r[:rows]  # the prior of β counts once, in the joint fit
    Q = basis_of(J[:, : fit.own])[0]
    B, r = _beside(Q, J[:, fit.own :]), _beside(Q, r)
    blocks = dict[str, Block]()
    if question.names:
        at_rest = any(len(t.scene.rest_marker) for t in data.train)
        todo = candidates_for(fit, data.control, forms=data.forms, names=question.names, has_placements=at_rest)
        fields = effect_fields(fit, data.train, todo)
        for i, one in enumerate(fields.todo):
            C = _beside(Q, whitened_columns(fit, problem, *fields.of(i))[:rows])
            if np.isfinite(C).all():
                blocks[_key(one)] = Block(C.T @ C, B.T @ C, C.T @ r)
    observations = float(sum(t.groups.observations for t in data.train))
    return NormalEquations(B.T @ B, B.T @ r, float(r @ r), observations, _squares(data, before), _squares(data, placed), blocks)


def _beside(Q: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(values - Q @ (Q.T @ values))


def _squares(data: Data, fitted: FittedModel) -> Squares:
    fitted_rows, held = [jet.residual for jet in fitted.fit.jets], fitted.held_residuals
    counts = [sum(len(r) for r in rows) for rows in (fitted_rows, held)]
    return Squares(sum(float((r**2).sum()) for r in fitted_rows), counts[0], sum(float((r**2).sum()) for r in held), counts[1])


def _key(one: Term) -> str:
    """Return the key of a candidate, the same in all recordings."""
    effect, seed, parameters = one
    whole = json_text(
        [effect.name, effect.discrete, plain(seed), [[p.key, str(p.part), p.scale] for p in parameters]], indent=None
    )
    return hashlib.blake2b(whole.encode(), digest_size=KEY).hexdigest()


# All recordings


Ask = Callable[[Question, Sequence[Recording]], Iterator[NormalEquations]]
"""Yields the normal equations of each recording, in order."""


def asked_here(forms: Sequence[Effect]) -> Ask:
    """Return a function that processes one recording after the other, in this process."""
    return lambda question, recordings: (normal_equations(question, r, forms) for r in recordings)


def asked_elsewhere(spread: Spread, forms: Sequence[Effect], own: Sequence[str | Path], folder: Path) -> Ask:
    """Return a function that processes recordings by `spread`: a task is the path of a recording and of a file with the question.

    Arguments:
        spread: runs the tasks.
        forms: forms of all effects; `own`: the files of user-defined ones.
        folder: for that file; workers on other machines must see it.
    """

    def ask(question: Question, recordings: Sequence[Recording]) -> Iterator[NormalEquations]:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".question-", dir=folder) as place:
            file = Path(place).absolute() / "question"
            Checkpoint((file, {}), forms).keep(question)
            task = str(file), file_hash(file), tuple(str(Path(path).absolute()) for path in own)
            yield from spread(answer, ((*task, str(r.folder)) for r in recordings))

    return ask


def answer(file: str, digest: str, own: tuple[str, ...], recording: str) -> NormalEquations:
    """Return the normal equations of a recording, in a worker.

    Arguments:
        file: file that contains the question; `digest`: its hash.
        own: files of a user's effects.
        recording: its folder.
    """
    question, forms = _question(file, digest, own)
    return normal_equations(question, load_recording(recording), forms)


@lru_cache(maxsize=1)
def _question(file: str, digest: str, own: tuple[str, ...]) -> tuple[Question, tuple[Effect, ...]]:
    forms = (*FORMS, *(load_own_effect(path) for path in own))
    question = Checkpoint((file, {}), forms).kept(Question)
    if question is None or file_hash(file) != digest:
        raise DataError(f"{file} cannot be read: check that the workers run the same femsense version and see the same files")
    return question, forms


def in_all_recordings(
    data: Data, search: Search, others: Sequence[Recording], names: Sequence[str], ask: Ask, progress: Progress
) -> Search:
    """Return a search whose last model is fitted to all recordings, without the effects that have no evidence there.

    Arguments:
        data: the searched recordings; `others`: all other ones.
        search: in these.
        names: effects that are tried.
        ask: returns the normal equations of the others.
        progress: called with the name of each step.
    """
    fitted, noise = search.final, search.noise
    for step in range(MOST_STEPS):
        progress(f"fitting to all {len(others) + len(data.train)} recordings (step {step + 1})")
        total = reduce(add, ask(_question_of(data, fitted, noise, ()), others))
        made = _with_others(data, fitted, noise, total)
        moved = np.abs(made.fit.coordinates - fitted.fit.coordinates) / np.maximum(made.fit.std, 1e-300)
        fitted = made
        if moved.max(initial=0.0) < STILL:
            break
    fitted, dropped = _with_evidence(data, fitted, search, noise)
    progress("screening effects in all recordings")
    screened = [n for n in names if n not in NUISANCE]
    here = [t.scene.recording for t in data.train]
    question = _question_of(data, fitted, noise, screened)
    total, own = reduce(add, ask(question, others)), reduce(add, (normal_equations(question, r, data.forms) for r in here))
    scores = _scores(data, fitted, screened, total + own)
    history = [h for h in search.history if h[0] in ("", *fitted.fit.hypothesis.names)]
    history = [*history[:-1], (history[-1][0], fitted)]
    seen = AllRecordings(
        recordings=len(others) + len(here),
        searched=len(here),
        **{
            f"{when}_{kind}_rms_m": value
            for when, squares in (("before", total.before + own.before), ("after", total.after + own.after))
            for kind, value in zip(("train", "validation"), squares.rms)
        },
        dbic={name: score for name, score in scores.items() if np.isfinite(score)},
    )
    refits = [replace(r, verdict=dropped.get(r.name, r.verdict)) if r.is_named else r for r in search.refits]
    return replace(search, history=history, final=fitted, refits=refits, everywhere=seen)


def _question_of(data: Data, fitted: FittedModel, noise: Noise, names: Sequence[str]) -> Question:
    fit = fitted.fit
    moves = next((t.mesh_moves for t in data.train), None)
    about = noise, data.placement_std, moves, data.mesh_as_shown
    return Question(data.robot_as_declared, fit.hypothesis, fit.coordinates, *about, tuple(names), data.thresholds)


def _with_others(data: Data, fitted: FittedModel, noise: Noise, total: NormalEquations) -> FittedModel:
    """Return a model fitted together with the normal equations of other recordings at its current values. Raises DataError."""
    prior = replace(fitted.fit.prior, others=total.rows(fitted.fit.coordinates))
    return fit_model(data, fitted.fit.hypothesis, prior, noise, fitted.fit.coordinates, own=own_of(fitted))


def _with_evidence(data: Data, fitted: FittedModel, search: Search, noise: Noise) -> tuple[FittedModel, dict[str, str]]:
    """Return a model without the effects that have no evidence in all recordings, tested from the last one on, and the verdicts on these."""
    verdicts = dict[str, str]()
    for name in reversed([effect.name for effect, _, _ in fitted.fit.hypothesis.terms if effect.name not in NUISANCE]):
        with contextlib.suppress(FemsenseError):  # no equilibrium without it: it stays
            without = without_effect(data, fitted, name, noise)
            cost = next((c.cost for c in (*search.last, *search.first) if c.effect.name == name), 0.0)
            gain = without.fit.chi2 - fitted.fit.chi2
            if gain - cost <= data.thresholds.evidence:
                fitted, verdicts[name] = without, f"too little evidence in all recordings (dBIC {gain - cost:.1f})"
    return fitted, verdicts


def _scores(data: Data, fitted: FittedModel, names: Sequence[str], total: NormalEquations) -> dict[str, float]:
    """Return the linear dBIC of the best form of each effect that a model lacks, in all recordings."""
    prior = 1.0 / fitted.fit.prior.std**2
    todo = candidates_for(fitted.fit, data.control, forms=data.forms, names=names, has_placements=False)
    effects, best = max(len({e.name for e, _, _ in todo}), 1), dict[str, float]()
    for effect, seed, parameters in todo:
        key = _key((effect, seed, parameters))
        if key not in total.candidates:
            continue
        matrix, offset = total.beside(key, prior)
        gain = float(offset @ offset - np.sum((offset + matrix.sum(axis=1)) ** 2))
        if not effect.discrete:
            gain = best_step(matrix, offset, parameters)[1]
        alone = sum(e is effect and len(p) == len(parameters) and s == seed for e, s, p in todo)
        score = gain - penalty(len(parameters), seed, alone, effects, total.observations)
        best[effect.name] = max(score, best.get(effect.name, -np.inf))
    return best
