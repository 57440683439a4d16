"""Options of a mesh, in Python and on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from femsense.core.options import Flag


class Element(StrEnum):
    """Tetrahedra with straight edges, or with nodes in the middle of their edges."""

    tet4 = "tet4"
    tet10 = "tet10"


@dataclass(frozen=True, eq=False, slots=True)
class MeshOptions:
    """Options of a mesh."""

    unit: Annotated[str | None, Flag("--unit", "m|cm|mm", "Unit of the surface file; required except for STEP.")] = None
    size_mm: Annotated[float | None, Flag("--size", "MM", "Edge length of the tetrahedra.")] = None
    """By default from `most_tets`."""
    most_tets: Annotated[
        int | None, Flag("--max-tets", "N", "Largest number of tetrahedra (2000; more for thin walls).", min=6)
    ] = None
    """None: MOST_TETS, or up to ENOUGH_TETS if the body needs them."""
    tolerance_mm: Annotated[float | None, Flag("--tolerance", "MM", "Largest distance between mesh and surface.")] = None
    """By default a share of the edge length."""
    element: Annotated[Element, Flag("--element", None, "For a new robot.toml.")] = Element.tet10
    close_holes: Annotated[bool, Flag("--close-holes", help="Close large holes too, by flat caps.")] = False
    fill_cavities: Annotated[bool, Flag("--fill-cavities", help="Treat inner shells as solid, not as chambers.")] = False
    part: Annotated[int | None, Flag("--part", "N", "Which of several bodies; 1 is the largest.", min=1)] = None
