"""Close the loop: measure the residual, screen every effect, refit the best jointly, decide on held-out data, hand back a better model.

The order of things: split by sweeps; calibrate the declared model (that is "before"); fit what calibration may always move (poses,
initial inputs, modulus, zeros of the cables); estimate the noise; screen; refit the best few in full nonlinearity; accept one if
BIC, its physical range and the held-out sweeps agree; start again from the better model until nothing passes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.arrays import FloatArray, IntArray
from femsense.calib.calibrate import calibrate, input_bounds, usable_frames
from femsense.calib.forward import Hypothesis, Scene, evaluate_scene, make_scene
from femsense.effects import EFFECTS, FORMS, Effect, Entry, Parameter, apply_effects, find_effect, load_own_effect
from femsense.effects.loads import STANDARD_GRAVITY
from femsense.errors import DataError, FemsenseError, InputError
from femsense.loop.joint import JointFit, JointProblem, Prior, Trial, fit_jointly, rms_of
from femsense.loop.noise import Groups, Noise, estimate_noise
from femsense.loop.result import LoopResult
from femsense.loop.screen import NUISANCE, TESTABLE, Candidate, Fields, candidates_for, confounding, effect_fields, screen
from femsense.loop.split import hold_out, sweeps_of
from femsense.loop.structure import describe_left, structure_test
from femsense.model import Robot
from femsense.recording import Recording, check_against, state_key

MAX_EFFECTS = 3
MAX_ROWS = 3000
"""Marker rows a recording at most; more are thinned out by whole frames."""
REFITS = 4
"""Candidates that are refitted in full nonlinearity at each step."""
EVIDENCE = 10.0
"""dBIC that a named effect needs."""
WORTH = 0.03
"""Share of the held-out error that an effect must take away to be worth naming."""
SIGNIFICANT = 3.0
RELEVANT = 0.02
"""A nuisance that moved by more than three standard deviations and 2 % is named as an effect."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False, slots=True)
class Data:
    """Recordings, split."""

    robot: Robot
    control: str
    train: list[Trial]
    held: list[Trial]
    held_of: list[int | None]
    """The training trial whose pose a held-out trial shares; None: it gets its own."""
    split: list[str]
    seat_std: float
    input_scale: FloatArray
    """Typical range of each cable's input [N] or [m], shape (a,)."""
    forms: tuple[Effect, ...] = FORMS
    """What may be tried, a user's effects among it."""


@dataclass(frozen=True, eq=False, slots=True)
class Stage:
    """A model with its fit and its error on held-out data."""

    fit: JointFit
    held_residuals: list[FloatArray]
    held_rms: float


