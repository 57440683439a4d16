"""recording.toml ↔ its tables: cameras, noise, tools, with their checks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StringConstraints, model_validator

from femsense.core.arrays import freeze
from femsense.core.errors import InputError
from femsense.core.units import PER_METRE
from femsense.io.mesh_files import read_surface
from femsense.io.tables import LengthUnit, Matrix, Positive, Schema, at_key, beside, doubles, pose_problems, schema_problems
from femsense.model.camera import Camera, CameraNoise
from femsense.model.recording import Recording
from femsense.model.recording_parts import Tool

FORMAT = "femsense-recording-1"
LENS_KEYS = ("width", "height", "fx", "fy", "cx", "cy")

# The tables of recording.toml

POSE = "4 rows of 4 numbers: maps camera coordinates to robot coordinates, translation in metres"
Pixels = Annotated[int, Field(gt=0)]


Models = Literal["brown_conrady", "inverse_brown_conrady", "kannala_brandt"]
Length = Annotated[float, Field(gt=0, lt=10)]
PlainName = Annotated[str, StringConstraints(pattern=r'^[^/\\,;"\s.][^/\\,;"\r\n\t]*$')]


class NoiseTable(Schema):
    kind: Literal["stereo", "tof"] = Field(
        description='kind = "stereo" (std = at_1m_m · z²) or "tof" (std = floor_m + slope · z)'
    )
    at_1m_m: Annotated[float, Field(gt=0, lt=1)] | None = Field(None, description="std of a depth at 1 m in metres, with stereo")
    floor_m: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="std of a depth at no distance in metres, with tof"
    )
    slope: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="metres of std more in each metre of distance, with tof"
    )

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> NoiseTable:
        given = {key for key in ("at_1m_m", "floor_m", "slope") if getattr(self, key) is not None}
        wanted = {"at_1m_m"} if self.kind == "stereo" else {"floor_m", "slope"}
        if given != wanted:
            raise ValueError(f'the noise of kind "{self.kind}" has {" and ".join(sorted(wanted))}, nothing else')
        if self.kind == "tof" and not self.floor_m and not self.slope:
            raise ValueError("a noise of zero: leave the table out where it is not known")
        return self


class CylinderTable(Schema):
    radius_m: Length = Field(description="radius in metres, > 0")
    length_m: Length = Field(description="length in metres, > 0")


class ToolTable(Schema):
    name: PlainName = Field(description="a name without commas, semicolons, quotes and slashes")
    radius_m: Length | None = Field(None, description="a ball: its radius in metres, > 0")
    cylinder: CylinderTable | None = Field(None, description="cylinder = { radius_m = 0.004, length_m = 0.15 }")
    mesh: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="a closed surface next to recording.toml, with unit"
    )
    unit: LengthUnit | None = Field(None, description='unit = "m", "cm" or "mm": of the coordinates in the mesh file')

    @model_validator(mode="after")
    def _is_one_shape(self) -> ToolTable:
        shapes = [self.radius_m is not None, self.cylinder is not None, self.mesh is not None]
        if sum(shapes) != 1 or (self.mesh is None) != (self.unit is None):
            raise ValueError("a tool is a ball with radius_m, or a cylinder, or a mesh with its unit")
        return self


class CameraTable(Schema):
    width: Pixels | None = Field(None, description="pixels, > 0")
    height: Pixels | None = Field(None, description="pixels, > 0")
    fx: Positive | None = Field(None, description="focal length in pixels, > 0")
    fy: Positive | None = Field(None, description="focal length in pixels, > 0")
    cx: float | None = Field(None, description="principal point in pixels")
    cy: float | None = Field(None, description="principal point in pixels")
    distortion: Annotated[list[float], Field(min_length=4, max_length=8)] = Field(
        default_factory=lambda: [0.0] * 5,
        description="five numbers in OpenCV's order: k1, k2, p1, p2, k3 (or 4, or 8 with k4, k5, k6)",
    )
    distortion_model: Models = Field("brown_conrady", description="the distortion model")
    depth_unit_m: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="metres in one unit of a depth image, such as 0.001"
    )
    T_robot_camera: Matrix | None = Field(None, description=POSE)
    noise: NoiseTable | None = Field(None, description="a table [camera.noise]: noise of a single depth value")

    @model_validator(mode="after")
    def _distortion_fits(self) -> CameraTable:
        count, last = len(self.distortion), self.distortion[4:]
        if count not in (4, 5, 8):
            raise ValueError(f"{count} numbers of distortion are neither 4, nor 5, nor 8")
        if self.distortion_model == "kannala_brandt" and any(last):
            raise ValueError("kannala_brandt has four numbers: k1, k2, k3, k4 (and zeros)")
        return self

    @model_validator(mode="after")
    def _lens_is_complete(self) -> CameraTable:
        missing = [key for key in LENS_KEYS if getattr(self, key) is None]
        if missing and self.model_fields_set - {"T_robot_camera"}:
            raise ValueError(f"the camera lacks {', '.join(missing)}")
        return self


class RecordingTable(Schema):
    """recording.toml, version femsense-recording-1."""

    format: Literal["femsense-recording-1"] = Field(description=f'format = "{FORMAT}"')
    actuation: Literal["tension", "displacement"] = Field(
        description='actuation = "tension" (cable columns in N) or "displacement" (in m, > 0 shortens)'
    )
    actuation_zero: Literal["absolute", "unknown"] = Field(
        description='actuation_zero = "absolute" (the values are the true inputs) or "unknown"'
    )
    T_robot_camera: Matrix | None = Field(None, description=POSE)
    camera: CameraTable | None = Field(None, description="a table [camera] with width, height, fx, fy, cx, cy")
    cameras: Annotated[dict[str, CameraTable], Field(min_length=1)] | None = Field(None, description="tables [cameras.NAME]")
    marker_noise_m: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="repeatability of a marker along each axis in metres, such as 0.0002"
    )
    session: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="a label: recordings of one session share per-session values, such as input offsets"
    )
    tools: list[ToolTable] = Field([], description="tables [[tools]]: objects that may touch the robot, with name and shape")


# Checks


def recording_problems(document: dict[str, Any], path: Path) -> list[InputError]:
    """Return everything that is wrong with the tables of a recording.toml."""
    problems = schema_problems(RecordingTable, document, path)
    return problems or list(table_problems(RecordingTable.model_validate(document), path))


def table_problems(table: RecordingTable, path: Path) -> Iterator[InputError]:
    """Yield the problems that single keys do not show: one camera and several, a pose given twice, a pose that is no rotation."""
    one, several = table.camera, table.cameras or {}
    if one is not None and several:
        yield InputError(
            "both [camera] and [cameras.NAME]", where=path, expected="[camera] for one camera, [cameras.NAME] for several"
        )
    if table.T_robot_camera is not None and several:
        yield InputError(
            "one pose for several cameras", where=at_key(path, "T_robot_camera"), expected="T_robot_camera in each [cameras.NAME]"
        )
    if table.T_robot_camera is not None and one is not None and one.T_robot_camera is not None:
        yield InputError(
            "the pose is given twice", where=at_key(path, "camera", "T_robot_camera"), expected="T_robot_camera above [camera]"
        )
    for name in several:
        if not re.fullmatch(r'[^/\\,;"\s.][^/\\,;"\s]*', name):
            yield InputError(
                "not a name for a camera, which is also the name of its folder",
                where=at_key(path, "cameras"),
                found=repr(name),
                expected="a name without blanks, slashes, commas and a point at its start",
            )
    yield from doubles([tool.name for tool in table.tools], "name", path, "tools", "name")
    yield from pose_problems(table.T_robot_camera, at_key(path, "T_robot_camera"))
    yield from pose_problems(one and one.T_robot_camera, at_key(path, "camera", "T_robot_camera"))
    for name, camera in several.items():
        yield from pose_problems(camera.T_robot_camera, at_key(path, "cameras", name, "T_robot_camera"))


# Parts of a recording


def views_of(table: RecordingTable, path: Path) -> tuple[tuple[str, ...], tuple[Camera | None, ...], tuple[Any, ...]]:
    """Return names, cameras and poses of the views."""
    if table.cameras is not None:
        items = table.cameras
        return tuple(items), tuple(_camera(n, c) for n, c in items.items()), tuple(c.T_robot_camera for c in items.values())
    if table.camera is None:
        return ("",), (None,), (table.T_robot_camera,)
    pose = table.T_robot_camera if table.T_robot_camera is not None else table.camera.T_robot_camera
    camera = _camera("", table.camera)
    if camera is None and pose is None:
        raise InputError(
            "the camera lacks its lens",
            where=at_key(path, "camera"),
            found="no width, height, fx, fy, cx, cy",
            expected=", ".join(LENS_KEYS),
        )
    return ("",), (camera,), (pose,)


def _camera(name: str, table: CameraTable) -> Camera | None:
    w, h, fx, fy, cx, cy = table.width, table.height, table.fx, table.fy, table.cx, table.cy
    if w is None or h is None or fx is None or fy is None or cx is None or cy is None:
        return None
    distortion = freeze([*table.distortion, 0.0] if len(table.distortion) == 4 else table.distortion)
    unit, noise = table.depth_unit_m or 0.001, table.noise
    errors = None if noise is None else CameraNoise(noise.kind, noise.at_1m_m or 0.0, noise.floor_m or 0.0, noise.slope or 0.0)
    return Camera(name, w, h, fx, fy, cx, cy, distortion, unit, table.distortion_model, errors)


def tools_of(table: RecordingTable, path: Path) -> tuple[Tool, ...]:
    """Return the tools, their meshes read. Raises InputError where a mesh is missing, broken or open."""
    return tuple(_tool(tool, at_key(path, "tools", i, "mesh"), path) for i, tool in enumerate(table.tools))


def _tool(table: ToolTable, where: str, path: Path) -> Tool:
    if table.radius_m is not None:
        return Tool(table.name, "ball", table.radius_m)
    if table.cylinder is not None:
        return Tool(table.name, "cylinder", table.cylinder.radius_m, table.cylinder.length_m)
    file, unit = beside(path, str(table.mesh)), str(table.unit)
    points, triangles = read_surface(file, where=where)
    mesh = freeze(points / PER_METRE[unit])
    return Tool(table.name, "mesh", points=mesh, triangles=freeze(triangles, np.int64), mesh_file=file.absolute(), mesh_unit=unit)


# Back to tables


def recording_document(recording: Recording) -> dict[str, Any]:
    """Return the plain tables of recording.toml."""
    document: dict[str, Any] = {"format": FORMAT, "actuation": recording.actuation, "actuation_zero": recording.actuation_zero}
    optional = {"marker_noise_m": recording.marker_noise_m, "session": recording.session}
    document |= {key: value for key, value in optional.items() if value is not None}
    if recording.tools:
        document["tools"] = [_tool_document(tool) for tool in recording.tools]
    tables = [camera_document(camera) for camera in recording.cameras]
    poses = [None if pose is None else pose.tolist() for pose in recording.T_robot_camera]
    if recording.camera_names == ("",):
        if poses[0] is not None:
            document["T_robot_camera"] = poses[0]
        return document | ({"camera": tables[0]} if tables[0] else {})
    document["cameras"] = {
        name: table | ({} if pose is None else {"T_robot_camera": pose})
        for name, table, pose in zip(recording.camera_names, tables, poses)
    }
    return document


def camera_document(camera: Camera | None) -> dict[str, Any]:
    """Return the table of a camera; empty without one."""
    if camera is None:
        return {}
    table: dict[str, Any] = {key: getattr(camera, key) for key in LENS_KEYS}
    table |= {"distortion": camera.distortion.tolist(), "depth_unit_m": camera.depth_unit}
    if camera.distortion_model != "brown_conrady":
        table["distortion_model"] = camera.distortion_model
    return table if camera.noise is None else table | {"noise": _noise_document(camera.noise)}


def _noise_document(noise: CameraNoise) -> dict[str, Any]:
    if noise.kind == "stereo":
        return {"kind": noise.kind, "at_1m_m": noise.at_1m}
    return {"kind": noise.kind, "floor_m": noise.floor, "slope": noise.slope}


def _tool_document(tool: Tool) -> dict[str, Any]:
    if tool.kind == "ball":
        return {"name": tool.name, "radius_m": tool.radius}
    if tool.kind == "cylinder":
        return {"name": tool.name, "cylinder": {"radius_m": tool.radius, "length_m": tool.length}}
    return {"name": tool.name, "mesh": tool_file(tool), "unit": tool.mesh_unit}


def tool_file(tool: Tool) -> str:
    """Return the name that a tool's mesh has in a saved recording."""
    return f"tool-{tool.name}{tool.mesh_file.suffix.lower() if tool.mesh_file else '.off'}"
