"""Geometric checks of a script: a floor or an object that intersects the robot, a contact far from the surface.

The rig simulates all of these; the camera then sees a robot that is partly hidden, or a force acts away from its
stated place. Each is therefore a warning with the distance.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, diagonal
from femsense.core.text import key_path
from femsense.fem.mesh import surface_triangles
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface
from femsense.rig.camera import Shape
from femsense.rig.experiment import Experiment
from femsense.rig.objects import object_shape, object_surface
from femsense.rig.patches import nearest_place
from femsense.rig.presses import Hovering, TrueContact
from femsense.rig.script import ScriptTable

OFF_SURFACE = 0.01
"""A contact farther from the surface at rest than this share of the body's diagonal is reported."""
CUT = 0.001
"""Depth of an intersection that is reported [m]; contacts indent less."""


def warn_of_script(script: ScriptTable, robot: Robot, where: Path) -> None:
    """Warn of contacts and loads far from the surface, and of a floor that intersects the robot at rest.

    Arguments:
        script, robot: of the simulation.
        where: for messages.
    """
    mesh = robot.body.mesh
    for location, point in _places(script):
        near, _ = nearest_place(mesh, np.asarray(point, dtype=float))
        off = float(np.linalg.norm(near - point))
        if off > max(CUT, OFF_SURFACE * diagonal(mesh.nodes)):
            warnings.warn(
                f"{where}: {key_path(location)} is {1e3 * off:.1f} mm from the surface of {robot.name} at rest; "
                f"the force acts at the nearest place, [{_metres(near)}]",
                stacklevel=3,
            )
    _warn_of_floor(script, robot, mesh.nodes, "at rest", where)


def warn_of_experiment(experiment: Experiment, where: Path) -> None:
    """Warn of a floor or objects that intersect the moving robot; each once, in its worst frame."""
    if not experiment.frames:
        return
    robot, script, mesh = experiment.robot, experiment.script, experiment.robot.body.mesh
    states = [frame.state.positions for frame in experiment.frames]
    if script.scene.floor_z_m is not None and _below(robot, mesh.nodes, script.scene.floor_z_m) <= CUT:
        lowest = int(np.argmin([x[:, 2].min() for x in states]))
        _warn_of_floor(script, robot, states[lowest], f"in frame {experiment.numbers[lowest]}", where)
    triangles = surface_triangles(mesh)
    worst: dict[int, tuple[float, int]] = {}
    for k, frame in enumerate(experiment.frames):
        near: list[TrueContact | Hovering] = [*frame.contacts, *frame.hovering]
        for contact in near:
            item = experiment.plan.contacts[contact.contact].item
            if item is None or contact.T_robot_object is None:
                continue
            shape = object_shape(item, object_surface(item, experiment.folder), contact.T_robot_object)
            depth = _overlap(Shape(states[k], triangles, shape.color), shape)
            worst[contact.contact] = max(worst.get(contact.contact, (0.0, k)), (depth, k), key=lambda found: found[0])
    for i, (depth, k) in worst.items():
        item = experiment.plan.contacts[i].item
        if depth > CUT and item is not None:
            warnings.warn(
                f"{where}: {key_path(('contacts', i))}: {item.kind} {item.name} cuts {1e3 * depth:.1f} mm into {robot.name} in frame "
                f"{experiment.numbers[k]}: it is too large for this place, or lies across another part of the body",
                stacklevel=3,
            )


def _places(script: ScriptTable) -> Iterator[tuple[tuple[int | str, ...], list[float]]]:
    for i, contact in enumerate(script.contacts):
        if contact.point_m is not None:
            yield ("contacts", i, "point_m"), contact.point_m
        for j, point in enumerate(contact.path_m or ()):
            yield ("contacts", i, "path_m", j), point
    for i, load in enumerate(script.loads):
        yield ("loads", i, "point_m"), load.point_m


def _warn_of_floor(script: ScriptTable, robot: Robot, positions: FloatArray, when: str, where: Path) -> None:
    height = script.scene.floor_z_m
    depth = 0.0 if height is None else _below(robot, positions, height)
    if depth > CUT:
        warnings.warn(
            f"{where}: the floor intersects {robot.name}: {when} the body reaches {1e3 * depth:.1f} mm below scene.floor_z_m = {height:g}, "
            f"and the camera does not see that part. Set scene.floor_z_m below {np.floor(1e3 * positions[:, 2].min()) / 1e3:.3f}",
            stacklevel=4,
        )


def _below(robot: Robot, positions: FloatArray, height: float) -> float:
    """Return the depth of the moving part of a body below a height [m]; the clamp may stand in the floor."""
    moving = np.setdiff1d(np.unique(surface_triangles(robot.body.mesh)), robot.body.clamped)
    return max(0.0, float(height - positions[moving, 2].min())) if len(moving) else 0.0


def _overlap(body: Shape, item: Shape) -> float:
    """Return the largest depth of the points of two closed surfaces inside each other [m]; 0 if they do not intersect."""
    depth = 0.0
    for one, other in ((body, item), (item, body)):
        points = one.points[np.unique(one.triangles)]
        low, high = other.points.min(axis=0), other.points.max(axis=0)
        inside = points[((points > low) & (points < high)).all(axis=1)]
        if len(inside):
            gap = Surface(other.points, other.triangles).signed_gap(inside, within=np.inf)
            depth = max(depth, float(-gap.min()))
    return depth


def _metres(point: FloatArray) -> str:
    return ", ".join(f"{x:.4f}" for x in point)
