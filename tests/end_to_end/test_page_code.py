"""The complete examples of the pages run, and their results are right."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import ROOT

import femsense as fs
from femsense.io.robot_toml import robot_names
from femsense.model.effects import build_entry, load_own_effect

DOCS = ROOT / "docs"
DEMO = robot_names()["four-leg"] / "recordings" / "demo" if "four-leg" in robot_names() else Path("nowhere")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def code_of(page: str, words: str) -> str:
    """Return the block of Python in a page that contains some words."""
    (block,) = [block for block in BLOCK.findall((DOCS / page).read_text(encoding="utf-8")) if words in block]
    return block


def run_block(page: str, words: str) -> dict[str, Any]:
    """Run that block and return its names."""
    known: dict[str, Any] = {}
    exec(compile(code_of(page, words), page, "exec"), known)  # a page of this repository
    return known


def test_equilibrium() -> None:
    known = run_block("method/equilibrium.md", "relaxed = ")
    pulled, W, body = known["pulled"], known["W"], known["robot"].body
    assert pulled.status == "converged" and pulled.residual_n < 1e-6
    assert pulled.tension == {"north": 1.0, "west": 0.5, "south": 0.0, "east": 0.0}
    np.testing.assert_allclose(W, W.T, rtol=1e-6, atol=1e-9)
    top = body.mesh.nodes[:, 2].argmax()
    nodal = np.zeros_like(body.mesh.nodes)
    nodal[top] = 0.01 * known["force"]
    pushed = fs.solve_equilibrium(body, tension={"north": 1.0, "west": 0.5}, nodal_forces=nodal, start=pulled)
    moved = (pushed.positions - pulled.positions)[top]
    np.testing.assert_allclose(moved, 0.01 * known["displacement"], rtol=0.02, atol=1e-7)


@pytest.mark.skipif(not DEMO.is_dir(), reason="the recording of the package is not here")
def test_forces(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_block("guides/sense.md", "fs.write_run")
    assert "calibration: converged" in capsys.readouterr().out
    run = fs.read_run(tmp_path / "demo-run")
    assert [frame.frame for frame in run.frames] == [*range(0, 37, 4), 38, 39]
    assert all(frame.status.startswith(("ok", "contact, size not determined")) for frame in run.frames)
    assert {contact.frame for contact in run.contacts} == {38, 39}
    assert (tmp_path / "demo-run" / "robot.glb").read_bytes()[:4] == b"glTF"


def test_reach() -> None:
    known = run_block("guides/reaching.md", "far = fs.reach")
    assert known["near"].status == "reached" and known["near"].error_m < 1e-9
    assert known["far"].status == "nearest" and known["far"].limits and known["far"].error_m > 0.1


def test_proprioception() -> None:
    known = run_block("guides/proprioception.md", "def record(")
    assert known["model"].report["error_mm"] < 0.5 and len(known["pose"].bones) == 6
    assert {item.channel for item in known["strange"].outside} <= {"outer", "inner"} and known["strange"].outside
    assert not known["pose"].outside and known["found"].verdict == "base moved"
    assert known["found"].shift_mm == pytest.approx(np.hypot(5.0, 2.0), abs=0.5)
    assert known["mended"].report["adapted"]["by"] == "base" and known["mended"].report["adapted"]["error_mm"] < 0.6


def test_magnet(tmp_path: Path) -> None:
    (tmp_path / "magnet.py").write_text(code_of("effects/own.md", "def forces("), encoding="utf-8")
    effect = load_own_effect(tmp_path / "magnet.py")
    robot = fs.load_robot("four-leg")
    seed = effect.seeds(robot)[0]
    entry = build_entry(effect.parameters(robot, "tension"), [0.0, 0.1, -0.2], seed)
    pulled = effect.apply(robot, entry)
    np.testing.assert_allclose((pulled.body.dead_forces - robot.body.dead_forces).sum(axis=0), [0.0, 0.1, -0.2], atol=1e-12)
    assert effect.lacks == "a magnet next to the tip" and len(effect.seeds(robot)) == 2
