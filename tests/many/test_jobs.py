"""Lists of jobs: patterns, folders of many results, names, and tables."""

from __future__ import annotations

from pathlib import Path

import pyarrow
import pytest
from pyarrow import parquet

from femsense.core.errors import InputError
from femsense.io.files import write_json
from femsense.many.jobs import MANY, SUMMARY, expanded, is_glob, names_of, read_table


def folders(root: Path, *names: str) -> list[Path]:
    for name in names:
        (root / name).mkdir(parents=True)
    return [root / name for name in names]


def test_patterns_are_sorted_and_summaries_are_no_recordings(tmp_path: Path) -> None:
    b, a = folders(tmp_path, "b", "a")
    for name in SUMMARY:
        (tmp_path / name).write_text("")
    assert expanded([tmp_path / "*"]) == [a, b] == expanded([a, tmp_path / "summary.csv", b])
    assert expanded([tmp_path / "nowhere"]) == [tmp_path / "nowhere"]
    with pytest.raises(InputError, match="nothing matches this pattern"):
        expanded([tmp_path / "x*"])


def test_a_folder_of_many_results_stands_for_these(tmp_path: Path) -> None:
    a, b = folders(tmp_path, "out/a", "out/b")
    write_json(tmp_path / "out" / MANY, {"folders": {"a": "a", "b": "b", "failed": ""}})
    assert expanded([tmp_path / "out"]) == [a, b]


def test_a_folder_with_brackets_is_no_pattern(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, "push [1]")
    assert not is_glob(folder) and is_glob(tmp_path / "push [2]") and expanded([folder]) == [folder]


def test_names_are_as_short_as_they_can_be(tmp_path: Path) -> None:
    paths = folders(tmp_path, "monday/push", "tuesday/push", "tuesday/run.2")
    assert names_of(paths[1:]) == ["push", "run.2"]
    assert names_of(paths) == ["monday-push", "tuesday-push", "tuesday-run.2"]
    assert names_of([tmp_path / "a.bag", tmp_path / "b.bag"]) == ["a", "b"]
    with pytest.raises(InputError, match="the same path occurs twice"):
        names_of([paths[0], paths[0]])


def test_a_table_is_the_same_as_csv_and_as_parquet(tmp_path: Path) -> None:
    (tmp_path / "jobs.csv").write_text("robot,recording,at,friction\narm,a,0.1 0.2,\nfinger,b,,0.5\n", encoding="utf-8")
    columns = {"robot": ["arm", "finger"], "recording": ["a", "b"], "at": [["0.1", "0.2"], None], "friction": [None, 0.5]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "jobs.parquet")
    wanted = [{"robot": "arm", "recording": "a", "at": "0.1 0.2"}, {"robot": "finger", "recording": "b", "friction": "0.5"}]
    for name in ("jobs.csv", "jobs.parquet"):
        assert [row.cells for row in read_table(tmp_path / name)] == wanted
    assert read_table(tmp_path / "jobs.csv")[1].where.endswith("jobs.csv, line 3")


def test_a_broken_table_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "jobs.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match="not a Parquet table"):
        read_table(tmp_path / "jobs.parquet")
