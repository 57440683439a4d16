"""A twin as the reference: what both recordings share drops out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.calib.calibrate import calibrate
from femsense.calib.reference import less_reference
from femsense.core.arrays import freeze
from femsense.core.errors import DataError, InputError
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import with_nuisance
from femsense.loop.improve import ImproveOptions, improve
from femsense.model.recording import Recording, select_frames

SHARED = {"name": "cable_gain", "scale": {"up": 1.5, "left": 1.3}}
WEIGHT = {"name": "tip_mass", "point_m": [0.095, 0.0, 0.0], "mass_kg": 0.004}
INPUTS = np.unique(sweeps(each=2)[0], axis=0)


@cache
def twins() -> tuple[Recording, Recording]:
    """Return recordings without and with a weight; the model lacks the gain of both."""
    truth = arm((6, 2, 2), law="neo_hookean")
    bare, loaded = (
        record(INPUTS, effects=e, noise=1e-4, seed=i, truth=truth)[0] for i, e in enumerate(([SHARED], [SHARED, WEIGHT]))
    )
    return bare, loaded


def test_what_both_share_drops_out_and_what_distinguishes_them_is_left() -> None:
    bare, loaded = twins()
    same, other = less_reference(arm((4, 1, 1)), [bare, loaded], [bare])
    assert calibrate(arm((4, 1, 1)), bare).rms_m > 1e-3
    assert calibrate(arm((4, 1, 1)), same).rms_m < 1e-6
    np.testing.assert_allclose(other.marker_xyz - same.marker_xyz, loaded.marker_xyz - bare.marker_xyz, atol=1e-9)


def test_the_loop_finds_a_weight_in_what_is_left() -> None:
    """The gain that the model lacks moves the arm by more than the weight does."""
    bare, loaded = twins()
    (effect,) = improve(arm((5, 2, 2)), [loaded], effects=["tip_mass"], options=ImproveOptions(references=[bare])).effects
    mass = effect.parameters["mass_kg"]
    assert abs(mass.value - 0.004) < 2.0 * mass.std < 0.0012
    again, _ = record(INPUTS, effects=[SHARED], noise=1e-4, seed=5, truth=arm((6, 2, 2), law="neo_hookean"))
    assert not improve(arm((4, 1, 1)), [again], effects=["tip_mass"], options=ImproveOptions(references=[bare])).effects


def test_beside_a_reference_modulus_and_input_offsets_stay() -> None:
    """What the model misses of the reference holds for those that it was computed with."""
    data = prepare(arm((4, 1, 1)), [twins()[0]], [])
    assert with_nuisance(data)[0].names == ("stiffness", "cable_offset")
    assert with_nuisance(replace(data, relative=True))[0].names == ()


def test_the_nearest_inputs_count_in_whatever_order() -> None:
    bare, loaded = twins()
    order = np.random.default_rng(0).permutation(len(INPUTS))
    mixed = replace(select_frames(bare, np.arange(len(INPUTS))), inputs=freeze(INPUTS[order] + 0.01))
    count = len(bare.marker_names)
    rows = (order[:, None] * count + np.arange(count)).ravel()
    mixed = replace(mixed, marker_xyz=freeze(bare.marker_xyz[rows]))
    one, other = (less_reference(arm((4, 1, 1)), [loaded], [reference])[0] for reference in (bare, mixed))
    np.testing.assert_allclose(one.marker_xyz, other.marker_xyz, atol=3e-4)


def test_frames_with_other_inputs_are_left_out_and_named() -> None:
    bare, loaded = twins()
    some = select_frames(bare, INPUTS[:, 2] == 0.0)
    with pytest.warns(UserWarning, match="frames have inputs that no reference has"):
        (one,) = less_reference(arm((4, 1, 1)), [loaded], [some])
    assert set(one.marker_frame) == set(np.flatnonzero(INPUTS[:, 2] == 0.0))
    far = replace(loaded, inputs=freeze(loaded.inputs + 5.0))
    with pytest.raises(DataError, match="no frame has the inputs of a reference"):
        less_reference(arm((4, 1, 1)), [far], [bare])


def test_noise_counts_twice_and_the_pose_is_that_of_the_reference() -> None:
    bare, loaded = (replace(r, marker_noise_m=1e-4) for r in twins())
    (one,) = less_reference(arm((4, 1, 1)), [loaded], [bare])
    assert one.marker_noise_m == pytest.approx(1.414e-4, rel=1e-3)
    np.testing.assert_allclose(one.T_robot_camera[0], calibrate(arm((4, 1, 1)), bare).T_robot_camera)


def test_what_is_driven_otherwise_or_from_an_unknown_zero_is_refused() -> None:
    bare, loaded = twins()
    with pytest.raises(InputError, match="unknown zero"):
        less_reference(arm((4, 1, 1)), [loaded], [replace(bare, actuation_zero="unknown")])
    with pytest.raises(InputError, match="otherwise than the reference"):
        less_reference(arm((4, 1, 1)), [replace(loaded, actuation="displacement")], [bare])
