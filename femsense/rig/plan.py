"""The plan of a virtual experiment: its script frame by frame, checked against the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.model.robot import Robot
from femsense.rig.planned_contact import PlannedContact, planned_contact
from femsense.rig.script import ScriptTable, SweepTable, script_problem

__all__ = ["Plan", "PlannedContact", "plan_script"]
MOTORS = 7
"""Stream of random numbers of the motors, in addition to those of `rig/experiment.py`."""


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """A script frame by frame, for one robot."""

    control: str
    """"tension" or "displacement"."""
    time_s: FloatArray
    """[s], shape (F,)."""
    sweep: tuple[str, ...]
    free: BoolArray
    """Shape (F,)."""
    commanded: FloatArray
    """Inputs relative to the initial ones [N] or [m], shape (F, a), in the order of the body's cables."""
    initial: FloatArray
    """True inputs before the first sweep [N] or [m], shape (a,)."""
    pressures: FloatArray
    """[Pa], shape (F, c), in the order of the body's chambers."""
    gravity: FloatArray | None
    """[m/s²], shape (F, 3); None: that of the body."""
    load_frame: IntArray
    """Frame index of each known load, shape (L,)."""
    load_points: FloatArray
    """[m], shape (L, 3)."""
    load_forces: FloatArray
    """[N], shape (L, 3)."""
    contacts: tuple[PlannedContact, ...]
    motor_scale: FloatArray | None = None
    """Ratio of true to recorded input of each cable [1], shape (a,); None: 1."""
    backlash: float = 0.0
    """Backlash of the motors [N] or [m]."""

    def pick(self, frames: IntArray) -> Plan:
        """Return the plan restricted to some of its frames."""
        kept = np.isin(self.load_frame, frames)
        return replace(
            self,
            time_s=freeze(self.time_s[frames]),
            sweep=tuple(self.sweep[k] for k in frames),
            free=freeze(self.free[frames], bool),
            commanded=freeze(self.commanded[frames]),
            pressures=freeze(self.pressures[frames]),
            gravity=None if self.gravity is None else freeze(self.gravity[frames]),
            load_frame=freeze(np.searchsorted(frames, self.load_frame[kept]), np.int64),
            load_points=freeze(self.load_points[kept]),
            load_forces=freeze(self.load_forces[kept]),
            contacts=tuple(contact.pick(frames) for contact in self.contacts),
        )


def plan_script(script: ScriptTable, robot: Robot, where: Path = Path("script")) -> Plan:
    """Return a script frame by frame.

    Arguments:
        script: the script.
        robot: defines cables and markers.
        where: for error messages.

    Raises:
        InputError: unknown cables or markers, negative tensions, lists that differ in length from their sweep,
                    missing frames.
    """
    names, chambers = robot.body.cable_names, robot.body.chamber_names
    _check_names(script, robot, where)
    counts = [len(sweep.profile()) for sweep in script.sweeps]
    first = dict(zip((s.label for s in script.sweeps), np.r_[0, np.cumsum(counts)[:-1]].tolist()))
    count = dict(zip(first, counts))
    steps = np.concatenate([np.full(n, s.dt_s or script.dt_s) for s, n in zip(script.sweeps, counts)])
    gravity = robot.body.gravity
    contacts = tuple(
        planned_contact(script, i, (first[c.sweep], count[c.sweep], int(steps.size)), gravity, where)
        for i, c in enumerate(script.contacts)
    )
    touched = {c.table.sweep for c in contacts if c.force.any()}
    initial = np.array([script.initial.get(name, 0.0) for name in names])
    commanded = np.vstack([_sweep_inputs(sweep, sweep.cables, names) for sweep in script.sweeps])
    pressures = np.vstack([_sweep_inputs(sweep, sweep.chambers, chambers) for sweep in script.sweeps])
    _check_pressures(pressures, robot, where)
    if script.actuation == "tension" and (commanded + initial < -1e-12).any():
        raise InputError(
            "a negative tension",
            where=f"{where}: sweeps",
            found=f"{(commanded + initial).min():g} N",
            expected="initial + sweep ≥ 0 N",
        )
    _check_cloud_frames(script, int(steps.size), where)
    frames, points, forces = _planned_loads(script, first, count, where)
    return Plan(
        control=script.actuation,
        time_s=freeze(np.cumsum(steps) - steps[0]),
        sweep=tuple(s.label for s, n in zip(script.sweeps, counts) for _ in range(n)),
        free=freeze(
            np.concatenate(
                [np.full(n, s.label not in touched if s.free is None else s.free) for s, n in zip(script.sweeps, counts)]
            ),
            bool,
        ),
        commanded=freeze(commanded),
        initial=freeze(initial),
        pressures=freeze(pressures),
        gravity=_planned_gravity(script, robot, counts),
        load_frame=freeze(frames, np.int64),
        load_points=freeze(points),
        load_forces=freeze(forces),
        contacts=contacts,
        motor_scale=_motor_scale(script, len(names)),
        backlash=script.motors.backlash,
    )


