"""Close the loop: screen all effects, refit the best candidates jointly, accept on held-out data, and return an improved robot.

The steps and their reasons are in docs/reference/closing-the-loop-rules.md.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.calib.reference import less_reference
from femsense.core.errors import FemsenseError, InputError
from femsense.core.parallel import beside, one_blas_thread
from femsense.io.checkpoint import Checkpoint
from femsense.loop.data.dataset import MESH, Data, prepare
from femsense.loop.design.next_experiment import next_experiment
from femsense.loop.design.next_steps import next_steps
from femsense.loop.fit.discretisation_error import make_finer
from femsense.loop.options import Measured, SearchOptions
from femsense.loop.result.loop_result import LoopResult, Verdict
from femsense.loop.result.records import RefitRecord
from femsense.loop.search.all_recordings import Ask, Spread, asked_elsewhere, asked_here, in_all_recordings, recordings_to_search
from femsense.loop.search.calibration import calibrated, with_discretisation_error
from femsense.loop.search.element_order import linear_suffice, need_quadratic, seeks_with_quadratic, with_quadratic
from femsense.loop.search.search import distinguishes_effects, new_search, search_effects
from femsense.loop.search.search_state import Progress, Search, SearchProgress
from femsense.loop.search.some_states import in_all_states, some_states
from femsense.loop.search.work_plan import ALL_STATES, CALIBRATION, SEARCH, VERDICT, WorkPlan
from femsense.loop.thresholds import DEFAULTS, EFFORT, Effort, Thresholds
from femsense.loop.verdict.verdict import conclude
from femsense.model.effects import EFFECTS, FORMS, Effect, find_effect, forms_by_recording, load_own_effect, try_own_effect
from femsense.model.recording import Recording, state_key
from femsense.model.robot import Robot

ELSE = "record other states than these: more levels of each input, several inputs together, and the way back"
"""The advice if no better experiment is known."""
MOST_STEPS = 3
"""Number of proposed next steps while an error remains."""


@dataclass(frozen=True, eq=False, slots=True)
class ImproveOptions(SearchOptions):
    """Options of `improve`: effects and measurements of the search, reference recordings, thresholds, and limits of the computation."""

    references: Sequence[Recording] = ()
    """Recordings of the same inputs without the load of interest (a weight, for example). Their residuals are subtracted from all other
    recordings (`femsense/calib/reference.py`)."""
    seed: int = 0
    """Seed of the permutation tests and the bootstrap."""
    thresholds: Thresholds = DEFAULTS
    """Decision thresholds; values other than the defaults are for studies of the loop itself."""
    effort: Effort = EFFORT
    """Limits of the computational effort."""
    spread: Spread | None = None
    """Maps a function over many recordings (`femsense.many.engines.spread`); None: in this process, one recording after the other."""
    keep: tuple[str | Path, Mapping[str, Any]] | None = None
    """A checkpoint file and the inputs that it must match: an interrupted search resumes from it, and a file with other inputs is ignored. It is
    removed at the end."""


@one_blas_thread()
def improve(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    validation: Sequence[Recording] = (),
    effects: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    progress: Progress | None = None,
    options: ImproveOptions | None = None,
) -> LoopResult:
    """Identify the physical effects that the declared model lacks, by stepwise model selection.

    Candidates (cable friction, slack, creep, payload, …: docs/effects) are fitted one at a time by nonlinear least squares, together with
    camera poses, modulus and inputs. One is accepted if its evidence (the decrease of χ² minus the BIC penalty of its parameters) is
    significant, and if it also improves the prediction of held-out sweeps. A sweep is an excursion of the inputs from their lowest level and
    back. docs/method/closing-the-loop.md describes the method.

    Arguments:
        robot: the declared robot.
        recordings: data to fit: markers, clouds or depth images.
        validation: data for the held-out error. Default: whole sweeps of `recordings` are held out.
        effects: names of effects to try (docs/effects). Default: all.
        without: names of effects to leave out.
        progress: called every few seconds, possibly from another thread, with a text: step, share of the work, remaining time.
        options: an `ImproveOptions`: user-defined effects, markers or clouds as measurements, checkpoint, limits of the computation.
            Default: `ImproveOptions()`.

    Returns:
        the result: `verdict`, accepted `effects` with their parameters and standard deviations, rejected ones with the reason, held-out errors [m], and
        `robot`, the improved robot.

    Raises:
        InputError: an unknown effect, or no recording.
        DataError: the data do not allow a fit.

    Example:
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> loop = fs.improve(robot, [recording], effects=["cable_friction", "stiffness"])
        >>> [(effect.name, round(effect.parameters["coefficient"].value, 2)) for effect in loop.effects]  # the truth: 0.15
        [('cable_friction', 0.15)]
    """
    work, options = WorkPlan(progress or (lambda text: None)), options or ImproveOptions()
    searched: Sequence[Recording]
    searched, others = _split(recordings, validation, options)
    task = _task(robot, searched, validation, effects, without, options, work, apart=not others)
    rng = np.random.default_rng(options.seed)
    with Checkpoint(options.keep, task.forms) as checkpoint, work.watching():
        data, search = _searched(task, checkpoint, work)
        if others:
            search = in_all_recordings(data, search, others, task.names, _ask(options, task.forms), work)
        work.plan([VERDICT], states_of(data), quadratic=data.robot.body.mesh.is_quadratic)
        work("testing the remaining residual")
        result = conclude(data, search, rng, correct=options.correct)
        record = next_experiment(data, search.final, search.noise, result.confounded, result.not_testable)
        noise_is_measured = result.model_error is None or result.model_error.noise_is_measured
        if result.verdict == Verdict.UNEXPLAINED or (result.confounded and not record):
            steps = next_steps(data, search.final, search.noise, noise_is_measured=noise_is_measured)
            record = "; or ".join(t for t in (*steps[:MOST_STEPS], record) if t) or ELSE
    result = replace(result, next_experiment=record, data=replace(result.data, seed=options.seed))
    if distinguishes_effects(data):
        return result
    only = "record another state (other inputs, load or direction of gravity): these data repeat too few states to distinguish effects"
    return replace(result, next_experiment="; ".join(t for t in (only, result.next_experiment) if t))


@one_blas_thread()
def search_recordings(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    effects: Sequence[str] | None = None,
    options: ImproveOptions | None = None,
) -> tuple[Data, Search]:
    """Return the data and the completed search, without the conclusion that `conclude` draws; arguments and errors as of `improve`."""
    options, work = options or ImproveOptions(), WorkPlan(lambda text: None)
    task = _task(robot, recordings, (), effects, None, options, work)
    with Checkpoint(options.keep, task.forms) as checkpoint:
        return _searched(task, checkpoint, work)


@dataclass(frozen=True, eq=False, slots=True)
class Task:
    """A search: the declared robot, the data, and the effects to try."""

    robot: Robot
    recordings: Sequence[Recording]
    validation: Sequence[Recording]
    names: list[str]
    forms: tuple[Effect, ...]
    """Of all effects."""
    options: ImproveOptions


def _split(
    recordings: Sequence[Recording], validation: Sequence[Recording], options: ImproveOptions
) -> tuple[list[Recording], list[Recording]]:
    """Return the recordings that are searched for effects, and the others; none of the latter with `validation` or `references`."""
    if validation or options.references or options.measured not in (Measured.auto, Measured.markers):
        return list(recordings), []
    return recordings_to_search(recordings, options.effort.recordings)


def _ask(options: ImproveOptions, forms: Sequence[Effect]) -> Ask:
    if options.spread is None:
        return asked_here(forms)
    folder = Path(tempfile.gettempdir()) if options.keep is None else Path(options.keep[0]).parent
    return asked_elsewhere(options.spread, forms, options.user_effects, folder)


def _task(
    robot: Robot,
    recordings: Sequence[Recording],
    validation: Sequence[Recording],
    effects: Sequence[str] | None,
    without: Sequence[str] | None,
    options: ImproveOptions,
    work: Progress,
    *,
    apart: bool = True,
) -> Task:
    """Return the search that is asked for, the residuals of references subtracted; effects have one value per recording too if `apart`. Raises InputError."""
    own = tuple(load_own_effect(file) for file in options.user_effects)
    for effect in own:
        try_own_effect(effect, robot)
    names = _names(effects, without, own)
    if options.references:  # they cancel the discretisation error of the declared mesh only
        names = [name for name in names if name != MESH.name]
    if not names:
        raise InputError(
            "no effect is left to try", where="effects, without", expected="one of those that femsense docs effects lists"
        )
    _require_one_that_acts(names if effects else [], own, robot, recordings)
    forms = (*FORMS, *(forms_by_recording(FORMS, recordings) if apart else ()), *own)
    if options.references:
        work("comparing with the reference")
        every = less_reference(robot, [*recordings, *validation], options.references)
        recordings, validation = every[: len(recordings)], every[len(recordings) :]
    return Task(robot, recordings, validation, names, forms, options)


def _data_on(body: Robot, task: Task, work: Progress) -> Data:
    """Return the data of a search on a robot: as declared, or with quadratic elements."""
    work("reading and calibrating")
    options = task.options
    return replace(
        prepare(body, task.recordings, task.validation, options.measured),
        forms=task.forms,
        declared=task.robot,
        thresholds=options.thresholds,
        effort=options.effort,
        relative=bool(options.references),
    )


def _begun(every: Data, names: Sequence[str], work: WorkPlan, *, quadratic: bool, refits: list[RefitRecord]) -> SearchProgress:
    """Return the state of a search in all states: calibrated, or as far as a search in representative states came."""
    elements, whole = {"quadratic": every.robot.body.mesh.is_quadratic}, states_of(every)
    some = some_states(every)
    with contextlib.suppress(FemsenseError):  # if an effect has no equilibrium in some state, the search runs in all states
        if some is not None:
            work.plan([CALIBRATION, SEARCH, ALL_STATES, VERDICT], states_of(some), **elements)
            state = _calibrated_search(some, names, work, quadratic, refits)
            search = search_effects(state, Checkpoint(None), work)[1]
            work.plan([ALL_STATES, SEARCH, VERDICT], whole, **elements)
            state = in_all_states(every, state, search, work)
            work.next_stage()
            return state
    work.plan([CALIBRATION, SEARCH, VERDICT], whole, **elements)
    return _calibrated_search(every, names, work, quadratic, refits)


def _calibrated_search(
    data: Data, names: Sequence[str], work: WorkPlan, quadratic: bool, refits: list[RefitRecord]
) -> SearchProgress:
    with beside(lambda: _get_ready(data.robot, names)) as finer_is_made:
        data, before, start = calibrated(data, work)
        finer_is_made()
    data = with_discretisation_error(data, start[-1][1], names, work)
    work.next_stage()
    return new_search((data, before, start), names, refits, quadratic=quadratic)


def _searched(task: Task, checkpoint: Checkpoint, work: WorkPlan) -> tuple[Data, Search]:
    """Return the data and the search: on quadratic elements if the robot declares linear ones and the data need quadratic ones, else on the declared
    mesh. An interrupted search resumes."""
    robot, names, refits = task.robot, task.names, list[RefitRecord]()
    linear_names = [name for name in names if name != MESH.name]
    asks = seeks_with_quadratic(robot, names)
    kept = checkpoint.kept(SearchProgress)
    if kept is not None:
        work(f"resuming the search (effects found: {kept.found})")
    if asks and kept is None:
        data = _data_on(robot, task, work)
        work.plan([CALIBRATION, SEARCH], states_of(data), quadratic=False)
        work("testing whether linear elements suffice")
        record = linear_suffice(data)
        if record is not None:
            state = _begun(replace(data, mesh_as_shown=True), linear_names, work, quadratic=False, refits=[record])
            return search_effects(state, checkpoint, work)
    if asks and (kept is None or kept.quadratic):
        with contextlib.suppress(FemsenseError):  # linear elements lock, and converge in states where quadratic ones fold
            state = kept or _begun(_data_on(with_quadratic(robot), task, work), names, work, quadratic=True, refits=[])
            data, search = search_effects(state, checkpoint, work)
            work("testing whether quadratic elements are needed")
            needed, refits = need_quadratic(data, search, names)
            if needed:
                return data, replace(search, refits=[*refits, *search.refits])
            names = linear_names
        kept = None
    state = kept or _begun(_data_on(robot, task, work), names, work, quadratic=False, refits=refits)
    return search_effects(state, checkpoint, work)


def states_of(data: Data) -> int:
    """Return the number of distinct states that are fitted."""
    return len({state_key(t.scene.recording, int(k)) for t in data.train for k in t.scene.frames})


def _get_ready(robot: Robot, names: Sequence[str]) -> None:
    """Start slow independent work early: make the finer mesh, and import Open3D, which casts the rays of the camera of the next experiment."""
    make_finer(robot, names)
    importlib.import_module("open3d")


def _names(effects: Sequence[str] | None, without: Sequence[str] | None, own: Sequence[Effect]) -> list[str]:
    mine = [effect.name for effect in own]
    for name in [*(effects or []), *(without or [])]:
        if name not in mine:
            find_effect(name)
    chosen = [*(e.name for e in EFFECTS), *mine] if effects is None else list(effects)
    return [name for name in chosen if name not in (without or [])]


def _require_one_that_acts(names: Sequence[str], own: Sequence[Effect], robot: Robot, recordings: Sequence[Recording]) -> None:
    """Raise InputError if none of the requested effects can act in the recordings."""
    asked = [effect for effect in (*EFFECTS, *own) if effect.name in names]
    drives = sorted({r.actuation for r in recordings})
    if asked and not any(effect.discrete or effect.parameters(robot, control) for effect in asked for control in drives):
        raise InputError(
            "none of these effects can act here",
            where="effects",
            found=", ".join(names),
            expected=f"effects of a robot that is driven by {' or '.join(drives)} (femsense docs effects)",
        )
