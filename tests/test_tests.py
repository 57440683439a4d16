"""Tests speak to the package by its public names, and replace nothing in it: what stands for a seam is an argument or a type."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
FILES = sorted(TESTS.rglob("*.py"))
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


def stands_for_the_package(node: ast.expr, ours: set[str], names: set[str] | None = None) -> bool:
    """Return whether an expression is a module, class or function of femsense: a name, what hangs on it, its path, or what `sys.modules` has."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, str) and node.value.split(".")[0] == "femsense"
    if isinstance(node, ast.Subscript):
        return ast.unparse(node.value) == "sys.modules" and stands_for_the_package(node.slice, ours)
    if isinstance(node, ast.Call):
        return ast.unparse(node.func).endswith("import_module") and stands_for_the_package(node.args[0], ours)
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


def replaced_parts(tree: ast.AST) -> Iterator[str]:
    """Yield what a file puts in the place of something of femsense."""
    ours = imported_from_the_package(tree)
    ours |= {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and not isinstance(node.value, (ast.Name, ast.Attribute, ast.Constant))
        for target in node.targets
        if isinstance(target, ast.Name) and stands_for_the_package(node.value, ours)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            how = ast.unparse(node.func)
            setting = how == "setattr" or how.endswith(
                (".setattr", ".setitem", ".delattr", "patch", "patch.object", "patch.dict")
            )
            if setting and node.args and stands_for_the_package(node.args[0], ours):
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
