"""Many jobs on workers of dask: as on processes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
from many_calls import job, work

from femsense.core.errors import DataError, InputError
from femsense.many.drive import run_jobs
from femsense.many.engines import open_engine
from femsense.many.limits import ONE_THREAD
from femsense.many.outcome import JobStatus


def test_a_local_cluster_sets_aside_what_kills_its_workers(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "bad", "die"), *(job(tmp_path, f"good-{i}", "write") for i in range(6))]
    jobs += [job(tmp_path, "threads", "environment", *ONE_THREAD)]
    with open_engine(2, "local", 2_000_000_000) as engine:
        found = run_jobs(jobs, work, engine)
    assert (found[0].status, found[0].deaths) == (JobStatus.CRASHED, 2)
    assert all(o.is_good and o.deaths == 0 for o in found[1:])  # one whose answer died with its worker is found and kept
    assert (tmp_path / "out/threads/result.txt").read_text().split("\n") == ["1"] * len(ONE_THREAD)


@pytest.mark.parametrize("where", ["tcp://127.0.0.1:9", "no-such-scheduler.json"])
def test_a_scheduler_that_does_not_answer_is_bad_input(where: str, tmp_path: Path) -> None:
    place = str(tmp_path / where) if where.endswith("json") else where
    with pytest.raises(InputError, match="no dask scheduler answers"), open_engine(None, place, None):
        pass


@pytest.mark.parametrize(
    ("text", "found"), [("jobqueue: {}\n", "none"), ("jobqueue: {slurm: {}, pbs: {}}\n", "slurm, pbs"), ("- 1\n", "none")]
)
def test_a_file_declares_one_cluster_of_dask_jobqueue(text: str, found: str, tmp_path: Path) -> None:
    file = tmp_path / "cluster.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"found:    {found}\n  expected: one of .*slurm"), open_engine(None, str(file), None):
        pass


def test_a_lifetime_that_would_end_each_worker_at_once_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "cluster.yaml"
    file.write_text("jobqueue: {slurm: {worker-extra-args: [--lifetime, 3h50m]}}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"--lifetime: not a duration\n  found:    3h50m"), open_engine(2, str(file), None):
        pass


def test_a_scheduler_that_dies_ends_the_run_and_keeps_what_is_done(tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *words], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 30
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        with open_engine(None, str(file), None) as engine:
            ends = scheduler.kill
            with pytest.raises(DataError, match="same command continues"):
                run_jobs([job(tmp_path, "a", "write")], work, engine, progress=lambda now: ends())
    finally:
        scheduler.kill()
        scheduler.wait()
