"""A robot of pressure chambers through every command: robot.toml, simulate, calibrate, estimate, improve, inspect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from helpers import block_mesh, changed, write_block_robot
from hollow import without_box

from femsense.app import cli
from femsense.core.errors import InputError
from femsense.fem.mesh import embed_points
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot, robot_document, save_robot
from femsense.loop.data.holdout import sweeps_of
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.finer_mesh import finer_state
from femsense.model.frame_state import solve_frame
from femsense.model.recording import make_recording, state_key
from femsense.model.recording_checks import check_against
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script
from femsense.sensing.run_files import read_run

CHAMBER = {"name": "core", "seed_m": [0.05, 0.015, 0.018], "max_pressure_pa": 12e3}
SCRIPT: dict[str, Any] = {
    "format": "femsense-script-1",
    "seed": 5,
    "sweeps": [
        {"label": "a", "chambers": {"core": 10e3}, "up": 2, "down": 2},
        {"label": "b", "chambers": {"core": [4e3, 8e3]}, "levels": [1.0, 1.0]},
        {"label": "c", "chambers": {"core": 6e3}, "up": 1, "hold": 1, "down": 1},
        {"label": "push", "chambers": {"core": 6e3}, "up": 1, "hold": 1, "down": 0},
    ],
    "contacts": [{"sweep": "push", "point_m": [0.1, 0.015, 0.015], "direction": [0.0, 0.0, -1.0], "force_n": [0.0, 0.15]}],
    "truth": {"refinements": 0, "element": "tet10", "law": "corotational", "substeps": 1},
    "effects": [{"name": "stiffness", "scale": 0.8}],
    "camera": {"width": 64, "height": 48, "fx": 60.0, "eye_m": [0.05, -0.3, 0.1], "target_m": [0.05, 0.0, 0.0]},
    "markers": {"std_m": 2e-5, "occlusion": False},
}
MARKERS = [
    {"name": f"m{i}", "position_m": p}
    for i, p in enumerate(
        [[0.1, 0.0, 0.03], [0.1, 0.03, 0.03], [0.1, 0.015, 0.0], [0.05, 0.0, 0.03], [0.05, 0.03, 0.03], [0.02, 0.015, 0.03]]
    )
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bar whose cavity lies high, so that pressure bends it down; nothing pulls it."""
    return write_pneumatic(tmp_path_factory.mktemp("pneumatic"))


def write_pneumatic(folder: Path, **overrides: Any) -> Path:
    tables = {"cables": [], "chambers": [CHAMBER], "markers": MARKERS, "mesh__element": "tet10", **overrides}
    block = without_box(block_mesh((4, 3, 4)), [0.025, 0.01, 0.015], [0.075, 0.02, 0.0225])
    return write_block_robot(folder, block=block, **tables)


def run(*arguments: object) -> int:
    return cli.run([str(a) for a in arguments])


def test_robot_toml_round_trip(folder: Path, tmp_path: Path) -> None:
    robot = load_robot(folder)
    assert robot.body.chamber_names == ("core",) and robot.body.chambers[0].max_pressure == 12e3
    assert robot_document(robot)["chambers"] == [CHAMBER]
    save_robot(robot, tmp_path)
    assert np.array_equal(load_robot(tmp_path).body.chambers[0].faces, robot.body.chambers[0].faces)


def test_a_seed_in_the_material_names_its_key(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)robot\.toml: chambers\[0\]\.seed_m.*in the material"):
        load_robot(write_pneumatic(tmp_path, chambers=[CHAMBER | {"seed_m": [0.05, 0.015, 0.001]}]))
    with pytest.raises(InputError, match=r"(?s)share a surface.*'core' and 'twin'"):
        load_robot(write_pneumatic(tmp_path, chambers=[CHAMBER, CHAMBER | {"name": "twin"}]))


def test_the_script_rises_and_refuses_what_bursts(folder: Path) -> None:
    robot = load_robot(folder)
    plan = plan_script(check_script(SCRIPT), robot)
    np.testing.assert_allclose(plan.pressures[:, 0], [5e3, 10e3, 5e3, 0, 4e3, 8e3, 6e3, 6e3, 0, 6e3, 6e3])
    assert plan.commanded.shape == (11, 0)
    wrong = {
        "pressure above the chamber's maximum": changed(SCRIPT, {"sweeps__0__chambers": {"core": 13e3}}),
        "(?s)unknown chamber.*core": changed(SCRIPT, {"sweeps__0__chambers": {"cor": 1e3}}),
        "another number of values than frames": changed(SCRIPT, {"sweeps__1__chambers": {"core": [1.0]}}),
    }
    for message, document in wrong.items():
        with pytest.raises(InputError, match=message):
            plan_script(check_script(document), robot)


