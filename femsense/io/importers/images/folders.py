"""Folders: TUM RGB-D, Redwood, and clouds in PLY, PCD, XYZ, NPY or NPZ."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import CLOUD_ENDINGS, read_cloud, viewpoint_doubt
from femsense.io.clouds.images import decoded_image, png_header, read_png
from femsense.io.importers.frames import FARTHEST, DepthImage, Format, Frame, Images, Source, camera_of_numbers, unit_of
from femsense.io.importers.images.array_clouds import read_array_cloud
from femsense.io.importers.images.intrinsics import FILES, JSON_NAMES, lens_line, lens_text, read_lens
from femsense.io.importers.options import Options
from femsense.io.importers.tables.input_samples import nearest_in_time
from femsense.model.camera import Camera
from femsense.model.plausibility import RANGES
from femsense.pointcloud.cloud import PointCloud

ENDINGS = (".ply", ".pcd", ".xyz", ".npy", ".npz")
TUM_UNIT = 1 / 5000
"""Metres in one unit of a TUM RGB-D depth image."""
REDWOOD_UNIT = 1 / 1000
WIDEST = 20.0
"""Scenes of cameras are not wider [m]."""
DEFAULT_LENS = camera_of_numbers(640, 480, (525.0, 525.0), (319.5, 239.5))
"""The lens that the TUM benchmark gives for all its sequences, and Redwood for its own."""
PAIRS = ("associations.txt", "associated.txt", "associate.txt", "association.txt")
"""Lists of pairs as `associate.py` of TUM RGB-D prints them: time file time file, depth first or second."""
NEAR_S = 0.02
"""Images of TUM RGB-D belong together up to this time apart, as its own `associate.py` has it."""


def is_tum(path: Path, head: bytes = b"") -> bool:
    """Whether a folder is one of TUM RGB-D."""
    return (path / "depth").is_dir() and any((path / name).is_file() for name in ("depth.txt", *PAIRS))


def _is_redwood(path: Path, head: bytes) -> bool:
    return (path / "depth").is_dir() and any((path / "depth").glob("*.png"))


def _is_clouds(path: Path, head: bytes) -> bool:
    return bool(_cloud_files(path)) if path.is_dir() else path.suffix.lower() in ENDINGS


def open_tum(folder: Path, options: Options) -> Source:
    """Return a TUM RGB-D folder (depth.txt and rgb.txt, associated by time, or a list of pairs) as a source.

    Raises InputError.
    """
    depth, color = _lists(folder)
    header = png_header(folder / depth[0][1]) if (folder / depth[0][1]).is_file() else None
    if header is None:
        raise InputError("the first depth image is missing or none", where=folder / depth[0][1], expected="a PNG of 16 bits")
    lens, notes = _folder_lens(folder, header[0], header[1])
    unit, said = _unit_of_depth(folder, options, TUM_UNIT)
    _warn_of_distance(folder / depth[0][1], unit, said, "TUM")
    pairs = _associated(depth, color)
    lost = sum(c is None for _, _, c in pairs) if color else 0
    found = {"depth_unit_m": unit, "images_without_colour": lost or None, "lens": lens_line(lens)}
    frames = partial(_image_frames, [(t, folder / d, folder / c if c else None) for t, d, c in pairs], lens)
    return Source(folder, frames, found=found, camera=replace(lens, depth_unit=unit), count=len(pairs), notes=notes)


def open_redwood(folder: Path, options: Options) -> Source:
    """Return a folder with depth/ and color/ in Redwood's or Open3D's layout as a source. Raises InputError."""
    depth = _numbered(folder / "depth", (".png",))
    colors = next((folder / n for n in ("color", "image", "rgb") if (folder / n).is_dir()), None)
    images = [] if colors is None else _numbered(colors, (".png", ".jpg", ".jpeg"))
    header = png_header(depth[0])
    if header is None or header[2:] != (16, 0):
        raise InputError("not a depth image", where=depth[0], found=header and f"{header[2]} bits", expected="a PNG of 16 bits")
    lens, notes = _folder_lens(folder, header[0], header[1])
    unit, said = _unit_of_depth(folder, options, REDWOOD_UNIT)
    _warn_of_distance(depth[0], unit, said, "Redwood")
    times = _file_times(depth)
    if times is None and options.rate is None:
        raise InputError(
            "no times", where=folder / "depth", found=depth[0].name, expected="--rate HZ, the camera's frames a second"
        )
    color_of = _color_of(depth, images)
    clock = times if times is not None else [i / (options.rate or 1.0) for i in range(len(depth))]
    items = [(clock[i], file, color_of.get(file)) for i, file in enumerate(depth)]
    found = {
        "depth_unit_m": unit,
        "lens": lens_line(lens),
        "times": "in the names of the files" if times is not None else f"{options.rate:g} a second",
    }
    return Source(
        folder,
        partial(_image_frames, items, lens),
        found=found,
        camera=replace(lens, depth_unit=unit),
        count=len(items),
        notes=notes,
    )


def open_clouds(folder: Path, options: Options) -> Source:
    """Return a folder of clouds (or one file of them) as a source; times from names, times.txt or a rate. Raises InputError."""
    files = [folder] if folder.is_file() else _cloud_files(folder)
    if not files:
        raise InputError("no clouds", where=folder, expected=", ".join(ENDINGS))
    times = _cloud_times(folder, files, options)
    doubt = viewpoint_doubt(files[0])
    if doubt is not None:
        warnings.warn(doubt, stacklevel=3)
    scale = _unit_of_clouds(files[0], options)
    frames = [Frame(t, picture=partial(_scaled_cloud, file, scale)) for t, file in zip(times, files)]
    endings = sorted({file.suffix.lower() for file in files})
    return Source(
        folder, lambda: iter(frames), found={"files": ", ".join(endings), "unit": options.unit or "m"}, count=len(files)
    )


def read_points(file: Path) -> PointCloud:
    """Return the cloud of a PLY, PCD, XYZ, NPY or NPZ file in the file's unit. Raises InputError."""
    ending = file.suffix.lower()
    return read_cloud(file) if ending in CLOUD_ENDINGS else read_array_cloud(file)


