"""What was recorded: frames with their inputs, markers, loads and clouds; parts of it, and whether it fits a robot."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import femsense
from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose
from femsense.core.text import did_you_mean

if TYPE_CHECKING:
    from femsense.model.robot import Robot

SLOW = 5.0
"""Frames that are farther apart than this [s] are more likely counted in milliseconds: cameras take 5 to 90 a second."""
LONG_PULL = 0.5
"""A cable that moves farther than this [m] is more likely given in millimetres or centimetres."""
FAR_LOAD = 0.25
"""A known load farther from the body than this times the mesh's diagonal is an error."""


def _no_indices() -> IntArray:
    return freeze(np.zeros(0), np.int64)


def _no_points() -> FloatArray:
    return freeze(np.zeros((0, 3)))


@dataclass(frozen=True, eq=False, slots=True)
class CameraNoise:
    """What a single depth is off by, as one standard deviation over the distance z."""

    kind: str
    """"stereo": at_1m · z²;  "tof": floor + slope · z."""
    at_1m: float = 0.0
    """[m] at z = 1 m; 0 where the kind is "tof"."""
    floor: float = 0.0
    """[m]; 0 where the kind is "stereo"."""
    slope: float = 0.0
    """[m/m]; 0 where the kind is "stereo"."""

    def std(self, depth: npt.ArrayLike) -> FloatArray:
        """Return one standard deviation [m] of depths z [m], of the same shape."""
        z = np.asarray(depth, dtype=np.float64)
        return self.at_1m * z**2 if self.kind == "stereo" else self.floor + self.slope * z


@dataclass(frozen=True, eq=False, slots=True)
class Tool:
    """A body of known shape that may touch the robot. Its frame: a ball's centre; a cylinder's centre and axis z; the mesh's own."""

    name: str
    kind: str
    """"ball", "cylinder" or "mesh"."""
    radius: float = 0.0
    """Of a ball or a cylinder [m]; 0 for a mesh."""
    length: float = 0.0
    """Of a cylinder [m]; 0 for others."""
    points: FloatArray = field(default_factory=_no_points)
    """Of a mesh [m], shape (n, 3)."""
    triangles: IntArray = field(default_factory=lambda: freeze(np.zeros((0, 3)), np.int64))
    """Of a mesh, a closed surface, outward, shape (t, 3)."""
    mesh_file: Path | None = None
    """Where the mesh was read; None where it was made in Python."""
    mesh_unit: str = "m"
    """Unit of the coordinates in that file."""


@dataclass(frozen=True, eq=False, slots=True)
class Camera:
    """A pinhole camera; the centre of the first pixel is (0, 0)."""

    name: str
    """"" where there is one camera."""
    width: int
    """[px]."""
    height: int
    """[px]."""
    fx: float
    """[px]."""
    fy: float
    """[px]."""
    cx: float
    """[px]."""
    cy: float
    """[px]."""
    distortion: FloatArray
    """OpenCV's k1, k2, p1, p2, k3, shape (5,), with k4, k5, k6 shape (8,); k1 … k4 and 0 where the model is "kannala_brandt"."""
    depth_unit: float
    """Metres in one unit of a depth image."""
    distortion_model: str = "brown_conrady"
    """"brown_conrady", "inverse_brown_conrady" (the same polynomial takes bent rays to straight ones) or "kannala_brandt"."""
    noise: CameraNoise | None = None
    """What a single depth is off by; None where not known."""


