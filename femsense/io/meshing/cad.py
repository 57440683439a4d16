"""CAD files (STEP, IGES, BREP) as triangles, through Gmsh and its OpenCASCADE kernel."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError, MissingDependency
from femsense.io.meshing.child_process import ProgramFailed, ProgramTimeout, run_program

CAD_READ = (".step", ".stp", ".iges", ".igs", ".brep")
INSTALL = 'pip install "femsense[cad]"'
PER_CIRCLE = 24
"""Edges around a full circle: the chord deviates by 0.9 % of the radius."""
SECONDS = 300.0
"""Gmsh is stopped after this time."""
GMSH = """
import sys
import numpy as np, gmsh
path, unit, per_circle = sys.argv[1:]
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setString("Geometry.OCCTargetUnit", unit.upper())
gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", float(per_circle))
gmsh.model.occ.importShapes(path)
gmsh.model.occ.synchronize()
if not gmsh.model.getEntities(3) and not gmsh.model.getEntities(2):
    raise SystemExit("no solids and no faces")
low, high = np.array(gmsh.model.getBoundingBox(-1, -1)).reshape(2, 3)
gmsh.option.setNumber("Mesh.MeshSizeMax", float(np.linalg.norm(high - low)) / 25)
gmsh.model.mesh.generate(2)
tags, xyz, _ = gmsh.model.mesh.getNodes()
triangles = []
volumes = gmsh.model.getEntities(3)
faces = gmsh.model.getBoundary(volumes, combined=False, oriented=False) if volumes else gmsh.model.getEntities(2)
for dimension, tag in faces:
    _, corners = gmsh.model.mesh.getElementsByType(2, tag)
    triangles.append(np.array(corners, dtype=np.int64).reshape(-1, 3))
number = np.full(int(tags.max()) + 1, -1)
number[tags] = np.arange(len(tags))
np.savez("made.npz", points=np.array(xyz).reshape(-1, 3), triangles=number[np.concatenate(triangles)])
gmsh.finalize()
"""


def read_cad(path: Path, unit: str) -> tuple[FloatArray, IntArray]:
    """Return points, shape (n, 3), in a unit ("m", "cm", "mm"), and triangles, shape (t, 3), of the faces of a CAD file.

    Raises:
        InputError: Gmsh cannot read or mesh the file. MissingDependency: without gmsh.
    """
    if importlib.util.find_spec("gmsh") is None:
        raise MissingDependency(f"a CAD file becomes triangles through gmsh: {INSTALL}")
    try:
        made = run_program(GMSH, str(path.absolute()), unit, str(PER_CIRCLE), seconds=SECONDS)
    except ProgramTimeout:
        raise InputError(
            "Gmsh did not come to an end",
            where=path,
            found=f"stopped after {SECONDS:.0f} s",
            expected="triangles",
            hint="export it as STL from the CAD program, in mm",
        ) from None
    except ProgramFailed as failed:
        last = str(failed)
        if "libGL" in last or "cannot open shared object" in last:
            raise MissingDependency(f"gmsh needs a library of the system: {last[:160]}") from None
        raise InputError(
            "not readable as a CAD file",
            where=path,
            found=last[:160],
            expected="solids in STEP, IGES or BREP",
            hint="export it as STL from the CAD program, in mm",
        ) from None
    return np.asarray(made["points"], dtype=np.float64), np.asarray(made["triangles"], dtype=np.int64)
