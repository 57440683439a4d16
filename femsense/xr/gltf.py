"""Skinned, animated meshes as binary glTF 2.0 (one `.glb` file), written by hand.

The file uses glTF's frame: metres, Y up, right-handed. Bones are flat siblings under one root node, which rotates the
robot frame (Z up) into that frame; animation keys are therefore bone poses in the robot frame, as in live streams.
Reference: Khronos Group, glTF 2.0 Specification, 2021.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_indices, as_points, rms
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, surface_triangles, vertex_normals
from femsense.io.files import write_beside
from femsense.xr.skinning import Skin, as_states, fit_poses, fit_skin, skin_vertices

T_GLTF_ROBOT = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Maps the robot frame (Z up) to glTF's (Y up): (x, y, z) → (x, z, −y)."""
DEFAULT_COLOR = (0.20, 0.45, 0.80)
COMPONENT: dict[np.dtype[Any], int] = {
    np.dtype(name): code for name, code in (("u1", 5121), ("u2", 5123), ("u4", 5125), ("f4", 5126))
}
SHAPE = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTEX_DATA, INDEX_DATA = 34962, 34963


@dataclass(frozen=True, eq=False, slots=True)
class ExportReport:
    """Result of `export_states`: size and accuracy of the written mesh."""

    path: Path
    """The file."""
    bones: int
    """Number of bones."""
    vertices: int
    """Number of surface vertices."""
    frames: int
    """Number of animation keys."""
    rms_m: float
    """Root mean square distance of the skinned vertices to the finite-element surface, all frames [m]."""
    max_m: float
    """Largest such distance [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Texture:
    """An image on a surface."""

    uv: FloatArray
    """Where each vertex lies in it, 0 … 1 from its upper left corner, shape (V, 2)."""
    png: bytes
    """The image."""


def export_states(
    rest_nodes: npt.ArrayLike | None,
    tets: npt.ArrayLike,
    time_s: npt.ArrayLike,
    nodes_m: npt.ArrayLike,
    path: str | Path,
    *,
    bones: int | None = None,
    color_rgb: npt.ArrayLike | None = None,
    name: str = "robot",
) -> ExportReport:
    """Write the frames of a run as a skinned, animated mesh.

    Arguments:
        rest_nodes: nodes at rest, robot frame [m], shape (n, 3); None takes the first frame for it.
        tets: node indices, shape (m, 4) or (m, 10).
        time_s: time of each frame [s], shape (F,), strictly increasing.
        nodes_m: nodes of each frame [m], shape (F, n, 3).
        path: the `.glb` file; replaced in one step.
        bones: number of bones; None: chosen on held-out frames.
        color_rgb: colour of the body, sRGB in 0 … 1, shape (3,).
        name: name of the body in the file.

    Returns:
        a report of the export, with the distance to the finite-element surface.

    Raises:
        InputError: states that are not finite, times that do not increase, shapes that do not belong together.
    """
    nodes = np.asarray(nodes_m)
    if nodes.ndim != 3 or nodes.shape[2] != 3 or not len(nodes):
        raise InputError("states have the wrong shape", where="nodes_m", found=nodes.shape, expected="(F ≥ 1, n, 3)")
    frames = as_states(nodes, nodes.shape[1])
    times = _as_times(time_s, len(frames))
    mesh = TetMesh(as_points(frames[0] if rest_nodes is None else rest_nodes, "rest_nodes"), np.asarray(tets))
    if len(mesh.nodes) != frames.shape[1]:
        raise InputError("rest and states differ", where="rest_nodes", found=len(mesh.nodes), expected=f"{frames.shape[1]} nodes")
    used, corners = np.unique(surface_triangles(mesh), return_inverse=True)
    rest, surface = mesh.nodes[used], frames[:, used]
    skin = fit_skin(rest, surface, bones=bones)
    poses = fit_poses(skin, surface)
    written = write_glb(path, rest, corners.reshape(-1, 3), skin, poses, times, color_rgb=color_rgb, name=name)
    return report_of(written, skin, len(frames), skin_vertices(skin, poses) - surface)


def report_of(path: Path, skin: Skin, frames: int, errors: FloatArray) -> ExportReport:
    """Return the report of an export; `errors` [m] are those of the vertices, shape (F, V, 3)."""
    farthest = float(np.linalg.norm(errors, axis=2).max())
    return ExportReport(path, len(skin.skeleton), len(skin.rest), frames, rms(errors), farthest)


def write_glb(
    path: str | Path,
    rest: npt.ArrayLike,
    triangles: npt.ArrayLike,
    skin: Skin,
    poses: npt.ArrayLike,
    time_s: npt.ArrayLike,
    *,
    color_rgb: npt.ArrayLike | None = None,
    texture: Texture | None = None,
    name: str = "robot",
) -> Path:
    """Write a skinned mesh with one animation, under a temporary name that is renamed at the end (`write_beside`).

    Arguments:
        path: the file.
        rest: vertices at rest, robot frame [m], shape (V, 3).
        triangles: vertex indices, outward, shape (t, 3).
        skin: bones and weights of these vertices.
        poses: T_robot_bone of each frame, shape (F, B, 4, 4).
        time_s: time of each frame [s], shape (F,), strictly increasing; the file counts from the first.
        color_rgb: sRGB in 0 … 1: one colour (3,), or one per vertex (V, 3).
        texture: an image instead.
        name: name of the body in the file.

    Returns:
        the path.

    Raises:
        InputError: shapes that do not belong together, times that do not increase, colours out of range.
    """
    data = glb_bytes(rest, triangles, skin, poses, time_s, color_rgb=color_rgb, texture=texture, name=name)
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError("the folder does not exist", where=target.parent, hint="make it first")
    with write_beside(target) as part:
        part.write_bytes(data)
    return target


def glb_bytes(
    rest: npt.ArrayLike,
    triangles: npt.ArrayLike,
    skin: Skin,
    poses: npt.ArrayLike,
    time_s: npt.ArrayLike,
    *,
    color_rgb: npt.ArrayLike | None = None,
    texture: Texture | None = None,
    name: str = "robot",
) -> bytes:
    """Return the content of the file that `write_glb` writes (same arguments)."""
    points = as_points(rest, "rest")
    bones = len(skin.skeleton)
    T_robot_bone = np.asarray(poses, dtype=np.float64)
    if len(points) != len(skin.rest):
        raise InputError("the skin belongs to other vertices", where="skin", found=len(skin.rest), expected=len(points))
    if T_robot_bone.ndim != 4 or T_robot_bone.shape[1:] != (bones, 4, 4) or not np.isfinite(T_robot_bone).all():
        raise InputError("wrong bone poses", where="poses", found=T_robot_bone.shape, expected=f"finite, (F, {bones}, 4, 4)")
    corners = as_indices(np.asarray(triangles).ravel(), len(points), "triangles").reshape(-1, 3)
    times = _as_times(time_s, len(T_robot_bone))
    vertex_color, base_color = _colors(color_rgb, len(points))

    buffer = Buffer()
    primitive = _add_mesh(buffer, points, corners, skin, vertex_color)
    paint: dict[str, Any] = {"baseColorFactor": base_color, "metallicFactor": 0.0, "roughnessFactor": 0.55}
    images = {} if texture is None else _add_texture(buffer, primitive, texture, paint, len(points))
    bind = np.linalg.inv(T_GLTF_ROBOT @ skin.skeleton.T_robot_bone)
    inverse_bind = buffer.add(bind.transpose(0, 2, 1).astype(np.float32))  # columns first
    samplers, channels = _add_animation(buffer, times, T_robot_bone)
    joints = [{"name": n, "translation": _floats(o)} for n, o in zip(skin.skeleton.names, skin.skeleton.origins)]
    gltf = {
        "asset": {"version": "2.0", "generator": "femsense"},
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0, 1]}],
        "nodes": [
            {"name": name, "mesh": 0, "skin": 0},
            {
                "name": "robot_frame",
                "rotation": [-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))],
                "children": list(range(2, 2 + bones)),
            },
            *joints,
        ],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [{"name": "body", "pbrMetallicRoughness": paint}],
        **images,
        "skins": [{"name": name, "skeleton": 1, "joints": list(range(2, 2 + bones)), "inverseBindMatrices": inverse_bind}],
        "animations": [{"name": "run", "samplers": samplers, "channels": channels}],
        **buffer.description(),
    }
    return container(gltf, bytes(buffer.content))


def quaternions(rotations: FloatArray) -> FloatArray:
    """Return unit quaternions x y z w, shape (F, B, 4), of rotations (F, B, 3, 3), without sign jumps along the frames.

    q and −q are the same rotation, but the straight line between two keys is short only if their product is not negative.
    """
    from scipy.spatial.transform import Rotation

    return without_jumps(np.asarray(Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat()).reshape(*rotations.shape[:2], 4))


def without_jumps(q: FloatArray) -> FloatArray:
    """Return quaternions, shape (F, …, 4), with signs such that the product of each with the one before is not negative."""
    flips = np.where((q[1:] * q[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    return np.concatenate([q[:1], q[1:] * np.cumprod(flips, axis=0)[..., None]])


# ---- parts of the file ---------------------------------------------------------------------------------------------------


class Buffer:
    """The binary part of a file, and the accessors that describe it."""

    def __init__(
        self,
        content: bytearray | None = None,
        views: list[dict[str, Any]] | None = None,
        accessors: list[dict[str, Any]] | None = None,
    ) -> None:
        """Begin empty, or with the content of a file."""
        self.content = bytearray() if content is None else content
        self.views, self.accessors = views or [], accessors or []

    def add(self, array: npt.NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (count, …) and return the number of its accessor."""
        self.content.extend(b"\0" * (-len(self.content) % 4))
        data = np.ascontiguousarray(array)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.content), "byteLength": data.nbytes}
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": COMPONENT[data.dtype],
            "count": len(data),
            "type": SHAPE[data.shape[1:]],
        }
        if target is not None:
            view["target"] = target
        if bounds:
            accessor["min"] = _floats(np.atleast_1d(data.min(axis=0)))
            accessor["max"] = _floats(np.atleast_1d(data.max(axis=0)))
        self.content.extend(data.astype(data.dtype.newbyteorder("<"), copy=False).tobytes())
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes) -> int:
        """Append bytes that are no numbers and return the number of their view."""
        self.content.extend(b"\0" * (-len(self.content) % 4))
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(data)})
        self.content.extend(data)
        return len(self.views) - 1

    def description(self) -> dict[str, Any]:
        return {"accessors": self.accessors, "bufferViews": self.views, "buffers": [{"byteLength": len(self.content)}]}


