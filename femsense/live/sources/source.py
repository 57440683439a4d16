"""The interface of a source of frames."""

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
    """The recording has ended."""


class SourceLost(FemsenseError):
    """A source without further frames until it is reopened."""

    def __init__(self, loss: Loss, text: str) -> None:
        """Arguments: the reason; a message with cause and remedy."""
        self.loss, self.text = loss, text
        super().__init__(text)

    def __reduce__(self) -> tuple[type[SourceLost], tuple[Loss, str]]:
        return SourceLost, (self.loss, self.text)


@dataclass(frozen=True, slots=True)
class Opening:
    """Arguments of opening a source."""

    begun_s: float = float("nan")
    """Time of the first attempt to open it [s, monotonic clock], from which a replay counts; nan: now."""
    attempt: int = 0
    """0 at the first opening; at later ones a source may reset its device."""
    last_number: int = -1
    """Counter of the last frame that was received; −1: none."""


@dataclass(frozen=True, eq=False, slots=True)
class SourceInfo:
    """Properties of an open source."""

    name: str
    """Model and serial number, for display."""
    cameras: tuple[Camera | None, ...]
    """One per view; None for point clouds without known intrinsics."""
    rate_hz: float
    """Configured frame rate [Hz]; nan: unknown."""
    camera_names: tuple[str, ...] = ("",)
    """One per view; "" for a single view."""
    link: str = ""
    """Such as "USB 3.2"; empty: none."""
    is_slow_link: bool = False
    """Whether the bandwidth of the link is too low for the streams, as with USB 2."""
    T_robot_camera: tuple[FloatArray | None, ...] = ()
    """Declared poses; empty: none."""
    actuation: str | None = None
    """Kind of the inputs that arrive with frames, "tension" or "displacement"; None: without inputs."""
    actuation_zero: str = "absolute"
    marker_noise_m: float | None = None
    longest_wait_s: float = 0.0
    """Longest planned time between two frames, as of a recording with pauses [s]; 0: that of a camera."""
    contact_free: str = ""
    """Which frames of a recording may calibrate, in words; empty for cameras."""
    largest_frame: int = 1 << 23
    """Maximum size of an encoded frame [bytes]."""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A connected camera."""

    source: str
    """Argument of --camera."""
    name: str
    link: str
    is_slow_link: bool
    needed_mbit_s: float
    """Data rate of the requested streams without compression [Mbit/s]."""


class FrameSource(Protocol):
    """A camera, or a substitute. All calls are made by one thread of the process that owns it."""

    def open(self, opening: Opening) -> SourceInfo:
        """Start streaming. Raises SourceLost, InputError, MissingDependency."""
        ...

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the newest frame; None after the timeout. Raises SourceLost if no frame will arrive."""
        ...

    def close(self) -> None:
        """Stop and release the device; allowed if it was never opened or is disconnected."""
        ...

    def list_devices(self) -> list[FoundCamera]:
        """Return the connected devices of this kind; none if it is not a device. Raises MissingDependency."""
        ...
