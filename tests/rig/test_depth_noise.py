"""What depth cameras add: edges that grow, shadows, gaps where it is dark or gleams, mixed pixels, second bounces, lenses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from femsense.core.pose import make_pose
from femsense.pointcloud.cloud import cloud_from_depth
from femsense.rig.camera import Shape, camera_of, look, render
from femsense.rig.camera_tables import NoiseTable, ViewTable
from femsense.rig.depth_noise import depth_std, second_bounce, shadowed
from femsense.rig.lens import pixels_of

POSE = make_pose(np.eye(3), np.zeros(3))
VIEW: dict[str, Any] = {"width": 160, "height": 120, "fx": 150.0, "T_robot_camera": POSE.tolist()}
CAMERA = camera_of(ViewTable.model_validate(VIEW))
QUIET = {"subpixel_px": 0.0, "edge_dropout": 0.0, "flying_share": 0.0, "quantum_m": 1e-9}


def _square(z: float, x: tuple[float, float], y: tuple[float, float] = (-2.0, 2.0), **more: float) -> Shape:
    corners = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    return Shape(corners, np.array([[0, 2, 1], [0, 3, 2]]), np.full(3, 0.5), **more)


WALL = _square(0.8, (-2.0, 2.0))
POST = _square(0.4, (-0.05, 0.05))


def _depth(shapes: list[Shape], seed: int = 0, **noise: Any) -> np.ndarray:
    table = NoiseTable.model_validate(noise)
    return render(CAMERA, POSE, shapes, noise=table, rng=np.random.default_rng(seed)).depth


def test_disparities_come_in_steps() -> None:
    depth = _depth([WALL], **{**QUIET, "subpixel_px": 0.3, "disparity_step_px": 1 / 32})
    steps = 150.0 * 0.055 / depth * 32
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-5)
    assert len(np.unique(np.rint(steps))) > 3


def test_what_one_imager_does_not_see_has_no_depth() -> None:
    """Left of what is near, in a strip that is f b (1/z − 1/z') wide."""
    depth = _depth([POST, WALL], **QUIET, shadows=True)
    post = np.flatnonzero(np.isclose(depth[60], 0.4))
    gone = np.flatnonzero(depth[60] == 0)
    width = 150.0 * 0.055 * (1 / 0.4 - 1 / 0.8)
    assert gone.max() == post.min() - 1 and abs(len(gone) - width) <= 1
    assert not shadowed(np.full((4, 30), 0.5), 8.0).any()


def test_what_is_near_grows_over_what_is_behind_it() -> None:
    grown = [np.isclose(_depth([POST, WALL], **QUIET, bleeding_px=px), 0.4).sum() / 120 for px in (0.0, 3.0)]
    assert 1.5 < grown[1] - grown[0] < 4.5  # half of the reach on either side, on average
    far = _depth([WALL], **QUIET, bleeding_px=3.0)
    np.testing.assert_allclose(far, 0.8, atol=1e-6)


@pytest.mark.parametrize(("albedo", "gloss", "lost"), [(0.6, 0.0, (0.0, 0.01)), (0.03, 0.0, (0.4, 0.6)), (0.6, 0.9, (0.7, 1.0))])
def test_dark_and_shiny_surfaces_lose_depth(albedo: float, gloss: float, lost: tuple[float, float]) -> None:
    wall = _square(0.8, (-2.0, 2.0), albedo=albedo, gloss=gloss)
    depth = _depth([wall], **QUIET, dark_signal=0.03, shiny_deg=8.0)
    assert lost[0] <= (depth[52:68, 72:88] == 0).mean() <= lost[1]
    if gloss:
        assert (depth[:, :30] == 0).mean() < 0.05  # away from the mirror direction


def test_a_camera_by_its_name_and_keys_of_another_kind() -> None:
    noise = NoiseTable.model_validate({"like": "D415", "bleeding_px": 1.0})
    assert (noise.subpixel_px, noise.baseline_m, noise.disparity_step_px, noise.bleeding_px) == (0.08, 0.055, 1 / 32, 1.0)
    for wrong in ({"kind": "time-of-flight", "subpixel_px": 0.1}, {"multipath": 1.0}, {"kind": "perfect", "edge_dropout": 0.1}):
        with pytest.raises(ValidationError, match="of another kind of camera"):
            NoiseTable.model_validate(wrong)
    np.testing.assert_allclose(_depth([WALL], kind="perfect"), 0.8, atol=1e-9)


def test_time_of_flight_noise_goes_as_one_over_the_amplitude() -> None:
    noise = {
        "kind": "time-of-flight",
        "multipath": 0.0,
        "mixing_px": 0.0,
        "least_signal": 0.0,
        "amplitude_std_m": 1e-3,
        "quantum_m": 1e-7,
    }
    middle = (slice(50, 70), slice(70, 90))

    def spread(z: float, albedo: float) -> float:
        shots = [_depth([_square(z, (-2.0, 2.0), albedo=albedo)], seed, **noise)[middle] for seed in range(6)]
        return float(np.std(shots))

    assert spread(1.0, 1.0) == pytest.approx(1e-3, rel=0.06)
    assert spread(0.5, 1.0) == pytest.approx(0.25e-3, rel=0.06)
    assert spread(0.5, 0.1) == pytest.approx(2.5e-3, rel=0.06)
    dim = _depth([_square(1.0, (-2.0, 2.0), albedo=0.04)], **{**noise, "least_signal": 0.05})
    assert (dim == 0).all()


def test_pixels_over_an_edge_mix_its_sides() -> None:
    noise = {
        "kind": "time-of-flight",
        "multipath": 0.0,
        "amplitude_std_m": 0.0,
        "edge_dropout": 0.0,
        "mixing_px": 0.8,
        "quantum_m": 1e-7,
    }
    depth = _depth([POST, WALL], **noise)
    between = (depth > 0.41) & (depth < 0.79)
    assert 1 <= between.sum(axis=1).mean() <= 6
    bright = _depth([_square(0.4, (-0.05, 0.05), albedo=1.0), _square(0.8, (-2.0, 2.0), albedo=0.05)], **noise)
    assert bright[between].mean() < depth[between].mean()  # more of the light is that of the post


def test_a_second_bounce_makes_corners_deeper_and_leaves_single_walls() -> None:
    sides = [
        Shape(
            np.array([[0.0, -0.5, 0.8], [x, -0.5, 0.5], [x, 0.5, 0.5], [0.0, 0.5, 0.8]]),
            np.array([[0, 1, 2], [0, 2, 3]]),
            np.ones(3),
        )
        for x in (-0.3, 0.3)
    ]
    noise = {"kind": "time-of-flight", "amplitude_std_m": 0.0, "mixing_px": 0.0, "edge_dropout": 0.0, "quantum_m": 1e-7}
    late, single = [_depth(shapes, **noise) - _depth(shapes, **noise, multipath=0.0) for shapes in (sides, sides[:1])]
    seen = _depth(sides, kind="perfect") > 0
    assert 2e-3 < late[seen].mean() < 3e-2 and late.min() > -1e-6
    np.testing.assert_allclose(single, 0.0, atol=2e-6)
    flat = look(CAMERA, POSE, [WALL])
    signal = flat.albedo * flat.facing
    np.testing.assert_allclose(second_bounce(flat, signal, np.random.default_rng(0)), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "numbers"),
    [
        ("brown_conrady", [0.1, -0.05, 1e-3, -2e-3, 0.0]),
        ("inverse_brown_conrady", [0.1, -0.05, 1e-3, 0.0, 0.0]),
        ("kannala_brandt", [0.02, -0.01, 0.0, 0.0]),
    ],
)
def test_a_lens_that_distorts_reads_back(model: str, numbers: list[float]) -> None:
    camera = camera_of(ViewTable.model_validate({**VIEW, "distortion": numbers, "distortion_model": model}))
    image = render(camera, POSE, [WALL])
    c = camera
    cloud = cloud_from_depth(np.rint(image.depth / 1e-6), c.fx, c.fy, c.cx, c.cy, c.distortion, 1e-6, distortion_model=model)
    np.testing.assert_allclose(cloud.points[:, 2], 0.8, atol=2e-6)
    v, u = np.divmod(np.arange(160 * 120), 160)
    np.testing.assert_allclose(pixels_of(camera, cloud.points), np.column_stack([u, v]), atol=2e-3)
    assert np.abs(pixels_of(CAMERA, cloud.points) - np.column_stack([u, v])).max() > 0.5
    with pytest.raises(ValidationError, match="distortion"):
        ViewTable.model_validate({**VIEW, "distortion": [0.1] * 6})


def test_the_noise_that_a_recording_declares_is_that_of_the_formula() -> None:
    noise = NoiseTable.model_validate({"subpixel_px": 0.1, "focal_px": 600.0})
    assert float(depth_std(np.array(1.0), noise, CAMERA)) == pytest.approx(0.1 / (600.0 * 0.055))
