"""The truth of the rig: equal to the estimator where nothing differs, apart from it where something does."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import NAMES, arm
from helpers import changed, write_block_robot
from rig_scripts import SCRIPT

from femsense.core.arrays import freeze
from femsense.core.errors import DataError, InputError
from femsense.fem.mesh import element_volumes
from femsense.io.checkpoint import Checkpoint
from femsense.io.files import folder_hash
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import apply_effects
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.robot import Robot
from femsense.rig.patches import contact_patch
from femsense.rig.plan import Plan, plan_script
from femsense.rig.presses import TrueContact
from femsense.rig.recorded import recording_of
from femsense.rig.scene import probe_shape
from femsense.rig.script import TruthTable, check_script
from femsense.rig.simulate import run_experiment, simulate
from femsense.rig.true_path import TruePath, creep_ahead, true_course, true_path
from femsense.rig.truth import creep_matrix, true_robot

LOAD = {"sweep": "b", "point_m": [0.1, 0.015, 0.015], "force_n": [0.0, 0.0, -0.05]}
BARE = changed(SCRIPT, {"contacts": [], "loads": [*SCRIPT["loads"], LOAD]})


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("block")))


def _estimators_markers(robot: Robot, script: dict[str, Any]) -> np.ndarray:
    """Return the markers along the estimator's own quasi-static path [m], shape (F, k, 3)."""
    checked = check_script(script)
    recording = recording_of(run_experiment(robot, checked))
    driven = DrivenRobot(robot, drive_of(robot, recording))
    return np.array([seen for _, _, seen, _ in solve_path(driven, range(recording.frame_count), attrgetter("markers"))])


def _true_markers(robot: Robot, script: dict[str, Any]) -> np.ndarray:
    return run_experiment(robot, check_script(script)).marker_positions


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_without_a_difference_the_truth_is_the_estimators(tmp_path: Path, element: str) -> None:
    robot = load_robot(write_block_robot(tmp_path / "r", mesh__element=element))
    script = changed(BARE, {"truth__element": element, "truth__substeps": 3})
    np.testing.assert_allclose(_true_markers(robot, script), _estimators_markers(robot, script), atol=1e-9)


def test_held_cables_agree_with_the_estimator(robot: Robot) -> None:
    held = changed(
        BARE,
        {
            "actuation": "displacement",
            "initial": {"top": 0.001},
            "sweeps__0__cables": {"top": 0.004},
            "sweeps__1__cables": {"top": 0.002, "side": [0.0, 0.002, 0.004]},
        },
    )
    np.testing.assert_allclose(_true_markers(robot, held), _estimators_markers(robot, held), atol=1e-9)


def let_out() -> tuple[Robot, Plan, np.ndarray]:
    """Return an arm whose cables rub, and how they are pulled and let out [m]."""
    rubbing = apply_effects(arm((5, 2, 2)), [{"name": "cable_friction", "coefficient": 0.5}])
    inputs = np.array([[4.0, 0.0, 3.0, 0.0], [3.6, 0.0, 2.8, 0.0]]) * 1e-3
    nothing = freeze(np.zeros((0, 3)))
    plan = Plan(
        control="displacement",
        time_s=freeze(np.arange(2.0)),
        sweep=("s",) * 2,
        free=freeze(np.ones(2), bool),
        commanded=freeze(inputs),
        initial=freeze(np.zeros(4)),
        pressures=freeze(np.zeros((2, 0))),
        gravity=None,
        load_frame=freeze(np.zeros(0), np.int64),
        load_points=nothing,
        load_forces=nothing,
        contacts=(),
    )
    return rubbing, plan, inputs


def test_bends_remember_the_tensions_at_which_a_held_cable_came_to_rest() -> None:
    rubbing, plan, _ = let_out()
    walker = TruePath(rubbing, plan, Path())
    for k in range(len(plan.time_s)):
        walker.frame(k, 1)
        pulled = list(walker.state.tension.values())
        np.testing.assert_allclose([grip.inner[0] for grip in walker.grips], pulled, atol=1e-9)
        assert max(pulled) > 0.5


