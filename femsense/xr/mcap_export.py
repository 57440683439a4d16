"""A run as an MCAP file of ROS 2: clouds, contacts, forces, inputs and the deformed body, as Foxglove shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.packages import needed
from femsense.io.files import check_target, write_beside
from femsense.io.own_files import MCAP
from femsense.model.recording import Recording
from femsense.sensing.run_files import read_run
from femsense.sensing.types import ContactForce, Run
from femsense.xr.ros_definitions import MESSAGES, definition
from femsense.xr.run_scene import BODY, FORCE, arrow_of, body_surface, camera_pose, cloud_of, recording_of

NOBODY: dict[str, list[Any]] = {
    name: [] for name in ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
}
TURNED = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


@dataclass(frozen=True, slots=True)
class McapReport:
    """Result of `export_mcap`."""

    frames: int
    clouds: int
    contacts: int
    topics: tuple[str, ...]


def export_mcap(folder: str | Path, path: str | Path) -> McapReport:
    """Write a run as MCAP with messages of ROS 2.

    Topics: /tf (robot → camera, contact_…), /femsense/contacts (PoseArray, z along the outward normal),
        /femsense/force_… (WrenchStamped
    [N] at contact_…), /femsense/inputs (JointState; effort holds tensions [N] and pressures [Pa]),
    /femsense/scene (SceneUpdate: the deformed surface and arrows), /femsense/cloud (PointCloud2, camera frame) where the
    recording has clouds and is still there.

    Arguments:
        folder: a run that `femsense estimate` wrote.
        path: the .mcap file.

    Raises:
        InputError: no run, or another file at that place. MissingDependency: without the extra mcap.
    """
    check_target(path, folder=False, kind=MCAP)
    run = read_run(folder)
    writer_module = needed("mcap_ros2.writer", "mcap", "writing MCAP")
    pose, recording, clouds = camera_pose(folder), recording_of(run), 0
    with write_beside(path) as part, part.open("wb") as stream:
        writer = writer_module.Writer(stream)
        out = _Topics(writer)
        for index, report in enumerate(run.frames):
            at = round(1e9 * report.time_s)
            contacts = [c for c in run.contacts if c.frame == report.frame]
            _write_frame(out, run, index, contacts, at, pose)
            clouds += _write_cloud(out, recording, report.frame, at)
        writer.finish()
    return McapReport(len(run.frames), clouds, len(run.contacts), tuple(sorted(out.topics)))


class _Topics:
    """Writes messages; their definitions go in once."""

    def __init__(self, writer: Any) -> None:
        self.writer = writer
        self.schemas = {name: writer.register_msgdef(name, definition(name)) for name in MESSAGES}
        self.topics: set[str] = set()

    def write(self, topic: str, kind: str, message: Mapping[str, Any], at: int) -> None:
        self.topics.add(topic)
        self.writer.write_message(topic, self.schemas[kind], message, log_time=at, publish_time=at)


def _write_frame(out: _Topics, run: Run, index: int, contacts: list[ContactForce], at: int, pose: FloatArray | None) -> None:
    transforms = [] if pose is None else [_transform("robot", "camera", pose[:3, 3], _quaternion(pose[:3, :3]), at)]
    transforms += [_transform("robot", f"contact_{c.contact}", c.position_m, TURNED, at) for c in contacts]
    if transforms:
        out.write("/tf", "tf2_msgs/msg/TFMessage", {"transforms": transforms}, at)
    poses = [{"position": _xyz(c.position_m), "orientation": _towards(c.normal, axis=2)} for c in contacts]
    out.write("/femsense/contacts", "geometry_msgs/msg/PoseArray", {"header": _header("robot", at), "poses": poses}, at)
    for c in contacts:
        wrench = {"force": _xyz(c.force_n_xyz), "torque": _xyz(np.zeros(3))}
        message = {"header": _header(f"contact_{c.contact}", at), "wrench": wrench}
        out.write(f"/femsense/force_{c.contact}", "geometry_msgs/msg/WrenchStamped", message, at)
    report = run.frames[index]
    drives = {**report.tension_n, **report.pressure_pa}
    if drives:
        state = {
            "header": _header("robot", at),
            "name": list(drives),
            "position": [],
            "velocity": [],
            "effort": list(drives.values()),
        }
        out.write("/femsense/inputs", "sensor_msgs/msg/JointState", state, at)
    out.write(
        "/femsense/scene", "foxglove_msgs/msg/SceneUpdate", {"deletions": [], "entities": _entities(run, index, contacts, at)}, at
    )


def _entities(run: Run, index: int, contacts: list[ContactForce], at: int) -> list[Any]:
    """Return the deformed surface and the arrows of the forces; arrows of an earlier frame go with their entity."""
    nodes, corners = body_surface(run, index)
    entities = []
    if np.isfinite(nodes).all():
        mesh = {
            "pose": {"position": _xyz(np.zeros(3)), "orientation": TURNED},
            "points": [_xyz(p) for p in nodes],
            "color": _color(BODY),
            "colors": [],
            "indices": corners.ravel().tolist(),
        }
        entities.append(_entity("body", at) | {"triangles": [mesh]})
    return [*entities, _entity("forces", at) | {"arrows": [_arrow(c) for c in contacts if np.isfinite(c.force_n_xyz).all()]}]


def _arrow(contact: ContactForce) -> dict[str, Any]:
    """Return an arrow that ends at the contact point."""
    start, along = arrow_of(contact)
    length = float(np.linalg.norm(along))
    return {
        "pose": {"position": _xyz(start), "orientation": _towards(contact.force_n_xyz, axis=0)},
        "shaft_length": 0.75 * length,
        "shaft_diameter": 0.08 * length,
        "head_length": 0.25 * length,
        "head_diameter": 0.18 * length,
        "color": _color(FORCE),
    }


def _write_cloud(out: _Topics, recording: Recording | None, frame: int, at: int) -> int:
    """Write the cloud of a frame, if there is one; return how many were written."""
    cloud = cloud_of(recording, frame)
    if cloud is None:
        return 0
    kind = [(axis, "<f4") for axis in "xyz"] + ([] if cloud.colors is None else [("rgb", "<u4")])
    rows = np.empty(len(cloud), dtype=kind)
    for i, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, i]
    if cloud.colors is not None:
        rows["rgb"] = np.rint(255 * cloud.colors).astype(np.uint32) @ np.array([65536, 256, 1], dtype=np.uint32)
    fields = [{"name": n, "offset": 4 * i, "datatype": 7, "count": 1} for i, (n, _) in enumerate(kind)]
    size = rows.dtype.itemsize
    message = {
        "header": _header("camera", at),
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "is_bigendian": False,
        "point_step": size,
        "row_step": size * len(rows),
        "data": rows.tobytes(),
        "is_dense": True,
    }
    out.write("/femsense/cloud", "sensor_msgs/msg/PointCloud2", message, at)
    return 1


# Parts of messages


def _stamp(at: int) -> dict[str, int]:
    return {"sec": at // 10**9, "nanosec": at % 10**9}


def _header(frame: str, at: int) -> dict[str, Any]:
    return {"stamp": _stamp(at), "frame_id": frame}


def _xyz(values: Any) -> dict[str, float]:
    return {axis: float(v) for axis, v in zip("xyz", values)}


def _color(rgba: tuple[float, float, float, float]) -> dict[str, float]:
    return dict(zip("rgba", rgba))


def _entity(name: str, at: int) -> dict[str, Any]:
    return {
        "timestamp": _stamp(at),
        "frame_id": "robot",
        "id": name,
        "lifetime": {"sec": 0, "nanosec": 0},
        "frame_locked": False,
        **NOBODY,
    }


def _transform(parent: str, child: str, place: Any, turn: Mapping[str, float], at: int) -> dict[str, Any]:
    return {"header": _header(parent, at), "child_frame_id": child, "transform": {"translation": _xyz(place), "rotation": turn}}


def _quaternion(R: FloatArray) -> dict[str, float]:
    from scipy.spatial.transform import Rotation

    return dict(zip("xyzw", Rotation.from_matrix(R).as_quat().tolist()))


def _towards(direction: Any, *, axis: int) -> dict[str, float]:
    """Return a rotation that takes an axis (0: x, 2: z) to a direction, shape (3,)."""
    d = np.asarray(direction, dtype=float)
    size = np.linalg.norm(d)
    if not np.isfinite(size) or size == 0.0:
        return dict(TURNED)
    first = d / size
    other = np.eye(3)[int(np.argmin(np.abs(first)))]
    second = np.cross(first, other)
    second /= np.linalg.norm(second)
    columns = [first, second, np.cross(first, second)]
    return _quaternion(np.stack(columns[-axis:] + columns[:-axis] if axis else columns, axis=1))
