"""Messages about a robot: topics, and the bytes of each.

A pose is a header of 20 bytes and seven numbers per bone, little-endian:

    "FSP1" · seq uint32 · time float64 [s] · bones uint16 · 0 uint16 · (x y z qx qy qz qw) float32 each, robot frame [m]

A cloud has the same header with "FSC1" and a count uint32, then (x y z residual) float32 of each point [m]. A field,
such as stress, has that header with "FSV1", then the largest value float32 and the share of it at each vertex of the mesh,
0 … 255. All other messages are JSON that Unity's JsonUtility reads: objects at the top, no dictionaries, unknown numbers left out.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.xr.landmarks import Landmarks

PREFIX = "femsense"


class Kind(StrEnum):
    """The kinds of messages, the last part of a topic."""

    MODEL = "model"
    GLB = "glb"
    POSE = "pose"
    POSE_JSON = "pose_json"
    FORCE = "force"
    INPUTS = "inputs"
    CLOUD = "cloud"
    FIELD = "field"
    STATUS = "status"
    DRAG = "drag"
    GHOST = "ghost"
    REACH = "reach"
    COMMAND = "command"
    MEASURED = "measured"
    LEASE = "lease"
    STOP = "stop"


RECEIVED = (Kind.DRAG, Kind.MEASURED, Kind.STOP)
"""What clients may send: requests, measured markers of the robot, and the stop of all motion."""
RETAINED = (Kind.MODEL, Kind.GLB, Kind.STATUS)
"""Kept by the broker, so that who comes late has them at once."""
SCHEMA = "femsense-model-1"
FRAMES = {"robot": "robot: right-handed, Z up", "markers": "markers: as they were measured, not the robot's"}
"""Frames of reference, and their names in `model`."""
POSE_HEAD = struct.Struct("<4sIdHH")
CLOUD_HEAD = struct.Struct("<4sIdI")
POSE_MAGIC, CLOUD_MAGIC, FIELD_MAGIC = b"FSP1", b"FSC1", b"FSV1"
MOST_POINTS = 20_000


@dataclass(frozen=True, eq=False, slots=True)
class Input:
    """An input of a robot, with its range."""

    name: str
    unit: str
    """"N", "m" or "Pa"; for sensors the unit of their file, or ""."""
    low: float
    high: float
    range: str = "declared"
    """Source of the range: "declared" (limits of the robot), "reached" (in the displayed run; no limits are declared) or "learnt" (in the training data
    of a sensor model)."""


@dataclass(frozen=True, eq=False, slots=True)
class Handle:
    """A point of the body that may be dragged."""

    name: str
    position_m: FloatArray
    """At rest, robot frame, shape (3,)."""


@dataclass(frozen=True, slots=True)
class FieldKind:
    """A quantity that colours the body."""

    name: str
    unit: str
    largest: float
    """That has the full colour."""


@dataclass(frozen=True, eq=False, slots=True)
class Twin:
    """The constant description of a streamed robot."""

    name: str
    glb: bytes
    """Its skinned mesh; its bones are those of the poses."""
    bone_names: tuple[str, ...]
    T_robot_bone: FloatArray
    """Bones at rest [m], shape (B, 4, 4)."""
    inputs: tuple[Input, ...] = ()
    handles: tuple[Handle, ...] = ()
    commands: bool = False
    """Whether commands may be published once a viewer arms them."""
    landmarks: Landmarks = field(default_factory=Landmarks)
    """Points shared with the real robot."""
    duration_s: float = float("nan")
    """Of a run that is played over and over; nan: none is."""
    field: FieldKind | None = None
    """Content of `TwinFrame.field`."""
    error_m: float = float("nan")
    """Root mean square marker error of a learnt model in its test [m]; nan: unknown."""
    frame: str = "robot"
    """Of reference of all that is sent, one of `FRAMES`; "markers": where these were never brought into the robot's frame."""


