"""Bones from points: curves whose frames are known, and what a rigid motion does to them."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from femsense.core.errors import InputError
from femsense.xr.armature import (
    ArmatureOptions,
    BonePoses,
    centreline_weights,
    local_poses,
    make_armature,
    poses_from_matrices,
    rotation_minimising,
)

RADIUS, PITCH = 0.05, 0.02


def circle(points: int) -> np.ndarray:
    """Return points on a quarter of a circle in the x z plane that begins upwards, shape (points, 3)."""
    angle = np.linspace(0.0, np.pi / 2, points)
    return RADIUS * np.stack([1.0 - np.cos(angle), np.zeros(points), np.sin(angle)], axis=1)


def helix(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, tangents and Frenet normals of a helix, shape (n, 3) each."""
    c, s = np.cos(angle), np.sin(angle)
    points = np.stack([RADIUS * c, RADIUS * s, PITCH * angle], axis=1)
    tangents = np.stack([-RADIUS * s, RADIUS * c, np.full(len(angle), PITCH)], axis=1) / np.hypot(RADIUS, PITCH)
    return points, tangents, np.stack([-c, -s, np.zeros(len(angle))], axis=1)


def test_a_circle_has_its_bones_on_it_with_tangents_along_it() -> None:
    errors = []
    for points in (6, 12, 24):
        bones = make_armature(circle(points), ArmatureOptions(bones=5)).rest
        angle = (np.arange(5) + 0.5) / 5 * np.pi / 2
        exact = RADIUS * np.stack([1.0 - np.cos(angle), np.zeros(5), np.sin(angle)], axis=1)
        tangent = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
        errors.append([np.abs(bones.positions - exact).max(), np.abs(bones.T_robot_bone[:, :3, 2] - tangent).max()])
    assert errors[0][0] < 3e-4 * RADIUS and errors[-1][1] < 1e-4
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (rates[:, 0] > 3.5).all() and (rates[:, 1] > 2.5).all()  # cubic: fourth order in place, third in direction


