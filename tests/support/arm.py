"""A small arm with four cables, and recordings of it made with another mesh and law than the one that estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from helpers import block_mesh

from femsense.core.arrays import freeze
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.fem.body import make_body, tie_cable
from femsense.fem.equilibrium import SolveOptions
from femsense.fem.mesh import embed_points, to_quadratic
from femsense.model.drive import DrivenRobot, drive_of, frame_loads
from femsense.model.effects import apply_effects
from femsense.model.frame_state import solve_frame
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.robot import Observation, Robot, plain_actuation, spread_features

LENGTH, WIDTH = 0.1, 0.02
NAMES = ("up", "down", "left", "right")
SIDES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]], dtype=float)
T_ROBOT_CAMERA = make_pose(rotation_from_vector([2.4, 0.0, 0.0]), [0.05, 0.25, 0.28])


def arm(
    cells: Sequence[int] = (7, 2, 2),
    *,
    law: str = "corotational",
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    modulus: float = 300e3,
) -> Robot:
    """Return an arm of 100 × 20 × 20 mm along x, clamped at x = 0."""
    mesh = to_quadratic(block_mesh(cells, (LENGTH, WIDTH, WIDTH), start=(0.0, -WIDTH / 2, -WIDTH / 2)))
    cables = tuple(
        tie_cable(
            mesh,
            name,
            [[0.095, *(0.008 * s[1:])], [0.05, *(0.008 * s[1:])]],
            [-0.01, *(0.012 * s[1:])],
            exit_direction=[-0.2, *s[1:]],
            max_tension=10.0,
        )
        for name, s in zip(NAMES, SIDES)
    )
    body = make_body(
        mesh,
        young_modulus=modulus,
        poisson_ratio=0.45,
        density=1070.0,
        law=law,
        clamped=mesh.nodes[:, 0] < 1e-9,
        cables=cables,
        gravity=gravity,
    )
    points = np.array([[x, *(0.5 * WIDTH * s[1:])] for x in (0.005, 0.05, 0.095) for s in SIDES])
    names = tuple(f"m{i}" for i in range(len(points)))
    return Robot(
        "arm",
        body,
        names,
        freeze(points),
        embed_points(mesh, points),
        spread_features(body, 40),
        freeze([0.2, 0.4, 0.8]),
        plain_actuation(4),
        Observation(),
    )


def sweeps(height: float = 2.0, *, each: int = 2) -> tuple[np.ndarray, list[str]]:
    """Return inputs (F, 4) that pull one cable, then pairs, up and down, and the label of the sweep of each frame."""
    rows, labels = [], []
    for label, cables in (("up", [0]), ("left", [2]), ("down", [1]), ("right", [3]), ("up-left", [0, 2])):
        levels = [*np.linspace(0, height, each + 1), *np.linspace(height, 0, each + 1)[1:]]
        for level in levels:
            row = np.zeros(4)
            row[cables] = level
            rows.append(row)
            labels.append(label)
    return np.array(rows), labels


def record(
    inputs: np.ndarray,
    *,
    effects: Sequence[dict] = (),
    noise: float = 1e-4,
    seed: int = 0,
    zero: str = "absolute",
    initial: np.ndarray | None = None,
    labels: list[str] | None = None,
    free: bool = True,
    forces: dict[int, tuple[np.ndarray, np.ndarray]] | None = None,
    truth: Robot | None = None,
    placements: np.ndarray | None = None,
    actuation: str = "tension",
) -> tuple[Recording, list[np.ndarray]]:
    """Return a recording of the true arm (finer mesh, neo-Hookean) and its node positions in each frame.

    `forces`: frame → (place at rest, force) of an undeclared contact. `placements`:
        by how much the markers sit elsewhere on the body at rest [m], (k, 3).
    """
    rng = np.random.default_rng(seed)
    true = apply_effects(truth or arm((8, 3, 3), law="neo_hookean"), effects)
    ties = true.markers if placements is None else true.tie_markers(true.marker_points + placements)
    plain = make_recording(
        Timeline(np.arange(len(inputs)) * 1.0),
        drives=Drives(actuation=actuation, cable_names=true.body.cable_names, inputs=inputs),
    )
    driven = DrivenRobot(true, drive_of(true, plain, initial=initial))
    points, states, state = [], [], None
    for k in range(len(inputs)):
        extra = None
        if forces and k in forces:
            place, force = forces[k]
            extra = embed_points(true.body.mesh, np.atleast_2d(place)).spread(np.atleast_2d(force), len(true.body.mesh.nodes))
        state = solve_frame(
            driven,
            k,
            start=state,
            nodal_forces=extra,
            options=SolveOptions(before=None if state is None else state.segment_tensions),
        )
        assert state.converged
        states.append(state.positions)
        points.append(ties.positions(state.positions))
    measured = transform_points(invert_pose(T_ROBOT_CAMERA), np.vstack(points)) + noise * rng.normal(
        size=(len(inputs) * len(true.marker_names), 3)
    )
    count = len(true.marker_names)
    recording = make_recording(
        Timeline(np.arange(len(inputs)) * 1.0, sweep=labels, free=np.full(len(inputs), free)),
        drives=Drives(actuation=actuation, actuation_zero=zero, cable_names=true.body.cable_names, inputs=inputs),
        markers=MarkerRows(
            true.marker_names, np.repeat(np.arange(len(inputs)), count), np.tile(np.arange(count), len(inputs)), measured
        ),
    )
    return recording, states


__all__ = ["NAMES", "T_ROBOT_CAMERA", "arm", "frame_loads", "record", "replace", "sweeps"]


def by_two_cameras(one: Recording, *, scale: tuple[float, float] = (1.0, 1.0)) -> Recording:
    """Return a recording as two cameras at one place have it, each with a scale of its own and no declared pose."""
    return replace(
        one,
        camera_names=("left", "right"),
        cameras=(None, None),
        T_robot_camera=(None, None),
        cloud_files=((None, None),) * one.frame_count,
        color_files=((None, None),) * one.frame_count,
        marker_frame=np.tile(one.marker_frame, 2),
        marker_index=np.tile(one.marker_index, 2),
        marker_view=np.repeat([0, 1], len(one.marker_frame)),
        marker_xyz=np.vstack([factor * one.marker_xyz for factor in scale]),
    )
