"""The report on a calibration: where the camera stands, the initial inputs, what the markers say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration
from femsense.report import words
from femsense.report.drawing import AFTER, as_image, draw_bars, name_axes, new_axes, whole_numbers
from femsense.report.page import Chapter, Html, panels, section, table, tiles, together
from femsense.report.text import has_unknown_inputs

MARKERS = 40


def calibration_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a calibration. Raises InputError where the file is broken."""
    calibration = read_calibration(file)
    body = together(
        _summary(calibration),
        section("Pose of the camera", _pose(calibration)),
        section("Initial inputs", _inputs(calibration)),
        section("Markers", panels(_marker_panel(calibration), _history_panel(calibration))),
    )
    return Chapter(title, body, _headline(calibration))


def _headline(c: Calibration) -> str:
    if not np.isfinite(c.rms_m):
        return f"Calibration: {c.status}."
    return f"Calibration: {c.status}; the markers lie {words.length(c.rms_m)} (rms) from the model."


def _summary(c: Calibration) -> Html:
    items = [("Residual", words.length(c.rms_m), "rms, 3-D")] if np.isfinite(c.rms_m) else []
    items += [("Markers", str(len(c.marker_rms_m)), "")] if c.marker_rms_m else []
    items += [("Frames", str(len(c.frames)), words.frame_list(c.frames) if len(c.frames) < 12 else "")] if c.frames else []
    return tiles([*items, ("Status", c.status or words.NOTHING, "")]) if len(c.status) < 24 else tiles(items)


def _pose(c: Calibration) -> Html | None:
    rows: list[list[Any]] = []
    for i, (name, T) in enumerate(zip(c.camera_names, c.poses)):
        camera = name or ("camera" if len(c.poses) == 1 else f"camera {i + 1}")
        spread = _spread(c) if i == 0 else ([None] * 3, [None] * 3)
        turn = _rotation_vector(T)
        rows.append(
            [
                camera,
                words.parameter(T[:3, 3].tolist(), spread[0], "m"),
                words.parameter(turn, spread[1], "rad"),
                words.parameter(T[:3, 2].tolist(), None, "1"),
            ]
        )
    headers = ("Camera", "Position x, y, z", "Rotation vector", "Looks along")
    return table(headers, rows, caption="In the robot frame. The deviations of the rotation are about the middle of the markers.")


def _spread(c: Calibration) -> tuple[list[Any], list[Any]]:
    """Return standard deviations of position [m] and rotation [rad] of the first camera; None where they are not known."""
    position = [float(v) if v > 0 else None for v in c.pose_std[:3, 3]]
    rotation = [float(np.sqrt(v)) if v > 0 else None for v in np.diag(c.pose_covariance)[:3]]
    return position, rotation


def _rotation_vector(T: Any) -> list[float]:
    from scipy.spatial.transform import Rotation

    turn: list[float] = Rotation.from_matrix(np.array(T[:3, :3])).as_rotvec().tolist()
    return turn


def _inputs(c: Calibration) -> Html | None:
    if not has_unknown_inputs(c):
        return None
    names = list(dict.fromkeys([*c.cable_tension_n, *c.cable_displacement_m]))
    rows = [
        [
            name,
            _input(c.cable_tension_n, c.tension_std_n, name, "N"),
            _input(c.cable_displacement_m, c.displacement_std_m, name, "m"),
        ]
        for name in names
    ]
    return table(("Cable", "Tension", "Shortening"), rows, caption="Of each cable at the start of the recording.", numeric=(1, 2))


def _input(values: dict[str, float], std: dict[str, float | None], name: str, unit: str) -> str:
    text = words.with_std(values.get(name), std.get(name), unit)
    return f"{text} (the data say nothing of it)" if name in std and std[name] is None and text != words.NOTHING else text


def _marker_panel(c: Calibration) -> Html | None:
    sizes = sorted(((1e3 * v, name) for name, v in c.marker_rms_m.items() if np.isfinite(v)), reverse=True)
    if not sizes:
        return None
    shown = sizes[:MARKERS]
    figure = draw_bars([name for _, name in shown], [size for size, _ in shown], "rms residual [mm]")
    more = f" The {len(shown)} largest of {len(sizes)}." if len(sizes) > len(shown) else ""
    return as_image(
        figure,
        alt=f"Residual of each marker: the largest {shown[0][0]:.2f} mm at {shown[0][1]}.",
        caption=f"Residual of each marker.{more}",
    )


def _history_panel(c: Calibration) -> Html | None:
    known = [(i, 1e3 * r) for i, r in enumerate(c.history) if words.known(r) and r > 0]
    if len(known) < 2:
        return None
    figure, axes = new_axes()
    axes.plot(*zip(*known), "o-", color=AFTER, linewidth=1.5, markersize=4)
    values = [r for _, r in known]
    axes.set_ylim(0.0, 1.08 * max(values))
    if max(values) > 20.0 * min(values):
        axes.set_yscale("log")
        axes.set_ylim(0.7 * min(values), 1.4 * max(values))
    whole_numbers(axes)
    name_axes(axes, "iteration", "rms residual [mm]")
    return as_image(
        figure,
        alt=f"Residual over the iterations: from {values[0]:.3g} mm to {values[-1]:.3g} mm.",
        caption="Residual over the iterations of the fit.",
    )