def improve(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    validation: Sequence[Recording] = (),
    effects: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    user_effects: Sequence[str | Path] = (),
    progress: Progress | None = None,
    seed: int = 0,
) -> LoopResult:
    """Find what the model lacks, add it, and report the error on held-out data before and after.

    Arguments:
        robot: the declared robot.
        recordings: data to fit; their markers are used.
        validation: data to judge on; by default whole sweeps of the recordings are held out.
        effects: names to try; by default all.
        without: names to leave out.
        user_effects: Python files of effects that are tried too (docs/effects/own.md); they belong to "all".
        progress: told what is going on.
        seed: of the permutation test and the bootstrap.

    Raises:
        InputError: unknown names, no recording; DataError: the data do not allow a fit.
    """
    say = progress or (lambda text: None)
    own = tuple(load_own_effect(file) for file in user_effects)
    names = _names(effects, without, own)
    rng = np.random.default_rng(seed)
    say("reading and calibrating")
    data = replace(prepare(robot, recordings, validation), forms=(*FORMS, *own))
    noise = Noise({"white": 5e-4}, "start")
    before = _stage(data, Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), noise, np.zeros(0))
    hypothesis, prior = _with_nuisance(data)
    say("fitting what calibration may move")
    base = _stage(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    history = [base]
    table, first, refits = list[Candidate](), list[Candidate](), list[dict[str, Any]]()
    growing = _fresh(data)
    while True:
        say(f"screening effects ({len(history) - 1} found so far)")
        fields = _fields(data, history[-1], names)
        noise, n_effective = _noise(data, history[-1], fields)
        here = history[-1].fit
        history[-1] = _stage(data, here.hypothesis, here.prior, noise, here.coordinates, own=_own(history[-1]))
        table = _screen(data, history[-1].fit, noise, fields, n_effective)
        first = first or table
        if not growing or len(history) > MAX_EFFECTS:
            break
        winner, tried = _best_refit(data, history[-1], table, noise, n_effective, say)
        refits += tried
        if winner is None:
            break
        history.append(winner)
    say("testing what is left")
    result = _conclude(data, before, history, noise, n_effective, table, first, refits, rng)
    if growing:
        return result
    only = "record another state (other inputs, load or direction of gravity): these data repeat one state, which cannot tell effects apart"
    return replace(result, next_experiment="; ".join(t for t in (only, result.next_experiment) if t))


def _names(effects: Sequence[str] | None, without: Sequence[str] | None, own: Sequence[Effect]) -> list[str]:
    mine = [effect.name for effect in own]
    for name in [*(effects or []), *(without or [])]:
        if name not in mine:
            find_effect(name)
    chosen = [*(e.name for e in EFFECTS), *mine] if effects is None else list(effects)
    return [name for name in chosen if name not in (without or [])]


# --- data ----------------------------------------------------------------------------------------------------------------


def prepare(robot: Robot, recordings: Sequence[Recording], validation: Sequence[Recording]) -> Data:
    """Check the recordings, split them, and calibrate each for a start. Raises InputError or DataError."""
    if not recordings:
        raise InputError("nothing to learn from", where="recordings", expected="at least one recording")
    recordings = [check_against(robot, r) for r in recordings]
    validation = [check_against(robot, r) for r in validation]
    control = recordings[0].actuation
    if any(r.actuation != control for r in [*recordings, *validation]):
        raise InputError(
            "recordings differ in actuation",
            where="recordings",
            found=[r.actuation for r in [*recordings, *validation]],
            expected="all tension or all displacement",
        )
    train: list[Trial] = []
    held: list[Trial] = []
    held_of: list[int | None] = []
    words: list[str] = []
    for i, recording in enumerate(recordings):
        frames = _marked_frames(recording)
        fitted, kept, how = (
            (frames, frames[:0], "all frames fitted; held out: other recordings") if validation else hold_out(recording, frames)
        )
        if not len(kept) and not validation:
            raise DataError("one frame is too few to hold anything out: record more frames, or give --validation")
        trial = _trial(robot, recording, fitted)
        train.append(trial)
        words.append(how)
        if len(kept):
            held.append(
                replace(
                    trial,
                    scene=make_scene(robot, recording, kept),
                    groups=_groups(recording, make_scene(robot, recording, kept)),
                    starts={},
                )
            )
            held_of.append(i)
    for recording in validation:
        held.append(_trial(robot, recording, _marked_frames(recording), first_only=True))
        held_of.append(None)
        words.append("validation recording")
    rest = [r for t in train for r in [_rest_spread(robot, t)] if r is not None]
    scale = np.max([np.ptp(r.inputs, axis=0) if r.inputs.size else np.zeros(len(robot.body.cables)) for r in recordings], axis=0)
    return Data(robot, control, train, held, held_of, words, float(np.sqrt(np.mean(np.square(rest)))) if rest else 1e-3, scale)


def _marked_frames(recording: Recording) -> IntArray:
    frames = usable_frames(recording)
    frames = frames[np.isin(frames, recording.marker_frame)]
    if not len(frames):
        raise DataError(
            "no frame with markers is free of undeclared contact: the loop needs markers in free frames (or declared loads)"
        )
    rows = int(np.isin(recording.marker_frame, frames).sum())
    return frames[:: max(1, int(np.ceil(rows / MAX_ROWS)))]


def _trial(robot: Robot, recording: Recording, frames: IntArray, *, first_only: bool = False) -> Trial:
    """Return a recording with a calibration to start from; `first_only` fits its pose on its first frames."""
    few = frames[: max(1, round(0.2 * len(frames)))] if first_only else frames
    calibration = calibrate(robot, recording, frames=few.tolist())
    scene = make_scene(robot, recording, frames)
    initial = None
    if recording.actuation_zero == "unknown" and robot.body.cables:
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    low, high = input_bounds(robot, recording)
    return Trial(scene, _groups(recording, scene), calibration.poses, initial, low, high, {})


def _groups(recording: Recording, scene: Scene) -> Groups:
    keys = {k: state_key(recording, int(k)) for k in np.unique(scene.frame)}
    sweep = dict(zip(scene.frames.tolist(), sweeps_of(recording, scene.frames)))
    state = np.unique([f"{m}:{keys[f].hex()}" for m, f in zip(scene.marker, scene.frame)], return_inverse=True)[1]
    return Groups(
        np.unique(scene.marker, return_inverse=True)[1],
        np.unique(scene.frame, return_inverse=True)[1],
        np.unique([sweep[int(f)] for f in scene.frame], return_inverse=True)[1],
        state,
    )


def _rest_spread(robot: Robot, trial: Trial) -> float | None:
    from femsense.calib.forward import rest_residual

    if not len(trial.scene.rest_marker):
        return None
    return max(float(np.sqrt((rest_residual(robot, trial.scene, trial.poses) ** 2).mean())), 1e-4)


# --- stages --------------------------------------------------------------------------------------------------------------


def _with_nuisance(data: Data) -> tuple[Hypothesis, Prior]:
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


def _stage(
    data: Data,
    hypothesis: Hypothesis,
    prior: Prior,
    noise: Noise,
    coordinates: FloatArray,
    *,
    own: FloatArray | None = None,
    max_iterations: int = 12,
) -> Stage:
    fit = fit_jointly(hypothesis, prior, data.train, noise, data.seat_std, coordinates, own=own, max_iterations=max_iterations)
    residuals = _held_residuals(data, fit, noise)
    return Stage(fit, residuals, rms_of(residuals))


def _own(stage: Stage) -> FloatArray:
    return np.array(stage.fit.fit.theta[: stage.fit.own])


def _held_residuals(data: Data, fit: JointFit, noise: Noise) -> list[FloatArray]:
    """Return the residuals of the held-out data (k, 3); a recording of its own gets its own pose from its first frames."""
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
            starts=trial.starts,
        )
        result.append(jet.residual)
    return result


