"""Quality of a tetrahedral mesh: angles, shapes, sizes, elements per wall, and the position of the worst elements."""

from __future__ import annotations

from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.closest_point import FACES
from femsense.fem.mesh import EDGES, TetMesh, element_volumes, surface_triangles, to_linear, to_quadratic, triangle_normals
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.surface_queries import wall_thickness

WORST = 5
"""Number of the worst elements that are listed."""


def mean_ratio(mesh: TetMesh) -> FloatArray:
    """Return 12 (3 V)^(2/3) / Σ l² of each corner tetrahedron [1], shape (m,): 1 regular, 0 flat (Liu and Joe 1994)."""
    squares = (edge_lengths(mesh) ** 2).sum(axis=1)
    return np.asarray(12.0 * np.cbrt(3.0 * np.abs(element_volumes(mesh))) ** 2 / squares)


def dihedral_angles(mesh: TetMesh) -> FloatArray:
    """Return the angles between the faces of each corner tetrahedron [°], shape (m, 6)."""
    corners = mesh.nodes[mesh.tets[:, :4]]
    a, b, c = (corners[:, FACES[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    pairs = np.array([(i, j) for i in range(4) for j in range(i)])
    cosine = -np.einsum("mpc,mpc->mp", normals[:, pairs[:, 0]], normals[:, pairs[:, 1]])
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def edge_lengths(mesh: TetMesh) -> FloatArray:
    """Return the lengths of the edges of each corner tetrahedron, shape (m, 6)."""
    ends = mesh.nodes[mesh.tets[:, EDGES]]
    return np.asarray(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2))


def elements_through(mesh: TetMesh) -> FloatArray:
    """Return, at the middle of each surface triangle, the way through the body to the next wall over the local edge length [1].

    Two linear elements through a wall that bends, or one quadratic element, are the least that a model can do with.
    """
    linear = to_linear(mesh)
    triangles = surface_triangles(linear)
    middles = linear.nodes[triangles].mean(axis=1)
    area = triangle_normals(linear.nodes, triangles)
    inward = -area / np.linalg.norm(area, axis=1, keepdims=True)
    sides = np.linalg.norm(linear.nodes[triangles] - linear.nodes[np.roll(triangles, 1, axis=1)], axis=2).mean(axis=1)
    way = wall_thickness(linear.nodes, triangles, middles, inward)
    return np.asarray((way / sides)[np.isfinite(way)])


def quality_report(mesh: TetMesh) -> dict[str, Any]:
    """Return the quality of a mesh in metres as plain numbers, units in the names."""
    linear, volumes = to_linear(mesh), element_volumes(mesh)
    angles, shape, means, lengths = dihedral_angles(mesh), radius_ratio(mesh), mean_ratio(mesh), edge_lengths(mesh)
    through = elements_through(mesh)
    return {
        "tetrahedra": len(mesh.tets),
        "nodes": len(linear.nodes),
        "unknowns_tet4": 3 * len(linear.nodes),
        "unknowns_tet10": 3 * len(to_quadratic(linear).nodes),
        "surface_triangles": len(surface_triangles(linear)),
        "volume_cm3": 1e6 * float(volumes.sum()),
        "smallest_volume_mm3": 1e9 * float(volumes.min()),
        "median_volume_mm3": 1e9 * float(np.median(volumes)),
        "edge_mm": _spread(1e3 * lengths),
        "dihedral_deg": _spread(angles),
        "radius_ratio": _spread(shape),
        "mean_ratio": _spread(means),
        "elements_through": {"fifth_percentile": float(np.percentile(through, 5)), "median": float(np.median(through))},
        "worst": [_element(mesh, int(i), shape, angles) for i in np.argsort(shape)[:WORST]],
    }


def _spread(values: FloatArray) -> dict[str, float]:
    return {"min": float(values.min()), "median": float(np.median(values)), "max": float(values.max())}


def _element(mesh: TetMesh, i: int, shape: FloatArray, angles: FloatArray) -> dict[str, Any]:
    return {
        "element": i,
        "place_mm": (1e3 * mesh.nodes[mesh.tets[i, :4]].mean(axis=0)).tolist(),
        "radius_ratio": float(shape[i]),
        "dihedral_deg": [float(angles[i].min()), float(angles[i].max())],
    }


def quality_text(report: dict[str, Any]) -> str:
    """Return a report of `quality_report` as a table."""
    rows = [
        ("tetrahedra", f"{report['tetrahedra']}"),
        ("nodes", f"{report['nodes']} ({report['unknowns_tet4']} unknowns as tet4, {report['unknowns_tet10']} as tet10)"),
        ("volume", f"{report['volume_cm3']:.4g} cm³"),
        ("elements' volume", f"smallest {report['smallest_volume_mm3']:.3g}, median {report['median_volume_mm3']:.3g} mm³"),
        ("edges", "{min:.3g} … {median:.3g} … {max:.3g} mm (minimum, median, maximum)".format(**report["edge_mm"])),
        ("dihedral angles", "{min:.3g}° … {median:.3g}° … {max:.4g}°".format(**report["dihedral_deg"])),
        ("radius ratio", "{min:.2f} … {median:.2f} … {max:.2f} (1 regular, 0 flat)".format(**report["radius_ratio"])),
        ("mean ratio", "{min:.2f} … {median:.2f} … {max:.2f}".format(**report["mean_ratio"])),
        (
            "elements per wall",
            "{fifth_percentile:.2g} (5th percentile), {median:.2g} (median)".format(**report["elements_through"]),
        ),
    ]
    lines = [f"  {name:<19}{value}" for name, value in rows]
    lines.append("  worst elements")
    for worst in report["worst"]:
        place = ", ".join(f"{value:.1f}" for value in worst["place_mm"])
        lines.append(
            f"    {worst['element']:>6}  at [{place}] mm, radius ratio {worst['radius_ratio']:.2f}, angles "
            f"{worst['dihedral_deg'][0]:.0f}° to {worst['dihedral_deg'][1]:.0f}°"
        )
    return "\n".join(lines)
