"""A contact of a script frame by frame: its force, its place, and its distance from the surface between contacts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.rig.script import ContactTable, ObjectTable, ScriptTable, script_problem


@dataclass(frozen=True, eq=False, slots=True)
class PlannedContact:
    """A contact over the frames."""

    table: ContactTable
    force: FloatArray
    """[N], shape (F,); 0: no contact."""
    path: FloatArray | None = None
    """Its place on the surface at rest [m], shape (F, 3); None: the point of its table."""
    tangent: FloatArray | None = None
    """Ratio of tangential to normal force [1], shape (F,); None: no tangential force."""
    away: FloatArray | None = None
    """Distance from the surface without contact [m], shape (F,), nan while absent; None: always absent."""
    item: ObjectTable | None = None
    """The object; None: a probe."""

    def place(self, k: int) -> FloatArray:
        """Return its place in frame k on the surface at rest [m], shape (3,)."""
        if self.path is not None:
            return np.array(self.path[k], dtype=np.float64)
        return np.asarray(self.table.point_m, dtype=np.float64)

    @property
    def way(self) -> FloatArray:
        """Direction of the tangential force, or of the path; shape (3,)."""
        for given in (self.table.tangent_direction, self.table.along):
            if given is not None:
                return np.asarray(given, dtype=float)
        if self.table.path_m is not None:
            start, end = (np.asarray(point, dtype=float) for point in (self.table.path_m[0], self.table.path_m[-1]))
            return np.asarray(end - start)
        return np.array([1.0, 0.0, 0.0])

    @property
    def along(self) -> FloatArray:
        """Direction of the object's x axis, shape (3,)."""
        return self.way if self.table.along is None else np.asarray(self.table.along, dtype=float)

    def pick(self, frames: IntArray) -> PlannedContact:
        """Return the contact in some of its frames."""
        path, tangent, away = (None if a is None else freeze(a[frames]) for a in (self.path, self.tangent, self.away))
        return PlannedContact(self.table, freeze(self.force[frames]), path, tangent, away, self.item)


def planned_contact(
    script: ScriptTable, i: int, frames: tuple[int, int, int], gravity: FloatArray, where: Path
) -> PlannedContact:
    """Return contact i of a script.

    Arguments:
        script: the script.
        i: index of the contact.
        frames: first frame of its sweep, number of frames of the sweep, and number of all frames.
        gravity: of the body [m/s²], shape (3,).
        where: for error messages.

    Raises:
        InputError: lists that differ in length from the sweep; a weight without gravity.
    """
    table = script.contacts[i]
    item = next((item for item in script.objects if item.name == table.object), None)
    first, count, total = frames

    def spread(key: str, value: float | list[float], fill: float) -> FloatArray:
        values = np.full(count, value) if isinstance(value, float | int) else np.array(value, dtype=float)
        if len(values) != count:
            found, expected = f"{len(values)} values", f"{count} values, or one number"
            raise script_problem("another number of values than frames", where, ("contacts", i, key), found, expected)
        column = np.full(total, fill)
        column[first : first + count] = values
        return freeze(column)

    if item is not None and item.kind == "weight":
        table = _hung(table, item, gravity, i, where)
    return PlannedContact(
        table,
        spread("force_n", table.force_n if table.force_n is not None else 0.0, 0.0),
        None if table.path_m is None else freeze(_walked(np.asarray(table.path_m, dtype=float), frames)),
        spread("tangent", table.tangent, 0.0) if np.any(table.tangent) else None,
        None if table.away_m is None else spread("away_m", table.away_m, np.nan),
        item,
    )


def _hung(table: ContactTable, item: ObjectTable, gravity: FloatArray, i: int, where: Path) -> ContactTable:
    """Return the contact of a weight: along gravity, with its weight as the default force."""
    size = float(np.linalg.norm(gravity))
    if not size:
        raise script_problem(
            "a weight without gravity", where, ("contacts", i, "object"), repr(item.name), "[gravity] in robot.toml"
        )
    force = (item.mass_kg or 0.0) * size if table.force_n is None else table.force_n
    return table.model_copy(update={"force_n": force, "direction": table.direction or (gravity / size).tolist()})


def _walked(corners: FloatArray, frames: tuple[int, int, int]) -> FloatArray:
    """Return the places along a path, evenly spaced over the frames of its sweep, shape (F, 3)."""
    first, count, total = frames
    at = np.clip(np.arange(total) - first, 0, count - 1) / max(count - 1, 1) * (len(corners) - 1)
    return np.stack([np.interp(at, np.arange(len(corners)), column) for column in corners.T], axis=1)
