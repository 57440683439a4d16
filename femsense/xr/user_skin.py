"""A surface of the user's own (CAD, glTF) that the finite-element body carries instead of its own surface.

Each vertex is tied to the element that holds it at rest, or to the nearest one, as markers are.
Its weights are then fitted to the states as those of the body's own surface. Beyond a budget the surface is decimated by quadric
errors (Garland and Heckbert 1997, as Open3D has it).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, diagonal, freeze, spread_evenly
from femsense.core.errors import InputError
from femsense.fem.mesh import Embedding, TetMesh, embed_points, surface_triangles
from femsense.xr.gltf import T_GLTF_ROBOT, ExportReport, Texture, export_states, report_of, write_glb
from femsense.xr.skinning import as_states, fit_poses, fit_skin, skin_vertices, weigh_points

BUDGET = 100_000
"""Maximum number of vertices: what headsets draw at their frame rate."""
FAR = 0.05
"""A vertex farther from the body than this share of its size does not belong to it; half of the vertices may not."""
SHOWN = 40
"""Frames to which weights are fitted, spread evenly over the run."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
GLTF = (".glb", ".gltf")


@dataclass(frozen=True, eq=False, slots=True)
class UserSkin:
    """A surface at rest with its colours."""

    rest: FloatArray
    """Vertices, robot frame [m], shape (V, 3)."""
    triangles: IntArray
    """Vertex indices, outward, shape (t, 3)."""
    colors: FloatArray | None = None
    """sRGB of each vertex, 0 … 1, shape (V, 3); None: the robot's."""
    texture: Texture | None = None


def read_skin(path: str | Path, *, unit: str | None = None, T_robot_skin: Any = None, budget: int = BUDGET) -> UserSkin:
    """Read a surface to be deformed with the body in animations, instead of the surface of the finite-element mesh.

    Arguments:
        path: an STL, OBJ, PLY or glTF file.
        unit: unit of the coordinates in the file: "m", "cm" or "mm". Required except for glTF, which is always in metres with Y up.
        T_robot_skin: transform from the coordinates of the surface [m] to those of the robot, shape (4, 4). Default: the identity.
        budget: maximum number of vertices. A surface with more is simplified, and its texture becomes vertex colours.

    Returns:
        the surface, for the argument `skin` of `export_glb`.

    Raises:
        InputError: the file is missing, it contains no surface, or `unit` is missing.
    """
    file = Path(path).expanduser()
    scale = _scale(file, unit)
    mesh = _load(file)
    T = np.eye(4) if T_robot_skin is None else np.asarray(T_robot_skin, dtype=float)
    if file.suffix.lower() in GLTF:
        T = T @ np.linalg.inv(T_GLTF_ROBOT)
    rest = scale * np.asarray(mesh.vertices, dtype=float) @ T[:3, :3].T + T[:3, 3]
    skin = UserSkin(freeze(rest), freeze(np.asarray(mesh.faces), np.int64), _colors(mesh), _texture(mesh))
    return skin if len(rest) <= budget else decimated(skin, budget, baked=_baked(mesh))


def decimated(skin: UserSkin, budget: int, *, baked: FloatArray | None = None) -> UserSkin:
    """Return a surface with at most `budget` vertices; colours are those of the nearest original vertex.

    baked: colours sampled from the texture, sRGB, shape (V, 3).
    """
    import open3d as o3d
    from scipy.spatial import cKDTree

    welded, inverse = np.unique(skin.rest.round(9), axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[skin.triangles]
    full = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(welded), o3d.utility.Vector3iVector(triangles))
    target = 2.0 * budget
    while True:
        small = full.simplify_quadric_decimation(int(target))
        small.remove_unreferenced_vertices()
        rest = np.asarray(small.vertices)
        if len(rest) <= budget:
            break
        target *= 0.98 * budget / len(rest)
    nearest = cKDTree(skin.rest).query(rest)[1]
    known = skin.colors if baked is None else baked
    return UserSkin(
        freeze(rest), freeze(np.asarray(small.triangles), np.int64), None if known is None else freeze(known[nearest])
    )


def tie_skin(skin: UserSkin, mesh: TetMesh) -> Embedding:
    """Embed a surface in a body. Raises InputError if most of it is far from the body, for example in another unit or frame."""
    ties = embed_points(mesh, skin.rest)
    size = diagonal(mesh.nodes)
    far = float(np.median(ties.outside))
    if far > FAR * size:
        raise InputError(
            "the skin does not lie on the body",
            where="--skin",
            found=(
                f"half of its vertices are {1e3 * far:.3g} mm or more away; it is {_extent(skin.rest)} large, the body "
                f"{_extent(mesh.nodes)}"
            ),
            expected="the same place and size at rest",
            hint="its unit, or its axes: robot frame as in robot.toml, glTF with Y up",
        )
    return ties


