"""Residuals of a robot without free parameters and without derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.model.observation import Hypothesis, Scene, SceneJet, evaluate_scene
from femsense.model.robot import Robot


def evaluate_robot(
    robot: Robot,
    scene: Scene,
    poses: Sequence[FloatArray],
    initial: FloatArray | None,
    starts: dict[int, Equilibrium] | None = None,
) -> SceneJet:
    """Return the residuals and states of a scene.

    Arguments:
        robot: the robot.
        scene: the measurements.
        poses: `T_robot_camera` of each camera [m], shape (4, 4).
        initial: unknown initial inputs of the actuators; None if the recorded inputs are absolute.
        starts: states of nearby evaluations, used as warm starts and updated.

    Raises:
        DataError: a frame has no equilibrium.
    """
    return evaluate_scene(
        Hypothesis(robot),
        scene,
        np.zeros(0),
        poses,
        initial,
        derivative=False,
        vary_initial=False,
        pivot=robot.marker_points.mean(axis=0),
        starts=starts,
    )
