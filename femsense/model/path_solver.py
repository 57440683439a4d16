"""Solver settings of the states of a path and of their linear response."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.model.drive import DrivenRobot
from femsense.model.frame_state import solve_frame

LOOKED_AT = 60
"""Newton steps of a state that is only looked at, load steps included. Where walls of chambers blow up, many more lead nowhere."""


@dataclass(frozen=True, slots=True)
class PathSolver:
    """The two solves of a path; another one may watch them, or fail as a real one does."""

    equilibrium: Callable[..., Equilibrium] = solve_frame
    """As `solve_frame`."""
    tangent: Callable[..., Tangent] = tangent_at
    """As `tangent_at`."""
    rough: bool = False
    """States are only tried, where one near by is known."""


def look_at(driven: DrivenRobot, frame: int, *, start: Equilibrium | None, options: SolveOptions) -> Equilibrium:
    """Return the state of a frame as `solve_frame` does, or how far few steps lead."""
    return solve_frame(driven, frame, start=start, options=replace(options, newton=replace(options.newton, most_steps=LOOKED_AT)))
