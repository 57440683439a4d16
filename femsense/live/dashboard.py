"""The terminal view of a session: forces with interval and age, rates, lost frames, and instructions."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING

import numpy as np

from femsense.live.events import SessionEvent
from femsense.live.figures import Snapshot
from femsense.live.link import LinkState

if TYPE_CHECKING:
    from rich.console import RenderableType

INTERVAL = 1.96
"""Half width of a 95 % interval in standard deviations."""
REDRAWN_HZ = 8.0
FRESH_S = 0.5
KEYS = {
    "t": "zero: use the present state as contact-free reference",
    "T": "the same during a contact",
    "c": "calibrate with the inputs that have moved so far",
    "q": "end",
}
SENSING_KEYS, OTHER_KEYS = "tTq", "cq"


def draw(snapshot: Snapshot, now_s: float, url: str = "") -> RenderableType:
    """Return the terminal view of a session at a time [s, monotonic clock]."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    head = Table.grid(padding=(0, 2))
    good = snapshot.link.state is LinkState.STREAMING
    link = Text(snapshot.link.text(now_s), style="green" if good else "bold red")
    head.add_row("camera", Text(f"{snapshot.camera} {snapshot.link_speed}".strip() or "…"), link)
    head.add_row("doing", Text(str(snapshot.phase)), Text(snapshot.todo, style="bold yellow"))
    latency, counts = snapshot.latency, snapshot.counts
    times = " / ".join(_number(1e3 * v) for v in (latency.p50_s, latency.p95_s, latency.p99_s))
    head.add_row("latency", Text(f"{times} ms (p50 / p95 / p99)"), Text(f"{_number(latency.rate_hz, 1)} frames/s"))
    frames = f"{snapshot.used} sensed, {counts.skipped} skipped, {counts.missed} missed, {counts.dropped} not delivered"
    head.add_row("frames", Text(frames), Text(f"recorded in {snapshot.recording}" if snapshot.recording else "not recorded"))
    parts: list[RenderableType] = [head, _contacts(snapshot, now_s)]
    parts += [Text(f"! {notice_text(event, now_s)}", style="yellow") for event in snapshot.notices]
    keys = "   ".join(f"{key} {KEYS[key]}" for key in (OTHER_KEYS if snapshot.answer is None else SENSING_KEYS))
    return Panel(Group(*parts, Text(f"{keys}   {url}".rstrip(), style="dim")), title="femsense live")


def notice_text(event: SessionEvent, now_s: float) -> str:
    """Return a problem with its time relative to now [s, monotonic clock], and how often it occurred."""
    lasts = event.ended_s > now_s
    when = f"for {now_s - event.begun_s:.0f} s" if lasts else f"{now_s - event.ended_s:.0f} s ago"
    often = f", {event.count} times" if event.count > 1 else ""
    return f"{event.kind.value} ({when}{often}): {event.text}"


def _contacts(snapshot: Snapshot, now_s: float) -> RenderableType:
    from rich.table import Table
    from rich.text import Text

    answer = snapshot.answer
    if answer is None:
        return Text("no forces yet", style="dim")
    age = now_s - snapshot.taken_s
    fresh = age < FRESH_S
    table = Table(
        title=f"{answer.report.status}, {1e3 * age:.0f} ms ago" if fresh else f"{age:.1f} s old: {answer.report.status}"
    )
    for name in ("track", "force [N]", "95 % interval", "at [mm]", "by"):
        table.add_column(name, justify="right")
    for c in answer.contacts:
        low, high = max(0.0, c.force_n - INTERVAL * c.std_n), c.force_n + INTERVAL * c.std_n
        place = ", ".join(f"{1e3 * x:.0f}" for x in c.position_m)
        table.add_row(str(c.track), f"{c.force_n:.3f}", f"{low:.3f} … {high:.3f}", place, c.source, style="" if fresh else "dim")
    if not answer.contacts:
        table.add_row("", "none", "", "", "")
    return table


def lines(before: Snapshot | None, now: Snapshot, now_s: float) -> Iterator[str]:
    """Yield a line for each change, for output that is not a terminal."""
    if before is None or before.phase != now.phase:
        yield str(now.phase)
    if now.todo and (before is None or before.todo != now.todo):
        yield now.todo
    if before is not None and before.link.state is not now.link.state:
        yield f"camera: {now.link.text(now_s)}"
    known = {} if before is None else {(event.kind, event.begun_s): event for event in before.notices}
    for event in now.notices:
        old = known.get((event.kind, event.begun_s))
        if old is None:
            yield f"{event.begun_s - now.begun_s:.1f} s: {event.kind.value}: {event.text}"
        elif old.ended_s == float("inf") > event.ended_s:
            yield f"{event.ended_s - now.begun_s:.1f} s: {event.kind.value}: over after {event.duration_s(now_s):.1f} s"


@contextmanager
def shown(
    snapshot: Callable[[], Snapshot], on_key: Callable[[str], None], say: Callable[[str], None], url: str
) -> Iterator[None]:
    """Show a session during the block: redrawn on a terminal, as lines elsewhere.

    Arguments:
        snapshot: of the session.
        on_key: called with a key of KEYS.
        say: receives a line if there is no terminal.
        url: of the page.
    """
    stop = Event()
    on_terminal = sys.stderr.isatty()
    threads = [Thread(target=_draw_on if on_terminal else _say_on, args=(snapshot, stop, url, say), daemon=True)]
    if sys.stdin is not None and sys.stdin.isatty():
        threads.append(Thread(target=_read_keys, args=(stop, on_key), daemon=True))
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(1.0)


def _draw_on(snapshot: Callable[[], Snapshot], stop: Event, url: str, _say: Callable[[str], None]) -> None:
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), refresh_per_second=REDRAWN_HZ, auto_refresh=False) as live:
        while not stop.wait(1.0 / REDRAWN_HZ):
            live.update(draw(snapshot(), time.monotonic(), url), refresh=True)


def _say_on(snapshot: Callable[[], Snapshot], stop: Event, _url: str, say: Callable[[str], None]) -> None:
    before: Snapshot | None = None
    while True:
        now = snapshot()
        for line in lines(before, now, time.monotonic()):
            say(line)
        before = now
        if stop.wait(1.0 / REDRAWN_HZ):
            return


def _read_keys(stop: Event, on_key: Callable[[str], None]) -> None:
    """Read single keys; the terminal settings are restored at the end."""
    import select

    try:
        import termios
        import tty
    except ImportError:  # Windows
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal)
        while not stop.is_set():
            if select.select([terminal], [], [], 0.2)[0]:
                key = sys.stdin.read(1)
                if key in KEYS:
                    on_key(key)
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _number(value: float, digits: int = 0) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"
