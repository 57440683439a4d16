"""A recording: frames with inputs, markers, loads and clouds; making one, and selecting frames of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import femsense
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose
from femsense.model.camera import Camera
from femsense.model.recording_parts import About, Drives, LoadRows, MarkerRows, RestMarkers, Timeline, Tool, UnnamedRows, Views


def _no_indices() -> IntArray:
    return freeze(np.zeros(0), np.int64)


def _no_points() -> FloatArray:
    return freeze(np.zeros((0, 3)))


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """A recording of one experiment: F frames in order of time, with the inputs of the robot and the observations of V cameras (views).

    The robot has a cables and c chambers. `load_recording`, `recording_from_arrays` and `make_recording` make one.
    """

    folder: Path | None
    """Folder that it was loaded from; None: made in Python."""
    actuation: str
    """Kind of `inputs`: "tension" [N] or "displacement" [m, > 0 shortens]."""
    actuation_zero: str
    """"absolute": the values are the true inputs; "unknown": they count from an unknown initial input."""
    camera_names: tuple[str, ...]
    """Name of each camera; ("",) if there is one camera without a name."""
    cameras: tuple[Camera | None, ...]
    """Intrinsics of each camera; None where they are unknown."""
    T_robot_camera: tuple[FloatArray | None, ...]
    """Pose of each camera, shape (4, 4), from camera to robot coordinates; None where it is unknown."""
    frame_numbers: IntArray
    """Number of each frame, as in frames.csv, shape (F,)."""
    time_s: FloatArray
    """Time of each frame [s], increasing, shape (F,)."""
    cable_names: tuple[str, ...]
    """Name of each cable, in the order of the columns of `inputs`."""
    inputs: FloatArray
    """Input of each cable in each frame: tension [N] or displacement [m], shape (F, a)."""
    chamber_names: tuple[str, ...]
    """Name of each chamber, in the order of the columns of `pressures`."""
    pressures: FloatArray
    """Pressure of each chamber in each frame above the surroundings [Pa], shape (F, c)."""
    free: BoolArray | None
    """Whether each frame is free of undeclared contacts, shape (F,); None: unknown."""
    sweep: tuple[str, ...] | None
    """Label of the sweep of each frame; the frames of a sweep are held out together. None: not given."""
    gravity: FloatArray | None
    """Gravity in each frame, robot coordinates [m/s²], shape (F, 3); None: that of the robot."""
    marker_names: tuple[str, ...]
    """Name of each marker, in the order of first appearance."""
    marker_frame: IntArray
    """Frame of each of K marker observations, an index from 0 to F − 1, shape (K,)."""
    marker_index: IntArray
    """Marker of each observation, an index into `marker_names`, shape (K,)."""
    marker_view: IntArray
    """Camera of each observation, an index into `camera_names`, shape (K,)."""
    marker_xyz: FloatArray
    """Position of each observed marker in the coordinates of that camera [m], shape (K, 3)."""
    rest: RestMarkers | None
    """Markers of the unloaded body; None: not measured."""
    load_frame: IntArray
    """Frame of each of L known loads, an index from 0 to F − 1, shape (L,)."""
    load_points: FloatArray
    """Point of the body at rest at which each load acts, robot coordinates [m], shape (L, 3)."""
    load_forces: FloatArray
    """Force of each load on the body, robot coordinates [N], shape (L, 3)."""
    cloud_files: tuple[tuple[Path | None, ...], ...]
    """Cloud or depth image of each frame and view; None where there is none."""
    color_files: tuple[tuple[Path | None, ...], ...]
    """Colour image of each frame and view; None where there is none."""
    marker_noise_m: float | None = None
    """Repeatability of a marker along each axis, one standard deviation [m]; None if not given."""
    session: str | None = None
    """Recordings of one session share values that are constant within a session; None if not given."""
    tools: tuple[Tool, ...] = ()
    """Objects of known shape that may touch the robot."""
    unnamed_frame: IntArray = field(default_factory=_no_indices)
    """Frame of each of U observations of markers without names, an index from 0 to F − 1, shape (U,); they are not contained in `marker_xyz`."""
    unnamed_view: IntArray = field(default_factory=_no_indices)
    """Camera of each such observation, an index into `camera_names`, shape (U,)."""
    unnamed_xyz: FloatArray = field(default_factory=_no_points)
    """Position of each such observation in the coordinates of that camera [m], shape (U, 3)."""

    @property
    def label(self) -> str:
        """Label by which values per recording are looked up: the session, else the name of the folder, else ""."""
        return self.session or (self.folder.name if self.folder is not None else "")

    @classmethod
    def from_arrays(cls, time_s: npt.ArrayLike, **parts: Any) -> Recording:
        """Return a recording of one camera from arrays; see `recording_from_arrays` for its parts, shapes and units."""
        return femsense.recording_from_arrays(time_s, **parts)

    def __repr__(self) -> str:
        seconds = float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) else 0.0
        drives = [f"{', '.join(self.cable_names)} [{self.actuation}]"] if self.cable_names else []
        drives += [f"chambers {', '.join(self.chamber_names)}"] if self.chamber_names else []
        seen = [f"{len(self.marker_names)} markers"] if self.has_markers else []
        seen += ["clouds"] if self.has_clouds else []
        return f"Recording({'; '.join([f'{self.frame_count} frames, {seconds:.4g} s', *drives, *seen])})"

    @property
    def frame_count(self) -> int:
        return len(self.time_s)

    @property
    def has_clouds(self) -> bool:
        """Whether any frame has a cloud or a depth image."""
        return any(file is not None for files in self.cloud_files for file in files)

    @property
    def has_markers(self) -> bool:
        """Whether any frame has a marker with a name."""
        return len(self.marker_frame) > 0


# Parts, selections


def make_recording(
    timeline: Timeline,
    *,
    drives: Drives | None = None,
    markers: MarkerRows | None = None,
    loads: LoadRows | None = None,
    views: Views | None = None,
    unnamed: UnnamedRows | None = None,
    about: About | None = None,
) -> Recording:
    """Make a recording from its parts. `recording_from_arrays` is simpler for one camera and named markers.

    Arguments:
        timeline: times and labels of the F frames.
        drives: inputs of the cables, pressures of the chambers. Default: none.
        markers: observations of markers with names. Default: none.
        loads: known loads. Default: none.
        views: cameras and their files. Default: one camera with unknown pose and no files.
        unnamed: observations of markers without names. Default: none.
        about: properties of the whole recording. Default: unknown.

    Returns:
        the recording.

    Raises:
        InputError: shapes that do not match, times that do not increase, or an index outside of its array.
    """
    seen = views or Views()
    times = freeze(np.asarray(timeline.time_s, dtype=np.float64).reshape(-1))
    F, V, known = len(times), len(seen.names), about or About()
    recording = Recording(
        folder=known.folder,
        session=known.session,
        rest=known.rest,
        tools=tuple(known.tools),
        **_timeline_fields(timeline, times),
        **_drive_fields(drives or Drives(), F),
        **_marker_fields(markers or MarkerRows((), (), (), ()), F, V),
        **_unnamed_fields(unnamed or UnnamedRows(), F, V),
        **_load_fields(loads or LoadRows(), F),
        **_view_fields(seen, F),
    )
    _check_parts(recording)
    return recording


def select_frames(recording: Recording, which: npt.ArrayLike) -> Recording:
    """Return a recording with some of the frames of another.

    Arguments:
        recording: a recording with F frames.
        which: a mask, shape (F,), or indices from 0 to F − 1.

    Returns:
        the selected frames in order of time.

    Example:
        >>> import femsense as fs
        >>> recording = fs.load_recording(fs.robot_names()["four-leg"] / "recordings" / "demo")  # installed with femsense
        >>> fs.select_frames(recording, range(36, 40)).frame_count
        4
    """
    mask = np.asarray(which)
    kept = np.flatnonzero(mask) if mask.dtype == np.bool_ else np.unique(mask.astype(np.int64))
    if mask.dtype == np.bool_ and mask.shape != (recording.frame_count,):
        raise InputError("the mask has the wrong shape", where="which", found=mask.shape, expected=(recording.frame_count,))
    if len(kept) and (kept[0] < 0 or kept[-1] >= recording.frame_count):
        raise InputError(
            "no such frame", where="which", found=(int(kept[0]), int(kept[-1])), expected=f"0 … {recording.frame_count - 1}"
        )
    new = np.full(recording.frame_count, -1)
    new[kept] = np.arange(len(kept))
    seen = new[recording.marker_frame] >= 0
    loaded = new[recording.load_frame] >= 0
    unnamed = new[recording.unnamed_frame] >= 0
    r = recording
    return replace(
        r,
        frame_numbers=freeze(r.frame_numbers[kept], np.int64),
        time_s=freeze(r.time_s[kept]),
        inputs=freeze(r.inputs[kept]),
        pressures=freeze(r.pressures[kept]),
        free=None if r.free is None else freeze(r.free[kept], np.bool_),
        sweep=None if r.sweep is None else tuple(r.sweep[k] for k in kept),
        gravity=None if r.gravity is None else freeze(r.gravity[kept]),
        marker_frame=freeze(new[r.marker_frame[seen]], np.int64),
        marker_index=freeze(r.marker_index[seen], np.int64),
        marker_view=freeze(r.marker_view[seen], np.int64),
        marker_xyz=freeze(r.marker_xyz[seen]),
        load_frame=freeze(new[r.load_frame[loaded]], np.int64),
        load_points=freeze(r.load_points[loaded]),
        load_forces=freeze(r.load_forces[loaded]),
        cloud_files=tuple(r.cloud_files[k] for k in kept),
        color_files=tuple(r.color_files[k] for k in kept),
        unnamed_frame=freeze(new[r.unnamed_frame[unnamed]], np.int64),
        unnamed_view=freeze(r.unnamed_view[unnamed], np.int64),
        unnamed_xyz=freeze(r.unnamed_xyz[unnamed]),
    )


def with_marker_table(
    recording: Recording,
    names: Sequence[str],
    frame: npt.ArrayLike,
    index: npt.ArrayLike,
    xyz: npt.ArrayLike,
    *,
    view: npt.ArrayLike | None = None,
) -> Recording:
    """Return the recording with other marker observations; see `Recording` for shapes and units. Raises InputError."""
    K = np.asarray(frame).size
    return replace(
        recording,
        marker_names=tuple(names),
        marker_frame=_indices(frame, K, recording.frame_count, "frame"),
        marker_index=_indices(index, K, len(names), "index"),
        marker_view=_indices(np.zeros(K) if view is None else view, K, len(recording.camera_names), "view"),
        marker_xyz=_shaped(xyz, (K, 3), "xyz"),
    )


def state_key(recording: Recording, frame: int) -> bytes:
    """Return a key that differs between frames under different inputs, loads or gravity."""
    rows = recording.load_frame == frame
    parts = [
        recording.inputs[frame],
        recording.pressures[frame],
        recording.load_points[rows].ravel(),
        recording.load_forces[rows].ravel(),
    ]
    if recording.gravity is not None:
        parts.append(recording.gravity[frame])
    return np.concatenate([np.asarray(p, dtype=float).ravel() for p in parts]).tobytes()


def _timeline_fields(timeline: Timeline, times: FloatArray) -> dict[str, Any]:
    t, F = timeline, len(times)
    return {
        "frame_numbers": _shaped(np.arange(F) if t.frame_numbers is None else t.frame_numbers, (F,), "frame_numbers", np.int64),
        "time_s": times,
        "free": None if t.free is None else _shaped(t.free, (F,), "free", np.bool_),
        "sweep": None if t.sweep is None else tuple(str(label) for label in t.sweep),
        "gravity": None if t.gravity is None else _shaped(t.gravity, (F, 3), "gravity"),
    }


def _drive_fields(drives: Drives, F: int) -> dict[str, Any]:
    d, a, c = drives, len(drives.cable_names), len(drives.chamber_names)
    return {
        "actuation": d.actuation,
        "actuation_zero": d.actuation_zero,
        "cable_names": tuple(d.cable_names),
        "inputs": _shaped(np.zeros((F, 0)) if d.inputs is None else d.inputs, (F, a), "inputs"),
        "chamber_names": tuple(d.chamber_names),
        "pressures": _shaped(np.zeros((F, 0)) if d.pressures is None else d.pressures, (F, c), "pressures"),
    }


def _marker_fields(markers: MarkerRows, F: int, V: int) -> dict[str, Any]:
    K = np.asarray(markers.frame).size
    return {
        "marker_names": tuple(markers.names),
        "marker_frame": _indices(markers.frame, K, F, "marker_frame"),
        "marker_index": _indices(markers.index, K, len(markers.names), "marker_index"),
        "marker_view": _indices(np.zeros(K) if markers.view is None else markers.view, K, V, "marker_view"),
        "marker_xyz": _shaped(markers.xyz, (K, 3), "marker_xyz"),
        "marker_noise_m": markers.noise_m,
    }


def _unnamed_fields(unnamed: UnnamedRows, F: int, V: int) -> dict[str, Any]:
    U = np.asarray(unnamed.frame).size
    return {
        "unnamed_frame": _indices(unnamed.frame, U, F, "unnamed_frame"),
        "unnamed_view": _indices(np.zeros(U) if unnamed.view is None else unnamed.view, U, V, "unnamed_view"),
        "unnamed_xyz": _shaped(unnamed.xyz, (U, 3), "unnamed_xyz"),
    }


def _load_fields(loads: LoadRows, F: int) -> dict[str, Any]:
    L = np.asarray(loads.frame).size
    return {
        "load_frame": _indices(loads.frame, L, F, "load_frame"),
        "load_points": _shaped(loads.points, (L, 3), "load_points"),
        "load_forces": _shaped(loads.forces, (L, 3), "load_forces"),
    }


def _view_fields(views: Views, F: int) -> dict[str, Any]:
    V = len(views.names)
    none = ((None,) * V,) * F
    return {
        "camera_names": tuple(views.names),
        "cameras": (None,) * V if views.cameras is None else tuple(views.cameras),
        "T_robot_camera": _poses(views.T_robot_camera, V),
        "cloud_files": none if views.cloud_files is None else tuple(tuple(files) for files in views.cloud_files),
        "color_files": none if views.color_files is None else tuple(tuple(files) for files in views.color_files),
    }


def _poses(poses: Sequence[npt.ArrayLike | None] | None, count: int) -> tuple[FloatArray | None, ...]:
    if poses is None:
        return (None,) * count
    return tuple(None if pose is None else freeze(check_pose(pose, f"T_robot_camera[{i}]")) for i, pose in enumerate(poses))


def _shaped(values: npt.ArrayLike, shape: tuple[int, ...], name: str, dtype: Any = np.float64) -> npt.NDArray[Any]:
    array = freeze(values, dtype)
    if array.size == 0 and 0 in shape:
        return freeze(np.zeros(shape), dtype)
    if array.shape != shape:
        raise InputError(f"{name} has the wrong shape", where=name, found=array.shape, expected=shape)
    if dtype is np.float64 and not np.isfinite(array).all():
        raise InputError(f"{name} must be finite", where=name, found="NaN or inf", expected="finite numbers")
    return array


def _indices(values: npt.ArrayLike, count: int, limit: int, name: str) -> IntArray:
    array = _shaped(values, (count,), name, np.int64)
    if array.size and (array.min() < 0 or array.max() >= limit):
        raise InputError(
            f"{name} out of range", where=name, found=(int(array.min()), int(array.max())), expected=f"0 … {limit - 1}"
        )
    return array


def _check_parts(recording: Recording) -> None:
    """Refuse parts that do not fit together."""
    r = recording
    F, V = r.frame_count, len(r.camera_names)
    if r.actuation not in ("tension", "displacement"):
        raise InputError("unknown actuation", where="actuation", found=r.actuation, expected="tension | displacement")
    if r.actuation_zero not in ("absolute", "unknown"):
        raise InputError("unknown zero", where="actuation_zero", found=r.actuation_zero, expected="absolute | unknown")
    wrong = np.flatnonzero(~np.isfinite(r.time_s[1:]) | ~(np.diff(r.time_s) > 0))
    if len(wrong) or not np.isfinite(r.time_s).all():
        k = int(wrong[0]) if len(wrong) else 0
        times = f"{r.time_s[k : k + 2].tolist()} s from position {k} on"
        raise InputError("time does not increase", where="time_s", found=times, expected="finite, in order of time")
    if len(np.unique(r.frame_numbers)) != F:
        raise InputError("a frame occurs twice", where="frame_numbers", expected="each frame once")
    lengths = {
        "sweep": (F if r.sweep is None else len(r.sweep), F),
        "cloud_files": (len(r.cloud_files), F),
        "color_files": (len(r.color_files), F),
        "cameras": (len(r.cameras), V),
        "T_robot_camera": (len(r.T_robot_camera), V),
    }
    for name, (found, expected) in lengths.items():
        if found != expected:
            raise InputError(f"{name} has the wrong length", where=name, found=found, expected=expected)
