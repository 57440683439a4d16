"""Checks of connected cameras, their links, and the disk that a session needs."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from femsense.app.doctor import Check, Level
from femsense.live.sources import list_cameras
from femsense.live.sources.source import FoundCamera

USB2_MBIT_S, USB3_MBIT_S = 280.0, 3200.0
"""Practical capacity of a bus of 480 and of 5000 Mbit/s."""
NEEDED_DISK_MB_S = 20.0
"""Depth and colour of 848 × 480 at 30 Hz as PNG."""
WRITTEN_MB = 32
Listing = tuple[Sequence[FoundCamera], Mapping[str, str]]


def camera_checks(listing: Callable[[], Listing] = list_cameras) -> list[dict[str, Any]]:
    """Return the checks of cameras: each one found, missing packages, overloaded buses, the disk.

    Arguments:
        listing: returns the cameras, and for each kind whose package is missing how to install it.
    """
    cameras, missing = listing()
    checks = [_camera(camera) for camera in cameras]
    if not cameras:
        looked = "none found" if len(missing) < 3 else "no package for cameras is installed"
        hint = "a recording can be replayed: femsense live ROBOT --camera RECORDING"
        checks.append(Check("cameras", Level.WARNING, looked, hint))
    for word, text in missing.items():
        checks.append(
            Check(f"cameras: {word}", Level.WARNING, "its package is not installed", text.partition("try:")[2].strip() or text)
        )
    needed = sum(camera.needed_mbit_s for camera in cameras)
    limit = USB2_MBIT_S if any(camera.is_slow_link for camera in cameras) else USB3_MBIT_S
    if len(cameras) > 1 and needed > limit:
        found = f"{needed:.0f} Mbit/s are needed, one bus carries about {limit:.0f}"
        checks.append(Check("bandwidth of the bus", Level.WARNING, found, "spread the cameras over several USB controllers"))
    checks.append(_disk())
    return [asdict(check) for check in checks]


def _camera(camera: FoundCamera) -> Check:
    name = f"camera {camera.source}"
    found = f"{camera.name}, {camera.link}, needs {camera.needed_mbit_s:.0f} Mbit/s"
    if camera.is_slow_link:
        return Check(name, Level.WARNING, found, f"a USB 2 bus carries about {USB2_MBIT_S:.0f}: use a USB 3 port and cable")
    return Check(name, Level.OK, found)


def _disk() -> Check:
    """Write for a moment into the present folder, where sessions go."""
    data = bytes(1 << 20)
    try:
        with tempfile.NamedTemporaryFile(dir=Path.cwd()) as stream:
            began = time.perf_counter()
            for _ in range(WRITTEN_MB):
                stream.write(data)
            stream.flush()
            speed = WRITTEN_MB / (time.perf_counter() - began)
    except OSError as error:
        return Check("disk for sessions", Level.WARNING, f"this folder cannot be written: {error.strerror}", "another -o SESSION")
    found = f"{speed:.0f} MB/s into this folder, a session at 30 Hz needs about {NEEDED_DISK_MB_S:.0f}"
    return Check("disk for sessions", Level.OK if speed > NEEDED_DISK_MB_S else Level.WARNING, found)
