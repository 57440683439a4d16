"""What the verdict asks of the model that is handed back."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from femsense.loop.data.trial import Groups
from femsense.loop.fit.noise_components import Noise
from femsense.loop.verdict.verdict import excess_of, lacks_much

RNG = np.random.default_rng(11)


def some_groups(frames: int = 12, markers: int = 5) -> Groups:
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    return Groups(marker, frame, frame // 4, np.arange(frames * markers))


def leaving(train: float, held: float) -> SimpleNamespace:
    """Return what the verdict asks of a stage that leaves residuals of such sizes [m] at 5 markers in 12 frames."""
    values = [size * np.sign(RNG.normal(size=(60, 3))) for size in (train, held)]
    return SimpleNamespace(fit=SimpleNamespace(jets=[SimpleNamespace(residual=values[0])]), held_residuals=[values[1]])


def test_a_verdict_asks_what_the_robot_that_is_handed_back_leaves():
    noise = Noise({"white": 1e-4}, "")
    trial = SimpleNamespace(groups=some_groups(), mesh_error=None)
    data = SimpleNamespace(train=[trial], held=[trial])
    before, right = leaving(1e-3, 1e-3), leaving(1.2e-4, 1.2e-4)
    assert excess_of(data, before, right, right, noise).explained > 0.99
    assert excess_of(data, before, right, leaving(1e-3, 7e-4), noise).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert excess_of(data, before, leaving(7e-4, 1e-4), right, noise).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert not lacks_much(data, right, right, noise)
    assert not lacks_much(data, before, before, noise)  # whatever calibration may move leaves as much
    assert lacks_much(data, leaving(1.2e-4, 3e-4), right, noise) and lacks_much(data, leaving(3e-4, 1.2e-4), right, noise)
