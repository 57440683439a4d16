"""The topics of a bag that make a recording: their contents, the user's choice, and choices still open."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import make_pose
from femsense.core.text import did_you_mean
from femsense.io.importers.images.intrinsics import check_lens
from femsense.io.importers.images.pictures import FINE_UNIT
from femsense.io.importers.options import Options
from femsense.io.importers.ros.bag import Bag, Topic
from femsense.io.importers.ros.messages import DEPTH, LAYOUTS, MODELS, lens_of, pose_matrix, sdk_values, stamp_of
from femsense.model.camera import Camera

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CLOUD = "PointCloud2"
MARKERS = ("PoseArray", "MarkerArray", "Markers", "RigidBodies", "PoseStamped", "PointStamped")
INPUTS = ("JointState", "Float64MultiArray", "Float32MultiArray", "FluidPressure")
TRANSPORTS = ("/compressedDepth", "/compressed", "/theora", "/ffmpeg")
INFRARED = re.compile(r"(^|[/_])(ir|infra\d?|infrared\d?)([/_]|$)")
"""Names of topics whose images of 16 bits are no depth."""
RECTIFIED = re.compile(r"(^|[/_])rect(_[^/]*)?$")
"""Names of topics whose images have no distortion any more, such as image_rect and image_rect_raw (image_proc)."""


class Kind(StrEnum):
    """The content of a topic."""

    DEPTH = "depth"
    CLOUD = "cloud"
    COLOR = "color"
    GREY = "grey"
    MARKERS = "markers"
    INPUTS = "inputs"
    LOADS = "loads"
    OTHER = "other"


@dataclass(frozen=True, eq=False, slots=True)
class Stream:
    """A topic and its content."""

    topic: Topic
    kind: Kind
    frame: str = ""
    """Its coordinate frame."""
    encoding: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Choice:
    """The streams that make a recording."""

    primary: Stream
    """Its messages are the frames."""
    markers: tuple[Stream, ...]
    inputs: tuple[Stream, ...]
    loads: tuple[Stream, ...]
    color: Stream | None = None
    lens: Camera | None = None
    """Of the depth images, with their unit."""
    color_lens: Camera | None = None
    T_color_depth: FloatArray | None = None
    """Shape (4, 4), translation [m]; None where it is not known."""
    notes: tuple[str, ...] = ()


def streams_of(bag: Bag) -> list[Stream]:
    """Return the content of each topic; images are identified by their first message."""
    return [_stream(bag, topic) for topic in bag.topics if topic.count]


def choose(bag: Bag, streams: Sequence[Stream], options: Options) -> Choice:
    """Return the streams to take.

    Raises:
        InputError: nothing to take, a topic that is not there, or several that could be meant: their names are listed.
    """
    _check_topics(streams, options)
    wanted = [s for s in streams if not options.topics or s.topic.name in options.topics]
    of = {kind: [s for s in wanted if s.kind is kind] for kind in Kind}
    for kind in (Kind.INPUTS, Kind.LOADS, Kind.COLOR, Kind.MARKERS):
        of[kind] = of[kind] or [s for s in streams if s.kind is kind]
    depth, cloud = _one(bag, of[Kind.DEPTH], "depth images"), None
    if depth is None:
        cloud = _one(bag, of[Kind.CLOUD], "clouds")
    primary = depth or cloud or next(iter(of[Kind.MARKERS]), None) or next(iter(of[Kind.INPUTS]), None)
    if primary is None:
        found = ", ".join(f"{s.topic.name} ({s.topic.type})" for s in streams[:12]) or "no messages"
        lost = [s.topic.name for s in streams if s.kind in (Kind.GREY, Kind.COLOR) and "depth" in s.topic.name]
        raise InputError(
            "nothing that can be taken",
            where=bag.path,
            found=found,
            expected="depth images, PointCloud2, markers or inputs",
            hint=f"{lost[0]} has 8 bits: the depth is not recoverable; record 16UC1 or compressedDepth" if lost else None,
        )
    choice = Choice(primary, tuple(of[Kind.MARKERS]), tuple(of[Kind.INPUTS]), tuple(of[Kind.LOADS]))
    if depth is None:
        return choice
    lens = _lens(bag, depth)
    if lens is None:
        raise InputError(
            "depth images without a lens",
            where=f"{bag.path}, topic {depth.topic.name}",
            found="no CameraInfo",
            expected="its CameraInfo topic",
        )
    choice = replace(choice, lens=replace(lens, depth_unit=_depth_unit(bag, depth, options)))
    others = [s.topic.name for s in of[Kind.CLOUD]]
    notes = (f"clouds that are there too, and not taken: {', '.join(others)}",) if others else ()
    return _with_color(bag, replace(choice, notes=notes), of[Kind.COLOR])


def cameras_of(streams: Sequence[Stream], options: Options) -> list[str]:
    """Return the topics of pictures that a person named, where those are several cameras; else none."""
    for kind in (Kind.DEPTH, Kind.CLOUD):
        named = [s.topic.name for s in streams if s.kind is kind and s.topic.name in options.topics]
        if named:
            return named if len({_base(name) for name in named}) > 1 else []
    return []


def transforms_of(bag: Bag) -> dict[str, tuple[str, FloatArray]]:
    """Return the static transforms: child frame → (parent frame, T_parent_child)."""
    found: dict[str, tuple[str, FloatArray]] = {}
    for message in bag.messages([t.name for t in bag.topics if t.name == "/tf_static"]):
        for item in bag.decode(message).transforms:
            found[item.child_frame_id.lstrip("/")] = (
                item.header.frame_id.lstrip("/"),
                pose_matrix(item.transform.translation, item.transform.rotation),
            )
    return found


def transform_between(tree: dict[str, tuple[str, FloatArray]], target: str, source: str) -> FloatArray | None:
    """Return T_target_source, shape (4, 4); None where the tree does not join them."""
    up_source, up_target = _to_root(tree, source.lstrip("/")), _to_root(tree, target.lstrip("/"))
    common = next((frame for frame in up_source if frame in up_target), None)
    return None if common is None else np.linalg.inv(up_target[common]) @ up_source[common]


def robot_pose(bag: Bag, stream: Stream, base: str | None) -> FloatArray | None:
    """Return T_robot_camera of a stream where `base` is the robot's frame, shape (4, 4); None where no base is named.

    Raises:
        InputError: the static transforms do not join the two.
    """
    if base is None:
        return None
    tree = transforms_of(bag)
    T = transform_between(tree, base, stream.frame)
    if T is None:
        names = sorted({*tree, *(parent for parent, _ in tree.values())})
        raise InputError(
            f"no static transform joins the robot's frame and {stream.frame!r}, the frame of {stream.topic.name}",
            where=f"--base {base}",
            found=", ".join(names) or "no tf_static",
            expected="a frame of tf_static",
            hint=did_you_mean(base, names),
        )
    return T


def _to_root(tree: dict[str, tuple[str, FloatArray]], frame: str) -> dict[str, FloatArray]:
    """Return T_ancestor_frame of a frame and all its ancestors."""
    found = {frame: np.eye(4)}
    at = frame
    while at in tree and tree[at][0] not in found:
        parent, T = tree[at]
        found[parent] = T @ found[at]
        at = parent
    return found


def _stream(bag: Bag, topic: Topic) -> Stream:
    short = topic.type.split("/")[-1]
    if topic.type in IMAGES:
        return _image_stream(bag, topic)
    if short in INPUTS:
        return Stream(topic, Kind.INPUTS)
    places = {CLOUD: Kind.CLOUD, "WrenchStamped": Kind.LOADS, **dict.fromkeys(MARKERS, Kind.MARKERS)}
    return Stream(topic, places[short], _frame(bag, topic)) if short in places else Stream(topic, Kind.OTHER)


def _image_stream(bag: Bag, topic: Topic) -> Stream:
    message = _first_whole(bag, topic)
    if message is None:
        return Stream(topic, Kind.OTHER)
    frame = stamp_of(message)[1]
    encoding = getattr(message, "encoding", None) or message.format
    if encoding.partition(";")[0].strip() in DEPTH or "compressedDepth" in encoding:
        infrared = encoding != "32FC1" and INFRARED.search(topic.name) is not None
        return Stream(topic, Kind.GREY if infrared else Kind.DEPTH, frame, encoding)
    grey = encoding in ("mono8", "8UC1") or encoding.startswith("mono8")
    return Stream(topic, Kind.GREY if grey else Kind.COLOR, frame, encoding)


def _frame(bag: Bag, topic: Topic) -> str:
    message = _first_whole(bag, topic)
    return "" if message is None else stamp_of(message)[1]


def _first_whole(bag: Bag, topic: Topic) -> Any:
    """Return the first message of a topic; None where it has none, or a broken one."""
    try:
        return bag.first([topic.name])
    except InputError:
        return None


def _check_topics(streams: Sequence[Stream], options: Options) -> None:
    names = [s.topic.name for s in streams]
    for name in options.topics:
        if name not in names:
            raise InputError(
                "no such topic", where=f"--topic {name}", found=name, expected=", ".join(names), hint=did_you_mean(name, names)
            )


def _one(bag: Bag, streams: Sequence[Stream], what: str) -> Stream | None:
    """Return the only stream of a kind; the same pictures in another transport count once, uncompressed first."""
    bases: dict[str, Stream] = {}
    for stream in sorted(streams, key=lambda s: s.topic.type != IMAGES[0]):
        bases.setdefault(_base(stream.topic.name), stream)
    if len(bases) > 1:
        raise InputError(
            f"several topics of {what}: which one?",
            where=bag.path,
            found="; ".join(f"{s.topic.name} ({s.topic.count} messages, frame {s.frame or '–'})" for s in bases.values()),
            expected=f"--topic {next(iter(bases.values())).topic.name}, or a --topic for each: then each is a camera",
        )
    return next(iter(bases.values()), None)


def _base(name: str) -> str:
    for ending in TRANSPORTS:
        name = name.removesuffix(ending)
    return name


# What belongs to a stream


def _shared(a: str, b: str) -> int:
    """Return how many leading parts two names share."""
    pairs = zip(a.split("/"), b.split("/"))
    return next((i for i, (x, y) in enumerate(pairs) if x != y), min(a.count("/"), b.count("/")) + 1)


def _nearest(name: str, topics: Sequence[Topic]) -> Topic | None:
    """Return the topic that shares most of its name, at least the parent's parent."""
    best = max(topics, key=lambda t: _shared(name, t.name), default=None)
    return best if best is not None and (_shared(name, best.name) >= 2 or len(topics) == 1) else None


