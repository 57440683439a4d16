"""A recording folder ↔ Recording. The tables of recording.toml are in `recording_toml`, the clouds in `frame_clouds`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.clouds.frame_clouds import find_clouds
from femsense.io.clouds.images import check_image_size, png_header
from femsense.io.files import write_beside, write_csv, write_toml
from femsense.io.recording_toml import (
    LENS_KEYS,
    PER_METRE,
    RecordingTable,
    recording_document,
    table_problems,
    tool_file,
    tools_of,
    views_of,
)
from femsense.io.tables import Table, read_csv, read_toml, validated
from femsense.model.recording import Camera, Recording, RestMarkers, Tool, make_recording

GRAVITY_COLUMNS = ("gravity_x_m_s2", "gravity_y_m_s2", "gravity_z_m_s2")
PLACE_COLUMNS = ("x_m", "y_m", "z_m")
FORCE_COLUMNS = ("fx_n", "fy_n", "fz_n")
TOO_FAR = 50.0
"""A marker farther from its camera than this [m] is in another unit."""
TOO_LONG = 5.0
"""A cable displacement beyond this [m] is in another unit."""


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
    names, cameras, poses = views_of(table, toml)
    frames = _read_frames(folder / "frames.csv", table.actuation)
    numbers = frames["frame_numbers"]
    clouds, colors = find_clouds(folder, names, numbers)
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
        marker_noise_m=table.marker_noise_m,
        session=table.session,
        tools=tools_of(table, toml),
    )


def _recording_folder(path: Path) -> Path:
    folder = path.parent if path.is_file() and path.name == "recording.toml" else path
    if not path.exists():
        names = [item.name for item in path.parent.iterdir()] if path.parent.is_dir() else []
        raise InputError(
            "no such recording",
            where=path,
            found="nothing there",
            expected="a folder with recording.toml",
            hint=did_you_mean(path.name, names),
        )
    if not (folder / "recording.toml").is_file():
        raise InputError(
            "not a recording: recording.toml is missing",
            where=folder,
            expected="recording.toml and frames.csv",
            hint="femsense import makes a recording of other formats",
        )
    return folder


def _read_frames(path: Path, actuation: str) -> dict[str, Any]:
    """Return the parts of a recording that stand in frames.csv."""
    if not path.is_file():
        raise InputError(
            "frames.csv is missing",
            where=path,
            found="no such file",
            expected="a table frame,time_s,cable_<name>… with one row a frame",
        )
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
        raise InputError(
            "a cable displacement of this size looks like millimetres",
            where=table.place(row, cables[column]),
            found=f"{inputs[row, column]:g} m",
            expected="metres",
            hint="divide the column by 1000",
        )
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
            raise InputError(
                "a frame stands twice",
                where=table.place(row, "frame"),
                found=number,
                expected="each frame once",
                hint=f"it stands in line {table.lines[first[number]]} too",
            )
        first[number] = row
    bad = np.flatnonzero(np.diff(time_s) <= 0)
    if len(bad):
        row = int(bad[0]) + 1
        raise InputError(
            "time does not increase",
            where=table.place(row, "time_s"),
            found=f"{time_s[row]:g} s after {time_s[row - 1]:g} s",
            expected="rows in order of time",
        )


def _free(table: Table) -> BoolArray:
    cells = table.text("free")
    bad = next((row for row, cell in enumerate(cells) if cell not in ("0", "1")), None)
    if bad is not None:
        raise InputError(
            "neither 0 nor 1",
            where=table.place(bad, "free"),
            found=cells[bad] or "an empty cell",
            expected="1 where nothing touches the robot, else 0",
        )
    return np.array([cell == "1" for cell in cells], dtype=bool)


def _gravity(table: Table) -> FloatArray | None:
    given = [column for column in GRAVITY_COLUMNS if column in table.columns]
    if given and len(given) < 3:
        raise InputError(
            "gravity needs its three columns",
            where=f"{table.path}, header",
            found=", ".join(given),
            expected=", ".join(GRAVITY_COLUMNS),
        )
    return table.numbers(GRAVITY_COLUMNS) if given else None


def _read_markers(path: Path, views: tuple[str, ...], numbers: IntArray) -> dict[str, Any]:
    """Return the parts of a recording that stand in markers.csv."""
    if not path.is_file():
        return {}
    table = read_csv(path, required=("frame", "marker", *PLACE_COLUMNS), optional=("camera",))
    frame = _frame_indices(table, numbers)
    view = _view_indices(table, views)
    xyz = table.numbers(PLACE_COLUMNS)
    _check_metres(table, xyz)
    unnamed = _unnamed(table, frame, numbers)
    parts = {"unnamed_frame": frame[unnamed], "unnamed_view": view[unnamed], "unnamed_xyz": xyz[unnamed]}
    table, frame, view, xyz = table.without(unnamed), frame[~unnamed], view[~unnamed], xyz[~unnamed]
    names, index = _named(table)
    keys = np.stack([frame, index, view], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    if len(first) < len(keys):
        row = int(np.setdiff1d(np.arange(len(keys)), first)[0])
        raise InputError(
            "a marker stands twice in one frame",
            where=table.place(row),
            found=f"frame {numbers[frame[row]]}, marker {names[index[row]]!r}",
            expected="one row a frame and marker",
        )
    named = {"marker_names": names, "marker_frame": frame, "marker_index": index, "marker_view": view, "marker_xyz": xyz}
    return {**named, **parts}


def _unnamed(table: Table, frame: IntArray, numbers: IntArray) -> BoolArray:
    """Return which rows name no marker, shape (rows,). Raises InputError where a frame has both kinds."""
    empty = np.array([not cell for cell in table.text("marker")], dtype=bool)
    mixed = np.flatnonzero(empty & np.isin(frame, frame[~empty]))
    if len(mixed):
        raise InputError(
            "a marker without a name beside markers with names",
            where=table.place(int(mixed[0]), "marker"),
            found=f"an empty cell in frame {numbers[frame[mixed[0]]]}",
            expected="a name, or empty cells in all rows of the frame, where nobody knows which marker is which",
        )
    return empty


def _read_rest(path: Path, views: tuple[str, ...]) -> RestMarkers | None:
    if not path.is_file():
        return None
    table = read_csv(path, required=("marker", *PLACE_COLUMNS), optional=("std_m", "camera"))
    xyz, view = table.numbers(PLACE_COLUMNS), _view_indices(table, views)
    _check_metres(table, xyz)
    std = table.numbers(["std_m"], empty_is_nan=True)[:, 0] if "std_m" in table.columns else np.full(len(table), np.nan)
    if (std < 0).any():
        row = int(np.flatnonzero(std < 0)[0])
        raise InputError(
            "a standard deviation below zero", where=table.place(row, "std_m"), found=float(std[row]), expected="≥ 0 m"
        )
    names, index = _named(table)
    seen = {}
    for row, key in enumerate(zip(index.tolist(), view.tolist())):
        if key in seen:
            raise InputError(
                "a marker stands twice", where=table.place(row, "marker"), found=names[key[0]], expected="one row a marker"
            )
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
        raise InputError(
            "a marker without a name", where=table.place(cells.index(""), "marker"), found="an empty cell", expected="a name"
        )
    number = {name: i for i, name in enumerate(dict.fromkeys(cells))}
    return list(number), np.array([number[cell] for cell in cells], dtype=np.int64)


def _view_indices(table: Table, views: tuple[str, ...]) -> IntArray:
    if "camera" not in table.columns:
        if len(views) > 1:
            raise InputError(
                "which camera saw these markers?",
                where=f"{table.path}, header",
                found=", ".join(table.columns),
                expected=f"a column camera with one of: {', '.join(views)}",
            )
        return np.zeros(len(table), dtype=np.int64)
    cells = table.text("camera")
    for row, cell in enumerate(cells):
        if cell not in views:
            raise InputError(
                "a camera that recording.toml does not have",
                where=table.place(row, "camera"),
                found=cell or "an empty cell",
                expected=", ".join(views) if views != ("",) else "no column camera, or [cameras.NAME] in recording.toml",
                hint=did_you_mean(cell, views),
            )
    return np.array([views.index(cell) for cell in cells], dtype=np.int64)


def _check_metres(table: Table, xyz: FloatArray) -> None:
    far = np.flatnonzero(np.abs(xyz).max(axis=1, initial=0.0) > TOO_FAR)
    if not len(far):
        return
    most = len(far) > 0.2 * len(xyz)
    what = "coordinates of this size look like millimetres" if most else "a marker this far away is not plausible"
    hint = "divide x, y and z by 1000" if most else "leave the row out where the marker was lost"
    raise InputError(
        what,
        where=table.place(int(far[0])),
        found=xyz[far[0]].tolist(),
        expected=f"metres in the camera frame, below {TOO_FAR:g}",
        hint=hint,
    )


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
            raise InputError(
                "there are depth images, but no camera",
                where=f"{toml}: {key}",
                found=f"{len(images)} images in {images[0].parent}",
                expected=f"a table [{key}] with {', '.join(LENS_KEYS)}, depth_unit_m",
            )
        if declared.depth_unit_m is None:
            raise InputError(
                "a required key is missing",
                where=f"{toml}: {key}.depth_unit_m",
                found="nothing",
                expected="metres in one unit of the depth images, such as 0.001",
            )
        header = next((h for h in map(png_header, images) if h is not None), None)
        if header is not None:
            check_image_size(header[0], header[1], camera, images[0])
            if header[2:] != (16, 0):
                raise InputError(
                    "not a depth image",
                    where=images[0],
                    found=f"{header[2]} bits a channel, colour type {header[3]}",
                    expected="one channel of 16 bits",
                )


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
        _copy_tools(recording, part)
        if fill is not None:
            fill(part)
    return final


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
    if not recording.has_markers and not len(recording.unnamed_frame):
        return
    r, named = recording, recording.camera_names != ("",)
    rows = (
        [r.frame_numbers[f], *([r.camera_names[v]] if named else []), r.marker_names[i], *xyz]
        for f, i, v, xyz in zip(r.marker_frame, r.marker_index, r.marker_view, r.marker_xyz.tolist())
    )
    unnamed = (
        [r.frame_numbers[f], *([r.camera_names[v]] if named else []), "", *xyz]
        for f, v, xyz in zip(r.unnamed_frame, r.unnamed_view, r.unnamed_xyz.tolist())
    )
    write_csv(path, ["frame", *(["camera"] if named else []), "marker", *PLACE_COLUMNS], chain(rows, unnamed))


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


def _copy_tools(recording: Recording, folder: Path) -> None:
    for tool in recording.tools:
        if tool.mesh_file is not None:
            _copy(tool.mesh_file, folder / tool_file(tool))
        elif tool.kind == "mesh":
            _write_off(tool, folder / tool_file(tool))


def _write_off(tool: Tool, path: Path) -> None:
    """Write a mesh as OFF, which keeps all digits, in the tool's unit."""
    rows = [" ".join(map(repr, row)) for row in (tool.points * PER_METRE[tool.mesh_unit]).tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in tool.triangles.tolist()]
    path.write_text("\n".join(["OFF", f"{len(tool.points)} {len(tool.triangles)} 0", *rows, ""]), encoding="utf-8")


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
