"""A recording that grows frame by frame, in memory; its images are kept in a scratch folder until they are processed."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.io.recording_tables import GRAVITY_COLUMNS
from femsense.live.frames import Image, ImageKind, Marker, StampedFrame
from femsense.live.sources.source import SourceInfo
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import About, Drives, MarkerRows, Timeline, Views
from femsense.model.robot import Robot

MEMORY = Path("/dev/shm")
"""A file system in memory, because the disk may be slow."""
PREFIX = "femsense-live-"


def make_scratch() -> Path:
    """Return a new folder for images that wait for processing, in memory if the system supports it."""
    return Path(tempfile.mkdtemp(prefix=PREFIX, dir=MEMORY if MEMORY.is_dir() else None))


def image_file(image: Image, number: int, names: Sequence[str]) -> str:
    """Return the path of an image in a recording, relative to its folder."""
    view = names[image.view]
    return "/".join([image.kind, *([view] if view else []), f"{number:06d}{image.suffix}"])


def empty_recording(
    robot: Robot, info: SourceInfo, *, actuation: str, actuation_zero: str, folder: Path, gravity: bool
) -> Recording:
    """Return a recording without frames.

    Arguments:
        robot: defines cables and chambers.
        info: the camera.
        actuation, actuation_zero: as in recording.toml.
        folder: its name in messages.
        gravity: whether frames contain gravity.
    """
    cables, chambers, views = robot.body.cable_names, robot.body.chamber_names, len(info.camera_names)
    poses = info.T_robot_camera or (None,) * views
    return make_recording(
        Timeline((), (), free=(), gravity=np.zeros((0, 3)) if gravity else None),
        drives=Drives(cables, np.zeros((0, len(cables))), actuation, actuation_zero, chambers, np.zeros((0, len(chambers)))),
        markers=MarkerRows((), (), (), np.zeros((0, 3)), noise_m=info.marker_noise_m),
        views=Views(info.camera_names, info.cameras, poses, (), ()),
        about=About(folder.absolute()),
    )


class GrowingRecording:
    """A `Recording` to which frames are added as they are processed."""

    def __init__(self, empty: Recording, scratch: Path) -> None:
        """`empty`: of `empty_recording`; `scratch`: of `make_scratch`."""
        self.recording = empty
        self._scratch = scratch

    def add(self, frame: StampedFrame, columns: Sequence[str], values: FloatArray, *, contact_free: bool) -> int:
        """Add a frame with its inputs and return its index.

        Arguments:
            frame: the frame; its images are written to the scratch folder.
            columns: of the values, as in frames.csv.
            values: inputs [N], [m] or [Pa], and gravity [m/s²], shape (columns,).
            contact_free: whether it is declared contact-free.
        """
        r, k = self.recording, self.recording.frame_count
        table = dict(zip(columns, values.tolist()))
        names, index, view, xyz = _with_markers(r, frame.raw.markers)
        depths, colors = self._write(frame)
        assert r.free is not None
        self.recording = replace(
            r,
            frame_numbers=freeze(np.append(r.frame_numbers, frame.number), np.int64),
            time_s=freeze(np.append(r.time_s, frame.time_s)),
            inputs=_appended(r.inputs, [table[f"cable_{name}"] for name in r.cable_names]),
            pressures=_appended(r.pressures, [table[f"chamber_{name}"] for name in r.chamber_names]),
            free=freeze(np.append(r.free, contact_free), np.bool_),
            gravity=None if r.gravity is None else _appended(r.gravity, [table[name] for name in GRAVITY_COLUMNS]),
            marker_names=names,
            marker_frame=freeze(np.append(r.marker_frame, np.full(len(index), k)), np.int64),
            marker_index=freeze(np.append(r.marker_index, index), np.int64),
            marker_view=freeze(np.append(r.marker_view, view), np.int64),
            marker_xyz=freeze(np.vstack([r.marker_xyz, xyz])),
            cloud_files=(*r.cloud_files, depths),
            color_files=(*r.color_files, colors),
        )
        return k

    def forget(self, k: int) -> None:
        """Remove the images of a frame that is no longer needed."""
        for file in (*self.recording.cloud_files[k], *self.recording.color_files[k]):
            if file is not None:
                file.unlink(missing_ok=True)

    def _write(self, frame: StampedFrame) -> tuple[tuple[Path | None, ...], tuple[Path | None, ...]]:
        names = self.recording.camera_names
        depths: list[Path | None] = [None] * len(names)
        colors: list[Path | None] = [None] * len(names)
        for image in frame.raw.images:
            file = self._scratch / image_file(image, frame.number, names)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(image.data)
            (colors if image.kind is ImageKind.COLOR else depths)[image.view] = file
        return tuple(depths), tuple(colors)


def remove_scratch(scratch: Path) -> None:
    """Remove a scratch folder, and the shared memory whose names begin with the folder's."""
    shutil.rmtree(scratch, ignore_errors=True)
    for left in MEMORY.glob(f"{scratch.name}-*"):
        left.unlink(missing_ok=True)


def _appended(table: FloatArray, row: Sequence[float]) -> FloatArray:
    return freeze(np.vstack([table, np.reshape(row, (1, -1))]))


def _with_markers(r: Recording, markers: Sequence[Marker]) -> tuple[tuple[str, ...], list[int], list[int], FloatArray]:
    """Return all marker names, and index, view and position of the markers of a frame."""
    names = list(r.marker_names)
    names += [name for name in dict.fromkeys(one.name for one in markers) if name not in names]
    index = [names.index(one.name) for one in markers]
    xyz = np.array([one.xyz_m for one in markers]).reshape(-1, 3)
    return tuple(names), index, [one.view for one in markers], xyz
