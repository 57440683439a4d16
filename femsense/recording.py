"""A recording folder ↔ Recording: inputs, markers, loads and clouds of frames in order of time."""

from __future__ import annotations

import re
import shutil
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from femsense.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.errors import InputError
from femsense.files import write_beside, write_csv, write_toml
from femsense.pose import check_pose
from femsense.tables import Schema, Table, key_path, near, read_csv, read_toml, schema_problems, validated

if TYPE_CHECKING:
    from femsense.model import Robot
    from femsense.pointcloud.cloud import PointCloud

FORMAT = "femsense-recording-1"
GRAVITY_COLUMNS = ("gravity_x_m_s2", "gravity_y_m_s2", "gravity_z_m_s2")
PLACE_COLUMNS = ("x_m", "y_m", "z_m")
FORCE_COLUMNS = ("fx_n", "fy_n", "fz_n")
LENS_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
FAR_LOAD = 0.25
"""A known load farther from the body than this times the mesh's diagonal is an error."""
TOO_FAR = 50.0
"""A marker farther from its camera than this [m] is in another unit."""
TOO_LONG = 5.0
"""A cable displacement beyond this [m] is in another unit."""


# Types


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
    """OpenCV's k1, k2, p1, p2, k3, shape (5,)."""
    depth_unit: float
    """Metres in one unit of a depth image."""


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

    @property
    def frame_count(self) -> int:
        return len(self.time_s)

    @property
    def has_clouds(self) -> bool:
        """Whether any frame has a cloud or a depth image."""
        return any(file is not None for files in self.cloud_files for file in files)

    @property
    def has_markers(self) -> bool:
        return len(self.marker_frame) > 0


# The tables of recording.toml

Matrix = Annotated[list[Annotated[list[float], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)]
POSE = "4 rows of 4 numbers: maps camera coordinates to robot coordinates, translation in metres"
Pixels = Annotated[int, Field(gt=0)]


class CameraTable(Schema):
    width: Pixels | None = Field(None, description="pixels, > 0")
    height: Pixels | None = Field(None, description="pixels, > 0")
    fx: Annotated[float, Field(gt=0)] | None = Field(None, description="focal length in pixels, > 0")
    fy: Annotated[float, Field(gt=0)] | None = Field(None, description="focal length in pixels, > 0")
    cx: float | None = Field(None, description="principal point in pixels")
    cy: float | None = Field(None, description="principal point in pixels")
    distortion: Annotated[list[float], Field(min_length=5, max_length=5)] = Field(
        default_factory=lambda: [0.0] * 5, description="five numbers in OpenCV's order: k1, k2, p1, p2, k3"
    )
    depth_unit_m: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="metres in one unit of a depth image, such as 0.001"
    )
    T_robot_camera: Matrix | None = Field(None, description=POSE)

    @model_validator(mode="after")
    def _lens_is_complete(self) -> CameraTable:
        missing = [key for key in LENS_KEYS if getattr(self, key) is None]
        if missing and len(missing) < len(LENS_KEYS):
            raise ValueError(f"the camera lacks {', '.join(missing)}")
        return self


class RecordingTable(Schema):
    """recording.toml, version femsense-recording-1."""

    format: Literal["femsense-recording-1"] = Field(description=f'format = "{FORMAT}"')
    actuation: Literal["tension", "displacement"] = Field(
        description='actuation = "tension" (cable columns in N) or "displacement" (in m, > 0 shortens)'
    )
    actuation_zero: Literal["absolute", "unknown"] = Field(
        description='actuation_zero = "absolute" (the values are the true inputs) or "unknown"'
    )
    T_robot_camera: Matrix | None = Field(None, description=POSE)
    camera: CameraTable | None = Field(None, description="a table [camera] with width, height, fx, fy, cx, cy")
    cameras: Annotated[dict[str, CameraTable], Field(min_length=1)] | None = Field(None, description="tables [cameras.NAME]")


# Loading