def _motor_scale(script: ScriptTable, count: int) -> FloatArray | None:
    if not script.motors.gain_std:
        return None
    return freeze(1.0 + script.motors.gain_std * np.random.default_rng([script.seed, MOTORS]).standard_normal(count))


def _check_pressures(pressures: FloatArray, robot: Robot, where: Path) -> None:
    for chamber, column in zip(robot.body.chambers, pressures.T):
        if column.max() > chamber.max_pressure * (1 + 1e-9):
            found, limit = f"{column.max():g} Pa", f"at most max_pressure_pa = {chamber.max_pressure:g} Pa"
            raise InputError(
                "pressure above the chamber's maximum",
                where=f"{where}: sweeps, chamber {chamber.name}",
                found=found,
                expected=limit,
            )


def _check_names(script: ScriptTable, robot: Robot, where: Path) -> None:
    used: list[tuple[str, str, tuple[int | str, ...]]] = [("cable", name, ("initial", name)) for name in script.initial]
    for i, sweep in enumerate(script.sweeps):
        used += [("cable", name, ("sweeps", i, "cables", name)) for name in sweep.cables]
        used += [("chamber", name, ("sweeps", i, "chambers", name)) for name in sweep.chambers]
    for kind, name, place in used:
        known = robot.body.cable_names if kind == "cable" else robot.body.chamber_names
        if name not in known:
            expected = ", ".join(known) or f"a robot with {kind}s"
            raise script_problem(f"unknown {kind}", where, place, repr(name), expected, did_you_mean(name, known))
    for i, name in enumerate(script.markers.names or ()):
        if name not in robot.marker_names:
            raise script_problem(
                "unknown marker",
                where,
                ("markers", "names", i),
                repr(name),
                ", ".join(robot.marker_names),
                did_you_mean(name, robot.marker_names),
            )


def _check_cloud_frames(script: ScriptTable, count: int, where: Path) -> None:
    for i, frame in enumerate(script.clouds.extra_frames):
        if frame >= count:
            raise script_problem("no such frame", where, ("clouds", "extra_frames", i), frame, f"0 … {count - 1}")


def _sweep_inputs(sweep: SweepTable, values: dict[str, float | list[float]], names: Sequence[str]) -> FloatArray:
    """Return the inputs of cables or chambers in a sweep, shape (frames, names)."""
    profile = np.array(sweep.profile())
    table = np.zeros((len(profile), len(names)))
    for name, value in values.items():
        table[:, names.index(name)] = np.asarray(value) if isinstance(value, list) else value * profile
    return table


def _planned_loads(
    script: ScriptTable, first: dict[str, int], count: dict[str, int], where: Path
) -> tuple[IntArray, FloatArray, FloatArray]:
    frames, points, forces = [], [], []
    for i, table in enumerate(script.loads):
        n = count[table.sweep]
        values = np.asarray(table.force_n, dtype=float)
        values = np.tile(values, (n, 1)) if values.ndim == 1 else values
        if len(values) != n:
            raise script_problem(
                "another number of vectors than frames",
                where,
                ("loads", i, "force_n"),
                f"{len(values)} vectors",
                f"{n} vectors, or one",
            )
        frames += [first[table.sweep] + k for k in range(n)]
        points += [table.point_m] * n
        forces += values.tolist()
    return np.array(frames, dtype=np.int64), np.array(points).reshape(-1, 3), np.array(forces).reshape(-1, 3)


def _planned_gravity(script: ScriptTable, robot: Robot, counts: Sequence[int]) -> FloatArray | None:
    if all(sweep.gravity_m_s2 is None for sweep in script.sweeps):
        return None
    rows = [robot.body.gravity if s.gravity_m_s2 is None else np.array(s.gravity_m_s2) for s in script.sweeps]
    return freeze(np.repeat(rows, counts, axis=0))
