"""Forces from markers and clouds of an arm of another mesh and law than the estimator's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, record
from touched_arm import touched as pushed_arm

from femsense.calib.calibrate import calibrate
from femsense.core.errors import InputError
from femsense.core.pose import invert_pose, transform_points
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.options import SensingOptions
from femsense.sensing.pipeline import estimate
from femsense.sensing.run_arrays import sensed

TIP = np.array([0.1, 0.0, 0.01])
FORCE = np.array([0.01, 0.08, -0.15])
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0]])


@pytest.fixture(scope="module")
def touched() -> tuple[Recording, list[np.ndarray]]:
    """Two free frames, then two with a force at the tip; noise 0.1 mm."""
    recording, states = record(INPUTS, noise=1e-4, forces={2: (TIP, FORCE), 3: (TIP, 2 * FORCE)})
    return replace(recording, free=np.array([True, True, False, False])), states


def test_a_force_at_a_given_place_comes_out_of_markers(touched):
    recording, _ = touched
    run = estimate(arm(), recording, calibrate(arm(), recording), at=TIP)
    assert {2, 3} <= {contact.frame for contact in run.contacts}
    for contact in run.contacts:
        true = (0 * FORCE, 0 * FORCE, FORCE, 2 * FORCE)[contact.frame]
        off = contact.force_n_xyz - true
        assert np.linalg.norm(off[1:]) < 0.01 + 0.05 * np.linalg.norm(true)
        assert abs(off[0]) < 3 * contact.force_std_n_xyz[0]  # along itself the arm is stiff: its markers tell less of this part
        assert np.linalg.norm(off) < 3 * contact.std_n
        assert contact.source == "given"
    assert all(report.status == "ok" for report in run.frames)
    assert run.frames[3].rms_after_m < 0.2 * run.frames[3].rms_before_m
    felt = {contact.frame for contact in sensed(run.contacts)}
    assert 3 in felt and not {0, 1} & felt  # places without a force are rows of contacts.csv, and no contacts
    assert [report.contacts for report in run.frames] == [int(k in felt) for k in range(4)]


def test_what_is_said_to_push_at_given_places_does_not_pull():
    """A force that lifts the arm may be of either place; where both push, it is the lower one that carries it."""
    upper, lift = np.array([0.08, 0.0, 0.01]), np.array([0.0, 0.03, 0.15])
    recording, _ = record(INPUTS, noise=1e-4, forces={2: (upper, lift)})
    recording, at = replace(recording, free=np.array([True, True, False, True])), [upper, upper * [1.0, 0.0, -1.0]]
    calibration = calibrate(arm(), recording)
    pulled, pushed = (estimate(arm(), recording, calibration, at=at, options=SensingOptions(push=push)) for push in (False, True))
    first, second = pulled.contacts
    assert np.linalg.norm((first.force_n_xyz + second.force_n_xyz - lift)[1:]) < 0.02
    assert abs(first.force_n_xyz[2] - 0.15) < 2.0 * first.force_std_n_xyz[2] and not sensed(pulled.contacts)
    assert [contact.track for contact in pushed.contacts if contact.force_n_xyz[2] > 0.1] == [1]
    for contact in pushed.contacts:
        along = -contact.force_n_xyz @ contact.normal
        assert np.linalg.norm(contact.force_n_xyz + along * contact.normal) <= along + 1e-4


def test_a_contact_at_a_given_place_is_the_same_one_after_a_frame_that_is_not_trusted():
    recording, _ = record(INPUTS, noise=1e-4, forces={1: (TIP, FORCE), 3: (TIP, FORCE)})
    recording = replace(recording, free=np.array([True, False, False, False]))
    calibration = calibrate(arm(), recording)
    spoiled = np.where(
        recording.marker_frame[:, None] == 2, 0.01 * np.random.default_rng(0).normal(size=(len(recording.marker_xyz), 3)), 0.0
    )
    run = estimate(arm(), replace(recording, marker_xyz=recording.marker_xyz + spoiled), calibration, at=TIP)
    assert [frame.status == "ok" for frame in run.frames] == [True, True, False, True]
    assert {contact.frame: contact.track for contact in run.contacts if contact.frame != 2} == {1: 0, 3: 0}


@pytest.mark.parametrize("along", [0.6, -0.6])
def test_a_force_along_the_arm_has_its_size_and_its_sign(along: float):
    true = np.array([along, 0.1, -0.2])
    recording, _ = record(INPUTS, noise=2e-5, forces={3: (TIP, true)})
    recording = replace(recording, free=np.array([True, True, True, False]))
    contact = estimate(arm(), recording, calibrate(arm(), recording), at=TIP).contacts[-1]
    off = contact.force_n_xyz - true
    assert abs(off[0]) < 0.25 * abs(along) and np.linalg.norm(off[1:]) < 0.02
    assert np.linalg.norm(off) < 3 * contact.std_n


def test_three_standard_deviations_hold_the_truth(touched):
    recording, _ = touched
    run = estimate(arm(), recording, calibrate(arm(), recording), at=TIP)
    for contact, true in zip(run.contacts[-2:], (FORCE, 2 * FORCE)):
        assert abs(contact.force_n - np.linalg.norm(true)) < 3 * contact.std_n
        along = true / np.linalg.norm(true)
        assert np.linalg.norm(contact.force_std_n_xyz * along) < 0.15 * np.linalg.norm(true)
        assert contact.std_n < contact.force_std_n_xyz[0]  # along the arm the force is hardly known, and its size holds that part


def test_a_known_load_at_the_place_is_sensed_and_compared(touched):
    recording, _ = touched
    loaded = replace(recording, load_frame=np.array([3]), load_points=TIP[None], load_forces=2 * FORCE[None])
    run = estimate(arm(), loaded, calibrate(arm(), recording), at=TIP)
    assert run.known_loads[0].frame == 3
    assert abs(run.known_loads[0].error_percent) < 15


def test_a_broken_frame_is_reported_and_the_rest_goes_on(touched):
    recording, _ = touched
    keep = recording.marker_frame != 2
    gap = replace(
        recording,
        marker_frame=recording.marker_frame[keep],
        marker_index=recording.marker_index[keep],
        marker_view=recording.marker_view[keep],
        marker_xyz=recording.marker_xyz[keep],
    )
    run = estimate(arm(), gap, calibrate(arm(), recording), at=TIP)
    assert "no marker" in run.frames[2].status and "prediction under the inputs" in run.frames[2].status
    inputs = dict(zip(recording.cable_names, recording.inputs[2].tolist()))
    expected = solve_equilibrium(arm().body, tension=inputs).positions
    np.testing.assert_allclose(run.states.nodes_m[2], expected, atol=1e-6)
    assert run.frames[3].status == "ok"


def test_without_clouds_a_place_must_be_given(touched):
    recording, _ = touched
    with pytest.raises(InputError, match="--at"):
        estimate(arm(), recording, calibrate(arm(), recording))


def test_a_place_far_from_the_body_is_refused(touched):
    recording, _ = touched
    with pytest.raises(InputError, match="far from the surface"):
        estimate(arm(), recording, calibrate(arm(), recording), at=[100.0, 0.0, 10.0])


def cloud_of(states: np.ndarray, force_at: np.ndarray | None, rng: np.random.Generator) -> PointCloud:
    """Return what the camera sees of the true arm in blue (faces towards it) and of a red ball at the place of the force."""
    true = arm((8, 3, 3), law="neo_hookean")
    triangles = surface_triangles(true.body.mesh)
    facing = (
        np.einsum("tc,tc->t", triangle_normals(states, triangles), T_ROBOT_CAMERA[:3, 3] - states[triangles].mean(axis=1)) > 0
    )
    triangles = triangles[facing]
    corners = states[triangles]
    weights = rng.dirichlet(np.ones(3), size=(len(triangles), 12))
    points = np.einsum("tsi,tic->tsc", weights, corners).reshape(-1, 3)
    colors = np.tile([0.2, 0.4, 0.8], (len(points), 1))
    if force_at is not None:
        ball = rng.normal(size=(1500, 3))
        ball = force_at + 0.006 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
        points, colors = np.vstack([points, ball]), np.vstack([colors, np.tile([0.9, 0.1, 0.1], (1500, 1))])
    noisy = points + 2e-4 * rng.normal(size=points.shape)
    return PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), noisy), colors)


def seen_clouds(folder: Path, place: np.ndarray, *, hides: float = 0.0) -> Recording:
    """Return a recording with clouds of the arm, pushed down on its upper face by 0.1 N in the last frame, by a ball that hides this face so far [m]."""
    recording, states = record(INPUTS, noise=1e-4, forces={3: (place, np.array([0.0, 0.0, -0.1]))})
    rng = np.random.default_rng(5)
    files = []
    true = arm((8, 3, 3), law="neo_hookean")
    rest = true.body.mesh.nodes
    node = int(np.argmin(np.linalg.norm(rest - place, axis=1)))
    for k, x in enumerate(states):
        ball = x[node] + [0, 0, 0.006] if k == 3 else None
        cloud = cloud_of(x, ball, rng)
        if hides and ball is not None:
            points = transform_points(T_ROBOT_CAMERA, cloud.points)
            top = x[rest[:, 2] > 0.0099]
            top = top[np.argsort(top[:, 0])]
            level = np.interp(points[:, 0], top[:, 0], top[:, 2])
            hidden = (points[:, 2] > level - 2e-3) & (np.linalg.norm(points[:, :2] - x[node, :2], axis=1) < hides)
            keep = ~hidden | (cloud.colors[:, 0] > 0.5)
            cloud = PointCloud(cloud.points[keep], cloud.colors[keep])
        write_cloud(folder / f"{k:06d}.ply", cloud)
        files.append((folder / f"{k:06d}.ply",))
    return replace(recording, free=np.array([True, True, True, False]), cloud_files=tuple(files), color_files=((None,),) * 4)


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Recording:
    """Clouds of the arm, pushed down in the middle of its upper face near the tip."""
    return seen_clouds(Path(tmp_path_factory.mktemp("clouds")), np.array([0.085, 0.0, 0.01]))


def test_a_push_is_found_in_a_coloured_cloud_with_its_force(seen):
    run = estimate(arm(), seen, calibrate(arm(), seen))
    assert [c.frame for c in run.contacts] == [3]
    contact = run.contacts[0]
    assert contact.source == "cloud"
    assert np.linalg.norm(contact.position_m[:1] - 0.085) < 0.006
    assert contact.force_n == pytest.approx(0.1, rel=0.15)
    assert abs(contact.force_n - 0.1) < 3 * contact.std_n
    assert contact.force_n_xyz[2] < -0.08


def test_a_friction_cone_allows_a_force_beside_the_normal(seen):
    run = estimate(arm(), seen, calibrate(arm(), seen), options=SensingOptions(friction=0.5))
    contact = run.contacts[0]
    along = -contact.force_n_xyz @ contact.normal
    assert np.linalg.norm(contact.force_n_xyz + along * contact.normal) <= 0.5 * along + 1e-9


def test_the_data_say_where_a_force_points_that_was_found(tmp_path):
    """What touches hides the side that it touches: here the camera sees but the flank of the arm beside the ball."""
    seen = seen_clouds(tmp_path, np.array([0.085, 0.01, 0.01]), hides=0.015)
    contact = estimate(arm(), seen, calibrate(arm(), seen)).contacts[0]
    assert abs(contact.force_n - 0.1) < max(0.02, 2 * contact.std_n)
    assert contact.force_n_xyz[2] < -0.9 * contact.force_n


def test_without_friction_a_force_lies_along_the_normal(tmp_path):
    recording = pushed_arm(tmp_path, np.array([0.0, 0.0, -0.15]), ball=True)
    contacts = estimate(arm(), recording, calibrate(arm(), recording), options=SensingOptions(friction=0.0)).contacts
    (contact,) = [one for one in contacts if one.source == "cloud"]
    np.testing.assert_allclose(np.cross(contact.force_n_xyz, contact.normal), 0.0, atol=0.03 * contact.force_n)


def test_a_cloud_that_is_no_cloud_is_reported(seen, tmp_path):
    broken = tmp_path / "000002.ply"
    broken.write_bytes(b"not a cloud")
    files = (*seen.cloud_files[:2], (broken,), seen.cloud_files[3])
    run = estimate(arm(), replace(seen, cloud_files=files), calibrate(arm(), seen))
    assert run.frames[2].status != "ok"
    assert str(broken) in run.frames[2].status
    assert run.frames[3].status == "ok"


class _Singular(type(Path())):
    """A cloud in whose frame a system of equations is singular."""

    @property
    def suffix(self):
        raise np.linalg.LinAlgError("Singular matrix")


def test_a_frame_whose_equations_have_no_solution_is_reported_and_the_rest_goes_on(seen):
    files = (*seen.cloud_files[:2], (_Singular(seen.cloud_files[2][0]),), seen.cloud_files[3])
    touched_there = replace(seen, cloud_files=files, free=np.array([True, True, False, False]))
    run = estimate(arm(), touched_there, calibrate(arm(), seen))
    assert run.frames[2].status == "its equations have no solution: Singular matrix"
    assert run.frames[3].status == "ok"


def test_the_motor_tensions_are_reported(seen):
    run = estimate(arm(), seen, calibrate(arm(), seen))
    assert run.frames[3].tension_n == pytest.approx(dict(zip(NAMES, INPUTS[3])))


def test_a_cloud_frame_whose_markers_are_elsewhere_is_not_ok(seen):
    """The cloud of another frame: it fits the body under the inputs, but the markers say that the body is not there."""
    moved = seen.marker_xyz + np.where(seen.marker_frame == 1, 0.008, 0.0)[:, None] * np.array([0.0, 1.0, 0.0])
    run = estimate(arm(), replace(seen, marker_xyz=moved), calibrate(arm(), seen))
    assert "the markers lie" in run.frames[1].status and "mm off the body" in run.frames[1].status
    assert [frame.status for frame in run.frames[2:]] == ["ok", "ok"]


def test_a_known_load_at_the_place_is_sensed_in_a_frame_that_is_declared_contact_free(touched):
    recording, _ = touched
    load = {"load_frame": np.array([3]), "load_points": TIP[None], "load_forces": 2 * FORCE[None]}
    declared = replace(recording, free=np.array([True, True, False, True]), **load)
    run = estimate(arm(), declared, calibrate(arm(), recording), at=TIP)
    assert abs(run.known_loads[0].error_percent) < 15 and run.frames[3].status == "ok"
