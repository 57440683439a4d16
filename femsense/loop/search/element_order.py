"""Linear meshes: effects are sought with quadratic elements, and at the end it is asked whether these are needed.

Linear elements lock, which looks like a stiff body, a small Poisson's ratio, or a clamp that does not give: what is found beside them stands for
their error as well. Whether quadratic elements of the same mesh err less is no question that data have to answer; whether these data show the
difference is one, and it is asked when everything else is in the model.

Where a recording was computed on the declared mesh, calibration alone shows that: linear elements then leave plainly less than quadratic ones. Effects are
sought on the declared mesh, which is no worse than it shows itself, and takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import MESH, NUISANCE, QUADRATIC, Data
from femsense.loop.data.representative_states import FEWEST, spread_states
from femsense.loop.fit.fitted_model import ROUGHLY, FittedModel, fit_model, span_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.calibration import START, calibrated_on, calibrated_pose
from femsense.loop.search.refit import FORGONE, beyond
from femsense.loop.search.screening import Candidate, penalty
from femsense.loop.search.search_state import Search, no_equilibrium
from femsense.loop.search.subsampling import representative_cases
from femsense.model.effects import Entry
from femsense.model.robot import Robot

PLAINLY = 0.5
"""Linear elements suffice where they leave less than this share of the mean square that quadratic ones leave, both calibrated: a tenth in the arms of
`benchmarks/distinct_states.py --elements`, which were computed on the declared elements."""


def seeks_with_quadratic(robot: Robot, names: Sequence[str]) -> bool:
    """Return whether effects are sought with quadratic elements where a robot declares linear ones."""
    return MESH.name in names and QUADRATIC in MESH.seeds(robot)


def with_quadratic(robot: Robot) -> Robot:
    """Return a robot with quadratic elements."""
    return MESH.apply(robot, QUADRATIC)


def linear_suffice(data: Data) -> RefitRecord | None:
    """Return what became of quadratic elements where linear ones leave plainly less in some of the states, both calibrated; None where they do not, and of
    clouds, whose rows depend on the mesh.

    Arguments:
        data: on the declared mesh.
    """
    if "clouds" in data.measured:
        return None
    try:
        linear, quadratic = both_calibrated(data)
    except FemsenseError:
        return None
    left = f"in some of the states they leave {1e3 * quadratic:.2f} mm, linear ones {1e3 * linear:.2f} mm, both calibrated"
    return RefitRecord(MESH.name, QUADRATIC, left, step=1) if linear**2 < PLAINLY * quadratic**2 else None


def both_calibrated(data: Data) -> tuple[float, float]:
    """Return what linear and quadratic elements leave [m], root mean square, each with all that calibration may move, in some of the states.

    Arguments:
        data: on the declared mesh.

    Raises:
        DataError: a kind of elements has no equilibrium there.
    """
    part = replace(data, train=[t.part(spread_states(t, FEWEST)[0]) for t in data.train], held=[], held_of=[])
    linear = calibrated_on(part, data.robot, calibrated_pose(part, data.robot, START))
    return linear.fit.rms, calibrated_on(part, with_quadratic(data.robot), linear).fit.rms


def need_quadratic(data: Data, search: Search, names: Sequence[str]) -> tuple[bool, list[RefitRecord]]:
    """Return whether the data miss quadratic elements where the whole model has linear ones, and what became of both kinds of mesh that were tried.

    Arguments:
        data: the data.
        search: what was found with quadratic elements.
        names: effects that are tried.
    """
    candidate = _candidate(names, search.n_effective)
    record = RefitRecord(MESH.name, QUADRATIC, step=1)
    worth = beyond(search.final.fit, FORGONE[1] * (candidate.cost + data.thresholds.evidence) + FORGONE[0])
    try:
        without = _on(data, data.robot_as_declared, search.history[0][1], search.final, search.noise, worth=worth)
        record = acceptance_test(data, without, candidate, search.final, record, search.noise).record
    except FemsenseError:
        record = replace(record, verdict=PASSES)  # without them it has no equilibrium
    needed = record.passes
    record = replace(record, verdict=NAMED) if needed else record
    return needed, [record, *(_refined(data, search, seed) for seed in MESH.seeds(data.robot_as_declared) if seed != QUADRATIC)]


def _candidate(names: Sequence[str], n_effective: float) -> Candidate:
    """Return quadratic elements as a candidate that was not screened."""
    nothing = np.zeros(0)
    cost = penalty(0, QUADRATIC, 1, max(len(names), 1), n_effective)
    return Candidate(MESH, QUADRATIC, (), [], [], np.zeros((0, 0)), np.zeros((0, 0)), 1.0, nothing, np.inf, np.inf, cost, nothing)


def _on(
    data: Data, mesh_of: Robot, linear: FittedModel, final: FittedModel, noise: Noise, *, worth: float = np.inf, steps: int = 12
) -> FittedModel:
    """Return a model fitted on the mesh of another robot: what calibration may move from where it was on linear elements, effects from where they are.
    Raises DataError."""
    fit, robot = final.fit, mesh_of
    others = tuple((effect, seed) for effect, seed in fit.hypothesis.settled if effect is not MESH)
    for effect, seed in others:
        robot = effect.apply(robot, seed)
    start = fit.coordinates.copy()
    for name in NUISANCE:
        if name in fit.hypothesis.names:
            start[span_of(fit, name)] = linear.fit.coordinates[span_of(linear.fit, name)]
    hypothesis = replace(fit.hypothesis, robot=robot, settled=others)
    own = fit.fit.theta[: fit.own]
    return fit_model(data, hypothesis, fit.prior, noise, start, own=own, worth=worth, max_iterations=steps)


def _refined(data: Data, search: Search, seed: Entry) -> RefitRecord:
    """Return what became of refined linear elements, tried in some states."""
    cases = representative_cases(data, search.final, search.noise)
    try:
        made = _on(
            cases.data, MESH.apply(data.robot_as_declared, seed), search.history[0][1], cases.fitted, search.noise, steps=ROUGHLY
        )
        verdict = f"in some of the states χ² is {made.fit.chi2:.0f}, with quadratic elements {cases.fitted.fit.chi2:.0f}"
    except FemsenseError as error:
        verdict = no_equilibrium(error)
    return RefitRecord(MESH.name, seed, verdict, step=1)
