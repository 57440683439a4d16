"""Labels that are swapped in single frames, and outliers: corrected or left out, with a warning."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.optimize import linear_sum_assignment

from femsense.calib.marker_fit import MarkerFit, root_mean_square
from femsense.calib.marker_readings import UNNAMED, with_robot_markers
from femsense.calib.readings import EXPLAINED
from femsense.core.arrays import BoolArray, FloatArray, IntArray, rows_alike
from femsense.core.errors import DataError
from femsense.model.observation import Scene
from femsense.model.recording import Recording, with_marker_table
from femsense.model.robot import Robot

OUTLIER = 0.1
"""An outlier is off by this share of the markers' spread at least. No measurement set it; on a real tendon robot one marker was
named for it, which may be the model's error."""


def true_labels(places: FloatArray, measured: FloatArray, marker: IntArray, *, noise: float) -> IntArray:
    """Correct swapped marker labels in one frame of one camera.

    Measured points are assigned to modelled markers by the smallest sum of squared distances (Hungarian algorithm, Kuhn 1955). The assignment
    replaces the labels if, for the markers with a new label,

    1. the root mean square distance falls by more than the factor EXPLAINED, and
    2. with the recorded labels it exceeds ten times the noise.

    Arguments:
        places: modelled positions of all markers [m], shape (m, 3).
        measured: measured points, in the same coordinate system [m], shape (k, 3).
        marker: recorded label of each point, an index into `places`, shape (k,).
        noise: standard deviation of a marker along each axis [m].

    Returns:
        the corrected labels, shape (k,).
    """
    if len(marker) < 2:
        return marker
    squares = ((measured[:, None] - places[None]) ** 2).sum(axis=2)
    rows, columns = linear_sum_assignment(squares)
    best = marker.copy()
    best[rows] = columns
    changed = best != marker
    if not changed.any() or len(np.unique(best)) < len(best):
        return marker
    before = np.sqrt(squares[changed, marker[changed]].mean())
    after = np.sqrt(squares[changed, best[changed]].mean())
    return best if after * EXPLAINED < before and before > 10.0 * noise else marker


def relabelled(fit: MarkerFit, *, strict: bool = True) -> Recording | None:
    """Return the recording with swapped labels corrected and outliers removed in the scene's frames, each listed in a warning; None where
    nothing changes.

    Arguments:
        fit: fit with the marker names in the files.
        strict: refuse labels that are swapped in most frames, but not in all.

    Raises:
        DataError: labels that seem swapped in most frames: the correct ones cannot be identified.
    """
    robot, scene, modelled, measured = fit.robot, fit.scene, fit.modelled, fit.measured
    marker, far, noise = (
        scene.marker.copy(),
        np.zeros(len(scene.marker), dtype=np.bool_),
        root_mean_square(fit.jet.residual) / 60.0,
    )
    for mine in rows_alike(scene.view, scene.frame):
        places = np.full((len(robot.marker_names), 3), 1e3)  # those that the camera does not see are far away
        places[scene.marker[mine]] = modelled[mine]
        marker[mine] = true_labels(places, measured[mine], scene.marker[mine], noise=noise)
        far[mine] = _outliers(np.linalg.norm(fit.jet.residual[mine], axis=1), fit.spread_of(scene.view[mine[0]]))
    renamed = marker != scene.marker
    swapped = len(np.unique(scene.frame[renamed]))
    if swapped > 0.5 * len(scene.frames):  # a swap in all frames is one of the whole recording
        if strict and swapped < len(scene.frames):
            names = " and ".join(robot.marker_names[m] for m in np.unique(scene.marker[renamed]))
            raise DataError(
                f"the labels of {names} seem swapped in {swapped} of {len(scene.frames)} frames. Make them the same in all frames of markers.csv. {UNNAMED}"
            )
        return None
    far &= ~renamed & ~_mostly(far, scene.marker)
    if not (far | renamed).any():
        return None
    _say(robot, scene, renamed, far)
    return _rewritten(fit, marker, ~far)


def _mostly(far: BoolArray, marker: IntArray) -> BoolArray:
    """Return which rows are of a marker that is far in most frames, shape (k,): it sits elsewhere than declared,
    which is no outlier."""
    total = np.bincount(marker, minlength=int(marker.max(initial=0)) + 1)
    return np.asarray((np.bincount(marker[far], minlength=len(total)) > 0.5 * total)[marker])


def _say(robot: Robot, scene: Scene, renamed: BoolArray, far: BoolArray) -> None:
    """Warn of corrected labels and removed outliers, frame by frame."""
    texts, frames = [], np.unique(scene.frame[renamed | far])
    for k in frames[:6]:
        parts = []
        for rows, what in ((renamed, "labels were swapped, and are corrected"), (far, "outliers, left out")):
            names = ", ".join(robot.marker_names[m] for m in scene.marker[rows & (scene.frame == k)])
            parts += [f"{names} ({what})"] if names else []
        texts.append(f"frame {int(scene.recording.frame_numbers[k])}: {', '.join(parts)}")
    text = "; ".join(texts) + (f"; and {len(frames) - 6} frames more" if len(frames) > 6 else "")
    warnings.warn(f"{scene.recording.folder or 'the recording'}: {text}", stacklevel=5)


def _outliers(off: FloatArray, spread: float) -> BoolArray:
    """Return which markers of one frame, shape (k,), have a large residual [m] while most others have a small one.

    In the sorted residuals, outliers follow a jump by the factor EXPLAINED within the upper two fifths. Model errors grow along the body
    without such a jump.
    """
    order = np.argsort(off)
    first = max(int(np.ceil(0.6 * len(off))), 3)
    jumps = [i for i in range(first, len(off)) if off[order[i]] > max(EXPLAINED * off[order[i - 1]], OUTLIER * spread)]
    far = np.zeros(len(off), dtype=np.bool_)
    far[order[jumps[0] :] if jumps else []] = True
    return far


def _rewritten(fit: MarkerFit, marker: IntArray, kept: BoolArray) -> Recording:
    """Return the recording whose rows in the scene's frames have other names, or are gone."""
    r = with_robot_markers(fit.robot, fit.scene.recording)
    own = np.isin(r.marker_frame, fit.scene.frames)  # the rows of the scene, in its order
    index, left = r.marker_index.copy(), np.ones(len(own), dtype=np.bool_)
    index[own], left[own] = marker, kept
    return with_marker_table(r, r.marker_names, r.marker_frame[left], index[left], r.marker_xyz[left], view=r.marker_view[left])
