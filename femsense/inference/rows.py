"""Residual rows: measured minus modelled along a direction at a point of the body, for pixels, markers and gaps between surfaces alike.

Row j takes the point p_j = Σ_i w_ji x_(n_ji) of the deformed body and a unit direction d_j. Its residual r_j [m] is the measured minus the modelled
coordinate along d_j, so that a displacement u of the nodes changes it by −d_j · Σ_i w_ji u_(n_ji).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from femsense.core.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Residual rows of one frame at one state."""

    residual: FloatArray
    """Measured minus modelled [m], shape (r,)."""
    std: FloatArray
    """Standard deviation σ [m], shape (r,)."""
    log_other: FloatArray
    """Log of o_j, the odds that the row shows another object, relative to the density of the robot at a residual of 0; −inf: never. Shape
    (r,)."""
    share: FloatArray
    """1/T_j: how many independent measurements each row counts for, shape (r,)."""
    nodes: IntArray
    """Nodes n_j that carry the point, shape (r, k)."""
    weights: FloatArray
    """Their weights w_j, shape (r, k)."""
    direction: FloatArray
    """Unit direction d_j, shape (r, 3)."""
    by_pose: FloatArray
    """Derivative of the measured side with (rotation about the pivot [rad], shift [m]) of each camera, shape (r, 6 v)."""
    field: FloatArray
    """Weights of the error field's centres (see `error_field`), shape (r, p); 0 for rows without a correlated error."""
    camera: FloatArray
    """Share of each camera in the measured side, shape (r, v); 0 without an error field of a camera."""
    way: FloatArray
    """Displacement of the point from rest [m], shape (r,)."""
    rest: FloatArray
    """The point at rest [m], shape (r, 3)."""
    pixel: BoolArray
    """Whether the row is a pixel, which may be thinned and counted; shape (r,)."""

    def __len__(self) -> int:
        return len(self.residual)

    def of(self, displacement: FloatArray) -> FloatArray:
        """Return d · u at the rows for node displacements (k, n, 3) [m], shape (r, k) [m]."""
        moves = np.ascontiguousarray(np.moveaxis(displacement, 0, 2))
        result = np.empty((len(self.residual), moves.shape[2]))
        _project(self.nodes, self.weights, self.direction, moves, result)
        return result

    def some(self, index: IntArray) -> Rows:
        """Return a selection of the rows, index (s,)."""
        return Rows(*(getattr(self, name)[index] for name in Rows.__slots__))

    def averaged(self, weight: FloatArray) -> Averaged:
        """Return the rows with the pixels of each triangle averaged under weights (r,), for quantities that hardly change over a
        triangle."""
        others = np.flatnonzero(~self.pixel)
        label = np.full(len(self), -1, dtype=np.int64)
        size = int(self.nodes.max(initial=0)) + 1
        own = self.nodes[self.pixel][:, :3].astype(np.int64)
        key = (own[:, 0] * size + own[:, 1]) * size + own[:, 2]
        label[self.pixel] = np.unique(key, return_inverse=True)[1]
        label[others] = int(label.max(initial=-1)) + 1 + np.arange(len(others))
        count = int(label.max(initial=-1)) + 1
        first = np.zeros(count, dtype=np.int64)
        first[label[::-1]] = np.arange(len(self))[::-1]
        total = np.bincount(label, weight, minlength=count).astype(np.float64)
        share = weight / np.maximum(total, 1e-300)[label]
        mean = Averaged(self.some(first), total, label, share)
        rows = replace(mean.rows, weights=mean.of_rows(self.weights), direction=mean.of_rows(self.direction))
        return replace(mean, rows=rows)


@dataclass(frozen=True, eq=False, slots=True)
class Averaged:
    """Rows, some of which are means of other rows."""

    rows: Rows
    weight: FloatArray
    """Sum of the weights of each, shape (a,)."""
    label: IntArray
    """Index of the mean to which each row belongs, shape (r,)."""
    share: FloatArray
    """Share of each row in its mean, shape (r,)."""

    def of_rows(self, values: FloatArray) -> FloatArray:
        """Return the means of values (r, k) of the rows, shape (a, k)."""
        result = np.zeros((len(self.weight), values.shape[1]))
        _add_up(self.label, self.share, np.ascontiguousarray(values), result)
        return result


def stacked(blocks: Sequence[Rows]) -> Rows:
    """Return the rows of several blocks, points with fewer nodes padded with weight 0."""
    if len(blocks) == 1:
        return blocks[0]
    most = max(block.nodes.shape[1] for block in blocks)

    def padded(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.pad(values, ((0, 0), (0, most - values.shape[1])))

    columns = []
    for name in Rows.__slots__:
        parts = [getattr(block, name) for block in blocks]
        columns.append(np.concatenate([padded(part) for part in parts] if name in ("nodes", "weights") else parts))
    return Rows(*columns)


@njit(cache=True)
def _add_up(label, share, values, result):  # type: ignore[no-untyped-def]
    for j in range(len(label)):
        for k in range(values.shape[1]):
            result[label[j], k] += share[j] * values[j, k]


@njit(cache=True, fastmath=True)
def _project(nodes, weights, direction, moves, result):  # type: ignore[no-untyped-def]
    """result[j, k] = Σ_i Σ_c w_ji d_jc moves[n_ji, c, k]."""
    for j in range(nodes.shape[0]):
        for k in range(moves.shape[2]):
            result[j, k] = 0.0
        for i in range(nodes.shape[1]):
            if weights[j, i] == 0.0:
                continue
            for c in range(3):
                scale = weights[j, i] * direction[j, c]
                for k in range(moves.shape[2]):
                    result[j, k] += scale * moves[nodes[j, i], c, k]
