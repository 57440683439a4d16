"""The constitutive law of the fitted states, and the deviations of forces due to it and to the zones of contacts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm
from touched_arm import touched

from femsense import calibrate
from femsense.core.arrays import FloatArray
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import covariances_of, estimate_frame
from femsense.sensing.fit import whitened
from femsense.sensing.law import moved_by_law, moved_by_zones
from femsense.sensing.model import Fit, Model
from femsense.sensing.prepare import make_sensor
from femsense.sensing.touches import make_touch


@pytest.fixture(scope="module")
def pushed(tmp_path_factory) -> tuple[Model, Fit]:
    """Without gravity and tensions the law changes nothing in the frames without contact."""
    none, force = np.zeros((4, 4)), np.array([0.0, 0.0, -0.6])
    recording, robot = (
        touched(tmp_path_factory.mktemp("pushed"), force, ball=False, inputs=none, gravity=np.zeros(3)),
        arm(gravity=np.zeros(3)),
    )
    model = learn(make_sensor(robot, recording, calibrate(robot, recording)))
    return model, estimate_frame(model, 3, None).best


def with_law(model: Model, law: str) -> Model:
    robot = model.sensor.robot
    robot = replace(robot, body=robot.body.with_material(replace(robot.body.material, law=law)))
    return replace(model, sensor=replace(model.sensor, robot=robot, driven=replace(model.sensor.driven, robot=robot)))


def test_states_with_clouds_are_neo_hookean_where_no_law_is_declared(pushed):
    model, _ = pushed
    assert model.sensor.robot.body.material.law == "neo_hookean" and not model.sensor.declares_law


def that_makes_up_for(model: Model, best: Fit, displacement: FloatArray) -> FloatArray:
    """Return the change of the force by which a fit with one contact makes up for a displacement of its model (n, 3)."""
    scale = whitened(model, best, trust=False)[0]
    X = np.hstack([best.D * scale, best.N])
    root = np.sqrt(best.weight)
    right = np.append(-root * best.rows.of(displacement[None])[:, 0], np.zeros(X.shape[1]))
    change = np.linalg.lstsq(np.vstack([root[:, None] * X, np.eye(X.shape[1])]), right)[0]
    return best.axes[0].T @ (scale * change[:5])[:3]


def test_the_change_under_the_other_law_makes_up_for_how_far_it_moves_the_body(pushed):
    model, best = pushed
    state = with_law(model, "corotational").solve(best.frame, best.contacts, best.forces, best.state)
    assert state is not None
    change = that_makes_up_for(model, best, state.positions - best.state.positions)
    assert np.linalg.norm(change) > 0.02
    assert np.linalg.norm(change - moved_by_law(model, best)) < 0.5 * np.linalg.norm(change)  # first order in the strain


def test_the_difference_of_the_laws_is_part_of_the_covariance(pushed):
    model, best = pushed
    change = moved_by_law(model, best)
    compliance = model.compliance_std**2 * np.outer(best.forces, best.forces)
    np.testing.assert_allclose(
        covariances_of(model, best)[0], best.covariance + compliance + np.outer(change, change) / 3.0, rtol=1e-9
    )


def test_the_length_of_a_line_contact_is_part_of_the_covariance(pushed):
    model, best = pushed
    own = best.contacts[0]
    made = [make_touch(model.sensor, own.place, source=own.source, along=np.array([a, 0.0, 0.0])) for a in (0.006, 0.012, 0.024)]
    half, whole, double = (replace(own, along=one.along, patch=one.patch) for one in made)
    with_zone = replace(best, contacts=(whole,))
    moved = moved_by_zones(model, with_zone)
    states = [model.solve(best.frame, (one,), best.forces, best.state) for one in (half, whole, double)]
    for at, change in ((0, moved[0]), (2, moved[1])):
        wanted = that_makes_up_for(model, best, states[at].positions - states[1].positions) / np.sqrt(2.0)
        assert np.linalg.norm(wanted) > 1e-4 and np.linalg.norm(change - wanted) < 0.3 * np.linalg.norm(wanted)
    np.testing.assert_allclose(covariances_of(model, with_zone)[0], covariances_of(model, best)[0] + moved.T @ moved, rtol=1e-9)


def test_a_robot_that_declares_its_law_keeps_it(tmp_path):
    recording = touched(tmp_path, np.array([0.0, 0.0, -0.3]), ball=True)
    robot = arm(law="gent")
    model = learn(make_sensor(robot, recording, calibrate(robot, recording)))
    assert model.sensor.robot.body.material.law == "gent" and model.sensor.declares_law
    assert not moved_by_law(model, estimate_frame(model, 3, None).best).any()


def test_without_contact_free_frames_a_warning_states_that_nothing_checks_the_frames(tmp_path):
    recording = touched(tmp_path, np.array([0.0, 0.0, -0.3]), ball=True)
    sensor = make_sensor(arm(), recording, calibrate(arm(), recording))
    with pytest.warns(UserWarning, match="no contact-free frame can be used"):
        model = learn(replace(sensor, recording=replace(recording, free=np.zeros(4, dtype=bool))))
    assert model.limits is None
