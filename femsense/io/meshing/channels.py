"""Tendons in channels: a path that is subdivided until the equilibrium's answer stops changing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.meshing.line_body import LineBody, place, section_at
from femsense.io.meshing.line_sections import second_moment
from femsense.model.tie_spacing import HELD

FEWEST, MOST = 8, 256
"""Points of a path at least and at most."""
SEARCHED_WITH, MOST_TRIES = 64, 12
"""Points with which a tension that bends the body is looked for, and how many are tried."""
STILL = 0.005
"""A path is fine enough where twice the points change the motion by less than this share of it [1].
The tentacle of docs/guides/bodies.md moves by 6 % from 16 to 32 points at 4.6 N, by 0.8 % from 32 to 64, and by 0.2 % from 64 to 128."""
GAP = 0.01
"""Distance of the default pull point from the beginning of the channel, along its direction [m]."""
BEND = 0.4
"""Paths are tried at a tension that moves the body by this share of its length [1],
or at the largest one if that is smaller: beyond, bodies curl up and answer anything."""


@dataclass(frozen=True, eq=False, slots=True)
class Channel:
    """Where a tendon runs in a body along a line."""

    name: str
    start: float
    """Length along the line where it enters [m]."""
    end: float
    """Where it is fixed [m]."""
    distances: tuple[float, float]
    """From the axis, at start and end [m]."""
    angles: tuple[float, float]
    """About the axis, at start and end [rad]."""
    pull_point: FloatArray | None
    """[m], shape (3,); None: straight on before the start."""
    max_tension: float
    """[N]; inf where it is not given."""
    points: int | None
    """Of the path; None: as many as it needs."""

    @property
    def need(self) -> tuple[object, ...]:
        """The properties that determine the number of path points: all except the name and the start angle."""
        return self.start, self.end, self.distances, self.angles[1] - self.angles[0], self.max_tension, self.points


@dataclass(frozen=True, eq=False, slots=True)
class Subdivision:
    """How the path of a tendon was subdivided."""

    name: str
    points: int
    change: float
    """Relative change of the motion with twice the number of points [1]; nan if not computed."""
    tension: float
    """At which it was tried [N]; nan where it was not."""
    moved: float
    """How far the body moved there, at most [m]."""


def channel_path(line: LineBody, channel: Channel, count: int) -> FloatArray:
    """Return points of a channel, evenly spaced, far end first [m], shape (count, 3)."""
    shares = np.linspace(1.0, 0.0, count)
    return np.array([_channel_point(line, channel, share) for share in shares])


def pull_point(line: LineBody, channel: Channel) -> FloatArray:
    """Return the point at which a tendon leaves the body towards its motor [m], shape (3,)."""
    if channel.pull_point is not None:
        return channel.pull_point
    before = channel.start - GAP
    return place(line, before, channel.distances[0], channel.angles[0])


def _channel_point(line: LineBody, channel: Channel, share: float) -> FloatArray:
    along, distance, angle = (
        (1.0 - share) * a + share * b for a, b in ((channel.start, channel.end), channel.distances, channel.angles)
    )
    return place(line, along, distance, angle)


def subdivided(
    body: BodyModel, line: LineBody, channel: Channel, *, tell: Callable[[str], None] = lambda text: None
) -> Subdivision:
    """Return the number of points of a tendon's path: doubled until the equilibrium changes by less than STILL of the motion.

    Arguments:
        body: without cables, with its weight.
        line, channel: where the tendon runs.
        tell: called with a description of each trial.
    """
    if channel.points is not None:
        return Subdivision(channel.name, channel.points, np.nan, np.nan, np.nan)
    rest = solve_equilibrium(body).positions
    pulled = _Pulled(body, line, channel, rest)
    tension = pulled.tension_that_moves(BEND * line.length)
    most = channel.max_tension if np.isfinite(channel.max_tension) else tension
    count, change, moved = points_that_hold(body, line, channel, most), np.inf, 0.0
    before = pulled.at(tension, count)
    while count < MOST and change >= STILL:
        tell(f"{channel.name}: {2 * count} points of its channel at {tension:.3g} N")
        after = pulled.at(tension, 2 * count)
        if before is not None and after is not None:
            moved = _farthest(after, rest)
            change = _farthest(after, before) / moved
        count, before = (count if change < STILL else 2 * count), after
    return Subdivision(channel.name, count, change, tension, moved)


def points_that_hold(body: BodyModel, line: LineBody, channel: Channel, tension: float) -> int:
    """Return a number of points to begin with: the body between two of them carries the tension (`tie_spacing`)."""
    E = float(body.material.young_modulus.min())
    stiffness = min(E * second_moment(section_at(line, s)) for s in np.linspace(channel.start, channel.end, 50))
    spacing = np.pi * np.sqrt(HELD * stiffness / max(tension, 1e-12))
    return int(np.clip(np.ceil((channel.end - channel.start) / spacing) + 1, FEWEST, MOST // 2))


@dataclass(frozen=True, eq=False, slots=True)
class _Pulled:
    """A body pulled by one tendon with a path of some points."""

    body: BodyModel
    line: LineBody
    channel: Channel
    rest: FloatArray

    def at(self, tension: float, count: int) -> FloatArray | None:
        """Return the positions under a tension [N] with a number of points; None if the body buckles between them or collapses."""
        pulled = with_cables(self.body, self.line, [self.channel], [count])
        state = solve_equilibrium(pulled, tension={self.channel.name: tension})
        return state.positions if state.converged else None

    def tension_that_moves(self, distance: float) -> float:
        """Return a tension [N] that moves the body about so far [m], at most the largest;
        half of it where the body is lost on the way."""
        most = self.channel.max_tension
        tension = min(1e-3, most)
        for _ in range(MOST_TRIES):
            state = self.at(tension, SEARCHED_WITH)
            if state is None:
                return 0.5 * tension
            moved = _farthest(state, self.rest)
            if moved > 0.7 * distance or tension >= most:
                break
            tension = min(most, tension * float(np.clip(distance / max(moved, 1e-12), 1.2, 10.0)))
        return tension


def _farthest(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


def with_cables(body: BodyModel, line: LineBody, channels: Sequence[Channel], counts: Sequence[int]) -> BodyModel:
    """Return a body with tendons in their channels, each subdivided into the given number of points."""
    cables = tuple(
        tie_cable(body.mesh, c.name, channel_path(line, c, n), pull_point(line, c), max_tension=c.max_tension)
        for c, n in zip(channels, counts)
    )
    made = make_body(
        body.mesh,
        young_modulus=body.material.young_modulus,
        poisson_ratio=body.material.poisson_ratio,
        density=body.material.density,
        clamped=body.clamped,
        cables=cables,
        gravity=body.gravity,
    )
    return replace(made, clamp_nodes=body.clamp_nodes)
