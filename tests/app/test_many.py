"""One command on many recordings, as a user types it."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from helpers import write_block_robot
from rig_scripts import SCRIPT

from femsense.app import cli
from femsense.app.many_command import progress_text
from femsense.io.files import folder_hash
from femsense.io.folder_lock import only_writer
from femsense.many.drive import Progress

IN_PROCESS = ("--workers", 0)


class Said:
    """What a command said."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Any:
    """Run a command in this process."""

    def run_command(*words: object) -> Said:
        capfd.readouterr()
        status = cli.run([str(word) for word in words])
        return Said(status, *capfd.readouterr())

    return run_command


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A robot, two scripts, and the recordings of these."""
    write_block_robot(tmp_path / "robot", cells=(3, 1, 1))
    (tmp_path / "scripts").mkdir()
    for name, dt in (("a", 0.5), ("b", 0.6)):
        (tmp_path / f"scripts/{name}.toml").write_text(tomli_w.dumps({**SCRIPT, "dt_s": dt}), encoding="utf-8")
    assert (
        cli.run(
            [
                "simulate",
                str(tmp_path / "robot"),
                str(tmp_path / "scripts/*.toml"),
                "-o",
                str(tmp_path / "recordings"),
                "--workers",
                "0",
            ]
        )
        == 0
    )
    return tmp_path


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_from_scripts_to_forces_with_one_table_and_a_second_run_that_does_nothing(run: Any, lab: Path) -> None:
    robot, recordings = lab / "robot", lab / "recordings"
    said = run("calibrate", robot, recordings, "-o", lab / "cal", *IN_PROCESS, "--json")
    assert said.status == 0 and said.json["counts"] == {"done": 2} and [j["name"] for j in said.json["jobs"]] == ["a", "b"]
    words = ("estimate", robot, *sorted(recordings.glob("*")), "-c", lab / "cal", "--at", "0.1,0.015,0.015", "-o", lab / "runs")
    assert run(*words, *IN_PROCESS).status == 0
    assert [row["name"] for row in rows_of(lab / "runs")] == ["a", "b"] and float(
        rows_of(lab / "runs")[0]["largest_force_n"]
    ) > 0.05
    said = run("inspect", lab / "runs")
    assert said.status == 0 and "the results of many recordings" in said.out and "done  2" in said.out
    assert json.loads((lab / "runs/a/run.json").read_text())["inputs"]["calibration"]
    before = (lab / "runs/summary.csv").read_bytes()
    said = run(*words, *IN_PROCESS)
    assert "2 were there" in said.out and (lab / "runs/summary.csv").read_bytes() == before
    assert run("report", lab / "runs", *IN_PROCESS).status == 0
    assert "a/report.html" in (lab / "runs/summary.html").read_text() and len(rows_of(lab / "runs")) == 2
    assert "2 were there" in run(*words, *IN_PROCESS).out
    shutil.copytree(lab / "runs/a", lab / "sessions/live/run", ignore=shutil.ignore_patterns("report.html"))
    (lab / "sessions/live/session.json").write_text("{}")
    asked = ("report", "--jobs", lab / "sessions/*", *IN_PROCESS)
    assert "1 done" in run(*asked).out and (lab / "sessions/live/run/report.html").is_file()
    assert "1 were there" in run(*asked).out
    (lab / "cal/b/calibration.json").unlink()
    said = run(
        "estimate", robot, recordings, "-c", lab / "cal", "--at", "0.1,0.015,0.015", "-o", lab / "again", *IN_PROCESS, "--json"
    )
    assert said.status == 1 and "summary.csv states why" in said.json["jobs"][1]["reason"]


def test_processes_make_the_same_bytes(run: Any, lab: Path) -> None:
    assert run("simulate", lab / "robot", lab / "scripts/*.toml", "-o", lab / "spread", "--workers", 2).status == 0
    assert folder_hash(lab / "spread/b") == folder_hash(lab / "recordings/b")


def test_a_table_says_robot_recording_and_options(run: Any, lab: Path) -> None:
    (lab / "robot").rename(lab / "beam")
    lines = ["robot,recording,name,at,push", "beam,recordings/a,first,,", 'beam,recordings/b,second,"0.1,0.015,0.015",yes']
    (lab / "jobs.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    said = run("estimate", "--jobs", lab / "jobs.csv", "-o", lab / "runs", *IN_PROCESS, "--json")
    same = run("calibrate", "--jobs", lab / "jobs.csv", "-o", lab / "cal", *IN_PROCESS)
    assert same.status == 0, same.err
    first, second = said.json["jobs"]
    assert (
        said.status == 1
        and (first["name"], first["status"]) == ("first", "failed")
        and "no clouds, and no place" in first["reason"]
    )
    assert (second["name"], second["status"]) == ("second", "done") and (lab / "runs/second/run.json").is_file()


def test_a_joint_question_of_each_row(run: Any, lab: Path) -> None:
    (lab / "jobs.csv").write_text("name,recording,effects\nboth,recordings/a recordings/b,stiffness\n", encoding="utf-8")
    said = run("improve", lab / "robot", "--jobs", lab / "jobs.csv", "-o", lab / "out", *IN_PROCESS, "--json")
    assert said.status == 0, said.out
    assert said.json["jobs"][0]["verdict"] in ("none", "effects", "unexplained")
    assert len(json.loads((lab / "out/both/loop.json").read_text())["inputs"]["recordings"]) == 2


def test_improve_works_in_this_process_alone_and_takes_a_folder_of_recordings(run: Any, lab: Path) -> None:
    said = run("improve", lab / "robot", lab / "recordings", "-o", lab / "out", "--effects", "stiffness", *IN_PROCESS, "--json")
    assert said.status == 0, said.err
    assert [Path(one["path"]).name for one in said.json["inputs"]["recordings"]] == ["a", "b"]


def test_captures_are_imported_by_a_pattern(run: Any, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("time_s,tip_x,tip_y,tip_z\n0,0.1,0,0\n0.1,0.1,0,0.01\n", encoding="utf-8")
    said = run("import", "--jobs", tmp_path / "*.csv", "--unit", "m", "-o", tmp_path / "recordings", *IN_PROCESS, "--json")
    assert said.status == 0 and (tmp_path / "recordings/b/recording.toml").is_file(), said.json


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("estimate", "robot", "recordings"), "Missing option '-o' / '--output'"),
        (("estimate", "--jobs", "recordings/*", "-o", "out"), "ROBOT: no robot"),
        (("estimate", "robot", "recordings/a", "--jobs", "recordings/*", "-o", "out"), "--jobs declares the jobs"),
        (("estimate", "robot", "--jobs", "none*", "-o", "out"), "nothing matches this pattern"),
        (("estimate", "robot", "recordings", "-o", "out", "--memory", "0"), "not an amount of memory"),
        (("improve", "robot", "recordings/a", "-o", "out", "--dask", "local"), "to more than 8 recordings"),
        (("import", "recordings", "-o", "out"), "--jobs 'recordings/*' makes a recording of each"),
        (("import", *("recordings/a/frames.csv",) * 9, "-o", "out"), "too many captures for the cameras of one recording"),
    ],
)
def test_wrong_usage_is_said_before_anything_runs(
    run: Any, lab: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(lab)
    said = run(*words)
    assert said.status == 2 and message in said.err and not (lab / "out").exists()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("recording,frition\nrecordings/a,1\n", "did you mean 'friction'?"),
        ("recording,push\nrecordings/a,perhaps\n", "neither yes nor no"),
        ("recording,name\nrecordings/a,x/y\n", "not the name of a folder"),
        ("recording,name\nrecordings/a,x\nrecordings/b,x\n", "two jobs have the same name"),
        ("friction\n1.0\n", "nothing to work on"),
        ("recording\n", "no jobs"),
    ],
)
def test_a_table_with_an_error_says_where(run: Any, lab: Path, table: str, message: str) -> None:
    (lab / "jobs.csv").write_text(table, encoding="utf-8")
    said = run("estimate", lab / "robot", "--jobs", lab / "jobs.csv", "-o", lab / "out", *IN_PROCESS)
    assert said.status == 2 and message in said.err and "jobs" in said.err


def test_results_of_many_are_not_mixed_into_one(run: Any, lab: Path) -> None:
    said = run("calibrate", lab / "robot", lab / "recordings", "-o", lab / "recordings/a", *IN_PROCESS)
    assert said.status == 2 and "the folder contains a single result, not those of several jobs" in said.err
    assert not (lab / "recordings/a/many.json").exists()


def test_two_drivers_do_not_work_on_one_folder(run: Any, lab: Path) -> None:
    with only_writer(lab / "cal"):
        said = run("calibrate", lab / "robot", lab / "recordings", "-o", lab / "cal", *IN_PROCESS)
    assert said.status == 2 and "another command is writing into this folder" in said.err


def test_one_that_cannot_be_read_does_not_stop_the_others(run: Any, lab: Path) -> None:
    shutil.rmtree(lab / "recordings/a/truth")
    (lab / "recordings/a/frames.csv").write_text("nonsense\n", encoding="utf-8")
    said = run("calibrate", lab / "robot", lab / "recordings", "-o", lab / "cal", *IN_PROCESS)
    assert said.status == 1 and "1 failed, 1 done" in said.out and "frames.csv" in said.out
    assert [row["status"] for row in rows_of(lab / "cal")] == ["failed", "done"]


@pytest.mark.parametrize(
    ("finished", "running", "said"), [(0, 0, "0 of 3, no worker yet"), (1, 2, "1 of 3, 2 running"), (3, 0, "3 of 3")]
)
def test_progress_says_when_no_worker_has_come(finished: int, running: int, said: str) -> None:
    now = Progress(total=3, finished=finished, kept=0, failed=0, running=running, seconds=9.0, seconds_left=None, slowest=None)
    assert progress_text(now) == said
