"""Contact forces in a glTF file: an arrow for each contact that moves, turns and scales with its force, and its uncertainty.

The tip of the arrow is the contact point. A pale cone shows one standard deviation of the direction, a pale spheroid at the tip one of the
contact point. In frames without the contact its nodes have zero size. Any glTF viewer shows forces this way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import vertex_normals
from femsense.model.robot import Robot
from femsense.sensing.run_arrays import identities_of, tracks_of
from femsense.sensing.types import ContactForce, FrameReport
from femsense.xr.glb_reader import parts_of
from femsense.xr.gltf import INDEX_DATA, VERTEX_DATA, Buffer, container, without_jumps

LONGEST = 0.42
"""Length of the arrow of the largest force, relative to the body's size."""
SIDES = 24
SHAFT, HEAD, HEAD_LENGTH = 0.03, 0.08, 0.28
"""Radii, and the length of the head, of an arrow of length 1."""
NODE = "forces"
"""Name of the node that holds them, in the robot's frame."""


@dataclass(frozen=True, eq=False, slots=True)
class _Track:
    """One contact over the frames; scale 0 in frames without it."""

    place: FloatArray
    """[m], shape (F, 3)."""
    turn: FloatArray
    """Quaternions x y z w that turn +Y into the force, shape (F, 4)."""
    length: FloatArray
    """Length of the arrow [m], shape (F,)."""
    aside: FloatArray
    """One standard deviation of its tail, across the force [m], shape (F,)."""
    blur: FloatArray
    """One standard deviation of the contact point along each axis [m], shape (F, 3)."""


class RunLike(Protocol):
    """A run, as far as its forces are drawn."""

    @property
    def contacts(self) -> tuple[ContactForce, ...]: ...
    @property
    def frames(self) -> tuple[FrameReport, ...]: ...
    @property
    def robot(self) -> Robot: ...


def with_arrows(glb: bytes, run: RunLike) -> bytes:
    """Return the content of a `.glb` file of femsense with the contact forces of its run.

    Arguments:
        glb: content of a file that `gltf.write_glb` wrote.
        run: run of which the file was written, with the same frames.

    Raises:
        InputError: not a mesh of femsense.
    """
    document, binary = parts_of(glb)
    buffer = Buffer(bytearray(binary), document["bufferViews"], document["accessors"])
    bounds = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    size = float(np.linalg.norm(np.subtract(bounds["max"], bounds["min"])))
    tracks = _tracks(run, size)
    nodes, animation = document["nodes"], document["animations"][0]
    arrow, cone, ball = (_add_mesh(buffer, document, name, *shape) for name, shape in _shapes().items())
    keys = animation["samplers"][0]["input"]
    holder: dict[str, Any] = {"name": NODE}
    nodes[1]["children"].append(len(nodes))
    nodes.append(holder)
    for k, track in enumerate(tracks):
        even = np.repeat(track.length[:, None], 3, axis=1)
        wide = np.column_stack([track.aside, track.length, track.aside])
        still = np.tile([0.0, 0.0, 0.0, 1.0], (len(track.length), 1))
        parts = (("arrow", arrow, track.turn, even), ("direction", cone, track.turn, wide), ("place", ball, still, track.blur))
        for part, mesh, turn, scale in parts:
            holder.setdefault("children", []).append(len(nodes))
            values = {"translation": track.place, "rotation": turn, "scale": scale}
            _animate(buffer, animation, keys, len(nodes), values)
            nodes.append({"name": f"contact_{k + 1}_{part}", "mesh": mesh, "scale": [float(v) for v in scale[0]]})
    document.update(buffer.description())
    return container(document, bytes(buffer.content))


