"""The summary of many jobs: a table, a page, and what was set aside."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest
from pyarrow import parquet

from femsense.core.errors import InputError
from femsense.many.outcome import JobStatus, Outcome
from femsense.many.summary import check_summary_folder, write_summary

OUTCOMES = (
    Outcome("a", JobStatus.DONE, row={"rms_m": 1e-3, "verdict": "none"}, seconds=2.0, peak_bytes=500_000_000, host="one"),
    Outcome("b", JobStatus.KEPT, row={"rms_m": 2e-3, "effects": "</script>"}, seconds=4.0, host="two"),
    Outcome("c", JobStatus.CRASHED, "its worker was ended by SIGSEGV", deaths=2),
    Outcome("d", JobStatus.DONE, deaths=1),
)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    for name in "abd":
        (tmp_path / "out" / name).mkdir(parents=True)
    (tmp_path / "out/b/report.html").write_text("")
    write_summary(tmp_path / "out", "calibrate", OUTCOMES, {o.name: tmp_path / "out" / o.name for o in OUTCOMES})
    return tmp_path / "out"


def test_one_table_has_a_row_for_each_job(out: Path) -> None:
    with (out / "summary.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["status"] for row in rows] == ["done", "done", "crashed", "done"]
    assert [row["folder"] for row in rows] == ["a", "b", "", "d"] and rows[0]["rms_m"] == "0.001" and rows[2]["rms_m"] == ""
    table = parquet.read_table(out / "summary.parquet").to_pylist()
    assert table[1]["rms_m"] == 2e-3 and table[0]["effects"] is None and list(table[0]) == list(rows[0])


def test_what_killed_its_workers_and_has_no_result_stands_in_a_list_of_its_own(out: Path) -> None:
    assert (out / "poison.csv").read_text(encoding="utf-8") == "name,reason,deaths\nc,its worker was ended by SIGSEGV,2\n"
    write_summary(out, "calibrate", OUTCOMES[:2], {o.name: out / o.name for o in OUTCOMES})
    assert not (out / "poison.csv").exists()


def test_the_page_needs_nothing_else_and_links_to_the_reports(out: Path) -> None:
    page = (out / "summary.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="', page.replace('href="#', "")) and page.count("</script>") == 2
    data = json.loads(re.search(r'id="data">(.*)</script>', page)[1])  # type: ignore[index]
    assert data["links"] == ["a/", "b/report.html", "", "d/"]
    assert data["rows"][1][data["columns"].index("effects")] == "</script>"
    assert "3 of 4 recordings have a result" in page


def test_a_file_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "summary.csv").write_text("my,own,table\n")
    with pytest.raises(InputError, match="another file would be replaced"):
        check_summary_folder(tmp_path)
