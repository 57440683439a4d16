"""Build the four-leg robot: its surface, the tetrahedra inside, robot.toml and the picture of the README.

    python meshes/four-leg/build.py              # four_leg.vtu and robot.toml
    python meshes/four-leg/build.py --picture    # four_leg.png too
    python meshes/four-leg/build.py --keep-mesh  # robot.toml alone, the mesh as it is

The surface is one closed skin of triangles made with trimesh: four tubes that go out from a hub, arch over a knee and come
down on feet, a stem on the hub, and the lids that close them. pytetwild (fTetWild) fills it with tetrahedra. fTetWild
shuffles, and gives another mesh each time: the script makes a few and keeps the one whose worst tetrahedron is the best.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from femsense import InputError, TetMesh, write_mesh
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import to_quadratic
from femsense.fem.mesh_checks import check_mesh
from femsense.io.files import write_toml
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.tetrahedra import tetrahedralise

HERE = Path(__file__).resolve().parent
LEGS = {"east": 0, "north": 1, "west": 2, "south": 3}
"""Name → quarter turns from the x axis."""

# One leg in the plane of radius and height [mm], from the hub outwards to the foot.
LEG_POINTS = np.array([[13.0, 80.0], [36.0, 84.0], [62.0, 76.0], [78.0, 54.0], [79.0, 30.0], [72.0, 7.0], [70.0, 0.0]])
LEG_WIDTH = np.array([26.0, 22.0, 19.0, 18.0, 18.0, 22.0, 24.0])
LEG_THICKNESS = np.array([18.0, 15.0, 13.0, 13.0, 13.0, 17.0, 20.0])
STATIONS = 15
"""Rings of quads along a leg, the foot pad not counted."""
KNEE = 9
"""Cross-section that the cable is tied to."""
ROUND = 0.86
"""Corners of a cross-section, over those of its rectangle."""
STEM = ((94.0, 0.78, 0.9), (110.0, 0.62, 0.85))
"""Levels of the stem: height [mm], size over the hub's, roundness."""
VIEW = np.array([-0.35, -0.6, 0.72])
"""Towards a camera in front; the feet's markers sit where it sees them."""
ACROSS, OUTWARD = (-1.0, 0.0, 1.0), (-1.0, 1.0)
"""Points of a leg's cross-section: three across, two outwards (up at the hub)."""
RIM = ((0, 1, 2, 2, 1, 0), (0, 0, 0, 1, 1, 1))
"""The points of a leg's cross-section around its border."""
STEM_RIM = ((0, 1, 2, 2, 2, 1, 0, 0), (0, 0, 0, 1, 2, 2, 2, 1))
"""The points of the stem's cross-section (x, y) around its border."""
EDGE_FRACTION = 0.1
"""Wanted edge of a tetrahedron, over the diagonal of the bounding box."""
TRIES = 12
MOST_UNKNOWNS = 7000


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep-mesh", action="store_true", help="leave four_leg.vtu as it is")
    parser.add_argument("--picture", action="store_true", help="render four_leg.png too")
    wanted = parser.parse_args()
    surface, legs = build_surface()
    check_surface(surface)
    if not wanted.keep_mesh:
        write_mesh(best_mesh(surface, legs), HERE / "four_leg.vtu")
    write_toml(HERE / "robot.toml", robot_document(legs))
    if wanted.picture:
        import picture

        picture.draw(HERE)


# The surface


def build_surface() -> tuple[Any, dict[str, FloatArray]]:
    """Return the closed surface (trimesh) [m] and, for each leg, its cross-sections [m], shape (stations, 3, 2, 3).

    Cross-sections go from the hub to the foot; their second index runs across the leg, their third outwards (up at the hub).
    """
    east, stem = leg_sections(), stem_sections()
    legs = {name: turned(east, turns) for name, turns in LEGS.items()}
    under = stem[0] - np.array([0.0, 0.0, LEG_THICKNESS[0]])
    quads = [tube(stem[:, *STEM_RIM]), lid(stem[-1]), lid(under)[:, ::-1]]
    for sections in legs.values():
        quads += [tube(sections[:, *RIM]), lid(sections[-1])]
    corners = np.vstack(quads)
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    numbers = np.arange(len(triangles) * 3).reshape(-1, 3)
    surface = trimesh.Trimesh(triangles.reshape(-1, 3), numbers, process=True)  # equal points become one
    surface.apply_scale(1e-3)
    return surface, {name: sections * 1e-3 for name, sections in legs.items()}


