"""The fixed tuning set of the ablation: cheap robots, with truths on other meshes, as of `loop_cases`,
and what real recordings have besides.

Beside the kinds of `loop_cases` there are: an effect outside the list next to one inside (`beside`),
an error of the model of 5 % of the motion that has no name (`no_name`), two recordings with cameras of their own (`sessions`),
and tensions that are commanded, not measured (`commanded`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from loop_cases import DISPLACEMENT_EFFECTS, OUTSIDE, TENSION_EFFECTS, Case, Design, hidden_effect, make_data

from femsense.core.arrays import FloatArray
from femsense.model.recording import Recording
from femsense.model.robot import Robot

SEED = 441
ROUND = ("null", "single", "single", "two", "single", "outside", "null", "single", "no_name", "beside")
"""Kinds, in the order of the set: each part of it holds some of every kind."""
OTHERS = {"no_name": ("no_name", "commanded", "sessions"), "beside": ("beside", "beside", "beside")}
"""What takes the place of a kind in turn."""


def _stick(p: FloatArray) -> FloatArray:
    return np.column_stack([0.09 * p[:, 0], 0.008 * p[:, 1:]])


def _wedge(p: FloatArray) -> FloatArray:
    return np.column_stack([0.10 * p[:, 0], 0.009 * p[:, 1], (0.010 - 0.003 * p[:, 0]) * p[:, 2]])


STICK = Design(
    "stick",
    (7, 1, 1),
    (10, 2, 2),
    _stick,
    {
        "a": ([[0.086, 0.005, 0.0], [0.045, 0.005, 0.0]], [-0.01, 0.008, 0.0]),
        "b": ([[0.086, -0.003, 0.004], [0.045, -0.003, 0.004]], [-0.01, -0.005, 0.007]),
    },
    (0.1, 0.55, 0.98),
    300e3,
    1.2,
)
WEDGE = Design(
    "wedge",
    (8, 1, 1),
    (11, 2, 2),
    _wedge,
    {
        "up": ([[0.095, 0.0, 0.004], [0.05, 0.0, 0.005]], [-0.01, 0.0, 0.009]),
        "down": ([[0.095, 0.0, -0.004], [0.05, 0.0, -0.005]], [-0.01, 0.0, -0.009]),
    },
    (0.1, 0.5, 0.97),
    250e3,
    1.5,
)


@dataclass(frozen=True)
class Problem:
    """A case as the loop is asked it."""

    case: Case
    declared: Robot
    recordings: tuple[Recording, ...]


def tuning_cases(count: int = 200) -> list[Case]:
    """Return the first so many cases of the set."""
    return [_case(i) for i in range(count)]


def _case(number: int) -> Case:
    rng = np.random.default_rng([SEED, number])
    kind, turn = ROUND[number % len(ROUND)], number // len(ROUND)
    kind = OTHERS[kind][turn % 3] if kind in OTHERS else kind
    control = "displacement" if turn % 3 == 2 and kind not in ("commanded",) else "tension"
    design = (STICK, WEDGE)[int(rng.integers(2))]
    names = TENSION_EFFECTS if control == "tension" else DISPLACEMENT_EFFECTS
    names = tuple(n for n in names if kind == "single" or n not in ("gravity", "marker_offset"))
    hidden: Sequence[str] = ()
    if kind in ("single", "beside", "sessions"):
        hidden = (names[(7 * number + 3 * turn) % len(names)],)
    if kind == "commanded" and turn % 2:
        hidden = (str(rng.choice(names)),)
    if kind == "two":
        hidden = [str(n) for n in rng.choice(names, 2, replace=False)]
    options = [o for o in OUTSIDE if o not in ("late_log",)]
    outside = str(rng.choice(options)) if kind in ("outside", "beside") else kind if kind in ("no_name", "commanded") else ""
    return Case(
        number,
        kind,
        design,
        control,
        float(rng.choice([5e-5, 1.5e-4])),
        tuple(hidden_effect(name, design, control, rng) for name in hidden),
        outside,
        float(rng.uniform(0.7, 1.5)) if kind != "no_name" else 1.0,
        bool(rng.random() < 0.5) and "marker_offset" not in hidden,
        hyperelastic="hyperelastic" in hidden or bool(rng.random() < 0.5),
        declared_gravity="gravity" not in hidden,
        modulus_scale=float(rng.uniform(0.8, 1.2)),
    )


def make_problem(case: Case) -> Problem:
    """Return a case with its recordings. Raises FemsenseError where its truth does not stand."""
    made = make_data(case, SEED)
    if case.kind != "sessions":
        return Problem(case, made.declared, (made.recording,))
    other = make_data(replace(case, number=case.number + 10_000), SEED)
    return Problem(case, made.declared, (made.recording, other.recording))