def test_columns_are_matched_by_name_and_pressures_beyond_the_limit_warn(folder: Path) -> None:
    robot = load_robot(folder)
    fits = make_recording(Timeline([0.0, 1.0]), drives=Drives(chamber_names=["core"], pressures=[[0.0], [13e3]]))
    with pytest.warns(UserWarning, match="'core' reaches 1.3e\\+04 Pa, more than its max_pressure_pa"):
        check_against(robot, fits)
    assert state_key(fits, 0) != state_key(fits, 1)
    for names, values in ((["other"], [[0.0]]), ([], None)):
        with pytest.raises(InputError, match=r"(?s)pressures: other chambers than those.*core"):
            check_against(robot, make_recording(Timeline([0.0]), drives=Drives(chamber_names=names, pressures=values)))


def test_excursions_of_the_pressure_are_sweeps() -> None:
    pressures = np.array([[0, 1, 2, 0, 1, 2, 0]], dtype=float).T * 1e3
    recording = make_recording(Timeline(np.arange(7.0)), drives=Drives(chamber_names=["core"], pressures=pressures))
    assert sweeps_of(recording, np.arange(7)).tolist() == [0, 0, 0, 1, 1, 1, 2]


def test_pressure_pushes_on_the_finer_mesh_too(folder: Path) -> None:
    """A few steps from the state of the declared mesh end where the finer mesh converges when it is solved for itself."""
    coarse = load_robot(folder)
    fine = robot_on_mesh(coarse, finer_mesh(coarse.body.mesh, None, 1))
    recording = make_recording(Timeline([0.0]), drives=Drives(chamber_names=["core"], pressures=[[10e3]]))
    driven, fine_driven = (DrivenRobot(r, drive_of(r, recording)) for r in (coarse, fine))
    state, ties = solve_frame(driven, 0), embed_points(coarse.body.mesh, fine.body.mesh.nodes)
    found, wanted = finer_state(driven, fine_driven, 0, state, ties), solve_frame(fine_driven, 0).positions
    assert found is not None
    gone = np.abs(wanted - fine.body.mesh.nodes).max()
    assert gone > 1e-3
    np.testing.assert_allclose(found, wanted, atol=0.01 * gone)


def test_simulate_calibrate_estimate_improve(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The truth is softer by a fifth and of another law; the loop finds its modulus, and the push is sensed with that model."""
    (tmp_path / "script.toml").write_text(tomli_w.dumps(SCRIPT), encoding="utf-8")
    recording, out, sensed = tmp_path / "recording", tmp_path / "out", tmp_path / "run"
    assert run("simulate", folder, tmp_path / "script.toml", "-o", recording) == 0
    loaded = load_recording(recording)
    assert loaded.chamber_names == ("core",) and loaded.pressures[1, 0] == 10e3
    assert run("inspect", folder) == 0 and run("inspect", recording) == 0
    assert run("improve", folder, recording, "-o", out, "--effects", "stiffness,payload") == 0
    loop = json.loads((out / "loop.json").read_text())
    assert loop["verdict"] == "effects" and loop["effects"][0]["name"] == "stiffness"
    scale = loop["effects"][0]["parameters"]["scale"]
    assert abs(scale["value"] - 0.8) < 0.05
    assert loop["after"]["validation_rms_m"] < 0.4 * loop["before"]["validation_rms_m"]
    assert run("calibrate", out, recording, "-o", tmp_path / "calibration.json") == 0
    assert run("estimate", out, recording, "-c", tmp_path / "calibration.json", "-o", sensed, "--at", "0.1,0.015,0.015") == 0
    capsys.readouterr()
    result = read_run(sensed)
    assert [f.pressure_pa["core"] for f in result.frames] == loaded.pressures[:, 0].tolist()
    pushed = [c for c in result.contacts if c.frame == 10]
    assert pushed[0].force_n_xyz[2] == pytest.approx(-0.15, abs=max(0.03, 3 * pushed[0].std_n))
    assert (sensed / "frames.csv").read_text().splitlines()[0].endswith("ms,pressure_core_pa")
