"""Close the loop: measure the residual, screen every effect, refit the best jointly, decide on held-out data, hand back a better model.

The order of things: split by sweeps; calibrate the declared model (that is "before"); fit what calibration may always move (poses,
initial inputs, modulus, zeros of the cables), on quadratic elements where linear ones are declared; ask what the mesh itself costs; estimate the noise; screen; refit the best few in full
nonlinearity; accept one if BIC, its physical range, the sweeps that are left out and the held-out data agree; start again from the
better model until nothing passes.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import DataError, FemsenseError, InputError
from femsense.core.parallel import beside, one_blas_thread
from femsense.io.checkpoint import Checkpoint
from femsense.loop.data.dataset import MESH, Data, prepare
from femsense.loop.data.outliers import without_outliers
from femsense.loop.design.next_experiment import next_experiment
from femsense.loop.fit.discretisation_error import errs_alike, few_states, make_finer, with_mesh_errors
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, rematched, roughly_keeping, weighed, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.marker_placement import with_turning_placements
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result import LoopResult
from femsense.loop.search.acceptance import discretisation_rms, moved_by
from femsense.loop.search.effect_fields import Fields, fields_of
from femsense.loop.search.element_order import need_quadratic, seeks_with_quadratic, with_quadratic
from femsense.loop.search.forward_selection import select_next, shortlist
from femsense.loop.search.input_offset import instead_of_offsets
from femsense.loop.search.pruning import prune
from femsense.loop.search.refit import EVIDENCE, evidence
from femsense.loop.search.screening import Candidate, noise_of, screen_model
from femsense.loop.search.search_state import Progress, Refit, Search, SearchProgress
from femsense.loop.search.subsampling import spares
from femsense.loop.search.swaps import BETTER, History, swapped
from femsense.loop.verdict.verdict import conclude
from femsense.model.effects import EFFECTS, FORMS, OF_BODY, Effect, find_effect, load_own_effect, try_own_effect
from femsense.model.observation import Hypothesis, SceneJet
from femsense.model.recording import Recording, state_key
from femsense.model.robot import Robot

MAX_EFFECTS = 3
Ready = tuple[Data, FittedModel, History]
"""Data, the declared model with its camera calibrated, and the models that effects are sought on top of."""
STATES = 5
"""So many different states can tell effects apart though what is held out only repeats them."""
START = Noise({"white": 5e-4}, "start")
"""The noise until it is estimated."""
MATCHINGS = 6
"""Times that the rows of clouds are made again, at most: from a camera that is 20 mrad off, four left a gain of 0 to 27, as rounding had it."""
ROUGHLY, STEPS = 4, 12
"""Steps of the fit whose residual tells the noise; and at most with that, to the end …"""
SPARED = 0.01
"""… or, on large meshes, to where they promise less than this share of what an effect promises on top."""


@one_blas_thread()
def improve(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    validation: Sequence[Recording] = (),
    effects: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    user_effects: Sequence[str | Path] = (),
    measured: str = "auto",
    progress: Progress | None = None,
    seed: int = 0,
    keep: tuple[str | Path, Mapping[str, Any]] | None = None,
) -> LoopResult:
    """Find what the model lacks, add it, and report the error on held-out data before and after.

    Arguments:
        robot: the declared robot.
        recordings: data to fit: markers, clouds or depth images.
        validation: data to judge on; by default whole sweeps of the recordings are held out.
        effects: names to try; by default all.
        without: names to leave out.
        user_effects: Python files of effects that are tried too (docs/effects/own.md); they belong to "all".
        measured: "markers", "clouds" or "both": what is used of a recording; "auto": its markers, or its clouds where it has none.
        progress: told what is going on.
        seed: of the permutation test and the bootstrap.
        keep: a file that holds how far the search has come, so that one that is killed goes on there, and what it is made from: a file that says
            something else is not used. It is removed at the end.

    Raises:
        InputError: unknown names, no recording; DataError: the data do not allow a fit.
    """
    say = progress or (lambda text: None)
    own = tuple(load_own_effect(file) for file in user_effects)
    for effect in own:
        try_own_effect(effect, robot)
    names = _names(effects, without, own)
    if not names:
        raise InputError("no effect is left to try", where="effects, without", expected="at least one of docs/effects/")
    _require_one_that_acts(names if effects else [], own, robot, recordings)
    rng = np.random.default_rng(seed)

    def ready(body: Robot, names: Sequence[str]) -> Ready:
        say("reading and calibrating")
        with beside(lambda: _get_ready(body, names)) as finer_is_made:
            data = prepare(body, recordings, validation, measured)
            data, before, start = _calibrated(replace(data, forms=(*FORMS, *own), declared=robot), say)
            finer_is_made()
        return _with_discretisation_error(data, start[-1][1], names, say), before, start

    with Checkpoint(keep, (*FORMS, *own)) as checkpoint:
        data, search = _searched(robot, names, ready, checkpoint, say)
        say("testing what is left")
        result = conclude(data, search, rng)
        record = next_experiment(data, search.final, search.noise, result.confounded, result.not_testable)
    result = replace(result, next_experiment=record, data={**result.data, "seed": seed})
    if _tells_apart(data):
        return result
    only = "record another state (other inputs, load or direction of gravity): these data repeat too few states, which cannot tell effects apart"
    return replace(result, next_experiment="; ".join(t for t in (only, result.next_experiment) if t))


def _searched(
    robot: Robot, names: list[str], ready: Callable[[Robot, Sequence[str]], Ready], checkpoint: Checkpoint, say: Progress
) -> tuple[Data, Search]:
    """Return the data with what a search finds in them: on quadratic elements where the robot declares linear ones and the data miss those, else on what
    is declared. One that was killed goes on where it was."""
    refits: list[dict[str, Any]] = []
    kept = checkpoint.kept(SearchProgress)
    if kept is not None:
        say(f"going on where it stopped (effects found: {kept.found})")
    if seeks_with_quadratic(robot, names) and (kept is None or kept.quadratic):
        with contextlib.suppress(FemsenseError):  # linear elements lock, and come to rest where quadratic ones fold
            course = kept or _begun(ready(with_quadratic(robot), names), names, [], quadratic=True)
            data, search = _search(course, checkpoint, say)
            say("asking whether quadratic elements are needed")
            needed, refits = need_quadratic(data, search, names)
            if needed:
                return data, replace(search, refits=[*refits, *search.refits])
            names = [name for name in names if name != MESH.name]
        kept = None
    return _search(kept or _begun(ready(robot, names), names, refits, quadratic=False), checkpoint, say)


def _get_ready(robot: Robot, names: Sequence[str]) -> None:
    """Begin what takes seconds and waits for nothing: the finer mesh, and loading Open3D, whose rays say what the next experiment's camera sees."""
    make_finer(robot, names)
    importlib.import_module("open3d")


