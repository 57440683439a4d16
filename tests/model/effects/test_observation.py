"""Effects between the body and the measured points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from arm import T_ROBOT_CAMERA, arm, record, sweeps

from femsense.model.effects import find_effect
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene

RNG = np.random.default_rng(11)


def test_a_scale_of_depth_neither_shrinks_the_noise_nor_holds_it_in_its_columns():
    inputs, labels = sweeps(each=1)
    robot = arm((4, 2, 2))
    effect = find_effect("depth_scale")
    hypothesis = Hypothesis(robot, ((effect, {}, effect.parameters(robot, "tension")),))
    scene = make_scene(robot, record(inputs, labels=labels, truth=robot, noise=0.0)[0], np.arange(3))
    noise = 3e-3 * RNG.normal(size=scene.points.shape)
    jets = [
        evaluate_scene(
            hypothesis,
            replace(scene, points=1.1 * scene.points + n),
            np.array([np.log(1.1), 0.0]),
            [T_ROBOT_CAMERA],
            None,
            derivative=True,
            vary_initial=False,
            pivot=robot.marker_points.mean(axis=0),
        )
        for n in (0.0, noise)
    ]
    np.testing.assert_allclose(jets[0].residual, 0.0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(jets[1].residual, axis=1), np.linalg.norm(noise, axis=1), rtol=1e-4)
    np.testing.assert_allclose(jets[0].by_effect, jets[1].by_effect, atol=1e-6)
