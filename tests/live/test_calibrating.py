"""Which frames a calibration needs, and what a person is told."""

from __future__ import annotations

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.live.calibrating import Coverage, CoverageLimits, insufficiency


def test_frames_with_other_inputs_are_kept_and_the_same_ones_wait() -> None:
    coverage = Coverage(("cable_a",), (10.0,), CoverageLimits(frames=3, wait_s=1.0))
    kept = [coverage.offer(t, np.array([value])) for t, value in ((0.0, 0.0), (0.1, 0.0), (0.2, 5.0), (0.3, 5.01), (1.5, 5.0))]
    assert kept == [True, False, True, False, True] and coverage.count == 3 and coverage.suffices and not coverage.missing


def test_what_is_missing_is_said_until_it_suffices() -> None:
    coverage = Coverage(("cable_a", "cable_b"), (10.0, np.inf), CoverageLimits(frames=2, wait_s=0.0))
    coverage.offer(0.0, np.array([0.0, 0.0]))
    assert coverage.missing == "1 of 2 frames missing; not moved yet: cable_a, cable_b"
    coverage.offer(1.0, np.array([0.5, 1.0]))
    assert coverage.missing == "not moved yet: cable_a" and not coverage.suffices
    coverage.offer(2.0, np.array([1.5, 1.0]))
    assert coverage.suffices and coverage.missing == ""


def test_inputs_that_never_move_are_given_up() -> None:
    coverage = Coverage(("cable_a",), (10.0,), CoverageLimits(frames=2, wait_s=0.0, patience=2.0))
    for t in range(3):
        coverage.offer(float(t), np.zeros(1))
    assert not coverage.suffices
    coverage.offer(3.0, np.zeros(1))
    assert coverage.suffices


def test_more_frames_are_asked_for_after_a_calibration_that_did_not_suffice() -> None:
    coverage = Coverage((), (), CoverageLimits(frames=1, wait_s=0.0))
    coverage.offer(0.0, np.zeros(0))
    assert coverage.suffices
    coverage.want_more(2)
    assert coverage.missing == "2 of 3 frames missing"


def calibration(rotation: float, position: float, status: str = "converged") -> Calibration:
    covariance = np.diag([rotation**2, 0.0, 0.0, position**2, 0.0, 0.0])
    pose = np.eye(4)
    return Calibration(pose, (pose,), ("",), {}, {}, 0.0, {}, (), np.zeros((4, 4)), covariance, {}, {}, status)


def test_a_pose_that_is_known_badly_does_not_suffice() -> None:
    assert insufficiency(calibration(1e-3, 1e-4)) == ""
    assert "2.00 mm" in insufficiency(calibration(1e-3, 2e-3)) and "required are 0.50 mm" in insufficiency(
        calibration(1e-3, 2e-3)
    )
    assert "0.57°" in insufficiency(calibration(1e-2, 1e-4))
    assert insufficiency(calibration(1e-3, 1e-4, "not settled: 40 steps")) == "not settled: 40 steps"
