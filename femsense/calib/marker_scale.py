"""Scale error of the markers of a camera, fitted together with poses and initial inputs.

A motion capture calibrated with a wand of another length, or a camera with a relative depth error, scales all its measurements. Poses and
inputs absorb a part of that, and the rest looks like model error. The scale is fitted to first order about the calibration, together with
the modulus, with which fitted inputs are collinear; the residual of a refit then decides.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.joint import root_mean_square
from femsense.calib.other_readings import TOLD, Refit
from femsense.calib.single_inputs import fit_by_frames
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.model.observation import Hypothesis, Scene, SceneJet, evaluate_scene
from femsense.model.recording import Recording
from femsense.model.robot import Robot

KNOWN = 3.0
"""A scale is wrong if it differs from 1 by more than this number of standard deviations."""
STIFFER = 0.02
"""Relative step of the derivative with respect to the modulus."""
MARKERS, FRAMES = 4, 2
"""Least number of markers and of frames."""


@dataclass(frozen=True, eq=False, slots=True)
class MarkerScale:
    """The scale of the markers of a camera, measured over true."""

    scale: float
    """[1]."""
    std: float
    """Clustered by frame [1]."""
    share: float
    """Residual with the scale, as a fraction of that with poses, initial inputs and further parameters alone [1]."""


def check_marker_scale(
    robot: Robot, scene: Scene, poses: Sequence[FloatArray], initial: FloatArray | None, jet: SceneJet, refit: Refit
) -> None:
    """Warn where the markers of a camera fit far better once they are divided by one number, and another modulus does not do the same.

    Arguments:
        robot: the robot.
        scene: the markers that were fitted.
        poses: as fitted, each (4, 4).
        initial: fitted initial inputs [N] or [m], shape (a,); None where they are known.
        jet: where the fit ended, with derivatives.
        refit: fits another reading.
    """
    before, names = root_mean_square(jet.residual), scene.recording.camera_names
    found: list[tuple[float, MarkerScale, tuple[int, ...]]] = []
    for views in [*((v,) for v in range(len(names))), *([tuple(range(len(names)))] if len(names) > 1 else [])]:
        best = marker_scale(scene, poses, jet, views)
        if not _tells(best):
            continue
        best = marker_scale(scene, poses, jet, views, by_modulus(robot, scene, poses, initial, jet))
        if best is None or not _tells(best):
            continue
        try:
            found.append(
                (root_mean_square(refit(robot, scaled(scene.recording, views, 1.0 / best.scale), scene.frames)), best, views)
            )
        except DataError:
            continue
    left, best, views = min(found, key=lambda one: one[0], default=(before, None, ()))
    if best is not None and before > TOLD * left:
        which = f"camera {names[views[0]] or '(only one)'}" if len(views) == 1 else "all cameras"
        warnings.warn(_text(which, best, before, left), stacklevel=5)


def _tells(found: MarkerScale | None) -> bool:
    return found is not None and found.share * TOLD < 1.0 and abs(found.scale - 1.0) > KNOWN * found.std


def marker_scale(
    scene: Scene, poses: Sequence[FloatArray], jet: SceneJet, views: Sequence[int], beside: FloatArray | None = None
) -> MarkerScale | None:
    """Return the scale of the markers of some cameras; None if there are too few. Declared poses are free too, because a scale about the
    camera shifts the body like a wrong pose.

    Arguments:
        scene, poses, jet: as of `check_marker_scale`.
        views: the cameras; all of them for a single motion capture.
        beside: further parameters, as the derivative of the residual, shape (k, 3).
    """
    mine = np.isin(scene.view, views)
    if len(np.unique(scene.marker[mine])) < MARKERS or len(np.unique(scene.frame[mine])) < FRAMES:
        return None
    rows, frame, residual = jet.residual.size, np.repeat(scene.frame, 3), jet.residual.ravel()
    common = np.hstack([jet.by_pose.reshape(rows, -1), jet.by_initial.reshape(rows, -1)])
    if beside is not None:
        common = np.column_stack([common, beside.ravel()])
    turns = np.stack([T[:3, :3] for T in poses])[scene.view]
    by_scale = -np.einsum("kij,kj->ki", turns, mine[:, None] * scene.points)
    plain = fit_by_frames(common, residual, frame)[2]
    x, std, left = fit_by_frames(np.column_stack([common, by_scale.ravel()]), residual, frame)
    share = float(np.linalg.norm(left)) / max(float(np.linalg.norm(plain)), 1e-300)
    return MarkerScale(1.0 + float(x[-1]), float(std[-1]), share)


def by_modulus(robot: Robot, scene: Scene, poses: Sequence[FloatArray], initial: FloatArray | None, jet: SceneJet) -> FloatArray:
    """Return how the residual changes with the logarithm of the modulus [m], shape (k, 3)."""
    stiffer = replace(robot, body=robot.body.with_stiffness_scale(1.0 + STIFFER))
    there = evaluate_scene(
        Hypothesis(stiffer),
        scene,
        np.zeros(0),
        poses,
        initial,
        derivative=False,
        vary_initial=False,
        pivot=robot.marker_points.mean(axis=0),
        starts=dict(jet.states),
    )
    return np.asarray((there.residual - jet.residual) / STIFFER)


def scaled(recording: Recording, views: Sequence[int], scale: float) -> Recording:
    """Return the recording with the markers of some cameras scaled about these."""
    factor = np.where(np.isin(recording.marker_view, views), scale, 1.0)[:, None]
    rest = recording.rest
    if rest is not None:
        rest = replace(rest, positions=freeze(rest.positions * np.where(np.isin(rest.view, views), scale, 1.0)[:, None]))
    return replace(recording, marker_xyz=freeze(recording.marker_xyz * factor), rest=rest)


def _text(which: str, best: MarkerScale, before: float, left: float) -> str:
    return (
        f"the markers of {which} are {best.scale:.3f} ± {best.std:.1g} times too large: divided by that they fit to "
        f"{1e3 * left:.3g} mm instead of {1e3 * before:.3g} mm. Is the scale of the motion capture or of the camera's depth right, "
        f"and the size of the robot's mesh?"
    )
