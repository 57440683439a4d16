"""Next steps if an error remains or causes are confounded: weigh the body, record at rest, hang a weight, pull cables together; with their predicted
benefit.

The benefit is the reduction of a parameter's standard deviation in the current fit, with the weight of the body as a free parameter (prior WEIGHED),
after rows of one more state are added HOLDS times (Bayesian linear design: Chaloner & Verdinelli 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.core.least_squares import covariance_of
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import heads_of, spans_of
from femsense.loop.design.candidate_experiments import Setup, setup_for
from femsense.loop.fit.fitted_model import FittedModel, poses_and_inputs, problem_of
from femsense.loop.fit.joint_fit import JointProblem
from femsense.loop.fit.noise_components import Noise
from femsense.model.effects import Effect, Entry, Parameter
from femsense.model.effects.base import number
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, LoadRows, MarkerRows, Timeline
from femsense.model.robot import Robot

WEIGHED = 0.1
"""Prior standard deviation of the density, as a share: data-sheet value against a body with pigment, glue and markers."""
HOLDS = 5
"""Number of times that a state of an experiment is recorded."""
BRINGS = 0.8
"""An experiment is proposed for a parameter whose standard deviation falls below this share of the current one."""
AT_REST, TOGETHER = 0.02, 0.25
"""Inputs below the first share of their ranges are at rest; two above the second pull together."""


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """An action, as one state of the robot."""

    words: str
    inputs: FloatArray | None
    """Of the cables [N] or [m], shape (a,); None: no state is recorded, the body is weighed."""
    load: tuple[FloatArray, FloatArray] | None = None
    """Place on the body at rest [m] and force [N], each (3,)."""


def next_steps(data: Data, fitted: FittedModel, noise: Noise, *, noise_is_measured: bool) -> list[str]:
    """Return the next steps in words, the most beneficial first, each with its benefit.

    Arguments:
        data: data of the search.
        fitted: the model with all effects that were found.
        noise: including the components that vary with the state, so that one more state is not overrated.
        noise_is_measured: whether states repeat or the noise is declared.
    """
    steps = _possible(data)
    gains = _gains(data, fitted, noise, steps)
    order = sorted(range(len(steps)), key=lambda i: gains[i][0])
    said = [steps[i].words + gains[i][1] for i in order]
    repeat = "repeat three of the states, or declare marker_noise_m: this separates noise from model error"
    return said if noise_is_measured else [repeat, *said]


def _possible(data: Data) -> list[Step]:
    """Return the actions that would add information on weight, modulus and inputs to these recordings."""
    recordings = [data.train[i].scene.recording for i in heads_of(data.train)]
    share = np.abs(np.concatenate([r.inputs for r in recordings])) / np.maximum(data.input_scale, 1e-12)
    count, steps = share.shape[1], list[Step]()
    if np.any(data.declared.body.gravity) and data.declared.body.material.density > 0:
        steps.append(Step("weigh the body with its markers, and declare the density that this gives", None))
    if count and not (share < AT_REST).all(axis=1).any():
        steps.append(Step("record a few frames at rest, all cables slack", np.zeros(count)))
    setup = _setup(data)
    if setup is not None and not any(len(r.load_frame) for r in recordings):
        down = setup.gravity / np.linalg.norm(setup.gravity)
        words = f"hang a known weight of about {setup.weight:.2g} N near the tip (loads.csv), at rest and at a full pull"
        steps.append(Step(words, np.zeros(count), (setup.tip, setup.weight * down)))
    if count > 1 and not ((share > TOGETHER).sum(axis=1) > 1).any():
        both = " and ".join(data.robot.body.cable_names[:2])
        steps.append(Step(f"pull {both} together, both at half", 0.5 * data.input_scale * (np.arange(count) < 2)))
    return steps


def _setup(data: Data) -> Setup | None:
    try:
        robot = data.declared
        return setup_for(robot, data.control, most=data.input_scale)
    except FemsenseError:
        return None


def _gains(data: Data, fitted: FittedModel, noise: Noise, steps: Sequence[Step]) -> list[tuple[float, str]]:
    """Return for each step the ratio of the standard deviation that decreases most, and that in words."""
    nothing = [(1.0, "")] * len(steps)
    hypothesis = fitted.fit.hypothesis
    if (
        len(hypothesis.robot.body.mesh.tets) * sum(len(t.scene.frames) for t in data.train) > 2 * data.effort.work
    ):  # too large to predict
        return nothing
    try:
        J, open_model = _with_weight(data, fitted, noise)
        return [_gain(data, fitted, noise, J, open_model, step) for step in steps]
    except (FemsenseError, np.linalg.LinAlgError):
        return nothing


def _with_weight(data: Data, fitted: FittedModel, noise: Noise) -> tuple[FloatArray, Hypothesis]:
    """Return the whitened Jacobian of a fit with a last column for the weight of the body and a last row for its prior; and the hypothesis with
    that parameter."""
    fit = fitted.fit
    parameter = Parameter("scale", None, "1", 0.0, -2.0, 2.0, 1e-3, "log", known=WEIGHED)
    open_model = replace(fit.hypothesis, terms=(*fit.hypothesis.terms, (WEIGHT, {}, (parameter,))))
    problem = problem_of(data, fit, noise)
    wider = JointProblem(
        open_model,
        replace(fit.prior, mean=np.append(fit.prior.mean, 0.0), std=np.append(fit.prior.std, WEIGHED)),
        data.train,
        problem.factors,
        data.placement_std,
    )
    jacobian = wider.evaluate(np.append(fit.fit.theta, 0.0), True)[1]
    assert jacobian is not None
    return jacobian, open_model


def _gain(data: Data, fitted: FittedModel, noise: Noise, J: FloatArray, open_model: Hypothesis, step: Step) -> tuple[float, str]:
    """Return the ratio of the standard deviation that decreases most, and that in words."""
    if step.inputs is None:
        more = np.zeros((1, J.shape[1]))
        more[0, -1] = 1.0 / (0.1 * WEIGHED)
    else:
        more = _rows(data, fitted, noise, open_model, step, J.shape[1])
    own = fitted.fit.own
    before, after = (np.sqrt(np.diag(covariance_of(rows))[own:-1]) for rows in (J, np.vstack([J, more])))
    if not len(before):
        return 1.0, ""
    share = after / np.maximum(before, 1e-300)
    best = int(np.argmin(share))
    if share[best] > BRINGS:
        return float(share[best]), ""
    names = [e.name if len(own_p) == 1 else f"{e.name} {p.label}" for e, _, own_p in open_model.terms for p in own_p]
    p = open_model.parameters[best]
    unit, size = (" %", 100.0) if p.scale == "log" else ("" if p.unit == "1" else f" {p.unit}", 1.0)
    return float(
        share[best]
    ), f" (the standard deviation of {names[best]} falls from {size * before[best]:.2g}{unit} to {size * after[best]:.2g}{unit})"


def _rows(data: Data, fitted: FittedModel, noise: Noise, open_model: Hypothesis, step: Step, count: int) -> FloatArray:
    """Return the whitened rows of a state recorded HOLDS times, by all parameters of the fit, shape (3 m, p)."""
    robot, fit, head = data.declared, fitted.fit, heads_of(data.train)[0]
    names = robot.glued_names
    loads = [] if step.load is None else [step.load]
    recording = make_recording(
        Timeline([0.0], free=[True]),
        drives=Drives(
            actuation=data.control,
            actuation_zero=data.train[head].scene.recording.actuation_zero,
            cable_names=robot.body.cable_names,
            inputs=np.array([step.inputs]),
        ),
        markers=MarkerRows(names, np.zeros(len(names)), np.arange(len(names)), np.zeros((len(names), 3))),
        loads=LoadRows(
            np.zeros(len(loads)),
            np.array([place for place, _ in loads]).reshape(-1, 3),
            np.array([force for _, force in loads]).reshape(-1, 3),
        ),
    )
    scene = make_scene(data.robot, recording, np.array([0]))
    poses, initial = poses_and_inputs(data, fit)[head]
    jet = evaluate_scene(
        open_model,
        scene,
        np.append(fit.coordinates, 0.0),
        poses[:1],
        initial,
        derivative=True,
        vary_initial=initial is not None,
        pivot=data.robot.marker_points.mean(axis=0),
    )
    rows = np.zeros((len(scene.frame), 3, count))
    span = spans_of(data.train)[head]
    poses_end = span.start + 6
    rows[:, :, span.start : poses_end] = jet.by_pose[:, :, :6]
    if initial is not None:
        first = span.stop - len(initial)
        rows[:, :, first : span.stop] = jet.by_initial
    rows[:, :, fit.own :] = jet.by_effect
    std = noise.row_std(data.train[head].groups)
    return np.asarray(np.sqrt(HOLDS) / std * rows.reshape(-1, count))


def _heavier(robot: Robot, entry: Entry) -> Robot:
    """Return the robot with its weight scaled."""
    return robot.with_body(robot.body.with_gravity(number(entry, "scale", "weight", low=1e-3) * robot.body.gravity))


WEIGHT = Effect("weight", "its own weight", lambda robot, control: (), _heavier, keys=("scale",))
"""The weight of the body as a parameter of planning; not an effect of the list."""