@dataclass(frozen=True, eq=False, slots=True)
class RestMarkers:
    """Markers measured with the body unloaded, camera frame."""

    names: tuple[str, ...]
    positions: FloatArray
    """[m], shape (r, 3)."""
    std: FloatArray
    """One standard deviation [m], shape (r,); NaN where it is not given."""
    view: IntArray
    """Index of the camera, shape (r,)."""


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """F frames in order of time, seen by one camera or several (views)."""

    folder: Path | None
    """Where it was read; None where it was made in Python."""
    actuation: str
    """What `inputs` holds: "tension" [N] or "displacement" [m, > 0 shortens]."""
    actuation_zero: str
    """"absolute": the values are the true inputs; "unknown": they count from an unknown initial input."""
    camera_names: tuple[str, ...]
    """One a view; ("",) where there is one camera without a name."""
    cameras: tuple[Camera | None, ...]
    """One a view; None where the lens is not known."""
    T_robot_camera: tuple[FloatArray | None, ...]
    """One a view, shape (4, 4); None where the pose is not known."""
    frame_numbers: IntArray
    """As in frames.csv, shape (F,)."""
    time_s: FloatArray
    """[s], increasing, shape (F,)."""
    cable_names: tuple[str, ...]
    inputs: FloatArray
    """[N] or [m], shape (F, a)."""
    chamber_names: tuple[str, ...]
    pressures: FloatArray
    """[Pa], shape (F, c)."""
    free: BoolArray | None
    """Frames in which nothing undeclared touches the robot, shape (F,); None where not known."""
    sweep: tuple[str, ...] | None
    """A label for each frame: what is held out together; None where not given."""
    gravity: FloatArray | None
    """In the robot frame [m/s²], shape (F, 3); None: as the robot declares."""
    marker_names: tuple[str, ...]
    """In the order of their first appearance."""
    marker_frame: IntArray
    """Frame of each marker observation, an index 0 … F − 1, shape (K,)."""
    marker_index: IntArray
    """Its marker, an index into marker_names, shape (K,)."""
    marker_view: IntArray
    """Its camera, an index into camera_names, shape (K,)."""
    marker_xyz: FloatArray
    """Its place in that camera's frame [m], shape (K, 3)."""
    rest: RestMarkers | None
    load_frame: IntArray
    """Frame of each known load, an index 0 … F − 1, shape (L,)."""
    load_points: FloatArray
    """Its place on the body at rest, robot frame [m], shape (L, 3)."""
    load_forces: FloatArray
    """Its force, robot frame [N], shape (L, 3)."""
    cloud_files: tuple[tuple[Path | None, ...], ...]
    """Cloud or depth image of each frame and view; None where there is none."""
    color_files: tuple[tuple[Path | None, ...], ...]
    """Colour image that goes with a depth image, the same shape."""
    marker_noise_m: float | None = None
    """What a marker repeats to along each axis [m]; None where not given."""
    session: str | None = None
    """Recordings of one session share what a session shares; None where not given."""
    tools: tuple[Tool, ...] = ()
    """What may touch the robot, where it is known."""
    unnamed_frame: IntArray = field(default_factory=_no_indices)
    """Frame of each marker that nobody named, an index 0 … F − 1, shape (U,); such rows are not among marker_xyz."""
    unnamed_view: IntArray = field(default_factory=_no_indices)
    """Its camera, an index into camera_names, shape (U,)."""
    unnamed_xyz: FloatArray = field(default_factory=_no_points)
    """Its place in that camera's frame [m], shape (U, 3)."""

    @property
    def label(self) -> str:
        """What values of their own in each recording go by: its session, else the name of its folder; "" where it has neither."""
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
    *,
    time_s: npt.ArrayLike,
    frame_numbers: npt.ArrayLike | None = None,
    folder: Path | None = None,
    actuation: str = "tension",
    actuation_zero: str = "absolute",
    camera_names: Sequence[str] = ("",),
    cameras: Sequence[Camera | None] | None = None,
    T_robot_camera: Sequence[npt.ArrayLike | None] | None = None,
    cable_names: Sequence[str] = (),
    inputs: npt.ArrayLike | None = None,
    chamber_names: Sequence[str] = (),
    pressures: npt.ArrayLike | None = None,
    free: npt.ArrayLike | None = None,
    sweep: Sequence[str] | None = None,
    gravity: npt.ArrayLike | None = None,
    marker_names: Sequence[str] = (),
    marker_frame: npt.ArrayLike = (),
    marker_index: npt.ArrayLike = (),
    marker_view: npt.ArrayLike | None = None,
    marker_xyz: npt.ArrayLike = (),
    rest: RestMarkers | None = None,
    load_frame: npt.ArrayLike = (),
    load_points: npt.ArrayLike = (),
    load_forces: npt.ArrayLike = (),
    cloud_files: Sequence[Sequence[Path | None]] | None = None,
    color_files: Sequence[Sequence[Path | None]] | None = None,
    marker_noise_m: float | None = None,
    session: str | None = None,
    tools: Sequence[Tool] = (),
    unnamed_frame: npt.ArrayLike = (),
    unnamed_view: npt.ArrayLike | None = None,
    unnamed_xyz: npt.ArrayLike = (),
) -> Recording:
    """Return a recording made of its parts; see `Recording` for shapes and units. What is left out is empty or unknown.

    Raises:
        InputError: where shapes do not fit, times do not increase, or an index points nowhere.
    """
    times = freeze(np.asarray(time_s, dtype=np.float64).reshape(-1))
    F, V = len(times), len(camera_names)
    K = np.asarray(marker_frame).size
    L, U = np.asarray(load_frame).size, np.asarray(unnamed_frame).size
    none_files = ((None,) * V,) * F
    recording = Recording(
        folder=folder,
        actuation=actuation,
        actuation_zero=actuation_zero,
        camera_names=tuple(camera_names),
        cameras=tuple(cameras) if cameras is not None else (None,) * V,
        T_robot_camera=_poses(T_robot_camera, V),
        frame_numbers=_shaped(np.arange(F) if frame_numbers is None else frame_numbers, (F,), "frame_numbers", np.int64),
        time_s=times,
        cable_names=tuple(cable_names),
        inputs=_shaped(np.zeros((F, 0)) if inputs is None else inputs, (F, len(cable_names)), "inputs"),
        chamber_names=tuple(chamber_names),
        pressures=_shaped(np.zeros((F, 0)) if pressures is None else pressures, (F, len(chamber_names)), "pressures"),
        free=None if free is None else _shaped(free, (F,), "free", np.bool_),
        sweep=None if sweep is None else tuple(str(label) for label in sweep),
        gravity=None if gravity is None else _shaped(gravity, (F, 3), "gravity"),
        marker_names=tuple(marker_names),
        marker_frame=_indices(marker_frame, K, F, "marker_frame"),
        marker_index=_indices(marker_index, K, len(marker_names), "marker_index"),
        marker_view=_indices(np.zeros(K) if marker_view is None else marker_view, K, V, "marker_view"),
        marker_xyz=_shaped(marker_xyz, (K, 3), "marker_xyz"),
        rest=rest,
        load_frame=_indices(load_frame, L, F, "load_frame"),
        load_points=_shaped(load_points, (L, 3), "load_points"),
        load_forces=_shaped(load_forces, (L, 3), "load_forces"),
        cloud_files=none_files if cloud_files is None else tuple(tuple(files) for files in cloud_files),
        color_files=none_files if color_files is None else tuple(tuple(files) for files in color_files),
        marker_noise_m=marker_noise_m,
        session=session,
        tools=tuple(tools),
        unnamed_frame=_indices(unnamed_frame, U, F, "unnamed_frame"),
        unnamed_view=_indices(np.zeros(U) if unnamed_view is None else unnamed_view, U, V, "unnamed_view"),
        unnamed_xyz=_shaped(unnamed_xyz, (U, 3), "unnamed_xyz"),
    )
    _check_parts(recording)
    return recording


