"""ROS bags as frames: pictures or clouds or markers, with the inputs, loads and markers of their moments."""

from __future__ import annotations

import warnings
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import one_line
from femsense.io.importers.frames import DepthImage, Format, Frame, Images, Source, check_reach, is_kept_as_image, upright
from femsense.io.importers.images.intrinsics import lens_line
from femsense.io.importers.images.lens import depth_points, pixel_rays, registered_color
from femsense.io.importers.images.pictures import depth_of_metres
from femsense.io.importers.options import Clock, Options
from femsense.io.importers.ros.bag import BEGINNINGS, ENDINGS, Bag, Message, open_bag
from femsense.io.importers.ros.messages import cloud_of, compressed_image, markers_of, place, raw_image, red_first
from femsense.io.importers.ros.plan import (
    LAG_S,
    Plan,
    chosen_streams,
    clock_of,
    device_time,
    is_sdk,
    named_values,
    plan_of,
    time_of,
)
from femsense.io.importers.ros.topics import Kind, Stream, cameras_of, choose, robot_pose, streams_of
from femsense.io.importers.several import camera_names, joined
from femsense.io.importers.tables.input_samples import NEAR_S, Samples, samples_of
from femsense.pointcloud.cloud import PointCloud

SDK = "realsense"
"""Format of a bag that the RealSense SDK wrote."""


def open_ros(path: Path, options: Options) -> Source:
    """Return a bag as a source; of several cameras where several topics of pictures are named.

    Raises:
        InputError: not readable, nothing in it that can be taken, or several topics that could be meant.
    """
    with open_bag(path) as bag:
        streams = streams_of(bag)
        cameras = cameras_of(streams, options)
        if not cameras:
            return _source(bag, streams, options)
        sources = _sources(bag, streams, cameras, options)
        if len({source.found["clock"] for source in sources.values()}) > 1:
            sources = _sources(bag, streams, cameras, replace(options, clock=Clock.RECORD))
    return joined(sources, path, options)


def _sources(bag: Bag, streams: Sequence[Stream], cameras: Sequence[str], options: Options) -> dict[str, Source]:
    """Return one source per camera; a topic of markers belongs to the first camera connected to it, so that markers are not counted
    twice."""
    others = tuple(topic for topic in options.topics if topic not in cameras)
    sources: dict[str, Source] = {}
    taken: set[str] = set()
    for name, topic in zip(camera_names(list(cameras)), cameras):
        left = [s for s in streams if s.topic.name not in taken]
        sources[name] = _source(bag, left, replace(options, topics=(topic, *(t for t in others if t not in taken))))
        taken |= set(sources[name].found["marker_topics"] or ())
    return sources


def _source(bag: Bag, streams: Sequence[Stream], options: Options) -> Source:
    """Return the chosen topics of a bag as the source of one camera."""
    choice = choose(bag, streams, options)
    clock = clock_of(bag, choice, options)
    plan = plan_of(bag, choice, options, clock)
    choice = plan.choice
    found = {
        "clock": clock,
        "topics": [{"topic": s.topic.name, "messages": s.topic.count} for s in chosen_streams(choice)],
        "not_taken": [s.topic.name for s in streams if s.kind is not Kind.OTHER and s not in chosen_streams(choice)] or None,
        "marker_topics": [s.topic.name for s in choice.markers] or None,
        "depth_unit_m": choice.lens and choice.lens.depth_unit,
        "lens": None if choice.lens is None else lens_line(choice.lens),
        "camera_frame": choice.primary.frame or None,
    }
    return Source(
        bag.path,
        partial(_frames, bag.path, plan),
        found=found,
        camera=choice.lens,
        actuation=plan.actuation,
        count=choice.primary.topic.count,
        notes=plan.notes,
        T_robot_camera=robot_pose(bag, choice.primary, options.base),
        names=plan.names,
        format=SDK if is_sdk(choice.primary.topic.name) else "",
    )


def list_ros(path: Path) -> dict[str, Any]:
    """Return all topics of a bag with their content, types, number of messages and coordinate frames."""
    with open_bag(path) as bag:
        rows = [
            {"topic": s.topic.name, "holds": s.kind, "type": s.topic.type, "messages": s.topic.count, "frame": s.frame or None}
            for s in streams_of(bag)
            if s.kind is not Kind.OTHER
        ]
        return {"topics": rows, "other_topics": sum(t.count > 0 for t in bag.topics) - len(rows)}


def topics_of(path: Path) -> set[str]:
    """Return the names of the topics that can be taken."""
    return {row["topic"] for row in list_ros(path)["topics"]}


