"""Whether a pose that is declared can be that of the camera: a pose that is fitted to the same data tells how far it is off."""

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
"""What a declared pose may be off beside clouds: turn [rad] and shift [m] along each axis (docs/appendix/forces-before-0.2.md has the trial)."""
Fitted = tuple[float, Sequence[FloatArray]]
"""What is left [m], and the poses."""


def check_declared_poses(
    recording: Recording, poses: Sequence[FloatArray], pairs: Sequence[Pairs], refit: Callable[[Recording], Fitted]
) -> None:
    """Refuse a declared pose where one that is fitted leaves a quarter of the residual. What the model lacks does not: with a modulus
    of half to three times the true one, the arm of the tests leaves half, as it sags by the same in all frames. Where the fitted one
    leaves a third less, a warning names both, pose and model.

    Arguments:
        recording: as it is calibrated.
        poses: of the cameras, declared ones among them.
        pairs: the markers of each camera.
        refit: fits the same markers with other poses declared.

    Raises:
        DataError: says how far it is off.
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
    """What is left with some declared poses fitted: one camera's, or all, as where the robot's base is elsewhere."""

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
    """Return what is left with some poses fitted; None where nothing suggests it, or nothing fits.

    With inputs as they are a rigid motion tells whether it may be worth it; inputs that are fitted have taken up a part of it.
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
    """Return the root mean square over all rows of what it is in groups of so many."""
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
    """Return in words how far declared poses are from fitted ones.

    Arguments:
        recording: names the cameras.
        views: of the cameras.
        declared, fitted: T_robot_camera of all cameras, shape (4, 4) each.
        middles: where the shifts are told, one a view [m], shape (3,).
        before, left: residual with the ones and the others [m].
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
