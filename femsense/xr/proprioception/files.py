"""SENSORS.csv and MARKERS.csv.

SENSORS.csv: `time_s`, optionally `frame`, and one column per channel, with any name and in any unit.
MARKERS.csv: `frame,marker[,camera],x_m,y_m,z_m[,qw,qx,qy,qz]`, as in a recording; a hidden marker has no row. Frames refer to
SENSORS.csv; without a column `frame` there, to its rows from 0. With a quaternion a marker is a rigid body: points in front of and behind it
along the body become markers too, so that bones follow its orientation.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from femsense.calib.files import read_calibration
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.recording_tables import PLACE_COLUMNS
from femsense.io.recording_toml import RecordingTable, views_of
from femsense.io.tables import Table, read_csv, read_text, read_toml, validated
from femsense.xr.proprioception.labelled import AS_MEASURED, ROBOT, Labelled, labelled

NOT_CHANNELS = ("frame", "time_s")
TURN = ("qw", "qx", "qy", "qz")
UNIT = 0.01
"""Tolerance of the length of a quaternion."""
DIRECTED = 0.25
"""Distance of the points that a rigid body adds, in mean distances of rigid bodies."""


def read_labelled(
    sensors: str | Path, markers: str | Path, *, calibration: str | Path | None = None, in_robot_frame: bool = False
) -> Labelled:
    """Return readings with their markers from two CSV files; rows without all markers are left out.

    Arguments:
        sensors, markers: SENSORS.csv and MARKERS.csv.
        calibration: its camera poses transform the markers into the robot frame. By default those declared in a
            recording.toml next to the files; without a pose the markers stay in their frame.
        in_robot_frame: whether the markers are in the robot frame already.

    Raises:
        InputError: unreadable files, no channel, decreasing times, frames in one file only, a camera without a pose.
    """
    if in_robot_frame and calibration is not None:
        raise InputError("markers in the robot's frame need no calibration", where="in_robot_frame", found=calibration)
    poses = {} if in_robot_frame else camera_poses(Path(markers), calibration)
    frames, time_s, channels, readings = read_sensors(sensors)
    names, places, turns = _read_markers(Path(markers), frames, poses)
    if turns is not None:
        names, places = with_directions(names, places, turns, Path(markers))
    frame = ROBOT if poses or in_robot_frame else AS_MEASURED
    return labelled(time_s, readings, places, channels=channels, marker_names=names, frame=frame)


def camera_poses(markers: Path, calibration: str | Path | None) -> dict[str, FloatArray]:
    """Return the pose T_robot_camera, shape (4, 4), of each camera by name; empty if a pose is missing.

    Arguments:
        markers: path of markers.csv.
        calibration: path of a calibration. None: the poses declared in recording.toml, in the folder of `markers`.

    Raises:
        InputError: the calibration or recording.toml is invalid.
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
        raise InputError("a frame appears twice", where=f"{file}, column frame", found=int(again[0]))
    return frames, table.numbers(("time_s",))[:, 0], channels, table.numbers(channels, empty_is_nan=True)


def with_directions(
    names: tuple[str, ...], places: FloatArray, turns: FloatArray, where: Path
) -> tuple[tuple[str, ...], FloatArray]:
    """Return rigid bodies with additional markers at `DIRECTED` of their mean distance before and behind each, along the body.

    The direction of the body is that of the line through the rigid bodies at rest (the first complete frame), and rotates with each.

    Arguments:
        names: names of the m rigid bodies, from base to tip.
        places: [m], shape (n, m, 3).
        turns: their rotations, shape (n, m, 3, 3), nan where one is hidden.
        where: for messages.

    Returns:
        names, and places of shape (n, 3 m − 2, 3).

    Raises:
        InputError: one rigid body, or no frame with all of them.
    """
    whole = np.flatnonzero(np.isfinite(turns).all(axis=(1, 2, 3)) & np.isfinite(places).all(axis=(1, 2)))
    if len(names) < 2 or not len(whole):
        raise InputError(
            "directions need two rigid bodies in one frame", where=where, found=f"{len(names)} named", expected="two or more"
        )
    rest = places[whole[0]]
    line = np.gradient(rest, axis=0)
    own = np.einsum("mji,mj->mi", turns[whole[0]], line / np.linalg.norm(line, axis=1, keepdims=True))
    reach = DIRECTED * float(np.linalg.norm(np.diff(rest, axis=0), axis=1).mean())
    along = reach * np.einsum("nmij,mj->nmi", turns, own)
    labels, points = list[str](), list[FloatArray]()
    for i, name in enumerate(names):
        for mark, sign in (("-", -1.0), ("", 0.0), ("+", 1.0)):
            if (i, mark) not in ((0, "-"), (len(names) - 1, "+")):
                labels.append(name + mark)
                points.append(places[:, i] + sign * along[:, i])
    return tuple(labels), np.stack(points, axis=1)


