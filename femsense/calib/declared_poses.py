"""Check of declared camera poses against poses fitted to the same data."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.checks import EXPLAINED, SUSPICIOUS, Pairs, rigid_rms
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, transform_points
from femsense.model.recording import Recording

TRIED = 1.5
"""A pose is fitted where it could take a third of the residual away, inputs as they are; and spoken of where it does."""
DECLARED_STD = np.repeat([np.radians(0.5), 1e-3], 3)
"""Prior standard deviation of a declared pose when clouds are fitted: rotation [rad] and translation [m] along each axis
(trial: docs/appendix/forces-before-0.2.md)."""
Fitted = tuple[float, Sequence[FloatArray]]
"""Residual [m], and the poses."""


def check_declared_poses(
    recording: Recording, poses: Sequence[FloatArray], pairs: Sequence[Pairs], refit: Callable[[Recording], Fitted]
) -> None:
    """Refuse a declared pose if a fitted one reduces the residual to a quarter. Model error does not reduce it that far: with half to
    three times the true modulus, a fitted pose of the arm of the tests halves it, since the sag is the same in all frames. If the
    residual falls by a third, a warning lists pose and model as possible causes.

    Arguments:
        recording: to be calibrated.
        poses: of the cameras, declared ones among them.
        pairs: the markers of each camera.
        refit: fits the same markers with other poses declared.

    Raises:
        DataError: states the difference of the two poses.
    """
    usable = [v for v, T in enumerate(recording.T_robot_camera) if T is not None and _tells(pairs[v])]
    found = [one for v in usable if (one := _fitted(recording, (v,), pairs, refit)) is not None]
    best = min(found, key=lambda one: one.left, default=None)
    together = _fitted(recording, tuple(usable), pairs, refit) if len(usable) > 1 else None
    if together is not None and (best is None or best.left > TRIED * together.left):
        best = together
    if best is None or best.before < TRIED * best.left:
        return
    text = said(
        recording, best.views, poses, best.poses, [pairs[v].modelled.mean(axis=0) for v in best.views], best.before, best.left
    )
    if best.before > max(EXPLAINED * best.left, SUSPICIOUS * max(pairs[v].spread for v in best.views)):
        raise DataError(text)
    warnings.warn(f"{text}. Or the model errs by as much: femsense improve", stacklevel=5)


@dataclass(frozen=True, eq=False, slots=True)
class _Fitted:
    """A fit with some declared poses free: that of one camera, or all of them, for a displaced base of the robot."""

    views: tuple[int, ...]
    before: float
    """Root mean square of their markers' distances as declared [m]."""
    left: float
    """The same of all markers, fitted [m]; the freedom of the poses is taken out."""
    poses: Sequence[FloatArray]


def _tells(one: Pairs) -> bool:
    return one.modelled.size >= 12 and len(np.unique(one.marker)) >= 3


def _fitted(
    recording: Recording, views: tuple[int, ...], pairs: Sequence[Pairs], refit: Callable[[Recording], Fitted]
) -> _Fitted | None:
    """Return the fit with some poses free; None if nothing suggests it, or it does not converge.

    With known inputs, a rigid motion of the markers shows whether the fit is worthwhile; fitted inputs absorb a part of that motion.
    """
    mine = [pairs[v] for v in views]
    counts = np.array([len(one.marker) for one in mine])
    before = _rms(counts, [np.sqrt(((one.measured - one.modelled) ** 2).sum(axis=1).mean()) for one in mine])
    rigid = _rms(counts, [rigid_rms(one.modelled, one.measured) for one in mine])
    if recording.actuation_zero != "unknown" and before < TRIED * rigid:
        return None
    opened = tuple(None if v in views else T for v, T in enumerate(recording.T_robot_camera))
    try:
        left, fitted = refit(replace(recording, T_robot_camera=opened))
    except DataError:
        return None
    rows = 3.0 * counts.sum()
    return _Fitted(views, before, float(np.sqrt(rows / (rows - 6.0 * len(views)))) * left, fitted)


def _rms(counts: IntArray, each: Sequence[float]) -> float:
    """Return the root mean square over all rows from the values of groups of given sizes."""
    return float(np.sqrt(counts @ np.square(each) / counts.sum()))


def said(
    recording: Recording,
    views: Sequence[int],
    declared: Sequence[FloatArray],
    fitted: Sequence[FloatArray],
    middles: Sequence[FloatArray],
    before: float,
    left: float,
) -> str:
    """Return a sentence with the difference between declared and fitted poses.

    Arguments:
        recording: with the names of the cameras.
        views: of the cameras.
        declared, fitted: T_robot_camera of all cameras, shape (4, 4) each.
        middles: point at which the translation is stated, one per view [m], shape (3,).
        before, left: residual with the declared and with the fitted poses [m].
    """
    names = [recording.camera_names[v] or "(only one)" for v in views]
    one = len(views) == 1
    off = "; ".join(
        f"{'the declared one' if one else f'that of {name}'} is {_apart(declared[v], fitted[v], middle)}"
        for v, name, middle in zip(views, names, middles)
    )
    which = f"the declared pose of camera {names[0]} leaves" if one else f"the declared poses of cameras {', '.join(names)} leave"
    return (
        f"{which} {1e3 * before:.3g} mm, {'one that is' if one else 'ones that are'} fitted {1e3 * left:.3g} mm: {off}. "
        f"Leave T_robot_camera out of recording.toml to have it fitted, or declare it in the robot's frame"
    )


def _apart(declared: FloatArray, fitted: FloatArray, middle: FloatArray) -> str:
    apart = declared @ invert_pose(fitted)
    turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(apart[:3, :3]) - 1.0), -1.0, 1.0)))
    shift = transform_points(apart, middle[None])[0] - middle
    along = ", ".join(f"{1e3 * x:.2g}" for x in shift)
    return f"turned by {turn:.2g}° and shifted by {1e3 * np.linalg.norm(shift):.3g} mm ({along}) at the body"