def check_surface(surface: Any) -> None:
    """Raise InputError where the surface is not one closed skin, outward, without handles."""
    wrong = {
        "open": not surface.is_watertight,
        "turned in places": not surface.is_winding_consistent,
        "inside out": surface.volume <= 0,
        "with handles or in parts": surface.euler_number != 2,
    }
    found = [name for name, holds in wrong.items() if holds]
    if found:
        raise InputError("not a surface to fill", where="four-leg", found=", ".join(found), expected="one closed skin, outward")


def tube(rings: FloatArray) -> FloatArray:
    """Return the quads between rings (n, k, 3) that turn to the left about the way they go, outward, shape (quads, 4, 3)."""
    ahead = np.roll(rings, -1, axis=1)
    return np.stack([rings[:-1], ahead[:-1], ahead[1:], rings[1:]], axis=2).reshape(-1, 4, 3)


def lid(grid: FloatArray) -> FloatArray:
    """Return the quads of a grid of points (a, b, 3), facing along a × b, shape (quads, 4, 3)."""
    return np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)


def stem_sections() -> FloatArray:
    """Return the hub's upper side and the levels of the stem on it [mm], shape (levels, 3, 3, 3), by x and y."""
    half, middle, thick = LEG_POINTS[0, 0], LEG_POINTS[0, 1], LEG_THICKNESS[0]
    levels = [(middle + thick / 2, 1.0, 1.0), *STEM]
    return np.array(
        [
            [[[*(size * half * rounded(np.array([i, j]), roundness)), height] for j in ACROSS] for i in ACROSS]
            for height, size, roundness in levels
        ]
    )


def rounded(cell: FloatArray, roundness: float) -> FloatArray:
    """Return a point of the square cross-section with its corners drawn in."""
    return cell * (roundness if np.abs(cell).min() > 0 else 1.0)


def leg_sections() -> FloatArray:
    """Return the cross-sections of the east leg [mm], the hub's side first, shape (stations, 3, 2, 3)."""
    from scipy.interpolate import CubicSpline

    chord = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(LEG_POINTS, axis=0), axis=1))]
    curve = CubicSpline(chord, LEG_POINTS, bc_type=((1, [1.0, 0.3]), (1, [-0.1, -1.0])))
    places = np.r_[np.linspace(0.0, chord[-2], STATIONS + 1), chord[-1]]
    size = np.stack([np.interp(places, chord, LEG_WIDTH), np.interp(places, chord, LEG_THICKNESS)], axis=1) / 2
    slope = curve(places, 1)
    outward = np.stack([-slope[:, 1], slope[:, 0]], axis=1) / np.linalg.norm(slope, axis=1, keepdims=True)
    outward[0], size[0, 0] = [0.0, 1.0], LEG_POINTS[0, 0]  # the hub's side
    outward[-2:] = [1.0, 0.0]  # the foot pad is level
    sections = np.empty((len(places), len(ACROSS), len(OUTWARD), 3))
    for s, (r, z) in enumerate(curve(places)):
        roundness = 1.0 + (ROUND - 1.0) * min(s / 2, 1.0)
        for i, j in np.ndindex(len(ACROSS), len(OUTWARD)):
            a, b = rounded(np.array([ACROSS[i], OUTWARD[j]]), roundness) * size[s]
            sections[s, i, j] = [r + b * outward[s, 0], a, z + b * outward[s, 1]]
    return sections


def turned(points: FloatArray, turns: int) -> FloatArray:
    """Return points after quarter turns about the vertical axis, without rounding."""
    for _ in range(turns):
        points = np.stack([-points[..., 1], points[..., 0], points[..., 2]], axis=-1)
    return points


# The tetrahedra


