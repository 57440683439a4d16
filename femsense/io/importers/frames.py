"""The types of an importer: a source with its frames, the options of a user, and the declaration of a format."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.core.units import length_unit
from femsense.io.importers.options import UNITS, Options
from femsense.io.importers.tables.mapping import Becomes
from femsense.model.camera import Camera
from femsense.pointcloud.cloud import PointCloud

SMALLEST, LARGEST = 2e-3, 100.0
"""Scenes of motion capture are between these sizes [m]: ten times less than a finger's markers span, ten times a large hall."""
FARTHEST = 15.0
"""Depth cameras see no farther [m]: a scene most of which is farther away is in another unit."""
HEAD = 512
"""Bytes at the beginning of a file by which formats are recognised."""
BROWN = "brown_conrady"
DepthImage = npt.NDArray[np.uint16]
ColorImage = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False, slots=True)
class Images:
    """Images of a depth camera in one frame."""

    depth: DepthImage
    """Units of the camera's `depth_unit`, 0 where there is none, shape (H, W)."""
    color: ColorImage | None = None
    """Red, green, blue, registered to the depth image, shape (H, W, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One moment of a recording."""

    time: float
    """[s] on the source's clock."""
    picture: Callable[[], Images | PointCloud] | None = None
    """Decodes the images or the cloud [m, camera frame] on demand; raises InputError if they are broken."""
    markers: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    """Name → position [m], shape (3,), without hidden markers."""
    unlabelled: npt.ArrayLike = ()
    """Places of markers of unknown name [m], shape (k, 3)."""
    inputs: Mapping[str, float] = field(default_factory=dict)
    """Column of frames.csv (cable_…, chamber_…) → value [N], [m] or [Pa]."""
    loads: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] = ()
    """Place [m] and force [N], robot frame, each of shape (3,)."""
    views: Mapping[str, Frame] = field(default_factory=dict)
    """Camera → its own data at this time; with several cameras, images and markers are here and not in the fields above."""


@dataclass(frozen=True, eq=False, slots=True)
class Source:
    """Contents of a file or a folder, read frame by frame."""

    path: Path
    frames: Callable[[], Iterator[Frame]]
    """Starts from the first frame at each call; a live source may go on for ever."""
    found: Mapping[str, Any] = field(default_factory=dict)
    """Properties for the report, beyond the frames; None where one is not known."""
    camera: Camera | None = None
    """Where pictures are depth images."""
    actuation: str | None = None
    """"tension" or "displacement"; None if the source does not declare it."""
    actuation_by_unit: bool = False
    """Whether units of the file give the actuation, so that another one is an error."""
    count: int | None = None
    """Frames that are expected, where it is known."""
    notes: Sequence[str] = ()
    """Assumptions and losses that the user should know."""
    T_robot_camera: FloatArray | None = None
    """Shape (4, 4), translation [m]; None if the source does not declare it."""
    views: Mapping[str, Source] = field(default_factory=dict)
    """Camera → its own source, where several look; see `several.joined`."""
    free: Sequence[tuple[float, float]] = ()
    """See `Options.free`."""
    names: Mapping[str, Sequence[Becomes]] = field(default_factory=dict)
    """Name that `--map` accepts → its allowed targets; see `mapping.check_names`."""
    format: str = ""
    """A name of `formats.FORMATS`, given by `Format.opened`."""


@dataclass(frozen=True, eq=False, slots=True)
class Format:
    """One format: each importer's module declares its own, and `formats` lists them."""

    name: str
    """As `--format` takes it."""
    open: Callable[[Path, Options], Source]
    recognises: Callable[[Path, bytes], bool]
    """Called with a path and the first HEAD bytes of a file, none of a folder."""
    unused: tuple[str, ...]
    """Options that have no effect on it."""
    list: Callable[[Path], dict[str, Any]] | None = None
    """Returns the contents without reading frames; None: those of `open`."""
    endings: tuple[str, ...] = ()
    """Of files that nothing else has."""
    topics: Callable[[Path], Iterable[str]] | None = None
    """Names that `--topic` takes, where several captures share the option."""
    columns: Callable[[Path], Iterable[str]] | None = None
    """Names that `--map` takes, where a log of actuation or another capture shares the option."""
    whole_depths: bool = False
    """Whether its depth images count a unit that may be another: `--depth-unit`."""
    transforms: bool = False
    """Whether it holds frames of coordinates: `--base`."""

    def opened(self, path: Path, options: Options) -> Source:
        """Return a source of this format. Raises InputError."""
        source = self.open(path, options)
        return source if source.format else replace(source, format=self.name)