def _calibrated(data: Data, say: Progress) -> Ready:
    """Return the data without strays, the declared model calibrated, and the model with all that calibration may move; before that the same on the
    declared mesh, where it is another one."""
    placed = _placed(data, data.robot, START)
    while (fewer := without_outliers(data, [jet.residual for jet in placed.fit.jets], placed.held_residuals)) is not data:
        data, placed = fewer, _placed(fewer, data.robot, START)
    say("fitting what calibration may move")
    base = _calibrated_on(data, data.robot, placed)
    if "clouds" in data.measured:
        say("matching the clouds again")
        rough = base.fit.normal_rms
        data, base = _matched(data, base, START if rough is None else replace(START, surface={"white": rough}), anew=True)
        placed = _placed(data, data.robot, START, placed)
    if not data.settled:
        return data, placed, [("", base)]
    declared = data.robot_as_declared
    before = _placed(data, declared, START)
    return data, before, [("", _calibrated_on(data, declared, before)), (MESH.name, base)]


def _placed(data: Data, robot: Robot, noise: Noise, start: FittedModel | None = None) -> FittedModel:
    """Return a robot with its camera calibrated."""
    nothing = Prior(np.zeros(0), np.zeros(0))
    own = None if start is None else own_of(start)
    return fit_model(data, Hypothesis(robot), nothing, noise, np.zeros(0), own=own)


