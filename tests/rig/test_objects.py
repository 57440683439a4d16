"""Objects that press: their patches by Hertz, where they stand on the deformed body, how they move,
and what a script may not say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import block_mesh, changed, write_block_robot
from rig_scripts import SCRIPT

from femsense.core.errors import InputError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.robot import Robot
from femsense.rig.object_tables import ObjectTable
from femsense.rig.objects import object_surface, pressing
from femsense.rig.patches import LoadPatch, nearest_place, pressed_patch
from femsense.rig.plan import plan_script
from femsense.rig.scene import frame_shapes
from femsense.rig.script import check_script
from femsense.rig.simulate import run_experiment, simulate
from femsense.rig.truth import motor_inputs

MODULUS = 2e5
TOP = np.array([0.05, 0.0, 0.015])


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("block")))


def _item(**keys: Any) -> ObjectTable:
    return ObjectTable.model_validate({"name": "o", "kind": "ball", **keys})


def _pressed(force: float, **keys: Any) -> LoadPatch:
    mesh, item = block_mesh((20, 6, 6)), _item(**keys)
    place, normal = nearest_place(mesh, _middle(mesh))
    how = pressing(item, object_surface(item, Path()), place, normal, np.array([1.0, 0.0, 0.0]))
    return pressed_patch(mesh, how, force, MODULUS)


def _middle(mesh: Any) -> np.ndarray:
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    return np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), high[2]])


def _spread(patch: LoadPatch) -> np.ndarray:
    mesh = block_mesh((20, 6, 6))
    points = patch.points(mesh.nodes) - patch.place(mesh.nodes)
    return np.sqrt((patch.share[:, None] * points**2).sum(axis=0))


@pytest.mark.parametrize("force", [0.1, 0.8])
def test_a_ball_presses_as_hertz_has_it(force: float) -> None:
    """a³ = 3 F R / (4 E*)."""
    patch = _pressed(force, radius_m=0.02)
    hertz = (3.0 * force * 0.02 / (4.0 * MODULUS)) ** (1.0 / 3.0)
    assert patch.radius == pytest.approx(hertz, rel=0.08)
    assert patch.share.sum() == pytest.approx(1.0)
    mesh = block_mesh((20, 6, 6))
    np.testing.assert_allclose(patch.place(mesh.nodes), _middle(mesh), atol=3e-4)
    total = patch.spread(np.array([1.0, 2.0, 3.0]), len(mesh.nodes))
    np.testing.assert_allclose(total.sum(axis=0), [1.0, 2.0, 3.0])
    np.testing.assert_allclose((patch.weights.ravel() @ mesh.nodes[patch.triangles.ravel()]), patch.place(mesh.nodes), atol=1e-12)


def test_a_rod_presses_along_its_line_and_a_plate_where_it_lies() -> None:
    rod = _spread(_pressed(0.3, kind="rod", radius_m=0.005, length_m=0.04))
    assert rod[0] == pytest.approx(0.04 / np.sqrt(12), rel=0.1) and rod[1] < 0.2 * rod[0]
    plate = _pressed(0.3, kind="plate", size_m=[0.02, 0.01, 0.003])
    np.testing.assert_allclose(_spread(plate)[:2], np.array([0.02, 0.01]) / np.sqrt(12), rtol=0.1)
    assert plate.radius == pytest.approx(np.sqrt(0.02 * 0.01 / np.pi), rel=0.05)
    assert _pressed(1.0, kind="plate", size_m=[0.02, 0.01, 0.003]).radius == pytest.approx(plate.radius)


def test_a_mesh_presses_with_its_lowest_places(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(subdivisions=5, radius=20.0).export(tmp_path / "ball.stl")
    item = _item(kind="mesh", mesh="ball.stl", unit="mm")
    mesh = block_mesh((20, 6, 6))
    place, normal = nearest_place(mesh, _middle(mesh))
    how = pressing(item, object_surface(item, tmp_path), place, normal, np.array([1.0, 0.0, 0.0]))
    assert pressed_patch(mesh, how, 0.8, MODULUS).radius == pytest.approx(_pressed(0.8, radius_m=0.02).radius, rel=0.1)
    with pytest.raises(InputError, match=r"nothing\.stl: no such mesh"):
        object_surface(_item(kind="mesh", mesh="nothing.stl", unit="mm"), tmp_path)


SLIDE: dict[str, Any] = {
    "objects": [{"name": "ball", "kind": "ball", "radius_m": 0.01, "declared": True}],
    "contacts": [
        {
            "sweep": "b",
            "object": "ball",
            "path_m": [[0.06, 0.015, 0.03], [0.08, 0.015, 0.03]],
            "force_n": [0.0, 0.2, 0.2],
            "tangent": 0.5,
            "away_m": 0.01,
        }
    ],
    "loads": [],
    "sweeps__1__cables": {},
}


def test_an_object_comes_slides_and_stands_on_the_deformed_body(robot: Robot) -> None:
    experiment = run_experiment(robot, check_script(changed(SCRIPT, SLIDE)))
    before, first, last = experiment.frames[6:]
    assert not before.contacts and len(before.hovering) == 1 and len(first.contacts) == 1
    assert not experiment.frames[5].hovering  # in another sweep it is not there
    np.testing.assert_allclose([f.contacts[0].rest[0] for f in (first, last)], [0.07, 0.08], atol=1.5e-3)
    force, normal = first.contacts[0].force, first.contacts[0].normal
    assert np.linalg.norm(force) == pytest.approx(0.2)
    into = -(force @ normal)
    assert np.linalg.norm(force + into * normal) / into == pytest.approx(0.5) and force[0] > 0
    center = first.contacts[0].T_robot_object @ [0.0, 0.0, 0.01, 1.0]
    gap = np.linalg.norm(first.state.positions - center[:3], axis=1).min() - 0.01
    assert abs(gap) < 2e-3
    hovering = before.hovering[0].T_robot_object
    assert hovering[2, 3] - 0.03 == pytest.approx(0.01, abs=2e-3)
    shapes = frame_shapes(experiment, 7)
    assert len(shapes) == 3
    around = np.linalg.norm(shapes[1].points - center[:3], axis=1)
    assert (np.abs(around - 0.01) < 1e-6).sum() > 500  # its sphere; the rest is the stick


def test_the_recording_has_the_tool_and_the_truth_its_patch(robot: Robot, tmp_path: Path) -> None:
    two = {"left": {"eye_m": [0.05, -0.3, 0.1], "target_m": [0.05, 0.0, 0.0], "width": 64, "height": 48, "fx": 60.0}}
    two["right"] = {
        **two["left"],
        "eye_m": [0.05, 0.3, 0.15],
        "declare_pose": True,
        "declare_noise": True,
        "noise": {"like": "D415"},
    }
    script = changed(SCRIPT, {**SLIDE, "clouds": {"kind": "depth", "frames": "contact"}, "markers": {"std_m": 1e-4}})
    del script["camera"]
    folder = simulate(robot, {**script, "cameras": two}, tmp_path / "out")
    recording = load_recording(folder)
    assert recording.camera_names == ("left", "right") and [len(files) for files in recording.cloud_files] == [2] * 9
    assert [all(f is not None for f in files) for files in recording.cloud_files] == [False] * 7 + [True] * 2
    assert recording.T_robot_camera[0] is None and recording.T_robot_camera[1] is not None
    right = recording.cameras[1]
    assert right is not None and right.noise is not None and right.noise.at_1m == pytest.approx(0.08 / (60.0 * 0.055))
    assert set(recording.marker_view.tolist()) == {0, 1}
    (tool,) = recording.tools
    assert (tool.name, tool.kind, tool.radius) == ("ball", "ball", 0.01)
    rows = (folder / "truth" / "contacts.csv").read_text().splitlines()
    assert rows[0].endswith("radius_m,object") and len(rows) == 3 and rows[1].endswith(",ball")


def test_a_weight_hangs_with_its_own_weight(robot: Robot) -> None:
    weight = {
        "objects": [{"name": "w", "kind": "weight", "mass_kg": 0.02, "radius_m": 0.004}],
        "contacts": [{"sweep": "b", "object": "w", "point_m": [0.09, 0.015, 0.03]}],
        "loads": [],
    }
    experiment = run_experiment(robot, check_script(changed(SCRIPT, weight)))
    contact = experiment.frames[7].contacts[0]
    np.testing.assert_allclose(contact.force, [0.0, 0.0, -0.02 * 9.81], atol=1e-9)
    np.testing.assert_allclose(contact.T_robot_object[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)  # its stick stands upright


def test_motors_have_scales_and_play_of_their_own(robot: Robot) -> None:
    script = changed(SCRIPT, {"motors": {"backlash": 0.5}, "initial": {}, "contacts": [], "loads": []})
    done = motor_inputs(plan_script(check_script(script), robot))[:6, 0]
    np.testing.assert_allclose(done, [0.0, 0.75, 1.75, 1.75, 1.25, 0.25])  # told 0 1 2 2 1 0
    scaled = plan_script(check_script(changed(script, {"motors": {"gain_std": 0.05}})), robot)
    ratio = motor_inputs(scaled)[2] / np.maximum(scaled.commanded[2], 1e-12)
    assert 0.8 < ratio[0] < 1.2 and ratio[0] != 1.0


@pytest.mark.parametrize(
    ("changes", "texts"),
    [
        ({"contacts__0__object": "bal"}, ["contacts[0].object", "no such object", "did you mean 'ball'"]),
        ({"contacts__0__force_n": None}, ["contacts[0].force_n", "a required key is missing"]),
        ({"contacts__0__away_m": [0.1]}, ["contacts[0].away_m", "1 values", "3 values"]),
        ({"contacts__0__point_m": [0.0, 0.0, 0.0]}, ["contacts[0]", "either point_m or path_m"]),
        ({"contacts__0__direction": [0.0, 0.0, 1.0]}, ["contacts[0]", "tangent needs"]),
        ({"objects__0__length_m": 0.1}, ["objects[0]", "a ball has radius_m, stick_m"]),
        ({"objects__0__kind": "plate", "objects__0__radius_m": None}, ["objects[0]"]),
        ({"objects": [{"name": "a", "kind": "box"}]}, ["objects[0]", "a box has size_m"]),
        (
            {"cameras": {"x": {"eye_m": [1.0, 0.0, 0.0], "target_m": [0.0, 0.0, 0.0]}}},
            ["either a table [camera] or tables [cameras.NAME]"],
        ),
    ],
)
def test_a_mistake_is_named(robot: Robot, changes: dict[str, Any], texts: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        plan_script(check_script(changed(changed(SCRIPT, SLIDE), changes)), robot)
    for text in texts:
        assert text in str(caught.value)
