"""Many jobs on an engine: what is there is kept, what fails is told with its kind, and what kills its workers is set aside."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import many_calls
import pytest
from many_calls import job, said, work, work_here

from femsense.core.errors import DataError
from femsense.many.drive import Progress, recorded, run_jobs
from femsense.many.engines import InProcess, processes, spread
from femsense.many.limits import ONE_THREAD
from femsense.many.outcome import JobStatus
from femsense.many.records import log_of, running_mark


def test_a_second_call_runs_nothing_and_one_with_another_input_runs_that_job(tmp_path: Path) -> None:
    jobs = [job(tmp_path, name, "write") for name in ("a", "b", "c")]
    first = run_jobs(jobs, work_here, InProcess())
    assert [(o.name, o.status) for o in first] == [(name, JobStatus.DONE) for name in "abc"]
    assert set(recorded(jobs)) == {"a", "b", "c"}
    (tmp_path / "input/b").write_text("other", encoding="utf-8")
    assert set(recorded(jobs)) == {"a", "c"}
    second = run_jobs(jobs, work_here, InProcess())
    assert [o.status for o in second] == [JobStatus.KEPT, JobStatus.DONE, JobStatus.KEPT]
    assert (tmp_path / "out/b/result.txt").read_text() == "OTHER"


def test_a_copy_of_the_input_with_other_times_is_read_and_its_result_kept(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "write")]
    run_jobs(jobs, work_here, InProcess())
    os.utime(tmp_path / "input/a", (1, 1))
    assert not recorded(jobs)
    assert [o.status for o in run_jobs(jobs, work_here, InProcess())] == [JobStatus.KEPT]
    assert set(recorded(jobs)) == {"a"}


@pytest.mark.parametrize("spoil", ["remove", "cut"])
def test_a_result_that_is_not_whole_is_made_again(tmp_path: Path, spoil: str) -> None:
    jobs = [job(tmp_path, "a", "write")]
    run_jobs(jobs, work_here, InProcess())
    result = tmp_path / "out/a/result.txt"
    result.unlink() if spoil == "remove" else result.write_text("")
    assert [o.status for o in run_jobs(jobs, work_here, InProcess())] == [JobStatus.DONE]
    assert result.read_text() == "A"


def test_what_was_added_beside_a_result_does_not_count(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "write")]
    run_jobs(jobs, work_here, InProcess())
    (tmp_path / "out/a/report.html").write_text("later")
    assert set(recorded(jobs)) == {"a"}


def test_again_runs_everything(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "write")]
    run_jobs(jobs, work_here, InProcess())
    assert [o.status for o in run_jobs(jobs, work_here, InProcess(), again=True)] == [JobStatus.DONE]


def test_each_failure_has_its_kind_and_a_rerun_tries_it_again(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "refuse"), job(tmp_path, "b", "misread"), job(tmp_path, "c", "write")]
    for _ in range(2):
        found = run_jobs(jobs, work_here, InProcess())
        assert [o.status for o in found[:2]] == [JobStatus.NO_RESULT, JobStatus.FAILED] and found[2].is_good
        assert found[0].reason == "too few markers" and "no such file" in found[1].reason


def test_a_full_disk_ends_the_run_and_says_what_is_done(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "write"), job(tmp_path, "b", "fill"), job(tmp_path, "c", "write")]
    with pytest.raises(DataError, match=r"the disk is full: OSError: .*No space left.*\n1 of 3 jobs are done; make room"):
        run_jobs(jobs, work_here, InProcess())
    assert set(recorded(jobs)) == {"a"}


def test_progress_says_how_far_it_is(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "write"), job(tmp_path, "b", "refuse"), job(tmp_path, "c", "wait", "0.2")]
    said = list[Progress]()
    run_jobs(jobs, work_here, InProcess(), progress=said.append)
    last = said[-1]
    assert (last.total, last.finished, last.failed, last.kept, last.running) == (3, 3, 1, 0, 0)
    assert last.slowest is not None and last.slowest.name == "c" and last.seconds_left == 0.0


# Processes


def test_a_job_that_kills_its_worker_twice_is_set_aside_and_the_others_go_on(tmp_path: Path) -> None:
    jobs = [
        job(tmp_path, "a", "write"),
        job(tmp_path, "bad", "die"),
        job(tmp_path, "worse", "abort"),
        job(tmp_path, "b", "write"),
    ]
    with processes(2) as engine:
        found = {o.name: o for o in run_jobs(jobs, work, engine)}
    assert found["a"].is_good and found["b"].is_good
    assert (found["bad"].status, found["bad"].deaths) == (JobStatus.CRASHED, 2) and "SIGKILL" in found["bad"].reason
    assert found["worse"].status is JobStatus.CRASHED and "Fatal Python error: Aborted" in found["worse"].reason
    assert log_of(jobs[0]).read_text().startswith("write a") and not list(tmp_path.rglob("*.running"))
    again = run_jobs(jobs, work_here, InProcess())  # it would end this process
    assert [o.status for o in again] == [JobStatus.KEPT, JobStatus.CRASHED, JobStatus.CRASHED, JobStatus.KEPT]


def test_a_job_whose_worker_died_once_is_run_once_more_with_one_thread_in_each_library(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a", "die once"), job(tmp_path, "b", "environment", *ONE_THREAD), job(tmp_path, "eats", "eat")]
    with processes(2) as engine:
        late, told, eats = run_jobs(jobs, work, engine)
    assert (late.status, late.deaths) == (JobStatus.DONE, 1)
    assert told.is_good and (tmp_path / "out/b/result.txt").read_text().split("\n") == ["1"] * len(ONE_THREAD)
    assert eats.status is JobStatus.OUT_OF_MEMORY and eats.deaths == 0 and "--memory" in eats.reason
    assert late.row["pid"] != os.getpid()


DRIVER = """
import sys; sys.path[:0] = {paths!r}
from pathlib import Path
from many_calls import job, work
from femsense.many.drive import run_jobs
from femsense.many.engines import processes
if __name__ == "__main__":
    with processes(1) as engine:
        run_jobs([job(Path({folder!r}), name, "wait", "1.5") for name in "abc"], work, engine)