def load_recording(path: str | Path) -> Recording:
    """Load a recording folder (or its recording.toml). Clouds and images are found, not read.

    Raises:
        InputError: with file, place, what was found and what was expected.
    """
    folder = _recording_folder(Path(path).expanduser())
    toml = folder / "recording.toml"
    document = read_toml(toml)
    table = validated(RecordingTable, document, toml)
    for problem in table_problems(table, toml):
        raise problem
    names, cameras, poses = _views(table, toml)
    frames = _read_frames(folder / "frames.csv", table.actuation)
    numbers = frames["frame_numbers"]
    clouds, colors = _find_clouds(folder, names, numbers)
    _check_depth(clouds, cameras, names, table, toml)
    return make_recording(
        folder=folder.absolute(),
        actuation=table.actuation,
        actuation_zero=table.actuation_zero,
        camera_names=names,
        cameras=cameras,
        T_robot_camera=poses,
        **frames,
        **_read_markers(folder / "markers.csv", names, numbers),
        rest=_read_rest(folder / "rest.csv", names),
        **_read_loads(folder / "loads.csv", numbers),
        cloud_files=clouds,
        color_files=colors,
    )


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
) -> Recording:
    """Return a recording made of its parts; see `Recording` for shapes and units. What is left out is empty or unknown.

    Raises:
        InputError: where shapes do not fit, times do not increase, or an index points nowhere.
    """
    times = freeze(np.asarray(time_s, dtype=np.float64).reshape(-1))
    F, V = len(times), len(camera_names)
    K = np.asarray(marker_frame).size
    L = np.asarray(load_frame).size
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
    )
    _check_parts(recording)
    return recording


def document_problems(document: dict[str, Any], path: Path) -> list[InputError]:
    """Return everything that is wrong with the tables of a recording.toml."""
    problems = schema_problems(RecordingTable, document, path)
    return problems or table_problems(RecordingTable.model_validate(document), path)


def table_problems(table: RecordingTable, path: Path) -> list[InputError]:
    """Return what single keys cannot show: one camera and several, a pose given twice, a pose that is no rotation."""
    problems: list[InputError] = []
    if table.camera is not None and table.cameras is not None:
        problems.append(InputError("both [camera] and [cameras.NAME]", where=path, expected="[camera] for one camera, [cameras.NAME] for several"))  # fmt: skip
    if table.T_robot_camera is not None and table.cameras is not None:
        problems.append(InputError("one pose for several cameras", where=f"{path}: T_robot_camera", expected="T_robot_camera in each [cameras.NAME]"))  # fmt: skip
    if table.T_robot_camera is not None and table.camera is not None and table.camera.T_robot_camera is not None:
        problems.append(InputError("the pose stands twice", where=f"{path}: camera.T_robot_camera", expected="T_robot_camera above [camera]"))  # fmt: skip
    for name in table.cameras or {}:
        if not re.fullmatch(r'[^/\\,;"\s.][^/\\,;"\s]*', name):
            problems.append(InputError("not a name for a camera, which is also the name of its folder", where=f"{path}: cameras", found=repr(name), expected="a name without blanks, slashes, commas and a point at its start"))  # fmt: skip
    for location, pose in _declared_poses(table):
        try:
            check_pose(pose, f"{path}: {key_path(location)}")
        except InputError as problem:
            problems.append(problem)
    return problems


def _recording_folder(path: Path) -> Path:
    folder = path.parent if path.is_file() and path.name == "recording.toml" else path
    if not path.exists():
        names = [item.name for item in path.parent.iterdir()] if path.parent.is_dir() else []
        raise InputError("no such recording", where=path, found="nothing there", expected="a folder with recording.toml", hint=near(path.name, names))  # fmt: skip
    if not (folder / "recording.toml").is_file():
        raise InputError("not a recording: recording.toml is missing", where=folder, expected="recording.toml and frames.csv", hint="femsense import makes a recording of other formats")  # fmt: skip
    return folder


def _declared_poses(table: RecordingTable) -> list[tuple[tuple[str, ...], Any]]:
    poses: list[tuple[tuple[str, ...], Any]] = [(("T_robot_camera",), table.T_robot_camera)]
    poses += [(("camera", "T_robot_camera"), table.camera.T_robot_camera)] if table.camera else []
    poses += [(("cameras", name, "T_robot_camera"), camera.T_robot_camera) for name, camera in (table.cameras or {}).items()]
    return [(location, pose) for location, pose in poses if pose is not None]


