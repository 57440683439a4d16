"""Reports on recordings, clouds and images."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from femsense.app.inspection.reports import Problems, Report, attempt
from femsense.core.arrays import FloatArray, spread_evenly
from femsense.core.errors import InputError
from femsense.io.clouds.cloud_checks import cloud_doubts, cloud_problems
from femsense.io.clouds.frame_clouds import FOLDERS, numbered_files, read_frame_cloud
from femsense.io.clouds.images import read_color, read_png
from femsense.io.recording_folder import load_recording
from femsense.io.recording_tables import TOO_FAR
from femsense.io.recording_toml import recording_problems
from femsense.io.tables import read_toml
from femsense.model.plausibility import doubts_of_cloud_places, doubts_of_recording, warn_of
from femsense.model.recording import Recording

JPEG = (".jpg", ".jpeg")
CLOUDS_READ = 8
"""Number of clouds of a recording that are read whole; of the others only the name and the size are checked."""


def inspect_recording(path: Path, report: Report, problems: Problems) -> None:
    """Report frames, markers, clouds and inputs of a recording."""
    folder = path if path.is_dir() else path.parent
    toml = folder / "recording.toml"
    if toml.is_file():
        found = recording_problems(read_toml(toml), toml)
        problems += found
        if found:
            return
    loaded = load_recording(folder)
    report.update(_recording_report(loaded))
    warn_of(doubts_of_recording(loaded))
    if not loaded.has_clouds and not loaded.has_markers and not len(loaded.unnamed_frame):
        problems.append(f"{folder}: neither markers nor clouds: nothing was measured")
    _check_clouds(loaded, report, problems)
    problems += cloud_problems(loaded)
    warn_of(cloud_doubts(loaded))
    _warn_of_unmatched(loaded, folder)


def inspect_cloud(file: Path, report: Report, problems: Problems) -> None:
    """Report points and colours of a cloud."""
    from femsense.io.clouds.cloud_files import read_cloud, viewpoint_doubt

    cloud = read_cloud(file)
    doubt = viewpoint_doubt(file)
    warn_of([*([doubt] if doubt else []), *doubts_of_cloud_places(cloud.points, str(file))])
    report.update({"points": len(cloud), "colors": cloud.colors is not None})
    if not len(cloud):
        problems.append(f"{file}: the cloud has no points")
        return
    report |= {"low_mm": 1e3 * cloud.points.min(axis=0), "high_mm": 1e3 * cloud.points.max(axis=0)}
    report["median_distance_mm"] = 1e3 * float(np.median(np.linalg.norm(cloud.points, axis=1)))
    largest = float(np.abs(cloud.points).max())
    if largest > TOO_FAR:
        text = "coordinates of this size look like millimetres"
        problems.append(InputError(text, where=file, found=f"up to {largest:.4g}", expected="metres"))


def inspect_image(file: Path, report: Report, problems: Problems) -> None:
    """Report size and content of a PNG or JPEG image."""
    jpeg = file.suffix.lower() in JPEG
    image = read_color(file) if jpeg else read_png(file)
    depth = image.ndim == 2 and image.dtype == np.uint16
    channels = 1 if image.ndim == 2 else image.shape[2]
    bits = 8 if jpeg else 8 * image.dtype.itemsize
    report.update({"width": image.shape[1], "height": image.shape[0], "channels": channels, "bits": bits})
    report["content"] = "depth" if depth else "colour" if channels >= 3 else "grey"
    if depth:
        valid = image[image > 0]
        depths = {"min": int(valid.min()), "median": float(np.median(valid)), "max": int(valid.max())} if valid.size else {}
        report["valid_share"] = float((image > 0).mean())
        report |= {f"depth_{name}": depths.get(name) for name in ("min", "median", "max")}
        if not valid.size:
            problems.append(f"{file}: no pixel has a depth")


def _recording_report(r: Recording) -> Report:
    steps = np.diff(r.time_s)
    _warn_of_gaps(r, steps)
    return {
        "frames": r.frame_count,
        "duration_s": float(r.time_s[-1] - r.time_s[0]),
        "rate_hz": 1.0 / float(np.median(steps)) if len(steps) else None,
        "actuation": r.actuation,
        "actuation_zero": r.actuation_zero,
        "cables": _input_report(r.cable_names, r.inputs, "n" if r.actuation == "tension" else "m"),
        "chambers": _input_report(r.chamber_names, r.pressures, "pa"),
        "free_frames": None if r.free is None else int(r.free.sum()),
        "sweeps": None if r.sweep is None else dict(Counter(r.sweep)),
        "gravity": "as the robot declares" if r.gravity is None else "given for each frame",
        "cameras": [_camera_report(r, v) for v in range(len(r.camera_names))],
        "markers": _marker_report(r),
        "markers_without_names": len(r.unnamed_frame) or None,
        "tools": [{"name": tool.name, "kind": tool.kind} for tool in r.tools],
        "session": r.session,
        "rest_markers": None if r.rest is None else len(r.rest.names),
        "loads": _load_report(r),
    }


def _input_report(names: Sequence[str], values: FloatArray, unit: str) -> list[Report]:
    return [
        {"name": name, f"min_{unit}": float(column.min()), f"max_{unit}": float(column.max())}
        for name, column in zip(names, values.T)
    ]


def _camera_report(r: Recording, v: int) -> Report:
    camera = r.cameras[v]
    files = [files[v] for files in r.cloud_files if files[v] is not None]
    images = sum(file is not None and file.suffix.lower() == ".png" for file in files)
    return {
        "name": r.camera_names[v] or "(the camera)",
        "pixels": f"{camera.width} × {camera.height}" if camera else "lens not given",
        "depth_unit_m": camera.depth_unit if camera and images else None,
        "pose": "not known" if r.T_robot_camera[v] is None else "known",
        "clouds": len(files) - images,
        "depth_images": images,
        "color_images": sum(files[v] is not None for files in r.color_files),
        "marker_rows": int((r.marker_view == v).sum()),
    }


def _marker_report(r: Recording) -> Report | None:
    if not r.has_markers:
        return None
    seen = np.zeros((r.frame_count, len(r.marker_names)), dtype=bool)
    seen[r.marker_frame, r.marker_index] = True
    visible = seen.sum(axis=1)
    return {
        "visible_per_frame_min": int(visible.min()),
        "visible_per_frame_median": float(np.median(visible)),
        "visible_per_frame_max": int(visible.max()),
        "hidden_share": 1.0 - float(seen.mean()),
        "each": [{"name": name, "frames": int(count)} for name, count in zip(r.marker_names, seen.sum(axis=0))],
    }


def _load_report(r: Recording) -> Report | None:
    if not len(r.load_frame):
        return None
    total = np.zeros((r.frame_count, 3))
    np.add.at(total, r.load_frame, r.load_forces)
    return {
        "rows": len(r.load_frame),
        "frames": len(np.unique(r.load_frame)),
        "largest_total_n": float(np.linalg.norm(total, axis=1).max()),
    }


def _check_clouds(r: Recording, report: Report, problems: Problems) -> None:
    """Read some clouds whole; report empty files and the number of points."""
    frames = [(k, v) for k in range(r.frame_count) for v in range(len(r.camera_names)) if r.cloud_files[k][v] is not None]
    if not frames:
        return
    chosen = {frames[i] for i in spread_evenly(len(frames), CLOUDS_READ)}
    counts: list[int] = []
    for k, v in frames:
        file = r.cloud_files[k][v]
        if (k, v) in chosen:
            cloud = attempt(partial(read_frame_cloud, r, k, view=v), problems)
            counts += [len(cloud)] if cloud is not None else []
        elif file is not None and file.stat().st_size == 0:
            problems.append(f"{file}: the file is empty")
    report["clouds"] = {
        "frames_with_cloud": len({k for k, _ in frames}),
        "frames_without_cloud": r.frame_count - len({k for k, _ in frames}),
        "read": len(counts),
        "points_median": float(np.median(counts)) if counts else None,
    }


def _warn_of_gaps(r: Recording, steps: FloatArray) -> None:
    if len(steps) < 3:
        return
    gaps = np.flatnonzero(steps > 5.0 * np.median(steps))
    if len(gaps):
        first = f"{steps[gaps[0]]:.3g} s before frame {r.frame_numbers[gaps[0] + 1]}"
        warnings.warn(f"{len(gaps)} gaps in time of more than five frames, the first of {first}", stacklevel=2)


def _warn_of_unmatched(r: Recording, folder: Path) -> None:
    """Warn of clouds and images whose number is no frame."""
    numbers = set(r.frame_numbers.tolist())
    for kind, endings in FOLDERS.items():
        for name in r.camera_names:
            place = folder / kind / name
            outliers = sorted(set(numbered_files(place, endings)) - numbers)
            if outliers:
                text = f"{len(outliers)} files whose number is not in frames.csv, the first is {outliers[0]}"
                warnings.warn(f"{place}: {text}", stacklevel=2)
    if any((folder / "clouds").glob("*/*.p[lc][yd]")) and r.camera_names == ("",):
        text = "folders of clouds, but recording.toml has no [cameras.NAME]: they are not used"
        warnings.warn(f"{folder / 'clouds'}: {text}", stacklevel=2)
