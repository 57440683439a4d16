"""What the build scripts of the robots share: their command line, writing, and the picture of a robot that is pulled.

A build script has `body_mesh()`, `robot_document()` and a `Portrait`; `build` does the rest.
The surfaces of a picture are seen by the rig's own camera (rays into the triangles), so that it shows what a recording shows.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femsense import Robot, TetMesh, load_robot, solve_equilibrium, write_mesh
from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, transform_points
from femsense.fem.mesh_checks import check_mesh
from femsense.io.files import write_toml
from femsense.rig.camera import camera_of, look_at, render, visible_points
from femsense.rig.scene import body_shape
from femsense.rig.script import SceneTable, ViewTable

CABLE_RGB = "#d9480f"
SILICONE = {"poisson_ratio": 0.46, "density_kg_m3": 1070.0}
"""What all the robots of this folder have in common; they differ in the modulus."""


@dataclass(frozen=True, eq=False, slots=True)
class Portrait:
    """Where the camera of a picture stands, and what each panel pulls."""

    eye_m: Sequence[float]
    target_m: Sequence[float]
    pulls: Sequence[Mapping[str, float]]
    """Cable → tension [N], or chamber → pressure [Pa], a panel each; the empty one shows the robot under its own weight."""
    fx: float = 1500.0
    size_px: tuple[int, int] = (760, 640)


def build(folder: Path, mesh: Callable[[], TetMesh], document: Callable[[], dict[str, Any]], portrait: Portrait) -> None:
    """Write the mesh and robot.toml of a robot, and with --picture its picture."""
    parser = argparse.ArgumentParser(description=f"Build the robot {folder.name}.")
    parser.add_argument("--picture", action="store_true", help="render its picture too")
    wanted = parser.parse_args()
    made, tables = mesh(), document()
    check_mesh(made, folder.name)
    write_mesh(made, folder / tables["mesh"]["file"])
    write_toml(folder / "robot.toml", tables)
    if wanted.picture:
        draw(folder, portrait)


def micrometres(point: FloatArray | Sequence[float]) -> list[float]:
    """Return a place [m] to the micrometre, without negative zeros."""
    return [round(float(value), 6) + 0.0 for value in point]


def draw(folder: Path, portrait: Portrait, *, name: str | None = None) -> None:
    """Write the picture of a robot: a panel for each of the pulls."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    robot = load_robot(folder)
    count = len(portrait.pulls)
    width, height = portrait.size_px
    figure, axes = plt.subplots(1, count, figsize=(4.2 * count, 4.2 * height / width + 0.4), dpi=110, squeeze=False)
    for axis, pulls in zip(axes[0], portrait.pulls):
        blown = {name: value for name, value in pulls.items() if name in robot.body.chamber_names}
        pulled = {name: value for name, value in pulls.items() if name not in blown}
        state = solve_equilibrium(robot.body, tension=pulled, pressure=blown)
        _panel(axis, robot, np.asarray(state.positions), portrait)
        texts = [f"{name} {force:g} N" for name, force in pulled.items()]
        texts += [f"{name} {pressure / 1e3:g} kPa" for name, pressure in blown.items()]
        named = ", ".join(texts) or "own weight only"
        axis.set_title(named, fontsize=11, pad=8)
    figure.tight_layout()
    figure.savefig(folder / f"{(name or folder.name).replace('-', '_')}.png", metadata={"Software": None})
    plt.close(figure)


def _panel(axis: Any, robot: Robot, positions: FloatArray, portrait: Portrait) -> None:
    width, height = portrait.size_px
    view = ViewTable.model_validate(
        {"width": width, "height": height, "fx": portrait.fx, "eye_m": list(portrait.eye_m), "target_m": list(portrait.target_m)}
    )
    camera, T = camera_of(view), look_at(portrait.eye_m, portrait.target_m)
    shapes = [body_shape(robot, positions, SceneTable.model_validate({}))]
    image = render(camera, T, shapes)
    axis.imshow(np.where(image.shape[..., None] < 0, 255, image.color))

    def pixels(points: FloatArray) -> FloatArray:
        x = transform_points(invert_pose(T), points)
        return np.stack([camera.fx * x[:, 0] / x[:, 2] + camera.cx, camera.fy * x[:, 1] / x[:, 2] + camera.cy])

    markers = robot.markers.positions(positions)
    seen = visible_points(camera, T, shapes, markers)
    axis.plot(*pixels(markers[seen]), "o", color="white", markeredgecolor="black", markersize=5)
    for cable in robot.body.cables:
        ends = np.vstack([cable.path.positions(positions), cable.pull_point])
        axis.plot(*pixels(ends), "-", color=CABLE_RGB, linewidth=1.2)
        axis.plot(*pixels(ends[-1:]), "s", color=CABLE_RGB, markersize=4)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_axis_off()
