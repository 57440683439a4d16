"""Some states that speak for all: where meshes are large, they show the way to places, and which rivals cannot win."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from femsense.arrays import BoolArray, FloatArray, IntArray
from femsense.calib.forward import Hypothesis
from femsense.errors import FemsenseError
from femsense.loop.data import Data
from femsense.loop.joint import JointFit, Trial
from femsense.loop.noise import Noise
from femsense.loop.screen import Candidate, Fields, screen
from femsense.loop.stages import Stage, problem_of, weighed
from femsense.march import has_history
from femsense.recording import Recording

MOST_WORK = 20_000
"""Tetrahedra × states of a recording that are fitted as they are; where there are more, some states speak for all."""
FEWEST = 12
"""They are as many at least …"""
SPARED = 0.6
"""… and no more than this share of all, or rivals are fitted on all at once."""
SAME = 1e-9
"""States whose inputs and loads differ by less, in units of their ranges, are one."""


@dataclass(frozen=True, eq=False, slots=True)
class Few:
    """What a stage makes of some of its states."""

    data: Data
    """Nothing is held out."""
    stage: Stage
    rows: list[BoolArray]
    """Which rows of each trial are theirs, shape (k,)."""
    share: float
    """How many of all distinct states they are."""

    @property
    def spares(self) -> bool:
        """Whether they are few enough to spare time: where a state depends on those before, all of these are solved, too."""
        fit = self.stage.fit
        return self.share < SPARED and not has_history(fit.hypothesis.robot_at(fit.coordinates))

    def of(self, fit: JointFit, noise: Noise) -> JointFit:
        """Return what another fit makes of these states."""
        return _picked(self.data, fit, noise, self.rows)

    def candidate(self, candidate: Candidate, noise: Noise) -> Candidate | None:
        """Return a candidate as these states have it; None where they do not tell, or the states before them would be needed."""
        effect, seed, parameters = candidate.effect, candidate.seed, candidate.parameters
        fit = self.stage.fit
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
        fields = Fields([(effect, seed, parameters)], raw, candidate.seats, fit.hypothesis)
        seen = screen(fit, problem_of(self.data, fit, noise), fields, 1.0)
        return replace(seen[0], cost=candidate.cost) if seen else None


def few_of(data: Data, stage: Stage, noise: Noise) -> Few:
    """Return some states of a stage that differ as much as they can, or all of them where these are not too much work."""
    tets = len(stage.fit.hypothesis.robot.body.mesh.tets)
    chosen = [spread_states(t, MOST_WORK // tets) for t in data.train]
    frames = [few for few, _ in chosen]
    rows = [np.isin(t.scene.frame, few) for t, few in zip(data.train, frames)]
    bare = replace(data, held=[], held_of=[])
    if all(own.all() for own in rows):
        return Few(bare, stage, rows, 1.0)
    trials = [
        replace(t.part(few), mesh_error=None if t.mesh_error is None else t.mesh_error[own])
        for t, few, own in zip(data.train, frames, rows)
    ]
    part = replace(bare, train=trials)
    share = float(np.mean([share for _, share in chosen]))
    return Few(part, Stage(_picked(part, stage.fit, noise, rows), [], float("nan")), rows, share)


def _picked(data: Data, fit: JointFit, noise: Noise, rows: list[BoolArray]) -> JointFit:
    """Return what a fit makes of some rows, which are the data."""
    return weighed(data, fit, noise, [jet.pick(own) for jet, own in zip(fit.jets, rows)])


def spread_states(trial: Trial, most: int) -> tuple[IntArray, float]:
    """Return the frames of a trial in so many of its states at most, FEWEST at least, which differ as much as they can, ascending; and the share of
    its states that these are."""
    frames = trial.scene.frames
    vectors = state_vectors(trial.scene.recording, frames)
    every = representatives(vectors, len(vectors))
    chosen = vectors[every[: max(FEWEST, most)]]
    return np.asarray(frames[cdist(vectors, chosen).min(axis=1) <= SAME]), len(chosen) / len(every)


def state_vectors(recording: Recording, frames: IntArray) -> FloatArray:
    """Return inputs, pressures, gravity and total load of each frame, each in units of its range, shape (f, q)."""
    load = np.zeros((len(recording.time_s), 3))
    np.add.at(load, recording.load_frame, recording.load_forces)
    gravity = np.zeros((len(load), 0)) if recording.gravity is None else recording.gravity
    table = np.hstack([recording.inputs, recording.pressures, gravity, load])[frames]
    return np.asarray((table - table[0]) / np.maximum(np.ptp(table, axis=0), 1e-12))


def representatives(vectors: FloatArray, most: int) -> list[int]:
    """Return indices of distinct states, at most so many, spread widely (farthest-point sampling)."""
    chosen = [0]
    distance = np.linalg.norm(vectors - vectors[0], axis=1)
    while len(chosen) < most and distance.max() > SAME:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(vectors - vectors[chosen[-1]], axis=1))
    return chosen


__all__ = ["Few", "few_of", "representatives", "spread_states", "state_vectors"]
