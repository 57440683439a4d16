"""From a surface to a mesh of tetrahedra of the wanted size."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.units import PER_METRE
from femsense.fem.mesh import TetMesh, element_volumes, surface_triangles
from femsense.fem.mesh_checks import check_mesh, hinged_parts
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.options import MeshOptions
from femsense.io.meshing.surface import ClosedSurface, repaired
from femsense.io.meshing.surface_queries import crossing_triangles, distance_to, sides
from femsense.io.meshing.tetrahedra import FILL_SECONDS, Unfinished, tetrahedralise
from femsense.io.meshing.thinning import thinned

MOST_TETS = 2000
"""Default number of tetrahedra …"""
ENOUGH_TETS = 8000
"""… and taken where a body with thin walls or fine detail cannot be filled with fewer."""
SETTLED = 0.9
"""If longer edges keep more than this fraction of the tetrahedra, walls and detail determine their number."""
ASTRAY = 3.0
"""A mesh whose distance from the surface exceeds this multiple of the tolerance has lost a part of the body."""
COARSER = 2.0
"""Factor on tolerance and edge length after a filling that was stopped early."""
ENVELOPE_OF_EDGE = 0.04
"""Default tolerance as a fraction of an edge …"""
LARGEST_ENVELOPE = 0.01
"""… and by this share of the diagonal at most."""
TRIES = 5
MOST_SECONDS = 600.0
"""All fillings together take no longer than this."""
POOR = 0.05
"""Filling is repeated if the worst radius ratio is below this (fTetWild is randomised)."""
LOOSE = 1e-3
"""Disconnected tetrahedra with less than this fraction of the volume are removed."""
Progress = Callable[..., None]


class Lost(InputError):
    """A filling that lost a part of the body."""


class Mesher(Protocol):
    """A mesher of closed surfaces: `tetrahedralise`, or a function with the same arguments."""

    def __call__(
        self,
        points: FloatArray,
        triangles: IntArray,
        *,
        edge_fraction: float,
        envelope: float,
        where: str,
        check_volume: bool,
        seconds: float,
    ) -> TetMesh:
        """Return the tetrahedra of a surface [m]; arguments as those of `tetrahedralise`."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Filled:
    """A surface filled with tetrahedra."""

    mesh: TetMesh
    """In metres."""
    edge_mm: float
    tolerance_mm: float
    deviation_mm: float
    """Largest distance of a point of one surface from the other."""
    done: tuple[str, ...]


def fill(
    points: FloatArray,
    triangles: IntArray,
    options: MeshOptions,
    *,
    where: str = "surface",
    progress: Progress | None = None,
    mesher: Mesher = tetrahedralise,
) -> Filled:
    """Repair a surface and fill it with tetrahedra of the given size.

    Arguments:
        points, triangles: of the file, in `options.unit`, shapes (n, 3) and (t, 3).
        options: size and repairs.
        where: for messages.
        progress: called with a description of each step.
        mesher: of the repaired surface.

    Raises:
        InputError: see `repaired` and `tetrahedralise`; or too many tetrahedra.
    """
    tell = progress or (lambda *_: None)
    tell("mending the surface")
    unit = options.unit or "m"
    surface = repaired(
        points,
        triangles,
        where=where,
        close_holes=options.close_holes,
        fill_cavities=options.fill_cavities,
        part=options.part,
        unit=unit,
    )
    surface = replace(surface, points=freeze(surface.points / PER_METRE[unit]))
    crossing = len(np.unique(crossing_triangles(surface.points, surface.triangles)))
    if crossing:
        note = f"{crossing} triangles intersect others; the union of their interiors was filled"
        surface = replace(surface, done=(*surface.done, note))
    walls = int((sides(surface.triangles)[2] > 2).sum())
    if walls:
        note = f"{walls} edges have more than two triangles (inner walls, or bodies that touch there); their interior was filled"
        surface = replace(surface, done=(*surface.done, note))
    return _of_wanted_size(surface, options, where, crosses=crossing + walls > 0, tell=tell, mesher=mesher)


