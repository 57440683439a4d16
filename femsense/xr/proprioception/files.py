"""SENSORS.csv and MARKERS.csv.

SENSORS.csv: `time_s`, optionally `frame`, and one column a channel, with any name and in any unit.
MARKERS.csv: `frame,marker[,camera],x_m,y_m,z_m`, as in a recording; a hidden marker has no row. Frames are those of SENSORS.csv, there the
rows from 0 where it has no such column.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from femsense.calib.files import read_calibration
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.pose import transform_points
from femsense.core.text import did_you_mean
from femsense.io.recording_toml import RecordingTable, views_of
from femsense.io.tables import Table, read_csv, read_text, read_toml, validated
from femsense.xr.proprioception.labelled import AS_MEASURED, ROBOT, Labelled, labelled

NOT_CHANNELS = ("frame", "time_s")
AXES = ("x_m", "y_m", "z_m")


def read_labelled(
    sensors: str | Path, markers: str | Path, *, calibration: str | Path | None = None, in_robot_frame: bool = False
) -> Labelled:
    """Return readings with their markers from two CSV files; rows without all markers are left out.

    Arguments:
        sensors, markers: SENSORS.csv and MARKERS.csv.
        calibration: through its camera poses the markers come into the robot's frame. By default through those that a
            recording.toml beside them declares; where none does they stay in the frame in which they were measured.
        in_robot_frame: the markers are in the robot's frame already.

    Raises:
        InputError: what cannot be read, no channel, times that decrease, frames that are in one file only, a camera without a pose.
    """
    if in_robot_frame and calibration is not None:
        raise InputError("markers in the robot's frame need no calibration", where="in_robot_frame", found=calibration)
    poses = {} if in_robot_frame else camera_poses(Path(markers), calibration)
    frames, time_s, channels, readings = read_sensors(sensors)
    names, places = _read_markers(Path(markers), frames, poses)
    frame = ROBOT if poses or in_robot_frame else AS_MEASURED
    return labelled(time_s, readings, places, channels=channels, marker_names=names, frame=frame)


def camera_poses(markers: Path, calibration: str | Path | None) -> dict[str, FloatArray]:
    """Return T_robot_camera, shape (4, 4), by the name of the camera: of a calibration, else of a recording.toml beside the markers.

    Empty where neither says one. Raises InputError.
    """
    if calibration is not None:
        found = read_calibration(calibration)
        return dict(zip(found.camera_names, found.poses))
    toml = markers.parent / "recording.toml"
    if not toml.is_file():
        return {}
    names, _, poses = views_of(validated(RecordingTable, read_toml(toml), toml), toml)
    known = {name: np.asarray(pose, dtype=np.float64) for name, pose in zip(names, poses) if pose is not None}
    return known if len(known) == len(names) else {}


def read_sensors(path: str | Path) -> tuple[IntArray, FloatArray, tuple[str, ...], FloatArray]:
    """Return frames (n,), times [s] (n,), names of channels and readings (n, c) of SENSORS.csv; an empty cell is nan.

    Raises InputError.
    """
    file = Path(path)
    header = next(csv.reader(io.StringIO(read_text(file))), [])
    columns = tuple(cell.strip() for cell in header)
    channels = tuple(name for name in columns if name not in NOT_CHANNELS)
    table = read_csv(file, required=("time_s",), optional=("frame", *channels))
    if not channels:
        raise InputError(
            "no channel", where=f"{file}, header", found=", ".join(columns), expected="time_s and a column for each sensor"
        )
    frames = table.integers("frame") if "frame" in columns else np.arange(len(table))
    again = np.flatnonzero(np.bincount(frames) > 1)
    if len(again):
        raise InputError("a frame stands twice", where=f"{file}, column frame", found=int(again[0]))
    return frames, table.numbers(("time_s",))[:, 0], channels, table.numbers(channels, empty_is_nan=True)


def _read_markers(path: Path, frames: IntArray, poses: dict[str, FloatArray]) -> tuple[tuple[str, ...], FloatArray]:
    """Return names in the order in which they first come, and places (n, m, 3), nan where a marker is hidden.

    Places are taken through the poses of their cameras, where there are any; of several cameras their mean is taken.
    """
    table = read_csv(path, required=("frame", "marker", *AXES), optional=("camera",))
    labels, numbers = table.text("marker"), table.integers("frame")
    names = tuple(dict.fromkeys(labels))
    if not names or "" in names:
        raise InputError("a marker without a name", where=path, found=names or "no row", expected="a name in each row")
    row_of = {int(frame): row for row, frame in enumerate(frames)}
    unknown = [int(number) for number in numbers if int(number) not in row_of]
    if len(unknown) == len(numbers):
        hint = did_you_mean(str(unknown[0]), [str(frame) for frame in frames[:50]])
        raise InputError(
            "no frame is in both files",
            where=path,
            found=f"frames {unknown[0]} … {unknown[-1]}",
            expected=f"frames {frames[0]} … {frames[-1]}" if len(frames) else "rows",
            hint=hint,
        )
    total, seen = np.zeros((len(frames), len(names), 3)), np.zeros((len(frames), len(names), 1))
    for label, number, place in zip(labels, numbers, _moved(table, poses, path)):
        if int(number) in row_of:
            at = row_of[int(number)], names.index(label)
            total[at] += place
            seen[at] += 1.0
    return names, np.divide(total, seen, out=np.full_like(total, np.nan), where=seen > 0)


def _moved(table: Table, poses: dict[str, FloatArray], path: Path) -> FloatArray:
    """Return the places of markers, shape (k, 3), each through the pose of its camera."""
    places = table.numbers(AXES)
    cameras = np.array(table.text("camera") if "camera" in table.columns else [""] * len(table))
    found = set(cameras.tolist())
    if not poses and len(found) > 1:
        raise InputError(
            "markers of several cameras without their poses",
            where=path,
            found=", ".join(sorted(found)),
            expected="-c CALIBRATION",
        )
    if len(poses) == 1 and len(found) == 1:
        return transform_points(next(iter(poses.values())), places)
    if poses and not found <= set(poses):
        raise InputError(
            "a camera without a pose", where=path, found=", ".join(sorted(found - set(poses))), expected=", ".join(poses)
        )
    for name, pose in poses.items():
        places[cameras == name] = transform_points(pose, places[cameras == name])
    return places
