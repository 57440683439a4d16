"""The picture of the README: the robot at rest and with a cable pulled, its markers and cables.

The surfaces are seen by the rig's own camera (rays into the triangles), so that the picture is what a recording shows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense import Robot, load_robot, solve_equilibrium
from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, transform_points
from femsense.rig.camera import camera_of, look_at, render, visible_points
from femsense.rig.scene import body_shape
from femsense.rig.script import SceneTable, ViewTable

VIEW = ViewTable.model_validate(
    {"width": 900, "height": 640, "fx": 1680.0, "eye_m": [-0.22, -0.34, 0.30], "target_m": [0.0, 0.0, 0.050]}
)
PULLS: tuple[dict[str, float], ...] = ({}, {"west": 1.8})


def draw(folder: Path) -> None:
    """Write four_leg.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    robot = load_robot(folder)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.3), dpi=110)
    for axis, pulls in zip(axes, PULLS):
        state = solve_equilibrium(robot.body, tension=pulls)
        _panel(axis, robot, np.asarray(state.positions))
        named = ", ".join(f"{name} {force:g} N" for name, force in pulls.items()) or "own weight only"
        axis.set_title(named, fontsize=11, pad=10)
    figure.tight_layout()
    figure.savefig(folder / "four_leg.png", metadata={"Software": None})


def _panel(axis: object, robot: Robot, positions: FloatArray) -> None:
    camera, T = camera_of(VIEW), look_at(VIEW.eye_m or (), VIEW.target_m or ())
    shapes = [body_shape(robot, positions, SceneTable.model_validate({}))]
    image = render(camera, T, shapes)
    axis.imshow(np.where(image.shape[..., None] < 0, 255, image.color))  # type: ignore[attr-defined]
    markers = robot.markers.positions(positions)
    seen = visible_points(camera, T, shapes, markers)
    u, v = _pixels(T, markers).T
    axis.plot(u[seen], v[seen], "o", color="white", markeredgecolor="black", markersize=6)  # type: ignore[attr-defined]
    for cable in robot.body.cables:
        ends = np.vstack([cable.path.positions(positions), cable.pull_point, cable.pull_point * [1, 1, 0]])
        u, v = _pixels(T, ends).T
        axis.plot(u, v, "-", color="#d9480f", linewidth=1.3)  # type: ignore[attr-defined]
        axis.plot(u[1], v[1], "s", color="#d9480f", markersize=4)  # type: ignore[attr-defined]
    axis.set_axis_off()  # type: ignore[attr-defined]


def _pixels(T_robot_camera: FloatArray, points: FloatArray) -> FloatArray:
    camera = camera_of(VIEW)
    x = transform_points(invert_pose(T_robot_camera), points)
    return np.stack([camera.fx * x[:, 0] / x[:, 2] + camera.cx, camera.fy * x[:, 1] / x[:, 2] + camera.cy], axis=1)