def select_frames(recording: Recording, which: npt.ArrayLike) -> Recording:
    """Return the recording of some of its frames, in order of time.

    Arguments:
        recording: the recording.
        which: a mask, shape (F,), or indices 0 … F − 1.
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


def marker_grid(recording: Recording, *, view: int = 0) -> FloatArray:
    """Return the markers as one camera saw them [m], camera frame, shape (F, markers, 3); NaN where hidden."""
    grid = np.full((recording.frame_count, len(recording.marker_names), 3), np.nan)
    mine = recording.marker_view == view
    grid[recording.marker_frame[mine], recording.marker_index[mine]] = recording.marker_xyz[mine]
    return grid


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
    if not np.isfinite(r.time_s).all() or (np.diff(r.time_s) <= 0).any():
        raise InputError("time does not increase", where="time_s", expected="finite, in order of time")
    if len(np.unique(r.frame_numbers)) != F:
        raise InputError("a frame stands twice", where="frame_numbers", expected="each frame once")
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


# Whether the numbers can be meant


def warn_of_values(recording: Recording) -> None:
    """Warn of times, displacements and signs that can be computed with but are hardly meant."""
    r, where = recording, _place(recording, "frames.csv")
    steps = np.diff(r.time_s)
    if len(steps) and np.median(steps) > SLOW:
        text = f"one frame every {np.median(steps):.4g} s by the column time_s; is it in milliseconds?"
        warnings.warn(f"{where}: {text}", stacklevel=3)
    if r.actuation != "displacement":
        return
    for name, pulled in zip(r.cable_names, r.inputs.T):
        longest = float(np.abs(pulled).max(initial=0.0))
        if longest > LONG_PULL:
            text = f"cable {name!r} moves by up to {longest:.4g} m; are displacements in millimetres?"
            warnings.warn(f"{where}: {text}", stacklevel=3)
        back, forth = int((pulled < 0).sum()), int((pulled > 0).sum())
        if r.actuation_zero == "absolute" and back > forth:
            text = (
                f"cable {name!r} is slack in {len(pulled) - forth} of {len(pulled)} frames, its displacement below zero in {back}"
            )
            warnings.warn(f"{where}: {text}; is the sign right? > 0 shortens", stacklevel=3)


# Against a robot


def check_against(robot: Robot, recording: Recording) -> Recording:
    """Return the recording as this robot needs it: cables and chambers in the robot's order, without markers that the robot lacks.

    Warns of markers that are dropped, of inputs beyond the limits of cables and chambers, and of numbers that are hardly meant.

    Raises:
        InputError: other cables or chambers than the robot's, no marker in common, a known load far from the body.
    """
    fitted = _without_strangers(robot, _with_chamber_order(robot, _with_cable_order(robot, recording)))
    _check_loads(robot, fitted)
    _check_displacements(robot, fitted)
    _warn_of_inputs(robot, fitted)
    warn_of_values(fitted)
    return fitted


def _place(recording: Recording, file: str) -> str:
    return str(recording.folder / file) if recording.folder else file


def _with_cable_order(robot: Robot, recording: Recording) -> Recording:
    wanted = robot.body.cable_names
    order = _drive_order(robot, recording, "cable", wanted, recording.cable_names)
    return replace(recording, cable_names=wanted, inputs=freeze(recording.inputs[:, order]))


def _with_chamber_order(robot: Robot, recording: Recording) -> Recording:
    wanted = robot.body.chamber_names
    order = _drive_order(robot, recording, "chamber", wanted, recording.chamber_names)
    return replace(recording, chamber_names=wanted, pressures=freeze(recording.pressures[:, order]))


def _drive_order(robot: Robot, recording: Recording, kind: str, wanted: tuple[str, ...], given: tuple[str, ...]) -> list[int]:
    """Return where the robot's cables or chambers stand among the columns."""
    if set(wanted) != set(given):
        lacking = [name for name in wanted if name not in given]
        extra = [name for name in given if name not in wanted]
        parts = [f"lacks {', '.join(lacking)}"] if lacking else []
        parts += [f"has {', '.join(extra)} that the robot has not"] if extra else []
        idle = "a cable that was slack" if kind == "cable" else "a chamber without pressure"
        raise InputError(
            f"other {kind}s than those of the robot {robot.name!r}: the recording {' and '.join(parts)}",
            where=_place(recording, "frames.csv"),
            found=", ".join(f"{kind}_{name}" for name in given) or f"no {kind} columns",
            expected=", ".join(f"{kind}_{name}" for name in wanted) or f"no {kind} columns",
            hint=did_you_mean(extra[0], wanted) if extra else f"{idle} has a column of zeros",
        )
    return [given.index(name) for name in wanted]


