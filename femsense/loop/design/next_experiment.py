"""The proposed next recording, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import heads_of
from femsense.loop.design.advice import next_element
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import ConfoundedPair, Untestable
from femsense.model.effects import Effect, Experiment
from femsense.model.recording import Recording


def next_experiment(
    data: Data, final: FittedModel, noise: Noise, confounded: Sequence[ConfoundedPair], not_testable: Sequence[Untestable]
) -> str:
    """Return recordings that distinguish the confounded effects, in words: by prediction if that is cheap, otherwise by rules."""
    pairs = [pair.pair for pair in confounded]
    predicted = next_element(data, final.fit, noise, pairs, [effect.name for effect in not_testable])
    if predicted:
        said = [
            f"{words} (would {what}: evidence {round(before)} → {round(after)}, threshold {data.thresholds.evidence:.0f})"
            for words, what, before, after in predicted[:2]
        ]
        loaded = any(len(t.scene.recording.load_frame) for t in data.train)
        said = [*([] if loaded else _against_aliases(data.forms, pairs)), *said]
        return "; or ".join(said)
    names = {name for pair in pairs for name in pair} | {effect.name for effect in not_testable}
    wanted = {effect.told_by for effect in data.forms if effect.name in names}
    recordings = [data.train[i].scene.recording for i in heads_of(data.train)]
    said = [_in_words(experiment, data, recordings) for experiment in Experiment if experiment in wanted]
    return "; ".join(text for text in said if text)


def _against_aliases(forms: Sequence[Effect], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Return the experiments that distinguish effects that are always collinear, once each, for the pairs in question."""
    told = {alias.told_by: {form.name, alias.name} for form in forms for alias in form.aliases if alias.told_by}
    return [words for words, pair in told.items() if any(set(p) == pair for p in pairs)]


def _in_words(experiment: Experiment, data: Data, recordings: Sequence[Recording]) -> str:
    """Return an experiment in words, without parts already recorded; empty if it is not possible."""
    if experiment is Experiment.TURN_THE_BASE:
        return "turn the base by 90° between frames, camera fixed (gravity_*_m_s2 in frames.csv): weight then changes direction and the pose does not"
    if experiment is Experiment.LOAD_UNLOAD_AND_HOLD and any(_goes_up_and_down(r) for r in recordings):
        return "hold for a minute at two levels, and repeat a sweep at another speed"
    if experiment is Experiment.LOAD_UNLOAD_AND_HOLD:
        return "go up and down at several levels, and hold for a minute"
    if experiment is Experiment.KNOWN_WEIGHT:
        return "hang a known weight on the robot in some frames (loads.csv)"
    if experiment is Experiment.MORE_MARKERS:
        return "add markers on opposite faces and close to the clamp, and pull opposite cables together"
    if not len(data.declared.marker_points):
        return ""
    rest = any(r.rest is not None for r in recordings)
    return "move the camera in depth" if rest else "record rest.csv: the unloaded body, and move the camera in depth"


def _goes_up_and_down(recording: Recording) -> bool:
    steps = np.diff(recording.inputs, axis=0)
    return bool(steps.max(initial=0.0) > 0 and steps.min(initial=0.0) < 0)
