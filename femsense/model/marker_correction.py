"""An empirical correction of the difference between markers and model, as a smooth function of the inputs. It has no physical meaning.

`femsense improve --correct` fits it (`loop/fit/correction.py`); `calibrate`, `estimate` and `reach` apply it with `--correct`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.model.recording import Recording

SEPARATE, TOGETHER = "each input by itself", "all inputs together"
KERNELS = SEPARATE, TOGETHER


@dataclass(frozen=True, eq=False, slots=True)
class Correction:
    """A function of the inputs: how far each marker is from the model."""

    kernel: str
    """One of KERNELS."""
    length: float
    """In ranges of an input."""
    control: str
    """Kind of the inputs with which it was learned: "tension" or "displacement"."""
    input_names: tuple[str, ...]
    """Cables, then chambers."""
    ranges: FloatArray
    """Of the inputs as recorded [N], [m] or [Pa], shape (a,)."""
    marker_names: tuple[str, ...]
    states: FloatArray
    """Inputs of the states that it was learned from, in their ranges, shape (n, a)."""
    basis: FloatArray
    """From the kernel to the terms, shape (n, q)."""
    weights: FloatArray
    """Of the terms, robot frame [m], shape (q, m, 3)."""
    covariance: FloatArray
    """Of the weights of one axis of a marker [m²], shape (q, q)."""
    noise: float
    """Residual standard deviation of a marker along each axis on the data with which it was learned [m]."""

    @property
    def terms(self) -> int:
        """Return how many terms it has."""
        return int(self.basis.shape[1])

    def shifts(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return measured minus modelled markers, robot frame [m], shape (f, m, 3), for recorded inputs, shape (f, a); and one standard
        deviation along each axis [m], shape (f,)."""
        terms = kernel_of(self.kernel, self.length, inputs / self.ranges, self.states) @ self.basis
        variance = np.einsum("fq,qr,fr->f", terms, self.covariance, terms)
        return np.einsum("fq,qmc->fmc", terms, self.weights), np.sqrt(np.maximum(variance, 0.0))

    def of_rows(self, recording: Recording) -> tuple[FloatArray, FloatArray]:
        """Return the correction of each marker observation of a recording, robot frame [m], shape (K, 3), and its standard deviation [m],
        shape (K,); zero for unknown markers.

        Raises:
            InputError: a recording that is driven otherwise.
        """
        self.check(recording.actuation, (*recording.cable_names, *recording.chamber_names), where=str(recording.folder))
        shifts, std = self.shifts(recorded_inputs(recording)[recording.marker_frame])
        index = np.array([*map(self._number, recording.marker_names), -1])[recording.marker_index]
        known = index >= 0
        return np.where(known[:, None], shifts[np.arange(len(index)), index], 0.0), np.where(known, std, 0.0)

    def _number(self, marker: str) -> int:
        return self.marker_names.index(marker) if marker in self.marker_names else -1

    def check(self, control: str, names: Sequence[str], *, where: str) -> None:
        """Raise InputError where a robot is driven otherwise than where this was learned."""
        if (control, *names) != (self.control, *self.input_names):
            raise InputError(
                "the correction was learned from other inputs",
                where=where,
                found=f"{control} of {', '.join(names)}",
                expected=f"{self.control} of {', '.join(self.input_names)}",
                hint="leave --correct out, or learn another: femsense improve --correct",
            )


def recorded_inputs(recording: Recording) -> FloatArray:
    """Return the inputs of each frame as recorded, of cables, then of chambers [N], [m] or [Pa], shape (F, a + c)."""
    return np.concatenate([recording.inputs, recording.pressures], axis=1)


def kernel_of(kind: str, length: float, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the kernel between inputs (n, a) and (k, a) in their ranges, shape (n, k). That of each input by itself is none at rest."""
    own = np.exp(-0.5 * (a[:, None, :] - b[None, :, :]) ** 2 / length**2)
    if kind == TOGETHER:
        return np.asarray(own.prod(axis=2))
    at_rest = [np.exp(-0.5 * values**2 / length**2) for values in (a, b)]
    return np.asarray((own - at_rest[0][:, None, :] * at_rest[1][None, :, :]).sum(axis=2))


def corrected(recording: Recording, correction: Correction, poses: Sequence[FloatArray]) -> Recording:
    """Return a recording with corrected markers, to be fitted by the model alone.

    Arguments:
        recording: markers and inputs.
        correction: of the robot.
        poses: T_robot_camera of each camera, each (4, 4); only their rotations count.

    Raises:
        InputError: a recording that is driven otherwise.
    """
    shifts = correction.of_rows(recording)[0]
    turns = np.array([T[:3, :3] for T in poses])[recording.marker_view]
    return replace(recording, marker_xyz=freeze(recording.marker_xyz - np.einsum("kc,kcd->kd", shifts, turns)))
