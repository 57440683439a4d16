"""What closing the loop returns, and the plain tables of loop.json."""

from __future__ import annotations

from femsense.loop.result.loop_result import EFFECTS, NONE, UNEXPLAINED, LoopResult

__all__ = ["EFFECTS", "NONE", "UNEXPLAINED", "LoopResult"]
