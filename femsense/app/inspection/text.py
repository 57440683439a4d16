"""Reports as aligned plain text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from femsense.report.text import columns


def section_text(items: Mapping[str, Any]) -> list[str]:
    """Return lines of aligned labels and values."""
    return section_lines(items, 2)


UNITS = {
    "kg_m3": "kg/m³",
    "m_s2": "m/s²",
    "cm3": "cm³",
    "cm2": "cm²",
    "kpa": "kPa",
    "mm": "mm",
    "hz": "1/s",
    "deg": "°",
    "pa": "Pa",
    "n": "N",
    "g": "g",
    "s": "s",
    "m": "m",
}


def section_lines(items: Mapping[str, Any], indent: int) -> list[str]:
    """Return lines of aligned labels and values; tables and nested sections below their label."""
    shown = {key: value for key, value in items.items() if value is not None and value != [] and value != {}}
    width = max((len(_label(key)) for key, value in shown.items() if not _nested(value)), default=0)
    lines: list[str] = []
    for key, value in shown.items():
        if isinstance(value, Mapping):
            lines += [" " * indent + _label(key), *section_lines(value, indent + 2)]
        elif _nested(value):
            lines += [" " * indent + _label(key), *_grid(value, indent + 2)]
        else:
            lines.append(" " * indent + f"{_label(key):<{width}}  {_value(key, value)}")
    return lines


def _nested(value: Any) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping | list))


def _grid(rows: Sequence[Any], indent: int) -> list[str]:
    """Return a table of mappings, or the rows of a matrix, as aligned lines."""
    if not isinstance(rows[0], Mapping):
        return [" " * indent + _value("", row) for row in rows]
    keys = [key for key in rows[0] if any(row.get(key) is not None for row in rows)]
    cells = [[_label(key) for key in keys]] + [[_value(key, row.get(key)) for key in keys] for row in rows]
    return columns(cells, indent=indent).splitlines()


def _label(key: str) -> str:
    for ending, unit in UNITS.items():
        if key.endswith("_" + ending):
            return f"{key.removesuffix('_' + ending).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


def _value(key: str, value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key.endswith("share"):
        return f"{100.0 * value:.1f} %"
    if isinstance(value, float):
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_value("", item) for item in value)
    return str(value)


def bullet(text: str) -> str:
    """Return a text as an item of a list, further lines indented."""
    first, *rest = text.splitlines()
    return "\n".join([f"  - {first}", *(f"  {line}" for line in rest)])