def _pose_on_first_frames(
    robot: Robot, trial: Trial, noise: Noise, seat_std: float, pivot: FloatArray
) -> tuple[list[FloatArray], FloatArray | None]:
    frames = trial.scene.frames
    scene = trial.scene.pick(frames[: max(1, round(0.2 * len(frames)))])
    first = replace(trial, scene=scene, groups=_groups(scene.recording, scene), starts={})
    fit = fit_jointly(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [first], noise, seat_std, np.zeros(0))
    return first.place(fit.fit.theta, pivot)


def _fields(data: Data, stage: Stage, names: Sequence[str]) -> Fields:
    """Return what each effect that is not in the model yet would do to the markers."""
    seated = any(len(t.scene.rest_marker) for t in data.train)
    todo = candidates_for(
        stage.fit, data.control, forms=data.forms, names=[n for n in names if n not in NUISANCE], has_seats=seated
    )
    return effect_fields(stage.fit, data.train, todo)


def _problem(data: Data, fit: JointFit, noise: Noise) -> JointProblem:
    return JointProblem(fit.hypothesis, fit.prior, data.train, [noise.whitener(t.groups) for t in data.train], data.seat_std)


def _noise(data: Data, stage: Stage, fields: Fields) -> tuple[Noise, float]:
    """Estimate the noise from what the richest linear model leaves; return it with the effective number of observations."""
    table = screen(stage.fit, _problem(data, stage.fit, Noise({"white": 5e-4}, "")), fields, 100.0)
    own = sum(t.size for t in data.train)
    columns, extra, at = [], [], 0
    for i, (trial, jet) in enumerate(zip(data.train, stage.fit.jets)):
        k = len(jet.residual)
        block = np.zeros((k, 3, own))
        block[:, :, at : at + 6 * len(trial.poses)] = jet.by_pose
        block[:, :, at + 6 * len(trial.poses) : at + trial.size] = jet.by_initial
        at += trial.size
        columns.append(np.concatenate([block, jet.by_effect], axis=2))
        others = [c.raw[i] for c in _one_each(table) if c.effect.name != "marker_offset"]
        extra.append(np.concatenate([np.zeros((k, 3, 0)), *others], axis=2))
    noise = estimate_noise([j.residual for j in stage.fit.jets], columns, extra, [t.groups for t in data.train])
    return noise, float(sum(3 * (t.groups.state.max() + 1) for t in data.train))


