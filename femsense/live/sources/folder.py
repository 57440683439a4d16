"""A folder into which another program writes images or clouds, one file per frame."""

from __future__ import annotations

import time
from pathlib import Path

from femsense.core.errors import InputError
from femsense.io.clouds.frame_clouds import FOLDERS
from femsense.io.clouds.images import png_header
from femsense.io.recording_toml import RecordingTable, views_of
from femsense.io.tables import read_toml, validated
from femsense.live.frames import Image, ImageKind, RawFrame
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost

POLL_S = 0.005
SETTLED_S = 0.02
"""A file that has not changed for this long is complete, even if its writer does not write under a temporary name [s]."""
CAMERA_FILE = "camera.toml"


class GrowingFolder:
    """New files `NUMBER.png`, `.ply` or `.pcd` in `depth/` with `color/`, or in `clouds/`, of a folder.

    `camera.toml` in the folder describes the camera as recording.toml does; depth images need it. Stamps are the modification times.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder).expanduser()
        self._last = -1
        self._kind = ImageKind.DEPTH

    def open(self, opening: Opening) -> SourceInfo:
        """Start with files written from now on."""
        if not self.folder.is_dir():
            raise SourceLost(Loss.UNPLUGGED, f"there is no folder {self.folder}")
        table = self._table()
        names, cameras, poses = views_of(table, self.folder / CAMERA_FILE)
        if names != ("",):
            raise InputError("one camera a folder", where=self.folder / CAMERA_FILE, found=", ".join(names), expected="[camera]")
        self._kind = ImageKind.CLOUD if (self.folder / ImageKind.CLOUD).is_dir() else ImageKind.DEPTH
        if self._kind is ImageKind.DEPTH and cameras[0] is None:
            raise InputError(
                "depth images need the intrinsics of their camera",
                where=self.folder,
                found=f"no {CAMERA_FILE} with a table [camera]",
                expected="width, height, fx, fy, cx, cy, depth_unit_m, as in recording.toml",
            )
        self._last = max(opening.last_number, max(self._numbers(), default=-1) if opening.attempt == 0 else -1)
        return SourceInfo(f"folder {self.folder.name}", cameras, float("nan"), T_robot_camera=poses)

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the newest complete frame; those between it and the previous one count as skipped."""
        end = time.monotonic() + timeout_s
        while True:
            if not self.folder.is_dir():
                raise SourceLost(Loss.UNPLUGGED, f"the folder {self.folder} was removed")
            numbers = [number for number in self._numbers() if number > self._last]
            for number in sorted(numbers, reverse=True):
                frame = self._frame(number)
                if frame is not None:
                    self._last = number
                    return frame
            if time.monotonic() > end:
                return None
            time.sleep(POLL_S)

    def close(self) -> None:
        """Do nothing: no resources are held."""

    def list_devices(self) -> list[FoundCamera]:
        """Return none: folders are not devices."""
        return []

    def _table(self) -> RecordingTable:
        file = self.folder / CAMERA_FILE
        known = {"format": "femsense-recording-1", "actuation": "tension", "actuation_zero": "absolute"}
        return validated(RecordingTable, known | (read_toml(file) if file.is_file() else {}), file)

    def _numbers(self) -> list[int]:
        place = self.folder / self._kind
        files = place.iterdir() if place.is_dir() else ()
        return [int(file.stem) for file in files if file.suffix.lower() in FOLDERS[self._kind] and file.stem.isdecimal()]

    def _frame(self, number: int) -> RawFrame | None:
        """Return a frame; None while one of its files is being written."""
        images, stamp = [], 0.0
        for kind in (self._kind, ImageKind.COLOR):
            file = next(
                (f for end in FOLDERS[kind] for f in (self.folder / kind).glob(f"*{number}{end}") if int(f.stem) == number), None
            )
            if file is None:
                continue
            written = file.stat().st_mtime
            if time.time() - written < SETTLED_S or (file.suffix == ".png" and png_header(file) is None):
                return None
            stamp = max(stamp, written)
            images.append(Image(kind, file.read_bytes(), file.suffix.lower()))
        waits_for_color = self._kind is ImageKind.DEPTH and len(images) == 1 and (self.folder / ImageKind.COLOR).is_dir()
        return None if not images or waits_for_color else RawFrame(number, stamp, tuple(images), arrived_s=time.monotonic())