def _add_mesh(buffer: Buffer, rest: FloatArray, triangles: IntArray, skin: Skin, colors: FloatArray | None) -> dict[str, Any]:
    """Return the primitive, with vertices at rest in glTF's frame, which matches the inverse bind matrices."""
    R = T_GLTF_ROBOT[:3, :3]
    normals = vertex_normals(rest, triangles)
    normals[(normals**2).sum(axis=1) < 0.5] = (0.0, 0.0, 1.0)
    attributes = {
        "POSITION": buffer.add((rest @ R.T).astype(np.float32), target=VERTEX_DATA, bounds=True),
        "NORMAL": buffer.add((normals @ R.T).astype(np.float32), target=VERTEX_DATA),
        "JOINTS_0": buffer.add(skin.joints.astype(np.uint8), target=VERTEX_DATA),
        "WEIGHTS_0": buffer.add(_float32_weights(skin.weights), target=VERTEX_DATA),
    }
    if colors is not None:
        attributes["COLOR_0"] = buffer.add(colors.astype(np.float32), target=VERTEX_DATA)
    width = np.uint16 if len(rest) < 65535 else np.uint32
    return {"attributes": attributes, "indices": buffer.add(triangles.ravel().astype(width), target=INDEX_DATA), "material": 0}


def _add_texture(
    buffer: Buffer, primitive: dict[str, Any], texture: Texture, paint: dict[str, Any], vertices: int
) -> dict[str, Any]:
    """Add an image and its places; the material shows it as it is. Returns the parts of the file that describe it."""
    if len(texture.uv) != vertices:
        raise InputError("the texture belongs to other vertices", where="texture", found=len(texture.uv), expected=vertices)
    primitive["attributes"]["TEXCOORD_0"] = buffer.add(texture.uv.astype(np.float32), target=VERTEX_DATA)
    paint.update(baseColorFactor=[1.0, 1.0, 1.0, 1.0], baseColorTexture={"index": 0})
    view = buffer.add_bytes(texture.png)
    return {
        "images": [{"bufferView": view, "mimeType": "image/png"}],
        "samplers": [{}],
        "textures": [{"source": 0, "sampler": 0}],
    }


