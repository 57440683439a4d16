"""Draw the picture and the animation of README and site from the results of `femsense demo`.

    python scripts/pictures.py [DEMO]      DEMO: the folder of the demo's results (default femsense-demo)

Writes docs/pictures/demo.png (the cloud of the camera; the fitted model with the estimated force) and docs/pictures/demo.gif (the press of the
recording: model, force, and the 95 % interval of each frame against the truth). The model is rendered by the camera of the virtual rig from the
calibrated pose; the animation interpolates the states between frames.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from PIL import Image

import femsense as fs
from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, transform_points
from femsense.io.clouds.cloud_files import read_cloud
from femsense.rig.camera import render
from femsense.rig.scene import body_shape
from femsense.rig.script import SceneTable

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
SHOWN = 41
"""Frame of the picture: the largest force of the recording."""
PRESS = (36, 43)
"""Frames of the animation: the sweep with the contact."""
STEPS = 4
"""Pictures of the animation from one frame to the next."""
ARROW_M_PER_N = 0.075
FORCE, TRUTH = "#e8590c", "#212529"
Z95 = 1.96


@dataclass(frozen=True, eq=False, slots=True)
class Demo:
    """What the pictures show."""

    robot: fs.Robot
    recording: fs.Recording
    run: fs.Run
    T_robot_camera: FloatArray
    truth: dict[int, float]
    """Frame → true force [N]."""


def read_demo(folder: Path) -> Demo:
    """Return the results of a demo. Raises InputError."""
    source = fs.robot_names()["four-leg"] / "recordings" / "demo"
    table = np.genfromtxt(source / "truth" / "contacts.csv", delimiter=",", names=True)
    truth = {int(row["frame"]): float(row["force_n"]) for row in table}
    pose = fs.read_calibration(folder / "run" / "calibration.json").T_robot_camera
    return Demo(fs.load_robot("four-leg"), fs.load_recording(source), fs.read_run(folder / "run"), np.asarray(pose), truth)


def view_of(width: int) -> fs.Camera:
    """Return the lens of the pictures: a narrower view from where the camera of the recording stands."""
    height = round(0.72 * width)
    return fs.Camera("", width, height, 1.75 * width, 1.75 * width, 0.5 * width, 0.5 * height, np.zeros(5), 1e-3)


def pixels(view: fs.Camera, T_robot_camera: FloatArray, points: FloatArray) -> FloatArray:
    """Return where points (n, 3) of the robot frame appear, shape (n, 2)."""
    x = transform_points(invert_pose(T_robot_camera), np.atleast_2d(points))
    return np.stack([view.fx * x[:, 0] / x[:, 2] + view.cx, view.fy * x[:, 1] / x[:, 2] + view.cy], axis=1)


def index_of(demo: Demo, frame: int) -> int:
    """Return the row of a frame in the states."""
    return [report.frame for report in demo.run.frames].index(frame)


def draw_model(axis: Any, demo: Demo, view: fs.Camera, nodes: FloatArray, place: FloatArray | None, force: FloatArray) -> None:
    """Draw the deformed body, and a force [N] that acts on it at a place [m]."""
    image = render(view, demo.T_robot_camera, [body_shape(demo.robot, nodes, SceneTable.model_validate({}))])
    opaque = (image.shape >= 0).astype(np.uint8) * 255
    axis.imshow(np.dstack([image.color, opaque]), interpolation="bilinear")
    if place is not None:
        tail, tip = pixels(view, demo.T_robot_camera, np.array([place - ARROW_M_PER_N * force, place]))
        axis.annotate("", tip, tail, arrowprops={"color": FORCE, "width": 3, "headwidth": 11, "headlength": 11, "shrink": 0})
    axis.set_xlim(0, view.width)
    axis.set_ylim(view.height, 0)
    axis.set_axis_off()


def draw_picture(demo: Demo, file: Path) -> None:
    """Write the picture: what the camera measured, and what femsense estimates from it."""
    view = view_of(1400)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), dpi=130, facecolor="white")
    row = index_of(demo, SHOWN)
    cloud = read_cloud(demo.recording.cloud_files[row][0])
    u, v = pixels(view, np.eye(4), cloud.points).T
    left.scatter(u, v, s=5, c=cloud.colors, linewidths=0)
    left.set_xlim(0, view.width)
    left.set_ylim(view.height, 0)
    left.set_aspect("equal")
    left.set_axis_off()
    left.set_title("measured: the point cloud of a depth camera", fontsize=12, x=0.05, ha="left")
    [contact] = [contact for contact in demo.run.contacts if contact.frame == SHOWN]
    nodes = np.asarray(demo.run.states.nodes_m[row], dtype=float)
    draw_model(right, demo, view, nodes, contact.position_m, contact.force_n_xyz)
    right.set_title("estimated: shape, contact point and force", fontsize=12, x=0.05, ha="left")
    text = f"{contact.force_n:.2f} ± {Z95 * contact.std_n:.2f} N"
    for height, line, color in (
        (1.01, text, FORCE),
        (0.94, "95 % interval", FORCE),
        (0.87, f"true: {demo.truth[SHOWN]:.2f} N", TRUTH),
    ):
        right.text(0.69, height, line, transform=right.transAxes, fontsize=12, color=color, va="top")
    figure.subplots_adjust(0.0, 0.0, 1.0, 0.93, wspace=0.0)
    as_image(figure).quantize(160, dither=Image.Dither.NONE).save(file, optimize=True)


def draw_animation(demo: Demo, file: Path) -> None:
    """Write the animation of the press."""
    first, last = PRESS
    times = np.linspace(first, last, STEPS * (last - first) + 1)
    pictures = [picture_at(demo, time) for time in times]
    palette = pictures[len(pictures) // 2].quantize(48)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    shown = [140] * (len(pictures) - 1) + [1500]
    pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=shown, loop=0, optimize=True)


def picture_at(demo: Demo, time: float) -> Image.Image:
    """Return one picture of the animation, at a time between two frames."""
    view = view_of(500)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.4), dpi=80, facecolor="white", width_ratios=(1.35, 1))
    before, share = int(np.floor(time)), time - np.floor(time)
    after = min(before + 1, PRESS[1])
    at_before, at_after = (np.asarray(demo.run.states.nodes_m[index_of(demo, frame)], dtype=float) for frame in (before, after))
    contacts = {contact.frame: contact for contact in demo.run.contacts}
    ends = [contacts.get(frame) for frame in (before, after)]
    forces = [np.zeros(3) if end is None else end.force_n_xyz for end in ends]
    places = [end.position_m for end in ends if end is not None]
    place = None if not places else (1 - share) * places[0] + share * places[-1]
    nodes = (1 - share) * at_before + share * at_after
    draw_model(left, demo, view, nodes, place, (1 - share) * forces[0] + share * forces[1])
    known = [contact for frame, contact in contacts.items() if frame <= time]
    right.step(
        [PRESS[0] - 0.5, *np.arange(PRESS[0], PRESS[1] + 1) + 0.5],
        [0.0, *(demo.truth.get(frame, 0.0) for frame in range(PRESS[0], PRESS[1] + 1))],
        color=TRUTH,
        lw=1.2,
        label="true",
    )
    right.errorbar(
        [c.frame for c in known],
        [c.force_n for c in known],
        [Z95 * c.std_n for c in known],
        fmt="o",
        color=FORCE,
        ms=6,
        capsize=4,
        label="estimated, 95 %",
    )
    right.set_xlim(PRESS[0] - 0.5, PRESS[1] + 0.5)
    right.set_ylim(0.0, 1.0)
    right.set_xlabel("frame")
    right.set_ylabel("contact force [N]")
    right.legend(loc="upper left", frameon=False)
    right.spines[["top", "right"]].set_visible(False)
    figure.subplots_adjust(0.0, 0.16, 0.985, 0.97, wspace=0.12)
    return as_image(figure)


def as_image(figure: Any) -> Image.Image:
    """Return a figure as an image, and close it."""
    stream = io.BytesIO()
    figure.savefig(stream, metadata={"Software": None})
    plt.close(figure)
    return Image.open(stream).convert("RGB")


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the picture and the animation of the README.")
    parser.add_argument("demo", type=Path, nargs="?", default=Path("femsense-demo"))
    demo = read_demo(parser.parse_args().demo)
    draw_picture(demo, PICTURES / "demo.png")
    draw_animation(demo, PICTURES / "demo.gif")
    for file in ("demo.png", "demo.gif"):
        print(f"docs/pictures/{file}: {(PICTURES / file).stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
