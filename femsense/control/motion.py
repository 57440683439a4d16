"""Arguments and results of `reach`."""

from __future__ import annotations

from dataclasses import dataclass

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium

REACHED, NEAREST, STOPPED, CONVERGING = "reached", "nearest", "stopped", "converging"


@dataclass(frozen=True, slots=True)
class WallContact:
    """A point of the body that is to press against a wall with a wanted force (hybrid control of position and force)."""

    point_m: tuple[float, float, float]
    """The point of the body that touches, at rest, robot frame [m]."""
    normal: tuple[float, float, float]
    """Unit normal of the wall, away from it and into the body's side, robot frame."""
    offset_m: float
    """The wall holds the places x with normal · x = offset [m]."""
    force_n: float
    """Wanted force of the wall on the body along the normal [N], ≥ 0."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """How far an answer is from the conditions of Karush, Kuhn and Tucker, all of them measured at the end."""

    equilibrium_n: float
    """Largest unbalanced nodal force [N]."""
    gradient: float
    """Share of the squared error that the linearised problem could still take away within the limits [1]."""
    violation: float
    """Largest violation of a limit, in units of the limit's range [1]."""


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """Inputs that bring points of the body to wanted places, or as near as the limits allow."""

    inputs: dict[str, float]
    """Commands: tension [N] or shortening [m] of each cable, pressure [Pa] of each chamber."""
    positions: FloatArray
    """Where the nodes end up at equilibrium [m], shape (n, 3)."""
    reached_m: dict[str, FloatArray]
    """Target → where its point ends up at equilibrium, robot frame [m], shape (3,)."""
    error_m: float
    """Largest distance of a point from its target, along the directions that are wanted [m]."""
    status: str
    """"reached"; "nearest": the limits allow no better, or no equilibrium was found further on; "stopped": steps ran out on the way;
    "converging": more steps come nearer (`Follower`)."""
    limits: tuple[str, ...]
    """The limits that stop it, in words, those that cost most first."""
    certificate: Certificate
    iterations: int
    """Equilibria that were solved."""
    equilibrium: Equilibrium
    """The state, a start for the next target."""
    correction_std_m: float | None = None
    """Standard deviation along each axis of the empirical correction in `reached_m` [m]; None if it is not used."""

    @property
    def text(self) -> str:
        """The outcome in one sentence."""
        if self.status == REACHED:
            sure = "" if self.correction_std_m is None else f"; the correction is sure to ± {1e3 * self.correction_std_m:.2g} mm"
            return f"reached to {1e3 * self.error_m:.3g} mm{sure}"
        by = f"; stopped by {', '.join(self.limits)}" if self.limits else ""
        if self.status == CONVERGING:
            return f"converging: {1e3 * self.error_m:.3g} mm off by now{by}"
        if self.status == NEAREST:
            reason = by or "; no input moves the points that way"
            return f"out of reach: the nearest is {1e3 * self.error_m:.3g} mm off{reason}"
        why = by if self.equilibrium.converged else f": {self.equilibrium.advice}{by}"
        return f"stopped {1e3 * self.error_m:.3g} mm off after {self.iterations} equilibria{why}"
