"""A run as a stream: its bones, forces and inputs at its own times, over and over."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, diagonal, freeze
from femsense.core.errors import FemsenseError
from femsense.xr.glb_reader import AnimatedSkin, read_glb
from femsense.xr.landmarks import landmarks_of_run
from femsense.xr.run_contents import contacts_of_run, current_glb, run_folder, stress_of_run
from femsense.xr.stream.payloads import Contact, FieldKind, Input, Twin, TwinFrame

if TYPE_CHECKING:
    from femsense.model.recording import Recording

Cloud = npt.NDArray[np.float32]
CLOUD_POINTS = 3000
"""Of a measured cloud that are shown."""
CLOUD_REACH = 0.1
"""Points farther from the surface than this share of the body's size are its surroundings."""
PAUSE_S = 0.5
"""Between the end of a run and its next beginning."""


@dataclass(frozen=True, eq=False, slots=True)
class RunStream:
    """A run that can be streamed."""

    twin: Twin
    skin: AnimatedSkin
    frames: tuple[TwinFrame, ...]
    """One for each pose, without its cloud."""
    clouds: MeasuredClouds
    """Measured points and residuals of each pose, if the recording still exists."""

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return float(self.skin.time_s[-1])


def open_run(folder: str | Path) -> RunStream:
    """Read a run folder, and the clouds of its recording if these still exist; its mesh is created if it is missing.

    Arguments:
        folder: written by `femsense estimate`.

    Raises:
        InputError: no readable states, or a malformed table.
    """
    run = run_folder(folder)
    told = contacts_of_run(run)
    with tempfile.TemporaryDirectory(prefix="femsense-stream-") as scratch:
        glb = current_glb(run, Path(scratch)).read_bytes()
    skin = read_glb(glb)
    skeleton = skin.skin.skeleton
    stress = stress_of_run(run, glb)
    twin = Twin(
        name=str(told["name"]),
        glb=glb,
        bone_names=skeleton.names,
        T_robot_bone=skeleton.T_robot_bone,
        inputs=tuple(Input(**entry) for entry in told["inputs"]),
        landmarks=landmarks_of_run(run),
        duration_s=float(skin.time_s[-1]),
        field=FieldKind(**told["field"], largest=stress.largest),
    )
    frames = tuple(_frame(*pose) for pose in zip(told["frames"], skin.bones, stress.shares))
    return RunStream(twin, skin, frames, MeasuredClouds(_clouds_of(run, frames)))


def frames_of(stream: RunStream, *, rate_hz: float = 60.0, loop: bool = True) -> Iterator[TwinFrame]:
    """Yield frames at a rate; bones are interpolated between those of the run, all else is that of the nearest.

    Arguments:
        stream: result of `open_run`.
        rate_hz: frames a second.
        loop: begin again after a short pause, for ever.
    """
    times = stream.skin.time_s
    count = max(1, int(np.floor(stream.duration_s * rate_hz)) + 1)
    offset = 0.0
    while True:
        for k in range(count):
            t = min(k / rate_hz, stream.duration_s)
            yield _at(stream, t, offset + t, int(np.abs(times - t).argmin()))
        if not loop:
            return
        waiting = int(PAUSE_S * rate_hz)
        for k in range(waiting):
            yield _at(stream, stream.duration_s, offset + stream.duration_s + (k + 1) / rate_hz, len(times) - 1)
        offset += stream.duration_s + (waiting + 1) / rate_hz


