"""An empirical correction of the remaining residual: a smooth function of the inputs. It is not a cause.

    r = J β + g(u) + ε,  g ~ GP(0, s² k(u, u′)),  ε ~ N(0, σ²)

r is the residual, u the inputs in units of their ranges, J the columns of calibration and the accepted effects. J is fitted too but not predicted, so that
g is orthogonal to it (Kennedy & O'Hagan 2001; Plumlee 2017). k is a sum of one kernel per input, which extrapolates from single inputs to
combinations, or one kernel of all inputs; the choice, its length and s/σ maximise the restricted likelihood. g keeps the terms whose variance
exceeds σ² (Nyström).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.least_squares import basis_of
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import Trial
from femsense.loop.fit.fitted_model import FittedModel
from femsense.model.marker_correction import KERNELS, Correction, kernel_of, recorded_inputs

LENGTHS = 0.3, 0.6, 1.2, 2.4
"""Candidate lengths of the kernel, in ranges of an input."""
RATIOS = 1.0, 3.0, 10.0, 30.0, 100.0, 300.0
"""Candidate ratios s²/σ²."""


def learn_correction(data: Data, fitted: FittedModel) -> Correction | None:
    """Return the most likely correction of the residual of the fitted markers; None if none exceeds the likelihood without correction, or if there are too
    few states."""
    rows = _rows_of(data, fitted)
    states, number = np.unique(np.round(rows.inputs, 9), axis=0, return_inverse=True)
    if len(states) <= data.thresholds.states:
        return None
    number = np.asarray(number).reshape(-1)
    plain = _Model(rows, np.zeros((len(number), 0)))
    best, chosen, likelier = plain.likelihood(1.0)[0], None, 0.5 * data.thresholds.evidence
    for kernel, length in product(KERNELS if states.shape[1] > 1 else KERNELS[1:], LENGTHS):
        gram = kernel_of(kernel, length, states, states)
        values, vectors = np.linalg.eigh(gram)
        for ratio in RATIOS:
            kept = values * ratio > 1.0
            if not kept.any():
                continue
            basis = vectors[:, kept] / np.sqrt(values[kept])
            found = _Model(rows, (gram @ basis)[number])
            value = found.likelihood(ratio)[0]
            # length and ratio were selected, and the sum of kernels is preferred: it predicts inputs that were not pulled together
            if value > best + (likelier if chosen is None or chosen[0] != kernel else 0.0):
                best, chosen = value, (kernel, length, ratio, basis, found)
    if chosen is None:
        return None
    kernel, length, ratio, basis, found = chosen
    weights, covariance = found.weights(ratio)
    names = tuple(data.robot.glued_names[m] for m in rows.markers)
    recording = data.train[0].scene.recording
    drives = (*recording.cable_names, *recording.chamber_names)
    noise = float(np.sqrt(found.likelihood(ratio)[1]))
    return Correction(kernel, length, data.control, drives, _ranges(data), names, states, basis, weights, covariance, noise)


@dataclass(frozen=True, eq=False, slots=True)
class _Rows:
    """Residuals of markers, one row for each marker in a frame."""

    inputs: FloatArray
    """In their ranges, shape (k, a)."""
    marker: IntArray
    """A number 0 … m − 1, shape (k,)."""
    markers: IntArray
    """Index of each of these among the robot's markers, shape (m,)."""
    residual: FloatArray
    """[m], shape (k, 3)."""
    columns: FloatArray
    """Columns of calibration and effects, shape (k, 3, p)."""


def _rows_of(data: Data, fitted: FittedModel) -> _Rows:
    pairs = [(t, j) for t, j in zip(data.train, fitted.fit.jets) if t.scene.crossings is None]
    own = [np.concatenate([j.by_pose, j.by_initial], axis=2) for _, j in pairs]
    ends = np.cumsum([0, *(o.shape[2] for o in own)])
    beside = [np.pad(o, ((0, 0), (0, 0), (a, ends[-1] - a - o.shape[2]))) for o, a in zip(own, ends)]
    columns = np.concatenate([np.concatenate([o, j.by_effect], axis=2) for o, (_, j) in zip(beside, pairs)])
    marker = np.concatenate([t.scene.marker for t, _ in pairs])
    markers, number = np.unique(marker, return_inverse=True)
    inputs = np.concatenate([inputs_of(t) for t, _ in pairs]) / _ranges(data)
    return _Rows(inputs, number, markers, np.concatenate([j.residual for _, j in pairs]), columns)


