"""Arguments and results of `reach`."""

from __future__ import annotations

from dataclasses import dataclass

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium

REACHED, NEAREST, STOPPED, CONVERGING = "reached", "nearest", "stopped", "converging"


@dataclass(frozen=True, slots=True)
class WallContact:
    """A point of the body that presses against a wall with a given force (hybrid control of position and force)."""

    point_m: tuple[float, float, float]
    """The contact point of the body at rest, robot frame [m]."""
    normal: tuple[float, float, float]
    """Unit normal of the wall towards the body, robot frame."""
    offset_m: float
    """The wall is the plane of points x with normal · x = offset [m]."""
    force_n: float
    """Force of the wall on the body along the normal [N], ≥ 0."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """Residuals of the Karush–Kuhn–Tucker conditions in the final state."""

    equilibrium_n: float
    """Largest unbalanced nodal force [N]."""
    gradient: float
    """Share of the squared error that the linearised problem could still remove within the limits [1]."""
    violation: float
    """Largest violation of a length limit [m] plus that of an effort limit [N or Pa]."""


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """Result of `reach`: inputs that bring points of the body to their targets, or as close as the limits allow."""

    inputs: dict[str, float]
    """Commands: tension [N] or shortening [m] of each cable, pressure [Pa] of each chamber."""
    positions: FloatArray
    """Node positions in the final equilibrium [m], shape (n, 3)."""
    reached_m: dict[str, FloatArray]
    """Target → position of its point in the final equilibrium, robot frame [m], shape (3,)."""
    error_m: float
    """Largest distance of a point from its target, along the constrained directions [m]."""
    status: str
    """"reached"; "nearest": no step within the limits reduces the error, or no equilibrium was found farther on; "stopped": the steps ran out;
    "converging": further steps reduce the error (`Follower`)."""
    limits: tuple[str, ...]
    """The active limits in words, the most costly first."""
    certificate: Certificate
    """Residuals of the optimality conditions in the final state."""
    iterations: int
    """Number of equilibria that were solved."""
    equilibrium: Equilibrium
    """The final state, a warm start for the next target."""
    correction_std_m: float | None = None
    """Standard deviation along each axis of the empirical correction in `reached_m` [m]; None if it is not used."""

    @property
    def text(self) -> str:
        """The result in one sentence."""
        if self.status == REACHED:
            sure = (
                ""
                if self.correction_std_m is None
                else f"; standard deviation of the correction {1e3 * self.correction_std_m:.2g} mm"
            )
            return f"reached to {1e3 * self.error_m:.3g} mm{sure}"
        by = f"; stopped by {', '.join(self.limits)}" if self.limits else ""
        if self.status == CONVERGING:
            return f"converging: {1e3 * self.error_m:.3g} mm from the target{by}"
        if self.status == NEAREST:
            reason = by or "; no input moves the points in that direction"
            return f"out of reach: the closest state is {1e3 * self.error_m:.3g} mm from the target{reason}"
        why = by if self.equilibrium.converged else f": {self.equilibrium.advice}{by}"
        return f"stopped {1e3 * self.error_m:.3g} mm from the target after {self.iterations} equilibria{why}"