def _lens(bag: Bag, stream: Stream) -> Camera | None:
    infos = [t for t in bag.topics if t.type.endswith("/CameraInfo") and t.count]
    topic = _nearest(stream.topic.name, infos)
    info = None if topic is None else bag.first([topic.name])
    if topic is None or info is None:
        return None
    frame, folder = stamp_of(info)[1], _base(stream.topic.name).rpartition("/")[0]
    if frame and stream.frame and frame != stream.frame and not topic.name.startswith((f"{folder}/", "/device_")):
        return None  # another camera's
    lens = lens_of(info, f"{bag.path}, topic {topic.name}", rectified=RECTIFIED.search(_base(stream.topic.name)) is not None)
    check_lens(lens, f"{bag.path}, topic {topic.name}")
    model = _sdk_model(bag, stream.topic.name)
    return lens if model is None or not np.any(lens.distortion != 0.0) else replace(lens, distortion_model=model)


def _sdk_model(bag: Bag, name: str) -> str | None:
    """Return the distortion model from the text metadata of a file of the RealSense SDK (from 2.58); its CameraInfo always has plumb_bob."""
    parts = sdk_values(bag.first([t.name for t in bag.topics if t.name == f"{name.split('/image/')[0]}/camera_info"]))
    return MODELS.get(parts["model"].strip().lower()) if "model" in parts else None


