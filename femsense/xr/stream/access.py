"""Access to a stream: this machine only, or with a password."""

from __future__ import annotations

import base64
import hmac
import ipaddress
import os
import secrets
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from femsense.core.errors import InputError

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
COOKIE = "femsense"
PASSWORD = "FEMSENSE_PASSWORD"
"""Environment variable that may hold the password."""
PASSWORD_WAYS = f"--password-file FILE, or the variable {PASSWORD}"


@dataclass(frozen=True, slots=True)
class Access:
    """Address of a server, and its access rules."""

    host: str = "127.0.0.1"
    password: str | None = field(default=None, repr=False)
    certificate: Path | None = None
    """PEM file; with it all traffic is encrypted."""
    key: Path | None = None
    names: tuple[str, ...] = ()
    """Further host names of this machine: of a proxy, a tunnel, a router."""
    ticket: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    """Value of the page's cookie after the password was accepted; random for each server."""

    def __post_init__(self) -> None:
        if not is_loopback(self.host) and not self.password:
            raise InputError(
                "other machines may watch only with a password",
                where="--host",
                found=self.host,
                expected="a password, or 127.0.0.1",
                hint=PASSWORD_WAYS,
            )
        if self.key is not None and self.certificate is None:
            raise InputError("a key without its certificate", where="--key", hint="--certificate FILE")

    @property
    def scheme(self) -> str:
        """URL scheme of the page."""
        return "https" if self.certificate is not None else "http"

    def tls(self) -> ssl.SSLContext | None:
        """Return the TLS context, or None. Raises InputError."""
        if self.certificate is None:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (OSError, ssl.SSLError) as error:
            raise InputError(
                "not a certificate with its key",
                where=self.certificate,
                found=error,
                expected="PEM files",
                hint="name the file of its key: --key" if self.key is None else None,
            ) from None
        return context

    def allows(self, authorization: str | None, cookie: str | None) -> bool:
        """Return whether a request may be answered, from its two headers."""
        if self.password is None:
            return True
        for part in (cookie or "").split(";"):
            name, _, value = part.strip().partition("=")
            if name == COOKIE and _same(value, self.ticket):
                return True
        return _same(_password_of(authorization), self.password)

    def knows_host(self, header: str | None, reached_at: str) -> bool:
        """Return whether a Host header is ours, so that no foreign page reaches us under its own name (DNS rebinding).

        Names of this machine's own loopback always are; with a password also the machine's name, the address that was reached, and
        those that were declared.
        """
        name = _name_of(header or "").lower().rstrip(".")
        if name in LOOPBACK_NAMES or self.password is None:
            return name in LOOPBACK_NAMES
        here = socket.gethostname().lower()
        own = {here, here.partition(".")[0], f"{here.partition('.')[0]}.local", reached_at.lower(), self.host.lower()}
        return name in own | {one.lower() for one in self.names}


def is_loopback(host: str) -> bool:
    """Return whether an address is this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def same_origin(origin: str | None, host: str | None) -> bool:
    """Return whether a browser's page comes from the server itself; programs send no origin."""
    return origin is None or origin.partition("://")[2] == (host or "")


def read_password(file: Path | None) -> str | None:
    """Return the first line of a file, else the value of the variable PASSWORD, else None. Raises InputError."""
    if file is None:
        return os.environ.get(PASSWORD) or None
    try:
        password = file.read_text(encoding="utf-8").partition("\n")[0].strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("the password cannot be read", where=file, found=error) from None
    if not password:
        raise InputError("the password is empty", where=file, expected="one line")
    return password


def _password_of(authorization: str | None) -> str:
    scheme, _, value = (authorization or "").partition(" ")
    if scheme.lower() != "basic":
        return ""
    try:
        return base64.b64decode(value, validate=True).decode().partition(":")[2]
    except ValueError:
        return ""


def _same(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())


def _name_of(host: str) -> str:
    """Return the name in a Host header without its port."""
    return host.partition("]")[0].lstrip("[") if host.startswith("[") else host.partition(":")[0]


def without_password(address: str) -> str:
    """Return an address as it may be shown: without the name and password before its host."""
    parts = urlsplit(address)
    return address.replace(parts.netloc, parts.netloc.rpartition("@")[2], 1) if "@" in parts.netloc else address
