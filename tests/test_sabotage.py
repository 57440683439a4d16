"""The list of sabotages: its entries name lines and tests that exist, and the tool distinguishes a failure from a survivor."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import ROOT

spec = importlib.util.spec_from_file_location("sabotage", ROOT / "scripts" / "sabotage.py")
assert spec is not None and spec.loader is not None
tool = sys.modules["sabotage"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)

ENTRY = tool.Sabotage("femsense/sum.py", "a + b", "a - b", "tests/test_sum.py::test_sum")


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository of one file and two tests."""
    root = tmp_path / "repository"
    test = """from femsense.sum import total
def test_sum():
    assert total(2, 1) == 3
def test_zero():
    assert total(0, 0) == 0
"""
    source = "def total(a, b):\n    return a + b\n"
    for name, text in (("femsense/__init__.py", ""), ("femsense/sum.py", source), ("tests/test_sum.py", test)):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    return root


def test_every_entry_names_one_line_and_a_test() -> None:
    assert not [f"{entry}: {why}" for entry in tool.load() if (why := entry.stale())]


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        (ENTRY, ""),
        (replace(ENTRY, line="a * b"), "the line occurs 0 times in the file"),
        (replace(ENTRY, file="femsense/product.py"), "the line occurs 0 times in the file"),
        (replace(ENTRY, test="tests/test_sum.py::test_product"), "there is no tests/test_sum.py::test_product"),
    ],
)
def test_an_entry_without_its_line_or_test_is_stale(repository: Path, entry: tool.Sabotage, why: str) -> None:
    assert entry.stale(repository) == why


def test_a_survivor_is_no_failure(repository: Path) -> None:
    assert tool.result_of(ENTRY, repository) == "failed"
    assert tool.result_of(replace(ENTRY, test="tests/test_sum.py::test_zero"), repository) == "SURVIVED"
    assert tool.result_of(replace(ENTRY, test="tests/test_sum.py::test_product"), repository) == "DID NOT RUN"
    assert (repository / "femsense/sum.py").read_text(encoding="utf-8").endswith("a + b\n")
