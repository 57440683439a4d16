"""The safety gate between targets and robot commands: arming, hold-to-run, rate and range limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from femsense.xr.stream.payloads import Input


@dataclass(frozen=True, slots=True)
class GateOptions:
    """Limits of the commands that a `CommandGate` sends."""

    allowed: bool = False
    """Whether commands are sent at all."""
    hold_s: float = 0.25
    """Commands end when no wish has come for so long: who drags must hold on."""
    range_per_s: float = 0.25
    """An input moves by this share of its range a second at most."""
    command_hz: float = 50.0
    """Interval of the commands [s]. A late command moves no farther: missed intervals are not made up for."""


class CommandGate:
    """Moves inputs towards their targets, slowly, within their ranges, and only while an armed client holds on."""

    def __init__(self, inputs: Sequence[Input], options: GateOptions | None = None) -> None:
        self.inputs, self.options = tuple(inputs), options or GateOptions()
        self.commanded: dict[str, float] = {}
        """The last command; empty while nothing is commanded."""
        self.last: dict[str, float] = {}
        """The last command, also after motion has stopped: a stopped robot stays there. Empty before the first command."""
        self.turn = 0
        """Number of releases: a target computed before a release is not valid after it."""
        self._wanted: dict[str, float] = {}
        self._held_at = self._moved_at = float("-inf")

    def hold(self, now: float, *, armed: bool) -> None:
        """Take note that someone holds on at a time [s], armed or not."""
        if armed and self.options.allowed:
            self._held_at = now
        else:
            self.release()

    def want(self, inputs: Mapping[str, float], *, turn: int | None = None) -> None:
        """Set the target of the inputs, unless it was computed before the last release."""
        if turn in (None, self.turn):
            self._wanted = dict(inputs)

    def release(self) -> None:
        """Stop all motion immediately."""
        self._held_at = float("-inf")
        self._wanted = {}
        self.turn += 1

    @property
    def moving(self) -> bool:
        """Whether commands go out."""
        return bool(self.commanded)

    @property
    def arrived(self) -> bool:
        """Whether the commanded inputs have reached their targets."""
        near = 1e-3
        return self.moving and all(
            abs(self.commanded[one.name] - _within(one, self._wanted.get(one.name, self.commanded[one.name])))
            <= near * (one.high - one.low)
            for one in self.inputs
        )

    def step(self, now: float, current: Mapping[str, float]) -> dict[str, float] | None:
        """Return the inputs to command at a time [s], or None if no command is allowed.

        Arguments:
            now: the time [s].
            current: inputs reported by the robot; commands begin there, so that there is no jump. Inputs that it does not report
                begin at their last command, however old.
        """
        held = now - self._held_at <= self.options.hold_s
        if not held:
            self.commanded = {}
        if not held or not self._wanted:
            return None
        if not self.commanded:
            last = self.last
            self.commanded = {one.name: _within(one, current.get(one.name, last.get(one.name, one.low))) for one in self.inputs}
            self._moved_at = now
        elapsed = min(now - self._moved_at, 1.0 / self.options.command_hz)
        self._moved_at = now
        for one in self.inputs:
            step = self.options.range_per_s * (one.high - one.low) * elapsed
            here = self.commanded[one.name]
            there = _within(one, self._wanted.get(one.name, here))
            self.commanded[one.name] = min(max(there, here - step), here + step)
        self.last = dict(self.commanded)
        return dict(self.commanded)


def _within(one: Input, value: float) -> float:
    return min(max(value, one.low), one.high)
