"""Tests speak to the package by its public names, and replace nothing in it: what stands for a seam is an argument or a type."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
FILES = sorted(TESTS.rglob("*.py"))
OURS = {"femsense", *(file.stem for file in FILES)}
"""What a test may not patch: the package, and what stands beside the tests."""
NAMES = [file.relative_to(TESTS).as_posix() for file in FILES]


def is_private(name: str) -> bool:
    """Return whether a name has one underscore in front; names that Python or IPython call have some behind too."""
    return name.startswith("_") and not name.endswith("_")


def imported_from_the_package(tree: ast.AST) -> set[str]:
    """Return the names in a file that stand for something of femsense, bound by an import."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "femsense":
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.asname or "femsense" for alias in node.names if alias.name.split(".")[0] == "femsense"}
    return found


def stands_for_the_package(node: ast.expr, ours: set[str]) -> bool:
    """Return whether an expression is a module, class or function of femsense, or hangs on one."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return isinstance(node, ast.Name) and node.id in ours


def private_names(tree: ast.AST) -> Iterator[str]:
    """Yield what a file takes of others by a private name; a class of its own may have private parts."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            yield from (f"line {node.lineno}: import {name}" for name in names if is_private(name))
        elif isinstance(node, ast.Attribute) and is_private(node.attr):
            if not (isinstance(node.value, ast.Name) and node.value.id == "self"):
                yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "getattr":
            name = node.args[1]
            if isinstance(name, ast.Constant) and is_private(str(name.value)):
                yield f"line {node.lineno}: {ast.unparse(node)}"


def imported_from_elsewhere(tree: ast.AST) -> set[str]:
    """Return the names in a file that an import of something else binds: Python, pytest, other libraries."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] not in OURS:
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.asname or alias.name.split(".")[0] for alias in node.names if alias.name.split(".")[0] not in OURS}
    return found


def is_foreign(node: ast.expr, others: set[str]) -> bool:
    """Return whether an expression is a part of another library: by its name, or by its path as a text."""
    if isinstance(node, ast.Constant):
        return str(node.value).split(".")[0] not in OURS
    while isinstance(node, ast.Attribute):
        node = node.value
    return isinstance(node, ast.Name) and node.id in others


def replaced_parts(tree: ast.AST) -> Iterator[str]:
    """Yield where a file puts something in the place of what is not known to be another library's."""
    others, ours = imported_from_elsewhere(tree), imported_from_the_package(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args:
            how = ast.unparse(node.func)
            replaces = how == "setattr" or how.endswith((".setattr", ".delattr", "mock.patch", "patch.object"))
            if replaces and not is_foreign(node.args[0], others):
                yield f"line {node.lineno}: {how}({ast.unparse(node.args[0])}, …)"
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AugAssign) else []
        for target in targets:
            if isinstance(target, ast.Attribute) and stands_for_the_package(target, ours):
                yield f"line {node.lineno}: {ast.unparse(target)} = …"


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_tests_use_public_names_and_replace_nothing(file: Path) -> None:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    found = [*private_names(tree), *replaced_parts(tree)]
    assert not found, "\n".join(["reach into the package:", *found])


REACHING = (
    "from femsense.fem import newton\nnewton._step(1)",
    "from femsense.fem.newton import _step",
    "from femsense._own import step",
    "import femsense\ngetattr(femsense.fem, '_step')",
    "from femsense.fem import newton\ndef test(monkeypatch):\n    monkeypatch.setattr(newton, 'CHORD', 0)",
    "def test(monkeypatch):\n    monkeypatch.setattr('femsense.fem.newton.CHORD', 0)",
    "import sys\ndef test(monkeypatch):\n    monkeypatch.setattr(sys.modules['femsense.fem'], 'CHORD', 0)",
    "from femsense.fem import newton\nfor module in (newton,):\n    setattr(module, 'CHORD', 0)",
    "from femsense.fem import newton\nnewton.CHORD = 0",
)
HARMLESS = (
    "import sys\ndef test(monkeypatch):\n    monkeypatch.setattr(sys, 'argv', [])",
    "def test(monkeypatch):\n    monkeypatch.setattr('tempfile.tempdir', 'x')",
    "from pathlib import Path\ndef test(monkeypatch):\n    monkeypatch.setattr(Path, 'home', None)",
    "class Own:\n    def __init__(self):\n        self._kept = 1",
    "run._repr_html_()",
)


@pytest.mark.parametrize(("texts", "are_found"), [(REACHING, True), (HARMLESS, False)])
def test_what_reaches_in_is_found(texts: tuple[str, ...], are_found: bool) -> None:
    for text in texts:
        tree = ast.parse(text)
        assert bool([*private_names(tree), *replaced_parts(tree)]) == are_found, text