def test_tensions_that_creep_as_a_geometric_series_are_summed() -> None:
    end, first, ratio = np.array([2.0, 3.0]), np.array([0.3, 0.0]), 0.95
    passes = [end * np.exp(-first * ratio**k) for k in range(3)]
    assert creep_ahead(passes[:2], 1.0) is None
    np.testing.assert_allclose(creep_ahead(passes, 1.0), end, rtol=1e-9)
    np.testing.assert_allclose(creep_ahead(passes, 0.05), passes[-1] * np.exp([0.05, 0.0]))  # no farther than it may
    assert creep_ahead([end, end, end], 1.0) is None


def test_held_cables_that_rub_converge_when_they_are_let_out() -> None:
    """Tensions at their motors then creep, pass by pass, as long as their bends hold."""
    rubbing, plan, inputs = let_out()
    recording = make_recording(Timeline(plan.time_s), drives=Drives(NAMES, inputs, actuation="displacement"))

    def markers(declared: Robot) -> np.ndarray:
        driven = DrivenRobot(declared, drive_of(declared, recording))
        return np.array([seen for _, _, seen, _ in solve_path(driven, range(2), attrgetter("markers"))])

    true = np.array([rubbing.markers.positions(f.state.positions) for f in true_path(rubbing, plan, substeps=2)])
    expected = markers(rubbing)
    matters = np.abs(expected - markers(arm((5, 2, 2)))).max()
    np.testing.assert_allclose(true, expected, atol=5e-2 * matters)
    assert matters > 2e-4


@pytest.mark.parametrize(
    "effect",
    [
        {"name": "cable_friction", "coefficient": {"top": 0.3, "side": 0.1}},
        {"name": "creep", "fraction": [0.2, 0.1], "time_s": [1.0, 5.0]},
        {"name": "stiffness", "scale": 0.8},
        {"name": "cable_gain", "scale": {"side": 0.7}},
        {"name": "cable_offset", "tension_n": -0.3},
        {"name": "hyperelastic", "law": "neo_hookean"},
        {"name": "base_compliance", "stiffness_n_m": 500.0},
        {"name": "payload", "point_m": [0.1, 0.015, 0.015], "force_n": [0.0, 0.1, 0.0]},
    ],
)
def test_an_effect_of_the_truth_is_what_the_estimator_means_by_it(robot: Robot, effect: dict[str, Any]) -> None:
    """The script's effect on the truth, against the same effect in the estimator's model."""
    script = changed(BARE, {"effects": [effect], "truth__substeps": 6})
    checked = check_script(script)
    recording = recording_of(run_experiment(robot, checked))
    declared = apply_effects(robot, [effect])
    driven = DrivenRobot(declared, drive_of(declared, recording))
    expected = np.array([seen for _, _, seen, _ in solve_path(driven, range(recording.frame_count), attrgetter("markers"))])
    plain = _estimators_markers(robot, BARE)
    # friction depends on the way between frames (the bends turn), which the estimator takes in one step
    tolerance = 2e-2 * np.abs(expected - plain).max() if effect["name"] == "cable_friction" else 1e-9
    np.testing.assert_allclose(_true_markers(robot, script), expected, atol=tolerance)
    assert np.abs(expected - plain).max() > 2e-5


def test_friction_leaves_a_loop(robot: Robot) -> None:
    script = changed(BARE, {"effects": [{"name": "cable_friction", "coefficient": 0.3}], "loads": [], "initial": {}})
    markers = _true_markers(robot, script)[:6, 0]
    assert np.linalg.norm(markers[4] - markers[1]) > 1e-4  # the same input on the way down and up
    plain = _true_markers(robot, changed(script, {"effects": []}))[:6, 0]
    np.testing.assert_allclose(plain[4], plain[1], atol=1e-9)


