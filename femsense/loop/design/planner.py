"""Experiment design: the recording that makes effects identifiable, with the predicted identifiability before and after.

The columns of every candidate experiment are computed once (`identifiability`); the search over combinations is linear algebra only. It starts from
the minimal recording, or from an existing one, and greedily adds the candidate that lowers `Identifiability.confusion` most, while that
falls by WORTH and the budget of frames allows it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import FemsenseError, InputError
from femsense.loop.data.dataset import groups_of, marked_frames
from femsense.loop.data.trial import Trial
from femsense.loop.design.candidate_experiments import Element, Setup, candidate_experiments, minimal, script_of, setup_for
from femsense.loop.design.experiment_blocks import Block, Form, forms_of, make_block, turns_of
from femsense.loop.design.identifiability import Identifiability, Judge
from femsense.model.effects import OF_INPUTS
from femsense.model.observation import make_scene
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_checks import check_against
from femsense.model.recording_parts import Drives, LoadRows, MarkerRows, Timeline, Views
from femsense.model.robot import Robot
from femsense.rig.camera import camera_of, pose_of
from femsense.rig.plan import Plan, plan_script
from femsense.rig.script import ScriptTable, check_script

NOISE_M = 2e-4
"""Default standard deviation of each coordinate of a marker [m]: a depth camera at half a metre."""
FRAMES = 60
"""Maximum number of frames of a proposal; an existing recording is thinned to this number, with weights for the frames left out."""
WORTH = 0.05
"""Minimum decrease of the confusion by an added candidate."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """One candidate that was added."""

    element: Element
    better: tuple[str, ...]
    """Its benefits, in words."""


@dataclass(frozen=True, eq=False, slots=True)
class Proposal:
    """An experiment with its identifiability."""

    setup: Setup
    noise: float
    """[m]."""
    start: tuple[Element, ...]
    """The minimal recording; empty if a recording is given."""
    steps: tuple[Step, ...]
    left_out: tuple[str, ...]
    """Candidates without an equilibrium on the declared robot."""
    before: Identifiability
    after: Identifiability

    @property
    def elements(self) -> tuple[Element, ...]:
        return (*self.start, *(s.element for s in self.steps))

    def scripts(self) -> dict[str, dict[str, Any]]:
        """Return the scripts of the experiment: "" for the camera at its place, "-far" for a second distance, if it has one."""
        made = {name: script_of(self.setup, self.elements, noise=self.noise, far=bool(name)) for name in ("", "-far")}
        return {name: script for name, script in made.items() if script["sweeps"]}


def plan_experiment(
    robot: Robot,
    *,
    control: str = "tension",
    noise: float = NOISE_M,
    frames: int = FRAMES,
    given: Recording | None = None,
    progress: Progress | None = None,
    only: Collection[str] | None = None,
) -> Proposal:
    """Return the recording that makes the effects identifiable, to first order on the declared robot.

    Arguments:
        robot: the declared robot.
        control: "tension" or "displacement"; ignored with a given recording.
        noise: standard deviation of each coordinate of each marker in each frame [m].
        frames: budget of new frames.
        given: an existing recording; without it the proposal starts from the minimal one.
        progress: called with (candidates done, all candidates).
        only: keys of the possible candidate experiments; by default all.

    Raises:
        InputError: no markers, no budget. DataError: the declared robot has no equilibrium.
    """
    _check(robot, noise)
    given = None if given is None else check_against(robot, given)
    zero = "absolute" if given is None else given.actuation_zero
    most = None if given is None or not given.inputs.size else given.inputs.max(axis=0)
    setup = setup_for(robot, control if given is None else given.actuation, zero, most=most)
    ranges = np.array([p.height for p in setup.pulls if p.kind == "cables"])
    forms = _forms(robot, setup.control, zero, ranges)
    candidates = [e for e in candidate_experiments(setup) if only is None or e.key in only]
    start, extras = ([], [*minimal(setup)[:1], *candidates]) if given is not None else (minimal(setup), candidates)
    if sum(e.frames for e in start) > frames:
        raise InputError(
            "too few frames",
            where="--frames",
            found=frames,
            expected=f"at least {sum(e.frames for e in start)}, for the minimal recording",
        )
    blocks, left_out = _blocks(setup, forms, [*start, *extras], noise, progress)
    if not all(e.key in blocks for e in start):
        raise InputError(
            "no equilibrium on the way up", where="robot", found="; ".join(left_out), expected="a robot that its cables can bend"
        )
    judge = Judge(forms)
    have = [blocks[e.key] for e in start] if given is None else [_given_block(robot, given, forms, noise)]
    before = judge.judge(have)
    steps, after = _grow(
        judge, have, blocks, [e for e in extras if e.rest_file or e.key in blocks], before, frames - sum(e.frames for e in start)
    )
    return Proposal(setup, noise, tuple(start), tuple(steps), tuple(left_out), before, after)


def identifiability_of_script(
    robot: Robot, script: ScriptTable, where: Path = Path("script"), *, noise: float = NOISE_M
) -> Identifiability:
    """Return the identifiability of a script's experiment, if it is recorded and the loop uses all its contact-free frames.

    Arguments:
        robot: the declared robot; effects, mesh and law of the script's truth are ignored.
        script: its sweeps, loads, markers and first camera are used.
        where: for error messages.
        noise: standard deviation of each coordinate of each marker [m].

    Raises:
        InputError: the script does not fit. DataError: the declared robot has no equilibrium in a frame.
    """
    _check(robot, noise)
    plan = plan_script(script, robot, where)
    ranges = np.ptp(plan.commanded, axis=0) if plan.commanded.size else np.zeros(len(robot.body.cables))
    forms = _forms(robot, plan.control, script.actuation_zero, ranges)
    trial = trial_of(robot, script, plan)
    block = make_block(
        trial,
        robot,
        forms,
        recording="",
        noise=noise,
        turns=turns_of(trial.scene.recording.gravity, robot.body.gravity),
        see=script.markers.occlusion,
        with_rest=script.markers.rest_file,
    )
    return Judge(forms).judge([block], rest=script.markers.rest_file)


def _check(robot: Robot, noise: float) -> None:
    if not len(robot.marker_points):
        raise InputError("the robot has no markers", where="robot.toml: markers", expected="[[markers]], which a plan needs")
    if not noise > 0:
        raise InputError("noise is positive", where="--noise", found=1e3 * noise, expected="> 0 mm")


def _forms(robot: Robot, control: str, zero: str, ranges: FloatArray) -> list[Form]:
    forms = forms_of(robot, control, ranges)
    if zero == "absolute":
        return forms
    kept, at = [], 0
    for f in forms:  # unknown initial inputs are fitted with the pose, instead of offsets
        if f.name not in OF_INPUTS:
            kept.append(replace(f, at=at))
            at += len(f.size)
    return kept


# Blocks of the candidates


def _blocks(
    setup: Setup, forms: list[Form], elements: Sequence[Element], noise: float, progress: Progress | None
) -> tuple[dict[str, Block], list[str]]:
    """Return the block of each element that has an equilibrium, and the others in words."""
    blocks, left_out = dict[str, Block](), list[str]()
    todo = [e for e in elements if e.sweeps]
    for i, element in enumerate(todo):
        try:
            blocks[element.key] = element_block(setup, forms, element, noise)
        except FemsenseError as error:
            left_out.append(f"{element.words}: {error}")
        if progress is not None:
            progress(i + 1, len(todo))
    return blocks, left_out


def element_block(setup: Setup, forms: Sequence[Form], element: Element, noise: float, *, with_rest: bool = True) -> Block:
    """Return the block of an element. Raises DataError if the declared robot has no equilibrium in it."""
    script = check_script(script_of(setup, [element], noise=noise, far=element.far))
    robot, turns = setup.robot, None
    if any(s.gravity_m_s2 is not None for s in script.sweeps):
        rows = [np.array(s.gravity_m_s2) for s in script.sweeps for _ in s.profile()]
        turns = turns_of(np.array([rows[0], *rows]), setup.gravity)
        if not np.any(
            robot.body.gravity
        ):  # a weightless robot remains weightless: a rotation only sets the direction of its weight
            script = script.model_copy(update={"sweeps": [s.model_copy(update={"gravity_m_s2": None}) for s in script.sweeps]})
    trial = trial_of(robot, script, plan_script(script, robot), lead=True)
    key = "new, far" if element.far else "new"
    return make_block(trial, robot, forms, recording=key, noise=noise, turns=turns, see=True, with_rest=with_rest)


def trial_of(robot: Robot, script: ScriptTable, plan: Plan, *, lead: bool = False) -> Trial:
    """Return the frames of a script as the loop would fit them, with marker positions undefined.

    Arguments:
        robot: the declared robot.
        script, plan: the script and its frames.
        lead: whether the robot rests before the first frame, unrecorded (friction and creep start there).
    """
    head, first_view = 1 if lead else 0, next(iter(script.views.values()))
    recorded = plan.commanded + (plan.initial if script.actuation_zero == "absolute" else 0.0)
    at_rest = recorded[:1] - plan.commanded[:1]
    dt = script.sweeps[0].dt_s or script.dt_s
    frames: IntArray = np.flatnonzero(plan.free) + head
    names = script.markers.names or robot.marker_names
    count = len(names)
    recording = make_recording(
        Timeline(
            np.concatenate([[0.0], plan.time_s + dt]) if lead else plan.time_s,
            sweep=[*plan.sweep[:head], *plan.sweep],
            gravity=None if plan.gravity is None else np.vstack([plan.gravity[:head], plan.gravity]),
        ),
        drives=Drives(
            actuation=script.actuation,
            actuation_zero=script.actuation_zero,
            cable_names=robot.body.cable_names,
            inputs=np.vstack([at_rest, recorded]) if lead else recorded,
            chamber_names=robot.body.chamber_names,
            pressures=np.vstack([0.0 * plan.pressures[:1], plan.pressures]) if lead else plan.pressures,
        ),
        markers=MarkerRows(
            names,
            np.repeat(frames, count),
            np.tile(np.arange(count), len(frames)),
            np.tile([0.0, 0.0, 1.0], (count * len(frames), 1)),
        ),
        loads=LoadRows(plan.load_frame + head, plan.load_points, plan.load_forces),
        views=Views(cameras=[camera_of(first_view)]),
    )
    scene = make_scene(robot, recording, frames)
    free = np.full(len(robot.body.cables), np.inf)
    initial = plan.initial if script.actuation_zero == "unknown" and len(plan.initial) else None
    return Trial(scene, groups_of(scene), (pose_of(first_view),), initial, -free, free, {})


def _given_block(robot: Robot, recording: Recording, forms: list[Form], noise: float) -> Block:
    """Return the block of an existing recording, calibrated."""
    frames = marked_frames(recording)
    thin = int(np.ceil(len(frames) / FRAMES))
    calibration = calibrate(robot, recording, frames=frames[::thin].tolist())
    scene = make_scene(robot, recording, frames[::thin])
    initial = None
    if recording.actuation_zero == "unknown" and robot.body.cables:
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    free = np.full(len(robot.body.cables), np.inf)
    trial = Trial(scene, groups_of(scene), calibration.poses, initial, -free, free, {})
    turns = turns_of(recording.gravity, robot.body.gravity)
    return make_block(trial, robot, forms, recording="given", noise=noise / np.sqrt(thin), turns=turns, measured=True)


# The search


def _grow(
    judge: Judge, have: list[Block], blocks: dict[str, Block], extras: list[Element], start: Identifiability, budget: int
) -> tuple[list[Step], Identifiability]:
    """Return the added candidates in order, and the identifiability with all of them."""
    steps, now, rest = list[Step](), start, False
    while True:
        best: tuple[float, Element, Identifiability] | None = None
        for element in (e for e in extras if e.frames <= budget):
            more = [] if element.rest_file else [blocks[element.key]]
            then = judge.judge([*have, *more], rest=rest or element.rest_file)
            if best is None or then.confusion < best[0] - 1e-9:
                best = (then.confusion, element, then)
        if best is None or best[0] > now.confusion - WORTH:
            return steps, now
        _, element, then = best
        steps.append(Step(element, tuple(_better(now, then))))
        have = have if element.rest_file else [*have, blocks[element.key]]
        rest, now, budget = rest or element.rest_file, then, budget - element.frames
        extras = [e for e in extras if e is not element]


def _better(before: Identifiability, after: Identifiability) -> list[str]:
    """Return the improvements of one experiment over another, in words."""
    then = {r.label: r for r in after.rows}
    words = []
    for r in before.rows:
        new = then.get(r.label)
        if new is None:
            words.append(f"{r.label} is measured instead of fitted")
        elif new.testable and not r.testable:
            words.append(f"{r.label} becomes testable ({100 * r.retained:.1f} → {100 * new.retained:.0f} % retained)")
        elif new.seen and not r.seen:
            words.append(f"{r.label} becomes detectable (dBIC {r.dbic:.0f} → {new.dbic:.0f})")
    old = {pair_labels(before, p): p for p in before.pairs()}
    for p in after.pairs():
        was = old.get(pair_labels(after, p))
        if (
            was is not None
            and before.cannot_distinguish(was)
            and not after.cannot_distinguish(p)
            and then[pair_labels(after, p)[0]].seen
            and then[pair_labels(after, p)[1]].seen
        ):
            words.append(f"{' and '.join(pair_labels(after, p))} become distinguishable (dBIC gap {was[3]:.0f} → {p[3]:.0f})")
    return words


def pair_labels(identifiability: Identifiability, pair: tuple[int, int, float, float]) -> tuple[str, str]:
    return identifiability.rows[pair[0]].label, identifiability.rows[pair[1]].label
