"""A program in a process of its own: one that may crash, may not end, or writes files where it runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


class ProgramTimeout(Exception):
    """The program did not come to an end."""


class ProgramFailed(Exception):
    """The program ended without its file; the text is the last line that it wrote."""


def run_program(program: str, *arguments: str, folder: str | Path, makes: str, seconds: float) -> Path:
    """Run a Python program in a folder and return the file that it makes there.

    Arguments:
        program: its source text.
        arguments: its command line.
        folder: where it runs.
        makes: name of the file.
        seconds: it is stopped after so long [s].
    Raises:
        ProgramTimeout: it was stopped.
        ProgramFailed: another exit status than 0, or no file.
    """
    command = [sys.executable, "-c", program, *arguments]
    try:
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=seconds)
    except subprocess.TimeoutExpired:
        raise ProgramTimeout from None
    made = Path(folder) / makes
    if result.returncode or not made.is_file():
        raise ProgramFailed((result.stderr.strip().splitlines() or [f"exit status {result.returncode}"])[-1])
    return made
