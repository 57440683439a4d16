"""The hypothesis that a camera, or the base of the robot, has moved: its J against that of the contacts.

The pose prior of every camera is widened to FAR, and inferred contacts are removed. Rays are recomputed from the new pose. The pixels of
the static background are rows of both hypotheses: they do not move before a camera at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import FemsenseError
from femsense.core.pose import moved_poses
from femsense.inference.mixture import misfit
from femsense.inference.nuisance import root_of
from femsense.sensing.fit import fit
from femsense.sensing.model import Fit, Frame, Model
from femsense.sensing.pose_rows import background_rows, cost_of_moving, far, pose_gain
from femsense.sensing.status import Status, Verdict, verdict
from femsense.sensing.types import Touch

MOVED = 2.0 * np.log(1000.0)
"""L of a moved camera: one in 1000 frames."""
EQUAL = 16.3
"""Hypotheses whose J differs by less are equally plausible: χ² with three degrees of freedom, exceeded once in 1000."""
LEAST_MM, LEAST_DEG = 0.05, 0.05
"""Smallest motion that is reported: poses are not known better."""
CLEAR = 2.0
"""A moved camera is fitted only if its J to first order is higher by at most this multiple of EQUAL."""
FAILED = (Status.NOT_EXPLAINED, Status.LARGE_ERROR_FIELD, Status.BEHIND_BODY, Status.OVERLAP, Status.SQUEEZED)
"""Statuses of frames that a moved camera may explain."""
STEPS, FIRST, STILL = 8, 1, 1e-3
"""Maximum number of pose steps, number of steps before the search may be abandoned, and the share of FAR below which a step is the last."""


@dataclass(frozen=True, eq=False, slots=True)
class Moved:
    """A frame, fitted with moved cameras."""

    step: FloatArray
    """(rotation about the pivot [rad], shift [m]) of all poses, shape (6 v,)."""
    criterion: float
    """J, including L of the motion."""


def camera_verdict(model: Model, best: Fit, found: Verdict) -> Verdict:
    """Return the verdict of a frame: the given one, or that a moved camera fits as well as its inferred contacts, or better than its
    contacts.

    The hypothesis is fitted in frames with inferred contacts, in frames that fail the posterior check, and if the linearised evidence of a
    pose step exceeds its prior odds.
    """
    if best.frame.pixels is None or len(model.sensor.places):
        return found
    inferred = [i for i, contact in enumerate(best.contacts) if contact.source == "shape"]
    failed = found.status in FAILED
    if not failed and _stands(model, best, inferred):
        return found
    try:
        stood = _stood(model, best)
        bound = np.inf if stood is None else stood + (EQUAL if inferred else 0.0)
        moved = moved_cameras(model, best, bound)
    except (FemsenseError, np.linalg.LinAlgError):
        return found
    if stood is None or moved is None:
        return found
    numbers = _in_words(model, moved)
    if moved.criterion > bound or (numbers["shift_mm"] < LEAST_MM and numbers["turn_deg"] < LEAST_DEG):
        return found
    shown = _misfit_of_background(model, best) - _misfit_of_background(_at(model, moved.step), best) > EQUAL
    return verdict(Status.CAMERA_MOVED if shown else Status.CAMERA_MAY_HAVE_MOVED, **numbers)


def _stands(model: Model, best: Fit, inferred: Sequence[int]) -> bool:
    """Return whether, to first order, a camera at rest has a far lower J than a moved one."""
    if not inferred:
        return bool(pose_gain(model, best) < MOVED)
    odds = MOVED - float(best.odds[inferred].sum())
    return bool(cost_of_moving(model, best, inferred) + odds > CLEAR * EQUAL)


def moved_cameras(model: Model, best: Fit, bound: float = np.inf) -> Moved | None:
    """Return the poses that fit the frame best with its visible contacts only; None without an equilibrium.

    bound: J to be reached; the search is abandoned if J is far above it after FIRST steps.
    """
    visible = [i for i, contact in enumerate(best.contacts) if contact.source != "shape"]
    contacts, forces, tau = [best.contacts[i] for i in visible], best.forces[visible], best.tau[visible]
    step, found, lowest = np.zeros(6 * model.views), None, np.inf
    start = best.state if visible else best.frame.predicted
    for i in range(STEPS):
        there = _at(model, step)
        frame = _seen_from(there, best.frame)
        fitted = fit(there, frame, [_seen_at(model, there, contact) for contact in contacts], forces, start, tau=tau)
        if fitted is None:
            return found
        change = (there.nuisance.mean + there.nuisance.root @ fitted.eta[: there.nuisance.root.shape[1]])[: len(step)]
        if fitted.criterion < lowest:
            lowest = fitted.criterion
            found = Moved(step - change, lowest + MOVED)
        if np.abs(change / far(model)).max() < STILL or (i >= FIRST and lowest + MOVED > bound + EQUAL):
            break
        step, forces, tau, start = step - change, fitted.forces, fitted.tau, fitted.state
    return found


def _stood(model: Model, best: Fit) -> float | None:
    """Return J of the best hypothesis with cameras at rest, background included."""
    frame = replace(best.frame, objects=(), background=background_rows(model, best.frame))
    again = fit(model, frame, best.contacts, best.forces, best.state, tau=best.tau, linearised=best.linearised)
    return None if again is None else again.criterion


def _at(model: Model, step: FloatArray) -> Model:
    """Return the model with its cameras moved by a step, and a wide pose prior about there."""
    sensor, nuisance, v = model.sensor, model.nuisance, len(step)
    poses = tuple(freeze(T) for T in moved_poses(sensor.calibration.poses, step, sensor.pivot))
    mean = nuisance.mean.copy()
    mean[:v] += step
    covariance = nuisance.root @ nuisance.root.T + block_diag(np.diag(far(model) ** 2), np.zeros((len(mean) - v,) * 2))
    calibration = replace(sensor.calibration, poses=poses, T_robot_camera=poses[0])
    nuisance = replace(nuisance, mean=freeze(mean), root=freeze(root_of(covariance)))
    return replace(model, sensor=replace(sensor, calibration=calibration), nuisance=nuisance)


def _seen_from(model: Model, frame: Frame) -> Frame:
    assert frame.scan is not None
    return replace(frame, pixels=model.pixels(frame.scan), objects=(), background=background_rows(model, frame))


def _seen_at(model: Model, there: Model, contact: Touch) -> Touch:
    """Return a contact moved with its object, by the step of the camera that shows most of it."""
    if contact.shape is None:
        return contact
    view = int(np.argmax(contact.shape.seen_by))
    before, after = (one.sensor.calibration.poses[view] for one in (model, there))
    return replace(contact, shape=contact.shape.moved(after @ np.linalg.inv(before)))


def _misfit_of_background(model: Model, best: Fit) -> float:
    rows = background_rows(model, best.frame)
    return 0.0 if rows is None else misfit(rows.residual, rows.log_other, rows.share)[0]


def _in_words(model: Model, moved: Moved) -> dict[str, Any]:
    """Return the text for the camera with the largest motion."""
    steps = moved.step.reshape(-1, 6)
    farthest = int(np.argmax(np.linalg.norm(steps / np.repeat([1.0, model.sensor.size], 3), axis=1)))
    name = model.sensor.recording.camera_names[farthest]
    return {
        "who": f"camera {name}" if name else "the camera",
        "shift_mm": 1e3 * float(np.linalg.norm(steps[farthest, 3:])),
        "turn_deg": float(np.degrees(np.linalg.norm(steps[farthest, :3]))),
    }
