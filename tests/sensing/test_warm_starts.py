"""A frame begins with the contacts of the one before: what holds, what is gone, what is new, and when that is enough."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm
from scipy.spatial import cKDTree
from touched_arm import touched

from femsense.calib.calibrate import calibrate
from femsense.pointcloud.primitives import Shape
from femsense.sensing.forces import fit_forces, no_forces
from femsense.sensing.pipeline import sense_frame
from femsense.sensing.places import object_touches
from femsense.sensing.prepare import condensed_at, make_sensor, scan_of
from femsense.sensing.responses import response_at
from femsense.sensing.search import held_on, nothing_new
from femsense.sensing.states import foretold, free_state
from femsense.sensing.touches import contact_radius, make_touch, pressed
from femsense.sensing.types import Fit, SensedFrame, Sensor

FORCE = np.array([0.0, 0.0, -0.15])
AWAY = np.array([0.04, 0.0, 0.01])


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sensor, SensedFrame]:
    """Return a sensor and its frame in which a ball pushes."""
    folder: Path = tmp_path_factory.mktemp("ball")
    seen = touched(folder, FORCE, ball=True)
    sensor = make_sensor(arm(), seen, calibrate(arm(), seen))
    return sensor, sense_frame(sensor, 3, None)


@pytest.fixture(scope="module")
def fits(pushed: tuple[Sensor, SensedFrame]) -> tuple[Fit, Fit]:
    """Return that frame without forces, and with one where the ball is."""
    sensor, frame = pushed
    scan = scan_of(sensor, 3, frame.state)
    assert scan is not None
    few = condensed_at(sensor, scan, frame.state)
    free = no_forces(sensor, 3, few, frame.free_state)
    return free, fit_forces(sensor, 3, few, frame.touches, free)


def test_the_same_frame_again_has_the_same_force(pushed):
    sensor, frame = pushed
    again = sense_frame(sensor, 3, frame)
    assert len(frame.contacts) == 1 and again.report.status == "ok"
    assert abs(again.contacts[0].force_n - frame.contacts[0].force_n) < 0.5 * frame.contacts[0].std_n


def test_a_touch_moves_on_with_its_object(pushed):
    sensor, frame = pushed
    touch = frame.touches[0]
    found = make_touch(sensor, touch.expected + np.array([0.004, 0.0, 0.0]), source="cloud", std_m=1e-3)
    held, kept = held_on(sensor, frame.touches, [found], frame.sure)
    assert kept.tolist() == [0]
    np.testing.assert_allclose(held[0].expected, found.place)
    np.testing.assert_allclose(held[0].place - found.place, touch.place - touch.expected, atol=1e-4)


def test_what_is_gone_is_left_out_and_what_is_new_is_fitted_along(pushed):
    sensor, frame = pushed
    assert held_on(sensor, frame.touches, [], (True,), gone=True)[0] == []
    (unseen,), _ = held_on(sensor, frame.touches, [], (True,))
    assert unseen.place is frame.touches[0].place and unseen.source == "shape"  # nothing is seen to touch there any more
    assert held_on(sensor, frame.touches, [], (False,))[0] == []
    other = make_touch(sensor, AWAY, source="cloud", std_m=1e-3)
    held, kept = held_on(sensor, frame.touches, [frame.touches[0], other], (False,))
    assert kept.tolist() == [0, -1] and held[1] is other and held[0].std_m == 0.0


def test_a_fit_is_enough_where_it_leaves_nothing_to_another_contact(pushed, fits):
    sensor, frame = pushed
    free, fit = fits
    assert nothing_new(sensor, fit, frame.touches)
    assert not nothing_new(sensor, fit, [*frame.touches, make_touch(sensor, AWAY, source="cloud")])
    assert not nothing_new(sensor, free, [])  # the shape betrays a touch
    other = make_touch(sensor, AWAY, source="cloud", std_m=1e-3)
    scan = scan_of(sensor, 3, frame.state)
    assert scan is not None
    beside = fit_forces(sensor, 3, condensed_at(sensor, scan, frame.state), [*frame.touches, other], free)
    assert nothing_new(sensor, beside, [*frame.touches, other])
    assert not nothing_new(sensor, beside, frame.touches)  # what seemed to touch there does not in this state


def test_points_of_the_body_itself_touch_nothing_in_the_state_that_the_force_makes(pushed):
    """A dark crease is not of the body's colour: in the state without forces its points lie beside the body."""
    sensor, frame = pushed
    upper = frame.state.positions[np.isclose(sensor.robot.body.mesh.nodes[:, 2], 0.01)]
    crease = upper[np.linalg.norm(upper - frame.touches[0].place, axis=1) < 0.02]
    shape = Shape("points", crease.mean(axis=0), np.eye(3), np.zeros(3), 0.0, 0.006, crease, cKDTree(crease), edge_m=0.0015)
    assert object_touches(sensor, [shape], frame.free_state)
    assert not object_touches(sensor, [shape], frame.state)
    assert object_touches(sensor, [replace(shape, edge_m=0.0)], frame.state)


def test_a_state_is_foretold_by_the_inputs(pushed):
    frame = pushed[1]
    alone = replace(frame.free_state, positions=frame.free_state.positions + 1e-3)
    np.testing.assert_allclose(foretold(frame, alone).positions, frame.state.positions + 1e-3)
    assert foretold(None, alone) is alone


def test_a_response_is_lent_to_states_near_by_alone(pushed):
    sensor = pushed[0]
    state = free_state(sensor, 3, None, None)
    here = response_at(sensor, state)
    near, far = (replace(state, positions=state.positions + share * sensor.size) for share in (5e-5, 2e-4))
    assert response_at(sensor, near, here) is here
    assert response_at(sensor, far, here) is not here


def test_a_patch_is_as_wide_as_hertz_has_it(pushed: tuple[Sensor, SensedFrame]) -> None:
    sensor, nodes = pushed[0], pushed[0].robot.body.mesh.nodes
    touch = make_touch(sensor, AWAY, source="cloud", radius=0.03)
    assert pressed(sensor, touch, np.zeros(3)).patch is touch.patch  # a point, as the mesh has it
    wide = pressed(sensor, touch, np.array([0.0, 0.0, -40.0]))
    a = contact_radius(sensor, 0.03, 40.0)
    assert a**3 == pytest.approx(0.75 * 40.0 * 0.03 * (1 - 0.45**2) / float(sensor.robot.body.material.young_modulus[0]))
    middle = wide.patch.mean(nodes)
    square = wide.patch.weights @ ((nodes[wide.patch.nodes] - middle) ** 2).sum(axis=1)
    assert square == pytest.approx(0.4 * a**2, rel=0.15)
    assert pressed(sensor, wide, np.array([0.0, 0.0, -41.0])) is wide