@dataclass(eq=False, slots=True)
class _Track:
    """Recent messages of a secondary stream."""

    times: deque[float] = field(default_factory=deque)
    values: deque[Any] = field(default_factory=deque)
    stamps: dict[float, float] = field(default_factory=dict)
    """Recording time → device time [s], if the latter is in another topic."""

    def stamp(self, record: float, device: float | None) -> None:
        if device is not None:
            self.stamps[record] = device

    def add(self, time: float, value: Any) -> None:
        self.times.append(time)
        self.values.append(value)

    def forget(self, before: float) -> None:
        """Drop all entries older than the last one before a given time."""
        while len(self.times) > 1 and self.times[1] <= before:
            self.times.popleft()
            self.values.popleft()
        for record in [r for r in self.stamps if r < before]:
            del self.stamps[record]

    def nearest(self, time: float, device: float | None = None) -> Any:
        """Return the value nearest in time (of the device, where that is given), at most NEAR_S away;
        None where there is none."""
        if not self.times:
            return None
        apart = [abs(t - time) if device is None else abs(self.stamps.get(t, np.inf) - device) for t in self.times]
        k = int(np.argmin(apart))
        return self.values[k] if apart[k] <= NEAR_S else None


def _frames(path: Path, plan: Plan) -> Iterator[Frame]:
    """Read the bag once, in the order of writing; hold back messages younger than LAG_S."""
    choice, rays = plan.choice, None
    if choice.lens is not None:
        rays = pixel_rays(choice.lens)
    primary = choice.primary.topic.name
    sampled = {s.topic.name for s in (*choice.inputs, *choice.loads) if plan.columns.get(s.topic.name, True)}
    tracks: dict[str, _Track] = {
        s.topic.name: _Track()
        for s in chosen_streams(choice)
        if (plan.metadata or s is not choice.primary) and s.topic.name not in sampled
    }
    waiting: deque[tuple[float, Message, Any]] = deque()
    with open_bag(path) as bag:
        samples = {topic: _samples(bag, plan, topic) for topic in sorted(sampled)}
        for message in bag.messages([primary, *tracks, *plan.metadata]):
            try:
                _take(bag, plan, message, primary, tracks, waiting)
            except InputError as problem:
                warnings.warn(one_line(problem), stacklevel=2)
                continue
            while waiting and message.record - waiting[0][1].record > LAG_S:
                yield _frame(bag, plan, *waiting.popleft(), tracks, samples, rays)
        while waiting:
            yield _frame(bag, plan, *waiting.popleft(), tracks, samples, rays)


def _samples(bag: Bag, plan: Plan, topic: str) -> Samples:
    """Return all values of a topic of inputs or loads; a warning counts broken messages."""
    rows, broken = array("d"), list[str]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the truncation of a bag is reported when the frames are read
        for message in bag.messages([topic]):
            try:
                decoded = bag.decode(message)
            except InputError as problem:
                broken.append(one_line(problem))
                continue
            rows.extend([time_of(bag, plan, message, decoded), *_values(plan, message, decoded)])
    if broken:
        warnings.warn(f"{len(broken)} messages of {topic} are left out: {broken[0]}", stacklevel=2)
    table = np.array(rows).reshape(-1, 1 + (3 if topic in plan.load_points else len(plan.columns[topic])))
    return samples_of(table[:, 0], table[:, 1:])


def _take(
    bag: Bag, plan: Plan, message: Message, primary: str, tracks: dict[str, _Track], waiting: deque[tuple[float, Message, Any]]
) -> None:
    lazy = plan.choice.lens is not None or plan.choice.primary.kind is Kind.CLOUD
    if message.topic in plan.metadata:
        tracks[plan.metadata[message.topic]].stamp(message.record, device_time(bag.decode(message)))
        return
    if message.topic == primary:
        decoded = None if lazy else bag.decode(message)
        waiting.append((time_of(bag, plan, message, decoded), message, decoded))
        return
    is_color = plan.choice.color is not None and message.topic == plan.choice.color.topic.name
    decoded = None if is_color else bag.decode(message)
    tracks[message.topic].add(time_of(bag, plan, message, decoded), message if is_color else decoded)


def _frame(
    bag: Bag,
    plan: Plan,
    time: float,
    message: Message,
    decoded: Any,
    tracks: dict[str, _Track],
    samples: dict[str, Samples],
    rays: FloatArray | None,
) -> Frame:
    choice = plan.choice
    for track in tracks.values():
        track.forget(time - 2 * LAG_S)
    device = tracks[message.topic].stamps.get(message.record) if plan.metadata else None
    color = None if choice.color is None else tracks[choice.color.topic.name].nearest(time, device)
    picture: Callable[[], Images | PointCloud] | None = None
    if choice.primary.kind is Kind.DEPTH:
        picture = partial(_images, bag, plan, message, color, rays)
    elif choice.primary.kind is Kind.CLOUD:
        picture = partial(_cloud, bag, plan, message)
    named, unnamed = _markers(plan, time, message, decoded, tracks)
    now = {topic: one.at(time)[0] for topic, one in samples.items()}
    pairs = ((one, v) for topic in plan.columns if topic in now for one, v in zip(plan.columns[topic].values(), now[topic]))
    inputs = {one.target.name: float(value) for one, value in pairs if np.isfinite(value)}
    loads = [(point, now[topic]) for topic, point in plan.load_points.items()]
    return Frame(time if device is None else device, picture, markers=named, unlabelled=unnamed, inputs=inputs, loads=loads)