def _views(table: RecordingTable, path: Path) -> tuple[tuple[str, ...], tuple[Camera | None, ...], tuple[Any, ...]]:
    """Return names, cameras and poses of the views."""
    if table.cameras is not None:
        items = table.cameras
        return tuple(items), tuple(_camera(n, c) for n, c in items.items()), tuple(c.T_robot_camera for c in items.values())
    if table.camera is None:
        return ("",), (None,), (table.T_robot_camera,)
    pose = table.T_robot_camera if table.T_robot_camera is not None else table.camera.T_robot_camera
    camera = _camera("", table.camera)
    if camera is None:
        raise InputError("the camera lacks its lens", where=f"{path}: camera", found="no width, height, fx, fy, cx, cy", expected=", ".join(LENS_KEYS))  # fmt: skip
    return ("",), (camera,), (pose,)


def _camera(name: str, table: CameraTable) -> Camera | None:
    w, h, fx, fy, cx, cy = table.width, table.height, table.fx, table.fy, table.cx, table.cy
    if w is None or h is None or fx is None or fy is None or cx is None or cy is None:
        return None
    return Camera(name, w, h, fx, fy, cx, cy, freeze(table.distortion), table.depth_unit_m or 0.001)


def _read_frames(path: Path, actuation: str) -> dict[str, Any]:
    """Return the parts of a recording that stand in frames.csv."""
    if not path.is_file():
        raise InputError("frames.csv is missing", where=path, found="no such file", expected="a table frame,time_s,cable_<name>… with one row a frame")  # fmt: skip
    table = read_csv(
        path, required=("frame", "time_s"), optional=("free", "sweep", *GRAVITY_COLUMNS), prefixes=("cable_", "chamber_")
    )
    if not len(table):
        raise InputError("no frames", where=path, found="a header without rows", expected="one row a frame")
    numbers, time_s = table.integers("frame"), table.numbers(["time_s"])[:, 0]
    _check_order(table, numbers, time_s)
    cables = [column for column in table.columns if column.startswith("cable_")]
    chambers = [column for column in table.columns if column.startswith("chamber_")]
    inputs = table.numbers(cables)
    if actuation == "displacement" and inputs.size and np.abs(inputs).max() > TOO_LONG:
        row, column = np.argwhere(np.abs(inputs) > TOO_LONG)[0]
        raise InputError("a cable displacement of this size looks like millimetres", where=table.place(row, cables[column]), found=f"{inputs[row, column]:g} m", expected="metres", hint="divide the column by 1000")  # fmt: skip
    return {
        "frame_numbers": numbers,
        "time_s": time_s,
        "cable_names": [column.removeprefix("cable_") for column in cables],
        "inputs": inputs,
        "chamber_names": [column.removeprefix("chamber_") for column in chambers],
        "pressures": table.numbers(chambers),
        "free": _free(table) if "free" in table.columns else None,
        "sweep": table.text("sweep") if "sweep" in table.columns else None,
        "gravity": _gravity(table),
    }


def _check_order(table: Table, numbers: IntArray, time_s: FloatArray) -> None:
    first: dict[int, int] = {}
    for row, number in enumerate(numbers.tolist()):
        if number in first:
            raise InputError("a frame stands twice", where=table.place(row, "frame"), found=number, expected="each frame once", hint=f"it stands in line {table.lines[first[number]]} too")  # fmt: skip
        first[number] = row
    bad = np.flatnonzero(np.diff(time_s) <= 0)
    if len(bad):
        row = int(bad[0]) + 1
        raise InputError("time does not increase", where=table.place(row, "time_s"), found=f"{time_s[row]:g} s after {time_s[row - 1]:g} s", expected="rows in order of time")  # fmt: skip


def _free(table: Table) -> BoolArray:
    cells = table.text("free")
    bad = next((row for row, cell in enumerate(cells) if cell not in ("0", "1")), None)
    if bad is not None:
        raise InputError("neither 0 nor 1", where=table.place(bad, "free"), found=cells[bad] or "an empty cell", expected="1 where nothing touches the robot, else 0")  # fmt: skip
    return np.array([cell == "1" for cell in cells], dtype=bool)


def _gravity(table: Table) -> FloatArray | None:
    given = [column for column in GRAVITY_COLUMNS if column in table.columns]
    if given and len(given) < 3:
        raise InputError("gravity needs its three columns", where=f"{table.path}, header", found=", ".join(given), expected=", ".join(GRAVITY_COLUMNS))  # fmt: skip
    return table.numbers(GRAVITY_COLUMNS) if given else None