def _read_markers(
    path: Path, frames: IntArray, poses: dict[str, FloatArray]
) -> tuple[tuple[str, ...], FloatArray, FloatArray | None]:
    """Return names in the order in which they first come, places (n, m, 3), nan where a marker is hidden, and rotations
    (n, m, 3, 3) of rigid bodies; None for points only.

    Positions are transformed by the poses of their cameras, if known; with several cameras the mean position is used, and the rotation of
    the last one.
    """
    table = read_csv(path, required=("frame", "marker", *PLACE_COLUMNS), optional=("camera", *TURN))
    labels, numbers = table.text("marker"), table.integers("frame")
    names = tuple(dict.fromkeys(labels))
    if not names or "" in names:
        raise InputError("a marker without a name", where=path, found=names or "no row", expected="a name in each row")
    row_of = {frame: row for row, frame in enumerate(frames.tolist())}
    rows = np.array([row_of.get(number, -1) for number in numbers.tolist()], dtype=np.int64)
    known = rows >= 0
    if not known.any():
        raise InputError(
            "no frame is in both files",
            where=path,
            found=f"frames {numbers[0]} … {numbers[-1]}",
            expected=f"frames {frames[0]} … {frames[-1]}" if len(frames) else "rows",
            hint=did_you_mean(str(numbers[0]), [str(frame) for frame in frames[:50]]),
        )
    T, turned = _poses_of_rows(table, poses, path), _turned(table, path)
    places = np.einsum("kij,kj->ki", T[:, :3, :3], table.numbers(PLACE_COLUMNS)) + T[:, :3, 3]
    at = rows[known], np.array([names.index(label) for label in labels])[known]
    total, seen = np.zeros((len(frames), len(names), 3)), np.zeros((len(frames), len(names), 1))
    np.add.at(total, at, places[known])
    np.add.at(seen, at, 1.0)
    turns = None if turned is None else np.full((len(frames), len(names), 3, 3), np.nan)
    if turns is not None and turned is not None:
        turns[at] = (T[:, :3, :3] @ turned)[known]
    return names, np.divide(total, seen, out=np.full_like(total, np.nan), where=seen > 0), turns


def _turned(table: Table, path: Path) -> FloatArray | None:
    """Return the rotation of each row, shape (k, 3, 3), in the frame of its camera; None without quaternions. Raises InputError."""
    given = [name for name in TURN if name in table.columns]
    if not given:
        return None
    if len(given) < len(TURN):
        raise InputError("not a whole quaternion", where=f"{path}, header", found=", ".join(given), expected=", ".join(TURN))
    numbers = table.numbers(TURN)
    off = np.abs(np.linalg.norm(numbers, axis=1) - 1.0)
    if (off > UNIT).any():
        row = int(np.argmax(off))
        found = f"length {np.linalg.norm(numbers[row]):.3g}"
        raise InputError("not a unit quaternion", where=f"{path}, row {row + 1}", found=found, expected="length 1")
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(numbers[:, [1, 2, 3, 0]]).as_matrix())


def _poses_of_rows(table: Table, poses: dict[str, FloatArray], path: Path) -> FloatArray:
    """Return the pose of the camera of each row, shape (k, 4, 4); the identity without poses. Raises InputError."""
    cameras = table.text("camera") if "camera" in table.columns else [""] * len(table)
    found = set(cameras)
    if not poses and len(found) > 1:
        raise InputError(
            "markers of several cameras without their poses",
            where=path,
            found=", ".join(sorted(found)),
            expected="-c CALIBRATION",
        )
    if len(found) == 1 and len(poses) <= 1:  # one pose is that of the one camera, whatever its name
        return np.tile(next(iter(poses.values()), np.eye(4)), (len(table), 1, 1))
    if not found <= set(poses):
        raise InputError(
            "a camera without a pose", where=path, found=", ".join(sorted(found - set(poses))), expected=", ".join(poses)
        )
    return np.array([poses[name] for name in cameras])
