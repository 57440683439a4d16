"""Inputs for targets with the robot's empirical correction g of the model. g is a function of the inputs, so that p_model(u) = p* − g(u) is
solved by fixed-point iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from femsense.control.goal import Target
from femsense.control.motion import REACHED, STOPPED, Motion
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.fem.equilibrium import Equilibrium
from femsense.model.robot import Robot

ROUNDS, SETTLED = 20, 1e-6
"""Maximum number of iterations, and change of the correction [m] at which they end."""


Start = Equilibrium | Motion | None


def reach_corrected(robot: Robot, target: Target, control: str, find: Callable[[Target, Start], Motion], start: Start) -> Motion:
    """Return the motion that brings markers to targets by the model with its correction.

    Arguments:
        robot: with a correction.
        target: marker → its target position [m], robot frame.
        control: kind of the cable commands.
        find: returns the inputs for a target by the model alone, from a state.
        start: the current state of the robot.

    Raises:
        InputError: no correction, one that was learned with other inputs, or a target that is not one of its markers.
    """
    correction = robot.require_correction()
    correction.check(control, (*robot.body.cable_names, *robot.body.chamber_names), where="control")
    for key in target:
        if key not in correction.marker_names:
            raise InputError(
                "the correction does not include this marker",
                where="target",
                found=key,
                expected=", ".join(correction.marker_names),
                hint="leave --correct out",
            )
    index = [correction.marker_names.index(str(key)) for key in target]
    wanted = np.array([np.asarray(place, dtype=np.float64) for place in target.values()])
    shift, near, change = np.zeros_like(wanted), start, np.inf
    for _ in range(ROUNDS):
        near = motion = find(dict(zip(target, wanted - shift)), near)
        shifts, std = correction.shifts(np.array([[motion.inputs[name] for name in correction.input_names]]))
        change = float(np.abs(shifts[0, index] - shift).max())
        shift = shifts[0, index]
        if change < SETTLED:
            break
    return _with_correction(motion, wanted, shift, float(std[0]), settled=change < SETTLED)


def _with_correction(motion: Motion, wanted: FloatArray, shift: FloatArray, std: float, *, settled: bool) -> Motion:
    """Return a motion with corrected positions; without convergence its status is stopped."""
    places = {name: freeze(place + s) for (name, place), s in zip(motion.reached_m.items(), shift)}
    off = np.nan_to_num(wanted - np.array(list(places.values())))
    status = motion.status if settled or motion.status != REACHED else STOPPED
    error = float(np.linalg.norm(off, axis=1).max())
    return replace(motion, reached_m=places, error_m=error, status=status, correction_std_m=std)
