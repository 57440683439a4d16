"""How far fitted values may be off: misfit, and gravity on its sphere."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from femsense.calib.fit import covariance_of
from femsense.effects.loads import STANDARD_GRAVITY
from femsense.loop.joint import GRAVITY_STD
from femsense.loop.noise import Noise
from femsense.loop.spread import coordinate_std, misfit


def linear_fit(rows: np.ndarray, gravity: np.ndarray, residual: np.ndarray | None = None) -> Any:
    """Return a fit of gravity alone with whitened rows (k, 3), at its optimum: the size of gravity is known besides."""
    prior = gravity / np.linalg.norm(gravity) / GRAVITY_STD
    J = np.vstack([rows, prior])
    r = np.zeros(len(J)) if residual is None else residual
    parameters = [SimpleNamespace(key="vector_m_s2")] * 3
    return SimpleNamespace(
        own=0, coordinates=gravity, std=np.sqrt(np.diag(covariance_of(J))), jets=[],
        hypothesis=SimpleNamespace(parameters=parameters), fit=SimpleNamespace(jacobian=J, residual=r, theta=gravity),
    )  # fmt: skip


NOISE = Noise({"white": 1e-4}, "")


def test_gravity_seen_along_one_axis_may_point_anywhere_on_a_circle() -> None:
    side, down = 4.0, -np.sqrt(STANDARD_GRAVITY**2 - 16.0)
    fit = linear_fit(np.array([[0.0, 0.0, 1 / 0.05]]), np.array([side, 0.0, down]))
    std = coordinate_std(fit, [], NOISE)
    # on a circle of radius 4 that the estimate lies on: E (x − 4)² = 16 (1 + 1/2), E y² = 16/2
    np.testing.assert_allclose(std[:2], [side * np.sqrt(1.5), side * np.sqrt(0.5)], rtol=0.03)
    assert fit.std[0] < 0.3 < std[0]  # what the tangent says
    assert std[2] == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("size", [STANDARD_GRAVITY, 9.4])
def test_gravity_seen_along_all_axes_has_the_usual_spread(size: float) -> None:
    towards, std = np.array([0.6, 0.0, -0.8]), 0.05
    # the data say `size`, what is known says 9.80665: the optimum lies between them
    best = (size / std**2 + STANDARD_GRAVITY / GRAVITY_STD**2) / (1 / std**2 + 1 / GRAVITY_STD**2)
    residual = np.append((best - size) * towards / std, (best - STANDARD_GRAVITY) / GRAVITY_STD)
    fit = linear_fit(np.eye(3) / std, best * towards, residual)
    np.testing.assert_allclose(coordinate_std(fit, [], NOISE), fit.std, rtol=0.05)


def trial(count: int) -> Any:
    return SimpleNamespace(groups=SimpleNamespace(state=np.repeat(np.arange(count), 5), surface=None), mesh_error=None)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_a_model_that_leaves_more_than_the_noise_is_trusted_less(factor: float) -> None:
    rng = np.random.default_rng(2)
    noise = Noise({"white": 1e-6, "state": 2e-4}, "")
    residual = factor * 2e-4 * rng.standard_normal((400, 3))
    fit = SimpleNamespace(jets=[SimpleNamespace(residual=np.repeat(residual, 5, axis=0))], fit=SimpleNamespace(theta=np.zeros(1)))
    assert misfit(fit, [trial(400)], noise) == pytest.approx(max(1.0, factor), rel=0.05)


def test_parameters_leave_less_to_judge_the_noise_by() -> None:
    noise = Noise({"white": 1e-6, "state": 1e-4}, "")
    fit = SimpleNamespace(jets=[SimpleNamespace(residual=np.full((10, 3), 1e-4))], fit=SimpleNamespace(theta=np.zeros(3)))
    assert misfit(fit, [trial(2)], noise) == pytest.approx(np.sqrt(2.0), rel=1e-3)
