"""The same experiment told in another way: other units, another order, another world, other numbers; and a log that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import tomli_w

from femsense.core.arrays import FloatArray, freeze
from femsense.core.pose import transform_points
from femsense.fem.body import make_body, tie_cable
from femsense.fem.mesh import TetMesh, embed_points, to_linear, to_quadratic
from femsense.io.robot_toml import load_robot, robot_document
from femsense.model.recording import Recording
from femsense.model.robot import Robot, spread_features

SCALE = {"m": 1.0, "cm": 1e2, "mm": 1e3}


# --- recordings --------------------------------------------------------------------------------------------------------------


def in_order(recording: Recording, order: Sequence[int]) -> Recording:
    """Return a recording with its frames in another order; the time before each frame goes with it."""
    r, order = recording, np.asarray(order)
    steps = np.diff(r.time_s, prepend=r.time_s[0] - (r.time_s[1] - r.time_s[0]))[order]
    new = np.empty(len(order), dtype=int)
    new[order] = np.arange(len(order))
    rows, loads = np.argsort(new[r.marker_frame], kind="stable"), np.argsort(new[r.load_frame], kind="stable")
    return replace(
        r,
        time_s=freeze(np.cumsum(steps) - steps[0]),
        inputs=freeze(r.inputs[order]),
        pressures=freeze(r.pressures[order]),
        free=None if r.free is None else freeze(r.free[order], np.bool_),
        sweep=None if r.sweep is None else tuple(r.sweep[k] for k in order),
        gravity=None if r.gravity is None else freeze(r.gravity[order]),
        marker_frame=freeze(new[r.marker_frame][rows], np.int64),
        marker_index=freeze(r.marker_index[rows], np.int64),
        marker_view=freeze(r.marker_view[rows], np.int64),
        marker_xyz=freeze(r.marker_xyz[rows]),
        load_frame=freeze(new[r.load_frame][loads], np.int64),
        load_points=freeze(r.load_points[loads]),
        load_forces=freeze(r.load_forces[loads]),
    )


def sweeps_shuffled(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return a recording with its sweeps in another order, each with its frames as they were."""
    assert recording.sweep is not None
    labels = list(dict.fromkeys(recording.sweep))
    order = [k for i in rng.permutation(len(labels)) for k, label in enumerate(recording.sweep) if label == labels[i]]
    return in_order(recording, order)


