"""The state of a search as a `Motion`: commands, positions and texts."""

from __future__ import annotations

from femsense.calib.calibration import Calibration
from femsense.control.limits import command
from femsense.control.motion import REACHED, Certificate, Motion
from femsense.control.search import Search, efforts_of, wound_up
from femsense.core.arrays import freeze
from femsense.model.robot import Robot


def found(robot: Robot, control: str, search: Search, status: str, calibration: Calibration | None) -> Motion:
    """Return the state of a search as a motion with a status."""
    body, goal, bounds, state = robot.body, search.goal, search.bounds, search.state
    effort, wound, miss = efforts_of(state), wound_up(body, state), goal.miss(state.positions)
    true = effort[: len(wound)] if control == "tension" else wound
    inputs = {name: command(robot, control, i, float(true[i]), calibration) for i, name in enumerate(body.cable_names)}
    zeros = {} if calibration is None else calibration.chamber_pressure_pa
    inputs.update({name: pressure - zeros.get(name, 0.0) for name, pressure in state.pressure.items()})
    places = goal.ties.positions(state.positions)
    share = search.last.gain / max(float(miss @ miss), 1e-300) if status != REACHED else 0.0
    certificate = Certificate(state.residual_n, max(share, 0.0), bounds.violation(wound) + bounds.outside(effort))
    return Motion(
        inputs=inputs,
        positions=state.positions,
        reached_m={name: freeze(place) for name, place in zip(goal.names, places)},
        error_m=goal.error(state.positions),
        status=status,
        limits=() if status == REACHED else _words(search),
        certificate=certificate,
        iterations=search.count,
        equilibrium=state,
    )


def _words(search: Search) -> tuple[str, ...]:
    """Return the active limits, and the end of the equilibria, in words."""
    active = tuple(search.bounds.text(i, which, search.body) for _, i, which in search.last.active)
    return (*active, f"no equilibrium further on ({search.beyond})") if search.beyond else active
