"""Readings of the markers: left-handed axes, exchanged labels, and a scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from femsense.calib.marker_fit import MarkerFit
from femsense.calib.pose_search import search_poses
from femsense.calib.readings import AS_GOOD, EXPLAINED, REPORTED, SUSPICIOUS, Reading, first_order, share_with
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.model.as_it_is import evaluate_robot
from femsense.model.recording import Recording
from femsense.model.recording_checks import camera_text
from femsense.model.robot import Robot

LEFT_HANDED = "Camera frames are right-handed (x right, y down, z forward): change the sign of one axis"
UNNAMED = "Where names are not known, leave the column marker empty: the model names the markers"
MIRROR = np.array([-1.0, 1.0, 1.0])
FEWEST = 4
"""Fewer markers fit mirrored, scaled or under other names too."""
SEARCHED = 3
"""Frames by which true labels are sought, those with the most markers."""
KNOWN = 3.0
"""A scale is wrong if it differs from 1 by more than this number of standard deviations."""
UNIT = 1.5
"""A scale beyond this is no error of a calibration."""
STIFFER = 0.02
"""Relative step of the derivative with respect to the modulus."""


def cameras_of(fit: MarkerFit) -> list[tuple[int, ...]]:
    """Return each camera with enough markers, and all of them together where there are several."""
    scene = fit.scene
    each: list[tuple[int, ...]] = [(v,) for v in range(len(fit.poses)) if len(np.unique(scene.marker[fit.rows_of(v)])) >= FEWEST]
    return [*each, tuple(v for views in each for v in views)] if len(each) > 1 else each


def text_of(fit: MarkerFit, views: Sequence[int]) -> str:
    """Return " of camera …", or nothing where there is only one."""
    names = fit.scene.recording.camera_names
    return f" of camera {' and '.join(names[v] for v in views)}" if len(names) > 1 else ""


def opened(recording: Recording, views: Sequence[int]) -> Recording:
    """Return the recording with the poses of some cameras undeclared."""
    return replace(recording, T_robot_camera=tuple(None if v in views else T for v, T in enumerate(recording.T_robot_camera)))


def scaled(recording: Recording, views: Sequence[int], scale: float | FloatArray) -> Recording:
    """Return the recording with the markers of some cameras multiplied by a number, or each axis by one, shape (3,)."""
    rest = recording.rest
    if rest is not None:
        rest = replace(
            rest, positions=freeze(np.where(np.isin(rest.view, views)[:, None], rest.positions * scale, rest.positions))
        )
    mine, xyz = np.isin(recording.marker_view, views)[:, None], recording.marker_xyz
    return replace(recording, marker_xyz=freeze(np.where(mine, xyz * scale, xyz)), rest=rest)


def left_handed(fit: MarkerFit) -> Iterator[Reading]:
    """Yield readings in which one axis of the markers' coordinates is reversed (left-handed axes)."""
    for views in cameras_of(fit):
        mine, off = np.isin(fit.scene.view, views), np.linalg.norm(fit.jet.residual, axis=1)
        if any(np.median(off[fit.rows_of(v)]) < SUSPICIOUS * fit.spread_of(v) for v in views):
            continue  # most markers fit: some are outliers
        yield Reading(
            f"the axes of the markers{text_of(fit, views)} seem left-handed",
            share_with(fit, measured=np.where(mine[:, None], fit.measured * MIRROR, fit.measured)),
            scaled(opened(fit.scene.recording, views), views, MIRROR),
            advice=LEFT_HANDED,
            reported=EXPLAINED,
            refused=EXPLAINED,
        )


def exchanged_labels(fit: MarkerFit) -> Iterator[Reading]:
    """Yield readings with exchanged marker labels, the same exchange in all frames."""
    scene, labels, own = fit.scene, fit.robot.marker_names, np.arange(len(fit.robot.marker_names))
    places = np.array([fit.robot.markers.positions(fit.jet.states[k].positions) for k in scene.frames.tolist()])
    true = {views[0]: _true_names(fit, views[0], places) for views in cameras_of(fit) if len(views) == 1}
    for names in {tuple(names.tolist()): names for names in true.values() if (names != own).any()}.values():
        views = [v for v, others in true.items() if (others == names).all()]
        renamed = np.where(np.isin(scene.view, views), names[scene.marker], scene.marker)
        every = opened(with_robot_markers(fit.robot, scene.recording), views)
        index = np.where(np.isin(every.marker_view, views), names[every.marker_index], every.marker_index)
        rows = text_of(fit, views).replace(" of", ", in the rows of", 1)
        changed = ", ".join(f"{labels[i]} is {labels[j]}" for i, j in enumerate(names.tolist()) if i != j)
        yield Reading(
            f"the labels{text_of(fit, views)} seem swapped: {changed}",
            share_with(fit, modelled=places[np.searchsorted(scene.frames, scene.frame), renamed]),
            replace(every, marker_index=freeze(index, np.int64)),
            advice=f"Swap them in markers.csv{rows}. {UNNAMED}",
            parameters=int((names != own).sum()),
            reported=EXPLAINED,
            refused=EXPLAINED,
        )


