"""The parts of a recording, arguments of `make_recording`; tools; markers at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.model.camera import Camera


@dataclass(frozen=True, eq=False, slots=True)
class Timeline:
    """Times and labels of the frames of a recording."""

    time_s: npt.ArrayLike
    """Time of each frame [s], increasing, shape (F,)."""
    frame_numbers: npt.ArrayLike | None = None
    """Number of each frame, as in frames.csv, shape (F,); None: 0 … F − 1."""
    free: npt.ArrayLike | None = None
    """Mask of the contact-free frames, those without undeclared contact, shape (F,); None: unknown."""
    sweep: Sequence[str] | None = None
    """Label of the sweep of each frame; the frames of a sweep are held out together. None: not given."""
    gravity: npt.ArrayLike | None = None
    """Gravity of each frame in the robot's coordinate system [m/s²], shape (F, 3); None: that of the robot."""


@dataclass(frozen=True, eq=False, slots=True)
class Drives:
    """Inputs of the robot in each frame: cables and chambers."""

    cable_names: Sequence[str] = ()
    """Name of each cable, in the order of the columns of `inputs`."""
    inputs: npt.ArrayLike | None = None
    """Cable inputs, shape (F, a): tensions [N], or displacements [m], > 0 shortens."""
    actuation: str = "tension"
    """Kind of `inputs`: "tension" [N] or "displacement" [m]."""
    actuation_zero: str = "absolute"
    """"absolute": the values are the true inputs; "unknown": they count from an unknown initial input."""
    chamber_names: Sequence[str] = ()
    """Name of each chamber, in the order of the columns of `pressures`."""
    pressures: npt.ArrayLike | None = None
    """Chamber pressures above the surroundings [Pa], shape (F, c)."""


@dataclass(frozen=True, eq=False, slots=True)
class MarkerRows:
    """Observations of named markers: K rows, one per marker that is visible in a frame."""

    names: Sequence[str]
    """Names of the markers."""
    frame: npt.ArrayLike
    """Frame of each row, an index from 0 to F − 1, shape (K,)."""
    index: npt.ArrayLike
    """Marker of each row, an index into `names`, shape (K,)."""
    xyz: npt.ArrayLike
    """Position of the marker in the coordinates of its camera [m], shape (K, 3)."""
    view: npt.ArrayLike | None = None
    """Camera of each row, an index into `Views.names`, shape (K,); None: the first."""
    noise_m: float | None = None
    """Repeatability of a marker along each axis, one standard deviation [m]; None if unknown."""


@dataclass(frozen=True, eq=False, slots=True)
class UnnamedRows:
    """Observations of markers without names: U rows, one per point in a frame. `calibrate` assigns them to the markers of the robot."""

    frame: npt.ArrayLike = ()
    """Frame of each row, an index from 0 to F − 1, shape (U,)."""
    xyz: npt.ArrayLike = ()
    """Position of the marker in the coordinates of its camera [m], shape (U, 3)."""
    view: npt.ArrayLike | None = None
    """Camera of each row, an index into `Views.names`, shape (U,); None: the first."""


@dataclass(frozen=True, eq=False, slots=True)
class LoadRows:
    """Known loads on the body: L rows, one per load in a frame."""

    frame: npt.ArrayLike = ()
    """Frame of each row, an index from 0 to F − 1, shape (L,)."""
    points: npt.ArrayLike = ()
    """Point of the body at rest, robot frame [m], shape (L, 3)."""
    forces: npt.ArrayLike = ()
    """Force on the body, robot frame [N], shape (L, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Views:
    """The V cameras of a recording: poses, intrinsics, and the files of their images or clouds."""

    names: Sequence[str] = ("",)
    """Name of each camera; ("",) for a single one."""
    cameras: Sequence[Camera | None] | None = None
    """Intrinsics of each camera; None where they are unknown."""
    T_robot_camera: Sequence[npt.ArrayLike | None] | None = None
    """Pose of each camera, shape (4, 4), from camera to robot coordinates; None where it is unknown."""
    cloud_files: Sequence[Sequence[Path | None]] | None = None
    """Cloud or depth image of each frame and view; None where there is none."""
    color_files: Sequence[Sequence[Path | None]] | None = None
    """Colour image of each frame and view; None where there is none."""


def _no_points() -> FloatArray:
    return freeze(np.zeros((0, 3)))


@dataclass(frozen=True, eq=False, slots=True)
class Tool:
    """A rigid object of known shape that may touch the robot.

    The origin of its coordinates is the centre of a ball or cylinder (with axis z), or that of the file of a mesh.
    """

    name: str
    """Name of the object."""
    kind: str
    """"ball", "cylinder" or "mesh"."""
    radius: float = 0.0
    """Radius of a ball or cylinder [m]; 0 for a mesh."""
    length: float = 0.0
    """Length of a cylinder [m]; 0 for others."""
    points: FloatArray = field(default_factory=_no_points)
    """Vertices of a mesh [m], shape (n, 3)."""
    triangles: IntArray = field(default_factory=lambda: freeze(np.zeros((0, 3)), np.int64))
    """Triangles of a mesh: indices of vertices, normals outward, shape (t, 3). The surface is closed."""
    mesh_file: Path | None = None
    """File of the mesh; None: made in Python."""
    mesh_unit: str = "m"
    """Unit of the coordinates in that file."""


@dataclass(frozen=True, eq=False, slots=True)
class RestMarkers:
    """Positions of markers measured on the unloaded body, in camera coordinates (rest.csv)."""

    names: tuple[str, ...]
    """Names of the markers."""
    positions: FloatArray
    """Position of each of r markers in the coordinates of its camera [m], shape (r, 3)."""
    std: FloatArray
    """Standard deviation of each position [m], shape (r,); NaN where it is not given."""
    view: IntArray
    """Camera of each marker, an index, shape (r,)."""


@dataclass(frozen=True, eq=False, slots=True)
class About:
    """Properties of a whole recording, such as its folder and session."""

    folder: Path | None = None
    """Folder that it was loaded from; None: made in Python."""
    session: str | None = None
    """Recordings of one session share values that are constant within a session; None if not given."""
    rest: RestMarkers | None = None
    """Markers measured on the unloaded body; None: not measured."""
    tools: Sequence[Tool] = ()
    """Objects of known shape that may touch the robot."""
