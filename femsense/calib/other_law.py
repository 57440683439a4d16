"""The robot under another law that agrees with its own for small strains: how far apart both are is what a law may err by."""

from __future__ import annotations

from dataclasses import replace

from femsense.model.robot import Robot


def with_other_law(robot: Robot) -> Robot | None:
    """Return the robot under the neo-Hookean law; None where it declares a law by an effect."""
    body = robot.body
    if body.material.law != "corotational":
        return None
    return replace(robot, body=replace(body, material=replace(body.material, law="neo_hookean")))