def _of_wanted_size(
    surface: ClosedSurface, options: MeshOptions, where: str, *, crosses: bool, tell: Progress, mesher: Mesher
) -> Filled:
    """Fill a repaired surface, with longer edges until the number of tetrahedra fits, and again if an element is flat."""
    wanted = options.most_tets or MOST_TETS
    edge, began, thin, rough = first_edge(surface, options), time.monotonic(), surface, 1.0
    fits: Filled | None = None
    fewest: Filled | None = None
    for attempt in range(TRIES):
        seconds = min(MOST_SECONDS - (time.monotonic() - began), FILL_SECONDS)
        tell(f"filling, edges of {1e3 * edge:.2g} mm, try {attempt + 1}, {seconds / 60:.0f} min at most")
        try:
            filled, thin = _fill_once(
                surface, thin, edge, options, where, rough=rough, crosses=crosses, seconds=seconds, mesher=mesher
            )
        except (Unfinished, Lost) as problem:
            if fits or fewest:
                break
            if isinstance(problem, Lost) or rough > 1.0 or options.tolerance_mm is not None:
                raise
            note = (
                f"edges of {1e3 * edge:.2g} mm did not come to an end in {seconds:.0f} s: longer ones, farther from the surface"
            )
            edge, rough, surface = COARSER * edge, COARSER, replace(surface, done=(*surface.done, note))
            thin = surface
            continue
        count = len(filled.mesh.tets)
        slow = time.monotonic() - began > 0.5 * MOST_SECONDS  # another try might not come to an end
        if count <= wanted:
            fits = filled
            if slow or radius_ratio(filled.mesh).min() >= POOR:
                break
            continue
        settled = fewest is not None and count > SETTLED * len(fewest.mesh.tets)
        fewest = filled if fewest is None or count < len(fewest.mesh.tets) else fewest
        if slow or settled or options.size_mm is not None:
            break
        edge = min(edge * 1.08 * (count / wanted) ** (1.0 / 3.0), 0.5 * surface.diagonal)
    return _best(fits, fewest, options, where)


def _best(fits: Filled | None, fewest: Filled | None, options: MeshOptions, where: str) -> Filled:
    """Return the mesh with few enough tetrahedra; by default also the smallest one possible up to ENOUGH_TETS. Raises InputError."""
    if fits is not None:
        return fits
    assert fewest is not None
    count, wanted = len(fewest.mesh.tets), options.most_tets or MOST_TETS
    if options.most_tets is None and count <= ENOUGH_TETS:
        note = f"{count} tetrahedra instead of {wanted}, because of thin walls or fine detail; all later computations take longer in proportion"
        asked = options.size_mm is not None
        return fewest if asked else replace(fewest, done=(*fewest.done, note))
    hint = f"--max-tets {count}, or a larger --tolerance"
    if options.size_mm is not None:
        hint = f"--size {options.size_mm * (count / wanted) ** (1 / 3):.3g}, or --max-tets {count}"
    raise InputError(
        "more tetrahedra than wanted", where=where, found=f"{count}", expected=f"--max-tets {wanted} at most", hint=hint
    )


def first_edge(surface: ClosedSurface, options: MeshOptions) -> float:
    """Return the edge length to begin with [m]: as wanted, or such that regular tetrahedra fill the volume."""
    if options.size_mm is not None:
        return 1e-3 * options.size_mm
    return float(np.cbrt(6.0 * np.sqrt(2.0) * surface.volume / (0.6 * (options.most_tets or MOST_TETS))))


