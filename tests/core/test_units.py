"""Names of units: any case where that is unambiguous, absolute and gauge pressures, what is refused."""

from __future__ import annotations

import pytest

from femsense.core.errors import InputError
from femsense.core.units import ATMOSPHERE_PA, Quantity, length_unit, likely_units, unit_named


@pytest.mark.parametrize(
    ("text", "quantity", "size", "zero"),
    [
        ("KPA", Quantity.PRESSURE, 1e3, 0.0),
        ("[mbar]", Quantity.PRESSURE, 1e2, 0.0),
        ("mpa", Quantity.PRESSURE, 1e6, 0.0),
        ("N/mm²", Quantity.PRESSURE, 1e6, 0.0),
        ("bar(g)", Quantity.PRESSURE, 1e5, 0.0),
        ("barA", Quantity.PRESSURE, 1e5, -ATMOSPHERE_PA),
        ("kPa abs", Quantity.PRESSURE, 1e3, -ATMOSPHERE_PA),
        ("Pa", Quantity.PRESSURE, 1.0, 0.0),
        ("mn", Quantity.FORCE, 1e-3, 0.0),
        ("kgf", Quantity.FORCE, 9.80665, 0.0),
        ("Millimeters", Quantity.LENGTH, 1e-3, 0.0),
        ("μm", Quantity.LENGTH, 1e-6, 0.0),
        ("MS", Quantity.TIME, 1e-3, 0.0),
        ("mA", Quantity.CURRENT, 1e-3, 0.0),
        ("ticks", Quantity.COUNT, 1.0, 0.0),
    ],
)
def test_names_in_any_case(text: str, quantity: Quantity, size: float, zero: float) -> None:
    unit = unit_named(text)
    assert unit is not None and (unit.quantity, unit.zero) == (quantity, zero)
    assert unit.size == pytest.approx(size)


@pytest.mark.parametrize("text", ["mPa", "MN"])
def test_a_case_that_is_a_million_apart_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="two ways"):
        unit_named(text)


@pytest.mark.parametrize("text", ["", "x", "north", "bend"])
def test_what_is_no_unit(text: str) -> None:
    assert unit_named(text) is None


def test_lengths_that_are_allowed() -> None:
    assert length_unit("MM", allowed=("m", "mm")) is not None
    assert length_unit("inch", allowed=("m", "mm")) is None and length_unit("kPa") is None


def test_the_unit_that_makes_a_reading_plausible_comes_first() -> None:
    assert likely_units(1.2, 2e3, 5e6, Quantity.PRESSURE)[0].name == "bar"
    assert likely_units(120.0, 2e3, 5e6, Quantity.PRESSURE)[0].name == "kPa"