def log_permuted(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return a recording whose inputs belong to other frames: nothing that the cables do can explain the markers any more."""
    order = rng.permutation(recording.frame_count)
    return replace(recording, inputs=freeze(recording.inputs[order]), pressures=freeze(recording.pressures[order]))


def reordered(robot: Robot, recording: Recording, rng: np.random.Generator) -> tuple[Robot, Recording]:
    """Return robot and recording with their markers in other orders, each in its own;
    the rows of a frame and the columns of cables too."""
    r, order = recording, rng.permutation(len(robot.marker_names))
    other = replace(
        robot,
        marker_names=tuple(robot.marker_names[i] for i in order),
        marker_points=freeze(robot.marker_points[order]),
        markers=robot.markers[order],
    )
    turn = rng.permutation(len(r.marker_names))
    new = np.argsort(turn)
    rows = np.lexsort((rng.random(len(r.marker_frame)), r.marker_frame))
    seen = replace(
        r,
        marker_names=tuple(r.marker_names[i] for i in turn),
        marker_index=freeze(new[r.marker_index][rows], np.int64),
        marker_frame=freeze(r.marker_frame[rows], np.int64),
        marker_xyz=freeze(r.marker_xyz[rows]),
        marker_view=freeze(r.marker_view[rows], np.int64),
    )
    columns = rng.permutation(len(r.cable_names))
    seen = replace(seen, cable_names=tuple(r.cable_names[i] for i in columns), inputs=freeze(r.inputs[:, columns]))
    return other, seen


# --- robots ------------------------------------------------------------------------------------------------------------------


def renumbered(robot: Robot, rng: np.random.Generator) -> Robot:
    """Return the robot on the same mesh with nodes, elements, and corners of elements in other orders."""
    linear = to_linear(robot.body.mesh)
    order = rng.permutation(len(linear.nodes))
    new = np.argsort(order)
    tets = new[linear.tets][rng.permutation(len(linear.tets))]
    turns = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [1, 0, 3, 2], [2, 3, 0, 1]])  # even: elements keep their orientation
    tets = np.take_along_axis(tets, turns[rng.integers(len(turns), size=len(tets))], axis=1)
    return _built(robot, TetMesh(linear.nodes[order], tets), np.eye(4))


def turned_world(robot: Robot, recording: Recording, T: FloatArray) -> tuple[Robot, Recording]:
    """Return robot and recording in a frame that is moved by T (4, 4): body, gravity, loads and camera all with it."""
    linear = to_linear(robot.body.mesh)
    r, R = recording, T[:3, :3]
    moved = replace(
        r,
        T_robot_camera=tuple(None if pose is None else freeze(T @ pose) for pose in r.T_robot_camera),
        gravity=None if r.gravity is None else freeze(r.gravity @ R.T),
        load_points=freeze(transform_points(T, r.load_points)),
        load_forces=freeze(r.load_forces @ R.T),
    )
    return _built(robot, TetMesh(transform_points(T, linear.nodes), linear.tets), T), moved


def _built(robot: Robot, linear: TetMesh, T: FloatArray) -> Robot:
    """Return a plain robot built anew on a mesh, everything else of it moved by T."""
    body, R = robot.body, T[:3, :3]
    mesh = to_quadratic(linear) if body.mesh.is_quadratic else linear
    held = {tuple(p) for p in transform_points(T, body.mesh.nodes[body.clamped]).round(9)}
    cables = tuple(
        tie_cable(
            mesh,
            c.name,
            transform_points(T, c.path.positions(body.mesh.nodes)),
            transform_points(T, c.pull_point[None])[0],
            exit_direction=None if c.exit_direction is None else R @ c.exit_direction,
            min_tension=c.min_tension,
            max_tension=c.max_tension,
        )
        for c in body.cables
    )
    material = body.material
    made = make_body(
        mesh,
        young_modulus=float(material.young_modulus[0]),
        poisson_ratio=float(material.poisson_ratio[0]),
        density=material.density,
        law=material.law,
        clamped=np.array([tuple(p) in held for p in mesh.nodes.round(9)]),
        cables=cables,
        gravity=R @ body.gravity,
    )
    assert made.clamped.size == body.clamped.size
    points = transform_points(T, robot.marker_points)
    return replace(
        robot,
        body=made,
        marker_points=freeze(points),
        markers=embed_points(mesh, points),
        features=spread_features(made, len(robot.features)),
    )


def in_unit(robot: Robot, unit: str, folder: Path) -> Robot:
    """Return a plain robot written with its mesh in a unit ("m", "cm" or "mm") and loaded again."""
    folder.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = robot_document(robot)
    linear = to_linear(robot.body.mesh)
    document["mesh"] = {"file": "mesh.vtu", "unit": unit, "element": "tet10" if robot.body.mesh.is_quadratic else "tet4"}
    for table in document["fixed"]:
        low, high = np.array(table["box_m"])
        table["box_m"] = [(low - 1e-6).tolist(), (high + 1e-6).tolist()]
    meshio.Mesh(np.asarray(linear.nodes) * SCALE[unit], [("tetra", np.asarray(linear.tets))]).write(folder / "mesh.vtu")
    (folder / "robot.toml").write_text(tomli_w.dumps(document))
    return load_robot(folder)


__all__ = ["in_order", "in_unit", "log_permuted", "renumbered", "reordered", "sweeps_shuffled", "turned_world"]