def _animate(buffer: Buffer, animation: dict[str, Any], keys: int, node: int, values: dict[str, FloatArray]) -> None:
    for path, rows in values.items():
        animation["channels"].append({"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}})
        output = buffer.add(rows.astype(np.float32))
        animation["samplers"].append({"input": keys, "output": output, "interpolation": "LINEAR"})


# ---- what moves


def _tracks(run: RunLike, size: float) -> list[_Track]:
    """Return the tracks of a run; forces are drawn so that the largest is LONGEST of the body's size [m]."""
    largest = max((float(np.linalg.norm(one.force_n_xyz)) for one in run.contacts), default=0.0)
    scale = LONGEST * size / max(largest, 1e-12)
    at, identities = {frame.frame: i for i, frame in enumerate(run.frames)}, identities_of(run)
    tracks = []
    for track in tracks_of(run):
        contacts = [one for one, identity in zip(run.contacts, identities) if identity == track]
        tracks.append(_track(contacts, np.array([at[one.frame] for one in contacts]), len(run.frames), scale))
    return tracks


def _track(contacts: Sequence[ContactForce], frames: IntArray, count: int, metres_per_newton: float) -> _Track:
    """Return a contact over `count` frames, present in `frames`."""
    from scipy.spatial.transform import Rotation

    nearest = np.abs(np.arange(count)[:, None] - frames).argmin(axis=1)  # in frames without it, its last pose is kept
    forces = np.array([one.force_n_xyz for one in contacts])
    sizes = np.linalg.norm(forces, axis=1)
    along = forces / np.maximum(sizes, 1e-12)[:, None]
    turn = np.array([Rotation.align_vectors(way[None], [[0.0, 1.0, 0.0]])[0].as_quat() for way in along])[nearest]
    there = np.isin(np.arange(count), frames).astype(float)
    std = np.nan_to_num([one.force_std_n_xyz for one in contacts])
    across = np.sqrt(np.maximum((std**2).sum(axis=1) - ((std * along) ** 2).sum(axis=1), 0.0) / 2.0)
    return _Track(
        place=np.array([one.position_m for one in contacts])[nearest],
        turn=without_jumps(turn),
        length=there * metres_per_newton * sizes[nearest],
        aside=there * metres_per_newton * across[nearest],
        blur=there[:, None] * np.nan_to_num([one.position_std_m for one in contacts])[nearest],
    )


# ---- shapes


def _shapes() -> dict[str, tuple[FloatArray, IntArray, float]]:
    """Return vertices, triangles and opacity of an arrow along +Y that ends at the origin, of a cone about it, and of a ball."""
    neck = -HEAD_LENGTH
    arrow = _turned([(0.0, -1.0), (SHAFT, -1.0), (SHAFT, neck), (HEAD, neck), (0.0, 0.0)])
    cone = _turned([(0.0, -1.0), (1.0, -1.0), (0.0, 0.0)])
    bow = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    ball = _turned([(float(np.cos(a)) * (abs(a) < 1.57), float(np.sin(a))) for a in bow])
    return {"arrow": (*arrow, 1.0), "direction": (*cone, 0.25), "place": (*ball, 0.25)}


def _turned(outline: Sequence[tuple[float, float]]) -> tuple[FloatArray, IntArray]:
    """Return vertices and outward triangles of an outline (radius, height), from below, turned about +Y."""
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
    circle = np.column_stack([np.cos(angle), 0.0 * angle, -np.sin(angle)])
    points, triangles = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    i, n = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    for (r0, y0), (r1, y1) in pairwise(outline):  # each band with vertices of its own: edges stay sharp
        low, high = len(points) + i, len(points) + SIDES + i
        bands = [np.stack([low, low[n], high[n]], axis=1)] if r0 > 0.0 else []
        bands += [np.stack([low, high[n], high], axis=1)] if r1 > 0.0 else []
        points = np.vstack([points, r0 * circle + [0.0, y0, 0.0], r1 * circle + [0.0, y1, 0.0]])
        triangles = np.vstack([triangles, *bands])
    return points, triangles


def _add_mesh(
    buffer: Buffer, document: dict[str, Any], name: str, points: FloatArray, triangles: IntArray, opacity: float
) -> int:
    """Add a mesh with a material and return its number."""
    paint = {"baseColorFactor": [1.0, 0.33, 0.033, opacity], "metallicFactor": 0.0, "roughnessFactor": 0.55}
    material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": paint}
    if opacity < 1.0:
        material |= {"alphaMode": "BLEND", "doubleSided": True}
    document["materials"].append(material)
    used, corners = np.unique(triangles, return_inverse=True)
    rest, corners = points[used], corners.reshape(-1, 3)
    attributes = {
        "POSITION": buffer.add(rest.astype(np.float32), target=VERTEX_DATA, bounds=True),
        "NORMAL": buffer.add(vertex_normals(rest, corners).astype(np.float32), target=VERTEX_DATA),
    }
    indices = buffer.add(corners.ravel().astype(np.uint16), target=INDEX_DATA)
    primitive = {"attributes": attributes, "indices": indices, "material": len(document["materials"]) - 1}
    document["meshes"].append({"name": name, "primitives": [primitive]})
    return len(document["meshes"]) - 1