@dataclass(frozen=True, eq=False, slots=True)
class Contact:
    """One contact as it is sent; nan where something is not known."""

    contact: int
    point_m: FloatArray
    """shape (3,)."""
    force_n: FloatArray
    """On the body, shape (3,)."""
    std_n: float = float("nan")
    force_std_n: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    """Of each component, shape (3,)."""
    point_std_m: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    """shape (3,)."""
    radius_m: float = float("nan")
    source: str = ""
    track: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class TwinFrame:
    """The messages of one moment."""

    time_s: float
    bones: npt.NDArray[np.float32]
    """x y z [m] and the quaternion x y z w of each bone, shape (B, 7)."""
    contacts: tuple[Contact, ...] | None = ()
    """None: no estimator runs."""
    inputs: tuple[float, ...] = ()
    """One value for each of the twin's inputs."""
    residual_m: float = float("nan")
    status: str = ""
    frame: int = -1
    """Number in the recording; -1: none."""
    run_s: float = float("nan")
    """From the beginning of a run that is played over and over."""
    interval_m: Mapping[str, float] = field(default_factory=dict)
    """Marker of a learnt model → radius of the 95 % interval of its position [m]."""
    cloud: npt.NDArray[np.float32] | None = None
    """Measured points and their distance from the surface [m], shape (n, 4)."""
    field: npt.NDArray[np.uint8] | None = None
    """Of the twin's field, share of the largest value at each vertex of the mesh, 0 … 255, shape (v,)."""
    read_at: float = float("nan")
    """When that was read which its bones show [s, monotonic clock]; -inf: never; nan: just now."""


def topic(robot: str, kind: str) -> str:
    """Return `femsense/<robot>/<kind>`; characters with a meaning in topics become "_"."""
    return f"{PREFIX}/{re.sub(r'[^A-Za-z0-9._-]', '_', robot) or '_'}/{kind}"


def split_topic(text: str) -> tuple[str, str] | None:
    """Return (robot, kind) of a topic of ours, else None."""
    parts = text.split("/")
    return (parts[1], parts[2]) if len(parts) == 3 and parts[0] == PREFIX and parts[1] and parts[2] else None


# Poses and clouds


