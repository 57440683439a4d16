"""A process that outlives a session: when the session ends or is killed, it completes the run and removes temporary files.

    python -m femsense.live.keeper SCRATCH [SESSION]

It waits for the end of its standard input, which the system closes with the session.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def start_keeper(scratch: Path, session: Path | None) -> subprocess.Popen[bytes]:
    """Start the process for a session; closing its standard input triggers it."""
    command = [sys.executable, "-m", "femsense.live.keeper", str(scratch), *([] if session is None else [str(session)])]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True, env=environment)


def main(words: list[str]) -> None:
    """Wait for the end of the session, then complete it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    from femsense.core.errors import FemsenseError
    from femsense.live.growing import remove_scratch
    from femsense.live.recorder import LIVE, finish_session

    remove_scratch(Path(words[0]))
    for session in words[1:]:
        Path(session, LIVE).unlink(missing_ok=True)  # its page is gone
    with suppress(FemsenseError, OSError, ValueError):  # a session without a frame, or on a disk that is gone
        for session in words[1:]:
            finish_session(Path(session))


if __name__ == "__main__":
    main(sys.argv[1:])
