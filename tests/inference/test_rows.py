"""Rows of pixels: against a slow ray, and their derivatives against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm

from femsense.inference.error_field import spread_field
from femsense.inference.mixture import Others
from femsense.inference.nuisance import columns, first_nuisance, fit_nuisance, gram_of, learnt, without_poses
from femsense.inference.pixels import Pixels, Skin, pixel_rows
from femsense.inference.rows import stacked
from femsense.model.contact_patch import body_surface

BODY = arm().body
SURFACE = body_surface(BODY.mesh)
CAMERA = np.array([0.05, -0.02, 0.3])


@pytest.fixture(scope="module")
def skin() -> Skin:
    corners = BODY.mesh.nodes[SURFACE.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    size = float(np.linalg.norm(np.ptp(BODY.mesh.nodes, axis=0)))
    return Skin(SURFACE.triangles, BODY.mesh.nodes, facing, spread_field(corners.mean(axis=1), facing, size), np.zeros(3), size)


def pixels_of(points: np.ndarray) -> Pixels:
    m = len(points)
    return Pixels(points, np.tile(CAMERA, (m, 1)), np.zeros(m, dtype=np.int64), np.full(m, 1e-3), Others(0.01, 1e-5), 1.0, True)


def upper_points(offset: float) -> np.ndarray:
    """Points above the upper face of the arm [m]."""
    top = BODY.mesh.nodes[:, 2].max()
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(0.02, 0.08, 40), rng.uniform(-0.006, 0.006, 40), np.full(40, top + offset)])


@pytest.mark.parametrize("offset", [2e-3, -2e-3])
def test_the_residual_is_the_distance_along_the_normal(skin: Skin, offset: float):
    rows = pixel_rows(pixels_of(upper_points(offset)), skin, BODY.mesh.nodes, 1)
    assert rows.residual == pytest.approx(offset, abs=1e-6)
    assert rows.direction == pytest.approx(np.tile([0.0, 0.0, 1.0], (40, 1)), abs=1e-6)
    ray = upper_points(offset) - CAMERA
    assert rows.std == pytest.approx(1e-3 * np.abs(ray[:, 2]) / np.linalg.norm(ray, axis=1), rel=1e-6)


def test_a_pixel_beside_the_body_takes_its_closest_point(skin: Skin):
    side = BODY.mesh.nodes[:, 1].max()
    rows = pixel_rows(pixels_of(np.array([[0.05, side + 0.004, 0.0]])), skin, BODY.mesh.nodes, 1)
    assert rows.residual == pytest.approx([0.004], abs=1e-6) and rows.direction[0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-4)


def test_pixels_far_from_the_body_may_stay_tied_to_its_closest_point(skin: Skin):
    """Where the body bends, the rows of those near it are the same, and the others are about as far off, and still not its own."""
    far = np.array([[0.05, 0.045, 0.005], [0.02, -0.06, 0.0], [0.09, 0.0, -0.07]])
    pixels = pixels_of(np.vstack([upper_points(2e-3), far]))
    x = BODY.mesh.nodes + np.column_stack([np.zeros((len(BODY.mesh.nodes), 2)), 4e-3 * np.sin(30.0 * BODY.mesh.nodes[:, 0])])
    exact, tied = (pixel_rows(one, skin, x, 1) for one in (pixels, pixels.anchored(skin, BODY.mesh.nodes)))
    assert (exact.residual[:40] == tied.residual[:40]).all()
    assert tied.residual[40:] == pytest.approx(exact.residual[40:], rel=0.05) and (tied.residual >= exact.residual - 1e-12).all()


def test_pixels_behind_the_body_are_hardly_something_else(skin: Skin):
    front, behind = (pixel_rows(pixels_of(upper_points(d)), skin, BODY.mesh.nodes, 1).log_other for d in (2e-3, -2e-3))
    assert np.exp(behind - front) == pytest.approx(1e-3)


def test_rows_move_with_the_nodes_and_the_pose_as_their_derivatives_say(skin: Skin):
    points, step = upper_points(1e-3), 1e-6
    here = pixel_rows(pixels_of(points), skin, BODY.mesh.nodes, 1)
    bend = np.zeros_like(BODY.mesh.nodes)
    bend[:, 2] = np.sin(30.0 * BODY.mesh.nodes[:, 0])
    there = pixel_rows(pixels_of(points), skin, BODY.mesh.nodes + 1e-4 * bend, 1)
    assert there.residual - here.residual == pytest.approx(-1e-4 * here.of(bend[None])[:, 0], abs=2e-6)
    shifted = pixel_rows(pixels_of(points + step * np.array([0.0, 0.0, 1.0])), skin, BODY.mesh.nodes, 1)
    assert (shifted.residual - here.residual) / step == pytest.approx(here.by_pose[:, 5], abs=0.05)


def test_stacked_rows_are_the_rows_of_both(skin: Skin):
    first, second = (pixel_rows(pixels_of(upper_points(d)), skin, BODY.mesh.nodes, 1) for d in (1e-3, 2e-3))
    both = stacked([first, second])
    u = np.random.default_rng(1).normal(size=(2, *BODY.mesh.nodes.shape))
    assert both.of(u) == pytest.approx(np.vstack([first.of(u), second.of(u)])) and len(both) == 80


def test_contact_free_frames_teach_a_common_pose(skin: Skin):
    """Three frames that are 0.4 mm too high because of the camera: the prior of the next one expects the shift, and knows it better than before."""
    rows = [pixel_rows(pixels_of(upper_points(4e-4)), skin, BODY.mesh.nodes, 1) for _ in range(3)]
    softening = np.zeros((1, *BODY.mesh.nodes.shape))
    C = [columns(one, softening) for one in rows]
    first = first_nuisance(np.zeros(7), np.diag([1e-8] * 3 + [1e-6] * 3 + [1e-4]), len(skin.field), 1)
    grams = []
    for one, own in zip(rows, C):
        eta, _, weight = fit_nuisance(one, one.residual, own @ first.root, np.zeros(first.root.shape[1]))
        assert np.abs(one.residual - own @ first.root @ eta).max() < 2e-4
        grams.append(gram_of(one, own, weight))
    after = learnt(first, [without_poses(gram, 6, 7) for gram in grams])
    assert after.mean[5] == pytest.approx(4e-4, rel=0.1)
    assert np.sqrt((after.root[5] ** 2).sum()) < 0.3 * 1e-3


def test_each_camera_has_its_own_error_field(skin: Skin):
    """Two cameras that see one face 0.2 mm too high and too low leave nothing behind, and the model needs no error of its own."""
    points = np.vstack([upper_points(2e-4), upper_points(-2e-4)])
    pixels = replace(pixels_of(points), view=np.repeat([0, 1], 40), ray_std=np.full(80, 7e-5))
    rows = pixel_rows(pixels, skin, BODY.mesh.nodes, 2)
    C = columns(rows, np.zeros((1, *BODY.mesh.nodes.shape)))
    prior = first_nuisance(np.zeros(13), 1e-16 * np.eye(13), len(skin.field), 2)
    eta, _, _ = fit_nuisance(rows, rows.residual, C @ prior.root, np.zeros(prior.root.shape[1]))
    found = prior.root @ eta
    assert np.abs(rows.residual - C @ found).max() < 5e-5
    first, second, model = np.split(found[13:], 3)
    assert first == pytest.approx(-second, abs=1e-5) and np.abs(first).max() > 5e-5 > 10.0 * np.abs(model).max()


def test_field_weights_have_unit_norm_and_fall_off(skin: Skin):
    weights = skin.field.weights(skin.field.places, skin.field.facing)
    assert (weights**2).sum(axis=1) == pytest.approx(1.0)
    assert (weights.argmax(axis=1) == np.arange(len(skin.field))).all()