def with_robot_markers(robot: Robot, recording: Recording) -> Recording:
    """Return the recording, all of whose markers are the robot's, with these in the robot's order."""
    number = np.array([robot.marker_names.index(name) for name in recording.marker_names], dtype=np.int64)
    return replace(recording, marker_names=robot.marker_names, marker_index=freeze(number[recording.marker_index], np.int64))


def _true_names(fit: MarkerFit, view: int, places: FloatArray) -> IntArray:
    """Return the marker that each label of a camera belongs to, shape (m,): of the poses that fit the points without their names about equally
    well, that under which the fewest labels change. `places` are the markers of the model in each frame [m], shape (f, m, 3)."""
    scene, measured, own = fit.scene, fit.measured, np.arange(places.shape[1])
    rows = [np.flatnonzero(fit.rows_of(view) & (scene.frame == k)) for k in scene.frames]
    used = sorted(range(len(rows)), key=lambda i: -len(rows[i]))[:SEARCHED]
    try:
        found = search_poses([places[i] for i in used], [measured[rows[i]] for i in used], rng=np.random.default_rng(0))
    except DataError:
        return own
    likely = []
    for one in (one for one in found if one.error_m < AS_GOOD * found[0].error_m):
        votes = 1e-3 * np.eye(len(own))
        for i, names in zip(used, one.marker):
            np.add.at(votes, (scene.marker[rows[i]][names >= 0], names[names >= 0]), 1.0)
        likely.append(linear_sum_assignment(-votes)[1])
    return min(likely, key=lambda names: int((names != own).sum()))


def marker_scale(fit: MarkerFit) -> Iterator[Reading]:
    """Yield markers that are all too large by one number, per camera or for all together, fitted together with all poses, the initial inputs and
    the modulus, with which fitted inputs are collinear.

    A motion capture calibrated with a wand of another length, or a camera with a relative depth error, scales all its measurements. Declared
    poses are free too, because a scale about the camera shifts the body like a wrong pose.
    """
    if len(fit.scene.frames) < 2:
        return
    turns = np.stack([T[:3, :3] for T in fit.poses])[fit.scene.view]
    beside = fit.jet.by_pose
    for views in cameras_of(fit):
        mine = np.isin(fit.scene.view, views)
        column = -np.einsum("kij,kj->ki", turns, mine[:, None] * fit.scene.points)[:, :, None]
        if first_order(fit, column, beside=beside).share * REPORTED > 1.0:
            continue
        if beside is fit.jet.by_pose:
            beside = np.concatenate([beside, _by_modulus(fit)], axis=2)
        found = first_order(fit, column, beside=beside)
        scale, std = 1.0 / (1.0 - found.value[0]), found.std[0] / (1.0 - found.value[0]) ** 2
        if abs(scale - 1.0) < KNOWN * std or scale <= 0.0:
            continue
        which = "all cameras" if len(views) > 1 else camera_text(fit.scene.recording.camera_names[views[0]])
        yield Reading(
            f"the markers of {which} are {scale:.3f} ± {std:.1g} times too large",
            found.share,
            scaled(fit.scene.recording, views, 1.0 / scale),
            advice="Is the scale of the motion capture or of the camera's depth right, and the size of the robot's mesh?",
            parameters=1,
            refused=EXPLAINED if max(scale, 1.0 / scale) > UNIT else np.inf,
        )


def _by_modulus(fit: MarkerFit) -> FloatArray:
    """Return how the residual changes with the logarithm of the modulus [m], shape (k, 3, 1)."""
    stiffer = replace(fit.robot, body=fit.robot.body.with_stiffness_scale(1.0 + STIFFER))
    there = evaluate_robot(stiffer, fit.scene, fit.poses, fit.initial, dict(fit.jet.states))
    return np.asarray((there.residual - fit.jet.residual) / STIFFER)[:, :, None]
