"""Tags and dots in images that the test renders itself: own projection, noise, things in front, and a lens that bends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.calib.from_images import find_spots
from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.model.camera import Camera
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline, Views
from femsense.model.robot import MarkerLook, Robot

W, H = 640, 480
LENS = np.array([0.08, -0.12, 0.001, -0.0007, 0.03])
PLACES = np.array([[0.0, -0.03, 0.0], [0.1, -0.03, 0.01], [0.05, 0.035, 0.02], [0.01, 0.03, -0.01], [0.09, 0.02, 0.0]])
NORMALS = np.array([[0.0, 0, 1], [0.3, 0, 1], [0.0, 0.4, 1], [-0.3, 0.2, 1], [0.2, -0.2, 1]])
SIDE = 0.024


def camera(lens: FloatArray = LENS) -> Camera:
    return Camera("", W, H, 520.0, 518.0, 322.0, 236.0, lens, 1e-4)


def painted(
    poses: tuple[FloatArray, FloatArray], kinds: list[object], lens: FloatArray, *, seed: int = 0, hidden: int = -1
) -> tuple[FloatArray, FloatArray]:
    """Return colour (H, W, 3) and depth (H, W) [m] of plane patches: a number is a tag, a triple a round dot;
    each pixel is cast by itself."""
    places, normals = poses
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(W, dtype=float), np.arange(H, dtype=float))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    K = np.array([[520.0, 0, 322], [0, 518.0, 236], [0, 0, 1]])
    rays = np.column_stack([cv2.undistortPoints(pixels[:, None], K, lens).reshape(-1, 2), np.ones(W * H)])
    color, depth = np.full((W * H, 3), 0.55), np.full(W * H, 0.7)
    for i, (place, normal, kind) in enumerate(zip(places, normals, kinds)):
        n = normal / np.linalg.norm(normal)
        x = np.cross(n, [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        y = np.cross(x, n)
        z = (place @ n) / (rays @ n)
        at = rays * z[:, None] - place
        a, b = at @ x / SIDE, at @ y / SIDE
        if isinstance(kind, int):
            on = (np.abs(a) < 0.75) & (np.abs(b) < 0.75) & (z > 0)
            shade = np.full((int(on.sum()), 3), 0.95)
            cells = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), kind, 240)
            inner = (np.abs(a[on]) < 0.5) & (np.abs(b[on]) < 0.5)
            column, row = ((a[on][inner] + 0.5) * 239).astype(int), ((b[on][inner] + 0.5) * 239).astype(int)
            shade[inner] = cells[row, column][:, None] / 255.0 * 0.9
        else:
            on = (np.hypot(a, b) < 0.3) & (z > 0)
            shade = np.tile(np.asarray(kind, dtype=float), (int(on.sum()), 1))
        color[on], depth[on] = shade, z[on]
        if i == hidden:
            cover = (np.abs(a) < 0.3) & (np.abs(b) < 0.8)
            color[cover], depth[cover] = 0.2, z[cover] - 0.05
    image = cv2.GaussianBlur(color.reshape(H, W, 3), (0, 0), 0.6) + 0.01 * rng.normal(size=(H, W, 3))
    depths = depth.reshape(H, W) * (1 + 5e-4 * rng.normal(size=(H, W)))
    depths[rng.random((H, W)) < 0.1] = 0.0
    return np.clip(image, 0, 1), depths


def front(places: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places and normals before a camera that looks along −z of theirs."""
    T = make_pose(rotation_from_vector([np.pi, 0.0, 0.0]) @ rotation_from_vector([0.1, -0.15, 0.3]), [-0.04, 0.01, 0.35])
    return transform_points(T, places), normals @ T[:3, :3].T


def tagged(kinds: list[object]) -> Robot:
    looks = tuple(
        MarkerLook(f"p{i}", kind) if isinstance(kind, int) else MarkerLook(f"p{i}", None, np.array(kind))
        for i, kind in enumerate(kinds)
    )
    names = tuple(f"p{i}" for i in range(len(kinds)))
    return replace(arm(), marker_names=names, marker_looks=looks).with_marker_points(PLACES[: len(kinds)])


RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2)


@pytest.mark.parametrize("lens", [np.zeros(5), LENS])
def test_tags_and_dots_are_lifted_to_a_tenth_of_a_millimetre(lens: FloatArray) -> None:
    kinds: list[object] = [3, 7, 11, RED, GREEN]
    places, normals = front(PLACES, NORMALS)
    color, depth = painted((places, normals), kinds, lens)
    spots = find_spots(tagged(kinds), color, depth, camera(lens))
    assert spots.allowed.sum(axis=1).tolist() == [1] * 5
    which = spots.allowed.argmax(axis=1)
    assert sorted(which.tolist()) == [0, 1, 2, 3, 4]
    assert np.linalg.norm(spots.xyz - places[which], axis=1).max() < 2.5e-4


def test_dots_of_one_colour_may_be_either_and_tags_of_others_are_left_alone() -> None:
    kinds: list[object] = [3, 7, 11, RED, RED]
    places, normals = front(PLACES, NORMALS)
    color, depth = painted((places, normals), [3, 7, 40, RED, RED], LENS)
    spots = find_spots(tagged(kinds), color, depth, camera())
    assert sorted(spots.allowed.sum(axis=1).tolist()) == [1, 1, 2, 2]


def test_hidden_tags_and_half_hidden_dots_give_none() -> None:
    kinds: list[object] = [3, 7, RED, RED, GREEN]
    places, normals = front(PLACES, NORMALS)
    for hidden, left in ((0, 4), (4, 4)):
        color, depth = painted((places, normals), kinds, LENS, hidden=hidden)
        assert len(find_spots(tagged(kinds), color, depth, camera()).xyz) == left


def test_an_unknown_dictionary_is_named() -> None:
    robot = replace(tagged([3]), aruco_dictionary="4X4")
    with pytest.raises(InputError, match="unknown dictionary of tags"):
        find_spots(robot, np.zeros((H, W, 3)), np.zeros((H, W)), camera())


def test_calibrate_reads_images_where_there_are_no_markers(tmp_path: Path) -> None:
    kinds: list[object] = [3, 7, 11, RED, RED]
    recording, _ = record(np.zeros((1, 4)))
    robot = replace(tagged(kinds), marker_share=np.zeros(5)).with_marker_points(PLACES)
    places, normals = front(PLACES, NORMALS)
    color, depth = painted((places, normals), kinds, LENS)
    files = tmp_path / "depth.png", tmp_path / "color.png"
    cv2.imwrite(str(files[0]), np.rint(depth / 1e-4).astype(np.uint16))
    cv2.imwrite(str(files[1]), np.rint(255 * color[..., ::-1]).astype(np.uint8))
    bare = make_recording(
        Timeline(recording.time_s, free=[False]),
        drives=Drives(recording.cable_names, recording.inputs),
        views=Views(cameras=[camera()], cloud_files=((files[0],),), color_files=((files[1],),)),
    )
    calibration = calibrate(robot, bare, frames=[0])
    expected = front(np.zeros((1, 3)), np.eye(3))
    found = transform_points(invert_pose(calibration.poses[0]), np.zeros((1, 3)))
    assert np.linalg.norm(found - expected[0]) < 5e-4
    assert set(calibration.marker_rms_m) == set(robot.marker_names)
