"""Closing the loop: from the residual of measured data to a named effect and a better model."""

from __future__ import annotations

from femsense.loop.improve import improve
from femsense.loop.result import LoopResult

__all__ = ["LoopResult", "improve"]
