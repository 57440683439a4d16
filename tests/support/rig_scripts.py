"""A script of the virtual rig with most of what one may say."""

from __future__ import annotations

from typing import Any

SCRIPT: dict[str, Any] = {
    "format": "femsense-script-1",
    "seed": 3,
    "initial": {"top": 0.25},
    "dt_s": 0.5,
    "sweeps": [
        {"label": "a", "cables": {"top": 2.0}, "rest": 1, "up": 2, "hold": 1, "down": 2},
        {"label": "b", "cables": {"top": 1.0, "side": [0.1, 0.2, 0.3]}, "levels": [0.0, 1.0, 0.5], "dt_s": 2.0},
    ],
    "contacts": [{"sweep": "b", "point_m": [0.1, 0.015, 0.015], "force_n": [0.0, 0.3, 0.1]}],
    "loads": [{"sweep": "a", "point_m": [0.1, 0.015, 0.015], "force_n": [0.0, 0.0, -0.1]}],
    "truth": {"refinements": 0, "element": "tet4", "law": "corotational", "substeps": 1},
    "camera": {"width": 64, "height": 48, "fx": 60.0, "eye_m": [0.05, -0.3, 0.1], "target_m": [0.05, 0.0, 0.0]},
}
