"""A force map as text, picture, coloured mesh and table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.pose import invert_pose, transform_points
from femsense.fem.mesh import triangle_normals
from femsense.io.files import check_target, followed, write_beside, write_csv
from femsense.io.own_files import FORCE_MAP, check_files
from femsense.rig.force_map import ForceMap

LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Forces for which the table states the share of the surface that resolves them [N]."""
COLORS = "viridis_r"


def force_document(found: ForceMap) -> dict[str, Any]:
    """Return the map as plain tables: for each group of places the resolution of a force along the normal and along the
    surface."""
    best, worst = int(found.normal_std.argmin()), int(found.normal_std.argmax())
    return {
        "points": found.points,
        "places": len(found.nodes),
        "seen": _group(found, found.visible),
        "hidden": _group(found, ~found.visible),
        "resolved_share": {f"{level:g}": float((found.normal_std <= level).mean()) for level in LEVELS},
        "best": {"place_m": found.rest[best].tolist(), "std_n": float(found.normal_std[best])},
        "worst": {"place_m": found.rest[worst].tolist(), "std_n": float(found.normal_std[worst])},
    }


def force_text(found: ForceMap) -> str:
    """Return the map as text."""
    document = force_document(found)
    lines = [
        (
            f"Forces: standard deviation of a small force at a known place, from {found.points} points a frame, at "
            f"{len(found.nodes)} places."
        ),
        "",
        f"{'places':<28}{'count':>6}{'along the normal: median':>26}{'best':>10}{'worst':>10}{'along the surface':>20}",
    ]
    for name, words in (("seen", "seen by a camera"), ("hidden", "out of sight")):
        group = document[name]
        if group["count"]:
            numbers = (
                f"{group['median_n']:>24.3g} N{group['best_n']:>8.2g} N{group['worst_n']:>8.2g} N{group['tangent_n']:>18.2g} N"
            )
            lines.append(f"{words:<28}{group['count']:>6}{numbers}")
    shares = ", ".join(f"{level} N {share:.0%}" for level, share in document["resolved_share"].items())
    lines += ["", f"share of the surface where it is smaller than … : {shares}"]
    for name in ("best", "worst"):
        place = ", ".join(f"{1e3 * x:.0f}" for x in document[name]["place_m"])
        lines.append(f"{name}: {document[name]['std_n']:.2g} N at ({place}) mm at rest")
    return "\n".join(lines)


def check_force_map(folder: str | Path) -> None:
    """Raise InputError if a force map cannot be written: at a file, or where other files have its names."""
    check_target(folder, folder=True)
    check_files(followed(folder), FORCE_MAP)


def write_force_map(found: ForceMap, folder: Path, T_robot_camera: FloatArray) -> list[Path]:
    """Write forces.csv, forces.glb (colours at the vertices) and forces.png (from the camera and from behind);
    return the files. Raises InputError: as `check_force_map`."""
    check_force_map(folder)
    folder.mkdir(parents=True, exist_ok=True)
    table, mesh, picture = folder / "forces.csv", folder / "forces.glb", folder / "forces.png"
    columns = ("x_m", "y_m", "z_m", "normal_std_n", "tangent_std_n", "visible")
    numbers = np.column_stack([found.rest, found.normal_std, found.tangent_std])
    write_csv(table, columns, [[*row, int(seen)] for row, seen in zip(np.round(numbers, 9).tolist(), found.visible)])
    _write_mesh(found, mesh)
    _write_picture(found, picture, T_robot_camera)
    return [table, mesh, picture]


def _group(found: ForceMap, which: BoolArray) -> dict[str, Any]:
    if not which.any():
        return {"count": 0}
    normal, tangent = found.normal_std[which], found.tangent_std[which]
    return {
        "count": int(which.sum()),
        "median_n": float(np.median(normal)),
        "best_n": float(normal.min()),
        "worst_n": float(normal.max()),
        "tangent_n": float(np.median(tangent)),
    }


def _scaled(found: ForceMap) -> FloatArray:
    """Return the logarithm of the standard deviation at every node, scaled to 0 … 1 between best and worst place, shape (n,)."""
    low, high = np.log(found.normal_std.min()), np.log(found.normal_std.max())
    return np.asarray(np.clip((np.log(found.over_nodes()) - low) / max(high - low, 1e-12), 0.0, 1.0))


def _write_mesh(found: ForceMap, path: Path) -> None:
    import matplotlib as mpl
    import trimesh

    colors = (255 * mpl.colormaps[COLORS](_scaled(found))).astype(np.uint8)
    mesh = trimesh.Trimesh(found.positions, found.triangles, vertex_colors=colors, process=False)
    with write_beside(path) as part:
        part.write_bytes(mesh.export(file_type="glb", tree_postprocessor=_sign))


def _sign(tree: dict[str, Any]) -> None:
    tree["asset"]["generator"] = "femsense"


def _write_picture(found: ForceMap, path: Path, T_robot_camera: FloatArray) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    norm = LogNorm(float(found.normal_std.min()), float(found.normal_std.max()) * 1.0001)
    values = np.exp(np.log(found.over_nodes())[found.triangles].mean(axis=1))
    behind = T_robot_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])
    for axes, T, title in zip(figure.subplots(1, 2), (T_robot_camera, behind), ("as the camera looks", "from the other side")):
        local = transform_points(invert_pose(T), found.positions)
        facing = triangle_normals(local, found.triangles)[:, 2] < 0
        corners = local[found.triangles[facing]]
        order = np.argsort(-corners[:, :, 2].mean(axis=1))
        flat = 1e3 * corners[order][:, :, :2] * [1.0, -1.0]
        axes.add_collection(
            PolyCollection(list(flat), array=values[facing][order], cmap=COLORS, norm=norm, edgecolors="face", linewidths=0.2)
        )
        axes.autoscale_view()
        axes.set(aspect="equal", title=title, xlabel="mm", ylabel="mm")
    figure.colorbar(ScalarMappable(norm, COLORS), ax=figure.axes, label="one standard deviation of a force along the normal [N]")
    with write_beside(path) as part:
        figure.savefig(part, dpi=120, format="png", metadata={"Software": "femsense"})
