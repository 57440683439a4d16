"""The smooth field that a fit leaves: its size is found where it is known, and what it makes of the covariance."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.calib.residual_field import Cells, likeliest_covariance, restricted_likelihood
from femsense.core.arrays import FloatArray

NOISE = 0.02


def drawn(rng: np.random.Generator, size: float, reach: float) -> Cells:
    """A straight body of 60 cells in two frames; what is left by a fit of an offset and a slope to a field and noise."""
    place = np.column_stack([np.tile(np.linspace(0.0, 1.0, 60), 2), np.zeros((120, 2))])
    apart = (place[:, None, 0] - place[None, :, 0]) ** 2
    field = np.linalg.cholesky(size**2 * np.exp(-apart / (2.0 * reach**2)) + 1e-9 * np.eye(120)) @ rng.normal(size=120)
    fixed = np.column_stack([np.ones(120), place[:, 0]])
    values = field + NOISE * rng.normal(size=120)
    left = values - fixed @ np.linalg.lstsq(fixed, values, rcond=None)[0]
    normal = np.tile([0.0, 0.0, 1.0], (120, 1))
    return Cells(left, fixed, np.full(120, NOISE**-2), place, normal, np.repeat([0, 1], 60))


def offset_variance(cells: Cells, covariance: FloatArray) -> FloatArray:
    """Covariance of the fit by least squares."""
    inverse = np.linalg.inv(cells.derivative.T @ cells.derivative)
    return np.asarray(inverse @ cells.derivative.T @ covariance @ cells.derivative @ inverse)


def test_the_parameters_err_by_what_the_field_says() -> None:
    """Over many draws the squared error of offset and slope is what the covariance has, though the field is seen after the fit only."""
    rng, ratios = np.random.default_rng(4), []
    for _ in range(30):
        cells = drawn(rng, 0.1, 0.2)
        ratios.append(offset_variance(cells, likeliest_covariance(cells)))
    place = cells.place[:, 0]
    true = offset_variance(cells, 0.01 * np.exp(-((place[:, None] - place) ** 2) / 0.08) + NOISE**2 * np.eye(120))
    stated = np.sqrt(np.diag(np.mean(ratios, axis=0)) / np.diag(true))
    assert (stated > 0.6).all() and (stated < 1.6).all(), stated
    independent = np.sqrt(np.diag(offset_variance(cells, 0.01 * np.eye(120))) / np.diag(true))
    assert (independent < 0.4).all()  # what independent rows of that size would say


def test_without_a_field_noise_alone_is_left() -> None:
    cells = drawn(np.random.default_rng(5), 1e-6, 0.2)
    stated = np.sqrt(np.diag(offset_variance(cells, likeliest_covariance(cells))))
    alone = np.sqrt(np.diag(offset_variance(cells, NOISE**2 * np.eye(120))))
    assert (stated < 2.0 * alone).all() and (stated >= alone).all()


def test_the_likelihood_does_not_see_what_the_parameters_explain() -> None:
    rng = np.random.default_rng(6)
    fixed, values = rng.normal(size=(20, 2)), rng.normal(size=20)
    covariance = np.eye(20) + 0.5
    moved = restricted_likelihood(values + fixed @ [3.0, -2.0], fixed, covariance)
    assert moved == pytest.approx(restricted_likelihood(values, fixed, covariance))
