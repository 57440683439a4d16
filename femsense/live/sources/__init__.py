"""Sources of frames. `SOURCES` is their registry: a new camera is a class with four methods and an entry there."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.live.sources.source import FoundCamera, FrameSource

SOURCES: Mapping[str, str] = {
    "realsense": "femsense.live.sources.realsense:RealSense",
    "orbbec": "femsense.live.sources.orbbec:Orbbec",
    "oak": "femsense.live.sources.oak:Oak",
    "mcap": "femsense.live.sources.mcap_pipe:McapPipe",
    "foxglove": "femsense.live.sources.foxglove:Foxglove",
    "folder": "femsense.live.sources.folder:GrowingFolder",
    "recording": "femsense.live.sources.recorded:Recorded",
    "software": "femsense.live.sources.software:SoftwareCamera",
}
"""Prefix → module and class, constructed with the text after the colon."""
CAMERAS = ("realsense", "orbbec", "oak")
"""Sources whose devices `list_cameras` lists."""


def make_source(text: str, *, as_fast_as_possible: bool = False) -> FrameSource:
    """Return the source that a text specifies, not opened yet.

    Arguments:
        text: `realsense[:SERIAL]`, `orbbec[:SERIAL]`, `oak[:ID]`, `mcap:FILE` (`-` is standard input), `foxglove:ws://…`,
            `software:RECORDING[?FAULTS]`, or a path: a recording is replayed, any other folder is watched for new files.
        as_fast_as_possible: replay the next frame on request instead of at its time.

    Raises:
        InputError: an unknown source.
    """
    word, _, rest = text.partition(":")
    if word not in SOURCES:
        word, rest = _kind_of_path(Path(text).expanduser(), text), str(Path(text).expanduser())
    if as_fast_as_possible:
        if word != "recording":
            raise InputError(
                "only a recording can be replayed as fast as possible",
                where="--as-fast-as-possible",
                found=text,
                expected="--camera RECORDING",
            )
        return _class_of(word)(rest, as_fast_as_possible=True)
    return _class_of(word)(rest)


def list_cameras() -> tuple[tuple[FoundCamera, ...], dict[str, str]]:
    """Return the connected cameras, and for each kind of camera whose package is missing the install command."""
    from femsense.core.errors import MissingDependency

    found: list[FoundCamera] = []
    missing: dict[str, str] = {}
    for word in CAMERAS:
        try:
            found += _class_of(word)("").list_devices()
        except MissingDependency as error:
            missing[word] = str(error)
    return tuple(found), missing


def _kind_of_path(path: Path, text: str) -> str:
    if (path / "recording.toml").is_file():
        return "recording"
    if path.is_dir():
        return "folder"
    if path.suffix == ".mcap":
        return "mcap"
    raise InputError(
        "no such source of frames",
        where="--camera",
        found=text,
        expected=", ".join(f"{word}:…" for word in SOURCES) + ", or the folder of a recording",
        hint=did_you_mean(text.partition(":")[0], tuple(SOURCES)),
    )


def _class_of(word: str) -> Callable[..., FrameSource]:
    module, _, name = SOURCES[word].partition(":")
    made: Callable[..., FrameSource] = getattr(importlib.import_module(module), name)
    return made
