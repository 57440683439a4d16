"""femsense mesh: from a surface file to a robot that loads, and what is refused with which words."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers import block_mesh, write_block_robot

from femsense.app import cli
from femsense.core.errors import InputError
from femsense.fem.chambers import chamber_volume
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import TetMesh, element_volumes, surface_triangles, to_linear
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing import tetrahedra
from femsense.io.meshing.cad_filling import fill_cad
from femsense.io.meshing.filling import fill
from femsense.io.meshing.options import MeshOptions
from femsense.io.meshing.robot_from_surface import mesh_into, read_any_surface, starter_text
from femsense.io.meshing.surface import repaired
from femsense.io.robot_toml import load_robot

MM = MeshOptions(unit="mm", most_tets=1200)
BOX = trimesh.creation.box((100, 30, 30))


def stl_bytes(corners: np.ndarray) -> bytes:
    """Return a binary STL file of triangles, shape (t, 3, 3)."""
    record = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    record["corners"] = corners
    return bytes(80) + len(corners).to_bytes(4, "little") + record.tobytes()


def write_box(path: Path, extents: tuple[float, float, float] = (100, 30, 30)) -> Path:
    box = trimesh.creation.box(extents)
    box.apply_translation(np.array(extents) / 2)
    box.export(path)
    return path


class Blocks:
    """A mesher in place of fTetWild that fills a box with blocks; its calls are listed."""

    def __init__(self) -> None:
        self.calls: list[dict[str, Any]] = []

    def __call__(self, points: np.ndarray, triangles: np.ndarray, **options: Any) -> TetMesh:
        self.calls.append(options)
        edge = options["edge_fraction"] * np.linalg.norm(np.ptp(points, axis=0))
        cells = np.maximum(np.round(np.ptp(points, axis=0) / edge), 1).astype(int)
        return block_mesh(cells, np.ptp(points, axis=0), start=points.min(axis=0))


@pytest.fixture
def quick() -> Blocks:
    return Blocks()


def made_before(*meshes: TetMesh) -> Callable[..., TetMesh]:
    """Return a mesher that gives these, one after the other."""
    left = iter(meshes)
    return lambda *_, **__: next(left)


def quiet(_: str) -> None: ...


# With fTetWild


def test_a_chamber_stays_hollow_and_the_robot_bends(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Both shells face outwards, as some programs write them; two triangles are missing, some are turned."""
    chamber = trimesh.creation.box((60, 12, 12))
    body = trimesh.util.concatenate([trimesh.creation.box((100, 30, 30)).subdivide().subdivide(), chamber])
    faces = np.delete(np.array(body.faces), [5], axis=0)
    faces[::7] = faces[::7, ::-1]
    trimesh.Trimesh(body.vertices, faces, process=False).export(tmp_path / "body.stl")
    arguments = [
        "mesh",
        tmp_path / "body.stl",
        "-o",
        tmp_path / "robot",
        "--unit",
        "mm",
        "--max-tets",
        "1500",
        "--close-holes",
        "--json",
    ]
    assert cli.run([str(a) for a in arguments]) == 0
    report = json.loads(capfd.readouterr().out)
    said = " ".join(report["done"])
    assert "triangles were turned" in said and "1 holes were closed" in said and "1 inner shells are kept as cavities" in said
    robot = load_robot(tmp_path / "robot")
    mesh = to_linear(robot.body.mesh)
    assert element_volumes(mesh).sum() == pytest.approx(90e-6 - 8.64e-6, rel=0.02)
    inner = np.abs(mesh.nodes).max(axis=1) < 0.0145
    assert inner.any()  # the walls of the chamber
    edges = len(np.unique(np.sort(surface_triangles(mesh)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    assert len(np.unique(surface_triangles(mesh))) - edges + len(surface_triangles(mesh)) == 4  # two spheres (Euler)
    assert report["quality"]["tetrahedra"] == len(mesh.tets) <= 1500 and report["deviation_mm"] < report["tolerance_mm"] * 1.5
    assert solve_equilibrium(robot.body).converged
    toml = tmp_path / "robot/robot.toml"  # what it says of the chamber holds once it is no comment any more
    text = re.sub(r"# (\[\[chambers\]\]\n)# (name.*\n)# (seed_m.*\n)# (max.*\n)", r"\1\2\3\4", toml.read_text())
    toml.write_text(text)
    chamber = load_robot(tmp_path / "robot").body.chambers[0]
    assert chamber_volume(chamber, robot.body.mesh.nodes) == pytest.approx(8.64e-6, rel=0.02)


def test_shells_that_cross_are_filled_as_one(tmp_path: Path) -> None:
    post = trimesh.creation.box((20, 20, 60))
    post.apply_translation([10, 0, 20])
    both = trimesh.util.concatenate([trimesh.creation.box((100, 30, 30)), post])
    filled = fill(np.array(both.vertices), np.array(both.faces), MM)
    assert element_volumes(filled.mesh).sum() == pytest.approx(90e-6 + 20 * 20 * 35e-9, rel=0.02)
    assert any("triangles intersect others" in note for note in filled.done)


# The folder


def test_the_new_robot_loads_and_says_what_is_guessed(tmp_path: Path, quick: Blocks) -> None:
    report = mesh_into(tmp_path / "my robot", write_box(tmp_path / "block.stl"), MM, say=quiet, mesher=quick)
    robot = load_robot(tmp_path / "my robot")
    text = (tmp_path / "my robot" / "robot.toml").read_text()
    assert robot.name == "my-robot" and robot.body.mesh.is_quadratic and "block.stl" in text and "GUESSED" in text
    held = robot.body.mesh.nodes[robot.body.clamped]
    assert held[:, 2].max() < 0.002 and (robot.body.mesh.nodes[:, 2].min() == held[:, 2].min())
    np.testing.assert_allclose(np.ptp(robot.body.mesh.nodes, axis=0), [0.1, 0.03, 0.03])
    assert report["robot"] == {
        "folder": str(tmp_path / "my robot"),
        "mesh_file": "mesh.vtu",
        "unit": "mm",
        "robot_toml": "written",
    }
    assert json.loads((tmp_path / "my robot" / "mesh.json").read_text()) == json.loads(json.dumps(report))


def test_the_examples_in_the_new_robot_work_once_they_are_uncommented(tmp_path: Path, quick: Blocks) -> None:
    mesh_into(tmp_path / "robot", write_box(tmp_path / "block.stl"), MM, say=quiet, mesher=quick)
    file = tmp_path / "robot" / "robot.toml"
    file.write_text(re.sub(r"^# (?=\[|\w+ = )", "", file.read_text(), flags=re.MULTILINE))
    robot = load_robot(tmp_path / "robot")
    assert robot.body.cable_names == ("cable-1",) and robot.marker_names == ("top",) and robot.color_rgb is not None
    assert robot.body.cables[0].path.outside.max() == 0.0 and robot.markers.outside.max() < 1e-6
    assert solve_equilibrium(robot.body, tension={"cable-1": 0.05}).converged


def test_the_lowest_slab_holds_a_body_that_stands_on_a_tip() -> None:
    cone = block_mesh((4, 4, 6), (2.0, 2.0, 1.0), start=(-1.0, -1.0, 0.0))
    nodes = cone.nodes * np.hstack([np.repeat(0.02 + cone.nodes[:, 2:], 2, axis=1), np.ones((len(cone.nodes), 1))])
    low, high = np.array(
        tomllib.loads(starter_text(TetMesh(0.1 * nodes, cone.tets), MM, "cone", "cone.stl"))["fixed"][0]["box_m"]
    )
    held = ((0.1 * nodes >= low) & (0.1 * nodes <= high)).all(axis=1)
    assert held.sum() >= 6 and np.linalg.matrix_rank(0.1 * nodes[held] - 0.1 * nodes[held].mean(axis=0), tol=1e-4) >= 2


def test_a_robot_that_is_there_keeps_its_table(tmp_path: Path, quick: Blocks) -> None:
    robot = write_block_robot(tmp_path / "robot", cells=(3, 1, 1), cables=None)
    before = (robot / "robot.toml").read_bytes()
    report = mesh_into(
        robot, write_box(tmp_path / "block.stl", (0.1, 0.03, 0.03)), MeshOptions(unit="m"), say=quiet, mesher=quick
    )
    assert (robot / "robot.toml").read_bytes() == before
    assert report["robot"]["mesh_file"] == "block.vtu" and report["robot"]["unit"] == "mm"
    assert len(load_robot(robot).body.mesh.tets) == report["quality"]["tetrahedra"] > 3 * 6
    np.testing.assert_allclose(np.ptp(load_robot(robot).body.mesh.nodes, axis=0), [0.1, 0.03, 0.03])


def test_a_surface_named_in_the_table_gives_way_to_the_mesh(tmp_path: Path, quick: Blocks) -> None:
    robot = write_block_robot(tmp_path / "robot", mesh__file="block.stl", cables=None)
    write_box(robot / "block.stl")
    mesh_into(robot, robot / "block.stl", MM, say=quiet, mesher=quick)
    assert load_robot(robot).document["mesh"]["file"] == "mesh.vtu"


def test_a_table_that_the_mesh_does_not_fit_stays_with_its_mesh(tmp_path: Path, quick: Blocks) -> None:
    robot = write_block_robot(tmp_path / "robot", cells=(3, 1, 1), fixed=[{"box_m": [[0.5, 0, 0], [0.6, 1, 1]]}], cables=None)
    before = {file.name: file.read_bytes() for file in robot.iterdir()}
    with pytest.raises(InputError, match="does not fit the new mesh; nothing was written") as error:
        mesh_into(robot, write_box(tmp_path / "block.stl"), MM, say=quiet, mesher=quick)
    assert "no node of the mesh is inside the box" in str(error.value) and str(robot) in str(error.value)
    assert {file.name: file.read_bytes() for file in robot.iterdir()} == before


def test_it_is_not_made_twice(tmp_path: Path, quick: Blocks) -> None:
    said: list[str] = []
    file = write_box(tmp_path / "block.stl")
    first = mesh_into(tmp_path / "robot", file, MM, say=said.append, mesher=quick)
    assert (
        mesh_into(tmp_path / "robot", file, MM, say=said.append, mesher=quick) == json.loads(json.dumps(first))
        and len(quick.calls) == 1
    )
    assert "contains this mesh already" in said[0]
    mesh_into(tmp_path / "robot", file, MM, say=said.append, mesher=quick, again=True)
    mesh_into(tmp_path / "robot", file, MeshOptions(unit="mm", size_mm=12.0), say=said.append, mesher=quick)
    assert len(quick.calls) == 3 and len(said) == 1
    (tmp_path / "robot" / "mesh.vtu").write_text("broken")
    mesh_into(tmp_path / "robot", file, MeshOptions(unit="mm", size_mm=12.0), say=said.append, mesher=quick)
    assert len(quick.calls) == 4


# Size


def test_the_number_of_tetrahedra_is_kept(quick: Blocks) -> None:
    box = trimesh.creation.box((100, 30, 30))
    for most in (200, 600, 3000):
        filled = fill(np.array(box.vertices), np.array(box.faces), MeshOptions(unit="mm", most_tets=most), mesher=quick)
        assert 0.1 * most < len(filled.mesh.tets) <= most
    edges = [call["edge_fraction"] for call in quick.calls]
    assert edges[-1] < edges[0]


def test_a_wanted_size_that_gives_too_many_says_what_would_do(quick: Blocks) -> None:
    box = trimesh.creation.box((100, 30, 30))
    with pytest.raises(InputError, match="more tetrahedra than wanted") as error:
        fill(np.array(box.vertices), np.array(box.faces), MeshOptions(unit="mm", size_mm=2.0), mesher=quick)
    assert "--size 6.46" in str(error.value) and len(quick.calls) == 1 and "--max-tets 67500" in str(error.value)


class Walls:
    """A mesher of a body whose walls ask for so many tetrahedra however long the edges are."""

    def __init__(self, *cells: tuple[int, int, int]) -> None:
        self.left, self.calls = list(cells), 0

    def __call__(self, points: np.ndarray, triangles: np.ndarray, **options: Any) -> TetMesh:
        self.calls += 1
        cells = self.left.pop(0) if len(self.left) > 1 else self.left[0]
        return block_mesh(cells, np.ptp(points, axis=0), start=points.min(axis=0))


def test_thin_walls_get_the_tetrahedra_that_they_ask_for_unless_somebody_says_how_many() -> None:
    points, triangles = np.array(BOX.vertices), np.array(BOX.faces)
    walls = Walls((12, 8, 8), (11, 8, 8))  # 4608, then 4224: longer edges bring hardly fewer
    filled = fill(points, triangles, MeshOptions(unit="mm"), mesher=walls)
    assert len(filled.mesh.tets) == 6 * 11 * 8 * 8 and walls.calls == 2
    assert any("4224 tetrahedra instead of 2000" in note for note in filled.done)
    with pytest.raises(InputError, match="more tetrahedra than wanted") as error:
        fill(points, triangles, MeshOptions(unit="mm", most_tets=2000), mesher=Walls((12, 8, 8)))
    assert "--max-tets 4608" in str(error.value)
    with pytest.raises(InputError, match="more tetrahedra than wanted"):
        fill(points, triangles, MeshOptions(unit="mm"), mesher=Walls((20, 12, 12)))


def test_a_mesh_without_a_part_of_the_body_is_no_mesh_of_it() -> None:
    whole, half = (block_mesh((12, 8, 8), (size, 0.03, 0.03), start=(-0.05, -0.015, -0.015)) for size in (0.1, 0.05))
    points, triangles = np.array(BOX.vertices), np.array(BOX.faces)
    with pytest.raises(InputError, match="a part of the body was lost"):
        fill(points, triangles, MeshOptions(unit="mm"), mesher=made_before(half))
    filled = fill(points, triangles, MeshOptions(unit="mm"), mesher=made_before(whole, half))
    assert len(filled.mesh.tets) == len(whole.tets)


def test_what_does_not_end_is_tried_once_more_with_longer_edges(quick: Blocks) -> None:
    edges: list[float] = []

    def endless(points: np.ndarray, triangles: np.ndarray, **options: Any) -> TetMesh:
        edges.append(options["edge_fraction"])
        if len(edges) < 2:
            raise tetrahedra.Unfinished("fTetWild did not come to an end")
        return quick(points, triangles, **options)

    filled = fill(np.array(BOX.vertices), np.array(BOX.faces), MeshOptions(unit="mm"), mesher=endless)
    assert edges[1] == pytest.approx(2.0 * edges[0])
    assert any("did not come to an end" in note for note in filled.done)


def test_the_envelope_follows_the_size_or_is_given(quick: Blocks) -> None:
    box = trimesh.creation.box((100, 30, 30))
    for options in (MeshOptions(unit="mm", size_mm=10.0), MeshOptions(unit="mm", size_mm=10.0, tolerance_mm=0.2)):
        fill(np.array(box.vertices), np.array(box.faces), options, mesher=quick)
    diagonal = np.linalg.norm([100, 30, 30])
    np.testing.assert_allclose([call["envelope"] * diagonal for call in quick.calls], [0.4, 0.2])


def test_a_flat_element_has_the_surface_filled_anew() -> None:
    good = block_mesh((3, 2, 2), (0.1, 0.03, 0.03), start=(-0.05, -0.015, -0.015))
    nodes = np.array(good.nodes)
    inner = np.flatnonzero((np.abs(nodes) < [0.049, 0.0149, 0.0149]).all(axis=1))[0]
    tet = good.tets[(good.tets == inner).any(axis=1)][0]
    nodes[inner] += 0.99 * (nodes[tet[tet != inner]].mean(axis=0) - nodes[inner])
    box, mesher = trimesh.creation.box((100, 30, 30)), made_before(TetMesh(nodes, good.tets), good)
    assert fill(np.array(box.vertices), np.array(box.faces), MM, mesher=mesher).mesh is good


def test_crumbs_are_left_out_and_parts_are_refused() -> None:
    box = trimesh.creation.box((100, 30, 30))
    body = block_mesh((3, 2, 2), (0.1, 0.03, 0.03), start=(-0.05, -0.015, -0.015))
    for size, fits in ((0.001, True), (0.01, False)):
        crumb = block_mesh((1, 1, 1), (size,) * 3, start=(0.06, 0.0, 0.0))
        both = TetMesh(np.vstack([body.nodes, crumb.nodes]), np.vstack([body.tets, crumb.tets + len(body.nodes)]))
        mesher = made_before(*[both] * 5)
        if fits:
            filled = fill(np.array(box.vertices), np.array(box.faces), MM, mesher=mesher)
            assert len(filled.mesh.tets) == len(body.tets) and filled.done == (
                "1 disconnected pieces of negligible volume were removed",
            )
            continue
        with pytest.raises(InputError, match="fall into parts that no face joins"):
            fill(np.array(box.vertices), np.array(box.faces), MM, mesher=mesher)


def test_a_wall_inside_is_said_and_filled(quick: Blocks) -> None:
    """A box cut by a wall that shares its edges with it."""
    left, right = (
        trimesh.creation.box((size, 30, 30), trimesh.transformations.translation_matrix((x, 0, 0)))
        for size, x in ((60, -30), (40, 20))
    )
    faces = np.vstack([left.triangles, right.triangles[(right.triangles[:, :, 0] > 1).any(axis=1)]])
    filled = fill(faces.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), MM, mesher=quick)
    assert any(note.startswith("4 edges have more than two triangles (inner walls") for note in filled.done)
    assert quick.calls[0]["check_volume"] is False


def test_bodies_that_touch_along_an_edge_are_no_body() -> None:
    one, other = (block_mesh((2, 2, 2), (0.03,) * 3, start=(x, x, 0.0)) for x in (0.0, 0.03))
    points, same = np.unique(np.vstack([one.nodes, other.nodes]), axis=0, return_inverse=True)
    both = TetMesh(points, same.reshape(-1)[np.vstack([one.tets, other.tets + len(one.nodes)])])
    boxes = trimesh.util.concatenate(
        [trimesh.creation.box((30, 30, 30), trimesh.transformations.translation_matrix((x, x, 0))) for x in (15, 45)]
    )
    with pytest.raises(InputError, match="no face joins") as error:
        fill(np.array(boxes.vertices), np.array(boxes.faces), MM, mesher=made_before(*[both] * 5))
    assert "let them overlap" in str(error.value)


def test_what_takes_too_long_is_stopped() -> None:
    with pytest.raises(InputError, match="did not come to an end"):
        tetrahedra.tetrahedralise(np.array(BOX.vertices), np.array(BOX.faces), seconds=0.2, program="import time; time.sleep(60)")


# What is refused


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("no.stl", None, "no such surface"),
        ("empty.stl", b"", "the file is empty"),
        ("words.stl", b"these are words\n", "no points either"),
        ("words.obj", b"these are words\n", "no points either"),
        ("cloud.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "a cloud of 3 points"),
        (
            "cloud.ply",
            (
                b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float "
                b"z\nend_header\n0 0 0\n1 0 0\n"
            ),
            "a cloud of 2 points",
        ),
        ("noise.stl", bytes(range(256)) * 10, "the content disagrees with its header"),
        ("cut.stl", stl_bytes(BOX.triangles)[:300], "12 triangles announced, room for 4"),
        (
            "nan.stl",
            stl_bytes(np.where(np.arange(108).reshape(12, 3, 3) == 40, np.nan, BOX.triangles)),
            "1 points, the first is number 13: [50",
        ),
        ("part.x_t", b"**ABC", "a CAD file of a format that is not read"),
        ("other.xyz", b"1 2 3\n", "not readable as a mesh"),
    ],
)
def test_files_that_are_no_surface(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: bytes | None, text: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert cli.run(["mesh", str(tmp_path / name), "-o", str(tmp_path / "robot"), "--unit", "mm"]) == 2
    assert text in capfd.readouterr().err and not (tmp_path / "robot").exists()


def test_tetrahedra_are_no_surface(tmp_path: Path) -> None:
    robot = write_block_robot(tmp_path / "robot")
    with pytest.raises(InputError, match="not a surface"):
        mesh_into(tmp_path / "other", robot / "block.vtu", MM, say=quiet)


@pytest.mark.parametrize(
    ("unit", "extent", "text", "hint"),
    [
        (None, 100.0, "a surface file does not contain its unit", "--unit mm makes it 100 mm long"),
        ("m", 100.0, "the body has an unlikely size", "--unit mm makes it 100 mm long"),
        ("mm", 0.1, "the body has an unlikely size", "--unit m makes it 100 mm long"),
        ("inch", 100.0, "unknown unit", "--unit mm makes it 100 mm long"),
    ],
)
def test_units(tmp_path: Path, unit: str | None, extent: float, text: str, hint: str) -> None:
    file = write_box(tmp_path / "block.stl", (extent, extent / 3, extent / 3))
    with pytest.raises(InputError, match=text) as error:
        mesh_into(tmp_path / "robot", file, MeshOptions(unit=unit), say=quiet)
    assert hint in str(error.value)


def test_a_doubtful_unit_is_questioned(tmp_path: Path, quick: Blocks) -> None:
    with pytest.warns(UserWarning, match=r"the body is 12 m across with --unit m; --unit cm makes it 120 mm long"):
        mesh_into(
            tmp_path / "robot", write_box(tmp_path / "block.stl", (12, 4, 4)), MeshOptions(unit="m"), say=quiet, mesher=quick
        )


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("a")
    file = write_box(tmp_path / "block.stl")
    with pytest.raises(InputError, match="something else than a robot"):
        mesh_into(tmp_path / "letters", file, MM, say=quiet)
    with pytest.raises(InputError, match="stands in the way"):
        mesh_into(file, file, MM, say=quiet)
    (tmp_path / "letters" / "robot.toml").write_text("name = 3")
    with pytest.raises(InputError, match=r"no table \[mesh\]"):
        mesh_into(tmp_path / "letters", file, MM, say=quiet)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_formats(tmp_path: Path, ending: str) -> None:
    points, triangles = read_any_surface(write_box(tmp_path / f"block.{ending}"))
    assert np.ptp(points, axis=0).tolist() == [100, 30, 30] and len(triangles) == 12


def write_step(path: Path) -> None:
    """Write a plate of 60 × 20 × 10 mm with a hole of 8 mm, in a process of its own: Gmsh keeps state."""
    import subprocess
    import sys

    text = f"""
import gmsh
gmsh.initialize(); gmsh.option.setNumber("General.Terminal", 0)
box, hole = gmsh.model.occ.addBox(0, 0, 0, 60, 20, 10), gmsh.model.occ.addCylinder(30, 10, -5, 0, 0, 30, 4)
gmsh.model.occ.cut([(3, box)], [(3, hole)]); gmsh.model.occ.synchronize(); gmsh.write({str(path)!r}); gmsh.finalize()
"""
    subprocess.run([sys.executable, "-c", text], check=True, capture_output=True, timeout=300)


def test_a_step_file_says_its_unit(tmp_path: Path) -> None:
    pytest.importorskip("gmsh")
    write_step(tmp_path / "plate.step")
    volume = 60 * 20 * 10 - np.pi * 16 * 10
    for unit, scale in (("mm", 1.0), ("cm", 0.1)):
        points, triangles = read_any_surface(tmp_path / "plate.step", unit=unit)
        np.testing.assert_allclose(np.ptp(points, axis=0), scale * np.array([60.0, 20.0, 10.0]), rtol=1e-6)
        surface = repaired(points, triangles, where="plate")
        assert surface.volume == pytest.approx(scale**3 * volume, rel=2e-3) and not surface.done
    (tmp_path / "cut.step").write_bytes((tmp_path / "plate.step").read_bytes()[:2000])
    with pytest.raises(InputError, match="not readable as a CAD file"):
        read_any_surface(tmp_path / "cut.step")


def test_a_step_file_is_filled_from_its_faces(tmp_path: Path) -> None:
    """Also with walls of a millimetre, quickly; what asks for repairs or fewer tetrahedra goes the usual way."""
    pytest.importorskip("gmsh")
    write_step(tmp_path / "plate.step")
    report = mesh_into(tmp_path / "robot", tmp_path / "plate.step", MeshOptions(), say=print)
    assert "filled by Gmsh" in report["done"][0] and report["deviation_mm"] < report["tolerance_mm"]
    body = load_robot(tmp_path / "robot").body
    assert float(element_volumes(body.mesh).sum()) == pytest.approx((60 * 20 * 10 - np.pi * 16 * 10) * 1e-9, rel=0.01)
    assert radius_ratio(body.mesh).min() > 0.1 and 300 < len(body.mesh.tets) < 2500
    points, triangles = read_any_surface(tmp_path / "plate.step")
    for options in (MeshOptions(unit="mm", close_holes=True), MeshOptions(unit="mm", most_tets=5)):
        assert fill_cad(tmp_path / "plate.step", points, triangles, options) is None
    broken = "raise SystemExit('no')"
    assert fill_cad(tmp_path / "plate.step", points, triangles, MeshOptions(unit="mm"), program=broken) is None
