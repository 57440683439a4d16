"""What a script puts where it cannot be is reported with the distance: floors and objects that cut the robot, contacts off its surface."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
from helpers import changed, write_block_robot
from rig_scripts import SCRIPT

from femsense.io.robot_toml import load_robot
from femsense.model.robot import Robot
from femsense.rig.camera_tables import ViewTable
from femsense.rig.scene_checks import warn_of_script
from femsense.rig.script import check_script
from femsense.rig.simulate import run_experiment

TOUCH = {"sweep": "touch", "point_m": [0.06, 0.015, 0.03], "force_n": 0.02}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("block")))


def script(**more: Any) -> dict[str, Any]:
    """Return a script of one sweep in which nothing moves, without a floor."""
    return {
        "format": "femsense-script-1",
        "sweeps": [{"label": "touch", "levels": [1.0]}],
        "camera": SCRIPT["camera"],
        "scene": {"floor_z_m": -0.5},
        "truth": {"refinements": 0, "element": "tet4", "substeps": 1},
        **more,
    }


def said(document: dict[str, Any], robot: Robot, *, run: bool = False) -> list[str]:
    """Return what is warned of a script before it runs, or when it runs."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        table = check_script(document)
        if run:
            run_experiment(robot, table)
        else:
            warn_of_script(table, robot, Path("push.toml"))
    return [str(item.message) for item in caught]


def test_a_script_where_all_is_in_its_place_says_nothing(robot: Robot) -> None:
    assert said(script(contacts=[TOUCH]), robot) == []


def test_a_floor_that_cuts_the_robot_is_reported_with_its_depth(robot: Robot) -> None:
    (text,) = said(script(scene={"floor_z_m": 0.015}), robot)
    assert (
        "the floor intersects block: at rest the body reaches 15.0 mm below scene.floor_z_m = 0.015" in text
        and "below 0.000" in text
    )
    assert said(script(scene={"floor_z_m": -0.001}), robot) == []
    sagging = said(script(scene={"floor_z_m": -0.0015}), robot, run=True)  # free at rest, and cut when its own weight bends it
    assert any("in frame 0 the body reaches" in text for text in sagging)


def test_a_contact_off_the_surface_is_reported_with_the_distance_and_the_nearest_place(robot: Robot) -> None:
    (text,) = said(script(contacts=[{**TOUCH, "point_m": [0.06, 0.015, 0.04]}]), robot)
    assert "contacts[0].point_m is 10.0 mm from the surface" in text and "[0.0600, 0.0150, 0.0300]" in text
    load = {"sweep": "touch", "point_m": [0.06, 0.015, 0.015], "force_n": [0.0, 0.0, -0.1]}
    (text,) = said(script(loads=[load]), robot)
    assert "loads[0].point_m is 15.0 mm" in text


def test_an_object_that_cuts_the_robot_is_reported_with_its_depth(robot: Robot) -> None:
    rod = {"name": "bar", "kind": "box", "size_m": [0.2, 0.02, 0.02]}
    beside = {**TOUCH, "object": "bar", "point_m": [0.1, 0.015, 0.015], "along": [0.0, 0.0, 1.0]}
    assert not [text for text in said(script(objects=[rod], contacts=[beside]), robot, run=True) if "cuts" in text]
    ball = {"name": "ball", "kind": "weight", "mass_kg": 0.002, "radius_m": 0.004, "stick_m": 0.03}
    through = {"sweep": "touch", "object": "ball", "point_m": [0.06, 0.015, 0.0]}  # it stands upright, through the body
    (text,) = [text for text in said(script(objects=[ball], contacts=[through]), robot, run=True) if "cuts" in text]
    assert "weight ball cuts" in text and "mm into block in frame 0" in text


def test_like_a_camera_sets_its_pixels_and_its_lens() -> None:
    place = {"eye_m": [0.0, -0.4, 0.2], "target_m": [0.0, 0.0, 0.0]}
    for given in ({"like": "D415"}, {"noise": {"like": "D415"}}):
        view = ViewTable.model_validate({**place, **given})
        assert (view.width, view.height) == (1280, 720) and view.fx == pytest.approx(1004.6, abs=0.1)
        assert view.noise is not None and view.noise.baseline_m == 0.055 and view.noise.shadows
    smaller = ViewTable.model_validate({**place, "like": "D415", "width": 640, "height": 360, "noise": {"subpixel_px": 0.05}})
    assert (smaller.width, smaller.height) == (640, 360) and smaller.fx == pytest.approx(502.3, abs=0.1)
    assert smaller.noise is not None and smaller.noise.subpixel_px == 0.05
    own = ViewTable.model_validate(changed({**place, "like": "D415"}, {"fx": 915.0}))
    assert own.fx == 915.0 and ViewTable.model_validate(place).width == 424