def _ranges(data: Data) -> FloatArray:
    """Return the largest fitted value of each input [N], [m] or [Pa], shape (a,); for an input that never moves, that of the largest one."""
    largest = np.max([np.abs(inputs_of(t)).max(axis=0) for t in data.train], axis=0)
    return np.asarray(np.where(largest > 0, largest, max(largest.max(initial=0.0), 1e-12)))


def inputs_of(trial: Trial) -> FloatArray:
    """Return the recorded inputs of each row of a trial [N], [m] or [Pa], shape (k, a)."""
    return recorded_inputs(trial.scene.recording)[trial.scene.frame]


class _Model:
    """The likelihood of a residual with some terms for each axis of each marker, and fitted columns."""

    def __init__(self, rows: _Rows, terms: FloatArray) -> None:
        self.rows, self.terms, self.q = rows, terms, terms.shape[1]
        flat = rows.columns.reshape(-1, rows.columns.shape[2])
        self.along = basis_of(flat)[0].reshape(*rows.columns.shape[:2], -1)

    def _groups(self) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Yield terms, residuals and columns for each axis of each marker: independent except for the columns."""
        for m in range(len(self.rows.markers)):
            own = self.rows.marker == m
            for axis in range(3):
                yield self.terms[own], self.rows.residual[own, axis], self.along[own, axis]

    def _solved(self, ratio: float) -> tuple[float, FloatArray, FloatArray, list[tuple[FloatArray, FloatArray, FloatArray]]]:
        """Return log|V|, XᵀV⁻¹X, XᵀV⁻¹r and (V⁻¹X, V⁻¹r, terms) of each group, V = 1 + ratio · terms termsᵀ."""
        p = self.along.shape[2]
        log_det, normal, right, parts = 0.0, np.zeros((p, p)), np.zeros(p), []
        for F, r, X in self._groups():
            inner = np.eye(self.q) / ratio + F.T @ F
            log_det += float(np.linalg.slogdet(ratio * inner)[1]) if self.q else 0.0
            both = np.column_stack([X, r])
            solved = both - F @ np.linalg.solve(inner, F.T @ both) if self.q else both
            normal += X.T @ solved[:, :-1]
            right += X.T @ solved[:, -1]
            parts.append((solved[:, :-1], solved[:, -1], F))
        return log_det, normal, right, parts

    def likelihood(self, ratio: float) -> tuple[float, float]:
        """Return the restricted log-likelihood at the optimal σ², and that σ² [m²]."""
        log_det, normal, right, parts = self._solved(ratio)
        beta = np.linalg.solve(normal, right)
        residuals = [r for _, r, _ in self._groups()]
        square = float(sum(r @ v for r, (_, v, _) in zip(residuals, parts)) - right @ beta)
        freedom = self.rows.residual.size - len(beta)
        variance = max(square, 1e-30) / freedom
        return -0.5 * (log_det + float(np.linalg.slogdet(normal)[1]) + freedom * float(np.log(variance))), variance

    def weights(self, ratio: float) -> tuple[FloatArray, FloatArray]:
        """Return the weights [m], shape (q, m, 3), and the largest of the covariances of one axis [m²], shape (q, q)."""
        _, normal, right, parts = self._solved(ratio)
        beta, variance = np.linalg.solve(normal, right), self.likelihood(ratio)[1]
        values = [ratio * F.T @ (v - X @ beta) for X, v, F in parts]
        covariances = [np.linalg.inv(np.eye(self.q) / ratio + F.T @ F) for _, _, F in parts]
        largest = covariances[int(np.argmax([np.trace(c) for c in covariances]))]
        weights = np.array(values).reshape(len(self.rows.markers), 3, self.q).transpose(2, 0, 1)
        return np.asarray(weights), np.asarray(variance * largest, dtype=np.float64)


def rows_of(correction: Correction, trial: Trial) -> tuple[FloatArray, FloatArray]:
    """Return the correction of the rows of a trial, robot frame [m], shape (k, 3), and its standard deviation, shape (k,)."""
    shifts, std = correction.shifts(inputs_of(trial))
    return shifts[np.arange(len(shifts)), trial.scene.marker], std