def _screen(data: Data, fit: JointFit, noise: Noise, fields: Fields, n_effective: float) -> list[Candidate]:
    return screen(fit, _problem(data, fit, noise), fields, n_effective)


# --- growth --------------------------------------------------------------------------------------------------------------


def _best_refit(
    data: Data, stage: Stage, table: list[Candidate], noise: Noise, n_effective: float, say: Progress
) -> tuple[Stage | None, list[dict[str, Any]]]:
    """Refit the best candidates in full nonlinearity; return the one that passes, if any, and what became of each."""
    chosen: dict[str, Candidate] = {}
    for candidate in table:
        if candidate.score > 0 and candidate.retained >= TESTABLE:
            chosen.setdefault(candidate.effect.name, candidate)
    best, records = None, []
    library = max(len({c.effect.name for c in table}), 1)
    refits = REFITS if len(stage.fit.hypothesis.terms) <= len(NUISANCE) else REFITS // 2
    for candidate in list(chosen.values())[:refits]:
        if best is not None and candidate.score < 0.7 * best[0] - EVIDENCE:
            break  # far behind: a joint refit seldom gains that much on its linear score
        say(f"refitting with {candidate.effect.name}")
        record: dict[str, Any] = {"name": candidate.effect.name, "seed": candidate.seed}
        records.append(record)
        try:
            trial = _refit(data, stage, candidate, noise)
        except FemsenseError as error:
            record["verdict"] = f"no equilibrium: {error}"
            continue
        q = len(candidate.parameters)
        gain = _evidence(stage.fit, trial.fit)
        score = gain - q * np.log(n_effective) - 2.0 * np.log(library)
        record |= {"dchi2": gain, "dbic": score, "validation_rms_m": trial.held_rms}
        reason = _objection(stage, trial, candidate, score)
        record["verdict"] = reason or "passes"
        if reason is None and (best is None or score > best[0]):
            best = (score, trial, record)
    if best is not None:
        best[2]["verdict"] = "named"
    return (None if best is None else best[1]), records


def _evidence(before: JointFit, after: JointFit) -> float:
    """Return the decrease of χ², or that of (rows − parameters) log χ² where it is smaller: the scale of the noise is an estimate too."""
    freedom = max(len(after.fit.residual) - len(after.fit.theta), 1)
    return min(before.chi2 - after.chi2, freedom * float(np.log(before.chi2 / max(after.chi2, 1e-12))))


def _fresh(data: Data) -> bool:
    """Return whether anything is held out that is not a repetition of a fitted state."""
    fitted = {state_key(t.scene.recording, int(k)) for t in data.train for k in t.scene.frames}
    return any(state_key(t.scene.recording, int(k)) not in fitted for t in data.held for k in t.scene.frames)


