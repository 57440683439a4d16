"""A search or an estimate that is stopped goes on where it was; what is read back is the package's own."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.app.inspect import inspect_path
from femsense.calib.calibrate import calibrate
from femsense.core.errors import DataError
from femsense.io.checkpoint import DIGEST, Checkpoint
from femsense.loop.improve import ImproveOptions, improve
from femsense.loop.result.loop_result import LoopResult
from femsense.loop.search.search_state import SearchProgress
from femsense.model.effects import FORMS, apply_effects
from femsense.sensing import pipeline
from femsense.sensing.types import Done

HIDDEN = [{"name": "cable_friction", "coefficient": 0.2}]
TIP, FORCE = np.array([0.1, 0.0, 0.01]), np.array([0.01, 0.08, -0.15])
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0], [0.5, 0, 0.3, 0]])
MADE_FROM = {"recordings": [{"sha256": "1"}]}


def search(file: Path | None, progress: Callable[[str], None]) -> LoopResult:
    inputs, labels = sweeps(each=6)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=HIDDEN)
    keep = None if file is None else (file, MADE_FROM)
    return improve(
        arm((4, 1, 1)), [recording], effects=["cable_friction", "gravity"], progress=progress, options=ImproveOptions(keep=keep)
    )


def stop_at(what: str) -> Callable[[str], None]:
    def said(text: str) -> None:
        if text.startswith(what):
            raise KeyboardInterrupt

    return said


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a search that was stopped when it had found one effect; it holds no factors."""
    file = tmp_path_factory.mktemp("stopped") / "loop" / ".unfinished"
    with pytest.raises(KeyboardInterrupt):
        search(file, stop_at("screening effects (1 found"))
    assert 0 < file.stat().st_size < 4e6
    return file


def test_a_search_that_was_stopped_goes_on_where_it_was(stopped: Path, tmp_path: Path):
    file, said = tmp_path / "loop" / ".unfinished", list[str]()
    file.parent.mkdir()
    file.write_bytes(stopped.read_bytes())
    found, whole = search(file, said.append), search(None, lambda text: None)
    assert said[:2] == ["resuming the search (effects found: 1)", "screening effects (1 found so far)"]
    assert found.verdict == whole.verdict and found.sentence == whole.sentence
    assert [e.name for e in found.effects] == [e.name for e in whole.effects] and "cable_friction" in found.sentence
    assert found.after.validation_rms_m == pytest.approx(whole.after.validation_rms_m, rel=1e-4)
    assert not file.parent.exists()


@pytest.mark.parametrize(
    "change", [lambda data: data[: len(data) // 2], lambda data: data[:DIGEST], lambda data: bytes(DIGEST) + data[DIGEST:]]
)
def test_a_file_that_is_cut_off_or_made_from_something_else_is_not_used(
    stopped: Path, tmp_path: Path, change: Callable[[bytes], bytes]
):
    file = tmp_path / ".unfinished"
    file.write_bytes(change(stopped.read_bytes()))
    assert Checkpoint((stopped, MADE_FROM), FORMS).kept(SearchProgress) is not None
    assert Checkpoint((file, MADE_FROM), FORMS).kept(SearchProgress) is None


class Hostile:
    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        self.reduced = call, arguments

    def __reduce__(self) -> Any:
        return self.reduced


@pytest.mark.parametrize("call", [os.mkdir, eval])
def test_a_file_from_elsewhere_runs_nothing(tmp_path: Path, call: Callable[..., Any]):
    made, checkpoint = tmp_path / "made", Checkpoint((tmp_path / ".unfinished", MADE_FROM), FORMS)
    hostile = Hostile(call, str(made) if call is os.mkdir else f"__import__('os').mkdir({str(made)!r})")
    checkpoint.file.write_bytes(checkpoint.made_from + pickle.dumps(hostile))
    assert checkpoint.kept(SearchProgress) is None and not made.exists()
    pickle.loads(pickle.dumps(hostile))
    assert made.exists()  # anyone else would have run it


def test_what_was_left_by_one_that_was_killed_while_it_wrote_goes_at_the_end(tmp_path: Path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / ".part-0a1b-.unfinished").write_bytes(b"half")
    with Checkpoint((folder / ".unfinished", MADE_FROM)) as checkpoint:
        checkpoint.keep(Done())
        assert checkpoint.kept(Done) is not None
    assert not folder.exists()


def test_an_error_that_would_come_again_leaves_nothing(tmp_path: Path):
    file, there = tmp_path / "loop" / ".unfinished", list[bool]()

    def fail(text: str) -> None:
        there.append(file.exists())
        if there[-1]:
            raise DataError("no equilibrium")

    with pytest.raises(DataError):
        search(file, fail)
    assert there[-1]
    assert not (tmp_path / "loop").exists()


def test_a_folder_that_holds_unfinished_work_says_so(stopped: Path):
    report = inspect_path(stopped.parent)
    assert report["kind"] == "unfinished" and "run the same command again: it goes on" in report["problems"][0]


def test_an_estimate_that_was_stopped_goes_on_at_the_next_frame(tmp_path: Path):
    rubbing = apply_effects(arm((4, 1, 1)), HIDDEN)  # each state needs the one before
    recording, _ = record(INPUTS, noise=1e-4, forces={2: (TIP, FORCE), 3: (TIP, 2 * FORCE)}, truth=rubbing)
    calibration, keep = calibrate(rubbing, recording), (tmp_path / "run" / ".unfinished", MADE_FROM)
    asked = list[int]()

    def stop(done: int, count: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.estimate(rubbing, recording, calibration, at=TIP, keep=keep, keep_every_s=0.0, progress=stop)
    run = pipeline.estimate(rubbing, recording, calibration, at=TIP, keep=keep, progress=lambda done, count: asked.append(done))
    whole = pipeline.estimate(rubbing, recording, calibration, at=TIP)
    assert asked == [4] and not keep[0].exists() and [f.status for f in run.frames] == [f.status for f in whole.frames]
    np.testing.assert_allclose([c.force_n_xyz for c in run.contacts], [c.force_n_xyz for c in whole.contacts], atol=1e-5)
    np.testing.assert_allclose(run.states.nodes_m, whole.states.nodes_m, atol=1e-7)
