"""The same recording with more declared: its camera's pose, somewhat off, in place of what markers tell; or the law of its truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .bodies import listed


def declare_law(case: Path, folder: Path) -> Path:
    """Write a case again whose robot declares the law of the truth, neo-Hookean; return its folder."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(case / "robot", folder / "robot")
    with (folder / "robot" / "robot.toml").open("a", encoding="utf-8") as text:
        text.write('\n[[effects]]\nname = "hyperelastic"\nlaw = "neo_hookean"\n')
    (folder / "recording").symlink_to((case / "recording").resolve())
    shutil.copy(case / "truth.json", folder)
    return folder


def declare(case: Path, folder: Path, turn_deg: float, shift_m: float, seed: int) -> None:
    """Write a case again, without markers and with its pose declared: turned about the middle of the robot and shifted, each into a random direction."""
    truth = json.loads((case / "truth.json").read_text(encoding="utf-8"))
    rng = np.random.default_rng([seed, 1])
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    pose, middle = np.array(truth["T_robot_camera"]), np.mean(list(truth["markers_m"].values()), axis=0)
    R = Rotation.from_rotvec(np.radians(turn_deg) * turn).as_matrix()
    off = np.eye(4)
    off[:3, :3], off[:3, 3] = R, middle - R @ middle + shift_m * shift
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "robot").symlink_to((case / "robot").resolve())
    shutil.copy(case / "truth.json", folder)
    (folder / "recording").mkdir()
    for path in (case / "recording").iterdir():
        if path.name not in ("markers.csv", "recording.toml"):
            (folder / "recording" / path.name).symlink_to(path.resolve())
    text = (case / "recording" / "recording.toml").read_text(encoding="utf-8").split("\n")
    lines = [f"T_robot_camera = {[listed(row) for row in off @ pose]}", *(line for line in text if "marker_noise" not in line)]
    lines[0], lines[1] = lines[1], lines[0]
    (folder / "recording" / "recording.toml").write_text("\n".join(lines), encoding="utf-8")