def test_the_finer_truth_is_the_same_body(robot: Robot) -> None:
    fine = true_robot(robot, TruthTable.model_validate({"refinements": 1, "element": "tet10"}), [])
    old, new = robot.body, fine.body
    assert len(new.mesh.tets) == 8 * len(old.mesh.tets)
    assert element_volumes(new.mesh).sum() == pytest.approx(element_volumes(old.mesh).sum())
    np.testing.assert_allclose(new.weight().sum(axis=0), old.weight().sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(new.mesh.nodes[new.clamped][:, 0], 0.0, atol=1e-12)
    assert (new.mesh.nodes[:, 0] < 1e-12).sum() == len(new.clamped)
    for was, now in zip(old.cables, new.cables):
        np.testing.assert_allclose(now.path.positions(new.mesh.nodes), was.path.positions(old.mesh.nodes), atol=1e-12)
    np.testing.assert_allclose(new.mesh.nodes[new.clamp_nodes], old.mesh.nodes[old.clamp_nodes], atol=1e-12)
    assert new.material.law == "neo_hookean"


def test_the_finer_truth_keeps_a_soft_region_and_a_payload(robot: Robot) -> None:
    effects = [
        {"name": "soft_region", "center_m": [0.1, 0.015, 0.015], "radius_m": 0.04, "scale": 0.5},
        {"name": "payload", "point_m": [0.05, 0.015, 0.03], "force_n": [0.1, 0.0, -0.2]},
    ]
    declared = apply_effects(robot, effects)
    fine = true_robot(declared, TruthTable.model_validate({"refinements": 1, "element": "tet4"}), [])
    volume = lambda body: element_volumes(body.mesh)[body.material.young_modulus < 100e3].sum()  # noqa: E731
    assert volume(fine.body) == pytest.approx(volume(declared.body))
    np.testing.assert_allclose(fine.body.dead_forces.sum(axis=0), [0.1, 0.0, -0.2], atol=1e-12)


def test_an_effect_that_does_not_fit_is_named(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"effects\[0\].*coefficient"):
        true_robot(robot, TruthTable.model_validate({}), [{"name": "cable_friction", "coefficient": -1.0}])


def test_creep_of_a_step_is_the_closed_form() -> None:
    """A ramp of a millisecond and then rest: the load has crept by f (1 − exp(−t/τ))."""
    time = np.array([0.0, 1e-6, 0.5, 2.0, 40.0])
    C = creep_matrix(time, [(0.3, 2.0), (0.1, 0.5)])
    step = C @ np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    expected = 1 + 0.3 * (1 - np.exp(-time / 2.0)) + 0.1 * (1 - np.exp(-time / 0.5))
    np.testing.assert_allclose(step[1:], expected[1:], atol=1e-6)
    np.testing.assert_allclose(C @ np.ones(5), 1.4, rtol=1e-14)  # what was always there has crept to its end
    np.testing.assert_allclose(creep_matrix(time, []), np.eye(5), atol=1e-15)


def test_a_contact_presses_with_its_force_into_the_surface(robot: Robot) -> None:
    plan = plan_script(check_script(SCRIPT), robot)
    real = true_robot(robot, check_script(SCRIPT).truth, [])
    frames = true_path(real, plan)
    assert [len(frame.contacts) for frame in frames] == [0] * 7 + [1, 1]
    for frame, force in zip(frames[7:], (0.3, 0.1)):
        contact = frame.contacts[0]
        assert np.linalg.norm(contact.force) == pytest.approx(force, rel=1e-12)
        np.testing.assert_allclose(contact.force / force, -contact.normal, atol=1e-9)
        np.testing.assert_allclose(frame.state.nodal_forces.sum(axis=0), contact.force, atol=1e-7)
        assert contact.place[0] == pytest.approx(frame.state.positions[:, 0].max(), abs=2e-3)
    free = true_path(real, replace(plan, contacts=()))
    assert np.abs(free[7].state.positions - frames[7].state.positions).max() > 1e-4


def test_a_force_that_turns_with_a_floppy_body_settles(tmp_path: Path) -> None:
    floppy = load_robot(write_block_robot(tmp_path / "floppy", cells=(12, 2, 2), material__young_modulus_pa=1e5))
    press = {"sweep": "b", "point_m": [0.095, 0.01, 0.03], "force_n": [0.0, 1.5, 3.0]}
    script = changed(BARE, {"contacts": [press], "loads": [], "sweeps__1__cables": {"top": 1e-3}})
    plan = plan_script(check_script(script), floppy)
    contact = true_path(floppy, plan)[-1].contacts[0]
    assert (
        np.linalg.norm(contact.force) == pytest.approx(3.0, rel=1e-9) and contact.normal[2] < 0.8
    )  # turned by more than a third of a right angle
    np.testing.assert_allclose(contact.force / 3.0, -contact.normal, atol=1e-7)


def test_a_contact_patch_is_small_and_on_one_side(robot: Robot) -> None:
    mesh = true_robot(robot, TruthTable.model_validate({"refinements": 2, "element": "tet4"}), []).body.mesh
    patch = contact_patch(mesh, [0.07, 0.015, 0.03], 0.008)
    assert patch.share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(patch.place(mesh.nodes), [0.07, 0.015, 0.03], atol=1e-3)
    np.testing.assert_allclose(patch.normal(mesh.nodes), [0.0, 0.0, 1.0], atol=1e-12)
    through = contact_patch(mesh, [0.07, 0.015, 0.03], 0.2)
    assert (mesh.nodes[through.triangles][:, :, 2].mean(axis=1) > 0.0).all()
    np.testing.assert_allclose(patch.spread(np.array([1.0, 2.0, 3.0]), len(mesh.nodes)).sum(axis=0), [1.0, 2.0, 3.0])


def test_a_load_that_no_body_carries_costs_its_frames_and_not_the_recording(robot: Robot, tmp_path: Path) -> None:
    crushed = changed(BARE, {"sweeps__0__cables": {"top": 4000.0}, "sweeps__0__levels": [0.0, 1.0, 0.0005], "sweeps__0__up": 1})
    with pytest.warns(UserWarning, match="1 of 6 frames do not converge and are left out: 1; the first: .* overload"):
        folder = simulate(robot, crushed, tmp_path / "out")
    recording = load_recording(folder)
    assert recording.frame_numbers.tolist() == [0, 2, 3, 4, 5]
    np.testing.assert_allclose(recording.inputs[:2, 0], [0.25, 2.25])
    assert sorted(set(recording.load_frame.tolist())) == [0, 1, 2, 3, 4]
    known = json.loads((folder / "truth" / "truth.json").read_text())
    assert [(entry["frame"], "overload" in entry["why"]) for entry in known["skipped"]] == [(1, True)]
    calm = run_experiment(robot, check_script(changed(crushed, {"sweeps__0__levels": [0.0, 0.0005, 0.0005]})))
    np.testing.assert_allclose(recording.marker_xyz[recording.marker_frame == 1].shape, (3, 3))
    settled = run_experiment(robot, check_script(changed(crushed, {"sweeps__0__levels": [0.0, 0.00025, 0.0005]})))
    np.testing.assert_allclose(settled.marker_positions[2], calm.marker_positions[2], atol=1e-7)


def test_where_no_frame_settles_there_is_no_recording(robot: Robot) -> None:
    crushed = changed(BARE, {"initial": {"top": 4000.0}, "sweeps": [{"label": "a", "levels": [0.0]}], "loads": []})
    with pytest.raises(DataError, match=r"none of 1 frames converges; frame 0: .*overload"):
        run_experiment(robot, check_script(crushed))


def test_a_path_that_was_stopped_goes_on_with_the_same_result(robot: Robot, tmp_path: Path) -> None:
    """To the last bit, with friction that remembers and a contact."""
    script, keep = changed(SEEN, {"seed": 4}), (tmp_path / "kept", {"script": "4"})
    whole = simulate(robot, script, tmp_path / "whole")
    real = true_robot(robot, check_script(script).truth, script["effects"])
    course = next(islice(true_course(real, plan_script(check_script(script), robot), substeps=1), 7, None))
    Checkpoint(keep).keep(course)
    done: list[int] = []
    again = simulate(robot, script, tmp_path / "again", progress=lambda k, _: done.append(k), keep=keep)
    assert done == [9] and not keep[0].exists()
    assert folder_hash(whole) == folder_hash(again)


# The recording


SEEN = changed(
    SCRIPT,
    {
        "actuation_zero": "unknown",
        "markers": {"std_m": 1e-4, "frame_std_m": 2e-4, "placement_std_m": 3e-4, "rest_file": True, "occlusion": False},
        "clouds": {"kind": "ply", "frames": "contact", "extra_frames": [0], "voxel_m": 0.004},
        "camera__noise": {},
        "effects": [{"name": "cable_friction", "coefficient": 0.2}],
    },
)


def test_a_recording_loads_and_says_what_the_contract_says(robot: Robot, tmp_path: Path) -> None:
    folder = simulate(robot, SEEN, tmp_path / "out")
    recording = load_recording(folder)
    assert recording.frame_count == 9 and recording.actuation_zero == "unknown"
    np.testing.assert_allclose(recording.inputs[:6, 0], [0.0, 1.0, 2.0, 2.0, 1.0, 0.0])  # without the initial 0.25 N
    assert recording.T_robot_camera == (None,)
    assert [file is not None for (file,) in recording.cloud_files] == [True] + [False] * 6 + [True, True]
    assert recording.free is not None and recording.free.tolist() == [True] * 6 + [False] * 3
    assert recording.rest is not None and len(recording.rest.names) == 3
    assert len(recording.load_frame) == 6
    assert sorted(file.name for file in (folder / "truth").iterdir()) == [
        "contacts.csv",
        "markers.csv",
        "states.npz",
        "truth.json",
    ]
    rows = (folder / "truth" / "contacts.csv").read_text().splitlines()
    assert len(rows) == 3 and rows[1].startswith("7,6.5,0,")


def test_the_same_seed_gives_the_same_bytes(robot: Robot, tmp_path: Path) -> None:
    folders = [simulate(robot, changed(SEEN, {"seed": seed}), tmp_path / str(i)) for i, seed in enumerate((1, 1, 2))]
    hashes = [folder_hash(folder) for folder in folders]
    assert hashes[0] == hashes[1] != hashes[2]


def test_absolute_inputs_hold_the_initial_ones_and_the_pose_may_be_declared(robot: Robot) -> None:
    experiment = run_experiment(robot, check_script(changed(SCRIPT, {"camera__declare_pose": True})))
    recording = recording_of(experiment)
    np.testing.assert_allclose(recording.inputs[:3, 0], [0.25, 1.25, 2.25])
    np.testing.assert_allclose(recording.T_robot_camera[0], experiment.views[0].T_robot_camera, atol=1e-15)


def test_marker_noise_has_its_parts(robot: Robot) -> None:
    many = changed(
        SEEN, {"sweeps": [{"label": "still", "levels": [0.0] * 400}], "contacts": [], "loads": [], "effects": [], "initial": {}}
    )
    experiment = run_experiment(robot, check_script(many))
    recording = recording_of(experiment)
    measured = recording.marker_xyz.reshape(400, 3, 3)
    T = experiment.views[0].T_robot_camera
    error = measured @ T[:3, :3].T + T[:3, 3] - experiment.marker_positions
    common = error.mean(axis=1, keepdims=True)
    assert (error - common).std() == pytest.approx(1e-4 * np.sqrt(2 / 3), rel=0.05)
    assert common.std() == pytest.approx(np.hypot(2e-4, 1e-4 / np.sqrt(3)), rel=0.06)
    glued = experiment.robot.marker_points - robot.marker_points
    assert 1e-4 < np.abs(glued).max() < 1.5e-3
    np.testing.assert_allclose(experiment.marker_positions.std(axis=0), 0.0, atol=1e-12)  # glued once, not in each frame


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_nothing_half_written_is_left(robot: Robot, tmp_path: Path) -> None:
    import resource

    simulate(robot, SEEN, tmp_path / "whole")
    largest = max(file.stat().st_size for file in (tmp_path / "whole").rglob("*") if file.is_file())
    others = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:  # no file may become as large as the largest one of them
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest - 1, others[1]))
        with pytest.raises(OSError, match="File too large"):
            simulate(robot, SEEN, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, others)
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_a_probe_touches_from_outside(kind: str) -> None:
    place, normal = np.array([0.01, 0.02, 0.03]), np.array([0.0, 0.0, 1.0])
    probe = probe_shape(TrueContact(0, place, normal, np.array([0.0, 0.0, -0.5])), kind, 0.006, np.ones(3))
    local = probe.points - place
    assert local[:, 2].min() == pytest.approx(0.0, abs=1e-5)
    assert np.hypot(local[:, 0], local[:, 1]).max() == pytest.approx(0.006, rel=0.02)
    assert local[:, 2].max() > 0.1


def test_a_camera_that_sees_no_marker_is_refused(robot: Robot, tmp_path: Path) -> None:
    away = changed(SCRIPT, {"camera__eye_m": [1.0, 0.0, 0.3], "camera__target_m": [2.0, 0.0, 0.3]})
    with pytest.raises(InputError, match="no marker is visible"):
        simulate(robot, away, tmp_path / "out")
    assert not (tmp_path / "out").exists()
