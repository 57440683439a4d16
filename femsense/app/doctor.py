"""Checks of this installation, each with the line that mends it."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import pickle
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import femsense
from femsense.core.packages import installed_version
from femsense.core.parallel import available_cores
from femsense.core.text import with_type

PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "numba": "numba",
    "pydantic": "pydantic",
    "typer": "typer",
    "rich": "rich",
    "tomli_w": "tomli-w",
    "meshio": "meshio",
    "pypcd4": "pypcd4",
    "qpsolvers": "qpsolvers",
    "daqp": "daqp",
    "onnx": "onnx",
    "osqp": "osqp",
    "matplotlib": "matplotlib",
    "cv2": "opencv-python-headless",
    "trimesh": "trimesh",
    "open3d": "open3d-cpu",
}
"""Module → the package that has it."""
LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libgomp.so.1": "libgomp1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
}
"""Library that Open3D is linked to on Linux → its Debian package."""
OTHER_LIBRARIES = {"libusb-1.0.so.0": "libusb-1.0-0", "libEGL.so.1": "libegl1", "libglib-2.0.so.0": "libglib2.0-0"}
"""Libraries of other versions of it."""
LITTLE_MEMORY_GB = 2.0
SMALL_RESIDUAL_N = 1e-6
FEW_KERNELS = 50
"""Functions: an installation brings 59, and the tiny solve alone leaves 31."""


class Level(StrEnum):
    """How serious a finding is."""

    OK = "ok"
    WARNING = "warning"
    """Something is slower, or missing and not always needed."""
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check."""

    level: Level
    found: str
    hint: str | None = None
    """The remedy."""


def good(found: str) -> Finding:
    """Return the finding of a check that passes."""
    return Finding(Level.OK, found)


def note(found: str, hint: str) -> Finding:
    """Return a finding that is slower or lacks something, with its remedy."""
    return Finding(Level.WARNING, found, hint)


def bad(found: str, hint: str) -> Finding:
    """Return a finding that keeps femsense from working, with its remedy."""
    return Finding(Level.ERROR, found, hint)


def diagnose(packages: Mapping[str, str] = PACKAGES) -> dict[str, Any]:
    """Check this installation.

    Arguments:
        packages: required modules, and their names on PyPI.

    Returns:
        `ok` (no check has the level "error") and `checks`, each `{name, level, found, hint}`.
    """
    findings = {"python": _python(), **{module: _package(module, package) for module, package in packages.items()}}
    findings |= {name: _guarded(part) for name, part in PARTS.items()}
    checks = [{"name": name, **asdict(finding)} for name, finding in findings.items()]
    return {"ok": all(finding.level is not Level.ERROR for finding in findings.values()), "checks": checks}


def doctor_text(document: dict[str, Any]) -> str:
    """Return the findings of `diagnose` as a table."""
    marks = {Level.OK: "ok", Level.WARNING: "note", Level.ERROR: "BAD"}
    width = max(len(check["name"]) for check in document["checks"])
    lines = []
    for check in document["checks"]:
        lines.append(f"{marks[check['level']]:<4}  {check['name']:<{width}}  {check['found']}")
        if check["hint"]:
            lines.append(f"{'':<{width + 8}}→ {check['hint']}")
    bad = sum(check["level"] == Level.ERROR for check in document["checks"])
    lines += ["", "everything that is needed works" if not bad else f"{bad} checks failed: femsense will not work fully"]
    return "\n".join(lines)


def _guarded(part: Callable[[], Finding]) -> Finding:
    """Return the finding of a check; one that fails in itself is an error, not a crash."""
    try:
        return part()
    except Exception as error:  # a broken installation may fail in any way
        return bad(with_type(error), "reinstall: pip install --force-reinstall femsense")


def _python() -> Finding:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    known = (3, 11) <= sys.version_info[:2] <= (3, 12)
    return good(found) if known else bad(found, "femsense runs on Python 3.11 and 3.12")


def _package(module: str, package: str) -> Finding:
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # OSError, ImportError, and errors of a broken binary
        return bad(with_type(error), import_hint(str(error), package))
    return good(installed_version(package) or str(getattr(loaded, "__version__", "version not known")))


def import_hint(message: str, package: str) -> str:
    """Return the remedy for an import that failed with this message: a package of the system, or of pip."""
    library = re.search(r"(lib[\w.+-]+\.so(?:\.\d+)*)", message)
    debian = {**LIBRARIES, **OTHER_LIBRARIES}.get(library.group(1)) if library else None
    if debian is not None:
        return f"a system library is missing: apt-get install {debian}"
    return f"pip install {package}"


def _tetrahedra() -> Finding:
    """pytetwild runs in a process of its own and is not loaded here."""
    if importlib.util.find_spec("pytetwild") is None:
        return note("not installed: surfaces cannot become tetrahedra", "pip install pytetwild")
    return good(installed_version("pytetwild") or "version not known")


