"""Build the four-leg robot: its tetrahedra, robot.toml and the picture of the README.

    python meshes/four-leg/build.py            # four_leg.vtu and robot.toml
    python meshes/four-leg/build.py --picture  # four_leg.png too

The body is swept from hexahedra: a hub, a stem on it, and four legs that go out from the hub, arch over a knee and come
down on feet. Each hexahedron becomes six tetrahedra around its lowest-numbered corner, with the diagonal of each far face
through that face's lowest corner; faces that two hexahedra share are then always cut alike. The same script gives the same
bytes every time (a free mesher such as fTetWild shuffles, and would give another mesh each time).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.arrays import FloatArray, IntArray
from femsense.fem.mesh import TetMesh, check_mesh, oriented
from femsense.files import write_toml
from femsense.meshfile import write_mesh

HERE = Path(__file__).resolve().parent
LEGS = {"east": 0, "north": 1, "west": 2, "south": 3}
"""Name → quarter turns from the x axis."""

# One leg in the plane of radius and height [mm], from the hub outwards to the foot.
LEG_POINTS = np.array([[13.0, 80.0], [36.0, 84.0], [62.0, 76.0], [78.0, 54.0], [79.0, 30.0], [72.0, 7.0], [70.0, 0.0]])
LEG_WIDTH = np.array([26.0, 22.0, 19.0, 18.0, 18.0, 22.0, 24.0])
LEG_THICKNESS = np.array([18.0, 15.0, 13.0, 13.0, 13.0, 17.0, 20.0])
STATIONS = 15
"""Hexahedra along a leg, the foot pad not counted."""
KNEE = 9
"""Cross-section that the cable is tied to."""
ROUND = 0.86
"""Corners of a cross-section, over those of its rectangle."""
STEM = ((94.0, 0.78, 0.9), (110.0, 0.62, 0.85))
"""Levels of the stem: height [mm], size over the hub's, roundness."""
VIEW = np.array([-0.35, -0.6, 0.72])
"""Towards a camera in front; the feet's markers sit where it sees them."""
ACROSS, OUTWARD = (-1.0, 0.0, 1.0), (-1.0, 1.0)
"""Nodes of a leg's cross-section: two cells wide, one thick."""
FACE_LOOPS = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
"""Faces of a hexahedron with corners 4 i + 2 j + k, each around its border."""


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", action="store_true", help="render four_leg.png too")
    wanted = parser.parse_args()
    mesh, stations = build_mesh()
    check_mesh(mesh, "four-leg")
    write_mesh(mesh, HERE / "four_leg.vtu")
    write_toml(HERE / "robot.toml", robot_document(mesh, stations))
    if wanted.picture:
        import picture

        picture.draw(HERE)


def build_mesh() -> tuple[TetMesh, dict[str, IntArray]]:
    """Return the tetrahedra [m] and, for each leg, the nodes of its cross-sections, shape (stations, 3, 2).

    Cross-sections go from the hub to the foot; their second index runs across the leg, their third outwards (up at the hub).
    """
    points: list[FloatArray] = []
    hub = np.array([[[add(points, hub_point(i, j, k)) for k in OUTWARD] for j in ACROSS] for i in ACROSS])
    blocks = [hub]
    stem = [hub[:, :, -1]]
    for height, size, roundness in STEM:
        cells = [size * rounded(np.array([i, j]), roundness) * LEG_POINTS[0, 0] for i in ACROSS for j in ACROSS]
        stem.append(np.array([add(points, np.append(cell, height)) for cell in cells]).reshape(3, 3))
    blocks.append(np.stack(stem, axis=2))
    stations = {}
    for name, turns in LEGS.items():
        stations[name] = leg_nodes(points, hub_face(hub, turns), turns)
        blocks.append(stations[name])
    hexes = np.vstack([hexahedra(block) for block in blocks])
    tets = np.vstack([six_tets(cell) for cell in hexes])
    return oriented(TetMesh(np.array(points) * 1e-3, tets)), stations


def add(points: list[FloatArray], point: npt.ArrayLike) -> int:
    """Append a point and return its number."""
    points.append(np.asarray(point, dtype=float))
    return len(points) - 1


def hub_point(i: float, j: float, k: float) -> FloatArray:
    """Return a node of the hub [mm]."""
    half, middle, thick = LEG_POINTS[0, 0], LEG_POINTS[0, 1], LEG_THICKNESS[0]
    return np.array([half * i, half * j, middle + thick / 2 * k])


def rounded(cell: FloatArray, roundness: float) -> FloatArray:
    """Return a node of the square cross-section with its corners drawn in."""
    return cell * (roundness if np.abs(cell).min() > 0 else 1.0)


def hub_face(hub: IntArray, turns: int) -> IntArray:
    """Return the hub's nodes where a leg begins, shape (3, 2): across, upwards."""
    if turns == 0:
        return hub[2, :, :]
    if turns == 1:
        return hub[::-1, 2, :]
    return hub[0, ::-1, :] if turns == 2 else hub[:, 0, :]


