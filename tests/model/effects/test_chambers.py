"""Pressures with a wrong zero or scale: true pressures, sensitivities against states solved anew, round trips and the rig."""

from __future__ import annotations

import numpy as np
import pytest
from hollow_bar_cable import hollow

from femsense.core.errors import InputError
from femsense.fem.mesh import embed_points
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import Entry, apply_effects, build_entry, find_effect
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.robot import Observation, Robot, plain_actuation
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script
from femsense.rig.true_path import true_path

MARKERS = np.array([[0.1, 0.015, 0.03], [0.05, 0.0, 0.015]])
PRESSURES = np.array([[0.0], [3e3], [6e3]])


def robot() -> Robot:
    body = hollow()
    ties = embed_points(body.mesh, MARKERS)
    return Robot("bar", body, ("a", "b"), MARKERS, ties, np.zeros(0, np.int64), None, plain_actuation(1), Observation())


def driven(r: Robot) -> DrivenRobot:
    recording = make_recording(
        Timeline([0.0, 1.0, 2.0]), drives=Drives(("top",), np.ones((3, 1)), chamber_names=("core",), pressures=PRESSURES)
    )
    return DrivenRobot(r, drive_of(r, recording))


def seen(r: Robot) -> np.ndarray:
    return np.array([points for _, _, points, _ in solve_path(driven(r), range(3), lambda one: one.markers)])


def test_the_scale_comes_before_the_zero_and_both_add_up() -> None:
    entries = [
        {"name": "chamber_offset", "pressure_pa": {"core": 200.0}},
        {"name": "chamber_gain", "scale": {"core": 0.9}},
        {"name": "chamber_offset", "pressure_pa": 100.0},
        {"name": "chamber_gain", "scale": 2.0},
    ]
    np.testing.assert_allclose(driven(apply_effects(robot(), entries)).drive.pressures, 1.8 * PRESSURES + 300.0)


@pytest.mark.parametrize("name", ["chamber_offset", "chamber_gain"])
def test_the_sensitivity_is_that_of_states_solved_anew(name: str) -> None:
    effect, r = find_effect(name), robot()
    (parameter,) = effect.parameters(r, "tension")

    def at(step: float) -> Robot:
        return effect.apply(r, build_entry((parameter,), [parameter.null + step], {}))

    variant = DrivenRobot(at(parameter.step), driven(at(parameter.step)).drive)
    paths = list(solve_path(driven(r), range(3), lambda one: one.markers, [variant]))
    slope = np.array([moved[0] - points for _, _, points, moved in paths]) / parameter.step
    h = 20.0 * parameter.step
    exact = (seen(at(h)) - seen(at(-h))) / (2.0 * h)
    assert np.abs(exact).max() * 0.1 * (parameter.high - parameter.null) > 1e-6
    np.testing.assert_allclose(slope, exact, atol=1e-3 * np.abs(exact).max())


def test_the_rig_has_them_too() -> None:
    r = robot()
    script = check_script(
        {
            "format": "femsense-script-1",
            "sweeps": [{"label": "s", "chambers": {"core": 4e3}, "up": 1, "down": 0}],
            "camera": {"eye_m": [0.05, 0.2, 0.1], "target_m": [0.05, 0.0, 0.0]},
        }
    )
    plan = plan_script(script, r)
    entries: list[Entry] = [{"name": "chamber_gain", "scale": 0.5}, {"name": "chamber_offset", "pressure_pa": 500.0}]
    (state,) = (frame.state for frame in true_path(apply_effects(r, entries), plan, substeps=1))
    assert state.pressure == {"core": pytest.approx(2500.0)}


def test_a_robot_without_chambers_cannot_show_them_and_a_wrong_name_says_which_there_are() -> None:
    from arm import arm

    for name, key in (("chamber_offset", "pressure_pa"), ("chamber_gain", "scale")):
        assert not find_effect(name).parameters(arm((3, 1, 1)), "tension")
        with pytest.raises(InputError, match=r"(?s)unknown chamber.*bellow.*core"):
            apply_effects(robot(), [{"name": name, key: {"bellow": 1.0}}])
