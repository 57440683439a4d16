"""Noise: its likelihood and whitening against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.loop.data.trial import Groups
from femsense.loop.fit.noise_components import Likelihood, Noise, whiten

RNG = np.random.default_rng(11)


def some_groups(frames: int = 12, markers: int = 5) -> Groups:
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    return Groups(marker, frame, frame // 4, np.arange(frames * markers))


def test_the_gradient_of_the_likelihood_is_its_difference():
    groups = some_groups()
    k = len(groups.marker)
    likelihood = Likelihood(
        ["white", "frame", "marker", "sweep"], [RNG.normal(size=(k, 3))], [RNG.normal(size=(k, 3, 4))], [groups]
    )
    at = np.log([1.0, 0.6, 0.4, 0.3])
    gradient = likelihood(at)[1]
    for i, step in enumerate(1e-5 * np.eye(4)):
        assert gradient[i] == pytest.approx((likelihood(at + step)[0] - likelihood(at - step)[0]) / 2e-5, rel=1e-5)


def test_whitening_takes_fields_that_count_as_noise():
    groups = some_groups(4, 3)
    noise = Noise({"white": 0.5, "frame": 0.3}, "")
    fields = RNG.normal(size=(12, 3, 2))
    W = whiten(noise.whitener(groups, fields), np.eye(36).reshape(12, 3, 36))
    E = fields.reshape(36, 2)
    sigma = np.kron(noise.covariance(groups), np.eye(3)) + E @ E.T
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(sigma), rtol=1e-9, atol=1e-9)


def test_whitening_is_kept_for_the_same_noise_and_groups_alone():
    groups, other = some_groups(4, 3), some_groups(3, 4)
    noise, louder = Noise({"white": 0.5, "frame": 0.3}, ""), Noise({"white": 0.5, "frame": 0.6}, "")
    for n, g in ((noise, groups), (louder, groups), (noise, other), (noise, groups)):
        lower = n.whitener(g).lower
        np.testing.assert_allclose(lower @ lower.T, n.covariance(g), atol=1e-12)
        assert n.whitener(g).lower is lower and not lower.flags.writeable