def leg_nodes(points: list[FloatArray], start: IntArray, turns: int) -> IntArray:
    """Append the nodes of a leg and return all of them with those of the hub, shape (stations, 3, 2)."""
    from scipy.interpolate import CubicSpline

    chord = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(LEG_POINTS, axis=0), axis=1))]
    curve = CubicSpline(chord, LEG_POINTS, bc_type=((1, [1.0, 0.3]), (1, [-0.1, -1.0])))
    places = np.r_[np.linspace(0.0, chord[-2], STATIONS + 1), chord[-1]]
    angle = turns * np.pi / 2
    radial, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    layers = [start]
    for s, place in enumerate(places[1:], start=1):
        (r, z), slope = curve(place), curve(place, 1)
        outward = np.array([-slope[1], slope[0]]) / np.linalg.norm(slope)
        if s >= len(places) - 2:
            outward = np.array([1.0, 0.0])  # the foot pad is level, so that its clamp is the same on every mesh
        width, thickness = np.interp(place, chord, LEG_WIDTH), np.interp(place, chord, LEG_THICKNESS)
        roundness = 1.0 + (ROUND - 1.0) * min(s / 2, 1.0)
        layer = []
        for cell in ((a, b) for a in ACROSS for b in OUTWARD):
            a, b = rounded(np.array(cell), roundness) * [width / 2, thickness / 2]
            layer.append(
                add(points, (r + b * outward[0]) * radial + a * across + (z + b * outward[1]) * np.array([0.0, 0.0, 1.0]))
            )
        layers.append(np.array(layer).reshape(len(ACROSS), len(OUTWARD)))
    return np.stack(layers)


def hexahedra(block: IntArray) -> IntArray:
    """Return the cells of a block of nodes (a, b, c), shape (cells, 8), corners 4 i + 2 j + k."""
    a, b, c = (n - 1 for n in block.shape)
    corners = [block[i : i + a, j : j + b, k : k + c].ravel() for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return np.stack(corners, axis=1)


def six_tets(cell: IntArray) -> IntArray:
    """Return a hexahedron as tetrahedra, shape (6, 4)."""
    low = int(cell.min())
    triangles = []
    for loop in FACE_LOOPS:
        face = cell[list(loop)]
        if low in face:
            continue
        face = np.roll(face, -int(face.argmin()))
        triangles += [face[[0, 1, 2]], face[[0, 2, 3]]]
    return np.array([[low, *triangle] for triangle in triangles])


def robot_document(mesh: TetMesh, stations: dict[str, IntArray]) -> dict[str, object]:
    """Return the tables of robot.toml."""
    x = mesh.nodes
    return {
        "format": "femsense-robot-1",
        "name": "four-leg",
        "mesh": {"file": "four_leg.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 320e3, "poisson_ratio": 0.46, "density_kg_m3": 1070.0},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": foot_box(x[nodes[-2:]])} for nodes in stations.values()],
        "cables": [
            cable_table(name, x[nodes]) for name, nodes in sorted(stations.items(), key=lambda item: "nwse".index(item[0][0]))
        ],
        "markers": marker_tables(mesh, stations),
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
        "path_m": [[round(float(v), 6) for v in knee]],
        "pull_point_m": [round(float(v), 6) for v in 0.014 * radial + [0.0, 0.0, knee[2] - 0.020]],
        "exit_direction": [0.0, 0.0, -1.0],
        "max_tension_n": 6.0,
    }


def marker_tables(mesh: TetMesh, stations: dict[str, IntArray]) -> list[dict[str, object]]:
    """Return markers on the surface: the tip, three along each leg, and one above each foot."""
    x = mesh.nodes
    top = x[:, 2].max()
    tip = int(np.argmin(np.linalg.norm(x - [0.0, 0.0, top], axis=1)))
    places = {"tip": x[tip]}
    for name, nodes in stations.items():
        for label, station in (("inner", 2), ("arch", 5), ("knee", 8)):
            places[f"{name}-{label}"] = x[nodes[station, 1, 1]]
        low, high = side_middles(x[nodes[-2]]), side_middles(x[nodes[-3]])
        side = int(np.argmax((low - low.mean(axis=0)) @ VIEW))
        places[f"{name}-foot"] = 0.7 * low[side] + 0.3 * high[side]
    return [{"name": name, "position_m": [round(float(v), 6) for v in place]} for name, place in places.items()]


def side_middles(section: FloatArray) -> FloatArray:
    """Return the middles of the four sides of a cross-section (3, 2, 3), shape (4, 3)."""
    return np.stack([section[0].mean(axis=0), section[2].mean(axis=0), section[1, 0], section[1, 1]])


if __name__ == "__main__":
    main()
