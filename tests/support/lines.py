"""Descriptions of bodies along a line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from femsense.io.files import write_toml

SILICONE = {"young_modulus_pa": 200e3, "poisson_ratio": 0.3, "density_kg_m3": 1000.0}


def description(*sections: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return a description of a body from sections, whose places lie 100 mm apart along −z where they are not given."""
    places = [{"at_mm": [0.0, 0.0, -100.0 * i]} | dict(section) for i, section in enumerate(sections)]
    return {"format": "femsense-line-1", "name": "body", "material": SILICONE, "sections": places} | more


def written(folder: Path, *sections: Mapping[str, Any], **more: Any) -> Path:
    """Write a description and return its path."""
    write_toml(folder / "body.toml", description(*sections, **more))
    return folder / "body.toml"