# Images


def _image_frames(items: Sequence[tuple[float, Path, Path | None]], lens: Camera) -> Iterator[Frame]:
    for time, depth, color in items:
        yield Frame(time, picture=partial(_images, depth, color, lens))


def _images(depth: Path, color: Path | None, lens: Camera) -> Images:
    image = _depth_image(depth)
    if image.shape != (lens.height, lens.width):
        raise InputError(
            "a depth image of another size than the first",
            where=depth,
            found=f"{image.shape[1]} × {image.shape[0]}",
            expected=f"{lens.width} × {lens.height}, which the lens is for",
        )
    if color is None or not color.is_file():
        return Images(image)
    pixels = decoded_image(color.read_bytes(), color)
    if pixels.shape != (*image.shape, 3):
        raise InputError(
            "the colour image does not fit",
            where=color,
            found=pixels.shape,
            expected=(*image.shape, 3),
            hint="register it to the depth image",
        )
    return Images(image, pixels)


def _depth_image(file: Path) -> DepthImage:
    if not file.is_file():
        raise InputError("a depth image is missing", where=file, found="no such file")
    image = read_png(file)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(
            "not a depth image",
            where=file,
            found=f"{image.dtype}, shape {image.shape}",
            expected="one channel of 16 bits",
            hint="depth that was packed as 8 bits is lost" if image.dtype == np.uint8 else None,
        )
    return np.asarray(image)