def _depth_unit(bag: Bag, stream: Stream, options: Options) -> float:
    """Return metres per unit: FINE_UNIT for floating point, else the user's option, else that of a RealSense sensor, else the millimetre
    of REP 118."""
    if stream.encoding.startswith("32FC1"):
        return FINE_UNIT
    if options.depth_unit is not None:
        return options.depth_unit
    sensor, ends = "/".join(stream.topic.name.split("/")[:3]), ("option/Depth_Units/value", "option/Depth Units/value")
    option = bag.first([t.name for t in bag.topics if t.name.startswith(sensor) and t.name.endswith(ends)])
    return 0.001 if option is None else float(option.data)


def _with_color(bag: Bag, choice: Choice, streams: Sequence[Stream]) -> Choice:
    depth = choice.primary
    same = [s for s in streams if s.frame == depth.frame] or [s for s in streams if _shared(s.topic.name, depth.topic.name) > 1]
    near = max((_shared(s.topic.name, depth.topic.name) for s in same or streams), default=0)
    color = _one(bag, [s for s in same or streams if _shared(s.topic.name, depth.topic.name) == near], "colour images")
    if color is None:
        return choice
    if color.topic.type == IMAGES[0] and color.encoding not in LAYOUTS:
        note = f"the colours of {color.topic.name} are left out: their encoding {color.encoding!r} is not read"
        return replace(choice, notes=(*choice.notes, note))
    lens = _lens(bag, color)
    T = _extrinsics(bag, depth, color)
    if lens is None or T is None:
        lacking = "its CameraInfo" if lens is None else "its pose relative to the depth camera (TF, extrinsics)"
        return replace(choice, notes=(*choice.notes, f"the colours of {color.topic.name} are left out: the bag lacks {lacking}"))
    return replace(choice, color=color, color_lens=lens, T_color_depth=T)