def bone_rows(T_robot_bone: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return x y z qx qy qz qw of poses, shape (…, B, 7), of matrices, shape (…, B, 4, 4)."""
    from scipy.spatial.transform import Rotation

    T = np.asarray(T_robot_bone, dtype=np.float64)
    flat = T.reshape(-1, 4, 4)
    rows = np.concatenate([flat[:, :3, 3], Rotation.from_matrix(flat[:, :3, :3]).as_quat()], axis=1)
    return rows.reshape(*T.shape[:-2], 7).astype(np.float32)


def pose_bytes(seq: int, time_s: float, bones: npt.NDArray[np.float32]) -> bytes:
    """Return a pose message of bones, shape (B, 7)."""
    head = POSE_HEAD.pack(POSE_MAGIC, seq & 0xFFFFFFFF, time_s, len(bones), 0)
    return head + np.ascontiguousarray(bones, dtype="<f4").tobytes()


def cloud_bytes(seq: int, time_s: float, points: npt.ArrayLike) -> bytes:
    """Return a message of measured points and residuals [m], shape (n, 4)."""
    rows = np.ascontiguousarray(points, dtype="<f4").reshape(-1, 4)[:MOST_POINTS]
    return CLOUD_HEAD.pack(CLOUD_MAGIC, seq & 0xFFFFFFFF, time_s, len(rows)) + rows.tobytes()


def field_bytes(seq: int, time_s: float, largest: float, shares: npt.NDArray[np.uint8]) -> bytes:
    """Return a message of a field: shares of the largest value, 0 … 255, shape (v,)."""
    head = CLOUD_HEAD.pack(FIELD_MAGIC, seq & 0xFFFFFFFF, time_s, len(shares))
    return head + struct.pack("<f", largest) + shares.tobytes()


# Documents


def header(seq: int, time_s: float, frame_id: str) -> dict[str, Any]:
    """Return a header as ROS 1 has it, and Unity's messages after it."""
    secs, nsecs = divmod(round(1e9 * time_s), 10**9)
    return {"seq": seq, "stamp": {"secs": secs, "nsecs": nsecs}, "frame_id": frame_id}


def document_bytes(seq: int, time_s: float, frame_id: str = "robot", **told: Any) -> bytes:
    """Return a JSON message with its header (sequence number, time [s]) and its values. Numbers that are not finite are left out."""
    return _json({"header": header(seq, time_s, frame_id), **told})


def model_bytes(twin: Twin, glb_url: str) -> bytes:
    """Return the retained description of a twin."""
    import hashlib

    known = twin.landmarks
    document = {
        "schema": SCHEMA,
        "name": twin.name,
        "glb": glb_url,
        "glb_sha256": hashlib.sha256(twin.glb).hexdigest(),
        "frame": FRAMES[twin.frame],
        "length_unit": "m",
        "force_unit": "N",
        "pose": "FSP1",
        "bones": [{"name": name, **_pose_table(row)} for name, row in zip(twin.bone_names, bone_rows(twin.T_robot_bone))],
        "inputs": twin.inputs,
        "handles": twin.handles,
        "commands": twin.commands,
        "markers": known.markers,
        "cameras": known.cameras,
        "duration_s": twin.duration_s,
        "error_m": twin.error_m,
        "field": None if twin.field is None else {"name": twin.field.name, "unit": twin.field.unit},
    }
    return _json(document)


def force_bytes(seq: int, frame: TwinFrame, frame_id: str = "robot") -> bytes:
    """Return contacts and forces of a moment, in the frame of reference `frame_id`, with standard deviations, and intervals of markers."""
    return document_bytes(
        seq,
        frame.time_s,
        frame_id,
        frame=frame.frame,
        status=frame.status,
        residual_m=frame.residual_m,
        run_s=frame.run_s,
        contacts=None if frame.contacts is None else [_contact_table(one) for one in frame.contacts],
        markers=[{"name": name, "interval_m": radius} for name, radius in frame.interval_m.items()] or None,
    )


def inputs_bytes(seq: int, time_s: float, inputs: Sequence[Input], values: Sequence[float], frame_id: str = "robot") -> bytes:
    """Return the inputs of the robot at a moment."""
    rows = [{"name": i.name, "unit": i.unit, "value": float(v)} for i, v in zip(inputs, values)]
    return document_bytes(seq, time_s, frame_id, inputs=rows)


def measured_bytes(seq: int, time_s: float, markers: Mapping[str, npt.ArrayLike], detail: str = "") -> bytes:
    """Return where markers of a robot were measured, name → place [m], robot frame, shape (3,); `detail`: why they were not."""
    rows = [{"name": name, "position_m": np.asarray(place)} for name, place in markers.items()]
    return document_bytes(seq, time_s, markers=rows, detail=detail or None)


def pose_json_bytes(seq: int, time_s: float, bones: npt.NDArray[np.float32]) -> bytes:
    """Return the pose for Unity's JsonUtility, in Unity's own left-handed frame.

    x changes its sign, as glTF importers for Unity do it; so do y and z of the quaternion.
    These are local poses of the bones under the node `robot_frame` of the GLB file,
    or under any transform that is turned by −90° about x.
    """
    return document_bytes(seq, time_s, "unity", poses=[_pose_table(row) for row in in_unity(bones)])


def in_unity(bones: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return rows x y z qx qy qz qw, shape (…, 7), mirrored at the plane x = 0: from right-handed to left-handed."""
    return bones * np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0], dtype=np.float32)


def status_bytes(state: str, detail: str = "", since_s: float = float("nan")) -> bytes:
    """Return a status: "live", "stale" (no new poses), "ended" (by the sender) or "lost" (by the broker's last will).

    `since_s`: time of the data of the last pose [s since 1970]; left out if there was none.
    """
    return _json({"state": state, "detail": detail, "since_s": since_s})


def read_document(payload: bytes, *, most: int = 1 << 20) -> dict[str, Any] | None:
    """Return a JSON object, or None for anything else: too long, not UTF-8, not JSON, not an object."""
    if len(payload) > most:
        return None
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _pose_table(row: npt.NDArray[np.float32]) -> dict[str, Any]:
    x, y, z, qx, qy, qz, qw = (round(float(v), 9) for v in row)
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def _contact_table(contact: Contact) -> dict[str, Any]:
    return {**_plain(contact), "size_n": float(np.linalg.norm(contact.force_n))}


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: fields of dataclasses, and x, y, z of vectors, without any that is None or not finite."""
    if is_dataclass(value):
        value = {one.name: getattr(value, one.name) for one in fields(value)}
    if isinstance(value, np.ndarray):
        return dict(zip("xyz", value.tolist())) if np.isfinite(value).all() else None
    if isinstance(value, Mapping):
        return {key: plain for key, own in value.items() if (plain := _plain(own)) is not None}
    if isinstance(value, list | tuple):
        return [_plain(own) for own in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(_plain(value), allow_nan=False, separators=(",", ":")).encode()