def _libraries() -> Finding:
    if not sys.platform.startswith("linux"):
        return good("only checked on Linux")
    missing = {library: package for library, package in LIBRARIES.items() if not _loads(library)}
    if not missing:
        return good("all that Open3D wants")
    return bad("missing: " + ", ".join(missing), "apt-get install " + " ".join(missing.values()))


def _solver() -> Finding:
    chosen = os.environ.get("FEMSENSE_SOLVER", "").lower()
    if chosen in ("", "direct"):
        return good("Cholesky of femsense, with the BLAS of SciPy")
    if chosen == "iterative":
        return note("conjugate gradients", "FEMSENSE_SOLVER=iterative asks for them: they save memory, not time")
    if chosen == "superlu":
        return note("SuperLU of SciPy", "FEMSENSE_SOLVER=superlu asks for it: it is slower than the own solver")
    return bad(f"FEMSENSE_SOLVER={chosen} is not known", "direct, iterative or superlu")


def _viewer() -> Finding:
    from femsense.xr.view import PAGE

    if not (PAGE / "index.html").is_file():
        hint = "pip install . (in a checkout: pip install -e .)"
        return note("not built into this installation: femsense view will not work", hint)
    size = sum(file.stat().st_size for file in PAGE.iterdir() if file.is_file())
    return good(f"{size / 1e3:.0f} kB")


def _robots() -> Finding:
    from femsense.io.robot_toml import robot_names

    names = ", ".join(robot_names())
    return good(names) if names else note("none", "reinstall femsense")


def _numba_cache() -> Finding:
    """Compiled kernels are kept in __pycache__, in NUMBA_CACHE_DIR, or in the user's cache folder."""
    package = Path(femsense.__file__).parent / "fem"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(chosen)] if chosen else [package / "__pycache__", package, Path.home() / ".cache"]
    if any(place.is_dir() and _writable(place) for place in places):
        return good("can be written")
    return note("no writable folder: kernels are compiled at each start", "set NUMBA_CACHE_DIR to a folder of your own")


def _kernels() -> Finding:
    """Kernels of calibrate and estimate come along compiled, if the build could run them;
    each is a file where numba looks for it."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    found = [_kernel_version(file) for file in Path(chosen or Path(femsense.__file__).parent).rglob("*.nbi")]
    mine = found.count(installed_version("numba"))
    if mine >= FEW_KERNELS:
        return good(f"{mine} functions are compiled")
    other = f", and {len(found) - mine} by another version of numba" if mine < len(found) else ""
    text = f"{mine} functions are compiled{other}: the first calibrate and estimate compile for up to a minute each"
    reinstall = "pip install --force-reinstall --no-deps -v femsense says why"
    return note(text, "NUMBA_CACHE_DIR hides those that came along" if chosen else reinstall)


def _kernel_version(index: Path) -> object:
    """Return the version of numba that wrote an index of compiled code: its first entry."""
    with index.open("rb") as file:
        return pickle.load(file)


def _tiny_solve() -> Finding:
    """Let a soft cube hang by one face: the equilibrium certifies itself by its residual, and the weight must be carried."""
    import numpy as np

    from femsense.fem.blocks import block_mesh
    from femsense.fem.body import make_body
    from femsense.fem.equilibrium import solve_equilibrium

    mesh = block_mesh([[0.0, 0.05]] * 3)
    body = make_body(
        mesh,
        young_modulus=1e5,
        poisson_ratio=0.45,
        density=1000.0,
        clamped=np.flatnonzero(mesh.nodes[:, 2] > 0.04),
        gravity=(0.0, 0.0, -9.81),
    )
    state = solve_equilibrium(body)
    sag = 1e3 * float((mesh.nodes - state.positions)[:, 2].max())
    found = f"{state.status}, residual {state.residual_n:.1e} N, sag {sag:.3f} mm"
    solved = state.status == "converged" and state.residual_n < SMALL_RESIDUAL_N and 0.01 < sag < 1.0
    return good(found) if solved else bad(found, "reinstall: pip install --force-reinstall femsense")


def _machine() -> Finding:
    free = _free_memory_gb()
    text = f"{available_cores()} cores" + ("" if free is None else f", {free:.1f} GB of memory free")
    if free is not None and free < LITTLE_MEMORY_GB:
        return note(text, f"large meshes want more than {LITTLE_MEMORY_GB:g} GB")
    return good(text)


PARTS: dict[str, Callable[[], Finding]] = {
    "pytetwild": _tetrahedra,
    "system libraries": _libraries,
    "linear solver": _solver,
    "viewer page": _viewer,
    "robots of the package": _robots,
    "cache of compiled kernels": _numba_cache,
    "compiled kernels": _kernels,
    "a tiny solve": _tiny_solve,
    "machine": _machine,
}
"""Name of a check → the check."""


def _free_memory_gb() -> float | None:
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(r"MemAvailable:\s+(\d+) kB", text)
    return int(found.group(1)) / 1e6 if found else None


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
