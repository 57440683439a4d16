"""Which forces a camera resolves: how the bound goes with noise, place and camera; words, table, mesh and picture of it."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import changed, write_block_robot

from femsense.core.errors import DataError
from femsense.io.robot_toml import load_robot
from femsense.model.robot import Robot
from femsense.rig.camera import Shape, camera_of, render
from femsense.rig.camera_tables import NoiseTable, ViewTable
from femsense.rig.force_map import ForceMap, Unknowns, force_map, neighbours
from femsense.rig.force_map_files import force_document, force_text, write_force_map
from femsense.rig.script import check_script

SCRIPT: dict[str, Any] = {
    "format": "femsense-script-1",
    "sweeps": [{"label": "a", "cables": {"top": 0.5}, "levels": [0.0, 1.0]}],
    "camera": {"width": 160, "height": 120, "fx": 150.0, "eye_m": [0.05, -0.25, 0.12], "target_m": [0.05, 0.0, 0.0], "noise": {}},
    "clouds": {"kind": "ply"},
    "scene": {"floor_z_m": -0.05},
}
SURE = Unknowns(places=24, turn_rad=1e-9, shift_m=1e-9, modulus=1e-9, force_n=1e3)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("block")))


def _map(robot: Robot, changes: dict[str, Any], unknowns: Unknowns = SURE) -> ForceMap:
    return force_map(robot, check_script(changed(SCRIPT, changes)), unknowns=unknowns)


def test_the_bound_goes_with_the_noise_and_with_the_compliance(robot: Robot) -> None:
    once, twice = (_map(robot, {"camera__noise": {"subpixel_px": px}}) for px in (0.08, 0.16))
    np.testing.assert_allclose(twice.normal_std / once.normal_std, 2.0, rtol=0.02)
    top = np.isclose(once.rest[:, 2], once.rest[:, 2].max()) & (once.rest[:, 0] < 0.09)
    far, near = once.rest[top, 0].argmax(), once.rest[top, 0].argmin()
    assert once.normal_std[top][far] < 0.5 * once.normal_std[top][near]  # a beam yields more at its free end
    assert 0 < once.visible.sum() < len(once.visible)
    front, back = (
        np.isclose(once.rest[:, 1], end) & (once.rest[:, 0] < 0.09) for end in (once.rest[:, 1].min(), once.rest[:, 1].max())
    )
    inner = once.rest[:, 2] < once.rest[:, 2].max() - 1e-6
    assert once.visible[front].any() and not once.visible[back & inner].any()


def test_what_is_not_known_beside_a_force_costs(robot: Robot) -> None:
    sure = _map(robot, {})
    for unknown in ({"turn_rad": 5e-3, "shift_m": 2e-3}, {"modulus": 0.3}):
        unsure = _map(
            robot,
            {},
            Unknowns(**{**{k: getattr(SURE, k) for k in ("places", "turn_rad", "shift_m", "modulus", "force_n")}, **unknown}),
        )
        assert (
            unsure.normal_std >= sure.normal_std * (1 - 1e-9)
        ).all() and unsure.normal_std.max() > 1.02 * sure.normal_std.max()
    known = _map(robot, {}, Unknowns(places=24, force_n=0.01))
    assert known.normal_std.max() <= 0.01 * (1 + 1e-9)


def test_two_cameras_resolve_more_than_one(robot: Robot) -> None:
    view = SCRIPT["camera"]
    both = {k: v for k, v in SCRIPT.items() if k != "camera"} | {
        "cameras": {"a": view, "b": {**view, "eye_m": [0.05, 0.3, 0.12]}}
    }
    two = force_map(robot, check_script(both), unknowns=SURE)
    one = _map(robot, {})
    assert (two.normal_std < one.normal_std).all() and two.visible.sum() > one.visible.sum()


def test_neighbours_that_err_together_count_as_one() -> None:
    """Variance of the mean of a large square beside that of pixels that err alone."""
    noise = NoiseTable.model_validate({"correlated_share": 0.5, "correlation_px": 2.0, "quantum_m": 1e-8})
    view = ViewTable.model_validate(
        {
            "width": 240,
            "height": 240,
            "fx": 300.0,
            "T_robot_camera": np.eye(4).tolist(),
            "noise": noise.model_dump(include={"correlated_share"}),
        }
    )
    wall = Shape(
        np.array([[-9.0, -9, 0.5], [9, -9, 0.5], [9, 9, 0.5], [-9, 9, 0.5]]), np.array([[0, 2, 1], [0, 3, 2]]), np.ones(3)
    )
    rng = np.random.default_rng(0)
    shots = np.array([render(camera_of(view), np.eye(4), [wall], noise=noise, rng=rng).depth - 0.5 for _ in range(12)])
    means = shots.reshape(12, 6, 40, 6, 40).mean(axis=(2, 4))
    assert means.var() * 1600 / shots.var() == pytest.approx(neighbours(noise), rel=0.2)
    assert neighbours(None) == 1.0


def test_it_is_said_in_words_and_files(robot: Robot, tmp_path: Path) -> None:
    found = _map(robot, {})
    document, text = force_document(found), force_text(found)
    assert document["seen"]["count"] + document["hidden"]["count"] == document["places"] == len(found.nodes)
    assert document["best"]["std_n"] == found.normal_std.min() and "seen by a camera" in text and "out of sight" in text
    files = write_force_map(found, tmp_path, np.eye(4))
    assert [file.name for file in files] == ["forces.csv", "forces.glb", "forces.png"]
    with files[0].open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_allclose([float(r["normal_std_n"]) for r in rows], found.normal_std, atol=1e-8)
    import trimesh

    (mesh,) = trimesh.load(files[1]).geometry.values()
    assert mesh.visual.kind == "vertex" and len(np.unique(mesh.visual.vertex_colors, axis=0)) > 10
    assert files[2].read_bytes().startswith(b"\x89PNG") and files[2].stat().st_size > 10_000
    at = found.over_nodes()[found.nodes]
    np.testing.assert_allclose(at, found.normal_std, rtol=1e-3)


def test_a_frame_that_is_not_there_and_a_camera_that_looks_away(robot: Robot) -> None:
    with pytest.raises(DataError, match="frames 0 … 1, not 7"):
        force_map(robot, check_script(SCRIPT), frame=7)
    with pytest.raises(DataError, match="no camera sees the robot"):
        _map(robot, {"camera__target_m": [0.05, -1.0, 0.12]})
