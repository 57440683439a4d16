"""Declared linear meshes: the search uses quadratic elements, and tests at the end whether the data need them.

Linear elements lock, and effects found with them would also compensate for that error. If calibration shows that the recording was computed with the
declared linear elements, the search uses these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import MESH, NUISANCE, QUADRATIC, Data
from femsense.loop.data.representative_states import FEWEST, spread_states
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.fitted_model import ROUGHLY, FittedModel, fit_model, span_of
from femsense.loop.fit.joint_fit import FitOptions
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.calibration import START, calibrated_on, calibrated_pose
from femsense.loop.search.refit import beyond
from femsense.loop.search.screening import Candidate, penalty
from femsense.loop.search.search_state import Search, no_equilibrium
from femsense.model.effects import Entry
from femsense.model.robot import Robot


def seeks_with_quadratic(robot: Robot, names: Sequence[str]) -> bool:
    """Return whether effects are searched for on quadratic elements although a robot declares linear ones."""
    return MESH.name in names and QUADRATIC in MESH.seeds(robot)


def with_quadratic(robot: Robot) -> Robot:
    """Return a robot with quadratic elements."""
    return MESH.apply(robot, QUADRATIC)


def linear_suffice(data: Data) -> RefitRecord | None:
    """Return the rejection of quadratic elements if, calibrated, they leave more than `lacks` times the mean square of linear ones in some of the states; else
    None. None for clouds too, whose rows depend on the mesh. For the arms of `benchmarks/distinct_states.py --elements`, which were computed
    on linear elements, the ratio is ten.

    Arguments:
        data: on the declared mesh.
    """
    if "clouds" in data.measured:
        return None
    try:
        linear, quadratic = both_calibrated(data)
    except FemsenseError:
        return None
    left = f"in some of the states quadratic elements leave {1e3 * quadratic:.2f} mm, linear ones {1e3 * linear:.2f} mm, both calibrated"
    return RefitRecord(MESH.name, QUADRATIC, left, step=1) if quadratic**2 > data.thresholds.lacks * linear**2 else None


def both_calibrated(data: Data) -> tuple[float, float]:
    """Return the rms residuals of linear and quadratic elements [m], each fully calibrated in some of the states.

    Arguments:
        data: on the declared mesh.

    Raises:
        DataError: one of them has no equilibrium there.
    """
    part = replace(data, train=[t.part(spread_states(t, FEWEST)[0]) for t in data.train], held=[], held_of=[])
    linear = calibrated_on(part, data.robot, calibrated_pose(part, data.robot, START))
    return linear.fit.rms, calibrated_on(part, with_quadratic(data.robot), linear).fit.rms


def need_quadratic(data: Data, search: Search, names: Sequence[str]) -> tuple[bool, list[RefitRecord]]:
    """Return whether the data need quadratic elements, tested by refitting the whole model with linear ones; and the records of the meshes tried.

    Arguments:
        data: the data.
        search: completed search with quadratic elements.
        names: effects that are tried.
    """
    candidate = _candidate(names, search.n_effective)
    record = RefitRecord(MESH.name, QUADRATIC, step=len(search.history))
    worth = beyond(search.final.fit, candidate.cost + data.thresholds.evidence)
    try:
        without = _on(data, data.robot_as_declared, search, worth=worth)
        record = acceptance_test(data, without, candidate, search.final, record, search.noise).record
    except FemsenseError:
        record = replace(record, verdict=PASSES)  # linear elements have no equilibrium
    needed = record.passes
    record = replace(record, verdict=NAMED) if needed else record
    return needed, [record, *(_refined(data, search, seed) for seed in MESH.seeds(data.robot_as_declared) if seed != QUADRATIC)]


def _candidate(names: Sequence[str], n_effective: float) -> Candidate:
    """Return quadratic elements as a candidate without screening."""
    nothing = np.zeros(0)
    cost = penalty(0, QUADRATIC, 1, max(len(names), 1), n_effective)
    return Candidate(MESH, QUADRATIC, (), [], [], np.zeros((0, 0)), np.zeros((0, 0)), 1.0, nothing, np.inf, np.inf, cost, nothing)


def _on(data: Data, mesh_of: Robot, search: Search, **options: Unpack[FitOptions]) -> FittedModel:
    """Return the last model of a search refitted on the mesh of another robot. Nuisance parameters start from their values on linear elements, effects from
    their current ones. Raises DataError."""
    fit, linear, robot = search.final.fit, search.history[0][1], mesh_of
    others = tuple((effect, seed) for effect, seed in fit.hypothesis.settled if effect is not MESH)
    for effect, seed in others:
        robot = effect.apply(robot, seed)
    start = fit.coordinates.copy()
    for name in NUISANCE:
        if name in fit.hypothesis.names:
            start[span_of(fit, name)] = linear.fit.coordinates[span_of(linear.fit, name)]
    hypothesis = replace(fit.hypothesis, robot=robot, settled=others)
    options["own"] = fit.fit.theta[: fit.own]
    return fit_model(data, hypothesis, fit.prior, search.noise, start, **options)


def _refined(data: Data, search: Search, seed: Entry) -> RefitRecord:
    """Return the record of refined linear elements, tried in some states."""
    frames = [spread_states(t, FEWEST)[0] for t in data.train]
    part = replace(data, train=[t.part(f) for t, f in zip(data.train, frames)], held=[], held_of=[])
    pairs = zip(data.train, frames, search.final.fit.jets)
    there = rms_of([jet.residual[np.isin(t.scene.frame, f)] for t, f, jet in pairs])
    try:
        left = _on(part, MESH.apply(data.robot_as_declared, seed), search, max_iterations=ROUGHLY).fit.rms
        verdict = f"in some of the states it leaves {1e3 * left:.2f} mm, quadratic elements {1e3 * there:.2f} mm"
    except FemsenseError as error:
        verdict = no_equilibrium(error)
    return RefitRecord(MESH.name, seed, verdict, step=1)
