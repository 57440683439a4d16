"""An empirical correction is learned from what a model leaves, beyond what calibration can move, and refused where it does not help."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, record

from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.correction import learn_correction, rows_of
from femsense.loop.fit.fitted_model import FittedModel, fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.verdict.empirical import judged_correction
from femsense.model.marker_correction import SEPARATE
from femsense.model.recording import Recording

NOISE = Noise({"white": 1e-4}, "")


def pulled(rows: np.ndarray, seed: int, size: float) -> Recording:
    """Return a recording whose markers are off, besides, by a wave of each input that no calibration has, up to so many times their number [m]."""
    recording, _ = record(rows, labels=[f"s{k}" for k in range(len(rows))], truth=arm((4, 1, 1)), noise=1e-4, seed=seed)
    wave = np.sin(np.pi * recording.inputs[recording.marker_frame][:, [0, 2]]) * (1.0 + recording.marker_index[:, None])
    off = size * np.column_stack([wave.sum(axis=1), -wave[:, 0], wave[:, 1]])
    return replace(recording, marker_xyz=recording.marker_xyz + off @ T_ROBOT_CAMERA[:3, :3])


def single_then_both(size: float, *, held: float = 1.0) -> tuple[Data, FittedModel]:
    """Return data of one cable at a time, with pairs held out, and the calibrated model; with `held` times the wave in the latter."""
    levels = np.linspace(0.2, 2.0, 7)
    single = np.concatenate([np.outer(levels, row) for row in np.eye(4)[[0, 2]]])
    both = np.array([[0.6, 0, 1.3, 0], [1.4, 0, 0.5, 0], [0.5, 0, 0.6, 0], [1.5, 0, 1.6, 0]])
    fitted_on, held_out = pulled(single, 0, size), pulled(both, 1, held * size)
    known = {"T_robot_camera": (T_ROBOT_CAMERA,)}
    data = prepare(arm((4, 1, 1)), [replace(fitted_on, **known)], [replace(held_out, **known)])
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)), max_iterations=3)


def test_what_single_inputs_leave_is_learned_and_carries_over_to_pairs() -> None:
    data, fitted = single_then_both(3e-4)
    found, again = judged_correction(data, fitted)
    assert found.accepted and found.kernel == SEPARATE
    assert found.validation_rms_after_m < 0.7 * found.validation_rms_before_m
    assert again is not None and again.marker_names == data.robot.glued_names and again.terms == found.terms
    learned = learn_correction(data, fitted)
    assert learned is not None
    for a, b in zip(rows_of(learned, data.held[0]), rows_of(again, data.held[0])):
        np.testing.assert_allclose(a, b)
    assert 0.0 < again.shifts(np.array([[1.0, 0.0, 0.0, 0.0]]))[1][0] < 1e-3 and again.input_names == NAMES
    assert 0.5e-4 < again.noise < 2e-4 and again.control == "tension"


def test_mere_noise_is_no_correction_and_one_that_does_not_help_is_refused() -> None:
    assert not judged_correction(*single_then_both(0.0))[0].accepted
    found, learned = judged_correction(*single_then_both(3e-4, held=-1.0))
    assert not found.accepted and learned is None and found.validation_rms_after_m > found.validation_rms_before_m
    assert "not predicted significantly better" in found.verdict


def test_what_calibration_can_move_is_left_to_calibration() -> None:
    data, fitted = single_then_both(0.0)
    moved = [
        replace(j, residual=j.residual + 2e-3 * j.by_effect[:, :, 0] / rms_of([j.by_effect[:, :, 0]])) for j in fitted.fit.jets
    ]
    assert rms_of([j.residual for j in moved]) == pytest.approx(2e-3, rel=0.1)
    assert learn_correction(data, replace(fitted, fit=replace(fitted.fit, jets=moved))) is None
