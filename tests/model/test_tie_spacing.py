"""The points of a cable's path lie close enough, or the body buckles between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lines import written

from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.meshing.robot_from_line import line_into
from femsense.io.robot_toml import load_robot
from femsense.model.tie_spacing import tie_spacing, tie_spacing_text, warn_of_tie_spacing


def pulled(tmp_path: Path, points: int, **more: float) -> BodyModel:
    tendon = {"name": "t", "distance_mm": 2.0, "points": points} | more
    source = written(tmp_path, {"radius_mm": 4.0}, {"radius_mm": 4.0}, tendons=[tendon])
    line_into(tmp_path / f"{points}", source, most_tets=800)
    return load_robot(tmp_path / f"{points}").body


def test_the_gap_buckles_at_eulers_load(tmp_path: Path) -> None:
    body = pulled(tmp_path, 5, max_tension_n=0.09)
    spacing = tie_spacing(body, body.cables[0])
    assert spacing is not None
    assert spacing.gap == pytest.approx(0.025)
    assert spacing.buckles_at == pytest.approx(np.pi**2 * 200e3 * np.pi / 4 * 0.004**4 / 0.025**2, rel=0.01)
    assert spacing.holds and spacing.declared


def test_few_points_answer_otherwise_and_are_warned_of(tmp_path: Path) -> None:
    few, many, more = (pulled(tmp_path, n, max_tension_n=0.25) for n in (4, 20, 40))
    moved = [solve_equilibrium(body, tension={"t": 0.25}).positions for body in (few, many, more)]
    size = np.linalg.norm(moved[2] - more.mesh.nodes, axis=1).max()
    change = [np.linalg.norm(x - moved[2], axis=1).max() / size for x in moved[:2]]
    assert change[0] > 0.05 > 0.02 > change[1]
    with pytest.warns(UserWarning, match="between points . and . of its path"):
        warn_of_tie_spacing(few)
    warn_of_tie_spacing(many)
    spacing = tie_spacing(few, few.cables[0])
    assert spacing is not None and not spacing.holds
    wanted = int(tie_spacing_text(spacing, 4).split("about ")[1].split()[0])
    enough = pulled(tmp_path, wanted + 1, max_tension_n=0.25)
    again = tie_spacing(enough, enough.cables[0])
    assert again is not None and again.holds


def test_without_a_largest_tension_one_that_bends_the_body_counts(tmp_path: Path) -> None:
    body = pulled(tmp_path, 30)
    spacing = tie_spacing(body, body.cables[0])
    assert spacing is not None and not spacing.declared and spacing.holds
    assert spacing.tension == pytest.approx(200e3 * np.pi / 4 * 0.004**4 / (0.002 * 0.1), rel=0.01)


def test_a_cable_of_one_point_runs_through_nothing(tmp_path: Path) -> None:
    body = pulled(tmp_path, 1)
    assert tie_spacing(body, body.cables[0]) is None
