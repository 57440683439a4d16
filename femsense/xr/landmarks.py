"""Points that a digital twin shares with the real robot: its markers, and cameras at their calibrated positions."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, freeze


@dataclass(frozen=True, eq=False, slots=True)
class Landmark:
    """A point with a name."""

    name: str
    position_m: FloatArray
    """Of a marker at rest, of a camera always; robot frame, shape (3,)."""


@dataclass(frozen=True, eq=False, slots=True)
class Landmarks:
    """Points for aligning the twin with the robot by touch."""

    markers: tuple[Landmark, ...] = ()
    cameras: tuple[Landmark, ...] = ()


def landmarks_of_run(run: Path) -> Landmarks:
    """Return the markers of the robot of a run and the cameras of its calibration; those whose files are missing are left out."""
    calibration, told = _document(run / "calibration.json"), _markers(robot_table(run))
    seats = calibration.get("placements_m")
    if isinstance(seats, dict):
        told |= {name: seats[name] for name in told.keys() & seats.keys()}
    pose = calibration.get("T_robot_camera")
    cameras = () if pose is None else (Landmark("the camera", freeze(np.asarray(pose, dtype=float)[:3, 3])),)
    return Landmarks(tuple(Landmark(name, freeze(place)) for name, place in told.items()), cameras)


def run_document(run: Path) -> dict[str, Any]:
    """Return the content of run.json; empty if it cannot be read."""
    return _document(run / "run.json")


def robot_table(run: Path) -> dict[str, Any]:
    """Return the content of robot.toml of the run's robot; empty if it no longer exists."""
    try:
        return tomllib.loads(Path(run_document(run)["inputs"]["robot"]["path"], "robot.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _markers(robot: dict[str, Any]) -> dict[str, Any]:
    try:
        return {str(row["name"]): np.asarray(row["position_m"], dtype=float).reshape(3) for row in robot.get("markers", [])}
    except (ValueError, KeyError, TypeError):
        return {}


def _document(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
