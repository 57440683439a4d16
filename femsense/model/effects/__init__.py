"""Effects: what a plain model may lack, by name. One tuple of them; robot.toml and loop.json use the same names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from femsense.core.errors import InputError
from femsense.model.effects.along import REST_SHAPE, STIFFNESS_GRADIENT
from femsense.model.effects.base import Alias, Calibrated, Effect, Entry, Experiment, InRecording, Parameter, build_entry
from femsense.model.effects.cable_path import CABLE_PATH
from femsense.model.effects.cables import CABLE_FRICTION, CABLE_FRICTIONS, CABLE_GAIN, CABLE_OFFSET, CABLE_SLACK, CABLE_STRETCH
from femsense.model.effects.chambers import CHAMBER_GAIN, CHAMBER_OFFSET
from femsense.model.effects.coupling import CABLE_COUPLING
from femsense.model.effects.loads import GRAVITY, PAYLOAD
from femsense.model.effects.material import CREEP, CREEP_TWICE, GENT, HYPERELASTIC, POISSON, SOFT_REGION, STIFFNESS
from femsense.model.effects.observation import CLAMPED_MARKER, DEPTH_SCALE, MARKER_OFFSET
from femsense.model.effects.per_recording import PER, by_session, checked, forms_by_recording, per_recording
from femsense.model.effects.shape import DISCRETISATION, GEOMETRY
from femsense.model.effects.softening import SOFTENING
from femsense.model.effects.support import BASE_COMPLIANCE, BASE_ROTATION
from femsense.model.effects.user_defined import find_own_file, load_own_effect, try_own_effect
from femsense.model.effects.weight import DENSITY, TIP_MASS
from femsense.model.robot import Robot

EFFECTS: tuple[Effect, ...] = (
    GRAVITY,
    STIFFNESS,
    POISSON,
    SOFT_REGION,
    DISCRETISATION,
    HYPERELASTIC,
    CREEP,
    PAYLOAD,
    BASE_COMPLIANCE,
    CABLE_FRICTION,
    CABLE_OFFSET,
    CABLE_GAIN,
    CABLE_STRETCH,
    CABLE_SLACK,
    GEOMETRY,
    DEPTH_SCALE,
    MARKER_OFFSET,
    CLAMPED_MARKER,
    DENSITY,
    TIP_MASS,
    CHAMBER_OFFSET,
    CHAMBER_GAIN,
    CABLE_PATH,
    STIFFNESS_GRADIENT,
    REST_SHAPE,
    CABLE_COUPLING,
    SOFTENING,
)
"""Each name once."""
FORMS: tuple[Effect, ...] = (*EFFECTS, GENT, CREEP_TWICE, BASE_ROTATION, CABLE_FRICTIONS)
"""Every way in which an effect can be fitted: some have further parameters, under the same name."""
EFFECT_NAMES: tuple[str, ...] = tuple(effect.name for effect in EFFECTS)
CALIBRATED: tuple[str, ...] = tuple(effect.name for effect in EFFECTS if effect.calibrated is not None)
"""Effects that are fitted along with everything: those of the inputs, and those of the body."""
OF_INPUTS: tuple[str, ...] = tuple(
    effect.name for effect in EFFECTS if effect.calibrated is not None and effect.calibrated.of_inputs
)
OF_BODY: tuple[str, ...] = tuple(name for name in CALIBRATED if name not in OF_INPUTS)


def find_effect(name: str) -> Effect:
    """Return the built-in effect with this name.

    Raises:
        InputError: no effect has this name; the most similar name is suggested.

    Example:
        >>> import femsense as fs
        >>> fs.find_effect("cable_friction").lacks
        'loss where a cable bends or rubs; depends on the direction of motion'
    """
    for effect in EFFECTS:
        if effect.name == name:
            return effect
    near = get_close_matches(name, EFFECT_NAMES, 1)
    raise InputError(
        "unknown effect",
        where="effects.name",
        found=name,
        expected=", ".join(EFFECT_NAMES),
        hint=f"did you mean {near[0]}?" if near else "an effect of your own comes with its file (femsense docs own)",
    )


def apply_effects(robot: Robot, entries: Sequence[Mapping[str, Any]]) -> Robot:
    """Return a robot with effects added, in the order given.

    Arguments:
        robot: the robot; it does not change.
        entries: list of dicts, each with `name` and the parameters of an effect, as in the tables `[[effects]]` of robot.toml (docs/effects).

    Returns:
        a new robot; its `body` has the changed properties.

    Raises:
        InputError: an unknown effect or parameter, or a value out of its bounds.

    Example:
        >>> import femsense as fs
        >>> soft = fs.apply_effects(fs.load_robot("finger"), [{"name": "stiffness", "scale": 0.8}])
        >>> round(float(soft.body.material.young_modulus.max()) / 1e6, 2)  # MPa; 1.2 as declared
        0.96
    """
    for entry in entries:
        rest = {key: value for key, value in entry.items() if key != "name"}
        effect = find_effect(str(entry.get("name"))) if "file" not in entry else _own(entry, robot)
        keys = (*effect.keys, PER) if effect.may_differ else effect.keys
        unknown = sorted(set(rest) - set(keys))
        if unknown:
            raise InputError("unknown key", where=f"effects.{effect.name}", found=unknown[0], expected=", ".join(keys))
        robot = effect.apply(robot, rest) if PER not in rest else checked(per_recording(effect).apply(robot, rest), rest)
    return robot


def _own(entry: Mapping[str, Any], robot: Robot) -> Effect:
    """Return the effect of an entry with `file`. Raises InputError."""
    file = find_own_file(entry, robot)
    effect = load_own_effect(file)
    if effect.name != entry.get("name"):
        raise InputError("the file holds another effect", where=f"{file}: name", found=effect.name, expected=entry.get("name"))
    return effect


__all__ = [
    "CALIBRATED",
    "EFFECTS",
    "EFFECT_NAMES",
    "FORMS",
    "OF_BODY",
    "OF_INPUTS",
    "Alias",
    "Calibrated",
    "Effect",
    "Entry",
    "Experiment",
    "InRecording",
    "Parameter",
    "apply_effects",
    "build_entry",
    "by_session",
    "find_effect",
    "forms_by_recording",
    "load_own_effect",
    "per_recording",
    "try_own_effect",
]
