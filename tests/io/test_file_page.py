"""The page of files says what is read."""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import femsense as fs
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


def test_the_files_of_the_page_are_read(pages: Any, tmp_path: Path) -> None:
    blocks = re.findall(r"^```(?:toml|text)\n(.*?)^```", pages.page(), re.MULTILINE | re.DOTALL)
    starts = {
        "robot.toml": 'format = "femsense-robot',
        "recording.toml": 'format = "femsense-rec',
        "frames.csv": "frame,t",
        "markers.csv": "frame,m",
    }
    for name, start in starts.items():
        [text] = [block for block in blocks if block.startswith(start)]
        (tmp_path / name).write_text(text, encoding="utf-8")
    shutil.copy(fs.robot_names()["finger"] / "finger.vtu", tmp_path)
    robot, recording = fs.load_robot(tmp_path), fs.load_recording(tmp_path)
    assert robot.body.cable_names == recording.cable_names == ("flexor",)
    assert recording.free is not None and recording.free.tolist() == [True, True, False]
    assert set(recording.marker_names) <= set(robot.marker_names)
