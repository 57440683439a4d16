"""The list of sabotages: what its entries name is there, what a sample holds, and that what was broken is whole again."""

from __future__ import annotations

import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from helpers import ROOT


def load_tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("sabotage", ROOT / "scripts" / "sabotage.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["sabotage"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


tool = load_tool()
ENTRIES = tool.load_sabotages()


def entry(file: str = "femsense/fem/bar.py", **changes: Any) -> Any:
    return tool.Sabotage(**{"file": file, "line": "a + b", "broken": "a - b", "tests": ("fem/test_bar.py::test_sum",), **changes})


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository of one file and one test."""
    for name, text in (("femsense/fem/bar.py", "x = a + b\n"), ("tests/fem/test_bar.py", "def test_sum() -> None:\n    pass\n")):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_every_entry_names_one_line_and_tests_that_exist() -> None:
    assert not [f"{tool.shown(s)}: {why}" for s in ENTRIES if (why := tool.what_is_stale(s))]
    assert all(s.broken != s.line and s.tests for s in ENTRIES)


def test_no_entry_stands_twice() -> None:
    assert len({(s.file, s.line, s.broken) for s in ENTRIES}) == len(ENTRIES)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"line": "a * b"}, "the line stands 0 times in the file"),
        ({"line": "a"}, ""),
        ({"line": " "}, "the line stands 4 times in the file"),
        ({"file": "femsense/fem/rod.py"}, "the line stands 0 times in the file"),
        ({"tests": ("fem/test_bar.py::test_difference",)}, "no test is called fem/test_bar.py::test_difference"),
        ({"tests": ("fem/test_bar.py::test_sum[1]",)}, ""),
    ],
)
def test_an_entry_that_names_what_is_not_there_is_stale(repository: Path, changes: dict[str, Any], why: str) -> None:
    assert tool.what_is_stale(entry(**changes), repository) == why


def test_a_sample_takes_one_of_each_file_before_the_second_of_any() -> None:
    entries = [entry(f"femsense/fem/{name}.py", line=str(i)) for i, name in enumerate("aaaaaabbbc")]
    drawn = tool.draw(entries, 5, random.Random(3))
    assert sorted(s.file[-4] for s in drawn[:3]) == ["a", "b", "c"] and sorted(s.file[-4] for s in drawn[3:]) == ["a", "b"]
    assert tool.draw(entries, 5, random.Random(3)) == drawn
    assert len(tool.draw(entries, 50, random.Random(3))) == len(entries)


def test_a_sample_runs_the_cheapest_test_alone() -> None:
    entries = [entry(line="x", tests=("cheap", "expensive"))]
    assert [s.tests for s in tool.draw(entries, 5, random.Random(0))] == [("cheap",)]


def test_the_sample_of_make_test_fits_the_list() -> None:
    files = {s.file for s in ENTRIES}
    drawn = tool.draw(ENTRIES, 64, random.Random(0))
    assert len(drawn) == 64 and len({s.file for s in drawn}) == min(64, len(files))


def test_what_was_broken_is_whole_again_with_its_kernels(repository: Path) -> None:
    path, kernels = repository / "femsense/fem/bar.py", repository / "femsense/fem/__pycache__"
    kernels.mkdir()
    (kernels / "bar.f-1.py311.nbi").write_text("whole")
    before = path.stat().st_mtime_ns
    with pytest.raises(KeyError), tool.broken(repository, entry()):
        assert path.read_text() == "x = a - b\n" and not list(kernels.iterdir())
        (kernels / "bar.f-1.py311.nbi").write_text("broken")
        raise KeyError
    assert path.read_text() == "x = a + b\n" and path.stat().st_mtime_ns == before
    assert [kernel.read_text() for kernel in kernels.iterdir()] == ["whole"]


def test_tests_that_cannot_run_are_no_red(repository: Path) -> None:
    test = repository / "tests/fem/test_bar.py"
    assert tool.red(repository, ["fem/test_bar.py::test_sum"])[0] is False
    test.write_text("def test_sum():\n    assert False\n")
    assert tool.red(repository, ["fem/test_bar.py::test_sum"])[0] is True
    noticed, remark = tool.red(repository, ["fem/test_bar.py::test_nothing"])
    assert not noticed and remark.startswith("the tests did not run")
