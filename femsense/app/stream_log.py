"""The messages of a stream while it runs and when it ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, eq=False, slots=True)
class Watched:
    """A connection or a source of readings, which may be missing."""

    missing: str
    back: str
    until: str
    why: Callable[[], str]
    """Why it is missing; empty where it is there."""
    beside: Callable[[], str] = lambda: ""
    """A note that is reported once while the source is there; empty: none."""

    @property
    def trouble(self) -> str:
        """The report that it is missing, with the reason; empty where it is there."""
        why = self.why()
        return f"{self.missing} ({why}), {self.until}" if why else ""


def connection(where: str, why: Callable[[], str]) -> Watched:
    """Return the observer of an outgoing connection."""
    return Watched(f"no connection to {where}", f"connected to {where}", "trying again", why)


def readings_from(source: str, why: Callable[[], str], refused: Callable[[], str] = lambda: "") -> Watched:
    """Return the observer of a source of readings; `refused` describes ignored messages."""

    def beside() -> str:
        return f"some of {source} is passed over: {said}" if (said := refused()) else ""

    return Watched(f"no readings of {source}", f"readings of {source} come", "waiting", why, beside)


def remark(text: Callable[[], str]) -> Watched:
    """Return the observer of a note that is reported once; the text is empty until there is one."""
    return Watched("", "", "", lambda: "", text)


class StreamLog:
    """Reports of each connection and source when it is lost and when it is back."""

    def __init__(self, watched: Sequence[Watched]) -> None:
        """Watch connections and sources; nothing is reported before one was missing."""
        self._watched = watched
        self._known: dict[Watched, str] = {}
        self._said: set[Watched] = set()

    def news(self) -> list[str]:
        """Return the changes since the last call."""
        told = []
        for one in self._watched:
            trouble = one.trouble
            if trouble != self._known.get(one, ""):
                told.append(trouble or one.back)
            self._known[one] = trouble
            if one not in self._said and not trouble and (beside := one.beside()):
                told.append(beside)
                self._said.add(one)
        return told


@dataclass(frozen=True, slots=True)
class Streamed:
    """Summary of a stream: poses and viewers."""

    poses: dict[str, int]
    """Of each robot."""
    seconds: float
    viewers: int
    """Of the page and its WebSocket."""
    clients: int | None = None
    """Of the embedded broker; None: there was none."""
    brokers: Mapping[str, bool] = field(default_factory=dict)
    """Elsewhere, and whether it was ever connected."""
    passed: int = 0
    """Messages or lines that were no readings."""
    dropped: int = 0
    """Readings that a newer one replaced before a pose was made of them."""

    @property
    def text(self) -> str:
        """One sentence for people."""
        robots = [f"{_count(count, 'pose')} of {name}" for name, count in self.poses.items()]
        places = [_count(self.viewers, "viewer")]
        places += [] if self.clients is None else [_count(self.clients, "client of the broker", "clients of the broker")]
        places += [f"the broker {where}" for where, reached in self.brokers.items() if reached]
        silent = "".join(f"; the broker {where} was never reached" for where, reached in self.brokers.items() if not reached)
        passed = f"; {_count(self.passed, 'line')} passed over: no readings" if self.passed else ""
        dropped = f"; {_count(self.dropped, 'reading')} replaced by newer ones" if self.dropped else ""
        return f"streamed {_listed(robots)} in {self.seconds:.1f} s, to {_listed(places)}{silent}{passed}{dropped}"


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number or 'no'} {one if number == 1 else many or one + 's'}"


def _listed(parts: Sequence[str]) -> str:
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
