"""Tables of the report on calibration: poses, initial inputs and nuisance effects by model, and the frames that are not used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from femsense.calib.calibrate import usable_frames
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.surface_rows import cloud_frames
from femsense.loop.data.trial import heads_of
from femsense.loop.fit.fitted_model import FittedModel, terms_of
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.result.evidence import CalibrationShift, InputShift, PoseShift, TermShift
from femsense.loop.result.tables import Vector
from femsense.model.recording import Recording


def calibration_shift(data: Data, models: Mapping[str, FittedModel]) -> CalibrationShift:
    """Return poses, initial inputs and nuisance effects of each model; poses relative to the first model."""
    poses, inputs, at = list[PoseShift](), list[InputShift](), 0
    for i, trial in enumerate(data.train[j] for j in heads_of(data.train)):
        poses += [_pose_shift(models, i, v, at + 6 * v) for v in range(len(trial.poses))]
        cables = data.robot.body.cable_names if trial.initial is not None else ()
        unit = "N" if data.control == "tension" else "m"
        for j, cable in enumerate(cables):
            inputs.append(InputShift(i, cable, unit, _input_values(models, at + 6 * len(trial.poses) + j)))
        at += trial.size
    return CalibrationShift(tuple(poses), tuple(inputs), tuple(_terms(models)))


def _pose_shift(models: Mapping[str, FittedModel], recording: int, camera: int, at: int) -> PoseShift:
    """Return the change of the pose whose six parameters begin at index `at`."""
    first, *others = models
    part = slice(at, at + 6)
    zero = models[first].fit.fit.theta[part]
    moved = {name: tuple((models[name].fit.fit.theta[part] - zero).tolist()) for name in others}
    std = {name: _deviations(fitted.fit, part) for name, fitted in models.items()}
    return PoseShift(
        recording,
        camera,
        turn_rad={name: m[:3] for name, m in moved.items()},
        shift_m={name: m[3:] for name, m in moved.items()},
        turn_std_rad={name: d[:3] for name, d in std.items()},
        shift_std_m={name: d[3:] for name, d in std.items()},
    )


def _input_values(models: Mapping[str, FittedModel], at: int) -> dict[str, Vector]:
    return {name: (float(s.fit.fit.theta[at]), *_deviations(s.fit, slice(at, at + 1))) for name, s in models.items()}


def _terms(models: Mapping[str, FittedModel]) -> list[TermShift]:
    """Return the nuisance values by model."""
    terms: dict[str, TermShift] = {}
    for name, fitted in models.items():
        for effect, _, parameters, span in terms_of(fitted.fit):
            for p, value, std in zip(parameters, fitted.fit.coordinates[span].tolist(), fitted.fit.std[span].tolist()):
                if effect.name in NUISANCE:
                    label = f"{effect.name}: {p.label}"
                    first = terms.get(label, TermShift(label, p.unit, p.value(p.null), {}))
                    terms[label] = replace(first, values={**first.values, name: (p.value(value), p.value_std(value, std))})
    return list(terms.values())


def _deviations(fit: JointFit, part: slice) -> Vector:
    return tuple(float(v) for v in np.sqrt(np.maximum(np.diag(fit.fit.covariance)[part], 0.0)))


def excluded(recording: Recording, data: Data) -> dict[str, tuple[int, ...]]:
    """Return the frames of a recording that are neither fitted nor held out, by reason."""
    used = {int(k) for t in [*data.train, *data.held] if t.scene.recording is recording for k in t.scene.frames}
    usable, marked = set(usable_frames(recording).tolist()), set(recording.marker_frame.tolist())
    if "clouds" in data.measured:
        marked |= set(cloud_frames(recording).tolist())
    reasons: dict[str, list[int]] = {}
    for k in range(len(recording.time_s)):
        if k in used:
            continue
        why = "in contact, load not declared" if k not in usable else "no markers" if k not in marked else "thinned out"
        reasons.setdefault(why, []).append(int(recording.frame_numbers[k]))
    return {why: tuple(frames) for why, frames in reasons.items()}