def _images(bag: Bag, plan: Plan, message: Message, color: Message | None, rays: FloatArray | None) -> Images | PointCloud:
    choice = plan.choice
    where = f"{bag.path}, topic {message.topic}"
    image, encoding = _pixels(bag, message)
    depth = _in_units(plan, image, where) if encoding == "32FC1" else image.astype(np.uint16)
    depth[depth == 65535] = 0
    lens = choice.lens
    if lens is None or rays is None or depth.shape != (lens.height, lens.width):
        raise InputError(
            "the image has another size than its CameraInfo",
            where=where,
            found=depth.shape,
            expected=lens and (lens.height, lens.width),
        )
    pixels = None
    if color is not None and choice.color_lens is not None and choice.T_color_depth is not None:
        seen, kind = _pixels(bag, color)
        seen = red_first(seen, kind)
        T = choice.T_color_depth
        same = np.array_equal(T, np.eye(4)) and seen.shape[:2] == depth.shape
        pixels = seen if same else registered_color(depth, rays, lens.depth_unit, seen, choice.color_lens, T)
    if is_kept_as_image(lens):
        return Images(depth, pixels)
    points, mask = depth_points(depth, rays, lens.depth_unit)
    return PointCloud(points, None if pixels is None else pixels[mask] / 255.0)


def _in_units(plan: Plan, image: Any, where: str) -> DepthImage:
    """Return a depth image in units of FINE_UNIT from distances in floating point. Raises InputError: far beyond any camera."""
    if plan.scale is None:
        check_reach(image[::4, ::4][np.isfinite(image[::4, ::4]) & (image[::4, ::4] > 0)], where)
    return depth_of_metres(image if plan.scale is None else plan.scale * image.astype(np.float64))


def _pixels(bag: Bag, message: Message) -> tuple[Any, str]:
    where = f"{bag.path}, topic {message.topic}"
    decoded = bag.decode(message)
    return compressed_image(decoded, where) if message.type.endswith("CompressedImage") else raw_image(decoded, where)


def _cloud(bag: Bag, plan: Plan, message: Message) -> PointCloud:
    where = f"{bag.path}, topic {message.topic}"
    cloud = cloud_of(bag.decode(message), where)
    if plan.scale is not None:
        return PointCloud(plan.scale * cloud.points, cloud.colors)
    check_reach(np.linalg.norm(cloud.points[::16], axis=1), where)
    return cloud


def _markers(
    plan: Plan, time: float, message: Message, decoded: Any, tracks: dict[str, _Track]
) -> tuple[dict[str, Any], list[Any]]:
    named: dict[str, Any] = {}
    unnamed: list[Any] = []
    for stream in plan.choice.markers:
        name = stream.topic.name
        value = decoded if name == message.topic else tracks[name].nearest(time)
        T = plan.T_camera_markers[name]
        for label, point in [] if value is None else markers_of(value, stream.topic.type):
            xyz = upright(T[:3, :3] @ (np.asarray(point) * (plan.scale or 1.0)) + T[:3, 3], plan.up)[0]
            label = plan.marker_names.get(label or name, label)
            if label:
                named[label] = xyz
            else:
                unnamed.append(xyz)
    return named, unnamed


def _values(plan: Plan, message: Message, decoded: Any) -> FloatArray:
    """Return the inputs of a message in the order of its columns, or the force of a wrench [N]."""
    if message.type.endswith("WrenchStamped"):
        return np.array(place(decoded.wrench.force))
    columns = plan.columns[message.topic]
    given = named_values(decoded, message.type)
    scaled = ((one.target, given.get((name, one.field), np.nan)) for name, one in columns.items())
    return np.array([target.factor * value + target.offset for target, value in scaled])


def _is_bag(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(item.suffix in (".db3", ".mcap") for item in path.iterdir())
    return path.suffix.lower() in ENDINGS or head.startswith(tuple(begin for begin, _ in BEGINNINGS))


ROS = Format("ros", open_ros, _is_bag, ("--rate",), list_ros, ENDINGS, topics_of, whole_depths=True, transforms=True)
REALSENSE = replace(ROS, name=SDK, recognises=lambda path, head: False, unused=("--rate", "--up", "--unit"), endings=())
