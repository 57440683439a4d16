"""Check of the spacing of a cable's path points: the body must not buckle away from the cable between two of them.

Between two points that tie it, a cable runs straight. The body there is a column under the tension T:
it leaves the cable as a column of length ℓ that is held at its ends, by a factor 1/(1 − T/P) with Euler's P = π² EI/ℓ²,
and buckles at P.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from femsense.fem.body import BodyModel
from femsense.fem.body_parts import Cable
from femsense.fem.sections import cut_section

HELD = 0.15
"""Share of Euler's load that a tension may be [1]. The tentacle of docs/guides/bodies.md answers 85 % wrong where it is 0.90,
6.4 % at 0.24, 1.0 % at 0.06 and 0.2 % at 0.02 (benchmarks/bodies.py)."""
ONE_TURN = 1.0
"""Without a declared largest tension, the tension that bends the body along the path by this angle is assumed [rad]."""


@dataclass(frozen=True, eq=False, slots=True)
class TieSpacing:
    """The widest gap between two points of a cable's path, by what the body there bears."""

    cable: str
    after: int
    """Number of the point at its far end."""
    gap: float
    """Its length [m]."""
    buckles_at: float
    """Euler's load of the body there [N]."""
    tension: float
    """The largest tension that is declared, or one that bends the body well [N]."""
    declared: bool
    """Whether that tension is declared."""

    @property
    def holds(self) -> bool:
        """Whether the points lie close enough."""
        return self.tension <= HELD * self.buckles_at

    @property
    def points_wanted(self) -> float:
        """Ratio of the number of points that the path needs to the number it has [1]."""
        return float(np.sqrt(self.tension / (HELD * self.buckles_at)))


def tie_spacing(body: BodyModel, cable: Cable) -> TieSpacing | None:
    """Return the gap of a path where the body buckles first; None for a path of one point,
    which is tied to it and runs through nothing."""
    points = cable.path.positions(body.mesh.nodes)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    loads, bent = [], 0.0
    for first, second, gap in zip(points[:-1], points[1:], gaps):
        middle = 0.5 * (first + second)
        section = cut_section(body.mesh, body.material.young_modulus, middle, second - first) if gap > 0 else None
        beside = np.inf if section is None else float(np.linalg.norm(section.centroid - middle))
        if section is None or beside > np.sqrt(section.area):  # the cable runs through the air there
            loads.append(np.inf)
            continue
        loads.append(np.pi**2 * float(section.bending[0]) / gap**2)
        bent += gap * beside / float(section.bending[0])
    if not np.isfinite(loads).any():
        return None
    worst = int(np.argmin(loads))
    declared = bool(np.isfinite(cable.max_tension))
    tension = cable.max_tension if declared else (ONE_TURN / bent if bent > 0 else 0.0)
    return TieSpacing(cable.name, worst, float(gaps[worst]), float(loads[worst]), float(tension), declared)


def warn_of_tie_spacing(body: BodyModel) -> None:
    """Warn about cables between whose points the body buckles."""
    for cable in body.cables:
        spacing = tie_spacing(body, cable)
        if spacing is not None and not spacing.holds:
            warnings.warn(tie_spacing_text(spacing, len(cable.path)), stacklevel=2)


def tie_spacing_text(spacing: TieSpacing, count: int) -> str:
    """Return a warning for a path of `count` points that does not hold."""
    pulled = "its max_tension_n" if spacing.declared else "what bends the body by 57°"
    return (
        f"cable {spacing.cable!r}: its points are too far apart. The body is free between points {spacing.after} and "
        f"{spacing.after + 1} of its path ({1e3 * spacing.gap:.3g} mm) and buckles there at {spacing.buckles_at:.3g} N. The "
        f"cable may pull {spacing.tension:.3g} N ({pulled}), more than {HELD:.0%} of that: the body leaves the cable. "
        f"Where it runs in a channel, give it about {int(np.ceil(count * spacing.points_wanted))} points instead of {count} (femsense docs bodies)"
    )
