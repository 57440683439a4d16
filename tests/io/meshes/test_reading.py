"""Mesh files of other programs: each format as its writers leave it, and what is refused."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from helpers import DATA, block_mesh

from femsense.core.errors import InputError
from femsense.fem.mesh import element_volumes, surface_triangles, to_quadratic
from femsense.io.mesh_files import read_tets, tet_values
from femsense.io.meshes.reading import read_content

BLOCK = block_mesh((3, 2, 1))
NODES, TETS = np.asarray(BLOCK.nodes), np.asarray(BLOCK.tets)
TRIALS = DATA / "trials" / "files"


def same_body(path: Path) -> None:
    """Assert that a file holds the block, whatever the order of its nodes."""
    mesh = read_tets(path)
    np.testing.assert_allclose(element_volumes(mesh), element_volumes(BLOCK), rtol=1e-6)
    np.testing.assert_allclose(mesh.nodes[mesh.tets[:, :4]], NODES[TETS], atol=1e-9)


def node_lines(numbers: np.ndarray) -> str:
    return "".join(f"{n} {x!r} {y!r} {z!r}\n" for n, (x, y, z) in zip(numbers.tolist(), NODES.tolist()))


def element_lines(numbers: np.ndarray, head: str) -> str:
    return "".join(f"{i + 1} {head} {' '.join(map(str, numbers[tet].tolist()))}\n" for i, tet in enumerate(TETS))


@pytest.mark.parametrize("kind", ["2.2", "4.0", "4.1"])
@pytest.mark.parametrize("binary", [False, True])
def test_gmsh_as_it_is_written(tmp_path: Path, kind: str, binary: bool) -> None:
    for name, mesh, cells in (("a", BLOCK, "tetra"), ("b", to_quadratic(BLOCK), "tetra10")):
        file = tmp_path / f"{name}.msh"
        content = meshio.Mesh(mesh.nodes, [(cells, mesh.tets)])
        meshio.gmsh.write(file, content, fmt_version=kind, binary=binary)
        same_body(file)
        assert read_tets(file).is_quadratic == (cells == "tetra10")


def test_gmsh_1_with_any_numbers(tmp_path: Path) -> None:
    numbers = 10 * np.arange(len(NODES))[::-1]
    text = f"$NOD\n{len(NODES)}\n{node_lines(numbers)}$ENDNOD\n$ELM\n{len(TETS)}\n{element_lines(numbers, '4 7 1 4')}$ENDELM\n"
    (tmp_path / "a.msh").write_text(text)
    same_body(tmp_path / "a.msh")
    assert (tet_values(tmp_path / "a.msh", "gmsh:physical", "here") == 7).all()


def gmsh_2(path: Path, *groups: int, first: int = 0) -> Path:
    """Write a mesh of version 2 with each tetrahedron once for each group."""
    numbers = np.arange(len(NODES)) + first
    elements = "".join(element_lines(numbers, f"4 2 {group} 1") for group in groups)
    head = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
    body = f"$Nodes\n{len(NODES)}\n{node_lines(numbers)}$EndNodes\n$Elements\n{len(groups) * len(TETS)}\n{elements}$EndElements\n"
    path.write_text(head + body)
    return path


def test_numbers_that_begin_at_zero(tmp_path: Path) -> None:
    same_body(gmsh_2(tmp_path / "a.msh", 1, first=0))


def test_a_tetrahedron_of_two_groups_is_used_once_and_keeps_both(tmp_path: Path) -> None:
    file = gmsh_2(tmp_path / "a.msh", 5, 6)
    with pytest.warns(UserWarning, match=f"{len(TETS)} of {2 * len(TETS)} tetrahedra occur twice"):
        same_body(file)
    np.testing.assert_array_equal(tet_values(file, "gmsh:physical", "here"), [[5, 6]] * len(TETS))


def test_gmsh_saves_all_with_groups_of_some(tmp_path: Path) -> None:
    """Version 4.1: the groups stand with the entities, some of which have none (SaveAll)."""
    half = len(TETS) // 2
    entities = "0 0 1 2\n1 0 0 0 1 1 1 0 0\n1 0 0 0 1 1 1 2 3 4 0\n2 0 0 0 1 1 1 0 0\n"
    nodes = f"1 {len(NODES)} 1 {len(NODES)}\n3 1 0 {len(NODES)}\n" + "".join(f"{i + 1}\n" for i in range(len(NODES)))
    nodes += "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in NODES.tolist())
    elements = f"3 {len(TETS) + 1} 1 {len(TETS) + 1}\n2 1 2 1\n999 1 2 3\n"
    for tag, part in ((1, TETS[:half]), (2, TETS[half:])):
        elements += f"3 {tag} 4 {len(part)}\n" + "".join(f"1 {' '.join(map(str, tet + 1))}\n" for tet in part)
    text = (
        f"$MeshFormat\n4.1 0 "
        f"8\n$EndMeshFormat\n$Entities\n{entities}$EndEntities\n$Nodes\n{nodes}$EndNodes\n$Elements\n{elements}$EndElements\n"
    )
    (tmp_path / "a.msh").write_text(text)
    same_body(tmp_path / "a.msh")
    values = tet_values(tmp_path / "a.msh", "gmsh:physical", "here")
    assert (values[:half] == [3, 4]).all() and (values[half:] == 0).all()


def test_a_gmsh_mesh_that_is_cut_off(tmp_path: Path) -> None:
    whole = tmp_path / "b.msh"
    meshio.write(whole, meshio.Mesh(NODES, [("tetra", TETS)]), file_format="gmsh", binary=True)
    for share in (0.3, 0.6, 0.9):
        (tmp_path / "a.msh").write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
        with pytest.raises(InputError, match="a broken Gmsh mesh"):
            read_content(tmp_path / "a.msh", "here")


def test_medit_that_counts_from_zero(tmp_path: Path) -> None:
    rows = "".join(f"{x!r} {y!r} {z!r} 0\n" for x, y, z in NODES.tolist())
    tets = "".join(f"{' '.join(map(str, tet))} 0\n" for tet in TETS.tolist())
    text = f"MeshVersionFormatted 2\nDimension 3\nVertices\n{len(NODES)}\n{rows}Tetrahedra\n{len(TETS)}\n{tets}End\n"
    (tmp_path / "a.mesh").write_text(text)
    with pytest.warns(UserWarning, match="count from 0"):
        same_body(tmp_path / "a.mesh")


# VTU


def piece(nodes: np.ndarray, tets: np.ndarray) -> str:
    array = lambda kind, name, values: (  # noqa: E731
        f'<DataArray type="{kind}" Name="{name}" format="ascii">{" ".join(map(repr, np.ravel(values).tolist()))}</DataArray>'
    )
    points = array("Float64", "Points", nodes).replace("Name=", 'NumberOfComponents="3" Name=')
    cells = array("Int64", "connectivity", tets) + array("Int64", "offsets", 4 * np.arange(1, len(tets) + 1))
    cells += array("UInt8", "types", np.full(len(tets), 10))
    data = array("Int64", "part", np.full(len(tets), len(tets)))
    counts = f'NumberOfPoints="{len(nodes)}" NumberOfCells="{len(tets)}"'
    return f"<Piece {counts}><Points>{points}</Points><Cells>{cells}</Cells><CellData>{data}</CellData></Piece>"


def vtu(*pieces: str) -> str:
    kind = 'type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"'
    return f'<?xml version="1.0"?><VTKFile {kind}><UnstructuredGrid>{"".join(pieces)}</UnstructuredGrid></VTKFile>'


def halves() -> list[str]:
    """Return the block as two pieces with nodes of their own where they meet."""
    pieces = []
    for part in (TETS[: len(TETS) // 2], TETS[len(TETS) // 2 :]):
        used, local = np.unique(part, return_inverse=True)
        pieces.append(piece(NODES[used], local.reshape(part.shape)))
    return pieces


def test_a_vtu_of_several_pieces_is_read_whole(tmp_path: Path) -> None:
    empty = piece(np.zeros((0, 3)), np.zeros((0, 4), dtype=int))
    (tmp_path / "a.vtu").write_text(vtu(*halves(), empty))
    same_body(tmp_path / "a.vtu")
    assert len(read_tets(tmp_path / "a.vtu").nodes) == len(NODES)
    assert tet_values(tmp_path / "a.vtu", "part", "here").shape == (len(TETS), 1)


def test_a_list_of_vtu_files(tmp_path: Path) -> None:
    for i, part in enumerate(halves()):
        (tmp_path / f"p{i}.vtu").write_text(vtu(part))
    text = (
        '<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid><Piece Source="p0.vtu"/><Piece '
        'Source="p1.vtu"/></PUnstructuredGrid></VTKFile>'
    )
    (tmp_path / "a.pvtu").write_text(text)
    same_body(tmp_path / "a.pvtu")
    (tmp_path / "p1.vtu").unlink()
    with pytest.raises(InputError, match="a piece is missing"):
        read_tets(tmp_path / "a.pvtu")


# Abaqus


def abaqus_nodes(numbers: np.ndarray) -> str:
    return "".join(f"{n}, {x!r}, {y!r}, {z!r}\n" for n, (x, y, z) in zip(numbers.tolist(), NODES.tolist()))


def abaqus_elements(numbers: np.ndarray, kind: str = "C3D4") -> str:
    rows = "".join(f"{i + 1}, {', '.join(map(str, numbers[tet].tolist()))}\n" for i, tet in enumerate(TETS))
    return f"*Element, type={kind}, elset=E\n{rows}"


NUMBERS = np.arange(len(NODES)) * 3 + 5


def test_abaqus_with_two_blocks_of_nodes_and_hybrid_elements(tmp_path: Path) -> None:
    lines = abaqus_nodes(NUMBERS).splitlines(keepends=True)
    for kind in ("C3D4", "C3D4H", "c3d4"):
        text = "*HEADING\n** a comment\n*NODE, nset=A\n" + "".join(lines[:5]) + "*Node\n" + "".join(lines[5:])
        (tmp_path / "a.inp").write_text(text + abaqus_elements(NUMBERS, kind) + "*Material, name=S\n*Density\n1e-9\n")
        same_body(tmp_path / "a.inp")


def test_abaqus_elements_over_several_lines(tmp_path: Path) -> None:
    mesh = to_quadratic(BLOCK)
    rows = "".join(
        f"{i}, {', '.join(map(str, t[:6] + 1))},\n  {', '.join(map(str, t[6:] + 1))}\n" for i, t in enumerate(mesh.tets)
    )
    nodes = "".join(f"{i + 1}, {x!r}, {y!r}, {z!r}\n" for i, (x, y, z) in enumerate(mesh.nodes.tolist()))
    (tmp_path / "a.inp").write_text(f"*Node\n{nodes}*Element, type=C3D10M\n{rows}")
    same_body(tmp_path / "a.inp")
    assert read_tets(tmp_path / "a.inp").is_quadratic


def test_an_instance_of_abaqus_stands_where_it_is_put(tmp_path: Path) -> None:
    part = "*Part, name=B\n*Node\n" + abaqus_nodes(NUMBERS) + abaqus_elements(NUMBERS) + "*End Part\n"
    place = (
        "*Assembly, name=A\n*Instance, name=B-1, part=b\n10., 0., 0.\n0., 0., 0., 0., 0., 1., 90.\n*End Instance\n*Node\n1, "
        "0., 0., 0.\n*End Assembly\n"
    )
    (tmp_path / "a.inp").write_text(part + place)
    moved = NODES + np.array([10.0, 0.0, 0.0])
    turned = np.column_stack([-moved[:, 1], moved[:, 0], moved[:, 2]])
    np.testing.assert_allclose(read_tets(tmp_path / "a.inp").nodes, turned, atol=1e-12)


def test_what_abaqus_writes_and_is_refused(tmp_path: Path) -> None:
    part = lambda name: f"*Part, name={name}\n*Node\n{abaqus_nodes(NUMBERS)}{abaqus_elements(NUMBERS)}*End Part\n"  # noqa: E731
    (tmp_path / "two.inp").write_text(part("A") + part("B"))
    with pytest.raises(InputError, match="several parts or instances") as error:
        read_tets(tmp_path / "two.inp")
    assert "A, B" in str(error.value) and "Merge" in str(error.value)
    (tmp_path / "made.inp").write_text("*Node\n1, 0, 0, 0\n*NGEN\n1, 9\n")
    with pytest.raises(InputError, match="NGEN is not read") as error:
        read_tets(tmp_path / "made.inp")
    assert ", line 3" in str(error.value)
    (tmp_path / "lost.inp").write_text("*Node\n1, 0, 0, 0\n*Element, type=C3D4\n1, 1, 2, 3, 4\n")
    with pytest.raises(InputError, match="names a node that does not exist"):
        read_tets(tmp_path / "lost.inp")


# Bodies that are none


def test_overlapping_elements_are_refused(tmp_path: Path) -> None:
    inner = np.vstack([NODES, NODES[TETS[0]].mean(axis=0)])
    more = [[*TETS[0][list(face)], len(NODES)] for face in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))]
    meshio.Mesh(inner, [("tetra", np.vstack([TETS, more]))]).write(tmp_path / "a.vtu")
    with pytest.raises(InputError, match="tetrahedra that overlap"):
        read_tets(tmp_path / "a.vtu")


def test_no_surface_is_an_error(tmp_path: Path) -> None:
    """The boundary of a simplex in four dimensions: each face lies between two tetrahedra."""
    nodes = np.random.default_rng(1).normal(size=(5, 3))
    tets = np.array([[i for i in range(5) if i != left] for left in range(5)])
    meshio.Mesh(nodes, [("tetra", tets)]).write(tmp_path / "a.vtu")
    with pytest.raises(InputError, match="the mesh has no surface"):
        read_tets(tmp_path / "a.vtu")


@pytest.mark.skipif(not TRIALS.is_dir(), reason="the trials are not here")
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("ok22.msh", 0.0, 100.0),
        ("saveall41.msh", 0.0, 100.0),
        ("twopieces.vtu", 0.0, 100.0),
        ("twonode.inp", 0.0, 100.0),
        ("twonode4.inp", 0.0, 100.0),
        ("oneinst.inp", 100.0, 200.0),
    ],
)
def test_files_that_went_wrong(name: str, low: float, high: float) -> None:
    mesh = read_tets(TRIALS / name)
    assert len(mesh.tets) == 192 and len(surface_triangles(mesh)) == 144
    np.testing.assert_allclose([mesh.nodes[:, 0].min(), mesh.nodes[:, 0].max()], [low, high])


GMSH = """
import gmsh, sys
gmsh.initialize(); gmsh.option.setNumber("General.Terminal", 0)
ends = [(3, gmsh.model.occ.addBox(x, 0, 0, 3, 1, 1)) for x in (0, 3)]
gmsh.model.occ.fragment(ends[:1], ends[1:]); gmsh.model.occ.synchronize()
for tag, name in ((1, "soft"), (2, "hard")):
    gmsh.model.addPhysicalGroup(3, [tag], name=name)
