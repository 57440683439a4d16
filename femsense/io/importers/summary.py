"""Statistics of an imported source over its frames: rate, gaps, lost and swapped markers, span."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from femsense.io.importers.frames import Source
from femsense.io.importers.journal import Journal, Picture

SHOWN = (Picture.DEPTH, Picture.CLOUD)
GAP = 1.5
"""A step in time longer than this times the usual one lacks frames."""
JUMP = 5.0
"""Two markers that each jump farther than this times their usual step, and land where the other was, are called swapped."""


def summary(source: Source, journal: Journal, counts: Mapping[str, int]) -> dict[str, Any]:
    """Return the summary of an import, with units in the keys; warns of swapped labels and of lost frames."""
    times = journal.times()
    step = np.diff(times)
    usual = float(np.median(step)) if len(step) else None
    gaps = step[step > GAP * usual] if usual else np.zeros(0)
    found: dict[str, Any] = {
        "format": source.format,
        "frames": len(times),
        "start_s": float(times[0]),
        "duration_s": float(times[-1] - times[0]),
        "rate_hz": None if not usual else 1.0 / usual,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max()) if len(gaps) else None,
        "frames_missing": int(np.rint(gaps / usual - 1).sum()) if usual else 0,
        "dropped_out_of_order": counts["out_of_order"],
        "resumed": counts["resumed"] or None,
        **_pictures(journal),
        **_markers(journal),
        "cameras": _cameras(source, journal) or None,
        **source.found,
    }
    if found["broken_pictures"]:
        warnings.warn(f"{source.path}: {found['broken_pictures']} of {len(times)} pictures are broken", stacklevel=2)
    return {key: value for key, value in found.items() if value is not None}


def _pictures(journal: Journal) -> dict[str, int | None]:
    kinds, empty = Counter[Picture](), 0
    for entry in journal.entries():
        kinds.update(one.picture for one in entry.seen.values())
        empty += sum(one.picture in SHOWN and one.center is None for one in entry.seen.values())
    if empty:
        warnings.warn(f"{empty} of {kinds[Picture.DEPTH] + kinds[Picture.CLOUD]} pictures show nothing", stacklevel=3)
    return {
        "depth_images": kinds[Picture.DEPTH],
        "clouds": kinds[Picture.CLOUD],
        "broken_pictures": kinds[Picture.BROKEN],
        "empty_pictures": empty or None,
    }


def _cameras(source: Source, journal: Journal) -> list[dict[str, Any]]:
    """Return the summary of each of several cameras."""
    pictures, markers = dict.fromkeys(source.views, 0), dict.fromkeys(source.views, 0)
    for entry in journal.entries():
        for name, seen in entry.seen.items() if source.views else ():
            pictures[name] += seen.picture in SHOWN
            markers[name] += bool(seen.markers or seen.unlabelled)
    return [
        {"camera": name, "format": one.format, "pictures": pictures[name], "frames_with_markers": markers[name]}
        | {
            key: one.found[key]
            for key in ("clock", "lens", "depth_unit_m", "camera_frame", "unit")
            if one.found.get(key) is not None
        }
        for name, one in source.views.items()
    ]


def _markers(journal: Journal) -> dict[str, Any]:
    """Return the markers, how often each is missing, the span [m] and the frames in which two seem to change places."""
    seen: dict[str, int] = {}
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    most, loads, frames = 0, 0, 0
    swaps: dict[str, _Swaps] = {}
    for entry in journal.entries():
        frames, loads = frames + 1, loads + len(entry.loads)
        for camera, one in entry.seen.items():
            most = max(most, len(one.unlabelled))
            places = np.array([*one.markers.values(), *one.unlabelled], dtype=float).reshape(-1, 3)
            if len(places):
                low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
            swaps.setdefault(camera, _Swaps()).look(entry.number, one.markers)
        for name in {name for one in entry.seen.values() for name in one.markers}:
            seen[name] = seen.get(name, 0) + 1
    swapped = [item for one in swaps.values() for item in one.found]
    if not seen and not most:
        return {"loads": loads} if loads else {}
    if swapped:
        warnings.warn(
            "labels of markers seem swapped: "
            + "; ".join(f"{a} and {b} at frame {k}" for k, a, b in swapped[:5])
            + (f" and {len(swapped) - 5} more" if len(swapped) > 5 else ""),
            stacklevel=3,
        )
    return {
        "markers": sorted(seen),
        "unlabelled_markers": most or None,
        "missing": [{"marker": name, "share": 1 - count / frames} for name, count in sorted(seen.items()) if count < frames]
        or None,
        "span_m": (high - low).tolist(),
        "label_swaps": len(swapped),
        "loads": loads or None,
    }


class _Swaps:
    """Watches named markers for two that jump to each other's place."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}
        self.usual: dict[str, float] = {}
        self.found: list[tuple[int, str, str]] = []

    def look(self, number: int, markers: Mapping[str, list[float]]) -> None:
        now = {name: np.asarray(place) for name, place in markers.items()}
        step = {name: float(np.linalg.norm(now[name] - self.last[name])) for name in now if name in self.last}
        jumped = [name for name, size in step.items() if name in self.usual and size > JUMP * max(self.usual[name], 1e-4)]
        for i, a in enumerate(jumped):
            for b in jumped[i + 1 :]:
                crossed = np.linalg.norm(now[a] - self.last[b]) + np.linalg.norm(now[b] - self.last[a])
                if crossed < 0.25 * (step[a] + step[b]):
                    self.found.append((number, a, b))
        for name, size in step.items():
            if name not in jumped:
                self.usual[name] = 0.9 * self.usual.get(name, size) + 0.1 * size
        self.last.update(now)