def test_bones_are_evenly_spaced_along_the_curve_where_the_points_are_not() -> None:
    points, _, _ = helix(np.array([0.0, 0.3, 1.4, 1.7, 3.0]))
    bones = make_armature(points, ArmatureOptions(bones=200)).rest
    steps = np.linalg.norm(np.diff(bones.positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)


@pytest.mark.parametrize("planar", [True, False])
def test_in_a_plane_the_normal_is_the_tangent_turned(planar: bool) -> None:
    options = ArmatureOptions(bones=4, plane_normal=(0, 1, 0) if planar else None, start_normal=None if planar else (1, 0, 0))
    T = make_armature(circle(20), options).rest.T_robot_bone
    turned = np.stack([T[:, 2, 2], np.zeros(4), -T[:, 0, 2]], axis=1)
    np.testing.assert_allclose(T[:, :3, 0], turned, atol=1e-9)
    np.testing.assert_allclose(T[:, :3, 1], np.tile([0, 1, 0], (4, 1)), atol=1e-9)


def test_frames_do_not_turn_about_the_tangent() -> None:
    """On a helix the Frenet frame turns by torsion times length against frames that minimise rotation."""
    errors = []
    for count in (41, 81):
        angle = np.linspace(0.0, 2 * np.pi, count)
        points, tangents, frenet = helix(angle)
        normals = rotation_minimising(points, tangents, frenet[0])
        binormals = np.cross(tangents, frenet)
        turned = np.unwrap(np.arctan2((normals * binormals).sum(axis=1), (normals * frenet).sum(axis=1)))
        torsion = PITCH / (RADIUS**2 + PITCH**2)
        errors.append(np.abs(turned + torsion * np.hypot(RADIUS, PITCH) * angle).max())
        np.testing.assert_allclose((normals * tangents).sum(axis=1), 0.0, atol=1e-12)
    assert errors[0] < 1e-4 and errors[0] / errors[1] > 12  # fourth order
    straight = make_armature(np.outer(np.linspace(0, 0.1, 5), [0, 0, 1.0]), ArmatureOptions(bones=3, start_normal=(1, 0, 0)))
    np.testing.assert_allclose(straight.rest.quaternions, np.tile([0, 0, 0, 1], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(straight.rest.positions[:, 2], [1 / 60, 3 / 60, 5 / 60], atol=1e-12)


@pytest.mark.parametrize("inextensible", [False, True])
def test_a_rigid_motion_of_all_moves_the_bones_along(inextensible: bool) -> None:
    rest, _, _ = helix(np.linspace(0.0, 0.5, 7))
    now, _, _ = helix(np.linspace(0.0, 2.5, 7))
    R, shift = Rotation.from_rotvec([0.4, -1.1, 0.7]), np.array([0.2, -0.1, 0.3])
    plain = make_armature(rest, ArmatureOptions(bones=6, start_normal=(1, 0, 0), inextensible=inextensible))
    start = tuple(R.apply([1.0, 0, 0]).tolist())
    moved = make_armature(R.apply(rest) + shift, ArmatureOptions(bones=6, start_normal=start, inextensible=inextensible))
    before, after = plain(now), moved(R.apply(now) + shift)
    np.testing.assert_allclose(after.positions, before.positions @ R.as_matrix().T + shift, atol=1e-12)
    turned = R.as_matrix() @ before.T_robot_bone[:, :3, :3]
    np.testing.assert_allclose(after.T_robot_bone[:, :3, :3], turned, atol=1e-9)


def test_a_line_that_stretches_keeps_shares_and_an_inextensible_one_keeps_lengths() -> None:
    rest = np.outer(np.linspace(0, 0.1, 5), [0, 0, 1.0])
    soft, stiff = (make_armature(rest, ArmatureOptions(at_m=(0.02, 0.05, 0.1), inextensible=fixed)) for fixed in (False, True))
    np.testing.assert_allclose(soft(1.2 * rest).positions[:, 2], [0.024, 0.06, 0.12], atol=1e-12)
    np.testing.assert_allclose(stiff(1.2 * rest).positions[:, 2], [0.02, 0.05, 0.1], atol=1e-12)
    bent = stiff(1.1 * circle(15)[::-1][:5])
    steps = np.linalg.norm(np.diff(bent.positions, axis=0), axis=1)
    assert (steps <= [0.03 + 1e-12, 0.05 + 1e-12]).all() and steps[0] > 0.9 * 0.03


def test_flat_and_hierarchical_say_the_same() -> None:
    points, _, _ = helix(np.linspace(0.0, 3.0, 9))
    chain = make_armature(points)
    poses = chain.rest
    assert repr(chain).startswith("Armature(8 bones on 161.6 mm through 9 points, in space")
    local = local_poses(poses)
    assert isinstance(local, BonePoses) and len(local) == 8
    assert "8 bones from (" in repr(poses) and len(repr(poses)) < 80
    np.testing.assert_allclose(local.positions[1:, :2], 0.0, atol=0.02)
    assert (local.positions[1:, 2] > 0.9 * np.linalg.norm(local.positions[1:], axis=1)).all()  # each lies ahead of its parent
    chained = list(accumulate(local.T_robot_bone, np.matmul))
    np.testing.assert_allclose(chained, poses.T_robot_bone, atol=1e-12)
    np.testing.assert_allclose(poses_from_matrices(poses.T_robot_bone).quaternions, poses.quaternions, atol=1e-12)
    assert len(make_armature(points).skeleton) == 8


def test_a_chain_of_a_body_from_its_nodes() -> None:
    x, y, z = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5), np.linspace(0, 10, 41), indexing="ij")
    nodes = 0.01 * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    weights = centreline_weights(nodes, points=6)
    chain = weights @ nodes
    np.testing.assert_allclose(chain[1:-1], [[0, 0, 0.02], [0, 0, 0.04], [0, 0, 0.06], [0, 0, 0.08]], atol=1e-12)
    assert chain[0, 2] < 0.01 and chain[-1, 2] > 0.09
    with pytest.raises(InputError, match="no nodes near a point"):
        centreline_weights(nodes[np.abs(nodes[:, 2] - 0.05) > 0.02], points=11, axis=(0, 0, 1))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        ([[0, 0, 0]], ArmatureOptions(), "a chain needs two points"),
        ([[0, 0, 0], [0, 0, 0], [0, 0, 1]], ArmatureOptions(), "neighbours of the chain coincide"),
        ([[0, 0, 0], [0, 0, 1]], ArmatureOptions(at_m=(0.5, 2.0)), "bones must follow each other"),
        ([[0, 0, 0], [0, 0, 1]], ArmatureOptions(bones=0), "impossible number of bones"),
        ([[0, 0, 0], [0, 0, 1]], ArmatureOptions(plane_normal=(0, 0, 1)), "along the normal of its plane"),
        ([[0, 0, 0], [0, 0, 1]], ArmatureOptions(start_normal=(0, 0, 2)), "the normal lies along the chain"),
    ],
)
def test_what_makes_no_chain_is_refused(points: list[list[float]], options: ArmatureOptions, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_armature(points, options)


def test_other_points_are_refused() -> None:
    with pytest.raises(InputError, match="another number of points"):
        make_armature(circle(5))(circle(6))