def _refit(data: Data, stage: Stage, candidate: Candidate, noise: Noise) -> Stage:
    """Joint fit with one more effect, started from its linear step."""
    hypothesis = Hypothesis(data.robot, (*stage.fit.hypothesis.terms, (candidate.effect, candidate.seed, candidate.parameters)))
    null = np.array([p.null for p in candidate.parameters])
    low, high = np.array([p.low for p in candidate.parameters]), np.array([p.high for p in candidate.parameters])
    prior = Prior(np.concatenate([stage.fit.prior.mean, null]), np.concatenate([stage.fit.prior.std, np.full(len(null), np.inf)]))
    start = np.clip(_first_guess(candidate, null), low, high)
    for share in (1.0, 0.3, 0.0):  # a linear step may lead too far
        coordinates = np.concatenate([stage.fit.coordinates, null + share * (start - null)])
        try:
            trial = _stage(data, hypothesis, prior, noise, coordinates, own=_own(stage), max_iterations=10)
        except DataError:
            continue
        if trial.fit.chi2 <= stage.fit.chi2 + 1.0:
            return trial
    raise DataError("no start from which the fit improves")


def _first_guess(candidate: Candidate, null: FloatArray) -> FloatArray:
    """Return the linear step; for gravity its direction with the size that is known."""
    start = null + candidate.step
    if candidate.effect.name == "gravity":
        start = start / max(float(np.linalg.norm(start)), 1e-9) * STANDARD_GRAVITY
    return np.asarray(start)


def _objection(stage: Stage, trial: Stage, candidate: Candidate, score: float) -> str | None:
    """Return why an effect is not accepted, or None."""
    q = len(candidate.parameters)
    values, std = trial.fit.coordinates[-q:], trial.fit.std[-q:]
    if score <= EVIDENCE:
        return f"too little evidence (dBIC {score:.1f})"
    if not np.isfinite(std).all():
        return "not identifiable: the data leave a parameter open"
    low, high = np.array([p.low for p in candidate.parameters]), np.array([p.high for p in candidate.parameters])
    at_bound = (values <= low + 1e-9) & (low > -np.inf) | (values >= high - 1e-9)
    if at_bound.any():
        return "acts like it, but its value lies at the edge of what is plausible"
    if trial.held_rms > (1.0 - WORTH) * stage.held_rms:
        return f"held-out error does not fall enough ({1e3 * stage.held_rms:.3f} to {1e3 * trial.held_rms:.3f} mm)"
    return None


# --- conclusion ------------------------------------------------------------------------------------------------------------


def _conclude(
    data: Data, before: Stage, history: list[Stage], noise: Noise, n_effective: float, table: list[Candidate], first: list[Candidate],
    refits: list[dict[str, Any]], rng: np.random.Generator,
) -> LoopResult:  # fmt: skip
    final = history[-1]
    promoted = _promoted(data, final)
    effects, entries = _chain(data, before, history, promoted, noise)
    after = final if len(history) > 1 or promoted else before
    residuals = [jet.residual for jet in final.fit.jets]
    statistic, p_value = structure_test(data.train, residuals, rng=rng)
    structured = p_value <= 0.01 and final.fit.rms > 1.3 * noise.total
    verdict = "unexplained" if structured and not _mostly_explained(before, final, noise) else "effects" if effects else "none"
    rivals = _confounded(table, first, refits, history)
    not_testable = [
        {"name": c.effect.name, "absorbed_share": float(np.sqrt(max(0.0, 1.0 - c.retained**2))), "retained_share": c.retained}
        for c in _one_each(first)
        if c.retained < TESTABLE
    ]
    robot = apply_effects(data.robot, entries) if entries else data.robot
    if data.robot.document is not None and entries:
        robot = replace(robot, document={**data.robot.document, "effects": [*data.robot.document.get("effects", []), *entries]})
    return LoopResult(
        verdict=verdict,
        sentence=_sentence(verdict, effects, before, after, noise),
        noise_m=noise.total,
        before=_errors(before, rng),
        after=_errors(after, rng),
        effects=tuple(effects),
        entries=tuple(entries),
        candidates=tuple(_candidate_rows(first, table, refits)),
        confounded=tuple(rivals),
        next_experiment=_next_experiment(data, rivals, not_testable),
        not_testable=tuple(not_testable),
        detectable=_detectable(table, {e["name"] for e in effects}),
        left=describe_left(data.robot, data.train, residuals, statistic, p_value),
        robot=robot,
        declared=data.robot,
        data=_card(data, before, final, noise, n_effective),
        residuals=_residual_table(data, before, after),
    )


