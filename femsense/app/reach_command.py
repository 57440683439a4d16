"""`femsense reach`: from places on the command line to inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from femsense.app.command_line.parameters import three_numbers
from femsense.core.arrays import FloatArray, diagonal
from femsense.core.errors import InputError
from femsense.io.files import check_target, write_json
from femsense.io.own_files import MOTION
from femsense.model.robot import Robot

FORMAT = "femsense-motion-1"
FAR = 10.0
"""A target that is farther from the body than this number of its diagonals is in another unit."""


def reach_targets(
    robot: str,
    targets: Sequence[str],
    *,
    control: str = "tension",
    forces: Sequence[str] = (),
    calibration: Path | None = None,
    output: Path | None = None,
    correct: bool = False,
) -> tuple[dict[str, Any], str, bool]:
    """Find the inputs for targets NAME=X,Y,Z; return the motion as plain tables and as text, and whether all is reached.

    Raises:
        InputError: an argument cannot be read, or names no marker.
    """
    from femsense.calib.files import read_calibration
    from femsense.control.motion import REACHED
    from femsense.control.reach import reach
    from femsense.control.search import ReachOptions
    from femsense.io.robot_toml import load_robot

    if output is not None:
        check_target(output, folder=False, kind=MOTION)
    body = load_robot(robot)
    wanted = dict(_target(text) for text in targets)
    _check_size(body, wanted)
    known = None if calibration is None else read_calibration(calibration)
    loads = [_force(text) for text in forces]
    motion = reach(body, wanted, control=control, forces=loads, calibration=known, options=ReachOptions(correct=correct))
    unit = {name: "N" if control == "tension" else "m" for name in body.body.cable_names}
    document = {
        "format": FORMAT,
        "status": motion.status,
        "error_m": motion.error_m,
        "control": control,
        "inputs": motion.inputs,
        "units": {name: unit.get(name, "Pa") for name in motion.inputs},
        "reached_m": motion.reached_m,
        "limits": list(motion.limits),
        "tension_n": motion.equilibrium.tension,
        "certificate": asdict(motion.certificate),
        "equilibria": motion.iterations,
    }
    if motion.correction_std_m is not None:
        document["correction_std_m"] = motion.correction_std_m
    if output is not None:
        write_json(output, document)
    lines = [motion.text, ""]
    width = max((len(name) for name in motion.inputs), default=0)
    for name, value in motion.inputs.items():
        lines.append(f"  {name:<{width}}  {_amount(value, unit.get(name, 'Pa'))}")
    if output is not None:
        lines += ["", f"written: {output}"]
    return document, "\n".join(lines), motion.status == REACHED


def _amount(value: float, unit: str) -> str:
    return f"{1e3 * value:+.3f} mm" if unit == "m" else f"{round(value, 9):.4g} {unit}"


def _check_size(robot: Robot, wanted: Mapping[Any, FloatArray]) -> None:
    """Raise InputError where a target is so far away that it is in another unit."""
    low, high = robot.body.mesh.nodes.min(axis=0), robot.body.mesh.nodes.max(axis=0)
    far = FAR * diagonal(robot.body.mesh.nodes)
    for name, place in wanted.items():
        if np.nanmax(np.maximum(low - place, place - high), initial=-np.inf) > far:
            raise InputError(
                f"the target of {name} is farther than {FAR:.0f} times the body's size from it",
                where="--target",
                found=", ".join("free" if np.isnan(x) else f"{x:g}" for x in place),
                expected=f"metres, robot frame; the body reaches from {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()}",
                hint="this looks like millimetres: divide by 1000",
            )


def _target(text: str) -> tuple[str | tuple[float, float, float], np.ndarray]:
    """Return the target of NAME=X,Y,Z or X,Y,Z=X,Y,Z."""
    name, equals, place = text.rpartition("=")
    if not equals or not name:
        raise InputError("not a target", where="--target", found=text, expected="MARKER=X,Y,Z in metres, robot frame")
    point = _numbers(place, "--target", free=True)
    if name.count(",") == 2:
        x, y, z = _numbers(name, "--target")
        return (float(x), float(y), float(z)), point
    return name, point


def _force(text: str) -> tuple[np.ndarray, np.ndarray]:
    place, equals, force = text.partition("=")
    if not equals:
        raise InputError(
            "not a force", where="--force", found=text, expected="X,Y,Z=FX,FY,FZ (metres on the body at rest, newtons)"
        )
    return _numbers(place, "--force"), _numbers(force, "--force")


def _numbers(text: str, where: str, *, free: bool = False) -> np.ndarray:
    values = three_numbers(text, free=free)
    if values is None:
        raise InputError("not three numbers", where=where, found=text, expected="X,Y,Z in metres (an empty one is left free)")
    return np.array(values)