def _extrinsics(bag: Bag, depth: Stream, color: Stream) -> FloatArray | None:
    """Return T_color_depth from one frame, static TF, the SDK's transforms of streams, or the driver's topic of extrinsics."""
    sdk = {s: _sdk_transform(bag, s.topic.name) for s in (depth, color)}
    if sdk[depth] is not None and sdk[color] is not None:
        return np.asarray(sdk[color] @ np.linalg.inv(sdk[depth]))  # type: ignore[arg-type,operator]
    if depth.frame and depth.frame == color.frame:
        return np.eye(4)
    if "aligned_depth_to_color" in depth.topic.name or "depth_registered" in depth.topic.name:
        return np.eye(4)
    joined = transform_between(transforms_of(bag), color.frame, depth.frame)
    return joined if joined is not None else _driver_extrinsics(bag)


def _sdk_transform(bag: Bag, name: str) -> FloatArray | None:
    """Return T_stream_reference as the RealSense SDK stores it: a Transform (.bag),
    or text with the rotation by columns (.db3)."""
    stream = name.split("/image/")[0]
    message = bag.first([t.name for t in bag.topics if t.name.startswith(f"{stream}/tf/")])
    if message is None:
        return None
    if not hasattr(message, "data"):
        return pose_matrix(message.translation, message.rotation)
    parts = sdk_values(message)
    return _pose_of_columns(parts["rotation"].split(","), parts["translation"].split(","))


def _driver_extrinsics(bag: Bag) -> FloatArray | None:
    """Return T_color_depth of realsense2_camera_msgs/Extrinsics: nine numbers by columns, then a translation [m]."""
    message = bag.first([t.name for t in bag.topics if t.name.endswith("extrinsics/depth_to_color")])
    return None if message is None else _pose_of_columns(message.rotation, message.translation)


def _pose_of_columns(rotation: Sequence[Any], translation: Sequence[Any]) -> FloatArray:
    """Return the matrix (4, 4) of nine numbers by columns and a translation."""
    return make_pose(np.asarray(rotation, dtype=np.float64).reshape(3, 3).T, np.asarray(translation, dtype=np.float64))
