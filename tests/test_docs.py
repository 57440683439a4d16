"""Links, files, modules and names that the pages mention exist."""

from __future__ import annotations

import ast
import doctest
import re
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import femsense
from femsense.many.outcome import JobStatus
from femsense.qp.solve import ProgramStatus
from femsense.sensing.status import Status as FrameStatus

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "meshes").rglob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
QUOTED = re.compile(r"`([^`\n]+)`")
FILE = re.compile(r"(?:python )?((?:\w[\w.-]*/)+[\w.-]+\.(?:py|md)|test_\w+\.py)(?: .*)?")
OURS = re.compile(r"\b((?:benchmarks|docs|femsense|meshes|scripts|tests)/[\w./-]+\.(?:py|md))\b")
DOTTED = re.compile(r"femsense(?:\.\w+)+")
NAME = re.compile(r"[A-Za-z_]\w*")
MEANT_BY_USERS = {"magnet.py"}
"""Files that an example of a page speaks of."""


def links_of(text: str) -> list[str]:
    """Return the targets of links to other pages and pictures, without their anchors."""
    found = (target.split("#")[0] for target in LINK.findall(FENCED.sub("", text)))
    return [target for target in found if target and "://" not in target and not target.startswith("mailto:")]


def files_of(text: str) -> list[str]:
    """Return the files that a page mentions: in backquotes, or by a path from the root anywhere."""
    quoted = (FILE.fullmatch(words) for words in QUOTED.findall(FENCED.sub("", text)))
    return sorted({*(m[1] for m in quoted if m), *OURS.findall(text)} - MEANT_BY_USERS)


def modules_of(text: str) -> list[str]:
    """Return the dotted names of the package that a page mentions in backquotes."""
    return sorted({words for words in QUOTED.findall(text) if DOTTED.fullmatch(words)})


def named_in_tables(text: str) -> list[tuple[str, str]]:
    """Return (file, name) of table rows that give a file of the package and names in it."""
    rows = (QUOTED.findall(line) for line in text.splitlines() if line.startswith("|"))
    return [(row[0], name) for row in rows if row and row[0].endswith(".py") for name in row[1:] if NAME.fullmatch(name)]


def exists(file: str, page: Path) -> bool:
    """Return whether a file is beside a page, at the root, in the package, or is a test."""
    if file.startswith("test_"):
        return any((ROOT / "tests").rglob(file))
    return any((folder / file).exists() for folder in (page.parent, ROOT, ROOT / "femsense", ROOT / "meshes"))


def extras_of(text: str) -> set[str]:
    """Return the extras of femsense that a text tells to install."""
    named = re.findall(r"(?:femsense|pip install[^\n`]*[ \"]\.)\[([a-z, ]+)\]", text)
    return {extra.strip() for group in named for extra in group.split(",")}


def top_level_names(file: Path) -> set[str]:
    """Return what a module defines or imports."""
    names: set[str] = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        match node:
            case ast.FunctionDef() | ast.ClassDef():
                names.add(node.name)
            case ast.Assign():
                names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
            case ast.AnnAssign(target=ast.Name(id=name)):
                names.add(name)
    return names


def is_there(dotted: str) -> bool:
    """Return whether a dotted name is a module of the package, or something in one."""
    path, _, last = dotted.rpartition(".")
    try:
        import_module(dotted)
    except ModuleNotFoundError:
        try:
            return hasattr(import_module(path), last)
        except ModuleNotFoundError:
            return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_to_files(page: Path) -> None:
    missing = [target for target in links_of(page.read_text(encoding="utf-8")) if not (page.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_that_a_page_mentions_exist(page: Path) -> None:
    missing = [file for file in files_of(page.read_text(encoding="utf-8")) if not exists(file, page)]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_modules_that_a_page_mentions_exist(page: Path) -> None:
    missing = [name for name in modules_of(page.read_text(encoding="utf-8")) if not is_there(name)]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_names_beside_a_file_are_in_that_file(page: Path) -> None:
    pairs = named_in_tables(page.read_text(encoding="utf-8"))
    missing = [(file, name) for file, name in pairs if (ROOT / file).exists() and name not in top_level_names(ROOT / file)]
    assert not missing


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "femsense").rglob("*.py"))], ids=lambda page: page.stem)
def test_extras_that_a_text_names_exist(page: Path) -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert extras_of(page.read_text(encoding="utf-8")) <= set(declared)


def test_the_architecture_shows_every_room() -> None:
    page = (ROOT / "docs/reference/architecture.md").read_text(encoding="utf-8")
    rooms = [folder.name for folder in (ROOT / "femsense").iterdir() if (folder / "__init__.py").exists()]
    inner = [f"loop/{folder.name}" for folder in (ROOT / "femsense/loop").iterdir() if (folder / "__init__.py").exists()]
    assert not [room for room in [*rooms, *inner] if f"| `{room}/` |" not in page]


def test_what_does_not_exist_is_found() -> None:
    text = "[a](no-such.md) [b](https://host/x.md) `fem/no_such.py` `python benchmarks/no_such.py --all` `femsense.no.such`\n"
    text += "| step | `femsense/core/pose.py` | `no_such` |\n```\npython meshes/no_such.py\n[c](d.md)\n```\n"
    assert links_of(text) == ["no-such.md"]
    gone = ["benchmarks/no_such.py", "fem/no_such.py", "meshes/no_such.py"]
    assert files_of(text) == [*gone[:2], "femsense/core/pose.py", gone[2]]
    assert [file for file in files_of(text) if not exists(file, ROOT / "docs/page.md")] == gone
    assert modules_of(text) == ["femsense.no.such"] and not is_there("femsense.no.such") and is_there("femsense.core.pose")
    assert named_in_tables(text) == [("femsense/core/pose.py", "no_such")]
    assert extras_of('pip install "femsense[no]", femsense[such,xr]\npip install -e ".[all]" or\npip install .[these]') == {
        "no",
        "such",
        "xr",
        "all",
        "these",
    }
    assert "no_such" not in top_level_names(ROOT / "femsense/core/pose.py")


STATUSES = [
    *(status.value for status in FrameStatus),
    *(status.value for status in JobStatus),
    *(status.value for status in ProgramStatus),
]


@pytest.mark.parametrize("text", STATUSES)
def test_every_status_has_its_row_with_cause_and_remedy(text: str) -> None:
    page = (ROOT / "docs/guides/statuses.md").read_text(encoding="utf-8")
    shown = re.sub(r"\{[^}]*\}", "…", text)
    rows = [line for line in page.splitlines() if line.startswith(f"| `{shown}` |")]
    assert len(rows) == 1
    assert len(rows[0].split(" | ")) == 3


def test_every_public_name_is_in_the_reference() -> None:
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs/reference").glob("*.md"))
    described = re.findall(r"^\.\. auto\w+:: femsense\.(\w+)$", pages, re.MULTILINE)
    assert sorted(described) == sorted(set(femsense.__all__) - {"__version__"})


@pytest.mark.parametrize("name", [name for name in femsense.__all__ if ">>>" in (getattr(femsense, name).__doc__ or "")])
def test_examples_of_the_reference_give_what_they_show(name: str) -> None:
    public = getattr(femsense, name)
    [test] = doctest.DocTestFinder(recurse=False).find(public, name, globs={"fs": femsense, "np": np})
    assert doctest.DocTestRunner().run(test).failed == 0
