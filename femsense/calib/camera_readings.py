"""Readings of the cameras: a declared pose, a pose held by rest.csv, and a camera that moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.declared_poses import REMEDY, pose_error
from femsense.calib.marker_fit import MarkerFit, root_mean_square
from femsense.calib.marker_readings import opened
from femsense.calib.readings import EXPLAINED, Reading, first_order, rigid_misfit
from femsense.core.arrays import freeze
from femsense.model.recording import Recording
from femsense.model.recording_checks import camera_text

FRAMES, ROWS, MARKERS = 4, 4, 3
"""Least number of frames of a camera that may have moved, of its rows before and after, and of different markers for a pose."""
WIDE = 0.2
"""Markers closer together than this fraction of the body's diagonal move together under any error of the model, and show no moved camera."""


def declared_pose(fit: MarkerFit) -> Iterator[Reading]:
    """Yield readings in which a declared pose is fitted: that of one camera, or those of all, which detects a displaced base of the robot."""
    recording = fit.scene.recording
    views = [v for v, T in enumerate(recording.T_robot_camera) if T is not None and _shows_pose(fit, v)]
    for free in [*((v,) for v in views), *([tuple(views)] if len(views) > 1 else [])]:
        columns = [c for v in free for c in range(6 * v, 6 * v + 6)]
        yield Reading(
            lambda other, free=free: pose_error(  # type: ignore[misc]
                recording, free, fit.poses, other.poses, [fit.modelled[fit.rows_of(v)].mean(axis=0) for v in free]
            ),
            min(_rigid_share(fit, free), first_order(fit, fit.jet.by_pose[:, :, columns]).share),
            opened(recording, free),
            advice=REMEDY,
            parameters=len(columns),
            refused=EXPLAINED,
        )


def _shows_pose(fit: MarkerFit, view: int) -> bool:
    mine = fit.scene.marker[fit.rows_of(view)]
    return len(mine) >= ROWS and len(np.unique(mine)) >= MARKERS


def _rigid_share(fit: MarkerFit, free: Sequence[int]) -> float:
    """Return the misfit with rigidly moved markers of some cameras, as a fraction of the current one."""
    view, residual = fit.scene.view, fit.jet.residual
    mine = np.isin(view, free)
    moved = mine.sum() * rigid_misfit(view[mine], fit.modelled[mine], fit.measured[mine]) ** 2
    return float(np.sqrt((moved + (residual[~mine] ** 2).sum()) / max((residual**2).sum(), 1e-300)))


def pose_at_rest(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the files without rest.csv, which holds the pose elsewhere than the markers of the frames: more than their spread, since a clamp
    that gives moves these, too."""
    scene, left = fit.scene, root_mean_square(fit.jet.residual)
    if scene.recording.rest is not None and left > max(map(fit.spread_of, range(len(fit.poses)))):
        yield Reading(
            f"rest.csv puts the robot elsewhere than the markers of the frames, which lie {1e3 * left:.3g} mm off",
            rigid_misfit(scene.view, fit.modelled, fit.measured) / max(left, 1e-300),
            replace(scene.recording, rest=None),
            advice="Are both in the frame of the same camera, which did not move in between?",
            reported=EXPLAINED,
            refused=EXPLAINED,
        )


def moved_camera(fit: MarkerFit) -> Iterator[Reading]:
    """Yield the reading in which a camera moved between two frames: those at which a second pose reduces the misfit most."""
    scene, recording = fit.scene, fit.scene.recording
    diagonal = float(np.linalg.norm(np.ptp(fit.robot.body.mesh.nodes, axis=0)))
    for v, name in enumerate(recording.camera_names):
        frames = np.unique(scene.frame[fit.rows_of(v)])
        if len(frames) < FRAMES or fit.spread_of(v) < WIDE * diagonal:
            continue
        plain = rigid_misfit(scene.view, fit.modelled, fit.measured)
        left, split = min((_split_misfit(fit, v, k), k) for k in frames[1:].tolist())
        before, after = (int(recording.frame_numbers[k]) for k in (frames[frames < split].max(), split))
        yield Reading(
            f"{camera_text(name)} or the robot's base seems to have moved between frames {before} and {after}",
            left / max(plain, 1e-300),
            _split(recording, v, split),
            advice="Calibrate the frames of one pose: make two recordings of it. If something touches the robot in frames that the column free marks "
            "with 1, write 0 there.",
            parameters=6,
            reported=EXPLAINED,
            refused=EXPLAINED,
        )


def _split_misfit(fit: MarkerFit, view: int, frame: int) -> float:
    """Return the misfit [m] with another pose of a camera from a frame on; infinite where few markers are left to one of them."""
    later = fit.rows_of(view) & (fit.scene.frame >= frame)
    if min(later.sum(), (fit.rows_of(view) & ~later).sum()) < ROWS:
        return np.inf
    return rigid_misfit(np.where(later, len(fit.poses), fit.scene.view), fit.modelled, fit.measured)


def _split(recording: Recording, view: int, frame: int) -> Recording:
    """Return the recording with a further camera, which sees what one saw from a frame on; neither has a declared pose."""
    r = opened(recording, [view])
    later = (r.marker_view == view) & (r.marker_frame >= frame)
    return replace(
        r,
        camera_names=(*r.camera_names, f"{r.camera_names[view]} from frame {int(r.frame_numbers[frame])}"),
        cameras=(*r.cameras, r.cameras[view]),
        T_robot_camera=(*r.T_robot_camera, None),
        marker_view=freeze(np.where(later, len(r.camera_names), r.marker_view), np.int64),
    )
