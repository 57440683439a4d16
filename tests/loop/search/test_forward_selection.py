"""Which form of an effect is added."""

from __future__ import annotations

import numpy as np
from arm import arm, record, sweeps

from femsense.loop.improve import improve


def test_one_marker_that_sits_elsewhere_is_named_alone():
    inputs, labels = sweeps(1.5, each=1)
    robot = arm((4, 2, 2))
    recording, _ = record(
        inputs, labels=labels, truth=robot, noise=1e-4, effects=[{"name": "marker_offset", "offset_m": {"m5": [2e-3, 0.0, 1e-3]}}]
    )
    loop = improve(robot, [recording], effects=["marker_offset", "cable_gain", "payload"])
    effect = next(e for e in loop.effects if e.name == "marker_offset")
    assert list(effect.parameters["offset_m"].value) == ["m5"]
    np.testing.assert_allclose(effect.parameters["offset_m"].value["m5"], [2e-3, 0.0, 1e-3], atol=2.5e-4)