def best_mesh(
    surface: Any, legs: dict[str, FloatArray], tries: int = TRIES, fill: Callable[..., TetMesh] = tetrahedralise
) -> TetMesh:
    """Return, of a few fillings of the surface that are small enough, the one whose flattest tetrahedron is the least flat."""
    points, triangles = np.array(surface.vertices), np.array(surface.faces)
    best, score = None, 0.0
    for attempt in range(tries):
        mesh = fill(points, triangles, edge_fraction=EDGE_FRACTION, where="four-leg")
        check_mesh(mesh, "four-leg")
        quality, count = radius_ratio(mesh), unknowns(mesh, legs)
        worst, usual = quality.min(), np.median(quality)
        print(f"{attempt + 1}: {len(mesh.tets)} tetrahedra, {count} unknowns, radius ratio {worst:.2f}, median {usual:.2f}")
        if count <= MOST_UNKNOWNS and worst > score:
            best, score = mesh, float(worst)
    if best is None:
        raise InputError(
            "no mesh is small enough", where="four-leg", expected=f"at most {MOST_UNKNOWNS} unknowns", hint="EDGE_FRACTION"
        )
    return best


def unknowns(mesh: TetMesh, legs: dict[str, FloatArray]) -> int:
    """Return the displacements that are free with mid-edge nodes and clamped feet."""
    nodes = to_quadratic(mesh).nodes
    held = np.zeros(len(nodes), dtype=bool)
    for sections in legs.values():
        low, high = np.array(foot_box(sections[-2:]))
        held |= ((nodes >= low) & (nodes <= high)).all(axis=1)
    return 3 * int((~held).sum())


# robot.toml


def robot_document(legs: dict[str, FloatArray]) -> dict[str, object]:
    """Return the tables of robot.toml; they follow from the surface, so that every mesh of it has the same."""
    return {
        "format": "femsense-robot-1",
        "name": "four-leg",
        "mesh": {"file": "four_leg.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 320e3, "poisson_ratio": 0.46, "density_kg_m3": 1070.0},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": foot_box(sections[-2:])} for sections in legs.values()],
        "cables": [cable_table(name, leg) for name, leg in sorted(legs.items(), key=lambda item: "nwse".index(item[0][0]))],
        "markers": marker_tables(legs),
        "features": {"count": 51},
        "appearance": {"color_rgb": [0.16, 0.48, 0.78]},
    }


def foot_box(layers: FloatArray) -> list[list[float]]:
    """Return the box around the lowest two cross-sections of a leg."""
    points = layers.reshape(-1, 3)
    return [
        [float(v) for v in np.floor(points.min(axis=0) * 1e3 - 0.5) / 1e3],
        [float(v) for v in np.ceil(points.max(axis=0) * 1e3 + 0.5) / 1e3],
    ]


def cable_table(name: str, leg: FloatArray) -> dict[str, object]:
    """Return a cable from the inside of a knee to a pull point near the axis, where it turns down."""
    knee = 0.35 * leg[KNEE, 1, 1] + 0.65 * leg[KNEE, 1, 0]
    radial = np.array([knee[0], knee[1], 0.0]) / np.hypot(knee[0], knee[1])
    return {
        "name": name,
        "path_m": [micrometres(knee)],
        "pull_point_m": micrometres(0.014 * radial + [0.0, 0.0, knee[2] - 0.020]),
        "exit_direction": [0.0, 0.0, -1.0],
        "max_tension_n": 6.0,
    }


def marker_tables(legs: dict[str, FloatArray]) -> list[dict[str, object]]:
    """Return markers on the surface: the tip, three along each leg, and one above each foot."""
    places = {"tip": np.array([0.0, 0.0, STEM[-1][0] * 1e-3])}
    for name, sections in legs.items():
        for label, station in (("inner", 2), ("arch", 5), ("knee", 8)):
            places[f"{name}-{label}"] = sections[station, 1, 1]
        low, high = side_middles(sections[-2]), side_middles(sections[-3])
        side = int(np.argmax((low - low.mean(axis=0)) @ VIEW))
        places[f"{name}-foot"] = 0.7 * low[side] + 0.3 * high[side]
    return [{"name": name, "position_m": micrometres(place)} for name, place in places.items()]


def micrometres(point: FloatArray) -> list[float]:
    """Return a place [m] to the micrometre, without negative zeros."""
    return [round(float(v), 6) + 0.0 for v in point]


def side_middles(section: FloatArray) -> FloatArray:
    """Return the middles of the four sides of a cross-section (3, 2, 3), shape (4, 3)."""
    return np.stack([section[0].mean(axis=0), section[2].mean(axis=0), section[1, 0], section[1, 1]])


if __name__ == "__main__":
    main()
