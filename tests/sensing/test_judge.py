"""States that a model does not hold for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from helpers import block_mesh

from femsense.fem.equilibrium import Equilibrium
from femsense.model.contact_patch import ContactPatch
from femsense.sensing.judge import chi_squared, first_to_go, least_stretch, objects_known, seen_elsewhere, unspoken
from femsense.sensing.types import Fit, Rows, Sensor, Touch

MESH = block_mesh((2, 1, 1))


def test_the_stretch_under_a_contact():
    carrying = np.array([0])
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.1, 0.5], carrying) == pytest.approx(0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, -0.5], carrying) == pytest.approx(-0.5)
    assert least_stretch(MESH, MESH.nodes * [1.0, 1.0, 0.5], np.zeros(0, dtype=np.int64)) == 1.0


def fit_of(forces: list[list[float]], sources: list[str]) -> Fit:
    """Return a fit whose forces are known to 0.01 N along each axis."""
    up, patch = np.array([0.0, 0.0, 1.0]), ContactPatch(np.array([0]), np.array([1.0]))
    touches = tuple(Touch(np.zeros(3), up, patch, np.zeros(3), 1e-3, source) for source in sources)
    none = cast(Equilibrium, None)
    covariance = 1e-4 * np.eye(3 * len(forces))
    return Fit(touches, none, np.array(forces), covariance, np.zeros((len(forces), 3, 3)), cast(Rows, none), 1.0)


def test_an_object_that_touches_beside_a_sure_force_stays_in_the_fit_unspoken():
    fit = fit_of([[0.0, 0.0, -0.2], [0.0, 0.0, -0.02]], ["cloud", "cloud"])
    np.testing.assert_allclose(chi_squared(fit), [400.0, 4.0])
    assert [unspoken(fit, i) for i in range(2)] == [False, True]
    assert not unspoken(fit_of([[0.0, 0.0, -0.02], [0.0, 0.0, -0.01]], ["cloud", "cloud"]), 1)  # none is sure
    assert not unspoken(fit_of([[0.0, 0.0, -0.2], [0.0, 0.0, -0.02]], ["cloud", "shape"]), 1)  # no object is seen there


def test_of_contacts_that_may_be_noise_the_one_whose_place_is_known_least_goes_first():
    fit = fit_of([[0.0, 0.0, -0.02], [0.0, 0.0, -0.03], [0.0, 0.0, -0.035]], ["cloud", "cloud", "cloud"])
    places = [replace(touch, std_m=std) for touch, std in zip(fit.touches, (1.8e-3, 6.4e-3, 6.2e-3))]
    assert first_to_go(fit, [0, 1, 2]) == 0  # all are known alike
    assert first_to_go(replace(fit, touches=tuple(places)), [0, 1, 2]) == 1
    assert first_to_go(replace(fit, touches=tuple(places)), [1, 2]) == 1
    assert first_to_go(replace(fit, touches=tuple(places)), [0]) == 0


def test_a_frame_with_a_force_that_is_not_known_is_not_ok():
    sure, weak = (fit_of([[0.0, 0.0, -0.2], [0.0, 0.0, -f]], ["cloud", "cloud"]) for f in (0.15, 0.02))
    assert objects_known(sure, sure.touches) == "ok"
    assert objects_known(weak, weak.touches[:1]) == "ok"  # the other one is scenery
    said = objects_known(weak, weak.touches)
    where = ", ".join(f"{1e3 * x:.0f}" for x in weak.touches[1].place)
    assert said == (
        f"an object may touch whose force is not known, up to 0.04 N at [{where}] mm of the body at rest, beside those that are reported"
    )
    known = replace(weak, covariance=np.diag([1e-4] * 3 + [1e-12] * 3), forces=np.array([[0.0, 0.0, -0.2], [0.0, 0.0, -1e-6]]))
    assert objects_known(known, known.touches) == "ok"  # the shape says that it carries nothing
    none = fit_of([], [])
    assert objects_known(none, ()) == "ok"
    assert "not known: too small" in objects_known(none, sure.touches)
    assert "touch where no contact was found" in objects_known(sure, (), sure.touches[:1])


def test_an_object_that_is_seen_to_touch_beside_a_contact_that_only_the_shape_shows_is_elsewhere():
    """Places are known to 1 mm each; the contact lies at the origin."""
    sensor = cast(Sensor, SimpleNamespace(scenery=np.zeros((0, 3)), size=0.2, surface=SimpleNamespace(edge=2e-3)))
    near, far = (replace(fit_of([[0.0] * 3], ["cloud"]).touches[0], place=np.array([x, 0.0, 0.0])) for x in (0.002, 0.006))
    shape, seen = (fit_of([[0.0, 0.0, -0.2]], [source]) for source in ("shape", "cloud"))
    assert seen_elsewhere(sensor, shape, [near, far]) == [far]
    assert seen_elsewhere(sensor, replace(shape, place_covariance=1e-5 * np.eye(3)[None]), [far]) == []
    assert seen_elsewhere(sensor, seen, [far]) == []
    assert seen_elsewhere(replace_scenery(sensor, far.place), shape, [far]) == []


def replace_scenery(sensor: Sensor, place: np.ndarray) -> Sensor:
    """Return a sensor in whose free frames something seems to touch at a place."""
    return cast(Sensor, SimpleNamespace(scenery=place[None], size=sensor.size, surface=sensor.surface))
