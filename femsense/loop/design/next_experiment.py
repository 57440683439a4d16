"""What to record next, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import heads_of
from femsense.loop.design.advice import next_element
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise


def next_experiment(
    data: Data, final: FittedModel, noise: Noise, rivals: Sequence[dict[str, Any]], not_testable: Sequence[dict[str, Any]]
) -> str:
    """Return in words what to record to tell apart what these data cannot: as predicted where that is cheap, else by rule."""
    pairs = [(r["pair"][0], r["pair"][1]) for r in rivals]
    predicted = next_element(data, final.fit, noise, pairs, [r["name"] for r in not_testable])
    if predicted:
        said = [
            f"{words} ({what}: expected dBIC {round(before)} → {round(after)})" for words, what, before, after in predicted[:2]
        ]
        loaded = any(len(t.scene.recording.load_frame) for t in data.train)
        if not loaded and any(set(pair) == {"stiffness", "cable_gain"} for pair in pairs):
            said.insert(
                0,
                "hang a known weight on the robot in some frames (loads.csv): a modulus answers to it, a gain of all cables does not",
            )
        return "; or ".join(said)
    names = {n for r in rivals for n in r["pair"]} | {r["name"] for r in not_testable}
    advice = []
    recordings = [data.train[i].scene.recording for i in heads_of(data.train)]
    unloading = any(
        len(r.inputs) > 1
        and (np.diff(r.inputs, axis=0).max(initial=0.0) > 0)
        and (np.diff(r.inputs, axis=0).min(initial=0.0) < 0)
        for r in recordings
    )
    if names & {"gravity", "payload"}:
        advice.append(
            "turn the base by 90° between frames, camera fixed (gravity_*_m_s2 in frames.csv): weight then changes direction and the pose does not"
        )
    if names & {"cable_friction", "creep", "cable_slack"}:
        advice.append(
            "go up and down at several levels, and hold for a minute"
            if not unloading
            else "hold for a minute at two levels, and repeat a sweep at another speed"
        )
    if names & {"cable_gain", "cable_offset", "stiffness", "cable_stretch"}:
        advice.append("hang a known weight on the robot in some frames (loads.csv)")
    if names & {"poisson", "soft_region", "base_compliance", "hyperelastic"}:
        advice.append("add markers on opposite faces and close to the clamp, and pull opposite cables together")
    if names & {"depth_scale", "marker_offset"} and len(data.declared.marker_points):
        rest = any(r.rest is not None for r in recordings)
        advice.append("move the camera in depth" if rest else "record rest.csv: the unloaded body, and move the camera in depth")
    return "; ".join(advice)
