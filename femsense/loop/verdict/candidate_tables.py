"""Tables of the report on candidates: estimates, ranks under the bootstrap, collinearity, and smallest detectable sizes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.dataset import Data
from femsense.loop.fit.cross_validation import LEAST_SWEEPS, sweep_rows
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.result.evidence import ConfoundingMap, Estimate, Ranked, Size
from femsense.loop.search.screening import Candidate, confounding, one_each
from femsense.loop.thresholds import Thresholds

DRAWS = 200
"""Number of bootstrap draws of sweeps."""
MAP = 14
"""Maximum number of effects in the map of confounding."""
KINDS = {"linear": "change", "log": "factor", "reciprocal": "softer_than"}
"""Meaning of the size of a parameter, by the scale of its coordinate."""


def ranking(data: Data, fit: JointFit, first: list[Candidate], rng: np.random.Generator) -> dict[str, Ranked]:
    """Return for each effect the linear estimate of its parameters with their plausible range, and the share of draws in which it is first."""
    ones = one_each(first)
    often = _first_share(data, fit, ones, rng)
    return {c.effect.name: Ranked(tuple(_estimates(c)), None if often is None else often[i]) for i, c in enumerate(ones)}


def _estimates(c: Candidate) -> list[Estimate]:
    if c.effect.discrete:
        return [Estimate(p.label, None, None, _ends(p.value(p.low), p.value(p.high)), p.unit) for p in c.parameters]
    scale = np.maximum(np.linalg.norm(c.columns, axis=0), 1e-300)
    std_of_steps = np.sqrt(np.maximum(np.diag(np.linalg.pinv((c.columns / scale).T @ (c.columns / scale))), 0.0)) / scale
    rows = []
    for p, step, std in zip(c.parameters, c.step, std_of_steps):
        at = p.null + float(step)
        ends = _ends(p.value(p.low), p.value(p.high))
        rows.append(Estimate(p.label, p.value(at), p.value_std(at, float(std)), ends, p.unit))
    return rows


def _ends(a: float, b: float) -> tuple[float, float]:
    return min(a, b), max(a, b)


def _first_share(data: Data, fit: JointFit, ones: list[Candidate], rng: np.random.Generator) -> list[float] | None:
    """Return the share of bootstrap draws of sweeps in which each effect has the best linear score; None for few sweeps.

    The nuisance columns are projected out again in each draw. Rows without a sweep (placements, declared poses, priors) stay.
    """
    groups = sweep_rows(data.train, fit)
    if len(groups) < LEAST_SWEEPS or not ones:
        return None
    J = np.asarray(fit.fit.jacobian)
    whole = np.hstack([J, *(c.columns for c in ones), fit.fit.residual[:, None]])
    size = np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
    size[-1] = 1.0
    whole = whole / size
    inside = np.zeros(len(whole), dtype=bool)
    grams = []
    for rows in groups:
        inside[rows] = True
        grams.append(whole[rows].T @ whole[rows])
    rest = whole[~inside].T @ whole[~inside]
    spans = list(pairwise(np.cumsum([J.shape[1], *(c.columns.shape[1] for c in ones)])))
    wins = np.zeros(len(ones))
    for _ in range(DRAWS):
        counts = np.bincount(rng.integers(0, len(groups), len(groups)), minlength=len(groups))
        G = without_first(rest + np.tensordot(counts, np.array(grams), axes=1), J.shape[1])
        gains = [_gain(G, a - J.shape[1], b - J.shape[1], c, size[a:b]) - c.cost for (a, b), c in zip(spans, ones)]
        wins[int(np.argmax(gains))] += max(gains) > 0
    return [float(w) / DRAWS for w in wins]


def without_first(gram: FloatArray, p: int) -> FloatArray:
    """Return a Gram matrix with its first p columns projected out."""
    B = gram[:p, p:]
    return np.asarray(gram[p:, p:] - B.T @ np.linalg.pinv(gram[:p, :p], rcond=1e-12, hermitian=True) @ B)


def _gain(G: FloatArray, a: int, b: int, c: Candidate, size: FloatArray) -> float:
    """Return the decrease of the sum of squares of the last column by columns a … b; a single parameter stays within its bounds."""
    if c.effect.discrete:
        return float(-2.0 * size[0] * G[a, -1] - size[0] ** 2 * G[a, a])
    if G[a:b, a:b].trace() <= 0:
        return 0.0
    step = -np.linalg.pinv(G[a:b, a:b], rcond=1e-10, hermitian=True) @ G[a:b, -1]
    if b - a == 1:
        p = c.parameters[0]
        step = np.clip(step, (p.low - p.null) * size, (p.high - p.null) * size)
    return float(-2.0 * step @ G[a:b, -1] - step @ G[a:b, a:b] @ step)


def confounding_map(first: list[Candidate], thresholds: Thresholds) -> ConfoundingMap:
    """Return the share of each effect's field (row) that is collinear with that of another one (column), nuisance projected out."""
    shown = [c for c in one_each(first) if c.retained >= thresholds.testable][:MAP]
    return ConfoundingMap(tuple(c.effect.name for c in shown), tuple(tuple(confounding(a, b) for b in shown) for a in shown))


def power(last: list[Candidate]) -> dict[str, tuple[Size, ...]]:
    """Return the smallest detectable change of each parameter of each effect, in its unit."""
    return {c.effect.name: tuple(_sizes(c)) for c in one_each(last)}


def _sizes(c: Candidate) -> list[Size]:
    if c.effect.discrete:
        return [Size("", "whole", float(c.smallest[0]) if len(c.smallest) else None, "1")]
    return [Size(p.label, KINDS[p.scale], own_size(float(size), p.scale), p.unit) for p, size in zip(c.parameters, c.smallest)]


def own_size(size: float, scale: str) -> float | None:
    """Return a size in a coordinate as a change of the value, a factor on it, or an upper limit of a stiffness; None if it is not detectable."""
    if not np.isfinite(size) or size <= 0:
        return None
    if scale == "log":
        return float(np.exp(size)) if size < 50.0 else None
    return 1.0 / size if scale == "reciprocal" else size
