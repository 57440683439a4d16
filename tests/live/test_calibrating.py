"""Which frames a calibration needs, and what a person is told."""

from __future__ import annotations

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.live.calibrating import Coverage, CoverageLimits, MovingInput, insufficiency

A, B = MovingInput("cable_a", 10.0), MovingInput("cable_b")


def offered(coverage: Coverage, *values: tuple[float, ...], wait_s: float = 1.0) -> list[bool]:
    return [coverage.offer(wait_s * k, np.array(row)) for k, row in enumerate(values)]


def test_frames_with_other_inputs_are_kept_and_the_same_ones_wait() -> None:
    coverage = Coverage([A], CoverageLimits(frames=3, wait_s=1.0))
    kept = [coverage.offer(t, np.array([value])) for t, value in ((0.0, 0.0), (0.1, 0.0), (0.2, 5.0), (0.3, 5.01), (1.5, 5.0))]
    assert kept == [True, False, True, False, True] and coverage.count == 3 and coverage.suffices and not coverage.missing


def test_what_is_missing_is_said_until_it_suffices() -> None:
    coverage = Coverage([A, B], CoverageLimits(frames=2, wait_s=0.0))
    coverage.offer(0.0, np.array([0.0, 0.0]))
    assert coverage.missing == "1 of 2 frames missing; still to be moved: cable_a by 1 N, cable_b"
    coverage.offer(1.0, np.array([0.5, 1.0]))
    assert coverage.missing == "still to be moved: cable_a by 1 N (so far 0.5)" and not coverage.suffices
    coverage.offer(2.0, np.array([1.5, 1.0]))
    assert coverage.suffices and coverage.missing == ""


def test_inputs_that_do_not_move_are_waited_for_and_cost_no_frames() -> None:
    coverage = Coverage([A], CoverageLimits(frames=2, wait_s=0.0))
    assert offered(coverage, *[(0.0,)] * 50).count(True) == coverage.count == coverage.wanted == 2
    assert not coverage.suffices and coverage.missing == "still to be moved: cable_a by 1 N"
    coverage.want_more()
    offered(coverage, *[(0.0,)] * 50)
    assert coverage.count == coverage.wanted == 8
    assert coverage.offer(100.0, np.array([2.0])) and coverage.suffices


def test_noise_of_an_input_is_no_movement() -> None:
    coverage = Coverage([A], CoverageLimits(frames=2, wait_s=10.0))
    assert offered(coverage, (0.0,), (0.02,), (0.05,), (0.01,)) == [True, False, False, False]


def test_a_person_may_accept_that_an_input_is_fixed() -> None:
    coverage = Coverage([A], CoverageLimits(frames=2, wait_s=0.0))
    offered(coverage, (0.0,), (0.0,))
    coverage.accept_fixed()
    assert coverage.suffices and coverage.missing == ""


def test_more_frames_are_asked_for_after_a_calibration_that_did_not_suffice() -> None:
    coverage = Coverage([], CoverageLimits(frames=1, wait_s=0.0, more=2))
    coverage.offer(0.0, np.zeros(0))
    assert coverage.suffices
    coverage.want_more()
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
