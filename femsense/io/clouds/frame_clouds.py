"""The cloud of a frame, from a PLY, PCD or XYZ file or from a depth image, read on demand."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.io.clouds.images import check_image_size, read_color_levels, read_png
from femsense.io.tables import beside
from femsense.model.camera import Camera
from femsense.model.recording import Recording

if TYPE_CHECKING:
    from femsense.pointcloud.cloud import PointCloud


FOLDERS = {"clouds": (".ply", ".pcd", ".xyz"), "depth": (".png",), "color": (".png", ".jpg", ".jpeg")}
"""Folders of a recording → suffixes of the files that are read there."""
SPARSE = 4
"""Pixels of a whole frame that are looked at for each point that is asked for: some show nothing, some the robot."""
BESIDE = (".txt", ".md", ".json", ".toml", ".csv", ".yaml", ".yml")
"""Suffixes of other files that are allowed next to clouds and images."""


def read_frame_cloud(recording: Recording, k: int, *, view: int = 0, mixed: bool = True) -> PointCloud | None:
    """Return the cloud of frame k (an index 0 … F − 1) in the frame of its camera; None where the frame has none.

    Arguments:
        recording: the recording.
        k: index of the frame.
        view: index of the camera.
        mixed: keep pixels that mix two surfaces (see `without_mixed_pixels`, and for files `without_mixed_points`).

    Raises:
        InputError: a broken file, or one whose size differs from the camera table.
    """
    file = recording.cloud_files[k][view]
    if file is None:
        return None
    if file.suffix.lower() == ".png":
        return _cloud_of(*_images(file, recording.color_files[k][view], recording.cameras[view]), mixed=mixed)
    from femsense.io.clouds.cloud_files import read_cloud
    from femsense.pointcloud.pixel_grid import without_mixed_points

    try:
        cloud = read_cloud(file)
        return cloud if mixed else without_mixed_points(cloud)
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            "not readable as a cloud", where=file, found=f"{type(error).__name__}: {error}", expected="a PLY, PCD or XYZ file"
        ) from None


def read_frame_parts(
    recording: Recording, k: int, *, view: int, T: FloatArray, box: FloatArray, some: int
) -> tuple[PointCloud, FloatArray] | None:
    """Return the cloud of frame k about a body, without mixed pixels, and points of the whole frame [m], (m, 3); None where the frame has no cloud.

    Of a depth image only what lies in a box becomes a cloud, and of the whole frame every so many-th pixel: a frame has ten times as many as are used.

    Arguments:
        recording, k, view: as for `read_frame_cloud`.
        T: pose of the camera in the frame of the box, shape (4, 4).
        box: lower and upper corner [m], shape (2, 3); the cloud may hold points outside.
        some: points of the whole frame, at least, where it has as many.

    Raises:
        InputError: as for `read_frame_cloud`.
    """
    file = recording.cloud_files[k][view]
    if file is None or file.suffix.lower() != ".png":
        cloud = read_frame_cloud(recording, k, view=view, mixed=False)
        return None if cloud is None else (cloud, cloud.points)
    depth, color, camera = _images(file, recording.color_files[k][view], recording.cameras[view])
    step = max(1, int(np.sqrt(depth.size / (SPARSE * some))))
    every = replace(camera, fx=camera.fx / step, fy=camera.fy / step, cx=camera.cx / step, cy=camera.cy / step)
    near = _cloud_of(depth, color, camera, mixed=False, within=(T, *box))
    return near, _cloud_of(depth[::step, ::step], None, every, mixed=True).points


def _images(depth_file: Path, color_file: Path | None, camera: Camera | None) -> tuple[Any, Any, Camera]:
    """Return the depth image, the colour image or None, and their camera. Raises InputError."""
    if camera is None:
        raise InputError("a depth image without a camera", where=depth_file, expected="a table [camera] in recording.toml")
    depth = read_png(depth_file)
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise InputError(
            "not a depth image", where=depth_file, found=f"{depth.dtype}, shape {depth.shape}", expected="one channel of 16 bits"
        )
    check_image_size(depth.shape[1], depth.shape[0], camera, depth_file)
    color = None
    if color_file is not None:
        color = read_color_levels(color_file)
        check_image_size(color.shape[1], color.shape[0], camera, color_file)
    return depth, color, camera


def _cloud_of(depth: Any, color: Any, camera: Camera, *, mixed: bool, within: Any = None) -> PointCloud:
    from femsense.pointcloud.cloud import cloud_from_depth, without_mixed_pixels

    c, model = camera, camera.distortion_model
    seen = depth if mixed else without_mixed_pixels(depth, c.fx, c.fy)
    lens = (c.fx, c.fy, c.cx, c.cy, c.distortion, c.depth_unit)
    return cloud_from_depth(seen, *lens, color=color, distortion_model=model, within=within)


def find_clouds(folder: Path, views: tuple[str, ...], numbers: IntArray) -> tuple[Any, Any]:
    """Return the cloud (or depth) files and the colour files of each frame and view."""
    clouds, colors = [], []
    for name in views:
        places = {kind: beside(folder / kind / "frames", name) for kind in FOLDERS}
        found, depth, color = (numbered_files(places[kind], endings) for kind, endings in FOLDERS.items())
        for kind, endings in FOLDERS.items():
            _warn_of_unread(places[kind], endings)
        clouds.append([found.get(n) or depth.get(n) for n in numbers.tolist()])
        colors.append([color.get(n) if n not in found and n in depth else None for n in numbers.tolist()])
    return tuple(zip(*clouds)), tuple(zip(*colors))


def _warn_of_unread(folder: Path, endings: tuple[str, ...]) -> None:
    """Warn of files that are neither read nor notes."""
    files = [file for file in folder.iterdir() if file.is_file() and file.name[0] != "."] if folder.is_dir() else []
    others = Counter(file.suffix.lower() or "no ending" for file in files if file.suffix.lower() not in (*endings, *BESIDE))
    if others:
        found = ", ".join(f"{count} × {ending}" for ending, count in others.items())
        warnings.warn(
            f"{folder}: files that are not read: {found}; what is read there ends in {', '.join(endings)}", stacklevel=4
        )


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
            raise InputError(
                "two files for one frame",
                where=file,
                found=f"{files[int(file.stem)].name} and {file.name}",
                expected="one file a frame",
            )
        files[int(file.stem)] = file
    return files
