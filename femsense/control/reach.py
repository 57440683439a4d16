"""The inverse problem of motion: cable inputs and pressures that bring points of the body to target positions.

The unknowns u are the tensions of the cables and the pressures of the chambers. Each iteration linearises the equilibrium,

    p(u + du) ≈ p(u) + W_pa du,    s(u + du) ≈ s(u) + W_aa du,

(W from the exact tangent, p the controlled coordinates, s the lengths wound up by the motors) and solves the quadratic programme

    min ½ |p + W_pa du − p*|² + ½ duᵀ S du + ½ λ |du|²   with  u_min ≤ u + du ≤ u_max,  s_min ≤ s + W_aa du ≤ s_max,

of Duriez (2013) and Coevoet et al. (2017) in a trust region that follows the next equilibrium. S is the estimated second-order
part, which matters for unreachable targets (`curvature`). The damping λ acts on the step, not on the input, so that it does not bias the
result. A wanted contact force is applied to the body and the position of the wall becomes one more target: both hold if the robot
presses the wall with that force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.control.corrected import reach_corrected
from femsense.control.found import found
from femsense.control.goal import Goal, Target, make_goal
from femsense.control.limits import make_limits
from femsense.control.motion import REACHED, Motion, WallContact
from femsense.control.search import ReachOptions, Search
from femsense.fem.equilibrium import Equilibrium
from femsense.model.robot import Robot


def reach(
    robot: Robot,
    target: Target,
    *,
    control: str = "tension",
    limits: Mapping[str, tuple[float, float]] | None = None,
    forces: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] | None = None,
    start: Equilibrium | Motion | None = None,
    calibration: Calibration | None = None,
    contacts: Sequence[WallContact] = (),
    options: ReachOptions | None = None,
) -> Motion:
    """Solve the inverse kinematics of a robot: inputs that bring points of the body to target positions, within limits.

    Arguments:
        robot: the robot with its effects. The limits of its cables and chambers apply.
        target: a marker's name, or a point of the body at rest [m] → its target position, robot frame [m], shape (3,); NaN leaves
            a direction free.
        control: kind of the cable commands: "tension" [N] or "displacement" [m].
        limits: name → (minimum, maximum): cable commands [N or m] and chamber pressures [Pa], in addition to those of the robot.
        forces: known or estimated contact forces: (point of the body at rest [m], force on the body [N]), each of shape (3,).
        start: the current state of the robot. Default: the equilibrium without inputs. If the search fails from the current state, it is
            repeated from there.
        calibration: initial inputs, which are subtracted from the commands.
        contacts: walls to press against with a given force.
        options: criteria to end the search.

    Returns:
        the motion; an unreachable target is a status with the closest state and the active limits, not an exception.

    Raises:
        InputError: an unknown marker, cable or control, reversed limits, or a requested correction that the robot lacks.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> motion = fs.reach(fs.load_robot("finger"), {"tip": (np.nan, np.nan, 0.02)})
        >>> motion.status, round(motion.inputs["flexor"], 1)  # N
        ('reached', 1.0)
    """
    known = options or ReachOptions()
    bounds = make_limits(robot, control, limits or {}, calibration)

    def searched(goal: Goal, first: Equilibrium | None) -> Motion:
        search = Search(robot.body, goal, bounds, first, known)
        while not search.status:
            search.advance()
        return found(robot, control, search, search.status, calibration)

    def find(aims: Target, near: Equilibrium | Motion | None) -> Motion:
        goal = make_goal(robot, aims, forces or (), contacts)
        first = near.equilibrium if isinstance(near, Motion) else near
        motion = searched(goal, first)
        if motion.status == REACHED or first is None:
            return motion
        again = searched(goal, None)
        return again if again.error_m < motion.error_m else motion

    return reach_corrected(robot, target, control, find, start) if known.correct else find(target, start)
