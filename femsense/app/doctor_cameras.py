"""Checks of connected cameras, their links, and the disk that a session needs."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from femsense.app.doctor import Finding, Level, good, note
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
    checks = {f"camera {camera.source}": _camera(camera) for camera in cameras}
    if not cameras:
        looked = "none found" if len(missing) < 3 else "no package for cameras is installed"
        checks["cameras"] = note(looked, "a recording can be replayed: femsense live ROBOT --camera RECORDING")
    for word, text in missing.items():
        checks[f"cameras: {word}"] = note("its package is not installed", text.partition("try:")[2].strip() or text)
    needed = sum(camera.needed_mbit_s for camera in cameras)
    limit = USB2_MBIT_S if any(camera.is_slow_link for camera in cameras) else USB3_MBIT_S
    if len(cameras) > 1 and needed > limit:
        found = f"{needed:.0f} Mbit/s are needed, one bus carries about {limit:.0f}"
        checks["bandwidth of the bus"] = note(found, "spread the cameras over several USB controllers")
    checks["disk for sessions"] = _disk()
    return [{"name": name, **asdict(finding)} for name, finding in checks.items()]


def _camera(camera: FoundCamera) -> Finding:
    found = f"{camera.name}, {camera.link}, needs {camera.needed_mbit_s:.0f} Mbit/s"
    if camera.is_slow_link:
        return note(found, f"a USB 2 bus carries about {USB2_MBIT_S:.0f}: use a USB 3 port and cable")
    return good(found)


def _disk() -> Finding:
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
        return note(f"this folder cannot be written: {error.strerror}", "another -o SESSION")
    found = f"{speed:.0f} MB/s into this folder, a session at 30 Hz needs about {NEEDED_DISK_MB_S:.0f}"
    return good(found) if speed > NEEDED_DISK_MB_S else Finding(Level.WARNING, found)