def between(times: FloatArray, bones: npt.NDArray[np.float32], t: float) -> npt.NDArray[np.float32]:
    """Return bones (B, 7) at a time [s]: linear between two frames (F, B, 7), quaternions made unit again."""
    k = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1:
        return np.asarray(bones[0])
    share = np.float32(np.clip((t - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0))
    rows = (1 - share) * bones[k] + share * bones[k + 1]
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return np.asarray(rows)


def _at(stream: RunStream, t: float, sent_at: float, nearest: int) -> TwinFrame:
    """Return the frame of a time in the run [s], sent at a time of the stream [s]."""
    bones = between(stream.skin.time_s, stream.skin.bones, t)
    return replace(stream.frames[nearest], time_s=sent_at, run_s=t, bones=bones, cloud=stream.clouds.at(nearest))


def _frame(told: Mapping[str, Any], bones: npt.NDArray[np.float32], field: npt.NDArray[np.uint8]) -> TwinFrame:
    """Return a frame of `contacts_of_run` with the bones and the field of its pose."""
    return TwinFrame(
        time_s=told["time_s"],
        bones=bones,
        contacts=tuple(_contact(c) for c in told["contacts"] if c["point_m"] and c["force_vector_n"]),
        inputs=tuple(_or_nan(value) for value in told["inputs"] or ()),
        residual_m=_or_nan(told["rms_after_m"]),
        status=told["status"] or "",
        frame=-1 if told["frame"] is None else told["frame"],
        field=field,
    )


def _contact(told: Mapping[str, Any]) -> Contact:
    unknown = (np.nan, np.nan, np.nan)
    return Contact(
        contact=told["contact"],
        point_m=np.array(told["point_m"]),
        force_n=np.array(told["force_vector_n"]),
        std_n=_or_nan(told["std_n"]),
        force_std_n=np.array(told["force_std_n"] or unknown),
        point_std_m=np.array(told["point_std_m"] or unknown),
        radius_m=_or_nan(told["radius_m"]),
        source=told["source"],
        track=told["track"],
    )


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


# Clouds of the recording


class MeasuredClouds:
    """Measured points of each pose with their residuals, read in the background in the order of the poses, so that the stream does not
    wait for them (importing the distance library alone takes seconds)."""

    def __init__(self, clouds: Iterable[Cloud | None]) -> None:
        """clouds: of each pose, read while they are iterated; None where a pose has none."""
        self._found: list[Cloud | None] = []
        self._stop = Event()
        self._thread = Thread(target=self._read_all, args=(clouds,), daemon=True, name="femsense-clouds")
        self._thread.start()

    def at(self, k: int) -> Cloud | None:
        """Return points and residuals [m] of a pose, shape (n, 4); None if there are none, or not yet."""
        return self._found[k] if k < len(self._found) else None

    def wait(self) -> None:
        """Return when all are read."""
        self._thread.join()

    def close(self) -> None:
        """Read no more."""
        self._stop.set()
        self.wait()

    def _read_all(self, clouds: Iterable[Cloud | None]) -> None:
        for cloud in clouds:
            self._found.append(cloud)
            if self._stop.is_set():
                return


def _clouds_of(run: Path, frames: Iterable[TwinFrame]) -> Iterator[Cloud | None]:
    """Yield the cloud of each pose of a run; nothing if its recording no longer exists."""
    from femsense.calib.files import read_calibration
    from femsense.io.recording_folder import load_recording
    from femsense.sensing.run_files import read_states

    try:
        document = json.loads((run / "run.json").read_text(encoding="utf-8"))
        recording = load_recording(document["inputs"]["recording"]["path"])
        poses = read_calibration(run / "calibration.json").poses
        states = read_states(run / "states.npz")
    except (OSError, ValueError, KeyError, TypeError, FemsenseError):
        return
    numbers = {int(number): k for k, number in enumerate(recording.frame_numbers)}
    for frame, nodes in zip(frames if recording.has_clouds else (), states.nodes_m):
        number = numbers.get(frame.frame)
        points = None if number is None else _points(recording, number, poses)
        yield None if points is None else with_residuals(points, nodes, states.tets)


def _points(recording: Recording, number: int, poses: Sequence[FloatArray]) -> FloatArray | None:
    """Return the points of all cameras in one frame, robot frame [m], shape (n, 3), or None."""
    from femsense.io.clouds.frame_clouds import read_frame_cloud

    try:
        clouds = [read_frame_cloud(recording, number, view=v) for v in range(len(poses))]
    except FemsenseError:
        return None
    points = [cloud.points @ T[:3, :3].T + T[:3, 3] for cloud, T in zip(clouds, poses) if cloud is not None]
    return np.vstack(points) if points else None


def with_residuals(points: FloatArray, nodes: npt.ArrayLike, tets: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return the points near a body with their signed distance from its surface, shape (k, 4) [m], > 0 outside.

    Arguments:
        points: measured, robot frame [m], shape (n, 3); an even choice of them is kept.
        nodes: nodes of the body [m], shape (m, 3).
        tets: its tetrahedra, shape (t, 4) or (t, 10).
    """
    from femsense.fem.mesh import TetMesh, surface_triangles
    from femsense.pointcloud.rays import Surface

    mesh = TetMesh(np.asarray(nodes, dtype=np.float64), np.asarray(tets))
    size = diagonal(mesh.nodes)
    reach = CLOUD_REACH * size
    inside = ((points > mesh.nodes.min(axis=0) - reach) & (points < mesh.nodes.max(axis=0) + reach)).all(axis=1)
    some = points[inside]
    some = some[:: max(1, -(-len(some) // CLOUD_POINTS))]
    if not len(some):
        return np.zeros((0, 4), dtype=np.float32)
    _, distance, _, _ = Surface(mesh.nodes, surface_triangles(mesh)).closest(some)
    rows = np.column_stack([some, distance])[np.abs(distance) <= reach]
    return freeze(rows, np.float32)
