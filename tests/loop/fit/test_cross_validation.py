"""Left-out sweeps against fits without them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from femsense.loop.data.trial import Groups
from femsense.loop.fit.cross_validation import sweeps_predicted

RNG = np.random.default_rng(11)


def some_groups(frames: int = 12, markers: int = 5) -> Groups:
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    return Groups(marker, frame, frame // 4, np.arange(frames * markers))


def linear_fit(J: np.ndarray, r: np.ndarray, rest: int = 0) -> SimpleNamespace:
    """Return what `sweeps_predicted` asks of a fit, at the optimum of a linear problem."""
    at_optimum = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
    return SimpleNamespace(
        fit=SimpleNamespace(jacobian=J, residual=at_optimum),
        jets=[SimpleNamespace(rest=np.zeros((rest, 3)), residual=np.zeros((0, 3)))],
    )


def test_left_out_sweeps_are_predicted_as_by_fits_without_them():
    groups = some_groups()
    n = 3 * len(groups.marker)
    trial = SimpleNamespace(groups=groups, poses=(), together=False)
    J, r = RNG.normal(size=(n, 6)), RNG.normal(size=n)
    small, large = linear_fit(J[:, :3], r), linear_fit(J, r)
    got, spread = sweeps_predicted([trial], small, large)

    def density(columns: np.ndarray, rows: np.ndarray) -> float:
        others = np.setdiff1d(np.arange(n), rows)
        theta = np.linalg.lstsq(columns[others], r[others], rcond=None)[0]
        cov = np.eye(len(rows)) + columns[rows] @ np.linalg.inv(columns[others].T @ columns[others]) @ columns[rows].T
        error = r[rows] - columns[rows] @ theta
        return float(-error @ np.linalg.solve(cov, error) - np.linalg.slogdet(cov)[1])

    sweep = np.repeat(groups.sweep, 3)
    gains = [density(J, np.flatnonzero(sweep == s)) - density(J[:, :3], np.flatnonzero(sweep == s)) for s in range(3)]
    assert got == pytest.approx(sum(gains), rel=1e-8)
    assert spread == pytest.approx(np.sqrt(3) * np.std(gains, ddof=1), rel=1e-8)


def test_a_direction_that_one_sweep_alone_decides_says_nothing_where_that_is_left_out():
    groups = some_groups()
    n = 3 * len(groups.marker)
    trial = SimpleNamespace(groups=groups, poses=(), together=False)
    J, r = RNG.normal(size=(n, 6)), RNG.normal(size=n)
    only = np.where(np.repeat(groups.sweep, 3) == 1, RNG.normal(size=n), 0.0)
    J = np.column_stack([only, J])
    small, large = linear_fit(J[:, :4], r), linear_fit(J, r)
    large.fit.residual = large.fit.residual + 1e-3 * only  # a fit ends near its optimum
    assert abs(sweeps_predicted([trial], small, large)[0]) < 100.0
