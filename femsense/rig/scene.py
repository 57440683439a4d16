"""The scene of a frame: the deformed body, objects in contact or close to it, and the floor."""

from __future__ import annotations

from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles
from femsense.model.robot import Robot
from femsense.rig.camera import Shape
from femsense.rig.experiment import Experiment
from femsense.rig.objects import object_shape, object_surface
from femsense.rig.presses import Hovering, TrueContact
from femsense.rig.script import SceneTable

PLAIN_RGB = (0.6, 0.6, 0.6)
FLOOR_HALF = 1.0
"""Half the side of the floor [m]."""
ROD_LENGTH = 0.12
"""Length of the rod that holds a probe [m]."""


def frame_shapes(experiment: Experiment, k: int) -> list[Shape]:
    """Return the shapes in the k-th frame of an experiment: the body first, then objects in contact or close to it,
    then the floor."""
    robot, frame, scene = experiment.robot, experiment.frames[k], experiment.script.scene
    shapes = [body_shape(robot, frame.state.positions, scene)]
    near: list[TrueContact | Hovering] = [*frame.contacts, *frame.hovering]
    for contact in near:
        planned = experiment.plan.contacts[contact.contact]
        table, T = planned.table, contact.T_robot_object
        if not table.shown:
            continue
        if planned.item is not None and T is not None:
            shapes.append(object_shape(planned.item, object_surface(planned.item, experiment.folder), T))
        elif isinstance(contact, TrueContact):
            shapes.append(probe_shape(contact, table.probe, table.probe_radius_m, np.array(scene.probe_rgb)))
    if scene.floor_z_m is not None:
        shapes.append(floor_shape(scene.floor_z_m, np.array(scene.floor_rgb), scene.floor_albedo))
    return shapes


def body_shape(robot: Robot, positions: FloatArray, scene: SceneTable) -> Shape:
    """Return the deformed surface of a body; positions [m], shape (n, 3)."""
    color = scene.robot_rgb if scene.robot_rgb is not None else robot.color_rgb if robot.color_rgb is not None else PLAIN_RGB
    shape = np.asarray(color, dtype=float)
    return Shape(positions, surface_triangles(robot.body.mesh), shape, scene.robot_albedo, scene.robot_gloss)


def probe_shape(contact: TrueContact, kind: str, radius: float, color: FloatArray) -> Shape:
    """Return a probe [m] that touches the body from outside along the force: a ball or a blunt rod, on a thin rod."""
    import trimesh

    axis = -contact.force / np.linalg.norm(contact.force)
    tip = contact.place
    rod = _rod(tip + 0.5 * radius * axis, tip + (ROD_LENGTH + radius) * axis, 0.45 * radius)
    if kind == "sphere":
        head = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        head.apply_translation(tip + radius * contact.normal)
    else:
        head = _rod(tip, tip + 3.0 * radius * axis, radius)
    both = trimesh.util.concatenate([head, rod])
    return Shape(np.array(both.vertices, dtype=float), np.array(both.faces, dtype=np.int64), color)


def floor_shape(height: float, color: FloatArray, albedo: float = 0.6) -> Shape:
    """Return a level square at a height [m]."""
    h = FLOOR_HALF
    corners = np.array([[-h, -h, height], [h, -h, height], [h, h, height], [-h, h, height]])
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]), color, albedo)


def _rod(start: FloatArray, end: FloatArray, radius: float) -> Any:
    import trimesh

    return trimesh.creation.cylinder(radius=radius, segment=np.stack([start, end]), sections=32)
