"""Gain and offset of a single cable's input, fitted together with the poses and a common gain of all cables.

Each cable in turn, to first order about the calibration. Model errors, above all of the modulus, scale all cables equally, so the common
gain is fitted too. With two cables, one that is too weak looks like the other one too strong: each cable that explains much is corrected
and refitted, and the smallest residual decides. Standard errors alone would report model error as a wrong input (0.985 ± 0.003 for a gain
of 1 on the arm of the tests).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.other_readings import TOLD, Refit
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.model.observation import Hypothesis, Scene, evaluate_scene
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@dataclass(frozen=True, eq=False, slots=True)
class SingleInput:
    """The gain and offset of one cable's input that fit the markers best."""

    cable: int
    """Index of the cable."""
    offset: float
    """Added to the values of frames.csv times the gain [N] or [m]."""
    offset_std: float
    gain: float
    """[1]; 1 where only one cable moves, as a modulus then does the same."""
    gain_std: float
    share: float
    """Residual with it and the common gain, as a fraction of the residual with poses alone [1]."""

    @property
    def is_off(self) -> bool:
        """Whether offset or gain are farther than three standard deviations from 0 and 1."""
        return abs(self.offset) > 3.0 * self.offset_std or abs(self.gain - 1.0) > 3.0 * self.gain_std

    def read(self, inputs: FloatArray) -> FloatArray:
        """Return the inputs [N] or [m], shape (F, a), as they would have to be read."""
        better = inputs.copy()
        better[:, self.cable] = self.gain * inputs[:, self.cable] + self.offset
        return better


def check_single_inputs(
    robot: Robot,
    scene: Scene,
    poses: Sequence[FloatArray],
    residual: FloatArray,
    states: dict[int, Equilibrium],
    refit: Refit,
    *,
    said: float = np.inf,
) -> None:
    """Warn if the markers fit far better with another gain and offset of one cable's input.

    Arguments:
        robot: the robot.
        scene: the fitted markers; the zero of the inputs is known.
        poses: as fitted, each (4, 4).
        residual: of the fit [m], shape (k, 3).
        states: the equilibrium of each frame.
        refit: fits another reading.
        said: residual of an alternative reading that was reported already [m].
    """
    recording, before = scene.recording, _rms(residual)
    left, best = np.inf, None
    for one in single_inputs(robot, scene, poses, states):
        if one.share * TOLD > 1.0 or not one.is_off:
            continue
        better = replace(recording, inputs=freeze(one.read(recording.inputs)))
        try:
            left, best = min((left, best), (_rms(refit(robot, better, scene.frames)), one), key=lambda pair: pair[0])
        except DataError:
            continue
    if best is not None and before > TOLD * left and left < said:
        warnings.warn(_text(recording, robot.body.cable_names[best.cable], best, before, left), stacklevel=5)


def single_inputs(robot: Robot, scene: Scene, poses: Sequence[FloatArray], states: dict[int, Equilibrium]) -> list[SingleInput]:
    """Return the best gain and offset of each cable that moves; empty if there are too few frames.

    Arguments:
        robot, scene, poses, states: as of `check_single_inputs`.
    """
    moving = np.flatnonzero(np.ptp(scene.recording.inputs[scene.frames], axis=0) > 0.0)
    if len(scene.frames) < 4 or not len(moving):
        return []
    jet = evaluate_scene(
        Hypothesis(robot),
        scene,
        np.zeros(0),
        poses,
        None,
        derivative=True,
        vary_initial=True,
        pivot=robot.marker_points.mean(axis=0),
        starts=dict(states),
    )
    by_offset = jet.by_initial.reshape(-1, jet.by_initial.shape[2])
    by_gain = (jet.by_initial * scene.recording.inputs[scene.frame][:, None, :]).reshape(by_offset.shape)
    free = [c for v, T in enumerate(scene.recording.T_robot_camera) if T is None for c in range(6 * v, 6 * v + 6)]
    by_pose, frame = jet.by_pose[:, :, free].reshape(len(by_offset), -1), np.repeat(scene.frame, 3)
    common = np.column_stack([by_pose, by_gain.sum(axis=1)])
    plain = float(np.linalg.norm(fit_by_frames(by_pose, jet.residual.ravel(), frame)[2]))
    found = []
    for j in moving.tolist():
        own = by_offset[:, [j]] if len(moving) == 1 else np.column_stack([by_offset[:, j], by_gain[:, j]])
        x, std, left = fit_by_frames(np.column_stack([common, own]), jet.residual.ravel(), frame)
        p = common.shape[1]
        gain, gain_std = (1.0, 0.0) if len(moving) == 1 else (1.0 + float(x[p + 1]), float(std[p + 1]))
        share = float(np.linalg.norm(left)) / max(plain, 1e-300)
        found.append(SingleInput(j, float(x[p]), float(std[p]), gain, gain_std, share))
    return found


def fit_by_frames(J: FloatArray, residual: FloatArray, frame: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the least-squares step for a residual (r,), its standard errors, and the remaining residual.

    Standard errors are clustered by frame (Liang and Zeger 1986), because the model error is correlated between its markers.
    """
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    A = J / size
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-10)
    x = -inverse @ (A.T @ residual)
    left = residual + A @ x
    _, group = np.unique(frame, return_inverse=True)
    scores = np.zeros((int(group.max()) + 1, A.shape[1]))
    np.add.at(scores, group, A * left[:, None])
    frames = len(scores)
    covariance = inverse @ (scores.T @ scores) @ inverse * frames / max(frames - 1, 1)
    return x / size, np.sqrt(np.maximum(np.diag(covariance), 0.0)) / size, left


def _text(recording: Recording, name: str, best: SingleInput, before: float, left: float) -> str:
    unit, scale = ("N", 1.0) if recording.actuation == "tension" else ("mm", 1e3)
    offset = f"plus {scale * best.offset:.2g} ± {scale * best.offset_std:.1g} {unit}"
    gain = f"times {best.gain:.3g} ± {best.gain_std:.1g}, " if best.gain_std else ""
    return (
        f"the input of {name} alone seems off: {gain}{offset}, the markers fit to {1e3 * left:.3g} mm instead of "
        f"{1e3 * before:.3g} mm. Is its sensor calibrated, the cable slack or caught?"
    )


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt((residual**2).sum(axis=1).mean()))
