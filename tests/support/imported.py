"""A capture, imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from femsense.io.importers.guess import open_sources
from femsense.io.importers.options import Options
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording
from femsense.model.recording import Recording


def imported(path: Path, folder: Path, options: Options | None = None, **more: Any) -> tuple[Recording, dict[str, Any]]:
    """Import into FOLDER/recording; return the recording and what was found."""
    found = write_recording(open_sources([path], options), folder / "recording", identity={"test": str(path)}, **more)
    return load_recording(folder / "recording"), found


def without_invalid(image: np.ndarray) -> np.ndarray:
    """Return a depth image whose 65535 is 0, as a recording has it."""
    return np.where(image == 65535, 0, image)
