"""The model error: the residual beyond noise, marker placement and discretisation error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.loop.data.dataset import Data
from femsense.loop.fit.discretisation_error import beyond_mesh, mesh_error_rms
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import Repeatability
from femsense.loop.result.records import ModelError


@dataclass(frozen=True, slots=True)
class Excess:
    """Root mean square residuals [m] beyond noise and marker placement, with the most likely share of the discretisation error subtracted."""

    left: float
    """Of the final model, fitted data."""
    held: float
    """Of the returned model, held-out data."""
    floor: float
    """Noise and marker placement together."""
    mesh: float
    """Discretisation error; 0 if unknown."""
    believed: float
    """The noise used: the measured repeatability or, if none was measured, the assumed one up to `relevant` of the body's reach."""
    explained: float
    """Share of the mean square beyond `floor` that the effects removed: the smaller of that of the final model in the fitted data and that of the
    returned model in the held-out data."""

    @property
    def is_large(self) -> bool:
        """Whether the model error exceeds noise and discretisation error together."""
        return self.left > float(np.hypot(self.believed, self.mesh))


def excess_of(
    data: Data, before: FittedModel, final: FittedModel, back: FittedModel, noise: Noise, measured: Repeatability
) -> Excess:
    """Return the residuals of three models: `before`, the final one, and the returned one (`back`)."""
    believed = measured.total if measured.known else min(measured.total, data.thresholds.relevant * data.robot.body.reach)
    floor = float(np.hypot(believed, placement_rms(data, noise)))
    fitted = [beyond_mesh(data.train, [j.residual for j in s.fit.jets], noise) for s in (before, final)]
    held = [beyond_mesh(data.held, s.held_residuals, noise) for s in (before, back)]
    explained = min(_taken_away(fitted[0], fitted[1], floor), _taken_away(held[0], held[1], floor))
    return Excess(_beyond(fitted[1], floor), _beyond(held[1], floor), floor, mesh_error_rms(data) or 0.0, believed, explained)


def model_error(data: Data, excess: Excess, noise: Noise, measured: Repeatability) -> ModelError:
    """Return the parts of the held-out error as a record."""
    return ModelError(
        fitted_m=excess.left,
        held_out_m=excess.held,
        noise_m=measured.total,
        noise_is_measured=measured.known,
        noise_source=measured.source,
        placement_m=placement_rms(data, noise),
        discretisation_m=mesh_error_rms(data),
        discretisation_note=data.mesh_note,
    )


def placement_rms(data: Data, noise: Noise) -> float:
    """Return the rms error of the declared marker positions [m]: the estimate from the data, at most the prior."""
    return float(np.sqrt(3.0)) * min(noise.std.get("marker", 0.0), data.placement_std)


def _beyond(value: float, floor: float) -> float:
    return float(np.sqrt(max(value**2 - floor**2, 0.0)))


def _taken_away(before: float, after: float, floor: float) -> float:
    """Return the removed share of the mean square beyond the floor; 1 if nothing remains beyond it."""
    return 1.0 if after <= floor else float((before**2 - after**2) / max(before**2 - floor**2, 1e-18))