def _without_strangers(robot: Robot, recording: Recording) -> Recording:
    """Return the recording without the markers that the robot lacks."""
    known = set(robot.marker_names)
    strangers = [name for name in recording.marker_names if name not in known]
    if recording.has_markers and len(strangers) == len(recording.marker_names):
        raise InputError(
            f"no marker that the robot {robot.name!r} has",
            where=_place(recording, "markers.csv"),
            found=", ".join(recording.marker_names),
            expected=", ".join(robot.marker_names) or "the robot declares no [[markers]]",
            hint=did_you_mean(strangers[0], robot.marker_names),
        )
    result = _without_rest_strangers(known, recording)
    if not strangers:
        return result
    warnings.warn(
        f"{_place(recording, 'markers.csv')}: markers that the robot {robot.name!r} lacks are left out: {', '.join(strangers)}",
        stacklevel=3,
    )
    names = [name for name in recording.marker_names if name in known]
    kept = np.array([recording.marker_names[i] in known for i in recording.marker_index], dtype=bool)
    index = [names.index(recording.marker_names[i]) for i in recording.marker_index[kept]]
    r = recording
    return with_marker_table(
        result, names, r.marker_frame[kept], np.array(index, dtype=np.int64), r.marker_xyz[kept], view=r.marker_view[kept]
    )


