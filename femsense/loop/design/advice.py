"""Plans as text, and the next experiment after a finished loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, spread_evenly
from femsense.core.errors import FemsenseError
from femsense.core.parallel import each
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import Trial, numbers_of
from femsense.loop.design.candidate_experiments import MOST_EACH, Element, candidate_experiments, setup_for
from femsense.loop.design.experiment_blocks import Block, Form, forms_of, make_block, turns_of
from femsense.loop.design.identifiability import Identifiability, Judge, Row
from femsense.loop.design.planner import FRAMES, Proposal, element_block
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.fit.noise_components import Noise
from femsense.model.drive import has_history
from femsense.model.effects import OF_INPUTS
from femsense.model.robot import Robot

# Tables


def identifiability_text(identifiability: Identifiability, before: Identifiability | None = None) -> str:
    """Return the identifiability of an experiment as a table, compared with `before` if given."""
    first = {r.label: r for r in before.rows} if before is not None else {}
    wide = max(len(r.label) for r in identifiability.rows) + 2
    head = f"{'effect':{wide}}{'retained share':>22}{'smallest detectable':>32}{'dBIC at plausible size':>26}"
    lines = [head, "-" * len(head)]
    for r in identifiability.rows:
        old = first.get(r.label)
        cells = [_arrow(None if old is None else old.retained, r.retained, "{:.1%}"), _both(old, r)]
        cells.append(_arrow(None if old is None else old.dbic, r.dbic, "{:.0f}"))
        lines.append(f"{r.label:{wide}}{cells[0]:>22}{cells[1]:>32}{cells[2]:>26}  {_verdict(r)}")
    for label in (k for k in first if k not in {r.label for r in identifiability.rows}):
        lines.append(f"{label:{wide}}measured by rest.csv, no longer fitted")
    return "\n".join([*lines, "", *_summary(identifiability, before)])


def _arrow(old: float | None, new: float, form: str) -> str:
    return form.format(new) if old is None else f"{form.format(old)} → {form.format(new)}"


def _both(old: Row | None, new: Row) -> str:
    if new.form.effect.discrete:
        return "as a whole"
    after = _smallest(new)
    return after if old is None else f"{_smallest(old, bare=True)} → {after}"


def _smallest(r: Row, *, bare: bool = False) -> str:
    """Return the median of the smallest detectable sizes of an effect's first key, in its unit."""
    of = [i for i, p in enumerate(r.form.parameters) if p.key == r.form.parameters[0].key]
    size = float(np.sort(r.smallest[of])[(len(of) - 1) // 2])
    p = r.form.parameters[0]
    if not np.isfinite(size) or not r.testable:
        return "–"
    value, unit = size, "" if p.unit == "1" else f" {p.unit}"
    if p.scale == "log":
        value, unit = 100 * float(np.expm1(min(size, 7.0))), " %"
    elif p.scale == "reciprocal":
        value = 1.0 / size
    elif p.unit == "m":
        value, unit = 1e3 * size, " mm"
    return f"{value:.3g}" + ("" if bare else unit)


def _verdict(r: Row) -> str:
    return "" if r.seen else "not detectable" if r.testable else "not testable"


def _summary(identifiability: Identifiability, before: Identifiability | None) -> list[str]:
    def count(what: str) -> str:
        new = len(getattr(identifiability, what)()) if what == "confused" else len(getattr(identifiability, what))
        if before is None:
            return str(new)
        old = len(before.confused()) if what == "confused" else len(getattr(before, what))
        return f"{old} → {new}"

    apart = " → ".join("{} of {}".format(*o.distinguished()) for o in (before, identifiability) if o is not None)
    lines = [
        f"not testable: {count('untestable')}; not detectable: {count('unseen')}; pairs of effects that would be distinguished: {apart}",
        f"pairs that would be detectable and collinear: {count('confused')}",
    ]
    for i, j, share, gap in sorted(identifiability.confused(), key=lambda p: p[3])[:12]:
        names = f"{identifiability.rows[i].label} / {identifiability.rows[j].label}"
        lines.append(f"  {names}: {100 * share:.0f} % collinear, dBIC gap {gap:.0f}")
    return lines


def proposal_text(proposal: Proposal) -> str:
    """Return a proposal as text with its table."""
    brings = {s.element.key: s.better for s in proposal.steps}
    frames, seconds = sum(e.frames for e in proposal.elements), sum(e.seconds for e in proposal.elements)
    lines = [f"What to record ({frames} frames, {seconds / 60:.1f} minutes of motion; every item starts and ends at rest):", ""]
    for i, e in enumerate(proposal.elements):
        effort = f" ({e.frames} frame{'s' if e.frames > 1 else ''}, {e.seconds:.0f} s)" if e.frames else ""
        lines.append(f"{i + 1:3d}. {e.words}{effort}")
        lines += [f"       {text}" for text in brings.get(e.key, ())[:4]]
    if not proposal.steps:
        lines.append("no candidate experiment helps within these frames")
    lines += [f"left out: {text}" for text in proposal.left_out]
    title = f"Predicted, before → after, {1e3 * proposal.noise:g} mm noise a coordinate, on the declared robot:"
    note = (
        "Validation needs frames beyond these: one more sweep of a kind that is not in the list (femsense improve --validation)."
    )
    return "\n".join([*lines, "", note, "", title, "", identifiability_text(proposal.after, proposal.before)])


# The next experiment after a loop


def next_element(
    data: Data, fit: JointFit, noise: Noise, confounded: Sequence[tuple[str, str]], not_testable: Sequence[str]
) -> list[tuple[str, str, float, float]]:
    """Return the candidate experiments that would help most with the open questions of the data, and by how much.

    Arguments:
        data: data of the search, thinned to a few frames.
        fit: the model.
        noise: noise model of the data.
        confounded: pairs of effects that the data cannot distinguish.
        not_testable: effects that calibration absorbs in these data.

    Returns:
        (what to do, the open question that gains most, the expected evidence on it before and after), the best first; empty if no
            experiment helps or if the prediction would take too long. The value of an experiment is the evidence that it adds to all questions,
            counted between 0 and `evidence`: below 0 the wrong answer is expected, and less of it is no improvement.
    """
    robot = fit.hypothesis.robot_at(fit.coordinates)
    names = {n for pair in confounded for n in pair} | set(not_testable)
    trials = [_representative(t) for t in data.train]
    tets = len(robot.body.mesh.tets)
    past = has_history(robot) or any(form.path_dependent for form in data.forms if form.name in names)
    cost = sum(int(t.scene.frames.max()) + 1 if past else len(t.scene.frames) for t in trials)
    if not names or cost > 2 * _most_frames(data, tets):
        return []
    try:
        zero = "unknown" if any(t.initial is not None for t in trials) else "absolute"
        marked = robot.without_surface_points() if robot.glued_names else robot  # an experiment has the declared markers only
        setup = setup_for(marked, data.control, zero, most=data.input_scale)
        forms = _open_forms(robot, data, names)
        shares = [len(cases.scene.frames) / len(t.scene.frames) for cases, t in zip(trials, data.train)]
        have = [
            _trial_block(t, robot, forms, noise.row_std(t.groups) * np.sqrt(share), str(number))
            for t, share, number in zip(trials, shares, numbers_of(data.train))
        ]
    except FemsenseError:
        return []
    judge, left = Judge(forms, thresholds=data.thresholds), _most_frames(data, tets)
    now = _open(judge.judge(have), confounded, not_testable)
    questions = [*(f"distinguish {a} from {b}" for a, b in confounded), *(f"show {name}" for name in not_testable)]
    chosen = []
    for element in _one_of_each_first(candidate_experiments(setup)):
        if element.sweeps and element.frames < left:
            left -= element.frames + 1
            chosen.append(element)

    def block_of(element: Element) -> Block | None:
        try:
            return element_block(setup, forms, element, noise.row_std(data.train[0].groups), with_rest=False)
        except FemsenseError:
            return None

    found = []
    for element, block in zip(chosen, each(block_of, chosen)):
        if block is None:
            continue
        then = _open(judge.judge([*have, block]), confounded, not_testable)
        gain = np.clip(then, 0.0, data.thresholds.evidence) - np.clip(now, 0.0, data.thresholds.evidence)
        if gain.sum() > 1.0:
            most = int(np.argmax(gain))
            found.append((float(gain.sum()), (element.words, questions[most], float(now[most]), float(then[most]))))
    return [item for _, item in sorted(found, key=lambda f: -f[0])]


def _most_frames(data: Data, tets: int) -> int:
    """Return the number of frames that candidates may take after a loop, a few seconds of work; the recordings may take twice that."""
    return min(3 * data.effort.work // (2 * tets), FRAMES)


def _one_of_each_first(elements: Sequence[Element]) -> list[Element]:
    kinds = [e.key.split(":")[0] for e in elements]
    return [e for _, _, e in sorted(((kinds[:i].count(kinds[i]), i, e) for i, e in enumerate(elements)), key=lambda t: t[:2])]


def _representative(trial: Trial) -> Trial:
    frames = trial.scene.frames
    return replace(
        trial.part(frames[spread_evenly(len(frames), MOST_EACH)]), together=False
    )  # the recording number links it to its markers


def _open_forms(robot: Robot, data: Data, names: set[str]) -> list[Form]:
    unknown = any(t.initial is not None for t in data.train)
    wanted = (names | set(NUISANCE)) - set(OF_INPUTS if unknown else ())
    return forms_of(robot, data.control, data.input_scale, names=sorted(wanted))


def _trial_block(trial: Trial, robot: Robot, forms: list[Form], noise: float, key: str) -> Block:
    turns = turns_of(trial.scene.recording.gravity, robot.body.gravity)
    return make_block(trial, robot, forms, recording=key, noise=noise, turns=turns, measured=True)


def _open(identifiability: Identifiability, pairs: Sequence[tuple[str, str]], not_testable: Sequence[str]) -> FloatArray:
    """Return the expected evidence on each open question: the dBIC gap of a pair, or of an effect over none."""
    of = {
        frozenset({identifiability.rows[i].name, identifiability.rows[j].name}): gap
        for i, j, _, gap in reversed(identifiability.pairs())
    }
    alone = {r.name: r.dbic for r in reversed(identifiability.rows)}
    wanted = identifiability.thresholds.evidence
    answers: list[Any] = [of.get(frozenset(p), wanted) for p in pairs]
    answers += [alone.get(n, wanted) for n in not_testable]
    return np.array(answers or [wanted])
