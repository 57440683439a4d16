"""A twin of one bone that moves, the page of two files, and clients of a stream that share nothing with it."""

from __future__ import annotations

import json
import re
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from femsense.xr.stream.payloads import Contact, Input, Twin, TwinFrame

DOCS = Path(__file__).resolve().parents[2] / "docs" / "guides" / "streaming.md"
PAGE = {"index.html": b"<p>page</p>", "app.js": b"1"}
GLB = b"glTF of a robot"


def documented(kind: str) -> Any:
    """The example that the documentation gives of a topic."""
    found = re.search(rf"^{kind} +(\{{.*\}})$", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert found is not None, kind
    return json.loads(found.group(1))


def names_in(document: Any) -> Any:
    """The names of a document and what lies under them, without values; of a list its first item."""
    if isinstance(document, list):
        return [names_in(one) for one in document[:1]]
    return {name: names_in(value) for name, value in document.items()} if isinstance(document, dict) else None


def twin(name: str = "arm", **more: Any) -> Twin:
    """Two bones at rest, one cable."""
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 2, 3] = 0.1
    return Twin(name, GLB, ("a", "b"), T, inputs=(Input("top", "N", 0.0, 5.0),), **more)


def moment(time_s: float, *, x: float = 0.0, contact: bool = False) -> TwinFrame:
    """The second bone at x, turned by 90° about z."""
    half = np.sqrt(0.5)
    bones = np.array([[0, 0, 0, 0, 0, 0, 1], [x, 0.2, 0.1, 0, 0, half, half]], dtype=np.float32)
    contacts = (Contact(3, np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.0, -2.0]), 0.1, source="cloud"),) if contact else ()
    return TwinFrame(time_s, bones, contacts, inputs=(1.5,), residual_m=4e-4, status="ok", frame=7)


def read_frame(frame: bytes) -> dict[str, bytes]:
    """The messages of a WebSocket frame, taken apart by hand."""
    found, at = {}, 0
    while at < len(frame):
        name, size = struct.unpack_from("<HI", frame, at)
        at += 6
        found[frame[at : at + name].decode()] = frame[at + name : at + name + size]
        at += name + size
    return found


def bones_of(pose: bytes) -> np.ndarray:
    """The seven numbers of each bone of a pose message."""
    return np.frombuffer(pose, "<f4", offset=20).reshape(-1, 7)


def x_of(pose: bytes) -> float:
    """The x of the second bone of a pose message, by its offset in the bytes."""
    return float(struct.unpack_from("<f", pose, 20 + 28)[0])


def within(seconds: float, true: Callable[[], bool]) -> bool:
    """Whether something comes true in time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.01)
    return true()


@contextmanager
def closing(*things: Any) -> Iterator[None]:
    """Close things in turn at the end, whatever happens."""
    try:
        yield
    finally:
        for thing in things:
            thing.close()
