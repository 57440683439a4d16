"""Options of `femsense stream`, and the valid combinations with those of `femsense view`: options without effect are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from femsense.core.errors import InputError
from femsense.core.options import Flag

BROKER_PORT = 1883
"""Registered for MQTT."""


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Where a stream goes and who may see it."""

    commands: Annotated[bool, Flag("--commands", help="With --drag: publish commands once a viewer arms them.")] = False
    insecure: Annotated[bool, Flag("--insecure", help="With --commands: also over a broker that lets anybody in.")] = False
    host: Annotated[str, Flag("--host", help="0.0.0.0 lets other machines watch; needs a password.")] = "127.0.0.1"
    names: Annotated[Sequence[str], Flag("--name", "NAME", "By which others know this machine.")] = ()
    port: Annotated[int, Flag("--port", help="Of the page and its WebSocket; 0: a free one.", min=0, max=65535)] = 8010
    mqtt: Annotated[str | None, Flag("--mqtt", "HOST[:PORT]", "Send to this broker; mqtts:// encrypts.")] = None
    broker: Annotated[bool, Flag("--broker", help="Serve a broker for this machine.")] = False
    broker_port: Annotated[
        int | None, Flag("--broker-port", help="Of --broker; 1883 if not given, 0: a free one.", min=0, max=65535)
    ] = None
    json_mirror: Annotated[bool, Flag("--json-mirror", help="Send pose_json too, for Unity's JsonUtility.")] = False
    rate_hz: Annotated[float, Flag("--rate", help="Most poses a second.", min=0.1, max=1000.0)] = 60.0
    password_file: Annotated[Path | None, Flag("--password-file", "FILE", "Or variable FEMSENSE_PASSWORD.")] = None
    certificate: Annotated[Path | None, Flag("--certificate", "PEM", "Encrypt with this.")] = None
    key: Annotated[Path | None, Flag("--key", "PEM", "Of the certificate.")] = None
    authority: Annotated[Path | None, Flag("--authority", "PEM", "Of the broker's certificate.")] = None
    page: Path | None = None
    """Folder of the built page; None: the one of the package."""

    @property
    def served_port(self) -> int | None:
        """Port of the broker of our own; None where there is none."""
        return self.broker_port if self.broker_port is not None or not self.broker else BROKER_PORT


def need_stream(runs: Sequence[Path], sensors: str | None, *, drag: bool) -> None:
    """Raise InputError unless there are runs or sensors; both go together where sensors measure what is dragged."""
    if runs and sensors is not None:
        need_with("RUN with --sensors", True, "--drag", drag)
    else:
        need_one(runs, sensors)


def need_one(runs: Sequence[Path], source: str | None) -> None:
    """Raise InputError unless there are runs or a live source, and not both."""
    if bool(runs) == (source is not None):
        found = "both" if runs else "neither"
        raise InputError("either a run or a live source", where="RUN", found=found, expected="RUN, --sensors or --stream")


def need_model(sensors: str | None, model: Path | None) -> None:
    """Raise InputError where sensors come without a model, or a model without sensors."""
    if (sensors is None) != (model is None):
        raise InputError("sensors go with a model", where="--sensors", expected="--sensors SOURCE --model MODEL")


def need_with(option: str, given: bool, other: str, there: bool) -> None:
    """Raise InputError where an option is given that does nothing without another."""
    if given and not there:
        raise InputError(f"{option} does nothing without {other}", where=option, found=f"no {other}", expected=f"{other} too")


def is_encrypted(address: str | None) -> bool:
    """Return whether an address denotes an encrypted connection."""
    return (address or "").partition("://")[0] in ("https", "wss", "mqtts")