def _promoted(data: Data, final: Stage) -> list[str]:
    """Return the nuisances that the data moved significantly away from what is declared."""
    result, at = [], 0
    values, std = final.fit.coordinates, final.fit.std
    for effect, _, parameters in final.fit.hypothesis.terms:
        part = slice(at, at + len(parameters))
        at += len(parameters)
        if effect.name not in NUISANCE:
            continue
        size = np.abs(values[part]) / (1.0 if effect.name == "stiffness" else np.maximum(data.input_scale, 1e-12))
        if ((np.abs(values[part]) > SIGNIFICANT * std[part]) & (size > RELEVANT)).any():
            result.append(effect.name)
    return result


def _chain(
    data: Data, before: Stage, history: list[Stage], promoted: list[str], noise: Noise
) -> tuple[list[dict[str, Any]], list[Entry]]:
    """Return the effects in the order in which they were added, each with the held-out error before and after it."""
    final = history[-1]
    tables = {e["name"]: e for e in final.fit.hypothesis.entries(final.fit.coordinates)}
    rows, entries, error = [], [], before.held_rms
    for name in promoted:
        after = (
            _stage_with(data, [n for n in promoted[: promoted.index(name) + 1]], noise).held_rms
            if name != promoted[-1]
            else history[0].held_rms
        )
        rows.append(
            {
                "name": name,
                "parameters": _parameters(final, name),
                "validation_rms_before_m": error,
                "validation_rms_after_m": after,
            }
        )
        entries.append(_rounded(tables[name]))
        error = after
    for stage in history[1:]:
        name = stage.fit.hypothesis.terms[-1][0].name
        rows.append(
            {
                "name": name,
                "parameters": _parameters(final, name),
                "validation_rms_before_m": error,
                "validation_rms_after_m": stage.held_rms,
            }
        )
        entries.append(_rounded(tables[name]))
        error = stage.held_rms
    return rows, entries


def _stage_with(data: Data, names: list[str], noise: Noise) -> Stage:
    """Return the declared model with some of the nuisances only."""
    full, prior = _with_nuisance(data)
    keep = [t for t in full.terms if t[0].name in names]
    mask = np.concatenate([np.full(len(p), e.name in names) for e, _, p in full.terms]) if full.terms else np.zeros(0, bool)
    return _stage(data, Hypothesis(data.robot, tuple(keep)), Prior(prior.mean[mask], prior.std[mask]), noise, prior.mean[mask])


def _rounded(entry: Entry) -> Entry:
    def tidy(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.9g}")
        if isinstance(value, list):
            return [tidy(v) for v in value]
        return {k: tidy(v) for k, v in value.items()} if isinstance(value, dict) else value

    return {k: tidy(v) for k, v in entry.items()}


def _parameters(stage: Stage, name: str) -> dict[str, Any]:
    """Return {key: {value, std, unit}} of one effect; vectors and tables keep their shape. What was a seed has std None."""
    at, result = 0, dict[str, Any]()
    values, std = stage.fit.coordinates, stage.fit.std
    for effect, seed, parameters in stage.fit.hypothesis.terms:
        for i, p in enumerate(parameters):
            if effect.name != name:
                continue
            slot = result.setdefault(p.key, {"value": None, "std": None, "unit": p.unit})
            value, deviation = p.value(values[at + i]), p.value_std(values[at + i], std[at + i])
            for field, number in (("value", value), ("std", deviation)):
                slot[field] = _placed(slot[field], p.part, float(number) if np.isfinite(number) else None)
        if effect.name == name:
            result |= {
                k: {"value": v, "std": None, "unit": "m" if k.endswith("_m") else "s" if k.endswith("_s") else "1"}
                for k, v in seed.items()
            }
        at += len(parameters)
    return result


def _placed(slot: Any, part: Any, number: float | None) -> Any:
    if part is None:
        return number
    if isinstance(part, int):
        return [*(slot or []), number]
    if isinstance(part, tuple):
        table = dict(slot or {})
        table[part[0]] = [*table.get(part[0], []), number]
        return table
    return {**(slot or {}), part: number}


