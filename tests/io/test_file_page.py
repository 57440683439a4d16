"""The page of files says what is read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from femsense.io.recording_columns import COLUMNS, columns

SCRIPT = Path(__file__).parents[2] / "scripts" / "file_pages.py"


@pytest.fixture(scope="module")
def pages() -> Any:
    spec = importlib.util.spec_from_file_location("file_pages", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(pages: Any) -> None:
    assert pages.PAGE.read_text(encoding="utf-8") == pages.page(), "run python scripts/file_pages.py"


def test_the_page_has_every_key_and_column(pages: Any) -> None:
    text = pages.page()
    for word in ("`[[tools]]`", "`[camera.noise]`", "`[cameras.NAME]`", "`[tools.cylinder]`", "| `at_1m_m` | number |"):
        assert word in text
    for table in COLUMNS.values():
        assert all(f"| `{column.name}` |" in text for column in table)


def test_columns_of_families() -> None:
    assert columns("frames.csv")[2] == ("cable_", "chamber_")
    assert columns("rest.csv") == (("marker", "x_m", "y_m", "z_m"), ("std_m", "camera"), ())
