"""The noise of the data: what a marker repeats to in a state that is reached again. What varies with the state is an error of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.dataset import Data
from femsense.loop.data.repeats import scatter_of_repeats
from femsense.loop.data.trial import Trial
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.model.repeats import LEAST_REPEATS


@dataclass(frozen=True, eq=False, slots=True)
class Repeatability:
    """What a row repeats to."""

    std: float
    """Of a marker along each axis, where there are only clouds along their normals [m]."""
    axes: int
    """Numbers that a point has: 3 of a marker, 1 of a cloud."""
    known: bool
    """Whether it is declared or measured, not assumed."""
    source: str
    """Where it comes from, in words."""

    @property
    def total(self) -> float:
        """Root mean square noise of a point [m], over all its axes."""
        return float(np.sqrt(self.axes) * self.std)


def repeatability(data: Data, fitted: FittedModel, noise: Noise) -> Repeatability:
    """Return the noise: as recording.toml declares it, else from states that are reached again, else from rest.csv.

    Where none of them tells it, it is assumed to be the part of the residual that no two rows share.
    """
    axes = 3 if noise.std else 1
    pairs = [(t, j.residual) for t, j in zip(data.train, fitted.fit.jets) if j.residual.shape[1] == axes]
    trials = [t for t, _ in pairs]
    declared = _declared(trials) if axes == 3 else None
    if declared is not None:
        return Repeatability(declared, axes, True, "marker_noise_m of recording.toml")
    scatter, freedom = scatter_of_repeats(trials, [r for _, r in pairs])
    if freedom >= LEAST_REPEATS:
        return Repeatability(scatter, axes, True, f"states that are reached again ({freedom} degrees of freedom)")
    at_rest = _at_rest(trials) if axes == 3 else None
    if at_rest is not None:
        return Repeatability(at_rest, axes, True, "std_m of rest.csv")
    white = noise.assumed or (noise.std or noise.surface)["white"]
    return Repeatability(
        white, axes, False, "assumed from the residual: no state is reached again, and marker_noise_m is not declared"
    )


def _declared(trials: Sequence[Trial]) -> float | None:
    """Return what recordings declare [m], root mean square; None where none does."""
    known = [t.scene.recording.marker_noise_m for t in trials if t.scene.recording.marker_noise_m is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _at_rest(trials: Sequence[Trial]) -> float | None:
    """Return what markers measured at rest repeat to [m], root mean square; None where that is not known."""
    stds = [t.scene.recording.rest.std for t in trials if t.scene.recording.rest is not None]
    known: FloatArray = np.concatenate([s[np.isfinite(s)] for s in stds]) if stds else np.zeros(0)
    return float(np.sqrt(np.mean(known**2))) if known.size else None
