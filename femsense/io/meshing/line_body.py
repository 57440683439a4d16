"""A body along a centre line, and its tetrahedra: sections, folds, cavities and channels at lengths along the line."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh
from femsense.io.meshing.line_sections import Section, between
from femsense.io.meshing.sweep import Kept, Layer, polar_triangles, sweep

Levels = Callable[[float], FloatArray]
TURN = 2.0 * np.pi
FINEST, COARSEST = 0.8, 4.0
"""Smallest and largest thickness of a layer in radii [1]."""
PER_FOLD = 6
"""Least number of layers of a fold: three on each flank."""
WIDEST = TURN / 8 * 1.001
"""A sector is not wider than this [rad]."""
MOST_SECTORS = 24


@dataclass(frozen=True, eq=False, slots=True)
class Cavity:
    """A closed chamber along a part of the line: around the axis, or a sector of a ring off the axis."""

    name: str
    start: float
    """Length along the line at which it begins [m]."""
    end: float
    """[m]."""
    inner: float
    """Its least distance from the axis [m]; 0: around the axis."""
    outer: float
    """Its largest distance from the axis [m]; 0 if `wall` determines it."""
    angles: tuple[float, float]
    """From and to [rad]; not used around the axis."""
    wall: float = 0.0
    """Thickness of the wall outside of it [m]; 0 if `outer` determines it."""
    max_pressure: float = 40e3
    """[Pa]."""

    @property
    def is_central(self) -> bool:
        return self.inner == 0.0

    @property
    def middle(self) -> tuple[float, float, float]:
        """Length along the line, distance from the axis [m] and angle [rad] of a point inside."""
        distance = 0.0 if self.is_central else 0.5 * (self.inner + self.outer)
        return 0.5 * (self.start + self.end), distance, 0.5 * sum(self.angles)


@dataclass(frozen=True, eq=False, slots=True)
class Fold:
    """Bellows: folds that narrow the outline between `start` and `end`."""

    start: float
    """[m]."""
    end: float
    """[m]."""
    count: int
    depth: float
    """How much smaller the radius is at the bottom of a fold [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class LineBody:
    """A centre line with its sections."""

    points: FloatArray
    """[m], shape (n, 3)."""
    sections: tuple[Section, ...]
    """One a point; two at the same point where a hole begins or ends."""
    zero: FloatArray
    """Direction of angle 0 at the first point, shape (3,)."""
    folds: tuple[Fold, ...] = ()
    cavities: tuple[Cavity, ...] = ()
    rings: int = 2
    """Elements from the axis to the outline."""

    @property
    def stations(self) -> FloatArray:
        """Length along the line of each point [m], shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """[m]."""
        return float(self.stations[-1])

    @property
    def around(self) -> list[Cavity]:
        """Cavities off the axis."""
        return [c for c in self.cavities if not c.is_central]


def place(line: LineBody, along: float, distance: float = 0.0, angle: float = 0.0) -> FloatArray:
    """Return a point by length along the line [m], distance from it [m] and angle [rad], shape (3,);
    beyond the ends it goes on straight."""
    s = line.stations
    axes, tangent = frame_at(line, along)
    center = np.array([np.interp(along, s, line.points[:, i]) for i in range(3)])
    center = center + (along - float(np.clip(along, 0.0, s[-1]))) * tangent
    return np.asarray(center + distance * (np.cos(angle) * axes[0] + np.sin(angle) * axes[1]))


def frame_at(line: LineBody, along: float) -> tuple[FloatArray, FloatArray]:
    """Return the directions of angle 0 and of 90°, shape (2, 3), and the tangent (3,) at a length [m]:
    carried along without twist."""
    s = line.stations
    legs = np.diff(line.points, axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 0]
    legs = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    marks = np.unique(s)
    tangents = np.vstack([legs[:1], legs[:-1] + legs[1:], legs[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    zero, zeros = line.zero, []
    for tangent in tangents:
        zero = zero - (zero @ tangent) * tangent
        zero = zero / np.linalg.norm(zero)
        zeros.append(zero)
    tangent = _between(marks, tangents, along)
    u = _between(marks, np.array(zeros), along)
    u = u - (u @ tangent) * tangent
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(tangent, u)]), tangent


def _between(marks: FloatArray, vectors: FloatArray, along: float) -> FloatArray:
    vector = np.array([np.interp(along, marks, vectors[:, i]) for i in range(3)])
    return np.asarray(vector / np.linalg.norm(vector))


def section_at(line: LineBody, along: float) -> Section:
    """Return the section at a length [m], folded, without chambers; where a hole begins or ends, with it."""
    s = line.stations
    at = int(np.clip(np.searchsorted(s, along, side="right") - 1, 0, len(s) - 2))
    same = np.flatnonzero(np.isclose(s, along, rtol=0.0, atol=1e-9 * s[-1]))
    if len(same):
        section = max((line.sections[i] for i in same), key=lambda one: one.hole_width)
    else:
        section = between(line.sections[at], line.sections[at + 1], float((along - s[at]) / (s[at + 1] - s[at])))
    for fold in line.folds:
        if fold.start < along < fold.end:
            turns = (along - fold.start) / (fold.end - fold.start) * fold.count
            back = 0.5 * fold.depth * (1.0 - np.cos(TURN * turns))
            section = replace(section, half_width=section.half_width - back, half_height=section.half_height - back)
    return section


def bored(line: LineBody, along: float) -> bool:
    """Return whether the body is hollow around the axis at a length [m] that is no station."""
    s = line.stations
    at = int(np.clip(np.searchsorted(s, along, side="right") - 1, 0, len(s) - 2))
    bore = min(line.sections[at].hole_width, line.sections[at + 1].hole_width) > 0
    return bore or any(c.is_central and c.start < along < c.end for c in line.cavities)


def with_hole(line: LineBody, section: Section, along: float) -> Section:
    """Return a section with the hole of a chamber around the axis that is there."""
    for cavity in line.cavities:
        if cavity.is_central and cavity.start - 1e-9 <= along <= cavity.end + 1e-9:
            wall = cavity.wall
            width = section.half_width - wall if wall else cavity.outer
            height = section.half_height - wall if wall else cavity.outer
            return replace(section, hole_width=width, hole_height=height)
    return section


def mesh_line(line: LineBody, *, most_tets: int = 2000, along: float | None = None) -> tuple[TetMesh, FloatArray]:
    """Return the tetrahedra of a body, and the length along the line of each node [m], shape (n,).

    Arguments:
        line: the body.
        most_tets: approximate largest number; it determines the thickness of the layers.
        along: thickness of a layer [m] instead.

    Raises:
        InputError: chambers that leave the body or meet, or too many tetrahedra.
    """
    angles = corner_angles(line)
    levels = ring_levels(line)
    triangles, _, _ = polar_triangles(len(levels(0.0)), len(angles))
    lengths = layer_places(line, most_layers=most_tets / (3.0 * len(triangles)), along=along)
    layers = []
    for s in lengths:
        section = with_hole(line, section_at(line, s), s)
        rings = levels(s)
        if section.hole_width > 0:
            rings = _around_hole(line, rings, section, s)
        layers.append(Layer(place(line, s), frame_at(line, s)[0], section, rings))
    mesh, layer = sweep(layers, angles, _kept(line, lengths, angles, levels))
    return mesh, lengths[layer]


def _around_hole(line: LineBody, rings: FloatArray, section: Section, along: float) -> FloatArray:
    """Return levels that begin at the hole."""
    first = section.hole_width / section.half_width
    if first >= 1.0 or (line.around and first >= rings[1]):
        raise InputError(
            "the hole leaves no wall",
            where=f"{1e3 * along:.4g} mm along the line",
            found=f"a hole of {1e3 * section.hole_width:.4g} mm in a body of {1e3 * section.half_width:.4g} mm radius",
            expected="a smaller hole",
        )
    if line.around:
        return np.concatenate([[first], rings[1:]])
    return np.linspace(first, 1.0, len(rings))


def corner_angles(line: LineBody) -> FloatArray:
    """Return the angles of the corners around the axis [rad], shape (n,): eight, or such that chambers begin and end at them."""
    bounds = sorted({round(a % TURN, 9) for c in line.around for a in c.angles})
    if not bounds:
        return np.arange(8) * TURN / 8
    if any(section.squareness for section in line.sections):
        raise InputError(
            "chambers off the axis need a round section",
            where="chambers",
            found="width_mm and height_mm",
            expected="radius_mm, or area_mm2 with second_moment_mm4",
        )
    widths = np.diff([*bounds, bounds[0] + TURN])
    for sectors in range(8, MOST_SECTORS + 1):
        counts = np.maximum(1, np.ceil(widths / (TURN / sectors) - 1e-6)).astype(int)
        if counts.sum() <= MOST_SECTORS and (widths / counts).max() <= WIDEST:
            parts = [b + w * np.arange(n) / n for b, w, n in zip(bounds, widths, counts)]
            return np.concatenate(parts)
    raise InputError(
        "chambers at too many angles", where="chambers", found=f"{len(bounds)} bounds", expected=f"{MOST_SECTORS} at most"
    )


def ring_levels(line: LineBody) -> Levels:
    """Return a function of the length along the line [m] → where the rings are between axis and outline [1], shape (r,)."""
    pairs = sorted({(c.inner, c.outer) for c in line.around})
    if not pairs:
        even = np.arange(1, line.rings + 1) / line.rings
        return lambda along: even
    bounds = [(inner, [c for c in line.around if (c.inner, c.outer) == (inner, outer)]) for inner, outer in pairs]
    bounds += [(outer, [c for c in line.around if (c.inner, c.outer) == (inner, outer)]) for inner, outer in pairs]
    bounds.sort(key=lambda bound: bound[0])

    def levels(along: float) -> FloatArray:
        found = [_level(line, distance, cavities, along) for distance, cavities in bounds]
        rings = np.array([0.6 * found[0], *found, 1.0])
        if (np.diff(rings) <= 1e-3).any():
            raise InputError(
                "chambers leave no wall, or lie at distances that do not fit together",
                where=f"{1e3 * along:.4g} mm along the line",
                found="rings at " + ", ".join(f"{1e3 * r * section_at(line, along).half_width:.4g}" for r in rings) + " mm",
                expected="chambers inside the body, those side by side at the same distance",
            )
        return rings

    return levels


def _level(line: LineBody, distance: float, cavities: Sequence[Cavity], along: float) -> float:
    """Return the radial position of a chamber boundary [1]: at its distance along the chambers, and at a fraction of the radius between
    them."""
    if any(c.start <= along <= c.end for c in cavities):
        return distance / section_at(line, along).half_width
    knots = sorted(s for c in cavities for s in (c.start, c.end))
    return float(np.interp(along, knots, [distance / section_at(line, s).half_width for s in knots]))


def layer_places(line: LineBody, *, most_layers: float, along: float | None = None) -> FloatArray:
    """Return the positions of the layers along the line [m]: at all boundaries, and between them according to the radius."""
    bounds = {0.0, line.length, *line.stations.tolist()}
    bounds |= {s for c in line.cavities for s in (c.start, c.end)} | {s for f in line.folds for s in (f.start, f.end)}
    marks = np.array(sorted(bounds))
    marks = marks[np.append(True, np.diff(marks) > 1e-6)]
    fine = np.linspace(0.0, line.length, 2001)
    radii = np.array([section_at(line, s).size for s in fine])
    counted = np.concatenate([[0.0], np.cumsum(0.5 * (1 / radii[1:] + 1 / radii[:-1]) * np.diff(fine))])  # length in radii
    if along is not None:
        counted, thickness = fine, along
    else:
        thickness = max(FINEST, counted[-1] / max(most_layers - 0.5 * len(marks), 1.0))
        if thickness > COARSEST:
            raise InputError(
                "more tetrahedra than wanted",
                where="--max-tets",
                found=f"layers of {thickness:.2g} radii",
                expected=f"{COARSEST:g} radii at most",
                hint="a larger --max-tets",
            )
    places = [0.0]
    for low, high in itertools.pairwise(marks):
        first, last = np.interp([low, high], fine, counted)
        count = max(1, round((last - first) / thickness), _least_layers(line, low, high))
        places += np.interp(np.linspace(first, last, count + 1)[1:], counted, fine).tolist()
    exact = np.array(places)
    for mark in marks:
        exact[np.abs(exact - mark).argmin()] = mark
    return exact


def _least_layers(line: LineBody, low: float, high: float) -> int:
    """Return how many layers the folds want between two lengths."""
    folds = [f for f in line.folds if f.start < 0.5 * (low + high) < f.end]
    return max([int(np.ceil(PER_FOLD * f.count * (high - low) / (f.end - f.start))) for f in folds], default=1)


def _kept(line: LineBody, lengths: FloatArray, angles: FloatArray, levels: Levels) -> Kept:
    """Return which cells of a slab belong to the body."""
    middles = np.append(angles, angles[0] + TURN)
    middles = 0.5 * (middles[:-1] + middles[1:])

    def keep(slab: int, rings: IntArray, sectors: IntArray) -> BoolArray:
        along = 0.5 * (lengths[slab] + lengths[slab + 1])
        body = np.ones(len(rings), dtype=bool)
        if bored(line, along):
            body &= rings > 0
        for cavity in line.around:
            if not cavity.start < along < cavity.end:
                continue
            radius = section_at(line, along).half_width
            rim = levels(along)
            between_rings = 0.5 * (rim[rings] + rim[np.maximum(rings - 1, 0)]) * radius
            turned = (middles[sectors] - cavity.angles[0]) % TURN
            inside = (cavity.inner < between_rings) & (between_rings < cavity.outer) & (rings > 0)
            body &= ~(inside & (turned < cavity.angles[1] - cavity.angles[0]))
        return body

    return keep
