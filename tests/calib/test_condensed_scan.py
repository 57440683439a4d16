"""Dense clouds as fewer points: means of neighbouring pixels lie on the surface, and depth jumps are not averaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from femsense.calib.condensed_scan import block_side, in_blocks
from femsense.calib.scan import Scan
from femsense.model.camera import CameraNoise

NOISES = (CameraNoise("stereo", at_1m=0.002),)
FOCAL = 600.0


def plate(tilt: float, step: float = 0.0) -> Scan:
    """Return 120 × 80 pixels of a plate 0.4 m away that leans by so much [1], its right half farther by a step [m]."""
    u, v = (a.ravel().astype(float) for a in np.meshgrid(np.arange(120), np.arange(80)))
    x, y = (u - 60.0) / FOCAL, (v - 40.0) / FOCAL
    z = 0.4 / (1.0 - tilt * x) + step * (u >= 61)
    points = np.column_stack([x * z, y * z, z])
    none = np.zeros(0, dtype=np.int64)
    return Scan(points, np.zeros(len(z), dtype=np.int64), np.zeros((0, 3)), none)


@pytest.mark.parametrize("tilt", [0.0, 1.0, 3.0])
def test_means_lie_on_the_plane_and_stand_for_all_points(tilt: float) -> None:
    whole = plate(tilt)
    few = in_blocks(whole, NOISES, [1.0 / FOCAL], block_side(len(whole.view), 2000))
    assert 1000 < len(few.view) < 3500 and few.measured.sum() == len(whole.view)
    off = few.camera_points[:, 2] - tilt * few.camera_points[:, 0] - 0.4
    assert np.abs(off).max() < 1e-12
    assert few.camera_points.T @ few.measured == pytest.approx(whole.camera_points.sum(axis=0))


def test_what_lies_on_both_sides_of_a_jump_is_not_averaged() -> None:
    scan = plate(0.0, step=0.05)
    few = in_blocks(scan, NOISES, [1.0 / FOCAL], block_side(len(scan.view), 2000))
    assert np.minimum(np.abs(few.camera_points[:, 2] - 0.4), np.abs(few.camera_points[:, 2] - 0.45)).max() < 1e-12


def test_what_stands_around_the_robot_is_averaged_as_it_is() -> None:
    whole = plate(1.0)
    few = in_blocks(replace(whole, others=whole.camera_points, others_view=whole.view), NOISES, [1.0 / FOCAL], 3)
    assert few.others == pytest.approx(few.camera_points) and len(few.others_view) == len(few.others) < len(whole.view) / 7


def test_few_points_stay_as_they_are() -> None:
    scan = plate(0.0)
    assert in_blocks(scan, NOISES, [1.0 / FOCAL], block_side(len(scan.view), len(scan.view))) is scan
