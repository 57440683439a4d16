"""Tetrahedra from the faces of a CAD file by Gmsh: the body is exact and closed and needs no repair. fTetWild took 110 to 230 s of
processor time for parts that Gmsh fills in seconds (`python benchmarks/meshing.py`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.units import PER_METRE
from femsense.fem.mesh import oriented
from femsense.fem.mesh_checks import check_mesh, hinged_parts
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.child_process import ProgramFailed, ProgramTimeout, run_program
from femsense.io.meshing.filling import (
    ASTRAY,
    ENOUGH_TETS,
    ENVELOPE_OF_EDGE,
    LARGEST_ENVELOPE,
    MOST_TETS,
    POOR,
    SETTLED,
    TRIES,
    Filled,
    Progress,
    deviation_of,
    first_edge,
)
from femsense.io.meshing.options import MeshOptions
from femsense.io.meshing.surface import ClosedSurface
from femsense.io.meshing.tetrahedra import compact

OF_WALL = 1 / 6
"""Largest distance between mesh and faces as a fraction of the mean wall thickness 2 V / A."""
SECONDS = 120.0
"""Gmsh is stopped after this time, and fTetWild has its turn."""
GMSH = """
import sys
import numpy as np, gmsh
path, unit, edge, tolerance = sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4])
gmsh.initialize(interruptible=False)
gmsh.option.setString("Geometry.OCCTargetUnit", unit.upper())
gmsh.model.occ.importShapes(path)
gmsh.model.occ.synchronize()
if len(gmsh.model.getEntities(3)) != 1:
    raise SystemExit("not one solid")
around = 24
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", around)
gmsh.option.setNumber("Mesh.MeshSizeFromPoints", 0)
gmsh.option.setNumber("Mesh.MeshSizeMax", 1e22)
def size(dimension, tag, x, y, z, wanted):
    if wanted > 1e20:
        return edge
    radius = around * wanted / (2 * np.pi)  # an edge L deviates from a circle of radius r by L^2 / 8 r; some edges are longer
    return min(edge, max(wanted, np.sqrt(4 * radius * tolerance)))
gmsh.model.mesh.setSizeCallback(size)
gmsh.model.mesh.generate(3)
gmsh.model.mesh.optimize("Netgen")
tags, xyz, _ = gmsh.model.mesh.getNodes()
_, corners = gmsh.model.mesh.getElementsByType(4)
number = np.full(int(tags.max()) + 1, -1)
number[tags] = np.arange(len(tags))
np.savez("made.npz", nodes=np.array(xyz).reshape(-1, 3), tets=number[np.array(corners, dtype=np.int64).reshape(-1, 4)])
gmsh.finalize()
"""


def fill_cad(
    path: Path,
    points: FloatArray,
    triangles: IntArray,
    options: MeshOptions,
    *,
    progress: Progress | None = None,
    program: str = GMSH,
) -> Filled | None:
    """Return the single solid of a CAD file filled with tetrahedra; None if `filling.fill` must be used instead: for several solids or
    none, if Gmsh fails or exceeds the number of tetrahedra, and with the options for repairs or a part.

    Arguments:
        path: of the STEP, IGES or BREP file.
        points, triangles: its faces as `read_cad` gives them, in `options.unit`, shapes (n, 3) and (t, 3).
        options: size and unit.
        progress: called with a description of each step.
        program: Python that meshes the file and writes `made.npz` where it runs.
    """
    if options.close_holes or options.fill_cavities or options.part is not None:
        return None
    tell, unit = progress or (lambda *_: None), options.unit or "mm"
    surface = ClosedSurface(freeze(points / PER_METRE[unit]), freeze(triangles, np.int64))
    wanted, edge = options.most_tets or MOST_TETS, first_edge(surface, options)
    fewest: Filled | None = None
    for attempt in range(TRIES):
        tell(f"filling with Gmsh, edges of {1e3 * edge:.2g} mm, try {attempt + 1}")
        filled = _filled(path, surface, edge, options, program)
        if filled is None:
            return None
        count = len(filled.mesh.tets)
        if count <= wanted:
            return filled
        settled = fewest is not None and count > SETTLED * len(fewest.mesh.tets)
        if not settled:
            fewest = filled
        if settled or options.size_mm is not None:
            break
        edge = min(edge * 1.08 * (count / wanted) ** (1.0 / 3.0), 0.5 * surface.diagonal)
    if fewest is None or options.most_tets is not None or len(fewest.mesh.tets) > ENOUGH_TETS:
        return None
    if options.size_mm is not None:
        return fewest
    note = (
        f"{len(fewest.mesh.tets)} tetrahedra instead of {wanted}, because of thin walls or fine detail; all later computations take longer "
        f"in proportion. --max-tets {wanted} allows a coarser mesh, less close to the faces; that can take minutes"
    )
    return replace(fewest, done=(*fewest.done, note))


def _filled(path: Path, surface: ClosedSurface, edge: float, options: MeshOptions, program: str) -> Filled | None:
    """Return one mesh with edges of a length [m]; None where Gmsh made none, or one that is flat, in parts or far away."""
    unit = options.unit or "mm"
    given = options.tolerance_mm
    usual = min(ENVELOPE_OF_EDGE * edge, LARGEST_ENVELOPE * surface.diagonal, OF_WALL * 2.0 * surface.volume / surface.area)
    tolerance = usual if given is None else 1e-3 * given
    try:
        made = run_program(
            program, str(path.absolute()), unit, str(edge * PER_METRE[unit]), str(tolerance * PER_METRE[unit]), seconds=SECONDS
        )
    except (ProgramTimeout, ProgramFailed):
        return None
    nodes, tets = np.asarray(made["nodes"], dtype=np.float64), np.asarray(made["tets"], dtype=np.int64)
    if not len(tets):
        return None
    mesh = oriented(compact(nodes / PER_METRE[unit], tets))
    if radius_ratio(mesh).min() < POOR or hinged_parts(mesh).max() > 0:
        return None
    check_mesh(mesh, str(path))
    deviation = deviation_of(mesh, surface, crosses=False)
    if deviation > ASTRAY * tolerance:
        return None
    return Filled(mesh, 1e3 * edge, 1e3 * tolerance, 1e3 * deviation, ("filled by Gmsh, from the faces of the CAD file",))
