"""What a fit of rays leaves as a smooth field along the body, and what that makes of the covariance.

The error of the model (law, mesh) displaces the surface smoothly, so that neighbouring rows err together. It is a random field of
vectors on the body at rest with the covariance s² exp(−d²/2L²), the same in all frames or another one in each. Its size and reach
are those under which the residual is likeliest, the parameters' own share left out (REML: Patterson and Thompson 1971).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from femsense.calib.scan import RayRows
from femsense.core.arrays import FloatArray, IntArray

CELL = 0.1
"""Rows are gathered in cells of the body at rest, a share of its diagonal …"""
MOST = 500
"""… which grow until there are no more than this."""
REACHES = (0.1, 0.2, 0.4, 0.8)
"""L, as shares of the body's diagonal."""
SIZES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
"""s, in root mean squares of the cells' residuals."""
HUBER = 2.5
"""Whitened residuals beyond this count linearly."""


@dataclass(frozen=True, eq=False, slots=True)
class Cells:
    """Means of the rows of a frame in cells of similar position and normal."""

    residual: FloatArray
    """[m], shape (g,)."""
    derivative: FloatArray
    """Of the residual by the parameters, shape (g, p)."""
    information: FloatArray
    """Of the residual [1/m²], shape (g,)."""
    place: FloatArray
    """On the body at rest, in units of its diagonal, shape (g, 3)."""
    normal: FloatArray
    """Unit normal, shape (g, 3)."""
    frame: IntArray
    """Shape (g,)."""


def row_weights(rows: RayRows) -> FloatArray:
    """Return Huber's weights of rows, shape (r,)."""
    size = np.abs(rows.residual / rows.std)
    return np.asarray(np.minimum(1.0, HUBER * max(1.0, 1.483 * float(np.median(size))) / np.maximum(size, 1e-12)))


def field_scores(frames: Iterable[tuple[RayRows, FloatArray]], rest: FloatArray) -> FloatArray:
    """Return rows whose sum of squares is the covariance of the gradient Jᵀr, shape (p, p): of noise, and of what the model lacks.

    Arguments:
        frames: rows of each frame at the end of the fit, and how their residual changes with the parameters, shape (r, p).
        rest: nodes of the body at rest [m], shape (n, 3).
    """
    every = list(frames)
    seen = [(rows, derivative) for rows, derivative in every if len(rows.residual)]
    if not seen:
        return np.zeros((0, every[0][1].shape[1] if every else 0))
    cell = CELL
    cells = _gathered(seen, rest, cell)
    while len(cells.residual) > MOST:
        cell *= 1.25
        cells = _gathered(seen, rest, cell)
    weighed = cells.derivative.T * cells.information
    values, vectors = np.linalg.eigh(weighed @ likeliest_covariance(cells) @ weighed.T)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def likeliest_covariance(cells: Cells) -> FloatArray:
    """Return the covariance of the cells' residuals [m²], shape (g, g), of noise and of the field under which they are likeliest."""
    noise = np.diag(1.0 / cells.information)
    rms = float(np.sqrt((cells.residual**2).mean()))
    scale = np.sqrt((cells.derivative**2).mean(axis=0))
    fixed = cells.derivative[:, scale > 0.0] / scale[scale > 0.0]
    if len(cells.residual) <= fixed.shape[1] + 1:
        return np.asarray(noise + rms**2 * _alike(cells, max(REACHES), own=False))
    best, found = -np.inf, noise
    for shape in (_alike(cells, reach, own=own) for reach in REACHES for own in (False, True)):
        for size in SIZES:
            covariance = noise + (size * rms) ** 2 * (shape + 1e-6 * np.eye(len(shape)))
            likelihood = restricted_likelihood(cells.residual, fixed, covariance)
            best, found = max((best, found), (likelihood, covariance), key=lambda pair: pair[0])
    return found


def restricted_likelihood(values: FloatArray, fixed: FloatArray, covariance: FloatArray) -> float:
    """Return the restricted log-likelihood of values, with the fixed effects projected out, up to a constant.

    Arguments:
        values: shape (g,).
        fixed: shape (g, p).
        covariance: shape (g, g).
    """
    factor = cho_factor(covariance, lower=True)
    whitened = cho_solve(factor, fixed)
    normal = fixed.T @ whitened
    normal += 1e-12 * np.trace(normal) * np.eye(len(normal))
    along = whitened.T @ values
    misfit = float(values @ cho_solve(factor, values) - along @ np.linalg.solve(normal, along))
    return -0.5 * (2.0 * float(np.log(np.diag(factor[0])).sum()) + float(np.linalg.slogdet(normal)[1]) + misfit)


def _alike(cells: Cells, reach: float, *, own: bool) -> FloatArray:
    """Return the correlation of a field of vectors along the normals, shape (g, g); with a field of its own for each frame, or not."""
    apart = ((cells.place[:, None] - cells.place[None]) ** 2).sum(axis=2)
    alike = np.exp(-apart / (2.0 * reach**2)) * (cells.normal @ cells.normal.T)
    return np.asarray(alike * (cells.frame[:, None] == cells.frame[None]) if own else alike)


def _gathered(seen: list[tuple[RayRows, FloatArray]], rest: FloatArray, cell: float) -> Cells:
    size = float(np.linalg.norm(np.ptp(rest, axis=0)))
    parts = [_cells_of(rows, derivative, rows.hits.place(rest) / size, k, cell) for k, (rows, derivative) in enumerate(seen)]
    return Cells(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(Cells)))


def _cells_of(rows: RayRows, derivative: FloatArray, place: FloatArray, frame: int, cell: float) -> Cells:
    """Return the cells of a frame."""
    normal = rows.hits.normal
    keys = np.hstack([np.floor(place / cell), np.sign(normal) * (np.abs(normal) > 0.5)]).astype(np.int64)
    group = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    weight = row_weights(rows) / rows.std**2
    information = np.asarray(np.bincount(group, weight), dtype=np.float64)

    def mean(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(group, weight * column) for column in values.T], axis=1) / information[:, None]

    facing = mean(normal)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    frames = np.full(len(information), frame)
    return Cells(mean(rows.residual[:, None])[:, 0], mean(derivative), information, mean(place), facing, frames)