def _add_animation(buffer: Buffer, times: FloatArray, poses: FloatArray) -> tuple[list[Any], list[Any]]:
    """Return samplers and channels: a translation and a rotation for each bone."""
    keys = buffer.add(times.astype(np.float32), bounds=True)
    rotations = quaternions(poses[..., :3, :3])
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for bone in range(poses.shape[1]):
        for path, values in (("translation", poses[:, bone, :3, 3]), ("rotation", rotations[:, bone])):
            channels.append({"sampler": len(samplers), "target": {"node": 2 + bone, "path": path}})
            samplers.append({"input": keys, "output": buffer.add(values.astype(np.float32)), "interpolation": "LINEAR"})
    return samplers, channels


def container(gltf: dict[str, Any], binary: bytes) -> bytes:
    """Return a GLB: header, JSON chunk padded with spaces, binary chunk padded with zeros."""
    text = json.dumps(gltf, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, length)
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


# ---- what goes into them ---------------------------------------------------------------------------------------------------


def _as_times(time_s: npt.ArrayLike, frames: int) -> FloatArray:
    """Return times counted from the first [s], shape (F,), strictly increasing in single precision. Raises InputError."""
    times = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
    if times.shape != (frames,) or not np.isfinite(times).all():
        raise InputError("one finite time a frame", where="time_s", found=f"shape {times.shape}", expected=f"({frames},)")
    steps = np.diff((times - times[0]).astype(np.float32))
    bad = np.flatnonzero(steps <= 0)
    if len(bad):
        raise InputError(
            "times must increase",
            where=f"time_s[{bad[0] + 1}]",
            found=f"{times[bad[0] + 1]:.9g} s after {times[bad[0]]:.9g} s",
            expected="each frame later than the one before",
            hint="sort the frames and leave out repeated ones",
        )
    return np.asarray(times - times[0])


def _float32_weights(weights: FloatArray) -> npt.NDArray[np.float32]:
    """Return weights (V, 4) whose single-precision sums are 1 as closely as that precision allows."""
    single = weights.astype(np.float32)
    rest = 1.0 - single[:, 1:].astype(np.float64).sum(axis=1)
    single[:, 0] = rest
    return single


def _colors(color_rgb: npt.ArrayLike | None, vertices: int) -> tuple[FloatArray | None, Sequence[float]]:
    """Return linear vertex colours (V, 3) or None, and the linear base colour with opacity (4 numbers)."""
    color = np.asarray(DEFAULT_COLOR if color_rgb is None else color_rgb, dtype=np.float64)
    if color.shape not in ((3,), (vertices, 3)) or not ((color >= 0) & (color <= 1)).all():
        raise InputError("not a colour", where="color_rgb", found=f"shape {color.shape}", expected="red, green, blue in 0 … 1")
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    if linear.ndim == 1:
        return None, [*_floats(linear), 1.0]
    return linear, [1.0, 1.0, 1.0, 1.0]


def _floats(values: npt.ArrayLike) -> list[float]:
    return [float(v) for v in np.asarray(values).ravel()]
