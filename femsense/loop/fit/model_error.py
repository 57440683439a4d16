"""What a model leaves beyond the noise, the placement of markers and the discretisation error: its own error."""

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
    """Root mean squares [m] over what repeats and what markers are placed to, less the likeliest share of the discretisation error."""

    left: float
    """What the final model leaves where it is fitted."""
    held: float
    """What the model that is handed back leaves of held-out data."""
    floor: float
    """Noise with the placement of markers."""
    mesh: float
    """Discretisation error; 0 where it is not known."""
    believed: float
    """The noise that is believed: what repeats or, where nothing does, no more than a share of the body."""
    explained: float
    """Share of the mean square beyond the floor that the effects took away: where fitted by all that was found, on held-out data by what is
    handed back; the smaller one."""

    @property
    def is_large(self) -> bool:
        """Whether it is larger than the noise and the discretisation error together, so that nothing of it is noise."""
        return self.left > float(np.hypot(self.believed, self.mesh))


def excess_of(
    data: Data, before: FittedModel, final: FittedModel, back: FittedModel, noise: Noise, measured: Repeatability
) -> Excess:
    """Return what models leave: `before`, with all that was found (`final`), and that is handed back (`back`)."""
    believed = measured.total if measured.known else min(measured.total, data.thresholds.resolved * data.robot.body.reach)
    floor = float(np.hypot(believed, placement_rms(data, noise)))
    fitted = [beyond_mesh(data.train, [j.residual for j in s.fit.jets], noise) for s in (before, final)]
    held = [beyond_mesh(data.held, s.held_residuals, noise) for s in (before, back)]
    explained = min(_taken_away(fitted[0], fitted[1], floor), _taken_away(held[0], held[1], floor))
    return Excess(_beyond(fitted[1], floor), _beyond(held[1], floor), floor, mesh_error_rms(data) or 0.0, believed, explained)


def model_error(data: Data, excess: Excess, noise: Noise, measured: Repeatability) -> ModelError:
    """Return what the held-out error consists of, as a record."""
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
    """Return how far markers are likely to sit from where they are declared [m]: as far as the data say, and no farther than is known beforehand."""
    return float(np.sqrt(3.0)) * min(noise.std.get("marker", 0.0), data.placement_std)


def _beyond(value: float, floor: float) -> float:
    return float(np.sqrt(max(value**2 - floor**2, 0.0)))


def _taken_away(before: float, after: float, floor: float) -> float:
    """Return the share of the mean square beyond the floor that is gone; all of it where nothing is left beyond."""
    return 1.0 if after <= floor else float((before**2 - after**2) / max(before**2 - floor**2, 1e-18))
