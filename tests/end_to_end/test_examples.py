"""The examples run, and what they show is true."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import femsense as fs
from femsense.io.robot_toml import robot_names
from femsense.model.effects import build_entry, load_own_effect

EXAMPLES = Path(fs.__file__).parents[1] / "examples"
DEMO = robot_names()["four-leg"] / "recordings" / "demo" if "four-leg" in robot_names() else Path("nowhere")


def load(name: str) -> ModuleType:
    """Return an example as a module; what stands under its `__main__` does not run."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_equilibrium() -> None:
    example = load("equilibrium")
    assert example.pulled.status == "converged" and example.pulled.residual_n < 1e-6
    assert example.pulled.tension == {"north": 1.0, "west": 0.5, "south": 0.0, "east": 0.0}
    W = example.W
    np.testing.assert_allclose(W, W.T, rtol=1e-6, atol=1e-9)
    body = example.robot.body
    nodal = np.zeros_like(body.mesh.nodes)
    nodal[body.mesh.nodes[:, 2].argmax()] = 0.01 * example.force
    pushed = fs.solve_equilibrium(body, tension={"north": 1.0, "west": 0.5}, nodal_forces=nodal, start=example.pulled)
    moved = (pushed.positions - example.pulled.positions)[body.mesh.nodes[:, 2].argmax()]
    np.testing.assert_allclose(moved, 0.01 * example.sag, rtol=0.02, atol=1e-7)


@pytest.mark.skipif(not DEMO.is_dir(), reason="the recording that comes along is not here")
def test_forces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = load("forces")
    example.main(tmp_path / "out")
    assert "calibration: converged" in capsys.readouterr().out
    run = fs.read_run(tmp_path / "out")
    assert [frame.frame for frame in run.frames] == list(example.FRAMES)
    assert all(frame.status.startswith(("ok", "contact, size not determined")) for frame in run.frames)
    assert {contact.frame for contact in run.contacts} == set(example.FRAMES[-2:])
    assert (tmp_path / "out" / "robot.glb").read_bytes()[:4] == b"glTF"


def test_reach() -> None:
    example = load("reach")
    assert example.near.status == "reached" and example.near.error_m < 1e-9
    assert example.far.status == "nearest" and example.far.limits and example.far.error_m > 0.1


def test_proprioception() -> None:
    example = load("proprioception")
    assert example.model.report["error_mm"] < 0.5 and len(example.pose.bones) == 6
    assert {item.channel for item in example.strange.outside} <= {"outer", "inner"} and example.strange.outside
    assert not example.pose.outside and example.found.verdict == "base moved"
    assert example.found.shift_mm == pytest.approx(np.hypot(5.0, 2.0), abs=0.5)
    assert example.mended.report["adapted"]["by"] == "base" and example.mended.report["adapted"]["error_mm"] < 0.6


def test_magnet() -> None:
    effect = load_own_effect(EXAMPLES / "magnet.py")
    robot = fs.load_robot("four-leg")
    seed = effect.seeds(robot)[0]
    entry = build_entry(effect.parameters(robot, "tension"), [0.0, 0.1, -0.2], seed)
    pulled = effect.apply(robot, entry)
    np.testing.assert_allclose((pulled.body.dead_forces - robot.body.dead_forces).sum(axis=0), [0.0, 0.1, -0.2], atol=1e-12)
    assert effect.lacks == "a magnet beside the tip" and len(effect.seeds(robot)) == 2


def test_every_example_is_tested() -> None:
    tested = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert {path.stem for path in EXAMPLES.glob("*.py")} <= tested
