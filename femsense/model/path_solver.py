"""What the states of a path, and their linear response, are solved with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.model.frame_state import solve_frame


@dataclass(frozen=True, slots=True)
class PathSolver:
    """The two solves of a path; another one may watch them, or fail as a real one does."""

    equilibrium: Callable[..., Equilibrium] = solve_frame
    """As `solve_frame`."""
    tangent: Callable[..., Tangent] = tangent_at
    """As `tangent_at`."""
