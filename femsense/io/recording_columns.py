"""The columns of a recording's CSV files, for reading and for the page on files."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Column:
    """One column, or a family of them where the name ends in <name>."""

    name: str
    holds: str
    """Its quantity and unit."""
    required: bool = True


PLACE = (
    Column("x_m", "place along x [m]"),
    Column("y_m", "place along y [m]"),
    Column("z_m", "place along z [m]"),
)
CAMERA = Column("camera", "name of the camera that saw it; needed where there are several", required=False)
COLUMNS: dict[str, tuple[Column, ...]] = {
    "frames.csv": (
        Column("frame", "number of the frame: whole, ≥ 0, each once; clouds and images carry it as their name"),
        Column("time_s", "time [s], increasing"),
        Column(
            "cable_<name>",
            "tension [N], or displacement [m] (> 0 shortens), as `actuation` says; one for each cable",
            required=False,
        ),
        Column("chamber_<name>", "pressure [Pa]; one for each chamber", required=False),
        Column("free", "1 where nothing undeclared touches the robot, else 0", required=False),
        Column("sweep", "a label: one excursion from rest and back, held out together", required=False),
        Column(
            "gravity_x_m_s2", "gravity in the robot frame [m/s²], in place of the robot's own; all three or none", required=False
        ),
        Column("gravity_y_m_s2", "as above", required=False),
        Column("gravity_z_m_s2", "as above", required=False),
    ),
    "markers.csv": (
        Column("frame", "number of a frame of frames.csv"),
        Column("marker", "name of the marker; empty in all rows of a frame with unnamed markers"),
        *PLACE,
        CAMERA,
    ),
    "rest.csv": (
        Column("marker", "name of the marker"),
        *PLACE,
        Column("std_m", "one standard deviation along each axis [m]", required=False),
        CAMERA,
    ),
    "loads.csv": (
        Column("frame", "number of a frame of frames.csv"),
        *PLACE,
        Column("fx_n", "force along x [N]"),
        Column("fy_n", "force along y [N]"),
        Column("fz_n", "force along z [N]"),
    ),
}
MEANS = {
    "frames.csv": "Required. One row a frame, in order of time.",
    "markers.csv": (
        "Markers as a camera sees them, camera frame. A hidden marker has no row; rows of 0, 0, 0 count as lost and are left "
        "out with a warning."
    ),
    "rest.csv": "Markers measured with the body unloaded, camera frame.",
    "loads.csv": "Known loads: the place on the body at rest and the force, both in the robot frame.",
}


def columns(file: str) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the names of required and of optional columns, and how the names of families begin."""
    known = COLUMNS[file]
    plain = [column for column in known if not column.name.endswith("<name>")]
    required = tuple(column.name for column in plain if column.required)
    optional = tuple(column.name for column in plain if not column.required)
    return required, optional, tuple(column.name.removesuffix("<name>") for column in known if column not in plain)
