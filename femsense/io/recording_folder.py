"""A recording folder ↔ Recording. Its parts: `recording_toml`, `recording_tables` (the CSV files), `clouds/frame_clouds`."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.core.units import PER_METRE
from femsense.io.checkpoint import UNFINISHED
from femsense.io.clouds.frame_clouds import find_clouds
from femsense.io.clouds.images import check_image_size, png_header
from femsense.io.files import check_own, check_target, followed, write_beside, write_toml
from femsense.io.recording_tables import (
    read_frames,
    read_loads,
    read_markers,
    read_rest,
    write_frames,
    write_loads,
    write_markers,
    write_rest,
)
from femsense.io.recording_toml import (
    LENS_KEYS,
    RecordingTable,
    recording_document,
    table_problems,
    tool_file,
    tools_of,
    views_of,
)
from femsense.io.tables import read_toml, validated
from femsense.model.camera import Camera
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import About, Tool, Views

OWN_FILES = re.compile(
    rf"recording\.toml|(frames|markers|rest|loads|sensors)\.csv|tool-[^/]+|{re.escape(UNFINISHED)}"
    r"|(clouds|depth|color)/([^/]+/)?\d{6,}\.\w+|truth/(truth\.json|(contacts|markers)\.csv|states\.npz)"
)
"""Names of the files that `save_recording` and the virtual rig write: only these are replaced."""

# Loading


def load_recording(path: str | Path) -> Recording:
    """Load a recording: times, inputs of the cables and chambers, markers and camera data of one experiment.

    Clouds and images are read later, frame by frame, so that long recordings need little memory.

    Arguments:
        path: the folder of the recording, or its recording.toml.

    Returns:
        the recording, in SI units, markers in the frames of their cameras.

    Raises:
        InputError: a file is missing or invalid; the error states file, row, value found and value expected.

    Example:
        >>> import femsense as fs
        >>> recording = fs.load_recording(fs.robot_names()["four-leg"] / "recordings" / "demo")  # or a path of your own
        >>> recording
        Recording(44 frames, 43 s; north, west, south, east [tension]; 16 markers; clouds)
        >>> recording.inputs.shape  # tensions of 44 frames and 4 cables [N]
        (44, 4)
    """
    folder = _recording_folder(Path(path).expanduser())
    toml = folder / "recording.toml"
    document = read_toml(toml)
    table = validated(RecordingTable, document, toml)
    for problem in table_problems(table, toml):
        raise problem
    names, cameras, poses = views_of(table, toml)
    timeline, drives = read_frames(folder / "frames.csv", table.actuation, table.actuation_zero)
    numbers = np.asarray(timeline.frame_numbers)
    clouds, colors = find_clouds(folder, names, numbers)
    _check_depth(clouds, cameras, names, table, toml)
    markers, unnamed = read_markers(folder / "markers.csv", names, numbers, table.marker_noise_m)
    rest = read_rest(folder / "rest.csv", names)
    return make_recording(
        timeline,
        drives=drives,
        markers=markers,
        unnamed=unnamed,
        loads=read_loads(folder / "loads.csv", numbers),
        views=Views(names, cameras, poses, clouds, colors),
        about=About(folder.absolute(), table.session, rest, tools_of(table, toml)),
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


def _check_depth(clouds: Any, cameras: Sequence[Camera | None], views: Sequence[str], table: RecordingTable, toml: Path) -> None:
    """Check the entries of recording.toml that depth images need, on the first whole image of each view."""
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
    """Write a recording to a folder. An earlier recording there is replaced as a whole, after all files are written.

    Arguments:
        recording: the recording; its cloud, depth and colour files are copied.
        folder: the folder to create.
        fill: function that is called with the path of the unfinished folder, to write further files (clouds, truth) into it. Default: none.

    Returns:
        the path of the folder.

    Raises:
        InputError: the folder is not writable, or it contains files that do not belong to a recording.
    """
    final = Path(folder)
    check_target(final, folder=True)
    check_own(followed(final), OWN_FILES, "a recording that femsense wrote")
    with write_beside(final) as part:
        part.mkdir()
        write_toml(part / "recording.toml", recording_document(recording))
        write_frames(recording, part / "frames.csv")
        write_markers(recording, part / "markers.csv")
        write_rest(recording, part / "rest.csv")
        write_loads(recording, part / "loads.csv")
        _copy_clouds(recording, part)
        _copy_tools(recording, part)
        if fill is not None:
            fill(part)
    return final


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