def _mostly_explained(before: Stage, final: Stage, noise: Noise) -> bool:
    """Return whether most of the excess over the noise is gone (a neighbour of the true effect leaves more)."""
    excess = max(before.fit.rms**2 - noise.total**2, 1e-18)
    return (before.fit.rms**2 - final.fit.rms**2) / excess > 0.8


def _errors(stage: Stage, rng: np.random.Generator) -> dict[str, Any]:
    squares = np.concatenate([(r**2).sum(axis=1) for r in stage.held_residuals])
    resampled = rng.integers(0, len(squares), size=(1000, len(squares)))
    draws = np.sqrt(squares[resampled].mean(axis=1))
    return {
        "train_rms_m": stage.fit.rms,
        "validation_rms_m": stage.held_rms,
        "validation_ci_m": [float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))],
    }


def _one_each(table: list[Candidate]) -> list[Candidate]:
    seen: dict[str, Candidate] = {}
    for candidate in table:
        seen.setdefault(candidate.effect.name, candidate)
    return list(seen.values())


def _candidate_rows(first: list[Candidate], table: list[Candidate], refits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return every effect that was tried with its scores: linear at the start, linear at the end, and the joint refits."""
    last = {c.effect.name: c for c in _one_each(table)}
    rows = []
    for c in _one_each(first):
        joint = [r for r in refits if r["name"] == c.effect.name]
        end = last.get(c.effect.name)
        rows.append({
            "name": c.effect.name, "seed": c.seed, "dchi2": c.gain, "dbic": c.score, "retained_share": c.retained,
            "dbic_at_end": None if end is None else end.score, "refits": joint, "verdict": joint[-1]["verdict"] if joint else _why_not(c),
        })  # fmt: skip
    return rows


def _why_not(c: Candidate) -> str:
    if c.retained < TESTABLE:
        return f"not testable: calibration imitates {100 * np.sqrt(max(0.0, 1 - c.retained**2)):.0f} % of it"
    return f"too little evidence (dBIC {c.score:.1f})"


def _confounded(
    table: list[Candidate], first: list[Candidate], refits: list[dict[str, Any]], history: list[Stage]
) -> list[dict[str, Any]]:
    """Return pairs that these data cannot tell apart: fields that agree, or refits whose evidence is within 10 of the named one."""
    pairs = []
    named = [s.fit.hypothesis.terms[-1][0].name for s in history[1:]]
    best = {r["name"]: r["dbic"] for r in refits if r.get("verdict") == "named"}
    for name in named:
        for r in refits:
            if (
                r["name"] not in named
                and r.get("verdict") == "passes"
                and r.get("dbic", -np.inf) > best.get(name, np.inf) - EVIDENCE
            ):
                pairs.append({"pair": [name, r["name"]], "dbic_gap": float(best[name] - r["dbic"])})
    ones = _one_each(first)
    for i, a in enumerate(ones):
        for b in ones[i + 1 :]:
            if a.retained < TESTABLE or b.retained < TESTABLE or len(b.parameters) > 6 or len(a.parameters) > 6:
                continue
            share = min(confounding(a, b), confounding(b, a))
            if share > 0.95:
                pairs.append({"pair": [a.effect.name, b.effect.name], "cosine": share})
    return pairs


def _detectable(table: list[Candidate], found: set[str]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for c in _one_each(table):
        if c.effect.name in found:
            continue
        sizes = {p.label: float(s) if np.isfinite(s) else None for p, s in zip(c.parameters, c.smallest)}
        result[c.effect.name] = {"smallest": sizes, "coordinate": c.parameters[0].scale, "unit": c.parameters[0].unit}
    return result


def _next_experiment(data: Data, rivals: list[dict[str, Any]], not_testable: list[dict[str, Any]]) -> str:
    """Return in words what to record to tell apart what these data cannot."""
    names = {n for r in rivals for n in r["pair"]} | {r["name"] for r in not_testable}
    advice = []
    recordings = [t.scene.recording for t in data.train]
    unloading = any(
        len(r.inputs) > 1
        and (np.diff(r.inputs, axis=0).max(initial=0.0) > 0)
        and (np.diff(r.inputs, axis=0).min(initial=0.0) < 0)
        for r in recordings
    )
    if names & {"gravity", "payload"}:
        advice.append(
            "turn the base by 90° between frames, camera fixed (gravity_*_m_s2 in frames.csv): weight then changes direction and the pose does not"
        )
    if names & {"cable_friction", "creep", "cable_slack"}:
        advice.append(
            "go up and down at several levels, and hold for a minute"
            if not unloading
            else "hold for a minute at two levels, and repeat a sweep at another speed"
        )
    if names & {"cable_gain", "cable_offset", "stiffness", "cable_stretch"}:
        advice.append("hang a known weight on the robot in some frames (loads.csv)")
    if names & {"poisson", "soft_region", "base_compliance", "hyperelastic"}:
        advice.append("add markers on opposite faces and close to the clamp, and pull opposite cables together")
    if names & {"depth_scale", "marker_offset"}:
        advice.append("record rest.csv: the unloaded body, and move the camera in depth")
    return "; ".join(advice)


def _sentence(verdict: str, effects: list[dict[str, Any]], before: Stage, after: Stage, noise: Noise) -> str:
    error = f"held-out error {1e3 * before.held_rms:.2f} mm"
    if verdict == "none":
        return f"The model explains the data to their noise ({1e3 * noise.total:.2f} mm): {error}."
    if verdict == "unexplained" and not effects:
        return f"A residual is left that no effect of the list explains: {error}, noise {1e3 * noise.total:.2f} mm."
    what = ", ".join(f"{e['name']} ({_short(e['parameters'])})" for e in effects)
    tail = "" if verdict == "effects" else " A structured residual is left that no effect explains."
    return f"The model lacks {what}; held-out error {1e3 * before.held_rms:.2f} mm before, {1e3 * after.held_rms:.2f} mm after.{tail}"


def _short(parameters: dict[str, Any]) -> str:
    def show(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}"
        if isinstance(value, list):
            return "[" + ", ".join(show(v) for v in value) + "]"
        return ", ".join(f"{k} {show(v)}" for k, v in value.items()) if isinstance(value, dict) else str(value)

    return ", ".join(f"{k} {show(p['value'])}" + ("" if p["unit"] == "1" else f" {p['unit']}") for k, p in parameters.items())


def _card(data: Data, before: Stage, final: Stage, noise: Noise, n_effective: float) -> dict[str, Any]:
    nuisance = {
        name: _parameters(final, name) for name in NUISANCE if any(e.name == name for e, _, _ in final.fit.hypothesis.terms)
    }
    return {
        "recordings": [str(t.scene.recording.folder) for t in data.train],
        "split": data.split,
        "frames_fitted": [[int(t.scene.recording.frame_numbers[k]) for k in t.scene.frames] for t in data.train],
        "frames_held_out": [[int(t.scene.recording.frame_numbers[k]) for k in t.scene.frames] for t in data.held],
        "noise_components_m": noise.std,
        "noise_source": noise.source,
        "effective_observations": n_effective,
        "nuisance_after": nuisance,
        "seat_std_m": data.seat_std,
    }


def _residual_table(data: Data, before: Stage, after: Stage) -> dict[str, Any]:
    rows: dict[str, list[Any]] = {"recording": [], "frame": [], "marker": [], "before_m": [], "after_m": []}
    for i, (trial, a, b) in enumerate(zip(data.held, before.held_residuals, after.held_residuals)):
        numbers = trial.scene.recording.frame_numbers[trial.scene.frame]
        rows["recording"] += [i] * len(a)
        rows["frame"] += [int(n) for n in numbers]
        rows["marker"] += [data.robot.marker_names[m] for m in trial.scene.marker]
        rows["before_m"] += a.tolist()
        rows["after_m"] += b.tolist()
    return rows


__all__ = ["Data", "Stage", "improve", "prepare"]
