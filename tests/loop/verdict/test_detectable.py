"""The smallest size of an effect that would have been seen, in the unit of its parameter."""

from __future__ import annotations

import numpy as np
import pytest
from arm import arm

from femsense.loop.search.screening import Candidate
from femsense.loop.verdict.summary import detectable
from femsense.model.effects import find_effect

ROBOT = arm((3, 1, 1))


def screened(name: str, smallest: float) -> Candidate:
    """Return a screened effect of which this size, in the coordinate of the fit, would just have been seen."""
    effect = find_effect(name)
    parameters, none = effect.parameters(ROBOT, "tension"), np.zeros((0, 0))
    sizes = np.full(len(parameters), smallest)
    return Candidate(effect, {"name": name}, tuple(parameters), [], [], none, none, 1.0, sizes, 0.0, 0.0, 0.0, sizes)


@pytest.mark.parametrize(
    ("name", "kind", "size"),
    [
        ("stiffness", "factor", np.exp(0.2)),  # its coordinate is the logarithm of the scale
        ("base_compliance", "softer_than", 1 / 0.2),  # the compliance of a spring, told as its stiffness
        ("gravity", "change", 0.2),
    ],
)
def test_a_size_is_told_as_its_parameter_is_meant(name: str, kind: str, size: float) -> None:
    found = detectable([screened(name, 0.2)], set())[name]
    assert found.kind == kind
    assert found.smallest and all(told == pytest.approx(size) for told in found.smallest.values())


def test_what_was_found_is_not_told_and_what_cannot_be_seen_has_no_size() -> None:
    table = [screened("stiffness", np.inf), screened("gravity", 0.2)]
    told = detectable(table, {"gravity"})
    assert list(told) == ["stiffness"]
    assert set(told["stiffness"].smallest.values()) == {None} and not told["stiffness"].would_be_seen
