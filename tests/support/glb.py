"""Just enough of glTF to place vertices as a viewer would, and Node for its validator."""

from __future__ import annotations

import importlib.util
import json
import struct
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


# ---- a reader that shares nothing with the writer ------------------------------------------------------------------------


class Glb:
    """Just enough of glTF 2.0 to put the skinned vertices of a time where a viewer would."""

    TYPES: ClassVar = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    WIDTHS: ClassVar = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<III", data)
        assert (magic, version, length) == (0x46546C67, 2, len(data))
        size, kind = struct.unpack_from("<II", data, 12)
        assert kind == 0x4E4F534A
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        self.binary = data[20 + size + 8 :]

    def array(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        width = self.WIDTHS[accessor["type"]]
        flat = np.frombuffer(self.binary, self.TYPES[accessor["componentType"]], accessor["count"] * width, view["byteOffset"])
        return flat.reshape(accessor["count"], width) if width > 1 else flat

    def attribute(self, name: str) -> np.ndarray:
        return self.array(self.json["meshes"][0]["primitives"][0]["attributes"][name])

    @property
    def times(self) -> np.ndarray:
        return self.array(self.json["animations"][0]["samplers"][0]["input"])

    def vertices(self, key: int | None) -> np.ndarray:
        """Positions in glTF's frame at a key of the animation, or at rest."""
        joints = self.json["skins"][0]["joints"]
        bind = self.array(self.json["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
        matrices = np.array([self.world(node, key) @ bind[j] for j, node in enumerate(joints)])
        points = np.c_[self.attribute("POSITION"), np.ones(len(self.attribute("POSITION")))]
        weights, indices = self.attribute("WEIGHTS_0").astype(float), self.attribute("JOINTS_0")
        return np.einsum("vk,vkij,vj->vi", weights, matrices[indices], points)[:, :3]

    def world(self, node: int, key: int | None) -> np.ndarray:
        parent = next((i for i, n in enumerate(self.json["nodes"]) if node in n.get("children", [])), None)
        local = self.local(node, key)
        return local if parent is None else self.world(parent, key) @ local

    def local(self, node: int, key: int | None) -> np.ndarray:
        part = {"translation": [0.0, 0, 0], "rotation": [0.0, 0, 0, 1]} | self.json["nodes"][node]
        animation = self.json["animations"][0]
        for channel in animation["channels"] if key is not None else []:
            if channel["target"]["node"] == node:
                part[channel["target"]["path"]] = self.array(animation["samplers"][channel["sampler"]]["output"])[key]
        x, y, z, w = (float(v) for v in part["rotation"])
        T = np.eye(4)  # the quaternion's matrix, written out
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = part["translation"]
        return T


def in_gltf(points: np.ndarray) -> np.ndarray:
    """Robot frame (Z up) to glTF (Y up), written out: what was up is y, what was y points at the viewer's back."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def build_hook() -> ModuleType:
    """The module that finds Node and npm for the wheel; it does so for the tests too."""
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hatch_build"] = module
    spec.loader.exec_module(module)
    return module


def npm_folder(cache: Path, *packages: str) -> Path:
    """A folder with these npm packages; kept between runs. Skips where npm cannot be had."""
    hook = build_hook()
    done = cache / "installed.json"
    if done.is_file() and json.loads(done.read_text()) == list(packages):
        return cache
    try:
        command = hook.npm_command(("install", "--ignore-scripts", "--no-audit", "--no-fund", "--no-save", *packages))
        subprocess.run(command, cwd=cache, check=True, capture_output=True, timeout=180)
    except (RuntimeError, subprocess.SubprocessError) as error:
        pytest.skip(f"npm cannot be reached: {error}")
    done.write_text(json.dumps(packages))
    return cache
