"""Calibration within the loop: of the declared robot with all nuisance parameters, and again when rows, weights or the model change."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np

from femsense.core.errors import DataError, FemsenseError
from femsense.loop.data.dataset import MESH, Data
from femsense.loop.data.outliers import without_outliers
from femsense.loop.fit.discretisation_error import representative_frames, with_mesh_errors
from femsense.loop.fit.fitted_model import ROUGHLY, FittedModel, fit_model, own_of, rematched, roughly_keeping, with_nuisance
from femsense.loop.fit.joint_fit import FitOptions, Prior
from femsense.loop.fit.marker_placement import with_errors_as_shown
from femsense.loop.fit.noise_components import UNTOLD, Noise
from femsense.loop.search.search_state import Progress
from femsense.loop.search.swaps import History
from femsense.model.effects import OF_BODY
from femsense.model.observation import Hypothesis
from femsense.model.robot import Robot

START = Noise({"white": UNTOLD}, "start")
"""The noise before it is estimated."""
STEPS = 12
"""Maximum number of steps of a fit with an estimated noise; large meshes stop earlier, when the predicted gain is small."""
Ready = tuple[Data, FittedModel, History]
"""Data, the declared model with its camera calibrated, and the models that the search extends."""


def calibrated(data: Data, progress: Progress) -> Ready:
    """Return the data without outliers, the declared model with its camera calibrated, and the fully calibrated model; preceded by the same on the
    declared mesh if the search uses another one."""
    data, placed = calibrated_without_outliers(data, data.robot, START)
    progress("fitting the nuisance parameters")
    base = calibrated_on(data, data.robot, placed)
    if "clouds" in data.measured:
        progress("recomputing the rows of the clouds")
        rough = base.fit.normal_rms
        data, base = matched(data, base, START if rough is None else replace(START, surface={"white": rough}), reselect=True)
        placed = calibrated_pose(data, data.robot, START, placed)
    if not data.settled:
        return data, placed, [("", base)]
    declared = data.robot_as_declared
    before = calibrated_pose(data, declared, START)
    return data, before, [("", calibrated_on(data, declared, before)), (MESH.name, base)]


def calibrated_pose(data: Data, robot: Robot, noise: Noise, start: FittedModel | None = None) -> FittedModel:
    """Return a robot with its camera poses and initial inputs calibrated."""
    nothing = Prior(np.zeros(0), np.zeros(0))
    own = None if start is None else own_of(start)
    return fit_model(data, Hypothesis(robot), nothing, noise, np.zeros(0), own=own)


def calibrated_without_outliers(data: Data, robot: Robot, noise: Noise) -> tuple[Data, FittedModel]:
    """Return the data without outliers, and a robot with its camera poses and initial inputs calibrated to them."""
    placed = calibrated_pose(data, robot, noise)
    while (fewer := without_outliers_of(data, placed)) is not data:
        data, placed = fewer, calibrated_pose(fewer, robot, noise)
    return data, placed


def without_outliers_of(data: Data, fitted: FittedModel) -> Data:
    """Return the data without the outliers of a fitted model; the same object if there are none."""
    return without_outliers(data, [jet.residual for jet in fitted.fit.jets], fitted.held_residuals)


def calibrated_on(data: Data, robot: Robot, placed: FittedModel) -> FittedModel:
    """Return a robot with all nuisance parameters fitted, in a few steps, to all states. A fit to representative states would end elsewhere: with
    fewer states the missing effects bias offsets and modulus more."""
    hypothesis, prior = with_nuisance(data, robot)
    nothing = np.zeros(len(prior.mean))
    return as_far_as_held_out_states_converge(
        lambda steps: fit_model(data, hypothesis, prior, START, nothing, own=own_of(placed), max_iterations=steps), ROUGHLY
    )


def with_discretisation_error(data: Data, base: FittedModel, names: Sequence[str], progress: Progress) -> Data:
    """Return the data with the discretisation error, and with marker placements that rotate with the body."""
    progress("estimating the discretisation error")
    try:  # the offsets of `base` may be biased by a missing effect, so only the modulus is kept
        frames = [representative_frames(t, len(base.fit.hypothesis.robot.body.mesh.tets)) for t in data.train]
        plain = roughly_keeping(data, base, OF_BODY, START, frames)
    except FemsenseError:
        plain = base
    return with_errors_as_shown(with_mesh_errors(data, plain, names), base)


def as_far_as_held_out_states_converge(fit: Callable[[int], FittedModel], steps: int) -> FittedModel:
    """Return a fit with `steps` steps, or with fewer if a held-out state collapses: nuisance parameters can be biased by a missing effect, which
    must not end the search. Raises DataError if the start has no equilibrium either."""
    for most in (steps, 2, 1):
        with contextlib.suppress(DataError):
            return fit(most)
    return fit(0)


def matched(data: Data, fitted: FittedModel, noise: Noise, *, reselect: bool = False) -> tuple[Data, FittedModel]:
    """Return the data with cloud rows recomputed in the fitted states, and the model fitted to these; repeated until χ² hardly changes, because the
    rounding computed in the previous state pulls the fit back towards it. With `reselect` the rows are selected again too."""
    for _ in range(data.effort.matchings):
        data = rematched(data, fitted, noise, reselect=reselect)
        fitted = fitted_again(data, fitted, noise, near=None if reselect else fitted.fit.jets)
        if fitted.fit.fit.cost[0] - fitted.fit.chi2 <= data.thresholds.evidence / 2.0:
            break
    return data, fitted


def fitted_again(data: Data, fitted: FittedModel, noise: Noise, **options: Unpack[FitOptions]) -> FittedModel:
    """Return a model refitted to other weights or rows, starting from its current values; derivatives known there, or close by, are reused."""
    fit, options["own"] = fitted.fit, own_of(fitted)

    def refitted(steps: int) -> FittedModel:
        options["max_iterations"] = steps
        return fit_model(data, fit.hypothesis, fit.prior, noise, fit.coordinates, **options)

    return as_far_as_held_out_states_converge(refitted, STEPS)
