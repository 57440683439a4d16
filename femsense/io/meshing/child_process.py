"""A Python program in a process and a folder of its own: it may crash, not end, or write files where it runs."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

GIVEN, MADE = "given.npz", "made.npz"
"""Input and output file of the program, in its folder."""


class ProgramTimeout(Exception):
    """The program did not come to an end."""


class ProgramFailed(Exception):
    """The program ended without its file; the text is the last line that it wrote."""


def run_program(
    program: str, *arguments: str, seconds: float, given: Mapping[str, Any] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Run a Python program and return the arrays that it writes into `made.npz` where it runs.

    Arguments:
        program: its source text.
        arguments: its command line.
        seconds: it is stopped after this time [s].
        given: arrays that it finds in `given.npz`.

    Raises:
        ProgramTimeout: it was stopped.
        ProgramFailed: another exit status than 0, or no file.
    """
    command = [sys.executable, "-c", program, *arguments]
    with tempfile.TemporaryDirectory(prefix="femsense-") as folder:
        if given is not None:
            np.savez(Path(folder, GIVEN), **given)
        try:
            result = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=seconds)
        except subprocess.TimeoutExpired:
            raise ProgramTimeout from None
        if result.returncode or not Path(folder, MADE).is_file():
            raise ProgramFailed((result.stderr.strip().splitlines() or [f"exit status {result.returncode}"])[-1])
        with np.load(Path(folder, MADE)) as made:
            return {name: made[name] for name in made.files}
