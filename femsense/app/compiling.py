"""The message of a command that waits for kernels to be compiled."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

COMPILING = frozenset({"demo", "mesh", "simulate", "calibrate", "estimate", "improve", "export", "reach"})
"""Commands that use compiled kernels."""
DRAGGING = frozenset({"--drag", "--commands"})
"""Options with which `stream` uses them too, at the first drag."""
COMPILING_TEXT = "compiling kernels, once after an installation: up to a minute"


@contextlib.contextmanager
def announced_compiling(words: Sequence[str], say: Callable[[str], None]) -> Iterator[None]:
    """Report once that kernels are compiled, when the first one is.

    Arguments:
        words: the command and its arguments; commands without kernels do not load numba.
        say: takes the line.
    """
    uses = words[0] in COMPILING or (words[0] == "stream" and bool(DRAGGING & set(words)))
    if not uses or {"-h", "--help"} & set(words):
        yield
        return
    from numba.core import event

    class Announcement(event.Listener):  # type: ignore[misc]
        said = False

        def on_start(self, event: object) -> None:
            if not self.said:
                self.said = True
                say(COMPILING_TEXT)

        def on_end(self, event: object) -> None:
            pass

    with event.install_listener("numba:compile", Announcement()):
        yield
