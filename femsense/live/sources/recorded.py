"""Replay of a recording as a camera, in real time or as fast as possible."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.core.text import numbers_text
from femsense.io.recording_folder import load_recording
from femsense.io.recording_tables import GRAVITY_COLUMNS
from femsense.live.frames import Image, ImageKind, Marker, RawFrame
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost

LARGEST = 1.2
"""Size of a ring slot relative to the largest frame of the recording."""


class Recorded:
    """A recording replayed as a camera."""

    def __init__(self, folder: str, *, as_fast_as_possible: bool = False, is_endless: bool = False) -> None:
        """Arguments: folder; whether frames are returned on request instead of at their times; whether the recording repeats."""
        self.folder = Path(folder).expanduser()
        self.as_fast_as_possible, self.is_endless = as_fast_as_possible, is_endless
        self.recording = load_recording(self.folder)
        self._begun_s = 0.0
        self._next = 0

    def open(self, opening: Opening) -> SourceInfo:
        """Start the replay at the time since the first opening, or after the last frame received."""
        recording = self.recording
        if not recording.has_clouds and not recording.has_markers:
            raise InputError("nothing to replay", where=self.folder, found="no clouds and no markers", expected="either")
        self._begun_s = time.monotonic() if math.isnan(opening.begun_s) else opening.begun_s
        self._next = opening.last_number + 1
        steps = np.diff(recording.time_s)
        return SourceInfo(
            name=f"recording {self.folder.name}",
            cameras=recording.cameras,
            camera_names=recording.camera_names,
            rate_hz=float(1.0 / np.median(steps)) if len(steps) else float("nan"),
            T_robot_camera=recording.T_robot_camera,
            actuation=recording.actuation,
            actuation_zero=recording.actuation_zero,
            marker_noise_m=recording.marker_noise_m,
            longest_wait_s=float(steps.max(initial=0.0)),
            contact_free=self._contact_free(),
            largest_frame=int(LARGEST * max(map(self._size, range(recording.frame_count)))) + (1 << 16),
        )

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the next frame at its time; frames whose time has passed are dropped, as by a camera."""
        count = self.recording.frame_count
        if not self.as_fast_as_possible:
            while (self.is_endless or self._next + 1 < count) and self.due_s(self._next + 1) <= time.monotonic():
                self._next += 1
            if self.is_endless or self._next < count:
                wait = self.due_s(self._next) - time.monotonic()
                time.sleep(max(0.0, min(timeout_s, wait)))
                if wait > timeout_s:
                    return None
        if self._next >= count and not self.is_endless:
            raise SourceLost(Loss.ENDED, f"{self.folder} has ended")
        number, self._next = self._next, self._next + 1
        stamp = self.due_s(number) - self._begun_s + float(self.recording.time_s[0])
        return replace(self.frame(number % count), number=number, stamp_s=stamp)

    def due_s(self, number: int) -> float:
        """Return the due time of a frame [s, monotonic clock], numbered over all repetitions."""
        times = self.recording.time_s
        period = float(times[-1] - times[0]) * (1.0 + 1.0 / max(1, len(times) - 1))
        return self._begun_s + float(times[number % len(times)] - times[0]) + number // len(times) * period

    def frame(self, k: int) -> RawFrame:
        """Return frame k of the recording, 0 … F − 1, as a frame of a camera."""
        r = self.recording
        images = []
        for view, (file, color) in enumerate(zip(r.cloud_files[k], r.color_files[k])):
            if file is not None:
                kind = ImageKind.DEPTH if file.suffix.lower() == ".png" else ImageKind.CLOUD
                images.append(Image(kind, file.read_bytes(), file.suffix.lower(), view))
            if color is not None:
                images.append(Image(ImageKind.COLOR, color.read_bytes(), color.suffix.lower(), view))
        rows = np.flatnonzero(r.marker_frame == k)
        markers = tuple(
            Marker(r.marker_names[r.marker_index[i]], tuple(r.marker_xyz[i].tolist()), int(r.marker_view[i])) for i in rows
        )
        inputs = [(f"cable_{name}", float(v)) for name, v in zip(r.cable_names, r.inputs[k])]
        inputs += [(f"chamber_{name}", float(v)) for name, v in zip(r.chamber_names, r.pressures[k])]
        if r.gravity is not None:
            inputs += zip(GRAVITY_COLUMNS, r.gravity[k].tolist())
        return RawFrame(
            number=k,
            stamp_s=float(r.time_s[k]),
            images=tuple(images),
            markers=markers,
            arrived_s=time.monotonic(),
            contact_free=None if r.free is None else bool(r.free[k]),
            inputs=tuple(inputs),
        )

    def close(self) -> None:
        """Do nothing: no resources are held."""

    def list_devices(self) -> list[FoundCamera]:
        """Return none: recordings are not devices."""
        return []

    def _contact_free(self) -> str:
        """Return which frames may calibrate, in words. Raises InputError if none may."""
        free = self.recording.free
        if free is None:
            return "the recording has no column `free`: until the calibration, all its frames are taken as contact-free"
        if not free.any():
            raise InputError(
                "no frame is declared contact-free, and a session begins with such frames",
                where=self.folder / "frames.csv",
                found="0 in every row of the column `free`",
                expected="1 where nothing touches the robot",
            )
        return f"only frames {numbers_text(self.recording.frame_numbers[free].tolist())}, by the column `free` of the recording"

    def _size(self, k: int) -> int:
        files = [*self.recording.cloud_files[k], *self.recording.color_files[k]]
        return sum(file.stat().st_size for file in files if file is not None)
