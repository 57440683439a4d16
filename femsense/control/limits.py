"""Limits of cables and chambers, and the conversion between commands and true inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.fem.body import BodyModel
from femsense.model.robot import Robot

CONTROLS = ("tension", "displacement")


@dataclass(frozen=True, eq=False, slots=True)
class Limits:
    """Bounds of efforts (tensions [N], then pressures [Pa]) and of the lengths wound up by the motors [m]."""

    low: FloatArray
    high: FloatArray
    short_low: FloatArray
    short_high: FloatArray
    names: tuple[str, ...]

    def rows(
        self, slopes: FloatArray, wound: FloatArray, low: FloatArray, high: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None, list[tuple[int, str]]]:
        """Return G and h of the length limits for scaled steps within low … high, and the limit of each row.

        A violated limit is relaxed to a value that most of the trust region can reach, so that the problem is feasible.
        """
        pairs = [(i, "longest", slopes[i], self.short_high[i] - wound[i]) for i in range(len(wound))]
        pairs += [(i, "shortest", -slopes[i], wound[i] - self.short_low[i]) for i in range(len(wound))]
        pairs = [pair for pair in pairs if np.isfinite(pair[3])]
        if not pairs:
            return None, None, []
        G = np.stack([row for _, _, row, _ in pairs])
        least = np.where(G > 0, low, high)
        within = 0.9 * np.einsum("mk,mk->m", G, np.where(np.isfinite(least), least, 0.0))
        return G, np.maximum([room for *_, room in pairs], within), [(i, which) for i, which, _, _ in pairs]

    def violation(self, wound: FloatArray) -> float:
        """Return the largest violation of a length limit [m]."""
        return float(np.maximum(wound - self.short_high, self.short_low - wound).max(initial=0.0))

    def outside(self, effort: FloatArray) -> float:
        """Return the largest violation of an effort limit [N, Pa]."""
        return float(np.maximum(effort - self.high, self.low - effort).max(initial=0.0))

    def text(self, i: int, which: str, body: BodyModel) -> str:
        """Return a limit in words."""
        name = self.names[i]
        if which in ("shortest", "longest"):
            value = self.short_low[i] if which == "shortest" else self.short_high[i]
            return f"{name} wound up by {'no less' if which == 'shortest' else 'no more'} than {1e3 * value:.4g} mm"
        value = self.low[i] if which == "least" else self.high[i]
        if i >= len(body.cables):
            return f"{name} at its {which} pressure, {value:.4g} Pa"
        return f"{name} cannot push" if which == "least" and value == 0 else f"{name} at its {which} tension, {value:.4g} N"


# Commands and efforts


def make_limits(robot: Robot, control: str, limits: Mapping[str, tuple[float, float]], calibration: Calibration | None) -> Limits:
    """Return the limits of the inputs: those of the robot, narrowed by the given ones. Raises InputError."""
    if control not in CONTROLS:
        raise InputError("unknown control", where="control", found=control, expected=" or ".join(CONTROLS))
    body = robot.body
    low = np.array([*(c.min_tension for c in body.cables), *(0.0 for _ in body.chambers)])
    high = np.array([*(c.max_tension for c in body.cables), *(c.max_pressure for c in body.chambers)])
    a = len(body.cables)
    short = np.full(a, -np.inf), np.full(a, np.inf)
    names = [*body.cable_names, *body.chamber_names]
    for name, pair in limits.items():
        if name not in names:
            raise InputError(
                "unknown cable or chamber",
                where="limits",
                found=name,
                expected=", ".join(names),
                hint=did_you_mean(name, names),
            )
        least, largest = (float(v) for v in pair)
        if not least <= largest:
            raise InputError(
                "reversed limits",
                where=f"limits[{name}]",
                found=f"{least:g}, {largest:g}",
                expected="(least, largest)",
            )
        i = names.index(name)
        if i < a:
            least, largest = (true_input(robot, control, i, v, calibration) for v in (least, largest))
        elif calibration is not None:
            zero = calibration.chamber_pressure_pa.get(name, 0.0)
            least, largest = least + zero, largest + zero
        if i < a and control == "displacement":
            short[0][i], short[1][i] = least, largest
        else:
            low[i], high[i] = max(low[i], least), min(high[i], largest)
    return Limits(low, np.maximum(high, low), *short, names=tuple(names))


def true_input(robot: Robot, control: str, i: int, command: float, calibration: Calibration | None) -> float:
    """Return the true tension [N] or shortening [m] under a command to cable i."""
    act, counted = robot.actuation, command + _initial(robot, control, i, calibration)
    if control == "tension":
        return float(act.gain[i] * counted + act.tension_offset[i])
    return float(act.gain[i] * counted + act.displacement_offset[i] - act.slack[i])


def command(robot: Robot, control: str, i: int, true: float, calibration: Calibration | None) -> float:
    """Return the command to cable i for a true tension [N] or shortening [m]."""
    act = robot.actuation
    offset = act.tension_offset[i] if control == "tension" else act.displacement_offset[i] - act.slack[i]
    return float((true - offset) / act.gain[i]) - _initial(robot, control, i, calibration)


def _initial(robot: Robot, control: str, i: int, calibration: Calibration | None) -> float:
    if calibration is None:
        return 0.0
    table = calibration.cable_tension_n if control == "tension" else calibration.cable_displacement_m
    return table.get(robot.body.cable_names[i], 0.0)
