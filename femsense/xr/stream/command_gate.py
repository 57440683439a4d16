"""What stands between a wish and a robot: armed or not, held or not, how fast, how far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from femsense.xr.stream.payloads import Input


@dataclass(frozen=True, slots=True)
class GateOptions:
    """How commands may go out."""

    allowed: bool = False
    """Whether any command goes out at all."""
    hold_s: float = 0.25
    """Commands end when no wish has come for so long: who drags must hold on."""
    range_per_s: float = 0.25
    """An input moves by this share of its range a second at most."""
    command_hz: float = 50.0
    """How often commands go out. A command that comes later moves no farther: what a thread has missed is not made up for at once."""


class CommandGate:
    """Lets inputs move towards what is wanted, slowly, within their ranges, and only while someone armed holds on."""

    def __init__(self, inputs: Sequence[Input], options: GateOptions | None = None) -> None:
        self.inputs, self.options = tuple(inputs), options or GateOptions()
        self.commanded: dict[str, float] = {}
        """What was commanded last; empty while nothing is."""
        self.last: dict[str, float] = {}
        """What was commanded last, also while nothing is: a robot that stops stays there. Empty before the first command."""
        self.turn = 0
        """How often it was let go: what was found for an earlier turn is not wanted in this one."""
        self._wanted: dict[str, float] = {}
        self._held_at = self._moved_at = float("-inf")

    def hold(self, now: float, *, armed: bool) -> None:
        """Take note that someone holds on at a time [s], armed or not."""
        if armed and self.options.allowed:
            self._held_at = now
        else:
            self.release()

    def want(self, inputs: Mapping[str, float], *, turn: int | None = None) -> None:
        """Set where the inputs are to go, unless that was found for an earlier turn."""
        if turn in (None, self.turn):
            self._wanted = dict(inputs)

    def release(self) -> None:
        """Stop at once: nothing moves any more."""
        self._held_at = float("-inf")
        self._wanted = {}
        self.turn += 1

    @property
    def moving(self) -> bool:
        """Whether commands go out."""
        return bool(self.commanded)

    @property
    def arrived(self) -> bool:
        """Whether the inputs that go out are those that are wanted: limited rates have caught up."""
        near = 1e-3
        return self.moving and all(
            abs(self.commanded[one.name] - _within(one, self._wanted.get(one.name, self.commanded[one.name])))
            <= near * (one.high - one.low)
            for one in self.inputs
        )

    def step(self, now: float, current: Mapping[str, float]) -> dict[str, float] | None:
        """Return the inputs to command at a time [s], or None where none may be.

        Arguments:
            now: the time [s].
            current: where the robot itself says that the inputs are; commands begin from there, so that nothing jumps. What it
                does not say is where commands left it last, however long ago.
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
