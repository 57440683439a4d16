"""Bags written by `rosbags` for tests: what a depth camera, motors and a motion-capture system would record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_000_000_000
STEP_NS = 33_333_333
WIDTH, HEIGHT = 64, 48
LENS = (50.0, 51.0, 31.5, 23.5)
"""fx, fy, cx, cy [px]."""


class BagWriter:
    """Writes messages of one kind of bag: "1" (.bag), "sqlite3" or "mcap" (folders of ROS 2)."""

    def __init__(self, path: Path, kind: str, *, chunk: int | None = None) -> None:
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "1" else Stores.ROS2_HUMBLE)
        plugins = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
        self.writer: Any = Writer1(path) if kind == "1" else Writer2(path, version=8, storage_plugin=plugins[kind])
        if chunk is not None and kind == "1":
            self.writer.chunk_threshold = chunk
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, stamp_ns: int, frame: str = "cam") -> Any:
        time = self.type("builtin_interfaces/msg/Time")(stamp_ns // 10**9, stamp_ns % 10**9)
        kind = self.type("std_msgs/msg/Header")
        return kind(seq=0, stamp=time, frame_id=frame) if self.kind == "1" else kind(stamp=time, frame_id=frame)

    def write(self, topic: str, record_ns: int, message: Any) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        pack = self.store.serialize_ros1 if self.kind == "1" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], record_ns, pack(message, name))

    # Messages

    def image(self, pixels: np.ndarray, encoding: str, stamp: int, frame: str = "cam", *, big: bool = False, pad: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")))
        data = rows.view(np.uint8).reshape(len(rows), -1)
        data = np.pad(data, ((0, 0), (0, pad)))
        kind = self.type("sensor_msgs/msg/Image")
        return kind(self.header(stamp, frame), *pixels.shape[:2], encoding, int(big), data.shape[1], data.ravel())

    def compressed(self, data: bytes, form: str, stamp: int, frame: str = "cam") -> Any:
        return self.type("sensor_msgs/msg/CompressedImage")(self.header(stamp, frame), form, np.frombuffer(data, dtype=np.uint8))

    def info(
        self,
        stamp: int,
        frame: str = "cam",
        *,
        lens: Any = LENS,
        size: Any = (WIDTH, HEIGHT),
        model: str = "plumb_bob",
        d: Any = (0.0,) * 5,
    ) -> Any:
        fx, fy, cx, cy = lens
        K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        R, P = np.eye(3).ravel(), np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        keys = "DKRP" if self.kind == "1" else "dkrp"
        arrays = dict(zip(keys, (np.array(d, dtype=float), K, R, P)))
        return self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(stamp, frame),
            height=size[1],
            width=size[0],
            distortion_model=model,
            **arrays,
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def cloud(self, points: np.ndarray, colors: np.ndarray | None, stamp: int, frame: str = "cam", *, big: bool = False) -> Any:
        field = self.type("sensor_msgs/msg/PointField")
        fields = [field(axis, 4 * i, 7, 1) for i, axis in enumerate("xyz")]
        columns = [points.astype(np.float32).view(np.uint32)]
        if colors is not None:
            fields.append(field("rgb", 12, 7, 1))
            packed = colors.astype(np.uint32) @ np.array([65536, 256, 1], dtype=np.uint32)
            columns.append(packed[:, None].astype(np.uint32))
        table = np.concatenate(columns, axis=1).astype(np.dtype(np.uint32).newbyteorder(">" if big else "<"))
        step = table.shape[1] * 4
        data = np.frombuffer(table.tobytes(), dtype=np.uint8)
        kind = self.type("sensor_msgs/msg/PointCloud2")
        return kind(self.header(stamp, frame), 1, len(points), fields, big, step, step * len(points), data, False)

    def joints(self, names: list[str], stamp: int, *, position: Any = (), effort: Any = ()) -> Any:
        kind = self.type("sensor_msgs/msg/JointState")
        numbers = [np.array(v, dtype=float) for v in (position, (), effort)]
        return kind(self.header(stamp, ""), names, *numbers)

    def array(self, values: Any) -> Any:
        layout = self.type("std_msgs/msg/MultiArrayLayout")([], 0)
        return self.type("std_msgs/msg/Float64MultiArray")(layout, np.array(values, dtype=float))

    def vector(self, xyz: Any, kind: str = "Vector3") -> Any:
        return self.type(f"geometry_msgs/msg/{kind}")(*(float(v) for v in xyz))

    def wrench(self, force: Any, stamp: int) -> Any:
        wrench = self.type("geometry_msgs/msg/Wrench")(self.vector(force), self.vector((0, 0, 0)))
        return self.type("geometry_msgs/msg/WrenchStamped")(self.header(stamp, "base"), wrench)

    def pose(self, xyz: Any) -> Any:
        turn = self.type("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
        return self.type("geometry_msgs/msg/Pose")(self.vector(xyz, "Point"), turn)

    def poses(self, places: Any, stamp: int, frame: str = "cam") -> Any:
        return self.type("geometry_msgs/msg/PoseArray")(self.header(stamp, frame), [self.pose(p) for p in places])

    def marker_array(self, places: dict[str, Any], stamp: int, frame: str = "cam") -> Any:
        kind, color = self.type("visualization_msgs/msg/Marker"), self.type("std_msgs/msg/ColorRGBA")(0.0, 0.0, 0.0, 1.0)
        life = self.type("builtin_interfaces/msg/Duration")(0, 0)
        common = {
            "type": 2, "action": 0, "scale": self.vector((0.01,) * 3), "color": color, "lifetime": life, "frame_locked": False, "points": [],
            "colors": [], "text": "", "mesh_resource": "", "mesh_use_embedded_materials": False,
        }  # fmt: skip
        if self.kind != "1":
            uv = self.type("sensor_msgs/msg/CompressedImage")(self.header(stamp, frame), "", np.zeros(0, dtype=np.uint8))
            common |= {
                "texture_resource": "",
                "texture": uv,
                "uv_coordinates": [],
                "mesh_file": self.type("visualization_msgs/msg/MeshFile")("", np.zeros(0, dtype=np.uint8)),
            }
        items = [kind(header=self.header(stamp, frame), ns=name, id=0, pose=self.pose(p), **common) for name, p in places.items()]
        return self.type("visualization_msgs/msg/MarkerArray")(items)

    def static_transform(self, parent: str, child: str, xyz: Any, quaternion: Any = (0.0, 0.0, 0.0, 1.0)) -> Any:
        turn = self.type("geometry_msgs/msg/Quaternion")(*(float(v) for v in quaternion))
        moved = self.type("geometry_msgs/msg/Transform")(self.vector(xyz), turn)
        stamped = self.type("geometry_msgs/msg/TransformStamped")(self.header(START_NS, parent), child, moved)
        return self.type("tf2_msgs/msg/TFMessage")([stamped])


def depth_of(number: int) -> np.ndarray:
    """Return a depth image in millimetres with holes, one pixel at 65535, another in each frame."""
    rng = np.random.default_rng(number)
    image = rng.integers(300, 900, size=(HEIGHT, WIDTH)).astype(np.uint16)
    image[rng.random(image.shape) < 0.1] = 0
    image[0, 0] = 65535
    return image


def color_of(number: int) -> np.ndarray:
    return np.random.default_rng(1000 + number).integers(0, 256, size=(HEIGHT, WIDTH, 3)).astype(np.uint8)


def write_camera(bag: BagWriter, frames: int, *, motors: bool = True, color: bool = True) -> None:
    """Write an aligned camera at 30 Hz, and motors (effort [N]) at 90 Hz whose effort is the time [s] since the start."""
    for k in range(frames):
        stamp = START_NS + k * STEP_NS
        bag.write("/camera/depth/image_raw", stamp + 5_000_000, bag.image(depth_of(k), "16UC1", stamp))
        bag.write("/camera/depth/camera_info", stamp + 5_000_000, bag.info(stamp))
        if color:
            bag.write("/camera/color/image_raw", stamp + 6_000_000, bag.image(color_of(k), "rgb8", stamp))
            bag.write("/camera/color/camera_info", stamp + 6_000_000, bag.info(stamp))
        for i in range(3 if motors else 0):
            at = stamp + i * STEP_NS // 3
            effort = 1e-9 * (at - START_NS)
            bag.write(
                "/joint_states",
                at + 1_000_000,
                bag.joints(["north", "south"], at, position=[0.0, 0.0], effort=[effort, 2 * effort + 1]),
            )
