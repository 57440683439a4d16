"""What is said of a recording beside a robot before anything is computed: tags of another dictionary, clouds in another frame."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import RECORDING_FILES, write_block_robot, write_small_recording

from femsense.app.input_checks import warn_of_tags
from femsense.app.inspect import inspect_path
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot

WIDTH, HEIGHT = 160, 120
CAMERA = f"\n[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\nfx = 130.0\nfy = 130.0\ncx = 79.5\ncy = 59.5\ndepth_unit_m = 0.001\n"


def tagged(folder: Path, dictionary: int, number: int) -> Path:
    """Write a recording whose first frame shows one tag, and depth of 0.5 m."""
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(dictionary), number, 48)
    image = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    image[36:84, 56:104] = tag[:, :, None]
    toml = RECORDING_FILES["recording.toml"] + CAMERA
    write_small_recording(folder, recording_toml=toml)
    for kind, pixels in (("depth", np.full((HEIGHT, WIDTH), 500, dtype=np.uint16)), ("color", image)):
        (folder / kind).mkdir()
        cv2.imwrite(str(folder / kind / "000000.png"), pixels)
    return folder


@pytest.mark.parametrize("declared", ["4X4_50", "5X5_50"])
def test_tags_of_another_dictionary_are_named(declared: str, tmp_path: Path) -> None:
    robot = write_block_robot(tmp_path / "robot", appearance__aruco_dictionary=declared, markers__0__aruco_id=7)
    recording = tagged(tmp_path / "r", cv2.aruco.DICT_4X4_50, 7)
    found = [text for text in inspect_path(recording, robot=robot)["warnings"] if "tags" in text]
    wanted = ["none of the tags 7 of 5X5_50", "tags of 4X4_50 with 1 of these numbers are"] if declared == "5X5_50" else []
    assert len(found) == len(wanted[:1]) and all(text in found[0] for text in wanted)


def test_a_robot_without_tags_is_not_asked_for_any(tmp_path: Path) -> None:
    recording = load_recording(tagged(tmp_path / "r", cv2.aruco.DICT_4X4_50, 7))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_tags(load_robot(write_block_robot(tmp_path / "robot")), recording)


def test_clouds_that_are_not_in_the_cameras_frame(tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path, markers_csv=None)
    (folder / "clouds").mkdir()
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 20\nHEIGHT 1\nVIEWPOINT 0 0 0.5 0 1 0 0\nPOINTS 20\nDATA ascii\n"
    (folder / "clouds" / "000000.pcd").write_text(head + "\n".join(" ".join(f"{v:.5f}" for v in p) for p in points) + "\n")
    report = inspect_path(folder)
    assert report["problems"] == []
    assert any("sensor stood at 0, 0, 0.5" in text for text in report["warnings"])
    assert any("lie behind the camera" in text for text in report["warnings"])


def clouded(folder: Path, points: np.ndarray, pose: np.ndarray) -> Path:
    toml = f"T_robot_camera = {pose.tolist()}\n" + RECORDING_FILES["recording.toml"]
    write_small_recording(folder, recording_toml=toml, markers_csv=None)
    (folder / "clouds").mkdir()
    (folder / "clouds" / "000000.xyz").write_text("\n".join(" ".join(f"{v:.6f}" for v in point) for point in points) + "\n")
    return folder


@pytest.mark.parametrize(
    ("written", "said"), [("right", None), ("inverse", "the inverse"), ("millimetres", "a translation in millimetres")]
)
def test_a_given_pose_that_leaves_no_cloud_near_the_robot_is_named(written: str, said: str | None, tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path / "robot")
    pose = make_pose(rotation_from_vector([2.0, 0.5, -0.3]), [0.1, -0.4, 0.5])
    points = transform_points(invert_pose(pose), load_robot(folder).body.mesh.nodes)
    given = invert_pose(pose) if written == "inverse" else pose
    given = make_pose(given[:3, :3], (1e3 if written == "millimetres" else 1.0) * given[:3, 3])
    recording = clouded(tmp_path / "r", points, given)
    found = [text for text in inspect_path(recording, robot=folder)["warnings"] if "near the robot" in text]
    assert (found == []) if said is None else (len(found) == 1 and said in found[0] and "is it that?" in found[0])
