"""The report on a calibration: pose of the camera, initial inputs, residuals of the markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration
from femsense.report import words
from femsense.report.drawing import AFTER, as_image, marker_bars, name_axes, new_axes, whole_numbers
from femsense.report.page import Chapter, render
from femsense.report.text import has_unknown_inputs


def calibration_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a calibration. Raises InputError where the file is broken."""
    c = read_calibration(file)
    names = dict.fromkeys([*c.cable_tension_n, *c.cable_displacement_m])
    inputs = [
        (
            name,
            _input(c.cable_tension_n, c.tension_std_n, name, "N"),
            _input(c.cable_displacement_m, c.displacement_std_m, name, "m"),
        )
        for name in (names if has_unknown_inputs(c) else ())
    ]
    bars = marker_bars(c.marker_rms_m, "Residual of each marker", most=40, axis="rms residual [mm]")
    body = render("calibration.html", c=c, poses=_poses(c), inputs=inputs, pictures=[bars, _history_panel(c)])
    return Chapter(title, body, _headline(c))


def _headline(c: Calibration) -> str:
    if not np.isfinite(c.rms_m):
        return f"Calibration: {c.status}."
    return f"Calibration: {c.status}; the markers lie {words.length(c.rms_m)} (rms) from the model."


def _poses(c: Calibration) -> list[dict[str, Any]]:
    """Return place and rotation of each camera; of the first with their standard deviations."""
    rows = []
    for i, (name, T) in enumerate(zip(c.camera_names, c.poses)):
        place_std, turn_std = _spread(c) if i == 0 else ([None] * 3, [None] * 3)
        camera = name or ("camera" if len(c.poses) == 1 else f"camera {i + 1}")
        turn = Rotation.from_matrix(np.array(T[:3, :3])).as_rotvec().tolist()
        place, axis = T[:3, 3].tolist(), T[:3, 2].tolist()
        rows.append({"camera": camera, "place": place, "place_std": place_std, "turn": turn, "turn_std": turn_std, "axis": axis})
    return rows


def _spread(c: Calibration) -> tuple[list[Any], list[Any]]:
    """Return standard deviations of position [m] and rotation [rad] of the first camera; None where they are not known."""
    position = [float(v) if v > 0 else None for v in c.pose_std[:3, 3]]
    rotation = [float(np.sqrt(v)) if v > 0 else None for v in np.diag(c.pose_covariance)[:3]]
    return position, rotation


def _input(values: dict[str, float], std: dict[str, float | None], name: str, unit: str) -> str:
    text = words.with_std(values.get(name), std.get(name), unit)
    return f"{text} (not determined by the data)" if name in std and std[name] is None and text != words.NOTHING else text


def _history_panel(c: Calibration) -> Markup | None:
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