def camera_of_numbers(
    width: int, height: int, focal: npt.ArrayLike, middle: npt.ArrayLike, distortion: npt.ArrayLike = (), model: str = BROWN
) -> Camera:
    """Return a camera whose depth images count millimetres, unless it is replaced.

    Arguments:
        width, height: of its images [px].
        focal, middle: focal lengths and principal point along x and y [px].
        distortion: OpenCV's order, any length; more than eight numbers are cut off.
        model: the name of a model of `Camera`.
    """
    numbers = np.concatenate([np.asarray(distortion, dtype=np.float64).ravel(), np.zeros(8)])[:8]
    (fx, fy), (cx, cy) = np.asarray([focal, middle], dtype=np.float64).tolist()
    return Camera("", width, height, fx, fy, cx, cy, freeze(numbers if numbers[5:].any() else numbers[:5]), 1e-3, model)


def is_kept_as_image(camera: Camera) -> bool:
    """Whether a depth image of a camera is kept as an image.

    The "inverse" model of the RealSense SDK is not the inverse of OpenCV's polynomial (20 mm apart at 1 m with its usual coefficients):
    such images become clouds, which are unambiguous.
    """
    return not np.any(camera.distortion != 0.0) or camera.distortion_model != "inverse_brown_conrady"


def unit_of(options: Options, declared: str | None, where: str | Path | None, extent: float) -> float:
    """Return metres in one unit of length: of the option, else of the file.

    Arguments:
        options: of the user.
        declared: the unit in the file; None without one.
        where: the file, for the message.
        extent: size of the scene in the file's unit, for the message.

    Raises:
        InputError: neither gives the unit.
    """
    said = options.unit or declared
    unit = length_unit(said) if said is not None else None
    if unit is not None:
        return unit.size
    raise InputError(
        "the unit of length is not known" if said is None else "an unknown unit of length",
        where=where,
        found=f"no unit; the positions span {extent:.4g}" if said is None else said,
        expected="--unit " + "|".join(UNITS),
        hint=f"in metres the scene would be {extent:.4g} m wide, in millimetres {1e-3 * extent:.4g} m",
    )


def check_size(extent: float, where: str | Path | None) -> None:
    """Warn of a motion capture that is absurdly small or large [m]: most likely its unit is another."""
    if 0.0 < extent < SMALLEST or extent > LARGEST:
        size = f"{extent:.3g} m" if extent > 1.0 else f"{1e3 * extent:.3g} mm"
        warnings.warn(f"{where}: the scene is {size} across: is its unit another? --unit " + "|".join(UNITS), stacklevel=3)


def check_reach(distances: npt.ArrayLike, where: str | Path | None) -> None:
    """Refuse distances in metres most of which exceed the range of a depth camera.

    Arguments:
        distances: of the points from the camera, shape (n,).
        where: the file or topic, for the message.

    Raises:
        InputError: with the unit that would fit.
    """
    given = np.asarray(distances, dtype=np.float64)
    far = float(np.median(given)) if given.size else 0.0
    if far <= FARTHEST:
        return
    raise InputError(
        "the scene is farther away than a depth camera sees: another unit than metres?",
        where=where,
        found=f"half of it beyond {far:.4g}",
        expected=f"metres, at most {FARTHEST:g}; or --unit " + "|".join(UNITS),
        hint=f"in millimetres that would be {1e-3 * far:.4g} m" if 1e-3 * far <= FARTHEST else None,
    )


def upright(points: npt.ArrayLike, up: str | None) -> FloatArray:
    """Return points (n, 3) turned so that the axis `up` becomes z (a rotation: handedness stays)."""
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if up == "y":
        return np.stack([xyz[:, 0], -xyz[:, 2], xyz[:, 1]], axis=1)
    if up == "x":
        return np.stack([-xyz[:, 2], xyz[:, 1], xyz[:, 0]], axis=1)
    return xyz
