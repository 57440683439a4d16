"""The script of the virtual rig: what it means frame by frame, and what it says of mistakes."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import ROOT, changed, write_block_robot
from rig_scripts import SCRIPT

from femsense.core.errors import InputError
from femsense.io.robot_toml import load_robot
from femsense.rig import script as script_module
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script, read_script


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("block")))


def test_a_sweep_rises_holds_and_falls(robot: Any) -> None:
    plan = plan_script(check_script(SCRIPT), robot)
    np.testing.assert_allclose(plan.commanded[:6, 0], [0.0, 1.0, 2.0, 2.0, 1.0, 0.0])
    np.testing.assert_allclose(plan.commanded[6:], [[0.0, 0.1], [1.0, 0.2], [0.5, 0.3]])
    np.testing.assert_allclose(plan.initial, [0.25, 0.0])
    np.testing.assert_allclose(plan.time_s, [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 4.5, 6.5, 8.5])
    assert plan.sweep == ("a",) * 6 + ("b",) * 3


def test_a_contact_makes_its_sweep_not_free(robot: Any) -> None:
    plan = plan_script(check_script(SCRIPT), robot)
    assert plan.free.tolist() == [True] * 6 + [False] * 3
    np.testing.assert_allclose(plan.contacts[0].force, [0.0] * 7 + [0.3, 0.1])
    assert plan.load_frame.tolist() == [0, 1, 2, 3, 4, 5]
    declared_free = changed(SCRIPT, {"sweeps__1__free": True})
    assert plan_script(check_script(declared_free), robot).free.all()


def test_gravity_of_a_sweep(robot: Any) -> None:
    turned = changed(SCRIPT, {"sweeps__1__gravity_m_s2": [9.81, 0.0, 0.0]})
    gravity = plan_script(check_script(turned), robot).gravity
    assert gravity is not None
    np.testing.assert_allclose(gravity[[0, 8]], [[0.0, 0.0, -9.81], [9.81, 0.0, 0.0]])
    assert plan_script(check_script(SCRIPT), robot).gravity is None


@pytest.mark.parametrize(
    ("changes", "texts"),
    [
        ({"camera": None}, ["script: either a table [camera]", "found:    format, "]),
        ({"sweeps__0__lable": "x"}, ["script: sweeps[0].lable", "unknown key", "did you mean 'label'"]),
        ({"sweeps__1__label": "a"}, ["script: sweeps[1].label", "occurs twice", "'a'"]),
        ({"contacts__0__sweep": "bb"}, ["script: contacts[0].sweep", "no such sweep", "did you mean 'b'"]),
        ({"contacts__0__force_n": [0.1]}, ["script: contacts[0].force_n", "1 values", "3 values"]),
        ({"contacts__0__force_n": -1.0}, ["script: contacts[0].force_n", "greater than or equal to 0"]),
        ({"loads__0__force_n": [[0.0, 0.0, 1.0]]}, ["script: loads[0].force_n", "1 vectors", "6 vectors"]),
        ({"sweeps__0__cables": {"tpo": 1.0}}, ["script: sweeps[0].cables.tpo", "unknown cable", "did you mean 'top'"]),
        ({"initial": {"bottom": 1.0}}, ["script: initial.bottom", "unknown cable", "top, side"]),
        ({"sweeps__0__cables": {"top": -2.0}}, ["a negative tension", "-1.75 N"]),
        ({"sweeps__1__levels": [0.0, 1.0]}, ["script: sweeps[1].cables.side", "3 values", "2 values"]),
        (
            {"sweeps__0__up": 0, "sweeps__0__rest": 0, "sweeps__0__hold": 0, "sweeps__0__down": 0},
            ["script: sweeps[0]", "a sweep without frames"],
        ),
        (
            {"camera__T_robot_camera": [[1.0, 0.0, 0.0, 0.0]] * 4},
            ["script: camera", "either by eye_m and target_m or by T_robot_camera"],
        ),
        ({"camera__eye_m": None}, ["script: camera", "either by eye_m"]),
        ({"truth__law": "gent"}, ["script: truth", "stretch_limit"]),
        ({"truth__refinements": 9}, ["script: truth.refinements", "less than or equal to 3"]),
        ({"markers__names": ["tipp"]}, ["script: markers.names[0]", "unknown marker", "did you mean 'tip'"]),
        ({"clouds__kind": "ply", "clouds__extra_frames": [9]}, ["script: clouds.extra_frames[0]", "no such frame", "0 … 8"]),
        ({"format": "femsense-script-2"}, ["script: format", "femsense-script-1"]),
        ({"dt_s": 0.0}, ["script: dt_s", "greater than 0"]),
    ],
)
def test_a_mistake_is_named(robot: Any, changes: dict[str, Any], texts: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        plan_script(check_script(changed(SCRIPT, changes)), robot)
    for text in texts:
        assert text in str(caught.value)


def test_a_missing_or_broken_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such script"):
        read_script(tmp_path / "none.toml")
    (tmp_path / "broken.toml").write_text("format = ", encoding="utf-8")
    with pytest.raises(InputError, match=r"broken\.toml"):
        read_script(tmp_path / "broken.toml")


def test_every_key_of_a_script_is_in_its_page():
    page = (ROOT / "docs" / "formats" / "scripts.md").read_text(encoding="utf-8")
    tables = [
        t for t in vars(script_module).values() if isinstance(t, type) and issubclass(t, script_module.Schema) and t.model_fields
    ]
    assert len(tables) == 13
    for table in tables:
        for key, field in table.model_fields.items():
            assert f"| `{key}` | {field.description} |" in page, f"{table.__name__}.{key}"
    example = tomllib.loads(page.split("```toml")[1].split("```")[0])
    assert check_script(example).sweeps[1].hold == 2
