"""Sensors in the body of the virtual rig: a strain or a shift between two of its points, with lag, noise and drift.

    strain:  ε = |x_b − x_a| / |X_b − X_a| − 1,                                reading = zero + gain ε
    colour:  u = (x_b − x_a) · d,  d perpendicular to the line from a to b,      reading_k = zero + gain ½ (1 + cos 2π (u / period − k / 3))

A colour sensor at a looks at a pattern of colours at b; a shift u brings other colours in front of it (Scharff et al. 2018).
The sensor follows the body with a lag; noise and drift are added to its reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, embed_points
from femsense.io.files import write_csv
from femsense.io.tables import NotNegative, Positive, Schema, Vector

COLOURS = ("red", "green", "blue")
DIGITS = 9


class SensorTable(Schema):
    """A sensor in the body; its readings are written to sensors.csv."""

    name: Annotated[
        str, Field(min_length=1, description="a name; a colour sensor has the channels NAME_red, NAME_green, NAME_blue")
    ]
    kind: Literal["strain", "colour"] = Field(
        "strain", description='"strain" between two points, or "colour": a pattern that is displaced'
    )
    from_m: Vector = Field(description="one point of the body at rest [m], robot frame")
    to_m: Vector = Field(description="the other point at rest [m]")
    across: Vector | None = Field(
        None,
        description="of a colour sensor: direction of the measured displacement; default: the most vertical transverse direction",
    )
    period_m: Positive = Field(0.01, description="of a colour sensor: period of the colour pattern [m], > 0")
    gain: float = Field(1.0, description="reading per unit of strain, or difference between dark and bright")
    zero: float = Field(0.0, description="reading at zero strain, or in the dark")
    lag_s: NotNegative = Field(0.0, description="time constant of the sensor [s], ≥ 0")
    noise_std: NotNegative = Field(0.0, description="noise of a reading, standard deviation in its unit, ≥ 0")
    drift_per_s: float = Field(0.0, description="drift of the zero reading, in its unit per second")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of its columns."""
        return (self.name,) if self.kind == "strain" else tuple(f"{self.name}_{colour}" for colour in COLOURS)


def sensor_readings(
    sensors: Sequence[SensorTable], mesh: TetMesh, states: Sequence[FloatArray], time_s: FloatArray, *, rng: np.random.Generator
) -> FloatArray:
    """Return the readings of sensors, shape (F, channels).

    Arguments:
        sensors: in the order of their columns.
        mesh: of the body, at rest.
        states: nodes of each frame [m], shape (n, 3) each.
        time_s: of each frame [s], shape (F,).
        rng: of the noise.

    Raises:
        InputError: the two points of a sensor coincide.
    """
    columns = []
    for sensor in sensors:
        ends = np.array([sensor.from_m, sensor.to_m], dtype=np.float64)
        if not np.linalg.norm(ends[1] - ends[0]) > 0:
            raise InputError("the two points of a sensor coincide", where=f"sensor {sensor.name}", found=sensor.from_m)
        tie = embed_points(mesh, ends)
        way = np.array([np.diff(tie.positions(nodes), axis=0)[0] for nodes in states])
        ideal = _strain(way, ends) if sensor.kind == "strain" else _colours(way, ends, sensor)
        late = _delayed(ideal, time_s, sensor.lag_s)
        columns.append(
            sensor.zero
            + sensor.gain * late
            + sensor.drift_per_s * (time_s - time_s[0])[:, None]
            + sensor.noise_std * rng.standard_normal(late.shape)
        )
    return np.concatenate(columns, axis=1) if columns else np.zeros((len(time_s), 0))


def write_sensors(path: Path, sensors: Sequence[SensorTable], time_s: FloatArray, readings: FloatArray) -> None:
    """Write sensors.csv: frame, time_s and one column per channel, as read by `femsense learn`."""
    names = [channel for sensor in sensors for channel in sensor.channels]
    rows = [[k, *np.round([t, *row], DIGITS).tolist()] for k, (t, row) in enumerate(zip(time_s, readings))]
    write_csv(path, ("frame", "time_s", *names), rows)


def _strain(way: FloatArray, ends: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(way, axis=1) / np.linalg.norm(ends[1] - ends[0]) - 1.0)[:, None]


def _colours(way: FloatArray, ends: FloatArray, sensor: SensorTable) -> FloatArray:
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    wanted = (
        np.asarray(sensor.across, dtype=np.float64) if sensor.across is not None else np.eye(3)[[2, 0][int(abs(along[2]) > 0.9)]]
    )
    across = wanted - (wanted @ along) * along
    shift = (way - (ends[1] - ends[0])) @ (across / np.linalg.norm(across))
    phase = shift[:, None] / sensor.period_m - np.arange(len(COLOURS)) / 3.0
    return np.asarray(0.5 * (1.0 + np.cos(2.0 * np.pi * phase)))


def _delayed(ideal: FloatArray, time_s: FloatArray, tau: float) -> FloatArray:
    """Return values filtered with a time constant, starting at the first value."""
    if tau == 0.0:
        return ideal
    late = ideal.copy()
    for k in range(1, len(late)):
        late[k] = late[k - 1] + (1.0 - np.exp((time_s[k - 1] - time_s[k]) / tau)) * (ideal[k] - late[k - 1])
    return late
