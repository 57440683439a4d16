"""The short tutorials run, and each page shows the code of its script."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))


def writer() -> ModuleType:
    """The script that writes the pages."""
    spec = importlib.util.spec_from_file_location("tutorials", ROOT / "scripts" / "tutorials.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", TUTORIALS, ids=lambda path: path.stem)
def test_a_page_has_the_text_and_the_code_of_its_script(script: Path) -> None:
    page = script.with_name(f"{script.stem.replace('_', '-')}.md").read_text(encoding="utf-8")
    tutorials = writer()
    cells = tutorials.cells_of(script.read_text(encoding="utf-8"))
    assert len(cells) > 5
    missing = [cell.text for cell in cells if (cell.text if cell.is_markdown else tutorials.code_of(cell)) not in page]
    assert not missing


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("extend", "of the magnet move the finger by up to"),
        ("sensors_to_headset", "8 bones, tip at"),
        ("close_the_loop", "not testable: creep"),
    ],
)
def test_it_runs(name: str, shown: str, tmp_path: Path) -> None:
    script = ROOT / "docs" / "tutorials" / f"{name}.py"
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert shown in done.stdout