gmsh.option.setNumber("Mesh.MeshSizeMax", 2); gmsh.model.mesh.generate(3)
for name, version, binary in (("a1", 1, 0), ("a2", 2.2, 1), ("a4", 4, 0), ("a41", 4.1, 1)):
    gmsh.option.setNumber("Mesh.MshFileVersion", version); gmsh.option.setNumber("Mesh.Binary", binary); gmsh.write(name + ".msh")
gmsh.option.setNumber("Mesh.Binary", 0)
for ending in ("bdf", "inp", "vtk", "mesh"):
    gmsh.write("a." + ending)
gmsh.finalize()
"""


def test_what_gmsh_itself_writes(tmp_path: Path) -> None:
    """Binary 4.1 with entities that are in no group, 4.0 that calls itself 4, Nastran without BEGIN BULK."""
    pytest.importorskip("gmsh")
    subprocess.run([sys.executable, "-c", GMSH], cwd=tmp_path, check=True, capture_output=True, timeout=120)
    files = sorted(tmp_path.glob("a*"))
    assert len(files) == 8
    for file in files:
        content = read_content(file, str(file))
        corners = content.points[content.cells["tetra"]]
        volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6
        assert volume == pytest.approx(6.0, rel=1e-6), file.name
    for name in ("a4.msh", "a41.msh"):
        assert set(np.unique(tet_values(tmp_path / name, "gmsh:physical", "here"))) == {1, 2}


@pytest.mark.skipif(importlib.util.find_spec("h5py") is not None, reason="h5py is there")
def test_a_format_that_needs_h5py_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.med").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(InputError, match="pip install h5py"):
        read_content(tmp_path / "a.med", "a.med")
