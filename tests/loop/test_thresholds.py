"""The thresholds of the loop: each of them decides something."""

from __future__ import annotations

import ast
from dataclasses import fields
from pathlib import Path

import femsense.loop
from femsense.loop.thresholds import Effort, Thresholds

FILES = [file for file in Path(femsense.loop.__file__).parent.rglob("*.py") if file.name != "thresholds.py"]


def test_every_threshold_is_read_in_the_loop() -> None:
    trees = (ast.parse(file.read_text(encoding="utf-8")) for file in FILES)
    read = {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert not {field.name for type_ in (Thresholds, Effort) for field in fields(type_)} - read
