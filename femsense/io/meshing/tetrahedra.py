"""Closed surfaces filled with tetrahedra by fTetWild. It is randomised without a seed, so results are stored and reused."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import secrets
import warnings
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError, MissingDependency
from femsense.fem.mesh import TetMesh, element_volumes, oriented
from femsense.io.files import PART_PREFIX
from femsense.io.meshing.child_process import ProgramFailed, ProgramTimeout, run_program

FTETWILD = """
import importlib.util, sys, types
import numpy as np
if importlib.util.find_spec("pyvista") is None:  # some versions import it for an accessor that is not used here
    sys.modules["pytetwild._accessor"] = types.ModuleType("pytetwild._accessor")
import pytetwild
data = np.load("given.npz")
nodes, tets = pytetwild.tetrahedralize(
    data["points"], data["triangles"], edge_length_fac=float(data["edge"]), epsilon=float(data["envelope"]), vtk_ordering=True,
    quiet=True,
)
np.savez("made.npz", nodes=nodes, tets=tets)
"""
EDGE_FRACTION = 0.05
"""Edge length of a mesh made from a surface, over the diagonal of its bounding box."""
FILL_SECONDS = 300.0
"""fTetWild is stopped early after this time."""
ENVELOPE = 1e-3
"""Largest distance of a mesh from its surface, over the diagonal of its bounding box."""


class Unfinished(InputError):
    """A filling that was stopped early."""


def tetrahedralise(
    points: FloatArray,
    triangles: IntArray,
    *,
    edge_fraction: float = EDGE_FRACTION,
    envelope: float = ENVELOPE,
    where: str = "surface",
    check_volume: bool = True,
    seconds: float = FILL_SECONDS,
    program: str = FTETWILD,
) -> TetMesh:
    """Return tetrahedra that fill a closed surface (fTetWild; another mesh each time, see `tets_of_surface`).

    Arguments:
        points: shape (n, 3), any unit.
        triangles: shape (t, 3), outward; a cavity's surface points into the cavity.
        edge_fraction: wanted edge length over the diagonal of the bounding box [1].
        envelope: largest distance from the surface over that diagonal [1].
        where: for messages.
        check_volume: warn if the volume differs from that of the surface (which is allowed for crossing shells).
        seconds: time after which it is stopped early [s].
        program: Python that fills the surface in `given.npz` and writes `made.npz` where it runs.

    Raises:
        InputError: no result, or not in time. MissingDependency: without pytetwild.
    """
    nodes, tets = _run_ftetwild(points, triangles, edge_fraction, envelope, where, seconds, program)
    if not len(tets):
        raise InputError(
            "no tetrahedra came out of this surface",
            where=where,
            found=f"{len(triangles)} triangles",
            expected="a closed surface around a volume",
        )
    mesh = oriented(compact(nodes, tets))
    corners = points[triangles]
    inside = float(np.linalg.det(corners).sum() / 6.0)  # Σ a · (b × c) / 6 over outward triangles
    filled = float(element_volumes(mesh).sum()) / inside if inside else np.nan
    if check_volume and not 0.95 < filled < 1.05:
        warnings.warn(
            f"{where}: the tetrahedra fill {100 * filled:.3g} % of the surface's volume; are its walls thin?", stacklevel=4
        )
    return mesh


def tets_of_surface(file: Path, points: FloatArray, triangles: IntArray, where: str) -> TetMesh:
    """Return the tetrahedra of a surface as they are kept, or made and kept.

    fTetWild shuffles with a seed of its own, so that only the kept mesh makes two runs equal: the first one written counts.
    """
    places = kept_tets(file, points, triangles)
    for place in places:
        kept = _read_kept(place)
        if kept is not None:
            return kept
    mesh = tetrahedralise(points, triangles, edge_fraction=EDGE_FRACTION, where=where)
    for place in places:
        if _keep(mesh, place):
            return _read_kept(place) or mesh
    warnings.warn(
        f"{where}: the tetrahedra cannot be kept, so that each run makes another mesh; femsense mesh writes one", stacklevel=4
    )
    return mesh


def kept_tets(surface: Path, points: FloatArray, triangles: IntArray) -> tuple[Path, Path]:
    """Return the file for the tetrahedra of a surface: next to it, or in the cache if its folder is not writable."""
    content = points.tobytes() + triangles.tobytes() + f"1 {EDGE_FRACTION}".encode()
    name = f"{surface.stem}-{hashlib.sha256(content).hexdigest()[:16]}.tets.npz"
    return surface.with_name(name), cache_folder() / "tetrahedra" / name


def cache_folder() -> Path:
    """Return where meshes made from surfaces are kept: $FEMSENSE_CACHE, else femsense in the user's cache folder."""
    if chosen := os.environ.get("FEMSENSE_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "femsense"


def compact(points: FloatArray, tets: IntArray) -> TetMesh:
    """Return the mesh of the used nodes: corners in their order, then the nodes that are only middles of edges."""
    corners = np.unique(tets[:, :4])
    order = np.concatenate([corners, np.setdiff1d(tets, corners)])
    number = np.full(len(points), -1)
    number[order] = np.arange(len(order))
    return TetMesh(points[order], number[tets])


def _keep(mesh: TetMesh, place: Path) -> bool:
    """Write the mesh unless the file exists (two processes may do so at once); False if that is not possible."""
    part = place.with_name(f"{PART_PREFIX}{secrets.token_hex(4)}-{place.name}")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(part, nodes=mesh.nodes, tets=mesh.tets)
        if _read_kept(place) is None:
            place.unlink(missing_ok=True)
        with contextlib.suppress(FileExistsError):
            os.link(part, place)
    except OSError:
        return False
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return True


def _read_kept(place: Path) -> TetMesh | None:
    """Return a kept mesh; None where there is none or it cannot be read."""
    try:
        with np.load(place) as data:
            return TetMesh(data["nodes"], data["tets"])
    except Exception:
        return None


def _run_ftetwild(
    points: FloatArray, triangles: IntArray, edge_fraction: float, envelope: float, where: str, seconds: float, program: str
) -> tuple[FloatArray, IntArray]:
    """Return nodes and tetrahedra from a process of its own: fTetWild writes files where it runs, and it may crash."""
    if importlib.util.find_spec("pytetwild") is None:
        raise MissingDependency("a surface becomes tetrahedra through pytetwild: pip install pytetwild")
    given = {"points": points, "triangles": triangles.astype(np.int32), "edge": edge_fraction, "envelope": envelope}
    try:
        made = run_program(program, seconds=seconds, given=given)
    except ProgramTimeout:
        raise Unfinished(
            "fTetWild did not come to an end",
            where=where,
            found=f"{len(triangles)} triangles, stopped early after {seconds:.0f} s",
            expected="tetrahedra",
            hint=(
                "nearly coincident surfaces and walls thinner than the tolerance take long: repair them, or "
                "femsense mesh with another --tolerance or a larger --size"
            ),
        ) from None
    except ProgramFailed as failed:
        raise InputError(
            "fTetWild failed on this surface",
            where=where,
            found=str(failed)[:200],
            expected="tetrahedra",
            hint="mend the surface (self-intersections, thin walls), or give tetrahedra",
        ) from None
    return np.asarray(made["nodes"], dtype=np.float64), np.asarray(made["tets"], dtype=np.int64)