def _lists(folder: Path) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Return (time [s], file) of the depth images and of the colour images."""
    pairs = next((folder / name for name in PAIRS if (folder / name).is_file()), None)
    if (folder / "depth.txt").is_file() or pairs is None:
        return _list(folder / "depth.txt"), _list(folder / "rgb.txt") if (folder / "rgb.txt").is_file() else []
    first, second = _list(pairs), _list(pairs, 2)
    return (first, second) if first[0][1].startswith("depth") else (second, first)


def _list(path: Path, column: int = 0) -> list[tuple[float, str]]:
    """Return (time [s], file) of each line of a list of TUM RGB-D, from a column on."""
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            found.append((float(words[column]), words[column + 1]))
        except (ValueError, IndexError):
            raise InputError(
                "not a line of a list of images", where=f"{path}, line {number}", found=line, expected="time file"
            ) from None
    if not found:
        raise InputError("an empty list of images", where=path, expected="lines: time file")
    return found


def _associated(depth: list[tuple[float, str]], color: list[tuple[float, str]]) -> list[tuple[float, str, str | None]]:
    """Return each depth image with the colour image nearest in time, at most NEAR_S away."""
    ordered = sorted(color)
    nearest = nearest_in_time(np.array([t for t, _ in depth]), np.array([t for t, _ in ordered]), NEAR_S)
    return [(time, file, ordered[k][1] if k >= 0 else None) for (time, file), k in zip(depth, nearest.tolist())]


def _folder_lens(folder: Path, width: int, height: int) -> tuple[Camera, list[str]]:
    """Return the lens of a folder's images, and where it is from. Raises InputError."""
    file = next((folder / name for name in FILES if (folder / name).is_file()), None)
    if file is not None:
        lens, notes = read_lens(file, width, height)
        return lens, [f"the lens is from {file.name}: {lens_text(lens)}", *(f"{file.name}: {note}" for note in notes)]
    if (width, height) == (DEFAULT_LENS.width, DEFAULT_LENS.height):
        return DEFAULT_LENS, [f"the lens is the default of TUM and Redwood for 640 × 480: {lens_text(DEFAULT_LENS)}"]
    raise InputError(
        "no lens",
        where=folder,
        found=f"images of {width} × {height}",
        expected="camera_intrinsic.json, or calibration.txt with fx fy cx cy",
    )


def _unit_of_depth(folder: Path, options: Options, usual: float) -> tuple[float, bool]:
    """Return metres per unit of the depth images, and whether the options or a file declare it.

    `depth_scale` counts units in a metre as Open3D writes it, or millimetres in one unit (BOP), which is at most 1.
    """
    if options.depth_unit is not None:
        return options.depth_unit, True
    file = next((folder / name for name in JSON_NAMES if (folder / name).is_file()), None)
    if file is None:
        return usual, False
    try:
        scale = json.loads(file.read_text(encoding="utf-8-sig")).get("depth_scale")
        value = float(scale) if scale else 0.0
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError("not a lens", where=file, found=str(error), expected="depth_scale: a number") from None
    if not value:
        return usual, False
    return (1.0 / value if value > 1.0 else 1e-3 * value), True


def _warn_of_distance(file: Path, unit: float, said: bool, layout: str) -> None:
    """Warn where the first depth image shows a scene that is too near or too far for its unit."""
    image = _depth_image(file)
    if not image.any():
        return
    away, low = unit * float(np.median(image[image > 0])), RANGES.scene_m[0] if said else RANGES.assumed_scene_m
    if low <= away <= FARTHEST:
        return
    others = {"millimetres": 1e-3, "0.2 mm": TUM_UNIT, "0.1 mm": 1e-4, "1/256 m": 1 / 256}
    fits = [
        f"in {n} it is {s * away / unit:.3g} m (--depth-unit {s:.6g})" for n, s in others.items() if 0.2 < s * away / unit < 5.0
    ]
    begin = f"the scene is {away:.3g} m away where one unit of depth is {1e3 * unit:.3g} mm"
    from_layout = "" if said else f", as {layout} has it"
    text = f"{file}: {begin}{from_layout}: is it another unit? {'; '.join(fits) or '--depth-unit M states another'}"
    warnings.warn(text, stacklevel=3)


