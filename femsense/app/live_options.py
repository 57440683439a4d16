"""Options of `femsense live`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from femsense.core.options import Flag
from femsense.io.importers.options import Inputs, Zero


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How a session runs, and where it is recorded, shown and sent to."""

    actuation: Annotated[
        str | None,
        Flag(
            "--actuation",
            "SOURCE",
            "mqtt://HOST/TOPIC, udp://HOST:PORT, ws://…, serial:PORT, a CSV file that grows, or fixed:NAME=VALUE,…",
        ),
    ] = None
    """None: the inputs that come with the frames."""
    calibration: Annotated[Path | None, Flag("-c --calibration", "FILE", "Made on the fly where it is not given.")] = None
    output: Annotated[Path | None, Flag("-o --output", "SESSION", "Record into this folder.")] = None
    as_fast_as_possible: Annotated[
        bool, Flag("--as-fast-as-possible", help="Of a recording: every frame, not at its own time.")
    ] = False
    delay_s: Annotated[float, Flag("--delay", "SECONDS", "From an input to its effect.", min=0.0)] = 0.0
    inputs: Annotated[Inputs, Flag("--inputs", help="Quantity of the cable inputs; a recording declares its own.")] = (
        Inputs.tension
    )
    zero: Annotated[Zero, Flag("--zero", help="Whether inputs count from an unknown zero.")] = Zero.absolute
    contact_free: Annotated[int, Flag("--contact-free", "N", "Contact-free frames first, with -c and after a zero.", min=0)] = 8
    seconds: Annotated[float | None, Flag("--seconds", help="End after this time.", min=0.0)] = None
    page: Annotated[bool, Flag("--page/--no-page", help="Serve the page.")] = True
    host: Annotated[str, Flag("--host", help="Of the page; beyond this machine a password is needed.")] = "127.0.0.1"
    port: Annotated[int, Flag("--port", help="Of the page; 0 takes a free one.", min=0, max=65535)] = 0
    mqtt: Annotated[str | None, Flag("--mqtt", "URL", "Send to this broker too.")] = None
    broker_port: Annotated[int | None, Flag("--broker", "PORT", "Serve a broker of our own; 0: a free port.")] = None
    mcap: Annotated[Path | None, Flag("--mcap", "FILE", "Write the messages to this file too.")] = None
    password_file: Annotated[Path | None, Flag("--password-file", "FILE", "Of page and brokers.")] = None