def export_surface(
    rest_nodes: npt.ArrayLike | None,
    tets: npt.ArrayLike,
    time_s: npt.ArrayLike,
    nodes_m: npt.ArrayLike,
    path: str | Path,
    *,
    skin: UserSkin | None,
    bones: int | None = None,
    color_rgb: npt.ArrayLike | None = None,
    name: str = "robot",
) -> ExportReport:
    """Write the frames of a run as the body's own surface (`gltf.export_states`), or as the user's (`export_skin`)."""
    if skin is None:
        return export_states(rest_nodes, tets, time_s, nodes_m, path, bones=bones, color_rgb=color_rgb, name=name)
    rest = np.asarray(nodes_m)[0] if rest_nodes is None else rest_nodes
    mesh = TetMesh(np.asarray(rest, dtype=float), np.asarray(tets))
    return export_skin(mesh, time_s, nodes_m, path, skin, bones=bones, color_rgb=color_rgb, name=name)


def export_skin(
    mesh: TetMesh,
    time_s: npt.ArrayLike,
    nodes_m: npt.ArrayLike,
    path: str | Path,
    skin: UserSkin,
    *,
    bones: int | None = None,
    color_rgb: npt.ArrayLike | None = None,
    name: str = "robot",
) -> ExportReport:
    """Write the frames of a run as an animated surface of the user; bones are those of the body's surface.

    Arguments:
        mesh: the body at rest [m].
        time_s, nodes_m: times [s], shape (F,), and nodes of each frame [m], shape (F, n, 3).
        path: the `.glb` file.
        skin: the surface.
        bones: number of bones; None: chosen on held-out frames.
        color_rgb: colour of a surface without colours.
        name: name of the body in the file.

    Returns:
        a report of the export; its errors are distances to the vertices embedded in the elements, over at most SHOWN frames.

    Raises:
        InputError: states that `gltf.export_states` refuses, or a surface that is far from the body.
    """
    ties = tie_skin(skin, mesh)
    frames = as_states(nodes_m, len(mesh.nodes))
    used = np.unique(surface_triangles(mesh))
    own = fit_skin(mesh.nodes[used], frames[:, used], bones=bones)
    poses = fit_poses(own, frames[:, used])
    some = spread_evenly(len(frames), SHOWN)
    carried = np.array([ties.positions(frame) for frame in frames[some]])
    worn = weigh_points(own, poses[some], skin.rest, carried)
    look = color_rgb if skin.colors is None else skin.colors
    written = write_glb(path, skin.rest, skin.triangles, worn, poses, time_s, color_rgb=look, texture=skin.texture, name=name)
    return report_of(written, worn, len(frames), skin_vertices(worn, poses[some]) - carried)


def _extent(points: FloatArray) -> str:
    return " × ".join(f"{1e3 * length:.3g}" for length in np.ptp(points, axis=0)) + " mm"


def _scale(file: Path, unit: str | None) -> float:
    if not file.is_file():
        raise InputError("no such file", where="--skin", found=file)
    if file.suffix.lower() in GLTF:
        return 1.0
    if unit not in UNITS:
        raise InputError("the unit of the skin is not known", where="--skin-unit", found=unit, expected="m, cm or mm")
    return UNITS[unit]


def _load(file: Path) -> Any:
    """Return a trimesh of the file, all of its parts in one."""
    import trimesh

    try:
        scene = trimesh.load_scene(file, process=False)
        mesh = scene.to_geometry()
    except Exception as error:  # whatever the many readers raise
        raise InputError("the skin cannot be read", where=file, found=error, expected="STL, OBJ, PLY or glTF") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError("the skin has no surface", where=file, found=type(mesh).__name__, expected="triangles")
    return mesh


def _colors(mesh: Any) -> FloatArray | None:
    """Return the vertex colours of a file, or the colour of its only material."""
    if mesh.visual.kind in ("vertex", "face"):
        return freeze(np.asarray(mesh.visual.vertex_colors, dtype=float)[:, :3] / 255.0)
    material = getattr(mesh.visual, "material", None)
    if material is None or _texture(mesh) is not None:
        return None
    return freeze(np.tile(np.asarray(material.main_color, dtype=float)[:3] / 255.0, (len(mesh.vertices), 1)))


def _texture(mesh: Any) -> Texture | None:
    image, uv = _image(mesh), getattr(mesh.visual, "uv", None)
    if image is None or uv is None or len(uv) != len(mesh.vertices):
        return None
    packed = io.BytesIO()
    image.convert("RGB").save(packed, format="PNG")
    flipped = np.array([0.0, 1.0]) + np.asarray(uv, dtype=float) * [1.0, -1.0]  # glTF counts from the top
    return Texture(freeze(flipped), packed.getvalue())


def _baked(mesh: Any) -> FloatArray | None:
    """Return the texture colour at each vertex, sRGB, shape (V, 3)."""
    if _texture(mesh) is None:
        return None
    return freeze(np.asarray(mesh.visual.to_color().vertex_colors, dtype=float)[:, :3] / 255.0)


def _image(mesh: Any) -> Any:
    material = getattr(mesh.visual, "material", None)
    return None if material is None else getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
