"""Alternative readings of a recording's files, and the one comparison by which one of them is reported.

A reading is the same recording, or robot, with one thing read otherwise: labels exchanged, an axis reversed, inputs a frame later, a pose left
open. It is fitted like the files themselves, and its evidence is the reduced misfit of the same markers, s² = Σ r² / (3 k − p) with p fitted parameters.
The statistic is the ratio s₀ / s of the files to the reading. Errors of a model are common to many rows, so that a likelihood which counts rows as
independent would report each of them; the thresholds are ratios found on recordings of known truth instead. `other_readings` lists the readings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.marker_fit import MarkerFit
from femsense.calib.rigid import rigid_residual
from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.model.recording import Recording
from femsense.model.robot import Robot

SUSPICIOUS = 0.02
"""A misfit below this share of the markers' spread suggests no error in the files. The value was chosen, not calibrated: recordings of
the rig have smaller residuals, and a real tendon robot with an incomplete model 0.03 to 0.26; there readings are tried and do not fit better."""
REPORTED = 1.5
"""A reading is reported where it divides the misfit by this."""
REFUSED = 2.0
"""A reading without fitted parameters has the files refused where it divides the misfit by this. Gravity up: 2.3 on the finger, 2.4 on the arm; signs,
order and delay of inputs: 8 and more."""
EXPLAINED = 4.0
"""The same for a reading with fitted parameters, or chosen from many: with half to three times the true modulus, a fitted pose of the arm of the tests
divides the misfit by two, since the sag is the same in all frames."""
AS_GOOD = 1.2
"""Readings whose misfits differ by less than this factor are not distinguished: that with the fewest parameters is reported, and the others listed."""
MOST = 4
"""Readings that are fitted, those with the smallest predicted misfit."""


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """An alternative interpretation (reading) of the same files: a hypothesis about one error in them, such as exchanged labels."""

    error: str | Callable[[MarkerFit], str]
    """The error in the files if this reading is right, as a clause; or that of the reading's fit."""
    predicted: float = np.inf
    """Misfit to first order, as a fraction of the current one; readings above 1/`reported` are not fitted."""
    recording: Recording | None = None
    """The recording under this reading; None: unchanged. The same holds for the robot and the frames below."""
    robot: Robot | None = None
    frames: IntArray | None = None
    """Indices of the frames that it applies to, shape (f,)."""
    advice: str = ""
    """What to do, one sentence or more."""
    parameters: int = 0
    """How many numbers were fitted or chosen beyond those of the files."""
    reported: float = REPORTED
    """Ratio of misfits from which it is reported."""
    refused: float = REFUSED
    """Ratio of misfits from which the files are refused; infinite for what may be an error of the model instead."""


Reread = Callable[[MarkerFit], Iterator[Reading]]
"""Yields readings of one kind of the files of a fit."""
Refit = Callable[[Robot, Recording, IntArray], MarkerFit]
"""Fits a robot to frames of a recording. Raises DataError."""


@dataclass(frozen=True, eq=False, slots=True)
class _Compared:
    """An alternative reading of the files after its fit."""

    kind: Reread
    reading: Reading
    text: str
    left: float
    """Root mean square residual [m]."""
    before: float
    """That of the files, in the same frames [m]."""
    ratio: float
    """s / s₀, of the reading to the files [1]."""


def compare_readings(fit: MarkerFit, rereads: Sequence[Reread], refit: Refit, *, rivals: Sequence[Reread] = ()) -> None:
    """Compare the files with alternative readings (hypotheses about one error in them), and refuse or warn if one fits better.

    Arguments:
        fit: fit of the unchanged files.
        rereads: the kinds of readings.
        refit: fits another reading.
        rivals: further kinds, which compete where one of the first is promising.

    Raises:
        DataError: states the error in the files if the reading is right, and the misfits of both.
    """
    tried = _promising(fit, rereads)
    tried += _promising(fit, rivals) if tried else []
    fitted = [_compared(fit, *one, refit) for one in sorted(tried, key=lambda one: one[1].predicted)[:MOST]]
    better = [one for one in fitted if one is not None and one.ratio * one.reading.reported < 1.0]
    if not better:
        return
    alike = AS_GOOD * min(one.ratio for one in better)
    of_kind: dict[Reread, _Compared] = {}
    for one in sorted(better, key=lambda one: (one.reading.parameters, one.ratio)):
        if one.ratio <= alike:
            of_kind.setdefault(one.kind, one)
    best, *others = of_kind.values()
    text = f"{best.text}: the markers then fit to {1e3 * best.left:.3g} mm instead of {1e3 * best.before:.3g} mm."
    if best.reading.advice:
        text += f" {best.reading.advice}"
    if others:
        text += f" As good: {'; '.join(f'{one.text} ({1e3 * one.left:.3g} mm)' for one in others)}."
    if is_suspicious(fit) and all(one.ratio * one.reading.refused < 1.0 for one in (best, *others)):
        raise DataError(text)
    warnings.warn(f"{text} Or the model errs by as much: femsense improve", stacklevel=5)


