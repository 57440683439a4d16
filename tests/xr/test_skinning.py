"""Skeleton and skinning: laws, a slow second implementation, refusals."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from xr_bar import bar_surface

from femsense.core.errors import InputError
from femsense.core.pose import make_pose
from femsense.fem.rotation import rotation_of
from femsense.xr.skeleton import Skeleton, farthest_points, skeleton_at
from femsense.xr.skinning import Skin, fit_poses, fit_skin, prepare_poses, rms, skin_rms, skin_vertices
from femsense.xr.skinning_kernels import simplex_least_squares


@pytest.fixture(scope="module")
def bar() -> tuple[np.ndarray, np.ndarray]:
    rest, states, _ = bar_surface()
    return rest, states


@pytest.fixture(scope="module")
def skin(bar: tuple[np.ndarray, np.ndarray]) -> Skin:
    return fit_skin(*bar, bones=8)


def random_poses(rng: np.random.Generator, frames: int) -> np.ndarray:
    return np.array([make_pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)) for _ in range(frames)])


def moved(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("fij,vj->fvi", poses[:, :3, :3], points) + poses[:, None, :3, 3]


def general_simplex(G: np.ndarray, g: np.ndarray) -> np.ndarray:
    """The same problem for a general solver."""
    k = len(g)
    total = {"type": "eq", "fun": lambda x: x.sum() - 1.0}
    found = minimize(
        lambda x: 0.5 * x @ G @ x - g @ x,
        np.full(k, 1 / k),
        jac=lambda x: G @ x - g,
        method="SLSQP",
        bounds=[(0, 1)] * k,
        constraints=total,
        options={"ftol": 1e-14},
    )
    return np.asarray(found.x)


# ---- laws -----------------------------------------------------------------------------------------------------------


def test_weights_are_a_partition_of_at_most_four(skin: Skin) -> None:
    assert skin.weights.shape == skin.joints.shape == (len(skin.rest), 4)
    assert (skin.weights >= 0).all()
    np.testing.assert_allclose(skin.weights.sum(axis=1), 1.0, atol=1e-14)
    assert (skin.joints[skin.weights == 0] == 0).all()
    for joints, weights in zip(skin.joints, skin.weights):
        used = joints[weights > 0]
        assert len(set(used)) == len(used)
    assert (skin.weight_matrix().sum(axis=1) > 0).all()  # no idle bone


@pytest.mark.parametrize("bones", [1, 2, 7])
def test_rigid_motion_is_reproduced_exactly(bar: tuple[np.ndarray, np.ndarray], bones: int) -> None:
    rest, _ = bar
    motion = random_poses(np.random.default_rng(3), 6)
    states = moved(motion, rest)
    skin = fit_skin(rest, states, bones=bones)
    poses = fit_poses(skin, states)
    assert skin_rms(skin, poses, states) < 1e-12
    for b in range(len(skin.skeleton)):
        np.testing.assert_allclose(poses[:, b], motion @ skin.skeleton.T_robot_bone[b], atol=1e-9)


def test_rest_poses_give_the_rest_shape(skin: Skin) -> None:
    np.testing.assert_allclose(skin_vertices(skin, skin.skeleton.T_robot_bone[None])[0], skin.rest, atol=1e-15)


def test_fit_moves_with_the_frame_of_reference(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    _, states = bar
    (T,) = random_poses(np.random.default_rng(5), 1)
    there = np.array([s @ T[:3, :3].T + T[:3, 3] for s in states])
    np.testing.assert_allclose(fit_poses(skin, there), T @ fit_poses(skin, states), atol=1e-7)


def test_bones_that_made_the_motion_are_found_again() -> None:
    rng = np.random.default_rng(11)
    rest, _, _ = bar_surface(2)
    height = rest[:, 2] / rest[:, 2].max()
    upper = np.clip(3.0 * height - 1.0, 0.0, 1.0)  # two bones, blended in the middle third
    origins = np.array([[0.0, 0.0, 0.03], [0.0, 0.0, 0.17]])
    weights = np.stack([1.0 - upper, upper, 0 * upper, 0 * upper], axis=1)
    truth = Skin(skeleton_at(origins), rest, np.where(weights > 0, [0, 1, 0, 0], 0), weights)
    poses = np.array(
        [
            [
                make_pose(Rotation.from_rotvec(rng.normal(size=3) * 0.4).as_matrix(), o + 0.01 * rng.normal(size=3))
                for o in origins
            ]
            for _ in range(12)
        ]
    )
    states = skin_vertices(truth, poses)
    found = fit_skin(rest, states, bones=2)
    assert skin_rms(found, fit_poses(found, states, sweeps=60), states) < 2e-4 < 0.05 * rms(states - rest)


def test_poses_are_proper_rotations(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    R = fit_poses(skin, bar[1])[..., :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert (np.linalg.det(R) > 0).all()


def test_sweeps_never_make_the_fit_worse(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    fit = prepare_poses(skin)
    for frame in bar[1][3:9]:
        errors = [skin_rms(skin, fit(frame, sweeps=n)[None], frame[None]) for n in (0, 1, 2, 4, 8, 16)]
        assert all(later <= before * (1 + 1e-9) for before, later in pairwise(errors))


def test_a_frame_far_from_the_one_before_does_not_depend_on_it(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    fit = prepare_poses(skin)
    (T,) = random_poses(np.random.default_rng(8), 1)
    there = bar[1][6] @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(fit(there, start=fit(bar[1][0]), sweeps=4), fit(there, sweeps=4), atol=1e-9)


def test_what_the_vertices_leave_open_follows_the_frame_before() -> None:
    line = np.linspace(0.0, 0.1, 6)[:, None] * [0.0, 0.0, 1.0]  # may turn about itself unseen
    joints, weights = np.zeros((6, 4), int), np.tile([1.0, 0.0, 0.0, 0.0], (6, 1))
    fit = prepare_poses(Skin(skeleton_at([[0.0, 0.0, 0.05]]), line, joints, weights))
    start = make_pose(Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix(), [0.0, 0.0, 0.05])[None]
    shift = [0.01, 0.02, 0.03]
    found = fit(line + shift, start=start)
    np.testing.assert_allclose(found[0, :3, :3], start[0, :3, :3], atol=1e-6)
    np.testing.assert_allclose(found[0, :3, 3], start[0, :3, 3] + shift, atol=1e-9)


# ---- against slow and clear implementations ----------------------------------------------------------------------------


def test_blending_against_its_definition(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    poses = fit_poses(skin, bar[1][4:6])
    for v in (0, 17, len(skin.rest) - 1):
        expected = np.zeros(4)
        for joint, weight in zip(skin.joints[v], skin.weights[v]):
            local = np.linalg.inv(skin.skeleton.T_robot_bone[joint]) @ [*skin.rest[v], 1.0]
            expected += weight * (poses[1, joint] @ local)
        np.testing.assert_allclose(skin_vertices(skin, poses)[1, v], expected[:3], atol=1e-14)


def test_poses_are_a_minimum(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    frame = bar[1][7]
    best = prepare_poses(skin)(frame, sweeps=400)
    reached = skin_rms(skin, best[None], frame[None])
    rng = np.random.default_rng(2)
    for _ in range(20):
        other = best.copy()
        b = rng.integers(len(best))
        other[b] = other[b] @ make_pose(Rotation.from_rotvec(1e-3 * rng.normal(size=3)).as_matrix(), 1e-5 * rng.normal(size=3))
        assert skin_rms(skin, other[None], frame[None]) > reached


def test_weights_against_a_general_solver() -> None:
    rng = np.random.default_rng(4)
    for k in [1, 2, 4, 7] + 30 * [9]:
        D = rng.normal(size=(3, k)) - 1.5 * rng.normal(size=(3, 1))  # from a place to points about it, most of them not needed
        G, g = D.T @ D + 1e-3 * np.eye(k), 0.01 * rng.normal(size=k)
        w = simplex_least_squares(G, g)
        assert (w >= 0).all() and np.isclose(w.sum(), 1.0)
        np.testing.assert_allclose(w, general_simplex(G, g), atol=1e-5)


def test_rotation_against_scipy_also_for_mirrored_clouds() -> None:
    rng = np.random.default_rng(9)
    for mirror in (1.0, -1.0):
        p = rng.normal(size=(20, 3))
        q = p @ Rotation.random(rng=rng).as_matrix().T * [1.0, 1.0, mirror]
        expected, _ = Rotation.align_vectors(q, p)
        R = np.empty((3, 3))
        rotation_of(p.T @ q, R)
        np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-9)


# ---- borders ----------------------------------------------------------------------------------------------------------


def test_no_motion_gives_smooth_weights_and_still_bones(bar: tuple[np.ndarray, np.ndarray]) -> None:
    rest, _ = bar
    skin = fit_skin(rest, np.repeat(rest[None], 3, axis=0), bones=6)
    poses = fit_poses(skin, rest[None])
    np.testing.assert_allclose(poses[0], skin.skeleton.T_robot_bone, atol=1e-9)
    neighbours = np.linalg.norm(rest[:, None] - rest, axis=2)
    near = np.argwhere((neighbours > 0) & (neighbours < 0.0101))
    dense = skin.weight_matrix()
    assert np.abs(dense[:, near[:, 0]] - dense[:, near[:, 1]]).max() < 0.6
    assert ((skin.weights > 1e-3).sum(axis=1) > 1).mean() > 0.5


def test_one_frame_is_enough(bar: tuple[np.ndarray, np.ndarray]) -> None:
    rest, states = bar
    skin = fit_skin(rest, states[5])
    assert skin_rms(skin, fit_poses(skin, states[5]), states[5:6]) < 0.02 * rms(states[5] - rest)


def test_fewer_vertices_than_bones() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    skin = fit_skin(rest, rest[None] + 0.1, bones=12)
    assert 1 <= len(skin.skeleton) <= 3
    np.testing.assert_allclose(skin_vertices(skin, fit_poses(skin, rest[None] + 0.1))[0], rest + 0.1, atol=1e-9)


def test_bone_count_is_chosen_on_held_out_frames() -> None:
    rest, states, _ = bar_surface(36)
    chosen = fit_skin(rest, states)
    assert 4 <= len(chosen.skeleton) <= 32
    few = fit_skin(rest, states, bones=4)
    assert skin_rms(chosen, fit_poses(chosen, states), states) < skin_rms(few, fit_poses(few, states), states)
    motion = moved(random_poses(np.random.default_rng(1), 12), rest)
    assert len(fit_skin(rest, motion).skeleton) == 4  # a rigid body needs no more than the fewest that are tried


def test_fit_repeats_bit_by_bit(bar: tuple[np.ndarray, np.ndarray]) -> None:
    one, two = (fit_skin(*bar, bones=6) for _ in range(2))
    assert (one.weights == two.weights).all() and (one.joints == two.joints).all()


def test_farthest_points_cover() -> None:
    line = np.linspace(0.0, 1.0, 101)[:, None] * [1.0, 0.0, 0.0]
    assert set(farthest_points(line, 3)) == {0, 50, 100}
    assert len(farthest_points(np.zeros((5, 3)), 4)) == 1


# ---- refusals ----------------------------------------------------------------------------------------------------------


def test_refusals_say_what_is_wrong(bar: tuple[np.ndarray, np.ndarray], skin: Skin) -> None:
    rest, states = bar
    broken = states.copy()
    broken[4, 2, 1] = np.nan
    with pytest.raises(InputError, match=r"states\[4\].*must be finite"):
        fit_skin(rest, broken)
    with pytest.raises(InputError, match="wrong shape"):
        fit_skin(rest, states[:, :-1])
    with pytest.raises(InputError, match="wrong shape"):
        fit_poses(skin, np.zeros((0, len(rest), 3)))
    with pytest.raises(InputError, match="impossible number of bones"):
        fit_skin(rest, states, bones=0)
    with pytest.raises(InputError, match="wrong bone poses"):
        skin_vertices(skin, np.zeros((1, 3, 4, 4)))
    with pytest.raises(InputError, match="sum to 1"):
        Skin(skin.skeleton, skin.rest, skin.joints, 0.5 * skin.weights)
    with pytest.raises(InputError, match="does not exist"):
        Skin(skin.skeleton, skin.rest, skin.joints + 99, skin.weights)
    with pytest.raises(InputError, match="one name a bone"):
        Skeleton(np.eye(4)[None], ("a", "b"))
