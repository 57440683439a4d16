"""Tests of structure on noise and on patterns."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
from arm import NAMES

from femsense.loop.data.trial import Groups
from femsense.loop.verdict.residual_diagnostics import structure_tests
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline

RNG = np.random.default_rng(11)


def structure_of(values: np.ndarray) -> Mapping[str, float]:
    """Return the p-values for residuals (frames, markers, 3) over four sweeps of different inputs."""
    frames, markers, _ = values.shape
    labels = np.arange(frames) // (frames // 4)
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    recording = make_recording(Timeline(np.arange(frames) * 1.0), drives=Drives(NAMES, RNG.uniform(0.1, 1.0, size=(frames, 4))))
    trial = SimpleNamespace(
        scene=SimpleNamespace(frame=frame, recording=recording, crossings=None),
        groups=Groups(marker, frame, labels[frame], frame),
    )
    return structure_tests([trial], [values.reshape(-1, 3)], rng=np.random.default_rng(0)).tests


def test_noise_alone_has_no_structure_and_a_pattern_has():
    noise = RNG.normal(size=(24, 6, 3))
    assert min(structure_of(noise).values()) > 0.003
    pattern = np.zeros_like(noise)
    pattern[6:12] = 3.0 * RNG.normal(size=(6, 3))
    p = structure_of(noise + pattern)
    assert p["pattern"] <= 0.002
    assert p["sweep"] <= 0.002
