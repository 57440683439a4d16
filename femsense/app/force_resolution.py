"""The forces that a recording's camera resolves on a robot, reported by `inspect`, `calibrate` and `estimate`."""

from __future__ import annotations

from typing import Any

from femsense.calib.calibration import Calibration
from femsense.core.errors import FemsenseError
from femsense.core.text import one_line
from femsense.model.recording import Recording
from femsense.model.robot import Robot


def force_resolution(robot: Robot, recording: Recording, calibration: Calibration) -> tuple[dict[str, Any], str]:
    """Return the result of `recorded_forces` as plain tables and as text; the reason, if there is none.

    An unknown resolution does not make a command fail."""
    from femsense.rig.recorded_forces import recorded_forces, resolution_document, resolution_text

    try:
        found = recorded_forces(robot, recording, calibration)
    except FemsenseError as error:
        return unknown_resolution(one_line(error))
    return resolution_document(found), resolution_text(found)


def unknown_resolution(reason: str) -> tuple[dict[str, Any], str]:
    """Return the result where the forces are not known, for a reason."""
    return {"unknown": reason}, f"forces that this camera resolves: not known. {reason}"
