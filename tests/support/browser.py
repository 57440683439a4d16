"""A headless browser, driven by playwright, and the page as the build hook makes it."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from glb import ROOT, build_hook, npm_folder

VIEWER = ROOT / "femsense" / "xr" / "viewer"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
HEAD = """
const { chromium } = require('playwright-core');
const [browser, ...given] = process.argv.slice(2);
const args = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-quic',
  '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync'];
(async () => {
const opened = await chromium.launch({ executablePath: browser, args });
"""
TAIL = "\n})().catch((e) => { console.error(e); process.exit(1); });"


def page_folder(config: pytest.Config) -> Path:
    """The bundle as the build hook makes it, kept between runs for the same sources. Skips where it cannot be built."""
    hook = build_hook()
    digest = hook.digest_of(VIEWER)
    kept = config.cache.mkdir("viewer-page")
    stamp = kept / "dist" / ".sources"
    if not (stamp.is_file() and stamp.read_text() == digest):
        for name in hook.SOURCES:
            source = VIEWER / name
            shutil.copytree(source, kept / name, dirs_exist_ok=True) if source.is_dir() else shutil.copy(source, kept / name)
        try:
            hook.build_page(kept, digest)
        except RuntimeError as error:
            pytest.skip(f"the page cannot be built here: {error}")
    return kept / "dist"


def start_browser(config: pytest.Config, script: str, *given: str) -> subprocess.Popen[str]:
    """Start a script in which `opened` is a browser and `given` the arguments; what it logs is on standard output."""
    packages = npm_folder(config.cache.mkdir("playwright"), "playwright-core@1.65.1")
    file = packages / "look.cjs"
    file.write_text(HEAD + script + TAIL, encoding="utf-8")
    command = [*build_hook().node_command(), str(file), str(CHROMIUM), *given]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def said(browser: subprocess.Popen[str]) -> Any:
    """Return what a script logs next."""
    assert browser.stdout is not None
    line = browser.stdout.readline()
    assert line, browser.stderr.read() if browser.stderr else ""
    return json.loads(line)


def go_on(browser: subprocess.Popen[str]) -> None:
    """Tell a script that waits for a line to go on."""
    assert browser.stdin is not None
    browser.stdin.write("go\n")
    browser.stdin.flush()


def run_in_browser(config: pytest.Config, script: str, *given: str) -> dict[str, Any]:
    """Return the object that a script logs last."""
    process = start_browser(config, script, *given)
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    found: dict[str, Any] = json.loads(out.splitlines()[-1])
    return found
