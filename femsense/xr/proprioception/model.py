"""A learnt model of a robot's own sensors: readings in, markers and bones out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, as_numbers
from femsense.core.errors import InputError
from femsense.xr.armature import Armature, BonePoses, poses_from_matrices
from femsense.xr.proprioception.domain import Domain, Outside, Why
from femsense.xr.proprioception.labelled import AS_MEASURED
from femsense.xr.proprioception.memory import longest_gap, step_memory, with_memory
from femsense.xr.proprioception.network import Network
from femsense.xr.proprioception.spread import Spread


@dataclass(frozen=True, eq=False, slots=True)
class ProprioceptiveModel:
    """A learnt map from the readings of c sensors in the body to the positions of m markers on it.

    `markers` predicts the markers, `interval` their 95 % intervals and `armature` the bones; `check` lists readings outside of the training domain.
    `learn` and `load_model` make one.
    """

    channels: tuple[str, ...]
    """Names of the readings, in the order of a row."""
    marker_names: tuple[str, ...]
    """Names of the predicted markers."""
    network: Network
    """Map from readings and their low-pass filters to the coordinates of the markers [m]."""
    memory_s: tuple[float, ...]
    """Time constants of the filters [s]; none: the readings of one moment are enough."""
    domain: Domain
    """The training domain."""
    chain: Armature | None
    """Bones on the curve through the markers; None with a single marker."""
    bones: Network | None = None
    """The end-to-end network, from readings to 9 numbers a bone (place, x axis, z axis); None: bones from the markers."""
    report: dict[str, Any] = field(default_factory=dict)
    """Training report, with errors on held-out data."""
    frame: str = AS_MEASURED
    """Coordinates of markers and bones: "robot", or "markers", those in which the markers were measured."""
    spread: Spread | None = None
    """Parameters of the 95 % intervals; None in files of older versions."""

    def __repr__(self) -> str:
        error = self.report.get("error_mm")
        stated = f", {error:.2g} mm on held-out blocks" if isinstance(error, float) else ""
        return (
            f"ProprioceptiveModel({len(self.channels)} channels → {len(self.marker_names)} markers, {self.network.units}{stated})"
        )

    def markers(self, rows: npt.ArrayLike, time_s: npt.ArrayLike | None = None) -> FloatArray:
        """Return the markers [m], shape (m, 3) for one row of readings, shape (c,), or (n, m, 3) for several, shape (n, c).

        Arguments:
            rows: readings. One row is taken as steady; for a stream, `live` keeps the memory. If a required reading
                is not finite, the markers are nan.
            time_s: times of several rows [s], shape (n,); required if the model has a memory.

        Raises:
            InputError: not numbers, a wrong number of channels, or missing times for a model with memory.
        """
        x, single = self._rows(rows)
        y = self.network(self._inputs(x, single, time_s)).reshape(len(x), -1, 3)
        return np.asarray(y[0] if single else y)

    def interval(self, rows: npt.ArrayLike, time_s: npt.ArrayLike | None = None) -> FloatArray:
        """Return the radius of the 95 % interval of each marker [m], shape (m,) for one row, or (n, m).

        It contains the predictive variance of the map and the drift within the training sessions, but not changes between days. Arguments and
        errors as of `markers`.

        Raises:
            InputError: also for models of an older version, without intervals.
        """
        if self.spread is None:
            raise InputError("a model of an older version has no intervals", where="model", hint="learn it again: femsense learn")
        x, single = self._rows(rows)
        radius = self.spread.radius(self.network, self._inputs(x, single, time_s))
        return np.asarray(radius[0] if single else radius)

    def armature(self, row: npt.ArrayLike) -> BonePoses:
        """Return the bones of one steady row of readings, shape (c,).

        Raises InputError as `markers`, if a reading is not finite, and if the model has no chain.
        """
        x, _ = self._rows(row)
        if not np.isfinite(x[0, self.needed]).all():
            unread = ", ".join(item.channel for item in self.check(x[0]))
            raise InputError(
                "no bones without all readings", where="row", found=unread, expected="a finite number for each channel"
            )
        return self.bones_of(self._inputs(x[:1], True, None))

    def bones_of(self, inputs: FloatArray) -> BonePoses:
        """Return the bones of one row of readings with their filters, shape (1, d)."""
        if self.bones is not None:
            return bones_from_numbers(self.bones(inputs)[0])
        return self._chain()(self.network(inputs).reshape(-1, 3))

    def check(self, row: npt.ArrayLike) -> tuple[Outside, ...]:
        """Return the channels of a row, shape (c,), outside of the training domain, the farthest first;
        empty if there are none."""
        return self.domain.check(self._rows(row)[0][0], self.channels, self.needed)

    @property
    def needed(self) -> BoolArray:
        """Whether each channel is required for a prediction, shape (c,). The others were constant in training, or made the prediction worse."""
        uses = self.network.uses if self.bones is None else self.network.uses | self.bones.uses
        return np.asarray(uses.reshape(-1, len(self.channels)).any(axis=0))

    @property
    def bone_names(self) -> tuple[str, ...]:
        """Name of each bone."""
        return self._chain().names

    @property
    def rest_bones(self) -> BonePoses:
        """The bones at rest."""
        return self._chain().rest

    def live(self) -> LiveModel:
        """Return an object that processes a stream of readings row by row and keeps the memory of the model."""
        return LiveModel(self)

    def _chain(self) -> Armature:
        if self.chain is None:
            raise InputError(
                "one marker makes no chain of bones", where="markers", found=self.marker_names, expected="two or more"
            )
        return self.chain

    def _rows(self, rows: npt.ArrayLike) -> tuple[FloatArray, bool]:
        count = len(self.channels)
        expected = f"a row of readings, one number for each of {count} channels: {', '.join(self.channels)}"
        x = as_numbers(rows, "rows", expected=expected, hint="numbers in the order of the channels")
        if x.ndim not in (1, 2) or x.shape[-1] != count:
            raise InputError("another number of channels", where="rows", found=f"shape {x.shape}", expected=expected)
        return np.atleast_2d(np.where(np.isfinite(x), x, np.nan)), x.ndim == 1

    def _inputs(self, x: FloatArray, steady: bool, time_s: npt.ArrayLike | None) -> FloatArray:
        x = np.where(self.needed | np.isfinite(x), x, self.domain.centre)
        if steady or not self.memory_s:
            return np.tile(x, (1, 1 + len(self.memory_s)))
        if time_s is None:
            raise InputError("this model has a memory", where="time_s", found=None, expected="the time of each row [s]")
        return with_memory(np.asarray(time_s, dtype=np.float64), x, self.memory_s)


@dataclass(frozen=True, eq=False, slots=True)
class LivePose:
    """Result of `LiveModel.step`: markers and bones predicted from one row of readings."""

    markers: FloatArray
    """[m], shape (m, 3)."""
    bones: BonePoses | None
    """None if the model has no chain."""
    outside: tuple[Outside, ...]
    """Channels outside of the training domain."""
    interval: FloatArray | None = None
    """Radius of the 95 % interval of each marker [m], shape (m,); None if the model has none, or without a pose."""


class LiveModel:
    """Processes a stream of readings row by row, with the model's memory."""

    def __init__(self, model: ProprioceptiveModel) -> None:
        self.model = model
        self._needed = model.needed
        self._memory: FloatArray | None = None
        self._row: FloatArray = np.zeros(len(model.channels))
        self._time_s = 0.0

    def step(self, row: npt.ArrayLike, time_s: float) -> LivePose:
        """Return markers and bones of a row, shape (c,), read at `time_s` [s].

        If a required reading is not finite, the pose is nan and `outside` lists the channel: keep showing the last valid one.
        """
        model = self.model
        x = model._rows(row)[0][0]
        outside = model.domain.check(x, model.channels, self._needed)
        x = np.where(self._needed, x, model.domain.filled(x))
        if not np.isfinite(x).all():
            return LivePose(np.full((len(model.marker_names), 3), np.nan), None, outside)
        taus = np.asarray(model.memory_s)
        past = np.tile(x, (len(taus), 1))
        if self._memory is not None:
            gap, longest = time_s - self._time_s, longest_gap(model.memory_s)
            past = step_memory(self._memory, self._row, x, gap, taus)
            if gap > longest:
                outside += (Outside("time_s", Why.GAP, gap, 0.0, longest, gap / longest - 1.0),)
        self._memory, self._row, self._time_s = past, x, time_s
        inputs = np.concatenate([x, past.ravel()])[None]
        markers = model.network(inputs).reshape(-1, 3)
        bones = None if model.chain is None else model.bones_of(inputs)
        return LivePose(markers, bones, outside, None if model.spread is None else model.spread.radius(model.network, inputs)[0])


def bone_numbers(poses: BonePoses) -> FloatArray:
    """Return the training targets of an end-to-end network: position [m], x axis and z axis of each bone, shape (9 b,)."""
    T = poses.T_robot_bone
    return np.concatenate([T[:, :3, 3], T[:, :3, 0], T[:, :3, 2]], axis=1).ravel()


def bones_from_numbers(numbers: FloatArray) -> BonePoses:
    """Return bones from 9 numbers each, the axes made orthogonal (z first, then x; Zhou et al. 2019)."""
    place, x, z = np.split(numbers.reshape(-1, 9), 3, axis=1)
    z = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    x = x - (x * z).sum(axis=1, keepdims=True) * z
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    T = np.tile(np.eye(4), (len(place), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = x, np.cross(z, x), z, place
    return poses_from_matrices(T)