def _promising(fit: MarkerFit, rereads: Sequence[Reread]) -> list[tuple[Reread, Reading]]:
    return [(kind, one) for kind in rereads for one in kind(fit) if one.predicted * one.reported < 1.0]


def _compared(fit: MarkerFit, kind: Reread, reading: Reading, refit: Refit) -> _Compared | None:
    """Return a reading with its evidence; None where it has no fit."""
    frames = fit.scene.frames if reading.frames is None else reading.frames
    try:
        other = refit(reading.robot or fit.robot, reading.recording or fit.scene.recording, frames)
    except DataError:
        return None
    residual, own = other.jet.residual, fit.jet.residual[np.isin(fit.scene.frame, frames)]
    p = len(fit.result.theta)
    reduced = [(r**2).sum() / max(r.size - q, 1e-9) for r, q in ((residual, p + reading.parameters), (own, p))]
    left, before = (float(np.sqrt((r**2).sum(axis=1).mean())) for r in (residual, own))
    text = reading.error if isinstance(reading.error, str) else reading.error(other)
    return _Compared(kind, reading, text, left, before, float(np.sqrt(reduced[0] / max(reduced[1], 1e-300))))


def is_suspicious(fit: MarkerFit) -> bool:
    """Return whether the residual of the markers of a camera exceeds the share `SUSPICIOUS` of their spread."""
    return any(fit.misfit_of(v) > SUSPICIOUS * fit.spread_of(v) for v in range(len(fit.poses)))


def rigid_misfit(view: IntArray, modelled: FloatArray, measured: FloatArray) -> float:
    """Return the root mean square residual [m] of markers, shape (k, 3) each, with a pose of its own for each camera (view, shape (k,))."""
    squares = sum(float((rigid_residual(modelled[view == v], measured[view == v]) ** 2).sum()) for v in np.unique(view))
    return float(np.sqrt(squares / max(len(view), 1)))


def share_with(
    fit: MarkerFit, *, modelled: FloatArray | None = None, measured: FloatArray | None = None, rows: BoolArray | None = None
) -> float:
    """Return the misfit of other markers as a fraction of the current one, both with free poses.

    Arguments:
        fit: fit of the unchanged files.
        modelled, measured: other places [m], robot frame, shape (k, 3).
        rows: which rows count, shape (k,); by default all.
    """
    rows = np.ones(len(fit.scene.view), dtype=np.bool_) if rows is None else rows
    own, seen = fit.modelled, fit.measured
    model, points = (own if modelled is None else modelled), (seen if measured is None else measured)
    view = fit.scene.view[rows]
    return rigid_misfit(view, model[rows], points[rows]) / max(rigid_misfit(view, own[rows], seen[rows]), 1e-300)


@dataclass(frozen=True, eq=False, slots=True)
class FirstOrder:
    """Result of `first_order`: further parameters of a fit, estimated to first order."""

    value: FloatArray
    """Shape (q,)."""
    std: FloatArray
    """Standard errors clustered by frame, since errors of the model are correlated between its markers (Liang and Zeger 1986); shape (q,)."""
    share: float
    """Misfit with them, as a fraction of that without [1]."""


def first_order(fit: MarkerFit, columns: FloatArray, *, beside: FloatArray | None = None) -> FirstOrder:
    """Return parameters fitted together with the undeclared poses and the unknown inputs.

    Arguments:
        fit: fit of the unchanged files, with the derivatives of its residual.
        columns: derivative of the residual by the parameters, shape (k, 3, q).
        beside: the same of nuisance parameters, which the misfit without `columns` has too, shape (k, 3, n).
    """
    jet, frame = fit.jet, np.repeat(fit.scene.frame, 3)
    rows, residual = jet.residual.size, jet.residual.ravel()
    free = np.flatnonzero(np.repeat([T is None for T in fit.scene.recording.T_robot_camera], 6))
    blocks = [jet.by_pose[:, :, free], jet.by_initial, *([] if beside is None else [beside])]
    common = np.hstack([block.reshape(rows, -1) for block in blocks])
    plain = _least_squares(common, residual, frame)[2]
    x, std, left = _least_squares(np.hstack([common, columns.reshape(rows, -1)]), residual, frame)
    q = columns.shape[2]
    return FirstOrder(x[-q:], std[-q:], float(np.linalg.norm(left)) / max(float(np.linalg.norm(plain)), 1e-300))


def _least_squares(J: FloatArray, residual: FloatArray, frame: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the least-squares step for a residual (r,), its clustered standard errors, and the remaining residual."""
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
