"""Messages of clients about a drag, and the replies in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

from femsense.control.motion import CONVERGING, NEAREST, REACHED, Motion
from femsense.core.arrays import FloatArray
from femsense.xr.stream.payloads import Input, read_document

LONGEST = 4096
"""Bytes of a wish."""
LONGEST_NAME = 64
"""Maximum number of characters of a client's name."""


@dataclass(frozen=True, eq=False, slots=True)
class Wish:
    """The requested position of a point, and by whom."""

    way: str
    """How it came: the connection of a WebSocket, the name of a broker's client, or the broker."""
    client: str
    seq: int
    number: int
    """Number of the lease; 0: a request for one."""
    held: bool
    armed: bool
    handle: str
    target_m: FloatArray | None
    """Robot frame, shape (3,)."""


def read_wish(payload: bytes, way: str) -> Wish | None:
    """Return the request in a message from any channel, or None if there is none."""
    told = read_document(payload, most=LONGEST)
    if told is None:
        return None
    client, seq, number = told.get("client"), told.get("seq"), told.get("lease", 0)
    if not isinstance(client, str) or not 0 < len(client) <= LONGEST_NAME or type(seq) is not int or type(number) is not int:
        return None
    held, armed = told.get("held") is True, told.get("armed") is True
    return Wish(way, client, seq, number, held, armed, str(told.get("handle")), place_of(told.get("target_m")))


def in_plain_words(motion: Motion) -> str:
    """Return the result of a request in words for a user without knowledge of the solver."""
    away = f"{1e3 * motion.error_m:.3g} mm"
    held_back = f": {'; '.join(motion.limits)}" if motion.limits else ""
    if motion.status == REACHED:
        return f"The robot can bring the point there, to {away}"
    if motion.status == CONVERGING:
        return f"Looking for a way: {away} to go{held_back}"
    if motion.status == NEAREST:
        return f"The robot cannot bring it closer than {away}{held_back or ': nothing that drives it moves the point that way'}"
    why = held_back if motion.equilibrium.converged else f": {motion.equilibrium.advice}"
    return f"No way was found, {away} are left{why}"


@dataclass(frozen=True, eq=False, slots=True)
class Report:
    """The state that a robot, or who measures it, reports."""

    places_m: dict[str, FloatArray]
    """Marker → measured position [m], robot frame, shape (3,)."""
    inputs: dict[str, float]
    """Input → value, as far as it is in the unit of commands."""
    detail: str
    """Why markers were not measured."""


def read_report(payload: bytes, inputs: Sequence[Input]) -> Report:
    """Return the report in a message of any origin; what is not understood is left out."""
    told, units = read_document(payload) or {}, {one.name: one.unit for one in inputs}
    places = {str(row.get("name")): place_of(row.get("position_m")) for row in _rows(told, "markers")}
    values = [(str(row.get("name")), row.get("unit"), row.get("value")) for row in _rows(told, "inputs")]
    return Report(
        {name: place for name, place in places.items() if place is not None},
        {name: float(value) for name, unit, value in values if unit == units.get(name, "") and _is_number(value)},
        str(told.get("detail", "")),
    )


def place_of(told: object) -> FloatArray | None:
    """Return x, y, z of an object, shape (3,), or None."""
    values = [told.get(axis) for axis in "xyz"] if isinstance(told, dict) else [None]
    return np.array(values, dtype=np.float64) if all(_is_number(value) for value in values) else None


def _rows(told: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the objects in a list of a document."""
    rows = told.get(name)
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def _is_number(told: object) -> TypeGuard[float]:
    return isinstance(told, int | float) and bool(np.isfinite(told))