def _color_of(depth: list[Path], images: list[Path]) -> dict[Path, Path]:
    """Return the colour image of each depth image: the same number, else the same position in the lists."""
    by_number = {_number(file): file for file in images}
    if images and all(_number(file) in by_number for file in depth):
        return {file: by_number[_number(file)] for file in depth}
    return (
        dict(zip(depth, images))
        if len(images) == len(depth)
        else {f: by_number[_number(f)] for f in depth if _number(f) in by_number}
    )


# Files in order


def _cloud_files(folder: Path) -> list[Path]:
    found = [f for f in folder.iterdir() if f.suffix.lower() in ENDINGS and f.is_file() and not f.name.startswith(".")]
    return sorted(found, key=_order)


def _numbered(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    files = [f for f in folder.iterdir() if f.suffix.lower() in endings and not f.name.startswith(".")]
    if not files:
        raise InputError("no images", where=folder, expected=", ".join(endings))
    return sorted(files, key=_order)


def _order(file: Path) -> tuple[float, str]:
    return (_number(file), file.name)


def _number(file: Path) -> float:
    """Return the first number in a file's name (Redwood: frame-time)."""
    match = re.search(r"\d+(?:\.\d+)?", file.stem)
    return float(match[0]) if match else -1.0


def _file_times(files: Sequence[Path]) -> list[float] | None:
    """Return times [s] from names such as 0000012-000000400400 (Redwood, microseconds) or 1305031102.175304; None without."""
    stems = [file.stem for file in files]
    redwood = [re.fullmatch(r"\d+-(\d{9,})", stem) for stem in stems]
    if all(redwood):
        return [1e-6 * int(m[1]) for m in redwood if m]
    seconds = [re.fullmatch(r"(?:\w*?[_-])?(\d+\.\d+)", stem) for stem in stems]
    if all(seconds):
        return [float(m[1]) for m in seconds if m]
    nanoseconds = [re.fullmatch(r"\d{18,19}", stem) for stem in stems]
    return [1e-9 * int(m[0]) for m in nanoseconds if m] if all(nanoseconds) else None


def _cloud_times(folder: Path, files: list[Path], options: Options) -> list[float]:
    times = _file_times(files)
    listed = folder / "times.txt"
    if times is None and listed.is_file():
        times = [float(word) for word in listed.read_text().split()]
        if len(times) != len(files):
            raise InputError("other times than files", where=listed, found=len(times), expected=f"{len(files)} times [s]")
    if times is None and options.rate is None and len(files) > 1:
        raise InputError(
            "no times", where=folder, found=files[0].name, expected="--rate HZ, times.txt, or names that are times in seconds"
        )
    return times if times is not None else [i / (options.rate or 1.0) for i in range(len(files))]


# Clouds


def _scaled_cloud(file: Path, scale: float) -> PointCloud:
    cloud = read_points(file)
    return cloud if scale == 1.0 else PointCloud(scale * cloud.points, cloud.colors)


def _unit_of_clouds(file: Path, options: Options) -> float:
    """Return metres in one unit of clouds: of the option, else 1 for formats whose writers use metres where size and distance of the first cloud
    agree with it (PLY and PCD of cameras). Raises InputError."""
    points = read_points(file).points
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    away = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
    in_metres = file.suffix.lower() in (".ply", ".pcd") and extent < WIDEST and away <= FARTHEST
    return unit_of(options, "m" if in_metres else None, file, extent)


TUM = Format("tum", open_tum, is_tum, ("--clock", "--rate", "--up", "--unit", "--topic"), whole_depths=True)
REDWOOD = Format("redwood", open_redwood, _is_redwood, ("--clock", "--up", "--unit", "--topic"), whole_depths=True)
CLOUDS = Format("clouds", open_clouds, _is_clouds, ("--clock", "--topic"))
