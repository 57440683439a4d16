"""How far a long computation has come, kept in a file: one that is killed goes on there.

The file is a pickle, of which only numbers and the package's own data are read back,
so that a folder from elsewhere runs nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, TypeVar

from femsense.core.errors import FemsenseError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.linalg.symbolic import Analysis, Pool
from femsense.fem.stencil import FreeMap
from femsense.io.files import PART_PREFIX, json_text, write_beside
from femsense.model.effects import Effect

Progress = TypeVar("Progress")
UNFINISHED = ".unfinished"
"""Name of the file, in the folder of the results."""
NUMPY = ("ndarray", "dtype", "scalar", "_reconstruct", "_frombuffer")
PATHS = ("Path", "PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath")
DIGEST = 32
"""Number of bytes at the beginning of the file that identify the inputs of the computation."""
NEEDLESS: dict[type, tuple[str, Callable[[], Any]]] = {
    Equilibrium: ("factor", lambda: None),
    Analysis: ("pool", Pool),
    FreeMap: ("laplacian", list),
}
"""Large objects that are quickly recomputed and therefore not stored: factorisations and work memory."""
UNREADABLE = (OSError, EOFError, ValueError, TypeError, LookupError, AttributeError, ImportError, pickle.UnpicklingError)
"""Exceptions raised by a truncated file, or by one of another version."""


class Checkpoint:
    """Stores the progress of a computation, if a file is given. If storing or reading fails, the computation starts from the beginning."""

    def __init__(self, where: tuple[str | Path, Mapping[str, Any]] | None, effects: Sequence[Effect] = ()) -> None:
        """where: the file, and the inputs of the computation. effects: all that it may refer to; they are not written."""
        self.file = None if where is None else Path(where[0])
        self.made_from = b"" if where is None else hashlib.sha256(json_text(where[1]).encode()).digest()
        self.effects = effects
        self.last = time.monotonic()

    def keep(self, course: object, *, every: float = 0.0) -> None:
        """Write the progress of a computation, at most once in `every` seconds."""
        if self.file is None or time.monotonic() < self.last + every:
            return
        with (
            contextlib.suppress(OSError, TypeError, pickle.PicklingError),
            write_beside(self.file) as part,
            part.open("wb") as stream,
        ):
            stream.write(self.made_from)
            _Writer(stream, self.effects).dump(course)
        self.last = time.monotonic()

    def kept(self, kind: type[Progress]) -> Progress | None:
        """Return how far a computation came that is made from the same; None where there is none, or none that can be read."""
        if self.file is None:
            return None
        try:
            with self.file.open("rb") as stream:
                if stream.read(DIGEST) != self.made_from:
                    return None
                course = _Reader(stream, self.effects).load()
        except UNREADABLE:
            return None
        return course if isinstance(course, kind) else None

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Remove the file, and its folder if empty, after a result or a reproducible error.

        Unfinished files of a killed computation are removed too.
        """
        if self.file is not None and (error is None or isinstance(error, FemsenseError)):
            with contextlib.suppress(OSError):
                for file in (self.file, *self.file.parent.glob(f"{PART_PREFIX}*-{self.file.name}")):
                    file.unlink(missing_ok=True)
                self.file.parent.rmdir()


class _Writer(pickle.Pickler):
    def __init__(self, stream: BinaryIO, effects: Sequence[Effect]) -> None:
        super().__init__(stream, protocol=5)
        self.number = {id(effect): i for i, effect in enumerate(effects)}

    def persistent_id(self, thing: Any) -> int | None:
        if not isinstance(thing, Effect):
            return None
        if id(thing) not in self.number:
            raise pickle.PicklingError(f"{thing.name} is none of the effects")
        return self.number[id(thing)]

    def reducer_override(self, thing: Any) -> Any:
        if type(thing) not in NEEDLESS:
            return NotImplemented
        name, nothing = NEEDLESS[type(thing)]
        return replace(thing, **{name: nothing()}).__reduce_ex__(pickle.HIGHEST_PROTOCOL)


class _Reader(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, effects: Sequence[Effect]) -> None:
        super().__init__(stream)
        self.effects = effects

    def persistent_load(self, number: Any) -> Effect:
        return self.effects[int(number)]

    def find_class(self, module: str, name: str) -> Any:
        package = module.split(".")[0]
        if (package == "numpy" and name in NUMPY) or (package == "pathlib" and name in PATHS):
            return super().find_class(module, name)
        if package == "femsense":
            found = super().find_class(module, name)
            if isinstance(found, type) and (is_dataclass(found) or module.startswith("femsense.fem.")):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is no part of a computation")
