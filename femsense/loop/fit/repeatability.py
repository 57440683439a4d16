"""The noise of the data: the repeatability of a marker in a repeated state. Errors that vary with the state are model errors."""

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
    """Repeatability of a row."""

    std: float
    """σ of a marker along each axis; with clouds only, along their normals [m]."""
    axes: int
    """Number of rows per point: 3 for a marker, 1 for a cloud."""
    known: bool
    """Whether it is declared or measured, and not assumed."""
    source: str
    """The source, in words."""

    @property
    def total(self) -> float:
        """Root mean square noise of a point [m], over all its axes."""
        return float(np.sqrt(self.axes) * self.std)


def repeatability(data: Data, fitted: FittedModel, noise: Noise) -> Repeatability:
    """Return the noise: declared in recording.toml, else from repeated states, else from rest.csv.

    If none of these is available, the uncorrelated part of the residual is assumed.
    """
    axes = 3 if noise.std else 1
    pairs = [(t, j.residual) for t, j in zip(data.train, fitted.fit.jets) if j.residual.shape[1] == axes]
    trials = [t for t, _ in pairs]
    declared = _declared(trials) if axes == 3 else None
    if declared is not None:
        return Repeatability(declared, axes, True, "marker_noise_m of recording.toml")
    scatter, freedom = scatter_of_repeats(trials, [r for _, r in pairs])
    if freedom >= LEAST_REPEATS:
        return Repeatability(scatter, axes, True, f"repeated states ({freedom} degrees of freedom)")
    at_rest = _at_rest(trials) if axes == 3 else None
    if at_rest is not None:
        return Repeatability(at_rest, axes, True, "std_m of rest.csv")
    white = noise.assumed or (noise.std or noise.surface)["white"]
    return Repeatability(white, axes, False, "assumed from the residual: no state repeats, and marker_noise_m is not declared")


def _declared(trials: Sequence[Trial]) -> float | None:
    """Return the root mean square of the declared noise [m]; None if no recording declares one."""
    known = [t.scene.recording.marker_noise_m for t in trials if t.scene.recording.marker_noise_m is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _at_rest(trials: Sequence[Trial]) -> float | None:
    """Return the root mean square of the standard deviations in rest.csv [m]; None if there are none."""
    stds = [t.scene.recording.rest.std for t in trials if t.scene.recording.rest is not None]
    known: FloatArray = np.concatenate([s[np.isfinite(s)] for s in stds]) if stds else np.zeros(0)
    return float(np.sqrt(np.mean(known**2))) if known.size else None
