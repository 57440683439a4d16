"""The equilibrium on a finer mesh against a solution there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import NAMES, arm

from femsense.core.errors import FemsenseError
from femsense.fem.body import make_body
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import Embedding, embed_points
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import apply_effects
from femsense.model.finer_mesh import FinerOptions, finer_state, retaut
from femsense.model.frame_state import solve_frame
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.remeshing import finer_mesh, robot_on_mesh


def on_both_meshes(
    inputs: list[float], actuation: str = "tension", effects: Sequence[dict[str, Any]] = ()
) -> tuple[DrivenRobot, DrivenRobot, int, Equilibrium, Embedding]:
    """Return what `finer_state` is asked with: an arm whose cables are driven so."""
    robot = apply_effects(arm((4, 2, 2)), effects)
    fine = robot_on_mesh(robot, finer_mesh(robot.body.mesh, None, 1))
    recording = make_recording(Timeline([0.0]), drives=Drives(NAMES, [inputs], actuation=actuation))
    driven, fine_driven = (DrivenRobot(r, drive_of(r, recording)) for r in (robot, fine))
    return driven, fine_driven, 0, solve_frame(driven, 0), embed_points(robot.body.mesh, fine.body.mesh.nodes)


def beyond(asked: tuple[DrivenRobot, DrivenRobot, int, Equilibrium, Embedding], x: np.ndarray | None) -> np.ndarray:
    """Return how far nodes of the finer mesh lie from the state of the declared one [m]."""
    assert x is not None
    return x - asked[4].positions(asked[3].positions)


def test_a_finer_state_that_runs_away_says_nothing_though_its_forces_look_small():
    forces_are_small = FinerOptions(enough=np.inf)
    assert finer_state(*on_both_meshes([2.0, 0.0, 0.0, 0.0]), options=forces_are_small) is not None
    assert finer_state(*on_both_meshes([12.0, 0.0, 0.0, 0.0]), options=forces_are_small) is None


def test_a_finer_state_that_folds_is_sought_in_shorter_steps():
    asked = on_both_meshes([0.024, 0.0, 0.0, 0.0], "displacement", [{"name": "hyperelastic", "law": "neo_hookean"}])
    with pytest.raises(FemsenseError, match="folded flat"):
        finer_state(*asked, options=FinerOptions(paces=(1.0,)))
    exact = beyond(asked, solve_frame(asked[1], 0).positions)
    assert (
        np.abs(beyond(asked, finer_state(*asked)) - exact).max() < 0.5 * np.abs(exact).max()
    )  # nearer than the declared mesh is


def test_where_a_body_is_not_stable_on_the_finer_mesh_no_factor_of_it_is_asked_for():
    asked = on_both_meshes([12.0, 0.0, 0.0, 0.0])
    with pytest.raises(FemsenseError, match="not stable"):
        finer_state(*asked, options=FinerOptions(rough_from=0))
    easy = on_both_meshes([2.0, 0.0, 0.0, 0.0])
    near, exact = (beyond(easy, finer_state(*easy, options=FinerOptions(rough_from=most))) for most in (0, 10**6))
    assert np.abs(near - exact).max() < 0.05 * np.abs(exact).max()


def test_a_finer_body_that_nothing_holds_is_an_error():
    driven, fine, *rest = on_both_meshes([2.0, 0.0, 0.0, 0.0])
    body = fine.robot.body
    loose = make_body(body.mesh, young_modulus=1e5, poisson_ratio=0.4, clamped=np.zeros(0, dtype=int), cables=body.cables)
    with pytest.raises(FemsenseError, match="nothing holds the body"):
        finer_state(driven, replace(fine, robot=replace(fine.robot, body=loose)), *rest)


def test_held_cables_stretch_as_far_as_they_pull_on_the_finer_mesh():
    asked = on_both_meshes([0.004, 0.002, 0.0, 0.0], "displacement", [{"name": "cable_stretch", "stiffness_n_m": 300.0}])
    wanted = beyond(asked, solve_frame(asked[1], 0).positions)
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), wanted, atol=0.02 * np.abs(wanted).max())


def test_a_slack_cable_that_is_too_long_on_the_finer_mesh_goes_taut():
    asked = on_both_meshes([0.0045, 0.0064, 0.0029, 0.0051], "displacement")
    exact, base = solve_frame(asked[1], 0), asked[3]
    assert exact.held[2] and not base.held[2]
    wanted = beyond(asked, exact.positions)
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), wanted, atol=0.03 * np.abs(wanted).max())


def test_a_held_cable_that_would_push_on_the_finer_mesh_goes_slack():
    _, fine, frame, base, ties = on_both_meshes([0.004, 0.0, 0.002, 0.0], "displacement")
    x = ties.positions(base.positions)
    for push, slack in ((-2e-3, True), (-5e-4, False)):
        pushing = replace(base, held=np.ones(4, bool), tension={**dict.fromkeys(NAMES, 0.1), NAMES[2]: push})
        now = retaut(fine, frame, pushing, x, 1e-4)
        assert now.held.tolist() == [True, True, not slack, True]
        assert now.tension[NAMES[2]] == (0.0 if slack else push)


@pytest.mark.parametrize("rough_from", [0, 10**6], ids=["conjugate gradients", "factor"])
def test_a_finer_state_that_is_bent_much_by_held_cables_settles_where_it_belongs(rough_from: int):
    asked = on_both_meshes([0.012, 0.0, 0.0, 0.0], "displacement")
    exact = beyond(asked, solve_frame(asked[1], 0).positions)
    options = FinerOptions(
        enough=1e-3, rough_from=rough_from
    )  # what is solved roughly must not keep the steps from getting there
    found = finer_state(*asked, options=options)
    np.testing.assert_allclose(beyond(asked, found), exact, atol=0.25 * np.abs(exact).max())
