"""robot.toml: what loads, what comes back after saving, and what each error says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import tomli_w
from helpers import DATA, block_document, block_mesh, block_surface, write_block_robot
from hypothesis import given, settings
from hypothesis import strategies as st

import femsense
from femsense.core.errors import InputError
from femsense.fem.body import make_body, tie_cable
from femsense.fem.mesh import TetMesh, element_volumes, embed_points, oriented, to_quadratic
from femsense.io.mesh_files import radius_ratio, read_tets
from femsense.io.meshing.tetrahedra import tetrahedralise
from femsense.io.robot_toml import find_robot, load_robot, robot_document, robot_names, save_robot
from femsense.model.robot import Observation, Robot, plain_actuation, spread_features

pytestmark = pytest.mark.filterwarnings("ignore:.*outside the mesh.*:UserWarning")


def rotated_block(angle: float = 0.3) -> list[list[float]]:
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.01], [0.0, 0.0, 0.0, 1.0]]


def same_robot(a: Robot, b: Robot) -> None:
    """Assert that two robots are the same, bit by bit where numbers were only copied."""
    assert (a.name, a.marker_names, a.creep) == (b.name, b.marker_names, b.creep)
    assert (a.observation.depth_scale, a.observation.depth_offset) == (b.observation.depth_scale, b.observation.depth_offset)
    for name in ("marker_points", "features", "color_rgb"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    for name in ("clamped", "clamp_nodes", "gravity", "dead_forces"):
        np.testing.assert_array_equal(getattr(a.body, name), getattr(b.body, name))
    np.testing.assert_array_equal(a.body.mesh.nodes, b.body.mesh.nodes)
    np.testing.assert_array_equal(a.body.mesh.tets, b.body.mesh.tets)
    np.testing.assert_array_equal(a.body.material.young_modulus, b.body.material.young_modulus)
    np.testing.assert_array_equal(a.body.material.poisson_ratio, b.body.material.poisson_ratio)
    assert a.body.material.density == b.body.material.density
    assert a.body.cable_names == b.body.cable_names
    for p, q in zip(a.body.cables, b.body.cables):
        np.testing.assert_allclose(p.path.positions(a.body.mesh.nodes), q.path.positions(b.body.mesh.nodes), atol=1e-15)
        np.testing.assert_array_equal(p.pull_point, q.pull_point)
        assert (p.min_tension, p.max_tension) == (q.min_tension, q.max_tension)
        assert (p.exit_direction is None) == (q.exit_direction is None)


# What loads


def test_a_robot_has_what_its_file_says(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path))
    body = robot.body
    assert robot.name == "block" and body.cable_names == ("top", "side") and robot.marker_names == ("tip", "middle", "stalk")
    np.testing.assert_allclose(body.mesh.nodes.max(axis=0), [0.1, 0.03, 0.03])
    np.testing.assert_array_equal(body.clamped, np.flatnonzero(body.mesh.nodes[:, 0] < 1e-9))
    np.testing.assert_array_equal(body.clamp_nodes, body.clamped)
    assert set(body.material.young_modulus) == {150e3} and body.material.density == 1070.0
    np.testing.assert_array_equal(body.gravity, [0, 0, -9.81])
    assert [cable.max_tension for cable in body.cables] == [5.0, np.inf]
    np.testing.assert_allclose(body.cables[1].exit_direction, [0, 0, -1])
    np.testing.assert_allclose(robot.markers.outside, [0, 0, 0.02], atol=1e-12)
    assert len(robot.features) == 12 and not set(robot.features) & set(body.clamped)
    np.testing.assert_allclose(robot.color_rgb, [0.2, 0.4, 0.8])
    assert robot.folder == tmp_path and robot.document is not None


def test_folder_and_file_are_the_same_robot(tmp_path: Path) -> None:
    write_block_robot(tmp_path)
    same_robot(load_robot(tmp_path), load_robot(tmp_path / "robot.toml"))
    same_robot(load_robot(tmp_path), load_robot(str(tmp_path)))


@pytest.mark.parametrize(("unit", "scale"), [("m", 1e3), ("cm", 1e1), ("mm", 1.0)])
def test_units_and_pose_of_the_mesh(tmp_path: Path, unit: str, scale: float) -> None:
    """The same body in another unit, moved by T_robot_mesh after the unit."""
    mesh = block_mesh()
    folder = write_block_robot(
        tmp_path,
        block=TetMesh(mesh.nodes / scale, mesh.tets),
        mesh__unit=unit,
        mesh__T_robot_mesh=[[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 0, 1]],
        cables=None,
        markers=None,
        fixed=[{"box_m": [[-1, -0.001, -1], [1, 0.001, 1]]}],
    )
    nodes = load_robot(folder).body.mesh.nodes
    np.testing.assert_allclose(nodes, mesh.nodes[:, [2, 0, 1]] + [0, 0, 0.5], atol=1e-12)


def test_a_quadratic_element_adds_nodes_that_carry_no_springs(tmp_path: Path) -> None:
    linear = load_robot(write_block_robot(tmp_path / "4"))
    quadratic = load_robot(write_block_robot(tmp_path / "10", mesh__element="tet10"))
    count = len(linear.body.mesh.nodes)
    assert quadratic.body.mesh.is_quadratic
    np.testing.assert_array_equal(quadratic.body.mesh.nodes[:count], linear.body.mesh.nodes)
    np.testing.assert_array_equal(quadratic.body.clamp_nodes, linear.body.clamped)
    assert len(quadratic.body.clamped) > len(linear.body.clamped)
    assert (quadratic.body.mesh.nodes[quadratic.body.clamped, 0] < 1e-9).all()


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_quadratic_file(tmp_path: Path, element: str) -> None:
    """Corner nodes come first whatever their order in the file; the declared mesh has the middles."""
    fine = to_quadratic(block_mesh())
    order = np.random.default_rng(1).permutation(len(fine.nodes))
    number = np.argsort(order)
    robot = load_robot(write_block_robot(tmp_path, block=TetMesh(fine.nodes[order], number[fine.tets]), mesh__element=element))
    corners = len(block_mesh().nodes)
    assert robot.body.mesh.tets[:, :4].max() == corners - 1
    assert len(robot.body.mesh.nodes) == (len(fine.nodes) if element == "tet10" else corners)
    np.testing.assert_allclose(element_volumes(robot.body.mesh).sum(), 9e-5)
    np.testing.assert_array_equal(robot.body.clamp_nodes, robot.body.clamped)


def test_a_vtu_file_with_the_ending_vtk_is_read_by_its_content(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, mesh__file="block.vtk")
    (folder / "block.vtu").rename(folder / "block.vtk")
    assert len(load_robot(folder).body.mesh.tets) == len(block_mesh().tets)


@pytest.mark.parametrize("ending", ["vtk", "msh", "mesh", "inp"])
def test_other_mesh_formats(tmp_path: Path, ending: str) -> None:
    folder = write_block_robot(tmp_path, mesh__file=f"block.{ending}")
    meshio.read(folder / "block.vtu").write(folder / f"block.{ending}")
    np.testing.assert_allclose(load_robot(folder).body.mesh.nodes, block_mesh().nodes, atol=1e-9)


def test_a_mesh_that_is_inverted_throughout_is_turned(tmp_path: Path) -> None:
    mesh = block_mesh()
    robot = load_robot(write_block_robot(tmp_path, block=TetMesh(mesh.nodes, mesh.tets[:, [1, 0, 2, 3]])))
    assert (element_volumes(robot.body.mesh) > 0).all()


def test_unused_nodes_are_dropped_with_a_warning(tmp_path: Path) -> None:
    mesh = block_mesh()
    folder = write_block_robot(tmp_path, block=TetMesh(np.vstack([[[9.0, 9.0, 9.0]], mesh.nodes]), mesh.tets + 1))
    with pytest.warns(UserWarning, match="1 nodes that belong to no tetrahedron were dropped"):
        robot = load_robot(folder)
    np.testing.assert_allclose(robot.body.mesh.nodes, mesh.nodes)


def test_the_boundary_of_a_box_counts(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path, fixed=[{"box_m": [[0.0, 0.0, 0.0], [0.0, 0.03, 0.03]]}]))
    assert len(robot.body.clamped) == 9


def test_several_boxes(tmp_path: Path) -> None:
    boxes = [{"box_m": [[x - 1e-3, 0.0, 0.0], [x + 1e-3, 0.03, 0.03]]} for x in (0.0, 0.1)]
    robot = load_robot(write_block_robot(tmp_path, fixed=boxes))
    np.testing.assert_array_equal(np.unique(robot.body.mesh.nodes[robot.body.clamped, 0]), [0.0, 0.1])


def test_a_robot_without_anything_optional(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path, gravity=None, cables=None, markers=None, features=None, appearance=None))
    assert robot.body.cables == () and robot.marker_names == () and robot.color_rgb is None
    assert robot.marker_points.shape == (0, 3) and len(robot.markers) == 0 and len(robot.features) > 0
    np.testing.assert_array_equal(robot.body.gravity, 0)


def test_cable_points_slightly_outside_warn_with_distance_and_rule(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, cables__0__path_m=[[0.1, 0.015, 0.0325]])
    with pytest.warns(UserWarning, match=r"cable 'top' has 1 of 1 points outside the mesh, up to 2\.5 mm.*nearest centre"):
        robot = load_robot(folder)
    path = robot.body.cables[0].path
    centres = robot.body.mesh.nodes[robot.body.mesh.tets].mean(axis=1)
    assert path.element[0] == np.linalg.norm(centres - [0.1, 0.015, 0.0325], axis=1).argmin()
    np.testing.assert_allclose(path.positions(robot.body.mesh.nodes), [[0.1, 0.015, 0.0325]], atol=1e-12)


def test_a_modulus_in_kpa_warns(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"material\.young_modulus_pa: 150 Pa is softer than any silicone"):
        load_robot(write_block_robot(tmp_path, material__young_modulus_pa=150.0))


def test_a_gravity_in_millimetres_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"more than ten times gravity[\s\S]*is it in mm/s²"):
        load_robot(write_block_robot(tmp_path, gravity__vector_m_s2=[0.0, 0.0, -9810.0]))


def test_a_density_in_grams_per_cubic_centimetre_warns(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"1\.07 kg/m³ is lighter than any foam; is it in g/cm³"):
        load_robot(write_block_robot(tmp_path, material__density_kg_m3=1.07))


def test_an_own_folder_with_the_name_of_a_robot_that_comes_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = sorted(robot_names())[0]
    write_block_robot(tmp_path / name)
    with pytest.warns(UserWarning, match="is used; the robot of that name in the package"):
        assert find_robot(name) == Path(name) / "robot.toml"
    (tmp_path / name / "robot.toml").unlink()
    with pytest.warns(UserWarning, match=r"of the package is used; the folder .* has no robot\.toml"):
        assert find_robot(name) == robot_names()[name] / "robot.toml"


def test_a_doubled_element_weighs_once(tmp_path: Path) -> None:
    block = block_mesh((4, 2, 2))
    folder = write_block_robot(tmp_path)
    mesh = meshio.Mesh(np.asarray(block.nodes) * 1e3, [("tetra", np.vstack([block.tets, block.tets[::2]]))])
    mesh.write(folder / "block.vtu")
    with pytest.warns(UserWarning, match="48 of 144 tetrahedra occur twice"):
        body = load_robot(folder).body
    assert body.stencil.volumes.sum() == pytest.approx(0.1 * 0.03 * 0.03)


def test_effects_act_on_the_robot_and_can_be_left_out(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, effects=[{"name": "gravity", "vector_m_s2": [0.0, 0.0, -1.0]}])
    assert load_robot(folder).body.gravity.tolist() == [0.0, 0.0, -1.0]
    assert load_robot(folder, effects=False).body.gravity.tolist() == [0.0, 0.0, -9.81]


def test_a_wrong_parameter_of_an_effect_names_the_file(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, effects=[{"name": "stiffness", "scale": 2.0}, {"name": "stiffness", "scal": 2.0}])
    with pytest.raises(InputError) as error:
        load_robot(folder)
    assert f"{folder / 'robot.toml'}: effects[1]: effect 'stiffness': unknown key" in str(error.value) and "scal" in str(
        error.value
    )
    write_block_robot(tmp_path, effects=[{"name": "stiffness", "scale": 2.0}])
    np.testing.assert_allclose(load_robot(folder).body.material.young_modulus, 300e3)


def test_names_of_the_project() -> None:
    meshes = Path(__file__).parents[2] / "meshes"
    names = sorted(folder.parent.name for folder in meshes.glob("*/robot.toml"))
    assert len(names) > 1 and robot_names() == {name: meshes / name for name in names}
    for name in names:
        assert find_robot(name) == meshes / name / "robot.toml"
    with pytest.raises(InputError) as error:
        load_robot("four-lge")
    assert f"one of: {', '.join(names)}" in str(error.value) and "did you mean 'four-leg'?" in str(error.value)


# What comes back


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_round_trip_through_another_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, element: str) -> None:
    write_block_robot(tmp_path / "a", mesh__element=element)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    robot = load_robot("a")
    monkeypatch.chdir(tmp_path / "elsewhere")
    save_robot(robot, "b")
    shutil.rmtree(tmp_path / "a")
    same_robot(robot, load_robot("b"))
    assert sorted(os.listdir("b")) == ["block.vtu", "robot.toml"]


def test_saving_over_its_own_folder_keeps_everything(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path))
    (tmp_path / "notes.txt").write_text("mine")
    save_robot(robot, tmp_path)
    same_robot(robot, load_robot(tmp_path))
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_saved_effects_replace_those_of_the_document(tmp_path: Path) -> None:
    robot = load_robot(
        write_block_robot(tmp_path / "a", effects=[{"name": "gravity", "vector_m_s2": [0, 0, -9.0]}]), effects=False
    )
    assert robot_document(robot)["effects"] == [{"name": "gravity", "vector_m_s2": [0, 0, -9.0]}]
    found = [{"name": "stiffness", "scale": np.float64(1.25)}, {"name": "cable_gain", "scale": {"top": np.float64(0.8)}}]
    save_robot(robot, tmp_path / "b", effects=found)
    document = load_robot(tmp_path / "b", effects=False).document
    assert document is not None and document["effects"] == [
        {"name": "stiffness", "scale": 1.25},
        {"name": "cable_gain", "scale": {"top": 0.8}},
    ]
    assert "effects" not in robot_document(robot, effects=[])


def python_robot(*, quadratic: bool, scattered: bool) -> Robot:
    mesh = to_quadratic(block_mesh()) if quadratic else block_mesh()
    clamped = np.flatnonzero(mesh.nodes[:, 0] < 1e-9)
    clamped = np.array([0, len(mesh.nodes) - 1]) if scattered else clamped
    cables = (
        tie_cable(
            mesh, "c", [[0.1, 0.01, 0.02], [0.05, 0.01, 0.02]], [0.0, 0.01, 0.03], exit_direction=[0, 1, 1], max_tension=4.0
        ),
    )
    body = make_body(
        mesh, young_modulus=2e5, poisson_ratio=0.4, density=900.0, clamped=clamped, cables=cables, gravity=[0, 0, -9.81]
    )
    points = np.array([[0.1, 0.015, 0.04]])
    return Robot(
        "made",
        body,
        ("tip",),
        points,
        embed_points(mesh, points),
        spread_features(body, 9),
        None,
        plain_actuation(1),
        Observation(),
    )


@pytest.mark.parametrize("quadratic", [False, True])
@pytest.mark.parametrize("scattered", [False, True])
def test_a_robot_made_in_python_round_trips(tmp_path: Path, quadratic: bool, scattered: bool) -> None:
    robot = python_robot(quadratic=quadratic, scattered=scattered)
    save_robot(robot, tmp_path / "r")
    same_robot(robot, load_robot(tmp_path / "r"))


def test_what_robot_toml_cannot_say_is_refused(tmp_path: Path) -> None:
    robot = python_robot(quadratic=False, scattered=False)
    soft = robot.with_body(robot.body.with_stiffness_scale(np.linspace(1, 2, len(robot.body.mesh.tets))))
    with pytest.raises(InputError, match="cannot say this without effects") as error:
        save_robot(soft, tmp_path / "r")
    assert "a material that varies" in str(error.value) and not (tmp_path / "r").exists()


@settings(max_examples=25, deadline=None)
@given(
    modulus=st.floats(1e3, 1e9),
    ratio=st.floats(-0.9, 0.499),
    density=st.floats(1.0, 1e5),
    angle=st.floats(-3, 3),
    point=st.tuples(*[st.floats(0.0, 0.03)] * 3),
    count=st.integers(1, 40),
)
def test_any_declared_robot_round_trips(
    tmp_path_factory: pytest.TempPathFactory,
    modulus: float,
    ratio: float,
    density: float,
    angle: float,
    point: tuple[float, float, float],
    count: int,
) -> None:
    folder = tmp_path_factory.mktemp("robot")
    write_block_robot(
        folder / "a",
        material={"young_modulus_pa": modulus, "poisson_ratio": ratio, "density_kg_m3": density},
        markers=[{"name": "m", "position_m": list(point)}],
        cables=None,
        features__count=count,
        mesh__T_robot_mesh=rotated_block(angle),
        fixed=[{"box_m": [[-0.03, -0.03, 0.0], [0.03, 0.03, 0.05]]}],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = load_robot(folder / "a")
        save_robot(robot, folder / "b")
        same_robot(robot, load_robot(folder / "b"))
    assert robot.body.material.young_modulus[0] == modulus


# Surfaces


@pytest.fixture
def surface_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("trimesh")
    monkeypatch.setenv("FEMSENSE_CACHE", str(tmp_path / "cache"))
    folder = write_block_robot(tmp_path / "robot", mesh__file="block.stl", cables=None)
    points, triangles = block_surface((100.0, 30.0, 30.0))
    meshio.Mesh(points, [("triangle", triangles)]).write(folder / "block.stl")
    return folder


def test_a_closed_surface_is_tetrahedralised_once(surface_robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    first = load_robot(surface_robot)
    assert not list(Path.cwd().iterdir())
    np.testing.assert_allclose(element_volumes(first.body.mesh).sum(), 9e-5, rtol=0.02)
    assert len(list(surface_robot.glob("*.tets.npz"))) == 1 and not list(surface_robot.glob(".part-*"))
    (kept,) = surface_robot.glob("*.tets.npz")
    made = kept.stat()
    same_robot(first, load_robot(surface_robot))
    assert (kept.stat().st_mtime_ns, kept.stat().st_ino) == (made.st_mtime_ns, made.st_ino)
    save_robot(first, surface_robot.parent / "saved")
    same_robot(first, load_robot(surface_robot.parent / "saved"))


def test_a_kept_mesh_that_is_broken_is_made_again(surface_robot: Path) -> None:
    load_robot(surface_robot)
    (kept,) = surface_robot.glob("*.tets.npz")
    kept.write_bytes(kept.read_bytes()[:100])
    robot = load_robot(surface_robot)
    same_robot(robot, load_robot(surface_robot))


def test_a_crash_of_the_mesher_is_a_clear_error() -> None:
    with pytest.raises(InputError, match="fTetWild failed on this surface") as error:
        tetrahedralise(*block_surface(), program="import os; os.abort()")
    assert "exit status -6" in str(error.value)


def test_another_surface_is_another_mesh(surface_robot: Path) -> None:
    load_robot(surface_robot)
    points, triangles = block_surface((100.0, 40.0, 30.0))
    meshio.Mesh(points, [("triangle", triangles)]).write(surface_robot / "block.stl")
    np.testing.assert_allclose(element_volumes(load_robot(surface_robot).body.mesh).sum(), 12e-5, rtol=0.02)


def test_an_open_surface_is_refused(surface_robot: Path) -> None:
    points, triangles = block_surface((100.0, 30.0, 30.0))
    meshio.Mesh(points, [("triangle", triangles[:-1])]).write(surface_robot / "block.stl")
    with pytest.raises(InputError, match="the surface is not closed") as error:
        load_robot(surface_robot)
    assert "3 edges with one triangle" in str(error.value) and "robot.toml: mesh.file block.stl" in str(error.value)


# What is wrong

BAD_TABLES: list[tuple[dict[str, Any], str, list[str]]] = [
    ({"material__young_modulus": 1.0}, "material.young_modulus", ["unknown key", "did you mean 'young_modulus_pa'?"]),
    ({"colour": 1}, "colour", ["unknown key", "material"]),
    ({"cables__1__max_tension": 5.0}, "cables[1].max_tension", ["unknown key", "'max_tension_n'"]),
    ({"mesh__unit": None}, "mesh.unit", ["a required key is missing", '"m", "cm" or "mm"']),
    ({"mesh__unit": "inch"}, "mesh.unit", ["'inch'", '"m", "cm" or "mm"']),
    ({"mesh__element": "hex8"}, "mesh.element", ["'hex8'", '"tet4" or "tet10"']),
    ({"mesh": None}, "mesh", ["a required key is missing", "[mesh]"]),
    ({"format": "femsense-robot-2"}, "format", ["'femsense-robot-2'", 'format = "femsense-robot-1"']),
    ({"name": None}, "name", ["a required key is missing"]),
    ({"material__young_modulus_pa": -1.0}, "material.young_modulus_pa", ["greater than 0", "-1.0", "pascal"]),
    ({"material__young_modulus_pa": "150 kPa"}, "material.young_modulus_pa", ["valid number", "'150 kPa'", "pascal"]),
    ({"material__young_modulus_pa": float("nan")}, "material.young_modulus_pa", ["nan"]),
    ({"material__poisson_ratio": 0.5}, "material.poisson_ratio", ["less than 0.5", "0.49"]),
    ({"material__density_kg_m3": 0.0}, "material.density_kg_m3", ["greater than 0"]),
    ({"gravity__vector_m_s2": [0.0, -9.81]}, "gravity.vector_m_s2", ["at least 3 items", "[0.0, -9.81]"]),
    ({"gravity__vector_m_s2": [0.0, 0.0, float("inf")]}, "gravity.vector_m_s2[2]", ["finite", "inf"]),
    ({"fixed": None}, "fixed", ["a required key is missing", "a body without a clamp"]),
    ({"fixed": []}, "fixed", ["at least 1 item", "a body without a clamp"]),
    ({"fixed__0__box_m": [[0, 0, 0]]}, "fixed[0].box_m", ["at least 2 items", "two corners"]),
    ({"fixed__0__box_m": [[0.1, 0, 0], [0, 1, 1]]}, "fixed[0].box_m", ["not in order"]),
    ({"cables__0__path_m": []}, "cables[0].path_m", ["at least 1 item"]),
    ({"cables__1__path_m": [[0.1, "a", 0]]}, "cables[1].path_m[0][1]", ["valid number", "'a'", "far end first"]),
    ({"cables__0__pull_point_m": None}, "cables[0].pull_point_m", ["a required key is missing", "metres"]),
    ({"cables__1__name": "top"}, "cables[1].name", ["a name occurs twice", "cables[0] has it too"]),
    ({"cables__1__name": "a,b"}, "cables[1].name", ["'a,b'", "without commas"]),
    ({"cables__0__min_tension_n": 9.0}, "cables[0].min_tension_n", ["above the largest", "min 9.0 N, max 5.0 N"]),
    ({"cables__1__exit_direction": [0, 0, 0]}, "cables[1].exit_direction", ["has no length"]),
    ({"markers__2__name": "tip"}, "markers[2].name", ["a name occurs twice"]),
    ({"markers__0__position_m": [1e3, 0, 0]}, "markers[0].position_m", ["marker 'tip' is far from the body", "millimetres"]),
    ({"features__count": 0}, "features.count", ["greater than or equal to 1"]),
    ({"features__count": True}, "features.count", ["valid integer"]),
    ({"appearance__color_rgb": [0.1, 0.2, 200]}, "appearance.color_rgb[2]", ["less than or equal to 1", "from 0 to 1"]),
    ({"effects": [{"name": "cable_fricton"}]}, "effects[0].name", ["unknown effect", "did you mean 'cable_friction'?"]),
    ({"effects": [{"coefficient": 1}]}, "effects[0].name", ["a required key is missing", "cable_friction"]),
    ({"chambers": [{"name": "a", "seed_m": [0, 0, 0]}]}, "chambers[0].max_pressure_pa", ["a required key is missing", "pascal"]),
    (
        {"mesh__T_robot_mesh": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "mesh.T_robot_mesh",
        ["not a rigid transform"],
    ),
    ({"mesh__T_robot_mesh": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "mesh.T_robot_mesh", ["at least 4 items", "4 rows of 4 numbers"]),
    ({"mesh__file": "blok.vtu"}, "mesh.file", ["no such mesh file", "did you mean 'block.vtu'?"]),
    ({"mesh__unit": "m"}, "mesh.unit", ["unlikely size", "100 m across with unit = 'm'", "unit = 'mm' gives 0.1 m"]),
    (
        {"fixed__0__box_m": [[-0.1, 0, 0], [-0.05, 0.03, 0.03]]},
        "fixed[0].box_m",
        ["no node of the mesh is inside the box", "50 mm away", "from [0, 0, 0] m to [0.1, 0.03, 0.03] m"],
    ),
    ({"fixed__0__box_m": [[-15, -15, -40], [-1, 15, 10]]}, "fixed[0].box_m", ["no node of the mesh", "looks like millimetres"]),
    ({"fixed__0__box_m": [[-1, -1, -1], [1, 1, 1]]}, "fixed", ["the boxes hold every node"]),
    (
        {"cables__0__path_m": [[0.1, 0.015, 0.03], [0.05, 0.015, 0.09]]},
        "cables[0].path_m",
        ["point 1 of cable 'top' is far outside the body", "60 mm outside", "0.25 ×"],
    ),
    ({"cables__0__path_m": [[100.0, 15.0, 30.0]]}, "cables[0].path_m", ["far outside the body", "millimetres"]),
    ({"cables__0__pull_point_m": [0.0, 15.0, 40.0]}, "cables[0].pull_point_m", ["far from the body", "millimetres"]),
]


@pytest.mark.parametrize(
    ("overrides", "key", "texts"), BAD_TABLES, ids=lambda value: next(iter(value)) if isinstance(value, dict) else None
)
def test_one_clear_error(tmp_path: Path, overrides: dict[str, Any], key: str, texts: list[str]) -> None:
    folder = write_block_robot(tmp_path, **overrides)
    with pytest.raises(InputError) as error:
        load_robot(folder)
    message = str(error.value)
    assert f"{folder / 'robot.toml'}: {key}" in message.splitlines()[0]
    for text in texts:
        assert text in message
    assert "pydantic" not in message and "Traceback" not in message


def test_a_syntax_error_says_line_and_column(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    (folder / "robot.toml").write_text('format = "femsense-robot-1"\nname = four-leg\n')
    with pytest.raises(InputError, match="not valid TOML") as error:
        load_robot(folder)
    assert "line 2, column 8" in str(error.value)


def test_a_byte_order_mark_is_accepted_and_another_encoding_is_not(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    text = tomli_w.dumps(block_document(name="Flügel"))
    (folder / "robot.toml").write_bytes(text.encode("utf-8-sig").replace(b"\n", b"\r\n"))
    assert load_robot(folder).name == "Flügel"
    (folder / "robot.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="not a UTF-8 text file"):
        load_robot(folder)


def test_a_folder_without_robot_toml(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(InputError, match=r"the folder has no robot\.toml") as error:
        load_robot(tmp_path)
    assert "a.txt" in str(error.value)


def bad_mesh(kind: str) -> TetMesh:
    mesh = block_mesh()
    if kind == "partly inverted":
        tets = mesh.tets.copy()
        tets[3] = tets[3][[1, 0, 2, 3]]
        return TetMesh(mesh.nodes, tets)
    if kind == "two parts":
        return TetMesh(
            np.vstack([mesh.nodes, mesh.nodes + np.array([0.2, 0, 0])]), np.vstack([mesh.tets, mesh.tets + len(mesh.nodes)])
        )
    if kind == "flat":
        return TetMesh(
            np.vstack([mesh.nodes, mesh.nodes[mesh.tets[0, :3]].mean(axis=0)]),
            np.vstack([mesh.tets, [*mesh.tets[0, :3], len(mesh.nodes)]]),
        )
    fine = to_quadratic(mesh)
    return TetMesh(fine.nodes, fine.tets[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]])


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("partly inverted", "inverted tetrahedra"),
        ("two parts", "the mesh falls into separate parts"),
        ("flat", "tetrahedra without volume"),
        ("middles", "mid-edge nodes that are not in the middle of their edges"),
    ],
)
def test_bad_meshes(tmp_path: Path, kind: str, text: str) -> None:
    folder = write_block_robot(tmp_path, block=bad_mesh(kind))
    with pytest.raises(InputError, match=text) as error:
        load_robot(folder)
    assert "robot.toml: mesh.file block.vtu" in str(error.value)


@pytest.mark.parametrize("content", [b"", b"not a mesh", b'<?xml version="1.0"?><VTKFile type="UnstructuredGrid"><broken'])
@pytest.mark.parametrize("name", ["block.vtu", "block.vtk", "block.msh", "block.stl", "block.txt"])
def test_files_that_are_no_mesh(tmp_path: Path, name: str, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_block_robot(tmp_path, mesh__file=name)
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=r"not readable as a|has no triangles|has no tetrahedra") as error:
        load_robot(folder)
    assert f"mesh.file {name}" in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_hexahedra_are_refused(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path)
    cube = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float) * 100
    meshio.Mesh(cube, [("hexahedron", [list(range(8))])]).write(folder / "block.vtu")
    with pytest.raises(InputError, match="elements that femsense does not compute with") as error:
        load_robot(folder)
    assert "hexahedron" in str(error.value)


# Meshes


def test_the_radius_ratio_of_a_regular_tetrahedron_is_one_and_falls_with_flatness() -> None:
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    mesh = oriented(TetMesh(regular, [[0, 1, 2, 3]]))
    np.testing.assert_allclose(radius_ratio(mesh), 1.0)
    corner = oriented(TetMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]]))  # r = 1/(3 + √3), R = √3/2
    np.testing.assert_allclose(radius_ratio(corner), 3 / (3 + np.sqrt(3)) / (np.sqrt(3) / 2))
    np.testing.assert_allclose(radius_ratio(TetMesh(7 * corner.nodes, corner.tets)), radius_ratio(corner))
    flat = oriented(TetMesh(regular * [1, 1, 1e-3], [[0, 1, 2, 3]]))
    assert radius_ratio(flat) < 5e-3


def test_the_block_of_the_helpers_is_a_sound_mesh() -> None:
    mesh = block_mesh((3, 2, 1), (0.3, 0.2, 0.1), start=(1.0, 0.0, 0.0))
    assert (element_volumes(mesh) > 0).all() and len(mesh.tets) == 36
    np.testing.assert_allclose(element_volumes(mesh).sum(), 0.006)
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [1, 0, 0])


def test_nothing_heavy_is_imported() -> None:
    code = (
        "import sys, femsense.io.robot_toml, femsense.io.recording_folder, femsense.app.inspect; print([m for m in "
        "('open3d', 'cv2', 'meshio', 'trimesh', 'pytetwild', 'matplotlib') if m in sys.modules])"
    )
    root = str(Path(femsense.__file__).parents[1])
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": root}, check=True
    )
    assert result.stdout.strip() == "[]"


# Real robots

REAL = {  # folder: (name, nodes of the file, tetrahedra, cables, markers)
    "beam/robot": ("silicone-beam", 1029, 4320, 0, 6),
    "beam/robot_gravity": ("silicone-beam-gravity", 1029, 4320, 0, 6),
    "diamond": ("diamond", 1628, 4147, 4, 1),
    "finger": ("finger", 158, 389, 1, 0),
    "hammer/robot": ("hammer-moldstar", 534, 1750, 0, 0),
}


@pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the repository")
@pytest.mark.parametrize("place", REAL)
def test_real_robots_load_and_round_trip(tmp_path: Path, place: str) -> None:
    robot = load_robot(DATA / place)
    name, nodes, tets, cables, markers = REAL[place]
    assert robot.name == name and len(robot.body.cables) == cables and len(robot.marker_names) == markers
    assert len(read_tets(next((DATA / place).glob("*.vtu"))).nodes) == nodes and len(robot.body.mesh.tets) == tets
    save_robot(robot, tmp_path / "copy")
    same_robot(robot, load_robot(tmp_path / "copy"))


@pytest.mark.skipif(not DATA.is_dir(), reason="no real data beside the repository")
def test_the_cables_of_the_diamond_lie_slightly_outside() -> None:
    with pytest.warns(UserWarning, match=r"cable 'west' has 1 of 1 points outside the mesh, up to 0\.317 mm"):
        robot = load_robot(DATA / "diamond")
    np.testing.assert_allclose(
        [cable.path.outside[0] for cable in robot.body.cables], [1.1e-6, 317e-6, 172e-6, 267e-6], atol=1e-6
    )
