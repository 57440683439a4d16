"""What a source of frames is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.live.frames import RawFrame
from femsense.model.camera import Camera


class Loss(StrEnum):
    """Why a source has no frames."""

    UNPLUGGED = "unplugged"
    REFUSED = "refused"
    """In use by another program, no permission, or a broken device."""
    ENDED = "ended"
    """A recording that is over."""


class SourceLost(FemsenseError):
    """A source that has no more frames, until it is opened again."""

    def __init__(self, loss: Loss, text: str) -> None:
        """Arguments: why, and in words what happened and what to do."""
        self.loss, self.text = loss, text
        super().__init__(text)

    def __reduce__(self) -> tuple[type[SourceLost], tuple[Loss, str]]:
        return SourceLost, (self.loss, self.text)


@dataclass(frozen=True, slots=True)
class Opening:
    """What a source is told when it is opened."""

    begun_s: float = float("nan")
    """`SourceInfo.begun_s` of the first time [s]; nan the first time."""
    attempt: int = 0
    """0 the first time; later a source may reset its device first."""
    last_number: int = -1
    """Counter of the last frame that was received; −1: none."""


@dataclass(frozen=True, eq=False, slots=True)
class SourceInfo:
    """What is known of a source once it is open."""

    name: str
    """Model and serial number, for people."""
    cameras: tuple[Camera | None, ...]
    """One a view; None where frames come as clouds and the lens is not known."""
    rate_hz: float
    """Frames a second that it is set to; nan: not known."""
    camera_names: tuple[str, ...] = ("",)
    """One a view; "" where there is one."""
    link: str = ""
    """Such as "USB 3.2"; empty: none."""
    is_slow_link: bool = False
    """Whether the link carries less than the streams need, as USB 2 does."""
    T_robot_camera: tuple[FloatArray | None, ...] = ()
    """Declared poses; empty: none."""
    actuation: str | None = None
    """What the inputs that come with frames are, "tension" or "displacement"; None: none come."""
    actuation_zero: str = "absolute"
    marker_noise_m: float | None = None
    begun_s: float = float("nan")
    """When a recording began to be replayed [s, monotonic clock]: it goes on from there when it is opened again."""
    largest_frame: int = 1 << 23
    """Of an encoded frame [bytes]."""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that is plugged in."""

    source: str
    """As --camera takes it."""
    name: str
    link: str
    is_slow_link: bool
    needed_mbit_s: float
    """Of the streams that a session asks for, without compression [Mbit/s]."""


class FrameSource(Protocol):
    """A camera, or what poses as one. All calls come from one thread of the process that has it."""

    def open(self, opening: Opening) -> SourceInfo:
        """Start to stream. Raises SourceLost, InputError, MissingDependency."""
        ...

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the next frame; None where none came in time. Raises SourceLost where none will come."""
        ...

    def close(self) -> None:
        """Stop, and let go of the device; also one that was never opened or is gone."""
        ...

    def list_devices(self) -> list[FoundCamera]:
        """Return the devices of this kind that are plugged in; none where it is not a device. Raises MissingDependency."""
        ...