def _without_rest_strangers(known: set[str], recording: Recording) -> Recording:
    rest = recording.rest
    if rest is None or known.issuperset(rest.names):
        return recording
    lost = sorted(set(rest.names) - known)
    warnings.warn(f"{_place(recording, 'rest.csv')}: markers that the robot lacks are left out: {', '.join(lost)}", stacklevel=4)
    kept = np.array([name in known for name in rest.names], dtype=bool)
    names = tuple(name for name in rest.names if name in known)
    left = RestMarkers(names, freeze(rest.positions[kept]), freeze(rest.std[kept]), freeze(rest.view[kept], np.int64))
    return replace(recording, rest=left if names else None)


def _check_loads(robot: Robot, recording: Recording) -> None:
    from femsense.fem.mesh import embed_points

    if not len(recording.load_points):
        return
    places = np.unique(recording.load_points, axis=0)
    outside = embed_points(robot.body.mesh, places).outside
    diagonal = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    worst = int(outside.argmax())
    if outside[worst] > FAR_LOAD * diagonal:
        k = int(recording.load_frame[(recording.load_points == places[worst]).all(axis=1)][0])
        looks = np.abs(places[worst]).max() > 20 * np.abs(robot.body.mesh.nodes).max()
        raise InputError(
            "a known load is far from the body",
            where=f"{_place(recording, 'loads.csv')}, frame {recording.frame_numbers[k]}",
            found=f"{places[worst].tolist()} m, {1e3 * outside[worst]:.4g} mm outside",
            expected=f"a place on the body at rest, robot frame, at most {250 * diagonal:.4g} mm outside",
            hint="this looks like millimetres: places are in metres"
            if looks
            else "loads are in the robot frame, not the camera's",
        )


def _check_displacements(robot: Robot, recording: Recording) -> None:
    """Refuse a cable that is shortened by more than its length. Raises InputError."""
    if recording.actuation != "displacement":
        return
    for cable, pulled in zip(robot.body.cables, recording.inputs.T):
        points = np.vstack([cable.path.positions(robot.body.mesh.nodes), cable.pull_point])
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        span = float(np.ptp(pulled)) if recording.actuation_zero == "unknown" else float(pulled.max(initial=0.0))
        if span > max(length, 1e-3):
            raise InputError(
                f"cable {cable.name!r} is shortened by more than its length",
                where=_place(recording, "frames.csv"),
                found=f"{span:.4g} m",
                expected=f"less than {length:.4g} m from its far end to its pull point",
                hint="this looks like millimetres: displacements are in metres" if span > 5 * length else None,
            )


def _warn_of_inputs(robot: Robot, recording: Recording) -> None:
    """Warn of pressures and tensions beyond what chambers and cables are declared for."""
    for j, chamber in enumerate(robot.body.chambers):
        highest = recording.pressures[:, j].max(initial=-np.inf)
        if highest > chamber.max_pressure * (1 + 1e-9):
            warnings.warn(
                f"{_place(recording, 'frames.csv')}: chamber {chamber.name!r} reaches {highest:.4g} Pa, more than its max_pressure_pa of {chamber.max_pressure:.4g} Pa",
                stacklevel=3,
            )
    if recording.actuation != "tension":
        return
    for j, cable in enumerate(robot.body.cables):
        tension = recording.inputs[:, j]
        if recording.actuation_zero != "absolute":
            span = max(float(tension.max(initial=0.0)), 0.0) - min(float(tension.min(initial=0.0)), 0.0)
            if span > (cable.max_tension - cable.min_tension) * (1 + 1e-9):
                warnings.warn(
                    f"{_place(recording, 'frames.csv')}: the tensions of cable {cable.name!r} span {span:.4g} N, more than from its min_tension_n to its max_tension_n",
                    stacklevel=3,
                )
            continue
        if tension.max(initial=-np.inf) > cable.max_tension * (1 + 1e-9):
            warnings.warn(
                f"{_place(recording, 'frames.csv')}: cable {cable.name!r} reaches {tension.max():.4g} N, more than its max_tension_n of {cable.max_tension:.4g} N",
                stacklevel=3,
            )
        if tension.min(initial=np.inf) < 0:
            warnings.warn(
                f"{_place(recording, 'frames.csv')}: cable {cable.name!r} goes down to {tension.min():.4g} N; a cable cannot push",
                stacklevel=3,
            )
