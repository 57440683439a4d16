"""Contacts and forces by one objective, from clouds and from markers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record
from touched_arm import INPUTS, PLACE, touched

from femsense.calib.calibrate import calibrate
from femsense.core.pose import invert_pose, move_pose, transform_points
from femsense.model.recording import Recording
from femsense.model.recording_parts import Tool
from femsense.sensing.cone import within_cones
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import estimate_frame, sense
from femsense.sensing.fit import fit, whitened
from femsense.sensing.model import Candidates, Model
from femsense.sensing.no_penetration import gap_rows, in_touch
from femsense.sensing.odds import VISIBLE, odds_of
from femsense.sensing.options import SensingOptions
from femsense.sensing.pipeline import estimate
from femsense.sensing.prepare import make_sensor
from femsense.sensing.proposals import proposals
from femsense.sensing.status import Status, checked, verdict
from femsense.sensing.types import Refuted, Run

PUSH = np.array([0.0, 0.0, -0.15])


def estimated(recording: Recording, **options: Any) -> Run:
    return estimate(arm(), recording, calibrate(arm(), recording), options=SensingOptions(**options))


def model_of(recording: Recording) -> Model:
    return learn(make_sensor(arm(), recording, calibrate(arm(), recording)))


def test_a_visible_contact_has_its_force_and_place_within_its_interval(tmp_path: Path):
    run = estimated(touched(tmp_path, PUSH, ball=True))
    (contact,) = run.contacts
    assert [frame.status for frame in run.frames] == ["ok"] * 4
    assert (contact.frame, contact.source) == (3, "cloud")
    assert contact.force_n == pytest.approx(0.15, rel=0.1) and abs(contact.force_n - 0.15) < 3 * contact.std_n
    assert np.linalg.norm(contact.position_m[:2] - PLACE[:2]) < 0.004


def test_of_two_tips_that_squeeze_the_body_both_are_found_with_about_their_forces(tmp_path: Path):
    places, forces = np.array([[0.08, 0.01, 0.005], [0.08, -0.01, 0.005]]), np.array([[0.0, -0.9, 0.0], [0.0, 0.9, 0.0]])
    contacts = estimated(touched(tmp_path, forces, ball=True, place=places)).contacts
    assert len(contacts) == 2  # alone, the pixels hardly tell them: they cancel
    for contact, place in zip(sorted(contacts, key=lambda c: -float(c.position_m[1])), places):
        assert contact.source == "cloud" and np.linalg.norm(contact.position_m - place) < 0.009  # the arm is bent there
        assert 0.45 < contact.force_n < 1.8  # the dent below a tip depends on the mesh


def test_a_contact_that_no_camera_sees_is_inferred(tmp_path: Path):
    run = estimated(touched(tmp_path, PUSH, ball=False))
    (contact,) = run.contacts
    assert (contact.frame, contact.source) == (3, "shape") and abs(contact.force_n - 0.15) < 3 * contact.std_n
    assert contact.position_std_m[2] > 0.004 > contact.position_std_m[0]  # pushed from above, or pulled from below


def test_without_a_contact_none_is_reported(tmp_path: Path):
    run = estimated(touched(tmp_path, np.zeros(3), ball=False))
    assert not run.contacts and [frame.status for frame in run.frames] == ["ok"] * 4


def test_a_moved_camera_is_told_from_a_contact_by_the_background(tmp_path: Path):
    nudge = np.array([0.0, 0.0, 0.0, 0.0, 0.002, 0.0])
    run = estimated(touched(tmp_path, np.zeros(3), ball=False, nudge=nudge, wall=True))
    assert "the camera seems to have moved by 2.0 mm" in run.frames[3].status
    assert [frame.status for frame in run.frames[:3]] == ["ok"] * 3


def test_markers_alone_give_the_force_at_a_given_place():
    force = np.array([0.0, 0.1, -0.2])
    recording, _ = record(INPUTS, noise=1e-4, forces={3: (PLACE, force)})
    recording = replace(recording, free=np.array([True, True, True, False]))
    run = estimate(arm(), recording, calibrate(arm(), recording), at=PLACE)
    contact = run.contacts[-1]
    assert contact.source == "given" and np.linalg.norm((contact.force_n_xyz - force)[1:]) < 0.02


def test_a_gap_is_a_row_whose_derivative_is_that_of_the_gap(tmp_path: Path):
    """Nodes that move away from the ball open the gap by as much as the row says."""
    recording = replace(touched(tmp_path, PUSH, ball=True), tools=(Tool("ball", "ball", 0.006),))
    model = model_of(recording)
    best = estimate_frame(model, 3, None).best
    (contact,) = best.contacts
    assert contact.shape is not None and contact.shape.kind == "sphere" and in_touch(model, contact, best.state.positions)
    assert odds_of(model, contact, best.rows) < VISIBLE  # a ball at the surface is likely to touch
    here = gap_rows(model, best.frame, best.contacts, best.state.positions)
    lower = np.zeros_like(best.state.positions)
    lower[:, 2] = -1e-4
    there = gap_rows(model, best.frame, best.contacts, best.state.positions + lower)
    assert there[0].residual - here[0].residual == pytest.approx(-here[0].of(lower[None])[:, 0], abs=2e-6)


def test_an_object_that_lies_in_the_undeformed_body_overlaps_it_without_a_contact(tmp_path: Path):
    recording = replace(touched(tmp_path, PUSH, ball=True), tools=(Tool("ball", "ball", 0.006),))
    model = model_of(recording)
    best = estimate_frame(model, 3, None).best
    (row,) = gap_rows(model, best.frame, (), best.frame.predicted.positions)
    assert row.residual[0] > 3.0 * row.std[0]


def test_the_evidence_of_a_true_contact_falls_when_it_is_dropped(tmp_path: Path):
    best = estimate_frame(model_of(touched(tmp_path, PUSH, ball=True)), 3, None).best
    assert best.drop_gain[0] > best.odds[0] + 10.0 and best.converged


def test_a_status_is_an_enum_with_a_text():
    told = verdict(Status.UNDETERMINED, force_n=0.48, std_n=0.26)
    assert str(told) == "contact, size not determined (0.48 ± 0.26 N)" and told.trusted
    assert not verdict(Status.NOT_CONVERGED).trusted and str(verdict(Status.OK)) == "ok"


def test_an_object_in_touch_without_a_contact_is_said(tmp_path: Path):
    model = model_of(touched(tmp_path, PUSH, ball=True))
    best = estimate_frame(model, 3, None).best
    beside = replace(best.frame, latent=best.contacts)
    unsure = replace(best, frame=beside, latent_force=np.array([[0.02, 0.15]]))
    known = replace(unsure, latent_force=np.array([[0.0, 0.01]]))
    hidden = replace(known, contacts=(replace(best.contacts[0], source="shape"),))
    found = [checked(model, one).status for one in (best, unsure, known, hidden)]
    assert found == [Status.OK, Status.MAY_TOUCH, Status.OK, Status.SEEN_ELSEWHERE]
    assert "up to 0.32 N" in str(checked(model, unsure))


def test_contact_free_clouds_correct_the_pose_of_the_camera(tmp_path: Path):
    recording = touched(tmp_path, np.zeros(3), ball=False)
    calibration = calibrate(arm(), recording)
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5e-4])
    off = replace(
        calibration,
        poses=tuple(move_pose(T, step) for T in calibration.poses),
        T_robot_camera=move_pose(calibration.T_robot_camera, step),
        joint_covariance=np.diag([1e-6] * 3 + [1e-6] * 3),
    )
    found = learn(make_sensor(arm(), recording, off)).sensor.calibration.poses[0]
    seen = transform_points(invert_pose(T_ROBOT_CAMERA), PLACE[None])
    after, before = (float(np.linalg.norm(transform_points(T, seen)[0] - PLACE)) for T in (found, off.poses[0]))
    assert before > 4e-4 and after < 0.3 * before


def test_the_same_frame_again_has_the_same_force(tmp_path: Path):
    model = model_of(touched(tmp_path, PUSH, ball=True))
    frame = sense(model, 3, None)
    again = sense(model, 3, frame)
    assert len(frame.contacts) == 1 and again.report.status == "ok"
    assert abs(again.contacts[0].force_n - frame.contacts[0].force_n) < 0.5 * frame.contacts[0].std_n


def test_an_estimate_that_goes_on_searches_with_the_answers_it_had(tmp_path: Path):
    model = model_of(touched(tmp_path, PUSH, ball=False))
    best = estimate_frame(model, 3, None).best
    near = replace(best.state, positions=best.state.positions * [1.0, 1.02, 1.0])
    had = model.answers_near(best.state)
    assert model.answers_near(near) is had
    resumed = replace(model, candidates=Candidates(model.candidates.state))
    np.testing.assert_allclose(resumed.answers_near(near), had, atol=1e-9)
    assert np.abs(replace(model, candidates=Candidates()).answers_near(near) - had).max() > 1e-6


def test_the_expected_gain_of_a_contact_is_about_that_of_its_fit(tmp_path: Path):
    """The second-order model of the vicinity of a fit ranks proposals: it has to be right to first order."""
    model = model_of(touched(tmp_path, 0.1 * PUSH, ball=False))
    alone = estimate_frame(model, 2, None).best
    frame = replace(estimate_frame(model, 3, None).best.frame)
    start = fit(model, frame, (), np.zeros((0, 3)), frame.predicted)
    assert start is not None and not alone.contacts
    best = max(proposals(model, start, ()), key=lambda one: one.gain)
    found = fit(model, frame, best.contacts, best.forces, frame.predicted, tau=best.tau)
    assert found is not None
    gained = start.criterion - found.criterion
    assert gained > 0.0 and best.gain == pytest.approx(gained, rel=0.5, abs=6.0)


def test_a_refuted_proposal_is_not_fitted_again_for_some_frames(tmp_path: Path):
    model = model_of(touched(tmp_path, PUSH, ball=False))
    alone = fit(
        model,
        estimate_frame(model, 3, None).best.frame,
        (),
        np.zeros((0, 3)),
        estimate_frame(model, 3, None).best.frame.predicted,
    )
    assert alone is not None
    free = sense(model, 2, None)
    for error, age, found in ((1e9, 1, 0), (1e9, 11, 1), (0.0, 1, 1)):
        refuted = tuple(Refuted(3 - age, (), one.contacts, error) for one in proposals(model, alone, []))
        assert len(sense(model, 3, replace(free, refuted=refuted)).touches) == found


@pytest.mark.parametrize("ball", [True, False])
def test_the_normal_force_of_a_visible_contact_has_no_prior_in_its_covariance(tmp_path: Path, ball: bool):
    best = estimate_frame(model_of(touched(tmp_path, PUSH, ball=ball)), 3, None).best
    scale = whitened(model_of(touched(tmp_path, PUSH, ball=ball)), best, trust=False)[0]
    X = np.hstack([best.D * scale, best.N])
    precision = np.eye(X.shape[1]) + (X * best.weight[:, None]).T @ X
    precision[0, 0] -= 1.0 if ball else 0.0
    covariance = np.linalg.inv(precision)[:3, :3] * np.outer(scale[:3], scale[:3])
    np.testing.assert_allclose(best.axes[0] @ best.covariance @ best.axes[0].T, covariance, rtol=1e-6, atol=1e-12)


def test_a_gap_moves_with_the_cameras_that_show_its_object(tmp_path: Path):
    recording = replace(touched(tmp_path, PUSH, ball=True), tools=(Tool("ball", "ball", 0.006),))
    model = model_of(recording)
    best = estimate_frame(model, 3, None).best
    (alone,) = gap_rows(model, best.frame, best.contacts, best.state.positions)
    (contact,) = best.contacts
    assert contact.shape is not None
    calibration = model.sensor.calibration
    two = replace(model, sensor=replace(model.sensor, calibration=replace(calibration, poses=2 * calibration.poses)))
    seen = replace(contact, shape=replace(contact.shape, seen_by=np.array([0.25, 0.75])))
    (shared,) = gap_rows(two, best.frame, [seen], best.state.positions)
    np.testing.assert_allclose(shared.by_pose, np.hstack([0.25 * alone.by_pose, 0.75 * alone.by_pose]))
    assert shared.camera.tolist() == [[0.25, 0.75]]


def test_a_weight_does_not_pull_upwards(tmp_path: Path):
    """A force that lifts becomes none, one that sways stays as it is."""
    best = estimate_frame(model := model_of(touched(tmp_path, PUSH, ball=False)), 3, None).best
    hangs = replace(best, contacts=(replace(best.contacts[0], pulls=True),))
    axes = np.eye(3)[None, [2, 0, 1]]
    assert within_cones(model.sensor, replace(hangs, forces=np.array([[0.05, 0.0, -0.1]])), axes) is None
    lifted = within_cones(model.sensor, replace(hangs, forces=np.array([[0.0, 0.0, 0.1]])), axes)
    assert lifted is not None and abs(lifted[0, 2]) < 1e-3


def test_an_error_that_body_and_ball_share_leaves_their_gap(tmp_path: Path):
    """A camera that sees all surfaces too high moves the rows of the body's upper side, and that of its gap to a ball above, by opposite amounts."""
    recording = replace(touched(tmp_path, PUSH, ball=True), tools=(Tool("ball", "ball", 0.006),))
    model = model_of(recording)
    best = estimate_frame(model, 3, None).best
    (gap,) = gap_rows(model, best.frame, best.contacts, best.state.positions)
    near = best.rows.pixel & (np.linalg.norm(best.rows.rest - gap.rest, axis=1) < 0.004) & (best.rows.direction[:, 2] > 0.9)
    upwards = best.rows.direction[near] @ gap.direction[0]
    assert near.sum() > 3 and (upwards < -0.9).all()
    assert gap.field[0] @ best.rows.field[near].mean(axis=0) < -0.5
