"""Reads the skinned, animated mesh that `gltf.write_glb` writes: bones, weights, bone poses over time,
and the surface."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.xr.gltf import COMPONENT, SHAPE, T_GLTF_ROBOT
from femsense.xr.skeleton import Skeleton
from femsense.xr.skinning import Skin

COMPONENTS = {code: dtype.newbyteorder("<") for dtype, code in COMPONENT.items()}
WIDTHS = {name: math.prod(shape) for shape, name in SHAPE.items()}


@dataclass(frozen=True, eq=False, slots=True)
class AnimatedSkin:
    """A skinned mesh and how its bones move, robot frame."""

    skin: Skin
    time_s: FloatArray
    """Times of the poses, from the first, shape (F,)."""
    bones: npt.NDArray[np.float32]
    """x y z [m] qx qy qz qw of each bone, shape (F, B, 7)."""


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """How a mesh looks, glTF's frame (Y up)."""

    name: str
    points: npt.NDArray[np.float32]
    """At rest [m], shape (V, 3)."""
    normals: npt.NDArray[np.float32]
    """shape (V, 3)."""
    triangles: IntArray
    """shape (t, 3)."""
    color: npt.NDArray[np.float32]
    """Linear red, green, blue of the material, shape (3,)."""
    colors: npt.NDArray[np.float32] | None
    """The same of each vertex, shape (V, 3)."""
    uv: npt.NDArray[np.float32] | None
    """Places in the image, from its upper left corner, shape (V, 2)."""
    png: bytes | None
    """The image."""


def read_glb(data: bytes) -> AnimatedSkin:
    """Return the skin and animation in the content of a file that femsense wrote. Raises InputError for any other."""
    with _ours():
        return _skin(*parts_of(data))


def read_surface(data: bytes) -> Surface:
    """Return the surface in the same content. Raises InputError as `read_glb`."""
    with _ours():
        return _surface(*parts_of(data))


@contextmanager
def _ours() -> Iterator[None]:
    try:
        yield
    except (KeyError, IndexError, ValueError, StopIteration, struct.error) as error:
        raise InputError(
            "not a mesh of femsense", where="glb", found=f"{type(error).__name__}: {error}", expected="femsense export RUN"
        ) from None


def parts_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON document and the binary chunk of a file. Raises ValueError if it is not binary glTF."""
    magic, _, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if magic != b"glTF" or kind != b"JSON" or length != len(data):
        raise ValueError("not binary glTF")
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def _surface(document: dict[str, Any], binary: bytes) -> Surface:
    primitive = document["meshes"][0]["primitives"][0]
    part = {name: _array(document, binary, index) for name, index in primitive["attributes"].items()}
    png = None
    if "images" in document:
        view = document["bufferViews"][document["images"][0]["bufferView"]]
        png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return Surface(
        document["meshes"][0]["name"],
        part["POSITION"],
        part["NORMAL"],
        _array(document, binary, primitive["indices"]).reshape(-1, 3).astype(np.int64),
        np.array(document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][:3], dtype=np.float32),
        part.get("COLOR_0"),
        part.get("TEXCOORD_0"),
        png,
    )


def _skin(document: dict[str, Any], binary: bytes) -> AnimatedSkin:
    joints = document["skins"][0]["joints"]
    nodes = [document["nodes"][joint] for joint in joints]
    origins = np.array([node["translation"] for node in nodes], dtype=np.float64)
    T_robot_bone = np.tile(np.eye(4), (len(nodes), 1, 1))
    T_robot_bone[:, :3, 3] = origins
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    part = {name: _array(document, binary, index) for name, index in attributes.items()}
    rest = part["POSITION"].astype(np.float64) @ T_GLTF_ROBOT[:3, :3]
    skin = Skin(
        Skeleton(T_robot_bone, tuple(node["name"] for node in nodes)),
        rest,
        part["JOINTS_0"],
        part["WEIGHTS_0"].astype(np.float64),
    )
    animation = document["animations"][0]
    times = _array(document, binary, animation["samplers"][0]["input"])[:, 0]
    rows = np.zeros((len(times), len(nodes), 7), dtype=np.float32)
    place = {"translation": slice(0, 3), "rotation": slice(3, 7)}
    for channel in animation["channels"]:
        if channel["target"]["node"] not in joints:
            continue  # an arrow
        bone = joints.index(channel["target"]["node"])
        rows[:, bone, place[channel["target"]["path"]]] = _array(
            document, binary, animation["samplers"][channel["sampler"]]["output"]
        )
    return AnimatedSkin(skin, freeze(times.astype(np.float64)), freeze(rows, np.float32))


def _array(document: dict[str, Any], binary: bytes, index: int) -> npt.NDArray[Any]:
    """Return an accessor's values, shape (count, width)."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = WIDTHS[accessor["type"]]
    kind = COMPONENTS[accessor["componentType"]]
    return np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