def _fill_once(
    surface: ClosedSurface,
    thinner: ClosedSurface,
    edge: float,
    options: MeshOptions,
    where: str,
    *,
    rough: float,
    crosses: bool,
    seconds: float,
    mesher: Mesher,
) -> tuple[Filled, ClosedSurface]:
    """Return the filled mesh, and the thinned surface for the next attempt."""
    diagonal = surface.diagonal
    given = options.tolerance_mm
    tolerance = 1e-3 * given if given is not None else min(ENVELOPE_OF_EDGE * edge, rough * LARGEST_ENVELOPE * diagonal)
    thin, drifted = thinned(surface, tolerance=0.5 * tolerance, start=thinner)
    envelope = _envelope(drifted, tolerance, diagonal, given is not None)
    made = mesher(
        np.array(thin.points),
        np.array(thin.triangles),
        edge_fraction=edge / diagonal,
        envelope=envelope / diagonal,
        where=where,
        check_volume=not crosses,
        seconds=seconds,
    )
    mesh, notes = _one_body(made, where)
    deviation = deviation_of(mesh, surface, crosses)
    if deviation > ASTRAY * max(tolerance, drifted + envelope):
        raise Lost(
            "a part of the body was lost: its walls are thinner than the mesh may leave the surface",
            where=where,
            found=f"{1e3 * deviation:.2g} mm from the surface",
            expected=f"{1e3 * max(tolerance, drifted + envelope):.2g} mm at most",
            hint="a smaller --size, or a --tolerance of a third of the wall, and a larger --max-tets",
        )
    return Filled(mesh, 1e3 * edge, 1e3 * tolerance, 1e3 * deviation, (*thin.done, *_rougher(drifted, tolerance), *notes)), thin


def _envelope(drifted: float, tolerance: float, diagonal: float, asked: bool) -> float:
    """Return the tolerance between mesh and thinned surface [m]: the remaining one, or by default the roughness if that is larger."""
    if not asked and drifted > 0.5 * tolerance:
        return min(drifted, LARGEST_ENVELOPE * diagonal)
    return max(tolerance - drifted, 0.5 * tolerance)


def _rougher(drifted: float, tolerance: float) -> tuple[str, ...]:
    """Return the note on a surface whose roughness exceeds the tolerance [m]."""
    if drifted <= 0.5 * tolerance:
        return ()
    return (
        f"the surface is rougher than the tolerance: the thinned one is up to {1e3 * drifted:.2g} mm away, "
        f"where {1e3 * tolerance:.2g} mm were allowed",
    )


def deviation_of(mesh: TetMesh, surface: ClosedSurface, crosses: bool) -> float:
    """Return the largest distance of a point of one surface from the other [m]; where shells cross,
    of the mesh from the surface."""
    skin, numbers = np.unique(surface_triangles(mesh), return_inverse=True)
    out = float(distance_to(surface.points, surface.triangles, mesh.nodes[skin]).max())
    if crosses:  # triangles inside another shell have no counterpart
        return out
    return max(out, float(distance_to(mesh.nodes[skin], numbers.reshape(-1, 3), surface.points).max()))


def _one_body(mesh: TetMesh, where: str) -> tuple[TetMesh, tuple[str, ...]]:
    """Return the mesh without loose crumbs. Raises InputError where larger parts hang loose."""
    parts = hinged_parts(mesh)
    volume = np.bincount(parts, element_volumes(mesh))
    if len(volume) == 1:
        check_mesh(mesh, where)
        return mesh, ()
    main = int(volume.argmax())
    loose = 1.0 - volume[main] / volume.sum()
    if loose > LOOSE:
        raise InputError(
            "the tetrahedra fall into parts that no face joins",
            where=where,
            found=f"{len(volume)} parts; all but the largest hold {100 * loose:.3g} % of the volume",
            expected="one connected body (an edge or a corner alone is a hinge)",
            hint=(
                "a larger --max-tets or a smaller --size keeps thin bridges; bodies that only touch: let them overlap in the "
                "CAD program"
            ),
        )
    nodes, tets = np.unique(mesh.tets[parts == main], return_inverse=True)
    kept = TetMesh(mesh.nodes[nodes], tets.reshape(-1, mesh.tets.shape[1]))
    check_mesh(kept, where)
    return kept, (f"{len(volume) - 1} disconnected pieces of negligible volume were removed",)
