"""Markers that sit on the clamp: laws of the ties, what is tried, and errors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import write_block_robot

from femsense.core.errors import InputError
from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.robot_toml import load_robot
from femsense.model.effects import apply_effects, find_effect
from femsense.model.robot import Robot

MARKERS = {"plate": [0.01, 0.04, 0.01], "side": [0.01, 0.015, -0.012], "skin": [0.01, 0.03, 0.03], "tip": [0.1, 0.015, 0.035]}


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    markers = [{"name": name, "position_m": place} for name, place in MARKERS.items()]
    return load_robot(
        write_block_robot(tmp_path_factory.mktemp("bar"), markers=markers, gravity={"vector_m_s2": [0.0, 0.0, -9.8]})
    )


def held(robot: Robot, share: float) -> Robot:
    return apply_effects(robot, [{"name": "clamped_marker", "markers": ["plate", "side"], "share": share}])


def test_a_marker_follows_the_body_by_its_share(bar: Robot) -> None:
    state = solve_equilibrium(bar.body).positions
    whole = bar.markers.positions(state) - bar.marker_points
    assert np.linalg.norm(whole, axis=1).min() > 1e-6
    for share in (0.0, 0.3, 1.0):
        way = held(bar, share).markers.positions(state) - bar.marker_points
        np.testing.assert_allclose(way, np.array([share, share, 1.0, 1.0])[:, None] * whole, atol=1e-15)


def test_a_share_stays_with_the_marker_when_it_moves_or_the_mesh_changes(bar: Robot) -> None:
    remeshed = apply_effects(held(bar, 0.0), [{"name": "discretisation", "element": "tet10"}])
    state = solve_equilibrium(remeshed.body).positions
    anew = remeshed.tie_markers(remeshed.marker_points)
    np.testing.assert_allclose(remeshed.markers.positions(state), anew.positions(state), atol=1e-15)
    robot = remeshed.with_marker_points(bar.marker_points + 1e-3)
    np.testing.assert_allclose(robot.markers.positions(state)[:2], bar.marker_points[:2] + 1e-3, atol=1e-15)
    assert np.abs(robot.markers[2:].positions(state) - bar.marker_points[2:] - 1e-3).max() > 1e-5


def test_a_displacement_has_no_part_that_stays(bar: Robot) -> None:
    ties = held(bar, 0.25).markers[np.array([0, 3])]
    field = np.ones((len(bar.body.mesh.nodes), 3))
    np.testing.assert_allclose(ties.moves(field), [[0.25] * 3, [1.0] * 3], rtol=1e-12)


def test_markers_beside_the_body_near_the_clamp_are_tried_together_and_alone(bar: Robot) -> None:
    seeds = find_effect("clamped_marker").seeds(bar)
    assert [seed["markers"] for seed in seeds] == [["plate", "side"], ["plate"], ["side"]]


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ({"share": 0.0}, "no markers are named"),
        ({"markers": ["tpi"], "share": 0.0}, "unknown marker"),
        ({"markers": ["tip"], "share": 9.0}, "not a number in range"),
    ],
)
def test_an_entry_that_does_not_fit_is_refused(bar: Robot, entry: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        apply_effects(bar, [{"name": "clamped_marker", **entry}])