def _calibrated_on(data: Data, robot: Robot, placed: FittedModel) -> FittedModel:
    """Return a robot with all that calibration may move, fitted roughly. To begin with some of the states leads elsewhere: what the model lacks pulls
    zeros and modulus further where fewer states hold them."""
    hypothesis, prior = with_nuisance(data, robot)
    nothing = np.zeros(len(prior.mean))
    return _as_far_as_held_out_states_rest(
        lambda steps: fit_model(data, hypothesis, prior, START, nothing, own=own_of(placed), max_iterations=steps), ROUGHLY
    )


def _with_discretisation_error(data: Data, base: FittedModel, names: Sequence[str], say: Progress) -> Data:
    """Return the data with what the mesh costs, and seats that turn with the body."""
    say("asking what the mesh costs")
    try:  # zeros may have gone far, for an effect's sake
        frames = [few_states(t, len(base.fit.hypothesis.robot.body.mesh.tets)) for t in data.train]
        plain = roughly_keeping(data, base, OF_BODY, START, frames)
    except FemsenseError:
        plain = base
    return with_turning_placements(with_mesh_errors(data, plain, names), base)


def _as_far_as_held_out_states_rest(fit: Callable[[int], FittedModel], steps: int) -> FittedModel:
    """Return a fit of so many steps, or of fewer where a held-out state collapses beyond: what calibration may move is no reason to fail, since it
    may go far for the sake of an effect that is not found yet. Raises DataError where the start has no equilibrium either."""
    for most in (steps, 2, 1):
        with contextlib.suppress(DataError):
            return fit(most)
    return fit(0)


def _begun(ready: Ready, names: Sequence[str], refits: list[dict[str, Any]], *, quadratic: bool) -> SearchProgress:
    """Return a search on top of the last model of a history that has found nothing yet."""
    data, before, history = ready
    last = history[-1][1]
    return SearchProgress(data, data, before, list(history), len(history), last, last, list(names), quadratic, refits)


def _search(course: SearchProgress, checkpoint: Checkpoint, say: Progress) -> tuple[Data, Search]:
    """Screen, refit and add effects until none passes; return the data as the last model has them, and the search."""
    while not course.over:
        checkpoint.keep(course)
        say(f"screening effects ({course.found} found so far)")
        _take_step(course, say)
    checkpoint.keep(course)
    data, history, noise = course.data, course.history, course.noise
    assert noise is not None
    fitted, refits, before = course.fitted, course.refits, course.before
    most = _most_effects(data)
    swap = instead_of_offsets(data, fitted, course.names, noise, course.n_effective, say) if most else None
    if swap is not None:
        refits = [*refits, *({**record, "step": len(history)} for record in swap.records)]
        if swap.fitted is not None:
            fitted, history = swap.fitted, [*history, (swap.name, swap.fitted)]
    if len(history) > 1 and "clouds" in data.measured:
        before = _placed(data, data.robot_as_declared, noise, before)  # before and after on the same rows
    found = Search(before, history, course.base, fitted, noise, course.n_effective, course.first, course.table, refits, swap)
    return data, found


def _most_effects(data: Data) -> int:
    return MAX_EFFECTS if _tells_apart(data) else 0


