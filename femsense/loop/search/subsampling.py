"""Some states that speak for all: where meshes are large, they show the way to places, and which alternatives cannot win."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, IntArray
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.data.representative_states import spread_states
from femsense.loop.fit.fitted_model import FittedModel, problem_of, weighed
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.effect_fields import Fields
from femsense.loop.search.screening import Candidate, screen
from femsense.model.drive import has_history
from femsense.model.observation import Hypothesis
from femsense.model.robot import Robot


@dataclass(frozen=True, eq=False, slots=True)
class RepresentativeCases:
    """What a fitted model makes of some of its states."""

    data: Data
    """Nothing is held out."""
    fitted: FittedModel
    rows: list[BoolArray]
    """Which rows of each trial are theirs, shape (k,)."""
    spares: bool
    """Whether they are few enough to spare time."""

    def of(self, fit: JointFit, noise: Noise) -> JointFit:
        """Return what another fit makes of these states."""
        return _picked(self.data, fit, noise, self.rows)

    def candidate(self, candidate: Candidate, noise: Noise) -> Candidate | None:
        """Return a candidate as these states have it; None where they do not tell, or the states before them would be needed."""
        effect, seed, parameters = candidate.effect, candidate.seed, candidate.parameters
        fit = self.fitted.fit
        if not candidate.raw:
            return None
        try:
            moved = np.array([np.clip(p.null + s, p.low, p.high) for p, s in zip(parameters, candidate.step)])
            acting = Hypothesis(fit.hypothesis.robot_at(fit.coordinates), ((effect, seed, parameters),)).robot_at(moved)
        except FemsenseError:
            return None
        if has_history(acting):
            return None
        raw = [block[rows] for block, rows in zip(candidate.raw, self.rows)]
        fields = Fields([(effect, seed, parameters)], raw, candidate.placements, fit.hypothesis)
        seen = screen(fit, problem_of(self.data, fit, noise), fields, 1.0)
        return replace(seen[0], cost=candidate.cost) if seen else None


def spares(data: Data, robot: Robot) -> bool:
    """Return whether some states of a robot, which speak for all, are few enough to spare time: where a state depends on those before, all of these
    are solved, too."""
    return _spares(data, _chosen(data, robot)[1], robot)


def _spares(data: Data, share: float, robot: Robot) -> bool:
    return share < data.effort.some_states and not has_history(robot)


def _chosen(data: Data, robot: Robot) -> tuple[list[IntArray], float]:
    """Return the frames of these states, of each trial, and how many of all distinct states they are."""
    chosen = [spread_states(t, data.effort.work // len(robot.body.mesh.tets)) for t in data.train]
    return [frames for frames, _ in chosen], float(np.mean([share for _, share in chosen]))


def representative_cases(data: Data, fitted: FittedModel, noise: Noise) -> RepresentativeCases:
    """Return some states of a fitted model that differ as much as they can, or all of them where these are not too much work."""
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    frames, share = _chosen(data, robot)
    rows = [np.isin(t.scene.frame, cases) for t, cases in zip(data.train, frames)]
    bare, less = replace(data, held=[], held_of=[]), _spares(data, share, robot)
    if all(own.all() for own in rows):
        return RepresentativeCases(bare, fitted, rows, less)
    trials = [
        replace(t.part(cases), mesh_error=None if t.mesh_error is None else t.mesh_error[own])
        for t, cases, own in zip(data.train, frames, rows)
    ]
    part = replace(bare, train=trials)
    return RepresentativeCases(part, FittedModel(_picked(part, fitted.fit, noise, rows), [], float("nan")), rows, less)


def _picked(data: Data, fit: JointFit, noise: Noise, rows: list[BoolArray]) -> JointFit:
    """Return what a fit makes of some rows, which are the data."""
    return weighed(data, fit, noise, [jet.pick(own) for jet, own in zip(fit.jets, rows)])
