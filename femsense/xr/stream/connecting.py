"""Connection errors of streams and brokers in words, with advice."""

from __future__ import annotations

import socket
import ssl

from femsense.xr.stream.access import PASSWORD_WAYS

NO_ANSWER = "no answer"
NO_TLS = "nothing is encrypted there: the address without the s (http://, mqtt://)"
NO_STREAM = "the server there is not a femsense stream, or is encrypted (https://)"
NO_BROKER = "the server there is not a broker, or is encrypted (mqtts://)"
REFUSED = "Connection refused: nothing listens at that port; is it the right one, and does the stream run?"


def why_not(error: BaseException, *, tls: bool, password: bool) -> str:
    """Return why an attempt to connect failed.

    Arguments:
        error: the exception.
        tls: whether the attempt was encrypted.
        password: whether a password was given.
    """
    answer = getattr(error, "response", None)  # of a WebSocket's handshake
    status = getattr(answer, "status_code", getattr(error, "code", None))
    if status is not None:
        return _refused_by_server(int(status), password=password)
    if isinstance(error, OSError):
        return _not_reached(error, tls=tls)
    if type(error).__name__ == "InvalidMessage":  # of websockets: the peer does not speak HTTP
        return NO_TLS if tls else NO_STREAM
    return str(error) or NO_ANSWER


def not_let_in(*, password: bool) -> str:
    """Return the error in words if the password is the cause."""
    return f"the password is wrong: {PASSWORD_WAYS}" if password else f"a password is needed: {PASSWORD_WAYS}"


def _refused_by_server(status: int, *, password: bool) -> str:
    if status == 401:
        return not_let_in(password=password)
    if status == 403:
        return "the server answers only to its own names: 127.0.0.1, or with a password those of its machine and of --name"
    if status == 503:
        return "too many viewers"
    return f"the server there is not a femsense stream (HTTP {status}): is it the right port?"


def _not_reached(error: OSError, *, tls: bool) -> str:
    reason = getattr(error, "reason", None)  # of urllib
    if isinstance(reason, OSError):
        return _not_reached(reason, tls=tls)
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the certificate is not trusted ({error.verify_message}): --authority PEM is the authority that it is checked against"
    if isinstance(error, ssl.SSLError) or (tls and isinstance(error, ConnectionResetError)):
        return NO_TLS
    if isinstance(error, TimeoutError) and "handshake" in str(error):
        return NO_TLS if tls else NO_STREAM
    if isinstance(error, ConnectionRefusedError):
        return REFUSED
    if isinstance(error, socket.gaierror):
        return "no machine of that name is known"
    return str(error) or NO_ANSWER
