"""Effects of transmission and observation whose values differ from recording to recording (`per = "recording"`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.model.effects.base import Effect, Entry, InRecording, Parameter
from femsense.model.recording import Recording
from femsense.model.robot import Robot

PER, RECORDING = "per", "recording"
"""Its key and value in robot.toml."""


@dataclass(frozen=True, slots=True)
class ByRecording:
    """An effect that a robot has with other values in each recording: (robot, label) → the robot there."""

    effect: Effect
    """With one set of values."""
    entry: Entry
    """Each value a table label → value."""

    def __call__(self, robot: Robot, label: str) -> Robot:
        return self.effect.apply(robot, entry_in(self.entry, label, owners_of(robot)))


def owners_of(robot: Robot) -> frozenset[str]:
    """Return the names that are allowed between a key and its values: cables, chambers and markers."""
    return frozenset((*robot.body.cable_names, *robot.body.chamber_names, *robot.marker_names))


def entry_in(entry: Entry, label: str, owners: frozenset[str]) -> Entry:
    """Return an entry as it is in one recording: of each table label → value that value, of an unknown label the mean of all.

    Arguments:
        entry: with `per = "recording"`.
        label: of a recording (`Recording.label`).
        owners: names of cables, chambers and markers: a table of these holds a value, or a table label → value, for each.
    """
    return {key: _value_in(value, label, owners, key) for key, value in entry.items() if key != PER}


def _value_in(value: Any, label: str, owners: frozenset[str], key: str) -> Any:
    if not isinstance(value, Mapping):
        return value
    if owners.issuperset(value):
        return {name: _value_in(own, label, frozenset(), key) for name, own in value.items()}
    if label in value:
        return value[label]
    try:
        mean = np.mean([np.asarray(v, dtype=float) for v in value.values()], axis=0)
    except (TypeError, ValueError):
        found, expected = dict(value), "recording → value, or name → recording → value"
        raise InputError("not a table of values", where=key, found=found, expected=expected) from None
    return mean.tolist()


@lru_cache(maxsize=64)
def per_recording(effect: Effect, labels: tuple[str, ...] = ()) -> Effect:
    """Return the form of an effect with separate values for recordings with these labels.
    Raises InputError where it has none.

    Forms are cached, so that the same arguments give the same object.
    """
    if not effect.may_differ:
        raise InputError(
            "the values of this effect do not differ from recording to recording",
            where=f"effects.{effect.name}.{PER}",
            expected="an effect of transmission or observation: " + ", ".join(("cable_*", "chamber_*", "depth_*", "marker_*")),
        )
    return replace(
        effect,
        parameters=partial(_parameters, effect, labels),
        apply=partial(_apply, effect),
        seeds=lambda robot: tuple({**seed, PER: RECORDING} for seed in effect.seeds(robot)),
        polish=lambda robot, control, seed: (),
        nearby=lambda robot, seed: (),
        aliases=(),
        planned=lambda robot: (),
    )


def _parameters(effect: Effect, labels: tuple[str, ...], robot: Robot, control: str) -> tuple[Parameter, ...]:
    parts = [(p, p.part) for p in effect.parameters(robot, control) if not isinstance(p.part, InRecording)]
    return tuple(replace(p, part=InRecording(part, label, labels)) for label in labels for p, part in parts)


def _alike(effect: Effect, labels: tuple[str, ...], robot: Robot, control: str) -> tuple[Parameter, ...]:
    """Return a scale that all cables or chambers have in common in each recording; none where an effect has no scale of each."""
    scales = [p for p in effect.parameters(robot, control) if isinstance(p.part, str) and p.scale == "log"]
    return tuple(replace(p, part=InRecording(None, label, labels)) for label in labels for p in scales[:1] if len(scales) > 1)


def _apply(effect: Effect, robot: Robot, entry: Entry) -> Robot:
    if entry.get(PER) != RECORDING:
        raise InputError("unknown value", where=f"{effect.name}.{PER}", found=entry.get(PER), expected=f'"{RECORDING}"')
    return replace(robot, by_recording=(*robot.by_recording, ByRecording(effect, dict(entry))))


def checked(robot: Robot, entry: Entry) -> Robot:
    """Return a robot with an entry of robot.toml once its values in every recording that it names have been tried.

    Raises InputError.
    """
    for label in ("", *_labels(entry.values(), owners_of(robot))):
        robot.in_recording(label)
    return robot


def _labels(values: Iterable[Any], owners: frozenset[str]) -> set[str]:
    """Return the labels of recordings in the tables of an entry."""
    tables = [v for v in values if isinstance(v, Mapping)]
    return {
        label
        for table in tables
        for label in (_labels(table.values(), frozenset()) if owners.issuperset(table) else {str(key) for key in table})
    }


def forms_by_recording(forms: Iterable[Effect], recordings: Sequence[Recording]) -> tuple[Effect, ...]:
    """Return the forms of effects whose values differ between recordings that were not made in one session;
    none where all were."""
    labels = tuple(dict.fromkeys(r.label for r in recordings))
    if len(labels) < 2 or "" in labels:
        return ()
    sought = [form for form in forms if form.may_differ and form.sought_by_recording]
    return (*(per_recording(form, labels) for form in sought), *(alike_per_recording(form, labels) for form in sought))


@lru_cache(maxsize=64)
def alike_per_recording(effect: Effect, labels: tuple[str, ...]) -> Effect:
    """Return the form of an effect in which all cables, or all chambers, have the same scale, another one in each recording."""
    return replace(per_recording(effect, labels), parameters=partial(_alike, effect, labels))


def by_session(effect: Effect, recordings: Sequence[Recording]) -> tuple[Effect, Entry]:
    """Return an effect that is fitted along with everything, and its seed:
    with values of its own in each session where several are declared."""
    sessions = tuple(dict.fromkeys(r.session for r in recordings))
    labels = tuple(s for s in sessions if s is not None)
    if not effect.may_differ or len(labels) < 2 or len(labels) < len(sessions):
        return effect, {}
    return per_recording(effect, labels), {PER: RECORDING}