def _take_step(course: SearchProgress, say: Progress) -> None:
    """Screen what a model may lack and add the effect that comes next; where none does, the search is over."""
    names, found = course.names, course.found
    data, fitted, noise, fields = course.data, course.fitted, course.noise, course.fields
    if found and "clouds" in data.measured:
        assert noise is not None
        fields = None
        data, fitted = _matched(data, fitted, noise)
    try:
        fitted, noise, n_effective, fields, table = _screened(data, fitted, fields, noise, names)
    except FemsenseError as error:
        if not found:
            raise
        course.take_back(error)
        return
    history, refits, ties = [*course.history[:-1], (course.history[-1][0], fitted)], course.refits, course.ties
    course.data, course.fitted, course.noise, course.n_effective = data, fitted, noise, n_effective
    course.fields, course.table, course.history = fields, table, history
    if not found:
        course.base, course.first = fitted, table
    if found >= _most_effects(data):
        course.over = True
        return
    next_one, others, tried = select_next(data, fitted, table, noise, say)
    refits = [*refits, *({**record, "step": len(history)} for record in tried)]
    if next_one is None and ties:
        instead, next_one, tried = _beside_a_tie(data, fitted, ties[0], fields, noise, names, n_effective, say)
        if next_one is not None:
            history[-1] = (ties[0].candidate.effect.name, instead)
            refits = [
                *_renamed(refits, len(history) - 1, history[-1][0]),
                *({**record, "step": len(history)} for record in tried),
            ]
            fitted, others = instead, []
    course.refits = refits
    if next_one is None:
        course.over = True
        return
    course.earlier = data
    name, winner, course.ties = next_one.candidate.effect.name, next_one.fitted, others
    anew = moved_by(fitted, winner) > discretisation_rms(data, fitted, whole=True) and not errs_alike(fitted, winner)
    fitted = prune(data, winner, noise, n_effective, say)
    history = [*history, (name, fitted)]
    data = with_turning_placements(with_mesh_errors(data, fitted, names) if anew else data, fitted)
    found_so = history
    history, refits = swapped(data, history, refits, noise, n_effective, say)
    if history is not found_so:
        history[-1] = (history[-1][0], prune(data, history[-1][1], noise, n_effective, say))
    course.data, course.history, course.refits, course.fitted = data, history, refits, history[-1][1]


def _screened(
    data: Data, fitted: FittedModel, before: Fields | None, noise: Noise | None, names: Sequence[str]
) -> tuple[FittedModel, Noise, float, Fields, list[Candidate]]:
    """Return a stage fitted with the noise that its residual tells, that noise, the effective number of observations, and the fields and scores
    of what may come next: by the fields of the model before, as long as these promise nothing."""
    fields = _fields(data, fitted, before, names)
    noise, n_effective = noise_of(data, fitted, fields, noise)
    fitted = _again(data, fitted, noise, known=fitted.fit.jets, spare=_spared(data, fitted, fields, noise, n_effective))
    return fitted, noise, n_effective, *_scored(data, fitted, fields, noise, names, n_effective)


def _spared(data: Data, fitted: FittedModel, fields: Fields, noise: Noise, n_effective: float) -> float:
    """Return what a stage need not gain any more before effects are tried on top of it, since one of these promises so much more; nothing where all
    states are little work."""
    if not spares(data, fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)):
        return 0.0
    fit = weighed(data, fitted.fit, noise, fitted.fit.jets)
    return SPARED * max((c.gain for c in screen_model(data, fit, noise, fields, n_effective)), default=0.0)


def _fields(data: Data, fitted: FittedModel, before: Fields | None, names: Sequence[str]) -> Fields:
    """Return the fields of the model before where they tell what may come next, else those of the stage itself."""
    hints = None if before is None else before.beside(fitted.fit)
    return fields_of(data, fitted, names) if hints is None else hints


def _scored(
    data: Data, fitted: FittedModel, fields: Fields, noise: Noise, names: Sequence[str], n_effective: float
) -> tuple[Fields, list[Candidate]]:
    """Return fields and the scores by them: those of the stage itself where others promise something."""
    table = screen_model(data, fitted.fit, noise, fields, n_effective)
    if fields.model is fitted.fit.hypothesis or not shortlist(table, first=False):
        return fields, table
    fields = fields_of(data, fitted, names)
    return fields, screen_model(data, fitted.fit, noise, fields, n_effective)


