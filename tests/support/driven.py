"""A small robot and a recording that drives it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from analytic import bar_body
from helpers import block_mesh

from femsense.fem.mesh import embed_points
from femsense.model.effects import apply_effects
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, LoadRows, Timeline
from femsense.model.robot import Observation, Robot, plain_actuation

MARKERS = np.array([[0.1, 0.015, 0.03], [0.06, 0.0, 0.0], [0.1, 0.03, 0.015]])


def robot(
    effects: Sequence[Mapping[str, Any]] = (), *, gravity: tuple[float, ...] = (0.0, 0.0, -9.81), friction: float = 0.0
) -> Robot:
    body = bar_body(block_mesh((4, 1, 1)), gravity=gravity, friction=friction)
    plain = Robot(
        name="bar",
        body=body,
        marker_names=("a", "b", "c"),
        marker_points=MARKERS,
        markers=embed_points(body.mesh, MARKERS),
        features=np.zeros(0, np.int64),
        color_rgb=None,
        actuation=plain_actuation(2),
        observation=Observation(),
    )
    return apply_effects(plain, effects)


def recording(
    inputs: Sequence[Sequence[float]],
    *,
    actuation: str = "tension",
    zero: str = "absolute",
    time_s: Sequence[float] | None = None,
    gravity: Sequence[Sequence[float]] | None = None,
    loads: LoadRows | None = None,
) -> Recording:
    """Return a recording of the bar of this file, a frame a second where no times are given."""
    times = np.arange(len(inputs), dtype=float) if time_s is None else time_s
    drives = Drives(("top", "side"), inputs, actuation, zero)
    return make_recording(Timeline(times, gravity=gravity), drives=drives, loads=loads)
