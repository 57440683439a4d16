"""Provenance of a result: inputs with their hashes, and versions."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import femsense
from femsense.core.packages import installed_version
from femsense.io.files import file_hash, json_text, plain
from femsense.io.result_folder import RUN_FILES
from femsense.model.effects.user_defined import find_own_file

if TYPE_CHECKING:
    from femsense.model.recording import Recording
    from femsense.model.robot import Robot


RECORDING_PARTS = ("recording.toml", "frames.csv", "markers.csv", "rest.csv", "loads.csv", "clouds", "depth", "color")
"""Files that results depend on; other files of a recording, such as its truth, do not count."""


def robot_input(robot: Robot) -> dict[str, Any]:
    """Return name, folder and SHA-256 of a robot: of its declaration with effects, and of its mesh."""
    mesh = robot.body.mesh
    digest = hashlib.sha256(json_text(robot.document).encode())
    digest.update(np.ascontiguousarray(mesh.nodes).tobytes() + np.ascontiguousarray(mesh.tets).tobytes())
    for entry in (robot.document or {}).get("effects", []):
        if "file" in entry:
            digest.update(file_hash(find_own_file(entry, robot)).encode())
    if robot.correction is not None:
        c = robot.correction
        digest.update(
            json_text(plain([c.kernel, c.length, c.ranges, c.states, c.basis, c.weights, c.covariance, c.noise])).encode()
        )
    return {"name": robot.name, "path": None if robot.folder is None else str(robot.folder), "sha256": digest.hexdigest()}


def recording_input(recording: Recording) -> dict[str, Any]:
    """Return folder and SHA-256 of a recording: of its frames' numbers and the files that results depend on."""
    if recording.folder is None:
        return {"path": None, "sha256": None}
    digest = hashlib.sha256(np.ascontiguousarray(recording.frame_numbers).tobytes())
    for part in RECORDING_PARTS:
        place = recording.folder / part
        for file in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if file.is_file():
                digest.update(f"{file.relative_to(recording.folder).as_posix()}\0{file_hash(file)}\n".encode())
    return {"path": str(recording.folder), "sha256": digest.hexdigest()}


def finished(folder: str | Path, inputs: Mapping[str, Any]) -> bool:
    """Return whether a folder holds the complete results of these inputs, made by this version of femsense."""
    root = Path(folder)
    marker = root / "run.json" if (root / "run.json").is_file() else root / "loop.json"
    try:
        known = json.loads(marker.read_text(encoding="utf-8"))
        made_from, versions = known["inputs"], known["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    complete = all((root / name).is_file() for name in (RUN_FILES if marker.name == "run.json" else ("robot.toml",)))
    same_version = isinstance(versions, dict) and versions.get("femsense") == femsense.__version__
    return complete and same_version and _without_paths(made_from) == _without_paths(plain(inputs)) and not _without_hash(inputs)


def versions() -> dict[str, str]:
    """Return the versions of femsense and of the packages that its numbers depend on."""
    found = {"femsense": femsense.__version__}
    for package, names in (("numpy", ("numpy",)), ("scipy", ("scipy",)), ("open3d", ("open3d-cpu", "open3d"))):
        found[package] = next((v for v in map(installed_version, names) if v), "not installed")
    return found


def _text_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _without_paths(value: Any) -> Any:
    """Return inputs without their places: the same content elsewhere is the same input."""
    if isinstance(value, Mapping):
        return {key: _without_paths(item) for key, item in value.items() if key != "path"}
    return [_without_paths(item) for item in value] if isinstance(value, list | tuple) else value


def _without_hash(value: Any) -> bool:
    """Return whether an input was made in Python and therefore has no hash."""
    if isinstance(value, Mapping):
        return ("sha256" in value and value["sha256"] is None) or any(map(_without_hash, value.values()))
    return any(map(_without_hash, value)) if isinstance(value, list | tuple) else False