def _beside_a_tie(
    data: Data,
    fitted: FittedModel,
    tie: Refit,
    fields: Fields | None,
    noise: Noise,
    names: Sequence[str],
    n_effective: float,
    say: Progress,
) -> tuple[FittedModel, Refit | None, list[dict[str, Any]]]:
    """Return the model with what was as good as the last effect in its place, and what comes next there, or None: the two together must be
    better than the stage. What hides behind a wrong one of two that look alike shows beside the right one."""
    say(f"trying {tie.candidate.effect.name} in the place of the last one, and what goes with it")
    jets = tie.fitted.fit.jets
    same = "clouds" not in data.measured
    instead = _again(data, tie.fitted, noise, known=jets if same else None, near=None if same else jets)
    _, table = _scored(data, instead, _fields(data, instead, fields, names), noise, names, n_effective)
    both, _, tried = select_next(data, instead, table, noise, say)
    if both is None or evidence(fitted.fit, both.fitted.fit) - both.candidate.cost <= BETTER:
        return instead, None, []
    return instead, both, tried


def _renamed(refits: list[dict[str, Any]], step: int, name: str) -> list[dict[str, Any]]:
    """Return what became of candidates where another one is named at a step."""
    said = {True: "named", False: "passes"}
    return [
        {**r, "verdict": said[r["name"] == name]} if r["step"] == step and r["verdict"] in said.values() else r for r in refits
    ]


def _matched(data: Data, fitted: FittedModel, noise: Noise, *, anew: bool = False) -> tuple[Data, FittedModel]:
    """Return the data with the rows of clouds as a stage has them, and the stage fitted to these, time and again until neither changes much: what is
    rounded off where the model was draws it back there. With `anew` it is asked again which rows there are."""
    for _ in range(MATCHINGS):
        data = rematched(data, fitted, noise, anew=anew)
        fitted = _again(data, fitted, noise, near=None if anew else fitted.fit.jets)
        if fitted.fit.fit.cost[0] - fitted.fit.chi2 <= EVIDENCE / 2.0:
            break
    return data, fitted


def _again(
    data: Data,
    fitted: FittedModel,
    noise: Noise,
    *,
    known: list[SceneJet] | None = None,
    near: list[SceneJet] | None = None,
    spare: float = 0.0,
) -> FittedModel:
    """Return a stage fitted to other weights or rows, from where it is: with derivatives that are known there, or that are near."""
    fit, own = fitted.fit, own_of(fitted)

    def refitted(steps: int) -> FittedModel:
        return fit_model(
            data,
            fit.hypothesis,
            fit.prior,
            noise,
            fit.coordinates,
            own=own,
            max_iterations=steps,
            known=known,
            near=near,
            spare=spare,
        )

    return _as_far_as_held_out_states_rest(refitted, STEPS)


def _names(effects: Sequence[str] | None, without: Sequence[str] | None, own: Sequence[Effect]) -> list[str]:
    mine = [effect.name for effect in own]
    for name in [*(effects or []), *(without or [])]:
        if name not in mine:
            find_effect(name)
    chosen = [*(e.name for e in EFFECTS), *mine] if effects is None else list(effects)
    return [name for name in chosen if name not in (without or [])]


def _require_one_that_acts(names: Sequence[str], own: Sequence[Effect], robot: Robot, recordings: Sequence[Recording]) -> None:
    """Raise InputError where none of the effects that are asked for can act in the recordings: nothing would be tried then."""
    asked = [effect for effect in (*EFFECTS, *own) if effect.name in names]
    drives = sorted({r.actuation for r in recordings})
    if asked and not any(effect.discrete or effect.parameters(robot, control) for effect in asked for control in drives):
        raise InputError(
            "none of these effects can act here",
            where="effects",
            found=", ".join(names),
            expected=f"effects of a robot that is driven by {' or '.join(drives)} (docs/effects/)",
        )


def _tells_apart(data: Data) -> bool:
    """Return whether these data can tell effects apart: a state that is not fitted is held out, or STATES different ones are fitted."""
    fitted = {state_key(t.scene.recording, int(k)) for t in data.train for k in t.scene.frames}
    fresh = any(state_key(t.scene.recording, int(k)) not in fitted for t in data.held for k in t.scene.frames)
    return fresh or len(fitted) >= STATES