def _read_markers(path: Path, views: tuple[str, ...], numbers: IntArray) -> dict[str, Any]:
    """Return the parts of a recording that stand in markers.csv."""
    if not path.is_file():
        return {}
    table = read_csv(path, required=("frame", "marker", *PLACE_COLUMNS), optional=("camera",))
    frame = _frame_indices(table, numbers)
    names, index = _named(table)
    view = _view_indices(table, views)
    xyz = table.numbers(PLACE_COLUMNS)
    _check_metres(table, xyz)
    keys = np.stack([frame, index, view], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    if len(first) < len(keys):
        row = int(np.setdiff1d(np.arange(len(keys)), first)[0])
        raise InputError("a marker stands twice in one frame", where=table.place(row), found=f"frame {numbers[frame[row]]}, marker {names[index[row]]!r}", expected="one row a frame and marker")  # fmt: skip
    return {"marker_names": names, "marker_frame": frame, "marker_index": index, "marker_view": view, "marker_xyz": xyz}


def _read_rest(path: Path, views: tuple[str, ...]) -> RestMarkers | None:
    if not path.is_file():
        return None
    table = read_csv(path, required=("marker", *PLACE_COLUMNS), optional=("std_m", "camera"))
    xyz, view = table.numbers(PLACE_COLUMNS), _view_indices(table, views)
    _check_metres(table, xyz)
    std = table.numbers(["std_m"], empty_is_nan=True)[:, 0] if "std_m" in table.columns else np.full(len(table), np.nan)
    if (std < 0).any():
        row = int(np.flatnonzero(std < 0)[0])
        raise InputError("a standard deviation below zero", where=table.place(row, "std_m"), found=float(std[row]), expected="≥ 0 m")  # fmt: skip
    names, index = _named(table)
    seen = {}
    for row, key in enumerate(zip(index.tolist(), view.tolist())):
        if key in seen:
            raise InputError("a marker stands twice", where=table.place(row, "marker"), found=names[key[0]], expected="one row a marker")  # fmt: skip
        seen[key] = row
    return RestMarkers(tuple(names[i] for i in index), freeze(xyz), freeze(std), freeze(view, np.int64))


def _read_loads(path: Path, numbers: IntArray) -> dict[str, Any]:
    """Return the parts of a recording that stand in loads.csv."""
    if not path.is_file():
        return {}
    table = read_csv(path, required=("frame", *PLACE_COLUMNS, *FORCE_COLUMNS))
    return {
        "load_frame": _frame_indices(table, numbers),
        "load_points": table.numbers(PLACE_COLUMNS),
        "load_forces": table.numbers(FORCE_COLUMNS),
    }


def _frame_indices(table: Table, numbers: IntArray) -> IntArray:
    """Return the column `frame` as indices into frames.csv, shape (rows,)."""
    row_of = {number: row for row, number in enumerate(numbers.tolist())}
    wanted = table.integers("frame").tolist()
    for row, number in enumerate(wanted):
        if number not in row_of:
            span = f"a frame of frames.csv ({numbers.min()} … {numbers.max()})"
            raise InputError(
                "a frame that frames.csv does not have", where=table.place(row, "frame"), found=number, expected=span
            )
    return np.array([row_of[number] for number in wanted], dtype=np.int64)


def _named(table: Table) -> tuple[list[str], IntArray]:
    """Return the markers in the order of their first appearance, and the index of each row's marker."""
    cells = table.text("marker")
    if "" in cells:
        raise InputError("a marker without a name", where=table.place(cells.index(""), "marker"), found="an empty cell", expected="a name")  # fmt: skip
    number = {name: i for i, name in enumerate(dict.fromkeys(cells))}
    return list(number), np.array([number[cell] for cell in cells], dtype=np.int64)


def _view_indices(table: Table, views: tuple[str, ...]) -> IntArray:
    if "camera" not in table.columns:
        if len(views) > 1:
            raise InputError("which camera saw these markers?", where=f"{table.path}, header", found=", ".join(table.columns), expected=f"a column camera with one of: {', '.join(views)}")  # fmt: skip
        return np.zeros(len(table), dtype=np.int64)
    cells = table.text("camera")
    for row, cell in enumerate(cells):
        if cell not in views:
            raise InputError("a camera that recording.toml does not have", where=table.place(row, "camera"), found=cell or "an empty cell", expected=", ".join(views) if views != ("",) else "no column camera, or [cameras.NAME] in recording.toml", hint=near(cell, views))  # fmt: skip
    return np.array([views.index(cell) for cell in cells], dtype=np.int64)


def _check_metres(table: Table, xyz: FloatArray) -> None:
    far = np.flatnonzero(np.abs(xyz).max(axis=1, initial=0.0) > TOO_FAR)
    if not len(far):
        return
    most = len(far) > 0.2 * len(xyz)
    what = "coordinates of this size look like millimetres" if most else "a marker this far away is not plausible"
    hint = "divide x, y and z by 1000" if most else "leave the row out where the marker was lost"
    raise InputError(what, where=table.place(int(far[0])), found=xyz[far[0]].tolist(), expected=f"metres in the camera frame, below {TOO_FAR:g}", hint=hint)  # fmt: skip


# Clouds


def read_frame_cloud(recording: Recording, k: int, *, view: int = 0) -> PointCloud | None:
    """Return the cloud of frame k (an index 0 … F − 1) in the frame of its camera; None where the frame has none.

    Arguments:
        recording: the recording.
        k: index of the frame.
        view: index of the camera.

    Raises:
        InputError: a file that is broken, or of another size than the camera table says.
    """
    file = recording.cloud_files[k][view]
    if file is None:
        return None
    if file.suffix.lower() == ".png":
        return _cloud_of_images(file, recording.color_files[k][view], recording.cameras[view])
    from femsense.pointcloud.cloud import read_cloud

    try:
        return read_cloud(file)
    except InputError:
        raise
    except Exception as error:
        raise InputError("not readable as a cloud", where=file, found=f"{type(error).__name__}: {error}", expected="a PLY or PCD file") from None  # fmt: skip


def read_png(path: Path) -> npt.NDArray[Any]:
    """Return a PNG image as it is: shape (H, W), or (H, W, 3) in the order blue, green, red. Raises InputError where it is broken."""
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    _check_png(data, path)
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError("not readable as an image", where=path, found=f"{len(data)} bytes", expected="a PNG image")
    return np.asarray(image)


def png_header(path: Path) -> tuple[int, int, int, int] | None:
    """Return (width, height, bits a channel, colour type) of a PNG image; None where the file is none."""
    with path.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        return None
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"), head[24], head[25]


def _cloud_of_images(depth_file: Path, color_file: Path | None, camera: Camera | None) -> PointCloud:
    from femsense.pointcloud.cloud import cloud_from_depth

    if camera is None:
        raise InputError("a depth image without a camera", where=depth_file, expected="a table [camera] in recording.toml")
    depth = read_png(depth_file)
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise InputError("not a depth image", where=depth_file, found=f"{depth.dtype}, shape {depth.shape}", expected="one channel of 16 bits")  # fmt: skip
    _check_image_size(depth.shape[1], depth.shape[0], camera, depth_file)
    color = None
    if color_file is not None:
        image = read_png(color_file)
        _check_image_size(image.shape[1], image.shape[0], camera, color_file)
        color = np.stack([image] * 3, axis=2) if image.ndim == 2 else image[:, :, 2::-1]
    c = camera
    return cloud_from_depth(depth, c.fx, c.fy, c.cx, c.cy, c.distortion, c.depth_unit, color=color)


def _check_image_size(width: int, height: int, camera: Camera, file: Path) -> None:
    if (width, height) != (camera.width, camera.height):
        raise InputError("the image has another size than the camera table says", where=file, found=f"{width} × {height}", expected=f"{camera.width} × {camera.height}", hint="the intrinsics belong to one size: use those of this one")  # fmt: skip


def _check_png(data: bytes, path: Path) -> None:
    """Refuse a PNG that is cut off or damaged: decoders return such images half filled."""
    position = 8
    while data[:8] == b"\x89PNG\r\n\x1a\n" and position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        body, mark = data[position + 4 : end - 4], data[end - 4 : end]
        if end > len(data) or zlib.crc32(body) != int.from_bytes(mark, "big"):
            break
        if body[:4] == b"IEND":
            return
        position = end
    raise InputError("a broken image", where=path, found=f"damaged or cut off at byte {position} of {len(data)}", expected="a whole PNG image", hint="leave the file out: the frame then has no cloud")  # fmt: skip


def _find_clouds(folder: Path, views: tuple[str, ...], numbers: IntArray) -> tuple[Any, Any]:
    """Return the cloud (or depth) files and the colour files of each frame and view."""
    clouds, colors = [], []
    for name in views:
        found = numbered_files(folder / "clouds" / name, (".ply", ".pcd"))
        depth = numbered_files(folder / "depth" / name, (".png",))
        color = numbered_files(folder / "color" / name, (".png",))
        clouds.append([found.get(n) or depth.get(n) for n in numbers.tolist()])
        colors.append([color.get(n) if n not in found and n in depth else None for n in numbers.tolist()])
    return tuple(zip(*clouds)), tuple(zip(*colors))


def numbered_files(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder by the number that is their name."""
    files: dict[int, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        if file.name.startswith(".") or file.suffix.lower() not in endings or not file.is_file():
            continue
        if not re.fullmatch("[0-9]+", file.stem):
            raise InputError(
                "the name is not a frame number", where=file, found=file.name, expected=f"such as 000000{endings[0]}"
            )
        if int(file.stem) in files:
            raise InputError("two files for one frame", where=file, found=f"{files[int(file.stem)].name} and {file.name}", expected="one file a frame")  # fmt: skip
        files[int(file.stem)] = file
    return files


def _check_depth(clouds: Any, cameras: Sequence[Camera | None], views: Sequence[str], table: RecordingTable, toml: Path) -> None:
    """Check what depth images need of recording.toml, on the first whole image of each view."""
    for v, name in enumerate(views):
        images = [files[v] for files in clouds if files[v] is not None and files[v].suffix.lower() == ".png"]
        if not images:
            continue
        key = f"cameras.{name}" if name else "camera"
        camera = cameras[v]
        declared = (table.cameras or {}).get(name) if name else table.camera
        if camera is None or declared is None:
            raise InputError("there are depth images, but no camera", where=f"{toml}: {key}", found=f"{len(images)} images in {images[0].parent}", expected=f"a table [{key}] with {', '.join(LENS_KEYS)}, depth_unit_m")  # fmt: skip
        if declared.depth_unit_m is None:
            raise InputError("a required key is missing", where=f"{toml}: {key}.depth_unit_m", found="nothing", expected="metres in one unit of the depth images, such as 0.001")  # fmt: skip
        header = next((h for h in map(png_header, images) if h is not None), None)
        if header is not None:
            _check_image_size(header[0], header[1], camera, images[0])
            if header[2:] != (16, 0):
                raise InputError("not a depth image", where=images[0], found=f"{header[2]} bits a channel, colour type {header[3]}", expected="one channel of 16 bits")  # fmt: skip


# Parts, selections


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
        raise InputError("no such frame", where="which", found=(int(kept[0]), int(kept[-1])), expected=f"0 … {recording.frame_count - 1}")  # fmt: skip
    new = np.full(recording.frame_count, -1)
    new[kept] = np.arange(len(kept))
    seen = new[recording.marker_frame] >= 0
    loaded = new[recording.load_frame] >= 0
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
        raise InputError(f"{name} out of range", where=name, found=(int(array.min()), int(array.max())), expected=f"0 … {limit - 1}")  # fmt: skip
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
    lengths = {"sweep": (F if r.sweep is None else len(r.sweep), F), "cloud_files": (len(r.cloud_files), F),
               "color_files": (len(r.color_files), F), "cameras": (len(r.cameras), V), "T_robot_camera": (len(r.T_robot_camera), V)}  # fmt: skip
    for name, (found, expected) in lengths.items():
        if found != expected:
            raise InputError(f"{name} has the wrong length", where=name, found=found, expected=expected)


# Against a robot


def check_against(robot: Robot, recording: Recording) -> Recording:
    """Return the recording as this robot needs it: cables in the robot's order, without markers that the robot lacks.

    Warns of markers that are dropped and of inputs beyond the cables' limits.

    Raises:
        InputError: other cables than the robot's, no marker in common, a known load far from the body.
    """
    fitted = _without_strangers(robot, _with_cable_order(robot, recording))
    _check_loads(robot, fitted)
    _warn_of_inputs(robot, fitted)
    return fitted


def _place(recording: Recording, file: str) -> str:
    return str(recording.folder / file) if recording.folder else file


def _with_cable_order(robot: Robot, recording: Recording) -> Recording:
    wanted = robot.body.cable_names
    if set(wanted) != set(recording.cable_names):
        lacking = [name for name in wanted if name not in recording.cable_names]
        extra = [name for name in recording.cable_names if name not in wanted]
        parts = [f"lacks {', '.join(lacking)}"] if lacking else []
        parts += [f"has {', '.join(extra)} that the robot has not"] if extra else []
        raise InputError(
            f"other cables than those of the robot {robot.name!r}: the recording {' and '.join(parts)}",
            where=_place(recording, "frames.csv"),
            found=", ".join(f"cable_{name}" for name in recording.cable_names) or "no cable columns",
            expected=", ".join(f"cable_{name}" for name in wanted) or "no cable columns",
            hint=near(extra[0], wanted) if extra else "a cable that was slack has a column of zeros",
        )
    order = [recording.cable_names.index(name) for name in wanted]
    return replace(recording, cable_names=wanted, inputs=freeze(recording.inputs[:, order]))


def _without_strangers(robot: Robot, recording: Recording) -> Recording:
    """Return the recording without the markers that the robot lacks."""
    known = set(robot.marker_names)
    strangers = [name for name in recording.marker_names if name not in known]
    if recording.has_markers and len(strangers) == len(recording.marker_names):
        raise InputError(f"no marker that the robot {robot.name!r} has", where=_place(recording, "markers.csv"),
                         found=", ".join(recording.marker_names), expected=", ".join(robot.marker_names) or "the robot declares no [[markers]]",
                         hint=near(strangers[0], robot.marker_names))  # fmt: skip
    result = _without_rest_strangers(known, recording)
    if not strangers:
        return result
    warnings.warn(f"{_place(recording, 'markers.csv')}: markers that the robot {robot.name!r} lacks are left out: {', '.join(strangers)}", stacklevel=3)  # fmt: skip
    names = [name for name in recording.marker_names if name in known]
    kept = np.array([recording.marker_names[i] in known for i in recording.marker_index], dtype=bool)
    index = [names.index(recording.marker_names[i]) for i in recording.marker_index[kept]]
    r = recording
    return with_marker_table(result, names, r.marker_frame[kept], np.array(index, dtype=np.int64), r.marker_xyz[kept], view=r.marker_view[kept])  # fmt: skip


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
        raise InputError("a known load is far from the body", where=f"{_place(recording, 'loads.csv')}, frame {recording.frame_numbers[k]}",
                         found=f"{places[worst].tolist()} m, {1e3 * outside[worst]:.4g} mm outside", expected=f"a place on the body at rest, robot frame, at most {250 * diagonal:.4g} mm outside",
                         hint="this looks like millimetres: places are in metres" if looks else "loads are in the robot frame, not the camera's")  # fmt: skip


def _warn_of_inputs(robot: Robot, recording: Recording) -> None:
    """Warn of tensions beyond what the cables are declared for."""
    if recording.actuation != "tension" or recording.actuation_zero != "absolute":
        return
    for j, cable in enumerate(robot.body.cables):
        tension = recording.inputs[:, j]
        if tension.max(initial=-np.inf) > cable.max_tension * (1 + 1e-9):
            warnings.warn(f"{_place(recording, 'frames.csv')}: cable {cable.name!r} reaches {tension.max():.4g} N, more than its max_tension_n of {cable.max_tension:.4g} N", stacklevel=3)  # fmt: skip
        if tension.min(initial=np.inf) < 0:
            warnings.warn(f"{_place(recording, 'frames.csv')}: cable {cable.name!r} goes down to {tension.min():.4g} N; a cable cannot push", stacklevel=3)  # fmt: skip


# Saving


def save_recording(recording: Recording, folder: str | Path, *, fill: Callable[[Path], None] | None = None) -> Path:
    """Write a recording folder; what stood there before is replaced as a whole, and only when all is written.

    Arguments:
        recording: the recording; its cloud, depth and colour files are copied.
        folder: the final place.
        fill: called with the unfinished folder, to write further files there (clouds, truth) before it gets its name.

    Returns:
        the folder.
    """
    final = Path(folder)
    with write_beside(final) as part:
        part.mkdir()
        write_toml(part / "recording.toml", recording_document(recording))
        _write_frames(recording, part / "frames.csv")
        _write_markers(recording, part / "markers.csv")
        _write_rest(recording, part / "rest.csv")
        _write_loads(recording, part / "loads.csv")
        _copy_clouds(recording, part)
        if fill is not None:
            fill(part)
    return final


def recording_document(recording: Recording) -> dict[str, Any]:
    """Return the plain tables of recording.toml."""
    document: dict[str, Any] = {"format": FORMAT, "actuation": recording.actuation, "actuation_zero": recording.actuation_zero}
    tables = [_camera_document(camera) for camera in recording.cameras]
    poses = [None if pose is None else pose.tolist() for pose in recording.T_robot_camera]
    if recording.camera_names == ("",):
        if poses[0] is not None:
            document["T_robot_camera"] = poses[0]
        return document | ({"camera": tables[0]} if tables[0] else {})
    document["cameras"] = {
        name: table | ({} if pose is None else {"T_robot_camera": pose})
        for name, table, pose in zip(recording.camera_names, tables, poses)
    }
    return document


def _camera_document(camera: Camera | None) -> dict[str, Any]:
    if camera is None:
        return {}
    table: dict[str, Any] = {key: getattr(camera, key) for key in LENS_KEYS}
    return table | {"distortion": camera.distortion.tolist(), "depth_unit_m": camera.depth_unit}


def _write_frames(recording: Recording, path: Path) -> None:
    r = recording
    columns: Mapping[str, Any] = {
        "frame": r.frame_numbers.tolist(),
        "time_s": r.time_s.tolist(),
        **{f"cable_{name}": r.inputs[:, j].tolist() for j, name in enumerate(r.cable_names)},
        **{f"chamber_{name}": r.pressures[:, j].tolist() for j, name in enumerate(r.chamber_names)},
        **({} if r.free is None else {"free": r.free.astype(int).tolist()}),
        **({} if r.sweep is None else {"sweep": r.sweep}),
        **({} if r.gravity is None else {name: r.gravity[:, j].tolist() for j, name in enumerate(GRAVITY_COLUMNS)}),
    }
    write_csv(path, list(columns), zip(*columns.values()))


def _write_markers(recording: Recording, path: Path) -> None:
    if not recording.has_markers:
        return
    r, named = recording, recording.camera_names != ("",)
    rows = (
        [r.frame_numbers[f], *([r.camera_names[v]] if named else []), r.marker_names[i], *xyz]
        for f, i, v, xyz in zip(r.marker_frame, r.marker_index, r.marker_view, r.marker_xyz.tolist())
    )
    write_csv(path, ["frame", *(["camera"] if named else []), "marker", *PLACE_COLUMNS], rows)


def _write_rest(recording: Recording, path: Path) -> None:
    rest, named = recording.rest, recording.camera_names != ("",)
    if rest is None:
        return
    with_std = bool(np.isfinite(rest.std).any())
    columns = ["marker", *(["camera"] if named else []), *PLACE_COLUMNS, *(["std_m"] if with_std else [])]
    rows = (
        [name, *([recording.camera_names[v]] if named else []), *xyz, *([std] if with_std else [])]
        for name, v, xyz, std in zip(rest.names, rest.view, rest.positions.tolist(), rest.std.tolist())
    )
    write_csv(path, columns, rows)


def _write_loads(recording: Recording, path: Path) -> None:
    r = recording
    if not len(r.load_frame):
        return
    rows = ([r.frame_numbers[f], *p, *n] for f, p, n in zip(r.load_frame, r.load_points.tolist(), r.load_forces.tolist()))
    write_csv(path, ["frame", *PLACE_COLUMNS, *FORCE_COLUMNS], rows)


def _copy_clouds(recording: Recording, folder: Path) -> None:
    """Copy cloud, depth and colour files under the names that the format gives them."""
    for k, number in enumerate(recording.frame_numbers.tolist()):
        for v, name in enumerate(recording.camera_names):
            file, color = recording.cloud_files[k][v], recording.color_files[k][v]
            if file is not None:
                kind = "depth" if file.suffix.lower() == ".png" else "clouds"
                _copy(file, folder / kind / name / f"{number:06d}{file.suffix.lower()}")
            if color is not None:
                _copy(color, folder / "color" / name / f"{number:06d}{color.suffix.lower()}")


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
