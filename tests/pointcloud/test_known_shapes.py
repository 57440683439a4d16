"""Objects of known shape are found where they stand from the side that a camera sees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from femsense.pointcloud.known_shapes import KnownShape, cylinder_shape, register
from femsense.pointcloud.rays import Surface

CAMERA = np.array([0.0, 0.0, -0.4])
NOISE = 3e-4


def angle_bracket() -> KnownShape:
    """Return an L of 30 × 40 × 15 mm."""
    flat = np.array([(0, 0), (0.03, 0), (0.03, 0.012), (0.012, 0.012), (0.012, 0.04), (0, 0.04)])
    faces = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    points = np.vstack([np.column_stack([flat, np.full(6, z)]) for z in (0.0, 0.015)])
    i, j = np.arange(6), (np.arange(6) + 1) % 6
    sides = np.vstack([np.column_stack([i, j, j + 6]), np.column_stack([i, j + 6, i + 6])])
    return KnownShape(points, np.vstack([faces[:, ::-1], faces + 6, sides]))


def surface_of(known: KnownShape, turn: np.ndarray, shift: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return places all over an object where it stands, shape (count, 3)."""
    corners = (known.points @ turn.T + shift)[known.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=area / area.sum())]
    return np.einsum("ti,tic->tc", rng.dirichlet(np.ones(3), size=count), chosen)


def seen(known: KnownShape, turn: np.ndarray, shift: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return what a camera sees of an object with noise along the rays, its standard deviation and its origins."""
    points = surface_of(known, turn, shift, 3000, rng)
    origins = np.tile(CAMERA, (len(points), 1))
    points = points[Surface(known.points @ turn.T + shift, known.triangles).cast(points, origins, reach=1e-5).index]
    ray = (points - CAMERA) / np.linalg.norm(points - CAMERA, axis=1, keepdims=True)
    return points + NOISE * rng.normal(size=(len(points), 1)) * ray, np.full(len(points), NOISE), origins[: len(points)]


@pytest.mark.parametrize(
    ("known", "core"),
    [(angle_bracket(), [0.006, 0.006, 0.0075]), (cylinder_shape(0.004, 0.06), [0.0, 0.0, 0.0])],
    ids=["bracket", "cylinder"],
)
@pytest.mark.parametrize("seed", [1, 4])
def test_an_object_is_found_with_the_side_that_is_hidden(known: KnownShape, core: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed).as_matrix(), 0.01 * rng.normal(size=3)
    cost, shape = register(known, *seen(known, turn, shift, rng))
    assert shape is not None and 0.5 < cost < 1.6
    off = np.abs(shape.distance(surface_of(known, turn, shift, 500, rng)))
    assert np.median(off) < 1e-4 and np.quantile(off, 0.95) < 4e-4
    assert shape.std_m < 1e-4
    assert shape.distance((turn @ core + shift)[None])[0] < -0.003


def test_another_object_is_not_taken_for_it() -> None:
    rng = np.random.default_rng(3)
    points = seen(angle_bracket(), Rotation.random(random_state=4).as_matrix(), np.zeros(3), rng)
    assert register(cylinder_shape(0.004, 0.06), *points)[1] is None
    assert register(cylinder_shape(0.002, 0.01), *points) == (np.inf, None)  # smaller than what is seen


def test_how_a_known_surface_is_curved() -> None:
    rng = np.random.default_rng(5)
    turn = Rotation.random(random_state=1).as_matrix()
    _, shape = register(cylinder_shape(0.01, 0.06), *seen(cylinder_shape(0.01, 0.06), turn, np.zeros(3), rng))
    assert shape is not None
    assert shape.radius_at(turn @ np.array([0.01, 0.0, 0.0]), 0.003) == pytest.approx(0.02, rel=0.2)  # mean of round and straight
    assert shape.radius_at(turn @ np.array([0.0, 0.0, 0.03]), 0.003) == np.inf
