"""What the verdict asks of the model that is handed back."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from femsense.loop.data.trial import Groups
from femsense.loop.fit.model_error import excess_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import Repeatability
from femsense.loop.thresholds import DEFAULTS
from femsense.loop.verdict.verdict import lacks_much

RNG = np.random.default_rng(11)


def some_groups(frames: int = 12, markers: int = 5) -> Groups:
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    return Groups(marker, frame, frame // 4, np.arange(frames * markers))


def leaving(train: float, held: float) -> SimpleNamespace:
    """Return what the verdict asks of a fitted model that leaves residuals of such sizes [m] at 5 markers in 12 frames."""
    values = [size * np.sign(RNG.normal(size=(60, 3))) for size in (train, held)]
    return SimpleNamespace(fit=SimpleNamespace(jets=[SimpleNamespace(residual=values[0])]), held_residuals=[values[1]])


NOISE = Noise({"white": 1e-4}, "")
TRIAL = SimpleNamespace(groups=some_groups(), mesh_error=None)
ROBOT = SimpleNamespace(body=SimpleNamespace(reach=0.1))
DATA = SimpleNamespace(train=[TRIAL], held=[TRIAL], placement_std=1e-3, robot=ROBOT, thresholds=DEFAULTS)
KNOWN = Repeatability(1e-4, 3, True, "")


def test_a_verdict_asks_what_the_robot_that_is_handed_back_leaves():
    before, right = leaving(1e-3, 1e-3), leaving(1.2e-4, 1.2e-4)
    assert excess_of(DATA, before, right, right, NOISE, KNOWN).explained > 0.99
    assert excess_of(DATA, before, right, leaving(1e-3, 7e-4), NOISE, KNOWN).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert excess_of(DATA, before, leaving(7e-4, 1e-4), right, NOISE, KNOWN).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert not lacks_much(DATA, right, right, NOISE)
    assert not lacks_much(DATA, before, before, NOISE)  # whatever calibration may move leaves as much
    assert lacks_much(DATA, leaving(1.2e-4, 3e-4), right, NOISE) and lacks_much(DATA, leaving(3e-4, 1.2e-4), right, NOISE)


def test_what_varies_with_the_state_is_an_error_of_the_model_and_no_noise():
    """Components of the covariance that a state does not repeat are as large as they like: what repeats says what noise is."""
    wide = Noise({"white": 3e-3, "state": 3e-3, "frame": 3e-3, "sweep": 3e-3}, "")
    left = excess_of(DATA, leaving(2e-2, 2e-2), leaving(5e-3, 5e-3), leaving(5e-3, 6e-3), wide, KNOWN)
    assert left.left == pytest.approx(np.sqrt(3.0) * 5e-3, rel=0.01) and left.held == pytest.approx(np.sqrt(3.0) * 6e-3, rel=0.01)
    assert left.is_large
    small = excess_of(DATA, leaving(2e-2, 2e-2), leaving(1.02e-4, 1e-4), leaving(1e-4, 1e-4), wide, KNOWN)
    assert not small.is_large


@pytest.mark.parametrize("known, large", [(True, False), (False, True)])
def test_noise_that_nothing_measures_is_believed_up_to_a_share_of_the_body(known: bool, large: bool):
    measured = Repeatability(3e-3, 3, known, "")  # 5 mm in space, on a body of 100 mm
    assert excess_of(DATA, leaving(9e-3, 9e-3), leaving(4e-3, 4e-3), leaving(4e-3, 4e-3), NOISE, measured).is_large == large


def test_markers_are_not_believed_to_sit_farther_off_than_is_known_beforehand():
    off = Noise({"white": 1e-4, "marker": 4e-3}, "")
    left = excess_of(DATA, leaving(2e-2, 2e-2), leaving(4e-3, 4e-3), leaving(4e-3, 4e-3), off, KNOWN)
    assert left.floor == pytest.approx(np.sqrt(3.0) * np.hypot(1e-4, 1e-3))
    assert left.left == pytest.approx(np.sqrt(3.0) * np.sqrt(4e-3**2 - 1e-4**2 - 1e-3**2), rel=1e-6)