"""


def test_a_driver_that_is_killed_leaves_no_worker_and_a_second_one_finishes(tmp_path: Path) -> None:
    paths = [str(Path(many_calls.__file__).parent), *sys.path]
    (tmp_path / "driver.py").write_text(DRIVER.format(paths=paths, folder=str(tmp_path)))
    driver = subprocess.Popen([sys.executable, tmp_path / "driver.py"])
    jobs = [job(tmp_path, name, "wait", "1.5") for name in "abc"]
    deadline = time.monotonic() + 60
    while not running_mark(jobs[1]).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    found = run_jobs(jobs, work_here, InProcess())  # waits for the worker that still has b
    assert found[0].status is JobStatus.KEPT and all(o.is_good for o in found)
    assert not list(tmp_path.rglob("*.running"))


def test_parts_that_a_dead_worker_left_are_removed(tmp_path: Path) -> None:
    one = job(tmp_path, "a", "write")
    part = tmp_path / "out/.part-12345678-a"
    part.mkdir(parents=True)
    run_jobs([one], work_here, InProcess())
    assert not part.exists()


# Tasks without records


def test_tasks_are_spread_in_order_and_one_that_loses_its_worker_is_run_once_more(tmp_path: Path) -> None:
    tasks = [(("write", str(tmp_path / f"{i}")),) for i in range(7)]
    tasks[3] = (("die once", str(tmp_path / "3")),)
    with processes(2) as engine:
        assert list(spread(engine, said, tasks)) == [f"{i}" for i in range(7)]
        with pytest.raises(DataError, match="this has ended two workers: its worker was ended by SIGKILL"):
            list(spread(engine, said, [(("die", str(tmp_path / "x")),)]))
    assert list(spread(InProcess(), said, tasks[:2])) == ["0", "1"]
