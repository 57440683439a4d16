"""The four-leg robot and its demo recording: sound, of the declared size, and showing what they are there for."""

from __future__ import annotations

import csv
import importlib.util
import json
from types import ModuleType

import numpy as np
import pytest
from helpers import ROOT, marker_grid
from scipy.spatial import cKDTree
from triangles import distances

from femsense.core.errors import InputError
from femsense.core.pose import transform_points
from femsense.fem.cables import bend_angles
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import TetMesh, element_volumes, refined, surface_triangles, to_linear
from femsense.fem.mesh_checks import check_mesh
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.mesh_files import radius_ratio
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot
from femsense.rig.plan import plan_script
from femsense.rig.script import read_script

FOLDER = ROOT / "meshes" / "four-leg"
DEMO = FOLDER / "recordings" / "demo"


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("four-leg")


@pytest.fixture(scope="module")
def rest(robot: Robot) -> Equilibrium:
    return solve_equilibrium(robot.body)


@pytest.fixture(scope="module")
def recording(robot: Robot) -> Recording:
    return check_against(robot, load_recording(DEMO))


@pytest.fixture(scope="module")
def truth() -> dict[str, object]:
    return dict(json.loads((DEMO / "truth" / "truth.json").read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def true_markers(robot: Robot, recording: Recording) -> np.ndarray:
    grid = np.full((recording.frame_count, len(robot.marker_names), 3), np.nan)
    with (DEMO / "truth" / "markers.csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            place = [float(row[axis]) for axis in ("x_m", "y_m", "z_m")]
            grid[int(row["frame"]), robot.marker_names.index(row["marker"])] = place
    return grid


def _build() -> ModuleType:
    spec = importlib.util.spec_from_file_location("four_leg_build", FOLDER / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_mesh_is_sound(robot: Robot) -> None:
    mesh = to_linear(robot.body.mesh)
    check_mesh(mesh, "four-leg")
    quality, volumes = radius_ratio(mesh), element_volumes(mesh)
    assert 700 <= len(mesh.tets) <= 1200
    assert len(robot.body.free_map.dofs) <= 7000 and robot.body.mesh.is_quadratic
    assert quality.min() > 0.3 and np.median(quality) > 0.6
    assert volumes.min() > 0.1 * np.median(volumes)


def test_the_script_makes_a_closed_surface() -> None:
    build = _build()
    surface, legs = build.build_surface()
    assert surface.is_watertight and surface.is_winding_consistent
    assert surface.euler_number == 2 and surface.body_count == 1
    assert surface.volume == pytest.approx(148.9e-6, rel=1e-3)
    build.check_surface(surface)
    torn = surface.copy()
    torn.update_faces(np.arange(len(torn.faces)) > 0)
    with pytest.raises(InputError, match="open"):
        build.check_surface(torn)
    assert list(legs) == ["east", "north", "west", "south"]


def test_the_surface_is_the_same_after_a_quarter_turn() -> None:
    points = np.array(_build().build_surface()[0].vertices)
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert cKDTree(points).query(turned)[0].max() < 1e-12


def test_the_mesh_fills_the_surface(robot: Robot) -> None:
    surface = _build().build_surface()[0]
    mesh = to_linear(robot.body.mesh)
    assert element_volumes(mesh).sum() == pytest.approx(surface.volume, rel=0.02)
    skin = mesh.nodes[surface_triangles(mesh)]
    drawn = np.array(surface.triangles)
    for one, other in ((skin, drawn), (drawn, skin)):
        samples = np.unique(np.vstack([one.mean(axis=1), *(one[:, i] for i in range(3))]), axis=0)
        assert distances(samples, other).max() < 1e-3


def test_the_script_makes_the_table_that_is_there() -> None:
    build = _build()
    assert build.robot_document(build.build_surface()[1]) == load_robot("four-leg").document


def test_the_script_keeps_the_best_mesh_that_is_small_enough(robot: Robot) -> None:
    build = _build()
    surface, legs = build.build_surface()
    good = to_linear(robot.body.mesh)
    worse = _with_a_flatter_tet(good)
    fine = refined(good)
    assert build.unknowns(good, legs) == len(robot.body.free_map.dofs)
    meshes = iter([worse, good, fine, worse])
    assert build.best_mesh(surface, legs, tries=4, fill=lambda *_, **__: next(meshes)) is good
    with pytest.raises(InputError, match="small enough"):
        build.best_mesh(surface, legs, tries=1, fill=lambda *_, **__: fine)


def test_the_clamps_hold_the_feet_alone(robot: Robot) -> None:
    nodes = robot.body.mesh.nodes
    held = np.zeros(len(nodes), dtype=bool)
    held[robot.body.clamped] = True
    assert nodes[held, 2].max() < 7.5e-3  # the pad is 7 mm high
    assert held[nodes[:, 2] < 7e-3].all()
    for radial in ([1, 0], [0, 1], [-1, 0], [0, -1]):
        foot = held & (nodes[:, :2] @ radial > 0.05)
        assert foot.sum() > 20 and np.isclose(nodes[foot, 2].min(), 0.0, atol=1e-4)


def _with_a_flatter_tet(mesh: TetMesh) -> TetMesh:
    """The mesh with one inner node moved most of the way into a face of the tetrahedra around it."""
    inner = np.setdiff1d(mesh.tets, surface_triangles(mesh))[0]
    tet = mesh.tets[(mesh.tets == inner).any(axis=1)][0]
    nodes = mesh.nodes.copy()
    nodes[inner] += 0.7 * (mesh.nodes[tet[tet != inner]].mean(axis=0) - nodes[inner])
    return TetMesh(nodes, mesh.tets)


def test_markers_and_cables_sit_on_and_in_the_body(robot: Robot) -> None:
    assert 14 <= len(robot.marker_names) <= 20
    assert robot.markers.outside.max() < 2e-4  # fTetWild leaves the surface by up to a thousandth of the diagonal
    skin = robot.body.mesh.nodes[surface_triangles(robot.body.mesh)]
    assert distances(robot.marker_points, skin).max() < 3e-4
    assert sum(point[2] < 0.02 for point in robot.marker_points) == 4
    assert len(robot.features) == 51
    for cable in robot.body.cables:
        assert cable.path.outside.max() == 0.0
        assert 60 < np.degrees(bend_angles(cable, robot.body.mesh.nodes)[-1]) < 90


def test_it_bends_visibly(robot: Robot, rest: Equilibrium) -> None:
    tip = robot.marker_names.index("tip")
    before = robot.markers.positions(rest.positions)
    assert 2e-3 < robot.marker_points[tip, 2] - before[tip, 2] < 6e-3
    for name in robot.body.cable_names:
        pulled = solve_equilibrium(robot.body, tension={name: 1.0}, start=rest)
        move = robot.markers.positions(pulled.positions)[tip] - before[tip]
        assert 5e-3 < np.linalg.norm(move) < 15e-3
        # the hub leans away from the knee that is drawn in
        assert move @ robot.body.cables[robot.body.cable_names.index(name)].pull_point < 0


def test_the_demo_loads_and_is_small(recording: Recording, robot: Robot) -> None:
    assert recording.actuation == "tension" and recording.actuation_zero == "unknown"
    assert recording.T_robot_camera == (None,)
    assert sum(file.stat().st_size for file in DEMO.rglob("*") if file.is_file()) < 2_000_000
    assert all(file.stat().st_size < 150_000 for file in DEMO.glob("clouds/*.ply"))
    labels = list(dict.fromkeys(recording.sweep or ()))
    assert labels == ["north", "west", "south", "east", "north-east", "south-west", "touch"]
    assert recording.free is not None
    assert [label == "touch" for label in recording.sweep or ()] == (~recording.free).tolist()
    plan = plan_script(read_script(FOLDER / "demo_script.toml"), robot)
    np.testing.assert_allclose(recording.inputs, plan.commanded, atol=1e-9)


def test_the_demos_clouds_show_the_robot_and_the_probe(recording: Recording, robot: Robot, truth: dict[str, object]) -> None:
    T = np.array(truth["T_robot_camera"])
    assert recording.free is not None and robot.color_rgb is not None
    contact = int(np.flatnonzero(~recording.free)[2])
    cloud = read_frame_cloud(recording, contact)
    assert cloud is not None and cloud.colors is not None
    blue = cloud.colors[:, 2] > cloud.colors[:, 0] + 0.15
    red = cloud.colors[:, 0] > cloud.colors[:, 2] + 0.15
    assert blue.sum() > 1000 and red.sum() > 20
    with np.load(DEMO / "truth" / "states.npz") as states:
        body = states["nodes_m"][contact]
    points = transform_points(T, cloud.points[blue])
    near = ((points > body.min(axis=0) - 0.01) & (points < body.max(axis=0) + 0.01)).all(axis=1)
    assert near.mean() > 0.98  # the others fly behind its edges
    rows = list(csv.DictReader((DEMO / "truth" / "contacts.csv").open(encoding="utf-8", newline="")))
    place = np.array([[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in rows])
    assert [float(row["force_n"]) for row in rows] == pytest.approx([0.2, 0.4, 0.6, 0.8, 0.5, 0.3])
    assert (
        np.linalg.norm(transform_points(T, cloud.points[red]) - place[2], axis=1).min() < 9e-3
    )  # the place itself is under the ball


def test_the_demos_markers_are_the_truth_with_its_noise(
    recording: Recording, robot: Robot, truth: dict[str, object], true_markers: np.ndarray
) -> None:
    T = np.array(truth["T_robot_camera"])
    order = [robot.marker_names.index(name) for name in recording.marker_names]
    error = marker_grid(recording) @ T[:3, :3].T + T[:3, 3] - true_markers[:, order]
    assert np.nanstd(error) == pytest.approx(np.hypot(0.15e-3, 0.05e-3), rel=0.06)
    seen = np.isfinite(error[..., 0]).sum(axis=0)
    assert (seen >= recording.frame_count - 6).sum() >= 12


def test_friction_shows_in_the_demo(recording: Recording, robot: Robot, true_markers: np.ndarray) -> None:
    """The same tension on the way up and down: the tip is elsewhere, by much more than the noise."""
    tip = true_markers[:, robot.marker_names.index("tip")]
    sweep = np.array(recording.sweep)
    for label in ("west", "south", "east"):
        frames = np.flatnonzero(sweep == label)
        up, down = frames[0], frames[4]
        np.testing.assert_allclose(recording.inputs[up], recording.inputs[down], atol=1e-9)
        assert np.linalg.norm(tip[up] - tip[down]) > 1.5e-3
