"""Readings of the body: another direction of gravity, another modulus. Their predicted misfit is that of a few frames."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from femsense.calib.input_readings import marker_places
from femsense.calib.inputs import most_different
from femsense.calib.marker_fit import MarkerFit, root_mean_square
from femsense.calib.readings import REFUSED, REPORTED, Reading, share_with
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.model.recording_checks import in_frames

FEW = 3
"""Frames by which they are predicted, those with the most different states."""
SAME = 7
"""Decimals of metres to which places of one state agree."""
MODULI = (0.4, 0.63, 1.6, 2.5)
"""Other moduli, as shares of the declared one, next to the one that the motions of the markers indicate. Without them, an arm declared 1.67
times too stiff was refused because of another direction of gravity."""
STEP = 1.6
"""Ratio of neighbours among them: the best one is refined up to there. Between them, a beam declared 1.75 times too soft was refused because of
another direction of gravity: under load, the nearest modulus still left twice the misfit of that direction."""
REFINED = 5
"""Misfits that the refinement computes; up to 20 change the modulus by less than 1 %."""
LEAST = 1.5
"""Ratio of motions below which they indicate no other modulus: laws differ by less on a correct recording."""
STILL = 1e-3
"""A model whose markers move by less than this share of their spread indicates no modulus."""
UNLIKELY = 3.0
"""A modulus off by more is refused: silicones of one name differ by a factor of two."""


Predict = Callable[[Reading], Reading | None]
"""Returns a reading with its predicted misfit; None where it has no equilibrium."""


def direction_of_gravity(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the reading of the files with gravity along another axis."""
    yield from filter(None, map(_prediction(fit), _gravities(fit)))


def modulus(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the reading with the Young's modulus that fits best."""
    predict, motion = _prediction(fit), _motion(fit)
    indicated = [1.0 / motion] if motion > 0.0 and max(motion, 1.0 / motion) > LEAST else []

    def of_log_scale(log_scale: float) -> Reading | None:
        return predict(_other_modulus(fit, float(np.exp(log_scale)), motion))

    def misfit(log_scale: float) -> float:
        reading = of_log_scale(log_scale)
        return np.inf if reading is None else reading.predicted

    tried = {x: misfit(x) for x in np.log([*MODULI, *indicated])}
    best = min(tried, key=tried.__getitem__)
    if tried[best] * REPORTED < 1.0:
        near = (best - np.log(STEP), best + np.log(STEP))
        refined = minimize_scalar(misfit, bounds=near, method="bounded", options={"maxiter": REFINED})
        reading = of_log_scale(refined.x if refined.fun < tried[best] else best)
        if reading is not None:
            yield reading


def _prediction(fit: MarkerFit) -> Predict:
    """Return the function that predicts the misfit of a reading by a few frames."""
    scene = fit.scene
    places = np.array([fit.robot.markers.positions(fit.jet.states[k].positions) for k in scene.frames.tolist()])
    moved = (places - places.mean(axis=0)).reshape(len(places), -1)
    chosen = np.array(most_different(moved, FEW))
    chosen = np.sort(chosen[np.unique(moved[chosen].round(SAME), axis=0, return_index=True)[1]])
    few, now = scene.frames[chosen], places[chosen]
    rows = np.isin(scene.frame, few)

    def predict(one: Reading) -> Reading | None:
        other = marker_places(one.robot or fit.robot, one.recording or scene.recording, few, fit.initial)
        if other is None:
            return None
        modelled = fit.modelled.copy()
        modelled[rows] += (other - now)[np.searchsorted(few, scene.frame[rows]), scene.marker[rows]]
        return replace(one, predicted=share_with(fit, modelled=modelled, rows=rows))

    return predict


def _gravities(fit: MarkerFit) -> Iterator[Reading]:
    body, recording = fit.robot.body, fit.scene.recording
    size = float(np.linalg.norm(body.gravity))
    if recording.gravity is not None:
        error = f"the gravity{in_frames(recording)} seems to have the wrong sign (an accelerometer at rest shows it upwards)"
        yield Reading(error, recording=replace(recording, gravity=freeze(-recording.gravity)))
        return
    for j, sign in itertools.product(range(3) if size else (), (1.0, -1.0)):
        other = sign * size * np.eye(3)[j]
        if float(other @ body.gravity) < 0.9 * size**2:
            axis = f"{'-' if sign < 0 else '+'}{'xyz'[j]}"
            error = f"gravity seems to point along {axis} of the robot, not as gravity.vector_m_s2 says"
            yield Reading(error, robot=replace(fit.robot, body=body.with_gravity(other)))


def _other_modulus(fit: MarkerFit, scale: float, motion: float) -> Reading:
    shown = f" (under these inputs, the markers move {motion:.3g} times as far as the model)" if motion > 0.0 else ""
    return Reading(
        f"the body seems to have about {scale:.2g} times its declared modulus{shown}",
        robot=replace(fit.robot, body=fit.robot.body.with_stiffness_scale(scale)),
        advice="Is young_modulus_pa right? femsense improve finds it.",
        parameters=1,
        refused=REFUSED if max(scale, 1.0 / scale) > UNLIKELY else np.inf,
    )


def _motion(fit: MarkerFit) -> float:
    """Return how far the markers move about their means, as a multiple of the model's motion along it [1]; 0 where the model hardly moves."""
    _, label = np.unique(np.column_stack([fit.scene.view, fit.scene.marker]), axis=0, return_inverse=True)
    own, seen = (places - _means(places, label.ravel()) for places in (fit.modelled, fit.measured))
    moved = root_mean_square(own)
    return float((own * seen).sum() / (own**2).sum()) if moved > STILL * max(map(fit.spread_of, range(len(fit.poses)))) else 0.0


def _means(rows: FloatArray, label: IntArray) -> FloatArray:
    """Return for each row (n, c) the mean of those with its label (n,)."""
    return np.stack([np.bincount(label, column) / np.bincount(label) for column in rows.T], axis=1)[label]
