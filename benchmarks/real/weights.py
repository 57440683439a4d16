"""What calibration within the loop leaves of a robot, by weights of the richest linear model, and by those that hold its own error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from femsense import load_recording, load_robot
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.fitted_model import FittedModel, span_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.calibration import calibrated, fitted_again, with_discretisation_error
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.screening import noise_of
from femsense.loop.verdict.empirical import judged_correction
from femsense.model.effects import EFFECT_NAMES, FORMS, forms_by_recording

LEFT_OUT = "soft_region", "rest_shape", "hyperelastic"
"""Effects whose fields take most of the time and change these weights little."""


def fitted_by_weights(robot: Path, train: Sequence[Path], held: Sequence[Path]) -> list[str]:
    """Return cells of a table: for both weights what is left where fitted and held out [mm] and the scale of the modulus; with a correction, held out."""
    names = [name for name in EFFECT_NAMES if name not in LEFT_OUT]
    recordings, others = [load_recording(path) for path in train], [load_recording(path) for path in held]
    body = load_robot(robot)
    data = replace(prepare(body, recordings, others), forms=(*FORMS, *forms_by_recording(FORMS, recordings)))
    data, before, history = calibrated(data, lambda text: None)
    base = history[-1][1]
    data = with_discretisation_error(data, base, names, lambda text: None)
    noise = noise_of(data, base, fields_of(data, base, names))[0]
    rich = fitted_again(data, base, noise, known=base.fit.jets)
    own = noise_of(data, rich, None, noise)[0]
    held_by = fitted_again(data, base, own, known=base.fit.jets)
    correction = judged_correction(data, held_by)[0].validation_rms_after_m
    cells = [f"{1e3 * before.held_rms:.1f}", *_cells(data, rich, noise), *_cells(data, held_by, own)]
    return [*cells, "–" if correction is None else f"{1e3 * correction:.1f}"]


def _cells(data: Data, fitted: FittedModel, noise: Noise) -> list[str]:
    left = 1e3 * rms_of([jet.residual for jet in fitted.fit.jets])
    std = parameter_std(data, fitted, noise, {})
    scale = float(np.exp(fitted.fit.coordinates[span_of(fitted.fit, "stiffness")][0]))
    return [f"{left:.1f}; {1e3 * fitted.held_rms:.1f}", f"{scale:.3f} ± {scale * float(std['stiffness'][0]):.3f}"]
